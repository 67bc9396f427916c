"""Common parts of the verbs that observe the ROS graph: options, the observer, its failures."""

from __future__ import annotations

import os
import re
import signal
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import click

from sros_tool.cli.common import (
    KEYSTORE_VARIABLE,
    PATH,
    Decorated,
    Verb,
    dry_run_option,
    enclave_environment,
    json_option,
    print_json,
    print_notes,
    read_log,
    verb,
)
from sros_tool.errors import SrosError, UnavailableError, UsageError
from sros_tool.terminal import echo, echo_document
from sros_tool.values import FileChange, file_change
from sros_tool.wording import counted

if TYPE_CHECKING:
    from sros_tool.graph.learn import DenialLine, Draft, Learned, LearnedPolicy
    from sros_tool.graph.observation import Observation
    from sros_tool.graph.observe import ObserverError, RosGraph, Snapshot
    from sros_tool.policy.model import Policy


# ── options ─────────────────────────────────────────────────────────────────────────────


_FOREVER = "until Ctrl-C"
_DURATION = re.compile(r"\d+[smhdwy]\Z", re.ASCII)


class WatchingVerb(Verb):
    """A command whose ``--watch`` needs no value."""

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """Parse the arguments, with a value after each ``--watch`` that has none."""
        words: list[str] = []
        for index, word in enumerate(args):
            words.append(word)
            follows = args[index + 1] if index + 1 < len(args) else ""
            if word == "--watch" and not _DURATION.match(follows):
                words.append(_FOREVER)
        return super().parse_args(ctx, words)


def observing_options(enclave_help: str) -> Callable[[Decorated], Decorated]:
    """Add the options that choose how long to observe, in which domain and in which enclave."""

    def add(function: Decorated) -> Decorated:
        for option in (
            click.option(
                "--keystore",
                type=PATH,
                metavar="KEYSTORE",
                help="The keystore that has the enclave of --enclave. [default: "
                "$ROS_SECURITY_KEYSTORE]",
            ),
            click.option("--enclave", metavar="ENCLAVE", help=enclave_help),
            click.option(
                "--domain", metavar="ID", help="The ROS domain. [default: $ROS_DOMAIN_ID, or 0]"
            ),
            click.option(
                "--spin-time",
                type=click.FloatRange(0.1, 86400),
                metavar="S",
                help="Observe for S seconds.",
            ),
            click.option(
                "--watch",
                metavar="[DURATION]",
                help="Keep observing for DURATION, such as 10m, or until Ctrl-C.",
            ),
        ):
            function = option(function)
        return function

    return add


def check_duration(watch: str | None, spin_time: float | None) -> None:
    """Raise `UsageError` if both --watch and --spin-time are given."""
    if watch is not None and spin_time is not None:
        raise UsageError("--watch and --spin-time exclude each other", "", "Choose one.")


# ── observing ───────────────────────────────────────────────────────────────────────────


def observer_environment(
    enclave: str | None, keystore: Path | None, domain: str | None, arguments: str
) -> dict[str, str]:
    """Return the environment variables that give the observer its domain and its enclave.

    ``arguments`` is a clause that says what the verb's arguments are, to explain in an error why
    they do not name the keystore.
    """
    from sros_tool.runtime.variables import DOMAIN, domain_from

    if enclave is None:
        if keystore is not None:
            raise UsageError(
                "--keystore is given without --enclave", "", "Name the observer's enclave."
            )
        if domain is None:
            domain_from(os.environ)
            return {}
        return {DOMAIN: str(domain_from({DOMAIN: domain}) or 0)}
    from sros_tool.keystore.reader import OpenedKeystore

    root = keystore or os.environ.get(KEYSTORE_VARIABLE)
    if not root:
        raise UsageError(
            f"the keystore of --enclave {enclave} is not named",
            f"No argument names it: {arguments}.",
            f"Add --keystore KEYSTORE, or set {KEYSTORE_VARIABLE}.",
        )
    return enclave_environment(OpenedKeystore(Path(root)), enclave, domain).variables


