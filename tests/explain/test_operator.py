"""What a person may do with ros2 and rqt in each step of the operator's enclaves, and no earlier.

The rights of a command are those of its node: the names of the nodes, and what they create, are
those of ros2cli 0.32 and rqt (ROS 2 Jazzy).
"""

from __future__ import annotations

from datetime import UTC, datetime
from functools import cache

import pytest

from sros_tool.dds.decision.access import AccessVerb
from sros_tool.dds.decision.vendors import Vendor
from sros_tool.dds.domains import DomainSet
from sros_tool.explain.answer import Evaluator, Part, Question
from sros_tool.files import policies_dir
from sros_tool.graph.observation import Endpoint
from sros_tool.keystore.participant import JoinContext, plan_enclave
from sros_tool.keystore.template import load_template
from sros_tool.policy.document import read_policy
from sros_tool.translate import governance_for
from tests.graph.graphs import common, endpoints

STEPS = ("list", "look", "configure", "drive")
VENDORS = (Vendor.FAST, Vendor.FAST_2_9, Vendor.CYCLONE)
CONTEXT = JoinContext(0, datetime(2026, 11, 22, tzinfo=UTC))
GOVERNANCE = governance_for(load_template("production").protection, DomainSet.parse("0"))

COMMAND = ("publish /rosout", "publish /parameter_events", "reply ~/get_type_description")
"""What the node of a command has by itself; its parameter services are left out."""
DAEMON = COMMAND[:2]
NODE = tuple(common("python"))
"""What an ordinary node of Python has, as those of `ros2 service call` and of rqt."""
PARAMETERS = tuple(
    f"request /arm/driver/{each}"
    for each in (
        "describe_parameters",
        "get_parameter_types",
        "get_parameters",
        "list_parameters",
        "set_parameters",
        "set_parameters_atomically",
    )
)
"""What the parameter client of rclpy creates, whatever it is asked for."""

CASES = [
    ("topic list, node info, action info, service find", "_ros2cli_4711", COMMAND, "list"),
    ("topic list --use-sim-time", "_ros2cli_4711", (*COMMAND, "subscribe /clock"), "list"),
    ("the daemon", "_ros2cli_daemon_0_5e8a", DAEMON, "list"),
    ("topic echo, hz, bw, delay", "_ros2cli_4711", (*COMMAND, "subscribe /cmd_vel"), "look"),
    ("topic echo /rosout", "_ros2cli_4711", (*COMMAND, "subscribe /rosout"), "look"),
    ("service echo", "_ros2cli_1", (*COMMAND, "subscribe /add/_service_event"), "look"),
    ("lifecycle get", "_ros2cli_1", (*COMMAND, "request /amcl/get_state"), "look"),
    (
        "lifecycle list",
        "_ros2cli_1",
        (*COMMAND, "request /amcl/get_available_transitions"),
        "look",
    ),
    ("component list", "_ros2cli_1", (*COMMAND, "request /c/_container/list_nodes"), "look"),
    (
        "service call /arm/get_parameters",
        "_ros2cli_requester_rcl_interfaces_GetParameters",
        (*NODE, "request /arm/driver/get_parameters"),
        "look",
    ),
    ("rqt_graph, rqt_plot", "rqt_gui_py_node_4711", (*NODE, "subscribe /odom"), "look"),
    (
        "rqt_image_view",
        "rqt_gui_cpp_node_4711",
        (*common("c++"), "subscribe /clock", "subscribe /camera/image_raw"),
        "look",
    ),
    ("param list, get, dump", "_ros2cli_4711", (*COMMAND, *PARAMETERS), "configure"),
    ("rqt_reconfigure", "rqt_gui_py_node_4711", (*NODE, *PARAMETERS), "configure"),
    ("lifecycle set", "_ros2cli_4711", (*COMMAND, "request /amcl/change_state"), "configure"),
    ("topic pub", "_ros2cli_4711", (*COMMAND, "publish /cmd_vel"), "drive"),
    (
        "service call",
        "_ros2cli_requester_std_srvs_Trigger",
        (*NODE, "request /arm/stop"),
        "drive",
    ),
    (
        "action send_goal",
        "_ros2cli_send_goal_nav2_msgs_action_NavigateToPose",
        (*NODE, "call /navigate_to_pose"),
        "drive",
    ),
    ("component load", "_ros2cli_1", (*COMMAND, "request /c/_container/load_node"), "drive"),
]
NEVER = [
    ("serves another node's service", "_ros2cli_4711", (*NODE, "reply /amcl/set_parameters")),
    ("executes an action of the robot", "_ros2cli_4711", (*NODE, "execute /navigate_to_pose")),
    ("has another node's name", "amcl", NODE),
    ("is in a namespace", "/hall/_ros2cli_1", COMMAND),
]


@cache
def evaluator(step: str, vendor: Vendor) -> Evaluator:
    (enclave,) = read_policy(policies_dir() / f"operator_{step}.xml").enclaves
    assert enclave.path == f"/operator/{step}"
    loaded = plan_enclave(enclave, GOVERNANCE, moment=CONTEXT.at)
    return Evaluator(vendor, loaded, CONTEXT)


def endpoints_of(node: str, rights: tuple[str, ...]) -> frozenset[Endpoint]:
    """What a node with this full name writes and reads by these rights."""
    ns, _, name = node.rpartition("/")
    return endpoints(ns or "/", name, rights)


def allowed(step: str, vendor: Vendor, node: str, rights: tuple[str, ...]) -> bool:
    found = sorted(endpoints_of(node, rights))
    parts = tuple(Part(AccessVerb(each.direction), each.topic) for each in found)
    return evaluator(step, vendor).answer(Question("use", only=parts)).allowed


@pytest.mark.parametrize("vendor", VENDORS)
@pytest.mark.parametrize(("command", "node", "rights", "first"), CASES)
def test_a_command_works_from_its_step_on_and_no_earlier(
    command: str, node: str, rights: tuple[str, ...], first: str, vendor: Vendor
) -> None:
    works = [step for step in STEPS if allowed(step, vendor, node, rights)]
    assert works == list(STEPS[STEPS.index(first) :]), command


@pytest.mark.parametrize("vendor", VENDORS)
@pytest.mark.parametrize(("what", "node", "rights"), NEVER)
def test_no_step_takes_the_place_of_a_node(
    what: str, node: str, rights: tuple[str, ...], vendor: Vendor
) -> None:
    assert [step for step in STEPS if allowed(step, vendor, node, rights)] == [], what
