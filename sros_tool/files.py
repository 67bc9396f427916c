"""Atomic and exclusive file writes, safe in folders that others can write; bounded TOML reading."""

from __future__ import annotations

import contextlib
import errno
import fcntl
import os
import secrets
import stat
import tomllib
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path, PurePosixPath
from typing import Any

from sros_tool.errors import DocumentError
from sros_tool.folders import Folder, make_folders, make_temporary_folder, remove_folders, write_all
from sros_tool.terminal import log_step
from sros_tool.wording import capitalized

_MOST_LINKS = 40


@contextlib.contextmanager
def staged_file(
    target: Path,
    data: bytes,
    *,
    mode: int = 0o600,
    ignores_umask: bool = False,
    like: os.stat_result | None = None,
    for_owner: bool = False,
) -> Iterator[Callable[[], None]]:
    """Write a temporary file next to ``target``; yield a function that moves it there atomically.

    The file is flushed to disk before the move.  A symbolic link at ``target`` is replaced, not
    followed.  Temporary files that killed processes of this user left for the same target are
    removed.

    Args:
        target: the path of the file.
        data: the content of the file.
        mode: the permission bits of the file from its first byte on, before the umask.
        ignores_umask: give the file these bits whatever the umask is, because others have to read
            the file.
        like: a file to copy the permission bits and, if permitted, the owner from.
        for_owner: whether a file that root makes belongs to the owner of its folder.

    Raises:
        OSError: the file cannot be written; the earlier file at ``target`` stays.
    """
    with Folder(target.parent, for_owner=for_owner) as folder:
        prefix = f".{target.name[:200]}.sros-"
        _remove_stale(folder, prefix)
        spare, handle = _locked_file(folder, prefix, mode, ignores_umask=ignores_umask)

        def put_in_place() -> None:
            folder.replace(spare, target.name)
            folder.flush()

        try:
            if like:
                with contextlib.suppress(PermissionError):
                    os.fchown(handle, like.st_uid, like.st_gid)
                os.fchmod(handle, stat.S_IMODE(like.st_mode))
            write_all(handle, data)
            os.fsync(handle)
            yield put_in_place
        finally:
            folder.unlink(spare, missing_ok=True)
            os.close(handle)


def _locked_file(folder: Folder, prefix: str, mode: int, *, ignores_umask: bool) -> tuple[str, int]:
    """Create and lock a temporary file; return its name and a descriptor that the caller closes."""
    while True:
        name = f"{prefix}{secrets.token_hex(4)}"
        handle = folder.create(name, mode, ignores_umask=ignores_umask)
        fcntl.flock(handle, fcntl.LOCK_EX)
        if folder.state(name):
            return name, handle
        os.close(handle)  # another process removed it as stale before it was locked


def _remove_stale(folder: Folder, prefix: str) -> None:
    for name in folder.names():
        state = folder.state(name) if name.startswith(prefix) else None
        if not state or not stat.S_ISREG(state.st_mode) or state.st_uid != os.geteuid():
            continue
        with contextlib.suppress(OSError):
            handle = folder.open_private(name)
            try:
                fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
                folder.unlink(name)
            finally:
                os.close(handle)


def write_new_file(
    path: Path, data: bytes, *, for_user: int | None = None, flush: bool = True
) -> None:
    """Write a file that only its owner can read, and flush it to disk unless ``flush`` is False.

    If root writes into a folder of the user ``for_user``, that user becomes the file's owner.

    Raises:
        FileExistsError: ``path`` exists already, perhaps as a link that leads nowhere.
        OSError: the file cannot be written; no part of the file is left.
    """
    with Folder(path.parent) as folder:
        handle = folder.create(path.name, 0o600)
        try:
            if os.geteuid() == 0 and folder.owner[0] == for_user:
                os.fchown(handle, *folder.owner)
            write_all(handle, data)
            if flush:
                os.fsync(handle)
        except BaseException:
            folder.unlink(path.name, missing_ok=True)
            raise
        finally:
            os.close(handle)


