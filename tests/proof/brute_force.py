"""Requirements decided name by name, with each vendor's own decision: slow, and plainly right.

Only short names are tried, of few letters.
"""

from __future__ import annotations

from collections import defaultdict, deque
from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass
from fnmatch import fnmatchcase
from functools import lru_cache
from itertools import product

from sros_tool.names import READING_SERVICES, dds_names
from sros_tool.policy.model import RIGHTS, Level
from sros_tool.policy.patterns import matches
from sros_tool.proof.requirements import (
    Apart,
    AtMost,
    Must,
    Nobody,
    NotBoth,
    NothingBut,
    Only,
    Protected,
    Requirement,
    Widest,
)

LETTERS = "abc"
LONGEST = 4


def short_names() -> list[str]:
    """Every absolute ROS name of a few letters."""
    found = []
    for size in range(1, LONGEST):
        for letters in product(LETTERS + "/", repeat=size):
            text = "".join(letters)
            if "//" not in text and text[0] != "/" and text[-1] != "/":
                found.append(f"/{text}")
    return found


NAMES = short_names()
PARTS = ("send_goal", "cancel_goal", "get_result", "feedback", "status")
WITH_PARTS = [*NAMES, *(f"/{a}/_action/{part}" for a in LETTERS for part in PARTS)]
WRITING = {
    "publish": lambda names: names.publish,
    "subscribe": lambda names: names.subscribe,
}


def topics() -> list[str]:
    """The DDS topics of all short names."""
    return [
        f"{begin}{name}{end}"
        for begin, end in (("rt", ""), ("rq", "Request"), ("rr", "Reply"))
        for name in WITH_PARTS
    ]


TOPICS = topics()
SHORT = frozenset(TOPICS)


@dataclass(frozen=True)
class Finite:
    """The short topics that each enclave may write and read, and those stated without wildcards."""

    writes: Mapping[str, frozenset[str]]
    reads: Mapping[str, frozenset[str]]
    stated: Mapping[tuple[str, bool], frozenset[str]]
    level: Callable[[str], int]
    """How well the messages of a topic are protected: 0, 1 (signed), or 2 (encrypted)."""
    own: Finite | None = None
    """What each enclave may do by its own permissions, if it can use those of others, too."""

    def lending(self) -> Finite:
        """The world of a vendor that takes the permissions of ``/a/b`` for those of ``/a``, too."""

        def with_fitting(enclave: str, of: Callable[[str], frozenset[str]]) -> frozenset[str]:
            parts = set(enclave.split("/"))
            fitting = (each for each in self.writes if parts <= set(each.split("/")))
            return frozenset().union(*map(of, fitting))

        return Finite(
            {each: with_fitting(each, self.writes.__getitem__) for each in self.writes},
            {each: with_fitting(each, self.reads.__getitem__) for each in self.writes},
            {
                (e, side): with_fitting(e, lambda of: self.stated[of, side])  # noqa: B023
                for e, side in self.stated
            },
            self.level,
            self,
        )

    def may(self, enclave: str, writes: bool, topic: str) -> bool:
        """Whether an enclave may write or read a topic."""
        return topic in (self.writes if writes else self.reads).get(enclave, ())


_RANK = {Level.SIGN: 1, Level.ENCRYPT: 2}


Uses = Collection[tuple[str, str]]
"""Pairs of an enclave and a topic."""


