"""Messages of robots in an inbox: verify and keep them, and sign their requests for renewal.

An inbox is a folder with a file ``<robot>/confirmation.p7s`` for each robot that fetches.  The file
is the robot's confirmation, signed with the key of one of its enclaves.  Whoever runs the web
server or carries the folder can write anything into it.  So a message counts only after its
signature, certificate, robot and sequence number were verified.  A refused message does not stop
the others.
"""

from __future__ import annotations

import errno
import hashlib
import os
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import nullcontext, suppress
from dataclasses import dataclass, field, replace
from datetime import datetime
from functools import cached_property
from itertools import islice
from pathlib import Path
from shlex import quote
from typing import Annotated, NamedTuple, Unpack

from cryptography import x509

from sros_tool.dds.decision.vendors import Vendor
from sros_tool.errors import DocumentError, KeystoreError, Note, PkiError, SrosError
from sros_tool.fleet.robots import RENEWAL_ALLOWED, Fleet, Robot, enclaves_of, robot_of
from sros_tool.folders import Folder
from sros_tool.keystore.confirmation import (
    LONGEST_REASON,
    LOW_SEQUENCE,
    MAX_BYTES,
    MESSAGE_FILE,
    NOT_IN_LEDGER,
    Confirmation,
    LastMessage,
    ReceivedConfirmation,
    RefusedMessage,
    last_confirmation,
    locked_confirmations,
    parse_confirmation,
    refusals,
    store_confirmation,
    store_refusals,
)
from sros_tool.keystore.delivery.published import may_have_later_releases, read_published
from sros_tool.keystore.delivery.restored import (
    LaterSeals,
    has_unpublished_restore,
    rotation_command,
)
from sros_tool.keystore.delivery.signing import certify_requests
from sros_tool.keystore.expiry import read_credentials
from sros_tool.keystore.fleet import checked_fleet, enclaves_of_robot, recorded_fleet
from sros_tool.keystore.issuing.keyring import IN_KEYSTORE, Keyring
from sros_tool.keystore.known_keys import (
    KnownKeys,
    perhaps_revoked_step,
    restored_at,
    revoked_serials,
)
from sros_tool.keystore.layout import CERTIFICATE_FILE, IDENTITY, confirmation_file, enclave_folder
from sros_tool.keystore.ledger import LATER_RELEASE, REPORTED, Entry
from sros_tool.keystore.lifecycle.change import ChangeOptions, KeystoreChange
from sros_tool.keystore.lifecycle.revocation_list import LostRecords
from sros_tool.keystore.lifecycle.revoke import (
    REVOKED_AGAIN,
    restore_revocations,
    restored_list_note,
)
from sros_tool.keystore.outcomes import changes_below
from sros_tool.keystore.reader import OpenedKeystore
from sros_tool.names import check_enclave_name
from sros_tool.pki import smime
from sros_tool.pki.certificates import (
    SigningRequest,
    digest,
    issued_by,
    key_digest,
    load_request,
    validity_of,
)
from sros_tool.pki.chains import chain_fault
from sros_tool.pki.crl import SUPERSEDED
from sros_tool.validity import Window, elapsed, iso, parse_duration, parse_iso, time_of_file
from sros_tool.values import DryRun, FileChange, FileChanges, NamedKeystore, Notes, Words
from sros_tool.wording import counted, first_few, serial_text

_MOST_NAMES = 100_000
"""Maximum number of names that sros reads in an inbox to find folders that belong to no robot."""
_SHOWN = 5
_MOST_SEARCHES = 4
"""Number of certificates up to which a ledger without index is searched once per certificate."""


# ── outcomes of messages and requests ──────────────────────────────────────────────────────

REQUEST_OUTCOMES = ("renewed", "answered", "not_due", "not_allowed", "refused", "not_signed")
_GOOD = REQUEST_OUTCOMES[:3]
MESSAGE_OUTCOMES = ("kept", "unchanged", "older", "missing", "revoked", "refused")


class CollectedRequest(NamedTuple):
    """A request for renewal, and its outcome."""

    enclave: str
    """The enclave of the request; empty if the request cannot be read."""
    key_sha256: str
    """SHA-256 of the public key (DER) in the request, in hexadecimal; empty if the request
    cannot be read.
    """
    outcome: Annotated[str, Words(REQUEST_OUTCOMES)]
    """``renewed``: the enclave has a new certificate; ``answered``: the enclave already has a new
    certificate, which comes with the next release; ``not_due``: too early; ``not_allowed``: the
    fleet file does not allow it; ``refused``: the request must not be signed; ``not_signed``: the
    CAs cannot sign now.
    """
    why: str
    """The reason as a clause; empty for ``renewed``."""


class CollectedMessage(NamedTuple):
    """The outcome of a robot's message."""

    robot: str
    """Name of the robot."""
    outcome: Annotated[str, Words(MESSAGE_OUTCOMES)]
    """``kept``: a new message, now the robot's last confirmation; ``unchanged``: the same message
    as last time, even if its certificate was revoked since then; ``older``: a message from before
    the last one, for example in an inbox that the robot used before; ``missing``: the inbox has no
    message; ``revoked``: all enclaves of the robot were revoked, so its message is not read;
    ``refused``: the message proves nothing.
    """
    why: str
    """Why the message was refused or not read, as a clause; empty for other outcomes."""
    enclave: str
    """The enclave whose key signed the message; empty if no message was verified."""
    sequence: int | None
    """Sequence number of the message; null if no message was verified."""
    remarks: Sequence[str]
    """Remarks (clauses), for example about the robot's clock or an expired certificate."""
    requests: Sequence[CollectedRequest]
    """The requests for renewal in the message."""
    shared_keys: bool
    """Whether two computers seem to have the robot's keys, or its disk was restored: the message
    came from an earlier start of the computer than the message before it, or shows an earlier
    release. The exit status of this run is then 1; `sros fleet status` exits with 1 for up to a
    day.
    """


