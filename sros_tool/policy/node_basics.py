"""The rights that every node of ROS 2 needs to start, from ``defaults/node_basics.xml``."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable
from functools import cache

from sros_tool.files import policies_dir
from sros_tool.names import NODE_SERVICES, PARAMETER_SERVICES, is_expression
from sros_tool.policy.document import read_policy
from sros_tool.policy.model import ALLOW, Policy
from sros_tool.policy.patterns import Names
from sros_tool.policy.rights import Right, Rules, is_of_one_node, policy_rights, split_actions

_SERVICES_WITHOUT_PARAMETERS = {"get_type_description"}
"""The services of a node without parameters."""


@cache
def node_basics() -> Policy:
    """Return the policy with the rights that every node needs, in the enclave /."""
    return read_policy(policies_dir() / "defaults" / "node_basics.xml")


@cache
def _basics() -> Rules:
    return Rules(policy_rights(node_basics()))


class NodeRights:
    """The rights of some enclaves that their own nodes need to start.

    The services of a node count only if the enclave may serve all of them, and no other enclave may
    serve any of them.  The reason is that a process with such a right can pose as another enclave's
    node.  For the same reason, a right with a wildcard in place of the node does not count.
    """

    def __init__(self, rights: Iterable[Right]) -> None:
        served: defaultdict[tuple[str, str], set[str]] = defaultdict(set)
        enclaves: defaultdict[str, set[str]] = defaultdict(set)
        for right in split_actions(rights):
            if (right.qualifier, right.right) != (ALLOW, "reply"):
                continue
            node, _, service = right.name.rpartition("/")
            if service in NODE_SERVICES and is_of_one_node(right.name):
                served[right.enclave, node].add(service)
            enclaves[right.name].add(right.enclave)
        wild = Names(sorted(filter(is_expression, enclaves)))

        def is_alone(enclave: str, node: str, services: set[str]) -> bool:
            # Nodes without parameters, such as those of tf2_ros, can have the same name in many
            # processes.
            compared = (
                PARAMETER_SERVICES if services == _SERVICES_WITHOUT_PARAMETERS else NODE_SERVICES
            )
            names = {f"{node}/{service}" for service in compared}
            names |= {expression for name in [*names] for expression in wild.overlapping(name)}
            return all(enclaves.get(name, {enclave}) <= {enclave} for name in names)

        complete = (set(NODE_SERVICES), set(PARAMETER_SERVICES), _SERVICES_WITHOUT_PARAMETERS)
        self._own = {
            place
            for place, services in served.items()
            if services in complete and is_alone(*place, services)
        }

    def needs(self, right: Right) -> bool:
        """Return whether the nodes of the right's enclave need ``right`` to start."""
        node, _, service = right.name.rpartition("/")
        if right.qualifier is not ALLOW:
            return False
        if right.right == "reply":
            return service in NODE_SERVICES and (right.enclave, node) in self._own
        return _basics().cover(right._replace(enclave="/"))


def are_basic(rights: Iterable[Right]) -> bool:
    """Return whether an enclave without a policy has all ``rights``."""
    return all(_basics().cover(right._replace(enclave="/")) for right in rights)
