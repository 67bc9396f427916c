"""The verb `close`: from an open robot to a closed one, by the verbs that do each step."""

from __future__ import annotations

import io
import os
import shlex
import sys
from collections.abc import Mapping, Sequence
from contextlib import nullcontext, redirect_stderr, redirect_stdout
from datetime import datetime, timedelta
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING

import click

from sros_tool.cli.common import (
    PATH,
    domain_of,
    dry_run_option,
    json_option,
    local_zone,
    now,
    print_json,
    verb,
)
from sros_tool.close.acceptance import IN_PREPARATION, IN_PROOF, Acceptance, Acceptances
from sros_tool.errors import UsageError
from sros_tool.terminal import echo
from sros_tool.validity import iso
from sros_tool.wording import counted, enumerated, first_few

if TYPE_CHECKING:
    from sros_tool.close.processes import ClosedProcess
    from sros_tool.close.robot import LocalRobot
    from sros_tool.close.state import CloseState
    from sros_tool.policy.model import Policy


def _run(words: Sequence[str], shows_messages: bool) -> tuple[int, str, str]:
    """Run a verb of sros in this process; return its status, its output and its messages.

    With ``shows_messages``, the messages are printed as usual, and returned as "".
    """
    from sros_tool.cli.program import program

    outputs = io.BytesIO(), io.BytesIO()
    out, err = (
        io.TextIOWrapper(output, "utf-8", "surrogateescape", write_through=True)
        for output in outputs
    )
    with redirect_stderr(sys.stderr if shows_messages else err), redirect_stdout(out):
        status = program.main(list(words), prog_name="sros", standalone_mode=False)
        texts = [output.getvalue().decode("utf-8", "surrogateescape") for output in outputs]
    return (status if isinstance(status, int) else 0), texts[0], texts[1]


