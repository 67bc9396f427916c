"""Robots that fetch, each a machine of its own behind one address, and home with a real nginx.

Each robot is a namespace of processes, mounts and network; its network ends at a street, which
replaces the robots' addresses by its own towards home, as the router of a site does.  Two nodes of
Cyclone DDS run on each robot, a talker and a listener, each in its own enclave.
"""

from __future__ import annotations

import hashlib
import json
import os
import random
import re
import shlex
import shutil
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from sros_tool.parallel import end_with_parent
from sros_tool.runtime.events import EventKind, read_events
from tests.integration.robots import FAKETIME
from tests.support.children import importing, run, wait_for
from tests.support.harness import Ended, sros
from tests.support.nginx import NGINX, certify_server, nginx_of_page

MISSING = [
    program
    for program in (NGINX, "ip", "nft", "nsenter", "unshare")
    if not shutil.which(program, path=f"{os.environ['PATH']}:/usr/sbin")
]
MISSING += [] if FAKETIME else ["libfaketime"]
"""Programs that these robots need and that are not here."""

HOME_ADDRESS = "203.0.113.1"
STREET_ADDRESS = "203.0.113.2"
ROLES = {"base": "talker", "lift": "listener"}
"""The enclaves of a robot, and which node runs in each."""

_SYSTEMCTL = """#!/bin/sh
# Stands in for systemd, which is not in a namespace: restart UNIT.
test "$1" = restart || exit 0
unit='{folder}/units/'"${{2%.service}}"
test -f "$unit.pid" && kill -9 "$(cat "$unit.pid")"
setsid "$unit" </dev/null >>"$unit.log" 2>&1 &
echo $! > "$unit.pid"
"""


class Namespaces:
    """Namespaces that last as long as a process in them, and the words that enter them."""

    def __init__(self, *kinds: str) -> None:
        command = ["unshare", *kinds, "--kill-child", "--fork", "sh", "-c"]
        self._first = subprocess.Popen(
            [*command, "ip link set lo up; echo; exec sleep infinity"],
            stdout=subprocess.PIPE,
            preexec_fn=end_with_parent,
        )
        assert self._first.stdout and self._first.stdout.readline()
        children = Path(f"/proc/{self._first.pid}/task/{self._first.pid}/children")
        self.pid = int(children.read_text().split()[0])
        self.enter = ["nsenter", "--target", str(self.pid), "--net", "--pid", "--mount"]

    def run(self, *words: object) -> None:
        """Run a program in them; it must succeed."""
        run([*self.enter, *words])

    def end(self) -> None:
        """End all processes in them."""
        self._first.kill()
        self._first.wait()


@dataclass
class Robot:
    """A robot: its folders, its agent, and its two nodes."""

    name: str
    folder: Path
    machine: Namespaces
    agent: subprocess.Popen[bytes] | None = None

    @property
    def keystore(self) -> Path:
        return self.disk / "keystore"

    @property
    def disk(self) -> Path:
        """Return the folder of the keystore's file system."""
        return self.folder / "disk"

    def start(self, *words: str, behind: str = "") -> subprocess.Popen[bytes]:
        """Start the agent, with a clock that is ``behind``, such as "2d"."""
        clock = {"LD_PRELOAD": FAKETIME, "FAKETIME": f"-{behind}"} if behind else {}
        command = [*self.machine.enter, sys.executable, "-m", "sros_tool", "agent", "run"]
        with (self.folder / "agent.log").open("ab") as log:
            self.agent = subprocess.Popen(
                [*command, str(self.keystore), *(words or ("--interval", "5s"))],
                env=importing(**clock),
                stdout=log,
                stderr=log,
                start_new_session=True,
                preexec_fn=end_with_parent,
            )
        return self.agent

    def signal(self, number: signal.Signals) -> None:
        """Send a signal to the agent and its children."""
        if self.agent:
            with suppress(ProcessLookupError):
                os.killpg(self.agent.pid, number)

    def stop(self) -> None:
        """Kill the agent."""
        self.signal(signal.SIGKILL)
        if self.agent:
            self.agent.wait()

    def write_units(self) -> None:
        """Write what the stand-in for systemd starts."""
        (self.folder / "units").mkdir()
        script = self.folder / "systemctl"
        script.write_text(_SYSTEMCTL.format(folder=self.folder))
        script.chmod(0o755)
        for part, role in ROLES.items():
            variables = {
                "PYTHONPATH": os.pathsep.join(filter(None, sys.path)),
                "ROS_SECURITY_KEYSTORE": str(self.keystore),
                "ROS_SECURITY_ENABLE": "true",
                "ROS_SECURITY_STRATEGY": "Enforce",
                "ROS_SECURITY_ENCLAVE_OVERRIDE": f"/{self.name}/{part}",
                "ROS_DOMAIN_ID": "0",
            }
            words = [sys.executable, "-m", "sros_tool.demo.cyclone_node", role]
            words += ["--topic", "/chatter", "--report", str(self.report(part))]
            exports = "".join(
                f"export {name}={shlex.quote(variables[name])}\n" for name in variables
            )
            unit = self.folder / "units" / part
            unit.write_text(f"#!/bin/sh\n{exports}exec {shlex.join(words)}\n")
            unit.chmod(0o755)

    def report(self, part: str) -> Path:
        """Return the file to which a node writes its events."""
        return self.folder / "units" / f"{part}.report"

    def heard(self) -> int:
        """Return how many messages the listener has heard."""
        path = self.report("lift")
        events = read_events(path) if path.exists() else []
        return sum(event.kind is EventKind.HEARD for event in events)

    def old_processes(self) -> list[str]:
        """Return the enclaves whose node started before a file of theirs was written."""
        old = []
        for part in ROLES:
            pid = int((self.folder / "units" / f"{part}.pid").read_text())
            name = Path(f"/proc/{_pid_outside(self.machine.pid, pid)}")
            written = max(
                path.stat().st_mtime
                for path in (self.keystore / "enclaves" / self.name / part).iterdir()
                if path.name != "key.pem"
            )
            if _started(name) < written - 1:
                old.append(part)
        return old


