"""What ``--json`` prints of exports, signed requests and imported answers."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, NamedTuple

from sros_tool.keystore.layout import enclave_folder
from sros_tool.keystore.lifecycle.shown import enclave_results, shown
from sros_tool.keystore.outcomes import (
    AuthorityFacts,
    EnclaveResult,
    changes_below,
    enclave_result,
    trusted_authorities,
)
from sros_tool.values import DryRun, FileChange, FileChanges, NamedKeystore, Notes, Words, shows

if TYPE_CHECKING:
    from sros_tool.keystore.delivery.answer import ImportedEnclave
    from sros_tool.keystore.delivery.request import Requested
    from sros_tool.keystore.delivery.signing import Signed


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


def shown_signed(
    signed: Signed, answer: Path | None = None, more: Sequence[FileChange] = ()
) -> SignedRequest:
    """Return what is printed of signed requests; ``more`` are changes outside of the keystore."""
    keys = [CertifiedKey(enclave, signed.keys[enclave.name]) for enclave in enclave_results(signed)]
    return shown(
        signed,
        SignedRequest,
        answer=answer,
        enclaves=keys,
        authorities=trusted_authorities(signed.identity_ca, signed.permissions_ca),
        changes=(*changes_below(signed.root, signed.changes), *more),
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


def shown_import(imported: ImportedEnclave, *, pinned: bool) -> ImportedAnswer:
    """Return what is printed of an imported answer."""
    return shown(
        imported,
        ImportedAnswer,
        authorities=trusted_authorities(imported.identity_ca, imported.permissions_ca),
        authorities_verified=pinned or not imported.first,
        restart_zenoh=imported.restart,
    )
