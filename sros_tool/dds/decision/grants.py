"""The subjects of certificates to which a grant applies, and the dates of a grant, by vendor.

The subject of a certificate is given as the RFC 2253 text that OpenSSL and
`sros_tool.pki.certificates.subject_text` print, with the most specific attribute first.
"""

from __future__ import annotations

import re
from calendar import timegm
from collections.abc import Callable, Collection, Mapping
from datetime import datetime, timedelta, tzinfo
from functools import lru_cache, partial
from math import inf

from sros_tool.dds.decision.vendors import DateRule, Subjects, VendorTraits
from sros_tool.validity import parse_iso

_BLANK = ord(" ")
_MOST_PARTS = 20  # Cyclone DDS refuses a grant whose subject has more parts


class ComparisonCrash(Exception):  # noqa: N818
    """Raised if the vendor's process crashes when it compares two subjects."""


def same_subject(rule: Subjects, granted_subject: str, certified_subject: str) -> bool:
    """Return whether a grant for ``granted_subject`` applies to ``certified_subject``.

    Raises:
        ComparisonCrash: the comparison crashes the vendor's process.
    """
    return _COMPARE[rule](granted_subject, certified_subject)


def other_fitting_enclaves(
    traits: VendorTraits, certified: Mapping[str, str], granted: Mapping[str, Collection[str]]
) -> dict[str, tuple[str, ...]]:
    """Map an enclave to the other enclaves whose permissions also fit the enclave's certificate.

    ``certified`` maps enclaves to the subjects of their certificates, ``granted`` to the subjects
    of their grants. Enclaves for which no other permissions fit are left out.
    """
    plain = _PLAIN_PARTS.get(traits.subjects)
    if plain is None:  # the other rules compare the whole subject
        return {}
    having: dict[str, set[str]] = {}
    for name, subjects in granted.items():
        for part in {
            plain(attribute)
            for subject in subjects
            for attribute in _SEPARATORS.split(subject.strip())
        }:
            having.setdefault(part, set()).add(name)
    fitting_others = {}
    for name, subject in certified.items():
        text = certified_text(traits, subject)
        several = [having.get(plain(part), set()) for part in _SEPARATORS.split(text) if part]
        fitting = set.intersection(*sorted(several, key=len)) if several else set()
        other_holders = tuple(
            holder
            for holder in sorted(fitting - {name})
            if any(
                same_subject(traits.subjects, granted_subject.strip(), text)
                for granted_subject in granted[holder]
            )
        )
        if other_holders:
            fitting_others[name] = other_holders
    return fitting_others


def certified_text(traits: VendorTraits, subject: str) -> str:
    """Return the subject of a certificate in the form that the vendor compares."""
    if traits.escapes_subjects:
        return "".join(
            letter if letter.isascii() else "".join(f"\\{octet:02X}" for octet in letter.encode())
            for letter in subject
        )
    if traits.longest_subject is None:
        return subject
    return subject.encode()[: traits.longest_subject].decode(errors="surrogateescape")


def _same_attributes(granted_subject: str, certified_subject: str) -> bool:
    return _attributes(granted_subject) == _attributes(certified_subject)


def _same_parts(granted_subject: str, certified_subject: str) -> bool:
    """Return whether two subjects have equal parts between commas, ignoring blanks around parts.

    Escaped commas split as well.  A part of less than three bytes keeps some blanks.  Text after an
    empty part is ignored.  Source: Fast DDS 2.9.1, Permissions.cpp (rfc2253_string_compare).
    """
    ours, theirs = granted_subject.encode(), certified_subject.encode(errors="surrogateescape")
    our_start = their_start = 0
    our_end, their_end = _part_end(ours, 0), _part_end(theirs, 0)
    while our_start < our_end and their_start < their_end:
        if _trimmed(ours, our_start, our_end) != _trimmed(theirs, their_start, their_end):
            return False
        our_start, their_start = our_end + 1, their_end + 1
        our_end, their_end = _part_end(ours, our_start), _part_end(theirs, their_start)
    return our_start >= our_end and their_start >= their_end


