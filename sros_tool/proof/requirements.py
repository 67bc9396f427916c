"""Requirements on the access of enclaves, their TOML file, and requirements that a change drops.

A requirement is a table of the file, such as::

    [[only]]
    publish = ["/cmd_vel"]
    enclaves = ["/robot/mux"]
    why = "Commands meet in one place."

Names are ROS names, with the wildcards of policies; enclaves are names or patterns, as for
``--match``, and ``!`` before a name excepts an enclave from a list.  A file can be read for a
namespace: then all enclaves, and the names without ``/`` or ``*`` at their beginning, are below it.
An enclave with ``//`` at its beginning stays: ``//tool/*`` is ``/tool/*`` in every namespace.
A file can also be read with remappings of names, such as the remappings of a node's command line.
The docstrings of the classes state the demands of the kinds.

Names and enclaves can have the placeholders of policies, which a fleet fills in.  A table with
``{robot}`` or ``{namespace}`` stands for a requirement for each robot; ``{robots}`` and
``{namespaces}`` stand for one name for each robot.

Whoever changes a policy can also change its requirements.  A requirement counts as kept if
requirements of the new file together demand at least as much, whatever their names and order.  If
the file is read for no namespace, this must be so in the namespace ``/`` and in every other
namespace.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import product
from pathlib import Path
from types import MappingProxyType
from typing import Any, ClassVar, NamedTuple

from sros_tool.checks.kind import Finding, RelatedPlace
from sros_tool.checks.requirements import DROPPED
from sros_tool.errors import DocumentError
from sros_tool.files import read_toml
from sros_tool.fleet.robots import Fleet, Robot
from sros_tool.names import expand, expression_problem, is_expression
from sros_tool.policy.model import RIGHTS, Level, Source, below_namespace
from sros_tool.policy.patterns import OTHER_NAMESPACE, covers, overlap
from sros_tool.policy.placeholders import (
    Placeholder,
    fill,
    has_placeholder,
    parts_of,
    placeholders_of,
)
from sros_tool.policy.remapping import Remapping, remapped_name
from sros_tool.policy.rights import KIND_OF
from sros_tool.values import shows
from sros_tool.wording import counted, first_few, shortened
from sros_tool.xml import read_bytes

_MOST_REQUIREMENTS = 1000
_MOST_TEXTS = 1000  # per key
_MOST_PAIRS = 20_000  # pairs of names from two lists, in all requirements of a file
_MOST_FILLED = 20_000  # after filling in the robots of a fleet
_LONGEST_TEXT = 500  # characters of a name or a reason
EXCEPT = "!"
"""Prefix of an enclave that is excepted from a list of enclaves."""
_UNMOVED = "//"
"""Beginning of an enclave that does not move with the namespace."""
_WORD_KEYS = ("name", "why")
"""Keys with words, which are in every table."""
_KEYS_WITHOUT_NAMES = (*_WORD_KEYS, "enclave", "enclaves", "from", "to", "through", "level")
"""Keys whose values are no names of topics, services or actions."""
_LEVELS = {"sign": Level.SIGN, "encrypt": Level.ENCRYPT}


class RobotNames(NamedTuple):
    """The names that a name with ``{robots}`` or ``{namespaces}`` stands for, one for each robot.

    ``own`` is the name for the requirement's robot; ``pattern`` has ``{other}`` for another robot;
    ``group`` is "" for the whole fleet.
    """

    names: tuple[str, ...]
    own: str
    pattern: str
    group: str


@dataclass(frozen=True, slots=True, kw_only=True)
class Requirement:
    """Base class of requirements.

    ``source`` is the place of the requirement's table in the file; ``name`` and ``why`` are its
    name and its reason, or "".  ``robot`` is the robot whose values replaced the placeholders, or
    "". ``of_robots`` are the lists that replaced placeholders for all robots. ``namespace`` is the
    namespace for which the file was read; ``is_relative`` says whether a name moves with it.
    ``elsewhere`` is the requirement in any other namespace; None if the file was read for a
    namespace.
    """

    KIND: ClassVar[str]

    source: Source
    name: str = ""
    why: str = ""
    robot: str = ""
    of_robots: tuple[RobotNames, ...] = field(default=(), compare=False, repr=False)
    namespace: str = field(default="/", compare=False, repr=False)
    is_relative: bool = field(default=False, compare=False, repr=False)
    elsewhere: Requirement | None = field(default=None, compare=False, repr=False)

    def __str__(self) -> str:
        """Return the requirement's name; if it has none, its demand as a sentence."""
        return self.name or demand(self)


RightNames = tuple[tuple[str, tuple[str, ...]], ...]
"""Maps rights to names, perhaps with wildcards."""


@dataclass(frozen=True, slots=True, kw_only=True)
class RightsRequirement(Requirement):
    """Base class of requirements about ``rights`` to names."""

    rights: RightNames


@dataclass(frozen=True, slots=True, kw_only=True)
class Only(RightsRequirement):
    """Only the listed ``enclaves`` may have any of the rights to any of the names.

    ``unmoved`` are the patterns among them that the file has with ``//`` at the beginning.
    """

    KIND = "only"

    enclaves: tuple[str, ...]
    unmoved: tuple[str, ...] = field(default=(), compare=False, repr=False)


@dataclass(frozen=True, slots=True, kw_only=True)
class Nobody(RightsRequirement):
    """No enclave may have any of the rights to any of the names."""

    KIND = "nobody"


@dataclass(frozen=True, slots=True, kw_only=True)
class Must(RightsRequirement):
    """The enclave must have all rights to all names."""

    KIND = "must"

    enclave: str


@dataclass(frozen=True, slots=True, kw_only=True)
class AtMost(RightsRequirement):
    """At most ``most`` enclaves may have the right to any one name.

    An enclave with a part of the right counts, such as one that may cancel the goals of an action.
    """

    KIND = "at_most"

    most: int


