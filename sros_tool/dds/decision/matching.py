"""Comparing expressions with topics, grants with subjects, and dates with moments, by vendor.

A certificate's subject is the RFC 2253 text that OpenSSL and
`sros_tool.pki.certificates.subject_text` print, with the most specific attribute first.
"""

from __future__ import annotations

import re
from calendar import timegm
from collections.abc import Callable, Iterable, Sequence
from datetime import datetime, timedelta, tzinfo
from functools import lru_cache
from itertools import takewhile
from math import inf

from sros_tool.dds.decision.vendors import Moments, Style, Subjects
from sros_tool.validity import parse_iso

_Matcher = Callable[[str], object]
"""Truthy if a name matches."""

_SPECIAL = frozenset("*?[")
"""An expression without any of these means itself, for every vendor."""

_BEFORE_SPECIAL = re.compile(r"[^*?\[]*")
_NEVER = "(?!)"
_CLASS = re.compile(r"\[:([a-y]*):\]")
_EQUIVALENT = re.compile(r"\[=(.)=\]", re.DOTALL)
_CLASSES = {
    "alnum": "0-9A-Za-z",
    "alpha": "A-Za-z",
    "blank": " \\t",
    "cntrl": "\\x00-\\x1f\\x7f",
    "digit": "0-9",
    "graph": "!-~",
    "lower": "a-z",
    "print": " -~",
    "punct": "!-/:-@\\[-`{-~",
    "space": " \\t-\\r",
    "upper": "A-Z",
    "xdigit": "0-9A-Fa-f",
}


@lru_cache(maxsize=65536)
def _matcher(style: Style, expression: str) -> _Matcher | None:
    """Return a function that matches names; None if ``expression`` matches only itself."""
    if _SPECIAL.isdisjoint(expression):
        return None
    take_set = _fnmatch_set if style is Style.FNMATCH else _cyclone_set
    segments = [""]  # the text between stars
    index = 0
    while index < len(expression):
        char = expression[index]
        index += 1
        if char == "*":
            if segments[-1] or len(segments) == 1:
                segments.append("")
        elif char == "?":
            segments[-1] += "."
        elif char == "[":
            part, index = take_set(expression, index)
            segments[-1] += part
        else:
            segments[-1] += re.escape(char)
    return re.compile(_joined(segments) + r"\Z", re.DOTALL).match


def _joined(segments: list[str]) -> str:
    """Return the pattern for the segments between stars.

    Each segment matches a fixed number of characters, so the first fit is as good as a later one.
    The atomic group tries only that one; otherwise many stars would take exponential time.
    """
    first, *rest = segments
    if not rest:
        return first
    *middle, last = rest
    return first + "".join(f"(?>.*?{each})" for each in middle) + ".*" + last


def matches(style: Style, expression: str, name: str) -> bool:
    """Return whether ``name`` matches ``expression``."""
    match = _matcher(style, expression)
    return expression == name if match is None else bool(match(name))


class ExpressionIndex:
    """Ordered expressions, and a fast answer to the question which of them match a name.

    Plain ones are looked up by the name, wildcards by the text before the first wildcard,
    so that thousands of them cost little more than one.
    """

    def __init__(self, style: Style, texts: Iterable[str], *, both_ways: bool = False) -> None:
        self._style = style
        self._texts = tuple(texts)
        self._both_ways = both_ways
        self._plain: dict[str, list[int]] = {}
        wild: dict[int, dict[str, list[tuple[int, _Matcher]]]] = {}
        for position, text in enumerate(self._texts):
            match = _matcher(style, text)
            if match is None:
                self._plain.setdefault(text, []).append(position)
                continue
            before = _BEFORE_SPECIAL.match(text)
            prefix = before[0] if before else ""
            wild.setdefault(len(prefix), {}).setdefault(prefix, []).append((position, match))
        self._wild = tuple(wild.items())

    def matching(self, name: str) -> Sequence[int]:
        """Return the positions of the expressions that match ``name``, in order."""
        if self._both_ways and not _SPECIAL.isdisjoint(name):
            return self._either_way(name)
        found = self._plain.get(name, [])
        for length, by_prefix in self._wild:
            candidates = by_prefix.get(name[:length])
            if candidates:
                found = found + [place for place, match in candidates if match(name)]
        return sorted(found)

    def first(self, name: str) -> int | None:
        """Return the position of the first expression that matches ``name``."""
        found = self.matching(name)
        return found[0] if found else None

    def _either_way(self, name: str) -> Sequence[int]:
        return [
            position
            for position, text in enumerate(self._texts)
            if matches(self._style, text, name) or matches(self._style, name, text)
        ]