class PublishedAnswers(NamedTuple):
    """The releases that were published after collecting an inbox."""

    folder: Path
    """The publishing folder, as given by the user."""
    robots: Sequence[str]
    """Robots with a new release, sorted by name."""
    refused: Sequence[str]
    """Robots whose release was refused, because an enclave cannot run."""
    altered: Sequence[str]
    """Published files that were missing, changed, older than published or foreign, as with ``sros
    fleet publish``.
    """


class CollectedInbox(NamedTuple):
    """The messages of an inbox, and their outcomes."""

    keystore: NamedKeystore
    inbox: Path
    """The folder with the messages, as given by the user."""
    robots: Sequence[CollectedMessage]
    """The outcome for each robot of the fleet, sorted by name."""
    not_signed: str
    """Why the CAs could not sign requests, as a clause; the exit status is then 2. Empty if no CA
    failed.
    """
    published: PublishedAnswers | None
    """What ``--publish`` published; null without this option, or if publishing failed."""
    dry_run: DryRun
    changes: FileChanges
    notes: Notes

    @property
    def has_new_files(self) -> bool:
        """Whether the keystore has new files that robots should get."""
        requests = (request for robot in self.robots for request in robot.requests)
        renewed = any(request.outcome == "renewed" for request in requests)
        return renewed or any(note.id == REVOKED_AGAIN for note in self.notes)

    @property
    def complete(self) -> bool:
        """Whether nothing was refused, every request that may be signed was signed, and no two
        computers seem to have the keys of a robot.
        """
        if self.published and self.published.refused:
            return False
        requests = (request for robot in self.robots for request in robot.requests)
        is_suspect = any(robot.outcome == "refused" or robot.shared_keys for robot in self.robots)
        return not is_suspect and all(request.outcome in _GOOD for request in requests)


def collect(
    root: Path,
    inbox: Path,
    *,
    now: datetime,
    restored: Collection[str] = (),
    allow_refusal: Sequence[Vendor] = (),
    keyring: Keyring = IN_KEYSTORE,
    dry_run: bool = False,
) -> CollectedInbox:
    """Verify and keep the messages in ``inbox``, and sign the requests that the fleet file allows.

    Args:
        root: the keystore.
        inbox: the folder with a folder for each robot.
        now: the current time.
        restored: robots whose disk was restored; a lower sequence number is accepted from them
            once.
        allow_refusal: vendors whose nodes may stop working because of a renewal.
        keyring: opens the keys of the CAs.
        dry_run: change nothing.

    Raises:
        KeystoreError: the keystore has no fleet, or cannot be read; another process collects
            messages, too.
        DocumentError: ``restored`` has a name that no robot of the fleet has; the inbox is not a
            folder.
    """
    recorded_fleet(OpenedKeystore(root))
    with nullcontext() if dry_run else locked_confirmations(root):
        keystore = OpenedKeystore(root)
        refused_before = refusals(keystore)
        fleet = checked_fleet(keystore)
        assert fleet
        for name in restored:
            fleet.robot(name)
        verifier = _Verifier(keystore, fleet, now, frozenset(restored))
        renewals = _Renewals(keystore, fleet, now)
        forgotten, seals = LostRecords(keystore, now), LaterSeals(keystore)
        robots_with_lists: list[str] = []
        robots_with_seals: list[str] = []
        changes: list[FileChange] = []
        taken: list[_ReceivedMessage] = []
        for message in _read_inbox(inbox, fleet, verifier):
            if message.verified:
                message.requests = renewals.decide(message.robot, message.verified)
                message.crl = message.verified.confirmation.crl
                message.seal = message.verified.confirmation.seal
            if message.crl and forgotten.add(message.crl.encode()):
                robots_with_lists.append(message.robot.name)
            if number := seals.later_number(message.seal):
                robots_with_seals.append(message.robot.name)
                forgotten.later_number = max(number, forgotten.later_number)
            forgotten.perhaps_revoked |= seals.missing_enclaves(message.seal)
            if message.signer_certificate:
                if number and seals.lost_ca_issued(message.seal, message.signer_certificate):
                    forgotten.has_lost_ca = True
                forgotten.add_certificate(
                    message.signer_certificate,
                    REPORTED,
                    explained=seals.explains(message.seal, message.signer_certificate),
                )
            if message.received:
                path = confirmation_file(message.robot.name)
                action = "replace" if (root / path).exists() else "create"
                changes.append(FileChange(action, str(root / path)))
                if not dry_run:
                    # Kept now: if this run is killed, the next run decides on the same requests.
                    store_confirmation(keystore, message.received)
            taken.append(message.without_confirmation())
        if not dry_run:
            store_refusals(keystore, refused_before, _refusals(refused_before, taken), now=now)
        not_signed, notes, signed = _revoke_again(
            root, forgotten, robots_with_lists, taken, now=now, keyring=keyring, dry_run=dry_run
        )
        later_notes = _later_release_notes(
            keystore, robots_with_seals, has_lost_ca=forgotten.has_lost_ca
        )
        notes = [*later_notes, *notes]
        after = OpenedKeystore(root)
        _defer_requests(
            after,
            taken,
            is_restored=bool(signed),
            shows_later_releases=bool(forgotten.later_number),
        )
        is_older = bool(forgotten.later_number or restored_at(after))
        is_older |= may_have_later_releases(after)
        if not not_signed:
            not_signed, more_notes, more_signed = _sign(
                root,
                taken,
                now=now,
                allow_refusal=allow_refusal,
                keyring=keyring,
                dry_run=dry_run,
            )
            notes, signed = [*notes, *more_notes], [*signed, *more_signed]
    return CollectedInbox(
        root,
        inbox,
        [message.result() for message in taken],
        not_signed,
        None,
        dry_run,
        [*changes, *signed],
        [
            *_unknown_file_notes(inbox, fleet, after, is_older=is_older),
            *_older_message_notes(inbox, taken),
            *notes,
        ],
    )


