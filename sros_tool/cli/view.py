"""The verb `view`: draw who may do what, as a page, SVG, DOT, Mermaid or JSON."""

from __future__ import annotations

import gc
import os
import tempfile
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import click

from sros_tool.cli.common import (
    PATH,
    SeveralValues,
    check_one_format,
    check_output,
    complete_template,
    dry_run_option,
    fleets_of,
    fleets_option,
    force_option,
    json_text,
    now,
    print_json,
    progress,
    save,
)
from sros_tool.errors import SrosError, UsageError
from sros_tool.terminal import echo, echo_document
from sros_tool.values import PlannedFiles, as_plain, file_change, versioned

if TYPE_CHECKING:
    from collections.abc import Container, Iterator, Mapping, Sequence
    from datetime import datetime

    from click.shell_completion import CompletionItem

    from sros_tool.checks.kind import Finding as Checked
    from sros_tool.fleet.robots import Fleet, Robot
    from sros_tool.keystore.reader import Keystore
    from sros_tool.report.compose import PictureSource
    from sros_tool.report.folding import Folding
    from sros_tool.report.picture import Picture, PicturedFinding

_FORMATS = ("html", "svg", "dot", "mermaid", "json")
_WITH_FINDINGS = ("html", "json")
"""The formats that show the findings of `sros check`."""
_ENDINGS = {".htm": "html", ".mmd": "mermaid", ".gv": "dot"}


class _SeveralObserved(SeveralValues):
    several = ("--observed", "--focus")


def _complete_focus(
    ctx: click.Context, _parameter: click.Parameter, incomplete: str
) -> list[CompletionItem | str]:
    """Complete the names and enclaves in the rights of the first SOURCE, if it can be read."""
    from sros_tool.keystore.rights import load_rights

    given = ctx.params.get("sources") or ctx.args
    try:
        rights = load_rights(Path(given[0])).rights if given else frozenset()
    except (SrosError, OSError):
        return []
    names = {each.enclave for each in rights} | {each.name for each in rights}
    return [name for name in sorted(names) if name.startswith(incomplete)]