@verb("close")
@click.argument("folder", type=PATH)
@click.option(
    "--for",
    "duration",
    metavar="DURATION",
    help="Watch the robot for DURATION, such as 5m, even if it was watched before. [default: "
    "until the ROS graph stops changing]",
)
@click.option(
    "--domain", "domain_text", metavar="ID", help="The ROS domain. [default: $ROS_DOMAIN_ID, or 0]"
)
@click.option("--apply", is_flag=True, help="Restart the robot's systemd units with security.")
@click.option("--proof", "prove", is_flag=True, help="Prove that the robot is closed.")
@click.option(
    "--undo",
    is_flag=True,
    help="Open the robot again: remove the drop-ins of --apply, restart their systemd units, and "
    "say what is left to do by hand.",
)
@click.option(
    "--accept",
    "accept",
    type=click.Choice([word.value for word in Acceptance]),
    multiple=True,
    help="nodes: accept processes whose nodes sros does not know, nodes that belong to no process "
    "here, Zenoh routers that sros did not observe, and processes whose nodes have the same name. "
    "unexamined: accept processes that sros could not examine, such as those of other users. "
    "unobserved: accept processes in enclaves in which sros did not observe them. requirements: "
    "accept a requirements.toml that is missing or cannot be checked, and requirements on names "
    "that the policy no longer has. connections: accept processes of which sros cannot see whether "
    "they hear the others, because they do not share the memory of Fast DDS. domains: accept "
    "processes that are also in another domain, or open in another network.  Can be repeated.",
)
@click.option("--partial", is_flag=True, help="Accept everything that --accept can accept.")
@click.option(
    "--without",
    metavar="ENCLAVE",
    multiple=True,
    help="Accept that no process of ENCLAVE runs. Can be repeated.",
)
@click.option(
    "--elsewhere",
    metavar="ENCLAVE",
    multiple=True,
    help="Remember that ENCLAVE belongs to another machine, such as a laptop, and keep its key "
    "out of the export. Can be repeated.",
)
@click.option(
    "--here",
    metavar="ENCLAVE",
    multiple=True,
    help="Remember that ENCLAVE belongs to this machine again, and export it: the opposite of "
    "--elsewhere. Can be repeated.",
)
@click.option(
    "--brought",
    metavar="ENCLAVE",
    multiple=True,
    help=(
        "Remember that the other machine has the present files of ENCLAVE, and that the process "
        "there runs with them. Use the option again after these files change. Can be repeated."
    ),
)
@dry_run_option
@json_option
def close(
    folder: Path,
    duration: str | None,
    domain_text: str | None,
    apply: bool,
    prove: bool,
    undo: bool,
    accept: tuple[str, ...],
    partial: bool,
    without: tuple[str, ...],
    elsewhere: tuple[str, ...],
    here: tuple[str, ...],
    brought: tuple[str, ...],
    dry_run: bool,
    as_json: bool,
) -> int:
    """Close the robot that runs open on this machine, step by step.

    A robot is open if its processes run without security, and closed if each runs in an enclave.

    Watches the robot on DDS or Zenoh, and writes its policy and the requirements that hold now
    into FOLDER. Adds a production keystore with an enclave for each process, an export of the
    enclaves without CA keys, and the files that start each process with security. Each step is a
    command, which is printed. Existing files are kept: edit policy.xml and requirements.toml, and
    run the verb again.

    Nothing is closed before --apply, which restarts the processes that are systemd units, and shows
    the commands for all others. --proof checks that every process was started in its enclave, that
    the files have no error, that the requirements hold, that everything that talked may still talk,
    that processes on Fast DDS have connected to each other, and that an open listener finds
    nothing. --apply also proves this, if nothing is left to do by hand. --undo makes the robot open
    again.

    Example:
      $ sros close robot --for 5m
      ...
      nothing is closed yet; next: sros close robot --apply
      $ sros close robot            # after changing robot/policy.xml
      $ sros close robot --apply
      $ sros close robot --proof    # after what is left to do by hand
      $ sros close robot --undo

    Exit status: 0 if everything is prepared, the robot is proved closed, or is open again; 1 if
    something is found, is left to do by hand, or does not hold; 2 if it could not be done.
    """
    from sros_tool.close.apply import apply as apply_security
    from sros_tool.close.apply import undo as open_again
    from sros_tool.close.preparation import prepare
    from sros_tool.close.proof import prove as prove_closed
    from sros_tool.close.robot import LocalRobot, Shell
    from sros_tool.close.start_files import check_may_restart

    if sum((apply, prove, undo)) > 1:
        raise UsageError("--apply, --proof and --undo exclude each other", "", "Choose one.")
    if duration and (apply or prove or undo):
        raise UsageError("--for is for watching an open robot", "", "Leave it out.")
    if prove and dry_run:
        raise UsageError("--proof changes nothing", "", "Leave --dry-run out.")
    asked = frozenset() if undo else IN_PROOF if prove else IN_PREPARATION
    asked |= IN_PROOF if apply else frozenset()
    if useless := [f"--accept {word}" for word in accept if word not in asked]:
        raise UsageError(
            f"{enumerated(useless)} would accept nothing here",
            "",
            f"Leave {'them' if useless[1:] else 'it'} out. `nodes` is for preparing a robot and "
            "for --apply, `requirements` also for --proof, and the other words are for --apply and "
            "--proof.",
        )
    if undo and partial:
        raise UsageError("--partial would accept nothing with --undo", "", "Leave it out.")
    machines = (("--elsewhere", elsewhere), ("--here", here), ("--brought", brought))
    for option, enclaves in machines:
        if enclaves and (prove or undo):
            raise UsageError(
                f"{option} changes what the folder remembers",
                "",
                f"First run `sros close {shlex.quote(str(folder))}` with only {option}; "
                "the folder remembers it.",
            )
    shell = Shell(_run, lambda line: echo(line, err=True), os.environ, now, local_zone(os.environ))
    robot = LocalRobot(folder, domain_of(domain_text), shell, without, elsewhere, here, brought)
    can_undo = undo and robot.export.exists()  # the export shows which processes are closed
    if (apply or prove or undo) and not (robot.observed or can_undo):
        if not folder.is_dir():
            raise UsageError(
                f"there is no folder '{folder}' here",
                f"This is '{Path.cwd()}'.",
                "Name the folder of the closed robot, or change to the folder above it.",
            )
        name = shlex.quote(str(folder))
        raise UsageError(f"'{folder}' has no watched robot", "", f"Run `sros close {name}` first.")
    if not undo:
        robot.check_keystore("--apply" if apply else "--proof" if prove else "")
    if apply and not dry_run:
        check_may_restart(robot, robot.processes.units, "--apply")
    accepted = set(Acceptance) if partial else {Acceptance(word) for word in accept}
    unexamined = ""
    with nullcontext() if dry_run or prove else robot.locked():
        if undo:
            closed, unexamined = open_again(robot, dry_run=dry_run)
            if unexamined and (dry_run or as_json):
                robot.shell.say(unexamined)
        elif prove:
            closed = prove_closed(robot)
        else:
            closed = prepare(robot, duration, accepted=accepted, dry_run=dry_run)
            if apply and not closed.blocked:
                closed = apply_security(robot, closed, dry_run=dry_run)
    holds = closed.is_proved(accepted)
    if as_json:
        print_json(closed)
    elif undo:
        _show_undone(robot, closed, unexamined)
    elif closed.problems or not dry_run:
        if not (apply or prove):
            _show(robot, closed)
        _show_end(robot, closed, apply=apply, holds=holds, accepted=accepted)
    if dry_run:
        return int(bool(closed.problems) and not undo)
    return int(bool(closed.problems) or ((apply or prove) and not holds))


