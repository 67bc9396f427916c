"""Stages what a rotation changes: new CAs beside the old, in their place, and the old ones away."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from datetime import datetime

from cryptography import x509

from sros_tool.keystore.authority import Authority
from sros_tool.keystore.bundle import (
    authority_files,
    carried_crl,
    certificates_of,
    write_bundle,
    write_copies,
)
from sros_tool.keystore.keyring import Keyring
from sros_tool.keystore.layout import CRL, IDENTITY, PERMISSIONS, PRIVATE, SETTINGS, ca_key
from sros_tool.keystore.ledger import Entry, append, certificate_entry
from sros_tool.keystore.lists import read_crl, sign_list
from sros_tool.keystore.open import load_settings
from sros_tool.keystore.reissue import Progress, reissue
from sros_tool.keystore.rotation import (
    RETIRED,
    ROTATION,
    Rotation,
    Stage,
    lists_confusable,
    render_rotation,
    retired_key,
)
from sros_tool.keystore.successor import Successor, begin, check_later, resume
from sros_tool.keystore.template import Template, render_template
from sros_tool.keystore.transaction import Transaction
from sros_tool.notes import Note
from sros_tool.pki.certificates import digest, pem
from sros_tool.validity import Span, window
from sros_tool.xml import read_bytes


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
