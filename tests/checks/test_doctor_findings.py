"""``sros doctor`` says what is wrong in the environment, beside which DDS enforces security."""

from __future__ import annotations

import json

import pytest

from sros_tool.demo import doctor
from sros_tool.demo.doctor import Diagnosis
from sros_tool.runtime.processes import ProcessTable, RunningProcesses
from sros_tool.runtime.stacks import Stack
from tests.checks.bench import Bench
from tests.support.harness import sros

pytest_plugins = ["tests.checks.sound_keystore"]

RMW = Stack("rclpy", "rmw", "Fast DDS", "2.14", "", True, False, "no security", "", "rmw_opendds")
CYCLONE = Stack("Cyclone DDS", "cyclone", "Cyclone DDS", "0.10", "", True, True, "it refused")


@pytest.mark.parametrize("as_json", [False, True])
def test_findings(as_json: bool, bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(doctor, "examine", lambda *_: Diagnosis((RMW, CYCLONE)))
    env = {
        "ROS_SECURITY_ENABLE": "true",
        "ROS_SECURITY_STRATEGY": "Enforce",
        "ROS_SECURITY_KEYSTORE": str(bench.root),
        "ROS_SECURITY_ENCLAVE_OVERRIDE": "/base",
        "RMW_IMPLEMENTATION": "rmw_connext",
    }
    flags = ("--json",) if as_json else ()

    def said() -> str:
        ended = sros("doctor", *flags, env=env)
        assert ended.status == 1, "an RMW that is not here, or does not enforce, is an error"
        out = ended.out
        return " ".join(e["id"] for e in json.loads(out)["findings"]) if as_json else out

    sound = said()
    assert "runtime.rmw-without-security" not in sound
    assert "[enclave." not in sound
    env["RMW_IMPLEMENTATION"] = "rmw_opendds"
    bench.path("enclaves/base/cert.pem").write_text("")
    broken = said()
    assert "runtime.rmw-without-security" in broken
    assert "enclave.file-empty" in broken


SECURE = RMW._replace(name="rclpy with rmw_s", enforces=True, rmw="rmw_s")
ABSENT = RMW._replace(present=False, enforces=None, rmw="")
UNTRIED = RMW._replace(enforces=None)
BY = "DDS Security can be enforced here, by "


@pytest.mark.parametrize(
    ("stacks", "status", "said", "ros"),
    [
        ((SECURE, CYCLONE), 0, f"{BY}rclpy with rmw_s and Cyclone DDS.", True),
        ((CYCLONE,), 0, f"{BY}Cyclone DDS. No RMW is installed", None),
        ((ABSENT, CYCLONE), 0, f"{BY}Cyclone DDS. No RMW is installed", None),
        (
            (RMW, CYCLONE),
            1,
            "but NOT by ROS nodes: rmw_opendds does not enforce it. Use the ROS 2",
            False,
        ),
        ((UNTRIED, CYCLONE), 1, "but NOT by ROS nodes: rmw_opendds could not be tried.", None),
        ((RMW, SECURE), 1, "rmw_opendds does not enforce it. Set RMW_IMPLEMENTATION=rmw_s", False),
        ((RMW,), 1, "Nothing here enforces DDS Security.", False),
    ],
)
def test_the_status_is_about_the_nodes_of_ros(
    stacks: tuple[Stack, ...],
    status: int,
    said: str,
    ros: bool | None,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(doctor, "examine", lambda *_: Diagnosis(stacks))
    # Other tests run secured processes on this machine, and doctor looks at those, too.
    monkeypatch.setattr(ProcessTable, "look", lambda *_: RunningProcesses())
    ended = sros("doctor", env={})
    assert ended.status == status
    assert said in ended.out.partition("\n\n")[0]
    assert ended.out.count("ROS 2 packages of Ubuntu") <= 1
    assert json.loads(sros("doctor", "--json", env={}).out)["ros_enforces"] is ros


def test_a_dds_of_which_little_is_known_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ProcessTable, "look", lambda *_: RunningProcesses())
    for version, said in (
        ("0.10.2", "[runtime.package-vulnerabilities]"),
        ("of unknown version", "[runtime.dds-version-unknown]"),
        ("11.0.1", ""),
    ):
        stack = CYCLONE._replace(version=version, where="/usr/lib/libddsc.so")
        monkeypatch.setattr(doctor, "examine", lambda *_, found=stack: Diagnosis((found,)))
        out = sros("doctor", env={}).out
        assert said in out and ("/usr/lib/libddsc.so'" in out) is bool(said)
