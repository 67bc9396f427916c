"""Read the sources of pictures: policies, permissions, keystores and observations.

A picture shows only the base name of a source, because paths of this machine are private. Keys of
enclaves are read only to report faults, such as a key that does not fit its certificate.
"""

from __future__ import annotations

import os
import re
from collections import defaultdict
from collections.abc import Callable, Container, Iterable, Iterator, Mapping, Sequence, Set
from contextlib import suppress
from dataclasses import dataclass, replace
from datetime import datetime, tzinfo
from pathlib import Path
from typing import TYPE_CHECKING

from cryptography import x509

from sros_tool.dds.governance import Governance
from sros_tool.dds.permissions import Grant
from sros_tool.errors import DocumentError, SrosError, UsageError
from sros_tool.fleet.expansion import FleetPolicy
from sros_tool.fleet.robots import Fleet, Robot, robot_of
from sros_tool.graph.learn import learn
from sros_tool.graph.observation import observation_from_json
from sros_tool.keystore.fleet import load_fleet
from sros_tool.keystore.known_keys import KnownKeys
from sros_tool.keystore.layout import PUBLIC, ROUTER_FILE, is_keystore
from sros_tool.keystore.participant import evaluate_enclave
from sros_tool.keystore.protection import governance_with_stated_protections
from sros_tool.keystore.reader import OpenedEnclave, OpenedKeystore, open_enclave
from sros_tool.keystore.rights import (
    RightsSource,
    is_zenoh,
    load_rights,
    notes_on_hidden_enclaves,
    rights_by_domains,
)
from sros_tool.keystore.template import load_template
from sros_tool.pki.certificates import authority_text, load_certificates, subject_text, validity_of
from sros_tool.pki.keys import algorithm
from sros_tool.policy.document import read_policy
from sros_tool.policy.minimize import enclaves_of_nodes, moved_to_enclaves
from sros_tool.policy.patterns import Names
from sros_tool.policy.rights import RightsDifference, policy_rights
from sros_tool.report.compose import PictureSource, compose, overlay, union, with_requirements
from sros_tool.report.focus import focused_picture
from sros_tool.report.folding import Folding, name_order, units_of
from sros_tool.report.formats import render_mermaid
from sros_tool.report.layout import scenes_of
from sros_tool.report.picture import (
    Picture,
    PicturedEnclave,
    PicturedFinding,
    PicturedUse,
    PicturedViolation,
    Requirements,
    SourceTitle,
    Validity,
)
from sros_tool.report.sampling import SampledKeystore, sample_of
from sros_tool.validity import iso
from sros_tool.values import parse_json
from sros_tool.wording import enumerated, first_few
from sros_tool.xml import read_bytes

if TYPE_CHECKING:
    from sros_tool.checks.kind import Finding

_LINK = re.compile(r"(it is a broken link) \([^)]*\)")
_AUTHORITY_FILES = "*_ca.cert.pem"


@dataclass(frozen=True, slots=True)
class PictureRequest:
    """What a picture should show: one source, or two sources to compare, and options.

    ``sources`` are paths of policies, permissions, enclaves, keystores or observations;
    ``observed`` are paths of observations to compare with a single source.  ``template`` is the
    keystore template that decides the protection in a policy's picture; ``hosts`` are texts
    ``HOST=ENCLAVE``; ``fleets`` has, for each source, the fleet whose robots fill in the
    placeholders; ``focus`` are names or paths of enclaves.  With ``checked``, the picture has the
    findings of ``sros check``; with a file of ``requirements``, also the rights that break a
    requirement.  Dates in permissions are read in the time zone ``zone``.  With ``sampled``, only
    some of many equal robots, namespaces or enclaves in a large keystore are read in full, and all
    robots in ``robots``.
    """

    sources: Sequence[Path]
    now: datetime
    zone: tzinfo
    observed: Sequence[Path] = ()
    template: str | None = None
    hosts: Sequence[str] = ()
    fleets: tuple[Fleet | None, Fleet | None] = (None, None)
    focus: Sequence[str] = ()
    requirements: Path | None = None
    checked: bool = False
    sampled: bool = False
    robots: Sequence[str] = ()


