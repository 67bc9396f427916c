"""The verbs that report faults: `check`, `doctor`, and `metrics` for Prometheus."""

from __future__ import annotations

import json
import os
import signal
import sys
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from datetime import datetime, timedelta
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import click
from click.core import ParameterSource

from sros_tool import __version__
from sros_tool.cli.changed import MAX_NAMES, first_lines
from sros_tool.cli.common import (
    KEYSTORE_VARIABLE,
    PATH,
    advisories_of,
    advisories_option,
    all_distros_option,
    check_metrics_file,
    check_one_decider,
    check_one_format,
    check_output,
    complete_template,
    distro_option,
    domain_of,
    dry_run_option,
    echo_findings,
    echo_folded,
    fleet_option,
    force_option,
    json_option,
    json_text,
    keystore_argument,
    keystore_from_environment,
    local_zone,
    moment_of,
    now,
    output_option,
    print_json,
    print_notes,
    progress,
    relative_path,
    removed_secrets,
    save,
    verb,
)
from sros_tool.dds.decision.vendors import TESTED, ZENOH, Vendor
from sros_tool.errors import NOT_DONE, SrosError, UsageError
from sros_tool.terminal import echo, echo_document, echo_lines, visible, visible_json
from sros_tool.values import file_change, shows, versioned
from sros_tool.wording import counted, enumerated, first_few

if TYPE_CHECKING:
    from sros_tool.checks.keystores.opened import Circumstances
    from sros_tool.checks.kind import ChosenFindings, Finding, FindingFilter
    from sros_tool.dds.advisories import Advisory
    from sros_tool.demo.doctor import Diagnosis, SecurityProvider
    from sros_tool.distributions import Distribution
    from sros_tool.fleet.robots import Fleet
    from sros_tool.keystore.reader import OpenedKeystore
    from sros_tool.prometheus import Metric
    from sros_tool.proof.system import System
    from sros_tool.runtime.processes import MappedLibrary, RunningProcesses

_FAMILIES = ("policy", "keystore", "runtime")
_LEVELS = click.Choice(["note", "warning", "error"])


def _complete_id(_ctx: click.Context, _parameter: click.Parameter, incomplete: str) -> list[str]:
    """Complete the ids of findings."""
    from sros_tool.checks.kind import all_kinds

    return [kind_id for kind_id in all_kinds() if kind_id.startswith(incomplete)]


_VENDORS = (*(vendor.value for vendor in TESTED), ZENOH)


