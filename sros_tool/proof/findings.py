"""Findings about requirements, with policy lines and worlds."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from shlex import quote

from sros_tool.automata import SearchLimit
from sros_tool.checks.kind import Finding, FindingKind, RelatedPlace
from sros_tool.checks.requirements import (
    ALLOWED_BY_NAME,
    ASSUMED,
    HOLDS_ALONE,
    MISSPELLED_ENCLAVE,
    NOT_CROSSING,
    NOT_ON_ZENOH,
    OF_EXPORT,
    REMAPPING_UNUSED,
    ROBOTS_LEFT_OUT,
    UNKNOWN_ENCLAVE,
    UNNAMED,
    VACUOUS,
    VIOLATED,
)
from sros_tool.dds.decision.vendors import joined_titles
from sros_tool.errors import UsageError
from sros_tool.faults import REFUSE_STRANGERS
from sros_tool.keystore.template import DEFAULT_TEMPLATE
from sros_tool.names import action_part, expand, is_expression, service_of
from sros_tool.policy.model import ALLOW, DENY, Level, Source
from sros_tool.policy.patterns import OTHER_NAMESPACE, covers, matches
from sros_tool.policy.remapping import Remapping, has_new_name, remapped_name
from sros_tool.policy.rights import KIND_OF, Right
from sros_tool.proof.decide import (
    MOST_STEPS,
    BlockedUse,
    Use,
    Verdict,
    Witness,
    Worlds,
    patterns_of_any_package,
    similar_enclave_clause,
)
from sros_tool.proof.requirements import (
    EXCEPT,
    Apart,
    AtMost,
    Must,
    Nobody,
    NotBoth,
    NothingBut,
    Only,
    Protected,
    Requirement,
    RightsRequirement,
    Widest,
    demand,
    enclaves_of,
    names_demanded_by,
    names_of,
    read_all_requirements,
    unused_remappings,
)
from sros_tool.proof.system import Place, System
from sros_tool.proof.worlds import ANYBODY, World
from sros_tool.wording import counted, first_few


@dataclass(frozen=True, slots=True)
class Step:
    """A use in a witness, with the place of the right that states it, or None.

    If an enclave lacks a right that it must have, the place is preferably the place of a denial.

    ``permissions_of`` is another enclave whose permissions allow the use; "" for the enclave's own
    permissions.
    """

    use: Use
    place: Place | None
    permissions_of: str = ""

    @property
    def source(self) -> Source | None:
        """File and line of the right, or None."""
        return self.place.source if self.place else None

    def action_text(self) -> str:
        """Return text such as ``publish /cmd_vel``, with the wildcard that allows it."""
        right, kind, name, by = self.stated_form()
        shown = f"action {name}" if kind == "actions" else name
        text = f"{right or ('write' if self.use.writes else 'read')} {shown}"
        is_denied = self.place and self.place.right.qualifier is DENY
        text += f"{', denied' if is_denied else ''} by {by}" if by else ""
        return (
            f"{text} with the permissions of {self.permissions_of}" if self.permissions_of else text
        )

    def stated_form(self) -> tuple[str, str, str, str]:
        """Return right, kind and name as a policy states them, and the wildcard that allows them.

        A part of an action is shown as the policy states it: as a right to the action, or to the
        part.
        """
        right, name, stated = self.use.right, self.use.name, self.place and self.place.right
        whole = KIND_OF.get(right) == "actions"
        if stated and stated.kind == "actions" and not whole:
            right, name = stated.right, action_part(name)[0] or name
        elif stated and stated.kind != "actions" and whole:
            right, name = stated.right, service_of(self.use.topic)[0] or self.use.topic[2:]
        kind = KIND_OF[right] if right and name.startswith("/") else "dds"
        by = stated.name if stated and is_expression(stated.name) else ""
        return right, kind, name, by

    def text(self) -> str:
        """Return text such as ``/teleop may publish /cmd_vel by /cmd*``."""
        return f"{self.use.enclave} may {self.action_text()}"


@dataclass(frozen=True, slots=True)
class Violation:
    """A broken requirement, the steps that show it, and the worlds in which it does not hold.

    ``worlds`` is empty if the requirement holds in no decided world.  ``missing`` is an enclave in
    the witness that does not exist, or "".  With ``idle``, no process could start with the
    enclave's files, whatever rights the enclave has. ``others`` are the steps of further enclaves
    that break the requirement: at most five enclaves with the same uses, and five with different
    uses.
    """

    requirement: Requirement
    witness: Witness
    steps: tuple[Step, ...]
    worlds: tuple[str, ...]
    missing: str = ""
    idle: bool = False
    others: tuple[tuple[Step, ...], ...] = ()

    @property
    def position(self) -> int:
        """The index of the use whose enclave should change.

        For an influence, this is the first enclave that passes the influence on, if there is one.
        """
        return 2 if isinstance(self.requirement, Apart) and len(self.steps) > 2 else 0

    @property
    def alike(self) -> list[str]:
        """Further enclaves that break the requirement with the same uses."""
        others, position = self.witness.others, self.position
        return [uses[position].enclave for uses in others if _are_alike(uses, self.witness)]

    @property
    def differing(self) -> list[tuple[Step, ...]]:
        """The steps of ``others`` that break the requirement with different uses."""
        similar_enclaves = {*self.alike}
        return [
            steps
            for steps in self.others
            if steps[self.position].use.enclave not in similar_enclaves
        ]


def _are_alike(uses: Sequence[Use], witness: Witness) -> bool:
    pairs = zip(uses, witness.uses, strict=False)
    return all((use.right, use.name) == (other.right, other.name) for use, other in pairs)


@dataclass(frozen=True, slots=True)
class Decisions:
    """The decisions on all requirements.

    ``violations`` are the broken requirements. ``vacuous`` are requirements of which a part, or the
    whole, cannot fail, with the reasons.  ``assumed`` are requirements that hold only with the
    assumed protection of the default template, with a name whose protection the policy does not
    state.  ``blocked`` are requirements that hold, with a use that does not pass between Zenoh
    routers. ``unnamed`` are requirements that hold, with their names that no right
    states.  ``unjudged`` are enclaves that have to have rights, but that an export
    lacks.  ``holding_alone`` are requirements that only further enclaves could
    break, with the reasons.  ``absent`` are requirements with exceptions for enclaves that do not
    exist, with clauses on these exceptions. ``misspelled`` are the same, if an enclave with a
    similar name exists. ``unanswered`` are requirements about names of which enclaves have only one
    side, with clauses on these names; ``unanswered_alone`` are the same, if perhaps only users of a
    package have the other side. ``by_name`` are requirements with uses that they allow only by a
    pattern that enclaves of any package can match.
    """

    violations: tuple[Violation, ...]
    vacuous: tuple[tuple[Requirement, tuple[str, ...]], ...]
    assumed: tuple[tuple[Requirement, str], ...] = ()
    blocked: tuple[tuple[Requirement, BlockedUse], ...] = ()
    unnamed: tuple[tuple[Requirement, tuple[str, ...]], ...] = ()
    unjudged: tuple[str, ...] = ()
    holding_alone: tuple[tuple[Requirement, tuple[str, ...]], ...] = ()
    absent: tuple[tuple[Requirement, tuple[str, ...]], ...] = ()
    misspelled: tuple[tuple[Requirement, tuple[str, ...]], ...] = ()
    unanswered: tuple[tuple[Requirement, tuple[str, ...]], ...] = ()
    unanswered_alone: tuple[tuple[Requirement, tuple[str, ...]], ...] = ()
    by_name: tuple[tuple[Only, tuple[Step, ...]], ...] = ()


def decide_all(
    requirements: Sequence[Requirement], system: System, breaking: frozenset[str] = frozenset()
) -> Decisions:
    """Return the decisions on requirements in all worlds.

    An export shows only which requirements are broken: it may lack the enclaves that have the names
    in a requirement, or that could break it.

    A violation of several enclaves begins with one that is not in ``breaking``.

    Raises:
        DocumentError: there are too many wildcards to decide a requirement.
    """
    violations, assumed, blocked, unnamed = [], [], [], []
    by_name: list[tuple[Only, tuple[Step, ...]]] = []
    vacuous: list[tuple[Requirement, tuple[str, ...]]] = []
    holding_alone: list[tuple[Requirement, tuple[str, ...]]] = []
    absent: list[tuple[Requirement, tuple[str, ...]]] = []
    misspelled: list[tuple[Requirement, tuple[str, ...]]] = []
    unanswered: list[tuple[Requirement, tuple[str, ...]]] = []
    unanswered_alone: list[tuple[Requirement, tuple[str, ...]]] = []
    limit = SearchLimit(MOST_STEPS)
    worlds = Worlds(system.worlds)
    known = {enclave for world in system.worlds for enclave in world.enclaves}
    demanded = [r.enclave for r in requirements if isinstance(r, Must) and r.enclave not in known]
    unjudged = tuple(dict.fromkeys(demanded)) if system.is_export else ()
    for requirement in requirements:
        if isinstance(requirement, Must) and requirement.enclave in unjudged:
            continue
        verdicts = list(worlds.decide(requirement, limit))
        broken = [(world, verdict.witness) for world, verdict in verdicts if verdict.witness]
        if broken:
            world, witness = min(broken, key=lambda pair: len(pair[1].uses))
            witness = witness.led_by_new(breaking) if breaking else witness
            steps = tuple(_step(requirement, use, world, system) for use in witness.uses)
            titles = tuple(world.title for world, _ in broken)
            titles = () if len(broken) == len(system.worlds) else titles
            missing = next(
                (enclave for enclave in witness.enclaves if enclave and enclave not in known), ""
            )
            idle = isinstance(requirement, Must) and requirement.enclave in world.idle
            similar_uses = [uses for uses in witness.others if _are_alike(uses, witness)]
            differing = [uses for uses in witness.others if not _are_alike(uses, witness)]
            other_steps = tuple(
                tuple(_step(requirement, use, world, system) for use in uses)
                for uses in (*similar_uses[:_MOST_SHOWN], *differing[:_MOST_SHOWN])
            )
            violations.append(
                Violation(requirement, witness, steps, titles, missing, idle, other_steps)
            )
        if not system.is_export:  # the enclaves that it lacks may have the names
            empty, waiting, always = _why_never_fails([verdict for _, verdict in verdicts])
            is_complete = _has_all_enclaves(requirement, system)
            is_gone = (is_complete or not requirement.is_relative) and _texts_in_all(
                verdict.gone for _, verdict in verdicts
            )
            if empty or is_gone or (always and not _users_may_break(requirement)):
                vacuous.append((requirement, (*empty, *(waiting or always))))
            elif (waiting or always) and not broken:
                holding_alone.append((requirement, (*(waiting or always),)))
            if not broken:
                failing, alone = _unanswered_clauses(requirement, system, [v for _, v in verdicts])
                if failing:
                    unanswered.append((requirement, failing))
                if alone:
                    unanswered_alone.append((requirement, alone))
            exceptions = _texts_in_all(verdict.absent for _, verdict in verdicts)
            meant = {name: similar_enclave_clause(name, known) for name in exceptions}
            if misspelled_names := [f"{name}{clause}" for name, clause in meant.items() if clause]:
                misspelled.append((requirement, (_no_enclave_clause(misspelled_names),)))
            if absent_names := [name for name, clause in meant.items() if not clause]:
                absent.append((requirement, (_no_enclave_clause(absent_names),)))
            if not broken and (names := _texts_in_all(verdict.unnamed for _, verdict in verdicts)):
                unnamed.append((requirement, names))
        if not broken and (
            assumed_names := [verdict.assumed for _, verdict in verdicts if verdict.assumed]
        ):
            assumed.append((requirement, assumed_names[0]))
        steps_by_name = {
            use.enclave: _step(requirement, use, world, system)
            for world, verdict in verdicts
            for use in verdict.by_name
        }
        if isinstance(requirement, Only) and steps_by_name:
            by_name.append((requirement, tuple(steps_by_name.values())))
        blocked += [(requirement, verdict.blocked) for _, verdict in verdicts if verdict.blocked][
            :1
        ]
    return Decisions(
        violations=tuple(violations),
        vacuous=tuple(vacuous),
        assumed=tuple(assumed),
        blocked=tuple(blocked),
        unnamed=tuple(unnamed),
        unjudged=unjudged,
        holding_alone=tuple(holding_alone),
        absent=tuple(absent),
        misspelled=tuple(misspelled),
        unanswered=tuple(unanswered),
        unanswered_alone=tuple(unanswered_alone),
        by_name=tuple(by_name),
    )


def _unanswered_clauses(
    requirement: Requirement, system: System, verdicts: Sequence[Verdict]
) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Return clauses on names without another side: for a warning, and for a note.

    A note is enough if the other side may be in the policies of users: in a policy, for topics and
    for services with relative names; in a keystore, for topics with relative names.
    """
    unserved, unheard = (
        [_listed_clauses(clauses)] if clauses else []
        for clauses in (
            _texts_in_all(verdict.unserved for verdict in verdicts),
            _texts_in_all(verdict.unheard for verdict in verdicts),
        )
    )
    is_complete = _has_all_enclaves(requirement, system)
    if is_complete and not requirement.is_relative:
        return (*unserved, *unheard), ()
    if is_complete or not requirement.is_relative:
        return tuple(unserved), tuple(unheard)
    return (), (*unserved, *unheard)


