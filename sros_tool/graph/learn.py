"""Learn a policy from an observation of the ROS graph, and write it, or add it to a policy.

Names come over the network, and anybody can send names to an unsecured robot.  So every name that
is not a plain ROS name is left out, above all a topic that is *named* like a wildcard.  The policy
uses relative names where they are shorter, and ``*`` for the part of a node's name that changes
with every start.  A common part is included only if the node has every right in this part, so that
an include never grants more rights than were observed.  Learned names need no escaping: plain ROS
names contain no markup.

The graph shows the enclave / for a process that was started without ``--ros-args --enclave``, which
is usual on a robot that is not secured yet: `enclave_per_node` gives such processes enclaves.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import StrEnum
from functools import lru_cache
from itertools import groupby
from pathlib import Path
from typing import Annotated, NamedTuple

from sros_tool.dds.domains import DomainSet
from sros_tool.dds.permissions import Criteria, Rule, name_notes
from sros_tool.errors import DocumentError, InvalidNameError, Note, PolicyError, UsageError
from sros_tool.files import new_files, replace_file
from sros_tool.graph.observation import (
    PUBLISH,
    SUBSCRIBE,
    Endpoint,
    IntermittentEndpoint,
    Observation,
    ObservedNode,
    make_observation,
)
from sros_tool.names import (
    ACTION_SEPARATOR,
    GLOBAL_TOPICS,
    NODE_SERVICES,
    check_enclave_name,
    check_namespace,
    check_plain_namespace,
    dds_names,
    expand,
    expression_problem,
    is_expression,
    node_name_problem,
)
from sros_tool.policy.document import IncludedFile, Includer, read_policy
from sros_tool.policy.merge import (
    Contradiction,
    EditedText,
    Merged,
    PlacedElement,
    counterpart_notes,
    kept_rights_notes,
    merge_all,
    merge_into,
    undenied_rights,
)
from sros_tool.policy.model import (
    ALLOW,
    DENY,
    RIGHTS,
    VERSION,
    Enclave,
    Group,
    Policy,
    Profile,
    Profiles,
    policy_in_enclave,
    policy_in_namespace,
    policy_of_nodes,
    stated_protections,
)
from sros_tool.policy.remapping import parse_remapping, remapped_policies, remapped_policy
from sros_tool.policy.rights import Right, Rules, order, policy_rights, profile_rights
from sros_tool.translate import refuse_contradictions, ros_rights
from sros_tool.values import DryRun, FileChanges, Notes, Words, shows
from sros_tool.wording import first_few
from sros_tool.xml import read_bytes, tag_of


class NodeRight(NamedTuple):
    """A right (publish, subscribe, request, reply, call, execute) on an absolute ROS name."""

    right: str
    name: str


@dataclass(frozen=True, slots=True)
class LearnedProfile:
    """The rights of a node, and the form in which a profile states them.

    ``rights`` are all rights of the node, with absolute names. ``includes`` are the common parts
    that the profile includes, ``groups`` state the rights that these parts do not contain.
    """

    enclave: str
    ns: str
    node: str
    rights: frozenset[NodeRight]
    includes: tuple[str, ...]
    groups: tuple[Group, ...]


class RightsOrigin(StrEnum):
    """The source of learned rights.

    ``graph`` stands for rights in the observed ROS graph, ``log`` for rights that a log reports as
    denied, ``audit`` for observed rights that the policy or keystore denies.
    """

    GRAPH = "graph"
    LOG = "log"
    AUDIT = "audit"


@dataclass(frozen=True, slots=True)
class Learned:
    """The result of learning: profiles sorted by enclave and node, and notes.

    ``source`` is the source of the rights.
    """

    profiles: tuple[LearnedProfile, ...]
    notes: tuple[Note, ...] = ()
    source: RightsOrigin = RightsOrigin.GRAPH

    def with_notes(self, notes: Iterable[Note]) -> Learned:
        """Return a copy with ``notes`` in front of the current notes."""
        return replace(self, notes=(*notes, *self.notes))

    @property
    def includes(self) -> tuple[str, ...]:
        """The common parts that the profiles include, sorted."""
        return tuple(sorted({part for profile in self.profiles for part in profile.includes}))

    def flat(self) -> Learned:
        """Return a copy that states all rights in groups, without includes."""
        profiles = (
            replace(
                profile, includes=(), groups=groups_of(profile.rights, profile.ns, profile.node)
            )
            for profile in self.profiles
        )
        return replace(self, profiles=tuple(profiles))

    def policy(self) -> Policy:
        """Return the learned rights as a policy without includes."""
        enclaves: dict[str, list[Profile]] = {}
        for profile in self.profiles:
            groups = groups_of(profile.rights, profile.ns, profile.node)
            enclaves.setdefault(profile.enclave, []).append(
                Profile(profile.ns, profile.node, groups)
            )
        return Policy(
            tuple(
                Enclave(path, (Profiles(tuple(profiles)),)) for path, profiles in enclaves.items()
            )
        )


_Place = tuple[str, str, str]


def notes_on_ended_nodes(
    nodes: Iterable[ObservedNode], everything: Observation
) -> tuple[Note, ...]:
    """Return a note on nodes that ended while the graph was observed, without tools that only read.

    ``everything`` has all observed nodes.
    """
    notes, tools = _Notes(), tool_nodes(everything.nodes)
    for node in nodes:
        if node not in tools or writing_rights(node):
            notes.add("ended", node.fqn)
    return notes.notes()


def learn(
    observation: Observation, common: CommonParts | None = None, *, of_tools: bool = False
) -> Learned:
    """Return the rights that the observed nodes use; profiles may include the parts in ``common``.

    If the enclave of a node is ambiguous, every possible enclave gets the node's rights, with a
    note.  ``observation`` has the whole graph, and tools in it get no rights; with ``of_tools``,
    every node gets its rights, for a caller that chose the nodes.
    """
    notes = _Notes()
    tools = frozenset[ObservedNode]() if of_tools else tool_nodes(observation.nodes)
    seen: dict[_Place, set[NodeRight]] = {}
    processes: dict[tuple[str, str], set[str]] = {}
    for node in observation.nodes:
        if node in tools:
            if written := writing_rights(node):
                notes.add("tool-writes", f"{node.fqn} ({', '.join(written)})")
            else:
                notes.add("tool", node.fqn)
            continue
        if len(node.enclaves) == 1:
            processes.setdefault((node.fqn, *node.enclaves), set()).add(node.process)
        for place, rights in _rights_of(node, notes):
            seen.setdefault(place, set()).update(rights)
    for (fqn, enclave), using in processes.items():
        if len(using) > 1:
            notes.add("same-node", f"{fqn} in {enclave} ({len(using)} processes)")
    for enclave, ns, name in observation.silent:
        if (enclave, ns, stable_name(name)) not in seen:
            notes.add("silent", f"{ns.rstrip('/')}/{name}")
    for _, endpoint in observation.strays:
        notes.add("stray", endpoint.topic)
    unshown = sum(enclave == "/" for enclave, _, _ in seen)
    if unshown:
        share = "1 node" if len(seen) == 1 else f"{unshown} of {len(seen)} nodes"
        notes.add("root-enclave", share)
    profiles = []
    for place, used in sorted(seen.items()):
        if not used:
            continue
        _, ns, name = place
        rights = frozenset(used)
        includes, rest = common.choose(rights, ns, name) if common else ((), rights)
        profiles.append(LearnedProfile(*place, rights, includes, groups_of(rest, ns, name)))
    return Learned(tuple(profiles), notes.notes())


def _rights_of(node: ObservedNode, notes: _Notes) -> list[tuple[_Place, frozenset[NodeRight]]]:
    """Return pairs of place (enclave, namespace, name) and rights, for all possible enclaves.

    Names that a policy cannot express are left out, with a note.
    """
    if not node.enclaves:
        notes.add("unknown-enclave", node.fqn)
        return []
    name = stable_name(node.name)
    enclaves = [enclave for enclave in node.enclaves if _is_enclave(enclave)]
    if not _is_plain_node(node.ns, node.name) or not enclaves:
        notes.add("odd-node", f"{node.fqn!r} in {' or '.join(map(repr, node.enclaves))}")
        return []
    if name != node.name:
        notes.add("changing-name", f"{node.fqn} as {name}")
    if len(enclaves) > 1:
        notes.add("ambiguous", f"{node.fqn} in {' or '.join(enclaves)}")
    folded = rights_of_endpoints(
        endpoint for endpoint in node.endpoints if _is_plain(endpoint, node, notes)
    )
    for half in folded.halves:
        notes.add("half-service", f"{node.fqn} {half.topic}")
    for foreign in folded.foreign:
        notes.add("no-ros-name", f"{node.fqn} {foreign.topic}")
    own, stable = expand("~/", node.ns, node.name), expand("~/", node.ns, name)
    rights = set()
    for right in folded.rights:
        _note_about(right, node, notes)
        renamed = stable + right.name[len(own) :] if right.name.startswith(own) else right.name
        rights.add(NodeRight(right.right, renamed))
    return [((enclave, node.ns, name), frozenset(rights)) for enclave in enclaves]


def _note_about(right: NodeRight, node: ObservedNode, notes: _Notes) -> None:
    if ACTION_SEPARATOR in right.name:
        notes.add("partial-action", f"{node.fqn} {right.right} {right.name}")
    elif right.name.endswith("/_service_event"):
        notes.add("service-event", f"{node.fqn} {right.right} {right.name}")
    elif right == NodeRight("publish", "/clock"):
        notes.add("sets-clock", node.fqn)


def _is_plain(endpoint: Endpoint, node: ObservedNode, notes: _Notes) -> bool:
    _, slash, name = endpoint.topic.partition("/")
    if slash and (expression_problem("/" + name) or is_expression(name)):
        notes.add("odd-name", f"{node.fqn} {endpoint.topic!r}")
        return False
    return True


def _is_enclave(name: str) -> bool:
    try:
        check_enclave_name(name)
    except InvalidNameError:
        return False
    return True


def _is_plain_node(ns: str, name: str) -> bool:
    """Return whether ROS accepts the namespace and name of a node, both without wildcards."""
    try:
        plain = check_namespace(ns) == ns and not is_expression(ns)
    except InvalidNameError:
        return False
    return plain and not node_name_problem(name) and not is_expression(name)


class EndpointRights(NamedTuple):
    """The ROS rights that a node needs for a set of DDS endpoints.

    ``halves`` are service endpoints without the matching request or reply endpoint; ``foreign`` are
    topics without a ROS name. A policy can express neither ``halves`` nor ``foreign``.
    """

    rights: frozenset[NodeRight]
    halves: frozenset[Endpoint]
    foreign: frozenset[Endpoint]


_ANY_DOMAIN = DomainSet.of((0, 0))


def rights_of_endpoints(endpoints: Iterable[Endpoint]) -> EndpointRights:
    """Return the ROS rights that a node needs for these DDS endpoints.

    The topics of a service or an action become a single right if none of them is missing.
    """
    endpoints = tuple(endpoints)
    rule = Rule(True, _ANY_DOMAIN, _criteria(endpoints, PUBLISH), _criteria(endpoints, SUBSCRIBE))
    rights, halves, foreign = set(), set(), set()
    for right in ros_rights(rule):
        if right.kind != "dds":
            rights.add(NodeRight(right.right, right.name))
        elif right.name.startswith(("rq/", "rr/")):
            halves.add(Endpoint(right.name, right.right))
        else:
            foreign.add(Endpoint(right.name, right.right))
    return EndpointRights(frozenset(rights), frozenset(halves), frozenset(foreign))


def _criteria(endpoints: Iterable[Endpoint], direction: str) -> tuple[Criteria, ...]:
    topics = tuple(
        sorted(endpoint.topic for endpoint in endpoints if endpoint.direction == direction)
    )
    return (Criteria(topics),) if topics else ()


def groups_of(rights: Iterable[NodeRight], ns: str, node: str) -> tuple[Group, ...]:
    """Return a group of names for each right (publish, request, call...) that the node has.

    Names in a group are sorted, and relative to the node where that is shorter.
    """
    rights = tuple(rights)
    groups = []
    for kind, rights_of_kind in RIGHTS.items():
        for kind_of_right in rights_of_kind:
            names = sorted(
                name_as_written(right.name, ns, node)
                for right in rights
                if right.right == kind_of_right
            )
            if names:
                groups.append(Group(kind, ((kind_of_right, ALLOW),), tuple(names)))
    return tuple(groups)


# ── names ──────────────────────────────────────────────────────────────────────────────────


_CHANGING_NAMES = (
    # Names of tf2_ros listeners contain a memory address; the other names contain a process id.
    (re.compile(r"(transform_listener_impl_)[0-9a-f]+\Z"), r"\1*"),
    (re.compile(r"(launch_ros_)[0-9]+\Z"), r"\1*"),
    (re.compile(r"(rqt_gui_(?:py|cpp)_node_)[0-9]+\Z"), r"\1*"),
)
_TOOLS = re.compile(r"_ros2cli(_.*)?\Z|(?P<observer>_sros_observer)(_.*)?\Z")
_OBSERVER_ENDPOINTS = frozenset({Endpoint("rt/parameter_events", PUBLISH)})
"""The endpoints of an observer of sros.

