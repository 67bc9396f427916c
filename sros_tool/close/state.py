"""How far a robot is closed: its processes that run in enclaves now, the steps, the proofs."""

from __future__ import annotations

import os
import time
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence, Set
from contextlib import suppress
from datetime import datetime
from functools import cached_property
from pathlib import Path
from typing import Annotated, NamedTuple

from sros_tool.checks.keystores.trust import revoked_enclaves
from sros_tool.checks.processes import (
    PLACE_OR_MODE,
    newer_files,
    why_order_is_unknown,
    zenoh_findings,
)
from sros_tool.close.acceptance import Acceptance, Acceptances
from sros_tool.close.assignment import with_command_of_unit
from sros_tool.close.processes import (
    DROP_IN,
    ROUTER,
    SYSTEMD_FOLDER,
    ClosedProcess,
    ObservedProcesses,
    command_without_enclave,
    is_in_domain,
    may_use_files,
    process_text,
)
from sros_tool.close.robot import MOST_NAMES, OBSERVER, LocalRobot, check_enclaves
from sros_tool.errors import SrosError
from sros_tool.keystore.expiry import Threshold, survey
from sros_tool.keystore.known_keys import IssuedCredentials
from sros_tool.keystore.layout import CRL_FILE, KEY_FILE, enclave_path, list_enclaves
from sros_tool.keystore.reader import FilesReadOnce, OpenedKeystore, open_enclave
from sros_tool.names import expand
from sros_tool.policy.model import Policy
from sros_tool.runtime.environment import node_argument, started_nodes
from sros_tool.runtime.processes import (
    Process,
    ProcessEnclave,
    ProcessTable,
    RunningProcesses,
    plain,
    process_origin,
    program_of,
    user_text,
)
from sros_tool.runtime.unit_properties import unit_properties
from sros_tool.runtime.variables import STRATEGY
from sros_tool.values import DryRun, FileChanges, Words, shows
from sros_tool.wording import first_few

_LONGEST_PATH = 300
"""Most characters that a text shows of a path that another process chose."""

_LOOK_SECONDS = 0.2
"""Seconds between two looks at the processes, until they are as they should be."""

_TOOLS = ("ros2", "sros", "sros_tool")
"""Programs, and packages of Python modules, with which a person tries an enclave."""

STARTED = "every process was started in its enclave"
KNOWN = "every process in an enclave belongs there"
ALONE = "no process is in a domain that was not examined"
ACCEPTED = "the files are accepted"
REQUIRED = "the requirements hold"
TALK = "everything that talked can still talk"
CONNECTED = "the processes on this machine have connected to each other"
SILENCE = "an open listener finds nothing"
_NEGATIONS = {
    STARTED: "not every process was started in its enclave",
    KNOWN: "not every process in an enclave belongs there",
    ALONE: "a process is in a domain that was not examined",
    ACCEPTED: "the files are not accepted",
    REQUIRED: "the requirements do not all hold",
    TALK: "not everything that talked can still talk",
    CONNECTED: "the processes on this machine have not all connected to each other",
    SILENCE: "an open listener finds something",
}
_ACCEPTANCES = {
    KNOWN: Acceptance.UNOBSERVED,
    ALONE: Acceptance.DOMAINS,
    REQUIRED: Acceptance.REQUIREMENTS,
    CONNECTED: Acceptance.CONNECTIONS,
}
_ACCEPTS_REVOKED = f"{CRL_FILE} changed, so certificates that were revoked since are accepted by"


class SecuredProcess(NamedTuple):
    """A process that runs in an enclave of the robot's export."""

    process: Process
    enclave: ProcessEnclave


