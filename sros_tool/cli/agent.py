"""The verbs `sros agent ...`, which run on a robot: set up its agent, run it, show its state."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import replace
from datetime import timedelta
from pathlib import Path
from shlex import quote, split
from typing import TYPE_CHECKING, Any

import click

from sros_tool.cli.common import (
    PATH,
    Verb,
    dry_run_option,
    json_option,
    local_zone,
    now,
    print_json,
    read_file_or_stdin,
    secrets,
)
from sros_tool.cli.program import VerbGroup
from sros_tool.errors import DocumentError, SrosError, UsageError
from sros_tool.terminal import echo, visible_line
from sros_tool.values import file_change
from sros_tool.wording import counted, first_few

if TYPE_CHECKING:
    from datetime import datetime

    from sros_tool.agent.agent import Round
    from sros_tool.agent.settings import AgentSettings, Unit
    from sros_tool.agent.state import AgentStatus

_DEFAULT_INTERVAL = "5m"
_MOST_ROOT_BYTES = 512 * 1024
_MOST_SHOWN = 10


class _Agent(Verb, VerbGroup):
    """A click group whose subcommands are verbs."""

    command_class = Verb


@click.group("agent", cls=_Agent)
def agent() -> None:
    """On a robot: fetch its published releases, install them, and report its files.

    Example:
      $ sros agent init /etc/sros/keystore --robot r1 --root root.json \\
            --from https://fleet.example/pub --inbox https://fleet.example/inbox
      $ sros agent run /etc/sros/keystore --once
    """


@agent.command("init")
@click.argument("folder", type=PATH)
@click.option("--robot", metavar="NAME", help="The name of this robot.")
@click.option(
    "--from", "source", metavar="PLACE",
    help="The folder that `sros fleet publish` writes: as a URL (https, http) or a path.",
)  # fmt: skip
@click.option(
    "--inbox", metavar="PLACE",
    help="Where the robot's messages go: a URL that accepts PUT, or a folder.",
)  # fmt: skip
@click.option(
    "--root", "root_file", metavar="FILE", type=PATH,
    help=(
        "The first root metadata (root.json) of the publishing folder; with it, the agent verifies "
        "everything else."),
)  # fmt: skip
@click.option(
    "--ca", "authorities", metavar="SHA256|FILE", multiple=True,
    help="A permissions CA to trust: its SHA-256, or its certificate; for a robot without any "
    "enclave yet. Can be repeated.",
)  # fmt: skip
@click.option(
    "--tls-ca", metavar="FILE", type=PATH,
    help="CA certificates for HTTPS, to verify the servers. [default: the system's]",
)  # fmt: skip
@click.option(
    "--new-key/--no-new-key",
    default=None,
    help=(
        "Make a new key for each renewal. The robot then asks for renewal before `sros renew "
        "--all-expiring soon` would renew the certificate of the present key. [default: the key "
        "stays]"
    ),
)
@click.option(
    "--restart/--no-restart", default=None,
    help=(
        "Restart units of changed enclaves: the units of --unit, and active units that `sros "
        "units` wrote. [default: only report which restarts are due]"),
)  # fmt: skip
@click.option(
    "--unit", "units", metavar="UNIT=ENCLAVE,...", multiple=True,
    help=(
        "A systemd unit, and the enclaves in which it runs. Units restart in the order of these "
        "options. Can be repeated."
    ),
)  # fmt: skip
@click.option(
    "--restart-if", metavar="COMMAND",
    help="Restart units only if COMMAND exits with 0, for example because the robot stands still.",
)  # fmt: skip
@click.option(
    "--systemctl", metavar="COMMAND",
    help="The command that restarts units, such as 'systemctl --user'. [default: systemctl]",
)  # fmt: skip
@click.option(
    "--force", is_flag=True,
    help="Change the settings of an earlier init: what you do not give stays. An option that you "
        "give replaces all its earlier values; to drop them, remove the line from agent.toml.",
)  # fmt: skip
@dry_run_option
@json_option
@click.pass_context
def _init(
    context: click.Context,
    folder: Path,
    robot: str | None,
    source: str | None,
    inbox: str | None,
    root_file: Path | None,
    authorities: tuple[str, ...],
    tls_ca: Path | None,
    new_key: bool | None,
    restart: bool | None,
    units: tuple[str, ...],
    restart_if: str | None,
    systemctl: str | None,
    force: bool,
    dry_run: bool,
    as_json: bool,
) -> None:
    """Set up the agent of this robot: write its settings to FOLDER/.agent/agent.toml.

    FOLDER is where `sros import` or an Ansible play installs this robot's enclaves. The agent runs
    as the owner of FOLDER. Compare the printed SHA-256 of the root metadata with the SHA-256 that
    `sros fleet publish` printed. --robot, --from, --inbox and --root are needed, but with --force,
    all that you do not give stays as it is.

    Example:
      $ sros agent init /etc/sros/keystore --robot r1 --root root.json \\
            --from https://fleet.example/pub --inbox https://fleet.example/inbox
      wrote /etc/sros/keystore/.agent/agent.toml
      root metadata: SHA-256 9f2c...
      $ sros agent init robot --robot r1 --root /media/usb/pub/metadata/1.root.json \\
            --from /media/usb/pub --inbox /media/usb/inbox --restart
      $ sros agent init robot --force --restart-if /opt/robot/stands-still
      wrote robot/.agent/agent.toml
      kept the earlier --robot, --from, --inbox, --restart, --root
    """
    from sros_tool.agent.fetch import is_root_pinned, pin_root
    from sros_tool.agent.install import has_permissions_ca
    from sros_tool.agent.settings import (
        SETTINGS_FILE,
        AgentSettings,
        agent_folder,
        check_owner,
        make_agent_folder,
        read_settings,
        render_settings,
        settings_from,
        write_settings,
    )
    from sros_tool.agent.state import (
        InitializedAgent,
        read_state,
        refuse_files_of_other_robot,
        write_state,
    )
    from sros_tool.files import parse_toml
    from sros_tool.keystore.delivery.robot import read_pinned_cas

    if not folder.is_dir():
        raise UsageError(
            f"'{folder}' is not a folder",
            "",
            "Name the folder that the enclaves of this robot are in, or will be in.",
        )
    check_owner(folder)
    path = agent_folder(folder) / SETTINGS_FILE
    existed = path.exists()
    earlier: AgentSettings | None = None
    if existed and force:
        with suppress(DocumentError):  # then the options are needed, as without earlier settings
            earlier = read_settings(folder)
    has_root = earlier is not None and is_root_pinned(agent_folder(folder))
    needed = {"robot": earlier, "source": earlier, "inbox": earlier, "root_file": has_root}
    for parameter in _init.params:
        name = parameter.name or ""
        if not needed.get(name, True) and context.params[name] is None:
            raise click.MissingParameter(ctx=context, param=parameter)
    pins = sorted({pin for text in authorities for pin in read_pinned_cas(text)})
    given: dict[str, Any] = {
        "robot": robot,
        "source": source and _absolute_source(source),
        "inbox": inbox and _absolute_source(inbox),
        "authorities": tuple(pins) if authorities else None,
        "tls_ca": str(tls_ca.absolute()) if tls_ca else None,
        "new_key": new_key,
        "restart": restart,
        "restart_if": None if restart_if is None else _words(restart_if, "--restart-if"),
        "systemctl": None if systemctl is None else _words(systemctl, "--systemctl"),
        "units": tuple(_parse_unit(text) for text in units) if units else None,
    }
    given = {name: value for name, value in given.items() if value is not None}
    settings = replace(earlier, **given) if earlier else AgentSettings(**given)
    kept = earlier.options(without=given) if earlier else []
    kept += ["--root"] * (root_file is None)
    refuse_files_of_other_robot(folder, settings.robot)
    if not settings.authorities and not has_permissions_ca(folder):
        raise UsageError(
            f"'{folder}' has no permissions CA, so this robot could trust no release",
            "No delivered enclave is there.",
            "Bring the enclaves of this robot first, with `sros distribute_key` or an Ansible "
            "play; or, if their keys were made here by `sros create_request`, name the CA with "
            "--ca.",
        )
    settings_from(parse_toml(render_settings(settings).decode()), "these options")
    if tls_ca and not tls_ca.is_file():
        raise UsageError(f"'{tls_ca}' is not a file")
    root = None
    if root_file:
        root = read_file_or_stdin(root_file, "root metadata", max_bytes=_MOST_ROOT_BYTES)
    if existed and not force:
        raise UsageError(
            f"'{folder}' already has an agent",
            f"'{path}' exists.",
            "Edit it, or add --force to change the settings that you give, and to trust only this "
            "root metadata.",
        )
    digest = ""
    if not dry_run:
        make_agent_folder(folder)
        digest = "" if root is None else pin_root(agent_folder(folder), root, now=now())
        write_settings(folder, settings)
        # The recorded results may be those of another source and inbox.
        write_state(folder, replace(read_state(folder), fetched=None, sent=None, problems=()))
    if as_json:
        changes = file_change(path, existed=existed)
        print_json(
            InitializedAgent(
                folder, dry_run, settings.robot, digest or None, tuple(kept), changes, ()
            )
        )
        return
    echo(f"{'would write' if dry_run else 'wrote'} {path}")
    if kept:
        echo(f"kept the earlier {', '.join(kept)}")
    if digest:
        echo(f"root metadata: SHA-256 {digest}")


def _words(command: str, option: str) -> tuple[str, ...]:
    """Return the words of a command, which ``option`` states."""
    try:
        return tuple(split(command))
    except ValueError as error:
        raise UsageError(
            f"{option} is not a command",
            f"{command!r} has a quotation mark or backslash without its counterpart.",
            "Write it as in a shell.",
        ) from error


def _absolute_source(text: str) -> str:
    """Return a URL as it is, and the path of a folder as an absolute path."""
    return text if "://" in text else str(Path(text).absolute())


def _parse_unit(text: str) -> Unit:
    from sros_tool.agent.settings import Unit

    name, mark, enclaves = text.partition("=")
    if not mark or not enclaves:
        raise UsageError(
            f"--unit {text!r} names no enclave", "", "Write --unit camera.service=/r1/camera."
        )
    return Unit(name, tuple(enclaves.split(",")))


@agent.command("run")
@click.argument("folder", type=PATH)
@click.option("--once", is_flag=True, help="Run one round and end, for a timer.")
@click.option(
    "--interval", metavar="DURATION", default=_DEFAULT_INTERVAL, show_default=True,
    help="The time between two rounds.",
)  # fmt: skip
@click.option(
    "--restarted", is_flag=True,
    help="With --once: confirm that all processes were restarted since the last round, even "
        "processes that the agent cannot see. The confirmation does not count for files that "
        "this round installs.",
)  # fmt: skip
@json_option
def _run(folder: Path, once: bool, interval: str, restarted: bool, as_json: bool) -> int:
    """Install the robot's releases in FOLDER, and report which files and processes the robot has.

    A round fetches the robot's release, verifies it, and installs it whole or not at all. It
    restarts units, or reports the restarts that are due, and checks the running processes. It asks
    for renewal in the last third of a certificate's validity, and sends a signed report to the
    keystore machine. After `sros agent init --new-key`, it asks for renewal when 60 % of the
    validity of the certificate or of the permissions is over, whichever is first.
    If one step fails, the other steps still run, and the next round tries the failed step again.

    Example:
      $ sros agent run /etc/sros/keystore --once
      release 12: changed 2 enclaves
      restart due: /r1/camera, /r1/lidar
      message sent
      $ sros agent run /etc/sros/keystore --interval 10m

    The exit status of --once is 0 if nothing is wrong, and 1 if something is.
    """
    from sros_tool.agent.settings import read_settings
    from sros_tool.agent.state import agent_lock
    from sros_tool.validity import parse_duration

    pause = parse_duration(interval)
    if restarted and not once:
        raise UsageError("--restarted is for --once only")
    read_settings(folder)  # a missing agent is reported first, also with --interval
    if once:
        with agent_lock(folder):
            done = _round(folder, read_settings(folder), restarted=restarted)
        _show(folder, done, restarted=restarted, as_json=as_json)
        return int(bool(done.problems))
    while True:
        try:
            with agent_lock(folder):
                _show(folder, _round(folder, read_settings(folder)), as_json=as_json)
        except (SrosError, OSError) as error:
            if isinstance(error, BrokenPipeError):
                raise
            echo(visible_line(f"this round failed: {error}"), err=True)
        sys.stdout.flush()
        time.sleep(pause.total_seconds())


def _round(folder: Path, settings: AgentSettings, *, restarted: bool = False) -> Round:
    import os

    from sros_tool.agent.agent import Machine, run_round

    moment = now()
    machine = Machine(moment, local_zone(os.environ), secrets(), restarted=restarted)
    return run_round(folder, settings, machine)


def _show(folder: Path, finished_round: Round, *, restarted: bool = False, as_json: bool) -> None:
    if as_json:
        print_json(finished_round)
        return
    for line in _round_lines(folder, finished_round, restarted=restarted):
        echo(visible_line(line))
    for problem in finished_round.problems:
        echo(visible_line(problem), err=True)


def _round_lines(folder: Path, finished_round: Round, *, restarted: bool) -> Iterator[str]:
    number = finished_round.accepted
    release = f"release {number}" if number else "no release"
    release += ", not yet complete" * (number > finished_round.release)
    changes = (
        [f"changed {counted(len(finished_round.changed), 'enclave')}"]
        if finished_round.changed
        else []
    )
    changes += (
        [f"removed {counted(len(finished_round.removed), 'enclave')}"]
        if finished_round.removed
        else []
    )
    if lists := len(finished_round.lists):
        of_enclaves = "list of 1 enclave was" if lists == 1 else f"lists of {lists} enclaves were"
        changes = [f"only the revocation {of_enclaves} installed"]
    no_change = "nothing changed" if finished_round.fetched else "nothing could be fetched"
    yield f"{release}: {', '.join(changes) or no_change}"
    if restarted and finished_round.unseen:
        has_new_files = not {*finished_round.changed}.isdisjoint(finished_round.unseen)
        yield (
            "--restarted does not count for files that this round "
            f"{'installed' if has_new_files else 'could not install yet'}: files of "
            f"{first_few(finished_round.unseen, _MOST_SHOWN)}"
        )
    for unit in finished_round.restarted:
        yield f"restarted {unit.name} ({first_few(unit.enclaves, _MOST_SHOWN)})"
    yield from _due_lines(folder, finished_round)
    if finished_round.requests:
        yield f"asked for renewal of {counted(finished_round.requests, 'enclave')}"
    yield "message sent" if finished_round.sent else "message not sent"


def _due_lines(folder: Path, last: Round | AgentStatus) -> Iterator[str]:
    if last.restart:
        yield f"restart due: {first_few(last.restart, _MOST_SHOWN)}"
    if last.waiting:
        yield (
            f"the agent itself restarts {first_few(last.waiting, _MOST_SHOWN)} in the first round "
            "in which the command of --restart-if exits with 0"
        )
    if unseen := [name for name in last.unseen if name not in last.waiting]:
        yield (
            "sros cannot see all processes here; once the processes of "
            f"{first_few(unseen, _MOST_SHOWN)} were restarted, or if no such process runs, confirm "
            f"this: `sros agent run {quote(str(folder))} --once --restarted`"
        )


@agent.command("status")
@click.argument("folder", type=PATH)
@click.option(
    "--max-age", metavar="DURATION", default="1d", show_default=True,
    help=(
        "Exit with 1 if the agent has not reached the publishing folder or the inbox for longer "
        "than DURATION."),
)  # fmt: skip
@json_option
def _status(folder: Path, max_age: str, as_json: bool) -> int:
    """Show the result of the agent's last round in FOLDER, what is due, and what is wrong now.

    sros examines the files now, as `sros verify` does; the processes are those of the last round.

    Example:
      $ sros agent status /etc/sros/keystore
      robot r1: release 12
      source reached 4 min ago: https://fleet.example/pub
      confirmed 4 min ago to https://fleet.example/inbox
      restart due: /r1/camera

    The exit status is 0 if nothing is wrong or due, and 1 if something is.
    """
    from sros_tool.agent.state import agent_status
    from sros_tool.validity import parse_duration

    oldest = parse_duration(max_age)
    moment = now()
    status = agent_status(folder, now=moment, oldest=oldest)
    if as_json:
        print_json(status)
    else:
        for line in _status_lines(status, moment):
            echo(visible_line(line))
    return int(not status.well)


def _status_lines(status: AgentStatus, moment: datetime) -> Iterator[str]:
    release = f"release {status.accepted}" if status.accepted else "no release"
    release += ", not yet complete" * (status.accepted > status.release)
    yield f"robot {status.robot}: {release}"
    yield f"source reached {_time_ago(status.fetched, moment)}: {status.source}"
    yield f"confirmed {_time_ago(status.sent, moment)} to {status.inbox}"
    yield from _due_lines(status.folder, status)
    yield from status.problems


def _time_ago(time: datetime | None, moment: datetime) -> str:
    from sros_tool.validity import elapsed

    if time is None:
        return "never"
    gone = moment - time
    return f"{elapsed(gone)} ago" if gone >= timedelta() else f"in the future ({elapsed(-gone)})"