A node with an observer's name and other endpoints is no observer.
"""


def tool_nodes(nodes: Iterable[ObservedNode]) -> frozenset[ObservedNode]:
    """Return the nodes of tools, such as ``ros2 topic echo``, among all ``nodes`` of a graph.

    Any program can give its nodes the name of a tool.  So a node counts as a tool only if all nodes
    of its process have names of tools: no node of the robot can hide a part of its own process.
    """
    nodes = tuple(nodes)
    others = {node.process for node in nodes if not _is_named_like_tool(node)}
    return frozenset(node for node in nodes if node.process not in others)


def robot_nodes(nodes: Iterable[ObservedNode]) -> list[ObservedNode]:
    """Return the nodes of a graph without the nodes of tools."""
    nodes = tuple(nodes)
    tools = tool_nodes(nodes)
    return [node for node in nodes if node not in tools]


def _is_named_like_tool(node: ObservedNode) -> bool:
    tool = _TOOLS.match(node.name)
    return tool is not None and (not tool["observer"] or node.endpoints <= _OBSERVER_ENDPOINTS)


def is_tool_name(name: str) -> bool:
    """Return whether a name is as tools give it to their nodes; other nodes can have it, too."""
    return _TOOLS.match(name) is not None


def writing_rights(tool: ObservedNode) -> tuple[str, ...]:
    """Return the rights of a tool, as text, by which it does more than observe.

    Reading, and writing what every node writes, is left out.
    """
    own_services = {expand(f"~/{service}", tool.ns, tool.name) for service in NODE_SERVICES}
    folded = rights_of_endpoints(tool.endpoints)
    rights = [
        right
        for right in folded.rights
        if right.right != SUBSCRIBE
        and not (right.right == PUBLISH and right.name in _WRITTEN_BY_EVERY_NODE)
        and not (right.right == "reply" and right.name in own_services)
    ]
    without_right = [
        endpoint for endpoint in folded.halves | folded.foreign if endpoint.direction == PUBLISH
    ]
    return tuple(
        sorted(
            [f"{right.right} {right.name}" for right in rights]
            + [f"{endpoint.direction} {endpoint.topic}" for endpoint in without_right]
        )
    )


_WRITTEN_BY_EVERY_NODE = ("/rosout", "/parameter_events")


def stable_name(name: str) -> str:
    """Return a node's name with ``*`` for the part that changes with every start."""
    for pattern, stable in _CHANGING_NAMES:
        if pattern.match(name):
            return pattern.sub(stable, name)
    return name


