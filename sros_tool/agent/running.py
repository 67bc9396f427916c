"""The processes in the enclaves of a security folder, and the units that restart processes."""

from __future__ import annotations

import ctypes
import os
import subprocess
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from datetime import datetime, tzinfo
from pathlib import Path
from types import MappingProxyType
from typing import NamedTuple

from sros_tool.agent.settings import AgentSettings, Unit
from sros_tool.checks.kind import WARNING
from sros_tool.checks.processes import (
    PROCESS_OUTDATED,
    PROCESS_WITHOUT_FILES,
    may_lack_list,
    newer_files,
    other_folder_findings,
    process_findings,
)
from sros_tool.errors import UnavailableError
from sros_tool.keystore.confirmation import (
    LibraryUse,
    RobotClock,
    RobotDds,
    RobotLibrary,
    RunningFiles,
    is_enclave_below_root,
)
from sros_tool.keystore.layout import KEY_FILE, enclave_path
from sros_tool.runtime.processes import (
    Process,
    ProcessEnclave,
    ProcessTable,
    RunningProcesses,
    installed_dds,
    plain,
)
from sros_tool.runtime.units import unit_instance
from sros_tool.runtime.variables import ENABLE, KEYSTORE

_LONGEST_PATH = 200
_LONGEST_CLAUSE = 200
_RESTART_SECONDS = 120.0
_NOT_ALLOWED = "nteractive authentication required"
"""What systemctl says to a user who may not restart a unit."""
_ALLOW_RESTARTS = (
    "Let the user of the agent restart the unit, with a polkit rule (docs/fetching.md: Restarts)."
)
_COMMAND_SECONDS = 30.0
"""How long a command, such as systemctl, may take."""


# ── processes ──────────────────────────────────────────────────────────────────────────────


class EnclaveProcesses(NamedTuple):
    """The processes in the enclaves of a security folder."""

    states: Mapping[str, RunningFiles]
    """Maps each enclave to whether its processes that run from the folder have the current files.

    A process of a user who cannot read the key may only claim to run in the enclave: it is never
    ``current``.
    """
    restartable: Mapping[str, RunningFiles]
    """Like `states`, but without processes that may only claim to run in the enclave: they must not
    cause a restart of a unit.
    """
    list_states: Mapping[str, RunningFiles]
    """Like `states`, but only for the revocation list and the CAs: ``current`` also if only the
    enclave's own certificate, permissions or governance are newer than a process."""
    elsewhere: tuple[str, ...]
    """The enclaves of the folder in which a process runs from another folder, or runs although the
    enclave was removed: a restart of a unit does not help there.
    """
    complete: bool
    """Whether every process of the machine could be looked at."""
    problems: tuple[str, ...]
    """The findings of `sros check runtime` on these processes, except notes and due restarts."""
    dds: RobotDds
    """The DDS of the robot."""

    def loaded_from_any_folder(self) -> Mapping[str, RunningFiles]:
        """Return which files the processes of each enclave have loaded, from any folder."""
        return {**self.states, **dict.fromkeys(self.elsewhere, RunningFiles.EARLIER)}


