"""Capture packets, count readable and protected ones, and send packets again or changed.

DDS packets are UDP; Zenoh packets are TCP, or TLS over TCP. Zenoh can also use shared memory.

The packet and raw sockets need CAP_NET_RAW in their network: root has this capability, and so does
a process in a network namespace that it created (`sros_tool.runtime.netns`).
"""

from __future__ import annotations

import asyncio
import mmap
import os
import socket
import time
from collections import Counter
from collections.abc import Collection, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Literal, NamedTuple

_ETH_P_ALL = 0x0003
_PACKET_OUTGOING = 4
_UDP, _TCP = 17, 6
_BUFFER_BYTES = 16 * 1024 * 1024
_SO_RCVBUFFORCE = 33

_RTPS_HEADER = 20
_PROTECTED_SUBMESSAGES = range(0x30, 0x35)
"""Ids of SEC_BODY, SEC_PREFIX, SEC_POSTFIX, SRTPS_PREFIX, SRTPS_POSTFIX (DDS-Security 1.1 §7.3.6).
"""


_TLS_DATA = b"\x17\x03\x03"
"""First bytes of a TLS record with application data (RFC 8446 §5.1)."""


class _CapturedPacket(NamedTuple):
    """A captured IPv4 packet, its capture time (CLOCK_MONOTONIC, s), and its UDP source port."""

    time: float
    source: int
    packet: bytes


class PacketCounter:
    """A counter of protected packets, and of packets that contain one of ``marks``.

    ``plain`` has the number of packets by mark.  ``protected`` has the number of packets by port; a
    packet counts for its source port and for its target port.  With ``keep``, ``kept`` has the RTPS
    packets in order.
    """

    def __init__(self, marks: Sequence[str], *, keep: bool = False) -> None:
        self._marks = {mark: mark.encode() for mark in marks}
        self._keep = keep
        self.plain: Counter[str] = Counter()
        self.protected: Counter[int] = Counter()
        self.kept: list[_CapturedPacket] = []

    def count(self, packet: bytes) -> None:
        """Count one packet; packets other than UDP over IPv4 and TCP are ignored."""
        transport, start = _transport(packet)
        if len(packet) < start + 8 or transport not in (_UDP, _TCP):
            return
        source = int.from_bytes(packet[start : start + 2], "big")
        target = int.from_bytes(packet[start + 2 : start + 4], "big")
        if transport == _TCP:
            header = (packet[start + 12] >> 4) * 4 if len(packet) > start + 12 else 20
            payload = packet[start + header :]
        else:
            payload = packet[start + 8 :]
        if self._keep and payload[:4] == b"RTPS":
            self.kept.append(_CapturedPacket(time.monotonic(), source, packet))
        for mark, raw in self._marks.items():
            if raw in payload:
                self.plain[mark] += 1
        is_tls = transport == _TCP and payload.startswith(_TLS_DATA)
        if is_tls or _is_protected(payload):
            self.protected.update({source, target})


class Capture(PacketCounter):
    """A capture on all interfaces that counts packets, and with ``keep`` stores them in memory.

    Raises:
        PermissionError: capturing is not permitted.
    """

    def __init__(self, marks: Sequence[str], *, keep: bool = False) -> None:
        super().__init__(marks, keep=keep)
        self._socket = socket.socket(socket.AF_PACKET, socket.SOCK_DGRAM, socket.htons(_ETH_P_ALL))
        self._socket.setblocking(False)
        try:
            self._socket.setsockopt(socket.SOL_SOCKET, _SO_RCVBUFFORCE, _BUFFER_BYTES)
        except OSError:
            self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _BUFFER_BYTES)

    def fileno(self) -> int:
        """Return the file descriptor of the socket, to wait for packets."""
        return self._socket.fileno()

    def drain(self) -> None:
        """Count all packets that have arrived."""
        while True:
            try:
                packet, address = self._socket.recvfrom(65535)
            except BlockingIOError:
                return
            if address[2] != _PACKET_OUTGOING:
                self.count(packet)

    def close(self) -> None:
        """Stop capturing."""
        self._socket.close()


_IPV6_HEADER = 40


