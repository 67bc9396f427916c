"""The index of a long ledger: it finds the lines about an enclave, a key or a document.

The index is an SQLite file next to the ledger.  With it, a change of one enclave need not read the
lines about all other enclaves.  The index is only a cache, and trusted as little as any other file.
Its `root` is the digest of its whole content.  The signed head of the ledger states the root, and
every part of the index that is read is compared with the root.  An index that is missing, damaged,
forged, or of another state of the ledger is not used.  The next change of the keystore makes it
again from the ledger.

A *term* is the value of a field of an entry, such as the name of an enclave.  A *posting* says that
a line has a term, where the line is, and what its digest is.  Postings are kept in buckets, by the
first bits of their terms.  A bucket also has the names of those enclaves with postings in it whose
last certificate was not revoked.  The root is the digest of the digests of all buckets.

The index also has the lines of the sealed parts of the ledger, so that the files of these parts are
only needed for reading all lines.  Each line is compared with the digest in its posting.
"""

from __future__ import annotations

import hashlib
import os
import sqlite3
import stat
import struct
from collections.abc import Iterable, Iterator, Sequence
from contextlib import closing, suppress
from pathlib import Path
from typing import Any, NamedTuple, Protocol, Self
from urllib.parse import quote

from sros_tool.errors import IndexDamagedError, SrosError
from sros_tool.keystore.layout import LEDGER_INDEX
from sros_tool.pki.crl import SUPERSEDED

_NEW_INDEX = f"{LEDGER_INDEX}.new"
_BUCKETS = 4096
_POSTING_FORMAT = struct.Struct(">16sIQI32s")
_DIGEST_BYTES = 32
_EMPTY_BUCKET_DIGESTS = hashlib.sha256().digest() * 2
"""The digests of the names and of the postings of an empty bucket."""
_INDEXED_FIELDS = ("enclave", "serial", "sha256", "key")
_UNINDEXED_KINDS = ("certificate", "permissions")
"""Kinds of entries that each make up half of a ledger, so that no index helps to find them."""
_SCHEMA = (
    "CREATE TABLE buckets (bucket INTEGER PRIMARY KEY, names BLOB NOT NULL, "
    "postings BLOB NOT NULL)",
    "CREATE TABLE lines (number INTEGER PRIMARY KEY, line BLOB NOT NULL)",
    "CREATE TABLE state (lines INTEGER NOT NULL, size INTEGER NOT NULL, number INTEGER NOT NULL, "
    "last TEXT NOT NULL, sealed INTEGER NOT NULL, sealed_size INTEGER NOT NULL, "
    "digests BLOB NOT NULL)",
)
_STATE_QUERY = "SELECT * FROM state WHERE length(digests) = ?"
_STATE_TYPES = [int, int, int, str, int, int, bytes]
_LARGEST_BUCKET = 128 << 20
"""Size of the largest bucket, in bytes."""
_PRAGMAS = ("trusted_schema = OFF", "cell_size_check = ON", "mmap_size = 0")


class Posting(NamedTuple):
    """The place of a line in the ledger: its number, first byte, and length without line end.

    ``digest`` is the SHA-256 of the line.
    """

    number: int
    offset: int
    length: int
    digest: bytes


class IndexState(NamedTuple):
    """The state of the ledger that an index describes.

    ``lines`` and ``size`` are the numbers of its lines and bytes.  ``number`` is the highest number
    of an entry.  ``last`` is the SHA-256 of the last line, in hexadecimal.  ``sealed`` and
    ``sealed_size`` are the numbers of lines and bytes in the sealed parts.
    """

    lines: int
    size: int
    number: int
    last: str
    sealed: int
    sealed_size: int

    def root(self, digests: bytes) -> str:
        """Return the root, in hexadecimal, of an index whose buckets have these digests."""
        text = f"sros index 2\n{' '.join(map(str, self))}\n"
        return hashlib.sha256(text.encode() + digests).hexdigest()


class IndexedEntry(Protocol):
    """The fields of a ledger entry that the index contains."""

    @property
    def what(self) -> str:
        """Kind of the entry."""

    @property
    def enclave(self) -> str:
        """Name of the enclave, or ""."""

    @property
    def reason(self) -> str:
        """Reason of a revocation, or ""."""

    @property
    def number(self) -> int:
        """Number of the entry, as in `Entry.number`, or 0."""


