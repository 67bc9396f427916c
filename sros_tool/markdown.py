"""Markdown for code hosts, of limited length, in which untrusted names stay plain text.

Whoever opens a pull request chooses the names in policies and the paths of files.  Such a name can
be a link, an image, a mention of a user, or the end of a comment.  In a code span or a fenced
block, the name is only text (CommonMark 0.31, 6.1 and 4.5; GitHub Flavored Markdown 0.29).
"""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Iterable

_LONGEST_SPAN = 400
_BACKTICK_RUNS = re.compile(r"`+")
_PUNCTUATION = re.compile(r"([\\`*_\[\]<>#~|!&@])")


def code(text: str) -> str:
    """Return ``text`` as a code span on one line, cut if it is long."""
    shown = _visible_line(text if len(text) <= _LONGEST_SPAN else f"{text[:_LONGEST_SPAN]}...")
    ticks = "`" * _delimiter_length(shown)
    return f"{ticks} {shown or ' '} {ticks}" if len(ticks) > 1 or not shown else f"`{shown}`"


def plain(text: str) -> str:
    """Return ``text`` with Markdown markup escaped."""
    return _PUNCTUATION.sub(r"\\\1", _visible_line(text))


def fenced(text: str, language: str = "text") -> str:
    """Return ``text`` as a fenced block; the fence is longer than any backtick run in ``text``."""
    fence = "`" * max(3, _delimiter_length(text))
    lines = "\n".join(map(_visible_line, text.rstrip("\n").split("\n")))
    return f"{fence}{language}\n{lines}\n{fence}"


def bounded_list(items: Iterable[str], maximum: int, shown_by: str) -> str:
    """Return ``items`` as a Markdown list of at most ``maximum`` characters.

    If some items do not fit, a further item has their number, followed by ``shown_by``, a clause
    that says where all items are shown. The further item may exceed the maximum.
    """
    lines: list[str] = []
    left, out = maximum, 0
    for item in items:
        left -= len(item) + 3
        if left < 0:
            out += 1
        else:
            lines.append(f"- {item}")
    if out:
        lines.append(f"- and {out} more, {shown_by}")
    return "\n".join(lines)


def _delimiter_length(text: str) -> int:
    """Return the number of backticks that safely delimit ``text``, which may contain backticks."""
    return max((len(run) for run in _BACKTICK_RUNS.findall(text)), default=0) + 1


_BLANK_CHARACTERS = "\u115f\u1160\u2800\u3164\uffa0\U0001d159"
"""Printable characters that are invisible."""


def _visible_line(text: str) -> str:
    """Return ``text`` on one line, with invisible and unprintable characters escaped."""
    return "".join(
        character if _is_visible(character) else f"\\x{ord(character):02x}" for character in text
    )


def _is_visible(character: str) -> bool:
    if character.isascii():
        return character.isprintable()
    marks = unicodedata.category(character).startswith("M")  # on the character before
    return character.isprintable() and not marks and character not in _BLANK_CHARACTERS
