"""Exact sets of names, and the operations on them: union, difference, first match.

A set holds exact names, and finite automata for expressions with wildcards.  The modules that
create the automata define what wildcards mean: `sros_tool.policy.patterns`,
`sros_tool.dds.decision` and `sros_tool.zenoh`.  `NameSet.example` finds the shortest name of a set,
or proves that there is none.  Nothing is sampled or approximated: an operation that takes too many
steps raises an error.

Names are texts of any characters but NUL, which no name in DDS and no file can have.
"""

from __future__ import annotations

import heapq
from bisect import bisect_left
from collections import Counter
from collections.abc import Callable, Container, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from itertools import accumulate, count, groupby, pairwise
from string import ascii_lowercase, ascii_uppercase, digits, punctuation
from typing import NamedTuple

from sros_tool.errors import DocumentError

# ── letters ────────────────────────────────────────────────────────────────────────────────

_LAST_CODE_POINT = 0x10FFFF
_EXCLUDED_RANGES = ((0, 0), (0xD800, 0xDFFF))
"""Characters that no name can have: NUL, and surrogates, which UTF-8 cannot encode."""
_PREFERRED_LETTERS = ascii_lowercase + ascii_uppercase + digits + "_/" + punctuation + " "
"""The characters to build readable examples from, best first."""


@dataclass(frozen=True, slots=True)
class Letters:
    """A set of characters: sorted ranges of code points that neither touch nor overlap."""

    ranges: tuple[tuple[int, int], ...]

    @classmethod
    def of(cls, text: str) -> Letters:
        """Return the characters of a text."""
        return cls.between((letter, letter) for letter in text)

    @classmethod
    def between(cls, ends: Iterable[tuple[str, str]]) -> Letters:
        """Return the characters of inclusive ranges; a range that is in reverse order is empty."""
        return cls._joined_ranges((ord(low), ord(high)) for low, high in ends)

    @classmethod
    def _joined_ranges(cls, ranges: Iterable[tuple[int, int]]) -> Letters:
        joined_ranges: list[tuple[int, int]] = []
        for low, high in sorted(part for part in ranges if part[0] <= part[1]):
            if joined_ranges and low <= joined_ranges[-1][1] + 1:
                joined_ranges[-1] = joined_ranges[-1][0], max(high, joined_ranges[-1][1])
            else:
                joined_ranges.append((low, high))
        return cls(tuple(joined_ranges))

    @classmethod
    def union(cls, sets: Iterable[Letters]) -> Letters:
        """Return the characters that are in at least one of the sets."""
        return cls._joined_ranges(part for letters in sets for part in letters.ranges)

    def __or__(self, other: Letters) -> Letters:
        return self.union((self, other))

    def __and__(self, other: Letters) -> Letters:
        return ~(~self | ~other)

    def __invert__(self) -> Letters:
        """Return all characters that are not in this set."""
        ends = [-1, *(end for part in self.ranges for end in part), _LAST_CODE_POINT + 1]
        between = zip(ends[::2], ends[1::2], strict=True)
        return Letters(tuple((a + 1, b - 1) for a, b in between if a + 1 < b))

    def __bool__(self) -> bool:
        return bool(self.ranges)

    def __contains__(self, letter: str) -> bool:
        return any(low <= ord(letter) <= high for low, high in self.ranges)

    def single(self) -> str:
        """Return the only character of the set; "" if it does not have exactly one."""
        if len(self.ranges) == 1 and self.ranges[0][0] == self.ranges[0][1]:
            return chr(self.ranges[0][0])
        return ""


ANY_LETTER = Letters(((0, _LAST_CODE_POINT),))
_USABLE_LETTERS = ~Letters(_EXCLUDED_RANGES)


# ── automata ───────────────────────────────────────────────────────────────────────────────

_Moves = Mapping[int, int]
"""Maps a distance to a bit mask of the positions that a letter moves by this distance; 0: they
stay.
"""


_MOST_CACHED_NAMES = 20_000
"""Maximum number of cached answers of an automaton; callers ask about the same names again."""


