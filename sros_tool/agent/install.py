"""Installing a release in the security folder of a robot, verified first, and whole or not at all.

Two things are verified, which the publishing folder cannot fake: a permissions CA that the robot
already trusts sealed the release, and no file in the release is older than the robot's own. Then
each enclave is tried as DDS would load it, with the robot's key.  An enclave that cannot be used
keeps its files, and no other enclave waits for it.

Units and containers mount the folders of enclaves, so no folder is replaced, and a file that does
not change is not touched.
"""

from __future__ import annotations

import errno
import os
import stat
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path
from typing import NamedTuple

from cryptography import x509

from sros_tool.agent.fetch import OLD_COPY
from sros_tool.dds.permissions import parse_permissions
from sros_tool.errors import KeystoreError, SrosError
from sros_tool.folders import Folder
from sros_tool.keystore.confirmation import (
    KEY_NOT_HERE,
    OF_OTHER_CA,
    OLDER_THAN_INSTALLED,
    enclave_of,
)
from sros_tool.keystore.delivery.release import RELEASE_FILES, Release, seal_problem
from sros_tool.keystore.delivery.robot import evaluate_delivered_files
from sros_tool.keystore.delivery.rollback import ROLES_OF_FILES, older_list, retired_authorities
from sros_tool.keystore.layout import (
    CERTIFICATE_FILE,
    CRL_FILE,
    IDENTITY,
    IDENTITY_CA_FILE,
    KEY_FILE,
    KEY_FILES,
    KEY_URI_FILE,
    LIST_FILES,
    OPTIONAL_FILES,
    PERMISSIONS,
    PERMISSIONS_CA_FILE,
    PERMISSIONS_FILE,
    PRIVATE,
    PUBLIC,
    REQUEST,
    SEAL,
    ZENOH_FILES,
    ZENOH_SIGNED,
    enclave_folder,
    search_enclaves,
)
from sros_tool.keystore.reader import OpenedEnclave, open_enclave, weaknesses
from sros_tool.keystore.transaction import Transaction, recover_keystore
from sros_tool.pki import smime
from sros_tool.pki.certificates import (
    authority_text,
    common_name_of,
    digest,
    issued_by,
    load_certificates,
    load_request,
    make_request,
    subject_text,
    validity_of,
)
from sros_tool.pki.crl import last_update, newest_list, next_update, read_lists, signed_by
from sros_tool.pki.keys import PrivateKey, PublicKey, key_pem, load_enclave_key
from sros_tool.validity import iso
from sros_tool.wording import capitalized, enumerated

_OPTIONAL_RELEASE_FILES = (*OPTIONAL_FILES, *ZENOH_FILES)
_ENCLAVE_FILES = (*sorted(RELEASE_FILES), *KEY_FILES, REQUEST, SEAL)
"""The files that are removed together with their enclave."""
_DATED_FILES = (CERTIFICATE_FILE, PERMISSIONS_FILE, PERMISSIONS_CA_FILE, *LIST_FILES)
"""The files that must not become older: with `sros import` or a play, newer ones may arrive."""
_DISK_FULL = (errno.ENOSPC, errno.EDQUOT)
_MISSED_ROTATION = (
    "If this robot missed a stage of a CA rotation, bring its files: `sros distribute_key KEYSTORE "
    "--robot {} FOLDER --force`. If not, check whether the server has an old copy from before a "
    "rotation."
)
_OF_OTHER_CA_AND_OLDER = (
    "If the CAs were replaced, the server probably has an old copy from before that: publish there "
    "again."
)


class DiskFullError(OSError):
    """The disk is full; at most revocation lists were written, those of the enclaves ``lists``."""

    def __init__(self, error: OSError, lists: Sequence[str]) -> None:
        super().__init__(error.errno, error.strerror, error.filename)
        self.lists = tuple(lists)


class Installation(NamedTuple):
    """The outcome for the enclaves of a release; an enclave that did not change is in no field."""

    changed: tuple[str, ...] = ()
    """Enclaves of which a file changed."""
    removed: tuple[str, ...] = ()
    """Enclaves that were removed, because the release does not have them."""
    kept: Mapping[str, str] = {}
    """Enclave that kept its files (except perhaps the revocation list) → the reason, as a clause.
    """
    latest: datetime | None = None
    """The newest date of the certificates and revocation lists of the enclaves that did not keep
    their files.
    """
    made: datetime | None = None
    """The newest date of the certificates and revocation lists of the whole release."""
    lists: tuple[str, ...] = ()
    """Enclaves that got only the revocation list, because the disk is full."""
    written: frozenset[str] = frozenset()
    """Paths of the files that were written or removed in the enclaves of the release."""


