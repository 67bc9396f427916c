"""The stage of a transaction: the folder with the new files, and the list of all changes.

``.sros-transaction`` in the keystore holds

- ``after``: new files and links for existing folders, in one flat folder, each named by the
  `staged_name` of its path;
- ``before``: the replaced files and links, named in the same way; created by the commit;
- ``live``: a link to ``before`` or ``after``; pointing it at ``after`` is the commit;
- ``added``: new folders, as they will be in the keystore;
- ``manifest.json``: a `Move` for each path in ``after``, and for each path to remove.
"""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

from sros_tool.errors import KeystoreError
from sros_tool.keystore.layout import STAGE

BEFORE, AFTER, LIVE, ADDED, MANIFEST = "before", "after", "live", "added", "manifest.json"
_VERSION = 2


class Move(NamedTuple):
    """The change of one path in an existing folder of the keystore.

    ``before`` and ``after`` say what is at the path: None for nothing, "" for a file, and the
    target of a symbolic link.
    """

    path: str
    before: str | None
    after: str | None


@dataclass(frozen=True, slots=True)
class Change:
    """One file or link that a transaction changes.

    ``action`` is "create", "replace" or "remove"; ``path`` is relative to the keystore.
    """

    action: str
    path: str


@dataclass(frozen=True, slots=True)
class Staged:
    """The changes that a forked worker staged, sent to the process that commits."""

    changes: tuple[Change, ...]
    moves: tuple[Move, ...]


def staged_name(path: str) -> str:
    """Return the name in the stage for a path; it is short, so that a link fits into an inode."""
    return hashlib.blake2b(os.fsencode(path), digest_size=8).hexdigest()


def stage_link_target(path: str) -> str:
    """Return the target of the link that is at ``path`` during the commit."""
    return "../" * path.count("/") + f"{STAGE}/{LIVE}/{staged_name(path)}"


def relocated_target(path: str, text: str) -> str:
    """Return the link target ``text`` of ``path``, rewritten for a link in the stage."""
    return text if text.startswith("/") else f"../../{path.rpartition('/')[0]}/{text}"


def point_live(stage: Path, to: str) -> None:
    """Atomically point the ``live`` symlink at ``to``, which is ``before`` or ``after``."""
    spare = f"{stage}/{LIVE}.next"
    os.symlink(to, spare)
    os.replace(spare, f"{stage}/{LIVE}")


def write_manifest(stage: Path, moves: Sequence[Move]) -> None:
    """Write the manifest; the caller flushes it to disk before the first move."""
    with open(stage / MANIFEST, "x", encoding="utf-8") as file:
        file.write(json.dumps({"version": _VERSION, "moves": moves}))


def read_manifest(stage: Path) -> tuple[Move, ...]:
    """Return the moves in the manifest.

    Raises:
        KeystoreError: the manifest is damaged, or another version of sros wrote it.
    """
    try:
        read = json.loads((stage / MANIFEST).read_bytes())
        if read["version"] != _VERSION:
            raise ValueError(f"its version is not {_VERSION}")
        return tuple(_move(*each) for each in read["moves"])
    except (OSError, ValueError, TypeError, KeyError) as error:
        raise KeystoreError(
            f"the interrupted change in '{stage}' can be neither completed nor undone",
            f"Its list of files, {MANIFEST}, cannot be read: {error}.",
            "Complete it with the version of sros that began it, or restore the keystore from a "
            "backup.",
        ) from error


def _move(path: str, before: str | None, after: str | None) -> Move:
    # A keystore may come from an archive with a forged stage.
    for each in (before, after):
        if each is not None and not isinstance(each, str):
            raise ValueError(f"{each!r} is not the state of a path")
    if not path or not set(path.split("/")).isdisjoint({"", ".", "..", STAGE}):
        raise ValueError(f"{path!r} is not a path in a keystore")
    return Move(path, before, after)
