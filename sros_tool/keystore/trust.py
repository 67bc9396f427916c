"""Whom the enclaves of a robot trust: those of one folder have an identity CA in common."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path

from cryptography import x509
from cryptography.hazmat.primitives import hashes

from sros_tool.errors import KeystoreError, PkiError, UsageError
from sros_tool.keystore.layout import ENCLAVES, PRIVATE, PUBLIC
from sros_tool.pki.certificates import UNREADABLE, subject_text
from sros_tool.xml import read_bytes

_AUTHORITY = "identity_ca.cert.pem"


def fingerprints(pem: bytes) -> frozenset[str]:
    """The SHA-256 of every certificate in a PEM file: more than one while a CA is rotated."""
    return frozenset(each.fingerprint(hashes.SHA256()).hex() for each in _load(pem))


def read_pin(text: str) -> frozenset[str]:
    """The SHA-256 of the CAs that a person named: by a fingerprint, or a file of certificates.

    Raises `UsageError` for what is neither; colons and capitals in a fingerprint do not matter, so
    that one may be copied from ``openssl x509 -fingerprint -sha256``.
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
        "Copy the one that `sros sign_request` says, or name a file.",
    )


def trusted_in(folder: Path, file: str) -> list[x509.Certificate]:
    """The CAs that the enclaves of a robot's folder trust, by the name of the CA file."""
    found: dict[str, x509.Certificate] = {}
    for path in sorted((folder / ENCLAVES).rglob(file)):
        if path.exists():
            found |= {each.fingerprint(hashes.SHA256()).hex(): each for each in _of(path)}
    return list(found.values())


def _of(path: Path) -> list[x509.Certificate]:
    return _load(read_bytes(path, "certificate"))


def check_same_authority(target: Path, files: Mapping[str, bytes]) -> None:
    """One folder holds the enclaves of one keystore only: others would never talk to each other.

    ``files`` are those that are to be written below ``target``, by their paths.
    """
    ours: set[str] = set()
    for path, data in files.items():
        if path.endswith(f"/{_AUTHORITY}"):
            ours |= fingerprints(data)
    for place in sorted((target / ENCLAVES).rglob(_AUTHORITY)):
        if f"{place.relative_to(target)}" in files or not place.exists():
            continue
        theirs = _of(place)
        if not {each.fingerprint(hashes.SHA256()).hex() for each in theirs} & ours:
            raise KeystoreError(
                f"'{target}' holds enclaves of another keystore",
                f"Those trust {subject_text(theirs[0].subject)}, and would not talk to these.",
                "Choose another folder.",
            )


def refuse_home(folder: Path, remedy: str) -> None:
    """Raise `KeystoreError` where ``folder`` is the keystore that has the CAs, not a robot's."""
    if (folder / PRIVATE).exists() or (folder / PUBLIC).exists():
        raise KeystoreError(
            f"'{folder}' is a keystore with CAs",
            "Requests are made, and their answers used, in a folder of the robot.",
            remedy,
        )


def _load(pem: bytes) -> list[x509.Certificate]:
    try:
        return x509.load_pem_x509_certificates(pem)
    except UNREADABLE as error:
        raise PkiError("the certificate of a CA cannot be read") from error