def _show(robot: LocalRobot, closed: CloseState) -> None:
    """Print on one screen who may do what, how processes are restarted, and what looks wrong."""
    from sros_tool.close.rights import access_lines
    from sros_tool.keystore.known_keys import revoked_entries
    from sros_tool.keystore.reader import OpenedKeystore
    from sros_tool.keystore.rights import load_rights
    from sros_tool.policy.document import read_policy
    from sros_tool.reach import unguarded_topics

    policy = read_policy(robot.policy)
    if not closed.is_signed:
        return
    echo(f"rights, without those that every node needs (all rights: {robot.page}):")
    keystore, outside = OpenedKeystore(robot.keystore), robot.enclaves_outside_policy()
    others = load_rights(keystore, only_enclaves=outside).rights
    for line in access_lines(policy, robot.folder, others):
        echo(f"  {line}")
    if outside:
        signed = ", ".join(outside)
        echo(f"  enclaves that the policy lacks, and that keep their signed rights: {signed}")
    for left_open in unguarded_topics(keystore.governance):
        does = f"{left_open.direction} DDS topic {left_open.topic}"
        echo(f"  every enclave may {does}: the governance of the keystore leaves the topic open")
    restart = "how to restart each process with security" if closed.pending else "processes"
    echo(f"{restart} (all files: {robot.start}):")
    for process in closed.observed.processes:
        echo(f"  {_process_line(process, closed, policy)}")
    for why in dict.fromkeys(closed.outdated.values()):
        names = [name for name, other in closed.outdated.items() if other == why]
        echo(f"  {why} the processes of {enumerated(names)}: restart them")
    for name, pids in closed.also_open.items():
        echo(f"  a process of {name} also runs open: {_pids_text(pids)}; stop it")
    for process_text in closed.not_observed:
        echo(f"  not observed before: {process_text}; if it does not belong to the robot, stop it")
    for name in closed.new:
        start = closed.observed.command_of_new_process(robot.export.absolute(), name)
        if name in closed.observed.ended:
            echo(f"  {name}: has ended, start it with: {start}")
            continue
        if any(f" has the name of {name}: " in problem for problem in closed.problems):
            echo(f"  {name}: new; a process with its name runs open (see below)")
            continue
        echo(
            f"  {name}: new, start it with: {start} (if it belongs to another machine: "
            f"`{robot.close_command} --elsewhere {name}`)"
        )
    if closed.secured and {*closed.new}.difference(closed.observed.ended):
        echo(
            "  if a systemd unit starts a new process, start the unit open, and run "
            f"`{robot.close_command}` again: --apply then gives the unit its enclave"
        )
    if naming := _renaming_advice(closed, policy):
        echo(naming)
    if not_here := sorted({*closed.observed.not_here}.difference(outside)):
        bring = f"sros distribute_key {shlex.quote(str(robot.keystore))} ENCLAVE FOLDER"
        echo(
            f"not on this machine: {', '.join(not_here)} (to bring an enclave to its machine: "
            f"{bring})"
        )
    revoked = {entry.enclave for entry in revoked_entries(keystore)}.difference(outside)
    if dropped := [
        name for name in robot.processes.enclaves_outside(policy) if name not in revoked
    ]:
        echo(f"the policy lacks enclaves that sros saw when it watched: {', '.join(dropped)}")
    for right in closed.newly_denied[:_MOST_DENIED]:
        echo(f"the policy now denies a right that the robot used when sros watched: {right}")
    if more := closed.newly_denied[_MOST_DENIED:]:
        echo(f"  and {counted(len(more), 'more right')} (--json has all)")
    if closed.newly_denied:
        echo(
            "  if this is a mistake, change the policy; otherwise, expect that a node without such "
            "a right may end when it starts"
        )
    for name in closed.denied_remappings:
        echo(_remapping_text(closed, name))