@dataclass(slots=True)
class _Change:
    """The changes of an enclave's files: new contents by path, and paths to remove.

    ``seen`` has the files with which the new files were compared, by path, as `_content` has them.
    """

    write: dict[str, bytes] = field(default_factory=dict)
    remove: list[str] = field(default_factory=list)
    seen: dict[str, bytes | str | None] = field(default_factory=dict)

    def __bool__(self) -> bool:
        return bool(self.write or self.remove)


def install_release(
    folder: Path,
    release: Release,
    robot: str,
    *,
    now: datetime,
    installed: int = 0,
    pinned: frozenset[str] = frozenset(),
    new_keys: Mapping[str, PrivateKey] | None = None,
    keep: Collection[str] = (),
    before: Callable[[Sequence[str]], None] = lambda _names: None,
) -> Installation:
    """Install a release in the security folder ``folder``.

    Args:
        folder: the security folder of this robot.
        release: the release; so far, its files were only compared with its seal.
        robot: the name of this robot.
        now: the time of the clock, or a later time that verified documents prove to be over.
        installed: the highest number of a release that was accepted before.
        pinned: SHA-256 of permissions CAs that count as trusted, too.
        new_keys: keys that wait for their certificate, by enclave.
        keep: enclaves that stay although the release does not have them.
        before: called before the files change, with the enclaves whose processes will have to be
            restarted.

    Raises:
        KeystoreError: the release as a whole is not for this folder, or is older than the files
            here; nothing was changed.
        DiskFullError: the disk is full; the revocation lists were installed if there was room.
        OSError: nothing could be written.
    """
    recover_keystore(folder)
    _check_folder(folder)
    present = search_enclaves(folder)[0]
    _check_release(folder, present, release, robot, installed, pinned)
    enclaves = release.enclaves()
    with Folder(folder) as opened:
        seen = {name: _files_seen(opened, name) for name in {*enclaves, *present}}
        for name, files in enclaves.items():
            _check_lists(name, files, present_lists(opened, name))
        changes: dict[str, _Change] = {}
        kept: dict[str, str] = {}
        for name, files in sorted(enclaves.items()):
            try:
                changes[name] = _enclave_change(
                    opened, name, files, (new_keys or {}).get(name), now
                )
            except (SrosError, OSError) as error:
                kept[name] = _error_clause(error)
                changes[name] = _revocation_list_change(opened, name, files, now)
        removed = []
        for name in present:
            if name in enclaves or name in keep or waits_for_answer(opened, name):
                continue
            try:
                changes[name] = _enclave_removal(opened, name)
                removed.append(name)
            except (SrosError, OSError) as error:
                kept[name] = _error_clause(error)
        changes = {name: change for name, change in changes.items() if change}
        for name, change in changes.items():
            change.seen = seen[name]
        ran = [name for name in changes if name in enclaves and _has_certificate(opened, name)]
    if changes:
        before(ran)
        failed = _apply_changes(folder, changes)
        kept |= failed
        changes = {name: change for name, change in changes.items() if name not in failed}
    return Installation(
        tuple(name for name in changes if name in enclaves),
        tuple(name for name in removed if name in changes),
        kept,
        # A file that is not valid yet proves no time: the keystore's clock may have been ahead.
        _newest_validity_start(files for name, files in enclaves.items() if name not in kept),
        release_time(release),
        written=frozenset(
            path
            for name, change in changes.items()
            if name in enclaves
            for path in (*change.write, *change.remove)
        ),
    )


# ── the release as a whole ─────────────────────────────────────────────────────────────────


def _check_folder(folder: Path) -> None:
    if (folder / PRIVATE).exists() or (folder / PUBLIC).exists():
        raise KeystoreError(
            f"'{folder}' is a keystore with CAs",
            "A release belongs in the security folder of a robot.",
            "Name that folder.",
        )


