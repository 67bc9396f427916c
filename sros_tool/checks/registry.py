"""All kinds of findings, and the selection of findings to report."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from functools import cache
from importlib import import_module
from types import ModuleType
from typing import NamedTuple

from sros_tool.checks.kind import (
    ERROR,
    NOTE,
    WARNING,
    Finding,
    FindingKind,
    Severity,
    group_by_cause,
    kinds_by_id,
)
from sros_tool.errors import UsageError
from sros_tool.wording import counted

_MODULES = (
    *("policies", "requirements", "keystores.files", "keystores.authorities"),
    *("keystores.enclaves", "keystores.vendors", "keystores.documents", "keystores.topic_names"),
    *("keystores.issued", "keystores.trust", "keystores.zenoh_files", "zenoh", "upgrade"),
    *("environment", "runtime", "processes", "vulnerabilities"),
)
"""The modules of checks, in the order in which their kinds are listed."""


def _declared(module: ModuleType) -> Iterator[FindingKind]:
    """Yield the kinds that a module defines, as constants or as values of dictionaries."""
    for value in vars(module).values():
        for part in value.values() if isinstance(value, dict) else (value,):
            if isinstance(part, FindingKind):
                yield part


@cache
def all_kinds() -> Mapping[str, FindingKind]:
    """Return all kinds of findings by id; imports all modules of checks."""
    modules = [import_module(f"sros_tool.checks.{name}") for name in _MODULES]
    return kinds_by_id(
        *dict.fromkeys(
            kind
            for module in modules
            for kind in sorted(_declared(module), key=lambda kind: kind.id)
        )
    )


@dataclass(frozen=True, slots=True)
class FindingFilter:
    """The selection of findings to report.

    With ``vendors``, findings about only other vendors are left out, and with a single vendor, also
    findings about differences between vendors.  ``include`` and ``exclude`` hold ids, ids of
    groups, or patterns with ``*`` and ``?``; an empty ``include`` means all.  ``severity`` is the
    lowest severity that is shown.  A prominent note is shown where warnings are.

    A weakness that the keystore's template chose, such as the single CA of template sros2, is
    accepted: it counts as a note, and is summarised in one line if notes are not shown.  With
    ``strict`` it counts like any other finding.  A keystore made by ros2/sros2 has no template, so
    no finding is accepted.
    """

    include: tuple[str, ...] = ()
    exclude: tuple[str, ...] = ()
    severity: Severity = WARNING
    strict: bool = False
    vendors: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        for pattern in (*self.include, *self.exclude):
            if not any(_matches(kind, pattern) for kind in all_kinds().values()):
                raise UsageError(
                    f"no finding has the id {pattern!r}",
                    "",
                    "See `sros check --list`; patterns are written as 'policy.*'.",
                )

    def wants(self, kind: FindingKind) -> bool:
        """Return whether the filter selects this kind, whatever its severity."""
        included = not self.include or any(_matches(kind, pattern) for pattern in self.include)
        if self.vendors and kind.vendors and not {*self.vendors} & {*kind.vendors}:
            return False
        if len(self.vendors) == 1 and kind.id == _DIFFERENCES:
            return False
        return included and not any(_matches(kind, pattern) for pattern in self.exclude)

    def _shows(self, finding: Finding) -> bool:
        return _prominence(finding) >= self.severity

    def choose(self, findings: Iterable[Finding]) -> ChosenFindings:
        """Return the findings to show, worst first, and the accepted findings that are hidden."""
        wanted = [finding for finding in findings if self.wants(finding.kind)]
        if self.strict:
            wanted = [finding._replace(accepted="") for finding in wanted]
        shown = [finding for finding in wanted if self._shows(finding)]
        shown.sort(key=lambda finding: (-_prominence(finding).weight, *_finding_place(finding)))
        hidden = [finding for finding in wanted if not self._shows(finding)]
        accepted = [
            finding for finding in hidden if finding.accepted and finding.kind.severity > NOTE
        ]
        return ChosenFindings(tuple(shown), tuple(accepted), len(hidden) - len(accepted))


def _prominence(finding: Finding) -> Severity:
    return max(finding.severity, WARNING if finding.kind.prominent else NOTE)


def _finding_place(finding: Finding) -> tuple[str, int]:
    return finding.file, finding.line or 0


class ChosenFindings(NamedTuple):
    """The findings to show, and those that are left out.

    ``accepted`` are left out because the keystore accepts the weakness; ``hidden`` is the
    number of those left out because their severity is too low.
    """

    shown: tuple[Finding, ...]
    accepted: tuple[Finding, ...]
    hidden: int

    def numbers(self) -> dict[str, int]:
        """Return the number of shown findings by severity, worst first."""
        severities = [finding.severity for finding in self.shown]
        return {str(level): severities.count(level) for level in (ERROR, WARNING, NOTE)}

    def summary(self) -> str:
        """Return a line with the numbers of findings, such as ``2 errors, 1 note``."""
        counts = [counted(number, word) for word, number in self.numbers().items() if number]
        hidden = self.hidden
        note = "more note" if any(finding.severity is NOTE for finding in self.shown) else "note"
        unseen = f" (not shown: {counted(hidden, note)}, --severity note)" if hidden else ""
        if not self.accepted:
            return f"{', '.join(counts) or 'nothing found'}{unseen}"
        number = counted(len(self.accepted), "weakness", "weaknesses")
        first = f"{', '.join(counts)}, and" if counts else "nothing found but"
        accepted = f"{number} that the template accepts (--strict makes them count)"
        return f"{first} {accepted}{unseen}"

    def fails(self, level: Severity) -> bool:
        """Return whether a finding of at least this severity is shown."""
        return any(finding.severity >= level for finding in self.shown)


class SharedCause(NamedTuple):
    """The common cause of several findings."""

    title: str
    """Short title of the fault."""
    text: str
    """Details of the fault, and its effect."""
    remedy: str
    """How to resolve all these findings."""
    findings: Sequence[int]
    """Positions in ``findings`` of the findings with this cause, from 0."""


class FindingCounts(NamedTuple):
    """The numbers of findings."""

    error: int
    """Number of errors that are shown."""
    warning: int
    """Number of warnings that are shown."""
    note: int
    """Number of notes that are shown."""
    accepted: int
    """Number of findings that the keystore's template accepts; ``--strict`` counts them too."""
    hidden: int
    """Number of findings below ``--severity``."""


