"""Packets that are sent again: without a checksum, and with other words in the same place."""

from __future__ import annotations

import struct

import pytest

from sros_tool.demo.wire import (
    PacketCounter,
    forged_text,
    packets_of,
    with_replaced_text,
    without_checksum,
)
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
def test_other_words_under_a_later_number(order: str) -> None:
    others = forged_text(WORDS)
    assert len(others) == len(WORDS)
    assert others != WORDS
    changed = with_replaced_text(packet(data(f"{WORDS}: 1", 7, order)), WORDS, others, 3)
    assert changed == packet(data(f"{others}: 1", 10, order))


@pytest.mark.parametrize(
    "payload", [data("nothing of it", 7), b"RTPS" + bytes(16), b"", data(WORDS, 7)[:40]]
)
def test_packets_that_do_not_say_it(payload: bytes) -> None:
    assert with_replaced_text(packet(payload), WORDS, forged_text(WORDS), 1) is None


def test_packets_are_kept_in_order_and_found_by_port() -> None:
    counter = PacketCounter([], keep=True)
    first, second = packet(data("a", 1), source=7001), packet(data("b", 2), source=7002)
    for each in (first, second, packet(b"not RTPS", source=7001), first):
        counter.count(each)
    assert [each.packet for each in packets_of(counter.kept, {7001})] == [first, first]
    assert [each.packet for each in packets_of(counter.kept, {7001, 7002})] == [
        *(first, second, first)
    ]
