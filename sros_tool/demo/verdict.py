"""Judge what was observed in a row, from the reports of its processes.

A crash is not a refusal.  Silence counts only if both sides were ready, the talker sent messages,
and the controls held; a refusal counts only if DDS Security reported it, for this topic.
"""

from __future__ import annotations

import re
import signal
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from sros_tool.demo.scenarios.model import (
    STATUS_OF,
    SUCCESSES,
    Claim,
    Party,
    Relation,
    Role,
    Row,
    RowStatus,
    Wire,
)
from sros_tool.demo.wire import Injection, WireCount, forged_text
from sros_tool.runtime.events import Event, EventKind, ProcessStage
from sros_tool.runtime.vendor_log import (
    endpoint_refusal,
    missing_security,
    participant_refusal,
    plain_refusal,
)


@dataclass(frozen=True)
class PartyRecord:
    """The record of one process after its end.

    ``text`` marks the messages of a talker; ``topic`` is its ROS topic; ``through`` names the
    library it used; ``output`` is what it printed; ``status`` is its exit status (negative for a
    signal) if it ended before it was stopped.
    """

    text: str = ""
    topic: str = ""
    through: str = ""
    events: tuple[Event, ...] = ()
    output: str = ""
    status: int | None = None


@dataclass(frozen=True)
class RowRecord:
    """The record of a row after its end.

    ``window`` has start and end of the observation (CLOCK_MONOTONIC, s), or None if a party was not
    ready in time.  ``injected`` counts the packets that were sent again or changed; ``skipped`` is
    why the row was not run, or "".
    """

    row: Row
    domain: int
    parties: Mapping[str, PartyRecord] = field(default_factory=dict)
    window: tuple[float, float] | None = None
    wire: Mapping[str, WireCount] = field(default_factory=dict)
    injected: Injection | None = None
    skipped: str = ""


@dataclass(frozen=True)
class RowResult:
    """The result of a row: one line of the table."""

    name: str
    expected: RowStatus
    observed: RowStatus
    mechanism: str
    detail: str
    domain: int
    seconds: float = 0.0
    attack: str = ""
    removed: str = ""
    open_because: str = ""
    remedy: str = ""
    accepted: bool = False
    unaccepted: bool = False

    @property
    def as_expected(self) -> bool:
        """Whether the row was skipped, has the expected status, or is open and was accepted."""
        expected = self.observed in (self.expected, RowStatus.SKIPPED) and not self.open_here
        return expected or self.known_open

    @property
    def known_open(self) -> bool:
        """Whether the row shows an attack that is known to succeed, or accepted by the user."""
        if self.accepted and self.observed in SUCCESSES:
            return True
        return bool(self.open_because) and self.observed is self.expected and not self.open_here

    @property
    def open_here(self) -> bool:
        """Whether the attack succeeds because of the user's keystore, and was not accepted."""
        return self.unaccepted and self.observed is self.expected

    def as_json(self) -> dict[str, Any]:
        """Return the row as `sros demo --json` shows it."""
        return {
            "name": self.name,
            "expected": self.expected.value,
            "observed": self.observed.value,
            "as_expected": self.as_expected,
            "mechanism": self.mechanism,
            "detail": self.detail,
            "domain": self.domain,
            "seconds": round(self.seconds, 1),
            "attack": self.attack,
            "defence_removed": self.removed,
            "open_because": self.open_because,
            "remedy": self.remedy,
            "accepted": self.accepted,
            "open_here": self.open_here,
        }


@dataclass(frozen=True)
class _Finding:
    """The observed status of one claim, with the evidence."""

    status: RowStatus
    detail: str


def judge_row(record: RowRecord) -> RowResult:
    """Return the result of a row from its record."""
    finding = _observe(record)
    row = record.row
    seconds = record.window[1] - record.window[0] if record.window else 0.0
    return RowResult(
        row.name,
        row.expected,
        finding.status,
        row.mechanism,
        finding.detail,
        record.domain,
        seconds,
        row.attack,
        row.removed,
        row.open_because,
        row.remedy,
        row.accepted,
        row.unaccepted,
    )


def _observe(record: RowRecord) -> _Finding:
    if record.skipped:
        return _Finding(RowStatus.SKIPPED, record.skipped)
    for party in record.row.parties:
        lost = _lost_import(party, record.parties[party.name])
        if lost:
            return _Finding(RowStatus.SKIPPED, lost)
    claims = [(claim, _judge_claim(claim, record)) for claim in record.row.claims]
    controls = [(claim, _judge_claim(claim, record)) for claim in record.row.controls]
    wrong = [finding for claim, finding in claims if finding.status is not claim.expected]
    if wrong:
        definite = wrong[0].status in STATUS_OF.values()
        several = len(claims) > 1
        status = RowStatus.DISTURBED if several and definite else wrong[0].status
        return _Finding(status, wrong[0].detail)
    for claim, finding in controls:
        if finding.status is not claim.expected:
            what = f"{claim.subject} {claim.relation} {claim.talker}".strip()
            return _Finding(
                RowStatus.UNDECIDED,
                f"the control failed ({what}: {finding.status}, {finding.detail})",
            )
    details = [finding.detail for _, finding in claims]
    details += [f"control: {finding.detail}" for _, finding in controls]
    return _Finding(record.row.expected, "; ".join(details))


