"""The keys of the CAs: where they are (keystore, another file, token), and how they are opened.

The library never prompts: the caller brings a secrets handler, which may.
"""

from __future__ import annotations

import logging
import os
from collections.abc import Callable, Iterable
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path

from sros_tool.errors import KeystoreError, PkiError, UsageError
from sros_tool.keystore.layout import IDENTITY, PERMISSIONS, ROLES, ca_key
from sros_tool.keystore.template import Template
from sros_tool.keystore.transaction.transaction import Transaction
from sros_tool.pki.keys import PrivateKey, generate_key, key_pem, load_key
from sros_tool.pki.token import SCHEME, create_token_key, holds_token_key, open_token_key
from sros_tool.xml import read_bytes

_LOG = logging.getLogger(__name__)

Secrets = Callable[[str], str]


def no_secrets(what: str) -> str:
    """Raise `PkiError`; use it as the secrets handler if nobody can give a secret."""
    raise PkiError(f"{what} is needed, and nobody is there to give it")


@dataclass(frozen=True, slots=True)
class Keyring:
    """The places of the keys of the two authorities, and the secrets that open them.

    ``places`` maps a role ("identity", "permissions") to the URI of its key, ``file:PATH`` or
    ``pkcs11:...``; for other roles the keystore's settings say the place.  ``secrets`` returns
    passphrases and PINs.  With ``encrypt``, new keys in files get a passphrase.
    """

    secrets: Secrets = no_secrets
    places: dict[str, str] = field(default_factory=dict)
    encrypt: bool = False

    def place(self, role: str, template: Template) -> str:
        """Return the URI of the key of a role, or the path of its file within the keystore."""
        role_key = {IDENTITY: template.identity_key}.get(role, template.permissions_key)
        return self.places.get(role) or role_key or ca_key(role)

    def open(self, root: Path, role: str, template: Template) -> PrivateKey:
        """Return the key of a role.

        Raises:
            KeystoreError: the key is missing, or cannot be used.
        """
        place = self.place(role, template)
        try:
            if place.startswith(SCHEME):
                token_key = open_token_key(place, self.secrets)
                _LOG.info("opened the key of the %s CA, on the token at %s", role, place)
                return token_key
            path = _path(place, root)
            if not path.exists():
                raise KeystoreError(
                    f"the key of the {role} CA is not at '{path}'",
                    "Perhaps it is kept elsewhere on purpose.",
                    "Put it back for this command, or name its place in "
                    f"SROS_{role.upper()}_KEY. A new CA would lock out every enclave that "
                    "exists, so none is made.",
                )
            pem = read_bytes(path, f"{role} CA key")
            key = load_key(pem, f"'{path}'", self._passphrase(role))
            _LOG.info("opened the key of the %s CA, '%s'", role, path)
            return key
        except (KeystoreError, PkiError) as error:
            raise KeystoreError(error.what, error.why, error.remedy) from error

    def make(
        self, transaction: Transaction, file: str, role: str, template: Template
    ) -> PrivateKey:
        """Return the key for a new authority: the existing one at its place, or a new one there.

        ``file`` is its path in the keystore, unless another place is named.
        """
        place = self.places.get(role) or (
            template.identity_key if role == IDENTITY else template.permissions_key
        )
        if place.startswith(SCHEME):
            if holds_token_key(place, self.secrets):
                return open_token_key(place, self.secrets)
            if transaction.dry_run:
                return generate_key()
            return create_token_key(place, self.secrets)
        if place and _path(place, transaction.root).exists():
            return self.open(transaction.root, role, template)
        key = generate_key()
        pem = key_pem(key, self._passphrase(role)() if self.encrypt else None)
        if not place:
            transaction.write(file, pem, private=True)
        elif not transaction.dry_run:
            _write_outside(_path(place, transaction.root), pem, transaction)
        return key

    def remembered(self, template: Template) -> Template:
        """Return ``template`` with the places of the keys, for the settings of a new keystore."""
        identity = self.places.get(IDENTITY) or template.identity_key
        permissions = self.places.get(PERMISSIONS) or template.permissions_key
        if not template.separate_authorities:
            permissions = identity
        return replace(template, identity_key=identity, permissions_key=permissions)

    def _passphrase(self, role: str) -> Callable[[], str]:
        return lambda: self.secrets(f"the passphrase of the {role} CA key")


IN_KEYSTORE = Keyring()
"""The keys lie in the keystore, unencrypted."""


def check_places(keyring: Keyring, template: Template) -> None:
    """Raise `KeystoreError` if one CA does both jobs and two places of its key are named."""
    named = {role: keyring.places.get(role) for role in ROLES}
    if not template.separate_authorities and len({place or "" for place in named.values()}) > 1:
        raise KeystoreError(
            "with one CA for both jobs, its key has one place",
            "Two different places are named.",
            "Name the same place for both, or use --ca-layout separate.",
        )


def check_keys_of(roles: Iterable[str], keyring: Keyring, template: Template) -> None:
    """Raise `UsageError` if the certificate of a CA is given without the place of its key."""
    for role in roles:
        if keyring.place(role, template) == ca_key(role):
            raise UsageError(
                f"the certificate of the {role} CA is given without its key",
                "A keystore signs with it.",
                f"Add --{role}-key file:PATH or --{role}-key pkcs11:...",
            )
        if not template.separate_authorities and role != IDENTITY:
            raise UsageError(
                "with one CA for both jobs, its certificate is the identity CA's",
                "",
                "Give --identity-ca alone, or --ca-layout separate.",
            )


def _path(place: str, root: Path) -> Path:
    return root / place.removeprefix("file:").removeprefix("//")


def _write_outside(path: Path, pem: bytes, transaction: Transaction) -> None:
    """Write a key file outside of the keystore; remove it if the transaction fails."""
    handle = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)

    def undo() -> None:
        with suppress(OSError):
            path.unlink()

    transaction.on_failure(undo)
    with os.fdopen(handle, "wb") as file:
        file.write(pem)
        file.flush()
        os.fsync(file.fileno())
