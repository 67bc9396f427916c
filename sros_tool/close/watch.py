"""Watch an open robot: its nodes, their processes, and the origins of the processes."""

from __future__ import annotations

import json
import os
import re
import shlex
import threading
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress

from sros_tool.close.assignment import (
    assign,
    ended_processes,
    process_ids_of_cyclone,
    with_command_of_unit,
)
from sros_tool.close.nodes import ObservedNodes, node_name, nodes_text
from sros_tool.close.processes import ObservedProcesses
from sros_tool.close.robot import MOST_NAMES, LocalRobot
from sros_tool.close.state import RunningRobot, keystore_text
from sros_tool.errors import UnavailableError, UsageError
from sros_tool.explain.explanation import likely_meaning
from sros_tool.files import policies_dir, remove_file, replace_file
from sros_tool.graph.learn import common_parts, robot_nodes
from sros_tool.graph.observation import ObservedNode, make_observation, observation_from_json
from sros_tool.names import expand, is_expression
from sros_tool.policy.document import read_policy
from sros_tool.policy.merge import plan_merge
from sros_tool.policy.model import ALLOW, Policy
from sros_tool.policy.rights import Right, policy_rights
from sros_tool.runtime.environment import RMW_ZENOH
from sros_tool.runtime.processes import Process, ProcessOrigin, ProcessTable, process_origin
from sros_tool.runtime.rmw import RMW
from sros_tool.runtime.variables import DOMAIN
from sros_tool.wording import counted, enumerated, first_few

_LOOK_SECONDS = 1.0
"""Seconds between two looks at the processes; a process that runs for less can be missed."""
_MOST_COMMANDS = 10_000
"""Number of commands of processes that are kept; of others, the start command is not known."""
_SHELL_VARIABLES = re.compile(
    r"_|SHLVL|PWD|OLDPWD|COLUMNS|LINES|PS[0-4]|PROMPT_COMMAND|HIST\w+|TERM\w*|COLORTERM|LS_COLORS"
    r"|LESS(OPEN|CLOSE)|debian_chroot|VIRTUAL_ENV_PROMPT"
    rf"|INVOCATION_ID|JOURNAL_STREAM|SYSTEMD_EXEC_PID|MEMORY_PRESSURE_\w+|{DOMAIN}"
    r"|DBUS_SESSION_BUS_ADDRESS|XDG_(RUNTIME_DIR|SESSION_\w+|SEAT|VTNR)|SSH_\w+|SUDO_\w+|MAIL"
)
"""Matches variables that differ between shells, that interactive shells, systemd or the start
commands set.
"""

_StartedProcesses = dict[tuple[str, ...], tuple[Process, ProcessOrigin]]
"""Processes by their commands, with what started them."""


def check_watchable(robot: LocalRobot) -> None:
    """Raise `SrosError` if the robot cannot be watched as an open robot."""
    robot.shell.check_open()
    rmw = robot.shell.environment.get(RMW)
    running = RunningRobot(robot)
    if secured := [process.label for process, _ in running.secured]:
        raise UsageError(
            f"the robot runs closed: {first_few(secured, MOST_NAMES)}",
            "Only an open robot can be watched.",
            f"Leave the robot closed, and add the missing rights to '{robot.policy}': `sros "
            f"explain {shlex.quote(str(robot.export))} --log FILE` names them. "
            f"To watch the whole robot again, open it first: `{robot.close_command} --undo`.",
        )
    nodes = [process for process in running.in_domain if not process.is_daemon]
    on_zenoh = [process for process in nodes if process.is_zenoh]
    if on_zenoh and rmw != RMW_ZENOH:
        raise UsageError(
            f"{on_zenoh[0].label} speaks Zenoh, but this shell is set up for DDS",
            "",
            f"Run `export {RMW}={RMW_ZENOH}`. Then run this command again.",
        )
    if nodes and not on_zenoh and rmw == RMW_ZENOH:
        raise UsageError(
            f"{nodes[0].label} speaks DDS, but this shell is set up for Zenoh",
            "",
            f"Run `unset {RMW}`, or set it to the RMW of the robot. Then run this command again.",
        )


