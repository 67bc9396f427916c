"""The verbs that add policies to each other, and compare what they and keystores allow."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from sros_tool.cli.common import (
    PATH,
    Decorated,
    dry_run_option,
    json_option,
    print_json,
    print_notes,
)
from sros_tool.cli.visible import visible
from sros_tool.errors import PolicyError, UsageError

if TYPE_CHECKING:
    from sros_tool.keystore.rights import RightsSource
    from sros_tool.notes import Note
    from sros_tool.policy.diff import Difference
    from sros_tool.policy.edit import Merged
    from sros_tool.policy.rights import Right


def output_option(help_text: str) -> Callable[[Decorated], Decorated]:
    """``-o FILE`` for a verb that writes a policy."""
    return click.option("-o", "--output", type=PATH, metavar="FILE", help=help_text)


force_option = click.option("--force", is_flag=True, help="Let FILE be replaced if it exists.")


def right_json(right: Right) -> dict[str, str]:
    """A right as JSON; ``kind`` is topics, services, actions or dds."""
    return {
        "enclave": right.enclave,
        "qualifier": right.qualifier.value,
        "kind": right.kind,
        "right": right.right,
        "name": right.name,
    }


def notes_json(notes: Sequence[Note]) -> list[dict[str, str]]:
    """Remarks as JSON."""
    return [{"id": note.id, "text": note.text} for note in notes]


def check_output(output: Path, *, force: bool) -> None:
    """Refuse a file that exists, unless it may be replaced, and what cannot be written.

    A device or a pipe is written to, and needs no permission to be replaced.
    """
    if not output.absolute().parent.is_dir():
        raise UsageError(
            f"cannot write '{output}'", "Its folder does not exist.", "Make the folder first."
        )
    if output.is_dir():
        raise UsageError(f"cannot write '{output}'", "It is a folder.", "Name a file.")
    if output.is_file() and not force:
        raise UsageError(f"'{output}' already exists", "", "Name another file, or add --force.")


def save(output: Path, document: bytes) -> str:
    """Write a document as a whole, and return what to say about it."""
    from sros_tool.atomic import replace_file

    verb = "replaced" if output.exists() else "wrote"
    replace_file(output, document)
    return visible(f"{verb} '{output}'")


# ── merge_policy ───────────────────────────────────────────────────────────────────────────


@click.command(
    "merge_policy",
    epilog="""\b
Example:
  $ sros merge_policy robot.xml learned.xml --in-place
  added 2 rights
    /talker ALLOW publish topic /diagnostics
    /talker ALLOW subscribe topic /tf
  note [merge.still-denied]: /talker DENY publish topic /cmd_vel stays, and counts before what was
  asked for: publish topic /cmd_vel.
  replaced 'robot.xml'""",
)
@click.argument("policy", metavar="POLICY", type=PATH)
@click.argument("others", metavar="OTHER...", type=PATH, nargs=-1, required=True)
@output_option("Write the result to FILE.")
@click.option("--in-place", is_flag=True, help="Write the result to POLICY itself.")
@force_option
@dry_run_option
@json_option
def merge_policy(
    policy: Path,
    others: tuple[Path, ...],
    output: Path | None,
    in_place: bool,
    force: bool,
    dry_run: bool,
    as_json: bool,
) -> None:
    """Print POLICY with the rights of every OTHER policy added.

    Comments, includes, metadata and layout of POLICY stay as they are; those of the others are
    not taken over. A right is added for its one direction only, and only where the enclave does
    not have it yet, be it through an include or a wildcard. A DENY always stays and always counts
    before an ALLOW; where the policies contradict each other, it is said.
    """
    from sros_tool.policy.edit import merge_all
    from sros_tool.policy.merge import merge_notes
    from sros_tool.policy.reader import read_policy

    if in_place and output:
        raise UsageError("--in-place and --output exclude each other")
    target = policy if in_place else output
    if output:
        check_output(output, force=force)
    merged = merge_all(policy, [read_policy(path) for path in others])
    if output:
        _check_includes(policy, output, merged.document)
    saved = ""
    if target and not dry_run and (merged.added or output):
        saved = save(target, merged.document)
    if as_json:
        show = target is None and not dry_run
        _print_merged_json(policy, merged, target if saved else None, show=show)
    elif dry_run:
        for right in merged.added:
            click.echo(f"would add {right}")
        if target and (merged.added or output):
            click.echo(f"would {'replace' if target.exists() else 'write'} {target}")
        if not merged.added:
            click.echo("no right would be added")
    elif target is None:
        click.echo(merged.document, nl=False)
    if not dry_run and not as_json:
        _say_added(merged)
    print_notes(merge_notes(merged.contradictions))
    if saved:
        click.echo(saved, err=True)


def _say_added(merged: Merged) -> None:
    count = len(merged.added)
    if not count:
        click.echo("no right was missing", err=True)
        return
    click.echo(f"added {count} right{'s' if count > 1 else ''}", err=True)
    for right in merged.added:
        click.echo(f"  {right}", err=True)


def _print_merged_json(policy: Path, merged: Merged, written: Path | None, *, show: bool) -> None:
    from sros_tool.policy.text import Text

    value: dict[str, Any] = {
        "policy": str(policy),
        "added": [right_json(right) for right in merged.added],
        "contradictions": [
            {
                "denied": right_json(each.denied),
                "allowed": right_json(each.allowed),
                "new": each.new,
            }
            for each in merged.contradictions
        ],
        "output": str(written) if written else None,
    }
    if show:
        value["document"] = Text(merged.document, str(policy)).text
    print_json(value)


def _check_includes(policy: Path, output: Path, document: bytes) -> None:
    """Refuse a place from where the includes of the policy would lead elsewhere."""
    from sros_tool.policy.reader import read_policy

    try:
        same = read_policy(output, document) == read_policy(policy, document)
    except PolicyError:
        same = False
    if not same:
        raise PolicyError(
            f"the result would not mean the same as '{output}'",
            f"Its includes are relative, and lead elsewhere than from '{policy}'.",
            f"Write it into the folder of '{policy}'.",
        )


# ── diff_policy ────────────────────────────────────────────────────────────────────────────


@click.command(
    "diff_policy",
    epilog="""\b
