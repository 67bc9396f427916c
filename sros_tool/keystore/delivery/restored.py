"""What changed after the backup of a restored keystore, as the last releases of its robots show.

A robot's release counts wherever it comes from, because the permissions CA sealed it.  So a number
that a robot invents shows nothing, but the seal of a later release shows that the keystore is older
than its robots.  Until its releases are published with ``--restored``, such a keystore neither
publishes nor renews by itself, because this would bring back rights that were taken away.
"""

from __future__ import annotations

import hashlib
import logging
import re
import textwrap
from collections import defaultdict
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from datetime import datetime
from pathlib import Path
from shlex import quote
from typing import Annotated, NamedTuple

from cryptography import x509
from cryptography.hazmat.primitives import serialization

from sros_tool.dds.governance import parse_governance, render_governance
from sros_tool.dds.permissions import parse_permissions
from sros_tool.errors import KeystoreError, Note, SrosError
from sros_tool.fleet.robots import folded_lines
from sros_tool.keystore.delivery.published import read_published
from sros_tool.keystore.delivery.release import Release, sealed_robot
from sros_tool.keystore.delivery.rollback import retired_authorities
from sros_tool.keystore.fleet import enclaves_of_robot, recorded_fleet
from sros_tool.keystore.known_keys import (
    KnownKeys,
    keys_on_robots_remedy,
    other_keys_remedy,
    perhaps_revoked_step,
)
from sros_tool.keystore.layout import (
    CERTIFICATE_FILE,
    GOVERNANCE_FILE,
    IDENTITY,
    IDENTITY_CA_FILE,
    LIST_FILES,
    PERMISSIONS,
    PERMISSIONS_CA_FILE,
    PERMISSIONS_FILE,
    enclave_folder,
    key_on_robot,
)
from sros_tool.keystore.ledger import (
    LATER_RELEASE,
    LOST_CA,
    PERHAPS_REVOKED,
    PUBLISHING,
    RECORDED_LATE,
    RENEWED_BY_NAME,
    RESTORED,
    Entry,
)
from sros_tool.keystore.lifecycle.replaced import EarlierPermissions, replaced_rights
from sros_tool.keystore.reader import OpenedKeystore
from sros_tool.pki import smime
from sros_tool.pki.certificates import (
    authority_text,
    issued_by,
    key_digest,
    key_digest_of_ca,
    load_certificates,
    subject_text,
    validity_of,
)
from sros_tool.pki.crl import SUPERSEDED, load_crls
from sros_tool.validity import iso
from sros_tool.values import Words
from sros_tool.wording import counted, first_few

_LOG = logging.getLogger(__name__)
_SHOWN = 5
_NAMED, _LONGEST = 3, 200
"""Maximum number of names in a refusal, and of characters about the rights of an enclave."""
_ENDS_OF_LIST_PATHS = tuple(f"/{file}" for file in LIST_FILES)
_WAITING = frozenset({LATER_RELEASE, PUBLISHING})
"""The reasons of restores after which the keystore publishes only with ``--restored``."""


class LaterChange(NamedTuple):
    """A change that a restored keystore lacks, because it was made after the backup."""

    change: Annotated[
        str,
        Words(
            (
                "certificate",
                "key",
                "other_key",
                "revoked",
                "rights_taken",
                "governance",
                "rights_given",
                "missing",
                "added",
            )
        ),
    ]
    """``certificate``: the certificate was replaced and revoked; ``key``: the enclave got another
    key; ``other_key``: the restored keystore made another key for the enclave than its robot has;
    ``revoked``: the enclave was revoked or removed, or may have been; ``rights_taken``: the enclave
    lost rights or ROS domains; ``governance``: the governance was changed; ``rights_given``: the
    enclave got rights or ROS domains; ``missing``: the keystore lacks the enclave; ``added``: the
    robot's last release lacks the enclave, which has a new key.  The first six keep ``--restored``
    from publishing.
    """
    enclave: str
    """Name of the enclave; empty for the governance."""
    what: str
    """The rights and domains, or the lines of the governance; empty for other changes."""


# ── whether the keystore is older than its robots ──────────────────────────────────────────