def is_indexed(name: str, value: str) -> bool:
    """Return whether an index finds the lines whose field ``name`` has this value."""
    return name in _INDEXED_FIELDS or (name == "what" and value not in _UNINDEXED_KINDS)


def _term(name: str, value: str) -> bytes:
    text = f"{name}\0{value}".encode("utf-8", "surrogatepass")
    return hashlib.sha256(text).digest()[:16]


def _bucket_of(term: bytes) -> int:
    return int.from_bytes(term[:2], "big") % _BUCKETS


def _joined_terms(names: Iterable[str]) -> bytes:
    return "\n".join(sorted(names)).encode("utf-8", "surrogatepass")


def _split_names(names: bytes) -> list[str]:
    return names.decode("utf-8", "surrogatepass").split("\n") if names else []


def _terms(entry: IndexedEntry) -> Iterator[bytes]:
    for name in _INDEXED_FIELDS:
        if value := getattr(entry, name):
            yield _term(name, value)
    if entry.what not in _UNINDEXED_KINDS:
        yield _term("what", entry.what)


class LedgerIndex:
    """An index whose root the signed head of the ledger states."""

    def __init__(self, path: Path, state: IndexState, digests: bytes) -> None:
        self.state = state
        self._path = path
        self._digests = digests
        self._process = 0
        self._connection: sqlite3.Connection | None = None

    @classmethod
    def open(cls, root: Path, lines: int, last: str, stated_root: str) -> Self | None:
        """Return the index of the keystore ``root``; None if the head states another index.

        The head states the number of ``lines``, the digest of the ``last`` line, and the index's
        ``stated_root``.
        """
        path = root / LEDGER_INDEX
        try:
            _check_file(path)
            with closing(_connect(path, "ro")) as connection:
                row = connection.execute(
                    _STATE_QUERY, (_BUCKETS * len(_EMPTY_BUCKET_DIGESTS),)
                ).fetchone()
        except (OSError, sqlite3.Error, ValueError, SrosError):
            return None
        if not row or [type(value) for value in row] != _STATE_TYPES:
            return None
        state, digests = IndexState(*row[:-1]), row[-1]
        if (state.lines, state.last) != (lines, last) or state.root(digests) != stated_root:
            return None
        return cls(path, state, digests)

    @property
    def digests(self) -> bytes:
        """The SHA-256 of the names and of the postings of every bucket, concatenated."""
        return self._digests

    def postings(self, name: str, value: str) -> Iterator[Posting]:
        """Yield the postings of the lines whose field ``name`` has the value, oldest first.

        Raises:
            IndexDamagedError: the bucket has changed since the head was signed.
        """
        term = _term(name, value)
        postings = self._postings_in(_bucket_of(term))
        at = postings.find(term)
        while at >= 0:
            if at % _POSTING_FORMAT.size == 0:
                _, *where = _POSTING_FORMAT.unpack_from(postings, at)
                yield Posting(*where)
            at = postings.find(term, at + 1)

    def line(self, number: int) -> bytes:
        """Return a line of the sealed parts; the caller compares it with its digest.

        Raises:
            IndexDamagedError: the index does not have the line.
        """
        rows = self._rows("SELECT line FROM lines WHERE number = ?", number)
        if not rows or type(rows[0][0]) is not bytes:
            raise IndexDamagedError(f"'{self._path}' lacks line {number}")
        return rows[0][0]

    def names(self, parts: Iterable[str] = ()) -> list[str]:
        """Return the enclaves whose last certificate in the ledger is not revoked, unsorted.

        With ``parts``, only names that contain one of these texts are returned.

        Raises:
            IndexDamagedError: the names have changed since the head was signed.
        """
        stored_buckets = dict(self._rows("SELECT bucket, names FROM buckets"))
        buckets = [self._checked_bucket(stored_buckets.get(i, b""), 2 * i) for i in range(_BUCKETS)]
        if not parts:
            return _split_names(b"\n".join(filter(None, buckets)))
        texts = [part.encode("utf-8", "surrogatepass") for part in parts]
        hits = [data for data in buckets if any(text in data for text in texts)]
        return [
            name for name in _split_names(b"\n".join(hits)) if any(part in name for part in parts)
        ]

    def bucket(self, bucket: int) -> tuple[bytes, bytes]:
        """Return the names and the postings in a bucket, verified.

        Raises:
            IndexDamagedError: the bucket has changed since the head was signed.
        """
        rows = self._rows("SELECT names FROM buckets WHERE bucket = ?", bucket)
        names = self._checked_bucket(rows[0][0] if rows else b"", 2 * bucket)
        return names, self._postings_in(bucket)

    def _postings_in(self, bucket: int) -> bytes:
        rows = self._rows("SELECT postings FROM buckets WHERE bucket = ?", bucket)
        return self._checked_bucket(rows[0][0] if rows else b"", 2 * bucket + 1)

    def _rows(self, query: str, *values: int) -> list[tuple[Any, ...]]:
        try:
            return self._read_only().execute(query, values).fetchall()
        except (OSError, sqlite3.Error, ValueError, SrosError) as error:
            raise IndexDamagedError(f"'{self._path}' cannot be read") from error

    def _checked_bucket(self, data: Any, number: int) -> bytes:
        """Return the content of the bucket ``number``, after comparing it with its digest."""
        digest = self._digests[number * _DIGEST_BYTES : (number + 1) * _DIGEST_BYTES]
        if type(data) is not bytes or hashlib.sha256(data).digest() != digest:
            raise IndexDamagedError(f"'{self._path}' does not match the head of the ledger")
        return data

    def _read_only(self) -> sqlite3.Connection:
        """Return the connection of this process; SQLite's connections do not survive a fork."""
        if self._connection is None or self._process != os.getpid():
            _check_file(self._path)
            self._connection = _connect(self._path, "ro")
            self._process = os.getpid()
        return self._connection


