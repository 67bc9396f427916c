"""Name expressions with wildcards: matching, covering and overlapping.

``*`` matches any characters, also "/"; ``?`` matches one character; ``[abc]`` and ``[a-c]`` match
one character of a set, ``[!a-c]`` one that is not in it.  This is fnmatch of glibc without escapes,
as the DDS vendors match.

`overlap` and `covers` compare two expressions, `Names` searches many.  `common_name` compares any
number, also with exceptions, and returns an example; it only considers valid absolute ROS names.
`listed_expressions` writes an expression as several without ``?`` and sets of characters.
"""

from __future__ import annotations

import re
from bisect import bisect_left
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from fnmatch import translate
from functools import cache, cached_property, lru_cache, reduce
from itertools import product
from math import prod
from operator import and_
from string import ascii_letters, digits
from typing import TYPE_CHECKING

from sros_tool.errors import DocumentError
from sros_tool.names import has_parts, is_expression

if TYPE_CHECKING:
    from sros_tool.automata import Letters, NameSet

_MANY = 4096
_WILDCARD = re.compile(r"[*?\[]")
_PIECE = re.compile(r"\*+|\?|\[(!?)([^\]]+)\]|(.)", re.DOTALL)
_RANGE = re.compile(r"(.)-(.)|(.)", re.DOTALL)
_ALPHABET = frozenset(map(chr, range(33, 127)))  # wider than ROS names: DDS topics may be foreign
_ANY = frozenset([""])
"""The pattern piece for ``*``."""
ELSEWHERE = "/[\ue000]"
"""Any namespace but ``/``: of the names that a file can have, only ``*`` covers the letter."""
_ROS_LETTERS = f"_{digits}{ascii_letters}/"
_CHOICE = re.compile(r"\[(!?)([^\]]+)\]|(\?)|([^?\[]+)")
_STARS = re.compile(r"\*\*+")


@lru_cache(maxsize=_MANY)
def compiled(expression: str) -> re.Pattern[str]:
    """Return a compiled regular expression that matches the same names as ``expression``."""
    return re.compile(translate(expression))


def matches(expression: str, name: str) -> bool:
    """Return whether ``expression`` matches ``name``, which has no wildcards."""
    if "?" in expression or "[" in expression:
        return compiled(expression).match(name) is not None
    # To compile an expression takes much longer than to look for its parts once.
    parts = expression.split("*")
    return expression == name if len(parts) == 1 else has_parts(name, parts)


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
    return narrow.startswith(literal_prefix(wide)) and _pattern_form(wide).covers(
        _pattern_form(narrow)
    )


def overlap(first: str, second: str) -> bool:
    """Return whether at least one name matches both expressions."""
    if not is_expression(first):
        return matches(second, first) if is_expression(second) else first == second
    if not is_expression(second):
        return matches(first, second)
    shorter, longer = sorted((literal_prefix(first), literal_prefix(second)), key=len)
    return longer.startswith(shorter) and _pattern_form(first).overlaps(_pattern_form(second))


_Pieces = tuple[frozenset[str], ...]