def _trimmed(text: bytes, start: int, end: int) -> bytes:
    """Return ``text[start:end]`` with blanks at both ends removed as by Fast DDS 2.9.1.

    Blanks are removed on each side until two bytes are left.  In a part of less than two bytes,
    removal continues beyond the part.
    """
    last = end - 1
    try:
        while text[start] == _BLANK and start + 1 != last:
            start += 1
        while text[last] == _BLANK and last - 1 != start:
            last -= 1
            if last < 0:
                raise IndexError
    except IndexError as error:
        raise ComparisonCrash from error
    return text[start : last + 1] if last + 1 >= start else text[start:]


def _part_end(text: bytes, start: int) -> int:
    comma = text.find(b",", start)
    return len(text) if comma < 0 else comma


_MOST_ATTRIBUTES = 20  # Fast DDS 2.14 ignores attributes beyond these
_TEXT_BEFORE = {
    wanted: re.compile(rf'(?:\\.|"(?:\\.|[^"\\])*(?:"|\\?\Z)|[^"\\{wanted}])*', re.DOTALL)
    for wanted in "=,"
}
"""Character → pattern for the text before the character's first occurrence.

Occurrences in escapes and quotes do not count.
"""


def _same_in_any_order(granted_subject: str, certified_subject: str) -> bool:
    ours, theirs = _types_and_values(granted_subject), _types_and_values(certified_subject)
    first_values: dict[str, str] = {}
    for kind, value in theirs:
        first_values.setdefault(kind, value)
    # Fast DDS finds only the first value of a type, so a repeated type matches only if its values
    # are equal; a type that the certificate lacks counts as having an empty value.
    return len(ours) == len(theirs) and all(first_values.get(k, "") == v for k, v in ours)


def _types_and_values(subject: str) -> list[tuple[str, str]]:
    """Return types and values of a subject's attributes.

    The list ends before the first malformed attribute.  Source: Fast DDS 2.14,
    DistinguishedName.cpp.
    """
    pairs: list[tuple[str, str]] = []
    rest = subject.lstrip(" ")
    while rest and len(pairs) < _MOST_ATTRIBUTES:
        equals = _outside_quotes(rest, "=")
        if equals < 0:
            break
        # In Fast DDS, a substring of length zero means all text up to the end.
        kind, rest = rest[: equals or None], rest[equals + 1 :]
        comma = _outside_quotes(rest, ",")
        value = rest if comma < 0 else rest[: comma or None]
        pairs.append((_plain_subject(kind), _plain_subject(value)))
        rest = "" if comma < 0 else rest[comma + 1 :].lstrip(" ")
    return pairs


def _outside_quotes(text: str, wanted: str) -> int:
    """Return the index of the first ``wanted`` character outside of escapes and quotes, or -1."""
    before = _TEXT_BEFORE[wanted].match(text)
    end = before.end() if before else 0
    return end if text[end : end + 1] == wanted else -1


_PART = re.compile(r'(?:\\.|"(?:\\.|[^"\\])*"|[^,"\\])*', re.DOTALL)
_EQUALS = re.compile(r'(?:\\.|"(?:\\.|[^"\\])*"|[^="\\])*', re.DOTALL)


def _attributes(subject: str) -> list[tuple[str, str]]:
    """Return types and unescaped values of a subject's attributes.

    The list ends before the first malformed attribute.
    """
    attributes = []
    index = 0
    while index < len(subject):
        part = _PART.match(subject, index)
        text = part[0].strip(" ") if part else ""
        kind = _EQUALS.match(text)
        if not text or not kind or kind.end() >= len(text):
            break
        attributes.append((_plain_subject(kind[0]), _plain_subject(text[kind.end() + 1 :])))
        index += len(part[0]) + 1 if part else 1
    return attributes


def _plain_subject(text: str) -> str:
    return text.strip(" ").replace("\\", "").replace('"', "")


_SEPARATORS = re.compile(r"[,/|]")


def _grant_has_all_parts(
    granted_subject: str, certified_subject: str, *, normalize: Callable[[str], str] = str
) -> bool:
    parts = [normalize(part) for part in _SEPARATORS.split(granted_subject) if part]
    if len(parts) > _MOST_PARTS:
        return False
    values: dict[str, str] = {}
    for part in parts:
        kind, _, value = part.partition("=")
        values.setdefault(kind, value)
    wanted = _SEPARATORS.split(certified_subject)
    if wanted and not wanted[-1]:  # Cyclone DDS sees no empty part after a final separator
        wanted.pop()
    for part in wanted:
        kind, _, value = normalize(part).partition("=")
        if not part or values.get(kind) != value:
            return False
    return True


