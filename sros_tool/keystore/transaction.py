"""Transactions: changes of many files in a keystore that stay atomic even if the machine stops.

New files are written to the stage, the folder ``.sros-transaction`` in the keystore.  The commit
(`Transaction.commit`) changes existing files in three steps.  First, each path becomes a link to
``.sros-transaction/live/<name>``, where ``live`` is a link to ``before``, so that the content is
still the old one.  Then ``live`` becomes a link to ``after``, which replaces all files in one step.
Finally plain files replace the links, and new folders move to their places (`_recover`).  If the
machine stops at any moment, DDS finds either all old files or all new files, and the next
transaction recovers: it completes a committed transaction, and undoes an uncommitted one.  Each
step of a recovery skips finished work, so an interrupted recovery can be repeated, too.

A new keystore is created in a sibling folder and renamed to its path.

The stage holds

- ``after``: new files and links for existing folders, in one flat folder, each named by the
  `staged_name` of its path;
- ``before``: the replaced files and links, named in the same way; created by the commit;
- ``live``: a link to ``before`` or ``after``; pointing it at ``after`` is the commit;
- ``added``: new folders, as they will be in the keystore;
- ``manifest.json``: a `Move` for each path in ``after``, and for each path to remove.
"""

from __future__ import annotations

import contextlib
import errno
import hashlib
import json
import logging
import os
import re
import signal
import stat
import time
from bisect import bisect_right
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from itertools import islice
from pathlib import Path
from typing import NamedTuple, Self, TypeVar, overload

from sros_tool.errors import KeystoreError, SrosError
from sros_tool.folders import Folder, make_folders, make_temporary_folder, remove_folders, try_lock
from sros_tool.keystore.layout import (
    CERTIFICATE_FILE,
    CRL,
    CRL_FILE,
    ENCLAVES,
    KEY_FILE,
    LOCK,
    PRIVATE,
    RETIRED,
    REVOKED,
    STAGE,
    enclave_folder,
    folder_mode,
    is_layout_path,
    link_to_list,
    readable_enclaves,
    search_enclaves,
)
from sros_tool.owners import refuse_link_of_stranger, user_name
from sros_tool.parallel import map_slices
from sros_tool.xml import read_bytes

_BEFORE, _AFTER, _LIVE, _ADDED, MANIFEST = "before", "after", "live", "added", "manifest.json"
_MANIFEST_VERSION = 3
_MANIFEST_VERSION_WITHOUT_FOLDERS = 2
"""The earlier version of the manifest, which lists no moves of folders."""


class Move(NamedTuple):
    """The change of a path in an existing folder of the keystore.

    ``before`` and ``after`` describe the file at the path: None for no file, "" for a regular file,
    or the target of a symbolic link.  If the path is the certificate of an enclave whose whole
    folder moves, ``to`` is the new path of that folder.
    """

    path: str
    before: str | None
    after: str | None
    to: str = ""


_ACTION_CLOSE = "close"
_ACTION_ADOPT = "adopt"


@dataclass(frozen=True, slots=True)
class Change:
    """A change of a file or link by a transaction.

    ``action`` is usually "create", "replace" or "remove".  It is `_ACTION_CLOSE` for a private key
    or a folder of keys that other users could open before.  It is `_ACTION_ADOPT` for a keystore of
    ros2/sros2 that gets settings and a ledger.  ``path`` is relative to the keystore.
    """

    action: str
    path: str


class ChangeRun(NamedTuple):
    """The same action on several files of a folder; ``folder`` is "" or ends with "/".

    With ``file``, ``names`` are enclaves, and the action is on this file of each enclave.
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

    Consecutive changes of the same kind are stored together.  Most folders of a large keystore get
    the same files, whose names are kept in memory only once.
    """

    def __init__(self) -> None:
        """Create an empty list of changes."""
        self._runs: list[ChangeRun] = []
        self._ends: list[int] = []  # the number of changes up to the end of each run
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
        """Return a mark of the changes so far, for `added_since`."""
        self._last_is_open = False
        return len(self._runs)

    def added_since(self, mark: int) -> tuple[ChangeRun, ...]:
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
class StagedChanges:
    """The changes that a forked worker staged, sent to the process that commits.

    ``kept`` has the new files and link targets of a dry run; None stands for files beyond the
    limit.
    """

    changes: tuple[ChangeRun, ...]
    moves: tuple[Move, ...]
    kept: dict[str, bytes | str | None]


def staged_name(path: str) -> str:
    """Return the file name that stands for ``path`` in the stage.

    The name is short, so that a file system can store the target of a link to it in the inode.
    """
    return hashlib.blake2b(os.fsencode(path), digest_size=8).hexdigest()


def _stage_link_target(path: str) -> str:
    """Return the target of the link that replaces ``path`` during the commit."""
    return "../" * path.count("/") + f"{STAGE}/{_LIVE}/{staged_name(path)}"


def _relocated_target(path: str, text: str) -> str:
    """Return the link target ``text`` of ``path``, rewritten for a link in the stage."""
    return text if text.startswith("/") else f"../../{path.rpartition('/')[0]}/{text}"


def _point_live(folder: Folder, to: str) -> None:
    """Atomically make the link ``live`` of the stage lead to ``to``, ``before`` or ``after``."""
    folder.symlink(to, f"{STAGE}/{_LIVE}.next")
    folder.replace(f"{STAGE}/{_LIVE}.next", f"{STAGE}/{_LIVE}")


