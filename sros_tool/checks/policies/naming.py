"""Names in a policy that cannot match or mean something else, and wildcards that are too wide."""

from __future__ import annotations

import re
from collections.abc import Iterator

from sros_tool.checks.kind import NOTE, WARNING, Finding, Kind, by_id
from sros_tool.checks.policies.stated import CheckedPolicy, Stated
from sros_tool.names import NODE_SERVICES, is_expression
from sros_tool.policy.model import RIGHTS
from sros_tool.policy.patterns import covers, literal_prefix, matches

NEVER_MATCHES = Kind(
    "policy.name-never-matches",
    WARNING,
    "a name that no topic, service or action can have",
    "A rule with such a name allows, or denies, nothing.",
    "rmw (validate_full_topic_name.h: at most 247 characters, no part begins with a digit).",
    "Correct the name.",
)
DDS_NAME = Kind(
    "policy.dds-name",
    WARNING,
    "a DDS name where a ROS name is meant",
    "rt/, rq/ and rr/ are put before ROS names when these become DDS topics; in a policy the name "
    "stands without.",
    "ROS 2 design, Topic and Service name mapping to DDS.",
    "Write the ROS name, without its prefix.",
)
WRONG_KIND = Kind(
    "policy.wrong-kind",
    WARNING,
    "a topic said to be a service, or a service said to be a topic",
    "The name is one that every node of ROS 2 has, and it has it for something else, so the rule "
    "allows nothing that is used.",
    "ROS 2 Jazzy (rclcpp 28, rclpy 7); ROS 2 design, Actions.",
    "Move the name to the group of its kind.",
)
EVERYTHING = Kind(
    "policy.everything",
    WARNING,
    "a wildcard that allows to act on everything",
    "Who holds it can command every node and answer in the place of every other.",
    "ROS 2 design, ROS 2 Security Enclaves: the least that is needed.",
    "Name what the node uses; `sros minimize_policy` narrows it to what was observed.",
)
WIDE = Kind(
    "policy.wide-wildcard",
    WARNING,
    "a wildcard wider than a namespace",
    "* crosses slashes, so the rule reaches nodes and namespaces that were not thought of.",
    "DDS-Security 1.1, 9.4.1.3 (POSIX fnmatch, in which * also matches a slash).",
    "Begin it with a whole namespace, as in /arm/*, or end it with a whole name.",
)
READS_EVERYTHING = Kind(
    "policy.reads-everything",
    NOTE,
    "a wildcard by which an enclave reads across namespaces",
    "A recorder needs it; anything else learns more than it has to.",
    "ROS 2 design, ROS 2 Security Enclaves: the least that is needed.",
    "Name the topics, or deny those that are nobody's business.",
)
SETS_PARAMETERS = Kind(
    "policy.sets-all-parameters",
    WARNING,
    "a wildcard by which an enclave sets the parameters of every node",
    "Parameters switch use_sim_time, remove limits, and change what drivers do.",
    "ROS 2 Jazzy: set_parameters of every node.",
    "Name the nodes whose parameters it has to set.",
)
SETS_CLOCK = Kind(
    "policy.sets-clock",
    NOTE,
    "an enclave that may publish /clock",
    "Who sets the clock can let every timeout expire on nodes that use simulated time.",
    "ROS 2 design, Clock and Time.",
    "Give it to a simulator alone.",
)
NO_COUNTERPART = Kind(
    "policy.no-counterpart",
    NOTE,
    "nobody in the policy is allowed the other side",
    "What is read here, nobody may publish; what is asked for, nobody may answer. It may be a "
    "typing error, or the other side is in another policy.",
    "sros: the policy as a whole.",
    "Compare the names on both sides, after remapping.",
)

KINDS = by_id(
    NEVER_MATCHES, DDS_NAME, WRONG_KIND, EVERYTHING, WIDE, READS_EVERYTHING, SETS_PARAMETERS,
    SETS_CLOCK, NO_COUNTERPART,
)  # fmt: skip

