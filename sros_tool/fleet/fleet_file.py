"""Files that name the robots of a fleet: TOML, or Ansible inventories.

In an inventory, robots are hosts, and groups of robots are groups.  Static inventories in YAML can
be read, and the output of ``ansible-inventory --list`` in JSON or YAML.  Source: Ansible's
inventory plugin "yaml", and "Developing dynamic inventory".
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from shlex import quote
from types import MappingProxyType
from typing import Any

from sros_tool.dds.domains import MAX_DOMAIN
from sros_tool.errors import DocumentError, UnavailableError
from sros_tool.files import read_toml
from sros_tool.fleet.robots import (
    MAX_PATTERNS,
    MAX_ROBOTS,
    ROUTERS,
    Fleet,
    Robot,
    address_problem,
    crossing_problem,
    grace_problem,
    name_problem,
    pattern_problem,
    renewal_problem,
    robot_of,
    router_enclave_of,
    router_problem,
    size_problem,
    user_problem,
)
from sros_tool.names import distribution_problem, namespace_problem
from sros_tool.values import parse_json
from sros_tool.wording import capitalized, shortened
from sros_tool.xml import read_bytes

MAX_BYTES = 4 * 1024 * 1024
_MOST_GROUPS = 32  # groups of one robot
_MOST_CROSSING = 1_000
_VALUE_CHECKS: Mapping[str, Callable[[str], str]] = {
    "namespace": namespace_problem,
    "address": address_problem,
    "user": user_problem,
    "router": router_problem,
    "distribution": distribution_problem,
    "renewal": renewal_problem,
    "renewal_grace": grace_problem,
}
"""Settings of a robot that are text, each with a function that returns why a value is invalid."""
_GROUP_KEYS = ("domain", *_VALUE_CHECKS, "crossing")
_ROBOT_PLACEHOLDER = "{robot}"
"""The placeholder for a robot's name in the settings of a group."""


def read_fleet(path: Path) -> Fleet:
    """Return the fleet in a TOML file, or in an Ansible inventory in YAML or JSON.

    Files with the ending .yml, .yaml or .json are inventories.

    Raises:
        DocumentError: the file cannot be read, or a value in it is not valid; the error names the
            key.
        UnavailableError: an inventory in YAML is named, and PyYAML is not installed.
    """
    data, ending = read_bytes(path, "fleet file", max_bytes=MAX_BYTES), path.suffix.lower()
    if ending in _INVENTORY_SUFFIXES:
        shown_path = f"the inventory '{path}'"
        table = _table_from_inventory(data, shown_path, is_json=ending == ".json" or _is_json(data))
        return _Reader(shown_path, _SHOWN_KEYS).fleet(table)
    try:
        return parse_fleet(data, f"the fleet file '{path}'")
    except DocumentError as error:
        if ending == ".toml" or not _INI_HOST.search(data):
            raise
        raise DocumentError(
            f"'{path}' is not a fleet file in TOML",
            "It looks like an Ansible inventory in INI.",
            f"Convert it with `ansible-inventory -i {quote(str(path))} --list > hosts.json`, and "
            "name hosts.json.",
        ) from error


def read_connection_settings(path: Path) -> dict[str, str]:
    """Return an inventory's settings for the connections to its hosts; {} for a TOML file.

    The result maps the path of a key, such as ``all.vars.ansible_user``, to the value as text.

    Raises:
        SrosError: as `read_fleet`.
    """
    data, ending = read_bytes(path, "fleet file", max_bytes=MAX_BYTES), path.suffix.lower()
    if ending not in _INVENTORY_SUFFIXES:
        return {}
    return _connection_settings(
        data, f"the inventory '{path}'", is_json=ending == ".json" or _is_json(data)
    )


_INVENTORY_SUFFIXES = (".yml", ".yaml", ".json")
_INI_HOST = re.compile(rb"^[A-Za-z0-9_.-]+[ \t]*(?:$|[ \t][A-Za-z_]+=)", re.MULTILINE)
"""Matches a host line of an INI inventory: a host name, perhaps with variables after it."""


def parse_fleet(data: bytes, label: str) -> Fleet:
    """Return the fleet in a TOML document; ``label`` names the document in errors.

    Raises:
        DocumentError: the document is not TOML, or a value in it is not valid.
    """
    return _Reader(label).fleet(read_toml(data, label, longest=MAX_BYTES))


