"""Fetching the release of this robot from a publishing folder, by The Update Framework (TUF).

The folder is an untrusted place: a web server, a bucket, a CDN or a USB stick.  `tuf` verifies its
metadata from the pinned root on, and so refuses files that are old, withheld or not signed, or
come from different versions of the folder.
Whether the permissions CA sealed the release is verified where it is installed.
"""

from __future__ import annotations

import hashlib
import ssl
import stat
from contextlib import suppress
from datetime import datetime
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from sros_tool.agent.connection import REFUSALS, is_tls_ended_by_server
from sros_tool.errors import SrosError, UsageError
from sros_tool.files import remove_file, replace_file
from sros_tool.fleet.robots import name_problem
from sros_tool.folders import Folder
from sros_tool.keystore.confirmation import EXPIRED_METADATA, OLDER_THAN_SEEN
from sros_tool.keystore.delivery.archive import LIMITS_OF_ONE_ROBOT
from sros_tool.keystore.delivery.release import Release, check_tuf, read_release, release_target
from sros_tool.validity import iso
from sros_tool.wording import capitalized
from sros_tool.xml import read_bytes

if TYPE_CHECKING:
    from tuf.api.metadata import TargetFile
    from tuf.ngclient import Updater

    from sros_tool.agent.transport import FolderTransport, HttpTransport

OLD_COPY = (
    "Check the files on the server, and publish there again. Only if the keystore comes from a "
    "backup, run `sros fleet publish KEYSTORE PUB --restored`."
)
"""Remedy for a source that has less than this robot had."""
_METADATA = "metadata"
"""The folder in the agent's folder with the trusted metadata, which `tuf` keeps."""
_PINNED_ROOT = "root.json"
"""The file in the agent's folder with the root metadata that `pin_root` trusted first."""
_FETCHED_ARCHIVE = "release.tar.gz"
"""The file in the agent's folder with the release that was transferred last."""
_REFUSED_ARCHIVE = "not-later.tar.gz"
"""The file in the agent's folder with a release that is not later than the installed one."""
_MOST_METADATA = 8 * 1024 * 1024


class FetchProblem(StrEnum):
    """The reasons why no release could be fetched."""

    UNREACHABLE = "unreachable"
    """The source does not answer, or lacks a file."""
    REFUSED = "refused"
    """The web server refuses the certificate of this robot."""
    EXPIRED = "expired"
    """The metadata expired: none is published, somebody withholds it, or a clock is wrong."""
    ROLLED_BACK = "rolled_back"
    """The metadata, or a part of it, is older than what this robot has seen."""
    NOT_SIGNED = "not_signed"
    """Metadata or release are not what the trusted keys signed, or are damaged."""
    TOO_LARGE = "too_large"
    """A file is larger than allowed, or than the metadata says."""
    NOT_FOR_ROBOT = "not_for_robot"
    """Nothing is published for this robot, or the published release belongs to another robot."""
    NOT_KEPT = "not_kept"
    """The agent's folder cannot be written, for example because the disk is full."""


class FetchError(SrosError):
    """A release that could not be fetched; ``problem`` says why, for programs."""

    def __init__(self, problem: FetchProblem, what: str, why: str = "", remedy: str = "") -> None:
        super().__init__(what, why, remedy)
        self.problem = problem


class ClientCertificate(NamedTuple):
    """The files (PEM) with which the robot identifies itself to a server with TLS."""

    certificate: Path
    key: Path


def pin_root(agent_folder: Path, data: bytes, *, now: datetime) -> str:
    """Trust the root metadata ``data`` (of ``N.root.json``) from now on; return its SHA-256.

    Metadata that was trusted before is forgotten.

    Args:
        agent_folder: the agent's folder, ``FOLDER/.agent``, which exists.
        data: the content of the file.
        now: the current time.

    Raises:
        FetchError: ``data`` is not root metadata signed by its own keys, or has expired.
        UnavailableError: the package ``tuf`` is not installed.
    """
    check_tuf()
    from tuf.api.exceptions import RepositoryError
    from tuf.api.metadata import Metadata, Root

    try:
        root = Metadata[Root].from_bytes(data)
        if not isinstance(root.signed, Root):
            raise RepositoryError("the file has metadata of another kind than root")
        root.signed.verify_delegate(Root.type, root.signed_bytes, root.signatures)
    except (RepositoryError, ValueError) as error:
        raise FetchError(
            FetchProblem.NOT_SIGNED,
            "the file is not the root metadata of a publishing folder",
            f"{_error_sentence(error)}",
            'Use the file that `sros fleet publish` names ("robots pin ...").',
        ) from error
    if root.signed.is_expired(now):
        raise FetchError(
            FetchProblem.EXPIRED,
            f"the root metadata expired at {iso(root.signed.expires)}",
            "",
            f'Use the file that `sros fleet publish` names ("robots pin ..."); or {_SET_CLOCK}.',
        )
    with Folder(agent_folder) as folder:
        if folder.is_folder(_METADATA):
            folder.remove_tree(_METADATA)
    replace_file(agent_folder / _PINNED_ROOT, data)
    return hashlib.sha256(data).hexdigest()


