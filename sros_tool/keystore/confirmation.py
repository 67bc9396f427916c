"""Confirmations of robots: the digests of a robot's enclave files, and its DDS.

A confirmation proves nothing, because whoever controls the robot can write anything into it.  So
sros reads confirmations as hostile input, only compares them with the records of the keystore, and
never opens a path from a confirmation.  `sros_tool/schemas/confirmation.json` describes the format.
"""

from __future__ import annotations

import binascii
import hashlib
import json
import os
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from datetime import datetime, timedelta
from enum import StrEnum
from pathlib import Path
from typing import Any, NamedTuple

from sros_tool.dds.advisories import PRODUCTS
from sros_tool.errors import DocumentError, InvalidNameError, SrosError
from sros_tool.files import staged_file
from sros_tool.fleet.robots import name_problem
from sros_tool.folders import Folder
from sros_tool.keystore.layout import (
    CERTIFICATE_FILE,
    CONFIRMED,
    ENCLAVES,
    IDENTITY_CA_FILE,
    KEY_FILE,
    OPTIONAL_FILES,
    PERMISSIONS_CA_FILE,
    REFUSED,
    REQUIRED_FILES,
    ZENOH_FILES,
    confirmation_file,
    enclave_folder,
    list_enclaves,
    search_enclaves,
)
from sros_tool.keystore.reader import OpenedKeystore
from sros_tool.keystore.transaction import KeystoreLock
from sros_tool.names import check_enclave_name
from sros_tool.validity import elapsed, iso, parse_iso
from sros_tool.values import DryRun, FileChange, NamedKeystore, Notes, as_plain, parse_json
from sros_tool.xml import read_bytes

_FORMAT = 1
MAX_BYTES = 4 * 1024 * 1024
"""Largest size of a confirmation in bytes; enough for a robot with 4,000 enclaves."""
LONGEST_REASON = 400
"""Maximum number of characters in the reason for refusing a message."""
NOT_IN_LEDGER = "its certificate is not in the ledger of the keystore"
"""How the reason begins for refusing a message whose certificate the ledger does not record."""
LOW_SEQUENCE = "its sequence number"
"""How the reason begins for refusing a message that does not come after the last message."""
_MOST_REFUSALS = 64 * 1024 * 1024
"""Largest size of the file of refused messages, in bytes; enough for 100,000 robots.

Each of them can have the longest reason.
"""
MESSAGE_FILE = "confirmation.p7s"
"""Name of a robot's signed message, in the robot's folder in an inbox."""
CONFIRMED_FILES = (
    *(file for file in REQUIRED_FILES if file != KEY_FILE),
    *OPTIONAL_FILES,
    *ZENOH_FILES,
)
"""Names of the enclave files that a confirmation lists: all exported files except the key."""
_CERTIFICATE_FILES = (CERTIFICATE_FILE, IDENTITY_CA_FILE, PERMISSIONS_CA_FILE)

_REQUIRED_KEYS = {"format", "robot", "time", "files"}
_AGENT_KEYS = (
    "boot",
    "crl_restart",
    "waiting",
    "sequence",
    "release",
    "expiry",
    "running",
    "clock",
    "problems",
    "requests",
    "crl",
    "seal",
)
"""Keys that only `sros agent` writes, except ``crl_restart`` and ``problems``."""
_OPTIONAL_KEYS = {"certificates", "restart", "dds", *_AGENT_KEYS}
_CLOCK_TOLERANCE = timedelta(minutes=1)
_MOST_BOOTS = 8
_MOST_CERTIFICATES = 32  # maximum number in a file
_MOST_LIBRARIES, _MOST_UNSEEN = 100, 1_000_000
_MOST_NUMBER = 2**53 - 1  # the largest number that every JSON reader reads exactly
MOST_PROBLEMS, LONGEST_PROBLEM = 50, 1000
"""Maximum number of problems in a confirmation, and of characters in a problem."""
MOST_REQUESTS = 500
"""Maximum number of signing requests in a confirmation; later confirmations have the others."""
_LONGEST_REQUEST = 16 * 1024
LONGEST_SEAL = 256 * 1024
"""Maximum number of characters of a release's seal in a confirmation: about 200 enclaves."""
LONGEST_LIST = 1024 * 1024
"""Maximum number of characters of a revocation list in a confirmation."""
_LIBRARY_VERSION = re.compile(r"\d{1,6}\.\d{1,6}\.\d{1,6}\Z", re.ASCII)
_LIBRARY_PATH = re.compile(r"/[\w.+/ ?-]{1,199}\Z")
"""Matches library paths of plain characters, which are only shown, never opened."""
_DIGEST = re.compile(r"[0-9a-f]{64}\Z")
_MOMENT_TEXT = re.compile(r"[0-9]{4}-[0-9]{2}-[0-9]{2}T[0-9]{2}:[0-9]{2}:[0-9]{2}Z\Z")
_REQUEST_PEM = re.compile(
    r"-----BEGIN CERTIFICATE REQUEST-----\n[A-Za-z0-9+/=\n]+-----END CERTIFICATE REQUEST-----\n\Z"
)
_CRL_PEM = re.compile(
    r"(?:-----BEGIN X509 CRL-----\n[A-Za-z0-9+/=\n]+-----END X509 CRL-----\n){1,8}\Z"
)
_CERTIFICATE_PEM = re.compile(
    rb"-----BEGIN CERTIFICATE-----([A-Za-z0-9+/=\s]*)-----END CERTIFICATE-----"
)


