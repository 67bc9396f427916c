"""Prepare everything that a robot needs to run closed, without closing it."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

from sros_tool.checks.requirements import VIOLATED
from sros_tool.close.export import remove_enclaves
from sros_tool.close.nodes import ObservedNodes
from sros_tool.close.problems import problems_of, shared_node_problems, shared_program_problems
from sros_tool.close.processes import ObservedProcesses
from sros_tool.close.robot import LocalRobot
from sros_tool.close.start_files import write_start_files
from sros_tool.close.state import CloseState, CloseStep, current_state
from sros_tool.close.steps import CommandStep, steps
from sros_tool.close.watch import watch
from sros_tool.errors import SrosError, UsageError
from sros_tool.files import replace_file
from sros_tool.runtime.rmw import RMW, built_without_security, rmw_implementations


def prepare(robot: LocalRobot, duration: str | None, *, partial: bool, dry_run: bool) -> CloseState:
    """Do the steps whose results are not there yet, and write how each process is started.

    Raises:
        SrosError: the robot cannot be watched, or the keystore was brought to another machine.
    """
    if robot.export.exists() and not robot.keystore.exists():
        raise UsageError(
            f"the keystore '{robot.keystore}' is not there, and '{robot.export}' was exported "
            "from it",
            "A new keystore would have other CAs.",
            "Bring the keystore back to change the robot; --proof and --undo need only the export.",
        )
    results = (robot.observation_file, robot.policy, robot.keystore, robot.export)
    if robot.folder.is_dir() and [*robot.folder.iterdir()] and not any(map(Path.exists, results)):
        robot.shell.say(f"'{robot.folder}' has files of yours: sros adds its own to them")
    if robot.observed and robot.named_elsewhere:
        robot.check_elsewhere()
        robot.observed = robot.observed.belonging_elsewhere(robot.named_elsewhere)
        if not dry_run:
            robot.remember(robot.observed)
    denied_before: Sequence[str] = ()
    if robot.export.exists() and robot.observation_file.exists():
        with suppress(SrosError):  # the steps say what is wrong
            denied_before = _denied_access(robot)
    steps, problems, is_stopped = _do_steps(robot, duration, partial=partial, dry_run=dry_run)
    changes = [] if dry_run or is_stopped else remove_enclaves(robot)
    state = current_state(robot, robot.read_policy())._replace(steps=steps, dry_run=dry_run)
    if dry_run or is_stopped:
        return state._replace(problems=problems)
    if robot.observed:
        known = {process.enclave for process in robot.observed.processes}
        later = [process for process in state.observed.processes if process.enclave not in known]
        if later:
            processes = [*robot.observed.processes, *later]
            robot.remember(robot.observed._replace(processes=processes))
    changes = [*write_start_files(robot, state), *changes]
    denied = _denied_access(robot)
    newly_denied = [right for right in denied if right not in denied_before]
    problems += problems_of(robot, state, partial=partial)
    if not state.secured:
        _warn_of_rmw(robot, state.observed)
    return state._replace(
        denied=denied, newly_denied=newly_denied, problems=problems, changes=changes
    )


def _denied_access(robot: LocalRobot) -> list[str]:
    """Return, as sentences, what the keystore denies to the observed nodes."""
    nodes = ObservedNodes(robot)
    return [str(right) for right in nodes.denied_rights(nodes.expected())]


def _do_steps(
    robot: LocalRobot, duration: str | None, *, partial: bool, dry_run: bool
) -> tuple[list[CloseStep], list[str], bool]:
    """Do the steps; return their states, the problems, and whether a problem stopped the rest."""
    done: list[CloseStep] = []
    problems: list[str] = []
    is_stopped = False
    for step in steps(robot, duration):
        state = "kept" if step.made and step.made.exists() else "open"
        if dry_run:
            robot.shell.say(f"{'kept' if state == 'kept' else 'would run'}: {step.command}")
            if step.signs and robot.keystore.exists():
                _, output, messages = robot.shell.run((*step.words, "--dry-run"), False)
                robot.shell.say_lines(messages if output else "")
        elif state == "open" and not is_stopped:
            state, step_problems = _do(robot, step)
            problems += step_problems
            is_stopped = step.guards and state == "findings"
        done.append(CloseStep(step.command, state))
        if step.into == robot.observation_file and not dry_run:
            shared = [*shared_program_problems(robot)]
            shared += [] if partial else shared_node_problems(robot)
            problems, is_stopped = [*problems, *shared], bool(shared)
    return done, problems, is_stopped


def _do(robot: LocalRobot, step: CommandStep) -> tuple[str, list[str]]:
    """Do a step; return its state, and why the robot is not closed yet.

    Raises:
        SrosError: the robot cannot be watched.
    """
    if step.into == robot.observation_file:
        return "done", watch(robot, step)
    robot.shell.say(f"+ {step.command}")
    status, output, messages = robot.shell.run(step.words, bool(step.into))
    if status or (step.guards and output):
        robot.shell.say_lines("" if step.into else f"{output}{messages}")
    elif step.signs and output:
        robot.shell.say_lines(messages)
    if status:
        remedy = "; nothing was signed" if step.guards else ""
        if VIOLATED.id in output:
            needed = shlex.quote(str(robot.requirements))
            remedy += f"; if you want the change, edit {needed}, or remove it for new ones"
        return "findings", [f"findings of `{step.command}`{remedy}"]
    if step.into:
        replace_file(step.into, output.encode())
    return "done", []


def _warn_of_rmw(robot: LocalRobot, observed: ObservedProcesses) -> None:
    """Warn if an RMW that the processes use was built without security."""
    environment = robot.shell.environment
    default = environment.get(RMW) or next(iter(rmw_implementations(environment)), "")
    for rmw in sorted({process.rmw or default for process in observed.processes}):
        if built_without_security(rmw, environment):
            robot.shell.say(
                f"WARNING: {rmw} is built without security here: no node starts in an enclave "
                "with it. Before you stop the robot, find an RMW that enforces security: "
                "sros doctor"
            )
