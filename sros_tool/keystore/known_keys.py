"""The keys of a keystore's enclaves, revoked keys, and how long issued files work.

A revocation list names certificates, so a new certificate for a revoked key would undo the
revocation of the key.  Two enclaves with one key are one identity: each can act as the other.  Keys
are compared by the SHA-256 of their SubjectPublicKeyInfo (DER).
"""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Collection, Container, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from datetime import datetime
from functools import cached_property
from pathlib import Path
from shlex import quote

from cryptography import x509

from sros_tool.errors import KeystoreError, Note, PkiError, SrosError
from sros_tool.fleet.robots import enclaves_of, robot_of
from sros_tool.keystore.fleet import load_fleet
from sros_tool.keystore.layout import (
    CERTIFICATE_FILE,
    FLEET,
    IDENTITY,
    KEY_FILE,
    PERMISSIONS,
    REQUEST,
    REVOKED,
    has_key,
    key_on_robot,
    revoked_certificates,
)
from sros_tool.keystore.ledger import (
    BY_POLICY,
    LATER_RELEASE,
    PUBLISHING,
    RECORDED_LATE,
    REPORTED,
    RESTORED,
    Entry,
    Ledger,
)
from sros_tool.keystore.reader import OpenedKeystore
from sros_tool.parallel import map_slices
from sros_tool.pki.certificates import (
    common_name_of,
    digest,
    identity_of,
    issued_by,
    key_digest,
    load_request,
    subject_text,
    validity_of,
)
from sros_tool.pki.crl import SUPERSEDED
from sros_tool.pki.keys import PublicKey, load_key
from sros_tool.validity import iso, parse_iso
from sros_tool.wording import first_few, serial_text


def other_enclave(keystore: OpenedKeystore, name: str, certificate: x509.Certificate) -> str:
    """Return the other enclave for which ``certificate``, in the folder of ``name``, was issued.

    The result is "" if the certificate was issued for ``name`` itself, or comes from another PKI,
    whose names no vendor compares with the folder.
    """
    common_name = common_name_of(certificate.subject)
    certified = f"/{common_name.removeprefix('/')}"
    if certified == name or not (common_name.startswith("/") or certified in keystore.names):
        return ""
    return certified


def revoked_serials(keystore: OpenedKeystore) -> frozenset[int]:
    """Return the serial numbers of all revoked certificates, also of those revoked as replaced."""
    recorded = {int(entry.serial, 16) for entry in keystore.entries_of("revocation")}
    listed = {entry.serial for crl in keystore.revocation_lists for entry in crl.revoked}
    return frozenset(recorded | listed)


def known_expiries(keystore: OpenedKeystore, serials: Collection[int]) -> dict[int, str]:
    """Map serial numbers to expiries (ISO 8601, UTC), by the ledger and the folder ``revoked``.

    A certificate is left out if its entry in the ledger is not certain.
    """
    wanted = {f"{serial:x}" for serial in serials}
    if not wanted:
        return {}
    # Version 0.2 of sros recorded the expiry only with the certificate.
    recorded = {
        entry.serial: entry.not_after
        for entry in keystore.ledger_file.with_values("serial", wanted).certain
        if entry.what in ("certificate", "revocation")
        and entry.serial in wanted
        and entry.not_after
    }
    expiries = {int(serial, 16): not_after for serial, not_after in recorded.items()}
    for certificate in certificates_of_revoked(keystore, recorded):
        if certificate.serial_number in serials:
            expiries[certificate.serial_number] = iso(validity_of(certificate).not_after)
    return expiries


def certificates_of_revoked(
    keystore: OpenedKeystore, known: Container[str] = ()
) -> Iterator[x509.Certificate]:
    """Yield the certificates in the folder ``revoked`` that a trusted identity CA issued.

    Certificates whose serial number (hexadecimal) is in ``known`` are not read.
    """
    file = keystore.identity_file
    trusted = keystore.certificates_of(file) if file else ()
    for path in revoked_certificates(keystore.root, known):
        with suppress(SrosError):  # the file is not a certificate
            certificate = keystore.certificate(path)
            if any(issued_by(certificate, authority) for authority in trusted):
                yield certificate


def restored_at(keystore: OpenedKeystore) -> str:
    """Return when sros noticed the last restore; "" if no identity CA of that time is trusted.

    The time is in ISO 8601 (UTC), and later than the backup.  What shows the same restore again,
    before or after it was published, does not change the time.  Restores before the trusted CAs
    do not count.
    """
    if not keystore.entries_of(RESTORED):
        return ""
    noticed, is_published = "", False
    entries = keystore.ledger_file.with_values("what", (RESTORED, "release")).entries
    for entry in _entries_since_trusted_ca(keystore, entries):
        if entry.what == "release":
            is_published = bool(noticed)
        elif entry.what == RESTORED and (
            not noticed or (is_published and entry.reason in (LATER_RELEASE, PUBLISHING))
        ):
            noticed, is_published = entry.time, False
    return noticed


