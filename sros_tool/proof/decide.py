"""Decide whether requirements hold in a world, for all names.

For each broken requirement there is a witness, which shows how it is broken.  "To do" something
means to write one of its DDS topics: whoever may write the requests of a service can have them
executed, even without the right to read the replies.  "To subscribe" means to read. Only a
requirement that an enclave must have a right needs all topics of the right.

This module reads no files.
"""

from __future__ import annotations

import fnmatch
from collections import Counter, defaultdict, deque
from collections.abc import Callable, Collection, Container, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from itertools import product
from string import ascii_letters
from typing import NamedTuple

from sros_tool.automata import NameSet, SearchLimit
from sros_tool.names import (
    ACTION_SEPARATOR,
    ROS_DISCOVERY_TOPIC,
    SERVICE_ENDS,
    dds_names,
    is_expression,
    right_to_use,
)
from sros_tool.policy.model import OFFERING_RIGHT, PEER_RIGHT, RIGHTS, below_namespace
from sros_tool.policy.patterns import OTHER_NAMESPACE, covers
from sros_tool.policy.rights import KIND_OF, is_of_every_node
from sros_tool.proof.requirements import (
    EXCEPT,
    Apart,
    AtMost,
    Must,
    Nobody,
    NotBoth,
    NothingBut,
    Only,
    Protected,
    Requirement,
    RightNames,
    Widest,
    patterns_of_enclaves,
)
from sros_tool.proof.worlds import (
    ANYBODY,
    Topics,
    TopicUser,
    World,
    names_of_expression,
    shortest,
    valid_topics,
)
from sros_tool.reach import OF_EVERY_NODE, QUESTIONS
from sros_tool.wording import counted

MOST_STEPS = 8_000_000
"""Maximum number of search steps for names that several wildcards match: about twenty seconds."""


@dataclass(frozen=True, slots=True)
class Use:
    """A use of a DDS topic by an enclave, which writes or reads it.

    ``right`` is the right to the ROS name ``name`` to which the topic belongs; "" for a DDS topic
    without a ROS name.
    """

    enclave: str
    right: str
    name: str
    topic: str
    writes: bool


@dataclass(frozen=True, slots=True)
class Witness:
    """The reason why a requirement does not hold: a shortest list of forbidden or missing uses.

    For influence, the uses are a chain: after each use that writes comes the use that reads.
    ``others`` has an entry for each further enclave that breaks the requirement: the same uses by
    that enclave if it has them, otherwise other uses that break it.  For influence, the entry is
    the same chain with the further enclave in the place of another one.
    """

    uses: tuple[Use, ...]
    others: tuple[tuple[Use, ...], ...] = ()

    @property
    def enclaves(self) -> tuple[str, ...]:
        """The enclaves of the uses, in order, without duplicates."""
        return tuple(dict.fromkeys(use.enclave for use in self.uses))

    def led_by_new(self, known: frozenset[str]) -> Witness:
        """Return the same witness, first with uses of enclaves that are not all ``known``.

        Enclaves that only together break a requirement keep their order.
        """
        if len(self.uses) > max(map(len, self.others), default=0):
            return self
        chains = [self.uses, *self.others]
        chains.sort(key=lambda uses: known.issuperset(use.enclave for use in uses))
        return Witness(chains[0], tuple(chains[1:]))


@dataclass(frozen=True, slots=True)
class Verdict:
    """The decision on a requirement in one world.

    ``witness`` is None if the requirement holds.  ``empty`` are clauses on enclaves under the
    requirement that do not exist, and on names that no enclave may use.  ``absent`` are the
    exceptions (enclaves or patterns) that fit no enclave.  ``waiting`` are clauses on
    names that no enclave may use yet, but whose other side an enclave has; ``gone`` are the same on
    a robot, if the name was probably changed. ``always`` is a clause that says why the requirement
    cannot fail whatever rights enclaves get, or "".  ``assumed`` is a
    name whose protection is assumed because the policy does not state it, or "".  ``blocked`` is a
    demanded use whose messages do not pass between Zenoh routers, or None. ``unnamed`` are names in
    the requirement that no right states, and that only wildcards match. ``unserved`` are clauses on
    services and actions that an enclave may use, and that nobody serves; ``unheard`` are clauses on
    topics of which enclaves have only the right in the requirement. ``by_name`` are uses that an
    `Only` allows only by `patterns_of_any_package` or by its ``unmoved`` patterns.
    """

    requirement: Requirement
    witness: Witness | None
    empty: tuple[str, ...] = ()
    waiting: tuple[str, ...] = ()
    gone: tuple[str, ...] = ()
    always: str = ""
    assumed: str = ""
    blocked: BlockedUse | None = None
    unnamed: tuple[str, ...] = ()
    absent: tuple[str, ...] = ()
    by_name: tuple[Use, ...] = ()
    unserved: tuple[str, ...] = ()
    unheard: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class BlockedUse:
    """A use whose messages do not pass between Zenoh routers to or from the enclaves ``others``."""

    use: Use
    others: tuple[str, ...]


class Worlds:
    """Several worlds in which requirements are decided.

    Worlds with equal access share a decision; the engine of every world confirms the witness.
    """

    def __init__(self, worlds: Iterable[World]) -> None:
        self._first_alike: dict[World, World] = {}
        for world in worlds:
            known = self._first_alike.values()
            alike = (earlier for earlier in known if world.has_same_access(earlier))
            self._first_alike[world] = next(alike, world)

    def decide(
        self, requirement: Requirement, limit: SearchLimit
    ) -> Iterator[tuple[World, Verdict]]:
        """Yield each world with its verdict.

        Raises:
            DocumentError: there are too many wildcards to decide the requirement.
        """
        known: dict[World, Verdict] = {}
        for world, representative in self._first_alike.items():
            if representative is world:
                known[world] = decide(requirement, world, limit)
            elif witness := known[representative].witness:
                _confirm(requirement, witness, world)
            yield world, known[representative]


