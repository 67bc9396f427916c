"""Bring about processes in every state, and tell what `sros check runtime` says of each.

Most of them run from the export of one keystore.
"""

from __future__ import annotations

import json
import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from sros_tool.files import templates_dir
from sros_tool.parallel import end_with_parent
from sros_tool.runtime.environment import secured_environment
from sros_tool.runtime.events import EventKind, read_events
from sros_tool.runtime.netns import enter_isolation
from sros_tool.runtime.rmw import RMW
from tests.support.children import LONG, importing, wait_for
from tests.support.harness import Running, policy_text, publish, sros

DOMAIN = 0
FILES = {
    "identity_ca": "identity_ca.cert.pem",
    "permissions_ca": "permissions_ca.cert.pem",
    "certificate": "cert.pem",
    "key": "key.pem",
    "governance": "governance.p7s",
    "permissions": "permissions.p7s",
    "crl": "crl.pem",
}
"""The files that a process loads: the one of the enclave of this name is replaced."""
OTHERS = ("fine", "expired", "wrapped", "revoked", "permissive", "elsewhere", "named", "removed")
QUIET = ("sh", "-c", "read line", "talker", "--ros-args")
"""A process that looks like a node and costs nothing; it ends with its standard input."""
TALKER = (sys.executable, "-m", "sros_tool.demo.cyclone_node", "talker")


@dataclass
class Started:
    """The processes by their names, and the folder in which they report."""

    folder: Path
    command: tuple[str, ...] = TALKER
    children: dict[str, subprocess.Popen[bytes]] = field(default_factory=dict)

    def start(
        self,
        name: str,
        environment: Mapping[str, str],
        *,
        through: Sequence[str] = (),
        arguments: Sequence[str] = (),
        dds: bool = False,
        first: Callable[[], None] | None = None,
    ) -> None:
        report = self.folder / f"{name}.jsonl"
        report.touch()
        command = [*QUIET, *arguments]
        if dds or LONG:
            command = [*self.command, "--report", str(report), *arguments]

        def begin() -> None:
            end_with_parent()
            if first:
                first()

        clean = {k: v for k, v in importing().items() if not k.startswith(("ROS_", "RMW_"))}
        self.children[name] = subprocess.Popen(
            [*through, *command],
            env={**clean, RMW: "rmw_cyclonedds_cpp", "ROS_DOMAIN_ID": str(DOMAIN), **environment},
            stdin=subprocess.PIPE,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            preexec_fn=begin,
        )

    def wait(self) -> None:
        for name in self.children:
            report = self.folder / f"{name}.jsonl"
            if "--report" in self.children[name].args:  # type: ignore[operator]
                wait_for(lambda report=report: _is_ready(report), f"{name} ready")  # type: ignore[misc]

    def pids(self) -> dict[int, str]:
        """The process ids, with that of the node below a wrapper, and their names."""
        found = {child.pid: name for name, child in self.children.items()}
        for path in Path("/proc").glob("[0-9]*/stat"):
            try:
                parent = int(path.read_text().rpartition(")")[2].split()[1])
            except OSError:
                continue
            if parent in found:
                found[int(path.parent.name)] = found[parent]
        return found

    def end(self) -> None:
        for pid in self.pids():  # also the node below a wrapper, which outlives it
            with suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)
        for child in self.children.values():
            child.wait()


def _is_ready(report: Path) -> bool:
    return any(event.kind is EventKind.READY for event in read_events(report))


def make_keystores(folder: Path) -> tuple[Path, Path, Path]:
    """A keystore, an export of its enclaves, and one of another keystore."""
    names = (*FILES, *OTHERS)
    (folder / "p.xml").write_text(policy_text({f"/{name}": publish("/chatter") for name in names}))
    template = (templates_dir() / "production.toml").read_text()
    (folder / "short.toml").write_text(template.replace("names = [", 'names = ["/expired", '))
    sros("create_keystore", "home", "--template", "short.toml", cwd=folder).ok()
    sros("generate_artifacts", "-k", "home", "-p", "p.xml", "-e", "/gone", cwd=folder).ok()
    sros("revoke", "home", "/gone", cwd=folder).ok()  # so that there is a revocation list
    sros("distribute_key", "home", *(f"/{name}" for name in names), "robot", cwd=folder).ok()
    (folder / "q.xml").write_text(policy_text({"/stranger": publish("/chatter")}))
    sros("generate_artifacts", "-k", "strange", "-p", "q.xml", cwd=folder).ok()
    return folder / "home", folder / "robot", folder / "strange"


