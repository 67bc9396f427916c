"""Signing requests for certificates on a robot that expire, with keys that stay on the robot."""

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
from sros_tool.keystore.issuing.tokens import place_in
from sros_tool.keystore.layout import CERTIFICATE_FILE, KEY_FILE, KEY_URI_FILE, enclave_path
from sros_tool.keystore.reader import read_certificate
from sros_tool.pki.certificates import make_request, validity_of
from sros_tool.pki.keys import PrivateKey, generate_key, key_pem, load_key
from sros_tool.pki.token import Secrets, open_enclave_key
from sros_tool.validity import time_of_file
from sros_tool.xml import read_bytes

_NEW_KEYS = "new-keys"


def _is_due(file: Path, now: datetime) -> bool:
    """Return whether at most a third of the life of the certificate in ``file`` is left.

    A file that does not change is never written again, so that its time tells how long the
    certificate has been here.

    Raises:
        SrosError: it cannot be read.
    """
    validity = validity_of(read_certificate(file))
    here_since = time_of_file(file.stat().st_mtime)
    return now >= validity.not_after - validity.life(here_since) / 3


def enclave_key(folder: Path, name: str, secrets: Secrets) -> PrivateKey:
    """Return the private key of an enclave on this robot, from its file or its token.

    Raises:
        SrosError: there is none, or it cannot be used.
    """
    place = enclave_path(folder, name)
    if (place / KEY_FILE).exists():
        return load_key(read_bytes(place / KEY_FILE, "private key"), f"of enclave {name}")
    return open_enclave_key(place_in(place / KEY_URI_FILE), secrets)


class Renewals(NamedTuple):
    """The signing requests (PEM) for a message, and who has to sign it.

    Only the enclave itself can vouch for its new key, with its present one.  So of the enclaves
    that ask with a new key, a message has the request of one, ``signer``; every hour it is another.
    """

    requests: tuple[str, ...]
    signer: str | None
    problems: tuple[str, ...]
    """Sentences on enclaves without a request."""


def renewals(
    folder: Path, names: Iterable[str], *, now: datetime, new_key: bool, secrets: Secrets
) -> Renewals:
    """Return requests for the enclaves ``names`` whose certificates expire.

    With ``new_key``, they are for new keys, which wait next to the present ones until their
    certificates are installed; a key on a token stays.  ``secrets`` is asked for the PIN of a
    token.
    """
    requests: list[str] = []
    problems: list[str] = []
    with_new_keys: list[str] = []
    for name in names:
        place = enclave_path(folder, name)
        try:
            if not _is_due(place / CERTIFICATE_FILE, now) or len(requests) == MOST_REQUESTS - 1:
                continue
            if new_key and (place / KEY_FILE).exists():
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
