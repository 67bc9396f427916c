"""What a robot's agent remembers between its runs, and its status: one small file, replaced whole.

The agent can do without the file: the installed release contains its number, and the sequence
numbers of messages follow the clock.
"""

from __future__ import annotations

import fcntl
import hashlib
import json
import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, fields, replace
from datetime import datetime, timedelta
from pathlib import Path
from shlex import quote
from typing import Any, NamedTuple

from sros_tool.agent.settings import agent_folder, read_settings
from sros_tool.checks.keystores.arrival import installed_sentences
from sros_tool.errors import KeystoreError, SrosError
from sros_tool.files import staged_file
from sros_tool.folders import Folder
from sros_tool.keystore.confirmation import CONFIRMED_FILES, COULD_NOT_START
from sros_tool.keystore.delivery.published import MOST_NUMBER
from sros_tool.keystore.delivery.release import sealed_robot
from sros_tool.keystore.layout import (
    CERTIFICATE_FILE,
    CRL_FILE,
    GOVERNANCE_FILE,
    IDENTITY_CA_FILE,
    PERMISSIONS_FILE,
    RELEASE_SEAL,
    enclave_folder,
    enclave_names,
    enclave_path,
    waits_for_answer,
)
from sros_tool.names import check_enclave_name
from sros_tool.pki.crl import load_crls, newest_list, read_lists
from sros_tool.validity import duration_text, parse_iso
from sros_tool.values import DryRun, FileChanges, Notes, as_plain, parse_json
from sros_tool.wording import first_few
from sros_tool.xml import read_bytes

_STATE_FILE = "state.json"
_LOCK_FILE = "lock"
_FORMAT = 1
_TRUST_FILES = tuple(
    file
    for file in CONFIRMED_FILES
    if file not in (CERTIFICATE_FILE, PERMISSIONS_FILE, GOVERNANCE_FILE)
)
"""Files of an enclave that decide whom it trusts: CAs and revocation list."""
_LONGEST_UPTIME = 1e10  # seconds


class CopiedKey(NamedTuple):
    """A private key that somebody may have copied, and the certificate of its enclave."""

    path: str
    """Path of the key in the security folder."""
    at: datetime
    """When the agent last saw that others could read the key, or when it removed the key."""
    key: str
    """SHA-256 of the public key; "" if it is not known."""
    serial: str
    """Serial number of the certificate (hexadecimal); "" if it is not known."""
    expires: datetime | None
    """Expiry of the certificate; None if it is not known."""


@dataclass(frozen=True, slots=True)
class AgentState:
    """The state that an agent keeps between its rounds.

    ``release`` is the number of the release that is installed with all its enclaves, and
    ``accepted`` the highest number that was verified: an older release is refused.  ``sequence`` is
    the number of the last message.  ``latest`` is the latest moment that has certainly passed,
    because a verified document became valid at that moment.  ``due`` are the enclaves whose
    processes were not yet seen with the installed files since the machine started; ``boot``
    identifies this start (see `boot_id`).  ``unseen`` are the enclaves in ``due`` of which no
    process was seen.  ``waiting`` are the enclaves in ``due`` whose units wait for ``restart_if``.
    ``restarted`` are the enclaves in ``due`` whose units were restarted after their files changed.
    ``list_due`` are the enclaves whose processes may lack the revocation
    list.  ``files`` maps enclaves to two digests at the end of the last round, as text: of all
    files, and of the files that decide whom the enclave trusts.  A change of a digest, whoever
    wrote the files, makes a restart due; ``list_since`` maps enclaves to the time since when the
    second digest is the same.  ``fetched`` and ``sent`` are when the source and the inbox were last
    reached. ``replaced`` and ``list_replaced`` map enclaves of `due` and `list_due` to when the
    agent last replaced their files, in seconds since the start of the machine: setting the clock
    does not change these times. ``repairs`` maps paths of files that differed from the release to
    the time of the last round that replaced them.  ``readable_keys`` are private keys that other
    users could read, and ``removed_keys`` the keys of enclaves that the agent removed because the
    installed release did not have them.
    """

    release: int = 0
    accepted: int = 0
    sequence: int = 0
    latest: datetime | None = None
    due: tuple[str, ...] = ()
    unseen: tuple[str, ...] = ()
    restarted: tuple[str, ...] = ()
    waiting: tuple[str, ...] = ()
    list_due: tuple[str, ...] = ()
    boot: str = ""
    fetched: datetime | None = None
    sent: datetime | None = None
    problems: tuple[str, ...] = ()
    repairs: Mapping[str, datetime] = field(default_factory=dict)
    list_since: Mapping[str, datetime] = field(default_factory=dict)
    replaced: Mapping[str, float] = field(default_factory=dict)
    list_replaced: Mapping[str, float] = field(default_factory=dict)
    readable_keys: tuple[CopiedKey, ...] = ()
    removed_keys: tuple[CopiedKey, ...] = ()
    files: Mapping[str, str] = field(default_factory=dict)

    def next_sequence(self, now: datetime) -> int:
        """Return the sequence number of the next message: higher than all earlier ones.

        The number follows the clock, so that the keystore accepts the messages of a robot whose
        disk was restored.
        """
        return max(self.sequence, int(now.timestamp())) + 1