def _set_of(members: list[str], negated: bool) -> str:
    if not members:
        return "." if negated else _NEVER
    return f"[{'^' if negated else ''}{''.join(members)}]"


def _fnmatch_set(text: str, start: int) -> tuple[str, int]:
    """Return the set after ``[`` as glibc reads it, and the index after the set.

    After an unknown class or symbol, and after a range without its end, no further character
    matches.  In all other cases, or if ``[`` was in it before, an unclosed set is a plain ``[``.
    """
    index = start
    negated = text[index : index + 1] in ("!", "^")
    index += negated
    members: list[str] = []
    goes_on = True
    first = True
    while index < len(text):
        if text[index] == "]" and not first:
            return (_set_of(members, negated) if goes_on or not negated else _NEVER), index + 1
        first = False
        if found := _CLASS.match(text, index):
            low = high = _CLASSES.get(found[1])
            index = found.end()
        elif found := _EQUIVALENT.match(text, index):
            low = high = re.escape(found[1])
            index = found.end()
        else:
            low, index = _member(text, index)
            high = low
            if text[index : index + 1] == "-" and text[index + 1 : index + 2] != "]":
                high, index = _member(text, index + 1)
        goes_on = goes_on and low is not None and high is not None
        if goes_on and low is high:
            members.append(low or "")
        elif goes_on and low and high and low[-1] <= high[-1]:
            members.append(f"{low}-{high}")
    opening = re.escape("[")
    return (opening if goes_on or opening in members else _NEVER), start


def _member(text: str, index: int) -> tuple[str | None, int]:
    """Return one character of a set, also if written ``[.a.]``, for a pattern; None without one."""
    if text[index : index + 2] != "[.":
        return (re.escape(text[index]) if index < len(text) else None), index + 1
    end = text.find(".]", index + 2)
    if end < 0:
        return None, len(text)
    return (re.escape(text[index + 2]) if end == index + 3 else None), end + 2


def _cyclone_set(text: str, start: int) -> tuple[str, int]:
    """Return the set after ``[`` as Cyclone DDS 0.10 reads it, and the index after the set.

    Its loop takes the closing bracket for a member before it ends, and looks for a range there,
    too: ``[ab]`` also matches ``]``, and ``[ab]-x`` is one set with the range ``]`` to ``x``.
    """
    index = start
    negated = text[index : index + 1] == "!"
    index += negated
    members: list[str] = []
    last = text[index : index + 1]
    while last != "]":
        last = text[index : index + 1]
        if not last:
            return _NEVER, len(text)
        if text[index + 1 : index + 2] == "-":
            high = text[index + 2 : index + 3]
            if high in ("", "]"):
                return _NEVER, len(text)
            if last <= high:
                members.append(f"{re.escape(last)}-{re.escape(high)}")
            index += 2
        else:
            members.append(re.escape(last))
        index += 1
    return _set_of(members, negated), index


_MOST_PARTS = 20  # Cyclone DDS 0.10 refuses a grant's subject of more


def same_subject(rule: Subjects, granted: str, certified: str) -> bool:
    """Return whether a grant for ``granted`` applies to the certificate subject ``certified``."""
    return _COMPARE[rule](granted, certified)


def escaped(certified: str) -> str:
    """Return the subject of a certificate with every non-ASCII byte as ``\\C3``."""
    parts = (
        each if each.isascii() else "".join(f"\\{b:02X}" for b in each.encode())
        for each in certified
    )
    return "".join(parts)


def _exact(granted: str, certified: str) -> bool:
    return _attributes(granted) == _attributes(certified)


def _whole_attributes(granted: str, certified: str) -> bool:
    # Fast DDS 2.9 splits at every comma, also at an escaped one.
    return _stripped(granted) == _stripped(certified)


def _stripped(name: str) -> list[str]:
    # It stops at the first empty part: text after two commas does not count.
    return [part.strip(" ") for part in takewhile(bool, name.split(","))]


