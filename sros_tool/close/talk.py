"""Prove that everything that talked on the open robot can still talk."""

from __future__ import annotations

import shlex
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from typing import Any

from sros_tool.close.nodes import (
    MovedEndpoint,
    ObservedNodes,
    endpoints_of,
    node_name,
    nodes_text,
    ros_use,
)
from sros_tool.close.processes import ObservedProcesses
from sros_tool.close.rights import ordinary_uses
from sros_tool.close.robot import MOST_NAMES, OBSERVER, LocalRobot
from sros_tool.close.state import TALK, Proof, RunningRobot
from sros_tool.errors import UnavailableError
from sros_tool.explain.audit import DeniedRight
from sros_tool.graph.learn import robot_nodes, tool_nodes
from sros_tool.graph.observation import (
    PUBLISH,
    SUBSCRIBE,
    Endpoint,
    Observation,
    ObservedNode,
    make_observation,
    observation_from_json,
)
from sros_tool.keystore.reader import OpenedKeystore
from sros_tool.keystore.rights import load_rights
from sros_tool.names import expand, is_expression
from sros_tool.policy.model import ALLOW, PEER_RIGHT
from sros_tool.policy.patterns import overlap
from sros_tool.policy.rights import (
    Right,
    RightsDifference,
    Rules,
    lost_counterpart_text,
    order,
    policy_rights,
    rights_without_counterpart,
)
from sros_tool.runtime.environment import ROS_ARGS, named_enclave
from sros_tool.runtime.unit_properties import unit_properties
from sros_tool.wording import counted, enumerated, first_few

_MOST_LATER = 20
"""Maximum number of names that a text shows of what the open robot did not have."""

_MOST_TRIES = 3
"""Maximum number of looks of the observer, until the nodes do what they did on the open robot."""


class UnitRestarts:
    """How often systemd restarted units, because their processes ended, since this object was made.

    Units of enclaves that the user named with --without are left out.
    """

    def __init__(self, robot: LocalRobot, observed: ObservedProcesses) -> None:
        self._robot = robot
        self._units = {
            process.enclave: process.unit
            for process in observed.processes
            if process.unit and process.enclave not in robot.without
        }
        self._before = {unit: self._count(unit) for unit in self._units.values()}

    def _count(self, unit: str) -> int:
        properties = unit_properties(unit, "NRestarts", "SubState")
        waits = properties.get("SubState") == "auto-restart"  # systemd restarts it soon
        return int(properties.get("NRestarts") or 0) + waits

    def texts(self) -> Mapping[str, str]:
        """Map the enclaves of restarted units to a text on the restarts, and on the log."""
        now = {unit: self._count(unit) - count for unit, count in self._before.items()}
        return {
            enclave: f"{enclave} ({unit}, {counted(now[unit], 'time')}; its log says why: "
            f"{self._robot.log_command(unit)}; if it ends on purpose, add --without {enclave})"
            for enclave, unit in self._units.items()
            if now[unit] > 0
        }


def proof_of_talk(
    running: RunningRobot, nodes: ObservedNodes, away: Collection[str], restarts: UnitRestarts
) -> Proof:
    """Return the proof that an observer in an enclave sees the same nodes as on the open robot.

    Processes of the enclaves ``away`` do not run; ``running`` are the processes of the other
    enclaves at the beginning of the proof. ``restarts`` counts since then: a process that ends
    again and again may be seen, and does not work.
    """
    robot = running.robot
    words = ["audit", str(robot.rights_source), "--keystore", str(robot.export)]
    words += ["--enclave", OBSERVER, "--domain", str(robot.domain), "--json"]
    words += ["--partial"] * bool(away or robot.without)
    for _ in range(_MOST_TRIES):  # nodes may still be starting
        try:
            status, audited = robot.shell.read_json(words)
        except UnavailableError as error:
            return Proof(TALK, None, str(error), details=[*_name_clauses(nodes, None, fails=False)])
        comparison = _TalkComparison(running, nodes, away, audited)
        restarted = restarts.texts()
        differences = {
            "restarted by systemd while the proof ran": [*restarted.values()],
            **comparison.differences(restarted),
            "not judged": audited["unjudged"],
        }
        # If everything is seen that the open robot did, the graph may keep changing.
        if status and audited["settled"] and not any(differences.values()):
            differences = {"not done": ["`sros audit` fails, and does not say why"]}
        reasons = {
            why: f"{why}: {first_few(names, MOST_NAMES, '; ', '; and ')}"
            for why, names in differences.items()
            if names
        }
        if not reasons:
            renamed = _name_clauses(nodes, comparison.current, fails=False)
            details = [*comparison.details(), *renamed]
            return Proof(TALK, True, comparison.summary(), comparison.denied, details)
    first, *others = reasons
    texts = [
        f"{reasons[first]}{_remedy(robot, first)}",
        *(f"also {reasons[why]}" for why in others),
    ]
    if elsewhere := comparison.unseen_elsewhere():
        options = " ".join(f"--without {name}" for name in elsewhere)
        texts.append(f"if the other machines are away on purpose, add {options}")
    details = [*comparison.not_compared(), *_name_clauses(nodes, comparison.current, fails=True)]
    if comparison.away:
        details.append(f"compared without {', '.join(comparison.away)}")
    return Proof(TALK, False, "; ".join(texts), comparison.denied, details)


