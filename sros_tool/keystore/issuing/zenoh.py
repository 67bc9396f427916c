"""Update the Zenoh configurations of a keystore whenever its signed permissions change.

Every change of a keystore that has a Zenoh network calls `keep_zenoh` in its transaction, so DDS
and Zenoh enforce the same rights at any moment.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from datetime import datetime

from cryptography import x509

from sros_tool.dds.domains import DomainSet
from sros_tool.errors import Note
from sros_tool.keystore.issuing.authority import Authority
from sros_tool.keystore.ledger import Ledger
from sros_tool.keystore.outcomes import KeptZenoh
from sros_tool.keystore.reader import Keystore
from sros_tool.keystore.transaction.transaction import Transaction
from sros_tool.keystore.zenoh_files import (
    NO_CHANGE,
    Drift,
    Drifted,
    ZenohChange,
    drifted,
    signed_path,
    stale_files,
    zenoh_documents,
)
from sros_tool.validity import iso
from sros_tool.zenoh.configuration import ZenohNetwork


def keep_zenoh(
    transaction: Transaction,
    *,
    keystore: Keystore,
    network: ZenohNetwork,
    domains: DomainSet,
    authority: x509.Certificate,
    signer: Callable[[], Authority],
    now: datetime,
    change: ZenohChange = NO_CHANGE,
) -> KeptZenoh:
    """Stage the Zenoh configurations that the keystore needs after a change.

    Args:
        transaction: the transaction, before its commit.
        keystore: the keystore, as it was opened for the change.
        network: the Zenoh network of the keystore's settings.
        domains: the ROS domains of the keystore's governance.
        authority: the permissions CA that signed what the keystore has.
        signer: returns the permissions CA; called only if a configuration has to be signed.
        now: the current time.
        change: what the transaction changes.

    Raises:
        PolicyError: an enclave's rights cannot be stated to Zenoh.
        KeystoreError: the enclave of the router is missing.
    """
    existing = transaction.enclaves
    wanted = zenoh_documents(keystore, network, domains, authority, now, change, existing=existing)
    drifts = drifted(keystore, wanted, authority, change.gone)
    for drift in drifts:
        if drift.kind is Drift.STALE:
            _remove(transaction, drift.path)
    changed = [drift for drift in drifts if drift.kind is not Drift.STALE]
    written = _stage(transaction, wanted.files, changed, signer()) if changed else {}
    names = tuple(wanted.enclaves.values())
    return KeptZenoh(
        {name: path for path, name in wanted.enclaves.items()},
        wanted.nodes,
        {name: why.rstrip(".") for name, why in wanted.left_out.items()},
        written,
        tuple(sorted({drift.enclave for drift in drifts if drift.kind is not Drift.UNSIGNED})),
        (
            *_left_out_notes(wanted.left_out),
            *_revoked_names(wanted.ledger, names, now, change.replaced),
        ),
    )


def _stage(
    transaction: Transaction,
    files: Mapping[str, bytes],
    changed: Sequence[Drifted],
    authority: Authority,
) -> dict[str, bytes]:
    """Stage changed configurations and their signed documents on all cores; map them to content."""

    def stage(part: Sequence[Drifted]) -> list[bytes]:
        documents = [files[drift.path] for drift in part]
        messages = [b""] * len(part)
        if not transaction.dry_run:
            messages = authority.sign_all(documents, "a Zenoh configuration")
        for drift, document, message in zip(part, documents, messages, strict=True):
            if drift.kind is not Drift.UNSIGNED:
                transaction.write(drift.path, document)
            transaction.write(signed_path(drift.path), message)
        return messages

    written: dict[str, bytes] = {}
    for part, signed in transaction.on_all_cores(changed, stage, alone=authority.on_token):
        for drift, message in zip(part, signed, strict=True):
            if drift.kind is not Drift.UNSIGNED:
                written[drift.path] = files[drift.path]
            written[signed_path(drift.path)] = message
    return written


def remove_zenoh(transaction: Transaction) -> tuple[str, ...]:
    """Stage the removal of all configurations of a keystore; return their enclaves."""
    stale = list(stale_files(transaction.root, (), transaction.enclaves))
    for drift in stale:
        _remove(transaction, drift.path)
    return tuple(dict.fromkeys(drift.enclave for drift in stale))


def _remove(transaction: Transaction, path: str) -> None:
    for file in (path, signed_path(path)):
        if (transaction.root / file).is_file():
            transaction.remove(file)


# ── notes ──────────────────────────────────────────────────────────────────────────────────


def _left_out_notes(left_out: Mapping[str, str]) -> Iterable[Note]:
    for name, why in left_out.items():
        yield Note(
            "zenoh.left-out",
            f"{name} gets no configuration for Zenoh, and all others deny it everything there: "
            f"{why}.".replace("..", "."),
        )


def _revoked_names(
    ledger: Ledger, names: Sequence[str], now: datetime, replaced: Collection[str]
) -> Iterable[Note]:
    """Yield a note on enclave names that revoked certificates also have, until these expire."""
    entries = ledger.entries
    revoked = {entry.serial for entry in entries if entry.what == "revocation"}
    again = sorted(
        {
            entry.enclave
            for entry in entries
            if entry.what == "certificate"
            and entry.serial in revoked
            and entry.enclave in names
            and entry.not_after >= iso(now)
        }
        | {*replaced}
    )
    if again:
        yield Note(
            "zenoh.revoked-name",
            f"a revoked certificate of {', '.join(again)} has not expired: Zenoh has no revocation "
            "list, so anyone who has the certificate gets the rights of that enclave. Give the "
            "enclave another name, or replace the identity CA with `sros rotate_ca`.",
        )
