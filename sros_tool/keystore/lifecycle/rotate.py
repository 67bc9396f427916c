"""The stages of a CA rotation, and the changes that each stage makes to a keystore.

In the stage ``distribute``, enclaves begin to trust the new CA in addition to the old one.  In
``reissue``, the new CA issues all certificates and signs all documents again.  In ``retire``,
enclaves stop trusting the old CA.  Each stage is a transaction.
"""

from __future__ import annotations

import secrets
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from datetime import datetime
from pathlib import Path
from shlex import quote
from typing import Any, Unpack

from cryptography import x509

from sros_tool.dds.governance import parse_governance
from sros_tool.errors import KeystoreError, Note, SrosError, UsageError
from sros_tool.faults import WAIT_FOR_CA
from sros_tool.fleet.robots import robot_of
from sros_tool.keystore.fleet import (
    checked_fleet,
    left_enclaves,
    left_enclaves_notes,
    load_fleet,
    publish_command,
)
from sros_tool.keystore.fleet_status import (
    fleet_status,
    robots_with_shared_keys,
    shared_keys_clause,
)
from sros_tool.keystore.issuing.authority import (
    Authority,
    ImportedAuthority,
    check_imported_ca,
    write_bundle,
    write_copies,
)
from sros_tool.keystore.issuing.enclave import EnclaveWriter, Issuance, NewIdentity
from sros_tool.keystore.issuing.keyring import IN_KEYSTORE, Keyring, check_places
from sros_tool.keystore.known_keys import perhaps_revoked_step, unknown_authorities
from sros_tool.keystore.layout import (
    CERTIFICATE_FILE,
    CRL,
    CRL_FILE,
    GOVERNANCE_FILE,
    GOVERNANCE_P7S,
    IDENTITY,
    PERMISSIONS,
    PERMISSIONS_FILE,
    PRIVATE,
    PUBLIC,
    RETIRED,
    ROLES,
    ROTATION,
    SETTINGS,
    ca_certificate_path,
    ca_key_path,
    enclave_folder,
    enclave_path,
    key_path,
)
from sros_tool.keystore.ledger import (
    FROM_BEFORE,
    NEW_CA,
    SAME_KEY,
    certificate_entry,
    document_entry,
)
from sros_tool.keystore.lifecycle.change import Changed, ChangeOptions, KeystoreChange
from sros_tool.keystore.lifecycle.revocation_list import sign_list
from sros_tool.keystore.lifecycle.rotation import (
    Replacement,
    Rotation,
    RotationStage,
    are_crls_confusable,
    read_rotation,
    render_rotation,
    retired_key_path,
)
from sros_tool.keystore.reader import OpenedKeystore
from sros_tool.keystore.rights import SignedRights
from sros_tool.keystore.settings import edit_remedy, find_edits, write_settings
from sros_tool.keystore.template import Template
from sros_tool.parallel import Progress
from sros_tool.pki.certificates import (
    authority_text,
    common_name,
    digest,
    issue_ca,
    issued_by,
    other_issuer_text,
    pem,
    same_key,
    subject_text,
    validity_of,
)
from sros_tool.pki.keys import PrivateKey, PublicKey, algorithm, is_weak
from sros_tool.pki.token import is_token_uri
from sros_tool.validity import Span, Window, iso, span_text, window
from sros_tool.wording import capitalized, first_few

_MOST_SHOWN = 10
"""Maximum number of robots that an error names."""
_ENCLAVES_SHOWN = 5


@dataclass(frozen=True, slots=True, kw_only=True)
class RotationStep(Changed):
    """The result of a rotation step.

    ``stage`` is the stage of the keystore afterwards.  ``files`` are the names, without suffixes,
    of the replaced CA files ("identity_ca", "permissions_ca" or "ca").  ``kept_elsewhere`` are the
    places outside of the keystore with old keys; sros never deletes these.  ``cut_off`` are robots
    that have not confirmed the previous stage, and can no longer communicate with the others.
    """

    stage: RotationStage
    files: tuple[str, ...]
    kept_elsewhere: tuple[str, ...] = ()
    cut_off: tuple[str, ...] = ()

    @property
    def replaces_identity(self) -> bool:
        """Whether the rotation replaces the identity CA, which issues the robots' certificates."""
        return any(file != "permissions_ca" for file in self.files)

    @property
    def replaces_seals(self) -> bool:
        """Whether the rotation replaces the permissions CA, which seals releases."""
        return any(file != "identity_ca" for file in self.files)


