"""The reach of an enclave: the enclaves it can influence and learn from, over several hops.

An enclave that publishes a topic influences all that may subscribe to it.  A service carries
information in both directions: the request to the server, the reply to the client; requests that
only ask (`QUESTIONS`) can be left out.  An action consists of services and topics.  All of them are
DDS topics, and are treated as such.  If both sides have wildcards, there is a hop if they share a
name that neither side is denied.  There is no hop between enclaves without a common ROS domain in
which both have these rights.  Every enclave, with any rights, can write or read the topics that the
governance leaves open.

This module reads no files.
"""

from __future__ import annotations

import re
from bisect import bisect_left
from collections import defaultdict, deque
from collections.abc import Callable, Collection, Container, Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import lru_cache, partial
from itertools import combinations, product
from typing import TYPE_CHECKING, NamedTuple

from sros_tool.dds.domains import DomainSet
from sros_tool.dds.governance import Governance
from sros_tool.names import ACTION_SEPARATOR, READING_SERVICES, SERVICE_ENDS, is_expression
from sros_tool.policy.model import DENY
from sros_tool.policy.patterns import common_name, covers, literal_prefix, matches, overlap
from sros_tool.policy.rights import Right
from sros_tool.values import shows

if TYPE_CHECKING:
    from sros_tool.translate_zenoh.rights import RouterLinks

DomainRights = Mapping[DomainSet | None, Collection[Right]]
"""Maps (closed) sets of ROS domains to the rights there; None stands for every domain."""


@dataclass(frozen=True, slots=True)
class Unguarded:
    """DDS topics that need no right in one direction (publish or subscribe).

    ``topic`` is an expression; ``without`` are expressions of earlier rules that protect a part of
    these topics.  ``domains`` are the ROS domains in which no right is needed; None stands for
    every domain. With ``join_needs_right``, only enclaves with a right in a domain can join it.
    """

    direction: str
    topic: str
    without: tuple[str, ...]
    domains: DomainSet | None = None
    join_needs_right: bool = False


def unguarded_topics(governance: Governance) -> Iterator[Unguarded]:
    """Yield the topics without access control in some domain; the first matching rule counts.

    Source: DDS-Security 1.1, 9.4.1.2.6 (topic rules, and enable_read/write_access_control).
    """
    for domain in governance.domain_access_rules:
        guarded: dict[str, list[str]] = {"publish": [], "subscribe": []}
        for rule in domain.topic_access_rules:
            for direction, on in (
                ("publish", rule.enable_write_access_control),
                ("subscribe", rule.enable_read_access_control),
            ):
                if on:
                    guarded[direction].append(rule.topic_expression)
                else:
                    yield Unguarded(
                        direction,
                        rule.topic_expression,
                        tuple(guarded[direction]),
                        domain.domains.closed(),
                        domain.enable_join_access_control,
                    )


OF_EVERY_NODE = ("/parameter_events",)
"""Topics of every node: if they counted, every enclave would influence every other one."""
QUESTIONS = tuple(f"*/{name}" for name in READING_SERVICES)
"""Services whose requests change nothing: a caller gets information, but influences nobody."""

_WRITER_RIGHTS = {
    "rt": ("topics", "publish", ""),
    "rq": ("services", "request", SERVICE_ENDS["rq"]),
    "rr": ("services", "reply", SERVICE_ENDS["rr"]),
}
"""DDS topic prefix → kind of ROS name, right to write the topic, and suffix of the DDS name."""


@shows("source", "right", "name", "target")
class Hop(NamedTuple):
    """A flow of information from enclave ``source`` to enclave ``target`` by one ROS name.

    ``right`` is the right of the source (publish, request, reply; call or execute for an action),
    ``kind`` is topics, services, actions or dds.  ``name`` is a name that both may use;
    ``stated_by_source`` and ``stated_by_target`` are the names or wildcards in their rights.
    """

    source: str
    """The enclave that sends."""
    target: str
    """The enclave that receives."""
    kind: str
    right: str
    """The right of the source: publish, request, reply, call or execute."""
    name: str
    """The ROS name that carries the information."""
    stated_by_source: str
    stated_by_target: str

    def __str__(self) -> str:
        """Return text like ``/a -publish /x-> /b``."""
        return f"{self.source} {self.arrow()}"

    def arrow(self) -> str:
        """Return text like ``-publish /x-> /b``, or ``-call action /go-> /b``."""
        kind = " action" if self.kind == "actions" else ""
        return f"-{self.right}{kind} {self.name}-> {self.target}"