def is_root_pinned(agent_folder: Path) -> bool:
    """Return whether the agent trusts root metadata."""
    return (agent_folder / _PINNED_ROOT).is_file()


def fetch_release(
    state: Path,
    source: str,
    robot: str,
    *,
    now: datetime,
    installed: int = 0,
    client_certificate: ClientCertificate | None = None,
    tls_ca: Path | None = None,
) -> Release | None:
    """Return the release that is published for ``robot``; None if it is the installed one.

    A different release with the same number as the installed release is returned, too.  The release
    is not verified against the CAs of the robot: callers have to verify its seal, with
    `sros_tool.keystore.delivery.release.seal_problem`.  A release that was fetched before is not
    transferred again.  Only one process at a time may use the same ``state``.

    Args:
        state: the agent's folder, ``FOLDER/.agent``, with the pinned root.
        source: the publishing folder: ``https://…``, ``http://…``, or the path of a folder.
        robot: the name of this robot.
        now: the current time, which decides whether metadata has expired.
        installed: the number of the installed release; 0 if none is.
        client_certificate: certificate and key for TLS.
        tls_ca: CA certificates (PEM) of the server; None: the CAs of the system.

    Raises:
        FetchError: there is no such release that can be trusted; its ``problem`` says why.
        UsageError: ``source`` is not an address, or ``robot`` not a name.
        UnavailableError: the package ``tuf`` is not installed.
    """
    check_tuf()
    from tuf.api.exceptions import DownloadError, RepositoryError

    if problem := name_problem(robot):
        raise UsageError(f"{robot!r} is not the name of a robot", problem)
    try:
        transport = _transport(source, client_certificate, tls_ca)
        with transport.connection:
            updater = _updater(state, transport, now)
            target = updater.get_targetinfo(release_target(robot))
            _refuse_other_publication(state, transport, source)
            number = _release_number(target, source, robot)
            if target is None:
                return None
            path = state / _FETCHED_ARCHIVE
            is_here = updater.find_cached_target(target, str(path)) is not None
            if number == installed and is_here:
                return None
            if not is_here and number <= installed and path.exists():
                path = state / _REFUSED_ARCHIVE
                is_here = updater.find_cached_target(target, str(path)) is not None
            if not is_here:
                updater.download_target(target, str(path))
    except (DownloadError, RepositoryError, OSError, ValueError) as error:
        raise _fetch_error(error, source, now) from error
    return _read_archive(path, robot, number)


def _transport(
    source: str, certificate: ClientCertificate | None, tls_ca: Path | None
) -> HttpTransport | FolderTransport:
    from sros_tool.agent.transport import FolderTransport, HttpTransport

    if source.startswith(("https://", "http://")):
        try:
            return HttpTransport(source, certificate=certificate, tls_ca=tls_ca)
        except OSError as error:
            raise FetchError(
                FetchProblem.UNREACHABLE,
                "the certificates for TLS cannot be used",
                _error_sentence(error),
                "Check the certificate, the key and the CAs in the agent's settings.",
            ) from error
    if "://" in source:
        raise UsageError(
            f"{source!r} is neither an address of http or https nor a folder",
            "",
            "Write it as in https://HOST/fleet, or as the path of a folder.",
        )
    return FolderTransport(Path(source), max_bytes=LIMITS_OF_ONE_ROBOT.packed)


