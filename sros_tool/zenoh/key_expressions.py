"""Key expressions of Zenoh: their canonical form, inclusion and intersection.

A key expression consists of chunks with "/" between them.  ``*`` stands for a single chunk, ``**``
for any number of chunks, ``$*`` for any part of a chunk.  No wildcard matches a chunk that begins
with ``@``.  Source: zenoh.io "Key Expressions"; tested with the wheel 1.10.2.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import cache, cached_property, lru_cache
from itertools import count

from sros_tool.automata import Automaton, Letters, NameSet
from sros_tool.names import has_parts

ANY_PART, ANY_CHUNK, ANY_CHUNKS = "$*", "*", "**"
_CACHE_SIZE = 65536
_LITERAL = re.compile(r"(?<![^/])[^/*]+(?![^/])")
"""Matches a chunk without wildcards."""
_MOST_COMPARED = 100_000
"""Maximum number of comparisons to find expressions that others include (takes under a second)."""


def canonical(chunks: Iterable[str]) -> str:
    """Return the key expression of some chunks in canonical form, the only form that Zenoh accepts.

    A chunk that is only ``$*`` becomes ``*``.  In a run of wildcards, each ``*`` comes before the
    single ``**``.  With a key in another form in a rule, the session does not open.
    """
    chunks = tuple(chunks)
    text = "/".join(chunks)
    if ANY_PART not in text and ANY_CHUNKS not in text:
        return text
    ordered: list[str] = []
    for chunk in chunks:
        while ANY_PART + ANY_PART in chunk:
            chunk = chunk.replace(ANY_PART + ANY_PART, ANY_PART)
        if chunk == ANY_PART:
            chunk = ANY_CHUNK
        if ordered and ordered[-1] == ANY_CHUNKS:
            if chunk == ANY_CHUNKS:
                continue
            if chunk == ANY_CHUNK:
                ordered.insert(-1, chunk)
                continue
        ordered.append(chunk)
    return "/".join(ordered)


def includes(wide: str, narrow: str) -> bool:
    """Return whether ``wide`` includes every key that ``narrow`` includes, by Zenoh's rules."""
    if wide == narrow:
        return True
    begin = _fixed_begin(wide)
    return begin != wide and narrow.startswith(begin) and _includes(wide, narrow)


class KeyExpressions:
    """A set of key expressions, with a fast search for those that include a given expression."""

    def __init__(self, expressions: Iterable[str]) -> None:
        self.all = frozenset(expressions)

    @cached_property
    def _by_begin(self) -> Mapping[str, Mapping[str, Mapping[str, list[str]]]]:
        """Wildcard expressions, by `_fixed_begin`, `_landmark` and `_wildcard_form`."""
        groups: dict[str, dict[str, dict[str, list[str]]]] = {}
        for expression in self.all:
            if (begin := _fixed_begin(expression)) != expression:
                by_form = groups.setdefault(begin, {}).setdefault(_landmark(expression), {})
                by_form.setdefault(_wildcard_form(expression), []).append(expression)
        return groups

    @cached_property
    def _sizes(self) -> list[int]:
        return sorted({len(begin) for begin in self._by_begin})

    def include(self, narrow: str) -> bool:
        """Return whether an expression of the set includes all of ``narrow``."""
        if narrow in self.all:
            return True
        return any(
            _includes(wide, narrow)
            for by_form in self._candidates(narrow)
            for same_form in by_form.values()
            for wide in same_form
        )

    def needed(self) -> list[str]:
        """Return the expressions that no other expression includes, sorted.

        If there are too many to compare, all expressions are returned.
        """
        forms = {expression: _wildcard_form(expression) for expression in self.all}
        if len(set(forms.values())) == 1:
            return sorted(self.all)
        wider, compared = {}, 0
        for expression in self.all:
            wider[expression] = candidates = self._candidates(expression)
            compared += sum(
                len(expressions) for by_form in candidates for expressions in by_form.values()
            )
            if compared > _MOST_COMPARED:
                return sorted(self.all)
        return sorted(
            expression
            for expression, own_form in forms.items()
            if not any(
                _includes(wide, expression)
                for by_form in wider[expression]
                for form, same_form in by_form.items()
                # Expressions with the same wildcards at the same places do not include each other.
                if form != own_form
                for wide in same_form
            )
        )

    def _candidates(self, narrow: str) -> list[Mapping[str, list[str]]]:
        """Return the expressions with wildcards that may include ``narrow``, as groups by form.

        These expressions begin like ``narrow``, and have the `_landmark` "" or a chunk of
        ``narrow``.
        """
        by_begin, candidates = self._by_begin, []
        chunks = {*_chunks(narrow), ""}
        for size in self._sizes:
            if size > len(narrow):
                break
            if by_landmark := by_begin.get(narrow[:size]):
                candidates += [by_landmark[chunk] for chunk in chunks & by_landmark.keys()]
        return candidates