@dataclass
class Home:
    """Home: a keystore, what is published, the inbox, and nginx of docs/howto/fleet_server.md."""

    folder: Path
    robots: dict[str, Robot] = field(default_factory=dict)
    lies: list[str] = field(default_factory=list)
    """Robots that were called current and were not."""
    server: Sequence[str] = ()
    """The command of nginx."""

    def sros(self, *words: object) -> Ended:
        return sros(*words, cwd=self.folder)

    def publish(self) -> None:
        self.sros("fleet", "publish", "keystore", "srv/pub").ok()

    def states(self) -> dict[str, str]:
        """Take in what robots sent; return the state of each, after comparing it with the truth."""
        copies = {
            self.folder / "keystore/public" / name: self.folder / "etc" / name
            for name in ("identity_ca.cert.pem", "identity_ca.crl.pem")
        }
        if any(file.read_bytes() != copy.read_bytes() for file, copy in copies.items()):
            for file, copy in copies.items():
                shutil.copy(file, copy)
            self.nginx("-s", "reload")
        self.sros("fleet", "collect", "keystore", "srv/inbox", "--publish", "srv/pub")
        said: dict[str, Any] = json.loads(self.sros("fleet", "status", "keystore", "--json").out)
        states = {robot["robot"]: robot["state"] for robot in said["robots"]}
        for name, state in states.items():
            if state == "current" and (untrue := self._untrue(self.robots[name])):
                self.lies.append(f"{name}: {untrue}")
        return states

    def _untrue(self, robot: Robot) -> str:
        """Return why a robot is not current: by its files and its processes themselves."""
        place = self.folder / "should-be"
        shutil.rmtree(place, ignore_errors=True)
        self.sros("distribute_key", "keystore", "--robot", robot.name, place).ok()
        if _digests(place) != _digests(robot.keystore):
            return "other files"
        return f"older processes: {old}" if (old := robot.old_processes()) else ""

    def until_current(self, names: Sequence[str]) -> dict[str, str]:
        """Wait until these robots are current, and their listeners hear their talkers."""
        last: dict[str, str] = {}

        def all_are() -> bool:
            last.update(self.states())
            return all(last[name] == "current" for name in names)

        wait_for(all_are, f"{names} current", words=lambda: (last, self._logs()))
        for name in names:
            robot = self.robots[name]
            enough = robot.heard() + 3
            wait_for(lambda: robot.heard() >= enough, f"{name} hears")  # noqa: B023 - called here
        return last

    def _logs(self) -> str:
        logs = [(robot.folder / "agent.log").read_text()[-400:] for robot in self.robots.values()]
        return "\n".join(logs)

    def nginx(self, *words: str) -> None:
        """Run nginx in the network of home."""
        run([*self.network.enter, *self.server, *words])

    network: Namespaces = field(init=False)

    def add(self, number: int, street: Namespaces, *, small: bool = False) -> Robot:
        """Deliver a robot, ``small`` on a disk of 1 MB, and set up its agent."""
        name = f"r{number}"
        folder = self.folder / "robots" / name
        (folder / "disk").mkdir(parents=True)
        if small:
            run(["mount", "-t", "tmpfs", "-o", "size=1m", "robot", folder / "disk"])
        machine = Namespaces("--net", "--pid", "--mount-proc")
        link = f"to-{name}"
        peer = ("type", "veth", "peer", "name", "eth0", "netns", str(machine.pid))
        street.run("ip", "link", "add", link, *peer)
        street.run("ip", "addr", "add", f"10.7.{number}.1/24", "dev", link)
        street.run("ip", "link", "set", link, "up")
        machine.run("ip", "addr", "add", f"10.7.{number}.2/24", "dev", "eth0")
        machine.run("ip", "link", "set", "eth0", "up", "multicast", "on")
        machine.run("ip", "route", "add", "default", "via", f"10.7.{number}.1")
        robot = Robot(name, folder, machine)
        self.robots[name] = robot
        robot.write_units()
        self.sros("distribute_key", "keystore", "--robot", name, robot.keystore).ok()
        units = [f"--unit={part}.service=/{name}/{part}" for part in ROLES]
        self.sros(
            *("agent", "init", robot.keystore, "--robot", name, *units, "--restart"),
            *("--from", f"https://{HOME_ADDRESS}/pub", "--inbox", f"https://{HOME_ADDRESS}/inbox"),
            *("--root", self.folder / "srv/pub/metadata/1.root.json"),
            *("--tls-ca", self.folder / "etc/server.cert.pem"),
            *("--systemctl", robot.folder / "systemctl"),
        ).ok()
        for part in ROLES:
            machine.run(robot.folder / "systemctl", "restart", f"{part}.service")
        return robot


