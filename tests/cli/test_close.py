"""``sros close`` beside a graph that is made up: what it makes, keeps, refuses, proves, undoes."""

from __future__ import annotations

import fcntl
import json
import os
import re
import shutil
import subprocess
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime, timedelta
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import yaml

import sros_tool
from sros_tool.api import renew
from sros_tool.cli import close
from sros_tool.close import (
    apply,
    assignment,
    nodes,
    overrides,
    preparation,
    processes,
    proof,
    start_files,
    state,
    talk,
    watch,
)
from sros_tool.close import robot as of_robot
from sros_tool.close.acceptance import Acceptance
from sros_tool.close.assignment import with_command_of_unit
from sros_tool.close.preparation import steps
from sros_tool.close.processes import ClosedProcess, ObservedProcesses, read_processes
from sros_tool.close.robot import LocalRobot, Shell
from sros_tool.explain.audit import audit
from sros_tool.files import policies_dir
from sros_tool.graph import observe
from sros_tool.keystore.layout import list_enclaves
from sros_tool.policy.document import read_policy
from sros_tool.runtime.environment import secured_environment
from sros_tool.runtime.processes import (
    SEVERAL_USERS,
    FileReader,
    Process,
    ProcessEnclave,
    ProcessOrigin,
    ProcessRoot,
    ProcessTable,
    RunningProcesses,
    UnseenProcess,
    boot_id,
    launch_word_index,
    process_origin,
    user_text,
    with_files,
)
from sros_tool.validity import iso, time_of_file
from sros_tool.values import as_plain
from tests.cli.test_json import Seen
from tests.graph.fake_graph import Beside, graph
from tests.runtime.test_origins import made_up
from tests.support.harness import Ended, policy_text, publish, snapshot, sros, subscribe
from tests.support.long_form import some, sometimes

pytest_plugins = ["tests.graph.beside"]

PID = {"/talker": 4711, "/listener": 4712}
SERVICES = (
    *("describe_parameters", "get_parameter_types", "get_parameters", "list_parameters"),
    *("set_parameters", "set_parameters_atomically", "get_type_description"),
)


def ros_node(name: str, participant: str, *endpoints: str) -> Any:
    """A node of the graph, in the root namespace or a/b, with what every node has."""
    ns, _, base = f"/{name}".rpartition("/")
    own = [f"publish rr/{name}/{service}Reply" for service in SERVICES]
    own += [f"subscribe rq/{name}/{service}Request" for service in SERVICES]
    return "/", ns or "/", base, participant, [*endpoints, *own, "publish rt/rosout", *EVENTS]


EVENTS = ("publish rt/parameter_events", "subscribe rt/parameter_events")
TALKER = ros_node("talker", "010f0000671200000000", "publish rt/chatter")
LISTENER = ros_node("listener", "010f0000681200000000", "subscribe rt/chatter")
SYSTEMCTL = """#!/bin/sh
[ $1 = show ] && exec cat {states}/$3 2> /dev/null
[ $1 = cat ] && exec cat {states}/$2
echo "$@" >> {log}
exit $(cat {status})
"""


def secured(*nodes: tuple[str, str, str, str, list[str]]) -> list[Any]:
    """The nodes in enclaves; those of one participant are in that of the first one."""
    first: dict[str, str] = {}
    for _, ns, name, of, _ in nodes:
        first.setdefault(of, f"{ns}{name}")
    return [(first[of], ns, name, of, rights) for _, ns, name, of, rights in nodes]


@dataclass
class Robot:
    """A robot of two processes, of which systemd starts those in ``units``."""

    folder: Path
    beside: Beside
    units: dict[str, str] = field(default_factory=dict)
    more: tuple[Process, ...] = ()
    unseen: tuple[UnseenProcess, ...] = ()
    by_hand: set[str] = field(default_factory=set)
    outdated: set[str] = field(default_factory=set)
    """The enclaves whose processes started before their files changed."""
    launch: tuple[str, ...] = ()
    container: str = ""
    named: bool = False
    launch_file: str = ""
    """The temporary file that a launch gave its processes."""
    spelled: str = "robot/export"
    """How the processes name the export."""
    absent: set[str] = field(default_factory=set)
    """The enclaves whose processes do not run."""
    nodes: tuple[Any, ...] = (TALKER, LISTENER)
    remaining: tuple[Any, ...] = (TALKER, LISTENER)
    """What an observer with an enclave sees."""

    @property
    def restarts(self) -> list[str]:
        log = self.folder / "systemctl.log"
        return log.read_text().splitlines() if log.exists() else []

    def process(self, enclave: str, *, is_secured: bool) -> Process:
        command: tuple[str, ...] = ("/opt/run", enclave.strip("/"))
        if self.named:
            command += ("--ros-args", "-r", f"__node:={command[1]}", "-r", "words:=chatter")
        if self.launch_file:
            command += ("--params-file", self.launch_file)
        libraries, now = frozenset({"libfastrtps", "librcl"}), datetime.now(UTC)
        process = Process(PID[enclave], command, {}, now, libraries=libraries, user=os.geteuid())
        if not is_secured:
            return process
        export = self.folder / self.spelled
        process = replace(
            process,
            environment=secured_environment(export, enclave, 0),
            started=now + timedelta(days=-1 if enclave in self.outdated else 1),
        )
        return self.with_its_files(process)

    def with_its_files(self, process: Process) -> Process:
        root = os.open("/", os.O_PATH | os.O_DIRECTORY)
        try:
            return with_files(process, ProcessRoot(root, FileReader()), "/")
        finally:
            os.close(root)

    def look(self, _table: object, _now: datetime) -> RunningProcesses:
        """Return the processes, secured if they were restarted with a drop-in, or by hand."""
        drop_ins = [*self.folder.glob("systemd/*.d/sros-close.conf")]
        restarted = {
            enclave
            for enclave, unit in self.units.items()
            if unit in {path.parent.name.removesuffix(".d") for path in drop_ins}
            and any("restart" in line and unit in line for line in self.restarts)
        }
        processes = tuple(
            self.process(enclave, is_secured=enclave in restarted | self.by_hand)
            for enclave in PID
            if enclave not in self.absent
        )
        return RunningProcesses((*processes, *self.more), self.unseen)

    def close(self, *words: str, status: int = 0, **environment: str) -> Ended:
        not_open = self._closed() | self.absent
        now_open = [node for node in self.nodes if f"/{node[2]}" not in not_open]
        seen = graph(*now_open) | {"secured": graph(*secured(*self.remaining))}
        if "--apply" in words:
            seen["until"] = str(self.folder / "systemd/talker.service.d/sros-close.conf")
        ended = self.beside("close", seen, "robot", *words, **environment)
        assert ended.status == status, ended
        return ended

    def _closed(self) -> set[str]:
        running = self.look(None, datetime.now(UTC)).processes
        return {process.enclave.name for process in running if process.enclave}


def find_origins(
    monkeypatch: pytest.MonkeyPatch, process_origin: Callable[[int], ProcessOrigin]
) -> None:
    for module in (apply, assignment, overrides, processes, state, watch):
        monkeypatch.setattr(module, "process_origin", process_origin)


