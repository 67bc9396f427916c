"""The error for a missing enclave, which says whether it was revoked or its name may be a typo."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from pathlib import Path
from shlex import quote

from sros_tool.errors import InvalidNameError, KeystoreError, SrosError
from sros_tool.keystore.layout import FLEET, PRIVATE, PUBLIC, REVOKED, SETTINGS
from sros_tool.keystore.ledger import Entry
from sros_tool.keystore.reader import Keystore
from sros_tool.names import check_enclave_name
from sros_tool.wording import first_few

_SHOWN = 5
"""The number of enclaves that an error names; it counts the others."""
_ALIKE = 0.75
"""The lowest similarity (`difflib`) of a typo: one of four letters differs, or two of eight."""
_WHOLE_ALIKE = 0.9
"""The lowest similarity of a typo in a whole name: names of one namespace begin alike."""


def no_such_enclave(
    root: Path, name: str, there: Collection[str], *, may_create: bool = True
) -> SrosError:
    """Return the error for the missing enclave ``name``; ``there`` are the existing enclaves.

    Without ``may_create`` it does not advise to create the enclave.
    """
    if revocation := _revocation(root, name):
        return _was_revoked(root, revocation)
    what = f"enclave {name} does not exist in keystore '{root}'"
    names = sorted(there)
    if below := [each for each in names if name and each.startswith(f"{name}/")]:
        number = "1 enclave" if len(below) == 1 else f"{len(below)} enclaves"
        return KeystoreError(
            what,
            f"It is the namespace of {number}, such as {below[0]}.",
            f"Name one of them; a verb that takes several also has --match '{name}/*'.",
        )
    meant = likely_names(name, there)
    if meant:
        return KeystoreError(what, "", f"Perhaps you mean {' or '.join(meant)}.")
    try:
        check_enclave_name(name)
    except InvalidNameError as error:
        return error
    why = f"The keystore has {first_few(names, _SHOWN) or 'no enclave'}."
    if not any((root / part).exists() for part in (PUBLIC, PRIVATE, SETTINGS)):
        where = f"`sros distribute_key KEYSTORE {name} {quote(str(root))}`"
        return KeystoreError(what, why, f"If it is not a typo, export it with {where}.")
    if not may_create:
        return KeystoreError(what, why, f"See `sros list_enclaves {quote(str(root))}`.")
    create = f"`sros create_enclave {quote(str(root))} {name}`"
    return KeystoreError(what, why, f"If it is not a typo, create it with {create}.")


def _revocation(root: Path, name: str) -> Entry | None:
    """Return the ledger entry of an enclave's revocation; None if it has a later certificate."""
    try:
        entries = Keystore(root).ledger_with("enclave", name).entries
    except SrosError:
        return None  # the missing enclave is the error to report here
    of_enclave = [
        e for e in entries if e.enclave == name and e.what in ("certificate", "revocation")
    ]
    if not of_enclave or of_enclave[-1].what != "revocation":
        return None
    # One revocation has an entry for each certificate; only one of them has files.
    kept = (e for e in reversed(of_enclave) if e.serial and (root / REVOKED / e.serial).is_dir())
    return next(kept, of_enclave[-1])


def _was_revoked(root: Path, entry: Entry) -> SrosError:
    reason = "" if entry.reason in ("", "unspecified") else f" ({entry.reason})"
    folder = root / REVOKED / entry.serial
    return KeystoreError(
        f"enclave {entry.enclave} of keystore '{root}' was revoked at {entry.time}{reason}",
        f"Its files are in '{folder}'." if folder.is_dir() else "",
        f"To use it again, with another key: `sros generate_artifacts -k {quote(str(root))} -e "
        f"{entry.enclave} -p POLICY_FILE{' --fleet FLEET_FILE' if (root / FLEET).exists() else ''}`"
        ".",
    )


def likely_names(name: str, there: Collection[str]) -> tuple[str, ...]:
    """Return at most three enclaves that a mistyped ``name`` may mean.

    These are the enclaves whose names end with ``name``, because people leave out the namespace;
    if there are none, the enclaves whose last part is spelled almost alike, and else those whose
    whole name is.  Capital letters do not count.
    """
    end = "/" + name.strip("/").lower()
    if end == "/":
        return ()
    lower = {each: each.lower() for each in there}
    found = [each for each in there if lower[each].endswith(end)]
    if not found:
        last = {each: text.rpartition("/")[2] for each, text in lower.items()}
        found = _alike(end.rpartition("/")[2], last, _ALIKE)
    return tuple(sorted(found or _alike(end, lower, _WHOLE_ALIKE))[:3])


def _alike(text: str, texts: Mapping[str, str], least: float) -> list[str]:
    """Return the enclaves whose text (the value) is spelled almost as ``text``."""
    import difflib

    alike = difflib.get_close_matches(text, set(texts.values()), n=3, cutoff=least)
    return [each for each, written in texts.items() if written in alike]