def draw(request: PictureRequest) -> tuple[Picture, Folding]:
    """Return a picture, and the same picture with equal units drawn once.

    Equal units are robots, namespaces or enclaves that differ only in their names.

    Raises:
        UsageError: there are too many sources, or an option does not fit them.
        SrosError: a source or the requirements cannot be read.
    """
    sources, fleets = request.sources, request.fleets
    if len(sources) > 2 or (request.observed and len(sources) > 1):
        raise UsageError(
            "at most two sources can be compared",
            "",
            "Name one SOURCE and --observed, or two SOURCEs.",
        )
    titles = _titles([*sources, *request.observed])
    read = [
        _read_source(path, fleet, request, title).with_title(title)
        for path, fleet, title in zip(sources, fleets, titles, strict=False)
    ]
    observed = [read_source(path, now=request.now) for path in request.observed]
    if request.template:
        _check_no_governance(sources, read)
        protection = load_template(request.template).protection
        read = [
            source
            if source.governance
            else replace(
                source,
                governance=governance_with_stated_protections(protection, source.protections),
            )
            for source in read
        ]
    robots: dict[str, Robot] = {}
    for path, fleet, source in zip(sources, fleets, read, strict=False):
        robots |= _robots(path, fleet, source)
    places = {enclave: robot.name for enclave, robot in robots.items()}
    hosts = places | _hosts(request.hosts)
    if observed:
        titled = map(PictureSource.with_title, observed, titles[len(read) :])
        observation = union([_in_enclaves_of(read[0], source) for source in titled])
        enclave_of = enclaves_of_nodes(observation.nodes, read[0].nodes)
        read.append(observation.moved_to_homes(enclave_of))
    picture = _compared_picture(read, hosts, use=bool(request.observed))
    governed = [source.governance for source in read if source.governance]
    if len(governed) == 2 and governed[0] != governed[1]:
        text = (
            "the sources differ in governance: the picture has the governance of the second one, "
            "and `sros inspect` shows each."
        )
        finding = PicturedFinding("view.governance-differs", "warning", text)
        picture = replace(picture, findings=(*picture.findings, finding))
    if len(domains := {enclave.domains for enclave in picture.enclaves} - {""}) > 1:
        several = enumerated(sorted(domains))
        text = f"enclaves are for different ROS domains ({several}), and a name is drawn once for "
        text += "all of them. Information goes only between enclaves with a common domain"
        if any(_rights_differ_by_domain(source) for source in read):
            text += "; on a page, a click treats each right as if it held in all domains of its "
            text += "enclave (--focus treats each right only in its own domains)"
        text += "."
        finding = PicturedFinding("view.domains", "note", text)
        picture = replace(picture, findings=(*picture.findings, finding))
    if request.focus:
        routers = max(_routers(source.keystore) for source in read)
        picture = focused_picture(picture, read, request.focus, routers)
    if request.requirements:
        picture = _with_requirements(picture, request.requirements, request, read[0].keystore)
    folding = Folding.of(picture, robots)
    return replace(picture, equal=folding.equal, different=folding.different), folding


def _rights_differ_by_domain(source: PictureSource) -> bool:
    """Return whether an enclave has different rights in different ROS domains."""
    enclaves = [{right.enclave for right in rights} for rights in source.in_domains.values()]
    return sum(map(len, enclaves)) > len(set[str]().union(*enclaves))


def _routers(keystore: OpenedKeystore | None) -> int:
    """Return the number of Zenoh routers whose files a keystore has."""
    if keystore is None:
        return 0
    return sum((keystore.folder(name) / ROUTER_FILE).exists() for name in keystore.names)