def decide(requirement: Requirement, world: World, limit: SearchLimit | None = None) -> Verdict:
    """Return the decision on a requirement; decisions for one question share ``limit``.

    Raises:
        DocumentError: there are too many wildcards to decide the requirement.
    """
    limit = limit or SearchLimit()
    match requirement:
        case Only() | Nobody():
            witness = _witness_against_only(requirement, world, limit)
        case Must():
            witness = _witness_against_must(requirement, world, limit)
        case AtMost():
            witness = _witness_against_at_most(requirement, world, limit)
        case Widest():
            witness = _witness_against_widest(requirement, world, limit)
        case NothingBut():
            witness = _witness_against_nothing_but(requirement, world, limit)
        case NotBoth():
            witness = _witness_against_not_both(requirement, world, limit)
        case Protected():
            witness = _witness_against_protected(requirement, world, limit)
        case Apart():
            witness = _witness_against_apart(requirement, world, limit)
        case _:
            raise AssertionError(requirement)
    if witness:
        _confirm(requirement, witness, world)
    unused_names = _unused_names(requirement, world, limit)
    missing, exceptions = _missing_enclaves(requirement, world)
    meant = (
        (name, similar_enclave_clause(name, world.enclaves))
        for name in missing
        if name not in world.away
    )
    empty = (
        *(f"there is no enclave {name}{clause}" for name, clause in meant),
        *unused_names.unused,
    )
    always = "" if witness or empty or missing else _why_never_fails(requirement, world)
    assumed = "" if witness else _assumed_protection(requirement, world, limit)
    blocked = None
    if isinstance(requirement, Must) and not witness and world.crossing:
        blocked = _use_blocked_by_routers(requirement, world, limit)
    by_name = _uses_by_name(requirement, world, limit) if isinstance(requirement, Only) else ()
    return Verdict(
        requirement,
        witness,
        empty,
        waiting=tuple(unused_names.waiting),
        gone=tuple(unused_names.gone),
        always=always,
        assumed=assumed,
        blocked=blocked,
        unnamed=tuple(unused_names.unnamed),
        absent=tuple(name for name in exceptions if name.removeprefix(EXCEPT) not in world.away),
        by_name=tuple(by_name),
        unserved=tuple(unused_names.unserved),
        unheard=tuple(unused_names.unheard),
    )


def _confirm(requirement: Requirement, witness: Witness, world: World) -> None:
    """Check a witness with the decision engine of the world.

    The engine has to allow each use in the witness, or, for a `Must`, deny each use.

    Raises:
        AssertionError: the engine decides otherwise.
    """
    if isinstance(requirement, Protected):
        return
    may = not isinstance(requirement, Must)
    if not may and any(use.enclave in world.idle for use in witness.uses):
        return
    worlds = (world, *(world.elsewhere if isinstance(requirement, Apart) else ()))
    for use in witness.uses:
        confirm = any(
            (world.confirm if may else world.confirm_own)(use.enclave, use.writes, use.topic)
            for world in worlds
        )
        if confirm is not may:
            raise AssertionError(f"{world.title} decides otherwise on {use}, for {requirement}")


# ── rights and their topics ────────────────────────────────────────────────────────────────

_NAME_MARK = "\0"


@dataclass(frozen=True, slots=True)
class _TopicOfRight:
    """One of the DDS topics that a right needs: the text before and after the ROS name."""

    writes: bool
    begin: str
    end: str

    @property
    def added_bytes(self) -> int:
        """Number of bytes that the topic has in addition to the name."""
        return len(self.begin) + len(self.end)

    def topics(self, name: str) -> Topics:
        return Topics(self.begin, name, self.end)


@lru_cache(maxsize=16)
def _parts_of(right: str) -> tuple[_TopicOfRight, ...]:
    """Return the DDS topics that a right needs."""
    names = dds_names(right, _NAME_MARK)
    return tuple(
        _TopicOfRight(writes, *topic.split(_NAME_MARK))
        for writes, topics in ((True, names.publish), (False, names.subscribe))
        for topic in topics
    )


@lru_cache(maxsize=16)
def _sufficient_parts(right: str) -> tuple[_TopicOfRight, ...]:
    """Return the DDS topics of a right, each of which is enough for a part of the right."""
    return tuple(part for part in _parts_of(right) if part.writes or right == "subscribe")


def _topics_of_rights(rights: RightNames) -> Iterator[tuple[str, _TopicOfRight, Topics]]:
    """Yield each right, each of its sufficient DDS topics, and that topic for each name."""
    for right, names in rights:
        for name in names:
            for part in _sufficient_parts(right):
                yield right, part, part.topics(name)


def _matching_enclaves(
    patterns: Sequence[str], enclaves: Collection[str], namespace: str = "/"
) -> set[str]:
    """Return the enclaves that match a pattern of the list, and no exception in the list.

    The enclaves are in a namespace, but are written without it; `OTHER_NAMESPACE` in a pattern
    stands for this namespace.
    """
    matching: set[str] = set()
    excepted: set[str] = set()
    below = {below_namespace(path, namespace): path for path in enclaves}
    for pattern in patterns:
        to = excepted if pattern[0] == EXCEPT else matching
        name = pattern.removeprefix(EXCEPT).replace(OTHER_NAMESPACE, namespace)
        to.update(below[path] for path in fnmatch.filter(below, name))
    return matching - excepted


