"""What becomes looser and what tighter: every attribute, in both directions."""

from __future__ import annotations

from dataclasses import fields, replace
from datetime import UTC, datetime, timedelta
from itertools import permutations

import pytest

from sros_tool.dds.domains import DomainSet
from sros_tool.dds.governance import DomainRule, Governance, TopicRule, attributes
from sros_tool.keystore.comparison import Effect, compare_governance, compare_settings, mismatch
from sros_tool.keystore.template import (
    NamedValues,
    ShortLivedEnclaves,
    Template,
    load_template,
    parse_template,
    settings_values,
    template_names,
    with_values,
)
from sros_tool.policy.model import Level
from sros_tool.translate import governance_for, protection_for
from sros_tool.zenoh.configuration import Mode, ZenohNetwork, ZenohRouter

NOW = datetime(2026, 11, 22, tzinfo=UTC)
ZERO = DomainSet.of((0, 0))
PRODUCTION = load_template("production")


def governance(template: Template, domains: DomainSet = ZERO) -> Governance:
    return governance_for(template.protection, domains)


def effects(old: Governance, new: Governance) -> list[tuple[str, str]]:
    return [(each.effect.value, each.key) for each in compare_governance(old, new)]


@pytest.mark.parametrize(
    ("where", "term"),
    [("protection", each.term) for each in attributes(DomainRule)]
    + [("protection.default", each.term) for each in attributes(TopicRule)],
)
def test_every_attribute_is_looser_one_way_and_tighter_the_other(where: str, term: str) -> None:
    rule = DomainRule if where == "protection" else TopicRule
    (attribute,) = [each for each in attributes(rule) if each.term == term]
    key = f"{where}.{term}"
    closed = with_values(PRODUCTION, [("protection.rtps", "NONE")])
    closed, opened = (
        with_values(closed, [(key, str(value).lower() if attribute.is_flag else str(value))])
        for value in (attribute.portable, attribute.open)
    )
    assert effects(governance(closed), governance(opened)) == [("looser", key)]
    assert effects(governance(opened), governance(closed)) == [("tighter", key)]
    assert effects(governance(opened), governance(opened)) == []


def test_every_pair_of_levels_is_looser_one_way_at_least() -> None:
    """One that signs each writer is no weaker than one that encrypts, and no stronger."""
    for one, other in permutations(Level, 2):
        old, new = (with_values(PRODUCTION, [("protection.rtps", each)]) for each in (one, other))
        there = {effect for effect, _ in effects(governance(old), governance(new))}
        back = {effect for effect, _ in effects(governance(new), governance(old))}
        assert there
        assert back == {{"looser": "tighter", "tighter": "looser"}[each] for each in there}


CAMERA = NamedValues("topic", "/camera/*", (("data", "NONE"), ("metadata", "SIGN")))


@pytest.mark.parametrize(
    ("rules", "expected"),
    [
        (
            [CAMERA],
            [
                ("looser", "protection.topic /camera/*.metadata"),
                ("looser", "protection.topic /camera/*.data"),
            ],
        ),
        (
            [NamedValues("service", "/add", (("read_access_control", "false"),))],
            [("looser", "protection.service /add.read_access_control")],
        ),
        (
            [NamedValues("action", "/fib", (("data", "NONE"),))],
            [("looser", "protection.action /fib.data")],
        ),
        # A rule that says what holds anyway changes nothing.
        ([NamedValues("topic", "/scan", (("data", "ENCRYPT"),))], []),
    ],
)
def test_rules_are_compared_by_what_they_decide(
    rules: list[NamedValues], expected: list[tuple[str, str]]
) -> None:
    changed = with_values(PRODUCTION, rules=rules)
    assert effects(governance(PRODUCTION), governance(changed)) == expected
    back = [("tighter", key) for _, key in expected]
    assert effects(governance(changed), governance(PRODUCTION)) == back


def test_the_order_of_rules_that_overlap_decides() -> None:
    """Neither rule is wider than the other, so the first decides on /axb."""
    weak = NamedValues("topic", "/a*", (("data", "NONE"),))
    strong = NamedValues("topic", "/*b", (("data", "ENCRYPT"),))
    first = governance(with_values(PRODUCTION, rules=[strong, weak]))
    second = governance(with_values(PRODUCTION, rules=[weak, strong]))
    (change,) = compare_governance(first, second)
    assert change.effect is Effect.LOOSER
    assert "/ab" in change.meaning


def test_domains() -> None:
    both = governance(PRODUCTION, DomainSet.parse("0,7"))
    assert effects(governance(PRODUCTION), both) == [("looser", "domain")]
    assert effects(both, governance(PRODUCTION)) == [("tighter", "domain")]


@pytest.mark.parametrize(
    ("values", "effect"),
    [
        (("certificates.validity", "400d"), "looser"),
        (("certificates.validity", "2000-01-01"), "tighter"),
        (("permissions.validity", "90d"), "tighter"),
        (("permissions.default", "everything"), "looser"),
        (("certificates.unique_subject", "false"), "looser"),
        (("authorities.layout", "single"), "looser"),
        (("authorities.validity", "20y"), "later"),
        (("authorities.name", "robots"), "later"),
        (("revocation.validity", "1y"), "later"),
    ],
)
def test_settings(values: tuple[str, str], effect: str) -> None:
    changed = with_values(PRODUCTION, [values])
    (change,) = compare_settings(PRODUCTION, changed, NOW)
    assert (change.effect.value, change.key) == (effect, values[0])


