"""Durations, moments and windows of time."""

from __future__ import annotations

import contextlib
from datetime import UTC, datetime, timedelta, timezone

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sros_tool.errors import UsageError
from sros_tool.validity import (
    BACKDATE,
    Window,
    duration_text,
    iso,
    parse_duration,
    parse_iso,
    soon_limit,
    window,
)

seconds = st.integers(1, 100 * 365 * 86400)
zones = st.integers(-14 * 60, 14 * 60).map(lambda each: timezone(timedelta(minutes=each)))
moments = st.datetimes(datetime(1900, 1, 2), datetime(9000, 1, 1), timezones=zones)
signing_times = st.datetimes(datetime(1950, 1, 3), datetime(9000, 1, 1), timezones=zones)


@given(seconds)
def test_a_duration_reads_back(length: int) -> None:
    duration = timedelta(seconds=length)
    assert parse_duration(duration_text(duration)) == duration


@pytest.mark.parametrize(
    ("text", "duration"),
    [
        ("1s", timedelta(seconds=1)),
        ("90m", timedelta(minutes=90)),
        ("1001h", timedelta(hours=1001)),
        ("90d", timedelta(days=90)),
        ("2w", timedelta(weeks=2)),
        ("100y", timedelta(days=36500)),
        (" 1d ", timedelta(days=1)),
        ("3600001s", timedelta(seconds=3600001)),
    ],
)
def test_durations(text: str, duration: timedelta) -> None:
    assert parse_duration(text) == duration


@given(st.text(alphabet="0123456789smhdwy. -٣", max_size=6))
def test_any_text_is_a_duration_or_an_error(text: str) -> None:
    try:
        assert parse_duration(text) > timedelta(0)
    except UsageError as error:
        assert repr(text) in error.what


@given(moments)
def test_a_moment_reads_back(moment: datetime) -> None:
    assert parse_iso(iso(moment)) == moment.replace(microsecond=0)
    assert parse_iso(iso(moment)).tzinfo is UTC


@given(st.text(max_size=30) | moments.map(str) | st.from_regex(r"\A\d{4}-\d\d-\d\dT\d\d:\d\d.*\Z"))
def test_any_text_is_a_moment_or_a_value_error(text: str) -> None:
    with contextlib.suppress(ValueError):
        assert parse_iso(text).tzinfo is UTC


@pytest.mark.parametrize("text", ["9999-12-31T23:59:59-14:00", "0001-01-01T00:00:00+14:00"])
def test_moments_outside_of_the_calendar(text: str) -> None:
    with pytest.raises(ValueError, match="years 1 to 9999"):
        parse_iso(text)


def test_without_a_zone_it_is_utc() -> None:
    assert parse_iso("2024-02-29T12:00:00") == datetime(2024, 2, 29, 12, tzinfo=UTC)
    assert parse_iso("2024-02-29T12:00:00+09:00") == datetime(2024, 2, 29, 3, tzinfo=UTC)


@given(signing_times, seconds)
def test_a_window_begins_early_enough_for_every_time_zone(moment: datetime, length: int) -> None:
    made = window(moment, timedelta(seconds=length))
    assert made.contains(moment.replace(microsecond=0))
    assert moment - made.not_before >= timedelta(hours=14)
    assert made.not_before + BACKDATE + timedelta(seconds=length) == made.not_after


@given(moments, st.lists(seconds, min_size=3, max_size=3, unique=True))
def test_a_window_within_another(moment: datetime, lengths: list[int]) -> None:
    one, two = (Window(moment, moment + timedelta(seconds=each)) for each in lengths[:2])
    both = one.intersection(two)
    assert both == two.intersection(one)
    assert both.not_after == min(one.not_after, two.not_after)
    with pytest.raises(UsageError):
        Window(moment, moment)
    with pytest.raises(UsageError):
        one.intersection(Window(one.not_after, one.not_after + timedelta(seconds=1)))


def test_a_new_document_of_short_validity_does_not_expire_soon() -> None:
    """Though sros writes that it is valid since a day before, which is most of its validity."""
    made = datetime(2026, 11, 1, tzinfo=UTC)
    for lifetime in (timedelta(minutes=5), timedelta(days=20), timedelta(days=365)):
        soon_from = Window(made - BACKDATE, made + lifetime).expires_soon_from()
        assert soon_from == made + lifetime - soon_limit(lifetime) > made


def test_a_validity_where_dates_end_has_a_lifetime() -> None:
    first, last = (each.replace(tzinfo=UTC) for each in (datetime.min, datetime.max))
    hour, now = timedelta(hours=1), datetime(2026, 1, 1, tzinfo=UTC)
    for begin in (first, last - hour):
        ends = Window(begin, begin + hour)
        assert ends.lifetime() == ends.lifetime(now) == hour
