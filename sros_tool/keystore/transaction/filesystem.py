"""File system operations of a transaction: locks, flushes, exchanges of names, and moves."""

from __future__ import annotations

import contextlib
import ctypes
import errno
import fcntl
import os
import stat
import sys
import time
from collections.abc import Iterable
from functools import lru_cache
from pathlib import Path

from sros_tool.errors import KeystoreError
from sros_tool.keystore.layout import ENCLAVES, folder_mode

_LOCK_SECONDS = 60.0
_AT_FDCWD = -100
_RENAME_EXCHANGE = 2
_NOT_SUPPORTED = (errno.EINVAL, errno.ENOSYS, errno.ENOTSUP)


def lock_folder(folder: Path, wait: float | None = None) -> int:
    """Lock a folder for this process; return the file descriptor that holds the lock.

    The lock is on the folder itself, so that no lock file remains.  ``wait`` is in seconds
    (default: 60).

    Raises:
        KeystoreError: another process held the lock for ``wait`` seconds.
    """
    wait = _LOCK_SECONDS if wait is None else wait
    handle = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    deadline = time.monotonic() + wait
    while True:
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
            return handle
        except BlockingIOError:
            if time.monotonic() >= deadline:
                os.close(handle)
                raise KeystoreError(
                    f"keystore '{folder}' is busy",
                    f"Another process has been writing to it for {wait:.0f} seconds.",
                    "Try again when that process has finished.",
                ) from None
            time.sleep(0.02)


def flush_file_system(folder: Path) -> None:
    """Flush the whole file system of ``folder`` to disk; flushing each file would be slower."""
    handle = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        if _c_library().syncfs(handle) != 0:
            number = ctypes.get_errno()
            raise OSError(number, os.strerror(number), str(folder))
    except AttributeError:  # a C library without syncfs
        os.sync()
    finally:
        os.close(handle)


def flush_folder(folder: Path) -> None:
    """Flush the entries of a folder to disk, without the contents of its files."""
    handle = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def exchange(one: str, other: str) -> bool:
    """Atomically exchange two paths (``renameat2``).

    Return False, without a change, if the kernel, the C library or the file system does not support
    the exchange.
    """
    try:
        rename = _c_library().renameat2
    except AttributeError:
        return False
    sys.audit("os.rename", one, other, -1, -1)
    names = os.fsencode(one), os.fsencode(other)
    if rename(_AT_FDCWD, names[0], _AT_FDCWD, names[1], _RENAME_EXCHANGE) == 0:
        return True
    number = ctypes.get_errno()
    if number in _NOT_SUPPORTED:
        return False
    raise OSError(number, os.strerror(number), one, None, other)


@lru_cache(maxsize=1)
def _c_library() -> ctypes.CDLL:
    return ctypes.CDLL(None, use_errno=True)


def is_folder(path: str | Path) -> bool:
    """Return whether ``path`` is a folder and not a symbolic link; False if it does not exist.

    Raises:
        KeystoreError: ``path`` is a file or a symbolic link.
    """
    try:
        mode = os.lstat(path).st_mode
    except FileNotFoundError:
        return False
    if stat.S_ISLNK(mode):
        raise KeystoreError(
            f"'{path}' is a symbolic link",
            "Files written below it would be stored elsewhere, outside of the keystore.",
            "Replace the link with a real folder.",
        )
    if not stat.S_ISDIR(mode):
        raise KeystoreError(f"'{path}' is in the way", "It is not a folder.", "Move it away.")
    return True


def make_folders(root: Path, folders: Iterable[str]) -> None:
    """Create the missing folders below ``root``.

    Raises:
        KeystoreError: one of the paths is a file or a symbolic link.
    """
    seen = {""}

    def make(folder: str) -> None:
        if folder in seen:
            return
        make(folder.rpartition("/")[0])
        if not is_folder(f"{root}/{folder}"):
            os.mkdir(f"{root}/{folder}", folder_mode(folder))
        seen.add(folder)

    for folder in folders:
        make(folder)


def move_into_place(source: Path, target: Path) -> None:
    """Move everything below ``source``, if it exists, to the same paths below ``target``.

    The folder of the enclaves is moved last: a folder without it does not count as a keystore yet.
    """
    if not source.is_dir():
        return
    with os.scandir(source) as entries:
        for entry in sorted(entries, key=lambda each: each.name == ENCLAVES):
            place = target / entry.name
            if not entry.is_dir(follow_symlinks=False):
                os.replace(entry.path, place)
            elif is_folder(place):
                move_into_place(Path(entry.path), place)
            else:
                os.rename(entry.path, place)


def remove_empty_folders(root: Path, paths: Iterable[str]) -> None:
    """Remove the empty parent folders of ``paths``, except the folders directly in ``root``."""
    for path in paths:
        folder = path.rpartition("/")[0]
        with contextlib.suppress(OSError):  # it is not empty
            while "/" in folder:
                with contextlib.suppress(FileNotFoundError):  # an earlier recovery removed it
                    os.rmdir(root / folder)
                folder = folder.rpartition("/")[0]
