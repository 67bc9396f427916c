"""A fleet: the checked settings of its robots, and the enclaves that the robots have.

The grammar of every value allows it to be one name in a policy, a command or a path: no markup, no
wildcard, no white space, and "/" only in a namespace.

A fleet has paths of enclaves with placeholders.  So the enclaves of a robot, and the robot of an
enclave, are found without a list of all enclaves.
"""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Collection, Container, Hashable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from ipaddress import ip_address
from itertools import permutations
from types import MappingProxyType
from typing import NamedTuple, TypeVar

from sros_tool.errors import DocumentError, InvalidNameError, Note, UsageError
from sros_tool.names import check_enclave_name, expression_problem
from sros_tool.policy.placeholders import (
    Parts,
    Placeholder,
    check_path,
    fill,
    parts_of,
    placeholders_of,
    sample,
)
from sros_tool.validity import parse_duration
from sros_tool.wording import first_few, natural_sort_key

_Item = TypeVar("_Item")
_Kind = TypeVar("_Kind", bound=Hashable)
MAX_ROBOTS = 100_000
RENEWAL_ALLOWED, _RENEWAL_REFUSED = "allowed", "refused"
ROUTERS = "/{robot}/router"
"""Default path of the enclave of each robot's Zenoh router."""
_MOST_GROUP_MEMBERS = 5  # in an error
_MAX_NAME = 64
"""Longest name of a robot or group in characters: longer ones fit into no enclave's name."""
_MAX_HOST = 253
"""Longest host name (RFC 1035)."""

_ANSIBLE_GROUPS = frozenset({"all", "ungrouped", "_meta", "localhost"})
"""Names that Ansible reserves in an inventory; "localhost" is the machine that runs Ansible."""

_TOKEN = re.compile(r"[A-Za-z_][A-Za-z0-9_]*", re.ASCII)
_HOST = re.compile(r"[A-Za-z0-9_](?:[A-Za-z0-9_.-]*[A-Za-z0-9_])?\.?", re.ASCII)
_USER = re.compile(r"[A-Za-z_][A-Za-z0-9_.-]{0,31}\$?", re.ASCII)


class Robot(NamedTuple):
    """A robot: its ROS namespace, and its network address.

    ``domain`` is its ROS_DOMAIN_ID; None stands for every domain of the keystore.  ``address`` is a
    host name or IP address, ``user`` the account there ("": the default of ssh).  ``groups`` are
    sorted.  ``router`` is the address (``HOST:PORT``) at which sessions and other routers connect
    to its Zenoh router, or "" if it has none; ``crossing`` are the names that may pass between that
    router and others (empty: all names).  ``distribution`` is its ROS 2 distribution ("": the
    distributions of the keystore).  ``renewal`` is `RENEWAL_ALLOWED` if `sros fleet collect` may
    sign its requests for renewal; ``renewal_grace`` is a duration, such as ``30d``, for which a
    certificate is still accepted with such a request after its expiry ("": none).
    """

    name: str
    namespace: str
    domain: int | None = None
    address: str = ""
    user: str = ""
    groups: tuple[str, ...] = ()
    router: str = ""
    crossing: tuple[str, ...] = ()
    distribution: str = ""
    renewal: str = ""
    renewal_grace: str = ""


