"""Publish the releases of a fleet's robots in a folder, for any web server or USB stick.

Robots find complete files at every moment, because of the order of writing.  First come the new
archives, which no metadata names yet.  Then the keystore's transaction writes ledger, keys and the
list of published files.  The metadata comes last, and its last file is the timestamp.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
import stat
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from datetime import UTC, datetime, timedelta
from functools import lru_cache, partial
from itertools import chain, islice
from pathlib import Path
from secrets import token_hex
from shlex import quote
from typing import TYPE_CHECKING, Annotated, NamedTuple

from cryptography import x509
from cryptography.x509.oid import ExtensionOID

from sros_tool import __version__
from sros_tool.errors import DocumentError, KeystoreError, Note, SrosError
from sros_tool.files import staged_file
from sros_tool.fleet.robots import Fleet, similar_names_notes
from sros_tool.folders import Folder, make_folders, remove_folders
from sros_tool.keystore.confirmation import OF_SAME_NUMBER, last_confirmation
from sros_tool.keystore.delivery.archive import listed_digests, refuse_archive_name
from sros_tool.keystore.delivery.export import released_enclave, released_files
from sros_tool.keystore.delivery.published import (
    BEGIN_AGAIN,
    MOST_NUMBER,
    TIMESTAMP_PATH,
    MetadataExpiry,
    PassedEvaluation,
    PublishedRelease,
    PublishedRobot,
    altered_lately,
    damaged_list_error,
    may_have_later_releases,
    read_published,
    releases_in,
    unseen_clause,
)
from sros_tool.keystore.delivery.release import (
    RELEASE_FILES,
    Release,
    check_tuf,
    pack_release,
    read_release,
    release_target,
    seal_problem,
    seal_releases,
)
from sros_tool.keystore.delivery.restored import (
    LaterChange,
    RobotClaim,
    check_authorities,
    enclaves_of_removed_robots,
    has_unpublished_restore,
    later_changes,
    older_than_robots_error,
    other_changes_notes,
    perhaps_revoked_enclaves,
    refuse_lost_ca,
    refuse_lost_changes,
    restores_after_last_release,
    with_earlier_keys,
    without_agreed_changes,
)
from sros_tool.keystore.delivery.role_keys import RoleKeys
from sros_tool.keystore.fleet import (
    checked_fleet,
    enclaves_of_robot,
    left_enclaves,
    left_enclaves_notes,
    recorded_fleet,
)
from sros_tool.keystore.issuing.keyring import IN_KEYSTORE, Keyring
from sros_tool.keystore.known_keys import KnownKeys, rights_of_backup_notes
from sros_tool.keystore.layout import (
    CERTIFICATE_FILE,
    CRL_FILE,
    FLEET_ROOT,
    IDENTITY,
    IDENTITY_CA_FILE,
    LIST_FILES,
    PERMISSIONS,
    PERMISSIONS_CA_FILE,
    PUBLISHED,
    RETIRED,
    ca_certificate_path,
    enclave_folder,
    enclave_path,
)
from sros_tool.keystore.ledger import PUBLISHING, REPORTED, SAME_KEY, Entry
from sros_tool.keystore.lifecycle.change import KeystoreChange
from sros_tool.keystore.lifecycle.revocation_list import LostRecords
from sros_tool.keystore.lifecycle.revoke import (
    REPLACED_AFTER_BACKUP,
    restore_revocations,
    restored_list_note,
)
from sros_tool.keystore.outcomes import changes_below
from sros_tool.keystore.reader import OpenedKeystore
from sros_tool.keystore.transaction import KeystoreLock
from sros_tool.parallel import map_slices, tick
from sros_tool.pki.certificates import digest, load_certificates
from sros_tool.pki.crl import lists_as_revoked, read_list
from sros_tool.validity import iso
from sros_tool.values import (
    DryRun,
    FileChange,
    FileChanges,
    NamedKeystore,
    Notes,
    Words,
    file_change,
    parse_json,
)
from sros_tool.wording import capitalized, first_few

if TYPE_CHECKING:
    from sros_tool.keystore.delivery.repository import NewMetadata, Roots
    from sros_tool.keystore.issuing.authority import Authority

_METADATA, _TARGETS, _ARCHIVES = "metadata", "targets", "targets/robots"
_MOST_NAMES = 3
"""Maximum number of enclaves that a message names."""
_MOST_DAMAGED = 5
"""Maximum number of robots with damaged archives that a message names."""
_KEPT = timedelta(days=2)
"""How long unused files are kept, because robots may be in the middle of an update."""
_REMOVABLE = re.compile(
    r"metadata/[0-9]+\.(?:targets|snapshot|robots-[0-9a-f]+)\.json"
    r"|targets/robots/[0-9a-f]{64}\.[A-Za-z0-9_]+\.tar\.gz"
    r"|(?:metadata|targets/robots)/\.[^/]+\.new"
)
"""Matches paths in a publishing folder that are removed when they have become unused."""
_MOST_SUPERSEDED = 500_000
"""Maximum number of unused paths that are remembered.

