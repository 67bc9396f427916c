"""Checks of a keystore's files: modes, links, and misplaced files."""

from __future__ import annotations

import os
import re
import stat
from collections.abc import Collection, Iterator, Sequence
from contextlib import suppress
from pathlib import Path
from shlex import quote

from sros_tool.checks.keystores.opened import CheckedKeystore
from sros_tool.checks.kind import ERROR, NOTE, WARNING, Finding, FindingKind, names_text
from sros_tool.errors import KeystoreError, SrosError
from sros_tool.faults import KEY_MADE_ON_ROBOT, ORIGINAL_KEYSTORE
from sros_tool.keystore.layout import (
    AGENT,
    CLOSED_PROCESSES,
    CONFIRMED,
    ENCLAVES,
    IDENTITY_CA_FILE,
    KEY_FILE,
    KEY_URI_FILE,
    LEDGER,
    LEDGER_INDEX,
    LOCK,
    OPTIONAL_FILES,
    PRIVATE,
    PUBLIC,
    REQUEST,
    REQUIRED_FILES,
    RETIRED,
    REVOKED,
    SEAL,
    STAGE,
    ZENOH_FILES,
    UnreadPath,
    enclave_folder,
    enclaves_of_closed_robot,
    folder_of_closed_robot,
    hidden_enclaves,
    is_layout_path,
)
from sros_tool.owners import (
    closing_command,
    is_for_root_alone,
    link_of_stranger,
    other_writers_clause,
    replaceable_on_the_way,
    steps_to,
    user_name,
)
from sros_tool.pki.keys import holds_private_key

