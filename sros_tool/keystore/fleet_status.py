"""The deployment status of a fleet: the robots' last confirmations, compared with the keystore.

A robot should have the files that an export would contain now.  The ledger shows when any other
file was issued, and to which enclave the file belongs.
"""

from __future__ import annotations

import hashlib
import os
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime, timedelta
from enum import StrEnum
from functools import cached_property
from itertools import chain
from shlex import quote
from typing import Annotated, NamedTuple

from sros_tool.errors import SrosError
from sros_tool.fleet.robots import (
    Fleet,
    Robot,
    UnrecordedEnclaves,
    enclaves_of,
    robot_of,
    unrecorded_enclaves,
)
from sros_tool.folders import Folder
from sros_tool.keystore.confirmation import (
    CONFIRMED_FILES,
    EXPIRED_METADATA,
    LOW_SEQUENCE,
    NOT_IN_LEDGER,
    OF_OTHER_CA,
    Confirmation,
    ReceivedConfirmation,
    RefusedMessage,
    RobotClock,
    RobotDds,
    RunningFiles,
    certificate_digests,
    concerns_key,
    enclave_of,
    is_mended,
    is_unusable,
    last_confirmation,
    problem_rank,
    refusals,
    shows_old_copy,
)
from sros_tool.keystore.delivery.published import altered_lately, read_published, unseen_clause
from sros_tool.keystore.fleet import (
    enclaves_of_robot,
    fleet_edits_clause,
    left_enclaves,
    recorded_fleet,
)
from sros_tool.keystore.known_keys import KnownKeys, other_keys_remedy, restored_at
from sros_tool.keystore.layout import (
    CERTIFICATE_FILE,
    CRL,
    CRL_FILE,
    GOVERNANCE_FILE,
    IDENTITY_CA_FILE,
    KEY_FILE,
    PERMISSIONS,
    PERMISSIONS_CA_FILE,
    PERMISSIONS_FILE,
    REQUIRED_FILES,
    enclave_folder,
    enclave_path,
    key_on_robot,
)
from sros_tool.keystore.ledger import SAME_KEY, Entry, clock_behind_clause
from sros_tool.keystore.lifecycle.rotation import RotationStage, read_rotation
from sros_tool.keystore.reader import OpenedKeystore
from sros_tool.parallel import map_slices
from sros_tool.pki.certificates import digest
from sros_tool.pki.crl import SUPERSEDED
from sros_tool.validity import Window, iso, parse_iso
from sros_tool.values import NamedKeystore, Words, shows
from sros_tool.wording import first_few


class State(StrEnum):
    """State of a robot's file, compared with the keystore.

    The state of a robot is the worst state of its files.  The order of the members is from good to
    bad.
    """

    CURRENT = "current"
    NONE = "none"
    """The robot has no enclave in the keystore."""
    RESTART = "restart"
    """The robot has the current files, but some processes still run with earlier ones."""
    UNUSABLE = "unusable"
    """The robot has the current files, but reports that no process could start in an enclave."""
    EARLIER = "earlier"
    """An earlier file that the keystore issued for the same enclave."""
    DIFFERENT = "different"
    """A Zenoh file that is not the current one (the ledger does not record earlier Zenoh files), or
    a file of another enclave of the same robot.
    """
    MISSING = "missing"
    EXPIRED = "expired"
    """A file on the robot has expired, even if it is the current one."""
    OFFLINE = "offline"
    """The robot has sent nothing for too long, whatever files it had at that time."""
    BROKEN = "broken"
    """The file in the keystore is missing, unreadable, or not as its CA signed it, so that no
    export is possible.
    """
    NEVER = "never"
    """The robot has sent no confirmation."""
    REFUSED = "refused"
    """The last message of the robot was refused, so its present files are not known."""
    LATER = "later"
    """The robot reports a later release than was ever published for it."""
    UNKNOWN = "unknown"
    """A file that the ledger does not record as issued."""
    REVOKED = "revoked"
    """A revoked file; also the state of a robot whose enclaves were all revoked."""
    ANOTHER = "another"
    """A file that belongs to another robot, or to an enclave without a robot."""


_RANK_OF_STATE = {state: place for place, state in enumerate(State)}

_KINDS_BY_FILE = {
    CERTIFICATE_FILE: "certificate",
    PERMISSIONS_FILE: "permissions",
    GOVERNANCE_FILE: "governance",
    CRL_FILE: "crl",
    IDENTITY_CA_FILE: "identity_ca",
    PERMISSIONS_CA_FILE: "permissions_ca",
}
_ZENOH_KIND = "zenoh"
FileKind = Annotated[str, Words((*_KINDS_BY_FILE.values(), _ZENOH_KIND))]
_AUTHORITY_KINDS = ("identity_ca", "permissions_ca")
_EXPIRING_KINDS = ("certificate", "permissions", "crl")
"""Kinds of files whose expiry the ledger records."""
_SIGNED_KINDS = ("permissions", "governance")
_KINDS_BY_ROLE = {"identity": ("certificate",), "permissions": _SIGNED_KINDS}
"""Maps the role of a CA to the kinds of files that the CA issues."""
_OFFLINE_AFTER = timedelta(days=1)
"""Default age of the last message from which a robot that fetches counts as offline."""
_CLOCK_AHEAD = timedelta(hours=1)
"""How far ahead a clock has to be so that metadata seems to have expired because of it."""
_FETCH_EXPECTED_WITHIN = timedelta(minutes=30)
"""Age of a fetching robot's last message from which sros says to check whether the robot is on.

By default, robots fetch every five minutes.
"""
_TASKS_BY_STATE = {
    State.RESTART: "restart",
    State.OFFLINE: "find out why",
    State.BROKEN: "sros check",
    State.NEVER: "deliver",
    State.REFUSED: "find out why",
    State.LATER: "find out why",
    State.UNKNOWN: "find out why",
    State.ANOTHER: "find out why",
}
"""Maps a state of a robot to the remedy, if the state alone decides it."""
_SUSPICIOUS_STATES = (State.LATER, State.UNKNOWN, State.ANOTHER)
"""States of a robot whose cause has to be found before anything is delivered to the robot."""


def _kind_of(path: str) -> str:
    """Return the kind of a file, such as ``permissions``; ``zenoh`` for all Zenoh files."""
    return _KINDS_BY_FILE.get(path.rpartition("/")[2], _ZENOH_KIND)


@shows(
    *("path", "kind", "state", "since", "enclave", "robot", "action"),
    null_if_empty=("since", "enclave", "robot"),
)
@dataclass(frozen=True, slots=True)
class ConfirmedFile:
    """A file on a robot that differs from the file that an export would contain now.

    With ``surplus``, the robot should have no file at this path.
    """

    path: str
    """Path of the file in the keystore."""
    kind: FileKind
    """Kind of the file."""
    state: State
    """What the robot has instead.  ``earlier``: an earlier file of the same enclave;
    ``different``: another Zenoh file (the ledger does not record earlier Zenoh files), or a file of
    another enclave of the robot; ``missing``: no file; ``unknown``: a file that the keystore did
    not issue; ``revoked``: a revoked file; ``another``: a file of another robot, or of no robot.
    ``broken``: the file in the keystore is missing, cannot be read, or is not as its CA signed it.
    """
    since: str = ""
    """When the keystore issued the robot's file, in UTC; null if the ledger does not record it."""
    enclave: str = ""
    """The enclave to which the robot's file belongs; null if ``path`` names this enclave."""
    robot: str = ""
    """The robot to which ``enclave`` belongs, or null."""
    surplus: bool = False

    @property
    def action(self) -> Annotated[str, Words(("deliver", "remove"))]:
        """Whether you have to deliver the file to the robot, or to remove it from the robot."""
        return "remove" if self.surplus else "deliver"


