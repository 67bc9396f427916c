"""The folder of a robot's enclaves: read as hostile input, changed wholly or not at all."""

from __future__ import annotations

import contextlib
import fcntl
import json
import os
import pwd
import shutil
import stat
import time
from typing import Callable, Iterator

from ansible_collections.sros.fleet.plugins.module_utils.exports import (
    KEY_FILE,
    MOST_FILES,
    MOST_OF_FILE,
    MOST_UNPACKED,
    Files,
    RefusedError,
    check_enclave,
    enclaves_in,
    is_enclave_path,
    trust_digest,
)

_FOLDER = os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW | os.O_CLOEXEC
_FILE = os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC
_NEW_FILE = os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW | os.O_CLOEXEC
_OF_OTHERS = stat.S_IWGRP | stat.S_IWOTH
_MOST_LINKS = 40
_AGENT, _AGENT_STATE = ".agent", "state.json"
_BOOT_ID = "/proc/sys/kernel/random/boot_id"
_LONGEST_WAIT = 60.0


class _Record:
    """A list of texts in a file next to the folder, such as ``.keystore.sros-restart``."""

    def __init__(self, path: str, check: Callable[[str], str]) -> None:
        """Take the path of the file, and a function that raises for a text that is not valid."""
        self._path = path
        self._check = check

    def read(self) -> list[str]:
        """Return the texts, sorted; none without the file.

        Raises:
            RefusedError: the file cannot be read.
        """
        try:
            with os.fdopen(os.open(self._path, _FILE), "rb") as file:
                texts = json.loads(file.read(MOST_OF_FILE).decode())
            return sorted({self._check(text) for text in texts})
        except FileNotFoundError:
            return []
        except (OSError, ValueError, TypeError, AttributeError, RecursionError) as error:
            raise RefusedError(
                f"'{self._path}' cannot be read: {error}. Restart all processes with enclaves, then"
                " remove it."
            ) from error

    def write(self, texts: list[str]) -> None:
        """Write the texts, flushed to the disk; without any, remove the file."""
        spare = self._path + "-new"
        if not texts:
            with contextlib.suppress(FileNotFoundError):
                os.unlink(self._path)
            return
        with contextlib.suppress(FileNotFoundError):
            os.unlink(spare)
        with os.fdopen(os.open(spare, _NEW_FILE, 0o600), "w") as file:
            json.dump(sorted(texts), file)
            file.flush()
            os.fsync(file.fileno())
        os.replace(spare, self._path)
        _flush(os.path.dirname(self._path))


