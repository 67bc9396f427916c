"""The topic expressions of vendors: the set of names that match, and tests of single names.

Vendors read ``[...]`` in an expression either like fnmatch of glibc, or like Cyclone DDS.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Sequence
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


def _pieces_of(style: Style, expression: str) -> list[Letters | None]:
    """Return the characters allowed at each position of an expression; None stands for ``*``."""
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
    """Return an automaton for the names that match an expression.

    The result is None for an expression that matches only its own text.
    """
    if not is_expression(expression):
        return None
    return Automaton.sequence(_pieces_of(style, expression))


def names_of(style: Style, expressions: Iterable[str]) -> NameSet:
    """Return the names that match at least one of the expressions."""
    return NameSet.of_automata({text: _automaton(style, text) for text in expressions})


def _pattern_of(letters: Letters) -> str:
    """Return a regular expression that matches one of ``letters``."""
    if letters == ANY_LETTER:
        return "."
    if single := letters.single():
        return re.escape(single)
    ranges = "".join(f"\\U{low:08x}-\\U{high:08x}" for low, high in letters.ranges)
    return f"[{ranges}]" if ranges else "(?!)"


class _FnmatchSets:
    """A parser of ``[...]`` in expressions that follows glibc, but in linear time."""

    def __init__(self, text: str) -> None:
        self._text = text
        self._known: dict[int, tuple[bool, bool]] = {}

    def take(self, text: str, start: int) -> tuple[Letters, int]:
        """Return the characters of the set after ``[``, and the index after the set.

        An unknown class or symbol, or a range without an end, is an error: later members of the set
        match nothing.  The ``[`` of an unclosed set stands for itself. But if an error comes before
        the next ``[``, this ``[`` matches nothing.
        """
        index = start
        negated = text[index : index + 1] in ("!", "^")
        index += negated
        closed, plain = self._closed_and_plain_from(index, is_first=True)
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

    def _closed_and_plain_from(self, index: int, *, is_first: bool) -> tuple[bool, bool]:
        """Return whether a set is closed after ``index``, and whether its ``[`` matches itself.

        The second value counts only if the set is not closed.  ``is_first`` says that ``index`` is
        the place of the first member, where a ``]`` does not close the set.

        Results are cached, because many unclosed sets would otherwise take quadratic time.
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
            if text[place] != "]":  # at the first position "]" is a member, later it closes the set
                self._known[place] = closed, plain
        return closed, plain


def _set_of(members: list[Letters], negated: bool) -> Letters:
    letters = Letters.union(members)
    return ~letters if negated else letters


def _token(text: str, index: int) -> tuple[Letters | None, bool, int]:
    """Return the characters for which a token of a set stands.

    Also returns whether the token is a range, and the index after the token.  The characters are
    None if glibc does not know the token.
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
    """Return a character of a set, written as itself or as ``[.a.]``, and the index after it.

    The character is None if the text has ended or ``[.`` does not enclose a single character.
    """
    if text[index : index + 2] != "[.":
        return (text[index] if index < len(text) else None), index + 1
    end = text.find(".]", index + 2)
    if end < 0:
        return None, len(text)
    return (text[index + 2] if end == index + 3 else None), end + 2


def _cyclone_set(text: str, start: int) -> tuple[Letters, int]:
    """Return the characters of the set after ``[``, and the index after the set (Cyclone DDS 0.10).

    The loop of Cyclone DDS ends only after it has read the closing bracket as a member, which can
    also begin a range: ``[ab]`` also matches ``]``, and ``[ab]-x`` is one set with the range from
    ``]`` to ``x``.
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


_Matcher = Callable[[str], object]
"""A function that returns a truthy value if a name matches."""

_BEFORE_SPECIAL = re.compile(r"[^*?\[]*")


@lru_cache(maxsize=65536)
def _matcher(style: Style, expression: str) -> _Matcher | None:
    """Return a function that returns whether a name matches ``expression``.

    The result is None for an expression without wildcards, which matches only its own text.
    """
    if not is_expression(expression):
        return None
    segments = [""]  # the parts between the stars
    for pattern in _patterns(style, expression):
        if pattern:
            segments[-1] += pattern
        elif segments[-1] or len(segments) == 1:
            segments.append("")
    return re.compile(_joined_regex(segments) + r"\Z", re.DOTALL).match


def _patterns(style: Style, expression: str) -> Iterable[str]:
    """Return a regular expression for each character of an expression, and "" for ``*``.

    Vendors differ only in sets of characters.
    """
    if "[" in expression:
        pieces = _pieces_of(style, expression)
        return ["" if piece is None else _pattern_of(piece) for piece in pieces]
    return ["" if char == "*" else "." if char == "?" else re.escape(char) for char in expression]


def _joined_regex(segments: list[str]) -> str:
    """Return a single regular expression for the parts of an expression between ``*``.

    A part matches a fixed number of characters, so its first match is as good as a later match. The
    atomic groups try only the first match; otherwise many stars would take exponential time.
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
    """An index of a list of expressions that finds the expressions matching a name.

    An expression without wildcards is found by the whole name, another expression by the text
    before its first wildcard.  So a search in thousands of expressions takes little longer than one
    comparison.  With ``both_ways``, a name with wildcards also finds expressions that match the
    name as an expression.
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
        if self._both_ways and is_expression(name):
            return self._either_way(name)
        places = self._plain.get(name, [])
        for length, by_prefix in self._wild:
            candidates = by_prefix.get(name[:length])
            if candidates:
                places = places + [place for place, match in candidates if match(name)]
        return sorted(places)

    def first(self, name: str) -> int | None:
        """Return the position of the first expression that matches ``name``, or None."""
        matching_numbers = self.matching(name)
        return matching_numbers[0] if matching_numbers else None

    def _either_way(self, name: str) -> Sequence[int]:
        return [
            position
            for position, text in enumerate(self._texts)
            if matches(self._style, text, name) or matches(self._style, name, text)
        ]
