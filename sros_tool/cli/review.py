"""The verb `review`: access that a change of policies and keystores adds, read from two commits."""

from __future__ import annotations

import os
import stat
from collections.abc import Callable, Iterator, Sequence
from itertools import chain
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

import click

from sros_tool import __version__
from sros_tool.cli.common import (
    PATH,
    Decorated,
    json_option,
    json_text,
    local_zone,
    now,
    print_json,
    progress,
    verb,
)
from sros_tool.errors import NOT_DONE, SrosError, UsageError
from sros_tool.terminal import echo
from sros_tool.wording import counted

if TYPE_CHECKING:
    from sros_tool.checks.kind import Finding
    from sros_tool.proof.repository import Repository
    from sros_tool.proof.review import AccessChange, Review, ReviewStep
    from sros_tool.proof.review_request import ReviewRequest

    _PathsType = click.ParamType[tuple[str, ...]]
else:  # generic from click 8.2 on
    _PathsType = click.ParamType

_MAX_MARKDOWN = 60_000
"""Maximum length of the Markdown, in characters: a comment on GitHub has at most 65,536."""
_MAX_REASONS = 20
"""Maximum number of lines below a failed step."""
_STATUS_SIGNS = {0: "🟢", 1: "🔴", 2: "⚪"}
_SIGN_ALLOWED = "🟡"
_STATUS_MARKS = {0: "ok", 1: "FAILED", 2: "UNDECIDED"}
_TITLES = {
    "new-access": "New access",
    "requirements": "Requirements",
    "requirements-before": "Earlier requirements",
    "files": "Files",
    "keystore": "Keystore",
    "signed": "Signed rights",
    "expiry": "Expiry",
    "policy": "Policy",
    "rights": "Rights",
}
"""Kind of step → title, the most important first: code hosts cut a long comment at its end."""
_ALLOWED_BY = {
    "requirements-before": "option --dropped-requirements allow",
    "signed": "review, because whoever changes a policy seldom has the keys of the CAs",
}
"""Kind of step → the option that allows its findings; ``--new-access allow`` for other kinds."""


class _PathLines(_PathsType):
    """Paths relative to the top of the repository, one on each line, as code hosts pass lists."""

    name = "paths"

    def convert(
        self, value: Any, _param: click.Parameter | None, _ctx: click.Context | None
    ) -> tuple[str, ...]:
        """Return the checked paths."""
        from sros_tool.proof.commit_files import checked_path

        if isinstance(value, tuple):
            return value
        lines = (line.strip() for line in str(value).splitlines())
        return tuple(checked_path(line) for line in lines if line)


def _paths_option(name: str, help_text: str) -> Callable[[Decorated], Decorated]:
    return click.option(
        f"--{name}",
        name.replace("-", "_"),
        type=_PathLines(),
        multiple=True,
        metavar="PATH",
        help=f"{help_text}  Can be repeated, or name several on separate lines.",
    )


