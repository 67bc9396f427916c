"""Apply the security of a robot to its systemd units, and undo it."""

from __future__ import annotations

import os
import shlex
import subprocess
import time
from collections import Counter
from collections.abc import Collection, Iterable, Iterator, Sequence, Set
from datetime import timedelta
from itertools import chain
from pathlib import Path

from sros_tool.checks.processes import ROOT_IS_NOT_ENOUGH
from sros_tool.close.nodes import ObservedNodes
from sros_tool.close.processes import (
    DROP_IN,
    SYSTEMD_FOLDER,
    ClosedProcess,
    ObservedProcesses,
    process_text,
)
from sros_tool.close.proof import proofs_of
from sros_tool.close.robot import LocalRobot
from sros_tool.close.start_files import check_may_restart, drop_in_heading
from sros_tool.close.state import (
    CloseState,
    Proof,
    RunningRobot,
    current_state,
    keystore_text,
    secured_process,
    wait_until,
)
from sros_tool.errors import SrosError, UnavailableError
from sros_tool.files import remove_file
from sros_tool.folders import remove_folders
from sros_tool.names import expand
from sros_tool.policy.model import Policy
from sros_tool.runtime.environment import node_argument
from sros_tool.runtime.logind import users_without_linger
from sros_tool.runtime.processes import Process, process_origin, program_of, user_text
from sros_tool.runtime.unit_properties import unit_properties
from sros_tool.runtime.units import TEMPLATE, unit_changes, write_units
from sros_tool.values import FileChange
from sros_tool.wording import enumerated
from sros_tool.xml import read_bytes

_RESTART_SECONDS = 30.0
"""How long processes that sros restarted may take until they run in their enclaves, or open."""

_SECONDS_BETWEEN = 1.0
"""Seconds between units that are closed: processes of Fast DDS that start together may miss each
other."""

_STABLE_FOR = timedelta(seconds=2)
"""How long a process that sros restarted open has to run: many end while they start."""


def apply(robot: LocalRobot, prepared: CloseState, *, dry_run: bool) -> CloseState:
    """Restart the units that do not run closed, and add drop-ins; return the new state.

    If there are problems, open units stay open.  Proves that the robot is closed, if nothing is
    left to do by hand or to close.
    """
    robot.shell.check_open()
    observed, secured = prepared.observed, prepared.secured
    if prepared.problems:
        observed = observed._replace(processes=[*filter(prepared.runs_closed, observed.processes)])
    is_left = len(observed.processes) < len(prepared.observed.processes)
    changes = _write_drop_ins(robot, observed, dry_run=dry_run)
    if not dry_run:
        _remember_new_units(robot, observed)
    unsecured = [process for process in observed.processes if not secured.get(process.enclave)]
    open_units = observed._replace(processes=unsecured).units
    idle = {process.unit for process in observed.processes if process.is_idle}
    states = _states_of_stopped_units(sorted(open_units - idle))
    stopped = {unit for unit in states if states[unit] == "inactive" or _is_disabled(unit)}
    _say_not_started(robot, sorted(stopped), "--apply", "closed")
    # A Zenoh router comes first: nodes wait for it.
    routers = {process.unit for process in observed.processes if process.is_router}
    last = {process.unit for process in observed.processes if prepared.may_restart_last(process)}
    restarts = [
        ["try-restart" if unit in idle else "restart", unit]
        for unit in sorted(
            open_units - stopped, key=lambda unit: (unit not in routers, unit in last, unit)
        )
    ]
    _restart_units(robot, restarts, changed=bool(changes), dry_run=dry_run)
    state = prepared._replace(changes=[*prepared.changes, *changes])
    if dry_run:
        return state
    by_hand, proofs = prepared.pending_by_hand, list[Proof]()
    if by_hand or is_left:
        restarted = open_units - stopped - idle
        expected = {known.enclave for known in observed.processes if known.unit in restarted}
        _say_open_processes(robot, by_hand.values(), expected)
    else:
        proofs = proofs_of(robot, prepared, _RESTART_SECONDS)
    running = current_state(robot, robot.read_policy())
    return state._replace(
        proofs=proofs,
        observed=running.observed,
        secured=running.secured,
        outdated=running.outdated,
        outdated_pids=running.outdated_pids,
        new=running.new,
        absent=running.absent,
    )


