"""Replacing files as a whole, and what is no file to replace."""

from __future__ import annotations

import os
import stat
import threading
from pathlib import Path

import pytest

from sros_tool.files import replace_file


def test_a_file_keeps_its_mode_and_a_link_its_target(tmp_path: Path) -> None:
    real, link = tmp_path / "real", tmp_path / "link"
    real.write_bytes(b"old")
    real.chmod(0o640)
    link.symlink_to("real")
    replace_file(link, b"new")
    assert link.is_symlink()
    assert (real.read_bytes(), stat.S_IMODE(real.stat().st_mode)) == (b"new", 0o640)
    assert sorted(each.name for each in tmp_path.iterdir()) == ["link", "real"]


@pytest.mark.parametrize("through_a_link", [False, True])
def test_a_pipe_is_written_to_and_stays_one(tmp_path: Path, through_a_link: bool) -> None:
    pipe, link = tmp_path / "pipe", tmp_path / "link"
    os.mkfifo(pipe)
    link.symlink_to("pipe")
    read: list[bytes] = []
    reader = threading.Thread(target=lambda: read.append(pipe.read_bytes()))
    reader.start()
    replace_file(link if through_a_link else pipe, b"what was asked for")
    reader.join(10)
    assert read == [b"what was asked for"]
    assert stat.S_ISFIFO(pipe.lstat().st_mode)


@pytest.mark.skipif(os.geteuid() != 0, reason="only root can make devices")
def test_a_device_is_never_replaced(tmp_path: Path) -> None:
    nothing = tmp_path / "null"
    try:
        os.mknod(nothing, 0o666 | stat.S_IFCHR, os.makedev(1, 3))
        nothing.write_bytes(b"x")
    except OSError as error:
        pytest.skip(f"devices do not work here: {error}")
    replace_file(nothing, b"anything")
    assert stat.S_ISCHR(nothing.lstat().st_mode)