@verb("check")
@click.argument("targets", metavar="[policy|keystore|runtime] [PATH]...", nargs=-1, type=PATH)
@click.option("--list", "as_list", is_flag=True, help="List all kinds of findings.")
@click.option(
    "--include",
    metavar="ID",
    multiple=True,
    shell_complete=_complete_id,
    help="Report only findings with this id; * and ? are wildcards. Can be repeated.",
)
@click.option(
    "--exclude",
    metavar="ID",
    multiple=True,
    shell_complete=_complete_id,
    help="Leave out findings with this id; * and ? are wildcards. Can be repeated.",
)
@click.option(
    "--severity",
    type=_LEVELS,
    help="Show only findings of this severity or higher; default: errors, warnings, and the most "
    "important notes.",
)
@click.option(
    "--fail-on",
    type=click.Choice(["note", "warning", "error", "never"]),
    default="warning",
    show_default=True,
    help="Exit with 1 if there is a finding of this severity or higher. Such findings are "
    "always shown, even below --severity.",
)
@click.option(
    "--strict", is_flag=True, help="Also report findings that the keystore's template accepts."
)
@click.option(
    "--policy",
    "policies",
    type=PATH,
    multiple=True,
    metavar="FILE",
    help="Compare the permissions of keystores with this policy.  Can be repeated.",
)
@fleet_option("The robots that the placeholders of policies stand for.")
@click.option(
    "--requirements",
    type=PATH,
    multiple=True,
    metavar="FILE",
    help="Check that the requirements in this TOML file hold for the policy or keystore. "
    "Can be repeated.",
)
@click.option(
    "--requirements-before",
    "earlier",
    type=PATH,
    multiple=True,
    metavar="FILE",
    help=(
        "An earlier version of the --requirements file: report requirements that the current "
        "file lacks or weakens. Can be repeated."
    ),
)
@click.option(
    "--namespace",
    "namespaces",
    metavar="NS",
    multiple=True,
    help="With --requirements: put the enclaves of the file, and its names without '/' or '*' at "
    "the beginning, into this namespace, such as /left.  Can be repeated: the requirements have to "
    "hold in each namespace.",
)
@click.option(
    "--remap",
    "remaps",
    metavar="[NODE:]FROM:=TO",
    multiple=True,
    help="With --requirements: remap a name in the requirements file, as `sros merge_policy "
    "--remap` did in the policy; NODE:__node:=NAME renames a node.  Can be repeated.",
)
@click.option(
    "--template",
    metavar="TEMPLATE",
    shell_complete=complete_template,
    help="For policies that are not signed yet: assume a keystore of this template.",
)
@click.option(
    "--suggest",
    is_flag=True,
    help="Print, as TOML, requirements that hold now: keep the ones that you want.",
)
@click.option(
    "--vendor",
    type=click.Choice(_VENDORS),
    metavar="VENDOR",
    help=f"Report only findings for this DDS vendor, or for Zenoh. One of: {', '.join(_VENDORS)}.",
)
@click.option(
    "--domain", metavar="ID", help="The ROS domain that the enclaves must be able to join."
)
@distro_option(
    "Report only findings for the nodes and the DDS of this ROS 2 distribution, such as lyrical. "
    "[default: the distributions in the keystore's settings; $ROS_DISTRO for nodes in policies]"
)
@all_distros_option("Report the findings for all supported ROS 2 distributions.")
@distro_option(
    "Report only what changes with an update to this ROS 2 distribution. The distribution before "
    "the update: --distro, else the distribution in the keystore's settings, else $ROS_DISTRO.",
    "--upgrade-to",
)
@click.option(
    "--at",
    "moment",
    metavar="MOMENT",
    help="Check as of a date (2027-06-01) or a time from now (90d).",
)
@click.option(
    "--format",
    "form",
    type=click.Choice(["text", "json", "sarif", "markdown"]),
    default="text",
    show_default=True,
    help="Output format: text, JSON, SARIF for code hosts, or Markdown for a pull request.",
)
@click.option(
    "--watch",
    is_flag=True,
    help="With `runtime`: keep running, and report changes of the findings on processes.",
)
@json_option
@click.option("--sarif", "as_sarif", is_flag=True, help="The same as --format sarif.")
@click.option(
    "--needs-renewal",
    metavar="DURATION|PERCENT|soon",
    help="List only the enclaves that expire within DURATION (30d) or have used PERCENT of their "
    "validity (66%). `soon`: a file of the enclave expires within 30 days, or within a third of "
    "its validity if this third is shorter. CAs, the revocation list and published metadata that "
    "expire within DURATION are listed, too; with PERCENT or `soon`, those that expire soon.",
)
@advisories_option
def check(
    targets: tuple[Path, ...],
    as_list: bool,
    include: tuple[str, ...],
    exclude: tuple[str, ...],
    severity: str | None,
    fail_on: str,
    strict: bool,
    policies: tuple[Path, ...],
    fleet_file: Path | None,
    requirements: tuple[Path, ...],
    earlier: tuple[Path, ...],
    namespaces: tuple[str, ...],
    remaps: tuple[str, ...],
    template: str | None,
    suggest: bool,
    vendor: str | None,
    domain: str | None,
    distro: Distribution | None,
    all_distros: bool,
    upgrade_to: Distribution | None,
    moment: str | None,
    form: str,
    watch: bool,
    as_json: bool,
    as_sarif: bool,
    needs_renewal: str | None,
    advisories: Path | None,
) -> int:
    r"""Find errors and weaknesses in policies, keystores and the runtime.

    PATH is a policy, a folder of policies, a keystore or an enclave. sros detects the type, unless
    the word `policy` or `keystore` before the first PATH states it. `sros check keystore` checks
    the folder `keystore` here; if there is none, the keystore of $ROS_SECURITY_KEYSTORE. Plain
    `sros check` checks the keystore of $ROS_SECURITY_KEYSTORE and the runtime: the environment and
    the processes of this machine.

    Example:
      $ sros check robot.xml keystore
      robot.xml:12: error: a node that may not publish /rosout [policy.no-rosout]
          /talker: node /talker may not publish /rosout
          Allow <topics publish="ALLOW"><topic>/rosout</topic></topics>. ...
      1 error
      $ sros check keystore --policy robot.xml --sarif > findings.sarif
      $ sros check --needs-renewal 30d keystore || \
            sros renew keystore --all-expiring 30d
      $ sros check robot.xml --suggest > robot.requirements.toml
      $ sros check robot.xml --requirements robot.requirements.toml
      $ sros check keystore --distro lyrical
      $ sros check keystore --distro jazzy --upgrade-to lyrical

    Findings that the keystore's template accepts count as notes and share one line; with --strict,
    for example in CI, they count like all others. If security is not enabled at all, `check
    runtime` shows a note, which counts with --fail-on note. Exit status: 1 if a finding of the
    --fail-on severity or higher is shown; 2 if all such findings only say that a process could not
    be examined; else 0.
    """
    from sros_tool.checks.kind import FindingFilter, Severity

    check_one_format()
    family, paths = _split_family(targets)
    form = "json" if as_json else "sarif" if as_sarif else form
    if needs_renewal is not None:
        if family not in ("", "keystore") or len(paths) > 1:
            raise UsageError("--needs-renewal takes one keystore")
        root = paths[0] if paths else keystore_from_environment()
        at = _circumstances(domain, moment, ())
        if form == "sarif":
            raise UsageError("--needs-renewal has no SARIF output", "", "Use --json.")
        return _show_renewals(root, needs_renewal, at.now, form)
    lowest = Severity[severity.upper()] if severity else None
    if _is_option_given("fail_on") and fail_on != "never":  # a hidden finding fails no check
        failing = Severity[fail_on.upper()]
        lowest = failing if failing < (lowest or Severity.WARNING) else lowest
    check_one_decider()
    vendors = _vendors(vendor, distro, all_distros=all_distros)
    selection = FindingFilter(include, exclude, lowest, strict, vendors)
    if as_list:
        if form in ("sarif", "markdown"):
            raise UsageError(f"--list has no {form} output", "", "Use --json.")
        _print_kinds(selection, form)
        return 0
    if family == "runtime" and policies:
        raise UsageError(
            "`check runtime` compares nothing with a policy",
            "",
            f"`sros audit {policies[0]}` reports what a policy would deny to the running robot.",
        )
    if advisories and not upgrade_to and (family not in ("", "runtime") or paths):
        raise UsageError(
            "--advisories is for `sros check runtime` and --upgrade-to", "", "Leave it out."
        )
    known = advisories_of(advisories)
    if watch:
        if family != "runtime" or form not in ("text", "json") or moment:
            raise UsageError(
                "--watch is for `sros check runtime`, as text or --json, without --at",
                "",
                "Write `sros check runtime --watch`.",
            )

        _watch_processes(_environment(domain_of(domain)), selection, known, as_json=form == "json")
        return 0
    at = _circumstances(domain, moment, policies, fleet_file, paths)
    nodes_of = _distribution_of_nodes(distro, all_distros=all_distros)
    at = replace(at, distribution=nodes_of, vendors=vendors, advisories=known)
    if upgrade_to:
        _refuse_options_with_upgrade()
        from sros_tool.distributions import ROS_DISTRO, sourced_distribution
        from sros_tool.proof.upgrade import check_upgrade

        with progress("comparing"):
            updates = [
                check_upgrade(
                    path,
                    upgrade_to,
                    at,
                    present=distro,
                    here=sourced_distribution(os.environ.get(ROS_DISTRO)),
                    vendor=vendor or "",
                )
                for path in _policies_or_keystore(family, paths, "--upgrade-to")
            ]
        changes = dict.fromkeys(finding for update in updates for finding in update.findings)
        chosen = selection.choose(map(_with_relative_paths, changes))
        compared = sum(update.compared for update in updates)
        not_compared = sum(update.enclaves for update in updates) - compared
        are = counted(not_compared, "enclave is", "enclaves are")
        upgraded = f"; {are} already for {upgrade_to.title}" if not_compared else ""
        echo(f"compared {counted(compared, 'enclave')}{upgraded}", err=True)
        _PRINTERS[form](chosen, selection)
        return _status(chosen, fail_on)
    if suggest:
        if form != "text" or requirements or earlier:
            raise UsageError("--suggest prints TOML", "", "Give it alone.")
        systems = _paths_of_systems(family, paths, "--suggest")
        if len(systems) > 1:
            raise _not_one_system_error("--suggest")
        with progress("deciding"):
            text = _suggested_requirements(systems[0], _load_system(systems[0], at, template))
        echo_document(text)
        return 0
    if template and not requirements and not _are_policies(family, paths):
        raise UsageError(
            "--template is for policies that are not signed yet", "", "Leave it out, or name one."
        )
    if earlier and not requirements:
        raise UsageError(
            "--requirements-before needs --requirements", "", "Add --requirements CURRENT_FILE."
        )
    for option, given in (("--namespace", namespaces), ("--remap", remaps)):
        if given and not requirements:
            raise UsageError(
                f"{option} has no effect without --requirements",
                "",
                f"Add it, or leave {option} out.",
            )
    decide = _requirements(family, paths, requirements, earlier, namespaces, remaps)
    with progress("checking"):
        findings = [*_findings(family, paths, at), *_stated_distribution_findings(paths, at)]
        if decide:
            findings += decide(lambda paths: _load_system(paths, at, template))
    if template:
        from sros_tool.checks.policies.portability import is_mended_by  # most checks read no policy
        from sros_tool.keystore.template import load_template

        assumed = load_template(template)
        findings = [finding for finding in findings if not is_mended_by(assumed, finding)]
    chosen = selection.choose(map(_with_relative_paths, findings))
    scope = _scope(vendors if vendor else (), distro, all_distros=all_distros)
    if scope and (form == "text" or (distro and distro.assumption)):
        echo(f"checked for {scope}", err=True)
    if form == "text":
        _print_text(chosen, _fleet_of(at, paths))
    elif form == "markdown":
        _print_markdown(chosen, _fleet_of(at, paths))
    else:
        _PRINTERS[form](chosen, selection)
    return _status(chosen, fail_on)