@dataclass(frozen=True, slots=True)
class Fleet:
    """The robots by name, and the robot names of each group; both sorted.

    ``enclaves`` are paths of enclaves with a placeholder, such as ``/{robot}/base``: they say
    which robot an enclave belongs to.  ``routers`` is the path of the enclaves of the robots' Zenoh
    routers; it is one of ``enclaves`` if any robot has a router.  ``by_namespace`` has the names of
    the robots in each namespace.
    """

    robots: Mapping[str, Robot]
    groups: Mapping[str, tuple[str, ...]]
    enclaves: tuple[str, ...] = ()
    routers: str = ROUTERS
    by_namespace: Mapping[str, tuple[str, ...]] = field(default_factory=dict, compare=False)

    @classmethod
    def of(
        cls,
        robots: Iterable[Robot],
        groups: Iterable[str] = (),
        enclaves: Sequence[str] = (),
        routers: str = ROUTERS,
    ) -> Fleet:
        """Return a fleet of ``robots``; ``groups`` may name groups without robots."""
        named = {robot.name: robot for robot in sorted(robots, key=lambda robot: robot.name)}
        members: dict[str, list[str]] = {name: [] for name in groups}
        spaces: dict[str, list[str]] = {}
        for robot in named.values():
            spaces.setdefault(robot.namespace, []).append(robot.name)
            for group in robot.groups:
                members.setdefault(group, []).append(robot.name)
        return cls(
            MappingProxyType(named),
            MappingProxyType({name: tuple(members[name]) for name in sorted(members)}),
            (),
            routers,
            MappingProxyType({name: tuple(spaces[name]) for name in spaces}),
        ).with_enclaves(enclaves)

    def robot(self, name: str) -> Robot:
        """Return the robot with this name.

        Raises:
            DocumentError: there is no such robot; the error has similar names.
        """
        if name in self.robots:
            return self.robots[name]
        remedy = _similar_names_remedy(name, self.robots)
        if name in self.groups:
            members = sorted((robot.name for robot in self.members(name)), key=natural_sort_key)
            remedy = f"{name} is a group: {first_few(members, _MOST_GROUP_MEMBERS)}."
        raise DocumentError(f"the fleet has no robot {name!r}", remedy=remedy)

    def members(self, group: str) -> tuple[Robot, ...]:
        """Return the robots of a group; "" stands for the whole fleet.

        Raises:
            DocumentError: the fleet has no such group; the error has similar names.
        """
        if not group:
            return tuple(self.robots.values())
        if group not in self.groups:
            raise DocumentError(
                f"the fleet has no group {group!r}",
                remedy=_similar_names_remedy(group, self.groups),
            )
        return tuple(self.robots[name] for name in self.groups[group])

    def with_enclaves(self, enclaves: Sequence[str]) -> Fleet:
        """Return the fleet with these enclave paths.

        The path of routers is added if a robot has a router.
        """
        of_routers = [self.routers] if any(robot.router for robot in self.robots.values()) else []
        return replace(self, enclaves=tuple(dict.fromkeys((*enclaves, *of_routers))))


def _similar_names_remedy(name: str, known: Iterable[str]) -> str:
    """Return the remedy for an unknown name: similar known names, or else the first known names.

    The result is "" if no names are known.
    """
    from difflib import get_close_matches

    names = sorted(known, key=natural_sort_key)
    similar = get_close_matches(name[:_MAX_NAME], names, n=3, cutoff=0.5) or names[:3]
    similar.sort(key=natural_sort_key)
    return (
        f"It has {', '.join(similar)}{' and others' if len(names) > len(similar) else ''}."
        if similar
        else ""
    )


# ── grammar ────────────────────────────────────────────────────────────────────────────────


def name_problem(name: str) -> str:
    """Return why ``name`` is not the name of a robot or group, as a sentence; "" if it is."""
    if len(name) > _MAX_NAME:
        return f"It has {len(name)} characters, more than {_MAX_NAME}."
    if not _TOKEN.fullmatch(name):
        return (
            "A name is one part of a ROS name: letters, digits and underscores, and no digit at "
            "its start, such as r7."
        )
    if name in _ANSIBLE_GROUPS:
        return "In an Ansible inventory this name means something else."
    return ""


def address_problem(address: str) -> str:
    """Return why ``address`` is neither a host name nor an IP address; "" if it is one."""
    if len(address) <= _MAX_HOST and _HOST.fullmatch(address) and ".." not in address:
        return ""
    try:
        ip_address(address)
    except ValueError:
        return "It is neither a host name nor an IP address, such as r7.example.com or 10.0.7.1."
    # The zone of an IPv6 address can have any characters.
    return "" if "%" not in address else "It has a zone: write the address without the zone."


def router_problem(router: str) -> str:
    """Return why ``router`` is no address of a Zenoh router, as a sentence; "" if it is one."""
    from sros_tool.zenoh.configuration import is_endpoint  # most fleets name no routers

    return "" if is_endpoint(router) else "It is not HOST:PORT, such as r7.example.com:7447."


