"""Finds a name that some expressions have in common and others leave out, or that there is none.

What `patterns.overlap` answers for two expressions, for any number, with exceptions, and with a
name to show for it.  Names are absolute ROS names: an overlap that no ROS name can have is none.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator
from functools import lru_cache
from string import ascii_letters, digits

from sros_tool.names import is_expression
from sros_tool.policy.patterns import ANY, matches, pieces

_LETTERS = ascii_letters + digits + "_/"
_MOST_STATES = 5_000
_START, _SLASH, _TOKEN = range(3)
"""Where in a ROS name one is: nowhere yet, behind a "/", or within one of its parts."""

_Pieces = tuple[frozenset[str], ...]
_State = tuple[int, tuple[frozenset[int], ...]]


def common_name(
    wanted: Iterable[str], unwanted: Iterable[str] = (), *, absolute: bool = True
) -> str | None:
    """The shortest absolute ROS name that all of ``wanted`` mean and none of ``unwanted``.

    Unless ``absolute``, one without its first "/", as DDS topics are.  None if there is no such
    name.  Where the search grows beyond all bounds (many ``?`` behind ``*``), the exceptions are
    left out of account: an overlap too many is told, never one too few.
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
    patterns = [pieces(each) for each in (*wanted, *unwanted)]
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
    """One letter of each kind that the patterns, and the grammar of names, tell apart."""
    told = {piece for pattern in patterns for piece in pattern if piece is not ANY}
    kinds: dict[tuple[object, ...], str] = {}
    for letter in _LETTERS:
        kind = (letter == "/", letter in digits, *(letter in piece for piece in told))
        kinds.setdefault(kind, letter)
    return "".join(kinds.values())


def _after(place: int, letter: str) -> int | None:
    """Where in a name the letter leads, or None where it cannot stand."""
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
        if pattern[at] is ANY:
            following.add(at)
        elif letter in pattern[at]:
            following.add(at + 1)
    return _closed(following, pattern)


def _closed(reached: set[int], pattern: _Pieces) -> frozenset[int]:
    """With the places that are reached when stars stand for nothing."""
    return frozenset(place for at in reached for place in _onward(at, pattern))


def _onward(at: int, pattern: _Pieces) -> Iterator[int]:
    yield at
    while at < len(pattern) and pattern[at] is ANY:
        at += 1
        yield at