HopPath = tuple[Hop, ...]
"""A chain of hops: each one starts at the target of the previous one."""


def path_text(path: HopPath) -> str:
    """Return text like ``/a -publish /x-> /b -publish /y-> /c``."""
    return " ".join((path[0].source, *(hop.arrow() for hop in path)))


@dataclass(frozen=True, slots=True)
class Reach:
    """The enclaves that an enclave can influence and learn from, each with a shortest path.

    Paths of ``influences`` start at the enclave; paths of ``learns_from`` lead to the enclave.
    """

    enclave: str
    influences: dict[str, HopPath]
    learns_from: dict[str, HopPath]


@dataclass(frozen=True, slots=True)
class _Access:
    """The right of an enclave to DDS topics; ``without`` are denied or ignored expressions.

    ``domains`` are the ROS domains of the right; None stands for every domain.
    """

    enclave: str
    topic: str
    without: tuple[str, ...]
    domains: DomainSet | None = None


class _Direction:
    """The accesses of all enclaves in one direction: either all writers or all readers.

    The accesses are indexed by exact topic, or by the text before the first wildcard.
    """

    def __init__(self, ends: Iterable[_Access]) -> None:
        self.by_enclave: dict[str, list[_Access]] = defaultdict(list)
        self._exact: dict[str, list[_Access]] = defaultdict(list)
        self._wild: dict[str, list[_Access]] = defaultdict(list)
        for end in ends:
            self.by_enclave[end.enclave].append(end)
            if is_expression(end.topic):
                self._wild[literal_prefix(end.topic)].append(end)
            else:
                self._exact[end.topic].append(end)
        self._topics = sorted(self._exact)
        self._prefixes = sorted(self._wild)

    def possibly_overlapping(self, topic: str) -> Iterator[_Access]:
        """Yield the accesses whose topics may overlap ``topic``, which can be a wildcard.

        Only the text before the first wildcard is compared, so some of the accesses do not overlap
        ``topic``.
        """
        prefix = literal_prefix(topic)
        if prefix == topic:
            yield from self._exact.get(topic, ())
        else:
            for name in _texts_starting_with(self._topics, prefix):
                yield from self._exact[name]
        for longer in _texts_starting_with(self._prefixes, prefix):
            yield from self._wild[longer]
        for length in range(len(prefix)):
            yield from self._wild.get(prefix[:length], ())


def _texts_starting_with(ordered: list[str], prefix: str) -> Iterator[str]:
    """Yield the texts of a sorted list that start with ``prefix``."""
    for index in range(bisect_left(ordered, prefix), len(ordered)):
        if not ordered[index].startswith(prefix):
            return
        yield ordered[index]


_FollowedTopics = set[tuple[str, tuple[str, ...], str, DomainSet | None]]


