"""The command line of the demo's nodes, the same on rclpy and on Cyclone DDS."""

from __future__ import annotations

import argparse
import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from pathlib import Path

_COMPOSED_SERVICE = "/add_two_ints"

FIBONACCI_ORDER = 5
"""The order that every goal of an action client asks for."""


@dataclass(frozen=True)
class NodeOptions:
    """The options of a node.

    ``topic`` is the ROS name of the role's topic, service or action.  ``period`` is in seconds.
    ``server`` is the text of the only action server ("": not known); ``also`` are further topics
    for an observer.
    """

    role: str
    topic: str = "chatter"
    period: float = 0.5
    text: str = "Hello World"
    report: Path | None = None
    server: str = ""
    also: tuple[str, ...] = ()

    @property
    def service(self) -> str:
        """The ROS service of the role; for a container, a fixed name."""
        return self.topic if self.role in ("server", "client") else _COMPOSED_SERVICE


def parse_options(module: str, roles: Collection[str], arguments: Sequence[str]) -> NodeOptions:
    """Return the options on the command line of ``python -m module``, without ``--ros-args``.

    Exits with status 2 on an error.
    """
    parser = argparse.ArgumentParser(
        prog=f"python -m {module}", description="Play one role of the demo until stopped."
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
        help="time between two messages, requests, goals or looks (default: %(default)s)",
    )
    parser.add_argument(
        "--text",
        default=NodeOptions.text,
        help="what a talker or server says before the number (default: %(default)s)",
    )
    parser.add_argument(
        "--server", default="", help="what the only server of an action client says"
    )
    parser.add_argument(
        "--also", action="append", default=[], help="one more topic that an observer looks at"
    )
    parser.add_argument(
        "--report", type=Path, metavar="FILE", help="append what happens to FILE as JSON lines"
    )
    own, _ = split_ros_args(arguments)
    parsed = vars(parser.parse_args(own))
    return NodeOptions(**{**parsed, "also": tuple(parsed["also"])})


def split_ros_args(arguments: Sequence[str]) -> tuple[list[str], list[str]]:
    """Return a node's own arguments, and those between ``--ros-args`` and ``--``."""
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
    """Return the Fibonacci numbers up to that order, from 0 and 1."""
    sequence = [0, 1]
    while len(sequence) <= order:
        sequence.append(sequence[-1] + sequence[-2])
    return sequence[: order + 1]