def rotate_ca(
    root: Path,
    to: RotationStage | None = None,
    *,
    roles: Sequence[str] = (),
    finish: bool = False,
    new_keys: Keyring = IN_KEYSTORE,
    existing: Mapping[str, bytes] = {},
    validity: Span | None = None,
    delete_old_key: bool = False,
    allow_unconfirmed: bool = False,
    progress: Progress | None = None,
    **options: Unpack[ChangeOptions],
) -> RotationStep:
    """Rotate the CAs to the stage ``to`` (default: the next stage), or with ``finish`` to the end.

    If the keystore is already at the stage ``to``, nothing is changed.  ``roles`` ("identity",
    "permissions"; default: both) and the ``validity`` of the new CAs are only used when a rotation
    begins.  ``new_keys`` names the places of new keys outside of the keystore.  ``existing`` maps
    roles to the certificates (PEM) of CAs that already exist, whose keys are at these places.
    ``delete_old_key`` deletes old keys in the keystore.  In a keystore with a fleet, a stage that
    cuts off robots, because they have not confirmed the previous stage, needs
    ``allow_unconfirmed``.

    Raises:
        KeystoreError: a key is missing, an enclave cannot be moved to the new CA, robots would be
            cut off, vendors would refuse enclaves that they accept today, or another process has
            begun the next stage.
        UsageError: the stage ``to`` is over, or is not the next stage; ``delete_old_key`` is set,
            but this stage deletes no old key; or ``existing`` is given for a rotation that has
            already begun.
    """
    is_next = to is None and not finish
    stage_before = read_rotation(OpenedKeystore(root)).stage if is_next else None
    change = KeystoreChange(root, **options)
    with change:
        rotation = read_rotation(change.keystore)
        if is_next and rotation.stage is not stage_before:
            raise _stage_changed_error(root, rotation.stage)
        if existing and rotation.stage is not RotationStage.NONE:
            raise UsageError(
                f"the keystore is at the stage {rotation.stage} of a rotation to another CA",
                "The certificate of an existing CA can be given only at the start of a rotation.",
                "End this rotation first, without the certificate.",
            )
        stage = RotationStage.RETIRE if finish else _target_stage(change.keystore, rotation, to)
        rotator = _Rotator(change, rotation, delete_old_key=delete_old_key)
        cut_off: tuple[str, ...] = ()
        if finish or stage not in (rotation.stage, RotationStage.NONE):
            if rotation.stage is not RotationStage.REISSUE:  # the last stage does not sign anything
                _refuse_edited(change.keystore)
            cut_off = robots_cut_off(change.keystore, rotation, stage, change.now)
            if cut_off and not allow_unconfirmed:
                raise _cut_off_error(change.keystore, rotation, stage, cut_off, roles)
            wanted = _WantedAuthorities(roles, new_keys, existing, validity)
            stage = rotator.go_to(stage, wanted, progress)
            if stage in (RotationStage.DISTRIBUTE, RotationStage.REISSUE):
                change.notes += _no_robot_notes(change.keystore, change.names, change.now)
            change.finish()
        elif delete_old_key:
            _refuse_late_deletion(change.keystore, rotation.stage)
    return _step_result(
        change,
        stage=stage,
        files=tuple(replacement.file for replacement in rotator.replacements),
        kept_elsewhere=tuple(rotator.kept_elsewhere),
        cut_off=cut_off,
    )


def _stage_changed_error(root: Path, stage: RotationStage) -> KeystoreError:
    return KeystoreError(
        f"the CA rotation of '{root}' has just reached the stage {stage}",
        "Another command began this stage, or sros completed an interrupted command. The next "
        "stage would cut off processes that lack the files of this stage.",
        f"`sros rotate_ca {quote(str(root))}` shows what to do before the next stage.",
    )


def _step_result(change: KeystoreChange, **more: Any) -> RotationStep:
    """Return the result of a step, with all enclaves reissued, or all kept."""
    reissued = any(
        change_of_file.path.endswith(f"/{CERTIFICATE_FILE}")
        for change_of_file in change.transaction.changes
    )
    outcomes = dict.fromkeys(change.names, "reissued" if reissued else "kept")
    return change.result(RotationStep, outcomes=outcomes, restart=(), **more)


def robots_cut_off(
    keystore: OpenedKeystore, rotation: Rotation, to: RotationStage, now: datetime
) -> tuple[str, ...]:
    """Return the sorted names of the robots that the stage ``to`` would cut off from the others.

    These are the robots that have not confirmed the previous stage (`FleetStatus.unconfirmed`); if
    stages are left out, these are all robots with enclaves.  Without a fleet, and in the first
    stage, no robot is cut off.

    Raises:
        KeystoreError: the fleet file is not the file that sros wrote last.
    """
    if to is RotationStage.DISTRIBUTE or checked_fleet(keystore) is None:
        return ()
    status = fleet_status(keystore).with_overdue(now)
    if _leaves_out_stages(rotation, to):  # no robot was ever at the stage that is left out
        return tuple(robot.robot for robot in status.robots if robot.enclaves)
    return status.unconfirmed


def _leaves_out_stages(rotation: Rotation, to: RotationStage) -> bool:
    """Return whether the stage ``to`` is not the next stage of a rotation."""
    stages = list(RotationStage)
    return stages.index(to) - stages.index(rotation.stage) > 1


def _no_robot_notes(
    keystore: OpenedKeystore, names: Iterable[str], now: datetime
) -> Iterator[Note]:
    """Yield notes on enclaves without a robot, whose state no confirmation shows."""
    fleet = load_fleet(keystore)
    if not fleet:
        return
    left = left_enclaves(keystore, fleet, now)
    yield from left_enclaves_notes(keystore, fleet, left)
    without = [name for name in names if name not in left and robot_of(fleet, name) is None]
    if without:
        verb, its = ("belongs", "its") if len(without) == 1 else ("belong", "their")
        yield Note(
            "keystore.of-no-robot",
            f"{first_few(without, _ENCLAVES_SHOWN)} {verb} to no robot, so it is unknown whether "
            f"{its} files are at this stage: check that before the next stage.",
        )


def _refuse_late_deletion(keystore: OpenedKeystore, stage: RotationStage) -> None:
    """Raise `UsageError` if the keystore is already at ``stage``, and still has old keys."""
    kept = sorted(map(str, (keystore.root / RETIRED).glob("*.key.pem")))
    if stage is RotationStage.DISTRIBUTE or (kept and stage is not RotationStage.NONE):
        raise UsageError(
            f"the keystore is already at the stage {stage}, so no key is deleted",
            "`sros revoke` may need the key of the old identity CA until the stage retire.",
            f"Use --delete-old-key with the command that begins the stage retire: `sros rotate_ca "
            f"{quote(str(keystore.root))} --to retire --delete-old-key`.",
        )
    if kept:
        raise UsageError(
            "no stage is left to do, so no key is deleted",
            f"Keys of replaced CAs: {first_few(kept, _MOST_SHOWN)}.",
            "Delete them yourself, or leave out --delete-old-key.",
        )


