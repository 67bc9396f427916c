"""Moves, makes and removes folders of a keystore, and follows no links on the way."""

from __future__ import annotations

import contextlib
import os
import stat
from collections.abc import Iterable
from pathlib import Path

from sros_tool.errors import KeystoreError
from sros_tool.keystore.layout import ENCLAVES, folder_mode


def is_folder(path: str | Path) -> bool:
    """Whether a real folder is at ``path``; raises `KeystoreError` if something else is."""
    try:
        mode = os.lstat(path).st_mode
    except FileNotFoundError:
        return False
    if stat.S_ISLNK(mode):
        raise KeystoreError(
            f"'{path}' is a symbolic link",
            "What is written below it would land elsewhere, outside of the keystore.",
            "Put a real folder in its place.",
        )
    if not stat.S_ISDIR(mode):
        raise KeystoreError(f"'{path}' is in the way", "It is not a folder.")
    return True


def make_folders(root: Path, folders: Iterable[str]) -> None:
    """See that the folders are there, and real."""
    seen = {""}

    def see(folder: str) -> None:
        if folder in seen:
            return
        see(folder.rpartition("/")[0])
        if not is_folder(f"{root}/{folder}"):
            os.mkdir(f"{root}/{folder}", folder_mode(folder))
        seen.add(folder)

    for folder in folders:
        see(folder)


def settle_folders(source: Path, target: Path) -> None:
    """Move everything below ``source``, if it is there, to its place below ``target``.

    The enclaves come last: without them, a new keystore that is not complete yet is none.
    """
    if not source.is_dir():
        return
    with os.scandir(source) as entries:
        for entry in sorted(entries, key=lambda each: each.name == ENCLAVES):
            place = target / entry.name
            if not entry.is_dir(follow_symlinks=False):
                os.replace(entry.path, place)
            elif is_folder(place):
                settle_folders(Path(entry.path), place)
            else:
                os.rename(entry.path, place)


def remove_empty_folders(root: Path, paths: Iterable[str]) -> None:
    """Remove the folders of ``paths`` of which nothing is left; never one of the first level."""
    for path in paths:
        folder = path.rpartition("/")[0]
        with contextlib.suppress(OSError):  # it is not empty
            while "/" in folder:
                with contextlib.suppress(FileNotFoundError):  # by whoever was stopped here
                    os.rmdir(root / folder)
                folder = folder.rpartition("/")[0]
