"""An enclave as DDS loads it, and the participant that each vendor creates for it.

Only this module combines a vendor's three decisions: which files the vendor refuses to load, how it
reads the documents, and whether the participant may join.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from contextlib import suppress
from dataclasses import replace
from datetime import UTC, datetime, timedelta, tzinfo
from functools import lru_cache
from pathlib import Path
from typing import NamedTuple

from cryptography import x509

from sros_tool.dds.decision.access import Access, Decision, GovernedDomain, Outcome, Refusal
from sros_tool.dds.decision.documents import (
    are_canonical_permissions,
    canonical_governance,
    is_plain_governance,
    is_plain_permissions,
    read_governance_as,
    read_permissions_as,
)
from sros_tool.dds.decision.vendors import (
    CYCLONE_DDS,
    FAST_DDS,
    TESTED,
    Vendor,
    VendorTraits,
    joined_titles,
)
from sros_tool.dds.domains import DomainSet
from sros_tool.dds.governance import Governance, parse_governance, render_governance
from sros_tool.dds.permissions import Permissions, render_permissions
from sros_tool.errors import SrosError
from sros_tool.faults import BEFORE_DDS, Fault
from sros_tool.keystore.layout import (
    GOVERNANCE_FILE,
    KEY_FILE,
    PERMISSIONS_CA_FILE,
    PERMISSIONS_FILE,
)
from sros_tool.keystore.loading import CRASHES, vendor_problems
from sros_tool.keystore.reader import OpenedEnclave, OpenedKeystore, Problem, open_enclave
from sros_tool.names import ROS_DISCOVERY_TOPIC
from sros_tool.pki.certificates import extension, load_certificates, subject_text, validity_of
from sros_tool.policy.model import Enclave

# ── enclaves as DDS loads them ─────────────────────────────────────────────────────────────

_VENDOR_SPECIFIC_FAULTS = frozenset(
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
"""Faults of documents on which each vendor decides by its own rules."""
_MISSING_KEY = (Fault.FILE_MISSING, KEY_FILE)

_PLANNED_VALIDITY = timedelta(days=365)
"""The assumed validity of permissions for a policy that is not yet signed."""


class LoadedEnclave(NamedTuple):
    """An enclave as DDS loads it.

    ``subject`` is the subject of the certificate, and ``domains`` are the ROS domains of the
    governance; "" and None if they cannot be read.  ``governance`` and ``permissions`` are the XML
    in the signed documents.  ``signed`` are the signed permissions; b"" before signing.  ``state``
    is the state of the files in ``folder`` at the time ``at``; None if they do not exist yet.
    ``key_elsewhere`` says that the key is on the robot that generated it.

    ``keystore`` is the enclave's keystore, and ``policy`` the enclave's part of ``policy_file``, if
    known.  With ``has_placeholders``, the policy is for the robots of a fleet.  ``portable`` are
    the permissions if all vendors read them alike, because sros wrote them.  An enclave that is
    only planned has no XML: ``portable`` and ``plain_governance`` replace it.
    """

    name: str
    subject: str
    governance: bytes
    permissions: bytes
    domains: DomainSet | None
    signed: bytes = b""
    folder: Path | None = None
    state: OpenedEnclave | None = None
    at: datetime | None = None
    key_elsewhere: bool = False
    keystore: OpenedKeystore | None = None
    policy: Enclave | None = None
    policy_file: Path | None = None
    has_placeholders: bool = False
    portable: Permissions | None = None
    plain_governance: Governance | None = None

    @property
    def root(self) -> Path | None:
        """The folder of the enclave's keystore; None if it is not known."""
        return self.keystore.root if self.keystore else None

    @property
    def joined_domains(self) -> DomainSet | None:
        """The ROS domains that governance and permissions allow; None without a governance.

        `sros run` chooses one of these domains.
        """
        return (self.state.joined_domains() if self.state else None) or self.domains

    def expiries(self) -> tuple[tuple[str, datetime], ...]:
        """Return (file, expiry) for each file that expires, except the permissions."""
        return tuple(_file_expiries(self.state, self.folder)) if self.state and self.folder else ()

    @property
    def on_this_machine(self) -> LoadedEnclave:
        """The enclave as a process on this machine loads it: a key elsewhere counts as missing."""
        return self._replace(key_elsewhere=self.state.key_on_robot) if self.state else self

    def problems(self, traits: VendorTraits) -> tuple[Problem, ...]:
        """Return the faults, except in documents, that prevent a vendor's process from starting."""
        if self.state is None or self.at is None:
            return ()
        return tuple(
            problem
            for problem in vendor_problems(traits, self.state, self.at)
            if problem.fault not in _VENDOR_SPECIFIC_FAULTS
            and not (self.key_elsewhere and (problem.fault, problem.file) == _MISSING_KEY)
        )


