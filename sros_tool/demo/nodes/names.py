"""What the signed permissions of an enclave allow, as far as nodes are cast by it.

A ROS node offers services under its own name: its parameters, its types.  An enclave that was made
from a policy allows them to the nodes of that policy alone, and a node of another name ends at
start.  So a node that plays a part in an enclave bears one of the names that the enclave allows.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

from sros_tool.dds.permissions import Grant, Rule, parse_permissions
from sros_tool.demo.model import Role
from sros_tool.errors import SrosError
from sros_tool.keystore.layout import enclave_path
from sros_tool.names import ACTION_INSIDE, NODE_SERVICES
from sros_tool.pki import smime
from sros_tool.policy.patterns import matches
from sros_tool.translate import dds_names

_EVERY_NODE = ("rt/rosout", "rt/parameter_events", "rt/clock", "ros_discovery_info")
_NODE_MARK = ("rr", f"/{NODE_SERVICES[0]}Reply")
_WILD = set("*?[")


def enclave_grant(root: Path, enclave: str) -> Grant | None:
    """Return the first grant of an enclave, or None where its permissions cannot be read."""
    try:
        signed = (enclave_path(root, enclave) / "permissions.p7s").read_bytes()
        grants = parse_permissions(smime.parse(signed).document).grants
    except (SrosError, OSError):
        return None
    return grants[0] if grants else None


def may(grant: Grant, verb: str, topic: str) -> bool:
    """Return whether the first rule that names a DDS topic allows it, as the vendors decide.

    ``verb`` is publish or subscribe.
    """
    for rule in grant.rules:
        if any(matches(expression, topic) for expression in _expressions(rule, verb)):
            return rule.allow
    return False


def topics_of_its_own(grant: Grant, verb: str) -> Iterator[str]:
    """Yield the DDS topics without wildcards that a grant allows, but for those of every node."""
    for topic in _allowed(grant, verb):
        private = topic.startswith("rt/_") or ACTION_INSIDE in topic
        if topic not in _EVERY_NODE and not private:
            yield topic


def is_node_allowed(grant: Grant, node: str) -> bool:
    """Return whether a grant allows every service that the node of that absolute name offers."""
    names = (dds_names("reply", f"{node}/{service}") for service in NODE_SERVICES)
    return all(
        all(may(grant, "publish", topic) for topic in each.publish)
        and all(may(grant, "subscribe", topic) for topic in each.subscribe)
        for each in names
    )


def nodes_named(grant: Grant) -> Iterator[str]:
    """Yield the absolute names of the nodes that a grant names and allows."""
    kind, service = _NODE_MARK
    for topic in _allowed(grant, "publish"):
        if topic.startswith(kind) and topic.endswith(service):
            node = topic.removeprefix(kind).removesuffix(service)
            if is_node_allowed(grant, node):
                yield node


def _allowed(grant: Grant, verb: str) -> Iterator[str]:
    for rule in grant.rules:
        for topic in _expressions(rule, verb) if rule.allow else ():
            if not set(topic) & _WILD:
                yield topic


def _expressions(rule: Rule, verb: str) -> Iterator[str]:
    for criteria in rule.publish if verb == "publish" else rule.subscribe:
        yield from criteria.topics


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
