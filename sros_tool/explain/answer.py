"""Answers a question by the decision engine, for one vendor: the outcome, and what decided it.

A right is added only if none covers the question, and a denial is lifted only if it stands in the
way; the result is tried out on the decision engine before it is proposed.
"""

from __future__ import annotations

import hashlib
import logging
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime, tzinfo
from enum import StrEnum
from functools import lru_cache
from pathlib import Path

from lxml import etree

from sros_tool.dds.decision.access import Access
from sros_tool.dds.decision.answers import Decision, Outcome, Refusal, Verb
from sros_tool.dds.decision.documents import read_governance_as, read_permissions_as
from sros_tool.dds.decision.matching import read_moment
from sros_tool.dds.decision.vendors import Vendor
from sros_tool.dds.governance import DomainRule, Governance, parse_governance
from sros_tool.dds.permissions import Grant, Permissions
from sros_tool.errors import SrosError
from sros_tool.explain.material import Material, from_policy
from sros_tool.explain.question import OWN_PARTS, Part, Question
from sros_tool.explain.remedy import remedy
from sros_tool.faults import Fault
from sros_tool.keystore.layout import LEDGER
from sros_tool.keystore.ledger import read_ledger
from sros_tool.keystore.reader import Problem
from sros_tool.names import dds_names, expand, is_expression
from sros_tool.policy.document import write_policy
from sros_tool.policy.model import (
    ALLOW,
    DENY,
    Enclave,
    Group,
    Policy,
    Profile,
    Profiles,
    Qualifier,
    Source,
)
from sros_tool.policy.rights import Right, profile_rights
from sros_tool.translate import grant_rights

_LOG = logging.getLogger(__name__)

_WORST = (
    Outcome.CRASHES,
    Outcome.REFUSED,
    Outcome.DENIED,
    Outcome.PEER_DENIES,
    Outcome.ALLOWED,
)
_UNTOLD_LOCALLY = {
    (Vendor.CYCLONE, Fault.KEY_MISMATCH),
    (Vendor.FAST, Fault.KEY_ALGORITHM),
    (Vendor.FAST_2_9, Fault.KEY_ALGORITHM),
    (Vendor.FAST_2_9, Fault.DOCUMENT_SIZE),
}
"""What a vendor does not notice itself, but every peer does."""

# All enclaves of a keystore have the same governance.
_governance_as = lru_cache(maxsize=16)(read_governance_as)


@dataclass(frozen=True, slots=True)
class Setting:
    """Where and when a question is asked; ``zone`` is the time zone of the host."""

    domain: int
    at: datetime
    zone: tzinfo = UTC


@dataclass(frozen=True, slots=True)
class PartAnswer:
    """The decision on one endpoint; ``part`` is None where it is about joining."""

    part: Part | None
    decision: Decision


@dataclass(frozen=True, slots=True)
class Answer:
    """What one vendor makes of a question.

    ``parts`` are all endpoints with their decisions, ``deciding`` is the one that the outcome
    comes from.  ``grant`` and ``domain_rule`` are the parts of the documents that hold.  ``until``
    is when the first of the files expires, ``until_file``; None where nothing is signed.
    """

    vendor: Vendor
    question: Question
    outcome: Outcome
    deciding: PartAnswer
    parts: tuple[PartAnswer, ...] = ()
    problems: tuple[Problem, ...] = ()
    grant: Grant | None = None
    domain_rule: DomainRule | None = None
    until: datetime | None = None
    until_file: str = ""

    @property
    def allowed(self) -> bool:
        """Whether data can flow."""
        return self.outcome.ok

    @property
    def as_documented(self) -> bool:
        """Whether it rests on what the vendor documents: faults of files are seen here."""
        return self.vendor.documented_only and not self.problems

    @property
    def failing(self) -> tuple[PartAnswer, ...]:
        """The endpoints that are not allowed, of those the question is about."""
        return tuple(each for each in self.parts if each.part and not each.decision.outcome.ok)


