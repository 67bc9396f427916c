"""The processes of a robot, their enclaves, and the commands that start them."""

from __future__ import annotations

import os
import re
import shlex
import shutil
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, NamedTuple, TypeVar

from sros_tool.enclave_environment import RMWS
from sros_tool.errors import DocumentError
from sros_tool.policy.model import Policy
from sros_tool.runtime.environment import REFUSING, REFUSING_DDS, RMW_ZENOH, ROS_ARGS, named_enclave
from sros_tool.runtime.processes import (
    SERVICE_NAME,
    Process,
    ProcessOrigin,
    RunningProcesses,
    boot_id,
    launch_word_index,
    process_origin,
    program_of,
    start_of,
    without_launch_files,
)
from sros_tool.runtime.rmw import RMW
from sros_tool.runtime.variables import DOMAIN, ENCLAVE
from sros_tool.terminal import visible
from sros_tool.values import Words, parse_json
from sros_tool.wording import enumerated
from sros_tool.xml import read_bytes

ROUTER = "/router"
"""The enclave of a Zenoh router."""
COMPOSE_FILE = "compose.yaml"
DROP_IN = "sros-close.conf"
SYSTEMD_FOLDER = Path("/etc/systemd/system")


class ClosedProcess(NamedTuple):
    """A process of the robot, and the enclave in which it has to run."""

    enclave: str
    """The enclave of the process."""
    pid: int
    """The id of the process; 0 if no process with the command is known to run in the enclave now,
    or if several processes fit (`alike`).
    """
    command: Sequence[str]
    """Command of the process, with the arguments."""
    folder: str
    """Working directory of the process."""
    user: int
    """The id of the user who runs the process; 4294967295 if several users can control it."""
    unit: str
    """The systemd unit that starts only this process; empty if you restart the process by
    hand.
    """
    known_by: Annotated[
        str, Words(("process id", "node name", "program", "elimination", "enclave", "command"))
    ]
    """What shows that this process has the nodes of the enclave; ``elimination``: no other process
    is left for them.
    """
    launch: Sequence[str] = ()
    """The command of the launch that started the process: `ros2 launch`, or a Python program that
    runs a launch description; empty if no launch started it.
    """
    container: str = ""
    """The id of the process's Docker container; empty outside of containers."""
    rmw: str = ""
    """rmw_zenoh_cpp for a process on Zenoh; otherwise the RMW that its environment names; empty if
    the environment names no RMW, or an RMW that enforces no security.
    """
    shares: Sequence[str] = ()
    """The other enclaves whose processes the same command starts, for example with
    `multiprocessing`.
    """
    chooses: bool = False
    """Whether the program itself gives the process its enclave, by ROS_SECURITY_ENCLAVE_OVERRIDE.
    """
    alike: Sequence[int] = ()
    """The ids of several processes that fit equally well; sros does not choose one, and `pid` is
    0.
    """
    started: str = ""
    """The id of the boot, and the clock ticks from the boot to the start of the process `pid`:
    after the process ends, another process may get its id. It is empty if sros did not see the
    start.
    """
    absent: bool = False
    """Whether the process does not run now, although its systemd unit started it when sros
    watched.
    """
    secured_by_unit: bool = False
    """Whether the unit itself starts the process in its enclave, as the units of `sros units` do.
    Such a unit gets no drop-in.
    """

    @classmethod
    def from_process(
        cls, process: Process, enclave: str, origin: ProcessOrigin, known_by: str
    ) -> ClosedProcess:
        """Return a running process with its enclave and what started it."""
        pid, _ = process.program
        start = enclave, pid, _start_command(process), origin.folder, process.user, origin.unit
        rmw = _rmw_to_start(process)
        chooses = process.environment.get(ENCLAVE) == enclave
        known = cls(*start, known_by, origin.launch, origin.container, rmw, (), chooses)
        return known._replace(started=start_of(pid))

    @property
    def is_router(self) -> bool:
        """Whether the process is a Zenoh router, which has no node."""
        return self.rmw == RMW_ZENOH and self.enclave == ROUTER

    @property
    def is_demo(self) -> bool:
        """Whether `sros demo` starts the process; its nodes name their enclaves themselves."""
        return tuple(self.command[:2]) == ("sros", "demo")

    @property
    def is_by_hand(self) -> bool:
        """Whether the user restarts the process, not --apply.

        A unit that needs no drop-in can be restarted without sros, so it alone does not require
        that root closes the robot.
        """
        may_restart = not self.secured_by_unit or os.access(SYSTEMD_FOLDER, os.W_OK)
        return not (self.unit and may_restart)

    @property
    def is_launch(self) -> bool:
        """Whether the process itself runs a launch description, and has a node of its own."""
        return bool(self.launch) and tuple(self.command) == tuple(self.launch)

    @property
    def pids_text(self) -> str:
        """The id of the process, or the ids that fit equally, as text; "" if none runs."""
        if self.alike:
            return (
                f"one of the processes {enumerated([*map(str, self.alike)])} (sros cannot tell "
                "which is this robot's)"
            )
        return f"process {self.pid}" if self.pid else ""

    @property
    def lacks_enclave_argument(self) -> bool:
        """Whether the command has to name the enclave, because Zenoh nodes look for the name."""
        is_node = self.rmw == RMW_ZENOH and not (self.is_router or self.is_demo)
        return is_node and named_enclave(self.command) != self.enclave

    def fits(self, process: Process) -> bool:
        """Return whether a process has this command and RMW; all Zenoh routers fit each other.

        The command may have the argument for the enclave that ``sros run`` adds, and the temporary
        files of another launch.
        """
        if self.is_router and process.is_router:
            return True
        rmws = {self.rmw, _rmw_to_start(process)}
        if len(rmws - {""}) > 1 or rmws == {"", RMW_ZENOH}:  # a process that names no RMW is on DDS
            return False
        started, known = (
            without_launch_files(command_without_enclave(command, self.enclave))
            for command in (_start_command(process), self.command)
        )
        return started == known

    def with_current_pid(
        self, running: RunningProcesses, domain: int, export: Path
    ) -> ClosedProcess:
        """Return a copy with the id and unit that the process has now, in its domain and network.

        A process that runs in its enclave of the ``export`` is preferred to open ones, unless its
        user cannot read the files.  The id stays if the process may run but could not be examined.
        """
        in_domain = [other for other in running.processes if is_in_domain(other, domain)]
        in_enclave = [
            other
            for other in in_domain
            if (enclave := other.enclave)
            and enclave.name == self.enclave
            and enclave.is_in_keystore(export)
            and may_use_files(other, export)
        ]
        pids = [
            *dict.fromkeys(
                other.program[0] for other in in_enclave or in_domain if self.fits(other)
            )
        ]
        is_same = self.pid in pids and self.still_runs
        may_run = self._may_run_unseen(running)
        if self.secured_by_unit and pids and not in_enclave:
            return self._replace(secured_by_unit=False).with_current_pid(running, domain, export)
        if is_same or (may_run and not pids and not in_enclave):
            return self._replace(alike=(), absent=False)
        origins = {pid: process_origin(pid) for pid in pids}
        of_unit = [pid for pid in pids if self.unit and origins[pid].unit == self.unit]
        if in_enclave:
            pids = (of_unit or pids)[:1]  # all of them run in the enclave
        elif len(pids) > 1:
            pids = of_unit or [pid for pid in pids if origins[pid].folder == self.folder] or pids
        runs = may_run or any(map(self.fits, running.processes))
        now = self._replace(pid=0, alike=(), absent=not (self.is_idle or runs) and bool(self.unit))
        if len(pids) > 1:
            return now._replace(alike=pids, unit=self.unit if of_unit else "")
        known_by = "command" if pids and self.known_by != "enclave" else self.known_by
        now = now._replace(pid=next(iter(pids), 0), known_by=known_by)
        return now._with_unit_of(in_domain, origins[now.pid]) if now.pid else now

    def _with_unit_of(self, in_domain: Iterable[Process], origin: ProcessOrigin) -> ClosedProcess:
        """Return a copy with the unit in which the process runs now, as its ``origin`` shows.

        Its earlier unit may have been stopped for good. Another unit counts only if it starts
        nothing else ``in_domain``, for the same user, and if its command need not name the enclave.
        """
        if origin.unit == self.unit or not self.unit or origin == ProcessOrigin():
            return self
        is_alone = all(
            (process.program[0], process.user) == (self.pid, self.user)
            for process in in_domain
            if process_origin(process.program[0]).unit == origin.unit
        )
        unit = origin.unit if is_alone and not self.lacks_enclave_argument else ""
        return self._replace(unit=unit, folder=origin.folder or self.folder)

    @property
    def is_idle(self) -> bool:
        """Whether no process is known, and none has to run, because the process ended."""
        return not (self.pid or self.alike or self.absent)

    @property
    def still_runs(self) -> bool:
        """Whether the process `pid` is the process that sros saw, and not a later one."""
        return bool(self.started) and start_of(self.pid) == self.started

    def _may_run_unseen(self, running: RunningProcesses) -> bool:
        """Return whether the process may run, although sros could not examine it."""
        if running.hidden:
            return bool(self.started) and self.started.partition(" ")[0] == boot_id()
        return self.pid in {process.pid for process in running.unseen} and self.still_runs

    def open_command(self, domain: int) -> str:
        """Return the shell command that starts the process open, in its ROS domain and RMW."""
        if self.container:
            return "docker compose up -d"
        variables = [f"{DOMAIN}={domain}"] * bool(domain) + [f"{RMW}={self.rmw}"] * bool(self.rmw)
        words = (*(("env", *variables) if variables else ()), *(self.launch or self.command))
        return f"cd {_shell_word(self.folder)} && {' '.join(map(_shell_word, words))}"

    def secured_command(
        self, folder: Path, launch_enclave: str = "", *, export: Path | None = None
    ) -> str:
        """Return the shell command that starts the process, its launch or containers with security.

        ``folder`` is the folder of the closed robot, and ``launch_enclave`` the enclave of the node
        of the launch itself. ``export`` is the export with the enclave; None for the export in
        ``folder``. A Python program that runs a launch description gets variables with
        which none of its nodes starts, unless it secures them: see `launch_advice`.
        """
        if self.container:
            overlay = shlex.quote(str(folder / "start" / COMPOSE_FILE))
            return f"docker compose -f compose.yaml -f {overlay} up -d"
        words = (_sros_word(), *self.command[1:]) if self.is_demo else self.command
        variables = {RMW: self.rmw} if self.rmw else {}
        if verb := launch_word_index(self.launch):
            words = launch_words(folder, self.launch[: verb + 1], self.launch[verb + 1 :])
        elif self.launch:
            words = self.launch
            variables = {**variables, **(REFUSING if self.rmw == RMW_ZENOH else REFUSING_DDS)}
        elif self.lacks_enclave_argument:
            words = (*words, ROS_ARGS, "--enclave", self.enclave)
        enclave = launch_enclave if self.launch else self.enclave
        if enclave:
            words = (*run_words(export or folder / "export", enclave, self.rmw), *words)
        elif variables:
            words = ("env", *(f"{name}={value}" for name, value in variables.items()), *words)
        return f"cd {_shell_word(self.folder)} && {' '.join(map(_shell_word, words))}"

    def launch_advice(self, folder: Path) -> str:
        """Return what to change in a Python program whose launch description starts the process.

        Returns "" for a process that `ros2 launch` or no launch starts.
        """
        if not self.launch or self.container or launch_word_index(self.launch):
            return ""
        given = f"keystore={str(folder / 'export')!r}, policy={str(folder / 'policy.xml')!r}"
        return visible(
            f"{program_of(tuple(self.launch))} runs a launch description itself. First put "
            f"SecuredNodes({given}) from sros_tool.launch in front of its nodes, once "
            "(docs/launch.md); without it, none of them starts."
        )