def without_policy_since_restore(keystore: OpenedKeystore, names: Collection[str]) -> list[str]:
    """Return the enclaves in ``names`` that have the rights of the backup.

    No policy was signed for them since sros noticed that the keystore was restored, so their
    permissions may lack rights, or have rights, that were changed after the backup.
    """
    if not names or not (restored := restored_at(keystore)):
        return []
    by_policy: dict[str, bool] = {}
    for entry in keystore.ledger_file.with_values("enclave", names).entries:
        if entry.what == "permissions" and entry.policy:
            is_since = entry.reason == BY_POLICY and entry.time >= restored
            by_policy[entry.enclave] = by_policy.get(entry.enclave, False) or is_since
    return [name for name in names if by_policy.get(name) is False]


def rights_of_backup_notes(keystore: OpenedKeystore, names: Sequence[str]) -> Iterator[Note]:
    """Yield a note if enclaves in ``names`` have rights that only a restored backup states."""
    if old := without_policy_since_restore(keystore, names):
        root, are = quote(str(keystore.root)), "have" if len(old) > 1 else "has"
        yield Note(
            "keystore.rights-of-backup",
            f"{first_few(old, 3)} {are} the rights of the backup: the keystore was restored (sros "
            f"noticed it at {restored_at(keystore)}), and no policy was signed since. Publishing "
            "undoes later changes of rights. First sign the present policy: `sros "
            f"generate_artifacts -k {root} -p POLICY_FILE"
            f"{' --fleet FLEET_FILE' * keystore.has(FLEET)}`.",
        )


def subjects_since_restore(keystore: OpenedKeystore, ledger: Ledger) -> frozenset[str] | None:
    """Return the subjects first recorded after the last restore.

    For these subjects, the ledger is complete: the certificates and permissions that it may lack,
    because they were issued after the backup, have other subjects.  The result is None if there was
    no restore, or if both CAs have been replaced since.
    Subjects that only messages or published releases showed are left out
    (`KnownKeys.certificates_shown_after_restore`).
    """
    entries = ledger.entries
    trusted = max(
        (_entries_since_trusted_ca(keystore, entries, r) for r in (IDENTITY, PERMISSIONS)), key=len
    )
    times = {entry.time for entry in trusted if entry.what == RESTORED}
    if not times:
        return None
    last = max(place for place, entry in enumerate(entries) if entry.what == RESTORED) + 1
    shown = {e.subject for e in entries[last:] if e.reason == REPORTED or e.time in times}
    return frozenset(entry.subject for entry in entries[last:]).difference(
        shown, (entry.subject for entry in entries[:last])
    )


def _entries_since_trusted_ca(
    keystore: OpenedKeystore, entries: Sequence[Entry], role: str = IDENTITY
) -> Sequence[Entry]:
    """Return the entries since the ledger first recorded a key of a trusted ``role`` CA.

    ``entries`` come from reading the ledger, and include all CAs.  All entries are returned in
    these cases:

    - there is no trusted CA;
    - a trusted CA was recorded only when it was renewed or replaced, because the earlier ledger was
      lost.
    """
    trusted = {_key_digest_of(ca) for ca in keystore.authority(role)}
    authorities = [
        place
        for place, entry in enumerate(entries)
        if entry.what == "ca" and entry.reason not in RECORDED_LATE
    ]
    places = (
        next((place for place in authorities if entries[place].key == key), 0) for key in trusted
    )
    return entries[min(places, default=0) :]


def revoked_entries(keystore: OpenedKeystore, listed: Collection[str] = ()) -> Iterator[Entry]:
    """Yield the ledger entries of revoked certificates, and of the permissions of their enclaves.

    Two kinds of certificates are left out: certificates of CAs that are no longer trusted, and
    certificates whose serial number (hexadecimal) is in ``listed``.  The entry of a certificate
    records its issue or, if the ledger lacks the issue, its revocation.
    """
    serials = {f"{serial:x}" for serial in revoked_serials(keystore)}.difference(listed)
    recorded = keystore.ledger_file.with_values("serial", serials).entries if serials else ()
    names = {entry.enclave for entry in recorded if entry.serial in serials} - {""}
    entries = keystore.ledger_file.with_values("enclave", names).entries if names else ()
    earlier = len(entries) - len(_entries_since_trusted_ca(keystore, entries))
    serials -= {entry.serial for entry in entries[:earlier]}
    for entry in entries:
        if entry.enclave in names and entry.what == "permissions":
            yield entry
        elif entry.enclave in names and entry.serial in serials:
            serials.remove(entry.serial)
            if _may_be_issued_by_trusted_ca(keystore, entry):
                yield entry