def load_enclave(name: str, folder: Path, *, moment: datetime) -> LoadedEnclave:
    """Return the enclave that DDS would load from a folder at the time ``moment``."""
    return loaded_enclave(name, folder, open_enclave(folder, now=moment), moment=moment)


def load_enclave_of(keystore: OpenedKeystore, name: str, *, moment: datetime) -> LoadedEnclave:
    """Return an enclave of a keystore as DDS would load it at the time ``moment``."""
    return loaded_enclave(
        name, keystore.folder(name), keystore.enclave(name, now=moment), moment=moment
    )


def deciding_enclave(keystore: OpenedKeystore, name: str, *, moment: datetime) -> LoadedEnclave:
    """Return an enclave as `load_enclave_of` does, for deciding what its documents allow.

    In a copy of a keystore without any keys, the enclave's key is not reported as missing.
    """
    enclave = load_enclave_of(keystore, name, moment=moment)
    lacks_key = enclave.state is not None and KEY_FILE not in enclave.state.files
    # Other enclaves are only examined if this one lacks its key, because a process may not be able
    # to read them.
    if lacks_key and not keystore.has_keys:
        return enclave._replace(key_elsewhere=True)
    return enclave


def loaded_enclave(
    name: str, folder: Path, state: OpenedEnclave, *, moment: datetime
) -> LoadedEnclave:
    """Return the enclave that DDS would load from a folder that was opened at ``moment``."""
    governance, permissions = (
        _signed_document(state, file) for file in (GOVERNANCE_FILE, PERMISSIONS_FILE)
    )
    return LoadedEnclave(
        name,
        subject_text(state.certificate.subject) if state.certificate else "",
        governance,
        permissions,
        state.domains() or _governance_domains(governance),
        state.files.get(PERMISSIONS_FILE, b""),
        folder,
        state,
        moment,
        key_elsewhere=state.key_on_robot,
        portable=_portable_permissions(state.permissions, permissions),
    )


def _portable_permissions(permissions: Permissions | None, document: bytes) -> Permissions | None:
    """Return ``permissions`` if all vendors read the document alike, else None."""
    return permissions if permissions and are_canonical_permissions(permissions, document) else None


def plan_enclave(policy: Enclave, governance: Governance, *, moment: datetime) -> LoadedEnclave:
    """Return the enclave that DDS would load if the policy were signed at ``moment``."""
    from sros_tool.translate import permissions_for
    from sros_tool.validity import window

    subject = f"CN={policy.path}"
    domains = governance.domains().closed()
    permissions = permissions_for(
        policy, subject=subject, validity=window(moment, _PLANNED_VALIDITY), domains=domains
    )
    # Permissions that all vendors read alike are passed on without rendering and reading them.
    plain = is_plain_permissions(permissions)
    plain_governance = is_plain_governance(governance)
    return LoadedEnclave(
        policy.path,
        subject,
        b"" if plain_governance else render_governance(governance),
        b"" if plain else render_permissions(permissions),
        domains,
        portable=permissions if plain else None,
        plain_governance=governance if plain_governance else None,
    )


def _signed_document(state: OpenedEnclave, file: str) -> bytes:
    with suppress(SrosError):
        return state.signed_document(file).document
    return b""


