"""Renewal of enclaves: new certificates, and the same permissions signed again."""

from __future__ import annotations

from collections.abc import Container, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from shlex import quote
from typing import Unpack

from sros_tool.errors import KeystoreError, Note, SrosError, UsageError
from sros_tool.fleet.robots import Fleet
from sros_tool.keystore.expiry import (
    Credentials,
    Threshold,
    UnreadableEnclave,
    enclaves_renewed_by_name,
    read_credentials,
    refuse_unreadable,
    survey,
)
from sros_tool.keystore.fleet import left_enclaves, revoke_command
from sros_tool.keystore.issuing.authority import Authorities
from sros_tool.keystore.issuing.ca_service import CaServiceError
from sros_tool.keystore.issuing.enclave import EnclaveTokens, EnclaveWriter, Issuance, NewIdentity
from sros_tool.keystore.known_keys import rights_of_backup_notes
from sros_tool.keystore.layout import KEY_URI_FILE, enclave_path, key_on_robot
from sros_tool.keystore.ledger import RENEWED_BY_NAME, RESTORED, Entry
from sros_tool.keystore.lifecycle.change import Changed, ChangeOptions, KeystoreChange
from sros_tool.keystore.lifecycle.replaced import (
    SupersededCertificate,
    certificates_until,
    may_lack_entries,
)
from sros_tool.keystore.reader import OpenedKeystore
from sros_tool.keystore.rights import RecordedRights, SignedRights
from sros_tool.keystore.selection import missing_enclave_error
from sros_tool.names import check_enclave_name
from sros_tool.parallel import Progress
from sros_tool.pki.certificates import (
    enclave_subject,
    has_unique_part,
    issued_by,
    other_issuer_text,
)
from sros_tool.pki.keys import PrivateKey, generate_key
from sros_tool.pki.token import token_notes, token_places
from sros_tool.validity import duration_text, iso
from sros_tool.wording import first_few

NOT_RENEWED = "renew.left-enclaves"
"""The id of the note on due enclaves that were not renewed, because their robot left the fleet."""


