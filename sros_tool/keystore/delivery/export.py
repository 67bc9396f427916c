"""Exports for robots: keystores of regular files, without links and without CA keys."""

from __future__ import annotations

import hashlib
import os
import tomllib
from collections import defaultdict
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from datetime import datetime
from functools import lru_cache
from pathlib import Path
from shlex import quote
from typing import Annotated, NamedTuple

from sros_tool.errors import DocumentError, KeystoreError, Note, SrosError
from sros_tool.faults import Fault
from sros_tool.files import staged_file
from sros_tool.fleet.robots import robot_of
from sros_tool.folders import Folder
from sros_tool.keystore.confirmation import enclave_of
from sros_tool.keystore.delivery.archive import (
    LIMITS_OF_ONE_ROBOT,
    SUFFIXES,
    file_mode,
    pack,
    refuse_archive_name,
    unpack,
)
from sros_tool.keystore.delivery.robot import check_same_authority
from sros_tool.keystore.delivery.rollback import (
    ROLES_OF_FILES,
    check_own_keys,
    check_rollback,
    trust_files_in,
)
from sros_tool.keystore.fleet import load_fleet, unrecorded_notes
from sros_tool.keystore.known_keys import (
    KnownKeys,
    known_authorities,
    other_keys_remedy,
    restored_at,
    unlisted_revocations,
)
from sros_tool.keystore.layout import (
    AGENT,
    CRL_FILE,
    ENCLAVES,
    GOVERNANCE_FILE,
    IDENTITY_CA_FILE,
    KEY_FILE,
    KEY_FILES,
    KEY_URI_FILE,
    OPTIONAL_FILES,
    PERMISSIONS_CA_FILE,
    PERMISSIONS_FILE,
    PRIVATE,
    REQUIRED_FILES,
    ZENOH_FILES,
    check_readable,
    enclave_folder,
    enclave_path,
    key_on_robot,
    search_enclaves,
)
from sros_tool.keystore.outcomes import EnclaveResult, enclave_result
from sros_tool.keystore.participant import EvaluatedEnclave, evaluate_enclave
from sros_tool.keystore.reader import OpenedEnclave, OpenedKeystore, read_consistently
from sros_tool.keystore.selection import missing_enclave_error
from sros_tool.keystore.transaction import Change, Transaction
from sros_tool.keystore.zenoh_files import open_zenoh
from sros_tool.names import check_enclave_name
from sros_tool.owners import refuse_link_of_stranger
from sros_tool.pki.certificates import fingerprints, load_certificates, validity_of
from sros_tool.pki.keys import holds_private_key
from sros_tool.pki.token import parse_token_file
from sros_tool.values import DryRun, FileChanges, NamedKeystore, Notes, Words
from sros_tool.wording import first_few
from sros_tool.xml import read_bytes

_MOST_SHOWN = 5
_ADD_KEYLESS = (
    "Add --keyless to export the other files, which belong next to the key on the robot. If the "
    "robot has made a new key that has no certificate yet, first sign its request.pem with `sros "
    "sign_request --renew`."
)


@dataclass(frozen=True, slots=True)
class Export:
    """The exported enclaves, and the changed files below ``target``."""

    target: Path
    enclaves: tuple[str, ...]
    changes: Sequence[Change]
    notes: tuple[Note, ...] = ()


@dataclass(frozen=True, slots=True)
class ExportSelection:
    """The enclaves to export, and the enclaves that the export has to leave out.

    The enclaves in ``left_out`` match the selection, but their keys are on their robots.
    """

    names: tuple[str, ...]
    left_out: tuple[str, ...]


