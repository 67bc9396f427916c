"""Expressions are compared fast, many at once, and as a plain search of their pieces compares."""

from __future__ import annotations

import re
from fnmatch import fnmatchcase
from random import Random

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from sros_tool.errors import DocumentError
from sros_tool.names import is_expression
from sros_tool.policy.patterns import (
    ComparisonLimit,
    Names,
    TooManyNames,
    covers,
    listed_expressions,
    literal_prefix,
    matches,
    overlap,
    renamed_matches,
)
from tests.support.long_form import some

PIECES = ["a", "b", "ab", "/", "/", "*", "*", "?", "[ab]", "[!a]", "[a-c]", "[b]", "a]", "c"]
patterns = st.lists(st.sampled_from(PIECES), min_size=1, max_size=8).map("".join)
sets = st.lists(patterns, max_size=40)

# ── a plain comparison ─────────────────────────────────────────────────────────────────────

Piece = frozenset[str] | None
"""The letters that a piece matches; None for ``*``."""

LETTERS = frozenset(map(chr, range(33, 127)))


def pieces(expression: str) -> list[Piece]:
    found: list[Piece] = []
    for star, any_one, members, literal in re.findall(
        r"(\*+)|(\?)|\[([^\]]+)\]|(.)", expression, re.DOTALL
    ):
        if star:
            found.append(None)
        elif any_one:
            found.append(LETTERS)
        elif literal:
            found.append(frozenset(literal))
        else:
            chosen = frozenset(c for c in LETTERS if fnmatchcase(c, f"[{members}]"))
            found.append(chosen)
    return found


def plainly_overlap(one: str, other: str) -> bool:
    first, second = pieces(one), pieces(other)
    seen: set[tuple[int, int]] = set()
    states = [(0, 0)]
    while states:
        i, j = state = states.pop()
        if state in seen:
            continue
        seen.add(state)
        if (i, j) == (len(first), len(second)):
            return True
        here = first[i] if i < len(first) else frozenset[str]()
        there = second[j] if j < len(second) else frozenset[str]()
        if here is None:
            states += [(i + 1, j)] + ([(i, j + 1)] if j < len(second) else [])
        if there is None:
            states += [(i, j + 1)] + ([(i + 1, j)] if i < len(first) else [])
        if here and there and here & there:
            states.append((i + 1, j + 1))
    return False


def plainly_covers(wide: str, narrow: str) -> bool:
    """Whether each piece of ``narrow`` has one of ``wide`` that matches at least as much."""
    if not is_expression(narrow):
        return fnmatchcase(narrow, wide)
    outer, inner = pieces(wide), pieces(narrow)
    reached = {0}
    for piece in [*inner, frozenset[str]()]:
        for i, each in enumerate(outer):
            if each is None and i in reached:
                reached.add(i + 1)
        if piece == frozenset():
            break
        reached = {i for i in reached if i < len(outer) and outer[i] is None} | {
            i + 1
            for i in reached
            if piece is not None and i < len(outer) and (each := outer[i]) and piece <= each
        }
    return narrow.startswith(literal_prefix(wide)) and len(outer) in reached


# ── two expressions ────────────────────────────────────────────────────────────────────────


@given(patterns, patterns)
@example("*", "?")
@example("*a?", "?b*")
@example("a*b*c", "a?c")
@example("a*ab", "ab*b")
@example("*ab*", "*ba*")
def test_two_expressions(one: str, other: str) -> None:
    assert overlap(one, other) == plainly_overlap(one, other)
    assert covers(one, other) == (one == other or plainly_covers(one, other))


@given(patterns, st.text("abc/]", max_size=8))
def test_a_name(expression: str, name: str) -> None:
    assert matches(expression, name) == fnmatchcase(name, expression)


def test_a_set_without_members_matches_nothing() -> None:
    assert not overlap("/[b-a]", "/*")
    assert not covers("/[b-a]", "/a")
    assert not covers("/[b-a]", "/a*")


# ── many expressions ───────────────────────────────────────────────────────────────────────


@given(sets, patterns)
def test_many_expressions(names: list[str], asked: str) -> None:
    known = list(dict.fromkeys(names))
    for few in (0, 100):  # with the index, and one by one
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr("sros_tool.policy.patterns._MAX_WITHOUT_INDEX", few)
            found = Names(names)
            covering = [e for e in known if e != asked and plainly_covers(e, asked)]
            assert list(found.covering(asked)) == [e for e in covering if is_expression(e)]
            met = [e for e in known if plainly_overlap(e, asked)]
            assert found.overlaps(asked) == bool(met)
            assert sorted(found.overlapping(asked)) == sorted(met)
            if is_expression(asked):
                assert list(found.overlapping(asked)) == met


ALIKE = {
    "a namespace": "/robot_{i}/*",
    "an end": "/*_{i}",
    "a middle": "/*m_{i}*",
    "two middles": "/*a{i}*b{j}*",
    "characters": "/a?{i}",
    "a set": "/a[bc]{i}/*",
    "both ends": "/r{j}/*/s_{i}",
}


@pytest.mark.parametrize("kind", some([*ALIKE], 2))
def test_few_of_many_are_compared(kind: str) -> None:
    """Of 3,000 expressions, each is compared with the few that could cover or meet it."""
    names = [ALIKE[kind].format(i=i, j=i % 97) for i in range(3000)]
    other = [each.replace("/", "/x", 1) for each in names]
    total = sum(map(len, names + other))
    limit = ComparisonLimit(200 * total)  # of 3,000 comparisons for each
    found = Names(names, limit)
    for each in other:
        list(found.covering(each))
        found.overlaps(each)
    with pytest.raises(DocumentError, match="too many"):
        limit.spend(200 * total + 1)


def test_too_many_comparisons_are_refused() -> None:
    dice = Random(0)
    names = ["/*" + "*".join(dice.choices("ab", k=12)) + "*" for _ in range(3000)]
    found = Names(names, ComparisonLimit(1_000_000))
    with pytest.raises(DocumentError, match=r"too many .* to be compared"):
        for each in names:
            list(found.covering(each + "c"))


NAMES = ("/a", "/b", "/ab", "/az", "/a9", "/a/b", "/aab", "/ac", "/a9b", "/bZ", "/c_")


@pytest.mark.parametrize(
    ("expression", "count"),
    [("/a", 1), ("/a*", 1), ("/a?", 63), ("/a?b", 64), ("/[ab][!a-z]", 2 * 37), ("/[a/]b", 1)],
)
def test_choices_of_characters_are_listed(expression: str, count: int) -> None:
    found = listed_expressions(expression, 4096)
    assert len(found) == count
    for name in NAMES:
        if name not in ("/a/b",):  # a "/" in a set stands for itself
            assert any(matches(each, name) for each in found) == matches(expression, name), name


def test_too_many_choices_are_refused() -> None:
    assert len(listed_expressions("/[a-h][a-h]", 64)) == 64
    for expression in ("/[a-h][a-i]", "/???", "/" + "?" * 900):
        with pytest.raises(TooManyNames):
            listed_expressions(expression, 64)


@given(patterns, st.text("ab/", max_size=6))
@example("/*a/b", "b")
@example("/a/[ab]?", "ab")
def test_no_renamed_name_is_lost(expression: str, rest: str) -> None:
    name = f"/a/{rest}"
    news = [new for _, new in renamed_matches(expression, "/a/*", "/c/d/*")]
    is_name = "//" not in name and name[-1] != "/"
    found = any(matches(new, f"/c/d/{rest}") for new in news)
    assert found == matches(expression, name) or not is_name