@dataclass(frozen=True)
class Automaton:
    """A finite automaton: numbered positions, edges labeled with letters, accepting positions.

    Several edges from a position may have the same letter.  Equal expressions should have equal
    automata, because a comparison of equal automata needs no search.
    """

    edges: tuple[tuple[int, Letters, int], ...]
    ends: frozenset[int]

    @classmethod
    def sequence(cls, pieces: Iterable[Letters | None]) -> Automaton:
        """Return an automaton for a sequence of letters; None in the sequence matches any text."""
        at = 0
        loops: set[int] = set()
        edges: list[tuple[int, Letters, int]] = []
        for piece in pieces:
            if piece is not None:
                edges.append((at, piece, at + 1))
                at += 1
            elif at not in loops:
                loops.add(at)
                edges.append((at, ANY_LETTER, at))
        return cls(tuple(edges), frozenset((at,)))

    @lru_cache(maxsize=4096)  # noqa: B019 - few automata, and each is compared by its hash
    def between(self, begin: str, end: str) -> Automaton:
        """Return an automaton for the texts that can stand between ``begin`` and ``end`` here.

        It accepts ``x`` if this automaton accepts ``begin`` + ``x`` + ``end``.
        """
        starts = self._reached_places(frozenset((0,)), begin)
        stops = frozenset(
            at for at in range(self.size) if self._reached_places(frozenset((at,)), end) & self.ends
        )
        edges = [(at + 1, letters, to + 1) for at, letters, to in self.edges]
        first = [(0, letters, to + 1) for at, letters, to in self.edges if at in starts]
        ends = {at + 1 for at in stops} | ({0} if starts & stops else set())
        return Automaton((*dict.fromkeys(first), *edges), frozenset(ends))

    def surrounded(self, begin: str, end: str) -> Automaton:
        """Return an automaton that accepts ``begin`` + name + ``end`` for each accepted name."""
        size, more = self.size, len(begin)
        edges = [(i, Letters.of(letter), i + 1) for i, letter in enumerate(begin)]
        edges += [(at + more, letters, to + more) for at, letters, to in self.edges]
        ends = frozenset(state + more for state in self.ends)
        for i, letter in enumerate(end):
            edges += [(at, Letters.of(letter), more + size + i) for at in sorted(ends)]
            ends = frozenset((more + size + i,))
        return Automaton(tuple(edges), ends)

    def _reached_places(self, places: frozenset[int], text: str) -> frozenset[int]:
        for letter in text:
            places = frozenset(
                to for at, letters, to in self.edges if at in places and letter in letters
            )
        return places

    def __hash__(self) -> int:
        return self._hash

    @cached_property
    def _hash(self) -> int:
        return hash((self.edges, self.ends))

    def matches(self, name: str) -> bool:
        """Return whether the automaton accepts ``name``."""
        if not name.startswith(self.prefix) or not name.endswith(self.suffix):
            return False
        if name not in self._known:
            if len(self._known) >= _MOST_CACHED_NAMES:
                self._known.clear()
            self._known[name] = self._accepts(name)
        return self._known[name]

    @cached_property
    def _known(self) -> dict[str, bool]:
        return {}

    def _accepts(self, name: str) -> bool:
        reached = 1
        if reached & self.endless_bits:
            return True
        for letter in name:
            if letter not in self._moves:
                self._moves[letter] = _moves(
                    (start, stop) for start, letters, stop in self.edges if letter in letters
                )
            reached = _positions_after(reached, self._moves[letter])
            if not reached:
                return False
        return bool(reached & self.end_bits)

    @cached_property
    def _moves(self) -> dict[str, _Moves]:
        return {}

    @cached_property
    def end_bits(self) -> int:
        """The accepting positions: bit n of the integer stands for position n."""
        return sum(1 << end for end in self.ends)

    @cached_property
    def endless_bits(self) -> int:
        """The positions from which every further text is accepted: bit n stands for position n."""
        loops = {at for at, letters, to in self.edges if at == to and letters == ANY_LETTER}
        return sum(1 << state for state in self.ends & loops)

    @cached_property
    def size(self) -> int:
        """The number of positions."""
        return 1 + max((max(at, to) for at, _, to in self.edges), default=0)

    @cached_property
    def levels(self) -> tuple[tuple[int, int], ...]:
        """Pairs of a number and positions (bits), sorted by the number.

        The number is the distance, in letters, from these positions to the nearest accepting one.
        """
        before: dict[int, list[int]] = {}
        for at, letters, to in self.edges:
            if letters:
                before.setdefault(to, []).append(at)
        levels: list[int] = []
        known, row = self.ends, self.ends
        while row:
            levels.append(sum(1 << state for state in row))
            row = frozenset(at for to in row for at in before.get(to, ())) - known
            known |= row
        return tuple(enumerate(levels))

    @cached_property
    def prefix(self) -> str:
        """The text that every accepted name begins with."""
        after: dict[int, list[tuple[Letters, int]]] = {}
        for at, letters, to in self.edges:
            after.setdefault(at, []).append((letters, to))
        return _forced_text(after, 0, self.ends)

    @cached_property
    def suffix(self) -> str:
        """The text that every accepted name ends with, or ""."""
        if len(self.ends) != 1:
            return ""
        before: dict[int, list[tuple[Letters, int]]] = {}
        for at, letters, to in self.edges:
            before.setdefault(to, []).append((letters, at))
        return _forced_text(before, next(iter(self.ends)), frozenset((0,)))[::-1]

    @cached_property
    def order(self) -> tuple[str, str, str]:
        """A sort key that is the same in every run of the program."""
        return self.prefix, self.suffix, repr(self.edges)

    def may_overlap(self, other: Automaton) -> bool:
        """Return False if the prefixes or suffixes show that no name is accepted by both."""
        return _can_overlap(self.prefix, other.prefix) and _can_overlap(
            self.suffix[::-1], other.suffix[::-1]
        )


