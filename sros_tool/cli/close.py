"""The verb `close`: from an open robot to a closed one, by the verbs that do each step."""

from __future__ import annotations

import io
import json
import os
import shlex
import stat
import subprocess
import sys
import time
from collections.abc import Sequence
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import replace
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import click

from sros_tool.cli.common import (
    PATH,
    dry_run_option,
    echo_findings,
    enclave_environment,
    json_option,
    local_zone,
    now,
    print_json,
    verb,
)
from sros_tool.errors import DocumentError, SrosError, UnavailableError, UsageError
from sros_tool.terminal import echo
from sros_tool.values import FileChange
from sros_tool.wording import counted, enumerated, first_few

if TYPE_CHECKING:
    from sros_tool.closing import CloseStep, ObservedProcesses, Proof
    from sros_tool.explain.audit import DeniedRight
    from sros_tool.graph.observation import Observation
    from sros_tool.runtime.processes import RunningProcesses

_SYSTEMD = Path("/etc/systemd/system")
_OBSERVER = "/sros_observer"
_RESTART_SECONDS, _START_SECONDS = 30.0, 3.0
"""How long processes may take until they run in their enclaves: restarted by sros, or by hand."""
_TRIES = 3
_MOST_LINES = 5


class _Step(NamedTuple):
    """The words of a command line of sros, what it makes, and where its output goes."""

    words: Sequence[str]
    made: Path | None = None
    into: Path | None = None

    @property
    def command(self) -> str:
        redirected = f" > {shlex.quote(str(self.into))}" if self.into else ""
        return f"sros {shlex.join(self.words)}{redirected}"