def _compared_picture(
    sources_read: Sequence[PictureSource], hosts: Mapping[str, str], *, use: bool
) -> Picture:
    """Return the picture of one source, or the comparison of two sources.

    The kind of comparison is "use" if ``use`` is set, or if the second source was observed;
    "change" for two sources of the same kind, "worlds" if a source is for Zenoh, and else "drift"
    (of a keystore from its policy).
    """
    if len(sources_read) == 1:
        return compose(sources_read[0], hosts)
    first, second = sources_read
    kinds = [source.origin.kind for source in sources_read]
    if use or kinds[1] == "observation":
        return overlay(first, second, "use", hosts)
    if kinds[0] == kinds[1]:
        return overlay(first, second, "change", hosts)
    if "zenoh" in kinds:
        first, second = sorted(sources_read, key=lambda source: source.origin.kind == "zenoh")
        return overlay(first, second, "worlds", hosts)
    # For drift, the policy is the first side, in whatever order the sources were named.
    first, second = sorted(sources_read, key=lambda source: source.origin.kind != "policy")
    return overlay(first, second, "drift", hosts)


def _read_source(
    path: Path, fleet: Fleet | None, request: PictureRequest, title: str
) -> PictureSource:
    """Read a source, with findings of ``sros check`` if ``request`` asks for them.

    A source that ``sros check`` does not read has the finding ``view.not-checked`` instead.
    Findings name files with the folders that ``title`` has.
    """
    folders = title.removesuffix(_base_name(path))

    def shown(file: str) -> str:
        return folders + os.path.relpath(file, path.parent) if folders else _file_name(file)

    sample = _sample(path, request)
    source = read_source(path, now=request.now, fleet=fleet, sample=sample)
    if not request.checked:
        return source
    if source.origin.kind == "observation":
        text = "`sros check` does not check what was observed."
        return replace(source, findings=(*source.findings, _not_checked_finding(text)))
    from sros_tool.checks.keystores.opened import Circumstances
    from sros_tool.checks.policies.policy import policy_file_findings
    from sros_tool.checks.targets import path_findings

    at = Circumstances(
        request.now, request.zone, fleet=fleet, sample=sample.enclaves if sample else None
    )
    if source.keystore:
        at.opened[path] = source.keystore
    try:
        findings = (
            list(policy_file_findings(path, fleet=fleet, policy=source.policy))
            if source.policy and path.is_file()
            else path_findings([path], at)
        )
    except SrosError as error:
        text = f"`sros check` cannot read {title}, so nothing in it was checked: {error.what}."
        return _with_findings(source, path, [_not_checked_finding(text)])
    pictured = [_pictured_finding(finding, {finding.subject}, shown) for finding in findings]
    return _with_findings(source, path, pictured)


def _not_checked_finding(text: str) -> PicturedFinding:
    return PicturedFinding("view.not-checked", "note", text)


def _sample(path: Path, request: PictureRequest) -> SampledKeystore | None:
    """Return the enclaves of a keystore to read in full; None for sources of other kinds.

    Raises:
        UsageError: ``request`` names a robot that the keystore lacks, or the source is no keystore.
    """
    if not (path.is_dir() and is_keystore(path)):
        if request.robots:
            raise UsageError("--robot is for a keystore only", "", "Leave it out.")
        return None
    keystore = OpenedKeystore(path)
    fleet = load_fleet(keystore)
    robots = _robots_of(fleet, keystore.names) if fleet else {}
    known = {unit.name for unit in units_of(keystore.names, robots)}
    for name in request.robots:
        if name not in known:
            raise UsageError(
                f"'{path}' has no enclaves of a robot {name!r}",
                "",
                f"It has {first_few(sorted(known, key=name_order), 5)}." if known else "",
            )
    draw_whole = not request.sampled or request.focus or request.requirements or request.observed
    if draw_whole or len(request.sources) > 1:
        return SampledKeystore(keystore, keystore.names)
    return sample_of(keystore, robots, request.robots)


