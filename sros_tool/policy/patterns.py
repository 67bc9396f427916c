"""Name expressions with wildcards: matching, covering and overlapping.

``*`` matches any characters, including "/"; ``?`` matches one character; ``[abc]`` and ``[a-c]``
match one character of a set, and ``[!a-c]`` one character outside of it.  This is fnmatch of glibc
without escapes, as in the DDS vendors.

`overlap` and `covers` compare two expressions, `Names` searches many expressions.
`renamed_matches` follows names to new names. `common_name` compares any number of expressions, also
with exceptions, and returns an example, which is a valid absolute ROS name. `listed_expressions`
replaces an expression by several expressions without ``?`` and sets of characters.
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

_CACHE_SIZE = 4096
_WILDCARD = re.compile(r"[*?\[]")
_PIECE = re.compile(r"\*+|\?|\[(!?)([^\]]+)\]|(.)", re.DOTALL)
_RANGE = re.compile(r"(.)-(.)|(.)", re.DOTALL)
# More than the letters of ROS names, because DDS topics need not be from ROS.
_ALPHABET = frozenset(map(chr, range(33, 127)))
_STAR = frozenset([""])
"""The piece for ``*`` in an expression."""
OTHER_NAMESPACE = "/[\ue000]"
"""Any namespace except ``/``, as an expression.

