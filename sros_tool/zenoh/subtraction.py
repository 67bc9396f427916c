"""The keys of access-control rules: allowed key expressions without denied key expressions.

Zenoh does not enforce a denial of a part of the allowed keys, so rules for topics and services only
allow.  All expressions are tuples of chunks.  A subtraction is exact for keys whose chunks are ROS
names.  Because ROS names use few letters, ``*`` without ``ab`` can be listed: chunks that contain a
letter other than a and b, chunks that begin with a letter other than a, and so on.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from functools import lru_cache
from string import ascii_letters, digits
from typing import NamedTuple

from sros_tool.zenoh.key_expressions import (
    ANY_CHUNK,
    ANY_CHUNKS,
    ANY_PART,
    KeyExpressions,
    TooManyExpressions,
    canonical,
    chunks_intersect,
    common,
    common_chunks,
    intersects,
    sequence_includes,
    sequences_intersect,
)

Chunks = tuple[str, ...]
"""A key expression or a part of it, as a tuple of chunks."""

MOST_EXPRESSIONS = 24576
"""Maximum number of key expressions in a difference.

In a process with Zenoh 1.10.2, a right to publish with 16,384 key expressions takes 212 MB.
"""
_LETTERS = "_" + digits + ascii_letters
_CACHE_SIZE, _SMALL_CACHE_SIZE = 65536, 1024
_MOST_CHARACTERS = 1_000_000
"""Maximum number of characters compared for a chunk; comparing them takes about one second."""


class CannotSubtract(Exception):  # noqa: N818 - the caller makes an error of it
    """Raised if key expressions cannot express a difference, or if it takes too many.

    ``denied`` is the expression that cannot be subtracted; () if the result is too large.
    """

    def __init__(self, denied: Chunks = ()) -> None:
        """Keep the expression that cannot be subtracted; () for a result that is too large."""
        super().__init__(denied)
        self.denied = denied


@lru_cache(maxsize=_SMALL_CACHE_SIZE)
def subtract_all(allowed: frozenset[Chunks], denied: frozenset[Chunks]) -> frozenset[Chunks]:
    """Return expressions for the keys that ``allowed`` includes and ``denied`` does not.

    Raises:
        CannotSubtract: the result has more than `MOST_EXPRESSIONS` expressions; or where an allowed
            expression has a wildcard, a denied expression has text between two wildcards.
    """
    without = _uncovered(denied)
    left: set[Chunks] = set()
    for wide in sorted(_uncovered(allowed)):
        left |= _subtract(wide, without)
        _check_number(len(left), MOST_EXPRESSIONS)
    return frozenset(left)


def _uncovered(expressions: frozenset[Chunks]) -> list[Chunks]:
    """Return the expressions that no other expression covers, and some more if there are many."""
    wide: list[Chunks] = []
    left: list[Chunks] = []
    for expression in sorted(
        expressions, key=lambda chunks: (-chunks.count(ANY_CHUNKS), len(chunks), chunks)
    ):
        if not any(_covers(wider, expression) for wider in wide):
            left.append(expression)
            if "*" in "".join(expression) and len(wide) < _MOST_COMPARED:
                wide.append(expression)
    return [
        expression
        for expression in left
        if not any(o != expression and _covers(o, expression) for o in wide)
    ]


def _subtract(wide: Chunks, denied: Iterable[Chunks]) -> set[Chunks]:
    """Return expressions for the keys that ``wide`` includes and ``denied`` does not."""
    without = frozenset(expression for expression in denied if _have_common_key(expression, wide))
    if not without:
        return {wide}
    if any(_covers(expression, wide) for expression in without):
        return set()
    left: set[Chunks] = set()
    for part in _parts(wide, without):
        left |= _remaining_keys(
            part,
            frozenset(expression for expression in without if _have_common_key(expression, part)),
        )
        _check_number(len(left))
    return _joined_expressions(left)


def _have_common_key(first: Chunks, second: Chunks) -> bool:
    """Return whether the expressions have a key in common."""
    for end in (0, -1) if first and second else ():
        if first[end] != second[end] and "*" not in first[end] + second[end]:
            return False
    return sequences_intersect(first, second)


_MOST_STEPS = 2 * MOST_EXPRESSIONS
"""Maximum number of expressions in a step, before some expressions are joined."""
_MOST_COMPARED = 64
"""Maximum number of wildcard expressions that are compared with all other expressions.

