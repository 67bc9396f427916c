"""The result of the demo as text: a table for a terminal, and a summary in Markdown."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from datetime import datetime

from sros_tool.demo.casting import CastMember
from sros_tool.demo.result import DemoResult, ScenarioResult
from sros_tool.demo.scenarios.model import RowStatus
from sros_tool.demo.verdict import RowResult
from sros_tool.validity import iso

_INDENT = " " * 6


def demo_table(result: DemoResult) -> str:
    """Return the result as a table, with the backend above and a summary line below."""
    network = (
        "a separate network namespace"
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
        lines += _cast_lines(scenario.cast)
        lines += _scenario(scenario)
    return "\n".join([*lines, "", _summary(result)])


def _cast_lines(members: Sequence[CastMember]) -> list[str]:
    """Return lines with the enclave of each part of a user's keystore."""
    width = max((len(member.part) for member in members), default=0)
    lines = [
        f"{_INDENT}{member.part:<{width}}  {member.enclave}"
        + (f" as node {', '.join(member.nodes)}" if member.nodes else "")
        + (f": {member.why}" if member.why else "")
        for member in members
    ]
    return ["enclave for each part:", *lines, ""] if lines else []


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
        if row.known_open or row.open_here:
            lines.append(f"{_INDENT}{_why_open(row)}")
    return lines


def _why_open(row: RowResult) -> str:
    why = f"{row.open_because}; to do: {row.remedy}" if row.open_because else ""
    return "; ".join(filter(None, (why, "accepted with --accept-open" if row.accepted else "")))


def _line(mark: str, cells: Sequence[str], widths: Sequence[int]) -> str:
    padded = (cell.ljust(width) for cell, width in zip(cells, widths, strict=True))
    return f"{mark:<4}  {'  '.join(padded)}".rstrip()


def _mark(row: RowResult) -> str:
    if row.observed is RowStatus.SKIPPED:
        return "skip"
    if row.open_here:
        return "OPEN"
    if row.known_open:
        return "open"
    return "ok" if row.as_expected else "FAIL"


def _summary(result: DemoResult) -> str:
    """Return the last sentence: what was as expected, and in it all that was not tried."""
    rows = result.rows
    opened = sum(1 for row in rows if row.open_here)
    wrong = sum(1 for row in rows if not row.as_expected)
    known = sum(1 for row in rows if row.known_open)
    good = len(rows) - wrong - sum(1 for row in rows if row.observed is RowStatus.SKIPPED)
    parts = [f"{good} of {len(rows)} rows as expected"]
    if known:
        parts.append(f"{known} of them known to be open")
    if opened:
        parts.append(f"{opened} open in this keystore (accept each with --accept-open NAME)")
    if wrong > opened:
        parts.append(f"{wrong - opened} not as expected")
    return ", ".join([*parts, *_left_out(result)]) + "."


def _left_out(result: DemoResult) -> Iterator[str]:
    """Yield clauses on what was not tried, also on enclaves of the user's keystore."""
    skipped = [row for row in result.rows if row.observed is RowStatus.SKIPPED]
    if others := sum(1 for row in skipped if row.applies):
        yield f"{others} skipped"
    if strange := len(skipped) - others:
        yield f"{strange} that {'does' if strange == 1 else 'do'} not apply to this keystore"
    if result.left_out:
        yield f"{result.left_out} left out with --only"
    for scenario in result.scenarios:
        if scenario.keystore is None:
            continue
        used = {member.enclave for member in scenario.cast}
        yield f"{len(used)} of {scenario.keystore.enclaves} enclaves in a part"
        if scenario.keystore.elsewhere:
            yield f"{scenario.keystore.elsewhere} with their key elsewhere"
        if scenario.not_tried:
            names = "; ".join(scenario.not_tried)
            yield f"not proved for want of what was not tried ({names})"


def summary_page(result: DemoResult, now: datetime) -> str:
    """Return a summary for a reviewer, in Markdown; ``now`` is the time of the demo."""
    attacks = [row for row in result.rows if row.attack and not row.removed]
    others = [row for row in result.rows if not row.attack]
    wrong = [row for row in result.rows if not row.as_expected]
    lines = [
        "# Security demo: expected and observed",
        "",
        f"Run {iso(now)} with `sros demo` on {result.backend.dds}; expected statuses are those of"
        f" the keystore template `{result.template}`: **{_verdict(result, wrong)}**",
        "",
    ]
    for scenario in result.scenarios:
        lines += _summary_cast(scenario.cast)
    if wrong:
        lines += ["## Not as expected", ""]
        lines += [
            f"- **{row.name}**: open in this keystore: {row.open_because}; to do: {row.remedy}."
            if row.open_here
            else f"- **{row.name}**: expected {row.expected}, observed {row.observed}. {row.detail}"
            for row in wrong
        ]
        lines.append("")
    if attacks:
        lines += _attacks(attacks, [row for row in result.rows if row.removed])
    if others:
        lines += ["## Other rows", "", *_table(others)]
    return "\n".join(lines).rstrip() + "\n"


def _summary_cast(members: Sequence[CastMember]) -> list[str]:
    if not members:
        return []
    lines = [
        "## Enclave for each part",
        "",
        "| part | enclave | ROS nodes | why |",
        "| --- | --- | --- | --- |",
    ]
    lines += [
        f"| {each.part} | {each.enclave} | {', '.join(each.nodes)} | {each.why} |"
        for each in members
    ]
    return [*lines, ""]


def _verdict(result: DemoResult, wrong: Sequence[RowResult]) -> str:
    known = sum(1 for row in result.rows if row.known_open)
    good = "as expected" if result.as_expected else "as expected where it was tried"
    parts = [f"{len(wrong)} of {len(result.rows)} rows not as expected" if wrong else good]
    if known:
        parts.append(f"{known} attacks that are known to succeed")
    return ", ".join([*parts, *_left_out(result)]) + "."


def _attacks(attacks: Sequence[RowResult], removed: Sequence[RowResult]) -> list[str]:
    closed = [row for row in attacks if not row.open_because]
    open_ = [row for row in attacks if row.open_because]
    lines = [
        "## Attacks",
        "",
        "A failed attack proves something only if the same attack succeeds without the defence: the"
        " last column shows that result.",
        "",
        "| attack | expected | observed | mechanism | without the defence |",
        "| --- | --- | --- | --- | --- |",
    ]
    for row in closed:
        twins = "; ".join(_unique(_twin(each) for each in removed if each.attack == row.attack))
        lines.append(f"| {_cells(row)} | {row.mechanism} | {twins} |")
    if open_:
        lines += ["", "## Attacks known to succeed, and remedies", ""]
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
    lines = ["| row | expected | observed | mechanism |", "| --- | --- | --- | --- |"]
    return [*lines, *(f"| {_cells(row)} | {row.mechanism} |" for row in rows), ""]


def _cells(row: RowResult) -> str:
    observed = str(row.observed) if row.as_expected else f"**{row.observed}**"
    if row.observed is RowStatus.SKIPPED:
        observed = f"skipped: {row.detail}"
    return f"{row.name} | {row.expected} | {observed}"