def _forced_text(
    edges: Mapping[int, Sequence[tuple[Letters, int]]], at: int, stops: frozenset[int]
) -> str:
    """Return the text that must follow position ``at``, up to a fork or a position in ``stops``."""
    text = ""
    while at not in stops:
        moves = edges.get(at, ())
        if len(moves) != 1 or not (letter := moves[0][0].single()):
            break
        text += letter
        at = moves[0][1]
    return text


def _can_overlap(first_text: str, second_text: str) -> bool:
    return first_text.startswith(second_text) or second_text.startswith(first_text)


def _moves(edges: Iterable[tuple[int, int]]) -> _Moves:
    places_by_distance: dict[int, int] = {}
    for at, to in edges:
        places_by_distance[to - at] = places_by_distance.get(to - at, 0) | 1 << at
    return places_by_distance


def _positions_after(positions: int, moves: _Moves) -> int:
    following = 0
    for by, places in moves.items():
        movable = positions & places
        following |= movable << by if by >= 0 else movable >> -by
    return following


# ── sets ───────────────────────────────────────────────────────────────────────────────────

_Truth = bool | None
"""Whether a name is in a set; None while that depends on the rest of the name."""
_Test = Callable[["_Union"], _Truth]


@dataclass(frozen=True)
class _Union:
    """The ``exact`` names, and all names that one of the ``automata`` accepts."""

    exact: frozenset[str] = frozenset()
    automata: frozenset[Automaton] = frozenset()

    @cached_property
    def everything(self) -> frozenset[Automaton]:
        """The automata that accept every name."""
        return frozenset(automaton for automaton in self.automata if automaton.endless_bits & 1)

    def has(self, name: str) -> bool:
        """Return whether a name is in the set."""
        return name in self.exact or self.accepts(name)

    def accepts(self, name: str) -> bool:
        """Return whether an automaton accepts a name."""
        return any(
            automaton.matches(name)
            for length in self._lengths
            for automaton in self._by_prefix.get(name[:length], ())
        )

    def possibly_overlapping(self, automaton: Automaton) -> Iterator[Automaton]:
        """Yield the automata that may accept a name that ``automaton`` accepts."""
        begin = automaton.prefix
        for length in self._lengths:
            if length < len(begin):
                yield from filter(automaton.may_overlap, self._by_prefix.get(begin[:length], ()))
        prefixes = self._prefixes
        for at in range(bisect_left(prefixes, begin), len(prefixes)):
            if not prefixes[at].startswith(begin):
                break
            yield from filter(automaton.may_overlap, self._by_prefix[prefixes[at]])

    @cached_property
    def _by_prefix(self) -> dict[str, list[Automaton]]:
        by_prefix: dict[str, list[Automaton]] = {}
        for automaton in self.automata:
            by_prefix.setdefault(automaton.prefix, []).append(automaton)
        return by_prefix

    @cached_property
    def _prefixes(self) -> list[str]:
        return sorted(self._by_prefix)

    @cached_property
    def _lengths(self) -> list[int]:
        return sorted(set(map(len, self._by_prefix)))

    def parts(self) -> tuple[_Node, ...]:
        return ()

    def truth(self, ask: _Test) -> _Truth:
        return ask(self)


@dataclass(frozen=True)
class _Complement:
    """The names that are not in the set ``of``."""

    of: _Node

    def parts(self) -> tuple[_Node, ...]:
        return (self.of,)

    def truth(self, ask: _Test) -> _Truth:
        inner = self.of.truth(ask)
        return None if inner is None else not inner


@dataclass(frozen=True)
class _Intersection:
    """The intersection of the sets ``of``."""

    of: tuple[_Node, ...]

    def parts(self) -> tuple[_Node, ...]:
        return self.of

    def truth(self, ask: _Test) -> _Truth:
        result: _Truth = True
        for part in self.of:
            inner = part.truth(ask)
            if inner is False:
                return False
            result = result if inner else None
        return result


@dataclass(frozen=True)
class _FirstMatch:
    """The names that a list of rules accepts: the first rule whose set has the name decides.

    ``of`` has pairs of a set and whether its names are accepted; ``last`` is the answer for names
    that are in none of these sets.
    """

    of: tuple[tuple[_Node, bool], ...]
    last: bool

    def parts(self) -> tuple[_Node, ...]:
        return tuple(part for part, _ in self.of)

    def truth(self, ask: _Test) -> _Truth:
        possible: set[bool] = set()
        for part, kept in self.of:
            inner = part.truth(ask)
            if inner is not False:
                possible.add(kept)
            if inner or len(possible) > 1:
                break
        else:
            possible.add(self.last)
        return possible.pop() if len(possible) == 1 else None


