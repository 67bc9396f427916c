"""The layout of a keystore, as ROS 2 and ros2/sros2 expect it, and the list of its enclaves.

Paths are relative to the keystore, with "/" between their parts.
"""

from __future__ import annotations

import errno
import os
import re
from collections.abc import Container, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from itertools import chain, islice
from pathlib import Path
from shlex import quote
from typing import NamedTuple, TypeAlias

from sros_tool.errors import DocumentError, KeystoreError, SrosError
from sros_tool.faults import ORIGINAL_KEYSTORE, remedy_in_original_keystore
from sros_tool.values import parse_json
from sros_tool.xml import read_bytes

ENCLAVES, PUBLIC, PRIVATE = "enclaves", "public", "private"
CLOSED_PROCESSES, CLOSED_POLICY = "processes.json", "policy.xml"
CLOSED_OBSERVATION = "observed.json"
"""With `CLOSED_PROCESSES` and `CLOSED_POLICY`, the files of `sros close` next to its keystore."""
CLOSED_KEYSTORE = "keystore"
"""The keystore in a folder of `sros close`, until it is brought to another machine."""
CLOSED_OBSERVER = "/sros_observer"
"""The enclave with which `sros close` observes a closed robot; no policy of the robot has it."""
SETTINGS = "sros.toml"
"""The settings of the keystore; keystores of ros2/sros2 do not have this file."""
FLEET = "fleet.toml"
"""The robots whose enclaves the keystore has; the file exists only in a keystore with a fleet."""
CONFIRMED = "confirmed"
"""The folder with the last confirmation of each robot of the fleet."""
REFUSED = f"{CONFIRMED}/.refused.json"
"""The file with the reasons why the last messages of robots were refused."""
FLEET_ROOT = "fleet_root.json"
"""The file with all versions of the root metadata (TUF) that were published for the fleet."""
PUBLISHED = "published.json"
"""The file with what was last published for each robot of the fleet, and the metadata versions."""
LEDGER = "ledger.jsonl"
"""The log of issued certificates and documents; keystores of ros2/sros2 do not have it.

For a long ledger, it is a link to the last part, whose name matches `SEALED_LEDGER`.
"""
SEALED_LEDGER = re.compile(r"ledger\.[0-9]{4,9}\.jsonl")
"""Matches the names of the parts of a long ledger; all parts but the last are sealed."""
LEDGER_HEAD = "ledger.p7s"
"""The file with the ledger's number of lines and the digest of the last one, signed by a CA."""
LEDGER_INDEX = ".sros-index"
"""The index of a long ledger; sros makes the index again if it is missing or does not fit."""

IDENTITY, PERMISSIONS = "identity", "permissions"
ROLES = (IDENTITY, PERMISSIONS)

CRL = f"{PUBLIC}/identity_ca.crl.pem"
"""The revocation list of the identity CA; it exists after the first revocation."""
REVOKED = "revoked"
"""The folder for the files of revoked enclaves."""

ROTATION = "rotation.json"
"""The file that names the replaced CAs, which exists only during a rotation."""
RETIRED = "retired"
"""The folder for certificates and keys of replaced CAs."""
STAGE = ".sros-transaction"
"""The folder of a transaction that is in progress, or was interrupted."""
AGENT = ".agent"
"""The folder of `sros agent` in the security folder of a robot."""
LOCK = ".sros-lock"
"""The file that a writing process locks, which exists only while this process writes."""

GOVERNANCE_XML = f"{ENCLAVES}/governance.xml"
GOVERNANCE_P7S = f"{ENCLAVES}/governance.p7s"

