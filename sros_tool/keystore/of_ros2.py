"""Keystores that ros2/sros2 made: how they are told from those of sros, and taken over.

The first write of sros gives them settings, with the values that are in force, and a ledger that
begins with what is there.  Nothing shows whether something was taken away before: what is recorded
is taken on trust, and the entries and the message say so.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator
from contextlib import suppress
from dataclasses import replace
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING

from cryptography import x509

from sros_tool.errors import SrosError
from sros_tool.keystore.layout import (
    GOVERNANCE_P7S,
    IDENTITY,
    LEDGER,
    LEDGER_HEAD,
    PERMISSIONS_FILE,
    ROLES,
    SETTINGS,
)
from sros_tool.keystore.reader import Keystore, as_keystore
from sros_tool.keystore.settings import present_settings, write_settings
from sros_tool.translate import protection_for

if TYPE_CHECKING:
    from sros_tool.keystore.ledger import Entry
    from sros_tool.keystore.transaction.transaction import Transaction

_ADOPTED = "taken over"
"""The ``reason`` of ledger entries for what was there before the ledger."""

_RECORDS = (SETTINGS, LEDGER, LEDGER_HEAD)


def is_of_ros2(root: Path | Keystore) -> bool:
    """Return whether ros2/sros2 made a keystore, and sros has written nothing to it yet.

    It has neither settings nor a ledger, and its CA has no key identifier, which sros gives to
    every CA that it makes: a keystore of sros is not taken for one of ros2/sros2 because somebody
    removed the records of what was taken away.
    """
    keystore = as_keystore(root)
    if any(os.path.lexists(keystore.root / name) for name in _RECORDS):
        return False
    try:
        authority = keystore.ca_certificate(IDENTITY)
        authority.extensions.get_extension_for_class(x509.SubjectKeyIdentifier)
    except x509.ExtensionNotFound:
        return True
    except (SrosError, OSError, ValueError):
        return False
    return False


def take_over(
    transaction: Transaction, keystore: Keystore, now: datetime, entries: Iterable[Entry]
) -> list[Entry]:
    """Return ``entries``, after those of what ros2/sros2 left in a keystore; stage its settings.

    Only certificates and permissions that the CAs of the keystore signed are recorded.  For a
    keystore of sros, the entries are returned as they are.
    """
    added = list(entries)
    if not is_of_ros2(keystore):
        return added
    before = list(_present(keystore, transaction.enclaves, now))
    transaction.adopt()
    if not any(each.what == "settings" for each in added):
        before += _settings(transaction, keystore, now)
    return [*before, *added]


def _present(keystore: Keystore, names: Iterable[str], now: datetime) -> Iterator[Entry]:
    from sros_tool.keystore.ledger import certificate_entry, document_entry

    authorities = dict.fromkeys(keystore.ca_certificate(role) for role in ROLES)
    for authority in authorities:
        yield certificate_entry(now, "ca", authority, reason=_ADOPTED)
    with suppress(SrosError):  # a missing one is reported by the verb
        message = keystore.read(GOVERNANCE_P7S, "governance document")
        yield replace(document_entry(now, "governance", message), reason=_ADOPTED)
    for name in names:
        state = keystore.enclave(name, now=now)
        files = {problem.file for problem in state.problems_at_home}
        if state.certificate and "cert.pem" not in files:
            yield certificate_entry(now, "certificate", state.certificate, name, _ADOPTED)
        message = state.files.get(PERMISSIONS_FILE, b"")
        if message and state.permissions_document and PERMISSIONS_FILE not in files:
            entry = document_entry(now, "permissions", message, enclave=name)
            yield replace(entry, reason=_ADOPTED)


def _settings(transaction: Transaction, keystore: Keystore, now: datetime) -> Iterator[Entry]:
    present = present_settings(keystore)
    if protection_for(present.governance):  # else settings would say another protection
        yield write_settings(transaction, present.settings, now)