def select_enclaves_to_export(
    keystore: OpenedKeystore, names: Iterable[str], named: Collection[str], *, keyless: bool
) -> ExportSelection:
    """Return the enclaves to export, and the enclaves left out because their keys are on robots.

    With ``keyless``, no enclave is left out. Enclaves in ``named`` (given by name) are never left
    out, so that `distribute` refuses them.

    Raises:
        KeystoreError: this is not a keystore, or the keys of all selected enclaves are on robots.
    """
    keystore.check()
    chosen: list[str] = []
    left_out: list[str] = []
    for name in dict.fromkeys(names):
        only_matches = name not in named and not keyless
        at_robot = only_matches and key_on_robot(keystore.folder(name))
        (left_out if at_robot else chosen).append(name)
    if not chosen:
        raise KeystoreError(
            f"the keys of {', '.join(left_out)} are not in keystore '{keystore.root}'",
            "They were made on their robots and stay there.",
            _ADD_KEYLESS,
        )
    return ExportSelection(tuple(chosen), tuple(left_out))


def distribute(
    keystore: OpenedKeystore,
    names: Sequence[str],
    target: Path,
    *,
    now: datetime,
    force: bool = False,
    keyless: bool = False,
    dry_run: bool = False,
) -> Export:
    """Export enclaves to ``target``: an archive if its name ends with ``.tar.gz``, else a folder.

    The same enclaves always give the same bytes.  In a folder from an earlier export, other
    enclaves stay.  With ``keyless``, enclaves whose keys are on their robots are also exported,
    without keys.

    Raises:
        KeystoreError: an enclave does not exist or cannot run, ``target`` cannot be used, or
            ``target`` has other content, which only ``force`` replaces.
    """
    _check_keys_of_robots(keystore, names)
    files = exported_files(keystore, names, now, keyless=keyless)
    notes = (*_token_notes(files), *unrecorded_notes(keystore, load_fleet(keystore), names))
    if target.name.endswith(SUFFIXES):
        changes = _write_archive(keystore, target, files, now=now, force=force, dry_run=dry_run)
        return Export(target, tuple(names), changes, notes)
    refuse_archive_name(target, "Name an archive FILE.tar.gz, or a folder without such an ending.")
    changes = _write_folder(keystore, target, files, now=now, force=force, dry_run=dry_run)
    notes += (*_readable_key_notes(target, names), *_other_enclave_notes(keystore, target, names))
    return Export(target, tuple(names), changes, notes)


def included_keys_notes(keystore: OpenedKeystore, names: Iterable[str]) -> Iterator[Note]:
    """Yield a note on enclaves whose private keys are in an export despite ``--keyless``."""
    keys = [name for name in names if (keystore.folder(name) / KEY_FILE).exists()]
    if keys:
        their = "its private key" if len(keys) == 1 else "their private keys"
        yield Note(
            "export.keys-included",
            f"the export has {first_few(keys, _MOST_SHOWN)} with {their}: --keyless does not "
            "leave out keys that the keystore has. Releases of `sros fleet publish` have no "
            "private key.",
        )


def _token_notes(files: Mapping[str, bytes]) -> Iterator[Note]:
    """Yield a note for each enclave whose key is on a token, and so is not in ``files``."""
    for path in files:
        folder, _, file = path.rpartition("/")
        if file == KEY_URI_FILE:
            place = parse_token_file(files[path])
            text = (
                f"{folder.removeprefix(ENCLAVES) or '/'}: the key is not exported. It is "
                f"{place.object} on the token {place.token}, which has to be in the robot."
            )
            yield Note("export.key-on-token", text)


def _readable_key_notes(target: Path, names: Sequence[str]) -> Iterator[Note]:
    """Yield a note for each private key in an unchanged export that other users can read."""
    for name in names:
        with suppress(OSError):
            key = enclave_path(target, name) / KEY_FILE
            if key.stat().st_mode & 0o077:
                yield Note(
                    "export.key-readable",
                    f"others can read '{key}': run `chmod 600 {quote(str(key))}`, and replace the "
                    "key if somebody may have copied it: `sros renew KEYSTORE ENCLAVE --new-key "
                    "--revoke-old`.",
                )


