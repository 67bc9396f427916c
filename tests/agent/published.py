"""A fleet at home that publishes, robots that fetch, and a thief with some of the keys."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from datetime import datetime, timedelta
from pathlib import Path
from typing import Any

import pytest
from tuf.api.metadata import Metadata, MetaFile, Root, Snapshot, TargetFile, Targets, Timestamp

from sros_tool.agent.fetch import FetchError, FetchProblem, fetch_release, pin_root
from sros_tool.keystore.delivery.publish import PublishedFleet, publish
from sros_tool.keystore.delivery.release import Release, release_target
from sros_tool.keystore.delivery.repository import load_signer
from sros_tool.keystore.issuing.authority import Authority, load_authority
from sros_tool.keystore.issuing.keyring import IN_KEYSTORE
from sros_tool.keystore.layout import PERMISSIONS
from sros_tool.keystore.reader import OpenedKeystore
from tests.support.harness import Ended, copy_of, sros

DAY = timedelta(days=1)
LATER = timedelta(minutes=10)


@dataclass
class Home:
    """A keystore with r1, r2 and r5, and its publishing folder; ``now`` is their time."""

    folder: Path
    now: datetime

    @property
    def root(self) -> Path:
        return self.folder / "ks"

    @property
    def pub(self) -> Path:
        return self.folder / "pub"

    def copy(self, folder: Path) -> Home:
        """Return a copy of this home in a new folder."""
        copy_of(self.folder, folder)
        return Home(folder, self.now)

    def run(self, *words: object) -> Ended:
        return sros(*words, cwd=self.folder).ok()

    def publish(self, after: timedelta = LATER, **more: Any) -> PublishedFleet:
        """Publish ``after`` the last time."""
        self.now += after
        return publish(self.root, self.pub, now=self.now, **more)

    def robot(self, name: str = "r1", pinned_at: datetime | None = None) -> Robot:
        """Return a robot that has pinned the first root, and fetched nothing yet."""
        state = self.folder / f"agent{len([*self.folder.glob('agent*')])}"
        state.mkdir()
        root = (self.pub / "metadata/1.root.json").read_bytes()
        pin_root(state, root, now=pinned_at or self.now)
        return Robot(self, state, name)

    def permissions_ca(self) -> Authority:
        """Return the permissions CA of the keystore, with its key."""
        keystore = OpenedKeystore(self.root)
        return load_authority(keystore, PERMISSIONS, keystore.template, IN_KEYSTORE, self.now)

    def kept(self, name: str) -> Path:
        """Return a copy of the publishing folder as it is now."""
        return Path(shutil.copytree(self.pub, self.folder / name))


@dataclass
class Robot:
    """A robot with an agent's folder."""

    home: Home
    state: Path
    name: str

    def fetch(self, source: Path | str | None = None, **more: Any) -> Release | None:
        """Fetch from ``source``, which is the publishing folder of home if None is given."""
        more = {"now": self.home.now, **more}
        return fetch_release(self.state, str(source or self.home.pub), self.name, **more)

    def gets(self, source: Path | str | None = None, **more: Any) -> Release:
        release = self.fetch(source, **more)
        assert release and release.robot == self.name
        return release

    def refuses(
        self, problem: FetchProblem, source: Path | str | None = None, **more: Any
    ) -> FetchError:
        with pytest.raises(FetchError) as refused:
            self.fetch(source, **more)
        assert refused.value.problem is problem, refused.value
        return refused.value


class Thief:
    """Who has stolen the keys of some roles, and controls the folder ``pub``."""

    def __init__(self, home: Home, pub: Path, *roles: str) -> None:
        private = home.root / "private"
        self.home = home
        self.metadata = pub / "metadata"
        self.pub = pub
        self.signers = {
            role: load_signer((private / f"fleet_{role}.pem").read_bytes(), role) for role in roles
        }

    def present(self, name: str) -> Metadata[Any]:
        """Return the latest metadata of a name."""
        if name == "timestamp":
            return Metadata[Timestamp].from_file(str(self.metadata / "timestamp.json"))
        files = self.metadata.glob(f"*.{name}.json")
        latest = max(files, key=lambda file: int(file.name.split(".")[0]))
        return Metadata[Targets].from_file(str(latest))

    def sign(self, name: str, edit: Callable[[Any], object], version: int = 0) -> int:
        """Write a new version of metadata, edited and signed; return its number."""
        metadata = self.present(name)
        edit(metadata.signed)
        metadata.signed.version = version or metadata.signed.version + 1
        metadata.signatures.clear()
        role = name if name in ("snapshot", "timestamp", "root") else "targets"
        metadata.sign(self.signers[role], append=True)
        file = f"{name}.json" if name == "timestamp" else f"{metadata.signed.version}.{name}.json"
        metadata.to_file(str(self.metadata / file))
        return int(metadata.signed.version)

    def lead_to(self, changed: Mapping[str, int], version: int = 0) -> None:
        """Sign a snapshot with other versions of some metadata, and a timestamp that names it."""

        def other(snapshot: Snapshot) -> None:
            snapshot.meta |= {f"{name}.json": MetaFile(number) for name, number in changed.items()}

        self.point_at(self.sign("snapshot", other, version), version)

    def point_at(self, snapshot: int, version: int = 0) -> None:
        """Sign a timestamp that names a version of the snapshot."""

        def other(timestamp: Timestamp) -> None:
            timestamp.snapshot_meta = MetaFile(snapshot)

        self.sign("timestamp", other, version)

    def bin_of(self, robot: str) -> str:
        """Return the name of the bin with a robot's release."""
        delegations = self.present("targets").signed.delegations
        assert delegations and delegations.succinct_roles
        return str(delegations.succinct_roles.get_role_for_target(release_target(robot)))

    def put(self, robot: str, archive: bytes, number: int, *, into: str = "") -> None:
        """Name ``archive`` as the release of a robot in its bin, or in the bin ``into``."""
        path = release_target(robot)
        target = TargetFile.from_data(path, archive, ["sha256"])
        target.unrecognized_fields["custom"] = {"number": number}
        for place in target.get_prefixed_paths():
            (self.pub / "targets" / place).write_bytes(archive)
        name = into or self.bin_of(robot)
        version = self.sign(name, lambda signed: signed.targets.update({path: target}))
        self.lead_to({name: version})

    def archive(self, robot: str) -> tuple[bytes, int]:
        """Return the current archive of a robot, and its number."""
        target = self.present(self.bin_of(robot)).signed.targets[release_target(robot)]
        (path,) = target.get_prefixed_paths()
        return (self.pub / "targets" / path).read_bytes(), target.custom["number"]


ROLES = (Root.type, Targets.type, Snapshot.type, Timestamp.type)