KEY_READABLE = FindingKind(
    "keystore.key-readable",
    ERROR,
    "a private key that others can read",
    "Anyone who can read the key of an enclave can act as this enclave; anyone who can read the "
    "key of a CA can act as any enclave. Neither rcl nor DDS checks file modes, and ros2/sros2 "
    "creates keys with mode 0644.",
    "ros2/sros2 0.13; rcl 9, Fast DDS 2.14.5 and Cyclone DDS 0.10.2 check no modes.",
    "Run `chmod 600` on the key. If others may have copied it, replace it: the key of an enclave "
    "with `sros renew KEYSTORE ENCLAVE --new-key --revoke-old`, the key of a CA with `sros "
    "rotate_ca KEYSTORE --finish --delete-old-key`. Then export the enclaves again, and restart "
    "all processes.",
)
WORLD_WRITABLE = FindingKind(
    "keystore.world-writable",
    ERROR,
    "a file or folder that everybody can change",
    "Whoever can replace CA certificates, links or documents decides whom a node trusts.",
    "POSIX modes; CWE-732.",
    "Run `chmod o-w` on the file or folder.",
)
OTHERS_WRITE = FindingKind(
    "keystore.others-write",
    ERROR,
    "a file or folder that other users can change",
    "Whoever can replace CA certificates, links or documents decides whom a node trusts. sros does "
    "not check access control lists.",
    "POSIX owners and modes; CWE-732.",
    "Run `chown` with the owner of the keystore, and `chmod g-w`, on the file or folder.",
)
REPLACEABLE = FindingKind(
    "keystore.replaceable",
    ERROR,
    "a folder above the keystore that other users can change",
    "These users can put another keystore in place of this one, and so decide whom a node "
    "trusts. sros does not check access control lists.",
    "POSIX owners and modes; CWE-732; rcl 9 checks neither.",
    "Run `chmod go-w` on the folder, or move the keystore to a folder that only its owner and root "
    "can change.",
)
FOREIGN_OWNER = FindingKind(
    "keystore.foreign-owner",
    WARNING,
    "a keystore of another user",
    "The owner can replace all its files, and so decides whom your nodes trust. Files that root "
    "unpacks from an archive may belong to the user of this machine whose user id the archive "
    "states.",
    "POSIX owners; CWE-283.",
    "Run the check as the user that runs the nodes, or make that user the owner: "
    "`chown -R USER KEYSTORE`.",
)
FOLDER_OPEN = FindingKind(
    "keystore.folder-open",
    WARNING,
    "a folder of keys that others may enter",
    "If a tool writes a key there with a mode that is too open, others can read it immediately.",
    "ros2/sros2 0.13 makes private/ with 0755; sros with 0700.",
    "Run `chmod 700` on the folder.",
)
LINK_DANGLING = FindingKind(
    "keystore.link-dangling",
    ERROR,
    "a broken link",
    "The target of the link is missing.",
    "rcl 9 (security.c) follows links.",
    "Restore the target of the link, or remove the link.",
)
LINK_ABSOLUTE = FindingKind(
    "keystore.link-absolute",
    WARNING,
    "a link with an absolute path",
    (
        "The link breaks as soon as the keystore is moved, copied to a robot, or mounted in a "
        "container."
    ),
    "ros2/sros2 keystore layout (relative links).",
    "Replace the link with a relative one: `ln -sr`.",
)
LINK_OUTSIDE = FindingKind(
    "keystore.link-outside",
    WARNING,
    "a link to a file outside of the keystore",
    "The file is not copied or backed up with the keystore, and anyone with write access there "
    "can change it.",
    "CWE-59.",
    "Put the file itself into the keystore.",
)
INTERRUPTED = FindingKind(
    "keystore.transaction-left",
    WARNING,
    "a write that was interrupted",
    "DDS still loads a complete set of files, old or new. The next verb that writes completes or "
    "undoes the change.",
    "sros: sros_tool/keystore/transaction.py.",
    "Run `sros renew KEYSTORE --all-expiring 1d`: before it renews what expires within a day, it "
    "completes or undoes the interrupted change.",
)
FOREIGN_STAGE = FindingKind(
    "keystore.transaction-not-ours",
    ERROR,
    "an interrupted write that sros cannot have left",
    "Somebody else may have forged it, in the keystore or in the archive that the keystore came "
    "from, to make sros move files with your rights. Verbs that write refuse to continue.",
    "sros: sros_tool/keystore/transaction.py; CWE-59.",
    "Find out who can write to the keystore. Look into the folder that the finding names, and "
    "remove the folder.",
)
STRAY_KEY = FindingKind(
    "keystore.stray-key",
    WARNING,
    "a private key in the wrong place",
    (
        "The key is perhaps a copy from a backup. No verb of sros protects, renews or removes "
        "such a key."
    ),
    "ROS 2 keystore layout: private/*.pem and enclaves/*/key.pem only.",
    "Move the key to a safe place, or delete it.",
)
ARCHIVE = FindingKind(
    "keystore.archive",
    WARNING,
    "an archive or a container of keys in the wrong place",
    "The file may contain private keys: a backup of the keystore, for instance, contains its CA "
    "keys. sros does not open the file.",
    "ROS 2 keystore layout: only private/ is for keys of CAs.",
    "Look into the file, and move it to a safe place. If others had access to a CA key in it, "
    "replace the CA (`sros rotate_ca`).",
)
CA_KEY_ON_ROBOT = FindingKind(
    "keystore.ca-key-on-robot",
    ERROR,
    "a CA key in an export for a robot",
    "An attacker on the robot can create any enclave, with any rights.",
    "ROS 2 design, ROS 2 Security Enclaves; NIST SP 800-57 part 1, 6 (protection of keys).",
    "Make sure that the keystore that made the export has the key, and remove the key here. If "
    "others had access to the key, replace the CA in that keystore (`sros rotate_ca`).",
)
_ON_A_ROBOT = (
    "On a robot, replace the folder by an export (`sros distribute_key KEYSTORE ENCLAVE "
    "TARGET`); if others could read it, run `sros rotate_ca`."
)
_COPY_WITHOUT_LINKS_REMEDY = (
    "On the keystore machine, keep the CA keys, and copy the keystore again with its links (`cp "
    f"-a`), or add `--exclude keystore.home-or-robot`. {_ON_A_ROBOT}"
)
HOME_OR_ROBOT = FindingKind(
    "keystore.home-or-robot",
    ERROR,
    "a keystore with keys that must not be on a robot",
    "The keys belong on the keystore machine. On a robot, an attacker who gets a CA key can "
    "create any enclave, with any rights. The files do not show whether this folder is on a "
    "robot.",
    "ROS 2 design, ROS 2 Security Enclaves; NIST SP 800-57 part 1, 6 (protection of keys).",
    f"On the keystore machine, keep the CA keys, and run `sros check KEYSTORE`. {_ON_A_ROBOT}",
)
UNREADABLE = FindingKind(
    "keystore.file-unreadable",
    ERROR,
    "a file or folder of the keystore that cannot be read",
    "Verbs that need it fail, and nothing in it was checked.",
    "sros keystore layout.",
    "Restore it from a backup.",
)
HIDDEN_ENCLAVE = FindingKind(
    "keystore.hidden-enclave",
    ERROR,
    "an enclave in a hidden folder",
    "DDS loads the enclave, and a node that names the enclave has its rights. No verb of sros "
    "lists, renews, revokes or exports the enclave, and `sros check` does not examine its "
    "certificate and permissions.",
    "rcl 9 (rcl/src/rcl/security.c) takes a folder of any name; sros keystore layout.",
    "Remove the folder. If you need the enclave, create one without a dot in its name (`sros "
    "create_enclave`). If others had access to the folder, replace the CA (`sros rotate_ca`), "
    "because the enclave's certificate stays valid.",
)
UNKNOWN_FILE = FindingKind(
    "keystore.unknown-file",
    NOTE,
    "a file that is not part of a keystore",
    "Neither ROS 2 nor sros reads the file.",
    "ROS 2 keystore layout.",
    "Delete the file, or keep it elsewhere.",
)