class RunningRobot:
    """The processes of this machine at one moment, compared with the robot's folder."""

    def __init__(self, robot: LocalRobot, processes: RunningProcesses | None = None) -> None:
        self.robot = robot
        self.processes = processes or ProcessTable().look(robot.shell.now())

    @property
    def in_domain(self) -> Sequence[Process]:
        """The processes in the robot's domain, secured and open."""
        processes, domain = self.processes.processes, self.robot.domain
        return [process for process in processes if is_in_domain(process, domain)]

    @property
    def secured(self) -> Sequence[SecuredProcess]:
        """The processes of the robot's domain that run in enclaves of the export."""
        return [
            secured
            for secured in self.secured_everywhere
            if is_in_domain(secured.process, self.robot.domain)
        ]

    @cached_property
    def secured_everywhere(self) -> Sequence[SecuredProcess]:
        """The processes of all domains and networks that run in enclaves of the export."""
        export = self.robot.export
        return [
            SecuredProcess(process, process.enclave)
            for process in self.processes.processes
            if process.enclave and process.enclave.is_in_keystore(export)
        ]

    @cached_property
    def open_processes(self) -> Sequence[Process]:
        """The processes in the robot's domain that run without security."""
        return [process for process in self.in_domain if not process.asks_for_security]

    def runs_open(self, process: ClosedProcess, since: datetime | None = None) -> bool:
        """Return whether a process like the observed one runs without security.

        With ``since``, the process must have run since that moment.  If the observed process
        belongs to a unit, the open process has to belong to the same unit, because any user can
        start a process with the same command.
        """
        return any(
            process.fits(other)
            and not (since and other.started > since)
            and process.unit in ("", process_origin(other.program[0]).unit)
            for other in self.open_processes
        )

    def is_open(self, process: ClosedProcess) -> bool:
        """Return whether an observed process runs open, and no process runs in its enclave."""
        is_secured = any(enclave.name == process.enclave for _, enclave in self.secured_everywhere)
        return not is_secured and self.runs_open(process)

    @cached_property
    def current_enclaves(self) -> Set[str]:
        """The enclaves whose processes all run with the current files of the export.

        Without the strategy Enforce, a process runs open if its files were not there at its start.
        """
        return {enclave.name for _, enclave in self.secured} - self.not_current.keys()

    @cached_property
    def not_current(self) -> Mapping[str, Sequence[tuple[Process, str]]]:
        """Return, for each enclave, its processes that are not closed, each with the reason.

        Enclaves without such processes are left out.  A reason is text before "the processes of X",
        such as "ROS_SECURITY_STRATEGY is not 'Enforce' in".  A process of a user who cannot read
        the files only claims to run in an enclave: such a process counts only if the enclave has no
        other process.
        """
        by_enclave: dict[str, list[SecuredProcess]] = {}
        for secured in self.secured:
            by_enclave.setdefault(secured.enclave.name, []).append(secured)
        not_current: dict[str, list[tuple[Process, str]]] = {}
        for name, processes in by_enclave.items():
            may_use = [secured for secured in processes if self.may_use_files(secured.process)]
            for process, enclave in may_use or processes:
                if why := self._why_not_current(process, enclave):
                    not_current.setdefault(name, []).append((process, why))
        return not_current

    def may_use_files(self, process: Process) -> bool:
        """Return whether a process is of a user who can read the enclaves."""
        return may_use_files(process, self.robot.export)

    def _why_not_current(self, process: Process, enclave: ProcessEnclave) -> str:
        """Return why a process is not closed, as text before "the processes of X"; "" for a closed
        one.
        """
        if not self.may_use_files(process):
            return f"{user_text(process.user)}, not the owner of the files, can control"
        if process.environment.get(STRATEGY) != "Enforce":
            return f"{STRATEGY} is not 'Enforce' in"
        if not enclave.is_there:
            return f"there are no files{f' ({enclave.problem})' * bool(enclave.problem)} for"
        names = [*newer_files(process, enclave)]
        newer = first_few(names, MOST_NAMES)
        if not newer:
            finding = next(zenoh_findings(process), None)
            return f"the files are not in force ({finding.text}) in" if finding else ""
        mode = enclave.file(KEY_FILE).mode
        readable = (
            f"others can read {KEY_FILE} (its mode is {mode:04o}): if anybody read it, run `sros "
            f"renew KEYSTORE {enclave.name} --new-key --revoke-old`, otherwise `chmod 600`; "
        )
        warning = readable if mode & 0o077 else ""
        if clock := why_order_is_unknown(process):
            return f"{warning}{clock}, and {newer} may have changed after the start of"
        if names == [CRL_FILE]:
            return f"{warning}{_ACCEPTS_REVOKED}"
        or_mode = "" if newer.endswith(PLACE_OR_MODE) else ", or got another mode,"
        changed = f"{newer} changed{or_mode} after the start of"
        if CRL_FILE in names:
            changed = f"revoked certificates are still accepted, because {changed}"
        return f"{warning}{changed}"

    def not_observed(self) -> Sequence[str]:
        """Return the processes in enclaves that sros did not observe, as text.

        A further process with an observed command counts, too. An enclave without an observed
        process may have one process.
        """
        secured = [secured for secured in self.secured if secured.enclave.name != OBSERVER]
        observed = self.robot.processes
        known = observed.enclaves
        count = Counter(
            name for name, _ in {(enclave.name, process.program[0]) for process, enclave in secured}
        )
        further = self.further_processes(secured, observed)
        alone = " (by another command than the observed process)"
        return [
            f"{process.label} in {enclave.name}"
            f"{alone * (count[enclave.name] == 1 and enclave.name in known)}"
            for process, enclave in further
        ]

    def also_open(
        self, observed: ObservedProcesses, secured: Collection[str]
    ) -> Mapping[str, Sequence[int]]:
        """Map enclaves in ``secured`` to the open processes that have the command of an enclave."""
        processes = observed.processes
        known = {pid for process in processes for pid in (process.pid, *process.alike)}
        others = [process for process in self.open_processes if process.program[0] not in known]
        pids = {
            process.enclave: [other.program[0] for other in others if process.fits(other)]
            for process in processes
            if process.enclave in secured
        }
        return {name: [*dict.fromkeys(fitting)] for name, fitting in pids.items() if fitting}

    def with_other_files(self, *, revoked: bool) -> Iterator[str]:
        """Yield the processes of the domain in enclaves of other folders, as text.

        Only those whose certificate is ``revoked``, or only the others.
        """
        pids = {process.pid for process, _ in self.secured}
        for process in self.in_domain:
            enclave = process.enclave
            if enclave and process.pid not in pids and revoked == self.revokes(enclave):
                files = keystore_text(enclave)
                yield f"{process.label} in {enclave.name} (with the files of '{files}')"

    def revokes(self, enclave: ProcessEnclave) -> bool:
        """Return whether the export's revocation list has the certificate of a process's enclave.

        The certificate is the one that is now in the enclave's folder; a folder that sros cannot
        read counts as not revoked.
        """
        list_file = enclave_path(self.robot.export, OBSERVER) / CRL_FILE
        with suppress(SrosError):
            data = OpenedKeystore(self.robot.export).read(list_file, "revocation list")
            if folder := enclave.local_keystore:
                return any(revoked_enclaves(data, OpenedKeystore(folder), [enclave.name]))
        return False

    def further_processes(
        self, secured: Sequence[SecuredProcess], observed: ObservedProcesses
    ) -> Iterator[SecuredProcess]:
        """Yield the processes in enclaves that are not the observed processes of these enclaves.

        Of several processes that fit an observed process, the first one counts as this process,
        unless its user cannot read the files of the enclave.
        """
        programs: dict[tuple[str, int], SecuredProcess] = {}
        by_user = sorted(
            secured,
            key=lambda entry: (not self.may_use_files(entry.process), entry.process.started),
        )
        for entry in by_user:
            programs.setdefault((entry.enclave.name, entry.process.program[0]), entry)
        count = Counter[tuple[str, Sequence[int]]]()
        for (name, _), program in programs.items():
            known = [known for known in observed.processes if known.enclave == name]
            fitting = tuple(place for place, like in enumerate(known) if like.fits(program.process))
            count[name, fitting] += 1
            if count[name, fitting] > (len(fitting) if known else 1):
                yield program

    def enclaves_with_other_files(self, observed: ObservedProcesses) -> Sequence[str]:
        """Return the enclaves whose process runs secured, but with no files of the export."""
        own = {process.pid for process, _ in self.secured}
        others = [
            process
            for process in self.in_domain
            if process.asks_for_security and process.pid not in own
        ]
        pids = {process.program[0] for process in others}
        names = {process.enclave.name for process in others if process.enclave}
        return [
            process.enclave
            for process in observed.processes
            if process.pid in pids or (process.enclave in names and not process.pid)
        ]

    def with_later_processes(self, observed: ObservedProcesses) -> ObservedProcesses:
        """Return the observed processes with their present commands and units, and new processes.

        Only processes of users who can read the enclaves count, because sros proposes to run their
        commands.
        """
        known = Counter(process.enclave for process in observed.processes)
        running: dict[str, list[Process]] = {}
        for process, enclave in self.secured:
            if self.may_use_files(process):
                running.setdefault(enclave.name, []).append(process)
        as_started = [
            self._with_own_unit(self._with_running_command(process, processes), processes)
            if known[process.enclave] == 1
            else process
            for process in observed.processes
            for processes in [running.get(process.enclave, ())]
        ]
        later = [
            self._with_own_unit(secured_process(process, name)._replace(unit=""), [process])
            for name, processes in running.items()
            if name not in {OBSERVER, *observed.not_here, *known}
            for process in processes
            if not _is_tool(process)
        ]
        return observed._replace(processes=[*as_started, *later])

    def _with_running_command(
        self, observed: ClosedProcess, running: Sequence[Process]
    ) -> ClosedProcess:
        """Return an observed process with the command of the only program in its enclave.

        Programs of `ros2` and sros do not count. If a launch, a container or another process starts
        the observed process, its command does not change; nor does it if the process left its unit
        for none of its own, or if the program runs without the argument for its enclave.
        """
        started_by = observed.launch or observed.container or observed.shares
        programs = {process.program: process for process in running}
        if started_by or len(programs) != 1 or any(map(observed.fits, running)):
            return observed
        (process,) = programs.values()
        now = secured_process(process, observed.enclave)
        if now.launch or now.container or _is_tool(process):
            return observed
        has_left = now.unit != observed.unit and not self._own_unit(process)
        if observed.unit and (has_left or now.lacks_enclave_argument):
            return observed
        return observed._replace(command=now.command, folder=now.folder, rmw=now.rmw, user=now.user)

    def _with_own_unit(self, known: ClosedProcess, running: Sequence[Process]) -> ClosedProcess:
        """Return a process with its unit, if the unit starts only this process, in its enclave.

        ``running`` are the processes in its enclave.
        """
        programs = {process.program[0]: process for process in running if known.fits(process)}
        if known.launch or known.container or known.shares or len(programs) != 1:
            return known
        ((pid, process),) = programs.items()
        unit = process_origin(pid).unit
        needs_drop_in = (SYSTEMD_FOLDER / f"{unit}.d" / DROP_IN).exists()
        if unit == known.unit:
            return known._replace(secured_by_unit=known.secured_by_unit and not needs_drop_in)
        if self._own_unit(process):
            known = known._replace(user=process.user)
            return known._replace(unit=unit, secured_by_unit=not needs_drop_in)
        return known._replace(unit="", secured_by_unit=False) if known.secured_by_unit else known

    def _own_unit(self, process: Process) -> str:
        """Return the unit that starts only this process, with security; "" without such a unit."""
        origin = process_origin(process.program[0])
        is_alone = self._programs_of_units[origin.unit] == 1
        # With another strategy, a restart would not help.
        is_secured = process.environment.get(STRATEGY) == "Enforce"
        by_itself = is_alone and is_secured and not (origin.launch or origin.container)
        return origin.unit if by_itself else ""

    @cached_property
    def _programs_of_units(self) -> Mapping[str, int]:
        """The number of programs in the robot's domain that each unit started."""
        programs = {process.program[0] for process in self.in_domain}
        return Counter(process_origin(pid).unit for pid in programs)

    def with_new_units(
        self, observed: ObservedProcesses, idle: Mapping[str, Collection[str]]
    ) -> ObservedProcesses:
        """Return the observed processes, and the open processes of units for enclaves without one.

        ``idle`` maps these enclaves to the full names of their nodes. Only units that start a
        single process count.
        """
        recognized = {
            text: known
            for text, named in self.named_processes(observed, idle).items()
            if (known := with_command_of_unit(named)).unit
            and self._programs_of_units[known.unit] == 1
        }
        moved = {known.enclave for known in recognized.values()}
        stay = [
            self._with_unit_of_main_process(process)
            for process in observed.processes
            if process.enclave not in moved
        ]
        return observed._replace(
            processes=[*stay, *recognized.values()],
            unknown=[text for text in observed.unknown if text not in recognized],
        )

    def _with_unit_of_main_process(self, known: ClosedProcess) -> ClosedProcess:
        """Return an open process with the unit into which the user moved it.

        Only root can restart the unit closed; for other users, the process stays without a unit.
        """
        unit, pid = unit_of_main_process(known), known.pid
        is_alone = self._programs_of_units[unit] == 1
        fits = is_alone and os.access(SYSTEMD_FOLDER, os.W_OK) and self.is_open(known)
        open_processes = [other for other in self.open_processes if other.program[0] == pid]
        if unit and fits and any(map(self.may_use_files, open_processes)):
            return known._replace(unit=unit)
        return known

    def named_processes(
        self, observed: ObservedProcesses, idle: Mapping[str, Collection[str]]
    ) -> Mapping[str, ClosedProcess]:
        """Map unknown open processes (their text) to the enclaves' processes that they seem to be.

        ``idle`` maps enclaves without a process to the full names of their nodes. Only processes of
        users who can read the enclaves count. Only a name shows the enclave: the last process left
        may be any program, and may not get rights.
        """
        programs = _programs_of_enclaves(observed)
        claims: dict[str, list[tuple[Process, str]]] = {}
        for process in filter(self.may_use_files, self.open_processes):
            enclaves, known_by = _enclaves_of(process, idle, programs)
            if len(enclaves) == 1 and process_text(process) in observed.unknown:
                claims.setdefault(enclaves[0], []).append((process, known_by))
        return {
            process_text(process): secured_process(process, enclave)._replace(known_by=known_by)
            for enclave, ((process, known_by), *others) in claims.items()
            if not others
        }

    def other_domains_text(self) -> str:
        """Return the processes of other ROS domains, with the commands that close them, or ""."""
        robot, domains = self.robot, dict[str, list[str]]()
        for process in self.processes.processes:
            if not (is_in_domain(process, robot.domain) or process.network or process.is_daemon):
                domains.setdefault(process.domain, []).append(process.label)
        close = "sros close ANOTHER_FOLDER" if robot.observed else robot.close_command
        texts = []
        for domain, labels in sorted(domains.items()):
            runs, these = ("runs", "it") if len(labels) == 1 else ("run", "them")
            texts.append(
                f"{first_few(labels, MOST_NAMES)} {runs} in domain {domain}, not in "
                f"{robot.domain}; to close {these}, run `{close} --domain {domain}`"
            )
        return "; ".join(texts)