def removed_enclaves(keystore: OpenedKeystore, now: datetime) -> Mapping[str, str]:
    """Map enclaves that were removed from a keystore, but not revoked, to their files' expiry.

    The expiry is in ISO 8601 (UTC).  Until the files expire, whoever has them can use
    them, because the keystore trusts their CA.
    """
    recorded = keystore.ledger_file.recorded_enclaves()
    if recorded is None:
        recorded = [entry.enclave for entry in keystore.ledger.entries]
    gone = {*recorded}.difference(keystore.names, ("",))
    revoked = {f"{serial:x}" for serial in revoked_serials(keystore)} if gone else set()
    entries = keystore.ledger_file.with_values("enclave", gone).entries if gone else ()
    expiry: dict[str, str] = {}
    for entry in _entries_since_trusted_ca(keystore, entries):
        if (
            entry.what == "certificate"
            and entry.enclave in gone
            and entry.serial not in revoked
            and entry.reason != REPORTED
            and entry.not_after > iso(now)
        ):
            expiry[entry.enclave] = max(entry.not_after, expiry.get(entry.enclave, ""))
    return expiry


def unlisted_revocations(keystore: OpenedKeystore, now: datetime) -> Sequence[str]:
    """Return the enclaves with a revoked, unexpired certificate that is on no revocation list."""

    def read() -> Sequence[str]:
        lists = keystore.revocation_lists
        listed = {f"{entry.serial:x}" for crl in lists for entry in crl.revoked}
        revoked = revoked_entries(keystore, listed)
        return sorted({e.enclave for e in revoked if e.serial and e.not_after > iso(now)})

    return keystore.once(("unlisted", now), read)


def unknown_authorities(keystore: OpenedKeystore, role: str) -> Sequence[x509.Certificate]:
    """Return the CAs in the CA file of a role that the keystore does not know.

    The result is empty if the ledger records no CA.
    """
    known = known_authorities(keystore, role)
    return (
        () if known is None else [ca for ca in keystore.authority(role) if digest(ca) not in known]
    )


def known_authorities(keystore: OpenedKeystore, role: str) -> frozenset[str] | None:
    """Return the SHA-256 of the known certificates in the CA file of a role.

    The known ones are the CAs in the ledger, and the CAs that issued their certificates.  The
    result is None if the ledger has no CA.
    """
    return keystore.once(("known", role), lambda: _known_authorities(keystore, role))


def _known_authorities(keystore: OpenedKeystore, role: str) -> frozenset[str] | None:
    chain = keystore.authority(role)
    recorded = {entry.sha256 for entry in keystore.entries_of("ca")}
    if not recorded:
        return None
    known = {digest(ca): ca for ca in chain if digest(ca) in recorded}
    while issuers := {
        digest(ca): ca
        for ca in chain
        if digest(ca) not in known and any(issued_by(issued, ca) for issued in known.values())
    }:
        known |= issuers
    return frozenset(known)


def _may_be_issued_by_trusted_ca(keystore: OpenedKeystore, entry: Entry) -> bool:
    """Return whether a trusted CA may have issued the certificate of a ledger entry.

    An entry after the entry of a trusted CA does not prove that this CA issued the certificate:
    until the stage reissue of a rotation, the previous CA goes on to issue. A copy of the
    certificate in the folder ``revoked``, with the recorded digest, shows the issuer. Without such
    a copy, the result is True.
    """
    file = keystore.identity_file
    with suppress(SrosError):
        certificate = keystore.certificate(f"{REVOKED}/{entry.serial}/{CERTIFICATE_FILE}")
        if file and entry.sha256 in ("", digest(certificate)):
            return any(issued_by(certificate, ca) for ca in keystore.certificates_of(file))
    return True


