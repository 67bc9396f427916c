"""The verb `audit`: try a policy on the running robot without denying anything."""

from __future__ import annotations

import os
import shlex
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import click

from sros_tool.cli.common import (
    PATH,
    check_output,
    distro_option,
    dry_run_option,
    fleet_option,
    force_option,
    json_option,
    keystore_from_environment,
    local_zone,
    now,
    print_json,
    print_notes,
    relative_path,
    save,
    verb,
)
from sros_tool.cli.observing import (
    WatchingVerb,
    check_duration,
    observe,
    observer_environment,
    observing_options,
    why_no_node_was_observed,
)
from sros_tool.dds.decision.vendors import Vendor
from sros_tool.errors import KeystoreError, Note, UnavailableError, UsageError
from sros_tool.terminal import echo
from sros_tool.values import file_change
from sros_tool.wording import counted, enumerated

if TYPE_CHECKING:
    from sros_tool.distributions import Distribution
    from sros_tool.explain.audit import Audit, AuditedEnclaves
    from sros_tool.fleet.robots import Fleet
    from sros_tool.graph.observation import Observation


@verb("audit", cls=WatchingVerb)
@click.argument("sources", metavar="[POLICY...|KEYSTORE]", type=PATH, nargs=-1)
@observing_options("Run the observer in this enclave, if the robot is already secured.")
@click.option(
    "--vendor",
    type=click.Choice([vendor.value for vendor in Vendor]),
    metavar="VENDOR",
    help=f"Decide as this DDS vendor does: {', '.join(vendor.value for vendor in Vendor)}. "
    "[default: the vendor of this machine's RMW]",
)
@distro_option(
    "Decide as a DDS that this ROS 2 distribution ships, such as lyrical: the DDS of --vendor or "
    "$RMW_IMPLEMENTATION, else the default DDS of the distribution. [default: $ROS_DISTRO]"
)
@click.option(
    "--patch",
    type=PATH,
    metavar="FILE",
    help="Write the missing rights to FILE, as a policy for merge_policy.",
)
@click.option(
    "--partial",
    is_flag=True,
    help="Accept that some nodes were not seen (otherwise, exit with 1).",
)
@click.option(
    "--unjudged",
    is_flag=True,
    help=(
        "Accept that sros did not judge a part of the graph, such as a tool that writes "
        "(otherwise, exit with 1)."
    ),
)
@click.option(
    "--unsettled",
    is_flag=True,
    help="Accept that the graph kept changing (otherwise, exit with 1).",
)
@fleet_option("The robots that the placeholders of POLICY stand for.")
@force_option
@dry_run_option
@json_option
def audit(
    sources: tuple[Path, ...],
    watch: str | None,
    spin_time: float | None,
    domain: str | None,
    enclave: str | None,
    keystore: Path | None,
    vendor: str | None,
    distro: Distribution | None,
    patch: Path | None,
    partial: bool,
    unjudged: bool,
    unsettled: bool,
    fleet_file: Path | None,
    force: bool,
    dry_run: bool,
    as_json: bool,
) -> int:
    """Report what policies or a keystore would deny to the nodes that are running now.

    Nothing is denied: DDS has no permissive mode, so sros observes the ROS graph and decides about
    every endpoint as the DDS vendor would. A node has the rights of the enclave that the graph
    shows for it, or else of the enclave whose profiles name it. By default, sros observes until the
    graph stops changing; --watch also sees endpoints that nodes create later. Several policies
    count as one. Without POLICY and KEYSTORE, the keystore of $ROS_SECURITY_KEYSTORE decides. For
    nodes on Zenoh, the files that `sros zenoh` wrote into KEYSTORE decide, unless --vendor is
    given.

    Example:
      $ sros audit robot.xml
      /talker publish topic /status (/talker): no rule allows publish rt/status
      1 right would be denied to 2 nodes with 47 endpoints, on Fast DDS 2.14
      to allow the denied access, add --patch missing.xml: ...
      $ sros audit robot.xml --watch 1h --patch missing.xml
      watching for 3600 s, or until Ctrl-C; then the result is shown
      denied: /talker publish topic /status (/talker): no rule allows ...
      ...
      wrote 'missing.xml'; add it: sros merge_policy robot.xml missing.xml ...
      $ sros merge_policy robot.xml missing.xml --in-place
      $ sros audit keystore --distro lyrical

    Exit status: 0 if nothing would be denied and every node of POLICY or KEYSTORE was seen; 1 if
    something would be denied; also 1 if a node was not seen (unless --partial is given), if
    something was not judged (unless --unjudged is given), and if the graph kept changing (unless
    --unsettled is given); 2 if the audit could not be done.
    """
    from sros_tool.distributions import ROS_DISTRO, sourced_distribution, unknown_distribution_notes
    from sros_tool.explain import audit as audits
    from sros_tool.fleet.fleet_file import read_fleet
    from sros_tool.keystore.participant import JoinContext
    from sros_tool.runtime.environment import RMW_ZENOH
    from sros_tool.runtime.rmw import chosen_vendor
    from sros_tool.runtime.variables import ENCLAVE, domain_from

    check_duration(watch, spin_time)
    sources = sources or (keystore_from_environment(),)
    compared = enumerated([f"'{source}'" for source in sources])
    environment = observer_environment(
        enclave,
        keystore,
        domain,
        f"{compared} {'is' if len(sources) == 1 else 'are'} compared with the robot",
    )
    if force and patch is None:
        raise UsageError("--force is for --patch only", "", "Leave it out.")
    if patch is not None:
        check_output(patch, force=force)
    if not (vendor or distro):
        print_notes(unknown_distribution_notes(os.environ))
    variables = {**os.environ, **environment}
    enclaves = audits.audited_enclaves(
        sources,
        chosen_vendor(vendor, distro, variables)[0],
        JoinContext(domain_from(variables) or 0, now(), local_zone(os.environ)),
        read_fleet(fleet_file) if fleet_file else None,
    )
    observer = environment.get(ENCLAVE, "")

    def judge(observation: Observation) -> Audit:
        return audits.audit(observation, enclaves, observer)

    reported: set[str] = set()

    def report(observation: Observation) -> None:
        # Unseen nodes may still appear, so no line suggests yet that a node has another name.
        for key, line in replace(judge(observation), unseen=()).lines().items():
            if key not in reported:
                reported.add(key)
                echo(f"denied: {line}", err=True)

    at_end = "the result is shown"
    snapshot, rmw = observe(environment, watch, spin_time, report, at_end=at_end)
    on_zenoh, unknown = rmw == RMW_ZENOH, ""
    if on_zenoh and enclaves.keystore and not vendor:
        try:
            enclaves = enclaves.on_zenoh()
        except KeystoreError as error:
            unknown = str(error)
    audited = judge(snapshot.everything)
    if unknown:
        notes = (
            *audited.notes,
            Note(
                "audit.zenoh-unknown",
                f"the rules of a DDS vendor decided, not the keystore's files for Zenoh: {unknown}",
            ),
        )
        audited = replace(audited, unjudged=(*audited.unjudged, _NO_ZENOH_FILES), notes=notes)
    left_out = [
        text
        for is_left_out, text in (
            (audited.unseen and not partial, _UNSEEN),
            (audited.unjudged and not unjudged, _UNJUDGED),
            (snapshot.unsettled and not unsettled, _UNSETTLED),
        )
        if is_left_out
    ]
    fine = audited.allowed and not left_out
    if not audited.observation.nodes:
        raise UnavailableError(
            "there is nothing to audit: no node was observed",
            why_no_node_was_observed(environment, snapshot.seconds, rmw, enclave),
        )
    ended = audits.notes_on_ended_nodes(snapshot.gone, snapshot.everything)
    by_vendor = (audits.BY_VENDOR_ON_ZENOH,) if on_zenoh and not (enclaves.zenoh or unknown) else ()
    decides = distro or (None if vendor else sourced_distribution(variables.get(ROS_DISTRO)))
    assumption = decides.assumption if decides and not enclaves.zenoh else ""
    assumed = (Note("audit.assumed-distribution", assumption),) if assumption else ()
    audited = replace(audited, notes=(*audited.notes, *ended, *by_vendor, *assumed))
    existed = patch is not None and patch.exists()
    written = _write_patch(audited, patch, dry_run=dry_run)
    if as_json:
        from sros_tool.explain.audit import AuditResult, RefusedEnclave

        refused = sorted(audited.refused.items())
        print_json(
            AuditResult(
                sources[0],
                sources[1:],
                enclaves.what,
                "zenoh" if enclaves.zenoh else enclaves.vendor,
                enclaves.context.domain,
                fine,
                denied=audited.denied,
                refused=[RefusedEnclave(name, reason) for name, reason in refused],
                unseen=audited.unseen,
                unjudged=audited.unjudged,
                tools=audited.tools,
                observation=audited.observation,
                settled=not snapshot.unsettled,
                partial=partial,
                unjudged_accepted=unjudged,
                unsettled_accepted=unsettled,
                patch=patch if written else None,
                dry_run=dry_run,
                changes=file_change(patch, existed=existed) if patch and written else (),
                notes=(*audited.notes, *audited.missing.notes),
            )
        )
    else:
        _show(audited, enclaves, snapshot.unsettled, on_zenoh=on_zenoh)
    print_notes((*audited.notes, *audited.missing.notes))
    if audited.allowed and left_out:
        echo(f"the exit status is 1: {'; '.join(left_out)}", err=True)
    if written:
        one_policy = enclaves.what == "policy" and len(sources) == 1
        policy = shlex.quote(str(relative_path(sources[0]))) if one_policy else "POLICY"
        command = f"add it: sros merge_policy {policy} {shlex.quote(str(patch))} --in-place"
        by_hand = (
            _advice_to_add_by_hand(sources, read_fleet(fleet_file), audited) if fleet_file else ""
        )
        echo(f"{written}; {by_hand or command}", err=True)
    elif patch is None and audited.missing.profiles:
        echo(_ALLOW_ADVICE, err=True)
    elif patch is not None:
        stays = f"; the earlier '{patch}' stays" if existed else ""
        patch_remark = _NO_PATCH_ELSEWHERE if audited.misplaced else _NO_PATCH
        patch_remark = "no patch is needed" if audited.allowed else patch_remark
        echo(patch_remark + stays, err=True)
    return 0 if fine else 1


