"""A keystore made ready for checks: what its files say, as far as they can be read."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass
from datetime import UTC, datetime, tzinfo
from pathlib import Path

from cryptography import x509

from sros_tool.errors import SrosError
from sros_tool.keystore.layout import (
    CRL,
    GOVERNANCE_P7S,
    LEDGER,
    PRIVATE,
    PUBLIC,
    ROLES,
    SETTINGS,
    ca_certificate,
    enclave_path,
    list_enclaves,
)
from sros_tool.keystore.ledger import Entry, read_ledger
from sros_tool.keystore.reader import OpenedEnclave, load_settings
from sros_tool.keystore.template import Template
from sros_tool.pki.certificates import load_certificates
from sros_tool.pki.crl import RevocationList, load_crl
from sros_tool.policy.model import Policy
from sros_tool.xml import read_bytes


@dataclass(frozen=True, slots=True)
class Unread:
    """A file that is there and cannot be read as what it is; ``path`` is relative to the root."""

    path: str
    error: SrosError


@dataclass(frozen=True, slots=True)
class CheckedKeystore:
    """A keystore, or the part of one that was exported for a robot.

    ``settings`` are None where ros2/sros2 made it.  ``authorities`` has the certificates of a CA
    file by role, the issuing one first.  ``policies`` are those that its permissions are compared
    with; ``zone`` is that of the host on which its enclaves run.  ``governance`` are the bytes
    of the document that its enclaves share, where there is one.
    """

    root: Path
    now: datetime
    names: tuple[str, ...]
    settings: Template | None
    authorities: dict[str, tuple[x509.Certificate, ...]]
    crl: RevocationList | None
    ledger: tuple[Entry, ...]
    governance: bytes = b""
    unread: tuple[Unread, ...] = ()
    policies: tuple[Policy, ...] = ()
    zone: tzinfo = UTC

    @property
    def is_home(self) -> bool:
        """Whether it has a place for CAs; else it was exported for a robot."""
        return any((self.root / part).exists() for part in (PUBLIC, PRIVATE, SETTINGS))

    def accepts(self, chosen: Callable[[Template], bool]) -> str:
        """Who accepted what was ``chosen``: a template, or the keystore of which this is an export.

        "" where nobody did, by its settings, or in a keystore of ros2/sros2, which has none.
        """
        if self.settings:
            return f"template {self.settings.name}" if chosen(self.settings) else ""
        return "" if self.is_home else "keystore that it was exported from"

    def shown(self, path: str | Path) -> str:
        """A path below the root as it is told."""
        return os.path.join(self.root, path)


@dataclass(frozen=True, slots=True)
class CheckedEnclave:
    """An enclave, what its files say, and the keystore that it is of."""

    keystore: CheckedKeystore
    name: str
    state: OpenedEnclave
    born_elsewhere: bool = False
    """Its key was made on its robot, and stays there."""

    @property
    def folder(self) -> Path:
        """Its folder."""
        return enclave_path(self.keystore.root, self.name)

    def file(self, name: str) -> str:
        """The path of one of its files."""
        return f"{self.folder}/{name}"


def read_keystore(
    root: Path, *, now: datetime, zone: tzinfo = UTC, policies: tuple[Policy, ...] = ()
) -> CheckedKeystore:
    """Read what a keystore says of itself; `KeystoreError` if it is none."""
    names = list_enclaves(root)
    unread: list[Unread] = []
    settings: Template | None = None
    ledger: tuple[Entry, ...] = ()
    crl: RevocationList | None = None
    authorities: dict[str, tuple[x509.Certificate, ...]] = {}
    try:
        settings = load_settings(root) if (root / SETTINGS).exists() else None
    except SrosError as error:
        unread.append(Unread(SETTINGS, error))
    try:
        ledger = read_ledger(root)
    except SrosError as error:
        unread.append(Unread(LEDGER, error))
    except OSError as error:
        unread.append(Unread(LEDGER, SrosError("the ledger cannot be read", f"{error.strerror}.")))
    try:
        if (root / CRL).exists():
            crl = load_crl(read_bytes(root / CRL, "revocation list"), f"'{root / CRL}'")
    except SrosError as error:
        unread.append(Unread(CRL, error))
    for role in ROLES:
        path = ca_certificate(role)
        try:
            if (root / path).exists():
                data = read_bytes(root / path, "certificate")
                authorities[role] = load_certificates(data, f"'{root / path}'")
        except SrosError as error:
            unread.append(Unread(path, error))
    governance = root / GOVERNANCE_P7S
    return CheckedKeystore(
        root,
        now,
        names,
        settings,
        authorities,
        crl,
        ledger,
        read_bytes(governance, "governance document") if governance.is_file() else b"",
        tuple(unread),
        policies,
        zone,
    )