IDENTITY_CA_FILE, PERMISSIONS_CA_FILE = "identity_ca.cert.pem", "permissions_ca.cert.pem"
CERTIFICATE_FILE, KEY_FILE = "cert.pem", "key.pem"
GOVERNANCE_FILE, PERMISSIONS_FILE = "governance.p7s", "permissions.p7s"
REQUIRED_FILES = (
    IDENTITY_CA_FILE,
    PERMISSIONS_CA_FILE,
    CERTIFICATE_FILE,
    KEY_FILE,
    GOVERNANCE_FILE,
    PERMISSIONS_FILE,
)
"""The files that rcl and the RMWs read from an enclave; if one is missing, no node starts."""
KEY_URI_FILE = "key.p11"
"""The file with the PKCS#11 URI of a key on a token (REP 2015), in place of ``key.pem``.

Source: rmw_dds_common of ROS 2 Jazzy and later (security.cpp); only rmw_fastrtps uses it.
"""
KEY_FILES = (KEY_FILE, KEY_URI_FILE)

CRL_FILE = "crl.pem"
OPTIONAL_FILES = (CRL_FILE,)
LIST_FILES = (CRL_FILE, IDENTITY_CA_FILE)
"""The files with revocation lists; in a rotation, the CA file has the list of the second CA."""

SESSION_FILE, ROUTER_FILE = "session.json5", "router.json5"
"""The Zenoh configurations: for an enclave's processes, and for the router of a router's enclave.
"""
ZENOH_SIGNED = {SESSION_FILE: "session.p7s", ROUTER_FILE: "router.p7s"}
"""Maps a Zenoh configuration to its copy signed by the permissions CA, which only sros verifies."""
ZENOH_FILES = (*ZENOH_SIGNED, *ZENOH_SIGNED.values())

REQUEST = "request.pem"
"""The signing request of an enclave whose key was made on its robot, where the key stays."""
SEAL = "answer.p7s"
"""The file with the digests of all files of an answer, signed by the permissions CA.

Without it, anyone who transports an answer could exchange the governance or a CA in it.  On the
robot, it stays next to the files, and its number shows which answer they came from.
"""

RELEASE_SEAL = "release.p7s"
"""The file with a robot's name and the digests of its release's files.

The permissions CA signs it.
"""


def confirmation_file(robot: str) -> str:
    """Return the path of a robot's last confirmation, relative to the keystore."""
    return f"{CONFIRMED}/{robot}.json"


def ledger_part(number: int) -> str:
    """Return the name of a part of a long ledger; the first part has the number 1."""
    return f"ledger.{number:04}.jsonl"


def ca_certificate_path(role: str) -> str:
    """Return the path of the certificate of the identity or permissions CA."""
    return f"{PUBLIC}/{role}_ca.cert.pem"


SHARED_FILES = {
    GOVERNANCE_FILE: GOVERNANCE_P7S,
    IDENTITY_CA_FILE: ca_certificate_path(IDENTITY),
    PERMISSIONS_CA_FILE: ca_certificate_path(PERMISSIONS),
}
"""Maps files of an enclave to the files of the keystore to which they are normally links."""


def ca_key_path(role: str) -> str:
    """Return the path of the private key of the identity or permissions CA."""
    return f"{PRIVATE}/{role}_ca.key.pem"


def permissions_ca_for(document: Path) -> Path | None:
    """Return the permissions CA certificate next to a signed document, or None."""
    folder = document.absolute().parent
    places = (folder / PERMISSIONS_CA_FILE, folder.parent / PUBLIC / PERMISSIONS_CA_FILE)
    return next((path for path in places if path.exists()), None)


def enclave_folder(name: str) -> str:
    """Return the folder of an enclave, relative to the keystore; for ``/`` it is ``enclaves``."""
    return ENCLAVES + name.rstrip("/")


def link_to_list(name: str) -> str:
    """Return the target of the link ``crl.pem`` in the folder of an enclave."""
    return "../" * (enclave_folder(name).count("/") + 1) + CRL


def enclave_path(root: Path, name: str) -> Path:
    """Return the folder of an enclave of the keystore ``root``."""
    return root / enclave_folder(name)


def is_own_copy(root: Path, name: str, file: str) -> bool:
    """Return whether an enclave has its own copy of a file instead of a link to the keystore's."""
    copy, common = enclave_path(root, name) / file, root / SHARED_FILES.get(file, "")
    return file in SHARED_FILES and (
        copy.is_file() and common.is_file() and not copy.samefile(common)
    )


