"""The floor of creating enclaves: only the same cryptography and the same files."""

from __future__ import annotations

import os
from datetime import UTC, datetime, timedelta
from pathlib import Path

from cryptography.hazmat.primitives import hashes
from cryptography.hazmat.primitives.serialization import Encoding, pkcs7

from sros_tool.pki.certificates import common_name, issue_ca, pem
from sros_tool.pki.keys import generate_key, key_pem
from sros_tool.validity import window


def sizes_of(folder: Path) -> list[tuple[str, int | str]]:
    """Return the name of each file of an enclave, with its size, or the target of a link."""
    return [
        (each.name, os.readlink(each) if each.is_symlink() else each.stat().st_size)
        for each in sorted(folder.iterdir())
    ]


def make_enclaves(folder: Path, files: list[tuple[str, int | str]], count: int) -> None:
    """Make for each enclave a key, its PEM, a certificate, a signed message, and ``files``."""
    key = generate_key()
    validity = window(datetime.now(UTC), timedelta(days=365))
    ca = issue_ca(key, common_name("floor"), validity)
    from sros_tool.pki.certificates import Issuer

    issuer = Issuer(ca, key)
    name = common_name("/floor/enclave")
    payload = {file: b"x" * size for file, size in files if isinstance(size, int)}
    for index in range(count):
        own = generate_key()
        key_pem(own)
        pem(issuer.issue(name, own.public_key(), validity))
        pkcs7.PKCS7SignatureBuilder().set_data(b"x" * 2000).add_signer(
            ca, key, hashes.SHA256()
        ).sign(Encoding.DER, [pkcs7.PKCS7Options.DetachedSignature])
        place = folder / str(index)
        place.mkdir()
        for file, size in files:
            path = os.path.join(place, file)
            if isinstance(size, str):
                os.symlink(size, path)
            else:
                handle = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
                os.write(handle, payload[file])
                os.close(handle)