def name_as_written(fqn: str, ns: str, node: str) -> str:
    """Return an absolute name in the form of the profile of ``node`` in ``ns``.

    Private names of the node become ``~/x``, names in its namespace ``x``; other names stay
    absolute. In the root namespace, only names without a further slash become relative, because
    deeper names belong to other namespaces.  The inverse is `expand`.
    """
    own = expand("~/", ns, node)
    if fqn.startswith(own):
        return "~/" + fqn[len(own) :]
    prefix = "/" if ns == "/" else ns + "/"
    if fqn in GLOBAL_TOPICS or not fqn.startswith(prefix):
        return fqn
    rest = fqn[len(prefix) :]
    if ns == "/" and "/" in re.sub(r"/_(action/\w+|service_event)\Z", "", rest):
        return fqn
    return rest


# ── common parts ───────────────────────────────────────────────────────────────────────────


PARTS = (
    "common/lifecycle_node.xml",
    "common/component_container.xml",
    "common/node.xml",
    "common/rclcpp_node.xml",
    "common/rclpy_node.xml",
    "common/transform_listener.xml",
    "common/node/logging.xml",
    "common/node/parameters.xml",
    "common/node/time.xml",
    "common/node/types.xml",
)
"""Paths of the common parts that a learned policy can include, relative to the policy's folder.

Parts with more rights come first.
"""