def restricted_enclaves(
    requirement: Requirement, enclaves: Collection[str], namespace: str = "/"
) -> tuple[set[str], ...]:
    """Return the sets of enclaves that a requirement restricts; () if it restricts all or none.

    The requirement and the enclaves are in ``namespace``, but are written without it.
    """
    match requirement.elsewhere if requirement.elsewhere and namespace != "/" else requirement:
        case Only(enclaves=listed):
            return (set(enclaves) - _matching_enclaves(listed, enclaves, namespace),)
        case Widest(enclaves=listed) | NothingBut(enclaves=listed):
            return (_matching_enclaves(listed, enclaves, namespace),)
        case Apart(sources=sources, targets=targets, through=through):
            free = _matching_enclaves(through, enclaves, namespace)
            return tuple(
                _matching_enclaves(ends, enclaves, namespace) - free for ends in (sources, targets)
            )
    return ()


def _use(enclave: str, right: str, part: _TopicOfRight, topics: Topics, topic: str) -> Use:
    return Use(enclave, right, topics.ros_name(topic), topic, part.writes)


def _use_order(use: Use) -> tuple[int, str, str]:
    """Return a sort key for uses that puts short names first."""
    return len(use.name), use.name, use.enclave


# ── who may do what ────────────────────────────────────────────────────────────────────────


def _witness_against_only(
    requirement: Only | Nobody, world: World, limit: SearchLimit
) -> Witness | None:
    allowed = requirement.enclaves if isinstance(requirement, Only) else ()
    return _shortest_use_as_witness(_uses_of_rights(requirement.rights, world, limit, allowed))


def _uses_of_rights(
    rights: RightNames, world: World, limit: SearchLimit, excluded: Sequence[str] = ()
) -> Mapping[str, Sequence[Use]]:
    """Map each enclave with uses of the rights to these uses; leave out ``excluded`` enclaves."""
    left_out = _matching_enclaves(excluded, world.enclaves)
    uses: defaultdict[str, list[Use]] = defaultdict(list)
    for right, part, topics in _topics_of_rights(rights):
        for met in world.side(part.writes).users_of_topics(topics, limit):
            if met.enclave in left_out:
                continue
            if topic := world.example_of_use(met, topics, limit):
                uses[met.enclave].append(_use(met.enclave, right, part, topics, topic))
    return uses


def _uses_by_name(requirement: Only, world: World, limit: SearchLimit) -> Iterator[Use]:
    """Yield a use of each enclave that is not in the list by its name, or by a pattern of its own.

    Only `patterns_of_any_package` or ``unmoved`` patterns allow it.
    """
    open_patterns = {*patterns_of_any_package(requirement), *requirement.unmoved}
    if not open_patterns:
        return
    clear = [name for name in requirement.enclaves if name not in open_patterns]
    allowed = _matching_enclaves(requirement.enclaves, world.enclaves)
    uses = _uses_of_rights(requirement.rights, world, limit, clear)
    for enclave in sorted(allowed & uses.keys()):
        yield min(uses[enclave], key=_use_order)


def patterns_of_any_package(requirement: Only) -> list[str]:
    """Return the patterns that enclaves of any package can match, but that do not match them all.

    In a requirement of a package, patterns that do not move with the namespace count, too: for
    users without a namespace, an enclave of the package can match them.
    """
    unmoved: tuple[str, ...] = ()
    if requirement.is_relative and requirement.elsewhere:
        unmoved = patterns_of_enclaves(requirement.elsewhere)
    return [
        name
        for name in requirement.enclaves
        if name[0] != EXCEPT and (name[0] != "/" or name in unmoved) and not covers(name, "/*")
    ]


def _shortest_use_as_witness(uses: Mapping[str, Sequence[Use]]) -> Witness | None:
    """Return the shortest use as a witness, with a use of every other enclave.

    The result is None without uses.
    """
    if not uses:
        return None
    best = min((use for enclave_uses in uses.values() for use in enclave_uses), key=_use_order)
    other_uses = (
        min(
            enclave_uses,
            key=lambda use: ((use.right, use.name) != (best.right, best.name), _use_order(use)),
        )
        for enclave, enclave_uses in sorted(uses.items())
        if enclave != best.enclave
    )
    return Witness((best,), tuple((use,) for use in other_uses))


def _witness_against_must(requirement: Must, world: World, limit: SearchLimit) -> Witness | None:
    """Return a witness with the shortest name for which a required right is not complete.

    The result is None if the requirement holds.
    """
    enclave = requirement.enclave
    lacking = []
    for right, names in requirement.rights:
        for name in names:
            for part in _parts_of(right):
                own_names = NameSet()
                if enclave not in world.idle:
                    own_names = _own_topics(world, enclave, part.writes)
                topics = part.topics(name)
                # For a wildcard, only names that a node can have are required.
                topic = (topics.valid() - own_names).example(limit, longest=world.longest)
                if topic:
                    lacking.append(_use(enclave, right, part, topics, topic))
    lacking += [
        Use(enclave, "", topic, topic, writes)
        for writes, topic in world.needed
        if not lacking and topic not in _own_topics(world, enclave, writes)
    ]
    if not lacking or _is_on_other_domain(world, enclave, limit):
        return None
    return Witness((min(lacking, key=_use_order),))


def _is_on_other_domain(world: World, enclave: str, limit: SearchLimit) -> bool:
    """Return whether an enclave has rights, but none in the ROS domain of ``world``."""

    def has_rights(world: World) -> bool:
        sides = (_own_topics(world, enclave, writes) for writes in (True, False))
        return any(names.example(limit, longest=world.longest) for names in sides)

    return bool(world.elsewhere) and not has_rights(world) and any(map(has_rights, world.elsewhere))