def breaches(requirement: Requirement, world: Finite) -> Iterator[tuple[str, ...]]:
    """Yield what breaks a requirement: the name, or the enclaves of a chain."""
    match requirement:
        case Only() | Nobody():
            allowed = requirement.enclaves if isinstance(requirement, Only) else ()
            for enclave in world.writes:
                if not listed(allowed, enclave):
                    for name, topic, writes in doings(requirement.rights):
                        if world.may(enclave, writes, topic):
                            yield (name,)
        case Must(enclave=enclave):
            world = world.own or world
            for right, patterns in requirement.rights:
                for name in WITH_PARTS:
                    needed = dds_names(right, name)
                    if not SHORT.issuperset((*needed.publish, *needed.subscribe)):
                        continue  # an action whose topics are too long to be tried
                    able = all(world.may(enclave, True, each) for each in needed.publish) and all(
                        world.may(enclave, False, each) for each in needed.subscribe
                    )
                    if any(matches(each, name) for each in patterns) and not able:
                        yield (name,)
        case AtMost(most=most):
            holders: dict[tuple[str, str], set[str]] = defaultdict(set)
            for right, patterns in requirement.rights:
                for name, topic, writes in doings(((right, patterns),)):
                    users = (each for each in world.writes if world.may(each, writes, topic))
                    holders[right, name].update(users)
            for (_, name), found in holders.items():
                if len(found) > most:
                    yield (name,)
        case Widest():
            for enclave in world.writes:
                if listed(requirement.enclaves, enclave):
                    for right, patterns in requirement.rights:
                        for name, topic, writes in doings(((right, ("*",)),)):
                            if any(matches(each, name) for each in patterns):
                                continue
                            if topic not in world.stated[enclave, writes] and world.may(
                                enclave, writes, topic
                            ):
                                yield (name,)
        case NothingBut(rights=rights, enclaves=enclaves):
            every = [dds_names(right, name) for right, names in rights for name in names]
            for enclave in (each for each in world.writes if listed(enclaves, each)):
                for side, given in enumerate((world.writes, world.reads)):
                    for topic in given[enclave]:
                        if not any(matches(each, topic) for pair in every for each in pair[side]):
                            yield (topic[2:].removesuffix("Request").removesuffix("Reply"),)
        case NotBoth(first=first, second=second):
            for enclave in world.writes:
                one, other = (
                    [n for n, topic, writes in doings(of) if world.may(enclave, writes, topic)]
                    for of in (first, second)
                )
                yield from ((name,) for name in one if other)
        case Protected(names=pairs, level=level):
            for kind, pattern in pairs:
                for name in (each for each in WITH_PARTS if matches(pattern, each)):
                    if any(world.level(each) < _RANK[level] for each in topics_of(kind, name)):
                        yield (name,)
        case Apart():
            yield from chains(requirement, world)
        case _:
            raise AssertionError(requirement)


def listed(patterns: Collection[str], enclave: str) -> bool:
    """Whether a list of enclaves, of which some are excepted, has an enclave."""
    fits = {each[0] == "!" for each in patterns if fnmatchcase(enclave, each.lstrip("!"))}
    return fits == {False}


def doings(rights: Collection[tuple[str, tuple[str, ...]]]) -> Iterator[tuple[str, str, bool]]:
    """Yield name, topic and whether to write it, for each topic that lets one do a right."""
    for right, patterns in rights:
        for name in WITH_PARTS:
            if any(matches(each, name) for each in patterns):
                needed = dds_names(right, name)
                yield from ((name, topic, True) for topic in needed.publish)
                if right == "subscribe":
                    yield from ((name, topic, False) for topic in needed.subscribe)


@lru_cache(None)
def topics_of(kind: str, name: str) -> frozenset[str]:
    """The DDS topics of a topic, service or action."""
    return frozenset(t for right in RIGHTS[kind] for side in dds_names(right, name) for t in side)


QUESTIONS = tuple(f"rq/*/{each}Request" for each in READING_SERVICES)


def chains(requirement: Apart, world: Finite) -> Iterator[tuple[str, ...]]:
    """Yield a shortest chain of enclaves for each source and target."""

    def among(patterns: Collection[str]) -> list[str]:
        return [each for each in world.writes if listed(patterns, each)]

    through = set(among(requirement.through))
    for source in among(requirement.sources):
        before: dict[str, tuple[str, ...]] = {source: (source,)}
        queue = deque([source] if source not in through else [])
        while queue:
            here = queue.popleft()
            for there in world.writes:
                flow = world.writes[here] & world.reads[there]
                if there not in before and there not in through and any(map(counts, flow)):
                    before[there] = (*before[here], there)
                    queue.append(there)
        for target in among(requirement.targets):
            if target in before and target != source:
                yield before[target]


def counts(topic: str) -> bool:
    """Whether a topic carries information from one enclave to another."""
    return topic != "rt/parameter_events" and not any(matches(each, topic) for each in QUESTIONS)


Decide = Callable[[str, bool, str], bool]


def finite(
    enclaves: Collection[str],
    stated: Mapping[tuple[str, bool], frozenset[str]],
    decide: Decide,
    level: Callable[[str], int],
) -> Finite:
    """The world in which ``decide`` says whether an enclave may write (or read) a topic."""
    sides = [
        {
            each: frozenset(topic for topic in TOPICS if decide(each, writes, topic))
            for each in enclaves
        }
        for writes in (True, False)
    ]
    return Finite(sides[0], sides[1], stated, level)