class ShownFindings(NamedTuple):
    """The findings of ``sros check``, and their numbers."""

    findings: Sequence[Finding]
    """The findings that are shown."""
    causes: Sequence[SharedCause]
    """Common causes of findings; the text output shows a cause in place of its findings."""
    accepted: Sequence[Finding]
    """Findings that the keystore's template accepts."""
    counts: FindingCounts
    """The numbers of findings."""


def shown_findings(chosen_findings: ChosenFindings) -> ShownFindings:
    """Return the findings in the form that ``--json`` prints."""
    place = {id(finding): index for index, finding in enumerate(chosen_findings.shown)}
    causes = [
        SharedCause(
            cause.title, cause.text, cause.remedy, [place[id(finding)] for finding in group]
        )
        for group in group_by_cause(chosen_findings.shown)
        if len(group) > 1 and (cause := group[0].cause)
    ]
    error, warning, note = chosen_findings.numbers().values()
    counts = FindingCounts(
        error, warning, note, len(chosen_findings.accepted), chosen_findings.hidden
    )
    return ShownFindings(chosen_findings.shown, causes, chosen_findings.accepted, counts)


class AllKinds(NamedTuple):
    """All kinds of findings that sros knows."""

    kinds: Sequence[FindingKind]
    """The kinds of findings, grouped by family."""


def select_kinds(selection: FindingFilter) -> Sequence[FindingKind]:
    """Return the selected kinds, in the order of `all_kinds`."""
    return [kind for kind in all_kinds().values() if selection.wants(kind)]


_DIFFERENCES = "portable.vendors-differ"
"""The kind of finding about differences between vendors, which concerns several vendors."""


def _matches(kind: FindingKind, pattern: str) -> bool:
    names = (kind.id, kind.group)
    return any(name and fnmatchcase(name, pattern) for name in names)
