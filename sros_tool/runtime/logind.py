"""Whose shared memory systemd-logind removes at the end of the user's last session.

Sources: logind.conf(5) (RemoveIPC, on by default), loginctl(1) (enable-linger) and sd_booted(3)
of systemd 252.
"""

from __future__ import annotations

import subprocess
from collections.abc import Iterable
from pathlib import Path

from sros_tool.owners import user_name
from sros_tool.runtime.processes import SEVERAL_USERS

_FIRST_LOGIN_USER = 1000
"""The first user id whose shared memory logind removes; lower ids are of system users."""

_BOOTED_FOLDER = Path("/run/systemd/system")
"""Exists on machines that systemd has booted."""

_LINGER_FOLDER = Path("/var/lib/systemd/linger")
_LOGIND = ("org.freedesktop.login1", "/org/freedesktop/login1", "org.freedesktop.login1.Manager")


def users_without_linger(users: Iterable[int]) -> list[str]:
    """Return the names (or ids) of those of ``users`` whose memory logind removes at logout."""
    chosen = sorted({user for user in users if _FIRST_LOGIN_USER <= user < SEVERAL_USERS})
    names = [user_name(user).removeprefix("user ") for user in chosen]
    names = [name for name in names if not (_LINGER_FOLDER / name).exists()]
    return names if names and _removes_memory() else []


def _removes_memory() -> bool:
    """Return whether logind removes shared memory; True, the default, if logind cannot be asked.

    Without systemd, nothing removes it.
    """
    if not _BOOTED_FOLDER.is_dir():
        return False
    command = ["busctl", "get-property", *_LOGIND, "RemoveIPC"]
    try:
        shown = subprocess.run(command, capture_output=True, check=False).stdout
    except OSError:
        return True
    return shown.split() != [b"b", b"false"]