def _write_manifest(folder: Folder, moves: Sequence[Move]) -> None:
    """Write the manifest; the caller flushes it to disk before the first move."""
    text = json.dumps({"version": _MANIFEST_VERSION, "moves": moves})
    folder.write(f"{STAGE}/{MANIFEST}", text.encode(), 0o600)


def _read_manifest(folder: Folder) -> tuple[Move, ...]:
    """Return the moves in the manifest.

    Raises:
        KeystoreError: the manifest is damaged, or another version of sros wrote it.
    """
    try:
        read = json.loads(folder.read(f"{STAGE}/{MANIFEST}"))
        if read["version"] not in (_MANIFEST_VERSION_WITHOUT_FOLDERS, _MANIFEST_VERSION):
            raise ValueError(f"its version is not {_MANIFEST_VERSION}")
        return tuple(_checked_move(*move) for move in read["moves"])
    except (OSError, ValueError, TypeError, KeyError, RecursionError) as error:
        raise _damaged_stage_error(
            folder, f"Its list of files, {MANIFEST}, cannot be read: {error}."
        ) from error


def _checked_move(path: str, before: str | None, after: str | None, to: str = "") -> Move:
    for state in (before, after):
        if state is not None and not isinstance(state, str):
            raise ValueError(f"{state!r} is not the state of a path")
    if not isinstance(path, str) or not is_layout_path(path):
        raise ValueError(f"{path!r} is not a file of a keystore")
    if after and not _stays_inside(path, after):
        raise ValueError(f"the link {path!r} would lead out of the keystore, to {after!r}")
    if to and not (
        _ENCLAVE_CERTIFICATE_PATH.fullmatch(path)
        and after is None
        and _REVOKED_FOLDER_PATH.fullmatch(to)
    ):
        raise ValueError(f"the folder of {path!r} would move to {to!r}")
    return Move(path, before, after, to)


_ENCLAVE_CERTIFICATE_PATH = re.compile(rf"{ENCLAVES}/.+/{re.escape(CERTIFICATE_FILE)}")
_REVOKED_FOLDER_PATH = re.compile(rf"{REVOKED}/[0-9a-f]+")


def _stays_inside(path: str, target: str) -> bool:
    """Return whether a link at ``path`` to ``target`` leads to a place inside the keystore."""
    target_path = os.path.normpath(f"{os.path.dirname(path)}/{target}")
    return not target.startswith("/") and not target_path.startswith("..")


_STAGE_ENTRY = re.compile(
    rf"{_BEFORE}|{_AFTER}|{_ADDED}|{re.escape(MANIFEST)}|{_LIVE}(\.next)?|spare(\.\d+)?"
)
_STAGED_NAME = re.compile(r"[0-9a-f]{16}")


def _checked_stage_target(folder: Folder) -> str | None:
    """Return the target of the link ``live`` (_BEFORE or _AFTER); None if nothing was changed yet.

    Whoever can write to the keystore, or packed it into an archive, could forge a stage, so that
    the next verb of another user moves files.  So a stage is only accepted if sros can have made
    all of it, run by this user or by the owner of the keystore.

    Raises:
        KeystoreError: another user made the stage, or it has the format of another version.
    """
    if not folder.is_folder(STAGE):
        return None
    _check_owner(folder, STAGE)
    if folder.mode(STAGE) & 0o077:
        raise _foreign_stage_error(folder, "Other users may open it.")
    for name in folder.names(STAGE):
        if not _STAGE_ENTRY.fullmatch(name):
            raise _damaged_stage_error(
                folder, f"{name!r} is not part of the format of this version of sros."
            )
        path = f"{STAGE}/{name}"
        _check_owner(folder, path)
        if name == _ADDED:
            _check_added(folder, "")
        elif name in (_BEFORE, _AFTER):
            folder.is_folder(path)
            for staged in folder.names(path):
                if not _STAGED_NAME.fullmatch(staged):
                    raise _damaged_stage_error(
                        folder, f"{staged!r} is not a file of a transaction."
                    )
                _check_file(folder, f"{path}/{staged}")
    to = folder.link_target(f"{STAGE}/{_LIVE}")
    if to not in (None, _BEFORE, _AFTER) or (
        to is None and folder.state(f"{STAGE}/{_LIVE}") is not None
    ):
        raise _damaged_stage_error(
            folder, f"{_LIVE!r} is not part of the format of this version of sros."
        )
    return to


def check_interrupted_change(folder: Folder) -> tuple[str | None, tuple[Move, ...]]:
    """Return the target of ``live`` in a stage, and the moves to complete or undo.

    Raises:
        KeystoreError: as `_checked_stage_target` and `_read_manifest`.
    """
    to = _checked_stage_target(folder)
    return to, _read_manifest(folder) if to else ()


def _check_added(folder: Folder, path: str) -> None:
    """Raise `KeystoreError` unless all files in an added folder can belong to a keystore."""
    added_path = f"{STAGE}/{_ADDED}/{path}".rstrip("/")
    if stat.S_ISDIR(folder.mode(added_path)):
        _check_owner(folder, added_path)
        for name in folder.names(added_path):
            _check_added(folder, f"{path}/{name}".lstrip("/"))
        return
    if not is_layout_path(path):
        raise _damaged_stage_error(folder, f"{_ADDED}/{path} is not a file of a keystore.")
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
        "Find out who can write to the keystore, look at the content of this folder, and remove "
        "the folder.",
    )


Item = TypeVar("Item")
Result = TypeVar("Result")

_LOG = logging.getLogger(__name__)
_KEY_FOLDERS = (PRIVATE, ENCLAVES, REVOKED, RETIRED)
_MOST_LINKS = 8
_MOST_KEPT = 32 << 20
"""Number of bytes of new files that a dry run keeps in memory, for `Transaction.content_after`."""


