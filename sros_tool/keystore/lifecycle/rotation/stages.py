"""Issues and signs everything of a keystore anew, by CAs that take the place of others.

distribute: a new CA is trusted beside the old one.  reissue: everything is issued and signed anew
by the new one.  retire: the old one is trusted no longer.  Each is one transaction.
"""

from __future__ import annotations

import secrets
from collections.abc import Sequence
from dataclasses import dataclass, replace
from datetime import datetime
from pathlib import Path

from cryptography import x509

from sros_tool.dds.governance import parse_governance
from sros_tool.errors import KeystoreError, Note, SrosError, UsageError
from sros_tool.keystore.authorities.authority import Authority, write_bundle, write_copies
from sros_tool.keystore.authorities.keyring import IN_KEYSTORE, Keyring, check_places
from sros_tool.keystore.issuing.issuance import Issuance, policies_of, renewed, teller
from sros_tool.keystore.layout import (
    CRL,
    GOVERNANCE_P7S,
    IDENTITY,
    PERMISSIONS,
    PRIVATE,
    PUBLIC,
    RETIRED,
    ROLES,
    ROTATION,
    SETTINGS,
    ca_key,
    enclave_folder,
    list_enclaves,
)
from sros_tool.keystore.ledger import Entry, append, certificate_entry, document_entry
from sros_tool.keystore.lifecycle.revocation_list import sign_list
from sros_tool.keystore.lifecycle.rotation.state import (
    Replacement,
    Rotation,
    Stage,
    lists_confusable,
    read_rotation,
    render_rotation,
    retired_key,
)
from sros_tool.keystore.reader import (
    authority_files,
    carried_crl,
    certificates_of,
    load_settings,
    read_crl,
    read_granted,
)
from sros_tool.keystore.template import Template, render_template
from sros_tool.keystore.transaction.recovery import tidy
from sros_tool.keystore.transaction.stage import Change
from sros_tool.keystore.transaction.transaction import Transaction
from sros_tool.parallel import Progress
from sros_tool.pki import smime
from sros_tool.pki.certificates import (
    common_name,
    digest,
    issue_ca,
    issued_by,
    load_certificate,
    pem,
    same_key,
    subject_text,
)
from sros_tool.validity import Span, Window, window
from sros_tool.xml import read_bytes

__all__ = ["Progress", "Turn", "reissue"]


@dataclass(frozen=True, slots=True)
class Turn:
    """An authority that takes the place of another."""

    old: x509.Certificate
    new: Authority


@dataclass(frozen=True, slots=True)
class Reissued:
    """What the ledger is told, and remarks."""

    entries: tuple[Entry, ...]
    notes: tuple[Note, ...]


def reissue(
    transaction: Transaction,
    names: Sequence[str],
    identity: Turn | None,
    permissions: Turn | None,
    template: Template,
    now: datetime,
    progress: Progress | None = None,
) -> Reissued:
    """Stage what the CAs in turn have to issue: certificates, governance and permissions.

    Keys, subjects and rights stay.  What a CA that is not in turn has issued is left as it is, so
    its key is not needed.  Raises `KeystoreError` for an enclave that is not of the old CA.
    """
    work = _Reissuer(transaction, identity, permissions, template, now)
    entries = (*work.governance(names), *work.enclaves(names, progress))
    return Reissued(entries, work.notes)


