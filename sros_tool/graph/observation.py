"""Observations of a ROS graph: nodes with their DDS endpoints, and the union of observations.

Topics have raw DDS names (``rt/chatter``, ``rq/addRequest``), because only raw names are
unambiguous; `sros_tool.graph.learn` translates them to ROS names.

``python -P -m sros_tool.graph.observation FD PERIOD`` is the observer process: it reads the ROS
graph through rclpy, so that a DDS that logs to standard output, refuses or crashes does no harm to
its parent.  The observer process writes JSON, one object per line, to the file descriptor FD: first
``{"ready": RMW}`` or ``{"failed": STAGE, "reason": TEXT}``, then an object after each reading: when
the reading began, and the graph if it has changed. The process reads the graph every PERIOD
seconds, after a change immediately, and exits when its standard input is closed.
"""

from __future__ import annotations

import json
import os
import secrets
import select
import sys
import time
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, NamedTuple, Protocol

from sros_tool.values import Words, shows

PUBLISH, SUBSCRIBE = "publish", "subscribe"


class Endpoint(NamedTuple):
    """A DDS writer (publish) or reader (subscribe) of a topic."""

    topic: str
    """Raw DDS name of the topic, such as ``rt/chatter``."""
    direction: Annotated[str, Words((PUBLISH, SUBSCRIBE))]
    """Whether the endpoint writes or reads the topic."""


class IntermittentEndpoint(NamedTuple):
    """An endpoint that its node had only for a part of a watch."""

    node: str
    """Full name of the node."""
    participant: str
    """DDS participant of the node's process, as in `nodes`."""
    topic: str
    """Raw DDS name of the topic."""
    direction: Annotated[str, Words((PUBLISH, SUBSCRIBE))]
    """Whether the endpoint writes or reads the topic."""


FAST_DDS = "010f"
"""The first two bytes of a participant of Fast DDS: its vendor id (RTPS 2.3, 9.4.5.1)."""
PROFILE_VARIABLES = ("FASTRTPS_DEFAULT_PROFILES_FILE", "FASTDDS_DEFAULT_PROFILES_FILE")
"""Variables that name files of profiles, for Fast DDS 2 and for Fast DDS 3."""


@shows("enclaves", "namespace", "name", "participant", "publish", "subscribe")
@dataclass(frozen=True, slots=True, order=True)
class ObservedNode:
    """A node of a process.

    ``enclaves`` has the enclave of the process, or all candidates, sorted, if the graph does not
    show the enclave. ``participant`` is the first 12 bytes of the identifiers of the node's
    endpoints, in hexadecimal (RTPS 2.3, 8.2.4.1), which nodes of the same process share. On Zenoh,
    ``participant`` is ``zenoh-`` and the id of the session.
    """

    enclaves: tuple[str, ...]
    """Enclave of the node, or several candidates if the graph does not show the enclave."""
    ns: str
    name: str
    """Name of the node, without its namespace."""
    participant: str
    """DDS participant of the node's process: the GUID prefix, in hexadecimal. On Zenoh, ``zenoh-``
    followed by the id of the session.
    """
    endpoints: frozenset[Endpoint]

    @property
    def namespace(self) -> str:
        """Namespace of the node."""
        return self.ns

    @property
    def publish(self) -> list[str]:
        """DDS topics that the node writes."""
        return _topics(self, PUBLISH)

    @property
    def subscribe(self) -> list[str]:
        """DDS topics that the node reads."""
        return _topics(self, SUBSCRIBE)

    @property
    def process(self) -> str:
        """The part of ``participant`` that all participants of the node's process share.

        A process has a participant for each context of rclpy or rclcpp.  With Fast DDS (2.6 to 3.6,
        ``GuidUtils.hpp``), all these participants have the host, process id and a random number in
        common; with other middleware, they have nothing in common.
        """
        return self.participant[:16] if self.participant.startswith(FAST_DDS) else self.participant

    @property
    def fqn(self) -> str:
        """Full name of the node: namespace and name."""
        return f"{self.ns.rstrip('/')}/{self.name}"