@verb("review")
@click.option(
    "--base",
    required=True,
    metavar="COMMIT|none",
    help="The commit to compare with: a full id, or a full reference such as "
    "refs/remotes/origin/main. To compare a merge with its target branch, add ^1 to the full id "
    "of the merge. `none`: no comparison.",
)
@click.option(
    "--head",
    default="HEAD",
    show_default=True,
    metavar="COMMIT",
    help="The commit to review: HEAD, a full id or a full reference.",
)
@_paths_option("policy", "A policy, or a folder of policies, of the robot or fleet.")
@_paths_option("requirements", "A file of requirements on the policies and keystores.")
@click.option(
    "--namespace",
    "namespaces",
    metavar="NS",
    multiple=True,
    help="Put the requirements into this namespace, as `sros check --namespace` does. The policies "
    "do not change: their nodes have to be in this namespace already. Can be repeated, or name "
    "several on separate lines.",
)
@click.option(
    "--remap",
    "remaps",
    metavar="[NODE:]FROM:=TO",
    multiple=True,
    help="Remap a name of the requirements, as `sros check --remap` does.  Can be repeated, or "
    "name several on separate lines.",
)
@click.option(
    "--fleet",
    default="",
    metavar="PATH",
    help="Fleet file whose robots replace the placeholders of the policies.",
)
@click.option(
    "--template",
    default="",
    metavar="TEMPLATE",
    help="Assume the protection of this keystore template: the name of one that ships with "
    "sros, or a PATH.",
)
@_paths_option("keystore", "A keystore, or its public part.")
@_paths_option(
    "leave-out",
    "A file, or a folder, of policies and keystores that are not for the robot, such as tests.",
)
@click.option(
    "--new-access",
    type=click.Choice(["fail", "allow"]),
    default="fail",
    show_default=True,
    help="Whether new access, or a changed policy that --policy does not cover, makes the review "
    "fail.",
)
@click.option(
    "--dropped-requirements",
    type=click.Choice(["fail", "allow"]),
    default="fail",
    show_default=True,
    help="Whether requirements of BASE that HEAD drops or weakens make the review fail.",
)
@click.option(
    "--renew-within",
    default="30d",
    show_default=True,
    metavar="DURATION|PERCENT|soon",
    help="Fail if an enclave of a keystore expires within DURATION, has used PERCENT of its "
    "validity, or expires soon, as defined for `sros renew --all-expiring`.",
)
@click.option(
    "--repository",
    "folder",
    type=PATH,
    default=".",
    metavar="FOLDER",
    help="Folder of the git repository. [default: the working directory]",
)
@click.option(
    "--fetch",
    "remote",
    metavar="REMOTE",
    help="Fetch the base from this remote, such as origin, if the repository does not have it.",
)
@click.option(
    "--summary",
    type=PATH,
    metavar="FILE",
    help="Write the result as Markdown, for a comment. FILE must be outside of the repository.",
)
@click.option(
    "--sarif",
    type=PATH,
    metavar="FILE",
    help="Write the findings as SARIF. FILE must be outside of the repository.",
)
@click.option(
    "--annotations",
    type=PATH,
    metavar="FILE",
    help="Write the findings as annotations of GitHub Actions, for `cat FILE` in a workflow. "
    "FILE must be outside of the repository.",
)
@json_option
def review(
    base: str,
    head: str,
    policy: tuple[tuple[str, ...], ...],
    requirements: tuple[tuple[str, ...], ...],
    namespaces: tuple[str, ...],
    remaps: tuple[str, ...],
    fleet: str,
    template: str,
    keystore: tuple[tuple[str, ...], ...],
    leave_out: tuple[tuple[str, ...], ...],
    new_access: str,
    dropped_requirements: str,
    renew_within: str,
    folder: Path,
    remote: str | None,
    summary: Path | None,
    sarif: Path | None,
    annotations: Path | None,
    as_json: bool,
) -> int:
    r"""Review a change of policies, requirements and keystores, as in a pull request.

    Checks the policies and keystores of the commit HEAD, decides whether the requirements hold,
    including those that HEAD drops, and compares all access with the commit BASE. PATHs are
    relative to the top of the repository.

    Both commits are read from git itself: nothing is checked out, and files of the work tree are
    read only to report that they differ from HEAD. No link in a commit is followed, and no program
    of the repository or its configuration is run. The result names everything that was not
    reviewed.

    Example:
      $ sros review --base refs/remotes/origin/main --policy robot/robot.xml
      [ok] policy robot/robot.xml: nothing found
      [FAILED] new-access robot/robot.xml: 1 right is new
        + /arm publish topic /cmd_vel  (robot/robot.xml:12)
      ...
      $ sros review --base 5d1c0a41c3ec2f2a9d2d1b3c63ff7b6e0aa1d9f4 \
            --policy robot/robot.xml --requirements robot/requirements.toml \
            --keystore keystore --summary /tmp/review.md --sarif /tmp/review.sarif

    Exit status: 0 if nothing was found, or only what is allowed; 1 if something was found, 2 if
    something could not be decided.
    """
    from sros_tool.keystore.expiry import parse_threshold
    from sros_tool.names import check_plain_namespace
    from sros_tool.policy.remapping import parse_remapping_of_names
    from sros_tool.proof.commit_files import checked_path
    from sros_tool.proof.repository import Repository
    from sros_tool.proof.review import review as review_change
    from sros_tool.proof.review_request import ReviewRequest

    if not base:
        raise UsageError(
            "the base is empty",
            "Nothing would be compared.",
            "Name a commit with --base, or write --base none.",
        )
    if not folder.is_dir():
        raise UsageError(f"'{folder}' is not a folder", "", "Name the folder of the repository.")
    policies, requirement_files, keystores, left_out = (
        tuple(dict.fromkeys(path for part in parts for path in part))
        for parts in (policy, requirements, keystore, leave_out)
    )
    if not policies and not keystores:
        raise UsageError("no policy and no keystore is named", "", "Add --policy or --keystore.")
    places, rules = (
        [line.strip() for text in texts for line in text.splitlines() if line.strip()]
        for texts in (namespaces, remaps)
    )
    for option, given in (("--namespace", places), ("--remap", rules)):
        if given and not requirement_files:
            raise UsageError(
                f"{option} has no effect without --requirements",
                "",
                f"Add it, or leave {option} out.",
            )
    repository = Repository(folder.resolve())
    threshold = parse_threshold(renew_within)
    outputs = _Outputs(repository, (*policies, *keystores)[0], summary, sarif, annotations)
    outputs.write_unfinished()
    try:
        request = ReviewRequest(
            repository,
            repository.base_commit(base, remote),
            repository.head_commit(head),
            policies,
            requirement_files,
            tuple(map(check_plain_namespace, places)),
            tuple(map(parse_remapping_of_names, rules)),
            checked_path(fleet) if fleet else "",
            keystores,
            new_access == "allow",
            dropped_requirements == "allow",
            threshold,
            left_out,
            checked_path(template) if template else "",
            now(),
            local_zone(os.environ),
        )
        with progress("reviewing"), TemporaryDirectory(prefix="sros-") as private:
            result = review_change(request, Path(os.path.realpath(private)))
            outputs.write(result, request)
    except SrosError as error:
        outputs.write_error(error)
        raise
    if as_json:
        from sros_tool.proof.review import ReviewResult, StepResult

        steps = [
            StepResult(
                step.kind,
                result.with_shown_paths(step.subject) or None,
                step.status,
                step.allowed,
                _sentence(result, step),
                [result.with_shown_paths(line) for line in _lines_to_read(step)],
            )
            for step in result.steps
        ]
        print_json(
            ReviewResult(
                result.base or None,
                result.head,
                result.status,
                steps,
                findings=_findings(result, request),
                left_out=result.left_out,
            )
        )
    else:
        for line in _text(result):
            echo(line)
    return result.status


