"""All writes to a keystore: staged, flushed to disk once, and put in place as a whole.

New files are written below ``.sros-transaction/new`` of the keystore.  Files that already exist
change together at a single moment: each is first replaced by a link to
``.sros-transaction/live/...`` (still its old content), then ``live`` itself, a link, is turned
from ``old`` to ``new``.  That turn is the commit.  Afterwards the links give way to the plain
files, and new folders are moved in.  Whatever the moment at which the machine stops, DDS finds
either all the old files or all the new ones, and the next transaction tidies up.
"""

from __future__ import annotations

import contextlib
import ctypes
import errno
import fcntl
import glob
import os
import secrets
import shutil
import stat
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Self

from sros_tool.errors import KeystoreError
from sros_tool.keystore.layout import ENCLAVES, folder_mode

STAGE = ".sros-transaction"
_REMOVED = "removed"
_LOCK_SECONDS = 60.0


@dataclass(frozen=True, slots=True)
class Change:
    """One file that a transaction creates or replaces; ``path`` is relative to the keystore."""

    action: str
    path: str


class Transaction:
    """A lock on a keystore and the files that will change in it.

    Use as a context manager; without `commit` nothing changes.  If ``fresh``, the keystore must
    not exist yet (an empty folder may) and appears at once; otherwise it must exist.  With
    ``dry_run`` nothing is written, and `changes` tells what would be.
    """

    def __init__(self, root: Path, *, fresh: bool = False, dry_run: bool = False) -> None:
        self.root = root
        self.changes: list[Change] = []
        self.dry_run = dry_run
        self._new_root = fresh and not root.exists()
        self._made_parents: list[Path] = []
        self._lock = -1
        self._stage = root / STAGE
        self._content = self._stage / "new"
        self._staged: set[str] = set()
        self._folders: dict[str, bool] = {}  # whether the folder is there already
        self._undo: list[Callable[[], None]] = []
        self._removed: list[str] = []

    def on_failure(self, undo: Callable[[], None]) -> None:
        """Have ``undo`` called at the end, unless everything was put in place."""
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
            return
        self._lock = _lock(self.root)
        recover(self.root)
        self._stage.mkdir(mode=0o700)
        self._content.mkdir(mode=0o700)

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
            with contextlib.suppress(FileExistsError):  # another process was faster
                each.mkdir()
                self._made_parents.insert(0, each)

    def _make_sibling(self) -> None:
        while self._lock < 0:
            self._stage = self.root.parent / f".{self.root.name}.sros-{secrets.token_hex(4)}"
            self._content = self._stage
            self._stage.mkdir(mode=0o700)
            # Until it is locked, another process may take it for a stale one and remove it.
            with contextlib.suppress(FileNotFoundError):
                lock = _lock(self._stage)
                if self._stage.exists():
                    self._lock = lock
                else:
                    os.close(lock)

    def _remove_stale_siblings(self) -> None:
        for stale in self.root.parent.glob(f".{glob.escape(self.root.name)}.sros-*"):
            with contextlib.suppress(KeystoreError, OSError):
                lock = _lock(stale, wait=0.0)
                shutil.rmtree(stale, ignore_errors=True)
                os.close(lock)

    # ── what is to change ──────────────────────────────────────────────────────────────────

    def write(self, path: str, data: bytes, *, private: bool = False) -> None:
        """Stage a file; ``private`` ones are readable by their owner only, from the first byte."""
        staged = self._prepare(path)
        if staged is None:
            return
        mode = 0o600 if private else 0o644
        handle = os.open(staged, os.O_WRONLY | os.O_CREAT | os.O_EXCL, mode)
        try:
            view = memoryview(data)
            while view:
                view = view[os.write(handle, view) :]
        except OSError as error:
            error.filename = str(self.root / path)
            raise
        finally:
            os.close(handle)

    def link(self, path: str, target: str) -> None:
        """Stage a symbolic link to ``target``, which is relative to the folder of ``path``."""
        staged = self._prepare(path)
        if staged is not None:
            os.symlink(target, staged)

    def remove(self, path: str) -> None:
        """Have a file or link go, together with the changes of the transaction.

        Folders of which nothing is left go too.
        """
        if not self._is_folder(path.rpartition("/")[0]) or not os.path.lexists(self.root / path):
            raise KeystoreError(f"'{self.root / path}' does not exist")
        self._removed.append(path)
        self.changes.append(Change("remove", path))

    def _prepare(self, path: str) -> str | None:
        if path in self._staged:
            raise KeystoreError(f"{path} would be written twice")
        self._staged.add(path)
        existed = self._prepare_folder(path.rpartition("/")[0]) and os.path.lexists(
            os.path.join(self.root, path)
        )
        self.changes.append(Change("replace" if existed else "create", path))
        return None if self.dry_run else f"{self._content}/{path}"

    def _prepare_folder(self, path: str) -> bool:
        """Stage a folder; tell whether it is in the keystore already."""
        if path in self._folders:
            return self._folders[path]
        exists = not self._new_root
        if path:
            exists = self._prepare_folder(path.rpartition("/")[0]) and self._is_folder(path)
            if not self.dry_run:
                staged, mode = f"{self._content}/{path}", folder_mode(path)
                with contextlib.suppress(FileExistsError):  # by a process with another share
                    os.mkdir(staged, mode)
                if mode != 0o700:
                    os.chmod(staged, mode)
        self._folders[path] = exists
        return exists

    def _is_folder(self, path: str) -> bool:
        real = os.path.join(self.root, path)
        try:
            mode = os.lstat(real).st_mode
        except FileNotFoundError:
            return False
        if stat.S_ISLNK(mode):
            raise _is_a_link(real)
        if not stat.S_ISDIR(mode):
            raise KeystoreError(f"'{real}' is in the way", "It is not a folder.")
        return True

    def absorb(self, changes: Sequence[Change]) -> None:
        """Take over what a forked process staged for this transaction."""
        for change in changes:
            self._staged.add(change.path)
            self._prepare_folder(change.path.rpartition("/")[0])
        self.changes += changes

    # ── commit ─────────────────────────────────────────────────────────────────────────────

    def commit(self) -> None:
        """Put everything in place; after this it is on the disk."""
        if self.dry_run or not self.changes:
            return
        if self._removed:
            (self._stage / _REMOVED).write_text("\0".join(self._removed), encoding="utf-8")
        _flush_file_system(self._stage)
        if self._new_root:
            self._appear()
        else:
            self._bridge()
            _turn(self._stage, "new")
            self._undo.clear()
            with contextlib.suppress(OSError):  # it is done; the end tries to tidy up once more
                recover(self.root)

    def _appear(self) -> None:
        os.chmod(self._stage, folder_mode(""))
        try:
            os.rename(self._stage, self.root)
        except OSError as error:
            if error.errno in (errno.ENOTEMPTY, errno.EEXIST, errno.ENOTDIR):
                raise KeystoreError(
                    f"keystore '{self.root}' already exists", "Another process just made it."
                ) from error
            raise
        self._made_parents.clear()
        self._undo.clear()
        with contextlib.suppress(OSError):  # it is there; the system writes it down in time anyway
            _flush_folder(self.root.parent)

    def _bridge(self) -> None:
        """Let every file that is to change be reached through ``live``, still with old content."""
        plain = [
            path for path in self._in_existing_folders() if not (self.root / path).is_symlink()
        ]
        if not plain:
            return
        old = self._stage / "old"
        old.mkdir(mode=0o700)
        _turn(self._stage, "old")
        copied = False
        for path in plain:
            target, kept = self.root / path, old / path
            if target.exists():
                kept.parent.mkdir(parents=True, exist_ok=True)
                try:
                    os.link(target, kept)
                except OSError:  # a file system, or an owner, that allows no hard links
                    shutil.copy2(target, kept)
                    copied = True
        if copied:
            _flush_file_system(old)
        spare = self._stage / "spare"
        for path in plain:
            os.symlink("../" * path.count("/") + f"{STAGE}/live/{path}", spare)
            os.replace(spare, self.root / path)

    def _in_existing_folders(self) -> Iterator[str]:
        staged = (path for path in self._staged if self._folders[path.rpartition("/")[0]])
        return iter(sorted([*staged, *self._removed]))