class Transaction:
    """An atomic change of many files of a keystore; the keystore is locked during the change.

    A transaction is a context manager, and changes nothing without `commit`.  Unless
    ``new_keystore`` is set, the keystore must exist.  With ``dry_run``, nothing is written, and
    ``changes`` lists the changes that would be made.  With ``partial``, some enclaves may be
    unreadable, because the caller may leave them out.
    """

    def __init__(
        self,
        root: Path,
        *,
        new_keystore: bool = False,
        dry_run: bool = False,
        partial: bool = False,
    ) -> None:
        self.root = root
        self.changes = Changes()
        self.dry_run = dry_run
        self._may_be_new = new_keystore
        self._partial = partial
        self._new_root = new_keystore and not root.exists()
        self._made_parents: list[Path] = []
        self._folder: Folder | None = None
        self._lock: KeystoreLock | None = None
        self._sibling = ""
        self._staged: dict[str, tuple[str, ...]] = {}  # the names of staged files in each folder
        self._names: dict[tuple[str, ...], tuple[str, ...]] = {}
        self._folders: dict[str, bool] = {}  # whether the folder exists in the keystore
        self._parents: set[str] = set()  # parents of staged folders
        self._moves: list[Move] = []
        self._linked: frozenset[str] = frozenset()
        self._undo: list[Callable[[], None]] = []
        self._after: list[Callable[[], None]] = []
        self._adopts = False
        # In a dry run, maps paths to new files (None beyond the limit) and to targets of links.
        self._kept_content: dict[str, bytes | str | None] = {}
        self._kept_bytes = 0

    @property
    def _target_folder(self) -> Folder:
        """The folder in which to write: the keystore, or a sibling folder for a new keystore."""
        if self._folder is None:
            self._folder = Folder(self.root, for_owner=True)
        return self._folder

    @property
    def _added(self) -> str:
        """The path in `_target_folder` for files in new folders: "" or ending with "/"."""
        return "" if self._new_root else f"{STAGE}/{_ADDED}/"

    def on_failure(self, undo: Callable[[], None]) -> None:
        """Register ``undo``, which is called if the transaction ends without a commit."""
        self._undo.append(undo)

    def after_commit(self, action: Callable[[], None]) -> None:
        """Register ``action``, which is called once all files are in place."""
        self._after.append(action)

    # ── begin and end ──────────────────────────────────────────────────────────────────────

    def __enter__(self) -> Self:
        """Begin the transaction, and lock the keystore; a dry run does not lock it.

        Raises:
            KeystoreError: the keystore is busy, or a new keystore would belong to another user.
        """
        try:
            if self._may_be_new:
                refuse_link_of_stranger(self.root)
            if self._may_be_new and not self._new_root:
                self._refuse_folder_of_stranger()
            if not self.dry_run:
                self._begin()
        except BaseException:
            self._end()
            raise
        return self

    def _begin(self) -> None:
        if self._new_root:
            if self.root.name == "..":
                raise KeystoreError(
                    f"'{self.root}' names no new folder", "It ends in '..'.", "Name the folder."
                )
            self._made_parents = make_folders(self.root.parent)
            with Folder(self.root.parent) as parent:
                prefix = f".{self.root.name}.sros-"
                self._sibling, self._folder = make_temporary_folder(parent, prefix)
            _LOG.info("began to create the keystore '%s'", self.root)
            return
        self._lock = KeystoreLock(self._target_folder)
        self._lock.acquire()
        _recover(self._target_folder)
        for path in (STAGE, f"{STAGE}/{_ADDED}", f"{STAGE}/{_AFTER}"):
            self._target_folder.mkdir(path, 0o700)
        _LOG.info("began a transaction in the keystore '%s'", self.root)

    @cached_property
    def enclaves(self) -> tuple[str, ...]:
        """The sorted names of the enclaves before the change, for verbs that change all enclaves.

        Raises:
            KeystoreError: this user cannot read all files of all enclaves.
        """
        if self._new_root:
            return ()
        return search_enclaves(self.root)[0] if self._partial else readable_enclaves(self.root)

    def _refuse_folder_of_stranger(self) -> None:
        """Refuse to write keys, as root, into a folder that another user may have prepared."""
        above = Path(os.path.realpath(self.root)).parent.stat()
        owner = self._target_folder.owner[0]
        if os.geteuid() == 0 and above.st_mode & stat.S_IWOTH and owner not in (0, above.st_uid):
            raise KeystoreError(
                f"'{self.root}' belongs to user {owner}",
                "Every user can create a folder at this path, and its owner could read the keys "
                "in it.",
                "Choose another folder, or run sros as that user.",
            )

    def __exit__(self, *_error: object) -> None:
        self._end()
        for undo in self._undo:
            undo()

    def _end(self) -> None:
        try:
            if self._sibling:
                with Folder(self.root.parent) as parent, contextlib.suppress(OSError):
                    parent.remove_tree(self._sibling)
            elif self._lock and self._lock.is_held:
                _recover(self._target_folder)
        finally:
            if self._lock:
                self._lock.release()
                self._lock = None
            if self._folder:
                self._folder.close()
                self._folder = None
            remove_folders(self._made_parents)

    # ── staging ──────────────────────────────────────────────────────────────────

    def write(self, path: str, data: bytes, *, private: bool = False) -> None:
        """Stage a file with the content ``data``; a ``private`` file always has mode 0600."""
        self.write_parts(path, (data,), private=private)
        if self.dry_run and not private:
            fits = self._kept_bytes + len(data) <= _MOST_KEPT
            self._kept_content[path] = data if fits else None
            self._kept_bytes += len(data) if fits else 0

    def write_parts(self, path: str, parts: Iterable[bytes], *, private: bool = False) -> None:
        """Stage a file as `write` does, from parts; a dry run does not read the parts."""
        staged = self._prepare(path, "")
        if staged is None:
            return
        try:
            self._target_folder.write_parts(staged, parts, 0o600 if private else 0o644)
        except OSError as error:
            error.filename = f"{self.root}/{path}"
            raise

    def read(self, path: str) -> bytes:
        """Return the content of a file, to move or copy it within the keystore.

        Raises:
            KeystoreError: a link leads out of the keystore, so that the keystore's owner would get
                a copy of a foreign file.
        """
        return self._target_folder.read_inside(path)

    def place_after(self, path: str) -> str:
        """Return the path to which links at ``path`` will lead, for `content_after`."""
        for _ in range(_MOST_LINKS):
            target = self.target_after(path)
            if target is None:
                break
            path = os.path.normpath(f"{path.rpartition('/')[0]}/{target}")
            # The link leads out of the keystore.
            if target.startswith("/") or path.startswith(".."):
                return str(self.root / path) if path.startswith("..") else target
        return path

    def content_after(self, place: str) -> bytes | None:
        """Return the content that a file (not a link) will have after the transaction.

        The result is None if the file will not exist or cannot be read, or if this is a dry run
        that makes more files than it keeps in memory.
        """
        if not self.is_staged(place):
            return _read_file(self.root / place)
        if self.dry_run:
            kept = self._kept_content.get(place)
            return kept if isinstance(kept, bytes) else None
        return _read_file(Path(self._stage_place(place)))

    def files_not_kept(self) -> list[str]:
        """Return the new files that `content_after` does not know because of a dry run's limit.

        Private files are not included.
        """
        return sorted(path for path, kept in self._kept_content.items() if kept is None)

    def target_after(self, path: str) -> str | None:
        """Return the target of the link at ``path`` after the transaction, or None."""
        if not self.is_staged(path):
            return _link_target(f"{self.root}/{path}")
        if self._links_to_list(path):
            return link_to_list(path.rpartition("/")[0].removeprefix(ENCLAVES) or "/")
        if self.dry_run:
            kept = self._kept_content.get(path)
            return kept if isinstance(kept, str) else None
        target = _link_target(self._stage_place(path))
        return target and target.removeprefix(_relocated_target(path, ""))

    def _stage_place(self, path: str) -> str:
        exists = not self._new_root and self._target_folder.is_folder(path.rpartition("/")[0])
        staged = f"{STAGE}/{_AFTER}/{staged_name(path)}" if exists else f"{self._added}{path}"
        return f"{self._target_folder.path}/{staged}"

    def changed_folders(self) -> dict[str, set[str]]:
        """Map folders ("" is the keystore) to the names of their files that change.

        Links to a first revocation list are left out.
        """
        folders: dict[str, set[str]] = {}
        for run in self.changes.added_since(0):
            if run.file:
                continue
            folders.setdefault(run.folder.removesuffix("/"), set()).update(run.names)
        return folders

    def link(self, path: str, target: str) -> None:
        """Stage a symbolic link to ``target``, which is relative to the folder of ``path``."""
        staged = self._prepare(path, target)
        if staged is not None:
            flat = self._folders[path.rpartition("/")[0]]
            self._target_folder.symlink(_relocated_target(path, target) if flat else target, staged)
        else:
            self._kept_content[path] = target

    def link_to_first_list(self, names: Sequence[str]) -> None:
        """Stage the link ``crl.pem`` for enclaves without one; this transaction writes the list.

        The commit makes the links first; until the list is there, they lead nowhere.
        """
        self._linked = frozenset(names)
        self.changes.extend((ChangeRun("create", "", tuple(names), CRL_FILE),))

    def remove(self, path: str) -> None:
        """Stage the removal of a file or link, and of folders that become empty."""
        exists = self._prepare_folder(path.rpartition("/")[0], wanted=False)
        before = self._present_description(path) if exists else None
        if before is None:
            raise KeystoreError(f"'{self.root}/{path}' does not exist")
        self._begin_change(path, "remove")
        self._moves.append(Move(path, before, None))

    def move_folder(self, folder: str, to: str, files: Sequence[str], links: Sequence[str]) -> None:
        """Stage the move of the enclave folder ``folder`` to ``to``, without its ``links``.

        The commit removes the certificate, without which no node starts in the enclave.  The rest
        of the folder is moved after the commit.
        """
        for name in files:
            self._begin_change(f"{to}/{name}", "create")
        for name in (*files, *links):
            self._begin_change(f"{folder}/{name}", "remove")
        self._moves.append(Move(f"{folder}/{CERTIFICATE_FILE}", "", None, to))

    def _prepare(self, path: str, after: str) -> str | None:
        """Record a change of ``path``, and return the path of its staged file in `_target_folder`.

        ``after`` is as in `Move`.  The result is None in a dry run.
        """
        exists = self._prepare_folder(path.rpartition("/")[0])
        before = self._present_description(path) if exists else None
        self._begin_change(path, "create" if before is None else "replace")
        if exists:
            self._moves.append(Move(path, before, after))
        if self.dry_run:
            return None
        return f"{STAGE}/{_AFTER}/{staged_name(path)}" if exists else f"{self._added}{path}"

    def _begin_change(self, path: str, action: str) -> None:
        folder, _, name = path.rpartition("/")
        names = self._staged.get(folder, ())
        if name in names:
            raise KeystoreError(f"{path} would be written twice")
        self._note_staged(folder, (*names, name))
        self.changes.add(action, path)

    def _note_staged(self, folder: str, names: tuple[str, ...]) -> None:
        self._staged[folder] = self._names.setdefault(names, names)

    def is_staged(self, path: str) -> bool:
        """Return whether this transaction writes or removes ``path``."""
        folder, _, name = path.rpartition("/")
        return name in self._staged.get(folder, ()) or self._links_to_list(path)

    def _links_to_list(self, path: str) -> bool:
        folder, _, name = path.rpartition("/")
        return name == CRL_FILE and (folder.removeprefix(ENCLAVES) or "/") in self._linked

    def _present_description(self, path: str) -> str | None:
        """Return what is at a path now, in the form of `Move.before`.

        This is None for no file, "" for a regular file, or the target of a link.
        """
        state = self._target_folder.state(path)
        if state is None:
            return None
        if stat.S_ISDIR(state.st_mode):
            raise KeystoreError(
                f"'{self.root}/{path}' is in the way", "It is a folder.", "Move it away."
            )
        return self._target_folder.link_target(path) or "" if stat.S_ISLNK(state.st_mode) else ""

    def _prepare_folder(self, path: str, *, wanted: bool = True) -> bool:
        """Return whether a folder exists in the keystore; if not, stage it if ``wanted``."""
        if path in self._folders:
            return self._folders[path]
        exists = not self._new_root
        if path:
            above = self._prepare_folder(path.rpartition("/")[0], wanted=wanted)
            exists = above and self._target_folder.is_folder(path)
            if not wanted and not exists:
                return False
            if not exists and not self.dry_run:
                self._stage_folder(path)
        self._folders[path] = exists
        return exists

    def _stage_folder(self, path: str) -> None:
        parts = path.split("/")
        for length in range(1, len(parts)):
            parent = "/".join(parts[:length])
            if parent not in self._parents:
                self._make_folder(f"{self._added}{parent}", 0o700)
                self._parents.add(parent)
        self._make_folder(f"{self._added}{path}", folder_mode(path))

    def _make_folder(self, path: str, mode: int) -> None:
        with contextlib.suppress(FileExistsError):  # made before, or by another worker
            self._target_folder.mkdir(path, mode)

    # ── by forked workers ───────────────────────────────────────────────────────────────

    def stage_on_all_cores(
        self,
        items: Sequence[Item],
        work: Callable[[Sequence[Item]], Result],
        *,
        alone: bool = False,
    ) -> list[tuple[Sequence[Item], Result]]:
        """Run ``work``, which may stage changes, on slices of ``items``, as `map_slices` does.

        With ``alone``, there are no forked workers: the session of a token does not survive a fork.
        """
        own_process, first_change, first_move = os.getpid(), self.changes.mark(), len(self._moves)
        first_kept = len(self._kept_content)

        def work_on(part: Sequence[Item]) -> tuple[Result, StagedChanges | None]:
            result = work(part)
            if os.getpid() == own_process:
                return result, None
            changes, moves = self.changes.added_since(first_change), self._moves[first_move:]
            kept = dict(islice(self._kept_content.items(), first_kept, None))
            return result, StagedChanges(changes, tuple(moves), kept)

        slices = [(items, work_on(items))] if alone else map_slices(items, work_on)
        for _, (_, staged) in slices:
            if staged:
                for _, folder, names, _ in staged.changes:
                    place = folder.removesuffix("/")
                    self._note_staged(place, (*self._staged.get(place, ()), *names))
                self.changes.extend(staged.changes)
                self._moves += staged.moves
                self._kept_content |= staged.kept
        return [(part, result) for part, (result, _) in slices]

    def note_adoption(self) -> None:
        """Add a change which says that the keystore gets its first settings and ledger."""
        self._adopts = True
        self.changes.add(_ACTION_ADOPT, "")

    # ── commit ─────────────────────────────────────────────────────────────────────────────

    def commit(self) -> None:
        """Put all staged changes in place atomically, and flush them to disk.

        Private keys and folders of keys that other users could open are closed to them, because
        ros2/sros2 leaves their mode to the umask.  Only the keys of the CAs and of the changed
        enclaves are closed.  When a keystore of ros2/sros2 is taken over, or all enclaves are read,
        the keys of all enclaves are closed.

        Raises:
            KeystoreError: another process has created the keystore in the meantime.
        """
        if not self.changes:
            return
        if self.dry_run:
            for path in self._exposed_keys():
                self.changes.add(_ACTION_CLOSE, path)
            return
        folder = self._target_folder
        if self._new_root:
            folder.flush_file_system()
            self._put_keystore_in_place()
            self._finish()
            return
        _write_manifest(folder, self._moves)
        folder.flush_file_system(STAGE)
        _replace_by_live_links(folder, self._moves)
        map_slices(sorted(self._linked), partial(_link_to_first_list, folder))
        _point_live(folder, _AFTER)
        self._undo.clear()
        with contextlib.suppress(OSError, SrosError):  # already committed; `_end` tries again
            _complete_commit(folder, self._moves)
        self._finish()
        for path in self._exposed_keys():
            with contextlib.suppress(OSError):  # `check` reports what stays open
                folder.close_to_others(path)
                if not folder.mode(path) & 0o077:
                    self.changes.add(_ACTION_CLOSE, path)

    def _exposed_keys(self) -> list[str]:
        """Return the keys that other users can open, except files that this transaction writes."""
        if self._new_root:
            return []
        # This takes time for each enclave, so only verbs that read all enclaves look at all of
        # them.
        looks_at_all = self._adopts or "enclaves" in self.__dict__
        changed = None if looks_at_all else self.changed_folders()
        return [path for path in _exposed_keys(self.root, changed) if not self.is_staged(path)]

    def _finish(self) -> None:
        for action in self._after:
            action()
        _LOG.info("committed %d changes to the keystore '%s'", len(self.changes), self.root)
        if _LOG.isEnabledFor(logging.DEBUG):
            for change in self.changes:
                _LOG.debug("%s %s", change.action, change.path)

    def _put_keystore_in_place(self) -> None:
        os.fchmod(self._target_folder.handle(""), folder_mode(""))
        try:
            with Folder(self.root.parent) as parent:
                parent.rename(self._sibling, self.root.name)
        except OSError as error:
            if error.errno in (errno.ENOTEMPTY, errno.EEXIST, errno.ENOTDIR):
                raise KeystoreError(
                    f"keystore '{self.root}' already exists",
                    "Another process has just created it.",
                    "Choose another path.",
                ) from error
            raise
        self._sibling = ""
        self._made_parents.clear()
        self._undo.clear()
        with contextlib.suppress(OSError), Folder(self.root.parent) as parent:
            parent.flush()  # the files are already in place; otherwise the system flushes them soon


