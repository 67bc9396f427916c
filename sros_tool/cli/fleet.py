"""The verbs `sros fleet ...`: list robots, store their reports, compare them with the keystore."""

from __future__ import annotations

import os
import re
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from shlex import quote
from types import MappingProxyType
from typing import TYPE_CHECKING, NamedTuple

import click

from sros_tool.cli.common import (
    PATH,
    Decorated,
    Verb,
    advisories_of,
    advisories_option,
    allow_refusal_option,
    check_metrics_file,
    check_output,
    complete_file,
    complete_robot,
    dry_run_option,
    finding_lines,
    json_option,
    json_text,
    keyring,
    keystore_argument,
    keystore_arguments,
    local_zone,
    now,
    output_option,
    print_json,
    print_notes,
    progress,
    read_file_or_stdin,
    robot_option,
    root_and_file,
    save,
    try_passphrase,
)
from sros_tool.cli.program import VerbGroup
from sros_tool.errors import NOT_DONE, Note, SrosError, UsageError
from sros_tool.terminal import echo, echo_document, visible_line
from sros_tool.values import file_change, shows
from sros_tool.wording import counted, first_few, natural_sort_key

if TYPE_CHECKING:
    from datetime import datetime

    from sros_tool.agent.running import EnclaveProcesses
    from sros_tool.checks.kind import Finding
    from sros_tool.dds.decision.vendors import Vendor
    from sros_tool.keystore.delivery.collect import CollectedInbox
    from sros_tool.keystore.delivery.publish import PublishedFleet
    from sros_tool.keystore.fleet_status import FleetStatus, RobotStatus


class _Fleet(Verb, VerbGroup):
    """A click group whose subcommands are verbs."""

    command_class = Verb


@click.group("fleet", cls=_Fleet)
def fleet() -> None:
    """Show the robots of a fleet, and which files of their enclaves they have.

    Example:
      $ sros fleet status keystore
      50 robots: 48 current, 1 earlier, 1 never confirmed
    """


# ── the robots ─────────────────────────────────────────────────────────────────────────────


@fleet.command("inventory")
@keystore_argument()
@click.option("--yaml", "as_yaml", is_flag=True, help="Print YAML instead of JSON.")
@click.option(
    "--list",
    "as_list",
    is_flag=True,
    help="Print the inventory in the format of Ansible's dynamic inventory scripts.",
)
def _inventory(root: Path, as_yaml: bool, as_list: bool) -> None:
    """Print the robots of KEYSTORE as an Ansible inventory.

    Each robot is a host, and each group of the fleet is a group of the inventory. The variables of
    a host are ansible_host, ansible_user, sros_robot, sros_namespace, sros_domain, sros_router,
    sros_crossing, sros_distribution, sros_renewal and sros_renewal_grace.

    Example:
      $ sros fleet inventory keystore > hosts.json
      $ ansible-playbook -i hosts.json sros.fleet.deliver
    """
    from sros_tool.fleet.fleet_file import inventory, script_inventory
    from sros_tool.keystore.fleet import recorded_fleet
    from sros_tool.keystore.reader import OpenedKeystore
    from sros_tool.values import yaml_text

    if as_yaml and as_list:
        raise UsageError("--yaml and --list exclude each other", "", "Choose one.")
    recorded = recorded_fleet(OpenedKeystore(root))
    value = script_inventory(recorded) if as_list else inventory(recorded)
    echo_document(yaml_text(value) if as_yaml else f"{json_text(value)}\n")


# ── on the robot ───────────────────────────────────────────────────────────────────────────


@fleet.command("report")
@keystore_argument("folder", "[DIR]")
@click.option("--robot", metavar="NAME", required=True, help="The name of this robot.")
@click.option(
    "--restarted", is_flag=True,
    help="Confirm that all processes were restarted since the files were brought, even processes "
        "that sros cannot see.",
)  # fmt: skip
def _report(folder: Path, robot: str, restarted: bool) -> None:
    """On a robot, print a report of its enclaves' files and its DDS, for `fleet confirm`.

    The report is JSON. It has the time, and the SHA-256 of each file of the enclaves in DIR except
    their keys. It also names the loaded and the installed DDS libraries, and the enclaves whose
    processes still run with earlier files. Run the command as root, who can see all processes. The
    report names these problems: enclaves in which no process could start, for example because the
    key does not fit the certificate; files that other users can read or change; and findings of
    `sros check runtime` on the processes of these enclaves. docs/json.md describes the report under
    "confirmation".

    Example:
      $ ssh root@r7 sros fleet report /etc/sros/keystore --robot r7 |
            sros fleet confirm keystore --robot r7 -
    """
    from sros_tool.agent.running import enclaves_to_restart
    from sros_tool.agent.state import read_state
    from sros_tool.checks.keystores.arrival import installed_sentences
    from sros_tool.keystore.confirmation import (
        RunningFiles,
        make_confirmation,
        render_confirmation,
        shortened_dds,
        shortened_problems,
    )
    from sros_tool.keystore.layout import list_enclaves
    from sros_tool.runtime.processes import boot_id

    with progress("reading"):
        moment = now()
        names = list_enclaves(folder)
        confirmation = make_confirmation(folder, robot, now=moment)
        # Look at processes after reading the files: files that arrive in between are not loaded.
        processes = _processes_here(folder, names, now())
        running = (f"{problem}." for problem in processes.problems)
        problems = (*running, *installed_sentences(folder, names, moment))
    confirmation = replace(
        confirmation, dds=shortened_dds(processes.dds), problems=shortened_problems(problems)
    )
    agent, states = read_state(folder), processes.loaded_from_any_folder()
    noted = agent.due if agent.boot == boot_id() and not restarted else ()
    restart = {*noted, *enclaves_to_restart((), states, complete=True)}
    list_restart = {
        *processes.elsewhere,
        *enclaves_to_restart((), processes.list_states, complete=True),
    }
    # If no process runs in these enclaves, this machine may not be the robot.
    seen = {*states.values()} - {RunningFiles.NOT_SEEN}
    is_known = restarted or (bool(seen) and processes.complete)
    if restart or is_known:
        confirmation = replace(confirmation, restart=tuple(sorted(restart)))
    if is_known and not noted:  # files may have changed since the agent looked
        confirmation = replace(confirmation, crl_restart=tuple(sorted(list_restart)))
    echo_document(render_confirmation(confirmation))


def _processes_here(folder: Path, names: Iterable[str], moment: datetime) -> EnclaveProcesses:
    """Return the processes of this machine that run in the enclaves ``names`` of a folder."""
    from sros_tool.agent.running import look_at_processes

    return look_at_processes(folder, names, now=moment, zone=local_zone(os.environ))


# ── in the keystore ─────────────────────────────────────────────────────────────────────────


