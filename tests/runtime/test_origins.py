"""What started a process: a unit, a program of several processes, a container."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from sros_tool.runtime.processes import ProcessOrigin, _forked_by, process_origin, program_of

OF_USER = "/user.slice/user-1000.slice/user@1000.service"


@pytest.mark.parametrize(
    ("text", "unit"),
    [
        ("0::/system.slice/robot@3.service\n", "robot@3.service"),
        ("1:name=systemd:/system.slice/system-r.slice/r@3.service\n0::/\n", "r@3.service"),
        (f"0::{OF_USER}/app.slice/x.service\n", "x.service (systemctl --user)"),
        (f"0::{OF_USER}/app.slice/vte-spawn-1.scope\n", ""),  # a terminal
        ("0::/system.slice/../x y.service\n", ""),
        ("0::/system.slice/cron.service\n", ""),  # a line with @reboot
        ("0::/system.slice/system-dropbear.slice/dropbear@1-a:22-b:9.service\n", ""),  # a login
        ("0::/system.slice/robot.service/ssh.service\n", ""),  # with Delegate=yes
        ("0::/system.slice/docker-1.scope/system.slice/ssh.service\n", ""),
        ("0::/\n", ""),
    ],
)
def test_the_unit_of_a_process(tmp_path: Path, text: str, unit: str) -> None:
    made_up(tmp_path, 7, "/opt/talker", parent=1, cgroup=text)
    origin = process_origin(7, tmp_path)
    assert (origin.unit_text, origin.folder) == (unit, "/opt")
    assert origin.unit == unit * (OF_USER not in text), "--apply restarts no unit of a user"
    assert process_origin(8, tmp_path) == ProcessOrigin()


SPAWNED = ("python3", "-c", "from multiprocessing.spawn import spawn_main; spawn_main(4)", "x")


FORKSERVER = ("python3", "-c", "from multiprocessing.forkserver import main; main(4)")


@pytest.mark.parametrize(
    ("commands", "program"),
    [
        ([("/bin/sh",), ("python3", "a.py")], 0),
        ([("/bin/sh",), ("python3", "a.py"), ("python3", "a.py")], 8),
        ([("/opt/a",), ("/opt/a",), ("/opt/a",)], 7),
        ([("/bin/sh",), ("python3.12", "a.py"), SPAWNED], 8),
        ([("python3", "a.py"), FORKSERVER, FORKSERVER], 7),
        ([("/lib/systemd", "--user"), SPAWNED], 0),
    ],
)
def test_the_program_of_a_process(
    tmp_path: Path, commands: list[tuple[str, ...]], program: int
) -> None:
    for pid, command in enumerate(commands, 7):
        made_up(tmp_path, pid, *command, parent=pid - 1 if pid > 7 else 1)
    folder = os.open(tmp_path / str(pid), os.O_RDONLY)
    first = _forked_by(folder, command)
    os.close(folder)
    assert first == (program, commands[program - 7] if program else ())


def test_the_name_of_a_program() -> None:
    """An option of the interpreter, such as -u for logs that are not buffered, is not its name."""
    for command, name in (
        ("python3 eyes.py", "eyes.py"),
        ("/usr/bin/python3.12 -u /opt/eyes.py -v", "eyes.py"),
        ("python3 -P -B -u -m pkg.eyes", "pkg.eyes"),
        ("python3 -c eyes.py", "python3"),
        ("python3 -W error eyes.py", "python3"),
        ("bash -c eyes", "bash"),
        ("sh -u eyes.sh", "eyes.sh"),
        ("/opt/eyes -u eyes.py", "eyes"),
        ("python3 -u", "python3"),
        ("", "?"),
    ):
        assert program_of(tuple(command.split())) == name


@pytest.mark.parametrize(
    "path", ["system.slice/docker-{}.scope", "docker/{}", "machine.slice/libpod-{}.scope/container"]
)
def test_the_container_of_a_process(tmp_path: Path, path: str) -> None:
    made_up(tmp_path, 7, "/opt/talker", parent=1, cgroup=f"0::/{path.format('0af' * 21 + '0')}\n")
    assert process_origin(7, tmp_path) == ProcessOrigin("", "/opt", (), "0af0af0af0af")


NODE = ("/opt/talker", "--ros-args", "--params-file", "/tmp/launch_params_a1_b2c3d")


@pytest.mark.parametrize(
    ("above", "children", "is_launch"),
    [
        (("/usr/bin/python3", "bringup.py"), [NODE], True),
        (("python3.12", "-m", "robot.bringup"), [("/opt/listener",), NODE], True),
        (("python3", "bringup.py"), [("sh", "-c", f"exec {' '.join(NODE)}")], True),
        (("python3", "bringup.py"), [("/opt/listener", "--params-file", "/tmp/own.yaml")], False),
        (("bash", "start.sh"), [NODE], False),
    ],
)
def test_a_program_that_runs_a_launch_description(
    tmp_path: Path, above: tuple[str, ...], children: list[tuple[str, ...]], is_launch: bool
) -> None:
    """launch_ros gives nodes with parameters files that a command cannot name again."""
    made_up(tmp_path, 7, *above, parent=1)
    (tmp_path / "7/task/7").mkdir(parents=True)
    (tmp_path / "7/task/7/children").write_text("8 9 ")
    for pid, command in enumerate(children, 8):
        made_up(tmp_path, pid, *command, parent=7)
    launch = above if is_launch else ()
    assert (
        process_origin(8, tmp_path)
        == process_origin(7, tmp_path)
        == ProcessOrigin("", "/opt", launch)
    )
    (tmp_path / "7/task/7/children").unlink()  # as on kernels without this list
    assert process_origin(pid, tmp_path).launch == launch


def made_up(proc: Path, pid: int, *command: str, parent: int, cgroup: str = "0::/\n") -> None:
    folder = proc / str(pid)
    folder.mkdir()
    (folder / "cgroup").write_text(cgroup)
    (folder / "cwd").symlink_to("/opt")
    (folder / "cmdline").write_text("".join(f"{word}\0" for word in command))
    (folder / "stat").write_text(f"{pid} (x) S {parent} " + "0 " * 30)