def _has_all_enclaves(requirement: Requirement, system: System) -> bool:
    """Return whether a system is a robot's: a keystore, or a policy that is checked in a namespace.

    A package's policy lacks the enclaves of users, also where a review tries it in a namespace.
    """
    return system.is_keystore or (requirement.elsewhere is None and not system.is_package)


def _users_may_break(requirement: Requirement) -> bool:
    """Return whether further enclaves, of a package's users, could break a requirement."""
    anywhere = requirement.elsewhere or requirement
    if not requirement.is_relative:
        return False
    return isinstance(anywhere, AtMost | NotBoth) or (
        isinstance(anywhere, Only)
        and (
            any(pattern.startswith(EXCEPT) for pattern in anywhere.enclaves)
            or not any(covers(pattern, "/*") for pattern in anywhere.enclaves)
        )
    )


def _no_enclave_clause(names: Sequence[str]) -> str:
    return f"there is no enclave {_listed_names(names, 'or')}"


def _step(requirement: Requirement, use: Use, world: World, system: System) -> Step:
    """Return a use with the place of the right that allows it or, for `Must`, of the denial.

    The right that allows it may be a right of another enclave.
    """
    if isinstance(requirement, Must) and (denial := system.places.find(use, DENY)):
        return Step(use, denial)
    holder = world.other_sufficient_enclave(use.enclave, use.writes, use.topic)
    stating = replace(use, enclave=holder) if holder else use
    return Step(use, system.places.find(stating), holder)


