"""Checks of the rights that every node needs to start."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from shlex import quote

from sros_tool.checks.kind import ERROR, NOTE, Cause, Finding, FindingKind, names_text
from sros_tool.checks.policies.statements import CheckedPolicy
from sros_tool.files import policies_dir
from sros_tool.names import PARAMETER_SERVICES, expand, has_type_descriptions, is_expression
from sros_tool.policy.document import COMMON
from sros_tool.policy.model import Enclave, Profile
from sros_tool.wording import capitalized, counted

_INCLUDE_ELEMENT = (
    '<xi:include xmlns:xi="http://www.w3.org/2001/XInclude" href="common/node.xml" '
    'xpointer="xpointer(/profile/*)"/>'
)
_INCLUDE_HINT = (
    f"{_INCLUDE_ELEMENT} allows what every node needs; `sros policies --copy common`, run in the "
    "folder of the policy, writes that file."
)
NO_TYPE_DESCRIPTION = FindingKind(
    "policy.no-type-description",
    ERROR,
    "a node that may not offer ~/get_type_description",
    "Nodes of ROS 2 Iron and later offer this service when they start, and exit if it is denied. "
    "Nodes of earlier distributions, such as Humble, do not have it: for such a distribution, add "
    "--distro, or set $ROS_DISTRO.",
    "ROS 2 Jazzy, rclcpp 28 and rclpy 7 (node type descriptions interface); Iron, rclcpp 21; "
    "REP-2016.",
    f'Allow <services reply="ALLOW"><service>~/get_type_description</service></services>. '
    f"{_INCLUDE_HINT}",
)
NO_ROSOUT = FindingKind(
    "policy.no-rosout",
    ERROR,
    "a node that may not publish /rosout",
    "Every node creates a publisher for its log when it starts, and fails if this is denied.",
    "ROS 2 Jazzy, rcl 9 (rcl_logging_rosout_init_publisher_for_node).",
    f'Allow <topics publish="ALLOW"><topic>/rosout</topic></topics>. {_INCLUDE_HINT}',
)
NO_PARAMETER_EVENTS = FindingKind(
    "policy.no-parameter-events",
    ERROR,
    "a node that may not publish /parameter_events",
    "Every node announces its parameters on this topic, and fails when it starts if this is "
    "denied.",
    "ROS 2 Jazzy, rclcpp 28 (NodeParameters) and rclpy 7 (Node).",
    f'Allow <topics publish="ALLOW"><topic>/parameter_events</topic></topics>. {_INCLUDE_HINT}',
)
NO_PARAMETER_SERVICES = FindingKind(
    "policy.no-parameter-services",
    ERROR,
    "a node that is denied some or all of its parameter services",
    "Every node offers all six, unless it was created without them. It fails when it starts if "
    "one of them is denied.",
    "ROS 2 Jazzy, rclcpp 28 (ParameterService) and rclpy 7 (start_parameter_services).",
    'Allow <services reply="ALLOW"> with ~/get_parameters and the other parameter services. '
    f"{_INCLUDE_HINT}",
)
NO_PARAMETERS = FindingKind(
    "policy.without-parameters",
    NOTE,
    "a node that may not offer any parameter service",
    "The node has all other rights that every node needs, so perhaps it was created without "
    "parameters. Otherwise the node fails when it starts.",
    "ROS 2 Jazzy, rclcpp 28 (NodeOptions) and rclpy 7 (start_parameter_services).",
    f"If the node has parameters, allow these services. {_INCLUDE_HINT}",
)
RELATIVE_GLOBAL = FindingKind(
    "policy.relative-global-name",
    ERROR,
    "a global ROS 2 topic that is written as a relative name",
    "/rosout, /parameter_events and /clock are absolute even for nodes in a namespace, so the "
    "rule allows a topic that no node uses. Sample policies of ros2/sros2 have this mistake.",
    "rcl 9 (logging_rosout.h: /rosout); rclcpp 28 (/parameter_events, /clock).",
    "Put a / before the name.",
)
_GLOBAL_TOPIC_NAMES = ("rosout", "parameter_events", "clock")
_NODE_BASICS = (
    (NO_TYPE_DESCRIPTION, "reply", ("~/get_type_description",)),
    (NO_ROSOUT, "publish", ("/rosout",)),
    (NO_PARAMETER_EVENTS, "publish", ("/parameter_events",)),
    (NO_PARAMETER_SERVICES, "reply", tuple(f"~/{name}" for name in PARAMETER_SERVICES)),
)
_START_ACTIONS = {
    NO_ROSOUT: "publish /rosout",
    NO_PARAMETER_EVENTS: "publish /parameter_events",
    NO_PARAMETER_SERVICES: "offer parameter services",
    NO_TYPE_DESCRIPTION: "offer ~/get_type_description",
}
"""Kind of finding → action of a starting node that the policy denies."""
_TF_LISTENER_PREFIX = "transform_listener_impl_"
"""Name prefix of the nodes of tf2_ros listeners; these nodes have no parameter services."""
_KINDS_OF_LISTENERS = (NO_TYPE_DESCRIPTION, NO_ROSOUT)


def check_nodes(checked_policy: CheckedPolicy) -> Iterator[Finding]:
    """Yield findings about nodes whose enclave lacks a right that every node needs.

    A profile for any node is skipped if the enclave also has named nodes, because these nodes
    start. Nodes whose names begin with an underscore are skipped: they are hidden nodes of tools
    such as ros2cli, without log, parameters and type descriptions (ROS 2 design, "Topic and Service
    Names").
    """
    lacking = [
        gap
        for enclave in checked_policy.policy.enclaves
        for profile in enclave.all_profiles()
        if profile.node and profile.ns.startswith("/") and not profile.node.startswith("_")
        if not (_is_any_node(profile.node) and _has_named_node(enclave))
        for gap in _lacking_basics(checked_policy, enclave, profile)
    ]
    groups: dict[tuple[str, str], list[_NodeLackingRight]] = defaultdict(list)
    differs = cache(_is_not_shipped)
    for gap in lacking:
        if gap.needs_include:
            included = gap.included if gap.included and differs(gap.included) else ""
            groups[gap.finding.file, included].append(gap)
    for (_, included), gaps in groups.items():
        cause = (
            _different_common_part_cause(included, gaps)
            if included
            else _missing_common_part_cause(gaps)
        )
        for gap in gaps:
            remedy = cause.remedy if included else ""
            shared = cause if len(gaps) > 1 else None
            gap.finding = gap.finding._replace(cause=shared, own_remedy=remedy)
    yield from (gap.finding for gap in lacking)
    for statement in checked_policy.statements:
        if (
            statement.written in _GLOBAL_TOPIC_NAMES
            and statement.profile.ns != "/"
            and statement.right.kind == "topics"
        ):
            text = (
                f"{statement.written} becomes {statement.name} in namespace {statement.profile.ns}"
            )
            remedy = f"Write /{statement.written}."
            if statement.source.file != statement.profile.source.file:
                remedy += (
                    " If the profile includes common/node.xml, remove the include of this file."
                )
            yield statement.found(RELATIVE_GLOBAL, text, remedy)


@dataclass(slots=True)
class _NodeLackingRight:
    """A node without a right that every node needs, with the finding about it.

    ``included`` is the folder of the common parts that the node's profile includes, or "".
    ``is_listener`` says that the node belongs to a listener of tf2_ros.
    """

    finding: Finding
    node: str
    is_listener: bool
    included: str

    @property
    def needs_include(self) -> bool:
        """Whether the remedy is to include ``common/node.xml``."""
        return not self.is_listener and self.finding.severity is ERROR


def _common_folder(profile: Profile) -> str:
    """Return the folder of the ``common/node.xml`` that a profile includes, or ""."""
    next_to_it = Path(profile.source.file).parent / COMMON
    for group in profile.groups:
        for folder in Path(group.source.file).parents:
            if folder.name == COMMON and group.source.file.startswith(f"{folder}/node"):
                return str(next_to_it if next_to_it.absolute() == folder else folder)
    return ""


def _is_not_shipped(folder: str) -> bool:
    """Return whether ``node.xml`` in a folder, or an included part, is not the shipped file."""
    shipped = policies_dir() / COMMON
    parts = (shipped / "node.xml", *(shipped / "node").iterdir())
    with suppress(OSError):
        own_files = [Path(folder, part.relative_to(shipped)) for part in parts]
        return own_files[0].is_file() and any(
            not copy.is_file() or copy.read_bytes() != part.read_bytes()
            for copy, part in zip(own_files, parts, strict=True)
        )
    return False


def _denied_start_actions_sentence(lacking: Sequence[_NodeLackingRight]) -> str:
    """Return a sentence on the denied actions that a node takes when it starts."""
    nodes = list(dict.fromkeys(gap.node for gap in lacking))
    kinds = Counter(kind for kind, _ in {(gap.finding.kind, gap.node) for gap in lacking})
    verbs = [
        verb if kinds[kind] == len(nodes) else f"{verb} ({counted(kinds[kind], 'node')})"
        for kind, verb in _START_ACTIONS.items()
        if kinds[kind]
    ]
    *first, last = verbs
    either = f"{', '.join(first)} or {last}" if first else last
    return f"{names_text(nodes)} may not {either}. A node needs all these rights to start."


def _different_common_part_cause(folder: str, lacking: Sequence[_NodeLackingRight]) -> Cause:
    """Return the common cause of findings: an included common part is not the shipped part."""
    new, old = quote(folder), quote(f"{folder}.old")
    return Cause(
        f"the included '{folder}/node.xml' lacks rights that the file in this version of sros has",
        _denied_start_actions_sentence(lacking),
        f"'{folder}/node.xml' is included and differs from the file in this version of sros. "
        f"Replace it: `mv {new} {old} && sros policies --copy {new}`. Your own files and changes "
        f"are then only in {old}: copy them back.",
        len(lacking),
    )


def _missing_common_part_cause(lacking: Sequence[_NodeLackingRight]) -> Cause:
    """Return the common cause of findings in one file: ``common/node.xml`` is not included."""
    file = Path(lacking[0].finding.file)
    nodes = list(dict.fromkeys(gap.node for gap in lacking))
    lines = list(dict.fromkeys(gap.finding.line or 0 for gap in lacking))
    plural = len(nodes) > 1
    copied = (file.parent / COMMON / "node.xml").exists()
    target = quote(str(file.parent / COMMON))
    copy = "" if copied else f"Run `sros policies --copy {target}`, and "
    at = f"line{'s' * (len(lines) > 1)} {names_text([str(line) for line in lines])}"
    place = "the <profile> of every node" if plural else "the <profile> of the node"
    if plural and len(lines) == len(nodes):  # sed edits only the first match in a line
        addresses = "".join(f"{line}ba;" for line in lines)
        # libxml2 gives a <profile> the line where its start tag ends; the tag may begin earlier.
        edit = quote(f"{addresses}b;:a;s#(<profile |^)([^<>]*[^/<>])?>#&{_INCLUDE_ELEMENT}#")
        put = f"run this command, which adds the include to {place} ({at}): "
        remedy = f"{copy}{put}`sed -E -i {edit} {quote(str(file))}`"
    else:
        remedy = f"{copy}put this line into {place} ({at}): {_INCLUDE_ELEMENT}"
    remedy = capitalized(remedy)
    if any(_is_any_node(node) for node in nodes):
        remedy = f"{_NAME_NODE_FIRST_REMEDY} {remedy}"
    return Cause(
        f"{counted(len(nodes), 'node')} lack rights that every node needs"
        if plural
        else "a node lacks rights that every node needs",
        _denied_start_actions_sentence(lacking),
        remedy,
        len(lacking),
    )


_NAME_NODE_FIRST_REMEDY = (
    "First write the name of the node in place of '*': otherwise the added line lets a process "
    "serve the parameters of every node."
)


def _is_any_node(node: str) -> bool:
    return node.rpartition("/")[2] == "*"


def _has_named_node(enclave: Enclave) -> bool:
    return any(not is_expression(profile.node) for profile in enclave.all_profiles())


def _lacking_basics(
    checked_policy: CheckedPolicy, enclave: Enclave, profile: Profile
) -> Iterator[_NodeLackingRight]:
    node = profile.full_name
    is_listener = profile.node.startswith(_TF_LISTENER_PREFIX)
    lacks_others = False
    for kind, right, names in _NODE_BASICS:
        if is_listener and kind not in _KINDS_OF_LISTENERS:
            continue
        if kind is NO_TYPE_DESCRIPTION and not has_type_descriptions(checked_policy.distribution):
            continue
        wanted = (expand(name, profile.ns, profile.node) for name in names)
        missing = [
            name for name in wanted if not checked_policy.rules.allow(enclave.path, right, name)
        ]
        if not missing:
            continue
        if kind is NO_PARAMETER_SERVICES and len(missing) == len(names) and not lacks_others:
            kind = NO_PARAMETERS
        lacks_others = True
        text = f"node {node} may not {right} {', '.join(missing)}"
        remedy = f"{_NAME_NODE_FIRST_REMEDY} {kind.remedy}" if _is_any_node(node) else ""
        finding = kind.found(
            enclave.path, text, profile.source.file, profile.source.line, remedy=remedy
        )
        yield _NodeLackingRight(finding, node, is_listener, _common_folder(profile))
