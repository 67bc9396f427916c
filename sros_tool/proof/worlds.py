"""The access of enclaves to DDS topics in one world: with one DDS vendor, or on Zenoh.

A world has an index of the topics of all its enclaves, which finds the enclaves with access to
names that an expression matches: exact topics are looked up, and only wildcards are compared.  On
Zenoh, a key stands for the DDS topic of the same ROS name, so that all worlds use the same names.
"""

from __future__ import annotations

import re
from bisect import bisect_left
from collections import defaultdict
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from itertools import count
from string import ascii_letters, digits
from types import MappingProxyType
from typing import NamedTuple

from sros_tool.automata import Automaton, Letters, NameSet, SearchLimit, Superset
from sros_tool.dds.decision.access import Access, AccessVerb
from sros_tool.dds.decision.expressions import names_of
from sros_tool.dds.decision.vendors import Style
from sros_tool.dds.domains import MAX_DOMAIN, DomainSet
from sros_tool.names import SERVICE_ENDS, is_expression
from sros_tool.policy.model import ALLOW, Level
from sros_tool.policy.rights import Right
from sros_tool.translate_zenoh.rights import ANY_TYPE, StatedRight, untyped
from sros_tool.zenoh.access import Enforcement, Flow, Message, Remote
from sros_tool.zenoh.key_expressions import names_of as names_of_keys

LONGEST = 255
"""Length in bytes of the longest DDS topic name in ROS 2 (rmw, validate_full_topic_name.h)."""
ANYBODY = "anybody without an identity"
"""Name that stands for all processes without an enclave, where a governance admits them."""
_LAST_CHARACTER = "\U0010ffff"
_COMPARISONS_PER_STEP = 4
"""Number of comparisons of wildcard prefixes and suffixes that count as one search step."""


@dataclass(frozen=True, slots=True)
class TopicAccess:
    """The DDS topics that an enclave may write, and the DDS topics that it may read."""

    writes: NameSet
    reads: NameSet


@dataclass(frozen=True, slots=True)
class Topics:
    """The DDS topics of the ROS names that match the expression ``name``.

    A topic is the prefix, the name and the suffix.
    """

    begin: str
    name: str
    end: str

    @property
    def expression(self) -> str:
        """The expression that matches the topics: prefix, name and suffix."""
        return f"{self.begin}{self.name}{self.end}"

    def ros_name(self, topic: str) -> str:
        """Return the ROS name of a DDS topic."""
        return topic[len(self.begin) : len(topic) - len(self.end)]

    def every(self) -> NameSet:
        """Return all topics of the expression, even topics that no ROS node would use."""
        return names_of_expression(self.expression)

    def valid(self) -> NameSet:
        """Return the topics of the expression that have a valid ROS name."""
        return self.every() & valid_topics(self.begin, self.end)


@lru_cache(maxsize=65536)
def names_of_expression(expression: str) -> NameSet:
    """Return the names that an expression of a policy matches; all vendors match the same names."""
    return names_of(Style.FNMATCH, (expression,))


@lru_cache(maxsize=65536)
def _automaton_of_wildcards(expression: str) -> Automaton | None:
    """Return an automaton for an expression, or None if it has no wildcard."""
    around = names_of_expression(expression).superset()
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
"""The DDS topics of all valid ROS names."""


@dataclass(frozen=True, slots=True)
class TopicUser:
    """An enclave that may use some of the topics in question.

    ``names`` are all topics that it may use. The rights of the enclave name the ``stated`` topics;
    with ``wild``, wildcards may match further topics.
    """

    enclave: str
    names: NameSet
    stated: tuple[str, ...]
    wild: bool


def shortest(names: Iterable[str]) -> str | None:
    """Return the shortest of ``names``, or None without names."""
    return min(names, key=lambda name: (len(name), name), default=None)