def _say_open_processes(
    robot: LocalRobot, by_hand: Iterable[Sequence[ClosedProcess]], expected: Set[str]
) -> None:
    """Show the open processes that no command starts again closed.

    First waits until processes run in the ``expected`` enclaves: their units were restarted.
    """
    running = wait_until(robot, lambda seen: seen.current_enclaves >= expected, _RESTART_SECONDS)
    named = {pid for known in chain(*by_hand) for pid in (known.pid, *known.alike)}
    others = {
        process.label: None
        for process in running.open_processes
        if not process.is_daemon and process.program[0] not in named
    }
    if others:
        robot.shell.say(f"also open: {enumerated([*others])}; stop these processes, too")


def _write_drop_ins(
    robot: LocalRobot, observed: ObservedProcesses, *, dry_run: bool
) -> list[FileChange]:
    """Write the drop-ins of the units, print their paths, and return the changes.

    Raises:
        SrosError: a unit has the drop-in of another folder, or a file cannot be used.
    """
    paths = [f"{unit}.d/{DROP_IN}" for unit in sorted(observed.units_with_drop_in)]
    files = {path: read_bytes(robot.start / "units" / path, "unit").decode() for path in paths}
    _drop_ins_of(robot, observed)
    if names := users_without_linger(
        process.user for process in observed.processes if not process.container
    ):
        linger = enumerated([f"`loginctl enable-linger {name}`" for name in names])
        one_of_them = names[0] if len(names) == 1 else f"one of the users {enumerated(names)}"
        robot.shell.say(
            f"WARNING: when {one_of_them} logs in and out again, systemd removes the shared "
            "memory of this user, and the nodes of this user hear nothing any more (RemoveIPC in "
            f"logind.conf(5)). First run {linger}, or run the nodes as a system user"
        )
    changes = unit_changes(SYSTEMD_FOLDER, files, force=True)
    for path, action in changes.items():
        robot.shell.say(f"{'would ' if dry_run else ''}{action} {SYSTEMD_FOLDER / path}")
    if not dry_run:
        write_units(SYSTEMD_FOLDER, files, changes)
    return [FileChange(action, str(SYSTEMD_FOLDER / path)) for path, action in changes.items()]


def _remember_new_units(robot: LocalRobot, observed: ObservedProcesses) -> None:
    """Write units that started processes only after the watch, and how, into the folder.

    Without a drop-in, nothing else shows --undo that such a unit belongs to the robot.
    """
    of_units = {process.enclave: process for process in observed.processes if process.unit}
    before = robot.processes.processes
    count = Counter(process.enclave for process in before)
    processes = list[ClosedProcess]()
    for process in before:
        now = of_units.get(process.enclave, process)
        if count[process.enclave] == 1:
            process = process._replace(
                command=now.command, folder=now.folder, rmw=now.rmw, user=now.user
            )
        processes.append(process._replace(unit=now.unit, secured_by_unit=now.secured_by_unit))
    processes += [
        process for process in observed.processes if process.unit and process.enclave not in count
    ]
    if processes != [*before]:
        robot.write_processes(robot.processes._replace(processes=processes))