def _refusals(
    before: Mapping[str, RefusedMessage], messages: Sequence[_ReceivedMessage]
) -> dict[str, str]:
    """Map robots to the reasons why their last messages were refused.

    Only a new message that is verified removes the reason from before: whoever has the inbox can
    put back an earlier one.
    """
    refused = {}
    for message in messages:
        name = message.robot.name
        if message.outcome == "refused":
            refused[name] = message.why
        elif message.outcome in ("missing", "older", "unchanged") and name in before:
            refused[name] = before[name].why
    return refused


# ── reading the inbox ──────────────────────────────────────────────────────────────────────


class _VerifiedMessage(NamedTuple):
    """A message whose signature, certificate and robot were verified.

    ``enclave`` is the enclave whose key signed the message with ``certificate``.
    """

    confirmation: Confirmation
    enclave: str
    certificate: x509.Certificate


@dataclass(slots=True)
class _ReceivedMessage:
    """The message of a robot on its way through the steps of `collect`.

    ``outcome``, ``why``, ``enclave``, ``sequence``, ``remarks`` and ``shared_keys`` are as in
    `CollectedMessage`.  ``verified`` is the verified content, until it is no longer needed.
    ``received`` is the confirmation to store if the message is new.
    """

    robot: Robot
    outcome: str
    why: str = ""
    enclave: str = ""
    sequence: int | None = None
    verified: _VerifiedMessage | None = None
    received: ReceivedConfirmation | None = None
    crl: str | None = None
    """The revocation list in the message; it counts only if a CA of the keystore signed it."""
    seal: str | None = None
    """The seal of a release in the message; it counts only if a CA of the keystore signed it."""
    signer_certificate: x509.Certificate | None = None
    """The signer's certificate, if the message itself is not accepted."""
    remarks: list[str] = field(default_factory=list)
    requests: list[_DecidedRequest] = field(default_factory=list)
    shared_keys: bool = False

    def without_confirmation(self) -> _ReceivedMessage:
        """Return a copy without the verified content, to save memory."""
        if self.verified is None:
            return replace(self, crl=None, seal=None, signer_certificate=None)
        return replace(
            self,
            enclave=self.verified.enclave,
            sequence=self.verified.confirmation.sequence,
            verified=None,
            received=None,
            crl=None,
            seal=None,
        )

    def result(self) -> CollectedMessage:
        """Return the outcome of the message."""
        return CollectedMessage(
            self.robot.name,
            self.outcome,
            self.why,
            self.enclave,
            self.sequence,
            self.remarks,
            [request.result for request in self.requests],
            self.shared_keys,
        )


class _RefusedError(SrosError):
    """The message proves nothing, or the request must not be signed."""


class _OutdatedCertificateError(_RefusedError):
    """The certificate of the message was valid once: it was revoked, or its CA was replaced.

    ``why`` is the remark on a message that was accepted before, as a clause.
    """


def _shortened(reason: str) -> str:
    """Return a reason cut to the maximum length, as it may contain names that the robot chose."""
    return reason if len(reason) <= LONGEST_REASON else f"{reason[: LONGEST_REASON - 3]}..."


class _File(NamedTuple):
    """The content of a message's file, and when the file was written."""

    data: bytes
    written: datetime


def _read_inbox(inbox: Path, fleet: Fleet, verifier: _Verifier) -> Iterator[_ReceivedMessage]:
    """Yield each robot's message as verified; without a valid message, yield the reason."""
    try:
        folder = Folder(inbox)
    except OSError as error:
        raise DocumentError(
            f"the inbox '{inbox}' cannot be opened",
            f"{error.strerror}.",
            "Name the folder that has a folder for each robot.",
        ) from error
    with folder:
        for robot in fleet.robots.values():
            is_revoked, file = verifier.was_revoked(robot), None
            try:
                file = _read_message(folder, robot.name)
                if not is_revoked:
                    yield (
                        verifier.verify_message(robot, file)
                        if file
                        else _ReceivedMessage(robot, "missing")
                    )
                    continue
                taken = _ReceivedMessage(robot, "revoked")
            except _RefusedError as refusal:
                outcome = "revoked" if is_revoked else "refused"
                taken = _ReceivedMessage(robot, outcome, _shortened(refusal.what))
            if is_revoked and (file or taken.why):
                taken.why = "all its enclaves were revoked; its message does not count"
            if file:
                _keep_parts_signed_by_cas(taken, file.data)
            yield taken


def _keep_parts_signed_by_cas(received: _ReceivedMessage, message: bytes) -> None:
    """Store the parts of a refused message that a CA may have signed: revocation list and seal.

    The certificate of the message's signer is stored, too.  Nothing is verified here.
    """
    with suppress(SrosError):
        signed = smime.parse_new(message)
        received.signer_certificate = signed.signer()
        confirmation = parse_confirmation(signed.text, "it")
        received.crl, received.seal = confirmation.crl, confirmation.seal


def _read_message(inbox: Folder, robot: str) -> _File | None:
    """Return a robot's message, without following links; None if there is no message.

    Raises:
        _RefusedError: the message is not a regular file, is too large, or cannot be read.
    """
    path = f"{robot}/{MESSAGE_FILE}"
    try:
        state = inbox.state(path)
        if state is None:
            return None
        data = inbox.read(path, max_bytes=MAX_BYTES)
    except FileNotFoundError:
        return None
    except OSError as error:
        if error.errno == errno.EFBIG:
            raise _RefusedError(f"it has more than {MAX_BYTES // 1024**2} MiB") from error
        if error.errno in (errno.ELOOP, errno.EINVAL, errno.ENXIO, errno.EISDIR):
            raise _RefusedError("it is not a regular file") from error
        raise _RefusedError(f"it cannot be read: {os.strerror(error.errno or 0)}") from error
    except KeystoreError as error:  # the robot's folder is a link or a file
        raise _RefusedError(error.what) from error
    return _File(data, time_of_file(state.st_mtime))


