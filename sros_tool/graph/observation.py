"""Observations of a ROS graph: nodes with their DDS endpoints, and the union of observations.

Topics have their raw DDS names here (``rt/chatter``, ``rq/addRequest``), because only those are
unambiguous; `sros_tool.graph.learn` translates them to ROS names.

As a process, ``python -P -m sros_tool.graph.observation FD PERIOD``, this module looks at the ROS
graph itself, so that the DDS can log to standard output, refuse, or crash without harm to its
parent.  It writes JSON, one object per line, to the file descriptor FD: first ``{"ready": RMW}`` or
``{"failed": STAGE, "reason": TEXT}``, then the graph after each change.  It looks every PERIOD
seconds, and exits when its standard input is closed.
"""

from __future__ import annotations

import json
import os
import secrets
import select
import sys
import time
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Annotated, Any, NamedTuple

from sros_tool.values import Words, shows

PUBLISH, SUBSCRIBE = "publish", "subscribe"


class Endpoint(NamedTuple):
    """A DDS topic (its raw name), and whether it is written (publish) or read (subscribe)."""

    topic: str
    """Its DDS topic."""
    direction: Annotated[str, Words((PUBLISH, SUBSCRIBE))]
    """What it does."""


@shows("enclaves", "namespace", "name", "participant", "publish", "subscribe")
@dataclass(frozen=True, slots=True, order=True)
class ObservedNode:
    """A node of one process.

    ``enclaves`` holds the enclave of that process; several, sorted, if the graph does not show
    which of them it is.  ``participant`` is the first 12 bytes of its endpoints' identifiers, in
    hex (RTPS 2.3, 8.2.4.1): the same for all nodes of a process, different for each process.
    """

    enclaves: tuple[str, ...]
    """Its enclave; several if the graph does not show which."""
    ns: str
    name: str
    """Its name."""
    participant: str
    """The participant of its process, in hexadecimal."""
    endpoints: frozenset[Endpoint]

    @property
    def namespace(self) -> str:
        """Its namespace."""
        return self.ns

    @property
    def publish(self) -> list[str]:
        """DDS topics that it writes."""
        return _topics(self, PUBLISH)

    @property
    def subscribe(self) -> list[str]:
        """DDS topics that it reads."""
        return _topics(self, SUBSCRIBE)

    @property
    def fqn(self) -> str:
        """The node's name with its namespace."""
        return f"{self.ns.rstrip('/')}/{self.name}"


