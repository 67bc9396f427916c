"""From what the processes of a row reported to what was observed: a crash is not a refusal.

Silence counts only where both sides were ready, the talker really sent, and the controls held;
a refusal only where DDS Security said so itself, about this topic.
"""

from __future__ import annotations

import re
import signal

from sros_tool.demo.model import STATUS_OF, Claim, Party, Relation, Role, Status, Wire
from sros_tool.demo.records import Finding, PartyRecord, RowRecord, RowResult, forged_text
from sros_tool.runtime.events import Event, Kind, Stage
from sros_tool.runtime.vendor_log import (
    endpoint_refusal,
    missing_security,
    participant_refusal,
    plain_refusal,
)


def judge_row(record: RowRecord) -> RowResult:
    """What was observed in a row."""
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
    )


def _observe(record: RowRecord) -> Finding:
    if record.skipped:
        return Finding(Status.SKIPPED, record.skipped)
    for party in record.row.parties:
        lost = _lost_import(party, record.parties[party.name])
        if lost:
            return Finding(Status.SKIPPED, lost)
    claims = [(claim, _judge_claim(claim, record)) for claim in record.row.claims]
    controls = [(claim, _judge_claim(claim, record)) for claim in record.row.controls]
    wrong = [finding for claim, finding in claims if finding.status is not claim.expected]
    if wrong:
        definite = wrong[0].status in STATUS_OF.values()
        several = len(claims) > 1
        status = Status.DISTURBED if several and definite else wrong[0].status
        return Finding(status, wrong[0].detail)
    for claim, finding in controls:
        if finding.status is not claim.expected:
            what = f"{claim.subject} {claim.relation} {claim.talker}".strip()
            return Finding(
                Status.UNDECIDED,
                f"the control failed ({what}: {finding.status}, {finding.detail})",
            )
    details = [finding.detail for _, finding in claims]
    details += [f"control: {finding.detail}" for _, finding in controls]
    return Finding(record.row.expected, "; ".join(details))


def _lost_import(party: Party, record: PartyRecord) -> str:
    """Why a node could not be loaded that needs what is not everywhere: rclpy, or an interface."""
    if party.role in (Role.TALKER, Role.LISTENER):
        return ""
    failed = (e.text for e in record.events if e.kind is Kind.FAILED and e.stage is Stage.IMPORT)
    what = "rclpy" if party.role is Role.OBSERVER else f"the {party.role}"
    return next((f"{what} cannot be loaded here: {text}" for text in failed), "")


def _judge_claim(claim: Claim, record: RowRecord) -> Finding:
    subject = record.parties[claim.subject]
    if claim.relation is Relation.IS_REFUSED:
        return _judge_refusal(claim.subject, subject)
    for name in filter(None, (claim.subject, claim.talker)):
        if problem := _trouble(name, record.parties[name]):
            return problem
    if claim.relation is Relation.STARTS:
        return Finding(Status.STARTED, f"{claim.subject} started")
    if record.window is None:
        return Finding(Status.UNDECIDED, "not all processes were ready in time")
    if claim.relation is Relation.READABLE:
        return _judge_wire(claim, record, subject)
    talker = record.parties[claim.talker]
    if claim.relation is Relation.HEARS_AGAIN:
        return _judge_replay(claim, record, subject, talker)
    if claim.relation is Relation.BELIEVES:
        return _judge_forgery(claim, record, subject, talker)
    if claim.relation is Relation.IS_ANSWERED:
        return _judge_answers(claim, record, subject, talker)
    sent = {e.text for e in talker.events if e.kind is Kind.SENT and _inside(e, record)}
    if not sent:
        return Finding(Status.UNDECIDED, f"{claim.talker} sent nothing in that time")
    if claim.relation is Relation.SEES:
        return _judge_view(claim, record, subject, talker)
    mark = f"{talker.text}: "
    heard = [e for e in subject.events if e.kind is Kind.HEARD and e.text.startswith(mark)]
    status = STATUS_OF[Relation.HEARS, bool(heard)]
    seconds = record.window[1] - record.window[0]
    arrived = len(sent & {event.text for event in heard})
    heard_of = f"{arrived} of {len(sent)} messages of the {claim.talker}"
    return Finding(status, f"{claim.subject} heard {heard_of} in {seconds:.1f} s")


def _judge_answers(
    claim: Claim, record: RowRecord, client: PartyRecord, server: PartyRecord
) -> Finding:
    asked = [e for e in client.events if e.kind is Kind.SENT and _inside(e, record)]
    if not asked:
        return Finding(Status.UNDECIDED, f"{claim.subject} asked nothing in that time")
    answers = [e for e in client.events if e.kind is Kind.HEARD and _is_of(e, server)]
    status = STATUS_OF[Relation.IS_ANSWERED, bool(answers)]
    within = sum(1 for event in answers if _inside(event, record))
    counted = f"{min(within, len(asked))} right answers of the {claim.talker}"
    return Finding(status, f"{claim.subject} asked {len(asked)} times and got {counted}")


def _judge_replay(
    claim: Claim, record: RowRecord, listener: PartyRecord, talker: PartyRecord
) -> Finding:
    replay = record.replay
    if replay is None or not replay.packets:
        return Finding(Status.UNDECIDED, "no packets were captured that could be sent again")
    heard = [e for e in listener.events if e.kind is Kind.HEARD and _is_of(e, talker)]
    again = sum(1 for event in heard if event.time >= replay.time)
    status = STATUS_OF[Relation.HEARS_AGAIN, again > 0]
    return Finding(
        status,
        f"{claim.subject} heard {again} messages in {replay.packets} packets of the"
        f" {claim.talker} that were sent again, twice, after it had left",
    )