The comparison finds expressions that another expression covers.
"""
_MAX_WILD_CHUNKS = 32
"""Maximum number of denied chunks with wildcards at one position of an expression."""
_MOST_KINDS = 1024
"""Maximum number of kinds of chunks; chunks of one kind match the same denied chunks."""


def _check_number(number: int, maximum: int = _MOST_STEPS) -> None:
    if number > maximum:
        raise CannotSubtract


def _covers(wide: Chunks, narrow: Chunks) -> bool:
    """Return whether ``wide`` includes all keys of ``narrow``; False may be wrong."""
    if wide.count(ANY_CHUNKS) != 1:
        return sequence_includes(wide, narrow)
    before, after = _around_wildcards(wide)
    if len(narrow) - narrow.count(ANY_CHUNKS) < len(before) + len(after):
        return False
    first, last = _around_wildcards(narrow) if ANY_CHUNKS in narrow else (narrow, narrow)
    return _begins_as(first, before) and _begins_as(last[::-1], after[::-1])


def _begins_as(chunks: Chunks, wide: Chunks) -> bool:
    return all(
        chunk == ANY_CHUNK or (at < len(chunks) and _matches(chunk, chunks[at]))
        for at, chunk in enumerate(wide)
    )


def _around_wildcards(chunks: Chunks) -> tuple[Chunks, Chunks]:
    """Return the chunks before the first ``**`` and the chunks after the last ``**``."""
    end = len(chunks) - chunks[::-1].index(ANY_CHUNKS)
    return chunks[: chunks.index(ANY_CHUNKS)], chunks[end:]


# ── by chunks ──────────────────────────────────────────────────────────────────────────────


def _parts(wide: Chunks, denied: Iterable[Chunks]) -> Iterator[Chunks]:
    """Divide ``wide`` so that each ``**`` is clear of the starts and ends of denied expressions.

    The start of an expression is the chunks before its first ``**``; its end, those after its last.
    So a part can be compared with a denied expression chunk by chunk, first from the start, then
    from the end.
    """
    if ANY_CHUNKS not in wide:
        yield wide
        return
    before, after = _around_wildcards(wide)
    wild = [_around_wildcards(expression) for expression in denied if ANY_CHUNKS in expression]
    fixed = max(
        (len(expression) for expression in denied if ANY_CHUNKS not in expression), default=-1
    )
    if wide.count(ANY_CHUNKS) > 1:
        between = wide[len(before) + 1 : len(wide) - len(after)]
        begin = max(fixed, *(len(first) for first, _ in wild), 0) - len(before)
        end = max(fixed, *(len(last) for _, last in wild), 0) - len(after)
        _check_number(max(begin, 1) * max(end, 1))
        for number in range(begin):
            yield from _parts((*before, *_any_chunks(number), *between, *after), denied)
        most = (*before, *_any_chunks(begin), ANY_CHUNKS, *between[:-1])
        for number in range(end):
            yield from _parts((*most, *_any_chunks(number), *after), denied)
        yield (*most, ANY_CHUNKS, *_any_chunks(end), *after)
        return
    begin = max((_length_to_last_named(first) for first, _ in wild), default=0)
    end = max((_length_to_last_named(last[::-1]) for _, last in wild), default=0)
    begin = max(begin - len(before), 0)
    shortest = len(before) + len(after)
    enough = max(shortest + begin, len(before) + begin + end, fixed + 1)
    _check_number(enough)
    for number in range(enough - shortest):
        yield (*before, *_any_chunks(number), *after)
    yield (
        *before,
        *_any_chunks(begin),
        ANY_CHUNKS,
        *_any_chunks(enough - shortest - begin),
        *after,
    )


def _any_chunks(number: int) -> Chunks:
    return (ANY_CHUNK,) * number


def _length_to_last_named(chunks: Chunks) -> int:
    """Return the number of chunks up to and including the last chunk that is not ``*``."""
    return max((at + 1 for at, chunk in enumerate(chunks) if chunk != ANY_CHUNK), default=0)


@lru_cache(maxsize=_SMALL_CACHE_SIZE)
def _remaining_keys(wide: Chunks, denied: frozenset[Chunks]) -> frozenset[Chunks]:
    """Return expressions for the keys of ``wide`` without ``denied``.

    All denied expressions have a key in common with ``wide``.
    """
    if not denied:
        return frozenset((wide,))
    if any(_covers(expression, wide) for expression in denied):
        return frozenset()
    if wide[0] != ANY_CHUNKS:
        return _split_by_first_chunk(wide, denied)
    if wide[-1] != ANY_CHUNKS:
        reversed_rest = _split_by_first_chunk(
            wide[::-1], frozenset(expression[::-1] for expression in denied)
        )
        return frozenset(expression[::-1] for expression in reversed_rest)
    return _shorter_keys(wide, denied)


def _shorter_keys(wide: Chunks, denied: Iterable[Chunks]) -> frozenset[Chunks]:
    """Return expressions for the keys of ``wide``, which must be ``**``, without ``denied``.

    The denied expressions must consist only of wildcards.  Because of their ``**``, they deny all
    keys from some length on, so that shorter keys remain.

    Raises:
        CannotSubtract: ``wide`` or a denied expression has another form.
    """
    named = [expression for expression in denied if {*expression} - {ANY_CHUNK, ANY_CHUNKS}]
    if wide != (ANY_CHUNKS,) or named:
        raise CannotSubtract(min(named or denied))
    least = min(len(expression) - 1 for expression in denied if ANY_CHUNKS in expression)
    lengths = {len(expression) for expression in denied if ANY_CHUNKS not in expression}
    return frozenset(_any_chunks(number) for number in range(least) if number not in lengths)


def _split_by_first_chunk(wide: Chunks, denied: Iterable[Chunks]) -> frozenset[Chunks]:
    """Return expressions for the keys of ``wide`` without ``denied``, found by the first chunk.

    The first chunk of ``wide`` must not be ``**``.
    """
    first, rest = wide[0], wide[1:]
    tails: dict[str, set[Chunks]] = {}
    for expression in denied:
        for chunk, tail in _first_chunks(expression):
            if common_chunks(first, chunk) and _have_common_key(tail, rest):
                tails.setdefault(chunk, set()).add(tail)
    always = {chunk for chunk in tails if _matches(chunk, first)}
    first_chunks = tuple(sorted(tails.keys() - always))
    # Maps what follows the first chunk to the kinds of first chunks after which it is allowed.
    kinds: dict[Chunks, set[frozenset[str]]] = {}
    for kind in _kinds(first, first_chunks):
        behind = frozenset(tail for chunk in kind | always for tail in tails[chunk])
        for remainder in _remaining_keys(rest, behind):
            kinds.setdefault(remainder, set()).add(kind)
    left = set()
    for remainder, matched in kinds.items():
        left |= {(chunk, *remainder) for chunk in _chunks(first, first_chunks, frozenset(matched))}
        _check_number(len(left))
    return frozenset(left)


def _first_chunks(expression: Chunks) -> Iterator[tuple[str, Chunks]]:
    """Yield each possible first chunk of an expression's keys, with the rest of the expression."""
    if expression and expression[0] == ANY_CHUNKS:
        yield from _first_chunks(expression[1:])
        yield ANY_CHUNK, expression
    elif expression:
        yield expression[0], expression[1:]