@pytest.mark.parametrize(
    ("before", "after", "effect"),
    [((), (1,), "tighter"), ((1,), (), "looser"), ((1,), (2,), "looser"), ((2,), (1,), "tighter")],
)
def test_short_lived_enclaves(before: tuple[int], after: tuple[int], effect: str) -> None:
    old, new = (
        replace(
            PRODUCTION,
            short_lived=tuple(ShortLivedEnclaves("/op/*", timedelta(days=d)) for d in days),
        )
        for days in (before, after)
    )
    (change,) = compare_settings(old, new, NOW)
    assert (change.effect.value, change.key) == (effect, "enclaves /op/*.validity")


def test_every_field_of_the_settings_is_compared() -> None:
    """A field that is added later would otherwise change in silence."""
    seen = {
        "name",
        "description",
        "distributions",  # says for what the keystore is, and changes no file
        "identity_key",  # a place, which an update does not change
        "permissions_key",
        "protection",  # compared as governance
        "separate_authorities",
        "authority_name",
        "authority_validity",
        "certificate_validity",
        "permissions_validity",
        "default_permissions",
        "unique_subject",
        "revocation_validity",
        "short_lived",
        "zenoh",
    }
    assert {each.name for each in fields(Template)} == seen


@pytest.mark.parametrize(
    ("values", "rules", "everything", "names"),
    [
        ([("protection.rtps", "SIGN")], [], True, ()),
        ([("protection.discovery", "SIGN")], [], True, ()),
        ([("protection.liveliness", "SIGN")], [], True, ()),
        ([("protection.join_access_control", "false")], [], False, ()),
        ([("protection.default.data", "NONE")], [], True, ()),
        ([], [CAMERA], False, ("topic /camera/*",)),
        ([("permissions.validity", "1d")], [], False, ()),
    ],
)
def test_what_does_not_communicate(
    values: list[tuple[str, str]],
    rules: list[NamedValues],
    everything: bool,
    names: tuple[str, ...],
) -> None:
    """As measured; `tests/integration/test_update_on_dds.py` asks the vendors."""
    found = mismatch(governance(PRODUCTION), governance(with_values(PRODUCTION, values, rules)))
    assert (found.everything, found.names) == (everything, names)


# ── settings as values, and back from governance ───────────────────────────────────────────


@pytest.mark.parametrize("name", template_names())
def test_the_protection_of_a_governance_is_found_again(name: str) -> None:
    template = with_values(
        load_template(name),
        rules=[
            CAMERA,
            NamedValues("topic", "/camera/secret", ()),
            NamedValues("service", "/add", (("data", "NONE"),)),
            NamedValues("action", "/fib", (("metadata", "SIGN"),)),
        ],
    )
    found = protection_for(governance(template, DomainSet.parse("0,5-7")))
    assert found is not None
    assert governance(replace(template, protection=found)) == governance(template)


def test_a_governance_that_settings_cannot_state() -> None:
    (rule,) = governance(PRODUCTION).domain_access_rules
    (last,) = rule.topic_access_rules
    half = replace(last, topic_expression="rq/addRequest")
    for rules in ((half, last), (last, last), ()):
        assert protection_for(Governance((replace(rule, topic_access_rules=rules),))) is None
    assert protection_for(Governance((rule, rule))) is None


def test_values_of_settings() -> None:
    changed = with_values(PRODUCTION, [("protection.rtps", "SIGN")], [CAMERA])
    values = settings_values(changed)
    assert values["protection.rtps"] == "SIGN"
    assert values["protection.topic /camera/*.data"] == "NONE"
    assert with_values(changed, dropped=[("topic", "/camera/*")]).protection.named == ()


@pytest.mark.parametrize(
    "wrong",
    [
        {"values": [("protection.rtps", "LOUD")]},
        {"values": [("protection.rpts", "SIGN")]},
        {"values": [("rtps", "SIGN")]},
        {"values": [("protection", "SIGN")]},
        {"values": [("permissions.validity", "soon")]},
        {"values": [("certificates.unique_subject", "perhaps")]},
        {"rules": [NamedValues("topic", "~/private", (("data", "NONE"),))]},
        {"rules": [NamedValues("topic", "/a", (("color", "NONE"),))]},
        {"dropped": [("topic", "/nobody")]},
    ],
    ids=str,
)
def test_values_that_are_none(wrong: dict[str, list[tuple[str, str]]]) -> None:
    from sros_tool.errors import UsageError

    with pytest.raises(UsageError):
        with_values(PRODUCTION, **wrong)  # type: ignore[arg-type]


def test_what_was_rendered_is_read_again() -> None:
    from sros_tool.keystore.template import render_template

    template = with_values(PRODUCTION, rules=[CAMERA])
    assert parse_template(render_template(template), "") == template


def test_each_choice_of_a_zenoh_network_is_compared() -> None:
    here = replace(PRODUCTION, zenoh=ZenohNetwork())
    further = ZenohRouter("/r1/router", ("r1:1",), enclaves=("/r1/*",))
    there = ZenohNetwork(
        "/way", ("robot:1",), ("[::]:1",), Mode.PEER, (0,), (further,), ("/chatter",)
    )
    changes = compare_settings(here, replace(here, zenoh=there), NOW)
    assert "/r1/router at r1:1 for /r1/*" in {change.after for change in changes}
    assert [each.key for each in changes] == [f"zenoh.{each.name}" for each in fields(ZenohNetwork)]
    (change,) = compare_settings(PRODUCTION, here, NOW)
    assert (change.key, change.before, change.after) == ("zenoh", "none", "client")