class IssuedCredentials:
    """The certificates and permissions of enclaves in the ledger, without revoked certificates.

    Permissions work with a certificate for their subject, until the permissions or the certificate
    expires.  Entries that are older than every trusted CA are left out.
    """

    def __init__(self, keystore: OpenedKeystore, names: Collection[str]) -> None:
        self.ledger = keystore.ledger_file.with_values("enclave", names)
        self._permissions: defaultdict[str, list[Entry]] = defaultdict(list)
        self._certificates: defaultdict[str, dict[str, str]] = defaultdict(dict)
        revoked = revoked_serials(keystore)
        for entry in _entries_since_trusted_ca(keystore, self.ledger.entries, PERMISSIONS):
            if entry.what == "permissions":
                self._permissions[entry.enclave].append(entry)
        for entry in _entries_since_trusted_ca(keystore, self.ledger.entries, IDENTITY):
            if entry.what == "certificate" and not (
                entry.serial and int(entry.serial, 16) in revoked
            ):
                expiry = self._certificates[entry.enclave]
                last = expiry.get(entry.subject, "")
                expiry[entry.subject] = max(last, entry.not_after)

    def permissions(self, name: str) -> Sequence[tuple[Entry, str]]:
        """Return the permissions of an enclave, each with the time until which they work.

        The time is "" if no certificate has their subject.
        """
        expiry = self._certificates[name]
        return [
            (entry, min(entry.not_after, expiry.get(entry.subject, "")))
            for entry in self._permissions[name]
        ]

    def permissions_until(self, name: str) -> datetime | None:
        """Return when the last permissions of an enclave stop working; None without permissions."""
        last = max((until for _, until in self.permissions(name)), default="")
        return parse_iso(last) if last else None

    def certificates_until(self, replaced_certificate: Entry, new_subject: str | None) -> datetime:
        """Return when a replaced certificate and all earlier ones of its enclave stop working.

        A certificate works until it expires, or until the last permissions for its subject in the
        ledger expire, if that is earlier.  In three cases, only the expiry of the certificate
        counts:

        - its subject is ``new_subject``, the subject of the enclave's new certificate;
        - its subject has no unique part, because Cyclone DDS finds such a subject in other
          subjects;
        - ``new_subject`` is None, which says that certificates need no permissions.
        """
        last: defaultdict[str, str] = defaultdict(str)
        for entry in self._permissions[replaced_certificate.enclave]:
            last[entry.subject] = max(last[entry.subject], entry.not_after)
        certificates = self._certificates[replaced_certificate.enclave].items()
        return parse_iso(
            max(
                min(expiry, last[subject])
                if last[subject]
                and new_subject not in (None, subject)
                and _UNIQUE_PART.search(subject)
                else expiry
                for subject, expiry in [
                    *certificates,
                    (replaced_certificate.subject, replaced_certificate.not_after),
                ]
            )
        )


_UNIQUE_PART = re.compile(r"(?:^|,)OU=[0-9a-f]{16}(?:,|$)")
_MOST_NAMES = 200
"""Number of enclaves up to which keys are looked up one by one.

For more enclaves, the files of all enclaves are read.
"""