class LibraryUse(StrEnum):
    """Whether processes of a robot use a DDS library."""

    PROCESS = "process"
    """At least one running process has loaded the library."""
    INSTALLED = "installed"
    """The library is installed, but no process that the robot could examine has loaded it."""


class RobotLibrary(NamedTuple):
    """A DDS library on a robot."""

    product: str
    """Name of the DDS, such as ``Fast DDS``."""
    version: str
    """Version of the DDS as three numbers; empty if the file name does not show the version."""
    path: str
    """Path of the library on the robot."""
    seen: LibraryUse
    """Whether a running process has loaded the library, or it is only installed."""


class RobotDds(NamedTuple):
    """The DDS of a robot, as reported by the robot."""

    libraries: tuple[RobotLibrary, ...]
    """The DDS libraries; an empty list if the robot saw none."""
    unseen: int
    """Number of processes that could not be examined; they may use other libraries."""


class EnclaveExpiry(NamedTuple):
    """When the files of an enclave on a robot expire; None stands for an unreadable file."""

    certificate: datetime | None
    permissions: datetime | None


class RunningFiles(StrEnum):
    """The files that the running processes of an enclave have loaded, as reported by the robot."""

    CURRENT = "current"
    """All processes of the enclave that were seen have loaded the installed files."""
    EARLIER = "earlier"
    """At least one process still has earlier files, or runs in the enclave in another folder."""
    NOT_SEEN = "not_seen"
    """No process of the enclave was seen: either none runs, or they cannot be examined."""


class RobotClock(StrEnum):
    """The state of a robot's clock, as the robot reports it."""

    SYNCHRONIZED = "synchronized"
    """A time service sets the clock, according to the kernel."""
    UNSYNCHRONIZED = "unsynchronized"
    """No time service has set the clock since the robot started."""
    BEHIND = "behind"
    """The clock is earlier than documents that the robot has already verified."""
    UNKNOWN = "unknown"
    """The kernel gives no information."""


@dataclass(frozen=True, slots=True)
class Confirmation:
    """The enclave files that a robot says it has, its DDS, and the time of the robot's clock.

    ``files`` maps paths to the SHA-256 of the files.  ``certificates`` maps the paths of
    certificate and CA files to the SHA-256 of each certificate (DER) in the file, in order; if a
    file has no entry, sros cannot recognize an earlier certificate in it.  ``dds`` is the DDS of
    the robot; ``restart`` are the enclaves whose processes still have earlier files.  Both are None
    if the confirmation does not state them.

    The other fields come from `sros agent`, and are None in a confirmation by another program.
    ``sequence`` is higher in each message of a robot.  ``release`` is the number of the installed
    release; 0 for none.  ``expiry`` maps enclaves to the times at which their files expire, and
    ``running`` maps enclaves to the files that their processes have loaded.  ``crl_restart`` are
    the enclaves in ``restart`` whose processes may lack the revocation list; None stands for all of
    them.  Processes of the remaining enclaves in ``restart`` lack only their own new documents.
    ``waiting`` are the enclaves in ``restart`` whose units the agent restarts later by itself.
    ``boot`` is a SHA-256 that changes with each start of the computer.  ``problems`` are short
    sentences, and ``requests`` signing requests (PEM) for certificates that expire.  ``crl`` is the
    newest revocation list (PEM) of each identity CA on the robot, if they may differ from the lists
    that were published last.  From these lists, a keystore that was restored from a backup learns
    of its later revocations.  ``seal`` is the seal of the installed release, which proves its
    number.
    """

    robot: str
    time: datetime
    files: Mapping[str, str]
    certificates: Mapping[str, tuple[str, ...]]
    dds: RobotDds | None = None
    restart: tuple[str, ...] | None = None
    sequence: int | None = None
    release: int | None = None
    expiry: Mapping[str, EnclaveExpiry] | None = None
    running: Mapping[str, RunningFiles] | None = None
    clock: RobotClock | None = None
    problems: tuple[str, ...] | None = None
    requests: tuple[str, ...] | None = None
    crl: str | None = None
    crl_restart: tuple[str, ...] | None = None
    waiting: tuple[str, ...] | None = None
    boot: str | None = None
    seal: str | None = None

    def enclaves(self) -> tuple[str, ...]:
        """Return the names of the enclaves in the confirmation, sorted."""
        return tuple(sorted({enclave_of(path) for path in self.files}))