@fleet.command("confirm")
@keystore_arguments("[KEYSTORE] FILE", shell_complete=complete_file)
@click.option(
    "--robot",
    metavar="NAME",
    required=True,
    shell_complete=complete_robot,
    help="The robot that the report comes from.",
)
@dry_run_option
@json_option
def _confirm(arguments: tuple[str, ...], robot: str, dry_run: bool, as_json: bool) -> None:
    """Store in KEYSTORE what a robot reports about its files.

    FILE is what `sros fleet report` or the Ansible collection made on the robot; - is standard
    input. FILE replaces the last report of the robot. A report is no proof; `sros fleet status`
    compares the report with the files that the robot should have.

    Example:
      $ ssh r7 sros fleet report /etc/sros/keystore --robot r7 |
            sros fleet confirm keystore --robot r7 -
      stored the report of r7: 18 files of 2 enclaves
    """
    from sros_tool.keystore.confirmation import (
        MAX_BYTES,
        KeptConfirmation,
        locked_confirmations,
        receive,
        refuse_older_confirmation,
        store_confirmation,
    )
    from sros_tool.keystore.fleet import recorded_fleet
    from sros_tool.keystore.layout import confirmation_file
    from sros_tool.keystore.reader import OpenedKeystore

    root, file = root_and_file(arguments, "fleet confirm takes a keystore and one file")
    keystore = OpenedKeystore(root)
    recorded_fleet(keystore).robot(robot)
    shown_file = "standard input" if str(file) == "-" else f"'{file}'"
    data = read_file_or_stdin(file, "confirmation", max_bytes=MAX_BYTES)
    received = receive(data, robot, shown_file, now=now())
    path = confirmation_file(robot)
    changes = file_change(root / path, existed=(root / path).exists())
    with nullcontext() if dry_run else locked_confirmations(root):
        refuse_older_confirmation(keystore, received)
        if not dry_run:
            store_confirmation(keystore, received)
    confirmation = received.confirmation
    enclaves = confirmation.enclaves()
    notes = [Note("fleet.clock", f"{robot}: {text}")] if (text := received.clock_note()) else []
    if as_json:
        print_json(
            KeptConfirmation(
                root,
                robot,
                received=received.time,
                clock=confirmation.time,
                enclaves=enclaves,
                files=len(confirmation.files),
                dry_run=dry_run,
                changes=changes,
                notes=notes,
            )
        )
    else:
        done = "would store" if dry_run else "stored"
        echo(
            f"{done} the report of {robot}: {counted(len(confirmation.files), 'file')} of "
            f"{counted(len(enclaves), 'enclave')}"
        )
    print_notes(notes)


@fleet.command("collect")
@keystore_arguments("[KEYSTORE] INBOX", shell_complete=complete_file)
@click.option(
    "--restored",
    multiple=True,
    metavar="ROBOT",
    shell_complete=complete_robot,
    help="Accept an earlier message from this robot, because its disk was restored. Can be "
    "repeated.",
)
@click.option(
    "--publish",
    "folder",
    type=PATH,
    metavar="PUB",
    help="Publish afterwards, as `sros fleet publish KEYSTORE PUB` does.",
)
@allow_refusal_option
@dry_run_option
@json_option
def _collect(
    arguments: tuple[str, ...],
    folder: Path | None,
    restored: tuple[str, ...],
    allow_refusal: tuple[Vendor, ...],
    dry_run: bool,
    as_json: bool,
) -> int:
    """Collect the messages of robots, keep their confirmations, and sign requests for renewal.

    INBOX is a folder with ROBOT/confirmation.p7s of each robot that runs `sros agent`. sros reads
    only the messages of robots in the fleet of KEYSTORE. sros accepts the message of a robot if an
    enclave of that robot signed it, with a certificate that this keystore issued and did not
    revoke. The message must be later than the last one that sros accepted. sros signs requests for
    renewal if the fleet file has renewal = "allowed" for the robot; rights do not change. A refused
    message does not stop the others.

    Example:
      $ sros fleet collect keystore inbox
      3 robots: 2 kept, 1 refused; 1 request: 1 renewed
      r3: refused: it is signed by /r4/base, an enclave of r4
      renewed /r1/base for the key 6f5bbd292e91c5d0...
      $ sros fleet collect keystore inbox --publish pub

    The exit status is 0 if nothing was refused, 1 if a message, request or release was refused, the
    fleet file does not allow a request, two computers seem to have the keys of a robot (or its
    disk was restored), or published files were altered, and 2 if the CAs cannot sign, or the
    releases cannot be published. For two computers, only a run that notices them exits with 1;
    `sros fleet status` exits with 1 for up to a day.
    """
    from sros_tool.keystore.delivery.collect import PublishedAnswers, collect

    moment, keys = now(), keyring()
    root, inbox = root_and_file(arguments, "fleet collect takes a keystore and one folder")
    with progress("collecting"):
        collected = collect(
            root,
            inbox,
            now=moment,
            restored=restored,
            allow_refusal=allow_refusal,
            keyring=keys,
            dry_run=dry_run,
        )
    published = None
    problem: SrosError | OSError | None = None
    if folder:
        from sros_tool.keystore.delivery.publish import publish

        try:
            with progress("publishing"):
                moment = now()
                published = publish(root, folder, now=moment, keyring=keys, dry_run=dry_run)
            new, refused = published.names("published"), published.names("refused")
            collected = collected._replace(
                published=PublishedAnswers(folder, new, refused, published.altered)
            )
        except (SrosError, OSError) as error:
            problem = error  # what was collected is printed first
    if as_json:
        print_json(collected)
    else:
        for line in (
            *_collected_lines(collected),
            *(_published_lines(published, moment) if published else ()),
        ):
            echo(line)
    print_notes((*collected.notes, *(published.notes if published else ())))
    if collected.has_new_files and not (folder or dry_run):
        from sros_tool.keystore.delivery.collect import restored_command
        from sros_tool.keystore.delivery.publish import unpublished_restore_clause
        from sros_tool.keystore.fleet import publish_command
        from sros_tool.keystore.reader import OpenedKeystore

        keystore = OpenedKeystore(root)
        deliver = publish_command(root) or (
            f"`sros distribute_key {quote(str(root))} --robot NAME FOLDER --force`"
        )
        if unpublished_restore_clause(keystore):
            deliver = restored_command(keystore)
        echo(
            f"the keystore has new files for robots; to bring them to the robots: {deliver}",
            err=True,
        )
    if problem:
        raise problem
    if collected.not_signed:
        if not any(robot.requests for robot in collected.robots):  # their lines name the reason
            echo(f"not signed: {collected.not_signed}", err=True)
        return NOT_DONE
    try_passphrase(root, keys)
    is_published = published is None or published.is_complete(moment)
    return 0 if collected.complete and is_published else 1


def _collected_lines(collected: CollectedInbox) -> Iterator[str]:
    """Yield the counts, then lines on messages and on requests, sorted by outcome."""
    from sros_tool.keystore.delivery.collect import MESSAGE_OUTCOMES, REQUEST_OUTCOMES

    would_be = "would be " if collected.dry_run else ""
    requests = [(robot.robot, request) for robot in collected.robots for request in robot.requests]
    messages = Counter(robot.outcome for robot in collected.robots)
    asked = Counter(request.outcome for _, request in requests)
    line = f"{counted(len(collected.robots), 'robot')}: "
    line += _outcomes_text(messages, MESSAGE_OUTCOMES, would_be)
    if requests:
        line += f"; {counted(len(requests), 'request')}: "
        line += _outcomes_text(asked, REQUEST_OUTCOMES, would_be)
    yield line
    by_outcome = sorted(collected.robots, key=lambda robot: MESSAGE_OUTCOMES.index(robot.outcome))
    similar_texts: dict[tuple[str, ...], dict[str, str]] = {}
    for robot in by_outcome:
        why = (f"{robot.outcome}: {robot.why}",) if robot.why else ()
        for text in (*why, *robot.remarks):
            unnamed = _without_robot_name(text, robot.robot)
            parts = tuple(_DURATION.split(unnamed))
            similar_texts.setdefault(parts, {})[robot.robot] = unnamed
    names = [robot.robot for robot in collected.robots]
    for texts in similar_texts.values():
        yield f"{_robot_names(texts, names)}: {_joined_durations(texts)}"
    requests.sort(key=lambda request: REQUEST_OUTCOMES.index(request[1].outcome))
    renewed = sum(request.outcome == "renewed" for _, request in requests)
    for name, request in requests[: renewed + _MOST_LINES]:
        if request.outcome == "renewed":
            yield f"{would_be}renewed {request.enclave} for the key {request.key_sha256}"
        else:
            enclave = request.enclave or f"a request of {name}"
            yield f"{enclave}: {request.outcome.replace('_', ' ')}: {request.why}"
    if (more := len(requests) - renewed - _MOST_LINES) > 0:
        yield f"and {counted(more, 'more request')}, see --json"


_OUTCOME_WORDS = {"missing": "without a message (or delivered by hand)"}


