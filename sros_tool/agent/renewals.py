"""The signing requests of a robot, and the new keys that wait for their certificates."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Iterable, Mapping
from contextlib import suppress
from datetime import datetime
from pathlib import Path
from typing import NamedTuple

from sros_tool.agent.settings import agent_folder
from sros_tool.errors import SrosError
from sros_tool.files import remove_file, staged_file
from sros_tool.folders import Folder
from sros_tool.keystore.confirmation import MOST_REQUESTS
from sros_tool.keystore.expiry import Threshold, read_credentials
from sros_tool.keystore.layout import CERTIFICATE_FILE, KEY_FILE, KEY_URI_FILE, enclave_path
from sros_tool.keystore.reader import OpenedKeystore, read_certificate
from sros_tool.pki.certificates import make_request, validity_of
from sros_tool.pki.keys import PrivateKey, generate_key, key_pem, load_key
from sros_tool.pki.token import Secrets, open_enclave_key, place_in_file
from sros_tool.validity import time_of_file
from sros_tool.xml import read_bytes

_NEW_KEYS_FOLDER = "new-keys"


_NEW_KEY_AFTER = 0.6
"""The elapsed fraction of a validity after which a robot asks for a new key.

`sros renew --all-expiring soon` renews with the present key after two thirds at the earliest, and
`sros fleet collect` signs requests after half.
"""


def _is_renewal_due(keystore: OpenedKeystore, name: str, now: datetime, *, new_key: bool) -> bool:
    """Return whether the robot asks for the renewal of an enclave.

    It asks when a third of the time from the arrival of the certificate to its expiry is left. A
    file is written only when it changes, so its modification time is when the robot got the
    certificate.  With ``new_key``, the expiry of the permissions counts, too: otherwise, when the
    permissions are due, the keystore machine would renew the certificate with the present key.

    Raises:
        SrosError: the certificate cannot be read.
    """
    if new_key:
        with suppress(SrosError):  # what is wrong with permissions is reported elsewhere
            lifetime = read_credentials(keystore, name).lifetime()
            return lifetime.is_due(Threshold(elapsed=_NEW_KEY_AFTER), now)
    file = keystore.folder(name) / CERTIFICATE_FILE
    validity, here_since = validity_of(read_certificate(file)), time_of_file(file.stat().st_mtime)
    left = 1 - _NEW_KEY_AFTER if new_key else 1 / 3
    return now >= validity.not_after - validity.lifetime(here_since) * left


def enclave_key(folder: Path, name: str, secrets: Secrets) -> PrivateKey:
    """Return the private key of an enclave on this robot, from its file or its token.

    Raises:
        SrosError: the enclave has no key, or the key cannot be used.
    """
    place = enclave_path(folder, name)
    if (place / KEY_FILE).exists():
        return load_key(read_bytes(place / KEY_FILE, "private key"), f"of enclave {name}")
    return open_enclave_key(place_in_file(place / KEY_URI_FILE), secrets)


class Renewals(NamedTuple):
    """The signing requests (PEM) for a message, and the enclave whose key has to sign the message.

    Only the current key of an enclave can vouch for its new key, by signing the message.  So a
    message has at most one request for a new key, which is from the enclave ``signer``.  Every
    hour, another enclave is the signer.
    """

    requests: tuple[str, ...]
    signer: str | None
    problems: tuple[str, ...]
    """Sentences on enclaves without a request."""


def renewals(
    folder: Path, names: Iterable[str], *, now: datetime, new_key: bool, secrets: Secrets
) -> Renewals:
    """Return requests for the enclaves ``names`` that are due for renewal.

    With ``new_key``, the requests are for new keys, which wait next to the current keys until their
    certificates are installed; a key on a token stays.  ``secrets`` is asked for the PIN of a
    token.
    """
    requests: list[str] = []
    problems: list[str] = []
    with_new_keys: list[str] = []
    keystore = OpenedKeystore(folder)
    for name in names:
        is_new = new_key and (enclave_path(folder, name) / KEY_FILE).exists()
        try:
            is_due = _is_renewal_due(keystore, name, now, new_key=is_new)
            if not is_due or len(requests) == MOST_REQUESTS - 1:
                continue
            if is_new:
                with_new_keys.append(name)
                continue
            requests.append(make_request(enclave_key(folder, name, secrets), name).decode())
        except (SrosError, OSError) as error:
            problems.append(f"{name} cannot be renewed: {error}")
    signer = None
    if with_new_keys:
        signer = with_new_keys[int(now.timestamp()) // 3600 % len(with_new_keys)]
        try:
            requests.append(make_request(_waiting_key(folder, signer), signer).decode())
        except (SrosError, OSError) as error:
            problems.append(f"{signer} cannot be renewed: {error}")
    return Renewals(tuple(requests), signer, tuple(problems))


def _key_file(name: str) -> str:
    """Return the path, in the agent's folder, of the new key of an enclave."""
    return f"{_NEW_KEYS_FOLDER}/{hashlib.sha256(name.encode()).hexdigest()[:32]}.pem"


def _waiting_key(folder: Path, name: str) -> PrivateKey:
    """Return an enclave's new key, which waits for its certificate; make the key if it is missing.

    Raises:
        SrosError: the key cannot be read.
        OSError: the key cannot be written.
    """
    agents_folder = agent_folder(folder)
    path = agents_folder / _key_file(name)
    if os.path.lexists(path):
        return load_key(read_bytes(path, "private key"), f"of enclave {name}")
    with Folder(agents_folder) as opened:
        if not opened.is_folder(_NEW_KEYS_FOLDER):
            opened.mkdir(_NEW_KEYS_FOLDER, 0o700)
    key = generate_key()
    with staged_file(path, key_pem(key)) as put_in_place:
        put_in_place()
    return key


def waiting_keys(folder: Path, names: Iterable[str]) -> dict[str, PrivateKey]:
    """Return the new keys that wait for their certificates, by enclave."""
    keys = {}
    for name in names:
        path = agent_folder(folder) / _key_file(name)
        if os.path.lexists(path):
            with suppress(SrosError):
                keys[name] = load_key(read_bytes(path, "private key"), f"of enclave {name}")
    return keys


def drop_installed_keys(folder: Path, keys: Mapping[str, PrivateKey]) -> None:
    """Remove the waiting copies of new keys that were installed."""
    for name, key in keys.items():
        with suppress(SrosError, OSError):
            path = enclave_path(folder, name) / KEY_FILE
            present = load_key(read_bytes(path, "private key"), f"of enclave {name}")
            if present.public_key() == key.public_key():
                remove_file(agent_folder(folder) / _key_file(name))
