"""Observations of a ROS graph: nodes with their DDS endpoints, and the union of observations.

Topics have their raw DDS names here (``rt/chatter``, ``rq/addRequest``), because only those are
unambiguous; `sros_tool.graph.learn` translates them to ROS names.
"""

from __future__ import annotations

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