def _judge_forgery(
    claim: Claim, record: RowRecord, listener: PartyRecord, talker: PartyRecord
) -> Finding:
    replay = record.replay
    if replay is None or not replay.packets:
        return Finding(Status.UNDECIDED, "no packet of the talker could be read and changed")
    mark = forged_text(talker.text)
    believed = sum(1 for e in listener.events if e.kind is Kind.HEARD and e.text.startswith(mark))
    return Finding(
        STATUS_OF[Relation.BELIEVES, believed > 0],
        f"{claim.subject} heard {believed} of {replay.packets} messages that the {claim.talker}"
        " never sent",
    )


def _is_of(event: Event, speaker: PartyRecord) -> bool:
    return event.text.startswith(f"{speaker.text}: ")


def _judge_refusal(name: str, record: PartyRecord) -> Finding:
    problem = _trouble(name, record)
    if problem is None:
        return Finding(Status.STARTED, f"{name} was let in")
    return problem


def _judge_view(
    claim: Claim, record: RowRecord, observer: PartyRecord, talker: PartyRecord
) -> Finding:
    looks = [e for e in observer.events if e.kind is Kind.SEEN and _inside(e, record)]
    if not looks:
        return Finding(Status.UNDECIDED, f"{claim.subject} did not look in that time")
    most = max(event.publishers.get(talker.topic, 0) for event in looks)
    counted = f"{observer.through} counts {most} publishers on {talker.topic}"
    return Finding(STATUS_OF[Relation.SEES, most > 0], f"{counted} in {len(looks)} looks")


def _judge_wire(claim: Claim, record: RowRecord, talker: PartyRecord) -> Finding:
    count = record.wire.get(claim.subject)
    if count is None:
        return Finding(Status.UNDECIDED, "no packets were captured")
    if claim.wire is not Wire.TEXT:
        shown = count.topics if claim.wire is Wire.TOPIC else count.certificates
        if not shown and not count.protected:
            return Finding(Status.UNDECIDED, "no packets of the row were captured")
        what = f"the {claim.wire}" if claim.wire is Wire.TOPIC else f"a {claim.wire}"
        return Finding(STATUS_OF[Relation.READABLE, shown > 0], f"{shown} packets show {what}")
    if count.plain:
        return Finding(Status.READABLE, f"{count.plain} packets show the text")
    sent = sum(1 for event in talker.events if event.kind is Kind.SENT and _inside(event, record))
    # Silence on the wire proves nothing unless the messages went over the captured wire.
    if count.protected * 2 < max(2, sent):
        return Finding(
            Status.UNDECIDED,
            f"only {count.protected} encrypted packets were captured for {sent} messages",
        )
    return Finding(Status.NOT_READABLE, f"0 packets show the text, {count.protected} are encrypted")


def _trouble(name: str, record: PartyRecord) -> Finding | None:
    """Why a party did not run through the row, or None if it did."""
    ready = any(event.kind is Kind.READY for event in record.events)
    for event in record.events:
        if event.kind is Kind.REFUSED:
            return _refused(name, event.stage, _own_denial(record, "") or event.text)
        if event.kind is Kind.FAILED:
            return _failure(name, record, event)
    if record.status is not None:
        return Finding(Status.CRASHED, f"{name} {_ending(record)}")
    if not ready:
        return Finding(Status.NOT_STARTED, f"{name} was not ready in time")
    return None


def _failure(name: str, record: PartyRecord, event: Event) -> Finding:
    told = f"{event.text}\n{record.output}"
    reason = " ".join(event.text.split())
    if lacking := missing_security(told):
        return Finding(Status.NOT_STARTED, f"{name}: {lacking}")
    if event.stage is Stage.ENDPOINT and (refusal := _own_denial(record, event.text)):
        return _refused(name, Stage.ENDPOINT, refusal)
    if event.stage in (Stage.PARTICIPANT, Stage.ENDPOINT):
        # A ROS node has topics and services of its own: denied one of them, it does not start.
        refusal = participant_refusal(told) or endpoint_refusal(told)
        if refusal:
            return _refused(name, Stage.PARTICIPANT, refusal)
    return Finding(Status.CRASHED, f"{name} failed: {reason}")


def _own_denial(record: PartyRecord, told: str) -> str:
    """The line in which DDS Security denies this very topic, or ""."""
    lines = f"{record.output}\n{told}".splitlines()
    return endpoint_refusal("\n".join(line for line in lines if _speaks_of(line, record.topic)))


def _speaks_of(line: str, topic: str) -> bool:
    """Whether a line is about that topic, or a service or action of that name."""
    name = rf"r[tqr]{re.escape(topic)}(?:/_action/\w+)?(?:Request|Reply)?(?!\w|/)"
    return bool(re.search(name, line)) or "not allowed by security" in line.lower()


def _refused(name: str, stage: Stage | None, reason: str) -> Finding:
    reason = plain_refusal(reason)
    if stage is Stage.ENDPOINT:
        return Finding(Status.REFUSED, f"{name}: {reason}")
    return Finding(Status.NOT_LET_IN, f"{name} was refused before it came to the topic: {reason}")


def _ending(record: PartyRecord) -> str:
    status = record.status or 0
    if status < 0:
        try:
            return f"was ended by {signal.Signals(-status).name}"
        except ValueError:
            return f"was ended by signal {-status}"
    last = " ".join(record.output.strip().splitlines()[-1:])
    return f"ended by itself with status {status}. {last}".strip()


def _inside(event: Event, record: RowRecord) -> bool:
    if record.window is None:
        return False
    start, end = record.window
    return start <= event.time <= end
