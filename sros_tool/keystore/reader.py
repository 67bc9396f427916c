"""The only reader of keystores and enclaves: their files, their grants, and their problems.

The reader repeats the checks that Fast DDS 2.14.5 and Cyclone DDS 0.10 make when a participant is
created, and names the cause of a refusal, which vendors seldom do.  `sros_tool.keystore.loading`
has the differences between vendors.
"""

from __future__ import annotations

import hashlib
import os
import re
from collections.abc import Callable, Hashable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from datetime import datetime
from functools import cached_property, lru_cache, wraps
from pathlib import Path
from shlex import quote
from typing import TYPE_CHECKING, Concatenate, Generic, NamedTuple, ParamSpec, TypeVar, overload

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
    LEDGER,
    LEDGER_HEAD,
    PERMISSIONS,
    PERMISSIONS_CA_FILE,
    PERMISSIONS_FILE,
    PRIVATE,
    PUBLIC,
    REQUIRED_FILES,
    ROLES,
    SETTINGS,
    STAGE,
    ca_certificate_path,
    check_keystore,
    enclave_names,
    enclave_path,
    how_to_add_domains,
    is_enclave,
    is_original_keystore,
    key_on_robot,
)
from sros_tool.keystore.ledger import Entry, Ledger, LedgerFile
from sros_tool.pki import smime
from sros_tool.pki.certificates import (
    extension,
    is_for_pss,
    issued_by,
    load_certificate,
    load_certificates,
    other_issuer_text,
    subject_text,
    validity_of,
    weakness,
)
from sros_tool.pki.chains import chain_fault
from sros_tool.pki.crl import (
    CRL_MARK,
    RevocationList,
    last_update,
    lists_as_revoked,
    load_crl,
    may_sign_lists,
    next_update,
    read_list,
    refusal_of,
    signed_by,
)
from sros_tool.pki.keys import is_key_for_pss, load_any_key
from sros_tool.pki.pem import XML, kind_of
from sros_tool.validity import Window, iso
from sros_tool.values import shows
from sros_tool.xml import MAX_BYTES, read_bytes, read_file

if TYPE_CHECKING:
    from sros_tool.keystore.template import Template
    from sros_tool.pki.token import TokenUri

_Parsed = TypeVar("_Parsed")


# ── files that are read once ───────────────────────────────────────────────────────────────


class FilesReadOnce:
    """A cache that reads each file at most once, even if it is reached through different links.

    The content that was read first is kept for a path.  A file that could not be read fails again.
    Once the cache holds 16 MiB, it `is_full`, and other files are read each time.
    """

    def __init__(self) -> None:
        self._size = 0
        self._by_path: dict[str, bytes] = {}
        self._by_file: dict[tuple[int, int, int, int], bytes] = {}
        self._errors: dict[tuple[str, str], SrosError] = {}
        self._signed: dict[bytes, smime.SignedDocument | SrosError] = {}

    def read(self, path: Path, label: str, *, max_bytes: int = MAX_BYTES) -> bytes:
        """Return the content of a regular file, as `sros_tool.xml.read_bytes` does.

        Raises:
            DocumentError: the file does not exist, cannot be read, is too large or not regular.
        """
        name = os.fspath(path)
        data = self._by_path.get(name)
        if data is not None and len(data) <= max_bytes:
            return data
        if error := self._errors.get((name, label)):
            raise error.with_traceback(None)
        try:
            data = self._read(path, label, max_bytes)
        except SrosError as error:
            self._errors[name, label] = error
            raise
        if not self.is_full:
            self._by_path[name] = data
        return data

    @property
    def is_full(self) -> bool:
        """Whether the cache accepts no further files."""
        return self._size > _MOST_CACHED_BYTES

    def _read(self, path: Path, label: str, max_bytes: int) -> bytes:
        with suppress(OSError, ValueError):  # `read_file` reports what is wrong with a path
            data = self._by_file.get(_file_identity(path.stat()))
            if data is not None and len(data) <= max_bytes:
                return data
        state, data = read_file(path, label, max_bytes=max_bytes)
        if not self.is_full:
            self._by_file[_file_identity(state)] = data
            self._size += len(data)
        return data

    def signed_document(self, message: bytes) -> smime.SignedDocument:
        """Return the signed document in ``message``; each message is parsed and verified only once.

        Raises:
            PkiError: ``message`` is not a signed message.
        """
        known = self._signed.get(message)
        if known is None:
            try:
                known = smime.parse(message)
            except SrosError as error:
                known = error
            if not self.is_full:
                self._signed[message] = known
        if isinstance(known, SrosError):
            raise known.with_traceback(None)
        return known


_MOST_CACHED_BYTES = 16 * 1024 * 1024


