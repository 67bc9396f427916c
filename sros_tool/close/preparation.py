"""Prepare everything that a robot needs to run closed, without closing it.

The steps are command lines of sros. Each problem that keeps the robot from running closed is shown
with its remedy.
"""

from __future__ import annotations

import os
import shlex
import stat
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import suppress
from itertools import chain
from pathlib import Path, PurePosixPath
from typing import NamedTuple

from sros_tool.checks.processes import has_other_files, other_folder_findings
from sros_tool.checks.requirements import VACUOUS, VIOLATED
from sros_tool.close.acceptance import Acceptance, Acceptances
from sros_tool.close.nodes import ObservedNodes
from sros_tool.close.processes import ClosedProcess, ObservedProcesses, process_text, run_words
from sros_tool.close.rights import names_without_requirement
from sros_tool.close.robot import MOST_NAMES, TEMPLATE, LocalRobot
from sros_tool.close.start_files import write_start_files
from sros_tool.close.state import (
    CloseState,
    CloseStep,
    RunningRobot,
    current_state,
    secured_process,
)
from sros_tool.close.watch import check_watchable, watch
from sros_tool.errors import SrosError, UsageError
from sros_tool.explain.audit import DeniedRight
from sros_tool.files import replace_file
from sros_tool.folders import Folder
from sros_tool.keystore.layout import (
    EARLIER_FILES,
    KEY_FILES,
    enclave_folder,
    enclave_path,
    how_to_learn_one_process,
    list_enclaves,
)
from sros_tool.keystore.reader import OpenedKeystore
from sros_tool.keystore.rights import load_rights
from sros_tool.keystore.selection import revocation_of
from sros_tool.names import expand
from sros_tool.owners import user_name
from sros_tool.policy.document import read_policy
from sros_tool.policy.model import OFFERING_RIGHT
from sros_tool.policy.rights import Rules, policy_rights
from sros_tool.proof.requirements import RightsRequirement, read_requirements
from sros_tool.runtime.environment import RMW_ZENOH, node_argument, remapping_rules
from sros_tool.runtime.processes import SEVERAL_USERS, without_launch_files
from sros_tool.runtime.rmw import RMW, no_security_text
from sros_tool.runtime.variables import ENCLAVE
from sros_tool.values import FileChange
from sros_tool.wording import counted, enumerated, first_few

_GITIGNORE_TEXT = """\
# What `sros close` makes for this machine, and private keys.
/keystore/
/export/
/start/
/observed.json
/processes.json
/rights.html
/seen.xml
"""

_NOT_SIGNED = "nothing was signed"
_REMAP = "--ros-args -r __node:=NODE -r __ns:=NAMESPACE"


class CommandStep(NamedTuple):
    """A command line of sros that is a step of closing a robot."""

    words: Sequence[str]
    """The verb, with its arguments."""
    made: Path | None = None
    """What the step makes; if it exists, the step is left out."""
    into: Path | None = None
    """The file into which the output goes."""
    guards: bool = False
    """Whether the later steps are left out if this step finds something."""
    signs: bool = False
    """Whether the step changes rights, and says which on standard error."""

    @property
    def command(self) -> str:
        """The command line that does the step."""
        redirected = f" > {shlex.quote(str(self.into))}" if self.into else ""
        return f"sros {shlex.join(self.words)}{redirected}"


