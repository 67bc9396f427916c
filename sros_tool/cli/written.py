"""What verbs that write print with ``--json``: what was done, or with ``--dry-run`` would be."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sros_tool.errors import SrosError
from sros_tool.values import as_plain

if TYPE_CHECKING:
    from cryptography import x509

    from sros_tool.errors import Note
    from sros_tool.keystore.transaction.stage import Change


def changes_json(root: Path, changes: Iterable[Change]) -> list[dict[str, str]]:
    """Return the changes below the folder ``root`` as JSON values, with whole paths."""
    return [{"action": each.action, "path": str(root / each.path)} for each in changes]


def file_change(path: Path, *, existed: bool) -> list[dict[str, str]]:
    """Return the change of a single file as JSON values."""
    return [{"action": "replace" if existed else "create", "path": str(path)}]


def enclave_json(
    root: Path, name: str, outcome: str, *, written: bool, folder: Path | None = None
) -> dict[str, Any]:
    """Return an enclave of the keystore ``root`` as JSON values, with its certificate.

    Args:
        root: the keystore.
        name: the enclave.
        outcome: what was done with it, such as ``created``.
        written: whether its files are there; those of a dry run have no certificate yet.
        folder: where the enclave is, if it is not the one in the keystore.
    """
    from sros_tool.keystore.expiry import read_credentials
    from sros_tool.keystore.layout import enclave_path
    from sros_tool.pki.certificates import digest
    from sros_tool.validity import iso

    value: dict[str, Any] = {
        "name": name,
        "outcome": outcome,
        "folder": str(folder or enclave_path(root, name)),
        "serial": None,
        "sha256": None,
        "valid_until": None,
    }
    if written:
        with suppress(SrosError):  # an existing enclave that is broken was left as it is
            found = read_credentials(root, name)
            value |= {
                "serial": f"{found.certificate.serial_number:x}",
                "sha256": digest(found.certificate),
                "valid_until": iso(found.lifetime().expires()),
            }
    return value


def authority_json(roles: Sequence[str], certificate: x509.Certificate | None) -> dict[str, Any]:
    """Return a CA as JSON values; ``certificate`` is None if a dry run did not make it."""
    from sros_tool.pki.certificates import digest, subject_text, validity_of
    from sros_tool.validity import iso

    return {
        "roles": list(roles),
        "subject": subject_text(certificate.subject) if certificate else None,
        "serial": f"{certificate.serial_number:x}" if certificate else None,
        "sha256": digest(certificate) if certificate else None,
        "valid_until": iso(validity_of(certificate).not_after) if certificate else None,
    }


def notes_json(notes: Iterable[Note]) -> Any:
    """Return notes as JSON values."""
    return as_plain(tuple(notes))
