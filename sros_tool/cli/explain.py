"""The verb `explain`: turn the options into a question, and print the answer as text or JSON."""

from __future__ import annotations

import os
import re
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import suppress
from datetime import datetime, timedelta
from pathlib import Path
from shlex import quote
from typing import TYPE_CHECKING

import click

from sros_tool.cli.common import (
    KEYSTORE_VARIABLE,
    PATH,
    all_distros_option,
    check_one_decider,
    complete_keystore_and_enclave,
    completions,
    distro_option,
    domain_of,
    enclave_filter_options,
    fleet_option,
    json_option,
    keystore_from_environment,
    local_zone,
    moment_of,
    named_zone,
    now,
    print_json,
    print_notes,
    progress,
    read_log,
    relative_path,
    ros_domain,
    verb,
)
from sros_tool.dds.decision.vendors import ZENOH, Vendor
from sros_tool.errors import Note, SrosError, UsageError
from sros_tool.names import is_expression
from sros_tool.terminal import Colored, echo
from sros_tool.validity import iso
from sros_tool.wording import counted, first_few

if TYPE_CHECKING:
    from click.shell_completion import CompletionItem

    from sros_tool.dds.domains import DomainSet
    from sros_tool.distributions import Distribution
    from sros_tool.explain.answer import Answer, Question
    from sros_tool.explain.asking import AskedEnclave, AskingContext
    from sros_tool.explain.log_causes import LogFinding
    from sros_tool.explain.vendors import Comparison, DdsExplanation, ZenohNextToDds
    from sros_tool.explain.who import AnswerForAll, Decider, FollowedReach
    from sros_tool.explain.zenoh import CheckedLink, ZenohAnswer, ZenohExplanation
    from sros_tool.fleet.robots import Fleet
    from sros_tool.keystore.reader import OpenedKeystore
    from sros_tool.policy.model import Source
    from sros_tool.proof.requirements import Requirement
    from sros_tool.zenoh.delivery import Check

_OPERATIONS = ("publish", "subscribe", "call", "serve", "execute", "request", "reply", "join")
_KIND_BY_OPERATION = {
    **dict.fromkeys(("publish", "subscribe"), "topics"),
    **dict.fromkeys(("call", "serve", "request", "reply"), "services"),
    "execute": "actions",
}
_ZENOH_TITLE = "Zenoh"
_VENDORS = (*(vendor.value for vendor in Vendor), ZENOH)


# ── options ────────────────────────────────────────────────────────────────────────────────


def _complete_arguments(
    ctx: click.Context, parameter: click.Parameter, incomplete: str
) -> list[CompletionItem | str]:
    """Complete the keystore, its enclaves, the `_OPERATIONS`, and then the ROS names."""
    from sros_tool.keystore.layout import is_keystore

    arguments: tuple[str, ...] = ctx.params.get("arguments") or ()
    named = bool(arguments) and is_keystore(Path(arguments[0]))
    rest = arguments[1:] if named else arguments
    before = 0 if ctx.params.get("who") else 1  # the enclave
    if len(rest) == before:
        return [word for word in _OPERATIONS if word.startswith(incomplete)]
    if len(rest) == before + 1:
        root = Path(arguments[0]) if named else ctx.params.get("keystore")
        names = _names_in_rights(
            ctx.params.get("policy") or root, _KIND_BY_OPERATION.get(rest[-1], "")
        )
        return [*completions(names, incomplete)]
    if rest:
        return []
    if named or ctx.params.get("keystore"):
        return _complete_enclave(ctx, parameter, incomplete)
    return complete_keystore_and_enclave(ctx, parameter, incomplete)


def _names_in_rights(path: Path | None, kind: str) -> list[str]:
    """Return the names of a kind in the rights of a policy or keystore, if they can be read."""
    from sros_tool.keystore.rights import load_rights

    try:
        rights = load_rights(path or keystore_from_environment()).rights
    except (SrosError, OSError):
        return []
    names = {right.name for right in rights if right.kind == kind}
    return sorted(name for name in names if not is_expression(name))


def _complete_enclave(
    ctx: click.Context, _parameter: click.Parameter, incomplete: str
) -> list[CompletionItem | str]:
    """Complete the enclaves of the keystore in the arguments, or else in the environment."""
    from sros_tool.keystore.layout import is_keystore, search_enclaves

    arguments = (
        ctx.params.get("arguments") or ctx.args
    )  # while an option lacks its value, click fills only ctx.args
    named = ctx.params.get("keystore") or (arguments[0] if arguments else "")
    root = Path(named or os.environ.get(KEYSTORE_VARIABLE, ""))
    names = search_enclaves(root)[0] if is_keystore(root) else ()
    return [*completions(names, incomplete)]


_IGNORED_PARAMETERS = {
    "": ("infrastructure", "patterns", "robots"),
    "--who": ("infrastructure", "all_vendors", "all_distros"),
    "--reach": (
        *("patterns", "robots", "kind", "all_vendors", "distro", "all_distros"),
        *("moment", "time_zone"),
    ),
    "--log": (
        *("infrastructure", "patterns", "robots", "kind", "fleet_file"),
        *("vendor", "all_vendors", "distro", "all_distros"),
    ),
}
"""Maps each option that chooses a mode to the parameters that have no effect with it."""
_GOES_WITH = {"infrastructure": "--reach only", "patterns": "--who only", "robots": "--who only"}


def _refuse_ignored(mode: str) -> None:
    """Raise `UsageError` if an option is given that has no effect in ``mode``.

    ``mode`` is --who, --reach or --log; "" is a question about one enclave.
    """
    from sros_tool.runtime.rmw import RMW

    context = click.get_current_context()
    for parameter in context.command.params:
        name = parameter.name or ""
        if name in _IGNORED_PARAMETERS[mode] and context.params[name]:
            option = parameter.opts[0]
            text = f"{mode} takes no {option}" if mode else f"{option} goes with {_GOES_WITH[name]}"
            remedy = "Leave it out."
            if (mode, name) == ("--log", "vendor"):
                remedy += f" {RMW} can say which RMW the node uses."
            if name == "robots":
                remedy = "Name one of the robot's enclaves instead; `sros list_enclaves KEYSTORE "
                remedy += f"--robot {quote(context.params[name][0])}` lists them."
            raise UsageError(text, "", remedy)


