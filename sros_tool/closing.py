"""Close an open robot: the steps, what each process needs, the proof, and the way back.

A process of Fast DDS shows its process id in the identifier of its DDS participant (two bytes of
the GUID prefix; Fast DDS 2.6 to 3.6, ``GuidUtils.hpp``), and a process of Cyclone DDS states it in
a property of its participant (``__Pid``; Cyclone DDS 0.10 to 11.0).  Other processes are known by
the name that their command gives the node, or by the name of their program.  A wrong guess is safe:
the middleware denies the process what its enclave may not do.

The steps are verbs of sros, which the caller runs (`Shell`); nothing is printed here.
"""

from __future__ import annotations

import json
import os
import re
import shlex
import shutil
import stat
import subprocess
import sys
import threading
import time
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext, suppress
from dataclasses import replace
from datetime import datetime, tzinfo
from itertools import chain
from pathlib import Path
from typing import Annotated, Any, NamedTuple

from sros_tool.checks.environment import secured_by
from sros_tool.checks.keystores.issued import STALE
from sros_tool.checks.kind import NOTE
from sros_tool.checks.processes import PROCESS_NOT_SEEN, newer_files, process_findings
from sros_tool.checks.requirements import VIOLATED
from sros_tool.enclave_environment import loadable_environment
from sros_tool.errors import DocumentError, SrosError, UnavailableError, UsageError
from sros_tool.explain.audit import DeniedRight, audit, audited_enclaves
from sros_tool.explain.explanation import likely_meaning
from sros_tool.files import policies_dir, remove_file, replace_file
from sros_tool.folders import Folder, make_folders, remove_folders
from sros_tool.graph.learn import common_parts, is_tool, stable_name
from sros_tool.graph.observation import (
    PUBLISH,
    SUBSCRIBE,
    Endpoint,
    Observation,
    ObservedNode,
    make_observation,
    observation_from_json,
)
from sros_tool.keystore.layout import (
    CLOSED_OBSERVER,
    CLOSED_POLICY,
    CLOSED_PROCESSES,
    KEY_FILE,
    KEY_FILES,
    enclave_folder,
    enclave_path,
    list_enclaves,
)
from sros_tool.keystore.participant import JoinContext
from sros_tool.keystore.reader import FilesReadOnce, OpenedKeystore, open_enclave
from sros_tool.keystore.selection import revocation_of
from sros_tool.keystore.template import load_template
from sros_tool.names import expand, is_expression, right_to_use
from sros_tool.owners import other_writers, replaceable_on_the_way
from sros_tool.policy.document import read_policy
from sros_tool.policy.merge import merge_into
from sros_tool.policy.model import ALLOW, DENY, RIGHTS, Policy
from sros_tool.policy.patterns import overlap
from sros_tool.policy.rights import Right, Rules, policy_rights
from sros_tool.proof.findings import decide_all
from sros_tool.proof.requirements import Requirement, read_requirements
from sros_tool.proof.system import policy_system
from sros_tool.runtime.environment import (
    COMPOSE,
    RMW_ZENOH,
    ROS_ARGS,
    Container,
    named_enclave,
    node_argument,
    object_name,
    render_container,
    render_environment,
)
from sros_tool.runtime.processes import (
    SERVICE_NAME,
    Process,
    ProcessEnclave,
    ProcessOrigin,
    ProcessTable,
    RunningProcesses,
    launch_verb,
    plain,
    process_origin,
    program_of,
)
from sros_tool.runtime.rmw import (
    RMW,
    built_without_security,
    chosen_vendor,
    rmw_implementations,
)
from sros_tool.runtime.units import unit_changes, unit_instance, unit_words, write_units
from sros_tool.runtime.variables import DOMAIN, ENCLAVE, KEYSTORE, STRATEGY, domain_of
from sros_tool.values import DryRun, FileChange, FileChanges, Words, as_plain, shows
from sros_tool.wording import counted, enumerated, first_few
from sros_tool.xml import read_bytes

_FAST_DDS = "010f"
"""The first two bytes of a participant of Fast DDS: its vendor id (RTPS 2.3, 9.4.5.1)."""
_NODE_PARTS = ("common/node.xml", "common/rclcpp_node.xml", "common/rclpy_node.xml")
_MOST_LINES, _MOST_NAMES, _LONGEST_PATH = 20, 3, 300
_SYSTEMD = Path("/etc/systemd/system")
_REQUIREMENTS, _TEMPLATE = "requirements.toml", "production"
_OBSERVER, _ROUTER = CLOSED_OBSERVER, "/router"
_DROP_IN, COMMANDS, _SERVICES = "sros-close.conf", "commands.txt", "compose.yaml"
_RESTART_SECONDS, _START_SECONDS = 30.0, 3.0
"""How long processes may take until they run in their enclaves: restarted by sros, or by hand."""
_TRIES = 3
_LOOK_SECONDS = 1.0
"""How often processes are looked at while the robot is watched; shorter ones can be missed."""
_MOST_SEEN = 10_000
"""Number of commands of processes that are kept; of others, the start command is not known."""


class Shell(NamedTuple):
    """What closing a robot needs of the command line.

    ``run`` runs a verb of sros, and returns its status, its output and its messages, unless its
    second argument lets it show these itself.  ``say`` shows progress.
    """

    run: Callable[[Sequence[str], bool], tuple[int, str, str]]
    say: Callable[[str], None]
    environment: Mapping[str, str]
    now: Callable[[], datetime]
    zone: tzinfo


# ── values ──────────────────────────────────────────────────────────────────────────────────


class ClosedProcess(NamedTuple):
    """A process of the robot, and the enclave in which it has to run."""

    enclave: str
    """The enclave of the process."""
    pid: int
    """Its id; 0 if it ended while sros watched, or is restarted by hand, and no process with its
    command runs any more."""
    command: Sequence[str]
    """Its command with the arguments."""
    folder: str
    """Its working directory."""
    user: int
    """The id of the user who runs it."""
    unit: str
    """The systemd unit that starts it alone; empty for a process that is restarted by hand."""
    known_by: Annotated[
        str, Words(("process id", "node name", "program", "elimination", "enclave"))
    ]
    """How sros knows that this process has the nodes of the enclave."""
    launch: Sequence[str] = ()
    """The command of the `ros2 launch` that started it; empty for a process of its own."""
    container: str = ""
    """The id of the Docker container in which it runs; empty outside of containers."""
    rmw: str = ""
    """rmw_zenoh_cpp for a process on Zenoh; empty on DDS."""
    shares: Sequence[str] = ()
    """The other enclaves whose processes the same command starts, as `multiprocessing` does."""
    chooses: bool = False
    """Whether the program itself gives the process its enclave, by ROS_SECURITY_ENCLAVE_OVERRIDE.
    """

    @classmethod
    def of(
        cls, process: Process, enclave: str, origin: ProcessOrigin, known_by: str
    ) -> ClosedProcess:
        """Return a running process with its enclave and what started it."""
        start = enclave, *process.program, origin.folder, process.user, origin.unit
        rmw = RMW_ZENOH if process.is_zenoh else ""
        chooses = process.environment.get(ENCLAVE) == enclave
        return cls(*start, known_by, origin.launch, origin.container, rmw, (), chooses)

    def as_it_runs(self, running: RunningProcesses) -> ClosedProcess:
        """Return a copy with the id that a process with this command has now.

        The command may have the argument for the enclave that ``sros run`` adds.  A process that
        may run, but could not be examined, keeps its id, and so does a process that its unit
        restarts; a process that ended while sros watched has none.
        """
        own = _without_enclave_argument(self.command, self.enclave)
        programs = [process.program for process in running.processes]
        pids = [
            pid for pid, words in programs if _without_enclave_argument(words, self.enclave) == own
        ]
        unseen = {process.pid for process in running.unseen}
        if (self.unit and self.pid) or running.hidden or self.pid in unseen or self.pid in pids:
            return self
        return self._replace(pid=pids[0] if pids else 0)

    def open_command(self, domain: int) -> str:
        """Return the shell command that starts the process open, in its ROS domain and RMW."""
        if self.container:
            return "docker compose up -d"
        variables = [f"{DOMAIN}={domain}"] * bool(domain) + [f"{RMW}={self.rmw}"] * bool(self.rmw)
        words = (*(("env", *variables) if variables else ()), *(self.launch or self.command))
        return f"cd {shlex.quote(self.folder)} && {shlex.join(words)}"

    def secured_command(self, folder: Path, of_launch: str = "") -> str:
        """Return the shell command that starts the process, its launch or containers with security.

        ``folder`` is the folder of the closed robot, and ``of_launch`` the enclave of the node of
        `ros2 launch` itself.
        """
        if self.container:
            overlay = shlex.quote(str(folder / "start" / _SERVICES))
            return f"docker compose -f compose.yaml -f {overlay} up -d"
        words = self.command
        if self.launch:
            after = launch_verb(self.launch) + 1
            words = _launch_words(folder, self.launch[:after], self.launch[after:])
        elif _needs_enclave_argument(self):
            words = (*words, ROS_ARGS, "--enclave", self.enclave)
        enclave = of_launch if self.launch else self.enclave
        if enclave:
            words = (*_run_words(folder / "export", enclave, self.rmw), *words)
        elif self.rmw:
            words = ("env", f"{RMW}={self.rmw}", *words)
        return f"cd {shlex.quote(self.folder)} && {shlex.join(words)}"


def _without_enclave_argument(command: Sequence[str], enclave: str) -> Sequence[str]:
    """Return a command without the argument for its enclave that ``sros run`` adds at its end."""
    words = tuple(command)
    return words[:-3] if words[-3:] == (ROS_ARGS, "--enclave", enclave) else words


def _run_words(export: Path, enclave: str, rmw: str) -> Sequence[str]:
    """Return the words before a command that start it in an enclave; ``rmw`` is "" on DDS."""
    return ("sros", "run", str(export), enclave, *(("--rmw", rmw) if rmw else ()), "--")