@lru_cache(maxsize=_CACHE_SIZE)
def _kinds(first: str, first_chunks: tuple[str, ...]) -> Mapping[frozenset[str], Chunks]:
    """Map each kind of chunks that ``first`` matches to expressions for the chunks of the kind.

    The kind of a chunk is the set of matching chunks in ``first_chunks``.
    """
    wild = [chunk for chunk in first_chunks if "*" in chunk]
    _check_number(len(wild), _MAX_WILD_CHUNKS)
    shared_by_kind: dict[frozenset[str], Chunks] = {frozenset(): (first,)}
    for chunk in wild:
        for kind, shared_chunks in list(shared_by_kind.items()):
            if shared := tuple(
                c for common_chunk in shared_chunks for c in common_chunks(common_chunk, chunk)
            ):
                shared_by_kind[kind | {chunk}] = shared
        _check_number(len(shared_by_kind), _MOST_KINDS)
    kinds = {
        kind: shared_chunks
        for kind, shared_chunks in shared_by_kind.items()
        if not all(_matches_any(chunk, wild, kind) for chunk in shared_chunks)
    }
    for chunk in first_chunks:
        if "*" not in chunk:
            matching = (wide for wide in wild if _matches(wide, chunk))
            kinds[frozenset((chunk, *matching))] = (chunk,)
    return kinds