def _use_blocked_by_routers(
    requirement: Must, world: World, limit: SearchLimit
) -> BlockedUse | None:
    """Return a demanded use that does not reach enclaves at other routers that may receive it.

    The result is None if the routers block no demanded use.
    """
    enclave = requirement.enclave
    for right, names in requirement.rights:
        for part, name in product(_parts_of(right), names):
            topics, own_topics = part.topics(name), _own_topics(world, enclave, part.writes)
            other_enclaves: dict[str, str] = {}
            for met in world.side(not part.writes).users_of_topics(topics, limit):
                ends = (enclave, met.enclave) if part.writes else (met.enclave, enclave)
                crossing = world.topics_between(*ends)
                if crossing is None:
                    continue
                if topic := world.example((own_topics & met.names) - crossing, topics, limit):
                    other_enclaves[met.enclave] = topic
            if other_enclaves:
                topic = next(iter(other_enclaves.values()))
                return BlockedUse(_use(enclave, right, part, topics, topic), tuple(other_enclaves))
    return None


def _own_topics(world: World, enclave: str, writes: bool) -> NameSet:
    """Return the topics that an enclave may write (or read) by its own permissions."""
    access = world.own.get(enclave)
    if access is None:
        return NameSet()
    return access.writes if writes else access.reads


def _witness_against_at_most(
    requirement: AtMost, world: World, limit: SearchLimit
) -> Witness | None:
    """Return a witness with a name that more enclaves may use than the requirement allows.

    The result is None if the requirement holds.

    An enclave that may write one topic of an action can do a part of the action, so it counts.
    """
    most = requirement.most
    best: tuple[Use, ...] = ()
    other_uses: tuple[Use, ...] = ()
    for right, names in requirement.rights:
        for expression in names:
            holders: dict[str, list[tuple[_TopicOfRight, TopicUser]]] = {}
            for part in _sufficient_parts(right):
                for met in world.side(part.writes).users_of_topics(part.topics(expression), limit):
                    holders.setdefault(met.enclave, []).append((part, met))
            for part, met in holders.get(ANYBODY, ()):
                # Any number of processes without an identity may exist, so a single use breaks the
                # requirement.
                if topic := world.example_of_use(met, part.topics(expression), limit):
                    return Witness((_use(ANYBODY, right, part, part.topics(expression), topic),))
            if len(holders) <= most:
                continue
            name = _shared_name(world, holders.values(), most + 1, expression, limit)
            if name is None:
                continue
            uses = [
                use
                for enclave, parts in sorted(holders.items())
                if (use := next(_uses_of(name, enclave, right, parts), None))
            ]
            if not best or _use_order(uses[0]) < _use_order(best[0]):
                best, other_uses = tuple(uses[: most + 1]), tuple(uses[most + 1 :])
    return Witness(best, tuple((use,) for use in other_uses)) if best else None


def _uses_of(
    name: str, enclave: str, right: str, parts: Iterable[tuple[_TopicOfRight, TopicUser]]
) -> Iterator[Use]:
    """Yield the uses of a name by an enclave, one for each part of the right."""
    for part, met in parts:
        topic = part.topics(name).expression
        if topic in met.names:
            yield Use(enclave, right, name, topic, part.writes)


def _shared_name(
    world: World,
    parts_by_holder: Collection[Sequence[tuple[_TopicOfRight, TopicUser]]],
    count: int,
    expression: str,
    limit: SearchLimit,
) -> str | None:
    """Return a name matching an expression that at least ``count`` holders may use, or None.

    ``parts_by_holder`` has, for each holder, the parts of the right that it may use. A name that an
    enclave states is preferred to a name that only wildcards match.
    """
    # Name → number of holders that state it, all without wildcards.
    exactly: Counter[str] = Counter()
    stated: set[str] = set()
    wild: list[NameSet] = []
    longest = world.longest
    for parts in parts_by_holder:
        names = {part.topics(expression).ros_name(t) for part, met in parts for t in met.stated}
        stated |= names
        longest = min(longest, *(world.longest - part.added_bytes for part, _ in parts))
        if any(met.wild for _, met in parts):
            own_names = (met.names.between(part.begin, part.end) for part, met in parts)
            wild.append(NameSet.union(own_names))
        else:
            exactly.update(names)

    def is_shared(name: str) -> bool:
        least = count - exactly[name]
        return least <= len(wild) and sum(name in wildcard for wildcard in wild) >= least

    if not is_expression(expression):
        return expression if is_shared(expression) else None
    known = [right for right in stated if is_shared(right)]
    valid = shortest(name for name in known if name in valid_topics("", ""))
    if valid or len(wild) < count:  # only holders with wildcards have unstated names
        return valid or shortest(known)
    shared, any_topic = NameSet.at_least(count, wild), Topics("", expression, "")
    return (
        (shared & any_topic.valid()).example(limit, longest=longest)
        or shortest(known)
        or (shared & any_topic.every()).example(limit, longest=longest)
    )


def _witness_against_widest(
    requirement: Widest, world: World, limit: SearchLimit
) -> Witness | None:
    """Return a witness with the shortest name that a wildcard allows beyond the requirement.

    The result is None if the requirement holds.
    """
    enclaves = sorted(_matching_enclaves(requirement.enclaves, world.enclaves))
    uses: defaultdict[str, list[Use]] = defaultdict(list)
    for right, names in requirement.rights:
        for part in _sufficient_parts(right):
            side, all_topics = world.side(part.writes), part.topics("*")
            within = NameSet.union(part.topics(name).every() for name in names)
            for enclave in enclaves:
                own_topics = side.topics_of[enclave]
                around = own_topics.superset()
                if around is not None and not around.automata:
                    continue
                access = world.stated[enclave]
                exact = access.writes if part.writes else access.reads
                if topic := world.example(own_topics - exact - within, all_topics, limit):
                    uses[enclave].append(_use(enclave, right, part, all_topics, topic))
    return _shortest_use_as_witness(uses)


_WRITTEN_BY_EVERY_NODE = NameSet((ROS_DISCOVERY_TOPIC, "rt/rosout", "rt/parameter_events"))
_READ_BY_EVERY_NODE = NameSet((ROS_DISCOVERY_TOPIC, "rt/parameter_events"))


