"""Nodes of the demo that are started by hand; docs/tutorial.md runs them on Cyclone DDS."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from sros_tool.demo.backend import HandNode, security_of
from sros_tool.demo.scenarios.model import Role
from sros_tool.errors import SrosError, UsageError
from tests.support.children import PATIENCE
from tests.support.harness import sros

TALKER = HandNode(Role.TALKER, "cyclone", "/chatter")


def test_a_node_says_whether_it_is_secured(keystore: Path) -> None:
    assert security_of(TALKER, {}).endswith("/chatter, domain 0: WITHOUT security")
    variables = {
        "ROS_SECURITY_ENABLE": "true",
        "ROS_SECURITY_STRATEGY": "Enforce",
        "ROS_SECURITY_KEYSTORE": str(keystore),
        "ROS_SECURITY_ENCLAVE_OVERRIDE": "/a",
        "ROS_DOMAIN_ID": "7",
    }
    assert security_of(TALKER, variables).endswith("domain 7: secured, in the enclave /a")
    (keystore / "enclaves" / "a" / "key.pem").unlink()
    with pytest.raises(SrosError, match=r"key\.pem"):
        security_of(TALKER, variables)
    # As rcl does: without Enforce, the node runs without the enclave.
    variables["ROS_SECURITY_STRATEGY"] = "Permissive"
    assert "WITHOUT security" in security_of(TALKER, variables)


def test_a_node_on_zenoh_says_its_configuration() -> None:
    pytest.importorskip("zenoh")
    node = HandNode(Role.LISTENER, "zenoh", "/chatter")
    assert "WITHOUT security" in security_of(node, {"ROS_SECURITY_ENABLE": "true"})
    assert "--rmw rmw_zenoh_cpp" in security_of(node, {"ROS_SECURITY_ENABLE": "true"})
    assert security_of(node, {"ZENOH_SESSION_CONFIG_URI": "/a.json5"}).endswith("by /a.json5")
    with pytest.raises(UsageError, match="only Zenoh has routers"):
        HandNode(Role.ROUTER, "rclpy", "/chatter")


@pytest.mark.parametrize("options", [["--json"], ["--scenario", "attacks"], ["--domain", "3"]])
def test_options_that_a_node_does_not_take_are_refused(options: list[str]) -> None:
    ended = sros("demo", "talker", *options)
    assert ended.status == 2
    assert f"a talker takes no {options[0]}" in ended.err


def test_a_hostile_topic_is_refused_before_a_node_starts() -> None:
    ended = sros("demo", "listener", "--topic", "/a\x1b[2J b")
    assert ended.status == 2
    assert "\x1b" not in ended.err


@pytest.mark.zenoh
def test_a_node_on_zenoh_ends_at_once_while_it_waits_for_a_router() -> None:
    pytest.importorskip("zenoh")
    program = [sys.executable, "-P", "-m", "sros_tool.demo.zenoh_node", "listener"]
    variables = {**os.environ, "ZENOH_CONFIG_OVERRIDE": 'connect/endpoints=["tcp/127.0.0.1:1"]'}
    with subprocess.Popen([*program, "--patience", "1000000"], env=variables) as node:
        status, end = Path(f"/proc/{node.pid}/status"), time.monotonic() + PATIENCE
        while not _catches(status.read_text("ascii"), signal.SIGTERM):
            assert node.poll() is None and time.monotonic() < end
            time.sleep(0.02)
        node.terminate()
        try:
            assert node.wait(PATIENCE) == 0
        finally:
            node.kill()


def _catches(status: str, number: signal.Signals) -> bool:
    """Return whether a process catches a signal, by its status in /proc."""
    line = next(each for each in status.splitlines() if each.startswith("SigCgt:"))
    return bool(int(line.split()[1], 16) >> (number - 1) & 1)