_STATE_KEYS = frozenset(key.name for key in fields(AgentState))


def read_state(folder: Path) -> AgentState:
    """Return the state of the agent of ``folder``.

    If the file of the state is missing or damaged, this is a new state.  The seal of the accepted
    release gives ``accepted``, if its number is higher.
    """
    state = AgentState()
    with suppress(SrosError, OSError, ValueError, TypeError, KeyError):
        path = agent_folder(folder) / _STATE_FILE
        state = _state_from(parse_json(read_bytes(path, "agent's state")))
    seal = read_seal(folder)
    with suppress(SrosError):
        number = sealed_robot(seal).number if seal else 0
        if number > state.accepted:
            return replace(state, accepted=number)
    return state


def _state_from(value: Any) -> AgentState:
    """Return the state in a JSON value.

    Raises:
        ValueError, TypeError, KeyError, InvalidNameError: the value has another form.
    """
    if not isinstance(value, dict) or value.pop("format", None) != _FORMAT:
        raise ValueError("another format")
    for number in ("release", "accepted", "sequence"):
        if type(value[number]) is not int or not 0 <= value[number] <= MOST_NUMBER:
            raise ValueError(number)
    for moment in ("latest", "fetched", "sent"):
        if value.get(moment) is not None:
            value[moment] = parse_iso(_checked_text(value[moment]))
    value["boot"] = _checked_text(value["boot"])
    value = {"list_due": value["due"], "restarted": [], "waiting": [], **value}
    for names in ("due", "unseen", "restarted", "waiting", "list_due"):
        value[names] = tuple(check_enclave_name(_checked_text(name)) for name in value[names])
    value["files"] = {
        check_enclave_name(_checked_text(name)): _checked_text(text)
        for name, text in dict(value.get("files", {})).items()
    }
    for moments in ("repairs", "list_since"):
        value[moments] = {
            _checked_text(path): parse_iso(_checked_text(moment))
            for path, moment in dict(value.get(moments, {})).items()
        }
    for keys in ("readable_keys", "removed_keys"):
        value[keys] = tuple(map(_copied_key_from, value.get(keys, ())))
    for seconds in ("replaced", "list_replaced"):
        value[seconds] = {
            check_enclave_name(_checked_text(name)): _checked_uptime(moment)
            for name, moment in dict(value.get(seconds, {})).items()
        }
    value["problems"] = tuple(map(_checked_text, value["problems"]))
    # An agent of another version may remember more.
    return AgentState(**{key: value[key] for key in value.keys() & _STATE_KEYS})


def _copied_key_from(value: Mapping[str, Any]) -> CopiedKey:
    path, at, key, serial = (_checked_text(value[name]) for name in CopiedKey._fields[:4])
    int(serial or "0", 16)
    expires = value["expires"]
    until = None if expires is None else parse_iso(_checked_text(expires))
    return CopiedKey(path, parse_iso(at), key, serial, until)


def _checked_uptime(value: Any) -> float:
    if not isinstance(value, int | float) or not 0 <= value <= _LONGEST_UPTIME:
        raise ValueError(f"{value!r} is not a number of seconds since the start of a machine")
    return float(value)


def _checked_text(value: Any) -> str:
    if not isinstance(value, str):
        raise TypeError(f"{value!r} is not text")
    return value


def write_state(folder: Path, state: AgentState) -> None:
    """Write the state of the agent of ``folder``.

    Raises:
        OSError: the state cannot be written; the earlier state stays.
    """
    text = json.dumps({"format": _FORMAT, **as_plain(state)}, indent=1)
    with staged_file(agent_folder(folder) / _STATE_FILE, text.encode() + b"\n") as put_in_place:
        put_in_place()


def mark_outdated(folder: Path) -> None:
    """Mark the state as outdated, by setting the modification time of its file to 0.

    The next `write_state` removes the mark.  On a file system that became read-only, only the age
    of the state shows that it is outdated.
    """
    with suppress(OSError), Folder(agent_folder(folder)) as opened:
        opened.set_time(_STATE_FILE, 0)