def _remedy(robot: LocalRobot, difference: str) -> str:
    """Return the remedy for a kind of difference, as a clause; "" if the kind needs no remedy."""
    policy, restart = f"'{robot.policy}'", f"run `{robot.close_command}`, and restart these nodes"
    remedies = {
        "denied": "if a node needs this right, add the right to the node's profile in "
        f"{policy}, and {restart}; if you changed a name only in the policy, also start the node "
        "with the new name",
        "not seen this time": "if the node does not always use the name, prove again while it "
        f"does; if it uses another name now, replace the old name in {policy}, in the profiles of "
        "the node and of the nodes that it talks to (this takes away the right to the old name), "
        f"and {restart}; otherwise, start the node as before ({robot.commands_file})",
        "left alone": f"give both sides one name, in {policy} and in their programs, and {restart}",
        "refused": f"ask `sros check {shlex.quote(str(robot.export))}`",
    }
    return f"; {remedy}" if (remedy := remedies.get(difference)) else ""


class _TalkComparison:
    """A comparison of the nodes of the open robot with the nodes that an observer audited now.

    ``audited`` is the JSON of `sros audit`; the other arguments are as in `proof_of_talk`.
    Processes of --without that ended since the beginning of the proof are away, too.
    """

    def __init__(
        self,
        running: RunningRobot,
        nodes: ObservedNodes,
        away: Collection[str],
        audited: Mapping[str, Any],
    ) -> None:
        self.current = observation_from_json(audited)
        self._running, self._nodes, self._audited = running, nodes, audited
        self._ended = _ended_since(running)
        self._away = {*away, *self._ended.keys() & running.robot.without}
        self._denied = nodes.denied_rights(nodes.expected_nodes(self.current))
        self._intermittent = nodes.intermittent_endpoints(self.current)

    @property
    def away(self) -> Sequence[str]:
        """The enclaves that are not compared, because their processes need not run here."""
        return sorted(self._away)

    @property
    def denied(self) -> Sequence[str]:
        """The rights, as sentences, that the nodes used and the keystore denies."""
        return [str(right) for right in self._denied]

    def differences(self, restarted: Collection[str]) -> Mapping[str, Sequence[str]]:
        """Return the differences from the open robot, by kind, such as "not seen".

        What nodes of the enclaves ``restarted`` lack is left out.
        """
        ended, nodes = self._ended, self._nodes
        unseen = [node for node in self._unseen() if node["enclave"] not in restarted]
        before, expected = (
            nodes.nodes_to_compare(self._away, self.current),
            nodes.expected_nodes(self.current),
        )
        names = {*map(node_name, self.current.nodes)}
        absent = {node["enclave"] for node in unseen}
        present = [
            node
            for node in before.nodes
            if (node_name(node) in names or node.enclaves[0] not in absent)
            and node.enclaves[0] not in restarted
        ]
        moved, enclaves = nodes.moved_endpoints(self.current), nodes.policy_enclaves
        observed = [node for node in nodes.in_their_enclaves if enclaves.issuperset(node.enclaves)]
        return {
            "denied": [
                f"{right['enclave']} {right['right']} {right['name']}: {right['reason']}"
                for right in self._audited["denied"]
            ],
            "refused": [refused["enclave"] for refused in self._audited["refused"]],
            "ended while the proof ran": [
                f"{node['node'] or node['enclave']} ({ended[node['enclave']]}; start it again, "
                f"or, if it does not always run, add --without {node['enclave']})"
                for node in unseen
                if node["enclave"] in ended
            ],
            "not seen": [
                _unseen_text(self._running, node["node"], node["enclave"])
                for node in unseen
                if node["enclave"] not in ended
            ],
            "not seen this time": _endpoint_texts(
                self._lost_endpoints(present) - self._intermittent
            ),
            "left alone": [
                *_abandoned_names(before, expected, moved, self._denied),
                *_endpoints_without_peer(
                    make_observation(observed),
                    make_observation([*expected.nodes, *self.current.nodes]),
                    [pair for pair in moved if pair.new_node in map(node_name, before.nodes)],
                    self._denied,
                ),
            ],
        }

    def _unseen(self) -> list[Mapping[str, Any]]:
        return [node for node in self._audited["unseen"] if node["enclave"] not in self._away]

    def unseen_elsewhere(self) -> list[str]:
        """Return the enclaves of other machines that have unseen nodes."""
        return sorted({node["enclave"] for node in self._unseen()} & self._running.robot.not_here)

    def _lost_endpoints(self, before: Iterable[ObservedNode]) -> set[tuple[str, Endpoint]]:
        """Return the endpoints that nodes had before and lack now, except denied endpoints."""
        lost = {*endpoints_of(before)} - _denied_endpoints(self._denied)
        return lost.difference(endpoints_of(self.current.nodes))

    def _later_names(self, nodes: Iterable[ObservedNode]) -> list[str]:
        """Return the nodes, and the uses of other nodes, that the open robot did not have."""
        expected = self._nodes.expected_nodes(self.current).nodes
        known = {*map(node_name, expected)}
        uses = {*endpoints_of(nodes)}.difference(endpoints_of(expected))
        later = sorted({*map(node_name, nodes)} - known)
        return [*later, *_endpoint_texts((node, use) for node, use in uses if node in known)]

    def _removed_rights(self) -> Iterator[Right]:
        """Yield the rights that nodes used whose enclaves the policy no longer has."""
        kept = self._nodes.policy_enclaves
        for node in robot_nodes(self._nodes.in_their_enclaves):
            for enclave in {*node.enclaves} - kept:
                for right, name in {*map(ros_use, node.endpoints)}:
                    if right in PEER_RIGHT:
                        yield Right(enclave, ALLOW, right, name)

    def _unused_rights(self) -> list[Right]:
        """Return the rights of the policy to one name that no node used, then or now."""
        policy, robot = self._nodes.policy, self._running.robot
        nodes = [*self._nodes.expected_nodes(self.current).nodes, *self.current.nodes]
        used = {
            (enclave, endpoint)
            for node in nodes
            for enclave in node.enclaves
            for endpoint in node.endpoints
        }
        running = {enclave for enclave, _ in used}.difference(self._away, [OBSERVER])
        rights = policy_rights(policy)
        rules, ordinary = Rules(rights), ordinary_uses(policy, robot.folder)
        return [
            right
            for right in sorted(rights, key=order)
            if right.enclave in running
            and not is_expression(right.name)
            and rules.allow(right.enclave, right.right, right.name)
            and (right.enclave, right.right, right.name) not in ordinary
            and used.isdisjoint((right.enclave, endpoint) for endpoint in _endpoints(right))
        ]

    def summary(self) -> str:
        """Return text on what was compared."""
        before = self._nodes.nodes_to_compare(self._away)
        as_now = self._nodes.nodes_to_compare(self._away, self.current).nodes
        endpoints = {*endpoints_of(as_now)} - _denied_endpoints(self._denied)
        endpoints -= self._lost_endpoints(as_now)
        text = f"{nodes_text(before.nodes)} with {len(endpoints)} endpoints as before (types are "
        text += "not compared)"
        return text + (f", without {', '.join(self.away)}" if self.away else "")

    def details(self) -> Iterator[str]:
        """Yield clauses on rights that the policy takes away, unused rights, and new nodes."""
        before = self._nodes.nodes_to_compare(self._away)
        as_now = self._nodes.nodes_to_compare(self._away, self.current)
        if denied := self._denied:
            rights = ", ".join(f"{each.right.enclave} {each.right.describe()}" for each in denied)
            number = counted(len(denied), "right")
            yield f"the policy takes away {number} that the robot used: {rights}"
        gone = [*(right.right for right in self._denied), *self._removed_rights()]
        if lost := _without_counterpart(self._running.robot, gone):
            yield f"left without a counterpart: {first_few(lost, MOST_NAMES, '; ')}"
        if not_now := self._lost_endpoints(as_now.nodes):
            names = first_few(_endpoint_texts(not_now), MOST_NAMES)
            yield f"allowed, but not seen now, and not always seen during the watch: {names}"
        if unused := self._unused_rights():
            signed = Rules(load_rights(OpenedKeystore(self._running.robot.export)).rights)
            kinds: dict[str, list[str]] = {}
            for right in unused:
                is_signed = signed.allow(right.enclave, right.right, right.name)
                kind = "allowed, but seen neither on the open robot nor now"
                kind = kind if is_signed else "in the policy, but not signed yet"
                kinds.setdefault(kind, []).append(f"{right.enclave} {right.describe()}")
            yield from (f"{kind}: {first_few(kinds[kind], MOST_NAMES)}" for kind in kinds)
        if not self._audited["settled"]:
            yield "the ROS graph kept changing meanwhile, or could not be read in time"
        known = {*map(node_name, before.nodes)}
        _, without_profile = self._nodes.divide_by_profile(self.current.nodes)
        new = sorted(
            f"{node_name(node)} in {' or '.join(node.enclaves) or 'no enclave'}"
            for node in without_profile
            if node_name(node) not in known
        )
        if new:
            yield f"new, without a profile: {first_few(new, MOST_NAMES)}"
        yield from self.not_compared()

    def not_compared(self) -> Iterator[str]:
        """Yield clauses on what sros did not see on the open robot, or what was no ROS node."""
        with_profile, _ = self._nodes.divide_by_profile(self.current.nodes)
        if later := self._later_names(with_profile):
            names = first_few(later, _MOST_LATER)
            yield (
                f"not compared, because `sros close` did not see these on the open robot: {names}"
            )
        if topics := self._nodes.topics_without_node:
            yield (
                f"not compared: writers or readers of {topics}, which belonged to no ROS node "
                "(programs without security cannot talk to the closed robot)"
            )


