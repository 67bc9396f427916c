"""Reading PEM files as OpenSSL 3 does for all DDS vendors (pem_lib.c), and finding file types.

OpenSSL is stricter than other programs, which RFC 7468 permits: a block begins and ends at the
start of a line, and a damaged block hides all blocks after it.
"""

from __future__ import annotations

import base64
import re
from collections.abc import Iterator
from typing import NamedTuple

from sros_tool.errors import PkiError
from sros_tool.pki import der

CERTIFICATES = ("CERTIFICATE", "X509 CERTIFICATE", "TRUSTED CERTIFICATE")
"""Labels of certificates; a block with the last label can also contain trust settings."""

_LINE_PIECE = re.compile(rb"[^\n]{0,253}\n|[^\n]{1,254}")
"""Matches a line as OpenSSL reads it: a whole line, or the next 254 characters of a longer line."""
_BEGIN = re.compile(rb"-----BEGIN (.*)-----", re.DOTALL)
_END = b"-----END "
_NOT_AT_START = re.compile(rb"[^\n]-----BEGIN ")
_BASE64 = re.compile(rb"[A-Za-z0-9+/]*={0,2}")
_SINGLE_BLOCK = re.compile(
    rb"-----BEGIN ([A-Z0-9 ]{1,60})-----\n((?:[A-Za-z0-9+/]{1,76}\n)*[A-Za-z0-9+/]{1,76}={0,2}\n)"
    rb"-----END \1-----\n"
)
"""Matches a file that consists of one block without headers, the common case."""
_BLANKS = bytes(range(0x21))
_IGNORED_IN_BASE64 = b" \t\r\n"
_BOM = b"\xef\xbb\xbf"
_LONGEST_LINE = 64


class Block(NamedTuple):
    """A block of a PEM file: its label, its headers (RFC 1421, 4.6), and its decoded content."""

    label: str
    headers: bytes
    content: bytes


def blocks(data: bytes) -> Iterator[Block]:
    """Yield the blocks of a PEM file, in order.

    Raises:
        PkiError: a block is damaged, so that OpenSSL does not read the blocks after it; or the
            first line of a block ends with a non-ASCII byte, which OpenSSL drops only on some
            processors.
    """
    if single := _SINGLE_BLOCK.fullmatch(data):
        label = single[1].decode("ascii")
        yield Block(label, b"", _decoded_content(single[2], label))
        return
    pieces = iter(_LINE_PIECE.findall(data))
    start = True  # OpenSSL drops a byte order mark at the start of the file and after each block
    for piece in pieces:
        line = (piece.removeprefix(_BOM) if start else piece).rstrip(_BLANKS)
        if b"\0" in line and line.startswith(b"-----BEGIN "):
            raise PkiError("one of its '-----BEGIN' lines has a zero byte")
        begin = _BEGIN.fullmatch(line)
        start = bool(begin)
        if begin:
            yield _read_block(begin[1], pieces)
        elif _BEGIN.match(line) and line[-1] > 0x7F:
            raise PkiError("one of its '-----BEGIN' lines ends with a non-ASCII byte")


def read_as_text(data: bytes) -> bytes:
    """Return a PEM file as OpenSSL sees it when it reads lines from a FILE pointer (bss_file.c).

    A zero byte ends its line.  A line that begins with a zero byte ends the whole file.
    """
    if b"\0" not in data:
        return data
    lines: list[bytes] = []
    for piece in _LINE_PIECE.findall(data):
        line, zero, _ = piece.partition(b"\0")
        if zero and not line:
            break
        lines.append(line + b"\n" if zero else piece)
    return b"".join(lines)


def missing_block_reason(data: bytes, label: str) -> str:
    """Return why OpenSSL finds no block with a label in a PEM file, as a clause."""
    if _NOT_AT_START.search(data):
        return (
            "'-----BEGIN' is not at the start of its line, where OpenSSL looks for it: "
            "the text is indented, or other text stands before it"
        )
    kind = kind_of(data)
    return f"it is {kind}" if kind else f"it has no line '-----BEGIN {label}-----'"


