"""The verb `view`: draw who may do what, as a page, SVG, DOT, Mermaid, a table or JSON."""

from __future__ import annotations

import gc
import os
import sys
import tempfile
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

import click

from sros_tool.cli.common import (
    PATH,
    SeveralValues,
    check_one_format,
    check_output,
    complete_template,
    completions,
    dry_run_option,
    fleets_of,
    fleets_option,
    force_option,
    json_text,
    local_zone,
    now,
    print_json,
    print_notes,
    progress,
    refuse_git_revision,
    robot_option,
    save,
    verb,
)
from sros_tool.errors import Note, SrosError, UsageError
from sros_tool.terminal import echo, echo_document
from sros_tool.values import PlannedFiles, as_plain, file_change, versioned

if TYPE_CHECKING:
    from collections.abc import Iterator

    from click.shell_completion import CompletionItem


_FORMATS = ("html", "svg", "dot", "mermaid", "markdown", "json")
_WITH_FINDINGS = ("html", "json")
"""The formats that show the findings of `sros check`."""
_ENDINGS = {".htm": "html", ".mmd": "mermaid", ".gv": "dot", ".md": "markdown"}


class _ViewVerb(SeveralValues):
    several = ("--observed", "--focus")


def _focus_completions(
    ctx: click.Context, _parameter: click.Parameter, incomplete: str
) -> list[CompletionItem | str]:
    """Return the names and enclaves of the first SOURCE that begin with ``incomplete``."""
    from sros_tool.keystore.rights import load_rights

    sources = ctx.params.get("sources") or ctx.args
    try:
        rights = load_rights(Path(sources[0])).rights if sources else frozenset()
    except (SrosError, OSError):
        return []
    names = {right.enclave for right in rights} | {right.name for right in rights}
    return [*completions(sorted(names), incomplete)]