@pytest.fixture
def robot(beside_graph: Beside, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Robot:
    robot = Robot(tmp_path, beside_graph)
    settling = observe.Settling(0.2, 0.1, 5.0)
    monkeypatch.setattr(observe, "Settling", lambda: settling)
    monkeypatch.setattr(observe, "SECURED", settling)
    monkeypatch.setattr(ProcessTable, "look", lambda table, now: robot.look(table, now))
    units = {PID[enclave]: enclave for enclave in PID}
    find_origins(
        monkeypatch,
        lambda pid: ProcessOrigin(
            robot.units.get(units.get(pid, f"{pid}"), ""), "/opt", robot.launch, robot.container
        ),
    )
    monkeypatch.setattr(processes, "start_of", lambda pid: f"{boot_id()} {pid}")
    # The RMWs of this machine may lack security.
    lacking = tmp_path / "lacking"
    monkeypatch.setattr(of_robot, "built_without_security", lambda *_: lacking.exists())
    for module in (apply, processes, start_files, state):
        monkeypatch.setattr(module, "SYSTEMD_FOLDER", tmp_path / "systemd")
    monkeypatch.setattr(proof, "_SHARED_MEMORY", tmp_path / "shm")
    monkeypatch.setattr(apply, "_RESTART_SECONDS", 0.1)
    monkeypatch.setattr(apply, "_STABLE_FOR", timedelta())
    monkeypatch.setattr(apply, "_SECONDS_BETWEEN", 0)
    monkeypatch.setattr(proof, "_START_SECONDS", 0.1)
    monkeypatch.setattr(state, "_LOOK_SECONDS", 0.01)
    monkeypatch.setattr(talk, "_MOST_TRIES", 1)
    for name in ("ROS_DOMAIN_ID", "RMW_IMPLEMENTATION", "ROS_SECURITY_ENABLE"):
        monkeypatch.delenv(name, raising=False)
    (tmp_path / "systemd").mkdir()
    (tmp_path / "bin").mkdir()
    (tmp_path / "status").write_text("0")
    script = tmp_path / "bin/systemctl"
    files = {"log": "systemctl.log", "status": "status", "states": "."}
    text = SYSTEMCTL.format_map({name: tmp_path / file for name, file in files.items()})
    script.write_text(text)
    script.chmod(0o755)
    monkeypatch.setenv("PATH", f"{tmp_path / 'bin'}:{os.environ['PATH']}")
    return robot


UNITS = {"/talker": "talker.service", "/listener": "listener.service"}
RESTARTS = ("restart listener.service", "restart talker.service")


def made(folder: Path) -> list[str]:
    return sorted(path.name for path in (folder / "robot").iterdir())


MADE = [
    ".gitignore",
    *("common", "export", "keystore", "observed.json", "observer.xml", "policy.xml"),
    *("processes.json", "requirements.toml", "rights.html", "start"),
]


def test_no_command_is_to_be_run_with_an_rmw_without_security(robot: Robot) -> None:
    """No node would start again."""
    (robot.folder / "lacking").touch()  # as the fixture has it
    robot.close(RMW_IMPLEMENTATION="rmw_fastrtps_cpp")
    commands = (robot.folder / "robot/start/commands.txt").read_text()
    assert commands.startswith("# NOT YET: rmw_fastrtps_cpp is built without security")
    said = robot.close("--apply", status=1, RMW_IMPLEMENTATION="rmw_fastrtps_cpp").err
    assert "no node would start by these commands yet; next: sros doctor, to find" in said


def test_everything_is_prepared_and_nothing_is_closed(robot: Robot) -> None:
    robot.units = {"/talker": "talker.service"}
    mine = robot.folder / "robot/base.py"
    mine.parent.mkdir()
    mine.touch()
    lacking = robot.folder / "lacking"  # as the fixture has it
    lacking.touch()
    ended = robot.close(RMW_IMPLEMENTATION="rmw_fastrtps_cpp")
    assert "\nWARNING: rmw_fastrtps_cpp is built without security here: " in ended.err
    lacking.unlink()
    mine.unlink()
    assert ended.err.startswith("'robot' already has files: sros adds its own\n")
    assert made(robot.folder) == MADE
    git = partial(subprocess.run, cwd=robot.folder / "robot", check=True, capture_output=True)
    git(["git", "init", "-q"])
    for_git = git(["git", "ls-files", "-o", "--exclude-standard"], text=True).stdout.split()
    shutil.rmtree(robot.folder / "robot/.git")
    of_policy = {name for name in for_git if not name.startswith("common/")}
    assert of_policy == {".gitignore", "policy.xml", "observer.xml", "requirements.toml"}
    export = robot.folder / "robot/export"
    assert list_enclaves(export) == ("/listener", "/sros_observer", "/talker")
    assert not (export / "private").exists()
    assert "  topic /chatter: /talker -> /listener\n" in ended.out
    assert "/talker: process 4711, known by its process id: --apply restarts talker.s" in ended.out
    assert "/listener: process 4712, known by its process id: by hand\n" in ended.out
    assert "\nsaw 2 nodes, and 2 processes of this machine\n" in ended.err
    assert "may be missing" not in ended.err
    commands = (robot.folder / "robot/start/commands.txt").read_text()
    assert f"\ncd /opt && sros run {export} /listener -- /opt/run listener\n" in commands
    assert "/talker --" not in commands
    drop_in = robot.folder / "robot/start/units/talker.service.d/sros-close.conf"
    assert 'Environment="ROS_SECURITY_ENCLAVE_OVERRIDE=/talker"\n' in drop_in.read_text()
    assert not robot.restarts and not [*(robot.folder / "systemd").iterdir()]
    assert ended.err.endswith(
        "next: sros doctor, to find an RMW that enforces security; then set RMW_IMPLEMENTATION to "
        "this RMW\n"
    )
    (ignored := robot.folder / "robot/.gitignore").write_text("mine\n")
    said = robot.close().err
    assert said.endswith("nothing is closed yet; next: sros close robot --apply\n")
    assert ignored.read_text() == "mine\n"


@sometimes("a_policy_that_was_changed_stays_and_is_followed", 1 / 2)
def test_a_policy_that_was_changed_stays_and_is_followed(robot: Robot) -> None:
    robot.named = True
    robot.close()
    policy = robot.folder / "robot/policy.xml"
    policy.write_text(policy.read_text().replace("chatter", "old/chatter", 1))
    changed = policy.read_text()
    ended = robot.close()
    denied = "start command of /listener remaps to a name that the policy denies (words:=chatter)"
    assert f"{denied}: change the remapping, and then restart the process\n" in ended.out
    commands = (robot.folder / "robot/start/commands.txt").read_text()
    change = "First change the remapping words:=chatter: the policy denies chatter.\ncd /opt && "
    assert f"\n# /listener\n# {change}" in commands and commands.count("First change") == 1
    by_hand = robot.close("--apply", status=1)
    assert f" words:=chatter\n  the {denied}: change the remap" in by_hand.out
    assert by_hand.err.endswith(
        "next: run these commands, then sros close robot (it remembers the changed commands), and "
        "then sros close robot --proof\n"
    )
    robot.units, robot.by_hand = UNITS, {*PID}
    assert denied in robot.close("--apply", status=1).out
    robot.by_hand = set()
    assert "/listener: the rights that it lost still work until 20" in ended.err
    assert sros("diff_policy", "robot/keystore", "robot/policy.xml", cwd=robot.folder).ok()
    assert policy.read_text() == changed
    renamed = (
        "/listener subscribe topic /chatter (/listener): no rule allows subscribe rt/chatter; "
    )
    assert f"{renamed}perhaps the policy means /old/chatter\n" in ended.out
    told_again = robot.close().out
    assert "denies" not in told_again.replace(denied, ""), "the proof has it"
    again = robot.close("--for", "1s", status=1)
    assert policy.read_text() == changed
    assert (
        "nothing is closed yet; but fix this first:\n  'robot/policy.xml' stays as it " in again.out
    )
    remapped = "perhaps the policy means /old/chatter (the node may lack the remapping -r "
    assert f"lacks 1 right seen now (/listener subscribe /chatter); {remapped}" in again.out
    assert "-r /chatter:=/old/chatter, or the policy may lack --remap /old/chatter:=" in again.out
    assert (
        "; if the node's command is wrong, restart the node with the right one, and watch again: "
        "sros close robot --for 1m;" in again.out
    )
    assert " otherwise, if a process should not have this right, stop the process, " in again.out
    policy.write_text(changed.replace('node="listener"', 'node="hearer"'))
    renamed = robot.close("--for", "1s", status=1).out
    assert "; perhaps /listener is /hearer, started without its name (-r __node:=hearer)" in renamed
    assert "/listener/get_parameters:=" not in renamed
    policy.write_text(changed)
    robot.close("--for", "1s", status=1)
    add = "sros merge_policy robot/policy.xml robot/seen.xml --in-place"
    assert f"; if it needs this right: {add}\n" in again.out
    sros(*add.split()[1:], cwd=robot.folder).ok()
    assert "would have" not in robot.close("--for", "1s").out
    policy.write_text(changed)
    robot.close()
    robot.remaining = (TALKER, ros_node("listener", "04"))
    said = robot.close("--apply").out
    except_for = "yes, except for what the policy takes away: everything that talked can still "
    assert f"{except_for}talk: 2 nodes with 35 endpoints as before (types are not compared)" in said
    alone = (
        "left without a counterpart: /talker may publish /chatter, but no enclave may subscribe to "
    )
    alone = f"1 right that the robot used: /listener subscribe topic /chatter\n  {alone}it any more"
    unused = "seen neither on the open robot nor now: /listener subscribe topic /old/chatter"
    assert f"\n  the policy takes away {alone}\n  allowed, but {unused}\n" in said
    (denied,) = json.loads(robot.close("--proof", "--json").out)["denied"]
    assert denied.startswith("/listener subscribe topic /chatter (/listener): ")


LOST = "robot/export/enclaves/lost"


@sometimes("what_is_taken_out_of_the_policy_stays_out", 1 / 2)
def test_what_is_taken_out_of_the_policy_stays_out(robot: Robot) -> None:
    robot.units = UNITS
    robot.close()
    policy = robot.folder / "robot/policy.xml"
    before, enclave, after = policy.read_text().partition('    <enclave path="/talker">')
    head, _, _ = before.partition('    <enclave path="/listener">')
    revoke = "sros revoke robot/keystore /listener"
    remove = "first remove /listener from 'robot/policy.xml' (and from requirements.toml): otherw"
    assert remove in sros(*revoke.split()[1:], "--dry-run", cwd=robot.folder).err
    policy.write_text(head + enclave + after)
    mine = robot.folder / "robot/start/mine.env"
    mine.write_text("A=1\n")
    drop_in = robot.folder / "robot/start/units/listener.service.d/sros-close.conf"
    assert drop_in.exists()
    first = robot.close("--apply", status=1)
    assert "the keystore has /listener, and the policy does not, so /listener keeps" in first.out
    assert f"{revoke} (then restart all closed processes, " in first.out
    assert ". If it belongs to another machine, such as a laptop, then also run" in first.out
    assert (
        "removed robot/start/listener.env: no known process needs it" in first.err
        and mine.exists()
        and not drop_in.exists()
    )
    # An enclave that the keystore lost, and did not revoke, keeps its key.
    shutil.copytree(robot.folder / "robot/export/enclaves/talker", robot.folder / LOST)
    said = robot.close("--apply", status=1).out
    assert (
        "the export has /lost, which is not in the keystore and was not revoked there: "
        f"remove it with rm -r {LOST}\n" in said
    )
    assert (robot.folder / LOST / "key.pem").exists()
    shutil.rmtree(robot.folder / LOST)
    assert robot.restarts == []
    assert "first remove" not in sros(*revoke.split()[1:], cwd=robot.folder).err
    robot.remaining = (TALKER,)
    left = robot.folder / "robot/export/enclaves/listener"
    assert left.exists() and not (robot.folder / "robot/start/listener.env").exists()
    ended = robot.close("--apply", status=1)
    assert not left.exists()
    assert "removed robot/export/enclaves/listener: its enclave was revoked\n" in ended.err
    assert robot.restarts == ["daemon-reload", "restart talker.service"]
    assert (
        "no: not every process was started in its enclave: process 4712 (run): in domain 0"
        in ended.out
    )
    assert "yes: everything that talked can still talk: 1 node with 18 endpoints" in ended.out
    alone = "left without a counterpart: /talker may publish /chatter, but no enclave may subscribe"
    assert f"\n  {alone} to it any more\n" in ended.out


def refuse_undo_of_others(robot: Robot) -> None:
    """A folder that others can change, and a drop-in of another folder, undo nothing."""
    for name in ("", "start/units", "processes.json", "observer.xml"):
        path = robot.folder / "robot" / name
        mode = path.stat().st_mode
        path.chmod(0o777)
        undone = robot.close("--undo", status=2)
        assert f"others can change '{Path('robot') / name}'. " in undone.err
        path.chmod(mode)
    drop_in = robot.folder / "systemd/talker.service.d/sros-close.conf"
    text = drop_in.read_text()
    drop_in.write_text(text.replace("/robot`", "/moved`", 1))
    for words in ("--undo", "--apply"):
        assert "is not the drop-in of this folder" in robot.close(words, status=2).err
    drop_in.write_text(f"{text}Environment=MINE=1\n")
    would = robot.close("--apply", "--dry-run").err
    assert f"would replace {drop_in}" in would and would.endswith(": systemctl daemon-reload\n")
    drop_in.write_text(text)
    assert len(robot.restarts) == 3


def renew_without_systemd(robot: Robot) -> None:
    """Run the script for robots without systemd: it ends the processes with outdated files."""
    page = (Path(__file__).parents[2] / "docs/howto/close.md").read_text()
    script = page.partition("tests/cli/test_close.py runs these lines -->\n```sh\n")[2]
    lines = script.partition("```")[0].replace("/opt/robot/stands-still", "true")
    # A second process runs in an enclave, by another command than the known one.
    robot.more = (replace(robot.process("/talker", is_secured=True), pid=13, command=("b",)),)
    closed = json.loads(robot.close("--json", "--dry-run").out)
    robot.more = ()
    assert closed["outdated"].keys() == PID.keys()
    (said := robot.folder / "said.json").write_text(json.dumps(closed))
    functions = f"""
        sros() {{ [ "$3" != --json ] && echo "sros $*" || cat {said}; }}
        kill() {{ echo "kill $*"; }}
        sleep() {{ :; }}
    """
    ran = subprocess.run(["sh", "-c", functions + lines], capture_output=True, text=True)
    assert (ran.returncode, ran.stderr) == (0, "")
    assert ran.stdout.splitlines() == [
        "sros renew /opt/robot/keystore --all-expiring 30d",
        "sros close /opt/robot --apply",
        *(f"kill {pid}" for pid in (PID["/listener"], PID["/talker"], 13)),
        "sros close /opt/robot --proof",
    ]
    said.unlink()


def renew_without_hands(robot: Robot) -> None:
    """Run the two commands of the timer in docs/howto/close.md: renew; export, restart, prove."""

    class UntilRestarted(set[str]):
        def __contains__(self, enclave: object) -> bool:
            return len(robot.restarts) == 3

    robot.outdated = UntilRestarted()
    sros("renew", "robot/keystore", "--all-expiring", "400d", cwd=robot.folder).ok()
    keystore, export = (
        robot.folder / "robot" / name / "enclaves/talker/cert.pem"
        for name in ("keystore", "export")
    )
    assert keystore.read_bytes() != export.read_bytes()
    renew_without_systemd(robot)
    said = robot.close("--apply")
    assert keystore.read_bytes() == export.read_bytes()
    assert robot.restarts[3:] == ["daemon-reload", *RESTARTS]
    assert "\nthe robot is closed\n  the files are valid until" in said.err
    robot.outdated = set()
    log = robot.folder / "systemctl.log"
    log.write_text("".join(log.read_text().splitlines(keepends=True)[:3]))


def test_a_robot_is_closed_proved_and_opened_again(
    robot: Robot, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(apply, "users_without_linger", lambda users: ["robo"] * bool([*users]))
    robot.units, robot.spelled = UNITS, "systemd/../robot/export"
    robot.close()
    seen = robot.folder / "robot/observed.json"
    twice = json.loads(seen.read_text())
    twice["nodes"].append({**twice["nodes"][0], "participant": "of an earlier start"})
    seen.write_text(json.dumps(twice))
    closed = robot.close("--apply")
    assert robot.restarts == ["daemon-reload", *RESTARTS]
    assert "First run `loginctl enable-linger robo`, or run the nodes as a s" in closed.err
    assert closed.out.splitlines()[-6:] == [
        "yes: every process was started in its enclave: 2 enclaves, and no open process in "
        "domain 0",
        "yes: the files are accepted: sros check finds no error: robot/export, and the CAs and "
        "settings of robot/keystore",
        "yes: the requirements hold: all of them: robot/requirements.toml",
        "yes: everything that talked can still talk: 2 nodes with 36 endpoints as before "
        "(types are not compared)",
        "  sros cannot see whether two nodes hear each other: look at what the nodes receive now, "
        "and restart a node that receives nothing",
        "yes: an open listener finds nothing: the listener saw 2 nodes before (without removed "
        "ones), and sees none now",
    ]
    assert re.search(
        r"\nthe robot is closed\n  the files are valid until 20.*Z; have them renewed before then "
        r"\(docs/howto/close.md, Automatic renewal\)\n"
        "  bring robot/keystore, which has the CA keys, to another machine\n$",
        closed.err,
    )
    robot.close("--apply")
    assert len(robot.restarts) == 3  # they run in their enclaves already
    renew_without_hands(robot)
    (robot.folder / "robot/keystore").rename(robot.folder / "home")
    policy = robot.folder / "robot/policy.xml"
    signed = policy.read_text()
    policy.write_text(signed.replace("chatter", "old/chatter", 1))
    proved = robot.close("--proof", status=1).out
    assert (
        "no: not everything that talked can still talk: denied: /listener subscribe /ch" in proved
    )
    differs = "differs from the signed permissions of /listener, which the processes use: bring"
    assert f"robot/export; 'robot/policy.xml' {differs} the signed" in proved
    policy.write_text(signed)
    listened = robot.close("--proof", ROS_AUTOMATIC_DISCOVERY_RANGE="LOCALHOST")
    assert "yes: everything that talked can still talk: 2 nodes" in listened.out
    again = "env -u ROS_AUTOMATIC_DISCOVERY_RANGE sros generate_policy robot/open.xml"
    assert again in listened.err
    refused = robot.close("--apply", status=2).err
    assert "A new keystore would have other CAs." in refused
    assert (
        "'robot/start/commands.txt' has the commands of processes that you start by hand" in refused
    )
    (robot.folder / "home").rename(robot.folder / "robot/keystore")
    more = '<topics publish="ALLOW"><topic>chatter</topic></topics><topics subscribe="ALLOW">'
    policy.write_text(signed.replace('<topics subscribe="ALLOW">', more, 1))
    proved = robot.close("--proof", ROS_AUTOMATIC_DISCOVERY_RANGE="SUBNET").out
    assert "env -u" not in proved
    breaks = "'robot/policy.xml', which is not signed yet, violates at least one requirement"
    assert f"yes: the requirements hold: all of them: robot/requirements.toml; {breaks}\n" in proved
    assert "\n  in the policy, but not signed yet: /listener publish topic /chatter\n" in proved
    assert "seen neither" not in proved
    policy.write_text(signed)
    refuse_undo_of_others(robot)
    (other := robot.folder / "systemd/listener.service.d/other.conf").touch()
    undone = robot.close("--undo")
    assert [*robot.folder.glob("systemd/*.d/*")] == [other]
    assert [*robot.folder.glob("systemd/*.d")] == [other.parent], "without empty folders"
    assert robot.restarts[3:] == ["daemon-reload", "restart listener.service talker.service"]
    assert undone.err.count("removed ") == 2
    robot.close("--undo")
    assert len(robot.restarts) == 5, "they run open already"
    robot.absent = {"/talker"}
    robot.more = (replace(robot.process("/talker", is_secured=False), pid=12, user=12),)
    policy.write_text(signed.replace('"/talker"', '"/other"'))
    for stopped in ("inactive", "failed"):
        (robot.folder / "talker.service").write_text(f"ActiveState={stopped}\n")
        assert "talker.service" not in robot.close("--undo").err, "its enclave was taken away"
    policy.write_text(signed)
    failed = "talker.service has failed: start it open with `systemctl start talker.service`, or"
    assert failed in robot.close("--undo", status=1).out
    (robot.folder / "talker.service").write_text("ActiveState=inactive\n")
    stays = "did not run, and --undo starts no stopped unit; to start it open: systemctl start talk"
    assert stays in robot.close("--undo").err
    assert {*robot.restarts[5:]} == {"daemon-reload"}
    (robot.folder / "systemctl.log").write_text("before\n" * 5)
    (robot.folder / "talker.service").unlink()
    ended = "/talker does not run open, though talker.service was restarted: systemctl status talk"
    assert ended in robot.close("--undo", status=1).out
    assert robot.restarts[5:] == ["daemon-reload", "restart talker.service"]
    robot.absent, robot.more = set(), ()
    (robot.folder / "systemctl.log").write_text("before\n" * 5)
    robot.by_hand = {"/talker"}
    still = "process 4711 (run) still runs in /talker: stop it if talker.service did not start it"
    assert still in robot.close("--undo", status=1).out
    assert robot.restarts[5:] == ["daemon-reload", "restart talker.service"]
    processes = robot.folder / "robot/processes.json"
    processes.rename(robot.folder / "processes.json")  # as if it was broken, and removed
    assert "the robot runs closed" in robot.close("--for", "1s", status=2).err
    of_unit = "(talker.service starts it: instead, remove `sros run`, or the variables of the enc"
    assert of_unit in robot.close("--undo", status=1).out
    robot.by_hand = set()
    assert "\nthe robot is open: " in f"\n{robot.close('--undo').err}", "who knows what it had?"
    (robot.folder / "processes.json").rename(processes)
    robot.close("--proof", status=1)
    assert made(robot.folder) == MADE
    opens = "protection.default.write_access_control=false"
    loosened = ("update_keystore", "robot/keystore", "--set", opens, "--allow-looser")
    sros(*loosened, cwd=robot.folder).ok()
    said = robot.close().out
    assert "every enclave may publish DDS topic *: the governance of the keystore leaves" in said


@sometimes("what_systemd_does_not_start_is_done_by_hand", 1 / 2)
def test_what_systemd_does_not_start_is_done_by_hand(
    robot: Robot, monkeypatch: pytest.MonkeyPatch
) -> None:
    robot.units = dict.fromkeys(PID, "both.service")  # its script starts both
    assert "/talker: process 4711, known by its process id: by hand, in both.s" in robot.close().out
    ended = robot.close("--apply", status=1)
    assert robot.restarts == []
    advice = "both.service starts it: put this command into the unit or its script, if it is not"
    assert ended.out.count(f"  {advice} there yet, and restart the unit instead\n") == 2
    assert (robot.folder / "robot/start/commands.txt").read_text().count(f"# {advice}") == 2
    robot.units = {}
    assert "stop process 4711, and start again with:\n  cd /opt && sros run " in ended.out
    assert ended.err.endswith("next: run these commands, and then sros close robot --proof\n")
    assert (
        "no: not every process was started in its enclave: no secured process of this robot runs "
        "in /listener (process 4712 is open: stop it), /talker (process 4711 is open: stop it"
    ) in robot.close("--proof", status=1).out
    for root in ("robot/keystore", "robot/export"):
        denied = sros("explain", root, "/talker", "publish", "/x", cwd=robot.folder).out
        assert "merge_policy robot/policy.xml allow.xml --in-place\n" in denied
        assert denied.endswith("sros close robot\n")
    elsewhere = sros("env", root, "/talker", "--domain", "5", cwd=robot.folder).err
    add = "add the domain to its keystore, with `sros update_keystore robot/keystore --domain 0,5"
    assert add in elsewhere
    forbids = (
        r"requirements\.toml:\d+ forbids this: only /talker may publish /chatter\n  remedy .*\n$"
    )
    for source in (root, "robot/policy.xml"):
        asked = "explain", source, "/listener", "publish", "/chatter"
        denied = sros(*asked, cwd=robot.folder).out
        assert re.search(forbids, denied) and "allow.xml" not in denied, source
    robot.by_hand = {"/talker"}
    ended = robot.close()
    assert "/talker: process 4711: closed\n" in ended.out
    assert (
        "the processes run in their enclaves, except for /listener (open); next: stop and start "
        "this process by the commands at the top of robot/start/commands.txt, and then sros close "
        "robot --proof\n  the files are valid until" in ended.err
    )
    commands = (robot.folder / "robot/start/commands.txt").read_text()
    assert re.search(
        r"\A# Stop .*\n# Start .*\n\n# /listener\n.*\n\n# These .*\n\n# /talker\n", commands
    )
    assert ("ros2 launch" in commands) == bool(shutil.which("ros2"))
    (robot.folder / "bin/ros2").symlink_to("systemctl")
    robot.absent = {"/listener"}
    ended = robot.close()
    commands = (robot.folder / "robot/start/commands.txt").read_text()
    assert "\nros2 launch --secured " in commands
    assert "except for /listener (not running); next: start this process by the com" in ended.err
    idle = "  to prove that the robot is closed, without a process of /listener: sros close rob"
    assert f"and then sros close robot --proof\n{idle}ot --proof --without /listener\n" in ended.err
    robot.absent = set()
    assert "start again with" in (said := robot.close("--apply", status=1).out)
    assert "process 4712" in said and "process 4711" not in said
    robot.by_hand, robot.named = {"/talker", "/listener"}, True
    robot.units = dict.fromkeys(PID, "both.service")
    ended = robot.close()
    robot.units = {}
    assert "  /talker: process 4711: closed\n" in ended.out
    now = "/opt/run talker --ros-args -r __node:=talker -r words:=chatter"
    remembered = "/talker was started by another command than before; sros remembers the new "
    assert f"{remembered}one: cd /opt && {now}; before: cd /opt && /opt/run talker\n" in ended.err
    commands = (robot.folder / "robot/start/commands.txt").read_text()
    assert f" /talker -- {now}\n" in commands and " /opt/run talker\n" not in commands
    in_enclaves = "\nthe processes run in their enclaves; next: sros close robot --proof\n  the fi"
    assert f"{in_enclaves}les are valid until 20" in ended.err
    robot.more = (replace(robot.process("/talker", is_secured=False), pid=12),)
    ended, robot.more = robot.close(), ()
    assert "\n  a process of /talker also runs open: process 12; stop it\n" in ended.out
    assert (
        "in their enclaves; next: stop process 12, and then sros close robot --proof\n" in ended.err
    )
    robot.named = False
    robot.more = (replace(robot.process("/talker", is_secured=True), pid=13, command=("/opt/b",)),)
    robot.absent = {"/talker"}
    robot.more += (replace(robot.more[0], pid=14, command=("/opt/c",)),)
    ended = robot.close()
    assert "\n  not observed before: process 14 (c) in /talker; if it does not belong" in ended.out
    kept = "was started by a new command; sros keeps the observed one: start it by that again "
    assert (
        f"  /talker: {kept}" in ended.out and "sros remembers: cd /opt && /opt/b" not in ended.err
    )
    robot.more, robot.absent = (), set()
    for words in ("--apply", "--proof"):
        assert "\n  bring robot/keystore, which has the CA keys" in robot.close(words).err
    robot.by_hand, robot.absent = {"/talker"}, {"/listener"}
    (robot.folder / "link").symlink_to("robot")
    robot.spelled = "link/export"
    robot.units = dict.fromkeys(PID, "both.service")
    undone = robot.close("--undo", status=1)
    assert undone.out == (
        "restart process 4711 open: cd /opt && /opt/run talker (both.service starts it: instead, "
        "remove `sros run`, or the variables of the enclave, from the unit or its script, and "
        "restart the unit)\n"
    )
    assert "/listener does not run; start it open: cd /opt && /opt/run listener\n" in undone.err
    foreign = replace(robot.process("/talker", is_secured=True), pid=13, command=("/opt/idle",))
    second = replace(
        foreign, pid=14, command=("/opt/run", "talker"), started=foreign.started + timedelta(1)
    )
    robot.more = (foreign, second, replace(foreign, pid=15, user=os.geteuid() + 1))
    advice = "was not observed; stop it, if it is not yours; otherwise restart it open: cd /opt && "
    assert robot.close("--undo", status=1).out == (
        f"{undone.out}process 13 (idle) in /talker {advice}/opt/idle\n"
        f"process 14 (run) in /talker {advice}/opt/run talker\n"
        "process 15 (idle) in /talker was not observed; end process 15 (idle), which runs as "
        f"{user_text(os.geteuid() + 1)}, not as the owner of the enclave's files\n"
    )
    robot.absent = {"/listener", "/talker"}
    robot.more = (foreign, replace(foreign, pid=16, command=("/opt/other",)))
    further = robot.close("--undo", status=1)
    others = [
        f"process {pid} ({name}) in /talker {advice}/opt/{name}\n"
        for pid, name in ((13, "idle"), (16, "other"))
    ]
    assert further.out == "".join(others)
    assert "/talker does not run; start it open: cd /opt && /opt/run talker\n" in further.err
    robot.more, robot.absent = (), {"/listener"}
    policy = robot.folder / "robot/policy.xml"
    kept = policy.read_text()
    policy.write_text("<policy")
    broken = robot.close("--undo", status=1)
    assert broken.out == undone.out and "policy.xml' is not well-form" in broken.err
    policy.write_text(kept)
    robot.absent = set()
    would = robot.close("--undo", "--dry-run")
    undone = robot.close("--undo", status=1)
    assert would.out == undone.out and not would.err
    assert undone.err == (
        "the robot is not open yet; next: do what each line says, and run sros close "
        "robot --undo again\n"
    )
    robot.by_hand = set()
    # Of files that are not those of the folder, nobody knows whether they are a copy of them.
    (robot.folder / "copy/enclaves").mkdir(parents=True)
    robot.spelled = "copy"
    robot.more = (robot.process("/talker", is_secured=True),)
    undone = robot.close("--undo", status=1)
    secured = f"process 4711 (run) runs secured with the files of '{robot.folder}/copy', not of"
    assert f"{secured} this folder, and open processes do not hear it: stop it, or " in undone.out
    robot.more = ()
    robot.unseen = (UnseenProcess(9, ("talker", "--ros-args"), "/proc hides it", uses_ros=True),)
    assert "process 9 (talker) uses ROS 2, and ca" in robot.close("--undo", status=1).out
    robot.unseen, robot.named = (UnseenProcess(9, (), "/proc hides it", uses_ros=False),), True
    robot.more = (replace(robot.process("/listener", is_secured=False), pid=12),)
    other_run = ("/other/run", *robot.more[0].command[2:])
    robot.more = (replace(robot.more[0], pid=11, command=other_run), *robot.more)
    robot.absent = {"/listener", "/talker"}
    policy = robot.folder / "robot/policy.xml"
    policy.write_text(policy.read_text().replace('node="listener"', 'node="hearer"'))
    undone = robot.close("--undo")  # with the open process 12
    assert undone.err.startswith(
        "/listener may run open by another command (process 12 (run)); if that is not so, "
        "start /listener open (its node was /listener when sros watched; it may also have its "
        "new name): cd /opt && /opt/run listener\n"
        "/talker does not run; start it open: cd /opt "
    )
    processes = robot.folder / "robot/processes.json"
    known = json.loads(processes.read_text())
    (listener,) = (each for each in known["processes"] if each["enclave"] == "/listener")
    listener["command"] += ["--ros-args", "-r", "__node:=hearer"]
    processes.write_text(json.dumps(known))
    assert "/listener open: cd /opt && /opt/run listener --ro" in robot.close("--undo").err
    cannot = "Some processes cannot be examined"
    assert undone.err.endswith(
        "\nthe robot is open, as far as sros can see: sros sees no process in an enclave of this "
        f"folder. {cannot}: as root, this command examines them, too\n"
    )
    assert f"\n{cannot}: as root" in robot.close("--undo", "--dry-run").err
    looked = replace(robot.look(None, datetime.now(UTC)), is_run_by_root=True)
    robot.more, robot.unseen = (), ()
    undone = robot.close("--undo", status=1)
    assert undone.out.startswith("no process of the robot runs, open or secured: start its proc")
    monkeypatch.setattr(ProcessTable, "look", lambda _table, _now: looked)
    undone = robot.close("--undo")
    assert f"in an enclave of this folder. {cannot}. Being root is not" in undone.err


def a_unit_that_started_after_the_watch(robot: Robot, late: Process) -> None:
    """It runs open next to the closed robot, and gets a drop-in, or it is open at the next boot."""
    drop_in = robot.folder / "robot/start/units/late.service.d/sros-close.conf"
    other = replace(late, command=("/opt/other", "--ros-args"))
    robot.units["7"] = "late.service"
    named = replace(late, command=(*other.command, "-r", "__node:=late"))
    for process, known in ((late, "by its program"), (named, "by its node name")):
        robot.more = (process,)
        ended = robot.close()
        assert f"  /late: process 7, known {known}: --apply restarts late.service" in ended.out
        assert "next: sros close robot --apply" in ended.err
        assert "ROS_SECURITY_ENCLAVE_OVERRIDE=/late" in drop_in.read_text()
    processes = robot.folder / "robot/processes.json"
    before = processes.read_bytes()
    robot.close("--apply", "--dry-run")
    assert processes.read_bytes() == before
    robot.close("--apply", status=1)
    robot.more = ()  # it could not start in its enclave
    (robot.folder / "late.service").write_text("ActiveState=failed\n")
    for _ in range(2):
        assert "late.service has failed: start it open" in robot.close("--undo", status=1).out
    processes.write_bytes(before)
    named = replace(late, command=(*late.command, "-r", "__node:=other"))
    zenoh = replace(late, libraries=frozenset({"libzenohc"}))
    by_another_user = replace(late, user=os.geteuid() + 1)
    for more in (
        (other,),  # the last process left may be any program
        (named,),
        (zenoh,),  # the unit starts another command, to which sros cannot add --enclave
        (by_another_user,),
        (late, replace(other, pid=8)),  # the unit starts two
    ):
        robot.units["8"], robot.more = "late.service", more
        said = robot.close(status=1).out
        assert "sros does not know the enclave of" in said and not drop_in.exists()
        by_unit = "Or, if late.service starts it, add the name of its node to the command in the"
        assert (by_unit in said) is (more != (by_another_user,))
    del robot.units["8"]
    robot.units["7"], robot.absent = "moved.service", {"/talker"}
    node, cyclone = (
        ["--ros-args", "-r", "__node:=talker"],
        {"RMW_IMPLEMENTATION": "rmw_cyclonedds_cpp"},
    )
    by_say, by_named_say = (
        before.replace(b'"/opt/run",\n        "talker"', json.dumps(words)[1:-1].encode())
        for words in (["/opt/say"], ["/opt/say", *node])
    )
    for remembered, command, known in (
        (before, ("python3", "/opt/talker.py"), "by its program"),  # the name of its node
        (by_say, ("/usr/say", "-v"), "by its program"),  # of the command that sros remembers
        (before, ("/usr/run", "-v"), ""),  # the program of /listener, too
        (by_named_say, ("/usr/say", "-v"), ""),  # the program may run another node
        (by_say, ("/opt/x", *node[:2], "__node:=say"), ""),  # the program of another node
        (before, ("/opt/x", *node), "by its node name"),
    ):
        processes.write_bytes(remembered)
        robot.more = (replace(late, command=command, environment=cyclone),)
        said = robot.close(status=int(not known)).out
        moved = f"  /talker: process 7, known {known}: --apply restarts moved.service"
        assert (moved in said) is bool(known), command
    robot.close("--apply", status=1)
    (talker,) = (each for each in json.loads(processes.read_text())["processes"] if each["unit"])
    assert (talker["enclave"], tuple(talker["command"])) == ("/talker", command)
    assert talker["rmw"] == "rmw_cyclonedds_cpp", "otherwise, --undo would not know it"
    processes.write_bytes(before)
    (robot.folder / "systemd/moved.service.d/sros-close.conf").unlink()
    robot.absent = set()
    del robot.units["7"]


@sometimes("processes_that_started_after_the_watch", 1 / 2)
def test_processes_that_started_after_the_watch(robot: Robot) -> None:
    """Open ones have no enclave; secured ones are asked for, named, and restarted by --undo."""
    robot.close()
    late = Process(7, ("/opt/late", "--ros-args"), {}, datetime.now(UTC))
    robot.more = (late,)
    said = robot.close(status=1).out
    unknown = "does not know a node of 1 open process: process 7 (late): /opt/late --ros-args."
    assert f"{unknown} Watch again" in said
    robot.close("--accept", "nodes")
    robot.more = ()
    robot.close()
    robot.by_hand = set(PID)
    merged = robot.folder / "robot/policy.xml"
    merged.write_text(
        re.sub(
            r' *<enclave path="/talker">.*?</enclave>\n',
            lambda enclave: enclave[0].replace("talker", "late") + enclave[0],
            merged.read_text(),
            flags=re.DOTALL,
        )
    )
    ended = robot.close(status=1)
    assert "; nothing was signed; if you want the change, edit robot/requirements.toml" in ended.out
    assert "+ sros generate_artifacts" not in ended.err and "who may do what" not in ended.out
    assert list_enclaves(robot.folder / "robot/export") == (
        "/listener",
        "/sros_observer",
        "/talker",
    )
    (robot.folder / "robot/requirements.toml").unlink()
    ended = robot.close()
    assert "  /late: new, start it with: sros run " in ended.out
    there = "(if it belongs to another machine: `sros close robot --elsewhere /late`)\n"
    assert f"/late -- COMMAND {there}" in ended.out
    assert "  if a systemd unit starts a new process, start the unit open, and run " in ended.out
    robot.more = (late,)
    said = robot.close(status=1).out
    assert (
        "enclaves, except for /late (not running, or not recognized); but fix this first:\n" in said
    )
    export = robot.folder / "robot/export"
    start = f"cd /opt && sros run {export} /late -- /opt/late --ros-args"
    named = "process 7 (late) runs open, and has the name of /late: stop it, and, if it is this"
    assert f"{named} node, start it in its enclave: {start}. While it runs open, the" in said
    assert "/late: new; a process with its name runs open (see below)\n" in said
    assert "COMMAND" not in said, "there is one command"
    assert "sros does not know the enclave" not in said
    a_unit_that_started_after_the_watch(robot, late)
    other = replace(late, pid=8, command=("/opt/more", "--ros-args"))
    robot.more = (other,)
    start = f"cd /opt && sros run {export} /late -- /opt/more --ros-args"
    belongs = "If the process belongs in /late, stop it, and start it in its enclave"
    assert f". {belongs}: {start}. Stop processes" in robot.close(status=1).out
    robot.more = (late, other)
    said = robot.close(status=1).out
    assert named in said and "of 1 open process: process 8 (more): /opt/more --ros-args." in said
    assert (
        "`sros demo listener`. To give another process its own enclave, let the process run" in said
    )
    learn = "`sros generate_policy robot/policy.xml --enclave-per-node`; read the added rights"
    assert f"next to the closed robot, and run {learn}" in said
    assert "--undo" not in said, "no advice opens the robot"
    robot.more = ()
    commands = (robot.folder / "robot/start/commands.txt").read_text()
    assert commands.startswith("# /late is new: COMMAND is what starts it\nsros run ")
    assert "enclaves, except for /late (not running); next: start" in ended.err
    environment = secured_environment(export, "/late", 0)
    late = robot.with_its_files(replace(late, environment=environment))
    robot.more = (replace(late, user=os.geteuid() + 1),)
    robot.close()
    commands = (robot.folder / "robot/start/commands.txt").read_text()
    assert "/opt/late" not in commands, "another user cannot propose what is run"
    robot.more = (replace(late, started=datetime.now(UTC) - timedelta(days=1)),)
    ended = robot.close()
    assert ": runs with earlier files or other settings: by hand\n" in ended.out
    assert "except for /late (with earlier files or other settings); next: stop" in ended.err
    robot.more = (replace(late, started=datetime.now(UTC) + timedelta(days=1)),)
    assert "\nthe processes run in their enclaves; next: sros close robot --pr" in robot.close().err
    watching = robot.close("--for", "1s", status=2).err
    assert "the robot runs closed: process 4711 (run), process 4712 (run), process 7" in watching
    commands = (robot.folder / "robot/start/commands.txt").read_text()
    assert f"\n# /late\ncd /opt && sros run {export} /late -- /opt/late --ros-args\n" in commands
    undone = "restart process 7 open: cd /opt && /opt/late --ros-args\n"
    assert undone in robot.close("--undo", status=1).out
    robot.by_hand, robot.more = set(), (replace(late, environment={}, enclave=None),)
    assert "the robot is open" in robot.close("--undo").err
    assert "closed yet; next: stop the robot" in robot.close().err


@sometimes("a_node_that_does_not_run_always", 1 / 2)
def test_a_node_that_does_not_run_always(robot: Robot) -> None:
    robot.close()
    robot.by_hand, robot.absent, robot.remaining = {"/talker"}, {"/listener"}, (TALKER,)
    ended = robot.close("--proof", status=1)
    assert (
        "no: not every process was started in its enclave: no secured process of this robot runs "
        "in /listener. St" in ended.out
    )
    assert (
        "For a process that does not always run, add its option: --without /listener\n" in ended.out
    )
    assert ended.out == robot.close("--proof", "--partial", status=1).out
    assert "has no enclave /x. It has /l" in robot.close("--proof", "--without", "/x", status=2).err
    without = "--proof", "--without", "/listener"
    assert robot.close("--apply", *without[1:]).err.endswith("to another machine\n")
    ended = robot.close(*without)
    assert (
        "yes: every process was started in its enclave: 1 enclave, and no open process in "
        "domain 0; "
        "not counted: /listener (not running)\n"
    ) in ended.out
    assert (
        "talk: 1 node with 18 endpoints as before (types are not compared), without /listener\n"
        in ended.out
    )
    assert "the robot is closed; no process of /listener runs\n  the files are" in ended.err
    robot.unseen = (UnseenProcess(9, (), "/proc hides it", uses_ros=False),)
    robot.close(*without, "--accept", "unobserved", status=1)
    ended = robot.close(*without, "--accept", "unexamined")
    assert "; not counted: /listener (not seen)\n" in ended.out
    robot.unseen = ()
    robot.absent, robot.by_hand = set(), {"/listener", "/talker"}  # it is compared, too
    assert "no: not everything that talked can still t" in robot.close(*without, status=1).out
    robot.by_hand = {"/talker"}
    assert "process 4712 (run): in domain 0" in robot.close(*without, status=1).out
    robot.absent = {"/listener", "/talker"}
    assert "no secured process" in robot.close(*without, "--without", "/talker", status=1).out
    assert (
        "add its option: --without /listener, --without /talker\n"
        in robot.close("--proof", status=1).out
    )


def before_the_audit(happen: Callable[[], object]) -> Any:
    """What runs verbs, and lets something happen when the audit begins."""

    def run(words: Any, live: bool, run: Any = close._run) -> Any:
        if words[0] == "audit":
            happen()
        return run(words, live)

    return run


def started_after_the_audit(robot: Robot, *processes: Process) -> Any:
    """What runs verbs, and lets processes start when the audit has ended."""

    def run(words: Any, live: bool, run: Any = close._run) -> Any:
        ended = run(words, live)
        robot.more = processes if words[0] == "audit" else robot.more
        return ended

    return run


def beside_a_graph_that_changes(words: Any, live: bool, run: Any = close._run) -> Any:
    """Run a verb, and say of an audit that the graph kept changing."""
    status, output, messages = run(words, live)
    if words[0] == "audit":
        status, output = 1, output.replace('"settled": true', '"settled": false')
    return status, output, messages


def intermittently_used(robot: Robot, node: str, topic: str, direction: str) -> None:
    """Let the watch have seen an endpoint of a node for a part of its time."""
    file = robot.folder / "robot/observed.json"
    seen = json.loads(file.read_text())
    assert seen["intermittent"] == []
    (of,) = (each["participant"] for each in seen["nodes"] if f"/{each['name']}" == node)
    endpoint = {"node": node, "participant": of, "topic": topic, "direction": direction}
    file.write_text(json.dumps({**seen, "intermittent": [endpoint]}))


def test_a_proof_fails_for_each_reason(robot: Robot, monkeypatch: pytest.MonkeyPatch) -> None:
    robot.units = UNITS
    robot.close()
    robot.close("--apply")
    robot.more = (Process(5, ("spy", "--ros-args"), {}, datetime.now(UTC)),)
    robot.more += (robot.process("/talker", is_secured=False),)
    robot.more += tuple(replace(robot.more[0], pid=pid) for pid in (6, 7))
    robot.absent = {"/listener"}
    said = robot.close("--proof", status=1).out
    assert "no secured process of this robot runs in /listener (" in said
    assert "; also open: process 5 (spy), process 4711 (run), process 6 (spy) and 1 more; " in said
    robot.absent = set()
    ended = robot.close("--proof", status=1)
    assert "; process 6 (spy): in domain 0" in ended.out and " and 1 more\n" in ended.out
    assert "no: not every process was started in its enclave: process 5 (spy)" in ended.out
    assert "ROS_SECURITY_ENABLE. Stop it: another process runs in /talker.\n" in ended.err
    robot.more = ()
    robot.outdated, restarts = {"/talker"}, "`sros close robot --apply` restarts"
    key = robot.folder / "robot/export/enclaves/talker/key.pem"
    key.chmod(0o644)
    said = robot.close("--proof", status=1).out
    assert "no: the files are not accepted: sros check finds 1 error, the first in " in said
    key.chmod(0o600)
    assert (
        "others can read key.pem (its mode is 0644): if anybody read it, run `sros renew " in said
    )
    assert " and 2 more changed, or got another mode, after the start of" in said
    assert f"the processes of /talker (process {PID['/talker']}); {restarts} them\n" in said
    said = robot.close().out
    assert " another mode, after the start of the processes of /talker: restart them\n" in said
    robot.more = (replace(robot.process("/talker", is_secured=True), pid=13, command=("b",)),)
    named = f"the processes of /talker (processes {PID['/talker']}, 13); {restarts} them\n"
    required = robot.folder / "robot/requirements.toml"
    stated = required.read_text()
    required.write_text('[[nobody]]\npublish = ["/chatter"]\n')
    said = robot.close("--proof", status=1).out
    assert named in said and "  because of this, the proof did not look whether everything" in said
    assert "\nno: the requirements do not all hold: at least one is violated" in said
    required.write_text(stated)
    robot.outdated, robot.absent = set(), {"/talker"}
    talker = robot.process("/talker", is_secured=True)
    robot.more = (replace(talker, started=datetime.now(UTC) + timedelta(days=1)),)
    assert ": restart them" not in robot.close().out
    long_ago = talker.started - timedelta(days=400)
    robot.more = (replace(talker, started=long_ago, clock_advance=timedelta(days=2)),)
    said = robot.close("--proof", status=1).out
    assert "its enclave: the clock was set forward by 2 d while the process ran, and " in said
    assert " may have changed after the start of the processes of /talker (process 4711); " in said
    lax = {**talker.environment, "ROS_SECURITY_STRATEGY": "Permissive"}
    for changed, why in (
        (replace(talker, environment=lax), "ROS_SECURITY_STRATEGY is not 'Enforce' in"),
        (replace(talker, user=12345), "user 12345, not the owner of the files, can control"),
    ):
        robot.more = (changed,)
        named = f"{why} the processes of /talker (process {PID['/talker']}); {restarts} them\n"
        assert f"in its enclave: {named}" in robot.close("--proof", status=1).out
    robot.absent = set()
    seven = Process(5, ("guest",), {"ROS_DOMAIN_ID": "7"}, datetime.now(UTC))
    robot.more = (seven, replace(seven, command=("inner",), environment={}, network="net:[1]"))
    robot.more += tuple(
        replace(talker, pid=pid, command=command, started=talker.started + timedelta(pid))
        for pid, command in ((6, ("/tmp/thief",)), (7, talker.command), (8, ("ros2", "topic")))
    )
    daemon = replace(seven, pid=9, environment={}, command=("/bin/python", "/bin/_ros2_daemon"))
    robot.absent, others = {"/talker"}, (*robot.more, replace(daemon, network="net:[1]"))
    robot.more = (replace(talker, command=("/opt/b",)),)
    by_other = "see process 4711 (b) in /talker (by another command than the observed process) when"
    ended = robot.close("--proof", status=1)
    assert f"there: sros did not {by_other}" in ended.out
    advised = (
        "not proved closed; next: if you changed the command of a process, run sros close robot (i"
    )
    assert advised in ended.err
    file = robot.folder / "robot/processes.json"
    known = file.read_text()
    remembered = "/talker was started by another command than before; sros remembers the new one: "
    assert f"{remembered}cd /opt && /opt/b; before: " in robot.close().err, "in the same unit"
    robot.close("--proof")
    file.write_text(known)
    robot.more = (replace(robot.more[0], pid=12),)
    assert remembered not in robot.close().err, "not in its unit"
    robot.units["12"] = "own.service"
    assert remembered in robot.close().err, "in a unit of its own"
    del robot.units["12"]
    file.write_text(known)
    assert advised not in robot.close("--proof", status=1).err
    robot.absent, robot.more = set(), others
    more = "every process in an enclave belongs there: sros did not see process 6 (thief) in "
    more += "/talker, process 7 (run) in /talker, process 8 (ros2) in /talker when it watched"
    guest = "in domain 0; process 5 (guest) runs open in domain 7\n"
    inner = "not checked (--accept domains accepts this): no process is in a domain that was not "
    inner += "examined: process 5 (inner) runs open, process 9 (_ros2_daemon) runs open in "
    inner += "domain 0 of another network namespace"
    said = robot.close("--proof", status=1).out
    assert f"{guest}not checked (--accept unobserved accepts this): {more}" in said
    assert inner in said
    (copy := robot.folder / "copy/enclaves/office").mkdir(parents=True)
    environment = secured_environment(copy.parents[1], "/office", 0)
    robot.more = (robot.with_its_files(replace(talker, pid=9, environment=environment)),)
    office = f"process 9 (run) in /office (with the files of '{copy.parents[1]}')"
    assert f"there: sros did not see {office} when" in robot.close("--proof", status=1).out
    robot.more = others
    for stray, label in ((replace(seven, environment={}), "guest"), (daemon, "_ros2_daemon")):
        robot.more = (stray,)
        label = f"process {stray.pid} ({label})"
        said = robot.close("--proof", status=1).out
        assert f"no: not every process was started in its enclave: {label}" in said
        assert "belongs there" not in said
    robot.more = (replace(talker, pid=8, command=("ros2", "topic"), domains=frozenset({0, 92})),)
    further = "not checked (--accept domains accepts this): no process is in a domain that was not "
    further += "examined: process 8 (ros2): its ports show that it is also in domain 92; "
    assert further in robot.close("--proof", status=1).out
    lax_talker = replace(talker, pid=11, environment=lax)
    for late, says in (
        (
            (lax_talker,),
            "in its enclave: ROS_SECURITY_STRATEGY is not 'Enforce' in the processes of",
        ),
        ((replace(seven, environment={}), others[2]), "in its enclave: process 5 (guest): in doma"),
        ((others[2],), "belongs there: sros did not see process 6 (thief) in /talker when"),
    ):
        robot.more = ()
        with monkeypatch.context() as patched:
            patched.setattr(close, "_run", started_after_the_audit(robot, *late))
            assert says in robot.close("--proof", status=1).out
    robot.more = ()
    robot.remaining = (TALKER,)
    lost = "no: not everything that talked can still talk: "
    runs = f"process {PID['/listener']} (run) runs: run the proof again, or restart the process;"
    assert (
        f"{lost}not seen: /listener ({runs} if the node is gone"
        in robot.close("--proof", status=1).out
    )
    with monkeypatch.context() as patched:
        patched.setattr(close, "_run", before_the_audit(partial(robot.absent.add, "/listener")))
        stopped = "/listener (process 4712 (run); start it again, or, if it does not always run, "
        said = robot.close("--proof", status=1).out
        robot.absent.clear()
        without = robot.close("--proof", "--without", "/listener").out
        assert "as before (types are not compared), without /listener\n" in without
    robot.absent = set()
    assert f"{lost}ended while the proof ran: {stopped}add --without /listener)\n" in said
    unit = robot.folder / "listener.service"
    loops = f"{lost}restarted by systemd while the proof ran: /listener (listener.service, 2 times"
    for seen in (robot.remaining, robot.nodes):  # a process that ends again and again may be seen
        unit.write_text("NRestarts=5\nSubState=running\n")
        robot.remaining = seen
        with monkeypatch.context() as patched:
            later = "NRestarts=6\nSubState=auto-restart\n"
            patched.setattr(close, "_run", before_the_audit(partial(unit.write_text, later)))
            said = robot.close("--proof", status=1).out
        log = "`journalctl -n 100 -u listener.service | sros explain robot/export --log -`"
        on_purpose = "if it ends on purpose, add --without /listener"
        assert f"{loops}; its log says why: {log}; {on_purpose})\n" in said
    unit.unlink()
    robot.remaining = (TALKER, ros_node("listener", LISTENER[3]))
    with monkeypatch.context() as patched:
        patched.setattr(close, "_run", beside_a_graph_that_changes)
        said = robot.close("--proof", status=1).out
        unseen = f"{lost}not seen this time: /listener subscribe /chatter; if the node does not "
        assert f"{unseen}always use the name, prove again while it does; if it uses an" in said
        assert "in 'robot/policy.xml', in the profiles of the node and of the nodes that" in said
        assert "(this takes away the right to the old name)" in said
        assert "start the node as before (robot/start/commands.txt)" in said
        intermittently_used(robot, "/listener", "rt/chatter", "subscribe")
        said = robot.close("--proof").out
    assert (
        "talk: 2 nodes with 35 endpoints as before (types are not compared)\n  allowed, but" in said
    )
    not_now = "allowed, but not seen now, and not always seen during the watch: "
    not_now += "/listener subscribe /chatter\n  "
    assert f"{not_now}the ROS graph kept changing meanwhile, or could not be read in time\n" in said
    robot.remaining = (TALKER, ros_node("guest", "05"))
    said = robot.close("--proof", status=1).out
    assert f"{lost}denied: /guest " in said and "; also not seen: /listener (" in said
    assert "; if a node needs this right, add the right to the node's profile in 'robot/pol" in said
    robot.remaining = (TALKER, LISTENER)
    robot.nodes = (*robot.nodes, ("/", "/", "spy", "03", ["subscribe rt/chatter"]))
    said = robot.close("--proof", status=1).out
    assert (
        "no: an open listener finds something: it sees /spy; stop what runs open, or start" in said
    )
    assert "with 36 endpoints as before (types are not compared)\n" in said
    robot.nodes = (TALKER, LISTENER, ("/", "", observe.NOBODY, "03", ["publish rt/cmd_vel"]))
    assert (
        "topics with writers or readers that belong to no ROS node: rt/cmd_vel; stop what runs open"
        in robot.close("--proof", status=1).out
    )
    robot.nodes = (TALKER, LISTENER)
    needed = robot.folder / "robot/requirements.toml"
    kept = needed.read_text()
    needed.write_text("[[only]]\n")
    assert "enclaves is missing in [[only]]" in robot.close("--proof", status=2).err
    needed.write_text('[[only]]\npublish = ["/chatter"]\nenclaves = ["/listener"]\n')
    ca_key = robot.folder / "robot/keystore/private/identity_ca.key.pem"
    for readable in (key, ca_key):
        readable.chmod(0o644)
    ended = robot.close("--proof", status=1)
    for readable in (key, ca_key):
        readable.chmod(0o600)
    named = f"process 4711 (run): the mode of '{key}' is 0644\n"
    assert f"no: not every process was started in its enclave: {named}" in ended.out
    assert "no: the files are not accepted: sros check finds 1 error, the first in rob" in ended.out
    assert "next: correct the problems above, and then run sros close robot" in ended.err
    assert (
        "; sros check finds 1 error, the first in robot/keystore/private/identity_ca" in ended.out
    )
    for replace_it in ("renew robot/keystore /talker --new-key --revoke-old", "rotate_ca robot/k"):
        assert f"If others may have copied the key, replace {replace_it}" in re.sub(
            "(?<=replace )[^`]*`sros ", "", ended.out
        )
    assert (
        "`, and restart all processes: robot/export, and the CAs and settings of robot/keystore\n"
        in ended.out
    )
    assert (
        "no: the requirements do not all hold: at least one is violated: robot/requirements.toml"
        in ended.out
    )
    assert "/talker: may publish /chatter" in ended.err
    needed.write_text(kept)
    robot.remaining = ()
    sros("crl", "robot/keystore", "--refresh", cwd=robot.folder).ok()
    ended = robot.close("--proof", "--partial", status=1)
    crl = "exporting 'robot/keystore' would change 3 files, such as robot/export/enclaves/"
    assert f"no: the files are not accepted: {crl}" in ended.out, "as in an export that is restored"
    again = "distribute_key", "robot/keystore", "--all", "robot/export", "--force"
    sros(*again, cwd=robot.folder).ok()
    sros("create_keystore", "other", cwd=robot.folder).ok()
    authority = robot.folder / "robot/keystore/public/identity_ca.cert.pem"
    trusted = authority.read_bytes()
    authority.write_bytes(
        trusted + (robot.folder / "other/public/identity_ca.cert.pem").read_bytes()
    )
    refused = robot.close("--proof", "--partial", status=1).out  # --partial accepts no refusal
    authority.write_bytes(trusted)
    assert "no: the files are not accepted: the keystore does not export them: " in refused
    assert (
        "not checked: everything that talked can still talk: there is nothing to audit" in ended.out
    )
    assert "not checked: an open listener finds nothing: this proves nothing, because" in ended.out
    assert "--accept" not in ended.err
    robot.remaining = (TALKER, LISTENER)
    robot.unseen = (
        UnseenProcess(9, (), "/proc hides it", uses_ros=False),
        UnseenProcess(10, ("init",), "Permission denied", uses_ros=False),
    )
    policy = robot.folder / "robot/policy.xml"
    policy.write_text(policy.read_text().replace("chatter", "old/chatter", 1))
    ended = robot.close("--proof", "--partial")
    assert (
        ": robot/export, and the CAs and settings of robot/keystore; 'robot/policy.xml' differs "
        "from the signed permissions of /listener, which the processes use: `sros close robot` "
        "checks and signs it\n" in ended.out
    )
    renamed = policy.read_text()
    pad = '<enclave path="/pad"><profiles><profile ns="/" node="pad"/></profiles></enclave>'
    policy.write_text(renamed.replace("</enclaves>", f"{pad}</enclaves>"))
    both = "which the processes use and has /pad, without signed permissions: `sros close robot` "
    assert both in robot.close("--proof", "--partial", "--without", "/pad").out
    policy.write_text(renamed)
    assert (
        "not checked (accepted): every process was started in its enclave: true for 2 "
        "enclaves; process 9 (?) (/proc hides it), process 10 (init) (Permission denied) may be "
        "nodes, but cannot be examined: they may run open, or with a copied key\n"
    ) in ended.out
    assert "closed, except for the claims that were not checked" in ended.err
    robot.unseen, rogue = (), robot.folder / "rogue.xml"
    rogue.write_text(policy_text({"/rogue": publish("x")}))
    sros("generate_artifacts", "-k", "robot/keystore", "-p", rogue, cwd=robot.folder).ok()
    said = robot.close("--proof", status=1).out
    advice = "`sros close robot` says how to revoke or keep such an enclave"
    assert (
        "no: the files are not accepted: the keystore has /rogue, and the policy does not; "
        f"{advice}" in said
    )
    assert f"not seen: any node in /rogue ({advice})" in said and "exports them" not in said


@pytest.mark.parametrize("after", some([False, True], 1))
def test_what_is_interrupted_at_any_step_goes_on(
    robot: Robot, monkeypatch: pytest.MonkeyPatch, after: bool
) -> None:
    run = close._run
    robot.units = UNITS
    policy = robot.folder / "robot/policy.xml"
    shell = Shell(run, print, os.environ, lambda: datetime.now(UTC), UTC)
    for step in steps(LocalRobot(robot.folder / "robot", 0, shell), None):

        def interrupted(words: Any, live: bool, step: Any = step) -> Any:
            is_it = [Path(word).name for word in words if word != "--dry-run"] == [
                Path(word).name for word in step.words
            ]
            ended = run(words, live) if after or not is_it else None
            if is_it:
                raise KeyboardInterrupt
            return ended

        with monkeypatch.context() as patched:
            patched.setattr(close, "_run", interrupted)
            before = policy.read_bytes() if policy.exists() else b""
            robot.close(status=130)
            assert not before or policy.read_bytes() == before
    assert robot.restarts == []
    robot.close()
    assert made(robot.folder) == MADE
    robot.close("--apply")


def test_a_watch_that_is_interrupted_keeps_nodes_and_processes_of_one_time(
    robot: Robot, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Or the next run takes the processes of the watch before for those of the new nodes."""

    def interrupted(*_: Any, **__: Any) -> None:
        raise KeyboardInterrupt

    robot.close()
    files = [robot.folder / "robot" / name for name in ("observed.json", "processes.json")]
    before = [file.read_bytes() for file in files]
    robot.nodes = (TALKER, LISTENER, ros_node("third", TALKER[3], "publish rt/third"))
    with monkeypatch.context() as patched:
        patched.setattr(watch, "assign", interrupted)
        robot.close("--for", "1s", status=130)
    assert [file.read_bytes() for file in files] == before


@pytest.mark.parametrize("folder", ["/proc", "/proc/none"])
def test_applying_without_units_writes_nothing_for_systemd(
    robot: Robot, monkeypatch: pytest.MonkeyPatch, folder: str
) -> None:
    """Not even root can write into these folders."""
    for module in (apply, processes, start_files, state):
        monkeypatch.setattr(module, "SYSTEMD_FOLDER", Path(folder))
    robot.close()
    assert "start again with:" in robot.close("--apply", status=1).out


@pytest.mark.parametrize("function", some(["write_units", "_restart_units"], 1))
def test_applying_that_is_interrupted_goes_on_or_back(
    robot: Robot, monkeypatch: pytest.MonkeyPatch, function: str
) -> None:
    def interrupted(*_: Any, **__: Any) -> None:
        raise KeyboardInterrupt

    robot.units = UNITS
    robot.close()
    with monkeypatch.context() as patched:
        patched.setattr(apply, function, interrupted)
        robot.close("--apply", status=130)
    assert robot.restarts == []
    robot.close("--undo")
    assert [*robot.folder.glob("systemd/*.d/*")] == []
    robot.close("--apply")
    monkeypatch.setattr(apply, "remove_file", interrupted)
    assert "removed" not in robot.close("--undo", status=130).err


@sometimes("a_unit_that_does_not_run_is_not_called_open", 1 / 2)
def test_a_unit_that_does_not_run_is_not_called_open(
    robot: Robot, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its process failed, as after a start with a missing file; its earlier id means nothing."""
    robot.units = UNITS | {"/listener": r"my\x2dlistener.service"}
    robot.close()
    robot.close("--apply")
    robot.absent = {"/listener"}
    unit = robot.units["/listener"]
    said = robot.close("--proof", status=1).out
    assert f"in /listener ({unit} does not run it: systemctl status '{unit}'). If a p" in said
    assert (
        f"ended, its log says why: `journalctl -n 100 -u '{unit}' | sros explain robot/exp" in said
    )
    assert "--without" not in said
    for lines, file in (
        ("StandardOutput=append:/var/a b.log\nStandardError=inherit", "'/var/a b.log'"),
        ("StandardOutput=null\nStandardError=file:/var/b.log", "/var/b.log"),
        ("StandardOutput=append:/var/%n.log", "ITS_LOG"),
    ):
        (robot.folder / unit).write_text(f"{lines}\n")
        said = robot.close("--proof", status=1).out
        assert f"its log says why: `sros explain robot/export --log {file}`" in said
    (robot.folder / unit).unlink()
    ended = robot.close()
    assert "  /listener: not running: --apply restarts" in ended.out
    assert "in their enclaves, except for /listener (not running); next:" in ended.err

    def proofs_of(*arguments: Any) -> Any:
        robot.absent = set()
        return proof.proofs_of(*arguments)

    monkeypatch.setattr(apply, "proofs_of", proofs_of)
    assert json.loads(robot.close("--apply", "--json").out)["absent"] == []


@sometimes("what_the_restarts_left_is_printed", 1 / 2)
def test_what_the_restarts_left_is_printed(robot: Robot) -> None:
    """A script that ended a process of a restarted unit might hit another one with its id."""

    class UntilRestarted(set[str]):
        def __contains__(self, enclave: object) -> bool:
            return enclave == "/listener" or len(robot.restarts) == 2

    robot.units = {"/talker": "talker.service"}
    robot.close()
    robot.by_hand = {"/listener"}
    robot.close("--apply")
    robot.outdated = UntilRestarted()
    assert json.loads(robot.close("--json").out)["outdated_pids"].keys() == PID.keys()
    left = json.loads(robot.close("--apply", "--json", status=1).out)
    assert left["outdated_pids"] == {"/listener": [PID["/listener"]]}
    assert (left["outdated"].keys(), left["proofs"]) == ({"/listener"}, [])


@sometimes("a_unit_that_secures_its_process_itself_is_restarted_without_a_drop_in", 1 / 2)
def test_a_unit_that_secures_its_process_itself_is_restarted_without_a_drop_in(
    robot: Robot, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As those of `sros units`: a timer renews their files, and has to restart them."""
    robot.close()
    unit, robot.by_hand = "sros@talker.service", {*PID}
    robot.units = dict.fromkeys(PID, unit)
    robot.outdated = {"/talker"}
    assert f"settings: by hand, in {unit}\n" in robot.close().out
    robot.units = {"/talker": unit}
    assert f": --apply restarts {unit}\n" in (ended := robot.close()).out
    assert ended.err.count("next: sros close robot --apply\n") == 1
    monkeypatch.setattr(processes, "SYSTEMD_FOLDER", robot.folder / "of root")
    assert f"settings: by hand, in {unit}\n" in robot.close().out
    by_hand = f"restart the unit with:\n  sudo systemctl restart {unit}\n"
    assert by_hand in robot.close("--apply", status=1).out
    monkeypatch.setattr(processes, "SYSTEMD_FOLDER", robot.folder / "systemd")

    class UntilRestarted(set[str]):
        def __contains__(self, enclave: object) -> bool:
            return not robot.restarts

    robot.outdated = UntilRestarted()
    robot.absent = {"/listener"}  # nobody else hears the talker
    assert "\nthe robot is closed" in robot.close("--apply", "--without", "/listener").err
    assert robot.restarts == ["daemon-reload", f"restart {unit}"]
    assert not [*robot.folder.glob("**/*.d/sros-close.conf")]
    open_again = f"first `systemctl disable --now {unit}`, because this unit starts it closed; then"
    start = f"open: {open_again} cd /opt && /opt/run talker\n"
    assert robot.close("--undo", status=1).out == f"restart process 4711 {start}"
    robot.absent = {*PID}
    (robot.folder / unit).write_text("ActiveState=activating\n")  # it waits for its restart
    assert robot.close("--undo", status=1).out == f"restart /talker {start}"
    assert "start again with" not in robot.close("--apply", "--without", "/listener", status=1).out
    assert robot.restarts[2:] == ["daemon-reload", f"restart {unit}"]
    (robot.folder / unit).write_text("ActiveState=inactive\n")
    robot.absent, robot.units, robot.by_hand = {"/listener"}, {}, set()
    assert "\nthe robot is open: " in f"\n{robot.close('--undo').err}"
    robot.units = {"/talker": unit}  # somebody took the variables out of the unit
    robot.close("--apply", status=1)
    assert (robot.folder / f"systemd/{unit}.d/sros-close.conf").exists()


@sometimes("a_unit_that_was_replaced_is_not_started_again", 1 / 2)
def test_a_unit_that_was_replaced_is_not_started_again(
    robot: Robot, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Otherwise, two drivers would run: the closed one of the stopped unit, and the open one."""
    robot.units = UNITS
    robot.close()
    robot.close("--apply")
    count, stray = len(robot.restarts), replace(robot.process("/talker", is_secured=False), pid=9)
    for unit in UNITS.values():
        (robot.folder / unit).write_text("ActiveState=inactive\n")
    robot.units = dict.fromkeys(PID, "both.service")  # its script starts both
    monkeypatch.setattr(processes, "start_of", lambda pid: f"{boot_id()} {pid} later")
    robot.more = (replace(stray, command=("/opt/run", "other")),)
    said = robot.close(status=1).out
    assert said.count("known by its command: by hand") == 2
    ended = robot.close("--apply", "--accept", "nodes", status=1)
    assert robot.restarts[count:] == []
    assert ended.out.count("both.service starts it: ") == 2
    assert "also open: process 9 (run); stop these processes, too" in ended.err
    assert "starts no stopped unit" not in robot.close("--undo", "--dry-run").err
    robot.by_hand = {*PID}
    assert "starts no stopped unit" not in robot.close("--undo", "--dry-run").err
    robot.by_hand = set()
    robot.more, robot.units = (), {**UNITS, "/talker": "new.service"}
    assert ": --apply restarts new.service" in robot.close().out
    robot.close("--apply")
    assert robot.restarts[count:] == ["daemon-reload", "restart new.service"]
    robot.absent, count = {"/talker"}, len(robot.restarts)
    for shown in ("ActiveState=inactive", "ActiveState=failed\nUnitFileState=disabled"):
        (robot.folder / "new.service").write_text(f"{shown}\n")
        said = robot.close("--apply", status=1).err
        assert "new.service did not run, and --apply starts no stopped unit; to start it" in said
    assert robot.restarts[count:] == []


@sometimes("a_process_that_moved_from_a_script_into_a_unit", 1 / 2)
def test_a_process_that_moved_from_a_script_into_a_unit(
    robot: Robot, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With the command that the script had; root restarts it closed."""
    robot.close()
    robot.by_hand, robot.units = {"/listener"}, {"/talker": "talker.service"}
    monkeypatch.setattr(processes, "start_of", lambda pid: f"{boot_id()} {pid} later")
    line = "/talker: process 4711, known by its command: "
    by_hand = f"{line}by hand, in talker.service"
    (robot.folder / "talker.service").write_text("MainPID=5\n")  # the script starts the process
    assert f"{by_hand}\n" in robot.close().out
    (robot.folder / "talker.service").write_text("MainPID=4711\n")
    of_root = robot.folder / "of root"
    for module in (start_files, state):
        monkeypatch.setattr(module, "SYSTEMD_FOLDER", of_root)
    as_root = " (as root, in a folder of root's, --apply restarts it)"
    assert f"{by_hand}{as_root}\n" in robot.close().out
    for module in (start_files, state):
        monkeypatch.setattr(module, "SYSTEMD_FOLDER", robot.folder / "systemd")
    assert f"{line}--apply restarts talker.service\n" in robot.close().out
    robot.close("--apply")
    assert robot.restarts == ["daemon-reload", "restart talker.service"]
    robot.close("--undo", status=1)
    assert robot.restarts[2:] == ["daemon-reload", "restart talker.service"]


@sometimes("units_that_do_not_restart_are_named", 1 / 2)
def test_units_that_do_not_restart_are_named(robot: Robot) -> None:
    robot.units = UNITS
    robot.close()
    (robot.folder / "status").write_text("1")
    ended = robot.close("--apply", status=2)
    assert "`systemctl daemon-reload` ended with 1" in ended.err and "--undo" in ended.err
    (robot.folder / "status").write_text("0")
    robot.close("--apply")
    for unit in UNITS.values():
        (robot.folder / unit).write_text("ActiveState=inactive\n")
    (robot.folder / "status").write_text("1")
    robot.close("--undo", status=2)
    (robot.folder / "status").write_text("0")
    count, robot.absent = len(robot.restarts), set(PID)
    undone = robot.close("--undo", status=1).out
    assert undone == "no process of the robot runs, open or secured: start its processes open\n"
    assert robot.restarts[count:] == ["daemon-reload"], "systemd still has the drop-ins"


def test_a_node_of_another_robot_is_not_proposed_for_another_machine(robot: Robot) -> None:
    """Its enclave is that of a process of this machine, whose key would leave the export."""
    robot.nodes += (ros_node("talker", "010f7f02671200000000", "publish rt/chatter"),)
    ended = robot.close(status=1)
    assert "nodes of /talker are in process 4711 and in another process" in ended.out
    assert "--elsewhere" not in ended.out


@sometimes("processes_that_show_no_id_are_to_be_named", 1 / 2)
def test_processes_that_show_no_id_are_to_be_named(robot: Robot) -> None:
    """As in containers, in each of which the only process has the id 1."""
    now, mapped = datetime.now(UTC), frozenset({"libfastrtps", "librcl"})
    robot.more = tuple(Process(pid, ("main",), {}, now, mapped, own_pid=1) for pid in (5, 6))
    robot.nodes += tuple(
        ros_node(name, f"010f7f0101000{index}00000000", "publish rt/chatter")
        for index, name in enumerate(("left", "right"))
    )
    said = robot.close(status=1).out
    assert ". Watch again while they run: sros close" in said
    assert "add the node's name to the command of each process (--ros-args" in said
    assert "for nodes of /left, /right. If they run on another machine" in said
    assert "from 'robot/policy.xml', and remove 'robot/requirements.toml', which sros then" in said


@sometimes("nothing_is_closed_of_what_is_not_understood", 1 / 2)
def test_nothing_is_closed_of_what_is_not_understood(robot: Robot) -> None:
    robot.units = UNITS
    robot.more = (Process(5, ("other", "--ros-args"), {}, datetime.now(UTC)),)
    assert (
        "first:\n  sros does not know a node of 1 open process: process 5 (o"
        in robot.close(status=1).out
    )
    assert (
        "While it runs open, the closed robot does not hear it (--accept nodes accepts this)"
        in robot.close("--apply", status=1).out
    )
    assert robot.restarts == []
    robot.more = (replace(robot.more[0], pid=6, environment={"ROS_DOMAIN_ID": "1"}),)
    ended, in_1 = robot.close("--for", "1s"), "process 6 (other) runs in domain 1, not in 0; to "
    in_1 += "close it, run `sros close ANOTHER_FOLDER --domain 1`"
    assert "process 6" not in ended.out and in_1 in ended.err
    assert f". Also {in_1}" in robot.close("--proof", status=1).out
    robot.close("--apply")


def test_a_renamed_node_is_compared_and_a_new_one_is_named(
    robot: Robot, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Or a robot whose node got another name could never be proved closed again."""
    robot.units, of, kept = UNITS, LISTENER[3], ("publish rt/cmd_vel", "publish rt/plan")
    rear = ros_node("rear_camera", of, "publish rt/rear_camera/image", "publish rt/odom", *kept)
    robot.nodes = (TALKER, LISTENER, rear)
    robot.close()
    policy = robot.folder / "robot/policy.xml"
    text = policy.read_text().replace('ns="/" node="rear_', 'ns="/nav" node="stern_')
    policy.write_text(text.replace(">cmd_vel<", ">/cmd_vel<").replace("<topic>plan</topic>", ""))
    said, denied = robot.close().out, "used: /listener publish topic /plan"
    assert said.count("used when sros watched") == 1 and f"{denied[4:]} (/nav/stern_c" in said
    moved = "publish rt/nav/stern_camera/image", "publish rt/nav/odom"
    stern_camera = ros_node("nav/stern_camera", of, *moved, kept[0])
    ghost = ("/", "/", "ghost_node", of, ["publish rt/rosout"])
    robot.remaining = (TALKER, LISTENER, stern_camera, ghost)
    said = robot.close("--apply").out
    talk = "yes, except for what the policy takes away: everything that talked can still talk: "
    assert (
        f"{talk}3 nodes with 56 endpoints as before (types are not compared)\n  "
        "the policy takes away 1 right that the robot " in said
    )
    new = "new, without a profile: /ghost_node in /listener"
    assert f"{denied}\n  {new}\n  compared " in said
    renamed = "compared under a new name: /rear_camera as /nav/stern_camera, and so /odom as /nav/o"
    assert f"\n  {renamed}dom (to keep a name, write it in policy.xml with a leading /)\n" in said
    renamed_alone = policy.read_text()
    policy.write_text(
        renamed_alone.replace(">odom</topic>", ">odom</topic><topic>/odom</topic>", 1)
    )
    robot.close()
    robot.nodes, audits = (), []

    def counted_audit(*asked: Any) -> Any:
        audits.append(asked)
        return audit(*asked)

    with monkeypatch.context() as patched:
        patched.setattr(nodes, "audit", counted_audit)
        said = robot.close("--proof").out
    assert f"{talk}3 nodes with 56 endpoints as before" in said and f"{renamed}dom (to" in said
    assert len(audits) == 2, "one of all possible names, one of the nodes"
    policy.write_text(renamed_alone)
    robot.close()
    robot.remaining = (TALKER, LISTENER, ros_node("nav/stern_camera", of, *moved))
    said = robot.close("--proof", status=1).out
    assert f"no: not {talk[44:]}not seen this time: /nav/stern_camera publish /cmd_vel; if" in said
    assert f"{renamed}dom" in said
    copied = re.sub(r'( *<profile ns="/nav" node=")stern(.*?</profile>)', r"\1stern\2\n\1bow\2",
                    policy.read_text(), flags=re.DOTALL)  # fmt: skip
    policy.write_text(copied.replace(">/cmd_vel<", ">/cmd_vel</topic><topic>/plan_b<", 1))
    robot.close()
    seen = robot.folder / "robot/observed.json"
    value = json.loads(seen.read_text())
    value["notes"].append(
        {"id": "graph.stray", "text": "left out, because they are alone: rt/odom"}
    )
    (talker,) = (node for node in value["nodes"] if node["name"] == "talker")
    talker["publish"].remove("rt/chatter")  # as a use that it learned later
    seen.write_text(json.dumps(value))
    bow_camera = ros_node("nav/bow_camera", of, "publish rt/nav/bow_camera/image")
    robot.remaining = (TALKER, LISTENER, stern_camera, bow_camera)
    unused, before = "allowed, but seen neither on the open robot nor now: ", said
    said = robot.close("--proof").out
    assert f"\n  {unused}/listener publish topic /plan_b\n  not" in said and unused not in before
    assert (
        "policy has no profile for them any more: /rear_camera (removed, or renamed together "
        in said
    )
    assert (
        "\n  not compared, because `sros close` did not see these on the open robot: "
        "/nav/bow_camera, /nav/stern_camera, /talker publish /chatter\n  not"
    ) in said
    assert "\n  not compared: writers or readers of rt/odom, which belonged to no ROS node" in said


def test_a_process_that_the_policy_lacks_keeps_its_command(robot: Robot) -> None:
    robot.nodes = (LISTENER,)
    robot.absent = {"/talker"}
    robot.close()
    lacking = sros("env", "robot/export", "/talker", cwd=robot.folder).err
    assert (
        "write the enclave's rights into robot/policy.xml, and run `sros close robot`." in lacking
    )
    revoked = sros("revoke", "robot/keystore", "/talker", cwd=robot.folder).err
    see = "see `sros list_enclaves robot/keystore`.\n"
    why = "Correct the name, because the ledger has no certificate of this name"
    assert revoked.endswith(f"{why}: {see}")
    policy = robot.folder / "robot/policy.xml"
    signed = policy.read_text()
    (enclave,) = re.findall('(?s)<enclave path="/listener">.*?</enclave>', signed)
    policy.write_text(signed.replace(enclave, enclave + enclave.replace("listener", "talker")))
    unsigned = sros("distribute_key", "robot/keystore", "/talker", "x", cwd=robot.folder).err
    assert "the change is not signed yet. Run `sros close robot`, which signs the" in unsigned
    policy.write_text(signed)
    robot.nodes, robot.absent = (TALKER, LISTENER), set()
    said = robot.close("--for", "1s", status=1).out
    add = "sros merge_policy robot/policy.xml robot/seen.xml --in-place"
    assert "(/talker publish /chatter" in said and f"; if it needs these rights: {add}\n" in said
    assert "the policy lacks enclaves that sros saw when it watched: /talker\n" in robot.close().out
    sros(*add.split()[1:], cwd=robot.folder).ok()
    said = robot.close().out
    assert "/talker: process 4711, known by its process id: by hand\n" in said
    assert "not in the policy" not in said
    commands = (robot.folder / "robot/start/commands.txt").read_text()
    assert "/talker -- /opt/run talker\n" in commands
    robot.absent = {"/talker"}
    talker = r'(?s)<enclave path="/talker">.*?</enclave>'
    policy.write_text(re.sub(talker, "", policy.read_text()))
    assert "saw when it watched: /talker\n" in robot.close(status=1).out
    renewal = ("robot/keystore", "/talker", "--new-key", "--revoke-old")
    sros("renew", *renewal, cwd=robot.folder).ok()
    assert "saw when it watched: /talker\n" in robot.close(status=1).out, "only a key is revoked"
    said = sros("revoke", "robot/keystore", "/talker", cwd=robot.folder).ok().err
    assert "first run `sros close robot`; then restart the processes of " in said
    assert "saw when it watched" not in robot.close().out, "the user took the enclave out"


def test_a_node_whose_enclave_the_graph_does_not_show_is_named(robot: Robot) -> None:
    """Any participant can have an identifier that looks like that of a secured one."""
    robot.nodes += (ros_node("ghost", "8f0f0000681200000000", "publish rt/cmd_vel"),)
    said = robot.close(status=1).out
    assert "these nodes belong to secured processes: /ghost. 'rob" in said
    robot.by_hand = set(PID)
    robot.nodes = (TALKER, LISTENER)
    assert (
        "2 nodes with 36 endpoints as before (types are not compared)" in robot.close("--proof").out
    )


def test_a_node_that_was_restarted_without_its_namespace(robot: Robot) -> None:
    left = ros_node("left/listener", LISTENER[3], "subscribe rt/left/chatter")
    robot.nodes = (TALKER, left)
    robot.close()
    robot.nodes = (TALKER, LISTENER)
    said = robot.close("--for", "1s", status=1).out
    hint = "perhaps /listener is /left/listener, started without its namespace (-r __ns:=/left)"
    assert f"; {hint}; if the node's command is wrong, restart the node with the right " in said
    robot.nodes = (TALKER, left, ros_node("listener", "010f0000071200000000"))
    assert "without its namespace" not in robot.close("--for", "1s", status=1).out


def test_a_process_with_the_name_of_another_is_not_signed(robot: Robot) -> None:
    """Or whoever calls itself /talker while sros watches gets its rights into /talker."""
    twin = ("/", "/", "talker", "010f0000070000000000", ["publish rt/cmd_vel"])
    robot.nodes = (*robot.nodes, twin)
    command, library = ("/tmp/evil", "a b"), frozenset({"libfastrtps", "librcl"})
    robot.more = (Process(7, command, {}, datetime.now(UTC), libraries=library),)
    said = robot.close(status=1).out
    both = "process 7 (/tmp/evil 'a b') and process 4711 (/opt/run talker) have nodes of the same"
    assert both in said
    assert not (robot.folder / "robot/keystore").exists()
    assert both in robot.close("--apply", status=1).out
    dry = robot.close("--dry-run", status=1).out
    assert both in dry and "rights, without" not in dry, "nothing is signed"
    robot.more, robot.absent = (), {"/talker"}
    both = "a process that ended (/tmp/evil 'a b') and a process that ended (/opt/run talker) have"
    assert both in robot.close(status=1).out, "the policy has the rights of both"
    robot.absent = set()
    talker = ClosedProcess("/talker", 7, ("talk",), "/opt", 0, "a.service", "program")
    accepted = ObservedProcesses(0, [talker, talker._replace(unit="b.service")])  # --partial
    assert accepted.units == {"a.service", "b.service"}
    robot.nodes, robot.more = robot.nodes[:2], ()
    (robot.folder / "robot/policy.xml").unlink()
    robot.close()
    assert "cmd_vel" not in (robot.folder / "robot/policy.xml").read_text()
    remembered = read_processes(robot.folder / "robot/processes.json")
    talker = next(one for one in remembered.processes if one.enclave == "/talker")
    runs = Process(7, ("talk",), {}, datetime.now(UTC), libraries=library)
    for known_by, robot.more in (("program", ()), ("enclave", (runs,))):
        same = talker._replace(pid=7, command=("talk",), known_by=known_by)
        twins = remembered._replace(processes=[*remembered.processes, same])
        content = json.dumps(as_plain(twins))
        (robot.folder / "robot/processes.json").write_text(content)
        said = robot.close().out
        assert "have nodes of the same name" not in said, "one has ended, or ran in the enclave"
        assert "known by its enclave" not in said, "it runs open now"


def test_a_program_that_starts_its_nodes_has_one_enclave(
    robot: Robot, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One command starts all of them; a node that moved to its enclave still has to talk."""
    program, of_root = (4700, ("python3", "pumps.py")), robot.process
    monkeypatch.setattr(
        robot, "process", lambda *e, **more: replace(of_root(*e, **more), forked_by=program)
    )
    said = robot.close("--partial", status=1).out
    assert "  python3 pumps.py starts the processes of /listener and /talker, and all of" in said
    assert not (robot.folder / "robot/keystore").exists()
    policy = robot.folder / "robot/policy.xml"
    moved = re.sub(
        r' *</profiles>\s*</enclave>\s*<enclave path="/talker">\s*<profiles>\n',
        "",
        policy.read_text(),
    )
    policy.write_text(moved)
    ended = robot.close()
    assert "  /listener: process 4700, known by its process id, for the nodes /l" in ended.out
    commands = (robot.folder / "robot/start/commands.txt").read_text()
    export = robot.folder / "robot/export"
    assert f"cd /opt && sros run {export} /listener -- python3 pumps.py\n" in commands
    assert "/talker --" not in commands
    robot.close("--for", "1s")  # the policy has all rights, in the other enclave
    robot.by_hand, in_one = {"/listener"}, lambda *nodes: [("/listener", *of[1:]) for of in nodes]
    robot.absent = {"/talker"}
    monkeypatch.setattr("tests.cli.test_close.secured", in_one)
    assert (
        "talk: 2 nodes with 36 endpoints as before (types are not compared)\n"
        in robot.close("--proof").out
    )
    robot.remaining = (LISTENER,)
    said = robot.close("--proof", status=1).out
    assert "no: not everything that talked can still talk: not seen: /talker (process" in said


def test_a_program_that_gives_its_processes_their_enclaves(
    robot: Robot, monkeypatch: pytest.MonkeyPatch
) -> None:
    spawned = ("python3", "-c", "from multiprocessing.spawn import spawn_main; spawn_main(4)")
    of_root = robot.process

    def process_of(enclave: str, **more: Any) -> Process:
        made = replace(of_root(enclave, **more), forked_by=(4700, ("python3", "pumps.py")))
        environment = {"ROS_SECURITY_ENCLAVE_OVERRIDE": enclave, **made.environment}
        return replace(made, command=spawned, environment=environment)

    monkeypatch.setattr(robot, "process", process_of)
    library = frozenset({"libfastrtps", "librcl"})
    robot.more = (Process(4700, ("python3", "pumps.py"), {}, datetime.now(UTC), libraries=library),)
    robot.close()
    said = robot.close("--apply", status=1).out
    run = f"sros run {robot.folder / 'robot/export'} /listener -- python3 pumps.py\n"
    assert f"stop process 4700, and start again with:\n  cd /opt && {run}" in said
    assert said.count("pumps.py") == 1


def test_tools_that_ended_while_sros_watched(robot: Robot, monkeypatch: pytest.MonkeyPatch) -> None:
    """The commands of those that sros saw running are known then."""
    tool, look, job = (
        ros_node(name, f"010f00000{number}0000000000", f"publish rt/{name}")
        for number, name in enumerate(("tool", "look", "job"), 7)
    )
    library = frozenset({"libfastrtps", "librcl"})
    seen = {7: ("/opt/tool", "a b"), 9: ("/opt/job",), 10: ("ros2", "topic", "list")}
    origins = {9: ProcessOrigin("job.service", "/opt")}
    find_origins(monkeypatch, lambda pid: origins.get(pid, ProcessOrigin("", "/opt")))
    again = ros_node("job", "010f0000060000000000", "publish rt/job")
    run, left = close._run, json.dumps([f"{node[3]}0000" for node in (tool, look, job, again)])

    def ran(words: Any, live: bool) -> tuple[int, str, str]:
        robot.more = tuple(
            Process(pid, command, {}, datetime.now(UTC), libraries=library)
            for pid, command in seen.items()
        )
        status, output, messages = run(words, live)
        robot.more = ()
        output = output.replace('"settled": true', '"settled": false')
        return status, output.replace('"ended": []', f'"ended": {left}'), messages

    monkeypatch.setattr(close, "_run", ran)
    robot.nodes = (TALKER, LISTENER, tool, look, job, again)
    ended = robot.close("--for", "1s")
    assert "\nsaw 5 nodes, and " in ended.err
    assert "when the whole robot runs, watch again: sros close robot --for 5m\n" in ended.err
    run_it = f"sros run {robot.folder / 'robot/export'}"
    assert f"  /look: has ended, start it with: {run_it} /look -- COMMAND\n" in ended.out
    assert "  /tool: has ended: by hand\n" in ended.out
    assert "  /job: has ended: --apply adds a drop-in to job.service\n" in ended.out
    commands = (robot.folder / "robot/start/commands.txt").read_text()
    assert f"# /look has ended: COMMAND is what starts it\n{run_it} /look -- COMMAND" in commands
    assert f"# /tool\ncd /opt && {run_it} /tool -- /opt/tool 'a b'\n" in commands
    applied = robot.close("--apply", status=1).err
    assert applied.endswith("--proof --without /job --without /look --without /tool\n")
    assert robot.restarts == ["daemon-reload", "try-restart job.service"]


def test_a_policy_with_an_error_closes_nothing(robot: Robot) -> None:
    robot.units = UNITS
    robot.close()
    policy = robot.folder / "robot/policy.xml"
    rosout = policy.read_text()
    policy.write_text("".join(e for e in rosout.splitlines(True) if "<xi:include" not in e))
    assert policy.read_text() != rosout
    ended = robot.close("--apply", status=1)
    assert "  findings of `sros check robot/policy.xml" in ended.out
    assert robot.restarts == []


def test_processes_of_another_user_need_the_files(
    robot: Robot, monkeypatch: pytest.MonkeyPatch
) -> None:
    robot.units = UNITS
    of_root = robot.process
    monkeypatch.setattr(
        robot, "process", lambda enclave, **more: replace(of_root(enclave, **more), user=1234)
    )
    (robot.folder / "robot").mkdir(mode=0o700)
    said = robot.close(status=1).out
    assert "chown -R 1234 robot/export" in said
    assert "  user 1234, who runs processes, cannot enter '/" in said
    robot.close("--apply", status=1)
    assert robot.restarts == []


def test_what_only_root_can_do_names_the_command_of_root(
    robot: Robot, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The folder of an ordinary user cannot become that of root, nor the keystore the user's."""
    robot.units, folder = UNITS, robot.folder / "robot"
    monkeypatch.setattr(start_files, "SYSTEMD_FOLDER", robot.folder / "of root")
    shell = " in a root shell (`sudo -s`) in which ROS 2 and sros are set up"
    begin = "`sros close /opt/robot` (or another folder of root that the users of the nodes can "
    only = "only root can restart listener.service and talker.service"
    is_root = os.geteuid() == 0
    apply_here = f"`sros close robot --apply`{shell}" if is_root else f"{begin}enter){shell}"
    assert robot.close().err.endswith(f"yet; next: {apply_here}, because {only}\n")
    if is_root:
        os.chown(folder, 1234, -1)
    before = snapshot(folder)
    said = robot.close("--apply", status=2, SUDO_UID="1234").err
    assert said.endswith(f": {only}. Nothing was changed. Run {begin}enter){shell}.\n")
    assert not robot.restarts and snapshot(folder) == before and "+ " not in said
    for words in ((), ("--dry-run",)) if is_root else ():
        said = robot.close(*words, status=2, SUDO_UID="1234").err
        assert "others can change 'robot'. " in said and "it belongs to user 1234. Root" in said
        assert "such as /opt: `sudo cp -a robot /opt/robot`, `sudo chown -R root: /opt" in said
        assert snapshot(folder) == before and "+ " not in said
    if is_root:
        os.chown(folder, 0, -1)
    monkeypatch.setattr(start_files, "SYSTEMD_FOLDER", robot.folder / "systemd")
    robot.close("--apply")
    monkeypatch.setattr(start_files, "SYSTEMD_FOLDER", robot.folder / "of root")
    assert f"{only}. Nothing was changed. " in robot.close("--undo", status=2).err
    allowed = os.access
    unreadable = folder.relative_to(robot.folder) / "keystore/private"
    monkeypatch.setattr(os, "access", lambda path, mode: path != unreadable and allowed(path, mode))
    for words in (("--proof",), ()):
        said = robot.close(*words, status=2).err
        assert "cannot read the keystore 'robot/keystore'. It belongs to user " in said
        assert "has the CA keys: do not give it to the user of the nodes. Run `sros close " in said
        assert f"{' '.join(('robot', *words))}`{shell if is_root else ' as user '}" in said


def test_root_reads_any_export(tmp_path: Path) -> None:
    export = tmp_path / "export"
    export.mkdir()
    if os.geteuid() == 0:
        os.chown(export, 1234, -1)
    shell = Shell(close._run, print, {}, lambda: datetime.now(UTC), UTC)
    robot = LocalRobot(tmp_path, 0, shell)
    for user, said in ((0, ""), (4321, "chown -R 4321 "), (SEVERAL_USERS, "start it as one user")):
        process = ClosedProcess("/a", 7, ("a",), "/", user, "", "program")
        problems = " ".join(preparation._user_problems(robot, ObservedProcesses(0, [process])))
        assert said in problems and str(SEVERAL_USERS) not in problems
        assert ("chown -R " in problems) is (user == 4321)
    of_several = [ClosedProcess(f"/{user}", 7, ("a",), "/", user, "", "") for user in (4321, 4322)]
    (problem,) = preparation._user_problems(robot, ObservedProcesses(0, of_several))
    assert "processes ran as user 4321 and user 4322, but only one user can read the" in problem
    assert "chown" not in problem and "User=" in problem


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("--apply --undo", "exclude each other"),
        ("--apply --for 1s", "--for is for watching"),
        ("--proof --dry-run", "--proof changes nothing. Leave --dry-run out."),
        (
            "--proof --accept nodes",
            "--accept nodes would accept nothing here. Leave it out. `nodes` is",
        ),
        ("--accept unexamined", "--accept unexamined would accept nothing here"),
        ("--undo --accept requirements", "--accept requirements would accept nothing here"),
        ("--undo --partial", "--partial would accept nothing with --undo. Leave it out."),
        ("--apply --accept nodes --accept unexamined", "there is no folder 'robot' here"),
        ("--apply", "there is no folder 'robot' here. This is '/"),
        ("--proof", "Unable to prove that the robot is closed: there is no folder 'robot' here. "),
        ("--undo", "Unable to open the robot: there is no folder 'robot' here. This is '/"),
    ],
)
def test_what_is_refused(robot: Robot, words: str, said: str) -> None:
    assert said in robot.close(*words.split(), status=2).err
    assert not (robot.folder / "robot").exists()


def test_a_robot_that_cannot_be_watched_is_refused(robot: Robot) -> None:
    robot.more = (Process(5, ("rmw_zenohd",), {}, datetime.now(UTC)),)
    assert "speaks Zenoh" in robot.close(status=2).err
    assert not (robot.folder / "robot").exists()
    robot.more = ()
    said = robot.close(status=2, RMW_IMPLEMENTATION="rmw_zenoh_cpp").err
    assert "process 4711 (run) speaks DDS, but this shell is set up for Zenoh. Run `unset " in said
    robot.more, robot.nodes = (Process(5, ("a",), {"ROS_DOMAIN_ID": "7"}, datetime.now(UTC)),), ()
    ended = robot.close(status=2)
    run = "run `sros close robot --domain 7`"
    there = f"process 5 (a) runs in domain 7, not in 0; to close it, {run}"
    assert f"to close: no node was observed in domain 0. {there}. Otherwise start the" in ended.err
    closed = Process(5, ("a",), {}, datetime.now(UTC), enclave=ProcessEnclave("/r/export", "/a"))
    robot.more = (closed,)
    there = "Processes run with the files of '/r/export': if that is the robot, name its folder, n"
    assert f"in domain 0. {there}" in robot.close(status=2).err
    robot.more = ()
    assert not (robot.folder / "robot").exists()
    (robot.folder / "robot").mkdir()  # by somebody else: it stays
    assert "has no watched robot" in robot.close("--proof", status=2).err
    assert "no node was observed in domain 0. Start the robot open" in robot.close(status=2).err
    assert (robot.folder / "robot").exists()
    robot.nodes, robot.more = (TALKER, LISTENER), (closed,)
    assert there in robot.close(status=1).out
    assert there not in robot.close(status=1).out, "they may be of another robot"
    shutil.rmtree(robot.folder / "robot")
    (robot.folder / "robot").mkdir()
    robot.more = ()
    robot.close()
    assert "was watched in domain 0, not 7" in robot.close("--domain", "7", status=2).err
    file = robot.folder / "robot/processes.json"
    text = file.read_text()
    other_unit = text.replace('"unit": ""', '"unit": "../x.service"')
    other_user = re.sub(r'"user": \d+', '"user": "a"', text, count=1)
    other_name = text.replace('"ended": []', '"ended": [{}]')
    other_map = text.replace('"brought": {}', '"brought": 5')
    number = text.replace('"enclave": "/talker"', '"enclave": 5')
    assert len({text, other_unit, other_user, other_name, other_map, number}) == 6
    file.write_text(text.replace('"rmw": ""', '"rmw": "rmw_zenoh_cpp"'))
    for words in ((), ("--proof",), ("--apply",)):
        said = robot.close(*words, status=2).err
        assert "this robot runs on rmw_zenoh_cpp. " in said
        assert "Set RMW_IMPLEMENTATION=rmw_zenoh_cpp." in said
    for rmw, remedy in (("", "Unset RMW_IMPLEMENTATION, as"), ("rmw_a", "Set RMW_IMPLEMENTATION=")):
        file.write_text(text.replace('"rmw": ""', f'"rmw": "{rmw}"'))
        said = robot.close("--proof", status=2, RMW_IMPLEMENTATION="rmw_zenoh_cpp").err
        assert "this robot runs on DDS. " in said and f" {remedy}{rmw}" in said
    for wrong in (other_unit, other_user, other_name, other_map, number, "{}", "[" * 100_000):
        file.write_text(wrong)
        assert "is not a list of processes" in robot.close(status=2).err


def test_a_secured_shell_proves_nothing(robot: Robot) -> None:
    """A listener that is secured itself hears no open node, whoever is there."""
    refused = "ROS_SECURITY_ENABLE is set, so this shell does not see an open robot. "
    assert refused in robot.close(status=2, ROS_SECURITY_ENABLE="true").err
    robot.units = UNITS
    robot.close()
    assert refused in robot.close("--apply", status=2, ROS_SECURITY_ENABLE="true").err
    assert robot.restarts == []
    robot.close("--apply")
    robot.nodes = (*robot.nodes, ("/", "/", "spy", "03", ["subscribe rt/chatter"]))
    (robot.folder / "fast.xml").write_text("<name>dds.sec.auth.plugin</name>")
    for variable, value in (
        ("ROS_SECURITY_ENABLE", "true"),
        ("FASTRTPS_DEFAULT_PROFILES_FILE", "fast.xml"),
    ):
        ended = robot.close("--proof", status=2, **{variable: value})
        assert variable in ended.err and "does not see an open robot" in ended.err


def test_one_run_at_a_time_writes_into_the_folder(robot: Robot) -> None:
    """Or an hour of watching forgets the enclaves that were given to another machine meanwhile."""
    robot.close()
    folder = os.open(robot.folder / "robot", os.O_RDONLY)
    fcntl.flock(folder, fcntl.LOCK_SH)  # even with this, nobody is alone
    before = snapshot(robot.folder)
    # After an --undo meanwhile, an --apply would close again what was said to be open.
    for words in (("--elsewhere", "/listener"), ("--undo",)):
        said = robot.close(*words, status=2).err
        assert "another `sros close robot` is at work" in said and snapshot(robot.folder) == before
    robot.close("--dry-run")
    robot.close("--proof", status=1)
    robot.close("--undo", "--dry-run")
    os.close(folder)
    shell = Shell(close._run, print, os.environ, lambda: datetime.now(UTC), UTC)
    waits, works = (LocalRobot(robot.folder / "robot", None, shell) for _ in range(2))
    observed = works.processes
    works.write_processes(observed.belonging_elsewhere(["/listener"]))
    with waits.locked():
        assert waits.not_here == {"/listener"}
    works.write_processes(observed)
    robot.close()


def stops_as_the_run_stops(robot: Robot, policy: Path, signed: str) -> None:
    """A dry run finds what the run would find, up to the first refusal."""
    head, enclave, _ = signed.partition('    <enclave path="/talker">')
    for edited, reason, signs in (
        (signed.replace('subscribe="ALLOW"', 'publish="ALLOW"', 1), "edit robot/requireme", False),
        (signed.replace("chatter", "chat"), "protects /chatter, which the policy does", False),
        (f"{head}</enclaves></policy>\n", "the keystore has /talker, and the policy d", True),
    ):
        assert edited != signed and enclave
        policy.write_text(edited)
        before = snapshot(robot.folder)
        dry = robot.close("--dry-run", status=1)
        assert snapshot(robot.folder) == before
        assert ("would run: sros generate_artifacts" in dry.err) is signs, dry
        assert ("sros would sign nothing" in dry.out) is not signs, dry
        assert "rights, without" not in dry.out, "the policy is not what was signed"
        for ended in (dry, robot.close(status=1)):
            assert "; but fix this first:\n  " in ended.out and reason in ended.out, ended


def test_a_dry_run_changes_nothing(robot: Robot) -> None:
    assert "would run: sros generate_policy robot/policy.xml" in robot.close("--dry-run").err
    assert not (robot.folder / "robot").exists()
    robot.units = UNITS
    robot.close()
    policy = robot.folder / "robot/policy.xml"
    signed = policy.read_text()
    policy.write_text(signed.replace("chatter", "old/chatter", 1))
    before = snapshot(robot.folder)
    ended = robot.close("--apply", "--dry-run")
    assert "kept: sros create_keystore" in ended.err
    assert "/listener would lose: subscribe topic /chatter\n" in ended.err
    assert "would run: systemctl restart listener.service\nwould run: systemctl rest" in ended.err
    assert snapshot(robot.folder) == before
    stops_as_the_run_stops(robot, policy, signed)
    policy.write_text(signed)
    robot.close("--apply")
    before = snapshot(robot.folder)
    assert "would remove " in robot.close("--undo", "--dry-run").err
    assert snapshot(robot.folder) == before


def test_what_is_printed_as_json(robot: Robot, monkeypatch: pytest.MonkeyPatch) -> None:
    """Also the process ids that the processes have after their restart."""
    of_root = robot.process

    def process_of(enclave: str, *, is_secured: bool) -> Process:
        made = of_root(enclave, is_secured=is_secured)
        return replace(made, pid=made.pid + 1000 * is_secured)

    monkeypatch.setattr(robot, "process", process_of)
    seen = Seen()
    robot.units = UNITS
    for words in ("--dry-run", "", "--apply", "--proof", "--undo"):
        ended = robot.close(*words.split(), "--json")
        seen.check("close", ended)
        if words == "--apply":
            pids = {process["pid"] for process in json.loads(ended.out)["processes"]}
            assert pids == {pid + 1000 for pid in PID.values()}
    assert seen.unseen("close") == []


def test_no_command_of_another_user_is_proposed(robot: Robot) -> None:
    """Anybody can start a program whose variables name the export."""
    robot.close()
    robot.by_hand, robot.absent = {"/talker", "/listener"}, {"/talker"}
    export = robot.folder / "robot/export"
    variables = secured_environment(export, "/talker", 0)
    later = datetime.now(UTC) + timedelta(days=1)
    mapped = frozenset({"libfastrtps", "librcl"})
    command = ("/tmp/evil", "--as-root")
    robot.more = (robot.with_its_files(Process(66, command, variables, later, mapped, user=12345)),)
    words = {**graph(), "secured": graph(*secured(*robot.remaining))}
    ended = robot.beside("close", words, "robot", "--undo")
    assert "evil" not in ended.out
    assert "restart /talker open: cd /opt && /opt/run talker" in ended.out


def test_what_is_exported_without_the_enclaves_of_other_machines(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The key of a laptop, or of a computer to which a process moved, is not on this one."""
    enclaves = "".join(
        f'<enclave path="/{name}"><profiles><profile ns="/" node="n"/></profiles></enclave>'
        for name in "ab"
    )
    policy = f'<policy version="0.2.0"><enclaves>{enclaves}</enclaves></policy>'
    (tmp_path / "policy.xml").write_text(policy)
    start = ClosedProcess("/a", 7, ("talk",), "/opt", 0, "", "program")
    observed = ObservedProcesses(0, [start, start._replace(enclave="/b")])
    (tmp_path / "processes.json").write_text(json.dumps(as_plain(observed)))
    shell = Shell(close._run, print, {}, lambda: datetime.now(UTC), UTC)
    robot = LocalRobot(tmp_path, 0, shell, elsewhere=["/b"])
    exported = [
        step.words[2:-2] for step in steps(robot, None) if step.words[0] == "distribute_key"
    ]
    assert exported == [("/a", "/sros_observer")]
    moved = observed.belonging_elsewhere(["/b"])
    assert [each.enclave for each in moved.processes] == ["/a"] and moved.not_here == ["/b"]
    # What its machine has from before a revocation trusts the revoked key.
    (shared := tmp_path / "crl.pem").touch()
    os.utime(shared, (0, revoked := 1_800_000_000))
    (folder := tmp_path / "keystore/enclaves/b").mkdir(parents=True)
    (folder / "crl.pem").symlink_to(shared)
    state_now = state.current_state(robot, None)
    assert state_now.needed_elsewhere == {"/b": datetime.fromtimestamp(revoked, UTC)}
    for problems in ((), ("the policy is broken",)):
        now = state_now._replace(problems=problems, blocked=bool(problems))
        close._show_end(robot, now, apply=False, holds=False, accepted=set())
        said = capsys.readouterr()
        assert ("fix this first" in said.out) is bool(problems)
        assert (
            "need the current files of /b (2027-01-15T08:00:00Z); bring the output of" in said.err
        )
    # Until the files change, their machine has those that --brought said are there.
    when = state_now.needed_elsewhere
    robot.named_brought = ["/b"]
    robot.observed = moved._replace(brought=robot.brought_now())
    for at, expected in ((revoked, ({}, when)), (revoked - 1, (when.keys(), {}))):
        os.utime(shared, (0, at))
        state_now = state.current_state(robot, None)
        needed = state_now.needed_elsewhere
        assert (needed and needed.keys(), state_now.brought) == expected
    assert robot.observed.belonging_here(["/b"]).brought == {}


def test_a_requirement_that_lost_its_right_is_told_before_a_review_fails(tmp_path: Path) -> None:
    reader = subscribe("x")
    (tmp_path / "policy.xml").write_text(policy_text({"/a": publish("x"), "/r": reader}))
    said: list[str] = []

    def run(words: Any, live: bool) -> tuple[int, str, str]:
        _, output, messages = close._run(words, live)
        return 0, output, messages  # the policy has other errors

    shell = Shell(run, said.append, {}, lambda: datetime.now(UTC), UTC)
    robot = LocalRobot(tmp_path, 0, shell)
    (guard,) = (step for step in steps(robot, None) if step.guards)
    for name, told in (("x", False), ("gone", True)):
        needed = f'[[only]]\npublish = ["/{name}"]\nenclaves = ["/a"]\n'
        (tmp_path / "requirements.toml").write_text(needed)
        preparation._run_step(robot, guard, accepted=set())
        assert ("`sros review` refuses a requirement" in said[-1]) is told, said
    # A name that is changed only in the policy loses its protection.
    sros("create_keystore", robot.keystore).ok()
    sros("generate_artifacts", "-k", robot.keystore, "-p", robot.policy).ok()
    assert preparation._run_step(robot, guard, accepted=set()) == ("done", []), "as before"
    readers = '[[only]]\nsubscribe = ["/x"]\nenclaves = ["/b", "/r"]\n'
    robot.requirements.write_text(needed.replace("gone", "x") + readers)
    for groups, other, lost in (
        (publish("*"), "", False),  # a wildcard in place of the name
        (publish("y"), publish("*"), True),  # a wildcard that another enclave has
        (publish("y"), "", True),
        (publish("y"), subscribe("x"), True),  # somebody still has the other side
    ):
        reads = subscribe("y") if lost else reader
        robot.policy.write_text(policy_text({"/a": groups, "/b": other, "/r": reads}))
        state_of_step, problems = preparation._run_step(robot, guard, accepted=set())
        assert state_of_step == ("findings" if lost else "done"), groups
        why = "which the policy does not name any more"
        if other == subscribe("x"):
            why = "but the policy now uses another name in its place"
        places = [problem.partition("requirements.")[2] for problem in problems]
        said_now = [f"toml:{line} protects /x, {why}; nothing was signed" for line in (1, 4)]
        assert [place.partition(". If")[0] for place in places] == said_now * lost
    # A later name gets no requirement by itself, unlike those of the first policy.
    lost_policy = robot.policy.read_text()
    one_end = {"/a": publish("x", "z"), "/r": reader}
    both_ends = one_end | {"/s": subscribe("z")}
    for stated, names, is_told, is_signed in (
        (both_ends, "/x", True, False),
        (both_ends, "/z", False, False),
        (both_ends, "/*", False, False),
        (one_end, "/x", False, True),
        (both_ends, "/x", True, True),  # the other end came later
        (both_ends, "/x", False, False),  # it was named before it was signed
    ):
        robot.policy.write_text(policy_text(stated))
        robot.requirements.write_text(needed.replace("/gone", names))
        said.clear()
        assert preparation._run_step(robot, guard, accepted=set()) == ("done", [])
        hints = [line for line in said if line.startswith("no requirement protects /z: `sros")]
        assert len(hints) == is_told, said
        if is_signed:
            sros("generate_artifacts", "-k", robot.keystore, "-p", robot.policy).ok()
    robot.policy.write_text(lost_policy)
    robot.requirements.write_text(needed.replace("gone", "x"))
    assert preparation._run_step(robot, guard, accepted={Acceptance.REQUIREMENTS}) == ("done", [])


def test_a_process_with_a_new_key_is_restarted_before_others(tmp_path: Path) -> None:
    """The others only need to know that its old key is revoked."""
    shell = Shell(close._run, print, {}, lambda: datetime.now(UTC), UTC)
    processes = [
        ClosedProcess(enclave, 1, (enclave[1:],), "/", 0, "", "node name")
        for enclave in ("/a", "/b", "/c")
    ]
    now = state.current_state(LocalRobot(tmp_path, 0, shell), None)._replace(
        observed=ObservedProcesses(0, processes),
        secured=dict.fromkeys(("/a", "/b", "/c"), False),
        outdated={
            "/a": state._ACCEPTS_REVOKED,
            "/b": f"others can read it; {state._ACCEPTS_REVOKED}",
            "/c": "key.pem changed, or got another mode, after the start of",
        },
    )
    order = [process.enclave for (process,) in now.pending_by_hand.values()]
    assert order == ["/c", "/a", "/b"]


def test_of_revoked_enclaves_no_folder_stays_in_the_export(keystore: Path, tmp_path: Path) -> None:
    """A folder that another enclave needs stays."""
    (tmp_path / "keystore").symlink_to(keystore)
    names = ("/mast/imu", "/mast/top/cam", "/arm", "/arm/left", "/arm/right")
    sros("create_enclave", keystore, *names).ok()
    sros("distribute_key", keystore, *names, tmp_path / "export").ok()
    sros("revoke", keystore, *names[:4]).ok()
    shell = Shell(close._run, print, {}, lambda: datetime.now(UTC), UTC)
    preparation._remove_enclaves(LocalRobot(tmp_path, 0, shell))
    enclaves = tmp_path / "export/enclaves"
    folders = {str(path.relative_to(enclaves)) for path in enclaves.rglob("*") if path.is_dir()}
    assert folders == {"arm", "arm/right"}


def test_a_robot_whose_files_expire_soon(keystore: Path, tmp_path: Path) -> None:
    sros("distribute_key", keystore, "/a", "/b", tmp_path / "export").ok()
    sros("create_enclave", keystore, "/operator/look").ok()  # works for a day
    (tmp_path / "keystore").symlink_to(keystore)

    def robot_at(moment: datetime) -> LocalRobot:
        shell = Shell(close._run, print, {}, lambda: moment, UTC)
        return LocalRobot(tmp_path, 0, shell, elsewhere=["/b", "/operator/look"])

    def state_at(moment: datetime) -> state.CloseState:
        found = state.current_state(robot_at(moment), None)
        return found._replace(folder=Path("robot"), secured={"/a": True})

    now = state_at(datetime.now(UTC))
    assert now.valid_until and not now.expired_elsewhere
    early = now.valid_until - timedelta(days=1)
    (soon,) = close._validity_lines(robot_at(early), state_at(early))
    assert soon.endswith("Z; renew them now: sros renew robot/keystore --all-expiring soon")
    settings = keystore / "sros.toml"
    settings.write_text(settings.read_text() + '[[enclaves]]\nnames = ["/a"]\nvalidity = "3d"\n')
    (soon,) = close._validity_lines(robot_at(early), state_at(early))
    assert soon.endswith("renew them now: sros renew robot/keystore /a --all-expiring soon")
    later = now.valid_until + timedelta(seconds=1)
    said = close._other_machines_lines(robot_at(later), state_at(later))[-1]
    assert f"have expired: /b ({iso(now.valid_until)}), /operator/look (" in said
    assert "; to renew them, run `sros renew" in said
    assert not state_at(later).earlier_elsewhere
    for days in (5, 0):
        renew(keystore, ["/operator/look"], now=datetime.now(UTC) + timedelta(days=days))
    expired = datetime.now(UTC) + timedelta(days=2)
    said = close._other_machines_lines(robot_at(expired), state_at(expired))[-1]
    (until,) = state_at(expired).earlier_elsewhere.values()
    here = proof.expired_text(robot_at(expired), ["/operator/look"])
    assert "(with --revoke-old, because earlier files of /operator/look still work for" in here
    assert "--revoke-old" not in proof.expired_text(robot_at(later), ["/a"])
    ended = proof.expired_text(robot_at(later), ["/a", "/b"])
    assert close._validity_lines(robot_at(later), state_at(later)) == [ended]
    assert ended.startswith("the files of /a, /b have expired; run `sros renew "), ended
    assert timedelta(days=3) < until - expired < timedelta(days=5)
    assert (
        f"their rights until the files expire: /operator/look ({iso(until)}); to end this" in said
    )
    # The line names an enclave that expires long before the others.
    sros("distribute_key", keystore, "/operator/look", tmp_path / "export", "--force").ok()
    look = state_at(moment := datetime.now(UTC))
    (line,) = close._validity_lines(robot_at(moment), look)
    others = f"(those of /operator/look; the others until {iso(now.valid_until)}); have"
    assert look.valid_until and line.startswith(
        f"the files are valid until {iso(look.valid_until)} {others}"
    )
    (tmp_path / "export/enclaves/b/permissions.p7s").write_bytes(b"damaged")
    assert state_at(datetime.now(UTC)).valid_until is None, "nobody knows until when /b works"


def test_a_process_with_older_files_of_an_enclave_is_no_closed_process(robot: Robot) -> None:
    """As a thief's; it would not get a revocation list of this folder. Twin: the robot's own."""
    robot.close()
    shutil.copytree(robot.folder / "robot/export", copy := robot.folder / "copy", symlinks=False)
    robot.by_hand = {"/talker", "/listener"}
    for spelled, status in (("robot/export", 0), ("copy", 1)):
        robot.spelled = spelled
        copied = copy / "enclaves/talker/permissions.p7s"
        copied.write_bytes(copied.read_bytes() + b"\n")
        robot.more = (replace(robot.process("/talker", is_secured=True), pid=13),)
        robot.spelled = "robot/export"
        robot.absent = {"/talker"} if status else set()
        ended = robot.close(status=status)
        runs = "enclaves, except for /talker (secured with other files); but fix this first:\n"
        assert (runs in ended.out) == bool(status), ended
        said = f"  process 13 (run): it runs in /talker from '{copy}', not from '{robot.folder}"
        assert (f"{said}/robot/export': stop it; if it belongs to the robot" in ended.out) == bool(
            status
        ), ended


def test_a_thief_does_not_keep_units_from_a_revocation(robot: Robot) -> None:
    """Only the restart makes it effective. An error of the files blocks the restart."""
    robot.units = {"/talker": "talker.service"}
    robot.close()
    robot.by_hand = {"/listener"}
    shutil.copytree(robot.folder / "robot/export", copy := robot.folder / "copy")
    (copy / "enclaves/talker/permissions.p7s").write_bytes(b"of the earlier key")
    robot.close("--apply")
    robot.spelled = "copy"
    robot.more = (replace(robot.process("/talker", is_secured=True), pid=13),)
    robot.spelled, count = "robot/export", len(robot.restarts)
    thief = f"  process 13 (run): it runs in /talker from '{copy}', not from "
    said = robot.close("--apply", status=1).out
    assert f"the processes run in their enclaves; but fix this first:\n{thief}" in said
    assert robot.restarts[count:] == []

    class UntilRestarted(set[str]):
        def __contains__(self, enclave: object) -> bool:
            is_due = enclave == "/talker" and len(robot.restarts) == count
            return is_due or enclave in by_hand

    by_hand: set[str] = set()
    robot.outdated = UntilRestarted()
    ended = robot.close(status=1)
    assert f"but fix this:\n{thief}" in ended.out
    assert "next: sros close robot --apply, which restarts talker.service in any" in ended.err
    needed = robot.folder / "robot/requirements.toml"
    kept = needed.read_text()
    needed.write_text('[[only]]\npublish = ["/chatter"]\nenclaves = ["/listener"]\n')
    assert "but fix this first:" in robot.close("--apply", status=1).out
    needed.write_text(kept)
    assert robot.restarts[count:] == []
    ended = robot.close("--apply", status=1)
    assert robot.restarts[count:] == ["daemon-reload", "restart talker.service"]
    assert f"the processes run in their enclaves; but fix this:\n{thief}" in ended.out
    assert "every process in an enclave belongs there: sros did not see process 13" in ended.out
    by_hand, count = {"/listener"}, len(robot.restarts)
    ended = robot.close("--apply", status=1)
    assert robot.restarts[count:] == ["daemon-reload", "restart talker.service"]
    assert "start again with:\n  cd /opt && " in ended.out and "next: do this, and" in ended.err
    known = robot.folder / "robot/processes.json"
    known.write_text(known.read_text().replace('"unit": ""', '"unit": "listener.service"'))
    robot.units, robot.by_hand, by_hand = UNITS, set(), set()
    count = len(robot.restarts)
    ended = robot.close("--apply", status=1)
    assert "except for /listener (open); but fix this:" in ended.out
    assert robot.restarts[count:] == ["daemon-reload", "restart talker.service"]
    assert not (robot.folder / "systemd/listener.service.d").exists(), "what is open stays open"


def test_who_only_claims_an_enclave_makes_no_unit_closed(robot: Robot) -> None:
    """Or --apply would close only this unit despite a problem, or all others without one."""
    robot.units = UNITS
    robot.close()
    secured = replace(robot.process("/talker", is_secured=True), pid=13, user=os.geteuid() + 1)
    stranger = Process(14, ("/opt/stranger",), {}, datetime.now(UTC))
    for command in (("/opt/guest",), secured.command):
        robot.more = (replace(secured, command=command), stranger)
        said = robot.close("--apply", status=1).out
        assert "; but fix this first:\n" in said and robot.restarts == []
        assert not [*(robot.folder / "systemd").iterdir()]
    robot.more = (secured,)
    said = robot.close("--apply", status=1).out
    assert robot.restarts == ["daemon-reload", *RESTARTS], "the unit of /talker, too"
    assert "every process in an enclave belongs there: sros did not see process 13 (run)" in said


@sometimes("an_enclave_that_belongs_to_another_machine")
def test_an_enclave_that_belongs_to_another_machine(robot: Robot) -> None:
    """Seen while sros watched, it has to be seen again; another one may be away, as a laptop."""
    robot.close()
    assert "has no enclave /x. It has" in robot.close("--elsewhere", "/x", status=2).err
    assert (
        "the folder remembers it"
        in robot.close("--proof", "--elsewhere", "/listener", status=2).err
    )
    robot.absent = {"/listener"}
    ended = robot.close("--elsewhere", "/listener")
    left = "robot/export/enclaves/listener"
    assert f"removed {left}: its enclave belongs to another machine\n" in ended.err
    assert (
        "\nnot on this machine: /listener (to bring an enclave to its machine: sros distribute_key "
        in ended.out
    )
    assert not (robot.folder / left).exists() and "/listener: process" not in ended.out
    commands = robot.folder / "robot/start/commands.txt"
    there = "\n# cd /opt && sros run FOLDER /listener -- /opt/run listener\n"
    assert there in commands.read_text()
    robot.more = (replace(robot.process("/listener", is_secured=False), pid=19),)
    back = "process 19 (run) runs open, and has the command of /listener, which belongs to another "
    back += "machine: stop it, or bring the enclave back: sros close robot --here /listener. While "
    assert f"  {back}" in (said := robot.close(status=1).out)
    assert "sros does not know" not in said
    robot.more = ()
    required = robot.folder / "required.toml"
    widest = '[[widest]]\nenclaves = ["%s"]\npublish = ["/x"]\n'
    only = '[[only]]\npublish = ["/chatter"]\nenclaves = ["/talker", "/listener"]\n'
    required.write_text(widest % "/listener" + widest % "/nobody" + only)
    asked = ("--requirements", required, "--include", "requirement.*")
    said = sros("check", "robot/export", *asked, cwd=robot.folder).out
    assert "no enclave" not in said, said
    assert "may have other enclaves; left out on purpose, for other machines: /listener" in said
    drawn = json.loads(
        sros("view", "robot/export", "--requirements", required, "--json", cwd=robot.folder).out
    )
    assert "no enclave" not in json.dumps(drawn)
    asked_of_python = sros_tool.check_requirements(robot.folder / "robot/export", required)
    assert "no enclave" not in f"{asked_of_python}"
    said = sros("run", "robot/export", "/listener", "--", "true", cwd=robot.folder).err
    assert "or run `sros close" in said and "robot --here /listener`" in said, said
    assert "--elsewhere and --here both name /listener" in (
        robot.close("--elsewhere", "/listener", "--here", "/listener", status=2).err
    )
    ended = robot.close("--here", "/listener")
    assert (robot.folder / left / "key.pem").exists(), ended
    assert "not on this machine" not in ended.out
    assert "still has the key of /listener: delete the files there, or replace the" in ended.err
    assert "/listener: no process runs its command: by hand\n" in ended.out
    assert there not in commands.read_text()
    assert "already belongs to this" in robot.close("--here", "/listener", status=2).err
    robot.close("--elsewhere", "/listener")
    robot.absent = set()
    ended = robot.close("--for", "1s", "--here", "/listener")
    assert "/listener: process 4712" in ended.out, ended
    robot.absent = {"/listener"}
    robot.close("--elsewhere", "/listener")
    robot.absent = set()
    returned = robot.close("--for", "1s").err
    assert "as with --here, this machine has /listener again, because the watch saw" in returned
    assert "still has the key of /listener: delete the files there" in returned
    robot.absent = {"/listener"}
    robot.close("--elsewhere", "/listener")
    assert not (robot.folder / left).exists()
    robot.by_hand = {"/talker"}
    sros("renew", "robot/keystore", "/talker", "--new-key", "--revoke-old", cwd=robot.folder).ok()
    shared = robot.folder / "robot/keystore/public/identity_ca.crl.pem"
    needed = (
        f"need the current files of /listener ({iso(time_of_file(shared.stat().st_mtime))}); bring"
    )
    assert needed in robot.close().err
    ended = robot.close("--proof")
    assert needed in ended.err
    said = (
        "1 enclave, and no open process in domain 0; not counted: /listener (on other machines)\n"
    )
    assert said in ended.out
    assert "differs from the signed permissions" not in ended.out
    assert "talk: 2 nodes with 36 endpoints as before (types are not compared)\n" in ended.out
    assert "--brought cannot name /talker" in robot.close("--brought", "/talker", status=2).err
    brought = "  other machines have, as you said with --brought, the current files of /listener ("
    for words in (("--brought", "/listener"), ("--proof",)):
        said = robot.close(*words).err
        assert brought in said and needed not in said
    policy = robot.folder / "robot/policy.xml"
    stated = policy.read_bytes()
    policy.write_bytes(stated.replace(b"</topics>", b"<topic>more</topic></topics>"))
    assert "differs from the signed permissions of /listener, /talker, which" in (
        robot.close("--proof").out
    )
    policy.write_bytes(stated)
    os.utime(shared)
    assert "need the current files of /listener (" in robot.close().err
    robot.remaining = (TALKER,)
    said = robot.close("--proof", status=1).out
    assert (
        "not seen: /listener" in said
        and "machines are away on purpose, add --without /listener\n" in said
    )
    ended = robot.close("--proof", "--without", "/listener")
    assert (
        "talk: 1 node with 18 endpoints as before (types are not compared), without /listener\n"
        in ended.out
    )
    # What sros proposed for the robot leaves room for a person, who looks by wildcards.
    policy = robot.folder / "robot/policy.xml"
    without_person = policy.read_bytes()
    look = policies_dir() / "operator_look.xml"
    sros("merge_policy", policy, look, "--in-place", cwd=robot.folder).ok()
    robot.close("--elsewhere", "/operator/look")
    robot.remaining = (TALKER,)
    said = robot.close("--proof", status=1).out
    assert "add --without /listener\n" in said and "\n  compared without /operator/look\n" in said
    policy.write_bytes(without_person)
    assert list_enclaves(robot.folder / "robot/export") == ("/sros_observer", "/talker")
    robot.remaining = (TALKER, LISTENER)
    # Out of the policy, it keeps what was signed, and its machine has the key.
    ended = robot.close(status=1)
    kept = "  the keystore has /operator/look, and the policy does not, so /operator/look keeps"
    assert kept in ended.out and "sros revoke robot/keystore /operator/look (then" in ended.out
    assert "  topic /chatter: /talker -> /listener, /operator/look\n" in ended.out
    assert (
        "  enclaves that the policy lacks, and that keep their signed rights: /operator/look\n"
        in ended.out
    )
    assert "\nnot on this machine: /listener (to " in ended.out
    assert "/operator/look (" not in ended.err, "nobody is to bring its files there"
    proved = robot.close("--proof", status=1).out
    assert (
        "no: the files are not accepted: the keystore has /operator/look, and the policy" in proved
    )
    assert "(types are not compared), without /operator/look\n" in proved
    sros("distribute_key", "robot/keystore", "/operator/look", "stolen", cwd=robot.folder).ok()
    sros("revoke", "robot/keystore", "/operator/look", cwd=robot.folder).ok()
    assert "\nnot on this machine: /listener (to " in robot.close().out
    assert "/operator/look" not in robot.close("--proof").out
    thief = replace(
        robot.process("/talker", is_secured=True),
        pid=9,
        environment=secured_environment(robot.folder / "stolen", "/operator/look", 0),
    )
    robot.more = (robot.with_its_files(thief),)
    refused = "no: not every process in an enclave belongs there: process 9 (run) in /operator/look"
    files = f"(with the files of '{robot.folder}/stolen') has a revoked certificate: stop what is"
    assert f"{refused} {files} not yours" in robot.close("--proof", status=1).out
    robot.outdated = {"/talker"}  # until it restarts, it still accepts the thief
    said = robot.close("--proof", status=1).out
    assert said.index(refused) < said.index("no: not every process was started in its enclave: ")
    robot.more, robot.outdated = (), set()
    sros("create_enclave", "robot/keystore", "/operator/look", cwd=robot.folder).ok()
    robot.close("--elsewhere", "/operator/look", status=1)
    robot.by_hand = set()
    there = "on other machines, also start the processes of /listener and /operator/look"
    assert f"sros sees no process in an enclave of this folder; {there} without sros run\n" in (
        robot.close("--undo").err
    )


def test_units_restart_in_order_and_keep_the_drop_ins_of_removed_processes(
    robot: Robot, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A process that was revoked restarts before those that then refuse its earlier key."""
    robot.units = UNITS
    robot.close()
    robot.close("--apply")
    robot.outdated, count = set(PID), len(robot.restarts)
    with monkeypatch.context() as patched:
        patched.setattr(
            state.CloseState, "may_restart_last", lambda _, known: known.enclave == "/listener"
        )
        robot.close("--apply", status=1)
    assert robot.restarts[count:] == ["daemon-reload", *RESTARTS[::-1]]
    robot.outdated = set()
    said = robot.close("--elsewhere", "/listener", status=1).err
    unit = "listener.service"
    stays = f"{robot.folder}/systemd/{unit}.d/sros-close.conf stays, so {unit} cannot start open"
    assert f": no known process needs it; {stays} (--undo removes" in said


def test_an_enclave_that_gets_another_name_keeps_its_process(robot: Robot) -> None:
    """A container has one enclave, by the name of one of its nodes, which says little."""
    robot.units = {"/talker": "talker.service"}
    robot.nodes = (TALKER, LISTENER, ros_node("logger", TALKER[3]))
    robot.remaining = robot.nodes
    said = robot.close()
    policy = robot.folder / "robot/policy.xml"
    named = "\nsros named /logger after one of several nodes. To choose another name, do it before "
    files = "--apply: change `path=` of the enclave (not `node=`) in robot/policy.xml, and the name"
    price = "in robot/requirements.toml. Then revoke the earlier name: sros revoke robot/keystore E"
    assert f"{named}{files} {price}NCLAVE\n" in said.out
    assert "after one of several nodes" not in robot.close().out
    for file in (policy, robot.folder / "robot/requirements.toml"):
        file.write_text(file.read_text().replace('"/logger"', '"/mission"'))
    said = robot.close(status=1)
    assert "/logger is now /mission, because the policy moved its nodes\n" in said.err
    known = "/mission: process 4711, known by its process id, for the nodes /logger and /talker: "
    assert f"{known}--apply restarts talker.service\n" in said.out
    assert "named after" not in said.out
    revoke = "sros revoke robot/keystore /logger (then restart all closed processes, because a"
    assert (
        f"If nothing needs it any more: {revoke} process reads revocations only when it starts)"
        in said.out
    )
    # The node that gave the enclave its first name may get another name later.
    sros("revoke", "robot/keystore", "/logger", cwd=robot.folder).ok()
    policy.write_text(policy.read_text().replace('node="logger"', 'node="lamps"'))
    robot.close()
    shell = Shell(close._run, print, {}, lambda: datetime.now(UTC), UTC)
    seen = nodes.ObservedNodes(LocalRobot(robot.folder / "robot", 0, shell))
    expected = {node.fqn: node.enclaves for node in seen.nodes_to_compare(()).nodes}
    mission = ("/mission",)
    assert expected == {"/lamps": mission, "/listener": ("/listener",), "/talker": mission}
    assert not seen.denied_rights(seen.expected_nodes())
    assert {pair.new.topic for pair in seen.moved_endpoints()} >= {"rr/lamps/get_parametersReply"}


def test_only_a_process_alone_follows_its_nodes_into_a_new_enclave(tmp_path: Path) -> None:
    """Otherwise, processes of one enclave would count as several with the same node name."""
    places = dict(zip("abcdefghi", "abcdddggg", strict=True))
    ends: dict[str, Any] = {"publish": [], "subscribe": []}
    observed_nodes = [
        {"enclaves": [f"/{of}"], "namespace": "/", "name": name, "participant": of, **ends}
        for name, of in places.items()
    ]
    enclaves = {
        name: [f'<profile ns="/" node="{node}"/>' for node in of]
        for name, of in {"both": "ab", "new": "c", "x": "d", "y": "eF", "one": "ghI"}.items()
    }
    stated = (
        f'<enclave path="/{name}"><profiles>{"".join(of)}</profiles></enclave>'
        for name, of in enclaves.items()
    )
    policy = f'<policy version="0.2.0"><enclaves>{"".join(stated)}</enclaves></policy>'
    (tmp_path / "policy.xml").write_text(policy)
    robot = LocalRobot(tmp_path, 0, Shell(close._run, print, {}, lambda: datetime.now(UTC), UTC))
    robot.observation_file.write_text(json.dumps({"nodes": observed_nodes}))
    start = ClosedProcess("", 7, ("run",), "/opt", 0, "", "process id")
    observed = ObservedProcesses(0, [start._replace(enclave=f"/{name}") for name in "abc"])
    renamed = preparation._with_renamed_enclaves(robot, observed)
    assert [process.enclave for process in renamed.processes] == ["/a", "/b", "/new"]
    # The nodes of /d moved into two enclaves, so f, which has no profile, may be in either.
    assert nodes.ObservedNodes(robot).renamed_nodes == {"/i": ("/", "I")}


def test_the_nodes_of_a_process_that_has_several(tmp_path: Path) -> None:
    profiles = "".join(f'<profile ns="/p" node="{name}"/>' for name in ("tracker", "detector"))
    file = tmp_path / "policy.xml"
    file.write_text(
        '<policy version="0.2.0"><enclaves><enclave path="/p/tracker"><profiles>'
        f"{profiles}</profiles></enclave></enclaves></policy>"
    )
    nodes = close._nodes_clause(read_policy(file), "/p/tracker")
    assert nodes == ", for the nodes /p/detector and /p/tracker"


def test_containers_are_started_with_the_files_of_their_enclaves(robot: Robot) -> None:
    robot.container = "0123456789ab"
    robot.close()
    place = robot.folder / "robot"
    services = yaml.safe_load((place / "start/compose.yaml").read_text())["services"]
    assert services["talker"]["environment"]["ROS_SECURITY_ENCLAVE_OVERRIDE"] == "/talker"
    assert services["listener"]["volumes"][0]["source"] == f"{place}/export/enclaves/listener"
    up = f"docker compose -f compose.yaml -f {place}/start/compose.yaml up -d"
    said = robot.close("--apply", status=1).out
    assert f"stop the containers of /listener and /talker, and start again with:\n  {up}\n" in said
    robot.by_hand = set(PID)
    undone = robot.close("--undo", status=1).out
    assert undone == "restart /listener and /talker open: docker compose up -d\n"


def test_a_node_on_zenoh_gets_an_argument_from_its_unit(robot: Robot) -> None:
    """If its unit starts the command of the process, and no script."""
    systemctl = robot.folder / "bin/systemctl"
    systemctl.write_text(
        "#!/bin/sh\necho 'ExecStart={ path=/opt/talk ; argv[]=/opt/talk a ; x }'\n"
    )
    start = "/talker", 1, ("python3", "/opt/talk", "a"), "/opt", 0, "talker.service", "program"
    on_zenoh = ClosedProcess(*start, rmw="rmw_zenoh_cpp")
    assert with_command_of_unit(on_zenoh).command == ("/opt/talk", "a")
    script = on_zenoh._replace(command=("/opt/talk", "b"))
    assert with_command_of_unit(script).unit == ""
    for other in (script._replace(rmw=""), script._replace(enclave="/router")):
        assert with_command_of_unit(other) == other


LAUNCH = ("/usr/bin/python3", "/opt/ros/jazzy/bin/ros2", "launch", "my_robot", "all.py", "a:=b c")


def test_a_process_that_was_launched_is_launched_secured(tmp_path: Path, robot: Robot) -> None:
    made_up(tmp_path, 7, *LAUNCH, parent=1)
    made_up(tmp_path, 8, "/bin/sh", "-c", "talker", parent=7)
    made_up(tmp_path, 9, "/opt/talker", parent=8)
    origin = ProcessOrigin("", "/opt", LAUNCH)
    assert process_origin(9, tmp_path) == process_origin(7, tmp_path) == origin
    assert launch_word_index(("ros2", "launch")) == 1
    assert not any(map(launch_word_index, [("ros2", "run", "launch"), ("launch",), ()]))

    robot.launch = LAUNCH
    assert "has no name= in its launch file, and would not start" in robot.close(status=1).out
    robot.named = True
    robot.close("--for", "1s")
    place = robot.folder / "robot"
    command = (
        "cd /opt && /usr/bin/python3 /opt/ros/jazzy/bin/ros2 launch --secured "
        f"{place}/export {place}/policy.xml my_robot all.py 'a:=b c'\n"
    )
    said = robot.close("--apply", status=1).out
    assert f"stop the launch of /listener and /talker, and start again with:\n  {command}" in said
    assert f"\n# /listener, /talker\n{command}" in (place / "start/commands.txt").read_text()
    robot.by_hand = set(PID)
    undone = robot.close("--undo", status=1).out
    restart = "restart /listener and /talker open: cd /opt && /usr/bin/python3 /opt/ros/jazzy/bin"
    assert undone.count(restart) == undone.count("restart ") == 1


def test_a_program_that_runs_a_launch_description_starts_no_open_node(robot: Robot) -> None:
    """Its nodes have temporary files, so it is started itself, and has to secure its nodes."""
    robot.named, robot.launch_file = True, "/tmp/launch_params_a1b2c3d4"
    said = robot.close("--for", "1s", status=1).out
    assert "the launch that started the process of /listener has ended, and the comma" in said
    robot.launch = ("python3", "bringup.py")
    robot.close("--for", "1s")
    robot.launch_file = "/tmp/launch_params_4d3c2b1a"  # as after a restart
    place = robot.folder / "robot"
    command = (
        "cd /opt && env ROS_SECURITY_KEYSTORE= ROS_SECURITY_ENABLE=true "
        "ROS_SECURITY_STRATEGY=Enforce python3 bringup.py\n"
    )
    advice = (
        "bringup.py runs a launch description itself. First put SecuredNodes(keystore="
        f"'{place}/export', policy='{place}/policy.xml') from sros_tool.launch in front of its "
        "nodes, once (docs/launch.md); without it, none of them starts.\n"
    )
    said = robot.close("--apply", status=1).out
    assert (
        f"the launch of /listener and /talker, and start again with:\n  {command}  {advice}" in said
    )
    commands = (place / "start/commands.txt").read_text()
    assert f"\n# /listener, /talker\n# {advice}{command}" in commands
    assert "launch_params" not in commands
    robot.by_hand = set(PID)
    robot.close("--proof")


@pytest.mark.parametrize(
    ("secured", "says"),
    [
        ({"/a": True}, "the processes run in their enclaves, except for /b and /c (open)"),
        ({"/a": True, "/b": True, "/c": True}, "the processes run in their enclaves"),
        (
            {"/a": False, "/b": False},
            "restart all 3 processes: /a and /b (with earlier files or other settings), /c (open)",
        ),
    ],
)
def test_the_state_says_first_what_to_do_if_no_process_is_as_it_should_be(
    secured: dict[str, bool], says: str
) -> None:
    pending = [name for name in ("/a", "/b", "/c") if not secured.get(name)]
    closed: Any = SimpleNamespace(secured=secured, pending=pending, stopped=set(), other_files=())
    assert close._state_text(closed, apply=False) == says