KEY_NOT_HERE = "is not on this robot"
OF_ANOTHER_KEY = "it does not belong to the enclave's key"
"""The agent's words if a release needs another key for an enclave than the robot has.

Either the robot has no key for the enclave, or the release's certificate is for another key.
"""


OLDER_THAN_SEEN = "are older than files that this robot has seen"
OLDER_THAN_INSTALLED = "which this robot has installed before"
EXPIRED_METADATA = "The metadata in "
OF_OTHER_CA = "is not sealed by a CA that this robot trusts"
OF_SAME_NUMBER = "of the installed release, but other files"
"""The agent's message on a release, or on published metadata, that the agent refuses."""
COULD_NOT_START = "could not start"
"""A robot's words if no process would start in an enclave."""
REPLACED_FILES = "changed or missing here, and replaced: "
"""An agent's words on files that it has mended, and reports for a day."""
READABLE_KEYS = ", others could read "
REMOVED_ENCLAVES = "The agent removed enclaves, "
FOREIGN_ENCLAVES = "This robot perhaps has enclaves of another robot: "
_OPEN_KEYS = ("private key that others can read", "private key others can read")
_ALTERNATED_SHOWN = timedelta(days=1)
_TWO_COMPUTERS = "Two computers with the keys of this robot"
_COPIED_KEYS = (READABLE_KEYS, REMOVED_ENCLAVES, FOREIGN_ENCLAVES, *_OPEN_KEYS, _TWO_COMPUTERS)
"""Words on private keys that somebody may have copied."""


def concerns_key(problem: str) -> bool:
    """Return whether a robot's problem is about a key, which a release cannot contain."""
    is_of_key = is_unusable(problem) and KEY_FILE in problem
    return is_of_key or KEY_NOT_HERE in problem or OF_ANOTHER_KEY in problem


def shows_old_copy(problem: str) -> bool:
    """Return whether a problem shows that the agent may fetch from an old copy of the releases."""
    phrases = (OLDER_THAN_SEEN, OLDER_THAN_INSTALLED, OF_OTHER_CA)
    return any(phrase in problem for phrase in phrases)


def is_unusable(problem: str) -> bool:
    """Return whether a robot's problem is that no process would start in an enclave."""
    return f" {COULD_NOT_START}: " in problem


def is_mended(problem: str) -> bool:
    """Return whether a robot's problem is over: its agent mended it, and reports it for a day."""
    return problem_rank(problem) == 2


def problem_rank(problem: str) -> int:
    """Return the rank of a robot's problem, 0 for the gravest: somebody may have copied a key.

    The rank is 2 for a problem that the agent has mended, such as a changed file.
    """
    if any(words in problem for words in _COPIED_KEYS):
        return 0
    return 2 if REPLACED_FILES in problem else 1


def is_enclave_below_root(name: str) -> bool:
    """Return whether ``name`` is the name of an enclave other than /."""
    try:
        return check_enclave_name(name) != "/"
    except InvalidNameError:
        return False


def enclave_of(path: str) -> str:
    """Return the name of the enclave to which the file at ``path`` in a keystore belongs."""
    return path.rpartition("/")[0].removeprefix(ENCLAVES) or "/"


# ── on the robot ───────────────────────────────────────────────────────────────────────────


def make_confirmation(
    root: Path,
    robot: str,
    *,
    now: datetime,
    unreadable: Callable[[str, Exception], None] | None = None,
) -> Confirmation:
    """Return a confirmation of all enclaves in ``root``, a keystore or a robot's security folder.

    Folders whose name is not the name of an enclave are left out, because no process can run in
    them.

    ``unreadable`` is called with the name of each enclave that has an unreadable file, and the
    error; the confirmation leaves this enclave out.  Without ``unreadable``, the error is raised.

    Raises:
        DocumentError: ``robot`` is not a robot's name.
        KeystoreError: ``root`` is not a keystore, or a file in ``root`` is a link that leads out of
            ``root``.
        OSError: a file cannot be read; a confirmation without this file would be false.
    """
    if problem := name_problem(robot):
        raise DocumentError(f"{robot!r} is not the name of a robot", problem)
    files: dict[str, str] = {}
    certificates: dict[str, tuple[str, ...]] = {}
    names = search_enclaves(root)[0] if unreadable else list_enclaves(root)
    with Folder(root) as folder:
        for name in names:
            if name != "/" and not is_enclave_below_root(name):
                continue
            try:
                contents = _confirmed_files(root, folder, name)
            except (SrosError, OSError) as error:
                if unreadable is None:
                    raise
                unreadable(name, error)
                continue
            for path, data in contents.items():
                files[path] = hashlib.sha256(data).hexdigest()
                if path.rpartition("/")[2] in _CERTIFICATE_FILES:
                    certificates[path] = certificate_digests(data)
    return Confirmation(robot, now, files, certificates)


def shortened_dds(dds: RobotDds) -> RobotDds:
    """Return a DDS with at most the libraries that a confirmation may state.

    The libraries beyond the limit count as unseen processes.
    """
    more = max(len(dds.libraries) - _MOST_LIBRARIES, 0)
    return RobotDds(dds.libraries[:_MOST_LIBRARIES], min(dds.unseen + more, _MOST_UNSEEN))