def _why_never_fails(verdicts: Sequence[Verdict]) -> tuple[list[str], list[str], list[str]]:
    """Return clauses that say why a requirement, or a part of it, cannot fail in any world.

    The first list is about enclaves that do not exist, and about names that no enclave may use. The
    second list is about names of which enclaves have only the other side.  The third list has a
    clause that holds whatever rights enclaves get.
    """
    empty, waiting = (
        [_listed_clauses(clauses)] if clauses else []
        for clauses in (
            _texts_in_all(verdict.empty for verdict in verdicts),
            _texts_in_all((*verdict.gone, *verdict.waiting) for verdict in verdicts),
        )
    )
    always = [verdicts[0].always] if all(verdict.always for verdict in verdicts) else []
    return empty, waiting, always


def _listed_clauses(clauses: Iterable[str]) -> str:
    """Return clauses in words; those that differ only in the name at their end are one clause."""
    names: dict[str, list[str]] = {}
    for clause in clauses:
        start, _, name = clause.rpartition(" ")
        names.setdefault(start, []).append(name)
    return _listed_names([f"{start} {_listed_names(ends)}" for start, ends in names.items()])


def _texts_in_all(lists: Iterable[Sequence[str]]) -> tuple[str, ...]:
    """Return the texts that are in all ``lists``, in the order of the first list."""
    first, *others = lists
    return tuple(text for text in first if all(text in other for other in others))


