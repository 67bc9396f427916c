"""The files that a process loaded at its start, as they are now, seen as that process sees them.

A process names its files by paths that mean other files to this process if it has a root directory
or mounts of its own, as in a container.  Paths are therefore resolved below the root directory of
the process, part by part: no link can lead out of it.  Only regular files are opened for reading,
so no pipe is waited for and no device is touched.

What tells that a file was replaced is the time of its last status change (st_ctime), which the
kernel sets by its own clock: copying programs can preserve other times, but not this one.
"""

from __future__ import annotations

import errno
import os
import stat
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path

from sros_tool.owners import other_writers
from sros_tool.runtime.cyclone import ENCLAVE_FILES
from sros_tool.runtime.environment import enclave_argument
from sros_tool.runtime.variables import ENABLE, ENCLAVE, KEYSTORE

_CRL = "crl.pem"
_KEY, _KEY_ON_TOKEN = "key.pem", "key.p11"
_UNREAD = (_KEY, _KEY_ON_TOKEN, "governance.p7s")
"""Files whose content says nothing about a process; private keys are never read."""
_MOST_BYTES = 16 * 1024 * 1024
_MOST_BYTES_OF_ALL = 64 * 1024 * 1024
_LAST_SECOND = 253402300799
_MOST_LINKS = 40
_MOST_FOLDERS = 200


@dataclass(frozen=True, slots=True)
class LoadedFile:
    """A file that a process loads at its start, as it is now.

    ``changed`` is when the file, or a link to it, was last written, replaced or given another mode
    or owner; None if there is no such file.  ``problem`` says why it could not be looked at, as a
    clause.
    """

    name: str
    changed: datetime | None = None
    data: bytes = field(default=b"", repr=False)
    problem: str = ""


@dataclass(frozen=True, slots=True)
class ProcessEnclave:
    """The enclave that a process names, and its files as they are now.

    ``keystore`` is the path that the process names.  ``moved`` maps the folders of the keystore in
    which nothing was added or removed since their last change to that change: they were moved, or
    got another mode.  ``writable`` says which folder others than the owner of the keystore can
    change.  ``here`` is the path of the keystore for this process, or None if it is another one
    here.  ``problem`` says why the enclave could not be looked at.
    """

    keystore: str
    name: str
    files: tuple[LoadedFile, ...] = ()
    is_there: bool = False
    moved: Mapping[str, datetime] = field(default_factory=dict)
    writable: str = ""
    here: Path | None = None
    problem: str = ""

    def file(self, name: str) -> LoadedFile:
        """Return a file of the enclave by its name."""
        return next((file for file in self.files if file.name == name), LoadedFile(name))

    @property
    def lacking(self) -> tuple[str, ...]:
        """The names of the required files that are not there."""
        there = {file.name for file in self.files if file.changed or file.problem}
        there |= {_KEY} if _KEY_ON_TOKEN in there else set()
        return tuple(each for each in ENCLAVE_FILES if each not in there)


