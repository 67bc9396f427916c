"""The one way to read a keystore and an enclave: its parts, its grant, and what is wrong."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from datetime import datetime
from functools import lru_cache
from pathlib import Path
from typing import TypeVar

from cryptography import x509

from sros_tool.dds.domains import DomainSet
from sros_tool.dds.governance import Governance, parse_governance
from sros_tool.dds.permissions import Grant, Permissions, parse_permissions
from sros_tool.errors import KeystoreError, SrosError
from sros_tool.faults import Fault
from sros_tool.keystore.layout import (
    GOVERNANCE_P7S,
    PERMISSIONS,
    REQUIRED_FILES,
    SETTINGS,
    ca_certificate,
)
from sros_tool.keystore.template import Template, load_template, read_template
from sros_tool.pki import smime
from sros_tool.pki.certificates import (
    issued_by,
    load_certificate,
    same_key,
    subject_text,
    validity_of,
)
from sros_tool.pki.crl import signed_by
from sros_tool.pki.keys import load_key
from sros_tool.validity import Window, iso
from sros_tool.values import shows
from sros_tool.xml import read_bytes


def load_settings(root: Path) -> Template:
    """The choices that the keystore was made by; those of ros2/sros2 where it has none."""
    path = root / SETTINGS
    return read_template(path) if path.exists() else load_template("sros2")


def load_governance(root: Path, authority: x509.Certificate) -> Governance:
    """The governance that DDS loads, after its signature by the permissions CA was verified."""
    path = root / GOVERNANCE_P7S
    try:
        signed = smime.parse(read_bytes(path, "governance document"))
        signed.verify(authority)
        return parse_governance(signed.document, f"'{path}'")
    except SrosError as error:
        raise KeystoreError(
            f"the governance of keystore '{root}' cannot be used: {error.what}",
            error.why,
            error.remedy or f"Restore '{path}' from a backup; every enclave depends on it.",
        ) from error


def governance_of(root: Path) -> Governance:
    """The governance that DDS loads, by the permissions CA that lies in the keystore."""
    path = root / ca_certificate(PERMISSIONS)
    return load_governance(root, load_certificate(read_bytes(path, "certificate"), f"'{path}'"))


def check_domain(domains: DomainSet, domain: int | None, root: Path) -> None:
    """Raise `KeystoreError` if ``domain`` is given and the keystore is not made for it."""
    if domain is None or domain in domains:
        return
    raise KeystoreError(
        f"ROS_DOMAIN_ID is {domain}, but keystore '{root}' is for domain {domains} only",
        "A node that joins any other domain with it is refused by DDS.",
        f"Set ROS_DOMAIN_ID to {domains}, or make a keystore with --domain {domain}.",
    )


@dataclass(frozen=True, slots=True)
class Granted:
    """A signed permissions document, not verified yet, with its SHA-256.

    ``grant`` is the first that fits a subject, which is the one that DDS reads, or None.
    """

    signed: smime.SignedDocument
    digest: str
    grant: Grant | None


def read_granted(path: Path, subject: str) -> Granted:
    """Read what a ``permissions.p7s`` grants to a subject; raises where it is no such document."""
    message = read_bytes(path, "permissions document")
    signed = smime.parse(message)
    grants = parse_permissions(signed.document, f"'{path}'").grants
    grant = next((each for each in grants if each.subject == subject), None)
    return Granted(signed, hashlib.sha256(message).hexdigest(), grant)


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
class OpenedEnclave:
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


def open_enclave(folder: Path, *, now: datetime, domain: int | None = None) -> OpenedEnclave:
    """Read and check the files of an enclave; with ``domain``, also whether it may join that."""
    return _EnclaveFiles(folder, now).run(domain)


class _EnclaveFiles:
    def __init__(self, folder: Path, now: datetime) -> None:
        self._folder = folder
        self._now = now
        self._problems: list[Problem] = []
        self._permissions_document = b""

    def run(self, domain: int | None) -> OpenedEnclave:
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
        return OpenedEnclave(
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
