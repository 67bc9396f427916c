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
import io
import json
import re
from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, fields, replace
from datetime import datetime
from functools import lru_cache
from itertools import islice
from pathlib import Path
from shlex import quote
from sys import intern
from typing import TYPE_CHECKING, NamedTuple

from cryptography import x509
from cryptography.hazmat.primitives import hashes

from sros_tool.errors import DocumentError, KeystoreError, PkiError, SrosError
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
    of the files sent to a robot), settings (of the keystore, with the whole TOML text in
    ``settings``), or gap (``reason`` says what was wrong with the lines up to ``number``).
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
    settings: str = ""
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


# Ten thousand enclaves that are renewed every month write 150 MB a year, in 240,000 lines.
_MOST_BYTES = 512 * 1024 * 1024
_MOST_LINES = 1_000_000
_FIELDS = tuple(each.name for each in fields(Entry))
_TEXTS = tuple(each.name for each in fields(Entry) if each.type == "str")
_REPEATED = frozenset(
    ("time", "what", "enclave", "subject", "not_before", "not_after", "policy", "reason")
)
_SERIAL = re.compile(r"[0-9a-f]{1,40}")
_MOST_BITS = 159
"""The length of a serial number (RFC 5280, 4.1.2.2)."""
_MOST_NUMBER = 10**12
_MOST_REMEMBERED = 64 * 1024 * 1024
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
    """The ledger, its bytes, and the faults that no entry ``gap`` records yet."""

    ledger: Ledger
    data: bytes = b""
    chained: bool = False
    unrecorded: Sequence[_Fault] = ()


def _read(root: Path, *, follow_link: bool = True) -> _Reading:
    while True:
        data = _bytes(root, follow_link)
        reading = _compare(root, data)
        # A transaction of another process may have ended between the reading of the two files.
        if not reading.unrecorded or _bytes(root, follow_link) == data:
            return reading


def _compare(root: Path, data: bytes | None) -> _Reading:
    """Return the ledger with these bytes, compared with its head."""
    if not data:
        if data is None and not any((root / file).exists() for file in (SETTINGS, LEDGER_HEAD)):
            return _Reading(Ledger())
        missing = _Fault(0, f"there is no {LEDGER}" if data is None else f"{LEDGER} is empty")
        return _Reading(Ledger(gaps=(missing.text,)), unrecorded=[missing])
    reader = _remembered if len(data) <= _MOST_REMEMBERED else _read_lines
    read = reader(data, _MOST_LINES)
    if read is None:
        raise _too_large(root / LEDGER, f"{_MOST_LINES} lines")
    numbered, number, chained = read.entries, read.lines, read.chained
    faults = [*read.faults]
    authorities = _authorities(root)
    if fault := _head_fault(root, data, number, authorities, chained=chained):
        faults.append(fault)
    recorded = [_Fault(each.number, each.reason) for _, each in numbered if each.what == GAP]
    last_recorded = max((at for at, each in numbered if each.what == GAP), default=0)
    start = _first_of(authorities, numbered)
    every = [*recorded, *faults]
    last = max((each.line for each in every), default=0)
    ledger = Ledger(
        tuple(entry for _, entry in numbered),
        tuple(dict.fromkeys(each.text for each in every if each.line >= start)),
        tuple(entry for at, entry in numbered if at > last),
        0 if start > read.unchained else read.unchained,
        number,
    )
    unrecorded = [each for each in faults if each.line >= last_recorded]
    return _Reading(ledger, data, chained, unrecorded)


class _Lines(NamedTuple):
    """The entries in a ledger's bytes with the numbers of their lines, and faults of the chain.

    ``unchained`` is the number of lines before the chain, ``lines`` that of all.
    """

    entries: Sequence[tuple[int, Entry]]
    faults: Sequence[_Fault]
    lines: int
    unchained: int
    chained: bool


def _read_lines(data: bytes, most: int) -> _Lines | None:
    """Return the lines of a ledger, or None if there are more than ``most``."""
    numbered: list[tuple[int, Entry]] = []
    faults: list[_Fault] = []
    damaged = 0  # how many lines before this one are no entries
    unchained = number = 0
    chained = False
    line, all_before = b"", hashlib.sha256()
    for number, (before, line) in enumerate(_with_previous(data), 1):
        if number > most:
            return None
        if not chained and number > 1:
            all_before.update((b"\n" if number > 2 else b"") + before)
        entry = _parse(line)
        if entry is None:
            damaged += 1
            continue
        if damaged:
            faults.append(_not_entries(number - 1, damaged))
        if chained and not entry.previous:
            faults.append(_Fault(number, f"line {number} was added from outside"))
        elif entry.previous:
            expected = _digest(before) if chained else all_before.hexdigest()
            if entry.previous != expected and not damaged:
                text = f"before line {number}, a line was changed or removed"
                faults.append(_Fault(number - 1, text))
            if not chained:
                chained, unchained = True, number - 1
        damaged = 0
        numbered.append((number, entry))
    if damaged:
        faults.append(_not_entries(number, damaged))
    if not chained:
        unchained = number
    return _Lines(numbered, faults, number, unchained, chained)


_remembered = lru_cache(maxsize=1)(_read_lines)  # a verb asks several times


