"""What DDS would load for an enclave: its documents and identity, from files or from a policy."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from datetime import datetime, timedelta
from pathlib import Path

from sros_tool.dds.decision.vendors import VendorTraits
from sros_tool.dds.domains import DomainSet
from sros_tool.dds.governance import Governance, parse_governance, render_governance
from sros_tool.dds.permissions import render_permissions
from sros_tool.errors import SrosError
from sros_tool.faults import Fault
from sros_tool.keystore.layout import KEY_FILE, REQUEST
from sros_tool.keystore.loading import vendor_problems
from sros_tool.keystore.reader import OpenedEnclave, Problem, open_enclave
from sros_tool.pki import smime
from sros_tool.pki.certificates import subject_text, validity_of
from sros_tool.pki.crl import load_crl
from sros_tool.policy.model import Enclave
from sros_tool.translate import permissions_for
from sros_tool.validity import window
from sros_tool.xml import read_bytes

_LEFT_TO_THE_VENDOR = frozenset(
    {
        Fault.GOVERNANCE_DOMAIN,
        Fault.GOVERNANCE_MALFORMED,
        Fault.PERMISSIONS_DOMAIN,
        Fault.PERMISSIONS_EXPIRED,
        Fault.PERMISSIONS_MALFORMED,
        Fault.PERMISSIONS_NOT_YET_VALID,
        Fault.PERMISSIONS_SUBJECT,
    }
)
"""Faults of documents that every vendor judges by rules of its own."""
_NO_KEY = (Fault.FILE_MISSING, KEY_FILE)

_PLANNED = timedelta(days=365)


@dataclass(frozen=True, slots=True)
class Material:
    """An enclave as DDS gets it.

    ``governance`` and ``permissions`` are the XML within the signed documents; ``signed`` is the
    signed permissions, b"" if they are not signed yet.  ``ends`` are files with the moment when
    they expire.  ``state`` is what the files were found to be at the moment ``at``; None where they
    are not made yet.
    """

    enclave: str
    subject: str
    governance: bytes
    permissions: bytes
    domains: DomainSet | None
    signed: bytes = b""
    ends: tuple[tuple[str, datetime], ...] = ()
    state: OpenedEnclave | None = None
    at: datetime | None = None
    key_elsewhere: bool = False
    """Its key is on the robot on which it was made."""

    def problems(self, traits: VendorTraits) -> tuple[Problem, ...]:
        """Those that keep a process of a vendor from running, whatever the documents say."""
        if self.state is None or self.at is None:
            return ()
        return tuple(
            each
            for each in vendor_problems(traits, self.state, self.at)
            if each.fault not in _LEFT_TO_THE_VENDOR
            and not (self.key_elsewhere and (each.fault, each.file) == _NO_KEY)
        )


def from_folder(name: str, folder: Path, *, at: datetime) -> Material:
    """What lies in the folder of an enclave, as it is at a moment."""
    state = open_enclave(folder, now=at)
    governance, permissions = (
        _document(state.files.get(file, b"")) for file in ("governance.p7s", "permissions.p7s")
    )
    return Material(
        name,
        subject_text(state.certificate.subject) if state.certificate else "",
        governance,
        permissions,
        state.domains() or _domains(governance),
        state.files.get("permissions.p7s", b""),
        tuple(_ends(state, folder)),
        state,
        at,
        key_elsewhere=(folder / REQUEST).exists() and not (folder / "key.pem").exists(),
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


def _document(message: bytes) -> bytes:
    with suppress(SrosError):
        return smime.parse(message).document
    return b""


def _domains(governance: bytes) -> DomainSet | None:
    with suppress(SrosError):
        return parse_governance(governance).domains().closed()
    return None


def _ends(state: OpenedEnclave, folder: Path) -> Iterator[tuple[str, datetime]]:
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