def _remapping_text(closed: CloseState, enclave: str) -> str:
    """Return what to change in a start command that gives a node a denied name."""
    return (
        f"the start command of {enclave} remaps to a name that the policy denies "
        f"({enumerated(closed.denied_remappings[enclave])}): change the remapping, and then "
        "restart the process"
    )


def _process_line(process: ClosedProcess, closed: CloseState, policy: Policy) -> str:
    """Return the enclave of a process, how sros knows the process, and how it is restarted."""
    from sros_tool.close.start_files import only_root_clause
    from sros_tool.close.state import unit_of_main_process, units_that_started

    restart = "by hand, with its launch file" if process.launch else "by hand"
    restart = "by hand, with Docker Compose" if process.container else restart
    if units := [process.unit] if process.unit else units_that_started([process]):
        restart += f", in {enumerated(units)}"
        if (unit := unit_of_main_process(process)) and only_root_clause([unit]):
            restart += " (as root, in a folder of root's, --apply restarts it)"
    if not process.is_by_hand:
        is_changed = process.is_idle and not process.secured_by_unit
        restart = f"--apply {'adds a drop-in to' if is_changed else 'restarts'} {process.unit}"
    runs = process.enclave in closed.secured
    if closed.secured.get(process.enclave):
        restart = "closed"
    elif runs:
        restart = f"runs {_NOT_CURRENT}: {restart}"
    if process.alike:
        state = process.pids_text
    elif process.enclave in closed.absent:
        state = "not running"
        restart += ", unless the unit was stopped"
    elif process.pid:
        # A process first seen in its enclave, but now elsewhere, was recognized by its command.
        signs = {"elimination": "because no other process is left", "enclave": "by its command"}
        sign = signs.get(process.known_by, f"by its {process.known_by}")
        state = f"process {process.pid}" + ("" if runs else f", known {sign}")
    elif runs:
        state = "was started by a new command; sros keeps the observed one: start it by that again "
        state += f"({closed.folder / 'start/commands.txt'}), or watch the open robot again"
    else:
        ended = process.enclave in closed.observed.ended
        state = "has ended" if ended else "no process runs its command"
    return f"{process.enclave}: {state}{_nodes_clause(policy, process.enclave)}: {restart}"


def _nodes_clause(policy: Policy, enclave: str) -> str:
    """Return a clause on the nodes of an enclave, if it has several; "" otherwise."""
    nodes = _node_names(policy, enclave)
    return f", for the nodes {enumerated(nodes)}" if len(nodes) > 1 else ""


def _node_names(policy: Policy, enclave: str) -> Sequence[str]:
    stated = policy.enclave(enclave)
    profiles = stated.all_profiles() if stated else ()
    return sorted(profile.full_name for profile in profiles)


def _renaming_advice(closed: CloseState, policy: Policy) -> str:
    """Return how to rename an enclave that sros named after one of its nodes.

    Returns "" after the run that made the keystore: another name might then need a restart.
    """
    several = [
        process.enclave
        for process in closed.observed.processes
        if process.enclave in (nodes := _node_names(policy, process.enclave)) and len(nodes) > 1
    ]
    is_first = any(
        step.state == "done" and step.command.startswith("sros create_keystore ")
        for step in closed.steps
    )
    if not (several and is_first):
        return ""
    folder = closed.folder
    return (
        f"sros named {enumerated(several)} after one of several nodes. To choose another name, do "
        "it before --apply: change `path=` of the enclave (not `node=`) in "
        f"{folder / 'policy.xml'}, and the name in {folder / 'requirements.toml'}. Then revoke the "
        f"earlier name: sros revoke {shlex.quote(str(folder / 'keystore'))} ENCLAVE"
    )


