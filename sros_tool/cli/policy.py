"""The verbs on policies: `merge_policy`, `diff_policy`, `minimize_policy` and `policies`."""

from __future__ import annotations

import logging
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import groupby
from pathlib import Path
from shlex import quote
from typing import TYPE_CHECKING, Any, NamedTuple

import click

from sros_tool.cli.common import (
    PATH,
    SeveralValues,
    check_one_format,
    check_output,
    dry_run_option,
    fleet_option,
    fleets_of,
    fleets_option,
    force_option,
    json_option,
    output_option,
    print_json,
    print_notes,
    progress,
    refuse_git_revision,
    save,
    verb,
)
from sros_tool.errors import PolicyError, UsageError
from sros_tool.terminal import echo, echo_document, echo_lines
from sros_tool.values import FileChange, as_plain, file_change
from sros_tool.wording import counted, first_few

if TYPE_CHECKING:
    from sros_tool.fleet.robots import Fleet
    from sros_tool.keystore.issuing.size import MinimizedEnclave
    from sros_tool.keystore.rights import RightsSource, SourcesDifference
    from sros_tool.policy.merge import Merged
    from sros_tool.policy.model import Policy, Source, StatedProtection
    from sros_tool.policy.rights import RightsDifference
    from sros_tool.proof.growth import DroppedDenial, Gain, Growth, NewNode, NewReach
    from sros_tool.proof.sources import AccessSource


# ── merge_policy ────────────────────────────────────────────────────────────────────────


@verb("merge_policy")
@click.argument("policy", metavar="POLICY", type=PATH)
@click.argument("others", metavar="OTHER...", type=PATH, nargs=-1, required=True)
@click.option(
    "--namespace",
    metavar="NS",
    help="Put the enclaves and nodes of OTHER into this namespace, such as /left, with all names "
    "that do not begin with '/'.",
)
@click.option(
    "--remap",
    "remaps",
    metavar="[NODE:]FROM:=TO",
    multiple=True,
    help="Remap a name of OTHER, as `--ros-args -r` does for a node; also __node:=NAME, __ns:=NS. "
    "Applies after --namespace.  If requirements still have an old name, a note gives the "
    "options for `sros check`.  `sros check` takes no __ns: use --namespace in both commands.  Can "
    "be repeated.",
)
@click.option(
    "--enclave",
    metavar="ENCLAVE",
    help="Put all nodes of OTHER into this enclave.  Use it if one process composes them.",
)
@click.option(
    "--node",
    "nodes",
    metavar="NODE",
    multiple=True,
    help="Take only the nodes of this name from OTHER.  Can be repeated.",
)
@output_option("Write the result to FILE.")
@click.option("--in-place", is_flag=True, help="Overwrite POLICY with the result.")
@force_option
@dry_run_option
@json_option
def merge_policy(
    policy: Path,
    others: tuple[Path, ...],
    namespace: str | None,
    remaps: tuple[str, ...],
    enclave: str | None,
    nodes: tuple[str, ...],
    output: Path | None,
    in_place: bool,
    force: bool,
    dry_run: bool,
    as_json: bool,
) -> None:
    """Print POLICY with the rights of every OTHER policy added.

    Comments, includes, metadata and layout of POLICY do not change. POLICY can be without enclaves
    (`<enclaves/>`). A right is added only if the enclave does not have it yet; rights from includes
    and wildcards count. Where a profile of OTHER includes common parts, the new profile in POLICY
    includes the same parts from POLICY's folder. Publish and subscribe are separate rights. A DENY
    always stays and always wins over an ALLOW, and a note names the ALLOW. If the policies state
    different protect= values for a name, nothing is written.

    Example:
      $ sros merge_policy robot.xml learned.xml --in-place
      added 2 rights
        /talker ALLOW publish topic /diagnostics
        /talker ALLOW subscribe topic /tf
      note [merge.still-denied]: /talker DENY publish topic /cmd_vel stays ...
      replaced 'robot.xml'
      $ sros merge_policy robot.xml gripper.xml --namespace /left --in-place
      $ sros merge_policy robot.xml camera.xml --remap image:=/front/image \\
            --in-place
      $ sros merge_policy robot.xml camera.xml --enclave /pipeline \\
            --node driver --node rectify --in-place
    """
    from sros_tool.graph.learn import merge_policies
    from sros_tool.policy.document import read_policy
    from sros_tool.policy.merge import EditedText, MergedPolicy

    if in_place and output:
        raise UsageError("--in-place and --output exclude each other", "", "Choose one.")
    target = policy if in_place else output
    if output:
        check_output(output, force=force)
    merged = merge_policies(
        policy,
        [read_policy(path) for path in others],
        namespace,
        remaps,
        enclave,
        nodes,
        may_include=output is None or output.parent.resolve() == policy.parent.resolve(),
    )
    if output:
        _check_includes(policy, output, merged.document)
    saved = ""
    changes: Sequence[FileChange] = ()
    if target and (merged.added or output):
        changes = file_change(target, existed=target.exists())
        saved = "" if dry_run else save(target, merged.document)
    if as_json:
        to_show = target is None and not dry_run
        print_json(
            MergedPolicy(
                policy,
                merged.added,
                merged.contradictions,
                output=target if saved else None,
                document=EditedText(merged.document, str(policy)).text if to_show else None,
                dry_run=dry_run,
                changes=changes,
                notes=merged.notes,
            )
        )
    elif dry_run:
        for right in merged.added:
            echo(f"would add {right}")
        if target and (merged.added or output):
            echo(f"would {'replace' if target.exists() else 'write'} {target}")
        if not merged.added:
            echo("no right would be added")
    elif target is None:
        echo_document(merged.document)
    if not dry_run and not as_json:
        _print_added(merged)
    print_notes(merged.notes)
    if saved:
        echo(saved, err=True)


