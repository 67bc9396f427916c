"""Findings about Zenoh configurations: each is found, and not in a sound one."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from sros_tool.checks.zenoh import configuration_findings
from sros_tool.zenoh.configuration import Mode
from tests.checks.zenoh_cases import ALLOW, CASES, HARMLESS, rule, sound
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


@pytest.mark.parametrize("id", HARMLESS)
def test_not_found(id: str, tmp_path: Path) -> None:  # noqa: A002
    document = sound()
    HARMLESS[id](document)
    assert id not in found(tmp_path, document)


def test_an_endpoint_can_switch_off_mutual_tls(tmp_path: Path) -> None:
    document = sound(Mode.ROUTER)
    assert found(tmp_path, document) == set()
    document["listen"]["endpoints"] = ["tls/[::]:7447#enable_mtls=false"]
    assert found(tmp_path, document) == {"zenoh.no-mutual-tls"}


def test_a_denial_holds_where_nothing_wider_is_allowed(tmp_path: Path) -> None:
    document = sound()
    rule("yes", "allow", "0/*/*/*", "/talker")(document)
    rule("no", "deny", "0/**", "/talker")(document)
    assert "zenoh.deny-in-wildcard" not in found(tmp_path, document)


def test_under_default_allow_a_denial_of_everything_holds(tmp_path: Path) -> None:
    document = sound()
    ALLOW(document)
    rule("no", "deny", "**", "/talker")(document)
    assert "zenoh.deny-in-wildcard" not in found(tmp_path, document)
    rule("less", "deny", "@ros2_lv/0/**", "/router")(document)
    assert "zenoh.deny-in-wildcard" in found(tmp_path, document)
    assert "zenoh.name-not-verified" in found(tmp_path, document), "nobody has to have a name"


def test_the_defaults_of_zenoh_are_open(tmp_path: Path) -> None:
    assert found(tmp_path, {"mode": "router"}) == {
        "zenoh.plain-endpoint",
        "zenoh.router-without-rules",
        "zenoh.shared-memory",
        "zenoh.multicast",
    }


def test_check_takes_a_configuration(tmp_path: Path) -> None:
    file = tmp_path / "session.json5"
    file.write_text(json.dumps(sound()))
    assert sros("check", file).ok().err == "nothing found\n"
    file.write_text("{mode: 'client', // open\n}")
    ended = sros("check", file)
    assert ended.status == 1
    assert "session.json5:1: error: a session without access control" in ended.out
    file.write_text("{mode: 'client'")
    assert "Line 1: it ends too early" in sros("check", file).out


def test_subjects_that_overlap_by_the_million_are_not_all_counted(tmp_path: Path) -> None:
    """A small file with 4,000,000 such pairs: they are counted up to a limit."""
    document = sound()
    access = document["access_control"]
    for number in range(2000):
        access["subjects"] += [
            {"id": f"name {number}", "cert_common_names": ["/a"]},
            {"id": f"place {number}", "interfaces": ["eth0"]},
        ]
    file = tmp_path / "session.json5"
    file.write_text(json.dumps(document))
    texts = [each.text for each in configuration_findings(file)]
    assert any(each.endswith("so can at least 1000 more pairs") for each in texts)