def _launch_words(folder: Path, before: Sequence[str], after: Sequence[str]) -> Sequence[str]:
    """Return a command of ``ros2 launch`` whose processes run in the enclaves of a closed robot."""
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
    """Enclaves that belong to other machines: those of `--elsewhere`."""

    @property
    def units(self) -> dict[str, str]:
        """The systemd units that start a process alone, by its enclave."""
        return {process.enclave: process.unit for process in self.processes if process.unit}

    def as_they_run(self, running: RunningProcesses) -> ObservedProcesses:
        """Return a copy with the current ids and the current unknown processes."""
        pids = {process.pid for process in self.processes}
        commands = {tuple(process.command) for process in self.processes}
        unknown = [
            _process_text(process)
            for process in running.processes
            if _is_in_domain(process, self.domain)
            and not (process.is_daemon or process.asks_for_security)
            and process.program[0] not in pids
            and process.program[1] not in commands
        ]
        processes = [process.as_it_runs(running) for process in self.processes]
        return self._replace(processes=processes, unknown=unknown)

    def belonging_elsewhere(self, names: Iterable[str]) -> ObservedProcesses:
        """Return a copy in which the enclaves ``names`` belong to other machines."""
        not_here = {*self.not_here, *names}
        return self._replace(
            processes=[process for process in self.processes if process.enclave not in not_here],
            elsewhere=[enclave for enclave in self.elsewhere if enclave not in not_here],
            not_here=sorted(not_here),
        )

    def within(self, policy: Policy) -> ObservedProcesses:
        """Return a copy without enclaves that the policy does not have any more."""
        names = {_ROUTER, *(enclave.path for enclave in policy.enclaves)}
        return self._replace(
            processes=[
                process._replace(shares=sorted(names.intersection(process.shares)))
                for process in self.processes
                if process.enclave in names
            ],
            elsewhere=[enclave for enclave in self.elsewhere if enclave in names],
        )

    def command_of_new(self, export: Path, enclave: str) -> str:
        """Return the shell command for a process of an enclave of which none was observed."""
        rmw = next((process.rmw for process in self.processes if process.rmw), "")
        return f"{shlex.join(_run_words(export, enclave, rmw))} COMMAND"

    def started_in(self, process: ClosedProcess) -> str:
        """Return the enclave in which the command of a process is started.

        It differs from the enclave of the process if the program itself chooses that enclave.
        """
        names = {process.enclave, *process.shares}
        program = (other for other in self.processes if other.enclave in names)
        return min((part.chooses, part.enclave) for part in program)[1]

    def commands_by_hand(self, folder: Path) -> Mapping[str, Sequence[ClosedProcess]]:
        """Map shell commands to the processes that they start and that no unit starts alone.

        A Zenoh router comes first: nodes wait for it.
        """
        launches = {
            tuple(process.launch): process.enclave
            for process in self.processes
            if launch_verb(process.command)
        }
        commands: dict[str, list[ClosedProcess]] = {}
        for process in sorted(self.processes, key=lambda process: process.enclave != _ROUTER):
            if not process.unit:
                first = process._replace(enclave=self.started_in(process))
                command = first.secured_command(folder, launches.get(tuple(process.launch), ""))
                commands.setdefault(command, []).append(process)
        return commands


class CloseStep(NamedTuple):
    """A step of closing a robot."""

    command: str
    """The command line that does the same."""
    state: Annotated[str, Words(("done", "kept", "findings", "open"))]
    """Whether the step was done now, was kept because its result existed, found something, or
    is not done."""


class Proof(NamedTuple):
    """A claim about the closed robot."""

    claim: str
    """What has to hold."""
    holds: bool | None
    """Whether the claim holds; null if it could not be tested."""
    reason: str
    """What was seen, or why the claim could not be tested."""

    @property
    def fails(self) -> bool:
        """Whether the claim was tested, and does not hold."""
        return self.holds is False

    @property
    def may_be_left_out(self) -> bool:
        """Whether ``--partial`` accepts the claim: not without an observer that hears the robot."""
        return self.holds is None and self.claim not in (_TALK, _SILENCE)


@shows(spread=("observed",))
class Closing(NamedTuple):
    """How far a robot is closed."""

    folder: Path
    """The folder with everything that was made."""
    observed: ObservedProcesses
    steps: Sequence[CloseStep]
    """The steps in their order."""
    secured: Mapping[str, bool]
    """The enclaves in which a process of the robot runs now, and whether with the current files;
    otherwise it has to be restarted."""
    new: Sequence[str]
    """The enclaves of the policy without a process: none was observed, and none runs now."""
    without: Sequence[str]
    """The enclaves of `--without`, of which no process has to run."""
    valid_until: datetime | None
    """When the first enclave of the export expires, in UTC; null without an export."""
    denied: Sequence[str]
    """What the observed nodes do although the keystore denies it, as sentences."""
    newly_denied: Sequence[str]
    """The part of `denied` that the keystore did not deny before this command."""
    problems: Sequence[str]
    """Reasons why the robot is not closed yet, or not open again, with what to do."""
    proofs: Sequence[Proof]
    """The proof that the robot is closed; empty before."""
    dry_run: DryRun
    changes: FileChanges

    def is_proved(self, *, partial: bool) -> bool:
        """Return whether the proof holds; ``partial`` accepts what could not be examined."""
        claims = [proof.holds or (partial and proof.may_be_left_out) for proof in self.proofs]
        return bool(claims) and all(claims)

    @property
    def is_signed(self) -> bool:
        """Whether the steps came to the end, so that the policy is what is signed."""
        return all(step.state != "open" for step in self.steps)

    @property
    def left(self) -> Sequence[str]:
        """The enclaves that should have a process with the current files, and have none."""
        names = {process.enclave for process in self.observed.processes} | {*self.new}
        names = names.difference(self.without) | self.secured.keys()
        return sorted(name for name in names if not self.secured.get(name))

    @property
    def stopped(self) -> set[str]:
        """The enclaves of which no process runs, open or closed."""
        stopped = {process.enclave for process in self.observed.processes if not process.pid}
        return {*self.new, *stopped} - self.secured.keys()

    @property
    def left_by_hand(self) -> Mapping[str, Sequence[ClosedProcess]]:
        """The commands to run by hand for the enclaves in ``left``, with their processes."""
        by_hand = self.observed.commands_by_hand(self.folder.absolute())
        return {
            command: processes
            for command, processes in by_hand.items()
            if any(process.enclave in self.left for process in processes)
        }


# ── processes ───────────────────────────────────────────────────────────────────────────────


def assign(
    nodes: Iterable[ObservedNode],
    running: Iterable[Process],
    domain: int,
    process_ids: Mapping[str, int] | None = None,
    origins: Mapping[int, ProcessOrigin] | None = None,
) -> ObservedProcesses:
    """Return the enclave of each process, by the nodes that the graph shows of it.

    Processes of other domains or networks are left out.  ``process_ids`` maps participants of
    Cyclone DDS to the process ids that they state; ``origins`` has what started each process, and
    None is for processes that run now.
    """
    left = {
        process.pid: process
        for process in running
        if _is_in_domain(process, domain) and not process.is_daemon
    }
    if origins is None:
        origins = {pid: process_origin(pid) for pid in left}
    programs = {process.program[0]: origins[pid].unit for pid, process in left.items()}
    units = Counter(programs.values())
    assigned: list[ClosedProcess] = []

    def assign_enclave(process: Process, enclave: str, known_by: str) -> None:
        origin = origins[process.pid]
        del left[process.pid]
        unit = origin.unit if units[origin.unit] == 1 else ""
        assigned.append(ClosedProcess.of(process, enclave, origin._replace(unit=unit), known_by))

    for router in [process for process in left.values() if process.is_router]:
        assign_enclave(router, _ROUTER, "program")
    by_enclave: dict[str, list[ObservedNode]] = {}
    for node in nodes:
        by_enclave.setdefault(node.enclaves[0], []).append(node)
    for known_by, shows_node in _KNOWN_BY.items():
        without = sorted(by_enclave.keys() - {process.enclave for process in assigned})
        if known_by == "elimination" and len(without) > 1:
            continue
        for enclave in without:
            of_enclave = by_enclave[enclave]
            processes = [
                process
                for process in left.values()
                if any(shows_node(process, node, process_ids or {}) for node in of_enclave)
            ]
            if len(processes) <= len({node.participant for node in of_enclave}):
                for process in processes:
                    assign_enclave(process, enclave, known_by)
    of_program: dict[int, set[str]] = {}
    for closed in assigned:
        of_program.setdefault(closed.pid, set()).add(closed.enclave)
    return ObservedProcesses(
        domain,
        sorted(
            closed._replace(shares=sorted(of_program[closed.pid] - {closed.enclave}))
            for closed in assigned
        ),
        [_process_text(process) for process in left.values() if process.pid not in of_program],
        sorted(
            enclave
            for enclave, of_enclave in by_enclave.items()
            if len({_process_of(node) for node in of_enclave})
            > sum(process.enclave == enclave for process in assigned)
        ),
    )


def _is_in_domain(process: Process, domain: int) -> bool:
    # A domain that rcl cannot read can be any for a program without it.
    near = process.domain == str(domain) or not process.domain.isdecimal()
    return near and not process.network


def _process_text(process: Process) -> str:
    return f"{process.label}: {shlex.join(process.command)}"


def _process_of(node: ObservedNode) -> str:
    """Return what the participants of a process have in common: Fast DDS shows host and id."""
    is_fast = node.participant.startswith(_FAST_DDS)
    return node.participant[:12] if is_fast else node.participant


def _shows_its_id(process: Process, node: ObservedNode, process_ids: Mapping[str, int]) -> bool:
    if not node.participant.startswith(_FAST_DDS):
        return process_ids.get(node.participant) == process.pid
    low, high = process.pid & 0xFF, process.pid >> 8 & 0xFF
    is_fast = bool(process.libraries & {"libfastrtps", "libfastdds"})
    return is_fast and node.participant[8:12] == f"{low:02x}{high:02x}"


def _is_named(process: Process, node: ObservedNode, _process_ids: object) -> bool:
    return node_argument(process.command) == (node.ns, node.name)


def _has_program_named_alike(process: Process, node: ObservedNode, _process_ids: object) -> bool:
    return program_of(process.command).removesuffix(".py") == node.name


_KNOWN_BY: dict[str, Callable[[Process, ObservedNode, Mapping[str, int]], bool]] = {
    "process id": _shows_its_id,
    "node name": _is_named,
    "program": _has_program_named_alike,
    "elimination": lambda _process, _node, _process_ids: True,
}


def _process_ids_of_cyclone(pids: Sequence[int], domain: int) -> Mapping[str, int]:
    """Return process ids as Cyclone DDS participants state them; none if it cannot be loaded."""
    if not pids:
        return {}
    asking = [sys.executable, "-P", "-m", "sros_tool.runtime.cyclone", f"{domain}", *map(str, pids)]
    with suppress(ValueError, subprocess.TimeoutExpired):
        ended = subprocess.run(asking, capture_output=True, check=False, timeout=_RESTART_SECONDS)
        value: Mapping[str, int] = json.loads(ended.stdout)
        return value
    return {}


def read_processes(path: Path) -> ObservedProcesses:
    """Return the processes in a file that `assign` filled.

    Raises:
        DocumentError: The file cannot be read.
    """
    try:
        value = json.loads(read_bytes(path, "list of processes"))
        processes = [ClosedProcess(**process) for process in value["processes"]]
        if not all(isinstance(name, str) for name in value.get("not_here", ())):
            raise ValueError(f"{value['not_here']} are not all text")
        for process in processes:
            words = (process.enclave, process.folder, process.container, process.rmw)
            texts = (*words, *process.command, *process.launch, *process.shares)
            if not all(isinstance(text, str) for text in texts):
                raise ValueError(f"{texts} are not all text")
            if process.unit and not re.fullmatch(SERVICE_NAME, process.unit, re.A):
                raise ValueError(f"{process.unit!r} is not a service")
        return ObservedProcesses(**value)._replace(processes=processes)
    except (ValueError, TypeError, KeyError) as error:
        raise DocumentError(
            f"'{path}' is not a list of processes",
            f"{error}",
            "Remove it, to watch the robot again.",
        ) from error


# ── who may do what ─────────────────────────────────────────────────────────────────────────


