"""Checks of the CAs that a robot's folder of enclaves trusts."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path

from cryptography import x509

from sros_tool.errors import KeystoreError, UsageError
from sros_tool.keystore.layout import (
    ENCLAVES,
    IDENTITY_CA_FILE,
    PRIVATE,
    PUBLIC,
    refuse_earlier,
)
from sros_tool.pki.certificates import digest, fingerprints, load_certificates, subject_text
from sros_tool.xml import read_bytes


def read_pin(text: str) -> frozenset[str]:
    """Return the SHA-256 of the pinned CAs, in lower-case hexadecimal.

    ``text`` is a fingerprint or the path of a certificate file.  A fingerprint can have colons and
    capitals, as ``openssl x509 -fingerprint -sha256`` prints it.

    Raises:
        UsageError: ``text`` is neither a fingerprint nor a certificate file.
    """
    plain = text.strip().rpartition("=")[2].replace(":", "").lower()
    if re.fullmatch(r"[0-9a-f]{64}", plain):
        return frozenset({plain})
    path = Path(text)
    if path.is_file():
        return fingerprints(read_bytes(path, "certificate"))
    raise UsageError(
        f"{text!r} is neither a certificate file nor a SHA-256 fingerprint",
        "A fingerprint has 64 hexadecimal digits.",
        "Copy the fingerprint that `sros sign_request` prints, or name the CA's certificate file.",
    )


def trusted_in(folder: Path, file: str) -> list[x509.Certificate]:
    """Return the distinct certificates in all files named ``file`` of a folder's enclaves."""
    found: dict[str, x509.Certificate] = {}
    for path in sorted((folder / ENCLAVES).rglob(file)):
        if path.exists():
            found |= {digest(each): each for each in _certificates(path)}
    return list(found.values())


def check_same_authority(target: Path, files: Mapping[str, bytes]) -> None:
    """Refuse to mix enclaves of two keystores in one folder: they could not communicate.

    Args:
        target: the folder of a robot.
        files: the content of the new files, by their paths relative to ``target``.

    Raises:
        KeystoreError: ``target`` holds an enclave that trusts none of the identity CAs in
            ``files``.
    """
    ours: set[str] = set()
    for path, data in files.items():
        if path.endswith(f"/{IDENTITY_CA_FILE}"):
            ours |= fingerprints(data)
    for place in sorted((target / ENCLAVES).rglob(IDENTITY_CA_FILE)):
        if f"{place.relative_to(target)}" in files or not place.exists():
            continue
        theirs = _certificates(place)
        if ours.isdisjoint(map(digest, theirs)):
            raise KeystoreError(
                f"'{target}' holds enclaves of another keystore",
                f"They trust {subject_text(theirs[0].subject)}, and could not communicate with the "
                "new enclaves.",
                "Choose another folder.",
            )


def refuse_ca_keystore(folder: Path, remedy: str) -> None:
    """Raise `KeystoreError` if ``folder`` is a keystore with CAs, not a folder of a robot."""
    refuse_earlier(folder)
    if (folder / PRIVATE).exists() or (folder / PUBLIC).exists():
        raise KeystoreError(
            f"'{folder}' is a keystore with CAs",
            "Signing requests and their answers belong in a folder on the robot.",
            remedy,
        )


def _certificates(path: Path) -> tuple[x509.Certificate, ...]:
    return load_certificates(read_bytes(path, "certificate"), f"'{path}'")