There is a limit because anyone who can write to the folder can make many.
"""
_ENDS_OF_LIST_PATHS = tuple(f"/{file}" for file in LIST_FILES)
"""Ends of the paths of files that may have revocation lists."""


class RobotRelease(NamedTuple):
    """The outcome of publishing for one robot."""

    robot: str
    """Name of the robot."""
    outcome: Annotated[str, Words(("published", "kept", "removed", "refused"))]
    """``published``: a new release; ``kept``: nothing has changed; ``removed``: no release is
    offered to the robot any more, because it has no enclaves or left the fleet; ``refused``: the
    robot keeps its earlier release, if it has one.
    """
    number: int | None
    """Number of the release that is now published for the robot; null if none is."""
    why: str
    """Why the release was refused; empty for other outcomes."""


class PublishedFleet(NamedTuple):
    """The releases and the metadata that were published."""

    keystore: NamedKeystore
    dry_run: DryRun
    folder: Path
    """The publishing folder, as given by the user."""
    robots: Sequence[RobotRelease]
    """The robots of the fleet, and robots whose releases were removed, sorted by name."""
    rotated: Sequence[str]
    """Roles of the metadata that have a new key."""
    versions: Mapping[str, int]
    """Versions of the metadata by name; ``robots-0`` and so on list the archives of robots."""
    expires: Mapping[str, datetime]
    """Expiry of the metadata by name, including ``root``, in UTC."""
    root: Path
    """File in the publishing folder with the root metadata that robots should pin."""
    root_sha256: str
    """SHA-256 of the root metadata, in hexadecimal."""
    refused_by: Sequence[str]
    """Robots that refuse their release: by their last message, they do not trust the permissions
    CA that sealed it.  Bring their files to them by hand.
    """
    later: Sequence[LaterChange]
    """With ``--restored``: changes made after the backup, which the keystore lacks."""
    altered: Sequence[str]
    """Files that this run found missing, changed, older than published, or foreign:
    ``robots/NAME.tar.gz`` (archives), ``metadata/timestamp.json`` (an earlier copy of the
    metadata), ``metadata/N.root.json`` and ``metadata`` (other metadata). This run published these
    files again, or renamed foreign files, and the exit status is 1.
    """
    changes: FileChanges
    notes: Notes

    def names(self, outcome: str) -> list[str]:
        """Return the robots with an outcome."""
        return [robot.robot for robot in self.robots if robot.outcome == outcome]

    def is_complete(self, now: datetime) -> bool:
        """Return whether no release was refused, no published file was found altered, and robots
        accept the metadata at ``now``.
        """
        is_accepted = all(end > now for end in self.expires.values())
        return is_accepted and not (self.names("refused") or self.altered)


def publish(
    root: Path,
    folder: Path,
    *,
    now: datetime,
    expiry: MetadataExpiry | None = None,
    root_key: Path | None = None,
    rotate: Collection[str] = (),
    restored: bool = False,
    new_folder: bool = False,
    keyring: Keyring = IN_KEYSTORE,
    dry_run: bool = False,
) -> PublishedFleet:
    """Publish the release of each robot of the fleet in ``folder``, and renew the metadata.

    Args:
        root: the keystore.
        folder: the publishing folder, which is made if missing.
        now: the current time.
        expiry: how long new metadata is valid.
        root_key: the file of the root key, or None for a key in the keystore.  A missing key is
            made when nothing was published yet.
        rotate: the roles that get new keys.
        restored: go on although the folder has later releases than the keystore knows.
        new_folder: go on although the folder has nothing of what the keystore published before.
        keyring: opens the keys of the CAs.
        dry_run: write nothing.

    Raises:
        KeystoreError: the keystore has no fleet; a key is missing; ``folder`` cannot be used, or
            belongs to another keystore; it has later releases than the keystore knows (without
            ``restored``); or it has nothing of what was published before (without ``new_folder``).
        UnavailableError: the package ``tuf`` is not installed.
    """
    check_tuf()
    keystore = OpenedKeystore(root)
    _unedited_fleet(keystore)
    refuse_archive_name(folder, "Releases are published in a folder: name one, such as pub.")
    _check_apart(root, folder)
    if behind := keystore.ledger_file.clock_clause(now):
        raise KeystoreError(
            behind,
            "Robots would refuse what is published now, or get it with wrong dates.",
            "Set the clock, and publish again. If the clock is correct now, but was ahead before, "
            f"first run `sros crl {quote(str(root))} --refresh`, so that the last entry of the "
            "ledger has today's date.",
        )
    with ExitStack() as stack:
        if not dry_run:
            made = make_folders(folder, mode=0o755)  # web servers have to read it
            # Of the folders that were made, only the empty ones.
            stack.callback(remove_folders, made)
            opened = stack.enter_context(Folder(folder))
            for part in (_METADATA, _TARGETS, _ARCHIVES):
                if not opened.is_folder(part):
                    opened.mkdir(part, 0o755)
                    made.insert(0, folder / part)
            lock = KeystoreLock(opened, "publishing folder")
            stack.callback(lock.release)
            lock.acquire()
        keystore.forget()  # another run may have published while this one waited
        fleet = _unedited_fleet(keystore)
        run = _Publication(keystore, folder, now, expiry or MetadataExpiry(), dry_run)
        run.notes += similar_names_notes(fleet)
        run.notes += left_enclaves_notes(keystore, fleet, left_enclaves(keystore, fleet, now))
        stack.enter_context(run.reporting_restore())
        run.check_restored(restored, new_folder, keyring)
        keys = RoleKeys(run.roots, root, root_key)
        keys.recover(dry_run)
        keys.open(rotate, now, run.expiry)
        changed = run.changed_robots()
        if not restored:  # which names the changes itself
            sent = [name for robot in changed for name in robot.enclaves]
            run.notes += rights_of_backup_notes(keystore, sent)
        if changed or keys.new or keys.has_new_root:
            with KeystoreChange(root, now=now, keyring=keyring, dry_run=dry_run) as change:
                run.keystore = change.keystore
                run.release(changed, change)
                run.compose(keys)
                run.stage(change, keys)
                change.record()
                change.transaction.commit()
                run.keep_changes(change)
        else:
            run.compose(keys)
            run.write_list_of_published()
        if not dry_run:
            try:
                run.write(keys)
            except OSError as error:  # for example if the disk is full
                raise KeystoreError(
                    f"not all files could be written in '{folder}'",
                    f"{error.strerror}. Robots find either all earlier files or all new files.",
                    "Remove the cause, and publish again.",
                ) from error
        return run.result(keys)


def _unedited_fleet(keystore: OpenedKeystore) -> Fleet:
    """Return the fleet of a keystore, which has to have one that nobody edited."""
    fleet = recorded_fleet(keystore)
    checked_fleet(keystore)
    return fleet


def _newer_folder_clause(keystore: OpenedKeystore) -> str:
    """Return a clause with evidence that the publishing folder is newer than the keystore, or "".

    The result is also "" if this cannot be determined here.  Only metadata that the keystore's own
    keys signed counts.
    """
    with suppress(SrosError, ValueError, OSError, KeyError, TypeError):
        # Archives are read only where the keystore signed the metadata: anybody can write many.
        if may_have_later_releases(keystore) and not _metadata_problem(keystore):
            check_tuf()
            folder, never = Path(read_published(keystore).folder), datetime.min.replace(tzinfo=UTC)
            run = _Publication(keystore, folder, never, MetadataExpiry(), dry_run=True)
            try:
                run.check_restored(restored=False, new_folder=False, keyring=IN_KEYSTORE)
            except KeystoreError as error:
                return error.what
    return ""


def _metadata_problem(keystore: OpenedKeystore) -> str:
    """Return why the metadata in the publishing folder does not verify, as a clause, or "".

    The result is also "" if this cannot be determined here: the folder or the package ``tuf`` is
    missing.  Expiry is not considered.

    Raises:
        DocumentError: the list of published files is damaged.
    """
    known = read_published(keystore)
    if not known.folder or not keystore.has(FLEET_ROOT):
        return ""
    folder = Path(known.folder)
    try:
        from sros_tool.keystore.delivery.repository import read_present

        roots = _roots(keystore)
        roots.add_later_versions(folder)
        version = read_present(folder, roots).versions().get("timestamp")
    except ImportError:
        return ""
    except KeystoreError as error:
        return f"{error.what}: {error.why.removesuffix('.')}"
    last = known.versions.get("timestamp", 0)
    return (
        f"'{folder}' has older metadata than the keystore published last"
        if version and version < last
        else ""
    )


def publication_problem(keystore: OpenedKeystore) -> str:
    """Return why robots refuse what is in the publishing folder, as a clause, or "".

    The problem is that of `_metadata_problem`, or a root file that is not the keystore's.  A later
    root file of the keystore itself, which a restored keystore does not know, is no problem.

    Raises:
        DocumentError: the list of published files is damaged.
    """
    if problem := _metadata_problem(keystore):
        return problem
    known = read_published(keystore)
    with suppress(ImportError, OSError):
        folder, roots = Path(known.folder), _roots(keystore)
        if known.folder and roots.versions and (folder / _METADATA).is_dir():
            roots.add_later_versions(folder)
            with Folder(folder) as opened:
                altered = roots.altered_in(opened, is_complete=True)
            if altered:
                files = ", ".join(altered)
                return f"'{folder}' has root metadata that is changed, missing or foreign: {files}"
    return ""


def _roots(keystore: OpenedKeystore) -> Roots:
    """Return the root metadata in the keystore.

    Raises:
        DocumentError: it is damaged.
    """
    from sros_tool.keystore.delivery.repository import Roots

    if not keystore.has(FLEET_ROOT):
        return Roots()
    try:
        return Roots(parse_json(keystore.read(FLEET_ROOT, "root metadata"))["roots"])
    except (DocumentError, ValueError, KeyError, TypeError) as error:
        raise DocumentError(
            f"'{keystore.root / FLEET_ROOT}' is damaged",
            "It is not the root metadata that sros wrote.",
            "Restore it from a backup. If there is none, move it and 'private/fleet_*' out of the "
            "keystore, publish to another folder, and give robots the root metadata of that folder "
            "(`sros agent init` with --force).",
        ) from error


def age_clause(keystore: OpenedKeystore) -> str:
    """Return what shows that the keystore is older than its robots, as a clause, or "".

    A keystore is older than its robots if it was restored from a backup, or is a copy, and has not
    published with ``--restored`` since. The result is "" if nothing shows this.
    """
    if restores_after_last_release(keystore):
        return "robots have files that it signed but does not know"
    return _newer_folder_clause(keystore)


def unpublished_restore_clause(keystore: OpenedKeystore) -> str:
    """Return what shows that later releases exist than the keystore knows, as a clause, or "".

    Unlike `age_clause`, the result is "" for a restore that only a revocation list showed: the
    keystore has repeated these revocations, and nothing waits for ``--restored``.
    """
    if has_unpublished_restore(keystore):
        return "robots have releases that it sealed but does not know"
    return _newer_folder_clause(keystore)


def unseen_publication_clause(keystore: OpenedKeystore) -> str:
    """Return why later releases than the keystore's cannot be seen here, as a clause, or "".

    Raises:
        DocumentError: the list of published files is damaged.
    """
    known = read_published(keystore)
    if not known.robots:
        return ""
    missing = known.first_missing()
    if why := unseen_clause(missing):
        folder = f", '{known.folder}'," if known.folder else " (not recorded)"
        return f"the folder of the last publication{folder} {why}"
    if missing and missing.startswith("metadata/"):
        return f"'{known.folder}' lacks {missing}"
    return publication_problem(keystore)


def older_keystore_notes(keystore: OpenedKeystore) -> Iterator[Note]:
    """Yield a note for an export from a keystore that is known to be older than its robots."""
    with suppress(SrosError):  # `sros check` reports a ledger that cannot be read
        if why := unpublished_restore_clause(keystore):
            yield Note(
                "export.older-keystore",
                f"the keystore is older than its robots: {why}. The export may have rights that "
                "were taken away after the backup, and lack revocations: before you bring it to a "
                f"robot, run `sros fleet status {quote(str(keystore.root))}`, which names the next "
                "step.",
            )


def is_all_published(root: Path, published: PublishedRobot, enclaves: Sequence[str]) -> bool:
    """Return whether the files of a robot are unchanged since they were last published."""
    return published.files == _files_digest(root, enclaves)


def _check_apart(root: Path, folder: Path) -> None:
    """Raise `KeystoreError` if the keystore is in the publishing folder, or the reverse."""
    inner, outer = (Path(os.path.realpath(path)) for path in (folder, root))
    if inner.is_relative_to(outer) or outer.is_relative_to(inner):
        raise KeystoreError(
            f"'{folder}' and the keystore '{root}' overlap",
            "Anybody may read the published files, and the keystore has private keys.",
            "Choose another folder.",
        )


class _ChangedRobot(NamedTuple):
    """A robot with possibly changed files: its enclaves, and a digest of the state of its files."""

    robot: str
    enclaves: Sequence[str]
    state: str


class _ReleaseOutcome(NamedTuple):
    """The outcome of publishing a robot's release.

    ``published`` is the release that the robot has now.  It is None if the robot has none: its
    first release was refused, or the archive of its earlier release is missing.  ``why`` says why
    the release was refused; otherwise it is empty.  ``not_valid`` is a clause on what in a new
    release is not valid now, or "".
    """

    robot: str
    published: PublishedRobot | None
    is_new: bool = False
    why: str = ""
    not_valid: str = ""


class _RobotFiles(NamedTuple):
    """The files of a robot's release, sorted by path, and the result of their evaluation.

    ``not_valid`` is a clause on what is not valid now, or "".  ``evaluated`` is None if the files
    have to be evaluated again before the next release.
    """

    files: Mapping[str, bytes]
    not_valid: str
    evaluated: PassedEvaluation | None


class _Evaluator:
    """An evaluator for the files of releases.

    A revocation changes only one file of each enclave.  If the other files were evaluated before,
    two checks are enough: the new list is evaluated with one enclave of each kind, and the
    certificates of the other enclaves are looked up in the list.
    """

    def __init__(self, keystore: OpenedKeystore, now: datetime) -> None:
        self._keystore = keystore
        self._now = now
        self._lists: dict[object, bool] = {}

    def files(self, enclaves: Sequence[str], before: PassedEvaluation | None) -> _RobotFiles:
        """Return the files of a robot with the given enclaves, evaluated.

        ``before`` is the evaluation of its last release.

        Raises:
            SrosError: an enclave cannot run, or its files cannot be read.
        """
        if before:
            by_enclave = {name: released_files(self._keystore, name) for name in enclaves}
            files = _sorted_by_path(by_enclave.values())
            if before.holds(_digest_except_revocation_lists(files), self._now) and all(
                self._is_list_good(name, of_enclave) for name, of_enclave in by_enclave.items()
            ):
                return _RobotFiles(files, "", before)
        released = {name: released_enclave(self._keystore, name, self._now) for name in enclaves}
        files = _sorted_by_path(enclave.files for enclave in released.values())
        not_valid = (
            f"{n}: {enclave.not_valid}" for n, enclave in released.items() if enclave.not_valid
        )
        until = min(enclave.until for enclave in released.values())
        evaluated = PassedEvaluation(_digest_except_revocation_lists(files), self._now, until)
        return _RobotFiles(files, "; ".join(not_valid), evaluated if until > self._now else None)

    def _is_list_good(self, name: str, files: Mapping[str, bytes]) -> bool:
        """Return whether an enclave accepts the revocation list, and is not on it.

        The list is evaluated once for each kind of enclave.  The result is also False if only a
        whole evaluation can tell.
        """
        folder = enclave_folder(name)
        data = files.get(f"{folder}/{CRL_FILE}")
        try:
            certificate = x509.load_pem_x509_certificate(files[f"{folder}/{CERTIFICATE_FILE}"])
            extensions = frozenset(
                (extension.oid, extension.critical, extension.value.public_bytes())
                for extension in certificate.extensions
                if extension.oid != ExtensionOID.SUBJECT_KEY_IDENTIFIER
            )
            revokes = data is not None and lists_as_revoked(
                _read_list(data), certificate.serial_number
            )
        except (ValueError, SrosError):
            return False
        kind = data, files[f"{folder}/{IDENTITY_CA_FILE}"], certificate.issuer, extensions
        if kind not in self._lists:
            try:
                enclave = released_enclave(self._keystore, name, self._now)
                self._lists[kind] = not enclave.not_valid
            except SrosError:
                self._lists[kind] = False
        return self._lists[kind] and not revokes


_read_list = lru_cache(maxsize=16)(partial(read_list, label=CRL_FILE))


def _sorted_by_path(enclaves: Iterable[Mapping[str, bytes]]) -> dict[str, bytes]:
    """Return the files of all enclaves by path, sorted."""
    return dict(sorted(item for files in enclaves for item in files.items()))


def _digest_except_revocation_lists(files: Mapping[str, bytes]) -> str:
    """Return a digest of files other than revocation lists, and of the evaluating version."""
    others = {path: data for path, data in files.items() if not path.endswith(f"/{CRL_FILE}")}
    return hashlib.sha256(__version__.encode() + b"\n" + listed_digests(others)).hexdigest()


class _Publication:
    """One run of `publish`: the published state, the intended state, and the writing."""

    def __init__(
        self,
        keystore: OpenedKeystore,
        folder: Path,
        now: datetime,
        expiry: MetadataExpiry,
        dry_run: bool,
    ) -> None:
        """Read what was published before, and what is in the folder now."""
        from sros_tool.keystore.delivery.repository import PresentMetadata, read_present

        self.keystore = keystore
        self.expiry = expiry
        self.list = read_published(keystore)
        self.roots = _roots(keystore)
        own = len(self.roots.versions)
        self._published_before = bool(own)
        self.roots.add_later_versions(folder)
        self._has_later_root = len(self.roots.versions) > own
        self._folder = folder
        self._earlier_folder = self.list.folder
        self.list.folder = os.path.abspath(folder)  # noqa: PTH100 - keeps a link as it is named
        if self._is_other_folder:
            self.list.superseded.clear()
        self._now = now
        self._dry_run = dry_run
        self._unread: set[str] = set()
        self._metadata_error: KeystoreError | None = None
        is_last_folder = self._earlier_folder == self.list.folder
        try:
            self._present = read_present(folder, self.roots)
        except KeystoreError as error:
            if unknown := self._unknown_releases():
                raise self._unknown_error(unknown) from error
            robots = self.list.robots.items()
            if damaged := [r for r, known in robots if not self._has_files_of(r, known.release)]:
                names = first_few(damaged, _MOST_DAMAGED)
                error.why += f" The archives of these robots are missing or changed, too: {names}."
            can_mend = os.access(folder / _METADATA, os.R_OK | os.W_OK | os.X_OK)
            if not (is_last_folder and can_mend):
                raise
            self._present, self._metadata_error = PresentMetadata(), error
        is_partly_there = any(os.path.exists(folder / path) for path in self.list.paths())  # noqa: PTH110 - no error if it cannot be read
        self._mends_metadata = (
            is_last_folder and not self._present.timestamp and is_partly_there
        ) or self._metadata_error is not None
        """Whether metadata that the keystore wrote here was altered, and is written again."""
        self._altered_roots: list[str] = []
        if (folder / _METADATA).is_dir():
            with Folder(folder) as opened:
                self._altered_roots = self.roots.altered_in(
                    opened, is_complete=is_last_folder and bool(self._present.timestamp)
                )
        self._present_releases = self._present.releases()
        self._composed: NewMetadata | None = None
        self._outcomes: list[_ReleaseOutcome] = []
        self._removed: list[str] = []
        self._damaged: set[str] = set()
        self._altered: Sequence[str] = ()
        self._number = 0
        self._least = 0
        self._changes: Sequence[FileChange] = ()
        self.notes: list[Note] = []
        self._restored_texts: list[str] = []
        self._is_restored = False
        self._root_note: Note | None = None
        self._later: Sequence[LaterChange] = ()
        self._revoked: Collection[str] = frozenset()
        """Enclaves that a dry run with ``restored`` would revoke again."""

    @contextmanager
    def reporting_restore(self) -> Iterator[None]:
        """Add to an error what `check_restored` has already changed in the keystore.

        The error also says which root metadata the keystore knows, if robots may know a later one.
        """
        try:
            yield
        except SrosError as error:
            if self._root_note:
                text = self._root_note.text
                error.remedy = f"{error.remedy.rstrip('.')}. {capitalized(text)}".lstrip(". ")
            if self._restored_texts:
                remedy = f"{error.remedy.rstrip('.')}. " if error.remedy else ""
                done = "; ".join(self._restored_texts)
                error.remedy = f"{remedy}The keystore was changed already: {done}."
            raise

    def check_restored(self, restored: bool, new_folder: bool, keyring: Keyring) -> None:
        """Refuse a folder that has, or may have had, later releases than the keystore knows.

        With ``restored`` (the keystore comes from a backup), later releases are accepted, and the
        enclaves that they revoke are revoked again.  A folder without releases is refused unless
        ``new_folder`` is set.  Another folder than last time is refused as long as the last folder
        has later releases.  With ``restored`` or ``new_folder``, the next numbers and versions are
        the seconds since 1970, because the numbers that were given before are not known.

        Raises:
            DocumentError: the list of published releases has numbers that were never given.
            KeystoreError: the keystore was restored from a backup, but ``restored`` is false; or
                ``restored`` is true, but nothing shows a restore; or the enclaves that the later
                releases revoke cannot be read.
        """
        if restored and self._metadata_error:
            raise self._metadata_error
        if restored or new_folder:
            self._mends_metadata = self._metadata_error is not None
        has_nothing = self._published_before and not self._present.timestamp
        is_lost = has_nothing and not self._mends_metadata
        unknown = [] if self._present.timestamp else self._unknown_releases()
        if unknown and not restored:
            raise self._unknown_error(unknown)
        if not self._present.timestamp:
            self._check_seals()
        if is_lost and not new_folder:
            raise self._nothing_published_error()
        if self._is_other_folder:
            self._check_earlier_folder()
        if not restored:
            is_new_place = has_nothing or self._is_other_folder
            is_known = has_unpublished_restore(self.keystore) or (
                is_new_place and bool(restores_after_last_release(self.keystore))
            )
            claim = self._claim_of_later_release() if is_new_place and not is_known else None
            if is_known or claim:
                doing = f"Publishing to '{self._folder}'"
                raise older_than_robots_error(self.keystore, doing, str(self._folder), claim)
        is_later = self._has_later_releases(restored)
        if restored and not (is_later or unknown or new_folder or self._shows_restore()):
            raise self._not_restored_error()
        if restored and not is_later:
            self._check_removed()
        if restored:
            if is_lost and not self._has_later_root:
                self._root_note = self._unseen_root_note()
            refuse_lost_ca(self.keystore)
            forgotten = LostRecords(self.keystore, self._now)
            if is_later or unknown:
                unknown = [self._latest_release()] if is_later else unknown
                check_authorities(self.keystore, self._folder, unknown[-1])
                for path, content in chain.from_iterable(
                    release.files.items() for release in unknown
                ):
                    if path.endswith(_ENDS_OF_LIST_PATHS):
                        forgotten.add(content)
            else:
                self.notes.append(self._hidden_revocations_note())
            self._restore(forgotten, keyring)
            if self._unread:
                self.notes.append(self._unread_note())
            if self._root_note:
                self.notes.append(self._root_note)
            self._is_restored = True
        self._check_removed()
        if is_lost or restored:
            self._least = int(self._now.timestamp())
            self.list.robots.clear()

    def _shows_restore(self) -> bool:
        """Return whether the folder, the ledger or a robot shows that the keystore was restored."""
        known, present = self.list.versions, self._present.versions()
        if self._has_later_root or any(present.get(name, 0) > known[name] for name in known):
            return True
        is_recorded = bool(restores_after_last_release(self.keystore))
        return is_recorded or self._claim_of_later_release() is not None

    def _claim_of_later_release(self) -> RobotClaim | None:
        """Return a robot's claim to have a release that the keystore never published, or None."""
        last = self.keystore.last_release
        fleet = recorded_fleet(self.keystore)
        for robot, member in fleet.robots.items():
            if not enclaves_of_robot(self.keystore, fleet, member):
                continue  # it was revoked, and may claim anything so that no robot gets the list
            with suppress(SrosError):
                if received := last_confirmation(self.keystore, robot):
                    sent = received.confirmation
                    if (sent.release or 0) > last:
                        return RobotClaim(robot, f"release {sent.release}")
                    if any(OF_SAME_NUMBER in problem for problem in sent.problems or ()):
                        return RobotClaim(
                            robot, "a release with the published number but other files"
                        )
        return None

    @property
    def _command(self) -> str:
        """The command `sros fleet publish` for this folder, in backquotes, without options."""
        where = f"{quote(str(self.keystore.root))} {quote(str(self._folder))}"
        return f"`sros fleet publish {where}`"

    @property
    def _is_other_folder(self) -> bool:
        """Whether the keystore last published to another folder."""
        return self._earlier_folder not in ("", self.list.folder)

    def _check_earlier_folder(self) -> None:
        """Refuse another folder while the folder of the last publication has later releases.

        Once the keystore records another folder, the later releases would no longer be noticed.
        """
        if evidence := _newer_folder_clause(self.keystore):
            where = f"{quote(str(self.keystore.root))} {quote(self._earlier_folder)}"
            raise KeystoreError(
                evidence,
                f"The keystore was restored from a backup, or is a copy. Publishing to "
                f"'{self._folder}' would undo later changes, such as a revocation.",
                f"Restore a later backup. If there is none, first run `sros fleet publish {where}`,"
                " which says what to do.",
            )

    def _hidden_revocations_note(self) -> Note:
        """Return a note on revocations that neither keystore nor publishing folder shows."""
        where, since = quote(str(self.keystore.root)), "the backup"
        last = self.keystore.ledger_file.last_time()
        if last and not restores_after_last_release(self.keystore):
            since = f"{iso(last)} (the last entry of the ledger)"
        return Note(
            "fleet.revocations-not-shown",
            f"nothing in '{self._folder}' shows what was revoked, or which rights were taken away, "
            f"after {since}: a robot that was stolen after that gets releases, and is trusted. "
            f"Run `sros fleet collect {where} INBOX` if you have not yet: it revokes again "
            "everything that messages of robots show as revoked. Also revoke again every other "
            f"stolen robot (`sros revoke {where} --robot NAME`), and sign the present policy "
            "(`sros generate_artifacts`). Then publish again.",
        )

    def _unseen_root_note(self) -> Note:
        """Return a note that keys of publishing may have been replaced without a trace here."""
        version = self.roots.last.version
        return Note(
            "fleet.root-not-seen",
            f"the keystore knows the root metadata up to version {version}, and nothing in "
            f"'{self._folder}' shows a later one. If a robot has a later N.root.json in "
            ".agent/metadata/root_history, keys of publishing were replaced after the backup, and "
            "robots refuse this publication. Then copy the later files to "
            f"'{self._folder}/metadata', and run {self._command} with --rotate-key ROLE for each "
            "replaced key.",
        )

    def _unread_note(self) -> Note:
        """Return a note on archives that may show revocations, but were not read."""
        revoke = f"sros revoke {quote(str(self.keystore.root))} --robot NAME"
        return Note(
            "fleet.archives-not-read",
            f"archives in '{self._folder}' were changed or renamed, or cannot be read, so sros did "
            f"not see what they revoke: {first_few(sorted(self._unread), _MOST_NAMES)}. Revoke "
            f"again what was stolen after the backup (`{revoke}`).",
        )

    def _not_restored_error(self) -> KeystoreError:
        return KeystoreError(
            f"nothing shows that the keystore '{self.keystore.root}' was restored",
            f"'{self._folder}' and the messages of robots have nothing later than its ledger. If "
            "robots say that their server has an older copy, that server does not have the files "
            f"of '{self._folder}'.",
            f"Publish with {self._command}, and copy '{self._folder}' to the server. "
            "If keystore and folder come from the same backup, add --new-folder.",
        )

    def _nothing_published_error(self) -> KeystoreError:
        return KeystoreError(
            f"'{self._folder}' has nothing that the keystore '{self.keystore.root}' published",
            "The keystore has published before. If it was restored from a backup and the folder "
            "was lost, too, robots that were revoked after the backup would get releases again.",
            "Name the folder in which the keystore publishes. If that folder is lost, or this is "
            f"an additional folder, add --new-folder to {self._command}; if the keystore was "
            "restored, first repeat the revocations that were made after the backup, and add "
            "--restored as well.",
        )

    def _has_later_releases(self, restored: bool) -> bool:
        """Return whether the folder has later releases than the keystore knows.

        Raises:
            KeystoreError: it has, and ``restored`` is false.
            DocumentError: the list of published releases has numbers that were never given.
        """
        if self.list.number >= (unused := self.keystore.ledger_file.next_number()):
            number = self.list.number
            why = f"It has release {number}, but the last number in the ledger is {unused - 1}."
            raise damaged_list_error(self.keystore, why)
        latest = self._highest_number
        if latest <= self.list.number:
            return False
        # The next number of the ledger does not tell: a restored keystore may have issued files
        # since.
        if latest in self.keystore.known_releases:
            return False
        if not restored:
            known = self.list.robots
            robots = [
                robot
                for robot, release in self._present_releases.items()
                if robot not in known or release.number > known[robot].release.number
            ]
            raise self._restored_error(
                f"has later releases of {first_few(robots, _MOST_NAMES)} than the keystore "
                f"'{self.keystore.root}' knows (up to the number {latest})",
                f"repeat the later changes, and add --restored to {self._command}, which "
                "revokes again what these releases revoke",
            )
        self._number = latest
        return True

    def _check_removed(self) -> None:
        """Refuse to publish for a robot that later metadata in the folder no longer has.

        The other releases do not show whether the robot was revoked or left the fleet.
        """
        from sros_tool.keystore.delivery.repository import RENEWED_ALONE

        known, present = self.list.versions, self._present.versions()
        if any(present.get(name, 0) > known[name] for name in known.keys() - RENEWED_ALONE):
            fleet = recorded_fleet(self.keystore)
            gone = sorted(self.list.robots.keys() - self._present_releases.keys())
            if removed := [robot for robot in gone if self._enclaves(fleet, robot)]:
                revoke = f"sros revoke {quote(str(self.keystore.root))} --robot {removed[0]}"
                raise self._restored_error(
                    f"was published again without {first_few(removed, _MOST_NAMES)}, and the "
                    f"keystore '{self.keystore.root}' does not know this",
                    f"repeat the revocations (`{revoke}`), remove from the fleet file the robots "
                    "that left the fleet, and publish again",
                )

    def _restored_error(self, evidence: str, remedy: str) -> KeystoreError:
        return KeystoreError(
            f"'{self._folder}' {evidence}",
            "The keystore was restored from a backup, or is a copy. Publishing would undo later "
            "changes, such as a revocation.",
            f"Restore a later backup. If there is none, {remedy}.",
        )

    @property
    def _highest_number(self) -> int:
        """The highest number of a release in the folder; 0 without a release."""
        return max((release.number for release in self._present_releases.values()), default=0)

    def _latest_release(self) -> Release:
        """Return a release with the highest number; it has the last CAs and revocation list.

        Releases with lower numbers may have earlier files, if later releases of their robots were
        refused.
        """
        problem = ""
        last = (
            robot for robot in self._present_releases.items() if robot[1].number == self._number
        )
        for robot, present_release in last:
            try:
                if not (data := self._read(robot, present_release)):
                    raise DocumentError(
                        f"'{self._folder / present_release.path(robot)}' is missing or incomplete"
                    )
                release = read_release(data)
                if release.number != present_release.number:
                    raise DocumentError(f"the release of {robot} does not have the recorded number")
            except SrosError as error:
                problem = problem or f"{capitalized(error.what)}."
            else:
                return release
        raise KeystoreError(
            f"sros cannot read the last release of any robot in '{self._folder}'",
            f"{problem} Without a release, sros cannot tell which revocations the keystore lacks.",
            "Copy a release there from a copy of the folder, or from a robot, whose agent "
            "keeps its release as FOLDER/.agent/release.tar.gz.",
        )

    def _restore(self, forgotten_lists: LostRecords, keyring: Keyring) -> None:
        """Record that the keystore was restored, and revoke again what ``forgotten_lists`` revoke.

        Certificates in releases that the keystore sealed are recorded, so that `revoke` knows them.
        """
        for certificate in self._sealed_certificates():
            forgotten_lists.add_certificate(certificate)
        last = self._last_releases()
        changes = without_agreed_changes(
            self.keystore, later_changes(self.keystore, last, self._now)
        )
        removed = enclaves_of_removed_robots(self.keystore, last, self._present_releases)
        sealed = [*self._sealed_releases()]
        perhaps_revoked = removed | perhaps_revoked_enclaves(self.keystore, last, sealed)
        unknown = forgotten_lists.unknown_certificates(self.keystore).values()
        unknowing = KnownKeys(self.keystore).made_unknowing(self.keystore.names, unknown)
        others = {*unknowing.values()} - {e.enclave for e in changes if e.change == "key"}
        changes += [LaterChange("other_key", name, "") for name in sorted(others)]
        kinds = ("key", "other_key", "governance")
        lost = [change for change in changes if change.change in kinds]
        rights = [change.enclave for change in changes if change.change == "rights_taken"]
        revocation = restore_revocations(
            self.keystore.root,
            forgotten_lists,
            shown_by=PUBLISHING,
            enclaves_with_named_rights=() if lost else rights,
            perhaps_revoked=perhaps_revoked,
            on_robots_only=[change.enclave for change in changes if change.change == "missing"],
            now=self._now,
            keyring=keyring,
            dry_run=self._dry_run,
        )
        self.keystore = OpenedKeystore(self.keystore.root)
        self._revoked = frozenset(revocation.names("revoked"))
        if forgotten_lists.lists:
            whence = f"the last release in '{self._folder}' has"
            self.notes.append(restored_list_note(revocation, whence))
        notes = [note for note in revocation.notes if note.id != REPLACED_AFTER_BACKUP]
        self.notes += notes
        if (forgotten_lists.lists or notes) and not self._dry_run:
            self._restored_texts.append("it has recorded what later releases and lists show")
            if self._revoked:
                names = first_few(sorted(self._revoked), _MOST_NAMES)
                self._restored_texts.append(f"it has revoked {names} again")
        # Enclaves of removed robots are named only as perhaps revoked, so that no command certifies
        # the keys of a stolen robot again.
        changes = [
            LaterChange("key" if is_key else "certificate", name, "")
            for name, is_key in revocation.replaced.items()
            if name not in removed
        ] + [
            change
            for change in changes
            if change.enclave not in self._revoked
            and not (
                change.change in ("key", "other_key")
                and change.enclave in revocation.replaced.keys() | removed
            )
        ]
        named = {change.enclave for change in changes if change.change in ("key", "other_key")}
        changes += [
            LaterChange("revoked", name, "")
            for name in with_earlier_keys(self.keystore, perhaps_revoked - self._revoked)
            if name not in named
        ]
        refuse_lost_changes(self.keystore, self._folder, changes)
        self.notes += other_changes_notes(self.keystore, changes)
        self._later = changes

    def _last_releases(self) -> dict[str, Release | None]:
        """Map robots to their last releases; None stands for a release that cannot be read.

        A release counts if a permissions CA of the keystore sealed it, or if metadata that the
        keystore's keys signed names it: the keystore may have lost a later permissions CA.
        """
        releases = sorted(self._sealed_releases(), key=lambda release: release.number)
        last: dict[str, Release | None] = {release.robot: release for release in releases}
        for robot, published in self._present_releases.items():
            sealed = last.get(robot)
            if sealed is None or sealed.number < published.number:
                last[robot] = None
                with suppress(SrosError):
                    if data := self._read(robot, published):
                        last[robot] = read_release(data)
        return last

    def _unknown_releases(self) -> list[Release]:
        """Return the sealed releases whose number or revocation list the keystore does not know.

        They are sorted by number.

        A number counts as known if the keystore's last publication in this folder has a higher one,
        for example from before a restore that was completed since.  It also counts as known if the
        keystore has or issued all files of the release, because then publishing was only
        interrupted before the ledger recorded its number.
        """
        known = self.keystore.known_releases
        is_same_folder = self._earlier_folder == self.list.folder
        last = self.list.number if is_same_folder else 0
        forgotten = LostRecords(self.keystore, self._now)
        unknown = [
            release
            for release in self._sealed_releases()
            if (
                release.number > last
                and release.number not in known
                and not self._issued_all_files_of(release)
            )
            or any(
                forgotten.add(content)
                for path, content in release.files.items()
                if path.endswith(_ENDS_OF_LIST_PATHS)
            )
        ]
        return sorted(unknown, key=lambda release: release.number)

    def _issued_all_files_of(self, release: Release) -> bool:
        """Return whether the keystore has, or has issued, every file of a release."""
        with suppress(SrosError, OSError):
            digests = {
                path: digest(load_certificates(data, path)[0])
                if path.endswith(f"/{CERTIFICATE_FILE}")
                else hashlib.sha256(data).hexdigest()
                for path, data in release.files.items()
            }
            entries = self.keystore.ledger_file.with_values("sha256", digests.values()).entries
            issued = {entry.sha256 for entry in entries if entry.reason != REPORTED}
            for role in (IDENTITY, PERMISSIONS):
                authority = self.keystore.read(ca_certificate_path(role), "CA certificate")
                issued.add(hashlib.sha256(authority).hexdigest())
            return all(
                digests[path] in issued or self.keystore.read(path, "file") == data
                for path, data in release.files.items()
            )
        return False

    def _check_seals(self) -> None:
        """Refuse a folder without metadata in which an unknown CA sealed releases."""
        known, authorities = self.keystore.known_releases, self.keystore.authority(PERMISSIONS)
        foreign = {
            release.robot
            for release in self._releases()
            if release.number not in known and seal_problem(release, authorities)
        }
        if foreign:
            raise KeystoreError(
                f"'{self._folder}' has releases that no CA of the keystore '{self.keystore.root}' "
                f"sealed: {first_few(sorted(foreign), _MOST_NAMES)}",
                "Another keystore published them, or this keystore was restored from a backup from "
                "before its permissions CA was replaced: publishing would undo later changes, such "
                "as a revocation.",
                "If the keystore was restored, first follow docs/howto/keystore_is_lost.md. "
                "Otherwise, name an empty folder.",
            )

    def _unknown_error(self, unknown: Sequence[Release]) -> KeystoreError:
        where = quote(str(self.keystore.root))
        robots = sorted({release.robot for release in unknown})
        end = ""
        if not self._published_before:
            end = " Give agents the new root metadata (`sros agent init --force`)."
        return self._restored_error(
            f"has releases of {first_few(robots, _MOST_NAMES)} that the keystore "
            f"'{self.keystore.root}' sealed but does not know (up to the number "
            f"{unknown[-1].number})",
            f"run `sros fleet collect {where} INBOX`, which revokes again everything that messages "
            "of robots show as revoked. Revoke again what else was revoked (`sros revoke "
            f"{where} --robot NAME`). Empty '{self._folder / _METADATA}', and add --restored "
            f"--new-folder to {self._command}: "
            "this also revokes again what these releases revoke. Then renew all certificates, and "
            f"publish again.{end} docs/howto/keystore_is_lost.md has these steps",
        )

    def _sealed_certificates(self) -> Iterator[x509.Certificate]:
        """Yield the certificates in all releases that a permissions CA of the keystore sealed."""
        for release in self._sealed_releases():
            for file, content in release.files.items():
                if file.endswith(f"/{CERTIFICATE_FILE}"):
                    with suppress(SrosError):
                        yield from load_certificates(content, file)[:1]

    def _sealed_releases(self) -> Iterator[Release]:
        """Yield the releases in all archives that a permissions CA of the keystore sealed."""
        authorities = self.keystore.authority(PERMISSIONS)
        yield from (
            release for release in self._releases() if not seal_problem(release, authorities)
        )

    def _releases(self) -> Iterator[Release]:
        """Yield the releases in all archives, whichever CA sealed them."""
        robots = recorded_fleet(self.keystore).robots
        return releases_in(self._folder, len(robots), self._unread)

    # ── which robots ───────────────────────────────────────────────────────────────────────

    def changed_robots(self, among: Sequence[_ChangedRobot] | None = None) -> list[_ChangedRobot]:
        """Return the robots that may need a new release, and forget robots without enclaves.

        If ``among`` is given, only these robots are examined.
        """
        root, fleet = self.keystore.root, _unedited_fleet(self.keystore)
        changed_robots, wanted = [], set()
        looked_at = (fleet.robots if among is None else {e.robot: e for e in among}).keys()
        for robot in looked_at:
            names = self._enclaves(fleet, robot)
            if not names:
                continue
            wanted.add(robot)
            state = _files_digest(root, names)
            before = self.list.robots.get(robot)
            has_files = before is not None and self._has_files_of(robot, before.release)
            if not before or before.files != state or not has_files:
                changed_robots.append(_ChangedRobot(robot, names, state))
            was_here = before and self._present_releases.get(robot) == before.release
            # An interrupted run can leave an archive out, but not leave other content in its place.
            if (
                before
                and not has_files
                and (
                    was_here
                    or self._mends_metadata
                    or os.path.lexists(self._folder / before.release.path(robot))
                )
            ):
                self._damaged.add(robot)
        known = self.list.robots.keys() | self._present_releases.keys()
        gone = (known if among is None else looked_at) - wanted
        for name in gone:
            self.list.robots.pop(name, None)
        self._removed = sorted({*self._removed, *(gone & self._present_releases.keys())})
        return changed_robots

    def _enclaves(self, fleet: Fleet, robot: str) -> list[str]:
        """Return a robot's enclaves that have certificates; [] for a robot outside of the fleet."""
        if robot not in fleet.robots:
            return []
        return [
            name
            for name in enclaves_of_robot(self.keystore, fleet, fleet.robots[robot])
            if name not in self._revoked
            and (self.keystore.folder(name) / CERTIFICATE_FILE).exists()
        ]

    def _has_files_of(self, robot: str, release: PublishedRelease) -> bool:
        """Return whether the folder has the archive of a release, undamaged."""
        return bool(self._read(robot, release))

    def _ensure_files_of(self, robot: str, release: PublishedRelease) -> bool:
        """Return whether the folder has a release; copy it from the earlier folder if needed."""
        if self._has_files_of(robot, release):
            return True
        data = self._earlier_folder and self._read(robot, release, Path(self._earlier_folder))
        if data and not self._dry_run:
            with Folder(self._folder) as folder:
                _put_file(folder, release.path(robot), data)
        return bool(data)

    def _read(self, robot: str, release: PublishedRelease, folder: Path | None = None) -> bytes:
        """Return the archive of a release in ``folder``; empty if missing, damaged or a link.

        The default for ``folder`` is the publishing folder.
        """
        try:
            with Folder(folder or self._folder) as opened:
                data = opened.read(release.path(robot), max_bytes=release.length)
        except (SrosError, OSError):
            return b""
        return data if hashlib.sha256(data).hexdigest() == release.sha256 else b""

    # ── their releases ─────────────────────────────────────────────────────────────────────

    def release(self, changed_robots: Sequence[_ChangedRobot], change: KeystoreChange) -> None:
        """Write the archives of new releases, which no metadata names yet.

        ``changed_robots`` are the robots that seemed changed before the keystore was locked.
        """
        changed = self.changed_robots(changed_robots)
        unused = change.keystore.ledger_file.next_number()
        number = max(unused, self._number + 1, self._least)
        if number > MOST_NUMBER:
            raise KeystoreError(
                f"no release can have the number {number}",
                f"Somebody with the targets key has written the version {number - 1}.",
                BEGIN_AGAIN,
            )
        authority = None if self._dry_run or not changed else change.permissions

        def work(part: Sequence[_ChangedRobot]) -> list[_ReleaseOutcome]:
            return list(self._release_all(part, number, authority))

        on_token = authority is not None and authority.on_token
        made = [(changed, work(changed))] if on_token else map_slices(changed, work)
        self._outcomes = [robot for _, part in made for robot in part]
        lines = []
        for robot, published, is_new, _, not_valid in self._outcomes:
            self.list.robots.pop(robot, None)
            if published:
                self.list.robots[robot] = published
            if published and is_new:
                lines.append(f"{published.release.sha256}  {robot}\n")
            if not_valid:
                text = f"{robot}: published, although the release is not valid now: {not_valid}"
                self.notes.append(Note("fleet.release-not-valid", text))
        if lines or self._is_restored:
            digest = hashlib.sha256("".join(sorted(lines)).encode()).hexdigest()
            change.entries.append(Entry(iso(self._now), "release", sha256=digest, number=number))

    def _release_all(
        self, robots: Sequence[_ChangedRobot], number: int, authority: Authority | None
    ) -> Iterator[_ReleaseOutcome]:
        """Yield the outcome for each robot; if ``authority`` is None, nothing is written."""
        evaluator = _Evaluator(self.keystore, self._now)
        new: list[tuple[_ChangedRobot, _RobotFiles, str]] = []
        for robot in robots:
            before = self.list.robots.get(robot.robot)
            try:
                files = evaluator.files(robot.enclaves, before.evaluated if before else None)
            except SrosError as error:
                kept = (
                    before
                    if before and self._ensure_files_of(robot.robot, before.release)
                    else None
                )
                yield _ReleaseOutcome(robot.robot, kept, why=str(error))
                continue
            content = hashlib.sha256(listed_digests(files.files)).hexdigest()
            if (
                before
                and before.content == content
                and self._ensure_files_of(robot.robot, before.release)
            ):
                kept = before._replace(files=robot.state, evaluated=files.evaluated)
                yield _ReleaseOutcome(robot.robot, kept)
            else:
                new.append((robot, files, content))
            tick()
        if authority is None:
            for robot, files, content in new:
                planned = PublishedRobot(
                    PublishedRelease(number, "0" * 64, 0), content, robot.state
                )
                yield _ReleaseOutcome(robot.robot, planned, is_new=True, not_valid=files.not_valid)
            return
        seals = seal_releases(
            [(robot.robot, number, files.files) for robot, files, _ in new], authority
        )
        with Folder(self._folder) as folder:
            for (robot, files, content), seal in zip(new, seals, strict=True):
                data = pack_release(Release(robot.robot, number, files.files, seal))
                digest = hashlib.sha256(data).hexdigest()
                release = PublishedRelease(number, digest, len(data))
                _put_file(folder, release.path(robot.robot), data)
                published = PublishedRobot(release, content, robot.state, files.evaluated)
                yield _ReleaseOutcome(
                    robot.robot, published, is_new=True, not_valid=files.not_valid
                )

    # ── metadata ───────────────────────────────────────────────────────────────────────────

    def compose(self, keys: RoleKeys) -> None:
        """Compose the metadata, and note which files it no longer names."""
        from sros_tool.keystore.delivery.repository import MetadataComposer

        self._note_altered()
        composer = MetadataComposer(
            self._present,
            keys.signers,
            known=self.list.versions,
            least=self._least,
            expiry=self.expiry,
            now=self._now,
        )
        releases = {name: robot.release for name, robot in self.list.robots.items()}
        self._composed = composer.compose(releases)
        self.list.versions = dict(self._composed.versions)
        self.list.metadata = sorted(
            f"{_METADATA}/{self.list.versions[name]}.{name}.json"
            for name in self._composed.expires.keys() - {"timestamp"}
        )
        self.list.root_until = keys.roots.last.expires
        self.list.until = min(*self._composed.expires.values(), self.list.root_until)
        needed = {release.path(robot) for robot, release in releases.items()}
        needed |= {f"{_METADATA}/{version}.{n}.json" for n, version in self.list.versions.items()}
        superseded = (path for path in self._removable_paths() if path not in needed)
        self.list.superseded = {
            path: self.list.superseded.get(path, self._now)
            for path in islice(superseded, _MOST_SUPERSEDED)
        }

    def _note_altered(self) -> None:
        """Note which published files are missing, changed, older or foreign, and list them."""
        altered = [release_target(robot) for robot in sorted(self._damaged)]
        if altered:
            names = first_few(sorted(self._damaged), _MOST_DAMAGED)
            text = (
                f"archives in '{self._folder}' were missing or changed: {names}. They are "
                "published again, with a new number. Find out who else can write to this folder."
            )
            self.notes.append(Note("fleet.archive-damaged", text))
        present, last = (
            versions.get("timestamp", 0)
            for versions in (self._present.versions(), self.list.versions)
        )
        if 0 < present < last and not self._is_other_folder:
            altered.append(TIMESTAMP_PATH)
            text = (
                f"the metadata in '{self._folder}' was older than the last publication, and is "
                "published again. Either a run was interrupted, or somebody put earlier files "
                "there: find out who else can write to this folder."
            )
            self.notes.append(Note("fleet.metadata-older", text))
        if self._mends_metadata:
            altered.append(_METADATA)
            error = self._metadata_error
            why = f"{error.what}: {error.why}" if error else f"{TIMESTAMP_PATH} was missing."
            text = (
                f"metadata in '{self._folder}' was missing or changed, and is published again: "
                f"{why} Either a run was interrupted, or somebody else can write to this folder: "
                "find out who."
            )
            self.notes.append(Note("fleet.metadata-altered", text))
        altered += self._note_altered_roots()
        self._altered = altered
        self.list.altered = {
            **altered_lately(self.list.altered, self._now),
            **dict.fromkeys(altered, self._now),
        }

    def _note_altered_roots(self) -> list[str]:
        """Note which root files are not the keystore's, and return their paths."""
        altered, after_last = self._altered_roots, self.roots.next_path()
        if os.path.lexists(self._folder / after_last) and after_last not in altered:
            altered = [*altered, after_last]  # it begins to count with a new root
        if altered:
            text = (
                f"root metadata in '{self._folder}' was missing, changed or foreign: "
                f"{', '.join(altered)}. sros writes its own files again, and renames foreign files "
                "to NAME.*.foreign, because robots that read them fetch nothing. Either a run was "
                "interrupted, or somebody else can write to this folder: find out who. If a robot "
                "was set up with a changed or foreign file, repeat its `sros agent init`, with "
                "--force."
            )
            self.notes.append(Note("fleet.root-altered", text))
        return altered

    def _removable_paths(self) -> Iterator[str]:
        """Yield the paths of files in the folder that may be removed at some time."""
        if not (self._folder / _ARCHIVES).exists():
            return  # a dry run, before anything was published
        with Folder(self._folder) as folder:
            for part in (_METADATA, _ARCHIVES):
                paths = (f"{part}/{name}" for name in folder.names(part))
                yield from (path for path in paths if _REMOVABLE.fullmatch(path))

    def stage(self, change: KeystoreChange, keys: RoleKeys) -> None:
        """Stage the keys, the versions of the root, and the list of published files."""
        if not self._dry_run:
            keys.write_new_key_outside()
        for path, data in keys.new.items():
            change.transaction.write(path, data, private=True)
        if keys.has_new_root:
            document = json.dumps({"roots": self.roots.as_json()}, indent=1).encode()
            change.transaction.write(FLEET_ROOT, document)
        change.transaction.write(PUBLISHED, self.list.document(self._now))

    def write_list_of_published(self) -> None:
        """Write the list of published files, and change nothing else in the keystore."""
        path = self.keystore.root / PUBLISHED
        self._changes = file_change(path, existed=True)
        if not self._dry_run:
            document = self.list.document(self._now)
            with staged_file(path, document, mode=0o644, for_owner=True) as put_in_place:
                put_in_place()

    def keep_changes(self, change: KeystoreChange) -> None:
        """Remember the committed changes of the keystore for the result."""
        self._changes = changes_below(self.keystore.root, change.transaction.changes)

    def write(self, keys: RoleKeys) -> None:
        """Write the metadata, with the timestamp last; then remove files that are long unused.

        A new root is written first if the current metadata already fits it.  Otherwise it is
        written after the new metadata, which the keys of both roots have signed.  So robots find
        complete metadata at every moment.
        """
        assert self._composed
        from sros_tool.keystore.delivery.repository import has_file

        with Folder(self._folder) as folder:
            for path in {*self._altered_roots, self.roots.next_path()}:
                _move_away(folder, path)
            roots = [file for file in self.roots.files() if not has_file(folder, *file)]
            roots_after_timestamp = [] if self._present.follows(self.roots.last) else roots
            *files, timestamp = self._composed.files
            for path, data in (*([] if roots_after_timestamp else roots), *files):
                _put_file(folder, path, data)
            folder.flush_file_system()
            missing = (path for path in self.list.paths() if not folder.state(path))
            if path := next(missing, ""):
                raise KeystoreError(
                    f"'{self._folder}' lacks {path}, which robots would fetch next",
                    "Somebody has removed it. Robots still find all earlier files.",
                    "Find out who else changes files there, and publish again.",
                )
            _put_file(folder, *timestamp)
            for path, data in roots_after_timestamp:
                _put_file(folder, path, data)
            folder.flush_file_system()
            for path, superseded_at in self.list.superseded.items():
                if self._now - superseded_at >= _KEPT:
                    with suppress(IsADirectoryError):  # sros never made a folder there
                        folder.unlink(path, missing_ok=True)
        keys.finish()

    # ── the result ─────────────────────────────────────────────────────────────────────────

    def result(self, keys: RoleKeys) -> PublishedFleet:
        """Return the result of publishing."""
        outcomes = {robot: RobotRelease(robot, "removed", None, "") for robot in self._removed}
        for robot, kept in self.list.robots.items():
            outcomes[robot] = RobotRelease(robot, "kept", kept.release.number, "")
        for robot, published, is_new, why, _ in self._outcomes:
            if is_new or why:
                number = published.release.number if published else None
                outcome = "refused" if why else "published"
                outcomes[robot] = RobotRelease(robot, outcome, number, why)
        path, data = list(self.roots.files())[-1]
        sealed = [name for name, done in outcomes.items() if done.outcome in ("published", "kept")]
        return PublishedFleet(
            self.keystore.root,
            self._dry_run,
            self._folder,
            [outcomes[robot] for robot in sorted(outcomes)],
            keys.rotated,
            dict(sorted(self.list.versions.items())),
            {**self._composed.expires, "root": keys.roots.last.expires} if self._composed else {},
            self._folder / path,
            hashlib.sha256(data).hexdigest(),
            list(_robots_without_ca(self.keystore, sorted(sealed))),
            self._later,
            self._altered,
            self._changes,
            (*self.notes, *keys.notes),
        )