def watch(robot: LocalRobot, words: Sequence[str]) -> list[str]:
    """Watch the robot with a command of sros, and write its nodes and processes into the folder.

    ``words`` are the words of the command (`generate_policy`).

    Return sentences on nodes without an enclave, and on observed rights that the existing policy
    lacks.

    Raises:
        SrosError: no node was observed.
    """
    with _recorded_processes(robot) as started:
        status, document, _ = robot.shell.run(words, True)
    running = RunningRobot(robot)
    enclaves = [process.enclave for process in running.in_domain if process.enclave]
    closed = [
        f"Processes run with the files of '{files}': if that is the robot, name its folder, not "
        f"'{robot.folder}'"
        for files in sorted({*map(keystore_text, enclaves)})[:1]
    ]
    if status:
        others = ". ".join(filter(None, (running.other_domains_text(), *closed)))
        raise UnavailableError(
            f"there is no robot to close: no node was observed in domain {robot.domain}",
            f"{others}." if others else "",
            f"{'Otherwise start' if others else 'Start'} the robot open. Then run "
            "this command again.",
        )
    replace_file(robot.observer, (policies_dir() / "observer.xml").read_bytes())
    learned = json.loads(document)
    all_nodes = observation_from_json(learned).nodes
    observed_nodes = ObservedNodes(robot, all_nodes)
    nodes = robot_nodes(observed_nodes.in_their_enclaves)
    observed = _observed_processes(running, nodes, learned["ended"], started)
    _write_observation(robot, document, observed)
    _show_variables(running, observed)
    number = counted(len(observed.processes), "process", "processes")
    robot.shell.say(f"saw {nodes_text(nodes)}, and {number} of this machine")
    if not learned["settled"]:
        robot.shell.say(
            f"nodes or endpoints may be missing in '{robot.policy}': the ROS graph still changed "
            "at the end, or could not be read in time; when the whole robot runs, watch again: "
            f"{robot.close_command} --for 5m"
        )
    if others := running.other_domains_text():
        robot.shell.say(others)
    if os.path.lexists(robot.observed_policy):  # a file of an earlier watch
        remove_file(robot.observed_policy)
    without_enclave = [node.fqn for node in robot_nodes(all_nodes) if not node.enclaves]
    problems = [_text_on_nodes_without_enclave(robot, without_enclave)] if without_enclave else []
    problems += closed if not robot.keystore.exists() else []
    lacking = ""
    if learned["dry_run"]:
        lacking = _lacking_text(robot, nodes, observed_nodes.renamed_nodes)
    return problems + [lacking] * bool(lacking)


@contextmanager
def _recorded_processes(robot: LocalRobot) -> Iterator[_StartedProcesses]:
    """Record all processes that run during the ``with`` body, and the origins of the processes."""
    table, is_over = ProcessTable(), threading.Event()
    started: _StartedProcesses = {}

    def look() -> None:
        for process in RunningRobot(robot, table.look(robot.shell.now())).in_domain:
            before, origin = started.get(process.command, (process, None))
            if before.pid != process.pid or origin is None:
                origin = process_origin(process.pid)
            if process.command in started or len(started) < _MOST_COMMANDS:
                started[process.command] = process, origin

    def look_until_over() -> None:
        while True:
            with suppress(OSError):  # the next look may succeed
                look()
            if is_over.wait(_LOOK_SECONDS):
                return

    looking = threading.Thread(target=look_until_over)
    looking.start()
    try:
        yield started
    finally:
        is_over.set()
        looking.join()


def _write_observation(robot: LocalRobot, document: str, observed: ObservedProcesses) -> None:
    """Write the observation, and the processes, including earlier ones that do not run now.

    Raises:
        UsageError: an option names an enclave that the robot does not have.
    """
    enclaves_here = observed.enclaves
    not_here = (robot.not_here - enclaves_here).union(robot.named_elsewhere)
    if robot.observed is None:  # otherwise checked before the watch
        robot.check_machines()
    if returned := sorted(robot.not_here - not_here):
        robot.named_here = [*robot.named_here, *returned]
        robot.shell.say(
            f"as with --here, this machine has {enumerated(returned)} again, because the watch saw "
            "a process of it here"
        )
    # A process that does not run now is still started by its remembered command.
    absent = robot.policy_enclaves() - enclaves_here - not_here
    kept = [process for process in robot.processes.processes if process.enclave in absent]
    remembered = observed._replace(
        processes=[*observed.processes, *kept],
        brought=robot.processes.brought,
        moved=robot.processes.moved,
    )
    replace_file(robot.observation_file, document.encode())
    robot.write_processes(remembered.belonging_elsewhere(not_here))


def _text_on_nodes_without_enclave(robot: LocalRobot, names: Sequence[str]) -> str:
    """Return a sentence that names the nodes which the graph shows without an enclave."""
    return (
        f"the identifiers of these nodes belong to secured processes: "
        f"{first_few(names, MOST_NAMES)}. '{robot.policy}' has no rights for these nodes. If "
        "they belong to the robot, start them open, and watch again: "
        f"{robot.close_command} --for 1m"
    )


def _observed_processes(
    running: RunningRobot,
    nodes: Sequence[ObservedNode],
    ended_participants: Collection[str],
    started: _StartedProcesses,
) -> ObservedProcesses:
    """Return the processes of the observed nodes, also processes that ended while sros watched."""
    processes, domain = running.in_domain, running.robot.domain
    pids = [
        process.own_pid or process.pid for process in processes if "libddsc" in process.libraries
    ]
    stayed = [node for node in nodes if node.participant not in ended_participants]
    observed = assign(stayed, processes, domain, process_ids_of_cyclone(pids, domain))
    ended = {node.enclaves[0] for node in nodes} - {node.enclaves[0] for node in stayed}
    commands = {process.command for process in processes}
    finished = ended_processes(
        [node for node in nodes if node.enclaves[0] in ended],
        [start for command, start in started.items() if command not in commands],
        observed,
    )
    with_units = [with_command_of_unit(process) for process in (*observed.processes, *finished)]
    return observed._replace(processes=with_units, ended=sorted(ended))