class _Places:
    """The paths in the folder of a robot that is being closed."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.policy, self.observer = folder / "policy.xml", folder / "observer.xml"
        self.requirements = folder / "requirements.toml"
        self.keystore, self.export = folder / "keystore", folder / "export"
        self.start, self.page = folder / "start", folder / "rights.html"
        self.observed, self.processes = folder / "observed.json", folder / "processes.json"
        self.lacks = ""
        """What the policy lacks of what was seen now, as a sentence."""

    @property
    def rights(self) -> Path:
        """The keystore, or the policy if the keystore was brought to another machine."""
        return self.keystore if self.keystore.exists() else self.policy

    def steps(self, domain: int, duration: str | None) -> list[_Step]:
        """Return the steps; with a ``duration``, the robot is watched even if it was before."""
        policy, keystore, needed = str(self.policy), str(self.keystore), str(self.requirements)
        learn = ["generate_policy", policy, "--enclave-per-node", "--domain", str(domain)]
        learn += ["--watch", duration] if duration else []
        learn += ["--dry-run"] if self.policy.exists() else []  # it may have been edited
        only_errors = ("--fail-on", "error")
        both, created = ("-p", policy, str(self.observer)), ("--template", "production")
        return [
            _Step((*learn, "--json"), None if duration else self.processes, self.observed),
            _Step(("check", policy, "--suggest"), self.requirements, self.requirements),
            _Step(("create_keystore", keystore, *created, "--domain", str(domain)), self.keystore),
            _Step(("generate_artifacts", "-k", keystore, *both)),
            _Step(("distribute_key", keystore, "--all", str(self.export), "--force")),
            _Step(("check", policy, keystore, "--policy", policy, *only_errors)),
            _Step(("check", keystore, "--requirements", needed, *only_errors)),
            _Step(("view", policy, *created, "-o", str(self.page), "--force")),
        ]


def _run(step: _Step, *, quiet: bool = False) -> tuple[int, str]:
    """Run a verb of sros in this process; return its status and what it prints.

    With ``quiet``, that has its messages, too.
    """
    from sros_tool.cli.program import program

    echo(f"$ {step.command}", err=True)
    output = io.BytesIO()
    stream = io.TextIOWrapper(output, "utf-8", "surrogateescape", write_through=True)
    with redirect_stderr(stream if quiet else sys.stderr), redirect_stdout(stream):
        status = program.main(list(step.words), prog_name="sros", standalone_mode=False)
        text = output.getvalue().decode("utf-8", "surrogateescape")
    return (status if isinstance(status, int) else 0), text


@verb("close")
@click.argument("folder", type=PATH)
@click.option(
    "--for",
    "duration",
    metavar="DURATION",
    help="Watch the robot for DURATION, such as 5m, or watch it again. [default: until the ROS "
    "graph stops changing]",
)
@click.option(
    "--domain", "domain_text", metavar="ID", help="The ROS domain. [default: $ROS_DOMAIN_ID, or 0]"
)
@click.option(
    "--apply", "applies", is_flag=True, help="Restart the robot's units of systemd secured."
)
@click.option("--proof", "proves", is_flag=True, help="Prove that the robot is closed.")
@click.option("--undo", "undoes", is_flag=True, help="Restart these units open again.")
@click.option(
    "--partial",
    is_flag=True,
    help="Accept that some processes or nodes are left out, or could not be asked.",
)
@dry_run_option
@json_option
def close(
    folder: Path,
    duration: str | None,
    domain_text: str | None,
    applies: bool,
    proves: bool,
    undoes: bool,
    partial: bool,
    dry_run: bool,
    as_json: bool,
) -> int:
    """Close the robot that runs open on this machine, step by step.

    Watches the robot on DDS, and writes into FOLDER its policy, requirements that hold now, a
    production keystore with an enclave for each process, an export of them without CA keys, and how
    each process is started secured. Each step is a verb, which is shown. What is there is kept:
    edit policy.xml and requirements.toml, and run it again.

    Nothing is closed before --apply, which restarts the processes that are units of systemd, and
    shows the commands for all others. --proof, which --apply does by itself if nothing is left to
    do by hand, asks: does every process run in its enclave, does everything that talked still talk,
    does an open listener find nothing? --undo goes back.

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
    from sros_tool.closing import CloseStep, Closing, ObservedProcesses, read_processes
    from sros_tool.policy.document import read_policy

    if sum((applies, proves, undoes)) > 1:
        raise UsageError("--apply, --proof and --undo exclude each other", "", "Choose one.")
    if duration and (applies or proves or undoes):
        raise UsageError("--for is for watching an open robot", "", "Leave it out.")
    at = _Places(folder)
    _check_own(at)
    if (applies or proves or undoes) and not at.processes.exists():
        name = shlex.quote(str(folder))
        raise UsageError(f"'{folder}' has no watched robot", "", f"Run `sros close {name}` first.")
    known = read_processes(at.processes) if at.processes.exists() else None
    if known and at.policy.exists() and not undoes:
        known = known.within(read_policy(at.policy))
    observed = known or ObservedProcesses(_domain(domain_text))
    if domain_text is not None and observed.domain != _domain(domain_text):
        raise UsageError(
            f"the robot was watched in domain {observed.domain}, not {domain_text}",
            "",
            "Close each domain into a folder of its own.",
        )
    if at.export.exists() and not (at.keystore.exists() or proves or undoes):
        raise UsageError(
            f"the keystore '{at.keystore}' is not there, and '{at.export}' comes from it",
            "A new keystore would have other CAs.",
            "Bring it back to change the robot; --proof and --undo need only the export.",
        )
    steps: list[CloseStep] = []
    denied: list[str] = []
    problems: list[str] = []
    proofs: list[Proof] = []
    changes: list[FileChange] = []
    if undoes:
        changes = _undo(at, observed, dry_run=dry_run)
    elif not proves:
        for step in at.steps(observed.domain, duration):
            is_kept = bool(step.made and step.made.exists())
            if dry_run:
                echo(f"{'kept' if is_kept else 'would run'}: {step.command}", err=True)
            state = "kept" if is_kept else "open" if dry_run else _do(at, step)
            steps.append(CloseStep(step.command, state))
        if not dry_run:
            observed = read_processes(at.processes).within(read_policy(at.policy))
            changes = _write_starts(at, observed)
            denied = [str(right) for right in _denied(at, observed.domain)]
            problems = _problems(at, observed, steps, partial=partial or not applies)
    if applies and not problems:
        changes += _apply(at, observed, dry_run=dry_run)
    if not dry_run and not problems and (proves or (applies and not observed.by_hand(folder))):
        proofs = _proofs(at, observed, _START_SECONDS if proves else _RESTART_SECONDS)
    holds = bool(proofs) and all(proof.holds or (partial and not proof.fails) for proof in proofs)
    if as_json:
        print_json(Closing(folder, observed, steps, denied, problems, proofs, dry_run, changes))
    elif not (dry_run or undoes):
        if not (applies or proves):
            _show(at, observed, denied)
        _show_end(at, observed, problems, proofs, applies=applies, holds=holds)
    if dry_run or undoes:
        return int(undoes and not dry_run and bool(observed.by_hand(folder)))
    return int(bool(problems) or ((applies or proves) and not holds))


