"""What differs between the releases of OpenSSL 3.0 that the tests meet."""

from __future__ import annotations

from functools import cache

from tests.support.children import run

_TAKES_CHANGES = ("3.0.18", "3.0.19", "3.0.20", "3.0.21")
"""Seen with 3.0.20, and not with 3.0.22; of those beside it nothing is known."""


@cache
def takes_changes_for_lists() -> bool:
    """Return whether OpenSSL may take a list that has only changes (a delta CRL) for a whole one.

    Then a process starts, and all that the whole list revoked is valid.  sros says of such a list
    what the other releases do: that it is refused.
    """
    return run(["openssl", "version"]).stdout.split()[1] in _TAKES_CHANGES
