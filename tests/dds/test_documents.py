"""Governance and permissions documents: what is written reads back, whatever the texts in it."""

from __future__ import annotations

import re
import string
from base64 import b64encode
from pathlib import Path
from random import Random
from typing import Any
from xml.sax import saxutils

import pytest
from hypothesis import given
from hypothesis import strategies as st
from lxml import etree

from sros_tool.dds.decision import cyclone, fastdds
from sros_tool.dds.decision.documents import canonical_governance, read_governance_as
from sros_tool.dds.decision.vendors import Vendor
from sros_tool.dds.domains import MAX_DOMAIN, DomainSet
from sros_tool.dds.governance import (
    DomainRule,
    Governance,
    ProtectionKind,
    TopicRule,
    attribute_values,
    attributes,
    parse_governance,
    render_governance,
)
from sros_tool.dds.permissions import (
    LARGE_BYTES,
    Criteria,
    Grant,
    Permissions,
    Rule,
    parse_permissions,
    render_permissions,
)
from sros_tool.errors import DocumentError
from sros_tool.xml import escape, quoted
from tests.dds.decision_documents import allow, grant, publish
from tests.dds.decision_documents import governance as decided_governance
from tests.dds.decision_documents import permissions as decided
from tests.support.children import python

domains = st.lists(st.integers(0, MAX_DOMAIN), min_size=1, max_size=4).map(
    lambda ids: DomainSet.of(*((each, each) for each in ids))
)
# Everything that XML sets apart, and letters of other alphabets.
texts = st.text(
    alphabet=string.ascii_letters + "/_*?[]!-&<>\"' =,{}%é中😀", min_size=1, max_size=12
)
lists = st.lists(texts, min_size=1, max_size=3).map(tuple)
none_or_some = st.lists(texts, max_size=2).map(tuple)
# Hypothesis draws also those fields of a named tuple that have a default and are not given.
criteria = st.lists(st.builds(Criteria, lists, none_or_some, st.just(())), max_size=2).map(tuple)
tagged = st.builds(
    Criteria, lists, none_or_some, st.lists(st.tuples(texts, texts), max_size=2).map(tuple)
)
relayed = st.lists(tagged, max_size=1).map(tuple)
rules = st.lists(
    st.builds(Rule, st.booleans(), domains, criteria, criteria, relayed, order=st.just(())),
    max_size=3,
)
dates = st.sampled_from(
    ["2024-01-01T00:00:00Z", "2034-01-01T00:00:00", "2034-01-01T00:00:00+09:00"]
)
never = st.just(False)
grants = st.builds(Grant, texts, texts, dates, dates, rules.map(tuple), st.booleans(), never, never)
permissions = st.lists(grants, min_size=1, max_size=2).map(lambda each: Permissions(tuple(each)))


def value_strategies(rule: type[DomainRule | TopicRule]) -> dict[str, st.SearchStrategy[object]]:
    return {each.name: st.sampled_from(each.values) for each in attributes(rule)}


topic_rules = st.builds(
    TopicRule,
    topic_expression=texts.filter(lambda text: text == text.strip()),
    **value_strategies(TopicRule),
)
domain_rules = st.builds(
    DomainRule,
    domains=domains,
    topic_access_rules=st.lists(topic_rules, min_size=1, max_size=4).map(tuple),
    **value_strategies(DomainRule),
)
governances = st.lists(domain_rules, min_size=1, max_size=2).map(
    lambda each: Governance(tuple(each))
)


def schema(name: str) -> etree.XMLSchema:
    path = Path(__file__).parents[1] / "schemas" / f"{name}.xsd"
    return etree.XMLSchema(etree.parse(path, etree.XMLParser(no_network=True)))


PERMISSIONS, GOVERNANCE = schema("dds_permissions"), schema("dds_governance")


@given(permissions)
def test_permissions_read_back(meant: Permissions) -> None:
    document = render_permissions(meant)
    assert parse_permissions(document) == meant
    assert parse_permissions(document.replace(b"\n", b"\r\n")) == meant
    if all(grant.rules for grant in meant.grants):
        PERMISSIONS.assertValid(etree.fromstring(document))


@given(governances)
def test_governance_reads_back(meant: Governance) -> None:
    document = render_governance(meant)
    assert parse_governance(document) == meant
    assert parse_governance(document.replace(b"\n", b"\r\n")) == meant
    GOVERNANCE.assertValid(etree.fromstring(document))