_KEY_FOLDERS = (PRIVATE, ENCLAVES, REVOKED, RETIRED, AGENT)
_MOST_BYTES_READ = 65536
_KNOWN_FILES = (
    *REQUIRED_FILES,
    KEY_URI_FILE,
    *OPTIONAL_FILES,
    *ZENOH_FILES,
    "permissions.xml",
    REQUEST,
    SEAL,
    "governance.xml",
)
_KNOWN_ANYWHERE = re.compile(
    r".*\.(?:cert|key|crl)\.pem\Z|.*\.p11\Z|.*\.srl\Z|index\.txt.*|serial.*"
)

_ARCHIVES = re.compile(
    r"(?i)\.(?:tar|tgz|tbz2?|txz|gz|bz2|xz|zst|zip|7z|rar|p12|pfx|jks|keystore|bak|old|orig)\Z|~\Z"
)
"""File name suffixes of archives, key containers and backup copies."""


def _users_of_closed_robot(export: Path) -> Collection[int]:
    """Return the users to whom `sros close` orders to give this export; empty for other folders.

    Also empty if others could have written the list of processes, as in a folder such as ``/tmp``.
    """
    robot = folder_of_closed_robot(export.absolute())
    users = frozenset({0, os.geteuid()})
    if not robot or any(
        other_writers_clause(path.stat(), users) for path in (robot, robot / CLOSED_PROCESSES)
    ):
        return ()
    return enclaves_of_closed_robot(export).users


def check_files(keystore: CheckedKeystore, names: Sequence[str] | None = None) -> Iterator[Finding]:
    """Yield findings about the modes, links and names of files; does not read DDS documents.

    Args:
        keystore: the keystore.
        names: the enclaves whose folders are checked; None for the whole keystore.
    """
    root = os.fspath(keystore.root)
    state = keystore.root.stat()
    of_robot = () if keystore.is_original else _users_of_closed_robot(keystore.root)
    if state.st_uid not in (0, os.geteuid(), *of_robot):
        owner, remedy = user_name(state.st_uid), ""
        if not keystore.is_original:
            remedy = (
                f"An export has to belong to the user that runs the nodes. If this is {owner}, "
                "change nothing: run the check as this user to have no warning. Otherwise run "
                f"`chown -R USER {quote(root)}`."
            )
        yield FOREIGN_OWNER.found(root, f"it belongs to {owner}", root, remedy=remedy)
    trusted = frozenset({0, os.geteuid(), state.st_uid})
    kept: list[str] = []
    replaceable = dict(replaceable_on_the_way(keystore.root, trusted))
    # The user of such a link may also own the keystore to which it leads.
    users = frozenset({0, os.geteuid()})
    if link := link_of_stranger(steps_to(keystore.root), users):
        replaceable[link] = f"it is a link of {user_name(link.lstat().st_uid)}"
    for folder, why in replaceable.items():
        remedy = f"Run `{closing_command(folder, users)}`." if folder == link else ""
        yield REPLACEABLE.found(str(folder), why, str(folder), remedy=remedy)
    yield from _write_access_findings(root, state, trusted)
    links = _Links(root)
    if names is None:
        yield from _hidden_enclave_findings(keystore)
        yield from _folder_findings(root, keystore, links, trusted, kept)
        if kept and not (keystore.is_original and _has_link_to_identity_ca(keystore)):
            remedy = _COPY_WITHOUT_LINKS_REMEDY if keystore.is_original else ""
            yield HOME_OR_ROBOT.found(root, f"it has {names_text(kept)}", root, remedy=remedy)
        return
    passed: set[Path] = set()
    for name in names:
        folder = Path(enclave_folder(name))
        passed |= {folder, *folder.parents} - {Path()}
        yield from _folder_findings(os.path.join(root, folder), keystore, links, trusted, kept)
    for folder in sorted(passed):
        path = os.path.join(root, folder)
        yield from _write_access_findings(path, Path(path).stat(), trusted)