def wait_until(
    robot: LocalRobot, is_over: Callable[[RunningRobot], bool], patience: float
) -> RunningRobot:
    """Return the running processes when they fulfill a condition, or after ``patience`` seconds."""
    table, end = ProcessTable(), time.monotonic() + patience
    while True:
        is_last = time.monotonic() > end
        running = RunningRobot(robot, table.look(robot.shell.now()))
        if is_last or is_over(running):
            return running
        time.sleep(_LOOK_SECONDS)


def secured_process(process: Process, enclave: str) -> ClosedProcess:
    """Return a process that runs in an enclave, with the command that starts it open."""
    known = ClosedProcess.from_process(process, enclave, process_origin(process.pid), "enclave")
    return known._replace(command=command_without_enclave(known.command, enclave))


def unit_of_main_process(process: ClosedProcess) -> str:
    """Return the unit that now starts a process without a unit, as its main process; or ""."""
    if process.launch or process.container or process.shares or process.lacks_enclave_argument:
        return ""
    unit = process_origin(process.pid).unit if process.pid and not process.unit else ""
    main = unit_properties(unit, "MainPID").get("MainPID") if unit else ""
    return unit if main == f"{process.pid}" else ""


def units_that_started(processes: Iterable[ClosedProcess]) -> Sequence[str]:
    """Return the units that started processes that run now, as text; sros restarts none of them."""
    pids = {process.pid for process in processes if not process.unit} - {0}
    return sorted({process_origin(pid).unit_text for pid in pids} - {""})