def _read_block(label: bytes, pieces: Iterator[bytes]) -> Block:
    """Parse a block after its BEGIN line: optional headers and an empty line, then content."""
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
        elif short or (len(parts) == 2 and len(line) > _LONGEST_LINE):
            raise PkiError(f"the block {name} in it has lines of different lengths")
        else:
            parts[-1].append(line)
            short = len(parts) == 2 and len(line) < _LONGEST_LINE
        split = not piece.endswith(b"\n")
    else:
        raise PkiError(f"the block {name} in it is cut short")
    if line != _END + label + b"-----":
        raise PkiError(f"the block {name} in it does not end with '-----END {name}-----'")
    if len(parts) == 1 and any(b":" in part for part in parts[0]):
        parts.append([])  # the block has headers only
    headers = b"\n".join(parts.pop(0)) if len(parts) == 2 else b""
    return Block(
        label.decode("utf-8", "replace"), headers, _decoded_content(b"\n".join(parts[0]), name)
    )


def _decoded_content(encoded: bytes, name: str) -> bytes:
    text = encoded.partition(b"-")[0].translate(None, _IGNORED_IN_BASE64)
    if not text:
        raise PkiError(f"the block {name} in it is empty")
    if len(text) % 4 or not _BASE64.fullmatch(text):
        raise PkiError(f"the block {name} in it is not valid base64")
    return base64.b64decode(text)


# ── kinds of files ─────────────────────────────────────────────────────────────────────────

ENCRYPTED_MESSAGE = "an S/MIME message that is encrypted, not signed"
SIGNED_MESSAGE = "an S/MIME signed message"
XML = "XML that is not signed"
_UTF_16 = "a text in UTF-16"

_KINDS_BY_BEGINNING = (
    (b"\xff\xfe", _UTF_16),
    (b"\xfe\xff", _UTF_16),
    (b"<\0", _UTF_16),
    (b"\0<", _UTF_16),
    (b"PK\x03\x04", "a ZIP archive"),
    (b"\x1f\x8b", "a file that gzip compressed"),
    (b"ssh-", "a public key of OpenSSH"),
    (b"ecdsa-sha2-", "a public key of OpenSSH"),
    (b"pkcs11:", "the URI of a key on a token"),
)
"""Maps the first bytes of a file to the kind of the file, as a noun with its article."""

_LABEL = re.compile(rb"^-----BEGIN ([^\r\n]{1,60})-----[ \t\r]*$", re.MULTILINE)
_KINDS_BY_LABEL = {
    "CERTIFICATE": "a certificate",
    "X509 CERTIFICATE": "a certificate",
    "TRUSTED CERTIFICATE": "a TRUSTED CERTIFICATE of OpenSSL",
    "CERTIFICATE REQUEST": "a signing request, not yet a certificate",
    "NEW CERTIFICATE REQUEST": "a signing request, not yet a certificate",
    "X509 CRL": "a revocation list",
    "PUBLIC KEY": "a public key",
    "RSA PUBLIC KEY": "a public key",
    "SSH2 PUBLIC KEY": "a public key of OpenSSH",
    "OPENSSH PRIVATE KEY": "a private key in the form of OpenSSH",
    "EC PARAMETERS": "the parameters of a key, without the key",
    "PKCS7": "PKCS#7 in PEM",
    "CMS": "CMS in PEM",
}

_KINDS_BY_OID = {
    der.encode_oid("1.2.840.113549.1.7.2"): "PKCS#7 in DER",
    der.encode_oid("1.2.840.113549.1.7.3"): ENCRYPTED_MESSAGE,
    der.encode_oid("1.2.840.113549.1.7.6"): ENCRYPTED_MESSAGE,
    der.encode_oid("1.2.840.113549.1.9.16.1.23"): ENCRYPTED_MESSAGE,
}
_KEY_IN_DER = "a private key in DER, not in PEM (`openssl pkey -inform DER` writes PEM)"
_CERTIFICATE_IN_DER = "a certificate in DER, not in PEM (`openssl x509 -inform DER` writes PEM)"
_LIST_IN_DER = "a revocation list in DER, not in PEM (`openssl crl -inform DER` writes PEM)"
_PKCS12 = "a PKCS#12 container (.p12, .pfx)"

