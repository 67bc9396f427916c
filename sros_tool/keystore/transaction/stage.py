"""The folder in which a transaction gathers what is to change, and the list of that.

``.sros-transaction`` in the keystore holds

- ``after``: new files and links for folders that exist, flat, each by the `number` of its path;
- ``before``: what they take the place of, by the same numbers, as soon as the change has begun;
- ``live``: a link to ``before`` or ``after``, whose turn is the moment of the change;
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


class Move(NamedTuple):
    """What becomes of a path of the keystore, whose folder exists.

    ``before`` and ``after`` tell what is there: None for nothing, "" for a file, and of a
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
    """What was staged since some moment, for the process that shares its work with this one."""

    changes: tuple[Change, ...]
    moves: tuple[Move, ...]


def number(path: str) -> str:
    """The name in the stage of what belongs to a path; short, so that a link fits its inode."""
    return hashlib.blake2b(os.fsencode(path), digest_size=8).hexdigest()


def bridge_text(path: str) -> str:
    """The text of the link that stands at ``path`` while it changes."""
    return "../" * path.count("/") + f"{STAGE}/{LIVE}/{number(path)}"


def seen_from_stage(path: str, text: str) -> str:
    """The text for a link in ``before`` or ``after`` that leads where one at ``path`` would."""
    return text if text.startswith("/") else f"../../{path.rpartition('/')[0]}/{text}"


def turn(stage: Path, to: str) -> None:
    """Let everything that changes be reached in ``before``, or in ``after``."""
    spare = f"{stage}/{LIVE}.next"
    os.symlink(to, spare)
    os.replace(spare, f"{stage}/{LIVE}")


def write_manifest(stage: Path, moves: Sequence[Move]) -> None:
    """Write the list of all moves; it must be on the disk before the first is begun."""
    with open(stage / MANIFEST, "x", encoding="utf-8") as file:
        file.write(json.dumps({"version": 2, "moves": moves}))


def read_manifest(stage: Path) -> tuple[Move, ...]:
    """The list of moves; raises `KeystoreError` if it is not one that a transaction wrote."""
    try:
        read = json.loads((stage / MANIFEST).read_bytes())
        if read["version"] != 2:
            raise ValueError("of another version")
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
