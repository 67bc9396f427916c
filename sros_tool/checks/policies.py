"""Checks of policies: names, nodes, rules, portability, and the files themselves."""

from __future__ import annotations

import os
import re
from collections import Counter, defaultdict
from collections.abc import Collection, Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from difflib import get_close_matches
from functools import cache, cached_property
from itertools import chain, islice
from pathlib import Path
from shlex import quote

from lxml import etree

from sros_tool.checks.kind import (
    ERROR,
    NOTE,
    WARNING,
    Cause,
    Finding,
    FindingKind,
    RelatedPlace,
    group_by_cause,
    names_text,
)
from sros_tool.dds.decision.vendors import CYCLONE_DDS, FAST_DDS, Vendor
from sros_tool.dds.domains import DomainSet
from sros_tool.dds.permissions import (
    MAX_SIGNED_BYTES,
    Permissions,
    mistaken_names,
    pairs_text,
    portability_problems,
)
from sros_tool.errors import DocumentError, Note, PolicyError, SrosError
from sros_tool.files import policies_dir
from sros_tool.fleet.expansion import FleetPolicy
from sros_tool.fleet.robots import Fleet, Robot, group_of
from sros_tool.keystore.issuing.size import SizeEstimator, right_bytes
from sros_tool.keystore.template import Template
from sros_tool.names import (
    ACTION_PARTS,
    ACTION_SEPARATOR,
    ACTION_SERVICES,
    ACTION_TOPICS,
    GLOBAL_TOPICS,
    NODE_SERVICES,
    PARAMETER_SERVICES,
    READING_SERVICES,
    action_part,
    expand,
    has_type_descriptions,
    is_expression,
)
from sros_tool.pki.certificates import common_name, subject_text
from sros_tool.policy.document import COMMON, IncludedFile, Includer, read_policy
from sros_tool.policy.model import (
    ALLOW,
    DENY,
    OFFERING_RIGHT,
    RIGHTS,
    Enclave,
    Policy,
    Profile,
    Source,
    nodes_in_several_namespaces,
    stated_protections,
)
from sros_tool.policy.node_basics import are_basic
from sros_tool.policy.patterns import ComparisonLimit, Names, covers, literal_prefix, matches
from sros_tool.policy.placeholders import parts_of
from sros_tool.policy.rights import Right, Rules, parts, placed_rights, policy_rights
from sros_tool.spelling import NearNames, is_typing_error
from sros_tool.translate import contradictions, permissions_for
from sros_tool.validity import Window
from sros_tool.wording import capitalized, counted, first_few
from sros_tool.xml import parse, read_bytes


@dataclass(frozen=True, slots=True)
class _Statement:
    """A right in one line of a policy; ``written`` is the name in that line, before expansion."""

    right: Right
    written: str
    source: Source
    profile: Profile

    @property
    def allows(self) -> bool:
        """Whether the statement is an ALLOW."""
        return self.right.qualifier is ALLOW

    @property
    def name(self) -> str:
        """The absolute ROS name."""
        return self.right.name

    @property
    def is_private(self) -> bool:
        """Whether the name begins with the name of its node."""
        node = self.profile.node
        return bool(node) and self.name.startswith(expand("~/", self.profile.ns, node))

    def found(self, kind: FindingKind, text: str, remedy: str = "") -> Finding:
        """Return a finding of this kind about this line."""
        file, line = self.source.file, self.source.line
        return kind.found(self.right.enclave, text, file, line, remedy)


class _CheckedPolicy:
    """A policy, its statements, and its rights in a form that can be queried.

    ``distribution`` is the ROS 2 distribution of its nodes, such as ``humble``; "" is the latest.
    """

    def __init__(self, policy: Policy, distribution: str = "") -> None:
        self.policy = policy
        self.distribution = distribution

    @cached_property
    def rules(self) -> Rules:
        """All rights and denials."""
        return Rules(policy_rights(self.policy))

    @cached_property
    def statements(self) -> tuple[_Statement, ...]:
        """All rights and denials, in the order of the policy file."""
        return tuple(
            _Statement(placed.right, placed.written, placed.source, placed.profile)
            for enclave in self.policy.enclaves
            for placed in placed_rights(enclave)
        )


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
NO_COUNTERPART = FindingKind(
    "policy.no-counterpart",
    NOTE,
    "a name for which no enclave has the counterpart right",
    "No enclave, in any ROS domain, may publish this subscribed topic, or serve this called "
    "service or action. The name may have a typing error, or its counterpart is in a policy "
    "that was not checked in the same command. This check leaves out names that many nodes "
    "share, such as /tf, /clock and /diagnostics, and services of any node, such as "
    "/*/get_state.",
    "sros: compares the rights of all enclaves in the policies that are checked together.",
    "Compare the names that senders and receivers have after remapping, and name all policies of "
    "the robot in one command.",
)
NOT_OFFERED = FindingKind(
    "policy.not-offered",
    NOTE,
    "a called service or action that the node in its name may not offer",
    "No call succeeds, because the policy does not let this node offer the service or action. "
    "Perhaps it was renamed. Or the node was: then it is not in the policy, but another node of "
    "the namespace offers a service or action with the same last part, which nobody calls.",
    "sros: compares the rights of all enclaves in the policies that are checked together.",
    "Write the new name at the node that calls, or allow the other node to offer the old name. "
    "Ignore this finding if another policy of the robot has the server.",
    prominent=True,
)
MISSPELT = FindingKind(
    "policy.name-misspelt",
    WARNING,
    "a name that differs from its likely counterpart in spelling, namespace or kind",
    "Neither of the two names has an exact counterpart, so the nodes do not communicate. One name "
    "may be misspelled, lack a namespace, or be of another kind, such as a service where an action "
    "is called.",
    "sros: compares the rights of all enclaves in the policy.",
    "Write the same name, of the same kind, in both places, as the nodes have it after remapping.",
)
MISTAKEN_SIDE = FindingKind(
    "policy.side-mistaken",
    WARNING,
    "a service or action for which request and reply, or call and execute, were confused",
    "A node offers (reply, execute) the services and actions under its own name, and other nodes "
    "use them (request, call). The rule states the wrong side, and nobody has its counterpart, so "
    "no call succeeds.",
    "sros: compares the rights of all enclaves in the policy.",
    'Write reply="ALLOW" (action: execute) at the node that offers the service, and '
    'request="ALLOW" (action: call) at the nodes that use it.',
)

CONTRADICTING_PROTECTION = FindingKind(
    "policy.protection-contradicts",
    ERROR,
    "a name with contradicting protect= values",
    "A keystore has one governance for all enclaves, so a name has one protection; a wildcard "
    "sets it for all names that it matches. No keystore can follow this policy.",
    "DDS-Security 1.1, 9.4.1.2 (topic rules); sros: protect= in a policy.",
    "State the same protection in both places, or only in one of them.",
)