def _other_enclave_notes(
    keystore: OpenedKeystore, target: Path, names: Sequence[str]
) -> Iterator[Note]:
    """Yield notes on enclaves in ``target`` that the keystore lacks, or that other robots have."""
    present, fleet = search_enclaves(target)[0], load_fleet(keystore)
    owners = {n: robot_of(fleet, n) if fleet else None for n in (*names, *present)}
    exported = {owner.name for name in names if (owner := owners[name])}
    of_others: dict[str, list[str]] = defaultdict(list)
    for name in present:
        owner = owners[name]
        if not keystore.has_enclave(name):
            yield Note(
                "export.not-in-keystore",
                f"'{target}' also has enclave {name}, which keystore '{keystore.root}' does not "
                "have. If the enclave was revoked, remove it from "
                f"the robot, and from this folder: `{_removal_command(target, [name], present)}`.",
            )
        elif owner and exported and owner.name not in exported:
            of_others[owner.name].append(name)
    for robot, enclaves in of_others.items():
        yield Note(
            "export.of-another-robot",
            f"'{target}' also has {first_few(enclaves, _MOST_SHOWN)} of robot {robot}: whoever "
            f"has the folder can act as {robot}. If files of {robot} are not meant to be there, "
            f"remove them: `{_removal_command(target, enclaves, present)}`. If they were on "
            f"another robot, give {robot} new keys: `sros renew {quote(str(keystore.root))} "
            f"--robot {quote(robot)} --new-key --revoke-old`.",
        )


def _removal_command(target: Path, names: Sequence[str], present: Sequence[str]) -> str:
    """Return the command that removes enclaves from a folder, but not enclaves nested in them.

    ``present`` are all enclaves in the folder ``target``.
    """
    nested = any(
        other.startswith(f"{name}/") for name in names for other in {*present}.difference(names)
    )
    folders = (quote(str(enclave_path(target, name))) for name in names)
    # Only names of files have a dot, so nested enclaves stay.
    return "rm " + " ".join(f"{folder}/*.*" if nested else f"-r {folder}" for folder in folders)


@dataclass(frozen=True, slots=True)
class PackedEnclaves:
    """An archive (``.tar.gz``) of enclaves, and the paths of the files in it."""

    data: bytes
    paths: tuple[str, ...]
    notes: tuple[Note, ...] = ()


def pack_enclaves(
    keystore: OpenedKeystore, names: Sequence[str], *, now: datetime, keyless: bool = False
) -> PackedEnclaves:
    """Return an archive of enclaves in memory; ``keyless`` is as in `distribute`.

    Raises:
        KeystoreError: an enclave does not exist, or cannot run.
    """
    _check_keys_of_robots(keystore, names)
    files = exported_files(keystore, names, now, keyless=keyless)
    return PackedEnclaves(pack(files), tuple(files), tuple(_token_notes(files)))


@read_consistently
def exported_files(
    keystore: OpenedKeystore, names: Sequence[str], now: datetime, *, keyless: bool = False
) -> dict[str, bytes]:
    """Map the paths of the files to export to their content; ``keyless`` is as in `distribute`.

    All files are of the same state of the keystore: either all enclaves have the revocation list
    from before a revocation, or all have the new list.

    Raises:
        KeystoreError: an enclave does not exist, or cannot run.
    """
    keystore.check()
    _check_list(keystore, now)
    for name in names:
        if not keystore.has_enclave(check_enclave_name(name)):
            raise missing_enclave_error(keystore, name, keystore.names)
    check_readable(keystore.root, names)
    files: dict[str, bytes] = {}
    for name in names:
        at_robot = key_on_robot(keystore.folder(name))
        if at_robot and not keyless:
            raise KeystoreError(
                f"the key of enclave {name} is not in keystore '{keystore.root}'",
                "It was made on its robot and stays there, so no process could run with the "
                "exported files.",
                _ADD_KEYLESS,
            )
        evaluation = _evaluate_enclave(keystore, name, now)
        if evaluation.problems:
            raise _refused_enclave_error(keystore, name, evaluation.problems)
        files |= _files_of(keystore, name, evaluation)
    return dict(sorted(files.items()))


def _check_keys_of_robots(keystore: OpenedKeystore, names: Sequence[str]) -> None:
    """Raise `KeystoreError` if the export would replace a key that its robot made."""
    unknowing = KnownKeys(keystore).made_unknowing(names) if restored_at(keystore) else {}
    if others := sorted({*unknowing.values()}):
        raise KeystoreError(
            f"the keystore has other keys for {first_few(others, 3)} than the robots",
            "After the backup of the keystore, robots got certificates for their keys, which "
            "the export would replace.",
            other_keys_remedy(keystore.root, others),
        )


