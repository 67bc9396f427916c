"""The rights that every node of ROS 2 needs to start, from ``defaults/node_basics.xml``."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Iterable
from functools import cache

from sros_tool.files import policies_dir
from sros_tool.names import PARAMETER_SERVICES, is_expression
from sros_tool.policy.document import read_policy
from sros_tool.policy.model import ALLOW, Policy
from sros_tool.policy.rights import Right, Rules, policy_rights, unfolded


@cache
def node_basics() -> Policy:
    """Return the policy with the rights that every node needs, in the enclave /."""
    return read_policy(policies_dir() / "defaults" / "node_basics.xml")


@cache
def _basics() -> Rules:
    return Rules(policy_rights(node_basics()))


class NodeRights:
    """Which of the rights of some enclaves are those that their own nodes need to start.

    The parameter services of a node count only if the enclave may serve all of them, and no other
    enclave may: a right to serve those of another enclave's node lets a process pose as that node.
    """

    def __init__(self, rights: Iterable[Right]) -> None:
        served: defaultdict[tuple[str, str], set[str]] = defaultdict(set)
        for right in unfolded(rights):
            node, _, service = right.name.rpartition("/")
            if (right.qualifier, right.right) == (ALLOW, "reply") and service in PARAMETER_SERVICES:
                served[right.enclave, node].add(service)
        nodes = [
            place for place, services in served.items() if len(services) == len(PARAMETER_SERVICES)
        ]
        enclaves = Counter(node for _, node in nodes)
        self._own = {
            (enclave, node) for enclave, node in nodes if is_expression(node) or enclaves[node] == 1
        }

    def needs(self, right: Right) -> bool:
        """Return whether a right is one that the nodes of its enclave need to start."""
        node, _, service = right.name.rpartition("/")
        if right.right == "reply" and service in PARAMETER_SERVICES:
            return (right.enclave, node) in self._own
        return _basics().cover(right._replace(enclave="/"))


def are_basic(rights: Iterable[Right]) -> bool:
    """Return whether rights are among those that an enclave without a policy has."""
    return all(_basics().cover(right._replace(enclave="/")) for right in rights)