@verb("explain")
@click.argument(
    "arguments",
    metavar="[KEYSTORE|POLICY] [ENCLAVE] [publish|subscribe|call|serve|execute|join [NAME]]",
    nargs=-1,
    shell_complete=_complete_arguments,
)
@click.option(
    "--type",
    "kind",
    type=click.Choice(["topic", "service", "action"]),
    help="Whether NAME is a topic, a service or an action.",
)
@click.option(
    "--keystore", type=PATH, metavar="KEYSTORE", help="A keystore, or an enclave's folder."
)
@click.option(
    "--policy",
    type=PATH,
    metavar="FILE",
    help="Policy that the permissions were made from, to show its lines.",
)
@fleet_option("The robots that placeholders of --policy stand for. [default: the keystore's]")
@click.option(
    "--vendor",
    type=click.Choice(_VENDORS),
    metavar="VENDOR",
    help="Decide as this DDS vendor does; zenoh: as Zenoh does with the files of `sros "
    f"zenoh`. One of: {', '.join(_VENDORS)}. [default: the vendor of this machine's RMW]",
)
@click.option("--all-vendors", is_flag=True, help="Compare the decisions of all vendors.")
@distro_option(
    "Decide as a DDS that this ROS 2 distribution ships, such as lyrical: the DDS of --vendor or "
    "$RMW_IMPLEMENTATION, else the default DDS of the distribution. [default: the only one that "
    "the keystore's fleet or settings state for the enclave, else $ROS_DISTRO]"
)
@all_distros_option("Compare the decisions of all supported ROS 2 distributions.")
@click.option(
    "--at",
    "moment",
    metavar="MOMENT",
    help="Decide with the current files as of a date (2027-06-01) or a time from now (90d). "
    "[default: now]",
)
@click.option(
    "--domain",
    metavar="ID",
    help="The ROS domain. [default: $ROS_DOMAIN_ID, or the keystore's; all domains with --who and "
    "--reach]",
)
@click.option(
    "--time-zone",
    metavar="ZONE",
    help="Time zone of the robot, such as Asia/Tokyo; Fast DDS reads dates in this zone. "
    "[default: this machine's]",
)
@click.option("--who", is_flag=True, help="Show which enclaves may do the operation on NAME.")
@enclave_filter_options("With --who: only")
@click.option(
    "--reach",
    metavar="ENCLAVE",
    shell_complete=_complete_enclave,
    help="Show which enclaves ENCLAVE can influence, and which enclaves can influence ENCLAVE, "
    "directly or through others.",
)
@click.option(
    "--infrastructure",
    is_flag=True,
    help="With --reach, also follow /parameter_events, which all nodes share, and requests that "
    "only read, such as get_parameters.",
)
@click.option(
    "--log",
    "logs",
    metavar="FILE",
    multiple=True,
    help="Explain the lines of one log of ROS 2, DDS or Zenoh, with a keystore, an enclave's "
    "folder or a policy; - is standard input.",
)
@json_option
def explain(
    arguments: tuple[str, ...],
    kind: str | None,
    keystore: Path | None,
    policy: Path | None,
    fleet_file: Path | None,
    vendor: str | None,
    all_vendors: bool,
    distro: Distribution | None,
    all_distros: bool,
    moment: str | None,
    domain: str | None,
    time_zone: str | None,
    who: bool,
    patterns: tuple[str, ...],
    robots: tuple[str, ...],
    reach: str | None,
    infrastructure: bool,
    logs: tuple[str, ...],
    as_json: bool,
) -> int:
    r"""Show whether DDS or Zenoh lets an enclave do something, why, and how to change this.

    call and serve are about services, execute is about actions. If the rights name an action NAME
    but no service NAME, call and serve are about the action; use --type to choose. KEYSTORE is a
    keystore, or an export on a robot; ENCLAVE can also be an enclave's folder. With a policy and no
    keystore, sros decides by the permissions that the policy would give; this is for DDS only.

    The exit status is 0 if the operation is allowed (with --who: to at least one enclave), and 1 if
    it is denied. With --log, it is 1 if the log reports a fault. With --log and ENCLAVE, it is also
    1 if the log is empty, or if no line says that a node runs secured in ENCLAVE. Zenoh logs no
    such line, so sros expects none if RMW_IMPLEMENTATION or the log shows that the node uses Zenoh.

    An action is allowed only if all of its services and topics are allowed. With --who, "in part"
    marks an enclave that has only some of these rights, but can command the action's server, for
    example by send_goal.

    Example:
      $ sros explain keystore /talker publish /chatter --policy robot.xml
      yes: /talker may publish topic /chatter, on Fast DDS 2.14 (...)
        why       rule 1 allows publish rt/chatter by rt/chatter
        rule      allow rule 1 of grant /talker: rt/chatter
        from      robot.xml:12: ALLOW publish chatter
        protected payload ENCRYPT, submessages ENCRYPT, RTPS messages SIGN
        until     2036-11-18T09:00:00Z, when cert.pem expires
      $ sros explain keystore /talker call /add_two_ints --all-vendors
      $ sros explain keystore /talker publish /chatter --vendor zenoh
      $ sros explain keystore /talker publish /chatter --all-distros
      $ sros explain keystore --who publish /cmd_vel
      $ sros explain robot.xml --who publish /cmd_vel
      $ sros explain keystore --reach /mobile_robot/teleop
      $ ros2 run demo_nodes_cpp talker 2>&1 | \
            sros explain keystore /talker --log -
    """
    if sum((who, bool(reach), bool(logs))) > 1:
        raise UsageError("--who, --reach and --log exclude each other", "", "Choose one.")
    if len(logs) > 1:
        raise UsageError("--log takes one log", "", "Run the command once for each log.")
    from sros_tool.explain.asking import is_policy
    from sros_tool.keystore.reader import OpenedKeystore
    from sros_tool.runtime.rmw import chosen_vendor

    mode = "--who" if who else "--reach" if reach else "--log" if logs else ""
    _refuse_ignored(mode)
    check_one_decider()
    root, rest = _split_keystore(arguments, keystore, operation_index=0 if who else 1)
    names_policy = root is not None and is_policy(root)
    if logs and names_policy and policy:
        raise UsageError(
            f"two policies are named, '{root}' and '{policy}'", "", "Leave one of them out."
        )
    if names_policy and not (policy or reach):
        policy, root = root, None
    policy = relative_path(policy) if policy else None  # for the names in printed commands
    opened = OpenedKeystore(root) if root else None
    if fleet_file and not (policy or names_policy):
        raise UsageError("--fleet goes with a policy only", "", "Leave it out.")
    if reach:
        if vendor not in (None, ZENOH):
            text = "--reach follows rights, which are the same for all DDS vendors."
            raise UsageError("--reach takes only --vendor zenoh", text, "Leave it out.")
        stated = policy, fleet_file
        zenoh = bool(_reason_for_zenoh(vendor, opened))
        only_in = domain_of(domain)
        return _show_reach(
            reach, opened, rest, stated, infrastructure, only_in, as_json, zenoh=zenoh
        )
    asking = _circumstances(moment, domain, time_zone, fleet_file)
    print_notes([*_notes_on_past(asking.at, opened)])
    if logs:
        return _show_log(logs[0], opened, rest, asking, policy, as_json)
    if vendor == ZENOH and distro:
        text = "On Zenoh, the decision is the same in every distribution."
        raise UsageError("--vendor zenoh takes no --distro", text, "Leave it out.")
    why_zenoh = "" if all_vendors or all_distros else _reason_for_zenoh(vendor, opened)
    by_machine = not (why_zenoh or vendor or distro or all_vendors or all_distros)
    if who and by_machine:
        _note_unknown_distribution()
    if who:
        asking = asking._replace(domain=domain_of(domain))  # without --domain, all domains
        chosen = None if why_zenoh else chosen_vendor(vendor, distro, os.environ)
        question, enclave_filter = _question_to_all(rest, kind), (patterns, robots)
        if policy:
            decider, who_context = _decider_of_policy(
                policy, opened, chosen, asking, enclave_filter
            )
        else:
            by_stated = not (vendor or distro)
            decider, who_context = _decider_of_keystore(
                opened, chosen, why_zenoh, asking, enclave_filter, stated=by_stated
            )
        return _print_answer_for_all(decider, question, kind, who_context, as_json)
    question = _parse_question(opened, rest, kind)
    asked = _open_enclave(opened, rest[0], policy, asking)
    context = asking.context(asked.enclave.joined_domains)
    explanation: DdsExplanation | ZenohExplanation
    if why_zenoh:
        from sros_tool.explain.zenoh import explain_on_zenoh

        with progress("reading"):
            explanation = explain_on_zenoh(asked, question, why_zenoh, context, kind=kind)
        lines = _zenoh_lines(explanation)
    else:
        from sros_tool.explain.vendors import ComparedDecisions, explain_on_dds

        if not (vendor or distro):
            distro = _stated_distribution(asked.enclave.keystore, asked.enclave.name)
        if by_machine and not distro:
            _note_unknown_distribution()
        chosen = chosen_vendor(None if vendor == ZENOH else vendor, distro, os.environ)
        compared = (
            ComparedDecisions.VENDORS
            if all_vendors
            else ComparedDecisions.DISTRIBUTIONS
            if all_distros
            else None
        )
        explanation = explain_on_dds(asked, question, chosen, context, kind=kind, compared=compared)
        lines = _vendor_lines(explanation)
    if as_json:
        print_json(explanation)
    else:
        _echo_answer(lines)
    print_notes([*_notes_on_policy_alone(opened, asked, policy), *explanation.notes])
    return 0 if explanation.allowed else 1