class ReleasedEnclave(NamedTuple):
    """The files of an enclave without its key, and the result of evaluating them.

    ``not_valid`` is a clause on what is not valid now, or "".  Until the time ``until``, the files
    also work with another revocation list that is valid and does not revoke the enclave.
    """

    files: Mapping[str, bytes]
    not_valid: str
    until: datetime


def released_enclave(keystore: OpenedKeystore, name: str, now: datetime) -> ReleasedEnclave:
    """Return the files of an enclave for its robot, after evaluating them.

    An enclave that cannot run only because of a date (expired, or not valid yet) is released
    nevertheless: its robot may have other enclaves that can run, and needs the revocation list.

    Raises:
        KeystoreError: the enclave cannot run for another reason.
    """
    _check_list(keystore, now)
    evaluation = _evaluate_enclave(keystore, name, now)
    state = evaluation.state
    problems = state.problems_in_keystore
    lasting = [str(problem) for problem in problems if problem.fault not in _DATE_FAULTS]
    if lasting or (evaluation.problems and not problems):
        raise _refused_enclave_error(keystore, name, lasting or evaluation.problems)
    _check_zenoh(keystore, name, state)
    _check_not_ca_key(keystore.folder(name), state)
    files = released_files(keystore, name)
    until = now if problems else _evaluated_until(files, state, now)
    return ReleasedEnclave(files, "; ".join(map(str, problems)), until)


def released_files(keystore: OpenedKeystore, name: str) -> dict[str, bytes]:
    """Map the paths of all files of an enclave, except its key, to their content.

    The files are not evaluated.

    Raises:
        KeystoreError: a file contains a private key.
    """
    return _read_files(keystore, name, (file for file in _EXPORTED_FILES if file not in KEY_FILES))


def _evaluated_until(files: Mapping[str, bytes], state: OpenedEnclave, now: datetime) -> datetime:
    """Return the time until which files without problems need no new evaluation: the first expiry.

    Revocation lists are not considered, because they are evaluated separately.  If the files also
    depend on lists in other ways (a list in the file of a CA, or Zenoh configurations), the result
    is ``now``.
    """
    by_name = {path.rpartition("/")[2]: data for path, data in files.items()}
    authorities = [by_name[file] for file in (IDENTITY_CA_FILE, PERMISSIONS_CA_FILE)]
    if by_name.keys() & {*ZENOH_FILES} or any(b"X509 CRL" in data for data in authorities):
        return now
    if not (state.certificate and state.permissions):
        return now
    return min(
        validity_of(state.certificate).not_after,
        *(grant.validity.not_after for grant in state.permissions.grants),
        *map(_first_expiry, authorities),
    )


@lru_cache(maxsize=16)
def _first_expiry(authorities: bytes) -> datetime:
    return min(
        validity_of(certificate).not_after for certificate in load_certificates(authorities, "")
    )


_DATE_FAULTS = frozenset(
    {
        Fault.CERTIFICATE_EXPIRED,
        Fault.CERTIFICATE_NOT_YET_VALID,
        Fault.CA_EXPIRED,
        Fault.CA_NOT_YET_VALID,
        Fault.CRL_EXPIRED,
        Fault.CRL_NOT_YET_VALID,
        Fault.PERMISSIONS_EXPIRED,
        Fault.PERMISSIONS_NOT_YET_VALID,
    }
)
"""Faults that depend on the time."""


def _evaluate_enclave(keystore: OpenedKeystore, name: str, now: datetime) -> EvaluatedEnclave:
    return evaluate_enclave(
        name, keystore.folder(name), keystore.enclave(name, now=now), moment=now
    )


def _refused_enclave_error(
    keystore: OpenedKeystore, name: str, problems: Sequence[str]
) -> KeystoreError:
    return KeystoreError(
        f"no process would run in enclave {name} on a robot",
        "; ".join(problem.rstrip(".") for problem in problems) + ".",
        f"See `sros inspect {quote(str(keystore.folder(name)))}`.",
    )


