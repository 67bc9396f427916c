"""Fleet files: the robots of a fleet, read with all checks, and written as TOML."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from shlex import quote
from types import MappingProxyType
from typing import Any

from sros_tool.dds.domains import MAX_DOMAIN
from sros_tool.errors import DocumentError
from sros_tool.files import read_toml
from sros_tool.fleet.enclaves import MAX_PATTERNS, pattern_problem, size_problem
from sros_tool.fleet.inventory import SHOWN, connections, fleet_table, is_json
from sros_tool.fleet.robots import (
    MAX_ROBOTS,
    Fleet,
    Robot,
    address_problem,
    name_problem,
    namespace_problem,
    user_problem,
)
from sros_tool.xml import read_bytes

MAX_BYTES = 4 * 1024 * 1024
_MOST_GROUPS = 32  # of one robot
_VALUES: Mapping[str, Callable[[str], str]] = {
    "namespace": namespace_problem,
    "address": address_problem,
    "user": user_problem,
}
"""The values of a robot that are texts, each with the function that says what is wrong with it."""
_OF_ROBOT = "{robot}"
"""Stands for the name of a robot in the values of a group."""


def read_fleet(path: Path) -> Fleet:
    """Return the fleet in a TOML file, or in an inventory of Ansible in YAML or JSON.

    The end of the name tells which: .yml, .yaml and .json are inventories.

    Raises:
        DocumentError: the file cannot be read, or a value in it is not valid; the error names the
            key.
        UnavailableError: an inventory in YAML is named, and PyYAML is not installed.
    """
    data, ending = read_bytes(path, "fleet file", most=MAX_BYTES), path.suffix.lower()
    if ending in _OF_INVENTORIES:
        what = f"the inventory '{path}'"
        table = fleet_table(data, what, is_json=ending == ".json" or is_json(data))
        return _Reader(what, SHOWN).fleet(table)
    try:
        return parse_fleet(data, f"the fleet file '{path}'")
    except DocumentError as error:
        if ending == ".toml" or not _INI_HOST.search(data):
            raise
        raise DocumentError(
            f"'{path}' is not a fleet file in TOML",
            "It looks like an inventory of Ansible in INI.",
            f"Convert it with `ansible-inventory -i {quote(str(path))} --list > hosts.json`, and "
            "name hosts.json.",
        ) from error


def read_connections(path: Path) -> dict[str, str]:
    """Return what an inventory says of how Ansible connects (`connections`); nothing for TOML.

    Raises:
        SrosError: as `read_fleet`.
    """
    data, ending = read_bytes(path, "fleet file", most=MAX_BYTES), path.suffix.lower()
    if ending not in _OF_INVENTORIES:
        return {}
    return connections(data, f"the inventory '{path}'", is_json=ending == ".json" or is_json(data))


_OF_INVENTORIES = (".yml", ".yaml", ".json")
_INI_HOST = re.compile(rb"^[A-Za-z0-9_.-]+[ \t]*(?:$|[ \t][A-Za-z_]+=)", re.MULTILINE)
"""A host on a line of its own, or with variables behind it."""


def parse_fleet(data: bytes, what: str) -> Fleet:
    """Return the fleet in a TOML document; ``what`` names it in errors.

    Raises:
        DocumentError: it is not TOML, or a value in it is not valid.
    """
    return _Reader(what).fleet(read_toml(data, what, longest=MAX_BYTES))


class _Reader:
    """Reader of one file; ``words`` are the ones that it has in place of the keys."""

    def __init__(self, what: str, words: Mapping[str, str] = MappingProxyType({})) -> None:
        self._what = what
        self._words = words

    def fleet(self, table: Mapping[str, Any]) -> Fleet:
        self._known(table, ("groups", "robots", "enclaves"), "")
        groups = self._tables(table, "groups")
        robots = self._tables(table, "robots")
        if not robots:
            raise self._error("it names no robot", "", "Write for example [robots.r7].")
        if len(robots) > MAX_ROBOTS:
            raise self._error(f"it has more than {MAX_ROBOTS} robots", "", "Divide the fleet.")
        for name, values in groups.items():
            self._known(values, ("domain", *_VALUES), f"groups.{name}")
            self._values(values, {key: f"groups.{name}.{key}" for key in values}, "r")
        enclaves = self._texts(table, "enclaves", "", MAX_PATTERNS)
        for path in enclaves:
            if problem := pattern_problem(path):
                raise self._refused("enclaves", path, problem)
        read = [self._robot(name, values, groups) for name, values in robots.items()]
        fleet = Fleet.of(read, groups, enclaves)
        if both := sorted(fleet.robots.keys() & fleet.groups.keys()):
            raise self._error(
                f"{_short(both[0])} is a robot and a group",
                "Ansible would take one for the other.",
                "Give one of them another name.",
            )
        if problem := size_problem(fleet):
            raise self._error("it is too large", problem, "Divide the fleet.")
        return fleet

    def _robot(
        self, name: str, values: Mapping[str, Any], groups: Mapping[str, Mapping[str, Any]]
    ) -> Robot:
        at = f"{self._word('robots')}.{name}"
        self._known(values, ("groups", "domain", *_VALUES), at)
        member = tuple(sorted(set(self._texts(values, "groups", at, _MOST_GROUPS))))
        for group in member:
            if problem := name_problem(group):
                raise self._refused(f"{at}.groups", group, problem)
        given: dict[str, Any] = {}
        origin: dict[str, str] = {}
        for group in member:
            for key, value in groups.get(group, {}).items():
                here = f"groups.{group}.{key}"
                if key in given and key not in values and given[key] != value:
                    raise self._error(
                        f"the robot {name} gets its {key} from two groups",
                        f"{origin[key]} and {here} differ.",
                        f"Write {at}.{key}.",
                    )
                given[key], origin[key] = value, here
        own = {key: value for key, value in values.items() if key != "groups"}
        given = self._values(given, origin, name) | self._values(
            own, {key: f"{at}.{self._word(key)}" for key in own}
        )
        usual = {"namespace": f"/{name}", "address": name, "user": "", "domain": None}
        return Robot(name, groups=member, **(usual | given))

    def _values(
        self, values: Mapping[str, Any], places: Mapping[str, str], name: str = ""
    ) -> dict[str, Any]:
        """Return values that are checked; those of a group get the ``name`` of the robot."""
        checked: dict[str, Any] = {}
        for key, value in values.items():
            if key == "domain":
                if type(value) is not int or not 0 <= value <= MAX_DOMAIN:
                    problem = f"A domain is a whole number from 0 to {MAX_DOMAIN}."
                    raise self._refused(places[key], value, problem)
                checked[key] = value
                continue
            if not isinstance(value, str):
                raise self._refused(places[key], value, "It is not a text.")
            checked[key] = value.replace(_OF_ROBOT, name) if name else value
            if problem := _VALUES[key](checked[key]):
                raise self._refused(places[key], value, problem)
        return checked

    def _word(self, key: str) -> str:
        return self._words.get(key, key)

    def _tables(self, table: Mapping[str, Any], key: str) -> Mapping[str, Mapping[str, Any]]:
        """Return the tables below ``key``, each by a name that is valid."""
        found = table.get(key, {})
        if not isinstance(found, dict):
            raise self._error(f"{key} is not a table", "", f"Write [{key}.NAME].")
        for name, values in found.items():
            if problem := name_problem(name):
                raise self._refused(key, name, problem)
            if not isinstance(values, dict):
                raise self._error(f"{key}.{name} is not a table", "", f"Write [{key}.{name}].")
        return found

    def _texts(self, table: Mapping[str, Any], key: str, at: str, most: int) -> tuple[str, ...]:
        values = table.get(key, [])
        where = f"{at}.{key}" if at else key
        if not isinstance(values, list) or not all(isinstance(value, str) for value in values):
            raise self._error(f"{where} is not a list of names", "", f'Write {key} = ["NAME"].')
        if len(values) > most:
            raise self._error(f"{where} has more than {most} names")
        return tuple(values)

    def _known(self, table: Mapping[str, Any], keys: Iterable[str], at: str) -> None:
        known = tuple(keys)
        for key in table:
            if key not in known:
                where = f"{at}.{_key(key)}" if at else _key(key)
                raise self._error(f"{where} is not a known key", f"There are {', '.join(known)}.")

    def _refused(self, at: str, value: object, problem: str) -> DocumentError:
        return self._error(f"{at} has {_short(value)}, which is not valid", problem)

    def _error(self, what: str, why: str = "", remedy: str = "") -> DocumentError:
        return DocumentError(f"{self._what}: {what}", why, remedy)


def _short(value: object) -> str:
    text = repr(value)
    return text if len(text) <= 80 else f"{text[:80]}..."


def _key(text: str) -> str:
    return text if text.isidentifier() and len(text) <= 80 else _short(text)


# ── writing ────────────────────────────────────────────────────────────────────────────────


def render_fleet(fleet: Fleet) -> str:
    """Return the fleet as TOML text, from which `parse_fleet` returns an equal fleet."""
    return "".join(f"{line}\n" for line in _lines(fleet))


def _lines(fleet: Fleet) -> Iterator[str]:
    if fleet.enclaves:
        yield "enclaves = ["
        yield from (f"  {json.dumps(pattern)}," for pattern in fleet.enclaves)
        yield "]"
    for group in fleet.groups:
        yield f"[groups.{group}]"
    yield "[robots]"
    for robot in fleet.robots.values():
        values: dict[str, object] = {
            "groups": list(robot.groups),
            "namespace": robot.namespace,
            "domain": robot.domain,
            "address": robot.address,
            "user": robot.user,
        }
        usual: dict[str, object] = {
            "groups": [],
            "namespace": f"/{robot.name}",
            "domain": None,
            "address": robot.name,
            "user": "",
        }
        shown = [
            f"{key} = {json.dumps(value)}" for key, value in values.items() if value != usual[key]
        ]
        yield f"{robot.name} = {{ {', '.join(shown)} }}" if shown else f"{robot.name} = {{}}"
