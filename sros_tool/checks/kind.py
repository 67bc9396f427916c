"""Findings and their kinds: a kind is data; a finding adds a place and a reason."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from enum import StrEnum
from typing import NamedTuple

from sros_tool.dds.decision.vendors import Vendor
from sros_tool.values import shows
from sros_tool.wording import first_few


class Severity(StrEnum):
    """Severity of a finding, as the word that options and reports write.

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
    """Why it matters."""
    source: str
    """Source of the rule, such as a section of a specification."""
    remedy: str
    """What to do about it."""
    group: str = ""
    vendors: tuple[Vendor, ...] = ()
    """The DDS vendors that the kind concerns; null for all."""
    prominent: bool = False

    @property
    def family(self) -> str:
        """The part of the id before the dot, such as ``enclave``."""
        return self.id.partition(".")[0]

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
        """Return a finding of this kind."""
        return Finding(self, subject, text, file, line or None, remedy, accepted, related)


class RelatedPlace(NamedTuple):
    """Another place in a file that a finding is about."""

    text: str
    """What is at this place."""
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
    """The template or setting that accepts the finding, or null."""
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
        """What to do about it."""
        return self.own_remedy or self.kind.remedy

    @property
    def place(self) -> str:
        """File and line, such as ``robot.xml:12``, or the subject for a finding without a file."""
        if not self.file:
            return self.subject
        return f"{self.file}:{self.line}" if self.line else self.file


def group_by_cause(findings: Sequence[Finding]) -> Iterator[tuple[Finding, ...]]:
    """Yield groups of findings: all that share a cause, or a single one without a cause."""
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
