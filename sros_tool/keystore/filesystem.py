"""What a transaction asks of the file system beyond single files: locks, flushes, exchanges."""

from __future__ import annotations

import ctypes
import errno
import fcntl
import os
import sys
import time
from functools import lru_cache
from pathlib import Path

from sros_tool.errors import KeystoreError

LOCK_SECONDS = 60.0
_AT_FDCWD = -100
_RENAME_EXCHANGE = 2
_NOT_SUPPORTED = (errno.EINVAL, errno.ENOSYS, errno.ENOTSUP)


def lock_folder(folder: Path, wait: float | None = None) -> int:
    """An exclusive lock on a folder itself, so that no lock file is left behind.

    Returns the descriptor that holds it.  Raises `KeystoreError` after ``wait`` seconds.
    """
    wait = LOCK_SECONDS if wait is None else wait
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
                    "Try again when it is done.",
                ) from None
            time.sleep(0.02)


def flush_file_system(folder: Path) -> None:
    """One flush for all files of a transaction: one for each would cost more than all else."""
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
    """Have the names in a folder written down."""
    handle = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def exchange(one: str, other: str) -> bool:
    """Let two names change their places at one moment (``renameat2``).

    False, and nothing is changed, where the system, its C library or the file system cannot.
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
