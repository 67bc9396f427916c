"""Which other users can change a file, or put another one in its place."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from sros_tool.owners import belongs_to_root, other_writers

STRANGER = 65532
US = frozenset({0, os.geteuid()})

as_root = pytest.mark.skipif(os.geteuid() != 0, reason="only root can act as several users")


@pytest.fixture
def file(tmp_path: Path) -> Path:
    """A file that only root can replace, in a real folder and behind a link."""
    folder = tmp_path / "real/inner"
    folder.mkdir(parents=True)
    (folder / "file").write_text("content")
    (tmp_path / "link").symlink_to("real/../real/inner")
    return tmp_path / "link/file"


@as_root
def test_what_belongs_to_root(file: Path) -> None:
    # Everybody can add files to /tmp, so nothing in it counts; below / nothing is in the way.
    assert not belongs_to_root(file)
    assert belongs_to_root(Path("/etc/passwd"))
    assert not belongs_to_root(Path("/etc/there is no such file"))


@as_root
def test_who_can_write_a_file(file: Path) -> None:
    assert other_writers(file.stat(), US) == ""
    file.chmod(0o666)
    assert other_writers(file.stat(), US) == "its mode is 0666, so everybody can write"
    os.chown(file, STRANGER, -1)
    assert other_writers(file.stat(), US) == f"it belongs to user {STRANGER}"
    assert other_writers(file.stat(), US | {STRANGER}).startswith("its mode is 0666")
