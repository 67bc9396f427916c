"""Update of an existing keystore: settings, governance, and the files that depend on them.

There are two stages, so that a running robot passes the first one without interruption.  In
``credentials``, enclaves get certificates and permissions by the new settings; processes with old
and new files communicate.  In ``governance``, the signed governance and the domains change; with
most differences, processes with the old governance cannot communicate with processes with the new
one.  Each stage is a transaction.  No progress is recorded: a stage remains if it would still
change something.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from pathlib import Path
from shlex import quote
from typing import Unpack

from sros_tool.dds.domains import DomainSet
from sros_tool.dds.governance import Governance, parse_governance
from sros_tool.dds.permissions import Grant
from sros_tool.errors import KeystoreError, Note, SrosError, UsageError
from sros_tool.keystore.comparison import (
    Effect,
    SettingChange,
    compare_governance,
    compare_settings,
    mismatch,
)
from sros_tool.keystore.expiry import (
    Credentials,
    UnreadableEnclave,
    read_credentials,
    refuse_unreadable,
)
from sros_tool.keystore.fleet import EnclaveDomains, robot_of_router
from sros_tool.keystore.issuing.ca_service import CaServiceError
from sros_tool.keystore.issuing.enclave import Issuance, NewIdentity, StatedRights, default_rights
from sros_tool.keystore.layout import (
    GOVERNANCE_XML,
    PERMISSIONS,
    PERMISSIONS_FILE,
    PRIVATE,
    PUBLIC,
    ROLES,
    SETTINGS,
    ca_certificate_path,
    ca_key_path,
    enclave_path,
    waits_for_answer,
)
from sros_tool.keystore.lifecycle.change import Changed, ChangeOptions, KeystoreChange, remove_zenoh
from sros_tool.keystore.lifecycle.create import (
    Creation,
    creation,
    exports_note,
    restart_note,
    write_enclaves,
    write_governance,
)
from sros_tool.keystore.lifecycle.renew import checked_rights
from sros_tool.keystore.lifecycle.replaced import (
    EarlierPermissions,
    ReplacedRights,
    SupersededCertificate,
    gained_rights_text,
    replaced_rights,
    with_expiries_in_ledger,
)
from sros_tool.keystore.lifecycle.rotation import RotationStage, read_rotation
from sros_tool.keystore.reader import OpenedKeystore
from sros_tool.keystore.rights import SignedRights
from sros_tool.keystore.settings import (
    PresentSettings,
    edit_remedy,
    find_edits,
    present_settings,
    with_key_places,
    write_settings,
)
from sros_tool.keystore.template import EVERYTHING, NODE_BASICS, Template, with_values
from sros_tool.parallel import Progress
from sros_tool.pki.certificates import enclave_subject, has_unique_part, same_key, validity_of
from sros_tool.policy.model import DomainProtection, Level
from sros_tool.policy.rights import compare
from sros_tool.translate import (
    allows_everything,
    governance_for,
    grant_rights,
    hidden_protections,
    permissions_for,
    protection_for,
)
from sros_tool.translate_zenoh.graph import shared_nodes
from sros_tool.validity import iso
from sros_tool.xml import read_bytes
from sros_tool.zenoh.configuration import ZenohNetwork, check_network


class UpdateStage(StrEnum):
    """The stages of an update, in order."""

    CREDENTIALS = "credentials"
    """Certificates and permissions of the enclaves, and the settings on which they depend."""
    GOVERNANCE = "governance"
    """The signed governance, and the domains in governance and permissions."""


@dataclass(frozen=True, slots=True, kw_only=True)
class KeystoreUpdate(Changed):
    """The result of an update.

    ``before`` and ``after`` are the names of the templates.  ``done`` are the stages that this
    update carries out, ``left`` the stages that remain.  ``outcomes`` has the enclaves that are
    renewed (new certificate and permissions) and signed (only new permissions).
    """

    before: str
    after: str
    done: tuple[UpdateStage, ...] = ()
    left: tuple[UpdateStage, ...] = ()
    settings: tuple[SettingChange, ...] = ()

    @property
    def looser(self) -> tuple[str, ...]:
        """What the update newly allows, as clauses."""
        gained = [
            f"{right.enclave} gains {gained_rights_text(right.gained)}"
            for right in self.rights
            if right.gained
        ]
        return (
            *(str(setting) for setting in self.settings if setting.effect is Effect.LOOSER),
            *gained,
        )


# ── present and wanted settings ────────────────────────────────────────────────────────────


def edited_settings(
    keystore: OpenedKeystore, present_settings: PresentSettings
) -> tuple[Template, DomainSet]:
    """Return the settings and domains that the edited files of a keystore state.

    Raises:
        KeystoreError: nothing was edited; both files were edited, but to different protection; or
            settings cannot express the governance.
    """
    root = keystore.root
    edits = present_settings.edits
    if not edits:
        raise KeystoreError(
            f"no file of keystore '{root}' was edited",
            f"{SETTINGS} and {GOVERNANCE_XML} are as sros wrote them.",
            "Edit one of them first, or name what to change with --set or --template.",
        )
    if present_settings.written is None and not present_settings.without_settings:
        # Raises the error that says what is wrong with the settings.
        _ = OpenedKeystore(root).template
        raise KeystoreError(
            f"there is no {SETTINGS} in keystore '{root}', so there is no change to apply",
            "",
            f"Restore the settings with `sros update_keystore {quote(str(root))} --discard-edits`.",
        )
    written = present_settings.written or present_settings.settings
    if present_settings.settings.zenoh and not written.zenoh:
        raise KeystoreError(
            f"{SETTINGS} of keystore '{root}' has no table [zenoh] any more",
            "The Zenoh files would stay, and no command would update them.",
            f"First run `sros update_keystore {quote(str(root))} --discard-edits`. To remove the "
            f"Zenoh files, then run `sros zenoh {quote(str(root))} --off`.",
        )
    if not edits.governance:
        return written, present_settings.domains
    path = root / GOVERNANCE_XML
    governance = parse_governance(read_bytes(path, "governance document"), f"'{path}'")
    protection = protection_for(governance)
    if protection is None:
        raise KeystoreError(
            f"'{path}' has rules that the settings of a keystore cannot express",
            "It has several domain rules, its last rule is not for *, or it has a rule for a DDS "
            "topic that is not a topic, service or action of ROS.",
            f"State the protection in {SETTINGS} instead: "
            f"`sros update_keystore {quote(str(root))} --discard-edits` restores the file.",
        )
    if written.protection not in (present_settings.settings.protection, protection):
        raise KeystoreError(
            f"{SETTINGS} and {GOVERNANCE_XML} of keystore '{root}' were edited, and differ",
            "Both state the protection of messages.",
            f"Restore one of the files, or both with `sros update_keystore {quote(str(root))} "
            "--discard-edits`.",
        )
    return replace(written, protection=protection), governance.domains().closed()


def _checked_target(
    keystore: OpenedKeystore, present_settings: PresentSettings, target: Template
) -> Template:
    """Return ``target`` with the present places of the CA keys.

    Raises:
        UsageError: the keystore cannot be changed to ``target``.
    """
    for name in ("identity_key", "permissions_key"):
        wanted, place = getattr(target, name), getattr(present_settings.settings, name)
        if wanted and wanted != place:
            raise UsageError(
                f"the new settings put a CA key at '{wanted}', but the key is at "
                f"'{place or PRIVATE}'",
                "update_keystore does not move CA keys.",
                f"Leave authorities.{name} out; `sros rotate_ca --{name.replace('_', '-')} URI` "
                "replaces the CA by a CA whose key is at URI.",
            )
    if not target.separate_authorities and len(keystore.authority_files) > 1:
        raise UsageError(
            "a keystore with separate CAs cannot change back to one CA for both roles",
            "With one CA, every enclave can sign its own permissions (Cyclone DDS 0.10.2, Fast DDS "
            "2.9.1).",
            "Add --set authorities.layout=separate to keep separate CAs, or create another "
            "keystore.",
        )
    known = hidden_protections(present_settings.settings.protection)
    for hidden, by in hidden_protections(target.protection):
        if (hidden, by) not in known:
            raise UsageError(
                f"the settings would protect {hidden} twice, and the second rule would never apply",
                f"The rule for {by} applies to the same names.",
                "State one rule for these names.",
            )
    return with_key_places(with_values(target), present_settings.settings)


# ── the update ─────────────────────────────────────────────────────────────────────────────


def update_keystore(
    root: Path,
    target: Template,
    domains: DomainSet | None = None,
    *,
    next_stage: bool = False,
    allow_looser: bool = False,
    revoke_old: bool = False,
    replace_edits: bool = False,
    seen_settings: PresentSettings | None = None,
    progress: Progress | None = None,
    **options: Unpack[ChangeOptions],
) -> KeystoreUpdate:
    """Change a keystore to the settings ``target`` and to ``domains`` (None: unchanged).

    Args:
        root: the keystore.
        target: the new settings; the places of the CA keys do not change.
        domains: the new domains.
        next_stage: carry out only the first stage that remains.
        allow_looser: accept settings that allow more than before.
        revoke_old: issue all certificates again, with subjects that no earlier permissions fit, and
            revoke all earlier certificates.
        replace_edits: accept that ``target`` replaces manual edits in the settings or the
            governance, because ``target`` contains or undoes them.
        seen_settings: the settings from which ``target`` was made.
        progress: called with the name of each enclave that is done.
        options: the options of every change of a keystore.

    Raises:
        UsageError: more would be allowed, and ``allow_looser`` is not set; or the keystore cannot
            be changed to ``target``.
        KeystoreError: an enclave cannot be issued again, files were edited by hand, the settings
            are no longer ``seen_settings``, or vendors would refuse enclaves that they accept
            today.
    """
    change = KeystoreChange(root, **options)
    with change:
        present = present_settings(change.keystore)
        if seen_settings is not None and seen_settings != present:
            raise KeystoreError(
                f"the settings of keystore '{root}' have just changed",
                "Another command changed them in the meantime.",
                "Nothing was changed. Run the command again.",
            )
        if present.edits and not replace_edits:
            raise KeystoreError(
                f"files of keystore '{root}' were edited by hand: "
                f"{'; '.join(present.edits.clauses())}",
                "The update would undo the edit.",
                f"First apply or undo the edit: {edit_remedy(root)}",
            )
        goal = _Goal(
            _checked_target(change.keystore, present, target),
            domains.closed() if domains else present.domains,
        )
        pending = _pending_stages(present, goal)
        done = pending[:1] if next_stage else pending
        step = goal if done == pending else _first_goal(present, goal)
        change.template, change.governance = present.settings, present.governance
        change.open_authorities()
        if revoke_old and not pending:
            raise UsageError(
                "nothing changes in the keystore, so no certificate is replaced",
                "",
                f"To replace and revoke certificates, run `sros renew {quote(str(root))} ENCLAVE "
                "--revoke-old`.",
            )
        update = _Updater(change, present, step, revoke_old=revoke_old).update(
            done, pending[len(done) :], progress
        )
        change.remarks += _signed_payload_notes(
            present.settings.protection, goal.settings.protection
        )
        if not change.dry_run and not allow_looser and (looser := update().looser):
            raise UsageError(
                f"the update would make keystore '{root}' looser: {'; '.join(looser)}",
                "Nothing was changed.",
                "If that is intended, add --allow-looser.",
            )
        change.finish(command="update with --revoke-old" if revoke_old else "")
    return update()


@dataclass(frozen=True, slots=True)
class _Goal:
    """The settings and the domains to which an update leads."""

    settings: Template
    domains: DomainSet

    def governance(self) -> Governance:
        """Return the governance that follows from the settings and domains."""
        return governance_for(self.settings.protection, self.domains)


def _first_goal(present_settings: PresentSettings, goal: _Goal) -> _Goal:
    """Return the goal of the first stage, CREDENTIALS: ``goal`` with the present protection.

    The present name, description, distributions and domains also stay.
    """
    settings = replace(
        goal.settings,
        protection=present_settings.settings.protection,
        name=present_settings.settings.name,
        description=present_settings.settings.description,
        distributions=present_settings.settings.distributions,
    )
    return _Goal(settings, present_settings.domains)


def _signed_payload_notes(before: DomainProtection, after: DomainProtection) -> list[Note]:
    """Return a note if payloads become signed but not encrypted: then Fast DDS loses messages."""
    old, new = (
        {
            name
            for name, data in (
                ("every name without a rule of its own", side.default.data),
                *((str(protection), protection.protection.data) for protection in side.named),
            )
            if data is Level.SIGN
        }
        for side in (before, after)
    )
    if not new - old:
        return []
    text = (
        "With data=SIGN, Fast DDS up to 2.14.5 loses messages whose length is not a multiple of "
        f"four (here: of {', '.join(sorted(new - old))}). Use data=NONE with metadata=SIGN, which "
        "signs the payload with its submessage, or data=ENCRYPT."
    )
    return [Note("governance.signed-payload", text)]


_DESCRIPTIVE_KEYS = ("name", "description", "distributions")
"""Settings on which no file depends."""


def _pending_stages(present_settings: PresentSettings, goal: _Goal) -> tuple[UpdateStage, ...]:
    """Return the stages that change something, in order."""
    stages = []
    before, after = present_settings.settings, _first_goal(present_settings, goal).settings
    if before != after:
        stages.append(UpdateStage.CREDENTIALS)
    if goal.governance() != present_settings.governance or present_settings.edits.governance:
        stages.append(UpdateStage.GOVERNANCE)
    named = any(getattr(before, key) != getattr(goal.settings, key) for key in _DESCRIPTIVE_KEYS)
    if not stages and (named or present_settings.edits or present_settings.written is None):
        stages.append(UpdateStage.CREDENTIALS)
    return tuple(stages)


@dataclass(frozen=True, slots=True)
class _ReissuedEnclave:
    """An enclave after its update; ``old`` is the record of its replaced certificate, or None."""

    name: str
    rights: ReplacedRights
    old: SupersededCertificate | None


@dataclass(frozen=True, slots=True)
class _KeptWideRights:
    """An enclave that keeps the right to everything, although the new default rights are narrower.

    ``reissued`` says what was replaced in the enclave; it is None if nothing was.
    """

    name: str
    reissued: _ReissuedEnclave | None


class _Updater:
    """Carries out one update, within a transaction."""

    def __init__(
        self,
        change: KeystoreChange,
        present_settings: PresentSettings,
        goal: _Goal,
        *,
        revoke_old: bool,
    ) -> None:
        self._change = change
        self._root = change.root
        self._present = present_settings
        self._goal = goal
        self._revoke_old = revoke_old
        before, after = present_settings.settings, goal.settings
        self._certificates = revoke_old or (
            (before.certificate_validity, before.unique_subject)
            != (after.certificate_validity, after.unique_subject)
        )
        self._permissions = (
            self._certificates
            or before.permissions_validity != after.permissions_validity
            or present_settings.domains != goal.domains
            # Once there are settings, rights that no ledger records would not be signed again.
            or present_settings.without_settings
        )
        self._kept_open: tuple[str, ...] = ()
        self._before = EnclaveDomains(present_settings.domains, change.fleet)
        self._after = EnclaveDomains(goal.domains, change.fleet)
        change.template, change.domains = goal.settings, goal.domains
        self._writer = change.writer(revoke_old=revoke_old)

    def update(
        self,
        done: tuple[UpdateStage, ...],
        left: tuple[UpdateStage, ...],
        progress: Progress | None,
    ) -> Callable[[], KeystoreUpdate]:
        """Stage the changes of the stages ``done``; return a function that makes the result.

        ``left`` are the stages that remain, for the result.
        """
        change, before, after = self._change, self._present.settings, self._goal.settings
        if after.zenoh and after.zenoh != before.zenoh:
            check_network(after.zenoh)
        names = tuple(
            name for name in change.names if not waits_for_answer(enclave_path(self._root, name))
        )
        governance = self._goal.governance()
        reissued = self._reissue(names, progress) if done else []
        change.entries += self._writer.entries
        if UpdateStage.GOVERNANCE in done:
            write_governance(change, governance, names=names)
        if done:
            self._separate_ca_files()
            change.entries.append(write_settings(change.transaction, after, change.now))
        superseded = [document.old for document in reissued if document.old]
        revoked = self._revoke_old and bool(superseded)
        if revoked:
            change.revoke_superseded(superseded, recipients=names)
        change.notes += self._writer.notes if reissued else ()
        if done:
            replaced = [old.name for old in superseded] if revoked else ()
            change.stage_zenoh(self._writer.signed, replaced=replaced)
        change.record()
        rights = tuple(document.rights for document in reissued)
        if revoked:
            rights = tuple(replaced.after_revocation() for replaced in rights)
        else:
            rights = with_expiries_in_ledger(change.keystore, rights, change.now)
        settings = (
            *compare_governance(self._present.governance, governance),
            *compare_settings(before, after, change.now),
        )
        if revoked or governance != self._present.governance:
            change.restart = names
        else:
            issued = (document.name for document in reissued)
            change.restart = tuple(sorted({*issued, *change.zenoh.restart}))
        if change.restart:
            disturbed = mismatch(self._present.governance, governance)
            change.remarks.append(restart_note(disturbed, revoked=revoked))
            change.remarks.append(exports_note(change.keystore, names))
        change.remarks += self._kept_open_notes()
        change.remarks += self._open_task_notes(settings)
        ends = [right.works_until for right in rights if right.works_until]
        renewed = dict.fromkeys((document.name for document in reissued if document.old), "renewed")
        signed = dict.fromkeys(
            (document.name for document in reissued if not document.old), "signed"
        )
        return lambda: change.result(
            KeystoreUpdate,
            before=before.name,
            after=after.name,
            done=done,
            left=left,
            settings=settings,
            rights=tuple(right for right in rights if right.lost or right.gained),
            outcomes=renewed | signed,
            works_until=max(ends, default=None),
        )

    # ── enclaves ───────────────────────────────────────────────────────────────────────────

    def _reissue(self, names: Sequence[str], progress: Progress | None) -> list[_ReissuedEnclave]:
        before, after = self._present.settings, self._goal.settings
        same_settings = (before.default_permissions, before.short_lived) == (
            after.default_permissions,
            after.short_lived,
        )
        if same_settings and not self._permissions:
            return []

        closes = before.default_permissions == EVERYTHING != after.default_permissions

        keystore = self._change.keystore

        def work(name: str) -> _ReissuedEnclave | _KeptWideRights | UnreadableEnclave | None:
            try:
                state = read_credentials(keystore, name)
                done = self._reissue_one(state)
                keeps_rights = done is None or not done.rights.lost
                if closes and keeps_rights and allows_everything(state.grant):
                    return _KeptWideRights(name, done)
                return done
            except CaServiceError:
                raise
            except SrosError as error:
                return UnreadableEnclave(name, error)

        results = self._writer.for_each(names, work, progress).values()
        unreadable = tuple(result for result in results if isinstance(result, UnreadableEnclave))
        refuse_unreadable(unreadable, "updated", takes_names=False)
        opened = [kept_open for kept_open in results if isinstance(kept_open, _KeptWideRights)]
        self._kept_open = tuple(kept_open.name for kept_open in opened)
        reissued = [
            result.reissued if isinstance(result, _KeptWideRights) else result for result in results
        ]
        return [document for document in reissued if isinstance(document, _ReissuedEnclave)]

    def _reissue_one(self, state: Credentials) -> _ReissuedEnclave | None:
        name = state.name
        change = self._change
        earlier = checked_rights(state, change.authorities, change.recorded_rights)
        replaces_default = self._has_default_rights(state, earlier)
        certificate = self._certificates or self._changes_longest_validity(name)
        if not (self._permissions or replaces_default or certificate):
            return None
        validity = validity_of(state.certificate)
        if not certificate and validity.not_after <= change.now:
            # Without its name, a short-lived enclave is not renewed.
            short = self._present.settings.longest_validity(name) is not None
            which = f"{quote(name)} " * short + "--all-expiring soon"
            raise KeystoreError(
                f"the certificate of enclave {name} has expired",
                f"It was valid until {iso(validity.not_after)}.",
                "First renew all that has expired: "
                f"`sros renew {quote(str(change.root))} {which}`.",
            )
        rights: SignedRights | StatedRights
        if replaces_default:
            enclave = default_rights(self._goal.settings, name)
            rights = StatedRights(enclave, self._after.domains_of(name))
        else:
            rights = earlier._replace(grant=self._grant_for_new_domains(name, earlier.grant))
        identity = self._new_identity(state) if certificate else state.certificate
        issued = self._writer.write(Issuance(name, identity, rights))
        (grant,) = issued.permissions.grants
        present = EarlierPermissions(state.certificate, state.grant)
        old = None
        if certificate:
            old = SupersededCertificate.record(
                name, state.certificate, issued.certificate, change.now
            )
        return _ReissuedEnclave(name, replaced_rights(name, present, grant, change.now), old)

    def _changes_longest_validity(self, name: str) -> bool:
        """Return whether the update changes the longest validity of an enclave's files."""
        before, after = self._present.settings, self._goal.settings
        return before.longest_validity(name) != after.longest_validity(name)

    def _new_identity(self, state: Credentials) -> NewIdentity:
        name, settings = state.name, self._goal.settings
        public = self._change.unrevoked_key(name, state.certificate)
        kept = settings.unique_subject == self._present.settings.unique_subject
        unique = (
            settings.unique_subject
            or self._revoke_old
            or (kept and has_unique_part(state.certificate.subject))
        )
        return NewIdentity(enclave_subject(name, unique=unique), public)

    def _has_default_rights(self, state: Credentials, earlier_rights: SignedRights) -> bool:
        """Return whether an enclave has the default rights, and the update changes these rights."""
        before, after = self._present.settings, self._goal.settings
        if before.default_permissions == after.default_permissions:
            return False
        default = default_rights(before, state.name)
        if earlier_rights.policy not in ("", default.digest):
            return False
        validity, domains = state.lifetime().permissions, self._before.domains_of(state.name)
        (grant,) = permissions_for(
            default, subject=state.grant.subject, validity=validity, domains=domains
        ).grants
        granted_rights = grant_rights(state.name, state.grant)
        if before.default_permissions == EVERYTHING:  # ros2/sros2 adds the DDS topic ``*``
            granted_rights = frozenset(right for right in granted_rights if right.kind != "dds")
        difference = compare(grant_rights(state.name, grant), granted_rights)
        return all(right in difference.covered for _, right in difference.lines())

    def _grant_for_new_domains(self, name: str, grant: Grant) -> Grant:
        """Return a grant whose rules are for the new domains.

        Raises:
            KeystoreError: a rule is not for the domains of the keystore.
        """
        before, after = self._before.domains_of(name), self._after.domains_of(name)
        if before == after:
            return grant
        if any(rule.domains.closed() != before for rule in grant.rules):
            raise KeystoreError(
                f"the permissions of enclave {name} are not for domain {before}",
                "The change would give the enclave the same rights in the new domain as in domain "
                f"{before}, but its permissions are for other domains.",
                f"State the rights with `sros create_permission {quote(str(self._root))} {name} "
                "POLICY_FILE`.",
            )
        rules = tuple(rule._replace(domains=after) for rule in grant.rules)
        return grant._replace(rules=rules)

    # ── authorities ────────────────────────────────────────────────────────────────────────

    def _separate_ca_files(self) -> None:
        """Stage a separate file for each CA if one file has both; DDS loads the same content."""
        settings, files = self._goal.settings, self._change.keystore.authority_files
        if not settings.separate_authorities or len(files) > 1:
            return
        if read_rotation(self._change.keystore).stage is not RotationStage.NONE:
            raise KeystoreError(
                f"a rotation of the CA of keystore '{self._root}' is under way",
                "It replaces the CA in both roles.",
                f"Finish it first: `sros rotate_ca {quote(str(self._root))} --next` for each "
                "stage.",
            )
        (file,) = files
        for path, private, path_of in (
            (f"{PUBLIC}/{file}.cert.pem", False, ca_certificate_path),
            (f"{PRIVATE}/{file}.key.pem", True, ca_key_path),
        ):
            if not (self._root / path).is_file():
                continue  # the key is kept in another place
            data = self._change.transaction.read(path)
            for role in ROLES:
                self._change.transaction.write(path_of(role), data, private=private)
            if path not in map(path_of, ROLES):
                self._change.transaction.remove(path)

    # ── remarks ────────────────────────────────────────────────────────────────────────────

    def _kept_open_notes(self) -> list[Note]:
        if not self._kept_open:
            return []
        which = "these enclaves" if len(self._kept_open) > 1 else "this enclave"
        text = (
            f"Still open: {', '.join(self._kept_open)} may do everything, as before. The new "
            f"default replaces only rights that equal the old default; the rights of {which} "
            "differ from it. State these rights with `sros create_permission "
            f"{quote(str(self._root))} {' '.join(map(quote, self._kept_open))} POLICY_FILE`."
        )
        return [Note("keystore.kept-open", text)]

    def _open_task_notes(self, changes: Sequence[SettingChange]) -> list[Note]:
        identity = self._change.identity.certificate
        shared = same_key(identity, self._change.permissions.key)
        if self._goal.settings.separate_authorities and shared:
            text = (
                "Identity CA and permissions CA now have files of their own, but still the same "
                "key, so an enclave can sign its own permissions until the permissions CA is "
                f"replaced: {self._rotation_clause(f' --{PERMISSIONS}')}."
            )
            return [Note("keystore.one-authority", text)]
        if any(e.effect is Effect.TIGHTER and e.key.startswith("protection") for e in changes):
            role_option = "" if shared else f" --{PERMISSIONS}"
            text = (
                "The signature of the previous governance stays valid: anyone who can change the "
                "files of a robot can put this governance back there, until the CA that signed "
                f"it is replaced: {self._rotation_clause(role_option)}."
            )
            return [Note("keystore.earlier-governance", text)]
        return []

    def _rotation_clause(self, role_option: str) -> str:
        """Return a clause with the command that begins or continues a rotation of CAs.

        ``role_option`` is the option that selects one CA, such as " --permissions"; "" for all CAs.
        """
        command = f"sros rotate_ca {quote(str(self._root))}"
        if read_rotation(self._change.keystore).stage is RotationStage.NONE:
            return f"`{command}{role_option} --next` begins that"
        return f"`{command} --next` goes on with the rotation that is under way"


