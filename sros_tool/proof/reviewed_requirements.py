"""The requirements of a review: what HEAD breaks of them, and what it drops or weakens.

They are decided for one subject at a time: the reviewed policies, or a keystore.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cache, cached_property, partial
from itertools import chain
from pathlib import Path
from typing import NamedTuple

from sros_tool.checks.kind import Finding, FindingKind
from sros_tool.checks.requirements import (
    ALLOWED_BY_NAME,
    HOLDS_ALONE,
    UNKNOWN_ENCLAVE,
    VACUOUS,
    VIOLATED,
)
from sros_tool.errors import DocumentError, SrosError
from sros_tool.fleet.robots import Fleet
from sros_tool.names import is_expression
from sros_tool.policy.model import DENY, Policy, policy_in_namespace
from sros_tool.policy.patterns import Names
from sros_tool.policy.remapping import Remapping
from sros_tool.policy.rights import Right, placed_rights
from sros_tool.proof.escapes import (
    MOST_NAMESPACES,
    RobotMoves,
    access_by_name_findings,
    lost_restriction_findings,
    namespaces_in,
    namespaces_of_patterns,
    renamed_requirement_findings,
    rights_with_new_peers,
    unanswered_requirement_findings,
)
from sros_tool.proof.findings import Decisions, decide_all, decided_findings, requirement_findings
from sros_tool.proof.requirements import (
    AtMost,
    DroppedRequirement,
    NotBoth,
    Requirement,
    dropped_findings,
    dropped_requirements,
    enclaves_allowed_unmoved,
    names_of,
    read_all_requirements,
    renamed_names,
    unmoved_enclaves,
)
from sros_tool.proof.sources import AccessSource
from sros_tool.proof.system import System
from sros_tool.wording import first_few

ONLY_THE_CHANGE = "whether the change breaks them"
_LASTING_NOTES = (HOLDS_ALONE, ALLOWED_BY_NAME, UNKNOWN_ENCLAVE)
"""Notes that each review of a policy would repeat."""


@dataclass(frozen=True)
class ReviewedSubject:
    """The policies or a keystore of a review, in BASE and in HEAD.

    ``system`` has the worlds of HEAD, and ``base_fleet`` are the robots of BASE. ``read_base`` and
    ``read_head`` read the access of both sides; ``read_base`` is None if there is nothing to
    compare with.
    """

    system: System
    base_fleet: Fleet | None
    read_base: Callable[[], AccessSource] | None
    read_head: Callable[[], AccessSource]

    def policies(self) -> tuple[AccessSource, AccessSource] | None:
        """Return the access of compared policies in BASE and HEAD; None for a keystore, too.

        Raises:
            SrosError: a policy cannot be read.
        """
        if self.system.is_keystore or not self.read_base:
            return None
        return self.read_base(), self.read_head()

    @cached_property
    def rights(self) -> tuple[Collection[Right], Collection[Right]]:
        """The rights of BASE and HEAD; none if a side cannot be read."""
        if self.read_base:
            with suppress(SrosError, OSError):  # the comparison reports the error
                return self.read_base().rights, self.read_head().rights
        return frozenset(), frozenset()

    def earlier_robots(self, moves: RobotMoves | None = None) -> Fleet | None:
        """Return the fleet of BASE without the robots that HEAD lacks, after ``moves``.

        If one of the two fleets is missing, the result is the other one, or None.

        So no requirement counts as dropped because its robot left the fleet. A group keeps its
        robots if all of them left.
        """
        now = self.system.fleet()
        before = moves.fleet if moves else self.base_fleet
        if before is None or now is None:
            return before or now
        gone = before.robots.keys() - now.robots.keys()
        emptied = [members for members in before.groups.values() if gone.issuperset(members)]
        gone = gone.difference(*emptied) if gone != before.robots.keys() else set()
        robots = (robot for robot in before.robots.values() if robot.name not in gone)
        return Fleet.of(robots, before.groups)


@dataclass(frozen=True, slots=True)
class RequirementFiles:
    """The requirements files of a commit, and the requirements in the files that can be read.

    Both are mapped from the path in the repository.
    """

    files: Mapping[str, Path]
    read: Mapping[str, Sequence[Requirement]]

    @property
    def requirements(self) -> list[Requirement]:
        """All requirements that could be read, in order."""
        return [*chain.from_iterable(self.read.values())]


@dataclass(frozen=True)
class ReviewedRequirements:
    """The requirements of BASE and HEAD for one subject.

    They were read for ``namespaces`` and ``remaps``.  With ``has_fleet``, the robots of the
    policies are known.  ``system_of`` returns the worlds of a policy as the review assumes them.
    """

    subject: ReviewedSubject
    base: RequirementFiles
    head: RequirementFiles
    namespaces: Sequence[str]
    remaps: Sequence[Remapping]
    has_fleet: bool
    system_of: Callable[[Policy], System]

    @cached_property
    def decided(self) -> Decisions:
        """The decisions on the requirements of HEAD."""
        return decide_all(self.head.requirements, self.subject.system)

    @property
    def is_relative(self) -> bool:
        """Whether a requirement of HEAD has a name that moves with the namespace."""
        return any(requirement.is_relative for requirement in self.head.requirements)

    # ── in the namespaces of the review ────────────────────────────────────────────────────

    def findings_here(self) -> list[Finding]:
        """Return the findings on the requirements of HEAD in the namespaces of the review."""
        system, (rights, _) = self.subject.system, self.subject.rights
        findings = decided_findings(self.decided, system, rights, self.base.requirements)
        if any(finding.kind in _LASTING_NOTES for finding in findings):
            known = self._known_notes()
            findings = [of for of in findings if (of.kind, of.text) not in known]
        return findings

    def _known_notes(self) -> Collection[tuple[FindingKind, str]]:
        """Return kinds and texts of BASE's notes that each review would repeat.

        The change has not caused them.
        """
        with suppress(SrosError, OSError):  # the comparison reports the error
            sides = None if self.has_fleet else self.subject.policies()
            if sides:
                before = replace(self.system_of(sides[0].policy), file=self.subject.system.file)
                findings = requirement_findings(self.base.requirements, before)
                return {(of.kind, of.text) for of in findings if of.kind in _LASTING_NOTES}
        return ()

    # ── in other namespaces ────────────────────────────────────────────────────────────────

    def _package(self) -> tuple[AccessSource, AccessSource] | None:
        """Return both sides of policies that users may put into a namespace of their own.

        None if the review knows the namespaces or the robots, or compares no policies.
        """
        return None if self.namespaces or self.has_fleet else self.subject.policies()

    @cached_property
    def _namespaces(self) -> _Namespaces:
        package = self._package()
        if not package:
            return _Namespaces([], 0)
        return _namespaces_to_try(*package, self.head.requirements)

    def decided_elsewhere(self) -> str:
        """Return a clause on what is decided in other namespaces; "" for nothing."""
        known = len(self._namespaces.ordered)
        if known <= MOST_NAMESPACES:
            return ONLY_THE_CHANGE if known else ""
        return (
            f"{ONLY_THE_CHANGE} in {MOST_NAMESPACES} of {known} namespaces (first those in which a "
            "changed name can match a requirement)"
        )

    def check_tried(self) -> None:
        """Raise an error if the change may break a requirement in a namespace that is not tried.

        Raises:
            DocumentError: a changed name can match a requirement there.
        """
        if not self.is_relative:
            return
        untried = self._namespaces.ordered[MOST_NAMESPACES : self._namespaces.count_matching]
        if untried:
            raise DocumentError(
                f"requirements were not decided in {first_few(untried, 3)}: the review tries only "
                f"{MOST_NAMESPACES} namespaces",
                "A name of an added or removed right can match a name of a requirement there.",
                "Change the names of fewer namespaces in one commit, or name the namespaces of the "
                "robots with --namespace.",
            )

    def findings_elsewhere(self) -> Iterator[Finding]:
        """Yield findings on requirements that fail in another namespace only because of the change.

        A requirement fails if it is broken, or if no right is left for any name in it.  It does not
        fail because of the change if BASE has the same failure under names that the change renames.

        Enclaves that the requirement allows by a name with ``//`` do not move with the namespace.
        If other lists name further enclaves with ``//``, the requirement has to hold both if these
        move and if they do not: no name that the change adds elsewhere hides a failure.
        """
        package = self._package() if self.is_relative else None
        if not package:
            return
        tried = self._namespaces.ordered[:MOST_NAMESPACES]
        all_unmoved = unmoved_enclaves(self.head.requirements)
        failing = {violation.requirement for violation in self.decided.violations}
        failing |= {requirement for requirement, _ in self.decided.vacuous}
        # In the namespaces of its own patterns, a requirement is for other enclaves than in /.
        left = {
            at: [*tried, *namespaces_of_patterns(here)[1:]]
            for at, here in enumerate(self.head.requirements)
            if here.is_relative and here not in failing
        }
        for name in dict.fromkeys([*tried, *chain(*left.values())]):
            namespace = self._in_namespace(name, *package)
            for at in [at for at in left if name in left[at]]:
                own = enclaves_allowed_unmoved(self.head.requirements[at])
                ways = (
                    [*namespace.findings(namespace.required[at], unmoved)]
                    for unmoved in dict.fromkeys((own, all_unmoved))
                )
                for finding in next(filter(None, ways), ()):
                    left.pop(at, None)
                    place = f"in namespace {name}, which the review tries"
                    yield finding._replace(text=f"{place}: {finding.text}")

    def _in_namespace(self, name: str, base: AccessSource, head: AccessSource) -> _Namespace:
        def systems(source: AccessSource) -> Callable[[frozenset[str]], System]:
            @cache
            def system(unmoved: frozenset[str]) -> System:
                moved = policy_in_namespace(source.policy, name, unmoved)
                return replace(self.system_of(moved), is_package=True)

            return system

        earlier, required = (
            read_all_requirements(side.files.values(), namespaces=(name,), remaps=self.remaps)
            for side in (self.base, self.head)
        )
        return _Namespace(earlier, required, systems(base), systems(head))

    # ── dropped by HEAD ────────────────────────────────────────────────────────────────────

    def dropped(self) -> tuple[int, list[Finding]]:
        """Return how many requirements of BASE HEAD drops or weakens, and the findings on them.

        Raises:
            SrosError: there are too many wildcards to decide a requirement.
        """
        moves = self._robot_moves()
        earlier, required = self._following(moves), self.head.requirements
        system, rights = self.subject.system, self.subject.rights
        weakened = [
            *unanswered_requirement_findings(earlier, required, *rights),
            *renamed_requirement_findings(earlier, required, *rights),
        ]
        sides = None
        with suppress(SrosError, OSError):  # the comparison reports the error
            sides = self.subject.policies()
        if sides:
            weakened += lost_restriction_findings(earlier, required, *sides, moves)
            weakened += access_by_name_findings(earlier, required, *sides, system)
        renamed = rights_with_new_peers(*rights)
        findings = dropped_findings(earlier, required, "", moves.clauses, renamed)
        dropped = [gone.requirement for gone in dropped_requirements(earlier, required)]
        broken = [of for of in requirement_findings(dropped, system) if of.kind is VIOLATED]
        return len(dropped) + len(weakened), [*findings, *weakened, *broken]

    def _robot_moves(self) -> RobotMoves:
        with suppress(SrosError, OSError):  # the step on requirements reports the error
            return RobotMoves.between(self.subject.base_fleet, self.subject.system.fleet())
        return RobotMoves()

    def _following(self, moves: RobotMoves) -> list[Requirement]:
        """Return the requirements of BASE, with new names for robots that move."""
        if not moves.namespaces:
            return self.base.requirements
        moved = read_all_requirements(
            [self.base.files[path] for path in self.base.read],
            partial(self.subject.earlier_robots, moves),
            self.namespaces,
            self.remaps,
        )
        required, system = self.head.requirements, self.subject.system
        return moves.follow(self.base.requirements, moved, required, system)


class _Namespaces(NamedTuple):
    """Namespaces in which requirements that hold in ``/`` may be broken.

    In the first ``count_matching``, a changed name can match a name of a requirement.
    """

    ordered: Sequence[str]
    count_matching: int


def _namespaces_to_try(
    before: AccessSource, after: AccessSource, requirements: Iterable[Requirement]
) -> _Namespaces:
    """Return namespaces in which requirements that hold in ``/`` may be broken.

    The first namespace is in no right, and stands for all other such namespaces. It is followed by
    the namespaces in names that do not move with the namespace, and by namespaces that wildcards in
    these names match.  Namespaces in which such a name of an added or removed right can match a
    requirement come first, then other namespaces of added and removed rights.
    """
    placed, placed_after = (
        {
            (of.right, of.written.startswith(("/", "*")))
            for of in chain.from_iterable(map(placed_rights, side.enclaves.values()))
        }
        for side in (before, after)
    )
    # Also a name that only becomes absolute or relative is another name in a namespace.
    difference = {right for right, _ in placed ^ placed_after}
    changed = {right.name for right in difference}
    fixed = {right.name for right, is_fixed in placed | placed_after if is_fixed}
    moving = {right.name for right, is_fixed in placed | placed_after if not is_fixed}
    ordinary = "/any_namespace"
    while any(ordinary in right.name for right in (*before.rights, *after.rights)):
        ordinary += "_"
    relative = [requirement for requirement in requirements if requirement.is_relative]
    required = {name for requirement in relative for name in names_of(requirement)}
    # A changed name that moves may break these only together with names that do not move, and a
    # removed DENY any requirement.
    are_joined = any(isinstance(requirement, AtMost | NotBoth) for requirement in relative)
    are_joined |= any(right.qualifier is DENY for right in difference)
    by_changed_name = Names(sorted(fixed if are_joined and changed & moving else fixed & changed))
    names_in_order = sorted(fixed, key=lambda name: (name not in changed, name))
    ordered = [*dict.fromkeys(namespaces_in(names_in_order))]
    matching = [
        namespace
        for namespace in ordered
        if any(
            by_changed_name.overlaps(namespace + name) for name in required if name.startswith("/")
        )
    ]
    return _Namespaces([*dict.fromkeys([ordinary, *matching, *ordered])], 1 + len(matching))


class _Failure(NamedTuple):
    """The failure of a requirement: uses that break it, or a text on why it protects nothing."""

    uses: tuple[tuple[str, str, str, str], ...] = ()
    """Enclaves, rights, names, and the wildcards that allow them ("" without wildcard)."""
    others: frozenset[str] = frozenset()
    """Further enclaves that break the requirement."""
    worlds: tuple[str, ...] = ()
    missing: str = ""
    """An enclave that has to have rights, and does not exist."""
    idle: bool = False
    """Whether the enclave that has to have rights cannot start."""
    text: str = ""

    @property
    def enclaves(self) -> frozenset[str]:
        """All enclaves that break the requirement."""
        return self.others.union(enclave for enclave, *_ in self.uses)

    def with_new_names(self, names: Mapping[tuple[str, str], str]) -> _Failure:
        """Return the same failure under new names, which are given by right and old name."""

        def renamed(right: str, name: str) -> str:
            for (of_right, old), new in names.items():
                begin = old.removesuffix("*")
                if right == of_right and (name == old or (begin != old and name.startswith(begin))):
                    return new.removesuffix("*") + name.removeprefix(begin)
            return name

        uses = tuple(
            (enclave, right, renamed(right, name), renamed(right, by))
            for enclave, right, name, by in self.uses
        )
        new_names = {old: new for (_, old), new in names.items()}
        text = _ABSOLUTE_NAME.sub(lambda match: new_names.get(match[0], match[0]), self.text)
        return self._replace(uses=uses, text=text)


_ABSOLUTE_NAME = re.compile(r"(?<!\S)(?<!enclave )/[^\s,;:()]*")


def _failures(decided: Decisions, findings: Sequence[Finding]) -> dict[_Failure, Finding]:
    """Return the findings which say that a requirement does not hold, or protects nothing."""
    failures = {
        _Failure(text=finding.text): finding for finding in findings if finding.kind is VACUOUS
    }
    broken = (finding for finding in findings if finding.kind is VIOLATED)
    for violation, finding in zip(decided.violations, broken, strict=True):
        # Of a single name, a wildcard gives no more than the name does.
        names = [*names_of(violation.requirement)]
        is_single = len(names) == 1 and not is_expression(names[0])
        steps = ((step.use, "" if is_single else step.stated_form()[3]) for step in violation.steps)
        uses = tuple((use.enclave, use.right, use.name, by) for use, by in steps)
        others = {use.enclave for uses in violation.witness.others for use in uses}
        why = violation.worlds, violation.missing, violation.idle
        failures[_Failure(uses, frozenset(others), *why)] = finding
    return failures


@dataclass(frozen=True)
class _Namespace:
    """The requirements and worlds of BASE and HEAD in another namespace.

    ``before`` and ``after`` return the worlds, in which the given enclaves do not move.
    """

    earlier: Sequence[Requirement]
    required: Sequence[Requirement]
    before: Callable[[frozenset[str]], System]
    after: Callable[[frozenset[str]], System]

    def findings(self, requirement: Requirement, unmoved: frozenset[str]) -> Iterator[Finding]:
        """Yield the findings on a requirement that are new in HEAD."""
        broken = self._failures_after(requirement, unmoved)
        if not broken:
            return
        known = {
            *self._failures_before(requirement, unmoved),
            *self._dropped_failures(requirement, unmoved),
        }
        if known.issuperset(broken):
            return
        if breaking := frozenset[str]().union(*(failure.enclaves for failure in known)):
            broken = self._failures_after(requirement, unmoved, breaking)
        yield from (finding for failure, finding in broken.items() if failure not in known)

    @cached_property
    def _dropped(self) -> Sequence[DroppedRequirement]:
        return dropped_requirements(self.earlier, self.required)

    def _failures_before(
        self, requirement: Requirement, unmoved: frozenset[str]
    ) -> dict[_Failure, Finding]:
        before = self.before(unmoved)
        decided = decide_all([requirement], before)
        return _failures(decided, decided_findings(decided, before))

    def _failures_after(
        self,
        requirement: Requirement,
        unmoved: frozenset[str],
        breaking: frozenset[str] = frozenset(),
    ) -> dict[_Failure, Finding]:
        """Return the failures of a requirement in HEAD.

        A name that no right states counts only if a right of BASE states it; for `Nobody`, only if
        the requirements of BASE forbid it already.  The place of a finding is a right of an enclave
        that is not in ``breaking``, if such an enclave breaks the requirement.
        """
        after = self.after(unmoved)
        decided = decide_all([requirement], after, breaking)
        rights = self.before(unmoved).rights if decided.unnamed else ()
        return _failures(decided, decided_findings(decided, after, rights, self.earlier))

    def _dropped_failures(
        self, requirement: Requirement, unmoved: frozenset[str]
    ) -> Iterator[_Failure]:
        """Yield the failures in BASE of dropped requirements that have other names than this one.

        The requirements are otherwise the same.  The failures have the names of ``requirement``.
        """
        for dropped in self._dropped:
            if names := renamed_names(dropped.requirement, requirement):
                failures = self._failures_before(dropped.requirement, unmoved)
                yield from (failure.with_new_names(names) for failure in failures)