class KnownKeys:
    """The keys of a keystore, to compare with a key that is about to be certified."""

    def __init__(self, keystore: OpenedKeystore) -> None:
        self._keystore = keystore

    @cached_property
    def _revoked_keys(self) -> Mapping[str, str]:
        """Maps the digests of revoked keys to descriptions of the revoked certificates."""
        recorded = [entry for entry in self._keystore.entries_of("revocation") if entry.key]
        descriptions = {
            entry.key: _description(entry.subject, int(entry.serial, 16)) for entry in recorded
        }
        serials = {entry.serial for entry in recorded}
        # If an earlier ledger was put back, only the lists have the later revocations.
        listed = {f"{serial:x}" for serial in self._revoked_serials} - serials
        if listed:
            for entry in self._keystore.ledger_file.with_values("serial", listed).entries:
                if entry.what == "certificate" and entry.key and entry.serial in listed:
                    text = _description(entry.subject, int(entry.serial, 16))
                    descriptions.setdefault(entry.key, text)
        indexed = self._keystore.ledger_file.is_indexed
        known = serials if indexed else ()  # the ledger has these certificates
        for path in revoked_certificates(self._keystore.root, known):
            try:
                descriptions.update([_key_and_description(self._keystore.certificate(path))])
            except SrosError:
                if path.parent.name not in serials:
                    raise
        return descriptions

    @cached_property
    def _revoked_serials(self) -> Collection[int]:
        """The serial numbers of certificates that were revoked together with their keys."""
        serials = {
            int(revocation.serial, 16)
            for revocation in self._keystore.entries_of("revocation")
            if revocation.reason != SUPERSEDED
        }
        lists = (entry for crl in self._keystore.revocation_lists for entry in crl.revoked)
        return serials | {entry.serial for entry in lists if entry.reason != SUPERSEDED}

    @cached_property
    def _unrecorded_serials(self) -> frozenset[int]:
        """The serial numbers on copied or published lists that the ledger lacks."""
        from sros_tool.keystore.delivery.published import later_revoked_serials

        recorded = {int(entry.serial, 16) for entry in self._keystore.entries_of("revocation")}
        listed = {entry.serial for crl in self._keystore.revocation_lists for entry in crl.revoked}
        return (later_revoked_serials(self._keystore) | listed) - recorded

    def enclaves_revoked_before(self, names: Collection[str]) -> set[str]:
        """Return the enclaves in ``names`` whose last certificate was revoked, not just renewed.

        For a certificate whose revocation is not in the ledger, a revocation list decides.  If the
        ledger was lost, the lists decide on the certificates in the folder ``revoked``.
        """
        if not self._revoked_serials:
            return set()
        files = revoked_certificates(self._keystore.root)
        revocations = self._keystore.entries_of("revocation")
        enclaves, recorded = set(), {entry.serial for entry in revocations}
        for entry in self._keystore.ledger_file.with_values("enclave", names).entries:
            recorded.add(entry.serial)
            if entry.what == "certificate":
                enclaves.discard(entry.enclave)
                if entry.serial and int(entry.serial, 16) in self._revoked_serials:
                    enclaves.add(entry.enclave)
            elif entry.what == "revocation" and entry.reason != SUPERSEDED:
                enclaves.add(entry.enclave)
        for path in files:
            if path.parent.name not in recorded:
                with suppress(SrosError):  # the file is not a certificate
                    certificate = self._keystore.certificate(path)
                    if certificate.serial_number in self._revoked_serials:
                        enclaves.add(common_name_of(certificate.subject))
        return enclaves.intersection(names)

    def certificates_shown_after_restore(self, names: Collection[str]) -> Sequence[Entry]:
        """Return the ledger entries of certificates that the keystore issued after its last backup.

        Messages of robots or published releases showed them to the restored keystore.
        """
        times = {entry.time for entry in self._keystore.entries_of(RESTORED)}
        return [
            entry
            for entry in self._keystore.ledger_file.with_values("enclave", names).entries
            if entry.what == "certificate"
            and entry.enclave in names
            and (entry.reason == REPORTED or entry.time in times)
        ]

    def later_key(self, name: str, key: str) -> Entry | None:
        """Return the ledger entry of the first certificate for the newest key of an enclave.

        The newest key is the one whose validity began last, by the ledger; revoked keys do not
        count.  If ``key`` is the enclave's present key, only keys count that a robot had after the
        backup, because the operator replaced all others.  Keys that `made_unknowing` returns do not
        count, either.  The result is None if ``key`` is the newest key, or is not in the ledger.
        """
        first = self._first_certificates(name)
        if key not in first or len(first) == 1:
            return None
        shown = {entry.key for entry in self.certificates_shown_after_restore([name])}
        is_present = key == self._present_key(name)
        counts = shown if is_present else {*first}.difference(self.made_unknowing([name]))
        kept = [
            entry
            for entry in first.values()
            if entry.key == key or (entry.key in counts and not self.is_revoked(entry.key))
        ]
        # Of keys that became valid at the same time, the later one is later in the ledger, too.
        newest = max(reversed(kept), key=lambda entry: entry.not_before)
        return newest if newest.key != key else None

    def made_unknowing(
        self, names: Collection[str], unrecorded: Iterable[Entry] = ()
    ) -> dict[str, str]:
        """Map keys that a restored keystore made to their enclaves, if robots have other keys.

        The keystore made such a key after it was restored, before a message or a published release
        showed it the certificate for the robot's key, which was made after the backup and is not
        revoked.  ``unrecorded`` are such certificates that the ledger still lacks.  Only enclaves
        whose present key is in the keystore are in the result.  A message shows the certificate of
        one enclave, so enclaves that were made together with such an enclave count, too.
        """
        unrecorded = tuple(unrecorded)
        found = self._made_for_added_robots(names, unrecorded)
        shown: dict[str, list[Entry]] = defaultdict(list)
        for entry in (*self.certificates_shown_after_restore(names), *unrecorded):
            shown[entry.enclave].append(entry)
        for name in shown:
            if not (self._keystore.has_enclave(name) and has_key(self._keystore.folder(name))):
                continue
            first, own = self._first_certificates(name), self._present_key(name)
            recorded_before = [*first][: [*first].index(own)] if own in first else [*first]
            if own in first and any(
                entry.key not in (own, *recorded_before)
                and entry.not_before <= first[own].not_before
                and not self.is_revoked(entry.key)
                for entry in shown[name]
            ):
                found[own] = name
        return found

    def _made_for_added_robots(
        self, names: Collection[str], unrecorded: Sequence[Entry]
    ) -> dict[str, str]:
        """Map keys of robots that were added after the backup to their enclaves in ``names``.

        The restored keystore made these keys before it was shown that the robot has another key for
        one of its enclaves.  ``unrecorded`` is as in `made_unknowing`.
        """
        if not (unrecorded or self._keystore.entries_of(RESTORED)):
            return {}
        fleet = load_fleet(self._keystore)
        owners = (robot_of(fleet, name) for name in names) if fleet else ()
        robots = {robot.name: robot for robot in owners if robot}
        robot_by_enclave = {
            name: robot.name
            for robot in robots.values()
            for name in (enclaves_of(fleet, robot) if fleet else ())
        }
        shown = (*self.certificates_shown_after_restore(robot_by_enclave), *unrecorded)
        added: dict[str, list[Entry]] = defaultdict(list)
        for entry in shown:
            robot = robot_by_enclave.get(entry.enclave)
            if (
                robot
                and not self.is_revoked(entry.key)
                and self._is_made_later(entry.enclave, entry)
            ):
                added[robot].append(entry)
        found: dict[str, str] = {}
        for name in {*names}.difference(entry.enclave for entry in shown) if added else ():
            own = self._present_key(name)
            if (
                any(
                    self._is_made_later(name, entry)
                    for entry in added[robot_by_enclave.get(name, "")]
                )
                and has_key(self._keystore.folder(name))
                and [*self._first_certificates(name)][:1] == [own]
            ):
                found[own] = name
        return found

    def _is_made_later(self, name: str, shown: Entry) -> bool:
        """Return whether the keystore made an enclave's first key unaware of a ``shown`` one.

        The key is another one, and is newer, but was recorded before the certificate was shown.
        """
        first = next(iter(self._first_certificates(name).values()), shown)
        return (
            first.key != shown.key
            and first.not_before > shown.not_before
            and first.time <= shown.time
        )

    def _first_certificates(self, name: str) -> dict[str, Entry]:
        """Map the keys of an enclave to the entries of their first certificates.

        The keys are in the order of the ledger.
        """
        first: dict[str, Entry] = {}
        for entry in self._keystore.ledger_file.with_values("enclave", [name]).entries:
            if entry.what == "certificate" and entry.enclave == name and entry.key:
                known = first.setdefault(entry.key, entry)
                if entry.not_before < known.not_before:
                    first[entry.key] = entry
        return first

    def _present_key(self, name: str) -> str:
        """Return the digest of the key in an enclave's certificate; "" if it cannot be read."""
        with suppress(SrosError):
            return _key_digest_of(self._keystore.certificate_of(name))
        return ""

    def missing_key_notes(self) -> Iterator[Note]:
        """Yield a note if the ledger may lack keys that were revoked."""
        if gaps := self._keystore.ledger_with("what", "revocation").gaps:
            yield Note(
                "ledger.may-lack-revocations",
                f"The ledger of '{self._keystore.root}' may lack revocations: {'; '.join(gaps)}. "
                "A revoked key may get a certificate again.",
            )

    def revoked_enclaves(self) -> list[str]:
        """Return the revoked enclaves that the keystore no longer has, sorted by name."""
        revocations = self._keystore.entries_of("revocation")
        names = {entry.enclave for entry in revocations if entry.enclave}
        return sorted(self.enclaves_revoked_before(names.difference(self._keystore.names)))

    def revoked_before_notes(self, names: Iterable[str]) -> Iterator[Note]:
        """Yield a note for each new enclave in ``names`` that was revoked before."""
        names = tuple(names)
        revoked = self.enclaves_revoked_before(names) if names else ()
        for name in names:
            if name in revoked:
                yield Note(
                    "keystore.revoked-before",
                    f"{name} was revoked, and now exists again with a new key and certificate; "
                    "the old key and certificate stay revoked.",
                )

    @cached_property
    def _enclaves_by_key(self) -> Mapping[str, Sequence[str]]:
        """Maps the digest of each key to the enclaves that have the key."""

        def read(names: Sequence[str]) -> list[tuple[str, str]]:
            return [(key, name) for name in names for key in _key_digests(self._keystore, name)]

        enclaves_by_key: dict[str, list[str]] = defaultdict(list)
        for _, part in map_slices(self._keystore.names, read):
            for key, name in part:
                enclaves_by_key[key].append(name)
        return enclaves_by_key

    def is_revoked(self, key: str) -> bool:
        """Return whether the key with the digest ``key`` was revoked."""
        return key in self._revoked_keys

    def refuse_revoked_key(
        self,
        key: PublicKey,
        holder: str,
        remedy: str,
        certificate: x509.Certificate | None = None,
        *,
        publish_first: bool = True,
    ) -> None:
        """Raise the error of `revoked_key_error` if ``key`` was revoked."""
        error = self.revoked_key_error(
            key, holder, remedy, certificate, publish_first=publish_first
        )
        if error:
            raise error

    def revoked_key_error(
        self,
        key: PublicKey,
        holder: str,
        remedy: str,
        certificate: x509.Certificate | None = None,
        *,
        publish_first: bool = True,
    ) -> KeystoreError | None:
        """Return an error if ``key`` was revoked; ``holder`` names its holder in the error.

        ``certificate`` is the current certificate for the key: a backup may have restored a revoked
        certificate.  With ``publish_first``, if only published lists revoke the key, the remedy is
        to publish with --restored.  Callers set it to False while CAs have to be replaced again,
        because publishing is refused until that is done.

        Raises:
            SrosError: it is not certain which keys were revoked, because a file cannot be read.
        """
        revoked = self._revoked_keys.get(key_digest(key))
        if certificate and certificate.serial_number in self._revoked_serials:
            revoked = _key_and_description(certificate)[1]
        if revoked:
            return KeystoreError(
                f"the key of {holder} was revoked", f"It is the key of {revoked}.", remedy
            )
        if certificate and certificate.serial_number in self._unrecorded_serials:
            from sros_tool.keystore.delivery.published import (
                may_have_later_releases,
                read_published,
            )

            if publish_first and may_have_later_releases(self._keystore):
                folder = quote(read_published(self._keystore).folder)
                publish = f"sros fleet publish {quote(str(self._keystore.root))} {folder}"
                remedy = (
                    f"First run `{publish} --restored`, which revokes again what this list revokes."
                )
            return KeystoreError(
                f"the certificate of {holder} was revoked",
                "A revocation list names it, and the ledger does not: the keystore may come from a "
                "backup.",
                remedy,
            )
        return None

    def refuse_shared_key(self, key: PublicKey, name: str, remedy: str) -> None:
        """Raise `KeystoreError` if another enclave than ``name`` has ``key``."""
        if others := self._other_enclaves(key, name):
            raise KeystoreError(
                f"the key for enclave {name} is the key of enclave {others[0]}",
                "Two enclaves with one key are one identity: each can act as the other.",
                remedy,
            )

    def shared_key_notes(self, names: Sequence[str]) -> Iterator[Note]:
        """Yield a note for each enclave in ``names`` that shares its key with other enclaves."""
        if not names:
            return
        if self._keystore.ledger_file.is_indexed and len(names) <= _MOST_NAMES:
            shared = {
                name: others
                for name in names
                for key in _key_digests(self._keystore, name)
                if (others := [holder for holder in self._enclaves_with_key(key) if holder != name])
            }
        else:
            shared = {
                name: others
                for enclaves in self._enclaves_by_key.values()
                if len(enclaves) > 1
                for name in enclaves
                if (others := [enclave for enclave in enclaves if enclave != name])
            }
        for name in names:
            if name in shared:
                yield Note(
                    "keystore.key-twice",
                    f"{name} has the same key as {', '.join(shared[name])}: each enclave can "
                    f"act as the others. Renew {name} with a new key.",
                )

    def _other_enclaves(self, key: PublicKey, name: str) -> list[str]:
        return [enclave for enclave in self._enclaves_with_key(key_digest(key)) if enclave != name]

    def _enclaves_with_key(self, key: str) -> Sequence[str]:
        """Return the enclaves that have the key with the digest ``key``.

        If the ledger has an index, these are the enclaves that the ledger records for the key and
        that still have it.  A key that somebody copied to another enclave is not found here, but by
        `sros check`, which reads the files of all enclaves.
        """
        if "_enclaves_by_key" in self.__dict__ or not self._keystore.ledger_file.is_indexed:
            return self._enclaves_by_key.get(key, ())
        entries = self._keystore.ledger_file.with_values("key", (key,)).entries
        recorded = {e.enclave for e in entries if e.what == "certificate" and e.key == key}
        return [name for name in sorted(recorded) if key in _key_digests(self._keystore, name)]