def _domain(text: str | None) -> int:
    from sros_tool.runtime.variables import DOMAIN, domain_of

    return domain_of(os.environ if text is None else {DOMAIN: text})


def _check_own(at: _Places) -> None:
    """Raise `SrosError` if others can change what is in the folder: it says what systemd starts.

    Whoever runs sros by sudo is trusted, as root is.
    """
    from sros_tool.owners import other_writers, replaceable_on_the_way

    sudo = os.environ.get("SUDO_UID", "") if os.geteuid() == 0 else ""
    trusted = frozenset({0, os.geteuid(), *([int(sudo)] if sudo.isdecimal() else [])})
    files = (at.policy, at.observed, at.processes)
    for path in (at.folder, at.start, at.start / "units", *files):
        if path.exists() and (why := other_writers(path.stat(), trusted)):
            ways = [(path, why)]
        else:
            ways = [*replaceable_on_the_way(path, trusted)]
        for step, why in ways:
            raise SrosError(
                f"others can change '{path}'",
                f"'{step}': {why}.",
                "Close the robot into a folder that only you and root can change.",
            )


# ── preparing ───────────────────────────────────────────────────────────────────────────────


def _do(at: _Places, step: _Step) -> str:
    """Do a step; return its state.  Raises `SrosError` if the robot cannot be watched."""
    from sros_tool.files import replace_file

    watches = step.into == at.observed
    if watches:
        _check_open(at)
    status, output = _run(step, quiet=not step.into)
    if watches and status:
        raise UnavailableError("there is no robot to close: no node was observed")
    if step.into and not status:
        replace_file(step.into, output.encode())
    elif not step.into:
        lines = output.splitlines()
        few = len(lines) if status or len(lines) <= _MOST_LINES else _MOST_LINES - 1
        notes = [line for line in lines[few:] if line.startswith("note ")]
        for line in (*lines[:few], *notes):
            echo(line, err=True)
        if more := len(lines) - few - len(notes):
            echo(f"... and {more} more lines", err=True)
    if watches:
        _keep_processes(at, step, output)
    return "findings" if status else "done"


def _check_open(at: _Places) -> None:
    """Make the folder; raise `SrosError` if the robot cannot be watched as an open one."""
    from sros_tool.folders import make_folders
    from sros_tool.runtime.processes import ProcessTable
    from sros_tool.runtime.variables import ENABLE

    if os.environ.get(ENABLE) == "true":
        raise UsageError(
            f"{ENABLE} is set, so this shell does not see an open robot", "", f"Unset {ENABLE}."
        )
    for process in ProcessTable().look(now()).processes:
        if process.is_zenoh:
            raise UnavailableError(
                f"{process.label} speaks Zenoh, and `sros close` is for DDS",
                "",
                "Close it by `sros generate_policy`, `sros generate_artifacts` and `sros zenoh`.",
            )
    make_folders(at.folder)


def _keep_processes(at: _Places, step: _Step, document: str) -> None:
    """Write which process has which nodes, and the policy of the observer."""
    from sros_tool.closing import assign, processes_document
    from sros_tool.files import policies_dir, replace_file
    from sros_tool.graph.learn import is_tool
    from sros_tool.runtime.processes import ProcessTable

    replace_file(at.observer, (policies_dir() / "observer.xml").read_bytes())
    added = json.loads(document)["added"] if "--dry-run" in step.words else ()
    if added:
        command = f"sros generate_policy {shlex.quote(str(at.policy))} --enclave-per-node"
        at.lacks = (
            f"'{at.policy}' stays as it is, and lacks {counted(len(added), 'right')} seen now; "
            f"if they are right, add them and run it again: {command}"
        )
    nodes = [node for node in _observation(at).nodes if not is_tool(node)]
    domain = int(step.words[step.words.index("--domain") + 1])
    observed = assign(nodes, ProcessTable().look(now()).processes, domain)
    replace_file(at.processes, processes_document(observed))
    number = counted(len(observed.processes), "process", "processes")
    echo(f"saw {counted(len(nodes), 'node')} in {number} of this machine", err=True)


