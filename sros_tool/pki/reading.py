"""Reading of keys, certificates, requests and revocation lists that others wrote."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from cryptography import x509

from sros_tool.errors import PkiError


@contextmanager
def reading(what: str, why: str, remedy: str = "") -> Iterator[None]:
    """Raise `PkiError` with these texts for any error of `cryptography` in the ``with`` block.

    For a damaged or hostile document it raises errors of more than ten classes, most of them at
    the first use of a part (``subject``, ``extensions``, ``public_key()``).  So the block also uses
    each part that is used later.
    """
    try:
        yield
    except Exception as error:
        raise PkiError(what, why, remedy) from error


def read_name(name: x509.Name) -> None:
    """Parse every part of a distinguished name that sros shows, compares or copies.

    Raises one of the errors that `reading` handles.
    """
    name.rfc4514_string()
    name.public_bytes()