# ── output ──────────────────────────────────────────────────────────────────────────────


class _Outputs:
    """The output files of a review; they must be outside of the repository."""

    def __init__(
        self,
        repository: Repository,
        first: str,
        summary: Path | None,
        sarif: Path | None,
        annotations: Path | None,
    ) -> None:
        """Check the files; ``first`` is the first reviewed path.  Raises `UsageError`."""
        self._first, self._summary, self._sarif = first, summary, sarif
        self._annotations = annotations
        self._top = repository.top() or repository.folder
        named = [file for file in (summary, sarif, annotations) if file]
        for file in named:
            _check_outside(file, self._top)
        if len({file.absolute() for file in named}) < len(named):
            raise UsageError("two options name the same file to write")

    def write(self, result: Review, request: ReviewRequest) -> None:
        """Write the result of the review to the output files."""
        self._write(_markdown(result, request), _findings(result, request))

    def write_unfinished(self) -> None:
        """Write "could not be decided", which stays if a time limit kills the review."""
        self._write_undecided("The review was ended before it had a result.")

    def write_error(self, error: SrosError) -> None:
        """Write the error that prevented a result."""
        from sros_tool.markdown import code

        self._write_undecided(code(str(error)), str(error))

    def _write_undecided(self, markdown: str, reason: str = "") -> None:
        from sros_tool.checks.review import UNDECIDED

        undecided = UNDECIDED.found(
            "the review", (reason or markdown).removesuffix("."), self._first
        )
        self._write(f"## Review: could not be decided\n\n{markdown}\n", [undecided])

    def _write(self, markdown: str, findings: Sequence[Finding]) -> None:
        from sros_tool.checks.formats import github_annotations, sarif
        from sros_tool.checks.kind import FindingFilter, select_kinds

        if self._summary:
            _save(self._summary, markdown.encode("utf-8", "backslashreplace"))
        if self._sarif:
            kinds = select_kinds(FindingFilter())
            log = sarif(findings, kinds, version=__version__, base=self._top)
            _save(self._sarif, f"{json_text(log)}\n".encode("utf-8", "backslashreplace"))
        if self._annotations:
            _save(
                self._annotations, github_annotations(findings).encode("utf-8", "backslashreplace")
            )


