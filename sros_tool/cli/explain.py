"""The verb `explain`: turn the options into a question, and print the answer as text or JSON."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress
from datetime import tzinfo
from functools import cache, partial
from pathlib import Path
from shlex import quote
from typing import TYPE_CHECKING, Any

import click

from sros_tool.cli.common import (
    KEYSTORE_VARIABLE,
    PATH,
    complete_keystore_and_enclave,
    domain_of,
    fleet_option,
    json_option,
    keystore_from_environment,
    moment_of,
    only_enclaves,
    print_json,
    print_notes,
    read_log,
    ros_domain,
)
from sros_tool.cli.explain_zenoh import (
    ZENOH,
    ZENOH_TITLE,
    brief_zenoh_json,
    row,
    zenoh_json,
    zenoh_lines,
    zenoh_who_json,
    zenoh_who_lines,
)
from sros_tool.cli.progress import progress
from sros_tool.dds.decision.vendors import NEWEST, Vendor
from sros_tool.errors import KeystoreError, Note, SrosError, UsageError
from sros_tool.names import check_enclave_name, is_expression
from sros_tool.terminal import Coloured, echo
from sros_tool.validity import iso
from sros_tool.values import as_plain
from sros_tool.wording import counted

if TYPE_CHECKING:
    from click.shell_completion import CompletionItem

    from sros_tool.dds.decision.answers import Decision
    from sros_tool.dds.domains import DomainSet
    from sros_tool.explain.answer import Answer
    from sros_tool.explain.change import PolicyChange
    from sros_tool.explain.evaluator import Evaluator
    from sros_tool.explain.log import LogFinding
    from sros_tool.explain.question import Part, Question
    from sros_tool.explain.who import EnclaveOutcome
    from sros_tool.explain.zenoh import ZenohAnswer
    from sros_tool.fleet.robots import Fleet
    from sros_tool.keystore.participant import JoinContext, LoadedEnclave
    from sros_tool.keystore.rights import RightsSource
    from sros_tool.policy.model import Enclave, Source
    from sros_tool.policy.rights import Right
    from sros_tool.reach import HopPath, Reach

_WORDS = ("publish", "subscribe", "call", "serve", "execute", "request", "reply", "join")
_KINDS = {
    **dict.fromkeys(("publish", "subscribe"), "topics"),
    **dict.fromkeys(("call", "serve", "request", "reply"), "services"),
    "execute": "actions",
}


# ── options ────────────────────────────────────────────────────────────────────────────────


def _complete_words(
    ctx: click.Context, parameter: click.Parameter, incomplete: str
) -> list[CompletionItem | str]:
    """Complete the keystore, its enclaves, the operations of `_WORDS`, and then the ROS names."""
    from sros_tool.keystore.layout import is_keystore

    given: tuple[str, ...] = ctx.params.get("words") or ()
    named = bool(given) and is_keystore(Path(given[0]))
    rest = given[1:] if named else given
    before = 0 if ctx.params.get("who") else 1  # the enclave
    if len(rest) == before:
        return [word for word in _WORDS if word.startswith(incomplete)]
    if len(rest) == before + 1:
        root = Path(given[0]) if named else ctx.params.get("keystore")
        names = _names_in_rights(ctx.params.get("policy") or root, _KINDS.get(rest[-1], ""))
        return [name for name in names if name.startswith(incomplete)]
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
    names = {each.name for each in rights if each.kind == kind}
    return sorted(name for name in names if not is_expression(name))


def _complete_enclave(
    ctx: click.Context, _parameter: click.Parameter, incomplete: str
) -> list[CompletionItem | str]:
    """Complete the enclaves of the keystore in the arguments, or else in the environment."""
    from sros_tool.keystore.layout import is_keystore, search_enclaves

    given = (
        ctx.params.get("words") or ctx.args
    )  # click fills only args if an option lacks its value
    named = ctx.params.get("keystore") or (given[0] if given else "")
    root = Path(named or os.environ.get(KEYSTORE_VARIABLE, ""))
    names = search_enclaves(root)[0] if is_keystore(root) else ()
    return [name for name in names if name.startswith(incomplete)]


_IGNORED = {
    "": ("infrastructure", "patterns", "robots"),
    "--who": ("infrastructure", "policy", "fleet_file", "all_vendors"),
    "--reach": ("patterns", "robots", "kind", "all_vendors", "moment", "domain", "time_zone"),
    "--log": (
        *("infrastructure", "patterns", "robots", "kind", "policy", "fleet_file"),
        *("vendor", "all_vendors"),
    ),
}
"""The parameters that have no effect, for each of the options that choose a mode."""
_GOES_WITH = {"infrastructure": "--reach only", "patterns": "--who only", "robots": "--who only"}


def _refuse_ignored(mode: str) -> None:
    """Raise `UsageError` if an option is given that has no effect in this mode."""
    context = click.get_current_context()
    for parameter in context.command.params:
        name = parameter.name or ""
        if name in _IGNORED[mode] and context.params[name]:
            option = parameter.opts[0]
            text = f"{mode} takes no {option}" if mode else f"{option} goes with {_GOES_WITH[name]}"
            raise UsageError(text, "", "Leave it out.")


@click.command(
    "explain",
    epilog="""\b
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
  $ sros explain keystore --who publish /cmd_vel
  $ sros explain keystore --reach /mobile_robot/teleop
  $ ros2 run demo_nodes_cpp talker 2>&1 | \\
        sros explain keystore /talker --log -""",
)
@click.argument(
    "words",
    metavar="[ROOT] [ENCLAVE] [publish|subscribe|call|serve|execute|join [NAME]]",
    nargs=-1,
    shell_complete=_complete_words,
)
@click.option(
    "--type", "kind", type=click.Choice(["topic", "service", "action"]), help="Type of NAME."
)
@click.option("--keystore", type=PATH, metavar="ROOT", help="A keystore, or an enclave's folder.")
@click.option(
    "--policy",
    type=PATH,
    metavar="FILE",
    help="Policy that the permissions were made from; without a keystore, explain this policy.",
)
@fleet_option("The robots that placeholders of --policy stand for. [default: the keystore's]")
@click.option(
    "--vendor",
    type=click.Choice([*(each.value for each in Vendor), ZENOH]),
    help="The vendor whose decision counts; zenoh: what Zenoh does with the files of `sros zenoh`."
    " [default: the vendor of this machine's RMW]",
)
@click.option("--all-vendors", is_flag=True, help="Compare the decisions of all vendors.")
@click.option(
    "--at",
    "moment",
    metavar="MOMENT",
    help="Decide as of a date (2027-06-01) or a time from now (90d). [default: now]",
)
@click.option(
    "--domain", metavar="ID", help="The ROS domain. [default: $ROS_DOMAIN_ID, or the keystore's]"
)
@click.option(
    "--time-zone",
    metavar="ZONE",
    help="Time zone of the robot, in which Fast DDS reads dates: Asia/Tokyo. "
    "[default: this machine's]",
)
@click.option("--who", is_flag=True, help="Show which enclaves of the keystore may do it.")
@only_enclaves("With --who: only")
@click.option(
    "--reach",
    metavar="ENCLAVE",
    shell_complete=_complete_enclave,
    help="Show which enclaves this one can influence and learn from, over any number of hops.",
)
@click.option(
    "--infrastructure",
    is_flag=True,
    help="With --reach, count /parameter_events too, which all nodes share, and requests that only"
    " ask, such as get_parameters.",
)
@click.option(
    "--log",
    "logs",
    metavar="FILE",
    multiple=True,
    help="Explain the lines of one DDS log; - is standard input.",
)
@json_option
def explain(
    words: tuple[str, ...],
    kind: str | None,
    keystore: Path | None,
    policy: Path | None,
    fleet_file: Path | None,
    vendor: str | None,
    all_vendors: bool,
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
    """Show whether DDS or Zenoh lets an enclave do something, by which rule, and how to change it.

    call and serve apply to services, execute to actions; call and serve apply to an action if the
    rights have an action NAME and no service NAME; --type decides it. ROOT is a keystore, here or
    on a robot; ENCLAVE can also be an enclave's folder. With --policy and no keystore, the policy
    itself is explained, before anything is signed.

    The exit status is 0 if it is allowed (with --who: to any enclave), and 1 if it is denied; with
    --log, 1 if the log reports a fault.
    """
    if sum((who, bool(reach), bool(logs))) > 1:
        raise UsageError("--who, --reach and --log exclude each other")
    if len(logs) > 1:
        raise UsageError("--log takes one log", "", "Ask once for each log.")
    mode = "--who" if who else "--reach" if reach else "--log" if logs else ""
    _refuse_ignored(mode)
    if fleet_file and not policy:
        raise UsageError("--fleet goes with --policy only", "", "Leave it out.")
    root, rest = _split(words, keystore, verb=0 if who else 1)
    if reach:
        if vendor not in (None, ZENOH):
            text = "It follows the rights, which are the same for all vendors of DDS."
            raise UsageError("--reach takes no --vendor but zenoh", text, "Leave it out.")
        of_zenoh = bool(_why_zenoh(vendor, root))
        stated = policy, fleet_file
        return _show_reach(reach, root, rest, stated, infrastructure, as_json, zenoh=of_zenoh)
    context = _ContextOptions(moment, domain, time_zone, fleet_file)
    if logs:
        return _show_log(logs[0], root, rest, context, as_json)
    zenoh = "" if all_vendors else _why_zenoh(vendor, root)
    if who and zenoh:
        return _show_zenoh_who(root, rest, kind, zenoh, context, (patterns, robots), as_json)
    if who:
        return _show_who(root, rest, kind, vendor, context, (patterns, robots), as_json)
    if zenoh:
        return _show_zenoh_answer(root, rest, kind, policy, zenoh, context, as_json)
    vendor = None if vendor == ZENOH else vendor
    return _show_answer(root, rest, kind, policy, vendor, all_vendors, context, as_json)


def _split(
    words: tuple[str, ...], keystore: Path | None, *, verb: int
) -> tuple[Path | None, tuple[str, ...]]:
    """Return the keystore, if it is the first word or named by the option, and the other words.

    ``verb`` is the index of the operation (such as publish) in ``words`` without a keystore.
    """
    from sros_tool.keystore.layout import is_keystore

    if keystore is not None and words and is_keystore(Path(words[0])):
        raise UsageError(
            f"two keystores are named, '{words[0]}' and '{keystore}'", "", "Leave one of them out."
        )
    if keystore is not None or not words or _is_word(words, verb):
        return keystore, words
    if _is_word(words, verb + 1) or Path(words[0]).is_dir():
        return Path(words[0]), words[1:]
    return None, words


def _is_word(words: tuple[str, ...], place: int) -> bool:
    return words[place : place + 1] != () and words[place] in _WORDS


class _ContextOptions:
    """The options --at, --domain, --time-zone and --fleet, with their defaults."""

    def __init__(
        self, moment: str | None, domain: str | None, zone: str | None, fleet_file: Path | None
    ) -> None:
        from sros_tool.cli.common import local_zone, named_zone

        self._fleet_file = fleet_file

        self.at = moment_of(moment)
        self._domain = ros_domain() if domain is None else domain_of(domain)
        self._zone: tzinfo = local_zone(os.environ) if zone is None else named_zone(zone)

    def context(self, domains: DomainSet | None) -> JoinContext:
        """Return the domain, time and zone to decide for, if an enclave may join ``domains``."""
        from sros_tool.keystore.participant import JoinContext
        from sros_tool.runtime.environment import choose_domain

        chosen = self._domain
        if chosen is None:
            chosen = choose_domain(domains, None, Path()) if domains else 0
        return JoinContext(chosen, self.at, self._zone)

    def fleet(self, root: Path | None) -> Fleet | None:
        """Return the fleet for the placeholders of a policy, if there is one."""
        return _fleet_of(self._fleet_file, root)


def _fleet_of(file: Path | None, root: Path | None) -> Fleet | None:
    """Return the fleet in a file, or else that of the keystore ``root``."""
    from sros_tool.fleet.fleet_file import read_fleet
    from sros_tool.keystore.fleet import load_fleet

    if file:
        return read_fleet(file)
    return load_fleet(root) if root else None


def _vendor_of(name: str | None) -> tuple[Vendor, str]:
    """Return the vendor given by --vendor, or this machine's, and the reason for the choice."""
    from sros_tool.runtime.rmw import vendor_here

    return (Vendor(name), "as asked") if name else vendor_here(os.environ)


