"""Which enclaves may write and read which DDS topics in one world: with a vendor, or on Zenoh.

A world holds the sets of all its enclaves, and finds those fast that have some name of an
expression: exact topics are looked up, and only wildcards are compared.
"""

from __future__ import annotations

from bisect import bisect_left
from collections import defaultdict
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from functools import cached_property, lru_cache
from string import ascii_letters, digits
from types import MappingProxyType

from sros_tool.automata import Automaton, Letters, NameSet, SearchLimit
from sros_tool.dataclass import dataclass
from sros_tool.dds.decision.expressions import names_of
from sros_tool.dds.decision.vendors import Style
from sros_tool.names import SERVICE_ENDS, is_expression
from sros_tool.policy.protection import Level

LONGEST = 255
"""Longest name of a topic in bytes: the limit of DDS in ROS 2 (rmw, validate_full_topic_name.h)."""
_LAST = "\U0010ffff"
_OF_A_STEP = 4
"""Comparisons of the ends of wildcards that take as long as a step of a search."""


@dataclass(frozen=True, slots=True)
class TopicAccess:
    """The DDS topics that an enclave may write, and those that it may read."""

    writes: NameSet
    reads: NameSet


@dataclass(frozen=True, slots=True)
class Topics:
    """The DDS topics of the ROS names that match ``name``: prefix, name, suffix."""

    begin: str
    name: str
    end: str

    @property
    def expression(self) -> str:
        """The expression of the topics."""
        return f"{self.begin}{self.name}{self.end}"

    def ros_name(self, topic: str) -> str:
        """Return the ROS name in one of the topics."""
        return topic[len(self.begin) : len(topic) - len(self.end)]

    def every(self) -> NameSet:
        """Return all topics, also those that no ROS node would use."""
        return named(self.expression)

    def valid(self) -> NameSet:
        """Return the topics whose names are valid in ROS."""
        return self.every() & valid_topics(self.begin, self.end)


@lru_cache(maxsize=65536)
def named(expression: str) -> NameSet:
    """Return the names that an expression of a policy matches: all vendors agree on it."""
    return names_of(Style.FNMATCH, (expression,))


@lru_cache(maxsize=65536)
def _wild(expression: str) -> Automaton | None:
    """Return the automaton of an expression, or None if it has no wildcard."""
    around = named(expression).around()
    return next(iter(around.automata), None) if around else None


@lru_cache(maxsize=64)
def valid_topics(begin: str, end: str) -> NameSet:
    """Return the topics of all absolute ROS names with a prefix and a suffix."""
    at = len(begin)
    first, more = Letters.of(ascii_letters + "_"), Letters.of(ascii_letters + digits + "_")
    slash = Letters.of("/")
    edges = [(i, Letters.of(letter), i + 1) for i, letter in enumerate(begin)]
    edges += [(at, slash, at + 1), (at + 1, first, at + 2)]
    edges += [(at + 2, more, at + 2), (at + 2, slash, at + 1)]
    edges += [(at + 2 + i, Letters.of(letter), at + 3 + i) for i, letter in enumerate(end)]
    return NameSet(automata=(Automaton(tuple(edges), frozenset((at + 2 + len(end),))),))


ROS_TOPICS = NameSet.union(
    valid_topics(begin, end) for begin, end in (("rt", ""), *SERVICE_ENDS.items())
)
"""The topics of all valid ROS names."""


@dataclass(frozen=True, slots=True)
class Meeting:
    """What an enclave may use of some topics: ``stated`` ones, and perhaps others by wildcards."""

    enclave: str
    names: NameSet
    stated: tuple[str, ...]
    wild: bool


def shortest(names: Iterable[str]) -> str | None:
    """Return the shortest of some names, or None if there are none."""
    return min(names, key=lambda each: (len(each), each), default=None)


