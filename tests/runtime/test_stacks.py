"""Where stacks are looked for."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path

import pytest

from sros_tool.errors import UnavailableError
from sros_tool.runtime import netns, stacks
from sros_tool.runtime.cyclone import FOLDER_VARIABLE, load_cyclone, version_of
from sros_tool.runtime.rmw import rmw_implementations
from tests.support.children import python
from tests.support.zenoh_configurations import with_rmw_zenoh


def index(prefix: Path, *names: str) -> Path:
    folder = prefix / "share/ament_index/resource_index/rmw_typesupport"
    folder.mkdir(parents=True)
    for name in names:
        (folder / name).touch()
    return prefix


def test_rmws_of_all_prefixes_the_preferred_first(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys, "prefix", str(tmp_path / "none"))
    one = index(tmp_path / "one", "rmw_implementation", "rmw_fastrtps_cpp", "rmw_connextdds")
    two = index(tmp_path / "two", "rmw_cyclonedds_cpp")
    variables = {"AMENT_PREFIX_PATH": f"{one}:{two}:"}
    assert rmw_implementations(variables) == (
        "rmw_fastrtps_cpp",
        "rmw_connextdds",
        "rmw_cyclonedds_cpp",
    )
    variables["RMW_IMPLEMENTATION"] = "rmw_cyclonedds_cpp"
    assert rmw_implementations(variables)[0] == "rmw_cyclonedds_cpp"
    assert rmw_implementations({}) == ()


@pytest.mark.parametrize(
    ("name", "version"),
    [("libddsc.so.0.10.2", "0.10.2"), ("libddsc.so.11.0.1", "11.0.1"), ("libddsc.so", "of unkn")],
)
def test_versions(name: str, version: str, tmp_path: Path) -> None:
    path = tmp_path / name
    path.touch()
    assert version_of(path).startswith(version)


def test_the_version_of_a_copied_link(tmp_path: Path) -> None:
    for name in ("libx.so.2.14", "libx.so.2.14.5"):
        (tmp_path / name).write_bytes(b"same")
    assert version_of(tmp_path / "libx.so.2.14") == "2.14.5"


@pytest.fixture
def fresh(monkeypatch: pytest.MonkeyPatch) -> None:
    load_cyclone.cache_clear()


@pytest.mark.usefixtures("fresh")
def test_a_named_folder_without_a_library(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(FOLDER_VARIABLE, str(tmp_path))
    with pytest.raises(UnavailableError, match="cannot find Cyclone DDS"):
        load_cyclone()


@pytest.mark.usefixtures("fresh")
def test_a_file_that_is_no_library(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "lib").mkdir()
    (tmp_path / "lib" / "libddsc.so.0.10.2").write_text("no")
    monkeypatch.setenv(FOLDER_VARIABLE, str(tmp_path))
    with pytest.raises(UnavailableError, match="cannot load"):
        load_cyclone()


def test_an_isolation_that_is_not_to_be_had_says_why(monkeypatch: pytest.MonkeyPatch) -> None:
    def deny() -> None:
        raise OSError(1, "Operation not permitted")

    monkeypatch.setattr(netns, "enter_isolation", deny)
    isolation = netns.try_isolation()
    assert not isolation.isolated
    assert isolation.reason.endswith("Operation not permitted")


@pytest.mark.parametrize(
    ("version", "advice"),
    [("0.10.5", "It enforces the files"), ("0.2.2", "which rmw_zenoh_cpp has since 0.2.3")],
)
def test_the_release_of_rmw_zenoh_is_said(
    version: str, advice: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: name)
    monkeypatch.setattr(stacks, "_run_probe", lambda *_: stacks.ProbeRun((), "", 1))
    monkeypatch.setattr(sys, "prefix", str(tmp_path / "none"))
    monkeypatch.setenv("AMENT_PREFIX_PATH", with_rmw_zenoh(tmp_path, version)["AMENT_PREFIX_PATH"])
    [stack] = stacks.rclpy_stacks(stacks.ProbeEnclave({}, "/a", "/b"))
    assert stack.dds == "Zenoh" and f"(rmw_zenoh_cpp {version}, as in ROS 2 " in stack.version
    assert advice in stack.advice


def test_importing_loads_no_library() -> None:
    code = (
        "import sros_tool.runtime.cyclone, sros_tool.runtime.stacks, sros_tool.demo.program;"
        "print(open('/proc/self/maps').read().count('libddsc'))"
    )
    done = python("-c", code)
    assert done.stdout.strip() == "0"
