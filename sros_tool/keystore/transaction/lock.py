"""Locks that keep two processes from writing to the same keystore at the same time."""

from __future__ import annotations

import contextlib
import errno
import fcntl
import os
import signal
import stat
import time
from collections.abc import Iterator
from typing import Self

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

    def __init__(self, folder: Folder) -> None:
        self._folder = folder
        self._handle = -1

    @property
    def held(self) -> bool:
        """Whether this process holds the lock."""
        return self._handle >= 0

    def acquire(self, wait: float | None = None) -> Self:
        """Lock the keystore; wait for it for ``wait`` seconds (default: 60).

        Whoever calls it calls `release` also if it raises: a signal may come just after the file
        was made.

        Raises:
            KeystoreError: another process held the lock for ``wait`` seconds.
        """
        wait = _LOCK_SECONDS if wait is None else wait
        deadline = time.monotonic() + wait
        while not self._try() and time.monotonic() < deadline:
            time.sleep(_PAUSE)
        if not self.held:
            raise KeystoreError(
                f"keystore '{self._folder.path}' is busy",
                f"Another process has been writing to it for {wait:.0f} seconds.",
                "Try again when that process has finished.",
            )
        return self

    def _try(self) -> bool:
        """Return whether the lock could be taken now."""
        try:
            with _signals_held_back():
                handle = self._folder.open_private(LOCK)
                if stat.S_ISREG(os.fstat(handle).st_mode) and _locked(handle):
                    if self._is_there(handle):
                        self._handle = handle
                        return True
                    os.close(handle)
                    return False
        except FileNotFoundError:
            return False  # another process removed it between two looks at it
        except PermissionError:
            if self._folder.state(LOCK) is None:
                raise  # this user cannot write to the folder
            return False  # root made the file just now, and hands it over to the owner
        except OSError as error:
            if error.errno not in (errno.ELOOP, errno.ENXIO):  # a link, a socket
                raise
            raise self._in_the_way() from error
        regular = stat.S_ISREG(os.fstat(handle).st_mode)
        os.close(handle)
        if not regular:
            raise self._in_the_way()
        return False

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


@contextlib.contextmanager
def _signals_held_back() -> Iterator[None]:
    """Let no signal end the work between making a file and noting that it was made."""
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT, signal.SIGTERM})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