def _without_counterpart(robot: LocalRobot, denied: Sequence[Right]) -> list[str]:
    """Return clauses on rights without a counterpart now that the rights ``denied`` are gone."""
    now = load_rights(robot.rights_source).rights
    before = [
        right
        for right in now
        if not any(
            right._replace(qualifier=ALLOW, name=gone.name) == gone
            and overlap(right.name, gone.name)
            for gone in denied
        )
    ]
    difference = RightsDifference(tuple(denied), (), {})
    lost = rights_without_counterpart([*before, *denied], now, difference)
    return [*map(lost_counterpart_text, lost)]


def _name_clauses(
    nodes: ObservedNodes, current: Observation | None, *, fails: bool
) -> Iterator[str]:
    """Yield a clause on nodes compared under new names, and a clause on nodes not compared.

    If the proof ``fails``, the first clause has advice, and the second clause is left out.
    """
    if renamed := nodes.renamed_nodes:
        names = [f"{old} as {expand('~', *renamed[old])}" for old in sorted(renamed)]
        text = f"compared under a new name: {first_few(names, MOST_NAMES)}"
        pairs = nodes.moved_endpoints(current)
        topics = sorted({(ros_use(pair.old)[1], ros_use(pair.new)[1]) for pair in pairs})
        private = tuple(f"{name}/" for name in renamed)
        if moved := [f"{old} as {new}" for old, new in topics if not old.startswith(private)]:
            text += f", and so {enumerated(moved)}"
            text += " (to keep a name, write it in policy.xml with a leading /)"
        if fails:
            text += (
                " (if a new name belongs to another node, and not to the renamed one, remove the "
                "unused rights from this other node's profile)"
            )
        yield text
    _, without_profile = nodes.divide_by_profile(nodes.as_observed)
    of_robot = {*without_profile} - tool_nodes(nodes.as_observed)
    not_compared = {*map(node_name, of_robot)} - renamed.keys()
    if not_compared and not fails:
        yield (
            "not compared, because the policy has no profile for them any more: "
            f"{first_few(sorted(not_compared), MOST_NAMES)} (removed, or renamed together with "
            "another change of nodes in the enclave)"
        )