def other_keys_remedy(root: Path, names: Sequence[str]) -> str:
    """Return what to do about enclaves whose robots have other keys than the keystore."""
    where, enclaves = quote(str(root)), " ".join(map(quote, names))
    return (
        f"If a robot made its key, sign its request again, with `sros sign_request {where} REQUEST "
        f"--no-answer --renew`, and run `sros renew {where} {enclaves} --revoke-old`; if the "
        "request is refused because the keystore has another key, do what the error says. "
        f"Otherwise, give new keys: `sros renew {where} {enclaves} --new-key --revoke-old`."
    )


def keys_on_robots_remedy(root: Path, names: Sequence[str]) -> str:
    """Return what to do about enclaves whose revoked keys were made on robots."""
    where, enclaves = quote(str(root)), " ".join(map(quote, names))
    return (
        "For keys that were made on the robot, first let the robot's agent run once, if there is a "
        "release that it can fetch. Then take the request.pem of each of these enclaves from the "
        f"robot, sign it with `sros sign_request {where} REQUEST --no-answer --renew`, and run "
        f"`sros renew {where} {enclaves} --revoke-old`. If the key of a request was revoked, first "
        "make a new key on the robot (docs/howto/rotate.md, A key in wrong hands). Do none of this "
        "for robots that were stolen or removed: revoke them."
    )