def _requirements(
    family: str,
    paths: tuple[Path, ...],
    files: tuple[Path, ...],
    earlier: tuple[Path, ...],
    namespaces: tuple[str, ...],
    remaps: tuple[str, ...],
) -> Callable[[Callable[[Sequence[Path]], System]], list[Finding]] | None:
    """Return a function that checks the requirements in ``files``; None if there are no files.

    The argument of the returned function is a function that reads the policies or the keystore at
    paths.
    """
    if not files:
        return None
    from sros_tool.names import check_plain_namespace
    from sros_tool.policy.remapping import parse_remapping_of_names
    from sros_tool.proof.findings import (
        left_out_robot_findings,
        requirement_findings,
        unused_remapping_findings,
    )
    from sros_tool.proof.requirements import (
        dropped_findings,
        read_all_requirements,
        read_requirements,
    )

    paths_of = _paths_of_systems(family, paths, "--requirements")
    places = [check_plain_namespace(namespace) for namespace in namespaces]
    rules = [parse_remapping_of_names(remap) for remap in remaps]

    def decide(load: Callable[[Sequence[Path]], System]) -> list[Finding]:
        findings: list[Finding] = []
        for system in map(load, paths_of):
            wanted = read_all_requirements(files, system.fleet, places, rules)
            findings += requirement_findings(wanted, system)
            findings += left_out_robot_findings(system, places)
            findings += unused_remapping_findings(files, system, places, rules)
            if earlier:
                before = [
                    requirement
                    for path in earlier
                    for requirement in read_requirements(path, system.fleet, places, rules)
                ]
                findings += dropped_findings(before, wanted, str(files[0]))
        return [*dict.fromkeys(findings)]

    return decide


def _status(chosen_findings: ChosenFindings, fail_on: str) -> int:
    """Return the exit status: 1 for shown findings of the severity ``fail_on`` or higher, else 0.

    `NOT_DONE` if all these findings only say that a process was not seen.
    """
    from sros_tool.checks.kind import Severity

    if fail_on == "never":
        return 0
    failing = [
        finding
        for finding in chosen_findings.shown
        if finding.severity >= Severity[fail_on.upper()]
    ]
    if failing and all(finding.id == "runtime.process-not-seen" for finding in failing):
        return NOT_DONE
    return 1 if failing else 0


