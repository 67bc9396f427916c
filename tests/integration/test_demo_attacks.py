"""The attacks over a real DDS: all of them in a sound keystore, and some in weak ones."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import pytest

from sros_tool.demo.backend import Backend, conditions
from sros_tool.demo.scenarios.attacks import ATTACKS
from sros_tool.demo.scenarios.model import Row
from sros_tool.keystore.template import load_template
from sros_tool.runtime.netns import RowNetwork, run_isolated, try_isolation
from tests.integration.enforcing import BACKENDS, enforcing_backend
from tests.integration.test_demo_run import processes_with, start
from tests.integration.weak_keystores import WEAKNESSES, make_weak
from tests.support.children import LONG, PATIENCE
from tests.support.harness import Running, snapshot, sros
from tests.support.long_form import ONLY_LONG, some, sometimes

pytestmark = pytest.mark.dds

ISOLATION = try_isolation()
needs_isolation = pytest.mark.skipif(not ISOLATION.isolated, reason=ISOLATION.reason)
SIGNED_BY_ITSELF = "permissions signed by the enclave itself"
NEEDS_ROOT = {"identity copied by another user of the robot"}


@pytest.fixture(scope="module", params=BACKENDS)
def backend(request: pytest.FixtureRequest) -> Backend:
    """Each back end that enforces security on this machine."""
    return enforcing_backend(request.param)


def demo(backend: Backend, *arguments: str, folder: Path) -> Running:
    chosen = ("--backend", backend.name, "--scenario", "attacks")
    return start("demo", *chosen, *arguments, folder=folder)


PUT_BACK, REPLAY = "old permissions put back", "replay of captured packets"


def some_attacks() -> list[str]:
    """Return some of the attacks, drawn anew in every run; in the long form all."""
    kinds = dict.fromkeys(row.attack for row in ATTACKS.rows if row.attack != SIGNED_BY_ITSELF)
    return [SIGNED_BY_ITSELF, *some(list(kinds), 1)]


def is_played(row: Row) -> bool:
    """Return whether --only with the names of `some_attacks` selects a row."""
    return any(attack.lower() in f"{row.attack} {row.name}".lower() for attack in some_attacks())


@pytest.fixture(scope="module")
def shown(
    backend: Backend, tmp_path_factory: pytest.TempPathFactory
) -> tuple[dict[str, Any], int, Path]:
    folder = tmp_path_factory.mktemp("attacks")
    summary = folder / "summary.md"
    temporary = folder / "tmp"
    temporary.mkdir()
    words = [word for name in some_attacks() for word in ("--only", name)]
    ended = demo(backend, "--json", "--summary", str(summary), *words, folder=temporary).end()
    assert not ended.err
    assert not list(temporary.iterdir())
    return json.loads(ended.out), ended.status, summary


def test_every_attack_ends_as_expected(
    backend: Backend, shown: tuple[dict[str, Any], int, Path]
) -> None:
    result, status, _ = shown
    assert not [row for row in result["rows"] if not row["as_expected"]]
    assert status == 0
    holding = conditions(backend, load_template("production"), "rt/chatter")
    rows = [row.with_expected_status(holding) for row in ATTACKS.rows if is_played(row)]
    assert [row["name"] for row in result["rows"]] == [row.name for row in rows]
    skipped = {row["name"]: row["detail"] for row in result["rows"] if row["observed"] == "skipped"}
    if ISOLATION.isolated and os.geteuid() == 0:
        assert not skipped
    observed = {row["name"]: row["observed"] for row in result["rows"]}
    if REPLAY in some_attacks():
        assert observed["packets of an unsecured talker sent again"] in ("heard again", "skipped")
        assert observed["packets of a secured talker sent again"] in ("not heard again", "skipped")
    assert observed[SIGNED_BY_ITSELF] == "not let in"
    twins = [row.name for row in rows if row.attack == SIGNED_BY_ITSELF and row.defence_removed]
    assert [observed[name] for name in twins] == ["heard"]
    open_doors = {row["name"] for row in result["rows"] if row["open_because"]}
    assert (PUT_BACK in open_doors) is (PUT_BACK in some_attacks())
    assert all(row["remedy"] for row in result["rows"] if row["open_because"])


OFTEN = ("subjects that others contain", "files open to all users")
"""What test_demo_user_keystore.py does not show in a robot's keystore."""


