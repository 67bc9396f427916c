"""Count what is readable on the wire, with a packet socket in plain Python.

Needs CAP_NET_RAW in the network that is looked at: root has it, and so has whoever made a network
namespace of his own (`sros_tool.runtime.netns`).
"""

from __future__ import annotations

import socket
import time
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

_ETH_P_IP = 0x0800
_PACKET_OUTGOING = 4
_UDP = 17
_BUFFER_BYTES = 16 * 1024 * 1024
_SO_RCVBUFFORCE = 33

_RTPS_HEADER = 20
_PROTECTED_SUBMESSAGES = range(0x30, 0x35)
"""SEC_BODY, SEC_PREFIX, SEC_POSTFIX, SRTPS_PREFIX, SRTPS_POSTFIX (DDS-Security 1.1 §7.3.6)."""


class Kept(NamedTuple):
    """A captured packet: when it was read (CLOCK_MONOTONIC), its UDP source port, all of it."""

    time: float
    source: int
    packet: bytes


class PacketCounter:
    """Counts IPv4 packets in which one of ``marks`` is readable, and those that are protected.

    ``plain`` counts by mark, ``protected`` by UDP port, for both ports of a packet.  With
    ``keep``, the RTPS packets themselves are in ``kept``, in order.
    """

    def __init__(self, marks: Sequence[str], *, keep: bool = False) -> None:
        self._marks = {mark: mark.encode() for mark in marks}
        self._keep = keep
        self.plain: Counter[str] = Counter()
        self.protected: Counter[int] = Counter()
        self.kept: list[Kept] = []

    def count(self, packet: bytes) -> None:
        """Count one packet; whatever is not UDP is passed over."""
        start = (packet[0] & 0x0F) * 4 if packet else 0
        if len(packet) < max(20, start) + 8 or packet[9] != _UDP:
            return
        source = int.from_bytes(packet[start : start + 2], "big")
        target = int.from_bytes(packet[start + 2 : start + 4], "big")
        payload = packet[start + 8 :]
        if self._keep and payload[:4] == b"RTPS":
            self.kept.append(Kept(time.monotonic(), source, packet))
        for mark, raw in self._marks.items():
            if raw in payload:
                self.plain[mark] += 1
        if _is_protected(payload):
            self.protected.update({source, target})


class Capture(PacketCounter):
    """Listens on every interface and counts; only what is to be kept is stored, in memory.

    Raises `PermissionError` where it is not permitted.
    """

    def __init__(self, marks: Sequence[str], *, keep: bool = False) -> None:
        super().__init__(marks, keep=keep)
        self._socket = socket.socket(socket.AF_PACKET, socket.SOCK_DGRAM, socket.htons(_ETH_P_IP))
        self._socket.setblocking(False)
        try:
            self._socket.setsockopt(socket.SOL_SOCKET, _SO_RCVBUFFORCE, _BUFFER_BYTES)
        except OSError:
            self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _BUFFER_BYTES)

    def fileno(self) -> int:
        """The descriptor to wait on."""
        return self._socket.fileno()

    def drain(self) -> None:
        """Count all packets that have come."""
        while True:
            try:
                packet, address = self._socket.recvfrom(65535)
            except BlockingIOError:
                return
            if address[2] != _PACKET_OUTGOING:
                self.count(packet)

    def close(self) -> None:
        """Stop listening."""
        self._socket.close()


def _is_protected(payload: bytes) -> bool:
    """Whether a UDP payload is RTPS with a protected submessage (RTPS 2.3 §9.4)."""
    if payload[:4] != b"RTPS":
        return False
    position = _RTPS_HEADER
    while position + 4 <= len(payload):
        kind, flags = payload[position], payload[position + 1]
        if kind in _PROTECTED_SUBMESSAGES:
            return True
        size = payload[position + 2 : position + 4]
        length = int.from_bytes(size, "little" if flags & 1 else "big")
        if length == 0:
            return False
        position += 4 + length
    return False


def udp_ports(process: int) -> frozenset[int]:
    """The UDP ports that a process has bound, by its open descriptors; empty if it has ended."""
    folder = Path(f"/proc/{process}")
    try:
        links = list((folder / "fd").iterdir())
        lines = (folder / "net" / "udp").read_text(encoding="ascii").splitlines()[1:]
    except OSError:
        return frozenset()
    inodes = {_socket_inode(link) for link in links}
    rows = [line.split() for line in lines]
    return frozenset(int(row[1].partition(":")[2], 16) for row in rows if row[9] in inodes)


def _socket_inode(link: Path) -> str:
    try:
        target = str(link.readlink())
    except OSError:
        return ""  # closed meanwhile
    return target.removeprefix("socket:[").removesuffix("]") if target[:8] == "socket:[" else ""
