"""A small reader and writer of DER (X.690), for what `cryptography` does not parse.

`cryptography` creates CMS signatures but cannot yet verify them.  So this reader extracts the key,
the signed bytes and the signature, which `cryptography` can verify.  The writer encodes private
keys encrypted with scrypt.
"""

from __future__ import annotations

import re
from typing import NamedTuple

from sros_tool.errors import PkiError

BOOLEAN, INTEGER, BIT_STRING, OCTET_STRING, OID, SEQUENCE, SET = 1, 2, 3, 4, 6, 0x30, 0x31
UTC_TIME, GENERALIZED_TIME = 0x17, 0x18
CONTEXT_0, CONTEXT_1 = 0xA0, 0xA1
_OID_CONTENT = re.compile(rb"(?:(?:[\x81-\xff][\x80-\xff]*)?[\x00-\x7f])+")


class Value(NamedTuple):
    """A DER value: its tag, its content, and its whole encoding (tag, length and content)."""

    tag: int
    content: bytes
    whole: bytes


def children(data: bytes) -> list[Value]:
    """Return the values in ``data``, the content of a constructed value.

    Raises:
        PkiError: a value is truncated, or has a form that this reader does not support.
    """
    values = []
    start, end = 0, len(data)
    while start < end:
        if end - start < 2:
            raise PkiError("a DER value is cut short")
        tag, length = data[start], data[start + 1]
        begin = start + 2
        if length >= 0x80:
            size = length & 0x7F
            if not 1 <= size <= 4:
                raise PkiError("a DER value has a form that is not supported")
            length = int.from_bytes(data[begin : begin + size], "big")
            begin += size
            if length < 0x80 or length >> 8 * (size - 1) == 0:
                raise PkiError("a DER value has a length that is not encoded in the shortest form")
        if tag & 0x1F == 0x1F or tag == 0:
            raise PkiError("a DER value has a form that is not supported")
        after = begin + length
        if after > end:
            raise PkiError("a DER value is cut short")
        values.append(Value(tag, data[begin:after], data[start:after]))
        start = after
    return values


def first_value(data: bytes) -> Value:
    """Return the first value in ``data``; raise `PkiError` if there is none."""
    values = children(data)
    if not values:
        raise PkiError("a DER value is missing")
    return values[0]


def split(data: bytes) -> tuple[bytes, bytes]:
    """Return the first value in ``data`` (BER) with its original bytes, and the bytes after it.

    Raises:
        PkiError: the value is truncated, or has a form that this reader does not support.
    """
    end = _read_header(data, 0)[2] or _normalized(data, 0, 0)[1]
    return data[:end], data[end:]


def split_all(data: bytes) -> list[bytes]:
    """Return all values in ``data`` (BER), with their original bytes.

    Raises:
        PkiError: a value is truncated, or has a form that this reader does not support.
    """
    values = []
    while data:
        value, data = split(data)
        values.append(value)
    return values


def normalized(data: bytes) -> bytes:
    """Return the first value in BER ``data`` (X.690, 8), re-encoded with DER lengths.

    The values inside a constructed value are re-encoded, too.  OpenSSL reads the BER form and the
    result alike.

    Raises:
        PkiError: the value is truncated, too deep, or has a form that this reader does not support.
    """
    return _normalized(data, 0, 0)[0]


def first_part(data: bytes) -> bytes:
    """Return the first value inside a constructed value (BER), with its original bytes.

    In certificates and revocation lists, the signature covers these bytes.

    Raises:
        PkiError: a value is truncated, or has a form that this reader does not support.
    """
    begin = _read_header(data, 0)[1]
    return data[begin : _normalized(data, begin, 1)[1]]


_DEEPEST_NESTING = 30
_CONSTRUCTED = 0x20
_INDEFINITE = 0x80
_END_OF_CONTENTS = b"\0\0"


