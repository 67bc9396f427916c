"""Markdown for code hosts, of limited length, in which untrusted names stay plain text.

A name in a policy or the path of a file can be anything that whoever opened the pull request wants
to be seen: a link, an image, a mention of a user, the end of a comment.  As a code span or in a
fenced block it is none of these (CommonMark 0.31, 6.1 and 4.5; GitHub Flavored Markdown 0.29).
"""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Iterable

_LONGEST = 400
_RUNS = re.compile(r"`+")
_PUNCTUATION = re.compile(r"([\\`*_\[\]<>#~|!&@])")


def code(text: str) -> str:
    """Return ``text`` as a code span on one line, cut if it is long."""
    shown = _visible_line(text if len(text) <= _LONGEST else f"{text[:_LONGEST]}...")
    ticks = "`" * _ticks(shown)
    return f"{ticks} {shown or ' '} {ticks}" if len(ticks) > 1 or not shown else f"`{shown}`"


def plain(text: str) -> str:
    """Return ``text`` with Markdown markup escaped."""
    return _PUNCTUATION.sub(r"\\\1", _visible_line(text))


def fenced(text: str, language: str = "text") -> str:
    """Return ``text`` as a fenced block; the fence is longer than any backtick run in ``text``."""
    fence = "`" * max(3, _ticks(text))
    lines = "\n".join(map(_visible_line, text.rstrip("\n").split("\n")))
    return f"{fence}{language}\n{lines}\n{fence}"


def bounded_list(items: Iterable[str], maximum: int, shown_by: str) -> str:
    """Return ``items`` as a Markdown list of at most ``maximum`` characters.

    A last item counts those that do not fit, followed by ``shown_by``, a clause that says where to
    read them.
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


def _ticks(text: str) -> int:
    """Return the number of backticks that safely delimit ``text``, which may contain backticks."""
    return max((len(run) for run in _RUNS.findall(text)), default=0) + 1


_BLANK = "\u115f\u1160\u2800\u3164\uffa0\U0001d159"
"""Printable characters that are invisible."""


def _visible_line(text: str) -> str:
    """Return ``text`` on one line, with invisible and unprintable characters escaped."""
    return "".join(
        character if _is_seen(character) else f"\\x{ord(character):02x}" for character in text
    )


def _is_seen(character: str) -> bool:
    if character.isascii():
        return character.isprintable()
    marks = unicodedata.category(character).startswith("M")  # on the character before
    return character.isprintable() and not marks and character not in _BLANK
