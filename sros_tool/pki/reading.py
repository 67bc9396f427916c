"""Reading of keys, certificates, requests and revocation lists that others wrote."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from cryptography import x509

from sros_tool.errors import PkiError
from sros_tool.pki import der
from sros_tool.pki.names import canonical_der

_BMP_STRING = 0x1E
_IN_NAMES = (0x03, 0x0C, 0x12, 0x13, 0x14, 0x16, 0x1C, _BMP_STRING)
"""The ASN.1 types that OpenSSL reads in names (B_ASN1_PRINTABLE)."""


@contextmanager
def reading(what: str, why: str, remedy: str = "") -> Iterator[None]:
    """Raise `PkiError` with these texts for any error of `cryptography` in the ``with`` block.

    For a damaged or hostile document it raises errors of more than ten classes, most of them at
    the first use of a part (``subject``, ``extensions``, ``public_key()``).  So the block also uses
    each part that is used later.
    """
    try:
        yield
    except BaseException as error:
        if is_of_reading(error):
            raise PkiError(what, why, remedy) from error
        raise


def is_of_reading(error: BaseException) -> bool:
    """Return whether an error may be one of `cryptography` about what it reads."""
    return isinstance(error, Exception) or type(error).__name__ == "PanicException"


def read_name(name: x509.Name) -> None:
    """Parse every part of a distinguished name that sros shows, compares or copies.

    Raises one of the errors that `reading` handles: also for a value that OpenSSL takes for no part
    of a name, such as a time.
    """
    name.rfc4514_string()
    read_name_der(name.public_bytes())


def read_name_der(name: bytes) -> None:
    """Parse every part of a distinguished name in DER, as `read_name` does."""
    canonical_der(name)
    for part in der.children(der.first(name).content):
        for attribute in der.children(part.content):
            oid, value = der.children(attribute.content)
            if (part.tag, attribute.tag, oid.tag) != (der.SET, der.SEQUENCE, der.OID):
                raise ValueError("not the structure of a name")
            if value.tag not in _IN_NAMES:
                raise ValueError(f"a value of a name has the ASN.1 type {value.tag}")
            characters = value.content.decode("utf-16-be") if value.tag == _BMP_STRING else ""
            if max(characters, default="") > "\uffff":
                raise ValueError("a BMPString has a character of more than 16 bits")
