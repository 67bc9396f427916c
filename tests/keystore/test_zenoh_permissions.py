"""Permissions that other programs wrote give no more on Zenoh than with any DDS vendor."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from datetime import UTC, datetime
from functools import cache
from itertools import product
from random import Random

import pytest

from sros_tool.dds.decision.access import Access, AccessVerb, GovernedDomain
from sros_tool.dds.decision.vendors import TESTED, Vendor
from sros_tool.dds.domains import DomainRange, DomainSet
from sros_tool.dds.governance import parse_governance
from sros_tool.dds.permissions import Criteria, Grant, Permissions, Rule
from sros_tool.errors import DocumentError, PolicyError
from sros_tool.keystore.zenoh_permissions import grant_for_all_vendors, rights_in_domain
from sros_tool.names import dds_names
from sros_tool.translate_zenoh.rights import remote_of
from sros_tool.zenoh.access import AccessControl, Flow, Message
from tests.dds.decision_documents import (
    allow,
    criteria,
    deny,
    governance,
    grant,
    permissions,
    publish,
    topic_rule,
)
from tests.support.children import LONG

ZERO = DomainSet.of((0, 0))
TYPE = "std_msgs::msg::dds_::String_/RIHS01_00"
VENDORS = (*TESTED, Vendor.CONNEXT)
USES = {
    "publish": (Flow.INGRESS, Message.PUT), "subscribe": (Flow.EGRESS, Message.PUT),
    "request": (Flow.INGRESS, Message.QUERY), "reply": (Flow.EGRESS, Message.QUERY),
}  # fmt: skip
NO_AGREEMENT = "because DDS vendors do not decide alike"
ORDER = "because the order of the rules matters"


def rule(qualifier: str, topic: str, *partitions: str, domains: DomainSet = ZERO) -> Rule:
    return Rule(qualifier == "allow", domains, publish=(Criteria((topic,), partitions),))


def granted(*rules: Rule) -> Grant:
    return Grant("g", "CN=/t", "2020-01-01T00:00:00Z", "2040-01-01T00:00:00Z", rules)


@pytest.mark.parametrize(
    ("rules", "names"),
    [
        ([rule("deny", "rt/a"), rule("allow", "rt/*")], ["/*", "not /a"]),
        ([rule("allow", "rt/*"), rule("deny", "rt/a")], ["/*"]),
        ([rule("allow", "rt/b"), rule("deny", "rt/*"), rule("allow", "rt/a")], ["/b"]),
        ([rule("allow", "rt/a", "p"), rule("allow", "rt/b")], ["/b"]),
        ([rule("allow", "rt/a", "p", "")], ["/a"]),
        ([rule("allow", "rt/a", "*")], ["/a"]),
        ([rule("deny", "rt/a", "p"), rule("allow", "rt/b")], ["/b"]),
        ([rule("allow", "rt/a", domains=DomainSet.of((0, 3)))], ["/a"]),
        ([rule("allow", "rt/a"), rule("deny", "rt/b", domains=DomainSet.of((7, 7)))], ["/a"]),
    ],
)
def test_what_every_vendor_decides_is_said(rules: list[Rule], names: list[str]) -> None:
    stated = [each.right for each in rights_in_domain("/t", granted(*rules), 0)]
    said = [f"{'' if each.qualifier == 'ALLOW' else 'not '}{each.name}" for each in stated]
    assert said == names


@pytest.mark.parametrize(
    ("rules", "text"),
    [
        (
            [rule("allow", "rt/a", "p"), rule("allow", "rt/*")],
            f"publish rt/a cannot be expressed in Zenoh, {NO_AGREEMENT}. Rule 1 names rt/a, but "
            "not the partitions of publish rt/a (Fast DDS); rule 2 allows",
        ),
        ([rule("deny", "rt/a", "p"), rule("allow", "rt/*")], NO_AGREEMENT),
        ([rule("deny", "rt/a", "p"), rule("allow", "rt/*", "p", "")], NO_AGREEMENT),
        (
            [rule("deny", "rt/a", domains=DomainSet.of((7, 7))), rule("allow", "rt/a")],
            f"{NO_AGREEMENT}. Rule 1 denies publish rt/a by rt/a (Fast DDS",
        ),
        (
            [
                rule("deny", "rt/a", domains=DomainSet((DomainRange(7, None),))),
                rule("allow", "rt/*", domains=DomainSet.of((0, 9))),
            ],
            NO_AGREEMENT,
        ),
        ([rule("deny", "rt/[^a]"), rule("allow", "rt/*")], NO_AGREEMENT),
        ([rule("deny", "rt/a "), rule("allow", "rt/*")], NO_AGREEMENT),
        (
            [
                rule("allow", "rt/[^a]", domains=DomainSet.of((0, 9)))._replace(
                    publish=(Criteria(("rt/[^a]",), ("p", "")), Criteria(("rt/*",), ("p",)))
                ),
                rule("allow", "rt/a*", "*", domains=DomainSet((DomainRange(0, None),))),
            ],
            "publish rt/a cannot be expressed in Zenoh, because DDS vendors do not read the "
            "rules alike. Rule 1 allows publish rt/a by rt/* (Fast DDS); rule 1 allows",
        ),
        (
            [rule("allow", "rt/c/a"), rule("deny", "rt/c/*"), rule("allow", "rt/*")],
            f"publish rt/c/a cannot be expressed in Zenoh, {ORDER}. On DDS, rule 1 allows publish "
            "rt/c/a by rt/c/a, and rule 2 comes too late to deny it.",
        ),
        ([rule("deny", "*"), rule("allow", "*")], "publish DDS topic * cannot be expressed"),
    ],
)
def test_what_vendors_or_the_order_decide_is_refused_with_the_rule(
    rules: list[Rule], text: str
) -> None:
    domain = 8 if any(None in (part.last for part in each.domains.ranges) for each in rules) else 0
    subscribing = rule("allow", "*").publish
    both = [each._replace(subscribe=subscribing if each.allow else ()) for each in rules]
    for some in (rules, both) if "*" in text else (rules,):
        with pytest.raises(PolicyError) as refused:
            rights_in_domain("/t", granted(*some), domain)
        assert "the permissions of /t: " in str(refused.value) and text in str(refused.value)


# ── drawn permissions ──────────────────────────────────────────────────────────────────────

TOPICS = ["rt/a", "rt/b", "rt/ab", "rt/a/b", "rt/a*", "rt/*", "rt*", "rt/?b", "rt/[ab]"]
ODD = ["rt/[^a]", "rt/a ", "*", "rq/aRequest", "rr/aReply"]
DOMAINS = [DomainSet.of((0, 7)), DomainSet.of((0, 0), (7, 7)), DomainSet.of((0, 0))]
ODD_DOMAINS = [DomainRange(0, None), DomainRange(None, 5), DomainRange(5, None), DomainRange(3, 0)]


def drawn_grant(draw: Random) -> Grant:
    """Rules in any order; in some grants with whatever vendors may read differently."""
    odd = draw.random() < 0.5
    rules = []
    for _ in range(draw.randint(1, 4)):
        both = [[*drawn_criteria(draw, odd)], [*drawn_criteria(draw, odd)]]
        if draw.random() < 0.5:
            service = draw.choice(("/a", "/b", "/*", "/a*"))
            ends = draw.sample((f"rq{service}Request", f"rr{service}Reply"), 2)
            for all_criteria, end in zip(both, ends, strict=True):
                all_criteria.append(Criteria((end,)))
        relay = drawn_criteria(draw, odd)[:1] if odd and draw.random() < 0.2 else []
        domains = draw.choice(DOMAINS) if odd else DOMAINS[0]
        if odd and draw.random() < 0.1:
            domains = DomainSet((draw.choice(ODD_DOMAINS),))
        out, into, through = map(tuple, (*both, relay))
        rules.append(Rule(draw.random() < 0.65, domains, out, into, through))
    return granted(*rules)._replace(default_allow=odd and draw.random() < 0.05)


def drawn_criteria(draw: Random, odd: bool) -> list[Criteria]:
    drawn = []
    for _ in range(draw.randint(0, 2)):
        topics = tuple(draw.sample(TOPICS, draw.randint(1, 2)))
        if odd and draw.random() < 0.2:
            topics += (draw.choice(ODD),)
        partitions = draw.choice(((), ("p",), ("*",), ("",), ("p", ""))) if odd else ()
        drawn.append(Criteria(topics, partitions, draw.choice(((), (("tag", "x"),)))))
    return drawn


@cache
def governed(vendor: Vendor, verb: AccessVerb, domain: int) -> GovernedDomain:
    """Joining and one direction are controlled: a topic needs no right of the other direction."""
    range_ = "<id_range><min>0</min><max>230</max></id_range>"
    document = parse_governance(governance(topic_rule("*"), domains=range_))
    (domain_rule,) = document.domain_access_rules
    (of_all,) = domain_rule.topic_access_rules
    of_all = replace(
        of_all,
        enable_write_access_control=verb is AccessVerb.PUBLISH,
        enable_read_access_control=verb is AccessVerb.SUBSCRIBE,
    )
    domain_rule = replace(domain_rule, topic_access_rules=(of_all,))
    return GovernedDomain(vendor, document._replace(domain_access_rules=(domain_rule,)), domain)


def on_dds(vendor: Vendor, document: Permissions, domain: int) -> dict[tuple[str, str], bool]:
    """Return whether the vendor lets the enclave use each right to each name."""
    access = {
        verb: Access(
            governed(vendor, verb, domain),
            document,
            "CN=/t",
            moment=datetime(2027, 1, 1, tzinfo=UTC),
        )
        for verb in (AccessVerb.PUBLISH, AccessVerb.SUBSCRIBE)
    }

    def all_ok(verb: AccessVerb, topics: Sequence[str]) -> bool:
        return all(access[verb].decide(verb, topic).outcome.ok for topic in topics)

    allowed = {}
    for right, name in product(USES, NAMES):
        names = dds_names(right, name)
        allowed[right, name] = all_ok(AccessVerb.PUBLISH, names.publish) and all_ok(
            AccessVerb.SUBSCRIBE, names.subscribe
        )
    return allowed


NAMES = ["/a", "/b", "/ab", "/a/b", "/c", "/cb"]


def test_drawn_permissions_give_exactly_what_each_vendor_gives_or_an_error() -> None:
    draw, count = Random(32), 3000 if LONG else 12
    translated = refused = 0
    for _ in range(count):
        drawn = drawn_grant(draw)
        for domain in (0, 7):
            if domain not in drawn.domains():
                continue
            try:
                stated = rights_in_domain("/t", drawn, domain)
                control = AccessControl((remote_of("/t", {domain: stated}),))
            except PolicyError:
                refused += 1
                continue
            translated += 1
            for vendor in VENDORS:
                meant = on_dds(vendor, Permissions((drawn,)), domain)
                said = {
                    (right, name): control.allows("/t", *USES[right], f"{domain}{name}/{TYPE}")
                    for right, name in meant
                }
                assert said == meant, (vendor, domain, drawn)
    assert translated > count / 2 and refused > count / 5


# ── documents ──────────────────────────────────────────────────────────────────────────────

OWN = allow(criteria("publish", "rt/a"))
OTHERS = allow(criteria("publish", "rt/secret"))


@pytest.mark.parametrize(
    "document",
    [
        permissions(grant(OWN, subject="CN=/t")),
        permissions(grant(OTHERS, subject="CN=/u"), grant(OWN, subject="CN=/t")),
        permissions(grant(OWN, subject="CN=/t"), grant(OTHERS, subject="CN=/t")),
        permissions(grant(deny(publish("rt/b")), OWN, subject="CN=/t")).replace(b"\n", b"\n  "),
    ],
)
def test_the_grant_that_every_vendor_takes(document: bytes) -> None:
    taken = grant_for_all_vendors(document, "the permissions of /t", "CN=/t")
    assert taken and taken.rules[-1].publish == (Criteria(("rt/a",)),)


@pytest.mark.parametrize(
    ("document", "text"),
    [
        # Cyclone DDS takes a grant whose subject has all attributes of the certificate's.
        (
            permissions(grant(OTHERS, subject="CN=/t,O=x"), grant(OWN, subject="CN=/t")),
            "are not the same for every DDS vendor: Cyclone DDS 0.10 uses other rules",
        ),
        (
            permissions(grant(OTHERS, subject=" CN=/t"), grant(OWN, subject="CN=/t")),
            "are not the same for every DDS vendor: Fast DDS 2.14 uses other rules",
        ),
        (
            permissions(grant(OWN, OTHERS, subject="CN=/t")).replace(
                b"rt/secret", b"rt/<!-- -->secret"
            ),
            "are not the same for every DDS vendor: Fast DDS 2.14 uses other rules",
        ),
        (
            permissions(grant(OWN, subject="CN=/t", end="2300-01-01T00:00:00Z")),
            "vendor accepts the permissions of /t: Cyclone DDS 0.10: grant 'g' expired",
        ),
    ],
)
def test_what_vendors_take_differently_is_refused(document: bytes, text: str) -> None:
    with pytest.raises(DocumentError) as refused:
        grant_for_all_vendors(document, "the permissions of /t", "CN=/t")
    assert text in str(refused.value)