def observe(
    environment: dict[str, str],
    watch: str | None,
    spin_time: float | None,
    report: Callable[[Observation], None],
    *,
    at_end: str,
) -> tuple[Snapshot, str]:
    """Observe the ROS graph; return the result and the RMW in use.

    ``watch`` is the value of --watch; None observes for ``spin_time`` seconds, or until the graph
    stops changing.  While watching, ``report`` gets all observations so far whenever there is a new
    one; ``at_end`` tells the user what happens at the end.
    """
    from sros_tool.graph.observe import (
        SECURED,
        ObserverError,
        RosGraph,
        Settling,
        observe_for,
        settle,
        with_certified_enclaves,
        with_owners_of_strays,
    )
    from sros_tool.runtime.variables import ENABLE
    from sros_tool.validity import parse_duration

    seconds = None
    variables = {**os.environ, **environment}
    enclaves = _enclaves_by_identity(variables)

    def identify(observation: Observation) -> Observation:
        return with_certified_enclaves(observation, enclaves)

    if watch not in (None, _FOREVER):
        seconds = parse_duration(watch).total_seconds()
    try:
        with RosGraph(environment) as graph:
            if watch is not None:
                snapshot = _watch(graph, seconds, lambda seen: report(identify(seen)), at_end)
            elif spin_time is not None:
                snapshot = observe_for(graph, spin_time, time.monotonic)
            else:
                settling = SECURED if variables.get(ENABLE) == "true" else Settling()
                snapshot = settle(graph, settling, time.monotonic)
            return replace(
                snapshot,
                observation=identify(snapshot.observation),
                everything=identify(with_owners_of_strays(snapshot.everything)),
            ), graph.rmw
    except ObserverError as error:
        raise _observer_error(error, environment) from error


def _enclaves_by_identity(environment: Mapping[str, str]) -> dict[str, str]:
    """Map the identities of participants to enclaves; empty if the observer is not secured."""
    from sros_tool.keystore.known_keys import enclaves_by_identity
    from sros_tool.keystore.layout import is_keystore
    from sros_tool.keystore.reader import OpenedKeystore
    from sros_tool.runtime.variables import ENABLE, KEYSTORE

    root = Path(environment.get(KEYSTORE, ""))
    if environment.get(ENABLE) != "true" or not is_keystore(root):
        return {}
    return enclaves_by_identity(OpenedKeystore(root))


def _watch(
    graph: RosGraph, seconds: float | None, report: Callable[[Observation], None], at_end: str
) -> Snapshot:
    from sros_tool.graph.observe import watch

    with _signal_watch() as stopped:
        until = f"for {seconds:.0f} s, or {_FOREVER}" if seconds else _FOREVER
        echo(f"watching {until}; then {at_end}", err=True)
        begin = time.monotonic()
        snapshot = watch(graph, seconds, time.monotonic, stop=stopped, report=report)
        if stopped():
            echo(f"stopped watching after {time.monotonic() - begin:.0f} s", err=True)
        return snapshot


