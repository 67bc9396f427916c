"""Robots for Ansible: real sshds on addresses of their own, each with a folder for its files.

All of them are processes of this machine, in a network namespace where the system allows it.  What
a robot lacks is systemd: ``systemctl`` is a script that writes down which unit was restarted, and
starts the command of the unit, if it has one.
"""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from sros_tool.parallel import end_with_parent
from sros_tool.runtime.netns import try_isolation
from tests.support.children import PATIENCE, run, wait_for

CHECKOUT = Path(__file__).parents[2]
PORT = 22022
SSHD = "/usr/sbin/sshd"
FAKETIME = next(map(str, Path("/usr/lib").glob("*/faketime/libfaketime.so.1")), "")
"""A library that gives a process another clock, or "" without it."""
PROGRAM = [sys.executable, "-m", "sros_tool"]
MISSING = [
    each
    for each in (SSHD, "ssh-keygen", "ansible-playbook")
    if not shutil.which(each, path=f"{Path(sys.executable).parent}:{os.environ['PATH']}:/usr/sbin")
]
"""Programs that these tests need and that are not here."""

_HOLDER = """
import signal, sys
from sros_tool.parallel import end_with_parent
from sros_tool.runtime.netns import enter_isolation
end_with_parent()
enter_isolation()
print("ready", flush=True)
signal.pause()
"""

_SYSTEMCTL = """#!/bin/sh
# Stands in for systemd, which is not in a container: restart UNIT.
echo "$2" >> '{log}'
unit='{folder}/units/'"$2"
test -x "$unit" || exit 0
if test -f "$unit.pid"; then
    kill "$(cat "$unit.pid")" && tail --pid="$(cat "$unit.pid")" -f /dev/null
fi
setsid "$unit" </dev/null >"$unit.log" 2>&1 &
echo $! > "$unit.pid"
"""


@dataclass
class Robot:
    """A robot: its sshd, and the folder that has its files."""

    name: str
    address: str
    folder: Path
    environment: dict[str, str]
    sshd: subprocess.Popen[bytes] | None = None

    @property
    def keystore(self) -> Path:
        return self.folder / "etc/sros/keystore"

    def restarts(self) -> list[str]:
        """Return the units that were restarted since the last call, in order."""
        log = self.folder / "restarts"
        found = log.read_text().split() if log.exists() else []
        log.unlink(missing_ok=True)
        return found


@dataclass
class Fleet:
    """Robots by name, and how to run Ansible on them.

    ``variables`` are those of the inventory for each robot and for "all", ``extra`` those of every
    command line.
    """

    folder: Path
    keystore: Path
    inside: list[str]
    robots: dict[str, Robot] = field(default_factory=dict)
    variables: dict[str, dict[str, Any]] = field(default_factory=dict)
    extra: dict[str, Any] = field(default_factory=dict)

    def add(self, name: str, environment: Mapping[str, str] | None = None) -> Robot:
        """Make a robot whose sshd runs; ``environment`` holds for all that runs on it."""
        number = len(self.robots) + 1
        folder = self.folder / "robots" / name
        (folder / "bin").mkdir(parents=True)
        (folder / "units").mkdir()
        path = {"PATH": "/usr/local/bin:/usr/bin:/bin"}
        robot = Robot(name, f"127.99.{number >> 8}.{number & 255}", folder, path)
        robot.environment |= environment or {}
        _write(folder / "bin/systemctl", _SYSTEMCTL.format(log=folder / "restarts", folder=folder))
        self.robots[name] = robot
        self.start(name)
        return robot

    def start(self, name: str) -> None:
        """Start the sshd of a robot."""
        robot = self.robots[name]
        assignments = " ".join(f'"{key}={value}"' for key, value in robot.environment.items())
        settings = {
            "Port": PORT,
            "ListenAddress": robot.address,
            "HostKey": self.folder / "host_key",
            "AuthorizedKeysFile": self.folder / "user_key.pub",
            "PidFile": "none",
            "StrictModes": "no",
            "UsePAM": "no",
            "PermitRootLogin": "yes",
            "PasswordAuthentication": "no",
            "MaxStartups": 100,
            "Subsystem": "sftp internal-sftp",
            "SetEnv": assignments,
        }
        text = "".join(f"{key} {value}\n" for key, value in settings.items())
        (robot.folder / "sshd_config").write_text(text)
        with (robot.folder / "sshd.log").open("ab") as log:
            robot.sshd = subprocess.Popen(
                [*self.inside, SSHD, "-D", "-e", "-f", robot.folder / "sshd_config"],
                stderr=log,
                stdout=log,
                start_new_session=True,
                preexec_fn=end_with_parent,  # also if the tests are killed
            )
        wait_for(lambda: "listening" in (robot.folder / "sshd.log").read_text(), "sshd")

    def stop(self, name: str) -> None:
        """End a robot's sshd with all its connections: it cannot be reached any more."""
        robot = self.robots[name]
        assert robot.sshd
        for each in _descendants(robot.sshd.pid):
            _kill(each)
        robot.sshd.wait()
        robot.sshd = None
        (robot.folder / "sshd.log").unlink()

    def inventory(self) -> Path:
        """Write the inventory; return its path."""
        hosts = {
            robot.name: {
                "ansible_host": robot.address,
                "sros_prefix": str(robot.folder),
                "sros_systemctl": [str(robot.folder / "bin/systemctl")],
                **self.variables.get(robot.name, {}),
            }
            for robot in self.robots.values()
        }
        common = {
            "ansible_port": PORT,
            "ansible_user": _user(),
            "ansible_python_interpreter": os.path.realpath(sys.executable),
            "sros_keystore": str(self.keystore),
            "sros_program": PROGRAM,
            **self.variables.get("all", {}),
        }
        path = self.folder / "inventory.json"
        path.write_text(json.dumps({"all": {"hosts": hosts, "vars": common}}))
        return path

    def begin(self, play: str, *words: object, **variables: object) -> subprocess.Popen[str]:
        """Start a play of the collection; the caller finishes it."""
        command = [
            *self.inside,
            str(Path(sys.executable).parent / "ansible-playbook"),
            *("-i", self.inventory(), f"sros.fleet.{play}"),
            *("-e", json.dumps(self.extra | variables)),
            *words,
        ]
        return subprocess.Popen(
            [str(each) for each in command],
            env=self.environment(),
            cwd=self.folder,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            start_new_session=True,
        )

    def play(
        self, play: str, *words: object, status: int | None = 0, **variables: object
    ) -> Played:
        """Run a play of the collection to its end."""
        process = self.begin(play, *words, **variables)
        try:
            out, _ = process.communicate(timeout=len(self.robots) * PATIENCE)
        except subprocess.TimeoutExpired:
            end_all(process)
            raise
        assert status in (None, process.returncode), (
            f"{play} ended with {process.returncode}: {out}"
        )
        return Played(out)

    def environment(self) -> dict[str, str]:
        """Return the environment of Ansible."""
        return {
            **os.environ,
            "PYTHONPATH": str(CHECKOUT),
            "ANSIBLE_CONFIG": str(self.folder / "ansible.cfg"),
            "ANSIBLE_HOME": str(self.folder / ".ansible"),
            "ANSIBLE_COLLECTIONS_PATH": str(CHECKOUT),
            "LC_ALL": "C.UTF-8",
        }


