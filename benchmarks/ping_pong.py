"""One end of a measurement: ``python -m benchmarks.ping_pong cyclone|rclpy ping|pong``.

``ping`` measures, and writes the numbers as JSON; ``pong`` answers.  The first letter of a message
is its kind: "h" (hello) asks when the other end began to join, "e" (echo) is sent back unchanged,
"b" is part of a burst, and "l" (last) ends a burst and gets a short reply.  Both read the
environment of a ROS 2 node; all numbers include the overhead of Python, which is the same with and
without security.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from sros_tool.errors import SrosError, UnavailableError

ENDS = ("pong", "ping")
TOPICS = ("/cost_ping", "/cost_pong")
"""The topics that ping and pong write."""

_PING, _PONG = TOPICS
_DEPTH = 10
_BURST = 8  # less than the history depth, so that no message is overwritten
_BURST_BYTES = 128 * 1024  # less than the default buffer of a socket, if possible
_ASK_AGAIN = 0.005
_LOST = 2.0


@dataclass(frozen=True)
class _Channel:
    """The connection between the two ends, as one end uses it.

    ``wait`` waits for a message, at most the given seconds; ``take`` returns the messages received
    since its last call, oldest first.
    """

    write: Callable[[str], None]
    wait: Callable[[float], bool]
    take: Callable[[], Sequence[str]]


@contextmanager
def _cyclone_channel(sends: str, hears: str) -> Iterator[_Channel]:
    from sros_tool.runtime.cyclone import Participant
    from sros_tool.runtime.variables import choose_loadable, domain_of

    choice = choose_loadable(os.environ)
    with Participant(domain_of(os.environ), choice.enclave) as participant:
        reader, writer = participant.reader(f"rt{hears}"), participant.writer(f"rt{sends}")
        yield _Channel(writer.write, reader.wait, reader.take)


@contextmanager
def _rclpy_channel(sends: str, hears: str) -> Iterator[_Channel]:
    try:
        import rclpy
        from rclpy.executors import SingleThreadedExecutor
        from std_msgs.msg import String
    except ImportError as error:
        raise UnavailableError(
            "rclpy cannot be loaded", f"{error}.", "Source the setup file of ROS 2."
        ) from error
    rclpy.init(args=[])
    node = rclpy.create_node("cost")
    heard: list[str] = []
    publisher = node.create_publisher(String, sends, _DEPTH)
    node.create_subscription(String, hears, lambda message: heard.append(message.data), _DEPTH)
    executor = SingleThreadedExecutor()
    executor.add_node(node)

    def wait(seconds: float) -> bool:
        end = time.monotonic() + seconds
        while not heard and (left := end - time.monotonic()) > 0:
            executor.spin_once(left)
        return bool(heard)

    def take() -> Sequence[str]:
        taken = heard[:]
        heard.clear()
        return taken

    yield _Channel(lambda text: publisher.publish(String(data=text)), wait, take)


_CHANNELS = {"cyclone": _cyclone_channel, "rclpy": _rclpy_channel}


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure, or answer until the parent ends; return the exit status."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.ping_pong")
    parser.add_argument("library", choices=_CHANNELS)
    parser.add_argument("role", choices=ENDS)
    parser.add_argument("--sizes", type=int, nargs="*", default=[], help="payloads in bytes")
    parser.add_argument("--seconds", type=float, default=0.5, help="duration of each measurement")
    parser.add_argument("--answer", type=Path, help="file to which ping writes its JSON")
    options = parser.parse_args(arguments)
    begin = time.monotonic()
    try:
        sends, hears = (_PONG, _PING) if options.role == "pong" else (_PING, _PONG)
        with _CHANNELS[options.library](sends, hears) as channel:
            if options.role == "pong":
                _answer(channel, begin)
            measured = _measure(channel, begin, options.sizes, options.seconds)
    except SrosError as error:
        print(error, file=sys.stderr)
        return 1
    options.answer.write_text(json.dumps(measured), encoding="utf-8")
    return 0


def _answer(channel: _Channel, begin: float) -> None:
    while True:
        channel.wait(1.0)
        for text in channel.take():
            if text[0] == "h":
                channel.write(f"h{begin:.6f}")
            elif text[0] == "e":
                channel.write(text)
            elif text[0] == "l":
                channel.write("l")


def _measure(
    channel: _Channel, begin: float, sizes: Sequence[int], seconds: float
) -> dict[str, Any]:
    other = ""
    while not other:
        channel.write("h")
        channel.wait(_ASK_AGAIN)
        other = next(iter(channel.take()), "")
    first = time.monotonic() - max(begin, float(other[1:]))
    while channel.wait(0.3):
        channel.take()  # further answers to "h"
    found = []
    for size in sizes:
        latency = _latency(channel, size, seconds)
        rate = _throughput(channel, size, seconds)
        found.append({"size": size, "latency": latency, "rate": rate})
    return {"first": first, "sizes": found}


def _latency(channel: _Channel, size: int, seconds: float) -> float:
    """Return half of the median round trip of a message of ``size`` bytes, in seconds."""
    text = "e".ljust(size, "x")
    times: list[float] = []
    end = time.monotonic() + seconds
    while (start := time.monotonic()) < end or not times:
        channel.write(text)
        _await(channel)
        times.append(time.monotonic() - start)
    return statistics.median(times) / 2


def _throughput(channel: _Channel, size: int, seconds: float) -> float:
    """Return the messages per second in the median burst; a burst ends with an answer."""
    burst = max(1, min(_BURST, _BURST_BYTES // size))
    texts = [*["b".ljust(size, "x")] * (burst - 1), "l".ljust(size, "x")]
    times: list[float] = []
    end = time.monotonic() + seconds
    while (start := time.monotonic()) < end or not times:
        for text in texts:
            channel.write(text)
        _await(channel)
        times.append(time.monotonic() - start)
    return burst / statistics.median(times)


def _await(channel: _Channel) -> None:
    """Wait for an answer.

    Raises:
        SrosError: no answer came within `_LOST` seconds, although messages are reliable.
    """
    if not channel.wait(_LOST):
        raise SrosError("an answer was lost", f"It did not come within {_LOST} s.")
    channel.take()


if __name__ == "__main__":
    sys.exit(main())
