"""What is made at the first use means the same as what Python makes at once."""

from __future__ import annotations

import copy
import dataclasses
import pickle
import re
import typing
from dataclasses import FrozenInstanceError, field, replace
from typing import Any, ClassVar, Generic, TypeVar

import pytest

from sros_tool import deferred

_T = TypeVar("_T")


def classes(dataclass: Any, **options: bool) -> tuple[Any, Any]:
    """Return a class with all kinds of fields, and one that has it as base."""

    @dataclass(**options)
    class Base:
        kind: ClassVar[str] = "fixed"
        name: str
        size: int = 0
        seen: list[int] = field(default_factory=list, compare=False, repr=False)

    @dataclass(**options)
    class Below(Base):
        more: tuple[int, ...] = ()

        def __post_init__(self) -> None:
            assert self.name, "no name"

    return Base, Below


OPTIONS = [
    {"frozen": True, "slots": True},
    {"frozen": True, "slots": True, "order": True},
    {"frozen": True, "kw_only": True},
    {"frozen": True, "slots": True, "eq": False},
    {"slots": True},
    {},
]


def outcome(action: Any) -> Any:
    try:
        return action()
    except Exception as error:
        return type(error)


@pytest.mark.parametrize("options", OPTIONS, ids=str)
def test_a_dataclass_does_what_that_of_python_does(options: dict[str, bool]) -> None:
    def seen(dataclass: Any) -> list[Any]:
        base, below = classes(dataclass, **options)
        one, same = (below(name="a", size=1, more=(2,)) for _ in range(2))
        other, above = below(name="b", size=0), base(name="a", size=1)
        return [
            *(str(each) for each in (one, other, above)),
            one == same,
            one == other,
            one == above,
            outcome(lambda: hash(one) == hash(same)),
            outcome(lambda: hash(other) == hash(one)),
            *(outcome(lambda two=two: one < two) for two in (same, other, above)),
            *(outcome(lambda two=two: one >= two) for two in (same, other, above)),
            outcome(lambda: setattr(one, "size", 3)),
            outcome(lambda: delattr(one, "size")),
            outcome(lambda: below("c", 1, [4], (2,)).seen),
            outcome(lambda: below()),
            outcome(lambda: below(name="")),
            outcome(lambda: below(name="a", unknown=1)),
            below(name="a").seen is below(name="a").seen,
            str(replace(other, size=7)),
            [(each.name, each.type) for each in dataclasses.fields(below)],
            below.__match_args__,
            below.kind,
            hasattr(one, "__dict__"),
            str(copy.deepcopy(other)),
        ]

    assert seen(deferred.dataclass) == seen(dataclasses.dataclass)


@deferred.dataclass(frozen=True, slots=True)
class Kept:
    """A value that other processes get."""

    name: str
    seen: dict[str, int] = field(default_factory=dict, compare=False)


def test_a_frozen_value_is_pickled() -> None:
    kept = pickle.loads(pickle.dumps(Kept("a", {"b": 1})))
    assert (kept, kept.seen) == (Kept("a"), {"b": 1})
    with pytest.raises(FrozenInstanceError):
        kept.name = "b"


class Pair(deferred.NamedTuple):
    """Two values."""

    first: int
    second: str | None = None

    @property
    def both(self) -> str:
        """The two values as text."""
        return f"{self.first}{self.second}"


class Several(deferred.NamedTuple, Generic[_T]):
    """Values of a kind."""

    values: tuple[_T, ...]
    total: int = 0


def test_a_named_tuple_is_one() -> None:
    pair = Pair(1)
    assert (pair, pair.both, pair._replace(second="b")) == ((1, None), "1None", Pair(1, "b"))
    assert (str(pair), Pair._fields) == ("Pair(first=1, second=None)", ("first", "second"))
    assert (Pair.__doc__, Pair.__module__) == ("Two values.", __name__)
    assert typing.get_type_hints(Pair) == {"first": int, "second": str | None}
    assert pickle.loads(pickle.dumps(pair)) == pair
    assert Several[int]((1, 2)) == ((1, 2), 0)
    with pytest.raises(TypeError, match="missing 1 required positional argument: 'first'"):
        Pair()  # type: ignore[call-arg]


def test_an_expression_is_compiled_when_it_is_used(monkeypatch: pytest.MonkeyPatch) -> None:
    compiled: list[str] = []
    python = re.compile

    def compiling(pattern: str, flags: int) -> re.Pattern[str]:
        compiled.append(pattern)
        return python(pattern, flags)

    monkeypatch.setattr(re, "compile", compiling)
    expression = deferred.regex(r"(A+)b", re.IGNORECASE)
    assert compiled == []
    assert [expression.sub(r"\1", "aab") for _ in range(2)] == ["aa", "aa"]
    assert expression.fullmatch("ab") and expression.flags & re.IGNORECASE
    assert set(compiled) == {"(A+)b"}


def test_a_class_that_is_not_used_compiles_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    compiled: list[str] = []
    monkeypatch.setattr("builtins.exec", lambda text, _names: compiled.append(text))
    classes(deferred.dataclass, frozen=True, slots=True, order=True)
    assert compiled == []