def access_lines(policy: Policy, folder: Path) -> list[str]:
    """Return a line for each name in a policy, with who may use it on either side.

    Names that are used only as every node uses them (the common parts) are left out.
    """
    common = common_parts(folder, policies_dir())
    parts = [part for part in _NODE_PARTS if part in common.rights]
    ordinary = {
        (enclave.path, right.right, right.name)
        for enclave in policy.enclaves
        for profile in enclave.all_profiles()
        for right in common.included_rights(parts, profile.ns, profile.node)
    }
    rights = policy_rights(policy)
    rules, enclaves = Rules(rights), sorted({right.enclave for right in rights})
    shown = {
        (right.kind, right.name)
        for right in rights
        if right.kind in RIGHTS
        and right.qualifier is ALLOW
        and (right.enclave, right.right, right.name) not in ordinary
    }
    stated = {right for right in rights if right.qualifier is ALLOW and is_expression(right.name)}

    def may(enclave: str, right: str, name: str) -> bool:
        if rules.allow(enclave, right, name):
            return True
        # A denial of some of the names leaves the others.
        is_stated = Right(enclave, ALLOW, right, name) in stated
        return is_stated and not rules.cover(Right(enclave, DENY, right, name))

    sides = {
        (kind, name): [
            [enclave for enclave in enclaves if may(enclave, right, name)] for right in RIGHTS[kind]
        ]
        for kind, name in shown
    }
    kinds = [*RIGHTS]
    in_order = sorted(
        sides, key=lambda named: (not all(sides[named]), kinds.index(named[0]), named[1])
    )
    lines = [
        f"{kind.removesuffix('s')} {name}: "
        + " -> ".join(first_few(of, _MOST_NAMES) or "nobody" for of in sides[kind, name])
        for kind, name in in_order
    ]
    more = len(lines) - _MOST_LINES
    return [*lines[:_MOST_LINES], *([f"and {counted(more, 'more name')}"] if more > 0 else [])]


def requirements_broken_by(robot: Path, addition: str, moment: datetime) -> list[Requirement]:
    """Return the requirements in the folder of a closed robot that more rights would break.

    ``addition`` is the policy document with these rights.  None if the folder has no requirements,
    or the policy with the addition cannot be decided.
    """
    file, path = robot / _REQUIREMENTS, robot / CLOSED_POLICY
    if not file.exists():
        return []
    try:
        needed, template = read_requirements(file), load_template(_TEMPLATE)
        merged = merge_into(path, read_policy(path, addition.encode())).document

        def broken_requirements(policy: Policy) -> dict[Requirement, None]:
            decided = decide_all(needed, policy_system(policy, moment=moment, template=template))
            return dict.fromkeys(violation.requirement for violation in decided.violations)

        if after := broken_requirements(read_policy(path, merged)):
            before = broken_requirements(read_policy(path))
            return [requirement for requirement in after if requirement not in before]
    except SrosError:
        pass
    return []


# ── the steps ───────────────────────────────────────────────────────────────────────────────


class _Step(NamedTuple):
    """The words of a command line of sros, what it makes, and where its output goes."""

    words: Sequence[str]
    made: Path | None = None
    into: Path | None = None
    guards: bool = False
    """Whether the later steps are left out if this step finds something."""
    signs: bool = False
    """Whether the step changes rights, and says which on standard error."""

    @property
    def command(self) -> str:
        redirected = f" > {shlex.quote(str(self.into))}" if self.into else ""
        return f"sros {shlex.join(self.words)}{redirected}"