@contextlib.contextmanager
def new_files(root: Path, files: Mapping[str, bytes]) -> Iterator[None]:
    """Write new files below the folder ``root``; remove the new files if the ``with`` body fails.

    Even if the process is killed, each file is whole or not there.

    Args:
        root: an existing folder.
        files: the contents by path relative to ``root``; missing folders on the way are made.

    Raises:
        FileExistsError: one of the files exists.
        KeystoreError: a folder on the way is a symbolic link or no folder.
    """
    made: list[str] = []
    with Folder(root) as folder:
        try:
            with _written(folder, root, files) as spare:
                for path in files:
                    _make_parents(folder, path, made)
                    _move_to_new_name(folder, f"{spare}/{path}", path, root)
                    made.append(path)
            folder.flush_file_system()
            yield
        except BaseException:
            for path in reversed(made):
                with contextlib.suppress(OSError):
                    is_folder = stat.S_ISDIR(folder.mode(path))
                    folder.rmdir(path) if is_folder else folder.unlink(path)
            raise


def write_new_folder(path: Path, files: Mapping[str, bytes]) -> None:
    """Make the folder ``path`` with these files, as in `new_files`, whole or not at all.

    Raises:
        OSError: the folder cannot be made, or ``path`` is something other than an empty folder.
    """
    paths = make_folders(path.parent)
    try:
        with Folder(path.parent) as parent, _written(parent, path, files) as spare:
            os.fchmod(parent.handle(spare), 0o755)
            parent.rename(spare, path.name)
    except BaseException:
        remove_folders(paths)
        raise


@contextlib.contextmanager
def _written(parent: Folder, target: Path, files: Mapping[str, bytes]) -> Iterator[str]:
    """Write files into a temporary folder, and flush them to disk; yield the name of the folder.

    The folder is in ``parent``, and is removed at the end if it is still there. ``target`` is the
    place that the files are for.
    """
    spare, folder = make_temporary_folder(parent, f".{target.name[:200]}.sros-")
    try:
        for path, data in files.items():
            try:
                _make_parents(folder, path, [])
                folder.write(path, data, 0o666)
            except OSError as error:
                error.filename = str(target / path)
                raise
        folder.flush_file_system()
        yield spare
    finally:
        folder.close()
        if parent.state(spare):
            parent.remove_tree(spare)


def _move_to_new_name(folder: Folder, source: str, target: str, root: Path) -> None:
    """Give the file ``source`` the name ``target``, which must be free, all below ``root``.

    A hard link never replaces a file that somebody made meanwhile; file systems without hard links
    have no such guarantee.
    """
    try:
        folder.link(source, target)
    except OSError as error:
        if isinstance(error, FileExistsError) or folder.state(target):
            name = str(root / target)
            raise FileExistsError(errno.EEXIST, os.strerror(errno.EEXIST), name) from None
        folder.replace(source, target)


def _make_parents(folder: Folder, path: str, made: list[str]) -> None:
    """Make the missing folders on the way to ``path``, and append them to ``made``."""
    for parent in map(str, reversed(PurePosixPath(path).parents[:-1])):
        if not folder.is_folder(parent):
            folder.mkdir(parent, 0o755)
            made.append(parent)


def remove_file(path: Path) -> None:
    """Remove the file or link at ``path``, if there is one."""
    with Folder(path.parent) as folder:
        folder.unlink(path.name, missing_ok=True)


def replace_file(path: Path, data: bytes) -> None:
    """Atomically replace the content of the file at ``path`` with ``data``, and flush it to disk.

    Other processes read either the old content or the new one.  An existing file of this user keeps
    its mode and its owner; a file of another user keeps them only if nobody else can write to the
    folder.  A symbolic link is followed if it belongs to this user or to root, as ``/dev/stdout``
    does.  Any other link is replaced, because in a folder such as ``/tmp``, another user's link
    could lead the output to any file.  A device or a pipe of this user or of root is written to,
    not replaced.

    Raises:
        OSError: the file cannot be written; the old content stays.
    """
    target, follows_links = _follow_own_links(path)
    state = _file_state(path, follow=follows_links)
    if (
        state
        and follows_links
        and not stat.S_ISREG(state.st_mode)
        and not stat.S_ISDIR(state.st_mode)
    ):
        if (
            stat.S_ISFIFO(state.st_mode)
            and not _is_of_trusted_user(state)
            and _is_shared(target.parent)
        ):
            raise PermissionError(errno.EACCES, "it is a pipe of another user", str(path))
        _write_to(path, state, data)
        return
    keep = state and follows_links and (_is_of_trusted_user(state) or not _is_shared(target.parent))
    with staged_file(target, data, mode=0o666, like=state if keep else None) as put_in_place:
        put_in_place()
    done = "replaced" if state else "wrote"
    log_step("INFO", __name__, "%s '%s', %d bytes", done, target, len(data))