@click.command(
    "view",
    cls=_SeveralObserved,
    epilog="""\b
Examples:
  $ sros view keystore -o robot.html --open
  wrote 'robot.html'
  $ sros view policies/mobile_robot.xml --format svg -o mobile_robot.svg
  $ sros view robot.xml --focus /cmd_vel -o drive.html
  $ sros view robot.xml --requirements robot.requirements.toml -o broken.svg
  $ sros view robot.xml --observed learned.xml -o use.html
  $ sros view old.xml new.xml -o change.html
  $ sros view robot.xml keystore -o drift.html
  $ sros view robot.xml --fleet fleet.toml -o fleet.html
  $ sros view keystore keystore/enclaves/router/router.json5 -o zenoh.html""",
)
@click.argument("sources", metavar="SOURCE...", type=PATH, nargs=-1, required=True)
@click.option(
    "--format",
    "form",
    type=click.Choice(_FORMATS),
    help="Output format. [default: by the suffix of FILE, else html]",
)
@click.option("--json", "as_json", is_flag=True, help="The same as --format json.")
@click.option(
    "-o", "--output", type=PATH, metavar="FILE", help="Write to FILE instead of standard output."
)
@click.option("--open", "show", is_flag=True, help="Open the result in the browser.")
@click.option(
    "--observed",
    multiple=True,
    type=PATH,
    metavar="OBSERVED...",
    help="Observed rights to compare with SOURCE: policies or JSON by generate_policy.",
)
@click.option(
    "--template",
    metavar="TEMPLATE",
    help="Show policies with the protection of this keystore template.",
    shell_complete=complete_template,
)
@click.option(
    "--host",
    "hosts",
    multiple=True,
    metavar="HOST=ENCLAVE",
    help="Group ENCLAVE, and the enclaves below it, by the host they run on.",
)
@fleets_option
@click.option(
    "--focus",
    "words",
    multiple=True,
    metavar="NAME...",
    help="Draw only what leads to this topic, service, action or enclave, and what it leads to.",
    shell_complete=_complete_focus,
)
@click.option(
    "--hops",
    type=click.IntRange(1, 99),
    help="With --focus, draw enclaves so many hops away; further ones are counted. [default: 2]",
)
@click.option(
    "--requirements",
    type=PATH,
    metavar="FILE",
    help="Draw in red what breaks the requirements in this TOML file.",
)
@click.option("--all", "everything", is_flag=True, help="Also draw rights that every node needs.")
@click.option("--graphviz", is_flag=True, help="Lay out the SVG with Graphviz.")
@force_option
@dry_run_option
def view(
    sources: tuple[Path, ...],
    form: str | None,
    as_json: bool,
    output: Path | None,
    show: bool,
    observed: tuple[Path, ...],
    template: str | None,
    hosts: tuple[str, ...],
    fleet_files: tuple[Path, ...],
    words: tuple[str, ...],
    hops: int | None,
    requirements: Path | None,
    everything: bool,
    graphviz: bool,
    force: bool,
    dry_run: bool,
) -> None:
    """Draw who may do what in SOURCE, or compare two sources in one drawing.

    A SOURCE is a policy file, a keystore (its signed permissions), the folder of an enclave, its
    permissions, a Zenoh configuration (router.json5), or the output of `sros generate_policy
    --json`. Two policies are compared as before and after, a policy and a keystore for drift, and
    a Zenoh configuration with what it should allow. --observed compares the rights in SOURCE
    with those that are used. --focus answers who may use a name, and who influences these.

    The page is one file that needs no network. No format contains keys or paths of this machine.
    """
    from sros_tool.report.folding import Folding

    check_one_format()
    if hops and not words:
        raise UsageError("--hops is for --focus only", "", "Name what to look at with --focus.")
    moment = now()
    written = _format("json" if as_json else form, output, graphviz)
    if output:
        check_output(output, force=force or dry_run)
    with progress("drawing"), _without_collection():
        picture, read, robots = _picture(
            sources,
            observed,
            template,
            hosts,
            moment,
            fleets_of(fleet_files),
            with_findings=written in _WITH_FINDINGS,
        )
        if words:
            from sros_tool.report.focus import focused

            picture = focused(picture, read, words)
        if requirements:
            picture = _with_requirements(
                picture,
                requirements,
                sources,
                template,
                moment,
                fleets_of(fleet_files)[0],
                read[0].keystore,
            )
        folding = Folding.of(picture, robots)
        picture = replace(picture, equal=folding.equal, different=folding.different)
        document = _rendered(picture, folding, written, everything, graphviz, moment, hops)
    if written != "json":
        for line in picture.headlines:
            echo(line, err=True)
    if dry_run and as_json:
        changes = file_change(output, existed=output.exists()) if output else ()
        print_json(PlannedFiles(changes, ()))
        return
    if dry_run:
        echo(f"would write {output or 'to standard output'}: {len(document)} characters")
        return
    if show and output is None:
        output = Path(tempfile.mkdtemp(prefix="sros-view-")) / f"view.{written}"
    if output is None:
        echo_document(document)
        return
    echo(save(output, document.encode("utf-8", "replace")), err=True)
    if show:
        click.launch(output.absolute().as_uri())


@contextmanager
def _without_collection() -> Iterator[None]:
    """Do not look for cycles of objects, which takes half of the time of a large picture.

    Pictures are values without cycles.
    """
    was = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if was:
            gc.enable()


def _format(form: str | None, output: Path | None, graphviz: bool) -> str:
    ending = output.suffix.lower() if output else ""
    found = form or _ENDINGS.get(ending, ending.removeprefix("."))
    if found not in _FORMATS:
        found = "html"
    if graphviz and found != "svg":
        raise UsageError("--graphviz is for SVG only", "", "Add --format svg, or leave it out.")
    return found