class _Reissuer:
    def __init__(
        self,
        transaction: Transaction,
        identity: Turn | None,
        permissions: Turn | None,
        template: Template,
        now: datetime,
    ) -> None:
        self._transaction = transaction
        self._identity = identity
        self._permissions = permissions
        self._issuance = Issuance(
            transaction,
            template,
            now,
            identity=identity.new if identity else None,
            permissions=permissions.new if permissions else None,
        )
        self._now = now
        self._policies = policies_of(transaction.root)
        self.notes = self._issuance.notes

    def governance(self, names: Sequence[str]) -> list[Entry]:
        """Sign the keystore's governance anew, as it is, and that of enclaves with a copy."""
        if not self._permissions:
            return []
        copies = [f"{enclave_folder(name)}/governance.p7s" for name in names if name != "/"]
        entries = []
        for path in (GOVERNANCE_P7S, *copies):
            real = self._transaction.root / path
            if not real.is_file() or real.is_symlink():
                continue
            signed = smime.parse(read_bytes(real, "governance document"))
            signed.verify(self._permissions.old)
            document = signed.document.replace(b"\r\n", b"\n")
            message = self._permissions.new.sign(
                document, parse_governance(document), parse_governance, "the governance document"
            )
            self._transaction.write(path, message)
            entries.append(document_entry(self._now, "governance", message))
        return entries

    def enclaves(self, names: Sequence[str], progress: Progress | None) -> list[Entry]:
        """Issue and sign for all enclaves, on all cores."""
        self._issuance.spread(names, self._enclave, teller(progress))
        return self._issuance.entries

    def _enclave(self, name: str) -> None:
        folder = enclave_folder(name)
        path = self._transaction.root / folder / "cert.pem"
        if not path.exists():
            return  # its key waits for a certificate, which will be of the new CA
        try:
            certificate = load_certificate(read_bytes(path, "certificate"), f"'{path}'")
            if self._identity:
                if not issued_by(certificate, self._identity.old):
                    raise KeystoreError(
                        f"its certificate was not issued by the identity CA of this keystore but "
                        f"by {subject_text(certificate.issuer)}"
                    )
                certificate = self._issuance.certificate(
                    name,
                    certificate.subject,
                    certificate.public_key(),  # type: ignore[arg-type]
                )
            if self._permissions:
                self._sign_permissions(name, certificate, self._permissions)
        except SrosError as error:
            raise KeystoreError(
                f"enclave {name} cannot be moved to the new CA: {error.what}",
                error.why,
                error.remedy or f"See `sros inspect {path.parent}`; nothing was changed.",
            ) from error

    def _sign_permissions(self, name: str, certificate: x509.Certificate, turn: Turn) -> None:
        path = self._transaction.root / enclave_folder(name) / "permissions.p7s"
        if not path.exists():
            return
        subject = subject_text(certificate.subject)
        old = read_granted(path, subject)
        old.signed.verify(turn.old)
        if old.grant is None:
            raise KeystoreError(
                f"its permissions have no grant for {subject}",
                "They belong to another certificate.",
                f"Sign them anew with `sros create_permission {self._transaction.root} {name} "
                "POLICY_FILE`.",
            )
        policy = self._policies.get(old.digest, "")
        self._issuance.permissions(name, certificate, renewed(old.grant), policy)


@dataclass(frozen=True, slots=True)
class Successor:
    """A new CA, and the certificates of the one whose place it takes (with the chain above it).

    ``file`` is the stem of the CA file, ``key`` the place of the new key: a URI, or a path in the
    keystore.
    """

    file: str
    roles: tuple[str, ...]
    old: tuple[x509.Certificate, ...]
    new: Authority
    key: str

    def turn(self) -> Turn:
        """What has to be issued anew."""
        return Turn(self.old[0], self.new)

    def replacement(self) -> Replacement:
        """What is remembered of it."""
        return Replacement(self.file, digest(self.old[0]), digest(self.new.certificate), self.key)


def begin(
    transaction: Transaction,
    roles: Sequence[str],
    new_keys: Keyring,
    keyring: Keyring,
    template: Template,
    validity: Window,
    *,
    beside: bool,
) -> list[Successor]:
    """Make new CAs for ``roles`` (none: for all), and stage their keys.

    Where they go into the keystore, they go ``beside`` the present keys, or in their place.
    """
    root = transaction.root
    files = authority_files(root)
    wanted = set(roles or ROLES)
    for file, serves in files.items():
        if wanted & set(serves) and not set(serves) <= wanted:
            raise UsageError(
                f"the CA in '{PUBLIC}/{file}.cert.pem' does both jobs",
                "It can only be replaced for both.",
                "Leave out --identity and --permissions.",
            )
    check_places(new_keys, replace(template, separate_authorities=len(files) > 1))
    found = []
    for file, serves in files.items():
        if wanted & set(serves):
            _check_place(root, file, serves[0], new_keys, keyring, template)
            at = f"{PRIVATE}/{'next_' if beside else ''}{file}.key.pem"
            found.append(_make(transaction, file, serves, at, new_keys, template, validity))
    return found