class OpenRobot:
    """A robot that is being closed into a folder.

    Raises:
        SrosError: others can change what is in the folder, which says what systemd starts, or a
            file in it is broken.
    """

    def __init__(
        self,
        folder: Path,
        domain: int | None,
        shell: Shell,
        without: Iterable[str] = (),
        elsewhere: Iterable[str] = (),
    ) -> None:
        self.folder, self._shell, self._without = folder, shell, sorted({*without})
        self._named_elsewhere = sorted({*elsewhere})
        self._close = f"sros close {shlex.quote(str(folder))}"
        self.policy, self.observer = folder / CLOSED_POLICY, folder / "observer.xml"
        self.requirements = folder / _REQUIREMENTS
        self.keystore, self.export = folder / "keystore", folder / "export"
        self.start, self.page = folder / "start", folder / "rights.html"
        self.seen, self.processes = folder / "observed.json", folder / CLOSED_PROCESSES
        self.seen_again = folder / "seen.xml"
        self._check_own()
        self.observed = read_processes(self.processes) if self.processes.exists() else None
        named = domain_of(shell.environment) if domain is None else domain
        known = self.observed.domain if self.observed else named
        if domain not in (None, known):
            raise UsageError(
                f"the robot was watched in domain {known}, not {domain}",
                "",
                "Close each domain into a folder of its own.",
            )
        self.domain = known

    def _check_own(self) -> None:
        """Raise `SrosError` if others can change what is in the folder.

        Whoever runs sros by sudo is trusted, as root is.
        """
        sudo = self._shell.environment.get("SUDO_UID", "") if os.geteuid() == 0 else ""
        trusted = frozenset({0, os.geteuid(), *([int(sudo)] if sudo.isdecimal() else [])})
        files = (self.policy, self.seen, self.processes)
        for path in (self.folder, self.start, self.start / "units", *files):
            ways = [*replaceable_on_the_way(path, trusted)]
            if path.exists() and (why := other_writers(path.stat(), trusted)):
                ways.insert(0, (path, why))
            for step, why in ways:
                raise SrosError(
                    f"others can change '{path}'",
                    f"'{step}': {why}.",
                    "Close the robot into a folder that only you and root can change.",
                )

    @property
    def _not_here(self) -> set[str]:
        """The enclaves that belong to other machines."""
        return {*self._named_elsewhere, *(self.observed.not_here if self.observed else ())}

    def _to_export(self) -> Sequence[str]:
        """Return the words that select the enclaves of this machine."""
        if not self._not_here:
            return ("--all",)
        names = {_OBSERVER, *(list_enclaves(self.keystore) if self.keystore.exists() else ())}
        if self.policy.exists():
            names |= {enclave.path for enclave in read_policy(self.policy).enclaves}
        return sorted(names - self._not_here)

    def steps(self, duration: str | None) -> Iterator[_Step]:
        """Yield the steps; with a ``duration``, the robot is watched even if it was before.

        The enclaves to export are known when the steps before are done.
        """
        policy, keystore, needed = str(self.policy), str(self.keystore), str(self.requirements)
        domain = ("--domain", str(self.domain))
        learn = ["generate_policy", policy, "--enclave-per-node", *domain]
        learn += ["--watch", duration] if duration else []
        learn += ["--dry-run"] if self.policy.exists() else []  # it may have been edited
        only_errors = ("--fail-on", "error")
        both, created = ("-p", policy, str(self.observer)), ("--template", _TEMPLATE)
        on_zenoh = self._shell.environment.get(RMW) == RMW_ZENOH
        watched = self.policy.exists() and not duration
        yield _Step((*learn, "--json"), self.processes if watched else None, self.seen)
        yield _Step(("check", policy, "--suggest"), self.requirements, self.requirements)
        yield _Step(
            ("check", policy, "--requirements", needed, *created, *only_errors), guards=True
        )
        yield _Step(("create_keystore", keystore, *created, *domain), self.keystore)
        yield _Step(("generate_artifacts", "-k", keystore, *both), signs=True)
        if on_zenoh:
            yield _Step(("zenoh", keystore))
        exported = *self._to_export(), str(self.export)
        yield _Step(("distribute_key", keystore, *exported, "--force"))
        yield _Step(("check", policy, keystore, "--policy", policy, *only_errors))
        yield _Step(("view", policy, *created, "-o", str(self.page), "--force"))

    def prepare(self, duration: str | None, *, partial: bool, dry_run: bool) -> Closing:
        """Do the steps whose results are not there yet, and write how each process is started.

        Raises:
            SrosError: the robot cannot be watched, or the keystore was brought to another machine.
        """
        if self.export.exists() and not self.keystore.exists():
            raise UsageError(
                f"the keystore '{self.keystore}' is not there, and '{self.export}' was exported "
                "from it",
                "A new keystore would have other CAs.",
                "Bring the keystore back to change the robot; --proof and --undo need only the "
                "export.",
            )
        own = (self.seen, self.policy, self.keystore, self.export)
        if self.folder.is_dir() and [*self.folder.iterdir()] and not any(map(Path.exists, own)):
            self._shell.say(f"'{self.folder}' has files of yours: sros adds its own to them")
        if self.observed and self._named_elsewhere:
            self._check_elsewhere()
            self.observed = self.observed.belonging_elsewhere(self._named_elsewhere)
            if not dry_run:
                self._write_processes(self.observed)
        denied_before: Sequence[str] = ()
        with suppress(SrosError):  # the steps say what is wrong
            denied_before = (
                self._denied_access_texts() if self.export.exists() and self.seen.exists() else ()
            )
        steps, problems, is_stopped = [], [], False
        for step in self.steps(duration):
            state = "kept" if step.made and step.made.exists() else "open"
            if dry_run:
                self._shell.say(f"{'kept' if state == 'kept' else 'would run'}: {step.command}")
                if step.signs and self.keystore.exists():
                    _, output, messages = self._shell.run((*step.words, "--dry-run"), False)
                    self._say(messages if output else "")
            elif state == "open" and not is_stopped:
                state, problem = self._do(step)
                problems += [problem] if problem else []
                is_stopped = step.guards and state == "findings"
            steps.append(CloseStep(step.command, state))
            if step.into == self.seen and not dry_run:
                mixed = [
                    *self._shared_program_texts(),
                    *(() if partial else self._shared_node_texts()),
                ]
                problems, is_stopped = [*problems, *mixed], bool(mixed)
        changes = [] if dry_run or is_stopped else self._remove_enclaves()
        closing = self._closing()._replace(steps=steps, dry_run=dry_run)
        if dry_run or is_stopped:
            return closing._replace(problems=problems)
        if self.observed:
            known = {process.enclave for process in self.observed.processes}
            later = [
                process for process in closing.observed.processes if process.enclave not in known
            ]
            if later:
                processes = [*self.observed.processes, *later]
                self._write_processes(self.observed._replace(processes=processes))
        changes = [*self._write_starts(closing), *changes]
        denied = self._denied_access_texts()
        newly = [right for right in denied if right not in denied_before]
        problems += self._problems(closing, partial=partial)
        if not closing.secured:
            self._warn_of_rmw()
        return closing._replace(
            denied=denied, newly_denied=newly, problems=problems, changes=changes
        )

    def _warn_of_rmw(self) -> None:
        """Say so if nodes on the RMW of this shell cannot run secured."""
        environment = self._shell.environment
        rmw = environment.get(RMW) or next(iter(rmw_implementations(environment)), "")
        if built_without_security(rmw, environment):
            self._shell.say(
                f"WARNING: {rmw} is built without security here: no node starts in an enclave "
                "with it. Before you stop the robot, find an RMW that enforces security: "
                "sros doctor"
            )

    def _closing(self) -> Closing:
        """Return the processes of the enclaves that the policy has, as they run now."""
        running = ProcessTable().look(self._shell.now())
        observed, new = ObservedProcesses(self.domain), set[str]()
        present = self._enclaves_with_process(running)
        names = {enclave.name for _, enclave in self._secured(running)} - {_OBSERVER}
        secured = {name: name in present for name in sorted(names)}
        if self.observed:
            observed = self._with_later(self.observed, running).as_they_run(running)
        if self.policy.exists():
            policy = read_policy(self.policy)
            observed = observed.within(policy)
            known = {process.enclave for process in observed.processes} | names
            new = {enclave.path for enclave in policy.enclaves} - known - {*observed.elsewhere}
            new -= self._not_here
        new -= {_OBSERVER} if self.observed else new
        until = self._valid_until()
        known = {process.enclave for process in observed.processes} | new | secured.keys()
        self._check_named(self._without, known | self._not_here, "--without")
        started = observed, (), secured, sorted(new), self._without, until
        return Closing(self.folder, *started, (), (), (), (), False, ())

    def _check_elsewhere(self) -> None:
        """Raise `UsageError` if neither the policy nor the keystore has an enclave elsewhere."""
        known = {*(list_enclaves(self.keystore) if self.keystore.exists() else ())} - {_OBSERVER}
        if self.policy.exists():
            known |= {enclave.path for enclave in read_policy(self.policy).enclaves}
        self._check_named(self._named_elsewhere, known, "--elsewhere")

    def _check_named(self, names: Iterable[str], known: Collection[str], option: str) -> None:
        if unknown := sorted({*names}.difference(known)):
            raise UsageError(
                f"the robot has no enclave {unknown[0]}",
                f"It has {first_few(sorted(known), _MOST_NAMES)}.",
                f"Correct {option}.",
            )

    def _may_use_files(self, process: Process) -> bool:
        """Return whether a process is of a user who can read the enclaves.

        Another user's process can only claim to run in one.
        """
        return process.user in (0, self.export.stat().st_uid)

    def _with_later(
        self, observed: ObservedProcesses, running: RunningProcesses
    ) -> ObservedProcesses:
        """Return a copy with the processes that were started later, in other enclaves.

        Only processes of users who can read the enclaves count, because sros proposes to run their
        commands.
        """
        known = {_OBSERVER, *observed.not_here}
        known |= {process.enclave for process in observed.processes}
        later = []
        for process, enclave in self._secured(running):
            if enclave.name not in known and self._may_use_files(process):
                later.append(_closed_process(process, enclave.name))
        return observed._replace(processes=[*observed.processes, *later])

    def _valid_until(self) -> datetime | None:
        """Return when the first enclave of the export expires; None if one cannot be read."""
        if not self.export.exists():
            return None
        now, files = self._shell.now(), FilesReadOnce()
        moments = [
            open_enclave(enclave_path(self.export, name), now=now, files=files).valid_until()
            for name in list_enclaves(self.export)
        ]
        return min(filter(None, moments), default=None) if all(moments) else None

    def _do(self, step: _Step) -> tuple[str, str]:
        """Do a step; return its state, and why the robot is not closed yet, or "".

        Raises:
            SrosError: the robot cannot be watched.
        """
        watches = step.into == self.seen
        made: list[Path] = []
        if watches:
            self._check_open()
            made = make_folders(self.folder)
        self._shell.say(f"+ {step.command}")
        meanwhile: _SeenProcesses = {}
        with self._looking(meanwhile) if watches else nullcontext():
            status, output, messages = self._shell.run(step.words, bool(step.into))
        if watches and status:
            remove_folders(made)
            others = self._in_other_domains(ProcessTable().look(self._shell.now()))
            raise UnavailableError(
                f"there is no robot to close: no node was observed in domain {self.domain}",
                f"{others}." if others else "",
                f"{'Otherwise start' if others else 'Start'} the robot open, and run this again.",
            )
        if status or (step.guards and output):
            self._say("" if step.into else f"{output}{messages}")
        elif step.signs and output:
            self._say(messages)
        if status:
            mend = "; nothing was signed" if step.guards else ""
            if VIOLATED.id in output:
                needed = shlex.quote(str(self.requirements))
                mend += f"; if you want the change, edit {needed}, or remove it for new ones"
            return "findings", f"findings of `{step.command}`{mend}"
        if step.into:
            replace_file(step.into, output.encode())
        return "done", self._keep_processes(output, meanwhile) if watches else ""

    @contextmanager
    def _looking(self, seen: _SeenProcesses) -> Iterator[None]:
        """Put into ``seen`` the processes that run in this context, with what started them."""
        table, over = ProcessTable(), threading.Event()

        def look() -> None:
            for process in table.look(self._shell.now()).processes:
                before, origin = seen.get(process.command, (process, None))
                if before.pid != process.pid or origin is None:
                    origin = process_origin(process.pid)
                if process.command in seen or len(seen) < _MOST_SEEN:
                    seen[process.command] = process, origin

        def look_again_and_again() -> None:
            while True:
                with suppress(OSError):  # the next look may succeed
                    look()
                if over.wait(_LOOK_SECONDS):
                    return

        looking = threading.Thread(target=look_again_and_again)
        looking.start()
        try:
            yield
        finally:
            over.set()
            looking.join()

    def _say(self, text: str) -> None:
        for line in text.splitlines():
            self._shell.say(line)

    def _check_shell(self) -> None:
        """Raise `UsageError` if an observer that this shell starts might run secured."""
        if secured := [*secured_by(self._shell.environment, Path.cwd())]:
            raise UsageError(
                f"{' and '.join(secured)}, so this shell does not see an open robot",
                "sros looks for open nodes with an observer that is open itself.",
                "Unset the variables in this message, for example with `env -u NAME sros close "
                "...`; if the message names a file in this folder, run sros in another folder.",
            )

    def _check_open(self) -> None:
        """Raise `SrosError` if the robot cannot be watched as an open one."""
        self._check_shell()
        named = self._shell.environment
        running = ProcessTable().look(self._shell.now())
        if secured := [process.label for process, _ in self._secured(running)]:
            raise UsageError(
                f"the robot runs closed: {first_few(secured, _MOST_NAMES)}",
                "Only an open robot can be watched.",
                f"Go back by `{self._close} --undo` and watch again, "
                f"or add what is missing to '{self.policy}' by hand.",
            )
        for process in running.processes:
            if process.is_zenoh and named.get(RMW) != RMW_ZENOH and self._is_neighbour(process):
                raise UsageError(
                    f"{process.label} speaks Zenoh, but this shell is set up for DDS",
                    "",
                    f"Run `export {RMW}={RMW_ZENOH}`, and this command again.",
                )

    def _is_neighbour(self, process: Process) -> bool:
        return _is_in_domain(process, self.domain)

    def _in_other_domains(self, running: RunningProcesses) -> str:
        """Return the processes of other ROS domains, with the commands that close them, or ""."""
        domains: dict[str, list[str]] = {}
        for process in running.processes:
            if not (self._is_neighbour(process) or process.network or process.is_daemon):
                domains.setdefault(process.domain, []).append(process.label)
        close = "sros close ANOTHER_FOLDER" if self.observed else self._close
        return "; ".join(
            f"in domain {domain}, not {self.domain}, runs {first_few(labels, _MOST_NAMES)}: "
            f"to close it, {close} --domain {domain}"
            for domain, labels in sorted(domains.items())
        )

    def _keep_processes(self, document: str, meanwhile: _SeenProcesses) -> str:
        """Write which process has which nodes, and the policy of the observer.

        ``meanwhile`` are the processes that ran while sros watched.  Return, as a sentence, which
        of the observed rights an earlier policy lacks.
        """
        replace_file(self.observer, (policies_dir() / "observer.xml").read_bytes())
        nodes = [node for node in self._observation(all_nodes=True).nodes if not is_tool(node)]
        table = ProcessTable().look(self._shell.now())
        running = table.processes
        of_cyclone = [process.pid for process in running if "libddsc" in process.libraries]
        process_ids = _process_ids_of_cyclone(of_cyclone, self.domain)
        learned = json.loads(document)
        stayed = [node for node in nodes if node.participant not in learned["ended"]]
        observed = assign(stayed, running, self.domain, process_ids)
        ended = {node.enclaves[0] for node in nodes} - {node.enclaves[0] for node in stayed}
        now = {process.command for process in running}
        of_ended = _ended_processes(
            [node for node in nodes if node.enclaves[0] in ended],
            [meanwhile[command] for command in meanwhile.keys() - now],
            observed,
        )
        processes = [_as_its_unit_starts(process) for process in (*observed.processes, *of_ended)]
        observed = observed._replace(processes=processes, ended=sorted(ended))
        seen_here = {process.enclave for process in processes}
        not_here = (self._not_here - seen_here).union(self._named_elsewhere)
        self._check_elsewhere()
        # What does not run now is still started by its command.
        present = {enclave.path for enclave in read_policy(self.policy).enclaves} - seen_here
        earlier = self.observed.processes if self.observed else ()
        kept = [process for process in earlier if process.enclave in present - not_here]
        observed = observed._replace(processes=[*observed.processes, *kept])
        self._write_processes(observed.belonging_elsewhere(not_here))
        for process in running:
            own = process.environment.keys() - {*self._shell.environment, *_OF_EVERY_SHELL}
            if process.pid in {closed.pid for closed in processes} and own:
                self._shell.say(
                    f"{process.label} has variables that this shell does not have, and that its "
                    f"command in {self.start / COMMANDS} does not set: "
                    f"{first_few(sorted(own), _MOST_NAMES)}"
                )
        number = counted(len(processes), "process", "processes")
        self._shell.say(f"saw {counted(len(nodes), 'node')} in {number} of this machine")
        if others := self._in_other_domains(table):
            self._shell.say(others)
        if os.path.lexists(self.seen_again):  # of an earlier watch
            remove_file(self.seen_again)
        return self._lacking_text(learned["added"], nodes) if learned["dry_run"] else ""

    def _lacking_text(
        self, lacking: Sequence[Mapping[str, str]], nodes: Iterable[ObservedNode]
    ) -> str:
        """Return, as a sentence, which rights of nodes the policy lacks; "" if it lacks none.

        Writes the rights that the nodes use as a policy of its own.
        """
        from sros_tool.graph.learn import draft, learn, write  # only after another watch

        if not lacking:
            return ""
        common = common_parts(self.folder, policies_dir())
        learned = learn(make_observation(nodes), common)
        write(draft(self.seen_again, learned, common))
        used, stated = policy_rights(learned.policy()), policy_rights(read_policy(self.policy))
        rights, meanings = [], []
        for value in lacking:
            right = Right(value["enclave"], ALLOW, value["right"], value["name"])
            rights.append(f"{right.enclave} {right.right} {right.name}")
            named = (
                other
                for other in stated
                if (other.enclave, other.qualifier) == (right.enclave, ALLOW)
                and not is_expression(other.name)
            )
            if meaning := likely_meaning(right, used, named):
                meanings.append(meaning)
        policy, seen = shlex.quote(str(self.policy)), shlex.quote(str(self.seen_again))
        add = f"sros merge_policy {policy} {seen} --in-place"
        first = (
            f"{first_few(meanings, _MOST_NAMES)}; then restart it with that, and watch again: "
            f"{self._close} --for 1m; otherwise, " * bool(meanings)
        )
        return (
            f"'{self.policy}' stays as it is, and lacks {counted(len(rights), 'right')} seen now "
            f"({first_few(rights, _MOST_NAMES)}); {first}if a process should not have them, stop "
            f"it, and run `{self._close}`; if they are right, add them: {add}"
        )

    def _shared_program_texts(self) -> Iterator[str]:
        """Yield a text for each program whose processes would all run in one enclave."""
        observed = (self.observed or ObservedProcesses(self.domain)).within(
            read_policy(self.policy)
        )
        by_program: dict[tuple[str, ...], list[ClosedProcess]] = {}
        for process in observed.processes:
            names = sorted({process.enclave, *process.shares})
            by_program.setdefault(tuple(names), []).append(process)
        for enclaves, processes in by_program.items():
            if len(enclaves) > 1 and sum(not process.chooses for process in processes) > 1:
                yield (
                    f"{shlex.join(processes[0].command)} starts the processes of "
                    f"{enumerated(enclaves)}, and all of them would run in one enclave; nothing "
                    f"was signed; in '{self.policy}', move their profiles into one of these "
                    "enclaves, which then has the rights of all, and remove the other "
                    "enclaves; or let the program start each process with the method spawn after "
                    f"setting {ENCLAVE} in os.environ, and watch again: "
                    f"{self._close} --for 1m"
                )

    def _shared_node_texts(self) -> Iterator[str]:
        """Yield a text for processes with nodes of the same name, which would share an enclave."""
        by_enclave: dict[str, list[ClosedProcess]] = {}
        for process in self.observed.processes if self.observed else ():
            by_enclave.setdefault(process.enclave, []).append(process)
        for enclave, twins in by_enclave.items():
            if len({twin.pid for twin in twins}) > 1:
                commands = [f"process {twin.pid} ({shlex.join(twin.command)})" for twin in twins]
                yield (
                    f"{enumerated(commands)} call themselves {enclave}, and the enclave of this "
                    "name would have the rights of all; nothing was signed; if one is not of the "
                    f"robot, stop it, remove '{self.policy}', and watch again: {self._close} "
                    "--for 1m; if all are, accept it: --partial"
                )

    def _write_processes(self, observed: ObservedProcesses) -> None:
        self.observed = observed
        replace_file(self.processes, f"{json.dumps(as_plain(observed), indent=2)}\n".encode())

    def _observed_nodes(self) -> tuple[ObservedNode, ...]:
        """Return the nodes that were observed, with the enclaves and names that they had then."""
        try:
            return observation_from_json(json.loads(read_bytes(self.seen, "observation"))).nodes
        except (ValueError, TypeError, KeyError) as error:
            raise DocumentError(
                f"'{self.seen}' is not an observation",
                f"{error}",
                "Watch the robot again: --for 1m.",
            ) from error

    def _observation(self, *, all_nodes: bool = False) -> Observation:
        """Return the nodes that were observed, in the enclaves that the policy has now.

        A node whose profile was moved to another enclave is in that one, and a renamed node has its
        new name.  A node without an enclave is left out.  With ``all_nodes``, it stays, and all
        nodes have the names that they had.
        """
        enclaves = read_policy(self.policy).enclaves
        names = {enclave.path for enclave in enclaves}
        moved = {
            (profile.ns, profile.node): (enclave.path,)
            for enclave in enclaves
            for profile in enclave.all_profiles()
        }
        renamed, nodes = {} if all_nodes else self._renamed_nodes(), []
        for node in self._observed_nodes():
            if new := renamed.get(_node_name(node)):
                endpoints = frozenset(self._renamed_endpoints(node, *new).values())
                nodes.append(replace(node, ns=new[0], name=new[1], endpoints=endpoints))
            elif names.issuperset(node.enclaves):
                nodes.append(node)
            elif place := moved.get((node.ns, stable_name(node.name))):
                nodes.append(replace(node, enclaves=place))
            elif all_nodes:
                nodes.append(node)
        return make_observation(nodes)

    def _renamed_nodes(self) -> dict[str, tuple[str, str]]:
        """Map observed nodes to the namespace and name that the policy gives them now.

        A node was renamed if it alone of its enclave has no profile any more, and one profile of
        that enclave alone is for a node that was not observed.
        """
        nodes = self._observed_nodes()
        _, without = self._divide_by_profile(nodes)
        known = {_node_name(node) for node in nodes}
        renamed = {}
        for enclave in read_policy(self.policy).enclaves:
            old = {_node_name(node) for node in without if enclave.path in node.enclaves}
            new = {
                (profile.ns, profile.node)
                for profile in enclave.all_profiles()
                if expand("~", profile.ns, profile.node) not in known
                and not is_expression(f"{profile.ns}{profile.node}")
            }
            if len(old) == len(new) == 1:
                renamed[old.pop()] = new.pop()
        return renamed

    def _renamed_endpoints(
        self, node: ObservedNode, ns: str, name: str
    ) -> dict[Endpoint, Endpoint]:
        """Map the endpoints of an observed node to those that it should have under another name.

        The first possible name that its enclave allows counts; without one, the first.
        """
        possible = {
            endpoint: _possible_endpoints(endpoint, node, ns, name) for endpoint in node.endpoints
        }
        tried = frozenset(chain.from_iterable(possible.values()))
        tried_by = make_observation([replace(node, ns=ns, name=name, endpoints=tried)])
        denied = {
            endpoint for right in self._denied_rights(tried_by) for endpoint in right.endpoints
        }
        return {
            endpoint: next((new for new in names if new not in denied), names[0])
            for endpoint, names in possible.items()
        }

    def _variables(self, enclave: str, rmw: str = "") -> dict[str, str]:
        """Return the environment of an enclave of the export."""
        shell, domain = self._shell, str(self.domain)
        return loadable_environment(
            self.export,
            enclave,
            domain,
            rmw or None,
            environment=shell.environment,
            now=shell.now(),
            zone=shell.zone,
        ).variables

    def _write_starts(self, closing: Closing) -> list[FileChange]:
        """Write the files that start each process with security; return what changed."""
        observed, folder = closing.observed, self.folder.absolute()
        variables = {
            process.enclave: self._variables(process.enclave, process.rmw)
            for process in observed.processes
        }
        files = {
            f"{unit_instance(enclave)}.env": render_environment(of_enclave, "docker")
            for enclave, of_enclave in variables.items()
        }
        services = [
            "# Rename the services to those of your own file; give both files to Docker Compose 2."
        ]
        for process in observed.processes:
            of_enclave = variables[observed.started_in(process)]
            if process.unit:
                text = render_environment(of_enclave, "systemd")
                if _needs_enclave_argument(process):
                    words = (*process.command, ROS_ARGS, "--enclave", process.enclave)
                    text += f"ExecStart=\nExecStart={' '.join(unit_words(words))}\n"
                files[f"units/{process.unit}.d/{_DROP_IN}"] = (
                    f"{self._drop_in_heading()}[Service]\n{text}"
                )
            where = str(folder / "export/enclaves" / process.enclave.strip("/"))
            name = object_name(process.enclave)
            service = render_container(Container(process.enclave, name, of_enclave, where), COMPOSE)
            services += ["services:", *service.splitlines()[1:]][len(services) > 1 :]
        lines = self._command_lines(closing)
        if shutil.which("ros2", path=self._shell.environment.get("PATH")):
            launch = shlex.join(_launch_words(folder, ("ros2", "launch"), ("PACKAGE", "FILE")))
            lines += ["", "# Any launch file; each process needs name= in it.", launch]
        files |= {COMMANDS: _text(lines).lstrip(), _SERVICES: _text(services)}
        changes = unit_changes(self.start, files, force=True)
        write_units(self.start, files, changes)
        written = [FileChange(action, str(self.start / path)) for path, action in changes.items()]
        kept = {self.start / path for path in files}
        keystore = f"{KEYSTORE}={self.export.absolute()}\n".encode()
        left = [
            path
            for path in sorted({*self.start.glob("*.env")} - kept)
            if keystore in read_bytes(path, "environment file")  # written here, for another enclave
        ]
        for path in left:
            remove_file(path)
            self._shell.say(f"removed {path}: it was for an enclave without a known process")
        return [*written, *(FileChange("remove", str(path)) for path in left)]

    def _command_lines(self, closing: Closing) -> list[str]:
        """Return the commands that start processes by hand: first those that are due now."""
        folder, due = self.folder.absolute(), closing.left_by_hand
        commands = closing.observed.commands_by_hand(folder)
        rest = {command: commands[command] for command in commands if command not in due}
        place = "by its command, in the place that starts it today."
        lines = [
            "# Stop all of these processes: secured and open ones do not hear each other. Then",
            f"# start each of them {place}",
        ]
        if closing.secured:
            lines = [f"# Stop each of these processes, and start it {place}"]
        lines = [*lines, *_commands(due)] if due else []
        for name in closing.new:
            start = closing.observed.command_of_new(self.export.absolute(), name)
            why = "has ended" if name in closing.observed.ended else "is new"
            lines += ["", f"# {name} {why}: COMMAND is what starts it", start]
        if rest:
            lines += ["", "# These processes run closed, with the current files."]
        return [*lines, *_commands(rest)]

    def _enclaves_left(self) -> list[str]:
        """Return the enclaves of the export that the keystore does not have any more."""
        return sorted({*list_enclaves(self.export)} - {*list_enclaves(self.keystore)})

    def _remove_enclaves(self) -> list[FileChange]:
        """Remove from the export enclaves that the keystore revoked, or of other machines."""
        keystore = OpenedKeystore(self.keystore)
        left = [name for name in self._enclaves_left() if revocation_of(keystore, name)]
        removed = dict.fromkeys(left, "its enclave was revoked")
        for name in self._not_here.intersection(list_enclaves(self.export)):
            if any((enclave_path(self.keystore, name) / file).exists() for file in KEY_FILES):
                removed[name] = "its enclave belongs to another machine"
        with Folder(self.export) as export:
            for inside in map(enclave_folder, removed):
                for entry in (f"{inside}/{name}" for name in export.names(inside)):
                    if not stat.S_ISDIR(export.mode(entry)):
                        export.unlink(entry)
            for inside in sorted(map(enclave_folder, removed), reverse=True):  # inner ones first
                if not export.names(inside):
                    export.rmdir(inside)
        paths = {str(enclave_path(self.export, name)): why for name, why in removed.items()}
        for path, why in paths.items():
            self._shell.say(f"removed {path}: {why}")
        return [FileChange("remove", path) for path in paths]

    def _drop_in_heading(self) -> str:
        """Return the first line of each drop-in that is made for this folder."""
        return f"# Made by `sros close {self.folder.absolute()}`; undone by its --undo.\n"

    @property
    def _rights(self) -> Path:
        """The keystore, or the policy if the keystore was brought to another machine."""
        return self.keystore if self.keystore.exists() else self.policy

    def _denied_access_texts(self) -> list[str]:
        """Return, as sentences, what the keystore denies to the observed nodes."""
        return [str(right) for right in self._denied_rights(self._observation())]

    def _denied_rights(self, observation: Observation) -> Sequence[DeniedRight]:
        """Return the rights that observed nodes need and the keystore denies."""
        context = JoinContext(self.domain, self._shell.now(), self._shell.zone)
        vendor = chosen_vendor(None, None, self._shell.environment)[0]
        enclaves = audited_enclaves([self._rights], vendor, context)
        return audit(observation, enclaves, _OBSERVER).denied

    def _problems(self, closing: Closing, *, partial: bool) -> Iterator[str]:
        """Yield what keeps the robot from running closed, with what to do."""
        policy, observed = read_policy(self.policy), closing.observed
        not_here = self._not_here
        for name in list_enclaves(self.keystore):
            if name not in (_OBSERVER, _ROUTER, *not_here) and not policy.enclave(name):
                revoke = f"sros revoke {shlex.quote(str(self.keystore))} {name}"
                yield (
                    f"the policy does not have {name}, and the keystore does: if nothing needs it "
                    f"any more, {revoke}; if it belongs to another machine, such as a laptop, "
                    f"{self._close} --elsewhere {name}; if it belongs to this machine, sros "
                    f"merge_policy {shlex.quote(str(self.policy))} ITS_POLICY --in-place"
                )
        for name in sorted(not_here & closing.secured.keys()):
            yield f"{name} belongs to another machine, and a process runs in it here: stop it"
        for name in self._enclaves_left():
            remove = f"rm -r {shlex.quote(str(enclave_path(self.export, name)))}"
            yield f"the export has {name}, which the keystore neither has nor revoked: {remove}"
        owner, export = self.export.stat().st_uid, self.export.absolute()
        users = sorted({process.user for process in observed.processes})
        for user in users:
            closed = [path for path in export.parents if not _may_enter(user, path.stat())]
            if closed and user:
                yield f"user {user}, who runs processes, cannot enter '{closed[-1]}'"
            if user != owner:
                yield (
                    f"processes run as user {user}, and only user {owner} can read the enclaves: "
                    f"chown -R {user} {shlex.quote(str(self.export))}"
                )
        for process in observed.processes:
            command = process.command
            if process.launch and not (node_argument(command) or launch_verb(command)):
                words = _run_words(export, process.enclave, process.rmw)
                prefix = f"prefix='{' '.join(words)}'"
                yield (
                    f"the process of {process.enclave} has no name= in its launch file, and would "
                    f"not start: give it one, or {prefix}"
                )
        if partial:
            return
        silent = "they would not be heard any more (accept: --partial)"
        if observed.unknown:
            named = first_few(observed.unknown, _MOST_NAMES)
            opened = f"go back by {self._close} --undo, and " if closing.secured else ""
            yield (
                f"sros saw no node of {counted(len(observed.unknown), 'process', 'processes')}: "
                f"{named}; {opened}watch again while they run: {self._close} --for 1m; "
                f"otherwise {silent}"
            )
        if observed.elsewhere:
            here = {process.enclave: process.pid for process in observed.processes}
            twice = sorted(here.keys() & {*observed.elsewhere})
            if twice:
                yield (
                    f"nodes of {twice[0]} are in process {here[twice[0]]} and in another one that "
                    "sros does not see: if another robot is in this ROS domain, switch it off, or "
                    "give it a domain of its own, remove the rights that it added to "
                    f"'{self.policy}', and watch again: {self._close} --for 1m"
                )
            if only_there := [name for name in observed.elsewhere if name not in twice]:
                named = first_few(only_there, _MOST_NAMES)
                options = " ".join(f"--elsewhere {name}" for name in only_there)
                yield (
                    f"sros knows no process of this machine for nodes of {named}; if they run on "
                    f"another machine: {self._close} {options}; otherwise {silent}"
                )

    # ── applying ────────────────────────────────────────────────────────────────────────────

    def apply(self, prepared: Closing, *, dry_run: bool) -> Closing:
        """Restart the systemd units that do not run in their enclaves, with drop-ins.

        Proves that the robot is closed, if nothing is left to do by hand.
        """
        self._check_shell()
        observed = prepared.observed
        paths = [f"{unit}.d/{_DROP_IN}" for unit in sorted(observed.units.values())]
        files = {path: read_bytes(self.start / "units" / path, "unit").decode() for path in paths}
        self._own_drop_ins(observed)
        changes = unit_changes(_SYSTEMD, files, force=True)
        for path, action in changes.items():
            self._shell.say(f"{'would ' if dry_run else ''}{action} {_SYSTEMD / path}")
        if not dry_run:
            write_units(_SYSTEMD, files, changes)
        secured = prepared.secured
        open_units = {unit for enclave, unit in observed.units.items() if not secured.get(enclave)}
        self._restart(observed, open_units, dry_run=dry_run)
        done = [FileChange(action, str(_SYSTEMD / path)) for path, action in changes.items()]
        by_hand = dry_run or prepared.left_by_hand
        proofs = () if by_hand else self._proofs(prepared, _RESTART_SECONDS)
        total = [*prepared.changes, *done]
        if not proofs:
            return prepared._replace(changes=total)
        now = self._closing()
        return prepared._replace(proofs=proofs, changes=total, secured=now.secured, new=now.new)

    def _restart(self, observed: ObservedProcesses, units: set[str], *, dry_run: bool) -> None:
        """Let systemd read its units again, and restart some.  Raises `SrosError`.

        Units whose processes ended by themselves are restarted only if they run.
        """
        idle = {process.unit for process in observed.processes if not process.pid}
        verbs = {"restart": units - idle, "try-restart": units & idle}
        restarts = [[verb, *sorted(of_verb)] for verb, of_verb in verbs.items() if of_verb]
        for words in [["daemon-reload"], *restarts] if units else []:
            command = ["systemctl", *words]
            self._shell.say(f"{'would run:' if dry_run else '+'} {shlex.join(command)}")
            try:
                ended = 0 if dry_run else subprocess.run(command, check=False).returncode
            except OSError as error:
                raise UnavailableError(f"systemctl cannot be run: {error.strerror}") from error
            if ended:
                raise SrosError(
                    f"`{shlex.join(command)}` ended with {ended}",
                    "Secured and open processes do not hear each other.",
                    "Fix it and run --apply again, or go back with --undo.",
                )

    def _own_drop_ins(self, observed: ObservedProcesses) -> list[Path]:
        """Return the drop-ins of this folder; raise `SrosError` at one of another folder."""
        drop_ins = [
            path
            for path in sorted(_SYSTEMD.glob(f"*.d/{_DROP_IN}"))
            if read_bytes(path, "unit").startswith(self._drop_in_heading().encode())
        ]
        for unit in sorted({*observed.units.values()}):
            path = _SYSTEMD / f"{unit}.d/{_DROP_IN}"
            if path not in drop_ins and os.path.lexists(path):
                raise SrosError(
                    f"'{path}' is not the drop-in of this folder",
                    "Its first line names another folder, or was changed. Nothing was changed.",
                    "Use the folder that it names, spelled as there, or remove the drop-in.",
                )
        return drop_ins

    def undo(self, *, dry_run: bool) -> Closing:
        """Remove the drop-ins of this folder, restart their units, and say what to do by hand."""
        observed = self.observed or ObservedProcesses(self.domain)
        observed = self._with_later(observed, ProcessTable().look(self._shell.now()))
        drop_ins = self._own_drop_ins(observed)
        for path in drop_ins:
            self._shell.say(f"{'would remove' if dry_run else 'removed'} {path}")
            if not dry_run:
                remove_file(path)
        of_drop_ins = {path.parent.name.removesuffix(".d") for path in drop_ins}
        self._restart(observed, {*observed.units.values()} | of_drop_ins, dry_run=dry_run)
        changes = [FileChange("remove", str(path)) for path in drop_ins]
        closing = self._closing()._replace(dry_run=dry_run, changes=changes)
        return closing._replace(problems=[*self._texts_to_open(observed)])

    def _texts_to_open(self, observed: ObservedProcesses) -> Iterator[str]:
        """Yield how to start each process open that runs in an enclave or does not run.

        Processes of enclaves that were taken out of the policy are left out.  Secured processes
        that sros does not know are named, so that none of them is taken for open.
        """
        running = ProcessTable().look(self._shell.now())
        are_open = {
            process.program[1]: process
            for process in filter(self._is_neighbour, running.processes)
            if not process.asks_for_security
        }
        observed_commands = {tuple(process.command) for process in observed.processes}
        others = [are_open[command] for command in are_open if command not in observed_commands]
        own = [*self._secured(running, everywhere=True)]
        secured = {
            enclave.name: process
            for process, enclave in sorted(own, key=lambda pair: self._may_use_files(pair[0]))
        }
        if self.policy.exists():
            observed = observed.within(read_policy(self.policy))
        by_hand = [*chain.from_iterable(observed.commands_by_hand(self.folder).values())]
        closed = [process for process in by_hand if process.enclave in secured]
        processes_of = Counter(process.enclave for process in closed)
        commands = []
        for process in closed:
            now = secured[process.enclave]
            is_alone = processes_of[process.enclave] == 1 and not process.launch
            if is_alone and not process.container and self._may_use_files(now):
                commands.append(_closed_process(now, process.enclave).open_command(self.domain))
            else:
                commands.append(process.open_command(self.domain))
        for command in dict.fromkeys(commands):
            yield f"restart it open: {command}"
        for process in by_hand:
            if process.enclave not in secured and tuple(process.command) not in are_open:
                names, old = self._node_names(process.enclave)
                under = f", under its old name {old}" if old else ""
                how = f"start it open{under}: {process.open_command(self.domain)}"
                like = [other.label for other in others if _is_like(other, process, names)]
                state = "does not run; "
                if like:
                    state = (
                        f"runs open by another command ({like[0]}); if that is another program, "
                    )
                self._shell.say(f"{process.enclave} {state}{how}")
        for name in sorted(secured.keys() - {process.enclave for process in observed.processes}):
            guest = secured[name]
            how = f"restart it open: {_process_text(guest)}"
            if not self._may_use_files(guest):
                how = f"it is {guest.label} of user {guest.user}, who cannot read its files"
            yield f"{name} runs in an enclave, too; {how}"
        pids = {process.pid for process, _ in own}
        for other in filter(self._is_neighbour, running.processes):
            if (enclave := other.enclave) and other.pid not in pids and not other.is_daemon:
                why = f" ({enclave.problem})" if enclave.problem else ""
                yield (
                    f"{other.label} runs secured with the files of '{_keystore_of(enclave)}'{why}, "
                    "which are not known as those of this folder; open processes do not hear it"
                )
        for unseen in running.unseen:
            if unseen.speaks:
                yield f"{unseen.label} speaks ROS 2, and cannot be looked at: {unseen.why}"
        if running.hidden or any(not unseen.speaks for unseen in running.unseen):
            self._shell.say("some processes cannot be looked at: to be sure of them, ask as root")

    def _node_names(self, enclave: str) -> tuple[set[str], str]:
        """Return the names of an enclave's nodes, observed or in the policy, and a replaced one.

        The replaced name is that of a node to which the policy gives another one; "" for none.
        """
        with suppress(SrosError):  # a broken file must not keep the robot closed
            seen = {_node_name(node) for node in self._observed_nodes() if enclave in node.enclaves}
            of_policy = read_policy(self.policy).enclave(enclave)
            profiles = of_policy.all_profiles() if of_policy else ()
            names = {expand("~", profile.ns, profile.node) for profile in profiles}
            return seen | names, next(iter(seen & self._renamed_nodes().keys()), "")
        return set(), ""

    # ── the proof ───────────────────────────────────────────────────────────────────────────

    def prove(self) -> Closing:
        """Prove that the robot is closed."""
        self._check_shell()
        closing = self._closing()
        proofs = self._proofs(closing, _START_SECONDS)
        fails = any(proof.fails for proof in proofs)
        if not fails and self.policy.exists() and (changed := self._enclaves_changed()):
            where = "" if self.keystore.exists() else ", where the keystore is,"
            self._shell.say(
                f"'{self.policy}' differs from the signed permissions of "
                f"{first_few(changed, _MOST_NAMES)}: `{self._close}`"
                f"{where} checks and signs it"
            )
        return closing._replace(proofs=proofs)

    def _enclaves_changed(self) -> list[str]:
        """Return the enclaves whose signed rights differ from the policy."""
        only = ("--include", STALE.id, "--json")
        words = ("check", str(self.export), "--policy", str(self.policy), *only)
        _, output, _ = self._shell.run(words, False)
        stale = [finding["subject"] for finding in json.loads(output)["findings"]]
        policy = {enclave.path for enclave in read_policy(self.policy).enclaves} - self._not_here
        return sorted({*stale, *policy.difference(list_enclaves(self.export))})

    def _proofs(self, closing: Closing, patience: float) -> list[Proof]:
        """Wait until each process runs in its enclave, and prove that the robot is closed."""
        observed = closing.observed
        expected = {process.enclave for process in observed.processes} | {*closing.new}
        if not expected:
            return [Proof(_CLAIM, False, "no process of the robot is known")]
        table, end = ProcessTable(), time.monotonic() + patience
        while True:
            running = table.look(self._shell.now())
            missing = sorted(expected - self._enclaves_with_process(running))
            if not missing:
                break
            if time.monotonic() > end:
                running_now = {enclave.name for _, enclave in self._secured(running)}
                needed = {*missing}.difference(self._without) | running_now.intersection(missing)
                if needed or expected == {*missing}:
                    why = self._why_missing(
                        sorted(needed) or missing, observed.as_they_run(running), running
                    )
                    return [Proof(_CLAIM, False, why)]
                break
            time.sleep(0.2)
        nodes, _ = self._divide_by_profile(self._observation().nodes)
        not_here = self._not_here
        # A laptop may be away; a computer whose nodes were seen has to be seen again.
        may_be_away = not_here - {node.enclaves[0] for node in nodes}
        away = sorted({*missing} | may_be_away | not_here.intersection(self._without))
        before = make_observation(node for node in nodes if node.enclaves[0] not in away)
        proof = self._proof_of_processes(len(expected) - len(missing), running)
        state = "not seen" if running.unseen or running.hidden else "not running"
        for what, names in ((state, missing), ("of other machines", sorted(not_here))):
            if names:
                proof = proof._replace(reason=f"{proof.reason}; {what}: {', '.join(names)}")
        talk = self._proof_of_talk(before, away, running)
        talk = talk._replace(reason=f"{talk.reason}{self._renamed_text(fails=talk.fails)}")
        if talk.fails and (compared := sorted(not_here.difference(away))):
            options = " ".join(f"--without {name}" for name in compared)
            talk = talk._replace(reason=f"{talk.reason}; if they may be away, add {options}")
        silence = self._proof_of_silence(before, hears=talk.holds is not None)
        return [proof, self._proof_of_files(), *self._proof_of_requirements(), talk, silence]

    def _renamed_text(self, *, fails: bool) -> str:
        """Return which nodes were compared under new names, and which ones not at all, as text."""
        renamed, text = self._renamed_nodes(), ""
        if renamed:
            names = [f"{old} as {expand('~', *renamed[old])}" for old in sorted(renamed)]
            text = f"; compared under a new name: {first_few(names, _MOST_NAMES)}"
            pairs = self._moved_endpoints(renamed)
            topics = sorted({(_use_of(old)[1], _use_of(new)[1]) for old, new in pairs})
            own = tuple(f"{name}/" for name in renamed)
            if moved := [f"{old} as {new}" for old, new in topics if not old.startswith(own)]:
                text += f", with {enumerated(moved)} (a name that does not move: write it absolute)"
            if fails:
                text += " (if it is another node, remove what it does not use from its profile)"
        _, without = self._divide_by_profile(self._observed_nodes())
        left = {_node_name(node) for node in without if not is_tool(node)} - renamed.keys()
        if left and not fails:
            text += (
                "; not compared, as the policy has no profile for them any more: "
                f"{first_few(sorted(left), _MOST_NAMES)} (if they have new names, they are compared"
                f" once the open robot was watched again: {self._close} --undo, {self._close} "
                "--for 1m)"
            )
        return text

    def _moved_endpoints(
        self, renamed: Mapping[str, tuple[str, str]]
    ) -> set[tuple[Endpoint, Endpoint]]:
        """Return the endpoints of renamed nodes that are renamed, too, each with the new one."""
        return {
            (before, after)
            for node in self._observed_nodes()
            if (new := renamed.get(_node_name(node)))
            for before, after in self._renamed_endpoints(node, *new).items()
            if before != after
        }

    def _divide_by_profile(
        self, nodes: Iterable[ObservedNode]
    ) -> tuple[list[ObservedNode], list[ObservedNode]]:
        """Divide nodes into those with a profile in the policy, and those without."""
        profiles = [
            profile
            for enclave in read_policy(self.policy).enclaves
            for profile in enclave.all_profiles()
        ]
        sides: tuple[list[ObservedNode], list[ObservedNode]] = [], []
        for node in nodes:
            name = stable_name(node.name)
            has_profile = any(
                overlap(profile.ns, node.ns) and overlap(profile.node, name) for profile in profiles
            )
            sides[0 if has_profile else 1].append(node)
        return sides

    def _proof_of_files(self) -> Proof:
        """Ask `check` about the files that the processes use, such as a key that others read."""
        status = self._check(str(self.export))
        reasons = {0: "sros check finds none", 1: "sros check finds one", 2: "they are not checked"}
        holds = {0: True, 1: False}.get(status)
        return Proof("the files have no error", holds, f"{reasons[status]}: {self.export}")

    def _proof_of_requirements(self) -> Iterator[Proof]:
        """Decide the requirements for the enclaves that the processes use.

        With processes on other machines, also for the enclaves of the keystore, or of the policy.
        """
        if not self.requirements.exists():
            return
        needed = ("--requirements", str(self.requirements), "--include", "requirement.*")
        places = [self.export, *[self._rights] * bool(self._not_here)]
        statuses = [self._check(str(place), *needed) for place in places]
        status = 1 if 1 in statuses else max(statuses)
        reasons = {0: "all of them", 1: "one is violated", 2: "sros could not check them"}
        holds = {0: True, 1: False}.get(status)
        yield Proof("the requirements hold", holds, f"{reasons[status]}: {self.requirements}")

    def _check(self, *words: str) -> int:
        """Run `check`, show what it says if it finds an error, and return its status."""
        step = _Step(("check", *words, "--fail-on", "error"))
        self._shell.say(f"+ {step.command}")
        status, output, messages = self._shell.run(step.words, False)
        self._say(f"{output}{messages}" if status else "")
        return status

    def _why_missing(
        self, missing: Sequence[str], observed: ObservedProcesses, running: RunningProcesses
    ) -> str:
        """Return which enclaves have no process, or an open one, and what the others lack."""
        wrong = {
            enclave.name: (process, self._why_not_current(process, enclave))
            for process, enclave in self._secured(running)
            if enclave.name in missing
        }
        are_open = {process.enclave: process.pid for process in observed.processes if process.pid}
        absent = [name for name in missing if name not in wrong]
        others = {name: f"stop process {pid}, which is open" for name, pid in are_open.items()}
        others |= {
            enclave.name: f"{process.label} has the files of '{_keystore_of(enclave)}'"
            for process in filter(self._is_neighbour, running.processes)
            if (enclave := process.enclave)
        }
        named = ", ".join(f"{name} ({others[name]})" if name in others else name for name in absent)
        reasons = [
            f"no secured process of {named}; start it as {self.start / COMMANDS} says; "
            f"if it ended: sros explain {shlex.quote(str(self.export))} --log ITS_LOG"
        ] * bool(absent)
        if may_end := [name for name in absent if name not in {*are_open, *self._without}]:
            options = " ".join(f"--without {name}" for name in may_end)
            reasons.append(f"if it does not always run, add {options}")
        if absent and (in_others := self._in_other_domains(running)):
            reasons.append(in_others)
        for why in dict.fromkeys(why for _, why in wrong.values()):
            named = ", ".join(
                f"{name} (process {wrong[name][0].pid})"
                for name in missing
                if name in wrong and wrong[name][1] == why
            )
            reasons.append(f"{why} the processes of {named}; restart them")
        return "; ".join(reasons)

    def _why_not_current(self, process: Process, enclave: ProcessEnclave) -> str:
        """Return what precedes "the processes of ENCLAVE" where they do not count as closed."""
        if not self._may_use_files(process):
            return f"user {process.user}, who cannot read the files, runs"
        if process.environment.get(STRATEGY) != "Enforce":
            return f"no {STRATEGY}=Enforce in"
        newer = first_few([*newer_files(process, enclave)], _MOST_NAMES) or "files"
        mode = enclave.file(KEY_FILE).mode
        readable = (
            f"others can read {KEY_FILE} (its mode is {mode:04o}): if anybody did, `sros renew "
            f"KEYSTORE {enclave.name} --new-key --revoke-old`, otherwise chmod 600; "
        )
        lead = readable if mode & 0o077 else ""
        return f"{lead}{newer} changed, or got another mode, after the start of"

    def _enclaves_with_process(self, running: RunningProcesses) -> set[str]:
        """Return the enclaves in which a process runs with the current files of the export.

        Without the strategy Enforce, a process runs open if its files were not there at its start.
        """
        return {
            enclave.name
            for process, enclave in self._secured(running)
            if enclave.is_there
            and self._may_use_files(process)
            and process.environment.get(STRATEGY) == "Enforce"
            and not [*newer_files(process, enclave)]
        }

    def _secured(
        self, running: RunningProcesses, *, everywhere: bool = False
    ) -> Iterator[tuple[Process, ProcessEnclave]]:
        """Yield the processes of the robot's domain that run in enclaves of the export.

        Those of other domains and networks, too, if they are looked for ``everywhere``.
        """
        for process in running.processes:
            enclave, is_near = process.enclave, everywhere or self._is_neighbour(process)
            if enclave and is_near and enclave.is_of(self.export):
                yield process, enclave

    def _proof_of_processes(self, number: int, running: RunningProcesses) -> Proof:
        """Look for processes that are open, or that something is wrong with."""
        self._shell.say(
            f'$ eval "$(sros env {shlex.quote(str(self.export))} {_OBSERVER})"; sros check runtime'
        )
        # This shell starts no node.
        here = {**self._shell.environment, **self._variables(_OBSERVER), ENCLAVE: ""}
        near = tuple(filter(self._is_neighbour, running.processes))
        others = [process for process in running.processes if process not in near]
        running, now = replace(running, processes=near), self._shell.now()
        findings = [
            finding
            for finding in process_findings(here, running, now=now, zone=self._shell.zone)
            if finding.severity > NOTE
        ]
        present, known = (
            self._enclaves_with_process(running),
            self.observed or ObservedProcesses(self.domain),
        )
        closed = {tuple(process.command): process.enclave for process in known.processes}
        left_over = {
            process.label: f"Stop it: another process runs in {closed[process.program[1]]}."
            for process in near
            if not process.asks_for_security and closed.get(process.program[1]) in present
        }
        for finding in findings:
            remedy = left_over.get(finding.subject, finding.remedy)
            self._shell.say(f"{finding.subject}: {finding.text}. {remedy}")
        wrong = [finding for finding in findings if finding.id != PROCESS_NOT_SEEN.id]
        if findings:
            first = (wrong or findings)[0]
            return Proof(_CLAIM, False if wrong else None, f"{first.subject}: {first.text}")
        known_pids = {process.pid for process, _ in self._secured(running)}
        guests = [
            f"; {process.label} runs in {process.enclave.name} with the files of "
            f"'{_keystore_of(process.enclave)}'"
            for process in near
            if process.enclave and process.pid not in known_pids and not process.is_daemon
        ]
        guests += [
            f"; {process.label} runs open in domain {process.domain}"
            for process in others
            if not (process.enclave or process.network or process.is_daemon)
        ]
        said = f"{counted(number, 'enclave')}, and no open process in domain {self.domain}"
        return Proof(_CLAIM, True, f"{said}{''.join(guests)}")

    def _proof_of_talk(
        self, before: Observation, missing: Sequence[str], running: RunningProcesses
    ) -> Proof:
        """Compare what an observer in an enclave sees now with what was seen before.

        Processes of the enclaves ``missing`` do not run; ``running`` are those of the other
        enclaves at the beginning of the proof.
        """
        observation = self._observation()
        denied = self._denied_rights(observation)
        moved = self._moved_endpoints(self._renamed_nodes())
        words = ("audit", str(self._rights), "--keystore", str(self.export), "--enclave", _OBSERVER)
        step = _Step(
            (*words, "--domain", str(self.domain), "--json", *["--partial"] * bool(missing))
        )
        for _ in range(_TRIES):  # nodes may still be starting
            try:
                status, value = self._status_and_json(step)
            except UnavailableError as error:
                return Proof(_TALK, None, f"{error}")
            now = observation_from_json(value)
            ended = self._ended_since(running)
            unseen = [node for node in value["unseen"] if node["enclave"] not in missing]
            wrong = {
                "denied": [
                    f"{right['enclave']} {right['right']} {right['name']}: {right['reason']}"
                    for right in value["denied"]
                ],
                "refused": [refused["enclave"] for refused in value["refused"]],
                "ended while the proof ran": [
                    f"{node['node'] or node['enclave']} ({ended[node['enclave']]}; start it again, "
                    f"or, if it does not always run, add --without {node['enclave']})"
                    for node in unseen
                    if node["enclave"] in ended
                ],
                "not seen": [
                    self._unseen_text(node["node"], node["enclave"], running) for node in unseen
                ],
                "gone": _lost_endpoints(before, now, denied),
                "left alone": left_alone(before, observation, moved, denied),
                "not judged": value["unjudged"],
                "not done": ["the ROS graph kept changing"] if status else [],
            }
            reason = next((f"{why}: {first_few(of, 3)}" for why, of in wrong.items() if of), "")
            if not reason:
                number = counted(len(before.nodes), "node")
                but = f", but for {counted(len(denied), 'right')} that the policy denies now: "
                but += ", ".join(
                    f"{right.right.enclave} {right.right.describe()}" for right in denied
                )
                seen = f"{number} with {before.endpoint_count} endpoints as before"
                left = f", without {', '.join(missing)}" if missing else ""
                _, others = self._divide_by_profile(now.nodes)
                known = {*map(_node_name, before.nodes)}
                new = sorted(
                    f"{_node_name(node)} in {' or '.join(node.enclaves) or 'no enclave'}"
                    for node in others
                    if _node_name(node) not in known and not is_tool(node)
                )
                more = f"; new, without a profile: {first_few(new, _MOST_NAMES)}" if new else ""
                return Proof(_TALK, True, f"{seen}{left}{but if denied else ''}{more}")
        return Proof(_TALK, False, reason)

    def _ended_since(self, running: RunningProcesses) -> dict[str, str]:
        """Map enclaves to their processes that were ``running`` and have ended."""
        pids = {process.pid for process in ProcessTable().look(self._shell.now()).processes}
        return {
            enclave.name: process.label
            for process, enclave in self._secured(running)
            if process.pid not in pids
        }

    def _unseen_text(self, node: str, enclave: str, running: RunningProcesses) -> str:
        """Return a node that an enclave has a profile for, and what to do if it does not exist."""
        for process, of in self._secured(running):
            if (
                of.name == enclave
                and process.is_zenoh
                and named_enclave(process.command) != of.name
            ):
                return (
                    f"{node or f'any node in {enclave}'} (start {process.label} with `{ROS_ARGS} "
                    f"--enclave {enclave}` at its end: on Zenoh, others do not see it otherwise)"
                )
        if not node or is_expression(node):
            return f"any node in {enclave}"
        return f"{node} (if it is gone for good, remove its profile from '{self.policy}')"

    def _proof_of_silence(self, before: Observation, *, hears: bool) -> Proof:
        """Look for nodes as an open listener; before, the same listener saw all nodes.

        Seeing none means something only if the observer ``hears`` the robot in its enclave now.
        """
        words = ("generate_policy", str(self.folder / "open.xml"), "--domain", str(self.domain))
        try:
            _, value = self._status_and_json(_Step((*words, "--dry-run", "--json")))
        except UnavailableError as error:
            return Proof(_SILENCE, None, f"{error}")
        if value["nodes"]:
            nodes = {f"{node['namespace'].rstrip('/')}/{node['name']}" for node in value["nodes"]}
            return Proof(_SILENCE, False, f"it sees {first_few(sorted(nodes), 3)}")
        if not hears:
            return Proof(_SILENCE, None, "nor does the observer in its enclave see the robot now")
        number = counted(len(before.nodes), "node")
        return Proof(_SILENCE, True, f"the observer that saw {number} before sees none")

    def _status_and_json(self, step: _Step) -> tuple[int, Any]:
        """Return the status of a verb, and the JSON that it prints."""
        self._shell.say(f"+ {step.command}")
        status, output, _ = self._shell.run(step.words, False)
        return status, json.loads(output)