@contextmanager
def _signal_watch() -> Iterator[Callable[[], bool]]:
    """Catch Ctrl-C and SIGTERM; yield a function that returns whether one was received."""
    came: list[int] = []

    def note_signal(number: int, _frame: object) -> None:
        came.append(number)

    before = {
        number: signal.signal(number, note_signal) for number in (signal.SIGINT, signal.SIGTERM)
    }
    try:
        yield lambda: bool(came)
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _observer_error(error: ObserverError, environment: dict[str, str]) -> SrosError:
    """Return an error for the observer's failure, with the cause that its DDS output shows."""
    from sros_tool.runtime.variables import ENABLE, ENCLAVE
    from sros_tool.runtime.vendor_log import (
        endpoint_refusal,
        missing_security,
        participant_refusal,
        plain_text,
    )

    error_text = f"{error.output}\n{error.reason}"
    if line := missing_security(error_text):
        return UnavailableError(
            "the DDS of this rclpy was built without DDS Security, so it cannot observe a secured "
            "robot",
            f"DDS says: {line}",
            "Use a ROS 2 whose DDS has DDS Security, such as the packages of Ubuntu; `sros "
            "doctor` shows "
            "which DDS here enforces security.",
        )
    name = environment.get(ENCLAVE) or os.environ.get(ENCLAVE) or "/"
    is_by_shell = ENABLE not in environment and os.environ.get(ENABLE) == "true"
    by_shell = f" (the observer runs in it because {ENABLE} is set)" if is_by_shell else ""
    if line := endpoint_refusal(error_text):
        return SrosError(
            f"the enclave {name} does not permit an observer{by_shell}",
            f"DDS says: {line}",
            "The rights that an observer needs are in policies/observer.xml (see `sros "
            "policies`), for an "
            "enclave named /sros_observer.",
        )
    if line := participant_refusal(error_text):
        return SrosError(
            f"DDS refuses the enclave {name}{by_shell}",
            f"DDS says: {line}",
            f"Run `sros inspect` on the enclave{', or unset ' + ENABLE if by_shell else ''}.",
        )
    last = [line for line in plain_text(error.output).splitlines() if line.strip()][-1:]
    why = error.reason + (f" The observer's last message: {last[0].strip()}" if last else "")
    return UnavailableError(error.what, why, "`sros doctor` shows what works here.")


def why_no_node_was_observed(
    environment: Mapping[str, str], seconds: float, rmw: str, enclave: str | None
) -> str:
    """Return the likely reasons why no node was observed, and a remedy."""
    from sros_tool.checks.environment import security_clauses
    from sros_tool.runtime.variables import DOMAIN, KEYSTORE

    merged = {**os.environ, **environment}
    looked = f"Observed domain {merged.get(DOMAIN) or 0} for {seconds:.0f} s with {rmw}. "
    if enclave is not None:
        return looked + (
            f"The observer ran secured, in enclave {enclave}: the observer does not see nodes that "
            "are unsecured, have a certificate of another CA, or use another DDS."
        )
    if secured := [*security_clauses(merged, Path.cwd())]:
        return looked + (
            f"The observer does not see open nodes, because {' and '.join(secured)}. To observe an "
            "open robot, unset the named variables, or run sros in a folder without the named "
            "file. To observe a secured robot, give --keystore and --enclave."
        )
    if merged.get(KEYSTORE):
        return looked + (
            f"{KEYSTORE} is set, so the robot may be secured, and secured nodes are invisible to "
            "an observer without an enclave. Observe with --enclave /sros_observer, made from "
            "policies/observer.xml (see `sros policies`)."
        )
    return looked + (
        "Nodes may be in another domain (ROS_DOMAIN_ID, --domain), on another network, or secured: "
        "secured nodes are invisible to an observer without --enclave and --keystore."
    )


# ── generate_policy ───────────────────────────────────────────────────────────────────────────


_NO_NODES = "No nodes detected in the ROS graph. No policy file was generated."
"""The message of ros2/sros2; scripts look for it."""


class _ObservingCommand(WatchingVerb):
    """A command whose ``--watch`` needs no value, and whose ``--from-log`` takes several values."""

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        words: list[str] = []
        in_logs = False
        for index, word in enumerate(args):
            follows = args[index + 1] if index + 1 < len(args) else ""
            if in_logs and (word == "-" or not word.startswith("-")):
                words += ["--from-log", word]
                continue
            in_logs = word == "--from-log"
            if in_logs and follows and (follows == "-" or not follows.startswith("-")):
                continue  # the option is added before each file instead
            words.append(word)
        return super().parse_args(ctx, words)


