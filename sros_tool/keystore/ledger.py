"""The ledger of a keystore: every certificate and signed document that it ever issued.

The file has one JSON object per line; lines are only added.  Entries are part of the transaction
that issues, so the ledger has exactly the certificates and documents that were installed.

The lines are a chain: ``previous`` is the SHA-256 of the line before, without its line end, or of
nothing on the first line.  The signed document ``ledger.p7s`` states the number of lines and the
SHA-256 of the last line.  So a changed, removed, added or truncated line is
noticed.  If a fault is noticed when a line is added, an entry ``gap`` before the new line records
the fault.

The head of a long ledger also states the root of its index (`sros_tool.keystore.ledger_index`).  A
question that the index can answer reads only the lines to which the index leads, each verified by
its digest, and the end of the ledger.  Changes in other lines are noticed when all lines are read.

A change that makes the file longer than 16 MiB seals the file: it becomes the part
``ledger.0001.jsonl``, which is never written again, and ``ledger.jsonl`` becomes a link to the next
part.  Each part begins with an entry ``sealed`` with the number and the SHA-256 of the part before.
A sealed part is opened only to read all lines, and is refused if it was changed since it was
sealed. All other questions get the lines of sealed parts from the index.  Versions of sros that do
not know parts refuse to follow the link when they change a keystore.
"""

from __future__ import annotations

import errno
import hashlib
import io
import json
import os
import re
import stat
from array import array
from bisect import bisect_right
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from contextlib import suppress
from datetime import datetime, timedelta
from functools import lru_cache
from itertools import chain, groupby
from pathlib import Path
from shlex import quote
from sys import intern
from typing import TYPE_CHECKING, BinaryIO, NamedTuple, TypeAlias

from cryptography import x509
from cryptography.hazmat.primitives import hashes

from sros_tool.errors import IndexDamagedError, KeystoreError, Note, PkiError, SrosError
from sros_tool.keystore.layout import (
    LEDGER,
    LEDGER_HEAD,
    LEDGER_INDEX,
    SEALED_LEDGER,
    SETTINGS,
    ledger_part,
)
from sros_tool.pki import smime
from sros_tool.pki.certificates import digest, subject_text, validity_of
from sros_tool.validity import Window, elapsed, iso, parse_iso
from sros_tool.xml import open_without_waiting, read_bytes

if TYPE_CHECKING:
    from sros_tool.keystore.ledger_index import IndexUpdate, LedgerIndex, Posting
    from sros_tool.keystore.transaction import Transaction

GAP = "gap"
LEDGER_REMEDY = (
    "Restore ledger.jsonl and ledger.p7s from the same backup. Without a backup, state all "
    "rights again with `sros generate_artifacts -k KEYSTORE -p POLICY_FILE`, and replace the "
    "CAs, with `sros rotate_ca KEYSTORE --next` for each stage: after the last stage, files that "
    "the ledger lacks are no longer valid."
)
"""What to do about a ledger with missing or changed lines."""
SEALED = "sealed"
RESTORED = "restored"
LEFT = "left"
"""The ``what`` of a line on an enclave whose robot (the ``reason``) left the fleet or its group."""
REPORTED = "reported"
"""The ``reason`` of a certificate that is known only from a robot's message.

Such a certificate can be revoked, but proves nothing.
"""
LATER_RELEASE = "later release"
"""The ``reason`` of a restore that the seal of a later release on a robot showed."""
PUBLISHING = "publishing"
"""The ``reason`` of a restore that `sros fleet publish --restored` recorded.

A line with an enclave says that publishing was refused, and named rights that the enclave had lost.
"""
PERHAPS_REVOKED = "perhaps revoked"
"""The ``reason`` of a restore, on a line with an enclave that was perhaps revoked.

Publishing waits until the enclave is revoked, or has a key that the ledger records after this line.
"""
ON_ROBOT_ONLY = "on robot only"
"""The ``reason`` of a restore, on a line with an enclave of a release that the keystore lacks."""
LOST_CA = "lost CA"
"""The ``reason`` of a restore after which robots have certificates of a later identity CA.

Publishing waits until the keystore has an identity CA that the ledger records after this line.
"""
RENEWED_BY_NAME = "renewed by name"
"""The ``reason`` of permissions that `sros renew` signed for a named enclave after a restore."""
BY_POLICY = "by policy"
"""The ``reason`` of permissions that a policy stated in a keystore that was restored.

If the policy changed nothing, the line repeats that of the present permissions.
"""
NEW_CA = "new CA"
"""The ``reason`` of a governance that a rotation signed again, without a change."""
SAME_KEY = "same key"
"""The ``reason`` of a CA certificate with the same key as the CA's previous certificate."""
FROM_BEFORE = "from before the ledger"
"""The ``reason`` of a CA that a rotation replaces, but that the ledger lacked.

The ledger can lack it because earlier lines were lost.
"""
RECORDED_LATE = (SAME_KEY, FROM_BEFORE)
"""The ``reason`` values of a CA certificate whose key may have issued what earlier lines record."""