def _is_like(process: Process, observed: ClosedProcess, nodes: Collection[str]) -> bool:
    """Return whether a process may be an observed one, which has these nodes, by other words."""
    if named := node_argument(process.program[1]):
        return expand("~", *named) in nodes
    return program_of(process.program[1]) == program_of(tuple(observed.command))


def _closed_process(process: Process, enclave: str) -> ClosedProcess:
    """Return a process that runs in an enclave, with the command that starts it open."""
    known = ClosedProcess.of(process, enclave, process_origin(process.pid), "enclave")
    return known._replace(command=_without_enclave_argument(known.command, enclave))


_SeenProcesses = dict[tuple[str, ...], tuple[Process, ProcessOrigin]]


def _needs_enclave_argument(process: ClosedProcess) -> bool:
    """Return whether the command must name the enclave, which others look for on Zenoh."""
    is_node = bool(process.rmw) and process.enclave != _ROUTER
    return is_node and named_enclave(process.command) != process.enclave


def _ended_processes(
    nodes: Iterable[ObservedNode],
    seen: Iterable[tuple[Process, ProcessOrigin]],
    observed: ObservedProcesses,
) -> list[ClosedProcess]:
    """Return the processes of nodes that ended while sros watched.

    Those of an enclave that had several commands are left out, because one of them may be another
    program that took the node's name.  ``observed`` are the processes that stayed; a unit that
    starts one of them starts it alone.
    """
    origins = {process.pid: origin for process, origin in seen}
    known = {*observed.units.values()}
    ended = assign(nodes, [process for process, _ in seen], observed.domain, {}, origins)
    commands = Counter(process.enclave for process in ended.processes)
    return [
        process._replace(pid=0, unit="" if process.unit in known else process.unit)
        for process in ended.processes
        # Many tools end while sros watches, so elimination shows nothing.
        if commands[process.enclave] == 1 and process.known_by != "elimination"
    ]