def fleet_key_path(role: str) -> str:
    """Return the path of the private key of a metadata role, such as ``snapshot``."""
    return f"{PRIVATE}/fleet_{role}.pem"


def key_path(root: Path, place: str) -> Path:
    """Return the path of a CA key's file; ``place`` is ``file:PATH``, or a path below ``root``."""
    return root / place.removeprefix("file:").removeprefix("//")


def folder_mode(path: str) -> int:
    """Return the permission bits of a keystore's folder: 0700 if it may contain keys, else 0755."""
    return 0o755 if path in ("", PUBLIC) else 0o700


_EARLIER_CA = ("ca.cert.pem", "ca.key.pem")
"""The CA in the top folder of a flat keystore (ros2/sros2 0.6 to 0.8).

These versions belong to ROS 2 Crystal to Eloquent.
"""

_TOP_FILES = frozenset((SETTINGS, FLEET, FLEET_ROOT, PUBLISHED, LEDGER, LEDGER_HEAD, ROTATION))
_IDENTITY_FILES = (CERTIFICATE_FILE, KEY_FILE)
_ENCLAVE_MARKS = (CERTIFICATE_FILE, *KEY_FILES)
_FILE_TYPES = (".pem", ".p7s", ".p11", ".xml", ".json5")
_TOP_FOLDERS = frozenset((ENCLAVES, PUBLIC, PRIVATE, REVOKED, RETIRED))


def is_layout_path(path: str) -> bool:
    """Return whether sros may write a file at ``path``, which is relative to a keystore."""
    top, *rest = path.split("/")
    if not rest:
        return top in _TOP_FILES or SEALED_LEDGER.fullmatch(top) is not None
    return (
        top in _TOP_FOLDERS
        and all(part and not part.startswith(".") and part.isprintable() for part in rest)
        and rest[-1].endswith(_FILE_TYPES)
    )


def is_keystore(root: Path) -> bool:
    """Return whether ``root`` is a keystore with its CAs, or an export of one without CAs.

    Raises:
        KeystoreError: this user must not read the folders of ``root``.
    """
    folder = root / ENCLAVES
    try:
        return folder.is_dir() and (
            (root / GOVERNANCE_P7S).is_file()
            or (root / ca_certificate_path(IDENTITY)).is_file()
            or any(search_enclaves(root))
        )
    except PermissionError as error:
        raise _unreadable_folder_error(
            root, [UnreadPath.from_error(error)], "Its enclaves cannot be listed."
        ) from error


def is_original_keystore(root: Path) -> bool:
    """Return whether a folder is an original keystore, not an export or an enclave's folder."""
    if (root / LEDGER).is_file():
        return True
    try:
        return any((root / PRIVATE).iterdir())
    except (FileNotFoundError, NotADirectoryError):
        return False
    except OSError:  # a folder of another user
        return True


def remedy_in_keystore(root: Path, remedy: str) -> str:
    """Return a remedy with its commands for KEYSTORE adapted to ``root``, a keystore or an export.

    An export has no CA keys, so its remedy says to run the commands in the original keystore.
    """
    if is_original_keystore(root):
        return re.sub(r"\bKEYSTORE\b", lambda _: quote(str(root)), remedy)
    return remedy_in_closed_robot(root, remedy_in_original_keystore(remedy))


EARLIER_FILES = "running processes keep the earlier files"
"""Begins the advice on what to do after permissions were signed."""
_EXPORT_AGAIN = re.compile(
    r"\b([Ee])xport (?:(?:(?:the|their|its|these) enclaves?|them) )?again"
    rf"(?:(?: from the {ORIGINAL_KEYSTORE}:)? \(?`sros distribute_key [^`]+`\)?)?"
)
"""The words of remedies that say to export enclaves again."""
_SIGN_POLICY = re.compile(r"un `sros generate_artifacts -k [^`]+ -p POLICY_FILE`")
"""The words of remedies that say to sign a whole policy."""


