"""Proposals for requirements that hold today; for a fleet, with placeholders for its robots."""

from __future__ import annotations

import json
from collections import defaultdict
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from itertools import islice
from typing import NamedTuple

from sros_tool.automata import SearchLimit
from sros_tool.fleet.robots import Fleet, Robot
from sros_tool.names import expression_problem, is_expression, moves_robot, only_reads
from sros_tool.policy.model import PEER_RIGHT, RIGHTS, Level, Source
from sros_tool.policy.patterns import matches, overlap
from sros_tool.policy.placeholders import Placeholder
from sros_tool.policy.rights import Right
from sros_tool.proof.decide import MOST_STEPS, Verdict, Worlds, influencers
from sros_tool.proof.requirements import (
    EXCEPT,
    Apart,
    Nobody,
    Only,
    Protected,
    Requirement,
    RightNames,
    Widest,
    demand,
)
from sros_tool.proof.worlds import World
from sros_tool.wording import counted, enumerated

_NOWHERE = Source("", 0)
_OF_EVERY_NODE = frozenset({"/rosout", "/parameter_events"})
_SENDING_RIGHTS = ("publish", "call", "request")
"""The rights with which an enclave sends without being asked, in the order of the proposals."""
_ENCLAVES_OF_PEOPLE = "/operator/*"
"""The enclaves of people in the policies that sros ships; `ros2 topic echo` needs wildcards."""
_MAX_HOLDERS = 3
"""Maximum number of enclaves with a right to a name that are proposed as its only users."""
_MAX_CANDIDATES = 1000
"""Maximum number of candidates for each robot, so that a person can read the proposals."""
_MAX_ROBOTS = 100
"""Maximum number of robots whose candidates are decided."""
_MAX_JOINED_NAMES = 50
"""Maximum number of names that are joined into one requirement."""


class Suggestions(NamedTuple):
    """Requirements that hold, and comments on names that move a robot without a requirement."""

    requirements: Sequence[Requirement]
    comments: Sequence[str]


def suggest(
    rights: Iterable[Right],
    worlds: Sequence[World],
    fleet: Fleet | None = None,
    *,
    is_keystore: bool = False,
) -> Suggestions:
    """Return proposals of requirements that hold in all worlds, from the allowed ``rights``.

    A requirement that `sros check` would call vacuous, in a keystore or else in a policy, is not
    proposed.  Proposals and comments that apply to all robots of ``fleet``, or of a group, are
    written once, with placeholders.

    Raises:
        DocumentError: there are too many wildcards to decide a requirement.
    """
    requirements: list[Requirement] = []
    limit = SearchLimit(MOST_STEPS)
    all_worlds, stated = Worlds(worlds), _StatedRights(rights)
    most = _MAX_CANDIDATES * min(len(fleet.robots) if fleet else 1, _MAX_ROBOTS)
    for requirement in islice(_candidates(stated, worlds), most):
        verdicts = all_worlds.decide(requirement, limit)
        if not any(
            verdict.witness or _is_vacuous(verdict, is_keystore=is_keystore)
            for _, verdict in verdicts
        ):
            last = _joined_requirement(requirements[-1], requirement) if requirements else None
            requirements[-1:] = [last] if last else [*requirements[-1:], requirement]
    missing: Iterable[Requirement] = _unreserved_moves(stated, requirements)
    if fleet:
        missing = _with_placeholders_for_robots(missing, fleet)
        requirements = [*_with_placeholders_for_robots(requirements, fleet)]
    return Suggestions(requirements, [_comment_on_unmet(each) for each in missing])


def _is_vacuous(verdict: Verdict, *, is_keystore: bool) -> bool:
    """Return whether a requirement with absolute names protects less than it states."""
    of_topics = verdict.unheard if is_keystore else ()
    clauses = (*verdict.empty, *verdict.waiting, *verdict.gone, *verdict.unserved, *of_topics)
    return bool(verdict.always or clauses)