def _is_option_given(parameter: str) -> bool:
    """Return whether the user gave this parameter's option on the command line."""
    source = click.get_current_context().get_parameter_source(parameter)
    return source is ParameterSource.COMMANDLINE


def _are_policies(family: str, paths: tuple[Path, ...]) -> bool:
    from sros_tool.checks.targets import is_of_policies

    return family in ("", "policy") and bool(paths) and all(map(is_of_policies, paths))


def _policies_or_keystore(family: str, paths: tuple[Path, ...], option: str) -> list[Path]:
    """Return the only path, which has to be a keystore or a policy, or the policies in it."""
    from sros_tool.keystore.layout import is_keystore
    from sros_tool.policy.document import files_of_policies

    if family != "runtime" and len(paths) < 2:
        path = paths[0] if paths else keystore_from_environment()
        if found := [path] if is_keystore(path) else list(files_of_policies(path)):
            return found
    raise UsageError(
        f"{option} takes one policy file, folder of policies or keystore",
        "",
        "Name only one, and run the command once for each.",
    )


def _paths_of_systems(
    family: str, paths: tuple[Path, ...], option: str
) -> Sequence[Sequence[Path]]:
    """Return the paths of each system: one list with all policies, and one with the keystore.

    A list that would be empty is left out.
    """
    from sros_tool.keystore.layout import is_keystore

    paths = paths or (() if family == "runtime" else (keystore_from_environment(),))
    keystores = [path for path in paths if is_keystore(path)]
    if not paths or len(keystores) > 1:
        raise _not_one_system_error(option)
    return [*filter(None, ([path for path in paths if path not in keystores], keystores))]


def _not_one_system_error(option: str) -> UsageError:
    return UsageError(
        f"{option} takes one keystore, or the policies of one robot or fleet",
        "Several policies count as one.",
        "Run the command once for each keystore, robot or fleet.",
    )


def _load_system(
    paths: Sequence[Path], circumstances: Circumstances, template: str | None = None
) -> System:
    from sros_tool.keystore.template import load_template
    from sros_tool.proof.system import load_system

    return load_system(paths, circumstances, load_template(template) if template else None)


def _suggested_requirements(paths: Iterable[Path], system: System) -> str:
    from sros_tool.proof.suggestions import render_requirements, suggest

    proposed = suggest(system.rights, system.worlds, system.fleet(), is_keystore=system.is_keystore)
    return render_requirements(proposed.requirements, map(str, paths), proposed.comments)


def _split_family(targets: tuple[Path, ...]) -> tuple[str, tuple[Path, ...]]:
    """Return the family of checks that the first word names, or "", and the paths.

    A single word is a path if that path exists: many keystores are named `keystore`.  The word
    `keystore` before other paths is also a path, if there is a keystore with this name and no other
    path names it.
    """
    from sros_tool.keystore.layout import is_keystore

    word = str(targets[0]) if targets else ""
    if word in _FAMILIES and not (len(targets) == 1 and targets[0].exists()):
        if word == "runtime" and len(targets) > 1:
            raise UsageError(
                "`check runtime` takes no path", "It checks this machine.", "Leave the path out."
            )
        if word == "keystore" and is_keystore(targets[0]) and targets[0] not in targets[1:]:
            return "", targets
        return word, targets[1:]
    return "", targets


def _circumstances(
    domain: str | None,
    moment: str | None,
    policies: Sequence[Path],
    fleet_file: Path | None = None,
    paths: Sequence[Path] = (),
) -> Circumstances:
    """Return the moment, domain, policies and fleet that the options name.

    Without --fleet, policies are read for the fleet of the keystore, if only one keystore is
    checked.
    """
    from sros_tool.checks.keystores.opened import Circumstances
    from sros_tool.cli.common import local_zone
    from sros_tool.keystore.layout import is_keystore

    fleet, read = None, []
    opened: dict[Path, OpenedKeystore] = {}
    if fleet_file:
        from sros_tool.fleet.fleet_file import read_fleet

        fleet = read_fleet(fleet_file)
    elif policies and len(paths) == 1 and is_keystore(paths[0]):
        from sros_tool.keystore.fleet import load_fleet
        from sros_tool.keystore.reader import OpenedKeystore

        opened[paths[0]] = OpenedKeystore(paths[0])
        with suppress(SrosError):  # what is wrong with it is a finding
            fleet = load_fleet(opened[paths[0]])
    for policy in policies:
        from sros_tool.fleet.expansion import FleetPolicy
        from sros_tool.policy.document import read_policy

        if fleet is None:
            read.append(read_policy(policy))
        else:
            expanded = FleetPolicy(read_policy(policy, placeholders=True), fleet)
            read.append(expanded.policy())
            fleet = fleet.with_enclaves(expanded.patterns)
    zone, wanted = local_zone(os.environ), domain_of(domain)
    return Circumstances(moment_of(moment), zone, wanted, tuple(read), fleet=fleet, opened=opened)


def _stated_distribution_findings(
    paths: Sequence[Path], circumstances: Circumstances
) -> Iterator[Finding]:
    """Yield findings if the distributions that a keystore states decide differently."""
    from sros_tool.keystore.fleet import enclaves_of_several_distributions
    from sros_tool.keystore.layout import is_keystore

    for path in paths or filter(None, (Path(os.environ.get(KEYSTORE_VARIABLE, "")),)):
        if circumstances.vendors or not is_keystore(path):
            continue
        keystore = circumstances.keystore(path)
        if enclaves_of_several_distributions(keystore):
            from sros_tool.proof.upgrade import check_distributions

            yield from check_distributions(keystore, circumstances)