class Place:
    """The folder ``path`` with the enclaves of a robot, and next to it what a change needs.

    Only root and this user may be able to change the folders above it: then no link that somebody
    else made is on the way, and none can appear.  The folder itself may belong to another user,
    ``owner``, and so its content is not trusted.

    Units and containers mount the folders of enclaves, so a folder stays the same folder while its
    files are exchanged.  Next to ``keystore`` exist, only during a change:

    - ``.keystore.sros-new``: files that are prepared and verified; then it becomes
    - ``.keystore.sros-remove``: the change is decided.  What the new files lack is removed.
    - ``.keystore.sros-apply``: each new file takes its place.
    - ``.keystore.sros-old``: folders that are removed.

    The folder ``.agent`` in it is that of ``sros agent``, and stays as it is.

    Whoever comes after a process that was killed ends a change that was decided, and drops another.
    ``due`` is the record of the enclaves whose processes still have earlier files, ``delivered`` of
    the enclaves that were installed last, even if somebody removed them since, and ``trusting`` of
    digests (`trust_digest`) of enclaves of ``due`` whose processes have these files.
    """

    def __init__(self, path: str, owner: str | None = None) -> None:
        """Check the path.

        Raises:
            RefusedError: the path cannot be used, or there is no user ``owner``.
        """
        self.path = os.path.abspath(path)
        self._parent, self._name = os.path.split(self.path)
        if not self._name:
            raise RefusedError("The folder of the enclaves cannot be '/'. Name another one.")
        self._owner = _user(owner)
        _check_way(self._parent)
        if os.path.islink(self.path):
            raise RefusedError(
                f"'{self.path}' is a symbolic link. Name the folder that it leads to, or remove it."
            )
        self.due = _Record(self._beside("restart"), check_enclave)
        self.delivered = _Record(self._beside("delivered"), check_enclave)
        self.trusting = _Record(self._beside("trusting"), str)

    @property
    def _uid(self) -> int:
        """The user id of the owner of the enclaves."""
        return self._owner[0] if self._owner else os.geteuid()

    @property
    def stage(self) -> str:
        """The path of the folder in which new files are prepared."""
        return self._beside("new")

    def _beside(self, what: str) -> str:
        return os.path.join(self._parent, f".{self._name}.sros-{what}")

    # ── reading ────────────────────────────────────────────────────────────────────────────

    def read(self) -> Files:
        """Return all files in the folder; none if it does not exist.

        Raises:
            RefusedError: something in it is not of an enclave, so that the folder may have another
                purpose, or cannot be read.
        """
        found: Files = {}
        size = 0
        try:
            top = os.open(self.path, _FOLDER)
        except FileNotFoundError:
            return found
        except OSError as error:
            raise RefusedError(f"'{self.path}' cannot be read: {error.strerror}.") from error
        try:
            for folder, folders, files, handle in os.fwalk(".", dir_fd=top, onerror=_fail):
                below = os.path.relpath(folder, ".")
                self._leave_out_agent(below, folders, handle)
                names = [(entry, True) for entry in folders] + [(entry, False) for entry in files]
                for name, is_folder in names:
                    path = name if below == "." else f"{below}/{name}"
                    if not self._belongs(path, name, is_folder, handle):
                        raise RefusedError(
                            f"'{self.path}/{path}' is not a file of an enclave. All that is in"
                            " this folder is replaced, so only enclaves may be in it: move the file"
                            " away, or choose another folder."
                        )
                    if is_folder:
                        continue
                    found[path] = _read_file(handle, name, os.path.join(self.path, path))
                    size += len(found[path])
                    if len(found) > MOST_FILES or size > MOST_UNPACKED:
                        raise RefusedError(f"'{self.path}' has too many or too large files.")
        except OSError as error:
            raise RefusedError(f"'{self.path}' cannot be read: {error}.") from error
        finally:
            os.close(top)
        return found

    @staticmethod
    def _belongs(path: str, name: str, is_folder: bool, handle: int) -> bool:
        state = os.stat(name, dir_fd=handle, follow_symlinks=False)
        if not is_folder:
            return stat.S_ISREG(state.st_mode) and is_enclave_path(path)
        return stat.S_ISDIR(state.st_mode) and is_enclave_path(path + "/" + KEY_FILE)

    def is_closed(self) -> bool:
        """Return whether owners and modes are as `replace` leaves them."""
        for folder, folders, files, handle in os.fwalk(self.path):
            self._leave_out_agent(os.path.relpath(folder, self.path), folders, handle)
            state = os.fstat(handle)
            if state.st_uid != self._uid or stat.S_IMODE(state.st_mode) != 0o700:
                return False
            for name in files:
                state = os.stat(name, dir_fd=handle, follow_symlinks=False)
                if state.st_uid != self._uid or stat.S_IMODE(state.st_mode) != _mode(name):
                    return False
        return True

    def _leave_out_agent(self, below: str, folders: list[str], handle: int) -> None:
        """Take the agent's folder off the list of folders at the top."""
        if below == "." and _AGENT in folders and self._is_kept(_AGENT, handle):
            folders.remove(_AGENT)

    # ── changing ───────────────────────────────────────────────────────────────────────────

    @contextlib.contextmanager
    def locked(self) -> Iterator[None]:
        """Let only one process at a time change the folder; tidy up what a killed one left.

        Raises:
            RefusedError: another process has it for a minute.
        """
        self._make_parents()
        _check_way(self._parent)
        handle = os.open(
            self._beside("lock"), os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_CLOEXEC, 0o600
        )
        try:
            end = time.monotonic() + _LONGEST_WAIT
            while True:
                try:
                    fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
                    break
                except BlockingIOError:
                    if time.monotonic() > end:
                        raise RefusedError(
                            f"Another process is changing '{self.path}'. Run the play again later."
                        ) from None
                    time.sleep(0.2)
            self._recover()
            yield
        finally:
            os.close(handle)

    def _make_parents(self) -> None:
        try:
            os.makedirs(self._parent, 0o755, exist_ok=True)
        except OSError as error:
            raise RefusedError(
                f"'{self._parent}' cannot be made: {error.strerror}. Choose a folder of this user,"
                " or become root."
            ) from error

    def _recover(self) -> None:
        """End a change that was decided, and drop one that was not."""
        old = self._beside("old")
        if not (self.is_pending() or os.path.lexists(self.path)) and os.path.isdir(old):
            os.rename(old, self.path)  # of a version that exchanged the whole folder
        self.discard()
        self._end()

    def is_pending(self) -> bool:
        """Return whether a process was killed in a change that was decided."""
        return any(os.path.lexists(self._beside(suffix)) for suffix in ("remove", "apply"))

    def prepare(self, files: Files) -> None:
        """Write all files into `stage`, which only this user can open."""
        os.mkdir(self.stage, 0o700)
        for path, content in sorted(files.items()):
            whole = os.path.join(self.stage, path)
            os.makedirs(os.path.dirname(whole), 0o700, exist_ok=True)
            handle = os.open(whole, _NEW_FILE, 0o600)
            with os.fdopen(handle, "wb") as file:
                file.write(content)
                os.fchmod(file.fileno(), _mode(whole))
        for _folder, _, _, handle in os.fwalk(self.stage):
            os.fchmod(handle, 0o700)  # whatever the umask is

    def discard(self) -> None:
        """Remove what `prepare` wrote."""
        if os.path.lexists(self.stage):
            shutil.rmtree(self.stage)

    def replace(self) -> None:
        """Put the prepared files in place, and remove all others."""
        if self._owner:
            for _, _, files, handle in os.fwalk(self.stage, topdown=False):
                for name in files:
                    os.chown(name, *self._owner, dir_fd=handle, follow_symlinks=False)
                os.fchown(handle, *self._owner)
        os.sync()
        os.rename(self.stage, self._beside("remove"))
        _flush(self._parent)
        self._end()

    def _end(self) -> None:
        """Go on with a change that was decided, from the step that it reached."""
        remove, apply, old = (self._beside(suffix) for suffix in ("remove", "apply", "old"))
        if os.path.lexists(remove):
            with _opened(self._parent) as parent:
                if os.path.lexists(self.path) and not self._is_kept(self._name, parent):
                    self._put_away(self._name, parent)
            if not os.path.lexists(self.path):
                os.rename(remove, self.path)
            else:
                with _opened(remove) as new, _opened(self.path) as present:
                    has_agent = _AGENT in os.listdir(present) and self._is_kept(_AGENT, present)
                    kept = frozenset({_AGENT} if has_agent else ())
                    self._remove_others(new, present, kept)
                os.rename(remove, apply)
            _flush(self._parent)
        if os.path.lexists(apply):
            if not os.path.lexists(self.path):
                os.rename(apply, self.path)
            else:
                with _opened(apply) as new, _opened(self.path) as present:
                    self._move_in(new, present)
                shutil.rmtree(apply)
        if os.path.lexists(old):
            shutil.rmtree(old)
        _flush(self._parent)

    def _remove_others(self, new: int, present: int, but: frozenset[str] = frozenset()) -> None:
        """Remove what the open folder ``present`` has and ``new`` lacks, except ``but``."""
        wanted = set(os.listdir(new))
        for name in set(os.listdir(present)) - but:
            is_folder = name in wanted and _is_folder(name, new)
            fits = self._is_kept if is_folder else _is_no_folder
            if name not in wanted or not fits(name, present):
                self._put_away(name, present)
            elif is_folder:
                with _opened(name, new) as below_new, _opened(name, present) as below:
                    self._remove_others(below_new, below)
        os.fsync(present)

    def _move_in(self, new: int, present: int) -> None:
        """Move the files of the open folder ``new`` to those of the same name in ``present``."""
        if os.fstat(present).st_uid != self._uid:
            raise RefusedError(f"Somebody changed '{self.path}' meanwhile. Run the play again.")
        os.fchmod(present, 0o700)
        there = set(os.listdir(present))
        for name in os.listdir(new):
            is_folder = _is_folder(name, new)
            if is_folder and name in there and self._is_kept(name, present):
                with _opened(name, new) as below_new, _opened(name, present) as below:
                    self._move_in(below_new, below)
            elif is_folder or not _are_same(name, new, present):
                if name in there and (is_folder or _is_folder(name, present)):
                    self._put_away(name, present)
                os.rename(name, name, src_dir_fd=new, dst_dir_fd=present)
        os.fsync(present)

    def _is_kept(self, name: str, where: int) -> bool:
        """Return whether something is a folder of the owner of the enclaves."""
        state = os.stat(name, dir_fd=where, follow_symlinks=False)
        return stat.S_ISDIR(state.st_mode) and state.st_uid == self._uid

    def _put_away(self, name: str, where: int) -> None:
        """Move something out of an open folder, to where it is removed."""
        old = self._beside("old")
        os.makedirs(old, 0o700, exist_ok=True)
        os.rename(name, os.path.join(old, str(len(os.listdir(old)))), src_dir_fd=where)

    # ── what is remembered ─────────────────────────────────────────────────────────────────

    def set_due(self, names: list[str]) -> None:
        """Record the enclaves whose processes have to be restarted."""
        self.due.write(names)
        if not names:
            self.trusting.write([])

    def crl_due(self, files: Files) -> list[str]:
        """Return the enclaves of `due` whose processes may lack the list or a CA in ``files``.

        Raises:
            RefusedError: a record cannot be read.
        """
        loaded = set(self.trusting.read())
        return [
            enclave for enclave in self.due.read() if trust_digest(files, enclave) not in loaded
        ]

    def agent_due(self, files: Files) -> list[str]:
        """Return the enclaves whose restart `sros agent` noted since the start of the machine.

        The agent may have installed files since the last play.  All enclaves of ``files`` if what
        it noted cannot be read.
        """
        try:
            with _opened(self.path) as top, _opened(_AGENT, top) as agent:
                content = _read_file(agent, _AGENT_STATE, os.path.join(self.path, _AGENT))
            state = json.loads(content.decode())
            due = sorted({check_enclave(enclave) for enclave in state["due"]})
            boot = _boot_id()
            return [] if boot and state["boot"] not in ("", boot) else due
        except FileNotFoundError:
            return []
        except (
            RefusedError,
            OSError,
            ValueError,
            TypeError,
            KeyError,
            AttributeError,
            RecursionError,
        ):
            return enclaves_in(files)