def _ended_since(running: RunningRobot) -> dict[str, str]:
    """Map enclaves to the labels of processes that were ``running`` and have ended."""
    pids = {process.pid for process in RunningRobot(running.robot).processes.processes}
    return {
        enclave.name: process.label
        for process, enclave in running.secured
        if process.pid not in pids
    }


def _unseen_text(running: RunningRobot, node: str, enclave: str) -> str:
    """Return text on an unseen node that has a profile in ``enclave``, with what to do about it."""
    for process, process_enclave in running.secured:
        if (
            process_enclave.name == enclave
            and process.is_zenoh
            and named_enclave(process.command) != enclave
        ):
            return (
                f"{node or f'any node in {enclave}'} (add `{ROS_ARGS} --enclave {enclave}` at the "
                f"end of the command of {process.label}, because others on Zenoh do not see a node "
                "without these arguments)"
            )
    if enclave in running.robot.enclaves_outside_policy():
        return f"{node or f'any node in {enclave}'} ({running.robot.revoking_advice})"
    if not node or is_expression(node):
        return f"any node in {enclave}"
    label = next((process.label for process, of in running.secured if of.name == enclave), "")
    asking = f"{label} runs: run the proof again, or restart the process; " if label else ""
    gone = f"if the node is gone for good, remove its profile from '{running.robot.policy}'"
    return f"{node} ({asking}{gone})"


