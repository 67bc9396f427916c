"""Sets of DDS domain ids, as governance and permissions documents list them."""

from __future__ import annotations

import re
from collections.abc import Collection, Iterable, Iterator
from dataclasses import dataclass
from itertools import pairwise

from sros_tool.errors import UsageError

MAX_DOMAIN = 230
"""Largest domain id that every vendor accepts: Cyclone DDS 0.10 refuses larger ids."""

_ID_OR_RANGE = re.compile(r"(\d{1,9})(?:-(\d{1,9}))?\Z", re.ASCII)


@dataclass(frozen=True, slots=True)
class DomainRange:
    """The domains from ``first`` to ``last``, both included.

    In documents that sros did not write, ``first`` or ``last`` may be missing (None); vendors read
    such a range differently.
    """

    first: int | None
    last: int | None

    def __contains__(self, domain: int) -> bool:
        return (self.first is None or self.first <= domain) and (
            self.last is None or domain <= self.last
        )

    def __str__(self) -> str:
        if self.first == self.last:
            return str(self.first)
        return (
            f"{'' if self.first is None else self.first}-{'' if self.last is None else self.last}"
        )


@dataclass(frozen=True, slots=True)
class DomainSet:
    """A set of domain ids, as ranges in the order of the document."""

    ranges: tuple[DomainRange, ...]

    @classmethod
    def parse(cls, text: str, source: str = "") -> DomainSet:
        """Return the domains in a text such as ``0``, ``0,7`` or ``3-5,9``, as sorted ranges.

        ``source`` names the origin of the text in errors.

        Raises:
            UsageError: the text is not a list of whole numbers from 0 to 230.
        """
        pairs = []
        for part in text.split(","):
            match = _ID_OR_RANGE.match(part)
            first = int(match[1]) if match else -1
            last = int(match[2]) if match and match[2] else first
            if not match or first > last or last > MAX_DOMAIN:
                raise UsageError(
                    f"{text!r}{source and f' ({source})'} is neither a domain id nor a list of "
                    "domain ids",
                    f"Domain ids are whole numbers from 0 to {MAX_DOMAIN}; some DDS vendors refuse "
                    "documents with larger numbers.",
                    "Write for example 0 or 0,7 or 10-19.",
                )
            pairs.append((first, last))
        return cls.of(*pairs)

    @classmethod
    def of(cls, *pairs: tuple[int, int]) -> DomainSet:
        """Return the set of these ranges, sorted, with overlapping and adjacent ranges joined."""
        joined: list[tuple[int, int]] = []
        for first, last in sorted(pairs):
            if joined and first <= joined[-1][1] + 1:
                joined[-1] = (joined[-1][0], max(last, joined[-1][1]))
            else:
                joined.append((first, last))
        return cls(tuple(DomainRange(first, last) for first, last in joined))

    def __contains__(self, domain: int) -> bool:
        return any(domain in part for part in self.ranges)

    def __iter__(self) -> Iterator[int]:
        """Yield every domain from 0 to 230 that is in the set."""
        domains: set[int] = set()
        for part in self.ranges:
            first = max(part.first or 0, 0)
            domains.update(
                range(first, 1 + (MAX_DOMAIN if part.last is None else min(part.last, MAX_DOMAIN)))
            )
        return iter(sorted(domains))

    def __str__(self) -> str:
        return ",".join(map(str, self.ranges))

    def closed(self) -> DomainSet:
        """Return the set without open ranges, sorted and joined.

        As in Fast DDS and Cyclone DDS, a range without a last domain has only its first domain, and
        a range without a first domain begins at 0.
        """
        pairs = []
        for part in self.ranges:
            first = 0 if part.first is None else part.first
            pairs.append((first, first if part.last is None else part.last))
        return DomainSet.of(*pairs)

    @classmethod
    def one_of_each_kind(
        cls, listed: Collection[DomainSet], other_sets: Iterable[DomainSet]
    ) -> tuple[int, ...]:
        """Return an example domain for each group of domains that are in the same sets, sorted.

        Only groups within the ``listed`` sets are included.  But if a range lacks an end, all
        groups are included, because vendors read such a range differently.
        """
        sets = dict.fromkeys((*listed, *other_sets))
        borders = {0}
        for part in (part for names in sets for part in names.ranges):
            borders |= {
                end + more for end in (part.first, part.last) if end is not None for more in (0, 1)
            }
        if any(part.first is None or part.last is None for names in sets for part in names.ranges):
            return tuple(sorted(borders))
        known = [
            border
            for border in sorted(borders)
            if any(border in domain_set for domain_set in listed)
        ]
        kinds = {
            tuple(domain in domain_set for domain_set in sets): domain for domain in reversed(known)
        }
        return tuple(sorted(kinds.values()))

    @classmethod
    def partition(cls, sets: Iterable[DomainSet]) -> tuple[DomainSet, ...]:
        """Return groups of domains that belong to the same ``sets`` (results of `closed`).

        So each set contains either all domains of a group or none of them.
        """
        ranges: dict[tuple[bool, ...], list[tuple[int, int]]] = {}
        known = tuple(dict.fromkeys(sets))
        if len(known) == 1:
            return known
        borders = {part.first or 0 for domain_set in known for part in domain_set.ranges}
        borders |= {(part.last or 0) + 1 for domain_set in known for part in domain_set.ranges}
        for first, after in pairwise(sorted(borders)):
            inside = tuple(first in domain_set for domain_set in known)
            if any(inside):
                ranges.setdefault(inside, []).append((first, after - 1))
        return tuple(cls.of(*pairs) for pairs in ranges.values())

    def __and__(self, other: DomainSet) -> DomainSet:
        """Return the domains that are in both closed sets."""
        common = (
            (max(left.first or 0, right.first or 0), min(left.last or 0, right.last or 0))
            for left in self.ranges
            for right in other.ranges
        )
        return DomainSet.of(*(pair for pair in common if pair[0] <= pair[1]))

    def preferred(self) -> int:
        """Return domain 0, the default of ROS, if it is in the set, or else the first domain."""
        return 0 if 0 in self else next(iter(self))

    def only(self) -> int | None:
        """Return the only domain of the set; None if the set has no domain, or several."""
        domains = list(self)
        return domains[0] if len(domains) == 1 else None
