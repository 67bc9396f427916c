"""Send captured packets again, as anybody could who was on the same network."""

from __future__ import annotations

import socket
from collections.abc import Collection, Sequence
from typing import Literal

from sros_tool.demo.capture import Kept

_RTPS_HEADER, _DATA = 20, 0x15
_NUMBER = 20
"""From the head of a DATA submessage to the low half of its sequence number."""


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


def with_other_words(packet: bytes, words: str, others: str, step: int) -> bytes | None:
    """An RTPS packet that says something else of the same length, ``step`` messages later.

    The sequence number of the DATA submessage that holds ``words`` is raised, so that a reader
    takes it for the writer's next one (RTPS 2.3 §9.4.5.3).  None where no words are readable.
    """
    start = (packet[0] & 0x0F) * 4 + 8
    position = start + _RTPS_HEADER
    changed = bytearray(packet)
    while position + 4 <= len(packet):
        kind, flags = packet[position], packet[position + 1]
        order: Literal["little", "big"] = "little" if flags & 1 else "big"
        length = int.from_bytes(packet[position + 2 : position + 4], order)
        end = position + 4 + length if length else len(packet)
        place = packet.find(words.encode(), position, end)
        if kind == _DATA and place >= 0:
            number = slice(position + _NUMBER, position + _NUMBER + 4)
            raised = int.from_bytes(packet[number], order) + step
            changed[number] = raised.to_bytes(4, order)
            changed[place : place + len(others.encode())] = others.encode()
            return bytes(changed)
        position = end
    return None


def without_checksum(packet: bytes) -> bytes:
    """A UDP packet whose checksum says that there is none (RFC 768: zero)."""
    start = (packet[0] & 0x0F) * 4 + 6
    return packet[:start] + b"\0\0" + packet[start + 2 :]
