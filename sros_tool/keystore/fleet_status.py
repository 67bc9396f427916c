"""What is where: what each robot of a fleet last confirmed, compared with what it should have.

A robot should have what an export would give now.  What it has instead is looked up in the ledger,
so an earlier file is known by when it was issued, and another robot's by whose it is.
"""

from __future__ import annotations

import hashlib
import os
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from datetime import datetime, timedelta
from enum import StrEnum
from pathlib import Path
from typing import Annotated, NamedTuple

from sros_tool.errors import SrosError
from sros_tool.fleet.enclaves import Unrecorded, enclaves_of, robot_of, unrecorded_enclaves
from sros_tool.fleet.robots import Fleet, Robot
from sros_tool.folders import Folder
from sros_tool.keystore.confirmation import (
    CONFIRMED_FILES,
    certificate_digests,
    enclave_of,
    last_confirmation,
)
from sros_tool.keystore.fleet import enclaves_of_robot, recorded_fleet
from sros_tool.keystore.layout import (
    CERTIFICATE_FILE,
    CRL_FILE,
    GOVERNANCE_FILE,
    IDENTITY_CA_FILE,
    KEY_FILE,
    PERMISSIONS_CA_FILE,
    PERMISSIONS_FILE,
    REQUIRED_FILES,
    enclave_folder,
    has_enclave,
)
from sros_tool.keystore.ledger import Entry
from sros_tool.keystore.lifecycle.rotation import RotationStage, read_rotation
from sros_tool.keystore.reader import Keystore
from sros_tool.parallel import map_slices
from sros_tool.pki.certificates import digest
from sros_tool.pki.crl import SUPERSEDED
from sros_tool.prometheus import Metric, Sample
from sros_tool.values import NamedKeystore, Words, shows


class State(StrEnum):
    """How a confirmed file compares with the present one, and the worst of a robot's files.

    The order is from good to bad.
    """

    CURRENT = "current"
    NONE = "none"
    """The robot has no enclave in the keystore."""
    EARLIER = "earlier"
    """An earlier file that the keystore issued for the same enclave."""
    DIFFERENT = "different"
    """A file of Zenoh that is not the present one; the ledger does not have earlier ones."""
    MISSING = "missing"
    BROKEN = "broken"
    """The file at home is missing or cannot be read, so no export can be made."""
    NEVER = "never"
    """The robot has confirmed nothing."""
    UNKNOWN = "unknown"
    """A file that the keystore did not issue, as far as its ledger tells."""
    REVOKED = "revoked"
    ANOTHER = "another"
    """A file of an enclave of another robot, or of an enclave of no robot."""


_BADNESS = {state: place for place, state in enumerate(State)}

_KINDS = {
    CERTIFICATE_FILE: "certificate",
    PERMISSIONS_FILE: "permissions",
    GOVERNANCE_FILE: "governance",
    CRL_FILE: "crl",
    IDENTITY_CA_FILE: "identity_ca",
    PERMISSIONS_CA_FILE: "permissions_ca",
}
_ZENOH = "zenoh"
FileKind = Annotated[str, Words((*_KINDS.values(), _ZENOH))]
_AUTHORITIES = ("identity_ca", "permissions_ca")


def _kind_of(path: str) -> str:
    """Return what the file at a path is, such as ``permissions``; all files of Zenoh are one."""
    return _KINDS.get(path.rpartition("/")[2], _ZENOH)


@shows(
    *("path", "kind", "state", "since", "enclave", "robot", "action"),
    null_if_empty=("since", "enclave", "robot"),
)
@dataclass(frozen=True, slots=True)
class ConfirmedFile:
    """A file that is not the one that an export would give now.

    With ``surplus``, the robot should have no such file.
    """

    path: str
    """The path of the file in the keystore."""
    kind: FileKind
    """What the file is."""
    state: State
    """What the robot has instead: an ``earlier`` file of the same enclave; a ``different`` one of
    Zenoh, whose earlier files the ledger does not have; none (``missing``); one that the keystore
    did not issue (``unknown``); a ``revoked`` one; one of ``another`` robot, or of no robot.
    ``broken``: the file at home is missing or cannot be read."""
    since: str = ""
    """When the keystore issued what the robot has, in UTC; null if it is not known."""
    enclave: str = ""
    """The enclave that what the robot has belongs to, if it is another's, or null."""
    robot: str = ""
    """The robot of that enclave, or null."""
    surplus: bool = False

    @property
    def action(self) -> Annotated[str, Words(("deliver", "remove"))]:
        """What has to be done on the robot."""
        return "remove" if self.surplus else "deliver"


