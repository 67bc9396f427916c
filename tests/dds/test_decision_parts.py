"""The parts of a decision: subjects, dates, domains, and what documents are readable."""

from __future__ import annotations

from datetime import UTC, datetime
from math import inf
from zoneinfo import ZoneInfo

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sros_tool.dds.decision.access import Outcome, Refusal, includes_domain
from sros_tool.dds.decision.documents import read_governance_as, read_permissions_as
from sros_tool.dds.decision.grants import read_date, same_subject
from sros_tool.dds.decision.vendors import DateRule, OpenRange, Subjects, Vendor
from sros_tool.dds.domains import DomainRange, DomainSet
from tests.dds.decision_documents import allow, governance, grant, permissions, publish

# ── subjects ───────────────────────────────────────────────────────────────────────────────


SUBSETS = {Subjects.SUBSET, Subjects.TRIMMED_SUBSET}


@pytest.mark.parametrize(
    ("granted", "certified", "accepted_by"),
    [
        ("CN=/t", "CN=/t", set(Subjects)),
        ("CN=/t", "CN=/u", set()),
        ("CN=/t,O=x", "CN=/t,O=x", set(Subjects)),
        ("CN=/t, O=x", "CN=/t,O=x", set(Subjects) - {Subjects.SUBSET}),
        ("O=x,CN=/t", "CN=/t,O=x", {Subjects.ANY_ORDER, *SUBSETS}),
        ("CN = /t", "CN=/t", {Subjects.EXACT, Subjects.ANY_ORDER, Subjects.TRIMMED_SUBSET}),
        ("OU=a,OU=b", "OU=a,OU=b", {Subjects.EXACT, Subjects.WHOLE_ATTRIBUTES}),
        ("CN=/robot/admin", "CN=/robot", SUBSETS),
        ("CN=/robot", "CN=/robot/admin", set()),
        ("CN=/b/a", "CN=/a/b", SUBSETS),
        ('CN="/t"', "CN=/t", {Subjects.EXACT, Subjects.ANY_ORDER}),
        (r"CN=a\,b", r"CN=a\,b", set(Subjects)),
        (r'CN="a,b"', r"CN=a\,b", {Subjects.EXACT, Subjects.ANY_ORDER}),
        ("cn=/t", "CN=/t", set()),
    ],
)
def test_subjects(granted: str, certified: str, accepted_by: set[Subjects]) -> None:
    assert {rule for rule in Subjects if same_subject(rule, granted, certified)} == accepted_by


# ── dates ──────────────────────────────────────────────────────────────────────────────────

NOON = datetime(2026, 6, 15, 12, tzinfo=UTC).timestamp()
HOUR = 3600
BAD = None


@pytest.mark.parametrize(
    ("text", "standard", "local", "cyclone"),
    [
        ("2026-06-15T12:00:00Z", 0, 0, 0),
        ("2026-06-15T12:00:00", 0, 0, 0),
        ("2026-06-15T12:00:00+09:00", -9, 0, -9),
        ("2026-06-15T12:00:00-05:30", 5.5, 0, 5.5),
        ("2026-06-15T12:00:00+13:00", -13, 0, -inf),
        ("2026-06-15", -12, -12, -inf),
        ("2026-06-15T12:00", 0, BAD, -inf),
        ("2026-06-15 12:00:00Z", 0, BAD, -inf),
        ("tomorrow", BAD, BAD, -inf),
        ("2026-13-01T00:00:00Z", BAD, BAD, -inf),
    ],
)
def test_dates_in_hours_from_noon(
    text: str, standard: float | None, local: float | None, cyclone: float | None
) -> None:
    for rule, hours in zip(DateRule, (standard, local, cyclone), strict=True):
        found = read_date(rule, text, UTC)
        assert found == (None if hours is None else NOON + hours * HOUR), rule


@pytest.mark.parametrize(
    ("zone", "hours"),
    # Without daylight saving, in June as well: mktime is told that there is none.
    [("America/Los_Angeles", 8), ("Asia/Tokyo", -9), ("Europe/Berlin", -1), ("Asia/Kolkata", -5.5)],
)
def test_local_dates_are_in_the_standard_time_of_the_host(zone: str, hours: float) -> None:
    for text in ("2026-06-15T12:00:00Z", "2026-06-15T12:00:00+09:00"):
        found = read_date(DateRule.LOCAL, text, ZoneInfo(zone))
        assert found == NOON + hours * HOUR
    assert read_date(DateRule.CYCLONE, "2026-06-15T12:00:00Z", ZoneInfo(zone)) == NOON


def test_what_no_calendar_holds_is_far_away_for_fast_dds() -> None:
    assert read_date(DateRule.LOCAL, "9999-12-31T23:59:60Z", UTC) == inf
    assert read_date(DateRule.LOCAL, "0000-01-01T00:00:00Z", UTC) == -inf
    assert read_date(DateRule.LOCAL, "2026-02-31T00:00:00Z", UTC) == (
        datetime(2026, 3, 3, tzinfo=UTC).timestamp()
    )


@given(st.text(alphabet="0123456789-:TZ+. ", max_size=30), st.sampled_from(DateRule))
def test_no_text_is_an_error(text: str, rule: DateRule) -> None:
    found = read_date(rule, text, ZoneInfo("America/Los_Angeles"))
    assert found is None or isinstance(found, float)