class _Reader:
    """Reader of a fleet file; ``words`` maps its keys to the words of messages (`_SHOWN_KEYS`)."""

    def __init__(self, label: str, words: Mapping[str, str] = MappingProxyType({})) -> None:
        self._what = label
        self._words = words

    def fleet(self, table: Mapping[str, Any]) -> Fleet:
        self._check_keys(table, ("groups", "robots", "enclaves", "routers"), "")
        groups = self._read_tables(table, "groups")
        robots = self._read_tables(table, "robots")
        if not robots:
            raise self._error("it names no robot", "", "Write for example [robots.r7].")
        if len(robots) > MAX_ROBOTS:
            raise self._error(f"it has more than {MAX_ROBOTS} robots", "", "Divide the fleet.")
        for name, values in groups.items():
            self._check_keys(values, _GROUP_KEYS, f"groups.{name}")
            self._read_values(values, {key: f"groups.{name}.{key}" for key in values}, "r")
        enclaves = self._read_texts(table, "enclaves", "", MAX_PATTERNS)
        routers = table.get("routers", ROUTERS)
        for key, path in (*(("enclaves", path) for path in enclaves), ("routers", routers)):
            problem = pattern_problem(path) if isinstance(path, str) else "It is not a text."
            if problem:
                raise self._invalid_value_error(key, path, problem)
        read = [self._read_robot(name, values, groups) for name, values in robots.items()]
        fleet = Fleet.of(read, groups, enclaves, routers)
        for robot in read:
            if robot.router and robot_of(fleet, router_enclave_of(fleet, robot)) != robot:
                text = (
                    f"It does not name an enclave of the robot {robot.name}. Write a path such as "
                )
                text += f"{ROUTERS}."
                raise self._invalid_value_error("routers", routers, text)
        if ambiguous := sorted(fleet.robots.keys() & fleet.groups.keys()):
            raise self._error(
                f"{shortened(ambiguous[0])} is a robot and a group",
                "Ansible would confuse them.",
                "Give one of them another name.",
            )
        if problem := size_problem(fleet):
            raise self._error("it is too large", problem, "Divide the fleet.")
        return fleet

    def _read_robot(
        self, name: str, values: Mapping[str, Any], groups: Mapping[str, Mapping[str, Any]]
    ) -> Robot:
        key_path = f"{self._shown_key('robots')}.{name}"
        self._check_keys(values, ("groups", *_GROUP_KEYS), key_path)
        member = tuple(sorted(set(self._read_texts(values, "groups", key_path, _MOST_GROUPS))))
        for group in member:
            if problem := name_problem(group):
                raise self._invalid_value_error(f"{key_path}.groups", group, problem)
        stated_values: dict[str, Any] = {}
        origin: dict[str, str] = {}
        for group in member:
            for key, value in groups.get(group, {}).items():
                group_key = f"groups.{group}.{key}"
                if key in stated_values and key not in values and stated_values[key] != value:
                    raise self._error(
                        f"the robot {name} gets its {key} from two groups",
                        f"{origin[key]} and {group_key} differ.",
                        f"Write {key_path}.{key}.",
                    )
                stated_values[key], origin[key] = value, group_key
        own_values = {key: value for key, value in values.items() if key != "groups"}
        stated_values = self._read_values(stated_values, origin, name) | self._read_values(
            own_values, {key: f"{key_path}.{self._shown_key(key)}" for key in own_values}
        )
        usual = {"namespace": f"/{name}", "address": name, "user": "", "domain": None}
        robot = Robot(name, groups=member, **(usual | stated_values))
        if robot.crossing and not robot.router:
            text = "Names can pass only through a router, and the robot has none."
            raise self._invalid_value_error(f"{key_path}.crossing", list(robot.crossing), text)
        return robot

    def _read_values(
        self, values: Mapping[str, Any], places: Mapping[str, str], name: str = ""
    ) -> dict[str, Any]:
        """Return the settings ``values`` after a check.

        ``places`` maps each key to the place that errors name. The robot's ``name`` is filled into
        the settings of a group; "" leaves placeholders as they are.
        """
        checked: dict[str, Any] = {}
        for key, value in values.items():
            if key == "domain":
                if type(value) is not int or not 0 <= value <= MAX_DOMAIN:
                    problem = f"A domain is a whole number from 0 to {MAX_DOMAIN}."
                    raise self._invalid_value_error(places[key], value, problem)
                checked[key] = value
                continue
            if key == "crossing":
                checked[key] = self._read_crossing(value, places[key], name)
                continue
            if not isinstance(value, str):
                raise self._invalid_value_error(places[key], value, "It is not a text.")
            checked[key] = value.replace(_ROBOT_PLACEHOLDER, name) if name else value
            if problem := _VALUE_CHECKS[key](checked[key]):
                raise self._invalid_value_error(places[key], value, problem)
        return checked

    def _read_crossing(self, names: Any, key_path: str, robot: str) -> tuple[str, ...]:
        table_path, _, key = key_path.rpartition(".")
        filled = []
        for name in self._read_texts({key: names}, key, table_path, _MOST_CROSSING):
            filled.append(name.replace(_ROBOT_PLACEHOLDER, robot) if robot else name)
            if problem := crossing_problem(filled[-1]):
                raise self._invalid_value_error(key_path, name, problem)
        return tuple(filled)

    def _shown_key(self, key: str) -> str:
        return self._words.get(key, key)

    def _read_tables(self, table: Mapping[str, Any], key: str) -> Mapping[str, Mapping[str, Any]]:
        """Return the tables below ``key``, by their names, which are checked."""
        tables = table.get(key, {})
        if not isinstance(tables, dict):
            raise self._error(f"{key} is not a table", "", f"Write [{key}.NAME].")
        for name, values in tables.items():
            if problem := name_problem(name):
                raise self._invalid_value_error(key, name, problem)
            if not isinstance(values, dict):
                raise self._error(f"{key}.{name} is not a table", "", f"Write [{key}.{name}].")
        return tables

    def _read_texts(
        self, table: Mapping[str, Any], key: str, key_path: str, maximum: int
    ) -> tuple[str, ...]:
        values = table.get(key, [])
        where = f"{key_path}.{key}" if key_path else key
        if not isinstance(values, list) or not all(isinstance(value, str) for value in values):
            raise self._error(f"{where} is not a list of names", "", f'Write {key} = ["NAME"].')
        if len(values) > maximum:
            raise self._error(f"{where} has more than {maximum} names")
        return tuple(values)

    def _check_keys(self, table: Mapping[str, Any], keys: Iterable[str], key_path: str) -> None:
        known = tuple(keys)
        for key in table:
            if key not in known:
                where = f"{key_path}.{_toml_key(key)}" if key_path else _toml_key(key)
                raise self._error(f"{where} is not a known key", f"There are {', '.join(known)}.")

    def _invalid_value_error(self, key_path: str, value: object, problem: str) -> DocumentError:
        return self._error(f"{key_path} has {shortened(value)}, which is not valid", problem)

    def _error(self, problem: str, why: str = "", remedy: str = "") -> DocumentError:
        return DocumentError(f"{self._what}: {problem}", why, remedy)


