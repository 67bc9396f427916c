"""The ordinary cases, on which all vendors agree."""

from __future__ import annotations

import pytest

from sros_tool.dds.decision.access import Access, AccessVerb, Outcome
from sros_tool.dds.decision.vendors import Vendor
from tests.dds.decision_documents import (
    NOW,
    SUBJECT,
    access_of,
    allow,
    deny,
    governance,
    grant,
    permissions,
    publish,
    subscribe,
    topic_rule,
)

VENDORS = list(Vendor)


def access(vendor: Vendor, perms: bytes, govern: bytes = governance(), domain: int = 42) -> Access:
    found = access_of(vendor, govern, perms, SUBJECT, domain=domain, at=NOW)
    assert isinstance(found, Access), found
    return found


@pytest.mark.parametrize("vendor", VENDORS)
def test_a_right_is_given_by_an_allow_rule(vendor: Vendor) -> None:
    perms = permissions(grant(allow(publish("rt/a", "rt/b/*"), subscribe("rt/c"))))
    decided = access(vendor, perms)
    assert decided.join().outcome is Outcome.ALLOWED
    for topic in ("rt/a", "rt/b/x/y"):
        answer = decided.publish(topic)
        assert (answer.outcome, answer.reason) == (Outcome.ALLOWED, "allow-rule")
        assert (answer.grant, answer.rule) == (0, 0)
        assert answer.topic_rule is not None
    assert decided.publish("rt/b/x").expression == "rt/b/*"
    assert decided.subscribe("rt/c").outcome is Outcome.ALLOWED
    assert decided.publish("rt/c").outcome is Outcome.DENIED
    assert decided.subscribe("rt/a").outcome is Outcome.DENIED
    assert decided.decide(AccessVerb.PUBLISH, "rt/d").outcome is Outcome.DENIED


@pytest.mark.parametrize("vendor", VENDORS)
def test_the_first_rule_that_matches_decides(vendor: Vendor) -> None:
    perms = permissions(grant(deny(publish("rt/s"), subscribe("rt/s")), allow(publish("rt/*"))))
    decided = access(vendor, perms)
    assert decided.publish("rt/s").reason == "deny-rule"
    assert decided.publish("rt/t").outcome is Outcome.ALLOWED
    late = access(vendor, permissions(grant(allow(publish("rt/*")), deny(publish("rt/s")))))
    assert late.publish("rt/s").outcome is Outcome.ALLOWED


@pytest.mark.parametrize("vendor", VENDORS)
def test_no_grant_no_participant(vendor: Vendor) -> None:
    for perms, reason in (
        (permissions(grant(allow(publish("*")), subject="CN=/other")), "no-grant"),
        (permissions(grant(allow(publish("*")), end="2025-01-01T00:00:00Z")), "expired"),
        (permissions(grant(allow(publish("*")), begin="2030-01-01T00:00:00Z")), "not-yet-valid"),
    ):
        decided = access(vendor, perms)
        assert (decided.join().outcome, decided.join().reason) == (Outcome.REFUSED, reason)
        assert decided.publish("rt/a").outcome is Outcome.REFUSED


@pytest.mark.parametrize("vendor", VENDORS)
def test_topics_without_access_control_are_open(vendor: Vendor) -> None:
    govern = governance(topic_rule("rt/open", read=False, write=False), topic_rule("rt/*"))
    decided = access(vendor, permissions(grant(allow(publish("rt/a")))), govern)
    assert decided.publish("rt/open").reason == "unrestricted"
    assert decided.publish("rt/b").outcome is Outcome.DENIED
    assert decided.publish("rq/a").reason == "no-topic-rule"