def names_to_protect(rights: Iterable[Right]) -> set[str]:
    """Return the names that get requirements of their own if these hold for the ``rights``."""
    stated = _StatedRights(rights)
    return {
        name
        for right in _SENDING_RIGHTS
        for requirement in _requirements_on_few_holders(stated, right)
        for _, names in requirement.rights
        for name in names
    }


def _unreserved_moves(stated: _StatedRights, proposed: Iterable[Requirement]) -> Iterator[Only]:
    """Yield a requirement for each name that moves a robot, and that ``proposed`` does not reserve.

    These requirements do not hold, or were not decided.
    """
    reserved = {
        (right, name)
        for requirement in proposed
        if isinstance(requirement, Only)
        for right, names in requirement.rights
        for name in names
    }
    for (right, name), users in sorted(stated.users.items()):
        if right in _SENDING_RIGHTS and moves_robot(name) and (right, name) not in reserved:
            enclaves = tuple(sorted(users))
            yield Only(source=_NOWHERE, rights=((right, (name,)),), enclaves=enclaves)


def _comment_on_unmet(requirement: Requirement) -> str:
    """Return a comment on a requirement of one name that does not hold."""
    assert isinstance(requirement, Only)
    (right, (name,)), users = requirement.rights[0], counted(len(requirement.enclaves), "enclave")
    return (
        f"# not proposed: that only some enclaves may {right} {name} (stated for {users}, but "
        "others may do so by a wildcard, a DENY applies, or nobody has the other side)"
    )


def _joined_requirement(requirement: Requirement, other: Requirement) -> Requirement | None:
    """Return one requirement that demands the same as two, or None if that is not possible."""
    match requirement, other:
        case (
            Nobody(rights=(("request", names),)),
            Nobody(rights=(("request", more),)),
        ) if len(names) < _MAX_JOINED_NAMES:
            return replace(requirement, rights=(("request", (*names, *more)),))
        case Protected(names=names, level=level), Protected(names=more) if other.level is level:
            return replace(requirement, names=(*names, *more))
    return None


class _StatedRights:
    """The enclaves that state each right to a name, and the wildcards of each right."""

    def __init__(self, rights: Iterable[Right]) -> None:
        self.users: dict[tuple[str, str], set[str]] = defaultdict(set)
        self.wild: dict[str, set[str]] = defaultdict(set)
        self.people: set[str] = set()  # the enclaves of people that may change nodes
        self.requests_of_people: set[str] = set()
        for right in rights:
            is_of_people = matches(_ENCLAVES_OF_PEOPLE, right.enclave)
            if is_of_people and right.right == "request" and not only_reads(right.name):
                self.people.add(right.enclave)
                self.requests_of_people.add(right.name)
            if right.kind == "dds" or expression_problem(right.name):
                continue  # permissions that others wrote may have any text
            if is_expression(right.name):
                if not is_of_people:
                    self.wild[right.right].add(right.name)
            else:
                self.users[right.right, right.name].add(right.enclave)

    def names(self, right: str) -> list[str]:
        """Return the names without wildcards that a right is stated for, sorted."""
        return sorted(name for of, name in self.users if of == right)

    @cached_property
    def changing_services(self) -> Mapping[str, tuple[str, ...]]:
        """The callers of services that change nodes, for each last part of the names.

        The callers for a last part, such as ``set_parameters``, are the enclaves that may call a
        service with this last part on any node.  A last part is included only if a node offers such
        a service that no enclave may call.  The enclave of this node must have a counterpart for
        another right: otherwise, as in the policy of a package, the callers may be in another
        policy.
        """
        partners = self.enclaves_with_counterpart()
        unused = {
            name.rpartition("/")[2]
            for name in self.names("reply")
            if name.count("/") > 1
            and not only_reads(name)
            and ("request", name) not in self.users
            and self.users["reply", name] & partners
        }
        users = {
            service: {_ENCLAVES_OF_PEOPLE}
            for service in unused
            if any(overlap(name, f"*/{service}") for name in self.requests_of_people)
        }
        users |= {service: set() for service in unused - users.keys()}
        for (right, name), enclaves in self.users.items():
            if right == "request" and (service := name.rpartition("/")[2]) in unused:
                users[service] |= enclaves - self.people
        return {service: tuple(sorted(enclaves)) for service, enclaves in users.items()}

    def enclaves_with_counterpart(self) -> set[str]:
        """Return the enclaves with a right whose counterpart another enclave has."""
        return {
            enclave
            for (right, name), enclaves in self.users.items()
            if name not in _OF_EVERY_NODE
            for enclave in enclaves
            if self.users.get((PEER_RIGHT[right], name), set()) - {enclave}
        }


