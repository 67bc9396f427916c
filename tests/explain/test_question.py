"""Questions in ROS terms become the DDS endpoints that a node opens, and nothing else is asked."""

from __future__ import annotations

import re
from itertools import product
from pathlib import Path

import pytest

import sros_tool.dds.decision as decision
from sros_tool.dds.decision.access import AccessVerb
from sros_tool.errors import UsageError
from sros_tool.explain.answer import TYPES, WORDS, ask
from sros_tool.explain.explanation import _FAULT_OF_REASON, remedy
from sros_tool.faults import FAULTS, Fault
from sros_tool.names import dds_names

KNOWN_CAUSES = frozenset((*FAULTS, *_FAULT_OF_REASON))
"""The ids of faults, and the reasons of decisions, that have a remedy."""
MEANT = {
    ("publish", "topic"): "publish",
    ("subscribe", "topic"): "subscribe",
    ("call", "service"): "request",
    ("request", "service"): "request",
    ("serve", "service"): "reply",
    ("reply", "service"): "reply",
    ("call", "action"): "call",
    ("execute", "action"): "execute",
}


@pytest.mark.parametrize(("word", "kind"), [*product(WORDS, TYPES)])
def test_every_combination(word: str, kind: str) -> None:
    if (word, kind) not in MEANT:
        with pytest.raises(UsageError):
            ask(word, "/x", kind)
        return
    question = ask(word, "/x", kind)
    assert question.right == MEANT[word, kind]
    names = dds_names(question.right, "/x")
    written = [p.topic for p in question.parts if p.verb is AccessVerb.PUBLISH]
    assert sorted(written) == sorted(names.publish)
    assert (
        tuple(p.topic for p in question.parts if p.verb is AccessVerb.SUBSCRIBE) == names.subscribe
    )
    assert all(bool(part.role) == (kind != "topic") for part in question.parts)


@pytest.mark.parametrize(
    ("word", "kind"),
    [("publish", "topic"), ("call", "service"), ("serve", "service"), ("execute", "action")],
)
def test_the_type_that_is_meant_without_saying(word: str, kind: str) -> None:
    assert ask(word, "/x") == ask(word, "/x", kind)


def test_joining_needs_no_endpoint() -> None:
    assert ask("join").parts == ()
    assert str(ask("join")) == "join the domain"
    assert str(ask("call", "/add")) == "call service /add"


def test_parts_of_an_action_have_names() -> None:
    for word, role in (("call", "send_goal requests"), ("execute", "send_goal replies")):
        assert ask(word, "/go", "action").parts[0].role == role, "what a reader expects first"
    roles = {part.role for part in ask("execute", "/go").parts}
    assert {"send_goal requests", "send_goal replies", "feedback", "status"} <= roles


def sources(module: object) -> str:
    folder = Path(str(getattr(module, "__file__", "")))
    files = folder.parent.glob("*.py") if folder.name == "__init__.py" else [folder]
    return "\n".join(file.read_text() for file in files)


def test_every_fault_of_an_enclave_has_a_remedy() -> None:
    assert {"key-mismatch", "crl-expired", "revoked", "file-missing"} <= set(FAULTS)
    assert set(FAULTS) <= KNOWN_CAUSES
    assert all(remedy(fault, "ks", "/a") for fault in Fault)


def test_every_reason_of_a_decision_is_of_the_policy_or_has_a_remedy() -> None:
    of_the_policy = {"unrestricted", "allow-rule", "deny-rule", "no-rule", "default"}
    found = re.findall(
        r'(?:Refusal|_refused|_answer|Decision)\(\s*(?:Outcome\.\w+,\s*)?"([a-z-]+)"',
        sources(decision),
    )
    assert {"no-grant", "expired", "domain-not-in-governance"} <= set(found)
    assert set(found) - of_the_policy <= KNOWN_CAUSES


def test_remedies_name_the_keystore_and_the_enclave() -> None:
    assert remedy("expired", "ks", "/a") == "Renew the enclave: `sros renew ks /a`."
    assert remedy("no-rule", "ks", "/a") == ""
    for word in KNOWN_CAUSES:
        assert "{" not in remedy(word, "ks", "/a")


@pytest.mark.parametrize(
    ("name", "remedy"), [("cmd_vel", "Write /cmd_vel,"), ("~/state", "Write /NODE/state,")]
)
def test_a_relative_name_is_refused_with_the_full_one(name: str, remedy: str) -> None:
    with pytest.raises(UsageError) as refused:
        ask("publish", name)
    assert refused.value.remedy.startswith(remedy)