def _unknown_file_notes(
    inbox: Path, fleet: Fleet, keystore: OpenedKeystore, *, is_older: bool
) -> Iterator[Note]:
    """Yield notes on names in the inbox that are not names of robots.

    ``is_older`` says that the keystore was restored, so that its fleet may lack robots.
    """
    names: list[str] = []
    with suppress(OSError), os.scandir(inbox) as entries:  # others can move the folder at any time
        names = sorted(entry.name for entry in islice(entries, _MOST_NAMES))
    parts = set[str]()
    for entry in keystore.entries_of("revocation"):
        if entry.reason != SUPERSEDED:
            parts.update(entry.enclave.split("/"))
    if revoked := [name for name in names if name in parts and name not in fleet.robots]:
        yield Note(
            "fleet.revoked-in-inbox",
            f"'{inbox}' has messages of {first_few(revoked, _SHOWN)}, not in the fleet any more, "
            "whose enclaves were revoked. They are not read: delete them. If you have such a robot "
            "back, see docs/howto/one_robot.md (Back in service).",
        )
    unknown = [
        ascii(name)[1:-1] for name in names if name not in fleet.robots and name not in revoked
    ]
    if unknown:
        verb = "is" if len(unknown) == 1 else "are"
        left = "If a robot left the fleet, delete its messages there."
        if is_older:
            left = (
                "Perhaps a robot was added after the backup of the keystore: put it into the fleet "
                "file, and sign its requests again before `sros generate_artifacts` "
                "(docs/howto/keystore_is_lost.md). Then collect again before you deliver, because "
                "its message shows certificates that the keystore lacks. If it left the fleet, "
                "delete its messages."
            )
        yield Note(
            "fleet.unknown-in-inbox",
            f"{counted(len(unknown), 'name')} in '{inbox}' {verb} not in the fleet, and {verb} not "
            f"read: {first_few(unknown, _SHOWN)}. {left}",
        )


def _older_message_notes(inbox: Path, messages: Iterable[_ReceivedMessage]) -> Iterator[Note]:
    """Yield a note on messages that are older than the last collected messages of their robots."""
    robots = [message.robot.name for message in messages if message.outcome == "older"]
    if robots:
        messages_text = "an older message" if len(robots) == 1 else "older messages"
        lies, older = (
            ("lies", "the older message") if len(robots) == 1 else ("lie", "the older messages")
        )
        newer = "a newer message was" if len(robots) == 1 else "newer messages were"
        yield Note(
            "fleet.older-message",
            f"{messages_text} of {first_few(robots, _SHOWN)} {lies} in '{inbox}', although "
            f"{newer} already collected. Delete {older}, which sros ignores.",
        )


# ── verifying ──────────────────────────────────────────────────────────────────────────────