def prepare(
    robot: LocalRobot, duration: str | None, *, accepted: Acceptances, dry_run: bool
) -> CloseState:
    """Run the steps whose results are missing, write how each process is started; return the state.

    Raises:
        SrosError: the robot cannot be watched, the keystore was brought to another machine, or
            others can change the files that systemd would run.
    """
    robot.check_units_folder()
    _check_folder(robot)
    if not duration:
        robot.check_rmw()
    brought = robot.brought_now()
    if robot.observed and (robot.named_elsewhere or robot.named_here or brought):
        robot.check_machines()
        robot.observed = robot.observed.belonging_elsewhere(robot.named_elsewhere)
        robot.observed = robot.observed.belonging_here(robot.named_here)
        brought = {**robot.observed.brought, **brought}
        robot.observed = robot.observed._replace(brought=brought)
        if not dry_run:
            robot.write_processes(robot.observed)
    denied_before: Sequence[str] = ()
    if robot.export.exists() and robot.observation_file.exists():
        with suppress(SrosError):  # the steps report the error
            denied_before = [str(right) for right in _denied_rights(robot)]
    done, problems, is_stopped = _run_steps(robot, duration, accepted=accepted, dry_run=dry_run)
    ignored = [] if dry_run else _ignore_in_git(robot)
    removed = [] if dry_run or is_stopped else _remove_enclaves(robot)
    if not (dry_run or is_stopped):
        _write_later_processes(robot)
    state = current_state(robot, robot.read_policy())._replace(steps=done, dry_run=dry_run)
    if dry_run and not is_stopped and robot.keystore.exists() and robot.export.exists():
        state = _with_problems(robot, state, problems, accepted=accepted)
        return state._replace(changes=ignored)
    if dry_run or is_stopped:
        return state._replace(problems=problems, blocked=bool(problems), changes=ignored)
    denied_rights = _denied_rights(robot)
    remappings = denied_remappings(denied_rights, state.observed.processes)
    state = state._replace(denied_remappings=remappings)
    changes = [*ignored, *write_start_files(robot, state), *removed]
    denied = [str(right) for right in denied_rights]
    newly_denied = [right for right in denied if right not in denied_before]
    state = _with_problems(robot, state, problems, accepted=accepted)
    if not state.secured:
        for rmw in robot.rmws_without_security():
            robot.shell.say(
                f"WARNING: {no_security_text(rmw)}. Before you stop the robot, find an RMW that "
                "enforces security: sros doctor"
            )
    return state._replace(denied=denied, newly_denied=newly_denied, changes=changes)


def _check_folder(robot: LocalRobot) -> None:
    """Raise `UsageError` if there is an export but no keystore; note other files in the folder."""
    if robot.export.exists() and not robot.keystore.exists():
        raise UsageError(
            f"the keystore '{robot.keystore}' is not there, and '{robot.export}' was exported "
            "from it",
            "A new keystore would have other CAs.",
            "Bring the keystore back to change the robot; --proof and --undo need only the export, "
            f"and '{robot.commands_file}' has the commands of processes that you start by hand.",
        )
    results = (robot.observation_file, robot.policy, robot.keystore, robot.export)
    if robot.folder.is_dir() and [*robot.folder.iterdir()] and not any(map(Path.exists, results)):
        robot.shell.say(f"'{robot.folder}' already has files: sros adds its own")


def _ignore_in_git(robot: LocalRobot) -> list[FileChange]:
    """Write a .gitignore for files that are not for git, unless the folder has a .gitignore."""
    file = robot.folder / ".gitignore"
    if os.path.lexists(file):
        return []
    replace_file(file, _GITIGNORE_TEXT.encode())
    return [FileChange("create", str(file))]


def _write_later_processes(robot: LocalRobot) -> None:
    """Write changed commands of processes, and new processes, into the folder, and show them.

    Enclaves that neither the keystore nor the policy has any more are removed from the enclaves of
    other machines. Before a watch, nothing is done.
    """
    if robot.observed is None:
        return
    known = robot.keystore_enclaves() | robot.policy_enclaves()
    not_here = [name for name in robot.observed.not_here if name in known]
    before = _with_renamed_enclaves(robot, robot.observed._replace(not_here=not_here))
    now = RunningRobot(robot).with_later_processes(before)
    for old, new in zip(before.processes, now.processes, strict=False):
        now_by, before_by = new.open_command(robot.domain), old.open_command(robot.domain)
        if now_by != before_by:
            robot.shell.say(
                f"{new.enclave} was started by another command than before; sros remembers the new "
                f"one: {now_by}; before: {before_by}"
            )
    if now != robot.observed:
        robot.write_processes(now)