def _matches_any(chunk: str, wild: Iterable[str], excluded: frozenset[str]) -> bool:
    """Return whether any chunk in ``wild``, except ``excluded`` chunks, includes ``chunk``."""
    return any(_matches(wide, chunk) for wide in wild if wide not in excluded)


@lru_cache(maxsize=_CACHE_SIZE)
def _matches(wide: str, narrow: str) -> bool:
    return sequence_includes((wide,), (narrow,))


@lru_cache(maxsize=_CACHE_SIZE)
def _chunks(first: str, first_chunks: tuple[str, ...], kinds: frozenset[frozenset[str]]) -> Chunks:
    """Return few chunks that together match the names that ``first`` matches, of some ``kinds``.

    The kind of a name is the set of matching chunks in ``first_chunks``. For each kind in
    ``kinds``, all kinds that are subsets must be in ``kinds``, too.
    """
    kinds_of_first = _kinds(first, first_chunks)

    def are_allowed(other_kinds: Iterable[frozenset[str]]) -> bool:
        return all(any(other_kind <= kind for kind in kinds) for other_kind in other_kinds)

    if are_allowed(kinds_of_first):
        return (first,)
    choices = []
    outside = frozenset(first_chunks).difference(*kinds)
    if are_allowed(kind for kind in kinds_of_first if not kind & outside):
        choices.append(_chunks_without_denied(first, outside))
    chosen: dict[str, None] = {}
    for kind in sorted(kinds, key=sorted):
        other_chunks = frozenset(first_chunks) - kind
        if are_allowed(kind_of_chunk for kind_of_chunk in kinds_of_first if kind <= kind_of_chunk):
            other_chunks = frozenset()
        chosen |= dict.fromkeys(
            c for chunk in kinds_of_first[kind] for c in _chunks_without_denied(chunk, other_chunks)
        )
    choices.append(tuple(chosen))
    wanted = [chunk for kind in kinds for chunk in kinds_of_first[kind]]
    for letter in sorted({*wanted[0]}.intersection(*wanted[1:]).difference(ANY_PART)):
        shared = common_chunks(first, f"{ANY_PART}{letter}{ANY_PART}")
        if len(shared) == 1 and are_allowed(_kinds(shared[0], first_chunks)):
            choices.append(shared)
    return min(choices, key=len)


# ── by letters ─────────────────────────────────────────────────────────────────────────────


