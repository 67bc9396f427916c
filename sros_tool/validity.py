"""A window of time in which a certificate or a document is valid.

Moments are timezone-aware and in UTC, with a resolution of one second.  Nothing here asks for
the present moment: it is passed in.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta

from sros_tool.errors import UsageError

BACKDATE = timedelta(hours=24)
"""How far before its creation a window begins.

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
                f"the validity ends at {iso(self.not_after)} before it begins at "
                f"{iso(self.not_before)}"
            )

    def contains(self, moment: datetime) -> bool:
        """Whether ``moment`` lies within the window."""
        return self.not_before <= moment <= self.not_after

    def within(self, outer: Window) -> Window:
        """The part of this window that lies in ``outer``."""
        return Window(max(self.not_before, outer.not_before), min(self.not_after, outer.not_after))


def window(now: datetime, duration: timedelta) -> Window:
    """The window of something made ``now`` that is to last for ``duration`` (back-dated)."""
    moment = now.astimezone(UTC).replace(microsecond=0)
    return Window(moment - BACKDATE, moment + duration)


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
    """``duration`` as `parse_duration` reads it, in days where they are whole."""
    seconds = int(duration.total_seconds())
    return f"{seconds // 86400}d" if seconds % 86400 == 0 else f"{seconds}s"


def iso(moment: datetime) -> str:
    """``moment`` as CCYY-MM-DDThh:mm:ssZ, in UTC."""
    return moment.astimezone(UTC).strftime("%Y-%m-%dT%H:%M:%SZ")


def parse_iso(text: str) -> datetime:
    """Read an XML dateTime; without a zone it is UTC (DDS-Security 1.1, 9.4.1.3.2.2).

    Raises `ValueError` if it is none.
    """
    moment = datetime.fromisoformat(text.strip())
    if moment.tzinfo is None:
        moment = moment.replace(tzinfo=UTC)
    try:
        return moment.astimezone(UTC)
    except OverflowError as error:  # an offset at the very end of the calendar
        raise ValueError(f"{text!r} lies outside of the calendar") from error