def may_use_files(process: Process, export: Path) -> bool:
    """Return whether a process is of a user who can read the enclaves of an export.

    A process of another user can only claim to run in an enclave.
    """
    return process.user == 0 or (export.exists() and process.user == export.stat().st_uid)


def _start_command(process: Process) -> tuple[str, ...]:
    """Return the command that starts a process again."""
    return process.demo_command or process.program[1]


def _rmw_to_start(process: Process) -> str:
    """Return the RMW that the command of a process has to name; "" if that is not known."""
    variable = process.environment.get(RMW, "")
    return RMW_ZENOH if process.is_zenoh else variable if variable in RMWS else ""


def _shell_word(word: str) -> str:
    """Return a word quoted for a shell, by `printf` if it may control a terminal or is no UTF-8."""
    if visible(word) == word:
        return shlex.quote(word)
    octal = re.sub(rb"[^A-Za-z0-9_./ ]", lambda byte: b"\\%03o" % ord(byte[0]), os.fsencode(word))
    return f"\"$(printf '{octal.decode()}')\""


def command_without_enclave(command: Sequence[str], enclave: str) -> Sequence[str]:
    """Return a command without the argument for its enclave that ``sros run`` adds at its end."""
    words = tuple(command)
    return words[:-3] if words[-3:] == (ROS_ARGS, "--enclave", enclave) else words


