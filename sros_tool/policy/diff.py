"""Compares two sets of rights, whatever documents they come from."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

from sros_tool.policy.rights import Right, Rules, folded, order


@dataclass(frozen=True, slots=True)
class Difference:
    """The rights that only one side has, in normal form and sorted.

    ``covered`` tells for some of them by which wildcards the other side has them all the same.
    """

    only_first: tuple[Right, ...]
    only_second: tuple[Right, ...]
    covered: Mapping[Right, tuple[Right, ...]]

    def __bool__(self) -> bool:
        return bool(self.only_first or self.only_second)

    def lines(self) -> list[tuple[str, Right]]:
        """Every difference with its sign, "-" for the first side, in the order of telling."""
        found = [("-", each) for each in self.only_first] + [("+", e) for e in self.only_second]
        return sorted(found, key=lambda line: (*order(line[1]), line[0] == "+"))


def compare(
    first: Iterable[Right], second: Iterable[Right], scope: frozenset[str] | None = None
) -> Difference:
    """How two sets of rights differ, within the enclaves of ``scope`` (None: all).

    The difference is empty just if both allow and deny the same, with actions taken for the
    services and topics that they consist of.
    """
    one, other = (
        folded(each for each in side if scope is None or each.enclave in scope)
        for side in (first, second)
    )
    only_first = tuple(sorted(one - other, key=order))
    only_second = tuple(sorted(other - one, key=order))
    covered: dict[Right, tuple[Right, ...]] = {}
    for rights, side in ((only_first, other), (only_second, one)):
        rules = Rules(side if rights else ())
        for right in rights:
            if by := rules.covering(right):
                covered[right] = tuple(sorted(folded(by), key=order))
    return Difference(only_first, only_second, covered)
