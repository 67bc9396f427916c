"""The ledger of a keystore: every certificate and signed document that it ever issued.

The file has one JSON object per line; lines are only added.  Entries are part of the transaction
that issues, so the ledger has exactly the certificates and documents that were installed.

The lines are a chain: ``previous`` is the SHA-256 of the line before, without its line end; on the
first line that has one, it is the SHA-256 of all lines before, joined by line ends (earlier
versions wrote no chain).  The signed document ``ledger.p7s`` states the number of lines and the
SHA-256 of the last one.  So a line that was changed, removed, added or cut off is noticed.  What
was noticed when a line was added stays visible as an entry ``gap`` before it.
"""

from __future__ import annotations

import errno
import hashlib
import json
import os
import re
import stat
from collections.abc import Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass, fields, replace
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from cryptography import x509
from cryptography.hazmat.primitives import hashes

from sros_tool.errors import KeystoreError, PkiError, SrosError
from sros_tool.keystore.layout import LEDGER, LEDGER_HEAD, ROLES, SETTINGS, ca_certificate
from sros_tool.pki import smime
from sros_tool.pki.certificates import digest, load_certificates, subject_text, validity_of
from sros_tool.validity import Window, iso
from sros_tool.xml import read_bytes

if TYPE_CHECKING:
    from sros_tool.keystore.authorities.authority import Authority
    from sros_tool.keystore.transaction.transaction import Transaction

GAP = "gap"
SAME_KEY = "same key"
"""The ``reason`` of a CA certificate for the key of the certificate before."""