def shortened_problems(problems: Iterable[str]) -> tuple[str, ...]:
    """Return problems with the length and the number that confirmations allow, sorted by rank."""
    texts = []
    for problem in sorted(dict.fromkeys(problems), key=problem_rank):
        text = "".join(character if character.isprintable() else "?" for character in problem)
        texts.append(text if len(text) <= LONGEST_PROBLEM else f"{text[: LONGEST_PROBLEM - 3]}...")
    surplus = len(texts) - MOST_PROBLEMS
    if surplus > 0:
        texts = [*texts[: MOST_PROBLEMS - 1], f"There are {surplus + 1} more problems."]
    return tuple(texts)


def _confirmed_files(root: Path, folder: Folder, name: str) -> dict[str, bytes]:
    """Map the paths of an enclave's files that belong in a confirmation to the files' content.

    Raises:
        KeystoreError: a file is a link that leads out of the keystore.
        OSError: a file cannot be read.
    """
    paths = (f"{enclave_folder(name)}/{file}" for file in CONFIRMED_FILES)
    return {path: folder.read_inside(path) for path in paths if os.path.lexists(root / path)}


def certificate_digests(data: bytes) -> tuple[str, ...]:
    """Return the SHA-256 of the certificates (DER) in a PEM file, leaving out damaged ones."""
    digests = []
    for block in _CERTIFICATE_PEM.finditer(data):
        try:
            digests.append(hashlib.sha256(binascii.a2b_base64(block[1])).hexdigest())
        except binascii.Error:
            continue
    return tuple(digests[:_MOST_CERTIFICATES])


def render_confirmation(confirmation: Confirmation) -> bytes:
    """Return a confirmation as JSON, for `parse_confirmation`.

    Equal confirmations give equal bytes.
    """
    return _as_json_line(_value_of(confirmation))


def _value_of(confirmation: Confirmation) -> dict[str, Any]:
    dds = confirmation.dds
    return {
        "format": _FORMAT,
        "robot": confirmation.robot,
        "time": iso(confirmation.time),
        "files": dict(sorted(confirmation.files.items())),
        "certificates": {
            path: list(digests) for path, digests in sorted(confirmation.certificates.items())
        },
        **({} if confirmation.restart is None else {"restart": list(confirmation.restart)}),
        **({"dds": as_plain(dds)} if dds else {}),
        **{
            key: as_plain(value)
            for key in _AGENT_KEYS
            if (value := getattr(confirmation, key)) is not None
        },
    }


def _as_json_line(value: Mapping[str, Any]) -> bytes:
    return json.dumps(value, indent=1).encode() + b"\n"


# ── in the keystore ─────────────────────────────────────────────────────────────────────────


def parse_confirmation(data: bytes, label: str) -> Confirmation:
    """Return the confirmation in a JSON document; ``label`` names the document in errors.

    Raises:
        DocumentError: the document is too large or not a confirmation; the error names the fault.
    """
    if len(data) > MAX_BYTES:
        raise DocumentError(
            f"{label} is too large", f"A confirmation has at most {MAX_BYTES // 1024**2} MiB."
        )
    with _named_in_errors(label):
        return _confirmation_from(_json_value(data))


class LastMessage(NamedTuple):
    """The last verified message of a robot's agent."""

    sequence: int
    """Sequence number of the message; later messages have higher numbers."""
    sha256: str
    """SHA-256 of the message."""
    enclave: str
    """The enclave whose key signed the message."""
    boots: tuple[str, ...] = ()
    """Ids of the computer's starts that sent messages, the latest first."""
    alternated: datetime | None = None
    """When a message last came from an earlier start of the computer than the message before, or
    with an earlier release.
    """
    collected: datetime | None = None
    """When the message was first seen in an inbox, by the clock of the keystore's machine; None if
    an earlier release of sros took it.
    """

    def next_boots(
        self, boot: str | None, now: datetime
    ) -> tuple[tuple[str, ...], datetime | None]:
        """Return ``boots`` and ``alternated`` for the next record, after a message from ``boot``.

        ``boot`` is the digest of a start of the computer.  A computer never returns to an earlier
        start: if an earlier ``boot`` comes back after another one, two computers send messages.
        """
        if boot is None or boot in self.boots[:1]:
            return self.boots, self.alternated
        boots = (boot, *(known_boot for known_boot in self.boots if known_boot != boot))[
            :_MOST_BOOTS
        ]
        return boots, now if boot in self.boots else self.alternated


