"""Findings in SARIF 2.1.0 (OASIS), as code hosts and editors show them, and as Markdown."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any
from urllib.parse import quote

from sros_tool.checks.kind import Finding, FindingKind, by_cause
from sros_tool.checks.registry import ChosenFindings
from sros_tool.markdown import bounded, code, plain

_MOST = 20_000  # characters: a comment on GitHub has at most 65,536
_SIGNS = {"error": "🔴", "warning": "🟠", "note": "🔵"}


def findings_markdown(chosen: ChosenFindings) -> str:
    """Return the findings as Markdown, under a heading with their numbers."""
    rest = "which `sros check` shows"
    listed = bounded(map(_item, by_cause(chosen.shown)), _MOST, rest)
    title = f"### Findings: {plain(chosen.summary())}"
    return "\n\n".join(part for part in (title, listed) if part) + "\n"


def _item(findings: Sequence[Finding]) -> str:
    return "<br>".join(_lines(findings[0]) if len(findings) == 1 else _cause_lines(findings))


def _cause_lines(findings: Sequence[Finding]) -> Iterator[str]:
    """Yield the Markdown lines of findings that share a cause."""
    first = findings[0]
    assert first.cause, "findings that are shown together have a cause"
    word, place = first.severity.word, first.cause.place or first.place
    ids = code(", ".join(dict.fromkeys(finding.id for finding in findings)))
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
    yield from (code(f"{place}: {place.text}") for place in finding.related)
    yield code(finding.remedy)


_VERSION = "2.1.0"
_SCHEMA = "https://json.schemastore.org/sarif-2.1.0.json"
_BASE = "SRCROOT"


def sarif(
    findings: Sequence[Finding], kinds: Sequence[FindingKind], *, version: str, base: Path
) -> dict[str, Any]:
    """Return a SARIF log of one run, in which ``kinds`` are the rules.

    Paths are relative to the folder ``base``; a finding without a line is placed at line 1.
    Accepted findings are included, marked as suppressed.
    """
    rules = {kind.id: index for index, kind in enumerate(kinds)}
    driver = {
        "name": "sros",
        "version": version,
        "semanticVersion": version,
        "rules": [_rule(kind) for kind in kinds],
    }
    run = {
        "tool": {"driver": driver},
        "columnKind": "unicodeCodePoints",
        "originalUriBaseIds": {_BASE: {"uri": f"{base.absolute().as_uri()}/"}},
        "results": [_result(finding, rules[finding.id], base) for finding in findings],
    }
    return {"$schema": _SCHEMA, "version": _VERSION, "runs": [run]}


def _rule(kind: FindingKind) -> dict[str, Any]:
    return {
        "id": kind.id,
        "name": "".join(part.capitalize() for part in kind.id.replace(".", "-").split("-")),
        "shortDescription": {"text": kind.title},
        "fullDescription": {"text": kind.why},
        "help": {"text": f"{kind.remedy}\n\nSource: {kind.source}"},
        "defaultConfiguration": {"level": kind.severity.word},
    }


def _result(finding: Finding, rule: int, base: Path) -> dict[str, Any]:
    result: dict[str, Any] = {
        "ruleId": finding.id,
        "ruleIndex": rule,
        "level": finding.severity.word,
        "message": {"text": _plain(f"{finding.subject}: {finding.text}. {finding.remedy}")},
    }
    if finding.file:
        result["locations"] = [_location(finding.file, finding.line, base)]
    if finding.related:
        result["relatedLocations"] = [
            {
                "id": number,
                **_location(place.file, place.line, base),
                "message": {"text": _plain(place.text)},
            }
            for number, place in enumerate(finding.related)
        ]
    if finding.accepted:
        result["suppressions"] = [
            {"kind": "external", "status": "accepted", "justification": finding.accepted}
        ]
    return result


def _location(file: str, line: int | None, base: Path) -> dict[str, Any]:
    return {
        "physicalLocation": {
            "artifactLocation": {
                "uri": quote(os.fsencode(_relative(file, base))),
                "uriBaseId": _BASE,
            },
            "region": {"startLine": line or 1},
        }
    }


def _plain(text: str) -> str:
    """Escape embedded links (SARIF 2.1.0, 3.11.6), as others may have chosen a name in the text.

    Only text with the form of a link is escaped, because many viewers show the escapes.
    """
    return re.sub(r"([\[\]\\])", r"\\\1", text) if "](" in text else text


def _relative(file: str, base: Path) -> str:
    """Return the path of ``file`` as seen from the folder ``base``, with "/" between its parts."""
    path, start = (base / file).absolute(), base.absolute()
    common = start
    ups = 0
    while not path.is_relative_to(common):
        common = common.parent
        ups += 1
    return "/".join(("..",) * ups + path.relative_to(common).parts)