class Entry(NamedTuple):
    """A line of the ledger: an issued certificate or document, or a revocation.

    Times are ISO 8601 in UTC.  Fields that do not apply are empty strings.
    """

    time: str
    """When the entry was written, in UTC."""
    what: str
    """What was issued or done: ``ca``, ``certificate``, ``permissions``, ``governance``, ``crl``,
    ``revocation``, ``answer`` (the signed list of the files sent to a robot), ``settings`` (of the
    keystore), ``fleet``, ``release`` (the list of the robots' releases that were published
    together), ``sealed`` (the part of the ledger before this line), ``restored`` (the keystore came
    from a backup, so that entries are missing), ``left`` (the robot of the enclave left the fleet,
    or the group of the enclave), or ``gap`` (lines before this one were missing or
    changed).
    """
    enclave: str = ""
    """Name of the enclave; empty if the entry is not about an enclave.  All later keys are also
    empty if they do not apply.
    """
    subject: str = ""
    """Subject of the certificate."""
    serial: str = ""
    """Serial number, in hexadecimal."""
    sha256: str = ""
    """SHA-256 of the certificate (DER), the document, or the sealed part."""
    not_before: str = ""
    """Start of the validity, in UTC."""
    not_after: str = ""
    """Expiry, in UTC; for a revocation, the expiry of the revoked certificate."""
    policy: str = ""
    """SHA-256 of the policy, with its includes, from which the permissions were made."""
    reason: str = ""
    """The reason of a revocation; the fault that a gap records; what showed a restore; the robot
    that left; why a
    document was signed again; or, if the keystore did not issue the certificate with this line, how
    the certificate became known.
    """
    key: str = ""
    """SHA-256 of the public key (DER) of the certificate, or of the revoked certificate."""
    number: int = 0
    """By `what`. Of an answer or a release: its number (later ones have higher numbers). Of a gap:
    the number of the last line that is missing or changed. Of a sealed part: its number. Of a
    restore: a number above all that the keystore gave before. Otherwise 0.
    """
    settings: str = ""
    """The settings of the keystore, as TOML."""
    nodes: str = ""
    """Nodes (namespaces and names) that the policy names, but that the permissions do not show."""
    previous: str = ""
    """SHA-256 of the line before."""


class Ledger(NamedTuple):
    """The readable entries of a ledger, oldest first, and its faults.

    ``gaps`` are clauses about missing, changed or unreadable lines.  Faults from before the present
    CAs are left out, because nothing that earlier CAs signed is valid.  ``certain`` are the entries
    after the last gap, among which none is missing.  ``lines`` is the number of all lines.
    """

    entries: tuple[Entry, ...] = ()
    gaps: tuple[str, ...] = ()
    certain: tuple[Entry, ...] = ()
    lines: int = 0

    def next_number(self) -> int:
        """Return the number for a new answer, higher than the numbers of all earlier answers."""
        return max([self.lines, *(entry.number for entry in self.entries)]) + 1


class _Fault(NamedTuple):
    """A fault in the lines up to the line number ``line``; ``text`` is a clause about it."""

    line: int
    text: str


# These are the limits of one part, and for reading all lines, of all parts together.
_MOST_BYTES = 4 * 1024**3
_MOST_LINES = 8_000_000
_LONGEST_LINE = 4 * 1024**2
_LAST_LINES_BYTES = 64 * 1024
_BLOCK_BYTES = 1024**2
_TEXT_FIELDS = tuple(name for name in Entry._fields if name != "number")
_SERIAL = re.compile(r"[0-9a-f]{1,40}")
_MOST_SERIAL_BITS = 159
"""Largest length of a serial number, in bits (RFC 5280, 4.1.2.2)."""
_MOST_NUMBER = 10**12
_MOST_CACHED_BYTES = 16 * 1024 * 1024
_SEAL_FROM_BYTES = 16 * 1024 * 1024
"""Size in bytes from which a part is sealed, because each change copies the last part."""
_USUAL_LINE_BYTES = 450
"""Usual length of a line, in bytes."""
_HEAD_TEXT = re.compile(
    rb"sros ledger [12]\nlines ([0-9]{1,12})\nsha256 ([0-9a-f]{64})\n(?:index ([0-9a-f]{64})\n)?"
)
_INDEX_FROM_LINES = 2000
"""Number of lines from which a ledger has an index; a shorter ledger is quickly read as a whole."""
_LINES_PER_LOOKUP = 5
"""Number of lines that take as long to read as one look-up in the index takes."""
_VALUE_PATTERNS = {
    "serial": r'"(?P<serial>[0-7][0-9a-f]{39}|[0-9a-f]{1,39})"',
    "number": r"([1-9][0-9]{0,11})",
}
_TEXT_PATTERN = r'"([^"\\\x00-\x1f]+)"'
_WRITTEN_LINE = re.compile(
    r"\{"
    + r"".join(
        f'{"," if index else ""}"{name}":{_VALUE_PATTERNS.get(name, _TEXT_PATTERN)}'
        if name in ("time", "what")
        else f'(?:,"{name}":{_VALUE_PATTERNS.get(name, _TEXT_PATTERN)})?'
        for index, name in enumerate(Entry._fields)
    )
    + r"\}"
)
"""Matches a line as `_json_line` writes it, without escaped characters; each field is a group."""
_json_text = json.encoder.encode_basestring_ascii


# ── entries ────────────────────────────────────────────────────────────────────────────────


_CLOCK_TOLERANCE = timedelta(hours=1)
"""How far behind the clock may be before it counts as wrong."""


def clock_behind_clause(now: datetime, last: datetime | None, event: str) -> str:
    """Return how far the clock is behind the time ``last`` of ``event``, as a clause, or "".

    Small differences are ignored.
    """
    if last is None or last - now <= _CLOCK_TOLERANCE:
        return ""
    return (
        f"the clock of this machine shows {iso(now)}, {elapsed(last - now)} behind {event}, of "
        f"{iso(last)}"
    )


def certificate_entry(
    now: datetime, label: str, certificate: x509.Certificate, enclave: str = "", reason: str = ""
) -> Entry:
    """Return the entry for an issued certificate; ``label`` is "ca" or "certificate"."""
    from sros_tool.pki.certificates import key_digest  # only writing needs this import

    validity = validity_of(certificate)
    return Entry(
        time=iso(now),
        what=label,
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
    label: str,
    message: bytes,
    *,
    enclave: str = "",
    subject: str = "",
    validity: Window | None = None,
    policy: str = "",
    nodes: str = "",
    number: int = 0,
) -> Entry:
    """Return the entry for a signed document; ``label`` is the kind of document, as in `Entry`."""
    return Entry(
        time=iso(now),
        what=label,
        enclave=enclave,
        subject=subject,
        sha256=hashlib.sha256(message).hexdigest(),
        not_before=iso(validity.not_before) if validity else "",
        not_after=iso(validity.not_after) if validity else "",
        policy=policy,
        nodes=nodes,
        number=number,
    )