@dataclass(frozen=True, slots=True)
class CommonParts:
    """The common parts that a policy can include.

    ``rights`` maps the path of a part to its rights, with names in the form of the part.
    ``missing`` maps the path of a part to the files to copy for this part: a map from path,
    relative to the folder of the policy, to content.
    """

    rights: Mapping[str, frozenset[NodeRight]] = field(default_factory=dict)
    missing: Mapping[str, Mapping[str, bytes]] = field(default_factory=dict)

    def choose(
        self, rights: frozenset[NodeRight], ns: str, node: str
    ) -> tuple[tuple[str, ...], frozenset[NodeRight]]:
        """Return the parts to include for these rights, and the rights that no part contains.

        The names of the rights are absolute.
        """
        chosen, rest = [], rights
        for part, names in self.rights.items():
            node_rights = _expanded_rights(names, ns, node)
            if node_rights <= rights and node_rights & rest:
                chosen.append(part)
                rest -= node_rights
        return tuple(chosen), rest

    def included_rights(self, parts: Iterable[str], ns: str, node: str) -> frozenset[NodeRight]:
        """Return the rights, with absolute names, that ``parts`` give to a node."""
        return frozenset().union(*(_expanded_rights(self.rights[part], ns, node) for part in parts))

    def files_to_copy(self, parts: Iterable[str]) -> dict[str, bytes]:
        """Return the content, by path, of files that ``parts`` need and the folder lacks."""
        return {path: data for part in parts for path, data in self.missing[part].items()}


def common_parts(folder: Path, shipped: Path) -> CommonParts:
    """Return the parts that a policy in ``folder`` can include, from ``folder`` or ``shipped``.

    A part in ``folder`` has priority.  A part of ``shipped`` is left out if ``folder`` has another
    version of a file that the part needs, so that versions never mix.
    """
    rights, missing = {}, {}
    for part, (needed, shipped_rights) in _shipped_parts(shipped).items():
        if (folder / part).exists():
            known, copies = _part_rights(folder, part), dict[str, bytes]()
        else:
            copies = {path: data for path, data in needed.items() if not (folder / path).exists()}
            other = [
                path
                for path in needed
                if path not in copies and _differs_from_shipped(folder, path, needed)
            ]
            known = None if other else shipped_rights
        if known:
            rights[part], missing[part] = known, copies
    return CommonParts(rights, missing)


def _expanded_rights(rights: Iterable[NodeRight], ns: str, node: str) -> frozenset[NodeRight]:
    return frozenset(NodeRight(right.right, expand(right.name, ns, node)) for right in rights)


def _differs_from_shipped(folder: Path, path: str, needed: Mapping[str, bytes]) -> bool:
    try:
        return read_bytes(folder / path, "policy file") != needed[path]
    except DocumentError:
        return True


def _part_rights(root: Path, part: str) -> frozenset[NodeRight] | None:
    """Return the rights that a common part allows; None if it denies a right or is unreadable."""
    includer = Includer(root.resolve())
    file = (root / part).resolve()
    rights = set()
    try:
        for group, _ in includer.children(includer.load(file), IncludedFile(file)):
            for right, qualifier in group.attrib.items():
                if qualifier != ALLOW:
                    return None
                rights |= {NodeRight(str(right), (name.text or "").strip()) for name in group}
    except DocumentError:
        return None
    return frozenset(rights)


@lru_cache(maxsize=4)  # cached, because verbs such as close call this several times
def _shipped_parts(
    shipped: Path,
) -> Mapping[str, tuple[Mapping[str, bytes], frozenset[NodeRight] | None]]:
    """Map each common part to its files (see `_needed_files`) and the rights that it allows."""
    return {part: (_needed_files(shipped, part), _part_rights(shipped, part)) for part in PARTS}


def _needed_files(root: Path, part: str) -> dict[str, bytes]:
    """Map the paths of a part and all its includes, relative to ``root``, to file contents."""
    files: dict[str, bytes] = {}
    waiting = [(root / part).resolve()]
    includer = Includer(root.resolve())
    while waiting:
        file = waiting.pop()
        path = file.relative_to(root.resolve()).as_posix()
        if path in files:
            continue
        files[path] = read_bytes(file, "policy file")
        waiting += [
            includer.target(element, IncludedFile(file))
            for element in includer.load(file)
            if tag_of(element).endswith("}include")
        ]
    return files


# ── notes and news ─────────────────────────────────────────────────────────────────────────


_MOST_SHOWN = 5
_NOTE_TEXTS = {
    "ambiguous": "nodes with the same name ({}) run in several enclaves, and the graph does not "
    "show which node runs in which enclave, so each of these enclaves gets the rights of all these "
    "nodes. To tell them apart, start one node at a time while this command runs with --watch",
    "changing-name": "nodes whose name changes with every start have a profile with a wildcard: {}",
    "ended": "left out, because these nodes ended while the graph was observed (--watch keeps "
    "them): {}",
    "half-service": "left out, because only the request or the reply of these services was "
    "observed: {}. Observe again with a longer --spin-time",
    "no-ros-name": "left out, because a policy cannot name topics that have no ROS name: {}",
    "odd-name": "left out, because these names are not valid in ROS; an attacker may be trying to "
    "get a wildcard into your policy: {}",
    "odd-node": "left out, because a policy cannot name these nodes or their enclaves: {}",
    "partial-action": "only parts of an action are used, so they are listed as "
    "topics and services: {}",
    "root-enclave": "the ROS graph shows the enclave / for {}, so the policy gives rights to "
    "/, and every process without an enclave has these rights. Either the "
    "processes were started without an enclave, or ROS_SECURITY_ENCLAVE_OVERRIDE (as `sros run` "
    "and `sros env` set it) names an enclave that the graph does not show. --enclave-per-node "
    "gives each process an enclave of its own, with the name of its node",
    "same-node": "several processes have a node with the same name in the same enclave, so this "
    "enclave gets the rights of all these processes: {}. Unless they are one process that was "
    "restarted, find out whether each of these processes is yours, and give the nodes different "
    "names (-r __node:=NAME)",
    "service-event": "service introspection is on, and every subscriber of these topics can read "
    "the requests: {}. If introspection is only for debugging, remove the topics from the policy",
    "sets-clock": "these nodes may set the clock of every node that uses simulated time; only a "
    "simulator or a player needs this: {}",
    "silent": "left out, because these nodes were announced but had no endpoint: {}",
    "stray": "left out, because the writers or readers of these topics belong to no ROS node: {}",
    "unknown-enclave": "left out, because the graph does not show in which enclaves these nodes "
    "run: {}. ROS_SECURITY_ENCLAVE_OVERRIDE names their enclaves, and the observer's keystore has "
    "no certificates of these enclaves. Observe with the keystore that has them (--keystore), or "
    "start the nodes with `--ros-args --enclave /its/name`",
    "tool": "left out, because these nodes have names of tools that observe the robot, and write "
    "nothing: {}",
    "tool-writes": "left out, although these nodes write, because they have names of the command "
    "`ros2`: {}. If one of them is a part of the robot, give it another name",
}


