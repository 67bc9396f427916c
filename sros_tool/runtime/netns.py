"""Move the calling process into a separate network, so that demo and host do not interfere.

The network namespace has only a loopback interface, and disappears with the last process in it.
Creating it needs CAP_SYS_ADMIN or a user namespace, which also grants the right to capture packets
in the new network (capabilities(7), user_namespaces(7)).
"""

from __future__ import annotations

import contextlib
import ctypes
import fcntl
import os
import signal
import socket
import struct
from dataclasses import dataclass
from pathlib import Path

_CLONE_NEWUSER = 0x10000000
_CLONE_NEWNET = 0x40000000
_PR_SET_PDEATHSIG = 1

_SIOCADDRT = 0x890B
_SIOCGIFFLAGS = 0x8913
_SIOCSIFFLAGS = 0x8914
_IFF_UP = 0x1
_IFF_MULTICAST = 0x1000
_RTF_UP = 0x1

_LOCAL_PORTS = Path("/proc/sys/net/ipv4/ip_local_port_range")
_BELOW_DDS = "1024 7399"
"""A port range that no domain uses: their ports begin at 7400 (RTPS 2.5 §9.6.2.3)."""

_TRIAL_SECONDS = 60


class _RouteEntry(ctypes.Structure):
    """The C struct ``rtentry`` of <net/route.h>."""

    _fields_ = [
        ("pad1", ctypes.c_ulong),
        ("destination", ctypes.c_char * 16),
        ("gateway", ctypes.c_char * 16),
        ("mask", ctypes.c_char * 16),
        ("flags", ctypes.c_ushort),
        ("pad2", ctypes.c_short),
        ("pad3", ctypes.c_ulong),
        ("pad4", ctypes.c_void_p),
        ("metric", ctypes.c_short),
        ("device", ctypes.c_void_p),
        ("mtu", ctypes.c_ulong),
        ("window", ctypes.c_ulong),
        ("round_trip", ctypes.c_ushort),
    ]


@dataclass(frozen=True)
class Isolation:
    """Whether a process can get a separate network, with the reason if it cannot."""

    isolated: bool
    reason: str = ""


def try_isolation() -> Isolation:
    """Return whether `enter_isolation` would work, by trying it in a child process."""
    read_end, write_end = os.pipe()
    child = os.fork()
    if child == 0:
        os.close(read_end)
        signal.alarm(_TRIAL_SECONDS)
        reason = ""
        try:
            enter_isolation()
        except OSError as error:
            reason = f"no separate network namespace: {error.strerror or error}"
        except BaseException as error:  # a forked child must never return into its caller
            reason = f"no separate network namespace: {error}"
        finally:
            os.write(write_end, (reason or "yes").encode())
            os._exit(0)
    os.close(write_end)
    with os.fdopen(read_end, "rb") as answers:
        answer = answers.read().decode("utf-8", "replace")
    os.waitpid(child, 0)
    if answer == "yes":
        return Isolation(True)
    return Isolation(False, answer or "the trial process ended without an answer")


def enter_isolation() -> None:
    """Move this process, which must have only one thread, into a new network namespace.

    Raises:
        OSError: The kernel does not allow it. The process may then be in a user namespace without
            rights, so call `try_isolation` first.
    """
    user, group = os.getuid(), os.getgid()
    try:
        _unshare(_CLONE_NEWNET)
    except OSError:
        _unshare(_CLONE_NEWUSER | _CLONE_NEWNET)
        Path("/proc/self/setgroups").write_text("deny", encoding="ascii")
        Path("/proc/self/uid_map").write_text(f"{user} {user} 1", encoding="ascii")
        Path("/proc/self/gid_map").write_text(f"{group} {group} 1", encoding="ascii")
    _bring_up_loopback()
    _keep_off_ports_of_dds()


def end_with_parent() -> None:
    """Ask the kernel to kill this process when the thread that started it ends."""
    _libc().prctl(_PR_SET_PDEATHSIG, int(signal.SIGKILL), 0, 0, 0)


def _libc() -> ctypes.CDLL:
    return ctypes.CDLL(None, use_errno=True)


def _unshare(flags: int) -> None:
    if _libc().unshare(flags) != 0:
        number = ctypes.get_errno()
        raise OSError(number, f"unshare: {os.strerror(number)}")


def _bring_up_loopback() -> None:
    """Do ``ip link set lo up multicast on; ip route add 224.0.0.0/4 dev lo`` without iproute2."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as control:
        request = struct.pack("16sH14x", b"lo", 0)
        answer = fcntl.ioctl(control, _SIOCGIFFLAGS, request)
        (flags,) = struct.unpack_from("H", answer, 16)
        request = struct.pack("16sH14x", b"lo", flags | _IFF_UP | _IFF_MULTICAST)
        fcntl.ioctl(control, _SIOCSIFFLAGS, request)
        _add_multicast_route(control)


def _add_multicast_route(control: socket.socket) -> None:
    device = ctypes.create_string_buffer(b"lo")
    entry = _RouteEntry(
        destination=_internet_address("224.0.0.0"),
        gateway=_internet_address("0.0.0.0"),  # noqa: S104 - "no gateway", nothing is bound
        mask=_internet_address("240.0.0.0"),
        flags=_RTF_UP,
        device=ctypes.addressof(device),
    )
    fcntl.ioctl(control, _SIOCADDRT, bytes(entry))


def _keep_off_ports_of_dds() -> None:
    """Stop the kernel from assigning ports of DDS domains to sockets that bind to any free port.

    From domain 102 on, the ports of DDS are in the range from which Linux assigns free ports: a
    participant could not join if its port was assigned to another socket.
    """
    with contextlib.suppress(OSError):  # a container may forbid it
        _LOCAL_PORTS.write_text(_BELOW_DDS, encoding="ascii")


def _internet_address(text: str) -> bytes:
    """Return the address as a ``struct sockaddr_in`` with port 0."""
    return struct.pack("=HH4s8x", socket.AF_INET, 0, socket.inet_aton(text))
