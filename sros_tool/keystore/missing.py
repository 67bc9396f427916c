"""The error for an enclave that a keystore does not have, which names the one that may be meant."""

from __future__ import annotations

import difflib
from collections.abc import Collection
from pathlib import Path

from sros_tool.errors import InvalidNameError, KeystoreError, SrosError
from sros_tool.names import check_enclave_name

_FEW = 5
"""So many enclaves are told before the rest is counted."""
_ALIKE = 0.75
"""The least likeness (`difflib`) of a slip of the keyboard: one letter of four, or two of eight."""


def no_such_enclave(root: Path, name: str, there: Collection[str]) -> SrosError:
    """The error for ``name``, which is none of the enclaves that are ``there``."""
    what = f"enclave {name} does not exist in keystore '{root}'"
    meant = likely(name, there)
    if meant:
        return KeystoreError(what, "", f"Perhaps {' or '.join(meant)} is meant.")
    try:
        check_enclave_name(name)
    except InvalidNameError as error:
        return error
    names = sorted(there)
    more = f" and {len(names) - _FEW} more" if len(names) > _FEW else ""
    why = f"It has {', '.join(names[:_FEW]) or 'none'}{more}."
    return KeystoreError(what, why, f"Make it with `sros create_enclave {root} {name}`.")


def likely(name: str, there: Collection[str]) -> tuple[str, ...]:
    """The enclaves that someone who wrote ``name`` may have meant, at most three.

    Those that end in it, for its beginning is what one leaves out; otherwise those whose last part
    is spelt alike.
    """
    end = "/" + name.strip("/")
    if end == "/":
        return ()
    found = [each for each in there if each.endswith(end)]
    if not found:
        last = {each: each.rpartition("/")[2] for each in there}
        alike = difflib.get_close_matches(
            end.rpartition("/")[2], set(last.values()), n=3, cutoff=_ALIKE
        )
        found = [each for each in there if last[each] in alike]
    return tuple(sorted(found)[:3])