@dataclass(frozen=True)
class _AtLeast:
    """The names that are in at least ``count`` of the sets ``of``."""

    of: tuple[_Node, ...]
    count: int

    def parts(self) -> tuple[_Node, ...]:
        return self.of

    def truth(self, ask: _Test) -> _Truth:
        true_parts = 0
        possible_parts = len(self.of)
        for part in self.of:
            inner = part.truth(ask)
            true_parts += inner is True
            possible_parts -= inner is False
            if true_parts >= self.count:
                return True
            if possible_parts < self.count:
                return False
        return None


_Node = _Union | _Complement | _Intersection | _FirstMatch | _AtLeast


class SearchLimit:
    """A limit on the number of search steps of one question."""

    def __init__(self, maximum: int = 600_000) -> None:
        """Set the limit to ``maximum`` steps; the default takes about ten seconds."""
        self._steps_left = maximum

    def spend(self, steps: int) -> None:
        """Subtract ``steps`` from the steps that are left.

        Raises:
            DocumentError: no steps are left.
        """
        self._steps_left -= steps
        if self._steps_left < 0:
            raise _too_many_error()


def _too_many_error() -> DocumentError:
    return DocumentError(
        "there are too many wildcards to decide which names they match",
        "Too many combinations of names would have to be compared, for example with many '?' after "
        "a '*'.",
        "Use fewer wildcards, or names in place of wildcards.",
    )


class NameSet:
    """An immutable set of names, which may be infinite.

    ``|``, ``&``, ``-`` and ``~`` return new sets.
    """

    __slots__ = ("_node",)

    def __init__(self, exact_names: Iterable[str] = (), automata: Iterable[Automaton] = ()) -> None:
        """Create the set of the ``exact_names`` and of all names that an automaton accepts."""
        self._node: _Node = _Union(frozenset(exact_names), frozenset(automata))

    @classmethod
    def of_automata(cls, automata: Mapping[str, Automaton | None]) -> NameSet:
        """Return the names of automata by expression; None stands for the expression's own text."""
        exact_names = (text for text, automaton in automata.items() if automaton is None)
        return cls(exact_names, filter(None, automata.values()))

    @classmethod
    def _of(cls, node: _Node) -> NameSet:
        name_set = cls()
        name_set._node = node
        return name_set

    @classmethod
    def first(cls, rules: Iterable[tuple[NameSet, bool]], otherwise: bool = False) -> NameSet:
        """Return the names that a list of rules accepts: the first rule with the name decides.

        A rule is a set and whether its names are accepted; ``otherwise`` decides on all other
        names.
        """
        joined = [
            (cls.union(names for names, _ in group)._node, kept)
            for kept, group in groupby(rules, key=lambda pair: pair[1])
        ]
        if not otherwise and joined and not joined[-1][1]:
            joined.pop()  # removes names that no other rule accepts
        if not otherwise and len(joined) == 1:
            return cls._of(joined[0][0])
        return cls._of(_FirstMatch(tuple(joined), otherwise))

    @classmethod
    def union(cls, sets: Iterable[NameSet]) -> NameSet:
        """Return the names that are in at least one of several sets."""
        other_nodes: list[_Node] = []
        exact: set[str] = set()
        automata: set[Automaton] = set()
        for names in sets:
            if isinstance(names._node, _Union):
                exact |= names._node.exact
                automata |= names._node.automata
            else:
                other_nodes.append(names._node)
        plain = _Union(frozenset(exact), frozenset(automata))
        if not other_nodes:
            return cls._of(plain)
        return cls._of(_FirstMatch(tuple((part, True) for part in (plain, *other_nodes)), False))

    @classmethod
    def at_least(cls, count: int, sets: Iterable[NameSet]) -> NameSet:
        """Return the names that are in at least ``count`` of several sets."""
        return cls._of(_AtLeast(tuple(names._node for names in sets), count))

    def between(self, begin: str, end: str) -> NameSet:
        """Return the texts ``x`` for which ``begin`` + ``x`` + ``end`` is in this set."""
        return NameSet._of(_between(self._node, begin, end))

    def superset(self) -> Superset | None:
        """Return a simple set with all names of this set, and perhaps others.

        Returns None if the only such set that is found is the set of all names.
        """
        return _superset_of(self._node, _longest_affixes_first)

    def __or__(self, other: NameSet) -> NameSet:
        return NameSet.union((self, other))

    def __and__(self, other: NameSet) -> NameSet:
        for name_set, two in ((self, other), (other, self)):
            if isinstance(name_set._node, _Union) and not name_set._node.automata:
                return NameSet(name for name in name_set._node.exact if name in two)
        return NameSet._of(_Intersection((self._node, other._node)))

    def __sub__(self, other: NameSet) -> NameSet:
        if isinstance(self._node, _Union) and not self._node.automata:
            return NameSet(name for name in self._node.exact if name not in other)
        return NameSet._of(_Intersection((self._node, _Complement(other._node))))

    def __invert__(self) -> NameSet:
        return NameSet._of(_Complement(self._node))

    def __eq__(self, other: object) -> bool:
        """Return whether both sets were built in the same way.

        Sets with the same names may be unequal, if they were built in different ways.
        """
        return isinstance(other, NameSet) and self._node == other._node

    def __hash__(self) -> int:
        return hash(self._node)

    def __contains__(self, name: str) -> bool:
        return bool(self._node.truth(lambda leaf: leaf.has(name)))

    def stated(self) -> Iterator[str]:
        """Yield the exact names in this set, the shortest first; not the names of wildcards."""
        exact = {name for leaf in _leaves(self._node) for name in leaf.exact}
        return (name for name in sorted(exact, key=_shortest_first) if name in self)

    def example(
        self, limit: SearchLimit | None = None, *, longest: int | None = None
    ) -> str | None:
        """Return the first name of this set, or None if the set is empty.

        Exact names come first, then short names, so the result is always the same.  Names longer
        than ``longest``, in bytes of UTF-8, are ignored.

        Raises:
            DocumentError: the search takes more steps than ``limit`` allows.
        """
        for name in self.stated():
            if longest is None or len(name.encode()) <= longest:
                return name
        limit = limit or SearchLimit()
        best: str | None = None
        for search in _searches(self._node, limit):
            example_name = search.shortest(limit, longest)
            if example_name is not None and (
                best is None or _shortest_first(example_name) < _shortest_first(best)
            ):
                best = example_name
        return best

    def is_empty(self, limit: SearchLimit | None = None) -> bool:
        """Return whether this set has no name.

        Raises:
            DocumentError: the search takes more steps than ``limit`` allows.
        """
        if next(self.stated(), None) is not None:
            return False
        limit = limit or SearchLimit()
        return all(search.shortest(limit, None) is None for search in _searches(self._node, limit))


