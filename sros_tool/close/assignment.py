"""Decide which running process has the nodes of which enclave.

A process of Fast DDS shows its process id in the identifier of its DDS participant (two bytes of
the GUID prefix; Fast DDS 2.6 to 3.6, ``GuidUtils.hpp``), and a process of Cyclone DDS states it in
a property of its participant (``__Pid``; Cyclone DDS 0.10 to 11.0).  Other processes are known by
the name that their command gives the node, or by the name of their program.  A wrong guess is safe:
the middleware denies the process what its enclave may not do.
"""

from __future__ import annotations

import json
import subprocess
import sys
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress

from sros_tool.close.processes import (
    ROUTER,
    ClosedProcess,
    ObservedProcesses,
    is_in_domain,
    process_text,
)
from sros_tool.errors import UsageError
from sros_tool.graph.observation import FAST_DDS, ObservedNode
from sros_tool.runtime.environment import node_argument
from sros_tool.runtime.processes import Process, ProcessOrigin, process_origin, program_of
from sros_tool.runtime.unit_properties import unit_properties
from sros_tool.runtime.units import unit_words

_CYCLONE_SECONDS = 30.0


def assign(
    nodes: Iterable[ObservedNode],
    running: Iterable[Process],
    domain: int,
    process_ids: Mapping[str, int] | None = None,
    origins: Mapping[int, ProcessOrigin] | None = None,
) -> ObservedProcesses:
    """Return the enclave of each process, by the nodes of the process in the graph.

    Processes of other domains or networks are left out.  ``process_ids`` maps participants of
    Cyclone DDS to the process ids that they state; ``origins`` maps processes to their origins; by
    default, the origins are read from the running processes.
    """
    # A process may have run several programs: the last one counts.
    by_pid = {process.pid: process for process in running}
    candidates = [
        process
        for process in by_pid.values()
        if is_in_domain(process, domain) and not process.is_daemon
    ]
    if origins is None:
        origins = {process.pid: process_origin(process.pid) for process in candidates}
    by_enclave: dict[str, list[ObservedNode]] = {}
    for node in nodes:
        by_enclave.setdefault(node.enclaves[0], []).append(node)
    claims = _assignments_by_evidence(candidates, by_enclave, process_ids or {})
    units = Counter(
        {process.program[0]: origins[process.pid].unit for process in candidates}.values()
    )
    assigned = []
    for process, enclave, known_by in claims:
        origin = origins[process.pid]
        if units[origin.unit] != 1:  # the unit starts several processes
            origin = origin._replace(unit="")
        assigned.append(ClosedProcess.from_process(process, enclave, origin, known_by))
    known = {process.pid for process, _, _ in claims} | {closed.pid for closed in assigned}
    counts = Counter(closed.enclave for closed in assigned)
    return ObservedProcesses(
        domain,
        processes=sorted(_with_shared_programs(assigned)),
        unknown=[process_text(process) for process in candidates if process.pid not in known],
        elsewhere=sorted(
            enclave
            for enclave, observed_nodes in by_enclave.items()
            if len({node.process for node in observed_nodes}) > counts[enclave]
        ),
    )


def _with_shared_programs(assigned: Sequence[ClosedProcess]) -> Iterator[ClosedProcess]:
    """Yield processes; each names the other enclaves for which its program runs, too."""
    enclaves: dict[int, set[str]] = {}
    for process in assigned:
        enclaves.setdefault(process.pid, set()).add(process.enclave)
    for process in assigned:
        yield process._replace(shares=sorted(enclaves[process.pid] - {process.enclave}))


def _assignments_by_evidence(
    processes: Sequence[Process],
    by_enclave: Mapping[str, Sequence[ObservedNode]],
    process_ids: Mapping[str, int],
) -> list[tuple[Process, str, str]]:
    """Return (process, enclave, kind of evidence) for processes, by the most reliable evidence.

    If more processes have the same evidence for an enclave than the enclave has participants, this
    evidence is ignored.
    """
    claims = [(process, ROUTER, "program") for process in processes if process.is_router]
    for known_by, shows_node in _EVIDENCE_CHECKS.items():
        unassigned = sorted(by_enclave.keys() - {enclave for _, enclave, _ in claims})
        if known_by == "elimination" and len(unassigned) > 1:
            continue
        for enclave in unassigned:
            claimed = {process.pid for process, _, _ in claims}
            nodes = by_enclave[enclave]
            candidates = [
                process
                for process in processes
                if process.pid not in claimed
                and any(shows_node(process, node, process_ids) for node in nodes)
            ]
            if len(candidates) <= len({node.participant for node in nodes}):
                claims += [(process, enclave, known_by) for process in candidates]
    return claims


