"""Inventories of Ansible as fleet files: hosts are robots, groups are groups.

Read are static inventories in YAML, and the JSON or YAML of ``ansible-inventory --list``.  Source:
Ansible's inventory plugin "yaml", and "Developing dynamic inventory".
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from sros_tool.errors import DocumentError, UnavailableError
from sros_tool.fleet.robots import Fleet, Robot, name_problem
from sros_tool.values import parse_json

_VALUES = {
    "namespace": "sros_namespace",
    "domain": "sros_domain",
    "address": "ansible_host",
    "user": "ansible_user",
}
"""The values of a robot, and the variables of a host that have them."""
_ROBOT = "sros_robot"
SHOWN = {"robots": "hosts", **_VALUES}
"""The words of a fleet file, and those of an inventory."""

_OF_ALL = ("all", "ungrouped", "_meta")
_MOST_DEPTH = 64
_MOST_STEPS = 200_000  # a host counts in each group, a group in each other one
_WRITE_OUT = "Write it out with `ansible-inventory -i FILE --list > hosts.json`, and name that."


def fleet_table(data: bytes, what: str, *, is_json: bool) -> dict[str, Any]:
    """Return the tables of a fleet file that state the same as an inventory.

    Args:
        data: the inventory.
        what: its name in errors.
        is_json: whether it is JSON; otherwise it is YAML.

    Raises:
        DocumentError: it is not an inventory, or one that only Ansible can read.
        UnavailableError: PyYAML is not installed.
    """
    return _Inventory(_loaded(data, what, is_json=is_json), what).table()


def connections(data: bytes, what: str, *, is_json: bool) -> dict[str, str]:
    """Map what in an inventory says how Ansible delivers keys, and whose, to its values.

    Left out is what a fleet has (`fleet_table`).  The variables of groups count together with who
    is in them; beside a template, every value counts.  Parameters and errors are those of
    `fleet_table`.
    """
    values = dict(_values_below(_loaded(data, what, is_json=is_json)))
    known = {*_VALUES.values(), _ROBOT}
    found = {
        path: text
        for path, text in values.items()
        if any(part.startswith(("ansible_", "sros_")) and part not in known for part in path)
    }
    if any("{" in text for text in found.values()):
        found = values
    elif any("vars" in path for path in found):
        found |= {path: text for path, text in values.items() if {"hosts", "children"} & {*path}}
    return {".".join(path): text for path, text in found.items()}


def _values_below(top: Mapping[str, Any]) -> Iterator[tuple[tuple[str, ...], str]]:
    """Yield everything in an inventory that is no mapping, or an empty one, with its keys."""
    left: list[tuple[tuple[str, ...], Any]] = [((), top)]
    while left:
        path, value = left.pop()
        if isinstance(value, dict) and value:
            left += [((*path, str(key)), each) for key, each in value.items()]
        else:
            yield path, str(value)


def _loaded(data: bytes, what: str, *, is_json: bool) -> Mapping[str, Any]:
    if is_json:
        try:
            value = parse_json(data)
        except ValueError as error:
            raise DocumentError(f"{what} is not valid JSON", f"{error}.") from error
    else:
        value = _load_yaml(data, what)
    if not isinstance(value, dict):
        raise DocumentError(
            f"{what} is not an inventory in YAML or JSON",
            "Its top is not a mapping of groups; an inventory in INI is not read.",
            _WRITE_OUT,
        )
    return value


def _load_yaml(data: bytes, what: str) -> Any:
    try:
        import yaml
    except ImportError as error:
        raise UnavailableError(
            f"{what} is in YAML, and PyYAML is not installed",
            "It comes with ansible-core.",
            "Run `pip install 'sros_tool[fleet]'`, or name the JSON of `ansible-inventory --list`.",
        ) from error
    loader: Any = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
    try:
        # Before the values are made: depth could end the process, aliases fill the memory.
        depth = 0
        for event in yaml.parse(data, Loader=loader):
            depth += isinstance(event, yaml.CollectionStartEvent)
            depth -= isinstance(event, yaml.CollectionEndEvent)
            if depth > _MOST_DEPTH or isinstance(event, yaml.AliasEvent):
                raise DocumentError(
                    f"{what} has an alias (*NAME), or is nested too deeply",
                    f"It is at {str(event.start_mark).strip()}.",
                    _WRITE_OUT,
                )
        return yaml.load(data, Loader=loader)  # noqa: S506 - a safe loader
    except (yaml.YAMLError, ValueError) as error:
        why = " ".join(str(error).split())
        raise DocumentError(
            f"{what} is not valid YAML of plain values", f"{why}.", _WRITE_OUT
        ) from error


_Variables = Mapping[str, tuple[int, Any]]


class _Inventory:
    def __init__(self, groups: Mapping[str, Any], what: str) -> None:
        self._what = what
        self._own: dict[str, dict[str, Any]] = {}
        """The variables of each host itself."""
        self._inherited: dict[str, dict[str, tuple[int, Any]]] = {}
        """Those of its groups, with the depth of the group: the deepest one counts."""
        self._unclear: dict[str, set[str]] = {}
        """Those that groups of the same depth set to different values."""
        self._groups: dict[str, set[str]] = {}
        self._steps = 0
        meta = self._mapping(groups.get("_meta"), "_meta")
        self._of_list = self._mapping(meta.get("hostvars"), "_meta.hostvars")
        self._top = groups

    def table(self) -> dict[str, Any]:
        for name in self._names(self._top):
            self._read(name, self._top[name], (), {})
        return {
            "groups": {name: {} for name in sorted(self._groups) if not name_problem(name)},
            "robots": dict(self._robots()),
        }

    def _names(self, groups: Mapping[str, Any]) -> Iterator[str]:
        """Yield the groups that are read from the top: those in no other one, if all are there."""
        inside: set[str] = set()
        for group in groups.values():
            children = group.get("children") if isinstance(group, dict) else None
            inside |= set(map(str, children)) if isinstance(children, (dict, list)) else set()
        for name in groups:
            if not isinstance(name, str):
                raise self._error(f"the name of a group is {name!r}, which is not a text")
            if name != "_meta" and (name not in inside or name == "all"):
                yield name

    def _read(self, name: str, group: Any, above: tuple[str, ...], variables: _Variables) -> None:
        """Read a group that is in the groups ``above``, whose ``variables`` it has, too."""
        self._step()
        if name in above or len(above) > _MOST_DEPTH:
            raise self._error(f"the group {name} is in itself, or in too many others")
        if not isinstance(group, dict):
            group = {"hosts": group} if isinstance(group, list) else self._mapping(group, name)
        inside = (*above, name)
        set_here = self._known(group.get("vars"), f"{name}.vars")
        variables = {**variables, **{key: (len(above), each) for key, each in set_here.items()}}
        if name not in _OF_ALL:
            self._groups.setdefault(name, set())
        hosts = group.get("hosts") or {}
        if isinstance(hosts, list):
            hosts = dict.fromkeys(map(str, hosts))
        for host, own in self._mapping(hosts, f"{name}.hosts").items():
            self._host(host, own, inside, variables)
        children = group.get("children") or {}
        if isinstance(children, list):  # of `ansible-inventory --list`: groups at the top
            children = {each: self._top.get(each) for each in map(str, children)}
        for child, value in self._mapping(children, f"{name}.children").items():
            self._read(child, value, inside, variables)

    def _step(self) -> None:
        self._steps += 1
        if self._steps > _MOST_STEPS:
            raise self._error(f"it names more than {_MOST_STEPS} hosts and groups in groups")

    def _host(self, host: object, own: Any, groups: tuple[str, ...], variables: _Variables) -> None:
        self._step()
        if not isinstance(host, str) or "[" in host:
            raise self._error(
                f"the host {host!r} is not a plain name",
                "A range such as r[1:50] is only read by Ansible.",
                _WRITE_OUT,
            )
        values = self._own.setdefault(host, self._known(self._of_list.get(host), host))
        values |= self._known(own, host)
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
            if group not in _OF_ALL:
                self._groups[group].add(host)

    def _known(self, value: Any, at: object) -> dict[str, Any]:
        """Return those of some variables that a fleet needs."""
        values = self._mapping(value, at)
        return {key: values[key] for key in (*_VALUES.values(), _ROBOT) if key in values}

    def _variables_of(self, host: str) -> dict[str, Any]:
        own = self._own[host]
        if unclear := sorted(self._unclear[host] - own.keys()):
            raise self._error(
                f"the host {host!r} gets {unclear[0]} from two groups that differ",
                "",
                "Set it for the host.",
            )
        return {key: value for key, (_, value) in self._inherited[host].items()} | own

    def _robots(self) -> Iterator[tuple[str, dict[str, Any]]]:
        of: dict[str, list[str]] = {host: [] for host in self._own}
        for group, hosts in self._groups.items():
            for host in hosts:
                if not name_problem(group):
                    of[host].append(group)
        named: dict[str, str] = {}
        for host in self._own:
            values = self._variables_of(host)
            name = values.get(_ROBOT, host)
            if not isinstance(name, str) or (problem := name_problem(name)):
                text = problem if isinstance(name, str) else "It is not a text."
                raise self._error(
                    f"the host {host!r} cannot be a robot by the name {name!r}",
                    text,
                    f"Give it the variable {_ROBOT}, such as {_ROBOT}: r7.",
                )
            if name in named:
                raise self._error(
                    f"the hosts {named[name]!r} and {host!r} are both the robot {name}",
                    "",
                    f"Give them different values of {_ROBOT}.",
                )
            named[name] = host
            robot = {key: values[word] for key, word in _VALUES.items() if word in values}
            domain = robot.get("domain")
            if isinstance(domain, str) and domain.isdecimal() and len(domain) < 4:
                robot["domain"] = int(domain)  # as variables of INI inventories are
            yield name, {"address": host, **robot, "groups": sorted(of[host])}

    def _mapping(self, value: Any, at: object) -> dict[Any, Any]:
        if value is None:
            return {}
        if not isinstance(value, dict):
            raise self._error(f"{str(at)[:80]!r} is not a mapping")
        return value

    def _error(self, what: str, why: str = "", remedy: str = "") -> DocumentError:
        return DocumentError(f"{self._what}: {what}", why, remedy)


# ── writing ────────────────────────────────────────────────────────────────────────────────


def inventory(fleet: Fleet) -> dict[str, Any]:
    """Return a static inventory of the robots: Ansible reads it from a file in YAML or JSON."""
    hosts = {robot.name: _variables(robot) for robot in fleet.robots.values()}
    groups: dict[str, Any] = {
        name: {"hosts": {member: {} for member in members}}
        for name, members in fleet.groups.items()
    }
    return {"all": {"hosts": hosts, **({"children": groups} if groups else {})}}


def script_inventory(fleet: Fleet) -> dict[str, Any]:
    """Return the inventory as a program prints it that Ansible runs with ``--list``."""
    ungrouped = [robot.name for robot in fleet.robots.values() if not robot.groups]
    return {
        "_meta": {"hostvars": {robot.name: _variables(robot) for robot in fleet.robots.values()}},
        "all": {"children": [*fleet.groups, "ungrouped"]},
        **{name: {"hosts": list(members)} for name, members in fleet.groups.items()},
        "ungrouped": {"hosts": ungrouped},
    }


def _variables(robot: Robot) -> dict[str, Any]:
    values = {
        "namespace": robot.namespace,
        "domain": robot.domain,
        "address": robot.address,
        "user": robot.user,
    }
    shown = {_VALUES[key]: value for key, value in values.items() if value not in (None, "")}
    return {_ROBOT: robot.name, **shown}


def is_json(data: bytes) -> bool:
    """Return whether a document begins as an object of JSON."""
    return data.lstrip()[:1] == b"{"