def _cut_off_error(
    keystore: OpenedKeystore,
    rotation: Rotation,
    to: RotationStage,
    robots: Sequence[str],
    roles: Sequence[str],
) -> KeystoreError:
    where, names = quote(str(keystore.root)), first_few(robots, _MOST_SHOWN)
    if _leaves_out_stages(rotation, to):
        files = {replacement.file for replacement in rotation.replacements}
        seals = files != {"identity_ca"} if files else [*roles] != [IDENTITY]
        refuses = ", and it does not accept a published release" * seals
        by_hand = f" by hand (`sros distribute_key {where} --robot NAME FOLDER --force`)" * seals
        return KeystoreError(
            f"several stages together would cut off every robot: {names}",
            "A robot trusts the new CA only once it has the new files, and its processes were "
            "restarted: before that, it cannot communicate with robots that have the "
            f"files{refuses}.",
            "If the robots may stand still, add --allow-unconfirmed, then bring the files to every "
            f"robot{by_hand}, and restart everything. Otherwise go stage by stage, with "
            f"`sros rotate_ca {where} --next`.",
        )
    copied = capitalized(shared_keys_clause(robots_with_shared_keys(keystore, robots)))
    doubt = f" {copied}: `sros fleet status` says what to do."
    return KeystoreError(
        f"not every robot has confirmed the stage {rotation.stage}: {names}",
        "After the next stage, these robots could not communicate with the other robots."
        f"{doubt if copied else ''}",
        "Deliver the current files, restart processes that run with earlier files, and confirm "
        f"the files and the restart; see `sros fleet status {where}`. --allow-unconfirmed goes on "
        "without these robots.",
    )


def _refuse_edited(keystore: OpenedKeystore) -> None:
    """Raise `KeystoreError` if settings or governance were edited: signing would undo the edits."""
    root, governance = keystore.root, None
    with suppress(SrosError):  # signing the governance again reports the error
        governance = keystore.governance
    if edits := find_edits(keystore, governance):
        raise KeystoreError(
            f"files of keystore '{root}' were edited by hand: {'; '.join(edits.clauses())}",
            "The new CA would sign the governance without these edits.",
            f"First apply or undo the edit: {edit_remedy(root)}",
        )


def _was_ca_replaced(keystore: OpenedKeystore) -> bool:
    """Return whether the ledger records that a CA was replaced by another one."""
    names = (keystore.certificates_of(f"{role}_ca") for role in ROLES)
    trusted = {
        subject_text(certificate.subject) for certificates in names for certificate in certificates
    }
    made = Counter(entry.subject for entry in keystore.entries_of("ca") if entry.reason != SAME_KEY)
    return any(number > 1 or subject not in trusted for subject, number in made.items())


def _target_stage(
    keystore: OpenedKeystore, rotation: Rotation, to: RotationStage | None
) -> RotationStage:
    """Return the stage to which to go; NONE if the keystore is already there.

    Raises:
        UsageError: the stage ``to`` is over, or is not the next stage.
    """
    root = keystore.root
    if to is None:
        return rotation.next_stage()
    if to is RotationStage.RETIRE and rotation.stage is RotationStage.NONE:
        if not _was_ca_replaced(keystore):
            raise UsageError(
                f"no CA of keystore '{root}' is being replaced",
                "There is no old CA to retire.",
                f"Begin with `sros rotate_ca {quote(str(root))} --next`.",
            )
        return RotationStage.NONE  # an earlier rotation is complete
    order = list(RotationStage)
    ahead = order.index(to) - order.index(rotation.stage)
    if ahead > 1:
        raise UsageError(
            f"the stage {to} is not the next stage",
            f"The next stage is {rotation.next_stage()}; after it, restart the processes.",
            f"Run `sros rotate_ca {quote(str(root))} --next`, or `--finish` to do all stages "
            "together.",
        )
    if ahead < 0:
        raise UsageError(
            f"the stage {to} is over",
            f"The keystore is at the stage {rotation.stage}, and a rotation cannot go back.",
            f"Run `sros rotate_ca {quote(str(root))} --next`.",
        )
    return to


def renew_identity_ca(
    root: Path,
    *,
    validity: Span | None = None,
    issued: bytes = b"",
    **options: Unpack[ChangeOptions],
) -> RotationStep:
    """Issue a new certificate for the identity CA, with the same name and key and a later expiry.

    If the identity CA is a CA service, ``issued`` is the certificate (PEM) that the service issued.

    Nothing else changes: on Cyclone DDS 0.10.2 and Fast DDS 2.9.1 (tested), the certificates that
    the CA issued have valid chains both to its old certificate and to its new one.  A permissions
    CA cannot be renewed in this way: signed documents contain its present certificate, and DDS
    would refuse them with a new one.

    Raises:
        KeystoreError: the keystore has a single CA; a rotation is in progress; the CA is not
            self-signed, or its key is weak or missing; or ``issued`` belongs to another CA.
        UsageError: the new certificate would expire before the current one, or is missing.
    """
    change = KeystoreChange(root, **options)
    with change:
        if len(change.keystore.authority_files) == 1:
            raise KeystoreError(
                f"the CA of keystore '{root}' cannot be renewed with the same key",
                "It is also the permissions CA: signed permissions contain its present "
                "certificate, and DDS would refuse them with a new certificate.",
                "Rotate it without --same-key.",
            )
        if read_rotation(change.keystore).stage is not RotationStage.NONE:
            raise KeystoreError(
                f"a rotation of the CAs of keystore '{root}' is under way",
                "",
                f"Finish it first: `sros rotate_ca {quote(str(root))} --next` for each stage.",
            )
        old, *above = change.keystore.certificates_of("identity_ca")
        if issued or change.keyring.ca_service(root, IDENTITY, change.template):
            renewed = _certificate_renewed_by_service(change, old, issued)
            new, bundle, signer = renewed.certificate, renewed.bundle, change.permissions
        else:
            key = change.keyring.open(change.keystore, IDENTITY, change.template)
            if above or not same_key(old, key):
                raise KeystoreError(
                    "the identity CA cannot be renewed with the same key",
                    "It is not self-signed, or the key belongs to another certificate.",
                    "Rotate it without --same-key.",
                )
            if is_weak(old.public_key()):
                raise KeystoreError(
                    "the identity CA cannot be renewed with the same key",
                    f"The key is weak: {algorithm(old.public_key())}.",
                    "Rotate it without --same-key.",
                )
            new = issue_ca(
                key, old.subject, window(change.now, validity or change.template.authority_validity)
            )
            bundle, signer = pem(new), Authority(new, key)
        _check_later(old, new)
        write_bundle(change.transaction, "identity_ca", (IDENTITY,), bundle, change.names)
        change.transaction.write(f"{RETIRED}/{old.serial_number:x}.cert.pem", pem(old))
        change.entries.append(certificate_entry(change.now, "ca", new, reason=SAME_KEY))
        change.record(signer)
        change.finish()
    return _step_result(change, stage=RotationStage.NONE, files=("identity_ca",))


