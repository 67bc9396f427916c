"""The systemd drop-ins that start the units of a robot with security."""

from __future__ import annotations

import os
import shlex
import subprocess
from pathlib import Path

from sros_tool.close.processes import ObservedProcesses
from sros_tool.close.robot import LocalRobot
from sros_tool.errors import SrosError, UnavailableError
from sros_tool.xml import read_bytes

SYSTEMD = Path("/etc/systemd/system")
DROP_IN = "sros-close.conf"


def drop_in_heading(robot: LocalRobot) -> str:
    """Return the first line of each drop-in that is made for this folder."""
    return f"# Made by `sros close {robot.folder.absolute()}`; undone by its --undo.\n"


def drop_ins_of(robot: LocalRobot, observed: ObservedProcesses) -> list[Path]:
    """Return the drop-ins of this folder; raise `SrosError` at one of another folder."""
    drop_ins = [
        path
        for path in sorted(SYSTEMD.glob(f"*.d/{DROP_IN}"))
        if read_bytes(path, "unit").startswith(drop_in_heading(robot).encode())
    ]
    for unit in sorted(observed.units):
        path = SYSTEMD / f"{unit}.d/{DROP_IN}"
        if path not in drop_ins and os.path.lexists(path):
            raise SrosError(
                f"'{path}' is not the drop-in of this folder",
                "Its first line names another folder, or was changed. Nothing was changed.",
                "Use the folder that it names, spelled as there, or remove the drop-in.",
            )
    return drop_ins


def restart_units(
    robot: LocalRobot,
    observed: ObservedProcesses,
    units: set[str],
    *,
    changed: bool = False,
    dry_run: bool,
) -> None:
    """Let systemd read its units again if some are restarted or changed.  Raises `SrosError`.

    Units whose processes ended by themselves are restarted only if they run.
    """
    idle = {process.unit for process in observed.processes if not process.pid}
    verbs = {"restart": units - idle, "try-restart": units & idle}
    restarts = [[verb, *sorted(names)] for verb, names in verbs.items() if names]
    for words in [["daemon-reload"], *restarts] if units or changed else []:
        command = ["systemctl", *words]
        robot.shell.say(f"{'would run:' if dry_run else '+'} {shlex.join(command)}")
        try:
            ended = 0 if dry_run else subprocess.run(command, check=False).returncode
        except OSError as error:
            raise UnavailableError(f"systemctl cannot be run: {error.strerror}") from error
        if ended:
            raise SrosError(
                f"`{shlex.join(command)}` ended with {ended}",
                "Secured and open processes do not hear each other.",
                "Fix it and run --apply again, or go back with --undo.",
            )
