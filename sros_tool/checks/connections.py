"""Which processes of Fast DDS have connected to each other, as their shared memory shows it.

A process of Fast DDS receives from the processes of its machine through a port in shared memory. A
process that sends to it maps this port. Every node of rmw_fastrtps sends its part of the ROS graph
to all others as soon as they have accepted its certificate. So two processes that have not mapped
each other's port do not hear each other.

Sources: Fast DDS 2.6.9 to 3.6.0 (SharedMemGlobal.hpp, SecurityManager.cpp). Fast DDS gives up
after ten messages of the handshake (14 s), without a line in the log, and does not try again as
long as both processes run.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from datetime import datetime, timedelta
from itertools import combinations
from typing import NamedTuple

from sros_tool.checks.kind import ERROR, WARNING, Finding, FindingKind
from sros_tool.dds.decision.vendors import FAST_DDS
from sros_tool.runtime.logind import users_without_linger
from sros_tool.runtime.processes import MemoryPort, Process, plain
from sros_tool.wording import counted, enumerated, first_few

CONNECTING_TIME = timedelta(seconds=30)
"""Time after the start of a process in which it should have connected to the others."""

PROCESS_NOT_CONNECTED = FindingKind(
    "runtime.process-not-connected",
    WARNING,
    "secured processes that have not connected to each other",
    "They do not hear each other, and do not log why. Fast DDS gives up if the handshake takes "
    "longer than 14 s, as on a busy machine, and does not try again.",
    "Fast DDS 2.6 to 3.6 (SecurityManager.cpp); tested with 2.14.5.",
    "If another finding names one of these processes, first do what that finding says. "
    "Otherwise, restart the process that this finding names. If this does not help, the program "
    "may turn security off in its own environment (such as `os.environ` in Python): the proof of "
    "a closed robot (docs/close.md, The proof) sees a node that runs open.",
    vendors=FAST_DDS,
)
PROCESS_LOST_MEMORY = FindingKind(
    "runtime.process-lost-memory",
    ERROR,
    "a process whose shared memory was removed",
    "It neither hears the other processes nor reaches them, and does not log why. By default, "
    "systemd removes the shared memory of a user at the end of the user's last session, also the "
    "memory that units of this user use.",
    "logind.conf(5) (RemoveIPC); Fast DDS 2.6 to 3.6 (SharedMemGlobal.hpp); tested with 2.14.5.",
    "Stop all processes that this finding names, and then start them again.",
    vendors=FAST_DDS,
)
_REMEDY_FOR_USERS = (
    "Run these processes as one user, or start the processes of one of the users with "
    "FASTDDS_BUILTIN_TRANSPORTS=UDPv4 (ROS 2 Jazzy and newer): Fast DDS cannot use the shared "
    "memory of another user."
)
_MOST_NAMES = 4


class Connections(NamedTuple):
    """The connections between processes of one machine.

    ``deaf`` are the processes that are stopped or lost their shared memory, and ``missing`` the
    pairs of other processes that do not hear each other. ``compared`` are the processes that sros
    can compare with each other; ``unknown`` are processes whose connections sros cannot see.
    """

    deaf: Sequence[Process]
    missing: Sequence[tuple[Process, Process]]
    compared: Sequence[Process]
    unknown: Sequence[Process]

    @property
    def are_settled(self) -> bool:
        """Whether waiting changes nothing: a process is deaf for good, or all have connected."""
        return bool(self.deaf) or not (self.missing or (self.compared and self.unknown))


class _Place(NamedTuple):
    """Where processes connect: a network namespace, a shared memory and a domain."""

    network: str
    memory: str
    domain: int


def connections_between(processes: Iterable[Process]) -> Connections:
    """Return the connections between processes that run the nodes of one robot."""
    deaf, processes = _divided_by_hearing(processes)
    ports = {process.pid: _ports_by_place(process) for process in processes}
    number = Counter(place for by_place in ports.values() for place in by_place)
    main = max(number, key=lambda place: number[place], default=None)
    missing = [
        (first, second)
        for first, second in combinations(processes, 2)
        if any(
            not ports[first.pid][place] <= second.mapped_ports
            or not ports[second.pid][place] <= first.mapped_ports
            for place in ports[first.pid].keys() & ports[second.pid].keys()
        )
    ]
    return Connections(
        deaf,
        missing,
        compared=[process for process in processes if main in ports[process.pid]],
        unknown=[process for process in processes if main not in ports[process.pid]],
    )


def _divided_by_hearing(processes: Iterable[Process]) -> tuple[list[Process], list[Process]]:
    """Return the processes that are stopped or lost their shared memory, and the others."""
    divided: tuple[list[Process], list[Process]] = [], []
    for process in processes:
        divided[not (process.is_stopped or process.lost_memory)].append(process)
    return divided


def _ports_by_place(process: Process) -> Mapping[_Place, set[MemoryPort]]:
    """Return the ports on which a process receives the data of nodes."""
    ports: dict[_Place, set[MemoryPort]] = {}
    for port in process.own_ports:
        if port.domain is not None:
            place = _Place(process.network, port.memory, port.domain)
            ports.setdefault(place, set()).add(port)
    return ports


def restarts(missing: Sequence[tuple[Process, Process]]) -> Iterator[tuple[Process, list[Process]]]:
    """Yield processes whose restart can connect all pairs, each with its peers.

    Takes the process with the most missing connections first, so that few have to restart.
    """
    pairs = [*missing]
    while pairs:
        number = Counter(process.pid for pair in pairs for process in pair)
        (pid, _), *_ = number.most_common(1)
        of_process = [pair for pair in pairs if any(process.pid == pid for process in pair)]
        process = next(process for process in of_process[0] if process.pid == pid)
        yield process, [first if second is process else second for first, second in of_process]
        pairs = [pair for pair in pairs if pair not in of_process]


def with_time_to_connect(processes: Iterable[Process], now: datetime) -> Iterator[Process]:
    """Yield the processes that had enough time to connect."""
    return (process for process in processes if process.started + CONNECTING_TIME <= now)


def connection_findings(missing: Sequence[tuple[Process, Process]]) -> Iterator[Finding]:
    """Yield findings about secured processes that trust the same CA, and are not connected."""
    for process, peers in restarts(missing):
        names = first_few([process_name(peer) for peer in peers], _MOST_NAMES)
        text = f"it has not connected to {names}: they do not hear each other"
        yield PROCESS_NOT_CONNECTED.found(
            process_name(process), text, remedy=_remedy(process, peers)
        )


def lost_memory_findings(processes: Iterable[Process]) -> Iterator[Finding]:
    """Yield a finding for each process that lost its shared memory."""
    for process in processes:
        if process.lost_memory:
            if process.is_stopped:  # it opens the files again when it continues
                text = "it is stopped (SIGSTOP), and files of its shared memory were removed"
                remedy = f"{_continuing([process])}."
            else:
                text = "files of its shared memory (/dev/shm) were removed while it runs: it hears "
                text += "nothing"
                remedy = f"{_linger_advice([process])}{PROCESS_LOST_MEMORY.remedy}"
            yield PROCESS_LOST_MEMORY.found(process_name(process), text, remedy=remedy)


def _linger_advice(deaf: Iterable[Process]) -> str:
    """Return a sentence on keeping the shared memory of users who log in; "" if it is kept."""
    names = users_without_linger(process.user for process in deaf)
    if not names:
        return ""
    linger = enumerated([f"`loginctl enable-linger {name}`" for name in names])
    return (
        f"If {enumerated(names)} also log{'s' * (len(names) == 1)} in, first run {linger}, "
        "because systemd removes the shared memory of a user who logs out. "
    )


def not_connected_text(connections: Connections) -> str:
    """Return text on processes that do not hear each other, with the remedy.

    Stopped processes come first, then those that lost their shared memory; "" if all have
    connected.
    """
    missing = connections.missing
    if stopped := [process for process in connections.deaf if process.is_stopped]:
        names = first_few([*map(process_name, stopped)], _MOST_NAMES)
        are, hear = ("is", "hears") if len(stopped) == 1 else ("are", "hear")
        return f"{names} {are} stopped (SIGSTOP), and {hear} nothing. {_continuing(stopped)}"
    if deaf := connections.deaf:
        names = first_few([*map(process_name, deaf)], _MOST_NAMES)
        is_one = len(deaf) == 1
        lost, hear = ("has lost its", "hears") if is_one else ("have lost their", "hear")
        restart = "Stop it, and start it again"
        if not is_one:
            restart = "Stop all of them before you start the first one again"
        return (
            f"{names} {lost} shared memory (its files in /dev/shm were removed), and {hear} "
            f"nothing. {_linger_advice(deaf)}{restart}"
        )
    if not missing:
        return ""
    first, second = map(process_name, missing[0])
    more = f" and {counted(len(missing) - 1, 'other pair')}" if missing[1:] else ""
    to_restart = [*restarts(missing)]
    remedy = next(filter(None, (_remedy(process, peers) for process, peers in to_restart)), "")
    if not remedy:
        names = enumerated([process_name(process) for process, _ in to_restart])
        remedy = (
            f"restart {names}{', one after the other' * (len(to_restart) > 1)}, and check again"
        )
    return f"{first} and {second}{more} do not hear each other; {remedy[0].lower()}{remedy[1:]}"


def _continuing(stopped: Iterable[Process]) -> str:
    pids = " ".join(str(process.pid) for process in stopped)
    return f"Continue with `kill -CONT {pids}`, and check again"


def _remedy(process: Process, peers: Iterable[Process]) -> str:
    """Return the remedy for processes of several users; "" otherwise."""
    return _REMEDY_FOR_USERS if {peer.user for peer in peers} != {process.user} else ""


def process_name(process: Process) -> str:
    """Return the name of a process in messages, with its enclave."""
    return f"{process.label}{f' in {plain(process.enclave.name)}' if process.enclave else ''}"
