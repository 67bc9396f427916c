"""Reading the dates of a grant's validity as a vendor reads them."""

from __future__ import annotations

import re
from calendar import timegm
from datetime import datetime, timedelta, tzinfo
from functools import lru_cache
from math import inf

from sros_tool.dds.decision.vendors import Moments
from sros_tool.validity import parse_iso

_CYCLONE = re.compile(
    r"(\d{4})-(\d\d)-(\d\d)T(\d\d):(\d\d):(\d\d)(\.\d{1,12})?(?:Z|([+Z-])(\d\d):(\d\d))?\Z",
    re.ASCII,
)
# std::get_time of libstdc++ with %Y-%m-%dT%H:%M:%S: the text may end after the year, the month or
# the day; one blank may precede the day; anything may follow the seconds.
_LOCAL = re.compile(
    r"\s*(\d{1,4})(?:-(\d\d?)(?:-\s?(\d\d?)(?:[Tt](\d\d?):(\d\d?):(\d\d?))?)?)?", re.ASCII
)
_LAST_YEAR = 2262  # of 64 bits of nanoseconds
_FARTHEST = timedelta(hours=12)


@lru_cache(maxsize=64)  # the enclaves of a keystore share most of their dates
def read_moment(rule: Moments, text: str, zone: tzinfo) -> float | None:
    """Return the moment that ``text`` means; None if the vendor calls the document malformed.

    ``zone`` is the host's time zone.  A date that Cyclone DDS cannot read is minus infinity: as a
    begin or an end it has always passed.
    """
    match rule:
        case Moments.LOCAL:
            return _local(text, zone)
        case Moments.CYCLONE:
            return _cyclone(text)
        case Moments.STANDARD:
            try:
                return parse_iso(text).timestamp()
            except ValueError:
                return None


def _local(text: str, zone: tzinfo) -> float | None:
    found = _LOCAL.match(text)
    if not found or (found[6] is None and found.end() < len(text)):
        return None
    year, month, day, hour, minute, second = (int(each or -1) for each in found.groups())
    if 0 in (month, day) or month > 12 or day > 31 or hour > 23 or minute > 59 or second > 60:
        return None
    # A missing month or day stays zero: January, or the last day of the month before.
    days = timedelta(days=max(day, 0) - 1)
    time = timedelta(hours=max(hour, 0), minutes=max(minute, 0), seconds=max(second, 0))
    try:
        wall = datetime(year, max(month, 1), 1) + days + time
        aware = wall.replace(tzinfo=zone)
        # tm_isdst stays 0, so that mktime takes standard time, in summer too.
        offset = (aware.utcoffset() or timedelta(0)) - (aware.dst() or timedelta(0))
    except (ValueError, OverflowError):
        return inf if year > 1 else -inf
    return timegm(wall.timetuple()) - offset.total_seconds()


def _cyclone(text: str) -> float:
    found = _CYCLONE.match(text)
    if not found:
        return -inf
    year, month, day, hour, minute, second = (int(found[index]) for index in range(1, 7))
    offset = timedelta(hours=int(found[9] or 0), minutes=int(found[10] or 0))
    if not 1970 <= year <= _LAST_YEAR or offset > _FARTHEST or int(found[10] or 0) > 59:
        return -inf
    try:
        moment = timegm(datetime(year, month, day, hour, minute, second).timetuple())
    except ValueError:
        return -inf
    seconds = moment + float(found[7] or 0)
    if found[8]:
        seconds -= offset.total_seconds() * (-1 if found[8] == "-" else 1)
    return seconds if 0 <= seconds < 2**63 / 1e9 else -inf