def _governance_domains(governance: bytes) -> DomainSet | None:
    with suppress(SrosError):
        return parse_governance(governance).domains().closed()
    return None


def _file_expiries(state: OpenedEnclave, folder: Path) -> Iterator[tuple[str, datetime]]:
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
            data = state.read_once.read(crl, "revocation list")
            yield "crl.pem", load_crl(data, "").next_update


# ── the participant of a vendor ────────────────────────────────────────────────────────────

_FAULTS_SEEN_BY_PEERS = {
    *((vendor, Fault.KEY_MISMATCH) for vendor in CYCLONE_DDS),
    *((vendor, Fault.KEY_ALGORITHM) for vendor in FAST_DDS),
    *((vendor, Fault.DOCUMENT_SIZE) for vendor in FAST_DDS),
}
"""Faults that a vendor's own process does not notice, but all its peers do."""


@lru_cache(maxsize=64)  # all enclaves of a keystore have the same governance
def _rules_for_domain(
    vendor: Vendor, document: Governance | bytes, domain: int
) -> GovernedDomain | Refusal:
    """Return the rules of a governance for a domain as ``vendor`` reads them, or its refusal."""
    governance: Governance | Refusal
    if isinstance(document, Governance):
        governance = document
    else:
        governance = canonical_governance(document) or read_governance_as(vendor, document)
    if isinstance(governance, Refusal):
        return governance
    return GovernedDomain(vendor, governance, domain)


class JoinContext(NamedTuple):
    """The ROS domain and the time for joining; ``zone`` is the time zone of the host."""

    domain: int
    at: datetime
    zone: tzinfo = UTC


class RefusalCause(NamedTuple):
    """A reason why no node of a vendor can run in an enclave, or why peers refuse the node.

    ``outcome`` is the decision on the node.  ``reason`` is the id of a fault or decision; ``text``
    is a clause that names the ``file``.
    ``hits_peers`` says that the processes of peers crash, but not the node's own process.
    """

    outcome: Outcome
    reason: str
    file: str
    text: str
    hits_peers: bool = False


_GOVERNANCE_REASONS = {
    *(Fault.GOVERNANCE_MALFORMED.id, "domain-not-in-governance", "no-topic-rule"),
    "unauthenticated-with-rtps-protection",
}
"""Ids of decisions that the governance causes, for which no fault names the file."""


def _crashes_before(problem: Problem, governed: GovernedDomain | Refusal) -> bool:
    """Return whether the governance crashes a process before the process finds the problem."""
    return (
        isinstance(governed, Refusal)
        and governed.outcome is Outcome.CRASHES
        and problem.file == PERMISSIONS_FILE
        and problem.fault not in BEFORE_DDS
    )


