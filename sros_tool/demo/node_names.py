"""The names of a role's ROS nodes, chosen so that the permissions of their enclave allow them.

A ROS node offers standard services under its name (parameters, types), and an enclave made from a
policy allows these only for the nodes in that policy: a node with another name fails at start.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

from sros_tool.dds.permissions import Grant
from sros_tool.demo.grants import allows, named_topics
from sros_tool.demo.scenarios.model import Role
from sros_tool.names import NODE_SERVICES
from sros_tool.topics import dds_names

_NODE_MARK = ("rr", f"/{NODE_SERVICES[0]}Reply")


def is_node_allowed(grant: Grant, node: str) -> bool:
    """Return whether a grant allows all standard services of the node ``node`` (absolute)."""
    names = (dds_names("reply", f"{node}/{service}") for service in NODE_SERVICES)
    return all(
        all(allows(grant, "publish", topic) for topic in each.publish)
        and all(allows(grant, "subscribe", topic) for topic in each.subscribe)
        for each in names
    )


def nodes_named(grant: Grant) -> Iterator[str]:
    """Yield the absolute names of the nodes whose standard services a grant names and allows."""
    kind, service = _NODE_MARK
    for topic in named_topics(grant, "publish"):
        if topic.startswith(kind) and topic.endswith(service):
            node = topic.removeprefix(kind).removesuffix(service)
            if is_node_allowed(grant, node):
                yield node


DEFAULT_NODE_NAMES: Mapping[Role, tuple[str, ...]] = {
    Role.TALKER: ("talker",),
    Role.LISTENER: ("listener",),
    Role.OBSERVER: ("observer",),
    Role.SERVER: ("server",),
    Role.CLIENT: ("client",),
    Role.ACTION_SERVER: ("action_server",),
    Role.ACTION_CLIENT: ("action_client",),
    Role.COMPOSED: ("talker", "listener", "server"),
}
"""The default names of the nodes of each role, in the namespace /."""


def node_names(role: Role, grant: Grant | None) -> tuple[str, ...]:
    """Return the absolute names of a role's nodes under a grant (None: without security).

    A node keeps its default name if the grant allows it.  Otherwise it gets the most similar node
    name in the grant; if there is no such name, it keeps its default name.
    """
    wanted = [f"/{name}" for name in DEFAULT_NODE_NAMES[role]]
    if grant is None:
        return tuple(wanted)
    kept = {name for name in wanted if is_node_allowed(grant, name)}
    named = [*dict.fromkeys(nodes_named(grant))]
    free = [name for name in named if name not in kept]
    return tuple(_names(wanted, kept, free, named))


def _names(
    wanted: Sequence[str], kept: set[str], free: list[str], named: Sequence[str]
) -> Iterator[str]:
    for name in wanted:
        if name in kept or not named:
            yield name
            continue
        # With more nodes than names, two nodes share a name: DDS allows that in a process.
        alike = [each for each in free if name[1:] in each.lower()]
        chosen = (alike or free or named)[0]
        if chosen in free:
            free.remove(chosen)
        yield chosen


def naming_arguments(role: Role, names: Sequence[str]) -> list[str]:
    """Return the ``--ros-args`` that give the nodes of a role these absolute names."""
    rules: list[str] = []
    for default, name in zip(DEFAULT_NODE_NAMES[role], names, strict=True):
        namespace, _, node = name.rpartition("/")
        if node != default:
            rules += ["-r", f"{default}:__node:={node}"]
        if namespace:
            # rcl looks up the namespace under the new name of the node.
            rules += ["-r", f"{node}:__ns:={namespace}"]
    return ["--ros-args", *rules, "--"] if rules else []
