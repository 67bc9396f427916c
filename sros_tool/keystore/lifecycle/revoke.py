"""Revocation of enclaves: their certificates are put on the list, their files into ``revoked``."""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from shlex import quote

from cryptography import x509

from sros_tool.dds.decision.vendors import Vendor
from sros_tool.errors import KeystoreError, Note, UsageError
from sros_tool.keystore.authorities.authority import Authority, load_authority
from sros_tool.keystore.authorities.keyring import IN_KEYSTORE, Keyring
from sros_tool.keystore.issuing.acceptance import refuse_stopping
from sros_tool.keystore.issuing.zenoh import KeptZenoh, keep_zenoh
from sros_tool.keystore.layout import (
    CRL,
    IDENTITY,
    KEY_URI_FILE,
    OPTIONAL_FILES,
    PERMISSIONS,
    PRIVATE,
    REQUEST,
    REQUIRED_FILES,
    REVOKED,
    ZENOH_FILES,
    check_keystore,
    enclave_folder,
    list_enclaves,
)
from sros_tool.keystore.ledger import Entry, Ledger, append, certificate_entry, read_ledger
from sros_tool.keystore.lifecycle.revocation_list import RevocationListSigner, put_away
from sros_tool.keystore.lifecycle.rotation.state import RotationStage, read_rotation
from sros_tool.keystore.missing import no_such_enclave
from sros_tool.keystore.reader import (
    authority_files,
    governance_of,
    identity_file,
    load_ca_certificate,
    load_settings,
    read_certificate,
)
from sros_tool.keystore.template import Template
from sros_tool.keystore.transaction.recovery import tidy
from sros_tool.keystore.transaction.stage import Change
from sros_tool.keystore.transaction.transaction import Transaction
from sros_tool.keystore.zenoh.wanted import ZenohChange
from sros_tool.names import check_enclave_name
from sros_tool.pki.certificates import common_name_of, issued_by, validity_of
from sros_tool.pki.crl import REASONS, SUPERSEDED, Revoked
from sros_tool.pki.requests import key_digest
from sros_tool.validity import iso

_FILES = (
    *REQUIRED_FILES,
    KEY_URI_FILE,
    *OPTIONAL_FILES,
    *ZENOH_FILES,
    "permissions.xml",
    REQUEST,
)
_PRIVATE = "key.pem"


@dataclass(frozen=True, slots=True)
class Revocation:
    """The result of a revocation; with ``dry_run``, the result it would have.

    ``revoked`` are the revoked enclaves.  ``restart`` are the enclaves whose processes trust the
    revoked certificates until they are restarted.  ``next_update`` is the expiry of the revocation
    list, in UTC.  ``remarks`` are notes about open tasks, ``zenoh`` are the configurations for
    Zenoh.
    """

    root: Path
    revoked: tuple[str, ...]
    restart: tuple[str, ...]
    next_update: datetime
    changes: Sequence[Change]
    remarks: tuple[Note, ...] = ()
    zenoh: KeptZenoh = KeptZenoh()  # noqa: RUF009 - frozen