class _Notes:
    """A collector of the subjects (nodes, topics) of notes; a note lists all subjects of a kind."""

    def __init__(self) -> None:
        self._found: dict[str, set[str]] = {}

    def add(self, kind: str, subject: str) -> None:
        """Add a subject: a node, a topic, or a number."""
        self._found.setdefault(kind, set()).add(subject)

    def notes(self) -> tuple[Note, ...]:
        """Return a note for each kind of subject, sorted by id."""
        return tuple(
            Note(f"graph.{kind}", _NOTE_TEXTS[kind].format(first_subjects(sorted(subjects))))
            for kind, subjects in sorted(self._found.items())
        )


def first_subjects(subjects: Sequence[str], separator: str = ", ") -> str:
    """Return the first five subjects, and the number of others: "a, b, c, d, e and 2 more"."""
    return first_few(subjects, _MOST_SHOWN, separator)


_EVERY_NODE_PART = "common/node.xml"


class ReportedRights:
    """The nodes and rights that were reported so far, except rights that every node needs."""

    def __init__(self, common: CommonParts) -> None:
        self._ordinary = common.rights.get(_EVERY_NODE_PART, frozenset[NodeRight]())
        self._nodes: set[tuple[str, str, str]] = set()
        self._rights: set[tuple[str, str, str, NodeRight]] = set()

    def lines(self, observation: Observation) -> list[str]:
        """Return a line for each node and each right in ``observation`` not reported before."""
        lines = []
        for profile in learn(observation).profiles:
            place = profile.enclave, profile.ns, profile.node
            name = f"{profile.ns.rstrip('/')}/{profile.node}"
            if place not in self._nodes:
                self._nodes.add(place)
                lines.append(f"seen: {name} ({profile.enclave})")
            for right in sorted(profile.rights):
                plain = NodeRight(
                    right.right, name_as_written(right.name, profile.ns, profile.node)
                )
                if plain not in self._ordinary and (*place, right) not in self._rights:
                    self._rights.add((*place, right))
                    lines.append(f"seen: {name} ({profile.enclave}) {right.right} {right.name}")
        return lines


UNSHOWN = ("/",)
"""`ObservedNode.enclaves` of a node whose enclave the graph does not show."""

_CONTAINER_SERVICE = "~/_container/load_node"


class NamedEnclaves(NamedTuple):
    """An observation in which every process has an enclave, and notes on the chosen names."""

    observation: Observation
    notes: tuple[Note, ...]


def enclave_per_node(observation: Observation, *, of_tools: bool = False) -> NamedEnclaves:
    """Return the observation, with a new enclave for each process that has no enclave in the graph.

    The enclave has the namespace and name of the process's node.  If a process has several nodes,
    its enclave is named after the component container, or else after the node with the shortest
    name.  Notes name processes with several nodes, enclaves of several processes, and names that
    Cyclone DDS mistakes for each other.  ``of_tools`` is as for `learn`.
    """
    tools = frozenset[ObservedNode]() if of_tools else tool_nodes(observation.nodes)
    processes: dict[str, list[ObservedNode]] = {}
    for node in observation.nodes:
        if node.enclaves == UNSHOWN and node not in tools:
            processes.setdefault(node.process, []).append(node)
    names = {process: _enclave_name(nodes) for process, nodes in processes.items()}
    nodes = [
        replace(node, enclaves=(names[node.process],))
        if node in processes.get(node.process, ())
        else node
        for node in observation.nodes
    ]
    named = make_observation(nodes, observation.silent, observation.strays)
    return NamedEnclaves(named, tuple(_notes(processes, names, nodes)))


def _enclave_name(nodes: Sequence[ObservedNode]) -> str:
    """Return the enclave name for a process with these nodes.

    The name is the full name of the main node, without the part that changes with every start.
    """
    main = min(nodes, key=_enclave_rank)
    return replace(main, name=stable_name(main.name).rstrip("_*") or main.name).fqn


def _enclave_rank(node: ObservedNode) -> tuple[bool, bool, int, str]:
    """Return the sort key of a node; the lowest node gives its name to a process's enclave."""
    (reply,) = dds_names("reply", expand(_CONTAINER_SERVICE, node.ns, node.name)).publish
    is_container = Endpoint(reply, PUBLISH) in node.endpoints
    return not is_container, stable_name(node.name) != node.name, len(node.fqn), node.fqn


def _notes(
    processes: Mapping[str, Sequence[ObservedNode]],
    names: Mapping[str, str],
    nodes: Sequence[ObservedNode],
) -> Iterator[Note]:
    several = [
        f"{names[process]} has {', '.join(sorted(node.fqn for node in nodes))}"
        for process, nodes in processes.items()
        if len(nodes) > 1
    ]
    if several:
        yield Note(
            "graph.several-nodes",
            "DDS secures processes, so all nodes of a process share one enclave, named after "
            f"one of the nodes: {first_subjects(sorted(several), '; ')}",
        )
    users: dict[str, dict[str, set[str]]] = {}
    for node in nodes:
        for enclave in node.enclaves:
            users.setdefault(enclave, {}).setdefault(node.process, set()).add(node.fqn)
    shared = [
        f"{name} ({len(users[name])} processes)"
        for name in sorted(set(names.values()))
        # `learn` has a note on processes that have a node in common.
        if len(users[name]) > 1 and not set.intersection(*users[name].values())
    ]
    if shared:
        yield Note(
            "graph.shared-enclave",
            "several processes share an enclave, because of the names of their nodes: "
            f"{first_subjects(shared)}. Each enclave gets the rights of all its processes. Unless "
            "they are one process that was restarted, give the nodes different names (-r "
            "__node:=NAME), or start each process with --ros-args --enclave /NAME",
        )
    yield from name_notes(users, set(names.values()))


