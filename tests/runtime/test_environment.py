"""Only what is known to start a ROS node gets the enclave on its command line."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

from sros_tool.runtime.environment import with_enclave

ADDED = ("--ros-args", "--enclave", "/arm")


@pytest.fixture
def prefix(tmp_path: Path) -> Path:
    """A ROS installation with one package that has two executables."""
    (tmp_path / "share/arm").mkdir(parents=True)
    (tmp_path / "share/arm/package.xml").write_text("<package/>")
    for name in ("lib/arm/driver", "lib/arm/node.py", "lib/other/driver", "bin/driver"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text("#!/bin/sh\necho $*\n")
        (tmp_path / name).chmod(0o755)
    return tmp_path


@pytest.mark.parametrize(
    "command",
    [
        "ros2 run arm driver",
        "ros2 run --prefix gdb arm driver --speed 3",
        "/opt/ros/jazzy/bin/ros2 run arm driver --ros-args -r a:=b",
        "my_node --ros-args -p x:=1 -- file",
        "{prefix}/lib/arm/driver --speed 3",
        "python3 {prefix}/lib/arm/node.py",
    ],
)
def test_a_ros_node(command: str, prefix: Path) -> None:
    words = tuple(command.format(prefix=prefix).split())
    assert with_enclave(words, "/arm") == (*words, *ADDED)


@pytest.mark.parametrize(
    "command",
    [
        "ros2 launch arm robot.launch.py",
        "ros2 launch arm robot.launch.py --ros-args",
        "ros2 topic echo /x",
        "ros2 run",
        "ros2 run arm",
        "ros2 run --help arm driver",
        "ros2 run arm driver --ros-args --enclave /leg",
        "ros2 run arm driver --ros-args -e /leg",
        "python3 node.py",
        "python3 -m arm.node",
        "python3",
        "{prefix}/lib/other/driver",
        "{prefix}/bin/driver",
        "{prefix}/lib/arm/nothing",
        "env",
        "sh -c ls",
    ],
)
def test_anything_else_stays_as_it_is(command: str, prefix: Path) -> None:
    words = tuple(command.format(prefix=prefix).split())
    assert with_enclave(words, "/arm") == words


def test_the_program_under_test_is_no_node() -> None:
    words = (sys.executable, "-m", "sros_tool")
    assert with_enclave(words, "/arm") == words