def look_at_processes(
    folder: Path,
    names: Iterable[str],
    *,
    now: datetime,
    zone: tzinfo,
    look: Callable[[datetime], RunningProcesses] | None = None,
    list_since: Mapping[str, datetime] = MappingProxyType({}),
    replaced: Mapping[str, datetime] = MappingProxyType({}),
    list_replaced: Mapping[str, datetime] = MappingProxyType({}),
) -> EnclaveProcesses:
    """Return the processes that run in the enclaves ``names`` of ``folder``.

    ``look`` reads the processes of the machine. ``replaced`` maps enclaves to the time when their
    files were replaced, and ``list_replaced`` to the time when their trust files (CAs and
    revocation list) were replaced. ``list_since`` maps enclaves to the time since when their trust
    files have been the same. All times are by the clock of ``now``. The first two are used in
    addition to the modification times of the files, because the clock may have been set since the
    files were written.
    """
    running = (look or ProcessTable().look)(now)
    own_processes = [process for process in running.processes if _runs_in_folder(process, folder)]
    readers = [process for process in own_processes if _can_read_key(process, folder)]

    def is_outdated(process: Process, enclave: ProcessEnclave) -> bool:
        return _started_before(process, replaced) or any(newer_files(process, enclave))

    def lacks_list(process: Process, enclave: ProcessEnclave) -> bool:
        since = list_since.get(_enclave_of(process))
        same_revocations = bool(since and since < process.started)
        return _started_before(process, list_replaced) or may_lack_list(
            process, enclave, same_revocations=same_revocations
        )

    names = [*names]
    states = _loaded_files_by_enclave(names, own_processes, is_outdated, readers)
    list_states = _loaded_files_by_enclave(names, own_processes, lacks_list, readers)
    other_processes = [
        process
        for process in running.processes
        if _enclave_of(process) in states and not _runs_in_folder(process, folder)
    ]
    elsewhere = [process for process in other_processes if _folder_is_known(process)]
    environment = {ENABLE: "true", KEYSTORE: str(folder)}
    findings = (
        *other_folder_findings(elsewhere, folder),
        *process_findings(
            environment,
            replace(running, processes=tuple(own_processes), unseen=()),
            now=now,
            zone=zone,
        ),
    )
    problems = tuple(
        f"{finding.subject}: {finding.kind.title}: {finding.text}"
        for finding in findings
        if finding.severity >= WARNING
        and finding.kind is not PROCESS_OUTDATED
        and finding.subject != "processes"
    )
    without_files = {
        finding.subject for finding in findings if finding.kind is PROCESS_WITHOUT_FILES
    }
    removed = [
        process
        for process in readers
        if process.label in without_files and is_enclave_below_root(_enclave_of(process))
    ]
    complete = not (running.unseen or running.hidden or running.is_in_container) and all(
        process.enclave and not process.enclave.problem
        for process in (*own_processes, *other_processes)
        if process not in elsewhere
    )
    return EnclaveProcesses(
        states,
        _loaded_files_by_enclave(names, readers, is_outdated, readers),
        list_states,
        tuple(sorted({*map(_enclave_of, (*elsewhere, *removed))})),
        complete,
        problems,
        _robot_dds(running),
    )


def _enclave_of(process: Process) -> str:
    """Return the name of the enclave that a process names; "" if it asks for no security."""
    return f"/{process.enclave.name.strip('/')}" if process.enclave else ""


def _folder_is_known(process: Process) -> bool:
    """Return whether the enclave folder of a process was found, or does not exist."""
    return bool(process.enclave and (process.enclave.folders or not process.enclave.problem))


def _runs_in_folder(process: Process, folder: Path) -> bool:
    enclave = process.enclave
    if enclave is None:
        return False
    if enclave.is_in_keystore(folder):
        return True
    named = os.path.abspath(enclave.keystore) == os.path.abspath(folder)  # noqa: PTH100
    return named and not _folder_is_known(process)


def _started_before(process: Process, moments: Mapping[str, datetime]) -> bool:
    moment = moments.get(_enclave_of(process))
    return moment is not None and process.started < moment


def _can_read_key(process: Process, folder: Path) -> bool:
    """Return whether a process is of a user who can read the key of its enclave in ``folder``.

    The files that the process sees prove nothing: any user can mount other files over them for its
    own processes.
    """
    if process.user in (0, folder.stat().st_uid):
        return True
    name, enclave = _enclave_of(process), process.enclave
    if enclave and is_enclave_below_root(name):
        with suppress(OSError):
            place = enclave_path(folder, name)
            state, key = place.stat(), (place / KEY_FILE).stat()
            is_same_folder = (state.st_dev, state.st_ino) in enclave.folders[1:]
            return is_same_folder and bool(key.st_mode & 0o077)
    return False


