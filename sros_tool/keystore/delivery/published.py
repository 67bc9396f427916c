"""The record of the last publication for a fleet, in the keystore's ``published.json``.

The file saves work, and has the last version numbers, which the next versions must exceed.  Robots
do not depend on it.
"""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from datetime import datetime, timedelta
from importlib.util import find_spec
from itertools import islice
from pathlib import Path
from typing import Any, NamedTuple

from sros_tool.errors import DocumentError, KeystoreError, SrosError
from sros_tool.keystore.delivery.archive import LIMITS_OF_ONE_ROBOT, stated_size
from sros_tool.keystore.delivery.release import Release, read_release, release_target
from sros_tool.keystore.layout import IDENTITY, LIST_FILES, PUBLISHED
from sros_tool.keystore.reader import OpenedKeystore
from sros_tool.pki.crl import load_crls, signed_by
from sros_tool.validity import iso, parse_iso
from sros_tool.values import parse_json
from sros_tool.xml import read_bytes

_FORMAT = 1
_MOST_BYTES = 128 * 1024 * 1024
_MOST_TIMESTAMP_BYTES = 64 * 1024
_ARCHIVES_OF_FLEET, _ARCHIVES_OF_ROBOT = 500, 50
"""Maximum number of archives in a publishing folder: for all robots, and in addition per robot.

Replaced archives are kept for two days.
"""
_MEAN_ARCHIVE_BYTES = 512 * 1024
"""Maximum mean size of these archives in bytes, unpacked."""
MOST_NUMBER = 10**12 - 1
"""Highest number of a release that a seal can have, and highest version of metadata."""
BEGIN_AGAIN = "Start again as after a theft of all keys: docs/fetching.md says how."
"""The remedy if somebody has used up the version numbers."""
TIMESTAMP_PATH = "metadata/timestamp.json"
_ALTERED_FOR = timedelta(days=1)
"""How long it is remembered that a published file was altered."""
_DIGEST = re.compile(r"[0-9a-f]{64}\Z")


class PublishedRelease(NamedTuple):
    """The archive of a robot's release, as described by the metadata."""

    number: int
    """Number of the release."""
    sha256: str
    """SHA-256 of the archive, in hexadecimal."""
    length: int
    """Size of the archive in bytes."""

    def path(self, robot: str) -> str:
        """Return the path of the archive in the publishing folder."""
        folder, _, name = release_target(robot).rpartition("/")
        return f"targets/{folder}/{self.sha256}.{name}"

    def checked(self) -> PublishedRelease:
        """Return this release; raise `ValueError` if it has a value that sros never publishes."""
        for value, most in ((self.number, MOST_NUMBER), (self.length, LIMITS_OF_ONE_ROBOT.packed)):
            check_positive_number(value, most)
        if not (isinstance(self.sha256, str) and _DIGEST.match(self.sha256)):
            raise ValueError("a SHA-256 does not have 64 hexadecimal digits")
        return self


def check_positive_number(value: object, maximum: int = MOST_NUMBER) -> int:
    """Return ``value``; raise `ValueError` unless it is a number from 1 to ``maximum``."""
    if type(value) is not int or not 1 <= value <= maximum:
        raise ValueError(f"a release number or version is not a number from 1 to {maximum}")
    return value


class PassedEvaluation(NamedTuple):
    """The evaluation that found no problem in a robot's files, and the time for which it holds.

    ``files`` is a digest of the files without revocation lists, and of the version of sros. From
    ``since`` until ``until``, files with this digest need no new evaluation.
    """

    files: str
    since: datetime
    until: datetime

    def holds(self, files: str, now: datetime) -> bool:
        """Return whether files with the digest ``files`` need no new evaluation at ``now``."""
        return self.files == files and self.since <= now < self.until


class PublishedRobot(NamedTuple):
    """The last published release of a robot, and digests of the files in the release.

    ``content`` is the SHA-256 of the list of the release's files.  ``files`` is a digest of the
    inodes, sizes and times of these files in the keystore: if this digest is the same, nothing has
    changed for the robot.
    """

    release: PublishedRelease
    content: str
    files: str
    evaluated: PassedEvaluation | None = None