def drawn_difference(
    first_source: RightsSource,
    second_source: RightsSource,
    difference: RightsDifference,
    *,
    letters: int,
    arrows: int,
) -> str | None:
    """Return a Mermaid diagram of added and removed rights, and of other rights to the same names.

    Args:
        first_source: the rights before.
        second_source: the rights after.
        difference: the rights that only one source has.
        letters: the maximum length of the diagram, in characters.
        arrows: the maximum number of arrows.

    Returns None if the diagram is too large, and "" if the sources are equal or of different kinds.
    """
    if first_source.kind != second_source.kind or not difference:
        return ""
    changed = (*difference.only_first, *difference.only_second)
    names = Names.by_key((right.kind, right.name) for right in changed)

    def titled_source(title: str, source: RightsSource) -> PictureSource:
        used = frozenset(
            right
            for right in source.rights
            if right.kind in names and names[right.kind].overlaps(right.name)
        )
        return PictureSource(SourceTitle(title, source.kind), used, scope=source.scope)

    before, after = (
        titled_source(title, source)
        for title, source in (("before", first_source), ("after", second_source))
    )
    picture = overlay(before, after, "change")
    scenes = scenes_of(picture, with_places=False)
    scene = next((scene for scene in scenes if scene.id == "all"), scenes[0])
    text = render_mermaid(picture, scene)
    return None if len(text) > letters or len(scene.links) > arrows else text


def _check_no_governance(sources: Sequence[Path], sources_read: Sequence[PictureSource]) -> None:
    """Raise `UsageError` if --template is used with a source that has a governance."""
    for path, source in zip(sources, sources_read, strict=True):
        kind = source.origin.kind
        if kind in ("keystore", "enclave"):
            raise UsageError(
                f"--template does not fit '{path}'",
                f"It is {'an' if kind == 'enclave' else 'a'} {kind}, which is drawn with its own "
                "governance; a template is for policies, which have no governance.",
                "Leave --template out, or name only the policy.",
            )


def _hosts(words: Iterable[str]) -> dict[str, str]:
    """Map the path of each enclave in texts ``HOST=ENCLAVE`` to its host.

    Raises:
        UsageError: a text has another form.
    """
    hosts = {}
    for word in words:
        host, equals, enclave = word.partition("=")
        if not equals or not host or not enclave.startswith("/"):
            raise UsageError(
                f"--host {word!r} is not HOST=ENCLAVE",
                "",
                "Write for example --host arm=/robot/arm.",
            )
        hosts[enclave.rstrip("/") or "/"] = host
    return hosts


def _robots(path: Path, fleet: Fleet | None, source: PictureSource) -> dict[str, Robot]:
    """Map the paths of a source's enclaves to the robots of these enclaves.

    Enclaves of no robot are left out; without a fleet, the result is empty.
    """
    if source.keystore:
        fleet = load_fleet(source.keystore)
    elif fleet and source.origin.kind == "policy":
        written = read_policy(path, placeholders=True)
        fleet = fleet.with_enclaves(FleetPolicy(written, fleet).patterns)
    if fleet is None:
        return {}
    return _robots_of(fleet, {right.enclave for right in source.rights})


def _robots_of(fleet: Fleet, enclaves: Iterable[str]) -> dict[str, Robot]:
    return {name: robot for name in enclaves if (robot := robot_of(fleet, name))}


def _with_requirements(
    picture: Picture, file: Path, request: PictureRequest, keystore: OpenedKeystore | None
) -> Picture:
    """Return the picture with the rights that break requirements, as ``sros check`` decides.

    Raises:
        UsageError: there are two sources.
        SrosError: the requirements cannot be read.
    """
    from sros_tool.checks.keystores.opened import Circumstances
    from sros_tool.proof.findings import assumption_text, decide_all, decided_findings, short_text
    from sros_tool.proof.requirements import Must, demand, read_requirements
    from sros_tool.proof.system import load_system

    if len(request.sources) > 1:
        raise UsageError("--requirements takes one policy or keystore", "", "Name only one SOURCE.")
    at = Circumstances(request.now, request.zone, fleet=request.fleets[0])
    if keystore:
        at.opened[request.sources[0]] = keystore
    template = load_template(request.template) if request.template else None
    system = load_system(request.sources[0], at, template)
    stated = read_requirements(file, system.fleet)
    decided = decide_all(stated, system)
    findings = decided_findings(decided, system)
    violations = tuple(
        PicturedViolation(
            _finding_text(finding, finding.subject),
            short_text(violation),
            tuple(
                PicturedUse(step.use.enclave, *step.stated_form())
                for step in violation.steps
                # What an enclave may not do, but must, is no right that could be drawn.
                if step.place and step.use.right and not isinstance(violation.requirement, Must)
            ),
        )
        for violation, finding in zip(decided.violations, findings, strict=False)
    )
    assumed = tuple(
        f"{demand(requirement)}: {assumption_text(name)}" for requirement, name in decided.assumed
    )
    judged = [
        requirement
        for requirement in stated
        if not (isinstance(requirement, Must) and requirement.enclave in decided.unjudged)
    ]
    requirements = Requirements(len(judged) - len(violations), violations, assumed)
    paths = {enclave.path for enclave in picture.enclaves}
    pictured = tuple(_pictured_finding(finding, paths) for finding in findings)
    picture = replace(picture, findings=(*picture.findings, *pictured))
    return with_requirements(picture, requirements)


