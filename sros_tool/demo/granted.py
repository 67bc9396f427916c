"""What the signed permissions of an enclave allow, as far as nodes are cast by it."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from sros_tool.dds.permissions import Grant, Rule, parse_permissions
from sros_tool.errors import SrosError
from sros_tool.keystore.enclave import enclave_path
from sros_tool.names import NODE_SERVICES, dds_names
from sros_tool.pki import smime
from sros_tool.policy.patterns import matches

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
        private = topic.startswith("rt/_") or "/_action/" in topic
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
