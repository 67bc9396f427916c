"""Show the result of the demo as text: one line per row, and under it what was seen."""

from __future__ import annotations

from collections.abc import Sequence

from sros_tool.demo.cost import cost_table
from sros_tool.demo.model import Status
from sros_tool.demo.records import CastMember, RowResult
from sros_tool.demo.result import DemoResult, ScenarioResult

_INDENT = " " * 6


def demo_table(result: DemoResult) -> str:
    """The table, with the backend above it and the verdict below."""
    network = (
        "a network namespace of its own"
        if result.isolation.isolated
        else f"the network of this machine ({result.isolation.reason})"
    )
    lines = [
        f"{result.backend.dds}, topic {result.topic}, in {network}",
        f"backend {result.backend.name}: {result.backend.why}",
    ]
    for scenario in result.scenarios:
        lines.append("")
        if len(result.scenarios) > 1:
            lines += [f"{scenario.name}: {scenario.title}", ""]
        lines += _cast(scenario.cast)
        lines += _scenario(scenario)
    return "\n".join([*lines, "", _summary(result.rows)])


def _cast(members: Sequence[CastMember]) -> list[str]:
    """Who plays which part, in a keystore that was not made for it."""
    width = max((len(member.part) for member in members), default=0)
    lines = [
        f"{_INDENT}{member.part:<{width}}  {member.enclave}"
        + (f" as node {', '.join(member.nodes)}" if member.nodes else "")
        for member in members
    ]
    return ["cast by the rights in the keystore:", *lines, ""] if lines else []


def _scenario(scenario: ScenarioResult) -> list[str]:
    rows = scenario.rows
    widths = [
        max(len(text) for text in column)
        for column in (
            ["what was tried", *(row.name for row in rows)],
            ["expected", *(row.expected for row in rows)],
            ["observed", *(row.observed for row in rows)],
        )
    ]
    lines = [_line("", ("what was tried", "expected", "observed"), widths)] if rows else []
    for row in rows:
        lines += [
            _line(_mark(row), (row.name, row.expected, row.observed), widths),
            f"{_INDENT}{row.detail}",
        ]
        if row.known_open:
            lines.append(f"{_INDENT}{row.open_because}; to do: {row.remedy}")
    return lines if scenario.cost is None else [*lines, "", *cost_table(scenario.cost)]


def _line(mark: str, cells: Sequence[str], widths: Sequence[int]) -> str:
    padded = (cell.ljust(width) for cell, width in zip(cells, widths, strict=True))
    return f"{mark:<4}  {'  '.join(padded)}".rstrip()


def _mark(row: RowResult) -> str:
    if row.observed is Status.SKIPPED:
        return "skip"
    if row.known_open:
        return "open"
    return "ok" if row.as_expected else "FAIL"


def _summary(rows: Sequence[RowResult]) -> str:
    wrong = sum(1 for row in rows if not row.as_expected)
    skipped = sum(1 for row in rows if row.observed is Status.SKIPPED)
    known = sum(1 for row in rows if row.known_open)
    good = len(rows) - wrong - skipped
    parts = [f"{good} of {len(rows)} rows as expected"]
    if known:
        parts.append(f"{known} of them known to be open")
    if skipped:
        parts.append(f"{skipped} skipped")
    if wrong:
        parts.append(f"{wrong} not as expected")
    return ", ".join(parts) + "."