def _with_renamed_enclaves(robot: LocalRobot, observed: ObservedProcesses) -> ObservedProcesses:
    """Return observed processes in the enclaves to which the policy moved all of their nodes.

    A process keeps its enclave if the policy still has it, or if the other enclave has a process or
    gets nodes of several enclaves.
    """
    nodes, moved = ObservedNodes(robot), dict[str, set[str]]()
    if robot.observation_file.exists():
        for old, new in zip(nodes.as_observed, nodes.in_their_enclaves, strict=True):
            moved.setdefault(old.enclaves[0], set()).add(new.enclaves[0])
    origins = Counter(chain.from_iterable(moved.values()))
    taken = observed.enclaves
    renamed = []
    for process in observed.processes:
        name, *others = moved.get(process.enclave, {process.enclave})
        if not others and origins[name] == 1 and name not in taken and not process.shares:
            robot.shell.say(f"{process.enclave} is now {name}, because the policy moved its nodes")
            process = process._replace(enclave=name)
        renamed.append(process)
    return observed._replace(processes=renamed)


def _denied_rights(robot: LocalRobot) -> Sequence[DeniedRight]:
    """Return the rights that observed nodes need and the keystore denies."""
    nodes = ObservedNodes(robot)
    return nodes.denied_rights(nodes.expected_nodes())


def denied_remappings(
    denied: Sequence[DeniedRight], processes: Sequence[ClosedProcess]
) -> dict[str, Sequence[str]]:
    """Map enclaves to the remapping rules of their start commands that give a denied name.

    A rule for one node counts for this node only.  Rules that change the name or
    namespace of a node are left out.
    """
    remappings: dict[str, Sequence[str]] = {}
    for process in processes:
        names = {
            (*node.rsplit("/", 1), right.right.name)
            for right in denied
            if right.right.enclave == process.enclave
            for node in right.nodes
        }
        rules = [
            f"{of_node}{':' * bool(of_node)}{old}:={new}"
            for of_node, old, new in remapping_rules(process.command)
            if not old.startswith("__")
            and any(
                of_node in ("", node) and expand(new, ns or "/", node) == name
                for ns, node, name in names
            )
        ]
        if rules:
            remappings[process.enclave] = rules
    return remappings


def _run_steps(
    robot: LocalRobot, duration: str | None, *, accepted: Acceptances, dry_run: bool
) -> tuple[list[CloseStep], list[str], bool]:
    """Run the steps; return their states, the problems, and whether a problem stopped the rest.

    In a dry run, only the checks that come before the signing are run.
    """
    done: list[CloseStep] = []
    problems: list[str] = []
    is_stopped = False
    for step in steps(robot, duration):
        state = "kept" if step.made and step.made.exists() else "open"
        is_tried = step.guards and robot.policy.exists() and robot.requirements.exists()
        if dry_run and not (is_tried or is_stopped):
            robot.shell.say(f"{'kept' if state == 'kept' else 'would run'}: {step.command}")
            if step.signs and robot.keystore.exists():
                _, output, messages = robot.shell.run((*step.words, "--dry-run"), False)
                robot.shell.say_lines(messages if output else "")
        elif state == "open" and not is_stopped:
            state, step_problems = _run_step(robot, step, accepted=accepted)
            problems += step_problems
            is_stopped = step.guards and state == "findings"
        done.append(CloseStep(step.command, state))
        if step.into == robot.observation_file and not (dry_run and state == "open"):
            shared = [*_shared_program_problems(robot)]
            shared += [] if Acceptance.NODES in accepted else _shared_node_problems(robot)
            problems, is_stopped = [*problems, *shared], bool(shared)
    if dry_run:
        problems = [text.replace(_NOT_SIGNED, "sros would sign nothing") for text in problems]
    return done, problems, is_stopped


