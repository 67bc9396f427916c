"""The verb `units`: units of systemd for nodes in enclaves, and for the work on a keystore."""

from __future__ import annotations

import os
import pwd
import shutil
import sys
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import click

from sros_tool.cli.common import (
    PATH,
    chosen_enclaves,
    complete_keystore_and_enclave,
    domain_of,
    dry_run_option,
    json_option,
    print_json,
    print_notes,
    several_enclaves,
    split_root,
)
from sros_tool.cli.containers import INSTALLED, target_path
from sros_tool.cli.enclave_environment import loadable_environment
from sros_tool.cli.progress import progress
from sros_tool.cli.running import ACCEPT_KEY, COMMAND, DOMAIN, RMW, WithCommand
from sros_tool.errors import UsageError
from sros_tool.owners import other_writers, replaceable_on_the_way
from sros_tool.runtime.units import Job
from sros_tool.terminal import echo
from sros_tool.written import FileChange

if TYPE_CHECKING:
    from sros_tool.errors import Note

_NODE_USER = "ros"


class _WithCommandAfterDashes(WithCommand):
    needs_no_dashes = False


@click.command(
    "units",
    cls=_WithCommandAfterDashes,
    epilog="""\b
Examples:
  $ sros units keystore /talker units -- /opt/robot/talker.sh
  wrote units/sros@.service
  wrote units/sros@talker.service.d/enclave.conf
  $ sudo cp -r units/* /etc/systemd/system/
  $ sudo systemctl enable --now sros@talker
  $ sros units keystore --match '/arm/*' units  # /etc/sros/nodes/arm/...
  $ sros units keystore --job renew --job check --job metrics units""",
)
@click.argument(
    "words",
    metavar="[ROOT] [NAME...] FOLDER [-- COMMAND...]",
    nargs=-1,
    required=True,
    shell_complete=complete_keystore_and_enclave,
)
@several_enclaves
@click.option(
    "--job",
    "jobs",
    multiple=True,
    type=click.Choice([each.value for each in Job]),
    help="A timer that renews what expires within 30 days, checks the keystore each day, or "
    "writes metrics every 15 minutes: of the keystore, or of `sros fleet status` (fleet); guard is "
    "no timer, and watches all ROS processes of the machine, as root.  Can be repeated.",
)
@click.option(
    "--target",
    "there",
    metavar="DIR",
    help="The path of the keystore where the units run. "
    f"[default: {INSTALLED} for nodes, ROOT for jobs]",
)
@click.option(
    "--user",
    metavar="NAME",
    help=f"The user who runs the units. [default: {_NODE_USER}, for jobs the owner of ROOT]",
)
@click.option(
    "--sros",
    "program",
    metavar="FILE",
    help="The program sros where the units run, which then also verifies each enclave before its "
    "node starts. [default: none for nodes, this program for jobs]",
)
@click.option(
    "--passphrase-file",
    "passphrase",
    metavar="FILE",
    help="With --job renew: the file there with the passphrase of the CA keys.",
)
@DOMAIN
@RMW
@ACCEPT_KEY
@click.option("--force", is_flag=True, help="Replace files in FOLDER that differ.")
@dry_run_option
@json_option
@click.pass_context
def units(
    ctx: click.Context,
    words: tuple[str, ...],
    every: bool,
    patterns: tuple[str, ...],
    robots: tuple[str, ...],
    jobs: tuple[str, ...],
    there: str | None,
    user: str | None,
    program: str | None,
    passphrase: str | None,
    domain: str | None,
    rmw: str | None,
    accept_readable_key: bool,
    force: bool,
    dry_run: bool,
    as_json: bool,
) -> None:
    """Write units of systemd to FOLDER: nodes in the enclaves NAME..., and timers (--job).

    A node runs in its enclave or not at all, sees the keys of no other enclave, and gets no right
    that a ROS node does not need. COMMAND is its program; without it, that is a file with the path
    of the enclave in /etc/sros/nodes.
    """
    from sros_tool.keystore.layout import enclaves_below
    from sros_tool.runtime.units import (
        TEMPLATE,
        WrittenUnits,
        job_units,
        node_settings,
        node_template,
        unit_instance,
    )

    root, rest = split_root(words)
    command = tuple(ctx.meta[COMMAND])
    several = bool(every or patterns or robots)
    if not rest or not (rest[1:] or several or jobs):
        raise UsageError("units takes a keystore, enclaves or --job, and a folder")
    folder = PATH.convert(rest[-1], None, None)
    if passphrase is not None and Job.RENEW not in jobs:
        raise UsageError("--passphrase-file is for --job renew only")
    if user is not None and Job.GUARD in jobs:
        raise UsageError(
            "--user is not for --job guard",
            "Only root can look at the processes of all users.",
            "Write the guard by a command of its own, without --user.",
        )
    if jobs and (rest[1:] or several) and there is None:
        raise UsageError(
            f"the nodes run where the keystore is in {INSTALLED}, and the jobs are for '{root}'",
            "One folder of units is for one machine.",
            "Write them to two folders by two commands, or name the keystore there by --target.",
        )
    target = None if there is None else target_path(there)
    files: dict[str, str] = {}
    notes: list[Note] = []
    names: Sequence[str] = ()
    if rest[1:] or several:
        names = chosen_enclaves(root, rest[:-1], patterns, robots, every=every)
        place = target or Path(INSTALLED)
        files[TEMPLATE] = node_template(user or _NODE_USER)
        with progress("checking"):
            for name in names:
                found = loadable_environment(
                    root, name, domain, rmw, accept_key=accept_readable_key, target=place
                )
                notes += [*found.notes, *found.enclave_notes]
                files[f"sros@{unit_instance(name)}.service.d/enclave.conf"] = node_settings(
                    name,
                    found.variables,
                    str(place),
                    command=command,
                    below=enclaves_below(root, name),
                    sros=program or "",
                )
    elif command:
        raise UsageError("COMMAND is for nodes, and no enclave is named")
    for job in jobs:
        files |= job_units(
            Job(job),
            str(target or root.absolute()),
            user=user or _owner(root),
            sros=program or _this_program(),
            passphrase=passphrase or "",
            domain=domain_of(domain) or 0,
        )
    changes = _changes(folder, files, force=force)
    if not dry_run:
        _write(folder, files, changes)
    if as_json:
        written = [FileChange(action, str(folder / path)) for path, action in changes.items()]
        print_json(WrittenUnits(root, dry_run, names, written, notes))
        return
    for path, action in changes.items():
        word = f"would {action}" if dry_run else {"create": "wrote", "replace": "replaced"}[action]
        echo(f"{word} {folder / path}")
    if not changes:
        echo(f"the units in '{folder}' are already up to date", err=True)
    print_notes(list(dict.fromkeys(notes)))