def revoke(
    root: Path,
    names: Sequence[str],
    *,
    now: datetime,
    reason: str = "unspecified",
    keyring: Keyring = IN_KEYSTORE,
    until_retired: bool = False,
    allow_refusal: Sequence[Vendor] = (),
    dry_run: bool = False,
) -> Revocation:
    """Revoke the certificates of enclaves and move their files to ``revoked`` in the keystore.

    All certificates of an enclave that have not expired are revoked, if its folder, the ledger or
    the folder ``revoked`` has them: an attacker with the key could use an earlier certificate, too.
    If the ledger may lack some, a remark says so.  The other enclaves get
    ``crl.pem``, a link to the list.  During a rotation of the identity CA, both CAs sign a list; if
    the key of the old CA is missing, ``until_retired`` accepts that Fast DDS trusts its
    certificates until it is retired.  On the vendors in ``allow_refusal``, nodes may stop.

    Raises:
        KeystoreError: an enclave does not exist, the identity CA did not issue its certificate, the
            key of a CA is missing, or vendors would refuse other enclaves with the list.
        UsageError: ``reason`` is not one of `REASONS`.
    """
    if reason not in REASONS:
        raise UsageError(
            f"unknown reason {reason!r} for a revocation", "", f"Choose {', '.join(REASONS)}."
        )
    if not dry_run:
        tidy(root)
    check_keystore(root)
    with Transaction(root, dry_run=dry_run) as transaction:
        existing = _check_names(root, names)
        template = load_settings(root)
        authority = load_authority(root, IDENTITY, template, keyring, now)
        ledger = read_ledger(root)
        issued = ledger.entries
        lists = RevocationListSigner(transaction, authority, template, keyring, ledger, now)
        listed = {each.serial for each in lists.present.revoked} if lists.present else set()
        revoked: list[Revoked] = []
        entries: list[Entry] = []
        present: dict[int, str] = {}
        known = _still_valid(root, issued, names, now)
        for name, valid in known.items():
            last = _move_away(transaction, authority, name, now)
            present[int(last.serial, 16)] = name
            valid[int(last.serial, 16)] = last
            for serial, each in valid.items():
                if serial not in listed:
                    listed.add(serial)
                    revoked.append(Revoked(serial, now.replace(microsecond=0), reason))
                    entries.append(_revocation_entry(each, now, reason, key=each.key))
        gone = frozenset(names)
        remaining = tuple(name for name in existing if name not in gone)
        next_update, signed = lists.sign(revoked, remaining, incomplete=until_retired)
        entries += signed
        _link_everywhere(transaction, remaining)
        kept = KeptZenoh()
        if template.zenoh:
            kept = keep_zenoh(
                transaction,
                template.zenoh,
                governance_of(root).domains().closed(),
                load_ca_certificate(root, PERMISSIONS),
                lambda: load_authority(root, PERMISSIONS, template, keyring, now),
                now,
                ZenohChange(gone=gone),
            )
        append(transaction, entries, authority, now)
        stopped = refuse_stopping(
            transaction, now, allowed=allow_refusal, remedy=another_ca(root, "revoke")
        )
        transaction.commit()
    return Revocation(
        root,
        tuple(dict.fromkeys(names)),
        remaining,
        next_update,
        transaction.changes,
        (*lists.remarks, *_remarks_on_lack(root, ledger, present), *kept.notes, *stopped),
        kept,
    )


def refresh_crl(
    root: Path,
    *,
    now: datetime,
    keyring: Keyring = IN_KEYSTORE,
    allow_refusal: Sequence[Vendor] = (),
    dry_run: bool = False,
) -> Revocation:
    """Sign the revocation list again, so that it is valid for longer.

    Its entries are kept, except certificates that had expired before the present list was signed.
    """
    if not dry_run:
        tidy(root)
    list_enclaves(root)
    with Transaction(root, dry_run=dry_run) as transaction:
        existing = list_enclaves(root)
        template = load_settings(root)
        authority = load_authority(root, IDENTITY, template, keyring, now)
        lists = RevocationListSigner(
            transaction, authority, template, keyring, read_ledger(root), now
        )
        next_update, entries = lists.sign((), existing, incomplete=True)
        _link_everywhere(transaction, existing)
        append(transaction, entries, authority, now)
        stopped = refuse_stopping(
            transaction, now, allowed=allow_refusal, remedy=another_ca(root, "sign the list")
        )
        transaction.commit()
    changes, remarks = transaction.changes, (*lists.remarks, *stopped)
    return Revocation(root, (), existing, next_update, changes, remarks)