def _check_release(
    folder: Path,
    present: Sequence[str],
    release: Release,
    robot: str,
    installed: int,
    pinned: frozenset[str],
) -> None:
    """Raise `KeystoreError` unless a release can replace the installed one.

    ``present`` are the enclaves in ``folder``, whose permissions CAs are trusted.
    A trusted permissions CA must have sealed it for this robot, its number must not be lower than
    ``installed``, and it must have an enclave of this robot.
    """
    if release.robot != robot:
        raise KeystoreError(
            f"the release is for robot {release.robot}, not for {robot}",
            "Nothing was changed.",
            "Check whether this robot has the right name (`sros agent init --robot`).",
        )
    trusted = [*_trusted_authorities(folder, present), *_pinned_authorities(release, pinned)]
    if not trusted:
        raise KeystoreError(
            f"'{folder}' trusts no permissions CA yet",
            "Nothing here shows whether the release comes from your keystore.",
            "Bring the first enclave with `sros import` or an Ansible play, or name the "
            "permissions CA with `sros agent init --ca`.",
        )
    is_older = release.number < installed
    # First the seal: the numbers of two keystores say nothing about each other.
    if problem := seal_problem(release, trusted):
        older = f"It is also older than release {installed}, {OLDER_THAN_INSTALLED}. "
        raise KeystoreError(
            f"release {release.number} {OF_OTHER_CA}",
            f"{capitalized(problem).rstrip('.')}. {older if is_older else ''}Nothing was changed.",
            (_OF_OTHER_CA_AND_OLDER if is_older else _MISSED_ROTATION.format(robot))
            + " Otherwise the release comes from another keystore, or was changed: check the place "
            "that `sros agent init --from` named, and find out who can write to the publishing "
            "folder.",
        )
    if is_older:
        raise KeystoreError(
            f"release {release.number} is older than release {installed}, {OLDER_THAN_INSTALLED}",
            "The server has older files than this robot received before. Nothing was changed.",
            OLD_COPY,
        )
    with Folder(folder) as opened:
        usable = [name for name in present if _has_certificate(opened, name)]
    if usable and not {*usable} & release.enclaves().keys():
        raise KeystoreError(
            f"the release of robot {robot} has none of the enclaves that this robot has",
            f"'{folder}' has {enumerated(usable)}, the release has "
            f"{enumerated(sorted(release.enclaves()))}. Installing the release would remove the "
            "keys that this robot has. Nothing was changed.",
            "Check whether this robot has the right name (`sros agent init --robot`).",
        )


def has_permissions_ca(folder: Path) -> bool:
    """Return whether an enclave in a security folder has a permissions CA."""
    return any(_trusted_authorities(folder, search_enclaves(folder)[0]))


def _trusted_authorities(folder: Path, present: Iterable[str]) -> Iterator[x509.Certificate]:
    """Yield the permissions CAs of the enclaves ``present``; unreadable files count as missing."""
    read_files = set()
    with Folder(folder) as opened:
        for name in present:
            with suppress(SrosError, OSError):
                data = opened.read_inside(f"{enclave_folder(name)}/{PERMISSIONS_CA_FILE}")
                if data not in read_files:
                    read_files.add(data)
                    yield from load_certificates(data, f"of {name}")


def _pinned_authorities(release: Release, pinned: frozenset[str]) -> Iterator[x509.Certificate]:
    """Yield the permissions CAs in a release whose SHA-256 is in ``pinned``."""
    for files in release.enclaves().values() if pinned else ():
        with suppress(SrosError):
            for authority in load_certificates(files[PERMISSIONS_CA_FILE], "of the release"):
                if digest(authority) in pinned:
                    yield authority


def _check_lists(name: str, files: Mapping[str, bytes], present: Mapping[str, bytes]) -> None:
    """Raise `KeystoreError` if a revocation list in the release is older than the list here.

    ``files`` are the files of an enclave in the release. ``present`` are the files of this enclave
    on the robot that may contain lists. Only lists signed by a CA in the release count, because the
    owner of the folder can write anything into the folder.
    """
    if older := older_list(present, files):
        here, new = older
        has = "none" if new.number < 0 else f"the number {new.number}"
        raise KeystoreError(
            f"the revocation list for {name} in the release is older than the list here",
            f"The current list has the number {here.number}, the release has {has}: revoked "
            "enclaves would be trusted again. Either the server has an old copy, or the "
            "keystore comes from a backup. Nothing was changed.",
            "Check the files on the server, and publish there again. Only if the keystore comes "
            "from a backup, run `sros fleet collect KEYSTORE INBOX` before you publish: it takes "
            "the list from the message of this robot. In a CA rotation, this robot's "
            f"{IDENTITY_CA_FILE} has revocation lists, too: also run `sros crl KEYSTORE --refresh "
            "--crl FILE` with this file.",
        )