class Network:
    """All enclaves of a system, connected by the topics that they may write and read.

    ``rights`` hold in every ROS domain unless they are mapped from sets of domains.  ``excluded``
    are topics (ROS names) to ignore, ``questions`` are services (names or wildcards) whose requests
    are ignored.  All enclaves in ``everybody`` may use the ``unguarded`` topics, independently of
    their rights, in the domains that they can join.  ``links`` are the links between several Zenoh
    routers: enclaves at different routers are connected only by the names that these routers pass
    on to each other.
    """

    def __init__(
        self,
        rights: Iterable[Right] | DomainRights,
        *,
        excluded: Collection[str] = (),
        questions: Collection[str] = (),
        unguarded: Iterable[Unguarded] = (),
        everybody: Iterable[str] = (),
        links: RouterLinks | None = None,
    ) -> None:
        ignored = ["rt" + name for name in excluded]
        ignored += [f"rq/{name.lstrip('/')}{SERVICE_ENDS['rq']}" for name in questions]
        by_domains: DomainRights = rights if isinstance(rights, Mapping) else {None: [*rights]}
        ends = _writers_and_readers(by_domains, ignored)
        opened = tuple(dict.fromkeys(unguarded))
        joined = _domains_by_enclave(by_domains) if opened else {}
        for opened_topic, enclave in product(opened, everybody):
            outside = sorted({*opened_topic.without, *ignored})
            met = tuple(
                expression for expression in outside if overlap(expression, opened_topic.topic)
            )
            if opened_topic.topic in met:
                continue
            for domains in (
                joined.get(enclave, (None,)) if opened_topic.join_needs_right else (None,)
            ):
                if common := _common_domain_set(opened_topic.domains, domains):
                    ends[opened_topic.direction].append(
                        _Access(enclave, opened_topic.topic, met, *common)
                    )
        self._sides = {direction: _Direction(accesses) for direction, accesses in ends.items()}
        self._router_of = links.router_of if links else {}
        self._passing = {
            router: _Direction(_writers_and_readers({None: passing}, ignored)["publish"])
            for router, passing in (links.passing.items() if links else ())
        }

    @property
    def enclaves(self) -> tuple[str, ...]:
        """The enclaves that may write or read at least one topic, sorted."""
        return tuple(sorted({name for side in self._sides.values() for name in side.by_enclave}))

    def links(self, enclave: str, known: Container[str]) -> Iterator[tuple[str, Callable[[], Hop]]]:
        """Yield each enclave that ``enclave`` can influence directly, with a function for the hop.

        The function searches for the name of the hop, which takes long.  Enclaves in ``known`` are
        left out, also if the caller adds them while it iterates.
        """
        for writer, reader in self._access_pairs(enclave, True, set(), known):
            if reader.enclave != enclave and self._carries_a_topic(writer, reader):
                yield reader.enclave, partial(self._hop_between, writer, reader)

    def _hop_between(self, writer: _Access, reader: _Access) -> Hop:
        return _hop(writer, reader, self._carried_topic(writer, reader))

    def users(self, direction: str, topic: str) -> frozenset[str]:
        """Return the enclaves that may publish or subscribe (``direction``) to a DDS topic.

        ``topic`` can be a wildcard: then the enclaves may use some topic that it matches.
        """
        asked = _Access("", topic, ())
        ends = self._sides[direction].possibly_overlapping(topic)
        return frozenset(end.enclave for end in ends if _shared_topic(asked, end))

    def reach(self, enclave: str) -> Reach:
        """Return the enclaves that an enclave can influence and learn from, over several hops."""
        return Reach(enclave, self.influenced_by({enclave}), self.influencers_of({enclave}))

    def influenced_by(self, enclaves: Collection[str]) -> dict[str, HopPath]:
        """Map the other enclaves that ``enclaves`` can influence to a shortest path."""
        return self._search(enclaves, True)

    def influencers_of(self, enclaves: Collection[str]) -> dict[str, HopPath]:
        """Map the other enclaves that can influence ``enclaves`` to a shortest path."""
        return self._search(enclaves, False)

    def _search(self, start_enclaves: Collection[str], forward: bool) -> dict[str, HopPath]:
        paths: dict[str, HopPath] = dict.fromkeys(sorted(start_enclaves), ())
        followed: _FollowedTopics = set()
        queue = deque(paths)
        while queue:
            enclave = queue.popleft()
            for hop in self._steps(enclave, forward, followed, paths):
                reached = hop.target if forward else hop.source
                if reached not in paths:
                    paths[reached] = (*paths[enclave], hop) if forward else (hop, *paths[enclave])
                    queue.append(reached)
        return {enclave: path for enclave, path in paths.items() if path}

    def _steps(
        self, enclave: str, forward: bool, followed: _FollowedTopics, known: Container[str]
    ) -> Iterator[Hop]:
        """Yield the hops from an enclave (``forward``) or to an enclave, except ``known`` enclaves.

        ``followed`` are the topics whose hops were yielded earlier, and so lead to ``known``
        enclaves only.  The topics of this enclave are added to them.
        """
        for writer, reader in self._access_pairs(enclave, forward, followed, known):
            if name := self._carried_topic(writer, reader):
                yield _hop(writer, reader, name)

    def _access_pairs(
        self, enclave: str, forward: bool, followed: _FollowedTopics, known: Container[str]
    ) -> Iterator[tuple[_Access, _Access]]:
        """Yield the accesses of writers and readers to compare; arguments as for `_steps`."""
        directions = ("publish", "subscribe") if forward else ("subscribe", "publish")
        own_side, other_side = (self._sides[direction] for direction in directions)
        for end in own_side.by_enclave.get(enclave, ()):
            like = (end.topic, end.without, self._router_of.get(enclave, ""), end.domains)
            if like in followed:
                continue
            followed.add(like)
            for reached in other_side.possibly_overlapping(end.topic):
                if reached.enclave in known:
                    continue
                yield (end, reached) if forward else (reached, end)

    def _carries_a_topic(self, writer: _Access, reader: _Access) -> bool:
        """Return whether `_carried_topic` has a result, if possible without the search for it."""
        routers = {self._router_of.get(end.enclave, "") for end in (writer, reader)}
        if len(routers) == 1 and all(
            _ANY_LETTERS.fullmatch(end.topic) and not end.without for end in (writer, reader)
        ):
            common = _common_domain_set(writer.domains, reader.domains)
            return bool(common) and overlap(writer.topic, reader.topic)
        return bool(self._carried_topic(writer, reader))

    def _carried_topic(self, writer: _Access, reader: _Access) -> str:
        """Return a DDS topic that a writer may write and a reader gets, or ""."""
        if not _common_domain_set(writer.domains, reader.domains):
            return ""
        sending, receiving = (self._router_of.get(end.enclave, "") for end in (writer, reader))
        if sending == receiving:
            return _shared_topic(writer, reader)
        passing = self._passing[receiving].possibly_overlapping(writer.topic)
        names = (
            _shared_topic(writer, reader, passed) for passed in passing if passed.enclave == sending
        )
        return next(filter(None, names), "")


