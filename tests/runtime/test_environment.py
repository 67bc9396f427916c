"""Variables in every form, and the command lines that get the enclave.

Only what is known to start a ROS node gets the enclave on its command line.
"""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from sros_tool.errors import UsageError
from sros_tool.runtime.environment import (
    REFUSING,
    render_environment,
    render_refusal,
    with_enclave,
    without_own_libraries,
)
from tests.support.children import run

ADDED = ("--ros-args", "--enclave", "/arm")


def test_a_command_gets_no_libraries_of_the_wheels_that_sros_runs_with() -> None:
    own, libraries = f"{sys.prefix}/lib/python3/site-packages/ros_fastrtps.libs", "LD_LIBRARY_PATH"
    for folders, kept in ((f"{own}:/opt/ros/lib", {libraries: "/opt/ros/lib"}), (own, {})):
        environment = {"HOME": "/root", libraries: folders}
        assert without_own_libraries(environment) == environment, "set by the user"
        marked = environment | {"_ROS_WHEELS_BOOTSTRAP_COMPLETE": "1"}
        assert without_own_libraries(marked) == {"HOME": "/root", **kept}


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
        "ros2 run rmw_zenoh_cpp rmw_zenohd",
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


PATHS = {
    "plain": "/srv/ks",
    "spaces": "/srv/two  words",
    "quotes": """/srv/it's "so\"""",
    "percent": "/srv/%h %% %n",
    "dollar": "/srv/$HOME ${HOME} $(id) `id`",
    "backslash": "/srv/a\\nb\\\\",
    "comment": "/srv/a #b;c",
    "umlaut": "/srv/ä",
    "newline": "/srv/a\nROS_SECURITY_ENABLE=false",
    "carriage return": "/srv/a\rEnvironment=ROS_SECURITY_ENABLE=false\r",
    "escape": "/srv/a\x1b[2J\x7f\x0b\x85",
    "line separator": "/srv/a\u2028b",
    "ends with a space": "/srv/a ",
    "not UTF-8": "/srv/a\udcff",
}
CONTROLS = {"newline", "carriage return", "escape", "line separator", "not UTF-8"}
INTERPRETED = {"dollar", "comment", "ends with a space"}


def test_a_shell_reads_every_path() -> None:
    for name, path in PATHS.items():
        text = render_environment({"A": path, "B": "end"}, "sh")
        script = 'eval "$1"; printf %s "$A|$B"'
        for shell in filter(shutil.which, ("dash", "bash", "zsh")):
            words = map(os.fsencode, (shell, "-c", script, shell, text))
            done = subprocess.run(list(words), capture_output=True, check=True)
            assert done.stdout == os.fsencode(f"{path}|end"), (name, shell)


@pytest.mark.skipif(not shutil.which("systemd-analyze"), reason="there is no systemd")
def test_systemd_reads_what_it_gets(tmp_path: Path) -> None:
    unit = tmp_path / "node.service"
    places = {f"A{number}": name for number, name in enumerate(PATHS) if name not in CONTROLS}
    text = "".join(
        render_environment({key: PATHS[name]}, "systemd") for key, name in places.items()
    )
    bare = 'Environment="BARE=/srv/a\rInjected=yes"\n'  # what the control characters would do
    unit.write_text(f"[Service]\nType=oneshot\nExecStart=/bin/true\n{text}{bare}")
    env = {**os.environ, "SYSTEMD_LOG_LEVEL": "debug", "LC_ALL": "C.UTF-8"}
    done = run(["systemd-analyze", "verify", "--man=no", unit], status=None, env=env)
    said = done.stdout + done.stderr
    found = dict(re.findall(r"\tEnvironment: (A\d+)=(.*)", said))
    assert found == {key: PATHS[name] for key, name in places.items()}
    assert "Unknown key 'Injected'" in said


@pytest.mark.skipif(not shutil.which("systemd-analyze"), reason="there is no systemd")
def test_systemd_reads_a_refusal_as_variables_and_a_failing_step(tmp_path: Path) -> None:
    unit = tmp_path / "node.service"
    unit.write_text("[Service]\nType=oneshot\nExecStart=/bin/true\n" + render_refusal("systemd"))
    env = {**os.environ, "SYSTEMD_LOG_LEVEL": "debug", "LC_ALL": "C.UTF-8"}
    done = run(["systemd-analyze", "verify", "--man=no", unit], status=None, env=env)
    said = done.stdout + done.stderr
    found = dict(re.findall(r"\tEnvironment: (\w+)=(.*)", said))
    assert {name: found[name] for name in REFUSING} == REFUSING
    assert re.search(r"ExecStartPre:\s+Command Line: /bin/false", said), said
    assert "Unknown key" not in said


def test_docker_reads_what_it_gets() -> None:
    for name in PATHS.keys() - CONTROLS - INTERPRETED:
        assert render_environment({"A": PATHS[name]}, "docker") == f"A={PATHS[name]}\n"


def test_a_program_reads_what_it_gets() -> None:
    for name in PATHS.keys() - {"not UTF-8"}:
        assert json.loads(render_environment({"A": PATHS[name]}, "json")) == {"A": PATHS[name]}


@pytest.mark.parametrize(
    ("form", "names"),
    [
        ("json", {"not UTF-8"}),
        ("systemd", CONTROLS),
        ("docker", CONTROLS | INTERPRETED),
    ],
)
def test_a_form_that_cannot_hold_a_path_refuses_it(form: str, names: set[str]) -> None:
    for name in names:
        with pytest.raises(UsageError):
            render_environment({"A": PATHS[name], "B": "end"}, form)