# ── as findings ────────────────────────────────────────────────────────────────────────────

_MOST_SHOWN = 5


def requirement_findings(requirements: Sequence[Requirement], system: System) -> list[Finding]:
    """Return a finding for each requirement that does not hold, or that cannot fail.

    Raises:
        DocumentError: there are too many wildcards to decide a requirement.
    """
    return decided_findings(decide_all(requirements, system), system)


def left_out_robot_findings(system: System, namespaces: Sequence[str]) -> list[Finding]:
    """Return a finding if requirements in ``namespaces`` leave out robots of the fleet.

    Requirements in the namespace ``/`` may be for every robot.
    """
    fleet = system.fleet() if {*namespaces} - {"/"} else None
    above = {place for namespace in namespaces for place in _with_parent_namespaces(namespace)}
    robots = fleet.robots.values() if fleet else ()
    others = sorted(robot.name for robot in robots if robot.namespace not in above)
    if not others:
        return []
    text = f"not checked for robots outside the named namespaces: {first_few(others, _MOST_SHOWN)}"
    return [ROBOTS_LEFT_OUT.found(system.file, text, system.file)]


def unused_remapping_findings(
    files: Collection[Path],
    system: System,
    namespaces: Sequence[str],
    remaps: Sequence[Remapping],
) -> list[Finding]:
    """Return a finding for each rule that changes no requirement, but perhaps should change one.

    `merge_policy` names a rule for each name that it moves, also if no requirement in ``files`` is
    about the name: then the rule is right, and there is no finding.

    Raises:
        UsageError: a rule changes no requirement, and ``system`` does not have the new name.
        SrosError: a file cannot be read.
    """
    unused = unused_remappings(files, system.fleet, namespaces, remaps) if remaps else []
    names = {right.name for right in system.rights}
    required = [
        name
        for requirement in (read_all_requirements(files, system.fleet) if unused else ())
        for name in names_of(requirement)
    ]
    other_rule = ", or another --remap moves it already" if len(remaps) > 1 else ""
    for rule in unused:
        if not has_new_name(rule, names, namespaces or ("/",)):
            raise UsageError(
                f"--remap {rule}: no requirement has the old name, and '{system.file}' does not "
                "have the new name",
                "",
                "Write both names as the requirements and the policy do, or leave --remap out.",
            )
    return [
        REMAPPING_UNUSED.found(
            system.file,
            f"--remap {rule}: no requirement has the old name{other_rule}",
            system.file,
        )
        for rule in unused
        if _may_be_wrong(rule, remaps, required)
    ]


def _may_be_wrong(rule: Remapping, rules: Sequence[Remapping], required: Iterable[str]) -> bool:
    """Return whether an unused rule perhaps misspells a name, or another rule replaces it.

    ``required`` are the full names in requirements for the namespace /.
    """
    from difflib import get_close_matches  # imported only for unused rules

    old = expand("~" if rule.renames_node else rule.old, "/", rule.node)
    moved, moved_alone = (remapped_name(old, "/", of) for of in (rules, [rule]))
    other_names = {*required} - {old}
    if rule.renames_node:
        other_names = {name.rpartition("/")[0] for name in other_names} - {old}
    return moved != moved_alone or bool(get_close_matches(old, other_names, 1))


def _with_parent_namespaces(namespace: str) -> Iterator[str]:
    """Yield a namespace and all its parent namespaces, except ``/``."""
    while namespace.strip("/"):
        yield namespace
        namespace = namespace.rpartition("/")[0]