def _distribution_of_nodes(distro: Distribution | None, *, all_distros: bool) -> str:
    """Return the distribution of the nodes in policies; "" stands for the latest one."""
    if all_distros:
        return ""
    return distro.given_name if distro else os.environ.get("ROS_DISTRO", "")


def _vendors(
    vendor: str | None, distro: Distribution | None, *, all_distros: bool
) -> tuple[str, ...]:
    """Return the DDS vendors, or ``zenoh``, that options select; () for all."""
    from sros_tool.distributions import SUPPORTED, selected_vendors

    if vendor == ZENOH:
        return (vendor,)
    return selected_vendors(vendor or "", SUPPORTED if all_distros else (distro,) if distro else ())


def _scope(vendors: Iterable[str], distro: Distribution | None, *, all_distros: bool) -> str:
    """Return the distributions, and the vendors, that options select; "" without options."""
    from sros_tool.distributions import SUPPORTED

    distributions = SUPPORTED if all_distros else (distro,) if distro else ()
    titles = ["Zenoh" if vendor == ZENOH else Vendor(vendor).title for vendor in vendors]
    if distributions:
        titles.append(f"ROS 2 {enumerated([each.title_with_assumption for each in distributions])}")
    return ", ".join(titles)


def _refuse_options_with_upgrade() -> None:
    """Raise `UsageError` for options that exclude --upgrade-to."""
    parameters = click.get_current_context().params
    for option in ("requirements", "suggest", "template", "all_distros", "policies"):
        if parameters[option]:
            name = "policy" if option == "policies" else option.replace("_", "-")
            raise UsageError(f"--upgrade-to and --{name} exclude each other", "", "Choose one.")


def _findings(family: str, paths: tuple[Path, ...], circumstances: Circumstances) -> list[Finding]:
    from sros_tool.checks.targets import (
        findings_between_folders,
        findings_in_keystore,
        path_findings,
        policy_findings,
    )
    from sros_tool.keystore.layout import is_keystore

    if family == "runtime":
        return _runtime(circumstances, says_counts=True)
    if family == "policy":
        if not paths:
            raise UsageError("no policy is named", "", "Name a file, or a folder of policies.")
        return policy_findings(paths, circumstances)
    if family == "keystore":
        if not paths and not os.environ.get(KEYSTORE_VARIABLE) and not Path(family).exists():
            raise UsageError(
                "there is no folder 'keystore' here",
                f"No other keystore is named, and {KEYSTORE_VARIABLE} is not set.",
                "Go to the folder of the keystore, or name its path.",
            )
        roots = paths or (keystore_from_environment(),)
        findings = [
            finding for root in roots for finding in findings_in_keystore(root, circumstances)
        ]
        return [*findings, *findings_between_folders(roots, circumstances)]
    if paths:
        return path_findings(paths, circumstances)
    findings = _runtime(circumstances)
    root = os.environ.get("ROS_SECURITY_KEYSTORE")
    if root and is_keystore(Path(root)):
        findings += path_findings([Path(root)], circumstances)
    elif not root:
        looked = "checked the runtime only: no path is given and ROS_SECURITY_KEYSTORE is not set"
        echo(looked, err=True)
    return list(dict.fromkeys(findings))


def _runtime(circumstances: Circumstances, *, says_counts: bool = False) -> list[Finding]:
    return _machine_findings(
        _environment(circumstances.domain),
        circumstances.now,
        {},
        advisories=circumstances.advisories,
        says_counts=says_counts,
    )


def _environment(domain: int | None) -> dict[str, str]:
    """Return the variables of this process, with the domain of --domain."""
    return {**os.environ, **({} if domain is None else {"ROS_DOMAIN_ID": str(domain)})}


def _machine_findings(
    environment: Mapping[str, str],
    moment: datetime,
    insecure_rmws: Mapping[str, str],
    libraries: tuple[MappedLibrary, ...] = (),
    advisories: tuple[Advisory, ...] | None = None,
    *,
    says_counts: bool = False,
) -> list[Finding]:
    """Return the runtime findings on this machine, for the variables in ``environment``.

    ``insecure_rmws`` maps RMWs that were found not to enforce security to the evidence.
    ``libraries`` are installed DDS libraries, and ``advisories`` are the known vulnerabilities;
    None means the advisories that ship with sros.  With ``says_counts``, a line says how many
    processes run secured and open.
    """
    from sros_tool.checks.processes import security_counts_text, unjudged_connections_text
    from sros_tool.checks.runtime import RuntimeState, runtime_findings
    from sros_tool.cli.common import local_zone
    from sros_tool.runtime.processes import ProcessTable
    from sros_tool.runtime.rmw import rmw_implementations

    zone = local_zone(environment)
    clock = now()
    rmws, running = rmw_implementations(environment), ProcessTable().look(clock)
    state = RuntimeState(
        environment, moment, zone, running, rmws, insecure_rmws, clock, libraries, advisories
    )
    if says_counts and (counts := security_counts_text(running)):
        echo(counts, err=True)
        if unjudged := unjudged_connections_text(running, clock):
            echo(unjudged, err=True)
    return runtime_findings(state)


def _with_relative_paths(finding: Finding) -> Finding:
    """Return the finding; files below the working directory get relative paths."""
    related = tuple(place._replace(file=_relative_file(place.file)) for place in finding.related)
    return finding._replace(file=_relative_file(finding.file), related=related)


def _relative_file(file: str) -> str:
    return str(relative_path(Path(file))) if file else ""


