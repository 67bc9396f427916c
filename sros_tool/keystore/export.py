"""Exports enclaves for a robot: a keystore of real files, without links and without any CA key."""

from __future__ import annotations

import gzip
import io
import os
import tarfile
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path

from sros_tool.errors import KeystoreError
from sros_tool.keystore.create import list_enclaves
from sros_tool.keystore.enclave import enclave_path
from sros_tool.keystore.layout import (
    ENCLAVES,
    OPTIONAL_FILES,
    PRIVATE,
    REQUIRED_FILES,
    enclave_folder,
    folder_mode,
)
from sros_tool.keystore.transaction import Change, Transaction
from sros_tool.keystore.verify import check_enclave
from sros_tool.names import check_enclave_name
from sros_tool.pki.certificates import load_certificate
from sros_tool.xml import read_bytes

ARCHIVE_SUFFIXES = (".tar.gz", ".tgz")


@dataclass(frozen=True, slots=True)
class Export:
    """What was exported, and where to."""

    target: Path
    enclaves: tuple[str, ...]
    changes: tuple[Change, ...]


def distribute(
    root: Path,
    names: Sequence[str],
    target: Path,
    *,
    now: datetime,
    force: bool = False,
    dry_run: bool = False,
) -> Export:
    """Export enclaves to ``target``: an archive if it is named ``.tar.gz``, else a folder.

    The same enclaves give the same bytes.  An enclave that cannot run is not exported.  In a
    folder that already is an export, other enclaves stay; files that would change need ``force``.
    """
    files = _collect(root, names, now)
    if target.name.endswith(ARCHIVE_SUFFIXES):
        changes = _write_archive(target, files, force, dry_run)
    else:
        changes = _write_folder(root, target, files, force, dry_run)
    return Export(target, tuple(names), changes)


def _collect(root: Path, names: Sequence[str], now: datetime) -> dict[str, bytes]:
    existing = set(list_enclaves(root))
    files: dict[str, bytes] = {}
    for name in names:
        check_enclave_name(name)
        if name not in existing:
            raise KeystoreError(
                f"enclave {name} does not exist in keystore '{root}'",
                "",
                f"Make it with `sros create_enclave {root} {name}`.",
            )
        folder = enclave_path(root, name)
        state = check_enclave(folder, now=now)
        if state.problems:
            raise KeystoreError(
                f"enclave {name} would not run where it is sent",
                "; ".join(map(str, state.problems)) + ".",
                f"See `sros inspect {folder}`.",
            )
        for file in (*REQUIRED_FILES, *OPTIONAL_FILES):
            if (folder / file).exists():
                files[f"{enclave_folder(name)}/{file}"] = read_bytes(folder / file, "file")
    return dict(sorted(files.items()))


def _real(path: Path) -> Path:
    # Unlike Path.resolve, realpath does not fail at links that lead in a circle.
    return Path(os.path.realpath(path))


def _mode(path: str) -> int:
    return 0o600 if path.endswith("/key.pem") else 0o644


def _write_folder(
    root: Path, target: Path, files: dict[str, bytes], force: bool, dry_run: bool
) -> tuple[Change, ...]:
    if _real(target).is_relative_to(_real(root)):
        raise KeystoreError(
            f"'{target}' is the keystore itself or lies in it", "", "Choose another folder."
        )
    if os.path.lexists(target) and not target.is_dir():
        raise KeystoreError(f"'{target}' is in the way", "It is not a folder.")
    if (target / PRIVATE).exists():
        raise KeystoreError(
            f"'{target}' holds CA keys",
            "It is a keystore of its own, not an export.",
            "Choose another folder.",
        )
    _check_same_authority(target, files)
    different = {
        path: data
        for path, data in files.items()
        if not (target / path).is_file() or read_bytes(target / path, "file") != data
    }
    replaced = [path for path in different if os.path.lexists(target / path)]
    if replaced and not force:
        raise KeystoreError(
            f"'{target}' already holds another version of {', '.join(replaced)}",
            "Nothing was changed.",
            "Add --force to replace it, or choose another folder.",
        )
    with Transaction(target, fresh=True, dry_run=dry_run) as transaction:
        for path, data in different.items():
            transaction.write(path, data, private=_mode(path) == 0o600)
        transaction.commit()
    return tuple(transaction.changes)


def _check_same_authority(target: Path, files: dict[str, bytes]) -> None:
    """One folder holds the enclaves of one keystore only: others would never talk to each other."""
    ours = {data for path, data in files.items() if path.endswith("/identity_ca.cert.pem")}
    for path in sorted((target / ENCLAVES).rglob("identity_ca.cert.pem")):
        theirs = read_bytes(path, "certificate")
        if f"{path.relative_to(target)}" not in files and theirs not in ours:
            name = load_certificate(theirs, f"'{path}'").subject.rfc4514_string()
            raise KeystoreError(
                f"'{target}' holds enclaves of another keystore",
                f"Those trust {name}, and would not talk to these.",
                "Choose another folder.",
            )


def _write_archive(
    target: Path, files: dict[str, bytes], force: bool, dry_run: bool
) -> tuple[Change, ...]:
    data = _archive(files)
    if target.exists():
        if not target.is_file():
            raise KeystoreError(f"'{target}' is in the way", "It is not a regular file.")
        if target.read_bytes() == data:
            return ()
        if not force:
            raise KeystoreError(
                f"'{target}' already exists and differs",
                "Nothing was changed.",
                "Add --force to replace it, or choose another name.",
            )
    change = Change("replace" if target.exists() else "create", target.name)
    if not dry_run:
        _write_whole(target, data)
    return (change,)


def _archive(files: dict[str, bytes]) -> bytes:
    """A gzipped tar that depends on the files alone: no names, numbers or moments of a machine."""
    buffer = io.BytesIO()
    with (
        gzip.GzipFile(fileobj=buffer, mode="wb", filename="", mtime=0) as packed,
        tarfile.open(fileobj=packed, mode="w", format=tarfile.PAX_FORMAT) as tar,
    ):
        folders = {
            str(parent) for path in files for parent in Path(path).parents if str(parent) != "."
        }
        for folder in sorted(folders):
            entry = tarfile.TarInfo(folder)
            entry.type, entry.mode = tarfile.DIRTYPE, folder_mode(folder)
            tar.addfile(entry)
        for path, data in files.items():
            entry = tarfile.TarInfo(path)
            entry.size, entry.mode = len(data), _mode(path)
            tar.addfile(entry, io.BytesIO(data))
    return buffer.getvalue()


def _write_whole(target: Path, data: bytes) -> None:
    """Write a file that holds keys: whole or not at all, and readable by its owner only."""
    spare = target.with_name(f".{target.name}.{os.getpid()}")
    handle = os.open(spare, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
    try:
        with os.fdopen(handle, "wb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        spare.replace(target)
    except BaseException:
        with suppress(OSError):
            spare.unlink()
        raise