def lacking_enclaves_remedy(root: Path) -> str:
    """Return what to do about enclaves that a restored keystore lacks; no full stop at the end."""
    where = quote(str(root))
    return (
        "If the robot of such an enclave stays in use, and made its keys, sign its requests again: "
        f"`sros sign_request {where} REQUEST --no-answer -p POLICY_FILE --fleet FLEET_FILE "
        "--enclave ENCLAVE`. If it did not make its keys, create its enclaves again with `sros "
        f"generate_artifacts`, then give them new keys: `sros renew {where} --robot NAME --new-key "
        "--revoke-old`. To revoke such an enclave, create it again first, or replace the CA with "
        "`sros rotate_ca`"
    )


def perhaps_revoked_step(keystore: OpenedKeystore, names: Sequence[str]) -> str:
    """Return what to do about enclaves that may have been revoked after the backup."""
    root, enclaves = quote(str(keystore.root)), " ".join(map(quote, names))
    steps = (
        f"Revoke those that should not run any more: `sros revoke {root} {enclaves}`. Robots that "
        "lose all their enclaves also have to leave the fleet file."
    )
    if here := [name for name in names if not key_on_robot(keystore.folder(name))]:
        renew = f"sros renew {root} {' '.join(map(quote, here))} --new-key --revoke-old"
        steps += f" Give new keys to the others: `{renew}`."
    if len(here) < len(names):
        on_robots = [name for name in names if name not in here]
        steps += (
            f" {first_few(on_robots, 3)}, whose keys were made on robots: to keep an enclave, "
            "make a new key on its robot (docs/howto/rotate.md, A key in wrong hands)."
        )
    return steps