def _observation(at: _Places) -> Observation:
    """Return the nodes that were observed, without those of enclaves that the policy lacks."""
    from sros_tool.graph.observation import from_json, make_observation
    from sros_tool.policy.document import read_policy
    from sros_tool.xml import read_bytes

    names = {enclave.path for enclave in read_policy(at.policy).enclaves}
    try:
        nodes = from_json(json.loads(read_bytes(at.observed, "observation"))).nodes
        return make_observation(node for node in nodes if names.issuperset(node.enclaves))
    except (ValueError, TypeError, KeyError) as error:
        raise DocumentError(
            f"'{at.observed}' is no observation", f"{error}", "Watch the robot again: --for 1m."
        ) from error


def _write_starts(at: _Places, observed: ObservedProcesses) -> list[FileChange]:
    """Write how each process is started secured; return what changed."""
    from sros_tool.closing import start_files
    from sros_tool.runtime.units import unit_changes, write_units

    domain = str(observed.domain)
    variables = {
        process.enclave: enclave_environment(at.export, process.enclave, domain).variables
        for process in observed.processes
    }
    files = start_files(at.folder.absolute(), observed, variables)
    changes = unit_changes(at.start, files, force=True)
    write_units(at.start, files, changes)
    return [FileChange(action, str(at.start / path)) for path, action in changes.items()]


def _denied(at: _Places, domain: int) -> Sequence[DeniedRight]:
    """Return what the keystore denies to the nodes as they were observed."""
    from sros_tool.explain.audit import audit, audited_enclaves
    from sros_tool.keystore.participant import JoinContext
    from sros_tool.runtime.rmw import chosen_vendor

    context = JoinContext(domain, now(), local_zone(os.environ))
    vendor = chosen_vendor(None, None, os.environ)[0]
    audited = audit(_observation(at), audited_enclaves(at.rights, vendor, context), _OBSERVER)
    return audited.denied


def _problems(
    at: _Places, observed: ObservedProcesses, steps: Sequence[CloseStep], *, partial: bool
) -> list[str]:
    """Return what keeps the robot from running closed, with what to do."""
    from sros_tool.keystore.layout import list_enclaves
    from sros_tool.policy.document import read_policy

    problems = [f"findings of `{step.command}`" for step in steps if step.state == "findings"]
    policy = read_policy(at.policy)
    for name in list_enclaves(at.keystore):
        if name != _OBSERVER and not policy.enclave(name):
            revoke = f"sros revoke {shlex.quote(str(at.keystore))} {name}"
            problems.append(f"the policy does not have {name}, and the keystore does: {revoke}")
    owner, export = at.export.stat().st_uid, at.export.absolute()
    for user in sorted({process.user for process in observed.processes} - {0}):
        closed = [path for path in export.parents if not _may_enter(user, path.stat())]
        if closed:
            problems.append(f"user {user}, who runs processes, cannot enter '{closed[-1]}'")
    for user in sorted({process.user for process in observed.processes} - {owner}):
        problems.append(
            f"processes run as user {user}, and only user {owner} can read the enclaves: "
            f"chown -R {user} {shlex.quote(str(at.export))}"
        )
    if (observed.unknown or observed.elsewhere) and not partial:
        problems.append("some processes or nodes would not be heard any more (accept: --partial)")
    return problems


def _may_enter(user: int, folder: os.stat_result) -> bool:
    return bool(folder.st_mode & (stat.S_IXUSR if folder.st_uid == user else 0o011))


# ── applying ────────────────────────────────────────────────────────────────────────────────