# ── reading ────────────────────────────────────────────────────────────────────────────────


class _Reading(NamedTuple):
    """The ledger as it was read, with the values needed for adding lines.

    ``unrecorded`` are the faults that no entry ``gap`` records yet.  ``previous`` is the digest for
    the next line.  ``ended`` says whether the last line has a line end.  ``sound`` says that every
    line belongs to the chain, and none has a fault.
    """

    ledger: Ledger
    unrecorded: Sequence[_Fault] = ()
    previous: str = hashlib.sha256().hexdigest()
    ended: bool = True
    sound: bool = True


_IN_EVERY_LINE = b""
_IN_NO_LINE = b"\n"
"""Values of ``needed_text``: a text that is in every line, and a text that is in no line."""
_GAP_TEXT, _CA_TEXT = b'"what":"gap"', b'"what":"ca"'


class _OpenedFiles(NamedTuple):
    """The ledger and its head, as they were at the same moment.

    ``state`` is None if there is no ledger.  ``lines`` is the content of the file; None if the file
    is too long to keep in memory, or follows sealed parts.  ``ledger_index`` is None if no index
    fits.  ``part`` is the number of the last part, which is the file.  ``later`` is the name of a
    later part; "" if there is none.  ``last_lines`` are the last lines of the file, which are not
    verified.
    """

    head: _Head | None
    state: os.stat_result | None
    lines: bytes | None
    ledger_index: LedgerIndex | None = None
    part: int = 1
    later: str = ""
    last_lines: tuple[bytes, ...] = ()