class Judge:
    """One vendor's answers about one enclave; prepared once, asked often."""

    def __init__(self, vendor: Vendor, material: Material, setting: Setting) -> None:
        self._vendor = vendor
        self._material = material
        self._setting = setting
        self._governance: Governance | None = None
        self._permissions: Permissions | None = None
        self._problems = material.problems(vendor.traits)
        self._before = self._prepare()
        self._until = self._end()

    def answer(self, question: Question) -> Answer:
        """The answer to a question."""
        if isinstance(self._before, Decision):
            return self._made(question, [PartAnswer(None, self._before)])
        access = self._before
        own = [PartAnswer(None, access.join())]
        if own[0].decision.outcome not in (Outcome.REFUSED, Outcome.CRASHES):
            own += [PartAnswer(part, access.decide(part.verb, part.topic)) for part in OWN_PARTS]
        asked = [PartAnswer(part, access.decide(part.verb, part.topic)) for part in question.parts]
        return self._made(question, own, asked)

    def _prepare(self) -> Access | Decision:
        material, setting = self._material, self._setting
        if self._problems:
            first = self._problems[0]
            untold = all((self._vendor, each.fault) in _UNTOLD_LOCALLY for each in self._problems)
            outcome = Outcome.PEER_DENIES if untold else Outcome.REFUSED
            return Decision(outcome, first.fault.id, f"{self._vendor.title}: {first}.")
        governance = _governance_as(self._vendor, material.governance)
        if isinstance(governance, Refusal):
            return replace(governance.decision(), reason=Fault.GOVERNANCE_MALFORMED.id)
        self._governance = governance
        permissions = read_permissions_as(self._vendor, material.permissions)
        if isinstance(permissions, Refusal):
            return replace(permissions.decision(), reason=Fault.PERMISSIONS_MALFORMED.id)
        self._permissions = permissions
        return Access(
            self._vendor,
            governance,
            permissions,
            material.subject,
            domain=setting.domain,
            at=setting.at,
            zone=setting.zone,
        )

    def _made(
        self, question: Question, own: list[PartAnswer], asked: Sequence[PartAnswer] = ()
    ) -> Answer:
        found = [*own, *asked]
        outcome = min((each.decision.outcome for each in found), key=_WORST.index)
        of_it = [each for each in found if each.decision.outcome is outcome]
        # An allowed question is answered by its own topics, any other by what comes first.
        deciding = next((each for each in asked if outcome.ok), of_it[0])
        grant = None
        if deciding.decision.grant is not None and self._permissions:
            grant = self._permissions.grants[deciding.decision.grant]
        file, until = self._until
        return Answer(
            self._vendor,
            question,
            outcome,
            deciding,
            tuple(asked),
            self._problems,
            grant,
            self._domain_rule(),
            until,
            file,
        )

    def _domain_rule(self) -> DomainRule | None:
        if self._governance is None:
            return None
        rules = self._governance.domain_access_rules
        return next((r for r in rules if self._setting.domain in r.domains.closed()), None)

    def _end(self) -> tuple[str, datetime | None]:
        ends = list(self._material.ends)
        if self._permissions and isinstance(self._before, Access):
            index = self._before.join().grant
            text = "" if index is None else self._permissions.grants[index].not_after
            moment = read_moment(self._vendor.traits.moments, text, self._setting.zone)
            if self._material.signed and moment is not None and 0 < moment < 2**40:
                ends.append(("permissions.p7s", datetime.fromtimestamp(moment, UTC)))
        return min(ends, key=lambda each: each[1], default=("", None))


@dataclass(frozen=True, slots=True)
class Origin:
    """A name in a policy that stands for a rule: where it is written, how, and what it says.

    ``group`` and ``profile`` are those that it stands in; ``right`` is the policy's word.
    """

    source: Source
    qualifier: Qualifier
    right: str
    name: str
    group: Group
    profile: Profile

    def __str__(self) -> str:
        """As ``robot.xml:12: ALLOW publish chatter``."""
        return f"{self.source}: {self.qualifier.value} {self.right} {self.name}"