def _files_of(
    keystore: OpenedKeystore, name: str, evaluation: EvaluatedEnclave
) -> dict[str, bytes]:
    """Map the paths of all files of an enclave to their content.

    Raises:
        KeystoreError: another file than the enclave's key has a private key, or a Zenoh
            configuration cannot be used.
    """
    _check_zenoh(keystore, name, evaluation.state)
    _check_not_ca_key(keystore.folder(name), evaluation.state)
    return _read_files(keystore, name, _EXPORTED_FILES)


_EXPORTED_FILES = (*REQUIRED_FILES, KEY_URI_FILE, *OPTIONAL_FILES, *ZENOH_FILES)


def _read_files(
    keystore: OpenedKeystore, name: str, wanted_files: Iterable[str]
) -> dict[str, bytes]:
    """Map the paths of an enclave's ``wanted_files`` to their content; missing files are left out.

    Raises:
        KeystoreError: another file than the enclave's key has a private key.
    """
    files: dict[str, bytes] = {}
    with Folder(keystore.root) as opened:
        for file in wanted_files:
            path = f"{enclave_folder(name)}/{file}"
            with suppress(FileNotFoundError):
                files[path] = opened.read_inside(path)
                if file != KEY_FILE and holds_private_key(files[path]):
                    raise _ca_key_error(keystore.root / path)
                if role := ROLES_OF_FILES.get(file):
                    _check_authorities(keystore, role, keystore.root / path, files[path])
                if file in (GOVERNANCE_FILE, PERMISSIONS_FILE):
                    _check_last_document(keystore, name, keystore.root / path, files[path])
    return files


def _check_list(keystore: OpenedKeystore, now: datetime) -> None:
    """Raise `KeystoreError` if the revocation list lacks revocations that the ledger records."""
    if names := unlisted_revocations(keystore, now):
        raise KeystoreError(
            f"the revocation list of keystore '{keystore.root}' lacks revoked certificates of "
            f"{first_few(names, 3)}",
            "An earlier list was put back, or the list was removed: robots would accept the "
            "certificates.",
            "Find out who changed the list, and run "
            f"`sros crl {quote(str(keystore.root))} --refresh`.",
        )


def _check_authorities(keystore: OpenedKeystore, role: str, path: Path, data: bytes) -> None:
    """Raise `KeystoreError` if a CA file has a CA that is not in the ledger.

    A ledger with gaps proves nothing, so there is no error.
    """
    known = known_authorities(keystore, role)
    if known is None or keystore.ledger_with("what", "ca").gaps:
        return
    if strangers := sorted(fingerprints(data) - known):
        raise KeystoreError(
            f"'{path}' has a CA that the keystore does not know (SHA-256 {strangers[0][:8]})",
            "Robots would trust everything that is issued with its key.",
            f"Find out who added the CA: `sros check {quote(str(keystore.root))}` says what to do.",
        )


def _check_last_document(keystore: OpenedKeystore, name: str, path: Path, data: bytes) -> None:
    """Raise `KeystoreError` if a signed document is not the last one that the ledger records.

    Documents that ros2/sros2 signed are not in the ledger, and are exported as they are.
    """
    kind = path.name.partition(".")[0]
    if kind == "governance":  # the governance is shared by all enclaves
        entries = keystore.ledger_with("what", kind).entries
    else:
        entries = keystore.ledger_file.with_values("enclave", (name,)).entries
    signed = [
        entry.sha256
        for entry in entries
        if entry.what == kind and (kind == "governance" or entry.enclave == name)
    ]
    sha256 = hashlib.sha256(data).hexdigest()
    if sha256 in signed and sha256 != signed[-1]:
        raise KeystoreError(
            f"'{path}' is older than the last signed {kind}",
            f"Somebody put it back, and robots would get the earlier {kind}.",
            f"Find out who put it back: `sros check {quote(str(keystore.root))}` says what to do.",
        )