def _as_its_unit_starts(process: ClosedProcess) -> ClosedProcess:
    """Return a process with the command of its unit, to which an argument can be added.

    If the unit starts another command, such as a script, return the process without its unit.
    """
    if not (process.unit and _needs_enclave_argument(process)):
        return process
    asking = ["systemctl", "show", "--property=ExecStart", "--value", process.unit]
    try:
        shown = subprocess.run(asking, capture_output=True, check=False).stdout
    except OSError:
        shown = b""
    with suppress(UsageError):  # some words cannot be written in a unit
        for words in (process.command, process.command[1:]):
            if f"; argv[]={' '.join(words)} ;".encode() in shown and [*unit_words(words)]:
                return process._replace(command=words)
    return process._replace(unit="")


def _keystore_of(enclave: ProcessEnclave) -> str:
    return plain(enclave.keystore, _LONGEST_PATH)


_CLAIM = "every process was started in its enclave"
_OF_EVERY_SHELL = ("_", "SHLVL", "PWD", "OLDPWD", "COLUMNS", "LINES", DOMAIN)
"""Variables that differ between shells, or that the commands set."""
_TALK = "everything that talked can still talk"
_SILENCE = "an open listener finds nothing"


def _may_enter(user: int, folder: os.stat_result) -> bool:
    return bool(folder.st_mode & (stat.S_IXUSR if folder.st_uid == user else 0o011))


