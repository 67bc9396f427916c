"""From an open robot to a closed one: which process gets which enclave, and what proves it.

A process of Fast DDS shows its process id in the identifier of its DDS participant (two bytes of
the GUID prefix; Fast DDS 2.6 to 3.6, ``GuidUtils.hpp``).  Other processes are known by the name
that their command gives the node, or by the name of their program.  A wrong guess is safe: DDS
denies the process what its enclave may not do.
"""

from __future__ import annotations

import json
import re
import shlex
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Annotated, NamedTuple

from sros_tool.errors import DocumentError
from sros_tool.explain.audit import DeniedRight
from sros_tool.graph.learn import common_parts, stable_name
from sros_tool.graph.observation import PUBLISH, SUBSCRIBE, Observation, ObservedNode
from sros_tool.policy.model import RIGHTS, Policy
from sros_tool.policy.rights import policy_rights
from sros_tool.runtime.environment import node_argument, render_environment
from sros_tool.runtime.processes import (
    SERVICE_NAME,
    Process,
    launch_verb,
    process_origin,
    program_of,
)
from sros_tool.runtime.units import unit_instance
from sros_tool.runtime.variables import ENABLE, KEYSTORE, STRATEGY
from sros_tool.values import DryRun, FileChanges, Words, as_plain, shows
from sros_tool.wording import first_few
from sros_tool.xml import read_bytes

_FAST_DDS = "010f"
"""The first two bytes of a participant of Fast DDS: its vendor id (RTPS 2.3, 9.4.5.1)."""
_NODE_PARTS = ("common/node.xml", "common/rclcpp_node.xml", "common/rclpy_node.xml")
_MOST_LINES, _MOST_NAMES = 20, 3
DROP_IN, COMMANDS = "sros-close.conf", "commands.txt"


class ClosedProcess(NamedTuple):
    """A process of the robot, and the enclave in which it has to run."""

    enclave: str
    """The enclave of the process."""
    pid: int
    """Its id when it was observed."""
    command: Sequence[str]
    """Its command with the arguments."""
    folder: str
    """Its working directory."""
    user: int
    """The id of the user who runs it."""
    unit: str
    """The unit of systemd that starts it alone; empty for a process that is restarted by hand."""
    known_by: Annotated[str, Words(("process id", "node name", "program", "elimination"))]
    """How sros knows that this process has the nodes of the enclave."""

    launch: Sequence[str] = ()
    """The command of the `ros2 launch` that started it; empty for a process of its own."""

    @property
    def open_command(self) -> str:
        """The shell command that starts the process as it was started."""
        return f"cd {shlex.quote(self.folder)} && {shlex.join(self.launch or self.command)}"

    def secured_command(self, folder: Path) -> str:
        """Return the shell command that starts the process, or its launch, in its enclave."""
        run = ("sros", "run", str(folder / "export"))
        if not self.launch:
            words = shlex.join((*run, self.enclave, "--", *self.command))
        else:
            prefix = shlex.join((*run, "--policy", str(folder / "policy.xml"), "--"))
            after = launch_verb(tuple(self.launch)) + 1
            words = shlex.join(
                (*self.launch[:after], "--launch-prefix", prefix, *self.launch[after:])
            )
            # A node to which the launch file gives a prefix of its own does not start.
            words = f"{ENABLE}=true {STRATEGY}=Enforce {KEYSTORE}= {words}"
        return f"cd {shlex.quote(self.folder)} && {words}"


class ObservedProcesses(NamedTuple):
    """The processes of an open robot, and what sros cannot start in an enclave."""

    domain: int
    """The ROS domain."""
    processes: Sequence[ClosedProcess] = ()
    """The processes with an enclave each."""
    unknown: Sequence[str] = ()
    """Processes on this machine whose nodes are not known; they are not closed."""
    elsewhere: Sequence[str] = ()
    """Enclaves with nodes that no process of this machine is known to have: also if another process
    has nodes of the same names."""

    def within(self, policy: Policy) -> ObservedProcesses:
        """Return a copy without enclaves that the policy does not have any more."""
        names = {enclave.path for enclave in policy.enclaves}
        return self._replace(
            processes=[process for process in self.processes if process.enclave in names],
            elsewhere=[enclave for enclave in self.elsewhere if enclave in names],
        )

    def by_hand(self, folder: Path) -> Mapping[str, Sequence[ClosedProcess]]:
        """Map the shell commands for what no unit of systemd starts alone to its processes."""
        commands: dict[str, list[ClosedProcess]] = {}
        for process in self.processes:
            if not process.unit:
                commands.setdefault(process.secured_command(folder), []).append(process)
        return commands