def _file_identity(state: os.stat_result) -> tuple[int, int, int, int]:
    return state.st_dev, state.st_ino, state.st_size, state.st_mtime_ns


# ── a keystore ─────────────────────────────────────────────────────────────────────────────


class _ReadOnceProperty(Generic[_Parsed]):
    """A property of a keystore that is read when it is first used, and then kept."""

    def __init__(self, read: Callable[[OpenedKeystore], _Parsed]) -> None:
        self._read = read
        self.__doc__ = read.__doc__

    @overload
    def __get__(self, keystore: None, owner: object) -> _ReadOnceProperty[_Parsed]: ...
    @overload
    def __get__(self, keystore: OpenedKeystore, owner: object) -> _Parsed: ...
    def __get__(
        self, keystore: OpenedKeystore | None, owner: object
    ) -> _ReadOnceProperty[_Parsed] | _Parsed:
        if keystore is None:
            return self
        return keystore.once(self, lambda: self._read(keystore))


class OpenedKeystore:
    """A keystore, or an export for a robot, opened for reading.

    Every part is read when it is first used, and never again: to see a change, open a new
    `OpenedKeystore`.  A part that exists and cannot be read raises the same `SrosError` each time.

    Args:
        root: the folder of the keystore.
        locked: whether this process has locked the keystore, so that links of a transaction in
            progress are not followed.
        lacks_keys: whether the keystore is a copy that should have no keys, so that `has_keys` is
            false.
    """

    def __init__(self, root: Path, *, locked: bool = False, lacks_keys: bool = False) -> None:
        self.root = root
        self._locked, self._lacks_keys = locked, lacks_keys
        self.forget()

    def __repr__(self) -> str:
        return f"OpenedKeystore({str(self.root)!r})"

    def forget(self) -> None:
        """Forget all parts that were read, so that changes of the keystore are seen."""
        self.files = FilesReadOnce()
        """Cache of the files that were read, in the keystore and next to it."""
        self._parts: dict[Hashable, object] = {}

    def once(self, key: Hashable, read: Callable[[], _Parsed]) -> _Parsed:
        """Return the result of ``read()``, which is called only once for each ``key``.

        If ``read()`` raised an exception, the exception is raised again.  The result for an enclave
        is not kept once `files` is full.
        """
        if key not in self._parts:
            if self.files.is_full and isinstance(key, tuple) and key[0] in _ENCLAVE_PART_KEYS:
                return read()
            try:
                self._parts[key] = read()
            except (SrosError, OSError) as error:
                self._parts[key] = _ReadFailure(error)
        part = self._parts[key]
        if isinstance(part, _ReadFailure):
            raise part.error.with_traceback(None)
        return part  # type: ignore[return-value]

    def read(self, path: str | Path, label: str) -> bytes:
        """Return the content of the file at ``path``; a text is a path relative to the keystore.

        ``label`` describes the file in errors.

        Raises:
            DocumentError: the file does not exist, cannot be read, is too large, or is not a
                regular file.
        """
        return self.files.read(self._path(path), label)

    def _path(self, path: str | Path) -> Path:
        return path if isinstance(path, Path) else self.root / path

    def has(self, path: str) -> bool:
        """Return whether there is a file or folder at ``path``, relative to the keystore."""
        return (self.root / path).exists()

    # ── the kind of keystore ──

    def check(self) -> None:
        """Raise `KeystoreError` if the folder is not a keystore."""
        self.once("check", lambda: check_keystore(self.root))

    @property
    def is_original(self) -> bool:
        """Whether this is a keystore with CAs or settings, not an export for a robot."""
        return any(map(self.has, (PUBLIC, PRIVATE, SETTINGS)))

    @property
    def has_all_enclaves(self) -> bool:
        """Whether every enclave that the keystore's CAs issued is here.

        An export may lack some enclaves, and has the governance only in the folders of its
        enclaves.
        """
        return is_original_keystore(self.root) or self.has(GOVERNANCE_P7S)

    @_ReadOnceProperty
    def was_written_only_by_sros2(self) -> bool:
        """Whether ros2/sros2 made the keystore, and sros has not written to it yet.

        Such a keystore has neither settings nor a ledger, and its CAs have no key identifier.  sros
        gives a key identifier to every CA.  So a keystore of sros does not look like this if
        somebody removes its ledger.  Nobody can exchange the CA certificate for one without an
        identifier either, because only the CA's key can sign it.
        """
        if any(os.path.lexists(self.root / name) for name in (SETTINGS, LEDGER, LEDGER_HEAD)):
            return False
        try:
            return all(
                issued_by(authority, authority)
                and extension(authority, x509.SubjectKeyIdentifier) is None
                for authority in map(self.ca_certificate, ROLES)
            )
        except (SrosError, OSError, ValueError):
            return False

    @_ReadOnceProperty
    def names(self) -> tuple[str, ...]:
        """The sorted names of the enclaves.

        Raises:
            KeystoreError: an enclave may be missing, because a folder cannot be read.
        """
        return enclave_names(self.root)

    @_ReadOnceProperty
    def settings(self) -> Template | None:
        """The settings; None for a keystore of ros2/sros2 and for an export."""
        return self.template if self.has(SETTINGS) else None

    @_ReadOnceProperty
    def template(self) -> Template:
        """The settings of the keystore; without settings, the template for ros2/sros2."""
        from sros_tool.keystore.template import decode_template, load_template

        if not self.has(SETTINGS):
            return load_template("sros2")
        remedy = "Correct the file, or restore the earlier settings with `sros "
        return decode_template(
            self.read(SETTINGS, "settings file"),
            self.root / SETTINGS,
            "settings file",
            f"{remedy}update_keystore {quote(str(self.root))} --discard-edits`.",
        )

    @_ReadOnceProperty
    def ledger_file(self) -> LedgerFile:
        """The file of the ledger, for reading some of its entries or adding entries."""
        return LedgerFile(
            self.root,
            lambda: self._trusted,
            follow_link=not self._locked,
            read_content=self.files.read,
        )

    @property
    def ledger(self) -> Ledger:
        """The ledger of all issued files; empty without a ledger."""
        return self.once("ledger", lambda: self.ledger_file.ledger())

    def ledger_with(self, name: str, value: str) -> Ledger:
        """Return the ledger with at least the entries whose field ``name`` has ``value``."""
        return self.once(("ledger", name, value), lambda: self.ledger_file.with_field(name, value))

    def entries_of(self, what: str) -> Sequence[Entry]:
        """Return the ledger entries of one kind, such as "release", oldest first."""
        entries = self.ledger_with("what", what).entries
        return self.once(("entries", what), lambda: [e for e in entries if e.what == what])

    @property
    def known_releases(self) -> set[int]:
        """The numbers of the releases in the ledger."""
        return {entry.number for entry in self.entries_of("release")}

    @property
    def last_release(self) -> int:
        """The highest number of a release in the ledger; 0 without a release."""
        return max(self.known_releases, default=0)

    # ── CAs ──

    def authority(self, role: str) -> tuple[x509.Certificate, ...]:
        """Return the certificates in a role's CA file, the issuing CA first; () without a file."""
        path = self.root / ca_certificate_path(role)

        def read() -> tuple[x509.Certificate, ...]:
            if not path.exists():
                return ()
            return load_certificates(self.read(path, "certificate"), f"'{path}'")

        return self.once(("authority", role), read)

    def ca_certificate(self, role: str) -> x509.Certificate:
        """Return the certificate of the issuing identity or permissions CA."""
        return self.certificate(ca_certificate_path(role), f"{role} CA certificate")

    def certificate(self, path: str | Path, label: str = "certificate") -> x509.Certificate:
        """Return the first certificate of a PEM file; arguments as for `read`.

        Raises:
            SrosError: the file is missing, or is not a readable certificate.
        """
        path = self._path(path)
        return self.once(
            ("certificate", path, label),
            lambda: load_certificate(self.read(path, label), f"'{path}'"),
        )

    @_ReadOnceProperty
    def _trusted(self) -> list[x509.Certificate]:
        """The certificates of the CAs that the keystore trusts; unreadable files are left out."""
        trusted: list[x509.Certificate] = []
        for role in ROLES:
            with suppress(SrosError):
                trusted += self.authority(role)
        return trusted

    @_ReadOnceProperty
    def authority_files(self) -> Mapping[str, tuple[str, ...]]:
        """Maps the name of each CA file, without suffixes, to the roles of its CA.

        Raises:
            KeystoreError: a CA file is missing, or is a link to a file outside of the keystore.
        """
        stems: dict[str, tuple[str, ...]] = {}
        for role in ROLES:
            path = self.root / ca_certificate_path(role)
            file = path
            # A link into the stage that an interrupted change left stands for the file itself.
            if path.is_symlink() and STAGE not in (to := str(path.readlink())):
                file = path.parent / to
            if not file.is_file() or file.parent != path.parent:
                raise KeystoreError(
                    f"keystore '{self.root}' has no {role} CA",
                    f"'{path}' is missing, or is a link to a file outside of the keystore.",
                    "Restore the file. In place of an export, use the keystore that it comes from.",
                )
            stem = file.name.removesuffix(".cert.pem")
            stems[stem] = (*stems.get(stem, ()), role)
        return stems

    @property
    def identity_file(self) -> str | None:
        """The name, without suffixes, of the identity CA's file; None for an export."""
        with suppress(KeystoreError):
            return next(file for file, roles in self.authority_files.items() if IDENTITY in roles)
        return None

    def certificates_of(self, file: str) -> tuple[x509.Certificate, ...]:
        """Return all certificates in a CA file, the issuing CA first; ``file`` has no suffixes."""
        path = self.root / PUBLIC / f"{file}.cert.pem"
        return self.once(
            ("certificates", file),
            lambda: load_certificates(self.read(path, "CA certificate"), f"'{path}'"),
        )

    def embedded_list(self, file: str) -> RevocationList | None:
        """Return the revocation list in a CA file after the certificates, or None."""
        path = self.root / PUBLIC / f"{file}.cert.pem"

        def read() -> RevocationList | None:
            data = self.read(path, "CA certificate")
            return load_crl(data, f"in '{path}'") if CRL_MARK in data else None

        return self.once(("list", file), read)

    @_ReadOnceProperty
    def revocation_list(self) -> RevocationList | None:
        """The revocation list of the issuing identity CA; None if there is none."""
        path = self.root / CRL
        if not path.exists():
            return None
        return load_crl(self.read(path, "revocation list"), f"'{path}'")

    @property
    def revocation_lists(self) -> tuple[RevocationList, ...]:
        """The revocation lists that DDS reads; there is a second one only in a rotation."""
        file = self.identity_file
        lists = (self.revocation_list, self.embedded_list(file) if file else None)
        return tuple(filter(None, lists))

    @_ReadOnceProperty
    def has_keys(self) -> bool:
        """Whether the folder of any enclave has the key, or says where the key is."""
        return not self._lacks_keys and any(
            os.path.lexists(enclave_path(self.root, name) / file)
            for name in enclave_names(self.root, hidden=True)
            for file in (KEY_FILE, KEY_URI_FILE)
        )

    # ── governance ──

    @_ReadOnceProperty
    def governance(self) -> Governance:
        """The governance that DDS loads, verified with the permissions CA of the keystore.

        Raises:
            KeystoreError: the governance is missing or malformed, or its signature does not verify.
        """
        return self.governance_signed_by(self.ca_certificate(PERMISSIONS))

    def governance_signed_by(self, authority: x509.Certificate) -> Governance:
        """Return the governance that DDS loads, after verifying that ``authority`` signed it.

        Raises:
            KeystoreError: the governance is missing or malformed, or its signature does not verify.
        """
        return self.once(("governance", authority), lambda: self._governance_by(authority))

    def _governance_by(self, authority: x509.Certificate) -> Governance:
        path = self.root / GOVERNANCE_P7S
        try:
            signed = self.files.signed_document(self.read(path, "governance document"))
            signed.verify(authority)
            return parse_governance(signed.document, f"'{path}'")
        except SrosError as error:
            raise KeystoreError(
                f"the governance of keystore '{self.root}' cannot be used: {error.what}",
                error.why,
                error.remedy or f"Restore '{path}' from a backup; every enclave depends on it.",
            ) from error

    @_ReadOnceProperty
    def domains(self) -> DomainSet:
        """The ROS domains that the governance names."""
        return self.governance.domains().closed()

    # ── enclaves ──

    def folder(self, name: str) -> Path:
        """Return the folder of an enclave."""
        return enclave_path(self.root, name)

    def has_enclave(self, name: str) -> bool:
        """Return whether the keystore has an enclave now, without listing all enclaves."""
        return is_enclave(self.folder(name))

    def enclave(self, name: str, *, now: datetime, domain: int | None = None) -> OpenedEnclave:
        """Return an enclave of the keystore, as `open_enclave` does."""
        folder = self.folder(name)
        return self.once(
            ("enclave", name, now, domain),
            lambda: open_enclave(folder, now=now, domain=domain, files=self.files),
        )

    def identity(self, name: str, *, now: datetime) -> EnclaveIdentity:
        """Return the certificate of an enclave, and the faults of its identity files.

        Governance and permissions are not read, because Zenoh needs neither of them.
        """
        folder = self.folder(name)
        return self.once(
            ("identity", name, now), lambda: _EnclaveFiles(folder, now, self.files).identity()
        )

    def certificate_of(self, name: str) -> x509.Certificate:
        """Return the certificate of an enclave.

        Raises:
            SrosError: the file is missing, or is not a readable certificate.
        """
        return self.certificate(self.folder(name) / CERTIFICATE_FILE)

    def signed_grant(self, name: str, subject: str) -> SignedGrant:
        """Return an enclave's permissions and their grant to ``subject``; neither is verified.

        Raises:
            SrosError: the file is not a signed permissions document.
        """
        path = self.folder(name) / PERMISSIONS_FILE
        return self.once(
            ("grant", name, subject), lambda: _read_signed_grant(path, subject, self.files)
        )


