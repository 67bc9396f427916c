"""The answers of Zenoh as `sros explain` shows them: as lines, and as JSON."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Any

from sros_tool.validity import iso
from sros_tool.wording import counted

if TYPE_CHECKING:
    from sros_tool.explain.question import Question
    from sros_tool.explain.zenoh import ZenohAnswer
    from sros_tool.zenoh.delivery import Check

ZENOH = "zenoh"
"""The word of --vendor for Zenoh, which is not DDS."""
ZENOH_TITLE = "Zenoh"
_MOST_SHOWN = 10
_LABEL_WIDTH = 10
_DOES = {
    "publish": ("heard by", "a put on all of it is heard by"),
    "subscribe": ("hears", ""),
    "call": ("served by", "a query on all of it is executed by"),
    "request": ("served by", "a query on all of it is executed by"),
    "serve": ("serves", ""),
    "reply": ("serves", ""),
    "execute": ("serves", ""),
}


def row(label: str, text: str) -> str:
    """Return a line of an answer: a label and a text in two columns."""
    return f"  {label:{_LABEL_WIDTH}}{text}"


def zenoh_lines(answer: ZenohAnswer, why: str) -> Iterator[str]:
    """Yield the answer of Zenoh as lines; ``why`` is the reason to ask Zenoh."""
    ok = answer.outcome.ok
    may = f"yes: {answer.enclave} may" if ok else f"no: {answer.enclave} may not"
    mode = f" in {answer.mode} mode" if answer.mode else ""
    yield f"{may} {answer.question}, on {ZENOH_TITLE}{mode} ({why})"
    yield row("why", answer.text)
    links = sorted(answer.links, key=lambda each: _dropped(each[1]) is None)
    for number, ((one, other), checks) in enumerate(links[:_MOST_SHOWN]):
        if len(links) == 1 or (number == 0 and not ok):
            yield row("link", f"between {one} and {other}:")
            yield from (row("", f"  {each}") for each in _message_lines(checks))
        else:
            yield row("link", f"between {one} and {other}: {_link_text(checks)}")
    if len(links) > _MOST_SHOWN:
        more = links[_MOST_SHOWN:]
        passing = sum(_dropped(checks) is None for _, checks in more)
        yield row("link", f"{len(more)} more: {passing} pass it, {len(more) - passing} drop it")
    if answer.dropped:
        by = answer.dropped.enforcer
        what = f"{by}: silently dropped, and {answer.enclave} gets no error"
        yield row("denied by", what)
    if ok and answer.question.word in _DOES:
        yield from _reach_lines(answer)
    if ok and answer.until:
        yield row("until", f"{iso(answer.until)}, when cert.pem expires")


def _reach_lines(answer: ZenohAnswer) -> Iterator[str]:
    does, wide_does = _DOES[answer.question.word]
    able = [each.enclave for each in answer.reached if not each.problem]
    yield row(does, _names(able))
    for each in [each for each in answer.reached if each.problem][:_MOST_SHOWN]:
        yield row("", f"not {each.enclave}, which has the right: {each.problem}")
    for wide, reached in answer.wildcards:
        yield row("wildcard", f"{wide} also matches other names")
        if wide_does:
            yield row("", f"{wide_does} {_names(reached)}")


def _names(names: Sequence[str]) -> str:
    shown = ", ".join(names[:_MOST_SHOWN])
    more = len(names) - _MOST_SHOWN
    return (f"{shown} and {more} more" if more > 0 else shown) or "nobody"


def _message_lines(checks: Sequence[Check]) -> Iterator[str]:
    """Yield for each message on a link who passes it by which rule, or drops it."""
    said: dict[tuple[str, str], list[str]] = {}
    for each in checks:
        way = "leaving" if each.flow == "egress" else "entering"
        how = "silently dropped"
        if each.decision.allowed:
            how = f"by rule {each.decision.rules[0]}" if each.decision.rules else "without a rule"
        said.setdefault((each.message, each.key), []).append(f"{way} {each.enforcer} {how}")
    for (message, key), found in said.items():
        yield f"{message} {key}: {', '.join(found)}"


def _link_text(checks: Sequence[Check]) -> str:
    """Return what happens on one of several links: whether all messages pass."""
    found = _dropped(checks)
    if found is None:
        return "passes"
    return f"{found} is silently dropped by {found.enforcer} ({found.decision.why})"


def _dropped(checks: Sequence[Check]) -> Check | None:
    return next((each for each in checks if not each.decision.allowed), None)


def zenoh_json(answer: ZenohAnswer) -> dict[str, Any]:
    """Return the answer of Zenoh as JSON values."""
    return {
        **brief_zenoh_json(answer),
        "outcome": answer.outcome.value,
        "links": [
            {
                "enclaves": list(ends),
                "passes": _dropped(checks) is None,
                "checks": [_check_json(each) for each in checks],
            }
            for ends, checks in answer.links
        ],
        "reached": [
            {"enclave": each.enclave, "problem": each.problem or None} for each in answer.reached
        ],
        "wildcards": [
            {"expression": wide, "reaches": list(reached)} for wide, reached in answer.wildcards
        ],
        "until": iso(answer.until) if answer.until else None,
        "unsigned": list(answer.unsigned),
    }


def brief_zenoh_json(answer: ZenohAnswer) -> dict[str, Any]:
    """Return only whether Zenoh allows it, and why, as JSON values."""
    return {
        "allowed": answer.outcome.ok,
        "mode": answer.mode.value if answer.mode else None,
        "text": answer.text,
    }


def _check_json(check: Check) -> dict[str, Any]:
    return {
        "enforcer": check.enforcer,
        "remote": check.remote,
        "flow": check.flow.value,
        "message": check.message.value,
        "key": check.key,
        "allowed": check.decision.allowed,
        "rules": list(check.decision.rules),
        "why": check.decision.why,
    }


def zenoh_who_lines(question: Question, found: Sequence[ZenohAnswer]) -> Iterator[str]:
    """Yield the allowed enclaves, those whose processes open no session, and the counts."""
    able = [each for each in found if each.outcome.ok]
    for each in able:
        wide = each.wildcards[0][0] if each.wildcards else ""
        yield each.enclave + (f"  by the wildcard {wide}" if wide else "")
    for each in found:
        if each.outcome == "refused":
            yield f"  not now: {each.enclave}  {each.text}"
    yield f"{len(able)} of {counted(len(found), 'enclave')} may {question}"


def zenoh_who_json(each: ZenohAnswer) -> dict[str, Any]:
    """Return the answer for one of several enclaves as JSON values."""
    return {
        "enclave": each.enclave,
        **brief_zenoh_json(each),
        "outcome": each.outcome.value,
        "wildcard": each.wildcards[0][0] if each.wildcards else None,
    }