class VendorParticipant:
    """The participant of a vendor in an enclave.

    ``problems`` are the faults of files for which the vendor, or all peers, refuse the participant.
    ``governance`` and ``permissions`` are the documents as the vendor reads them; None if the
    vendor cannot read them.  ``permissions_document`` is the XML of the permissions.  ``refusal``
    is the decision that prevents the process from running, or None.
    """

    def __init__(self, vendor: Vendor, enclave: LoadedEnclave, context: JoinContext) -> None:
        self.vendor = vendor
        self.governance: Governance | None = None
        self.permissions: Permissions | None = None
        self.permissions_document = enclave.permissions
        self.problems = enclave.problems(vendor.traits)
        made = self._decide_join(enclave, context)
        self.access = made if isinstance(made, Access) else None
        """The access control of the process; None if it does not run, or no peer accepts it."""
        self.refusal = made if isinstance(made, Decision) else None

    def join(self) -> Decision:
        """Return the decision whether the process starts and its peers accept it."""
        if self.access is not None:
            return self.access.join()
        assert self.refusal is not None
        return self.refusal

    def causes(self) -> tuple[RefusalCause, ...]:
        """Return why no node can run in the enclave, or why peers refuse nodes; () if nodes run.

        Rights to topics are not considered, because they are a matter of the policy.
        """
        join = self.join()
        if join.reason in {problem.fault.id for problem in self.problems}:
            return tuple(
                RefusalCause(join.outcome, problem.fault.id, problem.file, str(problem))
                for problem in self.problems
            )
        stopped = None if join.outcome.ok else join
        if stopped is None and self.access is not None:
            stopped = self.access.governance_refusal(
                ROS_DISCOVERY_TOPIC
            )  # every ROS 2 node opens this topic
        if stopped is None:
            return ()
        file = GOVERNANCE_FILE if stopped.reason in _GOVERNANCE_REASONS else PERMISSIONS_FILE
        text = f"{file}: {stopped.clause}"
        return (RefusalCause(stopped.outcome, stopped.reason, file, text, stopped.hits_peers),)

    def _decide_join(self, enclave: LoadedEnclave, context: JoinContext) -> Access | Decision:
        """Return the access control of the vendor's process, or the decision that stops it."""
        late: Decision | None = None
        governed = _rules_for_domain(
            self.vendor, enclave.plain_governance or enclave.governance, context.domain
        )
        noticed = [
            problem
            for problem in self.problems
            if (self.vendor, problem.fault) not in _FAULTS_SEEN_BY_PEERS
        ]
        if noticed and not _crashes_before(noticed[0], governed):
            first = noticed[0]
            outcome = Outcome.CRASHES if first.fault in CRASHES else Outcome.REFUSED
            return Decision(outcome, first.fault.id, f"{self.vendor.title}: {first}.")
        if self.problems:
            first = self.problems[0]
            text = f"{self.vendor.title}: {first}."
            late = Decision(Outcome.PEER_DENIES, first.fault.id, text)
        if isinstance(governed, Refusal):
            return governed.decision()._replace(reason=Fault.GOVERNANCE_MALFORMED.id)
        self.governance = governed.governance
        permissions = enclave.portable or read_permissions_as(self.vendor, enclave.permissions)
        if isinstance(permissions, Refusal):
            return permissions.decision()._replace(reason=Fault.PERMISSIONS_MALFORMED.id)
        self.permissions = permissions
        access = Access(
            governed, permissions, enclave.subject, moment=context.at, zone=context.zone
        )
        if late is None:
            return access
        # Peers refuse it anyway, but its own process may also refuse the documents.
        joined = access.join()
        return joined if joined.outcome in (Outcome.REFUSED, Outcome.CRASHES) else late


class EvaluatedEnclave(NamedTuple):
    """An enclave as some vendors load it, with the participants of these vendors."""

    state: OpenedEnclave
    participants: tuple[VendorParticipant, ...]

    def refusal_sentences(self, ignored: Collection[str] = ()) -> str:
        """Return why no vendor runs a process in the enclave, as sentences; "" if a vendor does.

        Causes whose reason is in ``ignored`` do not count.
        """
        sentences = []
        for participant in self.participants:
            causes = [cause.text for cause in participant.causes() if cause.reason not in ignored]
            if not causes:
                return ""
            sentences.append(f"{participant.vendor.title} refuses it: {'; '.join(causes)}.")
        return " ".join(sentences)

    def partial_refusal_clauses(self, problems: Sequence[Problem]) -> list[str]:
        """Return clauses on the problems for which only some of the vendors refuse the enclave."""
        clauses = []
        for problem in problems:
            titles = [
                participant.vendor.title
                for participant in self.participants
                if any(cause.file == problem.file for cause in participant.causes())
            ]
            if titles and problem not in self.state.problems:
                clauses.append(f"{problem} (refused by {' and '.join(joined_titles(titles))})")
        return clauses

    @property
    def problems(self) -> tuple[str, ...]:
        """Clauses on problems that stop a process; a key that is on the robot is not a problem."""
        named = tuple(map(str, self.state.problems_in_keystore))
        return named or tuple(filter(None, (self.refusal_sentences().removesuffix("."),)))

    @property
    def problems_here(self) -> tuple[str, ...]:
        """Clauses on problems that stop a process here, where a missing key is a problem, too."""
        return tuple(map(str, self.state.problems)) or self.problems