@lru_cache(maxsize=_CACHE_SIZE)
def _chunks_without_denied(wide: str, denied: frozenset[str]) -> Chunks:
    """Return chunks for the names that ``wide`` matches and no chunk of ``denied`` matches."""
    if not denied:
        return (wide,)
    search = _LetterSearch()
    without = tuple(sorted(chunk.replace(ANY_PART, "*") for chunk in denied))
    try:
        search.run(_SearchState("", wide.replace(ANY_PART, "*"), without, _LETTERS))
    except CannotSubtract as error:
        if error.denied:  # a chunk that is left after some letters were read
            raise CannotSubtract((min(denied),)) from None
        raise
    return tuple(canonical((chunk.replace("*", ANY_PART),)) for chunk in search.kept)


class _SearchState(NamedTuple):
    """A state of the search: names that begin with ``read``, then text that ``wide`` matches.

    ``denied`` are the denied chunks for the text after ``read``. ``letters`` are the letters that
    this text may have; names with other letters are already kept.
    """

    read: str
    wide: str
    denied: tuple[str, ...]
    letters: str


@dataclass
class _LetterSearch:
    """The search for chunks that match the names of a chunk, without denied names.

    The search reads names from the start until no denied chunk can match any more.  If all
    wildcards in denied chunks are stars at the start, a second search reads backwards from the end.

    ``kept`` has the chunks that were found; ``effort_left`` is the number of characters that may
    still be compared.
    """

    backwards: bool = False
    kept: dict[str, None] = field(default_factory=dict)
    effort_left: int = _MOST_CHARACTERS

    def run(self, start: _SearchState) -> None:
        """Search from the state ``start`` until nothing is left to read."""
        seen = set()
        states = [start]
        while states:
            state = states.pop()
            if state[:2] not in seen:
                seen.add(state[:2])
                states += self._following(state)

    def _following(self, state: _SearchState) -> Iterable[_SearchState]:
        """Return the next states of a state; () if all its names are already kept or denied."""
        read, wide, denied, _ = state
        self.effort_left -= sum(map(len, denied)) + len(denied) * len(wide) + len(read)
        if self.effort_left < 0:
            raise CannotSubtract
        denied = tuple(chunk for chunk in denied if chunks_intersect(_chunk(chunk), _chunk(wide)))
        if not denied:
            self._keep(read + wide)
            return ()
        if any(_matches(_chunk(chunk), _chunk(wide)) for chunk in denied):
            return ()
        if not wide.startswith("*"):
            return (
                _SearchState(
                    read + wide[0], wide[1:], _rest_after_letter(wide[0], denied), _LETTERS
                ),
            )
        starred = [chunk for chunk in denied if chunk.startswith("*")]
        if starred and all(chunk in starred or "*" not in chunk for chunk in denied):
            self._keep_backwards(read, wide, denied)
            return ()
        return self._split_by_next_letter(state._replace(denied=denied))

    def _split_by_next_letter(self, state: _SearchState) -> Iterator[_SearchState]:
        """Yield the next states, one for each next letter; ``wide`` must begin with "*"."""
        read, wide, denied, letters = state
        if wide == "*" and not any("*" in chunk for chunk in denied):
            # A chunk with a letter that no denied chunk has is allowed, whatever its other letters
            # are.
            needed = {letter for chunk in denied for letter in chunk}
            for letter in letters:
                if letter not in needed:
                    self._keep(f"{read}*{letter}*")
            letters = "".join(letter for letter in letters if letter in needed)
        yield _SearchState(read, wide[1:], denied, letters)
        begins = not self.backwards and not read
        for letter in letters:
            if not (begins and letter in digits):
                yield _SearchState(read + letter, wide, _rest_after_letter(letter, denied), letters)

    def _keep_backwards(self, read: str, wide: str, denied: tuple[str, ...]) -> None:
        if self.backwards:
            raise CannotSubtract((wide,))
        ends = _LetterSearch(backwards=True, effort_left=self.effort_left)
        ends.run(_SearchState("", wide[::-1], tuple(chunk[::-1] for chunk in denied), _LETTERS))
        for chunk in ends.kept:
            self._keep(read + chunk[::-1])

    def _keep(self, chunk: str) -> None:
        if chunk or self.backwards:  # a chunk cannot be empty, but the end of a chunk can
            self.kept[chunk] = None
        _check_number(len(self.kept))