def _outcomes_text(numbers: Mapping[str, int], outcomes: Sequence[str], verb_form: str) -> str:
    """Return the number of messages or requests with each outcome, in words."""
    present_outcomes = (outcome for outcome in outcomes if numbers.get(outcome))
    return ", ".join(
        f"{numbers[name]} {_OUTCOME_WORDS.get(name) or verb_form + name.replace('_', ' ')}"
        for name in present_outcomes
    )


def _validity_options(function: Decorated) -> Decorated:
    """Add an option for the validity of the metadata of each role."""
    for role, help_text in reversed(_VALIDITIES.items()):
        function = click.option(f"--{role}-validity", metavar="DURATION", help=help_text)(function)
    return function


_VALIDITIES = {
    "timestamp": "How long robots accept the published files without a new publication. [default: "
    "1d]",
    "snapshot": "How long the list of versions is valid. [default: 7d]",
    "targets": "How long the lists of releases are valid. [default: 90d]",
    "root": "How long the list of the keys is valid. [default: 365d]",
}
"""Role of published metadata → help of the option for its validity."""


@fleet.command("publish")
@keystore_arguments("[KEYSTORE] PUB", shell_complete=complete_file)
@click.option(
    "--root-key",
    type=PATH,
    metavar="FILE",
    help="File of the root key, to keep the key outside of the keystore. The first publication "
    "creates the file.",
)
@click.option(
    "--rotate-key",
    "rotated",
    type=click.Choice(tuple(_VALIDITIES)),
    multiple=True,
    help="Give this role a new key; sros signs the new list of keys with the root key. Can be "
    "repeated.",
)
@_validity_options
@click.option(
    "--restored",
    is_flag=True,
    help="After the keystore was restored: publish although PUB has later releases. Enclaves that "
    "these releases revoke are revoked again; new releases get numbers that were never used.",
)
@click.option(
    "--new-folder",
    is_flag=True,
    help="Publish to PUB although PUB lacks the files that the keystore published before, because "
    "PUB "
    "is a new folder, or replaces a lost folder.",
)
@dry_run_option
@json_option
def _publish(
    arguments: tuple[str, ...],
    root_key: Path | None,
    rotated: tuple[str, ...],
    restored: bool,
    new_folder: bool,
    dry_run: bool,
    as_json: bool,
    **validities: str | None,
) -> int:
    """Publish a release for each robot of KEYSTORE in the folder PUB.

    PUB has plain files for any web server, bucket or USB stick, and no private key. For each robot,
    PUB has an archive with the files of the robot's enclaves, signed by the permissions CA. PUB
    also has metadata of The Update Framework, with which `sros agent` on the robot refuses old
    files, forged files, and files from different versions of PUB. Run this verb after each change,
    and again before the time that it prints, for example each hour. Archives of unchanged robots
    stay; archives of robots that were revoked or left the fleet are removed.

    The keys that sign PUB are in KEYSTORE/private.  The root key signs only the list of the other
    keys.  Move the root key away from the keystore.  Name it with --root-key to replace a key, and
    once a year to renew the list of keys.

    Example:
      $ sros fleet publish keystore pub
      published new releases of 2 robots in 'pub', unchanged: 48 robots
      robots pin pub/metadata/1.root.json, SHA-256 daaeacc27199d9193220b79479981f64...
      robots accept these files until 2027-05-22T09:00:00Z: publish again before then
      $ mv keystore/private/fleet_root.pem /media/safe/
      $ sros fleet publish keystore pub --rotate-key timestamp
            --root-key /media/safe/fleet_root.pem

    The exit status is 1 in three cases: an enclave of a robot cannot run, so that its release was
    refused; the root metadata has expired, so that robots refuse everything; or files in PUB were
    missing, changed, older than this verb published them or foreign, so that it put them right.
    """
    from sros_tool.keystore.delivery.publish import publish
    from sros_tool.keystore.delivery.published import MetadataExpiry
    from sros_tool.validity import parse_duration

    moment = now()
    root, folder = root_and_file(arguments, "fleet publish takes a keystore and one folder")
    given = {
        name.removesuffix("_validity"): parse_duration(text)
        for name, text in validities.items()
        if text is not None
    }
    with progress("publishing"):
        published = publish(
            root,
            folder,
            now=moment,
            expiry=MetadataExpiry(**given),
            root_key=root_key,
            rotate=rotated,
            restored=restored,
            new_folder=new_folder,
            keyring=keyring(),
            dry_run=dry_run,
        )
    if as_json:
        print_json(published)
    else:
        for line in _published_lines(published, moment):
            echo(line)
    print_notes(published.notes)
    return 0 if published.is_complete(moment) else 1


def _published_lines(published: PublishedFleet, moment: datetime) -> Iterator[str]:
    """Yield what was published, which robots got no release, and what to do next."""
    from sros_tool.validity import iso

    new, kept = (len(published.names(outcome)) for outcome in ("published", "kept"))
    unchanged = f", unchanged: {counted(kept, 'robot')}" if kept else ""
    would = "would publish" if published.dry_run else "published"
    releases = (
        f"{would} new releases of {counted(new, 'robot')}" if new else f"{would} no new release"
    )
    yield f"{releases} in '{published.folder}'{unchanged}"
    if removed := published.names("removed"):
        which = f"robots that left the fleet or were revoked: {first_few(removed, _MOST_GROUPS)}"
        offers = "would no longer offer" if published.dry_run else "no longer offers"
        yield f"{offers} releases to {which} (their files are removed after two days)"
    for robot in published.robots:
        if robot.outcome == "refused":
            keeps = "keeps its earlier release" if robot.number else "has no release"
            yield f"refused: {robot.robot} {keeps}: {robot.why}"
    if published.rotated:
        yield (
            f"new keys: {', '.join(published.rotated)}; {published.root.name} lets robots accept "
            "them"
        )
    yield f"robots pin {published.root}, SHA-256 {published.root_sha256}"
    accepting = "robots accept"
    if published.refused_by:
        accepting = "robots that trust this CA accept"
        yield (
            "these robots refuse the files, because they do not trust the permissions CA (as their "
            f"last messages say): {first_few(published.refused_by, _MOST_GROUPS)}. Bring the files "
            f"by hand: `sros distribute_key {quote(str(published.keystore))} --robot NAME FOLDER "
            "--force`"
        )
    if published.expires:
        end, role = min((end, role) for role, end in published.expires.items())
        next_step = "publish again"
        if role == "root":
            where = f"{quote(str(published.keystore))} {quote(str(published.folder))}"
            next_step = f"`sros fleet publish {where} --root-key FILE`"
        yield (
            f"{accepting} these files until {iso(end)}: {next_step} before then"
            if end > moment
            else f"robots refuse these files, because the root metadata has expired: {next_step}"
        )


@shows(spread=("status",))
class ComparedFleet(NamedTuple):
    """The deployment status of a fleet at a moment, and known vulnerabilities of its DDS."""

    at: datetime
    """When the robots were compared with the keystore, in UTC."""
    status: FleetStatus
    outdated_dds: Sequence[str]
    """Robots whose DDS has known vulnerabilities that a later release of the same major version
    fixes, sorted by name; with ``--fail-on vulnerabilities``, the exit status is 1 if there
    are such robots.
    """
    findings: Sequence[Finding]
    """Findings on known vulnerabilities of the robots' DDS, in the form of ``sros check runtime``.
    """