def _why_zenoh(vendor: str | None, root: Path | None) -> str:
    """Return the reason to ask Zenoh and not a vendor of DDS, or ""."""
    from sros_tool.keystore.layout import has_zenoh_files, is_keystore
    from sros_tool.runtime.rmw import RMW

    if vendor == ZENOH:
        return "as asked"
    rmw = os.environ.get(RMW, "")
    keystore = root or Path(os.environ.get(KEYSTORE_VARIABLE, ""))
    if vendor or "rmw_zenoh" not in rmw or not is_keystore(keystore):
        return ""
    return f"{RMW} is {rmw}" if has_zenoh_files(keystore) else ""


# ── one question ───────────────────────────────────────────────────────────────────────────


def _show_answer(
    root: Path | None,
    rest: tuple[str, ...],
    kind: str | None,
    policy: Path | None,
    vendor: str | None,
    all_vendors: bool,
    options: _ContextOptions,
    as_json: bool,
) -> int:
    """Print whether an enclave may do something; return 0 if the vendor allows it, else 1."""
    from sros_tool.explain.evaluator import Evaluator

    question = _question(rest, kind)
    enclave = _enclave(root, rest[0], policy, options)
    context = options.context(enclave.joined_domains)
    chosen, why = _vendor_of(vendor)
    evaluator = Evaluator(chosen, enclave, context)
    taken: list[Note] = []
    if not kind and (action := _action_meant(evaluator, question, policy, options)):
        taken = _taken_for_action(question, action)
        question = action
    answer = evaluator.explain(question)
    zenoh = _beside(enclave, question, context)
    if all_vendors:
        others = {v: Evaluator(v, enclave, context) for v in Vendor if v is not chosen}
        answers = [answer if v is chosen else others[v].explain(question) for v in Vendor]
        if as_json:
            shown = [_answer_json(enclave, each, policy) for each in answers]
            differ = len({each["outcome"] for each in shown}) > 1
            asked = _question_json(enclave, context, question)
            print_json({**asked, "vendors": shown, "differ": differ, **_beside_json(zenoh)})
        else:
            _echo(_table_lines(enclave, answers))
            _echo(_beside_lines(zenoh))
    elif as_json:
        asked = _question_json(enclave, context, question)
        answered = _answer_json(enclave, answer, policy)
        print_json({**asked, **answered, "vendor_why": why, **_beside_json(zenoh)})
    else:
        lines = _answer_lines(enclave, answer, why, policy)
        word, _, head = next(lines).partition(":")
        echo(Coloured(word), f":{head}")
        _echo(lines)
        _echo(_beside_lines(zenoh))
    notes = [
        *_policy_alone(root, enclave, policy),
        *taken,
        *_provenance_notes(answer, policy),
        *_other_type(evaluator, answer, kind),
        *_no_topic(answer, _other_rights(enclave, policy, options)),
        *_other_name(answer, enclave),
    ]
    if not all_vendors:
        measured = [
            answer if v is chosen else Evaluator(v, enclave, context).answer(question)
            for v in NEWEST
        ]
        if len({each.outcome for each in measured}) > 1:
            notes.append(Note("explain.vendors-differ", f"{_differences(measured)}."))
    print_notes(notes)
    return 0 if answer.allowed else 1