class LedgerFile:
    """The ledger file of a keystore and its signed head, which are read once.

    ``authorities`` returns the certificates of the CAs that the keystore trusts.  A ledger of more
    than 16 MiB is read again for each question.  ``follow_link`` is False in the process that has
    locked the keystore.  ``read_content`` reads the head the first
    time.
    """

    def __init__(
        self,
        root: Path,
        authorities: Callable[[], Sequence[x509.Certificate]],
        *,
        follow_link: bool = True,
        read_content: Callable[[Path, str], bytes] = read_bytes,
    ) -> None:
        self.root = root
        self._read_first = read_content
        self._authorities = authorities
        self._follow_link = follow_link
        self._files: _OpenedFiles | None = None
        self._readings: dict[bytes, _Reading] = {}
        self._recorded: Sequence[str] | None = None
        self._entries: dict[bytes, Entry] = {}
        self._may_restore = not follow_link

    def ledger(self) -> Ledger:
        """Return the ledger; an empty one for a keystore without a ledger (of ros2/sros2).

        Raises:
            KeystoreError: the file cannot be read at all.
        """
        return self._reading(_IN_EVERY_LINE).ledger

    def with_field(self, name: str, value: str) -> Ledger:
        """Return the ledger with at least the entries whose field ``name`` has the value ``value``.

        The chain of all lines is verified as always, but other entries may be left out to save
        time.

        Raises:
            KeystoreError: the file cannot be read at all.
        """
        if _IN_EVERY_LINE in self._readings:
            return self._readings[_IN_EVERY_LINE].ledger
        return self._reading(f'"{name}":{_json_text(value)}'.encode(), [(name, value)]).ledger

    def with_values(self, name: str, values: Collection[str]) -> Ledger:
        """Return the ledger with at least the entries whose field ``name`` has one of ``values``.

        Without an index, or for very many values, the whole ledger is returned.

        Raises:
            KeystoreError: the file cannot be read at all.
        """
        index = self._opened_files().ledger_index
        many = index is None or len(values) * _LINES_PER_LOOKUP > index.state.lines
        if index is None or (many and self.is_complete):
            return self.ledger()
        terms = [(name, value) for value in values]
        return self._reading_with(_IN_EVERY_LINE, terms).ledger

    def next_number(self) -> int:
        """Return the number for a new answer, as `Ledger.next_number` does."""
        if index := self._opened_files().ledger_index:
            state = index.state
            return max(state.lines, state.number) + 1
        return self.ledger().next_number()

    def recorded_enclaves(self) -> Sequence[str] | None:
        """Return the sorted enclaves whose last certificate is not revoked; None without an index.

        Some of them may be missing in the keystore, and enclaves that somebody copied into it are
        not included.
        """
        if self._recorded is None:
            names = self.recorded_enclaves_with()
            self._recorded = None if names is None else sorted(names)
        return self._recorded

    def recorded_enclaves_with(self, *parts: str) -> Collection[str] | None:
        """Return the `recorded_enclaves` with one of ``parts`` in their names, unsorted.

        The result is None without an index.
        """
        index = self._opened_files().ledger_index
        try:
            return index.names(parts) if index else None
        except IndexDamagedError:
            return self.recorded_enclaves_with(*parts) if self._remove_damaged_index() else None

    @property
    def is_indexed(self) -> bool:
        """Whether there is an index, so that a few entries are found quickly."""
        return self._opened_files().ledger_index is not None

    @property
    def is_complete(self) -> bool:
        """Whether no sealed part is missing, so that all lines can be read."""
        return all(
            (self.root / ledger_part(n)).exists() for n in range(1, self._opened_files().part)
        )

    def _opened_files(self) -> _OpenedFiles:
        if self._files is None:
            self._files = self._read()
        return self._files

    def reading_for_append(self) -> _Reading:
        """Return a reading with the values needed for adding lines; ``ledger`` may lack entries."""
        return self._readings.get(_IN_EVERY_LINE) or self._reading(_IN_NO_LINE, ())

    def index_update(self, new_lines: int, reading: _Reading) -> IndexUpdate | None:
        """Return the update of the index for so many new lines; None if there is no index.

        ``reading`` comes from `reading_for_append`.  A ledger with a fault gets no index, because
        only reading all lines shows which entries are certain.
        """
        if reading.ledger.lines + new_lines < _INDEX_FROM_LINES or not reading.sound:
            return None
        from sros_tool.keystore.ledger_index import IndexUpdate

        if index := self._opened_files().ledger_index:
            return IndexUpdate(self.root, index)
        with self._open() or io.BytesIO() as file:
            made, is_sound = self._new_index(file, self._opened_files().head)
            return made if is_sound else None

    def last_part(self) -> tuple[int, int]:
        """Return the number and the size, in bytes, of the part to which lines are added.

        Raises:
            KeystoreError: there is a later part, so an earlier ledger was put back.
        """
        files = self._opened_files()
        if files.later:
            raise self._later_part_error(files.later)
        return files.part, files.state.st_size if files.state else 0

    def clock_clause(self, now: datetime) -> str:
        """Return how far the clock is behind the last entries, as a clause, or ""."""
        return clock_behind_clause(now, self.last_time(), "the last entry of the ledger")

    def clock_notes(self, now: datetime) -> Iterator[Note]:
        """Yield a note if the clock is behind the ledger, so that expired files may seem valid."""
        with suppress(SrosError):  # `sros check` reports a ledger that cannot be read
            if behind := self.clock_clause(now):
                text = f"{behind}: expired files may count as valid. Set the clock."
                yield Note("keystore.clock", text)

    def last_time(self) -> datetime | None:
        """Return the time of the last entries, in UTC; None if there is no entry.

        This is the latest time among the entries from the last revocation list on.  Because several
        entries count, a single entry with an early time does not hide that the clock is behind.
        Because entries before the list do not count, a new list ends the effect of late times,
        which were written while the clock was ahead.
        """
        times = []
        for line in reversed(self._opened_files().last_lines):
            if entry := _parse_line(line):
                with suppress(ValueError):
                    times.append(parse_iso(entry.time))
                if entry.what == "crl":
                    break
        return max(times, default=None)

    def content(self) -> Iterator[bytes]:
        """Yield the bytes of the last part, in blocks."""
        if self._files and self._files.lines is not None:
            yield self._files.lines
            return
        with self._open() or io.BytesIO() as file:
            yield from iter(lambda: file.read(_BLOCK_BYTES), b"")

    def _reading(self, needed_text: bytes, terms: _FieldValues | None = None) -> _Reading:
        """Return the ledger; chained lines without ``needed_text`` are verified, not parsed.

        ``terms`` are the field values by which the index finds these lines; None if the index
        cannot find them.
        """
        if needed_text not in self._readings:
            self._readings[needed_text] = self._reading_with(needed_text, terms)
        return self._readings[needed_text]

    def _reading_with(self, needed_text: bytes, terms: _FieldValues | None) -> _Reading:
        while True:
            known = self._files
            files = known or self._read()
            try:
                lines = self._indexed_lines(files, terms)
            except IndexDamagedError:
                if self._remove_damaged_index():
                    continue
                files, lines = files._replace(ledger_index=None), None
            if lines:
                self._files = files
                return self._compared_with_head(files, lines)
            reading = self._compared_with_head(files, self._lines(files, needed_text))
            # Another process may have committed a transaction between reading the two files.
            kept = known is not None and known.lines is not None
            if kept or not reading.unrecorded or self._is_unchanged(files):
                self._files = files
                return reading
            self._files = None

    def _remove_damaged_index(self) -> bool:
        """Remove a damaged index, once; return whether this call removed it.

        The process that locks the keystore makes the index again.
        """
        may_restore, self._may_restore, self._files = self._may_restore, False, None
        if may_restore:
            from sros_tool.folders import Folder

            with suppress(OSError, SrosError), Folder(self.root) as folder:
                folder.unlink(LEDGER_INDEX, missing_ok=True)
        return may_restore

    def _read(self) -> _OpenedFiles:
        files = self._read_once()
        while files.later and not self._is_unchanged(
            files
        ):  # another process has just sealed a part
            files = self._read_once()
        return files

    def _read_once(self) -> _OpenedFiles:
        head = self._read_head(self._read_first)
        self._read_first = read_bytes
        file = self._open()
        if file is None:
            return _OpenedFiles(head, None, b"", later=self._file_with_later_lines(0))
        with file:
            state = os.fstat(file.fileno())
            before = _entry_of_part_before(file)
            part = before.number + 1 if before else 1
            start = max(0, state.st_size - _LAST_LINES_BYTES)
            last = tuple(os.pread(file.fileno(), _LAST_LINES_BYTES, start).split(b"\n"))[
                bool(start) :
            ]
            later = self._file_with_later_lines(part, state)
            if head and (index := self._index(file, head)):
                return _OpenedFiles(head, state, None, index, part, later, last)
            kept = state.st_size <= _MOST_CACHED_BYTES and not before
            lines = file.read() if kept else None
            return _OpenedFiles(head, state, lines, None, part, later, last)

    def _index(self, file: BinaryIO, head: _Head) -> LedgerIndex | None:
        """Return the index that the head states; None if no index fits the end of this ledger.

        If the index is missing, or another version of sros made it, a process that has locked the
        keystore makes a new index.
        """
        is_long = head.lines >= _INDEX_FROM_LINES
        if not head.index_root and (self._follow_link or not is_long):
            return None
        from sros_tool.keystore.ledger_index import LedgerIndex

        index = LedgerIndex.open(self.root, head.lines, head.last, head.index_root)
        if index is None and not self._follow_link:
            made, is_sound = self._new_index(file, head)
            root = made.root()
            if root == head.index_root or is_sound:
                made.save()
                index = LedgerIndex.open(self.root, head.lines, head.last, root)
        last_size = index.state.size - index.state.sealed_size if index else 0
        ends_so = index and _last_line_digest(file, last_size) == head.last
        file.seek(0)
        return index if ends_so else None

    def _indexed_lines(self, files: _OpenedFiles, terms: _FieldValues | None) -> _ReadLines | None:
        """Return the lines that the index finds; None if it is missing or cannot find ``terms``.

        Raises:
            IndexDamagedError: the index, or a line to which it leads, was changed.
        """
        if files.ledger_index is None or files.head is None or terms is None:
            return None
        from sros_tool.keystore.ledger_index import is_indexed, merged_postings

        if not all(is_indexed(*term) for term in terms):
            return None
        index, head = files.ledger_index, files.head
        terms = dict.fromkeys([*terms, ("what", "ca"), ("what", GAP)])
        postings = merged_postings(index.postings(*term) for term in terms)
        with self._open() or io.BytesIO() as file:
            for posting in postings:
                if posting.digest not in self._entries:
                    self._entries[posting.digest] = _entry_at(posting, index, file)
        entries = tuple(self._entries[posting.digest] for posting in postings)
        numbers = [posting.number for posting in postings]
        return _ReadLines(entries, numbers, (), head.lines, head.last, head.last, ended=True)

    def _read_head(self, read_content: Callable[[Path, str], bytes]) -> _Head | None:
        """Return the head of the ledger; None if there is none."""
        path = self.root / LEDGER_HEAD
        if not path.exists():
            return None
        try:
            signed = smime.parse(read_content(path, "signed head of the ledger"))
            if authorities := self._authorities():
                _check_signer(signed, authorities)
            stated = _HEAD_TEXT.fullmatch(signed.text)
        except SrosError as error:
            return _Head(fault=f"{LEDGER_HEAD} does not sign the end of the ledger: {error.what}")
        if not stated:
            return _Head(fault=f"{LEDGER_HEAD} is not the signed end of a ledger")
        return _Head(int(stated[1]), stated[2].decode(), index_root=(stated[3] or b"").decode())

    def _is_unchanged(self, files: _OpenedFiles) -> bool:
        """Return whether the ledger and the head on disk are unchanged since they were read."""
        state = None
        with suppress(OSError):
            state = (self.root / LEDGER).stat()
        if state is None or files.state is None:
            is_same = state is files.state
        else:
            is_same = os.path.samestat(state, files.state)
        return is_same and self._read_head(read_bytes) == files.head

    def _lines(self, files: _OpenedFiles, needed_text: bytes) -> _ReadLines:
        stated = files.head.lines if files.head else 0
        if files.lines is not None:
            read = _read_remembered_lines(
                files.lines, needed_text, stated, _MOST_LINES, _MOST_BYTES
            )
        else:
            with self._open() or io.BytesIO() as file:
                lines = self._every_line(file)
                read = _read_lines(lines, needed_text, stated, _MOST_LINES, _MOST_BYTES)
        if read is None:
            raise _too_large_error(self.root / LEDGER)
        return read

    # ── sealed parts ───────────────────────────────────────────────────────────────────────

    def _every_line(
        self, last_part: BinaryIO, after_part: Callable[[str], None] = lambda _: None
    ) -> Iterator[bytes]:
        """Yield the lines of all parts (the last is open); call ``after_part`` after each part.

        Raises:
            KeystoreError: a sealed part is missing, or is not as it was sealed.
        """
        before = _entry_of_part_before(last_part)
        parts = [before] if before else []
        while parts and parts[-1].number > 1:
            with self._part(parts[-1]) as file:
                before = _entry_of_part_before(file)
            if before is None or before.number != parts[-1].number - 1:
                raise self._not_as_sealed_error(parts[-1])
            parts.append(before)
        for part in reversed(parts):
            digest = hashlib.sha256()
            with self._part(part) as file:
                for line in _lines_in(file):
                    digest.update(line)
                    yield line
            if digest.hexdigest() != part.sha256:
                raise self._not_as_sealed_error(part)
            after_part(ledger_part(part.number))
        yield from _lines_in(last_part)

    def _part(self, sealed: Entry) -> BinaryIO:
        """Return the sealed part that the entry ``sealed`` records, open for reading."""
        name = ledger_part(sealed.number)
        if file := self._open(name):
            return file
        raise KeystoreError(
            f"{name}, a sealed part of the ledger of '{self.root}', is missing",
            "This command needs all lines of the ledger.",
            "Copy it back from your archive.",
        )

    def _new_index(self, last_part: BinaryIO, head: _Head | None) -> tuple[IndexUpdate, bool]:
        """Return an index of all lines, and whether the lines are the chain that ``head`` signs.

        ``last_part`` must be from the same reading as ``head``, because between two readings,
        another process that can write to the keystore could exchange a part.

        Raises:
            KeystoreError: as `_every_line`.
        """
        from sros_tool.keystore.ledger_index import IndexUpdate

        index = IndexUpdate(self.root, None)

        def indexed() -> Iterator[bytes]:
            for line in self._every_line(last_part, index.seal):
                text = line.removesuffix(b"\n")
                if entry := _parse_line(text):
                    index.add(entry, text)
                yield line

        stated = head.lines if head else 0
        read = _read_lines(indexed(), _IN_NO_LINE, stated, _MOST_LINES, _MOST_BYTES)
        if read is None or read.faults:
            return index, False
        return index, not _head_fault(head, read.lines, read.signed)

    def _compared_with_head(self, files: _OpenedFiles, read: _ReadLines) -> _Reading:
        if not read.lines:
            return self._without_lines(file_exists=files.state is not None)
        entries, numbers, faults = read.entries, read.numbers, [*read.faults]
        if fault := _head_fault(files.head, read.lines, read.signed):
            faults.append(fault)
        if files.later:
            text = f"{files.later} is a later part of the ledger, so an earlier ledger was put back"
            faults.append(_Fault(read.lines, text))
        recorded = [_Fault(entry.number, entry.reason) for entry in entries if entry.what == GAP]
        gaps = (at for at, entry in zip(numbers, entries, strict=True) if entry.what == GAP)
        last_recorded = max(gaps, default=0)
        start = _first_ca_line(self._authorities(), zip(numbers, entries, strict=True))
        all_faults = [*recorded, *faults]
        last_fault = max((fault.line for fault in all_faults), default=0)
        ledger = Ledger(
            entries,
            tuple(dict.fromkeys(fault.text for fault in all_faults if fault.line >= start)),
            entries[bisect_right(numbers, last_fault) :],
            read.lines,
        )
        unrecorded = [fault for fault in faults if fault.line >= last_recorded]
        return _Reading(ledger, unrecorded, read.previous, read.ended, not faults)

    def _open(self, name: str = LEDGER) -> BinaryIO | None:
        """Return the ledger file, or its part ``name``, open for reading; None if there is none.

        While a transaction is committed, the file is a link.  The process that has locked the
        keystore does not follow the link, because the link could lead out of the keystore.
        """
        path = self.root / name
        try:
            if self._follow_link:
                return _checked_regular_file(open_without_waiting(path))
            from sros_tool.folders import Folder  # reading alone does not import modules that write

            with Folder(self.root) as folder:
                target = folder.link_target(name) or ""
                file = target if SEALED_LEDGER.fullmatch(target) else name
                return _checked_regular_file(folder.open(file))
        except FileNotFoundError:
            return None
        except (OSError, SrosError) as error:
            if isinstance(error, OSError) and error.errno == errno.EFBIG:
                raise _too_large_error(path) from error
            raise KeystoreError(
                f"the ledger '{path}' cannot be read",
                f"{error.strerror}."
                if isinstance(error, OSError)
                else error.why or f"{error.what}.",
                "Restore it from a backup.",
            ) from error

    def _without_lines(self, *, file_exists: bool) -> _Reading:
        """Return the reading of a ledger file that is missing or has no lines.

        This is a fault, except in a keystore that never had a ledger (of ros2/sros2).
        """
        had_ledger = any((self.root / file).exists() for file in (SETTINGS, LEDGER_HEAD))
        if not file_exists and not had_ledger:
            return _Reading(Ledger())
        missing = _Fault(0, f"{LEDGER} is empty" if file_exists else f"there is no {LEDGER}")
        return _Reading(Ledger(gaps=(missing.text,)), [missing])

    def _file_with_later_lines(self, part: int, last: os.stat_result | None = None) -> str:
        """Return the name of a file that has lines after the last known part; "" if there is none.

        ``part`` is the number of the last known part.  ``last`` is the state of this part's file,
        which can also have another name, or be a copy.
        """
        if not self.root.exists():
            return ""
        for name in sorted(filter(SEALED_LEDGER.fullmatch, os.listdir(self.root)), reverse=True):
            number = int(name.split(".")[1])
            with suppress(OSError):  # a link of a transaction that is not yet committed
                state = (self.root / name).stat()
                is_last = last and os.path.samestat(state, last)
                is_longer = number == part and last and state.st_size > last.st_size
                if (number > part and not is_last) or is_longer:
                    return name
        return ""

    def _later_part_error(self, name: str) -> KeystoreError:
        return KeystoreError(
            f"'{self.root / name}' is a later part of the ledger than {LEDGER}",
            "An earlier ledger was put back. It lacks what the keystore issued and revoked later.",
            f"Restore {LEDGER}, its parts and {LEDGER_HEAD} from the latest backup; or, if they "
            "are lost, move the later parts to an archive.",
        )

    def _not_as_sealed_error(self, sealed: Entry) -> KeystoreError:
        return KeystoreError(
            f"{ledger_part(sealed.number)} is not the sealed part of the ledger of '{self.root}'",
            "It was changed, cut off or exchanged.",
            "Copy the sealed part back from your archive.",
        )


