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
import re
import stat
from bisect import bisect_right
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple, overload

from sros_tool.errors import KeystoreError
from sros_tool.folders import Folder
from sros_tool.keystore.layout import (
    CERTIFICATE_FILE,
    ENCLAVES,
    REVOKED,
    STAGE,
    enclave_folder,
    is_layout_path,
)

BEFORE, AFTER, LIVE, ADDED, MANIFEST = "before", "after", "live", "added", "manifest.json"
_VERSION = 3
_EARLIER = 2
"""The version without moves of folders."""


class Move(NamedTuple):
    """The change of a path in an existing folder of the keystore.

    ``before`` and ``after`` are the content of the path: None for nothing, "" for a file, and the
    target of a symbolic link.  If the path is the certificate of an enclave whose whole folder
    moves, ``to`` is the new path of that folder.
    """

    path: str
    before: str | None
    after: str | None
    to: str = ""


CLOSE = "close"
ADOPT = "adopt"


@dataclass(frozen=True, slots=True)
class Change:
    """A file or link that a transaction changes.

    ``action`` is "create", "replace" or "remove", or `CLOSE` for a private key or a folder of keys
    that other users could open before, or `ADOPT` for a keystore of ros2/sros2 that gets its
    settings and ledger; ``path`` is relative to the keystore.
    """

    action: str
    path: str


class ChangeRun(NamedTuple):
    """The same action on several files of a folder; ``folder`` is "" or ends with "/".

    With ``file``, it is the action on this file of each enclave in ``names``.
    """

    action: str
    folder: str
    names: tuple[str, ...]
    file: str = ""

    def path(self, name: str) -> str:
        """Return the path of the change for one of the names."""
        return f"{enclave_folder(name)}/{self.file}" if self.file else f"{self.folder}{name}"


class Changes(Sequence[Change]):
    """The changes of a transaction, in order.

    Consecutive changes of the same kind are stored together: most folders of a large keystore get
    the same files, whose names are in memory only once.
    """

    def __init__(self) -> None:
        """Create an empty list of changes."""
        self._runs: list[ChangeRun] = []
        self._ends: list[int] = []  # how many changes there are up to the end of each run
        self._names: dict[tuple[str, ...], tuple[str, ...]] = {}
        self._last_is_open = False

    def add(self, action: str, path: str) -> None:
        """Add a change at the end."""
        folder, slash, name = path.rpartition("/")
        names: tuple[str, ...] = (name,)
        if self._last_is_open and self._runs[-1][:2] == (action, folder + slash):
            names = (*self._runs.pop().names, name)
            self._ends.pop()
        self.extend((ChangeRun(action, folder + slash, names),))
        self._last_is_open = True

    def extend(self, runs: Iterable[ChangeRun]) -> None:
        """Add changes at the end."""
        for run in runs:
            names = self._names.setdefault(run.names, run.names)
            self._runs.append(run._replace(names=names))
            self._ends.append(len(self) + len(names))

    def mark(self) -> int:
        """Return a mark of the changes so far, for `since`."""
        self._last_is_open = False
        return len(self._runs)

    def since(self, mark: int) -> tuple[ChangeRun, ...]:
        """Return the changes that were added after ``mark``."""
        return tuple(self._runs[mark:])

    def __len__(self) -> int:
        return self._ends[-1] if self._ends else 0

    def __iter__(self) -> Iterator[Change]:
        return (Change(run.action, run.path(name)) for run in self._runs for name in run.names)

    @overload
    def __getitem__(self, index: int) -> Change: ...

    @overload
    def __getitem__(self, index: slice) -> Sequence[Change]: ...

    def __getitem__(self, index: int | slice) -> Change | Sequence[Change]:
        if isinstance(index, slice):
            return tuple(self)[index]
        place = range(len(self))[index]
        at = bisect_right(self._ends, place)
        run = self._runs[at]
        return Change(run.action, run.path(run.names[place - self._ends[at]]))

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Sequence) and tuple(self) == tuple(other)

    def __hash__(self) -> int:
        return hash(tuple(self))


@dataclass(frozen=True, slots=True)
class Staged:
    """The changes that a forked worker staged, sent to the process that commits.

    ``kept`` has the new files and link targets of a dry run; None for files beyond its limit.
    """

    changes: tuple[ChangeRun, ...]
    moves: tuple[Move, ...]
    kept: dict[str, bytes | str | None]


def staged_name(path: str) -> str:
    """Return the name of a path's file in the stage; short, so that a link fits in an inode."""
    return hashlib.blake2b(os.fsencode(path), digest_size=8).hexdigest()


def stage_link_target(path: str) -> str:
    """Return the target of the link that replaces ``path`` during the commit."""
    return "../" * path.count("/") + f"{STAGE}/{LIVE}/{staged_name(path)}"


def relocated_target(path: str, text: str) -> str:
    """Return the link target ``text`` of ``path``, rewritten for a link in the stage."""
    return text if text.startswith("/") else f"../../{path.rpartition('/')[0]}/{text}"


def point_live(folder: Folder, to: str) -> None:
    """Atomically point the ``live`` symlink of the stage at ``to``: ``before`` or ``after``."""
    folder.symlink(to, f"{STAGE}/{LIVE}.next")
    folder.replace(f"{STAGE}/{LIVE}.next", f"{STAGE}/{LIVE}")


def write_manifest(folder: Folder, moves: Sequence[Move]) -> None:
    """Write the manifest; the caller flushes it to disk before the first move."""
    text = json.dumps({"version": _VERSION, "moves": moves})
    folder.write(f"{STAGE}/{MANIFEST}", text.encode(), 0o600)


