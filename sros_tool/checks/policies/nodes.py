"""What every ROS 2 node needs to start, and whether a policy gives it to each of its nodes."""

from __future__ import annotations

from collections.abc import Iterator

from sros_tool.checks.kind import ERROR, NOTE, Finding, Kind, by_id
from sros_tool.checks.policies.stated import CheckedPolicy
from sros_tool.names import PARAMETER_SERVICES, expand
from sros_tool.policy.model import Enclave, Profile

_INCLUDE = (
    '<xi:include href="common/node.xml" xpointer="xpointer(/profile/*)"/> gives all of that; '
    "`sros policies --copy` has the file."
)

NO_TYPE_DESCRIPTION = Kind(
    "policy.no-type-description",
    ERROR,
    "a node that may not offer ~/get_type_description",
    "Nodes of Jazzy offer this service, and one that is denied it ends as soon as it starts.",
    "ROS 2 Jazzy, rclcpp 28 and rclpy 7 (node type descriptions interface); REP-2016.",
    f'Allow <services reply="ALLOW"><service>~/get_type_description</service></services>. '
    f"{_INCLUDE}",
)
NO_ROSOUT = Kind(
    "policy.no-rosout",
    ERROR,
    "a node that may not publish /rosout",
    "Every node makes a publisher for its log when it starts, and fails where it may not.",
    "ROS 2 Jazzy, rcl 9 (rcl_logging_rosout_init_publisher_for_node).",
    f'Allow <topics publish="ALLOW"><topic>/rosout</topic></topics>. {_INCLUDE}',
)
NO_PARAMETER_EVENTS = Kind(
    "policy.no-parameter-events",
    ERROR,
    "a node that may not publish /parameter_events",
    "Every node announces its parameters there, and fails at its start where it may not.",
    "ROS 2 Jazzy, rclcpp 28 (NodeParameters) and rclpy 7 (Node).",
    f'Allow <topics publish="ALLOW"><topic>/parameter_events</topic></topics>. {_INCLUDE}',
)
NO_PARAMETER_SERVICES = Kind(
    "policy.no-parameter-services",
    ERROR,
    "a node that may not offer all of its parameter services",
    "Every node offers all six unless it was made without, and fails at its start where it may "
    "not.",
    "ROS 2 Jazzy, rclcpp 28 (ParameterService) and rclpy 7 (start_parameter_services).",
    f'Allow <services reply="ALLOW"> with ~/get_parameters and the others. {_INCLUDE}',
)
NO_PARAMETERS = Kind(
    "policy.without-parameters",
    NOTE,
    "a node that may offer no parameter service at all",
    "It has everything else that it needs, so it may well have been made without parameters; "
    "otherwise it fails at its start.",
    "ROS 2 Jazzy, rclcpp 28 (NodeOptions) and rclpy 7 (start_parameter_services).",
    f"If it has parameters, let it offer them. {_INCLUDE}",
)
RELATIVE_GLOBAL = Kind(
    "policy.relative-global-name",
    ERROR,
    "a name that ROS has at the root, said relative to a namespace",
    "/rosout, /parameter_events and /clock are absolute also for nodes in a namespace, so the "
    "rule allows a topic that nobody uses. Sample policies of ros2/sros2 have this.",
    "rcl 9 (logging_rosout.h: /rosout); rclcpp 28 (/parameter_events, /clock).",
    "Put a / before the name.",
)

KINDS = by_id(
    NO_TYPE_DESCRIPTION, NO_ROSOUT, NO_PARAMETER_EVENTS, NO_PARAMETER_SERVICES, NO_PARAMETERS,
    RELATIVE_GLOBAL,
)  # fmt: skip

_GLOBAL = ("rosout", "parameter_events", "clock")
_BASICS = (
    (NO_TYPE_DESCRIPTION, "reply", ("~/get_type_description",)),
    (NO_ROSOUT, "publish", ("/rosout",)),
    (NO_PARAMETER_EVENTS, "publish", ("/parameter_events",)),
    (NO_PARAMETER_SERVICES, "reply", tuple(f"~/{name}" for name in PARAMETER_SERVICES)),
)
_LISTENER = "transform_listener_impl_"
"""Begins the names of the nodes that tf2_ros makes; they have no parameters, and no events."""
_OF_LISTENERS = (NO_TYPE_DESCRIPTION, NO_ROSOUT)


def check_nodes(checked: CheckedPolicy) -> Iterator[Finding]:
    """Every node of a policy, by what its enclave allows as a whole.

    Nodes whose names begin with an underscore are hidden ones, tools that are started without
    log, parameters and types (ROS 2 design, "Topic and Service Names"; ros2cli does so).
    """
    for enclave in checked.policy.enclaves:
        for profile in enclave.all_profiles():
            if profile.node and profile.ns.startswith("/") and not profile.node.startswith("_"):
                yield from _basics(checked, enclave, profile)
    for each in checked.statements:
        if each.written in _GLOBAL and each.profile.ns != "/" and each.right.kind == "topics":
            text = f"{each.written} becomes {each.name} in namespace {each.profile.ns}"
            yield each.found(RELATIVE_GLOBAL, text, f"Write /{each.written}.")


def _basics(checked: CheckedPolicy, enclave: Enclave, profile: Profile) -> Iterator[Finding]:
    node = expand("~", profile.ns, profile.node)
    listener = profile.node.startswith(_LISTENER)
    lacks_others = False
    for kind, right, names in _BASICS:
        if listener and kind not in _OF_LISTENERS:
            continue
        wanted = (expand(name, profile.ns, profile.node) for name in names)
        missing = [name for name in wanted if not checked.rules.allow(enclave.path, right, name)]
        if not missing:
            continue
        if kind is NO_PARAMETER_SERVICES and len(missing) == len(names) and not lacks_others:
            kind = NO_PARAMETERS
        lacks_others = True
        text = f"node {node} may not {right} {', '.join(missing)}"
        yield kind.found(enclave.path, text, profile.source.file, profile.source.line)