def _certificate_renewed_by_service(
    change: KeystoreChange, old: x509.Certificate, issued: bytes
) -> ImportedAuthority:
    """Return the new CA certificate in ``issued`` (PEM), after comparing it with ``old``.

    A CA service issued this certificate for itself.  Name and key must be the same as in ``old``.
    """
    if not (issued and change.keyring.ca_service(change.root, IDENTITY, change.template)):
        raise UsageError(
            "sros issues the certificate of this identity CA itself"
            if issued
            else "the CA service itself has to issue its new certificate",
            "",
            "Leave --identity-ca out."
            if issued
            else "Give its new certificate with --identity-ca FILE.",
        )
    renewed = check_imported_ca(IDENTITY, issued, None, change.now)
    new = renewed.certificate
    if (old.subject, old.public_key()) != (new.subject, new.public_key()):
        raise KeystoreError(
            "the certificate has another name or key than the identity CA",
            "All enclaves would need new certificates, and each of the two CAs a revocation list.",
            "Make a new keystore for another CA.",
        )
    change.notes += renewed.notes
    return renewed


class _Rotator:
    """Carries out one rotation step.

    ``replacements`` are the replaced CAs, ``kept_elsewhere`` the places of old keys outside of the
    keystore.
    """

    def __init__(self, change: KeystoreChange, rotation: Rotation, *, delete_old_key: bool) -> None:
        self._change = change
        self._transaction = change.transaction
        self._keystore = change.keystore
        self._root = change.root
        self._rotation = rotation
        self._delete = delete_old_key
        self._template = change.template
        self.replacements = list(rotation.replacements)
        self.kept_elsewhere: list[str] = []

    def go_to(
        self, stage: RotationStage, wanted: _WantedAuthorities, progress: Progress | None
    ) -> RotationStage:
        """Stage all changes up to ``stage``; return the stage of the keystore afterwards.

        If there are revocations, and enclaves lack a revocation list of the new identity CA, only
        this list is distributed, and the stage stays DISTRIBUTE.  The reason is that Fast DDS
        2.9.1, once it has a list, refuses every enclave of a CA without a list (tested).
        """
        self._refuse_deletion(stage)  # before a key is made on a token
        if self._rotation.stage is RotationStage.REISSUE:
            self._retire_old_cas()
            self._refuse_deletion(stage)
            return stage
        if self._rotation.stage is RotationStage.NONE:
            successors = self._begin_rotation(wanted, keep_keys=stage is RotationStage.DISTRIBUTE)
            if stage is RotationStage.DISTRIBUTE:
                self._distribute(successors)
            else:
                self._reissue(successors, stage, progress)
        else:
            successors = _distributed_successors(self._change, self._rotation)
            entries = self._keystore.ledger_with("what", "ca").entries
            recorded = {entry.sha256 for entry in entries}
            for successor in successors:
                # The entry was lost since the CA was recorded.
                if digest(successor.new.certificate) not in recorded:
                    self._record_authorities(successor)
            if stage is RotationStage.REISSUE and self._lacks_crl(successors):
                stage = RotationStage.DISTRIBUTE
                self._distribute(successors)
            else:
                self._reissue(successors, stage, progress)
        self._refuse_deletion(stage)
        self._change.record(successors[0].new)
        return stage

    def _refuse_deletion(self, stage: RotationStage) -> None:
        """Raise `UsageError` if asked to delete an old key that sros does not delete."""
        if self._delete and stage is RotationStage.DISTRIBUTE:
            raise UsageError(
                "the stage distribute deletes no key",
                "The old CA is still in use.",
                "Add --delete-old-key to a later stage.",
            )
        if self._delete and self.kept_elsewhere:
            keys = "this key" if len(self.kept_elsewhere) == 1 else "these keys"
            raise UsageError(
                f"sros deletes no key outside of the keystore: {', '.join(self.kept_elsewhere)}",
                f"Another keystore may use {keys}, and there may be copies.",
                f"Leave out --delete-old-key. After the stage retire, delete {keys} yourself, and "
                f"the files `*.key.pem` in '{self._root}/{RETIRED}'.",
            )

    def _note_old_key(
        self,
        roles: Sequence[str],
        old: x509.Certificate,
        stage: RotationStage,
        *,
        is_here: bool,
        elsewhere: str,
    ) -> None:
        """Add a note on where the old key of a CA is after ``stage``, and how long to keep it.

        ``is_here`` says whether the key is in the keystore; ``elsewhere`` is its place outside, or
        "".  A lost key is noted only while revocations need it.
        """
        revokes = stage is RotationStage.REISSUE and IDENTITY in roles
        key, place = (
            f"the old key of the {_ca_name(roles)}",
            f"{self._root}/{retired_key_path(old)}",
        )
        if not (is_here or elsewhere or revokes):
            return
        if not (is_here or elsewhere):
            text = f"{key} is missing; until the stage retire, `sros revoke` needs it at "
            text += f"'{place}'; without the key, add --until-retired"
        elif self._delete:
            text = f"--delete-old-key deletes {key}"
            text += "; until the stage retire, `sros revoke` needs --until-retired" * revokes
        else:
            text = f"sros does not delete {key}, '{elsewhere}'; "
            if not elsewhere:
                text = f"sros keeps {key}, '{place}'; "
            text += (
                "`sros revoke` needs it until the stage retire"
                if revokes
                else "nothing needs it any more: delete it"
            )
        self._change.notes.append(Note("rotation.old-key", f"{text}."))
        if elsewhere:
            self.kept_elsewhere.append(elsewhere)

    # ── the stages ─────────────────────────────────────────────────────────────────────────

    def _begin_rotation(self, wanted: _WantedAuthorities, *, keep_keys: bool) -> list[_Successor]:
        for role in ROLES:
            strangers = unknown_authorities(self._keystore, role)
            if strangers and not self._keystore.ledger_with("what", "ca").gaps and keep_keys:
                raise KeystoreError(
                    f"the file of the {role} CA has {authority_text(strangers[0])}, which the "
                    "keystore does not know",
                    "Every process trusts this CA, and would still trust it during the rotation.",
                    f"Restore '{self._root}/{ca_certificate_path(role)}' from a backup; or, if all "
                    "processes may be restarted together, replace the CAs with --finish.",
                )
        successors = _make_successors(self._change, wanted, keep_keys=keep_keys)
        for successor in successors:
            if wanted.validity is None:
                self._note_earlier_expiry(successor.old[0], successor.new.certificate)
            self._record_authorities(successor)
        self.replacements = [successor.replacement() for successor in successors]
        return successors

    def _record_authorities(self, successor: _Successor) -> None:
        """Record a new CA in the ledger.

        If the ledger has gaps and lacks the CA that is replaced, that CA is recorded first.
        """
        now, old = self._change.now, successor.old[0]
        ledger = self._keystore.ledger_with("what", "ca")
        if ledger.gaps and digest(old) not in {entry.sha256 for entry in ledger.entries}:
            self._change.entries.append(certificate_entry(now, "ca", old, reason=FROM_BEFORE))
        self._change.entries.append(certificate_entry(now, "ca", successor.new.certificate))

    def _note_earlier_expiry(self, old: x509.Certificate, new: x509.Certificate) -> None:
        """Add a note if a new CA expires before the old CA because of the settings.

        Raises:
            UsageError: a new CA would expire earlier, and the keystore has no settings that choose
                this.
        """
        if not (self._root / SETTINGS).exists():
            _check_later(old, new)
        elif validity_of(new).not_after < validity_of(old).not_after:
            text = (
                f"the new CA expires at {validity_of(new).not_after:%Y-%m-%d}, before the old one "
                f"({validity_of(old).not_after:%Y-%m-%d}): authorities.validity of the settings is "
                f"{span_text(self._template.authority_validity)}. --ca-validity chooses "
                "another validity."
            )
            # Both CAs usually have the same dates, and then one note is enough.
            note = Note("keystore.ca-expires-earlier", text)
            if note not in self._change.notes:
                self._change.notes.append(note)

    def _distribute(self, successors: list[_Successor]) -> None:
        for successor in successors:
            bundle = b"".join(map(pem, (*successor.old, successor.new.certificate)))
            if self._can_distribute_crl_with(successor) and (old := self._keystore.revocation_list):
                bundle += self._empty_crl(successor.new, old.number + 1)
            write_bundle(
                self._transaction, successor.file, successor.roles, bundle, self._change.names
            )
        self._write_state(RotationStage.DISTRIBUTE)

    def _empty_crl(self, authority: Authority, number: int) -> bytes:
        """Return an empty revocation list of a new CA, as PEM."""
        signed = sign_list(
            authority, (), number=number, template=self._template, now=self._change.now
        )
        self._change.entries.append(signed.entry)
        return signed.document

    def _lacks_crl(self, successors: list[_Successor]) -> bool:
        """Return whether the distributed identity CA needs a revocation list, but has none.

        This is the case if the first revocation was during the stage DISTRIBUTE.
        """
        return (self._root / CRL).exists() and any(
            self._can_distribute_crl_with(successor)
            and not self._keystore.embedded_list(successor.file)
            for successor in successors
        )

    def _can_distribute_crl_with(self, successor: _Successor) -> bool:
        """Return whether a new CA's revocation list can be distributed together with the CA."""
        return IDENTITY in successor.roles and not are_crls_confusable(
            successor.old[0], successor.new.certificate
        )

    def _reissue(
        self, successors: list[_Successor], stage: RotationStage, progress: Progress | None
    ) -> None:
        by_role = {role: successor for successor in successors for role in successor.roles}
        self._issue_again(by_role.get(IDENTITY), by_role.get(PERMISSIONS), progress)
        self.replacements = []
        for successor in successors:
            trusted = (
                successor.new.certificate,
                *(successor.old if stage is RotationStage.REISSUE else ()),
            )
            bundle = b"".join(map(pem, trusted))
            if IDENTITY in successor.roles and (old := self._keystore.revocation_list):
                if stage is RotationStage.REISSUE:
                    bundle += self._keystore.read(CRL, "revocation list")
                crl = self._empty_crl(successor.new, old.number + 2)
                self._transaction.write(CRL, crl)
                write_copies(self._transaction, self._change.names, CRL_FILE, crl)
            write_bundle(
                self._transaction, successor.file, successor.roles, bundle, self._change.names
            )
            old_key = self._install_key(successor, stage)
            self.replacements.append(replace(successor.replacement(), old_key=old_key))
            if stage is RotationStage.RETIRE:
                self._keep_certificate(successor.old[0])
        self._write_settings(successors)
        if stage is RotationStage.REISSUE:
            self._write_state(stage)
        elif self._rotation.stage is not RotationStage.NONE:
            self._transaction.remove(ROTATION)

    def _issue_again(
        self,
        identity: _Successor | None,
        permissions: _Successor | None,
        progress: Progress | None,
    ) -> None:
        """Stage the certificates, governance and permissions that the new CAs issue.

        Keys, subjects and rights do not change.  If one CA is not replaced, its certificates or
        documents do not change either, so its key is not needed.
        """
        if permissions:
            self._sign_governance(permissions)
        change = self._change
        if identity:
            _refuse_revoked_enclaves(change)
        writer = EnclaveWriter(
            change.transaction,
            change.template,
            change.now,
            identity=identity.new if identity else None,
            permissions=permissions.new if permissions else None,
        )

        def reissue(name: str) -> None:
            try:
                if issuance := _issuance(change, name, identity, permissions):
                    writer.write(issuance)
            except SrosError as error:
                folder = enclave_path(self._root, name)
                raise KeystoreError(
                    f"enclave {name} cannot be moved to the new CA: {error.what}",
                    error.why,
                    error.remedy
                    or f"Run `sros inspect {quote(str(folder))}`. Nothing was changed.",
                ) from error

        writer.for_each(change.names, reissue, progress)
        change.entries += writer.entries
        change.notes += writer.notes
        if permissions:
            change.permissions = permissions.new
            change.stage_zenoh(writer.signed)
        if identity:
            change.notes += change.known.shared_key_notes(change.names)

    def _sign_governance(self, permissions: _Successor) -> None:
        """Stage the governance, unchanged but signed by the new CA, with its copies in enclaves."""
        copies = [
            f"{enclave_folder(name)}/{GOVERNANCE_FILE}"
            for name in self._change.names
            if name != "/"
        ]
        for path in (GOVERNANCE_P7S, *copies):
            file = self._root / path
            if not file.is_file() or file.is_symlink():
                continue
            signed = self._keystore.files.signed_document(
                self._keystore.read(file, "governance document")
            )
            signed.verify(permissions.old[0])
            parse_governance(signed.document)  # raises an error if the governance is malformed
            message = permissions.new.sign(signed.document, "the governance document")
            self._transaction.write(path, message)
            entry = document_entry(self._change.now, "governance", message)
            self._change.entries.append(entry._replace(reason=NEW_CA))

    def _retire_old_cas(self) -> None:
        files = self._keystore.authority_files
        for replacement in self._rotation.replacements:
            new, *others = self._keystore.certificates_of(replacement.file)
            (old,) = [
                certificate for certificate in others if digest(certificate) == replacement.old
            ]
            write_bundle(
                self._transaction,
                replacement.file,
                files[replacement.file],
                pem(new),
                self._change.names,
            )
            self._keep_certificate(old)
            key, elsewhere = retired_key_path(old), replacement.old_key
            is_here = (self._root / key).exists() and not elsewhere
            self._note_old_key(
                files[replacement.file],
                old,
                RotationStage.RETIRE,
                is_here=is_here,
                elsewhere=elsewhere,
            )
            if self._delete and is_here:
                self._transaction.remove(key)
        self._transaction.remove(ROTATION)

    # ── files ──────────────────────────────────────────────────────────────────────────────

    def _write_state(self, stage: RotationStage) -> None:
        rotation = Rotation(stage, tuple(self.replacements))
        self._transaction.write(ROTATION, render_rotation(rotation))

    def _keep_certificate(self, old: x509.Certificate) -> None:
        self._transaction.write(f"{RETIRED}/{old.serial_number:x}.cert.pem", pem(old))

    def _install_key(self, successor: _Successor, stage: RotationStage) -> str:
        """Stage the moves of the old key to ``retired``, and of the new key to the old key's place.

        Returns the place of the old key if it is outside of the keystore, else "".
        """
        transaction, root, roles = self._transaction, self._root, successor.roles
        place = f"{PRIVATE}/{successor.file}.key.pem"
        is_here, elsewhere = (root / place).is_file(), ""
        if not is_here:
            named = self._change.keyring.place(roles[0], self._template)
            elsewhere = "" if named == ca_key_path(roles[0]) else named  # the key was lost
        elif not self._delete:
            key = transaction.read(place)
            transaction.write(retired_key_path(successor.old[0]), key, private=True)
        self._note_old_key(roles, successor.old[0], stage, is_here=is_here, elsewhere=elsewhere)
        if successor.key == f"{PRIVATE}/next_{successor.file}.key.pem":
            transaction.write(place, transaction.read(successor.key), private=True)
            transaction.remove(successor.key)
        elif successor.key != place and (root / place).is_file():
            transaction.remove(place)
            for role in successor.roles:
                if (root / ca_key_path(role)).is_symlink():
                    transaction.remove(ca_key_path(role))
        return elsewhere

    def _write_settings(self, successors: list[_Successor]) -> None:
        """Stage the settings with the places of the new keys."""
        places = {
            role: "" if successor.key.startswith(f"{PRIVATE}/") else successor.key
            for successor in successors
            for role in successor.roles
        }
        template: Template = replace(
            self._template,
            identity_key=places.get(IDENTITY, self._template.identity_key),
            permissions_key=places.get(PERMISSIONS, self._template.permissions_key),
        )
        if template != self._template:
            self._change.entries.append(
                write_settings(self._transaction, template, self._change.now)
            )