def another_ca(root: Path, aim: str) -> str:
    """Return what to do where DDS refuses the lists of the identity CA, before the ``aim``."""
    file = identity_file(root)
    words = ["sros rotate_ca", quote(str(root))]
    if read_rotation(root).stage is not RotationStage.NONE:
        return (
            f"First retire the old CA: `{' '.join(words)} --finish`, restart all processes, and "
            f"{aim} then."
        )
    if len(authority_files(root)) > 1:
        words.append("--identity")
    if not (root / f"{PRIVATE}/{file}.key.pem").exists():
        words.append("--identity-key URI")
    return (
        f"Replace the identity CA by one that may sign revocation lists: `{' '.join(words)} "
        f"--finish`, restart all processes, and {aim} then."
    )


def _check_names(root: Path, names: Sequence[str]) -> tuple[str, ...]:
    """Return all enclaves of the keystore; raise if one of ``names`` does not exist."""
    existing = list_enclaves(root)
    there = frozenset(existing)
    for name in names:
        check_enclave_name(name)
        if name not in there:
            raise no_such_enclave(root, name, existing, may_create=False)
    return existing


def _still_valid(
    root: Path, issued: Iterable[Entry], names: Iterable[str], now: datetime
) -> dict[str, dict[int, Entry]]:
    """Map each of the enclaves ``names`` to its earlier certificates that have not expired.

    They are serial numbers with entries, from the ledger (``issued``) and from the files in
    ``revoked``: a list that was lost no longer has those.
    """
    found: dict[str, dict[int, Entry]] = {name: {} for name in names}
    moment = iso(now)
    for each in issued:
        expired = each.not_after and each.not_after < moment
        if each.what == "certificate" and each.enclave in found and each.serial and not expired:
            found[each.enclave][int(each.serial, 16)] = each
    for certificate in put_away(root):
        name = common_name_of(certificate.subject)
        if name in found and validity_of(certificate).not_after >= now:
            entry = certificate_entry(now, "certificate", certificate, name)
            found[name][certificate.serial_number] = entry
    return found


def _remarks_on_lack(root: Path, ledger: Ledger, present: Mapping[int, str]) -> tuple[Note, ...]:
    """Return a remark if the ledger may lack earlier certificates of revoked enclaves.

    ``present`` maps the serial numbers of their last certificates to their names.
    """
    why = list(ledger.gaps)
    if ledger.unchained:
        why.append(f"nothing shows whether a line was removed from its first {ledger.unchained}")
    recorded = {int(each.serial, 16) for each in ledger.entries if each.serial}
    if unknown := sorted(name for serial, name in present.items() if serial not in recorded):
        why.append(f"it does not have the present certificate of {', '.join(unknown)}")
    if not why:
        return ()
    text = (
        f"The ledger of '{root}' may lack earlier certificates: {'; '.join(why)}. Those that it "
        "lacks stay valid until they expire or their CA is replaced: see `sros rotate_ca`."
    )
    return (Note("ledger.may-lack-certificates", text),)


def _revocation_entry(certificate: Entry, now: datetime, reason: str, *, key: str) -> Entry:
    """Return the entry of a revocation; ``key`` is the digest of the revoked key, or ""."""
    return Entry(
        iso(now),
        "revocation",
        certificate.enclave,
        certificate.subject,
        certificate.serial,
        reason=reason,
        key=key,
    )


@dataclass(frozen=True, slots=True)
class Superseded:
    """A certificate that was replaced, and the digest of the key of the new certificate."""

    name: str
    old: Entry
    not_after: datetime
    new_key: str

    @classmethod
    def by(
        cls, name: str, old: x509.Certificate, new: x509.Certificate, now: datetime
    ) -> Superseded:
        """Return the record that ``new`` replaced ``old`` at ``now``."""
        entry = certificate_entry(now, "certificate", old, name)
        key = key_digest(new.public_key())  # type: ignore[arg-type]
        return cls(name, entry, validity_of(old).not_after, key)


@dataclass(frozen=True, slots=True)
class SupersededRevocation:
    """The revocation of replaced certificates: ledger entries, their number, and remarks."""

    entries: tuple[Entry, ...]
    count: int
    remarks: tuple[Note, ...]