def _check_place(
    root: Path, file: str, role: str, new_keys: Keyring, keyring: Keyring, template: Template
) -> None:
    if not new_keys.places.get(role) and not (root / f"{PRIVATE}/{file}.key.pem").is_file():
        raise KeystoreError(
            f"the key of the {role} CA is not in the keystore, so its successor's should not be "
            "either",
            f"It is at '{keyring.place(role, template)}'.",
            f"Name a place for the new one with --{role}-key.",
        )


def _make(
    transaction: Transaction,
    file: str,
    roles: tuple[str, ...],
    at: str,
    new_keys: Keyring,
    template: Template,
    validity: Window,
) -> Successor:
    old = certificates_of(transaction.root, file)
    present = transaction.root / f"{PRIVATE}/{file}.key.pem"
    encrypted = present.is_file() and b"ENCRYPTED" in read_bytes(present, "CA key")
    new_keys = replace(new_keys, encrypt=new_keys.encrypt or encrypted)
    place = new_keys.places.get(roles[0], "")
    key = new_keys.make(
        transaction, at, roles[0], replace(template, identity_key="", permissions_key="")
    )
    if same_key(old[0], key):
        raise KeystoreError(
            f"the key at '{place}' is that of the present {roles[0]} CA",
            "A new CA needs a new key.",
            "Name another place.",
        )
    # Fast DDS refuses peers whose permissions CA has another name (2.9.1: ran).
    name = old[0].subject
    if PERMISSIONS not in roles:
        name = common_name(f"{template.authority_name} identity CA {secrets.token_hex(4)}")
    certificate = issue_ca(key, name, validity)
    return Successor(file, roles, old, Authority(certificate, key), place or at)


def resume(root: Path, rotation: Rotation, keyring: Keyring, template: Template) -> list[Successor]:
    """The new CAs that were distributed, with their keys."""
    found = []
    files = authority_files(root)
    for each in rotation.replacements:
        roles = files[each.file]
        certificates = certificates_of(root, each.file)
        (new,) = [one for one in certificates if digest(one) == each.new]
        moved = replace(template, identity_key=each.key, permissions_key=each.key)
        key = replace(keyring, places={}).open(root, roles[0], moved)
        if not same_key(new, key):
            raise KeystoreError(
                f"the key at '{each.key}' is not that of the new {roles[0]} CA",
                "",
                "Restore it from a backup.",
            )
        old = tuple(one for one in certificates if one != new)
        found.append(Successor(each.file, roles, old, Authority(new, key), each.key))
    return found


def check_later(old: x509.Certificate, new: x509.Certificate) -> None:
    """Raise `UsageError` where a new CA would end before the old one, which nobody asked for."""
    if new.not_valid_after_utc < old.not_valid_after_utc:
        raise UsageError(
            "the new CA would end before the old one",
            f"The old one ends at {old.not_valid_after_utc:%Y-%m-%d}, the new one would at "
            f"{new.not_valid_after_utc:%Y-%m-%d}.",
            "Say how long it is to be valid with --ca-validity.",
        )


