"""The keys of the roles of a publication, which sign its metadata."""

from __future__ import annotations

import os
from collections.abc import Collection
from datetime import datetime, timedelta
from pathlib import Path
from typing import TYPE_CHECKING

from sros_tool.errors import KeystoreError, Note, SrosError
from sros_tool.files import remove_file, staged_file
from sros_tool.folders import Folder
from sros_tool.keystore.delivery.published import MetadataExpiry
from sros_tool.keystore.layout import FLEET_ROOT, fleet_key_path
from sros_tool.validity import iso
from sros_tool.xml import read_bytes

if TYPE_CHECKING:
    from securesystemslib.signer import CryptoSigner

    from sros_tool.keystore.delivery.repository import Roots

_ROLES = ("root", "targets", "snapshot", "timestamp")
_ONLINE = _ROLES[1:]
"""The roles whose keys must be in the keystore."""
_BEFORE = "before"


class RoleKeys:
    """The keys of the metadata roles, and the versions of the root metadata that name them."""

    def __init__(self, roots: Roots, root: Path, root_key: Path | None) -> None:
        """Prepare the keys of the keystore ``root``, whose root key may be at ``root_key``."""
        self.roots = roots
        self.signers: dict[str, list[CryptoSigner]] = {}
        self.new: dict[str, bytes] = {}
        self.has_new_root = False
        self.rotated: tuple[str, ...] = ()
        self.notes: list[Note] = []
        self._root = root
        self._elsewhere = root_key
        self._root_file = root_key or self._path("root")
        self._new_elsewhere = b""

    def recover(self, dry_run: bool) -> None:
        """Complete or undo an interrupted rotation of a root key outside of the keystore.

        The root metadata in the keystore tells whether the new key is already in use.
        """
        if not self._elsewhere or not self.roots.versions:
            return
        spare = self._new_key_path(self._elsewhere)
        is_new_key = self._is_root_key(spare)
        if is_new_key and dry_run:
            self._root_file = spare
        elif is_new_key:
            with Folder(spare.parent) as folder:
                folder.replace(spare.name, self._elsewhere.name)
        elif is_new_key is False and not dry_run and self._is_root_key(self._elsewhere):
            remove_file(spare)

    def _is_root_key(self, path: Path) -> bool | None:
        """Return whether a file has the root key that robots trust; None without a readable key."""
        from sros_tool.keystore.delivery.repository import load_signer

        try:
            signer = load_signer(read_bytes(path, "root key"), f"'{path}'")
        except (SrosError, OSError):
            return None
        return self.roots.has_key("root", signer)

    def open(self, rotate: Collection[str], now: datetime, expiry: MetadataExpiry) -> None:
        """Open or make the key of each role, and add a version of the root if a key changes.

        The roles in ``rotate`` get new keys.

        Raises:
            KeystoreError: a key is missing, or differs from the key that the root metadata names.
        """
        first = not self.roots.versions
        if first and (roles := [role for role in _ROLES if self._path(role).exists()]):
            raise KeystoreError(
                f"'{self._root}' has the {roles[0]} key for publishing, but no {FLEET_ROOT}",
                f"{FLEET_ROOT} says which keys robots trust.",
                f"Restore {FLEET_ROOT} from a backup.",
            )
        self.rotated = () if first else tuple(role for role in _ROLES if role in rotate)
        for role in _ONLINE:
            self.signers[role] = self._online_signers(role, new=first or role in rotate)
        self.roots.check_signers(
            {
                role: (self.signers[role][0], self._path(role))
                for role in _ONLINE
                if fleet_key_path(role) not in self.new
            }
        )
        left = expiry.root if first else self.roots.last.expires - now
        if first or rotate or left < expiry.root / 3:
            self._sign_root(
                now + expiry.root, new=first or "root" in rotate, is_required=bool(rotate)
            )
        if left < expiry.root / 3 and not self.has_new_root:
            end = iso(self.roots.last.expires)
            text = (
                f"the root metadata expires at {end}, and robots then refuse everything: before "
                "then, publish with --root-key FILE"
                if left > timedelta(0)
                else f"the root metadata expired at {end}, and robots refuse everything: publish "
                "with --root-key FILE"
            )
            self.notes.append(Note("fleet.root-expires", text))

    def _path(self, role: str) -> Path:
        return self._root / fleet_key_path(role)

    def _online_signers(self, role: str, *, new: bool) -> list[CryptoSigner]:
        """Return the signer of a role, and the previous one while robots may still need it.

        With ``new``, the role gets a new key.
        """
        from sros_tool.keystore.delivery.repository import load_signer, lost_key_remedy, new_key

        path, before = self._path(role), self._path(f"{role}.{_BEFORE}")
        if new:
            self.new[fleet_key_path(role)] = made = new_key()
            signers = [load_signer(made, "the new key")]
            if path.exists():
                old = read_bytes(path, "key")
                self.new[fleet_key_path(f"{role}.{_BEFORE}")] = old
                signers.append(load_signer(old, f"'{path}'"))
            return signers
        if not path.exists():
            raise KeystoreError(f"'{path}' is missing", "", lost_key_remedy(role))
        signers = [load_signer(read_bytes(path, "key"), f"'{path}'")]
        if before.exists():
            signers.append(load_signer(read_bytes(before, "key"), f"'{before}'"))
        return signers

    def _sign_root(self, expires: datetime, *, new: bool, is_required: bool) -> None:
        """Add a version of the root metadata, if the root key is here.

        ``new`` also makes a new root key.  If ``is_required`` is set, a missing root key is an
        error.
        """
        from sros_tool.keystore.delivery.repository import load_signer, new_key

        path = self._root_file
        keys = []
        if path.exists():
            keys.append(load_signer(read_bytes(path, "root key"), f"'{path}'"))
            if self.roots.versions:
                self.roots.check_signers({"root": (keys[0], path)})
        elif self.roots.versions:
            if is_required or self._elsewhere:
                raise KeystoreError(
                    f"the root key '{path}' does not exist",
                    "This key signs the list of the keys that robots trust.",
                    "Name its file with --root-key.",
                )
            return
        if new and (self.roots.versions or not keys):
            made = new_key()
            if self._elsewhere:
                self._new_elsewhere = made
            else:
                self.new[fleet_key_path("root")] = made
            keys.append(load_signer(made, "the new key"))
        named = {role: signers[0] for role, signers in self.signers.items()}
        self.roots.add({"root": keys[-1], **named}, keys, expires.replace(microsecond=0))
        self.has_new_root = True

    def write_new_key_outside(self) -> None:
        """Write a new root key outside of the keystore next to the key that it will replace."""
        if self._new_elsewhere and self._elsewhere:
            exists = self._elsewhere.exists()
            path = self._new_key_path(self._elsewhere) if exists else self._elsewhere
            if os.path.lexists(path):
                raise KeystoreError(
                    f"'{path}' is in the way",
                    "sros writes the new root key to this path before it records the key in the "
                    "keystore.",
                    "Move this file away.",
                )
            with staged_file(path, self._new_elsewhere) as put_in_place:
                put_in_place()

    def finish(self) -> None:
        """Put the new root key outside of the keystore in its place, and remove replaced keys."""
        if self._new_elsewhere and self._elsewhere:
            with Folder(self._elsewhere.parent) as folder:
                spare = self._new_key_path(self._elsewhere).name
                if folder.state(spare):
                    folder.replace(spare, self._elsewhere.name)
        with Folder(self._root) as folder:
            for role in _ONLINE:
                folder.unlink(fleet_key_path(f"{role}.{_BEFORE}"), missing_ok=True)

    @staticmethod
    def _new_key_path(path: Path) -> Path:
        """Return where a new root key is kept until robots know it."""
        return path.with_name(f"{path.name}.new")
