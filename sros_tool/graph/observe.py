"""Observe the live ROS graph through rclpy, and find the enclave of each node.

`RosGraph` runs rclpy in a separate process (`observation.main`); `settle`, `observe_for` and
`watch` end the observation.  Times are in seconds; clock and source are passed in.

rclpy lists nodes with their enclaves, but without their processes; it lists endpoints with the
names of their nodes and with their participants (processes), but without enclaves.  `resolve`
combines the two lists, even if nodes of the same name run in several enclaves.

The graph shows the enclave of ``--ros-args --enclave``, but "/" for a process whose enclave comes
from ROS_SECURITY_ENCLAVE_OVERRIDE.  But the identifier of a secured participant begins with a
digest of the certificate's subject (DDS-Security 1.1, 9.3.3), which peers check;
`with_certified_enclaves` uses this digest.
"""

from __future__ import annotations

import contextlib
import importlib.util
import json
import logging
import os
import selectors
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple, Protocol, Self

from sros_tool.errors import UnavailableError
from sros_tool.graph.observation import (
    PROFILE_VARIABLES,
    SUBSCRIBE,
    Endpoint,
    IntermittentEndpoint,
    Observation,
    ObservedNode,
    make_observation,
)
from sros_tool.names import SERVICE_ENDS, node_of_service
from sros_tool.pki.certificates import IDENTITY_DIGITS

_LOG = logging.getLogger(__name__)
_NO_SHARED_MEMORY = {"FASTDDS_BUILTIN_TRANSPORTS": "UDPv4"}
"""Variables against shared memory: Fast DDS cannot write to another user's shared memory."""
_ANNOUNCING = Path(__file__).with_name("fast_dds_observer.xml")
"""The profile of the observer's participant: it announces itself to new processes in time."""
_READING_SECONDS = 0.1
"""Seconds between two readings of the graph; short, to see a node that runs for a second."""
_START_SECONDS = 30.0
_END_SECONDS = 3.0
_MOST_UNREAD_SECONDS = 5.0


class Readings(NamedTuple):
    """The moments at which complete readings of the graph began.

    ``last`` is the begin of the last reading, ``gap`` the longest time between the begins of two
    successive readings, both in seconds.
    """

    last: float = float("-inf")
    gap: float = 0.0

    def with_next(self, began: float) -> Readings:
        """Return these readings and the next one, which began at the moment ``began``."""
        gap = began - self.last if self.last > float("-inf") else 0.0
        return Readings(began, max(self.gap, gap))

    def show_everything(self, now: float) -> bool:
        """Return whether the graph was read so often until ``now`` that no node was missed."""
        return max(self.gap, now - self.last) <= _MOST_UNREAD_SECONDS


class GraphSource(Protocol):
    """A source of observations: `RosGraph`, or a script in a test."""

    @property
    def readings(self) -> Readings:
        """The complete readings until the last call of `next`."""

    def next(self, seconds: float) -> Observation | None:
        """Return the graph after its next change, or None if it has not changed for ``seconds``."""


class ObserverError(UnavailableError):
    """A failure of the observer process.

    ``reason`` is the text from rclpy, ``output`` the text that the DDS printed.
    """

    def __init__(self, what: str, reason: str, output: str) -> None:
        super().__init__(what, reason)
        self.reason = reason
        self.output = output