class _Verifier:
    """A verifier of messages, by the CAs, the ledger and the fleet of a keystore."""

    def __init__(
        self, keystore: OpenedKeystore, fleet: Fleet, now: datetime, restored: Collection[str]
    ) -> None:
        self._keystore = keystore
        self._fleet = fleet
        self._now = now
        self._restored = restored
        self._searched = 0
        self._authorities = keystore.authority(IDENTITY)

    def verify_message(self, robot: Robot, file: _File) -> _ReceivedMessage:
        """Return a robot's message after verifying it, with the confirmation to keep.

        Raises:
            _RefusedError: the message proves nothing.
        """
        remarks: list[str] = []
        last = None
        try:
            last = last_confirmation(self._keystore, robot.name)
        except SrosError as error:
            remarks.append(f"its last confirmation cannot be used: {error.what}")
        before = last.message if last else None
        sha256 = hashlib.sha256(file.data).hexdigest()
        try:
            verified = self._verify(robot, file.data)
        except _OutdatedCertificateError as error:
            if not (before and before.sha256 == sha256):
                raise
            # The message was verified before, when its certificate was valid.
            taken = _ReceivedMessage(
                robot,
                "unchanged",
                enclave=before.enclave,
                sequence=before.sequence,
                remarks=[*remarks, error.why],
            )
            _keep_parts_signed_by_cas(taken, file.data)
            return taken
        remarks += self._expiry_clauses(verified.certificate)
        sequence = verified.confirmation.sequence
        assert sequence
        if before and before.sha256 == sha256:
            return _ReceivedMessage(robot, "unchanged", verified=verified, remarks=remarks)
        is_restored = robot.name in self._restored
        if before and last and sequence <= before.sequence:
            is_restored |= self._begins_again(robot, verified, last)
        is_older = before is not None and sequence < before.sequence and not is_restored
        # A message that came later may be from a robot with a restored disk, or may be replayed.
        if is_older and last and file.written < last.time:
            said = verified.confirmation
            return _ReceivedMessage(robot, "older", crl=said.crl, seal=said.seal, remarks=remarks)
        if before and sequence <= before.sequence and not is_restored:
            raise _RefusedError(
                f"{LOW_SEQUENCE} {sequence} is not higher than {before.sequence}, the number "
                "of the last message: this is an old message, two computers have the robot's "
                "keys, or the robot's clock was ahead before its disk was restored or its computer "
                f"was replaced (only then add --restored {robot.name})"
            )
        arrived = self._arrival(file, verified.confirmation, last)
        message = LastMessage(
            sequence, sha256, verified.enclave, collected=self._now.replace(microsecond=0)
        )
        installed = verified.confirmation.release
        before_it = (last.confirmation.release if last else None) or 0
        went_back = installed is not None and installed < before_it and not is_restored
        boot = verified.confirmation.boot
        boots, alternated = (before or message).next_boots(boot, arrived)
        is_earlier_start = before is not None and boot in before.boots[1:]
        if last and (alternated or went_back) and self._has_new_keys(robot, last):
            if not restored_at(self._keystore):
                went_back = is_earlier_start = False
                boots, alternated = message.next_boots(boot, arrived)
            elif last.is_alternation_shown and self._issue_after(verified.certificate, last):
                # The ledger may lack an earlier certificate: the problem stays for its day.
                went_back = is_earlier_start = False
                alternated = before.alternated if before else None
        # A new agent begins without a release, and a robot can only claim unpublished releases.
        known = self._keystore.known_releases if went_back else ()
        has_earlier_release = bool(installed) and before_it in known
        if has_earlier_release:
            alternated = arrived
        received = ReceivedConfirmation(
            replace(verified.confirmation, requests=None, crl=None, seal=None),
            arrived,
            message._replace(boots=boots, alternated=alternated),
        )
        if note := received.clock_note():
            remarks.append(note)
        if went_back:
            release = f"release {installed}" if installed else "no release"
            remarks.append(
                f"it has {release}, and had release {before_it} before: its disk was restored, or "
                "two computers have its keys (`sros fleet status` says what to do)"
            )
        elif is_earlier_start:
            remarks.append(
                "two computers seem to have its keys: a message came from an earlier start of "
                "the computer than the message before it (`sros fleet status` says what to do)"
            )
        return _ReceivedMessage(
            robot,
            "kept",
            verified=verified,
            received=received,
            remarks=remarks,
            shared_keys=is_earlier_start or has_earlier_release,
        )

    def _has_new_keys(self, robot: Robot, last: ReceivedConfirmation) -> bool:
        """Return whether a robot got new keys after its last message, and its old keys are revoked.

        Then another computer that has an earlier key of the robot can no longer use it, unless the
        keystore was restored from a backup: its ledger may lack earlier keys.
        """
        names = {
            *enclaves_of_robot(self._keystore, self._fleet, robot),
            *last.confirmation.enclaves(),
        }
        entries = [
            entry
            for entry in self._keystore.ledger_file.with_values("enclave", names).entries
            if entry.what == "certificate" and entry.enclave in names
        ]
        # Nobody knows when a certificate was issued that only releases showed after a restore.
        shown = KnownKeys(self._keystore).certificates_shown_after_restore(names)
        earlier = [entry for entry in entries if entry.time <= iso(last.latest) or entry in shown]
        later_keys = {entry.key for entry in entries if entry not in earlier}
        return bool(earlier) and all(
            entry.key not in {"", *later_keys}
            and (entry.not_after <= iso(self._now) or int(entry.serial, 16) in self._revoked)
            for entry in earlier
        )

    def _issue_after(
        self, certificate: x509.Certificate, last: ReceivedConfirmation
    ) -> Entry | None:
        """Return the ledger's entry for a certificate if it is from after a message, or None."""
        issued = self._issue_entry(digest(certificate))
        return issued if issued and issued.time > iso(last.latest) else None

    def _begins_again(
        self, robot: Robot, verified: _VerifiedMessage, last: ReceivedConfirmation
    ) -> bool:
        """Return whether a message is from a new computer, with keys that came after ``last``.

        After a restore, the ledger may lack an earlier certificate for the same key, with which an
        old message was signed: then, the message must also be from after its certificate.
        """
        issued = self._issue_after(verified.certificate, last)
        if issued is None or not self._has_new_keys(robot, last):
            return False
        is_later = iso(verified.confirmation.time) >= issued.time
        return is_later or not restored_at(self._keystore)

    def _arrival(
        self, file: _File, confirmation: Confirmation, last: ReceivedConfirmation | None
    ) -> datetime:
        """Return when a message came into the inbox.

        Messages may be there for a long time before they are collected, so this is the time at
        which the file was written, by the clock of the server.  If it was written before the last
        message was collected, then the clock of the server is behind: the time that the message
        shows counts, but no time before that collection or after now.  For a message that an
        earlier release of sros took, the time of its receipt stands for its collection.
        """
        came = file.written
        collected = last.message and (last.message.collected or last.time) if last else None
        if collected and came < collected:
            came = max(confirmation.time, collected)
        return min(came, self._now).replace(microsecond=0)

    def _verify(self, robot: Robot, data: bytes) -> _VerifiedMessage:
        try:
            signed = smime.parse_new(data)
            signer = signed.signer()
            if signer is None or len(signed.signatures) != 1:
                raise _RefusedError(
                    "it lacks the signer's certificate, or does not have exactly one signature"
                )
            signed.verify(signer)
            if weakness := signed.weakness():
                raise _RefusedError(weakness)
        except PkiError as error:
            raise _RefusedError(error.what) from error
        enclave = self._enclave(robot, signer)
        try:
            confirmation = parse_confirmation(signed.text, "it")
        except SrosError as error:
            raise _RefusedError(error.what) from error
        if confirmation.robot != robot.name:
            raise _RefusedError(f"it is the confirmation of another robot, {confirmation.robot}")
        if confirmation.sequence is None:
            raise _RefusedError("it has no sequence number, although `sros agent` writes one")
        return _VerifiedMessage(confirmation, enclave, signer)

    def was_revoked(self, robot: Robot) -> bool:
        """Return whether all enclaves of a robot were revoked."""
        return bool(
            self._revoked
            and not enclaves_of_robot(self._keystore, self._fleet, robot)
            and self._revoked_names.intersection(enclaves_of(self._fleet, robot))
        )

    @cached_property
    def _revoked_names(self) -> frozenset[str]:
        """The enclaves that had a certificate revoked for another reason than its replacement."""
        revocations = self._keystore.entries_of("revocation")
        return frozenset(entry.enclave for entry in revocations if entry.reason != SUPERSEDED)

    def _enclave(self, robot: Robot, signer: x509.Certificate) -> str:
        """Return the robot's enclave to which the keystore issued the certificate.

        Raises:
            _RefusedError: the keystore did not issue the certificate, it was revoked, or it belongs
                to no enclave of the robot.
        """
        validity = validity_of(signer)
        moment = min(max(self._now, validity.not_before), validity.not_after)
        fault = chain_fault(signer, self._authorities, moment=moment)
        is_of_replaced_ca = bool(fault) and self._was_of_replaced_ca(robot, signer)
        if fault and not is_of_replaced_ca:
            why = "no identity CA of the keystore issued its certificate"
            # This comes first, because the sender chose the words of the fault.
            if restored_at(self._keystore):
                why += " (perhaps the CA was replaced after the backup of the keystore: see "
                why += "docs/howto/keystore_is_lost.md)"
            raise _RefusedError(f"{why}: {fault}")
        issued = self._issue_entry(digest(signer))
        owner = robot_of(self._fleet, issued.enclave) if issued else None
        of_whom = f", an enclave of {owner.name}" if owner else ", which belongs to no robot"
        if signer.serial_number in self._revoked:
            why = (
                f"its certificate, {serial_text(signer.serial_number)}, was revoked: perhaps the "
                "robot lacks its new keys, or another computer that has earlier keys of the robot "
                "sends messages in its place"
            )
            if issued and owner != robot:
                why = (
                    f"it is signed with a revoked certificate of {issued.enclave}{of_whom}"
                    f"{self._revocation_clause(signer)}: a computer that has this key sends "
                    f"messages in the place of {robot.name}"
                )
            raise _OutdatedCertificateError(
                why, "its certificate was revoked after this message was accepted"
            )
        if is_of_replaced_ca:
            why = "its identity CA was replaced: the robot missed the rotation of this CA"
            raise _OutdatedCertificateError(why, why)
        if issued is None:
            raise _RefusedError(
                f"{NOT_IN_LEDGER}, though the keystore's identity CA issued it: the keystore may "
                "have been restored from a backup that is older than this certificate"
            )
        if owner != robot:
            raise _RefusedError(f"it is signed by {issued.enclave}{of_whom}")
        if self._now > validity.not_after and not self._has_key_of(issued.enclave, signer):
            age = elapsed(self._now - validity.not_after)
            raise _RefusedError(
                f"its certificate expired {age} ago, and {issued.enclave} has another key now"
            )
        return issued.enclave

    def _revocation_clause(self, certificate: x509.Certificate) -> str:
        """Return when and why a certificate was revoked, in parentheses; "" if it is not known."""
        for entry in self._keystore.entries_of("revocation"):
            if int(entry.serial, 16) == certificate.serial_number:
                reason = "" if entry.reason in ("", "unspecified") else f", {entry.reason}"
                return f" (revoked at {entry.time}{reason})"
        return ""

    def _was_of_replaced_ca(self, robot: Robot, signer: x509.Certificate) -> bool:
        """Return whether a replaced CA issued the certificate to an enclave of the robot.

        The certificate's digest must be in the ledger.  So nobody can make such a certificate with
        only a copy of the replaced CA's key.
        """
        if any(issued_by(signer, authority) for authority in self._authorities):
            return False
        issued = self._issue_entry(digest(signer))
        return bool(issued and robot_of(self._fleet, issued.enclave) == robot)

    def _has_key_of(self, enclave: str, signer: x509.Certificate) -> bool:
        """Return whether a certificate is for the current key of an enclave.

        An earlier key may be on a computer that nobody looks after any more.
        """
        with suppress(SrosError):  # the enclave does not exist, or a file of it is broken
            present = self._keystore.certificate_of(enclave)
            return present.public_key() == signer.public_key()
        return False

    def _issue_entry(self, sha256: str) -> Entry | None:
        """Return the ledger's entry for a certificate (SHA-256 of the DER), or None."""
        if self._searched < _MOST_SEARCHES or self._keystore.ledger_file.is_indexed:
            self._searched += 1
            entries: Sequence[Entry] = self._keystore.ledger_with("sha256", sha256).entries
        else:
            entries = self._certificates.get(sha256, ())
        return next((entry for entry in entries if _proves_issue(entry, sha256)), None)

    @cached_property
    def _certificates(self) -> Mapping[str, Sequence[Entry]]:
        """Maps the SHA-256 of each certificate to the ledger's entries for it."""
        by_digest: dict[str, list[Entry]] = {}
        for entry in self._keystore.ledger_with("what", "certificate").entries:
            by_digest.setdefault(entry.sha256, []).append(entry)
        return by_digest

    @cached_property
    def _revoked(self) -> Collection[int]:
        """The serial numbers that the ledger or the revocation lists revoke."""
        return revoked_serials(self._keystore)

    def _expiry_clauses(self, certificate: x509.Certificate) -> Iterator[str]:
        validity = validity_of(certificate)
        if self._now > validity.not_after:
            age = elapsed(self._now - validity.not_after)
            yield f"its certificate expired {age} ago, at {iso(validity.not_after)}"
        elif self._now < validity.not_before:
            yield f"its certificate is valid only from {iso(validity.not_before)}"