def _sros_word() -> str:
    """Return "sros", or the path of this program if the word does not start it in a shell."""
    running, found = shutil.which(sys.argv[0]), shutil.which("sros")
    if not running or Path(running).name != "sros" or (found and Path(found).samefile(running)):
        return "sros"
    return str(Path(running).absolute())


def run_words(export: Path, enclave: str, rmw: str) -> Sequence[str]:
    """Return the words before a command that start it in an enclave.

    If ``rmw`` is "", the words name no RMW.
    """
    return (_sros_word(), "run", str(export), enclave, *(("--rmw", rmw) if rmw else ()), "--")


def launch_words(folder: Path, before: Sequence[str], after: Sequence[str]) -> Sequence[str]:
    """Return a ``ros2 launch`` command whose processes run in the enclaves of a closed robot.

    ``before`` are the words of the command before the option that secures the processes, ``after``
    the words after it.
    """
    secured = ("--secured", str(folder / "export"), str(folder / "policy.xml"))
    return (*before, *secured, *after)


class ObservedProcesses(NamedTuple):
    """The processes of an open robot, and what sros cannot start in an enclave."""

    domain: int
    """The ROS domain."""
    processes: Sequence[ClosedProcess] = ()
    """The processes, each with the enclave that it will run in."""
    unknown: Sequence[str] = ()
    """Processes on this machine whose nodes are not known; they are not closed."""
    elsewhere: Sequence[str] = ()
    """Enclaves with nodes whose process sros did not find on this machine."""
    ended: Sequence[str] = ()
    """Enclaves whose processes ended while sros watched."""
    not_here: Sequence[str] = ()
    """Enclaves that belong to other machines (`--elsewhere`)."""
    brought: Mapping[str, str] = {}
    """Enclaves of `--brought`, and when their files in the keystore had changed last, in ISO 8601.
    """
    moved: Sequence[ClosedProcess] = ()
    """The processes of `not_here` that sros saw on this machine before `--elsewhere` named their
    enclaves.
    """

    @property
    def enclaves(self) -> set[str]:
        """The enclaves of the processes."""
        return {process.enclave for process in self.processes}

    @property
    def units(self) -> set[str]:
        """The systemd units that each start a single process, and that --apply restarts."""
        return {process.unit for process in self.processes if not process.is_by_hand}

    @property
    def units_with_drop_in(self) -> set[str]:
        """The units that start their processes in the enclaves by a drop-in of sros."""
        return {process.unit for process in self.processes if not process.secured_by_unit} - {""}

    def with_current_pids(self, running: RunningProcesses, export: Path) -> ObservedProcesses:
        """Return a copy with the current ids and the current unknown processes."""
        pids = {process.pid for process in self.processes if process.still_runs}
        unknown = [
            process_text(process)
            for process in running.processes
            if is_in_domain(process, self.domain)
            and not (process.is_daemon or process.is_router or process.asks_for_security)
            and process.program[0] not in pids
            and not any(known.fits(process) for known in self.processes)
        ]
        processes = [
            process.with_current_pid(running, self.domain, export) for process in self.processes
        ]
        return self._replace(processes=processes, unknown=unknown)

    def belonging_elsewhere(self, names: Iterable[str]) -> ObservedProcesses:
        """Return a copy in which the enclaves ``names`` belong to other machines."""
        not_here = {*self.not_here, *names}
        moved = [process for process in self.processes if process.enclave in not_here]
        seen_again = {process.enclave for process in moved}
        return self._replace(
            processes=[process for process in self.processes if process.enclave not in not_here],
            moved=[
                *moved,
                *(process for process in self.moved if process.enclave in not_here - seen_again),
            ],
            elsewhere=[enclave for enclave in self.elsewhere if enclave not in not_here],
            not_here=sorted(not_here),
        )

    def belonging_here(self, names: Iterable[str]) -> ObservedProcesses:
        """Return a copy in which the enclaves ``names`` belong to this machine again."""
        not_here = {*self.not_here}.difference(names)
        brought = {name: of for name, of in self.brought.items() if name in not_here}
        back = [process for process in self.moved if process.enclave not in not_here]
        return self._replace(
            processes=[*self.processes, *back],
            moved=[process for process in self.moved if process.enclave in not_here],
            not_here=sorted(not_here),
            brought=brought,
        )

    def limited_to(self, policy: Policy) -> ObservedProcesses:
        """Return a copy without enclaves that the policy does not have any more."""
        names = {ROUTER, *(enclave.path for enclave in policy.enclaves)}
        return self._replace(
            processes=[
                process._replace(shares=sorted(names.intersection(process.shares)))
                for process in self.processes
                if process.enclave in names
            ],
            elsewhere=[enclave for enclave in self.elsewhere if enclave in names],
            moved=[process for process in self.moved if process.enclave in names],
        )

    def enclaves_outside(self, policy: Policy) -> list[str]:
        """Return the enclaves of observed processes with nodes that the policy does not have.

        Zenoh routers are left out: they have no node, so no policy has their enclave. Processes
        that were first seen in their enclave are left out, too: their enclave was added by hand,
        not observed.
        """
        nodes = {
            process.enclave
            for process in self.processes
            if not process.is_router and process.known_by != "enclave"
        }
        return sorted(nodes.difference(enclave.path for enclave in policy.enclaves))

    def command_of_new_process(self, export: Path, enclave: str) -> str:
        """Return a shell command that starts a new process, written as COMMAND, in an enclave."""
        rmw = next((process.rmw for process in self.processes if process.rmw), "")
        return f"{shlex.join(run_words(export, enclave, rmw))} COMMAND"

    def start_enclave(self, process: ClosedProcess) -> str:
        """Return the enclave in which the command of a process has to be started.

        This enclave differs from the enclave of the process if the program itself chooses the
        enclave in which its process runs.
        """
        enclaves = {process.enclave, *process.shares}
        return min(
            (other.chooses, other.enclave) for other in self.processes if other.enclave in enclaves
        )[1]

    def commands_by_hand(self, folder: Path) -> Mapping[str, Sequence[ClosedProcess]]:
        """Map shell commands to the processes that they start, without those of `units`.

        A Zenoh router comes first: nodes wait for it.
        """
        launches = {
            tuple(process.launch): process.enclave
            for process in self.processes
            if process.is_launch
        }
        commands: dict[str, list[ClosedProcess]] = {}
        for process in sorted(self.processes, key=lambda process: process.enclave != ROUTER):
            if process.is_by_hand and process.unit:
                command = f"sudo systemctl restart {shlex.quote(process.unit)}"
                commands[command] = [process]
            elif process.is_by_hand:
                started = process._replace(enclave=self.start_enclave(process))
                command = started.secured_command(folder, launches.get(tuple(process.launch), ""))
                commands.setdefault(command, []).append(process)
        return commands


