"""What the signed permissions of an enclave allow, for casting enclaves and naming their nodes."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

from sros_tool.dds.permissions import Grant, Rule, parse_permissions
from sros_tool.demo.scenarios.model import Role
from sros_tool.errors import SrosError
from sros_tool.keystore.layout import PERMISSIONS_FILE, enclave_path
from sros_tool.names import ACTION_SEPARATOR, NODE_SERVICES
from sros_tool.pki import smime
from sros_tool.policy.patterns import matches
from sros_tool.topics import dds_names
from sros_tool.xml import read_bytes

_TOPICS_OF_EVERY_NODE = ("rt/rosout", "rt/parameter_events", "rt/clock", "ros_discovery_info")
_WILD = set("*?[")


def enclave_grant(root: Path, enclave: str) -> Grant | None:
    """Return the first grant of an enclave, or None if its permissions cannot be read."""
    try:
        signed = read_bytes(enclave_path(root, enclave) / PERMISSIONS_FILE, "permissions document")
        grants = parse_permissions(smime.parse(signed).document).grants
    except (SrosError, OSError):
        return None
    return grants[0] if grants else None


def allows(grant: Grant, verb: str, topic: str) -> bool:
    """Return whether a grant allows ``verb`` (publish or subscribe) on a DDS topic."""
    return bool(_allowing(grant, verb, topic))


def _allowing(grant: Grant, verb: str, topic: str) -> str:
    """Return the expression by which a grant allows ``verb`` on a DDS topic; "" if it denies that.

    The first rule that names the topic decides, as with the vendors; of its expressions the topic's
    own name comes first.  A topic that no rule names is denied.
    """
    for rule in grant.rules:
        fitting = [
            expression for expression in _expressions(rule, verb) if matches(expression, topic)
        ]
        if fitting:
            return (topic if topic in fitting else fitting[0]) if rule.allow else ""
    return ""


def is_denied(grant: Grant, topic: str) -> bool:
    """Return whether a rule denies publishing or subscribing a DDS topic."""
    return any(
        matches(expression, topic)
        for rule in grant.rules
        for verb in ("publish", "subscribe")
        for expression in (() if rule.allow else _expressions(rule, verb))
    )


def expressions_of(grant: Grant, right: str, name: str) -> tuple[str, ...]:
    """Return the expression of `_allowing` for each DDS topic that a right on a ROS name needs."""
    topics = dds_names(right, name)
    return (
        *(_allowing(grant, "publish", topic) for topic in topics.publish),
        *(_allowing(grant, "subscribe", topic) for topic in topics.subscribe),
    )


def may(grant: Grant, right: str, name: str, *, named: bool = False) -> bool:
    """Return whether a grant allows a right on a ROS name; with ``named``, without wildcards."""
    return all(
        expression and not (named and is_wild(expression))
        for expression in expressions_of(grant, right, name)
    )


def is_wild(expression: str) -> bool:
    """Return whether an expression has wildcards, and so can match topics that nobody named."""
    return bool(set(expression) & _WILD)


def application_topics(grant: Grant, verb: str) -> Iterator[str]:
    """Yield the application's DDS topics that a grant allows by a name without wildcards.

    Topics of every node, hidden topics and topics of actions are left out.
    """
    for topic in _named_topics(grant, verb):
        private = topic.startswith("rt/_") or ACTION_SEPARATOR in topic
        if topic not in _TOPICS_OF_EVERY_NODE and not private:
            yield topic


def _named_topics(grant: Grant, verb: str) -> Iterator[str]:
    """Yield the DDS topics that a grant allows by a name without wildcards."""
    for rule in grant.rules:
        for topic in _expressions(rule, verb) if rule.allow else ():
            if not is_wild(topic):
                yield topic


def _expressions(rule: Rule, verb: str) -> Iterator[str]:
    for criteria in rule.publish if verb == "publish" else rule.subscribe:
        yield from criteria.topics


# ── names of nodes ───────────────────────────────────────────────────────────────────────────────

_NODE_MARK = ("rr", f"/{NODE_SERVICES[0]}Reply")


def is_node_allowed(grant: Grant, node: str) -> bool:
    """Return whether a grant allows all standard services of the node ``node`` (absolute)."""
    names = (dds_names("reply", f"{node}/{service}") for service in NODE_SERVICES)
    return all(
        all(allows(grant, "publish", topic) for topic in name.publish)
        and all(allows(grant, "subscribe", topic) for topic in name.subscribe)
        for name in names
    )


def nodes_named(grant: Grant) -> Iterator[str]:
    """Yield the absolute names of the nodes whose standard services a grant names and allows."""
    kind, service = _NODE_MARK
    for topic in _named_topics(grant, "publish"):
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
