"""File operations below an open folder that follow no symbolic link.

A folder that others wrote, or can write, is hostile input: a link in it could lead a program of
root to any other file.  `Folder` opens one part of a path at a time, relative to the part before
it (openat(2) with O_NOFOLLOW), so that neither a link that is there nor one that appears meanwhile
leads out of the folder.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import os
import re
import secrets
import stat
import sys
from collections.abc import Iterable, Iterator
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, BinaryIO, Self

from sros_tool.errors import KeystoreError

if TYPE_CHECKING:
    import ctypes

_FOLDER_FLAGS = os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC
_NEW_FILE_FLAGS = os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW | os.O_CLOEXEC
_OLD_FILE_FLAGS = os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC
_MOST_OPEN = 64
_MOST_BYTES = 128 * 1024 * 1024
_RENAME_EXCHANGE = 2
_SIMPLE_LINK = re.compile(r"(?:\.\./)*(?:[^/.][^/]*/)*[^/.][^/]*")
"""Targets of links whose leading ``..`` can be resolved as text, without following other links."""
_NOT_SUPPORTED = (errno.EINVAL, errno.ENOSYS, errno.ENOTSUP)


class Folder:
    """An open folder; its methods take paths relative to it, with "/" between their parts.

    Use it as a context manager, or `close` it.  A path is never absolute and has no part ``..``.
    Every method raises `KeystoreError` if a folder on the way is a symbolic link or no folder, and
    OSError, with the whole path, where the system refuses the operation.
    """

    def __init__(self, path: Path, *, for_owner: bool = False) -> None:
        """Open the folder at ``path``, which may itself be a symbolic link: the user named it.

        With ``for_owner``, files that root makes in the folder belong to the owner of the folder.
        """
        self.path = path
        self._handles = {"": os.open(path, _FOLDER_FLAGS)}
        state = os.fstat(self._handles[""])
        self._owner = (state.st_uid, state.st_gid)
        self._hand_over = for_owner and os.geteuid() == 0 and self._owner != (0, os.getegid())

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_error: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the folder; it cannot be used afterwards."""
        self.forget()
        with contextlib.suppress(KeyError):
            os.close(self._handles.pop(""))

    @property
    def owner(self) -> tuple[int, int]:
        """The user id and the group id of the folder."""
        return self._owner

    def forget(self, folder: str = "") -> None:
        """Close cached descriptors of ``folder`` and its subfolders, whose paths have changed.

        "" stands for all folders below this one.
        """
        below = f"{folder}/" if folder else ""
        for path in [path for path in self._handles if path and f"{path}/".startswith(below)]:
            os.close(self._handles.pop(path))

    # ── looking ────────────────────────────────────────────────────────────────────────────

    def state(self, path: str) -> os.stat_result | None:
        """Return the lstat(2) of ``path`` (a link is not followed); None if nothing is there."""
        try:
            parent, name = self._folder_and_name(path)
            return os.stat(name, dir_fd=parent, follow_symlinks=False)
        except FileNotFoundError:
            return None

    def mode(self, path: str) -> int:
        """Return the st_mode of ``path`` (file type and permission bits); 0 if nothing is there."""
        state = self.state(path)
        return state.st_mode if state else 0

    def is_folder(self, path: str) -> bool:
        """Return whether a folder is at ``path``.

        Raises:
            KeystoreError: ``path`` is a file or a symbolic link.
        """
        state = self.state(path)
        if state is not None and not stat.S_ISDIR(state.st_mode):
            raise self._blocked_path_error(path, link=stat.S_ISLNK(state.st_mode))
        return state is not None

    def link_target(self, path: str) -> str | None:
        """Return the target text of the link at ``path``; None if there is no link."""
        try:
            parent, name = self._folder_and_name(path)
            return os.readlink(name, dir_fd=parent)
        except OSError as error:
            if error.errno in (errno.EINVAL, errno.ENOENT):
                return None
            raise

    def names(self, path: str = "") -> list[str]:
        """Return the sorted names in the folder at ``path``."""
        return sorted(os.listdir(self.handle(path)))

    def links(self, path: str) -> list[str]:
        """Return the names of the symbolic links in the folder at ``path``."""
        with os.scandir(self.handle(path)) as entries:
            return [entry.name for entry in entries if entry.is_symlink()]

    def read(self, path: str, *, max_bytes: int = _MOST_BYTES) -> bytes:
        """Return the content of the regular file at ``path``, of at most ``max_bytes`` bytes."""
        with self._adding_path_to_errors(path), self.open(path) as file:
            state = os.fstat(file.fileno())
            if not stat.S_ISREG(state.st_mode):
                raise OSError(errno.EINVAL, "it is not a regular file", str(self.path / path))
            if state.st_size > max_bytes:
                raise OSError(errno.EFBIG, os.strerror(errno.EFBIG), str(self.path / path))
            return file.read(state.st_size)

    def open(self, path: str) -> BinaryIO:
        """Open ``path`` for reading, whatever its file type; return the file object."""
        parent, name = self._folder_and_name(path)
        with self._adding_path_to_errors(path):
            return open(os.open(name, _OLD_FILE_FLAGS, dir_fd=parent), "rb")

    def read_inside(self, path: str) -> bytes:
        """Return the content of a file, as `read` does, also through links that stay in the folder.

        Raises:
            KeystoreError: a link leads out of the folder.
        """
        try:  # a faster way for a file, or for a simple link to a file
            target = self.link_target(path)
            if target is None:
                return self.read(path)
            if _SIMPLE_LINK.fullmatch(target):
                parent = path.rpartition("/")[0]
                return self.read(os.path.normpath(f"{parent}/{target}" if parent else target))
        except (OSError, ValueError, KeystoreError) as error:
            if isinstance(error, FileNotFoundError) and not os.path.lexists(self.path / path):
                raise
        real, top = (os.path.realpath(folder_path) for folder_path in (self.path / path, self.path))
        if not Path(real).is_relative_to(top):
            raise KeystoreError(
                f"'{self.path / path}' is a link out of '{self.path}'",
                f"It leads to '{real}'.",
                "Replace the link with the file itself.",
            )
        return self.read(os.path.relpath(real, top))

    # ── making ─────────────────────────────────────────────────────────────────────────────

    def create(self, path: str, mode: int, *, ignores_umask: bool = False) -> int:
        """Make the new file ``path``; ``mode`` has its permission bits.

        Args:
            path: the path in this folder.
            mode: the permission bits.
            ignores_umask: give the file these bits whatever the umask is, because others have to
                read it.

        Returns:
            A descriptor for writing, which the caller closes.
        """
        parent, name = self._folder_and_name(path)
        with self._adding_path_to_errors(path):
            handle = os.open(name, _NEW_FILE_FLAGS, mode, dir_fd=parent)
            if ignores_umask:
                os.fchmod(handle, mode)
            if self._hand_over:
                os.fchown(handle, *self._owner)
        return handle

    def write(self, path: str, data: bytes, mode: int, *, ignores_umask: bool = False) -> None:
        """Write the new file ``path``, with permission bits as in `create`."""
        self.write_parts(path, (data,), mode, ignores_umask=ignores_umask)

    def write_parts(
        self, path: str, parts: Iterable[bytes], mode: int, *, ignores_umask: bool = False
    ) -> None:
        """Write the new file ``path`` part by part, with permission bits as in `create`."""
        handle = self.create(path, mode, ignores_umask=ignores_umask)
        try:
            for part in parts:
                with self._adding_path_to_errors(path):
                    write_all(handle, part)
        finally:
            os.close(handle)

    def open_private(self, path: str) -> int:
        """Open the file ``path``, and make it if it is missing; only its owner can open it.

        Returns:
            A descriptor, which the caller closes.
        """
        try:
            return self.create(path, 0o600)
        except FileExistsError:
            parent, name = self._folder_and_name(path)
            with self._adding_path_to_errors(path):
                return os.open(name, _OLD_FILE_FLAGS, dir_fd=parent)

    def symlink(self, target: str, path: str) -> None:
        """Make the symbolic link ``path`` with the text ``target``."""
        parent, name = self._folder_and_name(path)
        with self._adding_path_to_errors(path):
            os.symlink(target, name, dir_fd=parent)
            if self._hand_over:
                # By a handle, because the owner of the folder could replace the link meanwhile.
                handle = os.open(name, os.O_PATH | os.O_NOFOLLOW | os.O_CLOEXEC, dir_fd=parent)
                try:
                    if stat.S_ISLNK(os.fstat(handle).st_mode):
                        os.chown(f"/proc/self/fd/{handle}", *self._owner)
                finally:
                    os.close(handle)

    def close_to_others(self, path: str) -> None:
        """Remove all permissions of group and others from a file or folder (chmod go=).

        A file with another owner than this folder, or with another hard link, stays unchanged: the
        link may be outside of this folder.
        """
        parent, name = self._folder_and_name(path)
        with self._adding_path_to_errors(path):
            handle = os.open(name, _OLD_FILE_FLAGS, dir_fd=parent)
            try:
                state = os.fstat(handle)
                if state.st_uid == self._owner[0] and _has_one_name(state):
                    os.fchmod(handle, stat.S_IMODE(state.st_mode) & 0o700)
            finally:
                os.close(handle)

    def mkdir(self, path: str, mode: int) -> None:
        """Make the folder ``path``; its permission bits are ``mode`` whatever the umask is."""
        parent, name = self._folder_and_name(path)
        with self._adding_path_to_errors(path):
            os.mkdir(name, 0o700, dir_fd=parent)
        if mode != 0o700 or self._hand_over:
            handle = self.handle(path)
            if self._hand_over:
                os.fchown(handle, *self._owner)
            os.fchmod(handle, mode)

    def copy(self, source: str, target: str) -> None:
        """Copy the regular file ``source`` with its permission bits and times to a new file."""
        parent, name = self._folder_and_name(source)
        old = os.stat(name, dir_fd=parent, follow_symlinks=False)
        self.write(target, self.read(source), stat.S_IMODE(old.st_mode) & 0o777)
        parent, name = self._folder_and_name(target)
        os.utime(name, ns=(old.st_atime_ns, old.st_mtime_ns), dir_fd=parent, follow_symlinks=False)

    def set_time(self, path: str, seconds: int) -> None:
        """Set the modification time of a file, in seconds since 1970; a full disk allows this."""
        parent, name = self._folder_and_name(path)
        os.utime(name, (seconds, seconds), dir_fd=parent, follow_symlinks=False)

    # ── moving and removing ────────────────────────────────────────────────────────────────

    def replace(self, source: str, target: str) -> None:
        """Rename ``source`` to ``target``; replace an existing file or link."""
        source_handle, name, target_handle, new = self._two_folders_and_names(source, target)
        with self._adding_path_to_errors(target):
            os.replace(name, new, src_dir_fd=source_handle, dst_dir_fd=target_handle)

    def rename(self, source: str, target: str) -> None:
        """Rename the folder ``source`` to ``target``, which is missing or an empty folder."""
        source_handle, name, target_handle, new = self._two_folders_and_names(source, target)
        with self._adding_path_to_errors(target):
            os.rename(name, new, src_dir_fd=source_handle, dst_dir_fd=target_handle)
        self.forget(source)

    def link(self, source: str, target: str) -> None:
        """Make ``target`` a second name (a hard link) of the file ``source``."""
        source_handle, name, target_handle, new = self._two_folders_and_names(source, target)
        with self._adding_path_to_errors(target):
            os.link(
                name, new, src_dir_fd=source_handle, dst_dir_fd=target_handle, follow_symlinks=False
            )

    def exchange(self, first: str, second: str) -> bool:
        """Atomically exchange two names (renameat2(2)).

        Return False, without a change, if the kernel, the C library or the file system does not
        support it.
        """
        return exchange(*self._two_folders_and_names(first, second))

    def unlink(self, path: str, *, missing_ok: bool = False) -> None:
        """Remove the file or link at ``path``."""
        with contextlib.ExitStack() as stack:
            if missing_ok:
                stack.enter_context(contextlib.suppress(FileNotFoundError))
            parent, name = self._folder_and_name(path)
            with self._adding_path_to_errors(path):
                os.unlink(name, dir_fd=parent)

    def rmdir(self, path: str) -> None:
        """Remove the empty folder at ``path``."""
        if path in self._handles:
            self.forget()
        parent, name = self._folder_and_name(path)
        with self._adding_path_to_errors(path):
            os.rmdir(name, dir_fd=parent)

    def remove_tree(self, path: str) -> None:
        """Remove the folder at ``path`` with everything in it; links in it are not followed."""
        import shutil

        self.forget()
        parent, name = self._folder_and_name(path)
        shutil.rmtree(name, dir_fd=parent)

    # ── the disk ───────────────────────────────────────────────────────────────────────────

    def flush(self, path: str = "") -> None:
        """Flush the directory entries of ``path`` to disk, not the contents of its files."""
        os.fsync(self.handle(path))

    def flush_file_system(self, path: str = "") -> None:
        """Flush the file system of ``path`` (syncfs(2)), cheaper than fsync(2) of many files."""
        flush_file_system(self.handle(path))

    # ── the way to a path ──────────────────────────────────────────────────────────────────

    def handle(self, path: str) -> int:
        """Return the descriptor of the folder at ``path``, which this object closes."""
        handle = self._handles.get(path)
        if handle is not None:
            return handle
        parent, name = self._find(path)
        try:
            handle = os.open(name, _FOLDER_FLAGS | os.O_NOFOLLOW, dir_fd=parent)
        except OSError as error:
            if error.errno in (errno.ELOOP, errno.ENOTDIR):
                link = self.link_target(path) is not None
                raise self._blocked_path_error(path, link=link) from error
            error.filename = str(self.path / path)
            raise
        self._handles[path] = handle
        return handle

    def _folder_and_name(self, path: str) -> tuple[int, str]:
        """Return the descriptor of the folder that ``path`` is in, and its last part."""
        if len(self._handles) > _MOST_OPEN:
            self.forget()
        return self._find(path)

    def _two_folders_and_names(
        self, first_path: str, second_path: str
    ) -> tuple[int, str, int, str]:
        """Return `_folder_and_name` of two paths, whose folders stay open together."""
        return (*self._folder_and_name(first_path), *self._find(second_path))

    def _find(self, path: str) -> tuple[int, str]:
        folder, _, name = path.rpartition("/")
        if name in ("", ".", ".."):
            raise ValueError(f"{path!r} is not a path below a folder")
        return self.handle(folder), name

    @contextlib.contextmanager
    def _adding_path_to_errors(self, path: str) -> Iterator[None]:
        """Add the full path to an OSError that the body raises."""
        try:
            yield
        except OSError as error:
            error.filename, error.filename2 = str(self.path / path), None
            raise

    def _blocked_path_error(self, path: str, *, link: bool) -> KeystoreError:
        full_path = self.path / path
        if link:
            return KeystoreError(
                f"'{full_path}' is a symbolic link",
                f"Files written below it would be stored elsewhere, outside of '{self.path}'.",
                "Replace the link with a real folder.",
            )
        return KeystoreError(f"'{full_path}' is in the way", "It is not a folder.", "Move it away.")