@fleet.command("status")
@keystore_argument()
@robot_option("Show only this robot of the fleet, with all its problems and files.")
@click.option("--all", "apart", is_flag=True, help="Show each robot in a line of its own.")
@click.option(
    "--max-age",
    metavar="DURATION",
    help="A robot is offline if its last confirmation is older than this. [default: 1d for robots "
    "that fetch]",
)
@click.option(
    "--prometheus", is_flag=True, help="Print metrics for the textfile collector of node_exporter."
)
@click.option("--html", is_flag=True, help="Print the status as an HTML page.")
@advisories_option
@click.option(
    "--no-advisories",
    is_flag=True,
    help="Leave known vulnerabilities of the robots' DDS out of the output.",
)
@click.option(
    "--fail-on",
    type=click.Choice(["delivery", "unmended", "seen", "vulnerabilities"]),
    multiple=True,
    default=["delivery"],
    show_default=True,
    help="`delivery`: the exit status is 1 only for problems with the delivery of files, and for "
    "problems that agents report. `unmended`: as `delivery`, but changed files that an agent or "
    "`sros fleet publish` has replaced (they are shown for a day) do not count. `seen`: "
    "as `delivery`, but a publishing folder that is not on this machine does not count. "
    "`vulnerabilities`: as `delivery`, and also for a DDS with known vulnerabilities that a later "
    "release fixes. Can be repeated: `--fail-on unmended --fail-on seen`.",
)
@output_option("Replace FILE atomically instead of printing.")
@dry_run_option
@json_option
def _status(
    root: Path,
    robots: tuple[str, ...],
    apart: bool,
    max_age: str | None,
    prometheus: bool,
    html: bool,
    advisories: Path | None,
    no_advisories: bool,
    fail_on: tuple[str, ...],
    output: Path | None,
    dry_run: bool,
    as_json: bool,
) -> int:
    """Compare the files that each robot last confirmed with the files that it should have.

    A robot should have the files that an export from KEYSTORE would give it now. A file is current;
    earlier (issued for this enclave before); foreign (issued for another enclave); revoked;
    missing; or unknown (never issued by this keystore). Processes use new files only after a
    restart. Confirmations by the Ansible collection and `sros agent` say which restarts are due.
    Confirmations by `sros fleet report` say this only if it saw all processes, or with --restarted.
    A robot without a recent confirmation is offline. Robots with the same state share a line, and
    there is no table if all are current; with --all, each robot has a line. A robot that reports a
    release which was never published has a line of its own, even if its files are current.
    The last line names the robots whose DDS has known vulnerabilities (advisories of sros) that a
    later release of the same major version fixes. --advisories FILE lists these vulnerabilities,
    and so does --robot NAME with --fail-on vulnerabilities.

    The revocation list is in force on a robot if the robot has the list, and confirms that no
    process has to restart for it. An earlier list that revokes the same certificates counts, too.
    `sros agent`, `sros fleet report` and the Ansible collection confirm which restarts the list
    needs. In other confirmations, every restart that is due counts as a restart for the list.

    Example:
      $ sros fleet status keystore
      50 robots: 44 current, 1 earlier, 4 never confirmed, 1 foreign files
      robot                  state            confirmed  to do         what
      r7                     earlier          3 d ago    deliver       earlier ...
      r8                     foreign files    2 min ago  find out why  10 files of r9
      r31 to r34 (4 robots)  never confirmed  -          deliver       each: 2 ...
      r1 to r6, r9 ... (44)  current          4 min ago
      $ sros fleet status keystore --max-age 7d
      $ sros fleet status keystore --prometheus -o /var/lib/.../fleet.prom

    The exit status is 0 if every robot that is not revoked has confirmed the files that it should
    have, no restart is due, no agent reports a problem, no published file is missing or was altered
    in the last day, and robots still accept the published files. Otherwise it is 1, also if the
    publishing folder is not on this machine. With --fail-on unmended, changed files that an agent
    or `sros fleet publish` has replaced do not count. With --fail-on seen, a publishing folder that
    is not on this machine does not count: use it on a copy of the keystore. With --fail-on
    vulnerabilities, the exit status is also 1 if a robot has a DDS to upgrade.
    """
    from sros_tool.checks.vulnerabilities import is_fixed_later, robot_findings
    from sros_tool.keystore.fleet_status import fleet_status
    from sros_tool.keystore.reader import OpenedKeystore
    from sros_tool.validity import parse_duration

    if as_json + prometheus + html > 1:
        raise UsageError("--json, --prometheus and --html exclude each other", "", "Choose one.")
    if apart and (robots or as_json or prometheus or html):
        raise UsageError(
            "--all is for the table of robots",
            "--robot, --json and --prometheus show each robot by itself. --html joins equal ones.",
            "Leave one of them out.",
        )
    if as_json and output:
        raise UsageError("--json takes no --output", "", "Leave one of them out.")
    on_vulnerabilities = "vulnerabilities" in fail_on
    if no_advisories and (advisories or prometheus or on_vulnerabilities):
        other = "--prometheus" if prometheus else "--fail-on vulnerabilities"
        other = "--advisories" if advisories else other
        raise UsageError(f"{other} and --no-advisories exclude each other", "", "Choose one.")
    moment = now()
    oldest = parse_duration(max_age) if max_age is not None else None
    if output:
        if prometheus:
            check_metrics_file(output)
        check_output(output, force=True)
    known = advisories_of(advisories)
    with progress("comparing"):
        status = fleet_status(OpenedKeystore(root), robots, moment)
    status = status.with_overdue(moment, oldest)
    reported = {
        robot.robot: robot.dds
        for robot in status.robots
        if robot.received and not no_advisories and robot.state != "revoked"
    }
    outdated = [
        robot
        for robot, dds in reported.items()
        if dds and any(is_fixed_later(library, known) for library in dds.libraries)
    ]

    def names(robots: Sequence[str]) -> str:
        return _robot_names(robots, status.names, status.groups, len(robots))

    findings = robot_findings(reported, known, names) if html else robot_findings(reported, known)
    compared = ComparedFleet(moment, status, outdated, list(findings))
    complete = status.is_settled(mended="unmended" in fail_on, unseen="seen" in fail_on)
    exit_status = 0 if complete and not (outdated and on_vulnerabilities) else 1
    if as_json:
        print_json(compared)
        return exit_status
    if prometheus:
        from sros_tool.keystore.fleet_metrics import fleet_metrics
        from sros_tool.prometheus import render_metrics

        text = render_metrics(fleet_metrics(status, now=moment, advisories=known))
    elif html:
        from sros_tool.report.pages import render_fleet_page
        from sros_tool.values import as_plain

        rows = list(_page_rows(compared, robots))
        in_force, total = _counts_of_list_in_force(status) or (0, 0)
        list_lacking = "".join(_revocation_list_facts(compared)) if in_force < total else ""
        text = render_fleet_page(
            as_plain(compared),
            _STATE_WORDS,
            [fact for fact in _fleet_facts(compared) if fact != list_lacking],
            rows,
            _remedies(status, {to_do for *_, to_do, _ in rows}),
            list_lacking,
        )
    else:
        names_them = advisories is not None or (bool(robots) and on_vulnerabilities)
        apart = apart or bool(robots)
        lines = _lines(compared, robots, apart=apart, findings=names_them)
        text = "".join(f"{visible_line(line)}\n" for line in lines)
    if output and not dry_run:
        echo(save(output, text.encode()), err=True)
    elif output:
        echo(f"would {'replace' if output.exists() else 'create'} {output}")
    else:
        echo_document(text)
    return exit_status


_STATE_WORDS = {
    "none": "no enclave",
    "restart": "restart due",
    "missing": "lacking files",
    "broken": "broken in the keystore",
    "never": "never confirmed",
    "later": "claims a later release",
    "refused": "message refused",
    "unknown": "unknown files",
    "another": "foreign files",
}
"""State of a file or robot → its words in the output, if they differ from the state's name."""
_DIGITS = re.compile(r"(\d+)")
_LONGEST_SUMMARY = 200
"""Maximum number of characters in the last column of the table."""
_MOST_LINES, _MOST_GROUPS = 50, 3
"""Maximum number of listed files of a robot, and of listed groups or unrecorded enclaves."""


