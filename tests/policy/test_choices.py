"""What ``?`` and sets of characters stand for is listed, if it is not too much."""

from __future__ import annotations

import pytest

from sros_tool.policy.choices import TooManyNames, listed
from sros_tool.policy.patterns import matches

NAMES = ("/a", "/b", "/ab", "/az", "/a9", "/a/b", "/aab", "/ac", "/a9b", "/bZ", "/c_")


@pytest.mark.parametrize(
    ("expression", "count"),
    [("/a", 1), ("/a*", 1), ("/a?", 63), ("/a?b", 64), ("/[ab][!a-z]", 2 * 37), ("/[a/]b", 1)],
)
def test_choices_of_characters_are_listed(expression: str, count: int) -> None:
    found = listed(expression, 4096)
    assert len(found) == count
    for name in NAMES:
        if name not in ("/a/b",):  # a "/" in a set stands for itself
            assert any(matches(each, name) for each in found) == matches(expression, name), name


def test_too_many_choices_are_refused() -> None:
    assert len(listed("/[a-h][a-h]", 64)) == 64
    for expression in ("/[a-h][a-i]", "/???", "/" + "?" * 900):
        with pytest.raises(TooManyNames):
            listed(expression, 64)