# ── files of one enclave ───────────────────────────────────────────────────────────────────


def _refuse_revoked_enclaves(change: KeystoreChange) -> None:
    """Raise `KeystoreError` if keys of enclaves were revoked; the error names all of them.

    A restored keystore has such enclaves.  A new CA would make their keys valid again.

    Raises:
        SrosError: it is not certain which keys were revoked, because a file cannot be read.
    """
    revoked: dict[str, KeystoreError] = {}
    for name in change.names:
        try:
            certificate = change.keystore.certificate_of(name)
        except SrosError:  # `_issuance` reports a certificate that cannot be read
            continue
        key: PublicKey = certificate.public_key()  # type: ignore[assignment]
        error = change.known.revoked_key_error(
            key, f"enclave {name}", "", certificate, publish_first=False
        )
        if error:
            revoked[name] = error
    if revoked:
        first, *others = revoked.values()
        raise KeystoreError(
            f"{', '.join(revoked)} cannot be moved to the new CA: {first.what}"
            + ", and so were the others" * bool(others),
            f"{first.why} A new certificate would undo this. Nothing was changed.",
            perhaps_revoked_step(change.keystore, [*revoked]),
        )


def _issuance(
    change: KeystoreChange,
    name: str,
    identity: _Successor | None,
    permissions: _Successor | None,
) -> Issuance | None:
    """Return what the new CAs issue for an enclave; None for an enclave without a certificate.

    Raises:
        KeystoreError: the old CA did not issue the certificate or sign the permissions.
    """
    root = change.root
    folder = enclave_path(root, name)
    path = folder / CERTIFICATE_FILE
    if not path.exists():
        return None  # the new CA will issue the enclave's first certificate
    kept = change.keystore.certificate(path)
    certificate: NewIdentity | x509.Certificate = kept
    if identity:
        if not issued_by(kept, identity.old[0]):
            raise KeystoreError(
                f"its certificate was issued by {other_issuer_text(kept, identity.old[0])}, not by "
                "the identity CA of this keystore"
            )
        key: PublicKey = kept.public_key()  # type: ignore[assignment]
        certificate = NewIdentity(kept.subject, key)
    rights = None
    if permissions and (folder / PERMISSIONS_FILE).exists():
        rights = _verified_rights(change, name, subject_text(kept.subject), permissions)
    return Issuance(name, certificate, rights)


