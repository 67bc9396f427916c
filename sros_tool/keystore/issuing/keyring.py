"""The private keys of the CAs: in the keystore, in another file, or on a PKCS#11 token.

The library never prompts for a secret: it calls the function that the caller gave it for secrets.
"""

from __future__ import annotations

import logging
import os
from collections.abc import Callable, Iterable
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from shlex import quote

from sros_tool.errors import DocumentError, KeystoreError, PkiError, SrosError, UsageError
from sros_tool.files import remove_file, write_new_file
from sros_tool.keystore.issuing.ca_service import CaService, check_ca_service
from sros_tool.keystore.layout import IDENTITY, PERMISSIONS, ROLES, ca_key_path, key_path
from sros_tool.keystore.reader import OpenedKeystore
from sros_tool.keystore.template import Template, is_ca_service
from sros_tool.keystore.transaction import Transaction
from sros_tool.pki.keys import PrivateKey, generate_key, key_pem, load_key
from sros_tool.pki.token import (
    create_token_key,
    holds_token_key,
    is_token_uri,
    open_token_key,
    parse_token_uri,
    refuse_pin,
)
from sros_tool.wording import counted
from sros_tool.xml import read_bytes

_SHORTEST_PASSPHRASE = 12  # in characters; OWASP ASVS 4.0.3, 2.1.1

_LOG = logging.getLogger(__name__)

Secrets = Callable[[str], str]
"""A function that returns a secret, such as a passphrase or PIN, given its description."""


def no_secrets(label: str) -> str:
    """Raise `PkiError`; this is the default of a keyring that cannot ask the user for secrets."""
    raise PkiError(
        f"{label} is needed",
        "The keyring has no secrets handler to ask for it.",
        "Pass a handler, as in `Keyring(secrets=...)`.",
    )