_MOST_ATTRIBUTES = 20  # the ones that Fast DDS 2.14 uses
_UNQUOTED = re.compile(r'(?:\\.|"(?:\\.|[^"\\])*(?:"|\\?\Z)|[^"\\])', re.DOTALL)


def _any_order(granted: str, certified: str) -> bool:
    ours, theirs = _types_and_values(granted), _types_and_values(certified)
    first_values: dict[str, str] = {}
    for kind, value in theirs:
        first_values.setdefault(kind, value)
    # Only the first value of a kind is found, so a repeated kind never matches; a kind that the
    # certificate lacks has an empty value.
    return len(ours) == len(theirs) and all(first_values.get(k, "") == v for k, v in ours)


def _types_and_values(name: str) -> list[tuple[str, str]]:
    """Return the attributes before a malformed one, as Fast DDS 2.14 (DistinguishedName.cpp)."""
    found: list[tuple[str, str]] = []
    rest = name.lstrip(" ")
    while rest and len(found) < _MOST_ATTRIBUTES:
        equals = _outside_quotes(rest, "=")
        if equals < 0:
            break
        # An empty cut means: up to the end of the text.
        kind, rest = rest[: equals or None], rest[equals + 1 :]
        comma = _outside_quotes(rest, ",")
        value = rest if comma < 0 else rest[: comma or None]
        found.append((_plain(kind), _plain(value)))
        rest = "" if comma < 0 else rest[comma + 1 :].lstrip(" ")
    return found


def _outside_quotes(text: str, wanted: str) -> int:
    """Return the index of the first such character outside of escapes and quotes, else -1."""
    index = 0
    while index < len(text):
        found = _UNQUOTED.match(text, index)
        if not found:
            break
        if found[0] == wanted:
            return index
        index = found.end()
    return -1


_PART = re.compile(r'(?:\\.|"(?:\\.|[^"\\])*"|[^,"\\])*', re.DOTALL)
_EQUALS = re.compile(r'(?:\\.|"(?:\\.|[^"\\])*"|[^="\\])*', re.DOTALL)


def _attributes(name: str) -> list[tuple[str, str]]:
    """Return kinds and plain values (no quotes, escapes, outer spaces) before a malformed one."""
    found = []
    index = 0
    while index < len(name):
        part = _PART.match(name, index)
        text = part[0].strip(" ") if part else ""
        kind = _EQUALS.match(text)
        if not text or not kind or kind.end() >= len(text):
            break
        found.append((_plain(kind[0]), _plain(text[kind.end() + 1 :])))
        index += len(part[0]) + 1 if part else 1
    return found


def _plain(text: str) -> str:
    return text.strip(" ").replace("\\", "").replace('"', "")


def _subset(granted: str, certified: str) -> bool:
    parts = [part for part in re.split(r"[,/|]", granted) if part]
    if len(parts) > _MOST_PARTS:
        return False
    values: dict[str, str] = {}
    for part in parts:
        kind, _, value = part.partition("=")
        values.setdefault(kind, value)
    wanted = re.split(r"[,/|]", certified)
    if wanted and not wanted[-1]:  # no empty part after a last separator
        wanted.pop()
    for part in wanted:
        kind, _, value = part.partition("=")
        if not part or values.get(kind) != value:
            return False
    return True


_COMPARE: dict[Subjects, Callable[[str, str], bool]] = {
    Subjects.EXACT: _exact,
    Subjects.WHOLE_ATTRIBUTES: _whole_attributes,
    Subjects.ANY_ORDER: _any_order,
    Subjects.SUBSET: _subset,
}


_CYCLONE = re.compile(
    r"(\d{4})-(\d\d)-(\d\d)T(\d\d):(\d\d):(\d\d)(\.\d{1,12})?(?:Z|([+-])(\d\d):(\d\d))?\Z", re.ASCII
)
# std::get_time of libstdc++ with %Y-%m-%dT%H:%M:%S: the text may end after the year, the month or
# the day; one blank may precede the day; anything may follow the seconds.
_LOCAL = re.compile(
    r"\s*(\d{1,4})(?:-(\d\d?)(?:-\s?(\d\d?)(?:[Tt](\d\d?):(\d\d?):(\d\d?))?)?)?", re.ASCII
)
_LAST_YEAR = 2262  # of 64 bits of nanoseconds
_FARTHEST = timedelta(hours=12)


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
