"""Time zones by name, and that of this machine."""

from __future__ import annotations

import re
from collections.abc import Mapping
from datetime import UTC, datetime, timedelta, timezone, tzinfo
from pathlib import Path
from zoneinfo import ZoneInfo

from sros_tool.errors import UsageError

_OFFSET = re.compile(r"([+-])(\d\d):?(\d\d)\Z")
_LOCALTIME = Path("/etc/localtime")


def named_zone(name: str) -> tzinfo:
    """The zone of an IANA name (``Asia/Tokyo``) or an offset (``+09:00``)."""
    if match := _OFFSET.match(name):
        offset = timedelta(hours=int(match[2]), minutes=int(match[3]))
        if offset < timedelta(hours=24):
            return timezone(-offset if match[1] == "-" else offset)
    try:
        return ZoneInfo(name)
    except (ValueError, OSError, LookupError) as error:
        raise UsageError(
            f"{name!r} is not a time zone", "", "Write for example Asia/Tokyo, UTC or +09:00."
        ) from error


def local_zone(environment: Mapping[str, str]) -> tzinfo:
    """The zone of this machine, with its daylight saving where its name can be found."""
    name = environment.get("TZ", "").removeprefix(":")
    if not name and _LOCALTIME.exists():
        _, found, name = str(_LOCALTIME.resolve()).partition("zoneinfo/")
        name = name if found else ""
    try:
        return ZoneInfo(name)
    except (ValueError, OSError, LookupError):
        return datetime.now().astimezone().tzinfo or UTC
