"""The output of verbs that change a keystore: changes, old files that still work, next steps.

The change itself (with ``--json``, as JSON) goes to standard output, all else to standard error.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress
from pathlib import Path
from shlex import quote
from typing import TYPE_CHECKING

from sros_tool.cli.common import print_json, print_notes
from sros_tool.errors import SrosError
from sros_tool.terminal import echo
from sros_tool.wording import counted, first_few

if TYPE_CHECKING:
    from sros_tool.keystore.lifecycle.change import Changed
    from sros_tool.keystore.lifecycle.replaced import ReplacedRights
    from sros_tool.keystore.outcomes import StagedZenoh
    from sros_tool.keystore.transaction import Change

_NAMES_SHOWN = 5
MAX_NAMES = 20
"""Number of enclaves that a message names."""
_CLOSED_SHOWN = 3


def json_form(result: Changed, form: str, **more: object) -> tuple[object, ...]:
    """Convert a change to the ``--json`` class with the name ``form`` in `lifecycle.shown`.

    ``more`` are fields that the change does not have.
    """
    from sros_tool.keystore.lifecycle import shown

    return shown.shown(result, getattr(shown, form), **more)


def print_changed(
    result: Changed,
    json_data: tuple[object, ...] | None = None,
    lines: Iterable[str] = (),
    *,
    planned: Iterable[str] = (),
    first: Iterable[str] = (),
    after: Iterable[str] = (),
    rights: bool = True,
    exported: bool = True,
    restart: bool = True,
) -> None:
    """Print a change of a keystore.

    Args:
        result: the change.
        json_data: what ``--json`` prints of the change; None without ``--json``.
        lines: what was done; a dry run prints the files that it would change instead.
        planned: lines that a dry run prints before these files.
        first: messages that come first on standard error.
        after: messages that come after the lines about changed rights.
        rights: say which rights enclaves lose and gain.
        exported: also say that exports are out of date.
        restart: say which processes have to be restarted.
    """
    if json_data is not None:
        print_json(json_data)
    elif result.dry_run:
        for line in planned:
            echo(line)
        print_plan(result.root, result.changes)
    else:
        for line in lines:
            echo(line)
    _print_to_stderr(first)
    print_follow_up(result, after, rights=rights, exported=exported, restart=restart)


def enclave_lines(names: Sequence[str], text: str) -> Iterator[str]:
    """Yield a line for each enclave, or one line for all if they are more than 20.

    ``text`` is the line, with the words ``enclave {}``. If steps are logged, each enclave has a
    line.
    """
    import logging

    if len(names) <= MAX_NAMES or logging.getLogger("sros_tool").isEnabledFor(logging.INFO):
        yield from map(text.format, names)
    else:
        several = text.replace("enclave {}", counted(len(names), "enclave"))
        yield f"{several}: {shown_names(names)} (-v lists all)"


def first_lines(lines: Sequence[str]) -> Iterator[str]:
    """Yield the first lines about enclaves, and a line with the number of further enclaves.

    If steps are logged, all lines are yielded.
    """
    import logging

    if logging.getLogger("sros_tool").isEnabledFor(logging.INFO):
        yield from lines
        return
    yield from lines[:MAX_NAMES]
    if more := len(lines[MAX_NAMES:]):
        yield f"and {counted(more, 'more enclave')} (-v lists all)"


def print_follow_up(
    result: Changed,
    after: Iterable[str] = (),
    *,
    rights: bool = True,
    exported: bool = True,
    restart: bool = True,
) -> None:
    """Print the next steps after a change on standard error; arguments as for `print_changed`."""
    if not result.dry_run:
        print_closed_and_adopted(result.root, result.changes)
    if rights:  # on stderr: stdout has the same lines as with ros2/sros2
        _print_to_stderr(rights_lines(result.root, result.rights, dry_run=result.dry_run))
    _print_to_stderr(after)
    if restart:
        _print_restart(result.root, result.restart, result.zenoh, exported=exported)
    _print_to_stderr(remark.text for remark in result.remarks)
    print_notes(result.notes)


def _print_to_stderr(lines: Iterable[str]) -> None:
    for line in lines:
        echo(line, err=True)


def print_plan(root: Path, changes: Sequence[Change]) -> None:
    """Print the files that a dry run would change, as `print_files` does."""
    plan: dict[str, list[str]] = {}
    for change in changes:
        plan.setdefault(change.action, []).append(change.path)
    for action, paths in plan.items():
        print_files(root, f"would {action}", paths)
    if not changes:
        echo("nothing would change")


def print_files(root: Path, words: str, paths: Sequence[str]) -> None:
    """Print ``words`` with the path of each file in the keystore ``root``.

    Files that differ only in the robot of a fleet share a line, and of many files only the first
    ones are named.  If steps are logged, all files are printed.
    """
    import logging

    is_verbose = logging.getLogger("sros_tool").isEnabledFor(logging.INFO)
    shown = paths if is_verbose else list(_change_lines(root, paths))
    if len(shown) > MAX_NAMES and not is_verbose:
        places = [str(root / path) for path in paths]
        shown_files = first_few(places, _NAMES_SHOWN)
        echo(f"{words} {counted(len(paths), 'file')}: {shown_files} (-v lists all)")
        return
    for path in shown:
        echo(f"{words} {root / path}")


def planned_lines(root: Path, names: Sequence[str], text: str) -> Iterator[str]:
    """Yield lines as `enclave_lines` does; the robots of a fleet share a line."""
    folded = list(_folded_by_robot(root, ((name, name) for name in names)))
    yield from enclave_lines(folded if len(folded) <= MAX_NAMES else names, text)


def _change_lines(root: Path, paths: Sequence[str]) -> Iterator[str]:
    """Yield the paths of files; paths that differ only in the robot of a fleet share a line."""
    lines = ((f"/{path.partition('/')[2].rpartition('/')[0]}", path) for path in paths)
    yield from _folded_by_robot(root, lines)


def _folded_by_robot(root: Path, lines: Iterable[tuple[str, str]]) -> Iterator[str]:
    """Yield lines about enclaves; lines that differ only in the robot of a fleet become one."""
    from sros_tool.fleet.robots import folded_lines
    from sros_tool.keystore.fleet import load_fleet
    from sros_tool.keystore.reader import OpenedKeystore

    fleet = None
    with suppress(SrosError):  # a new keystore and an export have no fleet
        fleet = load_fleet(OpenedKeystore(root))
    yield from folded_lines(fleet, lines)


def print_closed_and_adopted(
    root: Path, changes: Sequence[Change], *, keystore: Path | None = None
) -> None:
    """Report on stderr keys that were closed to other users, and adoption of an sros2 keystore.

    ``root`` is an export of ``keystore``, or, without that argument, the keystore itself.
    """
    if any(change.action == "adopt" for change in changes):
        echo(
            f"took over '{root}', which ros2/sros2 made: it has settings and a ledger from now on. "
            "The existing certificates and permissions that its CA signed are trusted: sros cannot "
            "see whether somebody put back a replaced or withdrawn file. Compare the rights of "
            "each "
            f"enclave with your policy: `sros diff_policy {quote(str(keystore or root))} "
            "POLICY_FILE`.",
            err=True,
        )
    closed = [str(root / change.path) for change in changes if change.action == "close"]
    if closed:
        where = quote(str(keystore or root))
        echo(
            "files that other users could open until now, and cannot open any more: "
            f"{first_few(closed, _CLOSED_SHOWN)}. Run the nodes as the owner of the keystore, or "
            "give other users exports (`sros distribute_key`). Replace keys that somebody may "
            f"have copied: keys of enclaves with `sros renew {where} ENCLAVE --new-key "
            f"--revoke-old`, keys of CAs with `sros rotate_ca {where} --next`.",
            err=True,
        )


def rights_lines(
    root: Path, replaced_rights: Sequence[ReplacedRights], *, dry_run: bool
) -> Iterator[str]:
    """Yield a line for each lost or gained right; the robots of a fleet share a line."""
    from sros_tool.fleet.robots import folded_lines
    from sros_tool.keystore.fleet import fleet_before_change
    from sros_tool.keystore.reader import OpenedKeystore

    fleet = fleet_before_change(OpenedKeystore(root)) if replaced_rights else None
    together: dict[tuple[str, str], list[str]] = {}
    for rights in replaced_rights:
        for verb, text in (("lose", rights.lost_text(fleet)), ("gain", rights.gained_text(fleet))):
            if text:
                together.setdefault((verb, text), []).append(rights.enclave)
    lines = []
    for (verb, text), names in together.items():
        word = f"would {verb}" if dry_run else verb if len(names) > 1 else f"{verb}s"
        lines.append((names[0], f"{shown_names(names)} {word}: {text}"))
    yield from folded_lines(fleet, lines)


def shown_names(names: Sequence[str]) -> str:
    """Return the first names in words, and the number of the others: "/a, /b and 3 more"."""
    return first_few(names, _NAMES_SHOWN)


def _print_restart(
    root: Path, names: Sequence[str], zenoh: StagedZenoh | None = None, *, exported: bool = True
) -> None:
    """Print on stderr that the processes of the enclaves ``names`` have to be restarted.

    ``zenoh`` has the enclaves whose Zenoh processes are affected.  With ``exported``, also print
    that exports are out of date.
    """
    from sros_tool.keystore.fleet import publish_command
    from sros_tool.keystore.layout import remedy_in_closed_robot

    if not names:
        return
    number = counted(len(names), "enclave")
    text = f"restart the processes of {number} for the change to take effect: "
    text += shown_names(names)
    if zenoh and zenoh.files and set(zenoh.restart) != set(names):
        text += f"; on Zenoh: {shown_names(zenoh.restart) or 'none'}"
    if exported and (published := publish_command(root)):
        text += f"; for robots that fetch, first run {published}"
    export_again = "export their enclaves again"
    here = remedy_in_closed_robot(root, export_again)
    if exported and here != export_again:
        text = f"first {here}; then {text}"
    elif exported:
        text += f"; if processes run from an export, {export_again} first"
    echo(text, err=True)