def unit_advice(processes: Iterable[ClosedProcess]) -> Iterator[str]:
    """Yield what to do with the units that start these processes by themselves."""
    for unit in units_that_started(processes):
        yield (
            f"{unit} starts it: put this command into the unit or its script, if it is not there "
            "yet, and restart the unit instead"
        )


def _programs_of_enclaves(observed: ObservedProcesses) -> Mapping[str, str]:
    """Map the enclaves of observed processes to their program, if it shows which node it runs.

    It does not if several enclaves have the program, such as `component_container`, or if the
    command gives the node a name or a namespace.
    """
    programs = {
        (process.enclave, _program_name(process.command)): any(
            map(any, started_nodes(process.command))
        )
        for process in observed.processes
    }
    count = Counter(program for _, program in programs)
    return {
        enclave: program
        for (enclave, program), is_named in programs.items()
        if count[program] == 1 and not is_named
    }


def _program_name(command: Sequence[str]) -> str:
    return program_of(tuple(command)).removesuffix(".py")


def _enclaves_of(
    process: Process, nodes: Mapping[str, Collection[str]], programs: Mapping[str, str]
) -> tuple[Sequence[str], str]:
    """Return the enclaves with a node of a process's name, and what shows the name.

    ``nodes`` maps enclaves to the full names of their nodes, and ``programs`` enclaves to the
    program that sros remembers. The name is the node's in the command, or otherwise the name of the
    program.
    """
    if named := node_argument(process.command):
        full_name = expand("~", *named)
        return [enclave for enclave, names in nodes.items() if full_name in names], "node name"
    program = _program_name(process.command)
    fitting = [
        enclave
        for enclave, names in nodes.items()
        if program in {programs.get(enclave), *(name.rpartition("/")[2] for name in names)}
    ]
    return fitting, "program"