def _not_entries(last: int, count: int) -> _Fault:
    """Return the fault of ``count`` lines up to the line ``last``."""
    if count == 1:
        return _Fault(last, f"line {last} is not an entry")
    return _Fault(last, f"lines {last - count + 1} to {last} are not entries")


def _lines_of(data: bytes) -> Iterator[bytes]:
    """Yield the lines one by one: a list of them would take as much memory again."""
    return (line.removesuffix(b"\n") for line in io.BytesIO(data))


def _with_previous(data: bytes) -> Iterator[tuple[bytes, bytes]]:
    """Yield each line after the line before it."""
    before = b""
    for line in _lines_of(data):
        yield before, line
        before = line


def _bytes(root: Path, follow_link: bool) -> bytes | None:
    """Return the content of the ledger, or None without one.

    While a transaction is being committed, the file is a link.  Whoever holds the lock of the
    keystore does not follow it: another link could lead to a file that is not of the keystore.
    """
    path = root / LEDGER
    try:
        if follow_link:
            return read_bytes(path, "ledger", most=_MOST_BYTES)
        from sros_tool.folders import Folder  # a question does not load what writes

        with Folder(root) as folder:
            return folder.read(LEDGER, most=_MOST_BYTES)
    except (OSError, SrosError) as error:
        cause = error.__cause__ if isinstance(error, DocumentError) else error
        if isinstance(cause, FileNotFoundError):
            return None
        if isinstance(cause, OSError) and cause.errno == errno.EFBIG:
            raise _too_large(path, f"{_MOST_BYTES // 1024**2} MiB") from error
        raise KeystoreError(
            f"the ledger '{path}' cannot be read",
            f"{error.strerror}." if isinstance(error, OSError) else error.why or f"{error.what}.",
            "Restore it from a backup.",
        ) from error


def _too_large(path: Path, limit: str) -> KeystoreError:
    root = path.parent
    return KeystoreError(
        f"the ledger '{path}' is too large",
        f"It has more than {limit}.",
        f"If all of it is of this keystore, move {LEDGER} and {LEDGER_HEAD} to an archive, state "
        f"all rights again with `sros generate_artifacts -k {quote(str(root))} -p POLICY_FILE`, "
        "and replace "
        f"the CAs with `sros rotate_ca {quote(str(root))} --next`, so that nothing that the new "
        "ledger lacks "
        "is valid. Otherwise restore it from a backup.",
    )


def _parse(line: bytes) -> Entry | None:
    """Return the entry of a line, or None if it is not an entry."""
    if not line.startswith(b"{"):
        return None
    try:
        entry = Entry(**json.loads(line, object_pairs_hook=_shared))
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


def _shared(pairs: list[tuple[str, object]]) -> dict[str, object]:
    """Return the fields of a line; texts that many lines have are in the memory once."""
    return {
        name: intern(value) if name in _REPEATED and isinstance(value, str) else value
        for name, value in pairs
    }


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
    root: Path,
    data: bytes,
    lines: int,
    authorities: Sequence[x509.Certificate],
    *,
    chained: bool,
) -> _Fault | None:
    """Return what is wrong between the ledger and its signed head, or None."""
    if not (root / LEDGER_HEAD).exists():
        text = f"{LEDGER_HEAD}, which signs its end, is missing"
        return _Fault(lines, text) if chained else None
    try:
        signed = smime.parse(read_bytes(root / LEDGER_HEAD, "signed head of the ledger"))
        if authorities:
            _verify(signed, authorities)
        stated = _HEAD.fullmatch(signed.text)
    except SrosError as error:
        return _Fault(lines, f"{LEDGER_HEAD} does not sign its end: {error.what}")
    if not stated:
        return _Fault(lines, f"{LEDGER_HEAD} is not the signed end of a ledger")
    count = int(stated[1])
    if count > lines:
        missing = count - lines
        text = f"{missing} line{'s are' if missing > 1 else ' is'} missing at its end"
        return _Fault(lines, text)
    if not count or _digest(next(islice(_lines_of(data), count - 1, None))) != stated[2].decode():
        return _Fault(lines, f"its last lines are not the ones that {LEDGER_HEAD} signs")
    if count < lines:
        return _Fault(lines, f"line {count + 1} was added from outside")
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
    data, number, chained = present.data, present.ledger.lines, present.chained
    if data and not data.endswith(b"\n"):
        data += b"\n"
    before = data.removesuffix(b"\n")
    if chained:
        before = before[before.rfind(b"\n") + 1 :]
    gaps = (Entry(iso(now), GAP, reason=e.text, number=e.line) for e in present.unrecorded)
    new = []
    for entry in (*gaps, *added):
        before = _line(replace(entry, previous=_digest(before)))
        new.append(before)
    head = f"sros ledger 1\nlines {number + len(new)}\nsha256 {_digest(before)}\n".encode()
    transaction.write(LEDGER, b"".join((data, *(line + b"\n" for line in new))))
    transaction.write(LEDGER_HEAD, authority.sign(head, "the head of the ledger"))


def _line(entry: Entry) -> bytes:
    filled = {name: value for name in _FIELDS if (value := getattr(entry, name))}
    return json.dumps(filled, separators=(",", ":")).encode()