def _read_manifest(folder: Folder) -> tuple[Move, ...]:
    """Return the moves in the manifest.

    Raises:
        KeystoreError: the manifest is damaged, or another version of sros wrote it.
    """
    try:
        read = json.loads(folder.read(f"{STAGE}/{MANIFEST}"))
        if read["version"] not in (_EARLIER, _VERSION):
            raise ValueError(f"its version is not {_VERSION}")
        return tuple(_move(*move) for move in read["moves"])
    except (OSError, ValueError, TypeError, KeyError, RecursionError) as error:
        raise _damaged_stage_error(
            folder, f"Its list of files, {MANIFEST}, cannot be read: {error}."
        ) from error


def _move(path: str, before: str | None, after: str | None, to: str = "") -> Move:
    for state in (before, after):
        if state is not None and not isinstance(state, str):
            raise ValueError(f"{state!r} is not the state of a path")
    if not isinstance(path, str) or not is_layout_path(path):
        raise ValueError(f"{path!r} is not a file of a keystore")
    if after and not _stays_inside(path, after):
        raise ValueError(f"the link {path!r} would lead out of the keystore, to {after!r}")
    if to and not (_OF_ENCLAVE.fullmatch(path) and after is None and _MOVED.fullmatch(to)):
        raise ValueError(f"the folder of {path!r} would move to {to!r}")
    return Move(path, before, after, to)


_OF_ENCLAVE = re.compile(rf"{ENCLAVES}/.+/{re.escape(CERTIFICATE_FILE)}")
_MOVED = re.compile(rf"{REVOKED}/[0-9a-f]+")


def _stays_inside(path: str, target: str) -> bool:
    """Return whether a link at ``path`` to ``target`` leads to a place inside the keystore."""
    target_path = os.path.normpath(f"{os.path.dirname(path)}/{target}")
    return not target.startswith("/") and not target_path.startswith("..")


_KNOWN = re.compile(
    rf"{BEFORE}|{AFTER}|{ADDED}|{re.escape(MANIFEST)}|{LIVE}(\.next)?|spare(\.\d+)?"
)
_STAGED_NAME = re.compile(r"[0-9a-f]{16}")


def _check_stage(folder: Folder) -> str | None:
    """Return the target of the link ``live``: BEFORE, AFTER, or None if nothing was changed yet.

    Whoever can write to the keystore, or packed it into an archive, could forge a stage, to have
    the next verb of another user move files.  A stage is only accepted if sros, run by this user or
    by the owner of the keystore, can have made all of it.

    Raises:
        KeystoreError: another user made the stage, or it has the format of another version.
    """
    if not folder.is_folder(STAGE):
        return None
    _check_owner(folder, STAGE)
    if folder.mode(STAGE) & 0o077:
        raise _foreign_stage_error(folder, "Other users may open it.")
    for name in folder.names(STAGE):
        if not _KNOWN.fullmatch(name):
            raise _damaged_stage_error(
                folder, f"{name!r} is not part of the format of this version of sros."
            )
        path = f"{STAGE}/{name}"
        _check_owner(folder, path)
        if name == ADDED:
            _check_added(folder, "")
        elif name in (BEFORE, AFTER):
            folder.is_folder(path)
            for staged in folder.names(path):
                if not _STAGED_NAME.fullmatch(staged):
                    raise _damaged_stage_error(
                        folder, f"{staged!r} is not a file of a transaction."
                    )
                _check_file(folder, f"{path}/{staged}")
    to = folder.link_target(f"{STAGE}/{LIVE}")
    if to not in (None, BEFORE, AFTER) or (
        to is None and folder.state(f"{STAGE}/{LIVE}") is not None
    ):
        raise _damaged_stage_error(
            folder, f"{LIVE!r} is not part of the format of this version of sros."
        )
    return to


def check_interrupted(folder: Folder) -> tuple[str | None, tuple[Move, ...]]:
    """Return the target of ``live`` in a stage, and the moves to complete or to undo.

    Raises:
        KeystoreError: as `_check_stage` and `_read_manifest`.
    """
    to = _check_stage(folder)
    return to, _read_manifest(folder) if to else ()


def _check_added(folder: Folder, path: str) -> None:
    """Raise `KeystoreError` unless all files below an added folder can belong to a keystore."""
    added_path = f"{STAGE}/{ADDED}/{path}".rstrip("/")
    if stat.S_ISDIR(folder.mode(added_path)):
        _check_owner(folder, added_path)
        for name in folder.names(added_path):
            _check_added(folder, f"{path}/{name}".lstrip("/"))
        return
    if not is_layout_path(path):
        raise _damaged_stage_error(folder, f"{ADDED}/{path} is not a file of a keystore.")
    _check_file(folder, added_path)


def _check_file(folder: Folder, path: str) -> None:
    _check_owner(folder, path)
    mode = folder.mode(path)
    if not stat.S_ISREG(mode) and not stat.S_ISLNK(mode):
        raise _damaged_stage_error(folder, f"{path} is neither a file nor a link.")


def _check_owner(folder: Folder, path: str) -> None:
    state = folder.state(path)
    if state and state.st_uid not in (0, os.geteuid(), folder.owner[0]):
        raise _foreign_stage_error(folder, f"{path} belongs to user {state.st_uid}.")


def _damaged_stage_error(folder: Folder, why: str) -> KeystoreError:
    return KeystoreError(
        f"the interrupted change in '{folder.path / STAGE}' can be neither completed nor undone",
        why,
        "Complete it with the version of sros that began it, or restore the keystore from a "
        "backup.",
    )


def _foreign_stage_error(folder: Folder, why: str) -> KeystoreError:
    return KeystoreError(
        f"'{folder.path / STAGE}' is not an interrupted change of yours",
        f"{why} Somebody else may have put it there, to make sros move files with your rights.",
        "Find out who can write to the keystore, look at its content, and remove it.",
    )