def undo(robot: LocalRobot, *, dry_run: bool) -> tuple[CloseState, str]:
    """Remove the drop-ins of this folder, and restart their units; return the new state, and
    sentences on processes that cannot be examined.

    Says what is left to do by hand.
    """
    running = RunningRobot(robot)
    observed = running.with_later_processes(robot.processes)
    drop_ins = _drop_ins_of(robot, observed)
    units = {path.parent.name.removesuffix(".d") for path in drop_ins}
    if not dry_run:
        check_may_restart(robot, units, "--undo")
    for path in drop_ins:
        if not dry_run:
            remove_file(path)
            remove_folders([path.parent])  # unless the unit has other drop-ins
        robot.shell.say(f"{'would remove' if dry_run else 'removed'} {path}")
    # A unit without a drop-in still runs closed if an earlier --undo was killed before the restart.
    units |= {
        process.unit
        for process in observed.processes
        if process.unit and not (process.secured_by_unit or running.is_open(process))
    }
    policy = _readable_policy(robot)
    expected = observed.limited_to(policy) if policy else observed
    not_running = _states_of_stopped_units(units)
    units -= not_running.keys()
    changed = bool(drop_ins or not_running)  # an earlier --undo may have been killed
    given_up = observed.units_with_drop_in - expected.units_with_drop_in
    replaced = {
        process.unit
        for process in observed.processes
        for other in running.in_domain
        if process.fits(other) and process.user == other.user
    }
    left = sorted(not_running.keys() - given_up - replaced)
    not_running = {unit: not_running[unit] for unit in left}
    inactive = [unit for unit in not_running if not_running[unit] == "inactive"]
    _say_not_started(robot, inactive, "--undo", "open")
    # Open processes of Fast DDS find each other also if they start together.
    restarts = [["restart", *sorted(units)]] if units else []
    _restart_units(robot, restarts, changed=changed, dry_run=dry_run)
    started = [process for process in observed.processes if process.unit in units and process.pid]
    if started and not dry_run:
        running = wait_until(
            robot, lambda seen: not [*_processes_not_open(seen, started)], _RESTART_SECONDS
        )
    changes = [FileChange("remove", str(path)) for path in drop_ins]
    state = current_state(robot, policy)._replace(dry_run=dry_run, changes=changes)
    remaining = _RemainingProcesses(RunningRobot(robot), expected)
    remaining.say_how_to_start()
    problems = [
        # It may have failed because it could not start secured, or because somebody stopped it.
        *(
            f"{unit} has failed: start it open with `systemctl start {shlex.quote(unit)}`, or let "
            f"it stay stopped: `systemctl reset-failed {shlex.quote(unit)}`"
            for unit, state in not_running.items()
            if state == "failed"
        ),
        *remaining.commands_to_open(),
        *(() if dry_run else remaining.secured_processes_of_units()),
        *(() if dry_run else _processes_not_open(running, started)),
        *remaining.further_secured_processes(),
        *remaining.unknown_processes(),
    ]
    runs = any(process.pid or process.alike for process in state.observed.processes)
    # Without the list of observed processes, "no process runs" would be a guess.
    if robot.observed and not (dry_run or problems or runs or state.observed.unknown):
        problems = ["no process of the robot runs, open or secured: start its processes open"]
    return state._replace(problems=problems), remaining.unexamined_text


def _processes_not_open(running: RunningRobot, started: Sequence[ClosedProcess]) -> Iterator[str]:
    """Yield a text for each process of a restarted unit that runs neither open nor secured."""
    secured = {enclave.name for _, enclave in running.secured_everywhere}
    since = running.robot.shell.now() - _STABLE_FOR
    for process in started:
        if process.enclave not in secured and not running.runs_open(process, since):
            yield (
                f"{process.enclave} does not run open, though {process.unit} was restarted: "
                f"systemctl status {shlex.quote(process.unit)}"
            )


def _readable_policy(robot: LocalRobot) -> Policy | None:
    """Return the policy; None, with its error shown, if it cannot be read."""
    try:
        return robot.read_policy()
    except SrosError as error:  # opening the robot must not fail because of a broken file
        robot.shell.say(f"{error}")
        return None