def _has_one_name(state: os.stat_result) -> bool:
    return stat.S_ISDIR(state.st_mode) or (stat.S_ISREG(state.st_mode) and state.st_nlink == 1)


def make_folders(path: Path, mode: int | None = None) -> list[Path]:
    """Make the folder at ``path`` and its parents; return the folders that were made, inner first.

    Args:
        path: the path of the folder.
        mode: the permission bits of the folders that are made, whatever the umask is; None for the
            bits that the umask leaves.

    Raises:
        OSError: a folder cannot be made; the folders that were made before are removed.
    """
    paths: list[Path] = []
    missing = [folder for folder in (path, *path.parents) if not folder.exists()]
    try:
        for folder in reversed(missing):
            with contextlib.suppress(FileExistsError):  # another process created it meanwhile
                if mode is None:
                    folder.mkdir()
                else:
                    with Folder(folder.parent) as parent:
                        parent.mkdir(folder.name, mode)
                paths.insert(0, folder)
    except BaseException:
        remove_folders(paths)
        raise
    return paths


def remove_folders(paths: list[Path]) -> None:
    """Remove the folders in ``paths`` that are empty, in the given order."""
    for path in paths:
        with contextlib.suppress(OSError):
            path.rmdir()


def make_temporary_folder(parent: Folder, prefix: str) -> tuple[str, Folder]:
    """Make and lock a temporary folder in ``parent``, which only this user can open.

    Temporary folders that killed processes of this user left with the same prefix are removed.

    Returns:
        The name of the folder, and the open folder: until it is closed, no process removes it.
    """
    for name in parent.names():
        state = parent.state(name) if name.startswith(prefix) else None
        if not state or not stat.S_ISDIR(state.st_mode) or state.st_uid != os.geteuid():
            continue
        with contextlib.suppress(KeystoreError, OSError), Folder(parent.path / name) as stale:
            if try_lock(stale.handle("")):
                parent.remove_tree(name)
    while True:
        name = f"{prefix}{secrets.token_hex(4)}"
        parent.mkdir(name, 0o700)
        # Until the folder is locked, another process may consider it stale and remove it.
        with contextlib.suppress(FileNotFoundError):
            folder = Folder(parent.path / name)
            try:
                locked = try_lock(handle := folder.handle(""))
            except BaseException:
                folder.close()
                parent.rmdir(name)
                raise
            state = parent.state(name)
            if locked and state and os.path.samestat(state, os.fstat(handle)):
                return name, folder
            folder.close()