def _split_keystore(
    arguments: tuple[str, ...], keystore: Path | None, *, operation_index: int
) -> tuple[Path | None, tuple[str, ...]]:
    """Return the keystore (the first argument, or the option) and the other arguments.

    ``operation_index`` is the index of the operation (such as publish) in ``arguments`` without a
    keystore.
    """
    from sros_tool.keystore.layout import is_keystore

    if keystore is not None and arguments and is_keystore(Path(arguments[0])):
        raise UsageError(
            f"two keystores are named, '{arguments[0]}' and '{keystore}'",
            "",
            "Leave one of them out.",
        )
    if keystore is not None or not arguments or _is_operation(arguments, operation_index):
        return keystore, arguments
    if _is_operation(arguments, operation_index + 1) or Path(arguments[0]).exists():
        return Path(arguments[0]), arguments[1:]
    return None, arguments


def _is_operation(arguments: tuple[str, ...], index: int) -> bool:
    return arguments[index : index + 1] != () and arguments[index] in _OPERATIONS


def _circumstances(
    moment: str | None, domain: str | None, zone: str | None, fleet_file: Path | None
) -> AskingContext:
    """Return the values of --at, --domain, --time-zone and --fleet, or their defaults."""
    from sros_tool.explain.asking import AskingContext

    return AskingContext(
        at=moment_of(moment),
        zone=local_zone(os.environ) if zone is None else named_zone(zone),
        domain=ros_domain() if domain is None else domain_of(domain),
        fleet_file=fleet_file,
    )


def _notes_on_past(moment: datetime, keystore: OpenedKeystore | None) -> Iterator[Note]:
    """Yield a note if the moment is in the past, where other files may have been in force."""
    if now() - moment < timedelta(minutes=1):
        yield from keystore.ledger_file.clock_notes(moment) if keystore else ()
        return
    changes = 0
    if keystore:
        with suppress(SrosError):
            changes = sum(entry.time > iso(moment) for entry in keystore.ledger.entries)
    text = "the answer uses the current files, not the files of that time"
    if changes:
        text += f"; ledger.jsonl has {counted(changes, 'later entry', 'later entries')}"
    yield Note("explain.past", text)


def _reason_for_zenoh(vendor: str | None, keystore: OpenedKeystore | None) -> str:
    """Return the reason to ask Zenoh and not a DDS vendor, or ""."""
    from sros_tool.keystore.layout import has_zenoh_files, is_keystore
    from sros_tool.runtime.rmw import RMW

    if vendor == ZENOH:
        return "as asked"
    rmw = os.environ.get(RMW, "")
    root = keystore.root if keystore else Path(os.environ.get(KEYSTORE_VARIABLE, ""))
    if vendor or "rmw_zenoh" not in rmw or not is_keystore(root):
        return ""
    return f"{RMW} is {rmw}" if has_zenoh_files(root) else ""


# ── one question ───────────────────────────────────────────────────────────────────────────


def _open_enclave(
    keystore: OpenedKeystore | None, name: str, policy: Path | None, asking: AskingContext
) -> AskedEnclave:
    """Open an enclave of a keystore, in a folder, or of a policy without a keystore."""
    from sros_tool.explain.asking import is_enclave, open_asked_enclave

    if keystore is None and not policy and not is_enclave(Path(name)):
        keystore = _keystore_of_environment()
    return open_asked_enclave(keystore, name, policy, asking)


def _keystore_of_environment() -> OpenedKeystore:
    from sros_tool.keystore.reader import OpenedKeystore

    return OpenedKeystore(keystore_from_environment())


