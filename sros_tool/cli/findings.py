"""Findings as text for people: one by one, or as one paragraph if they have one cause."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterable, Sequence
from shlex import quote
from typing import TYPE_CHECKING

from sros_tool.terminal import Coloured, echo, visible_line

if TYPE_CHECKING:
    from sros_tool.checks.kind import Finding


def echo_findings(findings: Sequence[Finding], *, err: bool = False) -> None:
    """Print one finding, or findings of one cause; the severity is in colour on a terminal."""
    first = findings[0]
    if first.cause and len(findings) > 1:
        place = first.cause.place or first.place
        ids = ", ".join(dict.fromkeys(each.id for each in findings))
        lines = [f"{place}: {first.severity.word}: {first.cause.title}"]
        for text in (f"[{ids}]", first.cause.text, first.cause.remedy):
            lines += _wrapped(text, "    ")
    else:
        lines = _finding_lines(first)
    word = first.severity.word
    place, _, title = lines[0].partition(f": {word}: ")
    echo(f"{place}: ", Coloured(word), f": {title}", err=err)
    for line in lines[1:]:
        echo(line, err=err)


def _finding_lines(finding: Finding) -> list[str]:
    """Return a finding as lines: place and title, reason, remedy, and related places."""
    head = f"{finding.place}: {finding.severity.word}: {finding.kind.title} [{finding.id}]"
    subject = "" if finding.subject in (finding.file, finding.place) else f"{finding.subject}: "
    by = f" (accepted by the {finding.accepted})" if finding.accepted else ""
    related = [f"      {each}: {each.text}" for each in finding.related]
    return [head, f"    {subject}{finding.text}{by}", *related, f"    {finding.remedy}"]


def _wrapped(text: str, indent: str) -> list[str]:
    """Return lines of at most 80 characters; what is to be copied stays on one, however long."""
    from textwrap import wrap

    whole = re.sub(r"`[^`]+`|<\w[^>]*/>", lambda m: m[0].replace(" ", "\0"), visible_line(text))
    lines = wrap(
        whole,
        80,
        initial_indent=indent,
        subsequent_indent=indent,
        break_long_words=False,
        break_on_hyphens=False,
    )
    return [each.replace("\0", " ") for each in lines]


def print_signed(groups: Sequence[Sequence[Finding]], files: Iterable[str]) -> None:
    """Print on stderr what is wrong with the policies, in ``files``, of signed permissions."""
    from sros_tool.checks.kind import Severity

    for group in groups[:_MOST_SHOWN]:
        echo_findings(group, err=True)
    counted = Counter(each.severity for group in groups[_MOST_SHOWN:] for each in group)
    more = [
        f"{counted[each]} {each.word}{'s' * (counted[each] > 1)}"
        for each in sorted(Severity, reverse=True)
        if counted[each]
    ]
    if more:
        command = f"sros check {' '.join(map(quote, dict.fromkeys(files)))}"
        echo(f"and {', '.join(more)}: see `{command}`", err=True)


_MOST_SHOWN = 3