def _witness_against_nothing_but(
    requirement: NothingBut, world: World, limit: SearchLimit
) -> Witness | None:
    """Return a witness with the shortest name to which an enclave has a right that is not listed.

    The result is None if the requirement holds.
    """
    enclaves = sorted(_matching_enclaves(requirement.enclaves, world.enclaves))
    uses: defaultdict[str, list[Use]] = defaultdict(list)
    for writes, ordinary in ((True, _WRITTEN_BY_EVERY_NODE), (False, _READ_BY_EVERY_NODE)):
        allowed = NameSet.union(
            part.topics(name).every()
            for right, names in requirement.rights
            for part in _parts_of(right)
            if part.writes is writes
            for name in names
        )
        for enclave in enclaves:
            unexpected = world.side(writes).topics_of[enclave] - allowed - ordinary
            if topic := world.any_example(unexpected, limit):
                right, name = right_to_use(topic, writes=writes)
                uses[enclave].append(Use(enclave, right, name, topic, writes))
    return _shortest_use_as_witness(uses)


def _witness_against_not_both(
    requirement: NotBoth, world: World, limit: SearchLimit
) -> Witness | None:
    """Return a witness with the shortest uses of an enclave that has rights of both sets.

    The result is None if the requirement holds.
    """
    first, second = (
        _with_unauthenticated_uses(_uses_of_rights(rights, world, limit), world)
        for rights in (requirement.first, requirement.second)
    )
    pairs = [
        (min(first[enclave], key=_use_order), min(second[enclave], key=_use_order))
        for enclave in sorted(first.keys() & second.keys())
    ]
    if not pairs:
        return None
    best = min(pairs, key=lambda pair: [_use_order(use) for use in pair])
    return Witness(best, tuple(pair for pair in pairs if pair is not best))


def _with_unauthenticated_uses(
    uses: Mapping[str, Sequence[Use]], world: World
) -> Mapping[str, Sequence[Use]]:
    """Return uses in which each enclave also has the uses of processes without an identity.

    A process with the files of an enclave can also run without an identity.
    """
    of_anybody = uses.get(ANYBODY, ())
    if not of_anybody:
        return uses
    by_enclave = {name: [*uses.get(name, ()), *of_anybody] for name in world.enclaves}
    return {**by_enclave, ANYBODY: of_anybody}


def _witness_against_protected(
    requirement: Protected, world: World, limit: SearchLimit
) -> Witness | None:
    """Return a witness with the shortest name that is protected less than demanded.

    The result is None if the requirement holds.
    """
    weak = world.weakly_protected(requirement.level)
    if weak is None:
        return None
    uses = []
    for topics in _topics_of_names(requirement.names):
        if topic := world.example(weak, topics, limit):
            uses.append(Use("", "", topics.ros_name(topic), topic, True))
    return Witness((min(uses, key=_use_order),)) if uses else None


def _assumed_protection(requirement: Requirement, world: World, limit: SearchLimit) -> str:
    """Return the shortest name whose protection is only assumed, or ""."""
    if not isinstance(requirement, Protected) or world.demanded is None:
        return ""
    names = []
    for topics in _topics_of_names(requirement.names):
        if topic := world.example(~world.demanded, topics, limit):
            names.append(topics.ros_name(topic))
    return shortest(names) or ""


def _topics_of_names(names: Iterable[tuple[str, str]]) -> Iterator[Topics]:
    """Yield the DDS topics of names (pairs of kind and name), without duplicates."""
    return iter(
        dict.fromkeys(
            part.topics(name)
            for kind, name in names
            for right in RIGHTS[kind]
            for part in _parts_of(right)
        )
    )


# ── influence ──────────────────────────────────────────────────────────────────────────────


def _witness_against_apart(requirement: Apart, world: World, limit: SearchLimit) -> Witness | None:
    """Return a witness with a shortest chain from a source to a target, not through ``through``.

    The result is None if the requirement holds.
    """
    through = _matching_enclaves(requirement.through, world.enclaves)
    sources = sorted(_matching_enclaves(requirement.sources, world.enclaves) - through)
    targets = _matching_enclaves(requirement.targets, world.enclaves) - through
    if sources and any(domain_world.open_topics for domain_world in (world, *world.elsewhere)):
        sources.append(ANYBODY)  # a source's process can also run without an identity
    chain = _shortest_chain(world, sources, targets, through, limit)
    if not chain:
        return None
    # Findings of a table for each robot are folded; different lists of others would prevent this.
    others = () if requirement.robot else _similar_chains(chain, world, sources, through)
    return Witness(_uses_of_chain(chain), tuple(_uses_of_chain(other) for other in others))


def _similar_chains(
    chain: _Chain, world: World, sources: Collection[str], through: Container[str]
) -> Iterator[_Chain]:
    """Yield the chain with each other enclave that can be in the place of the enclave in findings.

    Findings name one enclave of a chain: the source of a direct influence, or else the first
    enclave that passes the influence on.
    """
    worlds = (world, *world.elsewhere)
    used = {ANYBODY, *(enclave for hop in chain for enclave in (hop.source, hop.target))}
    *before, after = chain[:2]
    for enclave in sorted({each for of in worlds for each in of.writers_of(after.topic)} - used):
        if enclave in through or not (before or enclave in sources):
            continue
        changed = [replace(hop, target=enclave) for hop in before]
        changed.append(replace(after, source=enclave))
        if all(any(_hop_passes(of, hop) for of in worlds) for hop in changed):
            yield (*changed, *chain[2:])


def _hop_passes(world: World, hop: TopicHop) -> bool:
    crossing = world.topics_between(hop.source, hop.target)
    return (
        hop.source in world.writers_of(hop.topic)
        and hop.target in world.readers_of(hop.topic)
        and (crossing is None or hop.topic in crossing)
    )