def _lines(
    compared_fleet: ComparedFleet, robots: Sequence[str], *, apart: bool, findings: bool
) -> Iterator[str]:
    """Yield the number of robots by state, a table of robots, and findings on their DDS.

    With ``apart``, each robot has a row.  Unless ``findings`` is set, the findings are only
    counted.
    """
    status = compared_fleet.status
    counts = ", ".join(f"{number} {_state_text(state)}" for state, number in status.counts.items())
    doubt = next(
        (
            text
            for text, is_so in (
                ("compared with a keystore that is older than its robots", status.older),
                ("perhaps not all robots", status.edited),
                ("judged by a clock that is behind", status.clock),
            )
            if is_so
        ),
        "",
    )
    doubt = f" ({doubt})" if doubt else ""
    yield f"{counted(len(status.robots), 'robot')}: {counts}{doubt}"
    facts = list(_fleet_facts(compared_fleet))
    yield from facts
    rows = list(_rows(compared_fleet, robots, apart=apart))
    widths = [max(len(row[column]) for row in rows) for column in range(4)] if rows else []
    for row in rows:
        cells = (f"{cell:{width}}" for cell, width in zip(row, widths, strict=False))
        yield "  ".join((*cells, row[4])).rstrip()
    yield from _command_lines(status, " ".join(facts))
    for robot in status.robots if robots else ():
        yield from _file_details(robot)
    if findings:
        yield from _dds_findings(compared_fleet)
    else:
        yield from _dds_count_lines(compared_fleet)


def _command_lines(status: FleetStatus, facts: str) -> Iterator[str]:
    """Yield a line with the commands of each frequent task, unless ``facts`` names them."""
    root = quote(str(status.keystore))
    publication = status.publication
    publish = f"sros fleet publish {root} {quote((publication and publication.folder) or 'PUB')}"
    for to_do in ("deliver", "publish", "restart"):
        robots = [robot.robot for robot in status.robots if robot.to_do == to_do]
        name = robots[0] if len(robots) == 1 else "NAME"
        command = {
            "deliver": f"`sros distribute_key {root} --robot {name} FOLDER --force`, bring FOLDER "
            "to the robot, and restart its processes",
            "publish": "" if "`sros fleet publish" in facts else f"`{publish}`",
            "restart": "restart the robot's processes, then let it report: `sros agent run FOLDER "
            f"--once` there (with `--restarted` if the agent cannot see the processes), or `ssh "
            f"{name} sros fleet report FOLDER --robot {name} | sros fleet confirm {root} --robot "
            f"{name} -`",
        }[to_do]
        if robots and command:
            yield f"{to_do}: {command}"


def _fleet_facts(compared_fleet: ComparedFleet) -> Iterator[str]:
    """Yield sentences about the fleet as a whole."""
    from sros_tool.keystore.fleet import fleet_edits_remedy
    from sros_tool.keystore.known_keys import lacking_enclaves_remedy
    from sros_tool.validity import elapsed, iso

    status = compared_fleet.status
    publication = status.publication
    folder = publication.folder if publication else ""
    publish = f"sros fleet publish {quote(str(status.keystore))} {quote(folder or 'PUB')}"
    root_end = publication.root_expires if publication else None
    publish += " --root-key FILE" if root_end and root_end <= compared_fleet.at else ""
    restored = f"`{publish} --restored`; docs/howto/keystore_is_lost.md has the other steps"
    if status.edited:
        remedy = fleet_edits_remedy(status.keystore, status.edited)
        yield f"perhaps not all robots are shown: the fleet file {status.edited}. {remedy}"
    if status.clock:
        yield f"{status.clock}: the age of the confirmations is not known. Set the clock"
    if status.older:
        yield f"the keystore is older than its robots: {status.older}. Publish with {restored}"
    elif any(robot.state == "later" for robot in status.robots):
        text = "the keystore may be older than its robots: if it was restored, publish with"
        yield f"{text} {restored}"
    elif publication and (publication.lacks or publication.refused):
        lacks = f"'{folder}' lacks {publication.lacks}, which robots fetch"
        wrong = f"the published files do not verify: {publication.refused}"
        faults = [lacks] * bool(publication.lacks) + [wrong] * bool(publication.refused)
        yield f"{'; '.join(faults)}. Run `{publish}`, which puts this right, or prints the remedy"
    elif publication and publication.accepted is False and publication.expires:
        ago = elapsed(compared_fleet.at - publication.expires)
        yield f"the published files expired {ago} ago, so robots get no new files: run `{publish}`"
    elif publication and publication.accepted is None:
        yield f"the expiry of the published files is not known: run `{publish}`"
    if publication and folder and publication.unseen and not status.older:
        yield (
            f"the folder of the last publication, '{folder}', {publication.unseen}: it is not "
            "known whether robots can fetch, or whether the keystore is older than its robots. "
            f"`{publish}` names the remedy. If the folder belongs on another machine, add "
            "`--fail-on seen`"
        )
    if lost := [robot.robot for robot in status.robots if robot.is_lost]:
        names = _robot_names(lost, status.names, status.groups)
        yield (
            f"the keystore was restored, and lacks enclaves of {names}, whose certificates stay "
            f"valid. {lacking_enclaves_remedy(status.keystore)}"
        )
    elif status.restored and not status.older:
        yield (
            "the keystore was restored from a backup (sros noticed it at "
            f"{iso(status.restored)}): no list revokes certificates that were issued after the "
            "backup and that the keystore has not found. If somebody may have such a certificate, "
            "replace the identity CA (docs/howto/keystore_is_lost.md, Certificates were renewed "
            "after the backup)"
        )
    if publication and publication.altered:
        ago = elapsed(compared_fleet.at - max(publication.altered.values()))
        yield (
            "published files were missing, changed, older than published or foreign: "
            f"{first_few(list(publication.altered), _MOST_GROUPS)} (last seen {ago} ago). sros "
            "put them right; find out who else can write to the folder"
        )
    if status.stage != "complete":
        robots = sum(bool(each.enclaves) for each in status.robots)
        confirmed = f"confirmed by {'all ' * (robots > 1)}{counted(robots, 'robot')}"
        if behind := status.unconfirmed:
            confirmed = f"not confirmed by {first_few(behind, 3)} yet"
            clause = _shared_keys_clause(status, behind)
            confirmed += f"; {clause}" if clause else ""
        yield f"CA rotation: {status.stage}; {confirmed}"
    yield from _revocation_list_facts(compared_fleet)
    yield from _expiry_facts(compared_fleet)
    if status.without_robot:
        whose = counted(status.unassigned, "enclave belongs", "enclaves belong")
        covered = "it" if status.unassigned == 1 else "them"
        named = first_few(status.without_robot, 3)
        yield f"{whose} to no robot, so no confirmation covers {covered}: {named}"
    if status.left:
        whose = counted(len(status.left), "valid enclave")
        yield (
            f"{whose} of robots that left the fleet or their group: {first_few(status.left, 5)}. "
            f"Revoke with `sros revoke {quote(str(status.keystore))} ENCLAVE...`"
        )


def _shared_keys_clause(status: FleetStatus, names: Collection[str]) -> str:
    from sros_tool.keystore.fleet_status import shared_keys_clause

    robots = [robot for robot in status.robots if robot.robot in names]
    return shared_keys_clause([robot.robot for robot in robots if robot.has_shared_keys])