def present_lists(folder: Folder, name: str) -> dict[str, bytes]:
    """Return the existing files of an enclave that may contain revocation lists."""
    present: dict[str, bytes] = {}
    for file in LIST_FILES:
        with suppress(SrosError, OSError):  # a process cannot load an unreadable file, either
            present[file] = folder.read_inside(f"{enclave_folder(name)}/{file}")
    return present


def release_time(release: Release) -> datetime | None:
    """Return when the newest document in a release began to be valid; None if none can be read."""
    return _newest_validity_start(release.enclaves().values())


def _newest_validity_start(enclaves: Iterable[Mapping[str, bytes]]) -> datetime | None:
    """Return when the newest document of enclaves began to be valid; None if none can be read.

    The documents are certificates, revocation lists, and the grants of the enclaves themselves,
    which the caller has verified.
    """
    moments = []
    for files in enclaves:
        with suppress(SrosError):
            certificates = load_certificates(files.get(CERTIFICATE_FILE, b""), CERTIFICATE_FILE)
            moments += [validity_of(certificate).not_before for certificate in certificates]
            document = smime.parse(files.get(PERMISSIONS_FILE, b"")).document
            subjects = [subject_text(certificate.subject) for certificate in certificates]
            grants = map(parse_permissions(document).grant_of, subjects)
            moments += [grant.validity.not_before for grant in grants if grant]
        with suppress(SrosError):
            lists = read_lists(files[CRL_FILE], CRL_FILE) if CRL_FILE in files else ()
            moments += [last_update(crl) for crl in lists]
    return max(moments, default=None)


# ── an enclave ─────────────────────────────────────────────────────────────────────────────


def _enclave_change(
    folder: Folder,
    name: str,
    files: Mapping[str, bytes],
    new_key: PrivateKey | None,
    now: datetime,
) -> _Change:
    """Return the changes of an enclave's files, after trying the new files with the key.

    Raises:
        SrosError: the new files cannot be used, or the current ones cannot be replaced.
        OSError: the current files cannot be read.
    """
    place = enclave_folder(name)
    _check_place(folder, place)
    certified = load_certificates(files.get(CERTIFICATE_FILE, b""), CERTIFICATE_FILE)[0]
    takes_new = new_key is not None and new_key.public_key() == certified.public_key()
    key = new_key.public_key() if new_key and takes_new else _present_key(folder, name, files)
    state, problems = evaluate_delivered_files(name, files, key, now=now)
    problems += [f"{file}: {text}" for file, text in weaknesses(state)]
    if problems:
        raise KeystoreError("its new files cannot be used", "; ".join(problems))
    _check_not_older(folder, place, state, now)
    change = _Change()
    for file, data in files.items():
        if _read_file(folder, f"{place}/{file}") != data:
            change.write[f"{place}/{file}"] = data
    if new_key and takes_new:
        change.write[f"{place}/{KEY_FILE}"] = key_pem(new_key)
        change.write[f"{place}/{REQUEST}"] = make_request(new_key, name)
    change.remove = [
        f"{place}/{file}"
        for file in _OPTIONAL_RELEASE_FILES
        if file not in files and folder.state(f"{place}/{file}")
    ]
    return change


