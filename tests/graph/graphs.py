"""Nodes and observations for tests, said briefly."""

from __future__ import annotations

from collections.abc import Iterable

from sros_tool.graph.observation import Endpoint, Observation, ObservedNode, make_observation
from sros_tool.names import dds_names, expand

SERVICES = (
    "describe_parameters",
    "get_parameter_types",
    "get_parameters",
    "list_parameters",
    "set_parameters",
    "set_parameters_atomically",
)


def endpoints(ns: str, node: str, rights: Iterable[str]) -> frozenset[Endpoint]:
    """The endpoints of rights, each said as "publish chatter"."""
    found = set()
    for each in rights:
        right, name = each.split()
        names = dds_names(right, expand(name, ns, node))
        found |= {Endpoint(topic, "publish") for topic in names.publish}
        found |= {Endpoint(topic, "subscribe") for topic in names.subscribe}
    return frozenset(found)


def common(language: str) -> list[str]:
    """What a node of a language has without simulated time."""
    found = ["publish /rosout", "publish /parameter_events", "reply ~/get_type_description"]
    found += [f"reply ~/{service}" for service in SERVICES]
    return found + (["subscribe /parameter_events"] if language == "c++" else [])


def node(
    fqn: str,
    *rights: str,
    enclave: str | tuple[str, ...] = "/robot",
    participant: str = "p1",
    like: str = "",
) -> ObservedNode:
    """A node with these rights, and what every node of a language (``like``) has."""
    ns, _, name = fqn.rpartition("/")
    ns = ns or "/"
    enclaves = (enclave,) if isinstance(enclave, str) else enclave
    every = [*rights, *(common(like) if like else ())]
    return ObservedNode(enclaves, ns, name, participant, endpoints(ns, name, every))


def graph(*nodes: ObservedNode) -> Observation:
    """An observation of these nodes."""
    return make_observation(nodes)
