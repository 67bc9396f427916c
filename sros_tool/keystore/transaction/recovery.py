"""Locks and recovery of a keystore: a committed transaction is completed, any other is undone.

Every transaction ends with a recovery: after the commit, plain files replace the links into the
stage, and new folders move to their places.  Each step can be repeated and skips finished work, so
an interrupted recovery can be repeated, too.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import logging
import os
import signal
import stat
import time
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Self

from sros_tool.errors import KeystoreError
from sros_tool.folders import Folder
from sros_tool.keystore.layout import (
    CERTIFICATE_FILE,
    CRL,
    CRL_FILE,
    ENCLAVES,
    LOCK,
    PRIVATE,
    STAGE,
    enclave_folder,
    folder_mode,
    link_to_list,
    search_enclaves,
)
from sros_tool.keystore.transaction.stage import (
    ADDED,
    AFTER,
    BEFORE,
    LIVE,
    Move,
    check_interrupted,
    stage_link_target,
    staged_name,
)
from sros_tool.parallel import map_slices

_LOCK_SECONDS = 60.0
_PAUSE = 0.02


class KeystoreLock:
    """The lock on a keystore: a locked file in the keystore, which exists only while it is locked.

    Only the owner of the keystore (and root) can open the file, so no other user can hold the lock:
    anybody who may read the folder could lock the folder itself.
    """

    def __init__(self, folder: Folder, what: str = "keystore") -> None:
        """Prepare to lock ``folder``, which is ``what`` in errors."""
        self._folder = folder
        self._what = what
        self._handle = -1

    @property
    def held(self) -> bool:
        """Whether this process holds the lock."""
        return self._handle >= 0

    def acquire(self, wait: float | None = None) -> Self:
        """Lock the keystore, waiting up to ``wait`` seconds (default: 60) for another process.

        The caller has to call `release` even if this raises: a signal may arrive just after the
        file was made.

        Raises:
            KeystoreError: another process held the lock for ``wait`` seconds.
        """
        wait = _LOCK_SECONDS if wait is None else wait
        deadline = time.monotonic() + wait
        while not self._try() and time.monotonic() < deadline:
            time.sleep(_PAUSE)
        if not self.held:
            raise KeystoreError(
                f"{self._what} '{self._folder.path}' is busy",
                f"Another process has been writing to it for {wait:.0f} seconds.",
                "Try again when that process has finished.",
            )
        return self

    def _try(self) -> bool:
        """Try to take the lock; return whether this succeeded."""
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
            "Find out who can write to the folder, and remove it.",
        )

    def _is_there(self, handle: int) -> bool:
        """Return whether the locked file is still in the folder; unlocking removes it."""
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
    """Lock a folder that only this user can open; return False if another process has locked it.

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
    """Delay signals, so that none interrupts between making and recording a file."""
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT, signal.SIGTERM})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


_LOG = logging.getLogger(__name__)


def tidy(root: Path) -> None:
    """Remove the transaction and the lock that an interrupted process left in the keystore.

    The transaction is completed if it was committed, and otherwise undone.

    Raises:
        KeystoreError: the keystore is busy, or the stage was not made by sros for this keystore.
    """
    if not any(os.path.lexists(root / name) for name in (STAGE, LOCK)):
        return
    with Folder(root, for_owner=True) as folder:
        lock = KeystoreLock(folder)
        try:
            lock.acquire()
            recover(folder)
        finally:
            lock.release()


def recover(folder: Folder) -> None:
    """Complete or undo an interrupted transaction, if there is one; the caller holds the lock."""
    if not folder.is_folder(STAGE):
        return
    to, moves = check_interrupted(folder)
    if to == AFTER:
        _LOG.info("moving the committed files to their places in the keystore '%s'", folder.path)
        complete(folder, moves)
        return
    if to == BEFORE:
        _LOG.info("undoing an uncommitted transaction in the keystore '%s'", folder.path)
        _undo(folder, moves)
    _remove_stage(folder)


def complete(folder: Folder, moves: Sequence[Move]) -> None:
    """Move all committed files to their places, and remove the stage."""
    _replace_links(folder, moves)
    if folder.is_folder(f"{STAGE}/{ADDED}"):
        _move_into_place(folder, f"{STAGE}/{ADDED}", "")
    folder.flush()
    _remove_stage(folder)


def _remove_stage(folder: Folder) -> None:
    """Remove the stage of a transaction that changed nothing, or is complete or undone."""
    # First ``live``: without it, the rest of the stage only needs to be removed.
    folder.unlink(f"{STAGE}/{LIVE}", missing_ok=True)
    folder.remove_tree(STAGE)


