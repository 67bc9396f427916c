"""What DDS would load for an enclave: its documents and identity, from files or from a policy."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from datetime import datetime, timedelta
from functools import lru_cache
from pathlib import Path

from sros_tool.dds.domains import DomainSet
from sros_tool.dds.governance import Governance, render_governance
from sros_tool.dds.permissions import render_permissions
from sros_tool.errors import SrosError
from sros_tool.keystore.layout import REQUEST
from sros_tool.keystore.verify import EnclaveState, Problem, check_enclave
from sros_tool.pki import smime
from sros_tool.pki.certificates import subject_text, validity_of
from sros_tool.pki.crl import load_crl
from sros_tool.policy.model import Enclave
from sros_tool.translate import permissions_for
from sros_tool.validity import window
from sros_tool.xml import read_bytes

_LEFT_TO_THE_VENDOR = frozenset(
    {
        "governance-domain",
        "governance-malformed",
        "permissions-domain",
        "permissions-expired",
        "permissions-malformed",
        "permissions-not-yet-valid",
        "permissions-subject",
    }
)
"""Faults of documents that every vendor judges by rules of its own."""

_PLANNED = timedelta(days=365)


@dataclass(frozen=True, slots=True)
class Material:
    """An enclave as DDS gets it.

    ``governance`` and ``permissions`` are the XML within the signed documents; ``signed`` is the
    signed permissions, b"" if they are not signed yet.  ``problems`` are those that keep a process
    from running whatever the documents say.  ``ends`` are files with the moment when they expire.
    """

    enclave: str
    subject: str
    governance: bytes
    permissions: bytes
    domains: DomainSet | None
    signed: bytes = b""
    problems: tuple[Problem, ...] = ()
    ends: tuple[tuple[str, datetime], ...] = ()


def from_folder(name: str, folder: Path, *, at: datetime) -> Material:
    """What lies in the folder of an enclave, as it is at a moment."""
    state = check_enclave(folder, now=at)
    passed_over = _LEFT_TO_THE_VENDOR
    if (folder / REQUEST).exists() and not (folder / "key.pem").exists():
        passed_over = _LEFT_TO_THE_VENDOR | {"file-missing key.pem"}  # it is on the robot
    governance = b""
    with suppress(SrosError):
        governance = _document(state.files.get("governance.p7s", b""))
    return Material(
        name,
        subject_text(state.certificate.subject) if state.certificate else "",
        governance,
        state.permissions_document,
        state.domains(),
        state.files.get("permissions.p7s", b""),
        tuple(
            each
            for each in state.problems
            if each.code not in passed_over and f"{each.code} {each.file}" not in passed_over
        ),
        tuple(_ends(state, folder)),
    )


def from_policy(enclave: Enclave, governance: Governance, *, at: datetime) -> Material:
    """What a policy would give to its enclave if it were signed at that moment."""
    subject = f"CN={enclave.path}"
    domains = governance.domains().closed()
    permissions = permissions_for(
        enclave, subject=subject, validity=window(at, _PLANNED), domains=domains
    )
    return Material(
        enclave.path,
        subject,
        render_governance(governance),
        render_permissions(permissions),
        domains,
    )


@lru_cache(maxsize=8)
def _document(message: bytes) -> bytes:
    return smime.parse(message).document


def _ends(state: EnclaveState, folder: Path) -> Iterator[tuple[str, datetime]]:
    certificates = {
        "cert.pem": state.certificate,
        "identity_ca.cert.pem": state.identity_ca,
        "permissions_ca.cert.pem": state.permissions_ca,
    }
    for file, certificate in certificates.items():
        if certificate:
            yield file, validity_of(certificate).not_after
    crl = folder / "crl.pem"
    if crl.exists():
        with suppress(SrosError):
            yield "crl.pem", load_crl(read_bytes(crl, "revocation list"), "").next_update