def _hidden_enclave_findings(keystore: CheckedKeystore) -> Iterator[Finding]:
    for name in hidden_enclaves(keystore.root):
        folder = str(keystore.opened.folder(name))
        yield HIDDEN_ENCLAVE.found(
            name, "the name of its folder, or of a folder above it, begins with a dot", folder
        )


def _has_link_to_identity_ca(keystore: CheckedKeystore) -> bool:
    """Return whether an enclave has a link to the identity CA, as in the original keystore.

    The enclaves of an export have copies instead.  So an export is recognized, even if somebody
    adds files to make it look like an original keystore.
    """
    files = [keystore.opened.folder(name) / IDENTITY_CA_FILE for name in keystore.names]
    return not any(map(os.path.lexists, files)) or any(map(os.path.islink, files))


def _folder_findings(
    start: str,
    keystore: CheckedKeystore,
    links: _Links,
    trusted_users: frozenset[int],
    kept_names: list[str],
) -> Iterator[Finding]:
    """Yield findings about the files and folders below ``start``.

    Appends the paths of keys that belong only in the original keystore to ``kept_names``.
    """
    root = os.fspath(keystore.root)
    keys = {os.path.join(root, ENCLAVES, name[1:], KEY_FILE) for name in keystore.names}
    keys |= {os.path.join(root, ENCLAVES, KEY_FILE)}
    keys |= set(map(_real_path_in_mounted_secret, keys))
    is_original = keystore.is_original
    unread: list[OSError] = []
    for parent, folders, files in os.walk(start, onerror=unread.append):
        folders.sort()
        if STAGE in folders:
            folders.remove(STAGE)
            yield _interrupted_change_finding(Path(parent), root)
        for name in folders:
            path = os.path.join(parent, name)
            info = os.lstat(path)
            if stat.S_ISLNK(info.st_mode):
                yield from links.check(path)
                continue
            yield from _write_access_findings(path, info, trusted_users)
            yield from _open_folder_findings(path, root, info.st_mode, is_original)
        if parent == root and AGENT in folders:
            folders.remove(AGENT)  # the folder of `sros agent` is closed to others
        inside = os.path.relpath(parent, root)
        for name in sorted(files):
            path = os.path.join(parent, name)
            try:
                info = os.lstat(path)
            except FileNotFoundError:  # removed meanwhile, such as a lock
                continue
            if stat.S_ISLNK(info.st_mode):
                yield from links.check(path)
                continue
            yield from _write_access_findings(path, info, trusted_users)
            if path in keys:
                yield from key_mode_findings(keystore, path, info.st_mode)
            elif name in _KNOWN_FILES and inside.startswith(ENCLAVES) and name != KEY_FILE:
                with suppress(OSError):  # `check_enclave` reports an unreadable one
                    if _holds_key(keystore, path, info):
                        yield from _stray_file_findings(keystore, path, info, is_original)
            elif keystore.looks_like_original and _is_key_of_ca_or_revoked_enclave(
                keystore, path, info
            ):
                kept_names.append(os.path.relpath(path, root))
                yield from key_mode_findings(keystore, path, info.st_mode)
            else:
                yield from _stray_file_findings(keystore, path, info, is_original)
    for error in unread:
        yield _unread_path_finding(error, root)


def _real_path_in_mounted_secret(key_path: str) -> str:
    """Return the real path of a key in a mounted Kubernetes secret, or else ``key_path``.

    In such a secret, files are links into ..data, which is a link to a sibling folder.
    """
    path = Path(key_path)
    if not path.is_symlink():
        return key_path
    data = path.with_name("..data")
    if not data.is_symlink():
        return key_path
    inside = data.readlink()
    mounted = path.readlink() == Path("..data", path.name) and len(inside.parts) == 1
    return os.fspath(path.parent / inside / path.name) if mounted else key_path


