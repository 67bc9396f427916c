"""Expressions less others are the names that only the first matches: exactly, or not at all."""

from __future__ import annotations

import contextlib
import re
import time
from itertools import product

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sros_tool.names import expression_problem
from sros_tool.policy.patterns import matches
from sros_tool.policy.subtraction import IN_PART, CannotSubtract, listed, subtract
from tests.support.children import LONG

PARTS = ("a", "b", "ab", "ba", "aab", "az", "z", "_", "a9", "Z_b")
NAMES = ["/" + "/".join(parts) for count in (1, 2, 3) for parts in product(PARTS, repeat=count)]


def said(expressions: list[str]) -> re.Pattern[str]:
    """What a result means, as one regular expression."""
    forms = (
        re.escape(each).replace(r"\*", ".*").replace(re.escape(IN_PART), "[^/]*")
        for each in expressions
    )
    return re.compile("|".join(f"(?:{each})" for each in forms) or r"(?!)")


def check(wide: str, denied: list[str], found: list[str]) -> None:
    meant = said(found)
    for name in NAMES:
        wanted = matches(wide, name) and not any(matches(each, name) for each in denied)
        assert bool(meant.fullmatch(name)) == wanted, (wide, denied, name)


@pytest.mark.parametrize(
    ("wide", "denied", "most"),
    [
        ("/a", ["/b"], 1),
        ("/a", ["/*"], 0),
        ("/a*", ["/b*"], 1),
        ("/*", ["/a"], 64),
        ("/*", ["/ab/*"], 68),
        ("/*", ["/front_camera/*"], 142),
        ("/*", ["/front_camera/*", "/back_camera/*"], 212),
        ("/*", ["/cmd_vel", "/emergency_stop", "/odom", "/tf", "/tf_static", "/scan"], 500),
        ("/*", ["/*/set_parameters"], 159),
        ("/*", ["/*ab"], 130),
        ("/*", ["/front*/image"], 391),
        ("/a*", ["/*b", "/ab/a"], 191),
        ("/*/a", ["/ab/*"], 70),
        ("/*/a", ["*/b/a"], 70),
        ("*/a", ["/ab/a"], 70),
        ("/*", ["/*"], 0),
        ("/*a*b*", ["/ab"], 250),
    ],
)
def test_few_expressions_are_enough(wide: str, denied: list[str], most: int) -> None:
    found = subtract(wide, denied, 4096)
    assert len(found) <= most
    check(wide, denied, found)


@pytest.mark.parametrize(
    ("wide", "denied", "why"),
    [
        ("/*", ["/a", "/*camera*"], "/*camera*"),
        ("/*", ["/a*x*b"], "/a*x*b"),
        ("/*", ["/front_camera/*", "/*/set_parameters"], ""),
    ],
)
def test_what_no_list_says_is_refused(wide: str, denied: list[str], why: str) -> None:
    with pytest.raises(CannotSubtract) as caught:
        subtract(wide, denied, 4096)
    assert caught.value.denied == why


EXPRESSION = (
    st.text("aab/**", min_size=1, max_size=6)
    .map(lambda text: re.sub(r"\*+", "*", f"/{text}"))
    .filter(lambda text: not expression_problem(text))
)


@settings(max_examples=3000 if LONG else 150, deadline=None)
@given(EXPRESSION, st.lists(EXPRESSION, min_size=1, max_size=3))
def test_the_difference_is_exact_on_names_of_ros(wide: str, denied: list[str]) -> None:
    try:
        found = subtract(wide, denied, 4096)
    except CannotSubtract:
        return
    check(wide, denied, found)


@pytest.mark.parametrize(
    ("expression", "count"),
    [("/a", 1), ("/a*", 1), ("/a?", 63), ("/a?b", 64), ("/[ab][!a-z]", 2 * 37), ("/[a/]b", 1)],
)
def test_choices_of_characters_are_listed(expression: str, count: int) -> None:
    found = listed(expression, 4096)
    assert len(found) == count
    for name in (*NAMES, "/ac", "/a9b", "/bZ", "/c_"):
        if name not in ("/a/b",):  # a "/" in a set stands for itself
            assert any(matches(each, name) for each in found) == matches(expression, name), name


def test_too_many_choices_are_refused() -> None:
    assert len(listed("/[a-h][a-h]", 64)) == 64
    for expression in ("/[a-h][a-i]", "/???", "/" + "?" * 900):
        with pytest.raises(CannotSubtract):
            listed(expression, 64)


@pytest.mark.parametrize(
    ("wide", "denied"),
    [
        ("/*", ["/" + "a" * 1990]),
        ("/" + "*a" * 900, ["/" + "*b" * 900]),
        ("/" + "*a" * 900, ["/" + "a" * 1800 + "*b"]),
        ("/*", [f"/*x{number}" for number in range(3000)]),
        ("/*", [f"/x{number}" + "y" * 1900 for number in range(300)]),
        ("/" + "a*" * 900 + "a", ["/" + "a" * 900 + "*b*a"]),
    ],
)
def test_a_hostile_policy_takes_no_unbounded_time(wide: str, denied: list[str]) -> None:
    begin = time.process_time()
    with contextlib.suppress(CannotSubtract):
        assert len(subtract(wide, denied, 4096)) <= 4096
    assert time.process_time() - begin < 60
