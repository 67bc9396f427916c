"""PEM files as OpenSSL 3 reads them, and with it every DDS vendor (pem_lib.c).

OpenSSL reads less than other programs (RFC 7468 leaves it to them): a block begins and ends at the
start of a line, and a damaged block hides all blocks after it.
"""

from __future__ import annotations

import base64
import re
from collections.abc import Iterator
from typing import NamedTuple

from sros_tool.errors import PkiError
from sros_tool.pki.kinds import kind_of

CERTIFICATES = ("CERTIFICATE", "X509 CERTIFICATE", "TRUSTED CERTIFICATE")
"""Labels of certificates; the last one may carry what the certificate is trusted for."""

_PIECE = re.compile(rb"[^\n]{0,253}\n|[^\n]{1,254}")
"""What OpenSSL reads at once: a line, or 254 characters of a longer one."""
_BEGIN = re.compile(rb"-----BEGIN (.*)-----", re.DOTALL)
_END = b"-----END "
_NOT_AT_START = re.compile(rb"[^\n]-----BEGIN ")
_BASE64 = re.compile(rb"[A-Za-z0-9+/]*={0,2}")
_ALONE = re.compile(
    rb"-----BEGIN ([A-Z0-9 ]{1,60})-----\n((?:[A-Za-z0-9+/]{1,76}\n)*[A-Za-z0-9+/]{1,76}={0,2}\n)"
    rb"-----END \1-----\n"
)
"""A file of one block without headers, as almost all programs write it."""
_BLANKS = bytes(range(0x21))
_BETWEEN = b" \t\r\n"
_BOM = b"\xef\xbb\xbf"
_LONGEST = 64


class Block(NamedTuple):
    """A block of a PEM file: its label, its headers (RFC 1421, 4.6), and its decoded content."""

    label: str
    headers: bytes
    content: bytes


def blocks(data: bytes) -> Iterator[Block]:
    """Yield the blocks of a PEM file, in order.

    Raises:
        PkiError: a block is damaged, so OpenSSL does not read what follows; or its first line ends
            with a byte beyond ASCII, which OpenSSL drops on some processors only.
    """
    if alone := _ALONE.fullmatch(data):
        label = alone[1].decode("ascii")
        yield Block(label, b"", _decoded(alone[2], label))
        return
    pieces = iter(_PIECE.findall(data))
    start = True  # a byte order mark is dropped here, and behind each block
    for piece in pieces:
        line = (piece.removeprefix(_BOM) if start else piece).rstrip(_BLANKS)
        if b"\0" in line and line.startswith(b"-----BEGIN "):
            raise PkiError("a line '-----BEGIN' in it has a zero byte")
        begin = _BEGIN.fullmatch(line)
        start = bool(begin)
        if begin:
            yield _block(begin[1], pieces)
        elif _BEGIN.match(line) and line[-1] > 0x7F:
            raise PkiError("a line '-----BEGIN' in it ends with a byte beyond ASCII")


def read_as_text(data: bytes) -> bytes:
    """Return what OpenSSL reads of a PEM file through a file pointer (bss_file.c).

    A zero byte ends its line, and a line that begins with a zero byte the whole file.
    """
    if b"\0" not in data:
        return data
    lines: list[bytes] = []
    for piece in _PIECE.findall(data):
        line, zero, _ = piece.partition(b"\0")
        if zero and not line:
            break
        lines.append(line + b"\n" if zero else piece)
    return b"".join(lines)


def missing(data: bytes, label: str) -> str:
    """Return why OpenSSL finds no block with this label in a PEM file, as a clause."""
    if _NOT_AT_START.search(data):
        return (
            "'-----BEGIN' is not at the start of its line, where OpenSSL looks for it: "
            "the text is indented, or other text stands before it"
        )
    kind = kind_of(data)
    return f"it is {kind}" if kind else f"it has no line '-----BEGIN {label}-----'"


def _block(label: bytes, pieces: Iterator[bytes]) -> Block:
    """Read a block after its first line: headers and an empty line, or only its content."""
    name = label.decode("utf-8", "replace")[:80]
    parts: list[list[bytes]] = [[]]
    split = short = False
    for piece in pieces:
        line = piece.rstrip(_BLANKS)
        if b"\0" in piece:
            raise PkiError(f"the block {name} in it has a zero byte")
        if not line:
            if not split:
                if len(parts) == 2:
                    raise PkiError(f"the block {name} in it has two empty lines")
                parts.append([])
        elif line.startswith(_END):
            break
        elif short or (len(parts) == 2 and len(line) > _LONGEST):
            raise PkiError(f"the block {name} in it has lines of different lengths")
        else:
            parts[-1].append(line)
            short = len(parts) == 2 and len(line) < _LONGEST
        split = not piece.endswith(b"\n")
    else:
        raise PkiError(f"the block {name} in it is cut short")
    if line != _END + label + b"-----":
        raise PkiError(f"the block {name} in it does not end with '-----END {name}-----'")
    if len(parts) == 1 and any(b":" in part for part in parts[0]):
        parts.append([])  # headers alone
    headers = b"\n".join(parts.pop(0)) if len(parts) == 2 else b""
    return Block(label.decode("utf-8", "replace"), headers, _decoded(b"\n".join(parts[0]), name))


def _decoded(encoded: bytes, name: str) -> bytes:
    text = encoded.partition(b"-")[0].translate(None, _BETWEEN)
    if not text:
        raise PkiError(f"the block {name} in it is empty")
    if len(text) % 4 or not _BASE64.fullmatch(text):
        raise PkiError(f"the block {name} in it is not valid base64")
    return base64.b64decode(text)
