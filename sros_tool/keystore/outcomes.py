"""What was done with enclaves, CAs and files of a keystore, as ``--json`` prints it."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from datetime import datetime
from pathlib import Path
from typing import Annotated, Generic, NamedTuple, TypeVar

from cryptography import x509

from sros_tool.errors import Note, SrosError
from sros_tool.keystore.expiry import read_credentials
from sros_tool.keystore.layout import ROLES
from sros_tool.keystore.reader import Keystore
from sros_tool.keystore.transaction.stage import Change
from sros_tool.pki.certificates import digest, subject_text, validity_of
from sros_tool.values import FileChange, Words

Outcome = TypeVar("Outcome", bound=str)
Restart = Annotated[
    Sequence[str],
    "The enclaves whose processes have to be restarted for the change to take effect.",
]
RestartZenoh = Annotated[
    Sequence[str], "The enclaves whose processes on Zenoh have to be restarted."
]


@dataclass(frozen=True, slots=True)
class KeptZenoh:
    """What a change of a keystore meant for its Zenoh configurations.

    ``files`` maps the enclaves to their files in the keystore, ``written`` the paths that were
    staged to their content.  ``restart`` are the enclaves whose
    processes have to be restarted, because their configurations changed.
    """

    files: Mapping[str, str] = field(default_factory=dict)
    written: Mapping[str, bytes] = field(default_factory=dict)
    restart: tuple[str, ...] = ()
    notes: tuple[Note, ...] = ()

    def without(self, names: Collection[str]) -> KeptZenoh:
        """Return the same without restarting the enclaves ``names``."""
        return replace(self, restart=tuple(each for each in self.restart if each not in names))


class EnclaveResult(NamedTuple, Generic[Outcome]):
    """An enclave."""

    name: str
    """The enclave."""
    outcome: Outcome
    folder: Path
    """The enclave's folder; in an archive, its path in the archive."""
    serial: str | None
    """Serial number of its certificate, in hexadecimal; null if a dry run did not issue it, or it
    cannot be read."""
    sha256: str | None
    """SHA-256 of its certificate (DER), in hexadecimal; null as above."""
    valid_until: datetime | None
    """First expiry of its certificate and its permissions, in UTC; null as above."""


def enclave_result(
    keystore: Keystore, name: str, outcome: str, *, written: bool, folder: Path | None = None
) -> EnclaveResult[str]:
    """Return what was done with an enclave of ``keystore``, with its certificate.

    Args:
        keystore: the keystore, opened after the change.
        name: the enclave.
        outcome: what was done with it, such as ``created``.
        written: whether its files are there; those of a dry run have no certificate yet.
        folder: where the enclave is, if it is not the one in the keystore.
    """
    folder = folder or keystore.folder(name)
    if written:
        with suppress(SrosError):  # an existing enclave that is broken was left as it is
            issued = read_credentials(keystore, name)
            number, sha256 = issued.certificate.serial_number, digest(issued.certificate)
            until = issued.lifetime().expires()
            return EnclaveResult(name, outcome, folder, f"{number:x}", sha256, until)
    return EnclaveResult(name, outcome, folder, None, None, None)


class AuthorityFacts(NamedTuple):
    """A CA."""

    roles: Sequence[Annotated[str, Words(ROLES)]]
    """What the CA signs."""
    subject: str | None
    """Subject of its certificate; null if a dry run did not make it."""
    serial: str | None
    """Serial number of its certificate, in hexadecimal; null as above."""
    sha256: str | None
    """SHA-256 of its certificate (DER), in hexadecimal; null as above."""
    valid_until: datetime | None
    """Expiry of its certificate, in UTC; null as above."""


def authority_facts(roles: Sequence[str], certificate: x509.Certificate | None) -> AuthorityFacts:
    """Return what is shown of a CA; ``certificate`` is None if a dry run did not make it."""
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
    """Return the CAs that a robot trusts; a single CA of both roles once."""
    if identity == permissions:
        return (authority_facts(ROLES, identity),)
    pairs = zip(ROLES, (identity, permissions), strict=True)
    return tuple(authority_facts((role,), certificate) for role, certificate in pairs)


def changes_below(root: Path, changes: Iterable[Change]) -> tuple[FileChange, ...]:
    """Return the changes below the folder ``root``, with whole paths."""
    return tuple(FileChange(each.action, str(root / each.path)) for each in changes)
