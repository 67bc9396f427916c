"""Prove that the nodes of a closed robot still talk as they did when it was open."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from typing import Any

from sros_tool.close.endpoints import left_alone, lost_endpoints, node_name, ros_use
from sros_tool.close.nodes import ObservedNodes
from sros_tool.close.robot import MOST_NAMES, OBSERVER
from sros_tool.close.running import RunningRobot
from sros_tool.close.state import TALK, Proof
from sros_tool.errors import UnavailableError
from sros_tool.explain.audit import DeniedRight
from sros_tool.graph.learn import is_tool
from sros_tool.graph.observation import Observation, observation_from_json
from sros_tool.names import expand, is_expression
from sros_tool.runtime.environment import ROS_ARGS, named_enclave
from sros_tool.wording import counted, enumerated, first_few

_TRIES = 3


def proof_of_talk(running: RunningRobot, nodes: ObservedNodes, away: Collection[str]) -> Proof:
    """Compare what an observer in an enclave sees now with what was seen before.

    Processes of the enclaves ``away`` do not run; ``running`` are the processes of the other
    enclaves at the beginning of the proof.
    """
    words = ["audit", str(running.robot.rights_source), "--keystore", str(running.robot.export)]
    words += ["--enclave", OBSERVER, "--domain", str(running.robot.domain), "--json"]
    words += ["--partial"] * bool(away)
    for _ in range(_TRIES):  # nodes may still be starting
        try:
            status, audited = running.robot.shell.read_json(words)
        except UnavailableError as error:
            return Proof(TALK, None, f"{error}{_renamed_text(nodes, None, fails=False)}")
        now = observation_from_json(audited)
        denied = nodes.denied_rights(nodes.expected(now))
        differences = {
            **_differences_of_audit(running, audited, away),
            "gone": lost_endpoints(nodes.compared(away, now), now, denied),
            "left alone": left_alone(
                nodes.compared(away, now), nodes.expected(now), nodes.moved_endpoints(now), denied
            ),
            "not judged": audited["unjudged"],
            "not done": ["the ROS graph kept changing"] if status else [],
        }
        reason = next(
            (f"{why}: {first_few(names, 3)}" for why, names in differences.items() if names), ""
        )
        if not reason:
            summary = _comparison_text(nodes, now, away, denied)
            return Proof(TALK, True, f"{summary}{_renamed_text(nodes, now, fails=False)}")
    return Proof(TALK, False, f"{reason}{_renamed_text(nodes, now, fails=True)}")


def _differences_of_audit(
    running: RunningRobot, audited: Mapping[str, Any], away: Collection[str]
) -> Mapping[str, Sequence[str]]:
    """Return what the observer's audit finds: denied rights, refused enclaves, unseen nodes."""
    ended = _ended_since(running)
    unseen = [node for node in audited["unseen"] if node["enclave"] not in away]
    return {
        "denied": [
            f"{right['enclave']} {right['right']} {right['name']}: {right['reason']}"
            for right in audited["denied"]
        ],
        "refused": [refused["enclave"] for refused in audited["refused"]],
        "ended while the proof ran": [
            f"{node['node'] or node['enclave']} ({ended[node['enclave']]}; start it again, "
            f"or, if it does not always run, add --without {node['enclave']})"
            for node in unseen
            if node["enclave"] in ended
        ],
        "not seen": [unseen_text(running, node["node"], node["enclave"]) for node in unseen],
    }


def _comparison_text(
    nodes: ObservedNodes, now: Observation, away: Collection[str], denied: Sequence[DeniedRight]
) -> str:
    """Return what was compared, what the policy denies now, and which nodes are new, as text."""
    before = nodes.compared(away)
    number = counted(len(before.nodes), "node")
    text = f"{number} with {before.endpoint_count} endpoints as before"
    text += f", without {', '.join(sorted(away))}" if away else ""
    if denied:
        text += f", but for {counted(len(denied), 'right')} that the policy denies now: "
        text += ", ".join(f"{right.right.enclave} {right.right.describe()}" for right in denied)
    known = {*map(node_name, before.nodes)}
    _, without_profile = nodes.divide_by_profile(now.nodes)
    new = sorted(
        f"{node_name(node)} in {' or '.join(node.enclaves) or 'no enclave'}"
        for node in without_profile
        if node_name(node) not in known and not is_tool(node)
    )
    return text + (f"; new, without a profile: {first_few(new, MOST_NAMES)}" if new else "")


def _renamed_text(nodes: ObservedNodes, now: Observation | None, *, fails: bool) -> str:
    """Return which nodes were compared under new names, and which ones not at all, as text."""
    renamed, text = nodes.renamed, ""
    if renamed:
        names = [f"{old} as {expand('~', *renamed[old])}" for old in sorted(renamed)]
        text = f"; compared under a new name: {first_few(names, MOST_NAMES)}"
        pairs = nodes.moved_endpoints(now)
        topics = sorted({(ros_use(old)[1], ros_use(new)[1]) for old, new in pairs})
        private = tuple(f"{name}/" for name in renamed)
        if moved := [f"{old} as {new}" for old, new in topics if not old.startswith(private)]:
            text += f", with {enumerated(moved)} (a name that does not move: write it absolute)"
        if fails:
            text += " (if it is another node, remove what it does not use from its profile)"
    _, without_profile = nodes.divide_by_profile(nodes.as_observed)
    not_compared = {
        node_name(node) for node in without_profile if not is_tool(node)
    } - renamed.keys()
    if not_compared and not fails:
        close = nodes.robot.close_command
        text += (
            "; not compared, as the policy has no profile for them any more: "
            f"{first_few(sorted(not_compared), MOST_NAMES)} (if they have new names, they are "
            f"compared once the open robot was watched again: {close} --undo, {close} --for 1m)"
        )
    return text


def _ended_since(running: RunningRobot) -> dict[str, str]:
    """Map enclaves to their processes that were ``running`` and have ended."""
    pids = {process.pid for process in RunningRobot(running.robot).processes.processes}
    return {
        enclave.name: process.label
        for process, enclave in running.secured
        if process.pid not in pids
    }


def unseen_text(running: RunningRobot, node: str, enclave: str) -> str:
    """Return a node that an enclave has a profile for, and what to do if it does not exist."""
    for process, running_in in running.secured:
        if (
            running_in.name == enclave
            and process.is_zenoh
            and named_enclave(process.command) != enclave
        ):
            return (
                f"{node or f'any node in {enclave}'} (start {process.label} with `{ROS_ARGS} "
                f"--enclave {enclave}` at its end: on Zenoh, others do not see it otherwise)"
            )
    if not node or is_expression(node):
        return f"any node in {enclave}"
    return f"{node} (if it is gone for good, remove its profile from '{running.robot.policy}')"
