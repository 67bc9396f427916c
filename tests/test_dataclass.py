"""Classes of `sros_tool.dataclass` behave as those of `dataclasses` do."""

from __future__ import annotations

import copy
import dataclasses
import pickle
from collections.abc import Callable
from dataclasses import FrozenInstanceError, field, fields, replace
from typing import Any

import pytest

from sros_tool.dataclass import dataclass


@dataclass(frozen=True, slots=True, order=True)
class Topic:
    """A value that is compared, sorted, copied and pickled."""

    name: str
    depth: int = 1
    line: int = field(default=0, compare=False, repr=False)


@dataclass(slots=True)
class Changeable:
    """A value that is changed."""

    names: list[str] = field(default_factory=list)


@dataclass(frozen=True, kw_only=True)
class Base:
    """The first half of the fields of `Derived`."""

    path: str
    size: int = 3

    def __post_init__(self) -> None:
        if self.size < 0:
            raise ValueError("negative")


@dataclass(frozen=True, kw_only=True)
class Derived(Base):
    """A class with the fields of another one, which it extends."""

    owner: str


def test_values_are_equal_by_the_fields_that_are_compared() -> None:
    assert Topic("a", line=1) == Topic("a", 1, line=2)
    assert hash(Topic("a", line=1)) == hash(Topic("a", line=2))
    assert Topic("a") != Topic("b")
    assert Topic("a").__eq__(("a", 1)) is NotImplemented
    assert Base(path="a") != Derived(path="a", owner="b")
    assert sorted([Topic("b"), Topic("a", 2), Topic("a")]) == [
        *(Topic("a"), Topic("a", 2), Topic("b"))
    ]
    with pytest.raises(TypeError):
        assert Topic("a") < "a"  # type: ignore[operator]


def test_frozen_values_are_not_changed() -> None:
    topic = Topic("a")
    with pytest.raises(FrozenInstanceError):
        topic.name = "b"  # type: ignore[misc]
    with pytest.raises(FrozenInstanceError):
        del topic.name
    assert topic.name == "a"


def test_others_are_changed_and_have_no_hash() -> None:
    first, second = Changeable(), Changeable()
    first.names.append("a")
    assert second.names == []
    second.names = ["a"]
    assert first == second
    with pytest.raises(TypeError):
        hash(first)


@pytest.mark.parametrize(
    "copied", [copy.copy, copy.deepcopy, lambda v: pickle.loads(pickle.dumps(v))]
)
@pytest.mark.parametrize(
    "value", [Topic("a", 2, 3), Changeable(["a"]), Derived(path="a", owner="b")]
)
def test_values_are_copied_and_pickled(copied: Callable[[Any], Any], value: Any) -> None:
    assert copied(value) == value
    assert repr(copied(value)) == repr(value)


def test_fields_and_replace_work() -> None:
    assert [each.name for each in fields(Derived)] == ["path", "size", "owner"]
    assert replace(Topic("a", 2), name="b") == Topic("b", 2)
    with pytest.raises(ValueError, match="negative"):
        replace(Derived(path="a", owner="b"), size=-1)


def test_wrong_arguments_are_refused_as_for_any_function() -> None:
    with pytest.raises(TypeError, match=r"Topic\.__init__\(\) missing 1 required"):
        Topic()  # type: ignore[call-arg]
    with pytest.raises(TypeError, match="unexpected keyword"):
        Topic("a", colour="red")  # type: ignore[call-arg]
    with pytest.raises(TypeError, match="positional"):
        Derived("a", owner="b")  # type: ignore[call-arg]


def test_the_text_is_that_of_dataclasses() -> None:
    like = dataclasses.make_dataclass("Topic", [("name", str), ("depth", int)])
    assert repr(Topic("a")) == repr(like("a", 1))
    assert repr(Topic("a")) == "Topic(name='a', depth=1)"


def test_methods_of_the_class_itself_stay() -> None:
    @dataclass(frozen=True)
    class Named:
        """A value that is known by its name alone."""

        name: str
        size: int = 0

        def __eq__(self, other: object) -> bool:
            return isinstance(other, Named) and self.name == other.name

        def __hash__(self) -> int:
            return hash(self.name)

        def __repr__(self) -> str:
            return self.name

    assert Named("a", 1) == Named("a", 2)
    assert len({Named("a", 1), Named("a", 2)}) == 1
    assert repr(Named("a")) == "a"
