"""``sros doctor`` says what is wrong in the environment, beside which DDS enforces security."""

from __future__ import annotations

import json

import pytest

from sros_tool.checks import runtime
from sros_tool.demo import doctor
from sros_tool.demo.doctor import Diagnosis
from sros_tool.runtime.stacks import Stack
from tests.checks.bench import Bench
from tests.support.harness import sros

pytest_plugins = ["tests.checks.sound_keystore"]

RMW = Stack("rclpy", "rmw", "Fast DDS", "2.14", "", True, False, "no security", "", "rmw_x")
CYCLONE = Stack("Cyclone DDS", "cyclone", "Cyclone DDS", "0.10", "", True, True, "it refused")


@pytest.mark.parametrize("as_json", [False, True])
def test_findings(as_json: bool, bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(doctor, "examine", lambda *_: Diagnosis((RMW, CYCLONE)))
    env = {
        "ROS_SECURITY_ENABLE": "true",
        "ROS_SECURITY_STRATEGY": "Enforce",
        "ROS_SECURITY_KEYSTORE": str(bench.root),
        "ROS_SECURITY_ENCLAVE_OVERRIDE": "/base",
        "RMW_IMPLEMENTATION": "rmw_y",
    }
    flags = ("--json",) if as_json else ()

    def said() -> str:
        ended = sros("doctor", *flags, env=env)
        assert ended.status == 1, "an RMW that is not here, or does not enforce, is an error"
        out = ended.out
        return " ".join(e["id"] for e in json.loads(out)["findings"]) if as_json else out

    sound = said()
    assert "runtime.rmw-without-security" not in sound
    assert "enclave." not in sound
    env["RMW_IMPLEMENTATION"] = "rmw_x"
    bench.path("enclaves/base/cert.pem").write_text("")
    broken = said()
    assert "runtime.rmw-without-security" in broken
    assert "enclave.file-empty" in broken


def test_status_0_where_nothing_is_wrong(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(doctor, "examine", lambda *_: Diagnosis((RMW, CYCLONE)))
    # Other tests run secured processes on this machine, and doctor looks at those, too.
    monkeypatch.setattr(runtime, "running_processes", lambda: iter(()))
    assert sros("doctor", env={}).ok().out.endswith("DDS Security can be enforced here.\n")
