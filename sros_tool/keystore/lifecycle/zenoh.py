"""The Zenoh network of a keystore: it begins, changes and ends here.

Every other change of the keystore keeps its files in step (`sros_tool.keystore.issuing.zenoh`).
"""

from __future__ import annotations

import hashlib
from dataclasses import replace
from datetime import datetime
from pathlib import Path
from shlex import quote

from sros_tool.errors import KeystoreError, UsageError
from sros_tool.keystore.authorities.keyring import IN_KEYSTORE, Keyring
from sros_tool.keystore.issuing.enclave import default_rights
from sros_tool.keystore.issuing.zenoh import remove_zenoh
from sros_tool.keystore.layout import PERMISSIONS_FILE, SETTINGS, enclave_path
from sros_tool.keystore.lifecycle.change import KeystoreChange
from sros_tool.keystore.lifecycle.create import Creation, creation
from sros_tool.keystore.lifecycle.enclaves import write_enclaves
from sros_tool.keystore.settings import edit_remedy, found_edits, write_settings
from sros_tool.keystore.template import EVERYTHING, NODE_BASICS
from sros_tool.zenoh.configuration import ZenohNetwork


def set_zenoh(
    root: Path,
    network: ZenohNetwork | None,
    *,
    now: datetime,
    keyring: Keyring = IN_KEYSTORE,
    dry_run: bool = False,
) -> Creation:
    """Give a keystore a Zenoh network, or None: its settings, and the files of all enclaves.

    The enclave of the router is created if it does not exist.  Files that are as they should be,
    with a valid signature, stay as they are.

    Raises:
        KeystoreError: files of the keystore were edited by hand, or it has no settings.
        PolicyError: an enclave has rights that Zenoh cannot enforce.
        UsageError: the network is not for the domains of the keystore, or the router's enclave has
            rights of its own.
    """
    with KeystoreChange(root, now=now, keyring=keyring, dry_run=dry_run) as change:
        change.begin_issuing(None)
        _check_settings(change, edited=bool(change.notes))
        template = replace(change.template, zenoh=network)
        if network and network.router in change.names:
            _check_router(change, network.router)
        if template != change.template:
            change.template = template
            change.entries.append(write_settings(change.transaction, template, now))
        removed = () if network else remove_zenoh(change.transaction)
        write_enclaves(change, {})
    change.restart = removed or change.restart
    return creation(change, ())


def _check_settings(change: KeystoreChange, *, edited: bool) -> None:
    """Raise `KeystoreError` if the settings are missing, or files were ``edited`` by hand."""
    root, where = change.root, quote(str(change.root))
    if not (root / SETTINGS).exists():
        raise KeystoreError(
            f"keystore '{root}' has no settings, as ros2/sros2 makes it",
            "Nothing would keep the files of Zenoh in step.",
            f"Run `sros update_keystore {where} --template sros2 --dry-run`, which shows what "
            "settings change, and then without --dry-run.",
        )
    if edited:
        edits = found_edits(change.keystore, change.governance)
        raise KeystoreError(
            f"files of keystore '{root}' were edited by hand: {'; '.join(edits.clauses())}",
            "Writing the settings would undo it, or carry it out unseen.",
            f"First carry it out or undo it: {edit_remedy(root)}",
        )


def _check_router(change: KeystoreChange, router: str) -> None:
    """Raise `UsageError` if the enclave of the router has permissions that a policy gave it."""
    path = enclave_path(change.root, router) / PERMISSIONS_FILE
    if not path.exists():
        return
    digest = hashlib.sha256(change.keystore.read(path, "permissions document")).hexdigest()
    usual = {
        default_rights(replace(change.template, default_permissions=choice), router).digest
        for choice in (EVERYTHING, NODE_BASICS)
    }
    if change.recorded.policy(router, digest) not in ("", *usual):
        raise UsageError(
            f"the enclave {router} has rights of its own",
            "The router passes on what all others say, so it would have the rights of all there.",
            "Name an enclave of the router's own with --router.",
        )