def _show_variables(running: RunningRobot, observed: ObservedProcesses) -> None:
    """Print variables of processes that neither their commands nor this shell set.

    Processes that a unit or a container starts keep their variables.
    """
    robot = running.robot
    rmws = {
        process.pid: process.rmw
        for process in observed.processes
        if not process.unit and not process.container
    }
    by_variables: dict[tuple[str, ...], list[str]] = {}
    for process in running.processes.processes:
        unset = process.environment.keys() - robot.shell.environment.keys()
        unset -= {RMW} if rmws.get(process.pid) else set()
        names = tuple(sorted(name for name in unset if not _SHELL_VARIABLES.fullmatch(name)))
        if process.pid in rmws and names:
            by_variables.setdefault(names, []).append(process.label)
    for names, labels in by_variables.items():
        robot.shell.say(
            f"{enumerated(labels)} {'run' if len(labels) > 1 else 'runs'} with variables that this "
            f"shell does not have, and that the start commands in {robot.commands_file} do not "
            f"set: {first_few(names, MOST_NAMES)}; before you start a process, set what it needs"
        )


def _lacking_text(
    robot: LocalRobot, nodes: Sequence[ObservedNode], renamed: Mapping[str, tuple[str, str]]
) -> str:
    """Return a sentence on rights of nodes that the policy lacks; "" if the policy has all.

    The rights that the nodes use are written into a separate policy file.  ``renamed`` are the
    nodes that the policy has by another namespace and name.
    """
    from sros_tool.graph.learn import draft, learn, write  # only after another watch

    common, policy = common_parts(robot.folder, policies_dir()), read_policy(robot.policy)
    learned = learn(make_observation(nodes), common, of_tools=True)
    lacking = plan_merge(policy, learned.policy()).added
    if not lacking:
        return ""
    write(draft(robot.observed_policy, learned, common))
    rights = [f"{right.enclave} {right.right} {right.name}" for right in lacking]
    private = tuple(f"{name}/" for name in renamed)
    others = [right for right in lacking if not right.name.startswith(private)]
    meanings = [
        *_lost_namespaces(nodes, policy),
        *_lost_names(renamed),
        *_likely_meanings(others, policy_rights(learned.policy()), policy_rights(policy)),
    ]
    files = shlex.join((str(robot.policy), str(robot.observed_policy)))
    add = f"sros merge_policy {files} --in-place"
    these = "this right" if len(rights) == 1 else "these rights"
    restart = (
        f"{first_few(meanings, MOST_NAMES)}; if the node's command is wrong, restart the node with "
        f"the right one, and watch again: {robot.close_command} --for 1m; otherwise, "
        * bool(meanings)
    )
    return (
        f"'{robot.policy}' stays as it is, and lacks {counted(len(rights), 'right')} seen now "
        f"({first_few(rights, MOST_NAMES)}); {restart}if a process should not have {these}, stop "
        f"the process, and run `{robot.close_command}`; if it needs {these}: {add}"
    )


def _likely_meanings(
    lacking: Iterable[Right], used: Collection[Right], policy: Collection[Right]
) -> Iterator[str]:
    """Yield clauses on names of a policy that probably correspond to names that the policy lacks.

    ``used`` are the rights that the nodes use, and ``policy`` the rights in the policy.
    """
    meanings = dict[str, None]()  # several enclaves may use the same name
    for right in lacking:
        allowed = (
            other
            for other in policy
            if (other.enclave, other.qualifier) == (right.enclave, ALLOW)
            and not is_expression(other.name)
        )
        meanings[likely_meaning(right, used, allowed)] = None
    yield from filter(None, meanings)


def _lost_namespaces(nodes: Sequence[ObservedNode], policy: Policy) -> Iterator[str]:
    """Yield a clause for each node that the policy has only in one other namespace.

    Namespaces in which a node of this name was seen are left out.
    """
    observed_names = {node_name(node) for node in nodes}
    namespaces: dict[str, set[str]] = {}
    for enclave in policy.enclaves:
        for profile in enclave.all_profiles():
            if not is_expression(f"{profile.ns}{profile.node}"):
                namespaces.setdefault(profile.node, set()).add(profile.ns)
    for node in nodes:
        in_policy = namespaces.get(node.name, set())
        lost = [ns for ns in in_policy if expand("~", ns, node.name) not in observed_names]
        if node.ns not in in_policy and len(lost) == 1:
            yield (
                f"perhaps {node_name(node)} is {expand('~', lost[0], node.name)}, started without "
                f"its namespace (-r __ns:={lost[0]})"
            )


def _lost_names(renamed: Mapping[str, tuple[str, str]]) -> Iterator[str]:
    """Yield a clause for each renamed node, unless only its namespace changed.

    ``renamed`` maps old full names to the namespace and name in the policy.
    """
    for old, (ns, name) in renamed.items():
        if old.rpartition("/")[2] != name:
            yield (
                f"perhaps {old} is {expand('~', ns, name)}, started without its name "
                f"(-r __node:={name})"
            )