@lru_cache(maxsize=_CACHE_SIZE)
def _wildcard_form(expression: str) -> str:
    """Return the wildcards and slashes of an expression, without other text."""
    return _LITERAL.sub("", expression)


@lru_cache(maxsize=_CACHE_SIZE)
def _landmark(expression: str) -> str:
    """Return the longest chunk without wildcards after the first wildcard, or ""."""
    rest = expression[len(_fixed_begin(expression)) :]
    return max((chunk for chunk in rest.split("/") if "*" not in chunk), key=len, default="")


def _common_beginning(expression: str) -> str:
    """Return the text with which every key of an expression begins.

    A slash before ``**`` is left out, because "/**" can match nothing.
    """
    begin, wildcard, _ = expression.partition("*")
    return begin.rstrip("$/") if wildcard else expression


_fixed_begin = lru_cache(maxsize=_CACHE_SIZE)(_common_beginning)


@lru_cache(maxsize=_CACHE_SIZE)
def _chunks(expression: str) -> tuple[str, ...]:
    return tuple(expression.split("/"))


def _includes(wide: str, narrow: str) -> bool:
    wide_chunks, narrow_chunks = _chunks(wide), _chunks(narrow)
    anywhere = wide_chunks.count(ANY_CHUNKS)
    if anywhere > 1:
        return sequence_includes(wide_chunks, narrow_chunks)
    if not anywhere:
        if len(wide_chunks) != len(narrow_chunks):
            return False
        for wide_chunk, narrow_chunk in zip(wide_chunks, narrow_chunks, strict=True):
            if wide_chunk != narrow_chunk and not _chunk_includes(wide_chunk, narrow_chunk):
                return False
        return True
    before = wide_chunks.index(ANY_CHUNKS)
    after = len(wide_chunks) - before - 1
    between = len(narrow_chunks) - after
    return (
        before <= between
        and all(map(_chunk_includes, wide_chunks[:before], narrow_chunks))
        and all(map(_chunk_includes, wide_chunks[before + 1 :], narrow_chunks[between:]))
        and not any(chunk.startswith("@") for chunk in narrow_chunks[before:between])
    )


def sequence_includes(wide: Sequence[str], narrow: Sequence[str]) -> bool:
    """Return whether the chunks ``wide`` include all keys of the chunks ``narrow``."""
    reached = _with_skipped_wildcards({0}, wide)
    for chunk in narrow:
        following = set()
        for at in reached:
            if at == len(wide):
                continue
            if wide[at] == ANY_CHUNKS and not chunk.startswith("@"):
                following.add(at)
            elif _chunk_includes(wide[at], chunk):
                following.add(at + 1)
        reached = _with_skipped_wildcards(following, wide)
    return len(wide) in reached


def _with_skipped_wildcards(positions: set[int], wide: Sequence[str]) -> set[int]:
    """Return ``positions``, and those after a ``**`` at them, which may match no chunk."""
    places = set(positions)
    for at in sorted(positions):
        while at < len(wide) and wide[at] == ANY_CHUNKS:
            at += 1
            places.add(at)
    return places


def _chunk_includes(wide: str, narrow: str) -> bool:
    if wide == narrow:
        return True
    if narrow == ANY_CHUNKS or "*" not in wide or narrow.startswith("@"):
        return False
    if wide == ANY_CHUNK:
        return True
    if narrow == ANY_CHUNK:
        return False
    # "\0" is no character of a key, so only a wildcard matches it.
    return has_parts(narrow.replace(ANY_PART, "\0"), wide.split(ANY_PART))


def widest_expression(expression: str) -> str:
    """Return an expression with ``**`` for all chunks, except chunks that begin with ``@``."""
    chunks = expression.split("/")
    return canonical(chunk if chunk.startswith("@") else ANY_CHUNKS for chunk in chunks)


def intersects(first: str, second: str) -> bool:
    """Return whether any key matches both expressions, by Zenoh's rules."""
    return sequences_intersect(_chunks(first), _chunks(second))


@lru_cache(maxsize=_CACHE_SIZE)
def sequences_intersect(first: tuple[str, ...], second: tuple[str, ...]) -> bool:
    """Return whether any key matches both expressions, given as chunks."""
    return _sequences_intersect(first, second, ANY_CHUNKS, chunks_intersect)


