"""Turns an observation into the least policy under which the robot does what was seen.

Names come over the network, and on an unsecured robot from anybody: whatever is no plain ROS name
is left out, above all a topic that is *named* like a wildcard.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

from sros_tool.errors import InvalidNameError
from sros_tool.graph.common import CommonParts
from sros_tool.graph.fold import Right, fold
from sros_tool.graph.naming import is_tool, stable_name, written
from sros_tool.graph.observation import Endpoint, Observation, ObservedNode
from sros_tool.graph.remarks import Remarks
from sros_tool.names import (
    check_enclave_name,
    check_namespace,
    expand,
    expression_problem,
    is_expression,
)
from sros_tool.notes import Note
from sros_tool.policy.model import ALLOW, RIGHTS, Enclave, Group, Policy, Profile, Profiles

_Place = tuple[str, str, str]


@dataclass(frozen=True, slots=True)
class LearnedProfile:
    """A node's rights: by includes, and the rest in groups; ``rights`` are all, absolute."""

    enclave: str
    ns: str
    node: str
    rights: frozenset[Right]
    includes: tuple[str, ...]
    groups: tuple[Group, ...]


@dataclass(frozen=True, slots=True)
class Learned:
    """What an observation comes down to: profiles sorted by enclave and node, and remarks."""

    profiles: tuple[LearnedProfile, ...]
    notes: tuple[Note, ...] = ()

    @property
    def includes(self) -> tuple[str, ...]:
        """Every part that is included, sorted."""
        return tuple(sorted({each for profile in self.profiles for each in profile.includes}))

    def flat(self) -> Learned:
        """The same without includes."""
        profiles = (
            replace(each, includes=(), groups=groups_of(each.rights, each.ns, each.node))
            for each in self.profiles
        )
        return replace(self, profiles=tuple(profiles))

    def policy(self) -> Policy:
        """Everything as a policy without includes."""
        enclaves: dict[str, list[Profile]] = {}
        for each in self.profiles:
            groups = groups_of(each.rights, each.ns, each.node)
            enclaves.setdefault(each.enclave, []).append(Profile(each.ns, each.node, groups))
        return Policy(
            tuple(Enclave(path, (Profiles(tuple(found)),)) for path, found in enclaves.items())
        )


def learn(observation: Observation, common: CommonParts | None = None) -> Learned:
    """The policy of an observation; with ``common``, its parts stand for what every node has.

    A node that can be in one of several enclaves gets its rights in each of them, and a note.
    """
    remarks = Remarks()
    seen: dict[_Place, set[Right]] = {}
    for node in observation.nodes:
        if is_tool(node.name):
            remarks.add("tool", node.fqn)
            continue
        for place, rights in _rights_of(node, remarks):
            seen.setdefault(place, set()).update(rights)
    for enclave, ns, name in observation.silent:
        if is_tool(name):
            remarks.add("tool", f"{ns.rstrip('/')}/{name}")
        elif (enclave, ns, stable_name(name)) not in seen:
            remarks.add("silent", f"{ns.rstrip('/')}/{name}")
    for _, endpoint in observation.strays:
        remarks.add("stray", endpoint.topic)
    if len(seen) > 1 and {enclave for enclave, _, _ in seen} == {"/"}:
        remarks.add("root-enclave", str(len(seen)))
    profiles = []
    for place, found in sorted(seen.items()):
        if not found:
            continue
        _, ns, name = place
        rights = frozenset(found)
        includes, rest = common.choose(rights, ns, name) if common else ((), rights)
        profiles.append(LearnedProfile(*place, rights, includes, groups_of(rest, ns, name)))
    return Learned(tuple(profiles), remarks.notes())


def groups_of(rights: Iterable[Right], ns: str, node: str) -> tuple[Group, ...]:
    """Groups of one right each, in the order of the policy language, with sorted names."""
    rights = tuple(rights)
    groups = []
    for kind, both in RIGHTS.items():
        for right in both:
            names = sorted(written(each.name, ns, node) for each in rights if each.right == right)
            if names:
                groups.append(Group(kind, ((right, ALLOW),), tuple(names)))
    return tuple(groups)


def _rights_of(node: ObservedNode, remarks: Remarks) -> list[tuple[_Place, frozenset[Right]]]:
    """The profiles of a node, one for each enclave that it can be in."""
    if not node.enclaves:
        remarks.add("unknown-enclave", node.fqn)
        return []
    name = stable_name(node.name)
    enclaves = [each for each in node.enclaves if _is_enclave(each)]
    if not _is_place(node.ns, node.name) or not enclaves:
        remarks.add("odd-node", f"{node.fqn!r} in {' or '.join(map(repr, node.enclaves))}")
        return []
    if name != node.name:
        remarks.add("changing-name", f"{node.fqn} as {name}")
    if len(enclaves) > 1:
        remarks.add("ambiguous", f"{node.fqn} in {' or '.join(enclaves)}")
    folded = fold(each for each in node.endpoints if _is_plain(each, node, remarks))
    for half in folded.halves:
        remarks.add("half-service", f"{node.fqn} {half.topic}")
    for foreign in folded.foreign:
        remarks.add("no-ros-name", f"{node.fqn} {foreign.topic}")
    own, stable = expand("~/", node.ns, node.name), expand("~/", node.ns, name)
    rights = set()
    for each in folded.rights:
        _remark_on(each, node, remarks)
        renamed = stable + each.name[len(own) :] if each.name.startswith(own) else each.name
        rights.add(Right(each.right, renamed))
    return [((enclave, node.ns, name), frozenset(rights)) for enclave in enclaves]


def _remark_on(right: Right, node: ObservedNode, remarks: Remarks) -> None:
    if "/_action/" in right.name:
        remarks.add("partial-action", f"{node.fqn} {right.right} {right.name}")
    elif right.name.endswith("/_service_event"):
        remarks.add("service-event", f"{node.fqn} {right.right} {right.name}")
    elif right == Right("publish", "/clock"):
        remarks.add("sets-clock", node.fqn)


def _is_plain(endpoint: Endpoint, node: ObservedNode, remarks: Remarks) -> bool:
    _, slash, name = endpoint.topic.partition("/")
    if slash and (expression_problem("/" + name) or is_expression(name)):
        remarks.add("odd-name", f"{node.fqn} {endpoint.topic!r}")
        return False
    return True


def _is_enclave(name: str) -> bool:
    try:
        check_enclave_name(name)
    except InvalidNameError:
        return False
    return True


def _is_place(ns: str, name: str) -> bool:
    try:
        plain = check_namespace(ns) == ns and not is_expression(ns)
    except InvalidNameError:
        return False
    return plain and name.replace("_", "a").isalnum() and name.isascii() and not name[0].isdigit()
