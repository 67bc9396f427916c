"""Shows findings: as text, as JSON of a stable shape, and as SARIF."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path

import click

from sros_tool import __version__
from sros_tool.checks.kind import Finding
from sros_tool.checks.registry import Chosen, Selection, select_kinds
from sros_tool.checks.sarif import sarif
from sros_tool.cli.common import print_json
from sros_tool.cli.visible import visible

_SCHEMA = 1


def _print_text(chosen: Chosen, _selection: Selection) -> None:
    for each in chosen.shown:
        click.echo(visible("\n".join(finding_lines(each))))
    for choice in dict.fromkeys(each.accepted for each in chosen.accepted):
        kinds = {e.id: e.kind.title for e in chosen.accepted if e.accepted == choice}
        told = "; ".join(f"{title} [{identity}]" for identity, title in kinds.items())
        click.echo(f"accepted, as the {choice} chose it: {told}")
    click.echo(_summary(chosen), err=True)


def finding_lines(finding: Finding) -> list[str]:
    """A finding for people: where and what, why here, and what to do."""
    head = f"{finding.place}: {finding.severity.word}: {finding.kind.title} [{finding.id}]"
    told = "" if finding.subject in (finding.file, finding.place) else f"{finding.subject}: "
    by = f" (chosen by the {finding.accepted})" if finding.accepted else ""
    return [head, f"    {told}{finding.text}{by}", f"    {finding.remedy}"]


def _summary(chosen: Chosen) -> str:
    counts = _counts(chosen)
    told = [f"{number} {word}{'s' * (number != 1)}" for word, number in counts.items() if number]
    number = chosen.hidden
    hidden = f" (not shown: {number} note{'s' * (number != 1)}, --severity note)" if number else ""
    return f"{', '.join(told) or 'nothing found'}{hidden}"


def _counts(chosen: Chosen) -> dict[str, int]:
    words = [each.severity.word for each in chosen.shown]
    return {word: words.count(word) for word in ("error", "warning", "note")}


def _print_json(chosen: Chosen, _selection: Selection) -> None:
    print_json(
        {
            "version": _SCHEMA,
            "findings": [each.as_json() for each in chosen.shown],
            "accepted": [each.as_json() for each in chosen.accepted],
            "counts": {**_counts(chosen), "hidden": chosen.hidden},
        }
    )


def _print_sarif(chosen: Chosen, selection: Selection) -> None:

    kinds, findings = select_kinds(selection), (*chosen.shown, *chosen.accepted)
    print_json(sarif(findings, kinds, version=__version__, base=Path.cwd()))


def print_list(selection: Selection, form: str) -> None:
    """Show the kinds of findings that are selected."""

    kinds = list(select_kinds(selection))
    if form != "text":
        print_json([each.as_json() for each in kinds])
        return
    width = max((len(each.id) for each in kinds), default=0)
    for each in kinds:
        click.echo(f"{each.id:{width}}  {each.severity.word:7}  {each.title}")


SHOW: Mapping[str, Callable[[Chosen, Selection], None]] = {
    "text": _print_text,
    "json": _print_json,
    "sarif": _print_sarif,
}
"""How findings are shown, by the value of --format."""