def _link_target(path: str) -> str | None:
    try:
        return os.readlink(path)
    except OSError:
        return None


def _read_file(path: Path) -> bytes | None:
    try:
        return read_bytes(path, "file")
    except SrosError:
        return None


def _exposed_keys(root: Path, changed: Collection[str] | None = None) -> Iterator[str]:
    """Yield the paths of private keys, and top folders of keys, that other users can open.

    Of the folders of enclaves, only those in ``changed`` are examined; None means all folders.
    """
    for top in _KEY_FOLDERS:
        if _is_open(f"{root}/{top}", stat.S_IFDIR):
            yield top
        folders = [f"{root}/{top}"]
        below = changed is None or top not in (ENCLAVES, REVOKED)
        if changed is not None and not below:
            folders = [f"{root}/{path}" for path in sorted(changed) if path.split("/")[0] == top]
        # This list grows; os.walk would follow each link to see where it leads.
        for folder in folders:
            with contextlib.suppress(OSError), os.scandir(folder) as entries:
                for entry in sorted(entries, key=lambda entry: entry.name):
                    if entry.is_dir(follow_symlinks=False) and not entry.name.startswith("."):
                        if below:
                            folders.append(entry.path)
                    elif entry.name.endswith(KEY_FILE) and _is_open(entry.path, stat.S_IFREG):
                        yield os.path.relpath(entry.path, root)