def _check_outside(file: Path, top: Path) -> None:
    """Raise `UsageError` if the reviewed change could control the output file, by a link.

    ``top`` is the top folder of the repository, which has the change.
    """
    parent = Path(os.path.realpath(file.absolute().parent))
    if parent.is_relative_to(os.path.realpath(top)):
        raise UsageError(
            f"'{file}' is in the repository",
            "The reviewed change could put a link there that leads to another file.",
            "Name a file outside of it, in a folder that only you can write to.",
        )
    if not parent.is_dir():
        raise UsageError(f"cannot write '{file}'", "Its folder does not exist.", "Create it first.")
    if file.is_symlink() or (file.exists() and not stat.S_ISREG(file.stat().st_mode)):
        raise UsageError(
            f"'{file}' is not a regular file",
            "sros writes neither through links nor to devices.",
            "Name a new file.",
        )


def _save(file: Path, data: bytes) -> None:
    from sros_tool.files import staged_file

    with staged_file(file.absolute(), data, mode=0o644) as put_in_place:
        put_in_place()


def _sentence(result: Review, step: ReviewStep) -> str:
    """Return the result of a step as a clause."""
    from sros_tool.checks.kind import ChosenFindings
    from sros_tool.cli.policy import access_summary
    from sros_tool.keystore.expiry import ExpiryCheck
    from sros_tool.proof.review import AccessChange, DroppedRequirements, RightsChange, StepFindings

    place = f" {result.place}" if result.place and step.kind.startswith("requirements") else ""
    match step.content:
        case ChosenFindings() as chosen:
            return f"{chosen.summary()}{place}"
        case AccessChange(growth=growth):
            return access_summary(growth)
        case RightsChange(compared=compared):
            added, gone = len(compared.rights.only_second), len(compared.rights.only_first)
            absolute = sum(form.is_absolute for form in compared.changed_forms)
            clauses = [
                f"{counted(count, noun)} {verb}"
                for count, noun, verb in (
                    (added, "written right", "added"),
                    (gone, "written right", "gone"),
                    (len(compared.protections), "stated protection", "changed"),
                    (len(compared.enclaves), "empty enclave", "added or gone"),
                    (absolute, "name", "made absolute"),
                    (len(compared.changed_forms) - absolute, "name", "made relative"),
                )
                if count
            ]
            return ", ".join(clauses)
        case DroppedRequirements(count=count, chosen=chosen):
            kind = f"{counted(count, 'requirement')} dropped, changed or escaped"
            text = f"{kind}, checked as they were before the change: {chosen.summary()}{place}"
            way = "; a reviewer can approve this: --dropped-requirements allow"
            return text if step.allowed else f"{text}{way}"
        case ExpiryCheck(due=due, unreadable=unreadable, lasting=count) as expiry:
            unread = f", {len(unreadable)} cannot be read" if unreadable else ""
            left_out = expiry.short_lived_text()
            left_out = f"; not counted: {left_out}" if left_out else ""
            need = "needs" if len(due) == 1 else "need"
            return (
                f"{len(due)} of {counted(count, 'enclave')} {need} to be renewed{unread}{left_out}"
            )
        case StepFindings() as facts:
            lines = facts.lines
            further = f", and {len(lines) - 1} more" if len(lines) > 1 else ""
            return f"'{lines[0][1]}' {lines[0][0]}{further}"
        case error:
            return result.with_shown_paths(str(error))


