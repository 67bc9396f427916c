"""A window of time in which a certificate or a document is valid.

Moments are timezone-aware and in UTC, with a resolution of one second.  Nothing here asks for
the present moment: it is passed in.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from functools import lru_cache

from sros_tool.errors import UsageError

BACKDATE = timedelta(hours=24)
"""The time from the start of a window to its creation.

Fast DDS 2.14.5 reads the dates of permissions in the host's local time, so a document must be
valid at least 14 hours before its creation in UTC to work in every time zone.
"""

_DURATION = re.compile(r"(\d{1,10})([smhdwy])\Z", re.ASCII)
_SECONDS = {"s": 1, "m": 60, "h": 3600, "d": 86400, "w": 604800, "y": 365 * 86400}
_LONGEST = 100 * _SECONDS["y"]


@dataclass(frozen=True, slots=True)
class Window:
    """From ``not_before`` to ``not_after``, both included and both in UTC."""

    not_before: datetime
    not_after: datetime

    def __post_init__(self) -> None:
        if self.not_after <= self.not_before:
            raise UsageError(
                f"the validity expires at {iso(self.not_after)}, before it begins at "
                f"{iso(self.not_before)}"
            )

    def contains(self, moment: datetime) -> bool:
        """Return whether ``moment`` lies within the window."""
        return self.not_before <= moment <= self.not_after

    def within(self, outer: Window) -> Window:
        """Return the part of this window that lies in ``outer``."""
        return Window(max(self.not_before, outer.not_before), min(self.not_after, outer.not_after))


@dataclass(frozen=True, slots=True)
class Lifespan:
    """A validity with a fixed start, a fixed end, or both; ``length`` counts from the start.

    Without ``start`` it begins when something is made.  Exactly one of the others is given.
    """

    start: datetime | None = None
    end: datetime | None = None
    length: timedelta | None = None


Span = timedelta | Lifespan
"""A chosen validity: a duration from the creation on, or a `Lifespan`."""


def window(now: datetime, span: Span) -> Window:
    """Return the window of something made ``now``; back-dated unless its start is fixed."""
    moment = now.astimezone(UTC).replace(microsecond=0)
    if isinstance(span, timedelta):
        return Window(moment - BACKDATE, moment + span)
    begin = span.start or moment
    end = span.end or begin + (span.length or timedelta(0))
    if end <= moment:
        raise UsageError(f"the validity expired at {iso(end)} already")
    return Window(span.start or moment - BACKDATE, end)


def parse_span(text: str) -> Span:
    """Read a duration (``90d``), an end (``2027-06-01``), or both ends of an interval.

    Intervals are written as in ISO 8601, ``2026-12-01/2027-06-01`` or ``2026-12-01/90d``; dates
    without a zone are in UTC.
    """
    first, slash, last = text.strip().partition("/")
    start = _moment(first, text) if slash else None
    rest = last if slash else first
    if _DURATION.match(rest):
        length = parse_duration(rest)
        return Lifespan(start=start, length=length) if start else length
    return Lifespan(start=start, end=_moment(rest, text))


def _moment(text: str, whole: str) -> datetime:
    try:
        return parse_iso(text).replace(microsecond=0)
    except (ValueError, OverflowError) as error:
        raise UsageError(
            f"{whole!r} is neither a duration nor a date",
            "",
            "Write for example 90d, 72h, 2027-06-01 or 2026-12-01/90d.",
        ) from error


def span_text(span: Span) -> str:
    """Return ``span`` as text for `parse_span`."""
    if isinstance(span, timedelta):
        return duration_text(span)
    end = iso(span.end) if span.end else duration_text(span.length or timedelta(0))
    return f"{iso(span.start)}/{end}" if span.start else end


def parse_duration(text: str) -> timedelta:
    """Read ``90d``, ``72h``, ``10y`` …: a whole number and one of s m h d w y (365 days)."""
    match = _DURATION.match(text.strip())
    if match:
        seconds = int(match[1]) * _SECONDS[match[2]]
        if 0 < seconds <= _LONGEST:
            return timedelta(seconds=seconds)
    raise UsageError(
        f"{text!r} is not a duration",
        "",
        "Write a whole number above zero and one of s, m, h, d, w, y, as in 90d or 72h; "
        "100y is the longest.",
    )


def duration_text(duration: timedelta) -> str:
    """Return ``duration`` as text for `parse_duration`, in days if they are whole."""
    seconds = int(duration.total_seconds())
    return f"{seconds // 86400}d" if seconds % 86400 == 0 else f"{seconds}s"


@lru_cache(maxsize=64)  # things made at once have equal moments
def iso(moment: datetime) -> str:
    """Return ``moment`` as CCYY-MM-DDThh:mm:ssZ, in UTC."""
    return moment.astimezone(UTC).strftime("%Y-%m-%dT%H:%M:%SZ")


def parse_iso(text: str) -> datetime:
    """Read an XML dateTime; without a zone it is UTC (DDS-Security 1.1, 9.4.1.3.2.2).

    Raises `ValueError` for any other text.
    """
    moment = datetime.fromisoformat(text.strip())
    if moment.tzinfo is None:
        moment = moment.replace(tzinfo=UTC)
    try:
        return moment.astimezone(UTC)
    except OverflowError as error:  # an offset at the very end of the calendar
        raise ValueError(f"{text!r} lies outside of the calendar") from error