_ENCLAVE_PART_KEYS = ("enclave", "identity", "grant", "certificate")


class _ReadFailure(NamedTuple):
    """Why a part of a keystore cannot be read."""

    error: SrosError | OSError


def check_domain(domains: DomainSet, domain: int | None, root: Path) -> None:
    """Raise `KeystoreError` if ``domain`` is not in ``domains``; None is always accepted."""
    if domain is None or domain in domains:
        return
    raise KeystoreError(
        f"ROS_DOMAIN_ID is {domain}, but keystore '{root}' is only for domain {domains}",
        "In any other domain, DDS refuses a node with this keystore.",
        f"Set ROS_DOMAIN_ID to {domains}, or {how_to_add_domains(root, f'{domains},{domain}')}.",
    )


def read_certificate(path: Path) -> x509.Certificate:
    """Return the first certificate of a PEM file.

    Raises:
        SrosError: the file is missing, or is not a readable certificate.
    """
    return load_certificate(read_bytes(path, "certificate"), f"'{path}'")


# ── signed permissions ─────────────────────────────────────────────────────────────────────


class SignedGrant(NamedTuple):
    """A signed permissions document and its grant to a subject; neither is verified.

    ``digest`` is the SHA-256 of the whole file, in hexadecimal.  ``grant`` is the first grant to
    the subject, the only one that DDS reads; None if the document has no grant to the subject.
    """

    signed: smime.SignedDocument
    digest: str
    grant: Grant | None


