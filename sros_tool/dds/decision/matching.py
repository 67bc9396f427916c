"""Matching names against a vendor's expressions: fnmatch of glibc, or Cyclone DDS's own loop."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Sequence
from functools import lru_cache

from sros_tool.dds.decision.vendors import Style

_Matcher = Callable[[str], object]
"""A function of a name; its result is truthy if the name matches."""

_SPECIAL = frozenset("*?[")
"""Wildcard characters: every vendor takes an expression without them literally."""

_BEFORE_SPECIAL = re.compile(r"[^*?\[]*")


@lru_cache(maxsize=65536)
def _matcher(style: Style, expression: str) -> _Matcher | None:
    """Return a function that tells whether names match; None if only ``expression`` itself does."""
    if _SPECIAL.isdisjoint(expression):
        return None
    segments = [""]  # the text between stars
    for pattern in _patterns(style, expression):
        if pattern:
            segments[-1] += pattern
        elif segments[-1] or len(segments) == 1:
            segments.append("")
    return re.compile(_joined_regex(segments) + r"\Z", re.DOTALL).match


def _patterns(style: Style, expression: str) -> Iterable[str]:
    """Return a regular expression for each character of an expression, and "" for ``*``.

    Vendors differ only in how they read sets of characters.
    """
    if "[" in expression:
        from sros_tool.dds.decision.expressions import pattern_of, pieces_of

        pieces = pieces_of(style, expression)
        return ["" if piece is None else pattern_of(piece) for piece in pieces]
    return ["" if char == "*" else "." if char == "?" else re.escape(char) for char in expression]


def _joined_regex(segments: list[str]) -> str:
    """Return one regular expression for parts of an expression that ``*`` separates.

    Each part matches a fixed number of characters, so its first match is as good as a later one.
    The atomic group tries only that one; otherwise many stars would take exponential time.
    """
    first, *rest = segments
    if not rest:
        return first
    *middle, last = rest
    return first + "".join(f"(?>.*?{part})" for part in middle) + ".*" + last


def matches(style: Style, expression: str, name: str) -> bool:
    """Return whether ``name`` matches ``expression``."""
    match = _matcher(style, expression)
    return expression == name if match is None else bool(match(name))


class ExpressionIndex:
    """An index of a list of expressions, to find those that match a name.

    An expression without wildcards is looked up by the name, any other by the text before its first
    wildcard.  So a search in thousands of expressions takes little longer than one comparison.
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
        places = self._plain.get(name, [])
        for length, by_prefix in self._wild:
            candidates = by_prefix.get(name[:length])
            if candidates:
                places = places + [place for place, match in candidates if match(name)]
        return sorted(places)

    def first(self, name: str) -> int | None:
        """Return the position of the first expression that matches ``name``."""
        matching_numbers = self.matching(name)
        return matching_numbers[0] if matching_numbers else None

    def _either_way(self, name: str) -> Sequence[int]:
        return [
            position
            for position, text in enumerate(self._texts)
            if matches(self._style, text, name) or matches(self._style, name, text)
        ]