def _policy_alone(root: Path | None, enclave: LoadedEnclave, policy: Path | None) -> list[Note]:
    """Return a note if a policy was asked although a keystore is set in the environment."""
    from sros_tool.runtime.variables import KEYSTORE

    default = os.environ.get(KEYSTORE)
    if not default or root is not None or enclave.signed or policy is None:
        return []
    text = (
        f"this is what the policy '{policy}' says. To ask what is signed, name the keystore: "
        f"`sros explain {quote(default)} {enclave.name} ...`."
    )
    return [Note("explain.policy-alone", text)]


def _question(rest: tuple[str, ...], kind: str | None) -> Question:
    """Return the question in the words after the keystore: enclave, operation and name."""
    from sros_tool.explain.question import ask

    if not 2 <= len(rest) <= 3:
        raise UsageError(
            "explain takes an enclave, an operation and a name",
            "",
            "Write for example `sros explain /talker publish /chatter`.",
        )
    return ask(rest[1], rest[2] if len(rest) > 2 else "", kind)


def _echo(lines: Iterator[str]) -> None:
    for line in lines:
        echo(line)


def _enclave(
    root: Path | None, name: str, policy: Path | None, options: _ContextOptions
) -> LoadedEnclave:
    """Load an enclave from a keystore, from its folder, or from a policy alone."""
    from dataclasses import replace

    own = _policy_of(policy, name, root, options)
    if root is None and not policy and not _is_enclave(Path(name)):
        root = keystore_from_environment()
    enclave = _signed_enclave(root, name, options, planned=own is not None)
    if enclave is None:
        assert own is not None
        enclave = _planned_enclave(own, root, options)
    elif own is None and policy:
        own = _policy_of(policy, enclave.name, root, options)
    return replace(enclave, root=root, policy=own)


def _policy_of(
    policy: Path | None, enclave: str, root: Path | None, options: _ContextOptions
) -> Enclave | None:
    """Return the enclave in the policy file, for the fleet if there is one; None without a file.

    Raises `PolicyError` if the file does not have an enclave of this name.
    """
    if policy is None:
        return None
    from sros_tool.errors import PolicyError
    from sros_tool.fleet.expansion import read_policy_for

    read = read_policy_for(policy, options.fleet(root))
    found = read.enclave(enclave)
    if found is None and not _is_enclave(Path(enclave)):
        from sros_tool.keystore.missing import likely_names

        there = [each.path for each in read.enclaves]
        meant = likely_names(enclave, there)
        raise PolicyError(
            f"unable to find enclave {enclave} in the policy '{policy}'",
            f"It has {', '.join(there)}.",
            f"Perhaps you mean {' or '.join(meant)}." if meant else "",
        )
    return found


def _signed_enclave(
    root: Path | None, name: str, options: _ContextOptions, *, planned: bool = False
) -> LoadedEnclave | None:
    """Load an enclave from the keystore ``root``, or from the folder ``name``.

    Returns None if there is neither keystore nor folder, or, with ``planned``, if the keystore does
    not have the enclave yet.
    """
    from sros_tool.keystore.layout import check_keystore, enclave_path, has_enclave, list_enclaves
    from sros_tool.keystore.participant import load_enclave

    if root is None:
        folder = Path(name)
        if not _is_enclave(folder):
            return None
        return load_enclave(_name_of(folder, options), folder, at=options.at)
    if _is_enclave(root) and not (root / "enclaves").is_dir():
        own = _name_of(root, options)
        if own != name:
            raise KeystoreError(f"'{root}' is the folder of {own or 'no enclave'}, not of {name}")
        return load_enclave(own, root, at=options.at)
    check_keystore(root)
    if has_enclave(root, name):
        return load_enclave(name, enclave_path(root, name), at=options.at)
    if planned:
        return None
    from sros_tool.keystore.missing import no_such_enclave

    raise no_such_enclave(root, name, list_enclaves(root))


def _is_enclave(folder: Path) -> bool:
    return any((folder / name).exists() for name in ("cert.pem", "permissions.p7s"))


def _name_of(folder: Path, options: _ContextOptions) -> str:
    """Return the name of the enclave in a folder: the common name of its certificate, or ""."""
    from sros_tool.keystore.reader import open_enclave
    from sros_tool.pki.certificates import common_name_of

    certificate = open_enclave(folder, now=options.at).certificate
    return common_name_of(certificate.subject) if certificate else ""


def _planned_enclave(policy: Enclave, root: Path | None, options: _ContextOptions) -> LoadedEnclave:
    """Return the enclave as the policy would create it, with the keystore's governance.

    Without a keystore, the governance is that of the default template, raised as the enclave says.
    """
    from sros_tool.dds.domains import DomainSet
    from sros_tool.keystore.participant import plan_enclave
    from sros_tool.keystore.protection import with_stated
    from sros_tool.keystore.reader import governance_of
    from sros_tool.keystore.template import DEFAULT_TEMPLATE, load_template
    from sros_tool.policy.model import stated_protections
    from sros_tool.translate import governance_for

    if root is not None:
        return plan_enclave(policy, governance_of(root), at=options.at)
    domain = options.context(None).domain
    stated = stated_protections([policy])
    protection = with_stated(load_template(DEFAULT_TEMPLATE).protection, stated)
    governance = governance_for(protection, DomainSet.of((domain, domain)))
    return plan_enclave(policy, governance, at=options.at)


