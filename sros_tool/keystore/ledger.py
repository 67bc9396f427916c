"""The ledger of a keystore: every certificate and signed document that it ever issued.

The file has one JSON object per line; lines are only added.  Entries are part of the transaction
that issues, so the ledger has exactly the certificates and documents that were installed.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable
from dataclasses import dataclass, fields
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING

from cryptography import x509
from cryptography.hazmat.primitives import hashes

from sros_tool.errors import KeystoreError
from sros_tool.keystore.layout import LEDGER
from sros_tool.pki.certificates import subject_text, validity_of
from sros_tool.validity import Window, iso

if TYPE_CHECKING:
    from sros_tool.keystore.transaction.transaction import Transaction


@dataclass(frozen=True, slots=True)
class Entry:
    """A line of the ledger: a certificate or document that was issued, or a revocation.

    ``what`` is ca, certificate, permissions, governance, crl, revocation, or answer (the signed
    list of the files sent to a robot).  ``sha256`` is the hash of a certificate's DER or of a
    document's bytes; ``serial`` is hexadecimal; ``policy`` is the SHA-256 of the policy file,
    with its includes, that permissions were made from.  Times are ISO 8601 in UTC.
    """

    time: str
    what: str
    enclave: str = ""
    subject: str = ""
    serial: str = ""
    sha256: str = ""
    not_before: str = ""
    not_after: str = ""
    policy: str = ""
    reason: str = ""


_FIELDS = tuple(each.name for each in fields(Entry))


def certificate_entry(
    now: datetime, what: str, certificate: x509.Certificate, enclave: str = ""
) -> Entry:
    """Return the entry of an issued certificate; ``what`` is ca or certificate."""
    validity = validity_of(certificate)
    return Entry(
        time=iso(now),
        what=what,
        enclave=enclave,
        subject=subject_text(certificate.subject),
        serial=f"{certificate.serial_number:x}",
        sha256=certificate.fingerprint(hashes.SHA256()).hex(),
        not_before=iso(validity.not_before),
        not_after=iso(validity.not_after),
    )


def document_entry(
    now: datetime,
    what: str,
    message: bytes,
    *,
    enclave: str = "",
    subject: str = "",
    validity: Window | None = None,
    policy: str = "",
) -> Entry:
    """Return the entry of a signed document."""
    return Entry(
        time=iso(now),
        what=what,
        enclave=enclave,
        subject=subject,
        sha256=hashlib.sha256(message).hexdigest(),
        not_before=iso(validity.not_before) if validity else "",
        not_after=iso(validity.not_after) if validity else "",
        policy=policy,
    )


def read_ledger(root: Path) -> tuple[Entry, ...]:
    """Return all entries, oldest first; none for a keystore without a ledger (of ros2/sros2).

    Raises:
        KeystoreError: a line is not an entry.
    """
    path = root / LEDGER
    if not path.exists():
        return ()
    entries = []
    for number, line in enumerate(path.read_bytes().splitlines(), 1):
        try:
            entries.append(Entry(**json.loads(line)))
        except (ValueError, TypeError) as error:
            raise KeystoreError(
                f"the ledger '{path}' cannot be read",
                f"Line {number} is not an entry.",
                "Restore it from a backup.",
            ) from error
    return tuple(entries)


def append(transaction: Transaction, entries: Iterable[Entry]) -> None:
    """Stage the ledger with ``entries`` added at its end."""
    new = b"".join(_line(entry) for entry in entries)
    if not new:
        return
    path = transaction.root / LEDGER
    old = path.read_bytes() if path.exists() else b""
    if old and not old.endswith(b"\n"):
        old += b"\n"
    transaction.write(LEDGER, old + new)


def _line(entry: Entry) -> bytes:
    filled = {name: value for name in _FIELDS if (value := getattr(entry, name))}
    return json.dumps(filled, separators=(",", ":")).encode() + b"\n"
