"""Names are written as people would, and mean what they meant."""

from __future__ import annotations

import pytest

from sros_tool.graph.learn import is_tool, is_tool_name, name_as_written, stable_name
from sros_tool.names import expand
from tests.graph.graphs import node


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


def test_no_node_hides_behind_the_name_of_the_observer() -> None:
    for name in ("_sros_observer", "_sros_observer_12ab"):
        assert is_tool(node(f"/{name}", "publish /parameter_events"))
        assert not is_tool(node(f"/{name}", "publish /parameter_events", "publish /cmd_vel"))
    assert is_tool(node("/_ros2cli_12", "subscribe /chatter"))
