"""Name the ROS nodes of the demo as the permissions of their enclave allow.

A ROS node offers services under its own name: its parameters, its types.  An enclave that was made
from a policy allows them to the nodes of that policy alone, and a node of another name ends at
start.  So a node that plays a part in an enclave bears one of the names that the enclave allows.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

from sros_tool.dds.permissions import Grant
from sros_tool.demo.granted import is_node_allowed, nodes_named
from sros_tool.demo.model import Role

OWN_NAMES: Mapping[Role, tuple[str, ...]] = {
    Role.TALKER: ("talker",),
    Role.LISTENER: ("listener",),
    Role.OBSERVER: ("observer",),
    Role.SERVER: ("server",),
    Role.CLIENT: ("client",),
    Role.ACTION_SERVER: ("action_server",),
    Role.ACTION_CLIENT: ("action_client",),
    Role.COMPOSED: ("talker", "listener", "server"),
}
"""The names that the nodes of a process have by themselves, in the namespace /."""


def node_names(role: Role, grant: Grant | None) -> tuple[str, ...]:
    """Return the absolute names of a role's nodes under a grant (None: without security).

    A node keeps its own name where the grant allows it.  Otherwise it gets that of a node which
    the grant names, the most similar one first, and its own one where there is none.
    """
    wanted = [f"/{name}" for name in OWN_NAMES[role]]
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
        # More nodes than names: DDS does not mind two nodes of one name in a process.
        alike = [each for each in free if name[1:] in each.lower()]
        chosen = (alike or free or named)[0]
        if chosen in free:
            free.remove(chosen)
        yield chosen


def naming_arguments(role: Role, names: Sequence[str]) -> list[str]:
    """Return the ``--ros-args`` by which the nodes of a role take these absolute names."""
    rules: list[str] = []
    for own, name in zip(OWN_NAMES[role], names, strict=True):
        namespace, _, node = name.rpartition("/")
        if node != own:
            rules += ["-r", f"{own}:__node:={node}"]
        if namespace:
            # rcl looks for the namespace of a node under the name that the node has by then.
            rules += ["-r", f"{node}:__ns:={namespace}"]
    return ["--ros-args", *rules, "--"] if rules else []