_LONGEST = 247
_DIGIT_FIRST = re.compile(r"/(?:[0-9]|\[[0-9-]+\])")
_DDS_PREFIX = re.compile(r"/?(?:rt|rq|rr|rs)/")
_ACTION_SERVICE = re.compile(r"/_action/(?:send_goal|cancel_goal|get_result)\Z")
_ACTION_TOPIC = re.compile(r"/_action/(?:feedback|status)\Z")
_GLOBAL_TOPICS = ("/rosout", "/parameter_events", "/clock", "/tf", "/tf_static", "/diagnostics")
_ALL = re.compile(r"/?[*?]*\*[*?]*\Z")
_OTHER_SIDE = {"subscribe": "publish", "request": "reply", "call": "execute"}


def check_names(checked: CheckedPolicy) -> Iterator[Finding]:
    """Every name by itself."""
    for each in checked.statements:
        if reason := _never(each.name):
            yield each.found(NEVER_MATCHES, f"{each.name} matches nothing: {reason}")
        if _DDS_PREFIX.match(each.written):
            yield each.found(DDS_NAME, f"{each.written} becomes {each.name}")
        if kind := _belongs(each):
            yield each.found(WRONG_KIND, f"{each.name} is one of the {kind}")
        if each.allows:
            yield from _breadth(each)


def check_counterparts(checked: CheckedPolicy) -> Iterator[Finding]:
    """Names that one side is allowed and the other side nobody."""
    names: dict[str, set[str]] = {right: set() for pair in RIGHTS.values() for right in pair}
    for each in checked.statements:
        if each.allows:
            names[each.right.right].add(each.name)
    wild = {right: [n for n in found if is_expression(n)] for right, found in names.items()}
    for each in checked.statements:
        other = _OTHER_SIDE.get(each.right.right)
        name = each.name
        if not other or not each.allows or is_expression(name) or name in _GLOBAL_TOPICS:
            continue
        if name not in names[other] and not any(matches(wide, name) for wide in wild[other]):
            if _ACTION_TOPIC.search(name) or _ACTION_SERVICE.search(name):
                continue  # it stands as an action there
            yield each.found(NO_COUNTERPART, f"no enclave may {other} {name}")


def _never(name: str) -> str:
    if len(name) > _LONGEST and not is_expression(name):
        return f"it has {len(name)} characters, and a ROS name has at most {_LONGEST}"
    return "a part of it begins with a digit" if _DIGIT_FIRST.search(name) else ""


def _belongs(each: Stated) -> str:
    """The kind that the name has everywhere, where it is another than here."""
    kind, name = each.right.kind, each.name
    if kind != "services":
        is_service = name.rpartition("/")[2] in NODE_SERVICES or _ACTION_SERVICE.search(name)
        return "services" if is_service else ""
    return "topics" if name in _GLOBAL_TOPICS or _ACTION_TOPIC.search(name) else ""


def _breadth(each: Stated) -> Iterator[Finding]:
    name, right = each.name, each.right.right
    if right == "publish" and name == "/clock":
        yield each.found(SETS_CLOCK, f"{each.right.enclave} may publish /clock")
    if not is_expression(name):
        return
    told = each.right.told()
    if _ALL.match(name):
        kind = READS_EVERYTHING if right == "subscribe" else EVERYTHING
        yield each.found(kind, f"{told} stands for every name")
    elif literal_prefix(name).count("/") < 2 and is_expression(name.rpartition("/")[2]):
        kind = READS_EVERYTHING if right == "subscribe" else WIDE
        yield each.found(
            kind, f"{told} begins with no whole namespace, and ends with no whole name"
        )
    elif right == "request" and covers(name, "/*/set_parameters"):
        yield each.found(SETS_PARAMETERS, f"{told} reaches every node")