def _read_header(data: bytes, start: int) -> tuple[int, int, int | None]:
    """Return the tag of the value at ``start``, and the offsets of the content's start and end.

    The end is None if two zero bytes mark the end of the content.
    """
    if len(data) - start < 2:
        raise PkiError("a DER value is cut short")
    tag, length = data[start], data[start + 1]
    begin = start + 2
    if tag & 0x1F == 0x1F or tag == 0 or (length == _INDEFINITE and not tag & _CONSTRUCTED):
        raise PkiError("a DER value has a form that is not supported")
    if length == _INDEFINITE:
        return tag, begin, None
    if length > _INDEFINITE:
        size = length - _INDEFINITE
        length = int.from_bytes(data[begin : begin + size], "big")
        begin += size
    if begin + length > len(data):
        raise PkiError("a DER value is cut short")
    return tag, begin, begin + length


def _normalized(data: bytes, start: int, depth: int) -> tuple[bytes, int]:
    """Return the value at ``start``, re-encoded with DER lengths, and the offset of its end."""
    if depth > _DEEPEST_NESTING:
        raise PkiError("a DER value has a form that is not supported")
    tag, begin, end = _read_header(data, start)
    if not tag & _CONSTRUCTED and end is not None:
        content = data[begin:end]
        is_true = tag == BOOLEAN and len(content) == 1 and content != b"\0"
        return encode(tag, b"\xff" if is_true else content), end
    parts = []
    inside = data[:end]
    while begin < len(inside) and (end or inside[begin : begin + 2] != _END_OF_CONTENTS):
        part, begin = _normalized(inside, begin, depth + 1)
        parts.append(part)
    if end is None and begin >= len(inside):
        raise PkiError("a DER value is cut short")
    return encode(tag, *parts), begin if end else begin + 2


def integer(value: Value) -> int:
    """Return the number in an INTEGER.

    Raises:
        PkiError: the value has another tag, or its content is not the shortest form.
    """
    if value.tag != INTEGER:
        raise PkiError("a DER value is not a number")
    number = int.from_bytes(value.content, "big", signed=True)
    if (number if number >= 0 else ~number).bit_length() // 8 + 1 != len(value.content):
        raise PkiError("a DER number is empty, or longer than it needs to be")
    return number


def encode(tag: int, *parts: bytes) -> bytes:
    """Return a DER value with this tag; its content is the concatenation of ``parts``."""
    content = b"".join(parts)
    length = len(content).to_bytes((len(content).bit_length() + 7) // 8 or 1, "big")
    if len(content) >= 0x80:
        length = bytes([0x80 | len(length)]) + length
    return bytes([tag]) + length + content


def encode_integer(number: int) -> bytes:
    """Encode an integer that is not negative."""
    return encode(INTEGER, number.to_bytes(number.bit_length() // 8 + 1, "big"))


def encode_oid(dotted: str) -> bytes:
    """Encode an object identifier, given in dotted form, as the content of a DER value."""
    first_arc, second_arc, *rest = map(int, dotted.split("."))
    content = bytearray([40 * first_arc + second_arc])
    for number in rest:
        part = [number & 0x7F]
        while number := number >> 7:
            part.append(number & 0x7F | 0x80)
        content += bytes(reversed(part))
    return bytes(content)


def decode_oid(value: Value) -> str:
    """Return the dotted form of an object identifier.

    Raises:
        PkiError: the value is not an object identifier, or one that OpenSSL refuses
            (ossl_c2i_ASN1_OBJECT).
    """
    if value.tag != OID or not _OID_CONTENT.fullmatch(value.content):
        raise PkiError("a DER value is not an object identifier")
    numbers = [0]
    for octet in value.content:
        numbers[-1] = numbers[-1] << 7 | octet & 0x7F
        if not octet & 0x80:
            numbers.append(0)
    first = min(numbers[0] // 40, 2)
    return ".".join(map(str, (first, numbers[0] - 40 * first, *numbers[1:-1])))