_XINCLUDE = "http://www.w3.org/2001/XInclude"
_INDENT = "  "
_DECLARATION = """<?xml version="1.0" encoding="UTF-8"?>\n"""
_HEADERS = {
    RightsOrigin.GRAPH: """\
<!-- Written by sros generate_policy: rights that the robot was observed to use.
     Review it before you enforce it: rights that were not observed are not allowed, and rights
     that were observed may be unwanted. -->
""",
    RightsOrigin.LOG: """\
<!-- Written by sros generate_policy: rights that were denied, as logs say.
     Review it before you enforce it: a process can print any line, also one that looks like a
     denial, to get a right that it should not have. -->
""",
    RightsOrigin.AUDIT: """\
<!-- Written by sros audit: rights that nodes were observed to use, and that the policy or keystore
     denies. Review it before you add it (sros merge_policy): rights that were observed may be
     unwanted. -->
""",
}
"""Source of rights → comment at the head of a learned policy."""


class DenialLine(NamedTuple):
    """A log line that reports a denied topic."""

    log: Path
    """Path of the log."""
    line: int
    """Number of the line, from 1."""
    process: str | None
    """The process that printed the line; null if it is unknown."""
    enclave: str | None
    """The enclave that the line names, or null."""
    direction: Annotated[str, Words((PUBLISH, SUBSCRIBE))]
    """Whether writing (``publish``) or reading (``subscribe``) was denied."""
    topic: str
    """The DDS topic that was denied."""


@shows(optional=("accepted", "denials"), spread=("observation",))
class LearnedPolicy(NamedTuple):
    """The learned rights, and the changes of the policy file."""

    file: Path | None
    """Path of the policy file; null without FILE."""
    source: RightsOrigin
    """The source of the rights."""
    created: bool
    """Whether the policy file is new, or would be with `--accept`."""
    changed: bool
    """Whether the policy file changes, or would change with `--accept`."""
    dry_run: DryRun
    observation: Observation
    """The nodes that were observed; empty for a log."""
    ended: Sequence[str]
    """The nodes whose participants ended while they were observed (`--watch`)."""
    intermittent: Sequence[IntermittentEndpoint]
    """The endpoints that running nodes had only for a part of the watch (`--watch`)."""
    settled: bool
    """Whether the ROS graph stopped changing, or was watched without a gap and did not grow any
    more at the end. Always true for a log.
    """
    added: Sequence[Right]
    """The rights that are added to the policy."""
    copied: Sequence[str]
    """Paths of common parts that are copied next to the policy."""
    accepted: bool | None
    """For a log: whether `--accept` was given; without it, no right is written."""
    denials: Sequence[DenialLine] | None
    """For a log: the lines that report denied rights."""
    changes: FileChanges
    notes: Notes


class Draft(NamedTuple):
    """A change of the policy file at ``path`` that is not written yet.

    ``before`` is the current content of the file, None if there is no file; ``document`` is the new
    content.  ``copies`` maps the paths of files to create, relative to the policy's folder, to
    their content.  ``document`` must give all rights in ``least``, and no right that is not in
    ``most``.
    """

    path: Path
    before: bytes | None
    document: bytes
    copies: Mapping[str, bytes]
    added: tuple[Right, ...]
    contradictions: tuple[Contradiction, ...]
    least: frozenset[Right]
    most: frozenset[Right]

    @property
    def changes(self) -> bool:
        """Whether writing the draft would change the policy."""
        return self.document != self.before


def draft(path: Path, learned: Learned, common: CommonParts | None) -> Draft:
    """Return the change that adds the ``learned`` rights to the policy file at ``path``.

    Nothing is written. ``common`` are the parts that ``learned`` may include; None stands for a
    single file without includes.

    Raises:
        PolicyError, DocumentError: the file is not a policy, or rights cannot be added to the file.
    """
    additions = learned.policy()
    rights = policy_rights(additions)
    if not os.path.lexists(path):
        copies = common.files_to_copy(learned.includes) if common else {}
        added = tuple(sorted(rights, key=order))
        return Draft(path, None, render(learned), copies, added, (), rights, rights)
    before = read_bytes(path, "policy file")
    merged = merge_into(path, additions)
    document, included = merged.document, tuple[str, ...]()
    if common and document != before:
        by_name, shown = _rights_and_profiles(path, before, merged.document, learned, common)
        document = merge_into(path, by_name.policy()).document
        document, included = _with_includes(path, before, document, shown)
    least = policy_rights(read_policy(path, merged.document))
    return Draft(
        path,
        before,
        document,
        common.files_to_copy(included) if common else {},
        merged.added,
        merged.contradictions,
        least,
        least | rights,
    )


def _rights_and_profiles(
    path: Path, before: bytes, merged: bytes, learned: Learned, common: CommonParts
) -> tuple[Learned, list[LearnedProfile]]:
    """Return the rights to write as single names, and the profiles to write with includes.

    An existing profile gets an include only if it neither has nor denies any right of the include.
    """
    known = _profiles_of(path, before)
    rules = Rules(policy_rights(read_policy(path, merged)))
    says: dict[tuple[str, str, str], set[tuple[str, str]]] = {}
    for enclave in read_policy(path, before).enclaves:
        for profile in enclave.all_profiles():
            rights = says.setdefault((enclave.path, profile.ns, profile.node), set())
            rights |= {
                (stated.right, stated.name) for stated in profile_rights(enclave.path, profile)
            }
    by_name, shown = [], []
    for own in learned.profiles:
        place = own.enclave, own.ns, own.node
        node_rights = common.included_rights(own.includes, own.ns, own.node)
        if place not in known:
            shown.append(own)
        elif node_rights and not any(
            (right.right, right.name) in says[place]
            or not rules.allow(own.enclave, right.right, right.name)
            for right in node_rights
        ):
            shown.append(own)
            own = replace(own, rights=own.rights - node_rights)
        by_name.append(own)
    return Learned(tuple(by_name)), shown


