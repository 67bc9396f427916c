"""Tells whether a process can run in an enclave: every check that DDS makes when it starts.

The checks follow what Fast DDS 2.14.5 and Cyclone DDS 0.10 do when a participant is created, and
name the cause where these stay silent.
"""

from __future__ import annotations

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
from sros_tool.dds.permissions import Permissions, parse_permissions
from sros_tool.errors import SrosError
from sros_tool.keystore.layout import REQUIRED_FILES
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
from sros_tool.xml import read_bytes

Parsed = TypeVar("Parsed")

_OWN = "cert.pem"
_ENCRYPTED = re.compile(rb"ENCRYPTED")
_SIGNED = re.compile(rb"(?i)multipart/signed|application/(?:x-)?pkcs7-mime")


@dataclass(frozen=True, slots=True)
class Problem:
    """Something that keeps a process from running in an enclave; ``file`` is what it lies in.

    ``code`` is a stable word for programs, such as ``key-mismatch`` or ``certificate-expired``.
    """

    file: str
    text: str
    code: str = ""

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
            governance = self._parsed("governance.p7s", document, _governance)
        if (document := self._signed("permissions.p7s", files, permissions_ca)) is not None:
            self._permissions_document = document
            permissions = self._parsed("permissions.p7s", document, parse_permissions)
        if governance and domain is not None and domain not in governance.domains().closed():
            self._fault(
                "governance.p7s",
                f"it is for domain {governance.domains().closed()}, not for {domain}",
                "governance-domain",
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

    def _fault(self, file: str, text: str, code: str) -> None:
        self._problems.append(Problem(file, text, code))

    def _read(self, name: str) -> bytes | None:
        path = self._folder / name
        if not path.exists():
            if path.is_symlink():
                self._fault(name, f"it is a link to nothing ({path.readlink()})", "link-dangling")
            else:
                self._fault(name, "missing", "file-missing")
            return None
        try:
            data = read_bytes(path, "file")
        except SrosError as error:
            self._fault(name, f"it cannot be read: {error.why.rstrip('.')}", "file-unreadable")
            return None
        if not data:
            self._fault(name, "it is empty", "file-empty")
            return None
        return data

    def _certificate(self, name: str, files: dict[str, bytes | None]) -> x509.Certificate | None:
        data = files[name]
        if data is None:
            return None
        try:
            certificate = _certificate(data, name)
        except SrosError as error:
            self._fault(name, error.why.rstrip("."), "certificate-malformed")
            return None
        self._valid_now(name, validity_of(certificate), "certificate" if name == _OWN else "ca")
        return certificate

    def _valid_now(self, name: str, validity: Window, what: str) -> None:
        if self._now > validity.not_after:
            self._fault(name, f"it expired at {iso(validity.not_after)}", f"{what}-expired")
        elif self._now < validity.not_before:
            begin = iso(validity.not_before)
            self._fault(name, f"it is not valid before {begin}", f"{what}-not-yet-valid")

    def _identity(
        self, certificate: x509.Certificate | None, ca: x509.Certificate | None, key: bytes | None
    ) -> None:
        if certificate and ca and not issued_by(certificate, ca):
            self._fault(
                "cert.pem",
                f"it was not issued by the identity CA of the enclave ({subject_text(ca.subject)}) "
                f"but by {subject_text(certificate.issuer)}",
                "certificate-issuer",
            )
        if key is None:
            return
        try:
            private = load_key(key, "key.pem")
        except SrosError as error:
            code = "key-encrypted" if _ENCRYPTED.search(key) else "key-malformed"
            self._fault("key.pem", error.why.rstrip("."), code)
            return
        if certificate and not same_key(certificate, private):
            self._fault("key.pem", "it is not the key of cert.pem", "key-mismatch")

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
            self._fault("crl.pem", text, "crl-malformed")
            return
        if not authentic:
            text = "it is not of the identity CA, and DDS then refuses everybody"
            self._fault("crl.pem", text, "crl-issuer")
        if crl.last_update_utc > self._now:
            self._fault(
                "crl.pem",
                f"it is not valid before {iso(crl.last_update_utc)}: everybody is refused",
                "crl-not-yet-valid",
            )
        if crl.next_update_utc and crl.next_update_utc < self._now:
            text = f"it expired at {iso(crl.next_update_utc)}: everybody is refused"
            self._fault("crl.pem", text, "crl-expired")
        if certificate and crl.get_revoked_certificate_by_serial_number(certificate.serial_number):
            self._fault("cert.pem", "it is revoked by crl.pem", "revoked")

    def _signed(
        self, name: str, files: dict[str, bytes | None], authority: x509.Certificate | None
    ) -> bytes | None:
        data = files[name]
        if data is None:
            return None
        try:
            return _content(data, authority)
        except SrosError as error:
            code = "signature" if _SIGNED.search(data[:1000]) else "not-signed"
            self._fault(name, str(error), code)
            return None

    def _parsed(
        self, name: str, document: bytes, read: Callable[[bytes, str], Parsed]
    ) -> Parsed | None:
        try:
            return read(document, name)
        except SrosError as error:
            code = f"{name.removesuffix('.p7s')}-malformed"
            self._fault(name, error.why.rstrip(".") or error.what, code)
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
            self._fault(name, text, "permissions-subject")
            return
        grant = grants[0]
        try:
            self._valid_now(name, grant.validity, "permissions")
        except SrosError as error:  # it ends before it begins
            self._fault(name, error.what, "permissions-malformed")
        rules = [rule for rule in grant.rules if rule.allow]
        if domain is not None and not any(domain in rule.domains.closed() for rule in rules):
            text = f"no rule of it allows anything in domain {domain}"
            self._fault(name, text, "permissions-domain")