def _candidates(stated_rights: _StatedRights, worlds: Sequence[World]) -> Iterator[Requirement]:
    for right in _SENDING_RIGHTS:
        yield from _requirements_on_few_holders(stated_rights, right)
    yield from _requirements_on_changing_services(stated_rights)
    yield from _gate_requirements(worlds[0])
    for kind, pair in RIGHTS.items():
        if any(stated_rights.wild[right] or stated_rights.names(right) for right in pair):
            yield Protected(source=_NOWHERE, names=((kind, "/*"),), level=Level.ENCRYPT)
    for right in ("publish", "request", "call"):
        wild = tuple(sorted(stated_rights.wild[right]))
        # All enclaves as "/*", which moves with a namespace as the exception does; "*" would still
        # be the whole robot, so that a package would restrict other parts of its user's robot.
        yield Widest(
            source=_NOWHERE, rights=((right, wild),), enclaves=("/*", EXCEPT + _ENCLAVES_OF_PEOPLE)
        )


def _requirements_on_few_holders(stated_rights: _StatedRights, right: str) -> Iterator[Only]:
    """Yield a requirement for each group of up to three enclaves that are the only users of names.

    Services that only read get their own requirement, so that an exception for them does not allow
    changes, too, and so do names without a known receiver, as these may not be proposed.  Names
    that move the robot get a requirement for any number of enclaves, even without a known receiver.
    Services for which `_requirements_on_changing_services` states the same users are left out.
    """
    other = PEER_RIGHT[right]
    names: dict[tuple[tuple[str, ...], bool, bool], list[str]] = defaultdict(list)
    users_elsewhere = stated_rights.changing_services if right == "request" else {}
    for name in stated_rights.names(right):
        users = tuple(sorted(stated_rights.users[right, name]))
        received = name not in _OF_EVERY_NODE and (other, name) in stated_rights.users
        is_covered = users_elsewhere.get(name.rpartition("/")[2]) == users
        if not is_covered and (moves_robot(name) or (len(users) <= _MAX_HOLDERS and received)):
            names[users, only_reads(name), not received].append(name)
    for (enclaves, *_), names_held in sorted(
        names.items(), key=lambda item: (len(item[0][0]), item[0])
    ):
        yield Only(source=_NOWHERE, rights=((right, tuple(names_held)),), enclaves=enclaves)


def _requirements_on_changing_services(stated_rights: _StatedRights) -> Iterator[Only | Nobody]:
    """Yield requirements on services that change nodes, and that nobody may call on some nodes.

    The enclaves that may call such a service of another node are exceptions.
    """
    services: dict[tuple[str, ...], list[str]] = defaultdict(list)
    for service, users in sorted(stated_rights.changing_services.items()):
        services[users].append(f"*/{service}")
    for users, names in sorted(services.items()):
        rights = (("request", tuple(names)),)
        if users:
            yield Only(source=_NOWHERE, rights=rights, enclaves=users)
        else:
            yield from (Nobody(source=_NOWHERE, rights=(("request", (name,)),)) for name in names)


