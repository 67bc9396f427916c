"""How long to look at a graph: until it has come to rest, for a time, or until told to stop.

Times are in seconds.  The clock is passed in, as is the source: a test needs neither.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from sros_tool.graph.observation import Observation
from sros_tool.graph.source import GraphSource

Clock = Callable[[], float]
_TICK = 0.2


@dataclass(frozen=True, slots=True)
class Settling:
    """When a graph counts as complete: after ``least``, unchanged for ``still``; at ``most``.

    Fast DDS announces its participants every 3 s after a first burst, some of which gets lost when
    there are many: half a robot was seen to stand still from 0.4 to 3.4 s.
    """

    least: float = 4.0
    still: float = 3.5
    most: float = 30.0


SECURED = Settling(least=6.0, still=5.0, most=45.0)
"""Secured participants authenticate each other first, which takes up to 2.5 s."""


@dataclass(frozen=True, slots=True)
class Snapshot:
    """The graph at the end of a look, how long the look took, and whether it had come to rest."""

    observation: Observation
    seconds: float
    settled: bool


def settle(source: GraphSource, settling: Settling, clock: Clock) -> Snapshot:
    """The graph once it has come to rest, or as it is at the latest moment."""
    begin = changed = clock()
    seen = Observation()
    while True:
        now = clock()
        if now - begin >= settling.most:
            return Snapshot(seen, now - begin, False)
        if now - begin >= settling.least and now - changed >= settling.still:
            return Snapshot(seen, now - begin, True)
        news = source.next(_TICK)
        if news is not None:
            seen, changed = news, clock()


def look_for(source: GraphSource, seconds: float, clock: Clock) -> Snapshot:
    """The graph as it is after exactly so many seconds."""
    begin = clock()
    seen = Observation()
    while (left := begin + seconds - clock()) > 0:
        seen = source.next(min(left, _TICK)) or seen
    return Snapshot(seen, seconds, True)


def watch(
    source: GraphSource,
    seconds: float | None,
    clock: Clock,
    *,
    stop: Callable[[], bool],
    tell: Callable[[Observation], None],
    still: float = 0.5,
    patience: float = 2.0,
) -> Snapshot:
    """The union of everything seen in so many seconds (None: without end), or until ``stop()``.

    ``tell`` gets the union whenever it has grown and then held still for a moment, so that what
    is only half discovered is not told; it waits no longer than ``patience``.
    """
    begin = clock()
    union = told = Observation()
    grown = changed = begin
    while not stop() and (seconds is None or clock() - begin < seconds):
        news = source.next(_TICK)
        now = clock()
        if news is not None:
            both = union.union(news)
            if both != union:
                if told is union:
                    grown = now
                union, changed = both, now
        if union is not told and (now - changed >= still or now - grown >= patience):
            tell(union)
            told = union
    if union is not told:
        tell(union)
    return Snapshot(union, clock() - begin, True)
