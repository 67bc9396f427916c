"""What ``--json`` prints of exports, signed requests and imported answers."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, NamedTuple

from sros_tool.keystore.layout import PERMISSIONS, enclave_folder
from sros_tool.keystore.outcomes import (
    AuthorityFacts,
    EnclaveResult,
    changes_below,
    enclave_result,
    trusted_authorities,
)
from sros_tool.keystore.reader import load_ca_certificate
from sros_tool.values import DryRun, FileChange, FileChanges, NamedKeystore, Notes, Words, shows

if TYPE_CHECKING:
    from sros_tool.keystore.delivery.answer import ImportedEnclave
    from sros_tool.keystore.delivery.request import Requested
    from sros_tool.keystore.delivery.signing import Certified, Signed


class ExportedEnclaves(NamedTuple):
    """The enclaves that were exported."""

    keystore: NamedKeystore
    dry_run: DryRun
    target: Path
    """TARGET, as it was named."""
    enclaves: Sequence[
        EnclaveResult[
            Annotated[
                str,
                Words(("exported", "kept")),
                "`exported`, or `kept` if TARGET was up to date.",
            ]
        ]
    ]
    """The exported enclaves."""
    left_out: Sequence[str]
    """Enclaves that fit ``--all`` or ``--match``, but whose key was made on its robot."""
    changes: FileChanges
    notes: Notes


def exported_outcomes(
    root: Path, names: Sequence[str], folder: Path, *, changed: bool
) -> list[EnclaveResult[str]]:
    """Return what was done with exported enclaves, which are below ``folder``."""
    outcome = "exported" if changed else "kept"
    return [
        enclave_result(root, name, outcome, written=True, folder=folder / enclave_folder(name))
        for name in names
    ]


class RequestedEnclave(NamedTuple):
    """An enclave with a signing request."""

    name: str
    """The enclave."""
    outcome: Annotated[str, Words(("requested", "requested_again"))]
    """``requested_again``: for the existing key."""
    folder: Path
    """The enclave's folder."""
    request: Path
    """The file to have signed."""
    key_sha256: str | None
    """SHA-256 of the enclave's public key (DER), in hexadecimal; null if a dry run made none."""


class MadeRequest(NamedTuple):
    """The signing request that was made."""

    folder: Path
    """DIR, as it was named."""
    dry_run: DryRun
    enclaves: Sequence[RequestedEnclave]
    """The enclave."""
    changes: FileChanges
    notes: Notes


def shown_request(folder: Path, made: Requested, *, again: bool, dry_run: bool) -> MadeRequest:
    """Return what is printed of a signing request."""
    key = made.key if again or not dry_run else None  # a dry run makes one, but does not keep it
    outcome = "requested_again" if again else "requested"
    enclave = RequestedEnclave(made.name, outcome, made.file.parent, made.file, key)
    return MadeRequest(folder, dry_run, (enclave,), changes_below(folder, made.changes), made.notes)


@shows(spread=("enclave",))
class CertifiedKey(NamedTuple):
    """An enclave whose key was certified."""

    enclave: EnclaveResult[
        Annotated[
            str,
            Words(("created", "renewed", "kept")),
            "What was done with the enclave; `kept` if its key has a certificate already.",
        ]
    ]
    key_sha256: str
    """SHA-256 of the enclave's public key (DER), in hexadecimal, to compare on both sides."""


class SignedRequest(NamedTuple):
    """The enclave that was certified, and the answer for its robot."""

    keystore: NamedKeystore
    dry_run: DryRun
    answer: Path | None
    """The file with the answer; ``-`` is standard output; null with ``--no-answer``."""
    enclaves: Sequence[CertifiedKey]
    """The enclave; with ``--no-answer``, all of them."""
    authorities: Sequence[AuthorityFacts]
    """The CAs that the robot will trust."""
    changes: FileChanges
    notes: Notes


def shown_answer(
    root: Path, signed: Signed, answer: Path, more: Sequence[FileChange], *, dry_run: bool
) -> SignedRequest:
    """Return what is printed of a signed request; ``more`` are changes outside of the keystore."""
    outcome = "renewed" if signed.renewed else "created"
    enclave = enclave_result(root, signed.name, outcome, written=not dry_run)
    return SignedRequest(
        root,
        dry_run,
        answer,
        [CertifiedKey(enclave, signed.key)],
        trusted_authorities(signed.identity_ca, load_ca_certificate(root, PERMISSIONS)),
        (*changes_below(root, signed.changes), *more),
        signed.notes,
    )


def shown_certified(root: Path, done: Certified, *, renew: bool, dry_run: bool) -> SignedRequest:
    """Return what is printed of requests that were certified without answers."""
    enclaves = []
    for name, key in done.keys.items():
        kept = name in done.kept
        outcome = "kept" if kept else "renewed" if renew else "created"
        enclave = enclave_result(root, name, outcome, written=kept or not dry_run)
        enclaves.append(CertifiedKey(enclave, key))
    return SignedRequest(
        root,
        dry_run,
        None,
        enclaves,
        trusted_authorities(done.identity_ca, load_ca_certificate(root, PERMISSIONS)),
        changes_below(root, done.changes),
        done.notes,
    )


class ImportedAnswer(NamedTuple):
    """The enclave that was imported."""

    folder: Path
    """DIR, as it was named."""
    dry_run: DryRun
    enclaves: Sequence[
        EnclaveResult[
            Annotated[
                str,
                Words(("imported", "kept")),
                "`imported`, or `kept` if this answer was installed already.",
            ]
        ]
    ]
    """The enclave."""
    authorities: Sequence[AuthorityFacts]
    """The CAs that the enclave trusts."""
    authorities_verified: bool
    """Whether ``--ca`` or earlier answers vouch for the CAs; if not, compare their SHA-256."""
    restart_zenoh: Sequence[str]
    """The enclave, if its processes on Zenoh have to be restarted."""
    changes: FileChanges
    notes: Notes


def shown_import(
    folder: Path, done: ImportedEnclave, *, pinned: bool, dry_run: bool
) -> ImportedAnswer:
    """Return what is printed of an imported answer."""
    outcome, known = "imported" if done.changes else "kept", not (dry_run and done.changes)
    return ImportedAnswer(
        folder,
        dry_run,
        [enclave_result(folder, done.name, outcome, written=known)],
        trusted_authorities(done.identity_ca, done.permissions_ca),
        authorities_verified=pinned or not done.first,
        restart_zenoh=(done.name,) if done.restart_zenoh else (),
        changes=changes_below(folder, done.changes),
        notes=done.notes,
    )