def _proves_issue(entry: Entry, sha256: str) -> bool:
    """Return whether a ledger entry shows that the keystore issued a certificate."""
    is_issued = entry.what == "certificate" and entry.reason != REPORTED
    return is_issued and entry.sha256 == sha256 and bool(entry.enclave)


# ── requests for renewal ───────────────────────────────────────────────────────────────────


@dataclass(slots=True)
class _DecidedRequest:
    """A request for renewal and the decision on it.

    ``request`` is the request to sign; None if the decision is not to sign.
    """

    result: CollectedRequest
    request: SigningRequest | None = None
    vouching: Collection[int] = ()
    """Serial numbers of the certificates that vouch for the request."""
    is_new_key: bool = False
    """Whether the request has another key than the enclave's current certificate."""

    def set_outcome(self, outcome: str, why: str = "") -> None:
        """Decide that the request is not signed; ``why`` is the reason as a clause."""
        self.result = self.result._replace(outcome=outcome, why=why)
        self.request = None


class _Renewals:
    """Decides which requests of robots may be signed: only requests that change nobody's rights."""

    def __init__(self, keystore: OpenedKeystore, fleet: Fleet, now: datetime) -> None:
        self._keystore = keystore
        self._fleet = fleet
        self._now = now

    def decide(self, robot: Robot, message: _VerifiedMessage) -> list[_DecidedRequest]:
        """Return the requests of a verified message with the decisions on them."""
        judged: list[_DecidedRequest] = []
        names: set[str] = set()
        for text in message.confirmation.requests or ():
            result = CollectedRequest("", "", "refused", "")
            try:
                request = load_request(text.encode(), f"of {robot.name}")
                check_enclave_name(request.name)
                result = CollectedRequest(
                    request.name, key_digest(request.public_key), "refused", ""
                )
                if request.name in names:
                    raise _RefusedError("the message has another request for this enclave")
                names.add(request.name)
                outcome, why = self._decide_request(robot, message, request)
            except SrosError as error:
                outcome, why = "refused", _shortened(error.what)
            result = result._replace(outcome=outcome, why=why)
            if outcome == "renewed":
                present = self._keystore.certificate_of(request.name)
                vouching = (message.certificate.serial_number, present.serial_number)
                is_new_key = present.public_key() != request.public_key
                judged.append(_DecidedRequest(result, request, vouching, is_new_key))
            else:
                judged.append(_DecidedRequest(result))
        return judged

    def _decide_request(
        self, robot: Robot, message: _VerifiedMessage, request: SigningRequest
    ) -> tuple[str, str]:
        """Return the outcome of a request, and the reason; "renewed" means that it may be signed.

        Raises:
            SrosError: the request must not be signed.
        """
        name, keystore = request.name, self._keystore
        owner = robot_of(self._fleet, name)
        if owner != robot:
            owner_clause = f"an enclave of {owner.name}" if owner else "not an enclave of a robot"
            raise _RefusedError(f"{name} is {owner_clause}")
        if not keystore.has_enclave(name):
            raise _RefusedError("the keystore does not have this enclave, or it was revoked")
        present = keystore.certificate_of(name)
        if present.serial_number in self._revoked:
            raise _RefusedError("its current certificate was revoked")
        same_key = present.public_key() == request.public_key
        on_robot = message.confirmation.certificates.get(
            f"{enclave_folder(name)}/{CERTIFICATE_FILE}", ()
        )
        is_there = digest(present) in on_robot
        if same_key and not is_there and validity_of(present).contains(self._now):
            # Even if it is due again, the robot first has to fetch the certificate that was signed
            # before.
            return "answered", "the robot has not fetched its new certificate yet"
        # Robots ask in the last third of the validity; half of it is accepted, because clocks may
        # be wrong.
        due = min(
            validity.not_after - validity.lifetime(made) / 2
            for validity, made in self._issued_validities(name)
        )
        if self._now < due:
            return "not_due", f"it can be renewed from {iso(due)}"
        if robot.renewal != RENEWAL_ALLOWED:
            return (
                "not_allowed",
                'the keystore\'s copy of the fleet file does not say renewal = "allowed" for '
                f"{robot.name}. If your fleet file says it, run `sros generate_artifacts -k "
                f"{quote(str(self._keystore.root))} -p POLICY_FILE --fleet FILE`",
            )
        if not same_key and message.enclave != name:
            raise _RefusedError(
                f"the request has a new key, so {name} itself has to sign the message, but "
                f"{message.enclave} signed it"
            )
        if not same_key and message.certificate.public_key() != present.public_key():
            raise _RefusedError(
                f"the request has a new key, so the current key of {name} has to sign the "
                "message, but an earlier key signed it"
            )
        for certificate in (message.certificate, present):
            self._check_grace(robot, validity_of(certificate))
        return "renewed", ""

    def _issued_validities(self, name: str) -> Iterator[tuple[Window, datetime | None]]:
        """Yield the validities of an enclave's certificate and permissions, with their issue times.

        The time is None for files that the ledger does not have, such as files of ros2/sros2.
        """
        credentials = read_credentials(self._keystore, name)
        lifetime = credentials.lifetime()
        for sha256, validity in (
            (digest(credentials.certificate), lifetime.certificate),
            (credentials.digest, lifetime.permissions),
        ):
            entries = self._keystore.ledger_with("sha256", sha256).entries
            times = [entry.time for entry in entries if entry.sha256 == sha256]
            yield validity, parse_iso(times[0]) if times else None

    def _check_grace(self, robot: Robot, validity: Window) -> None:
        """Raise `_RefusedError` if a certificate expired longer ago than the fleet file accepts."""
        overdue = self._now - validity.not_after
        if overdue.total_seconds() <= 0:
            return
        if not robot.renewal_grace or overdue > parse_duration(robot.renewal_grace):
            grace = robot.renewal_grace or "none"
            raise _RefusedError(
                f"its certificate expired {elapsed(overdue)} ago, which is more than the "
                f"renewal_grace of {robot.name} ({grace})"
            )

    @cached_property
    def _revoked(self) -> Collection[int]:
        return revoked_serials(self._keystore)