def _check_not_older(folder: Folder, place: str, sent: OpenedEnclave, now: datetime) -> None:
    """Raise `KeystoreError` if an enclave has newer files, from `sros import` or an Ansible play.

    ``place`` is the enclave's folder, and ``sent`` the enclave in the release.
    Only files that a process could load count: the owner of the folder can write anything into it.
    """
    if folder.state(f"{place}/{CERTIFICATE_FILE}") is None:
        return
    present = open_enclave(folder.path / place, now=now)
    if present.problems or not (present.certificate and sent.certificate):
        return
    for role, file in ((IDENTITY, IDENTITY_CA_FILE), (PERMISSIONS, PERMISSIONS_CA_FILE)):
        trusted, brought = (
            load_certificates(state.files.get(file, b""), file) for state in (present, sent)
        )
        if retired := retired_authorities(trusted, brought):
            is_single = sent.files.get(IDENTITY_CA_FILE) == sent.files.get(PERMISSIONS_CA_FILE)
            flag = "" if is_single else f" --{role}"
            raise KeystoreError(
                f"the release goes back to the {role} CA {authority_text(retired[0])}, which a "
                "later CA replaced on this robot",
                "the keystore comes from a backup: replace the CA again in that keystore, with "
                "`sros "
                f"rotate_ca KEYSTORE{flag} --finish --allow-unconfirmed`, and publish",
            )
    same_authority = present.files.get(PERMISSIONS_CA_FILE) == sent.files.get(PERMISSIONS_CA_FILE)
    newer = [
        f"its {document} is valid from {iso(here)}, the {document} in the release from {iso(there)}"
        for document, here, there in (
            (
                "certificate",
                validity_of(present.certificate).not_before,
                validity_of(sent.certificate).not_before,
            ),
            ("grant", _grant_start(present), _grant_start(sent)),
        )
        if here and there and here > there
    ]
    if same_authority and newer:
        raise KeystoreError(
            "it has newer files than the release",
            f"{newer[0]}; if the keystore comes from a backup, first sign the present policy in "
            "that keystore (`sros generate_artifacts`), because otherwise the rights of the backup "
            "come back; then run `sros renew KEYSTORE --all`, and publish "
            "(docs/howto/keystore_is_lost.md)",
        )


def _grant_start(state: OpenedEnclave) -> datetime | None:
    with suppress(SrosError):
        return state.grant.validity.not_before if state.grant else None
    return None


def _present_key(folder: Folder, name: str, files: Mapping[str, bytes]) -> PublicKey:
    """Return the public key of an enclave, from its key file, its request or its certificate.

    A key on a token has no file: the enclave's signing request shows the public key, or, without a
    request, the enclave's current certificate.

    Raises:
        SrosError: the key is not on this robot, or cannot be read.
        OSError: a file cannot be read.
    """
    place = enclave_folder(name)
    if (data := _read_file(folder, f"{place}/{KEY_FILE}")) is not None:
        return load_enclave_key(data, f"of enclave {name}").public_key()
    if KEY_URI_FILE in files or folder.state(f"{place}/{KEY_URI_FILE}"):
        if (data := _read_file(folder, f"{place}/{REQUEST}")) is not None:
            return load_request(data, f"of enclave {name}").public_key
        pem = _read_file(folder, f"{place}/{CERTIFICATE_FILE}") or files.get(CERTIFICATE_FILE, b"")
        return load_certificates(pem, CERTIFICATE_FILE)[0].public_key()  # type: ignore[return-value]
    raise KeystoreError(
        f"the key of enclave {name} {KEY_NOT_HERE}",
        "",
        "Bring the key once, with `sros distribute_key` or an Ansible play, or make one here "
        "with `sros create_request`.",
    )


def _files_seen(folder: Folder, name: str) -> dict[str, bytes | str | None]:
    """Return the files that show how new an enclave is, by path, as `_content` has them."""
    paths = [f"{enclave_folder(name)}/{file}" for file in _DATED_FILES]
    return {path: _content(folder, path) for path in paths}


def _content(folder: Folder, path: str) -> bytes | str | None:
    """Return the content of a file; None if it is missing.

    Of a file that cannot be read, return text with the reason, and with the inode and time.
    """
    try:
        return _read_file(folder, path)
    except (SrosError, OSError) as error:
        with suppress(SrosError, OSError):
            if state := folder.state(path):
                return f"{error} {state.st_ino} {state.st_mtime_ns}"
        return str(error)


