"""Archives (``.tar.gz``) for robots: reproducible when written, hostile input when read."""

from __future__ import annotations

import gzip
import hashlib
import io
import tarfile
import zlib
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import NamedTuple, Self

from sros_tool.errors import DocumentError, UsageError
from sros_tool.keystore.layout import folder_mode

SUFFIXES = (".tar.gz", ".tgz")
_OTHER_SUFFIXES = (".tar", ".tar.xz", ".txz", ".tar.bz2", ".tbz2", ".tar.zst", ".zip", ".7z")
MAX_UNPACKED = 40 * 1024 * 1024
MAX_MEMBER = 17 * 1024 * 1024
"""Maximum size in bytes of the unpacked content of an answer, and of a file in any archive.

This leaves room for the largest Zenoh configuration that sros reads, with its signed document.
"""


def refuse_archive_name(folder: Path, remedy: str) -> None:
    """Raise `UsageError` if a new folder would have the name of an archive, or `-`."""
    name = folder.name
    if (name == "-" or name.endswith((*SUFFIXES, *_OTHER_SUFFIXES))) and not folder.is_dir():
        raise UsageError(f"'{folder}' would become a folder, not an archive", "", remedy)


class ArchiveLimits(NamedTuple):
    """Maximum size in bytes of an archive, packed and unpacked, and maximum number of entries."""

    packed: int
    unpacked: int
    members: int


_EXTENSION_HEADERS = (tarfile.XHDTYPE, tarfile.GNUTYPE_LONGNAME)
"""Types of headers with further fields of the entry that follows, such as a long path."""
_MOST_HEADER = 1024
"""Maximum size in bytes of a header with further fields: enough for a path."""
_SPARSE_KEY = b"GNU.sparse."
"""Prefix of the fields that the header of a sparse file has."""
_LIMITS_OF_ONE_ENCLAVE = ArchiveLimits(16 * 1024 * 1024, MAX_UNPACKED, 200)
LIMITS_OF_ONE_ROBOT = ArchiveLimits(64 * 1024 * 1024, 256 * 1024 * 1024, 20_000)
"""The limits of an archive with all enclaves of a robot."""
_GZIP_WINDOW_BITS = 16 + zlib.MAX_WBITS


def file_mode(path: str) -> int:
    """Return the permission bits of an exported file: 0600 for a private key, else 0644."""
    return 0o600 if path.rpartition("/")[2] == "key.pem" else 0o644


def pack(files: Mapping[str, bytes]) -> bytes:
    """Return a ``.tar.gz`` archive of ``files``, which maps paths to content.

    The archive has no users, groups or times, so equal files give equal bytes.
    """
    plain, buffer = io.BytesIO(), io.BytesIO()
    with tarfile.open(fileobj=plain, mode="w", format=tarfile.PAX_FORMAT) as tar:
        for folder in sorted(_folders(files)):
            entry = tarfile.TarInfo(folder)
            entry.type, entry.mode = tarfile.DIRTYPE, folder_mode(folder)
            tar.addfile(entry)
        for path, data in files.items():
            entry = tarfile.TarInfo(path)
            entry.size, entry.mode = len(data), file_mode(path)
            tar.addfile(entry, io.BytesIO(data))
    with gzip.GzipFile(fileobj=buffer, mode="wb", filename="", mtime=0) as packed:
        packed.write(plain.getbuffer())
    return buffer.getvalue()


def _folders(paths: Iterable[str]) -> set[str]:
    """Return all folders, at any depth, on the way to relative paths."""
    folders: set[str] = set()
    for path in paths:
        folder = path.rpartition("/")[0]
        while folder and folder not in folders:
            folders.add(folder)
            folder = folder.rpartition("/")[0]
    return folders