def _show_end(
    robot: LocalRobot,
    closed: CloseState,
    *,
    apply: bool,
    holds: bool,
    accepted: Acceptances,
) -> None:
    """Print whether the robot is closed, the reasons, and what to do next.

    ``holds`` says whether the robot is proved closed; ``apply`` is the option, and
    ``accepted`` are the claims that need not have been tested.
    """
    from sros_tool.close.start_files import only_root_clause

    folder, observed = shlex.quote(str(robot.folder)), closed.observed
    ask, details = f"sros close {folder} --proof", list[str]()
    then = f"and then {ask}"
    if not closed.denied_remappings.keys().isdisjoint(closed.pending):
        then = f"then {robot.close_command} (it remembers the changed commands), {then}"
    if apply:
        for process in observed.processes:
            if not process.is_by_hand and process.enclave in closed.denied_remappings:
                echo(_remapping_text(closed, process.enclave))
    for proof in closed.proofs:
        words = [f"--accept {word}" for word in proof.acceptances]
        accept = f" ({' or '.join(words)} accepts this)" if words else ""
        if not accepted.isdisjoint(proof.acceptances):
            accept = " (accepted)"
        answer = _ANSWERS[proof.holds]
        if proof.holds and proof.denied:
            answer += ", except for what the policy takes away"
        echo(f"{answer}{accept}: {proof.statement}: {proof.reason}")
        for detail in proof.details:
            echo(f"  {detail}")
    if closed.problems:
        echo(f"{_state_text(closed, apply=apply)}; but fix this{' first' * closed.blocked}:")
        for problem in closed.problems:
            echo(f"  {problem}")
        answer = f"next: sros close {folder}{' --apply' if apply else ''}"
        if not closed.blocked and apply:
            _show_commands_by_hand(robot, closed, only_secured=True)
            answer = f"next: do this, and then run sros close {folder} --apply"
        elif not closed.blocked:
            these = enumerated(sorted(closed.closed_units_to_restart))
            answer += f" --apply, which restarts {these} in any case"
    elif holds:
        is_asked = all(proof.holds for proof in closed.proofs)
        exceptions = "" if is_asked else ", except for the claims that were not checked"
        if missing := [name for name in closed.without if name not in closed.secured]:
            exceptions += f"; no process of {', '.join(missing)} runs"
        answer, details = f"the robot is closed{exceptions}", _validity_lines(robot, closed)
        if robot.keystore.exists():
            details.append(f"bring {folder}/keystore, which has the CA keys, to another machine")
    elif closed.proofs:
        accept = _ACCEPT_ADVICE if closed.is_proved(set(Acceptance)) else ""
        if _has_changed_command(robot, closed):
            accept = (
                f"if you changed the command of a process, run {robot.close_command} (it remembers "
                f"the command), and then {ask}; otherwise, {accept}"
            )
        next_command = f"correct the problems above, and then run sros close {folder} --proof, "
        next_command += "or go back with --undo"
        answer = f"the robot is not proved closed; next: {accept}{next_command}"
    elif apply:
        _show_commands_by_hand(robot, closed)
        answer = f"next: run these commands, {then}"
        details = _idle_lines(closed, ask)
        if not_starting := _advice_without_security(robot, closed):
            answer = f"no node would start by these commands yet; next: {not_starting}"
            details = []
    else:
        steps = f"stop the robot, start each process by the commands in {robot.commands_file}"
        if closed.secured:
            these = "these processes" if len(closed.pending) > 1 else "this process"
            steps = f"start {these} by the commands at the top of {robot.commands_file}"
            if not closed.stopped.issuperset(closed.pending):
                steps = f"stop and {steps}"
        if not closed.pending:
            pids = sorted({*chain.from_iterable(closed.also_open.values())})
            following = f"stop {_pids_text(pids)}, and then {ask}" if pids else ask
        elif units := {
            process.unit
            for process in observed.processes
            if process.enclave in closed.pending and not process.is_by_hand
        }:
            following = f"sros close {folder} --apply"
            if why := only_root_clause(units):
                following = f"{robot.as_root('--apply')}, because {why}"
        else:
            following = f"{steps}, {then}"
            details = _idle_lines(closed, ask)
        if not_starting := _advice_without_security(robot, closed):
            following, details = not_starting, []
        answer = f"{_state_text(closed, apply=apply)}; next: {following}"
        details += _validity_lines(robot, closed)
    echo(answer, err=True)
    for detail in (*details, *_other_machines_lines(robot, closed)):
        echo(f"  {detail}", err=True)


