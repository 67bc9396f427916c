"""Every rule of every example policy, explained: allowed as it says, and a twin of it denied.

On Fast DDS and on Cyclone DDS, with the line of the policy where it stands, and for the denied
twin with a change of the policy after which it is allowed, and nothing else is.
"""

from __future__ import annotations

from collections.abc import Iterator
from datetime import UTC, datetime
from functools import cache
from pathlib import Path

import pytest

from sros_tool.dds.decision.access import Outcome
from sros_tool.dds.decision.vendors import Vendor
from sros_tool.dds.domains import DomainSet
from sros_tool.explain.answer import Evaluator, Question, ask
from sros_tool.explain.explanation import explain, policy_of
from sros_tool.files import policies_dir
from sros_tool.keystore.participant import JoinContext, LoadedEnclave, plan_enclave
from sros_tool.keystore.template import load_template
from sros_tool.names import is_expression
from sros_tool.policy.document import read_policy
from sros_tool.policy.model import ALLOW, DENY, Enclave, Policy
from sros_tool.policy.patterns import common_name, matches
from sros_tool.policy.rights import Right, Rules, policy_rights
from sros_tool.translate import governance_for
from tests.support.long_form import some

FILES = sorted(policies_dir().glob("*.xml")) + sorted(policies_dir().glob("defaults/*.xml"))
VENDORS = [Vendor.FAST, Vendor.CYCLONE, Vendor.FAST_2_9]
NOW = datetime(2026, 11, 21, 12, tzinfo=UTC)
CONTEXT = JoinContext(0, NOW)
GOVERNANCE = governance_for(load_template("production").protection, DomainSet.parse("0"))
WORDS = {
    "publish": ("publish", "topic"),
    "subscribe": ("subscribe", "topic"),
    "request": ("call", "service"),
    "reply": ("serve", "service"),
    "call": ("call", "action"),
    "execute": ("execute", "action"),
}
OPPOSITE = {"publish": "subscribe", "request": "reply", "call": "execute"}
OPPOSITE |= {other: right for right, other in OPPOSITE.items()}


@cache
def policy(file: Path) -> Policy:
    return read_policy(file)


def enclaves() -> Iterator[tuple[Path, Enclave]]:
    for file in FILES:
        for enclave in policy(file).enclaves:
            yield file, enclave


def planned(enclave: Enclave) -> LoadedEnclave:
    return plan_enclave(enclave, GOVERNANCE, moment=NOW)._replace(policy=enclave)


def question(right: str, name: str) -> Question:
    word, kind = WORDS[right]
    return ask(word, name, kind)


def test_there_are_policies_of_every_kind() -> None:
    rights = [right for file in FILES for right in policy_rights(policy(file))]
    assert {right.right for right in rights} == set(WORDS)
    assert any(is_expression(right.name) for right in rights)
    assert len(rights) > 300


@pytest.mark.parametrize("vendor", VENDORS)
@pytest.mark.parametrize(
    ("file", "enclave"), some([*enclaves()], 12), ids=lambda value: getattr(value, "path", None)
)
def test_every_rule(file: Path, enclave: Enclave, vendor: Vendor) -> None:
    rights = sorted(each for each in policy_rights(policy(file)) if each.enclave == enclave.path)
    rules = Rules(rights)
    evaluator = Evaluator(vendor, planned(enclave), CONTEXT)
    denials = [each.name for each in rights if each.qualifier is DENY]
    for right in rights:
        if right.qualifier is DENY:
            continue
        name = common_name([right.name], denials)
        assert name is not None
        found = explain(evaluator, question(right.right, name))
        assert found.outcome is Outcome.ALLOWED, (right, found.decision)
        assert bool(found.wildcard) == is_expression(found.decision.expression or "")
        assert found.change is None
        if not is_expression(found.decision.expression or ""):
            lines = Path(found.lines[0].source.file).read_text().splitlines()
            stands = lines[found.lines[0].source.line - 1]
            assert f">{found.lines[0].name}</" in stands, (right, stands)
        # The other direction is what the policy says it is, by its own meaning.
        other = OPPOSITE[right.right]
        answer = evaluator.answer(question(other, name))
        assert answer.allowed == rules.allow(enclave.path, other, name), (other, name)


@pytest.mark.parametrize(
    ("file", "enclave", "vendor"),
    some([(*each, vendor) for each in enclaves() for vendor in VENDORS[:2]], 6),
    ids=lambda value: getattr(value, "path", None),
)
def test_every_denied_twin(file: Path, enclave: Enclave, vendor: Vendor) -> None:
    rights = {each for each in policy_rights(policy(file)) if each.enclave == enclave.path}
    rules = Rules(rights)
    evaluator = Evaluator(vendor, planned(enclave), CONTEXT)
    for right in sorted(rights):
        expressions = [each.name for each in rights if is_expression(each.name)]
        name = f"{right.name.replace('*', 'any')}_twin"
        if right.qualifier is DENY:
            continue
        if any(matches(each, name) for each in expressions):
            continue  # a wildcard for everything has no twin that is denied
        asked = question(right.right, name)
        found = explain(evaluator, asked)
        assert found.outcome is Outcome.DENIED, (right, found.decision)
        assert not rules.allow(enclave.path, right.right, name)
        assert found.change is not None and found.change.lift == ()
        assert found.change.add == (Right(enclave.path, ALLOW, right.right, name),)
        changed = plan_enclave(
            policy_of(enclave.path, rights.union(found.change.add)), GOVERNANCE, moment=NOW
        )
        assert Evaluator(vendor, changed, CONTEXT).answer(asked).allowed
        still = question(OPPOSITE[right.right], name)
        assert not Evaluator(vendor, changed, CONTEXT).answer(still).allowed


def denials() -> Iterator[tuple[Enclave, Right]]:
    for file, enclave in enclaves():
        for right in sorted(policy_rights(policy(file))):
            if right.enclave == enclave.path and right.qualifier is DENY:
                yield enclave, right


@pytest.mark.parametrize("vendor", VENDORS[:2])
@pytest.mark.parametrize(("enclave", "right"), list(denials()), ids=str)
def test_every_denial(enclave: Enclave, right: Right, vendor: Vendor) -> None:
    name = common_name([right.name])
    assert name
    evaluator = Evaluator(vendor, planned(enclave), CONTEXT)
    found = explain(evaluator, question(right.right, name))
    assert (found.outcome, found.decision.reason) == ("denied", "deny-rule")
    assert [(each.qualifier, each.right) for each in found.lines] == [(DENY, right.right)]
    assert found.change is not None
    assert (found.change.lift, found.change.add) == ((right,), ())
    assert [edit.source for edit in found.change.edits] == [found.lines[0].group.source]
    rights = {
        r for each in FILES for r in policy_rights(policy(each)) if r.enclave == right.enclave
    }
    lifted = plan_enclave(policy_of(enclave.path, rights - {right}), GOVERNANCE, moment=NOW)
    assert Evaluator(vendor, lifted, CONTEXT).answer(question(right.right, name)).allowed


def test_there_is_a_denial() -> None:
    assert list(denials())
