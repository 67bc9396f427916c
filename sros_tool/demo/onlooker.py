"""What an onlooker on the network does with packets that he has seen: replay them, change them."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Collection

from sros_tool.demo.launch import PartyProcess
from sros_tool.demo.records import Replay, forged_text
from sros_tool.demo.replay import with_other_words
from sros_tool.demo.wiretap import Wiretap

_TICK = 0.05
_GRACE = 0.3
_SECONDS_TO_END = 2.0
_AFTER_REPLAY = 2.0
_LONGEST_PAUSE = 0.5
_ROUNDS = 2
_FORGED = 5
_AFTER_FORGERY = 1.0


async def replay_packets(talker: PartyProcess, tap: Wiretap) -> Replay:
    """Let a talker leave, then send again what it had sent, at the pace of the original."""
    packets = tap.packets(talker.ports())
    await end_softly([talker])
    await asyncio.sleep(_GRACE)
    started = time.monotonic()
    # Twice, since the listener may take from the first round only who there is to hear.
    for _ in range(_ROUNDS):
        for before, each in zip([*packets[:1], *packets], packets, strict=False):
            await asyncio.sleep(min(each.time - before.time, _LONGEST_PAUSE))
            tap.send(each.packet)
    await asyncio.sleep(_AFTER_REPLAY)
    return Replay(len(packets), started)


async def forge_packets(talker: PartyProcess, tap: Wiretap) -> Replay:
    """Hold a talker, and go on in its name with packets that say something else."""
    talker.hold()
    await asyncio.sleep(_GRACE)
    words, others = talker.text, forged_text(talker.text)
    packets = [each.packet for each in reversed(tap.packets(talker.ports()))]
    last = next((each for each in packets if with_other_words(each, words, others, 1)), b"")
    started = time.monotonic()
    steps = range(1, _FORGED + 1) if last else ()
    sent = [each for step in steps if (each := with_other_words(last, words, others, step))]
    for packet in sent:
        tap.send(packet)
    await asyncio.sleep(_AFTER_FORGERY)
    return Replay(len(sent), started)


async def end_softly(processes: Collection[PartyProcess]) -> None:
    """Let processes end by themselves, for a while; they log and report until then."""
    for process in processes:
        process.ask_to_end()
    latest = time.monotonic() + _SECONDS_TO_END
    while time.monotonic() < latest and not all(process.gone for process in processes):
        await asyncio.sleep(_TICK)