def _check_place(folder: Folder, place: str) -> None:
    """Raise `KeystoreError` if the enclave folder ``place`` exists and cannot be changed."""
    parts = place.split("/")
    for length in range(1, len(parts) + 1):
        path = "/".join(parts[:length])
        if not folder.is_folder(path):
            return
        if not os.access(folder.path / path, os.W_OK | os.X_OK):
            raise KeystoreError(f"'{folder.path / path}' cannot be changed by this user")
    for file in _ENCLAVE_FILES:
        mode = folder.mode(f"{place}/{file}")
        if mode and not (stat.S_ISREG(mode) or stat.S_ISLNK(mode)):
            raise KeystoreError(f"'{folder.path / place / file}' is not a file")


def _read_file(folder: Folder, path: str) -> bytes | None:
    """Return the content of a file; None if it does not exist, or is a link that leads nowhere.

    Raises:
        KeystoreError: a link leads out of the security folder.
        OSError: the file cannot be read.
    """
    if folder.state(path) is None:
        return None
    try:
        return folder.read_inside(path)
    except FileNotFoundError:
        return None


def _revocation_list_change(
    folder: Folder, name: str, files: Mapping[str, bytes], now: datetime
) -> _Change:
    """Return the change that gives an enclave only its new revocation list, if the list fits.

    Otherwise, the change is empty.

    The enclave must trust the same identity CAs as before, and have a certificate. One of these CAs
    must have signed the list, and the list must be valid.
    """
    place, change = enclave_folder(name), _Change()
    with suppress(SrosError, OSError):
        _check_place(folder, place)
        authorities = files.get(IDENTITY_CA_FILE, b"")
        same_cas = _read_file(folder, f"{place}/{IDENTITY_CA_FILE}") == authorities
        path, sent = f"{place}/{CRL_FILE}", files.get(CRL_FILE, b"")
        newest = newest_list(sent, authorities)
        expiry = next_update(newest) if newest is not None else None
        fits = same_cas and _has_certificate(folder, name) and _read_file(folder, path) != sent
        valid = (
            newest is not None and last_update(newest) <= now and (expiry is None or now < expiry)
        )
        if fits and valid:
            change.write[path] = sent
    return change


def _enclave_removal(folder: Folder, name: str) -> _Change:
    """Return the removal of an enclave's files.

    Raises:
        SrosError: the files cannot be removed.
    """
    place = enclave_folder(name)
    _check_place(folder, place)
    paths = (f"{place}/{file}" for file in _ENCLAVE_FILES)
    return _Change(remove=[path for path in paths if folder.state(path)])


def waits_for_answer(folder: Folder, name: str) -> bool:
    """Return whether an enclave waits for the first answer to its signing request."""
    with suppress(SrosError, OSError):
        place = enclave_folder(name)
        return bool(folder.state(f"{place}/{REQUEST}")) and not _has_certificate(folder, name)
    return False


def _has_certificate(folder: Folder, name: str) -> bool:
    """Return whether an enclave has a certificate; without one, no process can run in it."""
    with suppress(SrosError, OSError):
        return folder.state(f"{enclave_folder(name)}/{CERTIFICATE_FILE}") is not None
    return False


# ── files that came before the release ──────────────────────────────────────────────────────


def files_made_after(
    latest: datetime, folder: Path, release: Release, paths: Iterable[str]
) -> frozenset[str]:
    """Return the ``paths`` in a security folder whose files the keystore made after ``latest``.

    Somebody may have brought them after the installed release, whose newest document is of
    ``latest``, and before ``release``.  Only what the CAs in ``release`` signed counts, because a
    stranger has no key of a CA, and no earlier document, which somebody put back.  Certificates,
    permissions and revocation lists have dates; other files count next to a new certificate.
    """
    enclaves, made = release.enclaves(), set()
    with Folder(folder) as opened:
        for path in paths:
            name, file = enclave_of(path), path.rpartition("/")[2]
            with suppress(SrosError, OSError):  # a damaged file does not count
                if name in enclaves and _is_made_after(latest, opened, name, file, enclaves[name]):
                    made.add(path)
    return frozenset(made)