def _verified_rights(
    change: KeystoreChange, name: str, subject: str, permissions: _Successor
) -> SignedRights:
    root = change.root
    old = change.keystore.signed_grant(name, subject)
    old.signed.verify(permissions.old[0])
    if old.grant is None:
        raise KeystoreError(
            f"its permissions have no grant for {subject}",
            "They belong to another certificate.",
            f"Sign them again with `sros create_permission {quote(str(root))} {name} POLICY_FILE`.",
        )
    return change.recorded_rights.rights_to_sign(name, old.digest, old.grant)


# ── new CAs ────────────────────────────────────────────────────────────────────────────────


@dataclass(frozen=True, slots=True)
class _Successor:
    """A new CA, with the certificates of the CA that it replaces.

    ``file`` is the name of the CA file without suffixes.  ``old`` is the certificate of the old CA,
    followed by the other certificates in the file.  ``key`` is the place of the new key: a URI, or
    a path in the keystore.
    """

    file: str
    roles: tuple[str, ...]
    old: tuple[x509.Certificate, ...]
    new: Authority
    key: str

    def replacement(self) -> Replacement:
        """Return the record of this CA for the rotation file."""
        return Replacement(self.file, digest(self.old[0]), digest(self.new.certificate), self.key)


@dataclass(frozen=True, slots=True)
class _WantedAuthorities:
    """The arguments of `rotate_ca` about the CAs with which a rotation begins."""

    roles: Sequence[str]
    new_keys: Keyring
    existing: Mapping[str, bytes]
    validity: Span | None