@dataclass(frozen=True, slots=True)
class Keyring:
    """Where the CA keys are, and the function that returns the secrets to open them.

    ``places`` maps a role ("identity", "permissions") to the URI of its key, ``file:PATH`` or
    ``pkcs11:...``, as the user named it.  For other roles, the keystore's settings name the place.

    ``secrets`` returns passphrases and PINs.  With ``encrypt``, new key files get a passphrase, of
    at least 12 characters unless ``short_passphrase`` is set.
    """

    secrets: Secrets = no_secrets
    places: dict[str, str] = field(default_factory=dict)
    encrypt: bool = False
    short_passphrase: bool = False

    def __post_init__(self) -> None:
        """Raise `UsageError` if the URI of a key contains a PIN, or is not valid."""
        for place in self.places.values():
            refuse_pin(place)
            check_ca_service(place)
            if is_token_uri(place):
                parse_token_uri(place)

    def place(self, role: str, template: Template) -> str:
        """Return the URI of a CA's key, or its path relative to the keystore."""
        return self.places.get(role) or template.key_place(role) or ca_key_path(role)

    def ca_service(self, root: Path, role: str, template: Template) -> CaService | None:
        """Return the CA service that issues as the ``role`` CA; None if sros signs with a key.

        Raises:
            UsageError: the place is not valid, or names a service for the permissions CA.
            KeystoreError: the service is named only by a keystore of another user, who could make
                the service issue with the rights of this user.
        """
        place = self.place(role, template)
        if not is_ca_service(place):
            return None
        check_ca_service(place)
        if role != IDENTITY or not template.separate_authorities:
            raise UsageError(
                "a CA service can be only the identity CA",
                "sros itself signs permissions and governance, so the permissions CA needs a key "
                "of its own.",
                "Use --ca-layout separate, and issuer:NAME only for --identity-key.",
            )
        owner = root.stat().st_uid if root.exists() else os.geteuid()
        if not self._is_from_user(role) and owner not in (0, os.geteuid()):
            raise KeystoreError(
                f"the keystore '{root}' of user {owner} names the CA service '{place}'",
                "The program of this service would run with your rights.",
                f"If it may, set SROS_IDENTITY_KEY={place}.",
            )
        return CaService(place, root)

    def open(self, keystore: OpenedKeystore, role: str, template: Template) -> PrivateKey:
        """Return the private key of the ``role`` CA.

        Raises:
            KeystoreError: the key is missing, cannot be opened, or belongs to a CA service.
        """
        root, place = keystore.root, self.place(role, template)
        _refuse_ca_service(role, place)
        try:
            if is_token_uri(place):
                token_key = open_token_key(
                    place, self.secrets, is_from_user=self._is_from_user(role)
                )
                _LOG.info("opened the key of the %s CA, on the token at %s", role, place)
                return token_key
            path = key_path(root, place)
            if not path.exists():
                raise KeystoreError(
                    f"the key of the {role} CA is missing: '{path}'",
                    "It may be stored elsewhere on purpose.",
                    f"Put it back for this command, or set SROS_{role.upper()}_KEY to its place "
                    "(only the command line reads the variable). No new CA is created, because it "
                    "would lock out every existing enclave.",
                )
            pem = self._read(keystore, path, role)
            key = load_key(pem, f"'{path}'", self._passphrase(role))
            _LOG.info("opened the key of the %s CA, '%s'", role, path)
            return key
        except (KeystoreError, PkiError) as error:
            raise KeystoreError(error.what, error.why, error.remedy) from error

    def try_files(
        self, keystore: OpenedKeystore, template: Template, *, missing_ok: bool = False
    ) -> None:
        """Open the key files of the CAs now, to find a wrong or missing passphrase early.

        Raises:
            KeystoreError: a key file cannot be opened, or, without ``missing_ok``, is missing.
        """
        for role in ROLES if template.separate_authorities else (IDENTITY,):
            place = self.place(role, template)
            if is_token_uri(place) or is_ca_service(place):
                continue
            if not missing_ok or key_path(keystore.root, place).exists():
                self.open(keystore, role, template)

    def make(
        self,
        transaction: Transaction,
        file: str,
        role: str,
        template: Template,
        *,
        compared: bool = False,
    ) -> PrivateKey:
        """Return the key for a new CA: the existing key at its place, or a new key created there.

        ``file`` is the path of a new key in the keystore if no other place is named.  A dry run
        opens a token only if the key is ``compared`` with a certificate; otherwise, it returns a
        temporary key.

        Raises:
            KeystoreError: only the template names the place of an existing key, and the key is not
                ``compared`` with a certificate that the user chose.  Without this check, whoever
                wrote the template could make another CA of the user sign for the new keystore.
        """
        place = self.places.get(role) or template.key_place(role)
        _refuse_ca_service(role, place)
        if is_token_uri(place):
            parse_token_uri(place)
            if transaction.dry_run and not compared:
                return generate_key()
            is_from_user = self._is_from_user(role)
            if holds_token_key(place, self.secrets, is_from_user=is_from_user):
                self._check_chosen(role, place, compared=compared)
                return open_token_key(place, self.secrets, is_from_user=is_from_user)
            if transaction.dry_run:
                return generate_key()
            return create_token_key(place, self.secrets, is_from_user=is_from_user)
        if place and key_path(transaction.root, place).exists():
            self._check_chosen(role, place, compared=compared)
            return self.open(OpenedKeystore(transaction.root), role, template)
        key = generate_key()
        pem = key_pem(key, self._new_passphrase(role) if self.encrypt else None)
        if not place:
            transaction.write(file, pem, private=True)
        elif not transaction.dry_run:
            _write_outside(key_path(transaction.root, place), pem, transaction)
        return key

    def _check_chosen(self, role: str, place: str, *, compared: bool) -> None:
        """Raise `KeystoreError` unless the user chose the existing key for a new CA.

        ``compared`` is as in `make`.
        """
        if not (compared or self._is_from_user(role)):
            raise KeystoreError(
                f"the template names an existing key for the {role} CA: '{place}'",
                "Files that the new keystore signs would be valid wherever a CA with that key is "
                "trusted.",
                f"If that is intended, name the key yourself: --{role}-key {quote(place)}.",
            )

    def is_encrypted(self, keystore: OpenedKeystore, role: str, template: Template) -> bool | None:
        """Return whether the file of a CA's key is encrypted; None if there is no readable file."""
        place = self.place(role, template)
        if is_token_uri(place) or is_ca_service(place):
            return None
        with suppress(SrosError):
            return b"ENCRYPTED" in self._read(keystore, key_path(keystore.root, place), role)
        return None

    def settings_with_places(self, template: Template) -> Template:
        """Return a new keystore's settings: ``template`` with the places of the CA keys."""
        identity = self.places.get(IDENTITY) or template.identity_key
        permissions = self.places.get(PERMISSIONS) or template.permissions_key
        if not template.separate_authorities:
            permissions = identity
        return replace(template, identity_key=identity, permissions_key=permissions)

    def _read(self, keystore: OpenedKeystore, path: Path, role: str) -> bytes:
        """Return the PEM of a CA key.

        In a keystore of another user, the settings or a link could name a CA key that only the
        user who runs sros can read, and so make this key sign.  So the owner of the keystore must
        also own the key, unless the user named the place.

        Raises:
            KeystoreError: the key file cannot be read, or belongs to another user than the
                keystore.
        """
        name, root = f"{role} CA key", keystore.root
        owner = root.stat().st_uid if root.exists() else os.geteuid()
        if self._is_from_user(role) or owner in (0, os.geteuid()):
            return keystore.read(path, name)
        try:
            return read_bytes(path, name, owner=owner)
        except DocumentError as error:
            raise KeystoreError(
                error.what,
                error.why,
                f"The keystore '{root}' of user {owner} names this key. If the CA may sign for "
                f"this keystore, set SROS_{role.upper()}_KEY=file:{path}; otherwise, find out who "
                "changed the keystore's settings.",
            ) from error

    def _is_from_user(self, role: str) -> bool:
        """Return whether the user named the place of a key; if not, the keystore's settings did."""
        return bool(self.places.get(role))

    def _new_passphrase(self, role: str) -> str:
        passphrase = self._passphrase(role)()
        length = len(passphrase.strip())
        if length < (1 if self.short_passphrase else _SHORTEST_PASSPHRASE):
            raise UsageError(
                f"the passphrase of the new {role} CA key is too short",
                f"It has {counted(length, 'character')}. Whoever copies the key can try "
                "passphrases without limit, and finds a short one.",
                f"Choose at least {_SHORTEST_PASSPHRASE} characters, or allow a short one with "
                "SROS_SHORT_PASSPHRASE=1 (in Python, short_passphrase=True).",
            )
        return passphrase

    def _passphrase(self, role: str) -> Callable[[], str]:
        return lambda: self.secrets(f"the passphrase of the {role} CA key")