def _uses_of_chain(chain: _Chain) -> tuple[Use, ...]:
    return tuple(use for hop in chain for use in _uses_of_hop(hop))


def _uses_of_hop(hop: TopicHop) -> Iterator[Use]:
    """Yield the two uses of a hop: its source writes the topic, its target reads the topic."""
    for enclave, writes in ((hop.source, True), (hop.target, False)):
        right, name = right_to_use(hop.topic, writes=writes)
        yield Use(enclave, right, name, hop.topic, writes)


# ── requirements that cannot fail ──────────────────────────────────────────────────────────


_CLAUSES_WITHOUT_PEER = {
    "publish": "no enclave may subscribe to",
    "subscribe": "no enclave may publish",
    "request": "no enclave may serve",
    "call": "no enclave may serve",
}
"""Right in a requirement → clause for a name that lacks the peer of the right."""

_RIGHT_OF_OTHER_KIND = {
    "call": "request",
    "request": "call",
    "execute": "reply",
    "reply": "execute",
}
"""Right → the right with the same role in the other kind: action for service, service for action.
"""


def _missing_enclaves(requirement: Requirement, world: World) -> tuple[list[str], list[str]]:
    """Return the patterns of enclaves that fit no enclave: restricted enclaves, and exceptions.

    Left out are patterns for enclaves that do not exist yet, such as those of a package's users.
    """
    restricted: tuple[str, ...] = ()
    exceptions: tuple[str, ...] = ()
    match requirement:
        case Only():
            exceptions = requirement.enclaves
        case Widest() | NothingBut():
            restricted = requirement.enclaves
        case Apart():
            restricted = (*requirement.sources, *requirement.targets)
            exceptions = requirement.through
    is_of_package = isinstance(requirement, Only) and requirement.is_relative
    missing: tuple[list[str], list[str]] = ([], [])
    for is_exception, patterns in enumerate((restricted, exceptions)):
        for pattern in dict.fromkeys(patterns):
            name = pattern.removeprefix(EXCEPT)
            is_excluded = name != pattern
            if is_expression(name) and (is_excluded or is_of_package):
                continue
            if not fnmatch.filter(world.enclaves, name):
                missing[is_exception != is_excluded].append(pattern)
    return missing


def similar_enclave_clause(pattern: str, enclaves: Iterable[str]) -> str:
    """Return a clause with the enclave that ``pattern`` perhaps means.

    ``pattern`` matches no enclave, perhaps because of a typing error; "" if none is similar.
    """
    return _meant_clause(pattern.removeprefix(EXCEPT), [frozenset(enclaves)])


class _UnusedNames(NamedTuple):
    """Names, or clauses on names, that the fields of `Verdict` with the same names describe."""

    unused: list[str]
    waiting: list[str]
    gone: list[str]
    unnamed: list[str]
    unserved: list[str]
    unheard: list[str]


def _unused_names(requirement: Requirement, world: World, limit: SearchLimit) -> _UnusedNames:
    """Return the names of a requirement that nobody uses, or of which one side is missing.

    A name waits for users if an enclave has its other side, such as the server of a service.  The
    name is gone instead if it lacks its server, or if an enclave that an `Only` lists by its exact
    name has the right to another name without another side: this is probably the new name.

    A name that no right states can still be used by a wildcard, and `Nobody` demands that nobody
    uses it.  So such a name counts as unused only if a right states another name that differs by
    one typing error, as in ``/cmd_vle``, or if the name is in use as another kind (service or
    action).
    """
    result = _UnusedNames([], [], [], [], [], [])
    for right, name, parts in _restricted_names(requirement):
        if isinstance(requirement, Protected) and name == "/*":  # also of a kind without names yet
            continue
        verb = "use" if isinstance(requirement, Nobody | Protected) else right
        peer = PEER_RIGHT[right]
        named = _named_right(right, name)
        stated = [world.stated_names(part.begin, part.end) for part in _parts_of(right)]
        known = is_expression(name) or any(name in names for names in stated)
        meant = "" if known else _meant_clause(name, stated)
        if not _is_used_by_anybody(world, parts, name, limit):
            other = _RIGHT_OF_OTHER_KIND.get(right, "")
            if other and _is_used_by_anybody(world, _sufficient_parts(other), name, limit):
                meant = f", but some enclaves may {other} {_named_right(other, name)}"
            if isinstance(requirement, Nobody) and not meant:
                result.unnamed.append(named)
            elif meant or verb != right:
                result.unused.append(f"no enclave may {verb} {named}{meant}")
            elif not _is_used_by_anybody(world, _sufficient_parts(peer), name, limit):
                result.unused.append(f"no enclave may {verb} or {peer} {named}")
            elif known:
                is_gone = verb in ("reply", "execute") or _has_unanswered_name(
                    requirement, name, world, parts
                )
                clauses = result.gone if is_gone else result.waiting
                clauses.append(f"no enclave may {verb} {named}")
            else:
                result.unused.append(f"no enclave may {verb} {named}")
        elif meant:
            result.unused.append(f"only wildcards match {named}{meant}")
        elif verb not in _CLAUSES_WITHOUT_PEER or (
            _is_used_by_anybody(world, _sufficient_parts(peer), name, limit)
        ):
            if not known:
                result.unnamed.append(named)
        elif KIND_OF[right] == "topics":
            if known:
                result.unheard.append(f"{_CLAUSES_WITHOUT_PEER[verb]} {named}")
            else:
                result.unnamed.append(named)
        elif known and (served := _similar_served_name(world, peer, name, limit)):
            result.unused.append(f"no enclave may {peer} {named} (perhaps {served} is meant)")
        else:
            result.unserved.append(f"{_CLAUSES_WITHOUT_PEER[verb]} {named}")
    return result