class Side:
    """What all enclaves may write, or what they may read."""

    def __init__(self, of: Mapping[str, NameSet]) -> None:
        self.of = of
        self.exact: dict[str, list[str]] = defaultdict(list)
        self._wild: dict[Automaton, list[str]] = defaultdict(list)
        self._any: list[str] = []
        self._found: dict[str, Sequence[str]] = {}
        self._met: dict[Automaton, frozenset[str]] = {}
        for enclave, names in of.items():
            around = names.around()
            if around is None:
                self._any.append(enclave)
                continue
            for name in around.exact:
                self.exact[name].append(enclave)
            for each in around.automata:
                self._wild[each].append(enclave)
        self._topics = sorted(self.exact)
        self._backwards = sorted(each[::-1] for each in self.exact)

    def meeting(self, topics: Topics, limit: SearchLimit) -> list[Meeting]:
        """Return the enclaves that perhaps may use some of the topics, sorted.

        An enclave without ``stated`` topics may in truth have none: only an example shows.
        """
        stated: dict[str, list[str]] = {}
        for topic in self.among(topics.expression, limit):
            for enclave in self.exact[topic]:
                if topic in self.of[enclave]:
                    stated.setdefault(enclave, []).append(topic)
        own = _wild(topics.expression)
        if own is None:
            alike = [each for each in self._wild if each.matches(topics.expression)]
        else:
            limit.spend(len(self._wild) // _OF_A_STEP)
            alike = [each for each in self._wild if each.may_meet(own)]
        wild = {enclave for each in alike for enclave in self._wild[each]}.union(self._any)
        return [
            Meeting(each, self.of[each], tuple(stated.get(each, ())), each in wild)
            for each in sorted(wild.union(stated))
        ]

    def among(self, expression: str, limit: SearchLimit) -> Sequence[str]:
        """Return the exact topics of all enclaves that match an expression."""
        if expression not in self._found:
            limit.spend(len(self._wild))
            own = _wild(expression)
            self._found[expression] = (
                tuple(self._matching(own, limit))
                if own
                else ((expression,) if expression in self.exact else ())
            )
        return self._found[expression]

    def _matching(self, own: Automaton, limit: SearchLimit) -> Iterator[str]:
        """Yield the exact topics that an automaton accepts."""
        forwards = _starting(self._topics, own.prefix)
        backwards = _starting(self._backwards, own.suffix[::-1])
        limit.spend(min(len(forwards), len(backwards)))
        if len(forwards) <= len(backwards):
            found: Iterator[str] = (self._topics[i] for i in forwards)
        else:
            found = (self._backwards[i][::-1] for i in backwards)
        return filter(own.matches, found)

    def perhaps_meeting(
        self, automata: Collection[Automaton] | None, limit: SearchLimit
    ) -> list[str]:
        """Return the enclaves that may perhaps use a topic of the automata, or any (None)."""
        if automata is None:
            return sorted(self.of)
        found = set(self._any)
        for own in automata:
            if own not in self._met:
                self._met[own] = self._meeting(own, limit)
            found.update(self._met[own])
        return sorted(found)

    def _meeting(self, own: Automaton, limit: SearchLimit) -> frozenset[str]:
        limit.spend(len(self._wild) // _OF_A_STEP)
        found: set[str] = set()
        for topic in self._matching(own, limit):
            found.update(self.exact[topic])
        for each, enclaves in self._wild.items():
            if each.may_meet(own):
                found.update(enclaves)
        limit.spend(len(found))  # they are kept
        return frozenset(found)

    def users_of(self, topic: str) -> list[str]:
        """Return the enclaves that may use one topic, sorted."""
        found = set(self.exact.get(topic, ())).union(self._any)
        for each, enclaves in self._wild.items():
            if not found.issuperset(enclaves) and each.matches(topic):
                found.update(enclaves)
        return sorted(each for each in found if topic in self.of[each])


def _starting(ordered: list[str], begin: str) -> range:
    """Return the places of the texts of a sorted list that start with ``begin``."""
    return range(bisect_left(ordered, begin), bisect_left(ordered, begin + _LAST))


Confirm = Callable[[str, bool, str], bool]
"""Whether an enclave may write (or else read) a topic, as the engine of the world decides."""


class World:
    """What all enclaves may write and read in one world.

    ``title`` names it, ``longest`` is the length in bytes of the longest topic that is used in it.
    """

    def __init__(
        self,
        title: str,
        access: Mapping[str, TopicAccess],
        *,
        confirm: Confirm,
        stated: Mapping[str, TopicAccess],
        weak: Mapping[Level, NameSet] = MappingProxyType({}),
        demanded: NameSet | None = None,
        needed: Sequence[tuple[bool, str]] = (),
        idle: Collection[str] = (),
        lenders: Mapping[str, Sequence[str]] = MappingProxyType({}),
        longest: int = LONGEST,
    ) -> None:
        """Take the access that each enclave has by its own permissions.

        ``confirm`` decides on one topic without these sets, and ``stated`` has the topics that the
        rights of an enclave name without wildcards.

        ``weak`` are the topics that are protected less than a level demands; without a level, there
        are none.  ``demanded`` are the topics whose protection is known, because a policy demands
        it, while that of all others is assumed; None if nothing is.  ``needed`` are topics that
        every node has to write (True) and read (False).  ``idle`` are enclaves in which no process
        starts with their files as they are: they may do what their rights give, and are able to do
        nothing.  ``lenders`` are the enclaves whose permissions an enclave can use as well, so that
        it may do what they may do; what it must be able to do, it has to be by its own.
        """
        self.title = title
        self.confirm_own = confirm
        self.lenders = lenders
        self.own = access
        self.stated = {name: self._with_lent(name, stated) for name in stated}
        self.longest = longest
        self.enclaves = tuple(sorted(access))
        self._access = {name: self._with_lent(name, access) for name in access}
        self.needed = tuple(needed)
        self.idle = frozenset(idle)
        self._weak = weak
        self.demanded = demanded
        self._readers_of: dict[str, list[str]] = {}
        self._shared: dict[tuple[str, str], str | None] = {}

    def _with_lent(self, name: str, access: Mapping[str, TopicAccess]) -> TopicAccess:
        every = [access[each] for each in (name, *self.lenders.get(name, ())) if each in access]
        if len(every) == 1:
            return every[0]
        writes, reads = ([e.writes for e in every], [e.reads for e in every])
        return TopicAccess(NameSet.union(writes), NameSet.union(reads))

    def confirm(self, enclave: str, writes: bool, topic: str) -> bool:
        """Return whether an enclave may write (or else read) a topic, as the engine decides."""
        able = (enclave, *self.lenders.get(enclave, ()))
        return any(self.confirm_own(each, writes, topic) for each in able)

    def lender(self, enclave: str, writes: bool, topic: str) -> str:
        """Return the enclave without whose permissions another one may not use a topic, or ""."""
        if enclave not in self.lenders or self.confirm_own(enclave, writes, topic):
            return ""
        others = self.lenders[enclave]
        return next((each for each in others if self.confirm_own(each, writes, topic)), "")

    def gives_as(self, other: World) -> bool:
        """Return whether all decisions are those of ``other``: both have equal sets."""
        return (
            (self.longest, self.needed, self.idle) == (other.longest, other.needed, other.idle)
            and self.stated == other.stated
            and (self._weak, self.demanded) == (other._weak, other.demanded)
            and self.own == other.own
            and self.lenders == other.lenders
        )

    @cached_property
    def _writers(self) -> Side:
        return Side({each: self._access[each].writes for each in self.enclaves})

    @cached_property
    def _readers(self) -> Side:
        return Side({each: self._access[each].reads for each in self.enclaves})

    def side(self, writes: bool) -> Side:
        """Return what enclaves may write, or what they may read."""
        return self._writers if writes else self._readers

    def example(self, names: NameSet, topics: Topics, limit: SearchLimit) -> str | None:
        """Return a name of a set among some topics, or None.

        A topic that an enclave names is better than one that only wildcards match, and a valid ROS
        name is better than others; then the shortest one is.
        """
        if not is_expression(topics.expression):
            return topics.expression if topics.expression in names else None
        found = (names & topics.every()).example(limit, longest=self.longest)
        if found is None:
            return None
        known = {
            topic
            for side in (self._writers, self._readers)
            for topic in side.among(topics.expression, limit)
            if topic in names
        }
        valid = valid_topics(topics.begin, topics.end)
        return (
            shortest(each for each in known if each in valid)
            or (names & topics.valid()).example(limit, longest=self.longest)
            or shortest(known)
            or found
        )

    def any_example(self, names: NameSet, limit: SearchLimit) -> str | None:
        """Return a topic of a set, if possible one that is stated, or that nodes can have."""
        sets = (names, *(names & each for each in _VALID))
        stated = (next(each.stated(), None) for each in sets)
        found = (each.example(limit, longest=self.longest) for each in (*sets[1:], names))
        return next(filter(None, (*stated, *found)), None)

    def use(self, met: Meeting, topics: Topics, limit: SearchLimit) -> str | None:
        """Return the best example of the topics that an enclave may use."""
        if met.wild:
            return self.example(met.names, topics, limit)
        valid = valid_topics(topics.begin, topics.end)
        return shortest(each for each in met.stated if each in valid) or shortest(met.stated)

    def readers_of(self, topic: str) -> list[str]:
        """Return the enclaves that may read a topic."""
        if topic not in self._readers_of:
            self._readers_of[topic] = self._readers.users_of(topic)
        return self._readers_of[topic]

    def shared(self, writer: str, reader: str, written: NameSet, limit: SearchLimit) -> str | None:
        """Return a topic in ``written`` that the reader may read, or None.

        ``written`` depends on the writer alone.
        """
        if (writer, reader) not in self._shared:
            both = written & self._readers.of[reader]
            valid = (both & each for each in _VALID)
            found = next(
                filter(None, (each.example(limit, longest=self.longest) for each in valid)), None
            )
            self._shared[writer, reader] = found or both.example(limit, longest=self.longest)
        return self._shared[writer, reader]

    def weaker(self, level: Level) -> NameSet | None:
        """Return the topics whose protection is weaker than a level; None if none can be."""
        return self._weak.get(level)


_VALID = tuple(valid_topics(*ends) for ends in (("rt", ""), ("rq", "Request"), ("rr", "Reply")))