def _revoke_again(
    root: Path,
    forgotten_lists: LostRecords,
    robots_with_lists: Sequence[str],
    messages: Sequence[_ReceivedMessage],
    *,
    now: datetime,
    keyring: Keyring,
    dry_run: bool,
) -> tuple[str, list[Note], list[FileChange]]:
    """Revoke certificates that only the revocation lists of robots revoke.

    Requests for which such a certificate vouches are refused.  ``robots_with_lists`` are the robots
    whose lists revoke more than the keystore's.  Certificates that the ledger lacks are recorded.
    If the keystore cannot sign its next list, no request is signed.  For a CA service, there is
    only a note, because only the service signs its lists and knows its certificates.
    """
    is_later = bool(forgotten_lists.later_number)
    unknown = forgotten_lists.unknown_certificates(OpenedKeystore(root))
    perhaps_revoked = forgotten_lists.perhaps_revoked
    if not (forgotten_lists.lists or unknown or is_later or perhaps_revoked):
        return "", [], []
    forgotten_serials = {entry.serial for crl in forgotten_lists.lists for entry in crl.revoked}
    requests = [request for message in messages for request in message.requests if request.request]
    for request in requests:
        if forgotten_serials & {*request.vouching}:
            request.set_outcome("refused", "its certificate was revoked")
    notes: list[Note] = []
    have = (
        f"{first_few(robots_with_lists, _SHOWN)} {'has' if len(robots_with_lists) == 1 else 'have'}"
    )
    if keyring.ca_service(root, IDENTITY, OpenedKeystore(root).template):
        # The list is for all sites, and everybody can get it, so this does not delay other robots.
        text = (
            f"{have} a revocation list, signed by the CA service, that the keystore lacks: import "
            f"it with `sros crl {quote(str(root))} --refresh --crl FILE`"
        )
        notes = [Note("fleet.later-list", text)] if robots_with_lists else []
        if not (is_later or perhaps_revoked):
            return "", notes, []
        forgotten_lists, robots_with_lists = LostRecords(OpenedKeystore(root), now), ()
    try:
        restored = restore_revocations(
            root,
            forgotten_lists,
            shown_by=LATER_RELEASE if is_later else "",
            perhaps_revoked=perhaps_revoked,
            now=now,
            keyring=keyring,
            dry_run=dry_run,
        )
    except SrosError as error:
        if not robots_with_lists:
            text = f"the ledger cannot record what messages of robots show: {error.what}"
            return "", [*notes, Note("fleet.certificates-restored", text)], []
        why = (
            f"{have} a revocation list that the keystore signed but does not know, and no new list "
            f"can be signed: {error.what}"
        )
        for request in requests:
            if request.request:
                request.set_outcome("not_signed", why)
        return why, [], []
    notes += [restored_list_note(restored, have)] if robots_with_lists else []
    if stay := sorted(perhaps_revoked.difference(restored.names("revoked"))):
        step = perhaps_revoked_step(OpenedKeystore(root), stay)
        text = (
            f"{first_few(stay, _SHOWN)} may have been revoked or removed after the backup: the "
            f"last release of the robot lacks it. {step}"
        )
        notes.append(Note("fleet.perhaps-revoked", text))
    return "", [*notes, *restored.notes], [*changes_below(root, restored.changes)]