class Side:
    """An index of the topics that enclaves may write, or of the topics that they may read."""

    def __init__(self, topics_of: Mapping[str, NameSet]) -> None:
        self.topics_of = topics_of
        self.exact: dict[str, list[str]] = defaultdict(list)
        self._wild: dict[Automaton, list[str]] = defaultdict(list)
        self._any: list[str] = []
        self._found: dict[str, Sequence[str]] = {}
        self._users_by_automaton: dict[Automaton, frozenset[str]] = {}
        for enclave, names in topics_of.items():
            around = names.superset()
            if around is None:
                self._any.append(enclave)
                continue
            for name in around.exact:
                self.exact[name].append(enclave)
            for automaton in around.automata:
                self._wild[automaton].append(enclave)
        self._topics = sorted(self.exact)
        self._backwards = sorted(name[::-1] for name in self.exact)

    def users_of_topics(self, topics: Topics, limit: SearchLimit) -> list[TopicUser]:
        """Return the enclaves that may use some of the topics, sorted.

        An enclave without ``stated`` topics may be listed wrongly; only an example topic is
        certain.
        """
        stated: dict[str, list[str]] = {}
        for topic in self.topics_matching(topics.expression, limit):
            for enclave in self.exact[topic]:
                if topic in self.topics_of[enclave]:
                    stated.setdefault(enclave, []).append(topic)
        own_automaton = _automaton_of_wildcards(topics.expression)
        if own_automaton is None:
            matching = [
                automaton for automaton in self._wild if automaton.matches(topics.expression)
            ]
        else:
            limit.spend(len(self._wild) // _COMPARISONS_PER_STEP)
            matching = [
                automaton for automaton in self._wild if automaton.may_overlap(own_automaton)
            ]
        wild = {enclave for automaton in matching for enclave in self._wild[automaton]}.union(
            self._any
        )
        return [
            TopicUser(
                enclave, self.topics_of[enclave], tuple(stated.get(enclave, ())), enclave in wild
            )
            for enclave in sorted(wild.union(stated))
        ]

    def topics_matching(self, expression: str, limit: SearchLimit) -> Sequence[str]:
        """Return the exact topics in rights of all enclaves that match an expression."""
        if expression not in self._found:
            limit.spend(len(self._wild))
            own_automaton = _automaton_of_wildcards(expression)
            self._found[expression] = (
                tuple(self._accepted_topics(own_automaton, limit))
                if own_automaton
                else ((expression,) if expression in self.exact else ())
            )
        return self._found[expression]

    def _accepted_topics(self, automaton: Automaton, limit: SearchLimit) -> Iterator[str]:
        """Yield the exact topics that an automaton accepts."""
        forwards = _indexes_starting_with(self._topics, automaton.prefix)
        backwards = _indexes_starting_with(self._backwards, automaton.suffix[::-1])
        limit.spend(min(len(forwards), len(backwards)))
        if len(forwards) <= len(backwards):
            topics: Iterator[str] = (self._topics[i] for i in forwards)
        else:
            topics = (self._backwards[i][::-1] for i in backwards)
        return filter(automaton.matches, topics)

    def possible_users(
        self, automata: Collection[Automaton] | None, limit: SearchLimit
    ) -> list[str]:
        """Return the enclaves that may use a topic that the automata accept (None: any topic).

        An enclave may be listed wrongly.
        """
        if automata is None:
            return sorted(self.topics_of)
        enclaves = set(self._any)
        for own_automaton in automata:
            if own_automaton not in self._users_by_automaton:
                self._users_by_automaton[own_automaton] = self._users_by_wildcard(
                    own_automaton, limit
                )
            enclaves.update(self._users_by_automaton[own_automaton])
        return sorted(enclaves)

    def _users_by_wildcard(self, own_automaton: Automaton, limit: SearchLimit) -> frozenset[str]:
        limit.spend(len(self._wild) // _COMPARISONS_PER_STEP)
        met: set[str] = set()
        for topic in self._accepted_topics(own_automaton, limit):
            met.update(self.exact[topic])
        for automaton, enclaves in self._wild.items():
            if automaton.may_overlap(own_automaton):
                met.update(enclaves)
        limit.spend(len(met))  # the result is cached
        return frozenset(met)

    def users_of(self, topic: str) -> list[str]:
        """Return the enclaves that may use a topic, sorted."""
        users = set(self.exact.get(topic, ())).union(self._any)
        for automaton, enclaves in self._wild.items():
            if not users.issuperset(enclaves) and automaton.matches(topic):
                users.update(enclaves)
        return sorted(user for user in users if topic in self.topics_of[user])


def _indexes_starting_with(ordered: list[str], begin: str) -> range:
    """Return the indexes of the texts in a sorted list that begin with ``begin``."""
    return range(bisect_left(ordered, begin), bisect_left(ordered, begin + _LAST_CHARACTER))


class Crossing:
    """The topics that Zenoh routers pass on to each other, by the rules of the receiving router.

    ``router_of`` maps enclaves to the routers that they connect to, and each router to itself;
    ``rules`` maps routers to their access control.
    """

    def __init__(
        self, router_of: Mapping[str, str], rules: Mapping[str, Enforcement], domain: int
    ) -> None:
        self.router_of = router_of
        self._rules = rules
        self._domain = domain
        self._passing: dict[tuple[str, str], NameSet] = {}

    def topics_between(self, writer: str, reader: str) -> NameSet | None:
        """Return the topics that can get from a writer to a reader.

        None stands for all topics: both use one router, or the router of one of them is unknown.
        """
        sending, receiving = self.router_of.get(writer), self.router_of.get(reader)
        if sending is None or receiving is None or sending == receiving:
            return None
        if (sending, receiving) not in self._passing:
            rules = (self._rules[receiving],)
            passing = enforced_access(rules, sending, self._domain).writes
            self._passing[sending, receiving] = passing
        return self._passing[sending, receiving]


Confirm = Callable[[str, bool, str], bool]
"""Function (enclave, writes, topic): whether the world's engine allows writing (or reading)."""


class WrittenTopics(NamedTuple):
    """The topics that an enclave may write; ``exact`` are the topics stated without wildcards.

    ``around`` is the result of `NameSet.superset` for the exact topics.
    """

    names: NameSet
    around: Superset | None
    exact: tuple[str, ...]


class World:
    """The topics that all enclaves may write and read, with one vendor or on Zenoh.

    ``title`` names the world in texts; ``longest`` is the length in bytes of the
    longest topic name that is possible in the world.
    """

    def __init__(
        self,
        title: str,
        access: Mapping[str, TopicAccess],
        *,
        confirm: Confirm,
        stated_access: Mapping[str, TopicAccess],
        weak: Mapping[Level, NameSet] = MappingProxyType({}),
        demanded: NameSet | None = None,
        needed: Sequence[tuple[bool, str]] = (),
        idle: Collection[str] = (),
        fitting_others: Mapping[str, Sequence[str]] = MappingProxyType({}),
        longest: int = LONGEST,
        crossing: Crossing | None = None,
        open_topics: NameSet | None = None,
    ) -> None:
        """Create a world from the access of each enclave by its own permissions.

        ``confirm`` decides on one topic without these sets, and ``stated_access`` has the topics
        that the rights of an enclave name without wildcards.

        ``weak`` maps levels to the topics that are protected less than the level demands.
        ``demanded`` are the topics whose protection a policy demands, while the protection of all
        other topics is assumed; None if nothing is assumed.  ``needed`` are topics that every node
        has to write (True) and read (False).  ``idle`` are enclaves in which no process starts with
        the present files: such an enclave counts as allowed to use its rights, but not as able to.
        ``fitting_others`` maps an enclave to others whose permissions it can use as well. These
        permissions count for what an enclave may do, but not for what it must be able to do.
        ``crossing`` has the topics that pass between several Zenoh routers; None if all enclaves
        reach each other. ``open_topics`` are the topics that processes without an identity may
        write and read, or None.
        """
        self.title = title
        self.confirm_own = confirm
        self.fitting_others = fitting_others
        self.own = access
        self.stated = {name: self._with_fitting(name, stated_access) for name in stated_access}
        self.longest = longest
        self.enclaves = tuple(sorted(access))
        self._access = {name: self._with_fitting(name, access) for name in access}
        self.open_topics = open_topics
        if open_topics is not None:
            self._access[ANYBODY] = TopicAccess(open_topics, open_topics)
        self.needed = tuple(needed)
        self.idle = frozenset(idle)
        self.crossing = crossing
        self.elsewhere: tuple[World, ...] = ()
        """The worlds of the same vendor, or of Zenoh, in other ROS domains."""
        self.away: Collection[str] = ()
        """The enclaves of other machines, which an export leaves out on purpose."""
        self._weak = weak
        self.demanded = demanded
        self._readers_of: dict[str, list[str]] = {}
        self._writers_of: dict[str, list[str]] = {}
        self._shared: dict[tuple[str, str], str | None] = {}
        self._written: dict[str, WrittenTopics] = {}
        self._stated_names: dict[tuple[str, str], frozenset[str]] = {}

    def _with_fitting(self, enclave: str, access: Mapping[str, TopicAccess]) -> TopicAccess:
        accesses = [
            access[holder]
            for holder in (enclave, *self.fitting_others.get(enclave, ()))
            if holder in access
        ]
        if len(accesses) == 1:
            return accesses[0]
        writes, reads = ([e.writes for e in accesses], [e.reads for e in accesses])
        return TopicAccess(NameSet.union(writes), NameSet.union(reads))

    def confirm(self, enclave: str, writes: bool, topic: str) -> bool:
        """Return whether an enclave may write (or else read) a topic, as the engine decides."""
        if enclave == ANYBODY:
            return self.open_topics is not None and topic in self.open_topics
        able = (enclave, *self.fitting_others.get(enclave, ()))
        return any(self.confirm_own(name, writes, topic) for name in able)

    def other_sufficient_enclave(self, enclave: str, writes: bool, topic: str) -> str:
        """Return another enclave whose permissions let ``enclave`` use a topic.

        Returns "" if the enclave's own permissions are enough, or if no other permissions fit.
        """
        if enclave not in self.fitting_others or self.confirm_own(enclave, writes, topic):
            return ""
        candidates = self.fitting_others[enclave]
        return next(
            (holder for holder in candidates if self.confirm_own(holder, writes, topic)), ""
        )

    def has_same_access(self, other: World) -> bool:
        """Return whether another world has equal sets of topics, so all decisions are equal."""
        return (
            (self.longest, self.needed, self.idle) == (other.longest, other.needed, other.idle)
            and self.stated == other.stated
            and (self._weak, self.demanded) == (other._weak, other.demanded)
            and (self.own, self.open_topics) == (other.own, other.open_topics)
            and self.fitting_others == other.fitting_others
            and [(world.own, world.open_topics) for world in self.elsewhere]
            == [(world.own, world.open_topics) for world in other.elsewhere]
            and self.crossing is other.crossing is None
        )

    @cached_property
    def _writers(self) -> Side:
        return Side({name: access.writes for name, access in self._access.items()})

    @cached_property
    def _readers(self) -> Side:
        return Side({name: access.reads for name, access in self._access.items()})

    def side(self, writes: bool) -> Side:
        """Return the index of writers, or of readers."""
        return self._writers if writes else self._readers

    def example(self, names: NameSet, topics: Topics, limit: SearchLimit) -> str | None:
        """Return a topic among ``topics`` whose name is in ``names``, or None.

        Topics that an enclave states come before topics that only wildcards match, then valid ROS
        names before other names, then short topics before long ones.
        """
        if not is_expression(topics.expression):
            return topics.expression if topics.expression in names else None
        example = (names & topics.every()).example(limit, longest=self.longest)
        if example is None:
            return None
        known = {
            topic
            for side in (self._writers, self._readers)
            for topic in side.topics_matching(topics.expression, limit)
            if topic in names
        }
        valid = valid_topics(topics.begin, topics.end)
        return (
            shortest(domain for domain in known if domain in valid)
            or (names & topics.valid()).example(limit, longest=self.longest)
            or shortest(known)
            or example
        )

    def any_example(self, names: NameSet, limit: SearchLimit) -> str | None:
        """Return a topic in ``names``, or None if it is empty.

        Stated topics, and topics that nodes can have, come first.
        """
        sets = (names, *(names & name_set for name_set in _VALID_TOPICS))
        stated = (next(name_set.stated(), None) for name_set in sets)
        examples = (
            name_set.example(limit, longest=self.longest) for name_set in (*sets[1:], names)
        )
        return next(filter(None, (*stated, *examples)), None)

    def stated_names(self, begin: str, end: str) -> frozenset[str]:
        """Return the names in stated topics with this text before and after the name."""
        if (begin, end) not in self._stated_names:
            self._stated_names[begin, end] = frozenset(
                topic[len(begin) : len(topic) - len(end)]
                for side in (self._writers, self._readers)
                for topic in side.exact
                if topic.startswith(begin) and topic.endswith(end)
            )
        return self._stated_names[begin, end]

    def example_of_use(
        self, topic_user: TopicUser, topics: Topics, limit: SearchLimit
    ) -> str | None:
        """Return the best example of ``topics`` that an enclave may use, or None."""
        if topic_user.wild:
            return self.example(topic_user.names, topics, limit)
        valid = valid_topics(topics.begin, topics.end)
        return shortest(right for right in topic_user.stated if right in valid) or shortest(
            topic_user.stated
        )

    def readers_of(self, topic: str) -> list[str]:
        """Return the enclaves that may read a topic."""
        if topic not in self._readers_of:
            self._readers_of[topic] = self._readers.users_of(topic)
        return self._readers_of[topic]

    def writers_of(self, topic: str) -> list[str]:
        """Return the enclaves that may write a topic."""
        if topic not in self._writers_of:
            self._writers_of[topic] = self._writers.users_of(topic)
        return self._writers_of[topic]

    def topics_between(self, writer: str, reader: str) -> NameSet | None:
        """Return the topics that can get from one enclave to another; None for all."""
        return self.crossing.topics_between(writer, reader) if self.crossing else None

    def router_of(self, enclave: str) -> str:
        """Return the router that an enclave connects to; "" in a network with a single router."""
        return self.crossing.router_of.get(enclave, "") if self.crossing else ""

    def written_by(self, enclave: str, excluded_names: NameSet) -> WrittenTopics:
        """Return topics that an enclave may write, without ``excluded_names``.

        All calls must have the same ``excluded_names``, because results are cached.
        """
        if enclave not in self._written:
            names = self.side(True).topics_of.get(enclave, NameSet()) - excluded_names
            around = names.superset()
            exact = tuple(topic for topic in around.exact if topic in names) if around else ()
            self._written[enclave] = WrittenTopics(names, around, exact)
        return self._written[enclave]

    def shared_topic(
        self, writer: str, reader: str, written: NameSet, limit: SearchLimit
    ) -> str | None:
        """Return a topic in ``written`` that ``reader`` may read and receives, or None.

        ``written`` has to depend on the writer only.
        """
        if (writer, reader) not in self._shared:
            shared = written & self._readers.topics_of.get(reader, NameSet())
            crossing = self.topics_between(writer, reader)
            shared = shared if crossing is None else shared & crossing
            valid = (shared & names for names in _VALID_TOPICS)
            example = next(
                filter(None, (name_set.example(limit, longest=self.longest) for name_set in valid)),
                None,
            )
            self._shared[writer, reader] = example or shared.example(limit, longest=self.longest)
        return self._shared[writer, reader]

    def weakly_protected(self, level: Level) -> NameSet | None:
        """Return the topics that are protected less than a level demands; None for no topics."""
        return self._weak.get(level)


_VALID_TOPICS = tuple(
    valid_topics(*ends) for ends in (("rt", ""), ("rq", "Request"), ("rr", "Reply"))
)


def topics_of(right: Right) -> Iterator[tuple[bool, str]]:
    """Yield pairs for the DDS topics of a right: whether it writes the topic, and the topic."""
    written, read = right.topics
    yield from ((True, topic) for topic in written)
    yield from ((False, topic) for topic in read)


# ── the topics of an enclave ───────────────────────────────────────────────────────────────

_IN, _OUT = Flow.INGRESS, Flow.EGRESS
_TOPIC_SUFFIXES = {"rt": "", **SERVICE_ENDS}
_MESSAGES_BY_USE: dict[tuple[bool, str], tuple[tuple[Flow, Message], ...]] = {
    (True, "rt"): ((_IN, Message.PUT),),
    (False, "rt"): ((_OUT, Message.PUT),),
    (True, "rq"): ((_IN, Message.QUERY),),
    (False, "rq"): ((_OUT, Message.QUERY),),
    (True, "rr"): ((_IN, Message.REPLY), (_IN, Message.DECLARE_QUERYABLE)),
    (False, "rr"): ((_OUT, Message.REPLY), (_OUT, Message.DECLARE_QUERYABLE)),
}
"""The Zenoh messages with which a process writes or reads topics with a prefix.

All these messages have to pass: replies without the offer to reply belong to the history of topics.
"""
_ANY_TYPE_CHUNKS = f"/{ANY_TYPE}"
"""Type and hash at the end of a key, as wildcards: rules that sros writes apply to all types."""
_UNTYPED = "/*/*"


def dds_access(access: Access) -> TopicAccess:
    """Return the topics that a vendor lets an enclave write and read."""
    return TopicAccess(access.topics(AccessVerb.PUBLISH), access.topics(AccessVerb.SUBSCRIBE))


def ros_access(stated_rights: Iterable[StatedRight]) -> TopicAccess:
    """Return the topics of the ROS names that a right allows and no denial covers."""
    names: dict[tuple[bool, str, bool], list[NameSet]] = defaultdict(list)
    for right in (right.right for right in stated_rights):
        for writes, topic in topics_of(right):
            names[writes, topic[:2], right.qualifier is ALLOW].append(names_of_expression(topic))

    def side(writes: bool) -> NameSet:
        return NameSet.union(
            (NameSet.union(names[writes, begin, True]) & valid_topics(begin, end))
            - NameSet.union(names[writes, begin, False])
            for begin, end in _TOPIC_SUFFIXES.items()
        )

    return TopicAccess(side(True), side(False))


def enforced_access(enforcers: Iterable[Enforcement], enclave: str, domain: int) -> TopicAccess:
    """Return an enclave's access on Zenoh, as the DDS topics that correspond to its keys.

    ``enforcers`` are the access control of the processes that the enclave connects to.  A topic is
    included if at least one of these processes lets its messages pass.
    """
    remote = Remote(enclave)

    def topics(enforcer: Enforcement, writes: bool, begin: str) -> NameSet:
        def of(keys: Iterable[str]) -> NameSet:
            return NameSet.union(_topics(key, domain, begin) for key in keys)

        first, *other_sets = (
            enforcer.passing(remote, *use, of) for use in _MESSAGES_BY_USE[writes, begin]
        )
        for names in other_sets:
            first &= names
        return first & names_of_expression(f"{begin}/*{_TOPIC_SUFFIXES[begin]}")

    all_enforcers = tuple(enforcers)
    return TopicAccess(
        *(
            NameSet.union(
                topics(enforcement, writes, begin)
                for enforcement in all_enforcers
                for begin in _TOPIC_SUFFIXES
            )
            for writes in (True, False)
        )
    )


def any_allows(
    enforcers: Iterable[Enforcement], enclave: str, domain: int, topic: str, *, writes: bool
) -> bool:
    """Return whether any of the enforcers lets an enclave write or read a topic."""
    messages = zenoh_messages(topic, domain, writes=writes)
    remote = Remote(enclave)
    return bool(messages) and any(
        all(enforcer.decide(remote, *message).allowed for message in messages)
        for enforcer in enforcers
    )


def domains_of(
    enforcers: Iterable[Enforcement], other_domains: Collection[DomainSet] = ()
) -> tuple[int, ...]:
    """Return an example ROS domain for each group of domains with the same rules.

    If keys have a wildcard in place of the domain, a domain is added that no key names. Domains in
    ``other_domains`` are added, too; domains in different sets count as having different rules.
    """
    rules: dict[int, set[object]] = {}
    wild = False
    for number, enforcer in enumerate(enforcers):
        subjects: dict[str, list[str]] = defaultdict(list)
        for policy in enforcer.policies:
            for rule_id in policy.rules:
                subjects[rule_id] += policy.subjects
        for rule in enforcer.rules:
            rule_key = number, frozenset(subjects[rule.id]), rule.allows, rule.flows, rule.messages
            for key in rule.key_expressions:
                begin, _, rest = key.partition("/")
                wild |= "*" in begin
                if _DOMAIN.match(begin):
                    rules.setdefault(int(begin), set()).add((*rule_key, rest))
    unnamed = next(domain for domain in count() if domain not in rules)
    known = {
        *rules,
        *(range(MAX_DOMAIN + 1) if other_domains else ()),
        *([unnamed] if wild else ()),
    }
    kinds: dict[object, int] = {}
    for domain in sorted(known, reverse=True):
        inside = tuple(domain in domain_set for domain_set in other_domains)
        if domain in rules or any(inside) or wild:
            kinds[frozenset(rules.get(domain, ())), inside] = domain
    return tuple(sorted(kinds.values()))


_DOMAIN = re.compile(r"(?:0|[1-9][0-9]{0,8})\Z", re.ASCII)


@lru_cache(maxsize=65536)
def _topics(key: str, domain: int, begin: str) -> NameSet:
    """Return the topics with a prefix that correspond to the keys of a key expression.

    Keys with a part that begins with "@" are left out, because no ROS name has such a part.  Such
    keys are about the graph, or about the history of a topic; the right to the topic includes its
    history.
    """
    if "/@" in key:
        return NameSet()
    end, space = _TOPIC_SUFFIXES[begin], str(domain)
    key = untyped(key)
    name = key.removesuffix(_UNTYPED).removeprefix(space)
    if len(name) == len(key) - len(space) - len(_UNTYPED) and "*" not in name:
        return NameSet((f"{begin}{name}{end}",)) if name.startswith("/") else NameSet()
    around = names_of_keys((key,)).superset()
    assert around
    inner = (automaton.between(space, _ANY_TYPE_CHUNKS) for automaton in around.automata)
    exact = (
        f"{begin}{key[len(space) : -len(_ANY_TYPE_CHUNKS)]}{end}"
        for key in around.exact
        if key.startswith(f"{space}/") and key.endswith(_ANY_TYPE_CHUNKS)
    )
    return NameSet(exact, (automaton.surrounded(begin, end) for automaton in inner))


def zenoh_messages(topic: str, domain: int, *, writes: bool) -> list[tuple[Flow, Message, str]]:
    """Return flow, message and key of the messages by which a process writes or reads a topic.

    A topic without a ROS name has no messages.
    """
    begin = topic[:2]
    end = _TOPIC_SUFFIXES.get(begin)
    if end is None or not topic[2:].startswith("/") or not topic.endswith(end):
        return []
    key = f"{domain}{topic[2 : len(topic) - len(end)]}{_ANY_TYPE_CHUNKS}"
    return [(flow, message, key) for flow, message in _MESSAGES_BY_USE[writes, begin]]
