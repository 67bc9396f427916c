"""The verb `generate_policy`: learn a policy from the ROS graph, or from denials in logs."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from sros_tool.cli.common import (
    PATH,
    dry_run_option,
    json_option,
    print_json,
    print_notes,
    read_log,
)
from sros_tool.cli.observing import (
    Watching,
    check_duration,
    observe,
    observer_environment,
    observing_options,
    why_empty,
)
from sros_tool.errors import SrosError, UsageError
from sros_tool.terminal import echo, echo_document
from sros_tool.values import as_plain
from sros_tool.wording import counted
from sros_tool.written import FileChange, file_change

if TYPE_CHECKING:
    from sros_tool.graph.document import Draft
    from sros_tool.graph.learn import Learned
    from sros_tool.graph.observation import Observation
    from sros_tool.policy.model import Policy


_NO_NODES = "No nodes detected in the ROS graph. No policy file was generated."
"""The message of ros2/sros2; scripts look for it."""


class _Words(Watching):
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


@click.command(
    "generate_policy",
    cls=_Words,
    epilog="""\b
Example:
  $ sros generate_policy robot.xml
  wrote 'robot.xml': 2 enclaves, 2 nodes, 20 rights
  copied common/node/logging.xml, common/node/types.xml, ... next to it
  $ sros generate_policy robot.xml --watch 10m
  watching for 600 s, or until Ctrl-C; then the policy is written
  new: /talker (/talker_listener/talker)
  new: /talker (/talker_listener/talker) publish /chatter
  ...
  $ sros generate_policy unsecured.xml --enclave-per-node
  wrote 'unsecured.xml': 2 enclaves, 2 nodes, 20 rights
  $ sros generate_policy robot.xml --enclave /talker_listener/talker \\
        --from-log talker.log --accept
  added 1 right to 'robot.xml'
    /talker_listener/talker ALLOW publish topic /nope
  these lines of logs ask for it; a process can print any line:
    talker.log:7: talker-1: publish rt/nope in /talker_listener/talker