def _states_process_id(
    process: Process, node: ObservedNode, process_ids: Mapping[str, int]
) -> bool:
    """Return whether the identifier or the property of a node's participant has the process id."""
    pid = process.own_pid or process.pid
    if not node.participant.startswith(FAST_DDS):
        return process_ids.get(node.participant) == pid
    low, high = pid & 0xFF, pid >> 8 & 0xFF
    is_fast = bool(process.libraries & {"libfastrtps", "libfastdds"})
    return is_fast and node.participant[8:12] == f"{low:02x}{high:02x}"


def _is_named_by_command(process: Process, node: ObservedNode, _process_ids: object) -> bool:
    """Return whether the command gives the node its name and namespace."""
    return node_argument(process.command) == (node.ns, node.name)


def _is_program_named_like_node(process: Process, node: ObservedNode, _process_ids: object) -> bool:
    """Return whether the program has the name of the node."""
    return program_of(process.command).removesuffix(".py") == node.name


_EVIDENCE_CHECKS: dict[str, Callable[[Process, ObservedNode, Mapping[str, int]], bool]] = {
    "process id": _states_process_id,
    "node name": _is_named_by_command,
    "program": _is_program_named_like_node,
    "elimination": lambda _process, _node, _process_ids: True,
}


def process_ids_of_cyclone(pids: Sequence[int], domain: int) -> Mapping[str, int]:
    """Map participants of Cyclone DDS to the process ids that they state.

    ``pids`` are the ids of processes on Cyclone DDS.  The result is empty without such processes,
    or if the participants cannot be read.
    """
    if not pids:
        return {}
    command = [
        sys.executable,
        "-P",
        "-m",
        "sros_tool.runtime.cyclone",
        f"{domain}",
        *map(str, pids),
    ]
    with suppress(ValueError, subprocess.TimeoutExpired):
        ended = subprocess.run(command, capture_output=True, check=False, timeout=_CYCLONE_SECONDS)
        value: Mapping[str, int] = json.loads(ended.stdout)
        return value
    return {}


def ended_processes(
    nodes: Iterable[ObservedNode],
    ran: Iterable[tuple[Process, ProcessOrigin]],
    observed: ObservedProcesses,
) -> list[ClosedProcess]:
    """Return the processes that ended while sros watched, with the nodes that they ran.

    ``ran`` are the ended processes, with their origins. If an enclave had several commands, its
    processes are left out, because one of them may be another program that took the node's
    name.  ``observed`` are the processes that still run; their units are taken to have started none
    of the ended processes.
    """
    origins = {process.pid: origin for process, origin in ran}
    units_in_use = observed.units
    ended = assign(nodes, [process for process, _ in ran], observed.domain, {}, origins)
    commands = Counter(process.enclave for process in ended.processes)
    return [
        process._replace(pid=0, unit="" if process.unit in units_in_use else process.unit)
        for process in ended.processes
        # Many tools end while sros watches, so elimination shows nothing.
        if commands[process.enclave] == 1 and process.known_by != "elimination"
    ]


def with_command_of_unit(process: ClosedProcess) -> ClosedProcess:
    """Return a process with the command of its unit, to which an argument can be added.

    If the unit starts another command, such as a script, return the process without its unit.  A
    process that has no unit, or needs no argument, does not change.
    """
    if not (process.unit and process.lacks_enclave_argument):
        return process
    shown = unit_properties(process.unit, "ExecStart").get("ExecStart", "")
    with suppress(UsageError):  # some words cannot be written in a unit
        for words in (process.command, process.command[1:]):
            if f"; argv[]={' '.join(words)} ;" in shown and [*unit_words(words)]:
                return process._replace(command=words)
    return process._replace(unit="")