@shows(
    *("robot", "state", "to_do", "enclaves", "revoked", "unrecorded", "sharing_name", "confirmed"),
    *("received", "clock", "fetches", "release", "published", "stage", "files", "pending"),
    *("restart", "waiting", "running", "crl_in_force"),
    *("expiry", "dds", "problems", "notes"),
    null_if_empty=("stage",),
)
@dataclass(frozen=True, slots=True)
class RobotStatus:
    """The deployment status of a robot, by its last confirmation.

    ``others`` are enclaves of the robot that the fleet does not record.  ``has_release`` is only
    set for a robot whose files differ from the keystore's: it says whether the last published
    release has the keystore's current files.  ``short_lived`` are short-lived enclaves with a file
    that expires soon or has expired.  ``has_list`` says whether the robot has the current
    revocation list, or an earlier list that revokes the same certificates.  It does not say whether
    processes have loaded the list.  From ``renew_from`` on, a file of the robot expires soon.  From
    ``locked_out_from`` on, a web server with the current CA and list refuses a robot that fetches.
    ``lacks_key`` are enclaves whose key is in the keystore but not on the robot; a release does not
    contain keys.  The other fields are about the robot:

    - ``is_ahead``: by its message, its files are newer than the backup of the keystore;
    - ``got_earlier_release``: it fetched after the publication and got an earlier release;
    - ``lacks_ca``: it refuses releases, because it does not trust the CA that seals releases;
    - ``is_doubtful``: its files are not known, whatever it confirmed, because its last message was
      refused, its release was never published, or two computers have its keys;
    - ``has_shared_keys``: two computers seem to have its keys;
    - ``may_trust_replaced``: one of its processes may trust an identity CA that was replaced;
    - ``is_behind``: its clock is earlier than documents that it has verified;
    - ``has_low_sequence``: its last message was refused because of its sequence number;
    - ``reported``: how many of its problems are in its own words; they come first in ``problems``.
    """

    robot: str
    """Name of the robot."""
    state: State
    """The worst state of the robot's files, or another reason why the robot is not current.
    ``revoked``: also if all enclaves of the robot were revoked (``enclaves`` is 0); ``restart``:
    the files are current, but processes still run with earlier files; ``unusable``: the files are
    current, but the robot says that no process could start in an enclave, for example because the
    key is missing; ``expired``: a file of the robot has expired (`expiry`); ``offline``: the last
    confirmation is too old (`overdue`); ``later``: the robot says that it has a later release than
    was ever published for it, so nothing in its message is reliable; ``refused``: the last message
    was refused; ``never``: the robot sent no confirmation; ``none``: the robot has no enclave in
    the keystore.
    """
    enclaves: int
    """Number of the robot's enclaves in the keystore."""
    revoked: tuple[str, ...]
    """Revoked enclaves of the robot that are no longer in the keystore, whether or not the robot
    confirmed their files.
    """
    others: UnrecordedEnclaves
    received: datetime | None
    """When the last confirmation was received, in UTC, by the clock of the keystore's machine; of a
    message in an inbox, when its file was written; or null.
    """
    clock: datetime | None
    """The time of the robot's clock in the last confirmation, in UTC, or null."""
    fetches: bool
    """Whether the robot fetches its files: its agent has sent a message that was verified."""
    release: int | None
    """Number of the release that the robot's agent installed last; 0 for none, null if the
    confirmation does not tell.
    """
    published: int | None
    """Number of the last release that was published for the robot; null for none."""
    stage: Annotated[str, Words(("unknown", "before", "distribute", "reissue", "complete"))]
    """The stage of a CA rotation that the robot's CA files have reached; null if the robot
    confirmed no CA file. ``before``: the robot does not trust the new CA yet; ``complete``: it
    trusts only the new CA."""
    files: Mapping[str, Mapping[State, int]]
    """Number of the robot's files, by kind and state."""
    pending: tuple[ConfirmedFile, ...]
    """Files that differ from the keystore; empty if the robot has sent no confirmation."""
    restart: tuple[str, ...] | None
    """The enclaves whose processes may still run with earlier files on the robot, by its last
    confirmation, including enclaves that the robot should no longer have; null if the confirmation
    does not tell.
    """
    waiting: tuple[str, ...]
    """Enclaves of ``restart`` whose units the robot's agent restarts by itself, in the first round
    in which the command of ``--restart-if`` exits with 0, by its last confirmation.
    """
    running: Mapping[str, RunningFiles] | None
    """The files that the processes of each enclave of the robot have loaded, by its last
    confirmation; null if the confirmation does not tell."""
    crl_in_force: bool | None
    """Whether the current revocation list, or an earlier list that revokes the same certificates,
    is in force on the robot: the robot has the list, the list has not expired, the robot reports
    that surely no process runs with another list or with earlier CAs, and it is not ``offline``.
    False if this is not known, also because two computers seem to have the keys of the robot
    (`problems`), or if the keystore was restored from a backup and lacks what its robots have; null
    if the keystore has no list, or the robot has no enclave. A restart that is due only for new
    permissions, a new governance or a new certificate of the process itself does not count if the
    confirmation says which restarts the list needs, as those of ``sros agent``, ``sros fleet
    report`` and the Ansible collection do; otherwise, any restart that is due counts.
    """
    expiry: Mapping[Annotated[str, Words(_EXPIRING_KINDS)], datetime]
    """By kind of file, the first expiry of the files that the robot confirmed, in UTC, according
    to the ledger.
    """
    dds: RobotDds | None
    """The DDS of the robot by its last confirmation; null if the confirmation does not tell."""
    problems: tuple[str, ...] | None
    """Problems that the robot's agent reported: what the agent could not do, what is wrong on the
    robot, or that the robot fetches from an old copy of the publication; null if the confirmation
    does not tell.
    """
    notes: tuple[str, ...]
    """Remarks (clauses), for example about the robot's clock."""
    to_do: str = ""
    """What you have to do for the robot, in a few words; empty if there is nothing to do."""
    has_release: bool = False
    short_lived: tuple[str, ...] = ()
    has_list: bool = False
    is_doubtful: bool = False
    has_shared_keys: bool = False
    may_trust_replaced: bool = True
    renew_from: datetime | None = None
    lacks_key: tuple[str, ...] = ()
    got_earlier_release: bool = False
    is_ahead: bool = False
    locked_out_from: datetime | None = None
    lacks_ca: bool = False
    reported: int = 0
    is_behind: bool = False
    has_low_sequence: bool = False
    is_lost: bool = False

    @property
    def is_published(self) -> bool:
        """Whether the robot reports that it has the published release, with the current files."""
        return self.has_release and bool(self.release) and self.release == self.published

    @property
    def unrecorded(self) -> tuple[str, ...]:
        """Enclaves in the robot's folder that the fleet does not record, such as ``/r3/spare``;
        ``sros revoke --robot`` revokes them, too.
        """
        return self.others.below

    @property
    def sharing_name(self) -> tuple[str, ...]:
        """Enclaves that the fleet does not record, with the robot's name elsewhere in their path,
        such as ``/desk/r3``; ``sros revoke --robot`` does not revoke them, but names them.
        """
        return self.others.naming

    @property
    def is_settled(self) -> bool:
        """Whether there is nothing to do: the files are current and the agent reports no problem.

        A robot without enclaves is settled, too.  A revoked robot is settled once its enclaves are
        gone, because only the other robots need the revocation list.  No robot is settled if a
        restored keystore lacks an enclave of the robot whose certificate is not revoked
        (``is_lost``).
        """
        if self.is_lost:
            return False
        if self.state is State.REVOKED:
            return not self.enclaves
        return self.state is State.NONE or (self.state is State.CURRENT and not self.problems)

    @property
    def mended(self) -> bool:
        """Whether the robot is `is_settled` except for problems that its agent has mended."""
        is_over = self.state is State.CURRENT and all(map(is_mended, self.problems or ()))
        return self.is_settled or (is_over and not self.is_lost)

    @property
    def may_have_copied_key(self) -> bool:
        """Whether a problem says that somebody may have copied a key of the robot."""
        return any(problem_rank(problem) == 0 for problem in self.problems or ())

    @property
    def has_damaged_file(self) -> bool:
        """Whether the robot has an unknown file, and reports that no process would start."""
        return self.state is State.UNKNOWN and any(map(is_unusable, self.problems or ()))

    @property
    def problem_clauses(self) -> list[str]:
        """The problems, the gravest first; the robot's own words begin with "it reports"."""
        problems = enumerate(self.problems or ())
        clauses = [
            # Whoever controls the robot chose the words.
            (problem_rank(text), True, f"it reports: {text}")
            if number < self.reported
            else (problem_rank(text), False, text)
            for number, text in problems
        ]
        return [clause for *_, clause in sorted(clauses, key=lambda clause: clause[:2])]

    @property
    def confirmed(self) -> datetime | None:
        """The time from which the age of the last confirmation counts, in UTC; null if the robot
        sent no confirmation.  This is the earlier of ``received`` and ``clock``: a message that
        somebody held back does not look new.
        """
        return min(self.received, self.clock) if self.received and self.clock else None

    def is_locked_out(self, now: datetime) -> bool:
        """Return whether a web server with the current CA and list refuses the robot at ``now``."""
        return self.locked_out_from is not None and self.locked_out_from <= now

    def as_offline(self) -> RobotStatus:
        """Return a copy with `State.OFFLINE` or worse, for a robot that was silent for too long."""
        state = max(self.state, State.OFFLINE, key=_RANK_OF_STATE.__getitem__)
        return replace(self.without_list(), state=state)

    def with_expired_state(self, now: datetime) -> RobotStatus:
        """Return a copy for the time ``now``: `State.EXPIRED` or worse if a file has expired."""
        if not self.enclaves or all(end > now for end in self.expiry.values()):
            return self
        status = self
        if (end := self.expiry.get("crl")) and end <= now:
            status = self.without_list()
        return replace(status, state=max(self.state, State.EXPIRED, key=_RANK_OF_STATE.__getitem__))

    def without_list(self) -> RobotStatus:
        """Return a copy for a robot on which the last revocation list may not be in force."""
        crl_in_force = None if self.crl_in_force is None else False
        return replace(self, crl_in_force=crl_in_force, has_list=False)

    def is_overdue(self, now: datetime, limit: timedelta) -> bool:
        """Return whether the last confirmation is older than ``limit``.

        Also true if it shows a time that is later than its receipt by more than ``limit``: then it
        proves nothing about its age.
        """
        if self.received is None or self.clock is None:
            return False
        return now - min(self.received, self.clock) > limit or self.clock - self.received > limit

    def _is_overdue_by_clock(self, now: datetime, limit: timedelta) -> bool:
        """Return whether only the robot's clock says that its last confirmation is not new."""
        came_in_time = self.received is not None and now - self.received <= limit
        return came_in_time and self.is_overdue(now, limit)

    def _shows_wrong_clock(self, now: datetime, limit: timedelta) -> bool:
        """Return whether somebody has to set the robot's clock first."""
        if self.state is State.OFFLINE:
            return self._is_overdue_by_clock(now, limit)
        others = (State.BROKEN, State.REFUSED, *_SUSPICIOUS_STATES)
        is_ahead = (
            any(EXPIRED_METADATA in problem for problem in self.problems or ())
            and self.received is not None
            and self.clock is not None
            and self.clock - self.received > _CLOCK_AHEAD
        )
        return (self.is_behind or is_ahead) and self.state not in others

    def next_step(self, now: datetime, limit: timedelta, *, is_accepted: bool) -> str:
        """Return what to do for the robot at ``now``, as ``to_do`` has it.

        ``limit`` is the age from which a confirmation is overdue.  ``is_accepted`` says whether
        robots accept the published metadata.
        """
        again = "sign its requests again, or revoke it" if self.is_lost else ""
        if self.state is State.REVOKED and not self.enclaves:
            return again or "take it out of the fleet file"
        if self._shows_wrong_clock(now, limit):
            return "check its clock"
        if self.state in (State.CURRENT, State.NONE):
            look = "check its server" if self.got_earlier_release else "look into it"
            return look if self.problems else again
        if self.is_ahead and (self.release or 0) > (self.published or 0):
            return "publish"
        if self.lacks_ca and self.state not in (State.BROKEN, *_SUSPICIOUS_STATES):
            return "deliver"
        if self.state is State.RESTART:  # the state says the restart
            if self.may_have_copied_key:
                return "look into it"
            if self.got_earlier_release:
                return "check its server"
        if self.state in _TASKS_BY_STATE and not self.is_ahead:
            return _TASKS_BY_STATE[self.state]
        if self.state is State.UNUSABLE:
            return "deliver" if self.lacks_key else "look into it"
        if self.state is State.EXPIRED and not self.pending:
            return "renew"
        if not self.fetches or self.lacks_key:
            return "deliver"
        if not is_accepted:
            return "publish"
        if self.got_earlier_release:
            return "check its server"
        if (self.published or 0) == (self.release or 0):
            return "find out why" if self.is_published else "publish"
        is_silent = self.confirmed is None or now - self.confirmed > _FETCH_EXPECTED_WITHIN
        if self.has_low_sequence:  # perhaps it has fetched already
            return "find out why"
        if self.is_locked_out(now):
            return "deliver" if is_silent else "wait, else deliver"
        if self._is_overdue_by_clock(now, _FETCH_EXPECTED_WITHIN):
            return "check its clock"
        if is_silent:
            return "check whether it is on"
        passes = (
            is_unusable(problem) or EXPIRED_METADATA in problem for problem in self.problems or ()
        )
        return "wait: it fetches" if all(passes) else "look into it"


