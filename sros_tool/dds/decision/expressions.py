"""The sets of names that a vendor's topic expressions match.

How a vendor reads ``[...]`` in an expression follows fnmatch of glibc, or the matching of Cyclone
DDS.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from functools import lru_cache

from sros_tool.automata import ANY_LETTER, Automaton, Letters, NameSet
from sros_tool.dds.decision.vendors import Style
from sros_tool.names import is_expression

_CLASS = re.compile(r"\[:([a-y]*):\]")
_EQUIVALENT = re.compile(r"\[=(.)=\]", re.DOTALL)
_NOTHING = Letters(())
_OPENING = Letters.of("[")
_DIGIT, _LOWER, _UPPER = (Letters.between([ends]) for ends in (("0", "9"), ("a", "z"), ("A", "Z")))
_CLASSES = {
    "alnum": _DIGIT | _LOWER | _UPPER,
    "alpha": _LOWER | _UPPER,
    "blank": Letters.of(" \t"),
    "cntrl": Letters.between([("\0", "\x1f"), ("\x7f", "\x7f")]),
    "digit": _DIGIT,
    "graph": Letters.between([("!", "~")]),
    "lower": _LOWER,
    "print": Letters.between([(" ", "~")]),
    "punct": Letters.between([("!", "/"), (":", "@"), ("[", "`"), ("{", "~")]),
    "space": Letters.between([(" ", " "), ("\t", "\r")]),
    "upper": _UPPER,
    "xdigit": Letters.between([("0", "9"), ("A", "F"), ("a", "f")]),
}


def pieces_of(style: Style, expression: str) -> list[Letters | None]:
    """Return the characters allowed at each place of an expression, with None for ``*``."""
    take_set = _FnmatchSets(expression).take if style is Style.FNMATCH else _cyclone_set
    pieces: list[Letters | None] = []
    index = 0
    while index < len(expression):
        char = expression[index]
        index += 1
        if char == "*":
            pieces.append(None)
        elif char == "?":
            pieces.append(ANY_LETTER)
        elif char == "[":
            letters, index = take_set(expression, index)
            pieces.append(letters)
        else:
            pieces.append(Letters.of(char))
    return pieces


@lru_cache(maxsize=65536)
def _automaton(style: Style, expression: str) -> Automaton | None:
    """Return an automaton for the names of an expression; None if it matches only itself."""
    if not is_expression(expression):
        return None
    return Automaton.sequence(pieces_of(style, expression))


def names_of(style: Style, expressions: Iterable[str]) -> NameSet:
    """Return the names that any of the expressions matches."""
    made = {expression: _automaton(style, expression) for expression in expressions}
    return NameSet(
        (expression for expression, wild in made.items() if wild is None),
        filter(None, made.values()),
    )


def pattern_of(letters: Letters) -> str:
    """Return a regular expression that matches one character out of ``letters``."""
    if letters == ANY_LETTER:
        return "."
    if single := letters.single():
        return re.escape(single)
    ranges = "".join(f"\\U{low:08x}-\\U{high:08x}" for low, high in letters.ranges)
    return f"[{ranges}]" if ranges else "(?!)"


class _FnmatchSets:
    """A parser of ``[...]`` in expressions, as glibc reads it, in linear time."""

    def __init__(self, text: str) -> None:
        self._text = text
        self._known: dict[int, tuple[bool, bool]] = {}

    def take(self, text: str, start: int) -> tuple[Letters, int]:
        """Return the characters of the set after ``[``, and the index after the set.

        After an unknown class or symbol, and after a range without its end, no further character
        matches.  A set that is not closed is a plain ``[`` in all other cases, and also if it has a
        ``[``.
        """
        index = start
        negated = text[index : index + 1] in ("!", "^")
        index += negated
        closed, plain = self._end_of(index, is_first=True)
        if not closed:
            return (_OPENING if plain else _NOTHING), start
        members: list[Letters] = []
        goes_on = first = True
        while first or text[index] != "]":
            first = False
            letters, _, index = _token(text, index)
            goes_on = goes_on and letters is not None
            if goes_on and letters:
                members.append(letters)
        if negated and not goes_on:
            return _NOTHING, index + 1
        return _set_of(members, negated), index + 1

    def _end_of(self, index: int, *, is_first: bool) -> tuple[bool, bool]:
        """Return whether a set is closed after ``index``; if not, whether its ``[`` is literal.

        Results are cached, because many sets that are not closed would take quadratic time.
        """
        text = self._text
        path: list[tuple[int, bool | None]] = []
        closed, plain = False, True
        while index < len(text):
            if not is_first and text[index] == "]":
                closed = True
                break
            if not is_first and index in self._known:
                closed, plain = self._known[index]
                break
            letters, a_range, after = _token(text, index)
            decided = None
            if letters is None:
                decided = False
            elif letters == _OPENING and not a_range:
                decided = True
            path.append((index, decided))
            index, is_first = after, False
        for place, decided in reversed(path):
            plain = plain if decided is None else decided
            if text[place] != "]":  # the first member of a set may be one; later it closes the set
                self._known[place] = closed, plain
        return closed, plain


def _set_of(members: list[Letters], negated: bool) -> Letters:
    letters = Letters.union(members)
    return ~letters if negated else letters


def _token(text: str, index: int) -> tuple[Letters | None, bool, int]:
    """Return the characters that a token of a set stands for.

    Also returns whether the token is a range, and the index after it.  The characters are None for
    something that glibc does not know.
    """
    if match := _CLASS.match(text, index):
        return _CLASSES.get(match[1]), False, match.end()
    if match := _EQUIVALENT.match(text, index):
        return Letters.of(match[1]), False, match.end()
    low, index = _member(text, index)
    if text[index : index + 1] != "-" or text[index + 1 : index + 2] == "]":
        return (None if low is None else Letters.of(low)), False, index
    high, index = _member(text, index + 1)
    if low is None or high is None:
        return None, True, index
    return Letters.between([(low, high)]), True, index


def _member(text: str, index: int) -> tuple[str | None, int]:
    """Return one character of a set, even if written ``[.a.]``, and the index after it.

    The character is None if there is none.
    """
    if text[index : index + 2] != "[.":
        return (text[index] if index < len(text) else None), index + 1
    end = text.find(".]", index + 2)
    if end < 0:
        return None, len(text)
    return (text[index + 2] if end == index + 3 else None), end + 2


def _cyclone_set(text: str, start: int) -> tuple[Letters, int]:
    """Return the characters of the set after ``[``, and the index after it (Cyclone DDS 0.10).

    The loop of Cyclone DDS takes the closing bracket for a member before it ends, and looks for a
    range there, too: ``[ab]`` also matches ``]``, and ``[ab]-x`` is one set with the range ``]`` to
    ``x``.
    """
    index = start
    negated = text[index : index + 1] == "!"
    index += negated
    members: list[tuple[str, str]] = []
    last = text[index : index + 1]
    while last != "]":
        last = text[index : index + 1]
        if not last:
            return _NOTHING, len(text)
        if text[index + 1 : index + 2] == "-":
            high = text[index + 2 : index + 3]
            if high in ("", "]"):
                return _NOTHING, len(text)
            members.append((last, high))
            index += 2
        else:
            members.append((last, last))
        index += 1
    letters = Letters.between(members)
    return (~letters if negated else letters), index