def restores_after_last_release(keystore: OpenedKeystore) -> list[str]:
    """Return the reasons of the restores that the ledger recorded after its last release."""
    entries = keystore.ledger_file.with_values("what", (RESTORED, "release")).entries
    reasons: list[str] = []
    for entry in entries:
        if entry.what == "release":
            reasons.clear()
        elif entry.what == RESTORED:
            reasons.append(entry.reason)
    return reasons


def has_unpublished_restore(keystore: OpenedKeystore) -> bool:
    """Return whether a restore is known that was not published with ``--restored`` yet."""
    return not _WAITING.isdisjoint(restores_after_last_release(keystore))


def refuse_unpublished_restore(keystore: OpenedKeystore, action: str) -> None:
    """Raise `KeystoreError` if the keystore is known to be older than its robots.

    ``action`` is what the error says must wait: a verb form, such as "Publishing".
    """
    if has_unpublished_restore(keystore):
        raise older_than_robots_error(keystore, action)


class RobotClaim(NamedTuple):
    """What a robot says in its last message about a release that was never published.

    ``release`` names the release in text, such as ``release 7``.
    """

    robot: str
    release: str


def older_than_robots_error(
    keystore: OpenedKeystore, action: str, folder: str = "", claim: RobotClaim | None = None
) -> KeystoreError:
    """Return the error for a keystore that is older than its robots, as their messages show.

    ``action`` is as in `refuse_unpublished_restore`.  ``folder`` is the publishing folder, or ""
    for the recorded one.  With ``claim``, only the message of one robot shows the keystore's age.
    """
    where = quote(str(keystore.root))
    place = quote(folder or read_published(keystore).folder or "PUB")
    shown = f"the keystore '{keystore.root}' is older than its robots, as messages or releases show"
    action, other = f"The keystore was restored from a backup, or is a copy. {action}", ""
    if claim:
        shown = (
            f"the robot {claim.robot} says that it has {claim.release}, which the keystore "
            f"'{keystore.root}' never published"
        )
        other = (
            f" If the keystore was not restored, {claim.robot} has wrong files, or sends false "
            f"messages: examine the robot, or run `sros revoke {where} --robot {claim.robot}`, so "
            "that its messages no longer count."
        )
        action = "Perhaps the keystore was restored from a backup, or is a copy: then, publishing"
    return KeystoreError(
        shown,
        f"{action} would undo later changes, such as a revocation, or bring back rights that were "
        "taken away.",
        f"Restore a later backup. If there is none, run `sros fleet collect {where} INBOX`, "
        f"revoke again what was revoked after the backup, and run `sros fleet publish {where} "
        f"{place} --restored`; docs/howto/keystore_is_lost.md has the other steps.{other}",
    )


_LISTED_FILE = re.compile(r"(?m)^([0-9a-f]{64})  (.+)$")
"""Matches the line of a file in a seal."""