def _show_renewals(root: Path, text: str, moment: datetime, form: str) -> int:
    from sros_tool.keystore.expiry import (
        describe_lifetime,
        due_enclaves,
        expiring_enclaves,
        parse_threshold,
    )
    from sros_tool.keystore.reader import OpenedKeystore
    from sros_tool.keystore.shared_expiry import shared_expiry

    keystore = OpenedKeystore(root)
    threshold = parse_threshold(text)
    expiring = due_enclaves(keystore, threshold, moment, keystore.template)
    shared = shared_expiry(keystore, threshold, moment, now())
    if form == "json":
        print_json(expiring_enclaves(expiring, shared))
    else:
        files = [file.line(moment) for file in shared.due]
        due = [describe_lifetime(enclave, moment) for enclave in expiring.due]
        unknown = [f"{enclave.name}  unknown: {enclave.error}" for enclave in expiring.unreadable]
        unknown_files = [f"{each.file}  unknown: {each.problem}" for each in shared.unreadable]
        none = f"none of {expiring.lasting} enclaves" if expiring.lasting > 1 else "no enclave"
        none_due = f"{none} needs to be renewed ({text})"
        if expiring.short_lived and not expiring.lasting:
            none_due = ""
        left_out = [
            f"not counted: {clause}"
            for clause in filter(None, (expiring.short_lived_text(), shared.published_text()))
        ]
        if form == "markdown":
            if_none = "; ".join(filter(None, (none_due, *left_out)))
            echo_lines(renewal_markdown(due, [*unknown_files, *unknown], files, if_none, text))
        else:
            for line in (*_renewal_lines(due, unknown), *files, *unknown_files):
                echo(line)
            for remark in filter(None, ("" if due or unknown else none_due, *left_out)):
                echo(remark, err=True)
    notes = tuple(keystore.ledger_file.clock_notes(moment))
    print_notes(notes)
    is_due = expiring.due or shared.due
    is_unknown = expiring.unreadable or shared.unreadable or (notes and not is_due)
    return NOT_DONE if is_unknown else 1 if is_due else 0


def _renewal_lines(due: Sequence[str], unknown: Sequence[str]) -> Iterator[str]:
    """Yield a line on each enclave; if they are many, enclaves that expire on one day share a line.

    Those of ``unknown`` expiry come first then, so that due ones cannot hide them, and then those
    that expire first.  If steps are logged, each enclave has its own line.
    """
    lines = [*due, *unknown]
    if [*first_lines(lines)] == lines:
        yield from lines
        return
    days: dict[str, list[tuple[str, str]]] = {}
    for line in due:
        name, _, expiry = line.partition("  ")
        days.setdefault(expiry.partition("T")[0], []).append((expiry, name))
    folded = []
    for found in sorted(days.values(), key=lambda found: min(found)[0].split()[-1]):
        names = first_few([name for _, name in found], 2)
        end = " (the first)" if len({expiry for expiry, _ in found}) > 1 else ""
        folded.append(f"{names}  {min(found)[0]}{end}")
    yield from [*unknown, *folded][:MAX_NAMES]
    yield f"{len(lines)} enclaves in all (-v lists them)"


def renewal_markdown(
    due: Sequence[str],
    unknown: Sequence[str],
    files: Sequence[str],
    text_if_none: str,
    threshold: str,
) -> str:
    """Return what to renew soon as Markdown, or a sentence that there is nothing.

    ``due`` and ``files`` are lines on enclaves and shared files to renew, and ``unknown`` are lines
    on what cannot be read. ``text_if_none`` is the sentence, and ``threshold`` the
    time within which a file is due.
    """
    from sros_tool.markdown import bounded_list, code, plain

    if not (due or unknown or files):
        return f"### Certificates: {plain(text_if_none)}\n"
    things = [counted(len(due), "enclave")] if due or not files else []
    things += [counted(len(files), "shared file")] if files else []
    need = f"{enumerated(things)} {'needs' if len(due) + len(files) == 1 else 'need'} to be renewed"
    unread = f", {len(unknown)} cannot be read" if unknown else ""
    shown_by = "which `sros check --needs-renewal` shows"
    listed = bounded_list(map(code, (*files, *due, *unknown)), 4000, shown_by)
    return f"### Certificates: {need} {plain(f'({threshold})')}{unread}\n\n{listed}\n"


def _print_markdown(chosen_findings: ChosenFindings, fleet: Fleet | None) -> None:
    from sros_tool.checks.formats import findings_markdown

    echo_lines(findings_markdown(chosen_findings, fleet))


def _fleet_of(circumstances: Circumstances, paths: Sequence[Path]) -> Fleet | None:
    """Return the fleet of --fleet, with the enclaves of the policies, or else the keystore's fleet.

    Returns None if there is no fleet, or if the fleet cannot be read.
    """
    from sros_tool.keystore.fleet import load_fleet

    if circumstances.fleet is None:
        opened = [circumstances.opened[path] for path in paths if path in circumstances.opened]
        with suppress(SrosError):  # what is wrong with it is a finding
            return load_fleet(opened[0]) if len(opened) == 1 else None
        return None
    from sros_tool.fleet.expansion import fleet_with_enclaves
    from sros_tool.policy.document import files_of_policies

    files: list[Path] = []
    for path in paths:
        if path not in circumstances.opened:
            with suppress(SrosError):  # what is wrong with it is a finding
                files += files_of_policies(path)
    return fleet_with_enclaves(circumstances.fleet, files)


def _print_all(chosen_findings: ChosenFindings, _selection: FindingFilter) -> None:
    _print_text(chosen_findings)


