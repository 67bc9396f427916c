"""The release of a robot: the files for its security folder, sealed by the permissions CA.

A release is an archive (``.tar.gz``) with all files of the robot's enclaves except their keys, and
with the seal ``release.p7s``: a signed message of the lines ::

    sros release 1
    robot NAME
    number N
    SHA-256  PATH      (a line for each file, sorted)

The number rises with each new content, so that a robot notices an older release.  Therefore nobody
who carries a release, or has the keys of the metadata, can change a release, give it to another
robot, or bring back an earlier release.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

from cryptography import x509

from sros_tool.errors import DocumentError, SrosError, UnavailableError
from sros_tool.fleet.robots import name_problem
from sros_tool.keystore.delivery.archive import LIMITS_OF_ONE_ROBOT, listed_digests, pack, unpack
from sros_tool.keystore.layout import (
    ENCLAVES,
    KEY_FILE,
    OPTIONAL_FILES,
    RELEASE_SEAL,
    REQUIRED_FILES,
    ZENOH_FILES,
)
from sros_tool.names import check_enclave_name
from sros_tool.pki import smime

if TYPE_CHECKING:
    from sros_tool.keystore.issuing.authority import Authority

RELEASE_FILES = frozenset({*REQUIRED_FILES, *OPTIONAL_FILES, *ZENOH_FILES} - {KEY_FILE})
"""The files of an enclave that a release can have: neither ``key.pem`` nor ``key.p11``."""
_SEAL_HEAD = re.compile(rb"sros release 1\nrobot ([^\n]{1,255})\nnumber ([1-9][0-9]{0,11})\n")


@dataclass(frozen=True, slots=True)
class Release:
    """A release: the files that the security folder of ``robot`` has to contain.

    ``number`` is higher than the numbers of all earlier releases of the robot.  ``files`` maps
    paths (``enclaves/r1/base/cert.pem``) to contents, without private keys.  An enclave without
    files in the release no longer belongs to the robot.  ``seal`` is the signed message with robot,
    number and the digests of all files; `seal_problem` verifies it.
    """

    robot: str
    number: int
    files: Mapping[str, bytes]
    seal: bytes

    def enclaves(self) -> dict[str, dict[str, bytes]]:
        """Map the names of enclaves to their files (contents by file name)."""
        enclaves: dict[str, dict[str, bytes]] = {}
        for path, data in self.files.items():
            name, file = _enclave_and_file(path)
            enclaves.setdefault(name, {})[file] = data
        return enclaves


def check_tuf() -> None:
    """Raise `UnavailableError` unless the package ``tuf`` is installed."""
    try:
        import tuf.ngclient  # noqa: F401
    except ImportError as error:
        raise UnavailableError(
            "the Python package tuf is not installed",
            "It signs and verifies the files that robots fetch.",
            "Install it: `pip install 'tuf>=6'`.",
        ) from error


def release_target(robot: str) -> str:
    """Return the TUF target path of a robot's release, the archive that its agent downloads."""
    return f"robots/{robot}.tar.gz"


class SealedRobot(NamedTuple):
    """The robot and the number in a seal that is not verified."""

    robot: str
    number: int


def seal_releases(
    releases: Sequence[tuple[str, int, Mapping[str, bytes]]], authority: Authority
) -> list[bytes]:
    """Return the seals (S/MIME) of releases, each given as (robot, number, files), in order."""
    documents = [_seal_text(robot, number, files) for robot, number, files in releases]
    return authority.sign_all(documents, "the file list of a release")


def pack_release(release: Release) -> bytes:
    """Return the archive of a release; equal releases give equal bytes."""
    return pack({**release.files, RELEASE_SEAL: release.seal})


def read_release(data: bytes) -> Release:
    """Return the release in an archive whose files are exactly those that its seal lists.

    The signer of the seal is not verified; `seal_problem` does that.

    Raises:
        DocumentError: the archive is damaged or too large; it has a file that does not belong to an
            enclave's release, such as a private key; or its files differ from the list in the seal.
    """
    try:
        files = unpack(data, LIMITS_OF_ONE_ROBOT)
        seal = files.pop(RELEASE_SEAL, b"")
        if not seal:
            raise DocumentError(f"it lacks {RELEASE_SEAL}")
        for path in files:
            _enclave_and_file(path)
        sealed = sealed_robot(seal)
        if smime.parse(seal).text != _seal_text(sealed.robot, sealed.number, files):
            raise DocumentError("its files differ from the signed list")
    except SrosError as error:
        raise DocumentError(f"the release cannot be used: {error.what}", error.why) from error
    return Release(sealed.robot, sealed.number, files, seal)


def sealed_robot(seal: bytes) -> SealedRobot:
    """Return the robot and the number in a seal, without verifying the seal.

    Raises:
        DocumentError: the message is not the seal of a release.
    """
    head = _SEAL_HEAD.match(smime.parse(seal).text)
    robot = head[1].decode("ascii", "replace") if head else ""
    if not head or name_problem(robot):
        raise DocumentError(f"{RELEASE_SEAL} is not the seal of a release")
    return SealedRobot(robot, int(head[2]))


def seal_problem(release: Release, authorities: Iterable[x509.Certificate]) -> str:
    """Return why no CA in ``authorities`` sealed this release, as a clause; "" if a CA did.

    On a robot, ``authorities`` are the permissions CAs that its folder trusts.
    """
    try:
        signed = smime.parse(release.seal)
    except SrosError as error:
        return str(error)
    if signed.text != _seal_text(release.robot, release.number, release.files):
        return "robot, number or files differ from the signed list"
    return signed.problem_for(authorities)


def _seal_text(robot: str, number: int, files: Mapping[str, bytes]) -> bytes:
    """Return the text of a seal."""
    head = f"sros release 1\nrobot {robot}\nnumber {number}\n"
    return head.encode() + listed_digests(files)


def _enclave_and_file(path: str) -> tuple[str, str]:
    """Return the enclave and the file name for a path in a release.

    Raises:
        SrosError: a release cannot have a file at this path.
    """
    folder, _, file = path.rpartition("/")
    if file not in RELEASE_FILES or not f"{folder}/".startswith(f"{ENCLAVES}/"):
        raise DocumentError(f"it contains {path!r}, which does not belong to a release")
    return check_enclave_name(folder.removeprefix(ENCLAVES) or "/"), file