def decided_findings(
    decided: Decisions,
    system: System,
    before: Iterable[Right] = (),
    earlier: Sequence[Requirement] = (),
) -> list[Finding]:
    """Return the findings of decisions: broken requirements first, in order.

    ``before`` are the rights before a change, which may have renamed names in requirements, and
    ``earlier`` are the requirements before it.
    """
    of_fleet = bool(decided.violations) and not system.is_keystore and system.fleet() is not None
    findings = [_violation_finding(violation, of_fleet) for violation in decided.violations]
    findings += [
        _part_finding(VACUOUS, requirement, why, _remedy_for_vacuous(requirement, system.rights))
        for requirement, why in _without_namespace_repeats(decided.vacuous)
    ]
    for kind, decisions, remedy in (
        (VACUOUS, decided.unanswered, _UNANSWERED_REMEDY),
        (MISSPELLED_ENCLAVE, decided.misspelled, ""),
        (UNKNOWN_ENCLAVE, decided.absent, ""),
        (HOLDS_ALONE, decided.holding_alone, _alone_remedy(decided.holding_alone, system)),
        (HOLDS_ALONE, decided.unanswered_alone, _UNANSWERED_ALONE_REMEDY),
    ):
        findings += [
            _part_finding(kind, requirement, why, remedy)
            for requirement, why in _without_namespace_repeats(decisions)
        ]
    if decided.unnamed:
        allowed = [right for right in before if right.qualifier is ALLOW]
        findings += [
            _unnamed_finding(*unnamed, allowed, earlier)
            for unnamed in _without_namespace_repeats(decided.unnamed)
        ]
    for only, steps in decided.by_name:
        findings += _by_name_findings(only, steps)
    findings += [_assumption_finding(*assumption) for assumption in decided.assumed]
    findings += [_not_crossing_finding(*blocked_use) for blocked_use in decided.blocked]
    if system.is_export:
        text = "only the enclaves in this export were judged: its keystore may have other enclaves"
        if decided.unjudged:
            text += (
                f", such as {first_few(decided.unjudged, _MOST_SHOWN)}, for which requirements "
                "demand rights"
            )
        if away := sorted({name for world in system.worlds for name in world.away}):
            text += f"; left out on purpose, for other machines: {first_few(away, _MOST_SHOWN)}"
        findings.append(OF_EXPORT.found(system.file, text, system.file))
    if system.left_out:
        error = system.left_out
        text = f"{error.what}: {error.why}" if error.why else error.what
        findings.append(NOT_ON_ZENOH.found(system.file, text, system.file))
    return findings


def _without_namespace_repeats(
    decided: Iterable[tuple[Requirement, tuple[str, ...]]],
) -> Iterable[tuple[Requirement, tuple[str, ...]]]:
    """Return requirements with reasons, without those that differ only in their namespace."""
    pairs = reversed([*decided])
    return reversed({(r.source, r.robot, why): (r, why) for r, why in pairs}.values())


def _violation_text(violation: Violation) -> str:
    requirement = violation.requirement
    text = f"{_violation_clause(violation)}, but {demand(requirement)}"
    if violation.worlds:
        text += f"; with {', '.join(joined_titles(violation.worlds))} only"
    if requirement.why:
        text += f": {requirement.why.rstrip('.')}"
    return text


def _subject(violation: Violation) -> str:
    """Return the subject of the finding: an enclave or a name."""
    use = violation.steps[0].use
    return use.name if isinstance(violation.requirement, AtMost | Protected) else use.enclave


_CLOSE_GOVERNANCE = (
    f"Run {REFUSE_STRANGERS} (for a policy: choose another --template), and check the requirement "
    "again."
)


def _violation_finding(violation: Violation, of_fleet: bool) -> Finding:
    requirement, steps = violation.requirement, violation.steps
    edit = _edit_text(violation, of_fleet)
    first = next((step.source for step in steps if step.source), None) or requirement.source
    others = [step for other_steps in violation.others for step in other_steps]
    named = [*steps, *others] if len(steps) > 1 else others
    related = [
        RelatedPlace(step.text(), step.source.file, step.source.line or None)
        for step in named
        if step.source
    ]
    place = requirement.source
    related.append(
        RelatedPlace(f"required: {_titled_demand(requirement)}", place.file, place.line or None)
    )
    return VIOLATED.found(
        _subject(violation),
        _violation_text(violation),
        first.file,
        first.line,
        _CLOSE_GOVERNANCE if ANYBODY in violation.witness.enclaves else edit,
        related=tuple(dict.fromkeys(related)),
    )