def _chunk(text: str) -> str:
    return text.replace("*", ANY_PART)


def _rest_after_letter(letter: str, chunks: Iterable[str]) -> tuple[str, ...]:
    """Return the rest of each chunk after a letter, without chunks that do not match it."""
    rests = []
    for chunk in chunks:
        if chunk.startswith("*"):
            rests.append(chunk)
            if chunk[1:2] == letter:
                rests.append(chunk[2:])
        elif chunk.startswith(letter):
            rests.append(chunk[1:])
    return tuple(dict.fromkeys(rests))


# ── fewer expressions ──────────────────────────────────────────────────────────────────────


def _joined_expressions(expressions: set[Chunks]) -> set[Chunks]:
    """Return fewer expressions for the same keys.

    An expression with ``**`` replaces expressions that differ only in the number of chunks.
    """
    joined = {
        tuple(canonical(expression).split("/")) if expression else expression
        for expression in expressions
    }
    while longer := [expression for expression in joined if _one_shorter(expression) in joined]:
        joined -= {_one_shorter(expression) for expression in longer}
        joined.difference_update(longer)
        joined |= {_with_shorter(expression) for expression in longer}
    wild = {
        _around_wildcards(expression) for expression in joined if expression.count(ANY_CHUNKS) == 1
    }
    begins = _Beginnings({before for before, _ in wild})
    ends = _Beginnings({after[::-1] for _, after in wild})
    return {
        expression
        for expression in joined
        if ANY_CHUNKS in expression
        or not any(
            (before, after[::-1]) in wild
            for before in begins.matching(expression)
            for after in ends.matching(expression[::-1])
            if len(before) + len(after) <= len(expression)
        )
    }


class _Beginnings:
    """An index of beginnings, with a search by the beginning of an expression."""

    def __init__(self, beginnings: Iterable[Chunks]) -> None:
        self._by_first: dict[Chunks, list[Chunks]] = {}
        for beginning in beginnings:
            self._by_first.setdefault(beginning[:1], []).append(beginning)
        self._known: dict[Chunks, list[Chunks]] = {}

    def matching(self, chunks: Chunks) -> Iterator[Chunks]:
        first = chunks[:1]
        if first not in self._known:
            known = (chunk for chunk in self._by_first if all(map(_matches, chunk, first)))
            self._known[first] = [beginning for key in known for beginning in self._by_first[key]]
        for beginning in self._known[first]:
            if len(beginning) <= len(chunks) and all(map(_matches, beginning, chunks)):
                yield beginning


def _one_shorter(chunks: Chunks) -> Chunks | None:
    """Return the expression for one chunk less: ``a/b`` for ``a/*/**/b``; None for other forms."""
    at = chunks.index(ANY_CHUNKS) if chunks.count(ANY_CHUNKS) == 1 else 0
    return (*chunks[: at - 1], *chunks[at + 1 :]) if at and chunks[at - 1] == ANY_CHUNK else None


def _with_shorter(chunks: Chunks) -> Chunks:
    at = chunks.index(ANY_CHUNKS)
    return (*chunks[: at - 1], *chunks[at:])


_CACHE_SIZE, _SMALL_CACHE_SIZE = 65536, 1024


