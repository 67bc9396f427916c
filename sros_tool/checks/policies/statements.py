"""A policy as the checks see it: statements in their lines, and rights that can be queried."""

from __future__ import annotations

import re
from dataclasses import dataclass
from functools import cached_property

from sros_tool.checks.kind import Finding, FindingKind
from sros_tool.errors import SrosError
from sros_tool.names import expand
from sros_tool.policy.model import ALLOW, Policy, Profile, Source
from sros_tool.policy.rights import Right, Rules, placed_rights, policy_rights


@dataclass(frozen=True, slots=True)
class PolicyStatement:
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


class CheckedPolicy:
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
    def statements(self) -> tuple[PolicyStatement, ...]:
        """All rights and denials, in the order of the policy file."""
        return tuple(
            PolicyStatement(placed.right, placed.written, placed.source, placed.profile)
            for enclave in self.policy.enclaves
            for placed in placed_rights(enclave)
        )


_PLACED_ERROR = re.compile(r"(?P<file>.+?):(?P<line>\d+): (?P<text>.*)", re.DOTALL)


def split_place(error: SrosError) -> tuple[str, int, str]:
    """Return the file and line that an error begins with ("" and 0 without them), and the rest."""
    match = _PLACED_ERROR.match(error.what)
    return (match["file"], int(match["line"]), match["text"]) if match else ("", 0, error.what)