def _lines_in(file: BinaryIO) -> Iterator[bytes]:
    return iter(lambda: file.readline(_LONGEST_LINE), b"")


def _entry_of_part_before(file: BinaryIO) -> Entry | None:
    """Return the first entry in ``file`` if it records the sealed part before, or None."""
    line = file.readline(_LONGEST_LINE)
    file.seek(0)
    entry = _parse_line(line.removesuffix(b"\n")) if b'"what":"sealed"' in line else None
    return entry if entry and entry.what == SEALED else None


def _entry_at(posting: Posting, index: LedgerIndex, last_part: BinaryIO) -> Entry:
    """Return the entry to which a posting leads, in the index or the last part of the ledger.

    Raises:
        IndexDamagedError: the line was changed.
    """
    state = index.state
    if posting.number <= state.sealed:
        line = index.line(posting.number)
    else:
        line = os.pread(last_part.fileno(), posting.length, posting.offset - state.sealed_size)
    entry = _parse_line(line)
    if hashlib.sha256(line).digest() != posting.digest or entry is None:
        raise IndexDamagedError(f"line {posting.number} was changed")
    return entry


_FieldValues: TypeAlias = Collection[tuple[str, str]]
"""Names of an entry's fields, each with a value."""


def _last_line_digest(file: BinaryIO, size: int) -> str:
    """Return the digest of the last line of a ledger of ``size`` bytes; "" if the size differs."""
    if os.fstat(file.fileno()).st_size != size:
        return ""
    file.seek(max(0, size - _LONGEST_LINE))
    before, ended, after_last = file.read().rpartition(b"\n")
    return _sha256(before.rpartition(b"\n")[2]) if ended and not after_last else ""


