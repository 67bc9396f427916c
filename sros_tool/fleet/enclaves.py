"""Which enclaves a robot has, and which robot an enclave belongs to.

A fleet has paths of enclaves with placeholders, so that neither answer needs a list of all
enclaves.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from functools import lru_cache
from typing import NamedTuple

from sros_tool.errors import InvalidNameError
from sros_tool.fleet.robots import Fleet, Robot
from sros_tool.names import check_enclave_name
from sros_tool.policy.placeholders import (
    Parts,
    Placeholder,
    check_path,
    fill,
    parts_of,
    placeholders_of,
    sample,
)
from sros_tool.wording import first_few

_PART = r"[A-Za-z_][A-Za-z0-9_]*"
MAX_ENCLAVES = 1_000_000
MAX_PATTERNS = 1_000
"""Maximum number of enclaves, and of paths with a placeholder, of one fleet."""

_VALUES = {"robot": _PART, "namespace": f"(?:/{_PART})*"}


def pattern_problem(path: str) -> str:
    """Return why ``path`` is not a pattern of one enclave per robot, as a sentence, or ""."""
    try:
        parts = parts_of(path)
        check_path(parts)
        check_enclave_name(sample(parts))
    except ValueError as error:
        return str(error)
    except InvalidNameError as error:
        return error.why
    return "" if placeholders_of(parts) else "It has no placeholder such as {robot}."


def group_of(parts: Parts) -> str:
    """Return the group whose robots have an enclave with this path; "" for the whole fleet."""
    return placeholders_of(parts)[0].group


def path_for(parts: Parts, robot: Robot) -> str:
    """Return the path of a robot's enclave."""
    return "".join(map(str, fill(parts, robot.name, robot.namespace)))


def router_of(fleet: Fleet, robot: Robot) -> str:
    """Return the path of the enclave of a robot's Zenoh router, if it has one."""
    return path_for(parts_of(fleet.routers), robot)


def enclaves_of(fleet: Fleet, robot: Robot) -> tuple[str, ...]:
    """Return the paths of the enclaves that a robot has by the patterns of the fleet, sorted."""
    paths = set()
    for pattern in fleet.enclaves:
        parts = parts_of(pattern)
        if group_of(parts) in ("", *robot.groups):
            paths.add(path_for(parts, robot))
    return tuple(sorted(paths))


def size_problem(fleet: Fleet) -> str:
    """Return why the fleet would have too many enclaves, as a sentence, or ""."""
    if len(fleet.enclaves) > MAX_PATTERNS:
        return f"It has {len(fleet.enclaves)} paths with a placeholder, more than {MAX_PATTERNS}."
    members = {name: len(robots) for name, robots in fleet.groups.items()}
    members[""] = len(fleet.robots)
    count = sum(members.get(group_of(parts_of(pattern)), 0) for pattern in fleet.enclaves)
    return f"Its robots have {count} enclaves, more than {MAX_ENCLAVES}." * (count > MAX_ENCLAVES)


def robot_of(fleet: Fleet, enclave: str) -> Robot | None:
    """Return the robot that an enclave belongs to; None for an enclave of no robot."""
    for pattern in _fitting(fleet, enclave):
        for robot in _candidates(fleet, pattern, enclave):
            inside = group_of(pattern.parts) in ("", *robot.groups)
            if inside and path_for(pattern.parts, robot) == enclave:
                return robot
    return None


def left_robot_of(fleet: Fleet, enclave: str) -> str:
    """Return the robot that an enclave belonged to before it left the fleet or its group, or "".

    The result is "" for an enclave of a robot, and if its path names no robot.  If a path has only
    a namespace, only robots that are still in the fleet can be found.
    """
    if robot_of(fleet, enclave):
        return ""
    for pattern in _fitting(fleet, enclave):
        match = pattern.expression.fullmatch(enclave)
        name = match.groupdict().get("robot", "") if match else ""
        if name and name not in fleet.robots:
            return name
        for robot in _candidates(fleet, pattern, enclave):
            if path_for(pattern.parts, robot) == enclave:
                return robot.name
    return ""


class Unrecorded(NamedTuple):
    """Enclaves whose path has a robot's name, but matches no path pattern of the fleet.

    ``below`` are in a folder of this robot only, such as ``/r3``; ``naming`` have its name as
    another part of their path, such as ``/desk/r3``.
    """

    below: tuple[str, ...] = ()
    naming: tuple[str, ...] = ()


def unrecorded_enclaves(
    fleet: Fleet, names: Iterable[str], robots: Collection[str]
) -> dict[str, Unrecorded]:
    """Map each robot to the enclaves, out of ``names``, that are `Unrecorded` for it."""
    folders = _folders(fleet)
    below: dict[str, list[str]] = {robot: [] for robot in robots}
    naming: dict[str, list[str]] = {robot: [] for robot in robots}
    for name in names:
        owners = next((folders[path] for path in _upwards(name) if path in folders), frozenset())
        named = owners | set(name.split("/")[1:])
        if named.isdisjoint(below) or robot_of(fleet, name):
            continue
        for robot in named & below.keys():
            (below if owners == {robot} else naming)[robot].append(name)
    return {
        robot: Unrecorded(tuple(sorted(below[robot])), tuple(sorted(naming[robot])))
        for robot in robots
    }


def _upwards(name: str) -> Iterator[str]:
    """Yield the path of an enclave and of the folders above it, without the root."""
    while name:
        yield name
        name = name.rpartition("/")[0]


def folders_of_robots(fleet: Fleet, robots: Collection[str]) -> tuple[str, ...]:
    """Return the sorted enclave folders, such as ``/r3``, that any of the robots has."""
    return tuple(sorted(path for path, of in _folders(fleet).items() if not of.isdisjoint(robots)))