def _loaded_files_by_enclave(
    names: Iterable[str],
    processes: Iterable[Process],
    is_outdated: Callable[[Process, ProcessEnclave], bool],
    readers: Collection[Process],
) -> dict[str, RunningFiles]:
    """Map each enclave to which files its processes loaded: earlier, current, or not seen.

    Only ``readers``, processes that can read the key of their enclave, count as having loaded the
    current files.
    """
    states = dict.fromkeys(names, RunningFiles.NOT_SEEN)
    for process in processes:
        name, enclave = _enclave_of(process), process.enclave
        if name not in states or enclave is None or enclave.problem:
            continue
        if is_outdated(process, enclave):
            states[name] = RunningFiles.EARLIER
        elif process in readers and states[name] is RunningFiles.NOT_SEEN:
            states[name] = RunningFiles.CURRENT
    return states


def enclaves_to_restart(
    due_enclaves: Iterable[str], states: Mapping[str, RunningFiles], *, complete: bool
) -> tuple[str, ...]:
    """Return the enclaves whose processes have to be restarted, by the states of all enclaves.

    A restart is done when the processes of the enclave were seen with the installed files, or when
    all processes of the machine were seen (``complete``) and none is in the enclave.
    """
    return tuple(
        sorted(
            name
            for name, state in states.items()
            if state is RunningFiles.EARLIER
            or (name in set(due_enclaves) and state is RunningFiles.NOT_SEEN and not complete)
        )
    )


def _robot_dds(running: RunningProcesses) -> RobotDds:
    """Return the DDS libraries that processes have loaded, or that are installed."""
    loaded = [library for process in running.processes for library in process.dds]
    place_by_library = dict.fromkeys(installed_dds(), LibraryUse.INSTALLED)
    place_by_library |= dict.fromkeys(
        (library._replace(replaced=False) for library in loaded), LibraryUse.PROCESS
    )
    libraries = dict.fromkeys(
        RobotLibrary(library.product, library.version, plain(library.path, _LONGEST_PATH), how)
        for library, how in sorted(
            place_by_library.items(), key=lambda pair: (pair[1] != "process", pair[0])
        )
    )
    return RobotDds(tuple(libraries), len(running.unseen) + bool(running.hidden))


# ── the clock ──────────────────────────────────────────────────────────────────────────────

_UNSYNCHRONIZED = 5  # TIME_ERROR
_TIMEX_BYTES = 512  # larger than the struct timex of any system


def kernel_clock() -> RobotClock:
    """Return whether a time service has set the clock, as adjtimex(2) says."""
    try:
        library = ctypes.CDLL(None, use_errno=True)
        # With a zeroed struct, adjtimex changes nothing.
        state = library.adjtimex(ctypes.create_string_buffer(_TIMEX_BYTES))
    except (OSError, AttributeError):
        return RobotClock.UNKNOWN
    if state < 0:
        return RobotClock.UNKNOWN
    return RobotClock.UNSYNCHRONIZED if state == _UNSYNCHRONIZED else RobotClock.SYNCHRONIZED


# ── units ──────────────────────────────────────────────────────────────────────────────────