class _ReadLines(NamedTuple):
    """The entries in a ledger with the ``numbers`` of their lines, and the faults of the chain.

    ``lines`` is the number of all lines.  ``signed`` is the digest of the line that the head states
    as the last one.  The other fields are as in `_Reading`.
    """

    entries: tuple[Entry, ...]
    numbers: Sequence[int]
    faults: Sequence[_Fault]
    lines: int
    signed: str
    previous: str
    ended: bool


def _read_lines(
    lines: Iterable[bytes], needed_text: bytes, stated: int, maximum: int, most_bytes: int
) -> _ReadLines | None:
    """Return the lines of a ledger; None if there are too many.

    At most ``maximum`` lines and ``most_bytes`` bytes are read.  ``stated`` is the number of lines
    that the head states; ``needed_text`` is as in `LedgerFile._reading`.
    """
    entries: list[Entry] = []
    numbers, added = array("Q"), array("Q")
    faults: list[_Fault] = []
    damaged = 0  # number of lines directly before this one that are not entries
    number = size = 0
    line = b""
    # The digests of the previous line, and of the line with the number ``stated``.
    last, signed = _sha256(b""), ""
    for number, line in enumerate(lines, 1):
        size += len(line)
        if number > maximum or size > most_bytes:
            return None
        text = line.removesuffix(b"\n")
        if (
            not damaged
            and needed_text not in text
            and text.endswith(b'","previous":"%b"}' % last.encode())
            and _GAP_TEXT not in text
            and _CA_TEXT not in text
        ):
            pass  # either unchanged since the head was signed, or a later line does not fit
        elif (entry := _parse_line(text)) is None:
            damaged += 1
        else:
            if damaged:
                faults.append(_not_entries_fault(number - 1, damaged))
            if not entry.previous:
                added.append(number)
            elif entry.previous != last and not damaged:
                reason = f"before line {number}, a line was changed or removed"
                faults.append(_Fault(number - 1, reason))
            damaged = 0
            entries.append(entry)
            numbers.append(number)
        last = _sha256(text)
        if number == stated:
            signed = last
    if damaged:
        faults.append(_not_entries_fault(number, damaged))
    faults = sorted([*faults, *_added_faults(added)], key=lambda fault: fault.line)
    ended = line.endswith(b"\n") or not number
    return _ReadLines(tuple(entries), numbers, faults, number, signed, last, ended)


