"""Validity of certificates and documents: windows of time, durations, and their text forms.

Times are timezone-aware, in UTC, with a resolution of one second.  Nothing here reads the clock:
callers pass the current time.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from functools import lru_cache
from typing import NamedTuple

from sros_tool.errors import UsageError

BACKDATE = timedelta(hours=24)
"""How long before its creation a certificate or document becomes valid.

Fast DDS 2.14.5 reads the dates of permissions in the host's local time, so a document must be
valid at least 14 hours before its creation in UTC to work in every time zone.
"""

_FIRST_YEAR = 1950
_EPOCH = datetime.fromtimestamp(0, UTC)

_DURATION = re.compile(r"(\d{1,10})([smhdwy])\Z", re.ASCII)
_SECONDS_PER_UNIT = {"s": 1, "m": 60, "h": 3600, "d": 86400, "w": 604800, "y": 365 * 86400}
_LONGEST_DURATION = 100 * _SECONDS_PER_UNIT["y"]


def time_of_file(seconds: float) -> datetime:
    """Return the time of a file in UTC.

    A time that `datetime` cannot express becomes the end of the year 9999, or 1970 if
    ``seconds`` is negative.
    """
    try:
        return datetime.fromtimestamp(seconds, UTC)
    except (ValueError, OverflowError, OSError):
        return datetime.max.replace(tzinfo=UTC) if seconds > 0 else _EPOCH


_SOON_BEFORE_EXPIRY = timedelta(days=30)
"""How long before it expires a document counts as expiring soon, unless its validity is short."""
AUTHORITY_SOON = timedelta(days=90)
"""How long before its expiry a CA counts as expiring soon: its replacement takes several stages."""


def soon_limit(lifetime: timedelta, longest: timedelta = _SOON_BEFORE_EXPIRY) -> timedelta:
    """Return the remaining time below which a document counts as expiring soon.

    This is ``longest``, or a third of the document's ``lifetime`` if that is shorter.  It is in
    whole days if possible, so that a daily job does not renew the document each time.
    """
    limit = min(longest, lifetime / 3)
    unit = timedelta(days=1) if limit >= timedelta(days=1) else timedelta(seconds=1)
    return limit // unit * unit


@dataclass(frozen=True, slots=True)
class Window:
    """A validity from ``not_before`` to ``not_after``, both included and both in UTC."""

    not_before: datetime
    """Start of the validity, in UTC."""
    not_after: datetime
    """End of the validity, in UTC."""

    def __post_init__(self) -> None:
        if self.not_after <= self.not_before:
            raise UsageError(
                f"the validity expires at {iso(self.not_after)}, before it begins at "
                f"{iso(self.not_before)}",
                "",
                "Choose a later expiry.",
            )

    def contains(self, moment: datetime) -> bool:
        """Return whether ``moment`` is within the window."""
        return self.not_before <= moment <= self.not_after

    def expires_soon_from(self, longest: timedelta = _SOON_BEFORE_EXPIRY) -> datetime:
        """Return the time from which the window counts as expiring soon; see `soon_limit`."""
        return self.not_after - soon_limit(self.lifetime(), longest)

    def lifetime(self, made_at: datetime | None = None) -> timedelta:
        """Return how long a document with this validity is valid after it was made.

        ``made_at`` is when the document was made, or when its file arrived here; a time long before
        the validity is ignored.  Without ``made_at``, the document counts as made by sros, that is,
        `BACKDATE` after its validity begins; documents of other programs may be valid only from
        ``made_at`` on.
        """
        length = self.not_after - self.not_before
        backdated = BACKDATE if length > BACKDATE else timedelta(0)
        # Computed by differences, because dates of a certificate may be the limits of `datetime`.
        if made_at is not None and (late := made_at - self.not_before) >= -BACKDATE:
            return length - min(max(late, timedelta(0)), backdated)
        return length - backdated

    def intersection(self, outer: Window) -> Window:
        """Return the part of this window that is in ``outer``."""
        return Window(max(self.not_before, outer.not_before), min(self.not_after, outer.not_after))

    def can_be_kept(self, new: Window, now: datetime) -> bool:
        """Return whether a document with this validity can be kept instead of a ``new`` one.

        It can be kept if it is valid as soon as ``new``, expires no later than ``new``, and has
        more than a third of the time left that ``new`` has.
        """
        return (
            self.not_before <= max(now, new.not_before)
            and self.not_after <= new.not_after
            and self.not_after - now > (new.not_after - now) / 3
        )


class Lifespan(NamedTuple):
    """A chosen validity with a fixed start, a fixed end, or both.

    Without ``start`` it begins at the creation.  Exactly one of ``end`` and ``length`` is given;
    ``length`` counts from the start.
    """

    start: datetime | None = None
    end: datetime | None = None
    length: timedelta | None = None


Span = timedelta | Lifespan
"""A chosen validity: a duration that counts from the creation, or a `Lifespan`."""


def window(now: datetime, span: Span) -> Window:
    """Return the validity of a certificate or document created ``now``.

    Without a fixed start it begins `BACKDATE` before ``now``.

    Raises:
        UsageError: the validity has expired already, or is not within the years that a certificate
            can name (1950 to 9999; RFC 5280, 4.1.2.5).
    """
    moment = now.astimezone(UTC).replace(microsecond=0)
    chosen = Lifespan(length=span) if isinstance(span, timedelta) else span
    try:
        end = chosen.end or (chosen.start or moment) + (chosen.length or timedelta(0))
        begin = chosen.start or moment - BACKDATE
    except OverflowError:
        end = begin = datetime.min.replace(tzinfo=UTC)
    if begin.year < _FIRST_YEAR:
        raise UsageError(
            f"the validity of what is signed at {iso(now)} is not within the years {_FIRST_YEAR} "
            "to 9999",
            "Certificates cannot contain other years.",
            "Set the clock of this machine, or choose a shorter validity.",
        )
    if end <= moment:
        raise UsageError(
            f"the chosen validity has expired already, at {iso(end)}", "", "Choose a later expiry."
        )
    return Window(begin, end)


def parse_span(text: str) -> Span:
    """Parse a duration (``90d``), an expiry (``2027-06-01``), or an interval.

    Intervals are written as in ISO 8601, ``2026-12-01/2027-06-01`` or ``2026-12-01/90d``; dates
    without a zone are in UTC.  Raises `UsageError` for any other text.
    """
    first, slash, last = text.strip().partition("/")
    start = _parse_moment(first, text) if slash else None
    rest = last if slash else first
    if _DURATION.match(rest):
        length = parse_duration(rest)
        return Lifespan(start=start, length=length) if start else length
    return Lifespan(start=start, end=_parse_moment(rest, text))


def _parse_moment(text: str, range_text: str) -> datetime:
    try:
        return parse_iso(text).replace(microsecond=0)
    except (ValueError, OverflowError) as error:
        raise UsageError(
            f"{range_text!r} is neither a duration nor a date",
            "",
            "Write for example 90d, 72h, 2027-06-01 or 2026-12-01/90d.",
        ) from error


def span_text(span: Span) -> str:
    """Return ``span`` as text that `parse_span` reads."""
    if isinstance(span, timedelta):
        return duration_text(span)
    end = iso(span.end) if span.end else duration_text(span.length or timedelta(0))
    return f"{iso(span.start)}/{end}" if span.start else end


def parse_duration(text: str) -> timedelta:
    """Parse a duration such as ``90d``: a whole number and one of s, m, h, d, w, y (365 days).

    Raises `UsageError` for any other text, for 0, and for more than 100 years.
    """
    match = _DURATION.match(text.strip())
    if match:
        seconds = int(match[1]) * _SECONDS_PER_UNIT[match[2]]
        if 0 < seconds <= _LONGEST_DURATION:
            return timedelta(seconds=seconds)
    raise UsageError(
        f"{text!r} is not a duration",
        "",
        "Write a whole number above zero and one of s, m, h, d, w, y, as in 90d or 72h; "
        "the longest duration is 100y.",
    )


def duration_text(duration: timedelta) -> str:
    """Return ``duration`` as text that `parse_duration` reads, in whole days or else in seconds."""
    seconds = int(duration.total_seconds())
    return f"{seconds // 86400}d" if seconds % 86400 == 0 else f"{seconds}s"


def elapsed(duration: timedelta) -> str:
    """Return a duration in its two largest units for people to read, such as ``3 d 4 h``."""
    seconds = max(0, int(duration.total_seconds()))
    units = (("d", 86400), ("h", 3600), ("min", 60), ("s", 1))
    numbers: list[tuple[int, str]] = []
    for unit, size in units:
        number, seconds = divmod(seconds, size)
        if number or numbers:
            numbers.append((number, unit))
    return " ".join(f"{number} {unit}" for number, unit in numbers[:2] if number) or "0 s"


@lru_cache(maxsize=64)  # files that are created together have equal times
def iso(moment: datetime) -> str:
    """Return ``moment`` as CCYY-MM-DDThh:mm:ssZ, in UTC."""
    plain = moment.astimezone(UTC).replace(tzinfo=None, microsecond=0)
    return f"{plain.isoformat()}Z"  # strftime("%Y") writes the year 1 without zeros


def parse_iso(text: str) -> datetime:
    """Parse an XML dateTime; without a zone it is UTC (DDS-Security 1.1, 9.4.1.3.2.2).

    Raises `ValueError` for any other text.
    """
    moment = datetime.fromisoformat(text.strip())
    if moment.tzinfo is None:
        moment = moment.replace(tzinfo=UTC)
    try:
        return moment.astimezone(UTC)
    except OverflowError as error:  # the zone moves the time out of the years 1 to 9999
        raise ValueError(f"{text!r} is outside of the years 1 to 9999") from error