class Systemd:
    """The command that restarts units, and lists active units."""

    def __init__(self, command: Sequence[str]) -> None:
        self._command = command

    def active_units(self) -> frozenset[str]:
        """Return the names of the active units that `sros units` writes for nodes.

        Raises:
            UnavailableError: the command cannot be run, or fails.
        """
        listing = self._run_systemctl(
            "list-units", "--plain", "--no-legend", "--state=active", "sros@*.service",
            seconds=_COMMAND_SECONDS,
        )  # fmt: skip
        return frozenset(line.split()[0] for line in listing.splitlines() if line.split())

    def restart(self, unit: str) -> None:
        """Restart a unit.

        Raises:
            UnavailableError: the unit does not restart; the error says why.
        """
        self._run_systemctl("restart", unit, seconds=_RESTART_SECONDS)

    def _run_systemctl(self, *words: str, seconds: float) -> str:
        failure = f"`{' '.join((*self._command, *words[:1], *words[-1:]))}` failed"
        try:
            done = subprocess.run(
                (*self._command, *words),
                capture_output=True,
                text=True,
                errors="replace",
                timeout=seconds,
                stdin=subprocess.DEVNULL,
            )
        except subprocess.TimeoutExpired as error:
            raise UnavailableError(
                failure, f"The command did not end within {seconds:.0f} s."
            ) from error
        except OSError as error:
            raise UnavailableError(failure, f"{error.strerror or error}.") from error
        if done.returncode:
            error_text = _clause(" ".join((done.stderr or done.stdout).split()))
            is_forbidden = _NOT_ALLOWED in error_text
            raise UnavailableError(
                failure,
                f"{error_text or f'Its exit status is {done.returncode}'}.",
                _ALLOW_RESTARTS if is_forbidden else "",
            )
        return done.stdout


def _clause(text: str) -> str:
    """Return what the system says as a clause, without characters that nobody sees.

    Punctuation stays: on the keystore machine, problems of robots may be any printable text.
    """
    seen = (letter if letter.isprintable() else "?" for letter in text[:_LONGEST_CLAUSE])
    return "".join(seen).removesuffix(".")


def _due_units(
    settings: AgentSettings,
    due_enclaves: Sequence[str],
    routers: Iterable[str],
    active: Iterable[str],
) -> list[Unit]:
    """Return the units to restart, units of Zenoh routers first.

    Then come the units of the settings, in their order, and the units of `sros units` in ``active``
    for enclaves without a unit in the settings.
    """
    units = [unit for unit in settings.units if set(unit.enclaves) & set(due_enclaves)]
    named = {name for unit in units for name in unit.enclaves}
    known = set(active)
    for name in due_enclaves:
        if name not in named and (unit := f"sros@{unit_instance(name)}.service") in known:
            units.append(Unit(unit, (name,)))
    first = set(routers)
    return sorted(units, key=lambda unit: not first & set(unit.enclaves))


class Restarts(NamedTuple):
    """Units that were restarted, units that wait for ``restart_if``, and sentences on problems."""

    units: Sequence[Unit] = ()
    waiting: Sequence[Unit] = ()
    problems: Sequence[str] = ()


def restart_units(
    settings: AgentSettings,
    due_enclaves: Sequence[str],
    *,
    routers: Iterable[str],
    unusable: Mapping[str, str],
    systemd: Systemd,
) -> Restarts:
    """Restart the units of enclaves, one after the other.

    A unit of an enclave in ``unusable``, which maps names to reasons, is left running, because its
    processes would not start again.
    """
    restarted: list[Unit] = []
    problems: list[str] = []
    if not due_enclaves or not settings.restart:
        return Restarts()
    try:
        active = systemd.active_units()
    except UnavailableError as error:
        active = frozenset()
        problems.append(str(error))
    units: list[Unit] = []
    for unit in _due_units(settings, due_enclaves, routers, active):
        if broken := [name for name in unit.enclaves if name in unusable]:
            why = f"no process could start in {broken[0]}: {unusable[broken[0]]}"
            problems.append(f"{unit.name} is not restarted: {why}.")
        else:
            units.append(unit)
    if units and settings.restart_if:
        try:
            allowed = subprocess.run(
                settings.restart_if,
                timeout=_COMMAND_SECONDS,
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL,
            )
        except (OSError, subprocess.SubprocessError) as error:
            why = _clause(str(error))
            text = "No unit is restarted, because the command in `restart_if` did not start or end"
            return Restarts(problems=(*problems, f"{text}: {why}."))
        if allowed.returncode:
            return Restarts(waiting=units, problems=problems)
    for unit in units:
        try:
            systemd.restart(unit.name)
        except UnavailableError as error:
            problems.append(str(error))
        else:
            restarted.append(unit)
    return Restarts(restarted, problems=problems)