class Provenance(StrEnum):
    """How signed permissions and a policy file hang together."""

    SAME = "same"
    """They were made from the file as it is now."""
    CHANGED = "changed"
    """They were made from another file, or the file has changed since."""
    UNKNOWN = "unknown"
    """The ledger does not know what they were made from."""
    PLANNED = "planned"
    """The policy was asked itself; nothing is signed."""


def provenance(root: Path, signed: bytes, policy: Enclave) -> Provenance:
    """Whether ``policy`` is what the ledger of a keystore says that ``signed`` was made from."""
    digest = recorded_policy(root, signed)
    if not digest:
        return Provenance.UNKNOWN
    return Provenance.SAME if digest == policy.digest else Provenance.CHANGED


def recorded_policy(root: Path, signed: bytes) -> str:
    """The SHA-256 of the policy that signed permissions were made from, or ""."""
    digest = hashlib.sha256(signed).hexdigest()
    found = (e.policy for e in reversed(read_ledger(root)) if e.sha256 == digest)
    return next(found, "")


def origins(
    enclave: Enclave, verb: Verb, expression: str, qualifier: Qualifier
) -> tuple[Origin, ...]:
    """The names of an enclave's policy that stand for a DDS ``expression`` of signed permissions.

    Several nodes of an enclave may have the same right, so there may be several.
    """
    return tuple(
        each
        for each in _names(enclave)
        if each.qualifier is qualifier and expression in _topics(each, verb)
    )


def origins_of(enclave: Enclave, right: Right) -> tuple[Origin, ...]:
    """The names of an enclave's policy that state a right or denial."""
    return tuple(
        each
        for each in _names(enclave)
        if (each.qualifier, each.right) == (right.qualifier, right.right)
        and expand(each.name, each.profile.ns, each.profile.node) == right.name
    )


def _names(enclave: Enclave) -> Iterator[Origin]:
    for profile in enclave.all_profiles():
        for group in profile.groups:
            for index, name in enumerate(group.names):
                source = group.source_of(index)
                for right, qualifier in group.rights:
                    yield Origin(source, qualifier, right, name, group, profile)


def _topics(origin: Origin, verb: Verb) -> tuple[str, ...]:
    fqn = expand(origin.name, origin.profile.ns, origin.profile.node)
    names = dds_names(origin.right, fqn)
    return names.publish if verb is Verb.PUBLISH else names.subscribe


_NO_RULE = frozenset({"no-rule", "default"})


@dataclass(frozen=True, slots=True)
class Edit:
    """A group of a policy file that is to be replaced; ``xml`` may be "", where nothing is left."""

    source: Source
    xml: str


@dataclass(frozen=True, slots=True)
class Change:
    """Rights to add and denials to lift.

    ``document`` is a policy of the additions alone, for ``sros merge_policy``; ``edits`` are how
    the groups that deny have to read, where the policy file is known.
    """

    add: tuple[Right, ...]
    lift: tuple[Right, ...]
    document: str
    edits: tuple[Edit, ...]


def smallest_change(
    enclave: str,
    rights: Iterable[Right],
    question: Question,
    governance: Governance,
    vendor: Vendor,
    setting: Setting,
    policy: Enclave | None = None,
) -> Change | None:
    """The change that makes ``vendor`` allow the question, or None if no policy could.

    ``rights`` are what the enclave has now, ``policy`` is where they come from, if that is known.
    """
    if not question.right:
        return None
    wanted = question.allowed(enclave)
    present = {right for right in rights if right.kind != "dds"}
    add: list[Right] = []
    lift: list[Right] = []
    while True:
        material = from_policy(as_policy(enclave, present), governance, at=setting.at)
        answer = Judge(vendor, material, setting).answer(question)
        decision = answer.deciding.decision
        if answer.allowed:
            break
        if decision.reason == "deny-rule":
            blocking = _blocking(present, answer.deciding, decision.expression or "")
        elif decision.reason in _NO_RULE and wanted not in present:
            present.add(wanted)
            add.append(wanted)
            continue
        else:
            return None
        if not blocking:
            return None
        present.difference_update(blocking)
        lift += sorted(blocking)
    return Change(
        tuple(add),
        tuple(lift),
        _document(add, policy),
        tuple(_edits(lift, policy)) if policy else (),
    )