def remedy_in_closed_robot(root: Path, remedy: str) -> str:
    """Return a remedy, adapted to the closed robot's folder if ``root`` is in one.

    In such a folder, `sros close` signs and exports. The remedy is returned unchanged if the folder
    has no CA keys (the keystore was moved to another machine), or no `observed.json` (the folder is
    the copy on that other machine).
    """
    robot = folder_of_closed_robot(root)
    is_here = robot and (robot / CLOSED_OBSERVATION).is_file()
    if not (robot and is_here and is_original_keystore(robot / CLOSED_KEYSTORE)):
        return remedy
    close, keystore = f"un `sros close {quote(str(robot))}`", quote(str(robot / CLOSED_KEYSTORE))
    remedy = _EXPORT_AGAIN.sub(lambda found: ("R" if found[1] == "E" else "r") + close, remedy)
    if _SIGN_POLICY.search(remedy):
        remedy = _SIGN_POLICY.sub(lambda _: close, remedy).replace(f" Then r{close}.", "")
    for where in (f"In the {ORIGINAL_KEYSTORE}: ", f" KEYSTORE is the {ORIGINAL_KEYSTORE}."):
        remedy = remedy.replace(where, "")
    return re.sub(r"\bKEYSTORE\b", lambda _: keystore, remedy)


def folder_of_closed_robot(root: Path) -> Path | None:
    """Return the folder of `sros close` to which this keystore or export belongs, or None."""
    folder = root / ".." if root.name in ("", "..") else root.parent  # such as "."
    made = all((folder / file).is_file() for file in (CLOSED_PROCESSES, CLOSED_POLICY))
    return folder if made else None


class RobotEnclaves(NamedTuple):
    """The enclaves of a robot that `sros close` closes."""

    here: frozenset[str] = frozenset()
    """The enclaves of the processes on this machine, also of those that do not always run."""
    elsewhere: frozenset[str] = frozenset()
    """The enclaves of other machines, such as laptops."""
    commands: Mapping[str, Sequence[str]] = {}
    """The commands of the processes on this machine, by enclave."""
    units: Mapping[str, str] = {}
    """The systemd units that start the processes; "" if you start the process by hand."""
    users: frozenset[int] = frozenset()
    """The ids of the users who ran the processes when sros watched."""


def enclaves_of_closed_robot(root: Path) -> RobotEnclaves:
    """Return the enclaves that `sros close` remembers next to a keystore or export.

    There are none if the folder is not of `sros close`, or if the list of processes is broken.
    """
    robot = folder_of_closed_robot(root.absolute())
    try:
        file = robot and read_bytes(robot / CLOSED_PROCESSES, "list of processes")
        if not file:
            return RobotEnclaves()
        listed = parse_json(file)
        commands = {
            str(process["enclave"]): [*map(str, process.get("command", ()))]
            for process in listed["processes"]
        }
        units = {
            str(process["enclave"]): str(process.get("unit", "")) for process in listed["processes"]
        }
        users = frozenset(
            int(process["user"]) for process in listed["processes"] if "user" in process
        )
        here = commands.keys() | {*map(str, listed.get("ended", ()))}
        elsewhere = frozenset(map(str, listed["not_here"]))
    except (SrosError, ValueError, TypeError, KeyError, AttributeError, OverflowError):
        return RobotEnclaves()
    own = frozenset({CLOSED_OBSERVER, *here}) - elsewhere
    return RobotEnclaves(own, elsewhere, commands, units, users)


def how_to_learn_one_process(robot: Path, domain: int = 0) -> str:
    """Return clauses on how to learn the rights of one process while all others stay closed.

    ``robot`` is a folder of `sros close`, and ``domain`` the ROS domain. The rights of a process
    can be learned only while it runs open.
    """
    option = f" --domain {domain}" * bool(domain)
    return (
        f"let the process run open next to the closed robot, and run `sros generate_policy "
        f"{quote(str(robot / CLOSED_POLICY))} --enclave-per-node{option}`; read the added "
        f"rights, run `sros close {quote(str(robot))}`, and restart the process as `sros close` "
        "says"
    )


