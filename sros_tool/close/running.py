"""The processes of a robot that run now, and which of them run in its enclaves."""

from __future__ import annotations

from collections.abc import Mapping, Sequence, Set
from functools import cached_property
from typing import NamedTuple

from sros_tool.checks.processes import newer_files
from sros_tool.close.processes import (
    ClosedProcess,
    ObservedProcesses,
    command_without_enclave,
    is_in_domain,
)
from sros_tool.close.robot import MOST_NAMES, OBSERVER, LocalRobot
from sros_tool.keystore.layout import KEY_FILE
from sros_tool.runtime.processes import (
    Process,
    ProcessEnclave,
    ProcessTable,
    RunningProcesses,
    plain,
    process_origin,
)
from sros_tool.runtime.variables import STRATEGY
from sros_tool.wording import first_few

_LONGEST_PATH = 300


class SecuredProcess(NamedTuple):
    """A process that runs in an enclave of the robot's export."""

    process: Process
    enclave: ProcessEnclave


class RunningRobot:
    """The processes of this machine at one moment, as the robot's folder knows them."""

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
            if process.enclave and process.enclave.is_of(export)
        ]

    @cached_property
    def open_processes(self) -> Mapping[tuple[str, ...], Process]:
        """The processes in the robot's domain that run without security, by their commands."""
        return {
            process.program[1]: process
            for process in self.in_domain
            if not process.asks_for_security
        }

    def is_open(self, process: ClosedProcess) -> bool:
        """Return whether an observed process runs open, and no process runs in its enclave."""
        is_secured = any(enclave.name == process.enclave for _, enclave in self.secured_everywhere)
        return not is_secured and tuple(process.command) in self.open_processes

    @cached_property
    def current_enclaves(self) -> Set[str]:
        """The enclaves in which a process runs with the current files of the export.

        Without the strategy Enforce, a process runs open if its files were not there at its start.
        """
        return {
            enclave.name
            for process, enclave in self.secured
            if enclave.is_there
            and self.may_use_files(process)
            and process.environment.get(STRATEGY) == "Enforce"
            and not [*newer_files(process, enclave)]
        }

    def may_use_files(self, process: Process) -> bool:
        """Return whether a process is of a user who can read the enclaves.

        Another user's process can only claim to run in one.
        """
        return process.user in (0, self.robot.export.stat().st_uid)

    def why_not_current(self, process: Process, enclave: ProcessEnclave) -> str:
        """Return why a process is not closed, as text before "the processes of ENCLAVE"."""
        if not self.may_use_files(process):
            return f"user {process.user}, who cannot read the files, runs"
        if process.environment.get(STRATEGY) != "Enforce":
            return f"no {STRATEGY}=Enforce in"
        newer = first_few([*newer_files(process, enclave)], MOST_NAMES) or "files"
        mode = enclave.file(KEY_FILE).mode
        readable = (
            f"others can read {KEY_FILE} (its mode is {mode:04o}): if anybody did, `sros renew "
            f"KEYSTORE {enclave.name} --new-key --revoke-old`, otherwise chmod 600; "
        )
        lead = readable if mode & 0o077 else ""
        return f"{lead}{newer} changed, or got another mode, after the start of"

    def with_later_processes(self, observed: ObservedProcesses) -> ObservedProcesses:
        """Return observed processes with those that were started later, in other enclaves.

        Only processes of users who can read the enclaves count, because sros proposes to run their
        commands.
        """
        known = {OBSERVER, *observed.not_here}
        known |= {process.enclave for process in observed.processes}
        later = [
            secured_process(process, enclave.name)
            for process, enclave in self.secured
            if enclave.name not in known and self.may_use_files(process)
        ]
        return observed._replace(processes=[*observed.processes, *later])

    def in_other_domains(self) -> str:
        """Return the processes of other ROS domains, with the commands that close them, or ""."""
        robot, domains = self.robot, dict[str, list[str]]()
        for process in self.processes.processes:
            if not (is_in_domain(process, robot.domain) or process.network or process.is_daemon):
                domains.setdefault(process.domain, []).append(process.label)
        close = "sros close ANOTHER_FOLDER" if robot.observed else robot.close_command
        return "; ".join(
            f"in domain {domain}, not {robot.domain}, runs {first_few(labels, MOST_NAMES)}: "
            f"to close it, {close} --domain {domain}"
            for domain, labels in sorted(domains.items())
        )


def secured_process(process: Process, enclave: str) -> ClosedProcess:
    """Return a process that runs in an enclave, with the command that starts it open."""
    known = ClosedProcess.from_process(process, enclave, process_origin(process.pid), "enclave")
    return known._replace(command=command_without_enclave(known.command, enclave))


def keystore_text(enclave: ProcessEnclave) -> str:
    """Return the keystore that a process names, short and safe to print."""
    return plain(enclave.keystore, _LONGEST_PATH)