def _sentences(result: Review, steps: Sequence[ReviewStep]) -> Iterator[tuple[ReviewStep, str]]:
    """Yield each step with its result as a clause, without errors that earlier steps reported."""
    earlier = ""
    for step in steps:
        sentence = _sentence(result, step)
        if isinstance(step.content, SrosError) and sentence in earlier:
            sentence = "could not be decided, for the reason above"
        earlier += "\n".join((sentence, *map(result.with_shown_paths, _lines_to_read(step))))
        yield step, sentence


def _findings(result: Review, request: ReviewRequest) -> list[Finding]:
    """Return the findings of all steps, with at least one finding for each step that fails.

    Paths are relative to the top of the repository.  Findings that the request allows are marked as
    accepted.
    """
    findings: dict[Finding, None] = {}
    for step in result.steps:
        allowed = _ALLOWED_BY.get(step.kind, "option --new-access allow") if step.allowed else ""
        for finding in _step_findings(result, step, request):
            accepted = finding.accepted or allowed
            findings[result.shown_finding(finding._replace(accepted=accepted))] = None
    return list(findings)


def _step_findings(result: Review, step: ReviewStep, request: ReviewRequest) -> Iterator[Finding]:
    """Yield the findings of a step, each at a place in HEAD."""
    from sros_tool.checks.kind import ChosenFindings
    from sros_tool.checks.review import EXPIRY, NEW_ACCESS, NOT_REVIEWED, PRIVATE_KEY, UNDECIDED
    from sros_tool.keystore.expiry import ExpiryCheck, describe_lifetime
    from sros_tool.proof.review import AccessChange, DroppedRequirements, RightsChange, StepFindings

    named = (request.policies, request.requirements, request.keystores)
    whole = (paths[0] for paths in named if paths and " ".join(paths) == step.subject)
    path = next(whole, step.subject) or next(chain(*named))
    match step.content:
        case ChosenFindings() as chosen:
            yield from (*chosen.shown, *chosen.accepted)
        case DroppedRequirements(chosen=chosen):
            yield from chosen.shown
        case AccessChange() as change:
            yield from _access_findings(change, path)
        case RightsChange():
            pass
        case ExpiryCheck(due=due, unreadable=unreadable):
            for lifetime in due:
                yield EXPIRY.found(lifetime.name, describe_lifetime(lifetime, request.at), path)
            for enclave in unreadable:
                yield UNDECIDED.found(enclave.name, str(enclave.error), path)
        case StepFindings(failing=failing):
            kinds = {"files": NOT_REVIEWED, "keystore": PRIVATE_KEY}
            for text, name in failing:
                is_file = step.kind in kinds
                yield kinds.get(step.kind, NEW_ACCESS).found(name, text, name if is_file else path)
        case error:
            yield UNDECIDED.found(step.subject or path, str(error).removesuffix("."), path)


def _access_findings(change: AccessChange, path: str) -> Iterator[Finding]:
    """Yield a finding for each line of HEAD with new access, or without a DENY of BASE.

    A finding without a line is placed at ``path``.
    """
    from sros_tool.checks.review import DROPPED_DENIAL, NEW_ACCESS
    from sros_tool.cli.policy import placed_changes

    at: dict[tuple[bool, str, int], list[tuple[str, str]]] = {}
    for subject, text, place, is_denial in placed_changes(
        change.before, change.after, change.growth
    ):
        line = (place.file, place.line) if place and place.file else (path, 0)
        at.setdefault((is_denial, *line), []).append((subject, text))
    for (is_denial, file, number), [(subject, text), *more] in at.items():
        text += f"; this line makes {counted(len(more), 'more change')}" if more else ""
        kind = DROPPED_DENIAL if is_denial else NEW_ACCESS
        yield kind.found(subject, text, file, number)