def _file_name(path: str) -> str:
    return Path(path).name


def _pictured_finding(
    finding: Finding, enclaves: Container[str], shown: Callable[[str], str] = _file_name
) -> PicturedFinding:
    """Return a finding for the picture; its text names the subject, unless it is in ``enclaves``.

    ``shown`` returns the name of a file.
    """
    known = finding.subject in enclaves
    about = "" if known or finding.subject == finding.file else finding.subject
    text = _finding_text(finding, about, shown)
    enclave = finding.subject if known else ""
    return PicturedFinding(finding.id, finding.severity.word, text, finding.remedy, enclave)


def _finding_text(finding: Finding, subject: str, shown: Callable[[str], str] = _file_name) -> str:
    """Return a finding as one text: file name, line, subject and text."""
    place = f"{shown(finding.file)}:{finding.line}" if finding.line else ""
    return ": ".join(filter(None, (place, subject, finding.text)))


# ── one source ─────────────────────────────────────────────────────────────────────────────


def _in_enclaves_of(source: PictureSource, observed: PictureSource) -> PictureSource:
    """Return an observed source with its nodes moved to their enclaves in ``source``."""
    if observed.policy is None:
        return observed
    moved, _ = moved_to_enclaves(observed.policy, source.nodes)
    return replace(observed, rights=policy_rights(moved), nodes=moved.nodes())


def read_source(
    path: Path, *, now: datetime, fleet: Fleet | None = None, sample: SampledKeystore | None = None
) -> PictureSource:
    """Read a policy, permissions, an enclave, a keystore or an observation at ``path``.

    An observation is a learned policy, or the output of ``sros generate_policy --json``.  Faults of
    a keystore become findings.  ``fleet`` has the robots that fill in placeholders of a policy,
    ``sample`` the enclaves of a keystore to read (None: all).

    Raises:
        DocumentError: ``path`` is none of these.
    """
    data = read_bytes(path, "file") if path.is_file() else b""
    if data.lstrip()[:1] == b"{" and not is_zenoh(data, path):
        return _read_observation(path)
    if sample is None and path.is_dir() and is_keystore(path):
        keystore = OpenedKeystore(path)
        sample = SampledKeystore(keystore, keystore.names)
    if sample:
        read = load_rights(sample.keystore, only_enclaves=sample.enclaves)
        notes = (*read.notes, *notes_on_hidden_enclaves(path))
        read = replace(read, rights=sample.without_unread_units(read.rights), notes=notes)
    else:
        read = load_rights(path, fleet)
    findings = tuple(PicturedFinding(note.id, "warning", note.text) for note in read.notes)
    source = PictureSource(
        SourceTitle(_base_name(path), read.kind),
        read.rights,
        findings=findings,
        scope=read.scope,
        in_domains=rights_by_domains(read),
    )
    if read.policy:
        nodes, stated = read.policy.nodes(), read.protections or ()
        source = replace(source, nodes=nodes, protections=stated, policy=read.policy)
    elif sample:
        source = _with_keystore(source, sample, now)
    elif read.kind == "enclave":
        source = _with_enclave(source, path, now)
    places = _file_names(path)
    return replace(
        _with_findings(replace(source, findings=()), path, source.findings),
        enclaves=tuple(
            replace(
                enclave, problems=tuple(_without_path(text, places) for text in enclave.problems)
            )
            for enclave in source.enclaves
        ),
    )