def _read_signed_grant(path: Path, subject: str, files: FilesReadOnce | None = None) -> SignedGrant:
    """Read a ``permissions.p7s`` and its grant to ``subject``, without verifying its signature.

    Raises:
        SrosError: the file is not a signed permissions document.
    """
    files = files or FilesReadOnce()
    message = files.read(path, "permissions document")
    signed = files.signed_document(message)
    permissions = parse_permissions(signed.document, f"'{path}'")
    return SignedGrant(signed, hashlib.sha256(message).hexdigest(), permissions.grant_of(subject))


# ── an enclave ─────────────────────────────────────────────────────────────────────────────


@shows("file", "text", "code")
class Problem(NamedTuple):
    """A fault in a file of an enclave."""

    file: str
    """Name of the file."""
    text: str
    """Description of the fault, as a clause."""
    fault: Fault

    @property
    def code(self) -> str:
        """Stable name of the fault, such as ``key-mismatch``."""
        return self.fault.id

    def __str__(self) -> str:
        return f"{self.file}: {self.text}"


@dataclass(frozen=True)
class OpenedEnclave:
    """The readable content of an enclave's files, and their problems.

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
    """The content of the readable files by name: the required files and ``crl.pem``."""
    permissions_document: bytes = field(default=b"", repr=False)
    """The XML in ``permissions.p7s``, even if malformed; empty without a valid signature."""
    key_on_robot: bool = False
    """Whether the key was generated on the robot and stays there."""
    token: TokenUri | None = None
    """The place of the key on a PKCS#11 token, by ``key.p11``.

    The key is not compared with the certificate, because reading an enclave opens no token.
    """
    public_key: object = field(default=None, repr=False)
    """The public key of ``key.pem``; None if the file cannot be read."""
    read_once: FilesReadOnce = field(
        default_factory=lambda: FilesReadOnce(), repr=False, compare=False
    )
    """A cache of the enclave's files, and of files that it shares with other enclaves."""

    def signed_document(self, file: str) -> smime.SignedDocument:
        """Return a signed document of the enclave, whose signature need not be verified yet.

        Raises:
            PkiError: the file does not exist, or is not a signed message.
        """
        return self.read_once.signed_document(self.files.get(file, b""))

    @cached_property
    def subject(self) -> str:
        """The subject of the enclave's certificate, or ""."""
        return subject_text(self.certificate.subject) if self.certificate else ""

    @cached_property
    def grant(self) -> Grant | None:
        """The first grant for the certificate's subject (DDS reads this one); None without any."""
        return self.permissions.grant_of(self.subject) if self.permissions else None

    @property
    def problems_in_keystore(self) -> tuple[Problem, ...]:
        """The problems, except a missing key that is on the robot."""
        return _problems_in_keystore(self.problems, self.key_on_robot)

    def domains(self) -> DomainSet | None:
        """Return the ROS domains that the governance names, or None without governance."""
        return self.governance.domains().closed() if self.governance else None

    def joined_domains(self) -> DomainSet | None:
        """Return the ROS domains in both governance and permissions; None without governance.

        If they have no domain in common, the result is the domains of the governance; `problems`
        has the fault.
        """
        governed = self.domains()
        if governed is None or self.grant is None:
            return governed
        allowed = self.grant.domains()
        common = DomainSet.of(*((domain, domain) for domain in governed if domain in allowed))
        return common if common.ranges else governed

    def valid_until(self) -> datetime | None:
        """Return the first expiry among the enclave's certificates and its grant, in UTC.

        The result is None if the certificate or the permissions, or their dates, cannot be read.
        """
        if not (self.certificate and self.permissions):
            return None
        certificates = (self.certificate, self.identity_ca, self.permissions_ca)
        moments = [
            validity_of(certificate).not_after for certificate in certificates if certificate
        ]
        try:
            moments += [self.grant.validity.not_after] if self.grant else []
        except DocumentError:
            return None
        except SrosError:  # the grant expires before it begins
            pass
        return min(moments)