def set_zenoh(
    root: Path,
    network: ZenohNetwork | None,
    **options: Unpack[ChangeOptions],
) -> Creation:
    """Set the Zenoh network of a keystore, or remove it (None), with the files of all enclaves.

    The router's enclave is created if it is missing.  Files that already have the right content and
    a valid signature are not changed.

    Raises:
        KeystoreError: files of the keystore were edited by hand, or the keystore has no settings.
        PolicyError: an enclave has rights that Zenoh cannot enforce.
        UsageError: the network cannot work, is not for the domains of the keystore, or the router's
            enclave has rights of its own.
    """
    with KeystoreChange(root, **options) as change:
        change.begin_issuing(None)
        _check_settings(change)
        before = change.template.zenoh
        if network:
            network = _with_routers_of_robots(change, network)
            check_network(network)
        if network and before and before.router != network.router:
            change.notes.append(_moved_router_note(before.router, network.router))
        template = replace(change.template, zenoh=network)
        for router in network.router_names() if network else ():
            if router in change.names:
                _check_router(change, router)
        if template != change.template:
            change.template = template
            change.entries.append(write_settings(change.transaction, template, change.now))
        removed = () if network else remove_zenoh(change.transaction)
        write_enclaves(change, {})
        change.notes += (
            Note("zenoh.shared-node", f"{shared.enclaves[0]}: {shared}. `sros check` says more.")
            for shared in shared_nodes(change.zenoh.nodes)
        )
    change.restart = removed or change.restart
    return creation(change, ())