def _print_text(chosen_findings: ChosenFindings, fleet: Fleet | None = None) -> None:
    from sros_tool.checks.kind import group_by_cause

    echo_folded(
        sorted(group_by_cause(chosen_findings.shown), key=lambda group: len(group) == 1), fleet
    )
    for choice in dict.fromkeys(finding.accepted for finding in chosen_findings.accepted):
        kinds = {e.id: e.kind.title for e in chosen_findings.accepted if e.accepted == choice}
        kinds_text = "; ".join(f"{title} [{identity}]" for identity, title in kinds.items())
        echo(f"accepted by the {choice}: {kinds_text}")
    echo(chosen_findings.summary(), err=True)


def _print_json(chosen_findings: ChosenFindings, _selection: FindingFilter) -> None:
    from sros_tool.checks.kind import shown_findings

    print_json(shown_findings(chosen_findings))


def _print_sarif(chosen_findings: ChosenFindings, selection: FindingFilter) -> None:
    from sros_tool.checks.formats import sarif
    from sros_tool.checks.kind import select_kinds

    kinds, findings = select_kinds(selection), (*chosen_findings.shown, *chosen_findings.accepted)
    echo_lines(json_text(sarif(findings, kinds, version=__version__, base=Path.cwd())))


def _print_kinds(selection: FindingFilter, form: str) -> None:
    """Print the kinds of findings that are selected."""
    from sros_tool.checks.kind import AllKinds, select_kinds

    kinds = list(select_kinds(selection))
    if form != "text":
        print_json(AllKinds(kinds))
        return
    width = max((len(kind.id) for kind in kinds), default=0)
    for kind in kinds:
        echo(f"{kind.id:{width}}  {kind.severity.word:7}  {kind.title}")


@shows(spread=("diagnosis",))
class MachineReport(NamedTuple):
    """The DDS of this machine, and whether it enforces security."""

    diagnosis: Diagnosis
    ros2_security: SecurityProvider | None
    """The package that provides ``ros2 security``; null without ros2, or if no package does."""
    findings: Sequence[Finding]
    """Findings of ``sros check runtime``."""


_PRINTERS: Mapping[str, Callable[[ChosenFindings, FindingFilter], None]] = {
    "text": _print_all,
    "json": _print_json,
    "sarif": _print_sarif,
    "markdown": lambda chosen, _selection: _print_markdown(chosen, None),
}
"""The function that prints findings, for each value of --format."""


@verb("doctor")
@click.option(
    "--report",
    "report",
    metavar="FILE",
    type=PATH,
    help="Also write FILE, to attach to a bug report: versions, environment and "
    "findings, without secrets and without names of hosts, users and paths.",
)
@force_option
@advisories_option
@json_option
def doctor(report: Path | None, force: bool, advisories: Path | None, as_json: bool) -> None:
    """Find out which DDS stacks and RMWs of this machine enforce security.

    Each DDS and RMW is tried in a separate process, in a temporary enclave, because its name and
    version do not show whether it was built with security. sros also names the known
    vulnerabilities of each DDS, and reports the findings of `sros check runtime`, such as
    misspelled ROS_SECURITY_* values, missing files or a wrong clock.

    Example:
      $ sros doctor
      DDS Security can be enforced here, by Cyclone DDS (libddsc), but NOT by ROS
      nodes: rmw_fastrtps_cpp does not enforce it. The ROS 2 packages of ...
      rclpy with rmw_fastrtps_cpp  does not enforce it  Fast DDS 2.14.5
          a secured participant fails: RCLError: error creating node: This Fast
          DDS version doesn't have the security libraries
      Cyclone DDS (libddsc)        enforces security    Cyclone DDS 0.10.2
          with an enclave made by sros, it created the allowed writer on /chatter
          and refused the denied writer and reader on /sros_not_allowed: ...
      $ sros doctor --report support.md

    Exit status: 1 if the RMW that ROS nodes use here does not enforce security (without
    any RMW: if nothing here does), or if a finding is an error; else 0.
    """
    from sros_tool.checks.kind import ERROR, WARNING
    from sros_tool.checks.vulnerabilities import NOTES_ON_LIBRARIES
    from sros_tool.demo.doctor import diagnosis_text, examine, security_provider, support_report

    if force and not report:
        raise UsageError("--force is for --report", "", "Add --report FILE, or leave --force out.")
    if report:
        check_output(report, force=force)
    known = advisories_of(advisories)
    moment = now()
    diagnosis = examine(moment)
    insecure = {
        stack.rmw: stack.evidence
        for stack in diagnosis.stacks
        if stack.rmw and stack.enforces is False
    }
    findings = _machine_findings(os.environ, moment, insecure, diagnosis.libraries, known)
    provider = security_provider(os.environ)
    if as_json:
        print_json(MachineReport(diagnosis, provider, findings))
    else:
        echo_lines(diagnosis_text(diagnosis))
        if provider:
            echo(str(provider))
        for finding in findings:
            if finding.severity >= WARNING or finding.kind in NOTES_ON_LIBRARIES:
                echo("")
                echo_findings([finding])
    if report:
        lines = _report_sections(diagnosis, provider, findings)
        text = support_report(os.environ, lines, secrets=removed_secrets())
        document = visible(text).encode("utf-8", "backslashreplace")
        echo(f"{save(report, document)}; read it before you attach it", err=True)
    if not diagnosis.sound or any(finding.severity >= ERROR for finding in findings):
        sys.exit(1)


def _report_sections(
    diagnosis: Diagnosis, provider: SecurityProvider | None, findings: Sequence[Finding]
) -> dict[str, list[str]]:
    """Return the lines of a support report; findings are counted by kind, without names."""
    words = {
        True: "enforces security",
        False: "does not enforce security",
        None: "could not be tried",
    }
    stacks = [
        f"{stack.name}: {words[stack.enforces]}. {stack.dds} {stack.version}. {stack.evidence}"
        for stack in diagnosis.stacks
        if stack.present
    ]
    counted = Counter(
        (finding.severity.word, finding.id, finding.kind.title) for finding in findings
    )
    return {
        "DDS": [*stacks, diagnosis.conclusion],
        "ros2 security": [str(provider)] if provider else [],
        "Findings": [
            f"{number} × {severity}: {title} [{identity}]"
            for (severity, identity, title), number in counted.items()
        ],
    }


