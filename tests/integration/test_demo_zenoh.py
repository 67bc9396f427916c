"""The whole demo on Zenoh as a user runs it; and that a missing defense makes it fail."""

from __future__ import annotations

import getpass
import json
import os
import subprocess
import sys
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import pytest

from sros_tool.demo.program import DemoOptions, run_demo
from sros_tool.demo.scenarios.model import Row, Scenario
from sros_tool.demo.scenarios.on_zenoh import ATTACKS, ZENOH_SCENARIOS
from tests.support.children import PATIENCE
from tests.support.long_form import some

pytest.importorskip("zenoh", reason="the wheel eclipse-zenoh is missing")
pytestmark = pytest.mark.zenoh

SROS = [sys.executable, "-c", "from sros_tool.cli import main; main()"]
ROWS = [row for scenario in ZENOH_SCENARIOS for row in scenario.rows]


def some_words() -> list[str]:
    """Return names of rows, of each scenario some, and of an attack; in the long form all."""
    attacks = list(dict.fromkeys(row.attack for row in ATTACKS.rows))
    others = [
        some([row.name for row in each.rows if not row.attack], 1) for each in ZENOH_SCENARIOS
    ]
    return [*(name for names in others for name in names), *some(attacks, 1)]


def is_played(row: Row) -> bool:
    """Return whether --only with these words selects a row."""
    return any(word.lower() in f"{row.attack} {row.name}".lower() for word in some_words())


@pytest.fixture(scope="module")
def shown(tmp_path_factory: pytest.TempPathFactory) -> tuple[dict[str, Any], int, Path]:
    folder = tmp_path_factory.mktemp("zenoh_demo")
    only = [word for each in some_words() for word in ("--only", each)]
    done = subprocess.run(
        [*SROS, "demo", "--backend", "zenoh", "--json", "--keep", folder / "kept", *only],
        env={**os.environ, "TMPDIR": str(folder), "ZENOH_CONFIG_OVERRIDE": "mode=wrong"},
        capture_output=True,
        text=True,
        timeout=PATIENCE,
        check=False,
    )
    assert not done.stderr
    return json.loads(done.stdout), done.returncode, folder / "kept"


def test_every_row_is_as_expected(shown: tuple[dict[str, Any], int, Path]) -> None:
    result, status, _ = shown
    assert [row for row in result["rows"] if not row["as_expected"]] == []
    assert status == 0
    assert result["backend"] == "zenoh"
    assert result["dds"].startswith("Zenoh 1.")
    assert [each["name"] for each in result["scenarios"]] == [
        scenario.name for scenario in ZENOH_SCENARIOS
    ]
    assert [row["name"] for row in result["rows"]] == [row.name for row in ROWS if is_played(row)]
    skipped = {row["name"] for row in result["rows"] if row["observed"] == "skipped"}
    assert not skipped or not result["own_network"]


def test_what_is_kept(shown: tuple[dict[str, Any], int, Path]) -> None:
    result, _, keep = shown
    assert json.loads((keep / "result.json").read_text()) == result
    assert (keep / "keystore/enclaves/router/router.p7s").is_file()
    for key in keep.glob("**/key.pem"):
        assert key.stat().st_mode & 0o077 == 0


def test_nothing_stays_in_shared_memory(shown: tuple[dict[str, Any], int, Path]) -> None:
    assert shown
    mine = [each for each in Path("/dev/shm").glob("*.zenoh") if each.owner() == getpass.getuser()]
    assert not [each for each in mine if b"Hello World from the talker" in each.read_bytes()]


def without_defenses(name: str) -> Scenario:
    """The scenario of an attack as if it were closed, in a keystore where it is not."""
    attacks = {row.name: row for row in ATTACKS.rows}
    closed = attacks[name]
    opened = next(
        row for row in ATTACKS.rows if row.attack == closed.attack and row.defence_removed
    )
    row = replace(opened, name=name, expected=closed.expected, claims=closed.claims, world="")
    return replace(ATTACKS, rows=(row,))


@pytest.mark.parametrize(
    "name",
    some(
        [
            "another enclave publishes through the router",
            "another enclave plays the router and reads",
        ],
        1,
    ),
)
def test_the_demo_fails_where_the_defense_is_missing(name: str) -> None:
    options = DemoOptions(backend="zenoh", scenarios=(without_defenses(name),))
    result = run_demo(options, datetime.now(UTC), lambda _line: None)
    assert not result.as_expected
    assert [row.observed.value for row in result.rows] == ["heard"]