@shows("nodes")
class Observation(NamedTuple):
    """The nodes of a ROS graph, sorted, and the endpoints without a node.

    ``silent`` are nodes (enclave, namespace, name) that were announced but had no endpoint.
    ``strays`` are endpoints (participant, endpoint) without a node: endpoints of a program that
    does not use ROS, or of a node that was not discovered completely.
    """

    nodes: tuple[ObservedNode, ...] = ()
    """The observed nodes; empty if the graph was not observed."""
    silent: frozenset[tuple[str, str, str]] = frozenset()
    strays: frozenset[tuple[str, Endpoint]] = frozenset()

    @property
    def endpoint_count(self) -> int:
        """The number of endpoints of all nodes."""
        return sum(len(node.endpoints) for node in self.nodes)

    def union(self, other: Observation) -> Observation:
        """Return the nodes and endpoints of both observations.

        A process never changes its enclave, so a node keeps only the candidate enclaves that both
        observations have.
        """
        enclaves: dict[str, tuple[str, ...]] = {}
        endpoints: dict[tuple[str, str, str], frozenset[Endpoint]] = {}
        for node in (*self.nodes, *other.nodes):
            before = enclaves.get(node.participant, node.enclaves)
            common = tuple(enclave for enclave in before if enclave in node.enclaves)
            enclaves[node.participant] = common or tuple(sorted({*before, *node.enclaves}))
            key = (node.participant, node.ns, node.name)
            endpoints[key] = endpoints.get(key, frozenset()) | node.endpoints
        nodes = sorted(
            ObservedNode(enclaves[participant], ns, name, participant, node_endpoints)
            for (participant, ns, name), node_endpoints in endpoints.items()
        )
        heard = {(enclave, n.ns, n.name) for n in nodes for enclave in n.enclaves}
        claimed = {(n.participant, endpoint) for n in nodes for endpoint in n.endpoints}
        return Observation(
            tuple(nodes),
            frozenset((self.silent | other.silent) - heard),
            frozenset((self.strays | other.strays) - claimed),
        )


def make_observation(
    nodes: Iterable[ObservedNode],
    silent: Iterable[tuple[str, str, str]] = (),
    strays: Iterable[tuple[str, Endpoint]] = (),
) -> Observation:
    """Return an `Observation` with ``nodes`` sorted."""
    return Observation(tuple(sorted(nodes)), frozenset(silent), frozenset(strays))


def observation_from_json(value: Mapping[str, Any]) -> Observation:
    """Return the observation that `as_plain` turned into the JSON value ``value``.

    Raises:
        ValueError, TypeError, KeyError: ``value`` is not such a JSON value.
    """
    return make_observation(
        ObservedNode(
            tuple(map(_text, node["enclaves"])),
            _text(node["namespace"]),
            _text(node["name"]),
            _text(node["participant"]),
            frozenset(Endpoint(_text(t), way) for way in (PUBLISH, SUBSCRIBE) for t in node[way]),
        )
        for node in value["nodes"]
    )


def intermittent_from_json(value: Mapping[str, Any]) -> Sequence[IntermittentEndpoint]:
    """Return the intermittent endpoints of an observation; earlier releases wrote none.

    Raises:
        ValueError, TypeError, KeyError: ``value`` is not such a JSON value.
    """
    fields = IntermittentEndpoint._fields
    return [
        IntermittentEndpoint(*(_text(endpoint[name]) for name in fields))
        for endpoint in value.get("intermittent", ())
    ]


def _text(value: object) -> str:
    if not isinstance(value, str):
        raise TypeError(f"{value!r} is not a text")
    return value


def _topics(node: ObservedNode, direction: str) -> list[str]:
    return sorted(endpoint.topic for endpoint in node.endpoints if endpoint.direction == direction)


_NODE_NAME = "_sros_observer_" + secrets.token_hex(8)
"""Name of the observer's node: random, so that no other program knows it in advance."""

_PREFIX_BYTES = 12  # length of the participant's part of an endpoint's identifier (RTPS 2.3, 9.3.1)
_DISCOVERY_TOPIC = "ros_discovery_info"
# These RMWs keep their participants sorted by identifier, and list nodes in that order.
_ORDERED_RMWS = (
    "rmw_fastrtps_cpp",
    "rmw_fastrtps_dynamic_cpp",
    "rmw_cyclonedds_cpp",
    "rmw_connextdds",
)
_LOG_FLUSH_SECONDS = 0.3
"""Seconds to wait before exit, so that the logging thread of Fast DDS can print its errors."""
_ATTEMPTS = 5
_REREAD_SECONDS = 0.01
"""Seconds until a changing graph is read again."""


def main() -> int:
    """Report the graph until standard input is closed; return the exit status."""
    report, period = os.fdopen(int(sys.argv[1]), "w", buffering=1), float(sys.argv[2])
    stage = "import"
    try:
        import rclpy
        from rclpy.parameter import Parameter
        from rclpy.signals import SignalHandlerOptions

        stage = "participant"
        context = rclpy.Context()
        rclpy.init(args=[], context=context, signal_handler_options=SignalHandlerOptions.NO)
        stage = "node"
        # A node with as few endpoints as rclpy allows, so that an observer needs few permissions.
        node = rclpy.create_node(
            _NODE_NAME,
            context=context,
            use_global_arguments=False,
            enable_rosout=False,
            start_parameter_services=False,
            parameter_overrides=[Parameter("start_type_description_service", value=False)],
        )
    except Exception as error:  # the parent gets any error of rclpy as the reason
        time.sleep(_LOG_FLUSH_SECONDS)
        send(report, {"failed": stage, "reason": f"{type(error).__name__}: {error}"})
        return 1
    rmw = rclpy.get_rmw_implementation_identifier()
    try:
        send(report, {"ready": rmw})
        report_graph(_Observer(node), report, period, ordered=rmw in _ORDERED_RMWS)
    except BrokenPipeError:
        pass
    finally:
        node.destroy_node()
        context.try_shutdown()
    return 0