def as_policy(enclave: str, rights: Iterable[Right]) -> Enclave:
    """An enclave with one nameless node that has these rights."""
    groups = tuple(
        Group(right.kind, ((right.right, right.qualifier),), (right.name,))
        for right in sorted(rights)
    )
    return Enclave(enclave, (Profiles((Profile("/", "", groups),)),))


def _blocking(rights: Iterable[Right], deciding: PartAnswer, expression: str) -> list[Right]:
    """The denials from which an expression comes; of the other direction only if it must be.

    Cyclone DDS denies a topic as a whole by a denial of either direction.
    """
    publishes = deciding.part is not None and deciding.part.verb is Verb.PUBLISH
    own: list[Right] = []
    other: list[Right] = []
    for right in rights:
        if right.qualifier is DENY:
            names = dds_names(right.right, right.name)
            if expression in (names.publish if publishes else names.subscribe):
                own.append(right)
            elif expression in names.publish + names.subscribe:
                other.append(right)
    return own or other


def _document(add: list[Right], policy: Enclave | None) -> str:
    if not add:
        return ""
    (right,) = add
    ns, node = _place(right, policy)
    group = Group(right.kind, ((right.right, right.qualifier),), (right.name,))
    enclave = Enclave(right.enclave, (Profiles((Profile(ns, node, (group,)),)),))
    return write_policy(Policy((enclave,))).decode().rstrip()


def _place(right: Right, policy: Enclave | None) -> tuple[str, str]:
    """The node that gets a right: the innermost one whose namespace the name lies in."""
    profiles = policy.all_profiles() if policy else ()
    fitting = [
        each for each in profiles if right.name.startswith(each.ns.rstrip("/") + "/")
    ] or list(profiles)
    if not fitting:
        return "/", right.enclave.rpartition("/")[2] or "node"
    best = max(fitting, key=lambda each: len(each.ns))
    return best.ns, best.node


def _edits(lift: list[Right], policy: Enclave) -> Iterable[Edit]:
    """What each group that denies has to read without these denials."""
    groups: dict[Source, Group] = {}
    found: dict[Source, set[tuple[str, str]]] = {}
    for right in lift:
        for origin in origins_of(policy, right):
            groups[origin.group.source] = origin.group
            found.setdefault(origin.group.source, set()).add((origin.name, origin.right))
    for source, lifted in found.items():
        group = groups[source]
        kept: dict[tuple[tuple[str, str], ...], list[str]] = {}
        for name in group.names:
            rights = tuple(each for each in group.rights if (name, each[0]) not in lifted)
            if rights:
                kept.setdefault(rights, []).append(name)
        yield Edit(source, "\n".join(_xml(group.kind, *each) for each in kept.items()))


def _xml(kind: str, rights: tuple[tuple[str, str], ...], names: list[str]) -> str:
    element = etree.Element(kind, dict(rights))
    for name in names:
        etree.SubElement(element, kind.removesuffix("s")).text = name
    etree.indent(element, space="  ")
    return etree.tostring(element, encoding="unicode")


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
    _LOG.info(
        "asked %s: %s of enclave %s: %s",
        vendor.title,
        " ".join(filter(None, (question.word, question.name))),
        case.material.enclave,
        answer.outcome,
    )
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
    faulty = (each.file for each in answer.problems if each.fault.id == reason)
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
