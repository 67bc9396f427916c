"""The verb that says what DDS will decide, and why."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING

import click

from sros_tool.cli.common import (
    KEYSTORE_VARIABLE,
    PATH,
    complete_keystore_and_enclave,
    json_option,
    print_json,
    print_notes,
)
from sros_tool.cli.explain_case import Place, case_of, vendor_of
from sros_tool.cli.explain_options import refuse_ignored
from sros_tool.cli.visible import visible
from sros_tool.errors import UsageError

if TYPE_CHECKING:
    from click.shell_completion import CompletionItem

    from sros_tool.dds.decision import Vendor
    from sros_tool.explain.case import Case, Explanation
    from sros_tool.explain.question import Question
    from sros_tool.notes import Note

_VENDORS = ("standard", "fastdds", "fastdds-2.9", "cyclonedds", "opendds", "connext")
_WORDS = ("publish", "subscribe", "call", "serve", "execute", "request", "reply", "join")


def _complete_words(
    ctx: click.Context, parameter: click.Parameter, incomplete: str
) -> list[CompletionItem | str]:
    """Completes the keystore, then its enclaves, then what they could do."""
    from sros_tool.keystore.layout import is_keystore

    given: tuple[str, ...] = ctx.params.get("words") or ()
    named = bool(given) and is_keystore(Path(given[0]))
    rest = given[1:] if named else given
    if len(rest) == (0 if ctx.params.get("who") else 1):
        return [word for word in _WORDS if word.startswith(incomplete)]
    if rest:
        return []
    if named or ctx.params.get("keystore"):
        return _complete_enclave(ctx, parameter, incomplete)
    return complete_keystore_and_enclave(ctx, parameter, incomplete)


def _complete_enclave(
    ctx: click.Context, _parameter: click.Parameter, incomplete: str
) -> list[CompletionItem | str]:
    """Completes the enclaves of the keystore that is named, or else of the environment's."""
    from sros_tool.keystore.layout import enclave_names, is_keystore

    given = ctx.params.get("words") or ctx.args  # args, where an option still lacks its value
    named = ctx.params.get("keystore") or (given[0] if given else "")
    root = Path(named or os.environ.get(KEYSTORE_VARIABLE, ""))
    names = enclave_names(root) if is_keystore(root) else ()
    return [name for name in names if name.startswith(incomplete)]


@click.command(
    "explain",
    epilog="""\b
Example:
  $ sros explain keystore /talker publish /chatter --policy robot.xml
  yes: /talker may publish topic /chatter, on Fast DDS 2.14 (rmw_fastrtps_cpp is installed here)
    why       rule 1 allows publish rt/chatter by rt/chatter
    rule      allow rule 1 of grant /talker: rt/chatter
    from      robot.xml:12: ALLOW publish chatter
    protected payload ENCRYPT, submessages ENCRYPT, RTPS messages SIGN
    until     2036-11-18T09:00:00Z, when cert.pem expires
  $ sros explain keystore /talker call /add_two_ints --all-vendors
  $ sros explain keystore --who publish /cmd_vel
  $ sros explain keystore --reach /mobile_robot/teleop
  $ ros2 run demo_nodes_cpp talker 2>&1 | sros explain keystore /talker --log -""",
)
@click.argument(
    "words",
    metavar="[ROOT] [ENCLAVE] [publish|subscribe|call|serve|execute|join [NAME]]",
    nargs=-1,
    shell_complete=_complete_words,
)
@click.option(
    "--type", "kind", type=click.Choice(["topic", "service", "action"]), help="What NAME is."
)
@click.option("--keystore", type=PATH, metavar="ROOT", help="A keystore, or an enclave's folder.")
@click.option(
    "--policy",
    type=PATH,
    metavar="FILE",
    help="Where the permissions came from; without a keystore, what is asked.",
)
@click.option(
    "--vendor",
    type=click.Choice(_VENDORS),
    help="Whose decision counts. [default: that of this machine's RMW]",
)
@click.option("--all-vendors", is_flag=True, help="Compare what the vendors decide.")
@click.option(
    "--at", "moment", metavar="MOMENT", help="When: 2027-06-01, or 90d from now. [default: now]"
)
@click.option(
    "--domain", metavar="ID", help="The ROS domain. [default: $ROS_DOMAIN_ID, or the keystore's]"
)
@click.option(
    "--time-zone",
    metavar="ZONE",
    help="That of the robot, which Fast DDS goes by: Asia/Tokyo. [default: this machine's]",
)
@click.option("--who", is_flag=True, help="Say which enclaves of the keystore may.")
@click.option(
    "--reach",
    metavar="ENCLAVE",
    shell_complete=_complete_enclave,
    help="Say whom this enclave can influence and learn from, over any number of hops.",
)
@click.option(
    "--infrastructure",
    is_flag=True,
    help="With --reach, count /parameter_events too, which all nodes share.",
)
@click.option(
    "--log", metavar="FILE", help="Say what the lines of a DDS log mean; - is standard input."
)
@json_option
def explain(
    words: tuple[str, ...],
    kind: str | None,
    keystore: Path | None,
    policy: Path | None,
    vendor: str | None,
    all_vendors: bool,
    moment: str | None,
    domain: str | None,
    time_zone: str | None,
    who: bool,
    reach: str | None,
    infrastructure: bool,
    log: str | None,
    as_json: bool,
) -> int:
    """Say whether DDS lets an enclave do something, by which rule, and what would change that.

    call and serve are about services, or with --type action call is about an action; execute is
    about actions. ROOT is a keystore, here or on a robot; ENCLAVE can also be an enclave's folder.
    With --policy and no keystore, the policy itself is asked, before anything is signed.

    The exit status is 0 if it is allowed (with --who: to anybody), and 1 if it is denied; with
    --log, 1 if the log tells of a fault.
    """
    if sum((who, bool(reach), log is not None)) > 1:
        raise UsageError("--who, --reach and --log exclude each other")
    mode = "--who" if who else "--reach" if reach else "--log" if log is not None else ""
    refuse_ignored(mode)
    root, rest = _split(words, keystore, verb=0 if who else 1)
    if log is not None:
        from sros_tool.cli.explain_log import show_log

        return show_log(log, root, rest, Place(moment, domain, time_zone), as_json=as_json)
    if reach:
        from sros_tool.cli.explain_all import show_reach

        return show_reach(reach, root, rest, policy, infrastructure, as_json)
    place = Place(moment, domain, time_zone)
    if who:
        from sros_tool.cli.explain_all import show_who

        return show_who(root, rest, kind, vendor, place, as_json)
    return _one(root, rest, kind, policy, vendor, all_vendors, place, as_json)