def how_to_add_domains(root: Path, domains: str) -> str:
    """Return advice on how to add a domain to a keystore or an export's keystore, as a clause.

    ``domains`` are all domains that the keystore should then have, such as "0,5".
    """
    robot = folder_of_closed_robot(root)
    candidates = (root, robot / CLOSED_KEYSTORE) if robot else (root,)
    keystore = next(filter(is_original_keystore, candidates), None)
    command = f"sros update_keystore {quote(str(keystore or 'KEYSTORE'))} --domain {domains}"
    if keystore == root:
        return f"add the domain with `{command} --allow-looser`"
    where = "to its keystore" if keystore else "on the machine of its keystore"
    text = f"add the domain {where}, with `{command} --allow-looser`, and export again"
    return remedy_in_closed_robot(root, text)


def is_enclave(folder: Path) -> bool:
    """Return whether ``folder`` has a certificate or a key of an enclave."""
    return any(os.path.lexists(f"{folder}/{file}") for file in _ENCLAVE_MARKS)


def key_on_robot(folder: Path) -> bool:
    """Return whether the key of an enclave was made on its robot and stays there."""
    return (folder / REQUEST).exists() and not has_key(folder)


def has_key(folder: Path) -> bool:
    """Return whether an enclave's folder has the enclave's key, or names a key on a token."""
    return any((folder / file).exists() for file in KEY_FILES)


def waits_for_answer(folder: Path) -> bool:
    """Return whether the signing request of an enclave is not answered yet."""
    return (folder / REQUEST).exists() and not (folder / CERTIFICATE_FILE).exists()


_FOLDER_ELSEWHERE = "It is a symbolic link to a folder elsewhere, which sros does not follow"


class UnreadPath(NamedTuple):
    """A file or folder of a keystore that sros cannot or will not read; ``why`` is a clause."""

    path: str
    why: str

    @classmethod
    def from_error(cls, error: OSError) -> UnreadPath:
        """Return the path that the operating system did not let sros read, with the reason."""
        return cls(os.fsdecode(error.filename), error.strerror or str(error))

    def remedy(self, root: Path) -> str:
        """Return the remedy, as a sentence; ``root`` is the keystore."""
        if self.why == _FOLDER_ELSEWHERE:
            return "Replace the link with a real folder."
        return (
            "Run sros as the owner of the file. If you may only look, ask the owner for a copy "
            "without private keys (docs/keystores.md). If files belong to several users, give all "
            f"files to one user: `sudo chown -R USER {quote(str(root))}`."
        )


def search_enclaves(
    root: Path, *, hidden: bool = False
) -> tuple[tuple[str, ...], tuple[UnreadPath, ...]]:
    """Return the sorted names of the enclaves, and the folders that could not be searched.

    An enclave is a folder with a certificate or a key.  Links to folders are not followed.  With
    ``hidden``, folders whose names begin with a dot are searched, too: sros never writes enclaves
    there, but DDS loads them.
    """
    top = os.fspath(root / ENCLAVES)
    return _search(top, top, hidden=hidden)


def _search(
    top: str, start: str, *, hidden: bool = False
) -> tuple[tuple[str, ...], tuple[UnreadPath, ...]]:
    """Return the result of `search_enclaves` for the folder ``start`` below ``top``."""
    unread: list[UnreadPath] = []
    names = _names_in(top, _walk_folders(start, unread, hidden=hidden))
    return names, tuple(unread)


_WalkedFolder: TypeAlias = tuple[str, list[str]]
"""A folder, and the names of the files in it."""


def _names_in(top: str, folders: Iterable[_WalkedFolder]) -> tuple[str, ...]:
    """Return the sorted names of the enclaves among folders below ``top``, their common folder."""
    return tuple(
        sorted(
            folder[len(top) :].replace(os.sep, "/") or "/"
            for folder, files in folders
            if any(file in files for file in _ENCLAVE_MARKS)
        )
    )