def crossing_problem(name: str) -> str:
    """Return why ``name`` cannot pass between routers, as a sentence; "" if it can."""
    if not name.startswith("/"):
        return "It does not start with '/', as /fleet/* does."
    return expression_problem(name)


def user_problem(user: str) -> str:
    """Return why ``user`` is not the name of an account, as a sentence; "" if it is."""
    return "" if _USER.fullmatch(user) else "It is not the name of an account, such as ros."


def renewal_problem(renewal: str) -> str:
    """Return why ``renewal`` is not a valid value, as a sentence; "" if it is."""
    known = (RENEWAL_ALLOWED, _RENEWAL_REFUSED)
    return "" if renewal in known else f"It is neither {known[0]} nor {known[1]}."


def grace_problem(grace: str) -> str:
    """Return why ``grace`` is not a duration, as a sentence; "" if it is."""
    try:
        parse_duration(grace)
    except UsageError as error:
        return error.remedy
    return ""


_PATH_PART = r"[A-Za-z_][A-Za-z0-9_]*"
MAX_ENCLAVES = 1_000_000
MAX_PATTERNS = 1_000
"""Maximum number of enclaves, and of paths with a placeholder, of one fleet."""

_PLACEHOLDER_PATTERNS = {"robot": _PATH_PART, "namespace": f"(?:/{_PATH_PART})*"}


def pattern_problem(path: str) -> str:
    """Return why ``path`` is not a pattern for one enclave of each robot; "" if it is one."""
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
    """Return the path of the enclave that a robot has by the path pattern ``parts``."""
    return "".join(map(str, fill(parts, robot.name, robot.namespace)))


def router_enclave_of(fleet: Fleet, robot: Robot) -> str:
    """Return the path for the enclave of a robot's Zenoh router, even if there is no router."""
    return path_for(parts_of(fleet.routers), robot)


def enclaves_of(fleet: Fleet, robot: Robot) -> tuple[str, ...]:
    """Return the paths of the enclaves that a robot has by the patterns of the fleet, sorted."""
    paths = set()
    for pattern in fleet.enclaves:
        parts = parts_of(pattern)
        if group_of(parts) in ("", *robot.groups):
            paths.add(path_for(parts, robot))
    return tuple(sorted(paths))


def similar_names_notes(fleet: Fleet) -> Iterator[Note]:
    """Yield a note on robots whose names differ only in upper and lower case."""
    by_name: dict[str, list[str]] = defaultdict(list)
    for name in sorted(fleet.robots):
        by_name[name.lower()].append(name)
    if similar := [" and ".join(names) for names in by_name.values() if len(names) > 1]:
        yield Note(
            "fleet.similar-names",
            f"robots whose names differ only in upper and lower case: {first_few(similar, 5)}. "
            "DNS, and web servers and file systems that ignore the case, give them one address or "
            "one folder, so they get and replace each other's files: rename one of them.",
        )


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
    for pattern in _fitting_patterns(fleet, enclave):
        for robot in _possible_robots(fleet, pattern, enclave):
            inside = group_of(pattern.parts) in ("", *robot.groups)
            if inside and path_for(pattern.parts, robot) == enclave:
                return robot
    return None


def former_robot_of(fleet: Fleet, enclave: str) -> str:
    """Return the robot that an enclave belonged to before it left the fleet or its group, or "".

    The result is "" if a robot still has the enclave, and if the path names no robot.  If a path
    has only a namespace, only robots that are still in the fleet can be found.
    """
    if robot_of(fleet, enclave):
        return ""
    for pattern in _fitting_patterns(fleet, enclave):
        match = pattern.expression.fullmatch(enclave)
        name = match.groupdict().get("robot", "") if match else ""
        if name and name not in fleet.robots:
            return name
        for robot in _possible_robots(fleet, pattern, enclave):
            if path_for(pattern.parts, robot) == enclave:
                return robot.name
    return ""


class UnrecordedEnclaves(NamedTuple):
    """Enclaves whose path has a robot's name, but matches no path pattern of the fleet.

    ``below`` are in a folder of this robot only, such as ``/r3``; ``naming`` have the robot's name
    as another part of their path, such as ``/desk/r3``.
    """

    below: tuple[str, ...] = ()
    naming: tuple[str, ...] = ()


