"""The result on one page, in Markdown, for somebody who reviews the security of a robot."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from datetime import datetime

from sros_tool.demo.model import Status
from sros_tool.demo.records import CastMember, RowResult
from sros_tool.demo.result import DemoResult
from sros_tool.validity import iso


def summary_page(result: DemoResult, now: datetime) -> str:
    """The page; ``now`` is when it was seen."""
    attacks = [row for row in result.rows if row.attack and not row.removed]
    others = [row for row in result.rows if not row.attack]
    wrong = [row for row in result.rows if not row.as_expected]
    lines = [
        "# What was tried on this robot's security",
        "",
        f"Seen {iso(now)} with `sros demo` on {result.backend.dds}, expectations of the keystore"
        f" template `{result.template}`: **{_verdict(result, wrong)}**",
        "",
    ]
    for scenario in result.scenarios:
        lines += _cast(scenario.cast)
    if wrong:
        lines += ["## Not as expected", ""]
        lines += [
            f"- **{row.name}**: expected {row.expected}, observed {row.observed}. {row.detail}"
            for row in wrong
        ]
        lines.append("")
    if attacks:
        lines += _attacks(attacks, [row for row in result.rows if row.removed])
    if others:
        lines += ["## What else was shown", "", *_table(others)]
    for scenario in result.scenarios:
        if scenario.cost is not None:
            lines += ["## What security costs", "", *scenario.cost.markdown(), ""]
    return "\n".join(lines).rstrip() + "\n"


def _cast(members: Sequence[CastMember]) -> list[str]:
    if not members:
        return []
    lines = ["## Who plays which part", "", "| part | enclave | ROS nodes |", "| --- | --- | --- |"]
    lines += [f"| {each.part} | {each.enclave} | {', '.join(each.nodes)} |" for each in members]
    return [*lines, ""]


def _verdict(result: DemoResult, wrong: Sequence[RowResult]) -> str:
    known = sum(1 for row in result.rows if row.known_open)
    skipped = sum(1 for row in result.rows if row.observed is Status.SKIPPED)
    parts = [f"{len(wrong)} of {len(result.rows)} rows not as expected" if wrong else "as expected"]
    if known:
        parts.append(f"{known} ways in that are known to be open")
    if skipped:
        parts.append(f"{skipped} rows could not be tried")
    return ", ".join(parts) + "."


def _attacks(attacks: Sequence[RowResult], removed: Sequence[RowResult]) -> list[str]:
    closed = [row for row in attacks if not row.open_because]
    open_ = [row for row in attacks if row.open_because]
    lines = [
        "## Attacks",
        "",
        "An attack that fails proves something only if it works elsewhere: the last column says how"
        " the same attack ended without the defence.",
        "",
        "| attack | expected | observed | what decides | without the defence |",
        "| --- | --- | --- | --- | --- |",
    ]
    for row in closed:
        twins = "; ".join(_unique(_twin(each) for each in removed if each.attack == row.attack))
        lines.append(f"| {_cells(row)} | {row.mechanism} | {twins} |")
    if open_:
        lines += ["", "## Known to be open, and what to do", ""]
        lines += [
            "| attack | expected | observed | why | remedy |",
            "| --- | --- | --- | --- | --- |",
        ]
        lines += [f"| {_cells(row)} | {row.open_because} | {row.remedy} |" for row in open_]
    return [*lines, ""]


def _twin(row: RowResult) -> str:
    return f"{row.observed} without {row.removed}"


def _unique(texts: Iterable[str]) -> list[str]:
    return list(dict.fromkeys(texts))


def _table(rows: Sequence[RowResult]) -> list[str]:
    lines = ["| row | expected | observed | what decides |", "| --- | --- | --- | --- |"]
    return [*lines, *(f"| {_cells(row)} | {row.mechanism} |" for row in rows), ""]


def _cells(row: RowResult) -> str:
    observed = str(row.observed) if row.as_expected else f"**{row.observed}**"
    if row.observed is Status.SKIPPED:
        observed = f"skipped: {row.detail}"
    return f"{row.name} | {row.expected} | {observed}"
