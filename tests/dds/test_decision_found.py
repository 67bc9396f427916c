"""What comparing with the vendors themselves brought to light, as a table."""

from __future__ import annotations

import os

import pytest

from sros_tool.dds.decision.access import Access, AccessVerb, Outcome
from sros_tool.dds.decision.documents import read_permissions_as
from sros_tool.dds.decision.vendors import Vendor
from sros_tool.dds.permissions import Permissions, portability_problems
from tests.dds.decision_documents import (
    NOW,
    SUBJECT,
    access_of,
    allow,
    governance,
    grant,
    permissions,
    publish,
    subscribe,
    topic_rule,
)

EVERYTHING = permissions(grant(allow(publish("*"))))
ELSEWHERE = permissions(grant(allow(publish("rt/a"), domains="<id>7</id>")))


def outcome(
    vendor: Vendor,
    perms: bytes,
    govern: bytes,
    topic: str,
    verb: AccessVerb = AccessVerb.PUBLISH,
) -> Outcome:
    found = access_of(vendor, govern, perms, SUBJECT, domain=42, at=NOW)
    assert isinstance(found, Access), found
    return found.decide(verb, topic).outcome


@pytest.mark.parametrize(
    "name", ["rt/-", "rt/]", "rt/a.b", "7", "rt/\N{LATIN SMALL LETTER E WITH ACUTE}"]
)
def test_cyclone_takes_letters_digits_and_slashes_as_topics(name: str) -> None:
    assert outcome(Vendor.CYCLONE, EVERYTHING, governance(), "rt/a_7") is Outcome.ALLOWED
    assert outcome(Vendor.CYCLONE, EVERYTHING, governance(), name) is Outcome.DENIED
    assert outcome(Vendor.FAST_2_9, EVERYTHING, governance(), name) is Outcome.ALLOWED


@pytest.mark.parametrize(
    ("rtps", "data", "vendor", "expected"),
    [
        ("NONE", "NONE", Vendor.CYCLONE, Outcome.ALLOWED),
        ("SIGN", "NONE", Vendor.CYCLONE, Outcome.PEER_DENIES),
        ("NONE", "SIGN", Vendor.CYCLONE, Outcome.PEER_DENIES),
        ("NONE", "NONE", Vendor.FAST_2_9, Outcome.PEER_DENIES),
    ],
)
@pytest.mark.parametrize("controlled", ["", "read", "write"])
def test_what_nothing_protects_is_shared_with_those_that_were_refused(
    rtps: str, data: str, vendor: Vendor, expected: Outcome, controlled: str
) -> None:
    """What is controlled is the other direction, for which peers do not ask."""
    free = topic_rule("rt/open", read=controlled == "read", write=controlled == "write", data=data)
    free = free.replace("<metadata_protection_kind>ENCRYPT", "<metadata_protection_kind>NONE")
    verb = AccessVerb.SUBSCRIBE if controlled == "write" else AccessVerb.PUBLISH
    hidden = governance(free, topic_rule(), rtps=rtps)
    assert outcome(vendor, ELSEWHERE, hidden, "rt/open", verb) is Outcome.PEER_DENIES
    free = free.replace("<enable_discovery_protection>true", "<enable_discovery_protection>false")
    govern = governance(free, topic_rule(), rtps=rtps)
    assert outcome(vendor, ELSEWHERE, govern, "rt/open", verb) is expected


def test_a_grant_without_rules_before_one_that_allows_joining() -> None:
    """The first grant decides: peers refuse its participant, and share what is unprotected."""
    perms = permissions(grant(), grant(allow(publish("rt/a"))))
    free = topic_rule(read=False, data="NONE")
    free = free.replace("<metadata_protection_kind>ENCRYPT", "<metadata_protection_kind>NONE")
    free = free.replace("<enable_discovery_protection>true", "<enable_discovery_protection>false")
    govern = governance(free, rtps="NONE")
    found = access_of(Vendor.CYCLONE, govern, perms, SUBJECT, domain=42, at=NOW)
    assert isinstance(found, Access)
    assert found.join().outcome is Outcome.PEER_DENIES
    assert found.publish("rt/a").outcome is Outcome.DENIED
    decision = found.subscribe("rt/a")
    assert decision.outcome is Outcome.ALLOWED
    assert "even peers that refuse the participant exchange" in decision.text


