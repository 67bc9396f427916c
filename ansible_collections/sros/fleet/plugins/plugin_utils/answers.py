"""What is taken from the answer of a robot, which can answer anything."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from typing import Any

from ansible_collections.sros.fleet.plugins.module_utils.exports import RefusedError, check_enclave
from ansible_collections.sros.fleet.plugins.module_utils.home import harmless

_MOST_BYTES = 16 << 20
_MOST_ITEMS = 100_000
_MOST_REMARKS = 20
_MOST_FILES = 10_000
_LONGEST_TEXT = 4_000
_LONGEST_NAME = 1_000
_LONGEST_DOCUMENT = 200_000

Reader = Callable[[Any], Any]
"""Returns the harmless form of a value, or raises ``ValueError`` (also ``TypeError``)."""


def flag(value: Any) -> bool:
    """Return a truth value."""
    if not isinstance(value, bool):
        raise TypeError
    return value


def number(value: Any) -> int:
    """Return an integer."""
    if not isinstance(value, int) or abs(value) >= 1 << 63:
        raise ValueError
    return value


def text(value: Any) -> str:
    """Return a text as one line."""
    return harmless(_str(value), most=_LONGEST_TEXT)


def name(value: Any) -> str:
    """Return a name as one line."""
    return harmless(_str(value), most=_LONGEST_NAME)


def enclave(value: Any) -> str:
    """Return the name of an enclave, which the plays show as what is to be restarted."""
    try:
        return check_enclave(_str(value))
    except RefusedError as error:
        raise ValueError from error


def document(value: Any) -> str:
    """Return a text of several lines."""
    return harmless(_str(value), most=_LONGEST_DOCUMENT, lines=True)


def list_of(read_item: Reader, most: int = _MOST_ITEMS) -> Reader:
    """Return the reader of a list with at most ``most`` items."""

    def read(value: Any) -> list[Any]:
        if not isinstance(value, list) or len(value) > most:
            raise ValueError
        return [read_item(item) for item in value]

    return read


def first_of(read_item: Reader, most: int) -> Reader:
    """Return the reader of a list of which the first items and the number of others are taken."""

    def read(value: Any) -> list[Any]:
        if not isinstance(value, list):
            raise TypeError
        more = [f"and {len(value) - most} more"] if len(value) > most else []
        return [*(read_item(item) for item in value[:most]), *more]

    return read


def map_of(read_item: Reader) -> Reader:
    """Return the reader of an object whose keys are names."""

    def read(value: Any) -> dict[str, Any]:
        if not isinstance(value, dict) or len(value) > _MOST_ITEMS:
            raise ValueError
        return {name(key): read_item(item) for key, item in value.items()}

    return read


def record(**readers: Reader) -> Reader:
    """Return the reader of an object, of which only these keys are taken."""

    def read(value: Any) -> dict[str, Any]:
        if not isinstance(value, dict):
            raise TypeError
        return {key: reader(value[key]) for key, reader in readers.items() if key in value}

    return read


remarks = first_of(text, _MOST_REMARKS)
"""Returns what is shown to the operator, and so is not long."""
OF_ALL: dict[str, Reader] = {
    "changed": flag,
    "failed": flag,
    "msg": text,
    "remarks": remarks,
}
"""What the answer of each module can have."""
DIFFERENCES = list_of(
    record(before_header=name, after_header=name, before=document, after=document), _MOST_FILES
)


def read_answer(output: str, error: str, readers: Mapping[str, Reader]) -> dict[str, Any]:
    """Return what a module answered, harmless: only the keys of ``readers`` and `OF_ALL`.

    Everything else that Ansible would act on or print is left out: facts, hosts and groups for the
    inventory, warnings, tracebacks.

    Args:
        output: what the module printed.
        error: what it printed on standard error.
        readers: the keys that this module returns.

    Raises:
        RefusedError: it is no such answer.
    """
    if len(output) > _MOST_BYTES:
        raise RefusedError("This robot answered with more than 16 MiB. Look at the robot.")
    answer = _object_in(output)
    if answer is None:
        said = harmless(f"{error} {output}".strip(), most=_LONGEST_NAME) or "nothing"
        raise RefusedError(f"This robot did not return the result of a module. It said: {said}")
    found = {}
    for key, reader in {**OF_ALL, **readers}.items():
        if key in answer:
            try:
                found[key] = reader(answer[key])
            except (TypeError, ValueError, RecursionError):
                raise RefusedError(
                    f"This robot returned another kind of value than it should for {key}. Look at"
                    " the robot."
                ) from None
    return found


def _object_in(output: str) -> dict[str, Any] | None:
    """Return the JSON object of the last line that has one: a login can print before it."""
    for line in reversed(output.splitlines()):
        if line.lstrip().startswith("{"):
            try:
                value = json.loads(line)
            except (ValueError, RecursionError):
                return None
            return value if isinstance(value, dict) else None
    return None


def _str(value: Any) -> str:
    if not isinstance(value, str):
        raise TypeError
    return value