def _between(node: _Node, begin: str, end: str) -> _Node:
    match node:
        case _Union():
            size = len(begin) + len(end)
            exact = frozenset(
                name[len(begin) : len(name) - len(end)]
                for name in node.exact
                if len(name) >= size and name.startswith(begin) and name.endswith(end)
            )
            return _Union(
                exact, frozenset(automaton.between(begin, end) for automaton in node.automata)
            )
        case _Complement():
            return _Complement(_between(node.of, begin, end))
        case _Intersection():
            return _Intersection(tuple(_between(part, begin, end) for part in node.of))
        case _FirstMatch():
            of = tuple((_between(part, begin, end), kept) for part, kept in node.of)
            return _FirstMatch(of, node.last)
        case _AtLeast():
            return _AtLeast(tuple(_between(part, begin, end) for part in node.of), node.count)


@dataclass(frozen=True, slots=True)
class Superset:
    """A set with all names of another set: ``exact`` names, and the names of ``automata``."""

    exact: frozenset[str]
    automata: frozenset[Automaton]


def _superset_of(node: _Node, rank: Callable[[Superset], tuple[int, int]]) -> Superset | None:
    """Return a simple set with all names of ``node``, or None if none is found.

    If several sets are found, the set with the lowest ``rank`` is returned.
    """
    match node:
        case _Union():
            return Superset(node.exact, node.automata)
        case _Complement():
            return None
        case _Intersection():
            parts = (_superset_of(part, rank) for part in node.of)
            return min(filter(None, parts), key=rank, default=None)
        case _FirstMatch():
            operands = [part for part, kept in node.of if kept]
            if node.last:
                return None
        case _AtLeast():
            operands = list(node.of)
    supersets_of_operands = [_superset_of(operand, rank) for operand in operands]
    known = [surroundings for surroundings in supersets_of_operands if surroundings is not None]
    if len(known) < len(supersets_of_operands):
        return None
    return Superset(
        frozenset[str]().union(*(surroundings.exact for surroundings in known)),
        frozenset[Automaton]().union(*(surroundings.automata for surroundings in known)),
    )


def _longest_affixes_first(superset: Superset) -> tuple[int, int]:
    """Return a sort key for sets that puts long prefixes and suffixes first."""
    known = min(
        (len(a.prefix) + len(a.suffix) for a in superset.automata), default=_LAST_CODE_POINT
    )
    return -known, -len(superset.exact)


def _shortest_first(name: str) -> tuple[int, str]:
    return len(name.encode(errors="surrogatepass")), name


def _leaves(node: _Node) -> Iterator[_Union]:
    if isinstance(node, _Union):
        yield node
    for part in node.parts():
        yield from _leaves(part)


# ── searching ──────────────────────────────────────────────────────────────────────────────