@verb("generate_policy", cls=_ObservingCommand)
@click.argument("file", type=PATH, required=False)
@observing_options("The enclave of the observer; with --from-log, of the node.")
@click.option(
    "--enclave-per-node",
    is_flag=True,
    help="Give every process without a known enclave an enclave named after its node.",
)
@click.option("--flat", is_flag=True, help="Write one file, without includes of common parts.")
@click.option(
    "--from-log",
    "logs",
    multiple=True,
    type=PATH,
    metavar="LOG...",
    help="Do not observe: add the rights that Fast DDS or Cyclone DDS denied, as these logs say "
    "(- is stdin).",
)
@click.option(
    "--node",
    metavar="/NS/NAME",
    help="With --from-log: the node to whose profile the rights are added.",
)
@click.option(
    "--accept",
    is_flag=True,
    help="Write the rights that --from-log proposes; without --accept, they are only shown.",
)
@click.option(
    "-s", "--use-sim-time", is_flag=True, help="Accepted and ignored: observing needs no clock."
)
@click.option(
    "--no-daemon", is_flag=True, help="Accepted and ignored: sros never uses the ROS daemon."
)
@dry_run_option
@json_option
def generate_policy(
    file: Path | None,
    watch: str | None,
    spin_time: float | None,
    enclave_per_node: bool,
    flat: bool,
    domain: str | None,
    enclave: str | None,
    keystore: Path | None,
    logs: tuple[Path, ...],
    node: str | None,
    accept: bool,
    use_sim_time: bool,
    no_daemon: bool,
    dry_run: bool,
    as_json: bool,
) -> int:
    r"""Write to FILE the smallest policy that allows everything the robot is observed to do.

    Observes the running nodes until the ROS graph stops changing, about four seconds. An existing
    FILE keeps its content; new rights are added to it. Read the result before you enforce it: on a
    robot that is not secured yet, an attacker's nodes are observed, too.

    With --from-log, the rights are those that logs report as denied. Any process can print such a
    line, so the rights are shown with the lines that report them, and written only with --accept.
    If FILE lacks some of these rights, the exit status without --accept is 2. Without FILE, the
    rights are printed as a policy, for merge_policy.

    Example:
      $ sros generate_policy robot.xml
      wrote 'robot.xml': 2 enclaves, 2 nodes, 20 rights
      copied common/node/logging.xml, ... next to 'robot.xml'
      $ sros generate_policy robot.xml --watch 10m
      watching for 600 s, or until Ctrl-C; then the policy is written
      seen: /talker (/talker_listener/talker)
      seen: /talker (/talker_listener/talker) publish /chatter
      ...
      $ sros generate_policy unsecured.xml --enclave-per-node
      wrote 'unsecured.xml': 2 enclaves, 2 nodes, 20 rights
      $ sros generate_policy robot.xml --enclave /talker_listener/talker \
            --from-log talker.log --accept
      added 1 right to 'robot.xml'
        /talker_listener/talker ALLOW publish topic /nope
      a process can print any line; these log lines ask for the rights:
        talker.log:7: talker-1: publish rt/nope in /talker_listener/talker

    On a secured robot, observe in a separate enclave. Create this enclave with `sros
    generate_artifacts -k KEYSTORE -p observer.xml`: policies/observer.xml (see `sros policies`) has
    the few rights that the observer needs. Observe with --keystore KEYSTORE --enclave
    /sros_observer.
    """
    present = _present_policy(file)
    if logs:
        if enclave_per_node:
            raise UsageError(
                "--enclave-per-node is not for --from-log",
                "A denial in a log belongs to the enclave in which the process ran.",
                "Leave it out.",
            )
        if accept and file is None:
            raise UsageError("--accept is given without FILE", "", "Name the policy to change.")
        from sros_tool.explain.denials import learned_from_logs

        texts = {log: _log_text(log) for log in logs}
        learned, lines, denied = learned_from_logs(
            texts, file=file, enclave=enclave or "", node=_namespace_and_name(node), present=present
        )
        if not learned.profiles:
            print_notes(learned.notes)
            no_proposal = "No right can be proposed for the denials in the logs."
            echo(no_proposal if denied else "The logs report no denial.", err=True)
        return _propose(learned.flat() if flat else learned, lines, file, accept, dry_run, as_json)
    if accept:
        raise UsageError("--accept is for --from-log only")
    if file is None:
        raise UsageError("no file is named", "", "Name the policy FILE to write.")
    if node is not None:
        raise UsageError("--node is for --from-log only")
    check_duration(watch, spin_time)
    from sros_tool.files import policies_dir
    from sros_tool.graph.learn import (
        NamedEnclaves,
        ReportedRights,
        common_parts,
        draft,
        learn,
        notes_on_ended_nodes,
        write,
    )
    from sros_tool.graph.learn import enclave_per_node as name_enclaves

    common = common_parts(file.parent, policies_dir())
    news = ReportedRights(common)

    def named(observation: Observation) -> NamedEnclaves:
        return name_enclaves(observation) if enclave_per_node else NamedEnclaves(observation, ())

    def report(observation: Observation) -> None:
        for line in news.lines(named(observation).observation):
            echo(line, err=True)

    written = f"'{file}' is the policy to write"
    environment = observer_environment(enclave, keystore, domain, written)
    snapshot, rmw = observe(
        environment,
        watch,
        spin_time,
        report,
        at_end="the result is shown" if dry_run else "the policy is written",
    )
    seen = named(snapshot.observation if watch is None else snapshot.everything)
    stayed = {node.participant for node in snapshot.observation.nodes}
    ended = sorted({node.participant for node in seen.observation.nodes} - stayed)
    learned = learn(seen.observation, None if flat else common).with_notes(seen.notes)
    if watch is None:
        learned = learned.with_notes(notes_on_ended_nodes(snapshot.gone, snapshot.everything))
    if not learned.profiles:
        if as_json:
            value = _learned_json(None, file, learned, seen.observation, dry_run)
            print_json(value._replace(settled=not snapshot.unsettled))
        echo(_NO_NODES, err=True)
        print_notes(learned.notes)
        echo(why_no_node_was_observed(environment, snapshot.seconds, rmw, enclave), err=True)
        return 1
    plan = draft(file, learned, None if flat else common)
    if not dry_run:
        write(plan)
    if as_json:
        print_json(
            _learned_json(plan, file, learned, seen.observation, dry_run)._replace(
                ended=ended,
                intermittent=sorted(snapshot.intermittent),
                settled=not snapshot.unsettled,
            )
        )
    else:
        _show(plan, learned, written=not dry_run)
    if why := snapshot.unsettled:
        advice = "--watch collects nodes that come and go"
        advice = "watch again for longer" if snapshot.grew else advice
        echo(f"{why}, so more may be missing; {advice}.", err=True)
    return 0


