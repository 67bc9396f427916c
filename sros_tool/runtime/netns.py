"""Networks for the demo, separate from the host's network: for the process, and for each row.

The network namespace has only a loopback interface, and disappears with the last process in it.
Creating a network namespace needs CAP_SYS_ADMIN or a user namespace, which also grants the right to
capture packets in the new network (capabilities(7), user_namespaces(7)).

A row's network is a namespace that exists as long as the processes and sockets in it.  To create
the network of a row, a process must be in a separate network and have only one thread
(`run_isolated`): setns(2) changes only the calling thread.
"""

from __future__ import annotations

import asyncio
import contextlib
import ctypes
import fcntl
import multiprocessing
import os
import signal
import socket
import struct
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

from sros_tool.errors import SrosError
from sros_tool.parallel import end_with_starter

_CLONE_NEWUSER = 0x10000000
_CLONE_NEWNET = 0x40000000

_SIOCADDRT = 0x890B
_SIOCGIFFLAGS = 0x8913
_SIOCSIFFLAGS = 0x8914
_IFF_UP = 0x1
_IFF_MULTICAST = 0x1000
_RTF_UP = 0x1

_LOCAL_PORTS = Path("/proc/sys/net/ipv4/ip_local_port_range")
_PORTS_BELOW_DDS = "1024 7399"
"""A port range that no domain uses: DDS ports begin at 7400 (RTPS 2.5 §9.6.2.3)."""

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


class Isolation(NamedTuple):
    """Whether a process can get a separate network, and the reason if it cannot."""

    isolated: bool
    reason: str = ""


def try_isolation() -> Isolation:
    """Return whether `enter_isolation` would work, after trying it in a child process."""
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
        except BaseException as error:  # a forked child must never return to its parent's code
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
    _reserve_dds_ports()


def _libc() -> ctypes.CDLL:
    return ctypes.CDLL(None, use_errno=True)


def _unshare(flags: int) -> None:
    if _libc().unshare(flags) != 0:
        number = ctypes.get_errno()
        raise OSError(number, f"unshare: {os.strerror(number)}")


def _bring_up_loopback() -> None:
    """Switch on the loopback interface, with multicast, without the program ip.

    The effect is the same as of ``ip link set lo up multicast on; ip route add 224.0.0.0/4 dev
    lo``.
    """
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


def _reserve_dds_ports() -> None:
    """Keep the kernel from assigning ports of DDS domains to sockets that bind to any free port.

    From domain 102 on, the DDS ports are in the range from which Linux assigns free ports: a
    participant could not join if its port was assigned to another socket.
    """
    with contextlib.suppress(OSError):  # a container may forbid it
        _LOCAL_PORTS.write_text(_PORTS_BELOW_DDS, encoding="ascii")


def _internet_address(text: str) -> bytes:
    """Return an IPv4 address as a C ``struct sockaddr_in`` with port 0."""
    return struct.pack("=HH4s8x", socket.AF_INET, 0, socket.inet_aton(text))


_OWN_NETWORK = "/proc/thread-self/ns/net"


class RowNetwork:
    """The network of a demo row's processes and capture.

    Without ``own``, the row uses the network of the machine.
    """

    def __init__(self, *, own: bool) -> None:
        self.own = own
        self._there = self._back = -1
        if not own:
            return
        self._back = os.open(_OWN_NETWORK, os.O_RDONLY | os.O_CLOEXEC)
        try:
            enter_isolation()
            self._there = os.open(_OWN_NETWORK, os.O_RDONLY | os.O_CLOEXEC)
        finally:
            _enter(self._back)

    @contextmanager
    def in_network(self) -> Iterator[None]:
        """Move this thread into the network of the row, until the end of the context."""
        if not self.own:
            yield
            return
        _enter(self._there)
        try:
            yield
        finally:
            _enter(self._back)

    def close(self) -> None:
        """Release the network; the kernel removes it with the last process and socket in it."""
        for descriptor in (self._there, self._back):
            if descriptor >= 0:
                os.close(descriptor)
        self._there = self._back = -1


def _enter(descriptor: int) -> None:
    if _libc().setns(descriptor, _CLONE_NEWNET) != 0:
        number = ctypes.get_errno()
        raise OSError(number, f"setns: {os.strerror(number)}")


_Value = TypeVar("_Value")

Progress = Callable[[str], None]
"""A function that is called with lines about the progress."""

ENDING_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)

_SECONDS_TO_END = 8.0


def run_isolated(
    work: Callable[[Progress], _Value], isolation: Isolation, progress: Progress
) -> _Value:
    """Run ``work`` in a child process and return its result.

    ``progress`` gets each line that ``work`` passes to its argument.  The child enters a separate
    network if ``isolation`` says so, and does not outlive this process.

    Raises:
        SrosError: ``work`` raised it, or the child ended without a result.
    """
    context = multiprocessing.get_context("fork")
    ours, theirs = context.Pipe(duplex=False)
    child = context.Process(
        target=_work_in_child, args=(work, isolation, theirs, end_with_starter())
    )
    child.start()
    theirs.close()
    try:
        while True:
            try:
                kind, value = ours.recv()
            except EOFError:
                child.join()
                raise SrosError(
                    "the demo ended without a result",
                    f"Its process ended with status {child.exitcode}.",
                ) from None
            if kind == "progress":
                progress(value)
            elif kind == "failed":
                raise value
            else:
                result: _Value = value
                return result
    except BaseException:
        child.terminate()
        raise
    finally:
        child.join(_SECONDS_TO_END)
        if child.is_alive():
            child.kill()
            child.join()
        ours.close()


def _work_in_child(
    work: Callable[[Progress], Any],
    isolation: Isolation,
    answers: Connection,
    follow_starter: Callable[[], None],
) -> None:
    follow_starter()
    # Drop the parent's handlers: Python loses an exception that a handler raises during a fork.
    # Work that must clean up sets handlers again.
    for number in ENDING_SIGNALS:
        signal.signal(number, signal.SIG_DFL)
    try:
        if isolation.isolated:
            enter_isolation()
        answers.send(("result", work(lambda line: answers.send(("progress", line)))))
    except asyncio.CancelledError:
        os._exit(1)
    except SrosError as error:
        answers.send(("failed", error))
    except Exception as error:
        answers.send(("failed", SrosError("the demo failed", f"{type(error).__name__}: {error}")))