def _with_routers_of_robots(change: KeystoreChange, network: ZenohNetwork) -> ZenohNetwork:
    """Return a network with the routers of the fleet's robots added.

    Raises:
        UsageError: ``network`` has other endpoints for a robot's router, or lacks the router.
    """
    complete = change.with_routers_of_robots(network)
    asked, before = (
        {router.name: router for router in (known.routers if known else ())}
        for known in (network, change.template.zenoh)
    )
    for router in complete.routers:
        of_fleet = asked.get(router.name) not in (router, before.get(router.name))
        if of_fleet and (robot := robot_of_router(change.fleet, router.name)):
            raise UsageError(
                f"the fleet file of keystore '{change.root}' sets the router of {robot.name}",
                f"The fleet file says {router}.",
                f"Change `router` of {robot.name} in the fleet file, and run `sros "
                "generate_artifacts --fleet`.",
            )
    return complete


def _moved_router_note(old: str, new: str) -> Note:
    return Note(
        "zenoh.router-moved",
        f"the router is now in enclave {new}: stop the router that runs in {old}, and start it "
        f"in {new}. Processes accept {old} as the router until they are restarted.",
    )


def _check_settings(change: KeystoreChange) -> None:
    """Raise `KeystoreError` if the settings are missing, or files were edited by hand."""
    root, where = change.root, quote(str(change.root))
    if not (root / SETTINGS).exists():
        raise KeystoreError(
            f"keystore '{root}' was made by ros2/sros2 and has no settings",
            "Without settings, no command would update the Zenoh files.",
            f"Run `sros update_keystore {where} --template sros2 --dry-run`, which shows the "
            "changed settings, and then without --dry-run.",
        )
    if edits := find_edits(change.keystore, change.governance):
        raise KeystoreError(
            f"files of keystore '{root}' were edited by hand: {'; '.join(edits.clauses())}",
            "Writing the settings would undo the edit, or apply it unnoticed.",
            f"First apply or undo the edit: {edit_remedy(root)}",
        )


def _check_router(change: KeystoreChange, router: str) -> None:
    """Raise `UsageError` if a policy gave the enclave of the router its permissions."""
    path = change.keystore.folder(router) / PERMISSIONS_FILE
    if not path.exists():
        return
    digest = hashlib.sha256(change.keystore.read(path, "permissions document")).hexdigest()
    usual = {
        default_rights(replace(change.template, default_permissions=choice), router).digest
        for choice in (EVERYTHING, NODE_BASICS)
    }
    if change.recorded_rights.policy(router, digest) not in ("", *usual):
        raise UsageError(
            f"a policy gave enclave {router} rights, so it is not for the router alone",
            "The router forwards all messages, so a node in its enclave would have the rights of "
            "all enclaves.",
            "With --router, name an enclave that only the router uses.",
        )
