"""The demo as a user runs it, over a real DDS; and that it fails where it has to."""

from __future__ import annotations

import json
import os
import signal
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from sros_tool.demo.backend import Backend
from sros_tool.demo.keystores import KeystoreSet
from sros_tool.demo.program import Limits, RunPlan, run_rows
from sros_tool.demo.result import RowResult
from sros_tool.demo.scenarios.communication import ROWS
from sros_tool.demo.scenarios.model import UNSECURED, Row, RowStatus
from sros_tool.errors import SrosError, UnavailableError
from sros_tool.runtime.cyclone import load_cyclone
from sros_tool.runtime.netns import run_isolated, try_isolation
from tests.support.children import PATIENCE
from tests.support.harness import Running
from tests.support.long_form import some

pytestmark = pytest.mark.dds

SHORT = Limits(window=1.0, longest_window=8.0)


@pytest.fixture(scope="module", autouse=True)
def _needs_cyclone() -> None:
    try:
        load_cyclone.cache_clear()
        load_cyclone()
    except UnavailableError as error:
        pytest.skip(str(error))


def start(*arguments: str, folder: Path, **more: str) -> Running:
    """Start a run of the program that makes its temporary files in ``folder``."""

    def first() -> None:
        tempfile.tempdir = str(folder)

    return Running(*arguments, env={**os.environ, **more}, first=first)


HEARD = "secured talker to secured listener"
DENIED = "secured talker without permission"
PLAYED = [HEARD, DENIED, *some([r.name for r in ROWS if r.name not in (HEARD, DENIED)], 1)]
"""The rows that are played: what is heard, what is denied, and one that is drawn."""


@pytest.fixture(scope="module")
def shown(tmp_path_factory: pytest.TempPathFactory) -> tuple[dict[str, Any], int, Path]:
    folder = tmp_path_factory.mktemp("demo")
    keep = folder / "kept"
    arguments = ["--backend", "cyclone", "--json", "--domain", "140", "--keep", str(keep)]
    only = [word for name in PLAYED for word in ("--only", name)]
    ended = start("demo", *arguments, *only, folder=folder).end()
    assert not ended.err
    return json.loads(ended.out), ended.status, keep


def test_every_row_is_as_expected(shown: tuple[dict[str, Any], int, Path]) -> None:
    result, status, _ = shown
    wrong = [row for row in result["rows"] if not row["as_expected"]]
    assert not wrong
    assert status == 0
    assert result["backend"] == "cyclone"
    assert result["dds"].startswith("Cyclone DDS 0.10")
    observed = {row["name"]: row["observed"] for row in result["rows"]}
    assert observed.keys() >= set(PLAYED)
    assert observed[HEARD] == "heard"
    assert observed[DENIED] == "refused"
    details = {row["name"]: row["detail"] for row in result["rows"]}
    assert "rt/chatter denied by default rule" in details[DENIED]


def test_what_is_kept(shown: tuple[dict[str, Any], int, Path]) -> None:
    result, _, keep = shown
    assert json.loads((keep / "result.json").read_text()) == result
    assert (keep / "keystore/enclaves/governance.p7s").is_file()
    assert len(list((keep / "rows").glob("row_*/*.jsonl"))) >= 2 * len(PLAYED)
    for key in keep.glob("**/*.key.pem"):
        assert key.stat().st_mode & 0o777 == 0o600


ONE_ROW = (
    *("--backend", "cyclone", "--domain", "160"),
    *("--only", "secured talker to secured listener"),
)


@pytest.mark.parametrize(
    ("number", "after"),
    some([(signal.SIGINT, "at once"), (signal.SIGTERM, "while rows run")], 1),
)
def test_an_interrupted_demo_leaves_nothing(
    number: signal.Signals, after: str, tmp_path: Path
) -> None:
    process = start("demo", *ONE_ROW, folder=tmp_path)
    deadline = time.monotonic() + PATIENCE
    wanted = "sros-demo-*/rows/row_*/*.jsonl" if after == "while rows run" else "sros-demo-*"
    while not list(tmp_path.glob(wanted)):
        assert time.monotonic() < deadline
        time.sleep(0.02)
    process.send_signal(number)
    ended = process.end()
    assert ended.status == {signal.SIGINT: 130, signal.SIGTERM: 143}[number]
    assert "Traceback" not in ended.err
    assert list(tmp_path.iterdir()) == []
    assert not processes_with(str(tmp_path))


def test_no_node_outlives_a_killed_demo(tmp_path: Path) -> None:
    process = start("demo", *ONE_ROW, folder=tmp_path)
    deadline = time.monotonic() + PATIENCE
    while not list(tmp_path.glob("sros-demo-*/rows/row_*/*.jsonl")):
        assert time.monotonic() < deadline
        time.sleep(0.02)
    assert processes_with(str(tmp_path))
    process.kill()
    process.wait()
    while processes_with(str(tmp_path)):
        assert time.monotonic() < deadline
        time.sleep(0.02)


def processes_with(text: str) -> list[str]:
    found = []
    for folder in Path("/proc").glob("[0-9]*"):
        try:
            line = (folder / "cmdline").read_bytes().decode("utf-8", "replace")
        except OSError:
            continue
        if text in line:
            found.append(line)
    return found


def play(rows: tuple[Row, ...], backend: Backend, folder: Path) -> dict[str, RowResult]:
    """Run rows without any keystore: only unsecured parties can take part."""
    plan = RunPlan(
        rows=rows,
        domains=tuple(range(180, 180 + len(rows))),
        backend=backend,
        keystores=KeystoreSet({}),
        topic="/chatter",
        folder=folder / "rows",
        limits=SHORT,
        own_networks=try_isolation().isolated,
    )
    results = run_isolated(lambda tell: run_rows(plan, tell), try_isolation(), lambda _line: None)
    return {result.name: result for result in results}


