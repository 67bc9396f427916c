"""The flow of information between the enclaves of a world: who can influence whom, by which topics.

Every DDS topic that one enclave may write and another one may read is a hop: the two halves of a
service carry information in both directions.  What every node writes and reads, and requests that
only ask (`sros_tool.reach`), are no hops.

This module reads no files.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Container, Iterable, Iterator

from sros_tool.automata import NameSet, SearchLimit
from sros_tool.dataclass import dataclass
from sros_tool.names import ROS_DISCOVERY_TOPIC, SERVICE_ENDS
from sros_tool.proof.worlds import World, named
from sros_tool.reach import OF_EVERY_NODE, QUESTIONS

_IGNORED = NameSet.union(
    named(each)
    for each in (
        ROS_DISCOVERY_TOPIC,
        *(f"rt{name}" for name in OF_EVERY_NODE),
        *(f"rq/{name.lstrip('/')}{SERVICE_ENDS['rq']}" for name in QUESTIONS),
    )
)
"""Topics that are no hops."""


@dataclass(frozen=True, slots=True)
class TopicHop:
    """A flow of information from enclave ``source`` to enclave ``target`` by a DDS topic."""

    source: str
    target: str
    topic: str


_Chain = tuple[TopicHop, ...]


def shortest_chain(
    world: World,
    sources: Iterable[str],
    targets: Container[str],
    without: Container[str],
    limit: SearchLimit,
) -> _Chain:
    """Return a chain with the fewest hops from a source to another enclave in ``targets``, or ().

    No chain leads through the enclaves ``without``.
    """
    starts = list(sources)
    # A target can be a source, too, and must be reached from another one: so two are kept.
    most = 2 if any(each in targets for each in starts) else 1
    origins: dict[str, set[str]] = {each: {each} for each in starts}
    used: dict[str, set[str]] = {}
    queue: deque[tuple[str, str, _Chain]] = deque((each, each, ()) for each in starts)
    flow = _Flow(world, limit)
    while queue:
        here, origin, chain = queue.popleft()

        def is_new(enclave: str, origin: str = origin) -> bool:
            there = origins.get(enclave, ())
            return enclave not in without and origin not in there and len(there) < most

        def is_unused(topic: str, origin: str = origin) -> bool:
            by = used.setdefault(topic, set())
            fresh = origin not in by and len(by) < most
            by.add(origin)
            return fresh

        for topic, target in flow.hops(here, is_unused, is_new):
            longer = (*chain, TopicHop(here, target, topic))
            if target in targets:
                return longer
            origins.setdefault(target, set()).add(origin)
            queue.append((target, origin, longer))
    return ()


def influencers(world: World, limit: SearchLimit) -> dict[str, set[str]]:
    """Map each enclave that others influence directly to these."""
    found: dict[str, set[str]] = {}
    flow = _Flow(world, limit)
    for enclave in world.enclaves:

        def is_new(target: str, source: str = enclave) -> bool:
            return source not in found.get(target, ())

        for _, target in flow.hops(enclave, lambda _: True, is_new):
            found.setdefault(target, set()).add(enclave)
    return found


class _Flow:
    """The hops of a world; what is shared by wildcards is searched once for each pair."""

    def __init__(self, world: World, limit: SearchLimit) -> None:
        self._world = world
        self._limit = limit

    def hops(
        self,
        enclave: str,
        is_unused: Callable[[str], bool],
        is_new: Callable[[str], bool],
    ) -> Iterator[tuple[str, str]]:
        """Yield topic and reader for the hops from an enclave to those that are new.

        Exact topics come first, each only if it is unused.
        """
        written = self._world.side(True).of[enclave] - _IGNORED
        around = written.around()
        for topic in sorted(around.exact if around else (), key=_plain_first):
            if topic in written and is_unused(topic):
                for reader in self._world.readers_of(topic):
                    if reader != enclave and is_new(reader):
                        yield topic, reader
        if around is not None and not around.automata:
            return
        for reader in self._world.side(False).perhaps_meeting(
            around.automata if around else None, self._limit
        ):
            if reader != enclave and is_new(reader):
                shared = self._world.shared(enclave, reader, written, self._limit)
                if shared:
                    yield shared, reader


def _plain_first(topic: str) -> tuple[bool, bool, int, str]:
    """Return a sort key: topics before services, and /rosout last."""
    return topic == "rt/rosout", not topic.startswith("rt/"), len(topic), topic