_MOST_ADDED = 20
_MAX_LISTED_PER_ENCLAVE = 2
"""Maximum number of rights that a merge lists for an enclave; of more rights, it shows the number.
"""


def _print_added(merged: Merged) -> None:
    count = len(merged.added)
    if not count:
        echo("no right was added", err=True)
        return
    from sros_tool.policy.node_basics import NodeRights

    nodes = NodeRights(merged.rights)
    rights_shown = [right for right in merged.added if not nodes.needs(right)]
    folded = len(rights_shown) > _MOST_ADDED and not logging.getLogger("sros_tool").isEnabledFor(
        logging.INFO
    )
    echo(f"added {counted(count, 'right')}{' (-v lists all)' * folded}", err=True)
    if folded:
        for enclave, rights in groupby(rights_shown, lambda right: right.enclave):
            texts = [str(right).removeprefix(f"{enclave} ") for right in rights]
            echo(f"  {enclave} {first_few(texts, _MAX_LISTED_PER_ENCLAVE)}", err=True)
    else:
        for right in rights_shown:
            echo(f"  {right}", err=True)
    if left_out := count - len(rights_shown):
        echo(f"  and {counted(left_out, 'right')} that every node needs", err=True)


def _check_includes(policy: Path, output: Path, document: bytes) -> None:
    """Raise `PolicyError` if the policy's relative includes would not work from ``output``."""
    from sros_tool.policy.document import read_policy

    try:
        is_same = read_policy(output, document) == read_policy(policy, document)
    except PolicyError:
        is_same = False
    if not is_same:
        raise PolicyError(
            f"the result cannot be written to '{output}'",
            f"In that folder, the relative includes of '{policy}' would name other files.",
            f"Write it to the folder of '{policy}'.",
        )


# ── diff_policy ─────────────────────────────────────────────────────────────────────────


