"""Key expressions are canonical and include each other as Zenoh itself says."""

from __future__ import annotations

import random

import pytest

from sros_tool.zenoh.key_expressions import (
    canonical,
    common,
    expression_problem,
    includes,
    intersects,
    names_of,
)
from tests.support.children import LONG


@pytest.mark.parametrize(
    ("chunks", "text"),
    [
        (("0", "a"), "0/a"),
        (("**", "*"), "*/**"),
        (("**", "*", "**", "*"), "*/*/**"),
        (("**", "$*"), "*/**"),
        (("**", "$*cam"), "**/$*cam"),
        (("a$*$*",), "a$*"),
        (("**", "**", "@adv", "**"), "**/@adv/**"),
    ],
)
def test_canonical(chunks: tuple[str, ...], text: str) -> None:
    assert canonical(chunks) == text


@pytest.mark.parametrize(
    ("wide", "narrow", "included"),
    [
        ("0/chatter/*/*", "0/chatter/t/h", True),
        ("0/chatter/*/*", "0/chatter/secret/t/h", False),
        ("0/chatter/*/*", "0/*/*/*", False),
        ("0/**", "0/@adv", False),
        ("0/**", "0", True),
        ("0/a$*b", "0/ab", True),
        ("0/a$*b", "0/a", False),
        ("0/$*a$*", "0/*", False),
        ("0/*", "0/a$*", True),
        ("a/*/**", "a/**/b", False),  # although it includes every key of it
    ],
)
def test_includes(wide: str, narrow: str, included: bool) -> None:
    assert includes(wide, narrow) is included


def drawn_expression(draw: random.Random) -> str:
    """Return a random canonical expression of few letters, so that many include each other."""

    def chunk() -> str:
        kind = draw.random()
        if kind < 0.4:
            return "*" if kind < 0.2 else "**"
        if kind < 0.5:
            return "@" + draw.choice("ab")
        return "".join(draw.choice(["a", "b", "$*"]) for _ in range(draw.randint(1, 3)))

    return canonical(chunk() for _ in range(draw.randint(1, 5)))


def test_zenoh_itself_says_the_same() -> None:
    """Also whether two expressions intersect."""
    zenoh = pytest.importorskip("zenoh", reason="the wheel eclipse-zenoh is missing")
    draw, included, met = random.Random(15), 0, 0
    count = 1_000_000 if LONG else 10_000
    for _ in range(count):
        wide, narrow = drawn_expression(draw), drawn_expression(draw)
        # The constructor refuses what is not canonical.
        one, other = zenoh.KeyExpr(wide), zenoh.KeyExpr(narrow)
        told = one.includes(other)
        assert includes(wide, narrow) is told, (wide, narrow)
        included += told
        told = one.intersects(other)
        assert intersects(wide, narrow) is told, (wide, narrow)
        met += told
    assert included > count // 20
    assert included + count // 20 < met < count // 2


def test_what_two_expressions_have_in_common() -> None:
    draw, met, several = random.Random(32), 0, 0
    for _ in range(20_000 if LONG else 1_000):
        one, other = drawn_expression(draw), drawn_expression(draw)
        found = common(one, other)
        assert not any(expression_problem(each) for each in found)
        assert all(includes(one, each) and includes(other, each) for each in found), (one, other)
        assert bool(found) is intersects(one, other), (one, other)
        both = names_of([one]) & names_of([other])
        assert (both - names_of(found)).example() is None, (one, other, found)
        met += bool(found)
        several += len(found) > 1
    assert met > 200 and several > 20


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("a/*/@b/**/c$*d", ""),
        ("", "begins"),
        ("a//b", "begins"),
        ("a/b#", "not allowed"),
        ("a*", "has to be '$*'"),
        ("$a", "has to be '$*'"),
        ("**/*", "has to be written '*/**'"),
        ("a$*$*", "has to be written 'a$*'"),
    ],
)
def test_what_is_no_expression(text: str, problem: str) -> None:
    found = expression_problem(text)
    assert problem in found
    assert bool(found) is bool(problem)


def drawn_text(draw: random.Random) -> str:
    return "".join(draw.choice(["a", "/", "*", "**", "$*", "$", "@", "/", "#"]) for _ in range(5))


def test_zenoh_itself_accepts_the_same() -> None:
    zenoh = pytest.importorskip("zenoh", reason="the wheel eclipse-zenoh is missing")
    draw, accepted = random.Random(15), 0
    for _ in range(20_000):
        text = drawn_text(draw)
        try:
            zenoh.KeyExpr(text)
            problem = False
        except zenoh.ZError:
            problem = True
        assert bool(expression_problem(text)) is problem, text
        accepted += not problem
    assert accepted > 200