def write(plan: Draft) -> None:
    """Write a draft to disk, or change nothing after a failure.

    Raises:
        PolicyError: the new policy, read again, would not give the expected rights.
    """
    if not plan.changes:
        return
    with new_files(plan.path.parent, plan.copies):
        _check(plan)
        replace_file(plan.path, plan.document)


def _check(plan: Draft) -> None:
    try:
        written = policy_rights(read_policy(plan.path, plan.document))
        if plan.least <= written <= plan.most:
            return
        difference = min(written ^ plan.least, key=order)
        right = f"the right of enclave {difference.enclave} to {difference.describe()}"
        why = f"The written policy and the learned rights would differ in {right}."
    except DocumentError as error:
        why = f"{error}"
    raise PolicyError(
        f"the learned rights cannot be written to '{plan.path}'",
        why,
        "Add --flat, which writes no includes.",
    )


# ── text ───────────────────────────────────────────────────────────────────────────────────


def render(learned: Learned) -> bytes:
    """Return the learned profiles as a policy file (XML); equal profiles give equal bytes."""
    declared = f' xmlns:xi="{_XINCLUDE}"' if learned.includes else ""
    lines = [f'<policy version="{VERSION}"{declared}>', "  <enclaves>"]
    for path, profiles in groupby(learned.profiles, key=lambda profile: profile.enclave):
        lines += [f'    <enclave path="{path}">', "      <profiles>"]
        for profile in profiles:
            lines.append(f'        <profile ns="{profile.ns}" node="{profile.node}">')
            lines += [f"          {line}" for line in _content(profile, "xi:include", _INDENT)]
            lines.append("        </profile>")
        lines += ["      </profiles>", "    </enclave>"]
    lines += ["  </enclaves>", "</policy>", ""]
    header = _DECLARATION + _HEADERS[learned.source]
    return (header + "\n".join(lines)).encode()


def _content(profile: LearnedProfile, include: str, indentation: str) -> Iterator[str]:
    """Yield the XML lines inside a profile; ``include`` is the tag name of an include element."""
    yield from _includes(profile, include)
    for group in profile.groups:
        item = group.kind.removesuffix("s")
        rights = "".join(f' {right}="{qualifier}"' for right, qualifier in group.rights)
        yield f"<{group.kind}{rights}>"
        yield from (f"{indentation}<{item}>{name}</{item}>" for name in group.names)
        yield f"</{group.kind}>"


def _includes(profile: LearnedProfile, include: str) -> Iterator[str]:
    for part in profile.includes:
        yield f'<{include} href="{part}" xpointer="xpointer(/profile/*)"/>'


def _with_includes(
    path: Path, before: bytes, merged: bytes, profiles: Iterable[LearnedProfile]
) -> tuple[bytes, tuple[str, ...]]:
    """Return the policy file ``merged`` with includes added, and the included parts.

    ``merged`` is ``before`` with the learned rights.  A profile that ``before`` already had gets
    includes in front of its content. A new profile gets no includes if the policy denies a right of
    the profile.
    """
    name = f"the policy file '{path}'"
    known = _profiles(EditedText(before, name))
    text = EditedText(merged, name)
    rules = Rules(policy_rights(read_policy(path, merged)))
    wanted = {
        (profile.enclave, profile.ns, profile.node): profile
        for profile in profiles
        if profile.includes
    }
    included: set[str] = set()
    for place, element in _profiles(text).items():
        profile = wanted.get(place)
        if profile is None:
            continue
        if place in known:
            text.insert(element.inner, _includes_xml(profile, element, text))
        elif all(rules.allow(profile.enclave, right.right, right.name) for right in profile.rights):
            text.insert(element.inner, _content_xml(profile, element, text), element.close)
        else:
            continue
        included.update(profile.includes)
    if included and _prefix(text) is None:
        text.insert(text.root.inner - len(">"), f' xmlns:xi="{_XINCLUDE}"')
    return text.document(), tuple(sorted(included))


