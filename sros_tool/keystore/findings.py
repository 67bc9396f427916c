"""Findings about a keystore as a whole: what works today and is still a weakness."""

from __future__ import annotations

from datetime import datetime, timedelta
from pathlib import Path

from sros_tool.keystore.authority import load_ca_certificate
from sros_tool.keystore.create import list_enclaves
from sros_tool.keystore.enclave import enclave_path
from sros_tool.keystore.layout import (
    IDENTITY,
    PERMISSIONS,
    PRIVATE,
    REQUEST,
    ca_certificate,
)
from sros_tool.keystore.revoke import read_crl
from sros_tool.keystore.verify import check_enclave
from sros_tool.notes import Note
from sros_tool.validity import iso

_ALARM = timedelta(days=30)


def keystore_findings(root: Path, now: datetime) -> tuple[Note, ...]:
    """What is wrong or weak in a keystore; `KeystoreError` if it is none."""
    found = []
    for name in list_enclaves(root):
        folder = enclave_path(root, name)
        born_elsewhere = (folder / REQUEST).exists() and not (folder / "key.pem").exists()
        found += [
            Note("enclave.not-loadable", f"{name}: {problem}")
            for problem in check_enclave(folder, now=now).problems
            if not (born_elsewhere and problem.file == "key.pem")
        ]
    authorities = [
        load_ca_certificate(root, role)
        for role in (IDENTITY, PERMISSIONS)
        if (root / ca_certificate(role)).exists()
    ]
    if len(authorities) == 2 and authorities[0].public_key() == authorities[1].public_key():
        found.append(
            Note(
                "keystore.one-authority",
                "One CA issues identities and signs permissions. Cyclone DDS 0.10.2 and Fast DDS "
                "2.9.1 then accept permissions that an enclave signed for itself. Make a keystore "
                "with separate CAs, which all templates but sros2 do.",
            )
        )
    crl = read_crl(root)
    if crl and crl.next_update - now < _ALARM:
        found.append(
            Note(
                "keystore.revocation-list-ends",
                f"The revocation list ends at {iso(crl.next_update)}, and DDS then refuses "
                f"everybody. Run `sros crl {root} --refresh`.",
            )
        )
    found += [
        Note(
            "keystore.key-readable",
            f"Others can read the private key '{path}'. Run `chmod 600` on it.",
        )
        for folder in (PRIVATE, "enclaves")
        for path in sorted((root / folder).rglob("*key.pem"))
        if not path.is_symlink() and path.stat().st_mode & 0o077
    ]
    return tuple(found)