@dataclass(frozen=True, slots=True)
class ReceivedConfirmation:
    """A confirmation with the time of its receipt, by the clock of the keystore's machine.

    ``message`` is the last message of the robot's agent, even if a later confirmation came in
    another way; None if the agent never sent a message.
    """

    confirmation: Confirmation
    time: datetime
    message: LastMessage | None = None

    @property
    def latest(self) -> datetime:
        """The latest time at which the robot can have made the confirmation or its last message."""
        collected = self.message.collected if self.message else None
        return max(self.time, collected) if collected else self.time

    @property
    def is_alternation_shown(self) -> bool:
        """Whether messages of the last day came from two computers."""
        alternated = self.message.alternated if self.message else None
        return alternated is not None and self.time - alternated <= _ALTERNATED_SHOWN

    def two_computers_sentence(self, *, was_restored: bool, makes_keys: bool) -> str:
        """Return a sentence if messages of the last day came from two computers, or "".

        With ``was_restored``, the keystore was restored from a backup: its ledger may lack earlier
        keys of the robot, so new keys do not end the problem (`collect`).  With ``makes_keys``, the
        robot makes its keys itself.
        """
        alternated = self.message.alternated if self.message else None
        if alternated is None or not self.is_alternation_shown:
            return ""
        section = "Keys that are made on the robot" if makes_keys else "Same name, new hardware"
        return (
            f"{_TWO_COMPUTERS} seem to send messages in turn: a message came from an earlier start "
            "of the computer, or showed an earlier release, than the message before it; last at "
            f"{iso(alternated)}. Perhaps a disk was copied or restored. "
            "sros knows the files of only one of the two computers. Give the robot new keys, and "
            f"revoke the earlier keys (docs/howto/one_robot.md: {section})."
        ) + was_restored * (
            " Because the keystore was restored from a backup, this problem is shown, even if the "
            "robot has new keys, until a message comes after "
            f"{iso(alternated + _ALTERNATED_SHOWN)}."
        )

    def clock_note(self) -> str:
        """Return how far the robot's clock is off, as a clause; "" for up to one minute."""
        ahead = self.confirmation.time - self.time
        if abs(ahead) <= _CLOCK_TOLERANCE:
            return ""
        if ahead > timedelta():
            return f"its clock is {elapsed(ahead)} ahead"
        delay_clause = "or its confirmation took that long to arrive"
        return f"its clock is {elapsed(-ahead)} behind, {delay_clause}"


class KeptConfirmation(NamedTuple):
    """The confirmation of a robot, as written to the keystore."""

    keystore: NamedKeystore
    robot: str
    """Name of the robot."""
    received: datetime
    """When the confirmation was received, by the clock of the keystore's machine, in UTC."""
    clock: datetime
    """When the confirmation was made, by the clock of the robot, in UTC."""
    enclaves: Sequence[str]
    """Names of the enclaves that the robot has, sorted."""
    files: int
    """Number of files of these enclaves, without keys."""
    dry_run: DryRun
    changes: Sequence[FileChange]
    """The written file; with ``--dry-run``, the file that would be written."""
    notes: Notes


def receive(data: bytes, robot: str, label: str, *, now: datetime) -> ReceivedConfirmation:
    """Return the confirmation in ``data``, as received from ``robot`` at ``now``.

    Args:
        data: JSON as `render_confirmation` writes it.
        robot: the name of the robot.
        label: the name of the document in errors.
        now: the current time.

    Raises:
        DocumentError: ``data`` is not a confirmation, or the confirmation is by another robot.
    """
    confirmation = parse_confirmation(data, label)
    if confirmation.robot != robot:
        raise DocumentError(
            f"{label} is the confirmation of {confirmation.robot}, not of {robot}",
            "A robot can confirm only its own files.",
            f"If the report comes from {confirmation.robot}, add --robot {confirmation.robot}.",
        )
    return ReceivedConfirmation(confirmation, now.replace(microsecond=0))


def refuse_older_confirmation(keystore: OpenedKeystore, received: ReceivedConfirmation) -> None:
    """Raise `DocumentError` if a confirmation was made before the last one of its robot.

    If the robot's clock was ahead, the last confirmation counts as made when it was received.
    """
    previous = None
    with suppress(DocumentError):  # the last confirmation is damaged
        previous = last_confirmation(keystore, received.confirmation.robot)
    if previous and received.confirmation.time < min(previous.confirmation.time, previous.time):
        robot, time = received.confirmation.robot, iso(received.confirmation.time)
        raise DocumentError(
            f"the report of {robot}, made at {time}, is older than the robot's last confirmation, "
            f"made at {iso(previous.confirmation.time)}",
            "It does not show what the robot has now.",
            f"Make it again: `sros fleet report FOLDER --robot {robot}`. If the clock of the robot "
            "is behind, set it first.",
        )


@contextmanager
def locked_confirmations(root: Path) -> Iterator[None]:
    """Lock the confirmations of a keystore, so that no other process writes any in the meantime.

    Raises:
        KeystoreError: another process holds the lock for too long.
    """
    with Folder(root, for_owner=True) as folder:
        if not folder.is_folder(CONFIRMED):
            folder.mkdir(CONFIRMED, 0o755)
    with Folder(root / CONFIRMED, for_owner=True) as folder:
        lock = KeystoreLock(folder, "folder of confirmations")
        try:
            lock.acquire()
            yield
        finally:
            lock.release()


