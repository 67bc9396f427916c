"""Tells whether a command starts a ROS node, and names the enclave on its command line.

ROS_SECURITY_ENCLAVE_OVERRIDE secures a process, and the ROS graph does not show it; what it shows
is the enclave of ``--ros-args --enclave`` (rcl, security.c and context.c).
"""

from __future__ import annotations

import re
import shutil
from collections.abc import Sequence
from pathlib import Path

_ROS_ARGS = "--ros-args"
_ENCLAVE = re.compile(r"(?:-e|--enclave)\Z")
_PYTHON = re.compile(r"python[\d.]*\Z")


def with_enclave(command: Sequence[str], enclave: str) -> tuple[str, ...]:
    """The command with ``--ros-args --enclave``, if it is known to start a ROS node.

    Known are ``ros2 run``, an executable of a ROS package (``lib/PACKAGE/NAME``), also of Python,
    and whatever has ``--ros-args`` already.  A command that names an enclave keeps it.
    """
    command = tuple(command)
    if Path(command[0]).name == "ros2" and not _is_ros2_run(command):
        return command
    ros_args = command[command.index(_ROS_ARGS) :] if _ROS_ARGS in command else ()
    if any(_ENCLAVE.match(word) for word in ros_args):
        return command
    if ros_args or _is_ros2_run(command) or _is_of_package(command):
        return (*command, _ROS_ARGS, "--enclave", enclave)
    return command


def _is_ros2_run(command: Sequence[str]) -> bool:
    """Whether it is ``ros2 run [--prefix PREFIX] PACKAGE EXECUTABLE ...``."""
    if Path(command[0]).name != "ros2" or tuple(command[1:2]) != ("run",):
        return False
    words = list(command[2:])
    if words[:1] == ["--prefix"]:
        words = words[2:]
    elif words and words[0].startswith("--prefix="):
        words = words[1:]
    return len(words) >= 2 and not any(word.startswith("-") for word in words[:2])


def _is_of_package(command: Sequence[str]) -> bool:
    """Whether the program, or the script that Python runs, is installed by a ROS package."""
    script = command[1] if _PYTHON.match(Path(command[0]).name) and len(command) > 1 else ""
    path = Path(script or shutil.which(command[0]) or command[0])
    if path.parent.parent.name != "lib" or not path.is_file():
        return False
    prefix, package = path.parent.parent.parent, path.parent.name
    return (prefix / "share" / package / "package.xml").is_file()