class CloseStep(NamedTuple):
    """A step of closing a robot."""

    command: str
    """The command line that does the same."""
    state: Annotated[str, Words(("done", "kept", "findings", "open"))]
    """Whether the step was done, its result was there and kept, it found something, or it is not
    done."""


class Proof(NamedTuple):
    """A claim about the closed robot."""

    claim: str
    """What has to hold."""
    holds: bool | None
    """Whether it holds; null if it could not be asked."""
    reason: str
    """What was seen, or why it could not be asked."""

    @property
    def fails(self) -> bool:
        """Whether it was asked, and does not hold."""
        return self.holds is False


@shows(spread=("observed",))
class Closing(NamedTuple):
    """How far a robot is closed."""

    folder: Path
    """The folder with everything that was made."""
    observed: ObservedProcesses
    steps: Sequence[CloseStep]
    """The steps in their order."""
    denied: Sequence[str]
    """What the observed nodes do and the keystore denies them, as sentences."""
    problems: Sequence[str]
    """Reasons why the robot is not closed yet, with what to do."""
    proofs: Sequence[Proof]
    """The proof that the robot is closed; empty before."""
    dry_run: DryRun
    changes: FileChanges


# ── processes ───────────────────────────────────────────────────────────────────────────────


def assign(
    nodes: Iterable[ObservedNode], running: Iterable[Process], domain: int
) -> ObservedProcesses:
    """Return the enclave of each running process, by the nodes that the graph shows of it.

    Processes of other domains or networks are left out.
    """
    left = {
        process.pid: process
        for process in running
        if process.domain == str(domain) and not process.network and not process.is_daemon
    }
    origins = {pid: process_origin(pid) for pid in left}
    units = Counter(origin.unit for origin in origins.values())
    by_enclave: dict[str, list[ObservedNode]] = {}
    for node in nodes:
        by_enclave.setdefault(node.enclaves[0], []).append(node)
    assigned: list[ClosedProcess] = []
    for known_by, shows_node in _KNOWN_BY.items():
        without = sorted(by_enclave.keys() - {process.enclave for process in assigned})
        if known_by == "elimination" and len(without) > 1:
            continue
        for enclave in without:
            of_enclave = by_enclave[enclave]
            processes = [
                process
                for process in left.values()
                if any(shows_node(process, node) for node in of_enclave)
            ]
            if len(processes) > len({node.participant for node in of_enclave}):
                continue  # it is not clear which of them
            for process in processes:
                del left[process.pid]
                unit, folder, launch = origins[process.pid]
                alone = unit if units[unit] == 1 else ""
                start = enclave, process.pid, process.command, folder, process.user
                assigned.append(ClosedProcess(*start, alone, known_by, launch))
    return ObservedProcesses(
        domain,
        sorted(assigned),
        [f"{process.label}: {shlex.join(process.command)}" for process in left.values()],
        sorted(
            enclave
            for enclave, of_enclave in by_enclave.items()
            if len({_process_of(node) for node in of_enclave})
            > sum(process.enclave == enclave for process in assigned)
        ),
    )


def _process_of(node: ObservedNode) -> str:
    """Return what the participants of a process have in common: Fast DDS shows host and id."""
    is_fast = node.participant.startswith(_FAST_DDS)
    return node.participant[:12] if is_fast else node.participant


def _shows_its_id(process: Process, node: ObservedNode) -> bool:
    low, high = process.pid & 0xFF, process.pid >> 8 & 0xFF
    return (
        node.participant.startswith(_FAST_DDS)
        and node.participant[8:12] == f"{low:02x}{high:02x}"
        and bool(process.libraries & {"libfastrtps", "libfastdds"})
    )


def _is_named(process: Process, node: ObservedNode) -> bool:
    return node_argument(process.command) == (node.ns, node.name)


def _is_its_program(process: Process, node: ObservedNode) -> bool:
    return program_of(process.command).removesuffix(".py") == node.name


_KNOWN_BY: dict[str, Callable[[Process, ObservedNode], bool]] = {
    "process id": _shows_its_id,
    "node name": _is_named,
    "program": _is_its_program,
    "elimination": lambda _process, _node: True,
}