Example:
  $ sros diff_policy robot.xml keystore
  - /talker ALLOW publish topic /status
  - /talker ALLOW request service /*
  + /talker ALLOW request service /add_two_ints  (A has it by request service /*)
  3 rights differ
  $ sros diff_policy robot.xml keystore/enclaves/talker/permissions.p7s""",
)
@click.argument("a", metavar="A", type=PATH)
@click.argument("b", metavar="B", type=PATH)
@json_option
def diff_policy(a: Path, b: Path, as_json: bool) -> int:
    """Compare the rights that A and B give: "-" has only A, "+" only B.

    Each is a policy file, a permissions.p7s or permissions.xml, the folder of an enclave, or a
    keystore. Permissions are told in ROS terms, and their signature is verified where the
    permissions CA lies with them. If one side is for a single enclave, only that is compared.

    The exit status is 1 if they differ, or if DDS would refuse one of them.
    """
    from sros_tool.keystore.rights import load_rights
    from sros_tool.policy.diff import compare

    first, second = load_rights(a), load_rights(b)
    scope = None
    if first.scope is None or second.scope is None:
        scope = second.scope if first.scope is None else first.scope
    difference = compare(first.rights, second.rights, scope)
    if as_json:
        print_json(_difference_json(first, second, difference))
    else:
        for line in _difference_lines(difference):
            click.echo(line)
        count = len(difference.only_first) + len(difference.only_second)
        of = f" of {', '.join(sorted(scope))}" if scope else ""
        differ = f"1 right{of} differs" if count == 1 else f"{count} rights{of} differ"
        click.echo(differ if count else f"the rights{of} are the same", err=True)
    print_notes((*first.notes, *second.notes))
    return 0 if not difference and first.sound and second.sound else 1


def _difference_lines(difference: Difference) -> list[str]:
    lines = []
    for sign, right in difference.lines():
        by = ", ".join(each.told() for each in difference.covered.get(right, ()))
        remark = f"  ({'B' if sign == '-' else 'A'} has it by {by})" if by else ""
        lines.append(f"{sign} {right}{remark}")
    return lines


def _difference_json(
    first: RightsSource, second: RightsSource, difference: Difference
) -> dict[str, Any]:
    return {
        "equal": not difference,
        **{
            side: {
                "path": str(source.path),
                "kind": source.kind,
                "enclaves": None if source.scope is None else sorted(source.scope),
                "sound": source.sound,
                "notes": notes_json(source.notes),
            }
            for side, source in (("a", first), ("b", second))
        },
        "differences": [
            {
                "only": "a" if sign == "-" else "b",
                **right_json(right),
                "covered_by": [right_json(each) for each in difference.covered.get(right, ())],
            }
            for sign, right in difference.lines()
        ],
    }
