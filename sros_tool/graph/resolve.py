"""Finds the process and the enclave of every node in what rclpy tells of a graph.

rclpy lists nodes with their enclaves, but without their processes; and endpoints with the names
of their nodes and with their participants (processes), but without enclaves.  Where nodes of the
same name run in several enclaves, the two lists have to be brought together.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

from sros_tool.graph.observation import Endpoint, Observation, ObservedNode, make_observation

Listed = tuple[str, str, str]
"""A node as it is announced: enclave, namespace, name."""
_Name = tuple[str, str]

# What rmw reports for an endpoint that no announced node claims (rmw_dds_common, graph_cache).
NOBODY = "_NODE_NAME_UNKNOWN_"


@dataclass(frozen=True, slots=True)
class Sighting:
    """One look at the graph: the announced nodes, in their order, and all endpoints.

    Each endpoint comes with its participant, and the namespace and name of its node.  ``ordered``
    says that the nodes are listed by ascending participant, as rmw_dds_common does (graph_cache
    keeps its participants in a map by identifier).
    """

    listed: tuple[Listed, ...]
    endpoints: tuple[tuple[str, str, str, Endpoint], ...]
    ordered: bool = False


def resolve(sighting: Sighting) -> Observation:
    """The nodes of a sighting, each with its process and the enclaves that it can have."""
    found: dict[str, dict[_Name, set[Endpoint]]] = {}
    strays = set()
    for participant, ns, name, endpoint in sighting.endpoints:
        if name in ("", NOBODY):
            strays.add((participant, endpoint))
        else:
            nodes = found.setdefault(participant, {})
            nodes.setdefault((ns, name), set()).add(endpoint)
    candidates = _enclaves(sighting, {each: frozenset(nodes) for each, nodes in found.items()})
    nodes_seen = []
    heard = set()
    for participant, nodes in found.items():
        enclaves = tuple(sorted(candidates[participant]))
        if not enclaves:  # its announcement is still to come, or was just withdrawn
            strays |= {(participant, each) for every in nodes.values() for each in every}
            continue
        for (ns, name), endpoints in nodes.items():
            heard |= {(enclave, ns, name) for enclave in enclaves}
            nodes_seen.append(ObservedNode(enclaves, ns, name, participant, frozenset(endpoints)))
    return make_observation(nodes_seen, set(sighting.listed) - heard, strays)


def _enclaves(
    sighting: Sighting, processes: dict[str, frozenset[_Name]]
) -> dict[str, frozenset[str]]:
    """The enclaves in which each process can be, narrowed as far as the sighting allows."""
    free: dict[str, Counter[_Name]] = {}
    for enclave, ns, name in sighting.listed:
        free.setdefault(enclave, Counter())[(ns, name)] += 1
    candidates = {
        each: frozenset(e for e, names in free.items() if all(names[n] for n in nodes))
        for each, nodes in processes.items()
    }
    if sighting.ordered:
        candidates = _by_order(sighting.listed, processes, candidates)
    settled: set[str] = set()
    while True:
        news = [each for each, left in candidates.items() if len(left) == 1 and each not in settled]
        if not news:
            return candidates
        # A node that is taken is not there for another process; that may settle further ones.
        for each in news:
            settled.add(each)
            (enclave,) = candidates[each]
            free[enclave].subtract(processes[each])
        for each, left in candidates.items():
            if each not in settled:
                possible = frozenset(
                    e for e in left if all(free[e][name] > 0 for name in processes[each])
                )
                candidates[each] = possible or left


def _by_order(
    listed: Sequence[Listed],
    processes: dict[str, frozenset[_Name]],
    candidates: dict[str, frozenset[str]],
) -> dict[str, frozenset[str]]:
    """The candidates, where the order of the list tells them; as they were, where it is in doubt.

    The nth node of a name belongs to the nth participant that has this name, if there are as
    many nodes as participants of it.
    """
    enclaves: dict[_Name, list[str]] = {}
    for enclave, ns, name in listed:
        enclaves.setdefault((ns, name), []).append(enclave)
    told: dict[str, set[str]] = {}
    for node, places in enclaves.items():
        owners = sorted(each for each, names in processes.items() if node in names)
        if len(owners) == len(places):
            for owner, enclave in zip(owners, places, strict=True):
                told.setdefault(owner, set()).add(enclave)
    if any(len(each) > 1 or not each <= candidates[owner] for owner, each in told.items()):
        return candidates  # not the order that was promised
    return {each: frozenset(told.get(each, left)) for each, left in candidates.items()}


def nodes_of(listed: Sequence[Sequence[str]]) -> tuple[Listed, ...]:
    """The announced nodes from JSON."""
    return tuple((enclave, ns, name) for enclave, ns, name in listed)