@shows(
    *("robot", "state", "enclaves", "revoked", "unrecorded", "sharing_name", "received", "clock"),
    *("stage", "files", "pending", "notes"),
    null_if_empty=("stage",),
)
@dataclass(frozen=True, slots=True)
class RobotStatus:
    """What a robot last confirmed; ``others`` are enclaves that the fleet does not record."""

    robot: str
    """Its name."""
    state: State
    """The worst state of its files; ``never``: it has confirmed nothing; ``none``: it has no
    enclave in the keystore."""
    enclaves: int
    """The number of its enclaves in the keystore."""
    revoked: tuple[str, ...]
    """Its enclaves that were revoked and are not in the keystore, whatever it confirmed."""
    others: Unrecorded
    received: datetime | None
    """When its last confirmation was received, by the clock at home, in UTC, or null."""
    clock: datetime | None
    """The time of its own clock in that confirmation, in UTC, or null."""
    stage: Annotated[str, Words(("unknown", "before", "distribute", "reissue", "complete"))]
    """The stage of a CA rotation that its CA files are of, or null: it has confirmed none.
    ``before``: it does not trust the CA that issues next, or now; ``complete``: it trusts no other
    one."""
    files: Mapping[str, Mapping[State, int]]
    """The number of its files, by kind and state."""
    pending: tuple[ConfirmedFile, ...]
    """The files that are not as at home; empty if it has confirmed nothing."""
    notes: tuple[str, ...]
    """Remarks, as clauses, such as on its clock."""

    @property
    def unrecorded(self) -> tuple[str, ...]:
        """Enclaves in the folder of the robot that the fleet does not record, such as
        ``/r3/spare``; ``sros revoke --robot`` revokes them, too.
        """
        return self.others.below

    @property
    def sharing_name(self) -> tuple[str, ...]:
        """Enclaves elsewhere that the fleet does not record, with the name of the robot as a part
        of the path, such as ``/desk/r3``; ``sros revoke --robot`` leaves them valid and names them.
        """
        return self.others.naming


@shows("keystore", "complete", "stage", "counts", "unassigned", "overdue", "robots")
@dataclass(frozen=True, slots=True)
class FleetStatus:
    """The robots of a fleet, and the stage of the keystore's CA rotation."""

    keystore: NamedKeystore
    stage: Annotated[str, Words(("complete", "distribute", "reissue"))]
    """The stage of the CA rotation of the keystore; ``complete`` if none is under way."""
    robots: tuple[RobotStatus, ...]
    """The robots, sorted by name."""
    unassigned: int
    """The number of enclaves that belong to no robot, of which nothing is known; 0 with --robot."""
    overdue: frozenset[str] = frozenset()
    """The robots whose last confirmation is older than --max-age, sorted by name."""

    @property
    def counts(self) -> Mapping[State, int]:
        """The number of robots by state."""
        counts = Counter(each.state for each in self.robots)
        return {state: counts[state] for state in State if counts[state]}

    @property
    def complete(self) -> bool:
        """Whether every robot that has enclaves confirmed the present files in time: the exit
        status is 0.
        """
        return not self.overdue and all(
            each.state in (State.CURRENT, State.NONE) for each in self.robots
        )

    def with_overdue(self, max_age: timedelta, now: datetime) -> FleetStatus:
        """Return the same with the robots whose last confirmation is older than ``max_age``."""
        late = (
            each.robot
            for each in self.robots
            if each.enclaves and each.received and now - each.received > max_age
        )
        return replace(self, overdue=frozenset(late))


@shows(spread=("status",))
class ComparedFleet(NamedTuple):
    """What each robot of the fleet has, by what it last confirmed."""

    at: datetime
    """When it was compared, in UTC."""
    status: FleetStatus


def fleet_status(keystore: Keystore, names: Sequence[str] = ()) -> FleetStatus:
    """Return what is where, of the robots with these names, or of all.

    Raises:
        KeystoreError: it is no keystore, has no fleet, or enclaves of it may be missing.
        DocumentError: the fleet has no such robot.
    """
    root, fleet = keystore.root, recorded_fleet(keystore)
    robots = [fleet.robot(name) for name in names] or list(fleet.robots.values())
    compared = _compare_robots(root, fleet, robots)
    stages = _Stages(keystore)
    known = _Known(keystore, fleet, compared)
    existing = keystore.names
    unassigned = 0 if names else len(existing) - sum(len(each.enclaves) for each in compared)
    unrecorded = unrecorded_enclaves(fleet, existing, {each.name for each in robots})
    found = tuple(_status(each, known, stages, unrecorded[each.robot.name]) for each in compared)
    return FleetStatus(root, stages.at_home, found, unassigned)