def _note_unknown_distribution() -> None:
    """Print a note if $ROS_DISTRO, which decides by default, names an unknown distribution."""
    from sros_tool.distributions import unknown_distribution_notes

    print_notes(unknown_distribution_notes(os.environ))


def _stated_distribution(keystore: OpenedKeystore | None, enclave: str) -> Distribution | None:
    """Return the only ROS 2 distribution that an enclave's fleet or keystore states, or None."""
    from sros_tool.distributions import find_distribution
    from sros_tool.keystore.fleet import stated_distributions

    if keystore is None:
        return None
    with suppress(SrosError):  # `sros check` reports the error
        stated = stated_distributions(keystore, enclave) if keystore.settings else ()
        return find_distribution(stated[0]) if len(stated) == 1 else None
    return None


def _notes_on_policy_alone(
    keystore: OpenedKeystore | None, asked_enclave: AskedEnclave, policy: Path | None
) -> list[Note]:
    """Return a note if a policy was explained without the keystore of $ROS_SECURITY_KEYSTORE."""
    from sros_tool.runtime.variables import KEYSTORE

    default = os.environ.get(KEYSTORE)
    if not default or keystore is not None or asked_enclave.enclave.signed or policy is None:
        return []
    text = (
        f"the policy '{policy}' decides here. For an answer from the signed permissions, name "
        f"the keystore: `sros explain {quote(default)} {asked_enclave.enclave.name} ...`."
    )
    return [Note("explain.policy-alone", text)]


def _parse_question(
    keystore: OpenedKeystore | None, other_arguments: tuple[str, ...], kind: str | None
) -> Question:
    """Return the question in the arguments after the keystore: enclave, operation and name."""
    from sros_tool.explain.answer import ask
    from sros_tool.keystore.layout import is_keystore

    if (
        keystore is None
        and len(other_arguments) > 1
        and other_arguments[1] in _OPERATIONS
        and is_keystore(Path(other_arguments[0]))
    ):
        asked = " ".join(map(quote, other_arguments[1:]))
        raise UsageError(
            "no enclave is named",
            "",
            f"Write `sros explain {quote(other_arguments[0])} ENCLAVE {asked}`, or ask for all "
            "enclaves: "
            f"`sros explain {quote(other_arguments[0])} --who {asked}`.",
        )
    if not 2 <= len(other_arguments) <= 3:
        remedy = "Write for example `sros explain /talker publish /chatter`."
        if keystore and len(other_arguments) == 1 and other_arguments[0].startswith("/"):
            folder = quote(f"{keystore.root}/enclaves{other_arguments[0]}")
            remedy += f" `sros inspect {folder}` shows everything that this enclave may do."
        raise UsageError("explain takes an enclave, an operation and a name", "", remedy)
    return ask(other_arguments[1], other_arguments[2] if len(other_arguments) > 2 else "", kind)


def _echo_answer(lines: Iterator[str]) -> None:
    """Print lines; a yes or no at the beginning of an answer is colored."""
    for number, line in enumerate(lines):
        word, colon, rest = line.partition(":")
        if not number and word in ("yes", "no"):
            echo(Colored(word), f"{colon}{rest}")
        else:
            echo(line)


# ── the answer as text ─────────────────────────────────────────────────────────────────────

_LABEL_WIDTH = 10
_MOST_SHOWN = 10


def _labeled_row(label: str, text: str) -> str:
    """Return a line of an answer: a label and a text in two columns."""
    return f"  {label:{_LABEL_WIDTH}}{text}"


def _vendor_lines(explanation: DdsExplanation) -> Iterator[str]:
    """Yield the answer for one vendor, or the question with a line for each answer."""
    from sros_tool.explain.vendors import VendorExplanation

    if isinstance(explanation, VendorExplanation):
        yield from _answer_lines(explanation.answer, explanation.vendor_why)
    else:
        yield from _table_lines(explanation)
    yield from _zenoh_decision_lines(explanation.zenoh_next_to_dds)


def _zenoh_decision_lines(on_zenoh: ZenohNextToDds | None) -> Iterator[str]:
    if on_zenoh and on_zenoh.zenoh:
        word = "yes" if on_zenoh.zenoh.allowed else f"no, {on_zenoh.zenoh.outcome}"
        yield _labeled_row("zenoh", f"{word}: {on_zenoh.zenoh.text}")
    elif on_zenoh:
        yield _labeled_row("zenoh", f"not known: {on_zenoh.problem}")


def _answer_lines(answer: Answer, why: str) -> Iterator[str]:
    """Yield the answer for one vendor as lines; ``why`` is the reason to choose this vendor."""
    from sros_tool.explain.answer import template_default
    from sros_tool.keystore.template import DEFAULT_TEMPLATE

    decision, grant = answer.decision, answer.grant
    name = answer.enclave.name
    may = f"yes: {name} may" if answer.allowed else f"no: {name} may not"
    documented = ", as documented" if answer.as_documented else ""
    asked = f"{answer.question}{_domain_clause(answer)}"
    yield f"{may} {asked}, on {answer.vendor.title} ({why}{documented})"
    yield _labeled_row("why", decision.clause)
    if answer.counts_key:
        yield _labeled_row("key", "missing here; the answer assumes that the process has the key")
    yield from (_labeled_row("and", str(problem)) for problem in answer.problems[1:])
    if len(answer.parts) > 1 and not answer.allowed:
        for part in answer.parts:
            sign = "ok" if part.decision.outcome.ok else str(part.decision.outcome)
            yield _labeled_row("part", f"{part.part}: {sign}")
    if decision.rule is not None and grant:
        deciding_rule = (
            f"{'allow' if grant.rules[decision.rule].allow else 'deny'} rule {decision.rule + 1}"
        )
        yield _labeled_row("rule", f"{deciding_rule} of grant {grant.name}: {decision.expression}")
    if answer.wildcard:
        yield _labeled_row("wildcard", f"{answer.wildcard} also matches other names")
    for line in answer.lines:
        stated = line.stated
        if level := line.group.protect:
            stated += f', protect="{level.lower()}"'
        yield _labeled_row("from", f"{_place_text(line.source)}: {stated}")
    if answer.policy_sha256 and not answer.enclave.policy_file and decision.rule is not None:
        digest = answer.policy_sha256
        default = template_default(digest)
        yield _labeled_row(
            "from",
            f"the default of the keystore's template, {default}, not a policy file"
            if default
            else f"a policy file: add --policy FILE to see its line (digest {digest[:12]})",
        )
    if answer.allowed:
        protection = ", ".join(_protection_words(answer))
        if not (answer.enclave.state or answer.enclave.keystore):
            protection += f", in a keystore with the template {DEFAULT_TEMPLATE}"
        yield _labeled_row("protected", protection)
    elif answer.denied_by:
        yield _labeled_row("denied by", answer.denied_by)
    if answer.until and answer.allowed:
        from sros_tool.keystore.layout import CERTIFICATE_FILE

        dropped = answer.vendor.traits.drops_expired and answer.until_file == CERTIFICATE_FILE
        then = "; then running nodes lose their peers" if dropped else ""
        yield _labeled_row("until", f"{iso(answer.until)}, when {answer.until_file} expires{then}")
    yield from _to_do_lines(answer)