def _toml_key(text: str) -> str:
    return text if text.isidentifier() and len(text) <= 80 else shortened(text)


# ── writing ────────────────────────────────────────────────────────────────────────────────


def render_fleet(fleet: Fleet) -> str:
    """Return the fleet as TOML text, from which `parse_fleet` returns an equal fleet."""
    return "".join(f"{line}\n" for line in _toml_lines(fleet))


def _toml_lines(fleet: Fleet) -> Iterator[str]:
    if fleet.enclaves:
        yield "enclaves = ["
        yield from (f"  {json.dumps(pattern)}," for pattern in fleet.enclaves)
        yield "]"
    if fleet.routers != ROUTERS:
        yield f"routers = {json.dumps(fleet.routers)}"
    for group in fleet.groups:
        yield f"[groups.{group}]"
    yield "[robots]"
    for robot in fleet.robots.values():
        settings = robot._asdict()
        usual = Robot(robot.name, f"/{robot.name}", address=robot.name)._asdict()
        shown = [
            f"{key} = {json.dumps(settings[key])}"
            for key in ("groups", *_VARIABLES)
            if settings[key] != usual[key]
        ]
        yield f"{robot.name} = {{ {', '.join(shown)} }}" if shown else f"{robot.name} = {{}}"


_VARIABLES = {
    "namespace": "sros_namespace",
    "domain": "sros_domain",
    "address": "ansible_host",
    "user": "ansible_user",
    "router": "sros_router",
    "crossing": "sros_crossing",
    "distribution": "sros_distribution",
    "renewal": "sros_renewal",
    "renewal_grace": "sros_renewal_grace",
}
"""Robot setting → the Ansible host variable that has it."""
ROBOT_VARIABLE = "sros_robot"
"""The Ansible host variable with the robot's name."""
_SHOWN_KEYS = {"robots": "hosts", **_VARIABLES}
"""Word in a fleet file → word in an inventory, for messages."""