@shows(
    *("folder", "unseen", "expires", "root_expires", "accepted", "lacks", "refused", "altered"),
    null_if_empty=("folder", "unseen", "lacks", "refused"),
)
@dataclass(frozen=True, slots=True)
class PublishedMetadata:
    """What was published last for the robots that fetch."""

    folder: str
    """Absolute path of the publishing folder; null if it is not known."""
    expires: datetime | None
    """The first expiry of the published metadata, in UTC: from then on, robots refuse the metadata,
    and get no new files.  Null if the last publication was by a release of sros that recorded no
    expiry.
    """
    root_expires: datetime | None = None
    """Expiry of the root metadata, in UTC; renewing the root metadata needs the root key. Null if
    the last publication was by a release of sros that recorded no expiry.
    """
    accepted: bool | None = None
    """Whether robots still accept the published files; null if ``expires`` is null."""
    unseen: str = ""
    """Why ``folder`` cannot be examined here, as a clause: it is not on this machine, or the
    package ``tuf`` is missing. Then sros does not know whether robots can fetch, or whether the
    folder has later releases than the keystore. Null if the folder was examined.
    """
    lacks: str = ""
    """Path of a published file that is missing in ``folder``, such as metadata or a robot's
    archive.  Null if nothing is missing, or if the folder is ``unseen``.
    """
    refused: str = ""
    """Why the metadata or an archive in ``folder`` does not verify, as a clause; robots refuse such
    files. Null if all verify, or if the folder is ``unseen``.
    """
    altered: Mapping[str, datetime] = field(default_factory=dict)
    """Files that ``sros fleet publish`` put right in the last day, because they were missing,
    changed, older than published or foreign; each with the time, in UTC.
    """

    @property
    def is_in_order(self) -> bool:
        """Whether the metadata has not expired, and no file is known to be missing or refused."""
        return bool(self.accepted and not self.lacks)

    def as_seen_at(self, now: datetime) -> PublishedMetadata:
        """Return this publication as robots see it at the time ``now``."""
        accepted = now < self.expires if self.expires else None
        altered = altered_lately(self.altered, now)
        return replace(self, accepted=False if self.refused else accepted, altered=altered)


@shows(
    *(
        "keystore",
        "complete",
        "mended",
        "seen",
        "stage",
        "counts",
        "unassigned",
        "without_robot",
        "left",
        "overdue",
        "older",
        "clock",
    ),
    *("edited", "restored", "revoked_until", "publication", "robots"),
    null_if_empty=("older", "clock", "edited"),
)
@dataclass(frozen=True, slots=True)
class FleetStatus:
    """The robots of a fleet, and the stage of the keystore's CA rotation."""

    keystore: NamedKeystore
    stage: Annotated[str, Words(("complete", "distribute", "reissue"))]
    """Stage of the keystore's CA rotation; ``complete`` if no rotation is in progress."""
    robots: tuple[RobotStatus, ...]
    """The robots, sorted by name."""
    without_robot: tuple[str, ...]
    """The enclaves that belong to no robot, so that no confirmation includes them, sorted by name;
    empty with ``--robot``.
    """
    left: tuple[str, ...] = ()
    """The valid enclaves of robots that left the fleet or their group, sorted by name; empty with
    ``--robot``.
    """
    overdue: frozenset[str] = frozenset()
    """The robots whose last confirmation is older than ``--max-age``, or shows a time that is later
    than its receipt by more than that, sorted by name. Without that option, the limit is a day,
    and only robots that fetch are listed.
    """
    older: str = ""
    """Why the keystore lacks what its robots have, as a clause: the keystore was restored from a
    backup, or is a copy, and has not yet published with ``--restored``.  Null if nothing shows
    this.
    """
    clock: str = ""
    """How far the clock of this machine is behind the last entry of the ledger, or behind the last
    confirmation, as a clause; then ages and expiry are not known.  Null if the clock is not behind.
    """
    edited: str = ""
    """How the keystore's fleet file differs from the file that sros wrote, as a clause; then robots
    may be missing.  Null if the file does not differ.
    """
    revoked_until: datetime | None = None
    """The time until which robots need the revocation list, in UTC: the latest expiry of a
    certificate on the list, or of a revoked certificate of a replaced CA that a robot may still
    trust, whichever is later. Null if no certificate is revoked, or if the ledger lacks a revoked
    certificate.
    """
    publication: PublishedMetadata | None = None
    """What robots fetch; null if nothing was published for any robot."""
    is_any_revoked: bool = False
    """Whether a certificate is on the revocation list, or was revoked and is of a replaced CA that
    a robot may still trust.
    """
    trusting_replaced: Sequence[str] = ()
    """The robots that may trust a replaced CA and so accept certificates that were revoked, if no
    certificate is on the revocation list.  Empty if there may be a later list (`older`).
    """
    groups: Mapping[str, Sequence[str]] = field(default_factory=dict)
    """The groups of the fleet file, with their robots."""
    awaited: frozenset[str] = frozenset()
    """The kinds of files that every robot must have before the next stage of a rotation."""
    recorded: datetime | None = None
    """The time of the last entry of the ledger, in UTC; None for an empty ledger."""
    restored: datetime | None = None
    """When sros noticed the last restore of the keystore from a backup, in UTC: certificates may
    exist that it lacks, and that no revocation list revokes.  Null if it was never restored, or if
    its identity CA has been replaced since.
    """

    @property
    def unassigned(self) -> int:
        """Number of enclaves that belong to no robot; 0 with ``--robot``."""
        return len(self.without_robot)

    @property
    def names(self) -> list[str]:
        """Names of the robots."""
        return [robot.robot for robot in self.robots]

    @property
    def counts(self) -> Mapping[State, int]:
        """The number of robots by state."""
        counts = Counter(robot.state for robot in self.robots)
        return {state: counts[state] for state in State if counts[state]}

    @property
    def unconfirmed(self) -> tuple[str, ...]:
        """Names of the robots that have not confirmed the stage of the CA rotation.

        In the first stage, robots have to confirm that they trust the new CA; in the second, that
        they have the files of the new CA.  A robot is also unconfirmed in these cases: its
        processes still run with earlier files; it fetches and is offline; it reports a release that
        was never published; or its last message was refused.
        """
        return tuple(
            robot.robot
            for robot in self.robots
            if robot.enclaves
            and (
                robot.received is None
                or robot.restart
                or robot.robot in self.overdue
                or robot.is_doubtful
                or any(file.kind in self.awaited and not file.surplus for file in robot.pending)
            )
        )

    @property
    def complete(self) -> bool:
        """Whether nothing is left to do for the fleet; if false, the exit status is 1.  True if
        every robot with enclaves confirmed the current files in time, no restart is due, no agent
        reports a problem, robots can still fetch the published releases, no published file was
        altered in the last day, and there is no other doubt about the robots' files.  Robots whose
        enclaves were all revoked do not count, unless a restored keystore lacks an enclave of the
        robot whose certificate is not revoked.
        """
        return self.is_settled()

    @property
    def mended(self) -> bool:
        """Like ``complete``, but changed files that an agent replaced, and altered files that were
        published again, do not count; both are shown for a day. A key that somebody may have
        copied still counts.
        """
        return self.is_settled(mended=True)

    @property
    def seen(self) -> bool:
        """Like ``complete``, but a publishing folder that cannot be examined does not count."""
        return self.is_settled(unseen=True)

    def is_settled(self, *, mended: bool = False, unseen: bool = False) -> bool:
        """Return whether nothing is left to do for the fleet.

        With ``mended``, files that were changed and replaced do not count.  With ``unseen``, a
        publishing folder that cannot be examined does not count.
        """
        publication = self.publication
        in_order = publication is None or (
            publication.is_in_order
            and (unseen or not publication.unseen)
            and (mended or not publication.altered)
        )
        in_doubt = self.overdue or self.older or self.clock or self.edited
        robots = (robot.mended if mended else robot.is_settled for robot in self.robots)
        return in_order and not in_doubt and all(robots)

    def with_overdue(self, now: datetime, max_age: timedelta | None = None) -> FleetStatus:
        """Return a copy in which silent robots are offline, with the remedy for each robot.

        A robot is offline if its last confirmation is older than ``max_age``.  Without ``max_age``,
        only a robot that fetches can be offline: if it has sent nothing for more than a day.
        """
        limit = max_age or _OFFLINE_AFTER
        overdue = frozenset(
            robot.robot
            for robot in self.robots
            if robot.enclaves and (max_age or robot.fetches) and robot.is_overdue(now, limit)
        )

        publication = self.publication and self.publication.as_seen_at(now)
        is_accepted = publication is None or publication.is_in_order

        def status(robot: RobotStatus) -> RobotStatus:
            is_overdue = robot.robot in overdue
            robot = robot.as_offline() if is_overdue else robot.with_expired_state(now)
            return replace(robot, to_do=robot.next_step(now, limit, is_accepted=is_accepted))

        to_do = tuple(map(status, self.robots))
        received = max((robot.received for robot in self.robots if robot.received), default=None)
        clock = clock_behind_clause(now, self.recorded, "the last entry of the ledger")
        clock = clock or clock_behind_clause(now, received, "the last confirmation")
        if clock:  # the ages of the confirmations are not known
            to_do = tuple(robot.without_list() for robot in to_do)
        return replace(self, robots=to_do, overdue=overdue, clock=clock, publication=publication)