def _provenance_notes(answer: Answer, policy: Path | None) -> list[Note]:
    from sros_tool.explain.answer import Provenance

    match answer.provenance:
        case Provenance.CHANGED:
            text = (
                f"the permissions were not made from '{policy}' in its current form: it states "
                "other rights than they have. The lines are from the current file."
            )
        case Provenance.UNKNOWN:
            text = f"whether the permissions were made from '{policy}' is not recorded."
        case _:
            return []
    return [Note(f"explain.policy-{answer.provenance}", text)]


def _action_meant(
    evaluator: Evaluator, question: Question, policy: Path | None, options: _ContextOptions
) -> Question | None:
    """Return the question about an action, if that is what the rights show the name to be."""
    from sros_tool.explain.evaluator import action_meant

    return action_meant(evaluator, question, _other_rights(evaluator.enclave, policy, options))


def _other_rights(
    enclave: LoadedEnclave, policy: Path | None, options: _ContextOptions
) -> list[Callable[[], frozenset[Right]]]:
    """Return functions that read the rights of the policy and of the keystore."""
    from sros_tool.keystore.layout import is_keystore

    root = enclave.root
    paths = [each for each in (policy, root if root and is_keystore(root) else None) if each]

    def read(path: Path) -> frozenset[Right]:
        from sros_tool.keystore.rights import load_rights

        return load_rights(path, options.fleet(root) if policy else None).rights

    return [partial(read, each) for each in paths]


def _taken_for_action(question: Question, action: Question) -> list[Note]:
    text = (
        f"{action.name} is an action in the rights here, and no service: {question.word} is taken "
        f"for '{action}'; --type service asks about a service."
    )
    return [Note("explain.an-action", text)]


def _other_name(answer: Answer, enclave: LoadedEnclave) -> list[Note]:
    """Return a note with the names that may be meant, if the enclave has rights to such names."""
    if answer.allowed or answer.problems or not answer.question.right:
        return []
    from sros_tool.explain.change import likely_names

    names = likely_names(answer, enclave)
    if not names:
        return []
    text = f"the enclave may {answer.question.word} {' and '.join(names)}: perhaps that is meant."
    return [Note("explain.likely-name", text)]


def _other_type(evaluator: Evaluator, answer: Answer, kind: str | None) -> list[Note]:
    """Return a note if the enclave may not call a service, but may call an action of this name."""
    from sros_tool.explain.question import ask

    question = answer.question
    if question.word != "call" or question.type != "service" or kind or answer.allowed:
        return []
    action = ask("call", question.name, "action")
    if not evaluator.answer(action).allowed:
        return []
    text = f"it may {action}: add --type action if {question.name} is an action."
    return [Note("explain.an-action", text)]


def _no_topic(answer: Answer, others: Iterable[Callable[[], frozenset[Right]]]) -> list[Note]:
    """Return a note if a denied topic has the name of a service or an action."""
    question = answer.question
    if question.type != "topic" or answer.allowed or answer.problems:
        return []
    rights: set[Right] = set()
    for read in others:
        with suppress(SrosError, OSError):
            rights |= read()
    kinds = {each.kind for each in rights if each.name == question.name}
    if "topics" in kinds or not kinds & {"services", "actions"}:
        return []
    what, word = ("an action", "execute") if "actions" in kinds else ("a service", "serve")
    text = f"{question.name} is {what} in the rights here, and no topic: ask about call or {word}."
    return [Note("explain.no-topic", text)]


# ── Zenoh ──────────────────────────────────────────────────────────────────────────────────


def _show_zenoh_answer(
    root: Path | None,
    rest: tuple[str, ...],
    kind: str | None,
    policy: Path | None,
    why: str,
    options: _ContextOptions,
    as_json: bool,
) -> int:
    """Print whether Zenoh lets an enclave do something; return 0 if it does, else 1."""
    from sros_tool.explain.evaluator import Evaluator
    from sros_tool.explain.zenoh import ZenohEvaluator
    from sros_tool.keystore.layout import is_keystore

    question = _question(rest, kind)
    enclave = _enclave(root, rest[0], policy, options)
    if enclave.root is None or enclave.state is None or not is_keystore(enclave.root):
        raise UsageError(
            "Zenoh needs a keystore with the enclave",
            "It decides by the files of the router and of other enclaves.",
            "Name the keystore before the enclave.",
        )
    context = options.context(enclave.joined_domains)
    # The permissions are the source of the files, so what they decide says what has to be changed.
    stated = Evaluator(Vendor.STANDARD, enclave, context)
    taken: list[Note] = []
    if not kind and (action := _action_meant(stated, question, policy, options)):
        taken = _taken_for_action(question, action)
        question = action
    with progress("reading"):
        evaluator = ZenohEvaluator(enclave.root, at=context.at, domain=context.domain)
        answer = evaluator.answer(enclave.name, question)
        outdated = evaluator.out_of_date(answer)
    by_permissions = stated.explain(question)
    written = _zenoh_remedy(enclave.root, by_permissions.allowed, answer, outdated)
    if as_json:
        print_json(
            {
                **_question_json(enclave, context, question),
                "vendor": ZENOH,
                "vendor_title": ZENOH_TITLE,
                "vendor_why": why,
                **zenoh_json(answer),
                "out_of_date": None if outdated is None else list(outdated),
                "policy": _policy_json(by_permissions, policy),
                **_zenoh_change_json(enclave, answer, by_permissions, policy, written),
            }
        )
    else:
        lines = zenoh_lines(answer, why)
        word, _, head = next(lines).partition(":")
        echo(Coloured(word), f":{head}")
        _echo(lines)
        _echo(_zenoh_change_lines(enclave, answer, by_permissions, policy, written))
    print_notes([*taken, *_zenoh_notes(answer, by_permissions, outdated)])
    return 0 if answer.outcome.ok else 1


def _zenoh_remedy(
    root: Path, permitted: bool, answer: ZenohAnswer, outdated: Sequence[str] | None
) -> str:
    """Return what to do if the files of Zenoh do not say what the permissions say, or ""."""
    from shlex import quote

    if answer.of_router:
        return "Give the node an enclave of its own."
    if answer.outcome.ok is permitted and not outdated:
        return ""
    text = "Write the files of Zenoh as the permissions are" if outdated else "Look at the files"
    return f"{text}: `sros zenoh {quote(str(root))}`; then restart the processes that it names."


def _zenoh_change_lines(
    enclave: LoadedEnclave, answer: ZenohAnswer, stated: Answer, policy: Path | None, written: str
) -> Iterator[str]:
    """Yield the lines of the policy, and what to change or to do."""
    for line in stated.lines:
        said = f"{line.qualifier.value} {line.right} {line.name}"
        yield row("from", f"{_shown(line.source)}: {said}")
    if _wants_rights(answer, stated):
        if stated.change:
            yield from _change_lines(stated.change)
        if stated.remedy:
            yield row("remedy", stated.remedy)
        for number, command in enumerate(_commands(enclave, stated, policy)):
            yield row("run" if not number else "", command)
    if written:
        yield row("remedy", written)


