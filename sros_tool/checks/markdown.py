"""Findings as Markdown, for a comment on a pull request or the summary of a job."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from sros_tool.checks.kind import Finding, by_cause
from sros_tool.checks.registry import ChosenFindings
from sros_tool.markdown import bounded, code, plain

_MOST = 20_000  # characters: a comment on GitHub has at most 65,536
_SIGNS = {"error": "🔴", "warning": "🟠", "note": "🔵"}


def findings_markdown(chosen: ChosenFindings, summary: str) -> str:
    """Return the findings under a heading; ``summary`` counts them in words."""
    rest = "which `sros check` shows"
    listed = bounded(map(_item, by_cause(chosen.shown)), _MOST, rest)
    return "\n\n".join(part for part in (f"### Findings: {plain(summary)}", listed) if part) + "\n"


def _item(findings: Sequence[Finding]) -> str:
    return "<br>".join(_lines(findings[0]) if len(findings) == 1 else _cause_lines(findings))


def _cause_lines(findings: Sequence[Finding]) -> Iterator[str]:
    """Yield the lines of findings of one cause."""
    first = findings[0]
    assert first.cause, "findings that are shown together have a cause"
    word, place = first.severity.word, first.cause.place or first.place
    ids = code(", ".join(dict.fromkeys(each.id for each in findings)))
    yield f"{_SIGNS[word]} **{word}** {code(place)} {plain(first.cause.title)} ({ids})"
    yield code(first.cause.text)
    yield code(first.cause.remedy)


def _lines(finding: Finding) -> Iterator[str]:
    word = finding.severity.word
    title = f"{plain(finding.kind.title)} ({code(finding.id)})"
    yield f"{_SIGNS[word]} **{word}** {code(finding.place)} {title}"
    subject = "" if finding.subject in (finding.file, finding.place) else f"{finding.subject}: "
    by = f" (accepted by the {finding.accepted})" if finding.accepted else ""
    yield code(f"{subject}{finding.text}{by}")
    yield from (code(f"{each}: {each.text}") for each in finding.related)
    yield code(finding.remedy)