def _check_not_ca_key(folder: Path, state: OpenedEnclave) -> None:
    """Raise `KeystoreError` if the key of an enclave is the key of a CA."""
    if any(
        authority and state.certificate and authority.public_key() == state.certificate.public_key()
        for authority in (state.identity_ca, state.permissions_ca)
    ):
        raise _ca_key_error(folder / KEY_FILE)


def _check_zenoh(keystore: OpenedKeystore, name: str, state: OpenedEnclave) -> None:
    """Raise `KeystoreError` for Zenoh configurations that `sros run` would refuse on the robot."""
    zenoh = open_zenoh(keystore.folder(name), name, state)
    if zenoh.files and zenoh.problems:
        raise KeystoreError(
            f"the Zenoh configuration of enclave {name} could not be used on a robot",
            "; ".join(map(str, zenoh.problems)) + ".",
            f"Write it again: `sros zenoh {quote(str(keystore.root))}`.",
        )


def _ca_key_error(path: Path) -> KeystoreError:
    return KeystoreError(
        f"'{path}' contains a private key that is not the key of an enclave",
        "A CA key would get to the robot, and whoever has the robot could issue any identity.",
        "Remove the key from the file, or make the enclave again with a key of its own.",
    )


def _real_path(path: Path) -> Path:
    # Unlike Path.resolve, realpath does not fail for circular links.
    return Path(os.path.realpath(path))


def _write_folder(
    keystore: OpenedKeystore,
    target: Path,
    files: dict[str, bytes],
    *,
    now: datetime,
    force: bool,
    dry_run: bool,
) -> Sequence[Change]:
    if _real_path(target).is_relative_to(_real_path(keystore.root)):
        raise KeystoreError(
            f"'{target}' is the keystore itself or a folder in it", "", "Choose another folder."
        )
    refuse_link_of_stranger(target)
    if os.path.lexists(target) and not target.is_dir():
        raise KeystoreError(
            f"'{target}' is in the way", "It is not a folder.", "Choose another folder."
        )
    if (target / PRIVATE).exists():
        raise KeystoreError(
            f"'{target}' contains CA keys",
            "It is a keystore with CAs, not an export.",
            "Choose another folder.",
        )
    with Transaction(target, new_keystore=True, dry_run=dry_run) as transaction:
        check_same_authority(
            target, files, earlier=frozenset(entry.sha256 for entry in keystore.entries_of("ca"))
        )
        _check_robot(keystore, target, files)
        check_rollback(keystore, target, trust_files_in(target, files), files, now)
        check_own_keys(target, files)
        stale = _stale_paths(target, files)
        different = {
            path: data
            for path, data in files.items()
            if not (target / path).is_file() or read_bytes(target / path, "file") != data
        }
        replaced = [path for path in (*different, *stale) if os.path.lexists(target / path)]
        if replaced and not force:
            raise KeystoreError(
                f"'{target}' already has other versions of {', '.join(replaced)}",
                "Nothing was changed.",
                "Add --force to replace these files, or choose another folder.",
            )
        for path, data in different.items():
            transaction.write(path, data, private=file_mode(path) == 0o600)
        for path in stale:
            transaction.remove(path)
        transaction.commit()
    return transaction.changes


def _check_robot(keystore: OpenedKeystore, target: Path, files: Mapping[str, bytes]) -> None:
    """Raise `KeystoreError` if an exported enclave belongs to another robot than ``target``."""
    settings = target / AGENT / "agent.toml"
    if not settings.is_file() or not (fleet := load_fleet(keystore)):
        return
    owner = None
    with suppress(SrosError, ValueError):  # the agent itself refuses such settings
        owner = tomllib.loads(read_bytes(settings, "settings").decode()).get("robot")
    for name in sorted({enclave_of(path) for path in files}):
        robot = robot_of(fleet, name)
        if robot and owner and robot.name != owner:
            raise KeystoreError(
                f"'{target}' is the folder of robot {owner}, and {name} belongs to {robot.name}",
                f"'{settings}' names {owner}. Nothing was changed.",
                f"Choose the folder of {robot.name}.",
            )