def _text(result: Review) -> list[str]:
    """Return the review as lines."""
    lines = []
    for step, sentence in _sentences(result, result.steps):
        subject = f" {result.with_shown_paths(step.subject)}" if step.subject else ""
        mark = "allowed" if step.allowed else _STATUS_MARKS[step.status]
        lines.append(f"[{mark}] {step.kind}{subject}: {sentence}")
        lines_to_read = _lines_to_read(step)
        more = counted(len(lines_to_read) - _MAX_REASONS, "more line")
        further = [f"and {more} (--summary FILE has all)"]
        shown = lines_to_read[:_MAX_REASONS] + further * (len(lines_to_read) > _MAX_REASONS)
        lines += [f"  {result.with_shown_paths(line)}" for line in shown]
    not_covered = [f"not covered: {'; '.join(result.left_out)}"] if result.left_out else []
    return [*lines, *not_covered, _verdict(result)]


def _lines_to_read(step: ReviewStep) -> list[str]:
    """Return the lines that a reviewer has to read.

    These are new access and dropped requirements, even if they are allowed; rights that lost their
    counterpart; and findings.
    """
    from sros_tool.checks.formats import folded_findings
    from sros_tool.checks.kind import ChosenFindings
    from sros_tool.cli.policy import (
        added_lines,
        changed_form_lines,
        dropped_lines,
        enclave_lines,
        folded_differences,
        protection_lines,
        unanswered_lines,
    )
    from sros_tool.proof.review import AccessChange, DroppedRequirements, RightsChange, StepFindings

    match step.content:
        case StepFindings() as facts if len(facts.lines) > 1:
            return [f"'{name}' {text}" for text, name in facts.lines]
        case AccessChange(before, after, growth):
            return [*added_lines(before, after, growth), *dropped_lines(after, growth)]
        case RightsChange(before=before, after=after, compared=compared):
            unanswered = unanswered_lines(compared, after.fleet)
            differing = folded_differences(before, after, compared.rights, ("BASE", "HEAD"))
            differing += enclave_lines(compared, after.fleet or before.fleet)
            differing += protection_lines(compared.protections)
            return [*unanswered, *changed_form_lines(compared, after.fleet), *differing]
        case (ChosenFindings() as chosen) | DroppedRequirements(chosen=chosen):
            one_per_group = ((finding,) for finding in chosen.shown)
            return [
                f"{_finding_line(finding)}{others and f' ({others})'}"
                for (finding, *_), others in folded_findings(one_per_group, step.fleet)
            ]
    return []


def _finding_line(finding: Finding) -> str:
    """Return a finding in one line; for a dropped requirement also with its line in BASE."""
    from sros_tool.checks.requirements import DROPPED

    subject = "" if finding.subject == finding.file else f"{finding.subject}: "
    line = f"{finding.place}: {finding.severity.word}: {subject}{finding.text} [{finding.id}]"
    places = finding.related if finding.kind is DROPPED else ()
    return line + "".join(f" ({place.text}: {place})" for place in places)


_OPTIONS = {
    "new-access": "--new-access allow",
    "requirements-before": "--dropped-requirements allow",
}
"""The options that accept the findings of a step."""


def _verdict(result: Review) -> str:
    """Return a sentence with the result."""
    counts = [sum(step.status == status for step in result.steps) for status in (1, 2)]
    words = [
        f"{counted(count, 'step')} {word}"
        for count, word in zip(counts, ("failed", "could not be decided"), strict=True)
        if count
    ]
    if allowed := sum(step.allowed for step in result.steps):
        words.append(f"{counted(allowed, 'step')} found only allowed changes")
    compared = f" compared with {result.base}" if result.base else ""
    failed = {step.kind for step in result.steps if step.status == 1}
    accepting = [f"{_OPTIONS[kind]} accepts {kind}" for kind in _OPTIONS if kind in failed]
    options = f" ({', '.join(accepting)})" if accepting else ""
    return f"{result.head}{compared}: {' and '.join(words) or _nothing_found(result)}{options}"


def _nothing_found(result: Review) -> str:
    """Return "nothing found", with rights that lost their counterpart, which never fail."""
    from sros_tool.proof.review import RightsChange

    changes = (step.content for step in result.steps if isinstance(step.content, RightsChange))
    lost = sum(len(change.compared.unanswered) for change in changes)
    alone = counted(lost, "right has no counterpart", "rights have no counterpart")
    return f"nothing found that fails, but {alone} any more" if lost else "nothing found"


