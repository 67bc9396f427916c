"""The ``<domains>`` element of governance and permissions documents."""

from __future__ import annotations

from lxml import etree

from sros_tool.dds.domains import DomainRange, DomainSet
from sros_tool.errors import DocumentError
from sros_tool.xml import tag_of


def domain_lines(domains: DomainSet) -> list[str]:
    """Return the ``<domains>`` element, a line each: ids alone, ranges with both ends."""
    lines = ["<domains>"]
    for part in domains.ranges:
        if part.first == part.last:
            lines.append(f"  <id>{part.first}</id>")
            continue
        low = "" if part.first is None else f"<min>{part.first}</min>"
        high = "" if part.last is None else f"<max>{part.last}</max>"
        lines.append(f"  <id_range>{low}{high}</id_range>")
    return [*lines, "</domains>"]


def read_domains(element: etree._Element) -> DomainSet:
    """Read a ``<domains>`` element without sorting or joining its ranges."""
    ranges = []
    for child in element:
        if child.tag == "id":
            domain = _number(child)
            ranges.append(DomainRange(domain, domain))
        elif child.tag == "id_range":
            low, high = child.find("min"), child.find("max")
            if low is None and high is None:
                raise DocumentError("an <id_range> has neither <min> nor <max>")
            ranges.append(
                DomainRange(
                    None if low is None else _number(low), None if high is None else _number(high)
                )
            )
        else:
            raise DocumentError(f"<domains> holds an unknown element <{tag_of(child)}>")
    if not ranges:
        raise DocumentError("<domains> names no domain")
    return DomainSet(tuple(ranges))


def _number(element: etree._Element) -> int:
    text = (element.text or "").strip()
    if not (text.isascii() and text.isdigit() and len(text) < 10):
        raise DocumentError(f"<{tag_of(element)}> holds {text!r}, which is not a domain id")
    return int(text)