@verb("diff_policy")
@click.argument("a", metavar="A", type=PATH)
@click.argument("b", metavar="B", type=PATH)
@fleets_option
@click.option(
    "--no-new-access",
    is_flag=True,
    help="Report only access that B gives and A does not, decided for all possible names.",
)
@click.option(
    "--format",
    "form",
    type=click.Choice(["text", "json", "markdown"]),
    default="text",
    show_default=True,
    help="Output format: text, JSON, or Markdown with a picture for a pull request.",
)
@json_option
def diff_policy(
    a: Path,
    b: Path,
    fleet_files: tuple[Path, ...],
    no_new_access: bool,
    form: str,
    as_json: bool,
) -> int:
    """Compare the rights that A and B give: "-" is only in A, "+" only in B.

    "~" marks an enclave that has the same rights under another name. It also marks a name that
    became absolute or relative (cmd, /cmd), which gives other rights only to users who put the node
    into another namespace. A and B are policies, folders of policies, permissions (.p7s or .xml),
    folders of enclaves, keystores, exports, or Zenoh configurations such as router.json5.
    Permissions and Zenoh rules are shown in ROS terms; the signature of permissions is verified if
    the permissions CA is next to them. "!" marks a right of B whose counterpart, such as the
    subscriber, only A has, and a name that only B has, if a wildcard that A and B have allows an
    enclave to send to it, or to serve it. If A or B covers only some enclaves, as an export does,
    only these are compared. If only one side has Zenoh routers, and these have only the rights that
    every node needs, they do not count as a difference; a note names them. Lines that differ only
    in the robot of a fleet are shown as one. Two policies are also compared by the protection that
    they demand, two keystores by their governance.

    The exit status is 1 if A and B differ (notes name differences that are not in the rights),
    or if DDS would refuse A or B.

    With --no-new-access, A and B can also be policies at a git revision, as git:REVISION:PATH; the
    output calls A BASE, and B HEAD. The exit status is 0 only if, for every vendor, domain and
    name, B gives no enclave any access that A does not give. Also, B must not assign a node to an
    enclave with more rights, must not protect anything less, and must not give more access to users
    who put the node into another namespace. The exit status is 2 if sros cannot decide this. sros
    assumes that a policy is signed with a governance that controls all access. If A is a policy,
    and B is a keystore that protects less than the template production, this counts as more access.
    If A is a keystore, and B is a policy, B never counts as protecting less. The last line says
    what is assumed and what is left out, such as dates. Here, "!" marks a DENY of A that B lacks,
    for names that B does not allow. If only a DENY is missing, nobody gets access, so the exit
    status is 0, but `sros review` fails.

    Example:
      $ sros diff_policy robot.xml keystore
      - /talker ALLOW publish topic /status
      - /talker ALLOW request service /*
      + /talker ALLOW request service /add_two_ints  (A has it as part of ...
      3 rights differ
      $ sros diff_policy robot.xml keystore/enclaves/talker/permissions.p7s
      $ sros diff_policy keystore keystore/enclaves/router/router.json5
      $ sros diff_policy robot.xml robot.xml --fleet old.toml --fleet new.toml
      $ sros diff_policy --no-new-access git:main:robot.xml robot.xml
      + /talker publish topic /arm_*  (robot.xml:7): such as /arm_c
      1 right is new
    """
    from sros_tool.fleet.changes import renewal_notes
    from sros_tool.keystore.rights import (
        compare_sources,
        load_rights,
        policy_difference,
        without_enclaves_of_sros,
    )

    check_one_format()
    form = "json" if as_json else form
    if no_new_access:
        return _show_new_access(a, b, fleets_of(fleet_files), form)
    refuse_git_revision((a, b), "Add --no-new-access.")
    with progress("reading"):
        fleets = fleets_of(fleet_files)
        first, second = load_rights(a, fleets[0]), load_rights(b, fleets[-1])
    first, second = without_enclaves_of_sros(first, second), without_enclaves_of_sros(second, first)
    notes = (*second.notes, *renewal_notes(first.fleet, second.fleet))
    second = replace(second, notes=notes)
    compared = compare_sources(first, second, governance=True)
    difference, protections = compared.rights, compared.protections
    if form == "json":
        print_json(policy_difference(first, second, compared))
    elif form == "markdown":
        echo_lines(rights_markdown(first, second, compared))
    else:
        lines = folded_differences(first, second, difference)
        lines += enclave_lines(compared, first.fleet or second.fleet)
        unanswered = unanswered_lines(compared, second.fleet)
        forms = changed_form_lines(compared, second.fleet)
        for line in (*lines, *protection_lines(protections), *forms, *unanswered):
            echo(line)
        count = len(difference.only_first) + len(difference.only_second)
        of = f" of {first_few(sorted(compared.scope), _MOST_NEW_LINES)}" if compared.scope else ""
        differ = f"1 right{of} differs" if count == 1 else f"{count} rights{of} differ"
        other_parts = compared.domains, compared.enclaves, compared.unclear, compared.changed_forms
        if count or not any(map(bool, other_parts)):
            echo(differ if count else f"the rights{of} are the same", err=True)
        of_keystore = {right.enclave for right in difference.only_first} - second.stated_enclaves()
        if of_keystore and (first.kind, second.kind) == ("keystore", "policy"):
            kept = first_few(sorted(of_keystore), _MOST_NEW_LINES)
            them = "it" if len(of_keystore) == 1 else "them"
            echo(
                f"B lacks {kept}: signing B does not change {them}; `sros revoke` takes away all "
                "rights of an enclave",
                err=True,
            )
        if compared.changed_forms:
            became = f"{counted(len(compared.changed_forms), 'name')} became absolute or relative"
            differ = "for users who put the node into another namespace, the rights differ"
            echo(f"{became}: {differ}", err=True)
        if compared.domains:
            number = counted(len(compared.domains), "enclave")
            echo(f"the ROS domains of {number} differ", err=True)
        if compared.enclaves:
            number = counted(len(compared.enclaves), "enclave")
            echo(f"{number} without rights, on one side only", err=True)
        if compared.unclear:
            number = counted(len(compared.unclear), "enclave")
            echo(
                f"the permissions of {number} differ in ways that the notes below describe",
                err=True,
            )
        if protections:
            echo("the policies demand different protection", err=True)
        if compared.governance_differs:
            command = f"sros diff_policy --no-new-access {quote(str(a))} {quote(str(b))}"
            shows = f"`{command}` shows what B opens, `sros inspect` shows each governance"
            echo(f"the governance differs: {shows}", err=True)
        if count and _have_same_nodes_elsewhere(first.policy, second.policy):
            command = f"sros minimize_policy {quote(str(a))} --observed {quote(str(b))}"
            echo(
                "the same nodes have enclaves with other names: if B was learned from a robot, "
                f"`{command}` compares the rights of each node",
                err=True,
            )
    print_notes((*first.notes, *second.notes))
    return 0 if not compared and first.sound and second.sound else 1


def _have_same_nodes_elsewhere(first: Policy | None, second: Policy | None) -> bool:
    """Return whether two policies have the same nodes, but some in no enclave of the same name."""
    if not first or not second:
        return False
    places, others = (
        {(node, enclave) for enclave, nodes in policy.nodes().items() for node in nodes}
        for policy in (first, second)
    )
    nodes, other_nodes, unmoved = (
        {node for node, _ in each} for each in (places, others, places & others)
    )
    return nodes == other_nodes != unmoved


_MOST_LINES, _MOST_PICTURE, _MOST_LINKS = 12_000, 25_000, 250
"""Maximum characters of a difference in Markdown, and maximum characters and arrows of its picture.

A comment on GitHub has at most 65,536 characters; Mermaid draws at most 50,000, and 500 arrows.
"""