def _is_tool(process: Process) -> bool:
    """Return whether a process is a tool for tests, such as `ros2 topic echo`, and no router."""
    is_tool = program_of(process.command).partition(".")[0] in _TOOLS
    return is_tool and not process.is_router


def keystore_text(enclave: ProcessEnclave) -> str:
    """Return the keystore that a process names, short and safe to print."""
    return plain(enclave.keystore, _LONGEST_PATH)


class CloseStep(NamedTuple):
    """A step of closing a robot."""

    command: str
    """The command line that does the same as the step."""
    state: Annotated[str, Words(("done", "kept", "findings", "open"))]
    """Whether the step was done now, was not repeated because its result existed, found something,
    or is not done.
    """


class Proof(NamedTuple):
    """A claim about the closed robot."""

    claim: str
    """What has to hold."""
    holds: bool | None
    """Whether the claim holds; null if it could not be tested."""
    reason: str
    """What was seen, or why the claim could not be tested."""
    denied: Sequence[str] = ()
    """The rights, as sentences, that the robot used when sros watched, and that the keystore now
    denies. The claim holds except for these."""
    details: Sequence[str] = ()
    """What else was seen, as clauses, such as rights that no node used, and new nodes; also what
    sros cannot see, such as whether two nodes hear each other.
    """
    unexamined: bool = False
    """Whether the claim could not be tested because sros could not examine processes."""

    @property
    def fails(self) -> bool:
        """Whether the claim was tested, and does not hold."""
        return self.holds is False

    @property
    def statement(self) -> str:
        """The claim, or its negation if the claim fails."""
        return _NEGATIONS[self.claim] if self.fails else self.claim

    @property
    def acceptances(self) -> Sequence[Acceptance]:
        """What ``--accept`` may name, one of these, so that the claim need not be tested.

        It is empty if the claim was tested, and for claims that need an observer of the running
        robot.
        """
        words = [Acceptance.UNEXAMINED] * self.unexamined
        words += [_ACCEPTANCES[claim] for claim in (self.claim,) if claim in _ACCEPTANCES]
        return words if self.holds is None else []