On a secured robot, observe in a separate enclave. Create it with `sros generate_artifacts -k ROOT
-p observer.xml`: policies/observer.xml (see `sros policies`) has the few rights it needs. Observe
with --keystore ROOT --enclave /sros_observer.""",
)
@click.argument("file", type=PATH, required=False)
@observing_options("Observe in this enclave; with --from-log, the enclave of the node.")
@click.option(
    "--enclave-per-node",
    is_flag=True,
    help="Give each process whose enclave the graph does not show one with the name of its node.",
)
@click.option("--flat", is_flag=True, help="Write one file, without includes of common parts.")
@click.option(
    "--from-log",
    "logs",
    multiple=True,
    type=PATH,
    metavar="LOG...",
    help="Do not observe; add rights that Fast DDS or Cyclone DDS denied in these logs (- is "
    "stdin).",
)
@click.option("--node", metavar="/NS/NAME", help="The node whose profile --from-log adds to.")
@click.option(
    "--accept",
    is_flag=True,
    help="Write the rights that --from-log proposes; without it, they are only shown.",
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
    """Write to FILE the smallest policy that allows everything the robot is observed to do.

    Observes the running nodes until the ROS graph stops changing, about four seconds. An existing
    FILE keeps its content; new rights are added to it. Read the result before you enforce it: on a
    robot that is not secured yet, an attacker's nodes are observed, too.

    A log proves less: a process can print any line, and so ask for rights. Rights from a log are
    shown with the lines that ask for them, and are written only with --accept; the exit status is 2
    if that is missing. Without FILE, the rights are printed as a policy, for merge_policy.
    """
    present = _present_policy(file)
    if logs:
        if enclave_per_node:
            raise UsageError(
                "--enclave-per-node is not for --from-log",
                "A denial in a log is of the enclave that its process ran in.",
                "Leave it out.",
            )
        if accept and file is None:
            raise UsageError("--accept is given without FILE", "", "Name the policy to change.")
        learned, lines = _learned_from_logs(logs, file, enclave, node, present)
        return _propose(learned.flat() if flat else learned, lines, file, accept, dry_run, as_json)
    if accept:
        raise UsageError("--accept is for --from-log only")
    if file is None:
        raise UsageError("no file is named", "", "Name the policy FILE to write.")
    if node is not None:
        raise UsageError("--node is for --from-log only")
    check_duration(watch, spin_time)
    from sros_tool.graph.document import draft, write
    from sros_tool.graph.enclaves import NamedEnclaves
    from sros_tool.graph.enclaves import enclave_per_node as name_enclaves
    from sros_tool.graph.learn import News, common_parts, is_tool_name, learn, listed
    from sros_tool.resources import policies_dir

    common = common_parts(file.parent, policies_dir())
    news = News(common)

    def named(observation: Observation) -> NamedEnclaves:
        return name_enclaves(observation) if enclave_per_node else NamedEnclaves(observation, ())

    def report(observation: Observation) -> None:
        for line in news.lines(named(observation).observation):
            echo(line, err=True)

    environment = observer_environment(enclave, keystore, domain)
    snapshot, rmw = observe(
        environment,
        watch,
        spin_time,
        report,
        secured=enclave is not None,
        then="the policy is written",
    )
    found = named(snapshot.observation)
    learned = learn(found.observation, None if flat else common).noting(found.notes)
    if not learned.profiles:
        if as_json:
            print_json(_json(None, file, learned, found.observation, dry_run))
        echo(_NO_NODES, err=True)
        print_notes(learned.notes)
        echo(why_empty(environment, snapshot.seconds, rmw, enclave), err=True)
        return 1
    plan = draft(file, learned, None if flat else common)
    if not dry_run:
        write(plan)
    if as_json:
        print_json(_json(plan, file, learned, found.observation, dry_run))
    else:
        _show(plan, learned, written=not dry_run)
    if gone := sorted(each for each in snapshot.gone if not is_tool_name(each.rpartition("/")[2])):
        text = f"left out, because these nodes went while the graph was observed: {listed(gone)}"
        echo(f"{text}; --watch keeps them.", err=True)
    if not snapshot.settled:
        echo(
            f"the ROS graph kept changing for {snapshot.seconds:.0f} s; use --watch to collect "
            "nodes that come and go.",
            err=True,
        )
    return 0


def _present_policy(file: Path | None) -> Policy | None:
    """Return the policy in ``file``, or None without one.

    Called before observing, so that a broken policy is reported at once.
    """
    from sros_tool.policy.document import read_policy

    if file is None:
        return None
    if os.path.lexists(file):
        return read_policy(file)
    if not file.parent.is_dir():
        raise UsageError(f"the folder '{file.parent}' does not exist", "", "Create it first.")
    return None


def _json(
    plan: Draft | None, file: Path | None, learned: Learned, observation: Observation, dry_run: bool
) -> dict[str, Any]:
    """Return what was learned as JSON values; without a ``plan``, no file changes."""
    from sros_tool.policy.merge import merge_notes
    from sros_tool.policy.rights import order, policy_rights

    value: dict[str, Any] = {
        "file": str(file) if file else None,
        "source": learned.source.value,
        "created": False,
        "changed": False,
        "dry_run": dry_run,
        **as_plain(observation),
        "added": as_plain(sorted(policy_rights(learned.policy()), key=order)),
        "copied": [],
        "changes": [],
        "notes": as_plain(learned.notes),
    }
    if plan:
        copied = sorted(plan.copies)
        changes = file_change(plan.path, existed=plan.before is not None) if plan.changes else []
        value |= {
            "created": plan.before is None,
            "changed": plan.changes,
            "added": as_plain(plan.added),
            "copied": copied,
            "changes": [*changes, *(_created(plan.path.parent / each) for each in copied)],
            "notes": as_plain((*merge_notes(plan.contradictions), *learned.notes)),
        }
    return value


def _created(path: Path) -> FileChange:
    (change,) = file_change(path, existed=False)
    return change


def _show(plan: Draft, learned: Learned, *, written: bool) -> None:
    from sros_tool.graph.learn import RightsFound
    from sros_tool.policy.merge import merge_notes

    from_log = learned.source is RightsFound.LOG
    would = "" if written else "would have "
    if plan.before is None:
        enclaves = {each.enclave for each in learned.profiles}
        echo(
            f"{would}{'wrote' if written else 'written'} '{plan.path}': "
            f"{counted(len(enclaves), 'enclave')}, {counted(len(learned.profiles), 'node')}, "
            f"{counted(len(plan.added), 'right')}"
        )
    elif plan.added:
        echo(f"{would}added {counted(len(plan.added), 'right')} to '{plan.path}'")
    else:
        known = "denied" if from_log else "observed"
        echo(f"nothing to add: '{plan.path}' already covers everything that was {known}")
    if plan.before is not None or from_log:
        for each in plan.added:
            echo(f"  {each}")
    if plan.copies:
        echo(f"{would}copied {', '.join(sorted(plan.copies))} next to it")
    print_notes((*merge_notes(plan.contradictions), *learned.notes))


# ── from logs ───────────────────────────────────────────────────────────────────────────


def _learned_from_logs(
    logs: Sequence[Path],
    file: Path | None,
    enclave: str | None,
    node: str | None,
    present: Policy | None,
) -> tuple[Learned, list[dict[str, Any]]]:
    """Return the rights that logs ask for, and the lines that ask for them, as JSON objects."""
    from sros_tool.explain.denials import as_learned, propose, read_denials
    from sros_tool.graph.learn import common_parts
    from sros_tool.resources import policies_dir
    from sros_tool.runtime.vendor_log import plain_text

    denials = {log: read_denials(plain_text(_log_text(log))) for log in logs}
    missing = propose(each for found in denials.values() for each in found)
    common = common_parts(file.parent if file else policies_dir(), policies_dir())
    learned = as_learned(missing, enclave or "", _place(node), present, common)
    asked = {profile.enclave for profile in learned.profiles}
    lines = [
        {
            "log": str(log),
            "line": each.line,
            "process": each.process or None,
            "enclave": each.enclave or enclave,
            "direction": each.direction,
            "topic": each.topic,
        }
        for log, found in denials.items()
        for each in found
        if propose([each]).rights and (each.enclave or enclave) in asked
    ]
    if not learned.profiles:
        print_notes(learned.notes)
        echo(
            "No right can be proposed for the denials in the logs."
            if any(denials.values())
            else "The logs report no denial.",
            err=True,
        )
    return learned, lines


def _propose(
    learned: Learned,
    lines: Sequence[Mapping[str, Any]],
    file: Path | None,
    accept: bool,
    dry_run: bool,
    as_json: bool,
) -> int:
    """Show the rights that logs ask for, and the lines; write the rights if they are accepted.

    Raises:
        SrosError: there is something to write that was not accepted.
    """
    from sros_tool.graph.document import draft, render, write
    from sros_tool.graph.learn import common_parts
    from sros_tool.graph.observation import Observation
    from sros_tool.resources import policies_dir

    if not learned.profiles or file is None:
        if as_json:
            value = _json(None, file, learned, Observation(), dry_run)
            print_json({**value, "source": "log", "accepted": accept, "denials": lines})
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
        value = _json(plan, file, learned, Observation(), dry_run)
        if not (written or dry_run):
            value["changes"] = []
        print_json({**value, "accepted": accept, "denials": lines})
    else:
        _show(plan, learned, written=written)
        _show_lines(lines if plan.changes else ())
    if plan.changes and not accept and not dry_run:
        raise SrosError(
            f"the rights were not written to '{file}'",
            "They come from a log, and a process can print any line.",
            "Check which process needs each right, and add --accept.",
        )
    return 0


def _show_lines(lines: Sequence[Mapping[str, Any]], *, err: bool = False) -> None:
    if lines:
        echo("these lines of logs ask for it; a process can print any line:", err=err)
    for each in lines:
        by = each["process"] or "a process without a label"
        what = f"{each['direction']} {each['topic']} in {each['enclave']}"
        echo(f"  {each['log']}:{each['line']}: {by}: {what}", err=err)


def _log_text(log: Path) -> str:
    if str(log) != "-" and not log.exists():
        raise UsageError(
            f"the log '{log}' does not exist",
            "--from-log takes all file names that follow it.",
            "Correct the name; if it is the policy FILE, write it before --from-log.",
        )
    return read_log(str(log))


def _place(node: str | None) -> tuple[str, str] | None:
    from sros_tool.names import check_namespace, expression_problem

    if node is None:
        return None
    ns, _, name = node.rpartition("/")
    if problem := expression_problem(name):
        raise UsageError(f"--node {node!r} is not a node", problem, "Write it as /namespace/name.")
    return check_namespace(ns), name
