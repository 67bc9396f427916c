"""Packets that are sent again: without a checksum, and changed."""

from __future__ import annotations

import struct

import pytest

from sros_tool.demo.wire import PacketCounter, packets_of, with_changed_bit, without_checksum
from tests.demo.test_demo_capture import packet

WORDS = "Hello World from the talker"


def data(text: str, number: int, order: str = "<") -> bytes:
    """RTPS with INFO_TS, and DATA with a sequence number (RTPS 2.3 9.4.5.3)."""
    flags = 5 if order == "<" else 4
    body = struct.pack(f"{order}HH", 0, 16) + b"RRRR" + b"WWWW"
    body += struct.pack(f"{order}iI", 0, number) + b"\0\1\0\0" + text.encode()
    timestamp = struct.pack(f"{order}BBH", 0x09, flags, 8) + bytes(8)
    head = struct.pack(f"{order}BBH", 0x15, flags, len(body))
    return b"RTPS\x02\x01" + bytes(14) + timestamp + head + body


def test_the_checksum_goes_and_nothing_else() -> None:
    whole = bytearray(packet(data(WORDS, 7)))
    whole[26:28] = b"\x12\x34"
    assert without_checksum(bytes(whole)) == packet(data(WORDS, 7))


@pytest.mark.parametrize("order", ["<", ">"])
def test_another_bit_in_each_place_under_a_later_number(order: str) -> None:
    later = packet(data(f"{WORDS}: 1", 10, order))
    found = [
        with_changed_bit(packet(data(f"{WORDS}: 1", 7, order)), 3, place, 8) for place in range(8)
    ]
    places = [
        [at for at, pair in enumerate(zip(each or b"", later, strict=True)) if len(set(pair)) == 2]
        for each in found
    ]
    assert all(len(each) == 1 for each in places)
    assert len({each[0] for each in places}) == 8
    assert min(each[0] for each in places) >= 48, "behind the headers of IP, UDP and RTPS"
    assert sum(WORDS.encode() not in (each or b"") for each in found) > 1


@pytest.mark.parametrize(
    ("payload", "changed"),
    [(b"RTPS" + bytes(16), False), (b"", False), (data(WORDS, 7)[:40], True)],
)
def test_packets_with_little_in_them(payload: bytes, changed: bool) -> None:
    assert bool(with_changed_bit(packet(payload), 1, 0, 8)) is changed


def test_packets_are_kept_in_order_and_found_by_port() -> None:
    counter = PacketCounter([], keep=True)
    first, second = packet(data("a", 1), source=7001), packet(data("b", 2), source=7002)
    for each in (first, second, packet(b"not RTPS", source=7001), first):
        counter.count(each)
    assert [each.packet for each in packets_of(counter.kept, {7001})] == [first, first]
    assert [each.packet for each in packets_of(counter.kept, {7001, 7002})] == [
        *(first, second, first)
    ]
