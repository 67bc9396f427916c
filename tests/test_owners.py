"""Which other users can change a file, or put another one in its place."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from sros_tool.owners import (
    closing_command,
    file_of_root,
    link_of_stranger,
    other_writers_clause,
    replaceable_on_the_way,
    steps_to,
)
from tests.support.users import as_root

STRANGER = 65532
US = frozenset({0, os.geteuid()})


@pytest.fixture
def file(tmp_path: Path) -> Path:
    """A file that only root can replace, in a real folder and behind a link."""
    folder = tmp_path / "real/inner"
    folder.mkdir(parents=True)
    (folder / "file").write_text("content")
    (tmp_path / "link").symlink_to("real/../real/inner")
    return tmp_path / "link/file"


KEEP = -1


@as_root
@pytest.mark.parametrize(
    ("name", "user", "group", "mode", "found"),
    [
        ("real", KEEP, KEEP, 0o755, False),
        ("real", KEEP, KEEP, 0o777, True),
        ("real/inner", KEEP, KEEP, 0o777, True),
        ("real", KEEP, STRANGER, 0o775, True),
        ("real", KEEP, 0, 0o775, False),  # the private group of root
        ("real", KEEP, KEEP, 0o1777, False),
        ("real", STRANGER, KEEP, 0o1777, True),
        ("real", STRANGER, KEEP, 0o755, True),
        ("link", STRANGER, KEEP, None, True),
    ],
)
def test_the_way_to_a_file(
    name: str, user: int, group: int, mode: int | None, found: bool, file: Path
) -> None:
    top = file.parent.parent
    os.chown(top / name, user, group, follow_symlinks=False)
    if mode is not None:
        (top / name).chmod(mode)
    names = {str(path.relative_to(top)) for path, _ in replaceable_on_the_way(file, US)}
    assert names == ({name} if found else set())


@as_root
@pytest.mark.parametrize(
    ("of_link", "of_folder", "mode", "found"),
    [
        (STRANGER, 0, 0o755, True),
        (STRANGER, STRANGER, 0o755, False),  # a home folder
        (STRANGER, STRANGER, 0o1777, True),
        (0, STRANGER, 0o1777, False),
    ],
)
def test_a_link_of_another_user(
    of_link: int, of_folder: int, mode: int, found: bool, file: Path
) -> None:
    link = file.parent
    os.chown(link, of_link, -1, follow_symlinks=False)
    os.chown(link.parent, of_folder, -1)
    link.parent.chmod(mode)
    assert link_of_stranger(steps_to(file), US) == (link if found else None)


def test_a_file_of_root(file: Path) -> None:
    # Everybody can add files to the temporary folder, so nothing below it counts.
    assert file_of_root(file) is None
    link = file.with_name("link")
    for target, found in (
        ("/etc/passwd", True),
        ("/etc/../etc/passwd", True),
        ("/etc", False),
        ("/dev/null", False),
        ("/etc/there is no such file", False),
        ("link", False),
    ):
        link.unlink(missing_ok=True)
        link.symlink_to(target)
        for path in (Path(target), link):
            assert file_of_root(path) == (Path("/etc/passwd") if found else None)
    assert file_of_root(Path("/etc/\0")) is None


@as_root
def test_who_can_write_a_file(file: Path) -> None:
    assert other_writers_clause(file.stat(), US) == ""
    file.chmod(0o666)
    assert other_writers_clause(file.stat(), US) == "its mode is 0666, so everybody can write"
    assert closing_command(file, US) == f"chmod go-w {file}"
    os.chown(file, STRANGER, -1)
    assert other_writers_clause(file.stat(), US) == f"it belongs to user {STRANGER}"
    assert closing_command(file, US) == f"sudo chown -h root {file}"
    assert other_writers_clause(file.stat(), US | {STRANGER}).startswith("its mode is 0666")


def test_a_loop_of_links_ends(tmp_path: Path) -> None:
    (tmp_path / "loop").symlink_to("loop/loop")
    assert list(replaceable_on_the_way(tmp_path / "loop/file", US)) == []
