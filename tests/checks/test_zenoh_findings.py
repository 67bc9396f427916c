"""Findings about configurations of Zenoh: each is found, and not in a sound one."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from sros_tool.checks.zenoh import configuration_findings
from sros_tool.zenoh.configuration import Mode
from tests.checks.zenoh_cases import CASES, sound
from tests.support.harness import sros


def found(folder: Path, document: object) -> set[str]:
    file = folder / "session.json5"
    file.write_text(json.dumps(document, indent=1))
    return {each.id for each in configuration_findings(file)}


@pytest.mark.parametrize("mode", Mode)
def test_what_sros_writes_has_no_findings(mode: Mode, tmp_path: Path) -> None:
    assert found(tmp_path, sound(mode)) == set()


@pytest.mark.parametrize("id", CASES)
def test_found(id: str, tmp_path: Path) -> None:  # noqa: A002
    document = sound()
    CASES[id](document)
    assert id in found(tmp_path, document)


def test_check_takes_a_configuration(tmp_path: Path) -> None:
    file = tmp_path / "session.json5"
    file.write_text(json.dumps(sound()))
    assert sros("check", file).ok().err == "nothing found\n"
    file.write_text("{mode: 'client', // open\n}")
    ended = sros("check", file)
    assert ended.status == 1
    assert "session.json5:1: error: a process of Zenoh without access control" in ended.out
    file.write_text("{mode: 'client'")
    assert "Line 1: it ends too early" in sros("check", file).out