class IndexUpdate:
    """The index of the ledger in a keystore's ``folder``, to which lines are added.

    ``base`` is the present index; if it is None, all lines of the ledger must be added.
    """

    def __init__(self, folder: Path, base: LedgerIndex | None) -> None:
        self._folder = folder
        self.state = base.state if base else IndexState(0, 0, 0, "", 0, 0)
        self._base = base
        self._added: dict[int, bytearray] = {}
        self._names: dict[str, bool] = {}
        self._sealed_before = self.state.sealed
        self._buckets: dict[int, tuple[bytes, bytes]] = {}
        self._digests = b""
        self._sealed: list[str] = []

    def add(self, entry: IndexedEntry, line: bytes) -> None:
        """Add the next line of the ledger; ``line`` has no line end."""
        lines, size, number, *_ = self.state
        digest = hashlib.sha256(line)
        for term in _terms(entry):
            posting = _POSTING_FORMAT.pack(term, lines + 1, size, len(line), digest.digest())
            self._added.setdefault(_bucket_of(term), bytearray()).extend(posting)
        if entry.what == "certificate":
            self._names[entry.enclave] = True
        elif entry.what == "revocation" and entry.reason != SUPERSEDED:
            self._names[entry.enclave] = False
        number = max(number, entry.number)
        self.state = self.state._replace(
            lines=lines + 1,
            size=size + len(line) + 1,
            number=number,
            last=digest.hexdigest(),
        )

    def seal(self, part: str) -> None:
        """Record that all lines so far are in sealed parts, of which ``part`` is the last one."""
        self.state = self.state._replace(sealed=self.state.lines, sealed_size=self.state.size)
        self._sealed.append(part)

    def root(self) -> str:
        """Return the root of the index with all added lines, in hexadecimal.

        Raises:
            IndexDamagedError: the present index has changed since the head was signed.
        """
        digests = bytearray(self._base.digests if self._base else _EMPTY_BUCKET_DIGESTS * _BUCKETS)
        changed: dict[int, dict[str, bool]] = {bucket: {} for bucket in self._added}
        for name, is_there in self._names.items():
            changed[_bucket_of(_term("enclave", name))][name] = is_there
        for bucket, names in changed.items():
            before, postings = self._base.bucket(bucket) if self._base else (b"", b"")
            left = {name for name in _split_names(before) if names.get(name, True)}
            left.update(name for name, is_there in names.items() if is_there)
            parts = _joined_terms(left), postings + self._added.pop(bucket)
            self._buckets[bucket] = parts
            digest = b"".join(hashlib.sha256(part).digest() for part in parts)
            digests[
                bucket * len(_EMPTY_BUCKET_DIGESTS) : (bucket + 1) * len(_EMPTY_BUCKET_DIGESTS)
            ] = digest
        self._digests = bytes(digests)
        return self.state.root(self._digests)

    def save(self) -> None:
        """Write the index to the keystore; call this after `root` and the commit of the ledger.

        If this process runs as the user root in a keystore of another user, nothing is written,
        because the user could lead the write to another file.  In this case, or if the process
        stops here, the next change makes the index again.
        """
        try:
            if not _is_own(self._folder):
                return
            if self._base is None:
                self._make()
                return
            _check_file(self._folder / LEDGER_INDEX)
            _remove_journals(self._folder, LEDGER_INDEX)
            with closing(_connect(self._folder / LEDGER_INDEX, "rw")) as connection:
                self._write(connection)
        except (OSError, sqlite3.Error, ValueError, SrosError):
            from sros_tool.folders import Folder

            with suppress(OSError, SrosError), Folder(self._folder) as folder:
                folder.unlink(LEDGER_INDEX, missing_ok=True)

    def _make(self) -> None:
        from sros_tool.folders import Folder  # reading alone does not import modules that write

        with Folder(self._folder) as folder:
            folder.unlink(_NEW_INDEX, missing_ok=True)
            folder.write(_NEW_INDEX, b"", 0o600)
            _remove_journals(self._folder, _NEW_INDEX)
            with closing(_connect(self._folder / _NEW_INDEX, "rw", is_new=True)) as connection:
                self._write(connection)
            folder.replace(_NEW_INDEX, LEDGER_INDEX)

    def _write(self, connection: sqlite3.Connection) -> None:
        with connection:
            lines = enumerate(self._new_sealed_lines(), self._sealed_before + 1)
            connection.executemany("REPLACE INTO lines VALUES (?, ?)", lines)
            buckets = ((bucket, *parts) for bucket, parts in self._buckets.items())
            connection.executemany("REPLACE INTO buckets VALUES (?, ?, ?)", buckets)
            connection.execute("DELETE FROM state")
            row = (*self.state, self._digests)
            connection.execute("INSERT INTO state VALUES (?, ?, ?, ?, ?, ?, ?)", row)

    def _new_sealed_lines(self) -> Iterator[bytes]:
        """Yield the lines of the parts that were sealed since ``base``."""
        from sros_tool.folders import Folder

        with Folder(self._folder) as folder:
            for part in self._sealed:
                with folder.open(part) as file:
                    yield from (line.removesuffix(b"\n") for line in file)