# ── comparing a confirmation with the files at home ────────────────────────────────────────


class _Difference(NamedTuple):
    """A file that is not as at home.

    ``confirmed`` is the SHA-256 of what the robot has, or "": it has none; ``certificates`` are
    those in it.  ``at_home`` says whether an export would give another one, None that the file at
    home cannot be read.
    """

    path: str
    confirmed: str
    certificates: tuple[str, ...]
    at_home: bool | None
    own: bool


class _ComparedRobot(NamedTuple):
    """What a robot confirmed, compared with the files of its enclaves at home.

    ``authorities`` has, by the kind of a CA file, the certificates in the files of each enclave as
    the robot confirmed them.  ``current`` counts the files that are as at home, by kind.
    """

    robot: Robot
    enclaves: tuple[str, ...]
    received: datetime | None
    clock: datetime | None
    current: Mapping[str, int]
    different: tuple[_Difference, ...]
    authorities: Mapping[str, frozenset[tuple[str, ...]]]
    notes: tuple[str, ...]


def _compare_robots(root: Path, fleet: Fleet, robots: Sequence[Robot]) -> list[_ComparedRobot]:
    """Return what each robot confirmed, compared with the files at home, on all cores."""

    def work(part: Sequence[Robot]) -> list[_ComparedRobot]:
        with Folder(root) as folder:
            at_home = _Home(root, folder)
            return [_compare(root, fleet, robot, at_home) for robot in part]

    return [each for _, part in map_slices(robots, work) for each in part]


def _compare(root: Path, fleet: Fleet, robot: Robot, at_home: _Home) -> _ComparedRobot:
    enclaves = enclaves_of_robot(root, fleet, robot)
    notes: list[str] = []
    received = None
    try:
        received = last_confirmation(root, robot.name)
    except SrosError as error:
        notes.append(f"its last confirmation cannot be used: {error}")
    if received is None:
        return _ComparedRobot(robot, enclaves, None, None, {}, (), {}, tuple(notes))
    if note := received.clock_note():
        notes.append(note)
    confirmed = received.confirmation
    current: Counter[str] = Counter()
    different: list[_Difference] = []
    authorities: dict[str, set[tuple[str, ...]]] = {kind: set() for kind in _AUTHORITIES}
    left = set(confirmed.files)
    for name in enclaves:
        for path, file in at_home.files_of(name).items():
            left.discard(path)
            sha256, kind = confirmed.files.get(path, ""), _kind_of(path)
            if file and sha256 == file.sha256:
                current[kind] += 1
                certificates = file.certificates
            else:
                certificates = confirmed.certificates.get(path, ())
                there = None if file is None else True
                different.append(_Difference(path, sha256, certificates, there, own=True))
            if kind in authorities:
                authorities[kind].add(certificates)
    folders = {enclave_folder(name) for name in enclaves}
    for path in sorted(left):
        certificates = confirmed.certificates.get(path, ())
        own = path.rpartition("/")[0] in folders
        different.append(_Difference(path, confirmed.files[path], certificates, False, own))
    return _ComparedRobot(
        robot,
        enclaves,
        received.time,
        confirmed.time,
        current,
        tuple(different),
        {kind: frozenset(found) for kind, found in authorities.items()},
        tuple(notes),
    )


class _FileAtHome(NamedTuple):
    sha256: str
    certificates: tuple[str, ...]


class _Home:
    """The digests of the files of enclaves; a file that many enclaves share is read once."""

    def __init__(self, root: Path, folder: Folder) -> None:
        self._root = root
        self._folder = folder
        self._shared: dict[tuple[str, str], _FileAtHome | None] = {}

    def files_of(self, name: str) -> Mapping[str, _FileAtHome | None]:
        """Map the paths of the files that an export has, without the key, to their digests.

        A file that is missing although every export has it, or that cannot be read, is None.
        """
        folder = enclave_folder(name)
        found: dict[str, _FileAtHome | None] = dict.fromkeys(
            f"{folder}/{file}" for file in REQUIRED_FILES if file != KEY_FILE
        )
        up = "../" * folder.count("/")
        with suppress(OSError), os.scandir(f"{self._root}/{folder}") as entries:
            for each in entries:
                if each.name in CONFIRMED_FILES:
                    path = f"{folder}/{each.name}"
                    found[path] = self._linked(path, up) if each.is_symlink() else self._file(path)
        return found

    def _linked(self, path: str, up: str) -> _FileAtHome | None:
        """Return what a link leads to; ``up`` leads from it to the folder of all enclaves."""
        with suppress(SrosError, OSError):
            link = self._folder.link_target(path) or ""
            if not link.startswith(up):
                return self._read(path, self._folder.read_inside)
            place = (up, link)  # which is the same file for every enclave of this depth
            if place not in self._shared:
                self._shared[place] = self._read(path, self._folder.read_inside)
            return self._shared[place]
        return None

    def _file(self, path: str) -> _FileAtHome | None:
        return self._read(path, self._folder.read)

    def _read(self, path: str, read: Callable[[str], bytes]) -> _FileAtHome | None:
        try:
            data = read(path)
        except (SrosError, OSError):
            return None
        is_bundle = _kind_of(path) in _AUTHORITIES
        certificates = certificate_digests(data) if is_bundle else ()
        return _FileAtHome(hashlib.sha256(data).hexdigest(), certificates)