def store_confirmation(keystore: OpenedKeystore, received: ReceivedConfirmation) -> str:
    """Write a robot's confirmation to the keystore in place of the previous one.

    Returns the path of the confirmation, relative to the keystore.  The last message of the robot's
    agent is kept.  The caller must hold `locked_confirmations`.
    """
    robot = received.confirmation.robot
    path, message = confirmation_file(robot), received.message
    with suppress(DocumentError):  # the previous confirmation is damaged
        if message is None and (previous := last_confirmation(keystore, robot)):
            message = previous.message
    value = {
        "received": iso(received.time),
        **({"message": as_plain(message)} if message else {}),
        "confirmation": _value_of(received.confirmation),
    }
    _write_for_owner(keystore.root / path, value)
    return path


def _write_for_owner(path: Path, value: Mapping[str, Any]) -> None:
    with staged_file(path, _as_json_line(value), mode=0o644, for_owner=True) as put_in_place:
        put_in_place()


class RefusedMessage(NamedTuple):
    """Why the last message of a robot's agent was refused (a clause), and since when."""

    time: datetime
    why: str


def store_refusals(
    keystore: OpenedKeystore,
    previous: Mapping[str, RefusedMessage],
    refused: Mapping[str, str],
    *,
    now: datetime,
) -> None:
    """Write the reasons for refused messages, by robot, if they differ from ``previous``.

    ``refused`` maps robots to the reasons, as clauses.

    The caller must hold `locked_confirmations`.
    """
    reasons = {robot: why[:LONGEST_REASON] for robot, why in refused.items()}
    if {robot: refusal.why for robot, refusal in previous.items()} == reasons:
        return
    value = {
        robot: {
            "time": iso(previous[robot].time if previous.get(robot, ("", ""))[1] == why else now),
            "why": why,
        }
        for robot, why in sorted(reasons.items())
    }
    _write_for_owner(keystore.root / REFUSED, value)


def refusals(keystore: OpenedKeystore) -> dict[str, RefusedMessage]:
    """Return why the last messages of robots were refused, by robot.

    Raises:
        DocumentError: the file cannot be read or is damaged, so it is unknown whose messages were
            refused.
    """
    path = keystore.root / REFUSED
    if not os.path.lexists(path):
        return {}
    data = read_bytes(path, "refused messages", max_bytes=_MOST_REFUSALS)
    try:
        return {
            robot: RefusedMessage(parse_iso(refusal["time"]), str(refusal["why"]))
            for robot, refusal in parse_json(data).items()
        }
    except (SrosError, ValueError, TypeError, KeyError, AttributeError) as error:
        raise DocumentError(
            f"'{path}' is damaged",
            "So sros does not know from which robots the last message was refused.",
            "Remove it, and run `sros fleet collect`, which writes it again.",
        ) from error


def last_confirmation(keystore: OpenedKeystore, robot: str) -> ReceivedConfirmation | None:
    """Return the last confirmation of ``robot``; None if the keystore has none.

    Raises:
        DocumentError: the file of the confirmation is damaged or cannot be read.
    """
    path = keystore.root / confirmation_file(robot)
    if not os.path.lexists(path):
        return None
    data = read_bytes(path, "confirmation", max_bytes=2 * MAX_BYTES)
    with _named_in_errors(f"'{path}'"):
        value = _json_value(data)
        if not isinstance(value, dict) or value.keys() - {"message"} != {
            "received",
            "confirmation",
        }:
            raise _FormError('its keys are not "received" and "confirmation"')
        confirmation = _confirmation_from(value["confirmation"])
        if confirmation.robot != robot:
            raise _FormError(f"it is the confirmation of another robot, {confirmation.robot}")
        message = _message_from(value["message"]) if "message" in value else None
        return ReceivedConfirmation(confirmation, _moment_from(value["received"]), message)


# The readers of the parts of a confirmation; each raises `_FormError` for another form.

_CONFIRM_AGAIN = "Make the confirmation again on the robot."


class _FormError(ValueError):
    """A part of a confirmation is malformed; the text of the error is a clause."""

    def __init__(self, why: str, remedy: str = _CONFIRM_AGAIN) -> None:
        super().__init__(why)
        self.remedy = remedy


@contextmanager
def _named_in_errors(label: str) -> Iterator[None]:
    """Turn a `_FormError` of the body into a `DocumentError`: ``label`` is not a confirmation."""
    try:
        yield
    except _FormError as error:
        raise DocumentError(f"{label} is not a confirmation: {error}", "", error.remedy) from error


def _json_value(data: bytes) -> Any:
    try:
        return parse_json(data)
    except ValueError as error:
        raise _FormError("it is not JSON") from error