class RosGraph:
    """The live ROS graph, observed by a child process; use it as a context manager.

    ``environment`` has additional variables for the child process: the domain, and the enclave if
    the observer is to be secured.  With rmw_zenoh_cpp, the child process uses Zenoh, else rclpy.

    Raises:
        UnavailableError: rclpy, or Zenoh for Python, is not installed.
        ObserverError: rclpy cannot start a node, or Zenoh cannot connect.
    """

    def __init__(self, environment: Mapping[str, str] | None = None) -> None:
        variables = {**os.environ, **(environment or {})}
        if not any(variables.get(name) for name in PROFILE_VARIABLES):
            variables |= dict.fromkeys(PROFILE_VARIABLES, str(_ANNOUNCING))
        self._environment = {**_NO_SHARED_MEMORY, **variables}
        on_zenoh = self._environment.get("RMW_IMPLEMENTATION") == "rmw_zenoh_cpp"
        self._module = f"sros_tool.graph.{'zenoh_tokens' if on_zenoh else 'observation'}"
        _require("zenoh" if on_zenoh else "rclpy")
        self.rmw = ""
        self.readings = Readings()

    def __enter__(self) -> Self:
        read_end, write_end = os.pipe()
        self._output = tempfile.TemporaryFile()
        try:
            self._process = subprocess.Popen(
                # -P: never import modules from the current folder.
                [
                    *(sys.executable, "-P", "-m", self._module),
                    *(str(write_end), str(_READING_SECONDS)),
                ],
                stdin=subprocess.PIPE,
                stdout=self._output,
                stderr=subprocess.STDOUT,
                pass_fds=[write_end],
                env=self._environment,
                process_group=0,  # Ctrl-C then reaches only this process, which ends the observer
            )
        except BaseException:
            os.close(read_end)
            self._output.close()
            raise
        finally:
            os.close(write_end)
        _LOG.info("started the observer, process %d", self._process.pid)
        self._report = read_end
        self._rest = b""
        try:
            answer = self._line(_START_SECONDS)
            if answer is None or "ready" not in answer:
                raise self._observer_error(answer)
        except BaseException:
            self.close()
            raise
        self.rmw = answer["ready"]
        return self

    def __exit__(self, *_error: object) -> None:
        self.close()

    def next(self, seconds: float) -> Observation | None:
        """Return the graph after its next change, or None if it has not changed for ``seconds``."""
        deadline = time.monotonic() + seconds
        while True:
            line = self._line(max(deadline - time.monotonic(), 0))
            if line is None:
                return None
            self.readings = self.readings.with_next(line["began"])
            if "listed" in line:
                break
        endpoints = tuple(
            (participant, ns, name, Endpoint(topic, direction))
            for participant, ns, name, topic, direction in line["endpoints"]
        )
        return resolve(Sighting(_parse_listed(line["listed"]), endpoints, line["ordered"]))

    def close(self) -> None:
        """Stop the observer process.

        A process whose input is closed leaves the graph properly; a process that does not end is
        killed.
        """
        if self._process.stdin:
            self._process.stdin.close()
        try:
            self._process.wait(_END_SECONDS)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        os.close(self._report)
        self._output.close()

    def _line(self, seconds: float) -> dict[str, Any] | None:
        """Return the next JSON object of the observer, or None if none comes within ``seconds``."""
        deadline = time.monotonic() + seconds
        with selectors.DefaultSelector() as selector:
            selector.register(self._report, selectors.EVENT_READ)
            while b"\n" not in self._rest:
                left = deadline - time.monotonic()
                if not selector.select(max(left, 0)):
                    return None
                data = os.read(self._report, 1 << 20)
                if not data:
                    with contextlib.suppress(subprocess.TimeoutExpired):
                        self._process.wait(_END_SECONDS)
                    raise self._observer_error(None)
                self._rest += data
        line, _, self._rest = self._rest.partition(b"\n")
        message: dict[str, Any] = json.loads(line)
        return message

    def _observer_error(self, answer: Mapping[str, Any] | None) -> ObserverError:
        self._output.seek(0)
        output = self._output.read().decode("utf-8", "replace")
        if answer is None:
            ended = self._process.poll()
            reason = (
                f"It exited with status {ended}." if ended is not None else "It does not answer."
            )
            return ObserverError("the process that observes the ROS graph failed", reason, output)
        summary = {
            "import": "rclpy cannot be imported",
            "participant": "rclpy cannot start",
            "node": "rclpy cannot start a node to observe the graph",
            "session": "the observer cannot connect to the Zenoh router",
        }[answer["failed"]]
        return ObserverError(summary, f"{answer['reason']}".rstrip(".") + ".", output)


def _require(module: str) -> None:
    """Raise `UnavailableError` if this Python lacks ``module`` (rclpy or zenoh)."""
    if importlib.util.find_spec(module) is not None:
        return
    if module == "zenoh":
        raise UnavailableError(
            "Zenoh is not installed for this Python, and sros needs it to observe the ROS graph",
            f"Python is {sys.executable}.",
            "Run `pip install eclipse-zenoh`.",
        )
    raise UnavailableError(
        "rclpy is not installed for this Python, and sros needs it to observe the ROS graph",
        f"Python is {sys.executable}.",
        "On a machine with ROS 2, source its setup file first (. /opt/ros/jazzy/setup.bash); "
        "elsewhere: `pip install 'ros-jazzy-rclpy[fastrtps]' ros-jazzy-std-msgs`. "
        "A policy can still be learned from logs: `sros generate_policy POLICY --from-log LOG`.",
    )


def _parse_listed(listed_nodes: Sequence[Sequence[str]]) -> tuple[Listed, ...]:
    """Return the announced nodes in the observer's JSON, as (enclave, namespace, name)."""
    return tuple((enclave, ns, name) for enclave, ns, name in listed_nodes)