def shared_keys_clause(robots: Sequence[str]) -> str:
    """Return a clause on robots (`RobotStatus.has_shared_keys`); "" without robots."""
    if not robots:
        return ""
    return (
        f"two computers seem to have the keys of {first_few(robots, 3)}, so their "
        "confirmations do not count"
    )


def robots_with_shared_keys(keystore: OpenedKeystore, names: Sequence[str]) -> list[str]:
    """Return the robots in ``names`` whose keys two computers seem to have.

    Raises:
        KeystoreError: the keystore has no fleet, or some of its enclaves may be missing.
    """
    robots = fleet_status(keystore, names).robots if names else ()
    return [robot.robot for robot in robots if robot.has_shared_keys]


def fleet_status(
    keystore: OpenedKeystore, names: Sequence[str] = (), now: datetime | None = None
) -> FleetStatus:
    """Return the deployment status of the named robots, or of the whole fleet.

    With ``now``, enclaves of robots that left the fleet are left out if they have expired, and
    certificates that a restored keystore lacks do not count if they have expired.

    Raises:
        KeystoreError: the keystore has no fleet, or some of its enclaves may be missing.
        DocumentError: the fleet has no such robot.
    """
    fleet = recorded_fleet(keystore)
    robots = [fleet.robot(name) for name in names] or list(fleet.robots.values())
    compared = _compare_robots(keystore, fleet, robots)
    stages = _Stages(keystore)
    records = _KeystoreRecords(keystore, fleet, compared, stages)
    existing = keystore.names
    of_robots = {enclave for robot in compared for enclave in robot.enclaves}
    unrecorded = unrecorded_enclaves(fleet, existing, {robot.name for robot in robots})
    statuses = tuple(
        _robot_status(robot, records, stages, unrecorded[robot.robot.name], now)
        for robot in compared
    )
    if older := records.age_clause:  # there may be a later list that the keystore lacks
        statuses = tuple(status.without_list() for status in statuses)
    trusting_replaced = [
        status.robot
        for status in statuses
        if status.crl_in_force is False and (older or status.may_trust_replaced)
    ]
    may_trust_replaced, is_any_listed = bool(trusting_replaced), records.is_any_listed()
    is_any_revoked = is_any_listed or (may_trust_replaced and records.is_any_revoked)
    return FleetStatus(
        keystore.root,
        stages.stage_of_keystore,
        statuses,
        () if names else tuple(sorted(set(existing) - of_robots)),
        () if names else tuple(left_enclaves(keystore, fleet, now)),
        older=older,
        edited=fleet_edits_clause(keystore, keystore.ledger_with("what", "fleet")),
        revoked_until=records.revoked_until(may_trust_replaced=may_trust_replaced)
        if is_any_revoked
        else None,
        publication=records.publication,
        is_any_revoked=is_any_revoked,
        trusting_replaced=() if is_any_listed or older else trusting_replaced,
        groups=fleet.groups,
        awaited=stages.awaited,
        recorded=keystore.ledger_file.last_time(),
        restored=parse_iso(restored) if (restored := restored_at(keystore)) else None,
    )


# ── comparing a confirmation with the keystore's files ────────────────────────────────────────


class _Difference(NamedTuple):
    """A confirmed file that differs from the keystore.

    ``confirmed`` is the SHA-256 of the robot's file, or "" if the robot has no file; ``kept`` is
    the SHA-256 of the keystore's file.  ``certificates`` are the SHA-256 of the certificates in the
    robot's file, and ``present`` the SHA-256 of the certificates in the keystore's file.
    ``exported`` says whether an export has a file at this path; None if the file in the keystore
    cannot be read.  ``is_own`` says whether the path belongs to an enclave of the robot.
    """

    path: str
    confirmed: str
    certificates: tuple[str, ...]
    exported: bool | None
    is_own: bool
    present: tuple[str, ...] = ()
    kept: str = ""


class _ComparedRobot(NamedTuple):
    """A robot's confirmation, compared with the files of its enclaves in the keystore.

    ``current`` counts the files that are equal to the keystore's, by kind.  ``authorities`` maps
    the kind of a CA file to the certificates in the confirmed CA files of all enclaves.
    ``expiring`` maps kinds of files that expire to the files' SHA-256 in the ledger.
    """

    robot: Robot
    enclaves: tuple[str, ...]
    received: ReceivedConfirmation | None
    current: Mapping[str, int]
    different: tuple[_Difference, ...]
    authorities: Mapping[str, frozenset[tuple[str, ...]]]
    expiring: Mapping[str, frozenset[str]]
    notes: tuple[str, ...]

    @property
    def confirmed(self) -> Confirmation | None:
        """The confirmation; None if the robot has sent none."""
        return self.received.confirmation if self.received else None

    def has_current_files(
        self, kind: str, is_equal: Callable[[_Difference], bool] = lambda _: False
    ) -> bool:
        """Return whether all files of a kind are current, or accepted by ``is_equal``.

        Enclaves that the robot does not have yet do not count, because no process can run in them.
        """
        had = {enclave_of(path) for path in self.confirmed.files} if self.confirmed else set()
        there = {*self.enclaves} & {*had, *(self.running() or ())}
        others = [
            file
            for file in self.different
            if _kind_of(file.path) == kind and (file.confirmed or enclave_of(file.path) in there)
        ]
        number = self.current.get(kind, 0) + len(others)
        return 0 < number == len(there) and all(map(is_equal, others))

    def running(self) -> Mapping[str, RunningFiles] | None:
        """Map each enclave to the files that its processes have loaded; None if not reported."""
        if self.confirmed is None or self.confirmed.running is None:
            return None
        running = self.confirmed.running
        return {name: running[name] for name in self.enclaves if name in running}

    def restart(self) -> tuple[str, ...] | None:
        """Return the enclaves whose processes have earlier files; None if not reported.

        Processes may also still run in an enclave that the keystore no longer gives to the robot.
        """
        running = self.running()
        due = self.confirmed.restart if self.confirmed else None
        if due is None and running is None:
            return None
        earlier = {name for name, files in (running or {}).items() if files == RunningFiles.EARLIER}
        return tuple(sorted(earlier.union(due or ())))

    def waiting(self) -> tuple[str, ...]:
        """Return the enclaves of `restart` whose units the robot's agent restarts by itself."""
        waiting = (self.confirmed and self.confirmed.waiting) or ()
        return tuple(name for name in self.restart() or () if name in waiting)

    def crl_restart(self) -> tuple[str, ...] | None:
        """Return the enclaves whose processes may lack the revocation list; None if not reported.

        Robots with an earlier release of sros report only which enclaves have to restart, not why.
        """
        due = self.confirmed.crl_restart if self.confirmed else None
        return self.restart() if due is None else due


