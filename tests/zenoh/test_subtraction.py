"""Key expressions less others are the names that only the first matches: exactly, or not at all."""

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
from sros_tool.translate_zenoh.rights import chunks_of
from sros_tool.zenoh.key_expressions import canonical
from sros_tool.zenoh.subtraction import (
    MOST_EXPRESSIONS,
    CannotSubtract,
    Chunks,
    Difference,
    subtract_all,
)
from tests.support.children import LONG
from tests.support.long_form import some

PARTS = ("a", "b", "ab", "ba", "aab", "az", "z", "_", "a9", "Z_b")
NAMES = ["/" + "/".join(parts) for count in (1, 2, 3) for parts in product(PARTS, repeat=count)]
NAMES += ["/" + "/".join(parts) for parts in product(("a", "b", "ab"), repeat=4)]

SLOW = 1000
"""Number of expressions that make a slow regular expression."""


def forms(*names: str) -> frozenset[Chunks]:
    return frozenset(chunks for name in names for chunks in chunks_of(name))


def said(expressions: frozenset[Chunks]) -> re.Pattern[str]:
    """What a result means, as one regular expression."""

    def chunk(text: str) -> str:
        if text == "**":
            return "(?:/[^/]+)*"
        return "/[^/]+" if text == "*" else "/" + "[^/]*".join(map(re.escape, text.split("$*")))

    one_of = "|".join("".join(map(chunk, each)) for each in expressions)
    return re.compile(f"(?:{one_of})" if expressions else r"(?!)")


def check(wide: list[str], denied: list[str], found: frozenset[Chunks]) -> None:
    meant = said(found)
    assert all(canonical(each) == "/".join(each) for each in found)
    for name in NAMES:
        wanted = all(matches(each, name) for each in wide)
        wanted &= not any(matches(each, name) for each in denied)
        assert bool(meant.fullmatch(name)) == wanted, (wide, denied, name)


@pytest.mark.parametrize(
    ("wide", "denied", "most"),
    [
        ("/a", ["/b"], 1),
        ("/a", ["/*"], 0),
        ("/a*", ["/b*"], 2),
        ("/*", ["/*/*"], 1),
        ("/*", ["/*/*/a"], 66),
        ("/*", ["/a"], 64),
        ("/*", ["/ab/*"], 66),
        ("/*", ["/front_camera/*"], 131),
        ("/*", ["/front_camera/*", "/back_camera/*"], 190),
        ("/*", ["/cmd_vel", "/emergency_stop", "/odom", "/tf", "/tf_static", "/scan"], 302),
        ("/*", ["/*/set_parameters"], 139),
        ("/*", ["/*ab"], 125),
        ("/*", ["/front*/image"], 382),
        ("/a*", ["/*b", "/ab/a"], 252),
        ("/*/a", ["/ab/*"], 65),
        ("*/a", ["/ab/a"], 70),
        ("/*", ["/*"], 0),
        ("/*a*b*", ["/ab"], 250),
        ("/*", ["/a/*", "/*/b"], 4100),
        ("/*", ["/a*", "/*/p"], 3330),
        ("/*", ["/secret/*", "/*/set_parameters"], 12000),
    ],
)
def test_few_expressions_are_enough(wide: str, denied: list[str], most: int) -> None:
    found = subtract_all(forms(wide), forms(*denied))
    assert len(found) <= most
    if len(found) < SLOW:
        check([wide], denied, found)


@pytest.mark.parametrize(
    ("wide", "denied", "why"),
    [
        ("/*", ["/a", "/*camera*"], True),
        ("/*", ["/a*x*b"], True),
        ("/*", ["/*/a/*"], True),
        ("/*", ["/front_camera/*", "/*/set_parameters", "/*/describe_parameters"], False),
    ],
)
def test_what_no_list_says_is_refused(wide: str, denied: list[str], why: bool) -> None:
    with pytest.raises(CannotSubtract) as caught:
        subtract_all(forms(wide), forms(*denied))
    assert bool(caught.value.denied) == why


EXPRESSION = (
    st.text("aab/**", min_size=1, max_size=6 if LONG else 4)
    .map(lambda text: re.sub(r"\*+", "*", f"/{text}"))
    .filter(lambda text: not expression_problem(text))
)


@settings(max_examples=3000 if LONG else 20, deadline=None)
@given(EXPRESSION, st.lists(EXPRESSION, min_size=1, max_size=3))
def test_the_difference_is_exact_on_names_of_ros(wide: str, denied: list[str]) -> None:
    try:
        found = subtract_all(forms(wide), forms(*denied))
    except CannotSubtract:
        return
    if LONG or len(found) < SLOW:
        check([wide], denied, found)


@settings(max_examples=2000 if LONG else 15, deadline=None)
@given(EXPRESSION, EXPRESSION, st.lists(EXPRESSION, max_size=2), st.lists(EXPRESSION, max_size=2))
def test_what_two_differences_share_is_exact(
    one: str, other: str, denied: list[str], never: list[str]
) -> None:
    end = "/$*::$*/*"
    first = Difference("0", end, forms(one), forms(*denied))
    second = Difference("0", f"{end}/**", forms(other), forms(*never))
    try:
        found = first.common(second)
    except CannotSubtract:
        return
    assert sorted(found) == sorted(second.common(first))
    names = frozenset(tuple(each.removesuffix(end).split("/"))[1:] for each in found)
    check([one, other], [*denied, *never], names)


@pytest.mark.parametrize(
    ("wide", "denied"),
    some(
        [
            ("/*", ["/" + "a" * 1990]),
            ("/*a*a*a*a*a", ["/*b*b*b*b*b"]),
            ("/a*b*", ["/" + "a/" * 900 + "b"]),
            ("/*", [f"/*x{number}" for number in range(500)]),
            ("/*", [f"/x{number}" + "y" * 1900 for number in range(300)]),
            ("/*", [f"/*x{number}*/*y{number}" for number in range(300)]),
        ],
        1,
    ),
)
def test_a_hostile_policy_takes_no_unbounded_time(wide: str, denied: list[str]) -> None:
    begin = time.process_time()
    with contextlib.suppress(CannotSubtract):
        assert len(subtract_all(forms(wide), forms(*denied))) <= MOST_EXPRESSIONS
    assert time.process_time() - begin < 60
