"""Founds a keystore: authorities, governance, settings, at a place where nothing is in the way."""

from __future__ import annotations

import difflib
import os
from collections.abc import Mapping
from datetime import datetime
from pathlib import Path
from types import MappingProxyType

from sros_tool.dds.domains import DomainSet
from sros_tool.dds.governance import parse_governance, render_governance
from sros_tool.errors import KeystoreError, UsageError
from sros_tool.keystore.authority import Authorities, Authority, create_authorities
from sros_tool.keystore.keyring import Keyring
from sros_tool.keystore.layout import (
    ENCLAVES,
    GOVERNANCE_P7S,
    GOVERNANCE_XML,
    PRIVATE,
    PUBLIC,
    SETTINGS,
    is_keystore,
)
from sros_tool.keystore.ledger import Entry, certificate_entry, document_entry
from sros_tool.keystore.template import Template, render_template
from sros_tool.keystore.transaction import Transaction
from sros_tool.translate import governance_for
from sros_tool.validity import window

NOTHING: Mapping[str, bytes] = MappingProxyType({})


def write_keystore(
    transaction: Transaction,
    template: Template,
    domains: DomainSet,
    keyring: Keyring,
    now: datetime,
    imported: Mapping[str, bytes] = NOTHING,
) -> tuple[Authorities, list[Entry]]:
    """Stage a new keystore: its authorities, its governance and its settings."""
    for span in (template.certificate_validity, template.permissions_validity):
        window(now, span)  # what could not issue anything is no keystore
    authorities = create_authorities(transaction, template, keyring, now, imported)
    distinct = dict.fromkeys((authorities.identity, authorities.permissions))
    entries = [certificate_entry(now, "ca", each.certificate) for each in distinct]
    message = _write_governance(transaction, authorities.permissions, template, domains)
    entries.append(document_entry(now, "governance", message))
    transaction.write(
        SETTINGS,
        b"# The choices by which sros made this keystore; what is added later follows them.\n"
        + render_template(keyring.remembered(template)).encode(),
    )
    return authorities, entries


def _write_governance(
    transaction: Transaction, authority: Authority, template: Template, domains: DomainSet
) -> bytes:
    """Stage the governance document of a keystore, with its readable form; the signed one."""
    governance = governance_for(template.protection, domains)
    document = render_governance(governance)
    message = authority.sign(document, governance, parse_governance, "the governance document")
    transaction.write(GOVERNANCE_XML, document)
    transaction.write(GOVERNANCE_P7S, message)
    return message


def check_free(root: Path) -> None:
    """Raise `KeystoreError` where something is in the way of a new keystore."""
    if is_keystore(root):
        raise _exists(root)
    if root.resolve() == Path("/"):
        raise KeystoreError("the root of the file system is no place for a keystore")
    if os.path.lexists(root) and not root.is_dir():
        raise KeystoreError(f"'{root}' is in the way", "It is not a folder.")
    remains = [part for part in (PUBLIC, PRIVATE, ENCLAVES) if (root / part).exists()]
    if remains:
        if is_keystore(root):  # another process has completed it between the two looks
            raise _exists(root)
        raise KeystoreError(
            f"'{root}' holds parts of a keystore already",
            f"There are {', '.join(remains)}; a new CA beside them would lock out every enclave "
            "that trusts the old one.",
            "Restore what is missing, or choose another path.",
        )


def _exists(root: Path) -> KeystoreError:
    return KeystoreError(
        f"keystore '{root}' already exists",
        "",
        "Nothing was changed. Add to it with `sros create_enclave`, or choose another path.",
    )


def check_typo(root: Path) -> None:
    """Refuse to make a keystore whose name is all but that of one beside it."""
    try:
        beside = [p.name for p in root.absolute().parent.iterdir() if p.is_dir()]
    except OSError:
        return
    close = difflib.get_close_matches(root.name, beside, n=3, cutoff=0.5)
    for name in close:
        if is_keystore(root.absolute().parent / name):
            raise UsageError(
                f"'{root}' does not exist, and '{name}' beside it is a keystore",
                "This may be a typing error, so no second keystore is made.",
                f"Name '{root.with_name(name)}', or run `sros create_keystore {root}` first.",
            )