class Rotator:
    """Does one stage in one transaction.

    ``replacements`` are the CAs that it is about, and ``kept_elsewhere`` the places of old keys
    that do not lie in the keystore and are left there.  ``notes`` are remarks on what was issued.
    """

    def __init__(
        self,
        transaction: Transaction,
        rotation: Rotation,
        keyring: Keyring,
        new_keys: Keyring,
        now: datetime,
        *,
        delete_old_key: bool,
    ) -> None:
        self._transaction = transaction
        self._root = transaction.root
        self._rotation = rotation
        self._keyring = keyring
        self._new_keys = new_keys
        self._now = now
        self._delete = delete_old_key
        self._template = load_settings(self._root)
        self._entries: list[Entry] = []
        self.replacements = list(rotation.replacements)
        self.kept_elsewhere: list[str] = []
        self.notes: tuple[Note, ...] = ()

    def go(
        self,
        stage: Stage,
        names: Sequence[str],
        roles: Sequence[str],
        validity: Span | None,
        progress: Progress | None,
    ) -> Stage:
        """Stage all that leads to ``stage``; the stage that is reached.

        It is the present one where the new identity CA has no revocation list yet, which has to be
        distributed first: Fast DDS 2.9.1 refuses whoever is of a CA without one (ran).
        """
        if self._rotation.stage is Stage.REISSUE:
            self._retire(names)
        elif self._rotation.stage is Stage.NONE:
            turns = begin(
                self._transaction,
                roles,
                self._new_keys,
                self._keyring,
                self._template,
                window(self._now, validity or self._template.authority_validity),
                beside=stage is Stage.DISTRIBUTE,
            )
            for each in turns:
                if validity is None:
                    check_later(each.old[0], each.new.certificate)
                self._entries.append(certificate_entry(self._now, "ca", each.new.certificate))
            self.replacements = [each.replacement() for each in turns]
            if stage is Stage.DISTRIBUTE:
                self._distribute(turns, names)
            else:
                self._reissue(turns, names, stage, progress)
        else:
            turns = resume(self._root, self._rotation, self._keyring, self._template)
            if stage is Stage.REISSUE and self._lacks_crl(turns):
                stage = Stage.DISTRIBUTE
                self._distribute(turns, names)
            else:
                self._reissue(turns, names, stage, progress)
        append(self._transaction, self._entries)
        return stage

    # ── the stages ─────────────────────────────────────────────────────────────────────────

    def _distribute(self, turns: list[Successor], names: Sequence[str]) -> None:
        for each in turns:
            bundle = b"".join(map(pem, (*each.old, each.new.certificate)))
            if self._takes_crl(each) and (old := read_crl(self._root)):
                bundle += self._empty_crl(each.new, old.number + 1)
            write_bundle(self._transaction, each.file, each.roles, bundle, names)
        self._write_state(Stage.DISTRIBUTE)

    def _empty_crl(self, authority: Authority, number: int) -> bytes:
        """A list of the new CA, which has issued nothing yet that could be revoked."""
        signed = sign_list(authority, (), number=number, template=self._template, now=self._now)
        self._entries.append(signed.entry)
        return signed.document

    def _lacks_crl(self, turns: list[Successor]) -> bool:
        """Whether something was revoked since the new identity CA was distributed."""
        return (self._root / CRL).exists() and any(
            self._takes_crl(each) and not carried_crl(self._root, each.file) for each in turns
        )

    def _takes_crl(self, each: Successor) -> bool:
        """Whether the list of a new CA can be distributed before that CA issues."""
        return IDENTITY in each.roles and not lists_confusable(each.old[0], each.new.certificate)

    def _reissue(
        self,
        turns: list[Successor],
        names: Sequence[str],
        stage: Stage,
        progress: Progress | None,
    ) -> None:
        of = {role: each.turn() for each in turns for role in each.roles}
        identity, permissions = of.get(IDENTITY), of.get(PERMISSIONS)
        done = reissue(
            self._transaction, names, identity, permissions, self._template, self._now, progress
        )
        self._entries += done.entries
        self.notes = done.notes
        self.replacements = []
        for each in turns:
            trusted = (each.new.certificate, *(each.old if stage is Stage.REISSUE else ()))
            bundle = b"".join(map(pem, trusted))
            if IDENTITY in each.roles and (old := read_crl(self._root)):
                if stage is Stage.REISSUE:
                    bundle += read_bytes(self._root / CRL, "revocation list")
                crl = self._empty_crl(each.new, old.number + 2)
                self._transaction.write(CRL, crl)
                write_copies(self._transaction, names, "crl.pem", crl)
            write_bundle(self._transaction, each.file, each.roles, bundle, names)
            old_key = self._install_key(each)
            self.replacements.append(replace(each.replacement(), old_key=old_key))
            if stage is Stage.RETIRE:
                self._keep_certificate(each.old[0])
        self._write_settings(turns)
        if stage is Stage.REISSUE:
            self._write_state(stage)
        elif self._rotation.stage is not Stage.NONE:
            self._transaction.remove(ROTATION)

    def _retire(self, names: Sequence[str]) -> None:
        files = authority_files(self._root)
        for each in self._rotation.replacements:
            new, *others = certificates_of(self._root, each.file)
            (old,) = [one for one in others if digest(one) == each.old]
            write_bundle(self._transaction, each.file, files[each.file], pem(new), names)
            self._keep_certificate(old)
            key = retired_key(old)
            if self._delete and (self._root / key).exists():
                self._transaction.remove(key)
        self._transaction.remove(ROTATION)

    # ── files ──────────────────────────────────────────────────────────────────────────────

    def _write_state(self, stage: Stage) -> None:
        rotation = Rotation(stage, tuple(self.replacements))
        self._transaction.write(ROTATION, render_rotation(rotation))

    def _keep_certificate(self, old: x509.Certificate) -> None:
        self._transaction.write(f"{RETIRED}/{old.serial_number:x}.cert.pem", pem(old))

    def _install_key(self, each: Successor) -> str:
        """Put the new key in the place of the old one, which goes to ``retired``.

        Returns the place of the old key where that is elsewhere.
        """
        transaction, root = self._transaction, self._root
        old_key = ""
        place = f"{PRIVATE}/{each.file}.key.pem"
        if (root / place).is_file():
            if not self._delete:
                key = read_bytes(root / place, "CA key")
                transaction.write(retired_key(each.old[0]), key, private=True)
        else:
            old_key = self._keyring.place(each.roles[0], self._template)
            self.kept_elsewhere.append(old_key)
        if each.key == f"{PRIVATE}/next_{each.file}.key.pem":
            transaction.write(place, read_bytes(root / each.key, "CA key"), private=True)
            transaction.remove(each.key)
        elif each.key != place and (root / place).is_file():
            transaction.remove(place)
            for role in each.roles:
                if (root / ca_key(role)).is_symlink():
                    transaction.remove(ca_key(role))
        return old_key

    def _write_settings(self, turns: list[Successor]) -> None:
        """Have the settings name the places of the new keys."""
        places = {
            role: "" if each.key.startswith(f"{PRIVATE}/") else each.key
            for each in turns
            for role in each.roles
        }
        template: Template = replace(
            self._template,
            identity_key=places.get(IDENTITY, self._template.identity_key),
            permissions_key=places.get(PERMISSIONS, self._template.permissions_key),
        )
        if template != self._template:
            comment = b"# The choices of this keystore; what is added later follows them.\n"
            self._transaction.write(SETTINGS, comment + render_template(template).encode())