def _walk_folders(
    top: str, unread: list[UnreadPath], *, hidden: bool = False
) -> Iterator[_WalkedFolder]:
    """Yield each folder below ``top``, with its files; add unreadable folders to ``unread``.

    With ``hidden``, folders whose names begin with a dot are included.
    """
    pending = [top]
    while pending:
        folder = pending.pop()
        files = []
        try:
            with os.scandir(folder) as listing:
                entries = list(listing)
        except OSError as error:
            if error.errno not in (errno.ENOENT, errno.ENOTDIR):
                unread.append(UnreadPath.from_error(error))
            continue
        for entry in entries:
            name = entry.name
            if entry.is_symlink():
                # A link named like a file is not an enclave: what is wrong with it concerns the
                # folder around it.
                of_file = name.endswith(_FILE_TYPES)
                if (of_file and name not in _IDENTITY_FILES) or not _is_folder(entry):
                    files.append(name)
                elif not of_file and (hidden or name[0] != ".") and not _is_inside(entry.path, top):
                    unread.append(UnreadPath(entry.path, _FOLDER_ELSEWHERE))
            elif not entry.is_dir(follow_symlinks=False):
                files.append(name)
            elif hidden or name[0] != ".":
                pending.append(entry.path)
        yield folder, files


def _is_folder(entry: os.DirEntry[str]) -> bool:
    with suppress(OSError):
        return entry.is_dir()
    return False


def _is_inside(path: str, top: str) -> bool:
    return Path(os.path.realpath(path)).is_relative_to(os.path.realpath(top))


def enclave_names(root: Path, *, hidden: bool = False) -> tuple[str, ...]:
    """Return the sorted names of the enclaves, which are the folders with a certificate or a key.

    ``hidden`` is as in `search_enclaves`.

    Raises:
        KeystoreError: an enclave may be missing, because a folder cannot be read.
    """
    names, unread = search_enclaves(root, hidden=hidden)
    if unread:
        raise _unreadable_folder_error(root, unread, "Enclaves would be missing from the result.")
    return names


def enclaves_below(root: Path, name: str) -> tuple[str, ...]:
    """Return the sorted names of the enclaves below the enclave ``name``.

    Raises:
        KeystoreError: an enclave may be missing, because a folder cannot be read.
    """
    top, start = os.fspath(root / ENCLAVES), os.fspath(enclave_path(root, name))
    names, unread = _search(top, start)
    if unread:
        raise _unreadable_folder_error(root, unread, "Enclaves would be missing from the result.")
    return tuple(enclave for enclave in names if enclave != name)


def has_zenoh_files(root: Path, *, hidden: bool = False) -> bool:
    """Return whether any enclave that this user can read has a Zenoh configuration.

    ``hidden`` is as in `search_enclaves`.
    """
    return any(
        is_enclave(Path(folder)) and Path(folder, file).is_file()
        for folder, files in _walk_folders(os.fspath(root / ENCLAVES), [], hidden=hidden)
        for file in ZENOH_SIGNED.keys() & files
    )


def readable_enclaves(root: Path) -> tuple[str, ...]:
    """Return the sorted names of the enclaves after checking that all their files can be read.

    Verbs that write call this function first.

    Raises:
        KeystoreError: this user cannot read some file of an enclave, so that the enclave would keep
            old files, such as a replaced CA.
    """
    top = os.fspath(root / ENCLAVES)
    unread: list[UnreadPath] = []
    names = _names_in(top, _noting_unreadable(_walk_folders(top, unread), unread))
    _refuse_unreadable(root, unread)
    return names


def check_readable(root: Path, names: Sequence[str]) -> None:
    """Raise `KeystoreError` if this user cannot read every file of the enclaves ``names``."""
    unread: list[UnreadPath] = []
    walks = (_walk_folders(os.fspath(enclave_path(root, name)), unread) for name in names)
    # A walk begins with the folder of the enclave itself.
    folders = chain.from_iterable(islice(walk, 1) for walk in walks)
    for _ in _noting_unreadable(folders, unread):
        pass
    _refuse_unreadable(root, unread)


