"""A round of a robot's agent: fetch, install, restart, examine processes, and report.

A part that fails is reported as a problem of the round, and the other parts still run.  So a robot
that cannot reach its source still sends its report, and a robot that cannot reach its inbox still
installs releases.
"""

from __future__ import annotations

import errno
import hashlib
import os
import time
from collections import defaultdict
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from datetime import datetime, timedelta, tzinfo
from pathlib import Path
from typing import NamedTuple, TypeVar

from cryptography import x509
from cryptography.hazmat.primitives.serialization import Encoding

from sros_tool.agent.fetch import ClientCertificate, FetchError, FetchProblem, fetch_release
from sros_tool.agent.inbox import RefusedError, send
from sros_tool.agent.install import (
    DiskFullError,
    Installation,
    files_made_after,
    install_release,
    present_lists,
    release_time,
    waits_for_answer,
)
from sros_tool.agent.renewals import (
    Renewals,
    drop_installed_keys,
    enclave_key,
    renewals,
    waiting_keys,
)
from sros_tool.agent.running import (
    EnclaveProcesses,
    Restarts,
    Systemd,
    enclaves_to_restart,
    kernel_clock,
    look_at_processes,
    restart_units,
)
from sros_tool.agent.settings import AgentSettings, Unit, agent_folder
from sros_tool.agent.state import (
    CopiedKey,
    enclave_digests,
    mark_outdated,
    read_seal,
    read_state,
    revoked_serials,
    robot_in_seal,
    sha256_of,
    write_seal,
    write_state,
)
from sros_tool.checks.keystores.arrival import (
    InstalledEnclave,
    exposed_keys,
    exposed_sentences,
    open_installed,
    unusable_sentences,
)
from sros_tool.errors import SrosError, UnavailableError
from sros_tool.faults import KEY_MADE_ON_ROBOT
from sros_tool.files import remove_file, replace_file
from sros_tool.folders import Folder
from sros_tool.keystore.confirmation import (
    FOREIGN_ENCLAVES,
    LONGEST_LIST,
    LONGEST_SEAL,
    OF_SAME_NUMBER,
    READABLE_KEYS,
    REMOVED_ENCLAVES,
    REPLACED_FILES,
    Confirmation,
    EnclaveExpiry,
    RobotClock,
    RunningFiles,
    concerns_key,
    enclave_of,
    make_confirmation,
    problem_rank,
    render_confirmation,
    shortened_dds,
    shortened_problems,
)
from sros_tool.keystore.delivery.archive import listed_digests
from sros_tool.keystore.delivery.release import Release, sealed_robot
from sros_tool.keystore.layout import (
    CERTIFICATE_FILE,
    CRL_FILE,
    GOVERNANCE_FILE,
    IDENTITY_CA_FILE,
    KEY_FILE,
    PERMISSIONS_CA_FILE,
    ROUTER_FILE,
    enclave_folder,
    enclave_path,
    search_enclaves,
)
from sros_tool.keystore.reader import read_certificate
from sros_tool.keystore.transaction import recover_keystore
from sros_tool.names import check_enclave_name
from sros_tool.pki import smime
from sros_tool.pki.certificates import (
    common_name_of,
    key_digest,
    key_digest_of_ca,
    load_certificates,
    pem,
    validity_of,
)
from sros_tool.pki.crl import list_number, newest_list
from sros_tool.pki.keys import load_key
from sros_tool.pki.token import Secrets
from sros_tool.runtime.processes import RunningProcesses, boot_id
from sros_tool.validity import elapsed, iso, time_of_file
from sros_tool.wording import capitalized, counted, first_few
from sros_tool.xml import read_bytes

_CLOCK_TOLERANCE = timedelta(minutes=2)
_LOOK_SECONDS = 0.2
_GRAVEST_FILES = (CRL_FILE, IDENTITY_CA_FILE, PERMISSIONS_CA_FILE, GOVERNANCE_FILE)
"""The files that are named first if they were changed: they decide for all other enclaves, too."""
_MOST_COPIED = 4000
"""Maximum number of keys of each kind that the agent remembers because somebody may have copied
them: one for each enclave of a large robot.  It keeps those that it has reported first."""
_REPLACED_LIST = "replaced.crl.pem"
_KEEP_REPLACED_LIST = timedelta(days=30)
"""How long the agent sends a revocation list after a release replaced it by a shorter one.
"""
_REPAIRS_REPORTED_FOR = timedelta(days=1)
"""How long the agent reports that it replaced files which differed from the release."""
_BRING_KEY = (
    " A release has no keys: run `sros distribute_key KEYSTORE --robot {} DIR --force` on the "
    "keystore machine, and bring DIR here. If the key was made on a robot, the keystore does "
    "not have it: make a new key, as for new hardware (docs/howto/one_robot.md). If another "
    "computer replaced this one, switch this computer off instead."
)
_DISK_FULL = (errno.ENOSPC, errno.EDQUOT)
_ServerAnswer = TypeVar("_ServerAnswer")
_MOST_CERTIFICATES = 8
"""Maximum number of client certificates that the agent tries if a web server refuses them."""


class Round(NamedTuple):
    """The result of a round of the agent."""

    release: int
    """Number of the release that is installed with all its enclaves; 0 for none."""
    accepted: int
    """Number of the last release that was verified; if it is higher than ``release``, some
    enclaves do not have the files of this release yet.
    """
    fetched: bool
    """Whether the agent reached the source, and trusted its metadata."""
    changed: Sequence[str]
    """Enclaves of which a file changed."""
    removed: Sequence[str]
    """Enclaves that were removed, because the release does not have them."""
    lists: Sequence[str]
    """Enclaves that got only the revocation list of a new release, because the disk is full."""
    restart: Sequence[str]
    """Enclaves whose processes were not yet seen with the installed files."""
    unseen: Sequence[str]
    """Enclaves of ``restart`` of which no process was seen, perhaps because some processes on this
    machine cannot be seen. Use ``--restarted`` to say that these restarts are done.
    """
    restarted: Sequence[Unit]
    """Units that the agent restarted in this round."""
    waiting: Sequence[str]
    """Enclaves of ``restart`` that wait: the agent restarts their units in the first round in which
    the command of ``--restart-if`` exits with 0.
    """
    requests: int
    """Number of signing requests in the message to the inbox."""
    sent: bool
    """Whether the message reached the inbox."""
    problems: Sequence[str]
    """What the agent could not do, and what is wrong, as sentences."""


