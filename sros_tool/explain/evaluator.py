"""Evaluate questions to one vendor about one enclave."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import UTC, datetime

from sros_tool.dds.decision.access import Access
from sros_tool.dds.decision.answers import Decision, Outcome
from sros_tool.dds.decision.moments import read_moment
from sros_tool.dds.decision.vendors import Vendor
from sros_tool.dds.governance import DomainRule
from sros_tool.explain.answer import Answer, DecidedPart
from sros_tool.explain.question import OWN_PARTS, Part, Question
from sros_tool.keystore.participant import JoinContext, LoadedEnclave, VendorParticipant

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
        asked = tuple(
            DecidedPart(part, access.decide(part.verb, part.topic)) for part in question.parts
        )
        return self._made(question, own, asked)

    def _made(
        self,
        question: Question,
        own: Sequence[tuple[Part | None, Decision]],
        asked: tuple[DecidedPart, ...] = (),
    ) -> Answer:
        """Return the answer that results from the decisions on the process and its endpoints."""
        decided = [*own, *asked]
        outcome = min((decision.outcome for _, decision in decided), key=_WORST_FIRST.index)
        # The first topic of the question explains an allowed outcome; any other outcome is
        # explained by the first decision that has it.
        deciding = next(pair for pair in decided if pair[1].outcome is outcome)
        part, decision = asked[0] if asked and outcome.ok else deciding
        grant, permissions = None, self._participant.permissions
        if decision.grant is not None and permissions:
            grant = permissions.grants[decision.grant]
        return Answer(
            vendor=self.vendor,
            enclave=self.enclave,
            question=question,
            outcome=outcome,
            decision=decision,
            part=part,
            parts=asked,
            problems=self._participant.problems,
            grant=grant,
            domain_rule=self._domain_rule(),
            until=self._until,
            until_file=self._until_file,
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