def _outdated_sentences(folder: Path) -> Iterator[str]:
    """Yield a sentence if the last round could not write its state."""
    with suppress(OSError):
        if (agent_folder(folder) / _STATE_FILE).stat().st_mtime == 0:
            yield (
                f"The last round could not write to '{agent_folder(folder)}', so its result is not "
                "known. Make room on the disk."
            )


def read_seal(folder: Path) -> bytes:
    """Return the seal of the release that was accepted last; b"" if there is none."""
    with suppress(SrosError, OSError):
        return read_bytes(agent_folder(folder) / RELEASE_SEAL, "seal of the release")
    return b""


def robot_in_seal(folder: Path) -> str:
    """Return the robot of the release that was accepted last; "" if it is not known."""
    with suppress(SrosError):
        return sealed_robot(read_seal(folder)).robot
    return ""


def refuse_files_of_other_robot(folder: Path, robot: str) -> None:
    """Raise `KeystoreError` if a folder has the enclaves of another robot than ``robot``.

    The seal of the last release has the robot's name.  A robot that got another name keeps the
    enclaves whose paths do not have its former name.
    """
    before = robot_in_seal(folder)
    named = {part for name in enclave_names(folder) for part in name.split("/")}
    if before and before != robot and before in named and robot not in named:
        raise KeystoreError(
            f"'{folder}' has the enclaves of robot {before}, not of {robot}",
            f"An agent for {robot} could not install anything there. Nothing was changed.",
            f"Give --robot {before}. If this computer is {robot} now, choose an empty folder, and "
            f"bring the enclaves of {robot} there (`sros distribute_key KEYSTORE --robot {robot} "
            "FOLDER`).",
        )


def write_seal(folder: Path, seal: bytes) -> None:
    """Write the seal of the accepted release into the agent's folder in ``folder``.

    Raises:
        OSError: the seal cannot be written; the earlier seal stays.
    """
    if read_seal(folder) != seal:
        with staged_file(agent_folder(folder) / RELEASE_SEAL, seal, mode=0o644) as put_in_place:
            put_in_place()


def enclave_digests(folder: Path, names: Iterable[str]) -> dict[str, str]:
    """Map each enclave to two digests: of its files without the key, and of its trust files.

    Both are in one text, with a space between them. The trust files decide which other enclaves
    the enclave accepts. Of a revocation list, only the revoked certificates count: a list that
    was only signed again makes no restart due.
    """
    with Folder(folder) as opened:
        return {
            name: " ".join(
                hashlib.sha256(
                    " ".join(
                        read_digest(opened, f"{enclave_folder(name)}/{file}") or "-"
                        for file in files
                    ).encode()
                ).hexdigest()
                for files, read_digest in (
                    (CONFIRMED_FILES, sha256_of),
                    (_TRUST_FILES, _trust_digest),
                )
            )
            for name in names
        }


def sha256_of(folder: Folder, path: str) -> str:
    """Return the SHA-256 of a file; "" if it is missing or cannot be read."""
    with suppress(SrosError, OSError):
        return hashlib.sha256(folder.read_inside(path)).hexdigest()
    return ""


def _trust_digest(folder: Folder, path: str) -> str:
    """Return the digest by which a change of a trust file is noticed.

    For a revocation list that a CA of the enclave signed, the digest is only of the revoked serial
    numbers; otherwise it is of the whole file.
    """
    place, _, file = path.rpartition("/")
    with suppress(SrosError, OSError):
        data = folder.read_inside(path) if file == CRL_FILE else b""
        signed = newest_list(data, folder.read_inside(f"{place}/{IDENTITY_CA_FILE}"))
        if signed is not None and len(read_lists(data, "here")) == 1:
            revoked = sorted(revoked_serials(data.decode()))
            return hashlib.sha256(
                f"{signed.issuer.public_bytes()!r} {revoked}".encode()
            ).hexdigest()
    return sha256_of(folder, path)


def revoked_serials(text: str) -> frozenset[int]:
    """Return the serial numbers in revocation lists (PEM); none if one cannot be read."""
    with suppress(SrosError):
        lists = load_crls(text.encode(), "here")
        return frozenset(entry.serial for crl in lists for entry in crl.revoked)
    return frozenset()


@contextmanager
def agent_lock(folder: Path) -> Iterator[None]:
    """Let only one agent at a time work in ``folder``.

    Raises:
        KeystoreError: another agent works in ``folder``.
    """
    with Folder(agent_folder(folder)) as opened:
        handle = opened.open_private(_LOCK_FILE)
        try:
            try:
                fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                raise KeystoreError(
                    f"another agent is running in '{folder}'",
                    "",
                    "Wait until its round ends, or see `systemctl status sros-agent`.",
                ) from None
            yield
        finally:
            os.close(handle)


