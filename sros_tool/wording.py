"""Numbers and lists in words: "2 topics", "a, b and 3 more", "a, b and c"."""

from __future__ import annotations

import re
from collections.abc import Sequence

_NUMBER = re.compile(r"(\d+)")


def counted(number: int, noun: str, plural: str = "") -> str:
    """Return a number with its noun, like ``1 topic`` or ``2 topics``.

    ``plural`` is needed if the plural is not the noun with an *s*.
    """
    return f"{number} {noun if number == 1 else plural or f'{noun}s'}"


def first_few(
    texts: Sequence[str], maximum: int, separator: str = ", ", joint: str = " and ", noun: str = ""
) -> str:
    """Return at most ``maximum`` texts and the number of the others: "a, b and 3 more".

    With the ``noun`` "name", the number is "3 more names".
    """
    left_out = len(texts) - maximum
    number = counted(left_out, f"more {noun}") if noun else f"{left_out} more"
    return separator.join(texts[:maximum]) + (f"{joint}{number}" if left_out > 0 else "")


def capitalized(text: str) -> str:
    """Return a text that begins with a capital, as the start of a sentence."""
    return text[:1].upper() + text[1:]


def serial_text(serial: int) -> str:
    """Return a serial number as OpenSSL prints it: an even number of hexadecimal digits."""
    digits = f"{abs(serial):x}"
    return f"{'-' * (serial < 0)}{'0' * (len(digits) % 2)}{digits}"


def natural_sort_key(name: str) -> list[tuple[int, str]]:
    """Return the key that sorts r2 before r10."""
    return [(int(part or 0), "") if part.isdigit() else (0, part) for part in _NUMBER.split(name)]


def shortened(value: object) -> str:
    """Return ``repr(value)``, cut after 80 characters."""
    text = repr(value)
    return text if len(text) <= 80 else f"{text[:80]}..."


def enumerated(texts: Sequence[str]) -> str:
    """Return all texts as in a sentence: "a, b and c"."""
    *first, last = texts
    return f"{', '.join(first)} and {last}" if first else last


def perhaps_meant(names: Sequence[str]) -> str:
    """Return the end of a sentence that has named one or several similar names."""
    return "perhaps the right name" if len(names) == 1 else "perhaps one of them is the right name"