def unrecorded_enclaves(
    fleet: Fleet, names: Iterable[str], robots: Collection[str]
) -> dict[str, UnrecordedEnclaves]:
    """Map each robot to the enclaves, out of ``names``, that are `UnrecordedEnclaves` for it."""
    folders = _robots_by_folder(fleet)
    below: dict[str, list[str]] = {robot: [] for robot in robots}
    naming: dict[str, list[str]] = {robot: [] for robot in robots}
    for name in names:
        owners = next(
            (folders[path] for path in _path_and_folders_above(name) if path in folders),
            frozenset(),
        )
        named = owners | set(name.split("/")[1:])
        if named.isdisjoint(below) or robot_of(fleet, name):
            continue
        for robot in named & below.keys():
            (below if owners == {robot} else naming)[robot].append(name)
    return {
        robot: UnrecordedEnclaves(tuple(sorted(below[robot])), tuple(sorted(naming[robot])))
        for robot in robots
    }


def _path_and_folders_above(name: str) -> Iterator[str]:
    """Yield the path of an enclave and of the folders above it, without the root."""
    while name:
        yield name
        name = name.rpartition("/")[0]


def folders_of_robots(fleet: Fleet, robots: Collection[str]) -> tuple[str, ...]:
    """Return the sorted enclave folders, such as ``/r3``, that any of the robots has."""
    return tuple(
        sorted(path for path, of in _robots_by_folder(fleet).items() if not of.isdisjoint(robots))
    )


def _robots_by_folder(fleet: Fleet) -> Mapping[str, frozenset[str]]:
    """Map enclave folders of robots, such as ``/r3``, to the names of the robots (usually one).

    A folder is a path of the fleet up to the part with the first placeholder.
    """
    folders: dict[str, set[str]] = {}
    for begin in dict.fromkeys(_beginning_of_path(parts_of(path)) for path in fleet.enclaves):
        for robot in fleet.robots.values():
            if len(folder := path_for(begin, robot)) > 1:
                folders.setdefault(folder, set()).add(robot.name)
    return {folder: frozenset(robots) for folder, robots in folders.items()}


def _beginning_of_path(path: Parts) -> Parts:
    """Return a path up to and including the first folder whose name has a placeholder."""
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


def _fitting_patterns(fleet: Fleet, enclave: str) -> Iterator[_Pattern]:
    """Yield the patterns whose end matches the end of an enclave's path."""
    patterns = _patterns_by_end(fleet.enclaves)
    end = len(enclave)
    while end >= 0:
        yield from patterns.get(enclave[end:], ())
        end = enclave.rfind("/", 0, end) if end else -1


class _Pattern(NamedTuple):
    """A path with placeholders, and the regular expression for the paths that it stands for."""

    parts: Parts
    expression: re.Pattern[str]


@lru_cache(maxsize=8)
def _patterns_by_end(paths: tuple[str, ...]) -> Mapping[str, list[_Pattern]]:
    """Group the patterns by the path parts after their last placeholder."""
    patterns: dict[str, list[_Pattern]] = {}
    for path in paths:
        parts = parts_of(path)
        last = parts[-1] if isinstance(parts[-1], str) else ""
        key = last[last.find("/") :] if "/" in last else ""
        patterns.setdefault(key, []).append(_Pattern(parts, _path_expression(parts)))
    return patterns


def _path_expression(parts: Parts) -> re.Pattern[str]:
    text, named_parts = "", set()
    for part in parts:
        if isinstance(part, str):
            text += re.escape(part)
        elif part.value in named_parts:
            text += f"(?P={part.value})"
        else:
            named_parts.add(part.value)
            text += f"(?P<{part.value}>{_PLACEHOLDER_PATTERNS[part.value]})"
    return re.compile(text, re.ASCII)


def _possible_robots(fleet: Fleet, pattern: _Pattern, enclave: str) -> Iterator[Robot]:
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


_MOST_SHOWN = 20  # maximum number of robots that a line names; --json has all
_MOST_OTHERS = 3  # other robots in a line, such as those that pass a message on
_MOST_TARGETS = 5  # if more pairs of robots share a text, they become one line


