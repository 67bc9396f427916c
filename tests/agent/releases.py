"""Releases of a robot as home seals them, and the security folder of the robot."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest

from sros_tool.keystore.delivery.export import exported_files
from sros_tool.keystore.delivery.release import Release, seal_releases
from sros_tool.keystore.issuing.authority import Authority
from sros_tool.keystore.layout import KEY_FILE, ca_certificate_path, ca_key_path
from sros_tool.keystore.reader import OpenedKeystore, read_certificate
from sros_tool.pki.keys import load_key
from tests.support.harness import copy_of, sros

NAMES = ("/r1/a", "/r1/b", "/r1/c")


def moment() -> datetime:
    """Return the current time, by which the keystores of tests are made, too."""
    return datetime.now(UTC)


def authority_of(root: Path) -> Authority:
    """Return the permissions CA of a keystore."""
    key = (root / ca_key_path("permissions")).read_bytes()
    return Authority(
        read_certificate(root / ca_certificate_path("permissions")), load_key(key, "CA")
    )


def files_of(root: Path, names: tuple[str, ...] = NAMES) -> dict[str, bytes]:
    """Return the files of enclaves as a release has them."""
    files = exported_files(OpenedKeystore(root), names, moment(), keyless=True)
    return {path: data for path, data in files.items() if not path.endswith(f"/{KEY_FILE}")}


def release_of(
    files: Mapping[str, bytes], number: int, authority: Authority, robot: str = "r1"
) -> Release:
    """Return the sealed release with these files."""
    (seal,) = seal_releases([(robot, number, files)], authority)
    return Release(robot, number, files, seal)


@dataclass(frozen=True)
class Home:
    """A keystore, the robot's folder as first delivered, and what home published one by one."""

    root: Path
    delivered: Path
    first: Release
    """What was delivered."""
    renewed: Release
    """With a renewed certificate and permissions of /r1/a."""
    revoked: Release
    """With a revocation list, and the renewed /r1/a."""

    @property
    def authority(self) -> Authority:
        """The permissions CA."""
        return authority_of(self.root)

    def release(self, files: Mapping[str, bytes], number: int = 9, robot: str = "r1") -> Release:
        """Return a sealed release with other files."""
        return release_of(files, number, self.authority, robot)

    def robot(self, folder: Path) -> Path:
        """Return a copy of the robot's folder as first delivered."""
        copy_of(self.delivered, folder / "robot")
        return folder / "robot"


def make_home(folder: Path) -> Home:
    """Return a home in ``folder`` with the enclaves `NAMES` of r1, and /r2/x."""
    root, delivered = folder / "home", folder / "delivered"
    sros("generate_artifacts", "-k", root, "-e", *NAMES, "/r2/x").ok()
    sros("distribute_key", root, *NAMES, delivered).ok()
    authority = authority_of(root)
    first = release_of(files_of(root), 1, authority)
    with pytest.MonkeyPatch.context() as patch:  # certificates count in seconds
        patch.setattr("sros_tool.cli.common._clock", lambda: moment() + timedelta(hours=1))
        sros("renew", root, "/r1/a").ok()
    renewed = release_of(files_of(root), 2, authority)
    sros("revoke", root, "/r2/x").ok()
    return Home(root, delivered, first, renewed, release_of(files_of(root), 3, authority))