# ── check runtime --watch ──────────────────────────────────────────────────────────────────


_POLL_SECONDS = 2.0
"""Seconds between two looks at the processes."""
_RECHECK_AFTER = timedelta(minutes=1)
"""Time after which unchanged processes are checked again, because their files may have expired."""
_ENDING_SIGNALS = (signal.SIGINT, signal.SIGTERM)


def _watch_processes(
    environment: Mapping[str, str],
    selection: FindingFilter,
    advisories: tuple[Advisory, ...] | None,
    *,
    as_json: bool,
) -> None:
    """Report changes of the findings about processes, until SIGINT or SIGTERM."""
    from sros_tool.checks.processes import process_findings
    from sros_tool.checks.runtime import PreviousFindings
    from sros_tool.checks.vulnerabilities import vulnerability_findings
    from sros_tool.runtime.processes import ProcessTable

    table, news, zone = ProcessTable(), PreviousFindings(), local_zone(environment)
    judged: tuple[RunningProcesses, datetime] | None = None
    # A blocked signal is received only by the wait below, so that it interrupts no output.
    before = signal.pthread_sigmask(signal.SIG_BLOCK, _ENDING_SIGNALS)
    try:
        echo("watching the processes of this machine until SIGINT (Ctrl-C) or SIGTERM", err=True)
        while True:
            moment = now()
            running = table.look(moment)
            if judged is None or judged[0] != running or moment - judged[1] >= _RECHECK_AFTER:
                judged = running, moment
                findings = [
                    *process_findings(
                        environment, running, now=moment, zone=zone, finding_per_node=True
                    ),
                    *vulnerability_findings(running, (), advisories),
                ]
                for change in news.changes(selection.choose(findings).shown, moment):
                    if as_json:
                        line = json.dumps(versioned(change), ensure_ascii=False)
                        echo_lines(visible_json(line))
                    else:
                        echo(str(change))
            if signal.sigtimedwait(_ENDING_SIGNALS, _POLL_SECONDS):
                return
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


@verb("metrics")
@keystore_argument()
@output_option("Replace FILE (*.prom) atomically instead of printing.")
@click.option(
    "--earliest",
    is_flag=True,
    help="Print only the earliest expiry, not the expiry of every enclave; for large keystores.",
)
@click.option(
    "--policy",
    "policies",
    type=PATH,
    multiple=True,
    metavar="FILE",
    help="Also print the number of differences between the keystore and this policy.  Can "
    "be repeated.",
)
@fleet_option("The robots that the placeholders of the policies stand for.")
@click.option(
    "--runtime",
    is_flag=True,
    help="Also print the number of running ROS processes, by the state of their security.",
)
@advisories_option
@dry_run_option
@json_option
def metrics(
    root: Path,
    output: Path | None,
    earliest: bool,
    policies: tuple[Path, ...],
    fleet_file: Path | None,
    runtime: bool,
    advisories: Path | None,
    dry_run: bool,
    as_json: bool,
) -> None:
    """Give Prometheus the expiry of all files of a keystore, and the number of findings.

    KEYSTORE is a keystore, or an export on a robot. The text is for the textfile collector of
    node_exporter.

    Example:
      $ sros metrics keystore -o /var/lib/prometheus/node-exporter/sros.prom
      $ sros metrics keystore | grep earliest
      sros_earliest_expiry_timestamp_seconds{keystore="/home/robot/keystore",...

    The exit status is 0 even if there are findings. The exit status is 2 if the keystore cannot be
    examined; then FILE does not change, so alert also on an old sros_examined_timestamp_seconds.
    """
    from sros_tool.checks.formats import keystore_metrics
    from sros_tool.checks.keystores.keystore import keystore_findings
    from sros_tool.prometheus import KeystoreMetrics, render_metrics

    if output:
        check_metrics_file(output)
        check_output(output, force=True)
    if fleet_file and not policies:
        raise UsageError("--fleet is for the placeholders of a policy: add --policy FILE")
    if advisories and not runtime:
        raise UsageError("--advisories needs the DDS of processes: add --runtime")
    known = advisories_of(advisories)
    circumstances = _circumstances(None, None, policies, fleet_file, (root,))
    with progress("examining"):
        keystore = circumstances.keystore(root)
        findings = keystore_findings(keystore, circumstances)
        moment = circumstances.now
        gauges = keystore_metrics(keystore, findings, now=moment, each_enclave=not earliest)
        gauges += _process_metrics(moment, known) if runtime else ()
    text = render_metrics(gauges)
    changes = file_change(output, existed=output.exists()) if output else ()
    saved = save(output, text.encode()) if output and not dry_run else ""
    if as_json:
        print_json(KeystoreMetrics(root, gauges, dry_run, changes, ()))
    elif dry_run:
        echo(f"would write {output or 'to standard output'}: {len(text)} characters")
    elif output:
        echo(saved, err=True)
    else:
        echo_document(text)


def _process_metrics(
    moment: datetime, advisories: tuple[Advisory, ...] | None
) -> tuple[Metric, ...]:
    from sros_tool.checks.processes import runtime_metrics
    from sros_tool.runtime.processes import ProcessTable

    running = ProcessTable().look(moment)
    zone = local_zone(os.environ)
    return runtime_metrics(os.environ, running, now=moment, zone=zone, advisories=advisories)
