"""Signing requests for certificates on a robot that expire, with keys that stay on the robot."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Iterable, Mapping
from contextlib import suppress
from datetime import datetime
from pathlib import Path

from sros_tool.agent.settings import agent_folder
from sros_tool.errors import SrosError
from sros_tool.files import remove_file, staged_file
from sros_tool.folders import Folder
from sros_tool.keystore.confirmation import MOST_REQUESTS
from sros_tool.keystore.issuing.tokens import place_in
from sros_tool.keystore.layout import CERTIFICATE_FILE, KEY_FILE, KEY_URI_FILE, enclave_path
from sros_tool.keystore.reader import read_certificate
from sros_tool.pki.certificates import make_request, validity_of
from sros_tool.pki.keys import PrivateKey, generate_key, key_pem, load_key
from sros_tool.pki.token import Secrets, open_enclave_key
from sros_tool.xml import read_bytes

_NEW_KEYS = "new-keys"


def is_due(certificate_from: datetime, until: datetime, now: datetime) -> bool:
    """Return whether less than a third of a certificate's life is left."""
    return now >= until - (until - certificate_from) / 3


def enclave_key(folder: Path, name: str, secrets: Secrets) -> PrivateKey:
    """Return the private key of an enclave on this robot, from its file or its token.

    Raises:
        SrosError: there is none, or it cannot be used.
    """
    place = enclave_path(folder, name)
    if (place / KEY_FILE).exists():
        return load_key(read_bytes(place / KEY_FILE, "private key"), f"of enclave {name}")
    return open_enclave_key(place_in(place / KEY_URI_FILE), secrets)


def renewal_requests(
    folder: Path,
    names: Iterable[str],
    *,
    now: datetime,
    new_key: bool,
    secrets: Secrets,
    permissions_until: Mapping[str, datetime],
) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Return signing requests (PEM) for enclaves that expire, and sentences on those without.

    Args:
        folder: the security folder of the robot.
        names: its enclaves.
        now: the present time.
        new_key: whether to ask with a new key, which waits next to the present one until its
            certificate is installed; a key on a token stays.
        secrets: is asked for the PIN of a token.
        permissions_until: when the permissions of enclaves expire.
    """
    requests: list[str] = []
    problems: list[str] = []
    for name in names:
        place = enclave_path(folder, name)
        try:
            validity = validity_of(read_certificate(place / CERTIFICATE_FILE))
            until = min(validity.not_after, permissions_until.get(name, validity.not_after))
            if not is_due(validity.not_before, until, now) or len(requests) == MOST_REQUESTS:
                continue
            in_file = (place / KEY_FILE).exists()
            key = (
                _waiting_key(folder, name)
                if new_key and in_file
                else enclave_key(folder, name, secrets)
            )
            requests.append(make_request(key, name).decode())
        except (SrosError, OSError) as error:
            problems.append(f"{name} cannot be renewed: {error}")
    return tuple(requests), tuple(problems)


def _key_file(name: str) -> str:
    """Return the path, in the agent's folder, of the new key of an enclave."""
    return f"{_NEW_KEYS}/{hashlib.sha256(name.encode()).hexdigest()[:32]}.pem"


def _waiting_key(folder: Path, name: str) -> PrivateKey:
    """Return the new key of an enclave that waits for its certificate, made if there is none.

    Raises:
        SrosError: the key cannot be read.
        OSError: the key cannot be written.
    """
    own = agent_folder(folder)
    path = own / _key_file(name)
    if os.path.lexists(path):
        return load_key(read_bytes(path, "private key"), f"of enclave {name}")
    with Folder(own) as opened:
        if not opened.is_folder(_NEW_KEYS):
            opened.mkdir(_NEW_KEYS, 0o700)
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
    """Remove the new keys that are installed."""
    for name, key in keys.items():
        with suppress(SrosError, OSError):
            path = enclave_path(folder, name) / KEY_FILE
            present = load_key(read_bytes(path, "private key"), f"of enclave {name}")
            if present.public_key() == key.public_key():
                remove_file(agent_folder(folder) / _key_file(name))