class LaterSeals:
    """Recognizes the seals of releases that a keystore sealed, and does not know any more."""

    def __init__(self, keystore: OpenedKeystore) -> None:
        entries = keystore.ledger_file.with_values("what", (RESTORED, "release")).entries
        self._known = {entry.number for entry in entries if entry.what == "release"}
        self._last = max(self._known, default=0)
        self._marked = {
            entry.enclave
            for entry in entries
            if entry.what == RESTORED
            and entry.reason == PERHAPS_REVOKED
            and entry.number > self._last
        }
        # A restore that the keystore waits for, or published, explains all lower numbers; a restore
        # that only a revocation list showed keeps the keystore from nothing.
        marks = [e for e in entries if e.what == RESTORED and e.reason in _WAITING]
        self._explained = max((mark.number for mark in marks), default=0)
        self._restored = max((mark.time for mark in marks), default="")
        self._authorities = keystore.authority(PERMISSIONS)
        self._keystore = keystore

    def later_number(self, seal: str | None) -> int:
        """Return the number in a seal if a CA signed it and the ledger lacks the number, or 0."""
        with suppress(SrosError):
            if seal:
                number = sealed_robot(seal.encode()).number
                is_unknown = number > self._explained and number not in self._known
                signed = smime.parse(seal.encode())
                if is_unknown and not signed.problem_for(self._authorities):
                    return 0 if self._has_issued(signed.text) else number
        return 0

    def missing_enclaves(self, seal: str | None) -> set[str]:
        """Return the keystore's enclaves that a later release of their robot, by its seal, lacks.

        They were revoked or removed after the backup.  Enclaves that the ledger has as perhaps
        revoked since the last release are left out.
        """
        with suppress(SrosError):
            if seal and sealed_robot(seal.encode()).number > self._last:
                signed, fleet = smime.parse(seal.encode()), recorded_fleet(self._keystore)
                member = fleet.robots.get(sealed_robot(seal.encode()).robot)
                is_sealed = not signed.problem_for(self._authorities)
                if member and is_sealed and not self._has_issued(signed.text):
                    listed = {path for _, path in _LISTED_FILE.findall(signed.text.decode())}
                    return {
                        name
                        for name in enclaves_of_robot(self._keystore, fleet, member)
                        if f"{enclave_folder(name)}/{CERTIFICATE_FILE}" not in listed
                    } - self._marked
        return set()

    def lost_ca_issued(self, seal: str | None, certificate: x509.Certificate) -> bool:
        """Return whether a seal lists a certificate of an identity CA that the keystore has lost.

        The seal is that of a later release (`later_number`), so the keystore issued the
        certificate.  A certificate from before the present CA shows nothing: the CA was replaced
        again since.
        """
        with suppress(SrosError):
            authorities = self._keystore.authority(IDENTITY)
            is_earlier = (
                validity_of(certificate).not_before < validity_of(authorities[0]).not_before
            )
            if is_earlier or any(issued_by(certificate, each) for each in authorities):
                return False
            pem = certificate.public_bytes(serialization.Encoding.PEM)
            sha256 = hashlib.sha256(pem).hexdigest()
            files = _LISTED_FILE.findall(smime.parse((seal or "").encode()).text.decode())
            return any(
                listed == sha256 and path.endswith(f"/{CERTIFICATE_FILE}") for listed, path in files
            )
        return False

    def explains(self, seal: str | None, certificate: x509.Certificate) -> bool:
        """Return whether a known restore explains that the ledger lacks a robot's certificate.

        This is so if the robot's release, by its seal, and the certificate are from before the
        restore.
        """
        with suppress(SrosError):
            if seal and iso(validity_of(certificate).not_before) <= self._restored:
                is_earlier = sealed_robot(seal.encode()).number <= self._explained
                return is_earlier and not smime.parse(seal.encode()).problem_for(self._authorities)
        return False

    def _has_issued(self, seal_text: bytes) -> bool:
        """Return whether the keystore issued all files that a seal lists, except certificates.

        If so, publishing was only interrupted before the ledger recorded the number of the release,
        and everybody who can read the folder has the seal.  Certificates need no comparison,
        because permissions are signed again with each new certificate.
        """
        listed = _LISTED_FILE.findall(seal_text.decode())
        digests = {sha256 for sha256, _ in listed}
        try:
            entries = self._keystore.ledger_file.with_values("sha256", digests).entries
            issued = {entry.sha256 for entry in entries}
            return bool(listed) and all(
                sha256 in issued
                or path.endswith(f"/{CERTIFICATE_FILE}")
                or hashlib.sha256(self._keystore.read(path, "file")).hexdigest() == sha256
                for sha256, path in listed
            )
        except SrosError:  # the keystore lacks the file, or a part of the ledger
            return False


# ── what changed ───────────────────────────────────────────────────────────────────────────


def later_changes(
    keystore: OpenedKeystore, last: Mapping[str, Release | None], now: datetime
) -> list[LaterChange]:
    """Return the changes that the last releases of robots show and the keystore lacks.

    ``last`` maps robots to their last releases; None stands for a release that cannot be read.
    Certificates that were revoked are left out, because only the revocation lists show them.
    Documents that the keystore knows show no later change, whatever it has signed since.
    """
    fleet, changes = recorded_fleet(keystore), list[LaterChange]()
    releases = [release for release in last.values() if release]
    known = _issued_digests(keystore, releases)
    for robot, release in sorted(last.items()):
        member = fleet.robots.get(robot)
        own = enclaves_of_robot(keystore, fleet, member) if member else ()
        if release is None:
            text = f"not known, because the archive of the last release of {robot} cannot be read"
            changes += (LaterChange("rights_taken", name, text) for name in own)
            continue
        sent = release.enclaves()
        changes += (LaterChange("added", name, "") for name in own if name not in sent)
        for name, files in sent.items():
            if keystore.has_enclave(name):
                changes += _changes_of(keystore, name, files, known, now)
            else:
                changes.append(LaterChange("missing", name, ""))
    if releases:
        changes += _governance_change(keystore, max(releases, key=lambda e: e.number), known)
    missing = [change.enclave for change in changes if change.change == "missing"]
    revoked = KnownKeys(keystore).enclaves_revoked_before(missing) if missing else ()
    return [change for change in changes if change.enclave not in revoked]


