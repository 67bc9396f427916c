"""Signing of the revocation lists of a keystore, in the files that DDS reads.

In every enclave, ``crl.pem`` is the list of the issuing identity CA.  During a rotation, there is a
second identity CA, whose list is in the file of the identity CAs.  Fast DDS 2.9.1 trusts both CAs
and reads lists in that file, but reads only one list in ``crl.pem``; Cyclone DDS 0.10.2 trusts only
the issuing CA (all tested).
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Collection, Container, Iterable, Mapping, Sequence, Set
from dataclasses import dataclass, replace
from datetime import datetime
from shlex import quote

from cryptography import x509
from cryptography.hazmat.primitives import serialization

from sros_tool.errors import KeystoreError, Note, SrosError, UsageError
from sros_tool.keystore.fleet import publish_command
from sros_tool.keystore.issuing.authority import Authority, write_bundle
from sros_tool.keystore.issuing.keyring import Keyring
from sros_tool.keystore.known_keys import (
    certificates_of_revoked,
    known_expiries,
    restored_at,
    revoked_entries,
    revoked_serials,
)
from sros_tool.keystore.layout import (
    CRL,
    CRL_FILE,
    IDENTITY,
    PRIVATE,
    enclave_folder,
    link_to_list,
    revoked_certificates,
)
from sros_tool.keystore.ledger import REPORTED, Entry, certificate_entry, document_entry
from sros_tool.keystore.lifecycle.replaced import SupersededCertificate
from sros_tool.keystore.lifecycle.rotation import (
    Replacement,
    RotationStage,
    are_crls_confusable,
    read_rotation,
)
from sros_tool.keystore.reader import OpenedKeystore
from sros_tool.keystore.template import Template
from sros_tool.keystore.transaction import Transaction
from sros_tool.names import check_enclave_name
from sros_tool.pki.certificates import (
    authority_text,
    common_name_of,
    digest,
    issued_by,
    pem,
    same_key,
    validity_of,
)
from sros_tool.pki.crl import (
    REASONS,
    SUPERSEDED,
    RevocationEntry,
    RevocationList,
    load_crl,
    load_crls,
    sign_crl,
    signed_by,
)
from sros_tool.validity import BACKDATE, Window, iso
from sros_tool.wording import capitalized, counted, serial_text


class LostRecords:
    """Lists and certificates that a keystore issued but has lost, as after restoring a backup.

    An identity CA of the keystore signed these ``lists`` and ``certificates``, so both are
    authentic wherever they come from.  ``certificates`` maps serial numbers (hexadecimal) to ledger
    entries.
    """

    def __init__(self, keystore: OpenedKeystore, now: datetime) -> None:
        self.lists: list[RevocationList] = []
        self.certificates: dict[str, Entry] = {}
        self.later_number = 0
        """Highest number of a robot's release that the keystore sealed and does not know, or 0."""
        self.perhaps_revoked: set[str] = set()
        """Enclaves of the keystore that such a release of their robot lacks."""
        self.has_lost_ca = False
        """Whether robots have certificates of an identity CA that the keystore has lost."""
        self.explained: set[str] = set()
        """Serial numbers of certificates from before a restore that is known already."""
        self._now = now
        self._issuing = keystore.ca_certificate(IDENTITY)
        self._authorities = keystore.authority(IDENTITY)
        self._revoked = set(revoked_serials(keystore))
        own = keystore.revocation_list
        self._latest = own if own and signed_by(own.list, self._issuing) else None
        self._seen: set[bytes] = set()

    def add_certificate(
        self, certificate: x509.Certificate, reason: str = "", *, explained: bool = False
    ) -> bool:
        """Add an enclave's certificate, unless it has expired; return whether it was added.

        `restore_revocations` records the certificate if the ledger lacks it.  ``reason`` is
        `REPORTED` if no seal of the keystore shows that the certificate belongs to this keystore.
        ``explained`` says that a known restore explains why the ledger lacks the certificate, so
        that it shows no other restore.
        """
        try:
            name = check_enclave_name(common_name_of(certificate.subject))
            entry = certificate_entry(self._now, "certificate", certificate, name, reason)
            ours = any(issued_by(certificate, authority) for authority in self._authorities)
        except (SrosError, ValueError):
            return False
        if not ours or entry.not_after < iso(self._now) or not entry.serial.strip("-0"):
            return False
        self.certificates.setdefault(entry.serial, entry)
        if explained:
            self.explained.add(entry.serial)
        return True

    def unknown_certificates(self, keystore: OpenedKeystore) -> dict[str, Entry]:
        """Map serial numbers to entries of certificates of which ``keystore`` has no record.

        A certificate that the ledger has only from a robot's message is included if a sealed
        release now shows it.
        """
        recorded = keystore.ledger_file.with_values("serial", self.certificates).entries
        known = {
            entry.serial
            for entry in recorded
            if entry.what == "certificate"
            and entry.serial in self.certificates
            and not (entry.reason == REPORTED != self.certificates[entry.serial].reason)
        }
        known |= {f"{serial:x}" for serial in revoked_serials(keystore)}
        return {serial: entry for serial, entry in self.certificates.items() if serial not in known}

    def add(self, document: bytes) -> bool:
        """Add the lists in a PEM file that the keystore has to know; return whether there are any.

        The file may have certificates, too.  The keystore has to know a list that revokes
        certificates which the keystore's list lacks.  It also has to know a list that is not
        earlier than its own list, because a robot with such a list would refuse the keystore's next
        list.
        """
        sha256 = hashlib.sha256(document).digest()
        if sha256 in self._seen:
            return False
        self._seen.add(sha256)
        try:
            added = [self._add_list(crl) for crl in load_crls(document, "of a robot")]
        except SrosError:
            return False
        return any(added)

    def _add_list(self, crl: RevocationList) -> bool:
        signers = [ca for ca in self._authorities if signed_by(crl.list, ca)]
        serials = {entry.serial for entry in crl.revoked}
        latest = self._latest
        is_later = self._issuing in signers and (
            latest is None
            or crl.number > latest.number
            or (crl.number == latest.number and crl[:4] != latest[:4])
        )
        if not signers or not (is_later or serials - self._revoked):
            return False
        if is_later:
            self._latest = crl
        self._revoked |= serials
        self.lists.append(crl)
        return True