class _Form:
    """An expression as a sequence of pieces; sets of positions are bits of an integer.

    Bit i of a set of positions stands for "the first i pieces have matched".
    """

    __slots__ = ("_covering", "_letters", "_meeting", "back", "front", "pieces", "starred", "stars")

    def __init__(self, pieces: _Pieces) -> None:
        self.pieces = pieces
        at = [i for i, piece in enumerate(pieces) if piece is _ANY]
        self.starred = bool(at)
        self.stars = sum(1 << i for i in at)
        self.front = pieces[: at[0]] if at else pieces
        self.back = pieces[at[-1] + 1 :] if at else pieces
        self._letters: dict[str, int] = {}
        self._covering: dict[frozenset[str], int] = {}
        self._meeting: dict[frozenset[str], int] = {}

    def covers(self, narrow: _Form) -> bool:
        """Return whether the pieces cover the pieces of ``narrow``, pair by pair."""
        reached = self._begin()
        for piece in narrow.pieces:
            kept = reached & self.stars
            if piece is not _ANY:
                kept |= (reached & self._covers_at(piece)) << 1
            reached = kept | (kept & self.stars) << 1
            if not reached:
                return False
        return bool(reached >> len(self.pieces))

    def overlaps(self, other: _Form) -> bool:
        """Return whether at least one name matches both expressions."""
        if not (all(self.pieces) and all(other.pieces)):
            return False  # a set without members matches nothing
        if self.starred and other.starred:
            # A name that begins and ends as both demand, and has the middle of one and then that
            # of the other in between, matches both: the stars match the rest.
            return _pieces_meet(self.front, other.front) and _pieces_meet(
                self.back[::-1], other.back[::-1]
            )
        if not self.starred and not other.starred:
            return len(self.pieces) == len(other.pieces) and _pieces_meet(self.pieces, other.pieces)
        return self._meets(other) if self.starred else other._meets(self)

    def _meets(self, fixed_form: _Form) -> bool:
        """Return whether a name of the pieces of ``fixed_form``, without ``*``, matches."""
        reached = self._begin()
        for piece in fixed_form.pieces:
            kept = reached & self.stars | (reached & self._meets_at(piece)) << 1
            reached = kept | (kept & self.stars) << 1
            if not reached:
                return False
        return bool(reached >> len(self.pieces))

    def _begin(self) -> int:
        return 1 | (self.stars & 1) << 1

    def _covers_at(self, piece: frozenset[str]) -> int:
        """Return the positions whose pieces match all letters of ``piece``."""
        if piece not in self._covering:
            all_covered = ~0
            for letter in piece:
                all_covered &= self._bit_of_letter(letter)
            self._covering[piece] = all_covered & (1 << len(self.pieces)) - 1 & ~self.stars
        return self._covering[piece]

    def _meets_at(self, piece: frozenset[str]) -> int:
        """Return the positions whose pieces match at least one letter of ``piece``."""
        if piece not in self._meeting:
            positions = 0
            for letter in piece:
                positions |= self._bit_of_letter(letter)
            self._meeting[piece] = positions
        return self._meeting[piece]

    def _bit_of_letter(self, letter: str) -> int:
        if letter not in self._letters:
            self._letters[letter] = sum(
                1 << i for i, piece in enumerate(self.pieces) if letter in piece
            )
        return self._letters[letter]


def _pieces_meet(first: _Pieces, second: _Pieces) -> bool:
    """Return whether the pieces at every position share a letter; extra pieces are ignored."""
    return not any(map(frozenset.isdisjoint, first, second))


@lru_cache(maxsize=4 * _MANY)
def _pattern_form(expression: str) -> _Form:
    return _Form(_pieces(expression))


def _pieces(expression: str) -> _Pieces:
    """Split an expression into pieces: `_ANY` for ``*``, else the set of matching characters."""
    letter_sets: list[frozenset[str]] = []
    for piece in _PIECE.finditer(expression):
        negated, members, literal = piece.groups()
        if literal is not None:
            letter_sets.append(_single_letter(literal))
        elif members is not None:
            chosen = _members(members)
            letter_sets.append(_ALPHABET - chosen if negated else chosen)
        else:
            letter_sets.append(_ALPHABET if piece[0] == "?" else _ANY)
    return tuple(letter_sets)


@lru_cache(maxsize=_MANY)
def _single_letter(letter: str) -> frozenset[str]:
    return frozenset(letter)


def _members(text: str) -> frozenset[str]:
    chosen: set[str] = set()
    for low, high, single in _RANGE.findall(text):
        chosen.update([single] if single else map(chr, range(ord(low), ord(high) + 1)))
    return frozenset(chosen)


# ── many expressions ───────────────────────────────────────────────────────────────────────


class ComparisonLimit:
    """A limit on comparisons, so that a question about many expressions ends in time."""

    def __init__(self, maximum: int = 60_000_000) -> None:
        """Set the limit to ``maximum`` characters; the default takes about ten seconds."""
        self._left = maximum

    def spend(self, characters: int) -> None:
        """Count a comparison without result against the limit, by the length of the expressions.

        Raises:
            DocumentError: the limit is exceeded.
        """
        self._left -= characters
        if self._left < 0:
            raise DocumentError(
                "there are too many similar names with wildcards to compare",
                "Nearly all pairs of these names have to be compared.",
                "Replace wildcards by the names that they stand for, or by fewer wildcards, or "
                "divide the rules between several enclaves.",
            )


_FEW = 16
"""Up to this number, expressions are compared one by one, without an index."""
_LAST = "\U0010ffff"
_END = re.compile(r".*[*?\]]", re.DOTALL)
_BETWEEN = "\0"
_RUN = re.compile(r"[^\0]+")
_GRAM = 4


