"""What watching an open robot shows."""

from __future__ import annotations

from datetime import UTC, datetime
from types import SimpleNamespace
from typing import Any

from sros_tool.close import watch
from sros_tool.close.processes import ClosedProcess, ObservedProcesses
from sros_tool.policy.model import ALLOW
from sros_tool.policy.rights import Right
from sros_tool.runtime.processes import Process, ProcessOrigin, RunningProcesses

OF_A_LOGIN = {"PS1": "$ ", "INVOCATION_ID": "1", "XDG_RUNTIME_DIR": "/run/user/1", "MAIL": "m"}


def test_variables_that_a_command_does_not_set_are_named() -> None:
    variables = {"HOME": "/", "RMW_IMPLEMENTATION": "rmw_cyclonedds_cpp", "GAIN": "2"}
    talkers = tuple(
        Process(pid, ("talk",), {**variables, **OF_A_LOGIN}, datetime.now(UTC)) for pid in (1, 2, 3)
    )
    origins = [
        ProcessOrigin("", "/opt"),
        ProcessOrigin("", "/opt"),
        ProcessOrigin("a.service", "/"),
    ]
    closed = [
        ClosedProcess.from_process(process, "/talker", origin, "program")
        for process, origin in zip(talkers, origins, strict=True)
    ]
    shown: list[str] = []
    shell = SimpleNamespace(environment={"HOME": "/root"}, say=shown.append)
    robot = SimpleNamespace(shell=shell, commands_file="commands.txt")
    running: Any = SimpleNamespace(robot=robot, processes=RunningProcesses(talkers))
    watch._show_variables(running, ObservedProcesses(0, closed))
    processes = "process 1 (talk) and process 2 (talk) run with variables that this shell does not"
    assert len(shown) == 1 and shown[0].startswith(processes)
    assert "do not set: GAIN; before" in shown[0]


def test_a_name_that_several_enclaves_use_is_explained_once() -> None:
    lacking, policy = (
        [Right(f"/{enclave}", ALLOW, "subscribe", name) for enclave in "abc"]
        for name in ("/gas", "/air/gas")
    )
    (meaning,) = watch._likely_meanings(lacking, frozenset(lacking), frozenset(policy))
    assert meaning.startswith("perhaps the policy means /air/gas (")