def _present_policy(file: Path | None) -> Policy | None:
    """Return the policy in ``file``, or None without a file.

    Called before observing, so that a broken policy is reported immediately.
    """
    from sros_tool.policy.document import read_policy

    if file is None:
        return None
    if os.path.lexists(file):
        return read_policy(file)
    if not file.parent.is_dir():
        raise UsageError(f"the folder '{file.parent}' does not exist", "", "Create it first.")
    return None


def _learned_json(
    plan: Draft | None, file: Path | None, learned: Learned, observation: Observation, dry_run: bool
) -> LearnedPolicy:
    """Return the ``--json`` output about learned rights; without a ``plan``, no file changes."""
    from sros_tool.graph.learn import LearnedPolicy
    from sros_tool.policy.merge import merge_notes
    from sros_tool.policy.rights import order, policy_rights

    copied = sorted(plan.copies) if plan else []
    changes: list[FileChange] = []
    if plan:
        if plan.changes:
            changes += file_change(plan.path, existed=plan.before is not None)
        for name in copied:
            changes += file_change(plan.path.parent / name, existed=False)
    contradictions = merge_notes(plan.contradictions) if plan else ()
    return LearnedPolicy(
        file,
        learned.source,
        created=plan is not None and plan.before is None,
        changed=plan is not None and plan.changes,
        dry_run=dry_run,
        observation=observation,
        ended=(),
        intermittent=(),
        settled=True,
        added=plan.added if plan else sorted(policy_rights(learned.policy()), key=order),
        copied=copied,
        accepted=None,
        denials=None,
        changes=changes,
        notes=(*contradictions, *learned.notes),
    )