class FileReader:
    """Reads the files of processes, at most 64 MiB of them, and the same file once."""

    def __init__(self) -> None:
        self._left = _MOST_BYTES_OF_ALL
        self._read: dict[tuple[int, ...], bytes] = {}
        self._before: dict[tuple[int, ...], bytes] = {}

    def read(self, handle: int, state: os.stat_result) -> bytes:
        """Return the content of a regular file that is open with O_PATH.

        Raises:
            OSError: The file cannot be read, is no regular file, or is too large.
        """
        key = (state.st_dev, state.st_ino, state.st_ctime_ns, state.st_size)
        if key not in self._read and key in self._before:
            self._read[key] = self._before[key]
            self._left -= state.st_size
        if key not in self._read:
            if not stat.S_ISREG(state.st_mode):
                raise OSError(errno.EINVAL, "it is not a regular file")
            if state.st_size > min(_MOST_BYTES, self._left):
                raise OSError(errno.EFBIG, "it is larger than sros reads")
            # By the link of the handle, so that it is still the same file.
            opened = os.open(f"/proc/self/fd/{handle}", os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
            with open(opened, "rb") as file:
                self._read[key] = file.read(state.st_size)
            self._left -= state.st_size
        return self._read[key]

    def begin(self) -> None:
        """Forget the files that were not asked for since the last time."""
        self._left = _MOST_BYTES_OF_ALL
        self._before, self._read = self._read, {}


class ProcessRoot:
    """The root directory of a process, below which its paths are resolved.

    ``handle`` is a folder that is open with O_PATH; it stays with the caller.
    """

    def __init__(self, handle: int, reader: FileReader) -> None:
        self._handle = handle
        self._reader = reader

    def load(self, name: str, path: str, *, read: bool = True) -> LoadedFile:
        """Return the state of a file at an absolute path, with its content if ``read``."""
        try:
            with self._opened(path) as (handle, way):
                links = [each for _, each in way[:-1] if stat.S_ISLNK(each.st_mode)]
                changed = max(each.st_ctime_ns for each in (*links, way[-1][1]))
                data = self._reader.read(handle, way[-1][1]) if read else b""
        except OSError as error:
            return LoadedFile(name, problem=_reason(error))
        return LoadedFile(name, _moment(changed), data)

    def folders(self, path: str) -> dict[str, os.stat_result]:
        """Map the folders on the way to a folder, and itself, to their states.

        Raises:
            OSError: There is no such folder, or it cannot be looked at.
        """
        with self._opened(path) as (_, way):
            if not stat.S_ISDIR(way[-1][1].st_mode):
                raise NotADirectoryError(errno.ENOTDIR, os.strerror(errno.ENOTDIR))
            return {each: state for each, state in way if stat.S_ISDIR(state.st_mode)}

    @contextmanager
    def _opened(self, path: str) -> Iterator[tuple[int, list[tuple[str, os.stat_result]]]]:
        """Open what is at a path with O_PATH.

        Yields the handle, and the path and state of each folder and link on the way, which ends
        with what is there.  Each part is opened in the folder before it and no link is followed by
        the system, so nothing outside of the root directory is reached.
        """
        rest = [each for each in path.split("/")[::-1] if each]
        way = [("/", os.fstat(self._handle))]
        folders: list[tuple[str, int]] = []
        links = 0
        try:
            while rest:
                part = rest.pop()
                if part == "..":
                    if folders:
                        os.close(folders.pop()[1])
                    continue
                if part == "." or len(folders) > _MOST_FOLDERS:
                    if part == ".":
                        continue
                    raise OSError(errno.ENAMETOOLONG, os.strerror(errno.ENAMETOOLONG))
                above, within = folders[-1] if folders else ("", self._handle)
                handle = _open_part(part, within)
                folders.append((f"{above}/{part}", handle))
                state = os.fstat(handle)
                way.append((f"{above}/{part}", state))
                if not stat.S_ISLNK(state.st_mode):
                    continue
                links += 1
                if links > _MOST_LINKS:
                    raise OSError(errno.ELOOP, os.strerror(errno.ELOOP))
                target = os.readlink("", dir_fd=handle)
                os.close(folders.pop()[1])
                if target.startswith("/"):
                    while folders:
                        os.close(folders.pop()[1])
                rest += [each for each in target.split("/")[::-1] if each]
            last = folders[-1] if folders else ("/", self._handle)
            way.append((last[0], os.fstat(last[1])))
            yield last[1], way
        finally:
            for _, handle in folders:
                os.close(handle)


def _open_part(name: str, folder: int) -> int:
    try:
        return os.open(name, os.O_PATH | os.O_NOFOLLOW | os.O_CLOEXEC, dir_fd=folder)
    except ValueError as error:  # a NUL in the name
        raise FileNotFoundError(errno.ENOENT, os.strerror(errno.ENOENT)) from error


def loaded_enclave(
    environment: Mapping[str, str],
    command: tuple[str, ...],
    root: ProcessRoot,
    *,
    user: int,
    folder: str = "",
) -> ProcessEnclave | None:
    """Return the enclave that rcl loads for a process, or None if the process asks for none.

    ``user`` is the user id of the process, and ``folder`` its working directory, or "" if that is
    not known.
    """
    keystore = environment.get(KEYSTORE, "")
    if environment.get(ENABLE) != "true" or not keystore:
        return None
    name = environment.get(ENCLAVE) or enclave_argument(command)
    if not keystore.startswith("/") and not folder:
        return ProcessEnclave(keystore, name, problem=f"{KEYSTORE} is a relative path")
    top = keystore if keystore.startswith("/") else f"{folder}/{keystore}"
    place = f"{top}/enclaves/{name.strip('/')}"
    try:
        above = root.folders(top)
    except OSError as error:
        return ProcessEnclave(keystore, name, problem=_reason(error))
    try:
        folders = root.folders(place)
    except OSError as error:
        return ProcessEnclave(keystore, name, problem=_reason(error), here=_same_here(top, above))
    own = list(folders.items())[len(above) - 1 :]
    return ProcessEnclave(
        keystore,
        name,
        tuple(
            root.load(each, f"{place}/{each}", read=each not in _UNREAD)
            for each in (*ENCLAVE_FILES, _KEY_ON_TOKEN, _CRL)
        ),
        is_there=True,
        moved={
            path: _moment(state.st_ctime_ns)
            for path, state in own
            if state.st_mtime_ns < state.st_ctime_ns
        },
        writable=_writable(own, user),
        here=_same_here(top, above),
    )


def _reason(error: OSError) -> str:
    """Return why a folder could not be looked at, or "" if it is not there."""
    if error.errno in (errno.ENOENT, errno.ENOTDIR):
        return ""
    return error.strerror or str(error)


def _writable(folders: list[tuple[str, os.stat_result]], user: int) -> str:
    """Return which folder users can change who are neither root, ``user`` nor the owner."""
    trusted = frozenset({0, user, folders[0][1].st_uid})
    for path, state in folders:
        if why := other_writers(state, trusted):
            return f"'{path}': {why}"
    return ""


def _same_here(path: str, folders: Mapping[str, os.stat_result]) -> Path | None:
    """Return the path of a folder of a process if it is the same folder for this process."""
    with suppress(OSError, ValueError):
        if os.path.samestat(Path(path).stat(), list(folders.values())[-1]):
            return Path(path)
    return None


def _moment(nanoseconds: int) -> datetime:
    # A file system can state any moment; later ones than a datetime can be are as good.
    return datetime.fromtimestamp(min(max(nanoseconds / 1e9, 0), _LAST_SECOND), UTC)
