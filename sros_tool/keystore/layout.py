"""Where things lie in a keystore, as ROS 2 and ros2/sros2 expect them.

Paths are relative to the keystore, with "/" between their parts.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

from sros_tool.errors import KeystoreError

ENCLAVES, PUBLIC, PRIVATE = "enclaves", "public", "private"
SETTINGS = "sros.toml"
"""The choices by which the keystore was made; keystores of ros2/sros2 have none."""

IDENTITY, PERMISSIONS = "identity", "permissions"
ROLES = (IDENTITY, PERMISSIONS)

CRL = f"{PUBLIC}/identity_ca.crl.pem"
"""The revocation list of the identity CA, once something was revoked."""
REVOKED = "revoked"
"""Where the files of revoked enclaves go."""

GOVERNANCE_XML = f"{ENCLAVES}/governance.xml"
GOVERNANCE_P7S = f"{ENCLAVES}/governance.p7s"

REQUIRED_FILES = (
    "identity_ca.cert.pem",
    "permissions_ca.cert.pem",
    "cert.pem",
    "key.pem",
    "governance.p7s",
    "permissions.p7s",
)
"""The files that rcl and the RMWs read from an enclave; one missing keeps a node from starting."""

OPTIONAL_FILES = ("crl.pem",)

REQUEST = "request.pem"
"""The signing request of an enclave whose key was made on its robot and stays there."""


def ca_certificate(role: str) -> str:
    """The certificate of the identity or permissions CA."""
    return f"{PUBLIC}/{role}_ca.cert.pem"


def ca_key(role: str) -> str:
    """The private key of the identity or permissions CA."""
    return f"{PRIVATE}/{role}_ca.key.pem"


def enclave_folder(name: str) -> str:
    """The folder of an enclave; that of ``/`` is ``enclaves`` itself."""
    return ENCLAVES + name.rstrip("/")


def enclave_path(root: Path, name: str) -> Path:
    """Return the folder of an enclave of the keystore at ``root``."""
    return root / enclave_folder(name)


def folder_mode(path: str) -> int:
    """The permission bits of a folder: closed wherever keys may lie."""
    return 0o755 if path in ("", PUBLIC) else 0o700


def is_keystore(root: Path) -> bool:
    """Whether ``root`` is a keystore: one at home, or one that was deployed without its CAs."""
    folder = root / ENCLAVES
    return folder.is_dir() and (
        (root / GOVERNANCE_P7S).is_file()
        or (root / ca_certificate(IDENTITY)).is_file()
        or any(True for _ in enclave_names(root))
    )


def has_enclave(root: Path, name: str) -> bool:
    """Whether the keystore has an enclave of that name, without a look at all the others."""
    folder = f"{root}/{enclave_folder(name)}"
    return os.path.lexists(f"{folder}/cert.pem") or os.path.lexists(f"{folder}/key.pem")


def enclave_names(root: Path) -> Iterator[str]:
    """The names of the enclaves in the keystore: every folder that holds a key, sorted."""
    top = os.fspath(root / ENCLAVES)
    found = []
    for folder, folders, files in os.walk(top):
        folders[:] = [each for each in folders if not each.startswith(".")]
        if "key.pem" in files or "cert.pem" in files:
            found.append(folder[len(top) :].replace(os.sep, "/") or "/")
    yield from sorted(found)


def list_enclaves(root: Path) -> tuple[str, ...]:
    """The names of the enclaves of a keystore, sorted; `KeystoreError` if it is none."""
    check_keystore(root)
    return tuple(enclave_names(root))


def check_keystore(root: Path) -> None:
    """Raise `KeystoreError` if ``root`` is no keystore."""
    if not is_keystore(root):
        raise KeystoreError(
            f"'{root}' is not a valid keystore",
            "It does not exist." if not root.exists() else f"It has no {ENCLAVES} folder in use.",
            f"Make one with `sros create_keystore {root}`.",
        )
