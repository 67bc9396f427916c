"""Send captured packets again, as anybody could who was on the same network."""

from __future__ import annotations

import socket
from collections.abc import Collection, Sequence

from sros_tool.demo.capture import Kept


class Injector:
    """Sends whole IPv4 packets under the address they came from; needs CAP_NET_RAW.

    A packet socket would not do: the kernel drops loopback addresses that come in by one.
    Raises `PermissionError` where it is not permitted.
    """

    def __init__(self) -> None:
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_RAW, socket.IPPROTO_RAW)

    def send(self, packet: bytes) -> None:
        """Send one packet as it is, but for the checksum, which the loopback never filled in."""
        self._socket.sendto(without_checksum(packet), (socket.inet_ntoa(packet[16:20]), 0))

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()


def packets_of(kept: Sequence[Kept], ports: Collection[int]) -> list[Kept]:
    """The captured packets that were sent from one of the ports, in order."""
    return [each for each in kept if each.source in ports]


def without_checksum(packet: bytes) -> bytes:
    """A UDP packet whose checksum says that there is none (RFC 768: zero)."""
    start = (packet[0] & 0x0F) * 4 + 6
    return packet[:start] + b"\0\0" + packet[start + 2 :]