def _has_unanswered_name(
    requirement: Requirement, name: str, world: World, parts: Iterable[_TopicOfRight]
) -> bool:
    """Return whether an enclave that an `Only` lists has a name without a stated other side.

    This may be the new name for ``name``.  Wildcards are no other side, such as the wildcard of a
    recorder.
    """
    listed = {*requirement.enclaves} if isinstance(requirement, Only) else set()
    for part in parts if listed else ():
        others = world.side(not part.writes).exact
        for topic, enclaves in world.side(part.writes).exact.items():
            if topic in others or listed.isdisjoint(enclaves):
                continue
            if topic.startswith(part.begin) and topic.endswith(part.end):
                own = topic[len(part.begin) : len(topic) - len(part.end)]
                is_alike = is_of_every_node(own) == is_of_every_node(name)
                if is_alike and ACTION_SEPARATOR not in own:
                    return True
    return False


def _similar_served_name(world: World, right: str, name: str, limit: SearchLimit) -> str | None:
    """Return the only served name that is similar to ``name``, which nobody serves.

    The result is None if there is no such name, or if there are several. The two names differ in
    the part before the last, which is often the name of the server's node: the node was perhaps
    renamed, and enclaves keep the right to request the earlier name.
    """
    parts = _sufficient_parts(right)
    if is_expression(name) or is_of_every_node(name):
        return None
    served = {
        other
        for part in parts
        for other in world.stated_names(part.begin, part.end)
        if _without_node(other) == _without_node(name)
        and _is_used_by_anybody(world, parts, other, limit)
    }
    return served.pop() if len(served) == 1 else None


def _without_node(name: str) -> tuple[list[str], str]:
    """Return a name's parts before the part that may be a node's name, and the part after it."""
    words = name.split("/")
    return words[:-2], words[-1]


def _restricted_names(
    requirement: Requirement,
) -> Iterator[tuple[str, str, tuple[_TopicOfRight, ...]]]:
    """Yield each name whose use a requirement restricts: a right, the name, and parts of the right.

    For `Nobody` and `Protected`, the parts include those of the right that the peer needs, such as
    publish for subscribe.
    """
    rights: RightNames = ()
    match requirement:
        case Only() | AtMost() | Nobody():
            rights = requirement.rights
        case NotBoth(first=first, second=second):
            rights = (*first, *second)
        case Protected(names=pairs):
            rights = tuple((RIGHTS[kind][0], (name,)) for kind, name in pairs)
    for right, names in rights:
        parts = _sufficient_parts(right)
        if isinstance(requirement, Nobody | Protected):
            parts = (*_sufficient_parts(PEER_RIGHT[right]), *parts)
        yield from ((right, name, parts) for name in names)


def rights_that_need_a_peer(requirement: Requirement) -> Iterator[tuple[str, str]]:
    """Yield the rights, with names, about which a requirement protects nothing without a peer.

    For example, a limit on who may request a service protects nothing if nobody serves it.  If a
    name is protected, the right is to receive its messages, or to request.  `Nobody` is left out:
    its names are compared with all rights before a change.
    """
    match requirement:
        case Nobody():
            return
        case Must(rights=rights):
            yield from ((right, name) for right, names in rights for name in names)
        case Protected(names=pairs):
            for kind, name in pairs:
                yield next(right for right in RIGHTS[kind] if right in OFFERING_RIGHT), name
        case _:
            yield from ((right, name) for right, name, _ in _restricted_names(requirement))


def _meant_clause(name: str, stated: Iterable[frozenset[str]]) -> str:
    """Return a clause with a stated name that differs by one typing error, or ""."""
    similar = shortest(one for names in stated for one in names.intersection(_with_one_slip(name)))
    return f" (perhaps {similar} is meant)" if similar else ""


def _with_one_slip(name: str) -> Iterator[str]:
    """Yield the names that differ by a letter within a word: wrong, missing, or in wrong order.

    Digits, and single letters between separators, distinguish names on purpose (``/arm_l``,
    ``/arm_r``).
    """
    for at in range(len(name) + 1):
        begin, end = name[:at], name[at:]
        for length in (0, 1, 2):
            wrong, rest = end[:length], end[length:]
            if len(wrong) < length or not any(map(str.isalpha, begin[-1:] + rest[:1])):
                continue
            if any(map(str.isdigit, wrong)):
                continue
            rights = (
                ("", *_LETTERS_IN_NAMES)
                if length == 1
                else (wrong[::-1],)
                if wrong
                else _LETTERS_IN_NAMES
            )
            yield from (f"{begin}{right}{rest}" for right in rights if right != wrong)


_LETTERS_IN_NAMES = tuple(f"{ascii_letters}_/")
"""The characters in names of ROS, without digits."""


def _why_never_fails(requirement: Requirement, world: World) -> str:
    """Return why a requirement cannot fail with the current enclaves, as a clause, or "".

    A list that names all present enclaves is no reason, because enclaves may be added.
    """
    count = len(world.enclaves)
    if world.open_topics:
        return ""
    match requirement:
        case Only(enclaves=enclaves) if any(map(is_expression, enclaves)):
            if len(_matching_enclaves(enclaves, world.enclaves)) == count:
                return "every enclave matches the list"
        case AtMost(most=most) if most >= count:
            return f"the whole system has {counted(count, 'enclave')}"
        case Widest() | NothingBut() if not any(restricted_enclaves(requirement, world.enclaves)):
            return "no enclave is left to restrict"
        case Widest(rights=rights):
            if all(any(covers(name, "/*") for name in names) for _, names in rights):
                return "the requirement lets wildcards match every name"
        case Apart():
            through = _matching_enclaves(requirement.through, world.enclaves)
            sources = _matching_enclaves(requirement.sources, world.enclaves) - through
            targets = _matching_enclaves(requirement.targets, world.enclaves) - through
            if not any(sources - {target} for target in targets):
                return "no two enclaves are left to keep apart"
    return ""


