"""The result of a demo: what ``sros demo --json`` prints, a table, and a summary in Markdown."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from datetime import datetime
from typing import Annotated, NamedTuple

from sros_tool.demo.backend import CYCLONE, RCLPY, ZENOH
from sros_tool.demo.casting import CastMember
from sros_tool.demo.scenarios.model import RowStatus
from sros_tool.demo.verdict import RowResult
from sros_tool.errors import NOT_DONE
from sros_tool.validity import iso
from sros_tool.values import Words, shows


class KeystoreSummary(NamedTuple):
    """What of a keystore was tried."""

    enclaves: int
    """Number of its enclaves."""
    elsewhere: int = 0
    """Number of enclaves whose key is elsewhere: they were not tried."""
    not_tried: tuple[str, ...] = ()
    """What would have to be tried for a proof, and was not: then the exit status is not 0."""


@shows("name", "title", "as_expected", "cast", "keystore", "rows", "cost")
@dataclass(frozen=True)
class ScenarioResult:
    """A scenario."""

    name: str
    """Its name."""
    title: str
    """Its title."""
    rows: tuple[RowResult, ...]
    """Its rows."""
    cast: tuple[CastMember, ...] = ()
    """With `--keystore`: the enclaves that played a part."""
    attacked: KeystoreSummary | None = None

    @property
    def wrong(self) -> tuple[RowResult, ...]:
        """The rows that are not as expected."""
        return tuple(row for row in self.rows if not row.as_expected)

    @property
    def keystore(self) -> KeystoreSummary | None:
        """With `--keystore`: what of it was tried."""
        return self.attacked and self.attacked._replace(not_tried=self.not_tried)

    @property
    def not_tried(self) -> tuple[str, ...]:
        """What would have to be tried to prove a user's keystore sound, and was not.

        The demo's own keystores are to show what works, and prove nothing of other ones.
        """
        if self.attacked is None:
            return ()
        return (*(row.name for row in self.rows if row.untried), *self.attacked.not_tried)

    @property
    def as_expected(self) -> bool:
        """Whether its rows are as expected."""
        return not self.wrong and not self.not_tried

    @property
    def cost(self) -> None:
        """Always null: `./dev bench --protection` measures what protection costs."""


@shows(
    *("backend", "dds", "why", "template", "topic", "own_network", "network_reason"),
    *("as_expected", "left_out", "scenarios", "rows"),
)
@dataclass(frozen=True)
class DemoResult:
    """The result."""

    backend: Annotated[str, Words((RCLPY, CYCLONE, ZENOH))]
    """What the nodes ran on."""
    dds: str
    """The DDS, or Zenoh, and its version."""
    why: str
    """Why this backend was chosen."""
    template: str
    """The template of the keystores."""
    topic: str
    """The topic."""
    own_network: bool
    """Whether it ran in a network namespace."""
    network_reason: str
    """If not, why."""
    scenarios: tuple[ScenarioResult, ...]
    """The scenarios."""
    left_out: int = 0
    """Number of rows that `--only` did not choose."""

    @property
    def rows(self) -> tuple[RowResult, ...]:
        """The rows of all scenarios."""
        return tuple(row for scenario in self.scenarios for row in scenario.rows)

    @property
    def as_expected(self) -> bool:
        """Whether every row is as expected, and a keystore of yours proved: the exit status is
        0.
        """
        return all(scenario.as_expected for scenario in self.scenarios)

    @property
    def exit_status(self) -> int:
        """0: as expected; 1: a row is not; `NOT_DONE`: a keystore could not be proved sound."""
        if any(scenario.wrong for scenario in self.scenarios):
            return 1
        return 0 if self.as_expected else NOT_DONE


class ListedScenario(NamedTuple):
    """A scenario."""

    name: str
    """Its name."""
    title: str
    """Its title."""
    rows: int
    """Number of its rows."""
    zenoh: bool
    """Whether it runs with `--backend zenoh`, and else on a DDS."""


class ScenarioList(NamedTuple):
    """The scenarios."""

    scenarios: Sequence[ListedScenario]
    """The scenarios."""


# ── as text ──────────────────────────────────────────────────────────────────────────────────────

_INDENT = " " * 6


def demo_table(result: DemoResult) -> str:
    """Return the result as a table, with the backend above and a summary line below."""
    network = (
        "a separate network namespace"
        if result.own_network
        else f"the network of this machine ({result.network_reason})"
    )
    lines = [
        f"{result.dds}, topic {result.topic}, in {network}",
        f"backend {result.backend}: {result.why}",
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
        f"Run {iso(now)} with `sros demo` on {result.dds}; expected statuses are those of"
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
        lines += ["## Other rows", "", *_rows_table(others)]
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
        f"| {member.part} | {member.enclave} | {', '.join(member.nodes)} | {member.why} |"
        for member in members
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


def _rows_table(rows: Sequence[RowResult]) -> list[str]:
    lines = ["| row | expected | observed | mechanism |", "| --- | --- | --- | --- |"]
    return [*lines, *(f"| {_cells(row)} | {row.mechanism} |" for row in rows), ""]


def _cells(row: RowResult) -> str:
    observed = str(row.observed) if row.as_expected else f"**{row.observed}**"
    if row.observed is RowStatus.SKIPPED:
        observed = f"skipped: {row.detail}"
    return f"{row.name} | {row.expected} | {observed}"