# ── for how long ────────────────────────────────────────────────────────────────────────


Clock = Callable[[], float]
_TICK = 0.2


class Settling(NamedTuple):
    """The times, in seconds, after which an observed graph counts as complete.

    The graph is complete after ``least`` seconds, if it has not changed for ``still`` seconds, and
    at the latest after ``most`` seconds.  Fast DDS announces its participants in a first burst, and
    then every 3 s.  With many participants, parts of the burst get lost: a graph of half a robot
    did not change from 0.4 to 3.4 s.
    """

    least: float = 4.0
    still: float = 3.5
    most: float = 30.0


SECURED = Settling(least=6.0, still=5.0, most=45.0)
"""Times for secured participants, which first authenticate each other, in up to 2.5 s."""


@dataclass(frozen=True, slots=True)
class Snapshot:
    """The graph at the end of an observation that took ``seconds`` seconds.

    ``everything`` also has the nodes that left while the graph was observed.  ``settled`` says
    whether the graph had stopped changing, or was watched without a gap.  ``intermittent`` are
    endpoints of the nodes in ``observation`` that a watch saw for a part of its time.  ``grew``
    says whether a watch still found new nodes or endpoints in its last ``Settling().still``
    seconds.
    """

    observation: Observation
    everything: Observation
    seconds: float
    settled: bool
    intermittent: frozenset[IntermittentEndpoint] = frozenset()
    grew: bool = False

    @property
    def unsettled(self) -> str:
        """Why nodes or endpoints may be missing, as a clause; "" if the whole graph was seen."""
        if self.grew:
            return (
                f"new nodes or endpoints still appeared in the last {Settling().still} s of the "
                f"watch, which took {self.seconds:.0f} s"
            )
        if self.settled:
            return ""
        return f"the ROS graph kept changing for {self.seconds:.0f} s, or could not be read in time"

    @property
    def gone(self) -> frozenset[ObservedNode]:
        """The nodes that left while the graph was observed."""
        stayed = {(node.participant, node.fqn) for node in self.observation.nodes}
        return frozenset(
            node for node in self.everything.nodes if (node.participant, node.fqn) not in stayed
        )


def settle(source: GraphSource, settling: Settling, clock: Clock) -> Snapshot:
    """Return the graph once it stops changing, at the latest after ``settling.most`` seconds.

    Time counts from the observer's first report, which comes late on a slow machine.  A graph is
    known to be still only until its last complete reading began.
    """
    begin = clock()
    changed: float | None = None
    seen = all_seen = Observation()
    while True:
        now = clock()
        if now - begin >= settling.most:
            return Snapshot(seen, all_seen, now - begin, False)
        is_still = changed is not None and source.readings.last - changed >= settling.still
        if now - begin >= settling.least and is_still:
            return Snapshot(seen, all_seen, now - begin, True)
        news = source.next(_TICK)
        if news is not None:
            seen, all_seen, changed = news, all_seen.union(news), clock()


def observe_for(source: GraphSource, seconds: float, clock: Clock) -> Snapshot:
    """Return the graph after exactly ``seconds`` seconds."""
    begin = clock()
    seen = all_seen = Observation()
    while (left := begin + seconds - clock()) > 0:
        if news := source.next(min(left, _TICK)):
            seen, all_seen = news, all_seen.union(news)
    return Snapshot(seen, all_seen, seconds, source.readings.show_everything(clock()))