def enclaves_of_removed_robots(
    keystore: OpenedKeystore, last: Mapping[str, Release | None], published: Collection[str]
) -> set[str]:
    """Return the keystore's enclaves of robots that later releases show as revoked or removed.

    These are robots without a release, and robots that are not among the ``published`` ones, whose
    releases the present metadata has (empty without metadata).  ``last`` is as in `later_changes`.
    """
    if not _shows_later_changes(keystore, last):
        return set()
    fleet = recorded_fleet(keystore)
    return {
        name
        for robot, member in fleet.robots.items()
        if robot not in last or (published and robot not in published)
        for name in enclaves_of_robot(keystore, fleet, member)
    }


def _shows_later_changes(keystore: OpenedKeystore, last: Mapping[str, Release | None]) -> bool:
    """Return whether the keystore does not know the latest of the releases that can be read."""
    latest = max((release.number for release in last.values() if release), default=None)
    return latest is not None and latest not in keystore.known_releases


def perhaps_revoked_enclaves(
    keystore: OpenedKeystore, last: Mapping[str, Release | None], earlier: Sequence[Release]
) -> set[str]:
    """Return the keystore's enclaves that were revoked or removed after the backup, or may be.

    ``last`` is as in `later_changes`; ``earlier`` are other sealed releases.  The seals prove what
    is in a release, so this also finds what an identity CA revoked that the keystore has lost:

    - A release that the keystore does not know lacks the enclave.
    - A revocation list in a release has a certificate for the enclave's key, and no last release
      has a valid certificate for this key.
    - The last release of the robot lacks revocations of the latest release, or cannot be read, and
      neither the ledger nor a release shows the certificates that were revoked.
    """
    if not _shows_later_changes(keystore, last):
        return set()
    known = keystore.known_releases
    readable = [release for release in last.values() if release]
    latest = max(readable, key=lambda release: release.number)
    revoked = _revoked_serials_in([*readable, *earlier])
    shown = {
        certificate.serial_number: (name, _key_of(certificate))
        for release in (*readable, *earlier)
        for name, certificate in _certificates_in(release)
    }
    recorded = keystore.ledger_file.with_values("serial", [f"{each:x}" for each in revoked]).entries
    explained = {entry.serial for entry in recorded}
    unexplained = {
        serial
        for serial, reason in _revoked_serials_in([latest]).items()
        if reason != SUPERSEDED and serial not in shown and f"{serial:x}" not in explained
    }
    found, fleet = set[str](), recorded_fleet(keystore)
    for robot, member in fleet.robots.items():
        own, release = enclaves_of_robot(keystore, fleet, member), last.get(robot)
        listed = _revoked_serials_in([release]) if release else {}
        if unexplained - listed.keys():
            found |= {*own}
        elif release and release.number not in known:
            found |= {*own} - release.enclaves().keys()
    valid_keys = {
        _key_of(certificate)
        for release in readable
        for _, certificate in _certificates_in(release)
        if certificate.serial_number not in revoked
    }
    for name, key in (shown[serial] for serial in revoked if serial in shown):
        with suppress(SrosError):  # without a certificate, nothing is published
            if key not in valid_keys and _key_of(keystore.certificate_of(name)) == key:
                found.add(name)
    return found


def _revoked_serials_in(releases: Iterable[Release]) -> dict[int, str]:
    """Map the serial numbers on all revocation lists in releases to the reasons for revocation.

    A serial number is mapped to `SUPERSEDED` only if all lists have this reason.
    """
    documents = {
        data
        for release in releases
        for path, data in release.files.items()
        if path.endswith(_ENDS_OF_LIST_PATHS)
    }
    reasons: dict[int, str] = {}
    for document in documents:
        with suppress(SrosError):  # a file of CAs without a list
            for crl in load_crls(document, "in a release"):
                for entry in crl.revoked:
                    if reasons.get(entry.serial, SUPERSEDED) == SUPERSEDED:
                        reasons[entry.serial] = entry.reason
    return reasons


