"""Conversion of values to JSON and YAML, reading JSON, and values that several verbs print."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import fields, is_dataclass
from datetime import datetime
from enum import Enum
from pathlib import Path, PurePath
from typing import Annotated, Any, Literal, NamedTuple, TypeVar

from sros_tool.errors import Note
from sros_tool.validity import iso

_Class = TypeVar("_Class")
_SHOWN_KEYS: dict[type, ShownKeys | None] = {}
"""Class → the keys of its JSON object; None for a class that is not written as an object."""


_JSON_VERSION = 1
"""The version of the ``--json`` output, raised when a key is removed or changes its meaning."""


def versioned(value: object) -> dict[str, Any]:
    """Return the object that ``--json`` prints: ``version`` before the keys of ``value``."""
    return {"version": _JSON_VERSION, **as_plain(value)}


def parse_json(data: bytes) -> Any:
    """Parse a JSON document; raise `ValueError` if it is malformed."""
    try:
        return json.loads(data)
    except RecursionError as error:
        raise ValueError("it is nested too deeply") from error


_PLAIN_YAML = re.compile(r"[A-Za-z/][A-Za-z0-9_./-]*\Z")
_YAML_WORDS = frozenset(("y", "n", "yes", "no", "on", "off", "true", "false", "null"))
"""Words, in lower case, that YAML 1.1 or 1.2 does not read as a string, such as ``yes``."""


def yaml_text(value: object) -> str:
    """Return dictionaries, lists, strings, integers and booleans as a YAML document.

    A string that YAML 1.1 or 1.2 could read as something else is written as a JSON string, which is
    also valid in YAML.

    Raises:
        TypeError: a part of ``value`` has another type.
    """
    return "".join(f"{line}\n" for line in _yaml_lines(value))


def _yaml_lines(value: object) -> Iterator[str]:
    if isinstance(value, Mapping) and value:
        for key, each in value.items():
            lines = _yaml_lines(each)
            if isinstance(each, (Mapping, list)) and each:
                yield f"{_yaml_string(key)}:"
                yield from (f"  {line}" for line in lines)
            else:
                yield f"{_yaml_string(key)}: {next(lines)}"
    elif isinstance(value, list) and value:
        for item in value:
            lines = _yaml_lines(item)
            yield f"- {next(lines)}"
            yield from (f"  {line}" for line in lines)
    elif isinstance(value, bool):
        yield str(value).lower()
    elif isinstance(value, int):
        yield str(value)
    elif isinstance(value, str):
        yield _yaml_string(value)
    elif isinstance(value, (Mapping, list)):
        yield "{}" if isinstance(value, Mapping) else "[]"
    else:
        raise TypeError(f"a {type(value).__name__} has no form in YAML: {value!r}")


def _yaml_string(text: str) -> str:
    if _PLAIN_YAML.match(text) and text.lower() not in _YAML_WORDS:
        return text
    quoted = json.dumps(text, ensure_ascii=False)
    return "".join(
        character if character.isprintable() else _yaml_escape(character) for character in quoted
    )


def _yaml_escape(character: str) -> str:
    code = ord(character)
    return f"\\u{code:04x}" if code < 0x10000 else f"\\U{code:08x}"


def as_plain(value: object) -> Any:
    """Return ``value`` as JSON types: dictionaries, lists, strings, numbers, booleans and None.

    A dataclass or a named tuple becomes a dictionary of its public fields, in their order, unless
    `shows` says otherwise.  An enumeration becomes its value, a datetime
    CCYY-MM-DDThh:mm:ssZ in UTC, a path its text, a sequence a list, and a set a sorted list.

    Raises:
        TypeError: ``value`` is of another type, such as bytes.
    """
    if value is None or type(value) in (str, int, float, bool):
        return value
    if isinstance(value, Enum):
        return value.value
    if shape := shown(type(value)):
        return _as_object(value, shape)
    if isinstance(value, Mapping):
        return {as_plain(key): as_plain(each) for key, each in value.items()}
    if isinstance(value, (set, frozenset)):
        return [as_plain(item) for item in sorted(value)]
    if isinstance(value, Sequence) and not isinstance(value, (str, bytes)):
        return [as_plain(item) for item in value]
    if isinstance(value, datetime):
        return iso(value)
    if isinstance(value, PurePath):
        return str(value)
    raise TypeError(f"a {type(value).__name__} has no form in JSON: {value!r}")


class ShownKeys(NamedTuple):
    """The keys of a class's JSON object; see `shows`."""

    names: tuple[str, ...]
    optional: tuple[str, ...] = ()
    null_if_empty: tuple[str, ...] = ()
    spread: tuple[str, ...] = ()