def rights_markdown(
    first_source: RightsSource, second_source: RightsSource, difference: SourcesDifference
) -> str:
    """Return how rights differ as Markdown, with a picture."""
    from sros_tool.markdown import bounded_list, code, fenced, plain
    from sros_tool.report.sources import drawn_difference

    drawn = drawn_difference(
        first_source, second_source, difference.rights, letters=_MOST_PICTURE, arrows=_MOST_LINKS
    )
    lines = folded_differences(first_source, second_source, difference.rights)
    lines += enclave_lines(difference, first_source.fleet or second_source.fleet)
    lines += protection_lines(difference.protections)
    parts = []
    shown_by = "which `sros diff_policy` shows"
    if forms := list(changed_form_lines(difference, second_source.fleet)):
        parts.append(f"**{counted(len(forms), 'name')} made absolute or relative**")
        parts.append(bounded_list(map(code, forms), 6000, shown_by))
    for sign, title in (("~", "renamed"), ("+", "added"), ("-", "removed"), ("?", "unclear")):
        signed = [line.removeprefix(f"{sign} ") for line in lines if line.startswith(sign)]
        if signed:
            parts.append(f"**{len(signed)} {title}**")
            parts.append(bounded_list(map(code, signed), _MOST_LINES, shown_by))
    if unanswered := list(unanswered_lines(difference, second_source.fleet)):
        parts += [
            "**New names that wildcards match, and rights without a counterpart now**",
            bounded_list(map(code, unanswered), _MOST_LINES, shown_by),
        ]
    if difference.governance_differs:
        parts.append("**The governance differs**: see `sros diff_policy --no-new-access`")
    notes = [f"{note.id}: {note.text}" for note in (*first_source.notes, *second_source.notes)]
    if notes:
        parts += ["**Notes**", bounded_list(map(code, notes), 4000, shown_by)]
    count = len(lines) + len(forms)
    differ = counted(count, "difference") if count else "no difference"
    title = f"### Rights: {plain(differ)}"
    if lines and drawn is None:
        parts.append(
            "The picture is too large for a comment: draw it with `sros view BEFORE AFTER -o "
            "change.html`"
        )
    elif lines and drawn:
        parts.append(fenced(drawn, "mermaid"))
    return "\n\n".join((title, *parts)) + "\n"


def enclave_lines(difference: SourcesDifference, fleet: Fleet | None) -> list[str]:
    """Return lines for enclaves that differ in something else than rights.

    Such an enclave is on one side only and has no rights there, has other ROS domains on the other
    side, or has unclear permissions.  Equal lines of robots are merged.
    """
    from sros_tool.fleet.robots import folded_lines

    sides = [
        [(pair.enclave, f"- {pair.enclave} in domain {pair.a}") for pair in difference.domains],
        [(pair.enclave, f"+ {pair.enclave} in domain {pair.b}") for pair in difference.domains],
    ]
    sides += [
        [
            (enclave, f"{sign} {enclave}, an enclave without rights")
            for sign, enclave in difference.enclaves
            if sign == side
        ]
        for side in "-+"
    ]
    unclear = "may have other rights in B than in A, as the notes say"
    sides.append([(name, f"? {name} {unclear}") for name in difference.unclear])
    return [text for lines in sides for text in folded_lines(fleet, lines)]


def unanswered_lines(difference: SourcesDifference, fleet: Fleet | None) -> Iterator[str]:
    """Yield a line for each right that the change leaves without a counterpart.

    A line for each new name that a wildcard of another enclave matches comes first.  Lines that
    differ only in the robot are merged.
    """
    from sros_tool.fleet.robots import folded_lines
    from sros_tool.policy.rights import lost_counterpart_text

    lines = [
        (
            right.enclave,
            f"! {right.enclave} may {right.right} {right.name}, a new name, by a wildcard",
        )
        for right in difference.reached
    ]
    lines += [
        (right.enclave, f"! {lost_counterpart_text(right)}") for right in difference.unanswered
    ]
    yield from folded_lines(fleet, lines)


def changed_form_lines(difference: SourcesDifference, fleet: Fleet | None) -> Iterator[str]:
    """Yield a line for each name that became absolute, or relative to its node's namespace.

    Lines that differ only in the robot are merged.
    """
    from sros_tool.fleet.robots import folded_lines
    from sros_tool.policy.model import ALLOW

    made_absolute = "begins with / now, so that the namespace of its node does not apply"
    made_relative = "no longer begins with /, so that the namespace of its node applies"
    for is_absolute, made in ((True, made_absolute), (False, made_relative)):
        lines = []
        for form in difference.changed_forms:
            if form.is_absolute == is_absolute:
                denied = "" if form.right.qualifier is ALLOW else "DENY "
                name = f"{form.right.enclave} {denied}{form.right.describe()}"
                lines.append((form.right.enclave, f"~ {name} {made}  ({form.place})"))
        yield from folded_lines(fleet, lines)


def protection_lines(protections: Iterable[tuple[str, StatedProtection]]) -> list[str]:
    """Return a line for each protection that only one of two policies demands."""
    return [
        f"{sign} {stated.enclave} protect {stated} with {stated.word}"
        for sign, stated in protections
    ]


def _difference_lines(
    difference: RightsDifference,
    first: Fleet | None,
    second: Fleet | None,
    sides: tuple[str, str] = ("A", "B"),
) -> list[str]:
    """Return the lines for a difference; lines that differ only in the robot are merged.

    ``first`` and ``second`` are the fleets of the two sides, ``sides`` their names.
    """
    from sros_tool.fleet.robots import folded_lines

    lines: list[tuple[str, str, str]] = []
    for sign, right in difference.lines():
        by = ", ".join(cover.describe() for cover in difference.covered.get(right, ()))
        remark = f"  ({sides[sign == '-']} has it as part of {by})" if by else ""
        lines.append((sign, right.enclave, f"{sign} {right}{remark}"))
    if first is None and second is None:
        return [text for _, _, text in lines]
    fleets = (("-", first or second), ("+", second or first))
    return [
        text
        for side, fleet in fleets
        for text in folded_lines(
            fleet, [(name, text) for sign, name, text in lines if sign == side]
        )
    ]


def folded_differences(
    first_source: RightsSource,
    second_source: RightsSource,
    difference: RightsDifference,
    sides: tuple[str, str] = ("A", "B"),
) -> list[str]:
    """Return the lines for a difference, with one line for each enclave that was renamed.

    If a source covers only some enclaves, no enclave counts as renamed.
    """
    from sros_tool.policy.rights import renamed_enclaves

    renamed: dict[str, str] = {}
    if first_source.scope is None and second_source.scope is None:
        renamed = renamed_enclaves(first_source.rights, second_source.rights)
    unrenamed = difference.without({*renamed, *renamed.values()})
    return [
        *_renamed_lines(renamed, second_source.fleet),
        *_difference_lines(unrenamed, first_source.fleet, second_source.fleet, sides),
    ]