def _certificates_in(release: Release) -> Iterator[tuple[str, x509.Certificate]]:
    """Yield the enclaves in a release with their certificates."""
    for name, files in release.enclaves().items():
        with suppress(SrosError):
            yield name, load_certificates(files.get(CERTIFICATE_FILE, b""), name)[0]


def _key_of(certificate: x509.Certificate) -> str:
    return key_digest(certificate.public_key())  # type: ignore[arg-type]


def with_earlier_keys(keystore: OpenedKeystore, perhaps_revoked: Iterable[str]) -> list[str]:
    """Return the perhaps revoked enclaves that still have a key from before the restore.

    The enclaves are those given, and those that earlier runs or messages of robots showed after the
    last release (`PERHAPS_REVOKED` in the ledger).
    """
    last = keystore.last_release

    def is_mark(entry: Entry) -> bool:
        is_later = entry.what == RESTORED and entry.number > last
        return is_later and entry.reason == PERHAPS_REVOKED

    marks = filter(is_mark, keystore.entries_of(RESTORED))
    names = {*perhaps_revoked, *(mark.enclave for mark in marks)}
    marked = set[str]()
    earlier, later = defaultdict[str, set[str]](set), defaultdict[str, set[str]](set)
    for entry in keystore.ledger_file.with_values("enclave", names).entries if names else ():
        if is_mark(entry):
            marked.add(entry.enclave)
        elif entry.what == "certificate":
            keys = later if entry.enclave in marked else earlier
            keys[entry.enclave].add(entry.key)
    kept = []
    for name in sorted(names):
        with suppress(SrosError):  # it was revoked, or has no certificate to publish
            key = _key_of(keystore.certificate_of(name))
            if key not in later[name] - earlier[name]:
                kept.append(name)
    return kept


def _issued_digests(keystore: OpenedKeystore, releases: Sequence[Release]) -> frozenset[str]:
    """Return the SHA-256 of the signed documents in ``releases`` that the keystore issued."""
    files = (PERMISSIONS_FILE, GOVERNANCE_FILE)
    digests = {
        hashlib.sha256(data).hexdigest()
        for release in releases
        for path, data in release.files.items()
        if path.rpartition("/")[2] in files
    }
    entries = keystore.ledger_file.with_values("sha256", digests).entries
    return frozenset(digests.intersection(entry.sha256 for entry in entries))


def _changes_of(
    keystore: OpenedKeystore,
    name: str,
    files: Mapping[str, bytes],
    known: Collection[str],
    now: datetime,
) -> Iterator[LaterChange]:
    """Yield the changes of an enclave that ``files`` of its last release show.

    ``known`` has the SHA-256 of documents that the keystore issued: they show no change.
    """
    certificate = None
    with suppress(SrosError):  # without a certificate on one side, no key was replaced
        certificate = load_certificates(files.get(CERTIFICATE_FILE, b""), name)[0]
        if _has_earlier_key(keystore, name, certificate, now):
            yield LaterChange("key", name, "")
    sent = files.get(PERMISSIONS_FILE, b"")
    if hashlib.sha256(sent).hexdigest() in known:
        return
    own = None
    with suppress(SrosError):  # publishing refuses this robot
        own = keystore.enclave(name, now=now).grant
    if own is None:
        return
    later = None
    with suppress(SrosError):
        subject = subject_text(certificate.subject) if certificate else ""
        later = parse_permissions(smime.parse(sent).text).grant_of(subject)
    if later is None or certificate is None:
        text = "not known, because the permissions in the last release cannot be read"
        yield LaterChange("rights_taken", name, text)
        return
    difference = replaced_rights(name, EarlierPermissions(certificate, later), own, now)
    if taken := difference.gained_text():
        yield LaterChange("rights_taken", name, taken)
    if given := difference.lost_text():
        yield LaterChange("rights_given", name, given)


