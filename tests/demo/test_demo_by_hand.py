"""Nodes of the demo that are started by hand; docs/tutorial.md runs them on Cyclone DDS."""

from __future__ import annotations

import ctypes
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import replace
from datetime import timedelta
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import MagicMock, Mock

import pytest

from sros_tool.demo import backend, ros_node
from sros_tool.demo.backend import HandNode, backend_by_hand, end_within, run_by_hand, security_line
from sros_tool.demo.cyclone_node import CycloneNode
from sros_tool.demo.nodes import ROLES, NodeOptions
from sros_tool.demo.scenarios.model import Role
from sros_tool.errors import SrosError, UnavailableError, UsageError
from sros_tool.runtime.cyclone import Participant, load_cyclone
from sros_tool.runtime.events import EventWriter, read_events
from sros_tool.runtime.rmw import _RMW_INDEX
from tests.support.children import LATE, PATIENCE, apart
from tests.support.harness import sros

_ANY_RELIABILITY = "qos_profile_sensor_data"
TALKER = HandNode(Role.TALKER, "cyclone", "/chatter")


@pytest.mark.parametrize(
    ("name", "chosen", "used"),
    [
        ("FASTDDS_BUILTIN_TRANSPORTS", "", "^UDPv4$"),
        ("FASTDDS_BUILTIN_TRANSPORTS", "SHM", "^SHM$"),
        ("CYCLONEDDS_URI", "", "<MaxAutoParticipantIndex>100<"),
        ("CYCLONEDDS_URI", "x.xml", "^x.xml$"),
    ],
)
def test_a_node_by_hand_meets_other_users_and_many_nodes(
    name: str, chosen: str, used: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Messages of other users do not pass through shared memory, and without multicast, Cyclone DDS
    has room for ten participants; who sets the variable keeps it.
    """
    monkeypatch.delenv(name, raising=False)
    if chosen:
        monkeypatch.setenv(name, chosen)

    def started(*_: object, env: Mapping[str, str], **__: object) -> None:
        raise OSError(env[name])

    monkeypatch.setattr(subprocess, "Popen", started)
    with pytest.raises(OSError, match=used):
        run_by_hand(replace(TALKER, backend="rclpy"), lambda _: None)


def test_a_node_says_whether_it_is_secured(keystore: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert security_line(TALKER, {}).endswith("/chatter, domain 0: WITHOUT security")
    variables = {
        "ROS_SECURITY_ENABLE": "true",
        "ROS_SECURITY_STRATEGY": "Enforce",
        "ROS_SECURITY_KEYSTORE": str(keystore),
        "ROS_SECURITY_ENCLAVE_OVERRIDE": "/a",
        "ROS_DOMAIN_ID": "7",
    }
    assert security_line(TALKER, variables).endswith("domain 7: secured, in the enclave /a")

    def started(command: list[str], **_: object) -> None:
        raise OSError(" ".join(command))

    monkeypatch.setattr(subprocess, "Popen", started)
    for enable, names_itself in (("true", True), ("false", False)):
        monkeypatch.setattr(os, "environ", {**variables, "ROS_SECURITY_ENABLE": enable})
        with pytest.raises(OSError, match="--by-hand") as error:
            run_by_hand(TALKER, lambda _: None)
        assert ("--text Hello World from /a --report" in str(error.value)) == names_itself
    (keystore / "enclaves" / "a" / "key.pem").unlink()
    with pytest.raises(SrosError, match=r"key\.pem"):
        security_line(TALKER, variables)
    # As rcl does: without Enforce, the node runs without the enclave.
    variables["ROS_SECURITY_STRATEGY"] = "Permissive"
    assert "WITHOUT security" in security_line(TALKER, variables)


def test_a_node_on_zenoh_says_its_configuration() -> None:
    pytest.importorskip("zenoh")
    node = HandNode(Role.LISTENER, "zenoh", "/chatter")
    assert "WITHOUT security" in security_line(node, {"ROS_SECURITY_ENABLE": "true"})
    assert "--rmw rmw_zenoh_cpp" in security_line(node, {"ROS_SECURITY_ENABLE": "true"})
    assert security_line(node, {"ZENOH_SESSION_CONFIG_URI": "/a.json5"}).endswith("by /a.json5")
    with pytest.raises(UsageError, match="only Zenoh has routers"):
        HandNode(Role.ROUTER, "rclpy", "/chatter")


def test_a_talker_on_rclpy_takes_a_type() -> None:
    assert HandNode(Role.TALKER, "rclpy", "/cmd_vel", "geometry_msgs/msg/Twist").type
    for role, on, kind, said in (
        (Role.LISTENER, "rclpy", "geometry_msgs/msg/Twist", "--type is only for a talker on rclpy"),
        (Role.TALKER, "cyclone", "geometry_msgs/msg/Twist", "--type is only for a talker on rclpy"),
        (Role.TALKER, "rclpy", "Twist", "is not a message type"),
    ):
        with pytest.raises(UsageError, match=said):
            HandNode(role, on, "/cmd_vel", kind)


def test_a_secured_node_runs_on_what_the_robot_runs_on(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr("importlib.util.find_spec", lambda _name: object())
    library = tmp_path / "lib/librmw_fastrtps_shared_cpp.so"
    for path in (library, tmp_path / f"{_RMW_INDEX}/rmw_fastrtps_cpp"):
        path.parent.mkdir(parents=True, exist_ok=True)
        path.touch()
    robot = {"AMENT_PREFIX_PATH": str(tmp_path), "RMW_IMPLEMENTATION": "rmw_fastrtps_cpp"}
    secured = {**robot, "ROS_SECURITY_ENABLE": "true"}
    monkeypatch.setattr(backend, "load_cyclone", lambda: None)
    assert backend_by_hand(Role.LISTENER, robot) == "cyclone"
    lacking = Mock(side_effect=UnavailableError("no libddsc"))
    monkeypatch.setattr(backend, "load_cyclone", lacking)
    assert backend_by_hand(Role.LISTENER, robot) == "rclpy"
    assert backend_by_hand(Role.LISTENER, secured) == "rclpy"
    on_cyclone = {"RMW_IMPLEMENTATION": "rmw_cyclonedds_cpp"}
    assert backend_by_hand(Role.LISTENER, {**secured, **on_cyclone}) == "cyclone"
    assert backend_by_hand(Role.LISTENER, {"RMW_IMPLEMENTATION": "rmw_zenoh_cpp"}) == "zenoh"
    library.write_bytes(b"this Fast DDS version doesn't have the security libraries")
    assert backend_by_hand(Role.LISTENER, secured) == "cyclone"


@pytest.mark.dds
def test_a_node_that_handles_no_signal_is_stopped_in_time() -> None:
    command = ["sh", "-c", "trap '' TERM; echo; exec sleep 60"]
    with subprocess.Popen(command, stdout=subprocess.PIPE) as process:
        assert process.stdout and process.stdout.readline()
        end_within(0.01, process)
        assert process.wait(10) == -signal.SIGKILL


@pytest.mark.dds
def test_a_listener_ends_after_its_time_and_without_a_reader(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    try:
        load_cyclone()
    except UnavailableError as error:
        pytest.skip(str(error))
    monkeypatch.setattr(backend, "_SILENCE_SECONDS", 0.6)
    node = HandNode(Role.LISTENER, "cyclone", "/nobody_talks")

    def say(line: str) -> None:
        if line.startswith("heard nothing"):
            assert line.endswith(": no publisher of /nobody_talks is visible")
            raise BrokenPipeError

    def played() -> list[str]:
        lines: list[str] = []
        assert run_by_hand(node, lines.append, timedelta(seconds=0.5)) == 0
        starting = lines[: lines.index("ready")]
        assert not any(line.startswith("heard nothing") for line in starting), starting
        with suppress(BrokenPipeError):
            run_by_hand(node, say)
            lines.append("goes on")
        return lines[-1:]

    (last,) = apart(played)
    assert last.startswith(
        "stopped; heard 0 messages, but the time may be too short to connect to other nodes:"
    )
    assert "--for is for a talker" in sros("demo", "--for", "3s").err


_NODE = """#!/bin/sh
for report; do :; done
tell() { printf '{"event": "%s", "time": 1, "text": "%s", "count": %s}\\n' "$@" > "$report"; }
trap 'tell heard "2 messages of nav_msgs/msg/Odometry" 2; exit 0' TERM
SEEN
tell ready "" 0
tell heard "4 messages of nav_msgs/msg/Odometry" 4
tell heard "3 messages of love" 1
while :; do sleep 0.01; done
"""
_SEEN = "/odom has 1 subscription of nav_msgs/msg/Odometry"
_HEARS_NOTHING = """trap 'exit 0' TERM
tell seen "/odom has 1 publisher of nav_msgs/msg/Odometry" 0
tell ready "" 0
while :; do sleep 0.01; done"""


@pytest.mark.parametrize(
    ("role", "seen", "seconds", "result"),
    [
        (Role.LISTENER, "", None, "heard 7 messages"),
        (Role.TALKER, f'tell seen "{_SEEN}" 0; tell seen "" 0', None, _SEEN),
        (Role.TALKER, "", None, "found no subscription of /odom"),
        (
            Role.LISTENER,
            _HEARS_NOTHING,
            0.01,
            "heard 0 messages, but the time may be too short to connect to other nodes: use --for "
            "10s",
        ),
    ],
)
def test_a_node_by_hand_ends_with_what_it_heard_and_saw(
    role: Role,
    seen: str,
    seconds: float | None,
    result: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Also messages that it reports only when it ends; a text that looks like a sum is one.

    The page on continuous integration looks for this line.
    """
    node, lines = tmp_path / "node", list[str]()
    node.write_text(_NODE.replace("SEEN", seen))
    node.chmod(0o755)
    monkeypatch.setattr(sys, "executable", str(node))

    def say(line: str) -> None:
        lines.append(line)
        if line.endswith("love"):
            os.kill(os.getpid(), signal.SIGTERM)

    def played() -> list[str]:
        duration = timedelta(seconds=seconds) if seconds else None
        run_by_hand(HandNode(role, "cyclone", "/odom"), say, duration)
        return lines

    last = apart(played)[-1]
    assert last == f"stopped; {result}"
    page = (Path(__file__).parents[2] / "docs/howto/ci.md").read_text()
    hears, hears_nothing = re.findall(r"tail -n 1 \w+\.log \| grep '(.*)'", page)
    assert bool(re.search(hears, last)) == ("heard 7" in result)
    assert bool(re.search(hears_nothing, last)) == ("heard 0" in result)


def test_a_node_by_hand_says_what_others_have_of_another_type(tmp_path: Path) -> None:
    try:
        load_cyclone()
    except UnavailableError as error:
        pytest.skip(str(error))
    report = tmp_path / "report"
    odometry, twist = "nav_msgs::msg::dds_::Odometry_", "geometry_msgs::msg::dds_::Twist_"

    def played() -> list[str]:
        listens = NodeOptions("listener", "/odom", 0.05, by_hand=True)
        drives = NodeOptions("talker", "/cmd_vel", 0.05, by_hand=True)
        events, end = EventWriter(report), time.monotonic() + LATE
        with Participant(5) as robot, Participant(5) as stranger:
            robot.counter("rt/cmd_vel", twist)
            writer = robot._endpoint("writer", "rt/odom", odometry)
            node = CycloneNode(stranger, reliable=False)
            roles = [ROLES[of.role](node, of, events) for of in (listens, drives)]
            while time.monotonic() < end:
                robot._library.api.dds_write(writer, ctypes.byref(ctypes.c_uint8(1)))
                for role in roles:
                    role.step()
                node.poll()
                texts = [e.text for e in read_events(report) if e.text]
                told = {t.lstrip("0123456789").replace("messages", "message") for t in texts}
                told -= {text for text in told if text.startswith("Hello World")}
                if len(told) > 2:
                    return sorted(told)
                time.sleep(0.02)
        return []

    heard, driven, seen = apart(played)
    assert heard == " message of nav_msgs/msg/Odometry"
    assert driven.startswith("/cmd_vel has 1 subscription of geometry_msgs/msg/Twist, but this ")
    assert seen == "/odom has 1 publisher of nav_msgs/msg/Odometry"


def test_an_rclpy_node_by_hand_gives_up_its_own_type_to_hear_another(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """Fast DDS refuses a second type of a topic in a process (tried with rmw_fastrtps_cpp)."""
    modules = {"std_msgs.msg": "String", "nav_msgs.msg": "Odometry", "rclpy.qos": _ANY_RELIABILITY}
    for module, name in modules.items():
        monkeypatch.setitem(sys.modules, module, Mock(**{name: name}))
    node, types = Mock(), ["nav_msgs/msg/Odometry"]
    node.get_publishers_info_by_topic = lambda _topic: [Mock(topic_type=kind) for kind in types]
    options = NodeOptions("listener", "/odom", 1e-9, by_hand=True)
    ros_node._listener(node, options, EventWriter(tmp_path / "report"))
    ((_, look),) = (call.args for call in node.create_timer.call_args_list)
    look()
    made = [call for call in node.method_calls if "subscription" in call[0]]
    assert [(call[0], call.args[0]) for call in made] == [
        ("create_subscription", "String"),
        ("destroy_subscription", node.create_subscription.return_value),
        ("create_subscription", "Odometry"),
    ]
    made[2].args[2](b"raw")
    types.append("lost_msgs/msg/Other")
    look()
    seen, heard = (event.text for event in read_events(tmp_path / "report")[1:])
    assert heard == "1 message of nav_msgs/msg/Odometry"
    assert "lost_msgs/msg/Other, which this listener cannot hear (No module named 'lost_" in seen


def test_an_rclpy_action_result_names_its_server(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """Any number of servers may answer one client, such as one that should be refused."""
    actions, server, client, report = Mock(), Mock(), Mock(), tmp_path / "report"
    actions.Fibonacci.Feedback = actions.Fibonacci.Result = SimpleNamespace
    monkeypatch.setitem(sys.modules, "rclpy.action", Mock(ActionServer=server, ActionClient=client))
    monkeypatch.setattr(ros_node, "_fibonacci_action", lambda: actions.Fibonacci)
    goal = client.return_value.send_goal_async
    ros_node._action_client(asks := Mock(), NodeOptions("action_client"), EventWriter(report))
    asks.create_timer.call_args.args[1]()
    keep = goal.call_args.kwargs["feedback_callback"]
    fetch, accepted = goal.return_value.add_done_callback.call_args.args[0], Mock()
    fetch(Mock(**{"result.return_value": accepted}))
    check = accepted.get_result_async.return_value.add_done_callback.call_args.args[0]
    for text in ("of the robot", "eines Gastes (früh)"):
        options = NodeOptions("action_server", text=text)
        ros_node._action_server(Mock(), options, EventWriter(tmp_path / "server"))
        asked = Mock(**{"request.order": 5})
        asked.publish_feedback = lambda part: keep(SimpleNamespace(feedback=part))
        result = server.call_args.args[3](asked)
        check(Mock(**{"result.return_value.result": result}))
    sent, *heard = read_events(report)
    assert sent.text == "goal 1"
    numbers = "[0, 1, 1, 2, 3, 5]"
    assert [event.text for event in heard] == [
        f"of the robot: {numbers}",
        f"eines Gastes (früh): {numbers}",
    ]


@pytest.mark.parametrize("options", [["--json"], ["--scenario", "attacks"], ["--domain", "3"]])
def test_options_that_a_node_does_not_take_are_refused(options: list[str]) -> None:
    ended = sros("demo", "talker", *options)
    assert ended.status == 2
    assert f"a talker takes no {options[0]}" in ended.err


def test_a_hostile_topic_is_refused_before_a_node_starts() -> None:
    ended = sros("demo", "listener", "--topic", "/a\x1b[2J b")
    assert ended.status == 2
    assert "\x1b" not in ended.err


@pytest.mark.zenoh
def test_a_node_on_zenoh_ends_at_once_while_it_waits_for_a_router() -> None:
    pytest.importorskip("zenoh")
    program = [sys.executable, "-P", "-m", "sros_tool.demo.zenoh_node", "listener"]
    variables = {**os.environ, "ZENOH_CONFIG_OVERRIDE": 'connect/endpoints=["tcp/127.0.0.1:1"]'}
    with subprocess.Popen([*program, "--patience", "1000000"], env=variables) as node:
        status, end = Path(f"/proc/{node.pid}/status"), time.monotonic() + PATIENCE
        while not _catches(status.read_text("ascii"), signal.SIGTERM):
            assert node.poll() is None and time.monotonic() < end
            time.sleep(0.02)
        node.terminate()
        try:
            assert node.wait(PATIENCE) == 0
        finally:
            node.kill()


@pytest.mark.parametrize(("name", "tokens"), [("listener", 1), ("", 0)])
def test_a_router_on_zenoh_is_no_node(name: str, tokens: int) -> None:
    """As rmw_zenohd: the audit of a robot would otherwise find a node that it cannot judge."""
    node = pytest.importorskip("sros_tool.demo.zenoh_node")
    session = MagicMock()
    node._ZenohNode(session, "0", "", name, 0)
    assert session.liveliness().declare_token.call_count == tokens


def _catches(status: str, number: signal.Signals) -> bool:
    """Return whether a process catches a signal, by its status in /proc."""
    line = next(each for each in status.splitlines() if each.startswith("SigCgt:"))
    return bool(int(line.split()[1], 16) >> (number - 1) & 1)