@shows(spread=("observed",))
class CloseState(NamedTuple):
    """What is done to close a robot, and what is missing."""

    folder: Path
    """The folder with everything that was made."""
    observed: ObservedProcesses
    steps: Sequence[CloseStep]
    """The steps in their order."""
    secured: Mapping[str, bool]
    """The enclaves in which a process of the robot runs now: true if the process has the current
    files, false if the process has to be restarted.
    """
    other_files: Sequence[str]
    """The enclaves whose process runs secured, but not with the files of the export."""
    outdated: Mapping[str, str]
    """The enclaves whose processes have to be restarted, each with the reason. Read the reason as a
    sentence that ends with "the processes of" and the enclave.
    """
    outdated_pids: Mapping[str, Sequence[int]]
    """The enclaves of `outdated`, each with the ids of the processes to restart; restart the
    enclaves in this order. With `--apply`, the processes that are left after its restarts.
    """
    also_open: Mapping[str, Sequence[int]]
    """The enclaves whose process runs closed, each with the ids of further processes that have the
    same command and run open, such as a new version of a node.
    """
    not_observed: Sequence[str]
    """Processes that run in enclaves of the robot but were not observed there, and further
    processes with an observed command, as "process 123 (talker) in /talker". The text of a
    process that runs in place of the observed process of its enclave ends with "(by another
    command than the observed process)".
    """
    new: Sequence[str]
    """The enclaves of the policy in which no process was observed, and none runs now."""
    absent: Sequence[str]
    """The enclaves whose process does not run, although a systemd unit starts it."""
    without: Sequence[str]
    """The enclaves of `--without`, of which no process has to run."""
    needed_elsewhere: Mapping[str, datetime]
    """The enclaves of other machines, and when their files changed last in the keystore, in UTC. A
    machine with earlier files needs the current files: it still trusts certificates that were
    revoked since then. Enclaves that the policy does not have are in `problems` instead, and
    enclaves whose current files were brought are in `brought`.
    """
    brought: Mapping[str, datetime]
    """The enclaves of other machines that have the current files, as the user said with
    `--brought` (sros cannot verify this), and when these files changed last in the keystore, in
    UTC.
    """
    expired_elsewhere: Mapping[str, datetime]
    """The enclaves of other machines whose files in the keystore have expired, and when they
    expired, in UTC.
    """
    earlier_elsewhere: Mapping[str, datetime]
    """The enclaves of `expired_elsewhere` of which earlier files still work for whoever kept them,
    and until when, in UTC.
    """
    valid_until: datetime | None
    """When the first enclave of the export expires, in UTC; null without an export."""
    expires_soon: Sequence[str]
    """The enclaves of the export that should be renewed now, because they expire soon."""
    denied: Sequence[str]
    """What the observed nodes did while sros watched, but the keystore denies, as sentences."""
    newly_denied: Sequence[str]
    """The part of `denied` that the keystore did not deny before this command."""
    denied_remappings: Mapping[str, Sequence[str]]
    """The enclaves whose start command gives a node a denied name, each with the remapping rules
    that give these names.
    """
    problems: Sequence[str]
    """Reasons why the robot is not closed yet, or not open again, with what to do."""
    blocked: bool
    """Whether `problems` keep `--apply` from restarting any unit. If not, `--apply` restarts the
    units that run closed and whose files changed, in spite of the problems.
    """
    proofs: Sequence[Proof]
    """The claims that prove the robot closed; empty if they were not tested."""
    dry_run: DryRun
    changes: FileChanges

    def is_proved(self, accepted: Acceptances) -> bool:
        """Return whether the proof holds; ``accepted`` claims need not have been tested."""
        claims = [
            proof.holds or not accepted.isdisjoint(proof.acceptances) for proof in self.proofs
        ]
        return bool(claims) and all(claims)

    @property
    def is_signed(self) -> bool:
        """Whether all steps were done, so that signed permissions and policy agree."""
        return all(step.state != "open" for step in self.steps)

    @property
    def pending(self) -> Sequence[str]:
        """The enclaves that should have a process with the current files, and have none."""
        names = self.observed.enclaves | {*self.new}
        names = names.difference(self.without) | self.secured.keys()
        return sorted(name for name in names if not self.secured.get(name))

    @property
    def stopped(self) -> set[str]:
        """The enclaves of which no process runs, open or closed."""
        processes = self.observed.processes
        stopped = {other.enclave for other in processes if not (other.pid or other.alike)}
        return {*self.new, *self.absent, *stopped} - self.secured.keys()

    @property
    def closed_units_to_restart(self) -> set[str]:
        """The units whose process runs in its enclave, but has to be restarted."""
        return {
            process.unit
            for process in self.observed.processes
            if self.runs_closed(process) and process.enclave in self.pending
        } & self.observed.units

    def runs_closed(self, process: ClosedProcess) -> bool:
        """Return whether a process of the robot runs in its enclave, even with earlier files.

        A process of another user can claim the enclave, while the robot's process runs open.
        """
        is_current = self.secured.get(process.enclave, False)
        return is_current or process.pid in self.outdated_pids.get(process.enclave, ())

    @property
    def pending_by_hand(self) -> Mapping[str, Sequence[ClosedProcess]]:
        """The commands to run by hand for the enclaves in ``pending``, with their processes.

        Processes that only need the new revocation list come last, after processes with a new key
        or new rights.
        """
        by_hand = self.observed.commands_by_hand(self.folder.absolute())
        due = [
            (command, processes)
            for command, processes in by_hand.items()
            if any(process.enclave in self.pending for process in processes)
        ]
        return dict(sorted(due, key=lambda entry: all(map(self.may_restart_last, entry[1]))))

    def may_restart_last(self, process: ClosedProcess) -> bool:
        """Return whether a process may restart after processes with a new key or new rights."""
        why = self.outdated.get(process.enclave, "")
        return why.endswith(_ACCEPTS_REVOKED) and process.enclave != ROUTER


