"""What changes the variables of a unit after the drop-in that closes the unit."""

from __future__ import annotations

import os
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from sros_tool.close.overrides import overrides
from sros_tool.close.processes import ClosedProcess, ObservedProcesses
from sros_tool.errors import SrosError
from sros_tool.runtime.processes import ProcessOrigin, RunningProcesses
from sros_tool.runtime.unit_properties import unit_properties
from tests.close.test_assignment import process

UNIT, NAME = "talker.service", "ROS_SECURITY_STRATEGY"


def refuse(*_words: str) -> dict[str, str]:
    raise SrosError("the files have expired")


def test_what_changes_the_variables_of_a_drop_in_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Or "restart it" would be said again after every restart. Comments change nothing."""
    paths = "a.conf", "sros-close.conf", "zz.conf", "default", "run.sh"
    first, own, later, variables, script = (tmp_path / f"{UNIT}.d" / name for name in paths)
    written = tmp_path / "start/units" / own.parent.name / own.name
    written.parent.mkdir(parents=True)
    own.parent.mkdir()
    for path in (first, own, written, later, variables, script):
        path.write_text(f"{NAME}=x\n")
    unit = tmp_path / UNIT
    shown = {
        "DropInPaths": f"{first} {own} {later}",
        "EnvironmentFiles": f"/nowhere (ignore_errors=yes)\n{variables} (ignore_errors=no)",
        "ExecStart": f"{{ path=/bin/sh ; argv[]=/bin/sh {script} a ; ignore_errors=no }}",
        "FragmentPath": f"{unit}",
        "NeedDaemonReload": "no",
    }
    monkeypatch.setattr("sros_tool.close.overrides.unit_properties", lambda *_: shown)
    monkeypatch.setattr("sros_tool.close.overrides.process_origin", lambda _: ProcessOrigin(UNIT))
    robot: Any = SimpleNamespace(
        start=tmp_path / "start",
        close_command="sros close robot",
        variables=lambda *_: {NAME: "Enforce", "ROS_SECURITY_ENABLE": "true"},
    )
    observed = ObservedProcesses(
        0, [ClosedProcess("/talker", 7, ("talk",), "/opt", 0, UNIT, "program")]
    )
    lax = replace(
        process(8, "talk", "b"),
        environment={NAME: "Permissive", "ROS_SECURITY_ENABLE": "true"},
        started=datetime.now(UTC) + timedelta(minutes=1),
    )

    def text(process: Any = lax) -> str:
        running: Any = SimpleNamespace(robot=robot, processes=RunningProcesses((process,)))
        return "".join(override.text for override in overrides(running, observed).values())

    remedy = f"changes {NAME} after the drop-in of sros: remove that change, and then run"
    for place in (later, variables, script):
        assert text() == f"'{place}' {remedy} `sros close robot --apply`"
        place.write_text(f"# {NAME}=x\n")
    assert text().startswith(f"the command of {UNIT}, or what it runs, {remedy}")
    shown["ExecStart"] = f"{{ path=/bin/env ; argv[]=/bin/env {NAME}=x talk ; ignore_errors=no }}"
    assert text().startswith(f"the start command in '{unit}' {remedy}")
    script.unlink()
    assert not text(replace(lax, environment={NAME: "Enforce", "ROS_SECURITY_ENABLE": "true"}))
    assert not text(replace(lax, started=lax.started - timedelta(days=1))), "it was not restarted"
    for name, value in (("NeedDaemonReload", "yes"), ("DropInPaths", f"{later}")):
        with monkeypatch.context() as changed:
            changed.setitem(shown, name, value)
            assert not text(), "a restart with the drop-in helps"
    own.write_text("another folder's\n")
    assert not text()
    own.write_text(written.read_text())
    assert text()
    monkeypatch.setattr(robot, "variables", refuse)
    assert not text(), "the proof says that the files cannot be used"


def test_properties_of_a_unit_are_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """ExecStart has a line for each command."""
    systemctl = tmp_path / "systemctl"
    systemctl.write_text("#!/bin/sh\necho \"$2 $3\" >&2; printf 'A=b=c\\nB=1\\nB=2\\n'\n")
    systemctl.chmod(0o755)
    monkeypatch.setenv("PATH", f"{tmp_path}:{os.environ['PATH']}")
    assert unit_properties(UNIT, "A", "B") == {"A": "b=c", "B": "1\n2"}
    monkeypatch.setenv("PATH", "/nowhere")
    assert unit_properties(UNIT, "A") == {}
