"""Recovers transactions that an earlier sros left behind: their stage held trees of folders.

``new`` and ``old`` had the paths of the keystore, ``removed`` listed what was to go, and ``live``
led to ``old`` until the moment of the change, then to ``new``.
"""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
from pathlib import Path

from sros_tool.keystore import filesystem
from sros_tool.keystore.folders import is_folder, remove_empty_folders, settle_folders
from sros_tool.keystore.stage import LIVE, STAGE

OLD, NEW, _REMOVED = "old", "new", "removed"


def recover(root: Path, stage: Path, *, committed: bool) -> None:
    """Complete the transaction if its change was ``committed``, or undo it."""
    if committed:
        _settle_links(stage / NEW, root)
        settle_folders(stage / NEW, root)
        _remove(stage / _REMOVED, root)
        filesystem.flush_folder(root)
        return
    for path in _files_below(stage / OLD):
        if _leads_into_stage(root / path):
            os.replace(stage / OLD / path, root / path)
    for path in _files_below(stage / NEW):
        if _leads_into_stage(root / path):
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


def _leads_into_stage(path: Path) -> bool:
    return path.is_symlink() and f"{STAGE}/{LIVE}/" in os.readlink(path)