def watch(
    source: GraphSource,
    seconds: float | None,
    clock: Clock,
    *,
    stop: Callable[[], bool],
    report: Callable[[Observation], None],
    still: float = 0.5,
    patience: float = 2.0,
) -> Snapshot:
    """Return the union of all graphs in ``seconds`` (None: no limit), or until ``stop()`` is true.

    When the union has grown, ``report`` gets the union after ``still`` seconds without a change, at
    the latest after ``patience`` seconds.  So no node is reported before it is discovered
    completely.  If a node that has just started is not announced yet, the watch lasts up to
    ``patience`` seconds longer.  If the union grew in the last ``Settling().still`` seconds, and
    ``seconds`` is more than that, the watch lasts up to ``Settling().still`` seconds longer.

    An endpoint that was seen is intermittent if the graph later stood still with the endpoint's
    node, but without the endpoint.  A graph that changes may show a node that is just ending.
    """
    begin = clock()
    seen = union = reported = Observation()
    missed: set[IntermittentEndpoint] = set()
    still_seen = seen
    grown = changed = begin
    quiet = Settling().still

    def is_over() -> bool:
        now = clock()
        if seconds is None or now - begin < seconds + patience * bool(seen.strays):
            return False
        is_growing = now - changed < quiet < seconds
        return not is_growing or now - begin >= seconds + quiet

    while not (stop() or is_over()):
        news = source.next(_TICK)
        now = clock()
        if news is not None:
            seen, joined = news, union.union(news)
            if joined != union:
                if reported is union:
                    grown = now
                union, changed = joined, now
        elif still_seen is not seen:
            missed.update(_missing_endpoints(union, seen))
            still_seen = seen
        if union is not reported and (now - changed >= still or now - grown >= patience):
            report(union)
            reported = union
    if union is not reported:
        report(union)
    stayed = {(node.fqn, node.participant) for node in seen.nodes}
    intermittent = frozenset(lost for lost in missed if (lost.node, lost.participant) in stayed)
    end = clock()
    grew = end - changed < quiet
    is_complete = source.readings.show_everything(end)
    return Snapshot(seen, union, end - begin, is_complete, intermittent, grew)


def _missing_endpoints(before: Observation, now: Observation) -> Iterator[IntermittentEndpoint]:
    """Yield the endpoints that nodes of the graph ``now`` had ``before``, and lack now."""
    earlier = {(node.fqn, node.participant): node.endpoints for node in before.nodes}
    for node in now.nodes:
        for endpoint in earlier[node.fqn, node.participant] - node.endpoints:
            yield IntermittentEndpoint(node.fqn, node.participant, *endpoint)


# ── the process and the enclave of each node ────────────────────────────────────────────


Listed = tuple[str, str, str]
"""An announced node: enclave, namespace, name."""
_Name = tuple[str, str]
# Node name of an endpoint that no announced node claims (rmw_dds_common, graph_cache).
NOBODY = "_NODE_NAME_UNKNOWN_"


class Sighting(NamedTuple):
    """A reading of the graph.

    ``listed`` are the announced nodes, in the order of the RMW.  ``endpoints`` are tuples of
    participant, namespace and name of the node, and endpoint.  ``ordered`` says that the RMW lists
    nodes by ascending participant, as rmw_dds_common does (graph_cache has a map of participants by
    identifier).
    """

    listed: tuple[Listed, ...]
    endpoints: tuple[tuple[str, str, str, Endpoint], ...]
    ordered: bool = False


def resolve(sighting: Sighting) -> Observation:
    """Return the nodes of a sighting, with their processes and possible enclaves."""
    by_participant: dict[str, dict[_Name, set[Endpoint]]] = {}
    strays = set()
    for participant, ns, name, endpoint in sighting.endpoints:
        if name in ("", NOBODY):
            strays.add((participant, endpoint))
        else:
            nodes = by_participant.setdefault(participant, {})
            nodes.setdefault((ns, name), set()).add(endpoint)
    candidates = _enclaves(
        sighting,
        {participant: frozenset(nodes) for participant, nodes in by_participant.items()},
    )
    nodes_seen = []
    heard = set()
    for participant, nodes in by_participant.items():
        enclaves = tuple(sorted(candidates[participant]))
        if not enclaves:  # not announced yet, or no longer
            strays |= {
                (participant, endpoint) for endpoints in nodes.values() for endpoint in endpoints
            }
            continue
        for (ns, name), endpoints in nodes.items():
            heard |= {(enclave, ns, name) for enclave in enclaves}
            nodes_seen.append(ObservedNode(enclaves, ns, name, participant, frozenset(endpoints)))
    return make_observation(nodes_seen, set(sighting.listed) - heard, strays)


def _enclaves(
    sighting: Sighting, processes: dict[str, frozenset[_Name]]
) -> dict[str, frozenset[str]]:
    """Map each process to the enclaves in which it may run, according to its listed nodes.

    ``processes`` maps participants to the names of their nodes.
    """
    free: dict[str, Counter[_Name]] = {}
    for enclave, ns, name in sighting.listed:
        free.setdefault(enclave, Counter())[(ns, name)] += 1
    candidates = {
        process: frozenset(e for e, names in free.items() if all(names[n] for n in nodes))
        for process, nodes in processes.items()
    }
    if sighting.ordered:
        candidates = _with_enclaves_by_order(sighting.listed, processes, candidates)
    settled: set[str] = set()
    while True:
        news = [
            process
            for process, left in candidates.items()
            if len(left) == 1 and process not in settled
        ]
        if not news:
            return candidates
        # A listed node of a decided process cannot belong to another process, which may decide that
        # one.
        for process in news:
            settled.add(process)
            (enclave,) = candidates[process]
            free[enclave].subtract(processes[process])
        for process, left in candidates.items():
            if process not in settled:
                possible = frozenset(
                    e for e in left if all(free[e][name] > 0 for name in processes[process])
                )
                candidates[process] = possible or left