def _show_commands_by_hand(
    robot: LocalRobot, closed: CloseState, *, only_secured: bool = False
) -> None:
    """Print how to start by hand each process that should have the current files.

    With ``only_secured``, processes that run open are left out.
    """
    from sros_tool.close.state import unit_advice

    for command, processes in closed.pending_by_hand.items():
        enclaves = {process.enclave for process in processes}
        if only_secured and enclaves.isdisjoint(closed.secured):
            continue
        start = "restart the unit" if processes[0].unit else "start again"
        stop = "" if processes[0].unit else _shared_start_text(processes)
        echo(f"stop {stop}, and {start} with:" if stop else f"{start} with:")
        echo(f"  {command}")
        if advice := processes[0].launch_advice(robot.folder.absolute()):
            echo(f"  {advice}")
        for process in processes:
            if process.enclave in closed.denied_remappings:
                echo(f"  {_remapping_text(closed, process.enclave)}")
        for advice in unit_advice(processes):
            echo(f"  {advice}")


def _has_changed_command(robot: LocalRobot, closed: CloseState) -> bool:
    """Return whether a process has a command that the next `sros close` remembers."""
    known = {(process.enclave, *process.command) for process in robot.processes.processes}
    enclaves = {enclave for enclave, *_ in known}
    return any(
        process.enclave in enclaves and (process.enclave, *process.command) not in known
        for process in closed.observed.processes
    )


def _idle_lines(state: CloseState, ask: str) -> list[str]:
    """Return how to prove the robot closed without the processes that do not run now.

    ``ask`` is the command for the proof.
    """
    idle = state.stopped if state.secured else {*state.observed.ended}
    if not (stopped := sorted(idle.intersection(state.pending))):
        return []
    options = "".join(f" --without {name}" for name in stopped)
    without = f"to prove that the robot is closed, without a process of {enumerated(stopped)}"
    return [f"{without}: {ask}{options}"]


def _advice_without_security(robot: LocalRobot, closed: CloseState) -> str:
    """Return what to do if no process can start closed with the present RMW; "" if one can."""
    if closed.secured or not robot.rmws_without_security():
        return ""
    return (
        "sros doctor, to find an RMW that enforces security; then set RMW_IMPLEMENTATION to this "
        "RMW"
    )


def _show_undone(robot: LocalRobot, closed: CloseState, unexamined: str) -> None:
    """Print what still has to be done until the robot is open.

    ``unexamined`` are sentences on processes that sros cannot examine; "" without any.
    """
    for problem in closed.problems:
        echo(problem)
    if closed.dry_run:
        return
    end = f". {unexamined}" if unexamined else ""
    if closed.problems:
        ask = f"run sros close {shlex.quote(str(robot.folder))} --undo again"
        echo(f"the robot is not open yet; next: do what each line says, and {ask}{end}", err=True)
    else:
        more = ""
        if other_machines := closed.observed.not_here:
            more = f"; on other machines, also start the processes of {enumerated(other_machines)} "
            more += "without sros run"
        is_open = f"the robot is open{', as far as sros can see' if unexamined else ''}"
        echo(f"{is_open}: sros sees no process in an enclave of this folder{more}{end}", err=True)


def _state_text(closed: CloseState, *, apply: bool) -> str:
    """Return a clause that says which processes run in their enclaves and which do not."""
    if not closed.secured:
        not_closed = "nothing was closed" if apply else "nothing is closed yet"
        return "no process of the robot runs" if closed.stopped >= {*closed.pending} else not_closed
    words = {name: _run_state_text(closed, name) for name in closed.pending}
    exceptions = ", ".join(
        f"{enumerated([name for name in words if words[name] == word])} ({word})"
        for word in dict.fromkeys(words.values())
    )
    if len(words) > 1 and not any(closed.secured.values()):
        return f"restart all {len(words)} processes: {exceptions}"
    return f"the processes run in their enclaves{', except for ' * bool(words)}{exceptions}"


def _run_state_text(closed: CloseState, enclave: str) -> str:
    """Return in words how the process of an enclave runs, which does not run as it should."""
    if enclave in closed.secured:
        return _NOT_CURRENT
    if enclave in closed.other_files:
        return "secured with other files"
    if enclave in closed.stopped:  # an unknown process may be the process of the enclave
        return "not running, or not recognized" if closed.observed.unknown else "not running"
    return "open"


