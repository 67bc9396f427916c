"""Answers about many enclaves, folded by robot: what differs only in the robot is said once."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Sequence
from functools import lru_cache

from sros_tool.fleet.enclaves import robot_of
from sros_tool.fleet.model import Fleet, Robot

_SHOWN = 20  # robots that a line names; --json has all


def folded(fleet: Fleet | None, lines: Iterable[tuple[str, str]]) -> Iterator[str]:
    """Yield the text of lines, in the order of the first of each kind.

    Those that are the same but for the name and namespace of the robot become one line, with
    placeholders in place of them, and the robots behind it.

    Args:
        fleet: the robots; without them every line stays as it is.
        lines: pairs of an enclave and a text about it.
    """
    found: dict[str, list[tuple[str, str]]] = {}
    for enclave, text in lines:
        robot = robot_of(fleet, enclave) if fleet else None
        # Another text that has such words of its own is not mixed up with a folded one.
        kind = _with_placeholders(text, enclave, robot) if robot else f"\0{text}"
        found.setdefault(kind, []).append((robot.name if robot else "", text))
    for kind, same in found.items():
        names = list(dict.fromkeys(name for name, _ in same))
        if fleet is None or len(names) == 1:
            yield from (text for _, text in same)
        else:
            yield f"{kind}  ({_named(fleet, names)})"


def path_of_robots(fleet: Fleet, enclave: str) -> tuple[str, str]:
    """Return the path of an enclave with a placeholder for its robot, and the robot's name.

    For an enclave of no robot, the path stays as it is and the name is "".
    """
    robot = robot_of(fleet, enclave)
    return (_with_placeholders(enclave, enclave, robot), robot.name) if robot else (enclave, "")


def _with_placeholders(text: str, enclave: str, robot: Robot) -> str:
    own = _whole(robot.name).sub("{robot}", enclave)
    parts = re.split(rf"(?<![A-Za-z0-9_]){re.escape(enclave)}(?![A-Za-z0-9_/])", text)
    for value, place in ((robot.namespace, "{namespace}"), (robot.name, "{robot}")):
        if value != "/":
            parts = [_whole(value).sub(place, part) for part in parts]
    return own.join(parts)


@lru_cache(maxsize=4096)
def _whole(value: str) -> re.Pattern[str]:
    """Return the expression for a value that is no part of a longer name."""
    before = "(?<![A-Za-z0-9_/])" if value.startswith("/") else "(?<![A-Za-z0-9_{])"
    return re.compile(f"{before}{re.escape(value)}(?![A-Za-z0-9_}}])")


def _named(fleet: Fleet, names: Sequence[str]) -> str:
    """Return robots in words."""
    count = f"{len(names)} robots"
    if len(names) == len(fleet.robots):
        return f"all {count}"
    for group, members in fleet.groups.items():
        if set(names) == set(members):
            return f"the {count} of {group}"
    more = f" and {len(names) - _SHOWN} more" if len(names) > _SHOWN else ""
    return f"{count}: {', '.join(names[:_SHOWN])}{more}"
