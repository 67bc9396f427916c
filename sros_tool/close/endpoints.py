"""Compare the endpoints that nodes had on the open robot with those that they have now."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator

from sros_tool.close.robot import MOST_NAMES
from sros_tool.explain.audit import DeniedRight
from sros_tool.graph.learn import is_tool, stable_name
from sros_tool.graph.observation import PUBLISH, SUBSCRIBE, Endpoint, Observation, ObservedNode
from sros_tool.names import right_to_use
from sros_tool.wording import first_few


def lost_endpoints(
    before: Observation, now: Observation, denied: Iterable[DeniedRight]
) -> list[str]:
    """Return the endpoints, as text, that nodes had before and lack now, unless ``denied``."""
    expected = {*_endpoints_of(before.nodes)} - _denied_endpoints(denied)
    lost: dict[str, list[str]] = {}
    gone = expected - {*_endpoints_of(now.nodes)}
    for node, right, name in sorted({(node, *ros_use(endpoint)) for node, endpoint in gone}):
        lost.setdefault(f"{node} {right}", []).append(name)
    return [f"{uses} {first_few(names, MOST_NAMES)}" for uses, names in lost.items()]


def left_alone(
    before: Observation,
    expected: Observation,
    moved: Collection[tuple[Endpoint, Endpoint]],
    denied: Iterable[DeniedRight],
) -> list[str]:
    """Return clauses on names that nodes still use, though all peers ``moved`` to another name.

    ``before`` are the nodes to compare, a part of the nodes ``expected`` now; ``denied`` endpoints
    are left out.
    """
    refused = _denied_endpoints(denied)
    robot_nodes = [node for node in expected.nodes if not is_tool(node)]
    kept = {endpoint for _, endpoint in {*_endpoints_of(robot_nodes)} - refused}
    used = {*_endpoints_of(node for node in before.nodes if not is_tool(node))} - refused
    other = {PUBLISH: SUBSCRIBE, SUBSCRIBE: PUBLISH}
    new_names = {
        old._replace(direction=other[old.direction]): ros_use(new)[1]
        for old, new in moved
        if old not in kept
    }
    alone = {(node, *ros_use(end), new_names[end]) for node, end in used if end in new_names}
    return [
        f"{node} {right} {name}, which is {new} now" for node, right, name, new in sorted(alone)
    ]


def _denied_endpoints(denied: Iterable[DeniedRight]) -> set[tuple[str, Endpoint]]:
    """Return the denied endpoints, with the names of their nodes."""
    return {
        (node, endpoint) for right in denied for node in right.nodes for endpoint in right.endpoints
    }


def ros_use(endpoint: Endpoint) -> tuple[str, str]:
    """Return the right that an endpoint needs, and its ROS name, or its DDS topic without one."""
    right, name = right_to_use(endpoint.topic, writes=endpoint.direction == PUBLISH)
    return right or endpoint.direction, name


def node_name(node: ObservedNode) -> str:
    """Return the full name of a node, with ``*`` for the part that changes with every start."""
    return f"{node.ns.rstrip('/')}/{stable_name(node.name)}"


def _endpoints_of(nodes: Iterable[ObservedNode]) -> Iterator[tuple[str, Endpoint]]:
    """Yield node name and endpoint, with ``*`` for the parts that change with every start."""
    for node in nodes:
        for topic, way in node.endpoints:
            yield node_name(node), Endpoint(topic.replace(node.name, stable_name(node.name)), way)
