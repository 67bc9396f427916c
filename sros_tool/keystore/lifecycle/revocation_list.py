"""Signing of the revocation lists of a keystore, in the files that DDS reads.

``crl.pem`` in every enclave is the list of the issuing identity CA.  During a rotation there is a
second identity CA; its list is in the file of the identity CAs.  Fast DDS 2.9.1 trusts both CAs and
reads lists in that file, but reads only one list in ``crl.pem``; Cyclone DDS 0.10.2 trusts the
issuing CA alone (all measured).
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Container, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from datetime import datetime
from shlex import quote

from cryptography import x509

from sros_tool.errors import KeystoreError, Note, SrosError
from sros_tool.keystore.issuing.authority import Authority, write_bundle
from sros_tool.keystore.issuing.keyring import Keyring
from sros_tool.keystore.layout import (
    CRL,
    IDENTITY,
    PRIVATE,
    enclave_folder,
    revoked_certificates,
)
from sros_tool.keystore.ledger import Entry, certificate_entry, document_entry
from sros_tool.keystore.lifecycle.replaced import Superseded
from sros_tool.keystore.lifecycle.rotation import (
    Replacement,
    RotationStage,
    crls_confusable,
    read_rotation,
)
from sros_tool.keystore.reader import Keystore
from sros_tool.keystore.template import Template
from sros_tool.keystore.transaction.transaction import Transaction
from sros_tool.pki.certificates import (
    authority_text,
    common_name_of,
    digest,
    issued_by,
    pem,
    same_key,
    validity_of,
)
from sros_tool.pki.crl import REASONS, SUPERSEDED, RevocationList, Revoked, sign_crl, signed_by
from sros_tool.validity import BACKDATE, Window, iso


@dataclass(frozen=True, slots=True)
class SignedList:
    """A signed revocation list as PEM, its expiry ``end`` in UTC, and its ledger entry."""

    document: bytes
    end: datetime
    entry: Entry


def sign_list(
    authority: Authority,
    revoked: Iterable[Revoked],
    *,
    number: int,
    template: Template,
    now: datetime,
) -> SignedList:
    """Sign a revocation list that expires with its CA at the latest."""
    validity = validity_of(authority.certificate)
    moment = now.replace(microsecond=0)
    begin = max(moment - BACKDATE, validity.not_before)
    end = min(moment + template.revocation_validity, validity.not_after)
    document = sign_crl(
        authority.certificate,
        authority.key,
        revoked,
        number=number,
        this_update=begin,
        next_update=end,
    )
    entry = document_entry(now, "crl", document, validity=Window(begin, end))
    return SignedList(document, end, entry)


def _carried_over(old: RevocationList | None, expiries: Mapping[int, str]) -> list[Revoked]:
    """Return the entries of the ``old`` list that the next list repeats.

    These are the certificates that had not expired when the old list was issued: RFC 5280, 3.3,
    keeps an entry until it was on one list after the certificate's expiry.  ``expiries`` maps
    serial numbers to expiries (ISO 8601, UTC); an entry without an expiry is always repeated.
    """
    if old is None:
        return []
    # thisUpdate is up to BACKDATE before the signing, so some entries are kept a little longer.
    issued = iso(old.this_update)
    return [each for each in old.revoked if expiries.get(each.serial, issued) >= issued]


def _put_away(keystore: Keystore, known: Container[str] = ()) -> Iterator[x509.Certificate]:
    """Yield the certificates in ``revoked`` that a trusted identity CA issued.

    Those whose serial number in hexadecimal is in ``known`` are not read.
    """
    file = keystore.identity_file
    trusted = keystore.certificates_of(file) if file else ()
    for path in revoked_certificates(keystore.root):
        if path.parent.name not in known:
            with suppress(SrosError):  # a file that is no certificate
                certificate = keystore.certificate(path)
                if any(issued_by(certificate, authority) for authority in trusted):
                    yield certificate


class RevocationListSigner:
    """Signer of the revocation lists of all trusted identity CAs, within a transaction.

    ``present`` is the list before the change, or None if there is none, or if no trusted identity
    CA signed it.  ``remarks`` are sentences about lists that could not be signed or used, and about
    certificates that nobody may know of.
    """

    def __init__(
        self,
        transaction: Transaction,
        keystore: Keystore,
        *,
        authority: Authority,
        template: Template,
        keyring: Keyring,
        now: datetime,
    ) -> None:
        self._transaction = transaction
        self._keystore = keystore
        self._root = keystore.root
        self._authority = authority
        self._template = template
        self._keyring = keyring
        self._now = now
        self._last: Mapping[str, Entry] = {}
        self.remarks: list[Note] = []
        self.present = self._authentic(keystore.revocation_list)

    # ── what is revoked ────────────────────────────────────────────────────────────────────

    def revocations(
        self, last: Mapping[str, Entry], reason: str, *, keep: Mapping[str, str] | None = None
    ) -> list[Entry]:
        """Return the ledger entries for revoking all valid certificates of enclaves.

        `sign` then remarks if the ledger may lack some of them.

        Args:
            last: the present certificate of each of the enclaves.
            reason: the reason, as RFC 5280 spells it.
            keep: the digests of the keys of enclaves that are not revoked with their certificates.
        """
        listed = {each.serial for each in self.present.revoked} if self.present else set()
        revocations = []
        moment = iso(self._now)
        present = last
        if keep is not None:  # an expired certificate needs no revocation to be replaced
            present = {name: each for name, each in last.items() if each.not_after >= moment}
        for name, valid in self._still_valid(last, present).items():
            for serial, each in valid.items():
                if serial not in listed:
                    listed.add(serial)
                    key = "" if keep and each.key == keep[name] else each.key
                    revocations.append(
                        Entry(
                            iso(self._now),
                            "revocation",
                            each.enclave,
                            each.subject,
                            each.serial,
                            reason=reason,
                            key=key,
                        )
                    )
        self._last = last
        return revocations

    def superseded(self, replaced: Iterable[Superseded]) -> list[Entry]:
        """Return the ledger entries for revoking all certificates that enclaves had before."""
        by_name = {each.name: each for each in replaced}
        return self.revocations(
            {name: each.old for name, each in by_name.items()},
            SUPERSEDED,
            keep={name: each.new_key for name, each in by_name.items()},
        )

    def _still_valid(
        self, names: Iterable[str], present: Mapping[str, Entry]
    ) -> dict[str, dict[int, Entry]]:
        """Map each of the enclaves to its certificates that have not expired, by serial number.

        They are from the ledger, from the files in ``revoked`` (a list that was lost no longer has
        those), and the ``present`` ones, which the ledger lacks if ros2/sros2 issued them.
        """
        found: dict[str, dict[int, Entry]] = {name: {} for name in names}
        moment = iso(self._now)
        for each in self._keystore.ledger.entries:
            expired = each.not_after and each.not_after < moment
            if each.what == "certificate" and each.enclave in found and each.serial and not expired:
                found[each.enclave][int(each.serial, 16)] = each
        for certificate in _put_away(self._keystore):
            name = common_name_of(certificate.subject)
            if name in found and validity_of(certificate).not_after >= self._now:
                entry = certificate_entry(self._now, "certificate", certificate, name)
                found[name][certificate.serial_number] = entry
        for name, each in present.items():
            found[name][int(each.serial, 16)] = each
        return found

    def _note_lack(self) -> None:
        """Note if the ledger may lack earlier certificates of the enclaves that are revoked."""
        if not self._last:
            return
        ledger = self._keystore.ledger
        why = list(ledger.gaps)
        if ledger.unchained:
            why.append(
                f"nothing shows whether a line was removed from its first {ledger.unchained}"
            )
        recorded = {int(each.serial, 16) for each in ledger.entries if each.serial}
        lacking = (
            name for name, each in self._last.items() if int(each.serial, 16) not in recorded
        )
        if unknown := sorted(lacking):
            why.append(f"it does not have the present certificate of {', '.join(unknown)}")
        if why:
            text = (
                f"The ledger of '{self._root}' may lack earlier certificates: {'; '.join(why)}. "
                "Those that it lacks stay valid until they expire or their CA is replaced: see "
                "`sros rotate_ca`."
            )
            self.remarks.append(Note("ledger.may-lack-certificates", text))

    # ── the lists ──────────────────────────────────────────────────────────────────────────

    def _authentic(self, found: RevocationList | None) -> RevocationList | None:
        """Return a list if a trusted identity CA signed it; else None, with a remark.

        Whoever can write the file, but not sign, could have entries signed that revoke others, or
        that keep a certificate from being revoked.
        """
        file = self._keystore.identity_file
        own = (self._authority.certificate,)
        trusted = self._keystore.certificates_of(file) if file else own
        if found is None or any(signed_by(found.list, each) for each in trusted):
            return found
        text = (
            "No identity CA of this keystore signed the revocation list that was there, so its "
            "entries do not count: find out who wrote it."
        )
        self.remarks.append(Note("crl.not-signed-here", text))
        return None

    def sign(
        self, revocations: Sequence[Entry], names: Sequence[str], *, incomplete: bool
    ) -> tuple[datetime, list[Entry]]:
        """Sign and stage the lists; return their first expiry and all ledger entries.

        ``revocations`` are the entries of what is revoked; the enclaves ``names`` get the lists.
        Each list has all serial numbers: the ledger does not say which of two CAs issued a
        certificate, and a serial number of the other CA does no harm.

        Raises:
            KeystoreError: a revocation needs the key of the old CA, which is missing, and
                ``incomplete`` is not set.
        """
        date = self._now.replace(microsecond=0)
        new_entries = [Revoked(int(each.serial, 16), date, each.reason) for each in revocations]
        expiries = self._expiries()
        if lost := self._lost(expiries):
            new_entries = [*new_entries, *lost]
            text = (
                f"The revocation list was not the last one that this keystore signed: {len(lost)} "
                "revocations are in it again."
            )
            self.remarks.append(Note("crl.put-back", text))
        signed = self._sign(self._authority, self.present, new_entries, expiries, 0)
        self._transaction.write(CRL, signed.document)
        found = [signed]
        if second := self._sign_second(new_entries, names, expiries, incomplete=incomplete):
            found.append(second)
        _link_everywhere(self._transaction, names)
        self._note_lack()
        return min(each.end for each in found), [*revocations, *(each.entry for each in found)]

    def _sign(
        self,
        authority: Authority,
        old: RevocationList | None,
        new_entries: Sequence[Revoked],
        expiries: Mapping[int, str],
        least: int,
    ) -> SignedList:
        kept = _carried_over(old, expiries)
        listed = {each.serial for each in kept}
        kept += [each for each in new_entries if each.serial not in listed]
        # Without an earlier list that is authentic: above every number that was used, because each
        # list that is signed adds an entry to the ledger, and at most 2 to the number.
        used = 2 * sum(each.what == "crl" for each in self._keystore.ledger.entries)
        number = max(old.number + 1 if old else used + 1, least)
        return sign_list(authority, kept, number=number, template=self._template, now=self._now)

    def _lost(self, expiries: Mapping[int, str]) -> list[Revoked]:
        """Return the revocations in the ledger, if the present list is older than the last one."""
        entries = self._keystore.ledger.entries
        count = max(
            (i for i, each in enumerate(entries, 1) if each.what == "revocation"), default=0
        )
        keystore = self._keystore
        present = keystore.read(CRL, "revocation list") if keystore.has(CRL) else b""
        sha256 = hashlib.sha256(present).hexdigest()
        if any(each.what == "crl" and each.sha256 == sha256 for each in entries[count:]):
            return []
        listed = {each.serial for each in self.present.revoked} if self.present else set()
        moment = iso(self._now)
        return [
            Revoked(serial, self._now.replace(microsecond=0), reason)
            for each in entries[:count]
            if each.what == "revocation" and each.serial
            if (serial := int(each.serial, 16)) not in listed
            if expiries.get(serial, moment) >= moment
            for reason in (each.reason if each.reason in REASONS else "unspecified",)
        ]

    def _expiries(self) -> dict[int, str]:
        """Map serial numbers to expiries, from the ledger and the files in ``revoked``.

        What is not certain has no expiry, and so stays on the list.
        """
        recorded = {
            each.serial: each.not_after
            for each in self._keystore.ledger.certain
            if each.what == "certificate" and each.serial and each.not_after
        }
        expiries = {int(serial, 16): not_after for serial, not_after in recorded.items()}
        for found in _put_away(self._keystore, recorded):
            expiries.setdefault(found.serial_number, iso(validity_of(found).not_after))
        return expiries

    # ── the second CA during a rotation ────────────────────────────────────────────────────

    def _sign_second(
        self,
        new_entries: Sequence[Revoked],
        names: Sequence[str],
        expiries: Mapping[int, str],
        *,
        incomplete: bool,
    ) -> SignedList | None:
        """Sign the list of the second identity CA, and stage it in the file of the identity CAs.

        Return None if there is no second CA or its list cannot be signed.
        """
        rotation = read_rotation(self._keystore)
        file = self._keystore.identity_file
        replaced = next((each for each in rotation.replacements if each.file == file), None)
        if not replaced or not file:
            return None
        coming = rotation.stage is RotationStage.DISTRIBUTE
        certificates = self._keystore.certificates_of(file)
        wanted = replaced.new if coming else replaced.old
        (other,) = [each for each in certificates if digest(each) == wanted]
        if coming and crls_confusable(certificates[0], other):
            return None  # in this case all processes have to be restarted together anyway
        old = self._authentic(self._keystore.embedded_list(file))
        try:
            authority = self._open(other, replaced, coming=coming)
        except KeystoreError as error:
            # The new CA has issued nothing yet; the next stage of the rotation signs its list.
            if not coming:
                self._handle_missing_key(other, error, new_entries, old, incomplete=incomplete)
            return None
        # The next stage replaces the present list with this one, so its number must be higher.
        least = (self.present.number if self.present else 0) + 2 if coming else 0
        signed = self._sign(authority, old, () if coming else new_entries, expiries, least)
        bundle = b"".join(map(pem, certificates)) + signed.document
        roles = self._keystore.authority_files[file]
        write_bundle(self._transaction, file, roles, bundle, names)
        return signed

    def _open(
        self, certificate: x509.Certificate, replaced: Replacement, *, coming: bool
    ) -> Authority:
        place = replaced.key if coming else replaced.old_key_place(certificate)
        # The places in the environment variables are for the key of the issuing CA.
        keyring = replace(self._keyring, places={})
        key = keyring.open(self._keystore, IDENTITY, replace(self._template, identity_key=place))
        if not same_key(certificate, key):
            name = authority_text(certificate)
            raise KeystoreError(
                f"the key at '{place}' does not belong to the CA {name}",
                "A revocation list signed with it would not verify.",
                "Restore the key from a backup.",
            )
        return Authority(certificate, key)

    def _handle_missing_key(
        self,
        old_ca: x509.Certificate,
        error: KeystoreError,
        new_entries: Sequence[Revoked],
        old: RevocationList | None,
        *,
        incomplete: bool,
    ) -> None:
        """Add a remark on the unsigned list of the old CA; raise if a revocation needs it."""
        name = authority_text(old_ca)
        if new_entries and not incomplete:
            raise KeystoreError(
                f"the key of the old identity CA {name} is not available",
                f"Until that CA is retired, Fast DDS accepts its certificates, so it also has to "
                f"sign a revocation list: {error.what}.",
                f"Restart all processes and run `sros rotate_ca {quote(str(self._root))} --to "
                "retire` first; "
                "or add --until-retired, and retire it soon.",
            )
        text = f"The list of the old identity CA {name} was not signed again"
        if new_entries:
            text += (
                "; until it is retired, Fast DDS accepts the revoked certificates that it issued"
            )
        elif old:
            text += f"; it expires at {iso(old.next_update)}, and Fast DDS then refuses "
            text += "the enclaves of that CA"
        text += f": run `sros rotate_ca {quote(str(self._root))} --to retire`."
        self.remarks.append(Note("crl.old-ca-not-signed", text))


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


def another_ca(keystore: Keystore, aim: str) -> str:
    """Return what to do where DDS refuses the lists of the identity CA, before the ``aim``."""
    file = keystore.identity_file
    words = ["sros rotate_ca", quote(str(keystore.root))]
    if read_rotation(keystore).stage is not RotationStage.NONE:
        return (
            f"First retire the old CA: `{' '.join(words)} --finish`, restart all processes, and "
            f"{aim} then."
        )
    if len(keystore.authority_files) > 1:
        words.append("--identity")
    if not keystore.has(f"{PRIVATE}/{file}.key.pem"):
        words.append("--identity-key URI")
    return (
        f"Replace the identity CA by one that may sign revocation lists: `{' '.join(words)} "
        f"--finish`, restart all processes, and {aim} then."
    )
