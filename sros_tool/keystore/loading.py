"""Tells whether a process can run in an enclave: every check that DDS makes when it starts.

The checks follow what Fast DDS 2.14.5 and Cyclone DDS 0.10 do when a participant is created, and
name the cause where these stay silent.

Vendors differ in it, by the traits in `sros_tool.dds.decision.vendors`; what all of them check
alike is in `sros_tool.keystore.loading`.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from datetime import datetime
from functools import lru_cache
from itertools import dropwhile
from pathlib import Path
from typing import TypeVar

from cryptography import x509
from cryptography.hazmat.primitives import hashes
from cryptography.hazmat.primitives.asymmetric import ec, rsa

from sros_tool.dds.decision import TRAITS, Traits, Vendor
from sros_tool.dds.decision.vendors import Hashes, Keys, Signers
from sros_tool.dds.domains import DomainSet
from sros_tool.dds.governance import Governance, parse_governance
from sros_tool.dds.permissions import MAX_SIGNED_BYTES, Permissions, parse_permissions
from sros_tool.errors import PkiError, SrosError
from sros_tool.faults import Fault
from sros_tool.keystore.layout import IDENTITY, REQUIRED_FILES
from sros_tool.pki import smime
from sros_tool.pki.certificates import (
    issued_by,
    load_certificate,
    load_certificates,
    same_key,
    subject_text,
    validity_of,
)
from sros_tool.pki.chains import chain_fault
from sros_tool.pki.crl import signed_by
from sros_tool.pki.keys import algorithm, load_key
from sros_tool.validity import Window, iso
from sros_tool.values import shows
from sros_tool.xml import read_bytes

Parsed = TypeVar("Parsed")

_OWN = "cert.pem"
_CERTIFICATE_ENDS = (Fault.CERTIFICATE_EXPIRED, Fault.CERTIFICATE_NOT_YET_VALID)
_CA_ENDS = (Fault.CA_EXPIRED, Fault.CA_NOT_YET_VALID)
_PERMISSIONS_ENDS = (Fault.PERMISSIONS_EXPIRED, Fault.PERMISSIONS_NOT_YET_VALID)
_ENCRYPTED = re.compile(rb"ENCRYPTED")
_SIGNED = re.compile(rb"(?i)multipart/signed|application/(?:x-)?pkcs7-mime")


@shows("file", "text", "code")
@dataclass(frozen=True, slots=True)
class Problem:
    """A fault that keeps a process from running in an enclave: in which file, and why there."""

    file: str
    text: str
    fault: Fault

    @property
    def code(self) -> str:
        """The stable word for programs, such as ``key-mismatch``."""
        return self.fault.id

    def __str__(self) -> str:
        return f"{self.file}: {self.text}"


@dataclass(frozen=True, slots=True)
class EnclaveState:
    """What the files of an enclave say, as far as they can be read, and what is wrong with them."""

    certificate: x509.Certificate | None
    identity_ca: x509.Certificate | None
    permissions_ca: x509.Certificate | None
    governance: Governance | None
    permissions: Permissions | None
    permissions_bytes: int
    problems: tuple[Problem, ...]
    files: Mapping[str, bytes] = field(default_factory=dict, repr=False)
    """The bytes of the required files, of those that can be read."""
    permissions_document: bytes = field(default=b"", repr=False)
    """The XML within ``permissions.p7s``, also where it cannot be read as permissions."""

    def domains(self) -> DomainSet | None:
        """The domains that governance names, or None without governance."""
        return self.governance.domains().closed() if self.governance else None


# The enclaves of a keystore have all but their own files in common: these are read once.
_certificate = lru_cache(maxsize=8)(load_certificate)
_governance = lru_cache(maxsize=8)(parse_governance)


@lru_cache(maxsize=8)
def _content(message: bytes, authority: x509.Certificate | None) -> bytes:
    signed = smime.parse(message)
    if authority:
        signed.verify(authority)
    return signed.document


@lru_cache(maxsize=8)
def _revocation_list(
    data: bytes, authority: x509.Certificate | None
) -> tuple[x509.CertificateRevocationList, bool]:
    """A revocation list, and whether it is of that authority."""
    crl = x509.load_pem_x509_crl(data)
    return crl, authority is None or signed_by(crl, authority)


def check_enclave(folder: Path, *, now: datetime, domain: int | None = None) -> EnclaveState:
    """Read and check the files of an enclave; with ``domain``, also whether it may join that."""
    return _Check(folder, now).run(domain)


class _Check:
    def __init__(self, folder: Path, now: datetime) -> None:
        self._folder = folder
        self._now = now
        self._problems: list[Problem] = []
        self._permissions_document = b""

    def run(self, domain: int | None) -> EnclaveState:
        files = {name: self._read(name) for name in REQUIRED_FILES}
        identity_ca = self._certificate("identity_ca.cert.pem", files)
        permissions_ca = self._certificate("permissions_ca.cert.pem", files)
        certificate = self._certificate("cert.pem", files)
        self._identity(certificate, identity_ca, files["key.pem"])
        self._revocation(certificate, identity_ca)
        governance = permissions = None
        if (document := self._signed("governance.p7s", files, permissions_ca)) is not None:
            governance = self._parsed(
                "governance.p7s", document, _governance, Fault.GOVERNANCE_MALFORMED
            )
        if (document := self._signed("permissions.p7s", files, permissions_ca)) is not None:
            self._permissions_document = document
            permissions = self._parsed(
                "permissions.p7s", document, parse_permissions, Fault.PERMISSIONS_MALFORMED
            )
        if governance and domain is not None and domain not in governance.domains().closed():
            self._fault(
                "governance.p7s",
                f"it is for domain {governance.domains().closed()}, not for {domain}",
                Fault.GOVERNANCE_DOMAIN,
            )
        if permissions and certificate:
            self._grant(permissions, certificate, domain)
        return EnclaveState(
            certificate,
            identity_ca,
            permissions_ca,
            governance,
            permissions,
            len(files["permissions.p7s"] or b""),
            tuple(self._problems),
            {name: data for name, data in files.items() if data is not None},
            self._permissions_document,
        )

    def _fault(self, file: str, text: str, fault: Fault) -> None:
        self._problems.append(Problem(file, text, fault))

    def _read(self, name: str) -> bytes | None:
        path = self._folder / name
        if not path.exists():
            if path.is_symlink():
                self._fault(
                    name, f"it is a link to nothing ({path.readlink()})", Fault.LINK_DANGLING
                )
            else:
                self._fault(name, "missing", Fault.FILE_MISSING)
            return None
        try:
            data = read_bytes(path, "file")
        except SrosError as error:
            self._fault(name, f"it cannot be read: {error.why.rstrip('.')}", Fault.FILE_UNREADABLE)
            return None
        if not data:
            self._fault(name, "it is empty", Fault.FILE_EMPTY)
            return None
        return data

    def _certificate(self, name: str, files: dict[str, bytes | None]) -> x509.Certificate | None:
        data = files[name]
        if data is None:
            return None
        try:
            certificate = _certificate(data, name)
        except SrosError as error:
            self._fault(name, error.why.rstrip("."), Fault.CERTIFICATE_MALFORMED)
            return None
        self._valid_now(
            name, validity_of(certificate), _CERTIFICATE_ENDS if name == _OWN else _CA_ENDS
        )
        return certificate

    def _valid_now(self, name: str, validity: Window, faults: tuple[Fault, Fault]) -> None:
        """Note it if it expired, or is not valid yet: the first or the second of ``faults``."""
        expired, not_yet_valid = faults
        if self._now > validity.not_after:
            self._fault(name, f"it expired at {iso(validity.not_after)}", expired)
        elif self._now < validity.not_before:
            begin = iso(validity.not_before)
            self._fault(name, f"it is not valid before {begin}", not_yet_valid)

    def _identity(
        self, certificate: x509.Certificate | None, ca: x509.Certificate | None, key: bytes | None
    ) -> None:
        if certificate and ca and not issued_by(certificate, ca):
            self._fault(
                "cert.pem",
                f"it was not issued by the identity CA of the enclave ({subject_text(ca.subject)}) "
                f"but by {subject_text(certificate.issuer)}",
                Fault.CERTIFICATE_ISSUER,
            )
        if key is None:
            return
        try:
            private = load_key(key, "key.pem")
        except SrosError as error:
            fault = Fault.KEY_ENCRYPTED if _ENCRYPTED.search(key) else Fault.KEY_MALFORMED
            self._fault("key.pem", error.why.rstrip("."), fault)
            return
        if certificate and not same_key(certificate, private):
            self._fault("key.pem", "it is not the key of cert.pem", Fault.KEY_MISMATCH)

    def _revocation(
        self, certificate: x509.Certificate | None, ca: x509.Certificate | None
    ) -> None:
        path = self._folder / "crl.pem"
        if not path.exists():
            return
        try:
            crl, authentic = _revocation_list(read_bytes(path, "revocation list"), ca)
        except (SrosError, ValueError):
            text = "it is not a revocation list, and DDS then refuses everybody"
            self._fault("crl.pem", text, Fault.CRL_MALFORMED)
            return
        if not authentic:
            text = "it is not of the identity CA, and DDS then refuses everybody"
            self._fault("crl.pem", text, Fault.CRL_ISSUER)
        if crl.last_update_utc > self._now:
            self._fault(
                "crl.pem",
                f"it is not valid before {iso(crl.last_update_utc)}: everybody is refused",
                Fault.CRL_NOT_YET_VALID,
            )
        if crl.next_update_utc and crl.next_update_utc < self._now:
            text = f"it expired at {iso(crl.next_update_utc)}: everybody is refused"
            self._fault("crl.pem", text, Fault.CRL_EXPIRED)
        if certificate and crl.get_revoked_certificate_by_serial_number(certificate.serial_number):
            self._fault("cert.pem", "it is revoked by crl.pem", Fault.REVOKED)

    def _signed(
        self, name: str, files: dict[str, bytes | None], authority: x509.Certificate | None
    ) -> bytes | None:
        data = files[name]
        if data is None:
            return None
        try:
            return _content(data, authority)
        except SrosError as error:
            fault = Fault.SIGNATURE if _SIGNED.search(data[:1000]) else Fault.NOT_SIGNED
            self._fault(name, str(error), fault)
            return None

    def _parsed(
        self,
        name: str,
        document: bytes,
        read: Callable[[bytes, str], Parsed],
        malformed: Fault,
    ) -> Parsed | None:
        try:
            return read(document, name)
        except SrosError as error:
            self._fault(name, error.why.rstrip(".") or error.what, malformed)
            return None

    def _grant(
        self, permissions: Permissions, certificate: x509.Certificate, domain: int | None
    ) -> None:
        name = "permissions.p7s"
        subject = subject_text(certificate.subject)
        grants = [grant for grant in permissions.grants if grant.subject == subject]
        if not grants:
            others = ", ".join(grant.subject for grant in permissions.grants)
            text = f"it has no grant for {subject}, only for {others or 'nobody'}"
            self._fault(name, text, Fault.PERMISSIONS_SUBJECT)
            return
        grant = grants[0]
        try:
            self._valid_now(name, grant.validity, _PERMISSIONS_ENDS)
        except SrosError as error:  # it ends before it begins
            self._fault(name, error.what, Fault.PERMISSIONS_MALFORMED)
        rules = [rule for rule in grant.rules if rule.allow]
        if domain is not None and not any(domain in rule.domains.closed() for rule in rules):
            text = f"no rule of it allows anything in domain {domain}"
            self._fault(name, text, Fault.PERMISSIONS_DOMAIN)


MEASURED = (Vendor.FAST, Vendor.FAST_2_9, Vendor.CYCLONE)
"""The vendors whose loading of CAs and signatures was measured."""
Certificates = tuple[x509.Certificate, ...]

IDENTITY_CA, PERMISSIONS_CA = "identity_ca.cert.pem", "permissions_ca.cert.pem"
CERTIFICATE, GOVERNANCE, PERMISSIONS = "cert.pem", "governance.p7s", "permissions.p7s"
_SIDES = ((IDENTITY_CA, CERTIFICATE), (PERMISSIONS_CA, GOVERNANCE, PERMISSIONS))
_JUDGED = frozenset(
    {Fault.CA_EXPIRED, Fault.CA_NOT_YET_VALID, Fault.CERTIFICATE_ISSUER, Fault.SIGNATURE}
)
"""Faults that do not hold for every vendor."""

_certificates = lru_cache(maxsize=16)(load_certificates)


def vendor_problems(traits: Traits, state: EnclaveState, at: datetime) -> tuple[Problem, ...]:
    """The problems that a vendor has with an enclave when it loads it, at the moment ``at``.

    Those of its documents' content are not among them, beyond what `EnclaveState` says.
    """
    kept = [each for each in state.problems if each.fault not in _JUDGED]
    # What is wrong with these for every vendor is not told twice.
    known = {
        each.file for each in kept if each.file == CERTIFICATE or each.fault is Fault.NOT_SIGNED
    }
    faults = [each for each in _faults(traits, state, at) if each.file not in known]
    for side in _SIDES:
        of_side = [each for each in faults if each.file in side]
        files = {each.file for each in of_side} | ({side[0]} if of_side else set())
        named = [each for each in state.problems if each.fault in _JUDGED and each.file in files]
        kept += named or of_side
    return tuple(kept)


def _faults(traits: Traits, state: EnclaveState, at: datetime) -> Iterator[Problem]:
    read: dict[str, Certificates] = {}
    for file in (IDENTITY_CA, PERMISSIONS_CA):
        if file in state.files:
            with suppress(PkiError):
                read[file] = _certificates(state.files[file], file)
    for file, certificates in read.items():
        if fault := authority_fault(traits, certificates, at):
            yield Problem(file, *fault)
    authorities = read.get(IDENTITY_CA)
    if authorities and state.certificate:
        yield from _identity_faults(traits, state.certificate, authorities, at)
    signers = read.get(PERMISSIONS_CA)
    for file in (GOVERNANCE, PERMISSIONS):
        if not signers or file not in state.files:
            continue
        if text := _signature_fault(traits, state.files[file], signers, at):
            yield Problem(file, text, Fault.SIGNATURE)
    largest = traits.largest_document
    if largest is not None and state.permissions_bytes > largest:
        text = f"it has {state.permissions_bytes} bytes, and from {MAX_SIGNED_BYTES} on the "
        yield Problem(PERMISSIONS, f"{text}handshake never ends", Fault.DOCUMENT_SIZE)


@lru_cache(maxsize=8)
def _signature_fault(traits: Traits, message: bytes, signers: Certificates, at: datetime) -> str:
    # The enclaves of a keystore have their governance in common.
    try:
        return signer_fault(traits, smime.parse(message), signers, at)
    except PkiError as error:
        return str(error)


@lru_cache(maxsize=16)
def authority_fault(
    traits: Traits, certificates: Certificates, at: datetime
) -> tuple[str, Fault] | None:
    """Why the vendor refuses a CA file as such, and the fault.

    ``certificates`` are those of the file, in their order.
    """
    trusted = _trusted(traits, certificates)
    if not trusted:
        name = subject_text(certificates[0].subject)
        return f"{name} is not signed with SHA-256", Fault.SIGNATURE_HASH
    if traits.verifies_authorities:
        fault = chain_fault(certificates[0], trusted, at=at, strict=True)
        if fault:
            return f"it is refused: {fault}", Fault.CA_CHAIN
    return None


def authority_refusals(role: str, certificates: Certificates, at: datetime) -> dict[Vendor, str]:
    """Which vendors refuse what a CA issues (identity) or signs (permissions), and why.

    ``certificates`` are those of its file, that of the CA itself first.  Only the vendors that were
    measured are asked.
    """
    refusals = {}
    for vendor in MEASURED:
        traits = TRAITS[vendor]
        fault = authority_fault(traits, certificates, at)
        if fault:
            refusals[vendor] = fault[0]
        elif role == IDENTITY:
            below = chain_fault(certificates[0], _trusted(traits, certificates), at=at)
            key = "" if _key_fits(traits, certificates[0]) else "its key is not of a kind it takes"
            refusals[vendor] = below or key
        elif traits.signers is Signers.CHAIN:
            trusted = _trusted(traits, certificates)
            refusals[vendor] = chain_fault(certificates[0], trusted, at=at, for_documents=True)
    return {vendor: text for vendor, text in refusals.items() if text}


def refusals_text(refusals: Mapping[Vendor, str]) -> str:
    """Which of the measured vendors refuse a CA and why, and which take it, as clauses."""
    by_text: dict[str, list[str]] = {}
    for vendor, text in refusals.items():
        by_text.setdefault(text, []).append(vendor.title)
    clauses = [
        f"{' and '.join(titles)} {'refuses' if len(titles) == 1 else 'refuse'} what it issues or "
        f"signs: {text}"
        for text, titles in by_text.items()
    ]
    takes = [vendor.title for vendor in MEASURED if vendor not in refusals]
    if takes:
        clauses.append(f"{' and '.join(takes)} {'takes' if len(takes) == 1 else 'take'} it")
    return "; ".join(clauses)


def signer_fault(
    traits: Traits, signed: smime.SignedDocument, certificates: Certificates, at: datetime
) -> str:
    """Why the vendor does not take the signature of a document, or "".

    ``certificates`` are those of the permissions CA's file, in their order.
    """
    trusted = _trusted(traits, certificates)
    if traits.signers is Signers.AUTHORITY:
        try:
            signed.verify(certificates[0])
        except PkiError as error:
            return str(error)
        return ""
    listed = traits.signers is Signers.LISTED
    signer = signed.signer_among(trusted if listed else signed.certificates)
    if signer is None:
        where = "in the file of the permissions CA" if listed else "in the message"
        return f"the certificate of its signer is not {where}"
    if not signed.is_intact(signer):
        return "its signature does not match its content"
    if listed:
        return ""
    fault = chain_fault(signer, trusted, signed.certificates, at=at, for_documents=True)
    return f"its signer is not accepted: {fault}" if fault else ""


def _trusted(traits: Traits, certificates: Certificates) -> Certificates:
    if traits.reads_first_authority:
        return certificates[:1]
    return tuple(dropwhile(lambda each: not _hash_fits(traits, each), certificates))


def _hash_fits(traits: Traits, certificate: x509.Certificate) -> bool:
    digest = certificate.signature_hash_algorithm
    if traits.hashes is Hashes.ANY or isinstance(digest, hashes.SHA256):
        return True
    return isinstance(digest, hashes.SHA1) and certificate.signature_algorithm_oid in _RSA_SHA1


_RSA_SHA1 = {x509.SignatureAlgorithmOID.RSA_WITH_SHA1}


def _identity_faults(
    traits: Traits, certificate: x509.Certificate, authorities: Certificates, at: datetime
) -> Iterator[Problem]:
    if not _hash_fits(traits, certificate):
        yield Problem(CERTIFICATE, "it is not signed with SHA-256", Fault.SIGNATURE_HASH)
    for file, each in ((CERTIFICATE, certificate), (IDENTITY_CA, authorities[0])):
        if not _key_fits(traits, each):
            text = f"it has a key of {algorithm(each.public_key())}"
            yield Problem(file, text, Fault.KEY_ALGORITHM)
    if fault := chain_fault(certificate, _trusted(traits, authorities), at=at):
        yield Problem(CERTIFICATE, fault, Fault.CERTIFICATE_ISSUER)


def _key_fits(traits: Traits, certificate: x509.Certificate) -> bool:
    key = certificate.public_key()
    if isinstance(key, ec.EllipticCurvePublicKey):
        return traits.keys is not Keys.SMALL or key.key_size == 256
    if isinstance(key, rsa.RSAPublicKey):
        return traits.keys is not Keys.SMALL or key.key_size == 2048
    return traits.keys is Keys.ANY
