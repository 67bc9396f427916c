"""The only reader of keystores and enclaves: their files, their grants, and their problems.

It repeats the checks that Fast DDS 2.14.5 and Cyclone DDS 0.10 make when a participant is created,
and names the cause of a refusal, which the vendors seldom do.  `sros_tool.keystore.loading` has the
differences between vendors.
"""

from __future__ import annotations

import hashlib
import os
import re
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from datetime import datetime
from functools import cached_property, lru_cache
from pathlib import Path
from shlex import quote
from typing import TYPE_CHECKING, TypeVar

from cryptography import x509
from cryptography.hazmat.primitives.asymmetric import rsa

from sros_tool.dds.domains import DomainSet
from sros_tool.dds.governance import Governance, parse_governance
from sros_tool.dds.permissions import Grant, Permissions, parse_permissions
from sros_tool.errors import DocumentError, KeystoreError, PkiError, SrosError
from sros_tool.faults import Fault
from sros_tool.keystore.layout import (
    CERTIFICATE_FILE,
    CRL,
    CRL_FILE,
    GOVERNANCE_FILE,
    GOVERNANCE_P7S,
    IDENTITY,
    IDENTITY_CA_FILE,
    KEY_FILE,
    KEY_URI_FILE,
    PERMISSIONS,
    PERMISSIONS_CA_FILE,
    PERMISSIONS_FILE,
    PRIVATE,
    PUBLIC,
    REQUIRED_FILES,
    ROLES,
    SETTINGS,
    STAGE,
    ca_certificate,
    check_keystore,
    enclave_names,
    enclave_path,
    key_on_robot,
)
from sros_tool.pki import smime
from sros_tool.pki.certificates import (
    is_for_pss,
    issued_by,
    load_certificate,
    load_certificates,
    other_issuer,
    subject_text,
    validity_of,
    weakness,
)
from sros_tool.pki.chains import chain_fault
from sros_tool.pki.crl import (
    CRL_MARK,
    RevocationList,
    lists_as_revoked,
    load_crl,
    may_sign_lists,
    read_list,
    refusal_of,
    signed_by,
)
from sros_tool.pki.keys import is_key_for_pss, load_any_key
from sros_tool.pki.kinds import XML, kind_of
from sros_tool.pki.token_uri import TokenUri, read_token_file
from sros_tool.validity import Window, iso
from sros_tool.values import shows
from sros_tool.xml import read_bytes

if TYPE_CHECKING:
    from sros_tool.keystore.ledger import Ledger
    from sros_tool.keystore.template import Template

_Parsed = TypeVar("_Parsed")


# ── a keystore ─────────────────────────────────────────────────────────────────────────────


class OpenedKeystore:
    """A keystore, or an export for a robot, opened for reading.

    Each property reads its file at the first access; it raises `SrosError` if the file exists and
    cannot be read.
    """

    def __init__(self, root: Path) -> None:
        self.root = root

    @property
    def is_home(self) -> bool:
        """Whether it is a keystore with CAs or settings, not an export for a robot."""
        return any((self.root / part).exists() for part in (PUBLIC, PRIVATE, SETTINGS))

    @cached_property
    def names(self) -> tuple[str, ...]:
        """The sorted names of the enclaves; raises `KeystoreError` if one may be missing."""
        return enclave_names(self.root)

    @cached_property
    def settings(self) -> Template | None:
        """The settings; None for a keystore of ros2/sros2 and for an export."""
        return load_settings(self.root) if (self.root / SETTINGS).exists() else None

    @cached_property
    def governance(self) -> Governance:
        """The governance that DDS loads, with its signature verified."""
        return governance_of(self.root)

    @cached_property
    def domains(self) -> DomainSet:
        """The ROS domains that the governance names."""
        return self.governance.domains().closed()

    @cached_property
    def revocation_list(self) -> RevocationList | None:
        """The revocation list of the issuing identity CA, or None if the keystore has no list."""
        return read_crl(self.root)

    @cached_property
    def ledger(self) -> Ledger:
        """The ledger of all issued files; empty without a ledger."""
        from sros_tool.keystore.ledger import read_ledger

        return read_ledger(self.root)

    def authority(self, role: str) -> tuple[x509.Certificate, ...]:
        """Return the certificates in a CA's file, the issuing CA first; empty without a file."""
        path = self.root / ca_certificate(role)
        if not path.exists():
            return ()
        return load_certificates(read_bytes(path, "certificate"), f"'{path}'")

    def enclave(self, name: str, *, now: datetime, domain: int | None = None) -> OpenedEnclave:
        """Return an enclave of the keystore, as `open_enclave` does."""
        return open_enclave(enclave_path(self.root, name), now=now, domain=domain)