@shows("nodes")
class Observation(NamedTuple):
    """The nodes of a graph, sorted, and the endpoints that belong to none of them.

    ``silent`` are nodes (enclave, namespace, name) that were announced but had no endpoint.
    ``strays`` are endpoints without a node: of a program that does not use ROS, or of a node
    that was not discovered completely.
    """

    nodes: tuple[ObservedNode, ...] = ()
    """The nodes that were observed; empty if none were asked for."""
    silent: frozenset[tuple[str, str, str]] = frozenset()
    strays: frozenset[tuple[str, Endpoint]] = frozenset()

    @property
    def endpoint_count(self) -> int:
        """The number of endpoints of all nodes together."""
        return sum(len(node.endpoints) for node in self.nodes)

    def union(self, other: Observation) -> Observation:
        """Return everything that is in either of the two observations.

        A process never changes its enclave, so only the enclaves remain that are possible in both
        observations.
        """
        enclaves: dict[str, tuple[str, ...]] = {}
        endpoints: dict[tuple[str, str, str], frozenset[Endpoint]] = {}
        for node in (*self.nodes, *other.nodes):
            before = enclaves.get(node.participant, node.enclaves)
            both = tuple(each for each in before if each in node.enclaves)
            enclaves[node.participant] = both or tuple(sorted({*before, *node.enclaves}))
            key = (node.participant, node.ns, node.name)
            endpoints[key] = endpoints.get(key, frozenset()) | node.endpoints
        nodes = sorted(
            ObservedNode(enclaves[participant], ns, name, participant, found)
            for (participant, ns, name), found in endpoints.items()
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
    """Return an observation of these nodes, sorted."""
    return Observation(tuple(sorted(nodes)), frozenset(silent), frozenset(strays))


def from_json(value: Mapping[str, Any]) -> Observation:
    """Return the observation in JSON that `as_plain` has made of one.

    Raises:
        ValueError, TypeError, KeyError: ``value`` is of another form.
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


def _text(value: object) -> str:
    if not isinstance(value, str):
        raise TypeError(f"{value!r} is not a text")
    return value


def _topics(node: ObservedNode, direction: str) -> list[str]:
    return sorted(endpoint.topic for endpoint in node.endpoints if endpoint.direction == direction)


_NODE_NAME = "_sros_observer_" + secrets.token_hex(8)
"""The name of the node that observes: nobody else can know it before the node is there."""

_PREFIX_BYTES = 12  # of an endpoint's identifier: its participant (RTPS 2.3, 9.3.1)
_DISCOVERY = "ros_discovery_info"
# These keep their participants sorted by identifier, and list nodes in that order.
_ORDERED = ("rmw_fastrtps_cpp", "rmw_fastrtps_dynamic_cpp", "rmw_cyclonedds_cpp", "rmw_connextdds")
_LOG_FLUSH_SECONDS = 0.3
"""Time for the logging thread of Fast DDS: a process that exits at once loses the reason."""
_ATTEMPTS = 5


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
        # With as few endpoints as rclpy allows, so that an observer needs few permissions.
        node = rclpy.create_node(
            _NODE_NAME,
            context=context,
            use_global_arguments=False,
            enable_rosout=False,
            start_parameter_services=False,
            parameter_overrides=[Parameter("start_type_description_service", value=False)],
        )
    except Exception as error:  # whatever rclpy raises has to reach the parent as a reason
        time.sleep(_LOG_FLUSH_SECONDS)
        _send(report, {"failed": stage, "reason": f"{type(error).__name__}: {error}"})
        return 1
    rmw = rclpy.get_rmw_implementation_identifier()
    try:
        _send(report, {"ready": rmw})
        _look(node, report, period, rmw in _ORDERED)
    except BrokenPipeError:
        pass
    finally:
        node.destroy_node()
        context.try_shutdown()
    return 0


def _look(node: Any, report: Any, period: float, ordered: bool) -> None:
    before: object = None
    observer = _Observer(node)
    while True:
        now = observer.sight()
        if now is not None and now != before:
            listed, endpoints = before = now
            _send(report, {"ordered": ordered, "listed": listed, "endpoints": endpoints})
        if select.select([sys.stdin], [], [], period)[0]:
            return


class _Observer:
    """The node that observes, which it leaves out; never another one that takes its name."""

    def __init__(self, node: Any) -> None:
        self._node = node
        self._itself: tuple[str, str, str] | None = None
        self._participant = ""

    def sight(self) -> tuple[list[Any], list[Any]] | None:
        """Return nodes and endpoints that belong together; None if nodes came or went each time."""
        for _ in range(_ATTEMPTS):
            listed = self._listed()
            endpoints = self._endpoints()
            if self._listed() == listed:
                return listed, endpoints
        return None

    def _listed(self) -> list[tuple[str, str, str]]:
        """Return enclave, namespace and name of each other node, in the RMW's order."""
        found = self._node.get_node_names_and_namespaces_with_enclaves()
        listed = [(enclave, ns, name) for name, ns, enclave in found]
        itself = self._itself or next((each for each in listed if each[2] == _NODE_NAME), None)
        if itself in listed:
            self._itself = itself
            listed.remove(itself)
        return listed

    def _endpoints(self) -> list[tuple[str, str, str, str, str]]:
        """Return the sorted endpoints: participant, node namespace and name, topic, direction."""
        found = set()
        for topic, _ in self._node.get_topic_names_and_types(no_demangle=True):
            if topic == _DISCOVERY:  # every participant has it, and no policy mentions it
                continue
            for direction, infos in (
                (PUBLISH, self._node.get_publishers_info_by_topic(topic, no_mangle=True)),
                (SUBSCRIBE, self._node.get_subscriptions_info_by_topic(topic, no_mangle=True)),
            ):
                for info in infos:
                    participant = bytes(info.endpoint_gid[:_PREFIX_BYTES]).hex()
                    found.add((participant, info.node_namespace, info.node_name, topic, direction))
        # The first participant with this name is this process: the name is not known elsewhere yet.
        named = {participant for participant, _, name, *_ in found if name == _NODE_NAME}
        if len(named) == 1 and not self._participant:
            (self._participant,) = named
        own = self._participant, _NODE_NAME
        return sorted(each for each in found if (each[0], each[2]) != own)


def _send(report: Any, value: object) -> None:
    report.write(json.dumps(value) + "\n")


if __name__ == "__main__":
    sys.exit(main())