class Difference(NamedTuple):
    """The keys of allowed names without the keys of denied names.

    A key consists of the chunk ``begin``, the name, and ``end``, which is "" or "/" with further
    chunks.
    """

    begin: str
    end: str
    allowed: frozenset[Chunks]
    denied: frozenset[Chunks]

    def names(self) -> frozenset[Chunks]:
        """Return key expressions for the remaining names.

        Raises:
            CannotSubtract: as in `subtract_all`.
        """
        return subtract_all(self.allowed, self.denied)

    def keys_below(self, end: str) -> Difference:
        """Return the difference with the same names and with ``end`` added as further chunks."""
        return self._replace(end=f"{self.end}/{end}")

    def include(self, name: str) -> bool:
        """Return whether the difference has a name without wildcards, such as ``robot/chatter``."""
        return _search_index(self.allowed).include(name) and not _search_index(self.denied).include(
            name
        )

    def include_all(self, begin: str, name: Chunks, end: str) -> bool:
        """Return whether the difference has all keys of an expression, given in three parts.

        False may be wrong.
        """
        return (
            begin == self.begin
            and _common_end(end, self.end) == end
            and any(_covers(expression, name) for expression in self.allowed)
            and not any(_have_common_key(expression, name) for expression in self.denied)
        )

    def common(self, other: Difference) -> list[str]:
        """Return key expressions for the keys that both differences have.

        Raises:
            CannotSubtract: as in `subtract_all`.
            TooManyExpressions: the common names take too many key expressions.
        """
        end = _common_end(self.end, other.end)
        if self.begin != other.begin or end is None:
            return []
        names = subtract_all(
            _common_expressions(self.allowed, other.allowed), self.denied | other.denied
        )
        return [canonical((self.begin, *name)) + end for name in names]


def _common_end(first: str, second: str) -> str | None:
    """Return the narrower of two endings, or None if they have nothing in common.

    An ending followed by ``/**`` includes the ending itself.
    """
    end, longer = sorted((first, second), key=len)
    return end if longer in (end, f"{end}/{ANY_CHUNKS}") else None


@lru_cache(maxsize=_SMALL_CACHE_SIZE)
def _search_index(expressions: frozenset[Chunks]) -> KeyExpressions:
    return KeyExpressions("/".join(chunks) for chunks in expressions)


@lru_cache(maxsize=_SMALL_CACHE_SIZE)
def _common_expressions(
    expressions: frozenset[Chunks], other_expressions: frozenset[Chunks]
) -> frozenset[Chunks]:
    """Return expressions for the keys that both sets of expressions match."""
    if expressions == other_expressions:
        return expressions
    return frozenset(
        tuple(expression.split("/"))
        for first in expressions
        for second in other_expressions
        for expression in common("/".join(first), "/".join(second))
    )


class RuleKeys:
    """The keys that the key expressions of a rule include.

    ``plain`` are key expressions for a single name, with wildcards only in the type, in its hash
    and after the hash.  ``tokens`` are graph tokens with wildcards; ``differences`` are all other
    keys.  ``is_plain`` says that all keys are plain.
    """

    def __init__(self, expressions: frozenset[str], differences: tuple[Difference, ...]) -> None:
        """Sort the key expressions by kind.

        ``differences`` are the set differences from which the expressions were computed; () if they
        are unknown.
        """
        wide = [expression for expression in expressions if "*" in _ENDS.sub("", expression)]
        self.plain = expressions.difference(wide)
        self.tokens = KeyExpressions(
            expression for expression in wide if expression.startswith("@")
        )
        self.differences = differences or _differences(wide)
        self.is_plain = not wide and not differences
        self._has_plain_tokens = any(expression.startswith("@") for expression in self.plain)

    def include(self, key: str) -> bool:
        """Return whether the rule's differences have all keys of an expression.

        False may be wrong.
        """
        begin, name, end = _expression_parts(key)
        chunks = tuple(name.split("/"))
        return any(difference.include_all(begin, chunks, end) for difference in self.differences)

    def common(self, other: RuleKeys) -> tuple[str, ...]:
        """Return expressions for exactly the common keys of both rules, sorted.

        Raises:
            TooManyExpressions: the result would have too many key expressions.
        """
        shared = self.plain & other.plain
        if self.is_plain and other.is_plain:
            return _in_order(shared) if shared else ()
        if self._plain_may_be_in(other):
            shared |= _plain_in(self.plain, other)
        if other._plain_may_be_in(self):
            shared |= _plain_in(other.plain, self)
        if self.tokens.all and other.tokens.all:
            shared |= _common_of_tokens(self.tokens, other.tokens)
        if self.differences and other.differences:
            shared |= _common_of_differences(self.differences, other.differences)
        return _in_order(shared) if shared else ()

    def _plain_may_be_in(self, wide: RuleKeys) -> bool:
        return bool(
            (self.plain and wide.differences) or (self._has_plain_tokens and wide.tokens.all)
        )