def _is_open(path: str, kind: int) -> bool:
    try:
        mode = os.lstat(path).st_mode
    except OSError:
        return False
    return stat.S_IFMT(mode) == kind and bool(mode & 0o077)


# ── links through the stage ────────────────────────────────────────────────────────────────


def _replace_by_live_links(folder: Folder, moves: Sequence[Move]) -> None:
    """Replace each path with a link through ``live`` to its old content, now in ``before``."""
    if not moves:
        return
    folder.mkdir(f"{STAGE}/{_BEFORE}", 0o700)
    _point_live(folder, _BEFORE)
    work = _LiveLinkWriter(folder)
    if _can_exchange(folder):
        map_slices(moves, work.exchange_with_links)
        return
    # A file system that cannot exchange two names: first make hard links or copies.
    if any(copied for _, copied in map_slices(moves, work.keep)):
        folder.flush_file_system(f"{STAGE}/{_BEFORE}")
    map_slices(moves, work.replace_with_links)


def _can_exchange(folder: Folder) -> bool:
    """Return whether the file system can exchange two names, found by trying it."""
    spare = f"{STAGE}/spare"
    folder.symlink(_BEFORE, spare)  # equal to `live`, so that exchanging the two changes nothing
    can = folder.exchange(spare, f"{STAGE}/{_LIVE}")
    folder.unlink(spare)
    return can


