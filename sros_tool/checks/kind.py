"""Findings and their kinds: a kind is data; a finding adds a place and a reason.

The module also lists all kinds, and selects the findings to report.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum
from fnmatch import fnmatchcase
from functools import cache
from importlib import import_module
from pkgutil import iter_modules
from typing import NamedTuple

from sros_tool.dds.decision.vendors import Vendor
from sros_tool.errors import UsageError
from sros_tool.values import shows
from sros_tool.wording import counted, first_few


class Severity(StrEnum):
    """The severity of a finding, as the word in options and reports.

    Severities, and their words, compare by weight: ``Severity.ERROR > "warning"``.
    """

    NOTE = "note"
    """Worth knowing; it may be intended."""
    WARNING = "warning"
    """Works today, but is a weakness or will break."""
    ERROR = "error"
    """Does not work, or is not protected although it should be."""

    @property
    def word(self) -> str:
        """The severity as a plain string."""
        return self.value

    @property
    def weight(self) -> int:
        """Rank of the severity for comparisons; a note has the lowest rank."""
        return _WEIGHTS[self]

    def __lt__(self, other: str) -> bool:
        """Return whether this severity is lower; raise `ValueError` for an unknown word."""
        return self.weight < Severity(other).weight

    def __le__(self, other: str) -> bool:
        """Return whether this severity is ``other`` or lower."""
        return self.weight <= Severity(other).weight

    def __gt__(self, other: str) -> bool:
        """Return whether this severity is higher than ``other``."""
        return self.weight > Severity(other).weight

    def __ge__(self, other: str) -> bool:
        """Return whether this severity is ``other`` or higher."""
        return self.weight >= Severity(other).weight


_WEIGHTS = {severity: weight for weight, severity in enumerate(Severity)}
NOTE, WARNING, ERROR = Severity.NOTE, Severity.WARNING, Severity.ERROR


@shows("id", "severity", "title", "why", "source", "remedy", "vendors", null_if_empty=("vendors",))
class FindingKind(NamedTuple):
    """A kind of finding.

    ``id`` never changes and has the form ``family.name``.  ``title`` is a clause; ``why``,
    ``source`` and ``remedy`` are sentences.  ``source`` is a section of a specification, a vendor
    and version, or ROS.  ``group`` is an id that several kinds share.  A ``prominent`` note is
    shown among the warnings, but counts as a note.
    """

    id: str
    """Stable id of the kind, such as ``enclave.certificate-expired``."""
    severity: Severity
    """Severity of the findings of this kind."""
    title: str
    """Clause that names the fault."""
    why: str
    """The reason that the fault matters."""
    source: str
    """Source of the rule, such as a section of a specification."""
    remedy: str
    """The steps that resolve the fault."""
    group: str = ""
    vendors: tuple[Vendor, ...] = ()
    """The DDS vendors that the kind concerns; null for all."""
    prominent: bool = False

    def found(
        self,
        subject: str,
        text: str,
        file: str = "",
        line: int | None = None,
        remedy: str = "",
        accepted: str = "",
        related: tuple[RelatedPlace, ...] = (),
    ) -> Finding:
        """Return a finding of this kind; the arguments are the fields of `Finding`."""
        return Finding(self, subject, text, file, line or None, remedy, accepted, related)


class RelatedPlace(NamedTuple):
    """Another place in a file that a finding is about."""

    text: str
    """A description of this place."""
    file: str
    """Path of the file."""
    line: int | None = None
    """Line in the file, from 1, or null."""

    def __str__(self) -> str:
        """Return text such as ``robot.xml:12``."""
        return f"{self.file}:{self.line}" if self.line else self.file


class Cause(NamedTuple):
    """The common cause of several findings of one severity, and the remedy for all of them.

    ``title`` is a clause, ``text`` and ``remedy`` are sentences.  ``number`` counts the findings
    with this cause: if only some of them are selected, they are shown one by one.  ``place``, if
    not empty, is shown instead of the place of the first finding.
    """

    title: str
    text: str
    remedy: str
    number: int
    place: str = ""


@shows(
    *("id", "severity", "subject", "file", "line", "text", "remedy", "source", "accepted"),
    "related",
    null_if_empty=("file", "accepted"),
)
class Finding(NamedTuple):
    """A finding of ``sros check``.

    ``own_remedy`` replaces the remedy of the kind unless it is empty.  An accepted finding counts
    as a note.  ``cause`` is set if other findings have the same cause.
    """

    kind: FindingKind
    subject: str
    """The enclave, variable or file that the finding is about."""
    text: str
    """Details of the fault, as a clause."""
    file: str = ""
    """Path of the file with the problem, or null."""
    line: int | None = None
    """Line in the file, from 1, or null."""
    own_remedy: str = ""
    accepted: str = ""
    """The template, setting or option that accepts the finding, or null."""
    related: tuple[RelatedPlace, ...] = ()
    """Other places that the finding is about, in the order to read them."""
    cause: Cause | None = None

    @property
    def id(self) -> str:
        """Id of the kind of finding, such as ``enclave.certificate-expired``."""
        return self.kind.id

    @property
    def source(self) -> str:
        """Source of the rule, such as a section of a specification."""
        return self.kind.source

    @property
    def severity(self) -> Severity:
        """Severity of the finding; an accepted finding is a note."""
        return NOTE if self.accepted else self.kind.severity

    @property
    def remedy(self) -> str:
        """The steps that resolve the fault."""
        return self.own_remedy or self.kind.remedy

    @property
    def place(self) -> str:
        """File and line, such as ``robot.xml:12``, or the subject for a finding without a file."""
        if not self.file:
            return self.subject
        return f"{self.file}:{self.line}" if self.line else self.file


def group_by_cause(findings: Sequence[Finding]) -> Iterator[tuple[Finding, ...]]:
    """Yield groups of findings that share a cause; a finding without a cause is a group of one."""
    groups: dict[Cause, list[Finding]] = {}
    for finding in findings:
        if finding.cause:
            groups.setdefault(finding.cause, []).append(finding)
    done: set[Cause] = set()
    for finding in findings:
        cause = finding.cause
        if not cause or len(groups[cause]) != cause.number:
            yield (finding,)
        elif cause not in done:
            done.add(cause)
            yield tuple(groups[cause])


def names_text(names: Sequence[str]) -> str:
    """Return text with the first names and the number of the other names."""
    return first_few(names, _NAMES_SHOWN)


_NAMES_SHOWN = 6


def kinds_by_id(*kinds: FindingKind) -> Mapping[str, FindingKind]:
    """Map each kind's id to the kind; raise for a duplicate id."""
    table = {kind.id: kind for kind in kinds}
    assert len(table) == len(kinds), "duplicate id of a kind of finding"
    return table


