"""Whether a domain is in a set of ranges, as each vendor reads ranges with an open end."""

from __future__ import annotations

from sros_tool.dds.decision.vendors import OpenRange
from sros_tool.dds.domains import DomainSet


def holds_for(rule: OpenRange, domains: DomainSet, domain: int) -> bool | None:
    """Whether ``domain`` is in ``domains``; None if the vendor crashes over the answer."""
    for part in domains.ranges:
        first, last = part.first, part.last
        if first is None:
            if rule is OpenRange.CRASHES:
                return None
            first = 0
        if last is None:
            last = first if rule is not OpenRange.OPEN else domain
        elif last == 0 and rule is OpenRange.SINGLE:
            last = first  # Fast DDS keeps 0 for "no upper end"
        if first <= domain <= last:
            return True
    return False