class _LiveLinkWriter:
    """Replaces the paths of some moves with links, in one of two ways.

    One way is `exchange_with_links`; the other is `keep`, followed by `replace_with_links`.
    """

    def __init__(self, folder: Folder) -> None:
        self._folder = folder

    def exchange_with_links(self, moves: Sequence[Move]) -> None:
        """Exchange each file with a link created in ``before``."""
        for move in moves:
            if move.before != "":
                self._keep_link(move)
                self._place(move)
                continue
            kept = _path_of_old_content(move)
            self._folder.symlink(_stage_link_target(move.path), kept)
            if not self._folder.exchange(kept, move.path):
                full_path = str(self._folder.path / move.path)
                raise OSError(errno.ENOTSUP, os.strerror(errno.ENOTSUP), full_path)

    def keep(self, moves: Sequence[Move]) -> bool:
        """Hard-link or copy each old file into ``before``; return whether a file was copied."""
        copied = False
        for move in moves:
            if move.before != "":
                self._keep_link(move)
                continue
            try:
                self._folder.link(move.path, _path_of_old_content(move))
            except OSError:  # the file system, or the owner of the file, allows no hard links
                self._folder.copy(move.path, _path_of_old_content(move))
                copied = True
        return copied

    def replace_with_links(self, moves: Sequence[Move]) -> None:
        """Replace each file with its link, after `keep`."""
        for move in moves:
            self._place(move)

    def _keep_link(self, move: Move) -> None:
        if move.before:
            self._folder.symlink(
                _relocated_target(move.path, move.before), _path_of_old_content(move)
            )

    def _place(self, move: Move) -> None:
        if move.before is None:
            self._folder.symlink(_stage_link_target(move.path), move.path)
            return
        spare = f"{STAGE}/spare.{os.getpid()}"
        self._folder.symlink(_stage_link_target(move.path), spare)
        self._folder.replace(spare, move.path)