def open_keystore(root: Path) -> OpenedKeystore:
    """Return the keystore ``root``, opened for reading.

    Raises:
        KeystoreError: ``root`` is not a keystore.
    """
    check_keystore(root)
    return OpenedKeystore(root)


def load_settings(root: Path) -> Template:
    """Return the settings of a keystore; without settings, the template for ros2/sros2.

    Raises:
        DocumentError: the settings are malformed.
    """
    from sros_tool.keystore.template import load_template, read_template

    path = root / SETTINGS
    if not path.exists():
        return load_template("sros2")
    remedy = "Correct the file, or write the settings of before again with `sros update_keystore "
    return read_template(path, "settings file", f"{remedy}{quote(str(root))} --discard-edits`.")


def load_governance(root: Path, authority: x509.Certificate) -> Governance:
    """Return the governance that DDS loads, after verifying that ``authority`` signed it.

    Raises:
        KeystoreError: the governance is missing or malformed, or its signature does not verify.
    """
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
    """Return the governance that DDS loads, verified with the permissions CA of the keystore."""
    return load_governance(root, load_ca_certificate(root, PERMISSIONS))


def check_domain(domains: DomainSet, domain: int | None, root: Path) -> None:
    """Raise `KeystoreError` if ``domain`` is given and not among ``domains``."""
    if domain is None or domain in domains:
        return
    raise KeystoreError(
        f"ROS_DOMAIN_ID is {domain}, but keystore '{root}' is for domain {domains} only",
        "In any other domain, DDS refuses a node with this keystore.",
        f"Set ROS_DOMAIN_ID to {domains}, or add the domain with `sros update_keystore "
        f"{quote(str(root))} --domain {domains},{domain} --allow-looser`.",
    )


# ── CAs ────────────────────────────────────────────────────────────────────────────────────


def read_certificate(path: Path, what: str = "certificate") -> x509.Certificate:
    """Return the first certificate of a PEM file; ``what`` describes the file in errors.

    Raises:
        SrosError: the file is missing, or is not a readable certificate.
    """
    return load_certificate(read_bytes(path, what), f"'{path}'")


def load_ca_certificate(root: Path, role: str) -> x509.Certificate:
    """Return the certificate of the issuing identity or permissions CA of a keystore."""
    return read_certificate(root / ca_certificate(role), f"{role} CA certificate")


def authority_files(root: Path) -> dict[str, tuple[str, ...]]:
    """Map the stem of each CA file to the roles of its CA.

    Raises:
        KeystoreError: a CA file is missing, or is a link to a file outside of the keystore.
    """
    found: dict[str, tuple[str, ...]] = {}
    for role in ROLES:
        path = root / ca_certificate(role)
        file = path
        # A link into the stage, left by an interrupted transaction, stands for the file itself.
        if path.is_symlink() and STAGE not in (to := str(path.readlink())):
            file = path.parent / to
        if not file.is_file() or file.parent != path.parent:
            raise KeystoreError(
                f"keystore '{root}' has no {role} CA",
                f"'{path}' is missing, or is a link to a file outside of the keystore.",
                "Use the keystore that this one was exported from.",
            )
        stem = file.name.removesuffix(".cert.pem")
        found[stem] = (*found.get(stem, ()), role)
    return found