def _folders(fleet: Fleet) -> Mapping[str, frozenset[str]]:
    """Map enclave folders of robots, such as ``/r3``, to the names of the robots (usually one).

    A folder is a path of the fleet up to the part with the first placeholder.
    """
    folders: dict[str, set[str]] = {}
    for begin in dict.fromkeys(_begin(parts_of(path)) for path in fleet.enclaves):
        for robot in fleet.robots.values():
            if len(folder := path_for(begin, robot)) > 1:
                folders.setdefault(folder, set()).add(robot.name)
    return {folder: frozenset(robots) for folder, robots in folders.items()}


def _begin(path: Parts) -> Parts:
    """Return the parts of a path to the end of its folder with the first placeholder."""
    begin: list[str | Placeholder] = []
    inside = False
    for part in path:
        if inside and isinstance(part, str) and "/" in part:
            begin.append(part[: part.index("/")])
            break
        if inside and isinstance(part, Placeholder) and part.value == "namespace":
            break
        begin.append(part if isinstance(part, str) else part._replace(group=""))
        inside = inside or isinstance(part, Placeholder)
    return tuple(part for part in begin if part != "")


def _fitting(fleet: Fleet, enclave: str) -> Iterator[_Pattern]:
    """Yield the patterns whose end matches the end of an enclave's path."""
    patterns = _patterns(fleet.enclaves)
    end = len(enclave)
    while end >= 0:
        yield from patterns.get(enclave[end:], ())
        end = enclave.rfind("/", 0, end) if end else -1


class _Pattern(NamedTuple):
    parts: Parts
    expression: re.Pattern[str]


@lru_cache(maxsize=8)
def _patterns(paths: tuple[str, ...]) -> Mapping[str, list[_Pattern]]:
    """Group the patterns by the path parts after their last placeholder."""
    patterns: dict[str, list[_Pattern]] = {}
    for path in paths:
        parts = parts_of(path)
        last = parts[-1] if isinstance(parts[-1], str) else ""
        key = last[last.find("/") :] if "/" in last else ""
        patterns.setdefault(key, []).append(_Pattern(parts, _expression(parts)))
    return patterns


def _expression(parts: Parts) -> re.Pattern[str]:
    text, seen = "", set()
    for part in parts:
        if isinstance(part, str):
            text += re.escape(part)
        elif part.value in seen:
            text += f"(?P={part.value})"
        else:
            seen.add(part.value)
            text += f"(?P<{part.value}>{_VALUES[part.value]})"
    return re.compile(text, re.ASCII)


def _candidates(fleet: Fleet, pattern: _Pattern, enclave: str) -> Iterator[Robot]:
    match = pattern.expression.fullmatch(enclave)
    if not match:
        return
    values = match.groupdict()
    if "robot" in values:
        names: Iterable[str] = [values["robot"]]
    else:
        names = fleet.by_namespace.get(values["namespace"] or "/", ())
    yield from (fleet.robots[name] for name in names if name in fleet.robots)


# ── names of many robots as one ───────────────────────────────────────────────────────────────


_SHOWN = 20  # robots that a line names; --json has all


def folded(fleet: Fleet | None, lines: Iterable[tuple[str, str]]) -> Iterator[str]:
    """Yield lines about enclaves; lines that differ only in the robot become one line.

    That line has placeholders for the robot's name and namespace, and lists the robots at its end.

    Args:
        fleet: the robots; None leaves every line as it is.
        lines: pairs of an enclave and a text about it.
    """
    kinds: dict[str, list[tuple[str, str]]] = {}
    for enclave, text in lines:
        robot = robot_of(fleet, enclave) if fleet else None
        # Another text that has such words of its own is not mixed up with a folded one.
        kind = _with_placeholders(text, enclave, robot) if robot else f"\0{text}"
        kinds.setdefault(kind, []).append((robot.name if robot else "", text))
    for kind, same in kinds.items():
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


def name_of_robots(fleet: Fleet, text: str) -> tuple[str, str]:
    """Return a text with a placeholder for the robot that it names first, and the robot's name.

    A text that names no robot stays as it is, and the name is "".
    """
    name = next(filter(fleet.robots.__contains__, re.findall(r"\w+", text, re.A)), "")
    of_robot = "{robot}"
    return (_whole(name).sub(of_robot, text), name) if name else (text, "")


def _with_placeholders(text: str, enclave: str, robot: Robot) -> str:
    of_robot = "{robot}"  # noqa: RUF027 - a placeholder of policies
    own = _whole(robot.name).sub(of_robot, enclave)
    parts = re.split(rf"(?<![A-Za-z0-9_]){re.escape(enclave)}(?![A-Za-z0-9_/])", text)
    for value, placeholder in ((robot.namespace, "{namespace}"), (robot.name, of_robot)):
        if value != "/":
            parts = [_whole(value).sub(placeholder, part) for part in parts]
    return own.join(parts)


@lru_cache(maxsize=4096)
def _whole(value: str) -> re.Pattern[str]:
    """Return a regular expression that matches ``value`` only as a whole name."""
    before = "(?<![A-Za-z0-9_/])" if value.startswith("/") else "(?<![A-Za-z0-9_{])"
    return re.compile(f"{before}{re.escape(value)}(?![A-Za-z0-9_}}])")


def _named(fleet: Fleet, names: Sequence[str]) -> str:
    """Return a list of robots in words, such as "r1, r2 and 3 more robots"."""
    count = f"{len(names)} robots"
    if len(names) == len(fleet.robots):
        return f"all {count}"
    for group, members in fleet.groups.items():
        if set(names) == set(members):
            return f"the {count} of {group}"
    return f"{count}: {first_few(names, _SHOWN)}"
