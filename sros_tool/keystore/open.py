"""Reads what a keystore says of itself: its choices, its governance, its domains."""

from __future__ import annotations

from pathlib import Path

from cryptography import x509

from sros_tool.dds.domains import DomainSet
from sros_tool.dds.governance import Governance, parse_governance
from sros_tool.errors import KeystoreError, SrosError
from sros_tool.keystore.layout import GOVERNANCE_P7S, PERMISSIONS, SETTINGS, ca_certificate
from sros_tool.keystore.template import Template, load_template, read_template
from sros_tool.pki import smime
from sros_tool.pki.certificates import load_certificate
from sros_tool.xml import read_bytes


def load_settings(root: Path) -> Template:
    """The choices that the keystore was made by; those of ros2/sros2 where it has none."""
    path = root / SETTINGS
    return read_template(path) if path.exists() else load_template("sros2")


def load_governance(root: Path, authority: x509.Certificate) -> Governance:
    """The governance that DDS loads, after its signature by the permissions CA was verified."""
    path = root / GOVERNANCE_P7S
    try:
        signed = smime.parse(read_bytes(path, "governance document"))
        signed.verify(authority)
        return parse_governance(signed.document, f"'{path}'")
    except SrosError as error:
        raise KeystoreError(
            f"the governance of keystore '{root}' cannot be used: {error.what}",
            error.why,
            error.remedy or f"Restore '{path}' from a backup; every enclave depends on it.",
        ) from error


def governance_of(root: Path) -> Governance:
    """The governance that DDS loads, by the permissions CA that lies in the keystore."""
    path = root / ca_certificate(PERMISSIONS)
    return load_governance(root, load_certificate(read_bytes(path, "certificate"), f"'{path}'"))


def check_domain(domains: DomainSet, domain: int | None, root: Path) -> None:
    """Raise `KeystoreError` if ``domain`` is given and the keystore is not made for it."""
    if domain is None or domain in domains:
        return
    raise KeystoreError(
        f"ROS_DOMAIN_ID is {domain}, but keystore '{root}' is for domain {domains} only",
        "A node that joins any other domain with it is refused by DDS.",
        f"Set ROS_DOMAIN_ID to {domains}, or make a keystore with --domain {domain}.",
    )