@needs_isolation
@pytest.mark.parametrize(
    "name",
    [
        pytest.param(each, marks=sometimes(each) if each in OFTEN else ONLY_LONG)
        for each in WEAKNESSES
    ],
)
def test_a_weakness_makes_its_rows_fail_and_no_others(
    backend: Backend, name: str, tmp_path: Path
) -> None:
    """Of the rows that keep their defenses: all that must fail, and one of the others.

    In the long form each weakness tries all rows.
    """
    weakness = WEAKNESSES[name]
    broken = weakness.broken_on(backend)
    rows_with_defenses = [row.name for row in ATTACKS.rows if not row.defence_removed]
    others = [row for row in rows_with_defenses if row not in broken]
    other = others[list(WEAKNESSES).index(name) % len(others)]
    tried = [row for row in rows_with_defenses if LONG or row in broken or row == other]
    root = make_weak(tmp_path, weakness, datetime.now(UTC))
    before = snapshot(root)
    words = [word for row in {*tried, *broken} for word in ("--only", row)]
    chosen = ("--template", "production", "--keystore", str(root), "--json", *words)
    ended = demo(backend, *chosen, folder=tmp_path).end()
    assert snapshot(root) == before
    assert not ended.err
    rows = {row["name"]: row for row in json.loads(ended.out)["rows"]}
    assert set(tried) <= set(rows)
    skipped = {each for each, row in rows.items() if row["observed"] == "skipped"}
    wrong = {each: row["observed"] for each, row in rows.items() if not row["as_expected"]}
    if os.geteuid() == 0:
        assert skipped == weakness.untried & set(tried)
    assert skipped <= NEEDS_ROOT | weakness.untried
    assert set(wrong) == broken - skipped, rows
    assert ended.status == bool(wrong)
    assert set(wrong.values()) <= {"heard", "answered", "readable", "deceived"}


@ONLY_LONG
@needs_isolation
def test_interrupted_attacks_leave_nothing(backend: Backend, tmp_path: Path) -> None:
    rows = [row for row in ATTACKS.rows if not row.defence_removed]
    words = [word for row in rows if LONG or row in rows[:6] for word in ("--only", row.name)]
    process = demo(backend, *words, folder=tmp_path)
    deadline = time.monotonic() + PATIENCE
    while len(list(tmp_path.glob("sros-demo-*/rows/row_*/*.jsonl"))) < 10:
        assert time.monotonic() < deadline
        time.sleep(0.02)
    process.send_signal(signal.SIGINT)
    ended = process.end()
    assert ended.status == 130
    assert "Traceback" not in ended.err
    assert list(tmp_path.iterdir()) == []
    assert not processes_with(str(tmp_path))


def _networks() -> Iterator[int]:
    for link in Path("/proc").glob("[0-9]*/ns/net"):
        try:
            yield link.stat().st_ino
        except OSError:
            continue


@needs_isolation
def test_the_network_of_a_row_ends_with_it() -> None:
    def work(_tell: Any) -> tuple[int, int, bool, bool]:
        here = Path("/proc/self/ns/net").stat().st_ino
        network = RowNetwork(own=True)
        with network.in_network():
            there = Path("/proc/thread-self/ns/net").stat().st_ino
            child = subprocess.Popen([sys.executable, "-c", "input()"], stdin=subprocess.PIPE)
        network.close()
        alive = there in set(_networks())
        child.communicate(b"\n")
        same = Path("/proc/thread-self/ns/net").stat().st_ino == here
        return here, there, alive and same, there in set(_networks())

    here, there, alive, left = run_isolated(work, ISOLATION, print)
    assert here != there
    assert alive
    assert not left


def test_a_keystore_in_which_nobody_talks(tmp_path: Path) -> None:
    root = tmp_path / "ks"
    assert sros("create_keystore", root, "--template", "production").status == 0
    assert sros("create_enclave", root, "/a", "/b").status == 0
    ended = sros("demo", "--scenario", "attacks", "--keystore", root)
    assert ended.status == 2
    assert "no two enclaves" in ended.err
    ended = sros("demo", "--keystore", root)
    assert ended.status == 2
    assert "isolation" in ended.err