@dataclass(frozen=True)
class Played:
    """What a play printed, and its recap by host."""

    text: str

    @property
    def recap(self) -> dict[str, dict[str, int]]:
        """Map each host to its numbers of tasks: ok, changed, unreachable, failed."""
        _, _, lines = self.text.partition("PLAY RECAP")
        found = {}
        for line in lines.splitlines()[1:]:
            name, colon, numbers = line.partition(" : ")
            if colon:
                pairs = (each.split("=") for each in numbers.split())
                found[name.strip()] = {key: int(value) for key, value in pairs}
        return found

    @property
    def changed(self) -> set[str]:
        """The hosts on which something changed."""
        return {name for name, numbers in self.recap.items() if numbers["changed"]}


@contextmanager
def fleet(folder: Path, keystore: Path) -> Iterator[Fleet]:
    """Yield a fleet without robots; at the end all its processes end."""
    Path("/run/sshd").mkdir(exist_ok=True)
    for name in ("host_key", "user_key"):
        run(["ssh-keygen", "-q", "-t", "ed25519", "-N", "", "-f", folder / name])
    host = (folder / "host_key.pub").read_text()
    (folder / "known_hosts").write_text(f"* {host}")
    options = {
        "IdentityFile": folder / "user_key",
        "UserKnownHostsFile": folder / "known_hosts",
        "IdentitiesOnly": "yes",
        "ControlMaster": "auto",
        "ControlPersist": "20s",
    }
    words = " ".join(f"-o {key}={value}" for key, value in options.items())
    (folder / "ansible.cfg").write_text(
        "[defaults]\nforks = 20\ninternal_poll_interval = 0.05\ntimeout = 60\n"
        "retry_files_enabled = false\nnocows = true\n"
        f"[ssh_connection]\npipelining = true\nssh_args = -F none {words}\n"
        f"control_path_dir = {folder}/cp\n"
    )
    with _network() as inside:
        made = Fleet(folder, keystore, inside)
        try:
            yield made
        finally:
            for name, robot in made.robots.items():
                for pid in robot.folder.glob("units/*.pid"):
                    _kill(int(pid.read_text()))
                if robot.sshd:
                    made.stop(name)


@contextmanager
def _network() -> Iterator[list[str]]:
    """Yield the words that begin a command in a network of the fleet's own, if there can be one."""
    if os.geteuid() != 0 or not shutil.which("nsenter") or not try_isolation().isolated:
        yield []
        return
    holder = subprocess.Popen(
        [sys.executable, "-c", _HOLDER],
        env={**os.environ, "PYTHONPATH": str(CHECKOUT)},
        stdout=subprocess.PIPE,
        text=True,
    )
    try:
        assert holder.stdout and holder.stdout.readline() == "ready\n"
        yield ["nsenter", "--target", str(holder.pid), "--net", "--"]
    finally:
        holder.kill()
        holder.wait()


def _descendants(pid: int) -> list[int]:
    """Return a process and all below it, the lowest first."""
    children: list[int] = []
    for task in Path(f"/proc/{pid}/task").glob("*/children"):
        children += map(int, task.read_text().split())
    return [*(below for each in children for below in _descendants(each)), pid]


def end_all(process: subprocess.Popen[str]) -> None:
    """Kill a play with everything that it started here, as a crash of this machine would."""
    for each in _descendants(process.pid):
        _kill(each)
    process.communicate()


def _kill(pid: int) -> None:
    try:
        os.kill(pid, signal.SIGKILL)
    except ProcessLookupError:
        return


def _write(path: Path, text: str) -> None:
    path.write_text(text)
    path.chmod(0o755)


def _user() -> str:
    import pwd

    return pwd.getpwuid(os.getuid()).pw_name


def names(number: int) -> Sequence[str]:
    """Return the names of robots."""
    return [f"r{each}" for each in range(1, number + 1)]