def start_all(started: Started, home: Path, robot: Path, strange: Path) -> None:
    def of(name: str, root: Path = robot, **more: str) -> dict[str, str]:
        return {**secured_environment(root, f"/{name}", DOMAIN), **more}

    started.start("fine", of("fine"), dds=True)
    for name in (*FILES, "expired", "removed"):
        started.start(name, of(name))
    named = ("--enclave", "/named") if not LONG else ("--ros-args", "--enclave", "/named")
    started.start("named", of("named", ROS_SECURITY_ENCLAVE_OVERRIDE=""), arguments=named)
    started.start("revoked", of("revoked", home), dds=True)
    started.start("permissive", of("permissive", ROS_SECURITY_STRATEGY="Permissive"))
    started.start("unsecured", of("nowhere", ROS_SECURITY_STRATEGY="Permissive"))
    started.start("open", {}, dds=True)
    started.start("stranger", of("stranger", strange), dds=True)
    started.start("elsewhere", of("elsewhere"), first=enter_isolation)
    run = (sys.executable, "-m", "sros_tool", "run", str(robot), "/wrapped", "--")
    started.start("wrapped", {}, through=("timeout", "600", *run), dds=True)
    started.wait()


def change_files(home: Path, robot: Path) -> None:
    """Replace a file of each kind, with its time of writing, and revoke and remove enclaves."""
    for name, file in (*FILES.items(), ("named", "cert.pem")):
        path = robot / "enclaves" / name / file
        shutil.copy2(path, path.with_suffix(".new"))
        path.with_suffix(".new").replace(path)
    shutil.rmtree(robot / "enclaves/removed")
    sros("revoke", home, "/revoked").ok()


def by_process(
    findings: Sequence[Mapping[str, str]], names: Mapping[int, str]
) -> dict[str, dict[str, str]]:
    """Map the processes' names to the ids and texts of the findings about each."""
    found: dict[str, dict[str, str]] = defaultdict(dict)
    for each in findings:
        for pid in re.findall(r"process (\d+) ", each["subject"]):
            if int(pid) in names:
                found[names[int(pid)]][each["id"]] = each["text"]
    return dict(found)


class Watching:
    """`sros check runtime --watch --json`, and what it has said so far."""

    def __init__(self) -> None:
        self._running = Running("check", "runtime", "--watch", "--json")

    def changes(self, names: Mapping[int, str]) -> list[tuple[str, str, str]]:
        """What became of which process with which finding."""
        found = []
        for line in self._running.out.split("\n")[:-1]:
            change = json.loads(line)
            for name in by_process([change["finding"]], names):
                found.append((change["change"], name, change["finding"]["id"]))
        return found

    def end(self) -> tuple[int, str]:
        self._running.terminate()
        ended = self._running.end()
        return ended.status, ended.err


def play() -> dict[str, Any]:
    """Return the ids of the findings about each process, with their texts; for a network apart."""
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        home, robot, strange = make_keystores(folder)
        started = Started(folder)
        try:
            start_all(started, home, robot, strange)
            watching = Watching()
            wait_for(lambda: watching.changes(started.pids()), "the first changes")
            change_files(home, robot)
            said = sros("check", "runtime", "--at", "2d", "--json", "--severity", "note")
            assert said.status in (1, 2), said
            findings = json.loads(said.out)["findings"]
            running = [name for name, child in started.children.items() if child.poll() is None]
            names = started.pids()
            found = by_process(findings, names)
            wanted = {(name, each) for name, of in found.items() for each in of}
            wanted.discard(("expired", "runtime.process-expired"))  # it has not expired today
            wait_for(
                lambda: {each[1:] for each in watching.changes(names)} >= wanted, "each change"
            )
            started.children["open"].kill()
            over = ("over", "open", "runtime.process-unsecured")
            wait_for(lambda: over in watching.changes(names), "the end of a process")
            watched = [list(each) for each in watching.changes(names)]
            return {"found": found, "running": running, "watched": watched, "end": watching.end()}
        finally:
            started.end()
