"""Answers a question by the decision engine, for one vendor: the outcome, and what decided it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime, tzinfo
from functools import lru_cache

from sros_tool.dds.decision import (
    TRAITS,
    Access,
    Decision,
    Outcome,
    Refusal,
    Vendor,
    read_governance_as,
    read_permissions_as,
)
from sros_tool.dds.decision.moments import read_moment
from sros_tool.dds.governance import DomainRule, Governance
from sros_tool.dds.permissions import Grant, Permissions
from sros_tool.explain.material import Material
from sros_tool.explain.question import OWN_PARTS, Part, Question
from sros_tool.keystore.verify import Problem

_WORST = (
    Outcome.CRASHES,
    Outcome.REFUSED,
    Outcome.DENIED,
    Outcome.PEER_DENIES,
    Outcome.ALLOWED,
)
_UNTOLD_LOCALLY = {
    (Vendor.CYCLONE, "key-mismatch"),
    (Vendor.FAST, "key-algorithm"),
    (Vendor.FAST_2_9, "key-algorithm"),
    (Vendor.FAST_2_9, "document-size"),
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
        self._problems = material.problems(TRAITS[vendor])
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
            untold = all((self._vendor, each.code) in _UNTOLD_LOCALLY for each in self._problems)
            outcome = Outcome.PEER_DENIES if untold else Outcome.REFUSED
            return Decision(outcome, first.code, f"{self._vendor.title}: {first}.")
        governance = _governance_as(self._vendor, material.governance)
        if isinstance(governance, Refusal):
            return replace(governance.decision(), reason="governance-malformed")
        self._governance = governance
        permissions = read_permissions_as(self._vendor, material.permissions)
        if isinstance(permissions, Refusal):
            return replace(permissions.decision(), reason="permissions-malformed")
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
            moment = read_moment(TRAITS[self._vendor].moments, text, self._setting.zone)
            if self._material.signed and moment is not None and 0 < moment < 2**40:
                ends.append(("permissions.p7s", datetime.fromtimestamp(moment, UTC)))
        return min(ends, key=lambda each: each[1], default=("", None))
