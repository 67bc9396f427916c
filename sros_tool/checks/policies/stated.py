"""A policy made ready for checks: every right with its line, and what they add up to."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

from sros_tool.checks.kind import Finding, Kind
from sros_tool.names import expand
from sros_tool.policy.model import ALLOW, Enclave, Policy, Profile, Source
from sros_tool.policy.rights import Right, Rules, policy_rights


@dataclass(frozen=True, slots=True)
class Stated:
    """One right as one line of a policy states it; ``written`` is the name as it stands there."""

    right: Right
    written: str
    source: Source
    profile: Profile

    @property
    def allows(self) -> bool:
        """Whether it is an ALLOW."""
        return self.right.qualifier is ALLOW

    @property
    def name(self) -> str:
        """The absolute name."""
        return self.right.name

    def found(self, kind: Kind, text: str, remedy: str = "") -> Finding:
        """A finding of that kind about this line."""
        file, line = self.source.file, self.source.line
        return kind.found(self.right.enclave, text, file, line, remedy)


class CheckedPolicy:
    """A policy, its statements, and its rights in a form that can be asked."""

    def __init__(self, policy: Policy) -> None:
        self.policy = policy

    @cached_property
    def rules(self) -> Rules:
        """All rights and denials."""
        return Rules(policy_rights(self.policy))

    @cached_property
    def statements(self) -> tuple[Stated, ...]:
        """Every right and denial, in the order of the document."""
        return tuple(each for enclave in self.policy.enclaves for each in _statements(enclave))


def _statements(enclave: Enclave) -> Iterator[Stated]:
    for profile in enclave.all_profiles():
        for group in profile.groups:
            for index, written in enumerate(group.names):
                name = expand(written, profile.ns, profile.node)
                source = group.source_of(index)
                for right, qualifier in group.rights:
                    stated = Right(enclave.path, qualifier, right, name)
                    yield Stated(stated, written, source, profile)