class _RemainingProcesses:
    """The processes that are left to open by hand after the units were restarted.

    ``observed`` are the processes that the robot has, and ``running`` the processes of the machine.
    """

    def __init__(self, running: RunningRobot, observed: ObservedProcesses) -> None:
        self._running, self._robot, self._observed = running, running.robot, observed
        by_user = sorted(
            running.secured_everywhere, key=lambda secured: running.may_use_files(secured.process)
        )
        programs = {(enclave.name, process.program[0]) for process, enclave in by_user}
        count = Counter(name for name, _ in programs)
        # The only program in an enclave counts as the observed process, even by another command.
        self._further = [
            (process, enclave.name)
            for process, enclave in running.further_processes(by_user, observed)
            if count[enclave.name] > 1
        ]
        further = {(name, process.program[0]) for process, name in self._further}
        # Sorted so that, of several processes in an enclave, the last one may use its files.
        self._secured = {
            enclave.name: process
            for process, enclave in by_user
            if (enclave.name, process.program[0]) not in further
        }
        processes = [
            process._replace(unit="") if process.secured_by_unit else process
            for process in observed.processes
        ]
        by_hand = observed._replace(processes=processes).commands_by_hand(self._robot.folder)
        self._started_by_hand = [*chain.from_iterable(by_hand.values())]
        units = {process.enclave: process.unit for process in observed.processes}
        candidates = {
            process.enclave: units[process.enclave]
            for process in self._started_by_hand
            if process.secured_by_unit
            and process.enclave not in self._secured
            and not running.runs_open(process)
        }
        stopped = _states_of_stopped_units(candidates.values())
        # systemd starts their processes again in a moment, in their enclaves.
        self._waiting = {name: unit for name, unit in candidates.items() if unit not in stopped}

    def commands_to_open(self) -> Iterator[str]:
        """Yield commands that restart secured processes open; none for units with a drop-in."""
        may_be_closed = {*self._secured, *self._waiting}
        closed = [process for process in self._started_by_hand if process.enclave in may_be_closed]
        counts = Counter(process.enclave for process in closed)
        started_by: dict[str, dict[str, None]] = {}
        for process in closed:
            name, secured = process.enclave, self._secured.get(process.enclave)
            unit = process_origin(secured.program[0]).unit_text if secured else self._waiting[name]
            is_alone = counts[process.enclave] == 1 and not process.launch
            is_alone = is_alone and not process.container
            if secured and is_alone and self._running.may_use_files(secured):
                process = secured_process(secured, process.enclave)
                name = f"process {secured.pid}"
            command = process.open_command(self._robot.domain)
            command = _with_unit_to_change(command, unit) if unit else command
            started_by.setdefault(command, {})[name] = None
        for command, names in started_by.items():
            yield f"restart {enumerated([*names])} open: {command}"

    def secured_processes_of_units(self) -> Iterator[str]:
        """Yield a text for each process that still runs secured after a restart of its unit."""
        for process in self._observed.processes:
            by_drop_in = process.unit and not process.secured_by_unit
            if by_drop_in and process.enclave in self._secured:
                yield (
                    f"{self._secured[process.enclave].label} still runs in {process.enclave}: stop "
                    f"it if {process.unit} did not start it; otherwise remove `sros run`, or the "
                    "variables of the enclave, from the unit"
                )

    def say_how_to_start(self) -> None:
        """Show how to start, without security, processes that ended or run by another command."""
        running, nodes = self._running, ObservedNodes(self._robot)
        known = running.with_later_processes(self._robot.processes)
        unknown = [
            process
            for process in running.open_processes
            if not any(other.fits(process) for other in known.processes)
        ]
        for process in self._started_by_hand:
            is_known = process.enclave in {*self._secured, *self._waiting}
            if is_known or running.runs_open(process):
                continue
            names, old_name = nodes.names_in(process.enclave)
            named = node_argument(process.command)
            has_old_name = old_name and (not named or expand("~", *named) == old_name)
            was = f" (its node was {old_name} when sros watched; it may also have its new name)"
            state, start = "does not run; ", "start it"
            if similar := [
                (len({*process.command}.intersection(other.program[1])), other.label)
                for other in unknown
                if _may_be_process(other, process, names)
            ]:
                _, label = max(similar)
                state = f"may run open by another command ({label}); if that is not so, "
                start = f"start {process.enclave}"
            command = process.open_command(self._robot.domain)
            self._robot.shell.say(
                f"{process.enclave} {state}{start} open{was * bool(has_old_name)}: {command}"
            )

    def further_secured_processes(self) -> Iterator[str]:
        """Yield a text for each process in an enclave that was not observed for this enclave."""
        known = self._observed.enclaves
        for enclave in sorted(self._secured.keys() - known):
            process = self._secured[enclave]
            remedy = f"restart process {process.pid} open: {process_text(process)}"
            remedy = self._end_of_guest(process) or remedy
            yield f"a process that sros did not observe runs in the enclave {enclave}; {remedy}"
        for process, enclave in self._further:
            command = secured_process(process, enclave).open_command(self._robot.domain)
            remedy = f"stop it, if it is not yours; otherwise restart it open: {command}"
            remedy = self._end_of_guest(process) or remedy
            yield f"{process.label} in {enclave} was not observed; {remedy}"

    def _end_of_guest(self, process: Process) -> str:
        """Return a clause that says to end a process of a user who cannot read the enclaves; ""
        for other processes.
        """
        if self._running.may_use_files(process):
            return ""
        user = user_text(process.user)
        return f"end {process.label}, which runs as {user}, not as the owner of the enclave's files"

    def unknown_processes(self) -> Iterator[str]:
        """Yield a text for each process that may run secured, but not from this folder."""
        running = self._running
        pids = {process.pid for process, _ in running.secured_everywhere}
        for process in running.in_domain:
            if (enclave := process.enclave) and process.pid not in pids and not process.is_daemon:
                why = f" ({enclave.problem})" if enclave.problem else ""
                yield (
                    f"{process.label} runs secured with the files of "
                    f"'{keystore_text(enclave)}'{why}, "
                    "not of this folder, and open processes do not hear it: stop it, or restart it "
                    "open"
                )
        for unseen in running.processes.unseen:
            if unseen.uses_ros:
                yield (
                    f"{unseen.label} uses ROS 2, and cannot be examined ({unseen.why}): if it "
                    "runs secured, stop it, or restart it open"
                )

    @property
    def unexamined_text(self) -> str:
        """Sentences on processes that sros cannot examine, and that may use ROS 2; "" if none."""
        running = self._running.processes
        if not (running.hidden or any(not unseen.uses_ros for unseen in running.unseen)):
            return ""
        if running.is_run_by_root:
            return f"Some processes cannot be examined. {ROOT_IS_NOT_ENOUGH}"
        return "Some processes cannot be examined: as root, this command examines them, too"


