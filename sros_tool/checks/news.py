"""What changes among findings that are made again and again: each change is reported once."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from datetime import datetime
from enum import StrEnum
from typing import Any

from sros_tool.checks.kind import Finding
from sros_tool.checks.process_files import PROCESS_NOT_SEEN
from sros_tool.validity import iso


class ChangeKind(StrEnum):
    """What became of a finding."""

    NEW = "new"
    CHANGED = "changed"
    OVER = "over"


@dataclass(frozen=True, slots=True)
class FindingChange:
    """A finding that is new, says something else than before, or is over."""

    kind: ChangeKind
    time: datetime
    finding: Finding

    def as_json(self) -> dict[str, Any]:
        """Return the JSON value that `sros check runtime --watch --json` prints on a line."""
        return {
            "time": iso(self.time),
            "change": self.kind.value,
            "finding": self.finding.as_json(),
        }

    def __str__(self) -> str:
        """Return a line of text."""
        of = self.finding
        head = f"{iso(self.time)} {self.kind}: {of.subject}: {of.severity.word}: {of.kind.title}"
        return f"{head} [{of.id}]: {of.text}"


class FindingNews:
    """The findings of the last time, to be compared with those of the next one."""

    def __init__(self) -> None:
        self._before: dict[tuple[str, str], Finding] = {}

    def changes(self, findings: Iterable[Finding], now: datetime) -> Iterator[FindingChange]:
        """Yield what changed since the last time; at first all findings are new.

        How many processes could not be looked at changes all the time, and is reported once.
        """
        found: dict[tuple[str, str], Finding] = {}
        for each in findings:
            found.setdefault((each.id, each.subject), each)
        before, self._before = self._before, found
        for key, each in before.items():
            if key not in found:
                yield FindingChange(ChangeKind.OVER, now, each)
        for key, each in found.items():
            if key not in before:
                yield FindingChange(ChangeKind.NEW, now, each)
            elif each.text != before[key].text and each.kind is not PROCESS_NOT_SEEN:
                yield FindingChange(ChangeKind.CHANGED, now, each)