def _domain_clause(answer: Answer) -> str:
    """Return in which ROS domain the question was decided, if the governance has several."""
    domains = answer.enclave.state.domains() if answer.enclave.state else None
    has_several = domains is not None and domains.only() is None
    return f" in domain {answer.domain}" if has_several and answer.question.right else ""


def _to_do_lines(answer: Answer) -> Iterator[str]:
    """Yield the change of the policy, or the remedy, and the commands that apply it.

    If requirements of a closed robot forbid the change, yield these requirements instead.
    """
    if forbidding := _requirements_forbidding(answer):
        from sros_tool.proof.requirements import demand

        for requirement in forbidding:
            text = f"{_place_text(requirement.source)} forbids this: {demand(requirement)}"
            yield _labeled_row("required", text)
        permit = "If the enclave is meant to have this right, first change the requirement; this "
        yield _labeled_row("remedy", f"{permit}command then shows what to add to the policy.")
        return
    if answer.change:
        yield from _change_lines(answer)
    if answer.remedy:
        yield _labeled_row("remedy", answer.remedy)
    for number, command in enumerate(answer.commands):
        yield _labeled_row("run" if not number else "", command)


def _requirements_forbidding(answer: Answer) -> Sequence[Requirement]:
    """Return the requirements that forbid the change that ``answer`` proposes.

    The requirements are next to the keystore, or the policy, of a closed robot.
    """
    from sros_tool.keystore.layout import folder_of_closed_robot

    policy, place, change = answer.enclave.policy, answer.enclave.root, answer.change
    if policy and not place:
        place = Path(policy.source.file)
    robot = folder_of_closed_robot(place) if place else None
    if not (robot and change and change.document) or answer.enclave.has_placeholders:
        return ()
    from sros_tool.close.rights import requirements_broken_by

    return requirements_broken_by(robot, change.document, moment_of(None))


def _place_text(source: Source) -> str:
    """Return file:line, with a relative path if the file is below the working directory."""
    cwd = Path.cwd()
    file = Path(source.file)
    return f"{file.relative_to(cwd) if file.is_relative_to(cwd) else file}:{source.line}"


def _protection_words(answer: Answer) -> Iterator[str]:
    topic, domain = answer.topic_rule, answer.domain_rule
    if topic:
        yield f"payload {topic.data_protection_kind}"
        yield f"submessages {topic.metadata_protection_kind}"
    if domain:
        yield f"RTPS messages {domain.rtps_protection_kind}"
    if topic:
        controlled = {
            "reading": topic.enable_read_access_control,
            "writing": topic.enable_write_access_control,
        }
        if off := [word for word, on in controlled.items() if not on]:
            yield f"ACCESS CONTROL OFF for {' and '.join(off)}"


def _change_lines(answer: Answer) -> Iterator[str]:
    from sros_tool.explain.answer import ADDITION

    change, policy = answer.change, answer.enclave.policy
    if change is None:
        return
    yield _labeled_row("change", "in the policy:")
    for edit in change.edits:
        if edit.xml:
            group = edit.xml.partition(" ")[0].removeprefix("<")
            yield f"    at {_place_text(edit.source)}, change the <{group}> group to"
            yield from (f"      {line}" for line in edit.xml.splitlines())
        else:
            yield f"    remove the group at {_place_text(edit.source)}"
    if change.lift and not change.edits:
        yield from (f"    remove: {right.qualifier} {right.describe()}" for right in change.lift)
    for right in change.lift:
        if is_expression(right.name):
            yield f"    this also removes the DENY of all other names that {right.name} matches"
    if change.document:
        if answer.enclave.has_placeholders:
            place = f"at {_place_text(policy.source)}" if policy else "to the fleet's policy"
            yield f"    add {place}, with placeholders for the robot's name and namespace"
        else:
            yield f"    save as {ADDITION}"
        lines = change.document.splitlines()  # the XML declaration is left out: it is the default
        yield from (f"      {line}" for line in lines if not line.startswith("<?xml"))


def _table_lines(compared: Comparison) -> Iterator[str]:
    """Yield the question, one line for each answer, and the vendors that decide differently."""
    rows = [
        (answer.vendor.title, "", answer, " (as documented)" if answer.as_documented else "")
        for answer in compared.vendors or ()
    ]
    for reply in compared.distributions or ():
        remark = "" if reply.measured else f" (assumed to decide as {reply.decided_as.title})"
        rows.append((reply.shipped.distribution.title, f"  {reply.release}", reply.answer, remark))
    where = _domain_clause(rows[0][2])
    yield f"may {compared.asked.enclave} {compared.asked.question}{where}?"
    widths = [max(len(row[column]) for row in rows) for column in (0, 1)]
    for name, release, answer, remark in rows:
        row = f"{name:{widths[0]}}{release:{widths[1]}}"
        yield f"  {row}  {answer.outcome:11}  {answer.decision.clause}{remark}"
    yield compared.sentence


# ── the answer of Zenoh as text ────────────────────────────────────────────────────────────

_RECEIVER_WORDS = {
    "publish": ("heard by", "a message sent to the wildcard itself is heard by"),
    "subscribe": ("hears", ""),
    "call": ("served by", "a request sent to the wildcard itself is executed by"),
    "request": ("served by", "a request sent to the wildcard itself is executed by"),
    "serve": ("serves", ""),
    "reply": ("serves", ""),
    "execute": ("serves", ""),
}