def folded_lines(fleet: Fleet | None, lines: Iterable[tuple[str, str]]) -> Iterator[str]:
    """Yield lines about enclaves; lines that differ only in the robot become one line.

    That line has placeholders for the robot's name and namespace, and lists the robots at its end.
    The robot of a line is the robot of the enclave, or, for an enclave of no robot, the only robot
    that the text names.  Lines that differ only in one *other* robot share a line with ``{other}``;
    lines that differ in both robots become one line if they are many, or are about each robot of
    one set with each robot of another set.  Lines with more than three other robots are not folded
    by these.

    Args:
        fleet: the robots; None leaves every line as it is.
        lines: pairs of an enclave and a text about it.
    """
    if fleet is None:
        yield from (text for _, text in lines)
        return
    read = [(text, *_foldings(fleet, enclave, text)) for enclave, text in lines]
    pairs: dict[_Folding, list[str]] = defaultdict(list)
    for _, _, wide in read:
        for folding, pair in wide:
            pairs[folding].append(pair)
    whole = {folding for folding, named in pairs.items() if _two_sets(named)}
    for (folding, _), by_robot in grouped_by_robot(read, _MOST_TARGETS, whole).items():
        if len(by_robot) == 1:
            yield from (text for texts in by_robot.values() for text in texts)
        else:
            yield f"{folding.text}  ({_robots_text(fleet, list(by_robot), folding)})"


def grouped_by_robot(
    items: Iterable[tuple[_Item, Sequence[tuple[_Kind, str]], Sequence[tuple[_Kind, str]]]],
    most: int,
    always: Container[_Kind] = (),
) -> dict[tuple[_Kind, bool], dict[str, list[_Item]]]:
    """Group items that differ only in one robot: kind -> robot -> items.

    Each item comes with two lists of pairs of a kind and a robot.  The first list has narrow kinds:
    the items of such a kind differ only in this robot.  The second list has wide kinds: their items
    also differ in other robots.  Of each list, the kind with the most robots is used.  A wide kind
    replaces its narrow kinds if it joins more than ``most`` of them, or is in ``always``; its key
    in the result has True.
    """
    robots: dict[_Kind, set[str]] = defaultdict(set)
    read = list(items)
    for _, same, similar in read:
        for kind, robot in (*same, *similar):
            robots[kind].add(robot)

    def largest(kinds: Sequence[tuple[_Kind, str]]) -> tuple[_Kind, str]:
        return max(kinds, key=lambda kind_and_robot: len(robots[kind_and_robot[0]]))

    chosen = [
        (item, largest(same), largest(similar) if similar else None) for item, same, similar in read
    ]
    parts: dict[_Kind, set[_Kind]] = defaultdict(set)
    for _, (kind, _), wide in chosen:
        if wide:
            parts[wide[0]].add(kind)
    groups: dict[tuple[_Kind, bool], dict[str, list[_Item]]] = {}
    for item, narrow, wide in chosen:
        many = wide is not None and (len(parts[wide[0]]) > most or wide[0] in always)
        kind, robot = wide if wide and many else narrow
        groups.setdefault((kind, many), {}).setdefault(robot, []).append(item)
    return groups


class _Folding(NamedTuple):
    """A text with a placeholder for any robot but ``own`` ("": for any robot).

    With ``pairs``, the text has placeholders for any pair of robots.
    """

    text: str
    own: str = ""
    pairs: bool = False


_Foldings = list[tuple[_Folding, str]]
"""Forms of a line with placeholders in place of robots, and the names of these robots."""


def _foldings(fleet: Fleet, enclave: str, text: str) -> tuple[_Foldings, _Foldings]:
    """Return the forms of a line with a placeholder for one robot, and for two.

    The first form replaces the robot of ``enclave``, the others another robot that ``text`` names,
    or both.  A line without these robots has a single form, without a robot.
    """
    own = robot_of(fleet, enclave)
    named = [robot for robot in named_robots(fleet, "", text) if robot != own]
    others = named if len(named) <= _MOST_OTHERS else []
    if own is None and len(named) == 1:
        own, others = named[0], []
    if own is None:
        # Marked, so that a text which contains "{robot}" itself is not mixed up with a folded text.
        return [(_Folding(f"\0{text}"), "")], []
    any_own = _with_placeholders(text, enclave, own)
    by_other = [(_Folding(_with_other(text, other), own.name), other.name) for other in others]
    by_both = [
        (_Folding(_with_other(any_own, other), pairs=True), f"{own.name} and {other.name}")
        for other in others
    ]
    return [(_Folding(any_own), own.name), *by_other], by_both