def shows(
    *names: str,
    optional: tuple[str, ...] = (),
    null_if_empty: tuple[str, ...] = (),
    spread: tuple[str, ...] = (),
) -> Callable[[type[_Class]], type[_Class]]:
    """Return a class decorator that chooses the keys of an object's JSON, as `as_plain` makes it.

    Args:
        names: the attributes that become keys; without any, the public fields of the class.
        optional: attributes left out of the object if they are None.
        null_if_empty: attributes written as null if they are empty.
        spread: attributes whose own keys are put into this object; None adds no key.
    """

    def decorate(kind: type[_Class]) -> type[_Class]:
        _SHOWN_KEYS[kind] = ShownKeys(
            names or _public_fields(kind), optional, null_if_empty, spread
        )
        return kind

    return decorate


def shown(kind: type) -> ShownKeys | None:
    """Return the keys of a class's JSON object; None if its values are not JSON objects."""
    if kind not in _SHOWN_KEYS:
        names = _public_fields(kind)
        _SHOWN_KEYS[kind] = ShownKeys(names) if names else None
    return _SHOWN_KEYS[kind]


class Words(tuple[str, ...]):
    """The allowed values of a string type, as an annotation for the JSON Schema."""


def key_of(name: str) -> str:
    """Return the JSON key of an attribute: its name without a trailing underscore (``from_``)."""
    return name.rstrip("_")


def _public_fields(kind: type) -> tuple[str, ...]:
    names: tuple[str, ...] = getattr(kind, "_fields", ())
    if is_dataclass(kind):
        names = tuple(field.name for field in fields(kind))
    return tuple(name for name in names if not name.startswith("_"))


def _as_object(value: object, shape: ShownKeys) -> dict[str, Any]:
    plain: dict[str, Any] = {}
    for name in shape.names:
        part = getattr(value, name)
        if name in shape.spread:
            plain |= as_plain(part) or {}
        elif part is not None or name not in shape.optional:
            empty = name in shape.null_if_empty and not part
            plain[key_of(name)] = None if empty else as_plain(part)
    return plain


# ── parts of what many verbs print ────────────────────────────────────────────────────────────


FILE_ACTIONS = Words(("create", "replace", "remove", "close", "adopt", "send"))


class FileChange(NamedTuple):
    """A file that was written or, with ``--dry-run``, would be."""

    action: Annotated[str, FILE_ACTIONS]
    """What is done with the file; ``close``: a private key or a folder of keys that other users
    could open is closed to them; ``adopt``: a keystore of ros2/sros2 gets settings and a ledger.
    """
    path: str
    """The file; for ``send``, its path in the archive on standard output."""


NamedKeystore = Annotated[Path, "Path of the keystore, as the user gave it."]
DryRun = Annotated[bool, "Whether nothing was changed, because of `--dry-run`."]
FileChanges = Annotated[
    Sequence[FileChange], "The files that were written or, with `--dry-run`, would be."
]
Notes = Annotated[Sequence[Note], "Notes, which text output prints on standard error."]


class PlannedFiles(NamedTuple):
    """The files that a dry run would write."""

    changes: FileChanges
    notes: Notes
    dry_run: Literal[True] = True
    """Always true: nothing was written."""


def file_change(path: Path, *, existed: bool) -> tuple[FileChange]:
    """Return the change for writing ``path``: "replace" if it ``existed``, else "create"."""
    return (FileChange("replace" if existed else "create", str(path)),)