def _named_right(right: str, name: str) -> str:
    return f"{KIND_OF[right].removesuffix('s')} {name}"


def _is_used_by_anybody(
    world: World, right_parts: Iterable[_TopicOfRight], name: str, limit: SearchLimit
) -> bool:
    """Return whether an enclave may use at least one DDS topic of a name."""
    for part in right_parts:
        met = world.side(part.writes).users_of_topics(part.topics(name), limit)
        if any(meeting.stated for meeting in met) or any(
            world.example_of_use(meeting, part.topics(name), limit) for meeting in met
        ):
            return True
    return False


# ── the flow of information ────────────────────────────────────────────────────────────────

_IGNORED_TOPICS = NameSet.union(
    names_of_expression(topic)
    for topic in (
        ROS_DISCOVERY_TOPIC,
        *(f"rt{name}" for name in OF_EVERY_NODE),
        *(f"rq/{name.lstrip('/')}{SERVICE_ENDS['rq']}" for name in QUESTIONS),
    )
)
"""Topics that do not count as a flow of information."""


@dataclass(frozen=True, slots=True)
class TopicHop:
    """A flow of information from enclave ``source`` to enclave ``target`` by a DDS topic."""

    source: str
    target: str
    topic: str


_Chain = tuple[TopicHop, ...]


def _shortest_chain(
    world: World,
    sources: Iterable[str],
    targets: Collection[str],
    excluded: Container[str],
    limit: SearchLimit,
) -> _Chain:
    """Return a shortest chain of hops from a source to one of ``targets``, or ().

    The chain does not pass through the enclaves ``excluded``. An enclave with rights in several ROS
    domains passes information on from every domain to all its domains.
    """
    worlds = (world, *world.elsewhere)
    targets = {each for each in targets if any(_may_learn(of, each, excluded) for of in worlds)}
    starts = list(sources) if targets else []
    # A target that is a source must be reached from another source, so two sources are kept.
    most = 2 if any(start in targets for start in starts) else 1
    origins: dict[str, set[str]] = {start: {start} for start in starts}
    used: dict[tuple[int, str, str], set[str]] = {}
    queue: deque[tuple[str, str, _Chain]] = deque((start, start, ()) for start in starts)
    flows = [_Flow(domain_world, limit) for domain_world in worlds]
    while queue:
        source, origin, chain = queue.popleft()

        def is_new(enclave: str, origin: str = origin) -> bool:
            known = origins.get(enclave, ())
            return enclave not in excluded and origin not in known and len(known) < most

        def is_unused(
            number: int, topic: str, origin: str = origin, router: str = world.router_of(source)
        ) -> bool:
            by = used.setdefault((number, topic, router), set())
            fresh = origin not in by and len(by) < most
            by.add(origin)
            return fresh

        for number, flow in enumerate(flows):
            for topic, target in flow.hops(source, partial(is_unused, number), is_new):
                longer_chain = (*chain, TopicHop(source, target, topic))
                if target in targets:
                    return longer_chain
                origins.setdefault(target, set()).add(origin)
                queue.append((target, origin, longer_chain))
    return ()


def _may_learn(world: World, enclave: str, excluded: Container[str]) -> bool:
    """Return whether an enclave may learn something from another enclave that is not ``excluded``.

    True may be wrong, but False is certain, and saves a search of the whole robot.
    """
    around = world.side(False).topics_of.get(enclave, NameSet()).superset()
    if around is None or around.automata:
        return True
    return any(
        writer != enclave and writer not in excluded
        for topic in around.exact
        if topic not in _IGNORED_TOPICS
        for writer in world.writers_of(topic)
    )


def influencers(world: World, limit: SearchLimit) -> dict[str, set[str]]:
    """Map each enclave to the enclaves that influence it directly."""
    sources: dict[str, set[str]] = {}
    flow = _Flow(world, limit)
    for enclave in world.enclaves:

        def is_new(target: str, source: str = enclave) -> bool:
            return source not in sources.get(target, ())

        for _, target in flow.hops(enclave, lambda _: True, is_new):
            sources.setdefault(target, set()).add(enclave)
    return sources


class _Flow:
    """The hops between the enclaves of a world.

    For each pair of enclaves, topics that only wildcards allow are searched once.
    """

    def __init__(self, world: World, limit: SearchLimit) -> None:
        self._world = world
        self._limit = limit

    def hops(
        self,
        enclave: str,
        is_unused: Callable[[str], bool],
        is_new: Callable[[str], bool],
    ) -> Iterator[tuple[str, str]]:
        """Yield pairs of a topic and an enclave that reads the topic from ``enclave``.

        Only readers for which ``is_new`` returns True count. Exact topics come first, but only
        those for which ``is_unused`` returns True; matches of wildcards follow.
        """
        written, around, exact = self._world.written_by(enclave, _IGNORED_TOPICS)
        for topic in sorted(exact, key=_topics_before_services):
            if is_unused(topic):
                for reader in self._world.readers_of(topic):
                    if reader == enclave or not is_new(reader):
                        continue
                    crossing = self._world.topics_between(enclave, reader)
                    if crossing is None or topic in crossing:
                        yield topic, reader
        if around is not None and not around.automata:
            return
        for reader in self._world.side(False).possible_users(
            around.automata if around else None, self._limit
        ):
            if reader != enclave and is_new(reader):
                shared = self._world.shared_topic(enclave, reader, written, self._limit)
                if shared:
                    yield shared, reader


def _topics_before_services(topic: str) -> tuple[bool, bool, int, str]:
    """Return a sort key: topics before services, and /rosout last."""
    return topic == "rt/rosout", not topic.startswith("rt/"), len(topic), topic