# ── what a robot has instead ───────────────────────────────────────────────────────────────


class _Known:
    """What the ledger tells of files that are not the present ones."""

    def __init__(
        self, keystore: Keystore, fleet: Fleet, compared: Sequence[_ComparedRobot]
    ) -> None:
        self._root = keystore.root
        self._fleet = fleet
        self._issued: dict[str, Entry] = {}
        self._revoked_serials: set[str] = set()
        self._revoked: set[str] = set()
        different = [each for robot in compared for each in robot.different if each.confirmed]
        wanted = {each.confirmed for each in different}
        wanted.update(one for each in different for one in each.certificates)
        ledger = keystore.ledger if wanted else keystore.ledger_with("what", "revocation")
        for entry in ledger.entries:
            if entry.sha256 in wanted:
                self._issued.setdefault(entry.sha256, entry)
            if entry.what == "certificate":
                self._revoked.discard(entry.enclave)
            elif entry.what == "revocation":
                self._revoked_serials.add(entry.serial)
                if entry.reason != SUPERSEDED:
                    self._revoked.add(entry.enclave)
        robots = {each.robot.name for each in compared}
        self._unrecorded = unrecorded_enclaves(fleet, self._revoked, robots)

    def revoked(self, robot: Robot) -> tuple[str, ...]:
        """Return the enclaves of a robot that were revoked and are not in the keystore."""
        if not self._revoked:
            return ()
        names = {name for name in enclaves_of(self._fleet, robot) if name in self._revoked}
        names.update(self._unrecorded[robot.name].below)
        return tuple(sorted(name for name in names if not has_enclave(self._root, name)))

    def file(self, robot: Robot, each: _Difference) -> ConfirmedFile:
        """Return what a robot has instead of the file at home."""
        kind, name = _kind_of(each.path), enclave_of(each.path)
        state, since, owner = self._identify(each, kind, name)
        if not each.own and state is not State.REVOKED:
            if name in self._revoked and not has_enclave(self._root, name):
                state = State.REVOKED
            elif has_enclave(self._root, name) or robot_of(self._fleet, name) not in (None, robot):
                state, owner = State.ANOTHER, name
        whose = robot_of(self._fleet, owner) if owner else None
        return ConfirmedFile(
            each.path,
            kind,
            state,
            since,
            owner,
            whose.name if whose else "",
            surplus=each.at_home is False,
        )

    def _identify(self, each: _Difference, kind: str, name: str) -> tuple[State, str, str]:
        """Return the state of a file, when it was issued, and the enclave that it is of instead."""
        if each.at_home is None:
            return State.BROKEN, "", ""
        if not each.confirmed:
            return State.MISSING, "", ""
        if kind == _ZENOH:
            return State.DIFFERENT, "", ""
        if kind in _AUTHORITIES:
            entries = [self._issued.get(one) for one in each.certificates]
            if not entries or not all(one and one.what == "ca" for one in entries):
                return State.UNKNOWN, "", ""
            return State.EARLIER, max(one.time for one in entries if one), ""
        sha256 = each.confirmed
        if kind == "certificate":
            sha256 = each.certificates[0] if each.certificates else ""
        entry = self._issued.get(sha256)
        if entry is None or entry.what != kind:
            return State.UNKNOWN, "", ""
        if entry.enclave and entry.enclave != name:
            return State.ANOTHER, entry.time, entry.enclave
        if entry.serial and entry.serial in self._revoked_serials:
            return State.REVOKED, entry.time, ""
        return State.EARLIER, entry.time, ""


