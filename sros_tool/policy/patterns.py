"""What the wildcards of names mean: which names they match, cover and share with each other.

``*`` stands for any characters, "/" among them, ``?`` for one, ``[abc]``, ``[a-c]`` and ``[!a-c]``
for one of a set or outside of it: glibc's fnmatch without escapes, as the DDS vendors match.
"""

from __future__ import annotations

import re
from fnmatch import translate
from functools import lru_cache

from sros_tool.names import is_expression

_MANY = 4096
_WILDCARD = re.compile(r"[*?\[]")
_PIECE = re.compile(r"\*+|\?|\[(!?)([^\]]+)\]|(.)", re.DOTALL)
_RANGE = re.compile(r"(.)-(.)|(.)", re.DOTALL)
_ALPHABET = frozenset(map(chr, range(33, 127)))  # wider than ROS names: DDS topics may be foreign
ANY: frozenset[str] = frozenset()
"""Stands for ``*`` among the pieces of a pattern."""


@lru_cache(maxsize=_MANY)
def compiled(expression: str) -> re.Pattern[str]:
    """The regular expression that matches the same names."""
    return re.compile(translate(expression))


def matches(expression: str, name: str) -> bool:
    """Whether ``name``, which has no wildcards, is meant by ``expression``."""
    return compiled(expression).match(name) is not None


def literal_prefix(expression: str) -> str:
    """The characters before the first wildcard."""
    return _WILDCARD.split(expression, maxsplit=1)[0]


def covers(wide: str, narrow: str) -> bool:
    """Whether everything that ``narrow`` means is also meant by ``wide``.

    True is always right.  Exotic patterns such as ``?*`` and ``*?`` mean the same and yet do not
    cover each other here; whoever relies on that keeps a rule too many, never one too few.
    """
    if wide == narrow:
        return True
    if not is_expression(wide):
        return False
    if not is_expression(narrow):
        return matches(wide, narrow)
    return narrow.startswith(literal_prefix(wide)) and _covers(wide, narrow)


@lru_cache(maxsize=_MANY)
def _covers(wide: str, narrow: str) -> bool:
    outer, inner = pieces(wide), pieces(narrow)
    # reached[i]: the first i pieces of outer cover the pieces of inner that were seen so far.
    reached = _after_stars({0}, outer)
    for piece in inner:
        following = {i for i in reached if i < len(outer) and outer[i] is ANY}
        if piece is not ANY:
            following |= {
                i + 1
                for i in reached
                if i < len(outer) and outer[i] is not ANY and piece <= outer[i]
            }
        reached = _after_stars(following, outer)
    return len(outer) in reached


def overlap(one: str, other: str) -> bool:
    """Whether some name is meant by both."""
    if not is_expression(one):
        return matches(other, one) if is_expression(other) else one == other
    if not is_expression(other):
        return matches(one, other)
    shorter, longer = sorted((literal_prefix(one), literal_prefix(other)), key=len)
    return longer.startswith(shorter) and _overlap(one, other)


@lru_cache(maxsize=_MANY)
def _overlap(one: str, other: str) -> bool:
    first, second = pieces(one), pieces(other)
    seen: set[tuple[int, int]] = set()
    states = [(0, 0)]
    while states:
        state = states.pop()
        if state in seen:
            continue
        seen.add(state)
        i, j = state
        if i == len(first) and j == len(second):
            return True
        here = first[i] if i < len(first) else None
        there = second[j] if j < len(second) else None
        if here is ANY:
            states.append((i + 1, j))
            if there is not None:
                states.append((i, j + 1))
        if there is ANY:
            states.append((i, j + 1))
            if here is not None:
                states.append((i + 1, j))
        if here and there and not here.isdisjoint(there):
            states.append((i + 1, j + 1))
    return False


def _after_stars(reached: set[int], pieces: tuple[frozenset[str], ...]) -> set[int]:
    """The places reached when stars that follow stand for nothing."""
    grown = set(reached)
    for i in sorted(reached):
        while i < len(pieces) and pieces[i] is ANY:
            i += 1
            grown.add(i)
    return grown


@lru_cache(maxsize=_MANY)
def pieces(expression: str) -> tuple[frozenset[str], ...]:
    """An expression piece by piece: `ANY` for ``*``, else the characters that fit one place."""
    found: list[frozenset[str]] = []
    for piece in _PIECE.finditer(expression):
        negated, members, literal = piece.groups()
        if literal is not None:
            found.append(frozenset(literal))
        elif members is not None:
            chosen = _members(members)
            found.append(_ALPHABET - chosen if negated else chosen)
        else:
            found.append(_ALPHABET if piece[0] == "?" else ANY)
    return tuple(found)


def _members(text: str) -> frozenset[str]:
    chosen: set[str] = set()
    for low, high, single in _RANGE.findall(text):
        chosen.update([single] if single else map(chr, range(ord(low), ord(high) + 1)))
    return frozenset(chosen)
