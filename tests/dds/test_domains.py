"""Sets of domain ids: reading them, joining them, and their XML."""

from __future__ import annotations

import re

import pytest
from hypothesis import given
from hypothesis import strategies as st
from lxml import etree

from sros_tool.dds.domains import MAX_DOMAIN, DomainRange, DomainSet
from sros_tool.dds.permissions import domain_lines, read_domains
from sros_tool.errors import DocumentError, UsageError

pairs = st.tuples(st.integers(0, MAX_DOMAIN), st.integers(0, MAX_DOMAIN)).map(
    lambda pair: (min(pair), max(pair))
)
some_pairs = st.lists(pairs, min_size=1, max_size=6)
GRAMMAR = re.compile(r"\d+(-\d+)?(,\d+(-\d+)?)*", re.ASCII)


def element(domains: DomainSet) -> etree._Element:
    return etree.fromstring("".join(domain_lines(domains)))


@given(some_pairs)
def test_text_and_xml_read_back(some: list[tuple[int, int]]) -> None:
    domains = DomainSet.of(*some)
    assert DomainSet.parse(str(domains)) == domains
    assert read_domains(element(domains)) == domains
    assert domains.closed() == domains


@given(some_pairs, st.randoms())
def test_the_order_and_the_overlaps_do_not_matter(
    some: list[tuple[int, int]], random: object
) -> None:
    ids = {domain for first, last in some for domain in range(first, last + 1)}
    domains = DomainSet.of(*some)
    assert set(domains) == ids
    assert DomainSet.of(*reversed(some)) == domains
    assert DomainSet.of(*((each, each) for each in ids)) == domains
    assert domains.only() == (ids.copy().pop() if len(ids) == 1 else None)
    assert all((domain in domains) == (domain in ids) for domain in range(-1, MAX_DOMAIN + 2))


@given(st.text(alphabet="0123456789,- ٣x", max_size=10) | st.text(max_size=5))
def test_any_text_is_domains_or_an_error(text: str) -> None:
    try:
        domains = DomainSet.parse(text)
    except UsageError:
        numbers = [int(each) for each in re.findall(r"\d+", text, re.ASCII)]
        assert not GRAMMAR.fullmatch(text) or max(numbers) > MAX_DOMAIN or "-" in text
    else:
        assert GRAMMAR.fullmatch(text)
        assert set(domains) <= set(range(MAX_DOMAIN + 1))
        assert set(domains)


@pytest.mark.parametrize(
    ("text", "domains"),
    [("0", "0"), ("0,1", "0-1"), ("1-3,2-5", "1-5"), ("7,0", "0,7"), ("230", "230"), ("1-1", "1")],
)
def test_ranges_are_joined(text: str, domains: str) -> None:
    assert str(DomainSet.parse(text)) == domains


@pytest.mark.parametrize(
    ("part", "means"),
    [
        (DomainRange(40, None), {40}),
        (DomainRange(None, 3), {0, 1, 2, 3}),
        (DomainRange(2, 3), {2, 3}),
    ],
)
def test_open_ranges_mean_what_fast_dds_makes_of_them(part: DomainRange, means: set[int]) -> None:
    assert set(DomainSet((part,)).closed()) == means


@pytest.mark.parametrize(
    "content",
    [
        "",
        "<id/>",
        "<id>-1</id>",
        "<id>a</id>",
        "<id>²</id>",
        "<id_range/>",
        "<x/>",
        "<id>1e1</id>",
        "<id>9999999999</id>",
        "<id_range><min>a</min></id_range>",
    ],
)
def test_xml_that_names_no_domain(content: str) -> None:
    with pytest.raises(DocumentError):
        read_domains(etree.fromstring(f"<domains>{content}</domains>"))