def _picture(
    sources: tuple[Path, ...],
    observed: tuple[Path, ...],
    template: str | None,
    hosts: tuple[str, ...],
    moment: datetime,
    fleets: tuple[Fleet | None, Fleet | None],
    *,
    with_findings: bool,
) -> tuple[Picture, Sequence[PictureSource], Mapping[str, Robot]]:
    """Return the picture, the sources whose rights are in it, and the robots by their enclaves."""
    from sros_tool.report.compose import Context, compose, overlay, union
    from sros_tool.report.sources import common_rights, read_source, template_governance
    from sros_tool.report.sources import with_findings as added

    if len(sources) > 2 or (observed and len(sources) > 1):
        raise UsageError(
            "at most two sources can be compared",
            "",
            "Name one SOURCE and --observed, or two SOURCEs.",
        )
    read = []
    for path, fleet in zip(sources, fleets, strict=False):
        source = read_source(path, now=moment, fleet=fleet)
        found = _checked(path, source, moment, fleet) if with_findings else []
        read.append(added(source, path, found))
    if template:
        _check_no_governance(sources, read)
        read = [
            each
            if each.governance
            else replace(each, governance=template_governance(template, each.protections))
            for each in read
        ]
    robots: dict[str, Robot] = {}
    for path, fleet, source in zip(sources, fleets, read, strict=False):
        robots |= _robots(path, fleet, source)
    places = {enclave: robot.name for enclave, robot in robots.items()}
    context = Context(common_rights(), places | _hosts(hosts))
    if observed:
        seen = union([read_source(path, now=moment) for path in observed])
        return overlay(read[0], seen, "use", context), (read[0], seen), robots
    if len(read) == 1:
        return compose(read[0], context), read, robots
    kinds = [each.origin.kind for each in read]
    if kinds[1] == "observation":
        return overlay(read[0], read[1], "use", context), read, robots
    if kinds[0] == kinds[1]:
        return overlay(read[0], read[1], "change", context), read, robots
    if "zenoh" in kinds:
        first, second = sorted(read, key=lambda each: each.origin.kind == "zenoh")
        return overlay(first, second, "worlds", context), read, robots
    # Drift is shown from the side of the policy, whichever was named first.
    first, second = sorted(read, key=lambda each: each.origin.kind != "policy")
    return overlay(first, second, "drift", context), read, robots


def _with_requirements(
    picture: Picture,
    file: Path,
    sources: tuple[Path, ...],
    template: str | None,
    moment: datetime,
    fleet: Fleet | None,
    opened: Keystore | None,
) -> Picture:
    """Return the picture with what breaks requirements, decided as `sros check` does."""
    from sros_tool.cli.common import local_zone
    from sros_tool.keystore.template import load_template
    from sros_tool.proof.findings import assumption_text, decide_all, decided_findings
    from sros_tool.proof.requirements import demand, read_requirements
    from sros_tool.proof.system import load_system
    from sros_tool.report.compose import with_requirements
    from sros_tool.report.picture import PicturedUse, PicturedViolation, Requirements

    if len(sources) > 1:
        raise UsageError("--requirements takes one policy or keystore", "", "Draw one of them.")
    wanted = read_requirements(file)
    system = load_system(
        sources[0],
        at=moment,
        zone=local_zone(os.environ),
        fleet=fleet,
        template=load_template(template) if template else None,
        opened=opened,
    )
    decided = decide_all(wanted, system)
    found = decided_findings(decided, system)
    violations = tuple(
        PicturedViolation(
            _finding_text(finding, finding.subject),
            tuple(
                PicturedUse(step.use.enclave, *step.drawn())
                for step in each.steps
                if step.place and step.use.right
            ),
        )
        for each, finding in zip(decided.violations, found, strict=False)
    )
    assumed = tuple(f"{demand(each)}: {assumption_text(name)}" for each, name in decided.assumed)
    requirements = Requirements(len(wanted) - len(violations), violations, assumed)
    paths = {each.path for each in picture.enclaves}
    pictured = tuple(_pictured(each, paths) for each in found)
    picture = replace(picture, findings=(*picture.findings, *pictured))
    return with_requirements(picture, requirements)