def _split(
    words: tuple[str, ...], keystore: Path | None, *, verb: int
) -> tuple[Path | None, tuple[str, ...]]:
    """The keystore, if one is named before the other words or by the option, and those words.

    ``verb`` is the place of what is to be done, where no keystore is named.
    """
    from sros_tool.keystore.layout import is_keystore

    if keystore is not None and words and is_keystore(Path(words[0])):
        raise UsageError(f"two keystores are named, '{words[0]}' and '{keystore}'")
    if keystore is not None or not words or _is_word(words, verb):
        return keystore, words
    if _is_word(words, verb + 1) or Path(words[0]).is_dir():
        return Path(words[0]), words[1:]
    return None, words


def _is_word(words: tuple[str, ...], place: int) -> bool:
    return words[place : place + 1] != () and words[place] in _WORDS


# ── one question ───────────────────────────────────────────────────────────────────────────


def _one(
    root: Path | None,
    rest: tuple[str, ...],
    kind: str | None,
    policy: Path | None,
    vendor: str | None,
    all_vendors: bool,
    place: Place,
    as_json: bool,
) -> int:
    from sros_tool.cli.explanation import (
        asked_json,
        differences,
        explanation_json,
        lines_of,
        table_lines,
    )
    from sros_tool.dds.decision import Vendor
    from sros_tool.explain.case import explain as explain_case
    from sros_tool.explain.question import ask

    if not 2 <= len(rest) <= 3:
        raise UsageError(
            "explain takes an enclave, what it wants to do, and a name",
            "",
            "Write for example `sros explain /talker publish /chatter`.",
        )
    question = ask(rest[1], rest[2] if len(rest) > 2 else "", kind)
    case = case_of(root, rest[0], policy, place)
    chosen, why = vendor_of(vendor)
    wanted = list(Vendor) if all_vendors else [chosen]
    found = [explain_case(case, question, each) for each in wanted]
    answer = next(each.answer for each in found if each.answer.vendor is chosen)
    if as_json:
        told = [explanation_json(case, each, policy) for each in found]
        one = {**told[0], "vendor_why": why}
        shown = {"vendors": told, "differ": len({each["outcome"] for each in told}) > 1}
        print_json({**asked_json(case, answer), **(shown if all_vendors else one)})
    else:
        lines = table_lines(case, found) if all_vendors else lines_of(case, found[0], why, policy)
        for line in lines:
            click.echo(visible(line))
    notes = [*_provenance_notes(found[0], policy), *_other_type(case, question, kind, chosen)]
    if not all_vendors:
        measured = [explain_case(case, question, v) for v in (Vendor.FAST, Vendor.CYCLONE)]
        if measured[0].answer.outcome is not measured[1].answer.outcome:
            notes.append(_note("explain.vendors-differ", differences(measured) + "."))
    print_notes(notes)
    return 0 if answer.allowed else 1


def _provenance_notes(found: Explanation, policy: Path | None) -> list[Note]:
    from sros_tool.explain.origin import Provenance

    match found.provenance:
        case Provenance.CHANGED:
            text = (
                f"the permissions were not made from '{policy}' as it is now: it has changed "
                "since, or it is another file. Lines are those of the file as it is now."
            )
        case Provenance.UNKNOWN:
            text = f"whether the permissions were made from '{policy}' is not recorded."
        case _:
            return []
    return [_note(f"explain.policy-{found.provenance}", text)]


def _other_type(case: Case, question: Question, kind: str | None, vendor: Vendor) -> list[Note]:
    """A remark where a service was asked for that the enclave knows as an action."""
    from sros_tool.explain.answer import Judge
    from sros_tool.explain.question import ask

    if question.word != "call" or kind:
        return []
    judge = Judge(vendor, case.material, case.setting)
    action = ask("call", question.name, "action")
    if judge.answer(question).allowed or not judge.answer(action).allowed:
        return []
    text = f"it may {action}: add --type action if that is what {question.name} is."
    return [_note("explain.an-action", text)]


def _note(name: str, text: str) -> Note:
    from sros_tool.notes import Note

    return Note(name, text)