def _simplified(
    node: _Node,
    certain_automata: frozenset[Automaton],
    possible_automata: frozenset[Automaton] | None,
) -> _Node | bool:
    """Return the set, simplified for certain names only; its exact names are left out.

    All of ``certain_automata`` accept these names. Each of ``possible_automata`` may accept them
    (None: any other automaton may), and no other automaton accepts them. The result is True if the
    set has all of these names, and False if it has none of them.
    """
    if isinstance(node, _Union):
        if not certain_automata.isdisjoint(node.automata):
            return True
        left = node.automata if possible_automata is None else possible_automata & node.automata
        if not left:
            return False
        return _Union(automata=left) if len(left) < len(node.automata) or node.exact else node
    if isinstance(node, _Complement):
        inner = _simplified(node.of, certain_automata, possible_automata)
        return not inner if isinstance(inner, bool) else _Complement(inner)
    if isinstance(node, _Intersection):
        kept: list[_Node] = []
        for part in node.of:
            inner = _simplified(part, certain_automata, possible_automata)
            if inner is False:
                return False
            if not isinstance(inner, bool):
                kept.append(inner)
        return (kept[0] if len(kept) == 1 else _Intersection(tuple(kept))) if kept else True
    if isinstance(node, _AtLeast):
        parts = [_simplified(part, certain_automata, possible_automata) for part in node.of]
        count = node.count - parts.count(True)
        undecided_parts = tuple(part for part in parts if not isinstance(part, bool))
        if count <= 0 or len(undecided_parts) < count:
            return count <= 0
        return _AtLeast(undecided_parts, count)
    rules: list[tuple[_Node, bool]] = []
    last = node.last
    for part, says in node.of:
        inner = _simplified(part, certain_automata, possible_automata)
        if inner is True:
            last = says
            break
        if not isinstance(inner, bool):
            rules.append((inner, says))
    while rules and rules[-1][1] is last:
        rules.pop()
    return _FirstMatch(tuple(rules), last) if rules else last


_AUTOMATA_PER_STEP = 16
"""Number of automata that can be compared in the time of one search step."""
_SMALL_SET = 64
_MOST_AUTOMATA = 8192
"""Largest number of automata in one search: more could take gigabytes of memory."""


def _searches(node: _Node, limit: SearchLimit) -> Iterator[_Search]:
    """Yield searches that together find every name of a set, except its exact names.

    A search considers the names that one automaton accepts, and only the other automata that may
    accept some of these names.  If no small group of automata covers the set, the last search
    considers the names that no automaton accepts.
    """
    leaves = tuple(_leaves(node))
    automata = frozenset[Automaton]().union(*(leaf.automata for leaf in leaves))
    if len(automata) > _MOST_AUTOMATA:
        raise _too_many_error()
    exact = frozenset[str]().union(*(leaf.exact for leaf in leaves))
    accepting_all = frozenset[Automaton]().union(*(leaf.everything for leaf in leaves))
    superset = _superset_of(node, _fewest_automata_first)
    for searched in sorted(
        automata if superset is None else superset.automata, key=_automaton_order
    ):
        met = frozenset(
            automaton for leaf in leaves for automaton in leaf.possibly_overlapping(searched)
        )
        if further_steps := len(met) // _AUTOMATA_PER_STEP:
            limit.spend(further_steps)
        left = _simplified(node, accepting_all | {searched}, met)
        if left is not False:
            yield _Search(
                _accepted_names(searched, left), frozenset(filter(searched.matches, exact))
            )
    no_automata = frozenset[Automaton]()
    if superset is None and not accepting_all and _simplified(node, no_automata, no_automata):
        left = _simplified(node, no_automata, None)
        yield _Search(_Complement(_Union()) if isinstance(left, bool) else left, exact)


def _fewest_automata_first(superset: Superset) -> tuple[int, int]:
    """Return a sort key that puts sets with few automata first.

    Small sets with an automaton without prefix and suffix come after other small sets.
    """
    if len(superset.automata) > _SMALL_SET:
        return len(superset.automata), 0
    affixes, _ = _longest_affixes_first(superset)
    return len(superset.automata) + (not affixes) * _MOST_AUTOMATA, affixes


def _including_automata(node: _Node) -> frozenset[Automaton]:
    """Return automata, each of which accepts every name of a set without exact names."""
    match node:
        case _Union():
            return node.automata if len(node.automata) == 1 else frozenset()
        case _Complement():
            return _excluding_automata(node.of)
        case _Intersection():
            return frozenset[Automaton]().union(*map(_including_automata, node.of))
        case _AtLeast():
            counts = Counter(need for part in node.of for need in _including_automata(part))
            spare = len(node.of) - node.count
            return frozenset(automaton for automaton, number in counts.items() if number > spare)
        case _FirstMatch(last=False):
            return _common_automata(_including_automata(part) for part, says in node.of if says)
    return frozenset()