# ── minimize_policy ─────────────────────────────────────────────────────────────────────


_MOST_SHOWN = 5


class _MinimizeVerb(SeveralValues):
    several = ("--observed",)


@verb("minimize_policy", cls=_MinimizeVerb)
@click.argument("policy", type=PATH)
@click.option(
    "--observed",
    required=True,
    multiple=True,
    type=PATH,
    metavar="OBSERVED...",
    help="Rights that were observed in use: policies from generate_policy, or permissions.",
)
@fleet_option("The robots that the placeholders of POLICY stand for.")
@output_option("Write the narrowed policy to FILE.")
@click.option(
    "--strict",
    is_flag=True,
    help="Also remove the standard rights of nodes (common/node.xml) that were not seen in use.",
)
@click.option(
    "--fail-on",
    type=click.Choice(["never", "difference"]),
    default="never",
    show_default=True,
    help="`difference`: exit with 1 if POLICY has rights to remove, wildcards to replace, or "
    "rights that were used only in part; if POLICY lacks an observed right; or if an enclave is "
    "only in POLICY or only in OBSERVED, or if nodes that POLICY has in several enclaves were "
    "observed in one process. With --fleet, an enclave also counts if it was "
    "not observed for every robot. Without --fleet, sros also compares each node of an enclave, if "
    "OBSERVED has profiles of the nodes.",
)
@force_option
@dry_run_option
@json_option
def minimize_policy(
    policy: Path,
    observed: tuple[Path, ...],
    fleet_file: Path | None,
    output: Path | None,
    strict: bool,
    fail_on: str,
    force: bool,
    dry_run: bool,
    as_json: bool,
) -> int:
    """Show the rights in POLICY that were never observed in use, and write a policy without them.

    "allowed" and "observed" count pairs of a right and an exact name. A wildcard counts once for
    each known name that it matches: names in the policy, in the observations, and in the rights
    that every node needs. The result is one file: includes are resolved, metadata is kept, and
    comments are lost. A DENY always stays, and an enclave that was never observed does not change.

    With --fleet, a right that any robot used stays for the corresponding enclave of every robot.
    The shown sizes of permissions.p7s are those of the robot with the longest name.

    The exit status is 0, also if rights are removed or missing, unless --fail-on is given.

    Example:
      $ sros minimize_policy robot.xml --observed learned.xml -o narrow.xml
      /talker: allowed 23, observed 4: 5.8x
        never observed, and removed
          publish topic /status
        wider than used
          request service /*  becomes  request service /add_two_ints
        never observed, but kept because every node needs them: 11 rights
        observed, and not allowed
          publish topic /cmd_vel
        permissions.p7s: 4044 bytes, narrowed 4028 (Fast DDS 2.6 ...
      wrote 'narrow.xml'
      $ sros minimize_policy robot.xml --observed learned.xml --fleet fleet.toml
    """
    from sros_tool.fleet.expansion import as_written
    from sros_tool.fleet.fleet_file import read_fleet
    from sros_tool.keystore.issuing.size import PolicyMinimization, minimized_policy

    if output:
        check_output(output, force=force)
    fleet = read_fleet(fleet_file) if fleet_file else None
    minimized = minimized_policy(policy, observed, fleet, strict=strict, output=output)
    enclaves, notes = minimized.enclaves, minimized.notes
    changes = file_change(output, existed=output.exists()) if output else ()
    saved = save(output, minimized.document) if output and not dry_run else ""
    if as_json:
        kept = output if not dry_run else None
        same = minimized.is_as_observed
        plain = as_plain(PolicyMinimization(policy, kept, enclaves, same, dry_run, changes, notes))
        print_json({**plain, "enclaves": _as_written(plain["enclaves"])})
    else:
        for enclave in enclaves:
            for line in _use_lines(enclave):
                echo(as_written(line))
    print_notes(notes)
    if output and dry_run:
        echo(f"would {'replace' if output.exists() else 'write'} {output}", err=as_json)
    if saved:
        echo(saved, err=True)
    if fail_on == "never" or minimized.is_as_observed:
        return 0
    echo(f"different: {as_written('; '.join(minimized.differences))}", err=True)
    return 1


def _ratio_text(ratio: float | None) -> str:
    """Return the over-privilege ratio as text, such as 3.5x."""
    return "none in use" if ratio is None else f"{ratio:.1f}x"