def _make_successors(
    change: KeystoreChange, authorities: _WantedAuthorities, *, keep_keys: bool
) -> list[_Successor]:
    """Create the wanted CAs, and stage their keys.

    With ``keep_keys``, new keys in the keystore are written next to the present keys; otherwise,
    they replace the present keys.
    """
    template, new_keys = change.template, authorities.new_keys
    files = change.keystore.authority_files
    wanted = set(authorities.roles or ROLES)
    validity = window(change.now, authorities.validity or template.authority_validity)
    if IDENTITY in wanted and change.keyring.ca_service(change.root, IDENTITY, template):
        raise UsageError(
            f"the identity CA of keystore '{change.root}' is a CA service",
            "sros cannot replace its CA.",
            "Replace only the permissions CA, with --permissions. If the service has a later "
            "certificate for the same key, import it with --same-key --identity-ca FILE; for "
            "another key, make a new keystore.",
        )
    for file, serves in files.items():
        if wanted & set(serves) and not set(serves) <= wanted:
            raise UsageError(
                f"the CA in '{PUBLIC}/{file}.cert.pem' is the identity CA and the permissions CA",
                "It can be replaced only in both roles.",
                "Leave out --identity and --permissions.",
            )
    check_places(new_keys, replace(template, separate_authorities=len(files) > 1))
    successors = []
    for file, serves in files.items():
        if wanted & set(serves):
            _check_place(change, file, serves[0], new_keys)
            at = f"{PRIVATE}/{'next_' if keep_keys else ''}{file}.key.pem"
            successors.append(_make_successor(change, file, serves, at, authorities, validity))
    return successors


def _check_place(change: KeystoreChange, file: str, role: str, new_keys: Keyring) -> None:
    if not new_keys.places.get(role) and not (change.root / f"{PRIVATE}/{file}.key.pem").is_file():
        raise KeystoreError(
            f"the key of the {role} CA is not in the keystore, so the key of the new CA should not "
            "be there either",
            f"The current key is not at '{change.root}/{place}'."
            if (place := change.keyring.place(role, change.template)) == ca_key_path(role)
            else f"The current key is at '{place}'.",
            f"Name a place for the new key with --{role}-key.",
        )


def _ca_name(roles: Sequence[str]) -> str:
    return f"{roles[0]} CA" if len(roles) == 1 else "CA"


