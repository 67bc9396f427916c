"""Whose shared memory systemd removes at logout."""

from __future__ import annotations

from pathlib import Path

import pytest

from sros_tool.runtime import logind
from sros_tool.runtime.logind import users_without_linger
from sros_tool.runtime.processes import SEVERAL_USERS


@pytest.mark.parametrize(
    ("answer", "lingers", "found"),
    [
        ("no systemd", "4712", []),
        ("b true", "4712", ["4711"]),
        ("b false", "4712", []),
        ("", "4712", ["4711"]),  # logind does not run now: the default counts
        (None, "4712", ["4711"]),
        ("b true", "4711", ["4712"]),
    ],
)
def test_users_who_log_in_lose_their_memory_without_linger(
    answer: str | None,
    lingers: str,
    found: list[str],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A user of the system, such as 999, keeps it anyway; "several users" is no user."""
    monkeypatch.setattr(logind, "_LINGER_FOLDER", tmp_path)
    is_booted = answer != "no systemd"
    monkeypatch.setattr(logind, "_BOOTED_FOLDER", tmp_path if is_booted else tmp_path / "none")
    monkeypatch.setenv("PATH", str(tmp_path))
    (tmp_path / lingers).touch()
    if answer is not None:
        (tmp_path / "busctl").write_text(f"#!/bin/sh\necho {answer}\n")
        (tmp_path / "busctl").chmod(0o755)
    users = {0, 999, 4711, SEVERAL_USERS} | ({4712} if lingers == "4711" else set())
    assert users_without_linger(users) == found