def renew(
    root: Path,
    names: Sequence[str] = (),
    *,
    expiring: Threshold | None = None,
    new_key: bool = False,
    key: str = "",
    revoke_old: bool = False,
    progress: Progress | None = None,
    **options: Unpack[ChangeOptions],
) -> Changed:
    """Renew the named enclaves, and the enclaves that are due by ``expiring``, all or nothing.

    The new certificate is for the same key. With ``new_key``, it is for a new key. With ``key``, it
    is for a key on a token; `create_enclaves` describes ``key``.  The signed rights do not change.
    All files are replaced in one step.  Whoever has the key can use a replaced certificate until
    this certificate or the last permissions for it expire, or until it is revoked.  With
    ``revoke_old``, all earlier certificates of the renewed enclaves are revoked, and the new ones
    get subjects that no earlier permissions fit.

    Raises:
        KeystoreError: enclaves cannot be renewed (the error names all of them), or vendors would
            refuse enclaves that they accept today.
    """
    if key and (expiring or new_key):
        raise UsageError(
            "--key needs the names of enclaves, and excludes --new-key and --all-expiring",
            "It gives the named enclaves new keys on a token.",
            "Name the enclaves, and leave out --new-key and --all-expiring.",
        )
    places = token_places(key, names) if key else {}
    change = KeystoreChange(root, **options)
    with change:
        for name in names:
            if not change.keystore.has_enclave(check_enclave_name(name)):
                raise missing_enclave_error(change.keystore, name, change.names)
        wanted = dict.fromkeys(names)
        if expiring is not None:
            others = [name for name in change.names if name not in wanted]
            short_lived = enclaves_renewed_by_name(change.keystore, change.template, others)
            fleet, problem = None, None
            try:
                fleet = change.fleet
            except SrosError as error:  # a fleet that is not known stops no other renewal
                problem = error
            left = left_enclaves(change.keystore, fleet or Fleet.of(()), change.now)
            due = [*_due_enclave_names(change, {*others}.difference(short_lived), expiring)]
            wanted |= dict.fromkeys(name for name in due if name not in left)
            if not_renewed := {name: left[name] for name in due if name in left}:
                change.notes.append(_left_note(change.keystore, not_renewed, problem))
            if short_lived:
                names_text = first_few(short_lived, 3)
                text = (
                    f"not renewed: {names_text} (enclaves in [[enclaves]] of sros.toml are "
                    "renewed only by name)"
                )
                change.notes.append(Note("renew.short-lived", text))
        if not wanted:  # then no CA key is opened
            # Raises an error for an export, which is never renewed.
            _ = change.keystore.authority_files
            change.notes += change.keystore.ledger_file.clock_notes(change.now)
            with suppress(SrosError):
                change.notes += change.edit_notes()
            return change.result(Changed)
        writer = change.writer(keys_on_token=bool(places), revoke_old=revoke_old)
        renewer = _Renewer(
            change,
            writer,
            new_key=new_key,
            tokens=change.tokens(places),
            unique=change.template.unique_subject or revoke_old,
        )
        replaced = renewer.renew(tuple(wanted), progress)
        renewed = tuple(certificate.name for certificate in replaced)
        change.notes += (*writer.notes, *renewer.notes) if replaced else ()
        remaining = writer.expiry - change.now
        if replaced and expiring and expiring.remaining and remaining <= expiring.remaining:
            text = (
                f"the new files expire within {duration_text(expiring.remaining)}, too (on "
                f"{iso(writer.expiry)}), so the same command would renew them every time: give "
                "--all-expiring a shorter time, or choose a longer validity."
            )
            change.notes.append(Note("renew.due-again", text))
        with suppress(SrosError):  # the governance is not part of a renewal
            change.notes += change.edit_notes()
        if not (new_key or places):
            change.notes += change.known.shared_key_notes(renewed)
        change.entries += _with_consent_marks(change, writer.entries, names)
        if revoke_old:
            change.revoke_superseded(replaced)
        if replaced:
            change.stage_zenoh(writer.signed, replaced=renewed if change.revoked else ())
        change.record()
        lasting = () if change.revoked else replaced
        until = certificates_until(change.keystore, lasting, change.template)
        may_work_longer = bool(lasting) and may_lack_entries(change.keystore)
        change.finish(command="renew with --revoke-old" if revoke_old else "")
    change.notes += rights_of_backup_notes(change.keystore, renewed)
    return change.result(
        Changed,
        outcomes=dict.fromkeys(renewed, "renewed"),
        works_until=until if until and until >= change.now else None,
        may_work_longer=may_work_longer,
    )


def _with_consent_marks(
    change: KeystoreChange, entries: Iterable[Entry], names: Sequence[str]
) -> Iterator[Entry]:
    """Yield ``entries``; until a restore is published, mark the permissions of ``names``.

    The mark says that the user named the enclave.  `sros fleet publish --restored` takes this as
    consent to rights that were taken away.
    """
    last = change.keystore.last_release
    is_waiting = any(entry.number > last for entry in change.keystore.entries_of(RESTORED))
    named = {*names} if is_waiting else set[str]()
    for entry in entries:
        is_named = entry.what == "permissions" and entry.enclave in named
        yield entry._replace(reason=RENEWED_BY_NAME) if is_named else entry


def _left_note(
    keystore: OpenedKeystore, left: Mapping[str, str], problem: SrosError | None
) -> Note:
    """Return the note on due enclaves of robots that left the fleet (as of `left_enclaves`).

    ``problem`` is the reason why it is not known whether these robots are in the fleet again.
    """
    text = (
        f"not renewed: {first_few([*left], 3)} (of robots that left the fleet or their "
        f"group: {first_few(sorted({*left.values()}), 3)}). "
    )
    if problem:
        text += f"It is not known whether these robots are back: {problem.what}. {problem.remedy}"
    else:
        text += (
            f"Revoke these enclaves, with {revoke_command(keystore, sorted(left))}; if a robot is "
            "to keep its enclaves, add it to the fleet file or the group again, and run "
            "`sros generate_artifacts`"
        )
    return Note(NOT_RENEWED, text)


def _due_enclave_names(
    change: KeystoreChange, names: Container[str], threshold: Threshold
) -> Iterator[str]:
    """Yield the enclaves among ``names`` that are due for renewal.

    Raises:
        KeystoreError: enclaves cannot be read; the error names all of them.
    """
    lifetimes, unreadable = survey(change.keystore)
    refuse_unreadable(tuple(enclave for enclave in unreadable if enclave.name in names), "renewed")
    for lifetime in lifetimes:
        if lifetime.name in names and lifetime.is_due(threshold, change.now):
            yield lifetime.name