def _revocation_list_facts(compared_fleet: ComparedFleet) -> Iterator[str]:
    """Yield which robots have the revocation list in force, or lack it, if a list exists."""
    status = compared_fleet.status
    numbers = _counts_of_list_in_force(status)
    if numbers and (trusting := status.trusting_replaced):
        until_clause = f" (until {until:%Y-%m-%d})" if (until := status.revoked_until) else ""
        clause = _shared_keys_clause(status, trusting)
        yield (
            f"{first_few(trusting, 5)} may still trust a replaced CA, and accept its revoked "
            f"certificates{until_clause}; the present CA has no revoked certificates"
        ) + (f"; {clause}" if clause else "")
    elif numbers:
        in_force, robots = numbers
        number = f"{in_force} of " if in_force < robots else "all " if in_force > 1 else ""
        text = f"the revocation list is in force on {number}{counted(robots, 'robot')}"
        lacking = [robot for robot in status.robots if robot.crl_in_force is False]
        missing = [robot.robot for robot in lacking]
        text += f" (not on {first_few(missing, 3)})" if in_force and missing else ""
        if waiting := sum(robot.has_list for robot in lacking):
            have = "have" if waiting > 1 else "has"
            which = "the other" if in_force else "these"
            who = f"{which} {len(lacking)} robots" if len(lacking) > 1 else missing[0]
            who = f"{waiting} of {who}" if waiting < len(lacking) else who
            text += f"; {who} {have} the list, but perhaps not all processes there have loaded it "
            text += "and the current CAs"
        if shared := [robot.robot for robot in lacking if robot.has_shared_keys]:
            text += (
                f"; two computers seem to have the keys of {first_few(shared, 3)}, so sros does "
            )
            text += "not know whether the list is in force there"
        if (until := status.revoked_until) is None:
            text += (
                "; sros does not know until when robots need the list, because the ledger lacks a "
            )
            text += "revoked certificate"
        elif until > compared_fleet.at:
            text += f"; no robot needs the list after {until:%Y-%m-%d}, when the "
            text += "revoked certificates have expired"
        yield text


def _counts_of_list_in_force(status: FleetStatus) -> tuple[int, int] | None:
    """Return two numbers of robots: where the revocation list is in force, and where it has to be.

    Returns None if nothing is revoked, or if no robot has to have the list.
    """
    robots = [robot for robot in status.robots if robot.crl_in_force is not None]
    if not (robots and status.is_any_revoked):
        return None
    return sum(bool(robot.crl_in_force) for robot in robots), len(robots)


def _remedies(status: FleetStatus, to_dos: Collection[str]) -> Mapping[str, str]:
    """Map each entry of the column `to do` to instructions."""
    from sros_tool.keystore.expiry import renewal_command
    from sros_tool.keystore.fleet import publish_command

    root = status.keystore
    where = quote(str(root))
    by_hand = (
        f"`sros distribute_key {where} --robot NAME FOLDER --force`, bring FOLDER to the robot, "
        "and restart its processes; with Ansible, run the play `deliver`"
    )
    to_renew = [robot for robot in status.robots if robot.to_do == "renew"]
    known = {
        "find out why": "check whether the robot is on, and which machine reports as this robot: "
        "that machine "
        "may have a wrong name, or a copied disk. If it has files of another robot, it can act "
        f"as that robot until you run `sros renew {where} --robot OTHER --new-key --revoke-old` "
        "(if OTHER makes its keys itself: docs/howto/one_robot.md, Keys that are made on the "
        "robot); then deliver to both robots",
        "check its clock": "set the clock of the robot; its agent then continues at the next "
        "round. If this clock is right, the clock of the server or of this machine is wrong, or "
        "somebody held the robot's confirmation back",
        "deliver": by_hand,
        "publish": publish_command(root),
        "renew": f"`{renewal_command(root)}`, then {_delivery_advice(root, to_renew)}",
        "take it out of the fleet file": "remove the robot from the fleet file, and run "
        f"`sros generate_artifacts -k {where} -p POLICY --fleet FILE`",
        "upgrade the DDS": "upgrade the library's package (named below) on the robot, "
        "and restart the robot's processes",
    }
    shown = {
        name: known[name] for name in known if known[name] and any(name in text for text in to_dos)
    }
    # Other instructions may end with a delivery.
    if any("deliver" in remedy for remedy in shown.values()):
        shown["deliver"] = by_hand
    return shown


def _delivery_advice(root: Path, robots: Sequence[RobotStatus]) -> str:
    """Return how to bring renewed files to robots: by a publication, a delivery, or both."""
    from sros_tool.keystore.fleet import publish_command

    publish = publish_command(root)
    if not publish or not any(robot.fetches for robot in robots):
        return "deliver"
    all_fetch = all(robot.fetches for robot in robots)
    return publish if all_fetch else f"{publish}, and deliver to the robots that do not fetch"


def _expiry_facts(compared_fleet: ComparedFleet) -> Iterator[str]:
    """Yield the moment when the first file on a robot expires, if soon, and what to do then."""
    from datetime import timedelta

    from sros_tool.keystore.expiry import renewal_command
    from sros_tool.validity import iso

    soon = [
        robot
        for robot in compared_fleet.status.robots
        if robot.enclaves and robot.renew_from and robot.renew_from < compared_fleet.at
    ]
    if not soon:
        return
    end, first, kind = min(
        (end, robot.robot, kind) for robot in soon for kind, end in robot.expiry.items()
    )
    root = compared_fleet.status.keystore
    time_left = end - compared_fleet.at
    when = f"{end:%Y-%m-%d}" if time_left > timedelta(days=1) else iso(end)
    label, robots = "first expiry on a robot", counted(len(soon), "robot has", "robots have")
    others = f"; {robots} files that expire within 30 days"
    if time_left <= timedelta(0):
        label, more = "first file that expired on a robot", counted(len(soon) - 1, "more robot")
        others = f"; files of {more} have expired or expire within 30 days" if soon[1:] else ""
    short_lived = [name for robot in soon for name in robot.short_lived]
    named = short_lived[:_MOST_GROUPS]  # enclave names need no quotes
    named += ["..."] * (len(short_lived) > _MOST_GROUPS)
    command = f"`sros renew {quote(str(root))} {' '.join(named)}`, then "
    if not all(robot.short_lived for robot in soon):
        command = f"`{renewal_command(root, *named)}`, then "
    if kind == "crl":
        command = f"`sros crl {quote(str(root))} --refresh`, then "
    if not any("current" in robot.files.get(kind, ()) for robot in soon):
        command = ""  # the keystore has renewed these files
    bring = f"{command}{_delivery_advice(root, soon)}"
    if not command and all(robot.has_release for robot in soon):
        bring = "new files are published; see the column `to do`"
    yield f"{label}: {when} ({first}, {_KIND_WORDS.get(kind, kind)}){others}: {bring}"


_KIND_WORDS = {"crl": "revocation list"}


_OFTEN_BY_PROBLEM = ("look into it", "check its server", "check whether it is on")
"""Tasks for which the problems of a robot come before the differences of its files."""


class _Group(NamedTuple):
    """Robots that share a row of the status; ``what`` is the summary of their differences."""

    robots: Sequence[RobotStatus]
    state: str
    to_do: str
    what: str

    @property
    def names(self) -> list[str]:
        """Names of the robots."""
        return [robot.robot for robot in self.robots]

    def oldest_confirmation(self, moment: datetime) -> RobotStatus:
        """Return the robot whose last confirmation is the oldest.

        A robot that never confirmed counts as confirmed at ``moment``.
        """
        return min(self.robots, key=lambda robot: robot.confirmed or moment)


def _groups(
    compared_fleet: ComparedFleet,
    problems: Callable[[RobotStatus], Iterable[str]],
    *,
    apart: bool,
) -> list[_Group]:
    """Group robots with the same state, remedy and summary; the last group has the current robots.

    With ``apart``, each robot is a group of its own.  ``problems`` returns the clauses of the
    summary on a robot's problems.
    """
    status, places = compared_fleet.status, _robot_positions(compared_fleet.status.names)
    robots_by_texts: dict[tuple[str, ...], list[RobotStatus]] = {}
    current: list[RobotStatus] = []
    clauses_by_robot: dict[str, str] = {}
    for robot in sorted(status.robots, key=lambda robot: places[robot.robot]):
        if apart or robot.state != "current" or robot.notes or robot.problems or robot.is_lost:
            files = (
                *_expiry_clauses(robot, compared_fleet.at),
                *_summary(robot, status.stage, compared_fleet.at),
            )
            is_silent = robot.state.value == "offline"  # what it reported last may say why
            is_problem = robot.to_do in _OFTEN_BY_PROBLEM or robot.may_have_copied_key or is_silent
            is_problem |= robot.has_damaged_file
            clauses = (*problems(robot), *files) if is_problem else (*files, *problems(robot))
            what = _CLOCK_SENTENCE.sub("", _without_robot_name("; ".join(clauses), robot.robot))
            clauses_by_robot[robot.robot] = what
            row = (robot.state.value, robot.to_do, *_DURATION.split(what))
            robots_by_texts.setdefault((*row, robot.robot if apart else ""), []).append(robot)
        else:
            current.append(robot)
    groups = []
    for (state, to_do, *_), group in robots_by_texts.items():
        what = _joined_durations({robot.robot: clauses_by_robot[robot.robot] for robot in group})
        # "each": the number is that of each robot, not the sum.
        each = "each: " if len(group) > 1 and what[:1].isdigit() else ""
        groups.append(_Group(group, state, to_do, f"{each}{what}"))
    return [*groups, _Group(current, "current", "", "")] if current else groups