def _is_made_after(
    latest: datetime, folder: Folder, name: str, file: str, sent: Mapping[str, bytes]
) -> bool:
    """Return whether a file of an enclave, which ``sent`` replaces, was made after ``latest``.

    Raises:
        SrosError, OSError: a file cannot be read.
    """

    def present(file: str) -> bytes:
        return _read_file(folder, f"{enclave_folder(name)}/{file}") or b""

    def authorities(file: str) -> Sequence[x509.Certificate]:
        return load_certificates(sent.get(file, b""), file)

    if file in ROLES_OF_FILES and {*load_certificates(present(file), file)} != {*authorities(file)}:
        return False
    if file in LIST_FILES:
        lists, new_lists = read_lists(present(file), file), read_lists(sent.get(file, b""), file)
        signers, new_signers = (
            [[ca for ca in authorities(IDENTITY_CA_FILE) if signed_by(crl, ca)] for crl in each]
            for each in (lists, new_lists)
        )
        is_signed = signers == new_signers and all(signers)
        return is_signed and all(last_update(crl) > latest for crl in lists)
    certificate = load_certificates(present(CERTIFICATE_FILE), CERTIFICATE_FILE)[0]
    is_issued = any(issued_by(certificate, ca) for ca in authorities(IDENTITY_CA_FILE))
    if common_name_of(certificate.subject) != name or not is_issued:
        return False
    if (signed_file := ZENOH_SIGNED.get(file, file)).endswith(".p7s"):
        signed = smime.parse(present(signed_file))
        is_signed_text = file == signed_file or present(file) == signed.text
        if not is_signed_text or signed.problem_for(authorities(PERMISSIONS_CA_FILE)):
            return False
        if file == PERMISSIONS_FILE:
            subject = subject_text(certificate.subject)
            grant = parse_permissions(signed.document).grant_of(subject)
            return grant is not None and grant.validity.not_before > latest
    is_of_key = certificate.public_key() == _present_key(folder, name, sent)
    return is_of_key and validity_of(certificate).not_before > latest


# ── writing ────────────────────────────────────────────────────────────────────────────────


def _apply_changes(folder: Path, changes: Mapping[str, _Change]) -> dict[str, str]:
    """Make all changes together; if that fails, change each enclave by itself, whole or not at all.

    Return the enclaves that could not be changed, and why.

    Raises:
        DiskFullError: the disk is full; at most revocation lists were written.
    """
    try:
        _write_changes(folder, changes.values())
        return {}
    except (SrosError, OSError) as error:
        if isinstance(error, OSError) and error.errno in _DISK_FULL:
            raise DiskFullError(error, _commit_lists(folder, changes)) from error
        first = error
    if len(changes) == 1:
        return {name: _error_clause(first) for name in changes}
    failed = {}
    for name, change in changes.items():
        try:
            _write_changes(folder, [change])
        except (SrosError, OSError) as error:
            failed[name] = _error_clause(error)
    return failed


def _write_changes(folder: Path, changes: Iterable[_Change]) -> None:
    with Transaction(folder, partial=True) as transaction, Folder(folder) as opened:
        for change in changes:
            _refuse_changed_files(opened, change)
            for path, data in change.write.items():
                transaction.write(path, data, private=path.endswith(f"/{KEY_FILE}"))
            for path in change.remove:
                transaction.remove(path)
        transaction.commit()


def _refuse_changed_files(folder: Folder, change: _Change) -> None:
    """Raise `KeystoreError` if files changed after the new ones were compared with them."""
    for path, before in change.seen.items():
        if _content(folder, path) != before:
            raise KeystoreError(
                "its files changed meanwhile",
                f"Another program changed or removed '{folder.path / path}'; the next round "
                "compares again",
            )


def _commit_lists(folder: Path, changes: Mapping[str, _Change]) -> Sequence[str]:
    """Write the new revocation lists of enclaves whose identity CAs stay, if the disk has room.

    Return the enclaves whose lists were written.
    """
    lists = {}
    for name, change in changes.items():
        crls = {path: data for path, data in change.write.items() if path.endswith(f"/{CRL_FILE}")}
        if crls and not any(path.endswith(f"/{IDENTITY_CA_FILE}") for path in change.write):
            lists[name] = _Change(write=crls, seen=change.seen)
    with suppress(SrosError, OSError):
        if lists:
            _write_changes(folder, lists.values())
            return sorted(lists)
    return ()


def _error_clause(error: SrosError | OSError) -> str:
    """Return an error as a clause."""
    if isinstance(error, SrosError):
        return f"{error.what}: {error.clause}" if error.why else error.what
    where = f" ('{os.fsdecode(error.filename)}')" if error.filename else ""
    return f"{error.strerror or error}{where}"
