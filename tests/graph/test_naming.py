"""Names are written as people would, and mean what they meant."""

from __future__ import annotations

from dataclasses import replace

import pytest

from sros_tool.graph.learn import (
    is_tool_name,
    name_as_written,
    stable_name,
    tool_nodes,
    writing_rights,
)
from sros_tool.graph.observation import Endpoint, ObservedNode
from sros_tool.names import expand
from tests.graph.graphs import node
from tests.graph.test_enclaves import FIRST, SECOND


@pytest.mark.parametrize(
    ("fqn", "ns", "node", "text"),
    [
        ("/chatter", "/", "talker", "chatter"),
        ("/talker/get_parameters", "/", "talker", "~/get_parameters"),
        ("/listener/get_parameters", "/", "talker", "/listener/get_parameters"),
        ("/hall/speed", "/hall", "conveyor", "speed"),
        ("/hall/belt/speed", "/hall", "conveyor", "belt/speed"),
        ("/hall/conveyor/stop", "/hall", "conveyor", "~/stop"),
        ("/hall_2/speed", "/hall", "conveyor", "/hall_2/speed"),
        ("/hall/conveyor", "/hall", "conveyor", "conveyor"),
        ("/speed", "/hall", "conveyor", "/speed"),
        ("/tf", "/", "talker", "/tf"),
        ("/rosout", "/", "talker", "/rosout"),
        ("/fib/_action/status", "/", "talker", "fib/_action/status"),
        ("/add/_service_event", "/", "talker", "add/_service_event"),
        ("/hall/fib/_action/status", "/", "talker", "/hall/fib/_action/status"),
    ],
)
def test_written(fqn: str, ns: str, node: str, text: str) -> None:
    assert name_as_written(fqn, ns, node) == text
    assert expand(text, ns, node) == fqn


@pytest.mark.parametrize(
    ("name", "stable"),
    [
        ("transform_listener_impl_55d0c2a4b8f0", "transform_listener_impl_*"),
        ("launch_ros_4711", "launch_ros_*"),
        ("rqt_gui_py_node_12", "rqt_gui_py_node_*"),
        ("camera_1", "camera_1"),
        ("transform_listener_impl_mine", "transform_listener_impl_mine"),
    ],
)
def test_names_of_one_run(name: str, stable: str) -> None:
    assert stable_name(name) == stable


def test_tools() -> None:
    assert is_tool_name("_ros2cli_daemon_0_0123abcd")
    assert is_tool_name("_ros2cli_1234")
    assert is_tool_name("_sros_observer")
    assert is_tool_name("_sros_observer_12ab")
    assert not is_tool_name("_hidden")
    assert not is_tool_name("ros2cli")


COMMAND = ("publish /rosout", "publish /parameter_events", "reply ~/get_type_description")


@pytest.mark.parametrize(
    ("nodes", "tools"),
    [
        ([node("/_ros2cli_12", *COMMAND, "subscribe /chatter")], ["/_ros2cli_12"]),
        ([node("/_ros2cli_1"), node("/_ros2cli_X")], ["/_ros2cli_1", "/_ros2cli_X"]),
        ([node("/_ros2cli_12"), node("/driver", participant="p2")], ["/_ros2cli_12"]),
        # The name alone makes no tool of a node in a process of the robot.
        ([node("/_ros2cli_12", "publish /cmd_evil"), node("/driver")], []),
        ([node("/_ros2cli_12", participant=FIRST), node("/driver", participant=SECOND)], []),
        ([node("/_sros_observer", *COMMAND[1:2]), node("/driver")], []),
        ([node("/_sros_observer", *COMMAND[1:2])], ["/_sros_observer"]),
        ([node("/_sros_observer_1", *COMMAND[1:2], "publish /cmd_evil")], []),
    ],
)
def test_no_node_hides_behind_the_name_of_a_tool(
    nodes: list[ObservedNode], tools: list[str]
) -> None:
    assert sorted(tool.fqn for tool in tool_nodes(nodes)) == tools


@pytest.mark.parametrize(
    ("rights", "writing"),
    [
        ((*COMMAND, "subscribe /chatter", "reply ~/get_parameters"), ()),
        (("publish /x",), ("publish /x",)),
        (("request /amcl/change_state",), ("request /amcl/change_state",)),
        (("call /fib", "reply ~/open"), ("call /fib", "reply /_ros2cli_12/open")),
        (("reply /amcl/get_parameters",), ("reply /amcl/get_parameters",)),
    ],
)
def test_what_a_tool_writes(rights: tuple[str, ...], writing: tuple[str, ...]) -> None:
    assert writing_rights(node("/_ros2cli_12", *rights)) == writing
    half = Endpoint("rq/xRequest", "publish")
    tool = replace(node("/_ros2cli_12"), endpoints=frozenset({half, half._replace(topic="y")}))
    assert writing_rights(tool) == ("publish rq/xRequest", "publish y")