class EnclaveIdentity(NamedTuple):
    """The certificate of an enclave, and the problems of certificate, key and identity CA.

    A key that was generated on the robot and stays there does not count as missing in the keystore.
    """

    certificate: x509.Certificate | None
    problems: tuple[Problem, ...]


def _problems_in_keystore(problems: tuple[Problem, ...], key_on_robot: bool) -> tuple[Problem, ...]:
    """Return the problems, except a missing key that is on the robot."""
    on_robot = (KEY_FILE, Fault.FILE_MISSING) if key_on_robot else None
    return tuple(problem for problem in problems if (problem.file, problem.fault) != on_robot)


def weaknesses(state: OpenedEnclave) -> Iterator[tuple[str, str]]:
    """Yield (file name, clause) for each use of weak cryptography in an enclave's files."""
    for file in (IDENTITY_CA_FILE, PERMISSIONS_CA_FILE, CERTIFICATE_FILE):
        with suppress(SrosError):
            for certificate in load_certificates(state.files.get(file, b""), file):
                if text := weakness(certificate):
                    yield file, text
    for file in (GOVERNANCE_FILE, PERMISSIONS_FILE):
        with suppress(SrosError):
            if text := state.signed_document(file).weakness():
                yield file, text


def open_enclave(
    folder: Path,
    *,
    now: datetime,
    domain: int | None = None,
    files: FilesReadOnce | None = None,
) -> OpenedEnclave:
    """Return the content of an enclave's files, and their problems at the time ``now``.

    With ``domain``, also check whether the enclave may join that ROS domain.  ``files`` is a cache
    of files that were already read, such as `OpenedKeystore.files`.
    """
    return _EnclaveFiles(folder, now, files or FilesReadOnce()).check(domain)


