"""Transactions: atomic changes of many files in a keystore, even if the machine stops.

New files are written below ``.sros-transaction`` in the keystore (`stage`).  The commit
(`Transaction.commit`) changes existing files in three steps.  Each path becomes a link to
``.sros-transaction/live/<name>``; ``live`` is a link to ``before``, so the content is still the
old one.  Then ``live`` is pointed at ``after``, which changes all files at once.  Finally plain
files replace the links, and new folders move to their places (`recovery`).  If the machine stops at
any moment, DDS finds either all old files or all new files, and the next transaction recovers.

A new keystore is created in a sibling folder and renamed to its path.
"""

from __future__ import annotations

import contextlib
import errno
import glob
import logging
import os
import secrets
import shutil
import stat
from collections.abc import Callable, Sequence
from pathlib import Path
from types import TracebackType
from typing import Self

from sros_tool.errors import KeystoreError, SrosError
from sros_tool.keystore.layout import STAGE, folder_mode
from sros_tool.keystore.transaction import filesystem
from sros_tool.keystore.transaction.filesystem import is_folder
from sros_tool.keystore.transaction.recovery import recover
from sros_tool.keystore.transaction.stage import (
    ADDED,
    AFTER,
    BEFORE,
    LIVE,
    Change,
    Move,
    Staged,
    point_live,
    relocated_target,
    stage_link_target,
    staged_name,
    write_manifest,
)
from sros_tool.parallel import map_slices

_LOG = logging.getLogger(__name__)