_BUILT_IN_GROUPS = ("all", "ungrouped", "_meta")
_MAX_DEPTH = 64
_MOST_STEPS = 200_000  # a host is counted once for each of its groups
_WRITE_INVENTORY = (
    "Write it out with `ansible-inventory -i FILE --list > hosts.json`, and name hosts.json."
)


def _table_from_inventory(data: bytes, label: str, *, is_json: bool) -> dict[str, Any]:
    """Convert an inventory into the tables of an equivalent fleet file.

    Args:
        data: the inventory.
        label: its name in errors.
        is_json: whether it is JSON; otherwise it is YAML.

    Raises:
        DocumentError: ``data`` is not an inventory, or is an inventory that only Ansible can read.
        UnavailableError: PyYAML is not installed.
    """
    return _Inventory(_load_inventory(data, label, is_json=is_json), label).table()


def _connection_settings(data: bytes, label: str, *, is_json: bool) -> dict[str, str]:
    """Return the settings of an inventory that decide how Ansible connects and delivers, by key.

    The settings of robots are left out (`_VARIABLES`).  If a group has variables, the members of
    the group are added, too.  If a value is a template, all values are returned.  Parameters
    and errors are the same as for `_table_from_inventory`.
    """
    values = dict(_inventory_leaves(_load_inventory(data, label, is_json=is_json)))
    known = _VARIABLES.values()  # without sros_robot, which decides whose keys a host gets
    kept = {
        path: text
        for path, text in values.items()
        if any(part.startswith(("ansible_", "sros_")) and part not in known for part in path)
    }
    if any("{" in text for text in kept.values()):
        kept = values
    elif any("vars" in path for path in kept):
        kept |= {path: text for path, text in values.items() if {"hosts", "children"} & {*path}}
    return {".".join(path): text for path, text in kept.items()}


def _inventory_leaves(top: Mapping[str, Any]) -> Iterator[tuple[tuple[str, ...], str]]:
    """Yield every leaf of an inventory: the keys that lead to it, and its text.

    A leaf is any value that is not a mapping, or an empty mapping.
    """
    remaining: list[tuple[tuple[str, ...], Any]] = [((), top)]
    while remaining:
        path, value = remaining.pop()
        if isinstance(value, dict) and value:
            remaining += [((*path, str(key)), inner) for key, inner in value.items()]
        else:
            yield path, str(value)


def _load_inventory(data: bytes, label: str, *, is_json: bool) -> Mapping[str, Any]:
    if is_json:
        try:
            value = parse_json(data)
        except ValueError as error:
            why = str(error)
            why = f"{capitalized(why)}."
            raise DocumentError(f"{label} is not valid JSON", why) from error
    else:
        value = _load_yaml(data, label)
    if not isinstance(value, dict):
        raise DocumentError(
            f"{label} is not an inventory in YAML or JSON",
            "Its top level is not a mapping of groups; sros does not read INI inventories.",
            _WRITE_INVENTORY,
        )
    return value


def _load_yaml(data: bytes, label: str) -> Any:
    try:
        import yaml
    except ImportError as error:
        raise UnavailableError(
            f"{label} is in YAML, and PyYAML is not installed",
            "PyYAML is part of ansible-core.",
            "Run `pip install ansible-core`, or name the JSON of `ansible-inventory --list`.",
        ) from error
    loader: Any = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
    try:
        # Checked before values are made: deep nesting could end the process, aliases could fill the
        # memory.
        depth = 0
        for event in yaml.parse(data, Loader=loader):
            depth += isinstance(event, yaml.CollectionStartEvent)
            depth -= isinstance(event, yaml.CollectionEndEvent)
            if depth > _MAX_DEPTH or isinstance(event, yaml.AliasEvent):
                raise DocumentError(
                    f"{label} has an alias (*NAME), or is nested too deeply",
                    f"See line {event.start_mark.line + 1}." if event.start_mark else "",
                    _WRITE_INVENTORY,
                )
        return yaml.load(data, Loader=loader)  # noqa: S506 - a safe loader
    except (yaml.YAMLError, ValueError) as error:
        why = " ".join(str(error).split())
        raise DocumentError(
            f"{label} is not valid YAML with only text, numbers, lists and mappings",
            f"{why}.",
            _WRITE_INVENTORY,
        ) from error