_MIME_HEADER = re.compile(rb"(?i)\s*(?:mime-version|content-type|content-transfer-encoding)[ \t]*:")
_BASE64_WITHOUT_PEM = re.compile(rb"[A-Za-z0-9+/\s]{40,}={0,2}\s*")
_MOST_EXAMINED = 4096
"""Number of bytes at the start of a text that are examined."""


def kind_of(data: bytes) -> str:
    """Return the kind of a file by its content, such as "a private key"; "" if it is unknown."""
    for mark, kind in _KINDS_BY_BEGINNING:
        if data.startswith(mark):
            return kind
    if data[:1] == bytes((der.SEQUENCE,)) and (kind := _kind_of_der(data)):
        return kind
    text = data.removeprefix(b"\xef\xbb\xbf")
    if match := _LABEL.search(text):
        return _kind_of_label(match[1].decode("ascii", "replace"))
    if _MIME_HEADER.match(text):
        return _kind_of_message(text)
    if text.lstrip()[:1] == b"<":
        return XML
    if not text.strip():
        return "a file with only blanks" if data else "an empty file"
    if _BASE64_WITHOUT_PEM.fullmatch(text[:_MOST_EXAMINED]):
        return "base64 without its lines '-----BEGIN' and '-----END'"
    return ""


def _kind_of_label(label: str) -> str:
    if label.endswith("PRIVATE KEY") and label not in _KINDS_BY_LABEL:
        return "a private key"
    return _KINDS_BY_LABEL.get(label, f"a PEM file of the kind {label}")


def _kind_of_message(text: bytes) -> str:
    """Return the kind of a MIME message, by its headers."""
    if text[:1].isspace():
        return "a MIME message with an empty line before its headers, so that it has no headers"
    head = text[:_MOST_EXAMINED].lower()
    if b"enveloped-data" in head or b"encrypted-data" in head:
        return ENCRYPTED_MESSAGE
    signed = b"multipart/signed" in head or b"pkcs7-mime" in head
    return SIGNED_MESSAGE if signed else "a MIME message that is not signed"


def _kind_of_der(data: bytes) -> str:
    """Return the kind of a DER file by its structure; "" if it is unknown."""
    try:
        whole, _ = der.split(data)
        parts = der.children(der.first_value(der.normalized(whole)).content)
        tags = tuple(part.tag for part in parts)
        if tags[:1] == (der.OID,):
            return _KINDS_BY_OID.get(parts[0].content, "a message in DER")
        if tags == (der.SEQUENCE, der.SEQUENCE, der.BIT_STRING):
            return _kind_of_signed(der.children(parts[0].content))
    except PkiError:
        return ""
    if tags == (der.SEQUENCE, der.BIT_STRING):
        return "a public key in DER"
    if tags == (der.SEQUENCE, der.OCTET_STRING):
        return "an encrypted private key in DER"
    if tags[:2] == (der.INTEGER, der.SEQUENCE):
        return _KEY_IN_DER if der.OCTET_STRING in tags else _PKCS12
    return _KEY_IN_DER if tags[:1] == (der.INTEGER,) else ""


def _kind_of_signed(parts: list[der.Value]) -> str:
    """Return the kind of a signed value in words: certificate, request or revocation list."""
    tags = [part.tag for part in parts]
    if der.UTC_TIME in tags or der.GENERALIZED_TIME in tags:
        return _LIST_IN_DER
    if tags[:3] == [der.INTEGER, der.SEQUENCE, der.SEQUENCE] and tags[3:] in ([], [der.CONTEXT_0]):
        return "a signing request in DER, not yet a certificate"
    return _CERTIFICATE_IN_DER