def _zenoh_lines(explanation: ZenohExplanation) -> Iterator[str]:
    """Yield lines with Zenoh's answer, the policy lines behind it, and the remedy."""
    answer, stated, allowed = explanation.answer, explanation.stated, explanation.allowed
    may = f"yes: {answer.enclave} may" if allowed else f"no: {answer.enclave} may not"
    mode = f" in {answer.mode} mode" if answer.mode else ""
    yield f"{may} {answer.question}, on {_ZENOH_TITLE}{mode} ({explanation.vendor_why})"
    yield _labeled_row("why", answer.text)
    yield from _link_lines(answer)
    if dropped := answer.dropping_check:
        dropper = (
            f"{dropped.enforcer}, which drops the message silently: {answer.enclave} gets no error"
        )
        yield _labeled_row("denied by", dropper)
    if allowed and answer.question.word in _RECEIVER_WORDS:
        yield from _reached_lines(answer)
    if allowed and answer.until:
        yield _labeled_row("until", f"{iso(answer.until)}, when cert.pem expires")
    for line in stated.lines:
        yield _labeled_row("from", f"{_place_text(line.source)}: {line.stated}")
    if explanation.wants_rights:
        yield from _to_do_lines(stated)
    if explanation.files_remedy:
        yield _labeled_row("remedy", explanation.files_remedy)


def _link_lines(answer: ZenohAnswer) -> Iterator[str]:
    """Yield the links on which the right is decided; links that drop messages come first."""
    links = sorted(answer.links, key=lambda link: link.passes)
    for number, link in enumerate(links[:_MOST_SHOWN]):
        between = " and ".join(link.enclaves)
        if len(links) == 1 or (number == 0 and not answer.allowed):
            yield _labeled_row("link", f"between {between}:")
            yield from (_labeled_row("", f"  {line}") for line in _message_lines(link.checks))
        else:
            yield _labeled_row("link", f"between {between}: {_link_text(link)}")
    if more := links[_MOST_SHOWN:]:
        passing = sum(link.passes for link in more)
        yield _labeled_row(
            "link",
            f"{counted(len(more), 'more link')}: the message passes through {passing}, and is "
            f"dropped at {len(more) - passing}",
        )


def _reached_lines(answer: ZenohAnswer) -> Iterator[str]:
    does, wide_does = _RECEIVER_WORDS[answer.question.word]
    reachable = [reached.enclave for reached in answer.reached if not reached.problem]
    yield _labeled_row(does, _names_text(reachable))
    for reached in [reached for reached in answer.reached if reached.problem][:_MOST_SHOWN]:
        yield _labeled_row(
            "", f"{reached.enclave} has the right, but does not take part: {reached.problem}"
        )
    for wildcard, enclaves in answer.wildcards:
        yield _labeled_row("wildcard", f"{wildcard} also matches other names")
        if wide_does:
            yield _labeled_row("", f"{wide_does} {_names_text(enclaves)}")


def _names_text(names: Sequence[str]) -> str:
    return first_few(names, _MOST_SHOWN) or "no other enclave"


def _message_lines(checks: Sequence[Check]) -> Iterator[str]:
    """Yield, for every message on a link, the enclaves and rules that pass or drop the message."""
    decided: dict[tuple[str, str], list[str]] = {}
    for check in checks:
        way = "leaving" if check.flow == "egress" else "entering"
        how = "silently dropped"
        if check.allowed:
            how = f"by rule {check.rules[0]}" if check.rules else "without a rule"
        decided.setdefault((check.message, check.key), []).append(f"{way} {check.enforcer} {how}")
    for (message, key), texts in decided.items():
        yield f"{message} {key}: {', '.join(texts)}"


def _link_text(link: CheckedLink) -> str:
    """Return the result for one of several links in words: whether all messages pass."""
    dropped = next((check for check in link.checks if not check.allowed), None)
    if dropped is None:
        return "passes"
    return f"{dropped} is silently dropped by {dropped.enforcer} ({dropped.why})"


# ── --who ──────────────────────────────────────────────────────────────────────────────────


_WhoContext = tuple["Fleet | None", int | None, "DomainSet | None", str]
"""The arguments of `_who_lines` after ``answer``."""
_EnclaveFilter = tuple[tuple[str, ...], tuple[str, ...]]
"""The values of --match and --robot."""


def _decider_of_keystore(
    keystore: OpenedKeystore | None,
    chosen_vendor: tuple[Vendor, str] | None,
    why_zenoh: str,
    asking: AskingContext,
    enclave_filter: _EnclaveFilter,
    *,
    stated: bool,
) -> tuple[Decider, _WhoContext]:
    """Return the decider for the enclaves of a keystore, and the keystore's fleet and domains.

    ``chosen_vendor`` is the DDS vendor that decides, None for Zenoh; ``why_zenoh`` is the reason to
    ask Zenoh. With ``stated``, the deciding
    vendor is the one of the distribution that the keystore or its fleet states.
    """
    from sros_tool.keystore.fleet import load_fleet
    from sros_tool.keystore.layout import is_original_keystore
    from sros_tool.keystore.selection import select_enclaves

    keystore = keystore or _keystore_of_environment()
    keystore.check()
    patterns, robots = enclave_filter
    names = select_enclaves(keystore, (), patterns, robots=robots) if patterns or robots else None
    decider: Decider
    if chosen_vendor:
        from sros_tool.explain.vendors import VendorOfKeystore
        from sros_tool.runtime.rmw import vendor_here

        enclaves = (keystore.names if names is None else names) if stated else ()
        distributions = {name: _stated_distribution(keystore, name) for name in enclaves}
        vendors = {of: vendor_here(os.environ, of) for of in {*distributions.values()} if of}
        if len({*distributions.values()}) == 1 and vendors:
            (chosen_vendor,) = vendors.values()

        def vendor_of(enclave: str) -> Vendor | None:
            distribution = distributions.get(enclave)
            return vendors[distribution][0] if distribution else None

        decider = VendorOfKeystore(keystore, *chosen_vendor, asking, names, vendor_of)
    else:
        from sros_tool.explain.zenoh import ZenohOfKeystore

        decider = ZenohOfKeystore(keystore, why_zenoh, asking, names)
    fleet = load_fleet(keystore) if chosen_vendor else None
    is_export = not is_original_keystore(keystore.root)
    domains = None if is_export else keystore.domains
    asked_in = " in this export" if is_export else ""
    return decider, (fleet, asking.domain, domains, asked_in)