_Variables = Mapping[str, tuple[int, Any]]


class _Inventory:
    def __init__(self, groups: Mapping[str, Any], label: str) -> None:
        self._what = label
        self._own: dict[str, dict[str, Any]] = {}
        """Host → variables set at the host itself."""
        self._inherited: dict[str, dict[str, tuple[int, Any]]] = {}
        """Host → variables set by its groups, with the group's depth: the deepest group wins."""
        self._unclear: dict[str, set[str]] = {}
        """Host → variables that groups of the same depth set to different values."""
        self._groups: dict[str, set[str]] = {}
        self._steps = 0
        meta = self._checked_mapping(groups.get("_meta"), "_meta")
        self._of_list = self._checked_mapping(meta.get("hostvars"), "_meta.hostvars")
        self._top = groups

    def table(self) -> dict[str, Any]:
        for name in self._top_level_groups(self._top):
            self._read_group(name, self._top[name], (), {})
        return {
            "groups": {name: {} for name in sorted(self._groups) if not name_problem(name)},
            "robots": dict(self._robot_tables()),
        }

    def _top_level_groups(self, groups: Mapping[str, Any]) -> Iterator[str]:
        """Yield the top-level groups, which are in no other group."""
        inside: set[str] = set()
        for group in groups.values():
            children = group.get("children") if isinstance(group, dict) else None
            inside |= set(map(str, children)) if isinstance(children, (dict, list)) else set()
        for name in groups:
            if not isinstance(name, str):
                raise self._error(f"the name of a group is {name!r}, which is not a text")
            if name != "_meta" and (name not in inside or name == "all"):
                yield name

    def _read_group(
        self, name: str, group: Any, parent_groups: tuple[str, ...], variables: _Variables
    ) -> None:
        """Read a group; it inherits ``variables`` from the ``parent_groups`` that contain it."""
        self._count_step()
        if name in parent_groups or len(parent_groups) > _MAX_DEPTH:
            raise self._error(f"the group {name} contains itself, or is nested too deeply")
        if not isinstance(group, dict):
            group = (
                {"hosts": group} if isinstance(group, list) else self._checked_mapping(group, name)
            )
        inside = (*parent_groups, name)
        set_here = self._used_variables(group.get("vars"), f"{name}.vars")
        variables = {
            **variables,
            **{key: (len(parent_groups), value) for key, value in set_here.items()},
        }
        if name not in _BUILT_IN_GROUPS:
            self._groups.setdefault(name, set())
        hosts = group.get("hosts") or {}
        if isinstance(hosts, list):
            hosts = dict.fromkeys(map(str, hosts))
        for host, own in self._checked_mapping(hosts, f"{name}.hosts").items():
            self._read_host(host, own, inside, variables)
        children = group.get("children") or {}
        if isinstance(children, list):  # of `ansible-inventory --list`: groups at the top
            children = {group: self._top.get(group) for group in map(str, children)}
        for child, value in self._checked_mapping(children, f"{name}.children").items():
            self._read_group(child, value, inside, variables)

    def _count_step(self) -> None:
        self._steps += 1
        if self._steps > _MOST_STEPS:
            raise self._error(f"its groups have more than {_MOST_STEPS} hosts and groups in all")

    def _read_host(
        self, host: object, own: Any, groups: tuple[str, ...], variables: _Variables
    ) -> None:
        self._count_step()
        if not isinstance(host, str) or "[" in host:
            raise self._error(
                f"the host {host!r} is not a plain name",
                "Only Ansible reads a range such as r[1:50].",
                _WRITE_INVENTORY,
            )
        values = self._own.setdefault(host, self._used_variables(self._of_list.get(host), host))
        values |= self._used_variables(own, host)
        inherited = self._inherited.setdefault(host, {})
        unclear = self._unclear.setdefault(host, set())
        for key, (depth, value) in variables.items():
            before = inherited.get(key, (-1, None))
            if depth == before[0] and value != before[1]:
                unclear.add(key)
            elif depth > before[0]:
                unclear.discard(key)
                inherited[key] = depth, value
        for group in groups:
            if group not in _BUILT_IN_GROUPS:
                self._groups[group].add(host)

    def _used_variables(self, value: Any, key_path: object) -> dict[str, Any]:
        """Return the variables that a fleet uses; other variables are left out."""
        values = self._checked_mapping(value, key_path)
        return {key: values[key] for key in (*_VARIABLES.values(), ROBOT_VARIABLE) if key in values}

    def _variables_of(self, host: str) -> dict[str, Any]:
        own = self._own[host]
        if unclear := sorted(self._unclear[host] - own.keys()):
            raise self._error(
                f"the host {host!r} gets {unclear[0]} from two groups, with different values",
                "",
                "Set it for the host.",
            )
        return {key: value for key, (_, value) in self._inherited[host].items()} | own

    def _robot_tables(self) -> Iterator[tuple[str, dict[str, Any]]]:
        of: dict[str, list[str]] = {host: [] for host in self._own}
        for group, hosts in self._groups.items():
            for host in hosts:
                if not name_problem(group):
                    of[host].append(group)
        named: dict[str, str] = {}
        for host in self._own:
            values = self._variables_of(host)
            name = values.get(ROBOT_VARIABLE, host)
            if not isinstance(name, str) or (problem := name_problem(name)):
                text = problem if isinstance(name, str) else "It is not a text."
                raise self._error(
                    f"the host {host!r} cannot be a robot by the name {name!r}",
                    text,
                    f"Give it the variable {ROBOT_VARIABLE}, such as {ROBOT_VARIABLE}: r7.",
                )
            if name in named:
                raise self._error(
                    f"the hosts {named[name]!r} and {host!r} have the same robot name {name}",
                    "",
                    f"Give them different values of {ROBOT_VARIABLE}.",
                )
            named[name] = host
            robot = {key: values[word] for key, word in _VARIABLES.items() if word in values}
            domain = robot.get("domain")
            if isinstance(domain, str) and domain.isdecimal() and len(domain) < 4:
                robot["domain"] = int(domain)  # variables of INI inventories are text
            yield name, {"address": host, **robot, "groups": sorted(of[host])}

    def _checked_mapping(self, value: Any, key_path: object) -> dict[Any, Any]:
        if value is None:
            return {}
        if not isinstance(value, dict):
            raise self._error(f"{str(key_path)[:80]!r} is not a mapping")
        return value

    def _error(self, problem: str, why: str = "", remedy: str = "") -> DocumentError:
        return DocumentError(f"{self._what}: {problem}", why, remedy)