def _apply(at: _Places, observed: ObservedProcesses, *, dry_run: bool) -> list[FileChange]:
    """Add the drop-ins of systemd, and restart the units that do not run in their enclaves."""
    from sros_tool.closing import DROP_IN
    from sros_tool.runtime.processes import ProcessTable
    from sros_tool.runtime.units import unit_changes, write_units
    from sros_tool.xml import read_bytes

    units = {process.enclave: process.unit for process in observed.processes if process.unit}
    paths = [f"{unit}.d/{DROP_IN}" for unit in sorted(units.values())]
    files = {path: read_bytes(at.start / "units" / path, "unit").decode() for path in paths}
    _own_drop_ins(at, observed)
    changes = unit_changes(_SYSTEMD, files, force=True)
    for path, action in changes.items():
        echo(f"{'would ' if dry_run else ''}{action} {_SYSTEMD / path}", err=True)
    if not dry_run:
        write_units(_SYSTEMD, files, changes)
    closed = _in_their_enclaves(at, observed, ProcessTable().look(now()))
    _restart(sorted(units[enclave] for enclave in units.keys() - closed), dry_run=dry_run)
    return [FileChange(action, str(_SYSTEMD / path)) for path, action in changes.items()]


def _restart(units: Sequence[str], *, dry_run: bool) -> None:
    """Let systemd read its units again, and restart some.  Raises `SrosError`."""
    for words in [["daemon-reload"], ["restart", *units]] if units else []:
        command = ["systemctl", *words]
        echo(f"{'would run:' if dry_run else '$'} {shlex.join(command)}", err=True)
        try:
            ended = 0 if dry_run else subprocess.run(command, check=False).returncode
        except OSError as error:
            raise UnavailableError(f"systemctl cannot be run: {error.strerror}") from error
        if ended:
            raise SrosError(
                f"`{shlex.join(command)}` ended with {ended}",
                "Secured and open processes do not hear each other.",
                "Mend it and run --apply again, or go back with --undo.",
            )


def _own_drop_ins(at: _Places, observed: ObservedProcesses) -> list[Path]:
    """Return the drop-ins of this folder; raise `SrosError` if a unit has that of another one."""
    from sros_tool.closing import DROP_IN, mark
    from sros_tool.xml import read_bytes

    drop_ins = [
        path
        for path in sorted(_SYSTEMD.glob(f"*.d/{DROP_IN}"))
        if read_bytes(path, "unit").startswith(mark(at.folder.absolute()).encode())
    ]
    units = {process.unit for process in observed.processes if process.unit}
    for path in (_SYSTEMD / f"{unit}.d/{DROP_IN}" for unit in sorted(units)):
        if path not in drop_ins and os.path.lexists(path):
            raise SrosError(
                f"'{path}' is not the drop-in of this folder",
                "Its first line names another folder, or was changed. Nothing was changed.",
                "Use the folder that it names, as it was written, or remove the drop-in.",
            )
    return drop_ins


def _undo(at: _Places, observed: ObservedProcesses, *, dry_run: bool) -> list[FileChange]:
    """Remove the drop-ins of this folder, restart their units, and show what to do by hand."""
    from sros_tool.files import remove_file

    drop_ins = _own_drop_ins(at, observed)
    units = {process.unit for process in observed.processes if process.unit}
    for path in drop_ins:
        echo(f"{'would remove' if dry_run else 'removed'} {path}", err=True)
        if not dry_run:
            remove_file(path)
    units |= {path.parent.name.removesuffix(".d") for path in drop_ins}
    _restart(sorted(units), dry_run=dry_run)
    by_hand = chain.from_iterable(observed.by_hand(at.folder).values())
    for command in dict.fromkeys(process.open_command for process in by_hand):
        echo(f"by hand, restart it open: {command}", err=True)
    return [FileChange("remove", str(path)) for path in drop_ins]


# ── the proof ───────────────────────────────────────────────────────────────────────────────


def _in_their_enclaves(
    at: _Places, observed: ObservedProcesses, running: RunningProcesses
) -> set[str]:
    """Return the enclaves in which a process runs with the present files of the export."""
    from sros_tool.checks.processes import newer_files

    export = str(at.export.absolute())
    return {
        process.enclave.name
        for process in running.processes
        if process.asks_for_security and process.domain == str(observed.domain)
        if process.enclave and process.enclave.keystore == export and not process.network
        if process.enclave.is_there and not [*newer_files(process, process.enclave)]
    } & {process.enclave for process in observed.processes}