def _owner(root: Path) -> str:
    """Return the name of the owner of a keystore.  Raises `UsageError`."""
    number = root.stat().st_uid
    try:
        return pwd.getpwuid(number).pw_name
    except KeyError:
        raise UsageError(
            f"the owner of keystore '{root}', user {number}, has no name", "", "Add --user NAME."
        ) from None


def _this_program() -> str:
    """Return the absolute path of the program sros that runs.  Raises `UsageError`."""
    found = shutil.which(sys.argv[0]) or shutil.which("sros")
    if found is None or not os.access(found, os.X_OK):
        raise UsageError("this program has no path of its own", "", "Add --sros FILE.")
    return str(Path(found).absolute())


def _changes(folder: Path, files: Mapping[str, str], *, force: bool) -> dict[str, str]:
    """Map the files that are missing or differ to `create` or `replace`.

    Raises:
        UsageError: a file differs, and not ``force``.
    """
    from sros_tool.xml import read_bytes

    _refuse_folders_of_others(folder, files)
    found = {}
    for path, text in files.items():
        if not os.path.lexists(folder / path):
            found[path] = "create"
        elif read_bytes(folder / path, "unit") != text.encode():
            found[path] = "replace"
    different = [path for path, action in found.items() if action == "replace"]
    if different and not force:
        raise UsageError(
            f"'{folder}' already holds other versions of {', '.join(different[:3])}",
            "Nothing was changed.",
            "Add --force to replace these files, or choose another folder.",
        )
    return found


def _refuse_folders_of_others(folder: Path, files: Iterable[str]) -> None:
    """Raise `UsageError` if another user could change the units, which systemd would run."""
    trusted = frozenset({0, os.geteuid()})
    for place in dict.fromkeys((folder, *((folder / path).parent for path in files))):
        others = [*replaceable_on_the_way(place, trusted)]
        if os.path.lexists(place):
            others.append((place, other_writers(place.lstat(), trusted)))
        for each, why in others:
            if why:
                raise UsageError(
                    f"the units would be in '{each}', which others can change: {why}",
                    "systemd would run what they write there.",
                    "Choose a folder that only you can change, such as /etc/systemd/system.",
                )


def _write(folder: Path, files: Mapping[str, str], changes: Mapping[str, str]) -> None:
    from sros_tool.files import new_files, replace_file, write_new_folder

    new = {path: files[path].encode() for path, action in changes.items() if action == "create"}
    if not folder.exists():
        write_new_folder(folder, new)
        return
    with new_files(folder, new):
        for path, action in changes.items():
            if action == "replace":
                replace_file(folder / path, files[path].encode())