def _with_enclaves_by_order(
    listed_nodes: Sequence[Listed],
    processes: dict[str, frozenset[_Name]],
    candidates: dict[str, frozenset[str]],
) -> dict[str, frozenset[str]]:
    """Return ``candidates`` with the enclaves that the order of ``listed_nodes`` decides.

    The nth listed node of a name belongs to the nth participant with a node of that name, if there
    are as many nodes as participants. ``processes`` maps participants to the names of their nodes.
    ``candidates`` do not change if the order contradicts them.
    """
    enclaves: dict[_Name, list[str]] = {}
    for enclave, ns, name in listed_nodes:
        enclaves.setdefault((ns, name), []).append(enclave)
    by_owner: dict[str, set[str]] = {}
    for node, places in enclaves.items():
        owners = sorted(process for process, names in processes.items() if node in names)
        if len(owners) == len(places):
            for owner, enclave in zip(owners, places, strict=True):
                by_owner.setdefault(owner, set()).add(enclave)
    if any(
        len(enclaves) > 1 or not enclaves <= candidates[owner]
        for owner, enclaves in by_owner.items()
    ):
        return candidates  # the order of the list is not the documented one
    return {process: frozenset(by_owner.get(process, left)) for process, left in candidates.items()}


# ── nodes that were never announced ─────────────────────────────────────────────────────


def with_owners_of_strays(observation: Observation) -> Observation:
    """Return the observation with the strays of each process as endpoints of its only node.

    A process that leaves soon may never announce its node; then the names of the node's standard
    services show the node. The possible enclaves of such a node are the enclaves of nodes with the
    same name, or else "/". Strays of a process without a known node, or with several nodes, stay
    strays.
    """
    by_process: dict[str, set[Endpoint]] = {}
    for participant, endpoint in observation.strays:
        by_process.setdefault(participant, set()).add(endpoint)
    announced = {(enclave, ns, name) for enclave, ns, name in observation.silent}
    names: dict[str, set[_Name]] = {}
    for node in observation.nodes:
        announced |= {(enclave, node.ns, node.name) for enclave in node.enclaves}
        names.setdefault(node.participant, set()).add((node.ns, node.name))
    owners = []
    for participant, endpoints in by_process.items():
        known = names.get(participant, set()) | set(_serving_nodes(endpoints))
        if len(known) == 1:
            (owner,) = known
            enclaves = tuple(sorted(e for e, *name in announced if tuple(name) == owner))
            owners.append(
                ObservedNode(
                    enclaves or _DEFAULT_ENCLAVE, *owner, participant, frozenset(endpoints)
                )
            )
    return observation.union(make_observation(owners))


def _serving_nodes(endpoints: Iterable[Endpoint]) -> Iterator[_Name]:
    """Yield namespace and name of each node whose standard services these endpoints serve."""
    for topic, direction in endpoints:
        if topic.startswith("rq/") and direction == SUBSCRIBE:
            node = node_of_service(topic[2:].removesuffix(SERVICE_ENDS["rq"]))
            if node:
                ns, _, name = node.rpartition("/")
                yield ns or "/", name


# ── enclaves by certificates ────────────────────────────────────────────────────────────


_FIRST_DIGITS_OF_SECURED = tuple("89abcdef")
"""First hexadecimal digits of identifiers of secured participants, whose first bit is set."""
_DEFAULT_ENCLAVE = ("/",)


def with_certified_enclaves(observation: Observation, enclaves: Mapping[str, str]) -> Observation:
    """Return the observation with the enclaves that the certificates of participants show.

    ``enclaves`` maps the result of `identity_of` to an enclave.  A secured node keeps no enclave if
    neither this map nor the graph shows its enclave.
    """
    nodes = []
    for node in observation.nodes:
        enclave = enclaves.get(node.participant[:IDENTITY_DIGITS])
        if enclave is not None:
            node = replace(node, enclaves=(enclave,))
        elif (
            node.participant.startswith(_FIRST_DIGITS_OF_SECURED)
            and node.enclaves == _DEFAULT_ENCLAVE
        ):
            node = replace(node, enclaves=())
        nodes.append(node)
    return make_observation(nodes, observation.silent, observation.strays)
