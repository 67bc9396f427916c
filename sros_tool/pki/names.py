"""Comparison of distinguished names as X.509 demands it (RFC 5280, 7.1; OpenSSL, x_name.c)."""

from __future__ import annotations

import re
from functools import lru_cache

from cryptography import x509

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
"""The encodings of the string types that are compared as text; others by their bytes."""
_SPACES = re.compile(rb"[ \t\n\v\f\r]+")


def same_name(one: x509.Name, other: x509.Name) -> bool:
    """Return whether two names are equal: string types, case and blanks do not count."""
    return len(one.rdns) == len(other.rdns) and canonical(one) == canonical(other)


@lru_cache(maxsize=64)  # all documents of a keystore have the same signer
def canonical_issuer(certificate: x509.Certificate) -> tuple[bytes, ...]:
    """Return the parts of the name of a certificate's issuer, as `canonical` does."""
    return canonical(certificate.issuer)


def canonical(name: x509.Name) -> tuple[bytes, ...]:
    """Return the parts (RDNs) of a name, such that names that are equal have equal parts."""
    return canonical_der(name.public_bytes())


@lru_cache(maxsize=256)  # a few CAs are compared with many certificates
def canonical_der(name: bytes) -> tuple[bytes, ...]:
    """Return the parts of a name in DER, as `canonical` does."""
    parts = der.children(der.first(name).content)
    return tuple(
        b"".join(sorted(_attribute(each) for each in der.children(part.content))) for part in parts
    )


def _attribute(attribute: der.Value) -> bytes:
    kind, value = der.children(attribute.content)
    encoding = _ENCODINGS.get(value.tag)
    if encoding is None:
        return der.encode(der.SEQUENCE, kind.whole, value.whole)
    text = value.content.decode(encoding, "surrogatepass").encode("utf-8", "surrogatepass")
    # Letters beyond ASCII keep their case.
    plain = _SPACES.sub(b" ", text).strip(b" ").lower()
    return der.encode(der.SEQUENCE, kind.whole, der.encode(0x0C, plain))
