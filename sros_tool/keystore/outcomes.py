"""The outcomes of a verb for enclaves, CAs and files of a keystore, as ``--json`` prints them."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Generic, NamedTuple, TypeVar

from cryptography import x509

from sros_tool.errors import Note, SrosError
from sros_tool.keystore.expiry import read_credentials
from sros_tool.keystore.layout import ROLES
from sros_tool.keystore.reader import OpenedKeystore
from sros_tool.keystore.transaction import Change
from sros_tool.pki.certificates import digest, subject_text, validity_of
from sros_tool.values import FileChange, Words

if TYPE_CHECKING:
    from sros_tool.translate_zenoh.graph import AnnouncedNodes

Outcome = TypeVar("Outcome", bound=str)
Restart = Annotated[
    Sequence[str],
    "The enclaves whose processes have to be restarted for the change to take effect.",
]
RestartZenoh = Annotated[
    Sequence[str], "The enclaves whose processes on Zenoh have to be restarted."
]


@dataclass(frozen=True, slots=True)
class StagedZenoh:
    """The Zenoh configurations after a change of a keystore.

    ``files`` maps enclaves to their files in the keystore.  ``written`` maps the paths of staged
    files to content.  ``nodes`` maps enclaves to the nodes that they may announce.  ``left_out``
    maps enclaves that get no file to the reason (a clause).  ``restart`` are the enclaves whose
    processes must be restarted because their configurations changed.
    """

    files: Mapping[str, str] = field(default_factory=dict)
    nodes: Mapping[str, AnnouncedNodes] = field(default_factory=dict)
    left_out: Mapping[str, str] = field(default_factory=dict)
    written: Mapping[str, bytes] = field(default_factory=dict)
    restart: tuple[str, ...] = ()
    notes: tuple[Note, ...] = ()

    def without_restart_of(self, names: Collection[str]) -> StagedZenoh:
        """Return a copy in which the enclaves ``names`` need no restart."""
        return replace(self, restart=tuple(name for name in self.restart if name not in names))


class EnclaveResult(NamedTuple, Generic[Outcome]):
    """The outcome of a command for an enclave."""

    name: str
    """Name of the enclave."""
    outcome: Outcome
    folder: Path
    """Folder of the enclave; for an enclave in an archive, its path in the archive."""
    serial: str | None
    """Serial number of the certificate, in hexadecimal; null if a dry run did not issue a
    certificate, or if the certificate cannot be read.
    """
    sha256: str | None
    """SHA-256 of the certificate (DER), in hexadecimal; null without a certificate."""
    valid_until: datetime | None
    """When the certificate or the permissions expire, whichever is first, in UTC; null if
    ``serial`` is null.
    """


def enclave_result(
    keystore: OpenedKeystore, name: str, outcome: str, *, written: bool, folder: Path | None = None
) -> EnclaveResult[str]:
    """Return the outcome of a verb for an enclave, with facts about the enclave's certificate.

    Args:
        keystore: the keystore, opened after the change.
        name: the name of the enclave.
        outcome: what was done with the enclave, such as ``created``.
        written: whether the enclave's files exist; in a dry run, there is no certificate yet.
        folder: the folder of the enclave, if it is not in the keystore.
    """
    folder = folder or keystore.folder(name)
    if written:
        with suppress(SrosError):  # an existing enclave that is broken was not changed
            issued = read_credentials(keystore, name)
            number, sha256 = issued.certificate.serial_number, digest(issued.certificate)
            until = issued.lifetime().first_expiry()
            return EnclaveResult(name, outcome, folder, f"{number:x}", sha256, until)
    return EnclaveResult(name, outcome, folder, None, None, None)


class AuthorityFacts(NamedTuple):
    """A CA, and its certificate."""

    roles: Sequence[Annotated[str, Words(ROLES)]]
    """Roles of the CA."""
    subject: str | None
    """Subject of the certificate; null if a dry run did not make the certificate."""
    serial: str | None
    """Serial number of the certificate, in hexadecimal; null without a certificate."""
    sha256: str | None
    """SHA-256 of the certificate (DER), in hexadecimal; null without a certificate."""
    valid_until: datetime | None
    """Expiry of the certificate, in UTC; null if ``subject`` is null."""


def authority_facts(roles: Sequence[str], certificate: x509.Certificate | None) -> AuthorityFacts:
    """Return the facts about a CA; None stands for a certificate that a dry run did not make."""
    if certificate is None:
        return AuthorityFacts(roles, None, None, None, None)
    return AuthorityFacts(
        roles,
        subject_text(certificate.subject),
        f"{certificate.serial_number:x}",
        digest(certificate),
        validity_of(certificate).not_after,
    )


def trusted_authorities(
    identity: x509.Certificate, permissions: x509.Certificate
) -> tuple[AuthorityFacts, ...]:
    """Return the facts about the CAs that a robot trusts: one CA if it has both roles, else two."""
    if identity == permissions:
        return (authority_facts(ROLES, identity),)
    pairs = zip(ROLES, (identity, permissions), strict=True)
    return tuple(authority_facts((role,), certificate) for role, certificate in pairs)


def changes_below(root: Path, changes: Iterable[Change]) -> tuple[FileChange, ...]:
    """Return ``changes`` with complete paths; their own paths are relative to ``root``."""
    return tuple(FileChange(change.action, str(root / change.path)) for change in changes)
