"""Load an enclave as DDS does, and evaluate what one vendor decides with it."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from datetime import UTC, datetime, timedelta, tzinfo
from functools import lru_cache
from pathlib import Path

from sros_tool.dds.decision.access import Access
from sros_tool.dds.decision.answers import Decision, Outcome, Refusal
from sros_tool.dds.decision.documents import read_governance_as, read_permissions_as
from sros_tool.dds.decision.moments import read_moment
from sros_tool.dds.decision.vendors import Vendor, VendorTraits
from sros_tool.dds.domains import DomainSet
from sros_tool.dds.governance import (
    DomainRule,
    Governance,
    parse_governance,
    render_governance,
)
from sros_tool.dds.permissions import Permissions, parse_permissions, render_permissions
from sros_tool.errors import SrosError
from sros_tool.explain.answer import (
    Answer,
    PolicyLine,
    Provenance,
    deciding_lines,
    recorded_policy,
)
from sros_tool.explain.question import OWN_PARTS, Part, Question, about_action
from sros_tool.faults import Fault
from sros_tool.keystore.layout import KEY_FILE, LEDGER
from sros_tool.keystore.loading import vendor_problems
from sros_tool.keystore.reader import OpenedEnclave, Problem, open_enclave
from sros_tool.pki import smime
from sros_tool.pki.certificates import subject_text, validity_of
from sros_tool.policy.model import Enclave
from sros_tool.policy.rights import Right
from sros_tool.xml import read_bytes

_LOG = logging.getLogger(__name__)

# ── what DDS loads ─────────────────────────────────────────────────────────────────────────

_LEFT_TO_THE_VENDOR = frozenset(
    {
        Fault.GOVERNANCE_DOMAIN,
        Fault.GOVERNANCE_MALFORMED,
        Fault.PERMISSIONS_DOMAIN,
        Fault.PERMISSIONS_EXPIRED,
        Fault.PERMISSIONS_MALFORMED,
        Fault.PERMISSIONS_NOT_YET_VALID,
        Fault.PERMISSIONS_SUBJECT,
    }
)
"""Faults of documents that each vendor judges by its own rules."""
_NO_KEY = (Fault.FILE_MISSING, KEY_FILE)

_PLANNED = timedelta(days=365)
"""The assumed validity of permissions for a policy that is not signed yet."""


@dataclass(frozen=True, slots=True)
class LoadedEnclave:
    """An enclave as DDS loads it.

    ``governance`` and ``permissions`` are the XML in the signed documents; ``signed`` is the
    signed permissions, b"" if they are not signed yet.  ``expiries`` are files with their expiry
    times.  ``state`` is the state of the files at the time ``at``; None if they do not exist yet.
    ``key_elsewhere`` says that the key is on the robot that generated it.

    ``root`` is its keystore and ``policy`` its part of the policy file, if known.
    """

    name: str
    subject: str
    governance: bytes
    permissions: bytes
    domains: DomainSet | None
    signed: bytes = b""
    expiries: tuple[tuple[str, datetime], ...] = ()
    state: OpenedEnclave | None = None
    at: datetime | None = None
    key_elsewhere: bool = False
    root: Path | None = None
    policy: Enclave | None = None

    @property
    def joined_domains(self) -> DomainSet | None:
        """The domains of its permissions, too, if they exist: `sros run` takes one of these."""
        return (self.state.joined_domains() if self.state else None) or self.domains

    def problems(self, traits: VendorTraits) -> tuple[Problem, ...]:
        """Return the faults, except in documents, that keep a vendor's process from starting."""
        if self.state is None or self.at is None:
            return ()
        return tuple(
            each
            for each in vendor_problems(traits, self.state, self.at)
            if each.fault not in _LEFT_TO_THE_VENDOR
            and not (self.key_elsewhere and (each.fault, each.file) == _NO_KEY)
        )


def load_enclave(name: str, folder: Path, *, at: datetime) -> LoadedEnclave:
    """Return the enclave that DDS would load from a folder at the time ``at``."""
    state = open_enclave(folder, now=at)
    governance, permissions = (
        _document(state.files.get(file, b"")) for file in ("governance.p7s", "permissions.p7s")
    )
    return LoadedEnclave(
        name,
        subject_text(state.certificate.subject) if state.certificate else "",
        governance,
        permissions,
        state.domains() or _domains(governance),
        state.files.get("permissions.p7s", b""),
        tuple(_expiries(state, folder)),
        state,
        at,
        key_elsewhere=state.key_on_robot,
    )


def plan_enclave(policy: Enclave, governance: Governance, *, at: datetime) -> LoadedEnclave:
    """Return the enclave that DDS would load if the policy were signed at ``at``."""
    from sros_tool.translate import permissions_for
    from sros_tool.validity import window

    subject = f"CN={policy.path}"
    domains = governance.domains().closed()
    permissions = permissions_for(
        policy, subject=subject, validity=window(at, _PLANNED), domains=domains
    )
    return LoadedEnclave(
        policy.path,
        subject,
        render_governance(governance),
        render_permissions(permissions),
        domains,
    )