_EXPIRY_OF_CERTIFICATE = (Fault.CERTIFICATE_EXPIRED, Fault.CERTIFICATE_NOT_YET_VALID)
_EXPIRY_OF_CA = (Fault.CA_EXPIRED, Fault.CA_NOT_YET_VALID)
_EXPIRY_OF_PERMISSIONS = (Fault.PERMISSIONS_EXPIRED, Fault.PERMISSIONS_NOT_YET_VALID)

_IDENTITY_FILES = (IDENTITY_CA_FILE, CERTIFICATE_FILE, KEY_FILE)
_ENCRYPTED_MARK = re.compile(rb"ENCRYPTED")
_SIGNED_MESSAGE_TYPE = re.compile(rb"(?i)multipart/signed|application/(?:x-)?pkcs7-mime")

# The enclaves of a keystore share some files, which are parsed only once.
_parse_governance = lru_cache(maxsize=8)(parse_governance)


@lru_cache(maxsize=8)
def _load_crl(
    data: bytes, authority: x509.Certificate | None, authorities: bytes
) -> tuple[x509.CertificateRevocationList, x509.Certificate | None]:
    """Return the list in ``data``, and the CA in ``authorities`` (PEM) that signed it (or None)."""
    crl = read_list(data, CRL_FILE)
    trusted: tuple[x509.Certificate, ...] = (authority,) if authority else ()
    with suppress(SrosError):
        trusted = load_certificates(authorities, IDENTITY_CA_FILE)
    return crl, next((certificate for certificate in trusted if signed_by(crl, certificate)), None)


