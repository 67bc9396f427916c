"""The verb that measures how much wider a policy is than its use, and narrows it."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from sros_tool.cli.common import (
    PATH,
    SeveralValues,
    dry_run_option,
    json_option,
    print_json,
    print_notes,
)
from sros_tool.cli.policy import (
    check_output,
    force_option,
    notes_json,
    output_option,
    right_json,
    save,
)
from sros_tool.errors import PolicyError
from sros_tool.notes import Note

if TYPE_CHECKING:
    from sros_tool.policy.minimize import EnclaveUse, Minimized
    from sros_tool.policy.model import Group, Policy
    from sros_tool.policy.rights import Right
    from sros_tool.policy.wildcards import Proposal

_SHOWN = 5
_ROOM = 256  # bytes below the limit, as names of CAs and signatures vary in length


class _SeveralObserved(SeveralValues):
    several = ("--observed",)


@click.command(
    "minimize_policy",
    cls=_SeveralObserved,
    epilog="""\b
Example:
  $ sros minimize_policy robot.xml --observed learned.xml -o narrow.xml
  /talker: allowed 23, observed 4: 5.8x
    never observed, and removed
      publish topic /status
    wider than its use
      request service /*  becomes  request service /add_two_ints
    never observed, and kept as every node needs it: 11
    observed, and not allowed
      publish topic /cmd_vel
    permissions.p7s: 4044 bytes, then 4028, of at most 65535
  wrote 'narrow.xml'""",
)
@click.argument("policy", type=PATH)
@click.option(
    "--observed",
    required=True,
    multiple=True,
    type=PATH,
    metavar="OBSERVED...",
    help="What was observed: policies by generate_policy, or permissions.",
)
@output_option("Write the narrowed policy to FILE.")
@click.option(
    "--strict",
    is_flag=True,
    help="Remove also what every node needs (common/node.xml), if it was not observed.",
)
@force_option
@dry_run_option
@json_option
def minimize_policy(
    policy: Path,
    observed: tuple[Path, ...],
    output: Path | None,
    strict: bool,
    force: bool,
    dry_run: bool,
    as_json: bool,
) -> None:
    """Tell what POLICY allows and nobody was observed to use, and narrow it.

    The number behind "allowed" and "observed" counts pairs of a right and an exact name; a
    wildcard counts as the names it matches among all that are known: from the policy, from the
    observations, and as what every node needs. What is written is one self-contained file:
    includes are resolved and comments are not kept, metadata is. A DENY always stays, and an
    enclave that was not observed at all stays as it is.
    """
    from sros_tool.keystore.rights import load_rights
    from sros_tool.policy.minimize import minimize
    from sros_tool.policy.reader import read_policy
    from sros_tool.policy.writer import write_policy

    if output:
        check_output(output, force=force)
    given = read_policy(policy)
    sources = [load_rights(path) for path in observed]
    seen = frozenset(right for source in sources for right in source.rights)
    result = minimize(given, seen, () if strict else _common())
    notes = [note for source in sources for note in source.notes]
    notes += _notes(given, result, seen)
    measured = _measure(given, result, seen)
    document = write_policy(result.policy)
    if output and read_policy(output, document) != result.policy:
        raise PolicyError("the narrowed policy does not read as it was meant")
    saved = save(output, document) if output and not dry_run else ""
    if as_json:
        value = _json(policy, result, measured, output if not dry_run else None)
        print_json({**value, "notes": notes_json(notes)})
    else:
        for use in result.uses:
            for line in _lines(use, measured[use.enclave]):
                click.echo(line)
    print_notes(notes)
    if output and dry_run:
        click.echo(f"would {'replace' if output.exists() else 'write'} {output}", err=as_json)
    if saved:
        click.echo(saved, err=True)


def _common() -> Sequence[Group]:
    """What every node needs, said for a node."""
    from sros_tool.policy.reader import read_policy
    from sros_tool.resources import policies_dir

    basics = read_policy(policies_dir() / "defaults" / "node_basics.xml")
    return [group for each in basics.enclaves for p in each.all_profiles() for group in p.groups]


def _notes(given: Policy, result: Minimized, seen: frozenset[Right]) -> Iterator[Note]:
    unseen = [use.enclave for use in result.uses if not use.seen]
    if unseen:
        text = f"never observed, and so left as they are: {', '.join(unseen)}."
        yield Note("minimize.enclave-never-observed", text)
    unknown = sorted({right.enclave for right in seen} - {each.path for each in given.enclaves})
    if unknown:
        text = f"observed, but not in the policy: {', '.join(unknown)}."
        yield Note("minimize.enclave-not-in-policy", text)


@dataclass(frozen=True, slots=True)
class _Measured:
    """The signed permissions of an enclave in bytes, and how they could become smaller."""

    before: int
    after: int
    proposals: tuple[Proposal, ...] = ()


def _measure(given: Policy, result: Minimized, seen: frozenset[Right]) -> dict[str, _Measured]:
    from sros_tool.dds.permissions import MAX_SIGNED_BYTES
    from sros_tool.keystore.measure import Scale, right_bytes
    from sros_tool.policy.rights import policy_rights
    from sros_tool.policy.wildcards import propose_wildcards

    scale = Scale()
    measured = {}
    for before, after in zip(given.enclaves, result.policy.enclaves, strict=True):
        sizes = scale.signed_bytes(before), scale.signed_bytes(after)
        proposals: tuple[Proposal, ...] = ()
        if sizes[1] > MAX_SIGNED_BYTES - _ROOM:
            proposals = propose_wildcards(
                after.path,
                policy_rights(result.policy),
                policy_rights(given) | seen,
                needed=sizes[1] - MAX_SIGNED_BYTES + _ROOM,
                size=right_bytes,
            )
        measured[before.path] = _Measured(*sizes, proposals)
    return measured


# ── telling ────────────────────────────────────────────────────────────────────────────────


def ratio_text(ratio: float | None) -> str:
    """The over-privilege ratio, such as 3.5x."""
    return "nothing of it is in use" if ratio is None else f"{ratio:.1f}x"


def _lines(use: EnclaveUse, measured: _Measured) -> Iterator[str]:
    from sros_tool.dds.permissions import MAX_SIGNED_BYTES

    if not use.seen:
        yield f"{use.enclave}: allowed {use.allowed_pairs}, never observed, left as it is"
    else:
        counts = f"allowed {use.allowed_pairs}, observed {use.observed_pairs}"
        yield f"{use.enclave}: {counts}: {ratio_text(use.ratio)}"
        if use.unused:
            yield "  never observed, and removed"
            yield from (f"    {right.told()}" for right in use.unused)
    if use.wide:
        yield "  wider than its use" if len(use.wide) == 1 else "  wider than their use"
    for wide in use.wide:
        used = ", ".join(right.told() for right in wide.used) or "nothing"
        instead = ", ".join(right.told() for right in wide.replacement)
        if instead == used:
            yield f"    {wide.rule.told()}  becomes  {instead}"
        else:
            yield f"    {wide.rule.told()}  covered {used}"
            yield f"      {f'becomes {instead}' if instead else 'not needed: other rules have it'}"
    if use.common:
        yield f"  never observed, and kept as every node needs it: {len(use.common)}"
    if use.refused:
        yield "  observed, and not allowed"
        yield from (f"    {right.told()}" for right in use.refused)
    sizes = f"{measured.before} bytes"
    if measured.after != measured.before:
        sizes += f", then {measured.after}"
    too_large = "" if measured.after < MAX_SIGNED_BYTES else ": TOO LARGE for Fast DDS 2.9"
    yield f"  permissions.p7s: {sizes}, of at most {MAX_SIGNED_BYTES - 1}{too_large}"
    for proposal in measured.proposals:
        names = [right.told() for right in proposal.adds]
        adds = ", ".join(names[:_SHOWN]) or "no name known here"
        adds += f" and {len(names) - _SHOWN} more" if len(names) > _SHOWN else ""
        yield f"    {proposal.rule.told()}  in place of {len(proposal.replaces)} names"
        yield f"      would save {proposal.saves} bytes and add {adds}"


def _json(
    policy: Path, result: Minimized, measured: dict[str, _Measured], output: Path | None
) -> dict[str, Any]:
    from sros_tool.dds.permissions import MAX_SIGNED_BYTES

    def rights(found: Sequence[Right]) -> list[dict[str, str]]:
        return [right_json(right) for right in found]

    return {
        "policy": str(policy),
        "output": str(output) if output else None,
        "enclaves": [
            {
                "enclave": use.enclave,
                "observed_at_all": use.seen,
                "allowed": use.allowed_pairs,
                "observed": use.observed_pairs,
                "remaining": use.remaining_pairs,
                "ratio": use.ratio,
                "never_observed": rights(use.unused),
                "kept_for_every_node": rights(use.common),
                "wildcards": [
                    {
                        "rule": right_json(wide.rule),
                        "used": rights(wide.used),
                        "replacement": rights(wide.replacement),
                    }
                    for wide in use.wide
                ],
                "not_allowed": rights(use.refused),
                "bytes": {
                    "before": measured[use.enclave].before,
                    "after": measured[use.enclave].after,
                    "limit": MAX_SIGNED_BYTES,
                },
                "proposals": [
                    {
                        "rule": right_json(each.rule),
                        "replaces": rights(each.replaces),
                        "adds": rights(each.adds),
                        "saves": each.saves,
                    }
                    for each in measured[use.enclave].proposals
                ],
            }
            for use in result.uses
        ],
    }