@lru_cache(maxsize=4)  # a verb asks several times
def _read_remembered_lines(
    data: bytes, needed_text: bytes, stated: int, maximum: int, most_bytes: int
) -> _ReadLines | None:
    return _read_lines(_lines_in(io.BytesIO(data)), needed_text, stated, maximum, most_bytes)


def _not_entries_fault(last: int, count: int) -> _Fault:
    """Return the fault of ``count`` lines up to the line ``last``."""
    if count == 1:
        return _Fault(last, f"line {last} is not an entry")
    return _Fault(last, f"lines {last - count + 1} to {last} are not entries")


def _added_faults(numbers: Iterable[int]) -> Iterator[_Fault]:
    """Yield a fault for each run of lines that do not name the line before them."""
    for _, run in groupby(enumerate(numbers), key=lambda pair: pair[1] - pair[0]):
        first, *more = (number for _, number in run)
        lines = f"lines {first} to {more[-1]} were" if more else f"line {first} was"
        yield _Fault(more[-1] if more else first, f"{lines} added by another program")


def _checked_regular_file(file: BinaryIO) -> BinaryIO:
    """Return ``file``; close it and raise OSError if it is too large or not a regular file."""
    state, error = os.fstat(file.fileno()), None
    if not stat.S_ISREG(state.st_mode):
        error = OSError(errno.EINVAL, "it is not a regular file")
    elif state.st_size > _MOST_BYTES:
        error = OSError(errno.EFBIG, os.strerror(errno.EFBIG))
    if error:
        file.close()
        raise error
    return file


def _too_large_error(path: Path) -> KeystoreError:
    root = path.parent
    return KeystoreError(
        f"the ledger '{path}' is too large",
        f"It has more than {_MOST_BYTES // 1024**2} MiB or {_MOST_LINES} lines.",
        f"If it belongs to this keystore, move {LEDGER}, its parts and {LEDGER_HEAD} to an "
        f"archive, and state all rights again with `sros generate_artifacts -k {quote(str(root))} "
        f"-p POLICY_FILE`. Then replace the CAs, with `sros rotate_ca {quote(str(root))} --next` "
        "for each stage: after the last stage, files that the new ledger lacks are no longer "
        "valid. If the ledger does not belong to this keystore, restore the right ledger from a "
        "backup.",
    )


def _parse_line(line: bytes) -> Entry | None:
    """Return the ledger entry in a line; None if there is none."""
    match = _WRITTEN_LINE.fullmatch(line.decode()) if line.isascii() else None
    if not match or (match["serial"] and not match["serial"].strip("0")):
        return _parse_any_line(line)
    (time, kind, enclave, subject, serial, sha256, begin, end, policy, reason, key) = match.groups(
        ""
    )[:11]
    if kind == "revocation" and not serial:
        return None  # it does not say which certificate it revokes
    number, settings, nodes, previous = match.groups("")[11:]
    # Texts that many lines have in common are kept in memory once.
    return Entry(
        intern(time),
        intern(kind),
        intern(enclave),
        intern(subject),
        serial,
        sha256,
        intern(begin),
        intern(end),
        intern(policy),
        intern(reason),
        key,
        int(number or 0),
        settings,
        intern(nodes),
        previous,
    )


def _parse_any_line(line: bytes) -> Entry | None:
    """Return the entry in a line of JSON in any form; None if the line is not an entry."""
    if not line.startswith(b"{"):
        return None
    try:
        entry = Entry(**json.loads(line))
    except (ValueError, TypeError, RecursionError):
        return None
    if not all(isinstance(getattr(entry, name), str) for name in _TEXT_FIELDS):
        return None
    if type(entry.number) is not int or not 0 <= entry.number < _MOST_NUMBER:
        return None
    if entry.serial:
        valid = _SERIAL.fullmatch(entry.serial)
        if not valid or not 0 < int(entry.serial, 16).bit_length() <= _MOST_SERIAL_BITS:
            return None
    elif entry.what == "revocation":
        return None
    return entry