class _EnclaveFiles:
    """Checks the files of an enclave, and collects the problems."""

    def __init__(self, folder: Path, now: datetime, files: FilesReadOnce) -> None:
        self._folder = folder
        self._now = now
        self._files = files
        self._problems: list[Problem] = []

    def identity(self) -> EnclaveIdentity:
        """Return the enclave's identity, without reading its documents."""
        files, _ = self._read_all(_IDENTITY_FILES)
        certificate, *_ = self._checked_identity(files)
        return EnclaveIdentity(
            certificate, _problems_in_keystore(tuple(self._problems), key_on_robot(self._folder))
        )

    def check(self, domain: int | None) -> OpenedEnclave:
        files, token = self._read_all(REQUIRED_FILES)
        permissions_ca = self._certificate(PERMISSIONS_CA_FILE, files)
        certificate, identity_ca, public_key = self._checked_identity(files)
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
            self._files,
        )

    def _read_all(self, names: Sequence[str]) -> tuple[dict[str, bytes | None], TokenUri | None]:
        """Map the files ``names`` to content; also return the place of a key on a token."""
        token_file = self._read_token_file()
        files = {
            name: self._read(name)
            for name in names
            if name != KEY_FILE or token_file is None or (self._folder / name).exists()
        }
        files.setdefault(KEY_FILE, None)
        return files, None if token_file is None else self._token(token_file, files[KEY_FILE])

    def _checked_identity(
        self, files: dict[str, bytes | None]
    ) -> tuple[x509.Certificate | None, x509.Certificate | None, object]:
        """Check the identity; return the certificates of enclave and CA, and the public key."""
        identity_ca = self._certificate(IDENTITY_CA_FILE, files)
        certificate = self._certificate(CERTIFICATE_FILE, files)
        public_key = self._checked_public_key(certificate, identity_ca, files)
        files[CRL_FILE] = self._checked_revocation_list(
            certificate, identity_ca, files[IDENTITY_CA_FILE]
        )
        return certificate, identity_ca, public_key

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

    def _content(self, path: Path, label: str) -> bytes | None:
        try:
            return self._files.read(path, label)
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
        """Return the place that ``key.p11`` names; None if the file is empty or faulty.

        ``key`` is the content of ``key.pem``, or None. Faults are recorded.
        """
        if key is not None:
            text = f"the folder also has {KEY_FILE}"
            self._add(KEY_URI_FILE, text, Fault.KEY_TWICE)
        if not data:  # already reported
            return None
        from sros_tool.pki.token import parse_token_file

        try:
            return parse_token_file(data)
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

    def _check_validity(self, file: str, validity: Window, faults: tuple[Fault, Fault]) -> None:
        """Add the first of ``faults`` if ``validity`` is over, the second if it has not begun."""
        expired, not_yet_valid = faults
        if self._now > validity.not_after:
            self._add(file, f"it expired at {iso(validity.not_after)}", expired)
        elif self._now < validity.not_before:
            self._add(file, f"it is not valid before {iso(validity.not_before)}", not_yet_valid)

    def _checked_public_key(
        self,
        certificate: x509.Certificate | None,
        ca: x509.Certificate | None,
        files: Mapping[str, bytes | None],
    ) -> object:
        """Check certificate and key, and return the public key of ``key.pem``, or None."""
        key, authorities = files[KEY_FILE], files[IDENTITY_CA_FILE]
        if certificate and ca and not issued_by(certificate, ca):
            text = (
                f"it was not issued by the identity CA of the enclave ({subject_text(ca.subject)}) "
                f"but by {other_issuer_text(certificate, ca)}"
            )
            if refusal := self._chain_problem(certificate, authorities or b""):
                text += f"; {IDENTITY_CA_FILE} also has this issuer, but {refusal}"
            self._add(CERTIFICATE_FILE, text, Fault.CERTIFICATE_ISSUER)
        elif certificate and ca and authorities and not self._problems:
            self._check_chain(certificate, authorities)
        if key is None:
            return None
        try:
            public_key = load_any_key(key, KEY_FILE).public_key()
        except SrosError as error:
            fault = Fault.KEY_ENCRYPTED if _ENCRYPTED_MARK.search(key) else Fault.KEY_MALFORMED
            self._add(KEY_FILE, error.clause, fault)
            return None
        if certificate and certificate.public_key() != public_key:
            self._add(KEY_FILE, "it is not the key of cert.pem", Fault.KEY_MISMATCH)
        elif certificate and isinstance(public_key, rsa.RSAPublicKey):
            names = ("an RSA key", "an RSA key for RSA-PSS alone")
            is_pss, wanted = is_key_for_pss(key), is_for_pss(certificate)
            if is_pss != wanted:
                text = f"it is {names[is_pss]}, and cert.pem is for {names[wanted]}"
                self._add(KEY_FILE, text, Fault.KEY_MISMATCH)
        return public_key

    def _chain_problem(self, certificate: x509.Certificate, authorities: bytes) -> str:
        """Return why no chain to the CAs in a file is valid, as a clause; "" if a chain is valid.

        The result is also "" if the issuer of ``certificate`` is not in the file.
        """
        with suppress(SrosError):
            chain = load_certificates(authorities, "")
            if any(issued_by(certificate, authority) for authority in chain):
                return chain_fault(certificate, chain, moment=self._now)
        return ""

    def _check_chain(self, certificate: x509.Certificate, authorities: bytes) -> None:
        try:
            chain = load_certificates(authorities, "")
        except SrosError as error:  # a certificate after the first one is faulty
            self._add(IDENTITY_CA_FILE, error.clause, Fault.CERTIFICATE_MALFORMED)
            return
        if refusal := chain_fault(certificate, chain, moment=self._now):
            self._add(CERTIFICATE_FILE, f"it is refused: {refusal}", Fault.CERTIFICATE_ISSUER)

    def _checked_revocation_list(
        self,
        certificate: x509.Certificate | None,
        ca: x509.Certificate | None,
        authorities: bytes | None,
    ) -> bytes | None:
        """Check and return the revocation list; None if there is no readable list."""
        path = self._folder / CRL_FILE
        if not os.path.lexists(path):
            return None
        if not path.is_file():
            text = "it is a folder" if path.is_dir() else "it is no file, or a broken link"
            self._add(CRL_FILE, f"{text}, so ROS 2 ignores it", Fault.CRL_LEFT_OUT)
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
            text = "the identity CA did not sign it, so DDS refuses every participant"
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
        if last_update(crl) > self._now:
            text = f"it is not valid before {iso(last_update(crl))}: every participant is refused"
            self._add(CRL_FILE, text, Fault.CRL_NOT_YET_VALID)
        expiry = next_update(crl)
        if expiry and expiry < self._now:
            text = f"it expired at {iso(expiry)}: every participant is refused"
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
            signed = self._files.signed_document(data)
            if authority:
                signed.verify(authority)
            return signed.document
        except SrosError as error:
            fault = (
                Fault.SIGNATURE if _SIGNED_MESSAGE_TYPE.search(data[:1000]) else Fault.NOT_SIGNED
            )
            self._add(name, str(error), fault)
            return None

    def _parsed(
        self,
        name: str,
        document: bytes,
        parse: Callable[[bytes, str], _Parsed],
        malformed: Fault,
    ) -> _Parsed | None:
        try:
            return parse(document, name)
        except SrosError as error:
            kind = kind_of(document)
            content_fault = f"its signed content is {kind}, not XML in UTF-8"
            text = error.clause if kind in ("", XML) else content_fault
            self._add(name, text, malformed)
            return None

    def _check_grant(
        self, permissions: Permissions, certificate: x509.Certificate, domain: int | None
    ) -> None:
        name = PERMISSIONS_FILE
        subject = subject_text(certificate.subject)
        grant = permissions.grant_of(subject)
        if grant is None:
            subjects = ", ".join(grant.subject for grant in permissions.grants)
            only = f", only for {subjects}" if subjects else ""
            text = f"it has no grant for {subject}{only}"
            self._add(name, text, Fault.PERMISSIONS_SUBJECT)
            return
        try:
            self._check_validity(name, grant.validity, _EXPIRY_OF_PERMISSIONS)
        except SrosError as error:  # the validity ends before it begins
            self._add(name, error.what, Fault.PERMISSIONS_MALFORMED)
        rules = [rule for rule in grant.rules if rule.allow]
        if domain is not None and not any(domain in rule.domains.closed() for rule in rules):
            allowed = grant.domains()
            only = f", only in domain {allowed}" if allowed.ranges else ""
            text = f"none of its rules allows anything in domain {domain}{only}"
            self._add(name, text, Fault.PERMISSIONS_DOMAIN)