def steps(robot: LocalRobot, duration: str | None) -> Iterator[CommandStep]:
    """Yield the steps; with a ``duration``, the robot is watched even if it was watched before.

    The enclaves to export are known when the earlier steps are done.
    """
    policy, keystore, needed = str(robot.policy), str(robot.keystore), str(robot.requirements)
    domain = ("--domain", str(robot.domain))
    learn = ["generate_policy", policy, "--enclave-per-node", *domain]
    learn += ["--watch", duration] if duration else []
    learn += ["--dry-run"] if robot.policy.exists() else []  # the user may have edited the policy
    only_errors = ("--fail-on", "error")
    policies, created = ("-p", policy, str(robot.observer)), ("--template", TEMPLATE)
    on_zenoh = robot.shell.environment.get(RMW) == RMW_ZENOH
    watched = robot.policy.exists() and not duration
    yield CommandStep(
        (*learn, "--json"), robot.processes_file if watched else None, robot.observation_file
    )
    yield CommandStep(("check", policy, "--suggest"), robot.requirements, robot.requirements)
    yield CommandStep(
        ("check", policy, "--requirements", needed, *created, *only_errors), guards=True
    )
    yield CommandStep(("create_keystore", keystore, *created, *domain), robot.keystore)
    yield CommandStep(("generate_artifacts", "-k", keystore, *policies), signs=True)
    if on_zenoh:
        yield CommandStep(("zenoh", keystore))
    yield CommandStep(robot.export_words())
    yield CommandStep(("check", policy, keystore, "--policy", policy, *only_errors))
    yield CommandStep(("view", policy, *created, "-o", str(robot.page), "--force"))


def _run_step(
    robot: LocalRobot, step: CommandStep, *, accepted: Acceptances
) -> tuple[str, list[str]]:
    """Run a step; return its state, and the reasons why the robot is not closed yet.

    Raises:
        SrosError: the robot cannot be watched.
    """
    is_watch = step.into == robot.observation_file
    if is_watch:
        check_watchable(robot)
    robot.shell.say(f"+ {step.command}")
    if is_watch:
        return "done", watch(robot, step.words)
    status, output, messages = robot.shell.run(step.words, bool(step.into))
    if status or (step.guards and output):
        robot.shell.say_lines("" if step.into else f"{output}{messages}")
    elif step.signs and output:
        for line in messages.splitlines():
            if not line.startswith(EARLIER_FILES):  # this run exports, and says what to restart
                robot.shell.say(line)
    needed = shlex.quote(str(robot.requirements))
    is_asked = step.guards and not status and Acceptance.REQUIREMENTS not in accepted
    if is_asked and (lost := [*_lost_protection(robot)]):
        return "findings", lost
    if step.guards and VACUOUS.id in output:
        robot.shell.say(
            f"`sros review` refuses a requirement that protects less than it states: edit {needed}"
        )
    if status:
        remedy = f"; {_NOT_SIGNED}" if step.guards else ""
        if VIOLATED.id in output:
            remedy += f"; if you want the change, edit {needed}, or remove this file to get "
            remedy += "new requirements"
        return "findings", [f"findings of `{step.command}`{remedy}"]
    if step.guards:
        _say_names_without_requirement(robot)
    if step.into:
        replace_file(step.into, output.encode())
    return "done", []


def _lost_protection(robot: LocalRobot) -> Iterator[str]:
    """Yield a text for each requirement with a name that the policy gave up.

    If the policy gave the name up for another one, the requirement does not protect the new name.
    Then nobody names it any more, or nobody has the required right to it, and an enclave that had
    it has a new right of this kind.  A new wildcard in place of the name, in the same enclaves, is
    no other name.

    If there is such a requirement, requirements on using a name that nobody offers any more follow:
    the same change gave up this name.
    """
    if not robot.keystore.exists():
        return
    signed = load_rights(OpenedKeystore(robot.keystore)).rights
    stated = policy_rights(read_policy(robot.policy))
    new, kept = stated - signed, {right.name for right in stated}
    new_rules = Rules(new)
    given_up = {right for right in signed - stated if not new_rules.cover(right)}
    gone = {right.name for right in given_up if right.name not in kept}
    held = {(right.right, right.name) for right in stated}
    gaining = {(right.enclave, right.right) for right in new}
    moved = {
        (right.right, right.name)
        for right in given_up
        if (right.right, right.name) not in held and (right.enclave, right.right) in gaining
    }
    required_rights = [
        (each.source.line, {(right, name) for right, names in each.rights for name in names})
        for each in read_requirements(robot.requirements)
        if isinstance(each, RightsRequirement)
    ]
    if any(pair in moved or pair[1] in gone for _, pairs in required_rights for pair in pairs):
        uses = {offering: using for using, offering in OFFERING_RIGHT.items()}
        moved |= {(uses[right], name) for right, name in moved if right in uses}
    for line, required in required_rights:
        names = gone & {name for _, name in required}
        if lost := sorted(names | {name for _, name in moved & required}):
            why = "which the policy does not name any more"
            if not names:
                why = f"but the policy now uses {'other names' if lost[1:] else 'another name'} "
                why += f"in {'their' if lost[1:] else 'its'} place"
            yield (
                f"{robot.requirements}:{line} protects {enumerated(lost)}, {why}; "
                f"{_NOT_SIGNED}. If the policy renamed a name, also rename it in the "
                "requirement. If nobody needs a name any more, remove it there (or accept this "
                "with --accept requirements)"
            )