# ── writing ────────────────────────────────────────────────────────────────────────────────


def inventory(fleet: Fleet) -> dict[str, Any]:
    """Return a static inventory of the robots: Ansible reads it from a file in YAML or JSON."""
    hosts = {robot.name: _ansible_variables(robot) for robot in fleet.robots.values()}
    groups: dict[str, Any] = {
        name: {"hosts": {member: {} for member in members}}
        for name, members in fleet.groups.items()
    }
    return {"all": {"hosts": hosts, **({"children": groups} if groups else {})}}


def script_inventory(fleet: Fleet) -> dict[str, Any]:
    """Return the inventory in the form of a dynamic inventory script (``--list``)."""
    ungrouped = [robot.name for robot in fleet.robots.values() if not robot.groups]
    return {
        "_meta": {
            "hostvars": {robot.name: _ansible_variables(robot) for robot in fleet.robots.values()}
        },
        "all": {"children": [*fleet.groups, "ungrouped"]},
        **{name: {"hosts": list(members)} for name, members in fleet.groups.items()},
        "ungrouped": {"hosts": ungrouped},
    }


def _ansible_variables(robot: Robot) -> dict[str, Any]:
    settings = {**robot._asdict(), "crossing": list(robot.crossing)}
    shown = {
        variable: settings[key]
        for key, variable in _VARIABLES.items()
        if settings[key] not in (None, "", [])
    }
    return {ROBOT_VARIABLE: robot.name, **shown}


def _is_json(data: bytes) -> bool:
    """Return whether a document begins like a JSON object."""
    return data.lstrip()[:1] == b"{"
