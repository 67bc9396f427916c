"""Signing requests: made on the robot, for a key that stays there."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from shlex import quote

from sros_tool.errors import KeystoreError
from sros_tool.keystore.delivery.trust import refuse_ca_keystore
from sros_tool.keystore.layout import REQUEST, enclave_folder
from sros_tool.keystore.transaction.recovery import tidy
from sros_tool.keystore.transaction.stage import Change
from sros_tool.keystore.transaction.transaction import Transaction
from sros_tool.names import check_enclave_name
from sros_tool.pki.keys import generate_key, key_pem, load_key
from sros_tool.pki.requests import key_digest, load_request, make_request
from sros_tool.xml import read_bytes


@dataclass(frozen=True, slots=True)
class Requested:
    """A new signing request for the enclave ``name``; ``key`` is the SHA-256 of its public key."""

    name: str
    file: Path
    key: str
    changes: tuple[Change, ...]


def create_request(
    folder: Path, name: str, *, again: bool = False, dry_run: bool = False
) -> Requested:
    """Create an enclave's private key in ``folder``, and a signing request for it.

    ``folder`` becomes a keystore without CAs.  With ``again`` the request is made for the existing
    key; a key is never replaced.

    Raises:
        KeystoreError: the enclave has a key already (without ``again``), or a certificate without
            a key, or ``folder`` is a keystore with CAs.
    """
    check_enclave_name(name)
    if not dry_run and folder.is_dir():
        tidy(folder)
    refuse_ca_keystore(
        folder, f"Make the enclave with `sros create_enclave {quote(str(folder))} {name}`."
    )
    place = enclave_folder(name)
    with Transaction(folder, fresh=True, dry_run=dry_run) as transaction:
        path = folder / place / "key.pem"
        if path.exists() and not again:
            raise KeystoreError(
                f"enclave {name} has a key in '{folder}' already",
                "A key is never replaced, because its certificate would become useless.",
                "Add --again to make the request again for this key, or choose another folder.",
            )
        if again:
            key = load_key(read_bytes(path, "private key"), f"'{path}'")
        elif (folder / place / "cert.pem").exists():
            raise KeystoreError(
                f"enclave {name} has a certificate in '{folder}', but no key",
                "A new key would make the certificate useless.",
                "Restore the key, or choose another folder.",
            )
        else:
            key = generate_key()
            transaction.write(f"{place}/key.pem", key_pem(key), private=True)
        request = make_request(key, name)
        # Report an unsupported kind of key here, not later at the keystore.
        load_request(request, f"of enclave {name}")
        transaction.write(f"{place}/{REQUEST}", request)
        transaction.commit()
    digest = key_digest(key.public_key())
    return Requested(name, folder / place / REQUEST, digest, tuple(transaction.changes))
