"""Checks that all enclaves in a robot's folder trust a common identity CA."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path

from cryptography import x509

from sros_tool.errors import KeystoreError, UsageError
from sros_tool.keystore.layout import ENCLAVES, IDENTITY_CA_FILE, PRIVATE, PUBLIC
from sros_tool.pki.certificates import digest, fingerprints, load_certificates, subject_text
from sros_tool.xml import read_bytes


def read_pin(text: str) -> frozenset[str]:
    """Return the SHA-256 of the pinned CAs, from a fingerprint or a certificate file.

    Colons and capitals in a fingerprint do not matter, so that the output of
    ``openssl x509 -fingerprint -sha256`` can be copied.

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
        f"{text!r} is neither the file of a certificate nor its SHA-256",
        "A fingerprint has 64 hexadecimal digits.",
        "Copy the one that `sros sign_request` prints, or name a file.",
    )


def trusted_in(folder: Path, file: str) -> list[x509.Certificate]:
    """Map the names of CA files to the CAs that the enclaves of a robot's folder trust by them."""
    found: dict[str, x509.Certificate] = {}
    for path in sorted((folder / ENCLAVES).rglob(file)):
        if path.exists():
            found |= {digest(each): each for each in _certificates(path)}
    return list(found.values())


def check_same_authority(target: Path, files: Mapping[str, bytes]) -> None:
    """Refuse to mix enclaves of two keystores in one folder: they would never talk.

    Args:
        target: the folder of a robot.
        files: the new files below ``target``, by relative paths.

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
                f"Those trust {subject_text(theirs[0].subject)}, and would not talk to these.",
                "Choose another folder.",
            )


def refuse_home(folder: Path, remedy: str) -> None:
    """Raise `KeystoreError` if ``folder`` is the keystore with the CAs, not a folder of a robot."""
    if (folder / PRIVATE).exists() or (folder / PUBLIC).exists():
        raise KeystoreError(
            f"'{folder}' is a keystore with CAs",
            "Requests are made, and their answers used, in a folder of the robot.",
            remedy,
        )


def _certificates(path: Path) -> tuple[x509.Certificate, ...]:
    return load_certificates(read_bytes(path, "certificate"), f"'{path}'")