def _with_findings(
    source: PictureSource, path: Path, findings: Iterable[PicturedFinding]
) -> PictureSource:
    """Return ``source`` with more findings, in whose texts the file name replaces the path.

    A finding keeps its enclave only if the source has an enclave of that name.
    """
    known = {enclave.path for enclave in source.enclaves} | {
        right.enclave for right in source.rights
    }
    places = _file_names(path)
    attached = tuple(
        _without_paths(_without_unknown_enclave(finding, known), places) for finding in findings
    )
    return replace(source, findings=tuple(dict.fromkeys((*source.findings, *attached))))


def _titles(paths: Sequence[Path]) -> list[str]:
    """Return the file names of sources, with folders as far as needed to distinguish them."""
    parts = [path.absolute().parts[1:] for path in paths]
    titles = []
    for path, own in zip(paths, parts, strict=True):
        others = [other for other in parts if other != own]
        shown = 1
        while shown < len(own) and any(other[-shown:] == own[-shown:] for other in others):
            shown += 1
        titles.append("/".join((*map(_printable, own[-shown:-1]), _base_name(path))))
    return titles


def _base_name(path: Path) -> str:
    """Return the file name of a source, without unprintable characters."""
    return _printable(path.absolute().name or "/")


def _printable(name: str) -> str:
    """Return a name in which U+FFFD replaces unprintable characters."""
    return "".join(
        letter if letter.isprintable() else "\N{REPLACEMENT CHARACTER}" for letter in name
    )


def _read_observation(path: Path) -> PictureSource:
    try:
        observed = observation_from_json(parse_json(read_bytes(path, "file")))
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise DocumentError(
            f"'{path}' is not an observation",
            "It contains JSON, but not the output of `sros generate_policy --json`.",
        ) from error
    learned = learn(observed)
    policy = learned.policy()
    notes = tuple(PicturedFinding(note.id, "note", note.text) for note in learned.notes)
    return PictureSource(
        SourceTitle(_base_name(path), "observation"),
        policy_rights(policy),
        policy.nodes(),
        findings=notes,
    )


# ── keystores ──────────────────────────────────────────────────────────────────────────────


def _with_keystore(source: PictureSource, sample: SampledKeystore, now: datetime) -> PictureSource:
    keystore = sample.keystore
    findings = list(source.findings)
    governances: list[Governance | None] = []
    problem = None
    try:
        governances.append(keystore.governance)
    except SrosError as error:  # an export has the governance in the folders of its enclaves
        problem = PicturedFinding("view.no-governance", "error", str(error))
    enclaves, validities = [], set()
    for name in sample.enclaves:
        opened = keystore.enclave(name, now=now)
        evaluation = evaluate_enclave(name, keystore.folder(name), opened, moment=now)
        enclaves.append(_pictured_enclave(name, evaluation.state, evaluation.problems))
        validities |= set(_validities_of(name, evaluation.state))
        governances.append(evaluation.state.governance)
    governance = _joint_governance(governances)
    if problem and governance is None:
        findings.append(problem)
    try:
        validities |= set(_authority_validities(keystore))
    except SrosError as error:
        findings.append(PicturedFinding("view.no-authorities", "error", str(error)))
    revoked: Sequence[str] = ()
    with suppress(SrosError):  # `check` reports a ledger that cannot be read
        revoked = KnownKeys(keystore).revoked_enclaves()
    return replace(
        source,
        keystore=keystore,
        revoked=tuple(revoked),
        unread=sample.unread,
        enclaves=tuple(enclaves),
        governance=governance,
        validities=tuple(sorted(validities)),
        findings=tuple(findings),
    )


def _joint_governance(governances: Iterable[Governance | None]) -> Governance | None:
    """Return the union of all governance documents, or None if there are none.

    Access that any document opens is open in the union.
    """
    distinct = [governance for governance in dict.fromkeys(governances) if governance is not None]
    if len(distinct) < 2:
        return distinct[0] if distinct else None
    return Governance(
        tuple(rule for governance in distinct for rule in governance.domain_access_rules)
    )


