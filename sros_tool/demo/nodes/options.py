"""The options that every demo node takes, whatever DDS it runs on."""

from __future__ import annotations

import argparse
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

DEFAULT_TEXT = "Hello World"
DEFAULT_TOPIC = "chatter"
DEFAULT_PERIOD = 0.5
DEFAULT_SERVICE = "/add_two_ints"


@dataclass(frozen=True)
class NodeOptions:
    """What a node was asked to do; ``period`` is in seconds.

    ``topic`` is also the name of an action; ``service`` that of a service.
    """

    topic: str
    period: float
    text: str
    report: Path | None
    service: str = DEFAULT_SERVICE


def option_parser(program: str, description: str) -> argparse.ArgumentParser:
    """A parser of the common options; a caller may add its own."""
    parser = argparse.ArgumentParser(prog=f"python -m {program}", description=description)
    parser.add_argument("--topic", default=DEFAULT_TOPIC, help="ROS name (default: %(default)s)")
    parser.add_argument(
        "--period",
        type=_positive,
        default=DEFAULT_PERIOD,
        metavar="SECONDS",
        help="time between two messages of a talker (default: %(default)s)",
    )
    parser.add_argument(
        "--text", default=DEFAULT_TEXT, help="what a talker says before the number (%(default)s)"
    )
    parser.add_argument("--server", default="", help="what the server of an action client says")
    parser.add_argument(
        "--report", type=Path, metavar="FILE", help="append what happens to FILE as JSON lines"
    )
    return parser


def node_options(program: str, description: str, arguments: Sequence[str]) -> NodeOptions:
    """Parse the arguments that are left without ``--ros-args``; exits with status 2 on an error."""
    return options_of(option_parser(program, description).parse_args(arguments))


def options_of(parsed: argparse.Namespace, role: str = "") -> NodeOptions:
    """The common options of a command line that was parsed.

    The topic of a server or client is its service; composed nodes serve the default one.
    """
    service = parsed.topic if role in ("server", "client") else DEFAULT_SERVICE
    return NodeOptions(parsed.topic, parsed.period, parsed.text, parsed.report, service)


def split_ros_args(arguments: Sequence[str]) -> tuple[list[str], list[str]]:
    """Part the arguments into a node's own and those between ``--ros-args`` and ``--``."""
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


def operands(number: int) -> tuple[int, int]:
    """The two numbers that the request of that number asks about; each request has its own sum."""
    return number, 3 * number + 1


def fibonacci(order: int) -> list[int]:
    """The sequence of Fibonacci's numbers up to the one of that order, from 0 and 1."""
    sequence = [0, 1]
    while len(sequence) <= order:
        sequence.append(sequence[-1] + sequence[-2])
    return sequence[: order + 1]