def absolute_place(place: str) -> str:
    """Return the place of a key as a URI, also if it is given as the path of a file."""
    if is_token_uri(place) or is_ca_service(place):
        return place
    return f"file:{Path(place.removeprefix('file:')).absolute()}"


def _refuse_ca_service(role: str, place: str) -> None:
    if is_ca_service(place):
        raise KeystoreError(
            f"the key of the {role} CA belongs to the CA service '{place}'",
            "The service issues certificates, and sros has no key to sign anything else, or to "
            "replace the CA.",
        )


IN_KEYSTORE = Keyring()
"""The keyring for unencrypted CA keys in the keystore."""


def check_places(keyring: Keyring, template: Template) -> None:
    """Raise `KeystoreError` if one CA has both roles, but a different key place for each role."""
    named = {role: keyring.places.get(role) for role in ROLES}
    if not template.separate_authorities and len({place or "" for place in named.values()}) > 1:
        raise KeystoreError(
            "a keystore with one CA for both roles needs one place for its key",
            "The command does not name the same place for the identity and the permissions key.",
            "Name the same place for both, or use --ca-layout separate.",
        )


def check_imported_keys(roles: Iterable[str], keyring: Keyring, template: Template) -> None:
    """Raise `UsageError` if an imported CA comes without its key, or does not fit the CA layout."""
    for role in roles:
        if keyring.place(role, template) == ca_key_path(role):
            raise UsageError(
                f"the certificate of the {role} CA is given without its key",
                "The keystore needs the key to sign.",
                f"Add --{role}-key file:PATH or --{role}-key pkcs11:...",
            )
        if not template.separate_authorities and role != IDENTITY:
            raise UsageError(
                "a keystore with one CA for both roles accepts no separate permissions CA",
                "",
                "Give only --identity-ca, or add --ca-layout separate.",
            )


def _write_outside(path: Path, pem: bytes, transaction: Transaction) -> None:
    """Write a key file outside of the keystore, and remove it if the transaction fails.

    If the folder belongs to the owner of the keystore, the file also gets this owner, who needs the
    key.
    """
    root = transaction.root
    write_new_file(path, pem, for_user=root.stat().st_uid if root.exists() else None)

    def undo() -> None:
        with suppress(OSError):
            remove_file(path)

    transaction.on_failure(undo)
