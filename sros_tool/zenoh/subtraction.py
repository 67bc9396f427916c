"""Subtract key expressions from another one: the result is a union of key expressions.

For rules that only allow: a denial of data inside a wider permission does not hold in Zenoh.  All
expressions are tuples of chunks.  The result is exact on keys whose chunks are names of ROS, whose
letters are few: ``*`` without ``ab`` is every chunk with another letter than a and b, or that
begins with another letter than a, and so on.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from functools import lru_cache
from string import ascii_letters, digits
from typing import NamedTuple

from sros_tool.zenoh.key_expressions import (
    ANY_CHUNK,
    ANY_CHUNKS,
    ANY_PART,
    canonical,
    chunks_intersect,
    common_chunks,
    sequence_includes,
    sequences_intersect,
)

Chunks = tuple[str, ...]
"""A key expression, or a part of one."""

MOST_EXPRESSIONS = 24576
"""Maximum number of key expressions of a difference.

A right to publish 16,384 of them takes 212 MB in a process with Zenoh 1.10.2.
"""
_LETTERS = "_" + digits + ascii_letters
_MANY, _FEW = 65536, 1024
_MOST_CHARACTERS = 1_000_000
"""Maximum number of characters that are compared for one chunk: about one second."""


class CannotSubtract(Exception):  # noqa: N818 - the caller makes an error of it
    """The difference is no union of expressions, or of too many; ``denied`` is why, if not ()."""

    def __init__(self, denied: Chunks = ()) -> None:
        """Record the expression that cannot be subtracted."""
        super().__init__(denied)
        self.denied = denied


@lru_cache(maxsize=_FEW)
def subtract_all(allowed: frozenset[Chunks], denied: frozenset[Chunks]) -> frozenset[Chunks]:
    """Return expressions for the keys that some expressions include, and none of ``denied``.

    Raises:
        CannotSubtract: there are more than `MOST_EXPRESSIONS`, or a denied expression has a chunk
            or letters between two wildcards where an allowed one has a wildcard, too.
    """
    without = _not_covered(denied)
    found: set[Chunks] = set()
    for wide in sorted(_not_covered(allowed)):
        found |= _subtract(wide, without)
        _check_number(len(found), MOST_EXPRESSIONS)
    return frozenset(found)


def _not_covered(some: frozenset[Chunks]) -> list[Chunks]:
    """Return the expressions that no other one covers, if they are not too many to compare."""
    wide: list[Chunks] = []
    left: list[Chunks] = []
    for each in sorted(some, key=lambda chunks: (-chunks.count(ANY_CHUNKS), len(chunks), chunks)):
        if not any(covers(other, each) for other in wide):
            left.append(each)
            if "*" in "".join(each) and len(wide) < _MOST_COMPARED:
                wide.append(each)
    return [each for each in left if not any(o != each and covers(o, each) for o in wide)]


def _subtract(wide: Chunks, denied: Iterable[Chunks]) -> set[Chunks]:
    """Return expressions for the keys that ``wide`` includes and none of ``denied``."""
    without = frozenset(each for each in denied if meet(each, wide))
    if not without:
        return {wide}
    if any(covers(each, wide) for each in without):
        return set()
    found: set[Chunks] = set()
    for part in _parts(wide, without):
        found |= _less(part, frozenset(each for each in without if meet(each, part)))
        _check_number(len(found))
    return _joined(found)


def meet(one: Chunks, other: Chunks) -> bool:
    """Return whether some key belongs to both expressions."""
    for end in (0, -1) if one and other else ():
        if one[end] != other[end] and "*" not in one[end] + other[end]:
            return False
    return sequences_intersect(one, other)


_MOST_STEPS = 2 * MOST_EXPRESSIONS
"""Most expressions before some are joined."""
_MOST_COMPARED = 64
"""Most expressions to compare with all others, to leave out those that they cover."""
_MOST_WILD, _MOST_KINDS = 32, 1024
"""Most chunks with wildcards that are denied at one place, and most kinds of chunks by these."""


def _check_number(number: int, most: int = _MOST_STEPS) -> None:
    if number > most:
        raise CannotSubtract


def covers(wide: Chunks, narrow: Chunks) -> bool:
    """Return whether ``wide`` includes all of ``narrow``; False can be wrong, True never is."""
    if wide.count(ANY_CHUNKS) != 1:
        return sequence_includes(wide, narrow)
    before, after = _around(wide)
    if len(narrow) - narrow.count(ANY_CHUNKS) < len(before) + len(after):
        return False
    first, last = _around(narrow) if ANY_CHUNKS in narrow else (narrow, narrow)
    return _begins_as(first, before) and _begins_as(last[::-1], after[::-1])


def _begins_as(chunks: Chunks, wide: Chunks) -> bool:
    return all(
        chunk == ANY_CHUNK or (at < len(chunks) and _matches(chunk, chunks[at]))
        for at, chunk in enumerate(wide)
    )


def _around(chunks: Chunks) -> tuple[Chunks, Chunks]:
    """Return the chunks before the first ``**`` and after the last one."""
    end = len(chunks) - chunks[::-1].index(ANY_CHUNKS)
    return chunks[: chunks.index(ANY_CHUNKS)], chunks[end:]


# ── by chunks ──────────────────────────────────────────────────────────────────────────────


def _parts(wide: Chunks, denied: Iterable[Chunks]) -> Iterator[Chunks]:
    """Yield expressions that together are ``wide``, whose ``**`` no denied beginning or end meets.

    So a denied expression can be compared from the start, and then from the end.
    """
    if ANY_CHUNKS not in wide:
        yield wide
        return
    before, after = _around(wide)
    wild = [_around(each) for each in denied if ANY_CHUNKS in each]
    fixed = max((len(each) for each in denied if ANY_CHUNKS not in each), default=-1)
    if wide.count(ANY_CHUNKS) > 1:
        between = wide[len(before) + 1 : len(wide) - len(after)]
        begin = max(fixed, *(len(first) for first, _ in wild), 0) - len(before)
        end = max(fixed, *(len(last) for _, last in wild), 0) - len(after)
        _check_number(max(begin, 1) * max(end, 1))
        for number in range(begin):
            yield from _parts((*before, *_any(number), *between, *after), denied)
        most = (*before, *_any(begin), ANY_CHUNKS, *between[:-1])
        for number in range(end):
            yield from _parts((*most, *_any(number), *after), denied)
        yield (*most, ANY_CHUNKS, *_any(end), *after)
        return
    begin = max((_to_last_named(first) for first, _ in wild), default=0)
    end = max((_to_last_named(last[::-1]) for _, last in wild), default=0)
    begin = max(begin - len(before), 0)
    shortest = len(before) + len(after)
    enough = max(shortest + begin, len(before) + begin + end, fixed + 1)
    _check_number(enough)
    for number in range(enough - shortest):
        yield (*before, *_any(number), *after)
    yield (*before, *_any(begin), ANY_CHUNKS, *_any(enough - shortest - begin), *after)


def _any(number: int) -> Chunks:
    return (ANY_CHUNK,) * number


def _to_last_named(chunks: Chunks) -> int:
    """Return the number of chunks up to the last one that is not ``*``."""
    return max((at + 1 for at, chunk in enumerate(chunks) if chunk != ANY_CHUNK), default=0)


@lru_cache(maxsize=_FEW)
def _less(wide: Chunks, denied: frozenset[Chunks]) -> frozenset[Chunks]:
    """Return expressions for the keys of ``wide`` without ``denied``, which all meet it."""
    if not denied:
        return frozenset((wide,))
    if any(covers(each, wide) for each in denied):
        return frozenset()
    if wide[0] != ANY_CHUNKS:
        return _by_first_chunk(wide, denied)
    if wide[-1] != ANY_CHUNKS:
        found = _by_first_chunk(wide[::-1], frozenset(each[::-1] for each in denied))
        return frozenset(each[::-1] for each in found)
    return _by_length(wide, denied)


def _by_length(wide: Chunks, denied: Iterable[Chunks]) -> frozenset[Chunks]:
    """Return the keys of ``**`` that are shorter than all denied ones, which have any chunks."""
    named = [each for each in denied if {*each} - {ANY_CHUNK, ANY_CHUNKS}]
    if wide != (ANY_CHUNKS,) or named:
        raise CannotSubtract(min(named or denied))
    least = min(len(each) - 1 for each in denied if ANY_CHUNKS in each)
    lengths = {len(each) for each in denied if ANY_CHUNKS not in each}
    return frozenset(_any(number) for number in range(least) if number not in lengths)


def _by_first_chunk(wide: Chunks, denied: Iterable[Chunks]) -> frozenset[Chunks]:
    """Compare the first chunk, which is not ``**``, with those of the denied expressions."""
    first, rest = wide[0], wide[1:]
    tails: dict[str, set[Chunks]] = {}
    for expression in denied:
        for chunk, tail in _openings(expression):
            if common_chunks(first, chunk) and meet(tail, rest):
                tails.setdefault(chunk, set()).add(tail)
    always = {chunk for chunk in tails if _matches(chunk, first)}
    some = tuple(sorted(tails.keys() - always))
    # What is left behind the first chunk, by which of the denied chunks match it.
    kinds: dict[Chunks, set[frozenset[str]]] = {}
    for kind in _kinds(first, some):
        behind = frozenset(tail for chunk in kind | always for tail in tails[chunk])
        for each in _less(rest, behind):
            kinds.setdefault(each, set()).add(kind)
    found = set()
    for each, of in kinds.items():
        found |= {(chunk, *each) for chunk in _chunks(first, some, frozenset(of))}
        _check_number(len(found))
    return frozenset(found)


def _openings(expression: Chunks) -> Iterator[tuple[str, Chunks]]:
    """Yield the first chunks that an expression may have, each with what follows."""
    if expression and expression[0] == ANY_CHUNKS:
        yield from _openings(expression[1:])
        yield ANY_CHUNK, expression
    elif expression:
        yield expression[0], expression[1:]


@lru_cache(maxsize=_MANY)
def _kinds(first: str, some: tuple[str, ...]) -> Mapping[frozenset[str], Chunks]:
    """Return the kinds of chunks that ``first`` matches: which of ``some`` match them, too.

    Each with expressions for what ``first`` and these match together.
    """
    wild = [chunk for chunk in some if "*" in chunk]
    _check_number(len(wild), _MOST_WILD)
    found: dict[frozenset[str], Chunks] = {frozenset(): (first,)}
    for chunk in wild:
        for kind, both in list(found.items()):
            if shared := tuple(e for one in both for e in common_chunks(one, chunk)):
                found[kind | {chunk}] = shared
        _check_number(len(found), _MOST_KINDS)
    kinds = {
        kind: both
        for kind, both in found.items()
        if not all(any(_matches(e, one) for e in wild if e not in kind) for one in both)
    }
    for chunk in some:
        if "*" not in chunk:
            kinds[frozenset((chunk, *(e for e in wild if _matches(e, chunk))))] = (chunk,)
    return kinds


@lru_cache(maxsize=_MANY)
def _matches(wide: str, narrow: str) -> bool:
    return sequence_includes((wide,), (narrow,))


@lru_cache(maxsize=_MANY)
def _chunks(first: str, some: tuple[str, ...], kinds: frozenset[frozenset[str]]) -> Chunks:
    """Return few chunks that match all of ``first`` whose kind is in ``kinds``.

    What is left allowed behind a chunk is allowed behind those, too, that fewer of ``some`` match.
    """
    every = _kinds(first, some)

    def are_allowed(others: Iterable[frozenset[str]]) -> bool:
        return all(any(other <= kind for kind in kinds) for other in others)

    if are_allowed(every):
        return (first,)
    choices = []
    outside = frozenset(some).difference(*kinds)
    if are_allowed(kind for kind in every if not kind & outside):
        choices.append(_chunks_less(first, outside))
    found: dict[str, None] = {}
    for kind in sorted(kinds, key=sorted):
        others = frozenset(some) - kind
        if are_allowed(other for other in every if kind <= other):
            others = frozenset()
        found |= dict.fromkeys(e for one in every[kind] for e in _chunks_less(one, others))
    choices.append(tuple(found))
    wanted = [one for kind in kinds for one in every[kind]]
    for letter in sorted({*wanted[0]}.intersection(*wanted[1:]).difference(ANY_PART)):
        both = common_chunks(first, f"{ANY_PART}{letter}{ANY_PART}")
        if len(both) == 1 and are_allowed(_kinds(both[0], some)):
            choices.append(both)
    return min(choices, key=len)


# ── by letters ─────────────────────────────────────────────────────────────────────────────


@lru_cache(maxsize=_MANY)
def _chunks_less(wide: str, denied: frozenset[str]) -> Chunks:
    """Return chunks for what ``wide`` matches and none of ``denied``."""
    if not denied:
        return (wide,)
    search = _Letters()
    without = tuple(sorted(each.replace(ANY_PART, "*") for each in denied))
    try:
        search.run(_Place("", wide.replace(ANY_PART, "*"), without, _LETTERS))
    except CannotSubtract as error:
        if error.denied:  # what is left of it after some letters
            raise CannotSubtract((min(denied),)) from None
        raise
    return tuple(canonical((each.replace("*", ANY_PART),)) for each in search.found)


class _Place(NamedTuple):
    """The chunks that begin with ``read``, and go on as ``wide`` and none of ``denied`` matches.

    ``letters`` are those that the rest may have: chunks with others have been found already.
    """

    read: str
    wide: str
    denied: tuple[str, ...]
    letters: str


@dataclass
class _Letters:
    """The search: it reads chunks from their start until no denied one can match any more.

    Where a denied chunk begins with a star, and none has one elsewhere, a second search reads
    backwards from the end.
    """

    backwards: bool = False
    found: dict[str, None] = field(default_factory=dict)
    effort: int = _MOST_CHARACTERS

    def run(self, start: _Place) -> None:
        """Run the search to the end."""
        seen = set()
        places = [start]
        while places:
            place = places.pop()
            if place[:2] not in seen:
                seen.add(place[:2])
                places += self._following(place)

    def _following(self, place: _Place) -> Iterable[_Place]:
        """Keep the chunks of a place if one expression matches them all; else split the place."""
        read, wide, denied, _ = place
        self.effort -= sum(map(len, denied)) + len(denied) * len(wide) + len(read)
        if self.effort < 0:
            raise CannotSubtract
        denied = tuple(each for each in denied if _overlap(each, wide))
        if not denied:
            self._keep(read + wide)
            return ()
        if any(_matches(_chunk(each), _chunk(wide)) for each in denied):
            return ()
        if not wide.startswith("*"):
            return (_Place(read + wide[0], wide[1:], _after(wide[0], denied), _LETTERS),)
        starred = [each for each in denied if each.startswith("*")]
        if starred and all(each in starred or "*" not in each for each in denied):
            self._keep_backwards(read, wide, denied)
            return ()
        return self._by_next_letter(place._replace(denied=denied))

    def _by_next_letter(self, place: _Place) -> Iterator[_Place]:
        """Split the chunks of a place by their next letter; ``wide`` begins with a star."""
        read, wide, denied, letters = place
        if wide == "*" and not any("*" in each for each in denied):
            # A chunk with a letter that no denied one has is allowed, whatever its other letters.
            needed = {letter for each in denied for letter in each}
            for letter in letters:
                if letter not in needed:
                    self._keep(f"{read}*{letter}*")
            letters = "".join(each for each in letters if each in needed)
        yield _Place(read, wide[1:], denied, letters)
        begins = not self.backwards and not read
        for letter in letters:
            if not (begins and letter in digits):
                yield _Place(read + letter, wide, _after(letter, denied), letters)

    def _keep_backwards(self, read: str, wide: str, denied: tuple[str, ...]) -> None:
        if self.backwards:
            raise CannotSubtract((wide,))
        ends = _Letters(backwards=True, effort=self.effort)
        ends.run(_Place("", wide[::-1], tuple(each[::-1] for each in denied), _LETTERS))
        for each in ends.found:
            self._keep(read + each[::-1])

    def _keep(self, chunk: str) -> None:
        if chunk or self.backwards:  # no chunk is empty, but the end of one may be
            self.found[chunk] = None
        _check_number(len(self.found))


def _chunk(text: str) -> str:
    return text.replace("*", ANY_PART)


def _overlap(one: str, other: str) -> bool:
    return chunks_intersect(_chunk(one), _chunk(other))


def _after(letter: str, chunks: Iterable[str]) -> tuple[str, ...]:
    """Return the rests of chunks after one letter was read."""
    found = []
    for chunk in chunks:
        if chunk.startswith("*"):
            found.append(chunk)
            if chunk[1:2] == letter:
                found.append(chunk[2:])
        elif chunk.startswith(letter):
            found.append(chunk[1:])
    return tuple(dict.fromkeys(found))


# ── fewer expressions ──────────────────────────────────────────────────────────────────────


def _joined(found: set[Chunks]) -> set[Chunks]:
    """Return expressions for the same keys: some of any length in place of one for each length."""
    joined = {tuple(canonical(each).split("/")) if each else each for each in found}
    while longer := [each for each in joined if _one_shorter(each) in joined]:
        joined -= {_one_shorter(each) for each in longer}
        joined.difference_update(longer)
        joined |= {_or_shorter(each) for each in longer}
    wild = {_around(each) for each in joined if each.count(ANY_CHUNKS) == 1}
    begins = _Beginnings({before for before, _ in wild})
    ends = _Beginnings({after[::-1] for _, after in wild})
    return {
        each
        for each in joined
        if ANY_CHUNKS in each
        or not any(
            (before, after[::-1]) in wild
            for before in begins.matching(each)
            for after in ends.matching(each[::-1])
            if len(before) + len(after) <= len(each)
        )
    }


class _Beginnings:
    """Beginnings of expressions, with a search for those that match the beginning of others."""

    def __init__(self, beginnings: Iterable[Chunks]) -> None:
        self._by_first: dict[Chunks, list[Chunks]] = {}
        for each in beginnings:
            self._by_first.setdefault(each[:1], []).append(each)
        self._known: dict[Chunks, list[Chunks]] = {}

    def matching(self, chunks: Chunks) -> Iterator[Chunks]:
        first = chunks[:1]
        if first not in self._known:
            firsts = (one for one in self._by_first if all(map(_matches, one, first)))
            self._known[first] = [each for one in firsts for each in self._by_first[one]]
        for each in self._known[first]:
            if len(each) <= len(chunks) and all(map(_matches, each, chunks)):
                yield each


def _one_shorter(chunks: Chunks) -> Chunks | None:
    """Return the expression for keys with one chunk less than those of a ``**`` after a ``*``."""
    at = chunks.index(ANY_CHUNKS) if chunks.count(ANY_CHUNKS) == 1 else 0
    return (*chunks[: at - 1], *chunks[at + 1 :]) if at and chunks[at - 1] == ANY_CHUNK else None


def _or_shorter(chunks: Chunks) -> Chunks:
    at = chunks.index(ANY_CHUNKS)
    return (*chunks[: at - 1], *chunks[at:])
