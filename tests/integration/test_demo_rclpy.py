"""The rclpy nodes: ordinary nodes that the demo's runner starts, here without security."""

from __future__ import annotations

import importlib.util
import json
import os
import signal
import subprocess
import sys
from datetime import UTC, datetime
from pathlib import Path

import pytest

from sros_tool.dds.domains import DomainSet
from sros_tool.demo.backend import RCLPY, Backend, choose_backend
from sros_tool.demo.keystores import KeystoreSet, KeystoreSpec, create_keystores
from sros_tool.demo.program import Limits, RunPlan, run_rows
from sros_tool.demo.scenarios import SCENARIOS
from sros_tool.demo.scenarios.communication import ACTIONS, COMPOSITION, ISOLATION, SERVICES, TALKER
from sros_tool.demo.scenarios.model import UNSECURED, RowStatus
from sros_tool.errors import UnavailableError
from sros_tool.keystore.template import load_template
from sros_tool.runtime.events import Event, EventKind, ProcessStage, read_events
from sros_tool.runtime.netns import run_isolated, try_isolation
from sros_tool.runtime.stacks import rclpy_stacks
from tests.integration.enforcing import enforcing_backend
from tests.integration.test_demo_run import without_security
from tests.support.children import LONG, PATIENCE, finish, python, wait_for
from tests.support.harness import sros
from tests.support.long_form import some

pytestmark = [
    pytest.mark.dds,
    pytest.mark.skipif(importlib.util.find_spec("rclpy") is None, reason="rclpy is not here"),
]

DOMAIN = str(1 + os.getpid() % 100)
"""Of this process alone, for these nodes are in the host's network: others test there, too."""