def _rows(
    compared_fleet: ComparedFleet, robots: Sequence[str], *, apart: bool
) -> Iterator[tuple[str, ...]]:
    """Yield the header and the rows of a table, or nothing if no robot needs a row.

    With ``apart``, each robot has a row.
    """
    # Of named robots, `_file_details` shows the problems.
    problems = (lambda _: ()) if robots else _gravest_problem
    groups = _groups(compared_fleet, problems, apart=apart)
    if not apart and all(group.state == "current" for group in groups):
        groups = [group for group in groups if group.what or group.to_do]
    if not groups:
        return
    yield "robot", "state", "confirmed", "to do", "what"
    for group in groups:
        names = _robot_names(group.names, compared_fleet.status.names, compared_fleet.status.groups)
        age = _age_text(group.oldest_confirmation(compared_fleet.at), compared_fleet.at)
        what = group.what if robots else _shortened_summary(group.what, group.names[0])
        yield names, _state_text(group.state), age, group.to_do, what


def _shortened_summary(summary: str, robot: str) -> str:
    """Return the first clauses of a summary that fit into a row, and where the others are."""
    if len(summary) <= _LONGEST_SUMMARY:
        return summary
    begin = summary[:_LONGEST_SUMMARY]
    begin = begin.rpartition("; ")[0] or f"{begin.rpartition(' ')[0]} ..."
    return f"{begin}; more: --robot {robot}"


def _page_rows(compared_fleet: ComparedFleet, robots: Sequence[str]) -> Iterator[tuple[str, ...]]:
    """Yield a row for each group of robots.

    The columns are: state, names, earliest confirmation, earliest expiry of a file, what to do, and
    why.
    """
    from sros_tool.validity import iso

    def problems(robot: RobotStatus) -> Iterable[str]:
        return robot.problem_clauses if robots else _gravest_problem(robot)

    for group in _groups(compared_fleet, problems, apart=bool(robots)):
        status, most = compared_fleet.status, len(group.robots)
        names = _robot_names(group.names, status.names, status.groups, most)
        confirmed = group.oldest_confirmation(compared_fleet.at).confirmed
        expiry = [moment for robot in group.robots for moment in robot.expiry.values()]
        outdated = [name for name in group.names if name in compared_fleet.outdated_dds]
        to_do = [group.to_do] if group.to_do else []
        if outdated:
            of = "" if len(outdated) == len(group.names) else f" of {first_few(outdated, most)}"
            to_do.append(f"upgrade the DDS{of}")
        yield (
            group.state,
            names,
            iso(confirmed) if confirmed else "",
            iso(min(expiry)) if expiry else "",
            "; ".join(to_do),
            group.what,
        )


_ROBOT_PLACEHOLDER = "{robot}"
"""Placeholder, as in policies, for the names of the robots that share a row."""


_DURATION = re.compile(r"(?<![\w.])\d+ (?:d|h|min|s)(?: \d+ (?:h|min|s))?(?![\w.])")
"""A duration as `elapsed` writes it."""
_CLOCK_SENTENCE = re.compile(r" The clock here shows \S+\.")
"""The time at which a robot reported a problem, which the row shows as well."""
_UNIT_SECONDS = {"d": 86400, "h": 3600, "min": 60, "s": 1}


def _joined_durations(texts: Mapping[str, str]) -> str:
    """Join texts of robots that differ only in durations, such as "2 min to 5 min behind".

    The text of a single robot has its name in place of `_ROBOT_PLACEHOLDER`.
    """
    durations_of_texts = [_DURATION.findall(text) for text in texts.values()]
    ranges = iter(
        [sorted(durations, key=_seconds) for durations in zip(*durations_of_texts, strict=True)]
    )
    robot, text = next(iter(texts.items()))

    def with_range(_: re.Match[str]) -> str:
        durations = next(ranges)
        return " to ".join(dict.fromkeys((durations[0], durations[-1])))

    text = _DURATION.sub(with_range, text)
    return text.replace(_ROBOT_PLACEHOLDER, robot) if len(texts) == 1 else text


def _seconds(duration: str) -> int:
    words = duration.split()
    return sum(
        int(number) * _UNIT_SECONDS[unit]
        for number, unit in zip(words[::2], words[1::2], strict=True)
    )


def _without_robot_name(text: str, robot: str) -> str:
    """Return a text with `_ROBOT_PLACEHOLDER` in place of the robot's name in paths."""
    return re.sub(rf"(?<=/){re.escape(robot)}(?=[/\s,;.:]|$)", _ROBOT_PLACEHOLDER, text)


def _is_next_number(before: str, name: str) -> bool:
    """Return whether ``name`` is ``before`` with one number increased by 1."""
    pairs = zip(natural_sort_key(before), natural_sort_key(name), strict=False)
    differing = [(first, second) for first, second in pairs if first != second]
    return (
        _DIGITS.sub("", before) == _DIGITS.sub("", name)
        and len(differing) == 1
        and differing[0][1][0] == differing[0][0][0] + 1
    )


def _robot_positions(robots: Iterable[str]) -> dict[str, int]:
    """Map the robots of a fleet to their positions, r2 before r10."""
    return {name: place for place, name in enumerate(sorted(robots, key=natural_sort_key))}


def _robot_names(
    names: Iterable[str],
    everybody: Iterable[str],
    groups: Mapping[str, Sequence[str]] = MappingProxyType({}),
    maximum: int = _MOST_GROUPS,
) -> str:
    """Return at most ``maximum`` names of robots; a whole group becomes "pickers (all 40)".

    Many neighbors in the fleet, whose numbers follow one another, become "r4 to r50".
    """
    places, remaining_names, words = _robot_positions(everybody), set(names), []
    number = len(remaining_names)
    for group, members in sorted(groups.items(), key=lambda item: -len(item[1])):
        if len(members) > _MOST_GROUPS and remaining_names.issuperset(members):
            words.append(f"{group} (all {len(members)})")
            remaining_names.difference_update(members)
    runs: list[list[str]] = []
    for name in sorted(remaining_names, key=places.__getitem__):
        last = runs[-1][-1] if runs else ""
        if runs and places[name] == places[last] + 1 and _is_next_number(last, name):
            runs[-1].append(name)
        else:
            runs.append([name])
    for run in runs:
        words += [f"{run[0]} to {run[-1]}"] if len(run) > _MOST_GROUPS else run
    shown = ", ".join(words[:maximum]) + (", ..." if len(words) > maximum else "")
    if number <= _MOST_GROUPS or (len(words) == 1 and not runs):
        return shown
    return f"{shown} ({number} robots)"


def _dds_findings(compared_fleet: ComparedFleet) -> Iterator[str]:
    """Yield the findings on the DDS of robots, except notes that need no attention."""
    from sros_tool.checks.kind import WARNING
    from sros_tool.checks.vulnerabilities import NOTES_ON_LIBRARIES

    for finding in compared_fleet.findings:
        if finding.severity >= WARNING or finding.kind in NOTES_ON_LIBRARIES:
            yield from finding_lines(finding)