def _without_blanks(part: str) -> str:
    """Return a part of a subject (``NAME = VALUE``) without blanks around name and value."""
    return "=".join(text.strip(" ") for text in part.split("=", 1))


_PLAIN_PARTS: dict[Subjects, Callable[[str], str]] = {
    Subjects.SUBSET: str,
    Subjects.TRIMMED_SUBSET: _without_blanks,
}
"""Rule that splits subjects → function that normalizes a part."""

_COMPARE: dict[Subjects, Callable[[str, str], bool]] = {
    Subjects.EXACT: _same_attributes,
    Subjects.WHOLE_ATTRIBUTES: _same_parts,
    Subjects.ANY_ORDER: _same_in_any_order,
    Subjects.SUBSET: _grant_has_all_parts,
    Subjects.TRIMMED_SUBSET: partial(_grant_has_all_parts, normalize=_without_blanks),
}


# ── dates ──────────────────────────────────────────────────────────────────────────────────

_CYCLONE_DATE = re.compile(
    r"(\d{4})-(\d\d)-(\d\d)T(\d\d):(\d\d):(\d\d)(\.\d{1,12})?(?:Z|([+Z-])(\d\d):(\d\d))?\Z",
    re.ASCII,
)
# The form that std::get_time of libstdc++ reads with %Y-%m-%dT%H:%M:%S: the text may end after the
# year, the month or the day; one blank may precede the day; anything may follow the seconds.
_LOCAL_DATE = re.compile(
    r"\s*(\d{1,4})(?:-(\d\d?)(?:-\s?(\d\d?)(?:[Tt](\d\d?):(\d\d?):(\d\d?))?)?)?", re.ASCII
)
_LAST_YEAR = 2262  # the last year that 64 bits of nanoseconds can hold
_FARTHEST_ZONE = timedelta(hours=12)


@lru_cache(maxsize=64)  # the enclaves of a keystore share most of their dates
def read_date(rule: DateRule, text: str, zone: tzinfo) -> float | None:
    """Return the time of a date, in seconds since 1970; None for a malformed date.

    ``zone`` is the host's time zone.  A date that Cyclone DDS cannot read becomes minus infinity,
    so that it has always passed.
    """
    match rule:
        case DateRule.LOCAL:
            return _local_time(text, zone)
        case DateRule.CYCLONE:
            return _cyclone_time(text)
        case DateRule.STANDARD:
            try:
                return parse_iso(text).timestamp()
            except ValueError:
                return None


def _local_time(text: str, zone: tzinfo) -> float | None:
    match = _LOCAL_DATE.match(text)
    if not match or (match[6] is None and match.end() < len(text)):
        return None
    year, month, day, hour, minute, second = (int(group or -1) for group in match.groups())
    if 0 in (month, day) or month > 12 or day > 31 or hour > 23 or minute > 59 or second > 60:
        return None
    # A missing month counts as January, a missing day as the last day of the month before.
    days = timedelta(days=max(day, 0) - 1)
    time = timedelta(hours=max(hour, 0), minutes=max(minute, 0), seconds=max(second, 0))
    try:
        wall = datetime(year, max(month, 1), 1) + days + time
        aware = wall.replace(tzinfo=zone)
        # tm_isdst is 0, so mktime uses standard time, even in summer.
        offset = (aware.utcoffset() or timedelta(0)) - (aware.dst() or timedelta(0))
    except (ValueError, OverflowError):
        return inf if year > 1 else -inf
    return timegm(wall.timetuple()) - offset.total_seconds()


def _cyclone_time(text: str) -> float:
    match = _CYCLONE_DATE.match(text)
    if not match:
        return -inf
    year, month, day, hour, minute, second = (int(match[index]) for index in range(1, 7))
    offset = timedelta(hours=int(match[9] or 0), minutes=int(match[10] or 0))
    if not 1970 <= year <= _LAST_YEAR or offset > _FARTHEST_ZONE or int(match[10] or 0) > 59:
        return -inf
    try:
        moment = timegm(datetime(year, month, day, hour, minute, second).timetuple())
    except ValueError:
        return -inf
    seconds = moment + float(match[7] or 0)
    if match[8]:
        seconds -= offset.total_seconds() * (-1 if match[8] == "-" else 1)
    return seconds if 0 <= seconds < 2**63 / 1e9 else -inf