def revoke_superseded(
    transaction: Transaction,
    replaced: Sequence[Superseded],
    authority: Authority,
    template: Template,
    keyring: Keyring,
    existing: Sequence[str],
    now: datetime,
) -> SupersededRevocation:
    """Stage the revocation of all certificates that the enclaves of ``replaced`` had before.

    ``authority`` is the identity CA; ``existing`` are all enclaves of the keystore, which get the
    list.
    """
    root = transaction.root
    ledger = read_ledger(root)
    lists = RevocationListSigner(transaction, authority, template, keyring, ledger, now)
    revocations = _superseded(root, replaced, ledger.entries, lists, now)
    present = {int(each.old.serial, 16): each.name for each in replaced}
    date = now.replace(microsecond=0)
    new_entries = [Revoked(int(each.serial, 16), date, SUPERSEDED) for each in revocations]
    _, signed = lists.sign(new_entries, existing, incomplete=False)
    _link_everywhere(transaction, existing)
    remarks = (*lists.remarks, *_remarks_on_lack(root, ledger, present))
    return SupersededRevocation((*revocations, *signed), len(revocations), remarks)


def _superseded(
    root: Path,
    replaced: Sequence[Superseded],
    ledger: Sequence[Entry],
    lists: RevocationListSigner,
    now: datetime,
) -> list[Entry]:
    """Return the ledger entries for revoking all earlier certificates that have not expired."""
    listed = {each.serial for each in lists.present.revoked} if lists.present else set()
    known = _still_valid(root, ledger, [each.name for each in replaced], now)
    found = []
    for each in replaced:
        # The ledger lacks certificates that ros2/sros2 issued.
        valid = known[each.name]
        if each.not_after >= now:
            valid[int(each.old.serial, 16)] = each.old
        found += [
            _revocation_entry(one, now, SUPERSEDED, key="" if one.key == each.new_key else one.key)
            for serial, one in valid.items()
            if serial not in listed
        ]
    return found


def _move_away(transaction: Transaction, authority: Authority, name: str, now: datetime) -> Entry:
    """Stage the move of an enclave's files to ``revoked``; return the entry of its certificate."""
    folder = enclave_folder(name)
    path = transaction.root / folder / "cert.pem"
    certificate = read_certificate(path)
    if not issued_by(certificate, authority.certificate):
        raise KeystoreError(
            f"the certificate of enclave {name} was not issued by the identity CA of this keystore",
            "Only the CA that issued it can revoke it.",
            "Revoke it in the keystore of that CA, or restore the right certificate.",
        )
    target = f"{REVOKED}/{certificate.serial_number:x}"
    for file in _FILES:
        source = transaction.root / folder / file
        if name == "/" and file == "governance.p7s":
            continue  # the governance of the keystore is in the folder of the enclave /
        if not source.is_symlink() and not source.exists():
            continue
        if not source.is_symlink():
            data = transaction.read(f"{folder}/{file}")
            transaction.write(f"{target}/{file}", data, private=file == _PRIVATE)
        transaction.remove(f"{folder}/{file}")
    return certificate_entry(now, "certificate", certificate, name)


def _link_everywhere(transaction: Transaction, names: Sequence[str]) -> None:
    """Stage the link ``crl.pem`` to the revocation list for each enclave without it."""

    def link(part: Sequence[str]) -> None:
        for name in part:
            folder = enclave_folder(name)
            target = "../" * folder.count("/") + f"../{CRL}"
            # Some ways to copy a keystore replace the link by a file, which would never be updated.
            try:
                there = os.readlink(f"{transaction.root}/{folder}/crl.pem")  # noqa: PTH115 - fast
            except OSError:
                there = ""
            if there != target:
                transaction.link(f"{folder}/crl.pem", target)

    transaction.on_all_cores(names, link)
