"""Prove that a robot is closed."""

from __future__ import annotations

import json
import time
from collections.abc import Iterator

from sros_tool.checks.keystores.issued import STALE
from sros_tool.close.nodes import ObservedNodes
from sros_tool.close.process_proof import CLAIM, proof_of_processes, why_missing
from sros_tool.close.robot import MOST_NAMES, LocalRobot
from sros_tool.close.running import RunningRobot
from sros_tool.close.state import SILENCE, CloseState, Proof, current_state
from sros_tool.close.talk_proof import proof_of_talk
from sros_tool.errors import UnavailableError
from sros_tool.graph.observation import Observation
from sros_tool.keystore.layout import list_enclaves
from sros_tool.runtime.processes import ProcessTable
from sros_tool.wording import counted, first_few

_START_SECONDS = 3.0
"""How long processes that were restarted by hand may take until they run in their enclaves."""


def prove(robot: LocalRobot) -> CloseState:
    """Prove that the robot is closed."""
    robot.shell.check_open()
    state = current_state(robot, robot.read_policy())
    proofs = proofs_of(robot, state, _START_SECONDS)
    fails = any(proof.fails for proof in proofs)
    if not fails and robot.policy.exists() and (changed := _enclaves_changed(robot)):
        where = "" if robot.keystore.exists() else ", where the keystore is,"
        robot.shell.say(
            f"'{robot.policy}' differs from the signed permissions of "
            f"{first_few(changed, MOST_NAMES)}: `{robot.close_command}`"
            f"{where} checks and signs it"
        )
    return state._replace(proofs=proofs)


def _enclaves_changed(robot: LocalRobot) -> list[str]:
    """Return the enclaves whose signed rights differ from the policy."""
    only = ("--include", STALE.id, "--json")
    words = ("check", str(robot.export), "--policy", str(robot.policy), *only)
    _, output, _ = robot.shell.run(words, False)
    stale = [finding["subject"] for finding in json.loads(output)["findings"]]
    unsigned = robot.policy_enclaves() - robot.not_here - {*list_enclaves(robot.export)}
    return sorted({*stale} | unsigned)


def proofs_of(robot: LocalRobot, state: CloseState, patience: float) -> list[Proof]:
    """Wait until each process runs in its enclave, and prove that the robot is closed."""
    expected = {process.enclave for process in state.observed.processes} | {*state.new}
    if not expected:
        return [Proof(CLAIM, False, "no process of the robot is known")]
    running = _wait_for(robot, expected, patience)
    missing = sorted(expected - running.current_enclaves)
    running_now = {enclave.name for _, enclave in running.secured}
    needed = {*missing}.difference(robot.without) | running_now.intersection(missing)
    if needed or expected == {*missing}:
        observed = state.observed.with_current_pids(running.processes)
        return [Proof(CLAIM, False, why_missing(running, sorted(needed) or missing, observed))]
    nodes, not_here = ObservedNodes(robot), robot.not_here
    # A laptop may be away; a computer whose nodes were seen has to be seen again.
    may_be_away = not_here - {node.enclaves[0] for node in nodes.compared(()).nodes}
    away = {*missing} | may_be_away | not_here.intersection(robot.without)
    proof = proof_of_processes(running, len(expected) - len(missing))
    absence = "not seen" if running.processes.unseen or running.processes.hidden else "not running"
    for label, names in ((absence, missing), ("of other machines", sorted(not_here))):
        if names:
            proof = proof._replace(reason=f"{proof.reason}; {label}: {', '.join(names)}")
    talk = proof_of_talk(running, nodes, away)
    if talk.fails and (present := sorted(not_here - away)):
        options = " ".join(f"--without {name}" for name in present)
        talk = talk._replace(reason=f"{talk.reason}; if they may be away, add {options}")
    silence = _proof_of_silence(robot, nodes.compared(away), hears=talk.holds is not None)
    return [proof, _proof_of_files(robot), *_proof_of_requirements(robot), talk, silence]


def _wait_for(robot: LocalRobot, enclaves: set[str], patience: float) -> RunningRobot:
    """Return the processes when some run in all ``enclaves``, or after ``patience`` seconds."""
    table, end = ProcessTable(), time.monotonic() + patience
    while True:
        is_over = time.monotonic() > end
        running = RunningRobot(robot, table.look(robot.shell.now()))
        if is_over or running.current_enclaves >= enclaves:
            return running
        time.sleep(0.2)


def _proof_of_files(robot: LocalRobot) -> Proof:
    """Ask `check` about the files that the processes use, such as a key that others read."""
    status = robot.shell.check(str(robot.export))
    reasons = {0: "sros check finds none", 1: "sros check finds one", 2: "they are not checked"}
    holds = {0: True, 1: False}.get(status)
    return Proof("the files have no error", holds, f"{reasons[status]}: {robot.export}")


def _proof_of_requirements(robot: LocalRobot) -> Iterator[Proof]:
    """Decide the requirements for the enclaves that the processes use.

    With processes on other machines, also for the enclaves of the keystore, or of the policy.
    """
    if not robot.requirements.exists():
        return
    needed = ("--requirements", str(robot.requirements), "--include", "requirement.*")
    places = [robot.export, *[robot.rights_source] * bool(robot.not_here)]
    statuses = [robot.shell.check(str(place), *needed) for place in places]
    status = 1 if 1 in statuses else max(statuses)
    reasons = {0: "all of them", 1: "one is violated", 2: "sros could not check them"}
    holds = {0: True, 1: False}.get(status)
    yield Proof("the requirements hold", holds, f"{reasons[status]}: {robot.requirements}")


def _proof_of_silence(robot: LocalRobot, before: Observation, *, hears: bool) -> Proof:
    """Look for nodes as an open listener; before, the same listener saw all nodes.

    Seeing none means something only if the observer ``hears`` the robot in its enclave now.
    """
    words = ("generate_policy", str(robot.folder / "open.xml"), "--domain", str(robot.domain))
    try:
        _, value = robot.shell.read_json((*words, "--dry-run", "--json"))
    except UnavailableError as error:
        return Proof(SILENCE, None, f"{error}")
    if value["nodes"]:
        nodes = {f"{node['namespace'].rstrip('/')}/{node['name']}" for node in value["nodes"]}
        return Proof(SILENCE, False, f"it sees {first_few(sorted(nodes), 3)}")
    if not hears:
        return Proof(SILENCE, None, "nor does the observer in its enclave see the robot now")
    number = counted(len(before.nodes), "node")
    return Proof(SILENCE, True, f"the observer that saw {number} before sees none")