@dataclass
class _Renewer:
    """Renews enclaves one at a time; ``notes`` are about their keys.

    With ``new_key``, enclaves get new keys; with ``unique``, subjects that no earlier permissions
    fit.
    """

    change: KeystoreChange
    writer: EnclaveWriter
    new_key: bool
    tokens: EnclaveTokens
    unique: bool
    notes: list[Note] = field(default_factory=list)

    def renew(self, names: Sequence[str], progress: Progress | None) -> list[SupersededCertificate]:
        """Renew the enclaves ``names``, and return the replaced certificates.

        Raises:
            KeystoreError: enclaves cannot be read; the error names all of them.
        """
        done = self.writer.for_each(names, self._renew_one, progress).values()
        unreadable = tuple(result for result in done if isinstance(result, UnreadableEnclave))
        refuse_unreadable(unreadable, "renewed")
        return [result for result in done if isinstance(result, SupersededCertificate)]

    def _renew_one(self, name: str) -> SupersededCertificate | UnreadableEnclave:
        now = self.change.now
        try:
            state = read_credentials(self.change.keystore, name)
            issued = self.writer.write(self._issuance(state))
        except CaServiceError:
            raise
        except SrosError as error:
            return UnreadableEnclave(name, error)
        return SupersededCertificate.record(name, state.certificate, issued.certificate, now)

    def _issuance(self, state: Credentials) -> Issuance:
        """Return the issuance for an enclave, after verifying the enclave's present files."""
        name = state.name
        rights = checked_rights(state, self.change.authorities, self.change.recorded_rights)
        # If a unique subject made earlier permissions useless, they must not become useful again.
        unique = self.unique or has_unique_part(state.certificate.subject)
        subject = enclave_subject(name, unique=unique)
        if name in self.tokens.places:
            self._refuse_key_on_robot(name)
            token_key = self.tokens.key(name)
            self.notes += token_notes(token_key)
            identity = NewIdentity(subject, token_key.public_key(), token_key)
        elif self.new_key:
            key = self._generate_key(name)
            identity = NewIdentity(subject, key.public_key(), key)
        else:
            identity = NewIdentity(subject, self.change.unrevoked_key(name, state.certificate))
        return Issuance(name, identity, rights)

    def _generate_key(self, name: str) -> PrivateKey:
        folder = enclave_path(self.change.root, name)
        if (folder / KEY_URI_FILE).exists():
            raise KeystoreError(
                f"the key of enclave {name} is on a token",
                f"A new key in a file would have no effect: {KEY_URI_FILE} names the current key.",
                f"Make a key on the token: `sros renew {quote(str(self.change.root))} {name} --key "
                "'pkcs11:token=NAME;object=LABEL'`, with a label that the token does not have.",
            )
        self._refuse_key_on_robot(name)
        return generate_key()

    def _refuse_key_on_robot(self, name: str) -> None:
        if key_on_robot(enclave_path(self.change.root, name)):
            raise KeystoreError(
                f"the key of enclave {name} is not in this keystore",
                "It was generated on the robot and stays there, so no new key is generated here.",
                "Remove the enclave's folder on the robot, create a new request there with "
                "`sros create_request`, and sign it here with `sros sign_request --renew`. To "
                "revoke the earlier key, then run "
                f"`sros renew {quote(str(self.change.root))} {quote(name)} --revoke-old`.",
            )


def checked_rights(
    state: Credentials, authorities: Authorities, recorded: RecordedRights
) -> SignedRights:
    """Return the rights of an enclave, after verifying its files, for signing them again.

    Raises:
        KeystoreError: the CAs of the keystore did not issue the certificate, or the permissions are
            not the last ones that the ledger records for the enclave.
        PkiError: the permissions CA did not sign the permissions.
    """
    authority = authorities.identity.certificate
    if not issued_by(state.certificate, authority):
        raise KeystoreError(
            f"the certificate of enclave {state.name} was not issued by the identity CA of this "
            "keystore",
            f"Its issuer is {other_issuer_text(state.certificate, authority)}.",
            "Restore the certificate, or remove the enclave's folder and create the enclave again.",
        )
    state.signed.verify(authorities.permissions.certificate)
    return recorded.rights_to_sign(state.name, state.digest, state.grant)
