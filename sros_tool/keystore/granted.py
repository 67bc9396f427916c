"""The rights that an enclave has signed, as DDS reads them."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from pathlib import Path

from sros_tool.dds.permissions import Grant, parse_permissions
from sros_tool.pki import smime
from sros_tool.xml import read_bytes


@dataclass(frozen=True, slots=True)
class Granted:
    """A signed permissions document, not verified yet, with its SHA-256.

    ``grant`` is the first that fits a subject, which is the one that DDS reads, or None.
    """

    signed: smime.SignedDocument
    digest: str
    grant: Grant | None


def read_granted(path: Path, subject: str) -> Granted:
    """Read what a ``permissions.p7s`` grants to a subject; raises where it is no such document."""
    message = read_bytes(path, "permissions document")
    signed = smime.parse(message)
    grants = parse_permissions(signed.document, f"'{path}'").grants
    grant = next((each for each in grants if each.subject == subject), None)
    return Granted(signed, hashlib.sha256(message).hexdigest(), grant)