_UNSEEN = "nodes were not seen (--watch finds nodes that start later, --partial accepts this)"
_UNJUDGED = "a part of the graph was not judged (--unjudged accepts this)"
_UNSETTLED = (
    "the graph was not seen standing still (a longer --watch finds later endpoints, --unsettled "
    "accepts this)"
)
_NO_ZENOH_FILES = "what the keystore's files for Zenoh allow"
_ALLOW_ADVICE = (
    "to allow the denied access, add --patch missing.xml: sros then writes the missing rights as a "
    "policy, and names the command that adds them"
)
_WRITE_ZENOH_FILES = (
    "the permissions allow some of these rights, but the keystore's files for Zenoh do not: write "
    "the files again with `sros zenoh KEYSTORE`, and restart the processes that it names"
)
_NO_PATCH = "no patch was written: no additional right would allow the denied access"

_NO_PATCH_ELSEWHERE = "no patch was written: first give the nodes of each process one enclave"


def _write_patch(audited: Audit, patch: Path | None, *, dry_run: bool) -> str:
    """Write missing rights to ``patch``; return a clause about it, "" if no right is missing."""
    from sros_tool.graph.learn import render

    if patch is None or not audited.missing.profiles:
        return ""
    document = render(audited.missing)
    if dry_run:
        return f"would {'replace' if patch.exists() else 'write'} '{patch}'"
    return save(patch, document)