def _has_earlier_key(
    keystore: OpenedKeystore, name: str, later: x509.Certificate, now: datetime
) -> bool:
    """Return whether the keystore's key of an enclave is older than the key in a certificate.

    The seal shows this even if the keystore has lost the identity CA of the release.  If both keys
    became valid at the same time (their settings may choose a date), the older key is the one that
    the ledger had first.
    """
    own = keystore.certificate_of(name)
    later_key, own_key = (key_digest(each.public_key()) for each in (later, own))  # type: ignore[arg-type]
    if own_key == later_key:
        return False
    entries = keystore.ledger_file.with_values("enclave", [name]).entries

    def first_times(certificate: x509.Certificate, key: str, recorded: str) -> tuple[str, str]:
        """Return when a key's validity began, and when the ledger recorded the key first.

        For a key that is not in the ledger, the times are those of ``certificate`` and
        ``recorded``.  All times are in ISO 8601 (UTC).
        """
        issued = (
            (entry.not_before, entry.time)
            for entry in entries
            if entry.what == "certificate" and entry.key == key
        )
        return min(issued, default=(iso(validity_of(certificate).not_before), recorded))

    return first_times(own, own_key, "") < first_times(later, later_key, iso(now))


def _governance_change(
    keystore: OpenedKeystore, release: Release, known: Collection[str]
) -> Iterator[LaterChange]:
    """Yield the change if a release has another governance, whose SHA-256 is not in ``known``."""
    paths = (path for path in release.files if path.endswith(f"/{GOVERNANCE_FILE}"))
    sent = release.files[next(paths)]
    if hashlib.sha256(sent).hexdigest() in known:
        return
    own = later = None
    with suppress(SrosError):  # publishing refuses all robots if their governance is damaged
        own = keystore.governance
    with suppress(SrosError):
        later = parse_governance(smime.parse(sent).text)
    if own and own != later:
        lines = (set(render_governance(each).decode().split("\n")) for each in (later, own) if each)
        texts = (
            _ELEMENT.sub(r"\1 \2", line.strip())
            for line in sorted(next(lines) - next(lines, set()))
        )
        yield LaterChange("governance", "", first_few([*texts], _SHOWN) if later else "")


_ELEMENT = re.compile(r"<(\w+)>(.*)</\w+>")


# ── what keeps `--restored` from publishing ────────────────────────────────────────────────


def without_agreed_changes(
    keystore: OpenedKeystore, changes: Sequence[LaterChange]
) -> list[LaterChange]:
    """Return ``changes`` without rights and governance that were signed again on purpose.

    Rights count as agreed to if publishing was refused only because of rights, and their enclave
    was then renewed by name.  Other commands that sign rights, such as a rotation, agree to none.
    A governance counts as agreed to if publishing was refused, the governance was then signed
    again, and it lacks no known line of the published governance.
    """
    last = keystore.last_release
    named, agreed = set[str](), set[str]()
    names = {change.enclave for change in changes if change.change == "rights_taken"}
    for entry in keystore.ledger_file.with_values("enclave", names).entries if names else ():
        if entry.what == RESTORED and entry.reason == PUBLISHING and entry.number > last:
            named.add(entry.enclave)
        elif entry.reason == RENEWED_BY_NAME and entry.enclave in named:
            agreed.add(entry.enclave)
    is_refused = is_governance_agreed = False
    kinds = ("governance", RESTORED)
    for entry in keystore.ledger_file.with_values("what", kinds).entries:
        if entry.what == RESTORED and entry.number > last:
            is_refused |= entry.reason == PUBLISHING
        elif entry.what == "governance" and not entry.reason:
            is_governance_agreed = is_refused
    return [
        change
        for change in changes
        if not (
            (change.change == "rights_taken" and change.enclave in agreed)
            or (change.change == "governance" and not change.what and is_governance_agreed)
        )
    ]