def _use_lines(enclave: MinimizedEnclave) -> Iterator[str]:
    use, sizes = enclave.use, enclave.bytes
    if not use.observed_at_all:
        yield f"{use.enclave}: allowed {use.allowed}, never observed; not changed"
    else:
        counts = f"allowed {use.allowed}, observed {use.observed}"
        yield f"{use.enclave}: {counts}: {_ratio_text(use.ratio)}"
        if use.never_observed:
            yield "  never observed, and removed"
            yield from (f"    {right.describe()}" for right in use.never_observed)
    if use.wildcards:
        yield "  wider than used"
    for wide in use.wildcards:
        used = ", ".join(right.describe() for right in wide.used) or "nothing"
        granted = ", ".join(right.describe() for right in wide.replacement)
        if granted == used:
            yield f"    {wide.rule.describe()}  becomes  {granted}"
        else:
            yield f"    {wide.rule.describe()}  covered {used}"
            yield f"      {f'becomes {granted}' if granted else 'not needed: other rules give it'}"
    if use.kept_for_every_node:
        number = counted(len(use.kept_for_every_node), "right")
        yield f"  never observed, but kept because every node needs them: {number}"
    if use.in_part:
        yield "  used or allowed only in part, and kept"
        yield from (f"    {right.describe()}" for right in use.in_part)
    if use.not_allowed:
        yield "  observed, and not allowed"
        yield from (f"    {right.describe()}" for right in use.not_allowed)
    then = f", narrowed {sizes.after}" if sizes.after != sizes.before else ""
    too_large = "" if sizes.after < sizes.limit else ": TOO LARGE"
    limit = f"Fast DDS 2.6 and 2.9 take {sizes.limit - 1}"
    yield f"  permissions.p7s: {sizes.before} bytes{then} ({limit}){too_large}"
    for proposal in enclave.proposals:
        names = [right.describe() for right in proposal.adds]
        adds = (
            f"also allows {first_few(names, _MOST_SHOWN)}"
            if names
            else "allows no other known name"
        )
        yield f"    {proposal.rule.describe()}  in place of {len(proposal.replaces)} names"
        yield f"      this rule saves {proposal.saves} bytes, and {adds}"


def _as_written(value: Any) -> Any:
    """Return a JSON value with its names written with placeholders, as in a fleet's policy."""
    from sros_tool.fleet.expansion import as_written

    if isinstance(value, dict):
        return {key: _as_written(part) for key, part in value.items()}
    if isinstance(value, list):
        return list(map(_as_written, value))
    return as_written(value) if isinstance(value, str) else value


# ── policies ────────────────────────────────────────────────────────────────────────────


@verb("policies")
@click.option(
    "--copy",
    "target",
    type=PATH,
    metavar="[DIR]",
    is_flag=False,
    flag_value="policies",
    help="Copy the policies to the folder DIR, as a start for your own; if DIR is named "
    "common, only the common parts.",
)
@json_option
@dry_run_option
def policies(target: Path | None, as_json: bool, dry_run: bool) -> None:
    """List the policies that ship with sros, each with its enclaves, or copy these policies.

    --copy adds missing files to an existing folder, and replaces nothing: if a file differs,
    nothing is copied.

    Example:
      $ sros policies
      add_two_ints.xml     /add_two_ints/client, /add_two_ints/server
      ...
      $ sros policies --copy my_policies
      copied the policies to 'my_policies'
      $ sros policies --copy common
      copied the common parts of policies to 'common'
    """
    from sros_tool.files import policies_dir
    from sros_tool.policy.document import PolicyFile, ShippedPolicies, read_policy

    source = policies_dir()
    if target is not None:
        _copy(source, target, as_json=as_json, dry_run=dry_run)
        return
    shipped = {path: read_policy(path) for path in sorted(source.glob("*.xml"))}
    if as_json:
        listed = [
            PolicyFile(path, [enclave.path for enclave in policy.enclaves])
            for path, policy in shipped.items()
        ]
        print_json(ShippedPolicies(listed))
        return
    width = max(len(path.name) for path in shipped)
    for path, policy in shipped.items():
        echo(f"{path.name:{width}}  {', '.join(enclave.path for enclave in policy.enclaves)}")
    echo(f"they are in '{source}'", err=True)


def _copy(source: Path, target: Path, *, as_json: bool, dry_run: bool) -> None:
    """Copy the shipped policies to a folder, or only the common parts to a folder ``common``."""
    from sros_tool.keystore.layout import is_keystore
    from sros_tool.policy.document import COMMON, CopiedPolicies, copy_policies

    if is_keystore(target):
        raise UsageError(f"'{target}' already exists, as a keystore", "", "Name another folder.")
    changes = copy_policies(source, target, dry_run=dry_run)
    kind = "common parts of policies" if target.absolute().name == COMMON else "policies"
    if as_json:
        print_json(CopiedPolicies(target, dry_run, changes, ()))
    elif not changes:
        echo(f"nothing to copy: '{target}' already has the {kind}")
    else:
        echo(f"{'would copy' if dry_run else 'copied'} the {kind} to '{target}'")


# ── diff_policy --no-new-access ───────────────────────────────────────────────────────────────


_MOST_NEW_LINES = 20
_MOST_NEW_RIGHTS = 3
"""Maximum number of reach lines, and of enclaves in a line, in text output; JSON has all."""
_MOST_CHARACTERS = 12_000
"""Maximum length of each list in Markdown, in characters."""


def _show_new_access(
    base: Path, head: Path, fleets: tuple[Fleet | None, Fleet | None], form: str
) -> int:
    """Print the access that HEAD adds to BASE; return 1 if there is any, else 0.

    Raises:
        SrosError: sros cannot decide whether HEAD adds access.
    """
    from sros_tool.fleet.changes import renewal_notes
    from sros_tool.proof.growth import ComparedSide, NewAccess, compare_access
    from sros_tool.proof.sources import load_side

    with progress("reading"):
        before, after = load_side(base, fleets[0]), load_side(head, fleets[-1])
    after = replace(after, notes=(*after.notes, *renewal_notes(before.fleet, after.fleet)))
    with progress("comparing"):
        growth = compare_access(before, after)
    if form == "json":
        print_json(NewAccess(ComparedSide.of(before), ComparedSide.of(after), growth))
    elif form == "markdown":
        echo_document(access_markdown(before, after, growth))
    else:
        for line in (
            *added_lines(before, after, growth),
            *_removed_lines(before, after, growth),
            *dropped_lines(after, growth),
        ):
            echo(line)
        echo(access_summary(growth), err=True)
    if form != "json":
        print_notes((*before.notes, *after.notes))
    return int(bool(growth))