def _compare_robots(
    keystore: OpenedKeystore, fleet: Fleet, robots: Sequence[Robot]
) -> list[_ComparedRobot]:
    """Return the comparison of each robot's confirmation with the keystore, using all cores."""

    def work(part: Sequence[Robot]) -> list[_ComparedRobot]:
        with Folder(keystore.root) as folder:
            files = _KeystoreFiles(folder)
            return [_compare_robot(keystore, fleet, robot, files) for robot in part]

    return [compared for _, part in map_slices(robots, work) for compared in part]


def _compare_robot(
    keystore: OpenedKeystore, fleet: Fleet, robot: Robot, keystore_files: _KeystoreFiles
) -> _ComparedRobot:
    enclaves = enclaves_of_robot(keystore, fleet, robot)
    notes: list[str] = []
    received = None
    try:
        received = last_confirmation(keystore, robot.name)
    except SrosError as error:
        notes.append(f"its last confirmation cannot be used: {error}")
    if received is None:
        return _ComparedRobot(robot, enclaves, None, {}, (), {}, {}, tuple(notes))
    notes += _notes_on_clock(received)
    confirmed = received.confirmation
    current: Counter[str] = Counter()
    different: list[_Difference] = []
    authorities: dict[str, set[tuple[str, ...]]] = {kind: set() for kind in _AUTHORITY_KINDS}
    expiring: dict[str, set[str]] = {kind: set() for kind in _EXPIRING_KINDS}
    unmatched_paths = set(confirmed.files)
    for name in enclaves:
        for path, file in keystore_files.files_of(name).items():
            unmatched_paths.discard(path)
            sha256, kind = confirmed.files.get(path, ""), _kind_of(path)
            if file and sha256 == file.sha256:
                current[kind] += 1
                certificates = file.certificates
            else:
                certificates = confirmed.certificates.get(path, ())
                difference = _Difference(path, sha256, certificates, None, is_own=True)
                if file:
                    difference = difference._replace(
                        exported=True, present=file.certificates, kept=file.sha256
                    )
                different.append(difference)
            if kind in authorities:
                authorities[kind].add(certificates)
            elif kind in expiring:
                expiring[kind].update(
                    certificates[:1] if kind == "certificate" else {sha256} - {""}
                )
    folders = {enclave_folder(name) for name in enclaves}
    for path in sorted(unmatched_paths):
        certificates = confirmed.certificates.get(path, ())
        is_own = path.rpartition("/")[0] in folders
        different.append(_Difference(path, confirmed.files[path], certificates, False, is_own))
    return _ComparedRobot(
        robot,
        enclaves,
        received,
        current,
        tuple(different),
        {kind: frozenset(certificates) for kind, certificates in authorities.items()},
        {kind: frozenset(digests) for kind, digests in expiring.items()},
        tuple(notes),
    )


def _notes_on_clock(received: ReceivedConfirmation) -> Iterator[str]:
    if note := received.clock_note():
        yield note
    if received.confirmation.clock == RobotClock.BEHIND:
        yield "its clock is behind the dates of documents that the robot has verified"


class _KeystoreFile(NamedTuple):
    """The SHA-256 of a file in the keystore, and of each certificate (DER) in the file."""

    sha256: str
    certificates: tuple[str, ...]


class _KeystoreFiles:
    """A reader of the digests of enclave files in a keystore, which reads shared files once."""

    def __init__(self, folder: Folder) -> None:
        self._folder = folder
        self._shared: dict[tuple[str, str], _KeystoreFile | None] = {}

    def files_of(self, name: str) -> Mapping[str, _KeystoreFile | None]:
        """Map the paths of an enclave's exported files, without the key, to their digests.

        A path maps to None if its file cannot be read, or if it is missing although it is one of
        `REQUIRED_FILES`.
        """
        folder = enclave_folder(name)
        files: dict[str, _KeystoreFile | None] = dict.fromkeys(
            f"{folder}/{file}" for file in REQUIRED_FILES if file != KEY_FILE
        )
        up = "../" * folder.count("/")
        with suppress(OSError), os.scandir(self._folder.path / folder) as entries:
            for entry in entries:
                if entry.name in CONFIRMED_FILES:
                    path = f"{folder}/{entry.name}"
                    files[path] = (
                        self._linked_file(path, up) if entry.is_symlink() else self._file(path)
                    )
        return files

    def _linked_file(self, path: str, up: str) -> _KeystoreFile | None:
        """Return the digests of the file to which a link leads; None if it cannot be read.

        ``up`` is the relative path from the link to the folder of all enclaves.
        """
        with suppress(SrosError, OSError):
            link = self._folder.link_target(path) or ""
            if not link.startswith(up):
                return self._read(path, self._folder.read_inside)
            place = (up, link)  # the same file for every enclave at this depth
            if place not in self._shared:
                self._shared[place] = self._read(path, self._folder.read_inside)
            return self._shared[place]
        return None

    def _file(self, path: str) -> _KeystoreFile | None:
        return self._read(path, self._folder.read)

    def _read(self, path: str, read_content: Callable[[str], bytes]) -> _KeystoreFile | None:
        try:
            data = read_content(path)
        except (SrosError, OSError):
            return None
        has_certificates = _kind_of(path) in (*_AUTHORITY_KINDS, "certificate")
        certificates = certificate_digests(data) if has_certificates else ()
        return _KeystoreFile(hashlib.sha256(data).hexdigest(), certificates)


# ── origin of different files ──────────────────────────────────────────────────────────────


class _FileValidity(NamedTuple):
    """The validity of a file on a robot, and the enclave of the file.

    ``enclave`` is "" for a file that all enclaves share, such as the revocation list.
    """

    enclave: str
    window: Window