def chunks_intersect(first: str, second: str) -> bool:
    """Return whether any chunk of a key matches both chunks."""
    if first == second:
        return True
    if ANY_CHUNKS in (first, second):
        return not (first + second).replace(ANY_CHUNKS, "").startswith("@")
    if first.startswith("@") or second.startswith("@"):
        return False
    if ANY_CHUNK in (first, second):
        return True
    if "*" not in first and "*" not in second:
        return False
    # "\0" is no character of a key; here it is the wildcard for any characters.
    left, right = (chunk.replace(ANY_PART, "\0") for chunk in (first, second))
    return _sequences_intersect(left, right, "\0", lambda a, b: "\0" in (a, b) or a == b)


def _sequences_intersect(
    first: Sequence[str], second: Sequence[str], many: str, meet: Callable[[str, str], bool]
) -> bool:
    """Return whether two sequences have a common match; ``many`` matches any number of members.

    ``meet`` returns whether two members have a common match.
    """
    reached = {0}
    for left in (*first, None):
        for at in sorted(reached):
            while at < len(second) and second[at] == many:
                at += 1
                reached.add(at)
        if left is None:
            break
        following: set[int] = set()
        for at in sorted(reached):
            if left == many:
                following.add(at)
                while at < len(second) and meet(left, second[at]):
                    at += 1
                    following.add(at)
            elif at < len(second) and meet(left, second[at]):
                following.add(at if second[at] == many else at + 1)
        reached = following
    return len(second) in reached


# ── intersections of expressions ───────────────────────────────────────────────────────────

_MOST_COMMON = 4096
"""Maximum number of key expressions for the intersection of two key expressions."""


class TooManyExpressions(Exception):  # noqa: N818 - the caller makes an error of it
    """Raised if an intersection needs too many key expressions."""


def common(first: str, second: str) -> list[str]:
    """Return key expressions for the intersection: exactly the keys that both expressions include.

    Raises:
        TooManyExpressions: the result would have too many key expressions.
    """
    if includes(first, second):
        return [second]
    if includes(second, first):
        return [first]
    if not intersects(first, second):
        return []
    shared = _common_parts(first.split("/"), second.split("/"), ANY_CHUNKS, common_chunks)
    return KeyExpressions(canonical(chunks) for chunks in shared).needed()


_ANY_LETTERS = "\0"
"""Stands for ``$*``; a key cannot contain this character."""


@lru_cache(maxsize=_CACHE_SIZE)
def common_chunks(first: str, second: str) -> tuple[str, ...]:
    """Return chunks for the intersection of two chunks, in which ``**`` matches any chunk."""
    if first == second:
        return (first,)
    if ANY_CHUNKS in (first, second):
        chunk = second if first == ANY_CHUNKS else first
        return () if chunk.startswith("@") else (chunk,)
    if not chunks_intersect(first, second):
        return ()
    if ANY_CHUNK in (first, second):
        return (second if first == ANY_CHUNK else first,)
    left, right = (chunk.replace(ANY_PART, _ANY_LETTERS) for chunk in (first, second))
    shared = {
        "".join(letters).replace(_ANY_LETTERS, ANY_PART)
        for letters in _common_parts(left, right, _ANY_LETTERS, _common_letters)
    }
    return tuple(sorted(shared))


def _common_letters(first: str, second: str) -> tuple[str, ...]:
    if _ANY_LETTERS in (first, second):
        return (second if first == _ANY_LETTERS else first,)
    return (first,) if first == second else ()


def _common_parts(
    first_sequence: Sequence[str],
    second_sequence: Sequence[str],
    many: str,
    meet: Callable[[str, str], tuple[str, ...]],
) -> set[tuple[str, ...]]:
    """Return the intersection of two sequences; ``many`` matches any number of members.

    ``meet`` returns the intersection of two members, even if one of them is ``many``.  The result
    is a set of sequences.
    """

    @cache
    def common_sequences_from(in_first: int, in_second: int) -> frozenset[tuple[str, ...]]:
        left = first_sequence[in_first : in_first + 1]
        right = second_sequence[in_second : in_second + 1]
        if not left and not right:
            return frozenset({()})
        sequences: set[tuple[str, ...]] = set()
        first, second = (members[0] if members else "" for members in (left, right))
        if first == many == second:
            # Where both have ``many``, one of the two can end, while the other continues.
            tails = common_sequences_from(in_first + 1, in_second)
            for tail in tails | common_sequences_from(in_first, in_second + 1):
                sequences.add(tail if tail[:1] == (many,) else (many, *tail))
        elif many in (first, second):
            sequences |= (
                common_sequences_from(in_first + 1, in_second)
                if first == many
                else common_sequences_from(in_first, in_second + 1)
            )
            if left and right:
                more = (
                    common_sequences_from(in_first, in_second + 1)
                    if first == many
                    else common_sequences_from(in_first + 1, in_second)
                )
                sequences |= {(member, *tail) for member in meet(first, second) for tail in more}
        elif left and right:
            more = common_sequences_from(in_first + 1, in_second + 1)
            sequences |= {(member, *tail) for member in meet(first, second) for tail in more}
        if len(sequences) > _MOST_COMMON:
            raise TooManyExpressions
        return frozenset(sequences)

    return set(common_sequences_from(0, 0))