def _updater(state: Path, transport: HttpTransport | FolderTransport, now: datetime) -> Updater:
    """Return the TUF client, which trusts the pinned root and the roots that follow from it."""
    from tuf.ngclient import Updater, UpdaterConfig

    path = state / _PINNED_ROOT
    if not path.exists():
        raise FetchError(
            FetchProblem.NOT_SIGNED,
            f"'{state}' has no {_PINNED_ROOT}",
            "Without this file, the agent knows no key for the published files.",
            "Give the file to `sros agent init` with --root.",
        )
    with Folder(state) as folder:
        if not folder.is_folder(_METADATA):
            folder.mkdir(_METADATA, 0o700)
    _remove_unreadable(state)
    updater = Updater(
        str(state / _METADATA),
        f"{transport.base}/metadata/",
        target_base_url=f"{transport.base}/targets/",
        fetcher=transport,
        config=UpdaterConfig(targets_max_length=_MOST_METADATA),
        bootstrap=read_bytes(path, "root metadata", max_bytes=_MOST_METADATA),
    )
    # The current time is passed in; the client would ask the clock of the machine.
    updater._trusted_set.reference_time = now
    return updater


def _refuse_other_publication(
    state: Path, transport: HttpTransport | FolderTransport, source: str
) -> None:
    """Raise `FetchError` if the published timestamp has the version that the robot trusts, but not
    its content.

    The client of TUF then goes on with its own copy, and would see nothing new.
    """
    trusted = read_bytes(
        state / _METADATA / "timestamp.json", "timestamp", max_bytes=_MOST_METADATA
    )
    if transport.timestamp not in (b"", trusted):
        raise FetchError(
            FetchProblem.ROLLED_BACK,
            f"the files in {source} {OLDER_THAN_SEEN}, or from another publication",
            "The published timestamp.json has the version of the one that this robot received "
            "before, but other content. Nothing was changed.",
            OLD_COPY,
        )


def _remove_unreadable(state: Path) -> None:
    """Remove pipes, devices and huge files, which the client of TUF would read without end."""
    for path in (state / _FETCHED_ARCHIVE, *(state / _METADATA).rglob("*")):
        with suppress(OSError):
            state_of_file = path.stat()
            is_file = (
                stat.S_ISREG(state_of_file.st_mode)
                and state_of_file.st_size <= LIMITS_OF_ONE_ROBOT.packed
            )
            if not (is_file or stat.S_ISDIR(state_of_file.st_mode)):
                remove_file(path)


def _release_number(target: TargetFile | None, source: str, robot: str) -> int:
    """Return the number of the release that the metadata describes.

    Raises:
        FetchError: no release is published for the robot, or the release is too large.
    """
    if target is None:
        raise FetchError(
            FetchProblem.NOT_FOR_ROBOT,
            f"nothing is published for the robot {robot} in {source}",
            "The robot is not in the fleet, or joined it after the last publication, or all its "
            "enclaves were revoked.",
            "On the keystore machine, run `sros fleet status KEYSTORE`.",
        )
    if target.length > LIMITS_OF_ONE_ROBOT.packed:
        raise FetchError(
            FetchProblem.TOO_LARGE,
            f"the release of {robot} is too large: {target.length} bytes",
            f"The limit is {LIMITS_OF_ONE_ROBOT.packed} bytes.",
        )
    number = target.custom.get("number") if isinstance(target.custom, dict) else None
    if not isinstance(number, int) or number < 1:
        raise FetchError(
            FetchProblem.NOT_SIGNED,
            f"the metadata of robot {robot} does not state the number of its release",
        )
    return number


def _read_archive(path: Path, robot: str, number: int) -> Release:
    """Return the release in the verified archive at ``path``; it must be a release of ``robot``."""
    try:
        release = read_release(read_bytes(path, "release", max_bytes=LIMITS_OF_ONE_ROBOT.packed))
    except SrosError as error:
        raise FetchError(FetchProblem.NOT_SIGNED, error.what, error.why, error.remedy) from error
    if release.robot != robot:
        raise FetchError(
            FetchProblem.NOT_FOR_ROBOT,
            f"the release that is published for {robot} belongs to {release.robot}",
            "Somebody with the keys of the metadata put it there, or a robot was renamed.",
            "Nothing was changed. Find out who published it.",
        )
    if release.number != number:
        raise FetchError(
            FetchProblem.NOT_SIGNED,
            f"the release of {robot} has number {release.number}, but the metadata says {number}",
            "Somebody with the keys of the metadata put it there.",
            "Nothing was changed. Find out who published it.",
        )
    return release