@dataclass(frozen=True, slots=True)
class Machine:
    """The inputs of a round: time, time zone, and functions that read and change the machine.

    ``look`` returns the running processes, ``clock`` whether a time service set the clock, and
    ``boot`` an id of the start of the machine; ``fetch`` fetches a release, and ``systemd``
    restarts units (None: the usual ones).
    """

    now: datetime
    zone: tzinfo
    secrets: Secrets
    look: Callable[[datetime], RunningProcesses] | None = None
    systemd: Systemd | None = None
    fetch: Callable[..., Release | None] = fetch_release
    clock: Callable[[], RobotClock] = kernel_clock
    boot: Callable[[], str] = boot_id
    patience: float = 10.0
    """Most seconds to wait until the processes of restarted units are seen."""
    restarted: bool = False
    """Whether somebody says that all processes were restarted since the last round."""


def run_round(folder: Path, settings: AgentSettings, machine: Machine) -> Round:
    """Run a round of the agent in the security folder ``folder``.

    Raises:
        KeystoreError: the folder as a whole cannot be used.
    """
    return _Round(folder, settings, machine).run()


class _Round:
    """A round that is under way, with its problems so far."""

    def __init__(self, folder: Path, settings: AgentSettings, machine: Machine) -> None:
        self._folder = folder
        self._settings = settings
        self._machine = machine
        self._problems: list[str] = []
        self._restarts = Restarts()
        self._state = read_state(folder)
        self._is_in_step = False
        """Whether the installed files, with their revocation list, are those of the last
        release."""
        self._began = _since_boot()

    def run(self) -> Round:
        now, before = self._machine.now, self._state
        self._try_part(lambda: recover_keystore(self._folder))
        boot = self._machine.boot()
        # Only two known ids prove a start of the machine; otherwise, restarts stay due.
        has_started = bool(before.boot and boot and before.boot != boot)
        self._state = replace(before, boot=boot)
        if self._machine.restarted or has_started:
            # After a start of the machine, no process has earlier files, so earlier restarts are
            # not due.
            self._forget_restarts()
        # Note this before files are replaced: processes may have started with the present files.
        self._note_due_restarts((), self._enclaves())
        if self._machine.restarted:
            self._forget_restarts()
        clock = self._clock_compared_with_proven_time(self._proven_moment())
        # Verified documents prove that ``before.latest`` has passed, whatever the clock shows.
        certain = max(now, before.latest) if before.latest else now
        # Remembered now, because installing closes the keys of changed enclaves to others.
        exposed = {key.path: key for key in self._still_copied(before.readable_keys)}
        for path in exposed_keys(self._folder, now):
            exposed[path] = self._copied_key(path)
        self._state = replace(self._state, readable_keys=tuple(exposed.values())[:_MOST_COPIED])
        installation, fetched = self._fetch_and_install(certain)
        if clock is not RobotClock.BEHIND and installation.made:
            clock = self._clock_compared_with_release(installation.made) or clock
        self._note_unreleased_enclaves()
        self._note_repaired_files(now)
        self._note_removed_enclaves()
        names = self._enclaves()
        opened = open_installed(self._folder, names, now=now)
        if clock is not RobotClock.BEHIND:  # with a wrong clock, valid files look unusable
            self._problems += unusable_sentences(opened)
        self._problems += exposed_sentences(self._folder, now)
        self._note_closed_keys(now)
        self._note_due_restarts(installation.changed, names)
        restarted: Sequence[str] = ()
        # With a wrong clock, nodes would not accept their certificates.
        if clock is not RobotClock.BEHIND:
            restarted = self._restart(names, opened)
        processes = self._examine_restarted(restarted, names)
        self._problems += [f"{problem}." for problem in processes.problems]
        due = enclaves_to_restart(self._state.due, processes.states, complete=processes.complete)
        unseen = tuple(name for name in due if processes.states[name] is RunningFiles.NOT_SEEN)
        list_due = enclaves_to_restart(
            self._state.list_due, processes.list_states, complete=processes.complete
        )
        again = tuple(name for name in self._state.restarted if name in due)
        waiting = {*_enclaves_of(self._restarts.waiting)}
        self._state = replace(
            self._state,
            due=due,
            unseen=unseen,
            list_due=list_due,
            restarted=again,
            waiting=tuple(name for name in due if name in waiting),
            replaced=_moments_of(due, self._state.replaced),
            list_replaced=_moments_of(list_due, self._state.list_replaced),
        )
        own = self._own_enclaves(names)
        asked = renewals(
            self._folder,
            own,
            now=now,
            new_key=self._settings.new_key,
            secrets=self._machine.secrets,
        )
        self._problems += asked.problems
        arrived = self._confirm(names, opened, processes, clock, asked)
        self._state = replace(
            self._state,
            fetched=now if fetched else self._state.fetched,
            problems=self._sorted_problems(),
        )
        self._save_state()
        return Round(
            self._state.release,
            self._state.accepted,
            fetched,
            installation.changed,
            installation.removed,
            installation.lists,
            self._state.due,
            self._state.unseen,
            self._restarts.units,
            self._state.waiting,
            len(asked.requests),
            arrived,
            self._sorted_problems(),
        )

    # ── parts of a round ───────────────────────────────────────────────────────────────────

    def _sorted_problems(self) -> tuple[str, ...]:
        return tuple(sorted(dict.fromkeys(self._problems), key=problem_rank))

    def _try_part(self, work: Callable[[], None]) -> bool:
        """Call ``work``; return whether it succeeded, and add a problem to the round if not."""
        try:
            work()
        except (SrosError, OSError) as error:
            self._note_error(error)
            return False
        return True

    def _note_error(self, error: SrosError | OSError) -> None:
        if isinstance(error, OSError):
            self._problems.append(self._write_error_text(error))
        else:
            self._problems.append(_error_sentence(error))

    def _write_error_text(self, error: OSError) -> str:
        where = f" '{os.fsdecode(error.filename)}'" if error.filename else ""
        text = f"The operating system refuses{where}: {error.strerror or error}."
        if error.errno in _DISK_FULL:
            return f"{text} Make room on the disk of '{self._folder}'; the agent then continues."
        return text

    def _save_state(self) -> None:
        if not self._try_part(lambda: write_state(self._folder, self._state)):
            mark_outdated(self._folder)

    def _clock_compared_with_proven_time(self, proven_time: datetime | None) -> RobotClock:
        now = self._machine.now
        if proven_time and now + _CLOCK_TOLERANCE < proven_time:
            what = "verified documents" if self._state.latest else "the certificates of this robot"
            self._problems.append(
                f"The clock shows {iso(now)}, but {what} are valid only from {iso(proven_time)}: "
                f"the clock is at least {elapsed(proven_time - now)} behind. "
                "Nothing is restarted; set the clock."
            )
            return RobotClock.BEHIND
        return self._machine.clock()

    def _clock_compared_with_release(self, made: datetime) -> RobotClock | None:
        """Return and report ``BEHIND`` if a release was ``made`` after the clock; else None."""
        now = self._machine.now
        if made <= now + _CLOCK_TOLERANCE:
            return None
        self._problems.insert(  # the cause comes before its consequences
            0,
            f"The clock shows {iso(now)}, but the published release was made at {iso(made)}: the "
            f"clock is at least {elapsed(made - now)} behind, unless the clock of the keystore "
            "machine was ahead. Nothing is restarted, and files that are not valid yet are not "
            "installed; set the clock.",
        )
        return RobotClock.BEHIND

    def _proven_moment(self) -> datetime | None:
        """Return the latest moment that is proven to be past; None if none is known.

        Verified documents prove it. If none was verified yet, it is the moment when the first
        certificate of the enclaves began to be valid.
        """
        if self._state.latest:
            return self._state.latest
        begins = []
        for name in self._enclaves():
            with suppress(SrosError, OSError):
                path = enclave_path(self._folder, name) / CERTIFICATE_FILE
                begins.append(validity_of(read_certificate(path)).not_before)
        return min(begins, default=None)

    def _fetch_and_install(self, certain_time: datetime) -> tuple[Installation, bool]:
        """Fetch and install a release; return the changes, and whether the source was reached."""
        settings, state = self._settings, self._state
        changed_files = self._changed_files()
        with Folder(self._folder) as opened:
            here = search_enclaves(self._folder)[0]
            waiting = {name for name in here if waits_for_answer(opened, name)}

        def fetch(certificate: ClientCertificate | None) -> Release | None:
            return self._machine.fetch(
                agent_folder(self._folder),
                settings.source,
                settings.robot,
                now=certain_time,
                installed=0 if changed_files or changed_files is None else state.accepted,
                client_certificate=certificate,
                tls_ca=Path(settings.tls_ca) if settings.tls_ca else None,
            )

        try:
            release = self._ask_as_enclave(settings.source, fetch)
        except (SrosError, OSError) as error:
            self._note_error(error)
            if isinstance(error, FetchError) and error.problem is FetchProblem.EXPIRED:
                self._problems.append(
                    f"The clock of this robot shows {iso(self._machine.now)}; if the time is "
                    "wrong, set the clock."
                )
            return Installation(), False
        if release is None:
            self._is_in_step = True
            return Installation(), True
        unreleased = {
            name: self._copied_key(f"{enclave_folder(name)}/{KEY_FILE}")
            for name in here
            if name not in release.enclaves()
        }
        released_before: Collection[str] = ()
        with suppress(SrosError):  # without a readable seal, nothing counts as released
            released_before = self._released_files()
        is_later = release.number != state.accepted
        brought: Collection[str] = ()
        if changed_files and is_later and state.latest:
            brought = files_made_after(state.latest, self._folder, release, changed_files)
        installation = self._install(release, certain_time)
        repaired = (
            path
            for path, sha256 in (changed_files or {}).items()
            if path in installation.written
            # Before a later release, somebody may have brought new files, or removed an enclave to
            # make a new key and request for it.
            and not (is_later and (path in brought or (not sha256 and enclave_of(path) in waiting)))
        )
        moments = dict.fromkeys(repaired, self._machine.now)
        self._state = replace(self._state, repairs={**self._state.repairs, **moments})
        # A later release removes what the release before had; nobody copied that key.
        removed = [
            unreleased[name]
            for name in installation.removed
            if name in unreleased
            and (
                not is_later or (state.accepted and _certificate_path(name) not in released_before)
            )
        ]
        known = {(key.path, key.serial): key for key in (*self._state.removed_keys, *removed)}
        self._state = replace(self._state, removed_keys=tuple(known.values())[:_MOST_COPIED])
        return installation, True

    def _foreign_key_sentence(self, name: str, own: Collection[str]) -> str:
        """Return what to do if an enclave's folder has the files of another robot's enclave, or "".

        ``own`` are the enclaves of this robot.
        """
        with suppress(SrosError, OSError):
            certificate = read_certificate(self._folder / _certificate_path(name))
            other = check_enclave_name(common_name_of(certificate.subject))
            if other not in own:
                return (
                    f" The certificate here is of {other}: if its key was here, too, it was in "
                    f"wrong hands: `sros renew KEYSTORE {other} --new-key --revoke-old`."
                )
        return ""

    def _changed_files(self) -> dict[str, str] | None:
        """Map each file that is missing, or differs from the installed release, to its SHA-256.

        The SHA-256 is "" for a missing file.

        If the release lacks an enclave, the path of its certificate is included, too, because
        installing the release removes this enclave; enclaves in `_newer_enclaves` stay. The result
        is None if no release is installed with all its enclaves, or if the seal of the release
        cannot be read.
        """
        state = self._state
        if not state.accepted or state.release != state.accepted:
            return None
        try:
            released = self._released_files()
            with Folder(self._folder) as opened:
                newer = self._newer_enclaves()
                others = (_certificate_path(name) for name in self._enclaves() if name not in newer)
                present = {path: sha256_of(opened, path) for path in (*released, *others)}
        except (SrosError, OSError):
            return None
        return {path: sha256 for path, sha256 in present.items() if sha256 != released.get(path)}

    def _released_files(self) -> dict[str, str]:
        """Map the path of each file of the accepted release to the SHA-256 in the seal.

        Raises:
            SrosError: the seal is missing or damaged.
        """
        lines = smime.parse(read_seal(self._folder)).text.splitlines()
        parts = (line.decode(errors="replace").partition("  ") for line in lines)
        return {path: digest for digest, mark, path in parts if mark}

    def _newer_enclaves(self) -> frozenset[str]:
        """Return the enclaves whose certificate is newer than everything in accepted releases.

        An enclave with an unreadable certificate is left out, because no process can run in it.
        """
        newer, latest = set(), self._state.latest
        for name in self._enclaves():
            with suppress(SrosError, OSError):
                path = self._folder / _certificate_path(name)
                if latest is None or validity_of(read_certificate(path)).not_before > latest:
                    newer.add(name)
        return frozenset(newer)

    def _note_unreleased_enclaves(self) -> None:
        """Report the enclaves that are here, but not in the accepted release."""
        accepted = self._state.accepted
        if not accepted:
            return
        with suppress(SrosError):  # the next installation writes the seal again
            released, newer = self._released_files(), self._newer_enclaves()
            here = sorted(self._enclaves())
            unreleased = [name for name in here if _certificate_path(name) not in released]
            unpublished = [name for name in unreleased if name in newer]
            foreign = self._seemingly_foreign(unpublished, released)
            for name in (name for name in unpublished if name not in foreign):
                self._problems.append(
                    f"{name} is newer than release {accepted}, which lacks this enclave. If it is "
                    "an enclave of this robot, publish it (`sros fleet publish KEYSTORE PUB`). "
                    "Otherwise remove it here: the next release that lacks the enclave removes its "
                    "files and its key."
                )
            if foreign:
                folders = first_few([enclave_folder(name) for name in foreign], 3)
                self._problems.append(
                    f"{FOREIGN_ENCLAVES}{first_few(foreign, 3)}. Release {accepted} lacks them, "
                    f"and their paths do not name {self._settings.robot}. If they belong to "
                    f"another robot, somebody may have copied their keys: remove {folders} here, "
                    "and run `sros renew KEYSTORE ENCLAVE --new-key --revoke-old`."
                    f"{KEY_MADE_ON_ROBOT} If they are new enclaves of this robot, publish them "
                    "(`sros fleet publish KEYSTORE PUB`)."
                )
            if older := [name for name in unreleased if name not in newer]:
                self._problems.append(
                    f"Release {accepted} of {self._settings.robot} does not have "
                    f"{first_few(older, 3)}, which {'is' if len(older) == 1 else 'are'} here, "
                    "perhaps "
                    "from another robot: the next round that can fetch and install removes "
                    "everything that the release lacks."
                )

    def _seemingly_foreign(self, names: Sequence[str], released: Iterable[str]) -> list[str]:
        """Return the enclaves ``names`` whose paths seem to be those of another robot.

        The agent does not know the fleet, so this is a guess: these paths do not name the robot,
        although the paths of all enclaves of the release, with the files ``released``, do.
        """
        robot = self._settings.robot
        own = {enclave_of(path) for path in released if path.endswith(f"/{CERTIFICATE_FILE}")}
        if not all(robot in name.split("/") for name in own):
            return []
        return [name for name in names if robot not in name.split("/")]

    def _own_enclaves(self, names: Sequence[str]) -> tuple[str, ...]:
        """Return the enclaves ``names`` that the accepted release has.

        If none is here, somebody has perhaps replaced all of them by hand: then newer enclaves are
        returned that do not seem to be those of another robot.  Before the first release, and
        without a readable seal, all are returned.
        """
        if self._state.accepted:
            with suppress(SrosError):  # the next installation writes the seal again
                released = self._released_files()
                if own := [name for name in names if _certificate_path(name) in released]:
                    return tuple(own)
                newer = self._newer_enclaves().intersection(names)
                foreign = self._seemingly_foreign(sorted(newer), released)
                return tuple(sorted(newer.difference(foreign)))
        return tuple(names)

    def _note_repaired_files(self, now: datetime) -> None:
        """Report for a day the files that differed from the release and were replaced."""
        recent = {
            path: at
            for path, at in self._state.repairs.items()
            if abs(now - at) < _REPAIRS_REPORTED_FOR
        }
        self._state = replace(self._state, repairs=recent)
        if recent:
            first, last = iso(min(recent.values())), iso(max(recent.values()))
            when = f"At {last}" if first == last else f"From {first} to {last}"
            paths = sorted(recent, key=lambda path: (_repaired_rank(path), path))
            self._problems.append(
                f"{when}, {counted(len(paths), 'file')} of the release "
                f"{'was' if len(paths) == 1 else 'were'} {REPLACED_FILES}"
                f"{first_few(paths, 3)}. Find out who or what changes files on this robot."
            )

    def _note_removed_enclaves(self) -> None:
        """Report the removed enclaves whose keys somebody may have copied.

        This ends when their certificates are revoked or have expired, or a release has them.
        """
        released: Collection[str] = ()
        with suppress(SrosError):  # the next installation writes the seal again
            released = self._released_files()
        removed = [
            key
            for key in self._not_revoked(self._state.removed_keys)
            if _certificate_path(enclave_of(key.path)) not in released
        ]
        self._state = replace(self._state, removed_keys=tuple(removed))
        if removed:
            names = sorted({enclave_of(key.path) for key in removed})
            self._problems.append(
                f"{REMOVED_ENCLAVES}the last at {iso(max(key.at for key in removed))}, because "
                f"the installed release lacks them: {first_few(names, 3)}. If they belong to "
                "another robot, somebody may have copied their keys: run `sros renew KEYSTORE "
                f"ENCLAVE --new-key --revoke-old`.{KEY_MADE_ON_ROBOT}"
            )

    def _note_closed_keys(self, now: datetime) -> None:
        """Report the keys that other users could read, until they are revoked or have expired."""
        exposed = self._still_copied(self._state.readable_keys)
        self._state = replace(self._state, readable_keys=tuple(exposed))
        readable = exposed_keys(self._folder, now)
        if closed := {key.path: key.at for key in exposed if key.path not in readable}:
            self._problems.append(
                "Until "
                f"{iso(max(closed.values()))}{READABLE_KEYS}{counted(len(closed), 'private key')}: "
                f"{first_few(sorted(closed), 2)}. File modes are correct now, but somebody may "
                "have copied a key: run `sros renew KEYSTORE ENCLAVE --new-key --revoke-old`, "
                f"and bring the new key.{KEY_MADE_ON_ROBOT}"
            )

    def _copied_key(self, path: str) -> CopiedKey:
        """Return the key at ``path``, noted now, with the present certificate of its enclave."""
        serial, expires = "", None
        with suppress(SrosError, OSError):
            certificate = read_certificate(self._folder / _certificate_path(enclave_of(path)))
            serial, expires = f"{certificate.serial_number:x}", validity_of(certificate).not_after
        return CopiedKey(path, self._machine.now, self._key_digest(path), serial, expires)

    def _still_copied(self, keys: Sequence[CopiedKey]) -> list[CopiedKey]:
        """Return the keys that can still be used, with their present certificates.

        A key that was replaced here, or cannot be read, counts until its certificate is revoked or
        has expired.
        """
        still, replaced = [], []
        for key in keys:
            present = self._copied_key(key.path)
            if key.key and key.key == present.key:
                still.append(present._replace(at=key.at) if present.serial else key)
            else:
                replaced.append(key)
        return [*still, *self._not_revoked(replaced)]

    def _not_revoked(self, keys: Sequence[CopiedKey]) -> list[CopiedKey]:
        """Return the keys whose certificates are neither revoked nor certainly expired.

        A key whose certificate is not known is left out after a day.
        """
        if not keys:
            return []
        now, latest = self._machine.now, self._state.latest
        revoked = revoked_serials(self._revocation_lists(self._enclaves()) or "")
        return [
            key
            for key in keys
            if (
                int(key.serial, 16) not in revoked
                and not (latest and key.expires and key.expires <= latest)
                if key.serial
                else abs(now - key.at) < _REPAIRS_REPORTED_FOR
            )
        ]

    def _key_digest(self, path: str) -> str:
        """Return the SHA-256 of the public key of a private key; "" if it cannot be read."""
        with suppress(SrosError, OSError):
            key = load_key(read_bytes(self._folder / path, "private key"), f"'{path}'")
            return key_digest(key.public_key())
        return ""

    def _install(self, release: Release, certain_time: datetime) -> Installation:
        settings, state = self._settings, self._state
        if release.number == state.accepted and self._differs_from_accepted_release(release):
            installed_robot = robot_in_seal(self._folder)
            if installed_robot not in ("", release.robot):
                self._problems.append(
                    f"'{self._folder}' has the files of robot {installed_robot}, and its agent is "
                    f"set up for {release.robot}. Nothing was changed. Check whether this robot "
                    "has the right name (`sros agent init --robot`)."
                )
                return Installation()
            self._problems.append(
                f"The published release has the number {release.number} {OF_SAME_NUMBER}: the "
                "keystore comes from a backup, or somebody else publishes. Nothing was changed. On "
                "the keystore machine, run `sros fleet publish KEYSTORE PUB --restored`."
            )
            return Installation()
        names = tuple({*release.enclaves(), *search_enclaves(self._folder)[0]})
        keys = waiting_keys(self._folder, names)
        replaced = self._revocation_lists(names)

        def before(ran: Sequence[str]) -> None:
            self._keep_replaced_list(replaced)
            self._record_due_restarts(ran)

        try:
            installation = install_release(
                self._folder,
                release,
                settings.robot,
                now=self._time_to_be_valid_at(release, certain_time),
                installed=state.accepted,
                pinned=frozenset(settings.authorities),
                new_keys=keys,
                keep=self._newer_enclaves() if release.number == state.accepted else (),
                before=before,
            )
        except (SrosError, OSError) as error:
            self._note_error(error)
            return Installation(lists=error.lists if isinstance(error, DiskFullError) else ())
        for name, why in installation.kept.items():
            remedy = ""
            if concerns_key(why):
                remedy = _BRING_KEY.format(settings.robot) + self._foreign_key_sentence(
                    name, release.enclaves()
                )
            self._problems.append(f"{name} does not get the files of the release: {why}.{remedy}")
        for name in installation.removed:
            self._problems.append(
                f"{name} was removed: release {release.number} lacks this enclave. Stop its "
                "processes."
            )
        self._try_part(lambda: write_seal(self._folder, release.seal))
        latest = max(filter(None, (state.latest, installation.latest)), default=None)
        self._state = replace(
            self._state,
            release=state.release if installation.kept else release.number,
            accepted=release.number,
            latest=latest,
        )
        self._save_state()
        self._is_in_step = not installation.kept
        self._drop_replaced_list(names)
        drop_installed_keys(self._folder, keys)
        return installation

    def _time_to_be_valid_at(self, release: Release, certain_time: datetime) -> datetime:
        """Return the time at which a release has to be valid.

        This is ``certain_time``: the time of the clock, or a later time that verified documents
        prove to be past. If the clock is behind, it is at least the time at which the keystore made
        the release.
        """
        made = (
            release_time(release) if self._machine.now < certain_time - _CLOCK_TOLERANCE else None
        )
        return max(certain_time, made) if made else certain_time

    def _differs_from_accepted_release(self, release: Release) -> bool:
        """Return whether a release has other files than the accepted release with the same number.

        The result is also False if the stored seal is of an earlier release, because the disk had
        no room for the seal of the accepted release.
        """
        seal = read_seal(self._folder)
        with suppress(SrosError):
            if sealed_robot(seal).number == release.number:
                return not smime.parse(seal).text.endswith(b"\n" + listed_digests(release.files))
        return False

    def _forget_restarts(self) -> None:
        nothing: dict[str, float] = {}
        self._state = replace(
            self._state,
            due=(),
            list_due=(),
            restarted=(),
            replaced=nothing,
            list_replaced=nothing,
        )

    def _record_due_restarts(self, names: Sequence[str]) -> None:
        """Record before a change that ``names`` need a restart, in case the agent is killed."""
        state, moments = self._state, dict.fromkeys(names, _since_boot())
        self._state = replace(
            state,
            due=tuple(sorted({*state.due, *names})),
            replaced={**state.replaced, **moments},
            list_replaced={**state.list_replaced, **moments},
        )
        self._save_state()

    def _note_due_restarts(self, changed: Iterable[str], names: Iterable[str]) -> None:
        """Note that processes have to be restarted because files of their enclaves changed.

        ``changed`` are the enclaves whose files the agent changed.  Changes that other programs
        made are found by the digests of the files.
        """
        before, files = self._state.files, enclave_digests(self._folder, names)
        changed = {*changed}
        new_files, moment = {*changed}, _since_boot()
        due = {*self._state.due, *changed} & files.keys()
        list_replaced = dict(self._state.list_replaced)
        list_due = {*self._state.list_due} & files.keys()
        list_since = dict(self._state.list_since)
        for name, digests in files.items():
            before_all, _, before_trust = before.get(name, "").partition(" ")
            all_files, _, trust = digests.partition(" ")
            if before_trust != trust:
                list_since[name] = self._current_time()
            if before_all != all_files:
                new_files.add(name)
                due.add(name)
                if before_trust != trust:
                    list_due.add(name)
                    list_replaced |= {name: moment} if name in changed else {}
        self._state = replace(
            self._state,
            due=tuple(sorted(due)),
            restarted=tuple(name for name in self._state.restarted if name not in new_files),
            list_due=tuple(sorted(list_due)),
            replaced=_moments_of(due, {**self._state.replaced, **dict.fromkeys(changed, moment)}),
            list_replaced=_moments_of(list_due, list_replaced),
            list_since={name: list_since[name] for name in files if name in list_since},
            files=files,
        )

    def _enclaves(self) -> tuple[str, ...]:
        """Return the enclaves with a certificate, in which processes can run."""
        return tuple(
            name
            for name in search_enclaves(self._folder)[0]
            if (enclave_path(self._folder, name) / CERTIFICATE_FILE).exists()
        )

    def _restart(
        self, names: Iterable[str], opened_enclaves: Mapping[str, InstalledEnclave]
    ) -> Sequence[str]:
        """Restart the units of enclaves whose restart is due, once after each change of files.

        Return the enclaves whose units restarted and whose processes can be seen. A unit without
        visible processes runs no nodes, or runs as a user whose processes this user cannot look at.
        """
        settings, machine = self._settings, self._machine
        if not settings.restart or not self._state.due:
            return ()
        # Restart only units whose processes were seen with earlier files, or may have earlier
        # files.
        processes = self._examine_processes(names)
        routers = [
            name for name in names if (enclave_path(self._folder, name) / ROUTER_FILE).exists()
        ]
        # A process that may only claim to run in an enclave makes a restart due without new files.
        states, due = processes.restartable, self._state.replaced
        done = self._restarts = restart_units(
            settings,
            [
                name
                for name in enclaves_to_restart(due, states, complete=processes.complete)
                if name not in self._state.restarted
            ],
            routers=routers,
            unusable={
                name: enclave.problem
                for name, enclave in opened_enclaves.items()
                if enclave.problem
            },
            systemd=machine.systemd or Systemd(settings.systemctl),
        )
        self._problems += done.problems
        enclaves = _enclaves_of(done.units)
        restarted = tuple(sorted({*self._state.restarted, *enclaves}))
        self._state = replace(self._state, restarted=restarted)
        return [name for name in enclaves if states[name] is not RunningFiles.NOT_SEEN]

    def _examine_restarted(
        self, restarted: Sequence[str], names: Iterable[str]
    ) -> EnclaveProcesses:
        """Examine the processes until the processes of restarted units have loaded new files."""
        end = time.monotonic() + self._machine.patience
        while True:
            processes = self._examine_processes(names)
            starting = (processes.states.get(name) is RunningFiles.NOT_SEEN for name in restarted)
            if not any(starting) or time.monotonic() > end:
                return processes
            time.sleep(_LOOK_SECONDS)

    def _examine_processes(self, names: Iterable[str]) -> EnclaveProcesses:
        """Examine the processes at the current time."""
        machine, state, now, since_boot = (
            self._machine,
            self._state,
            self._current_time(),
            _since_boot(),
        )

        def on_the_clock(seconds_since_boot: Mapping[str, float]) -> dict[str, datetime]:
            return {
                name: now - timedelta(seconds=since_boot - seconds)
                for name, seconds in seconds_since_boot.items()
                if seconds <= since_boot  # a later time is of an earlier start of the machine
            }

        return look_at_processes(
            self._folder,
            names,
            now=now,
            zone=machine.zone,
            look=machine.look,
            list_since=state.list_since,
            replaced=on_the_clock(state.replaced),
            list_replaced=on_the_clock(state.list_replaced),
        )

    def _current_time(self) -> datetime:
        """Return the current time, which is later than the start of the round."""
        passed = timedelta(seconds=_since_boot() - self._began)
        return self._machine.now + passed

    # ── the message ────────────────────────────────────────────────────────────────────────

    def _confirm(
        self,
        names: Sequence[str],
        opened_enclaves: Mapping[str, InstalledEnclave],
        processes: EnclaveProcesses,
        clock: RobotClock,
        renewals: Renewals,
    ) -> bool:
        """Send the message with the confirmation and ``renewals``; return whether it arrived."""
        now = self._machine.now.replace(microsecond=0)
        sequence = self._state.next_sequence(now)
        self._state = replace(self._state, sequence=sequence)
        self._save_state()
        confirmation = make_confirmation(
            self._folder,
            self._settings.robot,
            now=now,
            unreadable=self._note_unreadable_enclave,
        )
        restart, crl_restart = (
            tuple(sorted({*names, *processes.elsewhere}))
            for names in (self._state.due, self._state.list_due)
        )
        confirmation = replace(
            confirmation,
            dds=shortened_dds(processes.dds),
            restart=restart,
            boot=_boot_digest(self._settings.robot, self._machine.boot()),
            crl_restart=None if crl_restart == restart else crl_restart,
            waiting=self._state.waiting or None,
            sequence=sequence,
            release=self._state.release,
            expiry={name: _enclave_expiry(opened_enclaves.get(name)) for name in names},
            running=processes.loaded_from_any_folder(),
            clock=clock,
            problems=shortened_problems(self._problems),
            requests=renewals.requests,
            crl=self._list_to_send(names),
            seal=self._seal_to_send(),
        )
        signers = (renewals.signer,) if renewals.signer else self._own_enclaves(names)
        message = self._signed_message(confirmation, signers)
        if not message:
            return False
        settings = self._settings

        def deliver(certificate: ClientCertificate | None) -> None:
            send(
                settings.inbox,
                settings.robot,
                message,
                client_certificate=certificate,
                tls_ca=Path(settings.tls_ca) if settings.tls_ca else None,
            )

        arrived = self._try_part(lambda: self._ask_as_enclave(settings.inbox, deliver))
        if arrived:
            self._state = replace(self._state, sent=now)
        return arrived

    def _list_to_send(self, names: Iterable[str]) -> str | None:
        """Return a revocation list that the keystore may have lost; None if nothing seems lost."""
        return self._replaced_list() if self._is_in_step else self._revocation_lists(names)

    def _seal_to_send(self) -> str | None:
        """Return the seal of the installed release; None if there is no seal, or it is too long."""
        with suppress(SrosError, ValueError):
            seal = read_seal(self._folder).decode("ascii")
            return seal if 0 < len(seal) <= LONGEST_SEAL else None
        return None

    def _replaced_list(self) -> str | None:
        """Return the kept revocation list (PEM) that a release may have replaced by a shorter one.

        The result is None if no list is kept, or if the list was kept for long enough.
        """
        with suppress(SrosError, OSError):
            path = agent_folder(self._folder) / _REPLACED_LIST
            since = time_of_file(path.stat().st_mtime)
            if abs(self._machine.now - since) < _KEEP_REPLACED_LIST:
                return read_bytes(path, "revocation list", max_bytes=LONGEST_LIST).decode()
        return None

    def _keep_replaced_list(self, text: str | None) -> None:
        """Store a copy of the revocation list ``text``, because a release may replace the list.

        A shorter list is normal: expired entries are left out.  But it can also come from a
        restored keystore that lost entries.
        """
        if text and not self._replaced_list():
            path = agent_folder(self._folder) / _REPLACED_LIST
            self._try_part(lambda: replace_file(path, text.encode()))

    def _drop_replaced_list(self, names: Iterable[str]) -> None:
        """Remove the kept revocation list if the current list revokes all of its certificates."""
        kept, present = self._replaced_list(), self._revocation_lists(names)
        if kept and present and revoked_serials(kept) <= revoked_serials(present):
            with suppress(OSError):
                remove_file(agent_folder(self._folder) / _REPLACED_LIST)

    def _revocation_lists(self, names: Iterable[str]) -> str | None:
        """Return the newest list of each CA of these enclaves as PEM; None without a list.

        In a rotation, the list of the second CA is in the file of the CAs.
        """
        with Folder(self._folder) as opened:
            files = {tuple(present_lists(opened, name).items()) for name in names}
        by_authority: defaultdict[str, list[x509.CertificateRevocationList]] = defaultdict(list)
        for documents in map(dict, files):
            with suppress(SrosError):
                authorities = documents.get(IDENTITY_CA_FILE, b"")
                for authority in load_certificates(authorities, IDENTITY_CA_FILE):
                    lists = (newest_list(data, pem(authority)) for data in documents.values())
                    by_authority[key_digest_of_ca(authority)] += (e for e in lists if e is not None)
        newest = (max(lists, key=list_number) for _, lists in sorted(by_authority.items()) if lists)
        text = "".join(crl.public_bytes(Encoding.PEM).decode() for crl in newest)
        if not text:
            return None
        if len(text) > LONGEST_LIST:
            self._problems.append(
                "The message of this robot lacks the revocation list, which is too long for it."
            )
            return None
        return text

    def _note_unreadable_enclave(self, name: str, error: Exception) -> None:
        text = self._write_error_text(error) if isinstance(error, OSError) else str(error)
        self._problems.append(f"The message of this robot leaves out {name}: {text}")

    def _signed_message(self, confirmation: Confirmation, names: Sequence[str]) -> bytes:
        """Return the message, signed by the enclave whose certificate is valid longest.

        Return b"" if no enclave can sign.
        """
        certificates = {}
        for name in names:
            with suppress(SrosError, OSError):
                path = enclave_path(self._folder, name) / CERTIFICATE_FILE
                certificates[name] = read_certificate(path)
        order = sorted(
            certificates.items(), key=lambda pair: validity_of(pair[1]).not_after, reverse=True
        )
        refused: list[str] = []
        for name, certificate in order:
            try:
                key = enclave_key(self._folder, name, self._machine.secrets)
                if key.public_key() == certificate.public_key():
                    return smime.sign(render_confirmation(confirmation), certificate, key)
            except (SrosError, OSError) as error:
                refused.append(f"{name}: {error}")
        why = f" ({refused[0]})" if refused else ""
        self._problems.append(
            "No enclave of this robot's release has a key and a certificate that can sign its "
            f"message{why}."
        )
        return b""

    def _ask_as_enclave(
        self, address: str, ask: Callable[[ClientCertificate | None], _ServerAnswer]
    ) -> _ServerAnswer:
        """Return the answer of a server to the first enclave whose certificate it accepts.

        ``address`` is the URL of the server, or the path of a folder, which needs no certificate.
        Some certificates may already be revoked while their successors wait to be fetched.

        Raises:
            SrosError, OSError: the error of ``ask``, for the last enclave if all were refused.
        """
        secure = address.startswith("https://")
        certificates = self._client_certificates() if secure else []
        for certificate in certificates[:-1]:
            try:
                return ask(certificate)
            except (FetchError, RefusedError) as error:
                if not _is_refusal(error):
                    raise
        try:
            return ask(certificates[-1] if certificates else None)
        except (FetchError, RefusedError) as error:
            if certificates or not secure or not _is_refusal(error):
                raise
            raise UnavailableError(
                f"{address} refuses this robot, which has no certificate to identify itself with",
                "No enclave here has a certificate and its key in files (a key on a token cannot "
                "be used for this).",
                "On the keystore machine, run `sros distribute_key KEYSTORE --robot "
                f"{self._settings.robot} FOLDER --force`, and bring the files here.",
            ) from error

    def _client_certificates(self) -> list[ClientCertificate]:
        """Return the enclaves' certificates and keys for TLS: those of the release come first.

        They are then sorted by expiry, the latest first. At most `_MOST_CERTIFICATES` are
        returned, half of them for other enclaves if there are so many: the server may refuse all
        of the release, or all others may be copied from another robot. An enclave whose key does
        not belong to its certificate, or cannot be read, is left out: `unusable_sentences` reports
        it.
        """
        of_release: list[tuple[datetime, ClientCertificate]] = []
        others: list[tuple[datetime, ClientCertificate]] = []
        names = self._enclaves()
        own = self._own_enclaves(names)
        for name in names:
            place = enclave_path(self._folder, name)
            with suppress(SrosError, OSError):
                files = ClientCertificate(place / CERTIFICATE_FILE, place / KEY_FILE)
                certificate = read_certificate(files.certificate)
                key = load_key(read_bytes(files.key, "private key"), f"'{files.key}'")
                if key.public_key() == certificate.public_key():
                    ranked = of_release if name in own else others
                    ranked.append((validity_of(certificate).not_after, files))
        for ranked in (of_release, others):
            ranked.sort(key=lambda pair: pair[0], reverse=True)
        kept = _MOST_CERTIFICATES - min(len(others), _MOST_CERTIFICATES // 2)
        return [files for _, files in (*of_release[:kept], *others)][:_MOST_CERTIFICATES]


def _enclaves_of(units: Iterable[Unit]) -> tuple[str, ...]:
    return tuple(name for unit in units for name in unit.enclaves)


def _is_refusal(error: FetchError | RefusedError) -> bool:
    """Return whether a server perhaps refuses the client's certificate."""
    return isinstance(error, RefusedError) or error.problem is FetchProblem.REFUSED


def _since_boot() -> float:
    """Return the seconds since the start of the machine."""
    return time.clock_gettime(time.CLOCK_BOOTTIME)


def _moments_of(names: Collection[str], moments: Mapping[str, float]) -> dict[str, float]:
    return {name: moment for name, moment in moments.items() if name in names}


def _boot_digest(robot: str, boot: str) -> str | None:
    """Return a digest of ``boot``, the random id of the machine's start; None without an id.

    The digest, a SHA-256 with the robot's name, hides the id.
    """
    return hashlib.sha256(f"{robot} {boot}".encode()).hexdigest() if boot else None


def _repaired_rank(path: str) -> int:
    """Return the rank of a file that was changed, 0 for the gravest: a revocation list."""
    file = path.rpartition("/")[2]
    return _GRAVEST_FILES.index(file) if file in _GRAVEST_FILES else len(_GRAVEST_FILES)


def _certificate_path(name: str) -> str:
    return f"{enclave_folder(name)}/{CERTIFICATE_FILE}"


def _enclave_expiry(enclave: InstalledEnclave | None) -> EnclaveExpiry:
    if enclave is None:
        return EnclaveExpiry(None, None)
    certificate = enclave.state.certificate
    with suppress(SrosError):
        until = validity_of(certificate).not_after if certificate else None
        return EnclaveExpiry(until, enclave.permissions_until())
    return EnclaveExpiry(None, enclave.permissions_until())


def _error_sentence(error: SrosError) -> str:
    text = str(error)
    begun = text if text.startswith("http") else capitalized(text)
    return begun + ("" if text.endswith(".") else ".")