def _edit_text(violation: Violation, of_fleet: bool) -> str:
    """Return a sentence on the edit that makes a requirement accept its violation, or "".

    ``of_fleet`` says whether the policy has placeholders for robots.
    """
    requirement, steps, effect = violation.requirement, violation.steps, ""
    match requirement:
        case Only(enclaves=listed):
            key, enclaves = "enclaves", [violation.steps[0].use.enclave, *violation.alike]
            enclaves += [steps[0].use.enclave for steps in violation.differing]
            if (number := sum(len(names) for _, names in requirement.rights)) > 1:
                effect = f"; this allows all {number} names of the requirement"
        case Apart(through=listed, sources=sources):
            # The narrowest exception: the first enclaves that pass on what the source sends.
            key, enclaves = "through", [steps[violation.position].use.enclave, *violation.alike]
            if {*enclaves} & {*sources}:  # a source would no longer be kept apart from anything
                return ""
            if violation.position:
                effect = f"; this allows all influence through {_listed_names(enclaves)}"
        case _:
            return ""
    if requirement.robot or any(name.startswith(EXCEPT) for name in listed):
        return ""
    space = requirement.namespace.rstrip("/")
    moved = [name for name in enclaves if space and name.startswith(f"{space}/")]
    for own in (name.removeprefix(space) for name in moved):
        if any(matches(name, own) for name in listed):
            text = f"Change the policy at the named lines. To keep {own} out of {space}, as the "
            if not of_fleet:
                return f"{text}requirement says, merge its policy with `--enclave {own}`."
            first, _, rest = own[1:].partition("/")
            path = f"/{first}/{{robot}}" + (f"/{rest}" if rest else "")
            return (
                f'{text}requirement says, write path="{path}" in the policy. In a copy of the '
                f'requirement, list "/{path}", and write {{namespace}}/ before its names.'
            )
    if moved:
        effect += f"; there, a name with one / at its beginning is below {space}"
    outside = sorted(name for name in enclaves if not name.startswith(f"{space}/"))
    stays = space and not any(name.startswith(f"{space}/") for name in (*enclaves, *listed))
    if of_fleet and stays and isinstance(requirement, Only):
        patterns = {_with_placeholder(name, space[1:]) for name in outside}
        if patterns.isdisjoint(outside):
            quoted = [f'"/{name}"' for name in sorted(patterns)]
            return (
                "Change the policy at the named lines; or, to allow this on each robot, list "
                f"{first_few(quoted, _MOST_SHOWN)} in a copy of the requirement, and write "
                f"{{namespace}}/ before its names{effect}."
            )
    if outside:
        effect += "; if a package ships the file, write this only into a copy"
    written = {
        name.removeprefix(space) if name.startswith(f"{space}/") else f"/{name}"
        for name in enclaves
    }
    place, quoted = requirement.source, [f'"{name}"' for name in sorted(written)]
    return (
        "Change the policy at the named lines; or, to allow this, add "
        f"{first_few(quoted, _MOST_SHOWN)} to `{key}` of the requirement at "
        f"{place.file}:{place.line}{effect}."
    )


def _with_placeholder(enclave: str, name: str) -> str:
    """Return an enclave's name with ``{robot}`` in place of each part that is a robot's name."""
    return "/".join("{robot}" if part == name else part for part in enclave.split("/"))


def _titled_demand(requirement: Requirement) -> str:
    name = f"{requirement.name}: " if requirement.name else ""
    return f"{name}{demand(requirement)}"


def short_text(violation: Violation) -> str:
    """Return the violation in short, such as ``/teleop may publish /cmd_vel``.

    The chain of an influence is left out, and further enclaves are only counted.
    """
    match violation.requirement:
        case AtMost():
            text = _clause(violation)
        case Protected(level=level):
            text = f"messages of {_subject(violation)} are not {_protection_word(level)}"
        case _:
            text = f"{_subject(violation)} {_clause(violation)}"
    more = 0 if violation.position else len(violation.witness.others)
    others = counted(more, "other enclave breaks", "other enclaves break")
    return f"{text}, and {others} the requirement" if more else text


def _violation_clause(violation: Violation) -> str:
    """Return a clause that states a violation, without the subject of the finding."""
    match violation.requirement:
        case Apart():
            text = f"{_clause(violation)}: {_chain_text(violation.steps)}"
            how = "through" if violation.position else "from"
            names = violation.alike
            return f"{text} (also {how} {_listed_names(names)})" if names else text
        case Must() | Protected():
            return _clause(violation)
        case _:
            return f"{_clause(violation)}{_other_violators_clauses(violation)}"


def _clause(violation: Violation) -> str:
    steps = violation.steps
    match violation.requirement:
        case Apart():
            return f"influences {steps[-1].use.enclave}"
        case Must():
            if violation.missing:
                return "does not exist"
            if violation.idle:
                return "cannot start with its current files (`sros check` shows why)"
            return f"may not {steps[0].action_text()}"
        case Protected(level=level):
            return f"its messages are not {_protection_word(level)}"
        case AtMost():
            return _joined_steps_text(steps)
        case NotBoth():
            return f"may {steps[0].action_text()} and {steps[1].action_text()}"
        case _:
            return f"may {steps[0].action_text()}"


def _protection_word(level: Level) -> str:
    return "encrypted" if level is Level.ENCRYPT else "signed"


def _chain_text(steps: Sequence[Step]) -> str:
    """Return a chain of steps as text, such as ``/a -publish /x-> /b -publish /y-> /c``."""
    hops = zip(steps[::2], steps[1::2], strict=True)
    return " ".join(
        (
            steps[0].use.enclave,
            *(f"-{step.action_text()}-> {heard.use.enclave}" for step, heard in hops),
        )
    )