def _message_from(value: Any) -> LastMessage:
    """Return the last message of a robot's agent from its JSON value."""
    later = {"boots", "alternated", "collected"}  # fields added after release 0.3.0 of sros
    if not isinstance(value, dict) or value.keys() | later != set(LastMessage._fields):
        raise _FormError('the keys of its message are not "sequence", "sha256" and "enclave"')
    sha256 = _digest_from(value["sha256"], "the digest of its message")
    sequence = _sequence_from(value["sequence"])
    boots = value.get("boots", [])
    if not isinstance(boots, list) or not all(map(_is_digest, boots)):
        raise _FormError('"boots" of its message are not SHA-256 digests')
    enclave = _enclave_from(value["enclave"])
    alternated, collected = (
        None if value.get(key) is None else _moment_from(value[key])
        for key in ("alternated", "collected")
    )
    return LastMessage(sequence, sha256, enclave, tuple(boots), alternated, collected)


def _confirmation_from(value: Any) -> Confirmation:
    if not isinstance(value, dict):
        raise _FormError("it is not a JSON object")
    if value.get("format") != _FORMAT or type(value["format"]) is not int:
        raise _FormError(
            f"its format is not {_FORMAT}", "Use the same version of sros here and on the robot."
        )
    if unknown := sorted(value.keys() - _REQUIRED_KEYS - _OPTIONAL_KEYS):
        raise _FormError(
            f"it has the unknown key {_shortened(unknown[0])}; if the robot has a later release of "
            "sros, update sros here first",
        )
    if missing := sorted(_REQUIRED_KEYS - value.keys()):
        raise _FormError(f"it lacks {', '.join(missing)}")
    robot = value["robot"]
    if not isinstance(robot, str) or name_problem(robot):
        raise _FormError(f"{_shortened(robot)} is not the name of a robot")
    files = {
        path: _digest_from(digest, f"the digest of {path}")
        for path, digest in _file_entries(value, "files")
    }
    certificates = {}
    for path, digests in _file_entries({"certificates": {}, **value}, "certificates"):
        if path not in files or path.rpartition("/")[2] not in _CERTIFICATE_FILES:
            raise _FormError(f"it lists certificates of {path}, which is not a certificate file")
        is_short_list = isinstance(digests, list) and len(digests) <= _MOST_CERTIFICATES
        if not is_short_list or not all(map(_is_digest, digests)):
            raise _FormError(f"the certificates of {path} are not a list of SHA-256 digests")
        certificates[path] = tuple(digests)
    dds = _dds_from(value["dds"]) if "dds" in value else None
    restart = _restart_from(value["restart"]) if "restart" in value else None
    time = _moment_from(value["time"])
    agent = {key: _AGENT_READERS[key](value[key]) for key in _AGENT_KEYS if key in value}
    return Confirmation(robot, time, files, certificates, dds, restart, **agent)


def _restart_from(value: Any) -> tuple[str, ...]:
    if not isinstance(value, list):
        raise _FormError('"restart", "crl_restart" or "waiting" is not a list')
    return tuple(sorted(set(map(_enclave_from, value))))


def _enclave_from(name: Any) -> str:
    try:
        return check_enclave_name(name if isinstance(name, str) else "")
    except InvalidNameError:
        raise _FormError(f"{_shortened(name)} is not the name of an enclave") from None


def _digest_from(value: Any, label: str) -> str:
    if not _is_digest(value):
        raise _FormError(f"{label} is not a SHA-256 digest")
    return str(value)


def _sequence_from(value: Any) -> int:
    return _number_from(value, '"sequence" is not a positive number', least=1)


def _release_from(value: Any) -> int:
    return _number_from(value, '"release" is not a number')


def _number_from(value: Any, why: str, *, least: int = 0, most: int = _MOST_NUMBER) -> int:
    """Return a whole number from ``least`` to ``most``; other values raise the error ``why``."""
    if type(value) is not int or not least <= value <= most:
        raise _FormError(why)
    return value


def _expiry_from(value: Any) -> dict[str, EnclaveExpiry]:
    if not isinstance(value, dict):
        raise _FormError('"expiry" is not an object')
    expiry = {}
    for name, times in value.items():
        if not isinstance(times, dict) or times.keys() != set(EnclaveExpiry._fields):
            raise _FormError(
                'an entry of "expiry" does not have the keys "certificate" and "permissions"'
            )
        moments = (
            None if times[file] is None else _moment_from(times[file])
            for file in EnclaveExpiry._fields
        )
        expiry[_enclave_from(name)] = EnclaveExpiry(*moments)
    return expiry


def _running_from(value: Any) -> dict[str, RunningFiles]:
    if not isinstance(value, dict):
        raise _FormError('"running" is not an object')
    for state in value.values():
        if state not in tuple(RunningFiles):
            raise _FormError(f"{_shortened(state)} is not a state of running processes")
    return {_enclave_from(name): RunningFiles(state) for name, state in value.items()}


def _clock_from(value: Any) -> RobotClock:
    if value not in tuple(RobotClock):
        raise _FormError(f"{_shortened(value)} is not the state of a clock")
    return RobotClock(value)