def listed_digests(files: Mapping[str, bytes]) -> bytes:
    """Return the file list for a seal: sorted lines of SHA-256, two spaces and path."""
    digests = (f"{hashlib.sha256(data).hexdigest()}  {path}" for path, data in files.items())
    return "\n".join([*sorted(digests), ""]).encode()


def unpack(data: bytes, limits: ArchiveLimits = _LIMITS_OF_ONE_ENCLAVE) -> dict[str, bytes]:
    """Map the paths in a ``.tar.gz`` archive to the content of the files; write nothing.

    The paths are not checked: the caller must do that.

    Raises:
        DocumentError: the archive is damaged, or too large, has too many entries, a repeated name,
            data after its end, or anything other than regular files and folders.
    """
    try:
        plain = _unzip(data, limits)
        if _SPARSE_KEY in plain:
            raise DocumentError("it contains a sparse file, which is not a regular file")
        with tarfile.open(fileobj=io.BytesIO(plain), mode="r:", tarinfo=_Entry) as tar:
            return dict(_files_in(tar, limits.members))
    except (
        tarfile.TarError,
        zlib.error,
        EOFError,
        OSError,
        ValueError,
        OverflowError,
        RecursionError,
    ) as error:
        raise DocumentError("it is not a .tar.gz archive, or it is damaged") from error


def stated_size(data: bytes) -> int:
    """Return the size in bytes that a ``.gz`` file states for its content; `unpack` reads no more.

    RFC 1952, 2.3.1: ISIZE, at the end of the file.
    """
    return int.from_bytes(data[-4:], "little")


def _unzip(data: bytes, limits: ArchiveLimits) -> bytes:
    if len(data) > limits.packed:
        raise DocumentError(f"it is too large: more than {limits.packed // 1024**2} MiB")
    stream = zlib.decompressobj(_GZIP_WINDOW_BITS)
    plain = stream.decompress(data, min(limits.unpacked, stated_size(data)) + 1)
    if len(plain) > limits.unpacked:
        raise DocumentError(f"it unpacks to more than {limits.unpacked // 1024**2} MiB")
    if not stream.eof:
        raise EOFError
    if stream.unused_data:
        raise DocumentError("there is data after its end")
    return plain


class _Entry(tarfile.TarInfo):
    """An entry that `tarfile` reads in little time and memory.

    `tarfile` itself reads maps of sparse files and long headers as a whole: an archive of 260 KB
    took two minutes and 7 GB.
    """

    @classmethod
    def frombuf(cls, buf: bytes | bytearray, encoding: str, errors: str) -> Self:
        """Return the entry whose header is ``buf``.

        Raises:
            DocumentError: the entry is no regular file or folder, or is a header that is too long.
        """
        entry = super().frombuf(buf, encoding, errors)
        if entry.type in _EXTENSION_HEADERS and entry.size > _MOST_HEADER:
            raise DocumentError(
                f"it contains a header of {entry.size} bytes; at most {_MOST_HEADER} are allowed"
            )
        if entry.type not in (
            *_EXTENSION_HEADERS,
            tarfile.REGTYPE,
            tarfile.AREGTYPE,
            tarfile.DIRTYPE,
        ):
            raise DocumentError(f"it contains {entry.name!r}, which is not a regular file")
        return entry


def _files_in(tar: tarfile.TarFile, maximum: int) -> Iterator[tuple[str, bytes]]:
    member_names: set[str] = set()
    for entry in tar:
        name = entry.name
        if name in member_names or len(member_names) >= maximum:
            raise DocumentError(
                f"it contains {name!r} twice"
                if name in member_names
                else f"it contains more than {maximum} entries"
            )
        member_names.add(name)
        if entry.isdir():
            continue
        if entry.size > MAX_MEMBER:
            raise DocumentError(
                f"it contains {name!r} with {entry.size} bytes; the limit is {MAX_MEMBER} bytes"
            )
        content = tar.extractfile(entry)
        read = content.read() if content else b""
        if len(read) != entry.size:
            raise EOFError
        yield name, read