def _sha256(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()


def _first_ca_line(
    authorities: Iterable[x509.Certificate], entries: Iterable[tuple[int, Entry]]
) -> int:
    """Return the number of the first ledger line about any of these CAs.

    The result is 0 if one of the CAs has no line, or was recorded only after it had issued
    something.
    """
    wanted = {digest(authority) for authority in authorities}
    lines: dict[str, int] = {}
    for number, entry in entries:
        if entry.what == "ca" and entry.sha256 in wanted:
            lines.setdefault(entry.sha256, 0 if entry.reason in RECORDED_LATE else number)
    return min(lines.values(), default=0) if lines.keys() == wanted else 0


class _Head(NamedTuple):
    """The signed head of a ledger: number of lines, digest of the last line, or a fault.

    ``index_root`` is the root of the index; "" if the ledger has no index.
    """

    lines: int = 0
    last: str = ""
    fault: str = ""
    index_root: str = ""


def _head_fault(head: _Head | None, lines: int, signed: str) -> _Fault | None:
    """Return the fault if a ledger and its signed head disagree, or None.

    ``signed`` is the digest of the line that the head states as the last one.
    """
    if not head:
        return _Fault(lines, f"{LEDGER_HEAD}, which signs the end of the ledger, is missing")
    if head.fault:
        return _Fault(lines, head.fault)
    if head.lines > lines:
        missing = head.lines - lines
        text = f"{missing} line{'s are' if missing > 1 else ' is'} missing at its end"
        return _Fault(lines, text)
    if not head.lines or signed != head.last:
        return _Fault(lines, f"its last lines are not the ones that {LEDGER_HEAD} signs")
    if head.lines < lines:
        return _Fault(lines, f"line {head.lines + 1} was added by another program")
    return None


def _check_signer(signed: smime.SignedDocument, authorities: Sequence[x509.Certificate]) -> None:
    """Raise `PkiError` unless one of the CAs signed the document."""
    for authority in authorities:
        with suppress(PkiError):
            return signed.verify(authority)
    raise PkiError("no CA of this keystore signed it")


# ── writing ────────────────────────────────────────────────────────────────────────────────


def append(
    transaction: Transaction,
    entries: Collection[Entry],
    sign: Callable[[bytes, str], bytes],
    now: datetime,
    file: LedgerFile,
) -> None:
    """Stage the ledger with ``entries`` added, and its signed head.

    ``sign`` signs the head with a CA, like `Authority.sign`.  ``file`` is the ledger as read under
    the lock.  Faults that are not recorded yet are added first, so that the new head does not hide
    them.
    """
    present = file.reading_for_append()
    gaps = [Entry(iso(now), GAP, reason=e.text, number=e.line) for e in present.unrecorded]
    index = None
    if not transaction.dry_run:
        index = file.index_update(len(gaps) + len(entries), present)
    links = _NewLines(chain(gaps, entries), present.previous, index)
    number, size = file.last_part()
    seals = index is not None and size + _USUAL_LINE_BYTES * len(entries) >= _SEAL_FROM_BYTES
    named = transaction.target_after(LEDGER) or ""
    is_part = seals or SEALED_LEDGER.fullmatch(named)
    digest = hashlib.sha256()

    def content() -> Iterator[bytes]:
        for block in chain(file.content(), [b"" if present.ended else b"\n"], links):
            digest.update(block)
            yield block

    transaction.write_parts(ledger_part(number) if is_part else LEDGER, content())
    if SEALED_LEDGER.fullmatch(named) and named != ledger_part(number):
        transaction.remove(named)  # somebody has renamed the last part
    for _ in links:  # only in a dry run, which does not write the lines
        pass
    if index and seals:
        index.seal(ledger_part(number))
        links.add(Entry(iso(now), SEALED, sha256=digest.hexdigest(), number=number))
        number += 1
        transaction.write_parts(ledger_part(number), links)
    if is_part and named != ledger_part(number):
        transaction.link(LEDGER, ledger_part(number))
    lines = present.ledger.lines + links.count
    head = f"lines {lines}\nsha256 {links.previous}\n"
    root = ""
    if index:
        with suppress(SrosError):  # the next change makes a damaged index again
            root = index.root()
            transaction.after_commit(index.save)
    head = f"sros ledger 2\n{head}index {root}\n" if root else f"sros ledger 1\n{head}"
    transaction.write(LEDGER_HEAD, sign(head.encode(), "the head of the ledger"))


class _NewLines:
    """An iterator over the lines of new entries; each line gets the digest of the previous one.

    ``previous`` is the digest of the last line so far, ``count`` the number of lines so far.  The
    lines are also added to ``index``.
    """

    def __init__(
        self, entries: Iterable[Entry], previous: str, index: IndexUpdate | None = None
    ) -> None:
        self.previous = previous
        self.count = 0
        self._entries: Iterator[Entry] = iter(entries)
        self._index = index

    def add(self, entry: Entry) -> None:
        """Add an entry at the end, after the lines of all earlier entries were read."""
        self._entries = iter((entry,))

    def __iter__(self) -> Iterator[bytes]:
        for entry in self._entries:
            line = _json_line(entry, self.previous)
            self.previous = _sha256(line)
            self.count += 1
            if self._index:
                self._index.add(entry, line)
            yield line + b"\n"


def _json_line(entry: Entry, previous: str) -> bytes:
    """Return an entry as compact JSON; ``previous`` is the digest of the previous line."""
    filled = ((name, getattr(entry, name)) for name in Entry._fields[:-1])
    parts = [
        f'"{name}":{_json_text(value) if isinstance(value, str) else value}'
        for name, value in filled
        if value
    ]
    return f'{{{",".join(parts)},"previous":"{previous}"}}'.encode()