def _stale_paths(target: Path, files: dict[str, bytes]) -> list[str]:
    """Return the paths of files in ``target`` that the exported enclaves no longer have.

    These are Zenoh files, keys, and revocation lists of other CAs, with which no process starts.
    (Losing a list of the enclave's own CA is refused by `check_rollback`.) If an enclave is
    exported without a key, its key in ``target`` stays, because there is no other copy.
    """
    folders = {path.rpartition("/")[0] for path in files}
    keyed = {folder for folder in folders for file in KEY_FILES if f"{folder}/{file}" in files}
    return sorted(
        path
        for folder in folders
        for path in (
            f"{folder}/{file}"
            for file in (CRL_FILE, *ZENOH_FILES, *(KEY_FILES if folder in keyed else ()))
        )
        if path not in files and os.path.lexists(target / path)
    )


def _write_archive(
    keystore: OpenedKeystore,
    target: Path,
    files: dict[str, bytes],
    *,
    now: datetime,
    force: bool,
    dry_run: bool,
) -> Sequence[Change]:
    refuse_link_of_stranger(target)
    data, before = pack(files), _state_of(target)
    if before:
        if not target.is_file():
            raise KeystoreError(
                f"'{target}' is in the way", "It is not a regular file.", "Choose another name."
            )
        if target.stat().st_size == len(data) and target.read_bytes() == data:
            return ()
        if not force:
            raise KeystoreError(
                f"'{target}' already exists, with other content",
                "Nothing was changed.",
                "Add --force to replace it, or choose another name.",
            )
        check_rollback(keystore, target, _unpack_archive(target), files, now)
    if not dry_run:
        with staged_file(target, data) as put_in_place:
            if _state_of(target) != before:
                raise KeystoreError(
                    f"another process has just written '{target}'",
                    "The archive may have newer files. Nothing was changed.",
                    "Run this command again.",
                )
            put_in_place()
    return (Change("replace" if before else "create", target.name),)


def _state_of(path: Path) -> tuple[int, ...] | None:
    """Return numbers that change if another process replaces or writes a file; None if missing."""
    with suppress(FileNotFoundError):
        state = path.stat()
        return state.st_ino, state.st_size, state.st_mtime_ns, state.st_ctime_ns
    return None


def _unpack_archive(target: Path) -> Mapping[str, bytes]:
    """Map the paths in an archive to the content of its files.

    Raises:
        KeystoreError: the archive cannot be read, so it may have a later CA or a newer revocation
            list.
    """
    try:
        return unpack(
            read_bytes(target, "archive", max_bytes=LIMITS_OF_ONE_ROBOT.packed), LIMITS_OF_ONE_ROBOT
        )
    except DocumentError as error:
        raise KeystoreError(
            f"'{target}' cannot be compared with the new archive",
            "It may have a later CA or a newer revocation list, and it cannot be read: "
            f"{str(error).rstrip('.')}. Nothing was changed.",
            "Choose another name, or first remove this archive.",
        ) from error


# ── as JSON ────────────────────────────────────────────────────────────────────────────────


class ExportedEnclaves(NamedTuple):
    """The enclaves that were exported."""

    keystore: NamedKeystore
    dry_run: DryRun
    target: Path
    """TARGET, as given on the command line."""
    enclaves: Sequence[
        EnclaveResult[
            Annotated[
                str,
                Words(("exported", "kept")),
                "`exported`, or `kept` if its files in TARGET were up to date.",
            ]
        ]
    ]
    """The exported enclaves."""
    left_out: Sequence[str]
    """Enclaves that ``--all`` or ``--match`` selects, but whose keys were made on their robots."""
    changes: FileChanges
    notes: Notes


def exported_outcomes(
    keystore: OpenedKeystore, names: Sequence[str], folder: Path, *, kept: Collection[str]
) -> list[EnclaveResult[str]]:
    """Return the outcomes of exported enclaves, whose files are below ``folder``.

    The files of the enclaves ``kept`` were up to date.
    """
    return [
        enclave_result(
            keystore,
            name,
            "kept" if name in kept else "exported",
            written=True,
            folder=folder / enclave_folder(name),
        )
        for name in names
    ]