@dataclass(frozen=True, slots=True, kw_only=True)
class Widest(RightsRequirement):
    """By a wildcard, the enclaves may have these rights only to the listed names.

    Without listed names, they may have none of these rights by a wildcard.  Rights that state a
    name exactly are not restricted.
    """

    KIND = "widest"

    enclaves: tuple[str, ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class NothingBut(RightsRequirement):
    """The enclaves may have only these rights, and the rights that every node needs to start."""

    KIND = "nothing_but"

    enclaves: tuple[str, ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class NotBoth(Requirement):
    """No enclave may have both a right of ``first`` and a right of ``second``."""

    KIND = "not_both"

    first: RightNames
    second: RightNames


@dataclass(frozen=True, slots=True, kw_only=True)
class Protected(Requirement):
    """The messages of all ``names`` (pairs of kind and name) must be signed, or encrypted."""

    KIND = "protected"

    names: tuple[tuple[str, str], ...]
    level: Level


@dataclass(frozen=True, slots=True, kw_only=True)
class Apart(Requirement):
    """The enclaves ``sources`` must not influence ``targets``, except through ``through``."""

    KIND = "apart"

    sources: tuple[str, ...]
    targets: tuple[str, ...]
    through: tuple[str, ...] = ()


def patterns_of_enclaves(requirement: Requirement) -> tuple[str, ...]:
    """Return the enclaves and patterns of a requirement, without ``!``."""
    match requirement:
        case Only(enclaves=listed) | Widest(enclaves=listed) | NothingBut(enclaves=listed):
            pass
        case Apart(sources=sources, targets=targets, through=through):
            listed = (*sources, *targets, *through)
        case _:
            return ()
    return tuple(name.removeprefix(EXCEPT) for name in listed)


def enclaves_of(requirement: Requirement) -> tuple[str, ...]:
    """Return the enclaves and patterns of a requirement, also the enclave of `Must`."""
    if isinstance(requirement, Must):
        return (requirement.enclave,)
    return patterns_of_enclaves(requirement)


def unmoved_enclaves(requirements: Iterable[Requirement]) -> frozenset[str]:
    """Return the enclaves that requirements name with ``//``, without wildcards.

    They do not move with the namespace.
    """
    return frozenset(
        name
        for requirement in requirements
        if requirement.elsewhere
        for name in (of.removeprefix(EXCEPT) for of in enclaves_of(requirement.elsewhere))
        if name.startswith("/") and not is_expression(name)  # a name that moves is an expression
    )


def enclaves_allowed_unmoved(requirement: Requirement) -> frozenset[str]:
    """Return the `unmoved_enclaves` that an `Only` allows by these names alone.

    So a change that adds such a name to the list weakens the requirement.
    """
    if not isinstance(requirement.elsewhere, Only):
        return frozenset()
    allowed = {name for name in requirement.elsewhere.enclaves if not name.startswith(EXCEPT)}
    return frozenset(
        name
        for name in allowed & unmoved_enclaves([requirement])
        if not any(covers(pattern, name) for pattern in allowed - {name})
    )


def names_of(requirement: Requirement) -> tuple[str, ...]:
    """Return the names of topics, services and actions in a requirement."""
    match requirement:
        case RightsRequirement(rights=rights):
            pass
        case NotBoth(first=first, second=second):
            rights = (*first, *second)
        case Protected(names=names):
            return tuple(name for _, name in names)
        case _:
            return ()
    return tuple(name for _, names in rights for name in names)


def demand(requirement: Requirement) -> str:
    """Return a requirement's demand as a clause, such as ``nobody may publish /x``."""
    enclaves_text = partial(_enclaves_text, of_robots=requirement.of_robots)
    match requirement:
        case Only(rights=rights, enclaves=enclaves):
            excepted = [name[len(EXCEPT) :] for name in enclaves if name.startswith(EXCEPT)]
            if excepted and {*enclaves} == {"*", *(EXCEPT + name for name in excepted)}:
                return f"{_listed_names(excepted)} may not {_rights_text(rights)}"
            return f"only {enclaves_text(enclaves)} may {_rights_text(rights)}"
        case Nobody(rights=rights):
            return f"nobody may {_rights_text(rights)}"
        case Must(rights=rights, enclave=enclave):
            return f"{enclave} has to be able to {_rights_text(rights, 'and')}"
        case AtMost(rights=rights, most=most):
            return f"at most {most} enclave{'' if most == 1 else 's'} may {_rights_text(rights)}"
        case Widest(rights=rights, enclaves=enclaves):
            if not any(names for _, names in rights):
                rights_text = _rights_text(rights).replace(" nothing", "")
                return f"{enclaves_text(enclaves)} may use no wildcard to {rights_text}"
            return f"{enclaves_text(enclaves)} may use wildcards only to {_rights_text(rights)}"
        case NothingBut(rights=rights, enclaves=enclaves):
            return f"{enclaves_text(enclaves)} may do nothing but {_rights_text(rights)}"
        case NotBoth(first=first, second=second):
            return f"nobody may both {_rights_text(first)} and {_rights_text(second)}"
        case Protected(names=names, level=level):
            shown = _listed_names([f"{kind.removesuffix('s')} {name}" for kind, name in names])
            return f"{shown} has to be {'encrypted' if level is Level.ENCRYPT else 'signed'}"
        case Apart(sources=sources, targets=targets, through=through):
            past = f" except through {enclaves_text(through)}" if through else ""
            return f"{enclaves_text(sources)} must not influence {enclaves_text(targets)}{past}"
        case _:
            raise AssertionError(requirement)


def _rights_text(rights: RightNames, link: str = "or") -> str:
    """Return rights in words, such as ``publish /cmd_vel or call action /dock``."""
    texts = (
        f"{right}{' action' if KIND_OF[right] == 'actions' else ''} {_listed_names(names)}"
        for right, names in rights
    )
    return f" {link} ".join(texts)


def _enclaves_text(enclaves: Iterable[str], of_robots: Iterable[RobotNames]) -> str:
    """Return a list of enclaves in words, with its exceptions."""
    entries = list(enclaves)
    excepted = [name.removeprefix(EXCEPT) for name in entries if name.startswith(EXCEPT)]
    names = [name for name in entries if not name.startswith(EXCEPT)]
    shown = list(names)
    for plural in of_robots:
        if (
            plural.own in excepted
            and plural.names.count(plural.own) == 1
            and {*plural.names} <= {*shown}
        ):
            robots = f"the other robots of {plural.group}" if plural.group else "all other robots"
            shown[shown.index(plural.names[0])] = f"{plural.pattern} of {robots}"
            shown = [name for name in shown if name not in plural.names]
            names.remove(plural.own)
    # "All other robots" already names the exception of the own robot, unless other names need it.
    own_names = {plural.own for plural in of_robots} - {*names}
    excepted = [
        enclave
        for enclave in excepted
        if enclave not in own_names or any(overlap(enclave, name) for name in names)
    ]
    text = _listed_names(shown)
    return f"{text} (but not {_listed_names(excepted)})" if excepted else text


def _listed_names(names: Iterable[str]) -> str:
    """Return names in words; a long list is shortened."""
    return first_few(list(names), 4) or "nothing"


# ── reading ────────────────────────────────────────────────────────────────────────────────


FleetSource = Callable[[], Fleet | None]
"""Function that returns the robots that placeholders stand for; it is called only if needed."""


def _no_fleet() -> None:
    return None


def read_requirements(
    path: Path,
    fleet: FleetSource = _no_fleet,
    namespaces: Sequence[str] = (),
    remaps: Sequence[Remapping] = (),
) -> tuple[Requirement, ...]:
    """Return the requirements in a TOML file, in their order, for the robots of a fleet.

    With ``namespaces``, each requirement is returned once for each namespace; else for ``/``. In
    every namespace, names are remapped by ``remaps`` (from `parse_remapping_of_names`).

    Raises:
        DocumentError: the file cannot be read, or a part of it is not valid; the error has file and
            line.
        SrosError: as ``fleet`` raises it.
    """
    data = read_bytes(path, "requirements file", max_bytes=1024 * 1024)
    return parse_requirements(data, str(path), fleet, namespaces, remaps)


def read_all_requirements(
    paths: Iterable[Path],
    fleet: FleetSource = _no_fleet,
    namespaces: Sequence[str] = (),
    remaps: Sequence[Remapping] = (),
) -> tuple[Requirement, ...]:
    """Return the requirements in several TOML files; see `read_requirements`.

    Raises:
        SrosError: as `read_requirements`.
    """
    return tuple(
        requirement
        for path in paths
        for requirement in read_requirements(path, fleet, namespaces, remaps)
    )


def unused_remappings(
    paths: Iterable[Path],
    fleet: FleetSource,
    namespaces: Sequence[str],
    remaps: Iterable[Remapping],
) -> list[Remapping]:
    """Return the remapping rules without which the requirements in the files stay the same.

    Without all of these rules together, too: of two rules that move a name to the same new name,
    the one for a node counts as used.

    Raises:
        SrosError: as `read_requirements`.
    """
    paths, used = tuple(paths), list(dict.fromkeys(remaps))
    read = partial(read_all_requirements, paths, fleet, namespaces)
    requirements = read(used)
    unused = []
    for rule in sorted(used, key=lambda rule: rule.depends_on_node):
        rest = [other for other in used if other != rule]
        if read(rest) == requirements:
            used = rest
            unused.append(rule)
    return unused


def parse_requirements(
    data: bytes,
    file: str,
    fleet: FleetSource = _no_fleet,
    namespaces: Sequence[str] = (),
    remaps: Sequence[Remapping] = (),
) -> tuple[Requirement, ...]:
    """Return the requirements in a TOML document, for each of the ``namespaces``, remapped.

    ``file`` is the name of the document in errors and sources.

    Raises:
        DocumentError: a part of the document is not valid.
    """
    unfilled_tables = _stated_tables(data, file)
    filled = (
        replace(table, namespace=namespace, remaps=remaps)
        for unfilled in unfilled_tables
        for table in _filled_tables(unfilled, fleet)
        for namespace in dict.fromkeys(namespaces or ("/",))
    )
    requirements = []
    pairs_left = _MOST_PAIRS
    for table in filled:
        requirement = _READERS[table.kind](table)
        if not namespaces:
            moved = _READERS[table.kind](replace(table, namespace=OTHER_NAMESPACE, remaps=()))
            requirement = replace(requirement, elsewhere=moved)
        requirements.append(requirement)
        if len(requirements) > _MOST_FILLED:
            raise DocumentError(
                f"{table.source}: the tables up to this line stand for more than {_MOST_FILLED} "
                "requirements",
                "A table counts once for each namespace, and for each robot that fills it in.",
                "Name a group of robots, as in {robot:carriers}, or divide the file.",
            )
        pairs_left -= _number_of_pairs(requirement)
        if pairs_left < 0:
            raise DocumentError(
                f"{requirement.source}: the requirements up to this line compare more than "
                f"{_MOST_PAIRS} pairs of names",
                "Every name of one list is compared with every name of the other.",
                "Write patterns in place of names, or divide the file.",
            )
    return tuple(requirements)


def _stated_tables(data: bytes, file: str) -> list[_Table]:
    """Return the tables of a TOML document, in the order of their lines."""
    document = read_toml(data, f"the requirements file '{file}'")
    text = data.decode()
    places = _lines_of_tables(text)
    tables: list[_Table] = []
    for kind, requirements in document.items():
        if kind not in _READERS:
            line = next((number for number, name in _headers(text) if name == kind), 0)
            raise DocumentError(
                f"{Source(file, line)}: {shortened(kind)} is not a kind of requirement",
                f"The kinds are {', '.join(_READERS)}.",
            )
        lines = places.get(kind, [])
        plain = isinstance(requirements, list) and all(
            isinstance(requirement, dict) for requirement in requirements
        )
        if not plain or len(requirements) != len(lines):
            raise DocumentError(
                f"{file}: {kind} is not written as tables",
                "Every requirement needs a header line: findings state the number of this line.",
                f"Write [[{kind}]] on a line of its own before every requirement, and not inside a "
                "multi-line string.",
            )
        tables += [
            _Table(kind, table, Source(file, line), keys)
            for (line, keys), table in zip(lines, requirements, strict=True)
        ]
    if not tables:
        raise DocumentError(
            f"'{file}' has no requirement",
            "",
            'Write for example [[nobody]] and below it request = ["*/set_parameters"].',
        )
    if len(tables) > _MOST_REQUIREMENTS:
        raise DocumentError(f"'{file}' has more than {_MOST_REQUIREMENTS} requirements")
    return sorted(tables, key=lambda table: table.source.line)


def _number_of_pairs(requirement: Requirement) -> int:
    """Return the number of pairs of names to compare for a requirement with two lists."""
    match requirement:
        case NotBoth(first=first, second=second):
            first_count, second_count = (
                sum(len(names) for _, names in rights) for rights in (first, second)
            )
            return first_count * second_count
        case Apart(sources=sources, targets=targets):
            return len(sources) * len(targets)
        case _:
            return 0


_HEADER = re.compile(r"[ \t]*\[\[?[ \t]*([A-Za-z0-9_-]+)[ \t]*\]")
_KEY = re.compile(r"[ \t]*([A-Za-z0-9_-]+)[ \t]*=")


def _headers(text: str) -> Iterator[tuple[int, str]]:
    """Yield line number and name of each line that begins a TOML table."""
    for number, line in enumerate(text.split("\n"), 1):
        if header := _HEADER.match(line):
            yield number, header[1]


def _lines_of_tables(text: str) -> dict[str, list[tuple[int, dict[str, int]]]]:
    """Map each kind of requirement to its tables: pairs of a table's line and its keys' lines."""
    places: dict[str, list[tuple[int, dict[str, int]]]] = {}
    keys: dict[str, int] = {}
    for number, line in enumerate(text.split("\n"), 1):
        if header := _HEADER.match(line):
            keys = {}
            places.setdefault(header[1], []).append((number, keys))
        elif key := _KEY.match(line):
            keys.setdefault(key[1], number)
    return places


@dataclass(frozen=True, slots=True)
class _Table:
    """One TOML table with the line numbers of its keys, and checks of its values."""

    kind: str
    values: Mapping[str, Any]
    source: Source
    lines: Mapping[str, int]
    robot: str = ""
    of_robots: tuple[RobotNames, ...] = ()
    namespace: str = "/"
    remaps: Sequence[Remapping] = ()

    def common_arguments(self, *keys: str) -> dict[str, Any]:
        """Return the arguments that all requirements have.

        ``keys`` are the keys that only this kind of requirement has.

        Raises:
            DocumentError: the table has an unknown key.
        """
        known_keys = (*keys, *_WORD_KEYS)
        for key in self.values:
            if key not in known_keys:
                raise self.error(
                    key,
                    f"{shortened(key)} is not a key of [[{self.kind}]]",
                    f"Its keys are {', '.join(known_keys)}.",
                )
        texts = {key: self.text(key) if key in self.values else "" for key in _WORD_KEYS}
        robots = {"robot": self.robot, "of_robots": self.of_robots}
        values = [value for key, value in self.values.items() if key not in _KEYS_WITHOUT_NAMES]
        names = (name for name in _names_in(values) if not name.startswith(("/", "*")))
        written = {"namespace": self.namespace, "is_relative": any(names)}
        return {"source": self.source, **written, **robots, **texts}

    def text(self, key: str) -> str:
        value = self.values.get(key)
        if not isinstance(value, str) or not value or len(value) > _LONGEST_TEXT:
            raise self.error(
                key,
                f"{key} has {shortened(value)}, which is not a text",
                f"A text has 1 to {_LONGEST_TEXT} characters.",
            )
        return value

    def texts(self, key: str, *, least: int = 1) -> tuple[str, ...]:
        """Return the strings of a list value."""
        value = self.values.get(key)
        if (
            not isinstance(value, list)
            or not least <= len(value) <= _MOST_TEXTS
            or not all(isinstance(text, str) for text in value)
        ):
            raise self.error(
                key,
                f"{key} is not a list of names",
                f"A list has {least} to {_MOST_TEXTS} names in quotation marks.",
            )
        return tuple(dict.fromkeys(value))

    def names(self, key: str, *, least: int = 1) -> tuple[str, ...]:
        """Return a list of names, perhaps with wildcards, in absolute form and remapped."""
        names = self.texts(key, least=least)
        for name in names:
            problem = expression_problem(name)
            if not problem and name[0] == "~":
                problem = "It is relative to a node (~), and a requirement is about no single node."
            if not problem and name == "/":
                problem = "It is a namespace."
            if problem:
                raise self.error(key, f"{shortened(name)} is not valid in {key}", problem)
        full = (
            name if name.startswith("*") else expand(name, self.namespace, "") for name in names
        )
        remapped = (
            new for name in full for new in remapped_name(name, self.namespace, self.remaps)
        )
        return tuple(dict.fromkeys(remapped))

    def enclaves(self, key: str) -> tuple[str, ...]:
        """Return a list of enclave names and patterns; excepted enclaves begin with ``!``."""
        enclaves = self.texts(key)
        for enclave in enclaves:
            name = enclave.removeprefix(EXCEPT)
            if problem := _enclave_problem(name, "/*?["):
                raise self.error(key, f"{shortened(enclave)} is not an enclave", problem)
        if all(enclave.startswith(EXCEPT) for enclave in enclaves):
            raise self.error(
                key,
                f"the list {key} names only excluded enclaves",
                'Begin the list with "*", for all other enclaves.',
            )
        return tuple(map(self.enclave_below, enclaves))

    def enclave_below(self, enclave: str) -> str:
        """Return an enclave or pattern in the namespace; ``//`` or a wildcard keeps it out."""
        begin = EXCEPT if enclave.startswith(EXCEPT) else ""
        name = enclave.removeprefix(begin)
        if name.startswith(_UNMOVED):
            return begin + name[1:]
        return begin + below_namespace(name, self.namespace) if name.startswith("/") else enclave

    def rights(self, *, least: int = 1) -> RightNames:
        """Return the rights of the table, at least one, with at least ``least`` names each."""
        rights = tuple(
            (right, self.names(right, least=least)) for right in KIND_OF if right in self.values
        )
        if not rights:
            raise self.error(
                "", f"[[{self.kind}]] names no right", f"The rights are {', '.join(KIND_OF)}."
            )
        return rights

    def with_names(self, change: Callable[[str], list[str]]) -> _Table:
        """Return the table with other names in place of each name that has a placeholder."""

        def new_names(part: object) -> list[Any]:
            return change(part) if isinstance(part, str) and has_placeholder(part) else [part]

        def with_new_names(value: object) -> object:
            match value:
                case str():
                    return new_names(value)[0]
                case list():
                    return [name for part in value for name in new_names(part)]
                case dict():
                    return {key: with_new_names(part) for key, part in value.items()}
                case _:
                    return value

        values = {
            key: value if key in _WORD_KEYS else with_new_names(value)
            for key, value in self.values.items()
        }
        return replace(self, values=values)

    def error(self, key: str, problem: str, why: str, remedy: str = "") -> DocumentError:
        """Return an error about a key, or about the whole table if ``key`` is ""."""
        if key and key not in self.values:
            problem = f"{key} is missing in [[{self.kind}]]"
        place = Source(self.source.file, self.lines.get(key, self.source.line))
        return DocumentError(f"{place}: {problem}", why, remedy)


def _enclave_problem(name: str, beginnings: str = "/") -> str:
    """Return why an enclave in a requirement is not valid, as a sentence, or ""."""
    plain = name[1:] if name.startswith(_UNMOVED) else name
    problem = "" if name == "/" else expression_problem(plain)
    if not problem and name[0] not in beginnings:
        problem = "An enclave begins with '/'."
    return problem


# ── placeholders ───────────────────────────────────────────────────────────────────────────


def _filled_tables(table: _Table, fleet: FleetSource) -> Iterator[_Table]:
    """Yield a table with its placeholders filled in; singular placeholders make a table per robot.

    Raises:
        DocumentError: there is no fleet, or a placeholder is not valid or has no value.
    """
    used = _placeholders(table)
    if not used:
        yield table
        return
    members = _group_members(table, used, fleet())
    singular = [placeholder for placeholder in used if not placeholder.plural]
    groups = list(dict.fromkeys(placeholder.group for placeholder in singular if placeholder.group))
    if len(groups) > 1:
        raise table.error(
            used[singular[-1]],
            f"{' and '.join(map(str, singular))} are of different groups",
            "In one table, {robot} and {namespace} always stand for the same robot.",
            "Write a table for each group.",
        )
    if not singular:
        yield table.with_names(partial(_filled_names, members=members))
        return
    for robot in members[groups[0] if groups else ""]:
        filled = table.with_names(partial(_filled_names, members=members, robot=robot))
        words = {
            key: _filled_words(filled.values[key], singular, robot)
            for key in _WORD_KEYS
            if key in filled.values
        }
        of_robots = tuple(_names_of_plural_placeholders(table, members, robot))
        yield replace(
            filled, values={**filled.values, **words}, robot=robot.name, of_robots=of_robots
        )


def _placeholders(table: _Table) -> dict[Placeholder, str]:
    """Map the placeholders in the names of a table to a key whose value has the placeholder."""
    used: dict[Placeholder, str] = {}
    for key, value in table.values.items():
        for name in filter(has_placeholder, () if key in _WORD_KEYS else _names_in(value)):
            try:
                placeholders = placeholders_of(parts_of(name.removeprefix(EXCEPT)))
            except ValueError as error:
                text = f"{shortened(name)} is not valid in {key}"
                raise table.error(key, text, str(error)) from None
            if isinstance(value, str) and any(placeholder.plural for placeholder in placeholders):
                raise table.error(
                    key,
                    f"{shortened(name)} is not valid in {key}",
                    "It stands for several names, but only one can be here.",
                )
            used |= dict.fromkeys(placeholders, key)
    return used


def _group_members(
    table: _Table, used_placeholders: Mapping[Placeholder, str], fleet: Fleet | None
) -> dict[str, tuple[Robot, ...]]:
    """Map the groups of placeholders to their robots; "" stands for the whole fleet."""
    members: dict[str, tuple[Robot, ...]] = {}
    for placeholder, key in used_placeholders.items():
        if fleet is None:
            raise table.error(
                key,
                f"{placeholder} stands for robots, but no fleet says which",
                "",
                "For a policy, name the fleet file with --fleet. Give a keystore a fleet with "
                "`sros generate_artifacts --fleet`.",
            )
        try:
            robots = fleet.members(placeholder.group)
        except DocumentError as error:
            raise table.error(key, error.what, error.why, error.remedy) from error
        if not robots:
            raise table.error(
                key,
                f"{placeholder} stands for no robot",
                "A requirement about no robot would demand nothing.",
                "Name a robot of this group in the fleet file, or remove the requirement.",
            )
        members[placeholder.group] = robots
    return members


def _names_in(value: object) -> Iterator[str]:
    """Yield the names in a value of a table."""
    match value:
        case str():
            yield value
        case list():
            for part in value:
                yield from _names_in(part)
        case dict():
            for part in value.values():
                yield from _names_in(part)


def _filled_names(
    name: str, members: Mapping[str, Sequence[Robot]], robot: Robot | None = None
) -> list[str]:
    """Return the names that a name, perhaps with `EXCEPT` before it, stands for.

    ``members`` maps each group to its robots.
    """
    begin = EXCEPT if name.startswith(EXCEPT) else ""
    parts = parts_of(name.removeprefix(begin))
    if robot:
        parts = fill(parts, robot.name, robot.namespace)
    plural = placeholders_of(parts)
    filled = (
        [
            fill(parts, member.name, member.namespace, plural=True)
            for member in members[plural[0].group]
        ]
        if plural
        else [parts]
    )
    return [begin + "".join(map(str, name_parts)) for name_parts in filled]


def _names_of_plural_placeholders(
    table: _Table, members: Mapping[str, Sequence[Robot]], robot: Robot
) -> Iterator[RobotNames]:
    """Yield, for each name with a plural placeholder in a table, the names that it stands for."""
    values = [value for key, value in table.values.items() if key not in _WORD_KEYS]
    for name in filter(has_placeholder, _names_in(values)):
        if name.startswith(EXCEPT):
            continue
        parts = fill(parts_of(name), robot.name, robot.namespace)
        if plural := placeholders_of(parts):
            yield RobotNames(
                tuple(_filled_names(name, members, robot)),
                "".join(map(str, fill(parts, robot.name, robot.namespace, plural=True))),
                "".join(map(str, fill(parts, "{other}", "/{other}", plural=True))),
                plural[0].group,
            )


def _filled_words(text: object, used_placeholders: Iterable[Placeholder], robot: Robot) -> object:
    """Return the name or reason of a requirement with the values of a robot.

    ``used_placeholders`` are the placeholders in the names of the requirement, which show the group
    of the robot.
    """
    if not isinstance(text, str):
        return text
    groups = {"", *(placeholder.group for placeholder in used_placeholders)}
    for (value, robot_value), group in product(
        (("robot", robot.name), ("namespace", robot.namespace)), groups
    ):
        text = text.replace(str(Placeholder(value, group=group)), robot_value)
    return text


def _only_from(table: _Table) -> Only:
    common = table.common_arguments(*KIND_OF, "enclaves")
    enclaves = table.enclaves("enclaves")
    unmoved = tuple(
        name[1:]
        for name in table.texts("enclaves")
        if name.startswith(_UNMOVED) and is_expression(name)
    )
    return Only(**common, rights=table.rights(), enclaves=enclaves, unmoved=unmoved)


def _nobody_from(table: _Table) -> Nobody:
    return Nobody(**table.common_arguments(*KIND_OF), rights=table.rights())


def _must_from(table: _Table) -> Must:
    common = table.common_arguments(*KIND_OF, "enclave")
    enclave = table.text("enclave")
    problem = _enclave_problem(enclave)
    if is_expression(enclave):
        problem = "It has a wildcard: write a table for every enclave that must have the rights."
    if problem:
        raise table.error("enclave", f"{shortened(enclave)} is not an enclave", problem)
    return Must(**common, rights=table.rights(), enclave=table.enclave_below(enclave))


def _at_most_from(table: _Table) -> AtMost:
    common = table.common_arguments(*KIND_OF, "enclaves")
    most = table.values.get("enclaves")
    if type(most) is not int or not 0 < most < 2**31:
        raise table.error(
            "enclaves",
            f"enclaves has {shortened(most)}, which is not a whole number from 1 on",
            "Write how many enclaves may use one name, at least 1. If none may, write [[nobody]].",
        )
    return AtMost(**common, rights=table.rights(), most=most)


def _widest_from(table: _Table) -> Widest:
    common = table.common_arguments(*KIND_OF, "enclaves")
    return Widest(**common, rights=table.rights(least=0), enclaves=table.enclaves("enclaves"))


def _nothing_but_from(table: _Table) -> NothingBut:
    common = table.common_arguments(*KIND_OF, "enclaves")
    return NothingBut(**common, rights=table.rights(least=0), enclaves=table.enclaves("enclaves"))


def _not_both_from(table: _Table) -> NotBoth:
    rights: list[RightNames] = []
    common = table.common_arguments("first", "second")
    for key in ("first", "second"):
        value = table.values.get(key)
        if not isinstance(value, dict) or not value or set(value) - set(KIND_OF):
            raise table.error(
                key,
                f"{key} has {shortened(value)}, which does not state rights",
                'Write for example first = { publish = ["/cmd_vel"] }.',
            )
        line = table.lines.get(key, table.source.line)
        place = Source(table.source.file, line)
        inner = replace(table, kind=f"not_both.{key}", values=value, source=place, lines={})
        rights.append(inner.rights())
    return NotBoth(**common, first=rights[0], second=rights[1])


def _protected_from(table: _Table) -> Protected:
    common = table.common_arguments(*RIGHTS, "level")
    level = table.values.get("level")
    if not isinstance(level, str) or level not in _LEVELS:
        raise table.error(
            "level", f"level has {shortened(level)}", f"Write {' or '.join(map(repr, _LEVELS))}."
        )
    names = tuple((k, name) for k in RIGHTS if k in table.values for name in table.names(k))
    if not names:
        raise table.error("", "[[protected]] names nothing", f"Write one of {', '.join(RIGHTS)}.")
    return Protected(**common, names=names, level=_LEVELS[level])


def _apart_from(table: _Table) -> Apart:
    common = table.common_arguments("from", "to", "through")
    through = table.enclaves("through") if "through" in table.values else ()
    return Apart(
        **common, sources=table.enclaves("from"), targets=table.enclaves("to"), through=through
    )


_READERS: Mapping[str, Callable[[_Table], Requirement]] = {
    Only.KIND: _only_from,
    Nobody.KIND: _nobody_from,
    Must.KIND: _must_from,
    Protected.KIND: _protected_from,
    Apart.KIND: _apart_from,
    AtMost.KIND: _at_most_from,
    Widest.KIND: _widest_from,
    NothingBut.KIND: _nothing_but_from,
    NotBoth.KIND: _not_both_from,
}
KINDS = tuple(_READERS)
"""The kinds of requirements, as a file names them."""


@shows("change", "demand", "name", "why", "file", "line", "now")
@dataclass(frozen=True, slots=True)
class DroppedRequirement:
    """A requirement of the earlier file that the new file drops or weakens.

    ``requirement`` is the requirement of the earlier file; ``kept`` are requirements of the new
    file about some of the same names or enclaves.  ``only_elsewhere`` says that the new file
    demands the same, but not in every other namespace.
    """

    requirement: Requirement
    kept: tuple[Requirement, ...] = ()
    only_elsewhere: bool = False

    @property
    def change(self) -> str:
        """``dropped`` if the new file demands nothing similar, else ``weakened``."""
        return "weakened" if self.kept or self.only_elsewhere else "dropped"

    @property
    def demand(self) -> str:
        """The demand of the requirement, as a clause."""
        return demand(self.requirement)

    @property
    def name(self) -> str:
        """The name that the file gives the requirement, or ""."""
        return self.requirement.name

    @property
    def why(self) -> str:
        """The ``why`` of the requirement, or ""."""
        return self.requirement.why

    @property
    def file(self) -> str:
        """Path of the earlier file."""
        return self.requirement.source.file

    @property
    def line(self) -> int:
        """The line of the requirement in the earlier file."""
        return self.requirement.source.line

    @property
    def now(self) -> tuple[str, ...]:
        """The demands of the new file about some of the same names, as clauses."""
        return tuple(demand(requirement) for requirement in self.kept)

    def text(self, renamed: Collection[str] = ()) -> str:
        """Return a clause on the part of the requirement that the new file still demands.

        ``renamed`` are the rights, such as publish, whose names a change may rename: for these, the
        clause does not propose `Nobody`, which would not be enough.
        """
        if self.only_elsewhere:
            names = {*_moving_names([self.requirement])} ^ {*_moving_names(self.kept)}
            text = "the new file demands less in another namespace (`sros check --namespace`)"
            if names:
                text += f": only one of the files states {first_few(sorted(names), 3)} without the "
                text += "first '/', as a relative name"
            return text
        text = f"the new file demands less: {'; '.join(self.now)}"
        if not self.kept:
            text = "the new file has no such requirement"
        if isinstance(self.requirement, Only | AtMost):
            kept = {*_single_rights(right for e in self.kept for right in getattr(e, "rights", ()))}
            gone = [one for one in _single_rights(self.requirement.rights) if one not in kept]
            if gone := [one for one in gone if one[0] not in renamed]:
                retired = _rights_text(tuple(gone))
                text += f" (if nobody is to {retired} any more, write so in [[nobody]])"
        return text


def _moving_names(requirements: Iterable[Requirement]) -> Iterator[str]:
    """Yield the names in requirements about rights, if these names change with the namespace."""
    for requirement in requirements:
        elsewhere = requirement.elsewhere
        if isinstance(requirement, RightsRequirement) and isinstance(elsewhere, RightsRequirement):
            here, there = map(_single_rights, (requirement.rights, elsewhere.rights))
            for (_, (name,)), (_, (moved,)) in zip(here, there, strict=True):
                if name != moved:
                    yield name


def dropped_requirements(
    before: Iterable[Requirement], after: Iterable[Requirement]
) -> tuple[DroppedRequirement, ...]:
    """Return the requirements of ``before`` that ``after`` does not fully demand, in order.

    All other requirements of ``before`` hold wherever all requirements of ``after`` hold.
    """
    after = tuple(after)
    similar_requirements = similarity_to(after)
    is_demanded = _demanded_by(after)
    is_demanded_elsewhere = _demanded_by(filter(None, (new.elsewhere for new in after)))
    dropped = []
    for requirement in before:
        here, elsewhere = is_demanded(requirement), requirement.elsewhere
        if here and (elsewhere is None or is_demanded_elsewhere(elsewhere)):
            continue
        dropped.append(DroppedRequirement(requirement, similar_requirements(requirement), here))
    return tuple(dropped)


def similarity_to(
    requirements: Iterable[Requirement],
) -> Callable[[Requirement], tuple[Requirement, ...]]:
    """Return a function that returns the requirements that are similar to its argument.

    Similar requirements are of the same kind, and about some of the same names or enclaves.
    """
    parts = [(part, requirement) for requirement in requirements for part in _parts(requirement)]

    def similar_requirements(requirement: Requirement) -> tuple[Requirement, ...]:
        own_parts = tuple(_parts(requirement))
        similar = (
            other for part, other in parts if any(_is_about_same(part, own) for own in own_parts)
        )
        return tuple(dict.fromkeys(similar))

    return similar_requirements


def renamed_names(old: Requirement, new: Requirement) -> dict[tuple[str, str], str]:
    """Map rights and names of ``old`` to names of ``new`` if only these differ, else return {}."""
    if not (isinstance(old, RightsRequirement) and isinstance(new, RightsRequirement)):
        return {}
    pairs, new_pairs = [*_single_rights(old.rights)], [*_single_rights(new.rights)]
    with_new_names = _only_demand(replace(old, rights=new.rights))
    same_rights = [right for right, _ in pairs] == [right for right, _ in new_pairs]
    if not same_rights or with_new_names != _only_demand(new):
        return {}
    names = zip(pairs, new_pairs, strict=True)
    return {
        (right, name): new_name for (right, (name,)), (_, (new_name,)) in names if name != new_name
    }


def names_demanded_by(requirements: Iterable[Requirement], requirement: Requirement) -> set[str]:
    """Return the names about which ``requirements`` fully demand what ``requirement`` demands."""
    is_demanded = _demanded_by(requirements)
    return {name for part in _parts(requirement) if is_demanded(part) for name in names_of(part)}


def _demanded_by(requirements: Iterable[Requirement]) -> Callable[[Requirement], bool]:
    """Return a function that returns whether ``requirements`` fully demand a requirement."""
    parts = [part for requirement in requirements for part in _parts(requirement)]
    demands = {_only_demand(part) for part in parts}  # a fast test for equal parts

    def is_demanded(requirement: Requirement) -> bool:
        return all(
            _only_demand(old) in demands or any(_implies(part, old) for part in parts)
            for old in _parts(requirement)
        )

    return is_demanded


def dropped_findings(
    before: Iterable[Requirement],
    after: Iterable[Requirement],
    file: str,
    clauses: Mapping[Requirement, str] = MappingProxyType({}),
    renamed: Collection[str] = (),
) -> list[Finding]:
    """Return a finding for each requirement that ``after`` does not fully demand.

    ``clauses`` has texts to add to findings; ``renamed`` as for `DroppedRequirement.text`.

    The requirements that one table makes for several robots share a finding.  Its place is a table
    that still demands something about the same names; without one, it is ``file``, the path of the
    requirements ``after``.
    """
    tables: dict[tuple[Source, bool, str], list[DroppedRequirement]] = {}
    for dropped in dropped_requirements(before, after):
        alone = "" if dropped.requirement.robot else dropped.demand
        table = dropped.requirement.source, bool(dropped.kept), alone
        tables.setdefault(table, []).append(dropped)
    return [
        DROPPED.found(
            ": ".join(filter(None, (first.name, first.demand))),
            first.text(renamed)
            + clauses.get(first.requirement, "")
            + _other_robots_text([other.requirement.robot for other in others]),
            *((first.kept[0].source.file, first.kept[0].source.line) if first.kept else (file, 0)),
            related=(RelatedPlace("required before", first.file, first.line or None),),
        )
        for first, *others in tables.values()
    ]


def _other_robots_text(robots: Sequence[str]) -> str:
    if not robots:
        return ""
    return f"; the same for {counted(len(robots), 'more robot')}: {first_few(robots, 4)}"


# ── what a requirement demands, part by part ───────────────────────────────────────────────


def _parts(requirement: Requirement) -> Iterator[Requirement]:
    """Yield requirements about a single name that together demand the same as ``requirement``."""
    match requirement:
        case Widest(rights=rights, enclaves=enclaves):
            for right in rights:
                for single in _single_enclaves(enclaves):
                    yield replace(requirement, rights=(right,), enclaves=single)
        case NothingBut(enclaves=enclaves):
            for single in _single_enclaves(enclaves):
                yield replace(requirement, enclaves=single)
        case NotBoth(first=first, second=second):
            for right in _single_rights(first):
                for second_right in _single_rights(second):
                    yield replace(requirement, first=(right,), second=(second_right,))
        case (
            Only(rights=rights)
            | Nobody(rights=rights)
            | Must(rights=rights)
            | AtMost(rights=rights)
        ):
            for verb, names in rights:
                for name in names:
                    yield replace(requirement, rights=((verb, (name,)),))
        case Protected(names=pairs):
            for pair in pairs:
                yield replace(requirement, names=(pair,))
        case Apart(sources=sources, targets=targets):
            for source in _single_enclaves(sources):
                for target in _single_enclaves(targets):
                    yield replace(requirement, sources=source, targets=target)
        case _:
            raise AssertionError(requirement)


def _single_enclaves(enclaves: Sequence[str]) -> Iterator[tuple[str, ...]]:
    """Yield lists with a single enclave or pattern of a list, together with all exceptions."""
    excepted = tuple(enclave for enclave in enclaves if enclave.startswith(EXCEPT))
    yield from ((enclave, *excepted) for enclave in enclaves if not enclave.startswith(EXCEPT))


def _single_rights(
    rights: Iterable[tuple[str, tuple[str, ...]]],
) -> Iterator[tuple[str, tuple[str, ...]]]:
    """Yield pairs of a right and a single name."""
    yield from ((right, (name,)) for right, names in rights for name in names)


def _only_demand(part: Requirement) -> Requirement:
    """Return a requirement without place, name and reason, so that demands can be compared."""
    return replace(part, source=_NOWHERE, name="", why="", robot="")


_NOWHERE = Source("", 0)


def _implies(new: Requirement, old: Requirement) -> bool:
    """Return whether ``old`` certainly holds wherever ``new`` holds."""
    match new, old:
        case Nobody(), Only() | AtMost() | Nobody():
            return _right_within(old, new)
        case Only(), Only():
            return _right_within(old, new) and _enclaves_within(new.enclaves, old.enclaves)
        case Must(), Must():
            return new.enclave == old.enclave and _right_within(old, new)
        case AtMost(), AtMost():
            return new.most <= old.most and _right_within(old, new)
        case Widest(), Widest():
            ((right, names),), ((old_right, old_names),) = new.rights, old.rights
            return (
                right == old_right
                and _patterns_within(names, old_names)
                and _enclaves_within(old.enclaves, new.enclaves)
            )
        case NothingBut(), NothingBut():
            return _enclaves_within(old.enclaves, new.enclaves) and all(
                any(
                    right == old_right and _patterns_within(names, old_names)
                    for old_right, old_names in old.rights
                )
                for right, names in new.rights
                if names
            )
        case NotBoth(), NotBoth():
            pairs = ((new.first[0], old.first[0]), (new.second[0], old.second[0]))
            return all(
                new_right == old_right and covers(new_name, old_name)
                for (new_right, (new_name,)), (old_right, (old_name,)) in pairs
            )
        case Protected(), Protected():
            ((kind, name),), ((old_kind, old_name),) = new.names, old.names
            strong = new.level is old.level or new.level is Level.ENCRYPT
            return kind == old_kind and strong and covers(name, old_name)
        case Apart(), Apart():
            return (
                _enclaves_within(old.sources, new.sources)
                and _enclaves_within(old.targets, new.targets)
                and _enclaves_within(new.through, old.through)
            )
        case _:
            return False


def _right_within(part: RightsRequirement, wide: RightsRequirement) -> bool:
    """Return whether the right of ``part`` is among the rights of ``wide``."""
    ((right, (name,)),), ((wide_right, (wide_name,)),) = part.rights, wide.rights
    return right == wide_right and covers(wide_name, name)


def _patterns_within(narrow: Iterable[str], wide: Sequence[str]) -> bool:
    """Return whether each pattern of ``narrow`` is covered by a pattern of ``wide``."""
    return all(any(covers(wide_pattern, name) for wide_pattern in wide) for name in narrow)


def _enclaves_within(narrow: Sequence[str], wide: Sequence[str]) -> bool:
    """Return whether all enclaves of the list ``narrow`` are in the list ``wide``."""
    narrow_excepted, wide_excepted = (
        [name[1:] for name in enclaves if name.startswith(EXCEPT)] for enclaves in (narrow, wide)
    )
    narrow_names = [name for name in narrow if not name.startswith(EXCEPT)]
    wide_names = [name for name in wide if not name.startswith(EXCEPT)]
    still_excepted = (
        enclave
        for enclave in wide_excepted
        if any(_overlap_in_a_namespace(enclave, name) for name in narrow_names)
    )
    return _patterns_within(narrow_names, wide_names) and _patterns_within(
        still_excepted, narrow_excepted
    )


def _overlap_in_a_namespace(first: str, second: str) -> bool:
    """Return whether any name matches both patterns, in any namespace for `OTHER_NAMESPACE`."""
    if OTHER_NAMESPACE not in second:  # else, the namespace of both is the same
        first = first.replace(OTHER_NAMESPACE, "/*", 1)
    return overlap(first, second.replace(OTHER_NAMESPACE, "/*", 1))


def _is_about_same(new: Requirement, old: Requirement) -> bool:
    """Return whether both requirements are of one kind, about some equal names or enclaves."""
    if type(new) is not type(old):
        return False
    match new, old:
        case Widest(), Widest():
            same_right = new.rights[0][0] == old.rights[0][0]
            return same_right and overlap(new.enclaves[0], old.enclaves[0])
        case NothingBut(), NothingBut():
            return overlap(new.enclaves[0], old.enclaves[0])
        case NotBoth(), NotBoth():
            pairs = ((new.first[0], old.first[0]), (new.second[0], old.second[0]))
            return all(
                new_right == old_right and overlap(new_name, old_name)
                for (new_right, (new_name,)), (old_right, (old_name,)) in pairs
            )
        case Must(), Must() if new.enclave != old.enclave:
            return False
        case RightsRequirement(), RightsRequirement():
            ((right, (name,)),), ((old_right, (old_name,)),) = new.rights, old.rights
            return right == old_right and overlap(name, old_name)
        case Protected(), Protected():
            ((kind, name),), ((old_kind, old_name),) = new.names, old.names
            return kind == old_kind and overlap(name, old_name)
        case Apart(), Apart():
            same_sources = overlap(new.sources[0], old.sources[0])
            return same_sources and overlap(new.targets[0], old.targets[0])
        case _:
            raise AssertionError(old)