def merge_policies(
    path: Path,
    others: Sequence[Policy],
    namespace: str | None = None,
    remaps: Sequence[str] = (),
    enclave: str | None = None,
    nodes: Sequence[str] = (),
    *,
    may_include: bool = True,
) -> Merged:
    """Merge policies into the policy file at ``path``; write nothing.

    Only the ``nodes`` of ``others`` (() for all) are merged.  These nodes are moved to the
    ``namespace``, remapped by the rules in ``remaps``, and put into the ``enclave``.  With
    ``may_include``, new profiles include common parts in the folder of ``path``.

    Raises:
        SrosError: as `merge_all` and `remapped_policies`; or a name is not valid, or a node is in
            no policy; or the result would state two levels of protection for a name.
    """
    additions = list(others)
    if namespace is not None:
        namespace = check_plain_namespace(namespace)
        additions = [policy_in_namespace(addition, namespace) for addition in additions]
    of_all_nodes = additions
    if nodes:
        additions = [policy_of_nodes(addition, nodes) for addition in additions]
        known = {
            p.node for policy in of_all_nodes for e in policy.enclaves for p in e.all_profiles()
        }
        if missing := [node for node in nodes if node not in known]:
            raise UsageError(
                f"--node {missing[0]}: no policy to merge has a node of this name",
                f"They have {first_few(sorted(known), _MOST_SHOWN)}.",
                "Write the name as in node= of its <profile>.",
            )
    notes: list[Note] = []
    present, stated = read_policy(path, may_be_empty=True), additions
    if remaps:
        additions, notes = remapped_policies(additions, remaps, present, of_all_nodes)
    if enclave is not None:
        check_enclave_name(enclave)
        joined = sorted({each.path for addition in additions for each in addition.enclaves})
        if len(joined) > max(1, len(nodes)):
            text = (
                f"--enclave {enclave} joins the enclaves {first_few(joined, _MOST_SHOWN)} in one: "
                "each process in it has the rights of all their nodes, and each DENY applies to "
                "all. Ignore this note if these nodes run in one process. Otherwise, choose the "
                "nodes of one process with --node, and merge the others in a second run."
            )
            notes.append(Note("merge.joined-enclaves", text))
        additions = [policy_in_enclave(addition, enclave) for addition in additions]
    rules = [parse_remapping(text) for text in remaps]

    def moved(policy: Policy) -> Policy:
        if namespace is not None:
            policy = policy_in_namespace(policy, namespace)
        policy, _ = remapped_policy(policy, rules)
        return policy_in_enclave(policy, enclave) if enclave is not None else policy

    undenied = (undenied_rights(policy, moved) for policy in others)
    merged = merge_all(path, additions, frozenset().union(*undenied))
    protections = stated_protections(present.enclaves)
    added = (stated for addition in additions for stated in stated_protections(addition.enclaves))
    refuse_contradictions((*protections, *added), known=protections)
    notes += (*merged.notes, *counterpart_notes(present, stated, merged.rights))
    if not any(note.id == "merge.earlier-names" for note in notes):
        notes += kept_rights_notes(present, additions, merged.added)
    document = merged.document
    if merged.added and may_include:
        document = _with_common_parts(path, document, additions)
    return replace(merged, document=document, notes=tuple(notes))


def _with_common_parts(path: Path, merged: bytes, others: Sequence[Policy]) -> bytes:
    """Return the policy file ``merged`` with includes of common parts in its new profiles.

    A profile is new if the file at ``path`` lacks it. If ``others``, the policies that were added,
    have no includes, ``merged`` is returned unchanged.  Rights never change.  A profile that states
    a protection does not change.  A part is not included if the enclave denies a right in it.
    """
    if not any(
        group.source.file != merged_policy.file
        for merged_policy in others
        for enclave in merged_policy.enclaves
        for profile in enclave.all_profiles()
        for group in profile.groups
    ):
        return merged
    folder = path.resolve().parent
    parts = {
        part: rights
        for part in PARTS
        if (folder / part).exists() and (rights := _part_rights(folder, part))
    }
    common, policy = CommonParts(parts), read_policy(path, merged)
    before = read_bytes(path, "policy file")
    known, profiles = _profiles_of(path, before), []
    for enclave in policy.enclaves:
        allowed = _allowed_rights(policy_rights(Policy((enclave,))))
        for profile in enclave.all_profiles():
            ns, node = profile.ns, profile.node
            if (enclave.path, ns, node) in known or any(g.protect for g in profile.groups):
                continue
            own = _allowed_rights(profile_rights(enclave.path, profile))
            # A merge leaves out rights that another profile of the enclave allows.
            chosen, _ = common.choose(allowed, ns, node)
            includes = tuple(
                part for part in chosen if common.included_rights((part,), ns, node) & own
            )
            given = common.included_rights(includes, ns, node)
            groups = _groups_not_given(given, profile)
            profiles.append(LearnedProfile(enclave.path, ns, node, given, includes, groups))
    document, _ = _with_includes(path, before, merged, profiles)
    is_same = policy_rights(read_policy(path, document)) == policy_rights(policy)
    return document if is_same else merged


def _allowed_rights(rights: Iterable[Right]) -> frozenset[NodeRight]:
    return frozenset(NodeRight(e.right, e.name) for e in rights if e.qualifier is ALLOW)


def _groups_not_given(given_rights: frozenset[NodeRight], profile: Profile) -> tuple[Group, ...]:
    """Return the groups of a profile, without names whose rights are all in ``given_rights``.

    Names with a denial stay.
    """
    groups = []
    for group in profile.groups:
        names = tuple(
            name
            for name in group.names
            if any(
                qualifier is DENY
                or NodeRight(right, expand(name, profile.ns, profile.node)) not in given_rights
                for right, qualifier in group.rights
            )
        )
        if names:
            groups.append(replace(group, names=names))
    return tuple(groups)


def _profiles(text: EditedText) -> dict[tuple[str, str, str], PlacedElement]:
    return {
        (enclave.get("path"), check_namespace(profile.get("ns")), profile.get("node")): profile
        for block in text.root.named("enclaves")
        for enclave in block.named("enclave")
        for profiles in enclave.named("profiles")
        for profile in profiles.named("profile")
    }


def _profiles_of(path: Path, document: bytes) -> frozenset[tuple[str, str, str]]:
    """Return (enclave, namespace, node) of the profiles in the file, but not in its includes."""
    return frozenset(_profiles(EditedText(document, f"the policy file '{path}'")))


def _includes_xml(profile: LearnedProfile, element: PlacedElement, text: EditedText) -> str:
    """Return the XML of a profile's includes, to insert before the profile's content."""
    include = f"{_prefix(text) or 'xi'}:include"
    outer = text.indent_of(element)
    lead = "" if outer is None else text.newline + outer + text.indentation
    return "".join(lead + line for line in _includes(profile, include))


def _content_xml(profile: LearnedProfile, element: PlacedElement, text: EditedText) -> str:
    """Return the XML of a profile's content, indented like its neighbors."""
    include = f"{_prefix(text) or 'xi'}:include"
    outer = text.indent_of(element)
    if outer is None:
        return "".join(_content(profile, include, ""))
    lines = [text.indentation + line for line in _content(profile, include, text.indentation)]
    return "".join(text.newline + outer + line for line in (*lines, ""))


def _prefix(text: EditedText) -> str | None:
    """Return the prefix of the XInclude namespace; None for a document without a prefix."""
    return next((p for p, uri in text.root.xml.nsmap.items() if p and uri == _XINCLUDE), None)