def is_in_domain(process: Process, domain: int) -> bool:
    """Return whether a process may be in a ROS domain, in the network in which sros runs."""
    # If the variable has no number, rcl refuses it, but a program without rcl may use any domain.
    may_be_in = process.domain == str(domain) or not process.domain.isdecimal()
    return may_be_in and not process.network


def process_text(process: Process) -> str:
    """Return the label of a process with its command."""
    return f"{process.label}: {shlex.join(process.command)}"


def read_processes(path: Path) -> ObservedProcesses:
    """Return the processes in a file that `assign` filled.

    Raises:
        DocumentError: The file cannot be read.
    """
    return read_document(
        path, _observed_from, "a list of processes", "Remove it, to watch the robot again."
    )


_Value = TypeVar("_Value")


def read_document(path: Path, parse: Callable[[Any], _Value], kind: str, remedy: str) -> _Value:
    """Read a JSON file of a robot's folder; return the result of ``parse`` for its value.

    Raises:
        DocumentError: The file cannot be read, or is not ``kind``, such as "an observation".
    """
    try:
        return parse(parse_json(read_bytes(path, kind.partition(" ")[2])))
    except (ValueError, TypeError, KeyError) as error:
        raise DocumentError(f"'{path}' is not {kind}", f"{error}", remedy) from error