SEVERAL_INSTANCES = FindingKind(
    "policy.several-instances",
    NOTE,
    "an enclave with the same node in several namespaces",
    "Each process that runs in the enclave has the rights of the node in all these namespaces, so "
    "one instance of the node can act for the others.",
    "sros: the rights of all profiles of an enclave are joined.",
    "Give each instance an enclave of its own, with its namespace also in path=, unless one "
    "process runs all of them.",
)
NODE_MISSPELT = FindingKind(
    "policy.node-misspelt",
    NOTE,
    "a node whose name differs from the path of its enclave by a letter",
    "If one of the two is misspelled, the node is refused when it starts: it has no enclave, or no "
    "right to its own services.",
    "sros: compares path= with ns= and node=.",
    "Write the name that the node has when it runs.",
)

_LONGEST_NAME = 247
_DIGIT_FIRST = re.compile(r"/(?:[0-9]|\[[0-9-]+\])")
_DDS_PREFIX = re.compile(r"/?(?:rt|rq|rr|rs)/")
_EVERY_NAME = re.compile(r"/?[*?]*\*[*?]*\Z")
_SETTING_SERVICES = ("set_parameters", "set_parameters_atomically")
_ASKING_RIGHT = {offering: asking for asking, offering in OFFERING_RIGHT.items()}


def _check_names(checked_policy: _CheckedPolicy) -> Iterator[Finding]:
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


def _check_counterparts(checked_policy: _CheckedPolicy) -> Iterator[Finding]:
    """Yield findings about subscribed or called names that no enclave may publish or serve."""
    names: dict[str, set[str]] = {right: set() for pair in RIGHTS.values() for right in pair}
    for statement in checked_policy.statements:
        if statement.allows:
            names[statement.right.right].add(statement.name)
    sides = {right: Names(sorted(names_of_right)) for right, names_of_right in names.items()}

    def is_alone(statement: _Statement, other: str) -> bool:
        name = statement.name
        if not statement.allows or is_expression(name) or name in GLOBAL_TOPICS:
            return False
        # The counterpart may be in a right to the whole action.
        return not sides[other].overlaps(name) and not action_part(name)[1]

    alone = [
        statement
        for statement in checked_policy.statements
        if (other := _ASKING_RIGHT.get(statement.right.right)) and is_alone(statement, other)
    ]
    yield from _offered_by_others_findings(alone)
    offered: dict[str, list[_Statement]] = defaultdict(list)
    for statement in alone:
        if not _is_service_of_every_node(statement.name):
            offered[statement.name].append(statement)
    nodes = {
        expand("~", statement.profile.ns, statement.profile.node)
        for statement in checked_policy.statements
    }
    near = NearNames(offered)
    spelled = cache(lambda side: NearNames(e for e in names[side] if not is_expression(e)))
    for statement in checked_policy.statements:
        other = OFFERING_RIGHT.get(statement.right.right)
        if not other or not is_alone(statement, other):
            continue
        if statement.right.kind != "topics" and statement.is_private:
            text = (
                f"the node may {statement.right.describe()}, a name of its own that nobody offers"
            )
            yield statement.found(MISTAKEN_SIDE, text, f'Write {other}="ALLOW" for it.')
            continue
        candidates = [
            candidate
            for name in (statement.name, *near.similar_names(statement.name))
            for candidate in offered.get(name, ())
        ] + [
            candidate
            for name in near.same_name_elsewhere(statement.name)
            for candidate in offered[name]
            if candidate.right.right == other
        ]
        # The same node may use one name for a topic and a service, so its own names are no
        # suggestions.
        candidates = [
            candidate for candidate in candidates if candidate.profile is not statement.profile
        ]
        same_end = [
            candidate
            for name in near.names_with_same_end(statement.name)
            for candidate in offered[name][:1]
            if candidate.right.right == other and candidate.profile is not statement.profile
        ]
        if (
            not candidates
            and len(same_end) == 1
            and _differ_only_by_namespace(statement, same_end[0])
        ):
            candidates = same_end
        if candidates:
            yield _misspelt_name_finding(statement, other, candidates)
        else:
            hint = f"; {_candidates_text(same_end)}" if same_end else ""
            # All of the similar names are used.
            if similar := spelled(other).similar_names(statement.name):
                hint = f"; perhaps you mean {' or '.join(similar[:_NAMES_SHOWN])} ({other})"
            name = statement.name
            node = name.rpartition("/")[0]
            is_of_node = statement.right.kind != "topics" and (
                node in nodes or any(_is_of_sibling(candidate, node) for candidate in same_end)
            )
            kind = NO_COUNTERPART
            if is_of_node and not _is_service_of_every_node(name):
                kind = NOT_OFFERED
            yield statement.found(kind, f"no enclave may {other} {name}{hint}")
    for statement in checked_policy.statements:
        other, name = OFFERING_RIGHT.get(statement.right.right), statement.name
        if other not in ("publish", "reply") or not statement.allows or not is_expression(name):
            continue
        if name.removeprefix("/*/") in READING_SERVICES:  # a question to any node, if it answers
            continue
        if not sides[other].overlaps(name) and ACTION_SEPARATOR not in name:
            text = f"no enclave may {other} a name that {name} matches"
            yield statement.found(NO_COUNTERPART, text)


def _differ_only_by_namespace(statement_a: _Statement, statement_b: _Statement) -> bool:
    """Return whether the longer name is the shorter one with a namespace in front of it.

    Returns False if the policy writes the longer name with ``~``, and so intends the namespace.
    """
    shorter, longer = sorted((statement_a, statement_b), key=lambda statement: len(statement.name))
    return longer.name.endswith(shorter.name) and "~" not in longer.written


def _is_of_sibling(statement: _Statement, node: str) -> bool:
    """Return whether a right is to a name of another node in the namespace of ``node``."""
    other = statement.name.rpartition("/")[0]
    return statement.is_private and other.rpartition("/")[0] == node.rpartition("/")[0]


def _candidates_text(candidates: Sequence[_Statement]) -> str:
    texts = dict.fromkeys(f"{candidate.name} ({candidate.right.right})" for candidate in candidates)
    return f"perhaps you mean {' or '.join([*texts][:_NAMES_SHOWN])}"


def _is_service_of_every_node(name: str) -> bool:
    """Return whether every node offers this service, which then needs no client in a policy."""
    return name.rpartition("/")[2] in NODE_SERVICES


def _offered_by_others_findings(unused_statements: Iterable[_Statement]) -> Iterator[Finding]:
    """Yield findings about uncalled services that are under the name of another enclave's node."""
    owners = {
        (statement.right.right, statement.name): statement
        for statement in unused_statements
        if statement.right.kind != "topics" and statement.is_private
    }
    for statement in unused_statements:
        owner = owners.get((statement.right.right, statement.name))
        if owner and not statement.is_private and statement.right.enclave != owner.right.enclave:
            asking = _ASKING_RIGHT[statement.right.right]
            place = RelatedPlace(f"{owner.right.enclave} offers it", *_source_place(owner.source))
            text = (
                f"the node may {statement.right.describe()}, under the name of a node in "
                f"{owner.right.enclave}; that enclave also offers it ({place}), and nobody may "
                f"{asking} it"
            )
            remedy = f'Write {asking}="ALLOW" for it.'
            yield statement.found(MISTAKEN_SIDE, text, remedy)._replace(related=(place,))