class _KeystoreRecords:
    """A reader of the ledger, which identifies confirmed files that differ from the keystore's."""

    def __init__(
        self,
        keystore: OpenedKeystore,
        fleet: Fleet,
        compared_robots: Sequence[_ComparedRobot],
        stages: _Stages,
    ) -> None:
        self._keystore = keystore
        self._stages = stages
        self.root = keystore.root
        self.has_list = keystore.has(CRL)
        """Whether the keystore has a revocation list."""
        # Most keystores publish nothing.
        from sros_tool.keystore.delivery.publish import publication_problem

        published = read_published(keystore)
        missing = published.first_missing()
        unseen, refused = unseen_clause(missing), publication_problem(keystore)
        if not unseen and (altered := published.first_altered()):
            why = (
                f"'{published.folder}' has an archive that is changed or cannot be read: {altered}"
            )
            refused = f"{refused}; {why}" if refused else why
        self._published = published.robots
        self.published = {name: robot.release.number for name, robot in published.robots.items()}
        """Maps robots to the number of the release that was published last for them."""
        self.publication = (
            PublishedMetadata(
                published.folder,
                published.until,
                published.root_until,
                unseen=unseen,
                lacks=missing or "",
                refused=refused,
                altered=published.altered,
            )
            if published.robots
            else None
        )
        self.refusals = refusals(keystore)
        """Maps robots to the reason why their last message was refused."""
        self._fleet = fleet
        self._issued: dict[str, Entry] = {}
        self._revoked_serials: set[str] = set()
        self._revoked: set[str] = set()
        self._equal_lists: set[str] = set()
        different = [
            file for robot in compared_robots for file in robot.different if file.confirmed
        ]
        wanted_digests = {file.confirmed for file in different}
        wanted_digests.update(
            certificate for file in different for certificate in file.certificates
        )
        wanted_digests.update(
            certificate
            for robot in compared_robots
            for file in robot.different
            if _kind_of(file.path) == "certificate"
            for certificate in file.present
        )
        for robot in compared_robots:
            wanted_digests.update(*robot.expiring.values())
            wanted_digests.update(
                file.kept for file in robot.different if _kind_of(file.path) in _SIGNED_KINDS
            )
            if robot.different:
                wanted_digests.update((stages.sealing_ca, stages.identity_ca))
        wanted_digests.discard("")  # stands for a file that the robot does not have
        ledger = keystore.ledger if wanted_digests else keystore.ledger_with("what", "revocation")
        for entry in ledger.entries:
            if entry.sha256 in wanted_digests:
                self._issued.setdefault(entry.sha256, entry)
            if entry.what == "certificate":
                self._revoked.discard(entry.enclave)
            elif entry.what == "crl":
                self._equal_lists.add(entry.sha256)
            elif entry.what == "revocation":
                self._equal_lists.clear()
                self._revoked_serials.add(entry.serial)
                if entry.enclave and entry.reason != SUPERSEDED:
                    self._revoked.add(entry.enclave)
        self._add_listed()
        robots = {robot.robot.name for robot in compared_robots}
        self._unrecorded = unrecorded_enclaves(fleet, self._revoked, robots)

    def _add_listed(self) -> None:
        """Add revocations that only a revocation list has, such as a list copied from a robot."""
        reason_by_serial = {
            f"{entry.serial:x}": entry.reason
            for crl in self._keystore.revocation_lists
            for entry in crl.revoked
            if f"{entry.serial:x}" not in self._revoked_serials
        }
        self._revoked_serials.update(reason_by_serial)
        if reason_by_serial:  # the ledger does not say which lists have these certificates
            self._equal_lists.clear()
        for entry in self._keystore.ledger_file.with_values("serial", reason_by_serial).entries:
            if (
                entry.what == "certificate"
                and reason_by_serial.get(entry.serial, SUPERSEDED) != SUPERSEDED
            ):
                self._revoked.add(entry.enclave)

    def is_list_equal(self, file: _Difference) -> bool:
        """Return whether an earlier revocation list revokes all that the current list revokes.

        Each list has all revocations so far.  So an earlier list that was signed after the last
        revocation in the ledger revokes the same certificates, provided that the ledger has all
        revocations on the current list.
        """
        return bool(file.exported and file.is_own) and file.confirmed in self._equal_lists

    def is_later(self, robot: str, release: int) -> bool:
        """Return whether a release number is higher than any that was published for a robot."""
        last = self.published.get(robot)
        return release > (self._keystore.last_release if last is None else last)

    def has_release(self, compared_robot: _ComparedRobot) -> bool:
        """Return whether the last release of a robot that fetches has the current files."""
        published = self._published.get(compared_robot.robot.name)
        if published is None or not (compared_robot.received and compared_robot.received.message):
            return False
        # Few robots need this import.
        from sros_tool.keystore.delivery.publish import is_all_published

        return is_all_published(self.root, published, compared_robot.enclaves)

    @cached_property
    def age_clause(self) -> str:
        """Why the keystore is older than its robots, as a clause; "" if nothing shows this."""
        from sros_tool.keystore.delivery.publish import age_clause

        return age_clause(self._keystore)

    @cached_property
    def is_restored(self) -> bool:
        """Whether the keystore was restored, and has published with ``--restored`` since."""
        return self.was_restored and not self.age_clause

    @property
    def was_restored(self) -> bool:
        """Whether the keystore was restored, so that its ledger may lack certificates."""
        return bool(restored_at(self._keystore))

    def is_ahead(self, confirmed: Confirmation) -> bool:
        """Return whether a robot reports a release from after the keystore's backup."""
        is_from_backup = bool(self.age_clause or self.is_restored)
        return bool(
            confirmed.release and is_from_backup and confirmed.release not in self._releases
        )

    @cached_property
    def enclaves_with_other_keys(self) -> frozenset[str]:
        """The enclaves for which the restored keystore made other keys than their robots have."""
        known = KnownKeys(self._keystore)
        names = self._keystore.names if self.was_restored else ()
        return frozenset(known.made_unknowing(names).values())

    def enclaves_lacking_key(self, compared_robot: _ComparedRobot) -> tuple[str, ...]:
        """Return the enclaves whose certificate is for a key that the robot does not have.

        This is so if the robot has no file of the enclave, if it has an earlier key, or if its
        agent reports that the key is missing.  An enclave whose key is not in the keystore is left
        out: its key was made on the robot, so the robot needs only a release.
        """
        confirmed = compared_robot.confirmed
        if confirmed is None:
            return ()
        problems = [problem for problem in confirmed.problems or () if concerns_key(problem)]
        enclaves_without_key = {
            name
            for name in compared_robot.enclaves
            if any(f"{name} " in problem for problem in problems)
        }
        folders = {path.rpartition("/")[0] for path in confirmed.files}
        for file in compared_robot.different:
            if _kind_of(file.path) == "certificate" and file.is_own and file.present:
                confirmed_entry = (
                    self._issued.get(file.certificates[0]) if file.certificates else None
                )
                present_entry = self._issued.get(file.present[0])
                has_other_key = (
                    confirmed_entry
                    and present_entry
                    and confirmed_entry.key
                    and present_entry.key
                    and confirmed_entry.key != present_entry.key
                )
                if has_other_key or file.path.rpartition("/")[0] not in folders:
                    enclaves_without_key.add(enclave_of(file.path))
        enclaves_without_key.difference_update(self.enclaves_with_other_keys)
        keys = {name: enclave_path(self.root, name) / KEY_FILE for name in enclaves_without_key}
        return tuple(sorted(name for name, key in keys.items() if os.path.lexists(key)))

    def makes_keys(self, compared_robot: _ComparedRobot) -> bool:
        """Return whether a key of a robot was made on the robot."""
        folders = map(self._keystore.folder, compared_robot.enclaves)
        return any(map(key_on_robot, folders))

    def lacks_ca(self, compared_robot: _ComparedRobot, *, is_published: bool) -> bool:
        """Return whether a robot that fetches does not trust the CA that seals releases.

        Unless ``is_published`` says that the current files are published, the earlier CA may have
        sealed the robot's release.  A CA that has the same key as its predecessor is also trusted
        by robots that only have the predecessor.
        """
        confirmed = compared_robot.confirmed
        trusted = {*chain.from_iterable(compared_robot.authorities.get("permissions_ca", ()))}
        if not (confirmed and trusted) or self._stages.sealing_ca in trusted:
            return False
        last = self.published.get(compared_robot.robot.name, 0)
        is_refused = any(OF_OTHER_CA in problem for problem in confirmed.problems or ())
        authority = self._issued.get(self._stages.sealing_ca)
        has_all = is_published or is_refused or (confirmed.release or 0) == last
        return has_all and not (authority and authority.reason == SAME_KEY)

    def locked_out_from(self, compared_robot: _ComparedRobot) -> datetime | None:
        """Return when a web server with the current CA and list begins to refuse a robot.

        This is the last expiry of the robot's certificates.  Revoked certificates and certificates
        of replaced identity CAs do not count; if the robot has no other certificates, the result is
        a time long ago.  The result is None if the time is not known.
        """
        long_ago = datetime.min.replace(tzinfo=UTC)
        authority = self._issued.get(self._stages.identity_ca)
        has_same_key = authority and authority.reason == SAME_KEY
        if self._stages.is_of_replaced_ca(compared_robot) and not has_same_key:
            return long_ago
        digests = set(compared_robot.expiring.get("certificate", ()))
        for file in compared_robot.different:
            if _kind_of(file.path) == "certificate":
                digests.update(file.certificates[:1])
        ends = []
        for entry in map(self._issued.get, digests):
            if entry is None or not entry.not_after:
                return None
            is_revoked = entry.serial in self._revoked_serials
            ends.append(long_ago if is_revoked else parse_iso(entry.not_after))
        return max(ends, default=None)

    def got_earlier_release(
        self, compared_robot: _ComparedRobot, confirmed_at: datetime | None
    ) -> bool:
        """Return whether a robot fetched long after the publication, but got an earlier release.

        A robot that reports another problem says itself why it did not get the release.
        """
        confirmed = compared_robot.confirmed
        if confirmed and any(map(shows_old_copy, confirmed.problems or ())):
            return True
        published = self.published.get(compared_robot.robot.name)
        if not (confirmed and confirmed_at and published and compared_robot.different):
            return False
        if not all(EXPIRED_METADATA in problem for problem in confirmed.problems or ()):
            return False
        released_at = self._releases.get(published)
        return (confirmed.release or 0) < published and bool(
            released_at and confirmed_at - released_at > _FETCH_EXPECTED_WITHIN
        )

    @cached_property
    def _releases(self) -> Mapping[int, datetime]:
        """Maps the numbers of all releases to the times of their publication."""
        releases = self._keystore.entries_of("release")
        return {entry.number: parse_iso(entry.time) for entry in releases}

    @property
    def is_any_revoked(self) -> bool:
        """Whether any certificate was revoked; the lists of replaced CAs may be gone, but count."""
        return bool(self._revoked_serials)

    def is_any_listed(self) -> bool:
        """Return whether the revocation list revokes a certificate, or cannot be read."""
        try:
            return any(crl.revoked for crl in self._keystore.revocation_lists)
        except SrosError:
            return self.has_list

    def revoked_until(self, *, may_trust_replaced: bool) -> datetime | None:
        """Return when the last certificate on the revocation list expires; None if not known.

        If a robot may trust a replaced CA, the revoked certificates of replaced CAs count, too.
        """
        with suppress(SrosError):
            lists = self._keystore.revocation_lists
            serials = {f"{entry.serial:x}" for crl in lists for entry in crl.revoked}
            serials |= self._revoked_serials if may_trust_replaced else set()
            entries = self._keystore.ledger_file.with_values("serial", serials).entries
            expiries = {entry.serial: entry.not_after for entry in entries if entry.not_after}
            if serials and serials <= expiries.keys():
                return parse_iso(max(expiries[serial] for serial in serials))
        return None

    def revoked_enclaves(self, robot: Robot) -> tuple[str, ...]:
        """Return a robot's revoked enclaves that are no longer in the keystore."""
        if not self._revoked:
            return ()
        names = {name for name in enclaves_of(self._fleet, robot) if name in self._revoked}
        names.update(self._unrecorded[robot.name].below)
        return tuple(sorted(name for name in names if not self._keystore.has_enclave(name)))

    def is_lost(self, compared_robot: _ComparedRobot, now: datetime | None) -> bool:
        """Return whether a restored keystore lacks an enclave of the robot that has a certificate.

        Messages or published releases showed the certificate, which is not revoked.  With ``now``,
        expired certificates do not count.
        """
        if not self.was_restored:
            return False
        names = enclaves_of(self._fleet, compared_robot.robot)
        lacking = [name for name in names if not self._keystore.has_enclave(name)]
        if not lacking:
            return False
        shown = KnownKeys(self._keystore).certificates_shown_after_restore(lacking)
        moment = iso(now) if now else ""
        return any(
            entry.serial not in self._revoked_serials and entry.not_after > moment
            for entry in shown
        )

    def short_lived(self, first_expiring: Mapping[str, _FileValidity]) -> tuple[str, ...]:
        """Return the short-lived enclaves of the files in ``first_expiring``.

        ``first_expiring`` maps a kind of file to the robot's file that expires first.
        """
        names = {file.enclave for file in first_expiring.values() if file.enclave}
        template = self._keystore.template
        return tuple(sorted(name for name in names if template.longest_validity(name) is not None))

    def first_expiring(self, compared_robot: _ComparedRobot) -> dict[str, _FileValidity]:
        """Map each kind of file to the robot's file that expires first, by the ledger."""
        first: dict[str, _FileValidity] = {}
        for kind, digests in compared_robot.expiring.items():
            entries = (self._issued.get(digest) for digest in digests)
            files = [
                entry
                for entry in entries
                if entry and entry.what == kind and "" < entry.not_before < entry.not_after
            ]
            if files:
                entry = min(files, key=lambda file: file.not_after)
                window = Window(parse_iso(entry.not_before), parse_iso(entry.not_after))
                first[kind] = _FileValidity(entry.enclave, window)
        return first

    def file(self, robot: Robot, difference: _Difference) -> ConfirmedFile:
        """Return the state and the origin of a robot's file that differs from the keystore."""
        kind, name = _kind_of(difference.path), enclave_of(difference.path)
        state, issued_at, owner = self._identify(difference, kind, name)
        if not difference.is_own and state is not State.REVOKED:
            if name in self._revoked and not self._keystore.has_enclave(name):
                state = State.REVOKED
            elif self._keystore.has_enclave(name) or robot_of(self._fleet, name) not in (
                None,
                robot,
            ):
                state, owner = State.ANOTHER, name
        other_robot = robot_of(self._fleet, owner) if owner else None
        if state is State.ANOTHER and other_robot == robot:
            state = State.DIFFERENT
        return ConfirmedFile(
            difference.path,
            kind,
            state,
            issued_at,
            owner,
            other_robot.name if other_robot else "",
            surplus=difference.exported is False,
        )

    def _is_edited(self, difference: _Difference, kind: str) -> bool:
        """Return whether the keystore's file differs from the file that was issued or signed."""
        if not difference.exported:
            return False
        if kind in (*_AUTHORITY_KINDS, "certificate"):
            return not difference.present
        if kind not in _SIGNED_KINDS or difference.kept in self._issued:
            return False
        with suppress(SrosError):
            data = self._keystore.read(difference.path, "document")
            authorities = self._keystore.authority(PERMISSIONS)
            return bool(self._keystore.files.signed_document(data).problem_for(authorities))
        return True

    def _identify(self, difference: _Difference, kind: str, name: str) -> tuple[State, str, str]:
        """Return a file's state, the time when it was issued, and the enclave to which it belongs.

        The time is "" if it is not known.  The enclave is "" if it is ``name``, in whose folder the
        file is.
        """
        if difference.exported is None or self._is_edited(difference, kind):
            return State.BROKEN, "", ""
        if not difference.confirmed:
            return State.MISSING, "", ""
        if kind == _ZENOH_KIND:
            return State.DIFFERENT, "", ""
        if kind in _AUTHORITY_KINDS:
            entries = [self._issued.get(entry) for entry in difference.certificates]
            if not entries or not all(entry and entry.what == "ca" for entry in entries):
                return State.UNKNOWN, "", ""
            return State.EARLIER, max(entry.time for entry in entries if entry), ""
        sha256 = difference.confirmed
        if kind == "certificate":
            sha256 = difference.certificates[0] if difference.certificates else ""
        entry = self._issued.get(sha256)
        if entry is None or entry.what != kind:
            return State.UNKNOWN, "", ""
        if entry.enclave and entry.enclave != name:
            return State.ANOTHER, entry.time, entry.enclave
        if entry.serial and entry.serial in self._revoked_serials:
            return State.REVOKED, entry.time, ""
        return State.EARLIER, entry.time, ""