def _is_a_link(path: str | Path) -> KeystoreError:
    return KeystoreError(
        f"'{path}' is a symbolic link",
        "What is written below it would land elsewhere, outside of the keystore.",
        "Put a real folder in its place.",
    )


def tidy(root: Path) -> None:
    """Complete or undo what an interrupted transaction left behind, if there is anything."""
    if (root / STAGE).is_dir():
        lock = _lock(root)
        try:
            recover(root)
        finally:
            os.close(lock)


def recover(root: Path) -> None:
    """As `tidy`, for a caller that holds the lock."""
    stage = root / STAGE
    if not stage.is_dir():
        return
    live = stage / "live"
    committed = live.is_symlink() and os.readlink(live) == "new"
    if committed:
        _settle_links(stage / "new", root)
        _settle(stage / "new", root)
        _remove(stage / _REMOVED, root)
        _flush_folder(root)
    else:
        for path in _files_below(stage / "old"):
            if _leads_into_stage(root / path):
                os.replace(stage / "old" / path, root / path)
        for path in _files_below(stage / "new"):
            if _leads_into_stage(root / path):
                os.unlink(root / path)
    with contextlib.suppress(FileNotFoundError):
        os.unlink(live)  # first, for without it what is left of the stage is only to be removed
    shutil.rmtree(stage)


