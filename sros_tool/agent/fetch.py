"""Fetching the release of this robot from a publishing folder, by The Update Framework (TUF).

The folder is an untrusted place: a web server, a bucket, a CDN or a USB stick.  `tuf` verifies
its metadata from the pinned root on, and so refuses what is old, mixed, withheld or not signed.
Whether the permissions CA sealed the release is verified where it is installed.
"""

from __future__ import annotations

from datetime import datetime
from enum import StrEnum
from pathlib import Path
from typing import NamedTuple

from sros_tool.errors import SrosError
from sros_tool.keystore.delivery.release import Release

METADATA = "metadata"
"""The folder in the agent's folder with the trusted metadata, which `tuf` keeps."""
PINNED_ROOT = "root.json"
"""The file in the agent's folder with the root metadata that `pin_root` trusted first."""


class FetchProblem(StrEnum):
    """Why no release could be fetched."""

    UNREACHABLE = "unreachable"
    """The source does not answer, or lacks a file."""
    EXPIRED = "expired"
    """The metadata expired: home publishes no more, somebody withholds it, or a clock is wrong."""
    ROLLED_BACK = "rolled_back"
    """The metadata is older than what this robot has seen, or parts of it are."""
    NOT_SIGNED = "not_signed"
    """Metadata or release are not what the trusted keys signed, or are damaged."""
    TOO_LARGE = "too_large"
    """A file is larger than allowed, or than the metadata says."""
    NOT_FOR_ROBOT = "not_for_robot"
    """Nothing is published for this robot, or what is published is another robot's."""
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


def pin_root(state: Path, data: bytes, *, now: datetime) -> str:
    """Trust the root metadata ``data`` (of ``N.root.json``) from now on; return its SHA-256.

    Metadata that was trusted before is forgotten.

    Args:
        state: the agent's folder, ``FOLDER/.agent``, which exists.
        data: the content of the file.
        now: the present time.

    Raises:
        FetchError: it is no root metadata that its own keys signed.
        UnavailableError: the package ``tuf`` is not installed.
    """
    raise NotImplementedError


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

    The release is not verified against the CAs of the robot: its seal has to be, by
    `sros_tool.keystore.delivery.release.seal_problem`.  A release that was fetched before is not
    transferred again.  Not for two processes at once in the same ``state``.

    Args:
        state: the agent's folder, ``FOLDER/.agent``, with the pinned root.
        source: the publishing folder: ``https://…``, ``http://…``, or the path of a folder.
        robot: the name of this robot.
        now: the present time, by which metadata expires.
        installed: the number of the installed release; 0 if none is.
        client_certificate: certificate and key for TLS.
        tls_ca: CA certificates (PEM) of the server; None: those of the system.

    Raises:
        FetchError: there is no such release that can be trusted; its ``problem`` says why.
        UnavailableError: the package ``tuf`` is not installed.
    """
    raise NotImplementedError