def _boot_id() -> str:
    """Return the id of the start of the machine; "" if it cannot be read."""
    with contextlib.suppress(OSError), open(_BOOT_ID) as file:
        return file.read().strip()
    return ""


def _mode(path: str) -> int:
    return 0o600 if os.path.basename(path) == KEY_FILE else 0o644


def _user(name: str | None) -> tuple[int, int] | None:
    """Return the user id and group id of a user, or None if nothing is to be given away."""
    if not name:
        return None
    try:
        entry = pwd.getpwnam(name)
    except KeyError:
        raise RefusedError(f"There is no user {name!r} on this robot.") from None
    if entry.pw_uid == os.geteuid():
        return None
    if os.geteuid() != 0:
        raise RefusedError(
            f"Only root can give files to the user {name!r}. Connect as that user, or become root."
        )
    return entry.pw_uid, entry.pw_gid


def _check_way(path: str) -> None:
    """Refuse a path on which anybody but root and this user can put a link or another folder."""
    trusted = (0, os.geteuid())
    here, rest, links = "/", path.split("/")[::-1], 0
    while rest:
        part = rest.pop()
        if part in ("", "."):
            continue
        if part == "..":
            here = os.path.dirname(here)
            continue
        here = os.path.join(here, part)
        try:
            state = os.lstat(here)
        except FileNotFoundError:
            here = os.path.dirname(here)
            break
        except OSError as error:
            raise RefusedError(f"'{here}' cannot be used: {error.strerror}.") from error
        if state.st_uid not in trusted:
            raise RefusedError(
                f"'{here}' belongs to another user, who could lead the files elsewhere. Choose a"
                " folder below one of root's, or connect as that user."
            )
        if stat.S_ISLNK(state.st_mode):
            links += 1
            if links > _MOST_LINKS:
                raise RefusedError(f"'{path}' leads through too many links.")
            target = os.readlink(here)
            here = "/" if target.startswith("/") else os.path.dirname(here)
            rest += target.split("/")[::-1]
        elif not stat.S_ISDIR(state.st_mode):
            raise RefusedError(f"'{here}' is not a folder.")
        elif not state.st_mode & stat.S_ISVTX:
            _check_closed(here, state)
    # In a sticky folder like /tmp nobody can replace what is there, but anybody can add to it.
    _check_closed(here, os.lstat(here))