The letter U+E000 does not occur in files, so only ``*`` in the expressions of files matches this
name.
"""
_ROS_LETTERS = f"_{digits}{ascii_letters}/"
_CHOICE = re.compile(r"\[(!?)([^\]]+)\]|(\?)|([^?\[]+)")
_STARS = re.compile(r"\*\*+")


@lru_cache(maxsize=_CACHE_SIZE)
def compiled(expression: str) -> re.Pattern[str]:
    """Return a compiled regular expression that matches the same names as ``expression``."""
    return re.compile(translate(expression))


def matches(expression: str, name: str) -> bool:
    """Return whether ``expression`` matches ``name``, which must have no wildcards."""
    if "?" in expression or "[" in expression:
        return compiled(expression).match(name) is not None
    # Searching the parts of an expression once is much faster than compiling the expression.
    parts = expression.split("*")
    return expression == name if len(parts) == 1 else has_parts(name, parts)


def literal_prefix(expression: str) -> str:
    """Return the characters before the first wildcard."""
    return _WILDCARD.split(expression, maxsplit=1)[0]


def covers(wide: str, narrow: str) -> bool:
    """Return whether ``wide`` matches every name that ``narrow`` matches.

    True is always right.  False can be wrong for unusual expressions: ``?*`` and ``*?`` match the
    same names, but do not cover each other here.  If False is wrong, callers only keep a redundant
    rule.
    """
    if wide == narrow:
        return True
    if not is_expression(wide):
        return False
    if not is_expression(narrow):
        return matches(wide, narrow)
    return narrow.startswith(literal_prefix(wide)) and _pattern(wide).covers(_pattern(narrow))


def overlap(first: str, second: str) -> bool:
    """Return whether any name matches both expressions."""
    if not is_expression(first):
        return matches(second, first) if is_expression(second) else first == second
    if not is_expression(second):
        return matches(first, second)
    shorter, longer = sorted((literal_prefix(first), literal_prefix(second)), key=len)
    return longer.startswith(shorter) and _pattern(first).overlaps(_pattern(second))


def renamed_matches(expression: str, old: str, new: str) -> Iterator[tuple[str, str]]:
    """Yield the names, among ``old``, that ``expression`` matches, each with its new name.

    ``new`` replaces the characters of ``old`` before the first wildcard; the rest of both is equal,
    as in ``/a/n/*`` and ``/b/m/*``.  The yielded names may be expressions.  Together they match
    all such names, and perhaps further names that fit the beginning of ``old``.
    """
    if covers(expression, old):
        yield old, new
    elif overlap(expression, old):
        begin, new_begin = literal_prefix(old), literal_prefix(new)
        for rest in _rests(expression, begin):
            name = begin + rest
            # A name has no "//" and no "/" at the end.
            if "//" not in name and name[-1:] != "/" and overlap(name, old):
                yield name, new_begin + rest


def _rests(expression: str, begin: str) -> Iterator[str]:
    """Yield expressions for the rest of the names that begin with ``begin``, and match."""
    pieces = _pieces(expression)
    texts = [match[0] for match in _PIECE.finditer(expression)]

    def with_stars_skipped(positions: Iterable[int]) -> set[int]:
        reached = set(positions)
        for i, piece in enumerate(pieces):
            if i in reached and piece is _STAR:
                reached.add(i + 1)
        return reached

    reached = {0}
    for letter in begin:
        before = with_stars_skipped(reached)
        reached = {i for i in before if i < len(pieces) and pieces[i] is _STAR}
        reached |= {i + 1 for i in before if i < len(pieces) and letter in pieces[i]}
    for i in sorted(reached):
        yield "".join(texts[i:])


_Pieces = tuple[frozenset[str], ...]


class _Pattern:
    """An expression as a sequence of pieces.

    Sets of positions are the bits of an integer: bit i stands for "the first i pieces have
    matched".
    """

    __slots__ = ("_covering", "_letters", "_meeting", "back", "front", "pieces", "starred", "stars")

    def __init__(self, pieces: _Pieces) -> None:
        self.pieces = pieces
        at = [i for i, piece in enumerate(pieces) if piece is _STAR]
        self.starred = bool(at)
        self.stars = sum(1 << i for i in at)
        self.front = pieces[: at[0]] if at else pieces
        self.back = pieces[at[-1] + 1 :] if at else pieces
        self._letters: dict[str, int] = {}
        self._covering: dict[frozenset[str], int] = {}
        self._meeting: dict[frozenset[str], int] = {}

    def covers(self, narrow: _Pattern) -> bool:
        """Return whether this expression covers ``narrow``, by comparing pieces."""
        reached = self._begin()
        for piece in narrow.pieces:
            kept = reached & self.stars
            if piece is not _STAR:
                kept |= (reached & self._covering_positions(piece)) << 1
            reached = kept | (kept & self.stars) << 1
            if not reached:
                return False
        return bool(reached >> len(self.pieces))

    def overlaps(self, other: _Pattern) -> bool:
        """Return whether any name matches both expressions."""
        if not (all(self.pieces) and all(other.pieces)):
            return False  # an empty set of characters matches nothing
        if self.starred and other.starred:
            # If both begin and end alike, there is a common name: that beginning, the middle of the
            # one, the middle of the other, and that end, in which the stars match the rest.
            return _pieces_overlap(self.front, other.front) and _pieces_overlap(
                self.back[::-1], other.back[::-1]
            )
        if not self.starred and not other.starred:
            return len(self.pieces) == len(other.pieces) and _pieces_overlap(
                self.pieces, other.pieces
            )
        return self._overlaps_fixed(other) if self.starred else other._overlaps_fixed(self)

    def _overlaps_fixed(self, fixed_form: _Pattern) -> bool:
        """Return whether any name matches both expressions; ``fixed_form`` has no ``*``."""
        reached = self._begin()
        for piece in fixed_form.pieces:
            kept = reached & self.stars | (reached & self._overlapping_positions(piece)) << 1
            reached = kept | (kept & self.stars) << 1
            if not reached:
                return False
        return bool(reached >> len(self.pieces))

    def _begin(self) -> int:
        return 1 | (self.stars & 1) << 1

    def _covering_positions(self, piece: frozenset[str]) -> int:
        """Return the positions whose pieces match all characters of ``piece``, as bits."""
        if piece not in self._covering:
            all_covered = ~0
            for letter in piece:
                all_covered &= self._bit_of_letter(letter)
            self._covering[piece] = all_covered & (1 << len(self.pieces)) - 1 & ~self.stars
        return self._covering[piece]

    def _overlapping_positions(self, piece: frozenset[str]) -> int:
        """Return the positions whose pieces match at least one character of ``piece``."""
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


def _pieces_overlap(first: _Pieces, second: _Pieces) -> bool:
    """Return whether the pieces at each position share a character; extra pieces are ignored."""
    return not any(map(frozenset.isdisjoint, first, second))


@lru_cache(maxsize=4 * _CACHE_SIZE)
def _pattern(expression: str) -> _Pattern:
    return _Pattern(_pieces(expression))


def _pieces(expression: str) -> _Pieces:
    """Split an expression into pieces: `_STAR` for ``*``, or else a set of matching characters."""
    letter_sets: list[frozenset[str]] = []
    for piece in _PIECE.finditer(expression):
        negated, members, literal = piece.groups()
        if literal is not None:
            letter_sets.append(_single_letter(literal))
        elif members is not None:
            chosen = _members(members)
            letter_sets.append(_ALPHABET - chosen if negated else chosen)
        else:
            letter_sets.append(_ALPHABET if piece[0] == "?" else _STAR)
    return tuple(letter_sets)


@lru_cache(maxsize=_CACHE_SIZE)
def _single_letter(letter: str) -> frozenset[str]:
    return frozenset(letter)


def _members(text: str) -> frozenset[str]:
    chosen: set[str] = set()
    for low, high, single in _RANGE.findall(text):
        chosen.update([single] if single else map(chr, range(ord(low), ord(high) + 1)))
    return frozenset(chosen)


# ── many expressions ───────────────────────────────────────────────────────────────────────


class ComparisonLimit:
    """A limit on comparisons, so that a search in many expressions ends in time."""

    def __init__(self, maximum: int = 60_000_000) -> None:
        """Set the limit to ``maximum`` characters; the default takes about ten seconds."""
        self._left = maximum

    def spend(self, characters: int) -> None:
        """Count a comparison of two expressions that did not match, by the length of both.

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


_MAX_WITHOUT_INDEX = 16
"""Maximum number of expressions that are compared one by one, without an index."""
_LAST_CHARACTER = "\U0010ffff"
_ALL_BEFORE_FIXED_END = re.compile(r".*[*?\]]", re.DOTALL)
_NO_FIXED_LETTER = "\0"
_FIXED_LETTERS = re.compile(r"[^\0]+")
_PART_LENGTH = 4


class Names:
    """An ordered set of names and expressions, searched for those that cover or overlap a name.

    Only expressions with the same beginning, end or letters are compared.  ``limit`` limits the
    number of comparisons; sets for the same purpose share a limit.
    """

    def __init__(self, names: Iterable[str], limit: ComparisonLimit | None = None) -> None:
        self._names = tuple(dict.fromkeys(names))
        self._wild = tuple(expression for expression in self._names if is_expression(expression))
        self._every = frozenset(self._names)
        self._exact = self._every.difference(self._wild)
        self._limit = limit or ComparisonLimit()

    @classmethod
    def by_key(cls, pairs: Iterable[tuple[str, str]]) -> dict[str, Names]:
        """Return sets for pairs of a key and a name: one sorted set for each key."""
        names: dict[str, set[str]] = {}
        for key, name in pairs:
            names.setdefault(key, set()).add(name)
        return {key: cls(sorted(names_of_key)) for key, names_of_key in names.items()}

    def cover(self, name: str) -> bool:
        """Return whether the set contains ``name`` or an expression that covers it."""
        return name in self._every or (bool(self._wild) and any(self.covering(name)))

    def covering(self, name: str) -> Iterator[str]:
        """Yield the expressions, other than ``name`` itself, that cover ``name``, in set order."""
        for wide in self._cover_candidates(name):
            if wide != name and self._count_failure(covers(wide, name), wide, name):
                yield wide

    def overlaps(self, name: str) -> bool:
        """Return whether an expression of the set overlaps ``name``."""
        if is_expression(name):
            candidates = map(self._names.__getitem__, self._overlap_candidates(name))
            return any(self._count_failure(overlap(e, name), e, name) for e in candidates)
        return name in self._exact or (bool(self._wild) and any(self.covering(name)))

    def overlapping(self, name: str) -> Iterator[str]:
        """Yield the expressions of the set that overlap ``name``, in set order."""
        if is_expression(name):
            for expression in map(self._names.__getitem__, sorted(self._overlap_candidates(name))):
                if self._count_failure(overlap(expression, name), expression, name):
                    yield expression
            return
        if name in self._exact:
            yield name
        yield from self.covering(name)

    def _count_failure(self, fits: bool, first: str, second: str) -> bool:
        """Return ``fits``; if it is False, count the comparison against the limit."""
        if not fits:
            self._limit.spend(len(first) + len(second))
        return fits

    def _cover_candidates(self, name: str) -> Iterable[str]:
        if len(self._wild) <= _MAX_WITHOUT_INDEX:
            return self._wild
        text = _letters_of(name)
        keys = {
            text[i : i + size]
            for size in range(_PART_LENGTH + 1)
            for i in range(len(text) - size + 1)
        }
        candidates = [
            number for key in keys & self._by_letters.keys() for number in self._by_letters[key]
        ]
        return [self._wild[number] for number in sorted(candidates)]

    @cached_property
    def _by_letters(self) -> dict[str, list[int]]:
        """Map parts of names to the positions of expressions whose names all have this part.

        Each expression is listed once, under its part that the fewest other expressions have.
        """
        grams = [
            {
                gram
                for run in _FIXED_LETTERS.findall(_letters_of(expression))
                for gram in _four_letter_parts(run)
            }
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
        """Return the positions of expressions that may overlap ``expression``."""
        if len(self._names) <= _MAX_WITHOUT_INDEX:
            return range(len(self._names))
        begin, end = literal_prefix(expression), _ALL_BEFORE_FIXED_END.sub("", expression)[::-1]
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
                (_ALL_BEFORE_FIXED_END.sub("", expression)[::-1], True)
                if is_expression(expression)
                else (expression[::-1], False)
                for expression in self._names
            ]
        )


class _Beginnings:
    """An index of texts by their beginnings; an open text stands for all texts that begin with it.

    A text is identified by its number, the position in the list.
    """

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
        """Return the numbers of the texts that begin with ``begin``; open texts may be shorter."""
        first = bisect_left(self._texts, begin)
        numbers = self._numbers[first : bisect_left(self._texts, begin + _LAST_CHARACTER, lo=first)]
        for size in self._sizes:
            if size >= len(begin):
                break
            numbers += self._open.get(begin[:size], ())
        return numbers


def _letters_of(expression: str) -> str:
    """Return the fixed letters of an expression, with NUL in place of all other characters."""
    if "[" not in expression:
        return expression.replace("*", _NO_FIXED_LETTER).replace("?", _NO_FIXED_LETTER)
    pieces = _pattern(expression).pieces
    return "".join(
        next(iter(piece)) or _NO_FIXED_LETTER if len(piece) == 1 else _NO_FIXED_LETTER
        for piece in pieces
    )


def _four_letter_parts(run: str) -> Iterator[str]:
    """Yield all sequences of four letters in ``run``; the whole text if it is shorter."""
    for i in range(max(len(run) - _PART_LENGTH, 0) + 1):
        yield run[i : i + _PART_LENGTH]


# ── names that expressions have in common ──────────────────────────────────────────────────


# Most callers need no automata, which take long to import.
@cache
def _ros_names(absolute: bool, elsewhere: bool) -> NameSet:
    """Return the set of all valid ROS names; if ``absolute``, with "/" at the beginning.

    If ``elsewhere``, the names are the absolute names in `OTHER_NAMESPACE`.
    """
    from sros_tool.automata import Automaton, Letters, NameSet

    word, slash = Letters.between([("A", "Z"), ("a", "z"), ("_", "_")]), Letters.of("/")
    parts = ((1, word, 2), (2, word | Letters.between([("0", "9")]), 2), (2, slash, 1))
    begin = [(0, slash, 1)] if absolute else [(0, word, 2)]
    if elsewhere:
        begin = [(0, slash, 3), (3, Letters.of(OTHER_NAMESPACE[2]), 4), (4, slash, 1)]
    return NameSet((), [Automaton((*begin, *parts), frozenset((2,)))])


@lru_cache(maxsize=_CACHE_SIZE)
def _names_of(expression: str) -> NameSet:
    """Return the set of the names that an expression matches."""
    from sros_tool.automata import Automaton, NameSet

    if not is_expression(expression):
        return NameSet([expression])
    pieces = _pieces(expression)
    return NameSet(
        (),
        [Automaton.sequence(None if piece is _STAR else _as_letters(piece) for piece in pieces)],
    )


@lru_cache(maxsize=_CACHE_SIZE)
def _as_letters(piece: frozenset[str]) -> Letters:
    from sros_tool.automata import Letters

    return Letters.of("".join(piece))


def common_name(
    wanted_names: Iterable[str], unwanted_names: Iterable[str] = (), *, absolute: bool = True
) -> str | None:
    """Return the shortest name that matches all ``wanted_names`` and no ``unwanted_names``.

    Without ``absolute``, the name has no leading "/", like a DDS topic.  If the ``wanted_names``
    begin with `OTHER_NAMESPACE`, the name also begins with it.  Returns None if there is no such
    name.

    Raises:
        DocumentError: the expressions have too many ``?`` after ``*`` for a decision.
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
def _search(
    wanted_names: tuple[str, ...], unwanted_names: tuple[str, ...], absolute: bool
) -> str | None:
    from sros_tool.automata import NameSet

    elsewhere = any(name.startswith(OTHER_NAMESPACE) for name in wanted_names)
    both = reduce(and_, map(_names_of, wanted_names), _ros_names(absolute, elsewhere))
    return (both - NameSet.union(map(_names_of, unwanted_names))).example()


# ── expressions without ? and sets ─────────────────────────────────────────────────────────


class TooManyNames(Exception):  # noqa: N818 - the caller makes an error of it
    """Raised if an expression matches too many names to list."""


def listed_expressions(expression: str, maximum: int) -> list[str]:
    """Return expressions that together match the same ROS names, with ``*`` as their only wildcard.

    A ``?`` stands for any character of ROS names.

    Raises:
        TooManyNames: the result would have more than ``maximum`` expressions.
    """
    if "?" not in expression and "[" not in expression:
        return [_STARS.sub("*", expression)]
    pieces = [_letters_or_text(*match.groups()) for match in _CHOICE.finditer(expression)]
    if prod(map(len, pieces)) > maximum:
        raise TooManyNames
    names = ("".join(choice) for choice in product(*pieces))
    # A name has no "//" and no "/" at the end.
    expressions = (_STARS.sub("*", name) for name in names if "//" not in name and name[-1:] != "/")
    return list(dict.fromkeys(expressions))


def _letters_or_text(negated: str, listed: str, any_letter: str, text: str) -> Sequence[str]:
    """Return, for a match of `_CHOICE`, the letters of its wildcard, or only its text."""
    if text:
        return [text]
    if any_letter:
        return _ROS_LETTERS
    chosen = _members(listed)
    return [letter for letter in _ROS_LETTERS if (letter in chosen) is not bool(negated)]