class PlacedChange(NamedTuple):
    """A change that makes a review fail.

    ``subject`` is an enclave or a setting, ``text`` a clause on the change, and ``place`` a line of
    HEAD; None if no line of HEAD shows the change.
    """

    subject: str
    text: str
    place: Source | None
    is_denial: bool = False
    """Whether the change is a dropped DENY, and not added access."""


def placed_changes(
    base: AccessSource, head: AccessSource, growth: Growth
) -> Iterator[PlacedChange]:
    """Yield the added access of a change and its dropped denials, each with its place in HEAD."""
    from sros_tool.proof.growth import renamed_between

    def place_of(enclave: str) -> Source | None:
        stated = head.enclaves.get(enclave)
        return next((profile.source for profile in stated.all_profiles()), None) if stated else None

    renamed = renamed_between(base, head)
    for old, new in sorted(renamed.items()):
        yield PlacedChange(new, _renamed_text(old, new), place_of(new))
    for gain in growth.without_renames(renamed).added:
        enclave, text = gain.enclaves[0], _gain_text("+", gain, growth)
        yield PlacedChange(enclave, text.removeprefix(f"{enclave} "), gain.source)
    for node in growth.new_nodes:
        yield PlacedChange(node.enclave, _new_node_text(node), node.place)
    for change in growth.lost:
        yield PlacedChange(change.key, f"less protection: {change}", None)
    for right, _, place in growth.elsewhere:
        text = f"may {right.describe()} in another namespace"
        yield PlacedChange(right.enclave, text, place)
    for denial in growth.dropped_denials:
        enclave = denial.denial.enclave
        yield PlacedChange(enclave, _dropped_text(denial), place_of(enclave), is_denial=True)


def added_lines(base: AccessSource, head: AccessSource, growth: Growth) -> list[str]:
    """Return the added access as lines that begin with "+", or "~" for a renamed enclave."""
    from sros_tool.proof.growth import renamed_between

    renamed = renamed_between(base, head)
    unrenamed = growth.without_renames(renamed)
    return [
        *(
            f"{line}; rights under a new name count as new, so that a reviewer has to allow them"
            for line in _renamed_lines(renamed, head.fleet)
        ),
        *_folded_gains(head, "+", unrenamed.added, growth),
        *_new_node_lines(head, growth.new_nodes),
        *(f"+ less protection: {change}" for change in growth.lost),
        *_reach_lines(head, unrenamed.reach),
        *(
            f"+ {right.enclave} {right.describe()} in another namespace  ({place})"
            for right, _, place in growth.elsewhere
        ),
    ]


def _new_node_lines(head: AccessSource, nodes: Iterable[NewNode]) -> Iterator[str]:
    """Yield a line for each node that gets more rights in another enclave; robots share lines."""
    from sros_tool.fleet.robots import folded_lines

    return folded_lines(head.fleet, ((node.enclave, f"+ {_new_node_text(node)}") for node in nodes))


def _new_node_text(new: NewNode) -> str:
    node, enclave, moved_from, rights, place = new
    where = f"moves from enclave {moved_from} to" if moved_from else "is new in enclave"
    may = first_few([right.describe() for right in rights], _MOST_NEW_RIGHTS)
    return f"node {node} {where} {enclave}, and may {may} there  ({place})"


def _renamed_lines(renamed: Mapping[str, str], fleet: Fleet | None) -> Iterator[str]:
    """Yield a line for each renamed enclave; equal lines of several robots are merged."""
    from sros_tool.fleet.robots import folded_lines

    lines = ((new, f"~ {_renamed_text(old, new)}") for old, new in sorted(renamed.items()))
    return folded_lines(fleet, lines)


def _renamed_text(old: str, new: str) -> str:
    return f"enclave {old} is now {new}, with the same rights"


def _removed_lines(base: AccessSource, head: AccessSource, growth: Growth) -> list[str]:
    from sros_tool.proof.growth import renamed_between

    removed = growth.without_renames(renamed_between(base, head)).removed
    protections = (
        f"- more protection: {change.key} {change.after} -> {change.before}"
        for change in growth.gained
    )
    return [*_folded_gains(base, "-", removed, growth), *protections]


def _folded_gains(
    side: AccessSource, sign: str, gains: Iterable[Gain], growth: Growth
) -> list[str]:
    from sros_tool.fleet.robots import folded_lines

    lines = [(gain.enclaves[0], f"{sign} {_gain_text(sign, gain, growth)}") for gain in gains]
    return list(folded_lines(side.fleet, lines))