def node(
    role: str, folder: Path, *arguments: str, on: str = "ros", **more: str
) -> subprocess.Popen[str]:
    variables = {**os.environ, "ROS_DOMAIN_ID": DOMAIN, "ROS_LOG_DIR": str(folder), **more}
    report = ["--report", str(folder / f"{role}.jsonl")]
    return subprocess.Popen(
        [sys.executable, "-m", f"sros_tool.demo.{on}_node", role, *report, *arguments],
        env=variables,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def wait_until(kind: EventKind, path: Path, process: subprocess.Popen[str]) -> list[Event]:
    """Wait until a process has reported an event of that kind; return all that it reported."""

    def found() -> list[Event]:
        events = read_events(path)
        return events if any(event.kind is kind for event in events) else []

    return wait_for(found, f"{path.name} says {kind}", process, words=path.read_text)


def test_the_runner_drives_rclpy_nodes(tmp_path: Path) -> None:
    """A drawn row that can be played without security; in the long form all of them."""
    playable = [
        [row for row in each.rows if all(p.identity == UNSECURED for p in row.parties)]
        for each in (ISOLATION, SERVICES, ACTIONS)
    ]
    playable += [[without_security(r) for r in COMPOSITION.rows if r.brief and not r.attack]]
    rows = tuple(some([row for of_scenario in playable for row in of_scenario], 1))
    plan = RunPlan(
        rows=rows,
        domains=tuple(range(191, 191 + len(rows))),
        backend=Backend(RCLPY, "Fast DDS", "a test"),
        keystores=KeystoreSet({}),
        topic="/chatter",
        folder=tmp_path / "rows",
        limits=Limits(window=2.0, longest_window=10.0),
    )
    results = run_isolated(lambda tell: run_rows(plan, tell), try_isolation(), print)
    wired = {row.name for row in rows if row.wire}
    assert len(results) == (8 if LONG else 1)
    for result in results:
        unpermitted = result.name in wired or "cannot be loaded" in result.detail
        skipped = result.observed is RowStatus.SKIPPED and unpermitted
        assert result.observed is result.expected or skipped, result


@pytest.mark.parametrize("name", [each.name for each in SCENARIOS if each.name != "attacks"])
def test_every_scenario_on_an_rclpy_that_enforces_security(name: str, tmp_path: Path) -> None:
    """The attacks are played by test_demo_attacks.py."""
    backend = enforcing_backend(RCLPY)
    page, summary = tmp_path / "page.html", tmp_path / "summary.md"
    ended = sros(
        *("demo", "--backend", "rclpy", "--scenario", name, "--json"),
        *("--report", page, "--summary", summary),
    )
    shown = json.loads(ended.ok().out)
    assert shown["dds"] == backend.dds
    assert len(shown["rows"]) > 4
    for row in shown["rows"]:
        assert row["observed"] == row["expected"], row
        assert "SECURITY" not in row["detail"], "the words of the refusal, not the line of the log"
    assert page.stat().st_size > 1000
    assert summary.stat().st_size > 300


@pytest.mark.parametrize("number", some([signal.SIGINT, signal.SIGTERM], 1))
def test_nodes_take_ros_arguments_and_end_quietly(number: signal.Signals, tmp_path: Path) -> None:
    remap = ["--ros-args", "-r", f"chatter:=/renamed_{os.getpid()}"]
    listener = node("listener", tmp_path, *remap, "-r", "__node:=ear")
    talker = node("talker", tmp_path, "--period", "0.1", "--text", "Hi", *remap)
    try:
        wait_until(EventKind.READY, tmp_path / "talker.jsonl", talker)
        heard = wait_until(EventKind.HEARD, tmp_path / "listener.jsonl", listener)
        assert heard[-1].text.startswith("Hi: ")
    finally:
        for process in (listener, talker):
            process.send_signal(number)
    for process in (listener, talker):
        assert "Traceback" not in finish(process).stderr
    for name in ("talker", "listener"):
        assert read_events(tmp_path / f"{name}.jsonl")[-1].kind is EventKind.DONE


_INTERRUPTED = """
import os, signal, sys
from sros_tool.demo import ros_node
def build(node, options, events):
    def interrupted():
        try:
            os.kill(os.getpid(), signal.SIGINT)
        except KeyboardInterrupt:
            import rclpy
            rclpy.ok = lambda: True  # it ends a moment later
            raise RuntimeError("Unable to convert call argument '0' to Python object")
    node.create_timer(0.01, interrupted)
ros_node._ROLES["talker"] = build
sys.exit(ros_node.main(["talker", "--report", sys.argv[1]]))
"""


def test_a_signal_inside_rclpy_is_no_failure(tmp_path: Path) -> None:
    """A KeyboardInterrupt in the middle of rclpy's C++ becomes another error there."""
    python("-c", _INTERRUPTED, tmp_path / "talker.jsonl")
    assert read_events(tmp_path / "talker.jsonl")[-1].kind is EventKind.DONE


def test_a_cyclone_talker_is_heard_by_an_rclpy_listener(tmp_path: Path) -> None:
    listener = node("listener", tmp_path)
    talker = node("talker", tmp_path, "--period", "0.1", "--text", "Cyclone", on="cyclone")
    try:
        heard = wait_until(EventKind.HEARD, tmp_path / "listener.jsonl", listener)
        assert heard[-1].text.startswith("Cyclone: ")
    finally:
        for process in (listener, talker):
            process.terminate()
            process.communicate(timeout=PATIENCE)


def test_a_secured_node_runs_secured_or_not_at_all(tmp_path: Path) -> None:
    """Over an RMW without security, the node must fail at the participant and say why."""
    domains, template = DomainSet.of((190, 190)), load_template("production")
    spec = KeystoreSpec("/chatter", domains, template, datetime.now(UTC))
    keystores = create_keystores(tmp_path, ISOLATION, spec)
    stack = next(rclpy_stacks(keystores.probe("/chatter", 190)))
    assert stack.enforces is not None, stack.evidence
    variables = keystores.environment(TALKER, 190)
    talker = node("talker", tmp_path, **variables)
    if stack.enforces:
        wait_until(EventKind.READY, tmp_path / "talker.jsonl", talker)
        talker.terminate()
        talker.communicate(timeout=PATIENCE)
        return
    _, errors = talker.communicate(timeout=PATIENCE)
    assert talker.returncode == 1
    (failed,) = read_events(tmp_path / "talker.jsonl")
    assert (failed.kind, failed.stage) == (EventKind.FAILED, ProcessStage.PARTICIPANT)
    assert "security" in errors
    with pytest.raises(UnavailableError, match="rclpy has no RMW here"):
        choose_backend("rclpy", keystores.probe("/chatter", 190))


STOPPED_WHILE_IT_IS_MADE = """
import os, signal, sys
from pathlib import Path
from sros_tool.demo.nodes import NodeOptions
from sros_tool.demo.ros_node import _run_role

def build(node, options, events):
    if "signal" in sys.argv:
        os.kill(os.getpid(), signal.SIGTERM)
    raise RuntimeError("half made")

sys.exit(_run_role(build, NodeOptions("talker", report=Path(sys.argv[1])), []))
"""


@pytest.mark.parametrize(("how", "status"), some([("signal", 0), ("fault", 1)], 1))
def test_a_node_that_is_ended_while_it_is_made_has_not_failed(
    how: str, status: int, tmp_path: Path
) -> None:
    report = tmp_path / "report.jsonl"
    done = python("-c", STOPPED_WHILE_IT_IS_MADE, report, how, status=status)
    last = read_events(report)[-1]
    assert last.kind is (EventKind.FAILED if status else EventKind.DONE), done.stderr