def refuse_lost_changes(
    keystore: OpenedKeystore, folder: Path, changes: Sequence[LaterChange]
) -> None:
    """Raise `KeystoreError` if publishing to ``folder`` would undo changes after the backup.

    One error names all changes, so that the remedy for one does not undo another in silence.  If
    the only lost changes are rights that were taken away, the error asks for consent to the rights.
    """
    root, names = quote(str(keystore.root)), defaultdict[str, list[str]](list)
    for change in changes:
        names[change.change].append(change.enclave)
    what: list[str] = []
    steps: list[str] = []

    def shown(enclaves: Sequence[str]) -> str:
        few = len(enclaves) <= _NAMED
        return ", ".join(enclaves) if few else counted(len(enclaves), "enclave")

    def renew(enclaves: Sequence[str], options: str = "") -> str:
        return f"`sros renew {root} {' '.join(map(quote, enclaves))}{options}`"

    if certificates := names["certificate"]:
        what.append(f"the certificates of {shown(certificates)} were replaced and revoked")
        steps.append(f"Give new certificates: {renew(certificates)}.")
    if keys := names["key"]:
        # Only a later certificate shows whether the key was replaced, too; a message may lack it.
        what.append(f"the keys of {shown(keys)} were replaced or revoked, or may have been")
        on_robots = [name for name in keys if key_on_robot(keystore.folder(name))]
        if here := [name for name in keys if name not in on_robots]:
            steps.append(other_keys_remedy(keystore.root, here))
        if on_robots:
            steps.append(keys_on_robots_remedy(keystore.root, on_robots))
    if others := names["other_key"]:
        what.append(f"robots got other keys for {shown(others)} than the keystore has")
        steps.append(other_keys_remedy(keystore.root, others))
    if revoked := names["revoked"]:
        what.append(f"{shown(revoked)} may have been revoked or removed")
        steps.append(perhaps_revoked_step(keystore, revoked))
    if missing := names["missing"]:
        steps.append(_missing_step(root, missing))
    if rights := names["rights_taken"]:
        taken = [
            (e.enclave, f"{e.enclave}: {e.what}") for e in changes if e.change == "rights_taken"
        ]
        why = _few_changes(keystore, taken, "right that was taken away after the backup")
        perhaps = ", or may have been" * any(": not known, because" in text for _, text in taken)
        what.append(f"rights of {shown(rights)} were taken away{perhaps} ({why})")
        steps.append("Sign the present policy again, with `sros generate_artifacts`.")
        if not (certificates or keys or others or revoked or names["governance"]):
            steps.append(f"If the enclaves are to have these rights, run {renew(rights)}.")
    for change in changes:
        if change.change == "governance":
            what.append(f"the governance was changed{f' ({change.what})' if change.what else ''}")
            again = f"`sros update_keystore {root} --set KEY=VALUE`"
            steps.append(
                f"Restore the governance that was published last, with {again}; make other "
                "changes only after publishing."
            )
    is_list = len(steps) > 1
    numbered = (f"({at}) {step}" if is_list else step for at, step in enumerate(steps, 1))
    if what:
        raise KeystoreError(
            f"nothing can be published in '{folder}' yet: after the backup, {'; '.join(what)}",
            "Publishing would undo this.",
            f"{' '.join(numbered)} Then repeat this command, with --restored.",
        )


def _few_changes(keystore: OpenedKeystore, lines: Sequence[tuple[str, str]], label: str) -> str:
    """Return the first texts about enclaves, shortened; log all texts with ``label`` in front.

    ``lines`` are pairs of an enclave and a text; equal texts about several robots become one text.
    """
    texts = [" ".join(text.split()) for text in folded_lines(recorded_fleet(keystore), lines)]
    for text in texts:
        _LOG.info("%s: %s", label, text)
    short = [textwrap.shorten(text, _LONGEST, placeholder=" ...") for text in texts[:_NAMED]]
    return "; ".join(short) + ("; -v shows more" if short != texts else "")


def _missing_step(root: str, missing: Sequence[str]) -> str:
    """Return what to do before the policy is signed, because the keystore lacks enclaves.

    Signing the policy would make new keys for them; releases do not show who made the present keys.
    """
    return (
        f"The keystore lacks {first_few(missing, _NAMED)}, which robots have. If a robot made the "
        "key of such an enclave, sign its request again before you sign the policy, with `sros "
        f"sign_request {root} REQUEST --no-answer -p POLICY_FILE --fleet FLEET_FILE`."
    )


def rotation_command(keystore: OpenedKeystore, roles: Sequence[str] = (IDENTITY,)) -> str:
    """Return the command that replaces CAs that were replaced after the backup, in backquotes."""
    has_own_ca = len(keystore.authority_files) > 1
    flag = f" --{roles[0]}" if has_own_ca and len(roles) == 1 else ""
    return f"`sros rotate_ca {quote(str(keystore.root))}{flag} --finish --allow-unconfirmed`"