def _misspelt_name_finding(
    misspelt: _Statement, counterpart: str, candidates: Sequence[_Statement]
) -> Finding:
    """Return the finding on a name for which no enclave has the right ``counterpart``.

    The finding suggests ``candidates``, statements with similar names.
    """
    shown, remedy = candidates[:_NAMES_SHOWN], ""
    hint, first = _candidates_text(shown), shown[0]
    if first.name == misspelt.name:
        kind = first.right.kind.removesuffix("s")
        article = "an" if kind == "action" else "a"
        hint = (
            f"{first.right.enclave} offers {article} {kind} of this name ({first.right.right}), "
            "which no enclave uses"
        )
        if misspelt.right.kind == "actions":
            place = RelatedPlace("", *_source_place(first.source))
            remedy = f"Write it at {place} {_as_action(counterpart, first.written)}"
        elif kind == "action":
            remedy = f"Write it {_as_action('call', misspelt.written)}"
    text = f"no enclave may {counterpart} {misspelt.name}; {hint}"
    places = tuple(
        RelatedPlace(
            f"{candidate.right.enclave} may {candidate.right.describe()}",
            *_source_place(candidate.source),
        )
        for candidate in shown
    )
    return misspelt.found(MISSPELT, text, remedy=remedy)._replace(related=places)


def _as_action(right: str, name: str) -> str:
    return f'as an action: <actions {right}="ALLOW"><action>{name}</action></actions>.'


def _source_place(source: Source) -> tuple[str, int | None]:
    return source.file, source.line or None


def _check_instances(checked_policy: _CheckedPolicy) -> Iterator[Finding]:
    """Yield findings about enclaves that have a node in several namespaces."""
    enclaves = checked_policy.policy.enclaves
    for (enclave, node), profiles in nodes_in_several_namespaces(enclaves).items():
        names = [profile.ns for profile in profiles]
        source = profiles[-1].source
        text = f"{enclave} has the node {node} in {first_few(names, _NAMES_SHOWN)}"
        yield SEVERAL_INSTANCES.found(enclave, text, source.file, source.line)


def _check_node_names(checked_policy: _CheckedPolicy) -> Iterator[Finding]:
    """Yield findings about nodes whose names are almost the name of their enclave."""
    for enclave in checked_policy.policy.enclaves:
        own = enclave.path.rpartition("/")[2]
        near = []
        for profile in enclave.all_profiles():
            full = profile.full_name
            if enclave.path == full or (
                own == profile.node and not is_typing_error(enclave.path, full)
            ):
                break
            if is_typing_error(own, profile.node) or is_typing_error(enclave.path, full):
                near.append((profile, full))
        else:
            for profile, full in near:
                text, source = f"{enclave.path} has the node {full}", profile.source
                yield NODE_MISSPELT.found(enclave.path, text, source.file, source.line)


def _check_protection(checked_policy: _CheckedPolicy) -> Iterator[Finding]:
    """Yield findings about names with contradicting protect= values."""
    for protection, other in islice(
        contradictions(stated_protections(checked_policy.policy.enclaves)), _MOST_FILES
    ):
        text = (
            f"{other} has protect={other.word}, "
            f"and {protection} has protect={protection.word} at {protection.source}"
        )
        place = other.source
        yield CONTRADICTING_PROTECTION.found(other.enclave, text, place.file, place.line)


def _why_impossible(name: str) -> str:
    if len(name) > _LONGEST_NAME and not is_expression(name):
        return f"it has {len(name)} characters; a ROS name has at most {_LONGEST_NAME}"
    return "a part of it begins with a digit" if _DIGIT_FIRST.search(name) else ""


def _kind_of_ros_name(statement: _Statement) -> str:
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


def _broad_right_findings(statement: _Statement) -> Iterator[Finding]:
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
        yield statement.found(
            kind,
            f"{text} has a wildcard in the first part and in the last part of the name",
        )
    elif right == "request" and any(covers(name, f"/*/{service}") for service in _SETTING_SERVICES):
        yield statement.found(SETS_PARAMETERS, f"{text} matches every node")


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