class Transaction:
    """An atomic change of many files of a keystore, which is locked meanwhile.

    Use it as a context manager; without `commit` nothing changes.  With ``fresh``, the keystore may
    be new; otherwise it must exist.  With ``dry_run`` nothing is written, and ``changes`` lists the
    changes that would be made.
    """

    def __init__(self, root: Path, *, fresh: bool = False, dry_run: bool = False) -> None:
        self.root = root
        self.changes: list[Change] = []
        self.dry_run = dry_run
        self._new_root = fresh and not root.exists()
        self._made_parents: list[Path] = []
        self._lock = -1
        self._stage = root / STAGE
        self._added = f"{self._stage}/{ADDED}"
        self._staged: set[str] = set()
        self._folders: dict[str, bool] = {}  # whether the folder exists in the keystore
        self._moves: list[Move] = []
        self._undo: list[Callable[[], None]] = []

    def on_failure(self, undo: Callable[[], None]) -> None:
        """Have ``undo`` called if the transaction ends without a commit."""
        self._undo.append(undo)

    # ── begin and end ──────────────────────────────────────────────────────────────────────

    def __enter__(self) -> Self:
        if self.dry_run:
            return self
        try:
            self._begin()
        except BaseException:
            self._end()
            raise
        return self

    def _begin(self) -> None:
        if self._new_root:
            self._remove_stale_siblings()
            self._make_parents()
            self._make_sibling()
            _LOG.info("began to create the keystore '%s'", self.root)
            return
        self._lock = filesystem.lock_folder(self.root)
        recover(self.root)
        self._stage.mkdir(mode=0o700)
        os.mkdir(self._added, 0o700)
        os.mkdir(f"{self._stage}/{AFTER}", 0o700)
        _LOG.info("began a transaction in the keystore '%s'", self.root)

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if not self.dry_run:
            self._end()
        for undo in self._undo:
            undo()

    def _end(self) -> None:
        if self._stage != self.root / STAGE:
            shutil.rmtree(self._stage, ignore_errors=True)
        elif self._lock >= 0:
            recover(self.root)
        if self._lock >= 0:
            os.close(self._lock)
            self._lock = -1
        for parent in self._made_parents:
            with contextlib.suppress(OSError):
                parent.rmdir()

    def _make_parents(self) -> None:
        missing = []
        parent = self.root.parent
        while not parent.exists():
            missing.append(parent)
            parent = parent.parent
        for each in reversed(missing):
            with contextlib.suppress(FileExistsError):  # another process created it meanwhile
                each.mkdir()
                self._made_parents.insert(0, each)

    def _make_sibling(self) -> None:
        while self._lock < 0:
            self._stage = self.root.parent / f".{self.root.name}.sros-{secrets.token_hex(4)}"
            self._added = f"{self._stage}"
            self._stage.mkdir(mode=0o700)
            # Until the folder is locked, another process may take it for a stale one and remove it.
            with contextlib.suppress(FileNotFoundError):
                lock = filesystem.lock_folder(self._stage)
                if self._stage.exists():
                    self._lock = lock
                else:
                    os.close(lock)

    def _remove_stale_siblings(self) -> None:
        for stale in self.root.parent.glob(f".{glob.escape(self.root.name)}.sros-*"):
            with contextlib.suppress(KeystoreError, OSError):
                lock = filesystem.lock_folder(stale, wait=0.0)
                shutil.rmtree(stale, ignore_errors=True)
                os.close(lock)

    # ── staging ──────────────────────────────────────────────────────────────────

    def write(self, path: str, data: bytes, *, private: bool = False) -> None:
        """Stage a file with the content ``data``; a ``private`` file always has mode 0600."""
        staged = self._prepare(path, "")
        if staged is None:
            return
        mode = 0o600 if private else 0o644
        handle = os.open(staged, os.O_WRONLY | os.O_CREAT | os.O_EXCL, mode)
        try:
            view = memoryview(data)
            while view:
                view = view[os.write(handle, view) :]
        except OSError as error:
            error.filename = f"{self.root}/{path}"
            raise
        finally:
            os.close(handle)

    def link(self, path: str, target: str) -> None:
        """Stage a symbolic link to ``target``, which is relative to the folder of ``path``."""
        staged = self._prepare(path, target)
        if staged is not None:
            flat = self._folders[path.rpartition("/")[0]]
            os.symlink(relocated_target(path, target) if flat else target, staged)

    def remove(self, path: str) -> None:
        """Stage the removal of a file or link, and of folders that become empty."""
        there = self._prepare_folder(path.rpartition("/")[0], wanted=False)
        before = self._at(path) if there else None
        if before is None:
            raise KeystoreError(f"'{self.root}/{path}' does not exist")
        self._begin_change(path, "remove")
        self._moves.append(Move(path, before, None))

    def _prepare(self, path: str, after: str) -> str | None:
        """Record a change of ``path``, and return the path of its staged file.

        ``after`` is as in `Move`.  Return None in a dry run.
        """
        exists = self._prepare_folder(path.rpartition("/")[0])
        before = self._at(path) if exists else None
        self._begin_change(path, "create" if before is None else "replace")
        if exists:
            self._moves.append(Move(path, before, after))
        if self.dry_run:
            return None
        return f"{self._stage}/{AFTER}/{staged_name(path)}" if exists else f"{self._added}/{path}"

    def _begin_change(self, path: str, action: str) -> None:
        if path in self._staged:
            raise KeystoreError(f"{path} would be written twice")
        self._staged.add(path)
        self.changes.append(Change(action, path))

    def _at(self, path: str) -> str | None:
        """Return the present state of a path, as in `Move.before`."""
        real = f"{self.root}/{path}"
        try:
            mode = os.lstat(real).st_mode
        except FileNotFoundError:
            return None
        if stat.S_ISDIR(mode):
            raise KeystoreError(f"'{real}' is in the way", "It is a folder.", "Move it away.")
        return os.readlink(real) if stat.S_ISLNK(mode) else ""

    def _prepare_folder(self, path: str, *, wanted: bool = True) -> bool:
        """Return whether a folder exists in the keystore; if not and ``wanted``, stage it."""
        if path in self._folders:
            return self._folders[path]
        exists = not self._new_root
        if path:
            exists = self._prepare_folder(path.rpartition("/")[0], wanted=wanted) and is_folder(
                f"{self.root}/{path}"
            )
            if not wanted and not exists:
                return False
            if not exists and not self.dry_run:
                self._stage_folder(path)
        self._folders[path] = exists
        return exists

    def _stage_folder(self, path: str) -> None:
        staged, mode = f"{self._added}/{path}", folder_mode(path)
        os.makedirs(os.path.dirname(staged), 0o700, exist_ok=True)
        with contextlib.suppress(FileExistsError):  # by another worker
            os.mkdir(staged, mode)
        if mode != 0o700:
            os.chmod(staged, mode)

    # ── by forked workers ───────────────────────────────────────────────────────────────

    def mark(self) -> tuple[int, int]:
        """Return a mark of the changes staged so far, for `since`."""
        return len(self.changes), len(self._moves)

    def since(self, mark: tuple[int, int]) -> Staged:
        """Return the changes that were staged after ``mark``."""
        return Staged(tuple(self.changes[mark[0] :]), tuple(self._moves[mark[1] :]))

    def absorb(self, staged: Staged) -> None:
        """Add the changes that a forked worker staged."""
        self._staged.update(change.path for change in staged.changes)
        self.changes += staged.changes
        self._moves += staged.moves

    # ── commit ─────────────────────────────────────────────────────────────────────────────

    def commit(self) -> None:
        """Put all staged changes in place atomically, and flush them to disk.

        Raises:
            KeystoreError: another process has created the keystore meanwhile.
        """
        if self.dry_run or not self.changes:
            return
        if self._new_root:
            filesystem.flush_file_system(self._stage)
            self._appear()
            self._report_commit()
            return
        write_manifest(self._stage, self._moves)
        filesystem.flush_file_system(self._stage)
        _bridge(self.root, self._stage, self._moves)
        point_live(self._stage, AFTER)
        self._undo.clear()
        self._report_commit()
        with contextlib.suppress(OSError, SrosError):  # already committed; `_end` tries again
            recover(self.root)

    def _report_commit(self) -> None:
        _LOG.info("committed %d changes to the keystore '%s'", len(self.changes), self.root)
        if _LOG.isEnabledFor(logging.DEBUG):
            for change in self.changes:
                _LOG.debug("%s %s", change.action, change.path)

    def _appear(self) -> None:
        os.chmod(self._stage, folder_mode(""))
        try:
            os.rename(self._stage, self.root)
        except OSError as error:
            if error.errno in (errno.ENOTEMPTY, errno.EEXIST, errno.ENOTDIR):
                raise KeystoreError(
                    f"keystore '{self.root}' already exists",
                    "Another process has just created it.",
                    "Choose another path.",
                ) from error
            raise
        self._made_parents.clear()
        self._undo.clear()
        with contextlib.suppress(OSError):  # already in place; the system flushes it soon
            filesystem.flush_folder(self.root.parent)


