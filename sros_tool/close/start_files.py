"""The files that start the processes of a robot with security."""

from __future__ import annotations

import shlex
import shutil
from collections.abc import Iterable, Iterator, Mapping, Sequence

from sros_tool.close.processes import COMPOSE_FILE, ClosedProcess, launch_words
from sros_tool.close.robot import LocalRobot
from sros_tool.close.state import CloseState
from sros_tool.files import remove_file
from sros_tool.runtime.environment import (
    COMPOSE,
    ROS_ARGS,
    Container,
    object_name,
    render_container,
    render_environment,
)
from sros_tool.runtime.units import unit_changes, unit_instance, unit_words, write_units
from sros_tool.runtime.variables import KEYSTORE
from sros_tool.values import FileChange
from sros_tool.xml import read_bytes

DROP_IN = "sros-close.conf"


def write_start_files(robot: LocalRobot, state: CloseState) -> list[FileChange]:
    """Write the files that start each process with security; return what changed."""
    observed, folder = state.observed, robot.folder.absolute()
    environments = {
        process.enclave: robot.variables(process.enclave, process.rmw)
        for process in observed.processes
    }
    files = {
        f"{unit_instance(enclave)}.env": render_environment(variables, "docker")
        for enclave, variables in environments.items()
    }
    services = [
        "# Rename the services to those of your own file; give both files to Docker Compose 2."
    ]
    for process in observed.processes:
        variables = environments[observed.started_in(process)]
        if process.unit:
            text = render_environment(variables, "systemd")
            if process.lacks_enclave_argument:
                words = (*process.command, ROS_ARGS, "--enclave", process.enclave)
                text += f"ExecStart=\nExecStart={' '.join(unit_words(words))}\n"
            files[f"units/{process.unit}.d/{DROP_IN}"] = (
                f"{drop_in_heading(robot)}[Service]\n{text}"
            )
        enclave_files = str(folder / "export/enclaves" / process.enclave.strip("/"))
        name = object_name(process.enclave)
        service = render_container(
            Container(process.enclave, name, variables, enclave_files), COMPOSE
        )
        services += ["services:", *service.splitlines()[1:]][len(services) > 1 :]
    lines = _command_lines(robot, state)
    if shutil.which("ros2", path=robot.shell.environment.get("PATH")):
        launch = shlex.join(launch_words(folder, ("ros2", "launch"), ("PACKAGE", "FILE")))
        lines += ["", "# Any launch file; each process needs name= in it.", launch]
    files |= {robot.commands_file.name: _text(lines).lstrip(), COMPOSE_FILE: _text(services)}
    changes = unit_changes(robot.start, files, force=True)
    write_units(robot.start, files, changes)
    written = [FileChange(action, str(robot.start / path)) for path, action in changes.items()]
    kept = {robot.start / path for path in files}
    keystore = f"{KEYSTORE}={robot.export.absolute()}\n".encode()
    unneeded = [
        path
        for path in sorted({*robot.start.glob("*.env")} - kept)
        if keystore in read_bytes(path, "environment file")  # written here, for another enclave
    ]
    for path in unneeded:
        remove_file(path)
        robot.shell.say(f"removed {path}: it was for an enclave without a known process")
    return [*written, *(FileChange("remove", str(path)) for path in unneeded)]


def drop_in_heading(robot: LocalRobot) -> str:
    """Return the first line of each drop-in that is made for this folder."""
    return f"# Made by `sros close {robot.folder.absolute()}`; undone by its --undo.\n"


def _command_lines(robot: LocalRobot, state: CloseState) -> list[str]:
    """Return the commands that start processes by hand: first those that are due now."""
    folder, due = robot.folder.absolute(), state.pending_by_hand
    commands = state.observed.commands_by_hand(folder)
    rest = {command: commands[command] for command in commands if command not in due}
    place = "by its command, in the place that starts it today."
    lines = [
        "# Stop all of these processes: secured and open ones do not hear each other. Then",
        f"# start each of them {place}",
    ]
    if state.secured:
        lines = [f"# Stop each of these processes, and start it {place}"]
    lines = [*lines, *_commands(due)] if due else []
    for name in state.new:
        start = state.observed.command_of_new(robot.export.absolute(), name)
        why = "has ended" if name in state.observed.ended else "is new"
        lines += ["", f"# {name} {why}: COMMAND is what starts it", start]
    if rest:
        lines += ["", "# These processes run closed, with the current files."]
    return [*lines, *_commands(rest)]


def _commands(by_hand: Mapping[str, Sequence[ClosedProcess]]) -> Iterator[str]:
    for command, processes in by_hand.items():
        yield from ("", f"# {', '.join(process.enclave for process in processes)}", command)


def _text(lines: Iterable[str]) -> str:
    return "".join(f"{line}\n" for line in lines)
