"""Renewal of enclaves: new certificates, and the same permissions signed again."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path

from sros_tool.errors import KeystoreError, Note, SrosError
from sros_tool.keystore.authorities.authority import Authorities, load_authorities
from sros_tool.keystore.authorities.keyring import IN_KEYSTORE, Keyring
from sros_tool.keystore.expiry import (
    Credentials,
    Threshold,
    UnreadableEnclave,
    read_credentials,
    refuse_unreadable,
)
from sros_tool.keystore.issuing.enclave import (
    EnclaveWriter,
    Issuance,
    NewIdentity,
    RecordedRights,
)
from sros_tool.keystore.known_keys import KnownKeys
from sros_tool.keystore.layout import (
    KEY_FILE,
    check_keystore,
    enclave_path,
    has_enclave,
    list_enclaves,
)
from sros_tool.keystore.ledger import Entry, append, certificate_entry, read_ledger
from sros_tool.keystore.lifecycle.revocation_list import RevocationListSigner
from sros_tool.keystore.lifecycle.revoke import (
    link_everywhere,
    remarks_on_lack,
    revocation_entry,
    still_valid,
)
from sros_tool.keystore.missing import no_such_enclave
from sros_tool.keystore.reader import load_settings
from sros_tool.keystore.template import Template
from sros_tool.keystore.transaction.recovery import tidy
from sros_tool.keystore.transaction.stage import Change
from sros_tool.keystore.transaction.transaction import Transaction
from sros_tool.names import check_enclave_name
from sros_tool.parallel import Progress
from sros_tool.pki.certificates import enclave_subject, issued_by, subject_text, validity_of
from sros_tool.pki.crl import SUPERSEDED, Revoked
from sros_tool.pki.keys import PrivateKey, PublicKey, generate_key
from sros_tool.pki.requests import key_digest


@dataclass(frozen=True, slots=True)
class Renewal:
    """The result of a renewal; with ``dry_run``, the result it would have.

    ``works_until`` is the latest expiry of the replaced certificates, or None if they have expired
    or were revoked.  ``revoked`` is the number of revoked certificates.  ``restart`` are the
    enclaves whose processes trust the revoked certificates until they are restarted.  ``remarks``
    are notes about open tasks.
    """

    root: Path
    renewed: tuple[str, ...]
    changes: tuple[Change, ...]
    notes: tuple[Note, ...] = ()
    works_until: datetime | None = None
    revoked: int = 0
    restart: tuple[str, ...] = ()
    remarks: tuple[Note, ...] = ()


@dataclass(frozen=True, slots=True)
class _Replaced:
    """A certificate that was replaced, and the digest of the key of the new certificate."""

    name: str
    old: Entry
    not_after: datetime
    new_key: str


def renew(
    root: Path,
    names: Sequence[str] = (),
    *,
    now: datetime,
    expiring: Threshold | None = None,
    new_key: bool = False,
    revoke_old: bool = False,
    keyring: Keyring = IN_KEYSTORE,
    dry_run: bool = False,
    progress: Progress | None = None,
) -> Renewal:
    """Renew the named enclaves, and all that are due by ``expiring``; all or nothing.

    The new certificate is for the same key, or with ``new_key`` for a new key; the signed rights do
    not change.  All files are replaced at once.  A replaced certificate works for anyone who
    has its key until it expires or is revoked; ``revoke_old`` revokes all earlier certificates of
    the renewed enclaves.

    Raises:
        KeystoreError: enclaves cannot be renewed; the error names all of them.
    """
    if not dry_run:
        tidy(root)
    check_keystore(root)
    for name in names:
        if not has_enclave(root, check_enclave_name(name)):
            raise no_such_enclave(root, name, list_enclaves(root))
    with Transaction(root, dry_run=dry_run) as transaction:
        template = load_settings(root)
        authorities = load_authorities(root, template, keyring, now)
        writer = EnclaveWriter(
            transaction,
            template,
            now,
            identity=authorities.identity,
            permissions=authorities.permissions,
        )
        known = KnownKeys(root)
        renewer = _Renewer(
            transaction, writer, authorities, template, now, known=known, new_key=new_key
        )
        existing = list_enclaves(root) if expiring or revoke_old else ()
        thresholds: dict[str, Threshold | None] = dict.fromkeys(names)
        if expiring is not None:
            thresholds |= {name: expiring for name in existing if name not in thresholds}

        def renew_one(name: str) -> _Replaced | UnreadableEnclave | None:
            return renewer.renew_if_due(name, thresholds[name])

        done = writer.for_each(list(thresholds), renew_one, progress)
        refuse_unreadable(
            tuple(each for each in done.values() if isinstance(each, UnreadableEnclave)), "renewed"
        )
        replaced = [each for each in done.values() if isinstance(each, _Replaced)]
        renewed = tuple(each.name for each in replaced)
        notes = writer.notes if replaced else ()
        if not new_key:
            notes += tuple(known.shared_notes(renewed))
        valid = [each for each in replaced if each.not_after >= now]
        entries, lists, count = writer.entries, None, 0
        if revoke_old and replaced:
            ledger = read_ledger(root)
            lists = RevocationListSigner(
                transaction, authorities.identity, template, keyring, ledger, now
            )
            revocations = _superseded(root, replaced, ledger.entries, lists, now)
            present = {int(each.old.serial, 16): each.name for each in replaced}
            lists.remarks += remarks_on_lack(root, ledger, present)
            count = len(revocations)
            date = now.replace(microsecond=0)
            new_entries = [Revoked(int(each.serial, 16), date, SUPERSEDED) for each in revocations]
            _, signed = lists.sign(new_entries, existing, incomplete=False)
            entries += [*revocations, *signed]
            link_everywhere(transaction, existing)
        append(transaction, entries, authorities.identity, now)
        transaction.commit()
    return Renewal(
        root,
        renewed,
        tuple(transaction.changes),
        notes,
        max((each.not_after for each in valid), default=None) if lists is None else None,
        count,
        existing if lists else (),
        tuple(lists.remarks) if lists else (),
    )


def _superseded(
    root: Path,
    replaced: Sequence[_Replaced],
    ledger: Sequence[Entry],
    lists: RevocationListSigner,
    now: datetime,
) -> list[Entry]:
    """Return the ledger entries for revoking all earlier certificates that have not expired."""
    listed = {each.serial for each in lists.present.revoked} if lists.present else set()
    known = still_valid(root, ledger, [each.name for each in replaced], now)
    found = []
    for each in replaced:
        # The ledger lacks certificates that ros2/sros2 issued.
        valid = known[each.name]
        if each.not_after >= now:
            valid[int(each.old.serial, 16)] = each.old
        found += [
            revocation_entry(one, now, SUPERSEDED, key="" if one.key == each.new_key else one.key)
            for serial, one in valid.items()
            if serial not in listed
        ]
    return found


class _Renewer:
    """Renewer of single enclaves, for `EnclaveWriter.for_each`."""

    def __init__(
        self,
        transaction: Transaction,
        writer: EnclaveWriter,
        authorities: Authorities,
        template: Template,
        now: datetime,
        *,
        known: KnownKeys,
        new_key: bool,
    ) -> None:
        self._root = transaction.root
        self._writer = writer
        self._authorities = authorities
        self._template = template
        self._now = now
        self._known = known
        self._new_key = new_key
        self._recorded = RecordedRights(transaction.root)

    def renew_if_due(
        self, name: str, threshold: Threshold | None
    ) -> _Replaced | UnreadableEnclave | None:
        """Renew an enclave and return the replaced certificate; None if it is not due.

        Without ``threshold`` it is always due.  If its files cannot be read, return that error.
        """
        try:
            state = read_credentials(self._root, name)
            if threshold and not state.lifetime().due(threshold, self._now):
                return None
            issued = self._writer.write(self._issuance(state))
        except SrosError as error:
            return UnreadableEnclave(name, error)
        old = state.certificate
        entry = certificate_entry(self._now, "certificate", old, name)
        new_key = key_digest(issued.certificate.public_key())  # type: ignore[arg-type]
        return _Replaced(name, entry, validity_of(old).not_after, new_key)

    def _issuance(self, state: Credentials) -> Issuance:
        """Verify the files of an enclave, and return what to issue in their place."""
        name = state.name
        if not issued_by(state.certificate, self._authorities.identity.certificate):
            raise KeystoreError(
                f"the certificate of enclave {name} was not issued by the identity CA of this "
                "keystore",
                f"It names the issuer {subject_text(state.certificate.issuer)}.",
                "Restore the certificate, or remove the enclave's folder and create it again.",
            )
        state.signed.verify(self._authorities.permissions.certificate)
        rights = self._recorded.of(name, state.digest, state.grant)
        subject = enclave_subject(name, unique=self._template.unique_subject)
        if self._new_key:
            key = self._generate_key(name)
            identity = NewIdentity(subject, key.public_key(), key)
        else:
            public: PublicKey = state.certificate.public_key()  # type: ignore[assignment]
            remedy = f"Give it another key with `sros renew {self._root} {name} --new-key`."
            self._known.refuse_revoked(public, f"enclave {name}", remedy, state.certificate)
            identity = NewIdentity(subject, public)
        return Issuance(name, identity, rights)

    def _generate_key(self, name: str) -> PrivateKey:
        if not (enclave_path(self._root, name) / KEY_FILE).exists():
            raise KeystoreError(
                f"the key of enclave {name} is not in this keystore",
                "It was generated on the robot and stays there, so no new key is generated here.",
                "Create a new request on the robot with `sros create_request`, and sign it here "
                "with `sros sign_request --renew`.",
            )
        return generate_key()
