"""The one way from frozen values to JSON: dataclasses and named tuples as plain dictionaries."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import fields, is_dataclass
from datetime import datetime
from enum import Enum
from pathlib import PurePath
from typing import Any, TypeVar

from sros_tool.validity import iso

_Value = TypeVar("_Value")
_SHOWN: dict[type, tuple[str, ...]] = {}
"""The attributes by which the values of a class are shown."""


def as_plain(value: object) -> Any:
    """Return ``value`` as JSON types: dictionaries, lists, texts, numbers, booleans and None.

    A dataclass or a named tuple becomes a dictionary by the names of its public fields, in their
    order, or by the attributes that `shows` names for it.  An enumeration becomes its value, a
    moment CCYY-MM-DDThh:mm:ssZ in UTC, a path its text, a tuple a list, and a set a sorted list.

    Raises:
        TypeError: for anything else, such as bytes.
    """
    if value is None or type(value) in (str, int, float, bool):
        return value
    if isinstance(value, Enum):
        return value.value
    if names := _shown(type(value)):
        return {name: as_plain(getattr(value, name)) for name in names}
    if isinstance(value, Mapping):
        return {as_plain(key): as_plain(each) for key, each in value.items()}
    if isinstance(value, (list, tuple)):
        return [as_plain(each) for each in value]
    if isinstance(value, (set, frozenset)):
        return [as_plain(each) for each in sorted(value)]
    if isinstance(value, datetime):
        return iso(value)
    if isinstance(value, PurePath):
        return str(value)
    raise TypeError(f"a {type(value).__name__} has no form in JSON: {value!r}")


def shows(*names: str) -> Callable[[type[_Value]], type[_Value]]:
    """Return a class decorator: `as_plain` then shows these attributes instead of the fields."""

    def decorate(kind: type[_Value]) -> type[_Value]:
        _SHOWN[kind] = names
        return kind

    return decorate


def _shown(kind: type) -> tuple[str, ...]:
    """Return the attributes by which values of a class are shown; none if it has no fields."""
    if kind not in _SHOWN:
        names: tuple[str, ...] = getattr(kind, "_fields", ())
        if is_dataclass(kind):
            names = tuple(each.name for each in fields(kind))
        _SHOWN[kind] = tuple(name for name in names if not name.startswith("_"))
    return _SHOWN[kind]