def _wants_rights(answer: ZenohAnswer, stated: Answer) -> bool:
    """Return whether more rights would help: the router's enclave shall have none."""
    return not answer.outcome.ok and not stated.allowed and not answer.of_router


def _zenoh_change_json(
    enclave: LoadedEnclave, answer: ZenohAnswer, stated: Answer, policy: Path | None, written: str
) -> dict[str, Any]:
    denied = _wants_rights(answer, stated)
    return {
        "permitted": stated.allowed,
        "remedy": written or (stated.remedy if denied else "") or None,
        "change": _change_json(stated.change) if denied and stated.change else None,
        "commands": _commands(enclave, stated, policy) if denied else [],
    }


def _zenoh_notes(answer: ZenohAnswer, stated: Answer, outdated: Sequence[str] | None) -> list[Note]:
    notes = []
    if answer.outcome.ok is not stated.allowed and not stated.problems:
        does, other = ("allow", "Zenoh drops") if stated.allowed else ("deny", "Zenoh lets through")
        text = f"the signed permissions {does} it and {other} it: the two are not in step."
        notes.append(Note("explain.zenoh-differs", text))
    if outdated:
        text = f"out of date: {', '.join(outdated)}. The answer is by these files as they are."
        notes.append(Note("explain.zenoh-out-of-date", text))
    if outdated is None:
        text = "it was not compared with what the permissions ask for, which takes the keystore's "
        text += "settings and all its enclaves: the answer is by the files as they are."
        notes.append(Note("explain.zenoh-not-compared", text))
    if answer.unsigned:
        text = f"the permissions CA has not signed {', '.join(answer.unsigned)}: whoever can write "
        text += "it gives rights, since Zenoh verifies no signature."
        notes.append(Note("explain.zenoh-unsigned", text))
    return notes


def _beside(
    enclave: LoadedEnclave, question: Question, context: JoinContext
) -> ZenohAnswer | SrosError | None:
    """Return what Zenoh decides next to DDS, or why that is not known; None without its files."""
    from sros_tool.keystore.layout import is_keystore

    root = enclave.root
    if root is None or enclave.state is None or not is_keystore(root):
        return None
    if not _runs_on_zenoh(root, enclave.name):
        return None
    from sros_tool.explain.zenoh import ZenohEvaluator

    try:
        evaluator = ZenohEvaluator(root, at=context.at, domain=context.domain)
        return evaluator.answer(enclave.name, question, reach=False, brief=True)
    except SrosError as error:
        return error


def _runs_on_zenoh(root: Path, name: str) -> bool:
    """Return whether an enclave has a configuration of Zenoh, or others where settings name Zenoh.

    Without such settings the other enclaves are not looked at: there may be very many.
    """
    from sros_tool.keystore.layout import SETTINGS, ZENOH_SIGNED, enclave_path, has_zenoh_files
    from sros_tool.xml import read_bytes

    if any((enclave_path(root, name) / file).is_file() for file in ZENOH_SIGNED):
        return True
    try:
        named = b"zenoh" in read_bytes(root / SETTINGS, "settings file")
    except SrosError:
        named = (root / SETTINGS).exists()
    return named and has_zenoh_files(root)


def _beside_lines(zenoh: ZenohAnswer | SrosError | None) -> Iterator[str]:
    if isinstance(zenoh, SrosError):
        yield row("zenoh", f"not known: {zenoh.what}")
    elif zenoh:
        yield row("zenoh", f"{'yes' if zenoh.outcome.ok else f'no, {zenoh.outcome}'}: {zenoh.text}")


def _beside_json(zenoh: ZenohAnswer | SrosError | None) -> dict[str, Any]:
    if zenoh is None:
        return {}
    return {"zenoh": None if isinstance(zenoh, SrosError) else brief_zenoh_json(zenoh)}


def _show_zenoh_who(
    root: Path | None,
    rest: tuple[str, ...],
    kind: str | None,
    why: str,
    options: _ContextOptions,
    only: tuple[tuple[str, ...], tuple[str, ...]],
    as_json: bool,
) -> int:
    """Print which enclaves Zenoh lets do something; return 0 if any, else 1."""
    from sros_tool.explain.question import about_action
    from sros_tool.explain.zenoh import ZenohEvaluator
    from sros_tool.keystore.layout import check_keystore
    from sros_tool.keystore.reader import governance_of
    from sros_tool.keystore.rights import load_rights

    question = _question_of_who(rest, kind)
    keystore = root or keystore_from_environment()
    check_keystore(keystore)
    context = options.context(governance_of(keystore).domains().closed())
    evaluator = ZenohEvaluator(keystore, at=context.at, domain=context.domain)
    names = _only_enclaves(keystore, *only) or evaluator.names
    taken: list[Note] = []
    with progress("asking"):
        found = evaluator.who(question, names)
        if not kind and all(each.wildcards for each in found if each.outcome.ok):
            rights = load_rights(keystore).rights if question.type == "service" else ()
            if action := about_action(question, rights):
                taken, question = _taken_for_action(question, action), action
                found = evaluator.who(action, names)
    if as_json:
        print_json(
            {
                "question": str(question),
                "vendor": ZENOH,
                "vendor_why": why,
                "domain": context.domain,
                "enclaves": [zenoh_who_json(each) for each in found],
            }
        )
    else:
        _echo(zenoh_who_lines(question, found))
        echo(f"decided by {ZENOH_TITLE} ({why})", err=True)
    if any(each.mode == "peer" for each in found):
        text = "peers decide by their own files, and this is by that of the router, which has the "
        text += (
            "same rights if `sros zenoh --check` says so; a question about one enclave reads all."
        )
        taken.append(Note("explain.zenoh-by-router", text))
    print_notes(taken)
    return 0 if any(each.outcome.ok for each in found) else 1


# ── the answer as text ─────────────────────────────────────────────────────────────────────

_ADDITION = "allow.xml"
"""Name of the file with the rights to add, in the commands that are proposed."""


