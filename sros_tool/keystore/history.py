"""Tells what became of everything that a keystore ever issued, by its ledger and its files."""

from __future__ import annotations

import hashlib
import ssl
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import datetime
from enum import StrEnum
from pathlib import Path

from sros_tool.keystore.create import list_enclaves
from sros_tool.keystore.layout import (
    CRL,
    GOVERNANCE_P7S,
    PUBLIC,
    REVOKED,
    enclave_folder,
)
from sros_tool.keystore.ledger import Entry, read_ledger
from sros_tool.keystore.revoke import read_crl
from sros_tool.validity import iso
from sros_tool.xml import read_bytes

_ISSUED = ("cert.pem", "permissions.p7s")


class Status(StrEnum):
    """What became of something that was issued."""

    CURRENT = "current"
    """It is in the keystore, and in date."""
    SUPERSEDED = "superseded"
    """It is no longer in the keystore, but would still be accepted: replaced is not revoked."""
    REVOKED = "revoked"
    EXPIRED = "expired"
    SENT = "sent"
    """It went to a robot; the keystore keeps no copy."""


@dataclass(frozen=True, slots=True)
class Item:
    """An entry of the ledger, what became of it, and where it lies (or "")."""

    entry: Entry
    status: Status
    path: str


@dataclass(frozen=True, slots=True)
class History:
    """All entries, oldest first, and the files that none of them explains."""

    items: tuple[Item, ...]
    unexplained: tuple[str, ...]


def history(root: Path, *, now: datetime) -> History:
    """Compare the ledger of a keystore with its certificates and signed documents."""
    issued, put_away = _files(root, _served(root)), _files(root, _put_away(root))
    crl = read_crl(root)
    revoked = {f"{each.serial:x}" for each in crl.revoked} if crl else set()
    entries = read_ledger(root)

    def status(entry: Entry) -> Status:
        if entry.what == "answer":
            return Status.SENT
        if entry.what == "revocation" or entry.serial in revoked or entry.sha256 in put_away:
            return Status.REVOKED
        if entry.not_after and entry.not_after < iso(now):
            return Status.EXPIRED
        return Status.CURRENT if entry.sha256 in issued else Status.SUPERSEDED

    known = {entry.sha256 for entry in entries}
    found = {**put_away, **issued}
    return History(
        tuple(
            Item(entry, status(entry), (found.get(entry.sha256) or [""])[0]) for entry in entries
        ),
        tuple(
            sorted(path for digest, paths in found.items() if digest not in known for path in paths)
        ),
    )


def _served(root: Path) -> Iterator[str]:
    """Every certificate and signed document that DDS may load."""
    yield from (f"{PUBLIC}/{path.name}" for path in sorted((root / PUBLIC).glob("*.cert.pem")))
    yield from (GOVERNANCE_P7S, CRL)
    for name in list_enclaves(root):
        yield from (f"{enclave_folder(name)}/{file}" for file in _ISSUED)


def _put_away(root: Path) -> Iterator[str]:
    for folder in sorted((root / REVOKED).glob("*")):
        yield from (f"{REVOKED}/{folder.name}/{file}" for file in _ISSUED)


def _files(root: Path, paths: Iterator[str]) -> dict[str, list[str]]:
    """Those of the files that are there, by their digest as the ledger has it."""
    found: dict[str, list[str]] = {}
    for path in paths:
        if (root / path).is_file() and not (root / path).is_symlink():
            found.setdefault(_digest(root / path), []).append(path)
    return found


def _digest(path: Path) -> str:
    data = read_bytes(path, "file")
    if path.name.endswith("cert.pem"):
        try:
            data = ssl.PEM_cert_to_DER_cert(data.decode("ascii").strip())
        except ValueError:
            return "unreadable"
    return hashlib.sha256(data).hexdigest()
