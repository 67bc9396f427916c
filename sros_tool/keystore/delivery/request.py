"""The signing request of an enclave: made on its robot, with a key that stays there."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from sros_tool.errors import KeystoreError
from sros_tool.keystore.delivery.trust import refuse_home
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
    """A new signing request: its file, the SHA-256 of its public key, and the changes."""

    name: str
    file: Path
    key: str
    changes: tuple[Change, ...]


def create_request(
    folder: Path, name: str, *, again: bool = False, dry_run: bool = False
) -> Requested:
    """Make a key, which stays in ``folder``, and a request to certify it.

    ``folder`` becomes a keystore without CAs, in which the enclave waits for the answer.  With
    ``again`` the request is made for the existing key; no key is ever replaced.
    """
    check_enclave_name(name)
    if not dry_run and folder.is_dir():
        tidy(folder)
    refuse_home(folder, f"Make the enclave with `sros create_enclave {folder} {name}`.")
    place = enclave_folder(name)
    with Transaction(folder, fresh=True, dry_run=dry_run) as transaction:
        path = folder / place / "key.pem"
        if path.exists() and not again:
            raise KeystoreError(
                f"enclave {name} has a key in '{folder}' already",
                "A key is never replaced, for its certificate would be useless without it.",
                "Add --again to have the request made again for this key, or choose another "
                "folder.",
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
        load_request(
            request, "as it was made"
        )  # reports a key of a wrong kind here, not at the keystore
        transaction.write(f"{place}/{REQUEST}", request)
        transaction.commit()
    digest = key_digest(key.public_key())
    return Requested(name, folder / place / REQUEST, digest, tuple(transaction.changes))