def _decider_of_policy(
    policy: Path,
    keystore: OpenedKeystore | None,
    chosen_vendor: tuple[Vendor, str] | None,
    asking: AskingContext,
    enclave_filter: _EnclaveFilter,
) -> tuple[Decider, _WhoContext]:
    """Return the decider for the enclaves of a policy, and the policy's fleet and domains.

    Raises:
        UsageError: a keystore is named, too, or an option that only a keystore can answer.
    """
    from sros_tool.explain.asking import fleet_of, policy_to_ask
    from sros_tool.explain.vendors import VendorOfPolicy

    patterns, robots = enclave_filter
    if keystore:
        text = "In a keystore, the signed permissions decide, not a policy."
        raise UsageError(
            "--who takes either a keystore or a policy",
            text,
            "Leave out the keystore or the policy.",
        )
    if chosen_vendor is None:
        text = "A policy has no Zenoh files; `sros zenoh KEYSTORE` writes them."
        raise UsageError("--who on Zenoh takes no policy", text, "Name the keystore.")
    if robots:
        raise UsageError("--robot takes a keystore", "", f"Write --match '/{robots[0]}/*' instead.")
    fleet = fleet_of(asking.fleet_file, None)
    _, stated = policy_to_ask(policy, fleet)
    decider = VendorOfPolicy(stated, *chosen_vendor, asking, patterns or ("*",))
    return decider, (fleet, asking.domain, None, "")


def _question_to_all(other_arguments: tuple[str, ...], kind: str | None) -> Question:
    """Return the question in the arguments after the keystore: operation and name."""
    from sros_tool.explain.answer import ask

    if not 1 <= len(other_arguments) <= 2:
        raise UsageError(
            "--who takes an operation and a name", "", "Write for example publish /cmd_vel."
        )
    return ask(other_arguments[0], other_arguments[1] if len(other_arguments) > 1 else "", kind)


def _print_answer_for_all(
    decider: Decider, question: Question, kind: str | None, who_context: _WhoContext, as_json: bool
) -> int:
    """Print the decisions on all enclaves; return 0 if any enclave may do the operation, else 1."""
    from sros_tool.explain.who import answer_for_all, note_on_callable_action, note_on_names_meant

    with progress("asking"):
        answer = answer_for_all(decider, question, kind)
    if as_json:
        print_json(decider.printed(answer.question, answer.outcomes))
    else:
        _echo_answer(_who_lines(answer, *who_context))
        echo(f"decided by {decider.title}", err=True)
        if not (kind or answer.allowed or any(outcome.in_part for outcome in answer.outcomes)):
            enclaves = {outcome.enclave for outcome in answer.outcomes}
            hint = note_on_callable_action(decider, answer.question) or note_on_names_meant(
                decider, answer.question, enclaves
            )
            print_notes([hint] if hint else [])
    print_notes(answer.notes)
    return 0 if answer.allowed else 1


def _who_lines(
    answer: AnswerForAll,
    fleet: Fleet | None,
    domain: int | None,
    domains: DomainSet | None,
    asked_in: str,
) -> Iterator[str]:
    """Yield the allowed enclaves, the enclaves whose participant does not start now, and counts.

    The enclaves of a fleet are grouped by robot.  ``domain`` is the value of --domain.  ``domains``
    are the domains of the keystore (None for an export or a policy): if an enclave may do the
    operation only in some domains, its line names these domains.  ``asked_in`` says where the
    enclaves are: " in this export", or "".
    """
    from sros_tool.fleet.robots import folded_lines

    able = [outcome for outcome in answer.outcomes if outcome.allowed]
    in_part = [outcome for outcome in answer.outcomes if outcome.in_part]
    lines = []
    by_domains = Counter(outcome.domains for outcome in able)
    everywhere = str(domains) if domains else next(iter(by_domains), "")
    if domain is not None or not by_domains.keys() - {everywhere}:
        by_domains.clear()
    for outcome in in_part:
        parts = ", ".join(outcome.in_part)
        lines.append((outcome.enclave, f"{outcome.enclave}  in part: {parts}"))
    holding = [outcome for outcome in answer.outcomes if outcome.by_permissions_of]
    for outcome in holding:
        holders = first_few(outcome.by_permissions_of, 3)
        enclave = outcome.enclave
        text = f"{enclave}  with the permissions of {holders}, which fit the certificate of "
        lines.append((enclave, f"{text}{enclave}, too"))
    for outcome in able:
        wildcard = f"  by the wildcard {outcome.wildcard}" if outcome.wildcard else ""
        where = f"  in domain {outcome.domains}" if by_domains else ""
        lines.append((outcome.enclave, f"{outcome.enclave}{wildcard}{where}"))
    stopped = [outcome for outcome in answer.outcomes if outcome.why_stopped]
    for outcome in stopped[:_MOST_SHOWN]:
        lines.append((outcome.enclave, f"  cannot start: {outcome.enclave}  {outcome.why_stopped}"))
    yield from folded_lines(fleet, lines)
    if more := stopped[_MOST_SHOWN:]:
        yield f"  cannot start: {counted(len(more), 'more enclave')}"
    count = counted(len(answer.outcomes), "enclave")
    where = "" if domain is None else f" in domain {domain}"
    if by_domains:
        where = f": {', '.join(f'{n} in domain {text}' for text, n in by_domains.items())}"
    whole = f"{len(able)} of {count}{asked_in} may {answer.question}"
    if in_part:
        whole = f"{len(in_part)} of {count}{asked_in} may {answer.question} in part, {len(able)} "
        whole += "as a whole"
    further = f"; {len(holding)} more may do so with the permissions of another enclave"
    further *= bool(holding)
    yield f"{whole}{where}{further}"


# ── --reach ────────────────────────────────────────────────────────────────────────────────


def _show_reach(
    enclave: str,
    keystore: OpenedKeystore | None,
    other_arguments: tuple[str, ...],
    stated: tuple[Path | None, Path | None],
    infrastructure: bool,
    domain: int | None,
    as_json: bool,
    *,
    zenoh: bool,
) -> int:
    """Print which enclaves one enclave can influence and learn from; return 0.

    ``stated`` are the files of a policy and of its fleet.
    """
    from sros_tool.explain.asking import fleet_of
    from sros_tool.explain.who import follow_reach
    from sros_tool.keystore.reader import OpenedKeystore
    from sros_tool.keystore.rights import load_rights, load_zenoh_rights

    policy, fleet_file = stated
    if keystore is None and len(other_arguments) == 1:
        keystore, other_arguments = OpenedKeystore(Path(other_arguments[0])), ()
    if other_arguments:
        raise UsageError("--reach takes an enclave, and no operation or name")
    if zenoh and policy:
        raise UsageError(
            "--reach on Zenoh takes no --policy", "On Zenoh, the keystore's Zenoh files decide."
        )
    if zenoh:
        source = load_zenoh_rights(keystore or _keystore_of_environment())
    else:
        fleet = fleet_of(fleet_file, None)
        named = keystore.root if keystore else policy  # this can also be the path of a policy
        source = load_rights(named or keystore_from_environment(), fleet)
    with progress("following the rights"):
        followed = follow_reach(source, enclave, infrastructure=infrastructure, domain=domain)
    if as_json:
        print_json(followed)
    else:
        _echo_answer(_followed_lines(followed))
    print_notes(followed.notes)
    if not infrastructure and not as_json:
        topics = ", ".join(topic for topic in followed.left_out if not topic.startswith("*"))
        text = f"left out: topics that every node may write ({topics}), and requests that "
        text += "only ask nodes about themselves (such as get_parameters and get_state)"
        echo(f"{text}; --infrastructure includes them", err=True)
    return 0


