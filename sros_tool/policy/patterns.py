"""Expressions with wildcards: which names they match, and whether they cover or overlap others.

``*`` matches any characters, also "/"; ``?`` matches one character; ``[abc]`` and ``[a-c]`` match
one character of a set, ``[!a-c]`` one that is not in it.  This is fnmatch of glibc without escapes,
as the DDS vendors match.

`overlap` compares two expressions.  `common_name` compares any number, also with exceptions, and
returns an example; it only considers valid absolute ROS names.
"""

from __future__ import annotations

import re
from collections import deque
from collections.abc import Iterable, Iterator
from fnmatch import translate
from functools import lru_cache
from string import ascii_letters, digits

from sros_tool.names import is_expression

_MANY = 4096
_WILDCARD = re.compile(r"[*?\[]")
_PIECE = re.compile(r"\*+|\?|\[(!?)([^\]]+)\]|(.)", re.DOTALL)
_RANGE = re.compile(r"(.)-(.)|(.)", re.DOTALL)
_ALPHABET = frozenset(map(chr, range(33, 127)))  # wider than ROS names: DDS topics may be foreign
_ANY: frozenset[str] = frozenset()
"""The piece of a pattern that means ``*``."""


@lru_cache(maxsize=_MANY)
def compiled(expression: str) -> re.Pattern[str]:
    """Return the regular expression that matches the same names as ``expression``."""
    return re.compile(translate(expression))


def matches(expression: str, name: str) -> bool:
    """Return whether ``expression`` matches ``name``, which has no wildcards."""
    return compiled(expression).match(name) is not None


def literal_prefix(expression: str) -> str:
    """Return the characters before the first wildcard."""
    return _WILDCARD.split(expression, maxsplit=1)[0]


