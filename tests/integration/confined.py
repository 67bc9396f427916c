"""Run a command under restrictions of a systemd unit, where there is no systemd that would.

``confined.py UNITS KEEP... -- COMMAND...``: ``UNITS`` is a file with the text of a template and of
its settings, each ``KEEP`` a folder of the test that stays as it is.  In force are, of what
`sros_tool.runtime.units` writes, the filters of system calls and address families, the
capabilities, the read-only file system, the private /tmp, and the other enclaves that are gone.
"""

from __future__ import annotations

import ctypes
import os
import re
import socket
import subprocess
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path

_NEWNS = 0x20000
_RDONLY, _REMOUNT, _BIND, _REC, _PRIVATE = 1, 32, 4096, 16384, 1 << 18
_CAPBSET_DROP, _NO_NEW_PRIVS = 24, 38
_ALLOW, _ERRNO, _EQUAL = 0x7FFF0000, 0x50000, 4
_EPERM, _EAFNOSUPPORT = 1, 97
_MOST_FAMILIES = 46

libc = ctypes.CDLL(None, use_errno=True)


class Comparison(ctypes.Structure):
    """The C struct ``scmp_arg_cmp`` of <seccomp.h>."""

    _fields_ = [
        ("argument", ctypes.c_uint),
        ("operator", ctypes.c_int),
        ("value", ctypes.c_uint64),
        ("other", ctypes.c_uint64),
    ]


def main() -> None:
    words = sys.argv[1:]
    at = words.index("--")
    text, keep, command = Path(words[0]).read_text(), words[1:at], words[at + 1 :]
    filters = values(text, "SystemCallFilter")  # before /tmp is another one
    calls = sorted({call for each in filters for call in system_calls(each)})
    replace_file_system(text, [Path(each) for each in keep])
    assert values(text, "CapabilityBoundingSet") == [""]
    for capability in range(64):
        libc.prctl(_CAPBSET_DROP, capability, 0, 0, 0)
    assert values(text, "NoNewPrivileges") == ["yes"]
    checked(libc.prctl(_NO_NEW_PRIVS, 1, 0, 0, 0), "no_new_privs")
    (families,) = values(text, "RestrictAddressFamilies")
    filter_calls({getattr(socket, each) for each in families.split()}, calls)
    os.execve(command[0], command, os.environ)


def values(text: str, key: str) -> list[str]:
    return re.findall(rf"^{key}=(.*)$", text, re.MULTILINE)


def checked(result: int, what: str) -> None:
    if result < 0:
        raise OSError(ctypes.get_errno(), f"{what}: {os.strerror(ctypes.get_errno())}")


def mount(source: str, target: Path, kind: str, flags: int) -> None:
    words = (source.encode(), os.fsencode(target), kind.encode())
    checked(libc.mount(*words, ctypes.c_ulong(flags), None), f"mount {target}")


def replace_file_system(text: str, keep: Sequence[Path]) -> None:
    """Make everything read-only but ``keep``, /tmp another one, and other enclaves disappear."""
    assert values(text, "ProtectSystem") == ["strict"] and values(text, "PrivateTmp") == ["yes"]
    checked(libc.unshare(_NEWNS), "unshare")
    mount("none", Path("/"), "", _REC | _PRIVATE)
    shown = [Path(each) for each in values(text, "BindReadOnlyPaths") if each[0] != "-"]
    # The program itself may be in a checkout below /tmp.
    own = [Path(each) for each in (Path(__file__).parents[2], sys.prefix)]
    shown += [each for each in own if each.is_relative_to("/tmp")]
    opened = {each: os.open(each, os.O_PATH) for each in (*keep, *shown)}
    mount("none", Path("/"), "", _REMOUNT | _BIND | _RDONLY)
    hidden = [Path(each.removesuffix(":ro")) for each in values(text, "TemporaryFileSystem")]
    for empty in (Path("/tmp"), *hidden):
        if empty in hidden and not empty.exists():
            continue
        mount("none", empty, "tmpfs", 0)
        for path in opened:
            if path.is_relative_to(empty):
                put_back(path, opened[path], read_only=path in shown)
    for path in keep:
        if not os.access(path, os.W_OK) or os.statvfs(path).f_flag & _RDONLY:
            put_back(path, opened[path], read_only=False)
    for path in hidden:
        mount("none", path, "", _REMOUNT | _BIND | _RDONLY)


def put_back(path: Path, handle: int, *, read_only: bool) -> None:
    path.mkdir(parents=True, exist_ok=True)
    mount(f"/proc/self/fd/{handle}", path, "", _BIND)
    mount("none", path, "", _REMOUNT | _BIND | (_RDONLY if read_only else 0))


def system_calls(group: str) -> Iterator[str]:
    """Yield the system calls of a group of systemd, such as @system-service."""
    if not group.startswith("@"):
        yield group
        return
    command = ["systemd-analyze", "syscall-filter", "--no-pager", group]
    said = subprocess.run(command, check=True, capture_output=True, text=True).stdout
    for line in said.splitlines()[1:]:
        name = line.strip()
        if name and not name.startswith("#"):
            yield from system_calls(name)


def filter_calls(families: set[int], calls: Sequence[str]) -> None:
    """Allow only these system calls, and sockets of these address families."""
    seccomp = ctypes.CDLL("libseccomp.so.2", use_errno=True)
    seccomp.seccomp_init.restype = ctypes.c_void_p
    number = seccomp.seccomp_syscall_resolve_name
    sockets = ctypes.c_void_p(seccomp.seccomp_init(_ALLOW))
    for family in set(range(_MOST_FAMILIES)) - families:
        rule = ctypes.byref(Comparison(0, _EQUAL, family, 0))
        action = _ERRNO | _EAFNOSUPPORT
        checked(seccomp.seccomp_rule_add_array(sockets, action, number(b"socket"), 1, rule), "rule")
    checked(seccomp.seccomp_load(sockets), "load")
    allowed = ctypes.c_void_p(seccomp.seccomp_init(_ERRNO | _EPERM))
    for call in calls:
        if (found := number(call.encode())) != -1:
            seccomp.seccomp_rule_add_array(allowed, _ALLOW, found, 0, None)
    checked(seccomp.seccomp_load(allowed), "load")


if __name__ == "__main__":
    main()