# ── links through the stage ────────────────────────────────────────────────────────────────


def _bridge(root: Path, stage: Path, moves: Sequence[Move]) -> None:
    """Replace each path with a link through ``live`` to its old content, now in ``before``."""
    if not moves:
        return
    os.mkdir(stage / BEFORE, 0o700)
    point_live(stage, BEFORE)
    work = _Bridge(f"{root}", f"{stage}")
    if _can_exchange(stage):
        map_slices(moves, work.by_exchange)
        return
    # A file system that cannot exchange two names: make hard links or copies first.
    if any(copied for _, copied in map_slices(moves, work.keep)):
        filesystem.flush_file_system(stage / BEFORE)
    map_slices(moves, work.by_replacement)


def _can_exchange(stage: Path) -> bool:
    """Return whether the file system can exchange two names, by trying it."""
    spare = f"{stage}/spare"
    os.symlink(BEFORE, spare)  # the same as `live`, so that exchanging them changes nothing
    can = filesystem.exchange(spare, f"{stage}/{LIVE}")
    os.unlink(spare)
    return can


class _Bridge:
    """Two ways to replace paths with links, each for a slice of the moves.

    One is `by_exchange`; the other is `keep`, followed by `by_replacement`.
    """

    def __init__(self, root: str, stage: str) -> None:
        self._root = root
        self._stage = stage

    def by_exchange(self, moves: Sequence[Move]) -> None:
        """Exchange each file with a link created in ``before``."""
        root, before = self._root, f"{self._stage}/{BEFORE}"
        for move in moves:
            if move.before != "":
                self._keep_link(move)
                self._place(move)
                continue
            kept = f"{before}/{staged_name(move.path)}"
            os.symlink(stage_link_target(move.path), kept)
            if not filesystem.exchange(kept, f"{root}/{move.path}"):
                raise OSError(errno.ENOTSUP, os.strerror(errno.ENOTSUP), f"{root}/{move.path}")

    def keep(self, moves: Sequence[Move]) -> bool:
        """Hard-link or copy each old file into ``before``; return whether a file was copied."""
        copied = False
        for move in moves:
            if move.before != "":
                self._keep_link(move)
                continue
            real, kept = (
                f"{self._root}/{move.path}",
                f"{self._stage}/{BEFORE}/{staged_name(move.path)}",
            )
            try:
                os.link(real, kept, follow_symlinks=False)
            except OSError:  # a file system, or an owner, that allows no hard links
                shutil.copy2(real, kept, follow_symlinks=False)
                copied = True
        return copied

    def by_replacement(self, moves: Sequence[Move]) -> None:
        """Replace each file with its link, after `keep`."""
        for move in moves:
            self._place(move)

    def _keep_link(self, move: Move) -> None:
        if move.before:
            kept = f"{self._stage}/{BEFORE}/{staged_name(move.path)}"
            os.symlink(relocated_target(move.path, move.before), kept)

    def _place(self, move: Move) -> None:
        real = f"{self._root}/{move.path}"
        if move.before is None:
            os.symlink(stage_link_target(move.path), real)
            return
        spare = f"{self._stage}/spare.{os.getpid()}"
        os.symlink(stage_link_target(move.path), spare)
        os.replace(spare, real)
