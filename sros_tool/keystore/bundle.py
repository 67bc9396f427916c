"""The file of a CA: all certificates that it makes trusted, and perhaps a revocation list.

It holds the issuing CA first, for Cyclone DDS 0.10.2 reads nothing else of it (ran); Fast DDS
2.9.1 trusts all that it holds, and reads a revocation list in it, too (ran).
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from cryptography import x509

from sros_tool.errors import KeystoreError
from sros_tool.keystore.layout import PUBLIC, ROLES, ca_certificate, enclave_folder
from sros_tool.keystore.transaction import STAGE, Transaction
from sros_tool.pki.certificates import load_certificates
from sros_tool.pki.crl import CRL_MARK, RevocationList, load_crl
from sros_tool.xml import read_bytes


def authority_files(root: Path) -> dict[str, tuple[str, ...]]:
    """The stem of each CA file, with the roles for which it serves."""
    found: dict[str, tuple[str, ...]] = {}
    for role in ROLES:
        path = root / ca_certificate(role)
        file = path
        # A link into the stage is a file of its own that an interrupted transaction left so.
        if path.is_symlink() and STAGE not in (to := str(path.readlink())):
            file = path.with_name(to)
        if not file.is_file() or file.parent != path.parent:
            raise KeystoreError(
                f"keystore '{root}' has no {role} CA of its own",
                f"'{path}' is missing, or leads out of the keystore.",
                "Use the keystore that it was exported from.",
            )
        stem = file.name.removesuffix(".cert.pem")
        found[stem] = (*found.get(stem, ()), role)
    return found


def certificates_of(root: Path, file: str) -> tuple[x509.Certificate, ...]:
    """All certificates of a CA file, the issuing one first."""
    path = root / PUBLIC / f"{file}.cert.pem"
    return load_certificates(read_bytes(path, "CA certificate"), f"'{path}'")


def carried_crl(root: Path, file: str) -> RevocationList | None:
    """The revocation list that a CA file carries beside its certificates, or None."""
    path = root / PUBLIC / f"{file}.cert.pem"
    data = read_bytes(path, "CA certificate")
    return load_crl(data, f"in '{path}'") if CRL_MARK in data else None


def write_bundle(
    transaction: Transaction,
    file: str,
    roles: Sequence[str],
    bundle: bytes,
    names: Sequence[str],
) -> None:
    """Stage a CA file, and the copies that enclaves have of it."""
    transaction.write(f"{PUBLIC}/{file}.cert.pem", bundle)
    for role in roles:
        write_copies(transaction, names, f"{role}_ca.cert.pem", bundle)


def write_copies(transaction: Transaction, names: Sequence[str], name: str, data: bytes) -> None:
    """Stage a file in every enclave that has a copy of it, not a link."""
    for enclave in names:
        path = f"{enclave_folder(enclave)}/{name}"
        if (transaction.root / path).is_file() and not (transaction.root / path).is_symlink():
            transaction.write(path, data)
