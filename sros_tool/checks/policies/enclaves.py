"""Checks of the enclaves of a policy, and of the nodes in each of them."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Collection, Iterable, Iterator
from itertools import islice

from sros_tool.checks.kind import NOTE, WARNING, Finding, FindingKind
from sros_tool.checks.policies.statements import CheckedPolicy
from sros_tool.names import PARAMETER_SERVICES, is_expression
from sros_tool.policy.model import (
    ALLOW,
    DENY,
    Enclave,
    Policy,
    nodes_in_several_enclaves,
    nodes_in_several_namespaces,
)
from sros_tool.policy.node_basics import are_basic
from sros_tool.policy.patterns import ComparisonLimit, Names, covers
from sros_tool.policy.rights import Right, Rules, policy_rights
from sros_tool.spelling import is_typing_error
from sros_tool.wording import first_few

_NAMES_SHOWN = 3

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
OTHER_NODES_PARAMETERS = FindingKind(
    "policy.other-nodes-parameters",
    WARNING,
    "a right to serve the parameters of a node that the enclave does not have",
    "A process in the enclave could pose as that node, and read and answer the requests that set "
    "the node's parameters.",
    "rcl_interfaces; rclcpp and rclpy (parameter services of a node).",
    "Remove the right. If the node runs in this enclave, add a profile for the node.",
)
_NAME_NODES_REMEDY = "Name the {} of this enclave in place of the wildcard."
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


def check_instances(checked_policy: CheckedPolicy) -> Iterator[Finding]:
    """Yield findings about enclaves that have a node in several namespaces."""
    enclaves = checked_policy.policy.enclaves
    for (enclave, node), profiles in nodes_in_several_namespaces(enclaves).items():
        names = [profile.ns for profile in profiles]
        source = profiles[-1].source
        text = f"{enclave} has the node {node} in {first_few(names, _NAMES_SHOWN)}"
        yield SEVERAL_INSTANCES.found(enclave, text, source.file, source.line)


def check_node_names(checked_policy: CheckedPolicy) -> Iterator[Finding]:
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


def check_parameters_of_others(checked_policy: CheckedPolicy) -> Iterator[Finding]:
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


def check_root_enclave(checked_policy: CheckedPolicy) -> Iterator[Finding]:
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


def duplicate_enclave_findings(enclaves: Iterable[Enclave]) -> Iterator[Finding]:
    """Yield a finding for each enclave that two policies state at different places."""
    stated: dict[str, Enclave] = {}
    for enclave in enclaves:
        earlier = stated.setdefault(enclave.path, enclave)
        if earlier.source != enclave.source:
            text = f"{enclave.path} is defined here and at {earlier.source}"
            yield IN_TWO_FILES.found(enclave.path, text, enclave.source.file, enclave.source.line)


def node_in_two_enclaves_findings(enclaves: Iterable[Enclave]) -> Iterator[Finding]:
    """Yield a finding for each node without wildcards in its name that several enclaves have."""
    for node, places in nodes_in_several_enclaves(enclaves).items():
        path, source = [*places.items()][1]
        text = f"the node {node} is in {first_few([*places], _NAMES_SHOWN)}"
        yield NODE_IN_TWO_ENCLAVES.found(path, text, source.file, source.line)
