"""The processes of a robot: the ids that they have, and the commands that start them."""

from __future__ import annotations

import json
import os
import subprocess
from collections.abc import Sequence
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from sros_tool.close import state
from sros_tool.close.assignment import assign
from sros_tool.close.processes import ClosedProcess, ObservedProcesses, run_words
from sros_tool.close.state import RunningRobot
from sros_tool.policy.model import Policy
from sros_tool.runtime.environment import NO_CONFIGURATION, RMW_ZENOH
from sros_tool.runtime.processes import (
    SEVERAL_USERS,
    LoadedFile,
    Process,
    ProcessEnclave,
    ProcessOrigin,
    RunningProcesses,
    UnseenProcess,
    boot_id,
)
from sros_tool.runtime.rmw import RMW
from sros_tool.terminal import visible
from tests.checks.zenoh_cases import sound
from tests.close.test_assignment import process


def test_a_command_is_written_so_that_it_controls_no_terminal() -> None:
    """Any user may start a process with such arguments, also with bytes that are not UTF-8."""
    words = ("/opt/talk", "\x1b[2J'%\\", "\udc9b1", "a b\n")
    talker = ClosedProcess("/talker", 7, words, "/opt", 0, "", "program")
    for command in (talker.secured_command(Path()), talker.open_command(0)):
        assert visible(command) == command
        arguments = command.removeprefix("cd /opt && sros run export /talker -- ")
        printed = f"printf '%s|' {arguments.removeprefix('cd /opt && ')}"
        done = subprocess.run(["sh", "-c", printed], capture_output=True, check=True)
        assert done.stdout == b"|".join(map(os.fsencode, words)) + b"|"