def named_robots(fleet: Fleet, enclave: str, text: str) -> tuple[Robot, ...]:
    """Return the robot of an enclave, if any, and the robots that ``enclave`` or ``text`` names."""
    owner = robot_of(fleet, enclave)
    words = dict.fromkeys(re.findall(r"\w+", f"{enclave} {text}", re.A))
    named = (fleet.robots[word] for word in words if word in fleet.robots)
    return tuple(dict.fromkeys((*([owner] if owner else []), *named)))


def with_robot_placeholder(text: str, robot: Robot, word: str = "robot") -> str:
    """Return a text with ``{robot}``, or another word, in place of a robot's namespace and name.

    The robot's name can also be a part of another name, as in ``r1_lift``.
    """
    any_robot = f"{{{word}}}"
    if robot.namespace != "/":
        text = _whole_name_expression(robot.namespace).sub(f"/{any_robot}", text)
    return re.sub(rf"(?<![A-Za-z0-9]){robot.name}(?![A-Za-z0-9])", any_robot, text)


def _with_placeholders(text: str, enclave: str, robot: Robot) -> str:
    of_robot = "{robot}"  # noqa: RUF027 - a placeholder of policies
    own = _whole_name_expression(robot.name).sub(of_robot, enclave)
    parts = re.split(rf"(?<![A-Za-z0-9_]){re.escape(enclave)}(?![A-Za-z0-9_/])", text)
    for value, placeholder in ((robot.namespace, "{namespace}"), (robot.name, of_robot)):
        if value != "/":
            parts = [_whole_name_expression(value).sub(placeholder, part) for part in parts]
    return own.join(parts)


def _with_other(text: str, robot: Robot) -> str:
    return _whole_name_expression(robot.name).sub("{other}", text)


@lru_cache(maxsize=4096)
def _whole_name_expression(value: str) -> re.Pattern[str]:
    """Return a regular expression that matches ``value`` only as a whole name."""
    before = "(?<![A-Za-z0-9_/])" if value.startswith("/") else "(?<![A-Za-z0-9_{])"
    return re.compile(f"{before}{re.escape(value)}(?![A-Za-z0-9_}}])")


def _two_sets(pairs: Sequence[str]) -> tuple[list[str], list[str]] | None:
    """Return two lists of robots if ``pairs`` pair each robot of one with each of the other."""
    names = [pair.split(" and ") for pair in pairs]
    first, second = ([*dict.fromkeys(pair[place] for pair in names)] for place in (0, 1))
    is_whole = len(set(pairs)) == len(first) * len(second) and min(len(first), len(second)) > 1
    return (first, second) if is_whole else None


def _robots_text(fleet: Fleet, names: Sequence[str], folding: _Folding) -> str:
    """Return a list of robots in words, such as "r1, r2 and 3 more robots"."""
    if folding.pairs:
        sources = list(dict.fromkeys(pair.split()[0] for pair in names))
        if {*names} == {f"{first} and {second}" for first, second in permutations(sources, 2)}:
            return f"{_robots_text(fleet, sources, _Folding(''))}, each with every other"
        if sets := _two_sets(names):
            first, second = (_robots_text(fleet, one, _Folding("")) for one in sets)
            return f"{first}, each with {second}"
        return f"{len(names)} pairs of robots, such as {names[0]}"
    own = folding.own
    count = f"{len(names)}{' other' if own else ''} robots"
    if set(names) == fleet.robots.keys() - {own}:
        return f"all {count}"
    for group, members in fleet.groups.items():
        if set(names) == set(members) - {own}:
            return f"the {count if own in members else f'{len(names)} robots'} of {group}"
    return f"{count}: {first_few(names, _MOST_SHOWN)}"