def _markdown(result: Review, request: ReviewRequest) -> str:
    """Return the review as Markdown: a line for each step, then the details, the worst first."""
    from sros_tool.markdown import bounded_list, code, plain

    allowed = any(step.allowed for step in result.steps)
    passed = "only allowed changes were found" if allowed else _nothing_found(result)
    verdict = (passed, "something found", "could not be decided")[result.status]
    lines = (
        f"{_SIGN_ALLOWED if step.allowed else _STATUS_SIGNS[step.status]} {_TITLES[step.kind]}"
        f"{' ' + code(result.with_shown_paths(step.subject)) if step.subject else ''}: "
        f"{code(sentence)}"
        for step, sentence in _sentences(result, _sorted_by_weight(result))
    )
    sides = f"Commit {code(result.head)}"
    sides += f", compared with {code(result.base)}." if result.base else "."
    printed = "which `sros review` prints"
    parts = [f"## Review: {plain(verdict)}", sides, bounded_list(lines, 12_000, printed)]
    if result.left_out:
        parts += ["Not covered:", bounded_list(map(code, result.left_out), 6000, printed)]
    characters_left = _MAX_MARKDOWN - sum(map(len, parts))
    for step in _sorted_by_weight(result):
        detail = result.with_shown_paths(_detail(result, step, request))
        if detail and len(detail) > characters_left:
            detail = f"### {_TITLES[step.kind]}: too long for a comment"
        if detail:
            parts.append(detail)
            characters_left -= len(detail) + 2
    return "\n\n".join(part.rstrip("\n") for part in parts) + "\n"


def _sorted_by_weight(result: Review) -> list[ReviewStep]:
    """Sort the steps: failed ones first, then allowed ones, then by importance."""
    kinds = list(_TITLES)
    return sorted(
        result.steps, key=lambda step: (not step.status, not step.allowed, kinds.index(step.kind))
    )


def _detail(result: Review, step: ReviewStep, request: ReviewRequest) -> str:
    """Return the details of a step as Markdown, or "" if `_sentence` already says everything."""
    from sros_tool.checks.formats import findings_markdown
    from sros_tool.checks.kind import ChosenFindings
    from sros_tool.cli.check import renewal_markdown
    from sros_tool.cli.policy import access_markdown, rights_markdown
    from sros_tool.keystore.expiry import ExpiryCheck, describe_lifetime
    from sros_tool.markdown import bounded_list, code
    from sros_tool.proof.review import AccessChange, DroppedRequirements, RightsChange, StepFindings

    def findings(chosen_findings: ChosenFindings, title: str = "Findings") -> str:
        shown = tuple(map(result.shown_finding, chosen_findings.shown))
        chosen_findings = chosen_findings._replace(shown=shown)
        return findings_markdown(chosen_findings, step.fleet, title)

    shown_by = "which `sros review` prints"
    match step.content:
        case ChosenFindings() as chosen:
            if not chosen.shown:
                return ""
            if step.allowed:
                return f"### {_TITLES[step.kind]}: allowed\n\n{findings(chosen)}"
            return findings(chosen, _TITLES[step.kind])
        case AccessChange(before, after, growth):
            return access_markdown(before, after, growth)
        case RightsChange(before, after, compared):
            return rights_markdown(before, after, compared)
        case DroppedRequirements(chosen=chosen):
            title = "### Requirements that changed, checked as they were before the change"
            return f"{title}\n\n{findings(chosen)}"
        case ExpiryCheck(due=due, unreadable=unreadable):
            lines = [describe_lifetime(lifetime, request.at) for lifetime in due]
            unknown = [f"{enclave.name}  unknown: {enclave.error}" for enclave in unreadable]
            nothing = not (lines or unknown)
            return "" if nothing else renewal_markdown(lines, unknown, (), "", "--renew-within")
        case StepFindings() as facts:
            facts_with_names = (f"{code(name)} {code(text)}" for text, name in facts.lines)
            return f"### {_TITLES[step.kind]}\n\n{bounded_list(facts_with_names, 6000, shown_by)}"
    return ""


assert max(_STATUS_SIGNS) == NOT_DONE
