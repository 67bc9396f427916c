"""Recovery of a keystore: completes a committed transaction, or undoes an uncommitted one.

Every transaction ends with a recovery: after the commit, plain files replace the links into the
stage, and new folders move to their places.  Each step can be repeated and skips finished work, so
an interrupted recovery can be repeated, too.
"""

from __future__ import annotations

import contextlib
import logging
import os
import re
import shutil
from collections.abc import Sequence
from pathlib import Path

from sros_tool.errors import KeystoreError
from sros_tool.keystore.layout import STAGE
from sros_tool.keystore.transaction import filesystem
from sros_tool.keystore.transaction.filesystem import (
    is_folder,
    make_folders,
    move_into_place,
    remove_empty_folders,
)
from sros_tool.keystore.transaction.stage import (
    ADDED,
    AFTER,
    BEFORE,
    LIVE,
    MANIFEST,
    Move,
    read_manifest,
    stage_link_target,
    staged_name,
)
from sros_tool.parallel import map_slices

_LOG = logging.getLogger(__name__)

_KNOWN = re.compile(
    rf"{BEFORE}|{AFTER}|{ADDED}|{re.escape(MANIFEST)}|{LIVE}(\.next)?|spare(\.\d+)?"
)


def tidy(root: Path) -> None:
    """Complete or undo an interrupted transaction of the keystore, if there is one.

    Raises:
        KeystoreError: the keystore is busy, or another version of sros wrote the stage.
    """
    if (root / STAGE).is_dir():
        lock = filesystem.lock_folder(root)
        try:
            recover(root)
        finally:
            os.close(lock)


def recover(root: Path) -> None:
    """Complete or undo an interrupted transaction, if there is one; the caller holds the lock."""
    stage = root / STAGE
    if not is_folder(stage):
        return
    live = stage / LIVE
    to = _target(stage)
    if to == AFTER:
        _LOG.info("moving the committed files to their places in the keystore '%s'", root)
        _complete(root, stage, read_manifest(stage))
        move_into_place(stage / ADDED, root)
        filesystem.flush_folder(root)
    elif to == BEFORE:
        _LOG.info("undoing an uncommitted transaction in the keystore '%s'", root)
        _undo(root, stage, read_manifest(stage))
    with contextlib.suppress(FileNotFoundError):
        os.unlink(live)  # first: without it, the rest of the stage only needs to be removed
    shutil.rmtree(stage)


def _target(stage: Path) -> str | None:
    """Return the target of the link ``live``: BEFORE, AFTER, or None if nothing was changed yet.

    Raises:
        KeystoreError: the stage has a file or folder that this version does not know.
    """
    strange = next((name for name in sorted(os.listdir(stage)) if not _KNOWN.fullmatch(name)), "")
    to = None
    if not strange and os.path.lexists(stage / LIVE):
        to = os.readlink(stage / LIVE) if (stage / LIVE).is_symlink() else ""
        strange = "" if to in (BEFORE, AFTER) else LIVE
    if strange:
        raise KeystoreError(
            f"the interrupted change in '{stage}' can be neither completed nor undone",
            f"This version of sros does not know the format: {strange!r} is not part of it.",
            "Complete it with the version of sros that began it, or restore the keystore from a "
            "backup.",
        )
    return to


def _complete(root: Path, stage: Path, moves: Sequence[Move]) -> None:
    """Replace the links into the stage with the new files and links."""
    make_folders(root, {move.path.rpartition("/")[0] for move in moves})

    def complete(part: Sequence[Move]) -> None:
        spare = f"{stage}/spare.{os.getpid()}"
        for path, before, after in part:
            real, name = f"{root}/{path}", staged_name(path)
            if after is None:
                if _leads_into_stage(real, path):
                    os.unlink(real)
            elif after:
                if _leads_into_stage(real, path):
                    _symlink(after, spare)
                    os.replace(spare, real)
            else:
                with contextlib.suppress(FileNotFoundError):  # an earlier recovery moved it
                    os.replace(f"{stage}/{AFTER}/{name}", real)
            if before is not None:
                with contextlib.suppress(FileNotFoundError):
                    os.unlink(f"{stage}/{BEFORE}/{name}")

    map_slices(moves, complete)
    remove_empty_folders(root, (move.path for move in moves if move.after is None))


def _undo(root: Path, stage: Path, moves: Sequence[Move]) -> None:
    """Restore the files that links into the stage replaced."""
    spare = f"{stage}/spare"
    for path, before, _ in moves:
        real = f"{root}/{path}"
        if not _leads_into_stage(real, path):
            continue
        if before is None:
            os.unlink(real)
        elif before:
            _symlink(before, spare)
            os.replace(spare, real)
        else:
            os.replace(f"{stage}/{BEFORE}/{staged_name(path)}", real)


def _symlink(text: str, path: str) -> None:
    with contextlib.suppress(FileNotFoundError):  # left by an interrupted recovery
        os.unlink(path)
    os.symlink(text, path)


def _leads_into_stage(real: str, path: str) -> bool:
    try:
        return os.readlink(real) == stage_link_target(path)
    except OSError:
        return False