def _answer_lines(
    enclave: LoadedEnclave, answer: Answer, why: str, policy: Path | None
) -> Iterator[str]:
    """Yield the answer for one vendor as lines; ``why`` is the reason to choose this vendor."""
    from sros_tool.explain.answer import template_default

    decision, grant = answer.decision, answer.grant
    may = f"yes: {enclave.name} may" if answer.allowed else f"no: {enclave.name} may not"
    documented = ", as documented" if answer.as_documented else ""
    yield f"{may} {answer.question}, on {answer.vendor.title} ({why}{documented})"
    yield row("why", decision.clause)
    yield from (row("and", str(each)) for each in answer.problems[1:])
    if len(answer.parts) > 1 and not answer.allowed:
        for part, decided in answer.parts:
            sign = "ok" if decided.outcome.ok else str(decided.outcome)
            yield row("part", f"{part}: {sign}")
    if decision.rule is not None and grant:
        what = f"{'allow' if grant.rules[decision.rule].allow else 'deny'} rule {decision.rule + 1}"
        yield row("rule", f"{what} of grant {grant.name}: {decision.expression}")
    if answer.wildcard:
        yield row("wildcard", f"{answer.wildcard} also matches other names")
    for line in answer.lines:
        stated = f"{line.qualifier.value} {line.right} {line.name}"
        if level := line.group.protect:
            stated += f", protected at least with {level.lower()}"
        yield row("from", f"{_shown(line.source)}: {stated}")
    if answer.policy_sha256 and policy is None and decision.rule is not None:
        digest = answer.policy_sha256
        default = template_default(digest)
        yield row(
            "from",
            f"the default of the keystore's template, {default}: no policy file has been signed"
            if default
            else f"a policy file: add --policy FILE to see its line (digest {digest[:12]})",
        )
    if answer.allowed:
        yield row("protected", ", ".join(_protection_words(answer)))
    elif answer.denied_by:
        yield row("denied by", answer.denied_by)
    if answer.until and answer.allowed:
        yield row("until", f"{iso(answer.until)}, when {answer.until_file} expires")
    if answer.change:
        yield from _change_lines(answer.change)
    if answer.remedy:
        yield row("remedy", answer.remedy)
    for number, command in enumerate(_commands(enclave, answer, policy)):
        yield row("run" if not number else "", command)


def _shown(source: Source) -> str:
    """Return file:line, with a relative path if the file is below the working directory."""
    here = Path.cwd()
    file = Path(source.file)
    return f"{file.relative_to(here) if file.is_relative_to(here) else file}:{source.line}"


def _protection_words(answer: Answer) -> Iterator[str]:
    topic, domain = _topic_rule(answer), answer.domain_rule
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


def _topic_rule(answer: Answer) -> Any:
    decisions = (answer.decision, *(decision for _, decision in answer.parts))
    return next((each.topic_rule for each in decisions if each.topic_rule), None)


def _change_lines(change: PolicyChange) -> Iterator[str]:
    yield row("change", "the smallest change of the policy that would allow it:")
    for edit in change.edits:
        if edit.xml:
            group = edit.xml.partition(" ")[0].removeprefix("<")
            yield f"    at {_shown(edit.source)}, change the <{group}> group to"
            yield from (f"      {line}" for line in edit.xml.splitlines())
        else:
            yield f"    remove the group at {_shown(edit.source)}"
    if change.lift and not change.edits:
        yield from (f"    remove: {right.qualifier} {right.describe()}" for right in change.lift)
    for right in change.lift:
        if is_expression(right.name):
            yield f"    this also removes the denial of all other names in {right.name}"
    if change.document:
        yield f"    save as {_ADDITION}"
        yield from (f"      {line}" for line in change.document.splitlines())


def _commands(enclave: LoadedEnclave, answer: Answer, policy: Path | None) -> list[str]:
    """Return the shell commands that apply a change, in order."""
    if not answer.change and not answer.sign:
        return []
    file = str(policy) if policy else "POLICY"
    commands = []
    if answer.change and answer.change.document:
        commands.append(f"sros merge_policy {file} {_ADDITION} --in-place")
    root = str(enclave.root) if enclave.root else "KEYSTORE"
    commands.append(f"sros create_permission {root} {enclave.name} {file}")
    return commands


def _table_lines(enclave: LoadedEnclave, answers: Sequence[Answer]) -> Iterator[str]:
    """Yield the question, one line for each vendor, and the vendors that differ."""
    yield f"may {enclave.name} {answers[0].question}?"
    width = max(len(each.vendor.title) for each in answers)
    for answer in answers:
        remark = " (as documented)" if answer.as_documented else ""
        reason = answer.decision.clause
        yield f"  {answer.vendor.title:{width}}  {answer.outcome:11}  {reason}{remark}"
    yield _differences(answers)


def _differences(answers: Sequence[Answer]) -> str:
    """Return a sentence that names the vendors whose outcome differs from the first one's."""
    first = answers[0]
    others = [each for each in answers if each.outcome is not first.outcome]
    if not others:
        return "all vendors decide alike"
    listed = ", ".join(f"{each.vendor.title} ({each.outcome})" for each in others)
    return f"VENDORS DIFFER: {first.vendor.title} ({first.outcome}), but {listed}"


# ── the answer as JSON ─────────────────────────────────────────────────────────────────────


def _question_json(
    enclave: LoadedEnclave, context: JoinContext, question: Question
) -> dict[str, Any]:
    """Return the enclave, the question, the domain and the time as JSON values."""
    return {
        "enclave": enclave.name,
        "question": {
            "word": question.word,
            "type": question.type or None,
            "right": question.right or None,
            "name": question.name or None,
        },
        "domain": context.domain,
        "at": iso(context.at),
        "time_zone": str(context.zone),
    }


def _answer_json(enclave: LoadedEnclave, answer: Answer, policy: Path | None) -> dict[str, Any]:
    """Return the answer for one vendor as JSON values."""
    decision = answer.decision
    return {
        "vendor": answer.vendor.value,
        "vendor_title": answer.vendor.title,
        "documented_only": answer.vendor.documented_only,
        "allowed": answer.allowed,
        "outcome": answer.outcome.value,
        "reason": decision.reason,
        "text": decision.text,
        "denied_by": answer.denied_by or None,
        "rule": _rule_json(answer),
        "wildcard": answer.wildcard or None,
        "policy": _policy_json(answer, policy),
        "policy_sha256": answer.policy_sha256 or None,
        "protection": _protection_json(answer),
        "until": iso(answer.until) if answer.until else None,
        "until_file": answer.until_file or None,
        "problems": as_plain(answer.problems),
        "parts": [_part_json(part, decided) for part, decided in answer.parts],
        "remedy": answer.remedy or None,
        "change": _change_json(answer.change) if answer.change else None,
        "commands": _commands(enclave, answer, policy),
    }


def _rule_json(answer: Answer) -> dict[str, Any] | None:
    decision = answer.decision
    if decision.rule is None or answer.grant is None:
        return None
    return {
        "grant": decision.grant,
        "grant_name": answer.grant.name,
        "rule": decision.rule,
        "allow": answer.grant.rules[decision.rule].allow,
        "expression": decision.expression,
    }


def _policy_json(answer: Answer, policy: Path | None) -> dict[str, Any] | None:
    if answer.provenance is None:
        return None
    return {
        "file": str(policy),
        "provenance": answer.provenance.value,
        "lines": [
            {
                "file": each.source.file,
                "line": each.source.line,
                "qualifier": each.qualifier.value,
                "right": each.right,
                "name": each.name,
                "protection": each.group.protect.lower() if each.group.protect else None,
            }
            for each in answer.lines
        ],
        "would_allow": answer.sign,
    }


