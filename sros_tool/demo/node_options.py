"""The command line of the demo's nodes, the same on rclpy and on Cyclone DDS."""

from __future__ import annotations

import argparse
import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from pathlib import Path

_COMPOSED_SERVICE = "/add_two_ints"

FIBONACCI_ORDER = 5
"""The order of the sequence that an action client requests in each goal."""


@dataclass(frozen=True)
class NodeOptions:
    """The options of a node.

    ``topic`` is the ROS name of the role's topic, service or action.  ``period`` is in seconds.
    ``text`` is sent in messages, and identifies a server.  ``server`` is the text of the action
    server that an action client uses ("": unknown).  ``also`` are further topics for an observer.
    On Zenoh, messages of a talker have ``size`` bytes or more, and ``patience`` is how long a
    process waits for its connection, in seconds.
    """

    role: str
    topic: str = "chatter"
    period: float = 0.5
    text: str = "Hello World"
    report: Path | None = None
    server: str = ""
    also: tuple[str, ...] = ()
    size: int = 0
    patience: float = 60.0

    @property
    def service(self) -> str:
        """The ROS service of the role; for a container, a fixed name."""
        return self.topic if self.role in ("server", "client") else _COMPOSED_SERVICE


def parse_options(module: str, roles: Collection[str], arguments: Sequence[str]) -> NodeOptions:
    """Return the options on the command line of ``python -m module``, without ``--ros-args``.

    Exits with status 2 on an error.
    """
    parser = argparse.ArgumentParser(
        prog=f"python -m {module}", description="Run a node in one role of the demo until stopped."
    )
    parser.add_argument("role", choices=tuple(roles))
    parser.add_argument(
        "--topic",
        default=NodeOptions.topic,
        help="ROS name of the topic, service or action (default: %(default)s)",
    )
    parser.add_argument(
        "--period",
        type=_positive,
        default=NodeOptions.period,
        metavar="SECONDS",
        help="time between two messages, requests, goals or counts (default: %(default)s)",
    )
    parser.add_argument(
        "--text",
        default=NodeOptions.text,
        help="text of a talker or server, sent before a number (default: %(default)s)",
    )
    parser.add_argument(
        "--server", default="", help="text of the only action server, for an action client"
    )
    parser.add_argument(
        "--also",
        action="append",
        default=[],
        help="another topic whose publishers an observer counts",
    )
    parser.add_argument(
        "--size", type=int, default=NodeOptions.size, help="bytes of a message on Zenoh, at least"
    )
    parser.add_argument(
        "--patience",
        type=_positive,
        default=NodeOptions.patience,
        metavar="SECONDS",
        help="time to wait for a connection on Zenoh (default: %(default)s)",
    )
    parser.add_argument(
        "--report", type=Path, metavar="FILE", help="append the events to FILE as JSON lines"
    )
    own, _ = split_ros_args(arguments)
    parsed = vars(parser.parse_args(own))
    return NodeOptions(**{**parsed, "also": tuple(parsed["also"])})


def split_ros_args(arguments: Sequence[str]) -> tuple[list[str], list[str]]:
    """Return the arguments outside and inside ``--ros-args ... --``."""
    own: list[str] = []
    ros: list[str] = []
    target = own
    for argument in arguments:
        if argument == "--ros-args":
            target = ros
        elif argument == "--" and target is ros:
            target = own
        else:
            target.append(argument)
    return own, ros


def _positive(text: str) -> float:
    value = float(text)
    if not (math.isfinite(value) and value > 0):
        raise ValueError(text)
    return value


def fibonacci(order: int) -> list[int]:
    """Return the Fibonacci sequence from 0 and 1 up to index ``order``."""
    sequence = [0, 1]
    while len(sequence) <= order:
        sequence.append(sequence[-1] + sequence[-2])
    return sequence[: order + 1]