def _check_closed(folder: str, state: os.stat_result) -> None:
    if state.st_mode & _OF_OTHERS:
        raise RefusedError(
            f"Others can write to '{folder}' (mode {stat.S_IMODE(state.st_mode):04o}), and could"
            " lead the files elsewhere. Choose another folder, or take these rights away."
        )


def _fail(error: OSError) -> None:
    raise error


def _read_file(folder: int, name: str, whole: str) -> bytes:
    with os.fdopen(os.open(name, _FILE, dir_fd=folder), "rb") as file:
        state = os.fstat(file.fileno())
        if not stat.S_ISREG(state.st_mode) or state.st_size > MOST_OF_FILE:
            raise RefusedError(f"'{whole}' is not a regular file, or too large.")
        if _may_be_linked(state, os.fstat(folder)):
            raise RefusedError(
                f"'{whole}' may be a hard link to a file of somebody else: it has another owner"
                " than its folder, or another name, too. It was not read. Put a copy in its place"
                " that belongs to the owner of the folder, or remove it."
            )
        return file.read(MOST_OF_FILE)


def _may_be_linked(file: os.stat_result, folder: os.stat_result) -> bool:
    """Return whether somebody can have linked a file of another user into the folder.

    Its content would become that of the owner of the enclaves.  What all users can read is no
    secret; but a secret can have lost its other name since.
    """
    same = file.st_uid == folder.st_uid
    if file.st_nlink > 1 and not (same and not folder.st_mode & _OF_OTHERS):
        return True
    return not same and not file.st_mode & stat.S_IROTH


@contextlib.contextmanager
def _opened(folder: str, where: int | None = None) -> Iterator[int]:
    """Open a folder, itself or below the open folder ``where``, and never through a link."""
    handle = os.open(folder, _FOLDER, dir_fd=where)
    try:
        yield handle
    finally:
        os.close(handle)


def _is_folder(name: str, where: int) -> bool:
    return stat.S_ISDIR(os.stat(name, dir_fd=where, follow_symlinks=False).st_mode)


def _is_no_folder(name: str, where: int) -> bool:
    return not _is_folder(name, where)


def _are_same(name: str, one: int, other: int) -> bool:
    """Return whether two open folders have the same file: content, owner and mode."""
    contents = []
    for folder in (one, other):
        try:
            with os.fdopen(os.open(name, _FILE, dir_fd=folder), "rb") as file:
                state = os.fstat(file.fileno())
                attributes = state.st_mode, state.st_uid, state.st_gid, state.st_nlink
                contents.append((attributes, file.read(MOST_OF_FILE)))
        except OSError:
            return False
    return contents[0] == contents[1]


def _flush(folder: str) -> None:
    with _opened(folder) as handle:
        os.fsync(handle)