def _gate_requirements(world: World) -> Iterator[Apart]:
    """Yield a requirement for each enclave that exactly one enclave influences directly.

    The requirement: all influence on the enclave passes through this influencer.
    """
    for target, sources in sorted(influencers(world, SearchLimit()).items()):
        if len(sources) == 1:
            yield Apart(source=_NOWHERE, sources=("*",), targets=(target,), through=tuple(sources))


# ── for a fleet ────────────────────────────────────────────────────────────────────────────

Names = tuple[str, ...]


def _with_placeholders_for_robots(
    requirements: Iterable[Requirement], fleet: Fleet
) -> Iterator[Requirement]:
    """Yield requirements that demand the same, with placeholders for the robots of a fleet."""
    stated = tuple(requirements)
    by_pattern: dict[Requirement, dict[str, Requirement]] = {}
    for requirement in stated:
        robot = _robot_of(requirement, fleet)
        kind = _with_robot_placeholders(requirement, robot) if robot else requirement
        by_pattern.setdefault(kind, {})[robot.name if robot else ""] = requirement
    for kind, of_robots in by_pattern.items():
        if "" in of_robots:
            yield _with_lists(kind, lambda names, value: _joined_names(names, value, fleet))
        elif (group := _group_of(of_robots, fleet)) is not None:
            first = next(iter(of_robots))
            yield _with_robot_placeholders(of_robots[first], fleet.robots[first], group)
        else:
            yield from of_robots.values()


def _robots_in(name: str, fleet: Fleet) -> set[str]:
    """Return the robots that the ROS name ``name`` names.

    It names a robot by a component that is the robot's name, or by a namespace at the beginning
    that only this robot has.
    """
    parts = name.split("/")
    robots = fleet.robots.keys() & set(parts)
    for end in range(2, len(parts)):
        of_space = fleet.by_namespace.get("/".join(parts[:end]), ())
        robots |= set(of_space) if len(of_space) == 1 else set()
    return robots


def _robot_of(requirement: Requirement, fleet: Fleet) -> Robot | None:
    """Return the only robot that a requirement names, or None."""
    named: set[str] = set()

    def collect(names: Names, _: str) -> Names:
        named.update(*(_robots_in(name, fleet) for name in names))
        return names

    _with_lists(requirement, collect)
    return fleet.robots[named.pop()] if len(named) == 1 else None


def _with_robot_placeholders(
    requirement: Requirement, robot: Robot, group: str = ""
) -> Requirement:
    """Return a requirement with placeholders for a robot of a group."""
    return _with_lists(
        requirement,
        lambda names, value: tuple(
            _with_placeholder(e, robot, Placeholder(value, group=group)) for e in names
        ),
    )


def _with_placeholder(name: str, robot: Robot, placeholder: Placeholder) -> str:
    """Return a name with a placeholder in place of a robot's namespace or name."""
    begin, rest = "", name
    space = f"{robot.namespace}/"
    if placeholder.value == "namespace" and robot.namespace != "/" and name.startswith(space):
        begin, rest = str(placeholder), name[len(robot.namespace) :]
    word = str(placeholder._replace(value="robot"))
    return begin + "/".join(word if part == robot.name else part for part in rest.split("/"))


def _joined_names(names: Names, placeholder_value: str, fleet: Fleet) -> Names:
    """Return the names, with one placeholder for names that exist for each robot of a group."""
    names_by_pattern: dict[str, dict[str, str]] = {}
    for name in names:
        robots = _robots_in(name, fleet)
        robot = fleet.robots[robots.pop()] if len(robots) == 1 else None
        placeholder = Placeholder(placeholder_value, plural=True)
        kind = _with_placeholder(name, robot, placeholder) if robot else name
        names_by_pattern.setdefault(kind, {})[robot.name if robot else ""] = name
    joined: list[str] = []
    for of_robots in names_by_pattern.values():
        group = None if "" in of_robots else _group_of(of_robots, fleet)
        if group is None:
            joined += of_robots.values()
        else:
            first = next(iter(of_robots))
            placeholder = Placeholder(placeholder_value, plural=True, group=group)
            joined.append(_with_placeholder(of_robots[first], fleet.robots[first], placeholder))
    return tuple(joined)