def _check_no_governance(sources: tuple[Path, ...], read: list[PictureSource]) -> None:
    """Raise `UsageError` if a source has its own signed governance, so that no template applies."""
    for path, each in zip(sources, read, strict=True):
        if each.origin.kind in ("keystore", "enclave"):
            raise UsageError(
                f"--template does not fit '{path}'",
                f"It is {'an' if each.origin.kind == 'enclave' else 'a'} {each.origin.kind}, which "
                "is drawn with its own governance; a template is for policies, which have none.",
                "Leave --template out, or name the policy alone.",
            )


def _checked(
    path: Path, source: PictureSource, moment: datetime, fleet: Fleet | None
) -> list[PicturedFinding]:
    """Return the findings of `sros check` for a source, or none if it cannot be checked."""
    from sros_tool.checks.policies import policy_file_findings
    from sros_tool.checks.targets import Circumstances, path_findings
    from sros_tool.cli.common import local_zone

    at = Circumstances(moment, local_zone(os.environ), fleet=fleet)
    if source.keystore:
        at.opened[path] = source.keystore
    try:
        found = (
            list(policy_file_findings(path, fleet=fleet, policy=source.policy))
            if source.policy
            else path_findings(path, at)
        )
    except SrosError:
        return []
    return [_pictured(each, {each.subject}) for each in found]


def _pictured(finding: Checked, enclaves: Container[str]) -> PicturedFinding:
    """Return a finding for the picture; its subject is in the text unless it is an enclave."""
    from sros_tool.report.picture import PicturedFinding

    known = finding.subject in enclaves
    about = "" if known or finding.subject == finding.file else finding.subject
    text = _finding_text(finding, about)
    enclave = finding.subject if known else ""
    return PicturedFinding(finding.id, finding.severity.word, text, finding.remedy, enclave)


def _finding_text(finding: Checked, about: str = "") -> str:
    """Return the text of a finding ``about`` something, with the base name of file and the line."""
    place = f"{Path(finding.file).name}:{finding.line}" if finding.line else ""
    return ": ".join(filter(None, (place, about, finding.text)))


def _hosts(words: tuple[str, ...]) -> dict[str, str]:
    found = {}
    for word in words:
        host, equals, enclave = word.partition("=")
        if not equals or not host or not enclave.startswith("/"):
            raise UsageError(
                f"--host {word!r} is not HOST=ENCLAVE",
                "",
                "Write for example --host arm=/robot/arm.",
            )
        found[enclave.rstrip("/") or "/"] = host
    return found


def _robots(path: Path, fleet: Fleet | None, source: PictureSource) -> dict[str, Robot]:
    """Map the enclaves of a source to their robots, by which they are grouped."""
    from sros_tool.fleet.enclaves import robot_of
    from sros_tool.fleet.expansion import FleetPolicy
    from sros_tool.keystore.fleet import load_fleet
    from sros_tool.policy.document import read_policy

    if source.keystore:
        fleet = load_fleet(source.keystore)
    elif fleet and source.origin.kind == "policy":
        written = read_policy(path, placeholders=True)
        fleet = fleet.with_enclaves(FleetPolicy(written, fleet).patterns)
    if fleet is None:
        return {}
    found = ((name, robot_of(fleet, name)) for name in {each.enclave for each in source.rights})
    return {name: robot for name, robot in found if robot}


def _rendered(
    picture: Picture,
    folding: Folding,
    form: str,
    everything: bool,
    graphviz: bool,
    moment: datetime,
    hops: int | None,
) -> str:
    if form == "json":
        return json_text(versioned(as_plain(picture))) + "\n"
    placed = form in ("html", "svg") and not graphviz
    scenes = folding.scenes(placed=placed, hops=hops or 0)
    if form == "html":
        from sros_tool.report.pages import render_page

        return render_page(picture, scenes, moment, folding.picture)
    scene = next((each for each in scenes if everything and each.id == "all"), scenes[0])
    if form == "svg" and not graphviz:
        from sros_tool.report.formats import render_svg

        return render_svg(picture, scene)
    from sros_tool.report.formats import graphviz_svg, render_dot, render_mermaid

    if form == "mermaid":
        return render_mermaid(picture, scene)
    dot = render_dot(picture, scene)
    return graphviz_svg(dot) if graphviz else dot