def evaluate_enclave(
    name: str,
    folder: Path,
    state: OpenedEnclave,
    *,
    moment: datetime,
    domain: int | None = None,
    zone: tzinfo = UTC,
    vendors: Sequence[Vendor] = TESTED,
) -> EvaluatedEnclave:
    """Return an opened enclave as ``vendors`` load it at the time ``moment``.

    ``domain`` is the ROS domain to join; None stands for the first domain in the enclave's
    documents.
    """
    number = domain if domain is not None else next(iter(state.joined_domains() or ()), 0)
    loaded, context = (
        loaded_enclave(name, folder, state, moment=moment),
        JoinContext(number, moment, zone),
    )
    participants = tuple(VendorParticipant(vendor, loaded, context) for vendor in vendors)
    return EvaluatedEnclave(accepted_state(state, participants), participants)


def accepted_state(
    state: OpenedEnclave, participants: Sequence[VendorParticipant]
) -> OpenedEnclave:
    """Return an enclave's state without the faults that at least one of the vendors accepts.

    Documents that a vendor loads count as the enclave's documents if a CA signed them.  Three
    faults stay even if a vendor accepts them: a missing key, a document that the enclave signed
    itself (CVE-2023-24011), and a revocation list that ROS does not pass to DDS.  There must be at
    least one participant.
    """
    loading = [participant for participant in participants if participant.permissions is not None]
    if not (state.problems and loading):
        return state
    sound = not all(participant.causes() for participant in participants)
    problems = tuple(
        problem
        for problem in state.problems
        if (problem.file == KEY_FILE and problem.fault is Fault.FILE_MISSING)
        or problem.fault is Fault.CRL_LEFT_OUT
        or (problem.fault in _VENDOR_SPECIFIC_FAULTS and not sound)
        or all(problem in participant.problems for participant in participants)
        or (problem.fault is Fault.SIGNATURE and not _is_signed_by_ca(state, problem.file))
    )
    if any(problem.fault is Fault.SIGNATURE for problem in problems):
        named = tuple(_with_acceptance(state, problem, participants) for problem in problems)
        return replace(state, problems=named)
    return replace(
        state,
        problems=problems,
        governance=state.governance or loading[0].governance,
        permissions=state.permissions or loading[0].permissions,
        permissions_document=state.permissions_document or loading[0].permissions_document,
    )


def _with_acceptance(
    state: OpenedEnclave, problem: Problem, participants: Sequence[VendorParticipant]
) -> Problem:
    """Return a problem of a signature, whose text names the vendors that accept the signature."""
    titles: dict[bool, list[str]] = {True: [], False: []}
    for participant in participants:
        titles[problem not in participant.problems].append(participant.vendor.title)
    accepting, refusing = (", ".join(joined_titles(titles[accepts])) for accepts in (True, False))
    if problem.fault is not Fault.SIGNATURE or not accepting:
        return problem
    text = f"{problem.text}; accepted by {accepting}"
    if refusing:
        text += f", refused by {refusing}"
    if state.certificate and _signers(state, problem.file) == {state.certificate}:
        text = f"the enclave gave itself these rights: {text}"
    return problem._replace(text=text, fault=Fault.SIGNER_NO_CA)


def _signers(state: OpenedEnclave, file: str) -> set[x509.Certificate | None]:
    """Return the certificates of a document's signers; None stands for a missing certificate."""
    with suppress(SrosError):
        signed = state.signed_document(file)
        data = state.files.get(PERMISSIONS_CA_FILE, b"")
        known = (*signed.certificates, *load_certificates(data, PERMISSIONS_CA_FILE))
        return {signature.signer_among(known) for signature in signed.signatures}
    return set()


def _is_signed_by_ca(state: OpenedEnclave, file: str) -> bool:
    """Return whether all signers of a document have CA certificates."""
    signers = _signers(state, file)
    return bool(signers) and all(signer is not None and _is_ca(signer) for signer in signers)


def _is_ca(certificate: x509.Certificate) -> bool:
    constraints = extension(certificate, x509.BasicConstraints)
    return constraints is not None and constraints.ca