def _later_release_notes(
    keystore: OpenedKeystore, robots: Sequence[str], *, has_lost_ca: bool
) -> Iterator[Note]:
    """Yield a note on robots with releases that the keystore sealed, but does not know any more."""
    if robots:
        have = f"{first_few(robots, _SHOWN)} {'has' if len(robots) == 1 else 'have'}"
        first = f" after {rotation_command(keystore)}, and" if has_lost_ca else ""
        lost = " Its identity CA was replaced after the backup." if has_lost_ca else ""
        yield Note(
            "fleet.later-release",
            f"{have} a release that the keystore sealed but does not know: the keystore was "
            f"restored from a backup, or is a copy.{lost} It publishes and renews again only{first}"
            f" after {restored_command(keystore)}; docs/howto/keystore_is_lost.md has the other "
            "steps.",
        )


def restored_command(keystore: OpenedKeystore) -> str:
    """Return the command that publishes the first releases after a restore."""
    where = quote(str(keystore.root))
    folder = quote(read_published(keystore).folder or "PUB")
    return f"`sros fleet publish {where} {folder} --restored`"


def _defer_requests(
    keystore: OpenedKeystore,
    messages: Sequence[_ReceivedMessage],
    *,
    is_restored: bool,
    shows_later_releases: bool,
) -> None:
    """Refuse requests with new keys while something shows that the keystore was restored.

    The key that vouches for a new key may have been revoked after the backup.  If the keystore must
    not publish before ``--restored``, all requests are refused, because a new certificate comes
    with the rights of the backup.  ``is_restored`` says that messages of
    this run show lost revocations; ``shows_later_releases``, that they show releases that
    the keystore does not know.
    """
    requests = [request for message in messages for request in message.requests if request.request]
    if not requests:
        return
    from sros_tool.keystore.delivery.publish import age_clause

    if has_lost_releases := shows_later_releases or has_unpublished_restore(keystore):
        reason = "rights that were taken away after the backup would come back"
    elif is_restored or age_clause(keystore):
        reason = "the key that vouches for the new key may be revoked"
    else:
        return
    why = (
        f"the keystore was restored from a backup, or is a copy, so {reason}: first run "
        f"{restored_command(keystore)}"
    )
    for request in requests:
        if has_lost_releases or request.is_new_key:
            request.set_outcome("refused", why)


def _sign(
    root: Path,
    messages: Sequence[_ReceivedMessage],
    **options: Unpack[ChangeOptions],
) -> tuple[str, list[Note], list[FileChange]]:
    """Sign the requests that may be signed, if possible all in one change of the keystore.

    If this fails, each half of the robots is tried by itself, and so on, so that one robot neither
    stops nor slows down the others.  Returns why the CAs cannot sign ("" if they can), notes, and
    the changed files.
    """
    by_robot = [
        [request for request in message.requests if request.request] for message in messages
    ]
    by_robot = [requests for requests in by_robot if requests]
    notes: list[Note] = []
    changes: list[FileChange] = []

    def sign(robots: Sequence[Sequence[_DecidedRequest]]) -> SrosError | None:
        """Sign the requests of some robots; return the error if this fails, or else None."""
        decided = [request for judged in robots for request in judged if request.request]
        requests = [request.request for request in decided if request.request]
        try:
            signed = certify_requests(
                root,
                b"".join(request.pem for request in requests),
                only_enclaves=[request.name for request in requests],
                renew=True,
                replace_keys=True,
                # Another change may have come first, while this one waited for the lock.
                vouching={request.result.enclave: request.vouching for request in decided},
                **options,
            )
        except SrosError as error:
            return error
        notes.extend(signed.notes)
        changes.extend(changes_below(root, signed.changes))
        return None

    def sign_parts(robots: Sequence[Sequence[_DecidedRequest]], error: SrosError | None) -> None:
        if error and len(robots) > 1:
            middle = len(robots) // 2
            for part in (robots[:middle], robots[middle:]):
                sign_parts(part, sign(part))
        elif error:
            for request in robots[0]:
                request.set_outcome("refused", error.what)

    if not by_robot:
        return "", notes, changes
    joint = sign(by_robot)
    if joint and (problem := _why_cannot_sign(root, **options)):
        for request in (request for judged in by_robot for request in judged):
            request.set_outcome("not_signed", problem)
        return problem, notes, changes
    sign_parts(by_robot, joint)
    return "", notes, changes


def _why_cannot_sign(root: Path, **options: Unpack[ChangeOptions]) -> str:
    """Return why the keystore's CAs can sign nothing now, as a clause; "" if they can sign."""
    try:
        with KeystoreChange(root, **options | {"dry_run": True}) as change:
            change.open_authorities()
    except SrosError as error:
        return error.what
    return ""
