"""The capture's reading of packets."""

from __future__ import annotations

import os
import socket
import struct

import pytest

from sros_tool.demo.wire import PacketCounter, bound_ports


def packet(payload: bytes, source: int = 7000, target: int = 7410, protocol: int = 17) -> bytes:
    udp = struct.pack("!HHHH", source, target, 8 + len(payload), 0) + payload
    head = bytes([0x45, 0]) + struct.pack("!H", 20 + len(udp)) + bytes(5)
    return head + bytes([protocol]) + bytes(10) + udp


def rtps(*submessages: tuple[int, bytes]) -> bytes:
    body = b"".join(struct.pack("<BBH", kind, 1, len(data)) + data for kind, data in submessages)
    return b"RTPS\x02\x01" + bytes(14) + body


@pytest.fixture
def capture() -> PacketCounter:
    return PacketCounter(["Hello 1", "Hello 2"])


def test_readable_text(capture: PacketCounter) -> None:
    capture.count(packet(rtps((0x15, b"....Hello 1: 7"))))
    assert (capture.plain["Hello 1"], capture.plain["Hello 2"]) == (1, 0)
    assert not capture.protected


@pytest.mark.parametrize("kind", [0x30, 0x31, 0x33])
def test_protected_submessages(capture: PacketCounter, kind: int) -> None:
    capture.count(packet(rtps((0x09, bytes(8)), (kind, bytes(16)))))
    assert capture.protected == {7000: 1, 7410: 1}
    assert not capture.plain


@pytest.mark.parametrize(
    "raw",
    [
        b"\x45",
        packet(b""),
        packet(b"RTPS"),
        packet(rtps((0x15, b"....")), protocol=6),
        packet(b"x" * 20 + b"\x33\x01\x04\x00abcd"),
        packet(rtps((0x01, b""), (0x33, b"abcd"))),
    ],
)
def test_what_is_neither(capture: PacketCounter, raw: bytes) -> None:
    capture.count(raw)
    assert not capture.protected
    assert not capture.plain


def test_ports_of_a_process() -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as bound:
        bound.bind(("127.0.0.1", 0))
        port = bound.getsockname()[1]
        assert port in bound_ports(os.getpid())
    assert port not in bound_ports(os.getpid())
