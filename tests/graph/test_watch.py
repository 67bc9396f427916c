"""When a graph is complete, and what a watch keeps and tells, by a clock of its own."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

from sros_tool.graph.observation import Endpoint, Observation, make_observation
from sros_tool.graph.observe import Readings, Settling, observe_for, settle, watch
from tests.graph.graphs import graph, node

ONE = graph(node("/a", "publish x"))
TWO = graph(node("/a", "publish x"), node("/b", "publish y", participant="p2"))
THREE = TWO.union(graph(node("/c", "publish z", participant="p3")))
SETTLING = Settling(least=2.0, still=1.0, most=10.0)


@dataclass
class Script:
    """A graph that changes at the given moments, and the clock by which it does.

    A reading ends every tenth of a second, but none of those in ``reading`` (begin and end).
    """

    changes: Sequence[tuple[float, Observation]]
    now: float = 100.0
    begin: float = 100.0
    reading: tuple[float, float] = (0.0, 0.0)
    readings: Readings = field(default=Readings())
    _told: int = field(default=0)

    def clock(self) -> float:
        return self.now

    def next(self, seconds: float) -> Observation | None:
        if self._told < len(self.changes):
            at, seen = self.changes[self._told]
            if self.begin + at <= self.now + seconds:
                self.now = max(self.now, self.begin + at)
                self._told += 1
                self._read()
                return seen
        self.now += seconds
        self._read()
        return None

    def _read(self) -> None:
        began, ended = (self.begin + each for each in self.reading)
        during = began < self.now < ended
        if not during or self.readings.last < began:
            self.readings = self.readings.with_next(began if during else self.now)


def test_a_still_graph_takes_the_least_time() -> None:
    script = Script([(0.1, ONE)])
    snapshot = settle(script, SETTLING, script.clock)
    assert snapshot.observation == ONE
    assert snapshot.settled
    assert 2.0 <= snapshot.seconds < 2.3


def test_a_late_change_is_waited_for() -> None:
    script = Script([(0.1, ONE), (1.9, TWO)])
    snapshot = settle(script, SETTLING, script.clock)
    assert snapshot.observation == TWO
    assert 2.9 <= snapshot.seconds < 3.3
    slow = Script([(7.0, ONE)])
    assert settle(slow, SETTLING, slow.clock).observation == ONE


def test_the_snapshot_is_the_graph_as_it_is_now() -> None:
    script = Script([(0.1, TWO), (0.5, ONE)])
    snapshot = settle(script, SETTLING, script.clock)
    assert snapshot.observation == ONE
    # What went is known all the same.
    assert snapshot.everything == ONE.union(TWO)
    assert snapshot.gone == {*TWO.nodes} - {*ONE.nodes}
    assert snapshot.gone


def test_a_graph_that_never_rests_ends_at_last() -> None:
    script = Script([(each / 2, (ONE, TWO)[each % 2]) for each in range(1, 100)])
    snapshot = settle(script, SETTLING, script.clock)
    assert not snapshot.settled
    assert 10.0 <= snapshot.seconds < 10.6


def test_a_graph_that_nobody_read_in_time_has_not_settled() -> None:
    """Others can make a graph so large that a reading lasts longer than the observation."""
    for reading, is_settled in (((0.5, 4.5), True), ((0.5, 99.0), False), ((3.0, 9.0), False)):
        observed = [
            observe_for((script := Script([(0.1, ONE)], reading=reading)), 12.0, script.clock),
            watch(
                (script := Script([(0.1, ONE)], reading=reading)),
                12.0,
                script.clock,
                stop=lambda: False,
                report=lambda _: None,
            ),
        ]
        assert [each.settled for each in observed] == [is_settled] * 2, reading
    hidden = Script([(0.1, ONE), (6.0, TWO)], reading=(0.5, 6.0))
    assert settle(hidden, SETTLING, hidden.clock).observation == TWO
    endless = Script([(0.1, ONE)], reading=(0.5, 99.0))
    assert not settle(endless, SETTLING, endless.clock).settled


def test_a_given_time_is_kept() -> None:
    script = Script([(0.1, ONE), (4.0, TWO)])
    assert observe_for(script, 3.0, script.clock).observation == ONE
    assert abs(script.now - 103.0) < 0.01


def test_a_watch_keeps_what_was_gone_and_tells_it_once() -> None:
    passing = graph(node("/p", "publish z", participant="p9"))
    script = Script([(0.1, ONE), (3.0, ONE.union(passing)), (5.0, ONE), (7.0, TWO)])
    told: list[Observation] = []
    snapshot = watch(script, 10.0, script.clock, stop=lambda: False, report=told.append)
    assert snapshot.everything == TWO.union(passing)
    assert snapshot.observation == TWO
    assert told == [ONE, ONE.union(passing), TWO.union(passing)]


def test_an_endpoint_that_goes_while_its_node_stays_is_intermittent() -> None:
    """Not one that comes late, or that goes for a moment, or with its node."""
    calls = graph(node("/a", "publish x", "publish now_and_then"))
    late = graph(node("/a", "publish x", "publish late"))
    lost = ("/a", "p1", "rt/now_and_then", "publish")
    for changes, expected in (
        ([(0.1, ONE), (3.0, calls), (3.4, ONE)], {lost}),
        ([(0.1, calls), (3.0, ONE), (6.0, calls)], {lost}),
        ([(0.1, ONE), (3.0, late)], set()),
        ([(0.1, calls), (3.0, ONE), (3.1, calls)], set()),
        ([(0.1, TWO), (3.0, ONE)], set()),
        ([(0.1, calls), (3.0, ONE), (6.0, Observation())], set()),
    ):
        script = Script(changes)
        snapshot = watch(script, 9.0, script.clock, stop=lambda: False, report=lambda _: None)
        assert snapshot.intermittent == expected, changes


def test_a_watch_says_whether_the_graph_still_grew_at_its_end() -> None:
    """The reason names the quiet time that decides, also after a short watch."""
    grew = "new nodes or endpoints still appeared in the last 3.5 s of the watch, which took "
    for seconds, changes, why in (
        (12.0, [(0.1, ONE)], ""),
        (12.0, [(0.1, ONE), (10.0, TWO)], ""),
        (12.0, [(0.1, ONE), (10.0, TWO), (13.0, THREE)], f"{grew}16 s"),
        (12.0, [(0.1, TWO), (10.0, ONE)], ""),
        (12.0, [(0.1, TWO), (7.0, ONE), (10.0, TWO)], ""),
        (6.0, [(1.9, ONE)], ""),
        (5.0, [(1.9, ONE)], ""),
        (3.0, [(1.9, ONE)], f"{grew}3 s"),
    ):
        script = Script(changes)
        snapshot = watch(script, seconds, script.clock, stop=lambda: False, report=lambda _: None)
        assert (snapshot.grew, snapshot.settled) == (bool(why), True), changes
        assert snapshot.unsettled.startswith(why), changes


def test_what_is_half_discovered_is_not_told_for_a_moment() -> None:
    half = graph(node("/a"))
    script = Script([(0.1, half), (0.3, ONE)])
    told: list[Observation] = []
    watch(script, 3.0, script.clock, stop=lambda: False, report=told.append)
    assert told == [ONE]


def test_a_restless_graph_is_told_nevertheless() -> None:
    grown = Observation()
    changes = []
    for each in range(1, 40):
        grown = grown.union(graph(node("/a", f"publish t{each}")))
        changes.append((each * 0.3, grown))
    script = Script(changes)
    told: list[Observation] = []
    watch(script, 12.0, script.clock, stop=lambda: False, report=told.append)
    assert len(told) >= 4


def test_a_node_that_starts_at_the_end_of_a_watch_is_waited_for() -> None:
    starting = make_observation(ONE.nodes, strays=[("p9", Endpoint("rt/rosout", "publish"))])
    for changes, end, seconds in (
        ([(0.1, ONE), (2.9, starting), (3.5, TWO)], TWO, 3.5),
        ([(0.1, starting)], starting, 5.0),
    ):
        script = Script(changes)
        told: list[Observation] = []
        snapshot = watch(script, 3.0, script.clock, stop=lambda: False, report=told.append)
        assert snapshot.observation == end
        assert abs(snapshot.seconds - seconds) < 0.5


def test_a_watch_ends_when_it_is_told_to() -> None:
    script = Script([(0.1, ONE)])
    told: list[Observation] = []
    stop = lambda: script.now > 101.0  # noqa: E731
    snapshot = watch(script, None, script.clock, stop=stop, report=told.append)
    assert snapshot.observation == ONE
    assert snapshot.seconds < 1.5
    assert told == [ONE]