def _gain_text(sign: str, gain: Gain, growth: Growth) -> str:
    from sros_tool.dds.decision.vendors import joined_titles

    who, other = first_few(gain.enclaves, _MOST_NEW_LINES), "BASE" if sign == "+" else "HEAD"
    if gain.action == "join":
        text = f"{who} join the domain"
    elif gain.right is None:
        text = f"{who} {gain.action} DDS topic {gain.topic} without a right to it"
    else:
        text = f"{who} {gain.right.describe()}"
        if gain.source:
            text += f"  ({gain.source})"
        if gain.right.enclave not in gain.enclaves:
            certificates = "certificate" if len(gain.enclaves) == 1 else "certificates"
            text += f" (by the permissions of {gain.right.enclave}, which fit the {certificates} "
            text += f"of {who}, too)"
        if gain.name != gain.right.name:
            text += f": such as {gain.name}"
    if gain.denied:
        at = f" at {gain.denied_at}" if gain.denied_at else ""
        text += f", which {other} denies by {gain.denied.name}{at}"
    if gain.worlds != growth.worlds:
        text += f"; with {', '.join(joined_titles(gain.worlds))}"
    if growth.other_domain in gain.domains:
        if lacked := [str(domain) for domain in growth.domains if domain not in gain.domains]:
            text += f"; in every domain except {', '.join(lacked)}"
    elif gain.domains != (0,) or len(growth.domains) > 1:
        text += f"; in domain {', '.join(map(str, gain.domains))}"
    return text


def _reach_lines(head: AccessSource, reach: Sequence[NewReach]) -> list[str]:
    from sros_tool.fleet.robots import folded_lines
    from sros_tool.reach import path_text

    reached = [
        (
            new_reach.source,
            f"+ {new_reach.source} can influence {new_reach.target}: {path_text(new_reach.path)}",
        )
        for new_reach in reach
    ]
    lines = list(folded_lines(head.fleet, reached))
    more = len(lines) - _MOST_NEW_LINES
    if more > 0:
        lines[_MOST_NEW_LINES:] = [
            f"+ and {counted(more, 'more line')} on influence (--json has all)"
        ]
    return lines


def dropped_lines(head: AccessSource, growth: Growth) -> list[str]:
    """Return a line for each DENY that is dropped or narrowed; lines of robots are merged."""
    from sros_tool.fleet.robots import folded_lines

    lines = (
        (denial.denial.enclave, f"! {denial.denial.enclave} {_dropped_text(denial)}")
        for denial in growth.dropped_denials
    )
    return list(folded_lines(head.fleet, lines))


def _dropped_text(dropped: DroppedDenial) -> str:
    right, name, moved_from = dropped
    if moved_from:
        text = f"has a node of {moved_from}, but not the DENY {right.describe()} of that enclave"
    else:
        text = f"DENY {right.describe()} is gone"
    text += f" for names such as {name}" if name else ""
    return f"{text}: other policies may allow {'them' if name else 'it'} now"


def access_summary(growth: Growth) -> str:
    """Return the added access and reach of a change, and its dropped denials, in one sentence."""
    if growth.elsewhere:
        new = _count(len(growth.elsewhere), "right")
        here = access_summary(replace(growth, elsewhere=()))
        return (
            f"{new} new only for users who put the node into another namespace; otherwise: {here}"
        )
    from sros_tool.dds.decision.vendors import joined_titles

    worlds = ", ".join(joined_titles(growth.worlds))
    basis = "".join(
        f"; {title}: {', '.join(clauses)}"
        for title, clauses in (
            ("not compared", growth.not_compared),
            ("assumed", growth.assumed),
            ("not covered", growth.left_out),
        )
        if clauses
    )
    rights_gone = f"; {_count(len(growth.removed), 'right')} gone" if growth.removed else ""
    dropped = growth.dropped_denials
    denials_gone = f"{counted(len(dropped), 'DENY is', 'DENYs are')} gone"
    if not growth:
        same = f"nobody gets more access, and nothing is protected less ({worlds})"
        if dropped:
            same = (
                f"{denials_gone}, so that other policies may allow the names; if none does, {same}"
            )
        return f"{same}{rights_gone}{basis}"
    parts = []
    if growth.added:
        parts.append(f"{_count(len(growth.added), 'right')} new")
    if growth.new_nodes:
        parts.append(f"{_count(len(growth.new_nodes), 'node')} new in an enclave of BASE")
    if growth.lost:
        parts.append(f"{_count(len(growth.lost), 'protection')} weaker")
    if growth.reach:
        pairs = len(growth.reach)
        text = "1 enclave can influence another one"
        parts.append(
            (text if pairs == 1 else f"in {pairs} pairs of enclaves, one can influence the other")
            + " now"
        )
    if growth.added and growth.reach_unknown:
        parts.append(f"the influence of enclaves on others is unknown now: {growth.reach_unknown}")
    return "; ".join(parts) + rights_gone + (f"; {denials_gone}" if dropped else "") + basis


def _count(number: int, noun: str) -> str:
    return f"1 {noun} is" if number == 1 else f"{number} {noun}s are"


def access_markdown(base: AccessSource, head: AccessSource, growth: Growth) -> str:
    """Return the added and removed access of a change, and its dropped denials, as Markdown."""
    from sros_tool.markdown import bounded_list, code, plain

    shown_by = "which `sros diff_policy --no-new-access` shows"
    summary = access_summary(growth)
    without = "none, but a DENY is gone" if growth.dropped_denials else "none"
    verdict = "yes" if growth else without
    parts = [f"### New access: {plain(verdict)}", plain(summary)]
    added, removed = added_lines(base, head, growth), _removed_lines(base, head, growth)
    renamed = [line for line in added if line.startswith("~")]
    gone = dropped_lines(head, growth)
    for title, lines in (
        ("renamed", renamed),
        ("added", added[len(renamed) :]),
        ("removed", removed),
        ("DENY gone" if len(gone) == 1 else "DENYs gone", gone),
    ):
        if lines:
            parts.append(f"**{len(lines)} {title}**")
            parts.append(
                bounded_list((code(line[2:]) for line in lines), _MOST_CHARACTERS, shown_by)
            )
    return "\n\n".join(parts) + "\n"