def _path_of_old_content(move: Move) -> str:
    """Return the path of the old content during the commit."""
    return f"{STAGE}/{_BEFORE}/{staged_name(move.path)}"


_LOCK_SECONDS = 60.0
_LOCK_RETRY_SECONDS = 0.02


class KeystoreLock:
    """The lock on a keystore: a locked file in the keystore.

    The file exists only while the keystore is locked. Only the owner of the keystore (and root) can
    open the file, so no other user can hold the lock. The folder itself is not locked, because
    anybody who may read it could lock it.
    """

    def __init__(self, folder: Folder, label: str = "keystore") -> None:
        """Prepare to lock ``folder``; ``label`` is the name of the folder in errors."""
        self._folder = folder
        self._what = label
        self._handle = -1

    @property
    def is_held(self) -> bool:
        """Whether this process holds the lock."""
        return self._handle >= 0

    def acquire(self, wait: float | None = None) -> Self:
        """Lock the keystore, waiting up to ``wait`` seconds (default: 60) for another process.

        The caller must call `release` even if an exception is raised, because a signal may arrive
        just after the file was made.

        Raises:
            KeystoreError: another process held the lock for ``wait`` seconds.
        """
        wait = _LOCK_SECONDS if wait is None else wait
        deadline = time.monotonic() + wait
        while not self._try_to_lock() and time.monotonic() < deadline:
            time.sleep(_LOCK_RETRY_SECONDS)
        if not self.is_held:
            state = self._folder.state(LOCK)
            if state and os.geteuid() not in (0, state.st_uid):  # who is at work hands it over
                raise _left_by_other_user_error(self._folder.path / LOCK)
            raise KeystoreError(
                f"{self._what} '{self._folder.path}' is busy",
                f"Another process has been writing to it for {wait:.0f} seconds.",
                "Try again when that process has finished.",
            )
        return self

    def _try_to_lock(self) -> bool:
        """Take the lock if it is free; return whether this process now holds it."""
        try:
            with _signals_held_back():
                handle = self._folder.open_private(LOCK)
                try:
                    regular = stat.S_ISREG(os.fstat(handle).st_mode)
                    if regular and try_lock(handle) and self._is_there(handle):
                        self._handle = handle
                finally:
                    if not self.is_held:
                        os.close(handle)
        except FileNotFoundError:
            return False  # another process has just removed it
        except PermissionError:
            if self._folder.state(LOCK) is None:
                raise  # this user cannot write to the folder
            return False  # root has just made the file, and will hand it over to the owner
        except OSError as error:
            if error.errno not in (errno.ELOOP, errno.ENXIO):  # a link or a socket
                raise
            raise self._blocked_lock_error() from error
        if not regular:
            raise self._blocked_lock_error()
        return self.is_held

    def _blocked_lock_error(self) -> KeystoreError:
        return KeystoreError(
            f"'{self._folder.path / LOCK}' is in the way",
            "It is not a file that sros made.",
            "Find out who can write to the folder, and remove this file.",
        )

    def _is_there(self, handle: int) -> bool:
        """Return whether the locked file is still in the folder, because unlocking removes it."""
        state = self._folder.state(LOCK)
        return state is not None and os.path.samestat(state, os.fstat(handle))

    def release(self) -> None:
        """Unlock the keystore."""
        if self._handle >= 0:
            for _ in range(2):  # on a full disk, the first attempt may fail
                with contextlib.suppress(OSError):
                    self._folder.unlink(LOCK, missing_ok=True)
                    break  # a file there now would be the lock of another process
            os.close(self._handle)
            self._handle = -1


@contextlib.contextmanager
def _signals_held_back() -> Iterator[None]:
    """Delay signals, so that none arrives between making a file and recording it."""
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT, signal.SIGTERM})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def recover_keystore(root: Path) -> None:
    """Remove the transaction and the lock that an interrupted process left in the keystore.

    The transaction is completed if it was committed; otherwise it is undone.

    Raises:
        KeystoreError: the keystore is busy, or the stage was not made by sros for this keystore.
    """
    if not any(os.path.lexists(root / name) for name in (STAGE, LOCK)):
        return
    with Folder(root, for_owner=True) as folder:
        lock = KeystoreLock(folder)
        try:
            lock.acquire()
            _recover(folder)
        finally:
            lock.release()


def _recover(folder: Folder) -> None:
    """Complete or undo an interrupted transaction, if there is one; the caller holds the lock."""
    if not folder.is_folder(STAGE):
        return
    try:
        _complete_or_undo(folder)
    except PermissionError as error:
        if os.geteuid() == 0:
            raise
        raise _left_by_other_user_error(Path(os.fsdecode(error.filename or STAGE))) from error


def _left_by_other_user_error(path: Path) -> KeystoreError:
    """Return the error for a file of an interrupted run that this user cannot open or remove."""
    user = "another user"
    with contextlib.suppress(OSError):
        user = user_name(path.lstat().st_uid)
    return KeystoreError(
        f"'{path}' is in the way, and this user cannot open it",
        f"It belongs to {user}, whose run of sros is not finished, or was killed.",
        "Wait until sros no longer runs for that user. If the file stays, run the command once "
        "as root: sros then completes or undoes the interrupted change.",
    )