def _proofs(at: _Places, observed: ObservedProcesses, patience: float) -> list[Proof]:
    """Wait until each process runs in its enclave, and prove that the robot is closed."""
    from sros_tool.closing import Proof
    from sros_tool.runtime.processes import ProcessTable

    table, expected = ProcessTable(), {process.enclave for process in observed.processes}
    end = time.monotonic() + patience
    while True:
        running = table.look(now())
        missing = sorted(expected - _in_their_enclaves(at, observed, running))
        if not missing:
            break
        if time.monotonic() > end:
            named = first_few(missing, 5)
            reason = f"none with the present files of {named}; start it as {at.start} says"
            return [Proof(_CLAIM, False, reason)]
        time.sleep(0.2)
    before = _observation(at)
    return [
        _proof_of_processes(at, observed, running),
        _proof_of_talk(at, before, observed.domain),
        _proof_of_silence(at, before, observed.domain),
    ]


_CLAIM = "every process runs in its enclave"


def _proof_of_processes(
    at: _Places, observed: ObservedProcesses, running: RunningProcesses
) -> Proof:
    """Look for processes that are open, or that something is wrong with."""
    from sros_tool.checks.kind import NOTE
    from sros_tool.checks.processes import PROCESS_NOT_SEEN, process_findings
    from sros_tool.closing import Proof
    from sros_tool.runtime.variables import ENCLAVE

    export = shlex.quote(str(at.export))
    echo(f'$ eval "$(sros env {export} {_OBSERVER})"; sros check runtime', err=True)
    here = enclave_environment(at.export, _OBSERVER, str(observed.domain)).variables
    here[ENCLAVE] = ""  # this shell starts no node
    neighbours = [
        process
        for process in running.processes
        if process.domain == str(observed.domain) and not process.network
    ]
    running = replace(running, processes=tuple(neighbours))
    zone = local_zone(os.environ)
    findings = [
        finding
        for finding in process_findings({**os.environ, **here}, running, now=now(), zone=zone)
        if finding.severity > NOTE
    ]
    for finding in findings:
        echo_findings([finding], err=True)
    wrong = [finding for finding in findings if finding.id != PROCESS_NOT_SEEN.id]
    if findings:
        first = (wrong or findings)[0]
        return Proof(_CLAIM, False if wrong else None, f"{first.subject}: {first.text}")
    number = len({process.enclave for process in observed.processes})
    return Proof(_CLAIM, True, f"{counted(number, 'enclave')}, and no open process")


def _proof_of_talk(at: _Places, before: Observation, domain: int) -> Proof:
    """Compare what an observer in an enclave sees now with what was seen before."""
    from sros_tool.closing import Proof, lost_endpoints
    from sros_tool.graph.observation import from_json

    claim, denied = "everything that talked still talks", _denied(at, domain)
    words = ("audit", str(at.rights), "--keystore", str(at.export), "--enclave", _OBSERVER)
    step = _Step((*words, "--domain", str(domain), "--json"))
    echo(f"$ {step.command}", err=True)
    for _ in range(_TRIES):  # nodes may still be starting
        try:
            with redirect_stderr(io.StringIO()):  # JSON says it all
                status, output = _run(step)
        except UnavailableError as error:
            return Proof(claim, None, f"{error}")
        value = json.loads(output)
        wrong = {
            "gone": lost_endpoints(before, from_json(value), denied),
            "denied": [f"{right['enclave']} {right['name']}" for right in value["denied"]],
            "refused": [refused["enclave"] for refused in value["refused"]],
            "not seen": [unseen["node"] or unseen["enclave"] for unseen in value["unseen"]],
            "not judged": value["unjudged"],
            "not done": ["the ROS graph kept changing"] if status else [],
        }
        reason = next((f"{why}: {first_few(of, 3)}" for why, of in wrong.items() if of), "")
        if not reason:
            number = f"{counted(len(before.nodes), 'node')} with {before.endpoint_count} endpoints"
            but = f", but for {counted(len(denied), 'right')} that the policy denies now"
            return Proof(claim, True, f"{number} as before{but if denied else ''}")
    return Proof(claim, False, reason)