OTHER_NODES_PARAMETERS = FindingKind(
    "policy.other-nodes-parameters",
    WARNING,
    "a right to serve the parameters of a node that the enclave does not have",
    "A process in the enclave could pose as that node, and read and answer the requests that set "
    "the node's parameters.",
    "rcl_interfaces; rclcpp and rclpy (parameter services of a node).",
    "Remove the right. If the node runs in this enclave, add a profile for the node.",
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


def _check_nodes(checked_policy: _CheckedPolicy) -> Iterator[Finding]:
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


def _check_parameters_of_others(checked_policy: _CheckedPolicy) -> Iterator[Finding]:
    """Yield findings about parameter services of nodes that the enclave does not have.

    A wildcard counts if it matches a parameter service of a node that only other enclaves have.
    """
    nodes: dict[str, set[str]] = defaultdict(set)
    enclave_by_node: dict[str, str] = {}
    for enclave in checked_policy.policy.enclaves:
        for profile in enclave.all_profiles():
            node = profile.full_name
            nodes[enclave.path].add(node)
            if profile.node and not is_expression(node):
                enclave_by_node.setdefault(node, enclave.path)
    services = Names(f"{node}/{name}" for node in enclave_by_node for name in PARAMETER_SERVICES)
    limit = ComparisonLimit(6_000_000)

    def is_denied(right: Right) -> bool:
        denied = checked_policy.rules.overlaps(right._replace(qualifier=DENY))
        if denied:
            limit.spend(len(right.name))
        return denied

    for statement in checked_policy.statements:
        right, name = statement.right, statement.name
        if not statement.allows or right.right != "reply":
            continue
        node, _, service = name.rpartition("/")
        is_of_parameters = service in PARAMETER_SERVICES
        if is_of_parameters and not any(covers(own, node) for own in nodes[right.enclave]):
            text = f"may serve {name}, and has no node {node}"
            yield statement.found(OTHER_NODES_PARAMETERS, text)
        elif is_expression(name):
            other_nodes = (
                other
                for matched in services.overlapping(name)
                if (other := matched.rpartition("/")[0]) not in nodes[right.enclave]
                and not is_denied(right._replace(name=matched))
            )
            for other in islice(other_nodes, 1):
                text = (
                    f"may serve {name}, and so pose as the node {other} of {enclave_by_node[other]}"
                )
                remedy = _NAME_NODES_REMEDY.format("nodes" if is_of_parameters else "services")
                yield statement.found(OTHER_NODES_PARAMETERS, text, remedy)


_NAME_NODES_REMEDY = "Name the {} of this enclave in place of the wildcard."


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
    checked_policy: _CheckedPolicy, enclave: Enclave, profile: Profile
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


DOCUMENT_SIZE = FindingKind(
    "portable.document-size",
    WARNING,
    "signed permissions of 60 KB or more",
    "Participants send their permissions and certificate together in the handshake. If these "
    "exceed one message of 64 KB, Fast DDS 2.6 and 2.9 never finish the handshake, or abort; later "
    "releases and Cyclone DDS accept them.",
    "ros2/sros2 issue 228; Fast DDS 2.6.12, 2.9.1 (SecurityManager.cpp), 2.14.5, 3.2.5 and "
    "3.6.2, Cyclone DDS 0.10.2; tested.",
    "Remove rights that are never used, or use wildcards (`sros minimize_policy POLICY --observed "
    "OBSERVED` shows such rights and wildcards), or split the enclave.",
    vendors=tuple(vendor for vendor in FAST_DDS if vendor.traits.largest_document),
)
LONG_NAME = FindingKind(
    "portable.long-name",
    WARNING,
    "a topic whose name is too long for Fast DDS",
    "If the DDS topic name has 252 bytes or more (with prefix and suffix), Fast DDS creates the "
    "endpoint and never matches it; Cyclone DDS matches it.",
    "Fast DDS 2.6 to 3.6, Cyclone DDS 0.10 and 11.0; tested.",
    "Use shorter namespaces and names.",
    vendors=FAST_DDS,
)
DENY_BLOCKS = FindingKind(
    "portable.deny-blocks-topic",
    WARNING,
    "a topic that is denied in one direction and allowed in the other: Cyclone DDS 0.10 denies "
    "both",
    "Cyclone DDS 0.10 does not create a topic that is denied in one direction; Fast DDS and "
    "Cyclone DDS 11 create it.",
    "Cyclone DDS 0.10.2 and 11.0.1 (access_control.c), Fast DDS 2.6 to 3.6; tested.",
    "Remove the deny rule (everything that no rule allows is denied anyway), or deny only names "
    "whose other direction the node does not use. Do not deny calls to the parameter services of "
    "all nodes, because every node serves its own.",
    vendors=(Vendor.CYCLONE,),
)
CHARACTER_SET = FindingKind(
    "portable.character-set",
    NOTE,
    "a [set] of characters in a name",
    "Vendors agree on sets such as [ab], but not on all sets. On * and ?, they always agree.",
    "Fast DDS 2.6 to 3.6 (fnmatch), Cyclone DDS 0.10 and 11.0 (its own matching); tested.",
    "Use * or ?, or write the names out.",
)
NOT_ON_ZENOH = FindingKind(
    "policy.not-on-zenoh",
    ERROR,
    "a policy that Zenoh rules cannot express",
    "`sros zenoh` refuses a keystore with such permissions. sros checks this only with --vendor "
    "zenoh.",
    "zenoh.io, Access Control; sros (docs/zenoh.md).",
    "List names in place of wildcards.",
)
ENCLAVE_NAMES = FindingKind(
    "portable.enclave-names",
    WARNING,
    "an enclave whose path consists only of components of another enclave's path",
    "Cyclone DDS checks only that every part of a certificate's subject occurs in the grant's "
    "subject. So /robot can join with the (public) permissions of /robot/admin.",
    "Cyclone DDS 0.10.2 and 11.0.1 (access_control.c); reproduced: readers received data of such "
    "an enclave.",
    "Rename an enclave so that its path has a part that the other path lacks, such as "
    "/robot_admin, or choose unique subjects (template production).",
    vendors=CYCLONE_DDS,
)
SEVERAL_PROFILES = FindingKind(
    "policy.several-profiles",
    NOTE,
    "an enclave with several <profiles>",
    "sros joins all <profiles>. ros2/sros2 makes one grant from each of them, and DDS uses only "
    "the first grant.",
    "ros2/sros2 0.13; DDS-Security 1.1, 9.4.1.3; Fast DDS 2.14.5 and Cyclone DDS 0.10.2.",
    "Put all <profile> elements of an enclave into one <profiles>.",
)

_PORTABILITY_KINDS = {
    kind.id: kind for kind in (DOCUMENT_SIZE, LONG_NAME, DENY_BLOCKS, CHARACTER_SET)
}
_MEASURED_FROM_BYTES = MAX_SIGNED_BYTES // 2
_ANY_TIME = Window(datetime(2026, 1, 1, tzinfo=UTC), datetime(2027, 1, 1, tzinfo=UTC))
_DOMAIN_0 = DomainSet.of((0, 0))


ROOT_ENCLAVE = FindingKind(
    "policy.root-enclave",
    WARNING,
    "the enclave '/', with the rights of nodes or of other enclaves",
    "A process that names no enclave runs in /, and gets all rights of /. Without an enclave /, it "
    "would not start (with ROS_SECURITY_STRATEGY=Enforce).",
    "rcl 9 (rcl/src/rcl/security.c, context.c: the enclave is / by default).",
    "Remove the enclave / from the policy once each process has its own enclave: `sros "
    "generate_policy POLICY --enclave-per-node` writes such a policy.",
)


def _check_root_enclave(checked_policy: _CheckedPolicy) -> Iterator[Finding]:
    """Yield a finding about an enclave / that has the rights of nodes, or of other enclaves.

    A single node counts only if it has a plain name (not ``_ros2cli_*`` or an expression) and
    rights that not every node needs.
    """
    root = checked_policy.policy.enclave("/")
    if root is None:
        return
    nodes = {profile.full_name for profile in root.all_profiles()}
    text = clause_on_enclaves_within_root(policy_rights(checked_policy.policy))
    if not text and len(nodes) > 1:
        text = f"/ has the rights of {len(nodes)} nodes"
    elif not text and not are_basic(policy_rights(Policy((root,)))):
        name = root.all_profiles()[0].node
        if name and name[0] != "_" and not is_expression(name):
            text = f"/ has the rights of the node {nodes.pop()}"
    if text:
        yield ROOT_ENCLAVE.found("/", text, root.source.file, root.source.line)


def clause_on_enclaves_within_root(rights: Collection[Right]) -> str:
    """Return a clause on the enclaves whose rights the enclave / also has; "" without any.

    Rights that every node needs do not count.
    """
    allowed = [right for right in rights if right.qualifier is ALLOW]
    root = Rules(right for right in rights if right.enclave == "/")
    rights_by_enclave: dict[str, list[Right]] = defaultdict(list)
    for right in allowed:
        if right.enclave != "/" and not are_basic([right]):
            rights_by_enclave[right.enclave].append(right)
    names = sorted(
        name
        for name, allowed_rights in rights_by_enclave.items()
        if all(root.allow("/", right.right, right.name) for right in allowed_rights)
    )
    return f"/ has all rights of {first_few(names, _NAMES_SHOWN)}" if names else ""


_NAMES_SHOWN = 3


def _check_portability(checked_policy: _CheckedPolicy) -> Iterator[Finding]:
    """Yield findings about the permissions that would be signed for each enclave."""
    for enclave in checked_policy.policy.enclaves:
        source = enclave.source
        permissions = permissions_for(
            enclave,
            subject=subject_text(common_name(enclave.path)),
            validity=_ANY_TIME,
            domains=_DOMAIN_0,
        )
        size = _signed_bytes(enclave)
        for finding in portability_findings(
            permissions, size, enclave.path, source.file, source.line
        ):
            yield (
                _with_place_of_denial(finding, checked_policy)
                if finding.kind is DENY_BLOCKS
                else finding
            )
        if len(enclave.profiles) > 1:
            text = f"it has {len(enclave.profiles)} <profiles>"
            yield SEVERAL_PROFILES.found(enclave.path, text, source.file, source.line)
    if pairs := mistaken_names(enclave.path for enclave in checked_policy.policy.enclaves):
        text = f"Cyclone DDS mistakes {pairs_text(pairs)}"
        first = checked_policy.policy.enclave(pairs[0][0])
        line = first.source.line if first else None
        yield ENCLAVE_NAMES.found(pairs[0][0], text, checked_policy.policy.file, line)


def _with_place_of_denial(finding: Finding, checked_policy: _CheckedPolicy) -> Finding:
    """Return the finding with the file and line of the first denial in its enclave."""
    denials = (
        s for s in checked_policy.statements if s.right.enclave == finding.subject and not s.allows
    )
    source = next(denials).source
    return finding._replace(file=source.file, line=source.line)


def portability_findings(
    permissions: Permissions, signed_bytes: int, subject: str, file: str, line: int | None = None
) -> Iterator[Finding]:
    """Yield findings about parts of permissions that are outside the portable profile."""
    for identity, fact in portability_problems(
        permissions, signed_bytes, lambda names: Names(names).overlaps
    ):
        yield _PORTABILITY_KINDS[identity].found(subject, fact, file, line)


def _signed_bytes(enclave: Enclave) -> int:
    """Return the size in bytes of an enclave's signed permissions; a small size is estimated."""
    rights = policy_rights(Policy((enclave,)))
    estimate = sum(map(right_bytes, rights))
    return SizeEstimator().signed_bytes(enclave) if estimate > _MEASURED_FROM_BYTES else estimate


_RULE_ORDER_SOURCE = (
    "sros signs the deny rules of an enclave before its allow rules, as ros2/sros2 does, and the "
    "first rule that matches decides (DDS-Security 1.1, 9.4.1.3)."
)

CONTRADICTION = FindingKind(
    "policy.contradiction",
    WARNING,
    "the same name is allowed and denied",
    "The DENY wins, so the ALLOW has no effect; one of the two is a mistake.",
    _RULE_ORDER_SOURCE,
    "Remove the ALLOW or the DENY.",
)
UNREACHABLE = FindingKind(
    "policy.unreachable-rule",
    WARNING,
    "an ALLOW that a DENY covers completely",
    "A DENY of the same enclave, perhaps of another node in it, covers every name of the ALLOW, "
    "so the ALLOW has no effect.",
    _RULE_ORDER_SOURCE,
    "Remove the ALLOW, or narrow the DENY.",
)
NO_EFFECT = FindingKind(
    "policy.deny-without-effect",
    NOTE,
    "a DENY of something that no rule allows",
    "Everything that no rule allows is denied anyway. The DENY has an effect only in a policy that "
    "users merge into their own, such as the policy of a package: there, it wins over every ALLOW "
    "for the enclave.",
    "DDS-Security 1.1, 9.4.1.3 (the default is DENY); sros: merge_policy never weakens a DENY.",
    "Keep the DENY if this right must never be added to the enclave.",
)
REDUNDANT_RULE = FindingKind(
    "policy.redundant-rule",
    NOTE,
    "a name that a wildcard in the same profile already covers",
    "The rights of a profile add up, so the name only makes the document longer.",
    "sros: the rights of a profile are joined.",
    "Remove the name, or better the wildcard.",
)
HALF_ACTION = FindingKind(
    "policy.action-in-part",
    ERROR,
    "an action that is allowed only in part",
    "An action consists of three services and two topics. The client or server of an action "
    "creates all five when it starts, and fails if one of them is denied. An enclave that has only "
    "a part of the right to execute the action can still send false feedback or results. (Not "
    "reported are rights to subscribe to feedback and status, which a node needs to observe an "
    "action, and to request cancel_goal or get_result.)",
    "ROS 2 design, Actions; rcl_action 9 (rcl_action_client_init, rcl_action_server_init).",
    'Write <actions call="ALLOW"> or <actions execute="ALLOW"> with the name of the action, or '
    "remove the part.",
)


def _check_rules(checked_policy: _CheckedPolicy) -> Iterator[Finding]:
    """Yield findings about contradicting, unused and repeated statements of an enclave."""
    for statement in checked_policy.statements:
        if statement.allows:
            yield from _statement_findings(statement, checked_policy.rules)
        elif not checked_policy.rules.overlaps(statement.right._replace(qualifier=ALLOW)):
            text = f"no rule gives the right to {statement.right.describe()}"
            yield statement.found(NO_EFFECT, text, _remedy_of_denial(statement.written))
    yield from _actions_in_part(checked_policy)
    yield from _redundancy_findings(checked_policy)


def _remedy_of_denial(written: str) -> str:
    """Return the remedy for a DENY without effect; ``written`` is its name in the policy file."""
    if written.startswith(("/", "~")):
        return NO_EFFECT.remedy
    return (
        f"{NO_EFFECT.remedy} Write /*{written.lstrip('*')} to deny the name in every namespace: "
        f"after a merge with `--namespace /left`, {written} denies only /left/{written}."
    )


def _statement_findings(statement: _Statement, rules: Rules) -> Iterator[Finding]:
    denial = statement.right._replace(qualifier=DENY)
    if denials := rules.covering_rights(denial):
        is_same_right = set(parts(denial)) == set(denials)
        shown = ", ".join(sorted({f"{by.right} {by.name}" for by in denials}))
        if is_same_right:
            text = f"{statement.right.describe()} is allowed here and denied in the same enclave"
            yield statement.found(CONTRADICTION, text)
        else:
            yield statement.found(UNREACHABLE, f"{statement.right.describe()} is denied by {shown}")
        return
    right, name = statement.right.right, statement.right.name
    if right in ACTION_PARTS and not is_expression(name) and rules.overlaps(denial):
        shown = ", ".join(f"{by.right} {by.name}" for by in rules.overlapping(denial))
        text = f"{right} {name} is allowed, but a part of the action is denied by {shown}"
        yield statement.found(HALF_ACTION, text, "Remove the DENY of the part, or the ALLOW.")


def _actions_in_part(checked_policy: _CheckedPolicy) -> Iterator[Finding]:
    """Yield a finding for each action of an enclave of which only parts are allowed."""
    rules = checked_policy.rules
    parts_of_actions: dict[tuple[str, str, str], list[_Statement]] = defaultdict(list)
    for statement in checked_policy.statements:
        enclave, _, right, name = statement.right
        action, separator, ending = name.rpartition(ACTION_SEPARATOR)
        if not (statement.allows and separator) or rules.cover(
            statement.right._replace(qualifier=DENY)
        ):
            continue
        if whole := _action_right(right, ending):
            parts_of_actions[enclave, whole, action].append(statement)
    for (enclave, whole, action), statements in parts_of_actions.items():
        if not rules.allow(enclave, whole, action):
            shown = first_few([f"{s.right.right} {s.name}" for s in statements], 2)
            is_are = "is" if len(statements) == 1 else "are"
            text = f"{shown} {is_are} allowed, but not everything needed to {whole} {action}"
            remedy = f'Write <actions {whole}="ALLOW"> with the name of the action, or remove '
            remedy += "the part." if len(statements) == 1 else "the parts."
            yield statements[0].found(HALF_ACTION, text, remedy)


def _action_right(right: str, ending: str) -> str:
    """Return the right to an action of which a part may be a mistake, or ""."""
    if right == "request":
        return "call" if matches(ending, "send_goal") else ""
    executes = any(
        right == of_part and matches(ending, part.removeprefix(ACTION_SEPARATOR))
        for of_part, part in ACTION_PARTS["execute"]
    )
    return "execute" if executes else ""


def _redundancy_findings(checked_policy: _CheckedPolicy) -> Iterator[Finding]:
    wild: dict[tuple[int, str], list[str]] = defaultdict(list)
    for statement in checked_policy.statements:
        if statement.allows and is_expression(statement.name):
            wild[id(statement.profile), statement.right.right].append(statement.name)
    limit = ComparisonLimit()
    names = {place: Names(expressions, limit) for place, expressions in wild.items()}
    for statement in checked_policy.statements:
        # Included rights are the same for all nodes, so a redundant one is not a mistake.
        if not statement.allows or statement.source.file != statement.profile.source.file:
            continue
        place_names = names.get((id(statement.profile), statement.right.right))
        if place_names and (wide := next(place_names.covering(statement.name), "")):
            yield statement.found(
                REDUNDANT_RULE, f"{statement.right.describe()} is covered by {wide}"
            )


MALFORMED = FindingKind(
    "policy.malformed",
    ERROR,
    "a policy that cannot be read",
    "No verb of sros can use it.",
    "SROS2 policy XML 0.2.0 (policy.xsd of ros2/sros2) and the ROS 2 names.",
    "Correct the policy at the reported place.",
)
DUPLICATE = FindingKind(
    "policy.duplicate-enclave",
    ERROR,
    "an enclave that is defined twice",
    "Some verbs of ros2/sros2 use the first definition, others the last, so rights depend on the "
    "command. sros refuses the policy.",
    "ros2/sros2 0.13 (create_permission, generate_artifacts).",
    "Join the two into one <enclave>.",
)
IN_TWO_FILES = FindingKind(
    "policy.enclave-in-two-files",
    WARNING,
    "an enclave that two policies define",
    "The two policies count as policies of one robot. Verbs that take rights from both policies "
    "fail.",
    "sros.",
    "Define the enclave in one of the two policies. If they are for different robots, check the "
    "policies of each robot with a separate command.",
)
NODE_IN_TWO_ENCLAVES = FindingKind(
    "policy.node-in-two-enclaves",
    WARNING,
    "a node that several enclaves have",
    "Names of nodes are unique in ROS, and a process runs in one enclave: `sros run --policy` "
    "and `ros2 launch --secured` refuse to choose an enclave for the node.",
    "rcl (node names are unique); sros.",
    "Keep the profile only in the enclave of the node's process. If these are nodes of several "
    "robots, check the policy of each robot by itself, or write the policy for a fleet.",
)
FALLBACK = FindingKind(
    "policy.include-fallback",
    WARNING,
    "an include whose file does not exist",
    "The <xi:fallback> of the include is used instead, so the rights are not the intended ones.",
    "XInclude 1.0, 4.4.",
    "Put the file there, or remove the include.",
)
REDUNDANT_INCLUDE = FindingKind(
    "policy.redundant-include",
    NOTE,
    "an include that adds nothing",
    "The profile already includes the file, directly or through another file.",
    "XInclude 1.0.",
    "Remove the include.",
)
SHARED_NAMESPACE = FindingKind(
    "policy.shared-namespace",
    WARNING,
    "robots with the same namespace, or with one namespace inside the other",
    "In the same namespace, both robots publish and subscribe to the same names. A wildcard in "
    "an outer namespace also matches the names in the inner namespace.",
    "rcl (puts the node's namespace before relative names); sros (placeholder {namespace}).",
    "Give each robot a namespace of its own in the fleet file, or a ROS domain of its own. "
    "Computers of one robot may share its namespace: put them, and no other robot, into one group, "
    "and let no node run on two of them.",
)

UNKNOWN_GROUP = FindingKind(
    "policy.unknown-group",
    WARNING,
    "robots in no group, or in a group that no policy names",
    "Their processes get no enclaves, and no keys.",
    "sros (placeholder {robot:GROUP}).",
    "Correct the groups of the robots in the fleet file, or name all policies of the fleet.",
)

ROBOT_WRITTEN_OUT = FindingKind(
    "policy.robot-written-out",
    WARNING,
    "the name of a robot in place of its placeholder",
    "For sros, the enclave belongs to no robot: nothing delivers, renews or revokes it with the "
    "robot.",
    "sros (placeholder {robot}).",
    "Write the path with the placeholder that the finding names.",
)

_CHECKS = (
    _check_rules,
    _check_nodes,
    _check_names,
    _check_node_names,
    _check_protection,
    _check_root_enclave,
    _check_portability,
)
_CHECKS_TOGETHER = (_check_counterparts, _check_instances, _check_parameters_of_others)
"""Checks for which the policies of a robot count as one policy."""
_PLACED_ERROR = re.compile(r"(?P<file>.+?):(?P<line>\d+): (?P<text>.*)", re.DOTALL)
_XML_ERROR_PLACE = re.compile(r", line (?P<line>\d+), column \d+")  # in messages of libxml2
_INCLUDE_TAGS = tuple(f"{{http://www.w3.org/{year}/XInclude}}include" for year in (2001, 2003))
_MOST_FILES = 1000
_NUMBER = re.compile(r"[0-9]+")


def findings_in(
    policies: Sequence[Policy], distribution: str = "", *, of_fleet: bool = False
) -> Iterator[Finding]:
    """Yield all findings in the parsed policies of a robot, except the findings about includes.

    A name may have its counterpart in any of the policies.  With ``of_fleet``, the policies are for
    several robots, whose nodes may have the same names in different ROS domains.
    """
    checked = [_CheckedPolicy(policy, distribution) for policy in policies]
    for checked_policy in checked:
        for check in _CHECKS:
            yield from check(checked_policy)
    if len(checked) > 1:
        enclaves = tuple(enclave for policy in policies for enclave in policy.enclaves)
        checked = [_CheckedPolicy(replace(policies[0], enclaves=enclaves), distribution)]
        yield from _duplicate_enclave_findings(enclaves)
    for checked_policy in checked:
        if not of_fleet:
            yield from _node_in_two_enclaves_findings(checked_policy.policy.enclaves)
        for check in _CHECKS_TOGETHER:
            yield from check(checked_policy)


def _duplicate_enclave_findings(enclaves: Iterable[Enclave]) -> Iterator[Finding]:
    """Yield a finding for each enclave that two policies state at different places."""
    stated: dict[str, Enclave] = {}
    for enclave in enclaves:
        earlier = stated.setdefault(enclave.path, enclave)
        if earlier.source != enclave.source:
            text = f"{enclave.path} is defined here and at {earlier.source}"
            yield IN_TWO_FILES.found(enclave.path, text, enclave.source.file, enclave.source.line)


def _node_in_two_enclaves_findings(enclaves: Iterable[Enclave]) -> Iterator[Finding]:
    """Yield a finding for each node without wildcards in its name that several enclaves have."""
    by_node: dict[str, dict[str, Source]] = defaultdict(dict)
    for enclave in enclaves:
        for profile in enclave.all_profiles():
            node = profile.full_name
            if profile.node and not is_expression(node):
                by_node[node].setdefault(enclave.path, profile.source)
    for node, places in by_node.items():
        if len(places) > 1:
            path, source = [*places.items()][1]
            text = f"the node {node} is in {first_few([*places], _NAMES_SHOWN)}"
            yield NODE_IN_TWO_ENCLAVES.found(path, text, source.file, source.line)


def is_mended_by(template: Template | None, finding: Finding) -> bool:
    """Return whether a keystore made from ``template`` would not have the reported weakness."""
    return template is not None and finding.kind is ENCLAVE_NAMES and template.unique_subject


def policy_file_findings(
    *paths: Path,
    distribution: str = "",
    fleet: Fleet | None = None,
    policy: Policy | None = None,
    on_zenoh: bool = False,
) -> Iterator[Finding]:
    """Yield all findings in policy files; a file that cannot be read is a finding too.

    Args:
        paths: the files, which are of one robot or fleet.
        distribution: the ROS 2 distribution of the nodes, such as ``humble``; "" is the latest.
        fleet: the robots that placeholders in the policies stand for.
        policy: the policy in the only file, if it is parsed already.
        on_zenoh: whether the nodes use Zenoh.
    """
    read: list[Policy] = []
    patterns: list[str] = []
    for path in paths:
        try:
            known = policy if policy and len(paths) == 1 else None
            if fleet:
                expanded = FleetPolicy(read_policy(path, placeholders=True), fleet)
                patterns += expanded.patterns
                known = known or expanded.policy()
            known = known or read_policy(path)
        except SrosError as error:
            yield from _unreadable_policy_findings(path, error)
            continue
        read.append(known)
        yield from _include_findings(path)
    if fleet:
        enclaves = [enclave for policy in read for enclave in policy.enclaves]
        if shared := [*_shared_namespaces(fleet.with_enclaves(patterns), enclaves)]:
            first = str(paths[0])
            yield SHARED_NAMESPACE.found(first, first_few(shared, 3, "; "), first)
    groups = {group_of(parts_of(pattern)) for pattern in patterns}
    if fleet and len(read) == len(paths) and (text := _unknown_groups_clause(groups, fleet)):
        yield UNKNOWN_GROUP.found(str(paths[0]), text, str(paths[0]))
    if fleet:
        yield from _written_out_robot_findings(read, fleet.with_enclaves(patterns))
    yield from findings_in(read, distribution, of_fleet=fleet is not None)
    if on_zenoh:
        yield from _check_zenoh(enclave for policy in read for enclave in policy.enclaves)


def _check_zenoh(enclaves: Iterable[Enclave]) -> Iterator[Finding]:
    """Yield findings about enclaves whose rights Zenoh rules cannot express."""
    from sros_tool.translate_zenoh.rights import remote_rights

    for enclave in enclaves:
        try:
            remote_rights(enclave, domain=0)
        except PolicyError as error:
            file, line, text = _split_place(error)
            yield NOT_ON_ZENOH.found(
                enclave.path, f"{text}. {error.why}", file, line, remedy=error.remedy
            )


def _shared_namespaces(fleet: Fleet, enclaves: Iterable[Enclave]) -> Iterator[str]:
    """Yield a clause for each namespace that several robots on one ROS domain share.

    The computers of one robot (in the fleet file, each counts as a robot) may share a namespace if
    they are exactly one group, and no node runs on two of them.
    """
    robots = {
        namespace: [fleet.robots[name] for name in names]
        for namespace, names in fleet.by_namespace.items()
    }
    groups = {*fleet.groups.values()}
    shared = {*chain(*(names for names in fleet.by_namespace.values() if names in groups))}
    twice = _robots_with_the_same_node(fleet, enclaves) if len(shared) > 1 else frozenset()
    for namespace, inside in robots.items():
        names = fleet.by_namespace[namespace]
        is_one_robot = names in groups and not twice & {*names}
        if not is_one_robot and (met := _robots_on_one_domain(inside)):
            yield f"{met[0].name} and {met[1].name} have the namespace {namespace}"
        above = namespace
        while above := above.rpartition("/")[0]:  # a robot in / may contain the others
            if met := _robots_on_one_domain(inside, robots.get(above, [])):
                outer, inner = (robot.name for robot in met)
                yield (
                    f"the namespace of {inner}, {namespace}, is inside {above}, the namespace of "
                    f"{outer}"
                )


def _robots_with_the_same_node(fleet: Fleet, enclaves: Iterable[Enclave]) -> frozenset[str]:
    """Return the names of robots with a node whose full name a node of another robot has, too."""
    from sros_tool.fleet.robots import robot_of

    robots_by_node: dict[str, set[str]] = defaultdict(set)
    for enclave in enclaves:
        if robot := robot_of(fleet, enclave.path):
            for profile in enclave.all_profiles():
                robots_by_node[profile.full_name].add(robot.name)
    return frozenset(chain(*(names for names in robots_by_node.values() if len(names) > 1)))


def _unknown_groups_clause(named: Collection[str], fleet: Fleet) -> str:
    """Return a clause on robots with a misspelled group or without a group; "" if there are none.

    ``named`` are the groups in the policies, with "" for enclaves of all robots.  Other groups may
    belong to policies that were not named.  So a group counts only if no other robot has the group,
    and if the name differs from a group in the policies by a typing error, not only by a number.  A
    robot without a group counts if every enclave is for a group.
    """
    for_all, groups = not named or "" in named, {*named} - {""}
    clauses = []
    for robot in fleet.robots.values():
        for group in sorted({*robot.groups} - groups):
            close = get_close_matches(group, groups) if len(fleet.groups[group]) < 2 else []
            letters = _NUMBER.sub("", group)
            if meant := sorted(name for name in close if _NUMBER.sub("", name) != letters):
                clauses.append(f"{robot.name} (group {group}: perhaps {first_few(meant, 2)})")
        if not (robot.groups or for_all):
            clauses.append(f"{robot.name} (in no group)")
    return f"no enclave is for {first_few(clauses, 5)}" if clauses else ""


def _written_out_robot_findings(policies: Sequence[Policy], fleet: Fleet) -> Iterator[Finding]:
    """Yield a finding for each enclave whose path has a robot's name in place of a placeholder."""
    from sros_tool.fleet.robots import robot_of

    for policy in policies:
        for enclave in policy.enclaves:
            name, _, rest = enclave.path[1:].partition("/")
            robot = fleet.robots.get(name)
            if robot and robot_of(fleet, enclave.path) is None:
                group = f":{robot.groups[0]}" if robot.groups else ""
                path = f"/{{robot{group}}}/{rest}".rstrip("/")
                text = f"{enclave.path} is no enclave of the robot {name}: write {path}"
                yield ROBOT_WRITTEN_OUT.found(enclave.path, text, enclave.source.file)


def _robots_on_one_domain(
    robots: Sequence[Robot], other_robots: Sequence[Robot] | None = None
) -> tuple[Robot, Robot] | None:
    """Return two robots that may be in the same ROS domain, or None.

    One robot is from ``robots``, and the other is from ``other_robots``. If that is None, both are
    from ``robots``.
    """
    robots_by_domain = {robot.domain: robot for robot in other_robots or ()}
    for robot in robots:
        candidates = (robots_by_domain.get(robot.domain), robots_by_domain.get(None))
        for other_robot in robots_by_domain.values() if robot.domain is None else candidates:
            if other_robot:
                return other_robot, robot
        if other_robots is None:
            robots_by_domain[robot.domain] = robot
    return None


def _unreadable_policy_findings(path: Path, error: SrosError) -> Iterator[Finding]:
    has_duplicates = False
    for name, line in _duplicates(path):
        has_duplicates = True
        yield DUPLICATE.found(name, f"{name} is defined here again", str(path), line)
    if has_duplicates:
        return
    file, line, text = _split_place(error)
    if not file and (syntax := _XML_ERROR_PLACE.search(error.why)):
        line = int(syntax["line"])
    why = " ".join(part for part in (f"{text}.", error.why) if part)
    yield MALFORMED.found(str(path), why, file or str(path), line, error.remedy)


def _split_place(error: SrosError) -> tuple[str, int, str]:
    """Return the file and line that an error begins with ("" and 0 without them), and the rest."""
    match = _PLACED_ERROR.match(error.what)
    return (match["file"], int(match["line"]), match["text"]) if match else ("", 0, error.what)


def _duplicates(path: Path) -> Iterator[tuple[str, int]]:
    try:
        root = parse(read_bytes(path, "policy file"), str(path))
    except SrosError:
        return
    names: set[str] = set()
    for element in root.iter("enclave"):
        name = element.get("path", "")
        if name in names:
            yield name, element.sourceline or 0
        names.add(name)


# ── includes ───────────────────────────────────────────────────────────────────────────────


def _include_findings(path: Path) -> Iterator[Finding]:
    """Yield findings about the includes of a file; reads an included file only once."""
    graph = _IncludeGraph(Path(os.path.realpath(path)))
    for includes in graph.includes_by_parent():
        reached = {
            included
            for file in {file for _, file in includes}
            for included in graph.included_files(file)
        }
        steps: set[tuple[Path, str]] = set()
        for element, file in includes:
            href, line = element.get("href", ""), element.sourceline
            step = (file, element.get("xpointer", ""))
            if not file.exists():
                yield FALLBACK.found(str(path), f"'{href}' does not exist", str(path), line)
            elif step in steps or file in reached:
                text = f"'{href}' is already included in the same profile by another include"
                yield REDUNDANT_INCLUDE.found(str(path), text, str(path), line)
            steps.add(step)


class _IncludeGraph:
    """The includes of a policy file, and of the files that are included."""

    def __init__(self, file: Path) -> None:
        self._file = file
        self._includer = Includer(file.parent)
        self._direct: dict[Path, frozenset[Path]] = {}
        self._reached: dict[Path, frozenset[Path]] = {}

    def includes_by_parent(self) -> Iterator[list[tuple[etree._Element, Path]]]:
        """Yield lists of sibling include elements of the policy file, with the included files."""
        for parent in self._includer.load(self._file).iter():
            includes = list(parent.iterchildren(*_INCLUDE_TAGS))
            if len(includes) <= _MOST_FILES:
                targets = ((element, self._target(self._file, element)) for element in includes)
                yield [(element, file) for element, file in targets if file]

    def included_files(self, file: Path) -> frozenset[Path]:
        """Return the files that a file includes, directly or through other files."""
        if file not in self._reached:
            paths: set[Path] = set()
            waiting = [file]
            while waiting and len(paths) < _MOST_FILES:
                new = self._files_included_by(waiting.pop()) - paths
                paths |= new
                waiting += new
            self._reached[file] = frozenset(paths - {file})
        return self._reached[file]

    def _files_included_by(self, file: Path) -> frozenset[Path]:
        if file not in self._direct:
            try:
                includes = list(self._includer.load(file).iter(*_INCLUDE_TAGS))
            except DocumentError:
                includes = []  # the file is in an unused fallback, or does not exist
            targets = (self._target(file, element) for element in includes)
            self._direct[file] = frozenset(target for target in targets if target)
        return self._direct[file]

    def _target(self, file: Path, element: etree._Element) -> Path | None:
        try:
            return self._includer.target(element, IncludedFile(file))
        except PolicyError:
            return None  # the include is in <metadata>, or in an unused fallback


_MOST_ENCLAVES = 1000  # per policy; checking a whole fleet would delay signing


def signed_findings(
    policies: Sequence[Policy | FleetPolicy], enclaves: Collection[str], distribution: str = ""
) -> list[tuple[Finding, ...]]:
    """Return the errors and warnings in policies, worst first, grouped by cause.

    A policy for a fleet is checked for one robot of each group.  At most 1,000 enclaves are
    checked.

    Args:
        policies: the policies.
        enclaves: the enclaves whose permissions are to be signed; no other enclaves are checked.
        distribution: the ROS 2 distribution of the nodes; "" is the latest.
    """
    parts: list[Policy] = []
    for policy_or_fleet in policies:
        policy = (
            policy_or_fleet.for_one_robot()
            if isinstance(policy_or_fleet, FleetPolicy)
            else policy_or_fleet
        )
        chosen = [enclave for enclave in policy.enclaves if enclave.path in enclaves][
            :_MOST_ENCLAVES
        ]
        parts.append(replace(policy, enclaves=tuple(chosen)))
    of_fleet = any(isinstance(policy, FleetPolicy) for policy in policies)
    findings = findings_in(parts, distribution, of_fleet=of_fleet)
    shown = [finding for finding in findings if finding.severity >= WARNING]
    shown.sort(key=lambda finding: -finding.severity.weight)
    return list(group_by_cause(list(dict.fromkeys(shown))))


def as_note(findings: tuple[Finding, ...]) -> Note:
    """Return a finding, or several findings with one cause, as a note."""
    first = findings[0]
    if first.cause and len(findings) > 1:
        cause, place = first.cause, first.cause.place or first.place
        text = f"{place}: {cause.title}. {cause.text} {cause.remedy}"
    else:
        text = f"{first.place}: {first.kind.title}: {first.text}. {first.remedy}"
    return Note(first.id, text)
