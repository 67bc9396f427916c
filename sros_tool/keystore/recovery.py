"""Completes a transaction after its moment of change, or undoes one that did not reach it.

Both are done by whoever made the transaction, and by the next one where that was stopped.  Each
step may be done again: it finds what is done already.
"""

from __future__ import annotations

import contextlib
import os
import shutil
from collections.abc import Sequence
from pathlib import Path

from sros_tool.keystore import earlier_stage, filesystem
from sros_tool.keystore.folders import (
    is_folder,
    make_folders,
    remove_empty_folders,
    settle_folders,
)
from sros_tool.keystore.parallel import in_shares
from sros_tool.keystore.stage import (
    ADDED,
    AFTER,
    BEFORE,
    LIVE,
    STAGE,
    Move,
    bridge_text,
    number,
    read_manifest,
)


def tidy(root: Path) -> None:
    """Complete or undo what an interrupted transaction left behind, if there is anything."""
    if (root / STAGE).is_dir():
        lock = filesystem.lock_folder(root)
        try:
            recover(root)
        finally:
            os.close(lock)


def recover(root: Path) -> None:
    """As `tidy`, for a caller that holds the lock."""
    stage = root / STAGE
    if not is_folder(stage):
        return
    live = stage / LIVE
    to = os.readlink(live) if live.is_symlink() else ""
    if to in (earlier_stage.OLD, earlier_stage.NEW):
        earlier_stage.recover(root, stage, committed=to == earlier_stage.NEW)
    elif to == AFTER:
        _complete(root, stage, read_manifest(stage))
        settle_folders(stage / ADDED, root)
        filesystem.flush_folder(root)
    elif to:
        _undo(root, stage, read_manifest(stage))
    with contextlib.suppress(FileNotFoundError):
        os.unlink(live)  # first, for without it what is left of the stage is only to be removed
    shutil.rmtree(stage)


def _complete(root: Path, stage: Path, moves: Sequence[Move]) -> None:
    """Let plain files and links take the place of those that lead into the stage."""
    make_folders(root, {move.path.rpartition("/")[0] for move in moves})

    def work(share: Sequence[Move]) -> None:
        spare = f"{stage}/spare.{os.getpid()}"
        for path, before, after in share:
            real, name = f"{root}/{path}", number(path)
            if after is None:
                if _leads_into_stage(real, path):
                    os.unlink(real)
            elif after:
                if _leads_into_stage(real, path):
                    _symlink(after, spare)
                    os.replace(spare, real)
            else:
                with contextlib.suppress(FileNotFoundError):  # it was done before
                    os.replace(f"{stage}/{AFTER}/{name}", real)
            if before is not None:
                with contextlib.suppress(FileNotFoundError):
                    os.unlink(f"{stage}/{BEFORE}/{name}")

    in_shares(moves, work)
    remove_empty_folders(root, (move.path for move in moves if move.after is None))


def _undo(root: Path, stage: Path, moves: Sequence[Move]) -> None:
    """Put everything back that a link into the stage took the place of."""
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
            os.replace(f"{stage}/{BEFORE}/{number(path)}", real)


def _symlink(text: str, path: str) -> None:
    with contextlib.suppress(FileNotFoundError):  # that of whoever was stopped here
        os.unlink(path)
    os.symlink(text, path)


def _leads_into_stage(real: str, path: str) -> bool:
    try:
        return os.readlink(real) == bridge_text(path)
    except OSError:
        return False