def _say_names_without_requirement(robot: LocalRobot) -> None:
    """Show the names that deserve a requirement since this change, but have none."""
    if not robot.keystore.exists():
        return
    signed = load_rights(OpenedKeystore(robot.keystore)).rights
    if names := names_without_requirement(robot.folder, signed, robot.shell.now()):
        policy = shlex.quote(str(robot.policy))
        robot.shell.say(
            f"no requirement protects {first_few(names, MOST_NAMES)}: `sros check {policy} "
            "--suggest` now proposes requirements; copy those that you want into "
            f"'{robot.requirements}'"
        )


def _enclaves_without_origin(robot: LocalRobot, *, revoked: bool) -> list[str]:
    """Return the enclaves of the export that the keystore revoked, or that it lost otherwise."""
    keystore = OpenedKeystore(robot.keystore)
    names = {*list_enclaves(robot.export)} - {*list_enclaves(robot.keystore)}
    return sorted(name for name in names if bool(revocation_of(keystore, name)) is revoked)


def _remove_enclaves(robot: LocalRobot) -> list[FileChange]:
    """Remove from the export enclaves that were revoked, or that belong to other machines."""
    revoked_enclaves = _enclaves_without_origin(robot, revoked=True)
    removed = dict.fromkeys(revoked_enclaves, "its enclave was revoked")
    for name in robot.not_here.intersection(list_enclaves(robot.export)):
        if any((enclave_path(robot.keystore, name) / file).exists() for file in KEY_FILES):
            removed[name] = "its enclave belongs to another machine"
    with Folder(robot.export) as export:
        for folder in map(enclave_folder, removed):
            for entry in (f"{folder}/{name}" for name in export.names(folder)):
                if not stat.S_ISDIR(export.mode(entry)):
                    export.unlink(entry)
        folders = {*map(PurePosixPath, map(enclave_folder, removed))}
        folders |= {parent for folder in folders for parent in folder.parents if parent.parent.name}
        for folder in map(str, sorted(folders, reverse=True)):  # inner ones first
            if not export.names(folder):
                export.rmdir(folder)
    paths = {str(enclave_path(robot.export, name)): why for name, why in removed.items()}
    for path, why in paths.items():
        robot.shell.say(f"removed {path}: {why}")
    return [FileChange("remove", path) for path in paths]


def _with_problems(
    robot: LocalRobot, state: CloseState, of_steps: Sequence[str], *, accepted: Acceptances
) -> CloseState:
    """Return a state with the problems that keep the robot from running closed.

    A problem of other processes, such as a thief's, does not block the restart of closed units:
    only this restart makes a revocation effective.
    """
    of_files = [*of_steps, *_file_problems(robot, state)]
    problems = [*of_files, *_process_problems(robot, state, accepted=accepted)]
    blocked = bool(of_files or (problems and not state.closed_units_to_restart))
    return state._replace(problems=problems, blocked=blocked)


def _file_problems(robot: LocalRobot, state: CloseState) -> Iterator[str]:
    """Yield problems of files with which processes that restart might not run closed."""
    for name in _enclaves_without_origin(robot, revoked=False):
        remove = f"rm -r {shlex.quote(str(enclave_path(robot.export, name)))}"
        yield (
            f"the export has {name}, which is not in the keystore and was not revoked there: "
            f"remove it with {remove}"
        )
    yield from _user_problems(robot, state.observed)