def _endpoint_texts(endpoints: Iterable[tuple[str, Endpoint]]) -> list[str]:
    """Return endpoints as text: each node and right, with the first names."""
    names: dict[str, list[str]] = {}
    for node, right, name in sorted({(node, *ros_use(endpoint)) for node, endpoint in endpoints}):
        names.setdefault(f"{node} {right}", []).append(name)
    return [f"{uses} {first_few(names[uses], MOST_NAMES, noun='name')}" for uses in names]


def _abandoned_names(
    before: Observation,
    expected: Observation,
    moved: Collection[MovedEndpoint],
    denied: Iterable[DeniedRight],
) -> list[str]:
    """Return clauses on names that nodes still use, though all peers ``moved`` to another name.

    The clauses are on the nodes ``before``.  The nodes ``expected`` now show whether a peer still
    uses the old name.  ``denied`` endpoints are left out.
    """
    refused = _denied_endpoints(denied)
    kept = {endpoint for _, endpoint in {*endpoints_of(robot_nodes(expected.nodes))} - refused}
    uses = {*endpoints_of(robot_nodes(before.nodes))} - refused
    new_names = {
        _opposite(pair.old): ros_use(pair.new)[1] for pair in moved if pair.old not in kept
    }
    abandoned = {
        (node, *ros_use(endpoint), new_names[endpoint])
        for node, endpoint in uses
        if endpoint in new_names
    }
    return [
        f"{node} {right} {name}, which is {new} now" for node, right, name, new in sorted(abandoned)
    ]


def _endpoints_without_peer(
    before: Observation,
    now: Observation,
    moved: Iterable[MovedEndpoint],
    denied: Iterable[DeniedRight],
) -> list[str]:
    """Return moved endpoints, as text, that no other node talks to under their new name.

    Only endpoints count that another node in ``before`` talked to; ``denied`` endpoints are left
    out.
    """
    refused = _denied_endpoints(denied)
    talked, talks = ({*endpoints_of(robot_nodes(seen.nodes))} for seen in (before, now))
    lonely = {
        (pair.new_node, *ros_use(pair.new))
        for pair in moved
        if (pair.new_node, pair.new) not in refused
        and any(
            node != pair.old_node and endpoint == _opposite(pair.old) for node, endpoint in talked
        )
        and not any(
            node != pair.new_node and endpoint == _opposite(pair.new)
            for node, endpoint in talks - refused
        )
    }
    return [f"{node} {right} {name}" for node, right, name in sorted(lonely)]


def _endpoints(right: Right) -> Iterator[Endpoint]:
    """Yield the endpoints that a node may have with a right."""
    for direction, topics in zip((PUBLISH, SUBSCRIBE), right.topics, strict=True):
        for topic in topics:
            yield Endpoint(topic, direction)


def _opposite(endpoint: Endpoint) -> Endpoint:
    """Return the counterpart of an endpoint: the subscriber of a publisher, or the reverse."""
    direction = SUBSCRIBE if endpoint.direction == PUBLISH else PUBLISH
    return endpoint._replace(direction=direction)


def _denied_endpoints(denied: Iterable[DeniedRight]) -> set[tuple[str, Endpoint]]:
    """Return the denied endpoints, with the names of their nodes."""
    return {
        (node, endpoint) for right in denied for node in right.nodes for endpoint in right.endpoints
    }