def current_state(robot: LocalRobot, policy: Policy | None) -> CloseState:
    """Return how far the robot is closed now; only enclaves of ``policy`` count."""
    running = RunningRobot(robot)
    secured = {
        name: name in running.current_enclaves
        for name in sorted({enclave.name for _, enclave in running.secured} - {OBSERVER})
    }
    observed = ObservedProcesses(robot.domain)
    if robot.observed:
        observed = running.with_later_processes(robot.observed)
        observed = observed.with_current_pids(running.processes, robot.export)
    observed = observed.limited_to(policy) if policy else observed
    if secured and policy:
        idle = {
            **_new_enclaves(robot, policy, observed, secured),
            **_movable_enclaves(policy, observed, secured),
        }
        observed = running.with_new_units(observed, idle)
    absent = {process.enclave for process in observed.processes if process.absent}
    new = _new_enclaves(robot, policy, observed, secured) if policy else {}
    outdated = {
        name: processes
        for name, processes in sorted(
            running.not_current.items(),
            key=lambda entry: (entry[1][-1][1].endswith(_ACCEPTS_REVOKED), entry[0]),
        )
        if name in secured
    }
    known = observed.enclaves | secured.keys()
    check_enclaves(robot.without, known | new.keys() | robot.not_here, "--without")
    outside = robot.enclaves_outside_policy() if policy else ()  # the policy may be broken
    changed_at = {
        name: changed
        for name in sorted(robot.not_here.difference(outside))
        if (changed := robot.changed_at(name))
    }
    brought = {
        name: changed
        for name, changed in changed_at.items()
        if observed.brought.get(name) == changed.isoformat()
    }
    return CloseState(
        folder=robot.folder,
        observed=observed,
        steps=(),
        secured=secured,
        other_files=running.enclaves_with_other_files(observed),
        outdated={name: processes[-1][1] for name, processes in outdated.items()},
        outdated_pids={
            name: [*dict.fromkeys(process.program[0] for process, _ in processes)]
            for name, processes in outdated.items()
        },
        also_open=running.also_open(observed, secured),
        not_observed=running.not_observed(),
        new=sorted(new),
        absent=sorted(absent - secured.keys()),
        without=robot.without,
        needed_elsewhere={
            name: changed for name, changed in changed_at.items() if name not in brought
        },
        brought=brought,
        expired_elsewhere=(expired := _expired_enclaves(robot, changed_at)),
        earlier_elsewhere=earlier_files_until(robot, expired),
        valid_until=(until := _valid_until(robot)),
        expires_soon=_expiring_enclaves(robot) if until else (),
        denied=(),
        newly_denied=(),
        denied_remappings={},
        problems=(),
        blocked=False,
        proofs=(),
        dry_run=False,
        changes=(),
    )


