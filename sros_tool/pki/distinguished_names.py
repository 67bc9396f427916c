"""Distinguished names: reading and comparing them as OpenSSL does (RFC 5280, 7.1; x_name.c).

``object_names.txt`` has the names of all object identifiers in OpenSSL 3.0, which the tested DDS
vendors use.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from functools import cache, lru_cache
from pathlib import Path

from cryptography import x509

from sros_tool.errors import PkiError
from sros_tool.pki import der

_ENCODINGS = {
    0x0C: "utf-8",
    0x13: "latin-1",
    0x14: "latin-1",
    0x16: "latin-1",
    0x1A: "latin-1",
    0x1C: "utf-32-be",
    0x1E: "utf-16-be",
}
"""Maps an ASN.1 string type, whose values are compared as text, to its encoding.

Values of other types are compared by bytes.
"""
_SPACES = re.compile(rb"[ \t\n\v\f\r]+")


def same_name(first: x509.Name, second: x509.Name) -> bool:
    """Return whether names are equal, regardless of string types, case, blanks and empty parts."""
    return canonical(first) == canonical(second)


@lru_cache(maxsize=64)  # all documents of a keystore have the same signer
def canonical_issuer(certificate: x509.Certificate) -> tuple[bytes, ...]:
    """Return the issuer name of a certificate in the form of `canonical`."""
    return canonical(certificate.issuer)


def canonical(name: x509.Name) -> tuple[bytes, ...]:
    """Return the parts (RDNs) of a name, normalized: equal names have equal results."""
    return canonical_der(name.public_bytes())


@lru_cache(maxsize=256)  # a few CAs are compared with many certificates
def canonical_der(name: bytes) -> tuple[bytes, ...]:
    """Return a name, given in DER, in the form of `canonical`."""
    parts = der.children(der.first_value(name).content)
    return tuple(
        b"".join(
            sorted(_canonical_attribute(attribute) for attribute in der.children(part.content))
        )
        for part in parts
        if part.content
    )


def _canonical_attribute(attribute: der.Value) -> bytes:
    kind, value = der.children(attribute.content)
    encoding = _ENCODINGS.get(value.tag)
    if encoding is None:
        return der.encode(der.SEQUENCE, kind.whole, value.whole)
    text = value.content.decode(encoding, "surrogatepass").encode("utf-8", "surrogatepass")
    # Letters beyond ASCII keep their case.
    plain = _SPACES.sub(b" ", text).strip(b" ").lower()
    return der.encode(der.SEQUENCE, kind.whole, der.encode(0x0C, plain))


# ── names of objects ──────────────────────────────────────────────────────────────────────────


@cache
def short_names() -> Mapping[str, str]:
    """Return OpenSSL's short names of attributes by OID.

    OpenSSL prints attributes without a short name in hexadecimal.
    """
    data = Path(__file__).with_name("object_names.txt").read_text(encoding="ascii")
    return dict(line.split(" ") for line in data.splitlines())


# ── reading ───────────────────────────────────────────────────────────────────────────────────


_BMP_STRING = 0x1E
_TYPES_IN_NAMES = (0x03, 0x0C, 0x12, 0x13, 0x14, 0x16, 0x1C, _BMP_STRING)
"""The ASN.1 types that OpenSSL reads in names (B_ASN1_PRINTABLE)."""


@contextmanager
def reading(unreadable: str, why: str, remedy: str = "") -> Iterator[None]:
    """Turn all errors of `cryptography` in the ``with`` block into a `PkiError` with these texts.

    For a damaged or hostile document, `cryptography` raises errors of more than ten classes, mostly
    at the first use of a part (``subject``, ``extensions``, ``public_key()``).  So the block has to
    use every part that is needed later.
    """
    try:
        yield
    except BaseException as error:
        if may_be_read_error(error):
            raise PkiError(unreadable, why, remedy) from error
        raise


def may_be_read_error(error: BaseException) -> bool:
    """Return whether `cryptography` may raise this error for a malformed document."""
    return isinstance(error, Exception) or type(error).__name__ == "PanicException"


def check_name_readable(name: x509.Name) -> None:
    """Raise an error if a part of a distinguished name cannot be parsed.

    Raises one of the errors that `reading` handles, also for a value of a type that OpenSSL does
    not read in names, such as a time.
    """
    name.rfc4514_string()
    check_name_der_readable(name.public_bytes())


def check_name_der_readable(name: bytes) -> None:
    """Raise an error if a part of a distinguished name in DER cannot be parsed."""
    canonical_der(name)
    whole = der.first_value(name)
    parts = der.children(whole.content)
    if whole.tag != der.SEQUENCE or any(part.tag != der.SET for part in parts):
        raise ValueError("not the structure of a name")
    for part in parts:
        for attribute in der.children(part.content):
            oid, value = der.children(attribute.content)
            if (attribute.tag, oid.tag) != (der.SEQUENCE, der.OID):
                raise ValueError("not the structure of a name")
            if value.tag not in _TYPES_IN_NAMES:
                raise ValueError(
                    f"a value of a name has the ASN.1 type {value.tag}, which OpenSSL does not "
                    "read in names"
                )
            characters = value.content.decode("utf-16-be") if value.tag == _BMP_STRING else ""
            if max(characters, default="") > "\uffff":
                raise ValueError("a BMPString may not have a character of more than 16 bits")
