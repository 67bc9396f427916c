"""Explains an answer: from which line of the policy it comes, and what would change it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from sros_tool.dds.decision import Outcome, Vendor, Verb
from sros_tool.dds.governance import parse_governance
from sros_tool.errors import SrosError
from sros_tool.explain.answer import Answer, Judge, Setting
from sros_tool.explain.change import Change, smallest_change
from sros_tool.explain.material import Material
from sros_tool.explain.origin import Origin, Provenance, origins, provenance, recorded_policy
from sros_tool.explain.question import Question
from sros_tool.explain.remedy import remedy
from sros_tool.keystore.ledger import LEDGER
from sros_tool.names import is_expression
from sros_tool.policy.model import ALLOW, DENY, Enclave
from sros_tool.policy.rights import Right, profile_rights
from sros_tool.translate import grant_rights


@dataclass(frozen=True, slots=True)
class Case:
    """Of what, where and by which policy a question is asked.

    ``root`` is the keystore, ``policy`` the enclave's part of a policy file, where given.
    """

    material: Material
    setting: Setting
    root: Path | None = None
    policy: Enclave | None = None


@dataclass(frozen=True, slots=True)
class Explanation:
    """An answer with its reasons.

    ``wildcard`` is the expression of a rule that allows or denies by a wildcard, or "".
    ``change`` is what a policy would have to say, ``remedy`` what to do where that is no matter
    of the policy.  ``sign`` says that the policy file, as it is now, would allow it once signed.
    ``recorded`` is the SHA-256 of the policy that the permissions were made from, where known.
    """

    answer: Answer
    wildcard: str
    provenance: Provenance | None
    origins: tuple[Origin, ...]
    who_denies: str
    change: Change | None = None
    remedy: str = ""
    sign: bool = False
    recorded: str = ""


def explain(case: Case, question: Question, vendor: Vendor) -> Explanation:
    """What one vendor answers, and why."""
    answer = Judge(vendor, case.material, case.setting).answer(question)
    decision = answer.deciding.decision
    known = _provenance(case)
    change, sign = None, False
    if not answer.allowed and not answer.problems:
        change, sign = _change(case, answer, known)
    return Explanation(
        answer,
        decision.expression if is_expression(decision.expression or "") else "",  # type: ignore[arg-type]
        known,
        _origins(case, answer),
        _who_denies(answer),
        change,
        "" if answer.allowed or change or sign else _remedy(case, answer, decision.reason),
        sign,
        recorded_policy(case.root, case.material.signed)
        if case.root and (case.root / LEDGER).exists()
        else "",
    )


def _provenance(case: Case) -> Provenance | None:
    if case.policy is None:
        return None
    if not case.material.signed:
        return Provenance.PLANNED
    if case.root is None:
        return Provenance.UNKNOWN
    return provenance(case.root, case.material.signed, case.policy)


def _origins(case: Case, answer: Answer) -> tuple[Origin, ...]:
    decision, part = answer.deciding.decision, answer.deciding.part
    if case.policy is None or part is None or not decision.expression or answer.grant is None:
        return ()
    rule = answer.grant.rules[decision.rule or 0]
    verb, qualifier = part.verb, ALLOW if rule.allow else DENY
    found = origins(case.policy, verb, decision.expression, qualifier)
    # Cyclone DDS denies a topic as a whole, also by a rule of the other direction.
    other = Verb.SUBSCRIBE if verb is Verb.PUBLISH else Verb.PUBLISH
    return found or origins(case.policy, other, decision.expression, qualifier)


def _change(case: Case, answer: Answer, known: Provenance | None) -> tuple[Change | None, bool]:
    """What would have to change, and whether signing the policy as it is would do."""
    try:
        governance = parse_governance(case.material.governance)
    except SrosError:
        return None, False
    name = case.material.enclave
    rights: frozenset[Right] = frozenset()
    if case.policy:
        profiles = case.policy.all_profiles()
        rights = frozenset(r for each in profiles for r in profile_rights(name, each))
    elif answer.grant:
        rights = grant_rights(name, answer.grant)
    change = smallest_change(
        name, rights, answer.question, governance, answer.vendor, case.setting, case.policy
    )
    if change and not (change.add or change.lift):
        return None, known is Provenance.CHANGED
    return change, False


def _remedy(case: Case, answer: Answer, reason: str) -> str:
    root = str(case.root) if case.root else ""
    faulty = (each.file for each in answer.problems if each.code == reason)
    return remedy(reason, root, case.material.enclave, next(faulty, ""))


def _who_denies(answer: Answer) -> str:
    question = answer.question
    match answer.outcome:
        case Outcome.ALLOWED:
            return ""
        case Outcome.PEER_DENIES:
            return "the peers: the node starts, and none of them talks to it"
        case Outcome.REFUSED:
            return "DDS in the process itself: no node of the enclave starts"
        case Outcome.CRASHES:
            return "nobody: the process crashes when it starts"
        case Outcome.DENIED if answer.deciding.part not in question.parts:
            return "DDS in the process itself: no node of the enclave starts"
        case _:
            return f"DDS in the process itself: {_MADE.get(question.word, 'it')} is not created"


_MADE = {
    "publish": "the publisher",
    "subscribe": "the subscription",
    "call": "the client",
    "request": "the client",
    "serve": "the server",
    "reply": "the server",
    "execute": "the action server",
}