def _followed_lines(followed: FollowedReach) -> Iterator[str]:
    """Yield the enclaves that an enclave influences and learns from, with a shortest path to each.

    The enclaves of a fleet are grouped by robot.
    """
    from sros_tool.fleet.robots import folded_lines
    from sros_tool.reach import path_text

    reach = followed.reach
    where = "" if followed.domain is None else f" in domain {followed.domain}"
    for clause, paths in (
        ("can influence", reach.influences),
        ("can learn from", reach.learns_from),
    ):
        yield f"{reach.enclave} {clause} {counted(len(paths), 'enclave')}{where}"
        in_order = sorted(paths.items(), key=lambda item: (len(item[1]), item[0]))
        lines = ((name, f"  {path_text(path)}") for name, path in in_order)
        yield from folded_lines(followed.fleet, lines)


# ── --log ──────────────────────────────────────────────────────────────────────────────────


def _show_log(
    log: str,
    keystore: OpenedKeystore | None,
    other_arguments: tuple[str, ...],
    asking: AskingContext,
    policy: Path | None,
    as_json: bool,
) -> int:
    """Print explanations of a DDS log, or of standard input for "-"; return 1 if there are any."""
    from sros_tool.explain.log import explain_log_file
    from sros_tool.runtime.rmw import RMW

    if len(other_arguments) > 1:
        named = Path(other_arguments[0])
        if not (keystore or policy or named.exists()):
            raise UsageError(f"'{named}' does not exist", "", "Name a keystore, or a policy.")
        raise UsageError("--log takes at most a keystore and an enclave")
    text = read_log(log)
    explained = explain_log_file(
        log, text, keystore, "".join(other_arguments), asking, policy, os.environ.get(RMW, "")
    )
    status = 1 if explained.findings or explained.secured is False else 0
    if as_json:
        print_json(explained)
        return status
    print_notes([note for note in explained.notes if note.id == "log.other-folder"])
    for finding in explained.findings:
        _echo_answer(_finding_lines(finding))
    if explained.secured is False and not explained.findings:
        if_on_zenoh = "" if os.environ.get(RMW) else _IF_ON_ZENOH
        echo(f"{_NOT_SHOWN_SECURED}{if_on_zenoh}" if text.strip() else _EMPTY_LOG)
    elif not explained.findings:
        lines = text.count("\n") + (not text.endswith("\n")) if text else 0
        for line in _lines_without_findings(text, lines):
            echo(line, err=True)
        if _ZENOH_TESTS in text:
            echo(_ONLY_TESTS, err=True)
    print_notes([note for note in explained.notes if note.id != "log.other-folder"])
    return status


_NOT_SHOWN_SECURED = (
    "no line of the log says that a node runs secured in this enclave ('Found security directory', "
    "at level info): perhaps the node runs open. Start it with `sros run KEYSTORE ENCLAVE -- "
    "COMMAND`, and log all its output from the start"
)
_IF_ON_ZENOH = (
    ". If the node uses rmw_zenoh, which logs no such line, set RMW_IMPLEMENTATION=rmw_zenoh_cpp "
    "for this command"
)
_EMPTY_LOG = (
    "the log is empty: it shows nothing about its node. `sros check runtime` on the node's machine "
    "shows how processes run"
)
_PERHAPS_OPEN = "whether a node runs open (`sros check runtime` on its machine)"
_SILENT_ON_ZENOH = "denials on Zenoh, because a log has them only with RUST_LOG=zenoh=trace"


def _lines_without_findings(log: str, count: int) -> Iterator[str]:
    """Yield what was not found in a log of ``count`` lines, and what such a log does not show."""
    from sros_tool.checks.environment import is_zenoh
    from sros_tool.runtime.vendor_log import log_lines, plain_text, security_directory

    if not count:
        yield _EMPTY_LOG
        return
    not_found = f"no message of DDS Security, and no denial by Zenoh, in {counted(count, 'line')}"
    if is_zenoh(os.environ):
        yield not_found
        yield f"not shown: {_PERHAPS_OPEN}; {_SILENT_ON_ZENOH}"
    elif match := next(filter(None, map(security_directory, log_lines(plain_text(log)))), None):
        yield f"{not_found}; the log says that a node found its enclave '{match['folder']}'"
        yield (
            "not shown: whether peers drop the node's messages (explain the peers' logs, or "
            f"compare keystores: `sros check FOLDER OTHER`); {_SILENT_ON_ZENOH}"
        )
    else:
        yield f"{not_found}, and no line 'Found security directory'"
        yield f"not shown: {_PERHAPS_OPEN}; {_SILENT_ON_ZENOH}"


_ZENOH_TESTS = "caching permissions for `"
_ONLY_TESTS = (
    "the log only says how Zenoh tested declared names; this does not show which message was "
    "dropped. `sros explain KEYSTORE ENCLAVE publish|subscribe|call|serve NAME --vendor zenoh` "
    "shows whether a message is denied."
)


_ALTERNATIVE = re.compile(r"(?<=[.)]) (?=(?:If|Or, if|Otherwise,) )")
"""The space between two sentences of a remedy of which a reader follows one."""


def _finding_lines(finding: LogFinding) -> Iterator[str]:
    from sros_tool.runtime.log_texts import UNKNOWN
    from sros_tool.runtime.vendor_log import plain_refusal

    times = f"  ({finding.count} times)" if finding.count > 1 else ""
    by = f" of {finding.process}" if finding.process else ""
    text = finding.text if finding.id == UNKNOWN.id else plain_refusal(finding.text)
    yield f"line {finding.line}{by}: {text[:160]}{times}"
    of = f" [{finding.enclave}]" if finding.enclave else ""
    source = finding.dds.title.split()[0] + " DDS" if finding.dds else "ROS 2"
    source = _ZENOH_TITLE if finding.zenoh else source
    yield f"  means     {source}{of}: {finding.cause}"
    yield from (f"  found     {cause}" for cause in finding.found)
    first, *others = _ALTERNATIVE.split(finding.remedy)
    yield f"  remedy    {first}"
    yield from (f"            {other}" for other in others)