def _noting_unreadable(
    folders: Iterable[_WalkedFolder], unread: list[UnreadPath]
) -> Iterator[_WalkedFolder]:
    """Yield ``folders``, and add the files in them that cannot be read to ``unread``."""
    for folder, files in folders:
        for name in files:
            path = f"{folder}/{name}"
            if name.endswith(_FILE_TYPES) and not os.access(path, os.R_OK):
                unread += _unread_path(path)
        yield folder, files


def _refuse_unreadable(root: Path, unread: list[UnreadPath]) -> None:
    if unread:
        raise _unreadable_folder_error(
            root, unread, "Enclaves would keep their old files. Nothing was changed."
        )


def revoked_certificates(root: Path, known: Container[str] = ()) -> tuple[Path, ...]:
    """Return the sorted paths of the certificates in the folder of revoked enclaves.

    Certificates whose serial number (hexadecimal) is in ``known`` are left out.

    Raises:
        KeystoreError: the folder cannot be read.
    """
    folder = root / REVOKED
    try:
        places = sorted(os.listdir(folder))
    except (FileNotFoundError, NotADirectoryError):
        return ()
    except OSError as error:
        effect = "Revoked certificates would be left out."
        raise _unreadable_folder_error(root, [UnreadPath.from_error(error)], effect) from error
    files = (folder / name / CERTIFICATE_FILE for name in places if name not in known)
    return tuple(name for name in files if os.path.lexists(name))


def _unread_path(path: str) -> Iterator[UnreadPath]:
    """Yield the path if the system does not let sros read it; a broken link counts as missing."""
    try:
        os.close(os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC))
    except OSError as error:
        if error.errno not in (errno.ENOENT, errno.ELOOP, errno.ENOTDIR):
            yield UnreadPath.from_error(error)


def _unreadable_folder_error(
    root: Path, unread: Sequence[UnreadPath], effect: str
) -> KeystoreError:
    first, more = unread[0], len(unread) - 1
    return KeystoreError(
        f"'{first.path}'{f' and {more} more' if more else ''} in keystore '{root}' cannot be read",
        f"{first.why}. {effect}",
        first.remedy(root),
    )


def hidden_enclaves(root: Path, among: Iterable[str] | None = None) -> tuple[str, ...]:
    """Return the sorted names of the enclaves in hidden folders, which `enclave_names` leaves out.

    ``among`` are the names from a search with ``hidden``; if None, the search is done here.  Two
    kinds of folders are left out: folders of an interrupted transaction, and folders that
    Kubernetes makes next to the link ``..data`` where it mounts a Secret with an enclave's own
    files.
    """
    names = search_enclaves(root, hidden=True)[0] if among is None else among
    folders = {name: enclave_path(root, name) for name in names if "/." in name}
    return tuple(
        sorted(
            name
            for name, folder in folders.items()
            if STAGE not in folder.parts and not _is_kubernetes_secret(folder)
        )
    )


def _is_kubernetes_secret(folder: Path) -> bool:
    """Return whether Kubernetes made ``folder`` for a Secret.

    Then its parent, the folder of an enclave, has links to the files in it.
    """
    link = folder.parent / "..data"
    try:
        return link.is_symlink() and all(
            (folder.parent / file.name).samefile(file) for file in folder.iterdir()
        )
    except OSError:
        return False


def list_enclaves(root: Path) -> tuple[str, ...]:
    """Return the names of the enclaves of a keystore, sorted.

    Raises:
        KeystoreError: ``root`` is not a keystore, or a folder of it cannot be read.
    """
    check_keystore(root)
    return enclave_names(root)