def _replaced_authorities_error(
    keystore: OpenedKeystore, replaced_roles: Sequence[str], evidence: str
) -> KeystoreError:
    """Return the error that CAs were replaced after the backup; ``evidence`` shows it."""
    roles = replaced_roles if len(keystore.authority_files) > 1 else replaced_roles[:1]
    names = " and ".join(f"the {role} CA" for role in roles)
    options = " ".join(f"--{role}-ca FILE --{role}-key PLACE" for role in roles)
    by_hand = (
        " Otherwise, also bring each robot its files by hand (`sros distribute_key "
        f"{quote(str(keystore.root))} --robot NAME FOLDER --force`), because a robot accepts a "
        "release only if it trusts the CA that sealed the release."
    ) * (PERMISSIONS in replaced_roles)
    return KeystoreError(
        f"{names} {'was' if len(roles) == 1 else 'were'} replaced after the backup of the "
        f"keystore '{keystore.root}'",
        f"{evidence} Publishing would put robots back on an earlier CA, whose key somebody may "
        "have copied.",
        "Restore a backup from after the rotation. If there is none, repeat later revocations, "
        f"repeat the rotation ({rotation_command(keystore, roles)}), and repeat this command. If "
        f"you have the key of each later CA, add {options} to the command of the rotation, so that "
        f"the keystore uses the later CA again (docs/howto/keystore_is_lost.md).{by_hand}",
    )


def refuse_lost_ca(keystore: OpenedKeystore) -> None:
    """Raise `KeystoreError` if messages showed certificates of an identity CA that was lost.

    An identity CA that the ledger records after these messages mends this.
    """
    current = key_digest_of_ca(keystore.ca_certificate(IDENTITY))
    is_lost = False
    for entry in keystore.ledger_with("what", RESTORED).entries:
        if entry.what == "ca" and entry.key == current and entry.reason not in RECORDED_LATE:
            is_lost = False
        elif entry.what == RESTORED and entry.reason == LOST_CA:
            is_lost = True
    if is_lost:
        evidence = "Robots have certificates of a later CA, as their messages show."
        raise _replaced_authorities_error(keystore, (IDENTITY,), evidence)


def check_authorities(keystore: OpenedKeystore, folder: Path, last: Release) -> None:
    """Refuse to publish with CAs that were replaced after the backup.

    Raises:
        KeystoreError: the keystore has a CA that the release ``last`` shows as replaced, or
            lacks the newest CA.
    """
    replaced: dict[str, x509.Certificate] = {}
    for role, file in ((IDENTITY, IDENTITY_CA_FILE), (PERMISSIONS, PERMISSIONS_CA_FILE)):
        own = keystore.authority(role)
        published = [
            authority
            for path, data in last.files.items()
            if path.endswith(f"/{file}")
            for authority in load_certificates(data, path)
        ]
        newest = max([*own, *published], key=lambda each: validity_of(each).not_before)
        lost = key_digest_of_ca(newest) not in map(key_digest_of_ca, own)
        if lost or retired_authorities(published, own):
            replaced[role] = newest
    if not replaced:
        return
    later_ones = " and ".join(dict.fromkeys(map(authority_text, replaced.values())))
    evidence = f"With the last release in '{folder}', robots trust {later_ones}."
    raise _replaced_authorities_error(keystore, tuple(replaced), evidence)


def other_changes_notes(keystore: OpenedKeystore, changes: Sequence[LaterChange]) -> Iterator[Note]:
    """Yield a note on changes that do not keep the keystore from publishing."""
    texts = {
        "rights_given": "has rights there that the keystore does not give: {}",
        "added": "is missing there",
    }
    lines = [
        (change.enclave, f"{change.enclave} {texts[change.change].format(change.what)}")
        for change in changes
        if change.change in texts
    ]
    missing = [change.enclave for change in changes if change.change == "missing"]
    sentences = [_missing_step(quote(str(keystore.root)), missing)] if missing else []
    if lines:
        shown = _few_changes(keystore, lines, "difference from the releases after the backup")
        sentences.append(f"The releases after the backup differ from the keystore: {shown}.")
    if sentences:
        sentences.append(
            "Sign the present policy and fleet again, with `sros generate_artifacts`; revoke "
            "enclaves that robots should not have."
        )
        yield Note("fleet.changed-after-backup", " ".join(sentences))