GRANT = Grant(
    "/a",
    "CN=/a",
    "2024-01-01T00:00:00Z",
    "2034-01-01T00:00:00Z",
    (Rule(True, DomainSet.of((0, 0)), (Criteria(("rt/x",)),)),),
)
GOOD = render_permissions(Permissions((GRANT,))).decode()


@pytest.mark.parametrize(
    ("old", "new"),
    [
        (r"(</?)dds\b", r"\1sdd"),
        (r"(</?)permissions\b", r"\1governance"),
        (r"(</?)grant\b", r"\1grunt"),
        (r"(</?)allow_rule\b", r"\1allow"),
        (r"(</?)publish\b", r"\1write"),
        (r"(</?)topics\b", r"\1topic_list"),
        (r"(</?)domains\b", r"\1domain"),
        (r"<subject_name>.*", ""),
        (r"<not_after>.*", ""),
        (r"2034-01-01T00:00:00Z", "tomorrow"),
        (r"2034-01-01T00:00:00Z", "9999-12-31T23:59:59-14:00"),
        (r"<default>.*", ""),
        (r"DENY", "deny"),
        (r"<topic>.*", ""),
        (r"<id>.*", ""),
        (r"</dds>", ""),
        (r"<dds", "<!DOCTYPE dds><dds"),
    ],
)
def test_permissions_that_are_none(old: str, new: str) -> None:
    assert parse_permissions(GOOD.encode()) == Permissions((GRANT,))
    broken = re.sub(old, new, GOOD)
    assert broken != GOOD
    with pytest.raises(DocumentError):
        parse_permissions(broken.encode())


@given(st.binary(max_size=80) | texts.map(str.encode))
def test_any_bytes_are_a_document_or_an_error(data: bytes) -> None:
    for parse in (parse_permissions, parse_governance):
        with pytest.raises(DocumentError):
            parse(data)


def test_governance_with_something_else_in_place_of_a_topic_rule() -> None:
    """Both vendors refuse it."""
    rule = TopicRule("*", True, True, True, True, ProtectionKind.NONE, ProtectionKind.NONE)
    kinds = (ProtectionKind.NONE,) * 3
    domain = DomainRule(DomainSet.of((0, 0)), False, True, *kinds, (rule,))
    good = render_governance(Governance((domain,)))
    assert parse_governance(good)
    with pytest.raises(DocumentError, match="topic_role"):
        parse_governance(good.replace(b"topic_rule>", b"topic_role>"))


@pytest.mark.parametrize("rule", [DomainRule, TopicRule])
def test_each_attribute_can_have_the_values_that_it_declares(
    rule: type[DomainRule | TopicRule],
) -> None:
    for each in attributes(rule):
        assert {each.open, each.portable} <= set(each.values)
        assert each.open != each.portable
        assert each.default is None or each.default in each.values


def utf_7(text: str) -> str:
    """Return text so that only UTF-7 reads it; for others, it has no markup."""
    return f"+{b64encode(text.encode('utf-16-be')).decode().rstrip('=')}-"


def test_a_document_with_other_rights_in_another_encoding_is_refused() -> None:
    """Vendors pass over the encoding: what they read is a comment to lxml, and the reverse."""
    narrow, wide = (allow(publish(topic), domains="<id>0</id>") for topic in ("rt/x", "*"))
    end = "<default>DENY</default></grant>"
    hidden = f"<!-- {utf_7('-->')}{narrow}{utf_7('<!--')} +AGE-->{wide}{end}"
    hidden += f'<grant name="{utf_7(f"-->{end}<grant name=" + chr(34))}">'
    _, _, rest = grant(narrow).partition(">")
    text = grant(hidden, default="").removesuffix("</grant>") + rest
    document = decided(text).replace(b"UTF-8", b"UTF-7")
    for read in (fastdds.read_permissions, cyclone.read_permissions):
        assert [rule.publish[0].topics for rule in read(document).grants[0].rules] == [("*",)]
    assert b">rt/x<" in etree.tostring(etree.fromstring(document)[0][0])  # as other readers do
    with pytest.raises(DocumentError, match=r"is not in UTF-8.*the encoding UTF-7"):
        parse_permissions(document)


@pytest.mark.parametrize("encoding", ["UTF-7", "ISO-8859-1", "UTF-16"])
def test_only_utf_8_is_read(encoding: str) -> None:
    def declared(document: bytes, name: str) -> bytes:
        assert b'encoding="UTF-8"' in document
        return document.decode().replace("UTF-8", name).encode(name)

    for document, read in (
        (decided(grant(allow(publish("rt/x")))), parse_permissions),
        (decided_governance(), parse_governance),
    ):
        with pytest.raises(DocumentError, match="is not in UTF-8"):
            read(declared(document, encoding))
        for name in ("utf-8", "us-ascii"):
            assert read(declared(document, name)) == read(document)