def covers(wide: str, narrow: str) -> bool:
    """Return whether ``wide`` matches every name that ``narrow`` matches.

    True is always correct.  False can be wrong for unusual expressions: ``?*`` and ``*?`` match the
    same names, but do not cover each other here.  Callers then keep a redundant rule.
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
    outer, inner = _pieces(wide), _pieces(narrow)
    # reached[i]: the first i pieces of outer cover the pieces of inner that were seen so far.
    reached = _after_stars({0}, outer)
    for piece in inner:
        following = {i for i in reached if i < len(outer) and outer[i] is _ANY}
        if piece is not _ANY:
            following |= {
                i + 1
                for i in reached
                if i < len(outer) and outer[i] is not _ANY and piece <= outer[i]
            }
        reached = _after_stars(following, outer)
    return len(outer) in reached


def overlap(one: str, other: str) -> bool:
    """Return whether some name matches both expressions."""
    if not is_expression(one):
        return matches(other, one) if is_expression(other) else one == other
    if not is_expression(other):
        return matches(one, other)
    shorter, longer = sorted((literal_prefix(one), literal_prefix(other)), key=len)
    return longer.startswith(shorter) and _overlap(one, other)


@lru_cache(maxsize=_MANY)
def _overlap(one: str, other: str) -> bool:
    first, second = _pieces(one), _pieces(other)
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
        if here is _ANY:
            states.append((i + 1, j))
            if there is not None:
                states.append((i, j + 1))
        if there is _ANY:
            states.append((i, j + 1))
            if here is not None:
                states.append((i + 1, j))
        if here and there and not here.isdisjoint(there):
            states.append((i + 1, j + 1))
    return False


def _after_stars(reached: set[int], pieces: tuple[frozenset[str], ...]) -> set[int]:
    """Return ``reached`` and the positions after stars, which can match nothing."""
    grown = set(reached)
    for i in sorted(reached):
        while i < len(pieces) and pieces[i] is _ANY:
            i += 1
            grown.add(i)
    return grown


@lru_cache(maxsize=_MANY)
def _pieces(expression: str) -> tuple[frozenset[str], ...]:
    """Return the pieces of an expression: `_ANY` for ``*``, else the set of matching characters."""
    found: list[frozenset[str]] = []
    for piece in _PIECE.finditer(expression):
        negated, members, literal = piece.groups()
        if literal is not None:
            found.append(frozenset(literal))
        elif members is not None:
            chosen = _members(members)
            found.append(_ALPHABET - chosen if negated else chosen)
        else:
            found.append(_ALPHABET if piece[0] == "?" else _ANY)
    return tuple(found)


def _members(text: str) -> frozenset[str]:
    chosen: set[str] = set()
    for low, high, single in _RANGE.findall(text):
        chosen.update([single] if single else map(chr, range(ord(low), ord(high) + 1)))
    return frozenset(chosen)


_LETTERS = ascii_letters + digits + "_/"
_MOST_STATES = 5_000
_START, _SLASH, _TOKEN = range(3)
"""Positions in a ROS name: before its start, after a "/", or within one of its parts."""

_Pieces = tuple[frozenset[str], ...]
_State = tuple[int, tuple[frozenset[int], ...]]


def common_name(
    wanted: Iterable[str], unwanted: Iterable[str] = (), *, absolute: bool = True
) -> str | None:
    """Return the shortest absolute ROS name that all of ``wanted`` and none of ``unwanted`` match.

    Without ``absolute``, the name has no leading "/", like DDS topics.  Returns None if there is no
    such name.  If the search gets too large (many ``?`` after ``*``), ``unwanted`` is ignored, so
    that no overlap is missed.
    """
    inner, outer = tuple(dict.fromkeys(wanted)), tuple(dict.fromkeys(unwanted))
    for name in inner:
        if not is_expression(name):
            others = (each for each in inner if each != name)
            fits = all(matches(each, name) for each in others)
            return name if fits and not any(matches(each, name) for each in outer) else None
    return _search(inner, outer, _START if absolute else _SLASH)


@lru_cache(maxsize=4096)
def _search(wanted: tuple[str, ...], unwanted: tuple[str, ...], begin: int) -> str | None:
    patterns = [_pieces(each) for each in (*wanted, *unwanted)]
    alphabet = _representatives(patterns)
    start: _State = (begin, tuple(_closed({0}, each) for each in patterns))
    before: dict[_State, tuple[_State, str] | None] = {start: None}
    queue = deque([start])
    while queue:
        state = queue.popleft()
        if len(before) > _MOST_STATES:
            return _search(wanted, (), begin) if unwanted else wanted[0]
        place, reached = state
        if place == _TOKEN and _fits(reached, patterns, len(wanted)):
            return _spelt(state, before)
        for letter in alphabet:
            following = _after(place, letter)
            if following is None:
                continue
            moved = tuple(
                _step(at, letter, pattern) for at, pattern in zip(reached, patterns, strict=True)
            )
            new = (following, moved)
            if all(moved[: len(wanted)]) and new not in before:
                before[new] = (state, letter)
                queue.append(new)
    return None


def _fits(reached: tuple[frozenset[int], ...], patterns: list[_Pieces], wanted: int) -> bool:
    ended = [len(pattern) in at for at, pattern in zip(reached, patterns, strict=True)]
    return all(ended[:wanted]) and not any(ended[wanted:])


def _spelt(state: _State, before: dict[_State, tuple[_State, str] | None]) -> str:
    letters = []
    while (step := before[state]) is not None:
        state, letter = step
        letters.append(letter)
    return "".join(reversed(letters))


def _representatives(patterns: list[_Pieces]) -> str:
    """Return one letter for each set of letters that patterns and ROS names treat alike."""
    special = {piece for pattern in patterns for piece in pattern if piece is not _ANY}
    kinds: dict[tuple[object, ...], str] = {}
    for letter in _LETTERS:
        kind = (letter == "/", letter in digits, *(letter in piece for piece in special))
        kinds.setdefault(kind, letter)
    return "".join(kinds.values())


def _after(place: int, letter: str) -> int | None:
    """Return the position in a name after the letter; None if the letter is not allowed."""
    if letter == "/":
        return None if place == _SLASH else _SLASH
    if place == _START or (place == _SLASH and letter in digits):
        return None
    return _TOKEN


def _step(reached: frozenset[int], letter: str, pattern: _Pieces) -> frozenset[int]:
    following = set()
    for at in reached:
        if at == len(pattern):
            continue
        if pattern[at] is _ANY:
            following.add(at)
        elif letter in pattern[at]:
            following.add(at + 1)
    return _closed(following, pattern)


def _closed(reached: set[int], pattern: _Pieces) -> frozenset[int]:
    """Return the ``reached`` positions and the positions after stars that match nothing."""
    return frozenset(place for at in reached for place in _onward(at, pattern))


def _onward(at: int, pattern: _Pieces) -> Iterator[int]:
    yield at
    while at < len(pattern) and pattern[at] is _ANY:
        at += 1
        yield at