def _protection_json(answer: Answer) -> dict[str, Any] | None:
    topic, domain = _topic_rule(answer), answer.domain_rule
    if domain is None:
        return None
    return {
        "rtps": domain.rtps_protection_kind.value,
        "discovery": domain.discovery_protection_kind.value,
        "liveliness": domain.liveliness_protection_kind.value,
        "topic_expression": topic.topic_expression if topic else None,
        "data": topic.data_protection_kind.value if topic else None,
        "metadata": topic.metadata_protection_kind.value if topic else None,
        "read_access_control": topic.enable_read_access_control if topic else None,
        "write_access_control": topic.enable_write_access_control if topic else None,
    }


def _part_json(part: Part, decision: Decision) -> dict[str, Any]:
    return {
        "verb": part.verb.value,
        "topic": part.topic,
        "role": part.role or None,
        "outcome": decision.outcome.value,
        "reason": decision.reason,
        "expression": decision.expression,
    }


def _change_json(change: PolicyChange) -> dict[str, Any]:
    return {
        "add": as_plain(change.add),
        "lift": as_plain(change.lift),
        "document": change.document or None,
        "edits": [
            {"file": each.source.file, "line": each.source.line, "xml": each.xml}
            for each in change.edits
        ],
    }


# ── --who ──────────────────────────────────────────────────────────────────────────────────


def _show_who(
    root: Path | None,
    rest: tuple[str, ...],
    kind: str | None,
    vendor: str | None,
    options: _ContextOptions,
    only: tuple[tuple[str, ...], tuple[str, ...]],
    as_json: bool,
) -> int:
    """Print which enclaves of the keystore may do something; return 0 if any may, else 1."""
    from sros_tool.explain.question import about_action, ask
    from sros_tool.explain.who import who
    from sros_tool.keystore.fleet import load_fleet
    from sros_tool.keystore.layout import check_keystore
    from sros_tool.keystore.rights import load_rights

    question = _question_of_who(rest, kind)
    chosen, why = _vendor_of(vendor)
    keystore = root or keystore_from_environment()
    check_keystore(keystore)
    names = _only_enclaves(keystore, *only)
    taken: list[Note] = []
    with progress("asking"):
        found = who(keystore, question, chosen, options.context, at=options.at, names=names)
        # A name that an enclave has as a service is one; a wildcard shows nothing about it.
        if not kind and all(each.wildcard for each in found if each.outcome.ok):
            rights = load_rights(keystore).rights if question.type == "service" else ()
            if action := about_action(question, rights):
                taken, question = _taken_for_action(question, action), action
                found = who(keystore, action, chosen, options.context, at=options.at, names=names)
    allowed = any(each.outcome.ok for each in found)
    if as_json:
        print_json(
            {
                "question": str(question),
                "vendor": chosen.value,
                "vendor_why": why,
                "documented_only": chosen.documented_only,
                "enclaves": [_outcome_json(each) for each in found],
            }
        )
    else:
        for line in _who_lines(question, found, load_fleet(keystore)):
            echo(line)
        documented = ", as documented" if chosen.documented_only else ""
        echo(f"decided by {chosen.title} ({why}{documented})", err=True)
        if question.type == "service" and question.word == "call" and not kind and not allowed:
            action = ask("call", question.name, "action")
            as_action = who(keystore, action, chosen, options.context, at=options.at, names=names)
            if any(each.outcome.ok for each in as_action):
                text = f"enclaves may {action}: add --type action if it is an action."
                print_notes([Note("explain.an-action", text)])
    print_notes(taken)
    return 0 if allowed else 1


def _only_enclaves(
    keystore: Path, patterns: tuple[str, ...], robots: tuple[str, ...]
) -> tuple[str, ...] | None:
    """Return the enclaves that --match and --robot name, or None: neither is given."""
    from sros_tool.keystore.selection import select_enclaves

    if not patterns and not robots:
        return None
    return select_enclaves(keystore, (), patterns, robots=robots)


def _question_of_who(rest: tuple[str, ...], kind: str | None) -> Question:
    """Return the question in the words after the keystore: operation and name."""
    from sros_tool.explain.question import ask

    if not 1 <= len(rest) <= 2:
        raise UsageError(
            "--who takes an operation and a name", "", "Write for example publish /cmd_vel."
        )
    return ask(rest[0], rest[1] if len(rest) > 1 else "", kind)


def _who_lines(
    question: Question, found: Sequence[EnclaveOutcome], fleet: Fleet | None
) -> Iterator[str]:
    """Yield the allowed enclaves, those whose participant does not start now, and the counts.

    The enclaves of a fleet are folded by robot.
    """
    from sros_tool.fleet.enclaves import folded

    able = [each for each in found if each.outcome.ok]
    wild = "  by the wildcard {}"
    lines = [
        (each.enclave, each.enclave + (wild.format(each.wildcard) if each.wildcard else ""))
        for each in able
    ]
    for each in found:
        if each.outcome in ("refused", "crashes"):
            text = f"  not now: {each.enclave}  {each.text.partition(': ')[2]}"
            lines.append((each.enclave, text))
    yield from folded(fleet, lines)
    yield f"{len(able)} of {counted(len(found), 'enclave')} may {question}"


def _outcome_json(each: EnclaveOutcome) -> dict[str, Any]:
    return {
        "enclave": each.enclave,
        "allowed": each.outcome.ok,
        "outcome": each.outcome.value,
        "reason": each.reason,
        "expression": each.expression or None,
        "wildcard": each.wildcard or None,
    }


# ── --reach ────────────────────────────────────────────────────────────────────────────────


def _show_reach(
    enclave: str,
    root: Path | None,
    rest: tuple[str, ...],
    stated: tuple[Path | None, Path | None],
    infrastructure: bool,
    as_json: bool,
    *,
    zenoh: bool,
) -> int:
    """Print which enclaves one enclave can influence and learn from; return 0.

    ``stated`` are the files of a policy and of its fleet.
    """
    from sros_tool.keystore.missing import likely_names
    from sros_tool.keystore.rights import load_rights, load_zenoh_rights
    from sros_tool.reach import OF_EVERY_NODE, QUESTIONS, Network

    policy, fleet_file = stated
    if root is None and len(rest) == 1:
        root, rest = Path(rest[0]), ()
    if rest:
        raise UsageError("--reach takes one enclave, and no question")
    if zenoh:
        if policy:
            raise UsageError("--reach on Zenoh takes no --policy", "It reads the files of Zenoh.")
        source = load_zenoh_rights(root or keystore_from_environment())
    else:
        fleet = _fleet_of(fleet_file, None)
        source = load_rights(root or policy or keystore_from_environment(), fleet)
    without, questions = ((), ()) if infrastructure else (OF_EVERY_NODE, QUESTIONS)
    network = Network(source.rights, without=without, questions=questions, **_uncontrolled(source))
    if source.kind == "keystore" or zenoh:
        _check_there(source.path, enclave)
    if enclave not in network.enclaves:
        meant = likely_names(enclave, network.enclaves)
        raise KeystoreError(
            f"enclave {enclave} has no rights in '{source.path}'",
            f"Enclaves with rights: {', '.join(network.enclaves[:5]) or 'none'}.",
            f"Perhaps you mean {' or '.join(meant)}." if meant else "",
        )
    with progress("following the rights"):
        reach = network.reach(enclave)
    if as_json:
        print_json(
            {"path": str(source.path), "left_out": [*without, *questions], **_reach_json(reach)}
        )
    else:
        for line in _reach_lines(reach, source.fleet):
            echo(line)
    print_notes(source.notes)
    if without and not as_json:
        text = f"left out: {', '.join(without)}, which every node writes and reads, and requests "
        text += "that only ask nodes about themselves, such as get_parameters and get_state"
        echo(f"{text} (include them with --infrastructure)", err=True)
    return 0