def _is_own(folder: Path) -> bool:
    """Return whether ``folder`` belongs to this user, and no other user can write to it."""
    state = folder.stat()
    return state.st_uid == os.geteuid() and not state.st_mode & 0o022


def _remove_journals(keystore_folder: Path, name: str) -> None:
    """Remove the files that SQLite would read next to an index, which this version never writes.

    A journal names files that SQLite removes, and a link would lead SQLite to another file.
    """
    from sros_tool.folders import Folder

    with Folder(keystore_folder) as folder:
        for end in ("-journal", "-wal", "-shm"):
            folder.unlink(f"{name}{end}", missing_ok=True)


def _check_file(path: Path) -> None:
    """Raise `IndexDamagedError` unless the index is a file that only this user can have written."""
    state = path.lstat()
    regular = stat.S_ISREG(state.st_mode) and state.st_nlink == 1
    if not regular or state.st_uid != os.geteuid() or state.st_mode & 0o022:
        raise IndexDamagedError(f"'{path}' is not a regular file that only this user can change")


def _connect(path: Path, mode: str, *, is_new: bool = False) -> sqlite3.Connection:
    """Return a connection that only reads and writes the tables of `_SCHEMA`.

    A file with other tables, views or triggers is refused, because queries could run code in them.
    If the file is only read, no lock and no journal next to it is used.
    """
    immutable = "&immutable=1" if mode == "ro" else ""
    place = f"file:{quote(os.path.abspath(path))}?mode={mode}{immutable}"  # noqa: PTH100
    connection = sqlite3.connect(place, uri=True, timeout=0)
    try:
        connection.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, _LARGEST_BUCKET)
        for setting in (*_PRAGMAS, "journal_mode = MEMORY", "synchronous = OFF"):
            connection.execute(f"PRAGMA {setting}")
        if is_new:
            for table in _SCHEMA:
                connection.execute(table)
        schema = connection.execute("SELECT sql FROM sqlite_schema ORDER BY name").fetchall()
        if schema != [(table,) for table in _SCHEMA]:
            raise IndexDamagedError(f"'{path}' is not an index of a ledger")
    except BaseException:
        connection.close()
        raise
    return connection


def merged_postings(postings: Iterable[Iterable[Posting]]) -> Sequence[Posting]:
    """Return postings of several terms in the order of their lines, without duplicates."""
    return sorted({posting.number: posting for of_term in postings for posting in of_term}.values())