# ── domains ────────────────────────────────────────────────────────────────────────────────


@pytest.mark.parametrize(
    ("first", "last", "answers"),
    [
        (42, 42, (True, True, True)),
        (40, 50, (True, True, True)),
        (43, 50, (False, False, False)),
        (42, None, (True, True, True)),
        (40, None, (True, False, False)),
        (None, 50, (True, True, None)),
        (None, 41, (False, False, None)),
        (42, 0, (False, True, False)),
    ],
)
def test_open_ranges(first: int | None, last: int | None, answers: tuple[bool | None, ...]) -> None:
    domains = DomainSet((DomainRange(first, last),))
    assert tuple(includes_domain(rule, domains, 42) for rule in OpenRange) == answers


def test_a_range_over_which_cyclone_crashes_is_not_reached_behind_one_that_holds() -> None:
    domains = DomainSet((DomainRange(42, 42), DomainRange(None, 7)))
    assert includes_domain(OpenRange.CRASHES, domains, 42)
    assert includes_domain(OpenRange.CRASHES, domains, 41) is None


# ── documents ──────────────────────────────────────────────────────────────────────────────

GOOD = permissions(grant(allow(publish("rt/a"))))


def outcome(found: object) -> Outcome | None:
    return found.outcome if isinstance(found, Refusal) else None


REFUSED, CRASHES = Outcome.REFUSED, Outcome.CRASHES


@pytest.mark.parametrize(
    ("old", "new", "fast", "cyclone"),
    [
        ("", "", None, None),
        ("<dds>", "<dds x='1'>", None, REFUSED),
        ("<grant", "<!-- c --><grant", None, None),
        ("rt/a", "<!-- c -->rt/a", None, None),
        ("<id>42</id>", "<id>0x2a</id>", None, None),
        ("<id>42</id>", "<id>42abc</id>", None, REFUSED),
        ("<id>42</id>", "<id></id>", REFUSED, None),
        ("<id>42</id>", "", REFUSED, None),
        ("<id>42</id>", "<id>231</id>", None, REFUSED),
        ("<id>42</id>", "<id>4294967338</id>", None, None),
        ("<id>42</id>", "<id>99999999999999999999</id>", None, REFUSED),
        ("<domains><id>42</id></domains>", "", REFUSED, None),
        ("<default>DENY</default>", "<default> DENY </default>", REFUSED, None),
        ("<default>DENY</default>", "<default>DENY</default><x/>", None, REFUSED),
        ("<publish>", "<publish>words", None, REFUSED),
        ("<not_after>2040-01-01T00:00:00Z", "<not_after>", CRASHES, REFUSED),
        ("<subject_name>CN=/t", "<subject_name>", REFUSED, REFUSED),
        ("</subject_name>", "</subject_name><subject_name>CN=/t</subject_name>", REFUSED, None),
        ("<publish>", "<data_tags><tag><name/></tag></data_tags><publish>", REFUSED, None),
        ("</topics>", "</topics><partitions></partitions>", REFUSED, None),
        ("<permissions>", "<PERMISSIONS>", REFUSED, REFUSED),
    ],
)
def test_permissions_that_are_read(
    old: str, new: str, fast: Outcome | None, cyclone: Outcome | None
) -> None:
    xml = GOOD.decode().replace(old, new).encode() if old else GOOD
    assert outcome(read_permissions_as(Vendor.FAST, xml)) is fast
    assert outcome(read_permissions_as(Vendor.CYCLONE, xml)) is cyclone


@pytest.mark.parametrize(
    ("old", "new", "fast", "cyclone"),
    [
        ("", "", None, None),
        (">true<", ">True<", None, None),
        (">true<", ">tRUE<", REFUSED, None),
        (">true<", "> 1 <", None, None),
        (">true<", "> true <", REFUSED, None),
        (">true<", "><", REFUSED, None),
        (">true<", ">2<", None, REFUSED),
        (">ENCRYPT<", ">encrypt<", REFUSED, REFUSED),
        (">ENCRYPT<", "> ENCRYPT <", REFUSED, None),
        ("<topic_expression>*<", "<topic_expression><", CRASHES, None),
        ("</topic_access_rules>", "</topic_access_rules><x/>", REFUSED, REFUSED),
    ],
)
def test_governance_that_is_read(
    old: str, new: str, fast: Outcome | None, cyclone: Outcome | None
) -> None:
    xml = governance().decode().replace(old, new).encode() if old else governance()
    assert outcome(read_governance_as(Vendor.FAST, xml)) is fast
    assert outcome(read_governance_as(Vendor.CYCLONE, xml)) is cyclone


@pytest.mark.parametrize("vendor", Vendor)
@pytest.mark.parametrize(
    "xml", [b"", b"no xml", b"<dds>", b"<other/>", b"<dds></dds>", b"<dds><permissions/></dds>"]
)
def test_garbage_is_refused_by_everybody(vendor: Vendor, xml: bytes) -> None:
    for read in (read_permissions_as, read_governance_as):
        refusal = read(vendor, xml)
        assert isinstance(refusal, Refusal)
        assert refusal.reason == "malformed"
        assert vendor.title in refusal.text