def identity_file(root: Path) -> str | None:
    """Return the stem of the identity CA's file; None for an export, which has no CA files."""
    with suppress(KeystoreError):
        return next(file for file, roles in authority_files(root).items() if IDENTITY in roles)
    return None


def certificates_of(root: Path, file: str) -> tuple[x509.Certificate, ...]:
    """Return all certificates of a CA file, the issuing CA first."""
    path = root / PUBLIC / f"{file}.cert.pem"
    return load_certificates(read_bytes(path, "CA certificate"), f"'{path}'")


def embedded_crl(root: Path, file: str) -> RevocationList | None:
    """Return the revocation list in a CA file, after its certificates, or None."""
    path = root / PUBLIC / f"{file}.cert.pem"
    data = read_bytes(path, "CA certificate")
    return load_crl(data, f"in '{path}'") if CRL_MARK in data else None


def read_crl(root: Path) -> RevocationList | None:
    """Return the revocation list of the issuing identity CA; None if the keystore has no list."""
    path = root / CRL
    if not path.exists():
        return None
    return load_crl(read_bytes(path, "revocation list"), f"'{path}'")


def read_lists(root: Path) -> tuple[RevocationList, ...]:
    """Return the revocation lists that DDS reads: of the issuing identity CA, and of the other one.

    Only during a rotation is there another identity CA.
    """
    file = identity_file(root)
    found = (read_crl(root), embedded_crl(root, file) if file else None)
    return tuple(each for each in found if each)


# ── signed permissions ─────────────────────────────────────────────────────────────────────


@dataclass(frozen=True, slots=True)
class SignedGrant:
    """A signed permissions document, not verified yet, and its grant to one subject.

    ``digest`` is the SHA-256 of the whole file, in hexadecimal.  ``grant`` is the first grant for
    the subject, which is the one that DDS reads, or None.
    """

    signed: smime.SignedDocument
    digest: str
    grant: Grant | None


def read_signed_grant(path: Path, subject: str) -> SignedGrant:
    """Read a ``permissions.p7s`` and its grant to ``subject``, without verifying its signature.

    Raises:
        SrosError: the file is not a signed permissions document.
    """
    message = read_bytes(path, "permissions document")
    signed = smime.parse(message)
    permissions = parse_permissions(signed.document, f"'{path}'")
    return SignedGrant(signed, hashlib.sha256(message).hexdigest(), permissions.grant_of(subject))


# ── an enclave ─────────────────────────────────────────────────────────────────────────────


@shows("file", "text", "code")
@dataclass(frozen=True, slots=True)
class Problem:
    """A fault of an enclave, with the file that has it and the reason as a clause."""

    file: str
    text: str
    fault: Fault

    @property
    def code(self) -> str:
        """The stable id of the fault, for programs, such as ``key-mismatch``."""
        return self.fault.id

    def __str__(self) -> str:
        return f"{self.file}: {self.text}"