def test_a_process_to_stop_is_named_by_the_id_that_it_has_now(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Later, or after the machine was started again, another process may have the earlier id."""
    seen = f"{boot_id()} 70"
    talker = ClosedProcess("/talker", 7, ("talk", "a"), "/opt", 0, "", "program", started=seen)
    again, other = process(8, "talk", "a"), process(7, "talk", "b")
    unseen = UnseenProcess(7, (), "another user's", uses_ros=False)
    hidden = RunningProcesses((other,), hidden="those of other users")
    for running, pid in (
        (RunningProcesses((process(7, "talk", "a"), again)), 7),
        (RunningProcesses((other, again)), 8),
        (RunningProcesses((replace(again, environment={"ROS_DOMAIN_ID": "64"}),)), 0),
        (RunningProcesses((replace(again, network="net:[1]"),)), 0),
        (RunningProcesses((replace(again, environment={"RMW_IMPLEMENTATION": RMW_ZENOH}),)), 0),
        (RunningProcesses((process(9, "talk", "a", "--ros-args", "--enclave", "/talker"),)), 9),
        (RunningProcesses((process(9, "talk", "a", "--ros-args", "--enclave", "/other"),)), 0),
        (RunningProcesses((other,)), 0),
        (hidden, 7),
        (RunningProcesses(unseen=(unseen,)), 7),
    ):
        monkeypatch.setattr(
            "sros_tool.close.processes.start_of", lambda pid: seen if pid == 7 else ""
        )
        now = talker.with_current_pid(running, 0, Path("/export"))
        assert (now.pid, now.absent) == (pid, False)
        monkeypatch.setattr("sros_tool.close.processes.start_of", lambda _: f"{boot_id()} 71")
        later = talker.with_current_pid(running, 0, Path("/export"))
        assert later.pid == (0 if pid == 7 and running != hidden else pid)
    earlier_boot = talker._replace(started="another 70")
    assert not earlier_boot.with_current_pid(hidden, 0, Path("/export")).pid
    assert [*later.alike] == [] and not later.absent
    known = ObservedProcesses(0, [talker])
    assert known.with_current_pids(RunningProcesses((other,)), Path("/export")).unknown == [
        "process 7 (talk): talk b"
    ]


def test_a_process_of_a_unit_is_looked_up_among_those_of_the_unit(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The id of the watch says nothing after a restart; a unit without a process is not idle."""
    units = {8: "other.service", 9: "talker.service", 11: "other.service"}
    monkeypatch.setattr(
        "sros_tool.close.processes.process_origin",
        lambda pid: ProcessOrigin(units.get(pid, ""), "/opt"),
    )
    unit = "talker.service"
    talker = ClosedProcess("/talker", 7, ("talk",), "/opt", 0, unit, "process id", started="x 70")
    twins = process(8, "talk"), process(9, "talk")
    for running, pid, alike, absent, now_of in (
        ((), 0, (), True, unit),
        (twins[:1], 8, (), False, "other.service"),
        ((twins[0], process(11, "hear")), 8, (), False, ""),  # the unit starts several processes
        ((replace(twins[0], user=4321),), 8, (), False, ""),
        ((process(10, "talk"),), 10, (), False, ""),
        (twins, 9, (), False, unit),
        ((twins[0], process(10, "talk")), 0, (8, 10), False, ""),
        ((replace(twins[1], environment={"ROS_DOMAIN_ID": "64"}),), 0, (), False, unit),
    ):
        for known in (talker, talker.with_current_pid(RunningProcesses(), 0, Path("/export"))):
            now = known.with_current_pid(RunningProcesses(running), 0, Path("/export"))
            assert (now.pid, (*now.alike,), now.absent) == (pid, alike, absent)
            assert now.unit == now_of, "not the unit that ran it before"
    idle = talker._replace(pid=0).with_current_pid(RunningProcesses(), 0, Path("/export"))
    assert idle.is_idle and not idle.absent


def test_sros_does_not_choose_among_processes_that_fit_equally() -> None:
    """A process in the enclave fits best: an open one of the same command is not closed."""
    talker = ClosedProcess("/talker", 7, ("talk",), "/opt", 0, "", "process id")
    twins = process(8, "talk"), process(9, "talk")
    now = talker.with_current_pid(RunningProcesses(twins), 0, Path("/export"))
    assert (now.pid, [*now.alike]) == (0, [8, 9])
    assert now.pids_text == "one of the processes 8 and 9 (sros cannot tell which is this robot's)"
    secured = replace(twins[1], enclave=ProcessEnclave("/export", "/talker"))
    for seen in ((twins[0], secured), (secured, process(7, "talk"))):
        now = now.with_current_pid(RunningProcesses(seen), 0, Path("/export"))
        assert (now.pid, now.known_by, now.alike) == (9, "command", ())


def test_the_command_of_a_secured_process_takes_the_place_of_the_observed_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Not that of a tool, of another user, or one of several; nor of a launch, or out of its unit.

    A command that starts a node later would otherwise be one that the robot does not use any more.
    """
    origins = {
        99: ProcessOrigin("pilot.service", "/new"),
        98: ProcessOrigin("", "/new", ("ros2", "launch", "a")),
        97: ProcessOrigin("", "/new", (), "c0ffee"),
    }
    monkeypatch.setattr(
        state, "process_origin", lambda pid: origins.get(pid, ProcessOrigin("", "/new"))
    )
    folder = tmp_path.stat()
    enclave = ProcessEnclave("/e", "/pilot", folders=((folder.st_dev, folder.st_ino),))
    camera = replace(process(8, "pilot", "--camera"), enclave=enclave, user=os.geteuid())
    other = replace(camera, pid=9, command=("pilot", "--lidar"))
    before = ClosedProcess("/pilot", 7, ("pilot",), "/opt", os.geteuid(), "", "process id")
    robot: Any = SimpleNamespace(export=tmp_path, domain=0)

    def command_after(known: Sequence[ClosedProcess], *running: Process) -> tuple[str, str]:
        observed = ObservedProcesses(0, known)
        now = RunningRobot(robot, RunningProcesses(running)).with_later_processes(observed)
        assert len(now.processes) == len(known)
        first = now.processes[0]
        return " ".join(first.command), f"{first.folder} {first.rmw}".rstrip()

    assert command_after([before], camera) == ("pilot --camera", "/new")
    # What such a try left behind gives way to the program.
    tried = before._replace(command=("sros", "demo", "talker", "--topic", "/image"))
    assert command_after([tried], camera) == ("pilot --camera", "/new")
    cyclone = replace(camera, environment={RMW: "rmw_cyclonedds_cpp"})
    assert command_after([before], cyclone) == ("pilot --camera", "/new rmw_cyclonedds_cpp")
    in_unit, of_unit = replace(camera, pid=99), before._replace(unit="pilot.service")
    for known_before in (before, of_unit):
        assert command_after([known_before], in_unit) == ("pilot --camera", "/new")
    # On Zenoh, the drop-in of the unit has the command.
    on_zenoh = replace(in_unit, environment={RMW: "rmw_zenoh_cpp"})
    of_unit_on_zenoh = of_unit._replace(rmw="rmw_zenoh_cpp")
    assert command_after([of_unit_on_zenoh], on_zenoh) == ("pilot", "/opt rmw_zenoh_cpp")
    ros2 = replace(camera, command=("/usr/bin/python3", "/opt/ros/bin/ros2", "topic", "echo"))
    for known, running in (
        ([before], (camera, other)),
        ([before], (camera, replace(camera, pid=9, command=("pilot",)))),
        ([before], (replace(camera, user=4321),)),
        *(([before], (replace(camera, pid=pid),)) for pid in (98, 97)),
        ([before], (ros2,)),
        ([before], (replace(camera, command=demo_node("talker", "/image")),)),
        ([before], (replace(camera, command=demo_node("talker", "/image")[:-4]),)),
        ([before], (replace(camera, command=("/opt/venv/bin/python3", "/opt/venv/bin/sros")),)),
        ([before], (replace(camera, enclave=replace(enclave, folders=((1, 1),))),)),
        ([before, before._replace(pid=6)], (camera,)),
        ([of_unit], (camera,)),
        ([before._replace(launch=("ros2", "launch", "a"))], (camera,)),
        ([before._replace(container="c0ffee")], (camera,)),
        ([before._replace(shares=("/x",))], (camera,)),
    ):
        assert command_after(known, *running) == ("pilot", "/opt"), (known, running)
    for running, commands in (
        ((camera,), [("pilot", "--camera")]),
        ((replace(camera, command=demo_node("talker", "/image")),), []),
    ):
        now = RunningRobot(robot, RunningProcesses(running))
        later = now.with_later_processes(ObservedProcesses(0)).processes
        assert [known.command for known in later] == commands, "a test is no process of the robot"


def test_commands_name_the_rmw_and_on_zenoh_the_enclave() -> None:
    """Without them, a process runs open or on another RMW, or others do not see it."""
    start = "/talker", 1, ("python3", "talk"), "/opt", 0, "", "program"
    talker = ClosedProcess(*start, rmw="rmw_zenoh_cpp")
    run = "sros run export {} --rmw rmw_zenoh_cpp --"
    assert talker.secured_command(Path()) == (
        f"cd /opt && {run.format('/talker')} python3 talk --ros-args --enclave /talker"
    )
    router = talker._replace(enclave="/router", command=("rmw_zenohd",))
    assert router.secured_command(Path()) == f"cd /opt && {run.format('/router')} rmw_zenohd"
    named = {"RMW_IMPLEMENTATION": "rmw_cyclonedds_cpp"}
    on_cyclone = Process(1, ("talk",), named, datetime.now(UTC))
    origin = ProcessOrigin("", "/opt")
    cyclone = ClosedProcess.from_process(on_cyclone, "/talker", origin, "program")
    started = "cd /opt && sros run export /talker --rmw rmw_cyclonedds_cpp -- talk"
    assert cyclone.secured_command(Path()) == started
    assert cyclone.open_command(0) == "cd /opt && env RMW_IMPLEMENTATION=rmw_cyclonedds_cpp talk"
    other = replace(on_cyclone, environment={"RMW_IMPLEMENTATION": "rmw_other"})
    assert ClosedProcess.from_process(other, "/talker", origin, "program").rmw == ""
    empty = Policy(())
    later = talker._replace(enclave="/later", known_by="enclave")
    assert ObservedProcesses(0, [talker, router, later]).enclaves_outside(empty) == ["/talker"]
    assert ObservedProcesses(0, [router._replace(rmw="")]).enclaves_outside(empty) == ["/router"]
    in_domain = "cd /opt && env ROS_DOMAIN_ID=7 RMW_IMPLEMENTATION=rmw_zenoh_cpp python3 talk"
    assert talker.open_command(7) == in_domain
    observed = ObservedProcesses(7, [talker])
    assert (
        observed.command_of_new_process(Path("export"), "/horn") == f"{run.format('/horn')} COMMAND"
    )


def test_commands_name_the_path_of_sros_where_a_shell_does_not_find_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As after a start by `venv/bin/sros`; a link on the path to the same program is enough."""
    program = tmp_path / "venv" / "sros"
    program.parent.mkdir()
    program.write_text("#!/bin/sh\n")
    program.chmod(0o755)
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.setattr("sys.argv", [str(program)])
    assert list(run_words(Path("export"), "/talker", ""))[:2] == [str(program), "run"]
    router = ClosedProcess("/router", 7, ("sros", "demo", "router"), "/opt", 0, "", "program")
    assert router.secured_command(Path()).endswith(f" -- {program} demo router")
    (tmp_path / "sros").symlink_to(program)
    assert list(run_words(Path("export"), "/talker", ""))[:2] == ["sros", "run"]


def test_a_router_has_no_node_and_is_no_unknown_process() -> None:
    """Also `sros demo router`, whose own command is for one start only."""
    words = ("-P", "-m", "sros_tool.demo.zenoh_node", "router", "--report", "/proc/self/fd/7")
    demo = replace(process(7, "python3", *words), libraries=frozenset({"zenoh"}))
    observed = assign([], [demo], 0, origins={7: ProcessOrigin("", "/opt")})
    assert [known.command for known in observed.processes] == [("sros", "demo", "router")]
    assert not observed.unknown and observed.processes[0].is_router
    for router in (replace(demo, pid=8), process(8, "/opt/rmw_zenohd")):
        later = observed.with_current_pids(RunningProcesses((router,)), Path("/export"))
        assert ([known.pid for known in later.processes], later.unknown) == ([8], [])
    open_script = replace(
        process(9, "python3", "r.py"), environment={"RMW_IMPLEMENTATION": RMW_ZENOH}
    )
    uris = {"ZENOH_SESSION_CONFIG_URI": NO_CONFIGURATION, "ZENOH_ROUTER_CONFIG_URI": "/r.json5"}
    script = replace(open_script, environment={**open_script.environment, **uris})
    for enclave in ("/router", "/far_router"):
        known = ClosedProcess.from_process(script, enclave, ProcessOrigin(), "enclave")
        assert known.fits(script) and known.fits(open_script), "it is known by its command, too"


def demo_node(role: str, topic: str, kind: str = "std_msgs/msg/String") -> tuple[str, ...]:
    """The command of the node that `sros demo` starts."""
    module = "sros_tool.demo.ros_node" if "String" not in kind else "sros_tool.demo.cyclone_node"
    node = ("/opt/python3", "-P", "-m", module, role, "--period", "1", "--topic", topic)
    return (*node, "--by-hand", "--type", kind, "--report", "/proc/self/fd/4")


def test_a_node_of_the_demo_is_started_by_the_command_of_a_person() -> None:
    """Its own command names a file descriptor of one start, and would end with an error."""
    twist = "geometry_msgs/msg/Twist"
    for command, again in (
        (demo_node("talker", "/image"), "sros demo talker --topic /image"),
        (demo_node("listener", "/image"), "sros demo listener --topic /image"),
        (demo_node("talker", "/a b", twist), f"sros demo talker --topic '/a b' --type {twist}"),
    ):
        node = process(8, *command)
        for rmw in ("", RMW_ZENOH):
            here = replace(node, environment={RMW: rmw})
            known = ClosedProcess.from_process(here, "/tried", ProcessOrigin("", "/opt"), "enclave")
            assert known.secured_command(Path()).endswith(f"-- {again}"), rmw
            assert known.fits(replace(here, pid=9)) and not known.fits(process(9, "other"))


def test_an_enclave_is_closed_only_if_all_its_processes_are(tmp_path: Path) -> None:
    """Such as two routers, of which one is old; a process of others only claims to be in one."""
    now, state = datetime.now(UTC), tmp_path.stat()
    file = LoadedFile("cert.pem", now)
    folders = ((state.st_dev, state.st_ino),)
    enclave = ProcessEnclave("/export", "/router", (file,), is_there=True, folders=folders)
    variables = {
        "RMW_IMPLEMENTATION": RMW_ZENOH,
        "ROS_SECURITY_STRATEGY": "Enforce",
        "ZENOH_SESSION_CONFIG_URI": "/export/enclaves/router/session.json5",
    }
    rules = LoadedFile("/s.json5", now - timedelta(2), json.dumps(sound()).encode())
    later, user = now + timedelta(1), os.geteuid()
    fresh = Process(7, ("a",), variables, later, enclave=enclave, configuration=rules, user=user)
    old, unread = replace(fresh, started=now - timedelta(1)), LoadedFile("/s.json5", problem="odd")
    unchanged = LoadedFile("cert.pem", now - timedelta(2))
    placed = replace(enclave, files=(unchanged,), moved={"/export": now})
    listed = replace(enclave, files=(file, LoadedFile("crl.pem", now)))
    robot: Any = SimpleNamespace(export=tmp_path, domain=0)
    for processes, why in (
        (
            (replace(old, enclave=placed),),
            "'/export' (its place or mode) changed after the start of",
        ),
        (
            (replace(old, environment={"ROS_SECURITY_STRATEGY": "Enforce"}, enclave=listed),),
            "revoked certificates are still accepted, because cert.pem, crl.pem changed, or got "
            "another mode, after the start of",
        ),
        ((fresh,), None),
        ((fresh, replace(old, user=4321)), None),
        ((fresh, old), "cert.pem changed, or got another mode, after the start of"),
        ((old, fresh), "cert.pem changed, or got another mode, after the start of"),
        ((replace(fresh, user=4321),), "user 4321, not the owner of the files, can control"),
        (
            (replace(fresh, user=SEVERAL_USERS),),
            "several users, not the owner of the files, can control",
        ),
        (
            (replace(fresh, configuration=unread),),
            "the files are not in force ('/s.json5' cannot be read: odd) in",
        ),
    ):
        running = RunningRobot(robot, RunningProcesses(processes))
        reasons = [reason for _, reason in running.not_current.get("/router", ())]
        assert reasons == ([why] if why else [])
        assert ("/router" in running.current_enclaves) is (why is None)
