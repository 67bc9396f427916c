"""Checks of single names in a policy: kind, prefix, wildcards, and names that nothing can have."""

from __future__ import annotations

import re
from collections.abc import Iterator

from sros_tool.checks.kind import NOTE, WARNING, Finding, FindingKind
from sros_tool.checks.policies.statements import CheckedPolicy, PolicyStatement
from sros_tool.names import (
    ACTION_SERVICES,
    ACTION_TOPICS,
    GLOBAL_TOPICS,
    NODE_SERVICES,
    action_part,
    is_expression,
)
from sros_tool.policy.patterns import covers, literal_prefix

NEVER_MATCHES = FindingKind(
    "policy.name-never-matches",
    WARNING,
    "a name that no topic, service or action can have",
    "A rule with this name has no effect.",
    "rmw (validate_full_topic_name.h: at most 247 characters, no part begins with a digit).",
    "Correct the name.",
)
DDS_NAME = FindingKind(
    "policy.dds-name",
    WARNING,
    "a DDS name in place of a ROS name",
    "ROS 2 puts rt/, rq/ or rr/ before a ROS name to get the name of its DDS topic. Names in a "
    "policy have no prefix.",
    "ROS 2 design, Topic and Service name mapping to DDS.",
    "Write the ROS name, without its prefix.",
)
WRONG_KIND = FindingKind(
    "policy.wrong-kind",
    WARNING,
    "a name of another kind, such as a service in a rule for topics",
    "In ROS 2, this name is always a topic, or always a service, so a rule for the other kind "
    "has no effect.",
    "ROS 2 Jazzy (rclcpp 28, rclpy 7); ROS 2 design, Actions.",
    "Move the name to the group of its kind: <topics> or <services>.",
)
EVERYTHING = FindingKind(
    "policy.everything",
    WARNING,
    "a wildcard that allows publishing, calling or serving every name",
    "The enclave can command every node and answer in place of every other node.",
    "ROS 2 design, ROS 2 Security Enclaves: least privilege.",
    "Name the topics, services and actions that the node uses: `sros minimize_policy POLICY "
    "--observed OBSERVED -o OUTPUT` writes the observed names in place of the wildcard.",
)
WIDE = FindingKind(
    "policy.wide-wildcard",
    WARNING,
    "a wildcard wider than a namespace",
    "* also matches slashes, so the rule may reach more nodes and namespaces than you expect.",
    "DDS-Security 1.1, 9.4.1.3 (POSIX fnmatch, in which * also matches a slash).",
    "Begin the name with a whole namespace, as in /arm/*, or end it with a whole "
    "name, as in /*/scan.",
)
READS_EVERYTHING = FindingKind(
    "policy.reads-everything",
    NOTE,
    "a wildcard that allows subscribing across namespaces",
    "A recorder needs this right; any other enclave learns more than it needs.",
    "ROS 2 design, ROS 2 Security Enclaves: least privilege.",
    "Name the topics, or deny the confidential ones.",
)
SETS_PARAMETERS = FindingKind(
    "policy.sets-all-parameters",
    WARNING,
    "a wildcard that allows setting the parameters of every node",
    "Parameters switch use_sim_time, remove limits, and change how drivers behave.",
    "ROS 2 Jazzy: set_parameters of every node.",
    "Name the nodes whose parameters the enclave has to set.",
)
SETS_CLOCK = FindingKind(
    "policy.sets-clock",
    NOTE,
    "an enclave that may publish /clock",
    "An enclave that sets the clock can make every timeout expire on nodes that use simulated "
    "time.",
    "ROS 2 design, Clock and Time.",
    "Allow publishing /clock to a simulator only.",
)
_LONGEST_NAME = 247
_DIGIT_FIRST = re.compile(r"/(?:[0-9]|\[[0-9-]+\])")
_DDS_PREFIX = re.compile(r"/?(?:rt|rq|rr|rs)/")
_EVERY_NAME = re.compile(r"/?[*?]*\*[*?]*\Z")
_SETTING_SERVICES = ("set_parameters", "set_parameters_atomically")


def check_names(checked_policy: CheckedPolicy) -> Iterator[Finding]:
    """Yield findings about single names."""
    for statement in checked_policy.statements:
        if reason := _why_impossible(statement.name):
            yield statement.found(NEVER_MATCHES, f"{statement.name} matches nothing: {reason}")
        if _DDS_PREFIX.match(statement.written):
            yield statement.found(
                DDS_NAME, f"{statement.written} means the ROS name {statement.name}"
            )
        if kind := _kind_of_ros_name(statement):
            yield statement.found(
                WRONG_KIND,
                f"{statement.name} is a {kind.removesuffix('s')}, and the rule is for "
                f"{statement.right.kind}",
            )
        if statement.allows:
            yield from _broad_right_findings(statement)


def _why_impossible(name: str) -> str:
    if len(name) > _LONGEST_NAME and not is_expression(name):
        return f"it has {len(name)} characters; a ROS name has at most {_LONGEST_NAME}"
    return "a part of it begins with a digit" if _DIGIT_FIRST.search(name) else ""


def _kind_of_ros_name(statement: PolicyStatement) -> str:
    """Return the kind that ROS 2 gives to a name; "" if the policy states this kind.

    The kind is "topics" or "services".
    """
    kind, name = statement.right.kind, statement.name
    if kind != "services":
        is_service = (
            name.rpartition("/")[2] in NODE_SERVICES or action_part(name)[1] in ACTION_SERVICES
        )
        return "services" if is_service else ""
    return "topics" if name in GLOBAL_TOPICS or action_part(name)[1] in ACTION_TOPICS else ""


def _broad_right_findings(statement: PolicyStatement) -> Iterator[Finding]:
    name, right = statement.name, statement.right.right
    if right == "publish" and name == "/clock":
        yield statement.found(SETS_CLOCK, f"{statement.right.enclave} may publish /clock")
    if not is_expression(name):
        return
    text = statement.right.describe()
    if _EVERY_NAME.match(name):
        kind = READS_EVERYTHING if right == "subscribe" else EVERYTHING
        yield statement.found(kind, f"{text} matches every name")
    elif literal_prefix(name).count("/") < 2 and is_expression(name.rpartition("/")[2]):
        kind = READS_EVERYTHING if right == "subscribe" else WIDE
        where = (
            "in the first part and in the last part" if name.count("/") > 1 else "in the only part"
        )
        yield statement.found(kind, f"{text} has a wildcard {where} of the name")
    elif right == "request" and any(covers(name, f"/*/{service}") for service in _SETTING_SERVICES):
        yield statement.found(SETS_PARAMETERS, f"{text} matches every node")