def _complete_or_undo(folder: Folder) -> None:
    to, moves = check_interrupted_change(folder)
    if to == _AFTER:
        _LOG.info("moving the committed files to their places in the keystore '%s'", folder.path)
        _complete_commit(folder, moves)
        return
    if to == _BEFORE:
        _LOG.info("undoing an uncommitted transaction in the keystore '%s'", folder.path)
        _undo(folder, moves)
    _remove_stage(folder)


def _complete_commit(folder: Folder, moves: Sequence[Move]) -> None:
    """Move all committed files to their places, and remove the stage."""
    _replace_links(folder, moves)
    if folder.is_folder(f"{STAGE}/{_ADDED}"):
        _move_into_place(folder, f"{STAGE}/{_ADDED}", "")
    folder.flush()
    _remove_stage(folder)


def _remove_stage(folder: Folder) -> None:
    """Remove the stage of a transaction that is complete, was undone, or changed nothing."""
    # ``live`` comes first: without it, a recovery only has to remove the rest of the stage.
    folder.unlink(f"{STAGE}/{_LIVE}", missing_ok=True)
    folder.remove_tree(STAGE)


def _replace_links(folder: Folder, moves: Sequence[Move]) -> None:
    """Replace the links into the stage with the new files and links."""
    _make_folders(folder, {(move.to or move.path).rpartition("/")[0] for move in moves})

    def replace(part: Sequence[Move]) -> None:
        spare = f"{STAGE}/spare.{os.getpid()}"
        for path, before, after, to in part:
            name = staged_name(path)
            if to:
                _move_revoked_folder(folder, path, to)
            elif after is None:
                if _leads_into_stage(folder, path):
                    folder.unlink(path)
            elif after:
                if _leads_into_stage(folder, path):
                    _replace_by_link(folder, after, spare, path)
            else:
                with contextlib.suppress(FileNotFoundError):  # an earlier recovery has moved it
                    folder.replace(f"{STAGE}/{_AFTER}/{name}", path)
            if before is not None:
                folder.unlink(f"{STAGE}/{_BEFORE}/{name}", missing_ok=True)

    map_slices(moves, replace)
    removed = (move for move in moves if move.after is None)
    gone = (move.path.rpartition("/")[0] if move.to else move.path for move in removed)
    _remove_empty_folders(folder, gone)


def _move_revoked_folder(keystore_folder: Folder, certificate: str, to: str) -> None:
    """Move the folder of a removed ``certificate`` to ``to``, without the links in it."""
    with contextlib.suppress(FileNotFoundError):  # an earlier recovery has moved it
        keystore_folder.rename(certificate.rpartition("/")[0], to)
    with contextlib.suppress(FileNotFoundError):  # an earlier recovery has put it back
        kept = f"{STAGE}/{_BEFORE}/{staged_name(certificate)}"
        keystore_folder.replace(kept, f"{to}/{CERTIFICATE_FILE}")
    for link in keystore_folder.links(to):
        keystore_folder.unlink(f"{to}/{link}")


def _undo(folder: Folder, moves: Sequence[Move]) -> None:
    """Restore the files that were replaced by links into the stage."""
    for path, before, *_ in moves:
        if not _leads_into_stage(folder, path):
            continue
        if before is None:
            folder.unlink(path)
        elif before:
            _replace_by_link(folder, before, f"{STAGE}/spare", path)
        else:
            folder.replace(f"{STAGE}/{_BEFORE}/{staged_name(path)}", path)
    if any(move.path == CRL and move.before is None for move in moves):
        _unlink_from_list(folder)


def _link_to_first_list(folder: Folder, names: Sequence[str]) -> None:
    """Make the link ``crl.pem`` of enclaves; until there is a list, it leads nowhere."""
    for name in names:
        folder.symlink(link_to_list(name), f"{enclave_folder(name)}/{CRL_FILE}")


def _unlink_from_list(folder: Folder) -> None:
    """Remove the links ``crl.pem`` to a list that does not exist."""
    for name in search_enclaves(folder.path)[0]:
        path = f"{enclave_folder(name)}/{CRL_FILE}"
        if folder.link_target(path) == link_to_list(name):
            folder.unlink(path)


def _replace_by_link(folder: Folder, target: str, spare: str, path: str) -> None:
    folder.unlink(spare, missing_ok=True)  # left by an interrupted recovery
    folder.symlink(target, spare)
    folder.replace(spare, path)


def _leads_into_stage(folder: Folder, path: str) -> bool:
    return folder.link_target(path) == _stage_link_target(path)


def _make_folders(folder: Folder, paths: Iterable[str]) -> None:
    """Make the missing folders among ``paths``.

    Raises:
        KeystoreError: a path exists and is not a real folder.
    """
    existing = {""}

    def make(path: str) -> None:
        if path in existing:
            return
        make(path.rpartition("/")[0])
        if not folder.is_folder(path):
            folder.mkdir(path, folder_mode(path))
        existing.add(path)

    for path in paths:
        make(path)


def _move_into_place(folder: Folder, source: str, target: str) -> None:
    """Move everything in the folder ``source`` to the same paths below the folder ``target``.

    CA keys are moved after their certificates, and enclaves last, because a folder without enclaves
    does not yet count as a keystore.
    """
    for name in sorted(folder.names(source), key=lambda name: (name == ENCLAVES, name == PRIVATE)):
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
    for parent in dict.fromkeys(path.rpartition("/")[0] for path in paths):
        with contextlib.suppress(OSError):  # the folder is not empty
            while "/" in parent:
                with contextlib.suppress(FileNotFoundError):  # an earlier recovery has removed it
                    folder.rmdir(parent)
                parent = parent.rpartition("/")[0]
