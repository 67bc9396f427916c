"""The files that start the processes of a robot with security."""

from __future__ import annotations

import os
import shlex
import shutil
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from pathlib import Path

from sros_tool.close.processes import (
    COMPOSE_FILE,
    DROP_IN,
    SYSTEMD_FOLDER,
    ClosedProcess,
    ObservedProcesses,
    launch_words,
)
from sros_tool.close.robot import LocalRobot
from sros_tool.close.state import CloseState, unit_advice
from sros_tool.errors import UnavailableError
from sros_tool.files import remove_file
from sros_tool.runtime.environment import (
    COMPOSE,
    ROS_ARGS,
    Container,
    object_name,
    render_container,
    render_environment,
)
from sros_tool.runtime.rmw import no_security_text
from sros_tool.runtime.units import unit_changes, unit_instance, unit_words, write_units
from sros_tool.runtime.variables import KEYSTORE
from sros_tool.terminal import visible
from sros_tool.values import FileChange
from sros_tool.wording import enumerated
from sros_tool.xml import read_bytes


def only_root_clause(units: Collection[str]) -> str:
    """Return a clause on units that this user cannot restart with other files; "" without any."""
    if not units or os.access(SYSTEMD_FOLDER, os.W_OK):
        return ""
    return f"only root can restart {enumerated(sorted(units))}"


def check_may_restart(robot: LocalRobot, units: Collection[str], option: str) -> None:
    """Raise `UnavailableError` if ``option`` needs root because of the units."""
    if why := only_root_clause(units):
        raise UnavailableError(why, "Nothing was changed.", f"Run {robot.as_root(option)}.")


def write_start_files(robot: LocalRobot, state: CloseState) -> list[FileChange]:
    """Write the files that start each process with security; return the changes."""
    observed = state.observed
    environments = {
        process.enclave: robot.variables(process.enclave, process.rmw)
        for process in observed.processes
    }
    files = {
        f"{unit_instance(enclave)}.env": render_environment(variables, "docker")
        for enclave, variables in environments.items()
    }
    for process in observed.processes:
        if process.unit and not process.secured_by_unit:
            variables = environments[observed.start_enclave(process)]
            files[f"units/{process.unit}.d/{DROP_IN}"] = _drop_in_text(robot, process, variables)
    files[robot.commands_file.name] = _commands_text(robot, state)
    files[COMPOSE_FILE] = _compose_text(robot, observed, environments)
    changes = unit_changes(robot.start, files, force=True)
    write_units(robot.start, files, changes)
    written = [FileChange(action, str(robot.start / path)) for path, action in changes.items()]
    return [*written, *_remove_earlier_files(robot, files)]


def _remove_earlier_files(robot: LocalRobot, kept: Collection[str]) -> list[FileChange]:
    """Remove environments and drop-ins written here that no known process needs any more."""
    keystore = f"{KEYSTORE}={robot.export.absolute()}\n".encode()
    unneeded = [
        path
        for path in sorted(robot.start.glob("*.env"))
        if path.name not in kept and keystore in read_bytes(path, "environment file")
    ]
    unneeded += [
        path
        for path in sorted(robot.start.glob(f"units/*.d/{DROP_IN}"))
        if str(path.relative_to(robot.start)) not in kept
        and read_bytes(path, "unit").startswith(drop_in_heading(robot).encode())
    ]
    for path in unneeded:
        remove_file(path)
        used = SYSTEMD_FOLDER / path.parent.name / path.name
        stays = ""
        if path.name == DROP_IN and os.path.lexists(used):
            unit = path.parent.name.removesuffix(".d")
            stays = f"; {used} stays, so {unit} cannot start open (--undo removes the drop-in)"
        robot.shell.say(f"removed {path}: no known process needs it{stays}")
    return [FileChange("remove", str(path)) for path in unneeded]


def _drop_in_text(robot: LocalRobot, process: ClosedProcess, variables: Mapping[str, str]) -> str:
    """Return the drop-in of the unit that starts a process."""
    text = render_environment(variables, "systemd")
    if process.lacks_enclave_argument:
        words = (*process.command, ROS_ARGS, "--enclave", process.enclave)
        text += f"ExecStart=\nExecStart={' '.join(unit_words(words))}\n"
    return f"{drop_in_heading(robot)}[Service]\n{text}"