def _with_unit_to_change(command: str, unit: str) -> str:
    """Return the command that starts a process open, and what to do with its unit before.

    A unit of `sros units` has to be disabled, because it only starts its process closed.
    """
    if unit.startswith(TEMPLATE.removesuffix(".service")):
        disable = f"systemctl disable --now {shlex.quote(unit)}"
        return f"first `{disable}`, because this unit starts it closed; then {command}"
    return (
        f"{command} ({unit} starts it: instead, remove `sros run`, or the variables of the "
        "enclave, from the unit or its script, and restart the unit)"
    )


def _may_be_process(process: Process, observed: ClosedProcess, nodes: Collection[str]) -> bool:
    """Return whether a process may be the ``observed`` process, started by another command.

    ``nodes`` are the full names of the nodes of ``observed``.
    """
    if node := node_argument(process.program[1]):
        return expand("~", *node) in nodes
    return program_of(process.program[1]) == program_of(tuple(observed.command))


def _drop_ins_of(robot: LocalRobot, observed: ObservedProcesses) -> list[Path]:
    """Return the drop-ins for this folder; raise `SrosError` if another folder has one."""
    drop_ins = [
        path
        for path in sorted(SYSTEMD_FOLDER.glob(f"*.d/{DROP_IN}"))
        if read_bytes(path, "unit").startswith(drop_in_heading(robot).encode())
    ]
    for unit in sorted(observed.units_with_drop_in):
        path = SYSTEMD_FOLDER / f"{unit}.d/{DROP_IN}"
        if path not in drop_ins and os.path.lexists(path):
            raise SrosError(
                f"'{path}' is not the drop-in of this folder",
                "Its first line names another folder, or was edited. sros changed nothing.",
                "Name the folder exactly as the first line does, or remove the drop-in.",
            )
    return drop_ins


def _states_of_stopped_units(units: Iterable[str]) -> dict[str, str]:
    """Map the units that do not run to their states, "inactive" or "failed".

    Somebody may have stopped a unit for a reason. The state "failed" does not show that nobody did:
    many nodes fail when they are stopped.
    """
    stopped = dict[str, str]()
    for unit in units:
        state = unit_properties(unit, "ActiveState").get("ActiveState", "")
        if state in ("inactive", "failed"):
            stopped[unit] = state
    return stopped


def _is_disabled(unit: str) -> bool:
    """Return whether systemd does not start a unit at boot: somebody stopped it for good."""
    return unit_properties(unit, "UnitFileState").get("UnitFileState") in ("disabled", "masked")


def _say_not_started(robot: LocalRobot, units: Sequence[str], option: str, how: str) -> None:
    """Show that the option starts none of these units, which would start "open" or "closed"."""
    if units:
        start = shlex.join(["systemctl", "start", *units])
        robot.shell.say(
            f"{enumerated([*units])} did not run, and {option} starts no stopped unit; to start "
            f"{'it' if len(units) == 1 else 'them'} {how}: {start}"
        )


def _restart_units(
    robot: LocalRobot, restarts: Sequence[Sequence[str]], *, changed: bool, dry_run: bool
) -> None:
    """Run systemctl with each list of words in ``restarts``, after systemd has read its units.

    Waits a second between two of them. With ``changed``, systemd reads its units again even if no
    unit is restarted.

    Raises:
        SrosError: systemctl cannot be run, or fails.
    """
    for number, words in enumerate([["daemon-reload"], *restarts] if restarts or changed else []):
        command = ["systemctl", *words]
        robot.shell.say(f"{'would run:' if dry_run else '+'} {shlex.join(command)}")
        if number > 1 and not dry_run:
            time.sleep(_SECONDS_BETWEEN)
        try:
            status = 0 if dry_run else subprocess.run(command, check=False).returncode
        except OSError as error:
            raise UnavailableError(f"systemctl cannot be run: {error.strerror}") from error
        if status:
            raise SrosError(
                f"`{shlex.join(command)}` ended with {status}",
                "Secured and open processes do not hear each other.",
                "Correct the failure, and run the same `sros close` again, or go back with --undo.",
            )