def _other_machines_lines(robot: LocalRobot, closed: CloseState) -> list[str]:
    """Return which files other machines need; sros does not see whether the files are there."""
    lines, keystore = [], shlex.quote(str(robot.keystore))
    if needed := closed.needed_elsewhere:
        lines.append(
            f"other machines need the current files of {_times_text(needed)}"
            f"; bring the output of `sros distribute_key {keystore} ENCLAVE FOLDER --force` "
            f"there, restart the process, and run `{robot.close_command} --brought ENCLAVE`"
        )
    if brought := closed.brought:
        lines.append(
            "other machines have, as you said with --brought, the current files of "
            f"{_times_text(brought)}"
        )
    if here := " ".join(robot.named_here):
        lines.append(
            f"the other machine still has the key of {here}: delete the files there, or replace "
            f"the key: `sros renew {keystore} {here} --new-key --revoke-old`, then "
            f"`{robot.close_command}`, and restart all processes"
        )
    if expired := closed.expired_elsewhere:
        lines.append(
            f"on other machines, files that have expired: {_times_text(expired)}; to renew them, "
            f"run `sros renew {keystore} {' '.join(expired)}`, and bring the new files to the "
            "machine"
        )
    if earlier := closed.earlier_elsewhere:
        lines.append(
            "whoever kept earlier files has their rights until the files expire: "
            f"{_times_text(earlier)}; to end this, run `sros renew {keystore} {' '.join(earlier)} "
            "--revoke-old`"
        )
    return lines


def _times_text(enclaves: Mapping[str, datetime]) -> str:
    return ", ".join(f"{name} ({iso(moment)})" for name, moment in enclaves.items())


def _validity_lines(robot: LocalRobot, closed: CloseState) -> list[str]:
    """Return which files of this machine have expired, or when those of closed processes expire.

    There is no line on files that are valid if no process runs closed.
    """
    from sros_tool.close.proof import expired_enclaves, expired_text

    if expired := expired_enclaves(robot, robot.export):
        return [expired_text(robot, expired)]
    if not (closed.secured and closed.valid_until):
        return []
    from sros_tool.keystore.expiry import enclaves_renewed_by_name, renewal_command
    from sros_tool.keystore.reader import OpenedKeystore

    advice = "have them renewed before then (docs/howto/close.md, Automatic renewal)"
    if closed.expires_soon:
        by_name = []
        if robot.keystore.exists():
            keystore = OpenedKeystore(robot.keystore)
            by_name = enclaves_renewed_by_name(keystore, keystore.template, closed.expires_soon)
        advice = f"renew them now: {renewal_command(closed.folder / 'keystore', *by_name)}"
    first = f"{iso(closed.valid_until)}{_first_to_expire_clause(robot, closed.valid_until)}"
    return [f"the files are valid until {first}; {advice}"]


def _first_to_expire_clause(robot: LocalRobot, first: datetime) -> str:
    """Return which enclaves expire at about the ``first`` moment, if others expire much later.

    Otherwise, returns "".
    """
    from sros_tool.close.robot import MOST_NAMES
    from sros_tool.close.state import expiries_of_export

    ends = {name: end for name, end in expiries_of_export(robot).items() if end}
    later = [end for end in ends.values() if end - first > _MUCH_LATER]
    if not later:
        return ""
    names = [name for name, end in ends.items() if end not in later]
    others = f"{'the others' if later[1:] else 'the other one'} until {iso(min(later))}"
    return f" (those of {first_few(names, MOST_NAMES)}; {others})"


def _shared_start_text(processes: Sequence[ClosedProcess]) -> str:
    """Return what one command stops and starts together: a process, a launch, or the containers.

    Returns "" if no process runs any more.
    """
    first = processes[0]
    if first.launch or first.container:
        names = enumerated([process.enclave for process in processes])
        return f"{'the containers' if first.container else 'the launch'} of {names}"
    if first.alike:
        return first.pids_text
    return _pids_text([*dict.fromkeys(process.pid for process in processes if process.pid)])


def _pids_text(pids: Sequence[int]) -> str:
    """Return the ids of processes as text; "" without any."""
    return f"process{'es' * (len(pids) > 1)} {enumerated([*map(str, pids)])}" if pids else ""


_MOST_DENIED = 4
_MUCH_LATER = timedelta(days=7)
_ANSWERS = {True: "yes", False: "no", None: "not checked"}
_NOT_CURRENT = "with earlier files or other settings"
_ACCEPT_ADVICE = "accept unchecked claims with --accept, or "