def _unread_path_finding(error: OSError, root: str) -> Finding:
    path = os.fsdecode(error.filename)
    remedy = UnreadPath.from_error(error).remedy(Path(root))
    return UNREADABLE.found(path, str(error.strerror), path, remedy=remedy)


def _interrupted_change_finding(parent: Path, root: str) -> Finding:
    from sros_tool.folders import Folder
    from sros_tool.keystore.transaction import check_interrupted_change

    try:
        with Folder(parent) as folder:
            check_interrupted_change(folder)
    except KeystoreError as error:
        return FOREIGN_STAGE.found(root, f"{error.what}. {error.why}", str(parent / STAGE))
    except OSError as error:
        text = f"an interrupted change cannot be read: {error.strerror}"
    else:
        text = "an interrupted change is neither completed nor undone"
    return INTERRUPTED.found(root, text, str(parent / STAGE))


def _open_folder_findings(path: str, root: str, mode: int, is_original: bool) -> Iterator[Finding]:
    inside = Path(path).relative_to(root)
    # Below a closed top folder, other users cannot enter any folder.
    asked = inside.parts[0] in _KEY_FOLDERS and (len(inside.parts) == 1 or not is_original)
    if asked and mode & 0o077 and not mode & stat.S_IWOTH:
        text, remedy = f"its mode is {stat.S_IMODE(mode):04o}", f"Run `chmod 700 {quote(path)}`."
        yield FOLDER_OPEN.found(path, text, path, remedy=remedy)


def _write_access_findings(
    path: str, info: os.stat_result, trusted_users: frozenset[int]
) -> Iterator[Finding]:
    if info.st_mode & stat.S_IWOTH:
        text = f"its mode is {stat.S_IMODE(info.st_mode):04o}"
        remedy = f"Run `chmod o-w {quote(path)}`."
        yield WORLD_WRITABLE.found(path, text, path, remedy=remedy)
    elif why := other_writers_clause(info, trusted_users):
        yield OTHERS_WRITE.found(path, why, path)


def key_mode_findings(keystore: CheckedKeystore, path: str, mode: int) -> Iterator[Finding]:
    """Yield a finding if others can read a private key, or only root can."""
    text, remedy = f"its mode is {stat.S_IMODE(mode):04o}", f"Run `chmod 600 {quote(path)}`."
    if mode & 0o077:
        remedy += f" If others may have copied the key, {_how_to_replace_key(keystore, path)}"
        yield KEY_READABLE.found(path, text, path, remedy=remedy)
    elif is_for_root_alone(mode):
        yield UNREADABLE.found(path, f"{text}: only root can read it", path, remedy=remedy)


def _how_to_replace_key(keystore: CheckedKeystore, path: str) -> str:
    """Return, as a clause and a sentence, how to replace the key of an enclave or of a CA."""
    root, where, on_robot = quote(os.fspath(keystore.root)), "", ""
    if not keystore.looks_like_original:
        root, where = "KEYSTORE", f" in the {ORIGINAL_KEYSTORE}"
    place = Path(os.path.relpath(path, keystore.root))
    (folder, *inside), name = place.parent.parts or ("",), place.name
    enclave = "/" + "/".join(part for part in inside if not part.startswith(".."))  # a mount
    if folder == "..":  # sros deletes no key outside of the keystore
        how = f"replace the CA{where}: `sros rotate_ca {root} --finish`; delete the old key"
    elif folder == PRIVATE:
        how = f"replace the CAs{where}: `sros rotate_ca {root} --finish --delete-old-key`"
    elif folder == RETIRED:
        how = f"finish the rotation{where}: `sros rotate_ca {root} --status` shows its stage"
    elif folder == ENCLAVES and name == KEY_FILE and enclave in keystore.names:
        how = f"replace it{where}: `sros renew {root} {quote(enclave)} --new-key --revoke-old`"
        on_robot = "" if keystore.looks_like_original else KEY_MADE_ON_ROBOT
    else:
        return "replace it."
    return f"{how}. Then export the enclaves again, and restart all processes.{on_robot}"