@dataclass(frozen=True, slots=True)
class SignedList:
    """A signed revocation list (PEM), its expiry ``end`` in UTC, and its ledger entry."""

    document: bytes
    end: datetime
    entry: Entry


def sign_list(
    authority: Authority,
    revoked: Iterable[RevocationEntry],
    *,
    number: int,
    template: Template,
    now: datetime,
) -> SignedList:
    """Return a newly signed revocation list, which expires no later than its CA."""
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


def _entries_to_repeat(
    old: RevocationList | None, expiries: Mapping[int, str], now: datetime
) -> list[RevocationEntry]:
    """Return the entries of the ``old`` list that the next list must repeat.

    These are the certificates that had not expired when the old list was issued.  By RFC 5280, 3.3,
    an entry may be left out only if an earlier list that was issued after the certificate's expiry
    has the entry.  An old list that was issued in the future, by a clock that was wrong, counts as
    issued ``now``.  ``expiries`` maps serial numbers to expiries (ISO 8601, UTC); an entry without
    a known expiry is always repeated.
    """
    if old is None:
        return []
    # thisUpdate is up to BACKDATE before the time of signing, so some entries are repeated longer
    # than needed.
    issued = iso(min(old.this_update, now))
    return [entry for entry in old.revoked if expiries.get(entry.serial, issued) >= issued]


