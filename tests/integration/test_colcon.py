"""colcon builds sros in a ROS workspace, whose `ros2 security` comes from sros."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

from sros_tool.xml import parse
from tests.support.checkout import CHECKOUT, known_files
from tests.support.long_form import sometimes

PROJECT = tomllib.loads((CHECKOUT / "pyproject.toml").read_text())["project"]
SECURITY = """
from importlib.metadata import entry_points
print({each.name: each for each in entry_points(group="ros2cli.command")}["security"].value)
"""
"""What ros2cli 0.32 does: entries by name, so it takes the last one (``entry_points.py``)."""

BUILT = sometimes("a workspace is built")
"""Marks the tests of the workspace, which is built for all of them or for none."""


@pytest.fixture(scope="module")
def workspace(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A workspace with the files of this checkout that git knows, built by colcon."""
    pytest.importorskip("colcon_core")
    folder = tmp_path_factory.mktemp("workspace")
    for name in known_files(".", ":!tests", ":!docs", ":!web"):
        place = folder / "src/sros" / name
        place.parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(CHECKOUT / name, place)
    program = "from colcon_core.command import main; import sys; sys.exit(main())"
    command = [sys.executable, "-P", "-c", program, "--log-base", "log", "build"]
    environment = {**os.environ, "COLCON_HOME": str(folder / "home")}
    environment.pop("PYTHONPATH", None)
    built = subprocess.run(
        command, cwd=folder, env=environment, capture_output=True, text=True, check=False
    )
    assert built.returncode == 0, built.stdout + built.stderr
    assert "Finished <<< sros_tool" in built.stdout
    return folder


def sourced(workspace: Path, command: str, **env: str) -> str:
    """Run a command of a shell in the environment of the workspace; return what it prints."""
    environment = {"PATH": f"{Path(sys.executable).parent}:/usr/bin:/bin", **env}
    ended = subprocess.run(
        ["sh", "-c", f". install/setup.sh && {command}"],
        cwd=workspace,
        env=environment,
        capture_output=True,
        text=True,
        check=False,
    )
    assert ended.returncode == 0, ended
    return ended.stdout


@BUILT
def test_the_program_of_the_workspace_works(workspace: Path) -> None:
    assert sourced(workspace, "command -v sros").startswith(f"{workspace}/install/")
    program = "-P -c 'import sros_tool.cli as cli; print(cli.__file__); cli.main()'"
    said = sourced(workspace, f"{sys.executable} {program} policies")
    assert said.startswith(f"{workspace}/install/") and "talker_listener" in said
    keystore = "create_keystore ks --template production"
    sourced(workspace, f"{sys.executable} {program} {keystore}")
    assert (workspace / "ks/enclaves/governance.p7s").is_file()
    assert not list((workspace / "src").rglob("*.egg-info"))


@BUILT
def test_nothing_is_imported_from_the_working_folder(workspace: Path) -> None:
    """An empty part of PYTHONPATH is the working folder, which anybody may own."""
    for before in ({}, {"PYTHONPATH": "/somewhere"}):
        paths = sourced(workspace, 'printf %s "$PYTHONPATH"', **before).split(":")
        assert all(paths) and paths[-1].endswith("/share/sros_tool/ros2_security")
        assert len(paths) == 2 + len(before)


@BUILT
def test_its_ros2_security_is_that_of_sros_where_sros2_is_installed_too(workspace: Path) -> None:
    """A workspace comes first in PYTHONPATH, and ros2cli takes the last entry of a name."""
    sros2 = workspace / "ros/lib/sros2.dist-info"
    sros2.mkdir(parents=True)
    (sros2 / "METADATA").write_text("Metadata-Version: 2.1\nName: sros2\nVersion: 0.13.0\n")
    (sros2 / "entry_points.txt").write_text("[ros2cli.command]\nsecurity = sros2.command:C\n")
    ask, around = f"{sys.executable} -S -c '{SECURITY}'", str(sros2.parent)
    assert sourced(workspace, ask).strip() == "sros_tool.cli.ros2:SecurityCommand"
    said = sourced(workspace, ask, PYTHONPATH=around).strip()
    assert said == "sros_tool.cli.ros2:SecurityCommand"
    without_the_end = f'PYTHONPATH="${{PYTHONPATH%:*}}" {ask}'
    assert sourced(workspace, without_the_end, PYTHONPATH=around).strip() == "sros2.command:C"
    twice = f'. install/setup.sh; echo "$PYTHONPATH"; {ask}'
    path, said = sourced(workspace, twice, PYTHONPATH=around).split()
    assert path.count("/share/sros_tool/ros2_security") == 1
    assert said == "sros_tool.cli.ros2:SecurityCommand"


def test_the_package_is_the_project() -> None:
    """What rosdep installs is what pip would; a version of ROS says no `.dev0`."""
    package = parse((CHECKOUT / "package.xml").read_bytes(), "package")
    text = {each.tag: each.text for each in package if isinstance(each.tag, str)}
    version = PROJECT["version"].removesuffix(".dev0")
    assert (text["name"], text["version"]) == (PROJECT["name"], version)
    assert text["license"] == PROJECT["license"]
    wanted = {each.text for each in package.iter("exec_depend")} - {"ros2cli"}
    packages = {f"python3-{each.split('>')[0]}" for each in PROJECT["dependencies"]}
    assert wanted == packages | {"python3-argcomplete"}
    own = (CHECKOUT / "colcon/entry_points.txt").read_text()
    value = PROJECT["entry-points"]["ros2cli.command"]["security"]
    assert own == f"[ros2cli.command]\nsecurity = {value}\n"