def _joined_steps_text(steps: Sequence[Step]) -> str:
    """Return text such as ``/a and /b may publish /x``; different uses are listed one by one."""
    if len({step.action_text() for step in steps}) > 1:
        return _listed_names([step.text() for step in steps])
    return f"{_listed_names([step.use.enclave for step in steps])} may {steps[0].action_text()}"


def _other_violators_clauses(violation: Violation) -> str:
    """Return clauses on the further enclaves that break a requirement; "" for none."""
    similar, differing = violation.alike, violation.differing
    text = f", and so may {_listed_names(similar)}" if similar else ""
    for steps in differing:
        text += f"; {steps[0].use.enclave} may {' and '.join(step.action_text() for step in steps)}"
    more = len(violation.witness.others) - len(similar) - len(differing)
    others = counted(more, "more enclave breaks", "more enclaves break")
    return f"{text}; {others} the requirement, too" if more else text


def _listed_names(names: Sequence[str], word: str = "and") -> str:
    if len(names) > _MOST_SHOWN:
        names = (*names[:_MOST_SHOWN], f"{len(names) - _MOST_SHOWN} more")
    *first, last = names
    return f"{', '.join(first)} {word} {last}" if first else last


def _part_finding(
    kind: FindingKind, requirement: Requirement, why: Sequence[str], remedy: str = ""
) -> Finding:
    place = requirement.source
    text = f"{'; '.join(why)}; required: {demand(requirement)}"
    return kind.found(place.file, text, place.file, place.line, remedy)


def _by_name_findings(requirement: Only, steps: Iterable[Step]) -> Iterator[Finding]:
    """Yield findings on enclaves that a requirement allows only by a pattern for any package."""
    patterns = patterns_of_any_package(requirement)
    # Without a namespace, the robot's own enclaves have a name that does not move.
    fixed = {*requirement.unmoved, *(name for name in patterns if name.startswith("/"))}
    anywhere = [name for name in patterns if name not in fixed]
    elsewhere, unmoved = [], []
    for step in steps:
        if not any(covers(name, step.use.enclave) for name in fixed):
            elsewhere.append(step)
        elif step.use.enclave not in requirement.enclaves:
            unmoved.append(step)
    if elsewhere:
        yield _by_name_finding(requirement, anywhere, elsewhere)
    if unmoved:
        yield _by_name_finding(requirement, [f"/{name}" for name in requirement.unmoved], unmoved)


def _by_name_finding(requirement: Only, patterns: Sequence[str], steps: Sequence[Step]) -> Finding:
    allowed = _listed_names([step.use.enclave for step in steps])
    text = f"{first_few(patterns, 3)} allows this to {allowed}"
    related = [
        RelatedPlace(step.text(), step.source.file, step.source.line or None)
        for step in steps[:_MOST_SHOWN]
        if step.source
    ]
    place = requirement.source
    text += f"; required: {demand(requirement)}"
    return ALLOWED_BY_NAME.found(
        place.file, text, place.file, place.line, related=tuple(dict.fromkeys(related))
    )


def _alone_remedy(
    holding_alone: Iterable[tuple[Requirement, tuple[str, ...]]], system: System
) -> str:
    if not any(
        _has_all_enclaves(requirement, system) or not requirement.is_relative
        for requirement, _ in holding_alone
    ):
        return ""
    what = "keystore" if system.is_keystore else "robot"
    return (
        f"No enclave of this {what} can break the requirement now. Ignore this finding, unless a "
        "name in it was changed: then change the name in the requirement, too."
    )


_NOBODY_REMEDY = (
    "Correct the name, or its kind (service or action). After `merge_policy --remap`, check with "
    "the same --remap."
)

_UNANSWERED_REMEDY = (
    "If the name was changed, change it in the requirement, too; after `merge_policy --remap`, "
    "check with the same --remap. If another policy of the robot has the other side of the name, "
    "name all policies in one command."
)

_UNANSWERED_ALONE_REMEDY = (
    "Ignore this finding if nodes of the package's users have the other side. If the name was "
    "changed, write the new name into the requirement, or check with the --remap of `merge_policy`."
)

_ENCLAVES_REMEDY = (
    "Correct the names of the enclaves, or the exceptions. For enclaves that come and go, such as "
    "laptops, write [[only]]."
)


def _remedy_for_vacuous(requirement: Requirement, rights: Iterable[Right]) -> str:
    """Return a remedy that fits better than the remedy of `VACUOUS`; "" if there is none."""
    if other_namespace := _namespace_remedy(requirement, rights):
        return other_namespace
    match requirement:
        case Nobody():
            return _NOBODY_REMEDY
        case Widest() | NothingBut() | Apart():
            return _ENCLAVES_REMEDY
        case _:
            return ""