class InitializedAgent(NamedTuple):
    """An agent that was set up."""

    folder: Path
    """FOLDER, as given on the command line."""
    dry_run: DryRun
    robot: str
    """Name of the robot."""
    root_sha256: str | None
    """SHA-256 of the root metadata of ``--root``; null with ``--dry-run`` or without ``--root``."""
    kept: tuple[str, ...]
    """With ``--force``: the options whose earlier values stay, such as ``--restart``."""
    changes: FileChanges
    notes: Notes


class AgentStatus(NamedTuple):
    """The last round of a robot's agent, and its pending work."""

    folder: Path
    """FOLDER, as given on the command line."""
    robot: str
    """Name of the robot."""
    source: str
    """Where releases are fetched from."""
    inbox: str
    """Where messages are sent to."""
    release: int
    """Number of the release that is installed with all its enclaves; 0 for none."""
    accepted: int
    """Number of the last release that was verified; if it is higher than ``release``, some
    enclaves do not have the files of this release yet.
    """
    fetched: datetime | None
    """When the source was last reached, by the clock of the robot, in UTC; null for never."""
    sent: datetime | None
    """When the inbox was last reached, by the clock of the robot, in UTC; null for never."""
    restart: Sequence[str]
    """Enclaves whose processes were not yet seen with the installed files."""
    unseen: Sequence[str]
    """Enclaves of ``restart`` of which no process was seen, perhaps because some processes on this
    machine cannot be seen. Use ``sros agent run FOLDER --once --restarted`` to say that these
    restarts are done.
    """
    waiting: Sequence[str]
    """Enclaves of ``restart`` that wait: the agent restarts their units in the first round in which
    the command of ``--restart-if`` exits with 0.
    """
    problems: Sequence[str]
    """What the last round could not do, that source or inbox were not reached within
    ``--max-age``, and what is wrong with the files now, as sentences.
    """
    well: bool
    """Whether nothing is wrong or due, and source and inbox were reached within ``--max-age``."""


def agent_status(folder: Path, *, now: datetime, oldest: timedelta) -> AgentStatus:
    """Return the result of the agent's last round, and the present problems of the files.

    If the source or the inbox was last reached longer than ``oldest`` ago, this is a problem.

    Raises:
        SrosError: the folder has no agent, or its settings are malformed.
    """
    settings, state = read_settings(folder), read_state(folder)
    whole = 0 < state.release == state.accepted
    problems = (
        *_outdated_sentences(folder),
        *state.problems,
        *_unreached_sentences(folder, state, now, oldest),
        *_present_problems(folder, state, now),
    )
    return AgentStatus(
        folder,
        settings.robot,
        settings.source,
        settings.inbox,
        state.release,
        state.accepted,
        state.fetched,
        state.sent,
        state.due,
        state.unseen,
        state.waiting,
        problems,
        whole and not state.due and not problems,
    )


def _unreached_sentences(
    folder: Path, state: AgentState, now: datetime, oldest: timedelta
) -> Iterator[str]:
    """Yield a sentence if the source or the inbox was not reached within ``oldest``."""
    places = {"source": state.fetched, "inbox": state.sent}
    unreached = [
        place for place, time in places.items() if time is None or abs(now - time) > oldest
    ]
    if unreached:
        names = " and ".join(f"the {place}" for place in unreached)
        yield (
            f"The agent did not reach {names} within --max-age ({duration_text(oldest)}). Check "
            f"that the agent runs and that the clock is right; `sros agent run "
            f"{quote(str(folder))} --once` tries now, and names what fails."
        )


def _present_problems(folder: Path, state: AgentState, now: datetime) -> Iterator[str]:
    """Yield sentences on present problems of the files that the last round did not report."""
    names = [n for n in enclave_names(folder) if not waits_for_answer(enclave_path(folder, n))]
    for name in sorted(state.files.keys() - {*names}):
        yield f"{name} had a certificate in the last round of the agent, and has none now."
    digests = enclave_digests(folder, names)
    changed = {name for name in names if digests[name] != state.files.get(name, digests[name])}
    known = {*state.problems}
    subjects = {text.partition(COULD_NOT_START)[0] for text in known if COULD_NOT_START in text}
    for sentence in installed_sentences(folder, names, now):
        if sentence not in known and sentence.partition(COULD_NOT_START)[0] not in subjects:
            yield sentence
            changed.discard(sentence.partition(f" {COULD_NOT_START}: ")[0])
    if changed:
        yield (
            f"Files of {first_few(sorted(changed), 3)} were changed after the last round of the "
            f"agent. Run `sros agent run {quote(str(folder))} --once`: the agent then restores the "
            "files of the release, or reports what differs."
        )
