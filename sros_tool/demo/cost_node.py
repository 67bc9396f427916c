"""One end of a measurement over Cyclone DDS: ``python -m sros_tool.demo.cost_node ping|pong``.

``pong`` sends back what it gets: whole messages that begin with "e", and a short receipt for the
last one of each burst, "b".  ``ping`` measures, and writes what it found as JSON.  Both read the
environment of a ROS 2 node; what they cost in Python and ctypes is the same with and without
security, and is in all numbers.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from sros_tool.errors import SrosError
from sros_tool.runtime.cyclone import Participant, Reader, Writer
from sros_tool.runtime.rcl_security import choose_loadable, domain_of

_PING, _PONG = "rt/cost_ping", "rt/cost_pong"
_BURST = 8  # below the depth of the history, so that nothing is overwritten before it is sent
_BURST_BYTES = 128 * 1024  # and below what a socket holds by default, where a payload allows it
_ASK_AGAIN = 0.005
_LOST = 2.0


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure, or answer until there is no parent any more; returns the exit status."""
    parser = argparse.ArgumentParser(prog="python -m sros_tool.demo.cost_node")
    parser.add_argument("role", choices=("ping", "pong"))
    parser.add_argument("--sizes", type=int, nargs="*", default=[], help="payloads in bytes")
    parser.add_argument("--seconds", type=float, default=0.5, help="for each measurement")
    parser.add_argument("--answer", type=Path, help="where ping writes its JSON")
    options = parser.parse_args(arguments)
    begin = time.monotonic()
    try:
        choice = choose_loadable(os.environ)
        with Participant(domain_of(os.environ), choice.enclave) as participant:
            if options.role == "pong":
                _answer(participant.reader(_PING), participant.writer(_PONG), begin)
            measured = _measure(
                participant.writer(_PING),
                participant.reader(_PONG),
                begin,
                options.sizes,
                options.seconds,
            )
    except SrosError as error:
        print(error, file=sys.stderr)
        return 1
    options.answer.write_text(json.dumps(measured), encoding="utf-8")
    return 0


def _answer(reader: Reader, writer: Writer, begin: float) -> None:
    while True:
        reader.wait(1.0)
        for text in reader.take():
            if text[0] == "h":
                writer.write(f"h{begin:.6f}")
            elif text[0] == "e":
                writer.write(text)
            elif text[0] == "l":
                writer.write("l")


def _measure(
    writer: Writer, reader: Reader, begin: float, sizes: Sequence[int], seconds: float
) -> dict[str, Any]:
    other = ""
    while not other:
        writer.write("h")
        reader.wait(_ASK_AGAIN)
        other = next(iter(reader.take()), "")
    first = time.monotonic() - max(begin, float(other[1:]))
    while reader.wait(0.3):
        reader.take()  # further answers to "h"
    found = []
    for size in sizes:
        latency = _latency(writer, reader, size, seconds)
        rate = _throughput(writer, reader, size, seconds)
        found.append({"size": size, "latency": latency, "rate": rate})
    return {"first": first, "sizes": found}


def _latency(writer: Writer, reader: Reader, size: int, seconds: float) -> float:
    """Half of the median round trip of a message of ``size`` bytes, in seconds."""
    text = "e".ljust(size, "x")
    times: list[float] = []
    end = time.monotonic() + seconds
    while (start := time.monotonic()) < end or not times:
        writer.write(text)
        _await(reader)
        times.append(time.monotonic() - start)
    return statistics.median(times) / 2


def _throughput(writer: Writer, reader: Reader, size: int, seconds: float) -> float:
    """Messages per second in the median burst; each burst is waited for."""
    burst = max(1, min(_BURST, _BURST_BYTES // size))
    texts = [*["b".ljust(size, "x")] * (burst - 1), "l".ljust(size, "x")]
    times: list[float] = []
    end = time.monotonic() + seconds
    while (start := time.monotonic()) < end or not times:
        for text in texts:
            writer.write(text)
        _await(reader)
        times.append(time.monotonic() - start)
    return burst / statistics.median(times)


def _await(reader: Reader) -> None:
    """Wait for an answer; raises `SrosError` where a reliable one does not come."""
    if not reader.wait(_LOST):
        raise SrosError("an answer was lost", f"It did not come within {_LOST} s.")
    reader.take()


if __name__ == "__main__":
    sys.exit(main())