def _lost_import(party: Party, record: PartyRecord) -> str:
    """Return why a node could not import rclpy or an interface, or ""."""
    if party.role in (Role.TALKER, Role.LISTENER):
        return ""
    failed = (
        e.text
        for e in record.events
        if e.kind is EventKind.FAILED and e.stage is ProcessStage.IMPORT
    )
    what = "rclpy" if party.role is Role.OBSERVER else f"the {party.role}"
    return next((f"{what} cannot be loaded here: {text}" for text in failed), "")


def _judge_claim(claim: Claim, record: RowRecord) -> _Finding:
    subject = record.parties[claim.subject]
    if claim.relation is Relation.IS_REFUSED:
        return _judge_refusal(claim.subject, subject)
    for name in filter(None, (claim.subject, claim.talker)):
        if problem := _why_not_running(name, record.parties[name]):
            return problem
    if claim.relation is Relation.STARTS:
        return _Finding(RowStatus.STARTED, f"{claim.subject} started")
    if record.window is None:
        return _Finding(RowStatus.UNDECIDED, "not all processes were ready in time")
    if claim.relation is Relation.READABLE:
        return _judge_wire(claim, record, subject)
    talker = record.parties[claim.talker]
    if claim.relation is Relation.HEARS_AGAIN:
        return _judge_replay(claim, record, subject, talker)
    if claim.relation is Relation.BELIEVES:
        return _judge_forgery(claim, record, subject, talker)
    if claim.relation is Relation.IS_ANSWERED:
        return _judge_answers(claim, record, subject, talker)
    sent = {e.text for e in talker.events if e.kind is EventKind.SENT and _in_window(e, record)}
    if not sent:
        return _Finding(RowStatus.UNDECIDED, f"{claim.talker} sent nothing in the window")
    if claim.relation is Relation.SEES:
        return _judge_view(claim, record, subject, talker)
    mark = f"{talker.text}: "
    heard = [e for e in subject.events if e.kind is EventKind.HEARD and e.text.startswith(mark)]
    status = STATUS_OF[Relation.HEARS, bool(heard)]
    seconds = record.window[1] - record.window[0]
    arrived = len(sent & {event.text for event in heard})
    heard_of = f"{arrived} of {len(sent)} messages of the {claim.talker}"
    return _Finding(status, f"{claim.subject} heard {heard_of} in {seconds:.1f} s")


def _judge_answers(
    claim: Claim, record: RowRecord, client: PartyRecord, server: PartyRecord
) -> _Finding:
    asked = [e for e in client.events if e.kind is EventKind.SENT and _in_window(e, record)]
    if not asked:
        return _Finding(RowStatus.UNDECIDED, f"{claim.subject} sent no request in the window")
    answers = [e for e in client.events if e.kind is EventKind.HEARD and _is_of(e, server)]
    status = STATUS_OF[Relation.IS_ANSWERED, bool(answers)]
    within = sum(1 for event in answers if _in_window(event, record))
    counted = f"{min(within, len(asked))} right answers from the {claim.talker}"
    return _Finding(status, f"{claim.subject} asked {len(asked)} times and got {counted}")


def _judge_replay(
    claim: Claim, record: RowRecord, listener: PartyRecord, talker: PartyRecord
) -> _Finding:
    injected = record.injected
    if injected is None or not injected.packets:
        return _Finding(RowStatus.UNDECIDED, "no packets of the talker were captured to send again")
    heard = [e for e in listener.events if e.kind is EventKind.HEARD and _is_of(e, talker)]
    again = sum(1 for event in heard if event.time >= injected.time)
    status = STATUS_OF[Relation.HEARS_AGAIN, again > 0]
    return _Finding(
        status,
        f"{claim.subject} heard {again} messages in {injected.packets} packets of the"
        f" {claim.talker} that were sent again, twice, after it had left",
    )


def _judge_forgery(
    claim: Claim, record: RowRecord, listener: PartyRecord, talker: PartyRecord
) -> _Finding:
    injected = record.injected
    if injected is None or not injected.packets:
        return _Finding(RowStatus.UNDECIDED, "no packet of the talker could be read and changed")
    mark = forged_text(talker.text)
    believed = sum(
        1 for e in listener.events if e.kind is EventKind.HEARD and e.text.startswith(mark)
    )
    return _Finding(
        STATUS_OF[Relation.BELIEVES, believed > 0],
        f"{claim.subject} heard {believed} of {injected.packets} messages that the {claim.talker}"
        " never sent",
    )


def _is_of(event: Event, speaker: PartyRecord) -> bool:
    return event.text.startswith(f"{speaker.text}: ")


def _judge_refusal(name: str, record: PartyRecord) -> _Finding:
    problem = _why_not_running(name, record)
    if problem is None:
        return _Finding(RowStatus.STARTED, f"{name} was not refused")
    return problem