def _group_of(robots: Collection[str], fleet: Fleet) -> str | None:
    """Return the group with exactly these robots, "" for the whole fleet, or None."""
    groups = {"": tuple(fleet.robots), **fleet.groups}
    return next((name for name in groups if set(groups[name]) == set(robots)), None)


def _with_lists(requirement: Requirement, change: Callable[[Names, str], Names]) -> Requirement:
    """Return a requirement with other lists of names and enclaves.

    ``change`` gets a list, and the kind of placeholder for the list: "namespace" for names, "robot"
    for enclaves.
    """

    def rights(stated: RightNames) -> RightNames:
        return tuple((right, change(names, "namespace")) for right, names in stated)

    match requirement:
        case Only() | Widest():
            return replace(
                requirement,
                rights=rights(requirement.rights),
                enclaves=change(requirement.enclaves, "robot"),
            )
        case Nobody():
            return replace(requirement, rights=rights(requirement.rights))
        case Protected():
            kinds = dict.fromkeys(kind for kind, _ in requirement.names)
            named = {
                kind: change(
                    tuple(name for of, name in requirement.names if of == kind), "namespace"
                )
                for kind in kinds
            }
            pairs = tuple((kind, name) for kind in named for name in named[kind])
            return replace(requirement, names=pairs)
        case Apart():
            return replace(
                requirement,
                sources=change(requirement.sources, "robot"),
                targets=change(requirement.targets, "robot"),
                through=change(requirement.through, "robot"),
            )
        case _:
            raise AssertionError(requirement)


# ── writing ────────────────────────────────────────────────────────────────────────────────

_HEADING = """\
# Requirements that hold for {sources} today, for all names that could ever be used.
# Keep the requirements that have to hold tomorrow, say why, and delete the others.
# In a package, leave out the first "/" of names that its users put into a namespace, and make the
# other changes of docs/howto/package.md (Requirements for a package).
"""


def render_requirements(
    requirements: Iterable[Requirement], source_names: Iterable[str], comments: Iterable[str] = ()
) -> str:
    """Return requirements as TOML, with their demands as comments, and ``comments`` at the end.

    ``source_names`` are written at the top.  `sros_tool.proof.requirements.parse_requirements`
    returns equal requirements, with other places.
    """
    lines = [_HEADING.format(sources=enumerated([*map(json.dumps, source_names)]))]
    for requirement in requirements:
        lines += [f"# {demand(requirement)}", f"[[{requirement.KIND}]]"]
        lines += [f"{key} = {_toml_value(value)}" for key, value in _values(requirement)]
        lines.append("")
    return "\n".join([*lines, *(f"{comment}\n" for comment in comments)])


def _values(requirement: Requirement) -> Iterator[tuple[str, object]]:
    match requirement:
        case Only() | Widest():
            yield from requirement.rights
            yield "enclaves", requirement.enclaves
        case Nobody():
            yield from requirement.rights
        case Protected():
            for kind in RIGHTS:
                if names := [name for of, name in requirement.names if of == kind]:
                    yield kind, names
            yield "level", requirement.level.value.lower()
        case Apart():
            yield "from", requirement.sources
            yield "to", requirement.targets
            if requirement.through:
                yield "through", requirement.through
        case _:
            raise AssertionError(requirement)


_WIDTH = 80


def _toml_value(value: object) -> str:
    if not isinstance(value, tuple | list):
        return json.dumps(value)
    texts = [json.dumps(item) for item in value]
    line = f"[{', '.join(texts)}]"
    if len(line) <= _WIDTH:
        return line
    return "\n".join(("[", *(f"  {text}," for text in texts), "]"))