def _document(message: bytes) -> bytes:
    with suppress(SrosError):
        return smime.parse(message).document
    return b""


def _domains(governance: bytes) -> DomainSet | None:
    with suppress(SrosError):
        return parse_governance(governance).domains().closed()
    return None


def _expiries(state: OpenedEnclave, folder: Path) -> Iterator[tuple[str, datetime]]:
    certificates = {
        "cert.pem": state.certificate,
        "identity_ca.cert.pem": state.identity_ca,
        "permissions_ca.cert.pem": state.permissions_ca,
    }
    for file, certificate in certificates.items():
        if certificate:
            yield file, validity_of(certificate).not_after
    crl = folder / "crl.pem"
    if crl.exists():
        from sros_tool.pki.crl import load_crl

        with suppress(SrosError):
            yield "crl.pem", load_crl(read_bytes(crl, "revocation list"), "").next_update


# ── what a vendor decides ──────────────────────────────────────────────────────────────────

_WORST_FIRST = (
    Outcome.CRASHES,
    Outcome.REFUSED,
    Outcome.DENIED,
    Outcome.PEER_DENIES,
    Outcome.ALLOWED,
)
_ONLY_PEERS_NOTICE = {
    (Vendor.CYCLONE, Fault.KEY_MISMATCH),
    (Vendor.FAST, Fault.KEY_ALGORITHM),
    (Vendor.FAST_2_9, Fault.KEY_ALGORITHM),
    (Vendor.FAST_2_9, Fault.DOCUMENT_SIZE),
}
"""Faults that a vendor does not notice in its own process, but all peers do."""

# All enclaves of a keystore have the same governance.
_governance_as = lru_cache(maxsize=16)(read_governance_as)


@dataclass(frozen=True, slots=True)
class JoinContext:
    """The domain and time of joining; ``zone`` is the time zone of the host."""

    domain: int
    at: datetime
    zone: tzinfo = UTC


class Evaluator:
    """An evaluator of questions to one vendor about one enclave; reusable for many questions."""

    def __init__(self, vendor: Vendor, enclave: LoadedEnclave, context: JoinContext) -> None:
        self.vendor = vendor
        self.enclave = enclave
        self.context = context
        self._governance: Governance | None = None
        self._permissions: Permissions | None = None
        self._problems = enclave.problems(vendor.traits)
        self._access = self._load()
        self._until_file, self._until = self._first_expiry()

    @property
    def access(self) -> Access | None:
        """The access of the vendor's process; None if it does not run, or no peer accepts it."""
        return self._access if isinstance(self._access, Access) else None

    def answer(self, question: Question) -> Answer:
        """Return the answer to a question, without policy lines, change and remedy."""
        if isinstance(self._access, Decision):
            return self._made(question, [(None, self._access)])
        access = self._access
        own: list[tuple[Part | None, Decision]] = [(None, access.join())]
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

    def _load(self) -> Access | Decision:
        """Return the access of the vendor's process, or the decision that keeps it from running."""
        enclave, context = self.enclave, self.context
        if self._problems:
            first = self._problems[0]
            noticed_late = all(
                (self.vendor, each.fault) in _ONLY_PEERS_NOTICE for each in self._problems
            )
            outcome = Outcome.PEER_DENIES if noticed_late else Outcome.REFUSED
            return Decision(outcome, first.fault.id, f"{self.vendor.title}: {first}.")
        governance = _governance_as(self.vendor, enclave.governance)
        if isinstance(governance, Refusal):
            return replace(governance.decision(), reason=Fault.GOVERNANCE_MALFORMED.id)
        self._governance = governance
        permissions = read_permissions_as(self.vendor, enclave.permissions)
        if isinstance(permissions, Refusal):
            return replace(permissions.decision(), reason=Fault.PERMISSIONS_MALFORMED.id)
        self._permissions = permissions
        return Access(
            self.vendor,
            governance,
            permissions,
            enclave.subject,
            domain=context.domain,
            at=context.at,
            zone=context.zone,
        )

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
        grant = None
        if decision.grant is not None and self._permissions:
            grant = self._permissions.grants[decision.grant]
        return Answer(
            self.vendor,
            question,
            outcome,
            decision,
            part,
            tuple(asked),
            self._problems,
            grant,
            self._domain_rule(),
            self._until,
            self._until_file,
        )

    def _domain_rule(self) -> DomainRule | None:
        rules = self._governance.domain_access_rules if self._governance else ()
        return next((r for r in rules if self.context.domain in r.domains.closed()), None)

    def _first_expiry(self) -> tuple[str, datetime | None]:
        """Return the file of the enclave that expires first, and when."""
        expiries = list(self.enclave.expiries)
        if self._permissions and isinstance(self._access, Access):
            index = self._access.join().grant
            text = "" if index is None else self._permissions.grants[index].not_after
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
