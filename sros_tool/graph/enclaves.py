"""Choose an enclave for each process whose enclave the ROS graph does not show.

The graph shows the enclave / for a process that was started without ``--ros-args --enclave``, as
those of a robot that is not secured yet usually are.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

from sros_tool.dds.portable import name_notes
from sros_tool.errors import Note
from sros_tool.graph.learn import is_tool, listed, stable_name
from sros_tool.graph.observation import (
    PUBLISH,
    Endpoint,
    Observation,
    ObservedNode,
    make_observation,
)
from sros_tool.names import expand
from sros_tool.topics import dds_names

UNSHOWN = ("/",)
"""The enclaves of a node whose enclave the graph does not show."""

_CONTAINER = "~/_container/load_node"


@dataclass(frozen=True, slots=True)
class NamedEnclaves:
    """An observation in which every process has an enclave, and notes on the chosen names."""

    observation: Observation
    notes: tuple[Note, ...]


def enclave_per_node(observation: Observation) -> NamedEnclaves:
    """Return the observation with an enclave of its own for each process that is shown in /.

    The enclave has the namespace and name of the process's node.  A process has one enclave, also
    if it has several nodes: it is named after its component container, or after the node with the
    shortest name.  Notes say which processes have several nodes, which enclaves several processes
    share, and which names Cyclone DDS mistakes for each other.
    """
    processes: dict[str, list[ObservedNode]] = {}
    for node in observation.nodes:
        if node.enclaves == UNSHOWN and not is_tool(node):
            processes.setdefault(node.participant, []).append(node)
    names = {participant: _enclave_name(nodes) for participant, nodes in processes.items()}
    nodes = [
        replace(each, enclaves=(names[each.participant],))
        if each in processes.get(each.participant, ())
        else each
        for each in observation.nodes
    ]
    named = make_observation(nodes, observation.silent, observation.strays)
    return NamedEnclaves(named, tuple(_notes(processes, names, nodes)))


def _enclave_name(nodes: Sequence[ObservedNode]) -> str:
    """Return the name for the enclave of a process with these nodes.

    The part of a node's name that changes with every start is left out.
    """
    main = min(nodes, key=_rank)
    return replace(main, name=stable_name(main.name).rstrip("_*") or main.name).fqn


def _rank(node: ObservedNode) -> tuple[bool, bool, int, str]:
    """Return the sort key by which the first node of a process gives its enclave the name."""
    (reply,) = dds_names("reply", expand(_CONTAINER, node.ns, node.name)).publish
    is_container = Endpoint(reply, PUBLISH) in node.endpoints
    return not is_container, stable_name(node.name) != node.name, len(node.fqn), node.fqn


def _notes(
    processes: Mapping[str, Sequence[ObservedNode]],
    names: Mapping[str, str],
    nodes: Sequence[ObservedNode],
) -> Iterator[Note]:
    several = [
        f"{names[participant]} has {', '.join(sorted(each.fqn for each in found))}"
        for participant, found in processes.items()
        if len(found) > 1
    ]
    if several:
        yield Note(
            "graph.several-nodes",
            "DDS knows processes, and the nodes of one process share its enclave, which has the "
            f"name of one of them: {listed(sorted(several), '; ')}",
        )
    users: dict[str, set[str]] = {}
    for each in nodes:
        for enclave in each.enclaves:
            users.setdefault(enclave, set()).add(each.participant)
    shared = [
        f"{name} ({len(users[name])} processes)"
        for name in sorted(set(names.values()))
        if len(users[name]) > 1
    ]
    if shared:
        yield Note(
            "graph.shared-enclave",
            "several processes get the same enclave, with the rights of all of them, because "
            "their nodes have the same name; unless it is one that was restarted, give the nodes "
            "different names (-r __node:=NAME), or start each process with --ros-args --enclave: "
            f"{listed(shared)}",
        )
    yield from name_notes(users, set(names.values()))