def _commands(by_hand: Mapping[str, Sequence[ClosedProcess]]) -> Iterator[str]:
    for command, processes in by_hand.items():
        yield from ("", f"# {', '.join(process.enclave for process in processes)}", command)


def _text(lines: Iterable[str]) -> str:
    return "".join(f"{line}\n" for line in lines)


def _lost_endpoints(
    before: Observation, now: Observation, denied: Iterable[DeniedRight]
) -> list[str]:
    """Return the endpoints, as text, that nodes had before and lack now, unless ``denied``."""
    expected = {*_endpoints(before.nodes)} - _denied_endpoints(denied)
    lost: dict[str, list[str]] = {}
    gone = expected - {*_endpoints(now.nodes)}
    for node, right, name in sorted({(node, *_use_of(endpoint)) for node, endpoint in gone}):
        lost.setdefault(f"{node} {right}", []).append(name)
    return [f"{uses} {first_few(names, _MOST_NAMES)}" for uses, names in lost.items()]


def left_alone(
    before: Observation,
    everybody: Observation,
    moved: Collection[tuple[Endpoint, Endpoint]],
    denied: Iterable[DeniedRight],
) -> list[str]:
    """Return, as text, what nodes use by a name whose whole other side ``moved`` to another one.

    ``before`` are the nodes to compare, of ``everybody``, with the names that count now; what is
    ``denied`` is left out.
    """
    refused = _denied_endpoints(denied)
    of_robot = [node for node in everybody.nodes if not is_tool(node)]
    kept = {endpoint for _, endpoint in {*_endpoints(of_robot)} - refused}
    used = {*_endpoints(node for node in before.nodes if not is_tool(node))} - refused
    other = {PUBLISH: SUBSCRIBE, SUBSCRIBE: PUBLISH}
    new_names = {
        old._replace(direction=other[old.direction]): _use_of(new)[1]
        for old, new in moved
        if old not in kept
    }
    alone = {(node, *_use_of(end), new_names[end]) for node, end in used if end in new_names}
    return [
        f"{node} {right} {name}, which is {new} now" for node, right, name, new in sorted(alone)
    ]


