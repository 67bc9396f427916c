"""Replacing files as a whole, and what is no file to replace."""

from __future__ import annotations

import errno
import fcntl
import os
import stat
import threading
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import pytest

from sros_tool import files, folders
from sros_tool.errors import KeystoreError
from sros_tool.files import new_files, replace_file, write_new_file, write_new_folder
from sros_tool.folders import Folder


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


FILES = {"a.xml": b"a", "common/node/b.xml": b"b"}


def test_content_is_on_the_disk_before_its_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A power failure leaves the whole old file or the whole new one."""
    calls: list[str] = []

    def note(module: object, name: str) -> None:
        real = getattr(module, name)

        def noting(*arguments: Any, **options: Any) -> None:
            is_file = name == "fsync" and stat.S_ISREG(os.fstat(arguments[0]).st_mode)
            calls.append(f"{name} of the file" if is_file else name)
            real(*arguments, **options)

        monkeypatch.setattr(module, name, noting)

    for module, name in (
        *((os, name) for name in ("fsync", "replace", "rename")),
        (folders, "flush_file_system"),
    ):
        note(module, name)
    replace_file(tmp_path / "file", b"new")
    assert calls == ["fsync of the file", "replace", "fsync"]
    calls.clear()
    write_new_file(tmp_path / "secret", b"secret")
    assert calls == ["fsync of the file"]
    calls.clear()
    write_new_folder(tmp_path / "folder", FILES)
    assert calls[:2] == ["flush_file_system", "rename"]


def test_a_temporary_file_that_was_removed_before_it_was_locked_is_made_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Another process took it for one that a killed process left."""
    lock, removed = fcntl.flock, list[Path]()

    def lose_the_first(handle: int, how: int) -> None:
        if not removed:
            removed.extend(tmp_path.iterdir())
            removed[0].unlink()
        lock(handle, how)

    monkeypatch.setattr(fcntl, "flock", lose_the_first)
    replace_file(tmp_path / "file", b"new")
    assert removed and tree(tmp_path) == {"file": b"new"}


def test_only_its_owner_can_read_a_new_file_that_is_never_one_of_before(
    tmp_path: Path, free_umask: None
) -> None:
    path = tmp_path / "secret"
    write_new_file(path, b"secret")
    assert (path.read_bytes(), stat.S_IMODE(path.stat().st_mode)) == (b"secret", 0o600)
    with pytest.raises(FileExistsError):
        write_new_file(path, b"another")
    assert path.read_bytes() == b"secret"


def tree(folder: Path) -> dict[str, bytes]:
    return {str(f.relative_to(folder)): f.read_bytes() for f in folder.rglob("*") if f.is_file()}


def test_a_new_folder_is_whole_or_not_there(tmp_path: Path) -> None:
    write_new_folder(tmp_path / "x/new", FILES)
    assert tree(tmp_path / "x/new") == FILES
    assert [each.name for each in (tmp_path / "x").iterdir()] == ["new"]
    with pytest.raises(OSError):
        write_new_folder(tmp_path / "x/new", FILES)
    with pytest.raises(KeystoreError, match="in the way"):
        write_new_folder(tmp_path / "y/new", {**FILES, "a.xml/c": b""})
    assert [each.name for each in tmp_path.iterdir()] == ["x"]
    assert [each.name for each in (tmp_path / "x").iterdir()] == ["new"]


def test_a_file_that_appears_meanwhile_is_not_replaced(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Twin: a file system without hard links."""
    link = Folder.link

    def late(folder: Folder, source: str, target: str) -> None:
        (tmp_path / target).write_bytes(b"of somebody else")
        link(folder, source, target)

    def missing(*_: object) -> None:
        raise OSError(errno.EPERM, os.strerror(errno.EPERM))

    monkeypatch.setattr(Folder, "link", late)
    with pytest.raises(FileExistsError), new_files(tmp_path, {"a": b"a"}):
        raise AssertionError
    assert (tmp_path / "a").read_bytes() == b"of somebody else"
    monkeypatch.setattr(Folder, "link", missing)
    with new_files(tmp_path, {"b": b"b"}):
        assert (tmp_path / "b").read_bytes() == b"b"
    assert sorted(os.listdir(tmp_path)) == ["a", "b"]


def test_new_files_replace_nothing_follow_no_link_and_go_when_the_rest_fails(
    tmp_path: Path,
) -> None:
    inside, outside = tmp_path / "in", tmp_path / "out"
    inside.mkdir()
    outside.mkdir()
    with pytest.raises(ZeroDivisionError), new_files(inside, FILES):
        assert tree(inside) == FILES
        raise ZeroDivisionError
    assert list(inside.iterdir()) == []
    (inside / "common").symlink_to(outside)
    with pytest.raises(KeystoreError, match="symbolic link"), new_files(inside, FILES):
        pass
    (inside / "common").unlink()
    (inside / "a.xml").write_bytes(b"mine")
    with pytest.raises(FileExistsError), new_files(inside, FILES):
        pass
    assert (tree(inside), list(outside.iterdir())) == ({"a.xml": b"mine"}, [])
    with new_files(inside, {"b/c": b"c"}):
        pass
    assert tree(inside) == {"a.xml": b"mine", "b/c": b"c"}


def write_into(folder: Path, contents: Mapping[str, bytes]) -> None:
    folder.mkdir(exist_ok=True)
    with new_files(folder, contents):
        pass


@pytest.mark.parametrize("write", [write_into, write_new_folder])
def test_a_killed_process_leaves_no_part_of_a_new_file(
    write: Callable[[Path, Mapping[str, bytes]], None], tmp_path: Path
) -> None:
    """An empty drop-in of `sros close --apply` would be one that neither it nor --undo knows."""
    inside, child = tmp_path / "in", os.fork()
    if child == 0:
        try:
            die = lambda handle, _: os._exit(os.write(handle, b"x"))  # noqa: E731
            vars(files)["write_all"] = vars(folders)["write_all"] = die
            write(inside, FILES)
        finally:
            os._exit(70)
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 1
    assert [each for each in tree(tmp_path) if ".sros-" not in each] == []
    assert tree(tmp_path), "nothing was written"
    write(inside, FILES)
    assert tree(tmp_path) == {f"in/{path}": data for path, data in FILES.items()}
    assert sorted(each.name for each in inside.iterdir()) == ["a.xml", "common"]