def _settle_links(source: Path, target: Path) -> None:
    """Move the links that belong into folders which are there.

    They come first, for a link that is still reached through ``live`` leads to nothing as soon as
    the file that it names has left the stage.
    """
    with os.scandir(source) as entries:
        for entry in entries:
            if entry.is_symlink():
                os.replace(entry.path, target / entry.name)
            elif entry.is_dir() and (target / entry.name).is_dir():
                _settle_links(Path(entry.path), target / entry.name)


def _settle(source: Path, target: Path) -> None:
    """Move everything below ``source`` to its place below ``target``.

    The enclaves come last: without them, a new keystore that is not complete yet is none.
    """
    with os.scandir(source) as entries:
        for entry in sorted(entries, key=lambda each: each.name == ENCLAVES):
            place = target / entry.name
            if not entry.is_dir(follow_symlinks=False):
                os.replace(entry.path, place)
            elif place.is_symlink():
                raise _is_a_link(place)
            elif os.path.lexists(place):
                _settle(Path(entry.path), place)
            else:
                os.rename(entry.path, place)


def _remove(names: Path, root: Path) -> None:
    """Remove what a file lists, and the folders that are empty then."""
    if not names.exists():
        return
    for name in names.read_text(encoding="utf-8").split("\0"):
        with contextlib.suppress(FileNotFoundError):
            os.unlink(root / name)
        folder = name.rpartition("/")[0]
        with contextlib.suppress(OSError):  # it is not empty
            while "/" in folder:
                with contextlib.suppress(FileNotFoundError):  # by whoever was stopped here
                    os.rmdir(root / folder)
                folder = folder.rpartition("/")[0]


def _turn(stage: Path, to: str) -> None:
    spare = stage / "live.next"
    os.symlink(to, spare)
    os.replace(spare, stage / "live")


def _files_below(folder: Path) -> Iterator[str]:
    for parent, _, files in os.walk(folder):
        for file in files:
            yield os.path.relpath(os.path.join(parent, file), folder)


def _leads_into_stage(path: Path) -> bool:
    return path.is_symlink() and f"{STAGE}/live/" in os.readlink(path)


def _lock(folder: Path, wait: float = _LOCK_SECONDS) -> int:
    """An exclusive lock on a folder itself, so that no lock file is left behind."""
    handle = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    deadline = time.monotonic() + wait
    while True:
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
            return handle
        except BlockingIOError:
            if time.monotonic() >= deadline:
                os.close(handle)
                raise KeystoreError(
                    f"keystore '{folder}' is busy",
                    f"Another process has been writing to it for {_LOCK_SECONDS:.0f} seconds.",
                    "Try again when it is done.",
                ) from None
            time.sleep(0.02)


def _flush_file_system(folder: Path) -> None:
    """One flush for all files of a transaction: one for each would cost more than all else."""
    handle = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        libc = ctypes.CDLL(None, use_errno=True)
        if libc.syncfs(handle) != 0:
            number = ctypes.get_errno()
            raise OSError(number, os.strerror(number), str(folder))
    except AttributeError:  # a C library without syncfs
        os.sync()
    finally:
        os.close(handle)


def _flush_folder(folder: Path) -> None:
    handle = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
