"""What changes among findings that are made again and again: each change is reported once."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from datetime import datetime
from enum import StrEnum

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
    """A change among the findings about processes; each is an object on a line of its own."""

    time: datetime
    """When it was seen, in UTC."""
    change: ChangeKind
    """What became of the finding: it is new, says something else, or is over."""
    finding: Finding
    """The finding."""

    def __str__(self) -> str:
        """Return a line of text."""
        of = self.finding
        head = f"{iso(self.time)} {self.change}: {of.subject}: {of.severity.word}: {of.kind.title}"
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
                yield FindingChange(now, ChangeKind.OVER, each)
        for key, each in found.items():
            if key not in before:
                yield FindingChange(now, ChangeKind.NEW, each)
            elif each.text != before[key].text and each.kind is not PROCESS_NOT_SEEN:
                yield FindingChange(now, ChangeKind.CHANGED, each)