_ANY_LETTERS = re.compile(r"(?!.*/[0-9])[^?\[]*\*[^?\[]*")
"""DDS expressions that share a valid ROS name if they overlap: a letter fits at each ``*``."""


def _domains_by_enclave(rights: DomainRights) -> dict[str, list[DomainSet | None]]:
    """Map enclaves to the sets of ROS domains in which they may do something."""
    joined: dict[str, list[DomainSet | None]] = defaultdict(list)
    for domains, rights_there in rights.items():
        for enclave in {right.enclave for right in rights_there if right.qualifier is not DENY}:
            joined[enclave].append(domains)
    return joined


def _common_domain_set(
    first: DomainSet | None, second: DomainSet | None
) -> tuple[DomainSet | None] | tuple[()]:
    """Return the common ROS domains of two sets, in a tuple; () without common domains."""
    if first is None or second is None or first is second:
        return (second if first is None else first,)
    return _common_domains(first, second)


@lru_cache(maxsize=4096)
def _common_domains(first: DomainSet, second: DomainSet) -> tuple[DomainSet] | tuple[()]:
    common = first & second
    return (common,) if common.ranges else ()


def _writers_and_readers(
    rights: DomainRights, ignored: Collection[str]
) -> dict[str, list[_Access]]:
    """Map "publish" to the topics that enclaves may write, and "subscribe" to those they may read.

    Topics in ``ignored`` are left out.
    """
    ends: dict[str, list[_Access]] = {"publish": [], "subscribe": []}
    for domains, rights_there in rights.items():
        for direction, accesses in _accesses(rights_there, domains, ignored):
            ends[direction] += accesses
    return ends