def _problems_from(value: Any) -> tuple[str, ...]:
    problems = _list_from(value, MOST_PROBLEMS, "problems")
    for text in problems:
        if not (isinstance(text, str) and text.isprintable() and 0 < len(text) <= LONGEST_PROBLEM):
            raise _FormError(
                f'one of its "problems" is not printable text of at most {LONGEST_PROBLEM} '
                "characters"
            )
    return tuple(problems)


def _requests_from(value: Any) -> tuple[str, ...]:
    requests = _list_from(value, MOST_REQUESTS, "requests")
    for text in requests:
        if not (
            isinstance(text, str) and len(text) <= _LONGEST_REQUEST and _REQUEST_PEM.match(text)
        ):
            raise _FormError("one of its requests is not exactly one signing request in PEM")
    return tuple(requests)


def _list_from(value: Any, most: int, label: str) -> list[Any]:
    if not isinstance(value, list) or len(value) > most:
        raise _FormError(f"its {label} are not a list of at most {most} items")
    return value


def _crl_from(value: Any) -> str:
    if not (isinstance(value, str) and len(value) <= LONGEST_LIST and _CRL_PEM.match(value)):
        raise _FormError("its crl is too long, or not a text with revocation lists in PEM")
    return value


def _seal_from(value: Any) -> str:
    if not (isinstance(value, str) and len(value) <= LONGEST_SEAL and value.isascii()):
        raise _FormError("its seal is too long, or not a text in ASCII")
    return value


def _boot_from(value: Any) -> str:
    return _digest_from(value, '"boot"')


_AGENT_READERS: Mapping[str, Callable[[Any], Any]] = {
    "sequence": _sequence_from,
    "release": _release_from,
    "expiry": _expiry_from,
    "running": _running_from,
    "clock": _clock_from,
    "problems": _problems_from,
    "requests": _requests_from,
    "crl": _crl_from,
    "crl_restart": _restart_from,
    "waiting": _restart_from,
    "boot": _boot_from,
    "seal": _seal_from,
}


def _dds_from(value: Any) -> RobotDds:
    if not isinstance(value, dict) or value.keys() != set(RobotDds._fields):
        raise _FormError('the keys of "dds" are not "libraries" and "unseen"')
    why = "its count of unseen processes is not a number"
    unseen = _number_from(value["unseen"], why, most=_MOST_UNSEEN)
    libraries = _list_from(value["libraries"], _MOST_LIBRARIES, "DDS libraries")
    return RobotDds(tuple(map(_library_from, libraries)), unseen)


def _library_from(value: Any) -> RobotLibrary:
    if not isinstance(value, dict) or value.keys() != set(RobotLibrary._fields):
        raise _FormError(
            'the keys of a DDS library are not "product", "version", "path" and "seen"'
        )
    product, version, path, seen = (value[key] for key in RobotLibrary._fields)
    if product not in PRODUCTS:
        raise _FormError(f"{_shortened(product)} is not the name of a DDS that sros knows")
    if not isinstance(version, str) or (version and not _LIBRARY_VERSION.match(version)):
        raise _FormError(f"{_shortened(version)} is not the version of a DDS")
    if not isinstance(path, str) or not _LIBRARY_PATH.match(path):
        raise _FormError(f"{_shortened(path)} is not the path of a library")
    if seen not in tuple(LibraryUse):
        raise _FormError(f"{_shortened(seen)} does not say where a library was seen")
    return RobotLibrary(product, version, path, LibraryUse(seen))


def _file_entries(value: Mapping[str, Any], key: str) -> Iterator[tuple[str, Any]]:
    """Yield the (path, value) pairs of the JSON object at ``key``.

    Every path names an enclave file that belongs in confirmations.
    """
    entries = value[key]
    if not isinstance(entries, dict):
        raise _FormError(f"{key} is not an object")
    checked_folders: set[str] = set()
    for path, entry in entries.items():
        folder, _, file = path.rpartition("/")
        if folder not in checked_folders:
            if not _is_enclave_folder(folder):
                raise _FormError(f"{_shortened(path)} is not the path of a file of an enclave")
            checked_folders.add(folder)
        if file not in CONFIRMED_FILES:
            raise _FormError(f"{_shortened(path)} is not a file that a confirmation lists")
        yield path, entry


def _is_enclave_folder(folder: str) -> bool:
    top, slash, name = folder.partition("/")
    return top == ENCLAVES and (not slash or is_enclave_below_root(f"/{name}"))


def _is_digest(value: object) -> bool:
    return isinstance(value, str) and bool(_DIGEST.match(value))


def _moment_from(text: object) -> datetime:
    if isinstance(text, str) and _MOMENT_TEXT.match(text):
        try:
            return parse_iso(text)
        except ValueError:
            pass
    raise _FormError(f"its time {_shortened(text)} does not have the form 2027-05-21T12:50:48Z")


def _shortened(value: object) -> str:
    text = ascii(value) if isinstance(value, (str, int, float, bool)) else type(value).__name__
    return text if len(text) <= 80 else f"{text[:80]}..."