class _Links:
    """Checks of links, with a cache of the real paths of the folders that links point to."""

    def __init__(self, root: str) -> None:
        self._real_root = os.path.realpath(root)
        self._folders: dict[str, str] = {}
        self._link_targets: dict[str, str] = {}

    def check(self, link: str) -> Iterator[Finding]:
        """Yield findings about ``link``."""
        target = os.readlink(link)  # noqa: PTH115 - a Path of each of very many takes long
        end = os.path.normpath(os.path.join(link.rpartition(os.sep)[0], target))
        real = self._link_targets.get(end)
        if real is None and not Path(link).exists():
            # `check_enclave` reports a missing file that an enclave needs.
            path = Path(link)
            if not (path.name in REQUIRED_FILES and ENCLAVES in path.parts):
                yield LINK_DANGLING.found(link, f"it leads to '{target}'", link)
            return
        if target.startswith(os.sep):
            yield LINK_ABSOLUTE.found(link, f"it leads to '{target}'", link)
        if real is None:
            real = self._link_target(link, end)
        if real != self._real_root and not real.startswith(self._real_root + os.sep):
            yield LINK_OUTSIDE.found(link, f"it leads to '{real}'", link)

    def _link_target(self, link: str, end: str) -> str:
        """Return the real path of ``link``, whose target is ``end``.

        The result is cached for ``end``, unless ``end`` is a link itself.  The path of the folder
        of ``link`` contains no link, so ".." in the path can be removed first.
        """
        if Path(end).is_symlink():
            return os.path.realpath(link)
        parent, name = os.path.split(end)
        if parent not in self._folders:
            self._folders[parent] = os.path.realpath(parent)
        self._link_targets[end] = f"{self._folders[parent]}/{name}"
        return self._link_targets[end]


def _holds_key(keystore: CheckedKeystore, path: str, info: os.stat_result) -> bool:
    small = stat.S_ISREG(info.st_mode) and info.st_size <= _MOST_BYTES_READ
    return small and holds_private_key(_content(keystore, path))


def _content(keystore: CheckedKeystore, path: str) -> bytes:
    """Return the content of a file, b"" if it is no longer a regular file.

    Raises:
        OSError: the file cannot be read.
    """
    try:
        if Path(path) == keystore.root / LEDGER:
            return b"".join(keystore.opened.ledger_file.content())
        return keystore.opened.read(Path(path), "file")
    except SrosError as error:
        if isinstance(error.__cause__, OSError):
            raise error.__cause__ from None
        return b""  # no longer a regular file


def _is_key_of_ca_or_revoked_enclave(
    keystore: CheckedKeystore, path: str, info: os.stat_result
) -> bool:
    """Return whether a file is a private key in a folder for keys of CAs or revoked enclaves."""
    if os.path.relpath(path, keystore.root).partition(os.sep)[0] not in (PRIVATE, REVOKED, RETIRED):
        return False
    try:
        return _holds_key(keystore, path, info)
    except OSError:
        return False  # another check reports an unreadable file


def _stray_file_findings(
    keystore: CheckedKeystore, path: str, info: os.stat_result, is_original: bool
) -> Iterator[Finding]:
    """Yield findings about a file that belongs to no enclave, such as a misplaced key."""
    root = os.fspath(keystore.root)
    inside = os.path.relpath(Path(path).parent, root)
    place = inside.partition(os.sep)[0]
    try:
        holds_key = _holds_key(keystore, path, info)
    except OSError as error:
        yield _unread_path_finding(error, root)
        return
    if holds_key:
        yield from key_mode_findings(keystore, path, info.st_mode)
        if place == PRIVATE or not is_original:
            text = "it contains a private key that belongs to no enclave"
            yield CA_KEY_ON_ROBOT.found(path, text, path)
        else:
            yield STRAY_KEY.found(path, "it contains a private key", path)
        return
    name = Path(path).name
    if _ARCHIVES.search(name) and place not in (PRIVATE, REVOKED, RETIRED):
        text = "by its name, it is an archive or a container of keys, which does not belong here"
        yield ARCHIVE.found(path, text, path)
        return
    known = (
        (inside == "." and (is_layout_path(name) or name in (LEDGER_INDEX, LOCK)))
        or (place in (PUBLIC, PRIVATE) and _KNOWN_ANYWHERE.match(name))
        or (place == REVOKED and name in _KNOWN_FILES)
        or place == RETIRED
        or (place == CONFIRMED and name.endswith(".json"))
    )
    if not known:
        yield UNKNOWN_FILE.found(path, "neither ROS 2 nor sros uses this name in this folder", path)