_MODULES = (
    *("policies", "requirements", "keystores.files", "keystores.authorities"),
    *("keystores.enclaves", "keystores.vendors", "keystores.documents", "keystores.topic_names"),
    *("keystores.issued", "keystores.trust", "keystores.zenoh_files", "zenoh", "upgrade"),
    *("environment", "runtime", "processes", "connections", "vulnerabilities", "review"),
)
"""The modules and packages of checks, in the order in which their kinds are listed."""


def _kinds_in(name: str) -> list[FindingKind]:
    """Return the kinds that a module, or the modules of a package, define, by id.

    They are constants, or values of dictionaries.
    """
    module = import_module(name)
    inner = (f"{name}.{part.name}" for part in iter_modules(getattr(module, "__path__", ())))
    values = [
        value for part in (module, *map(import_module, inner)) for value in vars(part).values()
    ]
    values += [part for value in values if isinstance(value, dict) for part in value.values()]
    return sorted(
        {value for value in values if isinstance(value, FindingKind)}, key=lambda kind: kind.id
    )


@cache
def all_kinds() -> Mapping[str, FindingKind]:
    """Return all kinds of findings by id; imports all modules of checks."""
    kinds = (kind for name in _MODULES for kind in _kinds_in(f"sros_tool.checks.{name}"))
    return kinds_by_id(*dict.fromkeys(kinds))