def new_key_clause(keystore: OpenedKeystore, name: str) -> str:
    """Return, as a clause, how to give an enclave a new key in place of a revoked one."""
    if key_on_robot(keystore.folder(name)):
        return "make a new key on its robot (docs/howto/rotate.md, A key in wrong hands)"
    return f"`sros renew {quote(str(keystore.root))} {quote(name)} --new-key --revoke-old`"


def _key_and_description(certificate: x509.Certificate) -> tuple[str, str]:
    """Return the digest of a certificate's key, and a description of the certificate."""
    text = _description(subject_text(certificate.subject), certificate.serial_number)
    return _key_digest_of(certificate), text


def _description(subject: str, serial: int) -> str:
    return f"certificate {serial_text(serial)} of {subject}"


def _key_digest_of(certificate: x509.Certificate) -> str:
    return key_digest(certificate.public_key())  # type: ignore[arg-type]


def _key_digests(keystore: OpenedKeystore, name: str) -> Iterator[str]:
    """Yield the digest of an enclave's key, from its certificate, key file or request.

    Yields nothing if all these files are missing, or if the file is damaged.
    """
    folder = keystore.folder(name)
    try:
        if (folder / CERTIFICATE_FILE).exists():
            yield _key_digest_of(keystore.certificate_of(name))
        elif (path := folder / KEY_FILE).exists():
            key = load_key(keystore.read(path, "private key"), f"'{path}'")
            yield key_digest(key.public_key())
        elif (path := folder / REQUEST).exists():  # the key is on a token
            request = load_request(keystore.read(path, "request"), f"'{path}'")
            yield key_digest(request.public_key)
    except PkiError:
        return  # a damaged file: DDS does not load it, and `sros check` reports it


# ── DDS participants ───────────────────────────────────────────────────────────────────────


def enclaves_by_identity(keystore: OpenedKeystore) -> dict[str, str]:
    """Map the DDS identity of each certificate subject (`identity_of`) to the enclave.

    A secured participant shows this identity in its GUID.  Enclaves whose certificate cannot be
    read are left out.
    """
    enclaves: dict[str, str] = {}
    for name in keystore.names:
        with suppress(SrosError):
            certificate = keystore.certificate_of(name)
            enclaves[identity_of(certificate.subject.public_bytes())] = name
    return enclaves
