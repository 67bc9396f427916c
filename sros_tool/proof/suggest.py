"""Requirements that hold today, proposed for a human to keep or to strike.

Candidates come from the rights as they are stated; only those are proposed that every world
confirms for all names, and that could fail.
"""

from __future__ import annotations

import json
from collections import defaultdict
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from itertools import islice

from sros_tool.automata import SearchLimit
from sros_tool.names import READING_SERVICES, expression_problem, is_expression
from sros_tool.policy.model import RIGHTS, Source
from sros_tool.policy.protection import Level
from sros_tool.policy.rights import Right
from sros_tool.proof.decide import OTHER_SIDE, Worlds
from sros_tool.proof.findings import MOST_STEPS
from sros_tool.proof.flow import influencers
from sros_tool.proof.requirements import (
    Apart,
    AtMost,
    Nobody,
    Only,
    Protected,
    Requirement,
    Widest,
    demand,
)
from sros_tool.proof.worlds import World

_NOWHERE = Source("", 0)
_OF_EVERY_NODE = frozenset({"/rosout", "/parameter_events"})
_FEW = 3
"""A name that so many enclaves may use is worth an upper limit."""
_MOST = 1000
"""Most candidates, so that a human can read what is left of them."""
_WIDE_LIST = 50
"""Most names that are joined into one requirement."""


def suggest(rights: Iterable[Right], worlds: Sequence[World]) -> tuple[Requirement, ...]:
    """Return requirements that hold in all worlds for ``rights``, which are those that are allowed.

    Raises:
        DocumentError: one cannot be decided with so many wildcards.
    """
    found: list[Requirement] = []
    limit = SearchLimit(MOST_STEPS)
    all_worlds = Worlds(worlds)
    for each in islice(_candidates(_Stated(rights), worlds), _MOST):
        verdicts = all_worlds.decide(each, limit)
        if not any(verdict.witness or verdict.empty or verdict.always for _, verdict in verdicts):
            last = _joined(found[-1], each) if found else None
            found[-1:] = [last] if last else [*found[-1:], each]
    return tuple(found)


def _joined(one: Requirement, other: Requirement) -> Requirement | None:
    """Return one requirement for two of a kind, if they demand the same of different names."""
    match one, other:
        case (
            Nobody(rights=(("request", some),)),
            Nobody(rights=(("request", more),)),
        ) if len(some) < _WIDE_LIST:
            return replace(one, rights=(("request", (*some, *more)),))
        case Protected(names=some, level=level), Protected(names=more) if other.level is level:
            return replace(one, names=(*some, *more))
    return None


class _Stated:
    """The enclaves that state each right to a name, and the wildcards of each right."""

    def __init__(self, rights: Iterable[Right]) -> None:
        self.users: dict[tuple[str, str], set[str]] = defaultdict(set)
        self.wild: dict[str, set[str]] = defaultdict(set)
        for each in rights:
            if each.kind == "dds" or expression_problem(each.name):
                continue  # permissions of others may have any text
            if is_expression(each.name):
                self.wild[each.right].add(each.name)
            else:
                self.users[each.right, each.name].add(each.enclave)

    def names(self, right: str) -> list[str]:
        """Return the names without wildcards that a right is stated for, sorted."""
        return sorted(name for of, name in self.users if of == right)


def _candidates(stated: _Stated, worlds: Sequence[World]) -> Iterator[Requirement]:
    for right in ("publish", "call", "request"):
        yield from _alone(stated, right)
    yield from _unused_services(stated)
    yield from _limits(stated)
    yield from _gates(worlds[0])
    for kind, pair in RIGHTS.items():
        if any(stated.wild[right] or stated.names(right) for right in pair):
            yield Protected(source=_NOWHERE, names=((kind, "/*"),), level=Level.ENCRYPT)
    for right in ("publish", "request", "call"):
        wild = tuple(sorted(stated.wild[right]))
        yield Widest(source=_NOWHERE, rights=((right, wild),), enclaves=("*",))


def _alone(stated: _Stated, right: str) -> Iterator[Only]:
    """Yield for each enclave the names that it alone has a right to, and others listen to."""
    other = OTHER_SIDE[right]
    names: dict[str, list[str]] = defaultdict(list)
    for name in stated.names(right):
        users = stated.users[right, name]
        if len(users) == 1 and name not in _OF_EVERY_NODE and (other, name) in stated.users:
            names[next(iter(users))].append(name)
    for enclave, found in sorted(names.items()):
        yield Only(source=_NOWHERE, rights=((right, tuple(found)),), enclaves=(enclave,))


def _unused_services(stated: _Stated) -> Iterator[Nobody]:
    """Yield the last parts of services that change something, such as ``*/set_parameters``."""
    last = {name.rpartition("/")[2] for name in stated.names("reply") if name.count("/") > 1}
    for each in sorted(last.difference(READING_SERVICES)):
        yield Nobody(source=_NOWHERE, rights=(("request", (f"*/{each}",)),))


def _limits(stated: _Stated) -> Iterator[AtMost]:
    """Yield the names that few enclaves publish, by how many they are."""
    names: dict[int, list[str]] = defaultdict(list)
    for name in stated.names("publish"):
        if name not in _OF_EVERY_NODE and ("subscribe", name) in stated.users:
            names[len(stated.users["publish", name])].append(name)
    for count in range(2, _FEW + 1):
        if names[count]:
            yield AtMost(source=_NOWHERE, rights=(("publish", tuple(names[count])),), most=count)


def _gates(world: World) -> Iterator[Apart]:
    """Yield the enclaves that all others can influence only through one of them."""
    for target, sources in sorted(influencers(world, SearchLimit()).items()):
        if len(sources) == 1:
            yield Apart(source=_NOWHERE, sources=("*",), targets=(target,), through=tuple(sources))


# ── writing ────────────────────────────────────────────────────────────────────────────────

_HEAD = """\
# Requirements that hold for {of} today, for all names that could ever be used.
# Keep those that have to hold tomorrow, say why, and strike the others.
"""


def render_requirements(requirements: Iterable[Requirement], of: str) -> str:
    """Return requirements as TOML, each with what it demands as a comment; ``of`` is in the head.

    `sros_tool.proof.requirements.parse_requirements` returns equal ones but for their places.
    """
    lines = [_HEAD.format(of=json.dumps(of))]
    for each in requirements:
        lines += [f"# {demand(each)}", f"[[{each.KIND}]]"]
        lines += [f"{key} = {_toml(value)}" for key, value in _values(each)]
        lines.append("")
    return "\n".join(lines)


def _values(requirement: Requirement) -> Iterator[tuple[str, object]]:
    match requirement:
        case Only() | Widest():
            yield from requirement.rights
            yield "enclaves", requirement.enclaves
        case AtMost():
            yield from requirement.rights
            yield "enclaves", requirement.most
        case Nobody():
            yield from requirement.rights
        case Protected():
            for kind in RIGHTS:
                if found := [name for of, name in requirement.names if of == kind]:
                    yield kind, found
            yield "level", requirement.level.value.lower()
        case Apart():
            yield "from", requirement.sources
            yield "to", requirement.targets
            if requirement.through:
                yield "through", requirement.through
        case _:
            raise AssertionError(requirement)


_WIDTH = 80


def _toml(value: object) -> str:
    if not isinstance(value, tuple | list):
        return json.dumps(value)
    texts = [json.dumps(each) for each in value]
    line = f"[{', '.join(texts)}]"
    if len(line) <= _WIDTH:
        return line
    return "\n".join(("[", *(f"  {each}," for each in texts), "]"))