def _transport(packet: bytes) -> tuple[int, int]:
    """Return the transport protocol of an IP packet, and the offset of the transport header.

    The result is (0, 0) for a packet that is neither IPv4 nor TCP over IPv6 without extension
    headers.
    """
    version = packet[0] >> 4 if len(packet) >= 20 else 0
    if version == 4:
        return packet[9], max(20, (packet[0] & 0x0F) * 4)
    if version == 6 and len(packet) > _IPV6_HEADER and packet[6] == _TCP:
        return _TCP, _IPV6_HEADER
    return 0, 0


def _is_protected(payload: bytes) -> bool:
    """Return whether a UDP payload is RTPS with a protected submessage (RTPS 2.3 §9.4)."""
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


def bound_ports(pid: int) -> frozenset[int]:
    """Return the UDP and TCP ports of a process (from /proc); empty for an ended process."""
    folder = Path(f"/proc/{pid}")
    try:
        links = list((folder / "fd").iterdir())
        lines = [
            line
            for table in ("udp", "tcp", "tcp6")
            if (folder / "net" / table).exists()
            for line in (folder / "net" / table).read_text(encoding="ascii").splitlines()[1:]
        ]
    except OSError:
        return frozenset()
    inodes = {_socket_inode(link) for link in links}
    rows = [line.split() for line in lines]
    return frozenset(int(row[1].partition(":")[2], 16) for row in rows if row[9] in inodes)


def _socket_inode(link: Path) -> str:
    try:
        target = str(link.readlink())
    except OSError:
        return ""  # the descriptor was closed meanwhile
    return target.removeprefix("socket:[").removesuffix("]") if target[:8] == "socket:[" else ""


_SHARED_MEMORY = "/dev/shm/"  # noqa: S108 - the segments of the demo's own processes
_LARGEST_SEGMENT = 1 << 28


def mapped_segments(pid: int) -> frozenset[Path]:
    """Return the shared memory segments that a process maps; empty for a process that has ended."""
    try:
        lines = Path(f"/proc/{pid}/maps").read_text("utf-8", "surrogateescape").splitlines()
    except OSError:
        return frozenset()
    names = (line.split(maxsplit=5)[5:] for line in lines)
    return frozenset(Path(name[0]) for name in names if name and name[0].startswith(_SHARED_MEMORY))


def segments_with_text(texts: Mapping[str, str], segments: Collection[Path]) -> dict[str, int]:
    """Map each party to the number of shared memory segments that contain the party's text.

    ``texts`` maps parties to their texts ("": none).
    """
    return {
        name: sum(_contains_text(path, text) for path in segments) if text else 0
        for name, text in texts.items()
    }


def _contains_text(path: Path, text: str) -> bool:
    try:
        with path.open("rb") as file:
            size = os.fstat(file.fileno()).st_size
            if not 0 < size <= _LARGEST_SEGMENT:
                return False
            with mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as segment:
                return segment.find(text.encode()) >= 0
    except (OSError, ValueError):
        return False


_Order = Literal["little", "big"]
_DATA_SUBMESSAGE = 0x15
_SEQUENCE_NUMBER = 20
"""Offset of the sequence number's low half from the start of a DATA submessage, in bytes."""


class _Injector:
    """A sender of whole IPv4 packets with their original source address.

    A packet socket cannot be used: the kernel would drop packets with loopback addresses.

    Raises:
        PermissionError: the process lacks CAP_NET_RAW.
    """

    def __init__(self) -> None:
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_RAW, socket.IPPROTO_RAW)

    def send(self, packet: bytes) -> None:
        """Send one packet without UDP checksum: the kernel adds none to loopback packets."""
        self._socket.sendto(without_checksum(packet), (socket.inet_ntoa(packet[16:20]), 0))

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()


def packets_of(packets: Sequence[_CapturedPacket], ports: Collection[int]) -> list[_CapturedPacket]:
    """Return the captured packets that were sent from one of ``ports``, in order."""
    return [packet for packet in packets if packet.source in ports]


