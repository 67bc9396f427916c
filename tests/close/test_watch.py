"""What watching an open robot shows."""

from __future__ import annotations

from datetime import UTC, datetime
from types import SimpleNamespace
from typing import Any

from sros_tool.close import watch
from sros_tool.close.processes import ClosedProcess, ObservedProcesses
from sros_tool.runtime.processes import Process, ProcessOrigin, RunningProcesses


def test_variables_that_a_command_does_not_set_are_named() -> None:
    variables = {"HOME": "/", "RMW_IMPLEMENTATION": "rmw_cyclonedds_cpp", "GAIN": "2"}
    talker = Process(1, ("talk",), variables, datetime.now(UTC))
    closed = ClosedProcess.from_process(talker, "/talker", ProcessOrigin("", "/opt"), "program")
    shown: list[str] = []
    shell = SimpleNamespace(environment={"HOME": "/root"}, say=shown.append)
    robot = SimpleNamespace(shell=shell, commands_file="commands.txt")
    running: Any = SimpleNamespace(robot=robot, processes=RunningProcesses((talker,)))
    watch._say_variables(running, ObservedProcesses(0, [closed]))
    assert len(shown) == 1 and shown[0].endswith("its command in commands.txt does not set: GAIN")