def _dds_count_lines(compared_fleet: ComparedFleet) -> Iterator[str]:
    """Yield a line on robots with an outdated DDS, or else with the number of DDS findings."""
    status, outdated = compared_fleet.status, compared_fleet.outdated_dds
    if outdated:
        robots = _robot_names(outdated, status.names, status.groups)
        yield (
            f"a later release fixes known vulnerabilities in the DDS of {robots}; "
            f"`sros fleet status {quote(str(status.keystore))} --robot {outdated[0]} "
            "--fail-on vulnerabilities` lists them, with the exit status 1"
        )
    elif list(_dds_findings(compared_fleet)):
        severities = Counter(finding.severity.word for finding in compared_fleet.findings)
        words = ", ".join(counted(number, word) for word, number in severities.items())
        yield (
            f"findings on the DDS of robots: {words}; `sros fleet status "
            f"{quote(str(status.keystore))} --robot NAME --fail-on vulnerabilities` lists them, "
            "and so does --json"
        )


def _expiry_clauses(robot: RobotStatus, moment: datetime) -> Iterator[str]:
    """Yield a clause for each kind of file on a robot that has expired."""
    from sros_tool.validity import elapsed

    for kind, end in robot.expiry.items() if robot.state == "expired" else ():
        if end <= moment:
            yield f"{_KIND_WORDS.get(kind, kind)} expired {elapsed(moment - end)} ago"


def _summary(robot: RobotStatus, stage: str, moment: datetime) -> Iterator[str]:
    """Yield clauses on how a robot's files differ from the keystore's, the worst first.

    ``stage`` is the stage of the CA rotation in the keystore.
    """
    from sros_tool.keystore.confirmation import enclave_of

    # The notes explain some states.
    early, late = robot.is_doubtful, not robot.is_doubtful and robot.state != "unknown"
    if early:
        yield from robot.notes
    if robot.state == "never":
        yield counted(robot.enclaves, "enclave")
    if robot.revoked:
        yield f"{counted(len(robot.revoked), 'enclave')} revoked"
    foreign = Counter(
        file.robot or file.enclave for file in robot.pending if file.state == "another"
    )
    for owner, number in foreign.items():
        yield f"{counted(number, 'file')} of {owner}"
    revoked = [file for file in robot.pending if file.state == "revoked"]
    if waiting := sum(not file.surplus for file in revoked):
        new = "one waits" if waiting == 1 else "ones wait"
        yield f"{counted(waiting, 'revoked certificate')}: the new {new} for the robot"
    if surplus := len(revoked) - waiting:
        yield counted(surplus, "revoked file")
    if robot.fetches and robot.lacks_key:
        names = first_few(robot.lacks_key, _MOST_GROUPS)
        yield f"lacks the key of {names}: releases bring no keys"
    elif robot.lacks_ca:
        yield "does not trust the CA that seals releases: fetching does not change this"
    elif robot.is_locked_out(moment):
        yield "a web server that checks certificates refuses the robot"
    if not (early or late):
        yield from robot.notes
    groups: dict[tuple[str, str], Counter[str]] = {}
    for file in robot.pending:
        if file.state not in ("another", "revoked"):
            groups.setdefault((file.state, file.since), Counter())[file.kind] += 1
    for (state, since), kinds in list(groups.items())[:_MOST_GROUPS]:
        named = (
            kind if number == 1 else _kind_in_plural(number, kind) for kind, number in kinds.items()
        )
        yield f"{state} {', '.join(named)}{f' of {since}' if since else ''}"
    if len(groups) > _MOST_GROUPS:
        yield f"more, see --robot {robot.robot}"
    waits_for = {enclave_of(file.path) for file in robot.pending}
    has_the_rest = waits_for and waits_for <= {*robot.lacks_key}
    if robot.fetches and (robot.published or 0) != (robot.release or 0) and not has_the_rest:
        has, published = (
            f"release {number}" if number else "no release"
            for number in (robot.release, robot.published)
        )
        yield f"reports {has}; {published} is published"
    elif robot.fetches and robot.pending and not has_the_rest:
        other = f"its files differ from the published release {robot.release}"
        yield other if robot.is_published else "not published yet"
    seen = [name for name in robot.restart or () if (robot.running or {}).get(name) == "earlier"]
    if seen:
        yield f"processes of {first_few(seen, _MOST_GROUPS)} have not loaded the installed files"
    if unseen := [name for name in robot.restart or () if name not in seen]:
        names = first_few(unseen, _MOST_GROUPS)
        yield f"not known whether processes of {names} have loaded the installed files"
    if robot.waiting:
        names = first_few(robot.waiting, _MOST_GROUPS)
        yield f"its agent restarts {names} once the command of --restart-if exits with 0"
    if robot.enclaves and robot.stage not in ("", "unknown", stage):
        yield f"its CA files are from the stage '{robot.stage}' of the rotation"
    if late:
        yield from robot.notes


def _gravest_problem(robot: RobotStatus) -> Iterator[str]:
    """Yield the gravest problem of a robot, and the number of the others."""
    yield from robot.problem_clauses[:1]
    if (more := len(robot.problem_clauses) - 1) > 0:
        yield f"{counted(more, 'more problem')}, see --robot"


def _kind_in_plural(number: int, kind: str) -> str:
    if kind == "permissions":
        return f"{number} {kind}"
    return f"{number} certificates" if kind == "certificate" else f"{number} {kind} files"


def _file_details(robot: RobotStatus) -> Iterator[str]:
    """Yield the problems of a robot, and its files: their number by state, and what differs."""
    yield f"{robot.robot}:"
    yield from (f"  {problem}" for problem in robot.problem_clauses)
    where = ("in the robot's folder", "in other folders, with the robot's name in the path")
    for names, place in zip(robot.others, where, strict=True):
        see = ", see --json" if len(names) > _MOST_GROUPS else ""
        if names:
            yield (
                f"  {counted(len(names), 'enclave')} {place}, but not recorded in the fleet: "
                f"{first_few(names, _MOST_GROUPS)}{see}"
            )
    for kind, states in robot.files.items():
        yield f"  {kind:14} {', '.join(f'{number} {state}' for state, number in states.items())}"
    for library in robot.dds.libraries if robot.dds else ():
        version = library.version or "of unknown version"
        how = "loaded" if library.seen == "process" else "installed, not loaded"
        yield f"  {library.product} {version}, {how}: {library.path}"
    if robot.dds and robot.dds.unseen:
        yield f"  {counted(robot.dds.unseen, 'process', 'processes')} could not be examined"
    pending = robot.pending
    if robot.revoked and not robot.enclaves:
        yield (
            f"  {counted(len(pending), 'file')} of its revoked enclaves: no file is delivered to "
            "this "
            "robot, and only somebody at the robot can remove these files"
        )
        pending = ()
    for file in pending[:_MOST_LINES]:
        issued = f" of {file.since}" if file.since else ""
        owner_clause = f" of {file.robot or file.enclave}" if file.enclave else ""
        # Robots may have the list that a keystore restored from a backup has lost.
        is_lost = file.surplus and file.kind == "crl" and file.state == "unknown"
        action = "find out who signed " if is_lost else ""
        if robot.to_do == "deliver" and not is_lost:  # other files come, or wait for their cause
            action = f"{file.action} "
        surplus = ", which it should not have" if file.surplus and not action else ""
        yield f"  {action}{file.path}: {file.state}{issued}{owner_clause}{surplus}"
    if (more := len(pending) - _MOST_LINES) > 0:
        yield f"  and {more} more, see --json"


def _age_text(robot: RobotStatus, moment: datetime) -> str:
    from sros_tool.validity import elapsed

    return f"{elapsed(moment - robot.confirmed)} ago" if robot.confirmed else "-"


def _state_text(state: str) -> str:
    return _STATE_WORDS.get(state, state)