def _process_problems(
    robot: LocalRobot, state: CloseState, *, accepted: Acceptances
) -> Iterator[str]:
    """Yield problems of processes that --apply does not restart, and of rights that are left."""
    yield from _keystore_problems(robot)
    for name in sorted(robot.not_here & state.secured.keys()):
        yield f"{name} belongs to another machine, but a process runs in it here: stop the process"
    running = RunningRobot(robot)
    yield from _copy_problems(running)
    yield from _launch_problems(robot, state.observed)
    if Acceptance.NODES not in accepted:
        yield from _unknown_process_problems(running, state)


def _copy_problems(running: RunningRobot) -> Iterator[str]:
    """Yield a problem for each process that loaded an enclave of the export from elsewhere."""
    export = running.robot.export.absolute()
    copies = (
        process
        for process in running.in_domain
        if process.enclave and has_other_files(process.enclave, export)
    )
    for finding in other_folder_findings(copies, export):
        yield (
            f"{finding.subject}: {finding.text}: stop it; if it belongs to the robot, start it "
            f"with the files in '{export}'"
        )


def _keystore_problems(robot: LocalRobot) -> Iterator[str]:
    """Yield a text for each enclave of the keystore that the policy does not have."""
    merge = f"sros merge_policy {shlex.quote(str(robot.policy))} ITS_POLICY --in-place"
    for name in robot.enclaves_outside_policy():
        revoke = f"sros revoke {shlex.quote(str(robot.keystore))} {name}"
        yield (
            f"the keystore has {name}, and the policy does not, so {name} keeps the rights that "
            f"were signed. If nothing needs it any more: {revoke} (then restart all closed "
            "processes, because a process reads revocations only when it starts). "
            + (
                f"If its machine still needs it: {merge}"
                if name in robot.not_here
                else f"Otherwise, merge its policy: {merge}. If it belongs to another machine, "
                f"such as a laptop, then also run {robot.close_command} --elsewhere {name}"
            )
        )


def _user_problems(robot: LocalRobot, observed: ObservedProcesses) -> Iterator[str]:
    """Yield a text for each user whose processes cannot read their enclaves."""
    owner, export = robot.export.stat().st_uid, robot.export.absolute()
    users = sorted({process.user for process in observed.processes})
    if len(ordinary := [user for user in users if user not in (0, SEVERAL_USERS)]) > 1:
        yield (
            f"when sros watched, processes ran as "
            f"{enumerated([user_name(user) for user in ordinary])}, but only one user can read the "
            "enclaves (and Fast DDS shares no memory between users): let one user start all of "
            f"them (in a unit: User=), and watch again: {robot.close_command} --for 1m"
        )
        return
    for user in users:
        if user == SEVERAL_USERS:
            yield (
                "a process, such as a set-user-ID program, runs as several users, and only one "
                "user can read the enclaves: start it as one user"
            )
            continue
        barred = [path for path in export.parents if not _may_enter(user, path.stat())]
        if barred and user:
            yield (
                f"user {user}, who runs processes, cannot enter '{barred[-1]}': let this user "
                "enter it"
            )
        if user not in (0, owner):
            yield (
                f"when sros watched, processes ran as {user_name(user)}, but only "
                f"{user_name(owner)} can read the enclaves: chown -R {user} "
                f"{shlex.quote(str(robot.export))} (if another user starts them now, watch again: "
                f"{robot.close_command} --for 1m)"
            )


def _launch_problems(robot: LocalRobot, observed: ObservedProcesses) -> Iterator[str]:
    """Yield a text for each process that its launch would not start in its enclave."""
    for process in observed.processes:
        command = process.command
        by_launch = process.launch or process.container
        if not by_launch and without_launch_files(command) != tuple(command):
            yield (
                f"the launch that started the process of {process.enclave} has ended, and the "
                "command of the process names temporary files of that launch. Start the launch "
                f"again, and watch again: {robot.close_command} --for 1m"
            )
        if process.launch and not (node_argument(command) or process.is_launch):
            words = run_words(robot.export.absolute(), process.enclave, process.rmw)
            prefix = f"prefix='{' '.join(words)}'"
            yield (
                f"the process of {process.enclave} has no name= in its launch file, and would "
                f"not start: give it a name=, or {prefix}"
            )