@lru_cache(maxsize=_CACHE_SIZE)
def _in_order(expressions: frozenset[str]) -> tuple[str, ...]:
    return tuple(sorted(expressions))


@lru_cache(maxsize=_CACHE_SIZE)
def keys_of(expressions: frozenset[str], differences: tuple[Difference, ...] = ()) -> RuleKeys:
    """Return the keys that expressions include; results are cached."""
    return RuleKeys(expressions, differences)


_ANY_TYPE = "/$*::$*/*"
"""Matches any type with its hash, the chunks after the name in a key."""
_ENDS = re.compile(rf"{re.escape(_ANY_TYPE)}(?:/\*\*)?(?:/@adv/\*\*)?\Z")


def _expression_parts(expression: str) -> tuple[str, str, str]:
    """Return the parts of a key expression before the name, of the name, and after the name."""
    begin, _, rest = expression.partition("/")
    name, of_type, below = rest.partition(_ANY_TYPE)
    return begin, name, of_type + below


def _differences(expressions: Iterable[str]) -> tuple[Difference, ...]:
    """Return key expressions, except graph tokens, as differences without denied names."""
    names: dict[tuple[str, str], set[Chunks]] = {}
    for expression in expressions:
        if not expression.startswith("@"):
            begin, name, end = _expression_parts(expression)
            names.setdefault((begin, end), set()).add(tuple(name.split("/")))
    return tuple(
        Difference(*place, frozenset(of), frozenset()) for place, of in sorted(names.items())
    )


@lru_cache(maxsize=_CACHE_SIZE)
def _plain_in(plain: frozenset[str], wide: RuleKeys) -> frozenset[str]:
    keys: set[str] = set()
    for key in plain:
        begin, name, end = _expression_parts(key)
        if begin.startswith("@"):
            keys.update([key] if wide.tokens.include(key) else _common_with_all(key, wide.tokens))
            continue
        for difference in wide.differences:
            common_end = _common_end(end, difference.end)
            if begin == difference.begin and common_end is not None and difference.include(name):
                keys.add(f"{begin}/{name}{common_end}")
    return frozenset(keys)


@lru_cache(maxsize=_CACHE_SIZE)
def _common_of_differences(
    differences: tuple[Difference, ...], other_differences: tuple[Difference, ...]
) -> frozenset[str]:
    try:
        shared = [
            key
            for first in differences
            for second in other_differences
            for key in first.common(second)
        ]
    except CannotSubtract:
        raise TooManyExpressions from None
    return frozenset(shared)


@lru_cache(maxsize=_CACHE_SIZE)
def _common_of_tokens(first: KeyExpressions, second: KeyExpressions) -> frozenset[str]:
    if first.all == second.all:
        return first.all
    shared = {token for token in first.all if second.include(token)}
    not_included = [token for token in first.all if token not in shared]
    for token in second.all if not_included else ():
        if first.include(token):
            shared.add(token)
        else:
            # Tokens of one side that the other side includes are shared unchanged.
            overlapping = (wide for wide in not_included if intersects(token, wide))
            shared.update(*(common(token, wide) for wide in overlapping))
    return frozenset(KeyExpressions(shared).needed())


@lru_cache(maxsize=_CACHE_SIZE)
def _common_with_all(key: str, wide: KeyExpressions) -> tuple[str, ...]:
    return tuple(shared for token in wide.all for shared in common(key, token))
