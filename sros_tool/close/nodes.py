"""The nodes observed on the open robot, with the enclaves and names of the current policy."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence, Set
from contextlib import suppress
from dataclasses import replace
from functools import cached_property
from itertools import chain
from typing import Any, NamedTuple, TypeVar

from sros_tool.close.processes import read_document
from sros_tool.close.robot import OBSERVER, LocalRobot
from sros_tool.errors import SrosError
from sros_tool.explain.audit import DeniedRight, audit, audited_enclaves
from sros_tool.graph.learn import stable_name
from sros_tool.graph.observation import (
    PUBLISH,
    Endpoint,
    Observation,
    ObservedNode,
    intermittent_from_json,
    make_observation,
    observation_from_json,
)
from sros_tool.keystore.participant import JoinContext
from sros_tool.names import expand, is_expression, right_to_use
from sros_tool.policy.document import read_policy
from sros_tool.policy.model import Policy
from sros_tool.policy.patterns import overlap
from sros_tool.runtime.rmw import chosen_vendor
from sros_tool.wording import counted

_Value = TypeVar("_Value")


class MovedEndpoint(NamedTuple):
    """An endpoint whose name changed because its node was renamed.

    ``old_node`` and ``new_node`` are full names of the node, ``old`` and ``new`` the endpoint.
    """

    old_node: str
    new_node: str
    old: Endpoint
    new: Endpoint


class ObservedNodes:
    """The nodes of the open robot, in the enclaves and with the names that the policy has now."""

    def __init__(self, robot: LocalRobot, nodes: Sequence[ObservedNode] | None = None) -> None:
        self.robot, self._nodes = robot, nodes

    @cached_property
    def as_observed(self) -> Sequence[ObservedNode]:
        """The nodes with the enclaves and names that they had on the open robot.

        Nodes whose enclave the graph did not show are left out.
        """
        nodes = self._nodes
        if nodes is None:
            nodes = self._read_observation(observation_from_json).nodes
        return [node for node in nodes if node.enclaves]

    @property
    def topics_without_node(self) -> str:
        """The topics on the open robot, as text, whose writers or readers belonged to no node."""

        def topics(learned: Any) -> str:
            notes = learned["notes"]
            texts = [str(note["text"]) for note in notes if note["id"] == "graph.stray"]
            return ", ".join(text.partition(": ")[2] for text in texts)

        return self._read_observation(topics)

    def _read_observation(self, parse: Callable[[Any], _Value]) -> _Value:
        file, again = self.robot.observation_file, "Watch the robot again: --for 1m."
        return read_document(file, parse, "an observation", again)

    @cached_property
    def policy(self) -> Policy:
        """The policy of the robot."""
        return read_policy(self.robot.policy)

    @property
    def policy_enclaves(self) -> set[str]:
        """The names of the enclaves in the policy."""
        return {enclave.path for enclave in self.policy.enclaves}

    @cached_property
    def in_their_enclaves(self) -> Sequence[ObservedNode]:
        """The nodes with their old names, in the enclaves that the policy gives them now.

        A node whose profile was moved is in the enclave of its profile.  A node without a profile
        follows the other nodes of its old enclave if they all moved into one enclave.
        """
        names = self.policy_enclaves
        enclave_of: dict[tuple[str, str], tuple[str, ...]] = {
            (profile.ns, profile.node): (enclave.path,)
            for enclave in self.policy.enclaves
            for profile in enclave.all_profiles()
        }
        moved = {
            node: enclave_of.get((node.ns, stable_name(node.name)))
            for node in self.as_observed
            if not names.issuperset(node.enclaves)
        }
        followed: dict[tuple[str, ...], set[tuple[str, ...]]] = {}
        for node, enclaves in moved.items():
            followed.setdefault(node.enclaves, set()).update({enclaves} if enclaves else ())
        for node, enclaves in moved.items():
            if not enclaves and len(others := followed[node.enclaves]) == 1:
                (moved[node],) = others
        return [
            replace(node, enclaves=enclaves) if (enclaves := moved.get(node)) else node
            for node in self.as_observed
        ]

    def expected_nodes(self, current: Observation | None = None) -> Observation:
        """Return the nodes whose enclaves the policy has, with the names that they should have now.

        If the policy allows several names for an endpoint of a renamed node, the result has the
        name that the node uses in the ``current`` graph.
        """
        names, nodes = self.policy_enclaves, []
        for node in self.in_their_enclaves:
            if node_name(node) in self.renamed_nodes or names.issuperset(node.enclaves):
                nodes.append(self._with_current_name(node, current, node.endpoints))
        return make_observation(nodes)

    def _with_current_name(
        self, node: ObservedNode, current: Observation | None, endpoints: Iterable[Endpoint]
    ) -> ObservedNode:
        """Return an observed node with its current name, and only with the given endpoints."""
        new = self.renamed_nodes.get(node_name(node))
        if not new:
            return replace(node, endpoints=frozenset(endpoints))
        names = self._current_endpoints(node, current)
        now = frozenset(names[endpoint] for endpoint in endpoints)
        return replace(node, ns=new[0], name=new[1], endpoints=now)

    def nodes_to_compare(
        self, away: Collection[str], current: Observation | None = None
    ) -> Observation:
        """Return the expected nodes with a profile, except those of the enclaves ``away``.

        No process of the enclaves ``away`` runs here.
        """
        nodes, _ = self.divide_by_profile(self.expected_nodes(current).nodes)
        return make_observation(node for node in nodes if node.enclaves[0] not in away)

    @cached_property
    def renamed_nodes(self) -> Mapping[str, tuple[str, str]]:
        """Map the old full names of renamed nodes to the namespace and name in the policy.

        A node counts as renamed if it is the only node of its enclave without a profile, and the
        enclave has only one profile of a node that was not observed.
        """
        _, without_profile = self.divide_by_profile(self.in_their_enclaves)
        known = {node_name(node) for node in self.as_observed}
        renamed = {}
        for enclave in self.policy.enclaves:
            old = {node_name(node) for node in without_profile if enclave.path in node.enclaves}
            new = {
                (profile.ns, profile.node)
                for profile in enclave.all_profiles()
                if profile.full_name not in known
                and not is_expression(f"{profile.ns}{profile.node}")
            }
            if len(old) == len(new) == 1:
                renamed[old.pop()] = new.pop()
        return renamed

    @cached_property
    def _allowed_endpoints(self) -> Mapping[ObservedNode, Mapping[Endpoint, Sequence[Endpoint]]]:
        """Map each renamed node to its old endpoints, and these to the allowed new endpoints.

        The new endpoints of an old one are sorted, the likeliest first.

        If the enclave denies all possible names, only the likeliest name is kept.
        """
        possible = {
            node: {
                endpoint: _possible_endpoints(endpoint, node, *new) for endpoint in node.endpoints
            }
            for node in self.in_their_enclaves
            if (new := self.renamed_nodes.get(node_name(node)))
        }
        tried = []
        for node, names in possible.items():
            ns, name = self.renamed_nodes[node_name(node)]
            candidates = frozenset(chain.from_iterable(names.values()))
            tried.append(replace(node, ns=ns, name=name, endpoints=candidates))
        denied = {
            (right.right.enclave, endpoint)
            for right in (self.denied_rights(make_observation(tried)) if tried else ())
            for endpoint in right.endpoints
        }
        return {
            node: {
                endpoint: [
                    candidate
                    for candidate in names
                    if denied.isdisjoint((enclave, candidate) for enclave in node.enclaves)
                ]
                or names[:1]
                for endpoint, names in endpoints.items()
            }
            for node, endpoints in possible.items()
        }

    def _current_endpoints(
        self, node: ObservedNode, current: Observation | None
    ) -> Mapping[Endpoint, Endpoint]:
        """Map the old endpoints of a renamed node to the endpoints that it should have now."""
        name = expand("~", *self.renamed_nodes[node_name(node)])
        nodes = (other for other in (current.nodes if current else ()) if node_name(other) == name)
        endpoints = {endpoint for other in nodes for endpoint in other.endpoints}
        return {
            endpoint: next((allowed for allowed in names if allowed in endpoints), names[0])
            for endpoint, names in self._allowed_endpoints[node].items()
        }

    def intermittent_endpoints(self, current: Observation) -> set[tuple[str, Endpoint]]:
        """Return the endpoints that nodes of the open robot had only for a part of the watch.

        The result has the names of `endpoints_of`, as in `expected_nodes` for the ``current``
        graph.
        """
        intermittent = {
            (seen.node, seen.participant, Endpoint(seen.topic, seen.direction))
            for seen in self._read_observation(intermittent_from_json)
        }
        partly, always = [], []
        for node in self.in_their_enclaves:
            part = frozenset(
                endpoint
                for endpoint in node.endpoints
                if (node.fqn, node.participant, endpoint) in intermittent
            )
            partly.append(self._with_current_name(node, current, part))
            always.append(self._with_current_name(node, current, node.endpoints - part))
        return {*endpoints_of(partly)}.difference(endpoints_of(always))

    def moved_endpoints(self, current: Observation | None = None) -> Set[MovedEndpoint]:
        """Return the endpoints whose names change because their nodes were renamed."""
        return {
            MovedEndpoint(
                node_name(node), expand("~", *self.renamed_nodes[node_name(node)]), before, after
            )
            for node in self._allowed_endpoints
            for before, after in self._current_endpoints(node, current).items()
            if before != after
        }

    def divide_by_profile(
        self, nodes: Iterable[ObservedNode]
    ) -> tuple[list[ObservedNode], list[ObservedNode]]:
        """Return the nodes that have a profile in the policy, and the nodes that have none."""
        profiles = [
            profile for enclave in self.policy.enclaves for profile in enclave.all_profiles()
        ]
        with_profile: list[ObservedNode] = []
        without_profile: list[ObservedNode] = []
        for node in nodes:
            name = stable_name(node.name)
            has_profile = any(
                overlap(profile.ns, node.ns) and overlap(profile.node, name) for profile in profiles
            )
            (with_profile if has_profile else without_profile).append(node)
        return with_profile, without_profile

    def denied_rights(self, observation: Observation) -> Sequence[DeniedRight]:
        """Return the rights that nodes need and the keystore denies."""
        shell = self.robot.shell
        context = JoinContext(self.robot.domain, shell.now(), shell.zone)
        vendor = chosen_vendor(None, None, shell.environment)[0]
        enclaves = audited_enclaves([self.robot.rights_source], vendor, context)
        return audit(observation, replace(enclaves, changed_since=True), OBSERVER).denied

    def names_in(self, enclave: str) -> tuple[set[str], str]:
        """Return the full names of an enclave's nodes, and the old name of a renamed node or "".

        The names are those of observed nodes and of nodes in the policy.
        """
        with suppress(SrosError):  # opening the robot must not fail because of a broken file
            observed = {
                node_name(node) for node in self.in_their_enclaves if enclave in node.enclaves
            }
            in_policy = self.policy.enclave(enclave)
            profiles = in_policy.all_profiles() if in_policy else ()
            names = {profile.full_name for profile in profiles}
            return observed | names, next(iter(observed & self.renamed_nodes.keys()), "")
        return set(), ""


def _possible_endpoints(
    endpoint: Endpoint, node: ObservedNode, ns: str, name: str
) -> Sequence[Endpoint]:
    """Return the possible new forms of an endpoint of a renamed node, the likeliest first.

    Private names of the node change with the node.  Another name in the node's namespace changes
    only if the program wrote it as a relative name, which the graph does not show.
    """
    prefix, fqn = endpoint.topic[:2], endpoint.topic[2:]
    private, near = expand("~/", node.ns, node.name), expand("", node.ns, "")
    if fqn.startswith(private):
        moved = f"{expand('~/', ns, name)}{fqn.removeprefix(private)}"
        return endpoint._replace(topic=prefix + moved), endpoint
    if fqn.startswith(near):  # not so for a DDS topic without a ROS name
        moved = expand(fqn.removeprefix(near), ns, name)
        return endpoint, endpoint._replace(topic=prefix + moved)
    return (endpoint,)


def ros_use(endpoint: Endpoint) -> tuple[str, str]:
    """Return the right that an endpoint needs, and its ROS name or, if it has none, DDS topic."""
    right, name = right_to_use(endpoint.topic, writes=endpoint.direction == PUBLISH)
    return right or endpoint.direction, name


def node_name(node: ObservedNode) -> str:
    """Return the full name of a node, with ``*`` for the part that changes with every start."""
    return f"{node.ns.rstrip('/')}/{stable_name(node.name)}"


def endpoints_of(nodes: Iterable[ObservedNode]) -> Iterator[tuple[str, Endpoint]]:
    """Yield node name and endpoint, with ``*`` for the parts that change with every start."""
    for node in nodes:
        for endpoint in node.endpoints:
            topic = endpoint.topic.replace(node.name, stable_name(node.name))
            yield node_name(node), endpoint._replace(topic=topic)


def nodes_text(nodes: Iterable[ObservedNode]) -> str:
    """Return the number of nodes in words; a node that started several times counts once."""
    return counted(len({*map(node_name, nodes)}), "node")