def _unknown_process_problems(running: RunningRobot, state: CloseState) -> Iterator[str]:
    """Yield texts on processes without known nodes, and on nodes without a known process."""
    robot, observed = running.robot, state.observed
    close = robot.close_command
    silent = "While {} open, the closed robot does not hear {} (--accept nodes accepts this)"
    policy = robot.read_policy() if state.secured else None
    nodes, stopped = policy.nodes() if policy else {}, state.stopped
    idle = {enclave: names for enclave, names in nodes.items() if enclave in stopped}
    named = running.named_processes(observed, idle)
    named = {text: process for text, process in named.items() if not process.unit}
    for text, process in named.items():
        label, start = text.partition(": ")[0], process.secured_command(robot.folder.absolute())
        yield (
            f"{label} runs open, and has the name of {process.enclave}: stop it, and, if it is "
            f"this node, start it in its enclave: {start}. {silent.format('it runs', 'it')}"
        )
    elsewhere = {
        process_text(process): moved.enclave
        for process in running.open_processes
        for moved in observed.moved
        if process_text(process) in {*observed.unknown}.difference(named) and moved.fits(process)
    }
    for text, enclave in elsewhere.items():
        yield (
            f"{text.partition(': ')[0]} runs open, and has the command of {enclave}, which belongs "
            f"to another machine: stop it, or bring the enclave back: {close} --here {enclave}. "
            f"{silent.format('it runs', 'it')}"
        )
    if unknown := [
        text for text in observed.unknown if text not in named.keys() | elsewhere.keys()
    ]:
        them, runs = ("it", "it runs") if len(unknown) == 1 else ("them", "they run")
        advice = f"Watch again while {runs}: {close} --for 1m"
        if observed.elsewhere:
            advice += ". If sros still sees no node, add the node's name to the command of "
            advice += f"each process ({_REMAP})"
        if state.secured:
            left = stopped - {process.enclave for process in named.values()}
            advice = _start_of_unknown_process(running, unknown, sorted(left), observed)
            advice += (
                "Stop processes that are not of the robot, such as your own `sros demo listener`"
            )
            # An enclave that was added while the robot is closed may already be of this process.
            if len(unknown) > len(left.intersection(state.new).difference(observed.ended)):
                learn = how_to_learn_one_process(robot.folder, robot.domain)
                advice += f". To give another process its own enclave, {learn}"
        what = "the enclave of" if state.secured else "a node of"
        number = counted(len(unknown), "open process", "open processes")
        processes = first_few(unknown, MOST_NAMES)
        yield (
            f"sros does not know {what} {number}: {processes}. {advice}. "
            f"{silent.format(runs, them)}"
        )
    routers = [process for process in running.open_processes if process.is_router]
    if routers and not any(process.is_router for process in observed.processes):
        yield (
            f"{routers[0].label} is a Zenoh router that did not run when sros watched, or does not "
            f"belong to the robot. Stop it, or watch again while it runs: {close} --for 1m. "
            "Otherwise closed nodes do not reach each other through this router (--accept nodes "
            "accepts this)"
        )
    pids = {process.enclave: process.pid for process in observed.processes}
    if twice := sorted(pids.keys() & {*observed.elsewhere}):
        yield (
            f"nodes of {twice[0]} are in process {pids[twice[0]]} and in another process "
            "that sros does not see. If another robot is in this ROS domain, switch it off, or "
            "give it a domain of its own. Then remove the rights of its nodes from "
            f"'{robot.policy}', and watch again: {close} --for 1m"
        )
    if only_there := [name for name in observed.elsewhere if name not in twice]:
        enclaves = first_few(only_there, MOST_NAMES)
        options = " ".join(f"--elsewhere {name}" for name in only_there)
        yield (
            f"sros knows no process of this machine for nodes of {enclaves}. If they run on "
            f"another machine: {close} {options}. If you do not know one of the nodes, it may be "
            f"a stranger's: remove its enclave from '{robot.policy}', and remove "
            f"'{robot.requirements}', which sros then proposes again. "
            f"{silent.format('they run', 'them')}"
        )