def _observed_from(value: Any) -> ObservedProcesses:
    """Return the processes in a JSON value.

    Raises:
        ValueError, TypeError, KeyError: the value has another form.
    """
    processes = [ClosedProcess(**process) for process in value["processes"]]
    moved = [ClosedProcess(**process) for process in value.get("moved", ())]
    observed = ObservedProcesses(**value)._replace(processes=processes, moved=moved)
    observed = observed._replace(brought=dict(observed.brought))
    names = (*observed.unknown, *observed.elsewhere, *observed.ended, *observed.not_here)
    _check_types((*names, *observed.brought.values()), (observed.domain,))
    for process in (*processes, *moved):
        words = (process.enclave, process.folder, process.container, process.rmw)
        texts = (*words, *process.command, *process.launch, *process.shares, process.started)
        _check_types((*texts, process.known_by), (process.pid, process.user, *process.alike))
        if process.unit and not re.fullmatch(SERVICE_NAME, process.unit, re.A):
            raise ValueError(f"{process.unit!r} is not a service")
    return observed


def _check_types(texts: Sequence[object], numbers: Sequence[object]) -> None:
    if not all(isinstance(text, str) for text in texts):
        raise ValueError(f"{texts} are not all text")
    if not all(isinstance(number, int) for number in numbers):
        raise ValueError(f"{numbers} are not all numbers")
