"""Send captured packets again, as anybody could who was on the same network."""

from __future__ import annotations

import socket
from collections.abc import Collection, Sequence

_ETH_P_IP = 0x0800
_LOOPBACK = "lo"


class Injector:
    """Sends whole IPv4 packets over the loopback interface; needs CAP_NET_RAW.

    Raises `PermissionError` where it is not permitted.
    """

    def __init__(self) -> None:
        self._socket = socket.socket(socket.AF_PACKET, socket.SOCK_DGRAM, 0)

    def send(self, packet: bytes) -> None:
        """Send one packet as it is, but for the checksum, which the loopback never filled in."""
        self._socket.sendto(without_checksum(packet), (_LOOPBACK, _ETH_P_IP))

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()


def packets_of(kept: Sequence[tuple[int, bytes]], ports: Collection[int]) -> list[bytes]:
    """The captured packets that were sent from one of the ports, in order."""
    return [packet for source, packet in kept if source in ports]


def without_checksum(packet: bytes) -> bytes:
    """A UDP packet whose checksum says that there is none (RFC 768: zero)."""
    start = (packet[0] & 0x0F) * 4 + 6
    return packet[:start] + b"\0\0" + packet[start + 2 :]