def with_changed_bit(packet: bytes, later: int, place: int, places: int) -> bytes | None:
    """Return a copy of an RTPS packet with one bit changed; None if the packet has no content.

    The bit is in the middle of part ``place`` (from 0), if the content is divided into ``places``
    equal parts.

    An attacker without keys can change encrypted packets in the same way.  The sequence number of a
    readable DATA submessage is raised by ``later``, so that a DataReader takes it for a later
    message of the writer (RTPS 2.3 §9.4.5.3).
    """
    begin = (packet[0] & 0x0F) * 4 + 8 + _RTPS_HEADER
    if len(packet) <= begin:
        return None
    changed = bytearray(packet)
    for position, end, order in _submessages(packet):
        if packet[position] == _DATA_SUBMESSAGE and end >= position + _SEQUENCE_NUMBER + 4:
            _raise_number(changed, position, order, later)
    changed[begin + (2 * place + 1) * (len(packet) - begin) // (2 * places)] ^= 1
    return bytes(changed)


def _raise_number(packet: bytearray, position: int, order: _Order, step: int) -> None:
    """Raise the sequence number of the DATA submessage at ``position`` by ``step``."""
    number = slice(position + _SEQUENCE_NUMBER, position + _SEQUENCE_NUMBER + 4)
    raised = int.from_bytes(packet[number], order) + step
    packet[number] = (raised & 0xFFFFFFFF).to_bytes(4, order)


def _submessages(packet: bytes) -> Iterator[tuple[int, int, _Order]]:
    """Yield the start, the end and the byte order of each submessage (RTPS 2.3 §9.4.5)."""
    position = (packet[0] & 0x0F) * 4 + 8 + _RTPS_HEADER
    while position + 4 <= len(packet):
        order: _Order = "little" if packet[position + 1] & 1 else "big"
        length = int.from_bytes(packet[position + 2 : position + 4], order)
        end = position + 4 + length if length else len(packet)
        yield position, end, order
        position = end


def without_checksum(packet: bytes) -> bytes:
    """Return a UDP packet with checksum 0, which means none (RFC 768)."""
    start = (packet[0] & 0x0F) * 4 + 6
    return packet[:start] + b"\0\0" + packet[start + 2 :]


_CERTIFICATE = "-----BEGIN CERTIFICATE-----"


class Wiretap:
    """A capture of the packets of a demo row; ``problem`` says why it is not permitted, or "".

    ``texts`` maps parties to their texts; ``topic`` is the topic in the form of packets. With
    ``replayed``, packets are kept, and can be sent again or changed.  The capture starts
    immediately, so create a wiretap in the network of the row, and in a running asyncio loop.
    """

    def __init__(self, texts: Mapping[str, str], topic: str, *, replayed: bool) -> None:
        self._texts = texts
        self._topic = topic
        self.problem = ""
        self._capture: Capture | None = None
        self._injector: _Injector | None = None
        try:
            self._capture = Capture([*texts.values(), topic, _CERTIFICATE], keep=replayed)
            self._injector = _Injector() if replayed else None
        except OSError as error:
            self.problem = f"capturing packets needs root or CAP_NET_RAW: {error.strerror}"
            self.close()
            return
        asyncio.get_running_loop().add_reader(self._capture.fileno(), self._capture.drain)

    def count(self, ports: Collection[int]) -> dict[str, WireCount]:
        """Return the counts by party so far; protected packets count only for ``ports``."""
        if self._capture is None:
            return {}
        self._capture.drain()
        plain = self._capture.plain
        protected = sum(self._capture.protected[port] for port in ports)
        return {
            name: WireCount(plain[text], protected, plain[self._topic], plain[_CERTIFICATE])
            for name, text in self._texts.items()
        }

    def packets(self, ports: Collection[int]) -> list[_CapturedPacket]:
        """Return the packets that were sent from one of ``ports`` so far, in order."""
        if self._capture is None:
            return []
        self._capture.drain()
        return packets_of(self._capture.kept, ports)

    def send(self, packet: bytes) -> None:
        """Send a captured or changed packet."""
        if self._injector is not None:
            self._injector.send(packet)

    def close(self) -> None:
        """Stop capturing."""
        if self._capture is not None:
            asyncio.get_running_loop().remove_reader(self._capture.fileno())
            self._capture.close()
        if self._injector is not None:
            self._injector.close()
        self._capture = self._injector = None


class WireCount(NamedTuple):
    """The number of packets with a talker's text, and of protected packets in the talker's row.

    ``topics`` and ``certificates`` count the packets of the row that show the topic name, and a
    certificate.
    """

    plain: int
    protected: int
    topics: int = 0
    certificates: int = 0


class Injection(NamedTuple):
    """The number of packets sent again or changed, and when sending began (CLOCK_MONOTONIC, s)."""

    packets: int
    time: float