def _judge_view(
    claim: Claim, record: RowRecord, observer: PartyRecord, talker: PartyRecord
) -> _Finding:
    looks = [e for e in observer.events if e.kind is EventKind.SEEN and _in_window(e, record)]
    if not looks:
        return _Finding(RowStatus.UNDECIDED, f"{claim.subject} counted nothing in the window")
    most = max(event.publishers.get(talker.topic, 0) for event in looks)
    counted = f"{observer.through} counts {most} publishers on {talker.topic}"
    return _Finding(STATUS_OF[Relation.SEES, most > 0], f"{counted} in {len(looks)} polls")


def _judge_wire(claim: Claim, record: RowRecord, talker: PartyRecord) -> _Finding:
    count = record.wire.get(claim.subject)
    if count is None:
        return _Finding(RowStatus.UNDECIDED, "no packets were captured")
    if claim.wire is not Wire.TEXT:
        shown = count.topics if claim.wire is Wire.TOPIC else count.certificates
        if not shown and not count.protected:
            return _Finding(RowStatus.UNDECIDED, "no packets of the row were captured")
        what = f"the {claim.wire}" if claim.wire is Wire.TOPIC else f"a {claim.wire}"
        return _Finding(STATUS_OF[Relation.READABLE, shown > 0], f"{shown} packets show {what}")
    if count.plain:
        return _Finding(RowStatus.READABLE, f"{count.plain} packets show the text")
    sent = sum(
        1 for event in talker.events if event.kind is EventKind.SENT and _in_window(event, record)
    )
    # Missing text proves something only if the messages were in the captured packets.
    if count.protected * 2 < max(2, sent):
        return _Finding(
            RowStatus.UNDECIDED,
            f"only {count.protected} encrypted packets were captured for {sent} messages",
        )
    return _Finding(
        RowStatus.NOT_READABLE, f"0 packets show the text, {count.protected} are encrypted"
    )


def _why_not_running(name: str, record: PartyRecord) -> _Finding | None:
    """Return why a party did not run until the end of the row, or None if it did."""
    ready = any(event.kind is EventKind.READY for event in record.events)
    for event in record.events:
        if event.kind is EventKind.REFUSED:
            return _refused(name, event.stage, _own_denial(record, "") or event.text)
        if event.kind is EventKind.FAILED:
            return _failure(name, record, event)
    if record.status is not None:
        return _Finding(RowStatus.CRASHED, f"{name} {_end_of(record)}")
    if not ready:
        return _Finding(RowStatus.NOT_STARTED, f"{name} was not ready in time")
    return None


def _failure(name: str, record: PartyRecord, event: Event) -> _Finding:
    reported = f"{event.text}\n{record.output}"
    reason = " ".join(event.text.split())
    if lacking := missing_security(reported):
        return _Finding(RowStatus.NOT_STARTED, f"{name}: {lacking}")
    if event.stage is ProcessStage.ENDPOINT and (refusal := _own_denial(record, event.text)):
        return _refused(name, ProcessStage.ENDPOINT, refusal)
    if event.stage in (ProcessStage.PARTICIPANT, ProcessStage.ENDPOINT):
        # A ROS node has standard topics and services: if one is denied, it does not start.
        refusal = participant_refusal(reported) or endpoint_refusal(reported)
        if refusal:
            return _refused(name, ProcessStage.PARTICIPANT, refusal)
    return _Finding(RowStatus.CRASHED, f"{name} failed: {reason}")


def _own_denial(record: PartyRecord, reported: str) -> str:
    """Return the message in which DDS Security denies the party's own topic, or ""."""
    lines = f"{record.output}\n{reported}".splitlines()
    return endpoint_refusal("\n".join(line for line in lines if _is_about(line, record.topic)))


def _is_about(line: str, topic: str) -> bool:
    """Return whether a log line names that topic, or a service or action of that name."""
    name = rf"r[tqr]{re.escape(topic)}(?:/_action/\w+)?(?:Request|Reply)?(?!\w|/)"
    return bool(re.search(name, line)) or "not allowed by security" in line.lower()


def _refused(name: str, stage: ProcessStage | None, reason: str) -> _Finding:
    reason = plain_refusal(reason)
    if stage is ProcessStage.ENDPOINT:
        return _Finding(RowStatus.REFUSED, f"{name}: {reason}")
    return _Finding(RowStatus.NOT_LET_IN, f"{name} was refused before it used the topic: {reason}")


def _end_of(record: PartyRecord) -> str:
    status = record.status or 0
    if status < 0:
        try:
            return f"was ended by {signal.Signals(-status).name}"
        except ValueError:
            return f"was ended by signal {-status}"
    last = " ".join(record.output.strip().splitlines()[-1:])
    return f"ended by itself with status {status}. {last}".strip()


def _in_window(event: Event, record: RowRecord) -> bool:
    if record.window is None:
        return False
    start, end = record.window
    return start <= event.time <= end
