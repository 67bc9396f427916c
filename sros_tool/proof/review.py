"""Review a change in git: findings in HEAD, and access that HEAD adds to BASE.

The author of the change cannot influence the review.  It compares the content of two commits, not
of a work tree (`sros_tool.proof.repository`, `sros_tool.proof.commit_files`).  The result names
what was not compared.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import cache, cached_property, partial
from itertools import chain
from pathlib import Path
from shlex import quote
from typing import Annotated, NamedTuple, TypeVar

from sros_tool.checks.keystores.issued import (
    LESS_PROTECTED,
    NOT_IN_EXPORT,
    NOT_IN_KEYSTORE,
    NOT_IN_POLICY,
    STALE,
)
from sros_tool.checks.keystores.opened import Circumstances
from sros_tool.checks.kind import WARNING, ChosenFindings, Finding, FindingFilter
from sros_tool.checks.policies.portability import is_mended_by
from sros_tool.checks.requirements import DROPPED
from sros_tool.checks.targets import path_findings, policy_findings
from sros_tool.errors import DocumentError, SrosError
from sros_tool.faults import Fault
from sros_tool.fleet.changes import FleetChange, delivery_place, fleet_changes
from sros_tool.fleet.expansion import FleetPolicy, fleet_with_enclaves, read_policy_for
from sros_tool.fleet.fleet_file import ROBOT_VARIABLE, read_connection_settings, read_fleet
from sros_tool.fleet.robots import Fleet, Robot, robot_of
from sros_tool.folders import Folder
from sros_tool.keystore.expiry import ExpiryCheck, due_enclaves
from sros_tool.keystore.fleet import load_fleet
from sros_tool.keystore.layout import FLEET, KEY_FILE, SETTINGS, is_keystore
from sros_tool.keystore.reader import OpenedKeystore
from sros_tool.keystore.rights import (
    RightsSource,
    SourcesDifference,
    compare_sources,
    without_enclaves_of_sros,
)
from sros_tool.keystore.template import Template, load_template, read_template, template_names
from sros_tool.policy.document import read_policy
from sros_tool.policy.model import Policy
from sros_tool.proof.commit_files import CommitFiles
from sros_tool.proof.escapes import MOST_NAMESPACES
from sros_tool.proof.findings import (
    common_namespaces,
    left_out_robot_findings,
    unused_remapping_findings,
)
from sros_tool.proof.growth import Growth, compare_access
from sros_tool.proof.requirements import FleetSource, Requirement, read_requirements
from sros_tool.proof.review_request import ReviewRequest
from sros_tool.proof.reviewed_requirements import (
    ONLY_THE_CHANGE,
    RequirementFiles,
    ReviewedRequirements,
    ReviewedSubject,
)
from sros_tool.proof.sources import AccessSource, load_policies, load_side
from sros_tool.proof.system import load_system, policy_system
from sros_tool.proof.unreviewed import UnreviewedFiles
from sros_tool.values import Words
from sros_tool.wording import enumerated

Value = TypeVar("Value")
_HEAD, _BASE = "HEAD", "BASE"
_FILE_MISSING = f"enclave.{Fault.FILE_MISSING.id}"
_BOTH_NAMES_REMEDY = "give --policy the folder that has the file under its old and its new name"
_UNSIGNED_POLICY_IDS = tuple(
    kind.id for kind in (STALE, LESS_PROTECTED, NOT_IN_POLICY, NOT_IN_KEYSTORE, NOT_IN_EXPORT)
)
"""Ids of findings which say that a keystore is not signed for the policies."""
_OK, _FOUND, _UNDECIDED = 0, 1, 2


@dataclass(frozen=True, slots=True)
class AccessChange:
    """Access that HEAD allows and BASE does not, and denials that HEAD drops or narrows."""

    before: AccessSource
    after: AccessSource
    growth: Growth


@dataclass(frozen=True, slots=True)
class RightsChange:
    """The differences between the rights of all reviewed policies in HEAD and in BASE."""

    before: RightsSource
    after: RightsSource
    compared: SourcesDifference


@dataclass(frozen=True, slots=True)
class DroppedRequirements:
    """Findings on requirements of BASE that HEAD drops or weakens, and their number.

    Each such requirement has a finding, and a second finding if HEAD breaks the requirement.
    """

    count: int
    chosen: ChosenFindings


@dataclass(frozen=True, slots=True)
class StepFindings:
    """The findings of a step as lines: pairs of a sentence and a name.

    The step fails for ``failing`` findings, and only shows the findings in ``shown_only``.
    """

    failing: tuple[tuple[str, str], ...]
    shown_only: tuple[tuple[str, str], ...] = ()

    @property
    def lines(self) -> tuple[tuple[str, str], ...]:
        """The findings that make the step fail, followed by the findings that are only shown."""
        return self.failing + self.shown_only


Content = (
    ChosenFindings
    | AccessChange
    | RightsChange
    | DroppedRequirements
    | ExpiryCheck
    | StepFindings
    | SrosError
)


@dataclass(frozen=True, slots=True)
class ReviewStep:
    """One step of a review, with its exit status and result.

    ``kind`` is "files", "policy", "requirements", "requirements-before", "new-access", "rights",
    "keystore", "signed" (whether the keystore is signed for the reviewed policies) or "expiry".
    ``subject`` is the path that the step is about.  An error as result is the reason why the step
    could not be decided. ``allowed`` says that the step found something that the request or the
    step's kind allows, so that the status is 0. ``fleet`` are the robots of the examined policy or
    keystore.
    """

    kind: str
    subject: str
    status: int
    content: Content
    allowed: bool = False
    fleet: Fleet | None = None


@dataclass(frozen=True, slots=True)
class Review:
    """The steps of a review, and clauses on what was not reviewed.

    ``place`` is a clause with the namespaces for which requirements were decided.

    ``base`` and ``head`` are full ids of commits; ``base`` is "" if nothing was compared. The files
    were read in ``head_folder`` and ``base_folder``, whose paths `with_shown_paths` removes.
    """

    base: str
    head: str
    steps: tuple[ReviewStep, ...]
    left_out: tuple[str, ...]
    place: str
    head_folder: Path
    base_folder: Path

    @property
    def status(self) -> int:
        """The worst exit status of all steps."""
        return max((step.status for step in self.steps), default=_OK)

    def with_shown_paths(self, text: str) -> str:
        """Return a text with file paths relative to the top of the repository."""
        base = f"git:{self.base[:12]}:"
        return text.replace(f"{self.head_folder}/", "").replace(f"{self.base_folder}/", base)

    def shown_finding(self, finding: Finding) -> Finding:
        """Return a finding with file paths relative to the top of the repository."""
        related = tuple(
            place._replace(
                text=self.with_shown_paths(place.text), file=self.with_shown_paths(place.file)
            )
            for place in finding.related
        )
        return finding._replace(
            subject=self.with_shown_paths(finding.subject),
            text=self.with_shown_paths(finding.text),
            file=self.with_shown_paths(finding.file),
            own_remedy=self.with_shown_paths(finding.own_remedy),
            related=related,
        )


_STEP_KINDS = (
    *("files", "policy", "requirements", "requirements-before", "new-access", "rights"),
    *("keystore", "signed", "expiry"),
)


class StepResult(NamedTuple):
    """The result of one step of a review."""

    step: Annotated[str, Words(_STEP_KINDS)]
    """Name of the step; ``requirements-before`` reports requirements that the change drops,
    ``signed`` whether a keystore is signed for the reviewed policies.
    """
    subject: str | None
    """Path that the step checks; null for the whole commit."""
    status: int
    """Exit status of the step: 0, 1 or 2, as for the review."""
    allowed: bool
    """Whether the step found something that an option allows, or that is always allowed
    (``signed``, and private keys that were there before); the status is then 0.
    """
    result: str
    """The result as a sentence, or the reason why the step could not be decided."""
    lines: Sequence[str]
    """What the step found, one text for each: new access, a dropped requirement, a changed right
    or a finding.
    """


class ReviewResult(NamedTuple):
    """The review of a change of policies, requirements and keystores in git."""

    base: str | None
    """Full id of the base commit; null without a comparison."""
    head: str
    """The full id of the commit that was reviewed."""
    status: int
    """Exit status: 0 if nothing fails the review, 1 for findings that fail it, 2 if a step could
    not be decided.
    """
    steps: Sequence[StepResult]
    """The steps of the review."""
    findings: Sequence[Finding]
    """Findings on the reviewed commit."""
    left_out: Sequence[str]
    """Parts that were not reviewed, as clauses."""


def review(request: ReviewRequest, folder: Path) -> Review:
    """Return the review of a change; files of both commits are written below ``folder``.

    Args:
        request: the commits and paths to review.
        folder: a new folder, outside of the repository, that nobody else can open.

    Raises:
        SrosError: a commit cannot be read.
    """
    repository = request.repository
    head = CommitFiles(repository, _HEAD, request.head, folder / _HEAD)
    base = CommitFiles(repository, _BASE, request.base, folder / _BASE) if request.base else None
    with Folder(folder) as private:
        for name in (_HEAD, _BASE):
            private.mkdir(name, 0o700)
    steps = _Review(request, head, base, UnreviewedFiles(request, head, base))
    steps_done = tuple(steps.all())
    return Review(
        request.base,
        request.head,
        steps_done,
        tuple(dict.fromkeys(steps.left_out())),
        steps.place(),
        folder / _HEAD,
        folder / _BASE,
    )


@dataclass(frozen=True)
class _Policies:
    """The policy files of BASE or HEAD, and the fleet of this commit (None without a fleet)."""

    commit: str
    files: Sequence[Path]
    fleet: Fleet | None
    unread: SrosError | OSError | None = None
    """Why a policy of the commit was not read; None if all were."""

    def check_read(self) -> None:
        """Raise the error of a policy that was not read, if none was read."""
        if self.unread and not self.files:
            raise self.unread

    def read(self) -> tuple[Policy, ...]:
        """Return the policies for the robots of the fleet.

        Raises:
            SrosError: a policy cannot be read.
        """
        return tuple(read_policy_for(file, self.fleet) for file in self.files)

    @cached_property
    def access(self) -> AccessSource:
        """The access that the policies give; reading it may raise an error."""
        self.check_read()
        return load_policies(self.files, self.commit, self.fleet)

    def robots_by_enclave(self) -> dict[str, Robot | None]:
        """Map enclaves to the robot that gets their keys, or to None if they are of no robot."""
        fleet = self.fleet
        if fleet is None:
            return {enclave.path: None for policy in self.read() for enclave in policy.enclaves}
        policies = [FleetPolicy(read_policy(of, placeholders=True), fleet) for of in self.files]
        return {
            path: policy.stated_enclave(path)[1] or robot_of(fleet, path)
            for policy in policies
            for path in policy
        }


@dataclass(slots=True)
class _Review:
    request: ReviewRequest
    head: CommitFiles
    base: CommitFiles | None
    unreviewed: UnreviewedFiles
    robots: dict[str, Fleet | None] = field(default_factory=dict)
    """The fleet of the policy or keystore that a step examines, by subject of the step."""
    unread_policy: SrosError | OSError | None = None
    """Why a policy of the request was not read from HEAD; None if all were read."""
    is_relative: bool = False
    """Whether a requirement has a name that moves with the namespace."""
    namespaces_to_add: set[str] = field(default_factory=set)
    """Namespaces in which the policies or keystores have names of the requirements."""
    decided_elsewhere: str = ONLY_THE_CHANGE
    """What the review decided about requirements in other namespaces; "" for nothing."""

    def _allows(self, kind: str) -> bool:
        """Return whether findings of a kind of step are allowed, by the request or always."""
        if kind == "requirements-before":
            return self.request.allow_dropped_requirements
        # Authors of a policy seldom have the CA keys, so the keystore may be signed later.
        # Names that are new in another namespace fail the step on new access.
        return kind == "signed" or (
            kind in ("new-access", "files") and self.request.allow_new_access
        )

    def all(self) -> Iterator[ReviewStep]:
        asked = self.request
        if asked.base == asked.head:
            refusal = DocumentError(
                "both commits are the same, so that nothing would be compared",
                "",
                "Check out the commit of the change (on GitHub, pull_request_target does not), or "
                "ask for no comparison: --base none.",
            )
            yield ReviewStep("files", "", _UNDECIDED, refusal)
        head_fleet = yield from self._fleet(self.head)
        base_fleet = yield from self._fleet(self.base)
        files = yield from self._head_policies(head_fleet)
        head = _Policies(_HEAD, files, head_fleet, self.unread_policy)
        base = _Policies(_BASE, (), base_fleet)
        with suppress(SrosError, OSError):  # the comparison reports the error
            base = replace(base, files=self._base_policies(base_fleet))
        named = " ".join(asked.policies)
        complete = head.unread is None
        if head_fleet:
            self.robots[named] = fleet_with_enclaves(head_fleet, head.files)
        yield from self._step_result(
            "policy",
            named,
            partial(self._policy_findings, head),
            is_wanted=bool(head.files),
            complete=complete,
        )
        keystores = yield from self._keystores()
        for path, keystore in keystores.items():
            with suppress(SrosError):  # faults of the fleet file are findings
                self.robots[path] = load_fleet(OpenedKeystore(keystore))
        base_keystores: dict[str, Path] = {}
        if self.base:
            base_keystores = yield from _read_each("new-access", keystores, self.base.write_tree)
        subjects: dict[str, Callable[[], ReviewedSubject]] = {
            path: partial(self._keystore_subject, path, folder, base_keystores.get(path))
            for path, folder in keystores.items()
        }
        if asked.policies:
            subjects[named] = partial(self._policies_subject, base, head)
        yield from self._requirement_steps(subjects, head_fleet)
        if self.base:
            yield from self._step_result(
                "new-access",
                named,
                partial(self._access_change, base, head),
                is_wanted=bool(asked.policies),
                complete=complete,
            )
            change = partial(self._rights_change, base, head)
            yield from self._step_result("rights", named, change, is_wanted=bool(base.files))
        for path, keystore in keystores.items():
            yield from self._keystore_steps(path, keystore, base_keystores.get(path), head)
        # Not allowed by --new-access: its user has read the commit, not a checkout, which may
        # differ.
        yield from self._step_result(
            "files",
            "",
            lambda: _found_lines(self.unreviewed.converted_by_git()),
            can_be_allowed=False,
        )
        yield from self._step_result("keystore", " ".join(asked.keystores), self._keys_step)
        if self.base:
            yield from self._step_result("files", "", partial(self._unreviewed_step, head))
            if head_fleet:
                moved = partial(self._fleet_step, base, head, head_fleet)
                yield from self._step_result("new-access", asked.fleet, moved)
        for error in self.head.refused + (self.base.refused if self.base else []):
            yield ReviewStep("files", "", _UNDECIDED, error)

    def _step_result(
        self,
        kind: str,
        subject: str,
        decide: Callable[[], tuple[int, Content] | None],
        *,
        is_wanted: bool = True,
        complete: bool = True,
        can_be_allowed: bool = True,
    ) -> Iterator[ReviewStep]:
        """Run ``decide`` and yield a step with its result or its error, if the step ``is_wanted``.

        Without ``complete`` (a file could not be read), no step says that nothing was found.
        """
        if not is_wanted:
            return
        try:
            decided = decide()
        except SrosError as error:
            decided = _UNDECIDED, error
        except OSError as error:  # such as a file name that is too long for this system
            decided = _UNDECIDED, DocumentError(f"'{error.filename}': {error.strerror}")
        if decided and (complete or decided[0] != _OK):
            status, content = decided
            only_named = isinstance(content, StepFindings) and not content.failing
            is_allowed = can_be_allowed and (self._allows(kind) or only_named)
            allowed = status == _FOUND and is_allowed
            yield ReviewStep(
                kind,
                subject,
                _OK if allowed else status,
                content,
                allowed,
                self.robots.get(subject),
            )

    # ── files ──────────────────────────────────────────────────────────────────────────────

    def _fleet(self, side: CommitFiles | None) -> Generator[ReviewStep, None, Fleet | None]:
        """Return the fleet of BASE or HEAD, or None; yield a step if it cannot be read."""
        if not self.request.fleet or not side:
            return None
        files = yield from self._files(side, "files", [self.request.fleet])
        fleets = yield from _read_each("files", files, lambda path: read_fleet(files[path]))
        return fleets.get(self.request.fleet)

    def _files(
        self, side: CommitFiles, kind: str, paths: Iterable[str]
    ) -> Generator[ReviewStep, None, dict[str, Path]]:
        """Map ``paths`` to files of BASE or HEAD; yield a step for each file that HEAD lacks."""

        def file_at(path: str) -> Path | None:
            file = side.write_file(path)
            if not file and side is self.head:
                raise self._missing_file_error(path)
            return file

        return (yield from _read_each(kind, paths, file_at))

    def _base_policies(self, fleet: Fleet | None) -> list[Path]:
        """Return the policy files that BASE has; none without BASE.

        Raises:
            SrosError: a file cannot be read.
        """
        if not self.base:
            return []
        write = partial(self.base.write_policies, placeholders=fleet is not None)
        return [*chain.from_iterable(map(write, self.request.policies))]

    def _head_policies(self, fleet: Fleet | None) -> Generator[ReviewStep, None, list[Path]]:
        """Return the policy files of HEAD; yield a step for each policy that cannot be read."""

        def files_at(path: str) -> Sequence[Path]:
            try:
                files = self.head.write_policies(path, placeholders=fleet is not None)
                if not files:
                    advice = f" If it is renamed, {_BOTH_NAMES_REMEDY}."
                    raise self._missing_file_error(path, advice)
            except (SrosError, OSError) as error:
                self.unread_policy = error
                raise
            return files

        read = yield from _read_each("policy", self.request.policies, files_at)
        return list(dict.fromkeys(file for files in read.values() for file in files))

    def _keystores(self) -> Generator[ReviewStep, None, dict[str, Path]]:
        """Map paths to keystores of HEAD; yield a step for each unreadable keystore."""

        def folder_at(path: str) -> Path:
            folder = self.head.write_tree(path)
            if not folder:
                raise self._missing_file_error(path)
            if not is_keystore(folder):
                raise DocumentError(f"'{path}' is not a keystore", "It has no enclaves.")
            return folder

        return (yield from _read_each("keystore", self.request.keystores, folder_at))

    def _missing_file_error(self, path: str, advice: str = "") -> DocumentError:
        """Return the error for a file that HEAD lacks, with a hint at the new path after a move."""
        entry = self.base.entry(path) if self.base else None
        became = ""
        if entry:
            became = "The change deletes it."
            for name, tree_entry in self.head.entries(unlike=self.base):
                if tree_entry.id == entry.id:
                    became = f"The change renames it to '{name}'."
        elif below := self._same_name_below(path):
            became = f"Paths begin at the top of the repository: perhaps '{below}' is meant."
        return DocumentError(
            f"'{path}' is not in the commit",
            became,
            f"Review the files that the robot uses.{advice if entry else ''}",
        )

    def _same_name_below(self, path: str) -> str:
        """Return a file or folder of HEAD whose path ends with ``path``, or ""."""
        with suppress(SrosError):  # a hint, without which the error is right, too
            for name, _ in self.head.entries():
                before, found, _ = f"{name}/".partition(f"/{path.strip('/')}/")
                if found:
                    return f"{before}{found}".rstrip("/")
        return ""

    def _fleet_step(
        self, base: _Policies, head: _Policies, fleet: Fleet
    ) -> tuple[int, Content] | None:
        """Return status and findings on changes of the fleet file; None without any.

        The rights do not show such changes: `fleet_changes`, keys that another robot gets, and
        other settings for the connections of Ansible.
        """
        known_paths = fleet_with_enclaves(base.fleet, base.files).enclaves if base.fleet else ()
        changes = [*fleet_changes(base.fleet, fleet, known_paths)]
        had, have = base.robots_by_enclave(), head.robots_by_enclave()
        changes += _moved_keys(had, have, base.fleet, fleet)
        if base.fleet and self.base:
            file = self.request.fleet
            before, after = (
                read_connection_settings(e.folder / file) for e in (self.base, self.head)
            )
            for where in sorted({*before, *after}, key=_variables_before_hosts):
                if before.get(where) != (value := after.get(where)):
                    is_robot = where.endswith(f".{ROBOT_VARIABLE}")
                    if is_robot and value is None and before[where] not in fleet.robots:
                        continue  # the robot is gone
                    text = "is gone" if value is None else f"is {value}"
                    effect = "this can change which keys Ansible delivers, and how"
                    changes.append(FleetChange(where, f"{text}: {effect}"))
        return _fleet_findings(changes)

    def _keys_step(self) -> tuple[int, Content] | None:
        """Return status and findings on private keys in HEAD; None without any.

        Options that allow new access do not apply: everybody who reads the repository has these
        keys.
        """
        facts = StepFindings(*map(tuple, self.unreviewed.private_keys()))
        return (_FOUND, facts) if facts.lines else None

    def _unreviewed_step(self, reviewed: _Policies) -> tuple[int, Content] | None:
        """Return status and findings on changed files that are not reviewed, or None."""
        files, all_read = self.unreviewed, reviewed.unread is None
        to_review = files.changes_to_review(reviewed.files, reviewed.fleet, all_read=all_read)
        return _found_lines(to_review, files.changes_only_named())

    def left_out(self) -> Iterator[str]:
        """Yield clauses on the parts that were not reviewed."""
        asked = self.request
        if not asked.policies:
            yield "policies: none is named"
        if not asked.requirements:
            yield "requirements: none are named"
        if self.is_relative:
            yield from self._undecided_in_namespaces()
        if not self.base:
            yield "nothing is compared with an earlier commit, as the options say"
        if asked.allow_new_access:
            yield "new access does not fail the review, as the options say"
        if asked.allow_dropped_requirements:
            yield "dropped requirements do not fail the review, as the options say"
        yield from self.unreviewed.clauses()

    def _undecided_in_namespaces(self) -> Iterator[str]:
        """Yield a clause if requirements may fail in a namespace, though no change breaks them."""
        subject = "requirements with relative names in namespaces other than"
        if self.request.namespaces:
            yield f"{subject} {enumerated(self.request.namespaces)}"
            return
        options = [f"--namespace {quote(name)}" for name in sorted(self.namespaces_to_add)]
        if (
            not options
            and self.decided_elsewhere == ONLY_THE_CHANGE
            and not any(map(self.unreviewed.is_changed, self.request.requirements))
        ):
            return
        add = f" (add {' '.join(options[:MOST_NAMESPACES])})" if options else ""
        decided = self.decided_elsewhere and f": sros only decided {self.decided_elsewhere}"
        yield f"{subject} /{add}{decided}"

    # ── policies ───────────────────────────────────────────────────────────────────────────

    def _circumstances(self, fleet: Fleet | None = None) -> Circumstances:
        return Circumstances(self.request.at, self.request.zone, fleet=fleet)

    def _policy_findings(self, head: _Policies) -> tuple[int, Content]:
        found = policy_findings(head.files, self._circumstances(head.fleet))
        template = self._template()
        return _chosen(finding for finding in found if not is_mended_by(template, finding))

    def _policies_subject(self, base: _Policies, head: _Policies) -> ReviewedSubject:
        """Return the policies for the steps on requirements.

        Raises:
            SrosError: the policies of HEAD cannot be read.
        """
        head.check_read()
        system = load_system(head.files, self._circumstances(head.fleet), self._template())
        read_base = (lambda: base.access) if base.files else None
        return ReviewedSubject(system, base.fleet, read_base, lambda: head.access)

    def _access_change(self, base: _Policies, head: _Policies) -> tuple[int, Content]:
        """Return the exit status for the access that the policies gain, and this access.

        If BASE has none of the policies, they are new, and the content says only this.
        """
        after = head.access
        if base.files:
            return self._compared_access(base.access, after)
        self._base_policies(base.fleet)  # raises the error of a file that was not read
        text = f"is new, so that all of its access is new; if it is renamed, {_BOTH_NAMES_REMEDY}"
        return _FOUND, StepFindings(((text, " ".join(self.request.policies)),))

    @staticmethod
    def _compared_access(before: AccessSource, after: AccessSource) -> tuple[int, Content]:
        growth = compare_access(before, after)
        status = _FOUND if growth or growth.dropped_denials else _OK
        return status, AccessChange(before, after, growth)

    @staticmethod
    def _rights_change(base: _Policies, head: _Policies) -> tuple[int, Content] | None:
        """Return the changed rights with the exit status, or None if no right changed."""
        first, second = base.access.as_rights(), head.access.as_rights()
        first, second = (
            without_enclaves_of_sros(first, second),
            without_enclaves_of_sros(second, first),
        )
        compared = compare_sources(first, second)
        return (_OK, RightsChange(first, second, compared)) if compared else None

    # ── requirements ───────────────────────────────────────────────────────────────────────

    def _requirement_steps(
        self, subjects: Mapping[str, Callable[[], ReviewedSubject]], fleet: Fleet | None
    ) -> Iterator[ReviewStep]:
        """Yield the steps on the requirements of each subject; ``fleet`` is that of HEAD."""
        paths = self.request.requirements
        if not paths:
            return
        base_files = dict[str, Path]()
        files = yield from self._files(self.head, "requirements", paths)
        if self.base:
            base_files = yield from self._files(self.base, "requirements", paths)
        if not subjects:
            yield from self._read_requirements(files, lambda: fleet)
        for name, load in subjects.items():
            try:
                subject = load()
            except (SrosError, OSError) as error:
                yield _undecided_step("requirements", name, error)
                continue
            head = yield from self._read_requirements(files, subject.system.fleet)
            base = yield from self._read_requirements(base_files, subject.earlier_robots)
            required = ReviewedRequirements(
                subject,
                base,
                head,
                self.request.namespaces,
                self.request.remaps,
                has_fleet=bool(self.request.fleet),
                system_of=lambda of: policy_system(of, self._circumstances(), self._template()),
            )
            yield from self._steps_of_subject(name, required)

    def _steps_of_subject(self, name: str, required: ReviewedRequirements) -> Iterator[ReviewStep]:
        """Yield the steps on what HEAD breaks, and on what it drops."""
        system, files, read = required.subject.system, required.head.files, required.head.read
        self.is_relative |= required.is_relative
        self.namespaces_to_add |= common_namespaces(required.head.requirements, system.rights)
        yield from self._step_result(
            "requirements",
            name,
            partial(self._decided_requirements, required),
            is_wanted=bool(read),
            complete=len(read) == len(self.request.requirements)
            and (system.is_keystore or self.unread_policy is None),
        )
        dropped = partial(self._dropped_step, required)
        all_read = len(read) == len(files)
        yield from self._step_result("requirements-before", name, dropped, is_wanted=all_read)

    def _read_requirements(
        self, files: Mapping[str, Path], fleet: FleetSource
    ) -> Generator[ReviewStep, None, RequirementFiles]:
        """Return the requirements in files; yield a step for each unreadable file."""

        def requirements_at(path: str) -> Sequence[Requirement]:
            asked = self.request
            return read_requirements(files[path], fleet, asked.namespaces, asked.remaps)

        read = yield from _read_each("requirements", files, requirements_at)
        return RequirementFiles(files, read)

    def _decided_requirements(self, required: ReviewedRequirements) -> tuple[int, ChosenFindings]:
        """Return the exit status and the findings on requirements, also in other namespaces."""
        asked, system = self.request, required.subject.system
        findings = required.findings_here()
        findings += left_out_robot_findings(system, asked.namespaces)
        if required.is_relative and self.decided_elsewhere:
            self.decided_elsewhere = required.decided_elsewhere()
        findings += required.findings_elsewhere()
        findings += unused_remapping_findings(
            required.head.files.values(), system, asked.namespaces, asked.remaps
        )
        # In several namespaces, a requirement with absolute names is decided several times.
        status, chosen = _chosen(dict.fromkeys(findings))
        if status == _OK:
            required.check_tried()
        return status, chosen

    def _dropped_step(self, required: ReviewedRequirements) -> tuple[int, Content] | None:
        """Return status and findings on requirements that HEAD drops or weakens, or None."""
        count, findings = required.dropped()
        if not count:
            return None
        chosen = FindingFilter().choose(map(self._placed_in_head, findings))
        return _FOUND, DroppedRequirements(count, chosen)

    def _placed_in_head(self, finding: Finding) -> Finding:
        """Return a finding; if it has no place, with the place in HEAD of what was required."""
        if finding.file or finding.kind is not DROPPED:
            return finding
        assert self.base
        (required_before,) = finding.related
        path = Path(required_before.file).relative_to(self.base.folder)
        return finding._replace(file=str(self.head.folder / path))

    def place(self) -> str:
        """Return a clause with the namespaces of the requirements; "" without namespaces."""
        namespaces = self.request.namespaces
        return f"in {enumerated(namespaces)}" if namespaces else ""

    def _template(self) -> Template | None:
        """Return the template that the request names, as it is in HEAD; None without a template.

        Raises:
            DocumentError: HEAD lacks the template, or the template is malformed.
        """
        choice = self.request.template
        if not choice or choice in template_names():
            return load_template(choice) if choice else None
        if file := self.head.write_file(choice):
            return read_template(file)
        raise self._missing_file_error(choice)

    # ── keystores ──────────────────────────────────────────────────────────────────────────

    def _keystore_fleet(self, path: str) -> Fleet | None:
        """Return the fleet of a keystore in BASE; None for a keystore without fleet."""
        file = self.base.write_file(f"{path}/{FLEET}") if self.base else None
        return read_fleet(file) if file else None

    def _keystore_subject(self, path: str, folder: Path, before: Path | None) -> ReviewedSubject:
        """Return a keystore for the steps on requirements; ``before`` is the keystore of BASE.

        A whole keystore in BASE is no export in HEAD: the enclaves that it lacks are removed.

        Raises:
            SrosError: the keystore cannot be read.
        """
        opened = {folder: OpenedKeystore(folder, lacks_keys=True)}
        system = load_system(folder, replace(self._circumstances(), opened=opened))
        was_whole = before is not None and OpenedKeystore(before).has_all_enclaves
        return ReviewedSubject(
            replace(system, is_export=system.is_export and not was_whole),
            self._keystore_fleet(path),
            partial(load_side, before) if before else None,
            partial(load_side, folder),
        )

    def _keystore_steps(
        self, path: str, folder: Path, before: Path | None, policies: _Policies
    ) -> Iterator[ReviewStep]:
        has_new_settings = not before or self.unreviewed.is_changed(f"{path}/{SETTINGS}")
        stated: tuple[Policy, ...] = ()
        with suppress(SrosError, OSError):  # the step on policies reports the error
            stated = policies.read()
        circumstances = replace(self._circumstances(self.robots.get(path)), policies=stated)

        @cache
        def all_findings() -> list[Finding]:
            return path_findings([folder], circumstances)

        def findings() -> tuple[int, Content]:
            findings = (
                finding
                for finding in all_findings()
                if (finding.id != _FILE_MISSING or Path(finding.file).name != KEY_FILE)
                and Path(os.path.normpath(finding.file or folder)).is_relative_to(folder)
            )
            strict = bool(self.base) and has_new_settings
            wanted = FindingFilter(exclude=_UNSIGNED_POLICY_IDS, strict=strict)
            return _chosen(findings, wanted)

        def signed() -> tuple[int, Content]:
            return _chosen(all_findings(), FindingFilter(include=_UNSIGNED_POLICY_IDS))

        def access() -> tuple[int, Content]:
            if before:
                return self._compared_access(load_side(before), load_side(folder))
            new = (("is new, so that all of its access is new", path),)
            return _FOUND, StepFindings(new)

        yield from self._step_result("keystore", path, findings)
        yield from self._step_result("signed", path, signed, is_wanted=bool(stated))

        def of_robots() -> tuple[int, Content] | None:
            after = self.robots.get(path)
            if not before or not after:
                return None
            earlier = self._keystore_fleet(path)
            if earlier == after:
                return None
            changes = [*fleet_changes(earlier, after)]
            had, have = (
                {name: robot_of(fleet, name) if fleet else None for name in keystore.names}
                for keystore, fleet in (
                    (OpenedKeystore(before), earlier),
                    (OpenedKeystore(folder), after),
                )
            )
            changes += _moved_keys(had, have, earlier, after)
            return _fleet_findings(changes)

        if self.base:
            yield from self._step_result("new-access", path, access)
            yield from self._step_result("new-access", f"{path}/{FLEET}", of_robots)
        yield from self._step_result(
            "expiry", path, lambda: self._expiring_enclaves(before or folder, folder)
        )

    def _expiring_enclaves(self, settings_folder: Path, folder: Path) -> tuple[int, Content]:
        settings = OpenedKeystore(settings_folder).template
        expiring = due_enclaves(
            OpenedKeystore(folder), self.request.renew_within, self.request.at, settings
        )
        return _UNDECIDED if expiring.unreadable else _FOUND if expiring.due else _OK, expiring


def _variables_before_hosts(where: str) -> tuple[bool, str]:
    """Return a sort key that puts Ansible variables before the hosts that have them."""
    return not any(part in where for part in ("ansible_", "sros_")), where


def _fleet_findings(changes: Iterable[FleetChange]) -> tuple[int, Content] | None:
    lines: dict[bool, list[tuple[str, str]]] = {True: [], False: []}
    for change in changes:
        lines[change.is_access].append((change.text, change.name))
    return _found_lines(lines[True], lines[False])


def _found_lines(
    failing: Iterable[tuple[str, str]], shown_only: Iterable[tuple[str, str]] = ()
) -> tuple[int, Content] | None:
    """Return status and findings of a step; None without findings."""
    facts = StepFindings(tuple(failing), tuple(shown_only))
    return (_FOUND if facts.failing else _OK, facts) if facts.lines else None


def _moved_keys(
    before: Mapping[str, Robot | None],
    after: Mapping[str, Robot | None],
    earlier: Fleet | None,
    later: Fleet,
) -> Iterator[FleetChange]:
    """Yield enclaves whose keys another robot of ``later`` gets, unless it was only renamed."""
    known = earlier.robots if earlier else ()
    for enclave, robot in after.items():
        old = before.get(enclave, robot)
        if not robot or (old and old.name == robot.name):
            continue
        is_renamed = old and old.name not in later.robots and robot.name not in known
        if old and is_renamed and delivery_place(old) == delivery_place(robot):
            continue
        had = old.name if old else "no robot"
        yield FleetChange(robot.name, f"gets the keys of {enclave}, which {had} had before")


def _chosen(
    findings: Iterable[Finding], wanted: FindingFilter | None = None
) -> tuple[int, ChosenFindings]:
    """Return the exit status and the wanted findings."""
    chosen = (wanted or FindingFilter()).choose(findings)
    return _FOUND if chosen.fails(WARNING) else _OK, chosen


def _undecided_step(kind: str, subject: str, error: SrosError | OSError) -> ReviewStep:
    known = error if isinstance(error, SrosError) else DocumentError(str(error))
    return ReviewStep(kind, subject, _UNDECIDED, known)


def _read_each(
    kind: str, paths: Iterable[str], read: Callable[[str], Value | None]
) -> Generator[ReviewStep, None, dict[str, Value]]:
    """Map paths to the values read from them; yield a step for each unreadable path."""
    values: dict[str, Value] = {}
    for path in paths:
        try:
            value = read(path)
        except (SrosError, OSError) as error:
            yield _undecided_step(kind, path, error)
        else:
            if value is not None:
                values[path] = value
    return values