@dataclass
class PublicationRecord:
    """The last publication: the releases by robot, and the versions of the metadata by name.

    ``superseded`` maps paths in the publishing folder that nothing names any more to the time when
    sros first noticed this.  ``folder`` is the absolute path of the publishing folder, "" if
    unknown. ``metadata`` has the paths there of the metadata to which the timestamp leads.
    ``altered`` maps files that a run found missing, changed, older than published or foreign to the
    time of that run; as `PublishedFleet.altered` lists few names, it stays small.
    ``until`` is the first expiry of the metadata: from then on, robots refuse it; ``root_until`` is
    the expiry of the root metadata.  These fields, from ``folder`` on, are empty
    or None if nothing was published, or if an earlier release of sros, which did not record them,
    published last.
    """

    robots: dict[str, PublishedRobot] = field(default_factory=dict)
    versions: dict[str, int] = field(default_factory=dict)
    superseded: dict[str, datetime] = field(default_factory=dict)
    folder: str = ""
    metadata: Sequence[str] = ()
    until: datetime | None = None
    root_until: datetime | None = None
    altered: dict[str, datetime] = field(default_factory=dict)

    @property
    def number(self) -> int:
        """The highest number of a release; 0 without a release."""
        return max((robot.release.number for robot in self.robots.values()), default=0)

    def paths(self) -> Iterator[str]:
        """Yield the paths in the publishing folder that robots fetch after the timestamp."""
        yield from self.metadata
        yield from (robot.release.path(name) for name, robot in sorted(self.robots.items()))

    def first_missing(self) -> str | None:
        """Return the first file that is missing in the publishing folder, or "".

        The result is None if the folder cannot be seen, for example because its disk is not
        mounted.
        """
        paths = (TIMESTAMP_PATH, *self.paths())
        with suppress(OSError):
            if self.folder and Path(self.folder).is_dir():
                return next((path for path in paths if not Path(self.folder, path).exists()), "")
        return None

    def first_altered(self) -> str:
        """Return the first archive in the publishing folder that is not as published, or "".

        This includes archives that cannot be read; `first_missing` has those that are missing.
        """
        for name, robot in sorted(self.robots.items()) if self.folder else ():
            path, length = robot.release.path(name), robot.release.length
            try:
                file = Path(self.folder, path)
                if file.stat().st_size != length:
                    return path
                data = read_bytes(file, "archive", max_bytes=length)
            except FileNotFoundError:
                continue
            except (SrosError, OSError):
                return path
            if hashlib.sha256(data).hexdigest() != robot.release.sha256:
                return path
        return ""

    def document(self, now: datetime) -> bytes:
        """Return the content of ``published.json``."""
        robots = {name: _robot_as_json(robot) for name, robot in sorted(self.robots.items())}
        superseded = {path: iso(time) for path, time in sorted(self.superseded.items())}
        value = {
            "format": _FORMAT,
            "time": iso(now),
            "folder": self.folder,
            "until": iso(self.until) if self.until else None,
            "root_until": iso(self.root_until) if self.root_until else None,
            "versions": dict(sorted(self.versions.items())),
            "metadata": list(self.metadata),
            "altered": {path: iso(time) for path, time in sorted(self.altered.items())},
        }
        return json.dumps({**value, "superseded": superseded, "robots": robots}).encode()


def unseen_clause(missing: str | None) -> str:
    """Return why the publishing folder cannot be examined, as a clause, or "".

    ``missing`` is the result of `PublicationRecord.first_missing`.
    """
    if missing is None:
        return "is not on this machine, or cannot be read"
    if find_spec("tuf") is None:
        return "cannot be verified, because the Python package tuf is not installed"
    return ""


def altered_lately(altered: Mapping[str, datetime], now: datetime) -> dict[str, datetime]:
    """Return the files of `PublicationRecord.altered` that were found in the day before ``now``."""
    return {path: at for path, at in altered.items() if now - at < _ALTERED_FOR}


def read_published(keystore: OpenedKeystore) -> PublicationRecord:
    """Return the record of the last publication; an empty record if nothing was published.

    Raises:
        DocumentError: the file is damaged.
    """
    if not keystore.has(PUBLISHED):
        return PublicationRecord()
    try:
        path = keystore.root / PUBLISHED
        value = parse_json(read_bytes(path, "list of what is published", max_bytes=_MOST_BYTES))
        until, root_until = (
            parse_iso(end) if (end := value.get(name)) else None for name in ("until", "root_until")
        )
        return PublicationRecord(
            {name: _robot_from(robot_value) for name, robot_value in value["robots"].items()},
            {name: check_positive_number(version) for name, version in value["versions"].items()},
            {path: parse_iso(time) for path, time in value["superseded"].items()},
            str(value.get("folder", "")),
            [str(path) for path in value.get("metadata", ())],
            until,
            root_until,
            {str(path): parse_iso(at) for path, at in value.get("altered", {}).items()},
        )
    except (ValueError, OverflowError, KeyError, TypeError, AttributeError) as error:
        raise damaged_list_error(keystore) from error


def may_have_later_releases(keystore: OpenedKeystore) -> bool:
    """Return whether the publishing folder has later metadata than the keystore recorded.

    Later metadata shows that the keystore was restored from a backup, or that somebody else wrote
    the metadata, which this function does not verify.
    """
    with suppress(SrosError, ValueError, OSError, KeyError, TypeError):
        known = read_published(keystore)
        if known.folder:
            path = Path(known.folder) / TIMESTAMP_PATH
            version = parse_json(read_bytes(path, "timestamp", max_bytes=_MOST_TIMESTAMP_BYTES))[
                "signed"
            ]["version"]
            return bool(version > known.versions.get("timestamp", 0))
    return False