def refuse_flat_keystore(root: Path) -> None:
    """Raise `KeystoreError` if ``root`` is a flat keystore of ROS 2 Eloquent or earlier.

    A keystore in the present layout is not refused, even if it also has files of the flat layout.
    """
    if not root.is_dir() or is_keystore(root):
        return
    if any((root / file).is_file() for file in _EARLIER_CA):
        raise KeystoreError(
            f"'{root}' is not a valid keystore",
            "It is a keystore of ROS 2 Eloquent or earlier: these distributions are not supported "
            "any more.",
            "Create a keystore, and generate artifacts from the policy: `sros create_keystore NEW` "
            "and `sros generate_artifacts -k NEW -p POLICY`.",
        )


def check_keystore(root: Path) -> None:
    """Raise `KeystoreError` if ``root`` is not a keystore."""
    if not is_keystore(root):
        refuse_flat_keystore(root)
        if root.is_file():
            raise KeystoreError(
                f"'{root}' is not a valid keystore",
                "It is a file.",
                "Name the folder of a keystore.",
            )
        if root.suffix == ".xml" and not root.exists():
            raise KeystoreError(f"the policy '{root}' does not exist", "", "Correct its path.")
        why = f"It has no {ENCLAVES} folder, or has neither a CA, a governance nor an enclave."
        if not root.exists():
            parent = next((path for path in root.parents[-2::-1] if not path.exists()), None)
            why = "It does not exist."
            why += (
                f" The folder '{parent}' does not exist either: perhaps its disk is not mounted."
                if parent
                else ""
            )
        raise KeystoreError(f"'{root}' is not a valid keystore", why, _wrong_path_remedy(root))


def _wrong_path_remedy(root: Path) -> str:
    """Return the remedy if ``root``, which is not a keystore, was given as a keystore."""
    if around := keystore_around(root):
        return f"It is a folder in the keystore '{around}': name that keystore."
    if similar := similar_keystores(root):
        return f"Perhaps you mean '{similar[0]}'."
    create = f"sros create_keystore {quote(str(root))}"
    return f"Name the keystore; if you have none yet, make one with `{create}`."


def keystore_around(folder: Path) -> Path | None:
    """Return the keystore that contains ``folder`` (which need not exist), or None."""
    with suppress(KeystoreError):
        return next(filter(is_keystore, Path(os.path.realpath(folder)).parents), None)
    return None


def similar_keystores(root: Path) -> list[Path]:
    """Return keystores next to ``root`` with similar names that differ not only in digits."""
    from difflib import get_close_matches  # only needed for this error

    def without_digits(name: str) -> str:
        return "".join(letter for letter in name if not letter.isdigit())

    with suppress(OSError, KeystoreError):
        siblings = [path.name for path in root.absolute().parent.iterdir() if path.is_dir()]
        names = get_close_matches(root.name, siblings, n=3, cutoff=0.75)
        paths = [
            root.with_name(name)
            for name in names
            if without_digits(name) != without_digits(root.name)
        ]
        return [path for path in paths if is_keystore(path)]
    return []


def locate_enclave(folder: Path) -> tuple[Path, str]:
    """Return the keystore that holds an enclave's folder, and the name of the enclave.

    Raises:
        DocumentError: ``folder`` is not below a folder named ``enclaves``.
        KeystoreError: ``folder`` belongs to a node in a keystore of ROS 2 Eloquent or earlier.
    """
    absolute = Path(os.path.abspath(folder))  # noqa: PTH100 - must not follow links
    for above in (absolute, *absolute.parents):
        if above.name == ENCLAVES:
            return above.parent, f"/{'/'.join(absolute.relative_to(above).parts)}"
    for above in absolute.parents:
        refuse_flat_keystore(above)
    raise DocumentError(
        f"'{folder}' is not below a folder named {ENCLAVES}",
        "rcl finds an enclave by its path below that folder.",
        "Name the keystore, or the enclave's folder in it. If you have only this folder, "
        f"copy it to a place where rcl looks: `mkdir -p robot/{ENCLAVES} && cp -a "
        f"{quote(str(absolute))} robot/{ENCLAVES}/ && sros check robot`.",
    )