def _show(plan: Draft, learned: Learned, *, written: bool) -> None:
    from sros_tool.graph.learn import RightsOrigin
    from sros_tool.policy.merge import merge_notes

    from_log = learned.source is RightsOrigin.LOG
    would = "" if written else "would have "
    if plan.before is None:
        enclaves = {profile.enclave for profile in learned.profiles}
        echo(
            f"{would}{'wrote' if written else 'written'} '{plan.path}': "
            f"{counted(len(enclaves), 'enclave')}, {counted(len(learned.profiles), 'node')}, "
            f"{counted(len(plan.added), 'right')}"
        )
    elif plan.added:
        echo(f"{would}added {counted(len(plan.added), 'right')} to '{plan.path}'")
    else:
        known = "denied" if from_log else "observed"
        echo(f"nothing to add: '{plan.path}' already covers all rights that were {known}")
    if plan.before is not None or from_log:
        for right in plan.added:
            echo(f"  {right}")
    if plan.copies:
        echo(f"{would}copied {', '.join(sorted(plan.copies))} next to '{plan.path}'")
    print_notes((*merge_notes(plan.contradictions), *learned.notes))


# ── from logs ───────────────────────────────────────────────────────────────────────────


def _propose(
    learned: Learned,
    lines: Sequence[DenialLine],
    file: Path | None,
    accept: bool,
    dry_run: bool,
    as_json: bool,
) -> int:
    """Show the rights that logs report as denied, and the lines; write the rights if accepted.

    Returns 1 if the logs report no denied right, else 0.

    Raises:
        SrosError: rights were proposed, and not accepted.
    """
    from sros_tool.explain.denials import lines_asking_for
    from sros_tool.files import policies_dir
    from sros_tool.graph.learn import common_parts, draft, render, write
    from sros_tool.graph.observation import Observation

    if not learned.profiles or file is None:
        if as_json:
            value = _learned_json(None, file, learned, Observation(), dry_run)
            print_json(value._replace(accepted=accept, denials=lines))
        if not learned.profiles:
            return 1
        if not as_json:
            print_notes(learned.notes)
            echo_document(render(learned).decode())
            _show_lines(lines, err=True)
        return 0
    common = common_parts(file.parent, policies_dir()) if learned.includes else None
    plan = draft(file, learned, common)
    written = accept and not dry_run
    if written:
        write(plan)
    if as_json:
        value = _learned_json(plan, file, learned, Observation(), dry_run)
        if not (written or dry_run):
            value = value._replace(changes=())
        print_json(value._replace(accepted=accept, denials=lines))
    else:
        _show(plan, learned, written=written)
        _show_lines(lines_asking_for(plan.added, lines) if plan.changes else ())
    if plan.changes and not accept and not dry_run:
        raise SrosError(
            f"the rights were not written to '{file}'",
            "The rights come from a log, and a process can print any line.",
            "Check which process needs each right, and add --accept.",
        )
    return 0


def _show_lines(lines: Sequence[DenialLine], *, err: bool = False) -> None:
    if lines:
        echo("a process can print any line; these log lines ask for the rights:", err=err)
    for line in lines:
        by = line.process or "a process without a name in the log"
        denial = f"{line.direction} {line.topic} in {line.enclave}"
        echo(f"  {line.log}:{line.line}: {by}: {denial}", err=err)


def _log_text(log: Path) -> str:
    if str(log) != "-" and not log.exists():
        raise UsageError(
            f"the log '{log}' does not exist",
            "--from-log takes all following file names.",
            "Correct the name of the log; write the policy FILE before --from-log.",
        )
    return read_log(str(log))


def _namespace_and_name(node: str | None) -> tuple[str, str] | None:
    from sros_tool.names import check_namespace, node_name_problem

    if node is None:
        return None
    ns, _, name = node.rpartition("/")
    if problem := node_name_problem(name):
        raise UsageError(f"--node {node!r} is not a node", problem, "Write it as /namespace/name.")
    return check_namespace(ns), name
