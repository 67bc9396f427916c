"""A name that expressions share is found, is right, and is missed only if there is none."""

from __future__ import annotations

from itertools import product

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sros_tool.policy.patterns import common_name, matches, overlap

PIECES = ["/", "a", "b", "*", "?", "[ab]", "[!a]"]
expressions = st.lists(st.sampled_from(PIECES), min_size=1, max_size=5).map(
    lambda parts: "/" + "".join(parts)
)


@pytest.mark.parametrize(
    ("wanted", "unwanted", "name"),
    [
        (["/a"], [], "/a"),
        (["/a"], ["/a"], None),
        (["/a", "/b"], [], None),
        (["/*", "/b"], [], "/b"),
        (["/*", "/b"], ["/?"], None),
        (["/cmd_*", "/*_vel"], [], "/cmd_vel"),
        (["/cmd_*", "/*_vel"], ["/cmd_vel"], "/cmd__vel"),
        (["/a/*", "/*/b"], [], "/a/b"),
        (["/a*", "/b*"], [], None),
        (["/[!a-zA-Z_]*"], [], None),
        (["/*"], ["*"], None),
        (["/*/"], [], None),
    ],
)
def test_the_shortest_name(wanted: list[str], unwanted: list[str], name: str | None) -> None:
    assert common_name(wanted, unwanted) == name


def test_names_of_dds_have_no_slash_before_them() -> None:
    assert common_name(["*", "rt/*"]) is None
    assert common_name(["*", "rt/*"], absolute=False) == "rt/a"


SHORT = [
    "/" + "".join(letters)
    for length in range(1, 5)
    for letters in product("ab_/", repeat=length)
    if "//" not in "/" + "".join(letters) and letters[-1] != "/"
]


@given(st.lists(expressions, min_size=1, max_size=2), st.lists(expressions, max_size=2))
def test_against_every_short_name(wanted: list[str], unwanted: list[str]) -> None:
    def right(name: str) -> bool:
        return all(matches(each, name) for each in wanted) and not any(
            matches(each, name) for each in unwanted
        )

    found = common_name(wanted, unwanted)
    if found is not None:
        assert right(found)
    else:
        assert not any(map(right, SHORT))


@given(expressions, expressions)
def test_what_shares_a_name_overlaps(one: str, other: str) -> None:
    if common_name([one, other]) is not None:
        assert overlap(one, other)


def test_many_question_marks_after_a_star_are_decided() -> None:
    unwanted = ["/*b" + "?" * 17, "/*c" + "?" * 16]
    name = common_name(["/*a" + "?" * 17], unwanted)
    assert name is not None
    assert matches("/*a" + "?" * 17, name)
    assert not any(matches(each, name) for each in unwanted)
