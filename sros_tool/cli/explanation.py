"""How the answers of ``sros explain`` are shown: as text and as JSON of a stable shape."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sros_tool.cli.policy import right_json
from sros_tool.names import is_expression
from sros_tool.validity import iso

if TYPE_CHECKING:
    from sros_tool.dds.decision import Decision
    from sros_tool.explain.answer import Answer, PartAnswer
    from sros_tool.explain.case import Case, Explanation
    from sros_tool.explain.change import Change
    from sros_tool.policy.model import Source

_ADDITION = "allow.xml"
_WIDTH = 10


# ── one question ───────────────────────────────────────────────────────────────────────────


def lines_of(case: Case, found: Explanation, why: str, policy: Path | None) -> Iterator[str]:
    """The answer of one vendor, with its reasons; ``why`` says why it is this vendor's."""
    answer = found.answer
    decision = answer.deciding.decision
    name, vendor = case.material.enclave, answer.vendor.title
    said = f"yes: {name} may" if answer.allowed else f"no: {name} may not"
    documented = ", as documented" if answer.as_documented else ""
    yield f"{said} {answer.question}, on {vendor} ({why}{documented})"
    yield _row("why", _reason(decision))
    if len(answer.problems) > 1:
        yield from (_row("and", str(each)) for each in answer.problems[1:])
    if (answer.outcome, len(answer.failing)) != ("allowed", 0) and len(answer.parts) > 1:
        yield from _parts(answer)
    if decision.rule is not None and answer.grant:
        rule = answer.grant.rules[decision.rule]
        what = f"{'allow' if rule.allow else 'deny'} rule {decision.rule + 1}"
        yield _row("rule", f"{what} of grant {answer.grant.name}: {decision.expression}")
    if found.wildcard:
        yield _row("wildcard", f"{found.wildcard} stands for more than this name")
    for each in found.origins:
        said = f"{each.qualifier.value} {each.right} {each.name}"
        yield _row("from", f"{_shown(each.source)}: {said}")
    if found.recorded and policy is None and decision.rule is not None:
        yield _row(
            "from", f"a policy file with the digest {found.recorded[:12]}; name it by --policy"
        )
    if answer.allowed:
        yield _row("protected", ", ".join(_protection_words(answer)))
    elif found.who_denies:
        yield _row("denied by", found.who_denies)
    if answer.until and answer.allowed:
        yield _row("until", f"{iso(answer.until)}, when {answer.until_file} expires")
    yield from _what_to_do(case, found, policy)


def _row(label: str, text: str) -> str:
    return f"  {label:{_WIDTH}}{text}"


def _shown(source: Source) -> str:
    """Where something stands, relative to here if it lies below."""
    here = Path.cwd()
    file = Path(source.file)
    return f"{file.relative_to(here) if file.is_relative_to(here) else file}:{source.line}"


def _reason(decision: Decision) -> str:
    _, colon, text = decision.text.partition(": ")
    return (text if colon else decision.text).removesuffix(".")


def _parts(answer: Answer) -> Iterator[str]:
    for each in answer.parts:
        if each.part:
            sign = "ok" if each.decision.outcome.ok else str(each.decision.outcome)
            yield _row("part", f"{each.part}: {sign}")


def _protection_words(answer: Answer) -> Iterator[str]:
    topic, domain = _topic_rule(answer), answer.domain_rule
    if topic:
        yield f"payload {topic.data_protection_kind}"
        yield f"submessages {topic.metadata_protection_kind}"
    if domain:
        yield f"RTPS messages {domain.rtps_protection_kind}"
    if topic and not (topic.enable_read_access_control and topic.enable_write_access_control):
        off = [
            word
            for word, on in (
                ("reading", topic.enable_read_access_control),
                ("writing", topic.enable_write_access_control),
            )
            if not on
        ]
        yield f"ACCESS CONTROL OFF for {' and '.join(off)}"


def _topic_rule(answer: Answer) -> Any:
    rules = (each.decision.topic_rule for each in (answer.deciding, *answer.parts))
    return next((rule for rule in rules if rule), None)


def _what_to_do(case: Case, found: Explanation, policy: Path | None) -> Iterator[str]:
    if found.change:
        yield from _change_lines(found.change)
    if found.remedy:
        yield _row("remedy", found.remedy)
    commands = commands_of(case, found, policy)
    for number, command in enumerate(commands):
        yield _row("run" if not number else "", command)


def _change_lines(change: Change) -> Iterator[str]:
    yield _row("change", "the smallest change of the policy that would allow it:")
    for edit in change.edits:
        group = edit.xml.partition(" ")[0].removeprefix("<") if edit.xml else "group"
        if edit.xml:
            yield f"    at {_shown(edit.source)}, let the <{group}> read"
            yield from (f"      {line}" for line in edit.xml.splitlines())
        else:
            yield f"    remove the group at {_shown(edit.source)}"
    if change.lift and not change.edits:
        yield from (f"    remove: {right.qualifier} {right.told()}" for right in change.lift)
    for right in change.lift:
        if is_expression(right.name):
            yield f"    which lifts the denial of everything else in {right.name}, too"
    if change.document:
        yield f"    save as {_ADDITION}"
        yield from (f"      {line}" for line in change.document.splitlines())