def test_a_date_that_cannot_be_read_in_any_grant() -> None:
    """Fast DDS reads all dates first; Cyclone DDS only those of the grant that it takes."""
    broken = grant(allow(publish("*")), subject="CN=/other", begin="tomorrow")
    perms = permissions(grant(allow(publish("*"))), broken)
    fast = access_of(Vendor.FAST_2_9, governance(), perms, SUBJECT, domain=42, at=NOW)
    assert isinstance(fast, Access)
    assert fast.join().reason == "malformed"
    assert outcome(Vendor.CYCLONE, perms, governance(), "rt/a") is Outcome.ALLOWED


def test_a_list_without_partitions_is_not_the_default_partition() -> None:
    empty = publish("rt/a").replace("</publish>", "<partitions></partitions></publish>")
    perms = permissions(grant(allow(empty, publish("rt/b"))))
    assert outcome(Vendor.CYCLONE, perms, governance(), "rt/b") is Outcome.ALLOWED
    assert outcome(Vendor.CYCLONE, perms, governance(), "rt/a") is Outcome.DENIED


def test_cyclone_reads_the_criteria_of_a_rule_in_the_order_of_the_document() -> None:
    """It creates a topic by the first criteria that names it, and crashes on an empty topic."""
    empty = subscribe("rt/b", "")
    crashing = permissions(grant(allow(empty, publish("rt/a"))))
    assert outcome(Vendor.CYCLONE, crashing, governance(), "rt/a") is Outcome.CRASHES
    for between in (publish("rt/c"), subscribe("rt/c")):
        sound = permissions(grant(allow(between, publish("rt/a"), empty)))
        assert outcome(Vendor.CYCLONE, sound, governance(), "rt/a") is Outcome.ALLOWED
    late = publish("rt/b", "")
    sound = permissions(grant(allow(subscribe("rt/a"), late)))
    reads = AccessVerb.SUBSCRIBE
    assert outcome(Vendor.CYCLONE, sound, governance(), "rt/a", reads) is Outcome.ALLOWED


def test_the_bytes_of_a_topic_count_even_if_they_are_no_utf_8() -> None:
    topic = "rt/" + 249 * "\udcac"
    perms = permissions(grant(allow(publish("rt/X")))).replace(b"rt/X", os.fsencode(topic))
    found = read_permissions_as(Vendor.CYCLONE, perms)
    assert isinstance(found, Permissions)
    assert ("portable.long-name", f"{topic[:60]}... has 252 bytes") in portability_problems(
        found, 0
    )
    assert outcome(Vendor.FAST, EVERYTHING, governance(), topic) is Outcome.PEER_DENIES


def test_peers_honour_a_default_of_allow() -> None:
    perms = permissions(grant(default="<default>ALLOW</default>"))
    govern = governance(topic_rule("rt/open", read=False), topic_rule())
    assert outcome(Vendor.CYCLONE, perms, govern, "rt/a") is Outcome.ALLOWED
    denied = permissions(grant(default="<default>DENY</default>"))
    assert outcome(Vendor.CYCLONE, denied, govern, "rt/a") is Outcome.DENIED


@pytest.mark.parametrize("vendor", [Vendor.CYCLONE, Vendor.FAST_2_9])
def test_blanks_before_the_declaration(vendor: Vendor) -> None:
    assert outcome(vendor, b"\n " + EVERYTHING, governance(), "rt/a") is Outcome.ALLOWED


@pytest.mark.parametrize(
    ("subject", "fits"),
    [("CN=/t,", True), ("CN=/t,,O=x", True), (",CN=/t", False), ("CN=/t,O=x", False)],
)
def test_fast_dds_stops_at_an_empty_part_of_a_subject(subject: str, fits: bool) -> None:
    perms = permissions(grant(allow(publish("rt/a")), subject=subject))
    expected = Outcome.ALLOWED if fits else Outcome.REFUSED
    assert outcome(Vendor.FAST_2_9, perms, governance(), "rt/a") is expected