@verb("view", cls=_ViewVerb)
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
    help="Draw policies with the protection of this keystore template.",
    shell_complete=complete_template,
)
@click.option(
    "--host",
    "hosts",
    multiple=True,
    metavar="HOST=ENCLAVE",
    help="Draw ENCLAVE, and the enclaves below it, in the group of HOST. Can be repeated.",
)
@fleets_option
@click.option(
    "--focus",
    multiple=True,
    metavar="NAME...",
    help="Draw only the enclaves and names that can influence this topic, service, action "
    "or enclave, or be influenced by it.",
    shell_complete=_focus_completions,
)
@click.option(
    "--hops",
    type=click.IntRange(1, 99),
    help="With --focus: number of hops to draw; enclaves further away are only counted. "
    "[default: 2]",
)
@click.option(
    "--requirements",
    type=PATH,
    metavar="FILE",
    help="Draw in red the accesses that break the requirements in this TOML file.",
)
@click.option(
    "--all",
    "everything",
    is_flag=True,
    help="Also draw the rights that every node needs, such as /rosout.",
)
@click.option("--graphviz", is_flag=True, help="Lay out the SVG with Graphviz.")
@robot_option(
    "In a large keystore, read all permissions of this robot, even if the robot differs from "
    "others "
    "only in names."
)
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
    focus: tuple[str, ...],
    hops: int | None,
    requirements: Path | None,
    everything: bool,
    graphviz: bool,
    robots: tuple[str, ...],
    force: bool,
    dry_run: bool,
) -> None:
    """Draw who may do what in SOURCE, or compare two sources in one drawing.

    A SOURCE is a policy file, a keystore (its signed permissions), the folder of an enclave, its
    permissions, a Zenoh configuration (router.json5), or the output of `sros generate_policy
    --json`. Two policies are compared as before and after, a policy and a keystore as intended and
    signed rights, and a Zenoh configuration with the rights that it should allow. --observed
    compares the rights in SOURCE with those that are used. --focus shows which enclaves may use a
    name, and who can influence these enclaves.

    In a keystore with more than 1,000 enclaves, sros reads only some of the robots that differ only
    in names. For the others, it compares the text of the permissions, and the page says so.
    --json, --focus, --requirements, --observed and comparisons read everything.

    The page is one file that needs no network. No format contains keys or paths of this machine.

    Examples:
      $ sros view keystore -o robot.html --open
      wrote 'robot.html'
      $ sros view policies/mobile_robot.xml --format svg -o mobile_robot.svg
      $ sros view robot.xml --format markdown
      $ sros view robot.xml --focus /cmd_vel -o drive.html
      $ sros view robot.xml --requirements robot.requirements.toml -o broken.svg
      $ sros view robot.xml --observed learned.xml -o use.html
      $ sros view old.xml new.xml -o change.html
      $ sros view robot.xml keystore -o drift.html
      $ sros view robot.xml --fleet fleet.toml -o fleet.html
      $ sros view keystore keystore/enclaves/router/router.json5 -o zenoh.html
    """
    from sros_tool.report.formats import render
    from sros_tool.report.sources import PictureRequest, draw

    check_one_format()
    if hops and not focus:
        raise UsageError("--hops is for --focus only", "", "Add --focus NAME.")
    refuse_git_revision(
        sources, "Check the revision out: `git worktree add old REVISION`, and name old/PATH."
    )
    moment = now()
    written = _format("json" if as_json and not dry_run else form, output, graphviz)
    if written == "markdown" and (len(sources) > 1 or observed or hops):
        raise UsageError(
            "--format markdown takes one source, and neither --observed nor --hops",
            "",
            "For several policies of a robot or package, name their folder. `sros diff_policy A B "
            "--format markdown` compares two.",
        )
    if written in ("html", "svg") and not (output or show or dry_run) and _is_on_terminal():
        raise UsageError(
            "a page or picture would be written to this terminal",
            "",
            "Name a file, `-o robot.html`, or let a browser show it: `--open`.",
        )
    if output:
        check_output(output, force=force or dry_run)
    request = PictureRequest(
        sources,
        moment,
        local_zone(os.environ),
        observed=observed,
        template=template,
        hosts=hosts,
        fleets=fleets_of(fleet_files),
        focus=focus,
        requirements=requirements,
        checked=written in _WITH_FINDINGS,
        sampled=written != "json",
        robots=robots,
    )
    with progress("drawing"), _without_collection():
        picture, folding = draw(request)
        if written == "json":
            document = json_text(versioned(as_plain(picture))) + "\n"
        else:
            document = render(
                picture,
                folding,
                written,
                moment,
                everything=everything,
                graphviz=graphviz,
                hops=hops,
            )
    if written != "json":
        for line in picture.headlines:
            echo(line, err=True)
    if written not in _WITH_FINDINGS:  # rights that DDS refuses would look like all others
        print_notes([Note(f.id, f.text) for f in picture.findings if f.id.startswith("rights.")])
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


def _is_on_terminal() -> bool:
    return sys.stdout is not None and sys.stdout.isatty()


def _format(form: str | None, output: Path | None, graphviz: bool) -> str:
    ending = output.suffix.lower() if output else ""
    of_ending = _ENDINGS.get(ending, ending.removeprefix("."))
    chosen = form or of_ending
    if output and of_ending in _FORMATS and chosen != of_ending:
        raise UsageError(
            f"'{output}' would be {chosen}, but its name says {of_ending}",
            "",
            f"Name it '{output.with_suffix(f'.{chosen}')}', or leave the format out.",
        )
    if chosen not in _FORMATS and ending:
        raise UsageError(
            f"view writes no {ending} files",
            "",
            f"Use one of the endings {', '.join(f'.{known}' for known in _FORMATS)}, or name the "
            "format with --format.",
        )
    chosen = chosen or "html"
    if graphviz and chosen != "svg":
        raise UsageError(
            "--graphviz is for SVG only", "", "Add --format svg, or leave --graphviz out."
        )
    return chosen


@contextmanager
def _without_collection() -> Iterator[None]:
    """Disable garbage collection, which takes half of the time of a large picture.

    Pictures are values without cycles.
    """
    was = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if was:
            gc.enable()
