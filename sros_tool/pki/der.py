"""Just enough of DER (X.690) to walk through a CMS signature.

`cryptography` makes CMS signatures but cannot yet verify them; this reader finds the parts that
its verification primitives are then given.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from sros_tool.errors import PkiError

INTEGER, OCTET_STRING, OID, SEQUENCE, SET = 0x02, 0x04, 0x06, 0x30, 0x31
CONTEXT_0 = 0xA0


@dataclass(frozen=True, slots=True)
class Value:
    """One tag-length-value: its tag, the bytes of its content, and all its bytes."""

    tag: int
    content: bytes
    whole: bytes


def read(data: bytes) -> Value:
    """The first value in ``data``."""
    for value in children(data):
        return value
    raise PkiError("a DER value is empty")


def children(data: bytes) -> Iterator[Value]:
    """The values that ``data`` (the content of a constructed value) consists of.

    Raises `PkiError` where a value is cut short, or of a form that DER does not have.
    """
    position, end = 0, len(data)
    while position < end:
        start = position
        if end - position < 2:
            raise PkiError("a DER value is cut short")
        tag, length = data[position], data[position + 1]
        position += 2
        if tag & 0x1F == 0x1F or length == 0x80:
            raise PkiError("a DER value has a form that is not supported")
        if length > 0x80:
            size = length & 0x7F
            if size > 4 or position + size > end:
                raise PkiError("a DER value is cut short")
            length = int.from_bytes(data[position : position + size], "big")
            position += size
        if position + length > end:
            raise PkiError("a DER value is cut short")
        yield Value(tag, data[position : position + length], data[start : position + length])
        position += length


def oid(content: bytes) -> str:
    """An object identifier's content in dotted form."""
    if not content:
        raise PkiError("a DER object identifier is empty")
    numbers, value = [], 0
    for byte in content:
        value = value << 7 | byte & 0x7F
        if not byte & 0x80:
            numbers.append(value)
            value = 0
    first = min(numbers[0] // 40, 2)
    return ".".join(map(str, (first, numbers[0] - 40 * first, *numbers[1:])))
