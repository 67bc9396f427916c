"""Reading JSON, and conversion of dataclasses and other values to JSON types."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import fields, is_dataclass
from datetime import datetime
from enum import Enum
from pathlib import PurePath
from typing import Any, TypeVar

from sros_tool.validity import iso

_Value = TypeVar("_Value")
_SHOWN: dict[type, tuple[str, ...]] = {}
"""The attributes of each class that its JSON object has."""


_JSON_VERSION = 1
"""The version of what ``--json`` prints: a key that changes its meaning or goes raises it."""


def versioned(value: Mapping[str, Any]) -> dict[str, Any]:
    """Return the object that ``--json`` prints: ``version`` before the keys of ``value``."""
    return {"version": _JSON_VERSION, **value}


def parse_json(data: bytes) -> Any:
    """Return the value of a JSON document; raise `ValueError` if it is none."""
    try:
        return json.loads(data)
    except RecursionError as error:
        raise ValueError("it is nested too deeply") from error


def as_plain(value: object) -> Any:
    """Return ``value`` as JSON types: dictionaries, lists, strings, numbers, booleans and None.

    A dataclass or a named tuple becomes a dictionary of its public fields, in their order, or of
    the attributes that `shows` names.  An enumeration becomes its value, a datetime
    CCYY-MM-DDThh:mm:ssZ in UTC, a path its text, a tuple a list, and a set a sorted list.

    Raises:
        TypeError: ``value`` is of another type, such as bytes.
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
    """Return a class decorator that makes `as_plain` use these attributes instead of the fields."""

    def decorate(kind: type[_Value]) -> type[_Value]:
        _SHOWN[kind] = names
        return kind

    return decorate


def _shown(kind: type) -> tuple[str, ...]:
    """Return the attributes that the JSON object of a class has; none if it has no fields."""
    if kind not in _SHOWN:
        names: tuple[str, ...] = getattr(kind, "_fields", ())
        if is_dataclass(kind):
            names = tuple(each.name for each in fields(kind))
        _SHOWN[kind] = tuple(name for name in names if not name.startswith("_"))
    return _SHOWN[kind]