class RevocationListSigner:
    """Signer of the revocation lists of all trusted identity CAs, within a transaction.

    ``present`` is the list before the change; None if there is no list, or no trusted identity CA
    signed it.  ``list_of_service`` is the list (PEM) that a CA service signed, if the keystore has
    a CA service.  ``remarks`` are notes on lists that could not be signed or used, and on
    certificates that may be missing from the ledger.
    """

    def __init__(
        self,
        transaction: Transaction,
        keystore: OpenedKeystore,
        *,
        authority: Authority,
        template: Template,
        keyring: Keyring,
        now: datetime,
        list_of_service: bytes = b"",
    ) -> None:
        if list_of_service and not authority.service:
            raise UsageError(
                "the keystore signs its revocation list itself",
                "--crl is only for a keystore whose identity CA is a CA service.",
                "Leave --crl out.",
            )
        self._given_list = list_of_service
        self._transaction = transaction
        self._keystore = keystore
        self._root = keystore.root
        self._authority = authority
        self._template = template
        self._keyring = keyring
        self._now = now
        self._known_time = min(now, keystore.ledger_file.last_time() or now)
        """A time that has passed even if the clock is ahead now, as of the last change."""
        self._last: Mapping[str, Entry] = {}
        self.remarks: list[Note] = []
        self.present = self._list_if_authentic(keystore.revocation_list)

    def recipients(self) -> Sequence[str] | None:
        """Return the enclaves that already have the list; None if some may lack it.

        The first list was linked into all enclaves, and every enclave created since then gets the
        list.  So once a list was signed, these are the enclaves in the ledger, if it has an index.
        In a rotation, the result is None, because the files of all enclaves may have to change.
        """
        if not self.present or read_rotation(self._keystore).stage is not RotationStage.NONE:
            return None
        return self._keystore.ledger_file.recorded_enclaves()

    # ── revocations ────────────────────────────────────────────────────────────────────────

    def revocations(
        self, last: Mapping[str, Entry], reason: str, *, keep: Mapping[str, str] | None = None
    ) -> list[Entry]:
        """Return the ledger entries for revoking all valid certificates of enclaves.

        If the ledger may lack some of these certificates, `sign` adds a remark.

        Args:
            last: maps the enclaves to their present certificates.
            reason: the reason, as in RFC 5280.
            keep: maps enclaves to the digests of keys that stay valid although the certificates do
                not.
        """
        listed = {entry.serial for entry in self.present.revoked} if self.present else set()
        # Revocations that only the list has do not count: somebody may have copied the list from a
        # robot.
        recorded = {int(entry.serial, 16) for entry in self._keystore.entries_of("revocation")}
        revocations = []
        moment = iso(self._known_time)
        present = last
        # A certificate that has certainly expired need not be revoked when it is replaced.
        if keep is not None:
            present = {name: entry for name, entry in last.items() if entry.not_after >= moment}
        for name, valid in self._unexpired_certificates(last, present, listed).items():
            for serial, entry in valid.items():
                if serial not in recorded:
                    recorded.add(serial)
                    key = "" if keep and entry.key == keep[name] else entry.key
                    revocations.append(
                        Entry(
                            iso(self._now),
                            "revocation",
                            entry.enclave,
                            entry.subject,
                            entry.serial,
                            not_after=entry.not_after,
                            reason=reason,
                            key=key,
                        )
                    )
        self._last = last
        return revocations

    def superseded_revocations(self, superseded: Iterable[SupersededCertificate]) -> list[Entry]:
        """Return the ledger entries for revoking all earlier certificates of enclaves."""
        by_name = {certificate.name: certificate for certificate in superseded}
        entries = self.revocations(
            {name: certificate.old for name, certificate in by_name.items()},
            SUPERSEDED,
            keep={name: certificate.new_key for name, certificate in by_name.items()},
        )
        if entries and (published := publish_command(self._root)):
            text = (
                f"publish ({published}), and wait until `sros fleet status "
                f"{quote(str(self._root))}` shows that the robots have fetched. Only then give "
                "the revocation list to the web server from which they fetch: otherwise, the "
                "server would refuse a robot whose certificates are all replaced"
            )
            self.remarks.append(Note("crl.web-server", text))
        return entries

    def _unexpired_certificates(
        self, names: Iterable[str], present: Mapping[str, Entry], listed_serials: Collection[int]
    ) -> dict[str, dict[int, Entry]]:
        """Map each enclave to its certificates that may not have expired, by serial number.

        The certificates come from three places: the ledger; the folder ``revoked``, because a new
        list that replaces a lost one does not have its entries; and ``present``, because the ledger
        lacks certificates that ros2/sros2 issued.  Serial numbers in ``listed_serials`` are not
        searched in the folder.
        """
        certificates: dict[str, dict[int, Entry]] = {name: {} for name in names}
        moment = iso(self._known_time)
        for entry in self._keystore.ledger_file.with_values("enclave", certificates).entries:
            expired = entry.not_after and entry.not_after < moment
            if (
                entry.what == "certificate"
                and entry.enclave in certificates
                and entry.serial
                and not expired
            ):
                certificates[entry.enclave][int(entry.serial, 16)] = entry
        for certificate in certificates_of_revoked(
            self._keystore, self._serials_not_to_search(listed_serials)
        ):
            name = common_name_of(certificate.subject)
            if name in certificates and validity_of(certificate).not_after >= self._known_time:
                entry = certificate_entry(self._now, "certificate", certificate, name)
                certificates[name][certificate.serial_number] = entry
        for name, entry in present.items():
            certificates[name][int(entry.serial, 16)] = entry
        return certificates

    def _serials_not_to_search(self, listed_serials: Collection[int]) -> Container[str]:
        """Return the serial numbers of certificates that need not be read in ``revoked``.

        These are ``listed_serials``, and certificates in the folder that the ledger certainly has.
        """
        known = {f"{serial:x}" for serial in listed_serials}
        ledger = self._keystore.ledger_file
        if not ledger.is_indexed:
            return known
        others = revoked_certificates(self._keystore.root, known)
        certain = ledger.with_values("serial", [path.parent.name for path in others]).certain
        return known | {entry.serial for entry in certain if entry.what == "certificate"}

    def _note_missing_certificates(self) -> None:
        """Add a remark if the ledger may lack earlier certificates of the revoked enclaves."""
        if not self._last:
            return
        serials = {entry.serial for entry in self._last.values()}
        ledger = self._keystore.ledger_file.with_values("serial", serials)
        why = list(ledger.gaps)
        recorded = {int(entry.serial, 16) for entry in ledger.entries if entry.serial}
        lacking = (
            name for name, entry in self._last.items() if int(entry.serial, 16) not in recorded
        )
        if unknown := sorted(lacking):
            why.append(f"it does not have the current certificate of {', '.join(unknown)}")
        if restored := restored_at(self._keystore):
            why.append(f"the keystore was restored from a backup (sros noticed it at {restored})")
        if why:
            text = (
                f"The ledger of '{self._root}' may lack earlier certificates: {'; '.join(why)}. "
                "Certificates that the ledger lacks are not revoked: they stay valid until they "
                "expire or their CA is replaced (`sros rotate_ca`)."
            )
            self.remarks.append(Note("ledger.may-lack-certificates", text))

    # ── the lists ──────────────────────────────────────────────────────────────────────────

    def _list_if_authentic(self, crl: RevocationList | None) -> RevocationList | None:
        """Return ``crl`` if a trusted identity CA signed it; otherwise None, with a remark.

        Without this check, whoever can write the file but not sign it could make the CA sign
        entries that revoke other enclaves, or that prevent a revocation.
        """
        file = self._keystore.identity_file
        own = (self._authority.certificate,)
        trusted = self._keystore.certificates_of(file) if file else own
        if crl is None or any(signed_by(crl.list, authority) for authority in trusted):
            return crl
        text = (
            "No identity CA of this keystore signed its current revocation list, so the "
            "entries of the list do not count: find out who wrote the list."
        )
        self.remarks.append(Note("crl.not-signed-here", text))
        return None

    def sign(
        self,
        revocations: Sequence[Entry],
        names: Sequence[str],
        *,
        incomplete: bool,
        least: int = 0,
    ) -> tuple[datetime, list[Entry]]:
        """Sign and stage the lists; return their first expiry (UTC) and the new ledger entries.

        ``revocations`` are the entries of new revocations.  The enclaves ``names`` get the lists,
        except the `recipients`, who already have them.  The numbers of the lists are at least
        ``least``.  ``incomplete`` accepts that the list of the old CA cannot be signed.  Each list
        has all serial numbers, because the ledger does not say which of two CAs issued a
        certificate, and a serial number of the other CA does no harm.

        Raises:
            KeystoreError: a revocation needs the key of the old CA, which is missing, and
                ``incomplete`` is not set.
        """
        date = self._now.replace(microsecond=0)
        new_entries = [
            RevocationEntry(int(entry.serial, 16), date, entry.reason) for entry in revocations
        ]
        expiries = known_expiries(self._keystore, revoked_serials(self._keystore))
        if lost := self._lost_revocations(expiries):
            new_entries = [*new_entries, *lost]
            text = (
                "The revocation list was not the last list that this keystore signed: "
                f"{counted(len(lost), 'revocation')} that it lacked "
                f"{'was' if len(lost) == 1 else 'were'} added again."
            )
            self.remarks.append(Note("crl.put-back", text))
        signed = self._sign(self._authority, self.present, new_entries, expiries, least)
        self._transaction.write(CRL, signed.document)
        signed_lists = [signed]
        if second := self._sign_list_of_second_ca(
            new_entries, names, expiries, incomplete=incomplete, least=least
        ):
            signed_lists.append(second)
        if self.recipients() is None:
            _link_everywhere(self._transaction, names)
        self._note_missing_certificates()
        return min(signed.end for signed in signed_lists), [
            *revocations,
            *(signed.entry for signed in signed_lists),
        ]

    def _sign(
        self,
        authority: Authority,
        old: RevocationList | None,
        new_entries: Sequence[RevocationEntry],
        expiries: Mapping[int, str],
        least: int,
    ) -> SignedList:
        kept = _entries_to_repeat(old, expiries, self._now)
        listed = {entry.serial for entry in kept}
        kept += [entry for entry in new_entries if entry.serial not in listed]
        if authority.service:
            # A CA service's list may also have other certificates, and drops certificates that have
            # expired.
            moment = iso(self._now)
            own = {int(entry.serial, 16) for entry in self._keystore.entries_of("revocation")}
            needed = {
                entry.serial for entry in kept if expiries.get(entry.serial, moment) >= moment
            }
            new = {entry.serial for entry in new_entries}
            return self._list_of_service(authority, needed & (own | new))
        # Without an authentic earlier list, this number is above all that were used: each signed
        # list adds an entry to the ledger, and at most 2 to the number.
        used = 2 * len(self._keystore.entries_of("crl"))
        number = max(old.number + 1 if old else used + 1, least)
        return sign_list(authority, kept, number=number, template=self._template, now=self._now)

    def _list_of_service(self, authority: Authority, serials: Set[int]) -> SignedList:
        """Return the CA service's list, after verifying it.

        Raises:
            KeystoreError: the list is missing, is not signed by the identity CA, is not later than
                the present list, is not valid now, or does not revoke all ``serials``.
        """
        numbers = ", ".join(map(serial_text, sorted(serials)))
        revoke = f"Revoke these certificates at the service: {numbers}. " if numbers else ""
        remedy = f"{revoke}Give the list of the service with --crl FILE."
        if not self._given_list:
            raise KeystoreError(
                f"the identity CA of keystore '{self._root}' is a CA service, and only this "
                "service signs revocation lists",
                "Nothing was changed.",
                remedy,
            )
        crl = load_crl(self._given_list, "of the CA service")
        if not signed_by(crl.list, authority.certificate):
            fault = f"{authority_text(authority.certificate)} did not sign it"
        elif not crl.this_update <= self._now < crl.next_update:
            fault = f"it is valid from {iso(crl.this_update)} to {iso(crl.next_update)}, not now"
        elif crl.number <= (least := self.present.number if self.present else 0):
            fault = f"its number is {crl.number}, and has to be higher than {least}"
        elif missing := sorted(serial for serial in serials if not crl.revokes(serial)):
            fault = f"it does not revoke {', '.join(map(serial_text, missing))}"
        else:
            document = crl.list.public_bytes(serialization.Encoding.PEM)
            validity = Window(crl.this_update, crl.next_update)
            entry = document_entry(self._now, "crl", document, validity=validity)
            return SignedList(document, crl.next_update, entry)
        raise KeystoreError(
            "the revocation list of the CA service cannot be used",
            f"{capitalized(fault)}. Nothing was changed.",
            remedy,
        )

    def _lost_revocations(self, expiries: Mapping[int, str]) -> list[RevocationEntry]:
        """Return the unexpired revocations in the ledger that the present list lacks.

        If the present list is not the last list in the ledger, all these revocations are returned.
        The last list may lack certificates of replaced CAs. So for the last list, only those
        revocations are returned for which `unlisted_revocations` refuses an export.
        """
        entries = self._keystore.ledger_file.with_values("what", ("revocation", "crl")).entries
        count = max(
            (i for i, entry in enumerate(entries, 1) if entry.what == "revocation"), default=0
        )
        keystore = self._keystore
        present = keystore.read(CRL, "revocation list") if keystore.has(CRL) else b""
        sha256 = hashlib.sha256(present).hexdigest()
        is_last = any(entry.what == "crl" and entry.sha256 == sha256 for entry in entries[count:])
        listed = {entry.serial for entry in self.present.revoked} if self.present else set()
        on_a_list = {
            f"{entry.serial:x}" for crl in keystore.revocation_lists for entry in crl.revoked
        }
        missed = {entry.serial for entry in revoked_entries(keystore, on_a_list)}
        moment = iso(self._now)
        return [
            RevocationEntry(serial, self._now.replace(microsecond=0), reason)
            for entry in entries[:count]
            if entry.what == "revocation" and entry.serial
            if (serial := int(entry.serial, 16)) not in listed
            if entry.serial in missed or not is_last
            if expiries.get(serial, moment) >= moment
            for reason in (entry.reason if entry.reason in REASONS else "unspecified",)
        ]

    # ── the second CA during a rotation ────────────────────────────────────────────────────

    def _sign_list_of_second_ca(
        self,
        new_entries: Sequence[RevocationEntry],
        names: Sequence[str],
        expiries: Mapping[int, str],
        *,
        incomplete: bool,
        least: int,
    ) -> SignedList | None:
        """Sign the second identity CA's list, and stage it in the file of the identity CAs.

        The result is None if there is no second CA, or its list cannot be signed.  ``expiries``
        maps serial numbers to expiries; the other arguments are as in `sign`.
        """
        rotation = read_rotation(self._keystore)
        file = self._keystore.identity_file
        replaced = next(
            (candidate for candidate in rotation.replacements if candidate.file == file), None
        )
        if not replaced or not file:
            return None
        is_new_ca = rotation.stage is RotationStage.DISTRIBUTE
        certificates = self._keystore.certificates_of(file)
        sha256 = replaced.new if is_new_ca else replaced.old
        (other,) = [candidate for candidate in certificates if digest(candidate) == sha256]
        if is_new_ca and are_crls_confusable(certificates[0], other):
            return None  # then all processes have to be restarted together anyway
        old = self._list_if_authentic(self._keystore.embedded_list(file))
        try:
            authority = self._open(other, replaced, is_new_ca=is_new_ca)
        except KeystoreError as error:
            # The new CA has not issued anything yet; the next stage of the rotation signs its list.
            if not is_new_ca:
                self._note_unsigned_list(other, error, new_entries, old, incomplete=incomplete)
            return None
        # In the next stage, this list replaces the present one, so its number must be higher.
        if is_new_ca:
            least = max(least, (self.present.number if self.present else 0) + 2)
        signed = self._sign(authority, old, () if is_new_ca else new_entries, expiries, least)
        bundle = b"".join(map(pem, certificates)) + signed.document
        roles = self._keystore.authority_files[file]
        write_bundle(self._transaction, file, roles, bundle, names)
        return signed

    def _open(
        self, certificate: x509.Certificate, replaced: Replacement, *, is_new_ca: bool
    ) -> Authority:
        place = replaced.key if is_new_ca else replaced.old_key_place(certificate)
        # The environment variables name places for the key of the issuing CA, not of this one.
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

    def _note_unsigned_list(
        self,
        old_ca: x509.Certificate,
        error: KeystoreError,
        new_entries: Sequence[RevocationEntry],
        old: RevocationList | None,
        *,
        incomplete: bool,
    ) -> None:
        """Add a remark that the old CA's list was not signed.

        Raises:
            KeystoreError: there are new revocations, but ``incomplete`` is not set.
        """
        name = authority_text(old_ca)
        if new_entries and not incomplete:
            raise KeystoreError(
                f"the key of the old identity CA {name} is not available",
                "Until that CA is retired, Fast DDS accepts its certificates, so the CA also has "
                f"to sign a revocation list, but {error.what}.",
                f"First restart all processes and run `sros rotate_ca {quote(str(self._root))} "
                "--to retire`; or add --until-retired, and retire the CA soon.",
            )
        text = f"The revocation list of the old identity CA {name} was not signed again"
        if new_entries:
            text += (
                "; until the CA is retired, Fast DDS accepts the revoked certificates that the CA "
                "issued"
            )
        elif old:
            text += f"; the list expires at {iso(old.next_update)}, and Fast DDS then refuses "
            text += "the enclaves of that CA"
        text += f": run `sros rotate_ca {quote(str(self._root))} --to retire`."
        self.remarks.append(Note("crl.old-ca-not-signed", text))