def commands_of(case: Case, found: Explanation, policy: Path | None) -> list[str]:
    """The commands that put a change into force, in their order."""
    if not found.change and not found.sign:
        return []
    file = str(policy) if policy else "POLICY"
    commands = []
    if found.change and found.change.document:
        commands.append(f"sros merge_policy {file} {_ADDITION} --in-place")
    root = str(case.root) if case.root else "KEYSTORE"
    commands.append(f"sros create_permission {root} {case.material.enclave} {file}")
    return commands


# ── all vendors ────────────────────────────────────────────────────────────────────────────


def table_lines(case: Case, found: Sequence[Explanation]) -> Iterator[str]:
    """One line for each vendor, and where they differ."""
    answers = [each.answer for each in found]
    yield f"may {case.material.enclave} {answers[0].question}?"
    width = max(len(each.vendor.title) for each in answers)
    for answer in answers:
        remark = " (as documented)" if answer.as_documented else ""
        reason = _reason(answer.deciding.decision)
        yield f"  {answer.vendor.title:{width}}  {answer.outcome:11}  {reason}{remark}"
    yield differences(found)


def differences(found: Sequence[Explanation]) -> str:
    """Which vendors answer otherwise than the first of them, in a sentence."""
    first = found[0].answer
    others = [e.answer for e in found if e.answer.outcome is not first.outcome]
    if not others:
        return "all of them decide alike"
    told = ", ".join(f"{each.vendor.title} ({each.outcome})" for each in others)
    return f"THEY DIFFER: {first.vendor.title} says {first.outcome}, otherwise decide {told}"


# ── JSON ───────────────────────────────────────────────────────────────────────────────────


def asked_json(case: Case, answer: Answer) -> dict[str, Any]:
    """What was asked, where and when."""
    question = answer.question
    return {
        "enclave": case.material.enclave,
        "question": {
            "word": question.word,
            "type": question.type or None,
            "right": question.right or None,
            "name": question.name or None,
        },
        "domain": case.setting.domain,
        "at": iso(case.setting.at),
        "time_zone": str(case.setting.zone),
    }


def explanation_json(case: Case, found: Explanation, policy: Path | None) -> dict[str, Any]:
    """The answer of one vendor."""
    answer = found.answer
    decision = answer.deciding.decision
    return {
        "vendor": answer.vendor.value,
        "vendor_title": answer.vendor.title,
        "documented_only": answer.vendor.documented_only,
        "allowed": answer.allowed,
        "outcome": answer.outcome.value,
        "reason": decision.reason,
        "text": decision.text,
        "denied_by": found.who_denies or None,
        "rule": _rule_json(answer),
        "wildcard": found.wildcard or None,
        "policy": _policy_json(found, policy),
        "policy_sha256": found.recorded or None,
        "protection": _protection_json(answer),
        "until": iso(answer.until) if answer.until else None,
        "until_file": answer.until_file or None,
        "problems": [
            {"file": each.file, "text": each.text, "code": each.code} for each in answer.problems
        ],
        "parts": [_part_json(each) for each in answer.parts],
        "remedy": found.remedy or None,
        "change": _change_json(found.change) if found.change else None,
        "commands": commands_of(case, found, policy),
    }


def _rule_json(answer: Answer) -> dict[str, Any] | None:
    decision = answer.deciding.decision
    if decision.rule is None or answer.grant is None:
        return None
    return {
        "grant": decision.grant,
        "grant_name": answer.grant.name,
        "rule": decision.rule,
        "allow": answer.grant.rules[decision.rule].allow,
        "expression": decision.expression,
    }


def _policy_json(found: Explanation, policy: Path | None) -> dict[str, Any] | None:
    if found.provenance is None:
        return None
    return {
        "file": str(policy),
        "provenance": found.provenance.value,
        "lines": [
            {
                "file": each.source.file,
                "line": each.source.line,
                "qualifier": each.qualifier.value,
                "right": each.right,
                "name": each.name,
            }
            for each in found.origins
        ],
        "would_allow": found.sign,
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


def _part_json(each: PartAnswer) -> dict[str, Any]:
    part = each.part
    assert part is not None
    return {
        "verb": part.verb.value,
        "topic": part.topic,
        "role": part.role or None,
        "outcome": each.decision.outcome.value,
        "reason": each.decision.reason,
        "expression": each.decision.expression,
    }


def _change_json(change: Change) -> dict[str, Any]:
    return {
        "add": [right_json(right) for right in change.add],
        "lift": [right_json(right) for right in change.lift],
        "document": change.document or None,
        "edits": [
            {"file": each.source.file, "line": each.source.line, "xml": each.xml}
            for each in change.edits
        ],
    }
