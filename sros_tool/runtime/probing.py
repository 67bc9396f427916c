"""Judge what a DDS answered to a probe: does it enforce security, and on what evidence.

Only two answers are a no: it says that security is not built in, or it lets an endpoint pass that
the permissions do not allow.  Whatever else goes wrong is "could not be tried", never a no.
"""

from __future__ import annotations

import signal
from collections.abc import Sequence
from dataclasses import dataclass

from sros_tool.runtime.events import Event, Kind, Stage
from sros_tool.runtime.security_log import endpoint_refusal, missing_security, participant_refusal


@dataclass(frozen=True)
class ProbeRun:
    """What one probe process left: its reports, its output, and how it ended.

    ``status`` is its exit status, negative for a signal, None where it had to be stopped.
    """

    events: tuple[Event, ...]
    output: str
    status: int | None


@dataclass(frozen=True)
class Verdict:
    """Whether a DDS enforces security (None: could not be tried), and what was seen."""

    enforces: bool | None
    evidence: str


def judge(run: ProbeRun, allowed: str, denied: str) -> Verdict:
    """Decide from a run that asked for a writer on ``allowed`` and endpoints on ``denied``."""
    told = "\n".join([run.output, *(event.text for event in run.events)])
    if lacking := missing_security(told):
        return Verdict(False, f"a secured participant fails: {lacking}")
    if not _happened(run.events, Kind.READY, Stage.PARTICIPANT):
        return _untried(_why_not_joined(run, told))
    answers = {
        event.text.partition("\n")[0]: event
        for event in run.events
        if event.stage is Stage.ENDPOINT
    }
    wanted = answers.get(f"writer {allowed}")
    if wanted is None or wanted.kind is not Kind.READY:
        return _untried(f"even the allowed writer on {allowed} failed. {_reason(wanted, run)}")
    asked = [f"writer {denied}", f"reader {denied}"]
    for question in asked:
        answer = answers.get(question)
        if answer is None:
            return _untried(f"no answer about the {question}. {_ending(run)}")
        if answer.kind is Kind.READY:
            return Verdict(False, f"it created a {question}, which its permissions do not allow")
    refusals = [_refusal(answers[question], run, denied) for question in asked]
    if not all(refusals):
        reason = _reason(answers[asked[0]], run)
        return _untried(f"endpoints on {denied} failed, but not by a security refusal. {reason}")
    return Verdict(
        True,
        f"in an enclave made by sros it created the allowed writer on {allowed}, and refused"
        f" writer and reader on {denied}: {refusals[0]}",
    )


def _refusal(answer: Event, run: ProbeRun, topic: str) -> str:
    if answer.kind is Kind.REFUSED:
        return answer.text.partition("\n")[2]
    lines = [line for line in run.output.splitlines() if topic in line or "SECURITY" in line]
    return endpoint_refusal("\n".join([answer.text, *lines]))


def _why_not_joined(run: ProbeRun, told: str) -> str:
    failed = _first(run.events, Kind.FAILED) or _first(run.events, Kind.REFUSED)
    refusal = participant_refusal(told) or endpoint_refusal(told)
    if refusal:
        return f"the participant itself was refused: {refusal}"
    return _reason(failed, run)


def _reason(event: Event | None, run: ProbeRun) -> str:
    if event is None:
        return _ending(run)
    return " ".join(event.text.split())


def _ending(run: ProbeRun) -> str:
    if run.status is None:
        return "The probe process gave no answer in time."
    if run.status < 0:
        return f"The probe process was ended by {_signal_name(-run.status)}."
    last = run.output.strip().splitlines()[-1:]
    return f"The probe process ended with status {run.status}. {' '.join(last)}".strip()


def _signal_name(number: int) -> str:
    try:
        return signal.Signals(number).name
    except ValueError:
        return f"signal {number}"


def _happened(events: Sequence[Event], kind: Kind, stage: Stage) -> bool:
    return any(event.kind is kind and event.stage is stage for event in events)


def _first(events: Sequence[Event], kind: Kind) -> Event | None:
    return next((event for event in events if event.kind is kind), None)


def _untried(why: str) -> Verdict:
    return Verdict(None, f"could not be tried: {why}")
