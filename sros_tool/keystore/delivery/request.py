"""Signing requests: made on the robot, for a key that stays there."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from shlex import quote

from sros_tool.errors import KeystoreError, Note, UsageError
from sros_tool.keystore.authorities.keyring import no_secrets
from sros_tool.keystore.delivery.trust import refuse_ca_keystore
from sros_tool.keystore.issuing.tokens import place_in, token_notes, token_places
from sros_tool.keystore.known_keys import KnownKeys
from sros_tool.keystore.layout import (
    CERTIFICATE_FILE,
    KEY_FILE,
    KEY_URI_FILE,
    REQUEST,
    enclave_folder,
    has_key,
)
from sros_tool.keystore.transaction.recovery import tidy
from sros_tool.keystore.transaction.stage import Change
from sros_tool.keystore.transaction.transaction import Transaction
from sros_tool.names import check_enclave_name
from sros_tool.pki.keys import PrivateKey, generate_key, key_pem, load_key
from sros_tool.pki.requests import key_digest, load_request, make_request
from sros_tool.pki.token import (
    Secrets,
    TokenKey,
    TokenUri,
    make_enclave_key,
    open_enclave_key,
    token_file,
)
from sros_tool.xml import read_bytes


@dataclass(frozen=True, slots=True)
class Requested:
    """A new signing request for the enclave ``name``; ``key`` is the SHA-256 of its public key.

    ``token`` is the place of the key, if it is on a PKCS#11 token.
    """

    name: str
    file: Path
    key: str
    changes: tuple[Change, ...]
    token: TokenUri | None = None
    notes: tuple[Note, ...] = ()


def create_request(
    folder: Path,
    name: str,
    *,
    again: bool = False,
    key: str = "",
    secrets: Secrets = no_secrets,
    dry_run: bool = False,
) -> Requested:
    """Create an enclave's private key in ``folder``, and a signing request for it.

    ``folder`` becomes a keystore without CAs.  With ``again`` the request is made for the existing
    key; a key is never replaced.  With ``key``, a ``pkcs11:`` URI, the key is on a token, where it
    is made if it is not there, and ``folder`` gets its place; ``secrets`` is asked for the PIN.

    Raises:
        KeystoreError: the enclave has a key already (without ``again``), or a certificate without
            a key, or ``folder`` is a keystore with CAs.
        PkiError: the token cannot be used.
    """
    check_enclave_name(name)
    place_of_key = token_places(key, [name])[name] if key else None
    if again and place_of_key:
        raise UsageError(
            "--again and --key exclude each other",
            "The request is made again for the key that the enclave has.",
            "Leave one of them out.",
        )
    if not dry_run and folder.is_dir():
        tidy(folder)
    refuse_ca_keystore(
        folder, f"Make the enclave with `sros create_enclave {quote(str(folder))} {name}`."
    )
    place = enclave_folder(name)
    with Transaction(folder, fresh=True, dry_run=dry_run) as transaction:
        path = folder / place / KEY_FILE
        on_token = folder / place / KEY_URI_FILE
        if has_key(folder / place) and not again:
            raise KeystoreError(
                f"enclave {name} has a key in '{folder}' already",
                "A key is never replaced, because its certificate would become useless.",
                "Add --again to make the request again for this key, or choose another folder.",
            )
        made: PrivateKey
        if again and on_token.exists() and not path.exists():
            made = open_enclave_key(place_in(on_token), secrets)
        elif again:
            made = load_key(read_bytes(path, "private key"), f"'{path}'")
        elif (folder / place / CERTIFICATE_FILE).exists():
            raise KeystoreError(
                f"enclave {name} has a certificate in '{folder}', but no key",
                "A new key would make the certificate useless.",
                "Restore the key, or choose another folder.",
            )
        elif place_of_key and dry_run:
            transaction.write(f"{place}/{KEY_URI_FILE}", token_file(place_of_key))
            made = generate_key()  # a dry run opens no token
        elif place_of_key:
            made = make_enclave_key(place_of_key, secrets)
            remedy = "Name another object of the token."
            KnownKeys(folder).refuse_second(made.public_key(), name, remedy)
            transaction.write(f"{place}/{KEY_URI_FILE}", made.file)
        else:
            made = generate_key()
            transaction.write(f"{place}/{KEY_FILE}", key_pem(made), private=True)
        request = make_request(made, name)
        # Report an unsupported kind of key here, not later at the keystore.
        load_request(request, f"of enclave {name}")
        transaction.write(f"{place}/{REQUEST}", request)
        transaction.commit()
    return Requested(
        name,
        folder / place / REQUEST,
        key_digest(made.public_key()),
        tuple(transaction.changes),
        made.place if isinstance(made, TokenKey) else place_of_key,
        tuple(token_notes(made)) if isinstance(made, TokenKey) else (),
    )