def _proof_of_silence(at: _Places, before: Observation, domain: int) -> Proof:
    """Look for nodes as an open listener, who saw them before."""
    from sros_tool.closing import Proof

    claim = "an open listener finds nothing"
    words = ("generate_policy", str(at.folder / "open.xml"), "--domain", str(domain))
    step = _Step((*words, "--dry-run", "--json"))
    echo(f"$ {step.command}", err=True)
    try:
        with redirect_stderr(io.StringIO()):  # why no node was observed
            _, output = _run(step)
    except UnavailableError as error:
        return Proof(claim, None, f"{error}")
    nodes = json.loads(output)["nodes"]
    if nodes:
        names = sorted(f"{node['namespace'].rstrip('/')}/{node['name']}" for node in nodes)
        return Proof(claim, False, f"it sees {first_few(names, 3)}")
    number = counted(len(before.nodes), "node")
    return Proof(claim, True, f"the observer that saw {number} before sees none")


# ── output ──────────────────────────────────────────────────────────────────────────────────


def _show(at: _Places, observed: ObservedProcesses, denied: Sequence[str]) -> None:
    """Print on one screen who may do what, how processes are restarted, and what looks wrong."""
    from sros_tool.closing import access_lines
    from sros_tool.files import policies_dir
    from sros_tool.policy.document import read_policy

    echo(f"who may do what, without what every node needs (all of it: {at.page}):")
    for line in access_lines(read_policy(at.policy), at.folder, policies_dir()):
        echo(f"  {line}")
    echo(f"how each process is restarted secured (all of it: {at.start}):")
    for process in observed.processes:
        how = "by its launch, by hand" if process.launch else "by hand"
        how = f"--apply restarts {process.unit}" if process.unit else how
        echo(f"  {process.enclave}: process {process.pid}, known by its {process.known_by}: {how}")
    for text in observed.unknown:
        echo(f"looks wrong: no node is known of {text}")
    for enclave in observed.elsewhere:
        echo(f"looks wrong: nodes of {enclave} are of no known process of this machine")
    for right in denied:
        echo(f"looks wrong: seen, and denied from now on: {right}")


def _show_end(
    at: _Places,
    observed: ObservedProcesses,
    problems: Sequence[str],
    proofs: Sequence[Proof],
    *,
    applies: bool,
    holds: bool,
) -> None:
    """Print problems and proofs, and what to do next."""
    from sros_tool.closing import COMMANDS

    folder = shlex.quote(str(at.folder))
    for proof in proofs:
        echo(f"{_ANSWERS[proof.holds]}: {proof.claim}: {proof.reason}")
    for problem in problems:
        echo(f"looks wrong: {problem}")
    if holds:
        left = "" if all(proof.holds for proof in proofs) else ", but for what was not asked"
        keys = f"bring {folder}/keystore to another machine: it has the CA keys"
        echo(f"the robot is closed{left}; {keys}", err=True)
    elif proofs:
        again = f"ask again with sros close {folder} --proof, or go back with --undo"
        echo(f"this is not proved; {again}", err=True)
    elif problems and applies:
        echo("nothing was closed; mend this, and run it again", err=True)
    elif applies:
        for command, processes in observed.by_hand(at.folder.absolute()).items():
            pids = enumerated([str(process.pid) for process in processes])
            echo(f"stop process {pids}, and start it by:")
            echo(f"  {command}")
        echo(f"then: sros close {folder} --proof", err=True)
    elif at.lacks:
        echo(f"nothing is closed yet; {at.lacks}", err=True)
    elif problems:
        echo("nothing is closed yet; next: mend this, and run it again", err=True)
    elif any(process.unit for process in observed.processes):
        echo(f"nothing is closed yet; next: sros close {folder} --apply", err=True)
    else:
        how = f"start each process as {at.start / COMMANDS} says"
        echo(f"nothing is closed yet; next: stop the robot, {how}, and ask", err=True)
        echo(f"sros close {folder} --proof", err=True)


_ANSWERS = {True: "yes", False: "no", None: "not asked"}
