"""A live robot is closed: on Cyclone DDS, on Zenoh; everything talks, and nobody else hears it."""

from __future__ import annotations

import importlib.util
import json
import os
import shlex
import subprocess
import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from sros_tool.close.processes import read_processes
from sros_tool.close.state import ALONE
from sros_tool.demo.backend import CYCLONE, RCLPY
from sros_tool.parallel import end_with_parent
from sros_tool.runtime.events import EventKind, read_events
from tests.integration.enforcing import enforces, enforcing_backend
from tests.support.children import apart, has_isolation, importing, wait_for
from tests.support.harness import Ended, sros
from tests.support.long_form import sometimes

pytestmark = pytest.mark.dds

DOMAIN = 187
SCRIPT = Path(__file__).with_name("ros_nodes") / "turning.py"
ROLES = {"talker": "publish", "listener": "subscribe"}
IN_EXPORT = (sys.executable, "-m", "sros_tool", "run", "robot/export")


@contextmanager
def running(folder: Path, *, secured: bool) -> Iterator[Mapping[str, Path]]:
    """Start both nodes; yield the files with their events, if they are secured."""
    children, reports = [], {}
    for role, right in ROLES.items():
        reports[role] = folder / f"{role}.jsonl"
        reports[role].touch()
        nodes = [{"name": role, "ns": "/", right: ["chatter"]}]
        node = [sys.executable, str(SCRIPT), role, str(reports[role]), json.dumps(nodes)]
        children.append(
            subprocess.Popen(
                [*(*IN_EXPORT, f"/{role}", "--"), *node] if secured else node,
                env=importing(ROS_DOMAIN_ID=str(DOMAIN)),
                cwd=folder,
                stdout=(folder / f"{role}.log").open("wb"),
                stderr=subprocess.STDOUT,
                preexec_fn=end_with_parent,
            )
        )
    try:
        yield reports
    finally:
        for child in children:
            child.kill()
            child.wait()


def heard(report: Path) -> bool:
    return any(event.kind is EventKind.HEARD for event in read_events(report))


def play(folder: Path) -> dict[str, Any]:
    """Close the robot; tell what sros said at each step."""
    named = {"ROS_DOMAIN_ID": str(DOMAIN), "ROS_SECURITY_ENABLE": None, "RMW_IMPLEMENTATION": None}

    def close(*words: str) -> Ended:
        return sros("close", "robot", *words, env=named, cwd=folder)

    said: dict[str, Any] = {}
    with running(folder, secured=False):
        for role in ROLES:
            log = folder / f"{role}.log"
            wait_for(lambda log=log: b"ready\n" in log.read_bytes(), role)  # type: ignore[misc]
        said["open"] = close()
        said["applied"] = close("--apply")
        said["not yet"] = close("--proof", "--partial", "--json")
    with running(folder, secured=True) as reports:
        wait_for(lambda: heard(reports["listener"]), "the listener hears the talker")
        said["closed"] = close("--proof", "--partial", "--json")
    return said


def proofs(ended: Ended) -> dict[str, Any]:
    """The proofs by claim, except the one on other network namespaces, where other tests run."""
    return {
        proof["claim"]: proof
        for proof in json.loads(ended.out)["proofs"]
        if proof["claim"] != ALONE
    }


@pytest.mark.skipif(importlib.util.find_spec("rclpy") is None, reason="rclpy is not here")
@sometimes("a live robot is closed")
def test_a_robot_is_closed(tmp_path: Path) -> None:
    if not has_isolation():
        pytest.skip("needs a network of its own")
    enforcing_backend(CYCLONE)
    if enforces(RCLPY):
        pytest.skip("rclpy is secured itself here, and does not see nodes of Cyclone DDS")
    said = apart(lambda: play(tmp_path))
    known = read_processes(tmp_path / "robot/processes.json")
    assert {(each.enclave, each.known_by) for each in known.processes} == {
        ("/talker", "process id"),
        ("/listener", "process id"),
    }
    assert said["open"].status == 0, said["open"]
    assert "  topic /chatter: /talker -> /listener\n" in said["open"].out
    assert said["applied"].status == 1
    assert f", and start again with:\n  cd {tmp_path} && sros run " in said["applied"].out

    assert said["not yet"].status == 1
    (first,) = proofs(said["not yet"]).values()
    assert first["reason"].startswith(
        "no secured process of this robot runs in /listener (process "
    )

    assert said["closed"].status == 1, said["closed"]
    processes, files, required, talk, silence = proofs(said["closed"]).values()
    assert files["holds"] is True and required["holds"] is True, (files, required)
    # The nodes secure themselves, without rcl: sros cannot see that they do, so they count as open.
    assert processes["holds"] is False, processes
    for reason in processes["reason"].split("; "):
        assert reason.endswith(f"it runs in domain {DOMAIN} with ROS_SECURITY_ENABLE=true"), reason
    # On the wheels of rclpy, which enforce no security, there is no observer with an enclave.
    assert talk["holds"] is None and "without DDS Security" in talk["reason"], talk
    assert silence["holds"] is None and "this proves nothing" in silence["reason"], silence


