"""Recovers transactions that an earlier sros left behind: their stage held trees of folders.

``new`` and ``old`` had the paths of the keystore, ``removed`` listed what was to go, and ``live``
led to ``old`` until the moment of the change, then to ``new``.

Both are done by whoever made the transaction, and by the next one where that was stopped.  Each
step may be done again: it finds what is done already.
"""

from __future__ import annotations

import contextlib
import os
import shutil
from collections.abc import Iterator, Sequence
from pathlib import Path

from sros_tool.keystore.layout import STAGE
from sros_tool.keystore.transaction import filesystem
from sros_tool.keystore.transaction.filesystem import (
    is_folder,
    make_folders,
    remove_empty_folders,
    settle_folders,
)
from sros_tool.keystore.transaction.stage import (
    ADDED,
    AFTER,
    BEFORE,
    LIVE,
    Move,
    bridge_text,
    number,
    read_manifest,
)
from sros_tool.parallel import in_shares

OLD, NEW, _REMOVED = "old", "new", "removed"


def earlier_stage_recover(root: Path, stage: Path, *, committed: bool) -> None:
    """Complete the transaction if its change was ``committed``, or undo it."""
    if committed:
        _settle_links(stage / NEW, root)
        settle_folders(stage / NEW, root)
        _remove(stage / _REMOVED, root)
        filesystem.flush_folder(root)
        return
    for path in _files_below(stage / OLD):
        if _earlier_stage_leads_into_stage(root / path):
            os.replace(stage / OLD / path, root / path)
    for path in _files_below(stage / NEW):
        if _earlier_stage_leads_into_stage(root / path):
            os.unlink(root / path)


def _settle_links(source: Path, target: Path) -> None:
    """Move the links that belong into folders which are there.

    They come first, for a link that is still reached through ``live`` leads to nothing as soon as
    the file that it names has left the stage.
    """
    with os.scandir(source) as entries:
        for entry in entries:
            if entry.is_symlink():
                os.replace(entry.path, target / entry.name)
            elif entry.is_dir() and is_folder(target / entry.name):
                _settle_links(Path(entry.path), target / entry.name)


def _remove(names: Path, root: Path) -> None:
    """Remove what a file lists, and the folders that are empty then."""
    if not names.exists():
        return
    paths = names.read_text(encoding="utf-8").split("\0")
    for path in paths:
        with contextlib.suppress(FileNotFoundError):
            os.unlink(root / path)
    remove_empty_folders(root, paths)


def _files_below(folder: Path) -> Iterator[str]:
    for parent, _, files in os.walk(folder):
        for file in files:
            yield os.path.relpath(os.path.join(parent, file), folder)


def _earlier_stage_leads_into_stage(path: Path) -> bool:
    return path.is_symlink() and f"{STAGE}/{LIVE}/" in os.readlink(path)


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
    if to in (OLD, NEW):
        earlier_stage_recover(root, stage, committed=to == NEW)
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
