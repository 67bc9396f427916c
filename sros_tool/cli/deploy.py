"""The verbs that bring enclaves to robots: exporting them, and verifying what arrived."""

from __future__ import annotations

import sys
from pathlib import Path

import click

from sros_tool.cli.common import (
    PATH,
    complete_keystore_and_enclave,
    domain_of,
    dry_run_option,
    json_option,
    keystore_from_environment,
    moment_of,
    now,
    print_json,
    print_plan,
    split_root,
)
from sros_tool.errors import UsageError

STREAM = Path("-")
"""Standard input or output, where a file could be named."""


@click.command(
    "distribute_key",
    epilog="""\b
Example:
  $ sros distribute_key keystore /talker talker.tar.gz
  exported enclave /talker to 'talker.tar.gz'
  $ tar -xzf talker.tar.gz -C /etc/robot/keystore      # on the robot
  $ sros distribute_key keystore --match '/arm/*' - | ssh robot tar -xz -C robot
  exported enclave /arm/gripper to standard output
  exported enclave /arm/wrist to standard output
  left out enclave /arm/camera: its key was made on its robot""",
)
@click.argument(
    "words",
    metavar="[ROOT] [NAME...] TARGET",
    nargs=-1,
    required=True,
    shell_complete=complete_keystore_and_enclave,
)
@click.option("--all", "every", is_flag=True, help="Export all enclaves of the keystore.")
@click.option(
    "--match",
    "patterns",
    multiple=True,
    metavar="PATTERN",
    help="Export those that fit, such as '/arm/*'; * also stands for '/'.  May be repeated.",
)
@click.option("--force", is_flag=True, help="Replace what TARGET holds of another version.")
@dry_run_option
def distribute_key(
    words: tuple[str, ...], every: bool, patterns: tuple[str, ...], force: bool, dry_run: bool
) -> None:
    """Export the enclaves NAME... to TARGET: a folder, a .tar.gz, or - for standard output.

    TARGET is a keystore with these enclaves only: real files in place of links, and no CA key.
    """
    from sros_tool.keystore.archive import SUFFIXES
    from sros_tool.keystore.export import distribute, pack_enclaves, select

    root, rest = split_root(words)
    names = rest[:-1]
    if not rest or not (names or every or patterns):
        raise UsageError("distribute_key takes a keystore, one or more enclaves and a target")
    target = PATH.convert(rest[-1], None, None)
    _check_target(root, rest[-1])
    selection = select(root, names, patterns, every=every)
    if target == STREAM:
        if not dry_run:
            refuse_terminal()
        packed = pack_enclaves(root, selection.names, now=now())
        if dry_run:
            for path in packed.paths:
                click.echo(f"would send {path}")
        else:
            write_stdout(packed.data)
        where, done = "standard output", not dry_run
    else:
        export = distribute(root, selection.names, target, now=now(), force=force, dry_run=dry_run)
        where, done = f"'{target}'", bool(export.changes) and not dry_run
        if dry_run:
            archive = target.name.endswith(SUFFIXES)
            print_plan(target.parent if archive else target, export.changes)
        elif not export.changes:
            for name in selection.names:
                click.echo(f"'{target}' already holds enclave {name} as it is", err=True)
        for change in export.changes if done else ():
            if change.action == "replace":
                click.echo(f"replaced {change.path}", err=True)
    for name in selection.names if done else ():
        click.echo(f"exported enclave {name} to {where}", err=target == STREAM)
    for name in selection.left_out:
        click.echo(f"left out enclave {name}: its key was made on its robot", err=True)


def _check_target(root: Path, word: str) -> None:
    """Refuse the name of an enclave as the target: there it was forgotten."""
    from sros_tool.keystore.layout import enclave_names

    if word.startswith("/") and not Path(word).exists() and word in set(enclave_names(root)):
        raise UsageError(
            f"no target is named: '{word}' is an enclave",
            "",
            "Add a folder, a .tar.gz, or - for standard output.",
        )


def write_stdout(data: bytes) -> None:
    """Write binary data on standard output, after what was printed."""
    sys.stdout.flush()
    sys.stdout.buffer.write(data)
    sys.stdout.buffer.flush()


def refuse_terminal() -> None:
    """Raise `UsageError` where binary data would land on a terminal."""
    if sys.stdout is not None and sys.stdout.isatty():
        raise UsageError(
            "an archive would be written to this terminal",
            "It is binary, and it may hold private keys.",
            "Lead it into a pipe, such as `| ssh robot tar -xz -C /etc/robot`, or name a file.",
        )


@click.command(
    "verify",
    epilog="""\b
Example:
  $ sros verify robot
  /arm/camera  loadable in domain 0 until 2027-05-20T07:45:12Z
  /arm/gripper  loadable in domain 0 until 2027-05-20T07:45:12Z
  /arm/wrist  NOT LOADABLE
    permissions.p7s: missing
    key.pem: others have access to it (mode 0644): chmod 600
  $ sros verify robot --at 2027-06-01 || echo 'renew before June'""",
)
@click.argument("folder", metavar="[DIR]", type=PATH, required=False)
@click.option("--domain", metavar="ID", help="Ask also whether it may join this ROS domain.")
@click.option("--at", metavar="MOMENT", help="As if it were then: 2027-06-01, or 90d from now.")
@json_option
def verify(folder: Path | None, domain: str | None, at: str | None, as_json: bool) -> int:
    """On a robot: say whether the enclaves in DIR, or the enclave DIR, can be used as they are.

    Checks that they are complete, consistent, in date and loadable; that nobody else can read the
    keys; that no CA key came with them; and that they trust the same CAs.  The exit status is 0 if
    all is well.
    """
    from sros_tool.keystore.arrival import verify_arrival
    from sros_tool.validity import iso

    folder = folder or keystore_from_environment()
    wanted, moment = domain_of(domain), moment_of(at)
    arrival = verify_arrival(folder, now=moment, domain=wanted)
    if as_json:
        print_json({**arrival.describe(), "at": iso(moment), "domain": wanted})
        return 1 if arrival.findings else 0
    for each in arrival.enclaves:
        until = f" until {iso(each.until)}" if each.until else ""
        said = f"loadable in domain {each.domains}{until}" if each.loadable else "NOT LOADABLE"
        click.echo(f"{each.name}  {said}")
        for finding in arrival.findings:
            if finding.enclave == each.name:
                click.echo(f"  {finding.file}: {finding.text}")
    for finding in arrival.findings:
        if not finding.enclave:
            click.echo(f"{finding.file}: {finding.text}")
    return 1 if arrival.findings else 0