# ── reading one state while another process writes ─────────────────────────────────────────


_MOST_READS = 5

Result = TypeVar("Result")
Arguments = ParamSpec("Arguments")
Opened = TypeVar("Opened", Path, OpenedKeystore)


def read_consistently(
    read: Callable[Concatenate[Opened, Arguments], Result],
) -> Callable[Concatenate[Opened, Arguments], Result]:
    """Decorate a function so that it is called again if the keystore changes in the meantime.

    After five calls, the last result is returned, or the last exception raised.
    """

    @wraps(read)
    def read_again(opened: Opened, *arguments: Arguments.args, **named: Arguments.kwargs) -> Result:
        root = opened.root if isinstance(opened, OpenedKeystore) else opened
        for _ in range(_MOST_READS - 1):
            before = _ledger_state(root)
            try:
                result = read(opened, *arguments, **named)
            except SrosError:
                if _ledger_state(root) == before:
                    raise
            else:
                if _ledger_state(root) == before:
                    return result
            if isinstance(opened, OpenedKeystore):
                opened.forget()
        return read(opened, *arguments, **named)

    return read_again  # type: ignore[return-value]  # mypy knows the name of the first argument


def _ledger_state(root: Path) -> object:
    """Return a value that differs after each change of a keystore.

    The value identifies the files of the ledger and of the settings.
    """
    file_states: list[tuple[int, int, int] | None] = []
    for name in (LEDGER, SETTINGS):
        try:
            state = os.stat(root / name)  # noqa: PTH116 - the link of a change under way, too
        except OSError:
            file_states.append(None)
        else:
            file_states.append((state.st_ino, state.st_size, state.st_mtime_ns))
    return file_states
