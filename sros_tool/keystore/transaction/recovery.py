"""Recovery of a keystore: completes a committed transaction, or undoes an uncommitted one.

Every transaction ends with a recovery: after the commit, plain files replace the links into the
stage, and new folders move to their places.  Each step can be repeated and skips finished work, so
an interrupted recovery can be repeated, too.
"""

from __future__ import annotations

import contextlib
import logging
import os
import stat
from collections.abc import Iterable, Sequence
from pathlib import Path

from sros_tool.folders import Folder
from sros_tool.keystore.layout import ENCLAVES, LOCK, PRIVATE, STAGE, folder_mode
from sros_tool.keystore.transaction.lock import KeystoreLock
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

_LOG = logging.getLogger(__name__)


def tidy(root: Path) -> None:
    """Remove what an interrupted process left in the keystore: its transaction, and its lock.

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
    """Put everything that was committed in its place, and remove the stage."""
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
    _make_folders(folder, {move.path.rpartition("/")[0] for move in moves})

    def replace(part: Sequence[Move]) -> None:
        spare = f"{STAGE}/spare.{os.getpid()}"
        for path, before, after in part:
            name = staged_name(path)
            if after is None:
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
    _remove_empty_folders(folder, (move.path for move in moves if move.after is None))


def _undo(folder: Folder, moves: Sequence[Move]) -> None:
    """Restore the files that links into the stage replaced."""
    for path, before, _ in moves:
        if not _leads_into_stage(folder, path):
            continue
        if before is None:
            folder.unlink(path)
        elif before:
            _replace_by_link(folder, before, f"{STAGE}/spare", path)
        else:
            folder.replace(f"{STAGE}/{BEFORE}/{staged_name(path)}", path)


def _replace_by_link(folder: Folder, target: str, spare: str, path: str) -> None:
    folder.unlink(spare, missing_ok=True)  # left by an interrupted recovery
    folder.symlink(target, spare)
    folder.replace(spare, path)


def _leads_into_stage(folder: Folder, path: str) -> bool:
    return folder.link_target(path) == stage_link_target(path)


def _make_folders(folder: Folder, paths: Iterable[str]) -> None:
    """Make the missing folders; raise `KeystoreError` if one is not a real folder."""
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

    CA keys come after their certificates, and enclaves last: a folder without them does not count
    as a keystore yet.
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
    for path in paths:
        parent = path.rpartition("/")[0]
        with contextlib.suppress(OSError):  # it is not empty
            while "/" in parent:
                with contextlib.suppress(FileNotFoundError):  # an earlier recovery removed it
                    folder.rmdir(parent)
                parent = parent.rpartition("/")[0]