class Names:
    """An ordered set of names and expressions with a fast search for covering and overlapping ones.

    Only expressions with the same beginning, end or letters are compared.  ``limit`` limits the
    comparisons; sets that are used for one purpose share it.
    """

    def __init__(self, names: Iterable[str], limit: ComparisonLimit | None = None) -> None:
        self._names = tuple(dict.fromkeys(names))
        self._wild = tuple(expression for expression in self._names if is_expression(expression))
        self._every = frozenset(self._names)
        self._exact = self._every.difference(self._wild)
        self._limit = limit or ComparisonLimit()

    def cover(self, name: str) -> bool:
        """Return whether the set contains ``name``, or an expression that covers ``name``."""
        return name in self._every or (bool(self._wild) and any(self.covering(name)))

    def covering(self, name: str) -> Iterator[str]:
        """Yield the other expressions that cover ``name`` (see `covers`), in set order."""
        for wide in self._cover_candidates(name):
            if wide != name and self._count_failure(covers(wide, name), wide, name):
                yield wide

    def meets(self, name: str) -> bool:
        """Return whether an expression of the set overlaps with ``name``."""
        if is_expression(name):
            candidates = map(self._names.__getitem__, self._overlap_candidates(name))
            return any(self._count_failure(overlap(e, name), e, name) for e in candidates)
        return name in self._exact or (bool(self._wild) and any(self.covering(name)))

    def overlapping(self, name: str) -> Iterator[str]:
        """Yield the expressions of the set that overlap with ``name``, in the order of the set."""
        if is_expression(name):
            for expression in map(self._names.__getitem__, sorted(self._overlap_candidates(name))):
                if self._count_failure(overlap(expression, name), expression, name):
                    yield expression
            return
        if name in self._exact:
            yield name
        yield from self.covering(name)

    def _count_failure(self, fits: bool, first: str, second: str) -> bool:
        """Return ``fits``; a comparison without result counts against the limit."""
        if not fits:
            self._limit.spend(len(first) + len(second))
        return fits

    def _cover_candidates(self, name: str) -> Iterable[str]:
        if len(self._wild) <= _FEW:
            return self._wild
        text = _letters_of(name)
        keys = {
            text[i : i + size] for size in range(_GRAM + 1) for i in range(len(text) - size + 1)
        }
        candidates = [
            number for key in keys & self._by_letters.keys() for number in self._by_letters[key]
        ]
        return [self._wild[number] for number in sorted(candidates)]

    @cached_property
    def _by_letters(self) -> dict[str, list[int]]:
        """Map letters that every matching name has to the numbers of the expressions.

        For each expression, the letters that the fewest other expressions have are used.
        """
        grams = [
            {gram for run in _RUN.findall(_letters_of(expression)) for gram in _grams(run)}
            for expression in self._wild
        ]
        count = Counter(gram for expression_grams in grams for gram in expression_grams)

        def rarity(gram: str) -> tuple[int, int, str]:
            return -len(gram), count[gram], gram

        numbers_by_letters: dict[str, list[int]] = {}
        for number, expression_grams in enumerate(grams):
            key = min(expression_grams, key=rarity) if expression_grams else ""
            numbers_by_letters.setdefault(key, []).append(number)
        return numbers_by_letters

    def _overlap_candidates(self, expression: str) -> Sequence[int]:
        """Return the numbers of expressions that could overlap with ``expression``."""
        if len(self._names) <= _FEW:
            return range(len(self._names))
        begin, end = literal_prefix(expression), _END.sub("", expression)[::-1]
        return min(
            self._by_begin.numbers_of_texts(begin), self._by_end.numbers_of_texts(end), key=len
        )

    @cached_property
    def _by_begin(self) -> _Beginnings:
        return _Beginnings(
            [(literal_prefix(expression), is_expression(expression)) for expression in self._names]
        )

    @cached_property
    def _by_end(self) -> _Beginnings:
        return _Beginnings(
            [
                (_END.sub("", expression)[::-1], True)
                if is_expression(expression)
                else (expression[::-1], False)
                for expression in self._names
            ]
        )


class _Beginnings:
    """An index of numbered texts by their beginnings; open texts continue with anything."""

    def __init__(self, texts: Sequence[tuple[str, bool]]) -> None:
        ordered = sorted((text, number) for number, (text, _) in enumerate(texts))
        self._texts = [text for text, _ in ordered]
        self._numbers = [number for _, number in ordered]
        self._open: dict[str, list[int]] = {}
        for number, (text, goes_on) in enumerate(texts):
            if goes_on:
                self._open.setdefault(text, []).append(number)
        self._sizes = sorted({len(text) for text in self._open})

    def numbers_of_texts(self, begin: str) -> list[int]:
        """Return the numbers of the texts that can begin with ``begin``."""
        first = bisect_left(self._texts, begin)
        numbers = self._numbers[first : bisect_left(self._texts, begin + _LAST, lo=first)]
        for size in self._sizes:
            if size >= len(begin):
                break
            numbers += self._open.get(begin[:size], ())
        return numbers