def _robots_without_ca(keystore: OpenedKeystore, robots: Iterable[str]) -> Iterator[str]:
    """Yield the robots that, by their last message, do not trust the CA that seals releases."""
    if not (keystore.root / RETIRED).exists():  # no CA was ever replaced
        return
    sealing_ca = digest(keystore.authority(PERMISSIONS)[0])
    issued = keystore.ledger_with("sha256", sealing_ca).entries
    if any(entry.sha256 == sealing_ca and entry.reason == SAME_KEY for entry in issued):
        return
    for robot in robots:
        with suppress(SrosError):  # `fleet status` reports a damaged confirmation
            received = last_confirmation(keystore, robot)
            certificates = received.confirmation.certificates if received else {}
            trusted = [
                sha256
                for path, digests in certificates.items()
                for sha256 in digests
                if path.endswith(f"/{PERMISSIONS_CA_FILE}")
            ]
            if received and received.message and trusted and sealing_ca not in trusted:
                yield robot


def _files_digest(root: Path, names: Sequence[str]) -> str:
    """Return a digest of the inodes, sizes and times of all files in the releases of enclaves."""
    digest = hashlib.sha256()
    for name in names:
        folder = os.fspath(enclave_path(root, name))
        for file in sorted(RELEASE_FILES):
            try:
                state = os.stat(f"{folder}/{file}")  # noqa: PTH116 - faster, of very many files
            except OSError:
                continue
            times = state.st_mtime_ns, state.st_ctime_ns
            digest.update(f"{name}\0{file}\0{state.st_ino} {state.st_size} {times}\n".encode())
    return digest.hexdigest()


def _put_file(folder: Folder, path: str, data: bytes) -> None:
    """Write a file of the publishing folder, whole or not at all."""
    parent, _, name = path.rpartition("/")
    spare = f"{parent}/.{name}.new"
    for in_the_way in (spare, path):
        if stat.S_ISDIR(folder.mode(in_the_way)):
            _move_away(folder, in_the_way)
    folder.unlink(spare, missing_ok=True)
    folder.write(spare, data, 0o644, ignores_umask=True)  # web servers have to read it
    folder.replace(spare, path)


def _move_away(folder: Folder, path: str) -> None:
    """Rename what is at ``path``, whatever it is, so that robots do not read it."""
    if folder.state(path):
        folder.replace(path, f"{path}.{token_hex(4)}.foreign")  # a name that nobody can block
