"""What keeps the process of a unit out of its enclave, although the unit has its drop-in."""

from __future__ import annotations

import re
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

from sros_tool.close.processes import DROP_IN, ObservedProcesses
from sros_tool.close.robot import LocalRobot
from sros_tool.close.state import RunningRobot
from sros_tool.errors import SrosError
from sros_tool.runtime.processes import Process, process_origin
from sros_tool.runtime.unit_properties import unit_properties
from sros_tool.terminal import visible
from sros_tool.validity import time_of_file
from sros_tool.wording import enumerated
from sros_tool.xml import read_bytes

_MOST_BYTES = 100_000
"""Size of the longest file in which variables are looked up."""


class Override(NamedTuple):
    """The process of a unit, and what changes the variables that the unit's drop-in gives it."""

    process: Process
    text: str


def overrides(running: RunningRobot, observed: ObservedProcesses) -> Mapping[str, Override]:
    """Map the enclaves of units to what keeps their processes out of their enclaves.

    Enclaves are left out whose unit started the process without the present drop-in: a restart with
    the drop-in helps.
    """
    of_unit = {
        process_origin(process.program[0]).unit: process for process in running.processes.processes
    }
    found = {}
    for known in observed.processes:
        if known.unit and (process := of_unit.get(known.unit)):
            variables: Mapping[str, str] = {}
            with suppress(SrosError):  # the files cannot be used; the proof says so
                variables = running.robot.variables(observed.start_enclave(known), known.rmw)
            changed = [
                name for name in variables if process.environment.get(name) != variables[name]
            ]
            if changed and (text := _override_text(running.robot, known.unit, process, changed)):
                found[known.enclave] = Override(process, text)
    return found


def _override_text(robot: LocalRobot, unit: str, process: Process, changed: Sequence[str]) -> str:
    """Return what changes the variables ``changed`` of a unit's drop-in, with the remedy; or ""."""
    names = "DropInPaths", "EnvironmentFiles", "ExecStart", "FragmentPath", "NeedDaemonReload"
    shown = unit_properties(unit, *names)
    drop_ins = [Path(path) for path in shown.get("DropInPaths", "").split()]
    own = next((path for path in drop_ins if path.name == DROP_IN), None)
    if own is None or shown.get("NeedDaemonReload") == "yes":
        return ""
    if _text_of(own) != _text_of(robot.start / "units" / f"{unit}.d" / DROP_IN):
        return ""
    if process.started < time_of_file(own.stat().st_mtime):
        return ""
    later = drop_ins[drop_ins.index(own) + 1 :]
    place = next(_places(shown, later, changed), "")
    place = place or f"the command of {unit}, or what it runs,"
    return (
        f"{place} changes {enumerated(changed)} after the drop-in of sros: remove that change, "
        f"and then run `{robot.close_command} --apply`"
    )


def _places(
    shown: Mapping[str, str], later: Sequence[Path], names: Collection[str]
) -> Iterator[str]:
    """Yield the files of a unit that may change variables, the most probable first.

    ``shown`` are the properties of the unit, and ``later`` the drop-ins that systemd reads after
    the drop-in of sros.
    """
    command = shown.get("ExecStart", "")
    files = re.findall(r"^(/.*) \(ignore_errors=", shown.get("EnvironmentFiles", ""), re.M)
    words = re.search(r"argv\[\]=(.*?) ;", command)
    scripts = words[1].split() if words else []
    for path in (*later[::-1], *map(Path, files)):
        if _mentions(_text_of(path), names):
            yield f"'{visible(str(path))}'"
    if _mentions(command, names):
        yield f"the start command in '{visible(shown.get('FragmentPath', ''))}'"
    for path in map(Path, scripts):
        if path.is_absolute() and _mentions(_text_of(path), names):
            yield f"'{visible(str(path))}'"


def _mentions(text: str, names: Collection[str]) -> bool:
    """Return whether a line of a text, which is no comment, has one of the names."""
    lines = [line for line in text.splitlines() if not line.lstrip().startswith(("#", ";"))]
    return any(name in line for line in lines for name in names)


def _text_of(path: Path) -> str:
    """Return the text of a file; "" for a file that cannot be read, or is too long."""
    with suppress(SrosError):
        return read_bytes(path, "file", max_bytes=_MOST_BYTES).decode(errors="replace")
    return ""