# ── the keys as sets of names ──────────────────────────────────────────────────────────────

_SLASH = Letters.of("/")
_CHUNK_LETTERS = ~_SLASH
_CHUNK_BEGIN_LETTERS = ~Letters.of("/@")


@lru_cache(maxsize=_CACHE_SIZE)
def _automaton(expression: str) -> Automaton | None:
    """Return an automaton for the keys that an expression includes; None for a single key."""
    if "*" not in expression:
        return None
    edges: list[tuple[int, Letters, int]] = []
    number = count(1)
    between = [0]  # the positions where a chunk may end
    for chunk in _chunks(expression):
        begin = next(number)
        edges += [(position, _SLASH, begin) for position in between]
        if chunk in (ANY_CHUNK, ANY_CHUNKS):
            inside = next(number)
            edges += [(begin, _CHUNK_BEGIN_LETTERS, inside), (inside, _CHUNK_LETTERS, inside)]
            if chunk == ANY_CHUNKS:
                edges.append((inside, _SLASH, begin))
                between.append(inside)
                continue
            between = [inside]
        else:
            between = [_add_chunk_edges(chunk, begin, number, edges)]
    # The automaton begins as if a "/" preceded the key.
    first = {to for at, _, to in edges if at == 0}
    edges = [edge for edge in edges if edge[0]]
    edges += [(0, letters, to) for at, letters, to in edges if at in first]
    return Automaton(tuple(edges), frozenset(between) - {0})


def _add_chunk_edges(
    chunk: str, begin: int, positions: Iterator[int], edges: list[tuple[int, Letters, int]]
) -> int:
    """Append edges for a chunk to ``edges``, and return the position after the chunk.

    A chunk that begins with a wildcard does not match a chunk that begins with "@".
    """
    parts = chunk.split(ANY_PART)
    at, wild = begin, len(parts) > 1
    for index, part in enumerate(parts):
        if index and at == begin:  # "$*" at the beginning of the chunk
            gap = next(positions)
            edges += [(begin, _CHUNK_BEGIN_LETTERS, gap), (gap, _CHUNK_LETTERS, gap)]
            if part:
                after = next(positions)
                edges += [(gap, Letters.of(part[0]), after)]
                edges += [(begin, Letters.of(part[0]) & _CHUNK_BEGIN_LETTERS, after)]
                part, at = part[1:], after
            else:
                at = gap
        elif index:
            edges.append((at, _CHUNK_LETTERS, at))
        for letter in part:
            letters = Letters.of(letter)
            to = next(positions)
            edges.append(
                (at, letters & _CHUNK_BEGIN_LETTERS if wild and at == begin else letters, to)
            )
            at = to
    return at


def names_of(expressions: Iterable[str]) -> NameSet:
    """Return the set of keys that at least one of the expressions includes."""
    return NameSet.of_automata({text: _automaton(text) for text in expressions})


@lru_cache(maxsize=_CACHE_SIZE)
def expression_problem(text: str) -> str:
    """Return a clause on why Zenoh does not accept a key expression; "" for an accepted one.

    A wildcard must be a whole chunk or ``$*``, and the expression must be in canonical form.
    """
    chunks = text.split("/")
    if "" in chunks:
        return "it begins or ends with '/', or has two '/' in a row"
    if "#" in text or "?" in text:
        return "'#' and '?' are not allowed in a key"
    for chunk in chunks:
        if chunk in (ANY_CHUNK, ANY_CHUNKS):
            continue
        rest = chunk.replace(ANY_PART, "")
        if "*" in rest or "$" in rest:
            return f"in {chunk!r} a wildcard has to be '$*'"
    if text != (right := canonical(chunks)):
        return f"it has to be written {right!r}"
    return ""
