"""Renewal of enclaves: new certificates, and the same permissions signed again."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from shlex import quote

from sros_tool.dds.decision.vendors import Vendor
from sros_tool.errors import KeystoreError, Note, SrosError, UsageError
from sros_tool.keystore.authorities.authority import Authorities, load_authorities
from sros_tool.keystore.authorities.keyring import IN_KEYSTORE, Keyring
from sros_tool.keystore.expiry import (
    Credentials,
    Threshold,
    UnreadableEnclave,
    read_credentials,
    refuse_unreadable,
)
from sros_tool.keystore.issuing.acceptance import refuse_stopping
from sros_tool.keystore.issuing.enclave import (
    EnclaveWriter,
    Issuance,
    NewIdentity,
)
from sros_tool.keystore.issuing.tokens import EnclaveTokens, token_notes, token_places
from sros_tool.keystore.issuing.zenoh import KeptZenoh, keep_zenoh
from sros_tool.keystore.known_keys import KnownKeys
from sros_tool.keystore.layout import (
    KEY_URI_FILE,
    check_keystore,
    enclave_path,
    has_enclave,
    has_key,
    list_enclaves,
)
from sros_tool.keystore.ledger import append
from sros_tool.keystore.lifecycle.revoke import Superseded, another_ca, revoke_superseded
from sros_tool.keystore.missing import no_such_enclave
from sros_tool.keystore.reader import governance_of, load_settings
from sros_tool.keystore.recorded import EarlierRights, RecordedRights
from sros_tool.keystore.settings import edit_notes
from sros_tool.keystore.transaction.recovery import tidy
from sros_tool.keystore.transaction.stage import Change
from sros_tool.keystore.transaction.transaction import Transaction
from sros_tool.keystore.zenoh.wanted import ZenohChange
from sros_tool.names import check_enclave_name
from sros_tool.parallel import Progress
from sros_tool.pki.certificates import (
    enclave_subject,
    has_unique_part,
    issued_by,
    other_issuer,
)
from sros_tool.pki.keys import PrivateKey, PublicKey, generate_key
from sros_tool.validity import duration_text, iso


@dataclass(frozen=True, slots=True)
class Renewal:
    """The result of a renewal; with ``dry_run``, the result it would have.

    ``works_until`` is the latest expiry of the replaced certificates, or None if they have expired
    or were revoked.  ``revoked`` is the number of revoked certificates.  ``restart`` are the
    enclaves whose processes trust the revoked certificates until they are restarted.  ``remarks``
    are notes about open tasks, ``zenoh`` are the configurations for Zenoh.
    """

    root: Path
    renewed: tuple[str, ...]
    changes: Sequence[Change]
    notes: tuple[Note, ...] = ()
    works_until: datetime | None = None
    revoked: int = 0
    restart: tuple[str, ...] = ()
    remarks: tuple[Note, ...] = ()
    zenoh: KeptZenoh = KeptZenoh()  # noqa: RUF009 - frozen


def renew(
    root: Path,
    names: Sequence[str] = (),
    *,
    now: datetime,
    expiring: Threshold | None = None,
    new_key: bool = False,
    key: str = "",
    revoke_old: bool = False,
    allow_refusal: Sequence[Vendor] = (),
    keyring: Keyring = IN_KEYSTORE,
    dry_run: bool = False,
    progress: Progress | None = None,
) -> Renewal:
    """Renew the named enclaves, and all that are due by ``expiring``; all or nothing.

    The new certificate is for the same key, or with ``new_key`` for a new key, or for the one on a
    token that ``key`` names, as in `create_enclaves`; the signed rights do not change.  All files
    are replaced at once.  A replaced certificate works for anyone who has its key until it expires
    or is revoked; ``revoke_old`` revokes all earlier certificates of the renewed enclaves, and
    gives them subjects that no earlier permissions fit.  On the vendors in ``allow_refusal``, nodes
    may stop.

    Raises:
        KeystoreError: enclaves cannot be renewed, and the error names all of them; or vendors would
            refuse enclaves that they accept today.
    """
    if key and (expiring or new_key):
        raise UsageError(
            "--key takes the names of its enclaves, and excludes --new-key",
            "It gives the named enclaves new keys on a token.",
            "Name the enclaves, and leave the other options out.",
        )
    places = token_places(key, names) if key else {}
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
            keys_on_token=bool(places),
        )
        known = KnownKeys(root)
        renewer = _Renewer(
            transaction,
            writer,
            authorities,
            now,
            known=known,
            new_key=new_key,
            on_token=EnclaveTokens(places, keyring.secrets, known, authorities, dry_run),
            unique=template.unique_subject or revoke_old,
        )
        existing = list_enclaves(root) if expiring or revoke_old else ()
        thresholds: dict[str, Threshold | None] = dict.fromkeys(names)
        if expiring is not None:
            # A short-lived enclave, such as a person's, ends unless somebody renews it by its name.
            chosen = (each for each in existing if template.longest_validity(each) is None)
            thresholds |= {name: expiring for name in chosen if name not in thresholds}

        def renew_one(name: str) -> Superseded | UnreadableEnclave | None:
            return renewer.renew_if_due(name, thresholds[name])

        done = writer.for_each(list(thresholds), renew_one, progress)
        refuse_unreadable(
            tuple(each for each in done.values() if isinstance(each, UnreadableEnclave)), "renewed"
        )
        replaced = [each for each in done.values() if isinstance(each, Superseded)]
        renewed = tuple(each.name for each in replaced)
        notes = (*writer.notes, *renewer.notes) if replaced else ()
        left = writer.expiry - now
        if replaced and expiring and expiring.remaining and left <= expiring.remaining:
            text = f"what is renewed now expires within {duration_text(expiring.remaining)} again, "
            text += f"on {iso(writer.expiry)}, so that it is renewed each time: choose a shorter "
            notes += (Note("renew.due-again", f"{text}time, or a longer validity."),)
        with suppress(SrosError):  # its governance is not what is renewed
            notes += edit_notes(root, governance_of(root))
        if not (new_key or places):
            notes += tuple(known.shared_notes(renewed))
        valid = [each for each in replaced if each.not_after >= now]
        entries, revoked = writer.entries, None
        if revoke_old and replaced:
            revoked = revoke_superseded(
                transaction, replaced, authorities.identity, template, keyring, existing, now
            )
            entries += revoked.entries
        permissions = authorities.permissions
        kept = KeptZenoh()
        if replaced and template.zenoh:
            kept = keep_zenoh(
                transaction,
                template.zenoh,
                governance_of(root).domains().closed(),
                permissions.certificate,
                lambda: permissions,
                now,
                ZenohChange(writer.grants, replaced=renewed if revoked else ()),
            )
            notes += kept.notes
        append(transaction, entries, authorities.identity, now)
        notes += refuse_stopping(
            transaction,
            now,
            allowed=allow_refusal,
            remedy=another_ca(root, "renew with --revoke-old") if revoked else "",
        )
        transaction.commit()
    return Renewal(
        root,
        renewed,
        transaction.changes,
        notes,
        None if revoked else max((each.not_after for each in valid), default=None),
        revoked.count if revoked else 0,
        existing if revoked else kept.restart,
        revoked.remarks if revoked else (),
        kept,
    )


class _Renewer:
    """Renewer of single enclaves, for `EnclaveWriter.for_each`."""

    def __init__(
        self,
        transaction: Transaction,
        writer: EnclaveWriter,
        authorities: Authorities,
        now: datetime,
        *,
        known: KnownKeys,
        new_key: bool,
        on_token: EnclaveTokens,
        unique: bool,
    ) -> None:
        self.notes: list[Note] = []
        self._root = transaction.root
        self._writer = writer
        self._authorities = authorities
        self._now = now
        self._known = known
        self._new_key = new_key
        self._on_token = on_token
        self._unique = unique
        self._recorded = RecordedRights(transaction.root)

    def renew_if_due(
        self, name: str, threshold: Threshold | None
    ) -> Superseded | UnreadableEnclave | None:
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
        return Superseded.by(name, state.certificate, issued.certificate, self._now)

    def _issuance(self, state: Credentials) -> Issuance:
        """Verify the files of an enclave, and return what to issue in their place."""
        name = state.name
        rights = checked_rights(state, self._authorities, self._recorded)
        # Once earlier permissions were cut off by a unique subject, they stay cut off.
        unique = self._unique or has_unique_part(state.certificate.subject)
        subject = enclave_subject(name, unique=unique)
        if name in self._on_token.places:
            self._refuse_key_on_robot(name)
            made = self._on_token.key(name)
            self.notes += token_notes(made)
            identity = NewIdentity(subject, made.public_key(), made)
        elif self._new_key:
            key = self._generate_key(name)
            identity = NewIdentity(subject, key.public_key(), key)
        else:
            public: PublicKey = state.certificate.public_key()  # type: ignore[assignment]
            remedy = (
                f"Give it another key with `sros renew {quote(str(self._root))} {name} --new-key`."
            )
            self._known.refuse_revoked(public, f"enclave {name}", remedy, state.certificate)
            identity = NewIdentity(subject, public)
        return Issuance(name, identity, rights)

    def _generate_key(self, name: str) -> PrivateKey:
        folder = enclave_path(self._root, name)
        if (folder / KEY_URI_FILE).exists():
            raise KeystoreError(
                f"the key of enclave {name} is on a token",
                f"A new one in a file would not be used: its {KEY_URI_FILE} names the one there.",
                f"Make one on the token: `sros renew {quote(str(self._root))} {name} --key "
                "'pkcs11:token=NAME;object=LABEL'`, with a label that the token does not have.",
            )
        self._refuse_key_on_robot(name)
        return generate_key()

    def _refuse_key_on_robot(self, name: str) -> None:
        if not has_key(enclave_path(self._root, name)):
            raise KeystoreError(
                f"the key of enclave {name} is not in this keystore",
                "It was generated on the robot and stays there, so no new key is generated here.",
                "Create a new request on the robot with `sros create_request`, and sign it here "
                "with `sros sign_request --renew`.",
            )


def checked_rights(
    state: Credentials, authorities: Authorities, recorded: RecordedRights
) -> EarlierRights:
    """Return the rights of an enclave, after verifying its files, to sign them again.

    Raises:
        KeystoreError: the CAs of the keystore did not issue its certificate, or the permissions are
            not the last ones that the ledger has for it.
        PkiError: the permissions CA did not sign them.
    """
    authority = authorities.identity.certificate
    if not issued_by(state.certificate, authority):
        raise KeystoreError(
            f"the certificate of enclave {state.name} was not issued by the identity CA of this "
            "keystore",
            f"Its issuer is {other_issuer(state.certificate, authority)}.",
            "Restore the certificate, or remove the enclave's folder and create it again.",
        )
    state.signed.verify(authorities.permissions.certificate)
    return recorded.of(state.name, state.digest, state.grant)