def try_lock(handle: int) -> bool:
    """Lock an open file or folder; False if another process has locked it.

    Raises:
        KeystoreError: the file system has no locks.
    """
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError as error:
        if error.errno not in (errno.ENOLCK, *_NOT_SUPPORTED):
            raise
        raise KeystoreError(
            f"'{Path(f'/proc/self/fd/{handle}').readlink()}' cannot be locked: {error.strerror}",
            "Without locks, two runs of sros at the same time would damage each other's files.",
            "Use a folder on a local disk, or a network file system with locks.",
        ) from error
    return True


def write_all(handle: int, data: bytes) -> None:
    """Write all of ``data`` to a descriptor."""
    view = memoryview(data)
    while view:
        view = view[os.write(handle, view) :]


def exchange(first_folder: int, first: str, second_folder: int, second: str) -> bool:
    """Exchange two names in two open folders, as `Folder.exchange`; False if this is impossible."""
    try:
        rename = _c_library().renameat2
    except AttributeError:
        return False
    sys.audit("os.rename", first, second, first_folder, second_folder)
    names = os.fsencode(first), os.fsencode(second)
    if rename(first_folder, names[0], second_folder, names[1], _RENAME_EXCHANGE) == 0:
        return True
    number = _last_errno()
    if number in _NOT_SUPPORTED:
        return False
    raise OSError(number, os.strerror(number), first, None, second)


def flush_file_system(handle: int) -> None:
    """Flush the file system that an open folder is on."""
    try:
        if _c_library().syncfs(handle) != 0:
            number = _last_errno()
            raise OSError(number, os.strerror(number))
    except AttributeError:  # a C library without syncfs
        os.sync()


@lru_cache(maxsize=1)
def _c_library() -> ctypes.CDLL:
    import ctypes  # not needed by programs that only read

    return ctypes.CDLL(None, use_errno=True)


def _last_errno() -> int:
    """Return the errno of this thread's last C library call."""
    import ctypes

    return ctypes.get_errno()