def _compose_text(
    robot: LocalRobot,
    observed: ObservedProcesses,
    environments: Mapping[str, Mapping[str, str]],
) -> str:
    """Return a file for Docker Compose with a service for each process."""
    services = []
    for process in observed.processes:
        files = str(robot.export.absolute() / "enclaves" / process.enclave.strip("/"))
        variables = environments[observed.start_enclave(process)]
        container = Container(process.enclave, object_name(process.enclave), variables, files)
        services += render_container(container, COMPOSE).splitlines()[1:]
    heading = (
        "# Give these services the names that they have in your own file, and give both files to "
        "Docker Compose 2."
    )
    return _text_of_lines([heading, *(["services:"] if services else []), *services])


def drop_in_heading(robot: LocalRobot) -> str:
    """Return the first line of each drop-in that is made for this folder."""
    return f"# Made by `sros close {robot.folder.absolute()}`; undone by its --undo.\n"


def _commands_text(robot: LocalRobot, state: CloseState) -> str:
    """Return the commands that start processes by hand: first the commands that are due now."""
    folder, due = robot.folder.absolute(), state.pending_by_hand
    commands = state.observed.commands_by_hand(folder)
    rest = {command: commands[command] for command in commands if command not in due}
    place = "by its command below, in the terminal or script that starts it now."
    together = "# Start them one second apart: processes that start together may miss each other."
    lines = [
        "# Stop all of these processes: secured and open ones do not hear each other. Then",
        f"# start each of them {place}",
        together,
    ]
    if state.secured:
        lines = [f"# Stop each of these processes, and start it {place}", together]
    if not state.secured:
        lines = [*map(_warning_of_rmw, robot.rmws_without_security()), *lines]
    lines = [*lines, *_command_lines(due, folder, state.denied_remappings)] if due else []
    for name in state.new:
        start = state.observed.command_of_new_process(robot.export.absolute(), name)
        why = "has ended" if name in state.observed.ended else "is new"
        lines += ["", f"# {name} {why}: COMMAND is what starts it", start]
    if rest:
        lines += ["", "# These processes run closed, with the current files."]
    lines += _command_lines(rest, folder, state.denied_remappings)
    lines += commands_elsewhere(state.observed.moved, folder)
    if shutil.which("ros2", path=robot.shell.environment.get("PATH")):
        launch = shlex.join(launch_words(folder, ("ros2", "launch"), ("PACKAGE", "FILE")))
        lines += [
            "",
            "# This starts a launch file closed, if it gives each process a name=.",
            launch,
        ]
    return _text_of_lines(lines).lstrip()


def _warning_of_rmw(rmw: str) -> str:
    """Return the comment that keeps a reader from stopping a robot that would not start again."""
    return (
        f"# NOT YET: {no_security_text(rmw)}. First find an RMW that enforces security: sros doctor"
    )


def _command_lines(
    by_hand: Mapping[str, Sequence[ClosedProcess]],
    folder: Path,
    denied_remappings: Mapping[str, Sequence[str]],
) -> Iterator[str]:
    """Yield the lines of commands, below comments with the enclaves of their processes."""
    for command, processes in by_hand.items():
        advice = processes[0].launch_advice(folder)
        yield from ("", f"# {', '.join(process.enclave for process in processes)}")
        yield from (f"# {advice}",) if advice else ()
        yield from (f"# {text}" for text in unit_advice(processes))
        for process in processes:
            for rule in map(visible, denied_remappings.get(process.enclave, ())):
                denied = rule.rpartition(":=")[2]
                yield f"# First change the remapping {rule}: the policy denies {denied}."
        yield command


def commands_elsewhere(moved: Sequence[ClosedProcess], folder: Path) -> Iterator[str]:
    """Yield comments with the commands of processes that moved from here to other machines.

    Launches and containers are left out: their files belong to this machine.
    """
    alone = [process for process in moved if not (process.launch or process.container)]
    if alone:
        yield from ("", "# On other machines; FOLDER is what `sros distribute_key` wrote:")
    for process in alone:
        yield f"# {process.secured_command(folder, export=Path('FOLDER'))}"


def _text_of_lines(lines: Iterable[str]) -> str:
    return "".join(f"{line}\n" for line in lines)