@dataclass(frozen=True)
class _RobotFacts:
    """What the last confirmation of a robot shows, together with the keystore's records."""

    compared: _ComparedRobot
    records: _KeystoreRecords

    @property
    def name(self) -> str:
        return self.compared.robot.name

    @property
    def has_enclaves(self) -> bool:
        """Whether the keystore has enclaves of the robot."""
        return bool(self.compared.enclaves)

    @property
    def received(self) -> ReceivedConfirmation | None:
        return self.compared.received

    @property
    def confirmed(self) -> Confirmation | None:
        return self.compared.confirmed

    # ── its state ──────────────────────────────────────────────────────────────────────────

    @cached_property
    def different(self) -> tuple[ConfirmedFile, ...]:
        """The files that differ from the keystore."""
        return tuple(
            self.records.file(self.compared.robot, file) for file in self.compared.different
        )

    @cached_property
    def revoked(self) -> tuple[str, ...]:
        """The revoked enclaves that are no longer in the keystore."""
        return self.records.revoked_enclaves(self.compared.robot)

    def files(self) -> dict[str, Mapping[State, int]]:
        """Return the number of files by kind and state."""
        counts = {
            kind: Counter({State.CURRENT: number}) for kind, number in self.compared.current.items()
        }
        for file in self.different:
            counts.setdefault(file.kind, Counter())[file.state] += 1
        return {
            kind: counts[kind] for kind in (*_KINDS_BY_FILE.values(), _ZENOH_KIND) if kind in counts
        }

    @cached_property
    def state(self) -> State:
        """The worst state of the files, or another reason why the robot is not current."""
        states = [self._state_of_files()]
        if self.has_enclaves and any(map(is_unusable, self.reported)):
            states.append(State.UNUSABLE)
        if self.is_later:
            states.append(State.LATER)
        if self.refusal:
            states.append(State.REFUSED)
        return max(states, key=_RANK_OF_STATE.__getitem__)

    def _state_of_files(self) -> State:
        if self.revoked and not self.has_enclaves:
            return State.REVOKED  # such a robot should have no files, whatever it reports
        if self.different:
            return max((file.state for file in self.different), key=_RANK_OF_STATE.__getitem__)
        if not self.has_enclaves:
            return State.NONE
        if self.received is None:
            return State.NEVER
        return State.RESTART if self.compared.restart() else State.CURRENT

    @cached_property
    def is_later(self) -> bool:
        """Whether the robot reports a later release than was ever published for it."""
        return bool(
            self.has_enclaves
            and self.confirmed
            and self.records.is_later(self.name, self.confirmed.release or 0)
        )

    @cached_property
    def refusal(self) -> RefusedMessage | None:
        """The refusal of the robot's last message; None if the message was accepted."""
        refusal = self.records.refusals.get(self.name) if self.has_enclaves else None
        is_last = refusal and (self.received is None or self.received.time <= refusal.time)
        return refusal if is_last else None

    @cached_property
    def is_ahead(self) -> bool:
        """Whether the files are newer than the backup of the keystore, by the robot's message."""
        return bool(
            self.state is State.UNKNOWN
            and self.received
            and self.received.message
            and self.records.is_ahead(self.received.confirmation)
        )

    @cached_property
    def is_doubtful(self) -> bool:
        """Whether the files are not known, in addition to the state that is shown."""
        return bool(self.refusal or self.is_later or self.two_computers)

    # ── what it reports, and what its messages show ────────────────────────────────────────

    @property
    def reported(self) -> tuple[str, ...]:
        """The problems in the robot's own words."""
        return (self.confirmed and self.confirmed.problems) or ()

    @cached_property
    def two_computers(self) -> str:
        """A sentence if two computers seem to have the keys of the robot, or ""."""
        if not (self.has_enclaves and self.received and self.received.is_alternation_shown):
            return ""
        return self.received.two_computers_sentence(
            was_restored=self.records.was_restored,
            makes_keys=self.records.makes_keys(self.compared),
        )

    @property
    def fetches(self) -> bool:
        """Whether the robot fetches its files."""
        return bool(self.received and self.received.message)

    @cached_property
    def got_earlier_release(self) -> bool:
        """Whether the robot fetched after a publication, and got an earlier release."""
        received, confirmed = self.received, self.confirmed
        confirmed_at = min(received.time, confirmed.time) if received and confirmed else None
        return self.fetches and self.records.got_earlier_release(self.compared, confirmed_at)

    def problems(self) -> tuple[str, ...] | None:
        """Return the reported problems, and those that the messages show; None if not reported."""
        problems = self.confirmed.problems if self.confirmed else None
        if self.two_computers:
            problems = (*self.reported, self.two_computers)
        if problems or not (self.got_earlier_release and self.confirmed):
            return problems
        release = self.confirmed.release
        has = f"release {release}" if release else "no release"
        return (
            f"It sent a message long after release {self.records.published.get(self.name)} was "
            f"published, and has {has}: the place that `from` names in the settings of its agent "
            "has an old copy.",
        )

    def notes(self) -> Iterator[str]:
        """Yield the remarks about the robot."""
        if restored := self._restored_clause():
            yield restored
        yield from self.compared.notes
        if self.refusal:
            since = iso(self.refusal.time)
            yield f"its last message has been refused since {since}: {self.refusal.why}"
        if self.is_ahead and self.confirmed:
            yield (
                f"it says that it has release {self.confirmed.release}, from after the backup of "
                "the keystore: its files are then newer than the keystore's, and the next release "
                "replaces them"
            )

    def _restored_clause(self) -> str:
        """Return a clause if a restored keystore lacks what the robot has, or ""."""
        why = self.refusal.why if self.refusal and self.state is State.REFUSED else ""
        is_lost = why.startswith(NOT_IN_LEDGER)
        is_unknown = self._has_intact_unknown_file() and not self.is_ahead
        if not ((is_lost or is_unknown) and self.records.is_restored):
            return ""
        root = self.records.root
        others = sorted(self.records.enclaves_with_other_keys.intersection(self.compared.enclaves))
        if others:
            return (
                f"the keystore was restored, and made another key for {', '.join(others)} than the "
                f"robot has. {other_keys_remedy(root, others).removesuffix('.')}"
            )
        cause = "the keystore was restored, and lacks what it issued after the backup"
        if not is_lost:
            cause = "perhaps the keystore issued this after the backup from which it was restored"
        return (
            f"{cause}. If the message is genuine, run `sros distribute_key {quote(str(root))} "
            "--robot NAME FOLDER --force`"
        )

    def _has_intact_unknown_file(self) -> bool:
        """Return whether the keystore does not know a file in which the robot sees no damage.

        A restore of the keystore does not explain files with which no process would start.
        """
        unusable = {problem.partition(" ")[0] for problem in filter(is_unusable, self.reported)}
        return self.state is State.UNKNOWN and any(
            file.state is State.UNKNOWN and enclave_of(file.path) not in unusable
            for file in self.different
        )

    # ── what it has, and what is in force ──────────────────────────────────────────────────

    @cached_property
    def has_authorities(self) -> bool:
        """Whether the robot has the current identity CA in all of its enclaves."""
        return (
            not self.is_doubtful
            and self.has_enclaves
            and self.received is not None
            and self.compared.has_current_files("identity_ca")
        )

    @cached_property
    def has_list(self) -> bool:
        """Whether the robot has the current revocation list, or an equal one."""
        return (
            self.records.has_list
            and self.has_authorities
            and self.compared.has_current_files("crl", self.records.is_list_equal)
        )

    @property
    def is_restarted(self) -> bool:
        """Whether no process runs with another list or with earlier CAs."""
        return self.compared.crl_restart() == ()

    @cached_property
    def has_release(self) -> bool:
        """Whether the last release has the current files, which the robot lacks."""
        return bool(self.different) and self.records.has_release(self.compared)

    def enclaves_lacking_key(self) -> tuple[str, ...]:
        """Return the enclaves whose key is in the keystore but not on the robot."""
        if not (self.different or self.state is State.UNUSABLE):
            return ()
        return self.records.enclaves_lacking_key(self.compared)