def later_revoked_serials(keystore: OpenedKeystore) -> frozenset[int]:
    """Return the serial numbers that the keystore's lists in later releases revoke.

    Raises:
        KeystoreError: as `releases_in`.
    """
    serials: set[int] = set()
    read_lists: set[bytes] = set()
    if may_have_later_releases(keystore):
        authorities, published = keystore.authority(IDENTITY), read_published(keystore)
        for release in releases_in(Path(published.folder), len(published.robots)):
            lists = {data for file, data in release.files.items() if file.endswith(LIST_FILES)}
            for data in lists - read_lists:
                read_lists.add(data)
                with suppress(SrosError):
                    for crl in load_crls(data, f"of {release.robot}"):
                        if any(signed_by(crl.list, authority) for authority in authorities):
                            serials.update(entry.serial for entry in crl.revoked)
    return frozenset(serials)


def releases_in(folder: Path, robots: int, altered: set[str] | None = None) -> Iterator[Release]:
    """Yield the releases in all archives of a publishing folder, whichever CA sealed them.

    Archives that cannot be read, or have no release, are left out, and so are archives whose name
    does not begin with their SHA-256: their content is not as published.  The names of all of these
    are added to ``altered``.
    ``robots`` is the number of robots of the fleet.

    Raises:
        KeystoreError: the folder has more archives, or larger ones, than the fleet can need.
            Without these limits, whoever runs the web server could keep the keystore busy forever.
    """
    most = _ARCHIVES_OF_FLEET + _ARCHIVES_OF_ROBOT * robots
    archives = [*islice((folder / "targets/robots").glob("*.tar.gz"), most + 1)]
    excess, size = f"more than {most}" if len(archives) > most else "", 0
    for path in () if excess else archives:
        try:
            data = read_bytes(path, "archive", max_bytes=LIMITS_OF_ONE_ROBOT.packed)
        except (SrosError, OSError):
            if altered is not None:
                altered.add(path.name)
            continue
        is_altered = hashlib.sha256(data).hexdigest() != path.name.partition(".")[0]
        stated = 0 if is_altered else min(stated_size(data), LIMITS_OF_ONE_ROBOT.unpacked)
        size += max(len(data), stated)
        if size > most * _MEAN_ARCHIVE_BYTES:
            excess = f"more than {most * _MEAN_ARCHIVE_BYTES // 1024**2} MiB (unpacked) of"
            break
        release = None
        with suppress(SrosError):
            release = None if is_altered else read_release(data)
        if release:
            yield release
        elif altered is not None:
            altered.add(path.name)
    if excess:
        raise KeystoreError(
            f"'{folder / 'targets/robots'}' has {excess} archives",
            "The keystore published less. sros would have to read all of them, because "
            "the keystore does not know the metadata in this folder.",
            f"Find out who else can write to the folder. Then move '{folder}' away, and publish "
            "with --new-folder of `sros fleet publish`. But if the keystore was restored from a "
            "backup, the folder may show what was revoked after the backup: remove only what no "
            "keystore published.",
        )


def damaged_list_error(keystore: OpenedKeystore, why: str = "") -> DocumentError:
    """Return the error for a damaged list of published releases; ``why`` is the reason."""
    return DocumentError(
        f"'{keystore.root / PUBLISHED}' is damaged",
        why,
        "Restore it from a backup. If there is none, remove it: all robots then get their "
        "releases again, with new numbers.",
    )


def _robot_from(value: Mapping[str, Any]) -> PublishedRobot:
    release = PublishedRelease(value["number"], value["sha256"], value["length"]).checked()
    files, *times = value.get("evaluated", [""])
    evaluated = PassedEvaluation(str(files), *map(parse_iso, times)) if times else None
    return PublishedRobot(release, str(value["content"]), str(value["files"]), evaluated)


def _robot_as_json(robot: PublishedRobot) -> dict[str, object]:
    value = {**robot.release._asdict(), "content": robot.content, "files": robot.files}
    if robot.evaluated is None:
        return value
    files, since, until = robot.evaluated
    return {**value, "evaluated": [files, iso(since), iso(until)]}


class MetadataExpiry(NamedTuple):
    """How long published metadata of each role is valid."""

    root: timedelta = timedelta(days=365)
    targets: timedelta = timedelta(days=90)
    snapshot: timedelta = timedelta(days=7)
    timestamp: timedelta = timedelta(days=1)

    def lifetime(self, name: str) -> timedelta:
        """Return how long the metadata ``name`` is valid; bins of robots are like ``targets``."""
        of_roles: dict[str, timedelta] = self._asdict()
        return of_roles.get(name, self.targets)