def _letters_of(expression: str) -> str:
    """Return the fixed letters of an expression, with NUL for all other characters."""
    if "[" not in expression:
        return expression.replace("*", _BETWEEN).replace("?", _BETWEEN)
    pieces = _pattern_form(expression).pieces
    return "".join(
        next(iter(piece)) or _BETWEEN if len(piece) == 1 else _BETWEEN for piece in pieces
    )


def _grams(run: str) -> Iterator[str]:
    """Yield the four-letter parts of a text, or the whole text if it is shorter."""
    for i in range(max(len(run) - _GRAM, 0) + 1):
        yield run[i : i + _GRAM]


# ── names that expressions have in common ──────────────────────────────────────────────────


# Most questions need no automata, which take long to import.
@cache
def _ros_names(absolute: bool, elsewhere: bool) -> NameSet:
    """Return the set of all valid ROS names, with or without a leading "/", or in `ELSEWHERE`."""
    from sros_tool.automata import Automaton, Letters, NameSet

    word, slash = Letters.between([("A", "Z"), ("a", "z"), ("_", "_")]), Letters.of("/")
    parts = ((1, word, 2), (2, word | Letters.between([("0", "9")]), 2), (2, slash, 1))
    begin = [(0, slash, 1)] if absolute else [(0, word, 2)]
    if elsewhere:
        begin = [(0, slash, 3), (3, Letters.of(ELSEWHERE[2]), 4), (4, slash, 1)]
    return NameSet((), [Automaton((*begin, *parts), frozenset((2,)))])


@lru_cache(maxsize=_MANY)
def _names_of(expression: str) -> NameSet:
    """Return the set of the names that an expression matches."""
    from sros_tool.automata import Automaton, NameSet

    if not is_expression(expression):
        return NameSet([expression])
    pieces = _pieces(expression)
    return NameSet(
        (), [Automaton.sequence(None if piece is _ANY else _as_letters(piece) for piece in pieces)]
    )


@lru_cache(maxsize=_MANY)
def _as_letters(piece: frozenset[str]) -> Letters:
    from sros_tool.automata import Letters

    return Letters.of("".join(piece))


def common_name(
    wanted_names: Iterable[str], unwanted_names: Iterable[str] = (), *, absolute: bool = True
) -> str | None:
    """Return the shortest name that matches all ``wanted_names`` and no ``unwanted_names``.

    Without ``absolute``, the name has no leading "/", like DDS topics.  If ``wanted_names`` begin
    with `ELSEWHERE`, so does the name.  Returns None if there is no such name.

    Raises:
        DocumentError: there are too many ``?`` after ``*`` to decide it.
    """
    inner, outer = tuple(dict.fromkeys(wanted_names)), tuple(dict.fromkeys(unwanted_names))
    for name in inner:
        if not is_expression(name):
            other_expressions = (expression for expression in inner if expression != name)
            fits = all(matches(expression, name) for expression in other_expressions)
            return (
                name
                if fits and not any(matches(expression, name) for expression in outer)
                else None
            )
    return _search(inner, outer, absolute)


@lru_cache(maxsize=4096)
def _search(wanted: tuple[str, ...], unwanted_names: tuple[str, ...], absolute: bool) -> str | None:
    from sros_tool.automata import NameSet

    elsewhere = any(name.startswith(ELSEWHERE) for name in wanted)
    both = reduce(and_, map(_names_of, wanted), _ros_names(absolute, elsewhere))
    return (both - NameSet.union(map(_names_of, unwanted_names))).example()


# ── what characters stand for ──────────────────────────────────────────────────────────────


class TooManyNames(Exception):  # noqa: N818 - the caller makes an error of it
    """An expression stands for too many names to list."""


def listed_expressions(expression: str, maximum: int) -> list[str]:
    """Return expressions whose only wildcard is ``*`` and that match the same ROS names.

    A ``?`` is any character of ROS names.

    Raises:
        TooManyNames: there are more than ``maximum``.
    """
    if "?" not in expression and "[" not in expression:
        return [_STARS.sub("*", expression)]
    pieces = [_letters_or_text(*match.groups()) for match in _CHOICE.finditer(expression)]
    if prod(map(len, pieces)) > maximum:
        raise TooManyNames
    names = ("".join(choice) for choice in product(*pieces))
    # "/" next to another one or at the end is in no name.
    expressions = (_STARS.sub("*", name) for name in names if "//" not in name and name[-1:] != "/")
    return list(dict.fromkeys(expressions))


def _letters_or_text(negated: str, listed: str, any_letter: str, text: str) -> Sequence[str]:
    """Return what one match of `_CHOICE` stands for: several letters, or its text alone."""
    if text:
        return [text]
    if any_letter:
        return _ROS_LETTERS
    chosen = _members(listed)
    return [letter for letter in _ROS_LETTERS if (letter in chosen) is not bool(negated)]
