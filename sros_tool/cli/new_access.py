"""`diff_policy --no-new-access`: what a change adds, as text, JSON or Markdown."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from sros_tool.cli.common import print_json, print_notes
from sros_tool.cli.progress import progress
from sros_tool.terminal import echo, echo_document

if TYPE_CHECKING:
    from sros_tool.fleet.model import Fleet
    from sros_tool.proof.growth import Gain, Growth, NewReach
    from sros_tool.proof.sources import AccessSource

_MOST_LINES = 20
"""Lines of reach that text shows, and enclaves of a line; JSON has all."""
_MOST_CHARACTERS = 12_000
"""Characters of each list in Markdown."""


def show_new_access(
    base: Path, head: Path, fleets: tuple[Fleet | None, Fleet | None], form: str
) -> int:
    """Print what HEAD adds to BASE in a format; return 1 if it adds anything, else 0.

    Raises:
        SrosError: it cannot be decided.
    """
    from sros_tool.proof.growth import ComparedSide, NewAccess, compare_access
    from sros_tool.proof.sources import load_side

    with progress("reading"):
        before, after = load_side(base, fleets[0]), load_side(head, fleets[-1])
    with progress("comparing"):
        growth = compare_access(before, after)
    if form == "json":
        print_json(NewAccess(ComparedSide.of(before), ComparedSide.of(after), growth))
    elif form == "markdown":
        echo_document(access_markdown(before, after, growth))
    else:
        for line in (*_added_lines(after, growth), *_removed_lines(before, growth)):
            echo(line)
        echo(access_summary(growth), err=True)
    if form != "json":
        print_notes((*before.notes, *after.notes))
    return int(bool(growth))


def _added_lines(head: AccessSource, growth: Growth) -> list[str]:
    return [
        *_folded(head, "+", growth.added, growth),
        *(f"+ less protection: {each}" for each in growth.lost),
        *_reach_lines(head, growth.reach),
    ]


def _removed_lines(base: AccessSource, growth: Growth) -> list[str]:
    more = (
        f"- more protection: {each.key} {each.after} -> {each.before}" for each in growth.gained
    )
    return [*_folded(base, "-", growth.removed, growth), *more]


def _folded(side: AccessSource, sign: str, gains: Iterable[Gain], growth: Growth) -> list[str]:
    from sros_tool.fleet.folding import folded

    lines = [(gain.enclaves[0], f"{sign} {_gain_text(sign, gain, growth)}") for gain in gains]
    return list(folded(side.fleet, lines))


def _gain_text(sign: str, gain: Gain, growth: Growth) -> str:
    who, other = _some(gain.enclaves), "BASE" if sign == "+" else "HEAD"
    if gain.action == "join":
        text = f"{who} join the domain"
    elif gain.right is None:
        text = f"{who} {gain.action} DDS topic {gain.topic}, which no right states"
    else:
        text = f"{who} {gain.right.describe()}"
        if gain.source:
            text += f"  ({gain.source})"
        if gain.right.enclave not in gain.enclaves:
            text += f" by the permissions of {gain.right.enclave}, which fit its certificate"
        if gain.name != gain.right.name:
            text += f": such as {gain.name}"
    if gain.denied:
        at = f" at {gain.denied_at}" if gain.denied_at else ""
        text += f", which {other} denies by {gain.denied.name}{at}"
    if gain.worlds != growth.worlds:
        text += f"; with {', '.join(gain.worlds)}"
    if gain.domains != (0,) or len(growth.domains) > 1:
        text += f"; in domain {', '.join(map(str, gain.domains))}"
    return text


def _reach_lines(head: AccessSource, reach: Sequence[NewReach]) -> list[str]:
    from sros_tool.fleet.folding import folded
    from sros_tool.reach import path_text

    found = [
        (each.source, f"+ {each.source} can influence {each.target}: {path_text(each.path)}")
        for each in reach
    ]
    lines = list(folded(head.fleet, found))
    more = len(lines) - _MOST_LINES
    if more > 0:
        lines[_MOST_LINES:] = [f"+ and {more} more that can influence others (--json has all)"]
    return lines


def _some(names: Sequence[str]) -> str:
    more = len(names) - _MOST_LINES
    return ", ".join(names[:_MOST_LINES]) + (f" and {more} more" if more > 0 else "")


def access_summary(growth: Growth) -> str:
    """Return what a change adds, in one sentence."""
    worlds = ", ".join(growth.worlds)
    basis = "".join(
        f"; {title}: {', '.join(clauses)}"
        for title, clauses in (
            ("not compared", growth.not_compared),
            ("assumed", growth.assumed),
            ("left out", growth.left_out),
        )
        if clauses
    )
    gone = f"; {_count(len(growth.removed), 'right')} gone" if growth.removed else ""
    if not growth:
        return f"nobody gets more access, and nothing is protected less ({worlds}){gone}{basis}"
    parts = []
    if growth.added:
        parts.append(f"{_count(len(growth.added), 'right')} new")
    if growth.lost:
        parts.append(f"{_count(len(growth.lost), 'protection')} less")
    if growth.reach:
        pairs = len(growth.reach)
        text = "1 enclave can influence another one"
        parts.append((text if pairs == 1 else f"{pairs} pairs of enclaves can influence") + " now")
    if growth.added and growth.reach_unknown:
        parts.append(f"whom that lets enclaves influence is not known: {growth.reach_unknown}")
    return "; ".join(parts) + gone + basis


def _count(number: int, what: str) -> str:
    return f"1 {what} is" if number == 1 else f"{number} {what}s are"


def access_markdown(base: AccessSource, head: AccessSource, growth: Growth) -> str:
    """Return what a change adds, and removes, as Markdown."""
    from sros_tool.markdown import bounded, code, plain

    rest = "which `sros diff_policy --no-new-access` shows"
    parts = [f"### New access: {plain('yes' if growth else 'none')}", plain(access_summary(growth))]
    lists = (("added", _added_lines(head, growth)), ("removed", _removed_lines(base, growth)))
    for title, lines in lists:
        if lines:
            parts.append(f"**{len(lines)} {title}**")
            parts.append(bounded((code(each[2:]) for each in lines), _MOST_CHARACTERS, rest))
    return "\n\n".join(parts) + "\n"