@dataclass(frozen=True, slots=True)
class RotationStep:
    """What was done, or with ``dry_run`` would be.

    ``stage`` is the one that is reached, ``files`` are the stems of the CA files that it is about,
    ``kept_elsewhere`` the places of old keys outside of the keystore, which are left there.
    """

    root: Path
    stage: Stage
    files: tuple[str, ...]
    enclaves: tuple[str, ...]
    changes: tuple[Change, ...]
    kept_elsewhere: tuple[str, ...] = ()
    notes: tuple[Note, ...] = ()


def rotate_ca(
    root: Path,
    to: Stage | None = None,
    *,
    roles: Sequence[str] = (),
    now: datetime,
    finish: bool = False,
    keyring: Keyring = IN_KEYSTORE,
    new_keys: Keyring = IN_KEYSTORE,
    validity: Span | None = None,
    delete_old_key: bool = False,
    dry_run: bool = False,
    progress: Progress | None = None,
) -> RotationStep:
    """Go to the stage ``to`` (default: the next one), or through all that remain with ``finish``.

    A stage that was reached already is left as it is, so that ``to`` can be repeated.  ``roles``
    ("identity", "permissions"; default both) count where a rotation begins.  ``keyring`` reaches
    the present keys; ``new_keys`` says where new ones are made, where not in the keystore.
    """
    if not dry_run:
        tidy(root)
    list_enclaves(root)
    with Transaction(root, dry_run=dry_run) as transaction:
        names = list_enclaves(root)
        rotation = read_rotation(root)
        stage = Stage.RETIRE if finish else _wanted(root, rotation, to)
        work = Rotator(transaction, rotation, keyring, new_keys, now, delete_old_key=delete_old_key)
        if finish or stage not in (rotation.stage, Stage.NONE):
            stage = work.go(stage, names, roles, validity, progress)
            transaction.commit()
    return RotationStep(
        root,
        stage,
        tuple(each.file for each in work.replacements),
        names,
        tuple(transaction.changes),
        tuple(work.kept_elsewhere),
        work.notes,
    )