def _advice_to_add_by_hand(sources: Sequence[Path], fleet: Fleet, audited: Audit) -> str:
    """Return where to add the missing rights if policies have placeholders; "" if none has any."""
    from sros_tool.fleet.expansion import FleetPolicy
    from sros_tool.policy.document import join_policies, read_policy

    stated = join_policies([read_policy(source, placeholders=True) for source in sources])
    policy = FleetPolicy(stated, fleet)
    if policy.policy() == stated:
        return ""
    missing = dict.fromkeys(profile.enclave for profile in audited.missing.profiles)
    of = dict.fromkeys(policy.stated_enclave(name)[0] for name in missing if name in policy)
    places = [f"{enclave.source} ({enclave.path})" for enclave in of] or [str(sources[0])]
    return f"add its rights by hand, with placeholders, at {', '.join(places)}"


# ── output ──────────────────────────────────────────────────────────────────────────────


def _show(audited: Audit, enclaves: AuditedEnclaves, unsettled: str, *, on_zenoh: bool) -> None:
    """Print denied rights, unseen nodes and a verdict that says what the audit did not cover."""
    for line in (*audited.lines().values(), *(f"not seen: {node}" for node in audited.unseen)):
        echo(line)
    problems = [counted(len(audited.denied), "right")] if audited.denied else []
    problems += [counted(len(audited.refused), "whole enclave")] if audited.refused else []
    verdict = f"{' and '.join(problems) or 'nothing'} would be denied to "
    verdict += f"{counted(len(audited.observation.nodes), 'node')} with "
    decided_by = f"{'by the rules of' if on_zenoh else 'on'} {enclaves.vendor.title}"
    if enclaves.zenoh:
        decided_by = "by the keystore's files for Zenoh"
    verdict += f"{counted(audited.observation.endpoint_count, 'endpoint')}, {decided_by}"
    if audited.unseen:
        number, of = len(audited.expected), len(audited.expected) - len(audited.unseen)
        seen = f"{of} of {counted(number, 'node')} of the {enclaves.what}"
        verdict = f"only {seen} {'was' if 1 in (of, number) else 'were'} seen: {verdict}"
    if audited.unjudged:
        verdict += f"; not judged: {', '.join(audited.unjudged)}"
    if unsettled:
        verdict += f"; {unsettled}"
    echo(verdict, err=True)
    if any(denied_right.by_rule for denied_right in audited.denied):
        echo(
            "some of these rights are denied by a DENY; no additional right overrides a DENY",
            err=True,
        )
    if any(denied_right.by_files for denied_right in audited.denied):
        echo(_WRITE_ZENOH_FILES, err=True)