def read_processes(path: Path) -> ObservedProcesses:
    """Return the processes in a file that `assign` filled.

    Raises:
        DocumentError: The file cannot be read.
    """
    try:
        value = json.loads(read_bytes(path, "list of processes"))
        processes = [ClosedProcess(**process) for process in value["processes"]]
        for process in processes:
            texts = (process.enclave, process.folder, *process.command, *process.launch)
            if not all(isinstance(text, str) for text in texts):
                raise ValueError(f"{texts} are not all text")
            if process.unit and not re.fullmatch(SERVICE_NAME, process.unit, re.A):
                raise ValueError(f"{process.unit!r} is no service")
        return ObservedProcesses(**value)._replace(processes=processes)
    except (ValueError, TypeError, KeyError) as error:
        raise DocumentError(
            f"'{path}' is no list of processes", f"{error}", "Remove it, to watch the robot again."
        ) from error


def processes_document(observed: ObservedProcesses) -> bytes:
    """Return the file that `read_processes` reads."""
    return f"{json.dumps(as_plain(observed), indent=2)}\n".encode()


# ── how they are started ────────────────────────────────────────────────────────────────────


def mark(folder: Path) -> str:
    """Return the first line of each drop-in that is made for a folder."""
    return f"# Made by `sros close {folder}`; undone by its --undo.\n"


def start_files(
    folder: Path, observed: ObservedProcesses, variables: Mapping[str, Mapping[str, str]]
) -> dict[str, str]:
    """Map the paths of the files that say how to start each process secured to their content.

    ``folder`` is absolute, and ``variables`` maps enclaves to their environment.
    """
    files = {
        f"{unit_instance(enclave)}.env": render_environment(of_enclave, "docker")
        for enclave, of_enclave in variables.items()
    }
    for process in observed.processes:
        if process.unit:
            text = render_environment(variables[process.enclave], "systemd")
            files[f"units/{process.unit}.d/{DROP_IN}"] = f"{mark(folder)}[Service]\n{text}"
    lines = [
        "# No script: stop all of these processes (secured and open ones do not hear each other),",
        "# and start each by its command, where it is started now: a start script, a terminal.",
    ]
    for command, processes in observed.by_hand(folder).items():
        lines += ["", f"# {', '.join(process.enclave for process in processes)}", command]
    return {**files, COMMANDS: "".join(f"{line}\n" for line in lines)}


# ── who may do what ─────────────────────────────────────────────────────────────────────────


def access_lines(policy: Policy, folder: Path, shipped: Path) -> list[str]:
    """Return a line for each name in a policy, with who uses it on either side.

    Rights that every node needs are left out; they are those of the common parts.
    """
    common = common_parts(folder, shipped)
    parts = [part for part in _NODE_PARTS if part in common.rights]
    ordinary = {
        (enclave.path, right.right, right.name)
        for enclave in policy.enclaves
        for profile in enclave.all_profiles()
        for right in common.given(parts, profile.ns, profile.node)
    }
    sides: dict[tuple[str, str], dict[str, list[str]]] = {}
    for right in sorted(policy_rights(policy)):
        if right.kind in RIGHTS and (right.enclave, right.right, right.name) not in ordinary:
            of_name = sides.setdefault((right.kind, right.name), {})
            of_name.setdefault(right.right, []).append(right.enclave)
    lines = [
        f"{kind.removesuffix('s')} {name}: {' -> '.join(_users(of_name, e) for e in RIGHTS[kind])}"
        for (kind, name), of_name in sorted(sides.items(), key=_two_sided_first)
    ]
    more = len(lines) - _MOST_LINES
    return [*lines[:_MOST_LINES], *([f"and {more} more names"] if more > 0 else [])]


def _two_sided_first(side: tuple[tuple[str, str], Mapping[str, object]]) -> tuple[int, int, str]:
    (kind, name), of_name = side
    return -len(of_name), [*RIGHTS].index(kind), name


def _users(of_name: Mapping[str, Sequence[str]], right: str) -> str:
    return first_few(of_name.get(right, ()), _MOST_NAMES) or "nobody"


# ── the proof ───────────────────────────────────────────────────────────────────────────────


def lost_endpoints(
    before: Observation, now: Observation, denied: Iterable[DeniedRight]
) -> list[str]:
    """Return what nodes did before, are not ``denied``, and do not do now, as text."""
    expected = {*_endpoints(before.nodes)} - {
        f"{node} {way} {topic}"
        for right in denied
        for node in right.nodes
        for topic, way in right.endpoints
    }
    return sorted(expected - {*_endpoints(now.nodes)})


def _endpoints(nodes: Iterable[ObservedNode]) -> Iterator[str]:
    for node in nodes:
        name = f"{node.ns.rstrip('/')}/{stable_name(node.name)}"
        for way in (PUBLISH, SUBSCRIBE):
            for topic in node.publish if way == PUBLISH else node.subscribe:
                yield f"{name} {way} {topic.replace(node.name, stable_name(node.name))}"