def _start_of_unknown_process(
    running: RunningRobot, texts: Sequence[str], idle: Sequence[str], observed: ObservedProcesses
) -> str:
    """Return sentences on how to start unknown processes in enclaves ``idle`` without a process.

    Returns "" without such an enclave. ``texts`` are the texts of the processes. The sentence has
    the command of the process if there is only one process and one enclave, no unit starts the
    process, and the process is of a user who can read the enclaves.  If units start unknown
    processes, another sentence says how to name the nodes in the units.
    """
    if not idle:
        return ""
    export = running.robot.export.absolute()
    start = observed.command_of_new_process(export, "ENCLAVE")
    unknown = [
        secured_process(process, idle[0])
        for process in filter(running.may_use_files, running.open_processes)
        if process_text(process) in texts
    ]
    units = sorted({process.unit for process in unknown} - {""})
    if len(texts) == len(idle) == len(unknown) == 1 and not units:
        start = unknown[0].secured_command(export.parent)
    names = first_few(idle, MOST_NAMES)
    which = "the process" if len(texts) == 1 else "one of them"
    advice = f"If {which} belongs in {names}, stop it, and start it in its enclave: {start}. "
    if units:
        advice += (
            f"Or, if {first_few(units, MOST_NAMES)} starts it, add the name of its node to the "
            f"command in the unit ({_REMAP}), restart the unit, and run "
            f"`{running.robot.close_command}`. "
        )
    return advice


def _shared_program_problems(robot: LocalRobot) -> Iterator[str]:
    """Yield a text for each program whose processes would all run in one enclave."""
    observed = robot.processes.limited_to(read_policy(robot.policy))
    by_program: dict[tuple[str, ...], list[ClosedProcess]] = {}
    for process in observed.processes:
        names = sorted({process.enclave, *process.shares})
        by_program.setdefault(tuple(names), []).append(process)
    for enclaves, processes in by_program.items():
        if len(enclaves) > 1 and sum(not process.chooses for process in processes) > 1:
            yield (
                f"{shlex.join(processes[0].command)} starts the processes of "
                f"{enumerated(enclaves)}, and all of them would run in one enclave; "
                f"{_NOT_SIGNED}. In '{robot.policy}', move the profiles of these enclaves into one "
                "of them, which then has the rights of all, and remove the others. Or let the "
                "program start each process with the method spawn after "
                f"setting {ENCLAVE} in os.environ, and watch again: "
                f"{robot.close_command} --for 1m"
            )


def _shared_node_problems(robot: LocalRobot) -> Iterator[str]:
    """Yield a text for processes with nodes of the same name, which would share an enclave."""
    running, is_signed = RunningRobot(robot).processes, robot.keystore.exists()
    by_enclave: dict[str, dict[tuple[int, str], str]] = {}
    for process in robot.processes.processes:
        # A process that was started in the enclave was not assigned by its node's name.
        if process.known_by == "enclave":
            continue
        twins, command = by_enclave.setdefault(process.enclave, {}), shlex.join(process.command)
        now = process.with_current_pid(running, robot.domain, robot.export)
        if is_signed:
            pids = now.alike or [now.pid] * bool(now.pid)
            twins |= {(pid, ""): f"process {pid} ({command})" for pid in pids}
        else:  # the policy has the rights of the process, even if it has ended
            label = now.pids_text or "a process that ended"
            twins[process.pid, command] = f"{label} ({command})"
    for enclave, twins in by_enclave.items():
        if len(twins) > 1:
            yield (
                f"{enumerated([*twins.values()])} have nodes of the same name, and the enclave "
                f"{enclave} would have the rights of all; {_NOT_SIGNED}. If one process is "
                f"not of the robot, stop it, remove '{robot.policy}', and watch again: "
                f"{robot.close_command} --for 1m. If all are of the robot, add --accept nodes"
            )


def _may_enter(user: int, folder: os.stat_result) -> bool:
    """Return whether a user may enter a folder, by its mode."""
    return bool(folder.st_mode & (stat.S_IXUSR if folder.st_uid == user else 0o011))