@dataclass(frozen=True, slots=True)
class FindingFilter:
    """The selection of findings to report.

    With ``vendors``, findings that are only about other vendors are left out. With a single vendor,
    findings about differences between vendors are left out, too.  ``include`` and ``exclude`` hold
    ids, ids of groups, or patterns with ``*`` and ``?``; an empty ``include`` means all.
    ``severity`` is the lowest severity that is shown; None shows warnings and prominent notes.

    A weakness that the keystore's template chose, such as the single CA of template sros2, is
    accepted: it counts as a note, and is summarized in one line if notes are not shown.  With
    ``strict`` it counts like any other finding.  A keystore made by ros2/sros2 has no template, so
    no finding is accepted.
    """

    include: tuple[str, ...] = ()
    exclude: tuple[str, ...] = ()
    severity: Severity | None = None
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
        if len(self.vendors) == 1 and kind.id == _DIFFERENCES_ID:
            return False
        return included and not any(_matches(kind, pattern) for pattern in self.exclude)

    def _shows(self, finding: Finding) -> bool:
        if self.severity is None:
            return _prominence(finding) >= WARNING
        return finding.severity >= self.severity

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
        return ChosenFindings(
            tuple(shown),
            tuple(accepted),
            len(hidden) - len(accepted),
            hides_warnings=any(finding.severity >= WARNING for finding in hidden),
        )


def _prominence(finding: Finding) -> Severity:
    return max(finding.severity, WARNING if finding.kind.prominent else NOTE)


def _finding_place(finding: Finding) -> tuple[str, int]:
    return finding.file, finding.line or 0


class ChosenFindings(NamedTuple):
    """The findings to show, and the findings that are left out.

    ``accepted`` are left out because the keystore accepts the weakness; ``hidden`` is the number of
    findings left out because their severity is too low; ``hides_warnings`` says whether some of
    these are no notes.
    """

    shown: tuple[Finding, ...]
    accepted: tuple[Finding, ...]
    hidden: int
    hides_warnings: bool = False

    def numbers(self) -> dict[str, int]:
        """The numbers of shown findings by severity, worst first."""
        severities = [finding.severity for finding in self.shown]
        return {str(level): severities.count(level) for level in (ERROR, WARNING, NOTE)}

    def summary(self) -> str:
        """Return a line with the numbers of findings, such as ``2 errors, 1 note``."""
        counts = [counted(number, word) for word, number in self.numbers().items() if number]
        hidden = self.hidden
        word = "finding" if self.hides_warnings else "note"
        if any(finding.severity is NOTE for finding in self.shown):
            word = f"more {word}"
        unseen = f" (not shown: {counted(hidden, word)}, --severity note)" if hidden else ""
        if not self.accepted:
            return f"{', '.join(counts) or 'nothing found'}{unseen}"
        number = counted(len(self.accepted), "weakness", "weaknesses")
        first = f"{', '.join(counts)}, and" if counts else "nothing found but"
        them = "it" if len(self.accepted) == 1 else "them"
        accepted = f"{number} that the template accepts (--strict counts {them})"
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
    """The findings with this cause, as positions in ``findings``, from 0."""


class FindingCounts(NamedTuple):
    """The numbers of findings."""

    error: int
    """Number of errors that are shown."""
    warning: int
    """Number of warnings that are shown."""
    note: int
    """Number of notes that are shown."""
    accepted: int
    """Number of findings that the keystore's template accepts; ``--strict`` reports them like
    other findings.
    """
    hidden: int
    """Number of findings that are not shown, because they are below ``--severity``."""


class ShownFindings(NamedTuple):
    """The findings of ``sros check``, and how many there are."""

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


_DIFFERENCES_ID = "portable.vendors-differ"
"""Id of the kind of finding about differences between vendors; it has no single vendor."""


def _matches(kind: FindingKind, pattern: str) -> bool:
    names = (kind.id, kind.group)
    return any(name and fnmatchcase(name, pattern) for name in names)