_DATE_ERRORS = (9, 10)
"""Errors of OpenSSL for a certificate that is not yet valid, or has expired (x509_vfy.h)."""
_SET_CLOCK = "set the clock of this robot, if it is wrong"


def _fetch_error(error: Exception, source: str, now: datetime) -> FetchError:
    """Return the `FetchError` for an error of the TUF client."""
    from tuf.api import exceptions

    why = _error_sentence(error)
    if isinstance(error, exceptions.ExpiredMetadataError):
        needs = " KEYSTORE PUB --root-key FILE" if "root.json" in why else ""
        return FetchError(
            FetchProblem.EXPIRED,
            f"{EXPIRED_METADATA[:1].lower()}{EXPIRED_METADATA[1:]}{source} has expired",
            f"{why} The clock here shows {iso(now)}. Either nothing is published any more, or "
            f"{source} has an old copy of the files, or somebody withholds the new files.",
            f"On the keystore machine, run `sros fleet publish{needs}`; {_SET_CLOCK}.",
        )
    # Roots of other versions are not older files, but damaged or foreign ones.
    if isinstance(error, exceptions.BadVersionNumberError) and "root version" not in str(error):
        return FetchError(
            FetchProblem.ROLLED_BACK,
            f"the files in {source} {OLDER_THAN_SEEN}",
            f"{why} The server has older files than this robot received before. Nothing was "
            "changed.",
            OLD_COPY,
        )
    if isinstance(error, exceptions.DownloadLengthMismatchError):
        return _altered_files_error(FetchProblem.TOO_LARGE, source, why)
    status = error.status_code if isinstance(error, exceptions.DownloadHTTPError) else 0
    if status in REFUSALS or is_tls_ended_by_server(error.__cause__):
        return FetchError(
            FetchProblem.REFUSED,
            f"{source} refuses this robot",
            f"{why} Perhaps the certificates of this robot's enclaves were revoked or have "
            "expired, or the server has an old copy of the CA or of the revocation list.",
            "See the log of the server. If the certificates are the reason, bring new files with "
            "`sros distribute_key KEYSTORE --robot ROBOT FOLDER --force`.",
        )
    if isinstance(error, exceptions.DownloadError):
        what = f"nothing can be fetched from {source}"
        cause = error.__cause__
        if isinstance(cause, ssl.SSLCertVerificationError) and cause.verify_code in _DATE_ERRORS:
            why = f"{why} The clock here shows {iso(now)}."
            remedy = f"{capitalized(_SET_CLOCK)}. If it is correct, renew the "
            remedy += "certificate of the server."
            return FetchError(FetchProblem.UNREACHABLE, what, why, remedy)
        return FetchError(FetchProblem.UNREACHABLE, what, why)
    if isinstance(error, OSError):
        return FetchError(
            FetchProblem.NOT_KEPT,
            "the fetched files cannot be stored",
            why,
            "Make room on the disk, and let the agent write in its folder.",
        )
    return _altered_files_error(FetchProblem.NOT_SIGNED, source, why)


def _altered_files_error(problem: FetchProblem, source: str, why: str) -> FetchError:
    return FetchError(
        problem,
        f"the files in {source} are damaged, or not signed with the trusted keys",
        f"{why} Probably a published file was damaged or altered. This robot keeps its files.",
        "On the keystore machine, run `sros fleet publish KEYSTORE PUB`, which puts altered files "
        "right, and prints the SHA-256 of the root metadata: if this robot is new, compare it with "
        "the SHA-256 that `sros agent init` printed. If robots fetch from a copy of PUB, copy it "
        "again, and remove files there that PUB does not have. If the keystore was restored or "
        "made again, it may publish with other keys: see docs/howto/keystore_is_lost.md "
        "(--rotate-key; or `sros agent init` with --force and the new root.json).",
    )


def _error_sentence(error: Exception) -> str:
    """Return an error as a sentence."""
    text = str(error)
    if isinstance(error, OSError) and error.strerror:
        text = f"{error.filename}: {error.strerror}" if error.filename else error.strerror
    text = text.strip().removesuffix(".") or type(error).__name__
    return f"{capitalized(text)}."