@pytest.mark.parametrize("missing", [1, 0])
def test_a_large_document_is_not_indented(missing: int) -> None:
    """It says the same in fewer bytes, so that more fits below the limit of Fast DDS 2.9."""
    names = tuple(f"rt/name_{number}" for number in range(1200))
    small = document_of(names)
    room = LARGE_BYTES - len(small.replace(b"\n", b"\r\n")) - missing
    assert room > 0
    made = document_of((*names[:-1], names[-1] + "n" * room))
    assert (b"\n    <grant" in made) is bool(missing)
    assert (len(made.replace(b"\n", b"\r\n")) == LARGE_BYTES - 1) is bool(missing)
    assert bool(re.search(rb"\n ", made)) is bool(missing)
    (grant,) = parse_permissions(made).grants
    assert len(grant.rules[0].publish[0].topics) == 1200


def document_of(topics: tuple[str, ...]) -> bytes:
    rule = Rule(True, DomainSet.of((0, 0)), (Criteria(topics),))
    date = "2026-01-01T00:00:00Z"
    return render_permissions(Permissions((Grant("/a", "CN=/a", date, date, (rule,)),)))


@given(st.text(st.sampled_from("a&<>\"'\n\r\t;é\u2028")))
def test_texts_are_written_as_the_standard_library_writes_them(text: str) -> None:
    assert escape(text) == saxutils.escape(text)
    assert quoted(text) == saxutils.quoteattr(text)


def test_a_node_starts_without_what_it_does_not_need() -> None:
    """A demo starts dozens of them."""
    words = "import sys, sros_tool.demo.cyclone_node; print(*sys.modules)"
    found = python("-c", words).stdout.split()
    assert "sros_tool.names" in found
    heavy = {"http.client", "ssl", "urllib.request", "uuid", "lxml.etree", "sros_tool.translate"}
    assert heavy.isdisjoint(found)


# ── documents that all vendors read alike ──────────────────────────────────────────────────

_DRAWN = 40
_EXPRESSIONS = ("*", "rt/chatter", "rq/*Request", "rr/a/bReply", "rt/[ab]?", "ros_discovery_info")


def _drawn(random: Random, rule: type[DomainRule | TopicRule]) -> dict[str, Any]:
    return {each.name: random.choice(each.values) for each in attributes(rule)}


def drawn_governance(random: Random) -> Governance:
    rules = []
    for _ in range(random.randint(1, 3)):
        first = random.randint(0, 200)
        topics = tuple(
            TopicRule(topic_expression=random.choice(_EXPRESSIONS), **_drawn(random, TopicRule))
            for _ in range(random.randint(1, 4))
        )
        domains = DomainSet.of((first, first + random.choice((0, 3, 30))), (0, 0))
        rules.append(
            DomainRule(domains=domains, topic_access_rules=topics, **_drawn(random, DomainRule))
        )
    return Governance(tuple(rules))


@pytest.mark.parametrize("seed", range(_DRAWN))
def test_every_vendor_reads_what_sros_writes_alike(seed: int) -> None:
    governance = drawn_governance(Random(seed))
    document = render_governance(governance)
    assert canonical_governance(document) == governance
    assert canonical_governance(document.replace(b"\n", b"\r\n")) == governance
    for vendor in Vendor:
        assert read_governance_as(vendor, document) == governance


@pytest.mark.parametrize(
    ("old", "new"),
    [
        (b"<topic_rule>", b"<!-- odd --><topic_rule>"),
        (b"</id>", b" </id>"),
        (b"true<", b"1<"),
        (b"<topic_expression>*<", b"<topic_expression> *<"),
        (b"<topic_expression>*<", b"<topic_expression><"),
        (b"<topic_expression>*<", b"<topic_expression>a&amp;b<"),
        (b"<id>0</id>", b"<id_range><min>0</min></id_range>"),
        (b"<id>0</id>", b"<id>231</id>"),
    ],
)
def test_a_document_that_vendors_may_read_in_their_own_ways_is_left_to_them(
    old: bytes, new: bytes
) -> None:
    plain = attribute_values(TopicRule, protect=True)
    rule = DomainRule(
        domains=DomainSet.of((0, 0)),
        topic_access_rules=(TopicRule(topic_expression="*", **plain),),
        **attribute_values(DomainRule, protect=True),
    )
    document = render_governance(Governance((rule,)))
    assert canonical_governance(document)
    assert old in document
    assert canonical_governance(document.replace(old, new)) is None