def _replace_links(folder: Folder, moves: Sequence[Move]) -> None:
    """Replace the links into the stage with the new files and links."""
    _make_folders(folder, {(move.to or move.path).rpartition("/")[0] for move in moves})

    def replace(part: Sequence[Move]) -> None:
        spare = f"{STAGE}/spare.{os.getpid()}"
        for path, before, after, to in part:
            name = staged_name(path)
            if to:
                _move_folder(folder, path, to)
            elif after is None:
                if _leads_into_stage(folder, path):
                    folder.unlink(path)
            elif after:
                if _leads_into_stage(folder, path):
                    _replace_by_link(folder, after, spare, path)
            else:
                with contextlib.suppress(FileNotFoundError):  # an earlier recovery moved it
                    folder.replace(f"{STAGE}/{AFTER}/{name}", path)
            if before is not None:
                folder.unlink(f"{STAGE}/{BEFORE}/{name}", missing_ok=True)

    map_slices(moves, replace)
    removed = (move for move in moves if move.after is None)
    gone = (move.path.rpartition("/")[0] if move.to else move.path for move in removed)
    _remove_empty_folders(folder, gone)


def _move_folder(folder: Folder, certificate: str, to: str) -> None:
    """Move the folder of a removed ``certificate`` to ``to``, without the links in it."""
    with contextlib.suppress(FileNotFoundError):  # an earlier recovery moved it
        folder.rename(certificate.rpartition("/")[0], to)
    with contextlib.suppress(FileNotFoundError):  # an earlier recovery put it back
        kept = f"{STAGE}/{BEFORE}/{staged_name(certificate)}"
        folder.replace(kept, f"{to}/{CERTIFICATE_FILE}")
    for link in folder.links(to):
        folder.unlink(f"{to}/{link}")


def _undo(folder: Folder, moves: Sequence[Move]) -> None:
    """Restore the files that links into the stage replaced."""
    for path, before, *_ in moves:
        if not _leads_into_stage(folder, path):
            continue
        if before is None:
            folder.unlink(path)
        elif before:
            _replace_by_link(folder, before, f"{STAGE}/spare", path)
        else:
            folder.replace(f"{STAGE}/{BEFORE}/{staged_name(path)}", path)
    if any(move.path == CRL and move.before is None for move in moves):
        _unlink_from_list(folder)


def link_to_first_list(folder: Folder, names: Sequence[str]) -> None:
    """Make the link ``crl.pem`` for enclaves; it leads nowhere until there is a list."""
    for name in names:
        folder.symlink(link_to_list(name), f"{enclave_folder(name)}/{CRL_FILE}")


def _unlink_from_list(folder: Folder) -> None:
    """Remove the links ``crl.pem`` to the list, which is not there."""
    for name in search_enclaves(folder.path)[0]:
        path = f"{enclave_folder(name)}/{CRL_FILE}"
        if folder.link_target(path) == link_to_list(name):
            folder.unlink(path)


def _replace_by_link(folder: Folder, target: str, spare: str, path: str) -> None:
    folder.unlink(spare, missing_ok=True)  # left by an interrupted recovery
    folder.symlink(target, spare)
    folder.replace(spare, path)


def _leads_into_stage(folder: Folder, path: str) -> bool:
    return folder.link_target(path) == stage_link_target(path)


def _make_folders(folder: Folder, paths: Iterable[str]) -> None:
    """Make the missing folders among ``paths``.

    Raises:
        KeystoreError: a path exists and is not a real folder.
    """
    there = {""}

    def make(path: str) -> None:
        if path in there:
            return
        make(path.rpartition("/")[0])
        if not folder.is_folder(path):
            folder.mkdir(path, folder_mode(path))
        there.add(path)

    for path in paths:
        make(path)


def _move_into_place(folder: Folder, source: str, target: str) -> None:
    """Move everything in the folder ``source`` to the same paths below the folder ``target``.

    CA keys move after their certificates, and enclaves last: a folder without enclaves does not
    count as a keystore yet.
    """
    for name in sorted(folder.names(source), key=lambda each: (each == ENCLAVES, each == PRIVATE)):
        old, new = f"{source}/{name}", f"{target}/{name}".lstrip("/")
        state = folder.state(old)
        if state is None or not stat.S_ISDIR(state.st_mode):
            folder.replace(old, new)
        elif folder.is_folder(new):
            _move_into_place(folder, old, new)
        else:
            folder.rename(old, new)


def _remove_empty_folders(folder: Folder, paths: Iterable[str]) -> None:
    """Remove the empty parent folders of ``paths``, except the folders directly in ``folder``."""
    for parent in dict.fromkeys(path.rpartition("/")[0] for path in paths):
        with contextlib.suppress(OSError):  # it is not empty
            while "/" in parent:
                with contextlib.suppress(FileNotFoundError):  # an earlier recovery removed it
                    folder.rmdir(parent)
                parent = parent.rpartition("/")[0]