@dataclass(frozen=True)
class OpenedEnclave:
    """The content of an enclave's files as far as they can be read, and their problems.

    ``permissions_bytes`` is the size of ``permissions.p7s``.
    """

    certificate: x509.Certificate | None
    identity_ca: x509.Certificate | None
    permissions_ca: x509.Certificate | None
    governance: Governance | None
    permissions: Permissions | None
    permissions_bytes: int
    problems: tuple[Problem, ...]
    files: Mapping[str, bytes] = field(default_factory=dict, repr=False)
    """The content of the files that can be read, by name: the required ones, and ``crl.pem``."""
    permissions_document: bytes = field(default=b"", repr=False)
    """The XML in ``permissions.p7s``, even if malformed; empty if its signature is not valid."""
    key_on_robot: bool = False
    """Whether the key was generated on the robot and stays there."""
    token: TokenUri | None = None
    """The place of the key on a PKCS#11 token, which ``key.p11`` names.

    The key is not compared with the certificate, because no token is opened to read an enclave.
    """
    public_key: object = field(default=None, repr=False)
    """The public key of ``key.pem``; None if that cannot be read."""

    @cached_property
    def subject(self) -> str:
        """The subject of the enclave's certificate, or ""."""
        return subject_text(self.certificate.subject) if self.certificate else ""

    @cached_property
    def grant(self) -> Grant | None:
        """The grant that DDS reads: the first for the subject of the certificate."""
        return self.permissions.grant_of(self.subject) if self.permissions else None

    @property
    def problems_at_home(self) -> tuple[Problem, ...]:
        """The problems, except the missing key of an enclave whose key is on the robot."""
        if not self.key_on_robot:
            return self.problems
        return tuple(
            each
            for each in self.problems
            if (each.file, each.fault) != (KEY_FILE, Fault.FILE_MISSING)
        )

    def domains(self) -> DomainSet | None:
        """Return the ROS domains that the governance names, or None without governance."""
        return self.governance.domains().closed() if self.governance else None

    def joined_domains(self) -> DomainSet | None:
        """Return the ROS domains that governance and permissions name, or None without governance.

        If they have none in common, those of the governance: what is wrong is a problem.
        """
        governed = self.domains()
        if governed is None or self.grant is None:
            return governed
        allowed = self.grant.domains()
        common = DomainSet.of(*((each, each) for each in governed if each in allowed))
        return common if common.ranges else governed

    def valid_until(self) -> datetime | None:
        """Return the first expiry among its certificates and its grant, in UTC.

        Return None if the certificate or the permissions, or their dates, cannot be read.
        """
        if not (self.certificate and self.permissions):
            return None
        certificates = (self.certificate, self.identity_ca, self.permissions_ca)
        moments = [validity_of(each).not_after for each in certificates if each]
        try:
            moments += [self.grant.validity.not_after] if self.grant else []
        except DocumentError:
            return None
        except SrosError:  # a grant that expires before it begins
            pass
        return min(moments)


def weaknesses(state: OpenedEnclave) -> Iterator[tuple[str, str]]:
    """Yield weak cryptography in an enclave's files: the name of the file, and a clause."""
    for file in (IDENTITY_CA_FILE, PERMISSIONS_CA_FILE, CERTIFICATE_FILE):
        with suppress(SrosError):
            for each in load_certificates(state.files.get(file, b""), file):
                if text := weakness(each):
                    yield file, text
    for file in (GOVERNANCE_FILE, PERMISSIONS_FILE):
        with suppress(SrosError):
            if text := smime.parse(state.files.get(file, b"")).weakness():
                yield file, text


def open_enclave(folder: Path, *, now: datetime, domain: int | None = None) -> OpenedEnclave:
    """Return the content of an enclave's files, and their problems at the time ``now``.

    With ``domain``, also check whether the enclave may join that ROS domain.
    """
    return _EnclaveFiles(folder, now).check(domain)


_EXPIRY_OF_CERTIFICATE = (Fault.CERTIFICATE_EXPIRED, Fault.CERTIFICATE_NOT_YET_VALID)
_EXPIRY_OF_CA = (Fault.CA_EXPIRED, Fault.CA_NOT_YET_VALID)
_EXPIRY_OF_PERMISSIONS = (Fault.PERMISSIONS_EXPIRED, Fault.PERMISSIONS_NOT_YET_VALID)

_ENCRYPTED = re.compile(rb"ENCRYPTED")
_SIGNED = re.compile(rb"(?i)multipart/signed|application/(?:x-)?pkcs7-mime")

# The enclaves of a keystore share some files, which are parsed only once.
_parse_governance = lru_cache(maxsize=8)(parse_governance)


@lru_cache(maxsize=8)
def _signed_document(message: bytes, authority: x509.Certificate | None) -> bytes:
    signed = smime.parse(message)
    if authority:
        signed.verify(authority)
    return signed.document