def _wanted(root: Path, rotation: Rotation, to: Stage | None) -> Stage:
    """The stage to go to; NONE where there is nothing to do.

    Raises `UsageError` where it is over, or where another one comes before it.
    """
    if to is None:
        return rotation.following()
    if to is Stage.RETIRE and rotation.stage is Stage.NONE:
        return Stage.NONE  # it is done
    order = list(Stage)
    ahead = order.index(to) - order.index(rotation.stage)
    if ahead > 1:
        raise UsageError(
            f"the stage {to} cannot be reached yet",
            f"Before it come {rotation.following()}, and restarting the processes.",
            f"Run `sros rotate_ca {root} --next`, or `--finish` to do all stages at once.",
        )
    if ahead < 0:
        raise UsageError(
            f"the stage {to} is over",
            f"The keystore is at {rotation.stage}; a rotation does not go back.",
            f"Run `sros rotate_ca {root} --next`.",
        )
    return to


def renew_identity_ca(
    root: Path,
    *,
    now: datetime,
    keyring: Keyring = IN_KEYSTORE,
    validity: Span | None = None,
    dry_run: bool = False,
) -> RotationStep:
    """Give the identity CA a new certificate of the same name and key, which ends later.

    All certificates that it has issued fit both, on Cyclone DDS 0.10.2 and Fast DDS 2.9.1 (ran), so
    nothing else changes.  A permissions CA cannot be renewed so: what it has signed names the very
    certificate.
    """
    if not dry_run:
        tidy(root)
    list_enclaves(root)
    with Transaction(root, dry_run=dry_run) as transaction:
        names = list_enclaves(root)
        if len(authority_files(root)) == 1:
            raise KeystoreError(
                "the one CA of this keystore cannot keep its key",
                "It signs permissions, too, and DDS takes these from the very certificate only.",
                "Rotate it without --same-key.",
            )
        if read_rotation(root).stage is not Stage.NONE:
            raise KeystoreError("a rotation is under way", "", "Bring it to its end first.")
        template = load_settings(root)
        key = keyring.open(root, IDENTITY, template)
        old, *above = certificates_of(root, "identity_ca")
        if above or not same_key(old, key):
            raise KeystoreError(
                "the identity CA cannot be renewed with its key",
                "It is not self-signed, or the key is not its own.",
            )
        new = issue_ca(key, old.subject, window(now, validity or template.authority_validity))
        check_later(old, new)
        write_bundle(transaction, "identity_ca", (IDENTITY,), pem(new), names)
        transaction.write(f"{RETIRED}/{old.serial_number:x}.cert.pem", pem(old))
        append(transaction, [certificate_entry(now, "ca", new)])
        transaction.commit()
    return RotationStep(root, Stage.NONE, ("identity_ca",), names, tuple(transaction.changes))
