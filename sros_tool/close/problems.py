"""What keeps a robot from running closed, with what to do."""

from __future__ import annotations

import os
import shlex
import stat
from collections.abc import Iterator

from sros_tool.close.export import enclaves_without_origin
from sros_tool.close.processes import ROUTER, ClosedProcess, ObservedProcesses, run_words
from sros_tool.close.robot import MOST_NAMES, OBSERVER, LocalRobot
from sros_tool.close.state import CloseState
from sros_tool.keystore.layout import enclave_path, list_enclaves
from sros_tool.policy.document import read_policy
from sros_tool.runtime.environment import node_argument
from sros_tool.runtime.processes import launch_verb
from sros_tool.runtime.variables import ENCLAVE
from sros_tool.wording import counted, enumerated, first_few


def problems_of(robot: LocalRobot, state: CloseState, *, partial: bool) -> Iterator[str]:
    """Yield what keeps the robot from running closed, with what to do."""
    yield from _keystore_problems(robot)
    for name in sorted(robot.not_here & state.secured.keys()):
        yield f"{name} belongs to another machine, and a process runs in it here: stop it"
    for name in enclaves_without_origin(robot):
        remove = f"rm -r {shlex.quote(str(enclave_path(robot.export, name)))}"
        yield f"the export has {name}, which the keystore neither has nor revoked: {remove}"
    yield from _user_problems(robot, state.observed)
    yield from _launch_problems(robot, state.observed)
    if not partial:
        yield from _unknown_process_problems(robot, state)


def _keystore_problems(robot: LocalRobot) -> Iterator[str]:
    """Yield the enclaves of the keystore that the policy does not have."""
    known = {OBSERVER, ROUTER, *robot.not_here, *robot.policy_enclaves()}
    for name in list_enclaves(robot.keystore):
        if name not in known:
            revoke = f"sros revoke {shlex.quote(str(robot.keystore))} {name}"
            yield (
                f"the policy does not have {name}, and the keystore does: if nothing needs it "
                f"any more, {revoke}; if it belongs to another machine, such as a laptop, "
                f"{robot.close_command} --elsewhere {name}; if it belongs to this machine, sros "
                f"merge_policy {shlex.quote(str(robot.policy))} ITS_POLICY --in-place"
            )


def _user_problems(robot: LocalRobot, observed: ObservedProcesses) -> Iterator[str]:
    """Yield the users of processes who cannot read their enclaves."""
    owner, export = robot.export.stat().st_uid, robot.export.absolute()
    for user in sorted({process.user for process in observed.processes}):
        closed = [path for path in export.parents if not _may_enter(user, path.stat())]
        if closed and user:
            yield f"user {user}, who runs processes, cannot enter '{closed[-1]}'"
        if user != owner:
            yield (
                f"processes run as user {user}, and only user {owner} can read the enclaves: "
                f"chown -R {user} {shlex.quote(str(robot.export))}"
            )


def _launch_problems(robot: LocalRobot, observed: ObservedProcesses) -> Iterator[str]:
    """Yield the processes that `ros2 launch` would not start in their enclaves."""
    for process in observed.processes:
        command = process.command
        if process.launch and not (node_argument(command) or launch_verb(command)):
            words = run_words(robot.export.absolute(), process.enclave, process.rmw)
            prefix = f"prefix='{' '.join(words)}'"
            yield (
                f"the process of {process.enclave} has no name= in its launch file, and would "
                f"not start: give it one, or {prefix}"
            )


def _unknown_process_problems(robot: LocalRobot, state: CloseState) -> Iterator[str]:
    """Yield the processes without known nodes, and the nodes without a known process."""
    observed, close = state.observed, robot.close_command
    silent = "they would not be heard any more (accept: --partial)"
    if observed.unknown:
        named = first_few(observed.unknown, MOST_NAMES)
        opened = f"go back by {close} --undo, and " if state.secured else ""
        yield (
            f"sros saw no node of {counted(len(observed.unknown), 'process', 'processes')}: "
            f"{named}; {opened}watch again while they run: {close} --for 1m; "
            f"otherwise {silent}"
        )
    here = {process.enclave: process.pid for process in observed.processes}
    if twice := sorted(here.keys() & {*observed.elsewhere}):
        yield (
            f"nodes of {twice[0]} are in process {here[twice[0]]} and in another one that "
            "sros does not see: if another robot is in this ROS domain, switch it off, or "
            "give it a domain of its own, remove the rights that it added to "
            f"'{robot.policy}', and watch again: {close} --for 1m"
        )
    if only_there := [name for name in observed.elsewhere if name not in twice]:
        named = first_few(only_there, MOST_NAMES)
        options = " ".join(f"--elsewhere {name}" for name in only_there)
        yield (
            f"sros knows no process of this machine for nodes of {named}; if they run on "
            f"another machine: {close} {options}; otherwise {silent}"
        )


def shared_program_problems(robot: LocalRobot) -> Iterator[str]:
    """Yield a text for each program whose processes would all run in one enclave."""
    observed = robot.processes.within(read_policy(robot.policy))
    by_program: dict[tuple[str, ...], list[ClosedProcess]] = {}
    for process in observed.processes:
        names = sorted({process.enclave, *process.shares})
        by_program.setdefault(tuple(names), []).append(process)
    for enclaves, processes in by_program.items():
        if len(enclaves) > 1 and sum(not process.chooses for process in processes) > 1:
            yield (
                f"{shlex.join(processes[0].command)} starts the processes of "
                f"{enumerated(enclaves)}, and all of them would run in one enclave; nothing "
                f"was signed; in '{robot.policy}', move their profiles into one of these "
                "enclaves, which then has the rights of all, and remove the other "
                "enclaves; or let the program start each process with the method spawn after "
                f"setting {ENCLAVE} in os.environ, and watch again: "
                f"{robot.close_command} --for 1m"
            )


def shared_node_problems(robot: LocalRobot) -> Iterator[str]:
    """Yield a text for processes with nodes of the same name, which would share an enclave."""
    by_enclave: dict[str, list[ClosedProcess]] = {}
    for process in robot.processes.processes:
        by_enclave.setdefault(process.enclave, []).append(process)
    for enclave, twins in by_enclave.items():
        if len({twin.pid for twin in twins}) > 1:
            commands = [f"process {twin.pid} ({shlex.join(twin.command)})" for twin in twins]
            yield (
                f"{enumerated(commands)} call themselves {enclave}, and the enclave of this "
                "name would have the rights of all; nothing was signed; if one is not of the "
                f"robot, stop it, remove '{robot.policy}', and watch again: {robot.close_command} "
                "--for 1m; if all are, accept it: --partial"
            )


def _may_enter(user: int, folder: os.stat_result) -> bool:
    return bool(folder.st_mode & (stat.S_IXUSR if folder.st_uid == user else 0o011))