def _status(
    compared: _ComparedRobot, known: _Known, stages: _Stages, unrecorded: Unrecorded
) -> RobotStatus:
    different = tuple(known.file(compared.robot, each) for each in compared.different)
    counts: dict[str, Counter[State]] = {}
    for kind, number in compared.current.items():
        counts.setdefault(kind, Counter())[State.CURRENT] = number
    for each in different:
        counts.setdefault(each.kind, Counter())[each.state] += 1
    if different:
        state = max((each.state for each in different), key=_BADNESS.__getitem__)
    elif not compared.enclaves:
        state = State.NONE
    else:
        state = State.NEVER if compared.received is None else State.CURRENT
    return RobotStatus(
        compared.robot.name,
        state,
        len(compared.enclaves),
        known.revoked(compared.robot),
        unrecorded,
        compared.received,
        compared.clock,
        stages.of(compared),
        {kind: counts[kind] for kind in (*_KINDS.values(), _ZENOH) if kind in counts},
        different,
        compared.notes,
    )


# ── the stages of a rotation ───────────────────────────────────────────────────────────────


class _Stages:
    """The stage of a rotation that the CA files of a robot are of."""

    BEFORE, COMPLETE, UNKNOWN = "before", "complete", "unknown"
    ORDER = (UNKNOWN, BEFORE, "distribute", "reissue", COMPLETE)

    def __init__(self, keystore: Keystore) -> None:
        rotation = read_rotation(keystore)
        is_complete = rotation.stage is RotationStage.NONE
        self.at_home = self.COMPLETE if is_complete else rotation.stage.value
        self._new: dict[str, str] = {}
        self._at_home: dict[str, tuple[tuple[str, ...], str]] = {}
        for file, roles in keystore.authority_files.items():
            certificates = tuple(map(digest, keystore.certificates_of(file)))
            new = [each.new for each in rotation.replacements if each.file == file]
            for kind in (f"{role}_ca" for role in roles):
                self._new[kind] = new[0] if new else certificates[0]
                self._at_home[kind] = certificates, self.at_home if new else self.COMPLETE

    def of(self, compared: _ComparedRobot) -> str:
        """Return the stage of the CA file that is behind; "" if the robot confirmed none."""
        stages = {
            self._stage(kind, certificates)
            for kind, files in compared.authorities.items()
            for certificates in files
        }
        return min(stages, key=self.ORDER.index, default="")

    def _stage(self, kind: str, certificates: tuple[str, ...]) -> str:
        if certificates == self._at_home[kind][0]:
            return self._at_home[kind][1]
        if not certificates:
            return self.UNKNOWN
        new = self._new[kind]
        if new not in certificates:
            return self.BEFORE
        if len(certificates) == 1:
            return self.COMPLETE
        return "reissue" if certificates[0] == new else "distribute"


# ── metrics ───────────────────────────────────────────────────────────────────────────────


def fleet_metrics(status: FleetStatus, *, now: datetime) -> tuple[Metric, ...]:
    """Return the metrics of a fleet; ``now`` is the moment of the comparison."""
    place = {"keystore": str(status.keystore.absolute())}
    robots = [({**place, "robot": each.robot}, each) for each in status.robots]
    return (
        Metric(
            "sros_fleet_compared_timestamp_seconds",
            "When the fleet was compared with its keystore, in seconds since 1970.",
            (Sample(int(now.timestamp()), place),),
        ),
        Metric(
            "sros_fleet_robots",
            f"Number of robots by state ({', '.join(State)}).",
            tuple(
                Sample(status.counts.get(state, 0), {**place, "state": state}) for state in State
            ),
        ),
        Metric(
            "sros_fleet_robot_state",
            "The state of each robot, with the value 1.",
            tuple(Sample(1, {**labels, "state": each.state}) for labels, each in robots),
        ),
        Metric(
            "sros_fleet_confirmed_timestamp_seconds",
            "When the last confirmation of a robot was received, in seconds since 1970.",
            tuple(
                Sample(int(each.received.timestamp()), labels)
                for labels, each in robots
                if each.received
            ),
        ),
        Metric(
            "sros_fleet_clock_ahead_seconds",
            "How far the clock of a robot was ahead when its confirmation was received.",
            tuple(
                Sample(int((each.clock - each.received).total_seconds()), labels)
                for labels, each in robots
                if each.clock and each.received
            ),
        ),
        Metric(
            "sros_fleet_pending_files",
            "Number of files by kind that a robot has to get or to lose; only of robots that "
            "confirmed something.",
            tuple(
                Sample(
                    sum(number for state, number in states.items() if state is not State.CURRENT),
                    {**labels, "kind": kind},
                )
                for labels, each in robots
                for kind, states in each.files.items()
            ),
        ),
    )