def _new_enclaves(
    robot: LocalRobot, policy: Policy, observed: ObservedProcesses, secured: Collection[str]
) -> Mapping[str, Collection[str]]:
    """Map the enclaves of the policy without a known process to the full names of their nodes.

    Processes run in the enclaves ``secured``. Before a watch, the result is empty.
    """
    known = {*observed.enclaves, *secured, *observed.elsewhere, *robot.not_here, OBSERVER}
    nodes = policy.nodes() if robot.observed else {}
    return {enclave: names for enclave, names in nodes.items() if enclave not in known}


def _movable_enclaves(
    policy: Policy, observed: ObservedProcesses, secured: Collection[str]
) -> Mapping[str, Collection[str]]:
    """Map the enclaves without a process whose node may have moved into a unit to full names.

    The user started the process by hand or by a script.
    """
    count = Counter(process.enclave for process in observed.processes)
    movable = {
        process.enclave
        for process in observed.processes
        if process.is_idle and process.enclave not in secured and count[process.enclave] == 1
        if not (process.unit or process.launch or process.container or process.shares)
    }
    return {enclave: names for enclave, names in policy.nodes().items() if enclave in movable}


def _valid_until(robot: LocalRobot) -> datetime | None:
    """Return when the first enclave of the export expires; None if one cannot be read."""
    if not robot.export.exists():
        return None
    moments = expiries_of_export(robot).values()
    return min(filter(None, moments), default=None) if all(moments) else None


def expiries_of_export(robot: LocalRobot) -> Mapping[str, datetime | None]:
    """Map the enclaves of the export to their expiry; None for an enclave that cannot be read."""
    return _expiries(robot, robot.export, list_enclaves(robot.export))


def _expiries(robot: LocalRobot, root: Path, names: Iterable[str]) -> Mapping[str, datetime | None]:
    """Map enclaves below ``root`` to their expiry; None for an enclave that cannot be read."""
    now, files = robot.shell.now(), FilesReadOnce()
    return {
        name: open_enclave(enclave_path(root, name), now=now, files=files).valid_until()
        for name in names
    }


def _expired_enclaves(robot: LocalRobot, names: Iterable[str]) -> Mapping[str, datetime]:
    """Map the named enclaves of the keystore that have expired to their expiry."""
    now, expiries = robot.shell.now(), _expiries(robot, robot.keystore, names)
    return {name: expiry for name, expiry in expiries.items() if expiry and expiry < now}


def _expiring_enclaves(robot: LocalRobot) -> Sequence[str]:
    """Return the enclaves of the export that expire soon, as `sros renew` decides."""
    lifetimes, _ = survey(OpenedKeystore(robot.export))
    now = robot.shell.now()
    return [lifetime.name for lifetime in lifetimes if lifetime.is_due(Threshold(), now)]


def earlier_files_until(robot: LocalRobot, names: Collection[str]) -> Mapping[str, datetime]:
    """Map each named enclave with earlier files that still work to the expiry of these files."""
    if not names:
        return {}
    issued, now = IssuedCredentials(OpenedKeystore(robot.keystore), names), robot.shell.now()
    moments = {name: issued.permissions_until(name) for name in names}
    return {name: until for name, until in moments.items() if until and until > now}
