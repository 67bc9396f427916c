"""Frozen values become what JSON has, whatever they consist of."""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta, timezone
from enum import IntEnum, StrEnum
from pathlib import Path
from typing import NamedTuple

import pytest

from sros_tool.values import as_plain, shows


class Color(StrEnum):
    RED = "red"


class Size(IntEnum):
    LARGE = 3


class Point(NamedTuple):
    x: int
    y: float


@shows("name", "width", "radius")
class Circle(NamedTuple):
    """Shows an attribute that is no field, between its fields."""

    name: str
    radius: int

    @property
    def width(self) -> int:
        return 2 * self.radius


@dataclass(frozen=True, slots=True)
class Leaf:
    color: Color
    points: tuple[Point, ...] = ()
    _known: dict[str, str] = field(default_factory=dict)


@shows("leaf", "height")
@dataclass(frozen=True)
class Tree:
    secret: str
    leaf: Leaf | None

    @property
    def height(self) -> int:
        return 7


@pytest.mark.parametrize(
    ("value", "plain"),
    [
        (None, None),
        (True, True),
        (3, 3),
        (2.5, 2.5),
        ("text", "text"),
        (Color.RED, "red"),
        (Size.LARGE, 3),
        (Path("a/b"), "a/b"),
        (datetime(2027, 1, 2, 3, 4, 5, 6, tzinfo=UTC), "2027-01-02T03:04:05Z"),
        (datetime(2027, 1, 2, tzinfo=timezone(timedelta(hours=9))), "2027-01-01T15:00:00Z"),
        ((1, (2, "3")), [1, [2, "3"]]),
        (frozenset({"b", "a"}), ["a", "b"]),
        ({Color.RED: (Path("x"),)}, {"red": ["x"]}),
        (Point(1, 2.0), {"x": 1, "y": 2.0}),
        (Circle("o", 2), {"name": "o", "width": 4, "radius": 2}),
        (Leaf(Color.RED, (Point(0, 1.5),)), {"color": "red", "points": [{"x": 0, "y": 1.5}]}),
        (Tree("key", None), {"leaf": None, "height": 7}),
        ([Tree("key", Leaf(Color.RED))], [{"leaf": {"color": "red", "points": []}, "height": 7}]),
    ],
)
def test_a_value_becomes_what_json_has(value: object, plain: object) -> None:
    found = as_plain(value)
    assert found == plain
    assert json.loads(json.dumps(found)) == plain


def test_the_order_is_that_of_the_fields_or_of_the_names_that_are_shown() -> None:
    assert list(as_plain(Leaf(Color.RED))) == ["color", "points"]
    assert list(as_plain(Circle("o", 2))) == ["name", "width", "radius"]


@pytest.mark.parametrize("value", [b"bytes", object(), 1j, (b"inside",), timedelta(1)])
def test_what_has_no_form_in_json_is_refused(value: object) -> None:
    with pytest.raises(TypeError, match="has no form in JSON"):
        as_plain(value)