def _make_successor(
    change: KeystoreChange,
    file: str,
    roles: tuple[str, ...],
    path_of_key: str,
    wanted: _WantedAuthorities,
    validity: Window,
) -> _Successor:
    transaction, template, new_keys = change.transaction, change.template, wanted.new_keys
    old = change.keystore.certificates_of(file)
    # The dates tell robots which CA replaced which (`retired_authorities`).
    first = validity_of(old[0]).not_before
    if change.now < first:
        raise KeystoreError(
            f"the {_ca_name(roles)} is not valid before {iso(first)}",
            "A CA that replaces it would not be valid earlier either.",
            WAIT_FOR_CA,
        )
    encrypted = change.keyring.is_encrypted(change.keystore, roles[0], template)
    place = new_keys.places.get(roles[0], "")
    elsewhere = replace(template, identity_key="", permissions_key="")
    given = new_keys.is_encrypted(change.keystore, roles[0], elsewhere) if place else None
    if encrypted and given is None and not (new_keys.encrypt or is_token_uri(place)):
        # A mistyped passphrase is refused now.
        change.keyring.open(change.keystore, roles[0], template)
        new_keys = replace(new_keys, encrypt=True, secrets=change.keyring.secrets)
    key = new_keys.make(transaction, path_of_key, roles[0], elsewhere, compared=True)
    if same_key(old[0], key):
        raise KeystoreError(
            f"the key at '{place}' belongs to the current {roles[0]} CA",
            "A new CA needs a new key.",
            f"Name another place with --{roles[0]}-key.",
        )
    is_plain = given is False or not (given or new_keys.encrypt or is_token_uri(place))
    if is_plain and encrypted is not False:
        path = quote(str(key_path(change.root, place or path_of_key)))
        why = "but the current key has one"
        if not encrypted:
            why = "and sros cannot see whether the current key has one"
        text = (
            f"the new key of the {_ca_name(roles)} has no passphrase, {why}. To encrypt it: "
            f"`openssl pkcs8 -topk8 -scrypt -in {path} -out {path}.new && mv {path}.new {path}`."
        )
        change.notes.append(Note("keystore.new-key-plain", text))
    # Fast DDS 2.9.1 refuses peers whose permissions CA has another name (tested).
    name = old[0].subject
    if PERMISSIONS not in roles:
        name = common_name(f"{template.authority_name} identity CA {secrets.token_hex(4)}")
    if existing := next((wanted.existing[r] for r in roles if r in wanted.existing), b""):
        certificate = _existing_ca(change, roles, existing, key, name)
        if validity_of(certificate).not_before < first:
            older = (
                f"{authority_text(certificate)} is valid from an earlier time than the "
                f"{_ca_name(roles)} that it would replace"
            )
            if publish_command(change.root):
                raise KeystoreError(
                    older,
                    "Robots that fetch would take it for a CA that was replaced, and refuse it.",
                    "Leave out the certificate, so that sros makes a new CA.",
                )
            text = (
                f"{older}, so robots take it for a CA that was replaced: the first `sros import` "
                "on each robot needs --force, and the Ansible play `deliver` needs "
                "sros_replace_authorities."
            )
            change.notes.append(Note("rotation.older-ca", text))
    else:
        later = replace(validity, not_before=max(validity.not_before, first))
        certificate = issue_ca(key, name, later)
    return _Successor(file, roles, old, Authority(certificate, key), place or path_of_key)


def _existing_ca(
    change: KeystoreChange, roles: Sequence[str], data: bytes, key: PrivateKey, name: x509.Name
) -> x509.Certificate:
    """Return the certificate of an existing CA, such as one that a backup lacks.

    Raises:
        PkiError: the certificate cannot belong to a CA, or ``key`` does not belong to the
            certificate.
        KeystoreError: the CA has a chain, or is a permissions CA with another name than ``name``.
    """
    imported = [check_imported_ca(role, data, key, change.now) for role in roles]
    certificate = imported[0].certificate
    if imported[0].bundle != pem(certificate) or (
        PERMISSIONS in roles and certificate.subject != name
    ):
        raise KeystoreError(
            f"{subject_text(certificate.subject)} cannot replace the {_ca_name(roles)}",
            f"It has to be self-signed, and a permissions CA has to be named {subject_text(name)}: "
            "otherwise DDS would refuse the enclaves of the other CA.",
            "Make a new CA, or a new keystore for this CA.",
        )
    change.notes += (note for each in imported for note in each.notes)
    return certificate


def _distributed_successors(change: KeystoreChange, rotation: Rotation) -> list[_Successor]:
    """Return the new CAs of a rotation in the stage DISTRIBUTE, with their keys."""
    successors = []
    files = change.keystore.authority_files
    for replacement in rotation.replacements:
        roles = files[replacement.file]
        certificates = change.keystore.certificates_of(replacement.file)
        (new,) = [
            certificate for certificate in certificates if digest(certificate) == replacement.new
        ]
        moved = replace(
            change.template, identity_key=replacement.key, permissions_key=replacement.key
        )
        key = replace(change.keyring, places={}).open(change.keystore, roles[0], moved)
        if not same_key(new, key):
            raise KeystoreError(
                f"the key at '{replacement.key}' does not belong to the new {roles[0]} CA",
                "",
                "Restore the key from a backup.",
            )
        old = tuple(certificate for certificate in certificates if certificate != new)
        successors.append(
            _Successor(replacement.file, roles, old, Authority(new, key), replacement.key)
        )
    return successors


def _check_later(old: x509.Certificate, new: x509.Certificate) -> None:
    """Raise `UsageError` if the new CA certificate expires before the old one."""
    expiry, earlier = validity_of(old).not_after, validity_of(new).not_after
    if earlier < expiry:
        raise UsageError(
            "the new CA would expire before the old one",
            f"The old CA expires at {expiry:%Y-%m-%d}, the new CA would expire at "
            f"{earlier:%Y-%m-%d}.",
            "Choose a longer validity with --ca-validity.",
        )
