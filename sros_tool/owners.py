"""Checks whether untrusted users can change or replace a file, by owners and permission bits.

Only owners and permission bits are looked at, not access control lists (acl(5)).
"""

from __future__ import annotations

import grp
import os
import pwd
import stat
from collections.abc import Iterable, Iterator
from contextlib import suppress
from functools import lru_cache
from pathlib import Path
from shlex import quote

from sros_tool.errors import KeystoreError

_ROOT = frozenset({0})
_MOST_LINKS = 40


def other_writers_clause(state: os.stat_result, trusted_users: frozenset[int]) -> str:
    """Return why other users than ``trusted_users`` (user ids) can change a file or folder, or "".

    The members of the group count as other users, unless it is the private group of a trusted user.
    Debian and other systems give each user such a group, with umask 002.
    """
    if state.st_uid not in trusted_users:
        return f"it belongs to {user_name(state.st_uid)}"
    if stat.S_ISLNK(state.st_mode):
        return ""
    mode = f"its mode is {stat.S_IMODE(state.st_mode):04o}"
    if state.st_mode & stat.S_IWOTH:
        return f"{mode}, so everybody can write"
    if state.st_mode & stat.S_IWGRP and not _is_private_group(state.st_gid, trusted_users):
        return f"{mode}, so the group {_group_name(state.st_gid)} can write"
    return ""


def closing_command(path: Path, trusted_users: frozenset[int]) -> str:
    """Return the command that takes the right to change ``path`` from other users.

    If one of them owns ``path``, the command makes the present user its owner.
    """
    if path.lstat().st_uid not in trusted_users:
        return f"sudo chown -h {user_name(os.geteuid()).split()[-1]} {quote(str(path))}"
    return f"chmod go-w {quote(str(path))}"


def is_for_root_alone(mode: int) -> bool:
    """Return whether this process, as root, can read a file that nobody else can read."""
    return os.geteuid() == 0 and not mode & (stat.S_IRUSR | stat.S_IRGRP | stat.S_IROTH)


def replaceable_on_the_way(path: Path, trusted_users: frozenset[int]) -> Iterator[tuple[Path, str]]:
    """Yield the folders and links above ``path`` that let others replace ``path``, and why.

    In a sticky folder such as ``/tmp``, only the owner of a file can rename the file.  So a sticky
    folder counts only if others own the next part of the path.
    """
    for step, state in steps_to(path):
        kept = state.st_mode & stat.S_ISVTX and state.st_uid in trusted_users
        if not kept and (why := other_writers_clause(state, trusted_users)):
            yield step, why


def refuse_link_of_stranger(path: Path) -> None:
    """Refuse to write keys where a link of another user leads.

    Raises:
        KeystoreError: `link_of_stranger` finds a link on the way to ``path``.
    """
    if link := link_of_stranger(steps_to(path), frozenset({0, os.geteuid()})):
        raise KeystoreError(
            f"'{link}' is a link of another user",
            f"It belongs to {user_name(link.lstat().st_uid)}, who decides where it leads: now to "
            f"'{os.path.realpath(link)}'.",
            "Choose another folder, or name the folder itself.",
        )


def link_of_stranger(
    steps: Iterable[tuple[str | Path, os.stat_result]], trusted_users: frozenset[int]
) -> Path | None:
    """Return the first link that another user than ``trusted_users`` made on a way, or None.

    ``steps`` are the folders and links on the way, as `steps_to` yields them. The owner of a folder
    may make links in it, unless everybody can write there.
    """
    folders: dict[Path, os.stat_result] = {}
    for step, state in ((Path(name), state) for name, state in steps):
        if not stat.S_ISLNK(state.st_mode):
            folders[step] = state
            continue
        folder = folders[step.parent]
        owners = trusted_users | (set() if folder.st_mode & stat.S_IWOTH else {folder.st_uid})
        if state.st_uid not in owners:
            return step
    return None


def file_of_root(path: Path) -> Path | None:
    """Return the real path of a regular file that only root can change or replace, else None."""
    try:
        real = path.resolve(strict=True)
        state = real.lstat()
    except (OSError, RuntimeError, ValueError):  # a loop of links, or a NUL byte
        return None
    ways = [state, *(status for _, status in steps_to(real))]
    is_ours = stat.S_ISREG(state.st_mode) and not any(
        other_writers_clause(status, _ROOT) for status in ways
    )
    return real if is_ours else None


def steps_to(path: Path) -> Iterator[tuple[Path, os.stat_result]]:
    """Yield the folders and links on the way to ``path``, each with its lstat(2).

    ``path`` itself is included only if it is a link.
    """
    here, rest, links = Path("/"), list(reversed(path.absolute().parts[1:])), 0
    yield here, here.lstat()
    while rest:
        part = rest.pop()
        if part == "..":
            here = here.parent
            continue
        entry = here / part
        try:
            state = entry.lstat()
        except OSError:
            return
        if stat.S_ISLNK(state.st_mode):
            links += 1
            if links > _MOST_LINKS:
                return
            yield entry, state
            target = entry.readlink()
            here = Path("/") if target.is_absolute() else here
            rest += reversed(target.parts[1:] if target.is_absolute() else target.parts)
        elif rest:
            yield entry, state
            here = entry


@lru_cache
def _is_private_group(group: int, trusted_users: frozenset[int]) -> bool:
    """Return whether a group is the private group of a trusted user, without other members."""
    users = []
    for user in trusted_users:
        with suppress(KeyError):
            users.append(pwd.getpwuid(user))
    try:
        name, _, _, members = grp.getgrgid(group)
    except KeyError:
        return False
    has_user = any(user.pw_gid == group and user.pw_name == name for user in users)
    return has_user and {user.pw_name for user in users}.issuperset(members)


def user_name(user: int) -> str:
    """Return text such as ``user alice``, or ``user 1000`` for a user without a name."""
    try:
        return f"user {pwd.getpwuid(user).pw_name}"
    except KeyError:
        return f"user {user}"


def _group_name(group: int) -> str:
    try:
        return grp.getgrgid(group).gr_name
    except KeyError:
        return str(group)