def _excluding_automata(node: _Node) -> frozenset[Automaton]:
    """Return automata, each of which accepts every name outside of a set without exact names."""
    match node:
        case _Complement():
            return _including_automata(node.of)
        case _Intersection():
            return _common_automata(map(_excluding_automata, node.of))
        case _FirstMatch(last=True):
            return _common_automata(_including_automata(part) for part, says in node.of if not says)
    return frozenset()


def _common_automata(sets: Iterable[frozenset[Automaton]]) -> frozenset[Automaton]:
    """Return the automata that are in all of the sets; none if there are no sets."""
    first, *others = [*sets] or [frozenset[Automaton]()]
    return first.intersection(*others)


def _accepted_names(automaton: Automaton, left: _Node | bool) -> _Node:
    """Return the names of the set ``left`` (True: all names) that ``automaton`` accepts."""
    node = _Union(automata=frozenset((automaton,)))
    return node if isinstance(left, bool) else _Intersection((node, left))


def _automaton_order(automaton: Automaton) -> tuple[str, str, str]:
    return automaton.order


class _Search:
    """The search for the shortest name of a set, except the names in ``taken``.

    The set has no exact names.  The search is A*: a state is the set of positions that all automata
    have reached, and a state comes early if few letters are left to a name of the set.
    """

    def __init__(self, node: _Node, taken: frozenset[str]) -> None:
        self._node = node
        automata = {automaton for leaf in _leaves(node) for automaton in leaf.automata}
        self._machine = _machine(tuple(sorted(automata, key=_automaton_order)))
        self._including_automata = _including_automata(node)
        self._taken = _ExcludedNames(name for name in taken if node.truth(_contains_test(name)))

    def shortest(self, limit: SearchLimit, longest: int | None) -> str | None:
        """Return a shortest name of the set, or None if the set is empty."""
        machine, taken = self._machine, self._taken
        start = machine.start, 0
        costs = {start: 0}
        before: dict[tuple[int, int], tuple[tuple[int, int], str]] = {}
        left = self._fewest_letters_left(machine.start)
        if left is None:
            return None
        number = count()
        row = [(left, 0, next(number), start)]
        while row:
            _, minus, _, state = heapq.heappop(row)
            cost = -minus
            if cost > costs[state]:
                continue
            reached, place = state
            if place not in taken.ends and self._node.truth(machine.acceptance_test(reached)):
                return _letters_to(state, before)
            ways = taken.next_letters(place, machine.classes)
            limit.spend(len(ways) * (1 + machine.size // 1024))
            for letter, moves, next_place in ways:
                to = _positions_after(reached, moves) & machine.useful
                new, new_cost = (to, next_place), cost + len(letter.encode())
                if (
                    costs.get(new, new_cost + 1) <= new_cost
                    or (left := self._fewest_letters_left(to)) is None
                ):
                    continue
                if longest is None or new_cost + left <= longest:
                    costs[new] = new_cost
                    before[new] = state, letter
                    heapq.heappush(row, (new_cost + left, -new_cost, next(number), new))
        return None

    def _fewest_letters_left(self, positions: int) -> int | None:
        """Return the fewest letters that complete a name, or None if no name begins in this way."""
        left = 0
        for need in self._including_automata:
            fewest = self._machine.fewest_letters_left(need, positions)
            if fewest is None:
                return None
            left = max(left, fewest)
        return (
            None
            if self._node.truth(self._machine.longer_acceptance_test(positions)) is False
            else left
        )


def _contains_test(name: str) -> _Test:
    return lambda leaf: leaf.accepts(name)


def _letters_to(
    state: tuple[int, int], before: Mapping[tuple[int, int], tuple[tuple[int, int], str]]
) -> str:
    """Return the letters that lead from the start to ``state``.

    ``before`` maps a state to the previous state and the letter between the two.
    """
    letters = []
    while state in before:
        state, letter = before[state]
        letters.append(letter)
    return "".join(reversed(letters))


@lru_cache(maxsize=1024)
def _machine(automata: tuple[Automaton, ...]) -> _ParallelAutomata:
    return _ParallelAutomata(automata)


class _LetterClass(NamedTuple):
    """Letters that every automaton treats in the same way, with the best letter for examples."""

    letters: Letters
    best: str
    moves: _Moves


class _ParallelAutomata:
    """Several automata that run in parallel.

    The positions of all automata are the bits of one integer, ``reached`` in its methods.
    """

    def __init__(self, automata: tuple[Automaton, ...]) -> None:
        sizes = [automaton.size for automaton in automata]
        begins = dict(zip(automata, accumulate((0, *sizes)), strict=False))
        self.size = sum(sizes)
        self._span = {a: ((1 << a.size) - 1) << begin for a, begin in begins.items()}
        self._ends = {a: a.end_bits << begin for a, begin in begins.items()}
        self._endless = {a: a.endless_bits << begin for a, begin in begins.items()}
        self._levels = {
            a: [(distance, places << begin) for distance, places in a.levels]
            for a, begin in begins.items()
        }
        self.useful = sum(places for levels in self._levels.values() for _, places in levels)
        self.start = sum(1 << begin for begin in begins.values()) & self.useful
        self.classes = _letter_classes(
            (at + begin, letters, to + begin)
            for a, begin in begins.items()
            for at, letters, to in a.edges
        )

    def acceptance_test(self, positions: int) -> _Test:
        """Return a function that says whether an automaton of a set accepts at ``positions``."""
        return lambda leaf: any(positions & self._ends[automaton] for automaton in leaf.automata)

    def longer_acceptance_test(self, positions: int) -> _Test:
        """Return a function that says whether the automata of a set accept longer texts.

        The automata are at ``positions``.  The result is True if at least one automaton accepts
        every longer text, False if none accepts any, and None if this depends on the text.
        """

        def ask(leaf: _Union) -> _Truth:
            if any(positions & self._endless[automaton] for automaton in leaf.automata):
                return True
            return (
                None
                if any(positions & self._span[automaton] for automaton in leaf.automata)
                else False
            )

        return ask

    def fewest_letters_left(self, automaton: Automaton, positions: int) -> int | None:
        """Return the fewest letters after which an automaton accepts; None if there is no way."""
        for distance, places in self._levels[automaton]:
            if positions & places:
                return distance
        return None


def _letter_classes(edges: Iterable[tuple[int, Letters, int]]) -> tuple[_LetterClass, ...]:
    """Return classes of letters that all edges treat alike, sorted by their best letter."""
    by_letters: dict[Letters, list[tuple[int, int]]] = {}
    for at, letters, to in edges:
        by_letters.setdefault(letters, []).append((at, to))
    kinds = list(by_letters)
    borders = (
        {low for low, _ in _EXCLUDED_RANGES} | {high + 1 for _, high in _EXCLUDED_RANGES} | {0}
    )
    borders |= {end for kind in kinds for low, high in kind.ranges for end in (low, high + 1)}
    ranges_by_membership: dict[tuple[bool, ...], list[tuple[int, int]]] = {}
    ordered = sorted(borders | {_LAST_CODE_POINT + 1})
    for low, after in pairwise(ordered):
        if (letter := chr(low)) in _USABLE_LETTERS:
            key = tuple(letter in kind for kind in kinds)
            ranges_by_membership.setdefault(key, []).append((low, after - 1))
    classes = []
    for key, ranges in ranges_by_membership.items():
        letters = Letters(tuple(ranges))
        of = (by_letters[kind] for kind, has in zip(kinds, key, strict=True) if has)
        classes.append(
            _LetterClass(
                letters,
                _best_letter(letters),
                _moves(edge for edges_of_kind in of for edge in edges_of_kind),
            )
        )
    return tuple(sorted(classes, key=lambda each: _letter_rank(each.best)))


def _best_letter(letters: Letters, excluded: Container[str] = ()) -> str:
    """Return the best letter for an example, or "" if all of them are excluded."""
    for letter in _PREFERRED_LETTERS:
        if letter in letters and letter not in excluded:
            return letter
    # Control characters come last.
    ranges = sorted(letters.ranges, key=lambda pair: (pair[1] < ord(" "), pair))
    every = (chr(number) for low, high in ranges for number in range(low, high + 1))
    return next((letter for letter in every if letter not in excluded), "")


def _letter_rank(letter: str) -> tuple[int, str]:
    at = _PREFERRED_LETTERS.find(letter)
    return (at if at >= 0 else len(_PREFERRED_LETTERS)), letter


class _ExcludedNames:
    """Names that a search leaves out, as a tree of their letters.

    A place is the number of a node of the tree; -1 is every place outside of the tree.
    """

    def __init__(self, names: Iterable[str]) -> None:
        self._tree: list[dict[str, int]] = [{}]
        self.ends: set[int] = set()
        for name in names:
            at = 0
            for letter in name:
                at = self._tree[at].setdefault(letter, len(self._tree))
                if at == len(self._tree):
                    self._tree.append({})
            self.ends.add(at)
        self._ways: dict[int, list[tuple[str, _Moves, int]]] = {}

    def next_letters(
        self, place: int, classes: Sequence[_LetterClass]
    ) -> list[tuple[str, _Moves, int]]:
        """Return the next letters to try at a place, each with its moves and the next place."""
        if place not in self._ways:
            children = self._tree[place] if place >= 0 else {}
            next_letters = []
            for letters, best, moves in classes:
                other = _best_letter(letters, children) if best in children else best
                if other:
                    next_letters.append((other, moves, -1))
                inner = ((letter, to) for letter, to in children.items() if letter in letters)
                next_letters += [(letter, moves, to) for letter, to in inner]
            self._ways[place] = next_letters
        return self._ways[place]
