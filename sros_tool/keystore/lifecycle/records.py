"""Taking the rights on trust that only lines of the ledger from before its chain vouch for."""

from __future__ import annotations

import hashlib
from dataclasses import replace
from datetime import datetime
from pathlib import Path
from shlex import quote

from sros_tool.errors import KeystoreError, Note
from sros_tool.keystore.authorities.authority import load_authorities
from sros_tool.keystore.authorities.keyring import IN_KEYSTORE, Keyring
from sros_tool.keystore.layout import PERMISSIONS_FILE, enclave_path
from sros_tool.keystore.ledger import append, read_ledger
from sros_tool.keystore.lifecycle.update import KeystoreUpdate
from sros_tool.keystore.reader import load_settings, open_enclave
from sros_tool.keystore.recorded import RecordedRights
from sros_tool.keystore.transaction.transaction import Transaction
from sros_tool.validity import iso


def trust_records(
    root: Path, *, now: datetime, keyring: Keyring = IN_KEYSTORE, dry_run: bool = False
) -> KeystoreUpdate:
    """Record the permissions of enclaves again that version 0.1 of sros recorded without a chain.

    Only permissions are recorded that are the last ones of their enclave in the ledger, and that
    the permissions CA signed.  Where others are there, nothing is written.

    Raises:
        KeystoreError: the ledger is damaged, or no enclave needs it, or permissions are not the
            last ones that the ledger has.
    """
    with Transaction(root, dry_run=dry_run) as transaction:
        ledger = read_ledger(root)
        if ledger.gaps:
            raise KeystoreError(
                f"the ledger of '{root}' is damaged: {ledger.gaps[0]}",
                "Lines that were changed or removed are not taken on trust.",
                f"See `sros check {quote(str(root))}`.",
            )
        last = RecordedRights(root, ledger).unproven()
        names = [name for name in transaction.enclaves if name in last]
        if not names:
            raise KeystoreError(f"no enclave of '{root}' has rights to take on trust")
        entries, others = [], []
        for name in names:
            state = open_enclave(enclave_path(root, name), now=now)
            message = state.files.get(PERMISSIONS_FILE, b"")
            if state.grant and hashlib.sha256(message).hexdigest() == last[name].sha256:
                entries.append(
                    replace(last[name], time=iso(now), reason="taken on trust", previous="")
                )
            else:
                others.append(name)
        if others:
            raise KeystoreError(
                f"the permissions of {', '.join(others)} are not the last ones in the ledger",
                "Perhaps older ones were put back, with rights that were taken away since.",
                f"State their rights with `sros create_permission {quote(str(root))} "
                f"{' '.join(map(quote, others))} POLICY_FILE`, and try again.",
            )
        settings = load_settings(root)
        authority = load_authorities(root, settings, keyring, now).identity
        append(transaction, entries, authority, now)
        transaction.commit()
    number = "1 enclave" if len(names) == 1 else f"{len(names)} enclaves"
    text = (
        f"taken on trust: the rights of {number}, as the ledger has them in lines "
        "without a chain. If somebody removed one of these lines, older permissions may be in "
        "force again: compare them with your policy (`sros diff_policy`)."
    )
    return KeystoreUpdate(
        *(root, settings.name, settings.name),
        *((), (), (), (), (), ()),
        None,
        0,
        (),
        (Note("keystore.taken-on-trust", text),),
        transaction.changes,
    )
