"""The stage of a transaction: the folder that holds what is to change, and the list of it.

``.sros-transaction`` in the keystore holds

- ``after``: new files and links for folders that exist, flat, each by the `number` of its path;
- ``before``: what they replace, by the same numbers, as soon as the change has begun;
- ``live``: a link to ``before`` or ``after``; pointing it at the other is the commit;
- ``added``: new folders, as they will be in the keystore;
- ``manifest.json``: the paths of all that is in ``after``, or removed, as `Move`.
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
    """How a path of the keystore changes, where its folder exists.

    ``before`` and ``after`` say what is at the path: None for nothing, "" for a file, and for a
    symbolic link its text.
    """

    path: str
    before: str | None
    after: str | None


@dataclass(frozen=True, slots=True)
class Change:
    """One file that a transaction creates or replaces; ``path`` is relative to the keystore."""

    action: str
    path: str


@dataclass(frozen=True, slots=True)
class Staged:
    """What a forked worker staged, for the process that commits."""

    changes: tuple[Change, ...]
    moves: tuple[Move, ...]


def number(path: str) -> str:
    """Return the name in the stage for a path; short, so that a link to it fits its inode."""
    return hashlib.blake2b(os.fsencode(path), digest_size=8).hexdigest()


def bridge_text(path: str) -> str:
    """Return the text of the link that is at ``path`` while it changes."""
    return "../" * path.count("/") + f"{STAGE}/{LIVE}/{number(path)}"


def seen_from_stage(path: str, text: str) -> str:
    """Return the text that a link in the stage needs to lead where one at ``path`` would."""
    return text if text.startswith("/") else f"../../{path.rpartition('/')[0]}/{text}"


def point_live(stage: Path, to: str) -> None:
    """Atomically point the ``live`` symlink at ``to``, which is ``before`` or ``after``."""
    spare = f"{stage}/{LIVE}.next"
    os.symlink(to, spare)
    os.replace(spare, f"{stage}/{LIVE}")


def write_manifest(stage: Path, moves: Sequence[Move]) -> None:
    """Write the list of all moves; it must be on the disk before the first one begins."""
    with open(stage / MANIFEST, "x", encoding="utf-8") as file:
        file.write(json.dumps({"version": _VERSION, "moves": moves}))


def read_manifest(stage: Path) -> tuple[Move, ...]:
    """Return the list of moves.

    Raises:
        KeystoreError: it cannot be read, or no transaction of this version wrote it.
    """
    try:
        read = json.loads((stage / MANIFEST).read_bytes())
        if read["version"] != _VERSION:
            raise ValueError(f"it is not of version {_VERSION}")
        return tuple(_move(*each) for each in read["moves"])
    except (OSError, ValueError, TypeError, KeyError) as error:
        raise KeystoreError(
            f"the interrupted change in '{stage}' can be neither completed nor undone",
            f"Its list of files, {MANIFEST}, cannot be read: {error}.",
            "Complete it with the version of sros that began it, or restore the keystore from a "
            "backup.",
        ) from error


def _move(path: str, before: str | None, after: str | None) -> Move:
    # A keystore may come from an archive, with a stage that somebody made up.
    for each in (before, after):
        if each is not None and not isinstance(each, str):
            raise ValueError(f"{each!r} is no file")
    if not path or not set(path.split("/")).isdisjoint({"", ".", "..", STAGE}):
        raise ValueError(f"{path!r} is no path in a keystore")
    return Move(path, before, after)