def _check_there(root: Path, enclave: str) -> None:
    from sros_tool.keystore.layout import enclave_names
    from sros_tool.keystore.missing import no_such_enclave

    there = enclave_names(root)
    if enclave not in there:
        raise no_such_enclave(root, enclave, there)


def _uncontrolled(source: RightsSource) -> dict[str, Any]:
    """Return arguments for `Network`: the topics that a governance leaves open to all enclaves."""
    if source.kind != "keystore":
        return {}
    from sros_tool.keystore.layout import enclave_names
    from sros_tool.keystore.reader import governance_of
    from sros_tool.reach import unguarded

    return {
        "unguarded": unguarded(governance_of(source.path)),
        "everybody": enclave_names(source.path),
    }


def _reach_lines(reach: Reach, fleet: Fleet | None) -> Iterator[str]:
    """Yield the enclaves that one influences and learns from, each with a shortest path.

    The enclaves of a fleet are folded by robot.
    """
    from sros_tool.fleet.enclaves import folded
    from sros_tool.reach import path_text

    for what, paths in (
        ("can influence", reach.influences),
        ("can learn from", reach.learns_from),
    ):
        count = f"{len(paths)} enclave{'' if len(paths) == 1 else 's'}"
        yield f"{reach.enclave} {what} {count}"
        in_order = sorted(paths.items(), key=lambda item: (len(item[1]), item[0]))
        yield from folded(fleet, ((name, f"  {path_text(path)}") for name, path in in_order))


def _reach_json(reach: Reach) -> dict[str, Any]:
    """Return the enclaves that one influences and learns from, with the hops of shortest paths."""
    return {
        "enclave": reach.enclave,
        "influences": _paths_json(reach.influences),
        "learns_from": _paths_json(reach.learns_from),
    }


def _paths_json(paths: dict[str, HopPath]) -> list[dict[str, Any]]:
    return [
        {
            "enclave": enclave,
            "path": [
                {
                    "from": hop.source,
                    "to": hop.target,
                    "kind": hop.kind,
                    "right": hop.right,
                    "name": hop.name,
                    "said": hop.said,
                    "heard": hop.heard,
                }
                for hop in path
            ],
        }
        for enclave, path in sorted(paths.items())
    ]


# ── --log ──────────────────────────────────────────────────────────────────────────────────


def _show_log(
    log: str, root: Path | None, rest: tuple[str, ...], options: _ContextOptions, as_json: bool
) -> int:
    """Print explanations of a DDS log, or of standard input for "-"; return 1 for any, else 0."""
    from sros_tool.explain.log import SearchedKeystore, explain_log
    from sros_tool.keystore.layout import is_keystore

    if len(rest) > 1:
        raise UsageError("--log takes at most a keystore and an enclave")
    named: LoadedEnclave | None = None
    if rest:
        named = _signed_enclave(root, rest[0], options)
        if named is None:
            raise UsageError(
                f"no keystore is named for enclave {rest[0]}",
                "",
                "Write the keystore before the enclave.",
            )

    # Once for each enclave: whoever writes the log chooses how many it names, and how often.
    @cache
    def find(enclave: str) -> LoadedEnclave | None:
        if named is not None and enclave in ("", named.name):
            return named
        if root is None or not enclave:
            return None
        try:
            return _signed_enclave(root, check_enclave_name(enclave), options, planned=True)
        except SrosError:  # the log names an enclave of another keystore, or a path
            return None

    text = read_log(log)
    findings = explain_log(
        text,
        find,
        lambda enclave: options.context(enclave.joined_domains),
        str(root or ""),
        SearchedKeystore(root) if root and is_keystore(root) else None,
    )
    if as_json:
        notes = as_plain(_LOG_NOTES if findings else ())
        shown = [_finding_json(each) for each in findings]
        print_json({"log": log, "findings": shown, "notes": notes})
    else:
        for finding in findings:
            _echo(_finding_lines(finding))
        if findings:
            print_notes(_LOG_NOTES)
        else:
            lines = text.count("\n") + (not text.endswith("\n")) if text else 0
            number = "the log is empty" if not lines else f"of {lines} lines, none"
            number += (
                ""
                if not lines
                else " looks like a message of DDS Security, or of a denial by Zenoh"
            )
            echo(number, err=True)
            if _ZENOH_TESTS in text:
                echo(_ONLY_TESTS, err=True)
    return 1 if findings else 0


_ZENOH_TESTS = "caching permissions for `"
_ONLY_TESTS = (
    "Zenoh's access control logged tests of declared keys: they do not tell which message was "
    "dropped. `sros explain ROOT ENCLAVE publish|subscribe|call|serve NAME --vendor zenoh` shows "
    "whether one is denied."
)


_LOG_NOTES = (
    Note(
        "log.only-text",
        "a process can print any line: only what is shown after 'found' was examined in the "
        "enclave",
    ),
)


def _finding_lines(finding: LogFinding) -> Iterator[str]:
    from sros_tool.runtime.vendor_log import UNKNOWN, plain_refusal

    times = f"  ({finding.count} times)" if finding.count > 1 else ""
    by = f" of {finding.process}" if finding.process else ""
    text = finding.text if finding.id == UNKNOWN.id else plain_refusal(finding.text)
    yield f"line {finding.line}{by}: {text[:160]}{times}"
    of = f" [{finding.enclave}]" if finding.enclave else ""
    source = finding.vendor.title.split()[0] + " DDS" if finding.vendor else "ROS 2"
    source = ZENOH_TITLE if finding.zenoh else source
    yield f"  means     {source}{of}: {finding.cause}"
    yield from (f"  found     {each}" for each in finding.found)
    yield f"  remedy    {finding.remedy}"


def _finding_json(finding: LogFinding) -> dict[str, Any]:
    return {
        "id": finding.id,
        "vendor": ZENOH if finding.zenoh else finding.vendor.value if finding.vendor else None,
        "line": finding.line,
        "count": finding.count,
        "text": finding.text,
        "process": finding.process or None,
        "enclave": finding.enclave or None,
        "cause": finding.cause,
        "checked": finding.checked,
        "found": list(finding.found),
        "remedy": finding.remedy,
    }
