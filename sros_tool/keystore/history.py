"""The history of a keystore: all certificates and documents that it issued, and their state."""

from __future__ import annotations

import binascii
import hashlib
import re
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import datetime
from enum import StrEnum
from pathlib import Path

from sros_tool.keystore.layout import (
    CERTIFICATE_FILE,
    CRL,
    GOVERNANCE_P7S,
    PERMISSIONS_FILE,
    PUBLIC,
    RETIRED,
    REVOKED,
    SETTINGS,
    enclave_folder,
    list_enclaves,
    revoked_certificates,
)
from sros_tool.keystore.ledger import GAP, Entry
from sros_tool.keystore.reader import Keystore
from sros_tool.validity import iso
from sros_tool.xml import read_bytes

_ISSUED = (CERTIFICATE_FILE, PERMISSIONS_FILE)
_PEM = re.compile(rb"-----BEGIN ([A-Z0-9 ]+)-----(.*?)-----END \1-----\n?", re.DOTALL)


class HistoryStatus(StrEnum):
    """The state of an issued certificate or document."""

    CURRENT = "current"
    """It is in the keystore, and has not expired."""
    SUPERSEDED = "superseded"
    """It is no longer in the keystore, but neither revoked nor expired: DDS still accepts it."""
    REPLACED = "replaced"
    """Settings that the keystore had before; DDS never reads any."""
    REVOKED = "revoked"
    RETIRED = "retired"
    """A CA that was replaced, and is no longer trusted."""
    EXPIRED = "expired"
    DAMAGED = "damaged"
    """Lines of the ledger were missing or changed when the entry was made."""
    SENT = "sent"
    """It went to a robot; the keystore keeps no copy."""


@dataclass(frozen=True, slots=True)
class HistoryItem:
    """An entry of the ledger, its state, and the path of its file (or "")."""

    entry: Entry
    status: HistoryStatus
    path: str


@dataclass(frozen=True, slots=True)
class History:
    """All entries of the ledger, oldest first, and the paths of files without an entry.

    ``gaps`` are sentences about lines of the ledger that are missing, changed or unreadable.
    """

    items: tuple[HistoryItem, ...]
    unexplained: tuple[str, ...]
    gaps: tuple[str, ...]


def history(root: Path, *, now: datetime) -> History:
    """Return the ledger of a keystore, compared with its certificates and signed documents."""
    issued, revoked_files = _files(root, _active_paths(root)), _files(root, _revoked_paths(root))
    retired = _files(root, _retired_paths(root))
    keystore = Keystore(root)
    ledger = keystore.ledger
    entries = ledger.entries
    # A new CA starts with an empty revocation list, and lists drop expired certificates, so the
    # ledger is asked too.
    revoked = {each.serial for each in entries if each.what == "revocation"}
    revoked |= {f"{entry.serial:x}" for crl in keystore.revocation_lists for entry in crl.revoked}
    moment = iso(now)
    settings = _files(root, iter((SETTINGS,)))

    def status(entry: Entry) -> HistoryStatus:
        if entry.what == GAP:
            return HistoryStatus.DAMAGED
        if entry.what == "answer":
            return HistoryStatus.SENT
        if entry.what == "settings":
            return HistoryStatus.CURRENT if entry.sha256 in settings else HistoryStatus.REPLACED
        if entry.what == "revocation" or entry.serial in revoked or entry.sha256 in revoked_files:
            return HistoryStatus.REVOKED
        if entry.sha256 in retired and entry.sha256 not in issued:
            return HistoryStatus.RETIRED
        if entry.not_after and entry.not_after < moment:
            return HistoryStatus.EXPIRED
        return HistoryStatus.CURRENT if entry.sha256 in issued else HistoryStatus.SUPERSEDED

    known = {entry.sha256 for entry in entries}
    found = {**retired, **revoked_files, **issued}
    places = {**found, **settings}
    return History(
        tuple(
            HistoryItem(entry, status(entry), (places.get(entry.sha256) or [""])[0])
            for entry in entries
        ),
        tuple(
            sorted(path for digest, paths in found.items() if digest not in known for path in paths)
        ),
        ledger.gaps,
    )


def _active_paths(root: Path) -> Iterator[str]:
    """Yield the paths where DDS loads certificates and signed documents, missing files included."""
    yield from (f"{PUBLIC}/{path.name}" for path in sorted((root / PUBLIC).glob("*.cert.pem")))
    yield from (GOVERNANCE_P7S, CRL)
    for name in list_enclaves(root):
        yield from (f"{enclave_folder(name)}/{file}" for file in _ISSUED)


def _revoked_paths(root: Path) -> Iterator[str]:
    for path in revoked_certificates(root):
        yield from (f"{REVOKED}/{path.parent.name}/{file}" for file in _ISSUED)


def _retired_paths(root: Path) -> Iterator[str]:
    yield from (f"{RETIRED}/{path.name}" for path in sorted((root / RETIRED).glob("*.cert.pem")))


def _files(root: Path, paths: Iterator[str]) -> dict[str, list[str]]:
    """Map SHA-256 digests, as in the ledger, to the paths of existing files."""
    found: dict[str, list[str]] = {}
    for path in paths:
        if (root / path).is_file() and not (root / path).is_symlink():
            for digest in _digests(root / path):
                found.setdefault(digest, []).append(path)
    return found


def _digests(path: Path) -> list[str]:
    """Return the digests of a file's content; a CA file may hold several certificates."""
    data = read_bytes(path, "file")
    if not path.name.endswith("cert.pem"):
        return [hashlib.sha256(data).hexdigest()]
    found = []
    for part in _PEM.finditer(data):
        content = part[0]
        if part[1] == b"CERTIFICATE":
            try:
                content = binascii.a2b_base64(part[2])
            except binascii.Error:
                return ["unreadable"]
        found.append(hashlib.sha256(content).hexdigest())
    return found or ["unreadable"]