def _link_everywhere(transaction: Transaction, names: Sequence[str]) -> None:
    """Stage ``crl.pem``, a link to the revocation list, for the enclaves ``names`` that lack it."""
    root, is_first = transaction.root, not os.path.lexists(transaction.root / CRL)
    lacking = []
    for name in names:
        folder = f"{root}/{enclave_folder(name)}"
        path = f"{enclave_folder(name)}/{CRL_FILE}"
        if is_first and os.path.lexists(folder) and not os.path.lexists(f"{folder}/{CRL_FILE}"):
            lacking.append(name)
        # Copying a keystore can replace the link by a file, which would never be updated.
        elif transaction.target_after(path) != link_to_list(name):
            transaction.link(path, link_to_list(name))
    if lacking:
        transaction.link_to_first_list(lacking)


def another_ca_remedy(keystore: OpenedKeystore, purpose: str) -> str:
    """Return, as a sentence, the remedy for an identity CA whose revocation lists DDS refuses.

    ``purpose`` is the command to repeat afterwards, such as "revoke".
    """
    file = keystore.identity_file
    words = ["sros rotate_ca", quote(str(keystore.root))]
    if read_rotation(keystore).stage is not RotationStage.NONE:
        return (
            f"First retire the old CA with `{' '.join(words)} --finish`, restart all processes, "
            f"and then {purpose}."
        )
    if len(keystore.authority_files) > 1:
        words.append("--identity")
    if not keystore.has(f"{PRIVATE}/{file}.key.pem"):
        words.append("--identity-key URI")
    return (
        f"With `{' '.join(words)} --finish`, replace the identity CA by a CA that may sign "
        f"revocation lists; restart all processes, and then {purpose}."
    )