def _accesses(
    rights: Iterable[Right], domains: DomainSet | None, ignored: Collection[str]
) -> Iterator[tuple[str, list[_Access]]]:
    """Yield pairs of a direction and accesses, by enclave, for rights in the same domains."""
    denied: dict[tuple[str, str], set[str]] = defaultdict(set)
    allowed: dict[tuple[str, str], set[str]] = defaultdict(set)
    for right in rights:
        topics_of = denied if right.qualifier is DENY else allowed
        for direction, topics in right.topics._asdict().items():
            if topics:
                topics_of[right.enclave, direction].update(topics)
    for (enclave, direction), topics in sorted(allowed.items()):
        outside = sorted(denied[enclave, direction].union(ignored))
        accesses = []
        for topic in sorted(topics, key=_exact_names_first):
            met = tuple(name for name in outside if overlap(name, topic))
            if not any(name == topic or covers(name, topic) for name in met):
                accesses.append(_Access(enclave, topic, met, domains))
        yield direction, accesses


def _exact_names_first(topic: str) -> tuple[bool, bool, bool, bool, str]:
    """Return a sort key: topics, parts of actions, replies, and /rosout last; exact names first."""
    kind = topic[:3]
    return (
        topic == "rt/rosout",
        kind == "rr/",
        kind != "rt/" or ACTION_SEPARATOR in topic,
        is_expression(topic),
        topic,
    )


def _shared_topic(*accesses: _Access) -> str:
    """Return a DDS topic that all accesses allow, or ""."""
    topics = sorted({access.topic for access in accesses})
    if not all(overlap(topic, other_topic) for topic, other_topic in combinations(topics, 2)):
        return ""
    exact = next((topic for topic in topics if not is_expression(topic)), "")
    outside = {excluded for access in accesses for excluded in access.without}
    if exact:
        return "" if any(matches(excluded, exact) for excluded in outside) else exact
    return _topic_shared_by_wildcards(tuple(topics), tuple(sorted(outside)))


@lru_cache(maxsize=4096)
def _topic_shared_by_wildcards(topics: tuple[str, ...], wildcards_outside: tuple[str, ...]) -> str:
    for prefix, (_, _, end) in _WRITER_RIGHTS.items():
        # Compare the ROS parts first, so that the result is a valid ROS name.
        inner = [_ros_part(topic, prefix, end) for topic in topics]
        outer = [_ros_part(excluded, prefix, end) for excluded in wildcards_outside]
        name = common_name(inner, filter(None, outer)) if all(inner) else ""
        topic = f"{prefix}{name}{end}"
        if name and not any(matches(excluded, topic) for excluded in wildcards_outside):
            return topic
    return common_name(topics, wildcards_outside, absolute=False) or ""


def _ros_part(topic: str, prefix: str, end: str) -> str:
    """Return the ROS name or wildcard in a DDS expression with this prefix and suffix, or ""."""
    if topic == "*":
        return "*"
    if topic.startswith(prefix + "/") and topic.endswith(end):
        return topic[len(prefix) : len(topic) - len(end)]
    return ""


def _ros_kind_right_name(topic: str) -> tuple[str, str, str]:
    """Return kind, right of the writer, and ROS name for a DDS topic or expression."""
    kind, right, end = _WRITER_RIGHTS.get(topic[:2], ("", "", ""))
    name = _ros_part(topic, topic[:2], end) if kind else ""
    if not name.startswith("/"):
        return "dds", "publish", topic
    action, part, _ = name.partition(ACTION_SEPARATOR)
    if part and action:
        return "actions", "call" if right == "request" else "execute", action
    return kind, right, name


def _hop(writer: _Access, reader: _Access, topic: str) -> Hop:
    kind, right, name = _ros_kind_right_name(topic)
    ends = (_ros_kind_right_name(end.topic)[2] for end in (writer, reader))
    return Hop(writer.enclave, reader.enclave, kind, right, name, *ends)