@lru_cache(maxsize=8)
def _load_crl(
    data: bytes, authority: x509.Certificate | None, authorities: bytes
) -> tuple[x509.CertificateRevocationList, x509.Certificate | None]:
    """Return a revocation list, and the CA of the file ``authorities`` that signed it, or None."""
    crl = read_list(data, CRL_FILE)
    trusted: tuple[x509.Certificate, ...] = (authority,) if authority else ()
    with suppress(SrosError):
        trusted = load_certificates(authorities, IDENTITY_CA_FILE)
    return crl, next((each for each in trusted if signed_by(crl, each)), None)


class _EnclaveFiles:
    """Checker of the files of one enclave, which collects the problems."""

    def __init__(self, folder: Path, now: datetime) -> None:
        self._folder = folder
        self._now = now
        self._problems: list[Problem] = []

    def check(self, domain: int | None) -> OpenedEnclave:
        token_file = self._read_token_file()
        files = {
            name: self._read(name)
            for name in REQUIRED_FILES
            if name != KEY_FILE or token_file is None or (self._folder / name).exists()
        }
        files.setdefault(KEY_FILE, None)
        token = self._token(token_file, files[KEY_FILE]) if token_file is not None else None
        identity_ca = self._certificate(IDENTITY_CA_FILE, files)
        permissions_ca = self._certificate(PERMISSIONS_CA_FILE, files)
        certificate = self._certificate(CERTIFICATE_FILE, files)
        public_key = self._check_identity(certificate, identity_ca, files)
        files[CRL_FILE] = self._check_revocation(certificate, identity_ca, files[IDENTITY_CA_FILE])
        governance = permissions = None
        document = self._signed(GOVERNANCE_FILE, files, permissions_ca)
        if document is not None:
            governance = self._parsed(
                GOVERNANCE_FILE, document, _parse_governance, Fault.GOVERNANCE_MALFORMED
            )
        document = self._signed(PERMISSIONS_FILE, files, permissions_ca)
        if document is not None:
            permissions = self._parsed(
                PERMISSIONS_FILE, document, parse_permissions, Fault.PERMISSIONS_MALFORMED
            )
        if governance and domain is not None and domain not in governance.domains().closed():
            text = f"it is for domain {governance.domains().closed()}, not for {domain}"
            self._add(GOVERNANCE_FILE, text, Fault.GOVERNANCE_DOMAIN)
        if permissions and certificate:
            self._check_grant(permissions, certificate, domain)
        return OpenedEnclave(
            certificate,
            identity_ca,
            permissions_ca,
            governance,
            permissions,
            len(files[PERMISSIONS_FILE] or b""),
            tuple(self._problems),
            {name: data for name, data in files.items() if data is not None},
            document or b"",
            key_on_robot(self._folder),
            token,
            public_key,
        )

    def _add(self, file: str, text: str, fault: Fault) -> None:
        self._problems.append(Problem(file, text, fault))

    def _read(self, name: str) -> bytes | None:
        path = self._folder / name
        if not path.exists():
            if path.is_symlink():
                text = f"it is a broken link ({path.readlink()})"
                self._add(name, text, Fault.LINK_DANGLING)
            else:
                self._add(name, "missing", Fault.FILE_MISSING)
            return None
        data = self._content(path, "file")
        if data is None:
            return None
        if not data:
            self._add(name, "it is empty", Fault.FILE_EMPTY)
            return None
        return data

    def _content(self, path: Path, what: str) -> bytes | None:
        try:
            return read_bytes(path, what)
        except SrosError as error:
            if path.is_file():
                text = f"it cannot be read: {error.clause}"
                self._add(path.name, text, Fault.FILE_UNREADABLE)
            else:
                text = f"it is {'a folder' if path.is_dir() else 'not a regular file'}"
                self._add(path.name, text, Fault.FILE_NO_FILE)
            return None

    def _read_token_file(self) -> bytes | None:
        path = self._folder / KEY_URI_FILE
        return self._read(KEY_URI_FILE) or b"" if os.path.lexists(path) else None

    def _token(self, data: bytes, key: bytes | None) -> TokenUri | None:
        """Return the key that ``key.p11`` names; ``key`` is that of ``key.pem``."""
        if key is not None:
            text = f"{KEY_FILE} is there, too"
            self._add(KEY_URI_FILE, text, Fault.KEY_TWICE)
        if not data:  # it was reported already
            return None
        try:
            return read_token_file(data)
        except PkiError as error:
            self._add(KEY_URI_FILE, error.clause, Fault.TOKEN_URI)
            return None

    def _certificate(self, name: str, files: dict[str, bytes | None]) -> x509.Certificate | None:
        data = files[name]
        if data is None:
            return None
        try:
            certificate = load_certificate(data, name)
        except SrosError as error:
            self._add(name, error.clause, Fault.CERTIFICATE_MALFORMED)
            return None
        faults = _EXPIRY_OF_CERTIFICATE if name == CERTIFICATE_FILE else _EXPIRY_OF_CA
        self._check_validity(name, validity_of(certificate), faults)
        return certificate

    def _check_validity(self, name: str, validity: Window, faults: tuple[Fault, Fault]) -> None:
        """Add the first of ``faults`` if ``validity`` is over, the second if it has not begun."""
        expired, not_yet_valid = faults
        if self._now > validity.not_after:
            self._add(name, f"it expired at {iso(validity.not_after)}", expired)
        elif self._now < validity.not_before:
            self._add(name, f"it is not valid before {iso(validity.not_before)}", not_yet_valid)

    def _check_identity(
        self,
        certificate: x509.Certificate | None,
        ca: x509.Certificate | None,
        files: Mapping[str, bytes | None],
    ) -> object:
        """Check certificate and key; return the public key of ``key.pem``, or None."""
        key, authorities = files[KEY_FILE], files[IDENTITY_CA_FILE]
        if certificate and ca and not issued_by(certificate, ca):
            text = (
                f"it was not issued by the identity CA of the enclave ({subject_text(ca.subject)}) "
                f"but by {other_issuer(certificate, ca)}"
            )
            if refusal := self._fault_with_all(certificate, authorities or b""):
                text += f"; with all CAs of the file, {refusal}"
            self._add(CERTIFICATE_FILE, text, Fault.CERTIFICATE_ISSUER)
        elif certificate and ca and authorities and not self._problems:
            self._check_chain(certificate, authorities)
        if key is None:
            return None
        try:
            public_key = load_any_key(key, KEY_FILE).public_key()
        except SrosError as error:
            fault = Fault.KEY_ENCRYPTED if _ENCRYPTED.search(key) else Fault.KEY_MALFORMED
            self._add(KEY_FILE, error.clause, fault)
            return None
        if certificate and certificate.public_key() != public_key:
            self._add(KEY_FILE, "it is not the key of cert.pem", Fault.KEY_MISMATCH)
        elif certificate and isinstance(public_key, rsa.RSAPublicKey):
            names = ("an RSA key", "an RSA key for RSA-PSS alone")
            said, wanted = is_key_for_pss(key), is_for_pss(certificate)
            if said != wanted:
                text = f"it is {names[said]}, and cert.pem is for {names[wanted]}"
                self._add(KEY_FILE, text, Fault.KEY_MISMATCH)
        return public_key

    def _fault_with_all(self, certificate: x509.Certificate, authorities: bytes) -> str:
        """Return why no chain of all CAs of a file is valid if its issuer is among them, or ""."""
        with suppress(SrosError):
            chain = load_certificates(authorities, "")
            if any(issued_by(certificate, each) for each in chain):
                return chain_fault(certificate, chain, at=self._now)
        return ""

    def _check_chain(self, certificate: x509.Certificate, authorities: bytes) -> None:
        try:
            chain = load_certificates(authorities, "")
        except SrosError as error:  # in a certificate after the first one
            self._add(IDENTITY_CA_FILE, error.clause, Fault.CERTIFICATE_MALFORMED)
            return
        if refusal := chain_fault(certificate, chain, at=self._now):
            self._add(CERTIFICATE_FILE, f"it is refused: {refusal}", Fault.CERTIFICATE_ISSUER)

    def _check_revocation(
        self,
        certificate: x509.Certificate | None,
        ca: x509.Certificate | None,
        authorities: bytes | None,
    ) -> bytes | None:
        """Check and return the revocation list; None without a list that can be read."""
        path = self._folder / CRL_FILE
        if not path.exists():
            return None
        data = self._content(path, "revocation list")
        if data is None:
            return None
        try:
            crl, signer = _load_crl(data, ca, authorities or b"")
        except SrosError as error:
            self._add(CRL_FILE, error.clause, Fault.CRL_MALFORMED)
            return data
        if ca and not signer:
            text = "it is not of the identity CA, so DDS refuses every participant"
            self._add(CRL_FILE, text, Fault.CRL_ISSUER)
        if signer and not may_sign_lists(signer):
            text = (
                f"the keyUsage of its CA, {subject_text(signer.subject)}, lacks cRLSign, so DDS "
                "refuses every participant"
            )
            self._add(CRL_FILE, text, Fault.CRL_USAGE)
        if refusal := refusal_of(crl):
            text = f"{refusal}, so DDS refuses every participant"
            self._add(CRL_FILE, text, Fault.CRL_PARTIAL)
        if crl.last_update_utc > self._now:
            text = (
                f"it is not valid before {iso(crl.last_update_utc)}: every participant is refused"
            )
            self._add(CRL_FILE, text, Fault.CRL_NOT_YET_VALID)
        if crl.next_update_utc and crl.next_update_utc < self._now:
            text = f"it expired at {iso(crl.next_update_utc)}: every participant is refused"
            self._add(CRL_FILE, text, Fault.CRL_EXPIRED)
        if certificate and lists_as_revoked(crl, certificate.serial_number):
            self._add(CERTIFICATE_FILE, "it is revoked by crl.pem", Fault.REVOKED)
        return data

    def _signed(
        self, name: str, files: dict[str, bytes | None], authority: x509.Certificate | None
    ) -> bytes | None:
        data = files[name]
        if data is None:
            return None
        try:
            return _signed_document(data, authority)
        except SrosError as error:
            fault = Fault.SIGNATURE if _SIGNED.search(data[:1000]) else Fault.NOT_SIGNED
            self._add(name, str(error), fault)
            return None

    def _parsed(
        self,
        name: str,
        document: bytes,
        read: Callable[[bytes, str], _Parsed],
        malformed: Fault,
    ) -> _Parsed | None:
        try:
            return read(document, name)
        except SrosError as error:
            kind = kind_of(document)
            what = f"what is signed in it is {kind}, and not XML in UTF-8"
            text = error.clause if kind in ("", XML) else what
            self._add(name, text, malformed)
            return None

    def _check_grant(
        self, permissions: Permissions, certificate: x509.Certificate, domain: int | None
    ) -> None:
        name = PERMISSIONS_FILE
        subject = subject_text(certificate.subject)
        grant = permissions.grant_of(subject)
        if grant is None:
            others = ", ".join(each.subject for each in permissions.grants)
            text = f"it has no grant for {subject}, only for {others or 'nobody'}"
            self._add(name, text, Fault.PERMISSIONS_SUBJECT)
            return
        try:
            self._check_validity(name, grant.validity, _EXPIRY_OF_PERMISSIONS)
        except SrosError as error:  # it expires before it begins
            self._add(name, error.what, Fault.PERMISSIONS_MALFORMED)
        rules = [rule for rule in grant.rules if rule.allow]
        if domain is not None and not any(domain in rule.domains.closed() for rule in rules):
            text = f"none of its rules allows anything in domain {domain}"
            self._add(name, text, Fault.PERMISSIONS_DOMAIN)
