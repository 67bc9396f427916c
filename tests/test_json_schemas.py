"""The schemas of what ``--json`` prints follow from the types of what is printed."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from enum import StrEnum
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, Generic, Literal, NamedTuple, TypeVar

import pytest
from jsonschema import Draft202012Validator

from sros_tool.values import Words, as_plain, shows
from tools.json_page import SCHEMAS
from tools.json_schemas import object_schema, schemas, text_of

BY_HAND = {"confirmation.json"}
"""The schema that no type makes: the confirmation, which robots write."""

Shape = TypeVar("Shape")


class Color(StrEnum):
    RED = "red"
    BLUE = "blue"


class Corner(NamedTuple):
    """A corner."""

    x: int
    """Its distance from the left."""


class Drawn(NamedTuple, Generic[Shape]):
    """Something that was drawn."""

    shape: Shape


@shows(optional=("note",), null_if_empty=("author",), spread=("corner", "other"))
@dataclass(frozen=True, slots=True)
class Picture:
    """A picture, in ``color``.

    This says more.
    """

    corner: Corner
    other: Corner | None
    color: Color
    """Its color."""
    note: str | None = None
    """A note."""
    author: str = ""
    """Who drew it."""
    from_: Path = Path("a")
    """Where it comes from."""
    drawn: Drawn[Annotated[str, Words(("line", "dot")), "What was drawn."]] | None = None
    """What is on it."""
    made: datetime | None = None
    """When it was made."""
    sizes: Mapping[str, Sequence[int | float]] | None = None
    """Its sizes."""


def test_a_class_becomes_an_object() -> None:
    schema = object_schema(Picture)
    assert schema["description"] == "A picture, in `color`."
    assert schema["additionalProperties"] is False
    assert schema["required"] == ["x", "color", "author", "from", "drawn", "made", "sizes"]
    parts = schema["properties"]
    assert parts["x"] == {"type": "integer", "description": "Its distance from the left."}
    assert parts["color"]["enum"] == ["red", "blue"]
    assert parts["note"]["type"] == "string"
    assert parts["author"]["type"] == ["string", "null"]
    assert parts["drawn"]["type"] == ["object", "null"]
    assert parts["drawn"]["properties"]["shape"] == {
        "type": "string",
        "enum": ["line", "dot"],
        "description": "What was drawn.",
    }
    assert parts["made"]["format"] == "date-time"
    assert parts["sizes"]["additionalProperties"]["items"] == {"type": "number"}


@pytest.mark.parametrize(
    "picture",
    [
        Picture(Corner(1), None, Color.RED),
        Picture(Corner(1), Corner(2), Color.BLUE, "new", "me", Path("b"), Drawn("dot")),
        Picture(Corner(1), None, Color.RED, sizes={"a": (1, 2.5)}),
    ],
)
def test_what_a_value_becomes_fits_the_schema_of_its_class(picture: Picture) -> None:
    Draft202012Validator(object_schema(Picture)).validate(as_plain(picture))


@pytest.mark.parametrize(
    "picture",
    [
        Picture(Corner(1), None, Color.RED, drawn=Drawn("circle")),
        Picture(Corner(1), None, Color.RED, sizes={"a": ("1",)}),  # type: ignore[dict-item]
    ],
)
def test_another_value_does_not_fit(picture: Picture) -> None:
    assert not Draft202012Validator(object_schema(Picture)).is_valid(as_plain(picture))


class Undescribed(NamedTuple):
    """A key of it has no description."""

    size: int


class WithProperties(NamedTuple):
    """Shows a property without a description."""

    size: int
    """Its size."""

    @property
    def width(self) -> int:
        return self.size

    @cached_property
    def height(self) -> Literal["high"]:
        """Its height."""
        return "high"


def test_there_is_no_key_without_a_description() -> None:
    with pytest.raises(TypeError, match=r"Undescribed\.size has no docstring"):
        object_schema(Undescribed)
    shown = shows("size", "height")(WithProperties)
    assert object_schema(shown)["properties"]["height"]["description"] == "Its height."
    with pytest.raises(TypeError, match=r"WithProperties\.width has no docstring"):
        object_schema(shows("size", "width")(WithProperties))


@pytest.mark.parametrize("kind", [bytes, Any, Shape])
def test_what_has_no_form_in_json_has_no_schema(kind: object) -> None:
    class Odd(NamedTuple):
        """Odd."""

        part: kind  # type: ignore[valid-type]
        """A part."""

    Odd.__annotations__["part"] = kind
    with pytest.raises(TypeError):
        object_schema(Odd)


def test_the_files_follow_from_the_types() -> None:
    made = schemas()
    for name, schema in made.items():
        assert (SCHEMAS / name).read_text() == text_of(schema), "run `python -m tools.json_schemas`"
    assert {path.name for path in SCHEMAS.glob("*.json")} - set(made) == BY_HAND
    assert json.loads(text_of(made["env.json"])) == made["env.json"]