@contextmanager
def fetching_robots(folder: Path, number: int, small: str) -> Iterator[Home]:
    """Home with a keystore and what it published, and its robots, delivered but without an agent.

    The robot ``small`` has its files on a disk of 1 MB.
    """
    home = Home(folder)
    home.network, street = Namespaces("--net"), Namespaces("--net")
    try:
        _connect(home.network, street)
        _serve(home)
        for each in range(1, number + 1):
            home.add(each, street, small=f"r{each}" == small)
        yield home
    finally:
        for robot in home.robots.values():
            robot.machine.end()
        with suppress(AssertionError):
            home.nginx("-s", "stop")
        for namespaces in (home.network, street):
            namespaces.end()
        if small in home.robots:
            run(["umount", "--lazy", home.robots[small].disk], status=None)


def _connect(home: Namespaces, street: Namespaces) -> None:
    """Connect home with the street, behind which all robots have one address."""
    peer = ("type", "veth", "peer", "name", "home", "netns", str(street.pid))
    home.run("ip", "link", "add", "street", *peer)
    for namespaces, link, address in (
        (home, "street", HOME_ADDRESS),
        (street, "home", STREET_ADDRESS),
    ):
        namespaces.run("ip", "addr", "add", f"{address}/24", "dev", link)
        namespaces.run("ip", "link", "set", link, "up")
    # /proc/sys shows the network of the process that opens it.
    street.run("sh", "-c", "echo 1 > /proc/sys/net/ipv4/ip_forward")
    hook = "{ type nat hook postrouting priority 100; }"
    street.run(
        "nft", f"add table ip t; add chain ip t c {hook}; add rule ip t c oifname home masquerade"
    )


def _serve(home: Home) -> None:
    """Start nginx as docs/howto/fleet_server.md says, with the paths of this folder."""
    certify_server(home.folder, home.folder / "keystore", HOME_ADDRESS)
    home.server = nginx_of_page(home.folder, home.folder / "nginx")
    home.nginx()


@contextmanager
def killed_at_random(robot: Robot) -> Iterator[list[int]]:
    """While it is open, start the agent of a robot again and again, and kill most of its rounds.

    Yields the numbers of rounds that were killed and that ended.
    """
    counts = [0, 0]
    over = threading.Event()

    def play() -> None:
        while not over.is_set():
            agent = robot.start("--once")
            try:
                agent.wait(random.uniform(0.3, 8))
                counts[1] += 1
            except subprocess.TimeoutExpired:
                robot.stop()
                counts[0] += 1

    thread = threading.Thread(target=play)
    thread.start()
    try:
        yield counts
    finally:
        over.set()
        thread.join()


def fill(folder: Path) -> Callable[[], None]:
    """Fill the disk of a folder; return what makes room again."""
    path = folder / "filler"
    with suppress(OSError), path.open("wb", buffering=0) as file:
        while True:
            file.write(bytes(512))
    return path.unlink


def _digests(keystore: Path) -> dict[str, str]:
    """Return the SHA-256 of the files of enclaves, without their keys."""
    enclaves = keystore / "enclaves"
    paths = [path for path in enclaves.rglob("*") if path.is_file() and path.name != "key.pem"]
    return {str(p.relative_to(enclaves)): hashlib.sha256(p.read_bytes()).hexdigest() for p in paths}


def _pid_outside(first: int, inside: int) -> int:
    """Return the number of a process here which in the namespace of ``first`` has another one."""
    space = os.readlink(f"/proc/{first}/ns/pid")
    for path in Path("/proc").glob("[0-9]*"):
        with suppress(OSError):
            if os.readlink(path / "ns/pid") != space:
                continue
            (line,) = re.findall(r"^NSpid:(.*)$", (path / "status").read_text(), re.MULTILINE)
            if int(line.split()[-1]) == inside:
                return int(path.name)
    raise AssertionError(f"no process {inside} there")


def _started(process: Path) -> float:
    """Return when a process started, in seconds since the epoch."""
    ticks = int((process / "stat").read_text().rpartition(")")[2].split()[19])
    (boot,) = re.findall(r"^btime (\d+)$", Path("/proc/stat").read_text(), re.MULTILINE)
    return float(int(boot) + ticks / os.sysconf("SC_CLK_TCK"))