def _namespace_remedy(requirement: Requirement, rights: Iterable[Right]) -> str:
    """Return a remedy if the rights have a requirement's name only in other namespaces, or "".

    Only requirements with relative names have this remedy.
    """
    names = _names_that_move(requirement)
    if not names:
        return ""
    allowed = [right for right in rights if right.qualifier is ALLOW]
    stated = {right.name for right in allowed}
    absent = (name for name in names if name not in stated)
    was_moved = requirement.elsewhere is None
    for name in absent:
        space = requirement.namespace
        if was_moved and (own := name.removeprefix(space.rstrip("/"))) in stated:
            return (
                f"The policy names {own} without the namespace, as the policy of a package does: "
                f"leave out `--namespace {quote(space)}`, or check the policy of a robot into "
                "which the policy of the package was merged."
            )
        if not was_moved and (namespaces := sorted(_namespaces_with(name, requirement, allowed))):
            options = " ".join(f"--namespace {quote(ns)}" for ns in namespaces[:_MOST_SHOWN])
            return (
                f"The policy names {namespaces[0]}{name}. If these are the requirements of a "
                f"package, check them with its namespace on the robot: `{options}`. Otherwise, "
                "correct the name, here or in the policy."
            )
    return ""


def _names_that_move(requirement: Requirement) -> list[str]:
    """Return the names in a requirement with relative names, or []."""
    match requirement:
        case Requirement(is_relative=False):
            return []
        case RightsRequirement():
            return [name for _, of_right in requirement.rights for name in of_right]
        case Protected():
            return [name for _, name in requirement.names]
        case _:
            return []


def _namespaces_with(name: str, requirement: Requirement, allowed: Collection[Right]) -> set[str]:
    """Return the namespaces, except ``/``, in which names of rights end with ``name``.

    If an enclave of the requirement, or of the node in ``name``, is in some of them, the result has
    only these: in the others, another package may have the name.
    """
    moved = {of.name.removesuffix(name) for of in allowed if of.name.endswith(name)}
    found = {namespace for namespace in moved if namespace and not is_expression(namespace)}
    patterns = enclaves_of(requirement.elsewhere) if found and requirement.elsewhere else ()
    own = [of.removeprefix(OTHER_NAMESPACE) for of in patterns if of.startswith(OTHER_NAMESPACE)]
    own.append(name.rpartition("/")[0])
    enclaves = {right.enclave for right in allowed} if found else ()
    return {ns for ns in found if any(of and ns + of in enclaves for of in own)} or found


def common_namespaces(requirements: Iterable[Requirement], rights: Iterable[Right]) -> set[str]:
    """Return the namespaces, except ``/``, in which rights have a name of every requirement.

    Only requirements with relative names count, and of these only names without wildcards.
    """
    allowed = [right for right in rights if right.qualifier is ALLOW]
    common: set[str] | None = None
    for requirement in requirements:
        names = _names_that_move(requirement)
        if all(map(is_expression, names)):
            continue
        namespaces = set[str]().union(
            *(_namespaces_with(name, requirement, allowed) for name in names)
        )
        common = namespaces if common is None else common & namespaces
    return common or set()


_GONE_REMEDY = (
    "If the name was changed, change it in the requirement, too. If nobody uses the name any more, "
    "remove the requirement, and approve its removal in the review."
)


def _unnamed_finding(
    requirement: Requirement,
    names: Sequence[str],
    allowed_before: Iterable[Right],
    earlier: Sequence[Requirement],
) -> Finding:
    if isinstance(requirement, Nobody):
        # Neither a forbidden right that is gone, nor a name that only the change forbids, shows a
        # renaming.
        forbidden = {right for right, _ in requirement.rights}
        forbidden_before = names_demanded_by(earlier, requirement)
        allowed_before = [
            right
            for right in allowed_before
            if right.right not in forbidden and right.name in forbidden_before
        ]
    known_before = {f"{right.kind.removesuffix('s')} {right.name}" for right in allowed_before}
    if gone := [name for name in names if name in known_before]:
        why = f"no right is stated for {_listed_names(gone)} any more"
        return _part_finding(VACUOUS, requirement, [why], _GONE_REMEDY)
    return _part_finding(UNNAMED, requirement, [f"no right is stated for {_listed_names(names)}"])


def _assumption_finding(requirement: Requirement, name: str) -> Finding:
    place = requirement.source
    text = f"{demand(requirement)}: {assumption_text(name)}"
    return ASSUMED.found(place.file, text, place.file, place.line)


def _not_crossing_finding(requirement: Requirement, blocked_use: BlockedUse) -> Finding:
    place, use, peers = requirement.source, blocked_use.use, _listed_names(blocked_use.others)
    ends = f"from {use.enclave} to {peers}" if use.writes else f"from {peers} to {use.enclave}"
    text = f"the routers do not pass {use.name} {ends}: {demand(requirement)}"
    return NOT_CROSSING.found(place.file, text, place.file, place.line)


def assumption_text(name: str) -> str:
    """Return a clause which says that the protection of a name is assumed, not stated."""
    assumed = f"sros assumes the template {DEFAULT_TEMPLATE}"
    return f"the policy does not say how {name} is protected; {assumed}"
