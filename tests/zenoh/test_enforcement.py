"""What any Zenoh access control decides: subjects, ALLOW, DENY and the default."""

from __future__ import annotations

import json
from collections.abc import Sequence
from itertools import permutations
from typing import Any

import pytest

from sros_tool.zenoh.access import Enforcement, Flow, Message, Remote
from sros_tool.zenoh.document import parse_configuration

TALKER = Remote("/talker")


def enforcement(
    rules: dict[str, str], subjects: dict[str, Any], policies: dict[str, str], default: str = "deny"
) -> Enforcement:
    """Rules as `allow KEY` or `deny KEY` for puts; policies as the names of rules by subject."""
    stated = [
        {"id": name, "permission": what, "messages": ["put"], "key_exprs": [key]}
        for name, (what, key) in ((name, text.split()) for name, text in rules.items())
    ]
    control = {
        "enabled": True,
        "default_permission": default,
        "rules": stated,
        "subjects": [{"id": name, **of} for name, of in subjects.items()],
        "policies": [{"rules": of.split(), "subjects": [name]} for name, of in policies.items()],
    }
    return parse_configuration(json.dumps({"access_control": control}).encode(), "file").access


NAMED = {"cert_common_names": ["/talker"]}
RULES = {"yes": "allow a/*", "all": "allow **", "no": "deny a/b", "never": "deny **"}


@pytest.mark.parametrize(
    ("subjects", "policies", "default", "key", "allowed", "rules"),
    [
        ({"t": NAMED}, {"t": "yes"}, "deny", "a/b", True, ("yes",)),
        ({"t": NAMED}, {"t": "yes"}, "deny", "a/*", True, ("yes",)),
        ({"t": NAMED}, {"t": "yes"}, "deny", "a/**", False, ()),
        ({"t": NAMED}, {"t": "yes no"}, "deny", "a/b", False, ("no",)),
        # The hole of a denial: a wildcard is not included in it.
        ({"t": NAMED}, {"t": "all no"}, "deny", "a/*", True, ("all",)),
        ({"t": NAMED, "e": {}}, {"t": "no", "e": "yes"}, "deny", "a/b", True, ("yes",)),
        ({"t": NAMED, "e": {}}, {"t": "yes", "e": "no"}, "deny", "a/b", True, ("yes",)),
        # Two subjects of the same values are one, in which DENY wins.
        ({"t": NAMED, "e": NAMED}, {"t": "yes", "e": "no"}, "deny", "a/b", False, ("no",)),
        ({"t": NAMED}, {"t": "no"}, "allow", "a/b", False, ("no",)),
        ({"t": NAMED}, {"t": "no"}, "allow", "a/c", True, ()),
        # Under default ALLOW a second subject without a rule disarms the denial.
        ({"t": NAMED, "e": {}}, {"t": "never"}, "allow", "a/b", True, ()),
        ({"o": {"cert_common_names": ["/o"]}}, {"o": "yes"}, "deny", "a/b", False, ()),
        ({"o": {"cert_common_names": ["/o"]}}, {"o": "never"}, "allow", "a/b", True, ()),
        ({"t": {**NAMED, "link_protocols": ["tcp"]}}, {"t": "yes"}, "deny", "a/b", False, ()),
        ({"t": {**NAMED, "link_protocols": ["tcp", "tls"]}}, {"t": "yes"}, "deny", "a/b", True,
         ("yes",)),
        ({"t": {"usernames": ["talker"]}}, {"t": "yes"}, "deny", "a/b", False, ()),
    ],
)  # fmt: skip
def test_decision(
    subjects: dict[str, Any],
    policies: dict[str, str],
    default: str,
    key: str,
    allowed: bool,
    rules: tuple[str, ...],
) -> None:
    found = enforcement(RULES, subjects, policies, default)
    decision = found.decide(TALKER, Flow.INGRESS, Message.PUT, key)
    assert (decision.allowed, decision.rules) == (allowed, rules)
    assert decision.why


def test_the_order_in_which_a_file_lists_its_rules_decides_nothing() -> None:
    """Policies name rules by their ids, and DENY wins wherever it stands."""

    def allowed(names: Sequence[str]) -> tuple[bool, ...]:
        rules = {name: RULES[name] for name in names}
        found = enforcement(rules, {"t": NAMED}, {"t": "yes no"})
        return tuple(
            found.decide(TALKER, Flow.EGRESS, Message.PUT, key).allowed
            for key in ("a/b", "a/c", "b")
        )

    assert {allowed(names) for names in permutations(RULES)} == {(False, True, False)}


def test_no_common_name_matches_no_named_subject() -> None:
    found = enforcement(RULES, {"t": NAMED}, {"t": "all"})
    assert found.decide(TALKER, Flow.EGRESS, Message.PUT, "x").allowed
    assert not found.decide(Remote(), Flow.EGRESS, Message.PUT, "x").allowed
    assert not found.decide(TALKER, Flow.EGRESS, Message.DELETE, "x").allowed


def test_access_control_that_is_off() -> None:
    assert (
        parse_configuration(b"{}", "file")
        .access.decide(Remote(), Flow.INGRESS, Message.PUT, "x")
        .allowed
    )
