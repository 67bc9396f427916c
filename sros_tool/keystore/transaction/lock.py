"""Locks that keep two processes from writing to the same keystore at the same time."""

from __future__ import annotations

import contextlib
import errno
import fcntl
import os
import stat
import time
from collections.abc import Callable

from sros_tool.errors import KeystoreError
from sros_tool.folders import Folder
from sros_tool.keystore.layout import LOCK

_LOCK_SECONDS = 60.0
_PAUSE = 0.02


class KeystoreLock:
    """The lock on a keystore: a locked file in it, which is there only while it is locked.

    Only the owner of the keystore (and root) can open the file, so nobody else can hold the lock:
    a lock on the folder itself could be taken by everybody who may read the folder.
    """

    def __init__(self, folder: Folder, wait: float | None = None) -> None:
        """Lock the keystore in ``folder``; wait for it for ``wait`` seconds (default: 60).

        Raises:
            KeystoreError: another process held the lock for ``wait`` seconds.
        """
        self._folder = folder
        wait = _LOCK_SECONDS if wait is None else wait
        self._handle = _until(time.monotonic() + wait, self._try)
        if self._handle < 0:
            raise KeystoreError(
                f"keystore '{folder.path}' is busy",
                f"Another process has been writing to it for {wait:.0f} seconds.",
                "Try again when that process has finished.",
            )

    def _try(self) -> int:
        """Return the descriptor of the locked file, or -1."""
        try:
            handle = self._folder.open_private(LOCK)
        except FileNotFoundError:
            return -1  # another process removed it between two looks at it
        except PermissionError:
            if self._folder.state(LOCK) is None:
                raise  # this user cannot write to the folder
            return -1  # root made the file just now, and hands it over to the owner
        except OSError as error:
            if error.errno not in (errno.ELOOP, errno.ENXIO):  # a link, a socket
                raise
            raise self._in_the_way() from error
        if not stat.S_ISREG(os.fstat(handle).st_mode):
            os.close(handle)
            raise self._in_the_way()
        if _locked(handle) and self._is_there(handle):
            return handle
        os.close(handle)
        return -1

    def _in_the_way(self) -> KeystoreError:
        return KeystoreError(
            f"'{self._folder.path / LOCK}' is in the way",
            "It is not a file that sros made.",
            "Find out who can write to the keystore, and remove it.",
        )

    def _is_there(self, handle: int) -> bool:
        """Return whether the locked file is still in the folder: who unlocks it removes it."""
        there = self._folder.state(LOCK)
        return there is not None and os.path.samestat(there, os.fstat(handle))

    def release(self) -> None:
        """Unlock the keystore."""
        if self._handle >= 0:
            for _ in range(2):  # a disk that is full may refuse it once
                with contextlib.suppress(OSError):
                    self._folder.unlink(LOCK, missing_ok=True)
                    break  # what is there now is the lock of another process
            os.close(self._handle)
            self._handle = -1


def lock_new(folder: Folder) -> bool:
    """Lock a folder that only this user can open; return whether no other process has locked it.

    The lock lasts until the folder is closed.
    """
    return _locked(folder.handle(""))


def _locked(handle: int) -> bool:
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    return True


def _until(deadline: float, attempt: Callable[[], int]) -> int:
    while (handle := attempt()) < 0 and time.monotonic() < deadline:
        time.sleep(_PAUSE)
    return handle
