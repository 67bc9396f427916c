"""Where rights are stated: the lines of a policy, or the permissions of an enclave."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping

from sros_tool.dataclass import dataclass
from sros_tool.dds.decision.matching import matches
from sros_tool.dds.decision.vendors import Style
from sros_tool.names import is_expression
from sros_tool.policy.model import ALLOW, Enclave, Policy, Source
from sros_tool.policy.rights import Right, placed_rights
from sros_tool.proof.decide import Use


@dataclass(frozen=True, slots=True)
class Place:
    """A right as it is stated somewhere; without a line, in the permissions of an enclave."""

    right: Right
    source: Source


class Places:
    """Where rights are stated, to find the one that lets an enclave use a topic."""

    def __init__(self, stated: Mapping[str, Iterable[Place]]) -> None:
        """Take the rights of each enclave."""
        self._stated = stated
        self._by_enclave: dict[str, list[tuple[bool, str, Place]]] = {}

    @classmethod
    def of_policy(cls, policy: Policy) -> Places:
        """Return the places in a policy, with their lines."""
        return cls({each.path: _Lazy(each) for each in policy.enclaves})

    def find(self, use: Use) -> Place | None:
        """Return the right that states a use: one without wildcards if there is one."""
        topics = self._by_enclave.get(use.enclave)
        if topics is None:
            found = self._stated.get(use.enclave, ())
            topics = self._by_enclave[use.enclave] = [
                (*topic, place) for place in found for topic in topics_of(place.right)
            ]
        best = None
        for writes, topic, place in topics:
            if writes is not use.writes:
                continue
            if topic == use.topic:
                return place
            if best is None and is_expression(topic) and matches(Style.FNMATCH, topic, use.topic):
                best = place
        return best


class _Lazy:
    """The rights that an enclave of a policy is allowed, each time they are asked for."""

    def __init__(self, enclave: Enclave) -> None:
        self._enclave = enclave

    def __iter__(self) -> Iterator[Place]:
        for placed in placed_rights(self._enclave):
            if placed.right.qualifier is ALLOW:
                yield Place(placed.right, placed.source)


def topics_of(right: Right) -> Iterator[tuple[bool, str]]:
    """Yield the DDS topics of a right, with True for those that it writes."""
    written, read = right.topics
    yield from ((True, topic) for topic in written)
    yield from ((False, topic) for topic in read)