def _denied_endpoints(denied: Iterable[DeniedRight]) -> set[tuple[str, Endpoint]]:
    return {
        (node, endpoint) for right in denied for node in right.nodes for endpoint in right.endpoints
    }


def _use_of(endpoint: Endpoint) -> tuple[str, str]:
    """Return the right that an endpoint needs, and its ROS name, or its DDS topic without one."""
    right, name = right_to_use(endpoint.topic, writes=endpoint.direction == PUBLISH)
    return right or endpoint.direction, name


def _node_name(node: ObservedNode) -> str:
    return f"{node.ns.rstrip('/')}/{stable_name(node.name)}"


def _possible_endpoints(
    endpoint: Endpoint, node: ObservedNode, ns: str, name: str
) -> Sequence[Endpoint]:
    """Return an endpoint of a node as it may be named under another node name, likeliest first.

    Private names of the node move with it.  The graph does not show whether a program wrote another
    name of its namespace as a relative one, which moves, or as an absolute one.
    """
    prefix, fqn = endpoint.topic[:2], endpoint.topic[2:]
    own, near = expand("~/", node.ns, node.name), expand("", node.ns, "")
    if fqn.startswith(own):
        moved = f"{expand('~/', ns, name)}{fqn.removeprefix(own)}"
        return endpoint._replace(topic=prefix + moved), endpoint
    if fqn.startswith(near):  # a DDS topic without a ROS name does not
        moved = expand(fqn.removeprefix(near), ns, name)
        return endpoint, endpoint._replace(topic=prefix + moved)
    return (endpoint,)


def _endpoints(nodes: Iterable[ObservedNode]) -> Iterator[tuple[str, Endpoint]]:
    for node in nodes:
        for topic, way in node.endpoints:
            yield _node_name(node), Endpoint(topic.replace(node.name, stable_name(node.name)), way)