def _with_enclave(source: PictureSource, folder: Path, now: datetime) -> PictureSource:
    name = next(iter(sorted(source.scope or ())), _base_name(folder))
    evaluation = evaluate_enclave(name, folder, open_enclave(folder, now=now), moment=now)
    state = evaluation.state
    return replace(
        source,
        enclaves=(_pictured_enclave(name, state, evaluation.problems_here),),
        governance=state.governance,
        validities=tuple(sorted(_validities_of(name, state))),
    )


def _pictured_enclave(
    enclave: str, state: OpenedEnclave, problems: tuple[str, ...]
) -> PicturedEnclave:
    certificate = state.certificate
    if certificate is None:
        return PicturedEnclave(enclave, "", problems=problems)
    return PicturedEnclave(
        enclave,
        "",
        subject=subject_text(certificate.subject),
        issuer=subject_text(certificate.issuer),
        serial=f"{certificate.serial_number:x}",
        key=algorithm(certificate.public_key()),
        problems=problems,
    )


def _validities_of(enclave: str, state: OpenedEnclave) -> Iterator[Validity]:
    if state.certificate:
        yield _certificate_validity(state.certificate, "certificate", enclave, enclave)
    for grant in state.permissions.grants if state.permissions else ():
        yield _grant_validity(grant, enclave)


def _grant_validity(grant: Grant, enclave: str) -> Validity:
    window = grant.validity
    return Validity(iso(window.not_after), iso(window.not_before), "permissions", enclave, enclave)


def _certificate_validity(
    certificate: x509.Certificate, kind: str, title: str, enclave: str
) -> Validity:
    window = validity_of(certificate)
    return Validity(iso(window.not_after), iso(window.not_before), kind, title, enclave)


def _authority_validities(keystore: OpenedKeystore) -> Iterator[Validity]:
    """Yield the validity of all CA certificates and revocation lists."""
    roles: dict[x509.Certificate, list[str]] = defaultdict(list)
    for path in sorted((keystore.root / PUBLIC).glob(_AUTHORITY_FILES)):
        role = path.name.removesuffix("_ca.cert.pem")
        for certificate in load_certificates(keystore.read(path, "CA certificate"), "of the CA"):
            roles[certificate].append(role)
    for certificate, certificate_roles in roles.items():
        named = [role for role in certificate_roles if role != "ca"] or certificate_roles
        title = f"{' and '.join(dict.fromkeys(named))} CA, {authority_text(certificate)}"
        yield _certificate_validity(certificate, "authority", title, "")
    for crl in keystore.revocation_lists:
        title = f"revocation list {crl.number}"
        yield Validity(iso(crl.next_update), iso(crl.this_update), "revocation list", title)


# ── removing paths of this machine ─────────────────────────────────────────────────────────


def _without_unknown_enclave(finding: PicturedFinding, known_enclaves: Set[str]) -> PicturedFinding:
    if not finding.enclave or finding.enclave in known_enclaves:
        return finding
    return replace(finding, enclave="", text=f"{finding.enclave}: {finding.text}")


def _without_paths(finding: PicturedFinding, places: Mapping[str, str]) -> PicturedFinding:
    text, remedy = (_without_path(text, places) for text in (finding.text, finding.remedy))
    return replace(finding, text=text, remedy=remedy)


def _file_names(path: Path) -> Mapping[str, str]:
    """Map the paths of a source, as given, absolute and resolved, to its file name.

    The folder of the source is mapped only in quotes: without quotes, the same text may begin a ROS
    name. Longer paths come first, so that they are replaced before paths that they contain.
    """
    places = {
        f"{quotes}{place}{quotes}": f"{quotes}{_base_name(shown)}{quotes}"
        for shown, quotes in ((path, ""), (path.parent, "'"))
        for place in (str(shown), str(shown.absolute()), os.path.realpath(shown))
        if "/" in place and place != "/"
    }
    return {place: places[place] for place in sorted(places, key=len, reverse=True)}


def _without_path(text: str, places: Mapping[str, str]) -> str:
    """Return ``text`` with the paths in ``places`` replaced by their file names."""
    for place, name in places.items():
        text = text.replace(place, name)
    return _LINK.sub(r"\1", text)