def _write_to(path: Path, state: os.stat_result, data: bytes) -> None:
    """Write to a device or pipe, if ``path`` is still the file that ``state`` describes."""
    handle = os.open(path, os.O_WRONLY | os.O_NOCTTY | os.O_CLOEXEC)
    try:
        if not os.path.samestat(os.fstat(handle), state):
            raise OSError(errno.ESTALE, "it was replaced by another file meanwhile", str(path))
        write_all(handle, data)
    finally:
        os.close(handle)


def _follow_own_links(path: Path) -> tuple[Path, bool]:
    """Follow links of this user or root; return the path reached, and whether it is not a link.

    A link of another user is not followed.
    """
    for _ in range(_MOST_LINKS):
        state = _file_state(path, follow=False)
        if not state or not stat.S_ISLNK(state.st_mode):
            return path, True
        if not _is_of_trusted_user(state):
            return path, False
        path = path.parent / path.readlink()
    raise OSError(errno.ELOOP, os.strerror(errno.ELOOP), str(path))


def _file_state(path: Path, *, follow: bool) -> os.stat_result | None:
    try:
        return path.stat(follow_symlinks=follow)
    except FileNotFoundError:
        return None


def _is_of_trusted_user(state: os.stat_result) -> bool:
    return state.st_uid in (0, os.geteuid())


def _is_shared(folder: Path) -> bool:
    """Return whether other users can make files in a folder, as in ``/tmp``."""
    return bool(folder.stat().st_mode & (stat.S_IWGRP | stat.S_IWOTH))


_LONGEST_LINE = 4000  # characters: the parser takes quadratic time for a key with many dots
_LONGEST_DOCUMENT = 256 * 1024  # characters


def read_toml(data: bytes, name: str, remedy: str = "", *, longest: int = _LONGEST_DOCUMENT) -> Any:
    """Return the tables of a TOML document in a file; ``name`` names the file in errors.

    Raises:
        DocumentError: the file is not TOML in UTF-8, too long, or nested too deeply.
    """
    try:
        return parse_toml(data.decode(), longest)
    except (UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise toml_error(error, name, remedy) from error


def toml_error(error: ValueError, name: str, remedy: str = "") -> DocumentError:
    """Return the error for a file, named ``name``, that the parser of TOML refused."""
    why = str(error)
    return DocumentError(f"{name} is not valid TOML", f"{capitalized(why)}.", remedy)


def parse_toml(text: str, longest: int = _LONGEST_DOCUMENT) -> dict[str, Any]:
    """Return the tables of a TOML document of at most ``longest`` characters (256 Ki).

    Raises:
        tomllib.TOMLDecodeError: the document is not TOML, too long, or nested too deeply.
    """
    if len(text) > longest:
        raise tomllib.TOMLDecodeError(f"it is longer than {longest // 1024} KiB")
    for number, line in enumerate(text.split("\n"), 1):
        if len(line) > _LONGEST_LINE:
            raise tomllib.TOMLDecodeError(
                f"line {number} is longer than {_LONGEST_LINE} characters"
            )
    try:
        return tomllib.loads(text)
    except tomllib.TOMLDecodeError:
        raise
    except RecursionError as error:
        raise tomllib.TOMLDecodeError("it is nested too deeply") from error
    except ValueError as error:  # such as a number with thousands of digits, or an impossible date
        raise tomllib.TOMLDecodeError(str(error)) from error


# ── files that ship with sros ─────────────────────────────────────────────────────────────────


_PACKAGE = Path(__file__).resolve().parent


def _shipped_folder(name: str) -> Path:
    inside = _PACKAGE / name
    return inside if inside.is_dir() else _PACKAGE.parent / name


def policies_dir() -> Path:
    """Return the folder of the example policies and the common files that they include."""
    return _shipped_folder("policies")


def templates_dir() -> Path:
    """Return the folder of the keystore templates, one TOML file each."""
    return _shipped_folder("keystore_templates")


def unpacked_dds_dir() -> Path:
    """Return the folder of a source checkout into which ``./dev`` unpacks Cyclone DDS."""
    return _PACKAGE.parent / ".dds"