# ── Zenoh ──────────────────────────────────────────────────────────────────────────────────

ZENOH_NODES = SCRIPT.with_name("zenoh_nodes.py")
ON_ZENOH = {
    "talker": "/chatter",
    "listener": "/chatter",
    "server": "/add",
    "client": "/add",
    "action_server": "/count",
    "action_client": "/count",
}
HEARING = ("listener", "client", "action_client")


@contextmanager
def all_running(folder: Path, commands: list[str]) -> Iterator[None]:
    """Run shell commands, the router first, until everybody who should hear something does."""
    reports = [folder / f"{role}.jsonl" for role in HEARING]
    for report in reports:
        report.write_text("")
    path = f"{Path(sys.executable).parent}:{os.environ['PATH']}"
    children = []
    try:
        for command in commands:
            environment = importing(PATH=path)
            output = (folder / "robot.log").open("ab")
            words = ["/bin/sh", "-c", command.replace(" && ", " && exec ", 1)]
            children.append(
                subprocess.Popen(
                    words, env=environment, stdout=output, stderr=output, preexec_fn=end_with_parent
                )
            )
            if len(children) == 1:
                wait_for(lambda: "router ready" in (folder / "robot.log").read_text(), "router")
        wait_for(lambda: all(map(heard, reports)), "everybody hears what is for them")
        yield
    finally:
        for child in children:
            child.kill()
            child.wait()
        (folder / "robot.log").rename(folder / "robot.log.before")


def play_on_zenoh(folder: Path) -> dict[str, Any]:
    """Close the robot by the commands that sros says, and open it again by them."""
    (folder / "rmw_zenohd").symlink_to(ZENOH_NODES)
    programs = [[sys.executable, "rmw_zenohd"]]
    for role, name in ON_ZENOH.items():
        node = [sys.executable, str(ZENOH_NODES), f"{role}.jsonl", role, name]
        programs.append([*node, "--ros-args", "-r", f"__node:={role}"])
    named = {"RMW_IMPLEMENTATION": "rmw_zenoh_cpp", "ROS_SECURITY_ENABLE": None}
    named |= {"ROS_DOMAIN_ID": None, "PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}"}

    def close(*words: str) -> Ended:
        return sros("close", "robot", *words, env=named, cwd=folder)

    said: dict[str, Any] = {}
    with all_running(folder, [f"cd {folder} && {shlex.join(words)}" for words in programs]):
        said["open"] = close()
        said["applied"] = close("--apply")
    starts = [line[2:] for line in said["applied"].out.splitlines() if line.startswith("  ")]
    with all_running(folder, starts):
        said["closed"] = close("--proof", "--partial", "--json")
    said["undone"] = close("--undo")
    lines = said["undone"].err.splitlines()
    starts = [line.partition(" does not run; start it open: ")[2] for line in lines]
    starts = [start for start in starts if start]
    assert len(starts) == len(programs), said["undone"]
    with all_running(folder, starts):
        said["open again"] = close("--proof", "--partial", "--json")
        said["undone again"] = close("--undo")
    return said


@pytest.mark.skipif(importlib.util.find_spec("zenoh") is None, reason="Zenoh is not here")
@sometimes("a live robot is closed")
def test_a_robot_on_zenoh_is_closed_and_opened_again(tmp_path: Path) -> None:
    if not has_isolation():
        pytest.skip("needs a network of its own")
    said = apart(lambda: play_on_zenoh(tmp_path))
    assert said["open"].status == 0, said["open"]
    assert "  action /count: /action_client -> /action_server\n" in said["open"].out
    assert "not in the policy" not in said["open"].out
    assert said["applied"].status == 1
    assert said["closed"].status == 0, said["closed"]
    processes, files, required, talk, silence = proofs(said["closed"]).values()
    assert files["holds"] is True and required["holds"] is True, (files, required)
    assert processes["holds"] is not False, processes
    assert talk["reason"] == "6 nodes with 118 endpoints as before (types are not compared)", talk
    assert silence["holds"] is True, silence
    (first,) = proofs(said["open again"]).values()
    assert first["holds"] is False
    assert said["undone again"].status == 0, said["undone again"]
