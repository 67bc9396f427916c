"""The metadata of The Update Framework (TUF) in a publishing folder: reading and writing it.

The top-level targets role delegates to bins, each with the releases of about 32 robots, so that a
robot transfers little.  All metadata files except the timestamp have their version in the name and
never change.  Robots read the timestamp first, so it is written last: if writing is interrupted,
robots still find the earlier metadata.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import datetime
from math import ceil, log2
from pathlib import Path
from typing import NamedTuple, TypeVar

from cryptography.exceptions import UnsupportedAlgorithm
from cryptography.hazmat.primitives import serialization
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
from securesystemslib.signer import CryptoSigner
from tuf.api.exceptions import RepositoryError
from tuf.api.metadata import (
    Delegations,
    Metadata,
    MetaFile,
    Root,
    Snapshot,
    SuccinctRoles,
    TargetFile,
    Targets,
    Timestamp,
)
from tuf.api.serialization.json import JSONSerializer

from sros_tool.errors import DocumentError, KeystoreError, PkiError, SrosError
from sros_tool.folders import Folder
from sros_tool.keystore.delivery.published import (
    BEGIN_AGAIN,
    MOST_NUMBER,
    MetadataExpiry,
    PublishedRelease,
    check_positive_number,
)
from sros_tool.keystore.delivery.release import release_target
from sros_tool.wording import capitalized, enumerated
from sros_tool.xml import read_bytes

_ROOT, _TARGETS, _SNAPSHOT, _TIMESTAMP = Root.type, Targets.type, Snapshot.type, Timestamp.type
RENEWED_ALONE = frozenset({_TIMESTAMP, _SNAPSHOT})
"""The metadata that is renewed even if nothing new is published."""
_METADATA = "metadata"
"""The folder of the metadata in a publishing folder."""
_BINS = "robots"
_ROBOTS_PER_BIN = 32
_MOST_BYTES = 8 * 1024 * 1024

_Content = TypeVar("_Content", Root, Targets, Snapshot, Timestamp)


# ── keys ───────────────────────────────────────────────────────────────────────────────────


def new_key() -> bytes:
    """Return a new Ed25519 key (PEM, PKCS #8)."""
    return Ed25519PrivateKey.generate().private_bytes(
        serialization.Encoding.PEM,
        serialization.PrivateFormat.PKCS8,
        serialization.NoEncryption(),
    )


def load_signer(data: bytes, label: str) -> CryptoSigner:
    """Return a signer for an Ed25519 key (PEM); ``label`` names the file of the key in errors."""
    try:
        key = serialization.load_pem_private_key(data, None)
    except (ValueError, TypeError, UnsupportedAlgorithm) as error:
        raise PkiError(f"{label} is not a private key, or has a passphrase") from error
    if not isinstance(key, Ed25519PrivateKey):
        raise PkiError(f"{label} is not an Ed25519 key", "", "Name the key that sros made.")
    return CryptoSigner(key)


def lost_key_remedy(*roles: str) -> str:
    """Return the remedy for lost keys of roles, as a sentence."""
    options = " ".join(f"--rotate-key {role}" for role in roles)
    what, other = ("it", "another") if len(roles) == 1 else ("them", "others")
    return f"Restore {what} from a backup, or make {other} with {options} of `sros fleet publish`."


_REMEDY_ROOT_KEY = (
    "Name the right file with --root-key. If a rotation of this key was interrupted, the right "
    "file is FILE.new, next to the earlier file."
)


# ── root ───────────────────────────────────────────────────────────────────────────────────


class Roots:
    """The versions of the root metadata, oldest first; the keys of each version sign the next one.

    A robot that has any version can verify the last one.
    """

    def __init__(self, documents: Sequence[Mapping[str, object]] = ()) -> None:
        """Read the versions from JSON values.

        Raises:
            DocumentError: the values are not a chain of root metadata.
        """
        self.versions: list[Metadata[Root]] = []
        self._later_in: Path | None = None
        try:
            for number, document in enumerate(documents, 1):
                version = Metadata[Root].from_dict(dict(document))
                if not isinstance(version.signed, Root) or version.signed.version != number:
                    raise RepositoryError("a version is missing")
                for signer in (*self.versions[-1:], version):
                    _verify(signer.signed, _ROOT, version)
                self.versions.append(version)
        except (RepositoryError, ValueError, KeyError, TypeError, AttributeError) as error:
            raise DocumentError("it is not a chain of root metadata", f"{error}.") from error

    def add_later_versions(self, folder: Path) -> None:
        """Add later versions in a publishing folder, verified by the last version's keys.

        A keystore that was restored from a backup does not have these versions, but robots do.
        """
        while self.versions:
            path = folder / _METADATA / f"{self.last.version + 1}.{_ROOT}.json"
            try:
                document = Metadata[Root].from_bytes(read_bytes(path, "root metadata")).to_dict()
                self.versions = Roots([*self.as_json(), document]).versions
                self._later_in = folder
            except (SrosError, RepositoryError, ValueError, KeyError, TypeError, AttributeError):
                return

    @property
    def last(self) -> Root:
        """The root metadata of the last version."""
        return self.versions[-1].signed

    def as_json(self) -> list[dict[str, object]]:
        """Return the JSON values of all versions."""
        return [version.to_dict() for version in self.versions]

    def files(self) -> Iterator[tuple[str, bytes]]:
        """Yield the path in the publishing folder and the content of each version."""
        for version in self.versions:
            yield f"{_METADATA}/{version.signed.version}.{_ROOT}.json", _metadata_bytes(version)

    def altered_in(self, folder: Folder, *, is_complete: bool) -> list[str]:
        """Return the paths of root files in a publishing folder that are not as in these versions.

        Robots read the next version until one is missing, so a file after the last version counts.
        Missing files count if ``is_complete`` is set.
        """
        paths = [
            path
            for path, data in self.files()
            if (is_complete or folder.state(path)) and not has_file(folder, path, data)
        ]
        after_last = self.next_path()
        return [*paths, after_last] if folder.state(after_last) else paths

    def next_path(self) -> str:
        """Return the path in the publishing folder of the version after the last one."""
        number = self.last.version if self.versions else 0
        return f"{_METADATA}/{number + 1}.{_ROOT}.json"

    def add(
        self, signers: Mapping[str, CryptoSigner], keys: Sequence[CryptoSigner], expires: datetime
    ) -> None:
        """Add a version that names the keys of ``signers``, by role, and is signed by ``keys``."""
        number = self.last.version + 1 if self.versions else 1
        root = Root(version=number, expires=expires, consistent_snapshot=True)
        for role, signer in signers.items():
            root.add_key(signer.public_key, role)
        version = Metadata(root)
        for key in keys:
            version.sign(key, append=True)
        self.versions.append(version)

    def has_key(self, role: str, signer: CryptoSigner) -> bool:
        """Return whether the current root metadata names the key of ``signer`` for a role."""
        return signer.public_key.keyid in self.last.roles[role].keyids

    def check_signers(self, signers: Mapping[str, tuple[CryptoSigner, Path]]) -> None:
        """Raise `KeystoreError` unless each signer, read from its path, has the key of its role."""
        wrong = [role for role, (signer, _) in signers.items() if not self.has_key(role, signer)]
        if wrong:
            which = enumerated([f"'{signers[role][1]}' is not the {role} key" for role in wrong])
            if self._later_in and _ROOT not in wrong:
                raise KeystoreError(
                    f"{which} with which '{self._later_in}' was published last",
                    "A later copy of this keystore replaced keys there, and robots would refuse "
                    "the signatures of this copy.",
                    "If the keystore was moved to another machine, publish only there, and remove "
                    "this copy. If this keystore was restored from a backup, see "
                    f"docs/howto/keystore_is_lost.md. {lost_key_remedy(*wrong)}",
                )
            raise KeystoreError(
                f"{which} with which this keystore publishes",
                "Robots would refuse the signatures.",
                _REMEDY_ROOT_KEY if _ROOT in wrong else lost_key_remedy(*wrong),
            )

    def verify(
        self, role: str, metadata: Metadata[Timestamp] | Metadata[Snapshot] | Metadata[Targets]
    ) -> None:
        """Raise `RepositoryError` unless the keys of some root version signed ``metadata``."""
        for version in reversed(self.versions):
            if _is_signed(version.signed, role, metadata):
                return
        raise RepositoryError(f"no root metadata names the keys that signed {role}")


def has_file(folder: Folder, path: str, data: bytes) -> bool:
    """Return whether a regular file, not a link, with this content is at ``path``."""
    try:
        return folder.read(path, max_bytes=_MOST_BYTES) == data
    except (SrosError, OSError):
        return False


def _verify(
    delegator: Root | Targets,
    role: str,
    metadata: Metadata[Root] | Metadata[Timestamp] | Metadata[Snapshot] | Metadata[Targets],
) -> None:
    delegator.verify_delegate(role, metadata.signed_bytes, metadata.signatures)


def _is_signed(
    delegator: Root | Targets,
    role: str,
    metadata: Metadata[Timestamp] | Metadata[Snapshot] | Metadata[Targets],
) -> bool:
    try:
        _verify(delegator, role, metadata)
    except (RepositoryError, ValueError):
        return False
    return True


# ── present metadata ───────────────────────────────────────────────────────────────────────


@dataclass
class PresentMetadata:
    """The metadata in a publishing folder that its timestamp names; empty without a timestamp."""

    timestamp: Metadata[Timestamp] | None = None
    snapshot: Metadata[Snapshot] | None = None
    snapshot_file: bytes = b""
    targets: Metadata[Targets] | None = None
    bins: dict[str, Metadata[Targets]] = field(default_factory=dict)

    def versions(self) -> dict[str, int]:
        """Map the names of all metadata to versions."""
        if not (self.timestamp and self.snapshot):
            return {}
        parts = {_TIMESTAMP: self.timestamp.signed.version, _SNAPSHOT: self.snapshot.signed.version}
        meta = self.snapshot.signed.meta.items()
        return parts | {name.removesuffix(".json"): file.version for name, file in meta}

    def releases(self) -> dict[str, PublishedRelease]:
        """Map robots to their releases."""
        begin, end = release_target("*").split("*")
        return {
            path.removeprefix(begin).removesuffix(end): PublishedRelease(
                target.custom["number"], target.hashes["sha256"], target.length
            ).checked()
            for bin_metadata in self.bins.values()
            for path, target in bin_metadata.signed.targets.items()
        }

    def follows(self, root: Root) -> bool:
        """Return whether a robot that has ``root`` accepts the metadata."""
        parts = ((_TIMESTAMP, self.timestamp), (_SNAPSHOT, self.snapshot), (_TARGETS, self.targets))
        return all(part is not None and _is_signed(root, role, part) for role, part in parts)


def read_present(folder: Path, roots: Roots) -> PresentMetadata:
    """Return the metadata in a publishing folder, verified by any version of the root.

    Raises:
        KeystoreError: the folder has metadata that the keys of this keystore did not sign, or
            damaged metadata.
    """
    try:
        with Folder(folder) as opened:
            if not opened.is_folder(_METADATA) or not opened.state(
                f"{_METADATA}/{_TIMESTAMP}.json"
            ):
                return PresentMetadata()
            return _read_present(opened, roots)
    except FileNotFoundError as error:
        if not folder.exists():
            return PresentMetadata()
        raise KeystoreError(
            f"'{error.filename}', which robots fetch, is missing",
            "The metadata that the keystore wrote names this file.",
            "Copy the file back. If the keystore was restored from a backup, first follow "
            f"docs/howto/keystore_is_lost.md. If the file is lost, "
            f"{_damaged_metadata_remedy(folder)}.",
        ) from error
    except OSError as error:
        raise KeystoreError(
            f"the metadata in '{folder}' cannot be read",
            f"'{error.filename}': {error.strerror}.",
            "Make the folder and its files accessible to the user who publishes. If a file is "
            f"damaged, {_damaged_metadata_remedy(folder)}.",
        ) from error
    except (RepositoryError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise _foreign_folder_error(folder, str(error)) from error


def _foreign_folder_error(folder: Path, why: str) -> KeystoreError:
    return KeystoreError(
        f"'{folder}' has metadata that this keystore did not write",
        f"{capitalized(why).removesuffix('.')}.",
        "If the keystore was restored from a backup, first follow docs/howto/keystore_is_lost.md. "
        "If this keystore published to this folder before, the metadata was changed or damaged: "
        "find out who else can write to the folder, "
        f"{_damaged_metadata_remedy(folder)}. Otherwise, name another folder.",
    )


def _damaged_metadata_remedy(folder: Path) -> str:
    """Return the remedy for damaged metadata, as a clause."""
    return (
        f"remove '{folder / _METADATA}', and publish again with --new-folder of "
        "`sros fleet publish`"
    )


def _read_present(folder: Folder, roots: Roots) -> PresentMetadata:
    timestamp = _read_metadata(folder, Timestamp, _TIMESTAMP)
    roots.verify(_TIMESTAMP, timestamp)
    described = timestamp.signed.snapshot_meta
    snapshot = _read_metadata(folder, Snapshot, _SNAPSHOT, described.version)
    file = folder.read(f"{_METADATA}/{described.version}.{_SNAPSHOT}.json", max_bytes=_MOST_BYTES)
    described.verify_length_and_hashes(file)
    roots.verify(_SNAPSHOT, snapshot)
    meta = snapshot.signed.meta
    targets = _read_metadata(folder, Targets, _TARGETS, meta[f"{_TARGETS}.json"].version)
    roots.verify(_TARGETS, targets)
    bins = {}
    roles = targets.signed.delegations and targets.signed.delegations.succinct_roles
    for name in roles.get_roles() if roles else ():
        bins[name] = _read_metadata(folder, Targets, name, meta[f"{name}.json"].version)
        _verify(targets.signed, name, bins[name])
    present = PresentMetadata(timestamp, snapshot, file, targets, bins)
    for version in present.versions().values():
        check_positive_number(version)
    present.releases()
    return present


def _read_metadata(
    folder: Folder, kind: type[_Content], role: str, version: int | None = None
) -> Metadata[_Content]:
    name = f"{role}.json" if version is None else f"{version}.{role}.json"
    data = folder.read(f"{_METADATA}/{name}", max_bytes=_MOST_BYTES)
    metadata = Metadata[_Content].from_bytes(data)
    if not isinstance(metadata.signed, kind):
        raise RepositoryError(f"{name} has metadata of another kind than {role}")
    return metadata


# ── new metadata ───────────────────────────────────────────────────────────────────────────


class NewMetadata(NamedTuple):
    """New metadata: the files in the order in which to write them.

    ``versions`` and ``expires`` map the names of all metadata, changed or not, to version and
    expiry.
    """

    files: Sequence[tuple[str, bytes]]
    versions: Mapping[str, int]
    expires: Mapping[str, datetime]


class MetadataComposer:
    """A composer of the metadata for releases, which keeps existing metadata that still fits.

    ``signers`` has the signers of each role.  While a key is rotated, this includes the previous
    signer, because robots that do not have the new root yet demand its signature.
    """

    def __init__(
        self,
        present: PresentMetadata,
        signers: Mapping[str, Sequence[CryptoSigner]],
        *,
        known: Mapping[str, int],
        least: int = 0,
        expiry: MetadataExpiry,
        now: datetime,
    ) -> None:
        """Prepare to compose.

        Args:
            present: the metadata in the publishing folder.
            signers: the signers of each role, the current one first.
            known: the versions that were published before, as far as the keystore knows.
            least: a number that all versions must exceed, because robots may have seen higher
                versions than the keystore knows.
            expiry: how long new metadata is valid.
            now: the current time.
        """
        self._least = least
        self._present = present
        self._signers = signers
        self._now = now.replace(microsecond=0)
        self._expiry = expiry
        versions = present.versions()
        names = {*versions, *known}
        self.versions = {name: max(versions.get(name, 0), known.get(name, 0)) for name in names}
        self._files: list[tuple[str, bytes]] = []
        self._expires: dict[str, datetime] = {}

    def compose(self, releases: Mapping[str, PublishedRelease]) -> NewMetadata:
        """Return the metadata for ``releases``, which maps robots to releases."""
        roles = self._roles(len(releases))
        targets: dict[str, dict[str, TargetFile]] = {name: {} for name in roles.get_roles()}
        for robot, release in sorted(releases.items()):
            path = release_target(robot)
            custom = {"custom": {"number": release.number}}
            hashes = {"sha256": release.sha256}
            targets[roles.get_role_for_target(path)][path] = TargetFile(
                release.length, hashes, path, custom
            )
        before = self._present.targets
        key = self._signers[_TARGETS][0].public_key
        for name, content in targets.items():
            old = self._present.bins.get(name)
            same_key = old is not None and key.keyid in old.signatures
            if same_key and old and old.signed.targets == content and self._is_current(name, old):
                self._expires[name] = old.signed.expires
            else:
                self._add(name, Targets(targets=content), self._signers[_TARGETS][:1])
        delegations = Delegations({key.keyid: key}, succinct_roles=roles)
        if before and before.signed.delegations == delegations and self._can_be_kept(before):
            self._expires[_TARGETS] = before.signed.expires
        else:
            self._add(_TARGETS, Targets(delegations=delegations), self._signers[_TARGETS])
        self._add_snapshot()
        return NewMetadata(self._files, self.versions, self._expires)

    def _roles(self, robots: int) -> SuccinctRoles:
        """Return the bins (TUF); their number is a power of two, and grows with the fleet.

        The number only changes when four times as many bins are needed.
        """
        bits = max(1, ceil(log2(max(1, robots / _ROBOTS_PER_BIN))))
        before = self._present.targets and self._present.targets.signed.delegations
        if before and before.succinct_roles:
            kept = before.succinct_roles.bit_length
            bits = bits if bits > kept + 1 else kept
        return SuccinctRoles([self._signers[_TARGETS][0].public_key.keyid], 1, bits, _BINS)

    def _is_current(self, name: str, metadata: Metadata[_Content]) -> bool:
        """Return whether metadata is the last version of ``name``, with half of its validity left.

        Versions up to ``least`` are too low.
        The last version can be in another folder, if the keystore published there since.
        """
        signed = metadata.signed
        lasts = signed.expires - self._now > self._expiry.lifetime(signed.type) / 2
        return lasts and self._least < signed.version == self.versions[name]

    def _can_be_kept(self, metadata: Metadata[_Content]) -> bool:
        """Return whether top-level metadata can stay: it is current, and each signer signed it."""
        signers = self._signers[metadata.signed.type]
        signed = all(signer.public_key.keyid in metadata.signatures for signer in signers)
        return signed and self._is_current(metadata.signed.type, metadata)

    def _add(self, name: str, content: _Content, signers: Sequence[CryptoSigner]) -> None:
        """Add a file with a new version of the metadata ``name``."""
        content.version = self.versions[name] = max(self.versions.get(name, 0), self._least) + 1
        if content.version > MOST_NUMBER:
            raise KeystoreError(
                f"the version {content.version} of {name}.json is too high",
                "Somebody with its key has used up the version numbers.",
                BEGIN_AGAIN,
            )
        content.expires = self._now + self._expiry.lifetime(name)
        metadata = Metadata(content)
        for signer in signers:
            metadata.sign(signer, append=True)
        file = f"{name}.json" if name == _TIMESTAMP else f"{content.version}.{name}.json"
        self._files.append((f"{_METADATA}/{file}", _metadata_bytes(metadata)))
        self._expires[name] = content.expires

    def _add_snapshot(self) -> None:
        """Add the snapshot if it changes, and always a new timestamp."""
        parts = sorted(self.versions.keys() - {_TIMESTAMP, _SNAPSHOT})
        # Names of unused bins stay, because robots refuse a snapshot in which a name is missing, or
        # has a lower version.
        for name in parts:
            if self._least and name not in self._expires:
                self.versions[name] = max(self.versions[name], self._least + 1)
        meta = {f"{name}.json": MetaFile(self.versions[name]) for name in parts}
        before = self._present.snapshot
        if before and before.signed.meta == meta and self._can_be_kept(before):
            self._expires[_SNAPSHOT] = before.signed.expires
            data = self._present.snapshot_file
        else:
            self._add(_SNAPSHOT, Snapshot(meta=meta), self._signers[_SNAPSHOT])
            data = self._files[-1][1]
        described = MetaFile.from_data(self.versions[_SNAPSHOT], data, ["sha256"])
        self._add(_TIMESTAMP, Timestamp(snapshot_meta=described), self._signers[_TIMESTAMP])


def _metadata_bytes(metadata: Metadata[_Content]) -> bytes:
    return metadata.to_bytes(JSONSerializer(compact=True))
