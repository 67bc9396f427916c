"""Evaluate questions to one vendor about one enclave."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from dataclasses import replace
from datetime import UTC, datetime

from sros_tool.dds.decision.access import Access
from sros_tool.dds.decision.answers import Decision, Outcome
from sros_tool.dds.decision.moments import read_moment
from sros_tool.dds.decision.vendors import Vendor
from sros_tool.dds.governance import DomainRule
from sros_tool.dds.permissions import parse_permissions
from sros_tool.errors import SrosError
from sros_tool.explain.answer import (
    Answer,
    PolicyLine,
    Provenance,
    deciding_lines,
    recorded_policy,
)
from sros_tool.explain.question import OWN_PARTS, Part, Question, about_action
from sros_tool.keystore.layout import LEDGER
from sros_tool.keystore.participant import JoinContext, LoadedEnclave, VendorParticipant
from sros_tool.policy.model import Enclave
from sros_tool.policy.rights import Right

_LOG = logging.getLogger(__name__)

_WORST_FIRST = (
    Outcome.CRASHES,
    Outcome.REFUSED,
    Outcome.DENIED,
    Outcome.PEER_DENIES,
    Outcome.ALLOWED,
)


class Evaluator:
    """An evaluator of questions to one vendor about one enclave; reusable for many questions."""

    def __init__(self, vendor: Vendor, enclave: LoadedEnclave, context: JoinContext) -> None:
        self.vendor = vendor
        self.enclave = enclave
        self.context = context
        self._participant = VendorParticipant(vendor, enclave, context)
        self._until_file, self._until = self._first_expiry()

    @property
    def access(self) -> Access | None:
        """The access of the vendor's process; None if it does not run, or no peer accepts it."""
        return self._participant.access

    def answer(self, question: Question) -> Answer:
        """Return the answer to a question, without policy lines, change and remedy."""
        access = self.access
        own: list[tuple[Part | None, Decision]] = [(None, self._participant.join())]
        if access is None:
            return self._made(question, own)
        if own[0][1].outcome not in (Outcome.REFUSED, Outcome.CRASHES):
            own += [(part, access.decide(part.verb, part.topic)) for part in OWN_PARTS]
        asked = [(part, access.decide(part.verb, part.topic)) for part in question.parts]
        return self._made(question, own, asked)

    def explain(self, question: Question) -> Answer:
        """Return the answer with its policy lines and, for a denial, a change or remedy."""
        answer = self.answer(question)
        _LOG.info(
            "asked %s: %s of enclave %s: %s",
            self.vendor.title,
            " ".join(filter(None, (question.word, question.name))),
            self.enclave.name,
            answer.outcome,
        )
        root, signed = self.enclave.root, self.enclave.signed
        recorded = recorded_policy(root, signed) if root and (root / LEDGER).exists() else ""
        provenance = self._provenance(recorded)
        answer = replace(
            answer, lines=self._lines(answer), provenance=provenance, policy_sha256=recorded
        )
        if answer.allowed:
            return answer
        if not answer.problems and (changed := self._changed(answer)):
            return changed
        return replace(answer, remedy=self._remedy(answer))

    def _made(
        self,
        question: Question,
        own: Sequence[tuple[Part | None, Decision]],
        asked: Sequence[tuple[Part, Decision]] = (),
    ) -> Answer:
        """Return the answer that results from the decisions on the process and its endpoints."""
        found = [*own, *asked]
        outcome = min((decision.outcome for _, decision in found), key=_WORST_FIRST.index)
        # The first topic of the question explains an allowed outcome; any other outcome is
        # explained by the first decision that has it.
        deciding = [each for each in found if each[1].outcome is outcome]
        part, decision = asked[0] if asked and outcome.ok else deciding[0]
        grant, permissions = None, self._participant.permissions
        if decision.grant is not None and permissions:
            grant = permissions.grants[decision.grant]
        return Answer(
            self.vendor,
            question,
            outcome,
            decision,
            part,
            tuple(asked),
            self._participant.problems,
            grant,
            self._domain_rule(),
            self._until,
            self._until_file,
        )

    def _domain_rule(self) -> DomainRule | None:
        governance = self._participant.governance
        rules = governance.domain_access_rules if governance else ()
        return next((r for r in rules if self.context.domain in r.domains.closed()), None)

    def _first_expiry(self) -> tuple[str, datetime | None]:
        """Return the file of the enclave that expires first, and when."""
        expiries = list(self.enclave.expiries())
        access, permissions = self.access, self._participant.permissions
        if permissions and access:
            index = access.join().grant
            text = "" if index is None else permissions.grants[index].not_after
            moment = read_moment(self.vendor.traits.moments, text, self.context.zone)
            if self.enclave.signed and moment is not None and 0 < moment < 2**40:
                expiries.append(("permissions.p7s", datetime.fromtimestamp(moment, UTC)))
        return min(expiries, key=lambda each: each[1], default=("", None))

    # ── why, and what would change it ──────────────────────────────────────────────────────

    def _provenance(self, recorded: str) -> Provenance | None:
        """Return whether the permissions were made from the policy, according to the ledger."""
        if self.enclave.policy is None:
            return None
        if not self.enclave.signed:
            return Provenance.PLANNED
        if not recorded:
            return Provenance.UNKNOWN
        if not self._states(self.enclave.policy):
            return Provenance.CHANGED
        return Provenance.SAME if recorded == self.enclave.policy.digest else Provenance.EQUAL

    def _states(self, policy: Enclave) -> bool:
        """Return whether the grant that DDS reads has the rules of a policy on its domains."""
        from sros_tool.translate import permissions_for

        with suppress(SrosError):
            found = parse_permissions(self.enclave.permissions).grant_of(self.enclave.subject)
            if found and found.rules and not found.default_allow:
                meant = permissions_for(
                    policy,
                    subject=found.subject,
                    validity=found.validity,
                    domains=found.rules[0].domains,
                )
                return meant.grants[0].rules == found.rules
        return False

    def _lines(self, answer: Answer) -> tuple[PolicyLine, ...]:
        return deciding_lines(self.enclave.policy, answer) if self.enclave.policy else ()

    def _changed(self, answer: Answer) -> Answer | None:
        """Return the answer with the change of the policy that would allow it, or None."""
        from sros_tool.explain.change import smallest_change

        change = smallest_change(self, answer)
        if change is None:
            return None
        if change.add or change.lift:
            return replace(answer, change=change)
        # The present policy allows it.
        return replace(answer, sign=True) if answer.provenance is Provenance.CHANGED else None

    def _remedy(self, answer: Answer) -> str:
        from sros_tool.explain.remedy import remedy

        reason, root = answer.decision.reason, str(self.enclave.root or "")
        faulty = (each.file for each in answer.problems if each.fault.id == reason)
        return remedy(reason, root, self.enclave.name, next(faulty, ""))


def action_meant(
    evaluator: Evaluator, question: Question, others: Iterable[Callable[[], Iterable[Right]]]
) -> Question | None:
    """Return the question about an action, if that is what the rights show the name to be.

    The rights of the enclave come first; ``others``, such as those of its policy and of its
    keystore, are read only if the service is denied.
    """
    if question.word not in ("call", "serve"):
        return None
    from sros_tool.translate import grant_rights  # most questions need no translation back

    answer = evaluator.answer(question)
    found = set(grant_rights(evaluator.enclave.name, answer.grant)) if answer.grant else set()
    if not answer.allowed:
        for read in others:
            with suppress(SrosError, OSError):
                found |= set(read())
    return about_action(question, found)