@dataclass(frozen=True, slots=True)
class Entry:
    """A line of the ledger: a certificate or document that was issued, or a revocation.

    ``what`` is ca, certificate, permissions, governance, crl, revocation, answer (the signed list
    of the files sent to a robot), or gap (``reason`` says what was wrong with the lines up to
    ``number``).
    ``sha256`` is the hash of a certificate's DER or of a document's bytes; ``serial`` is
    hexadecimal; ``policy`` is the SHA-256 of the policy file, with its includes, that permissions
    were made from; the ``number`` of an answer orders it.  ``key`` is the SHA-256 of the public key
    of a certificate (its DER SubjectPublicKeyInfo), or of the key that was revoked with a
    certificate.  Times are ISO 8601 in UTC.
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
    key: str = ""
    number: int = 0
    previous: str = ""


@dataclass(frozen=True, slots=True)
class Ledger:
    """The readable entries of a ledger, oldest first, and what is wrong with it.

    ``gaps`` are sentences about lines that are missing, changed or unreadable; what came before
    the present CAs is left out, because nothing that other CAs signed is valid.  ``certain`` are
    the entries after the last gap: nothing is missing among them.  ``unchained`` is the number of
    lines from before the chain, of which some may have been removed.  ``lines`` is the number of
    all lines.
    """

    entries: tuple[Entry, ...] = ()
    gaps: tuple[str, ...] = ()
    certain: tuple[Entry, ...] = ()
    unchained: int = 0
    lines: int = 0

    def next_number(self) -> int:
        """Return a number that is higher than those of all answers before."""
        return max([self.lines, *(each.number for each in self.entries)]) + 1


class _Fault(NamedTuple):
    """Something wrong with the lines up to ``line``."""

    line: int
    text: str


_MOST_BYTES = 128 * 1024 * 1024  # as `Folder.read`
_FIELDS = tuple(each.name for each in fields(Entry))
_TEXTS = tuple(each.name for each in fields(Entry) if each.type == "str")
_SERIAL = re.compile(r"[0-9a-f]{1,40}")
_MOST_BITS = 159
"""The length of a serial number (RFC 5280, 4.1.2.2)."""
_MOST_NUMBER = 10**12
_HEAD = re.compile(rb"sros ledger 1\nlines ([0-9]{1,12})\nsha256 ([0-9a-f]{64})\n")


# ── entries ────────────────────────────────────────────────────────────────────────────────


def certificate_entry(
    now: datetime, what: str, certificate: x509.Certificate, enclave: str = "", reason: str = ""
) -> Entry:
    """Return the entry of an issued certificate; ``what`` is ca or certificate."""
    from sros_tool.pki.requests import key_digest  # only writing needs it

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
        reason=reason,
        key=key_digest(certificate.public_key()),  # type: ignore[arg-type]
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
    number: int = 0,
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
        number=number,
    )


# ── reading ────────────────────────────────────────────────────────────────────────────────


def read_ledger(root: Path) -> Ledger:
    """Return the ledger of a keystore; empty for one that has none (of ros2/sros2).

    Raises:
        KeystoreError: the file cannot be read at all.
    """
    return _read(root).ledger


class _Reading(NamedTuple):
    """The ledger, its lines, and the faults that no entry ``gap`` records yet."""

    ledger: Ledger
    lines: Sequence[bytes] = ()
    chained: bool = False
    unrecorded: Sequence[_Fault] = ()


def _read(root: Path, *, follow_link: bool = True) -> _Reading:
    while True:
        lines = _lines(root, follow_link)
        reading = _compare(root, lines)
        # A transaction of another process may have ended between the reading of the two files.
        if not reading.unrecorded or _lines(root, follow_link) == lines:
            return reading


def _compare(root: Path, lines: list[bytes] | None) -> _Reading:
    """Return the ledger with these lines, compared with its head."""
    if not lines:
        if lines is None and not any((root / file).exists() for file in (SETTINGS, LEDGER_HEAD)):
            return _Reading(Ledger())
        missing = _Fault(0, f"there is no {LEDGER}" if lines is None else f"{LEDGER} is empty")
        return _Reading(Ledger(gaps=(missing.text,)), unrecorded=[missing])
    numbered: list[tuple[int, Entry]] = []
    faults: list[_Fault] = []
    chained = damaged = False
    unchained = 0
    for number, line in enumerate(lines, 1):
        entry = _parse(line)
        if entry is None:
            faults.append(_Fault(number, f"line {number} is not an entry"))
            damaged = True
            continue
        if chained and not entry.previous:
            faults.append(_Fault(number, f"line {number} was added from outside"))
        elif entry.previous:
            before = lines[number - 2 : number - 1] if chained else lines[: number - 1]
            if entry.previous != _digest(b"\n".join(before)) and not damaged:
                text = f"before line {number}, a line was changed or removed"
                faults.append(_Fault(number - 1, text))
            if not chained:
                chained, unchained = True, number - 1
        damaged = False
        numbered.append((number, entry))
    if not chained:
        unchained = len(lines)
    authorities = _authorities(root)
    if fault := _head_fault(root, lines, authorities, chained=chained):
        faults.append(fault)
    recorded = [_Fault(each.number, each.reason) for _, each in numbered if each.what == GAP]
    last_recorded = max((number for number, each in numbered if each.what == GAP), default=0)
    start = _first_of(authorities, numbered)
    every = [*recorded, *faults]
    last = max((each.line for each in every), default=0)
    ledger = Ledger(
        tuple(entry for _, entry in numbered),
        tuple(dict.fromkeys(each.text for each in every if each.line >= start)),
        tuple(entry for number, entry in numbered if number > last),
        0 if start > unchained else unchained,
        len(lines),
    )
    unrecorded = [each for each in faults if each.line >= last_recorded]
    return _Reading(ledger, lines, chained, unrecorded)


def _lines(root: Path, follow_link: bool) -> list[bytes] | None:
    """Return the lines, or None without a ledger.

    While a transaction is being committed, the file is a link.  Whoever holds the lock of the
    keystore does not follow it: another link could lead to a file that is not of the keystore.
    """
    path = root / LEDGER
    try:
        if not follow_link:
            from sros_tool.folders import Folder  # a question does not load what writes

            with Folder(root) as folder:
                data = folder.read(LEDGER)
        elif path.is_file() or not path.exists():
            data = _followed(path)
        else:
            raise KeystoreError("it is not a regular file")
    except FileNotFoundError:
        return None
    except (OSError, KeystoreError) as error:
        raise KeystoreError(
            f"the ledger '{path}' cannot be read",
            f"{error.strerror if isinstance(error, OSError) else error.what}.",
            "Restore it from a backup.",
        ) from error
    return data.removesuffix(b"\n").split(b"\n") if data else []


def _followed(path: Path) -> bytes:
    """Return the content of the ledger, also behind a link; do not wait for a pipe.

    A sparse file takes no space on the disk, and would take all memory.
    """
    handle = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
    with open(handle, "rb") as file:
        state = os.fstat(handle)
        if not stat.S_ISREG(state.st_mode):
            raise KeystoreError("it is not a regular file")
        if state.st_size > _MOST_BYTES:
            raise OSError(errno.EFBIG, os.strerror(errno.EFBIG), str(path))
        return file.read(state.st_size)


def _parse(line: bytes) -> Entry | None:
    """Return the entry of a line, or None if it is not an entry."""
    try:
        entry = Entry(**json.loads(line))
    except (ValueError, TypeError, RecursionError):
        return None
    if not all(isinstance(getattr(entry, name), str) for name in _TEXTS):
        return None
    if type(entry.number) is not int or not 0 <= entry.number < _MOST_NUMBER:
        return None
    if entry.serial:
        valid = _SERIAL.fullmatch(entry.serial)
        if not valid or not 0 < int(entry.serial, 16).bit_length() <= _MOST_BITS:
            return None
    return entry


def _digest(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()


def _authorities(root: Path) -> list[x509.Certificate]:
    """Return the certificates of the CAs that the keystore trusts; none where unreadable."""
    found: list[x509.Certificate] = []
    for role in ROLES:
        path = root / ca_certificate(role)
        with suppress(SrosError):
            found += load_certificates(read_bytes(path, "certificate"), f"'{path}'")
    return found


def _first_of(authorities: Iterable[x509.Certificate], found: Iterable[tuple[int, Entry]]) -> int:
    """Return the line of the first of the trusted CAs, or 0 if the ledger does not tell."""
    wanted = {digest(each) for each in authorities}
    lines: dict[str, int] = {}
    for number, entry in found:
        if entry.what == "ca" and entry.sha256 in wanted:
            # Certificates from before a CA was renewed with the same key are still valid.
            lines.setdefault(entry.sha256, 0 if entry.reason == SAME_KEY else number)
    return min(lines.values(), default=0) if lines.keys() == wanted else 0


def _head_fault(
    root: Path, lines: Sequence[bytes], authorities: Sequence[x509.Certificate], *, chained: bool
) -> _Fault | None:
    """Return what is wrong between the ledger and its signed head, or None."""
    if not (root / LEDGER_HEAD).exists():
        text = f"{LEDGER_HEAD}, which signs its end, is missing"
        return _Fault(len(lines), text) if chained else None
    try:
        signed = smime.parse(read_bytes(root / LEDGER_HEAD, "signed head of the ledger"))
        if authorities:
            _verify(signed, authorities)
        stated = _HEAD.fullmatch(signed.document.replace(b"\r\n", b"\n"))
    except SrosError as error:
        return _Fault(len(lines), f"{LEDGER_HEAD} does not sign its end: {error.what}")
    if not stated:
        return _Fault(len(lines), f"{LEDGER_HEAD} is not the signed end of a ledger")
    count = int(stated[1])
    if count > len(lines):
        missing = count - len(lines)
        text = f"{missing} line{'s are' if missing > 1 else ' is'} missing at its end"
        return _Fault(len(lines), text)
    if not count or _digest(lines[count - 1]) != stated[2].decode():
        return _Fault(len(lines), f"its last lines are not the ones that {LEDGER_HEAD} signs")
    if count < len(lines):
        return _Fault(len(lines), f"line {count + 1} was added from outside")
    return None


def _verify(signed: smime.SignedDocument, authorities: Sequence[x509.Certificate]) -> None:
    """Raise `PkiError` unless one of the CAs signed the document."""
    for each in authorities:
        with suppress(PkiError):
            return signed.verify(each)
    raise PkiError("no CA of this keystore signed it")


# ── writing ────────────────────────────────────────────────────────────────────────────────


def append(
    transaction: Transaction, entries: Iterable[Entry], authority: Authority, now: datetime
) -> None:
    """Stage the ledger with ``entries`` added at its end, and its head, signed by ``authority``.

    What is wrong with the present ledger is recorded first, so that the new head hides nothing.
    """
    added = list(entries)
    if not added:
        return
    present = _read(transaction.root, follow_link=transaction.dry_run)
    lines = list(present.lines)
    before = lines[-1:] if present.chained else lines
    gaps = (Entry(iso(now), GAP, reason=e.text, number=e.line) for e in present.unrecorded)
    for entry in (*gaps, *added):
        lines.append(_line(replace(entry, previous=_digest(b"\n".join(before)))))
        before = lines[-1:]
    head = f"sros ledger 1\nlines {len(lines)}\nsha256 {_digest(lines[-1])}\n".encode()
    transaction.write(LEDGER, b"".join(line + b"\n" for line in lines))
    transaction.write(LEDGER_HEAD, authority.sign(head, "the head of the ledger"))


def _line(entry: Entry) -> bytes:
    filled = {name: value for name in _FIELDS if (value := getattr(entry, name))}
    return json.dumps(filled, separators=(",", ":")).encode()