class Reading(NamedTuple):
    """Nodes (enclave, namespace, name) and endpoints of the graph, in the RMW's order.

    With ``nodes_changed``, nodes came or went during the reading: ``listed`` has the nodes before
    and after it.  Otherwise, a program could hide nodes by starting and ending others all the time.
    """

    listed: list[Any]
    endpoints: list[Any]
    nodes_changed: bool = False


class GraphObserver(Protocol):
    """Interface of an observer of the ROS graph."""

    def snapshot(self) -> Reading:
        """Return a reading, of a single moment if possible."""


def report_graph(observer: GraphObserver, output: Any, period: float, *, ordered: bool) -> None:
    """Report each reading, with the graph after a change, until standard input is closed.

    The key ``began`` of a report is when its reading began, by the monotonic clock, which all
    processes share.  A reading of a very large graph can take minutes, and may lack later changes.

    After a change, the graph is read again immediately, not after ``period`` seconds: a node may
    not show all its endpoints yet, and may exit before the next regular reading.  ``ordered`` says
    that the nodes are listed by ascending participant, unless they changed during a reading.
    """
    before: Reading | None = None
    while True:
        message: dict[str, Any] = {"began": time.monotonic()}
        now = observer.snapshot()
        if changes := now.nodes_changed or now != before:
            in_order = ordered and not now.nodes_changed
            message |= {"ordered": in_order, "listed": now.listed, "endpoints": now.endpoints}
            before = now
        send(output, message)
        if select.select([sys.stdin], [], [], _REREAD_SECONDS if changes else period)[0]:
            return


class _Observer:
    """The observer's node, which reads the graph and leaves itself out of the result.

    Another node that takes the same name later is not left out.
    """

    def __init__(self, node: Any) -> None:
        self._node = node
        self._itself: tuple[str, str, str] | None = None
        self._participant = ""

    def snapshot(self) -> Reading:
        """Return a reading of a single moment, unless nodes changed in every attempt."""
        after = self._listed()
        for _ in range(_ATTEMPTS):
            before, endpoints, after = after, self._endpoints(), self._listed()
            if before == after:
                return Reading(after, endpoints)
        listed = (Counter(before) | Counter(after)).elements()
        return Reading(sorted(listed), endpoints, nodes_changed=True)

    def _listed(self) -> list[tuple[str, str, str]]:
        """Return (enclave, namespace, name) of all nodes but the observer, in the RMW's order."""
        nodes = self._node.get_node_names_and_namespaces_with_enclaves()
        listed = [(enclave, ns, name) for name, ns, enclave in nodes]
        itself = self._itself or next((node for node in listed if node[2] == _NODE_NAME), None)
        if itself in listed:
            self._itself = itself
            listed.remove(itself)
        return listed

    def _endpoints(self) -> list[tuple[str, str, str, str, str]]:
        """Return all endpoints except the observer's, sorted.

        An endpoint is (participant, namespace of its node, name of its node, topic, direction).
        """
        endpoints = set()
        for topic, _ in self._node.get_topic_names_and_types(no_demangle=True):
            if (
                topic == _DISCOVERY_TOPIC
            ):  # every participant has this topic, and no policy mentions it
                continue
            for direction, infos in (
                (PUBLISH, self._node.get_publishers_info_by_topic(topic, no_mangle=True)),
                (SUBSCRIBE, self._node.get_subscriptions_info_by_topic(topic, no_mangle=True)),
            ):
                for info in infos:
                    participant = bytes(info.endpoint_gid[:_PREFIX_BYTES]).hex()
                    endpoints.add(
                        (participant, info.node_namespace, info.node_name, topic, direction)
                    )
        # The first participant with this name is this process: the name is not known elsewhere yet.
        named = {participant for participant, _, name, *_ in endpoints if name == _NODE_NAME}
        if len(named) == 1 and not self._participant:
            (self._participant,) = named
        own = self._participant, _NODE_NAME
        return sorted(endpoint for endpoint in endpoints if (endpoint[0], endpoint[2]) != own)


def send(output: Any, value: object) -> None:
    """Write ``value`` as a line of JSON to the observer's output."""
    output.write(json.dumps(value) + "\n")


if __name__ == "__main__":
    sys.exit(main())