def without_security(row: Row) -> Row:
    return replace(row, parties=tuple(replace(party, identity=UNSECURED) for party in row.parties))


CYCLONE = Backend("cyclone", "Cyclone DDS", "a test")


def test_without_security_the_demo_fails(tmp_path: Path) -> None:
    """Its rows can fail: where everybody is unsecured, everybody is heard and let in."""
    heard = [row for row in ROWS if row.name == "secured talker to secured listener"]
    rows = [*heard, *some([row for row in ROWS if row not in heard], 1)]
    found = play(tuple(map(without_security, rows)), CYCLONE, tmp_path)
    assert found["secured talker to secured listener"].observed is RowStatus.HEARD
    closed = [result for result in found.values() if result.expected is not RowStatus.HEARD]
    skipped = {result.name for result in closed if result.observed is RowStatus.SKIPPED}
    wrong = {result.name for result in closed if not result.as_expected}
    assert wrong | skipped >= {
        result.name for result in closed if result.expected is not RowStatus.READABLE
    }
    assert skipped <= {row.name for row in ROWS if row.wire}


@pytest.mark.parametrize("victim", some(["talker", "listener"], 1))
def test_a_node_that_dies_makes_its_row_fail(victim: str, tmp_path: Path) -> None:
    """A node that is killed as soon as it is ready hears nothing, and that is no isolation."""
    row = without_security(
        next(r for r in ROWS if r.name == "secured talker to unsecured listener")
    )
    row = replace(row, controls=())

    class Dying(Backend):
        def command(
            self, role: Any, options: Any, names: Any, *, secured: bool = False
        ) -> list[str]:
            if role.value != victim:
                return super().command(role, options, names)
            code = (
                "import os, sys; from pathlib import Path;"
                "from sros_tool.runtime.events import *;"
                "report = Path(sys.argv[sys.argv.index('--report') + 1]);"
                "EventWriter(report).report(EventKind.READY);"
                "import time; time.sleep(0.5); os.kill(os.getpid(), 11)"
            )
            return [sys.executable, "-c", code, *options]

    (result,) = play((row,), Dying("cyclone", "x", "y"), tmp_path).values()
    assert result.observed is RowStatus.CRASHED
    assert "SIGSEGV" in result.detail
    assert not result.as_expected


def test_an_error_of_the_runner_is_an_error_of_the_demo() -> None:
    def fail(_tell: Any) -> None:
        raise ValueError("x")

    with pytest.raises(SrosError, match="ValueError: x"):
        run_isolated(fail, try_isolation(), print)
    with pytest.raises(SrosError, match="without a result"):
        run_isolated(lambda _tell: os._exit(3), try_isolation(), print)


def test_doctor_finds_what_enforces(tmp_path: Path) -> None:
    ended = start("doctor", "--json", folder=tmp_path, ROS_SECURITY_ENABLE="True").end()
    found = json.loads(ended.out)
    stacks = {stack["kind"]: stack for stack in found["stacks"]}
    assert stacks["cyclone"]["enforces"] is True
    assert ended.status == 1, "a misspelt variable switches security off"
    assert "runtime.enable-misspelt" in {each["id"] for each in found["findings"]}
    assert list(tmp_path.iterdir()) == []


def test_doctor_says_what_to_install(tmp_path: Path) -> None:
    def first() -> None:
        tempfile.tempdir = str(tmp_path)
        load_cyclone.cache_clear()

    environment = {**os.environ, "SROS_CYCLONEDDS_DIR": str(tmp_path)}
    ended = Running("doctor", "--json", env=environment, first=first).end()
    answer = json.loads(ended.out)
    cyclone = next(each for each in answer["stacks"] if each["kind"] == "cyclone")
    assert not cyclone["present"]
    assert "libddsc0debian" in cyclone["advice"]
    # Processes of other tests may be misconfigured on purpose, and doctor looks at all of them.
    misconfigured = any(each["severity"] == "error" for each in answer["findings"])
    sound = answer["enforces"] and answer["ros_enforces"] is not False
    assert ended.status == (misconfigured or not sound)


FAST_DDS_NODE = """
import sys
from pathlib import Path
from sros_tool.runtime.events import EventWriter, EventKind, ProcessStage
argument = dict(zip(sys.argv, sys.argv[1:]))
events = EventWriter(Path(argument["--report"]))
if "without_permission" in argument["--report"]:
    print("\\x1b[37;1m2026-01-01 12:00:00.000 [\\x1b[31;1mSECURITY Error\\x1b[37;1m] "
          f"\\x1b[0mrt{argument['--topic']} topic not found in allow rule. -> Function check")
    events.report(EventKind.FAILED, "RCLError: invalid allocator", stage=ProcessStage.ENDPOINT)
    sys.exit(1)
events.report(EventKind.READY)
import time; time.sleep(600)
"""


def test_a_denial_as_rclpy_over_fast_dds_shows_it(tmp_path: Path) -> None:
    """The exception misleads; what Fast DDS prints on stdout, in color, is what counts."""

    class FastDds(Backend):
        def command(
            self, role: Any, options: Any, names: Any, *, secured: bool = False
        ) -> list[str]:
            return [sys.executable, "-c", FAST_DDS_NODE, *options]

    rows = tuple(without_security(row) for row in ROWS if row.expected is RowStatus.REFUSED)
    results = play(rows, FastDds("rclpy", "Fast DDS", "a test"), tmp_path)
    assert len(results) == 2
    for result in results.values():
        assert (result.observed, result.as_expected) == (RowStatus.REFUSED, True)
        assert "topic not found in allow rule" in result.detail