def _robot_status(
    compared_robot: _ComparedRobot,
    records: _KeystoreRecords,
    stages: _Stages,
    unrecorded: UnrecordedEnclaves,
    now: datetime | None,
) -> RobotStatus:
    facts = _RobotFacts(compared_robot, records)
    received, confirmed = facts.received, facts.confirmed
    validity = records.first_expiring(compared_robot)
    renewals = (file.window.expires_soon_from() for file in validity.values())
    needs_list = records.has_list and facts.has_enclaves
    return RobotStatus(
        robot=facts.name,
        state=facts.state,
        enclaves=len(compared_robot.enclaves),
        revoked=facts.revoked,
        others=unrecorded,
        received=received.time if received else None,
        clock=confirmed.time if confirmed else None,
        fetches=facts.fetches,
        release=confirmed.release if confirmed else None,
        published=records.published.get(facts.name),
        stage=stages.stage_of(compared_robot),
        files=facts.files(),
        pending=facts.different,
        restart=compared_robot.restart(),
        waiting=compared_robot.waiting(),
        running=compared_robot.running(),
        crl_in_force=facts.has_list and facts.is_restarted if needs_list else None,
        expiry={kind: file.window.not_after for kind, file in validity.items()},
        dds=confirmed.dds if confirmed else None,
        problems=facts.problems(),
        notes=tuple(facts.notes()),
        has_release=facts.has_release,
        short_lived=records.short_lived(validity),
        has_list=facts.has_list,
        is_doubtful=facts.is_doubtful,
        has_shared_keys=bool(facts.two_computers),
        may_trust_replaced=not (facts.has_authorities and facts.is_restarted),
        renew_from=min(renewals, default=None),
        lacks_key=facts.enclaves_lacking_key(),
        got_earlier_release=facts.got_earlier_release,
        is_ahead=facts.is_ahead,
        locked_out_from=records.locked_out_from(compared_robot) if facts.fetches else None,
        lacks_ca=facts.fetches and records.lacks_ca(compared_robot, is_published=facts.has_release),
        reported=len(facts.reported),
        is_behind=bool(confirmed and confirmed.clock is RobotClock.BEHIND),
        has_low_sequence=bool(facts.refusal and facts.refusal.why.startswith(LOW_SEQUENCE)),
        is_lost=records.is_lost(compared_robot, now),
    )


# ── the stages of a rotation ───────────────────────────────────────────────────────────────


class _Stages:
    """The stages of the keystore's CA rotation that robots' CA files have reached."""

    BEFORE, COMPLETE, UNKNOWN = "before", "complete", "unknown"
    ORDER = (UNKNOWN, BEFORE, "distribute", "reissue", COMPLETE)

    def __init__(self, keystore: OpenedKeystore) -> None:
        rotation = read_rotation(keystore)
        is_complete = rotation.stage is RotationStage.NONE
        self.stage_of_keystore = self.COMPLETE if is_complete else rotation.stage.value
        replaced_roles = {
            role
            for replacement in rotation.replacements
            for role in keystore.authority_files[replacement.file]
        }
        awaited = {f"{role}_ca" for role in replaced_roles}
        if rotation.stage is RotationStage.REISSUE:
            awaited.update(kind for role in replaced_roles for kind in _KINDS_BY_ROLE[role])
        self.awaited = frozenset(awaited)
        self._new: dict[str, str] = {}
        self._of_kind: dict[str, tuple[tuple[str, ...], str]] = {}
        for file, roles in keystore.authority_files.items():
            certificates = tuple(map(digest, keystore.certificates_of(file)))
            new = [replaced.new for replaced in rotation.replacements if replaced.file == file]
            for kind in (f"{role}_ca" for role in roles):
                self._new[kind] = new[0] if new else certificates[0]
                self._of_kind[kind] = certificates, self.stage_of_keystore if new else self.COMPLETE

    @property
    def sealing_ca(self) -> str:
        """The SHA-256 of the permissions CA that seals releases now."""
        return self._of_kind["permissions_ca"][0][0]

    @property
    def identity_ca(self) -> str:
        """The SHA-256 of the identity CA after the rotation, or of the present CA."""
        return self._new["identity_ca"]

    def is_of_replaced_ca(self, compared_robot: _ComparedRobot) -> bool:
        """Return whether replaced, untrusted identity CAs issued all certificates of a robot.

        In files of the stage ``distribute``, the certificates are still by the old CA, and the new
        CA is trusted.
        """
        files = compared_robot.authorities.get("identity_ca", ())
        is_over = self._of_kind["identity_ca"][1] == self.COMPLETE
        return (
            is_over
            and bool(files)
            and all(
                self._stage("identity_ca", certificates) in (self.BEFORE, "distribute")
                for certificates in files
            )
        )

    def stage_of(self, compared_robot: _ComparedRobot) -> str:
        """Return the stage of a robot's least advanced CA file; "" without a confirmed CA file."""
        stages = {
            self._stage(kind, certificates)
            for kind, files in compared_robot.authorities.items()
            for certificates in files
        }
        return min(stages, key=self.ORDER.index, default="")

    def _stage(self, kind: str, certificates: tuple[str, ...]) -> str:
        if certificates == self._of_kind[kind][0]:
            return self._of_kind[kind][1]
        if not certificates:
            return self.UNKNOWN
        new = self._new[kind]
        if new not in certificates:
            return self.BEFORE
        if len(certificates) == 1:
            return self.COMPLETE
        return "reissue" if certificates[0] == new else "distribute"
