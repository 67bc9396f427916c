"""Each state in which a process can run is named by `sros check runtime`, and nothing else."""

from __future__ import annotations

from typing import Any

import pytest

from tests.integration import what_runs
from tests.support.children import apart, has_isolation

pytestmark = pytest.mark.dds

EXPECTED = {
    **{name: {"process-outdated"} for name in (*what_runs.FILES, "named") if name != "key"},
    "expired": {"process-expired"},
    "removed": {"process-without-files"},
    "revoked": {"process-revoked"},
    "permissive": {"process-permissive"},
    "unsecured": {"process-runs-unsecured"},
    "open": {"process-unsecured"},
    "stranger": {"process-other-keystore"},
    "elsewhere": {"process-elsewhere"},
}
"""The ids of the findings about each process; the others of `SOUND` have none.

A key of which only the file is new is the one that the process has: the certificate is the same.
"""
SOUND = {"fine", "wrapped", "key"}


@pytest.fixture(scope="module")
def said() -> Any:
    if not has_isolation():
        pytest.skip("needs a network of its own")
    return apart(what_runs.play)


def test_each_state_is_named_and_nothing_else(said: Any) -> None:
    found = {
        name: {each.removeprefix("runtime.") for each in of} for name, of in said["found"].items()
    }
    assert set(said["running"]) == {*EXPECTED, *SOUND}
    assert found == EXPECTED


def test_the_file_that_changed_is_named(said: Any) -> None:
    for name, file in what_runs.FILES.items() - {("key", "key.pem")}:
        text = said["found"][name]["runtime.process-outdated"]
        assert f"; {file} of /{name} changed later" in text


def test_watching_says_each_change_once_and_ends_quietly(said: Any) -> None:
    watched = [tuple(each) for each in said["watched"]]
    expected = {("new", name, f"runtime.{each}") for name, of in EXPECTED.items() for each in of}
    expected.discard(("new", "expired", "runtime.process-expired"))
    assert len(watched) == len(set(watched))
    assert {each for each in watched if each[0] == "new"} == expected
    assert {each for each in watched if each[0] != "new"} == {
        ("over", "open", "runtime.process-unsecured")
    }
    status, err = said["end"]
    assert status == 0
    assert len(err.splitlines()) == 1
