"""The result of a demo: the outcome of every row, as a table, Markdown and JSON.

A row is judged from the reports of its processes.  A crash is not a refusal.  Silence counts only
if both sides were ready, the talker sent messages, and the controls held; a refusal counts only if
DDS Security reported it, for this topic.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import datetime
from itertools import chain
from typing import Annotated, NamedTuple

from sros_tool.dds.advisories import Advisory, known_vulnerabilities
from sros_tool.demo.backend import CYCLONE, RCLPY, ZENOH
from sros_tool.demo.casting import CastMember
from sros_tool.demo.scenarios.model import (
    OUTCOMES,
    SUCCESSES,
    Claim,
    Party,
    Relation,
    Role,
    Row,
    RowStatus,
    Wire,
)
from sros_tool.demo.wire import Injection, WireCount
from sros_tool.errors import NOT_DONE
from sros_tool.runtime.events import Event, EventKind, ProcessStage, signal_name
from sros_tool.runtime.processes import MappedLibrary
from sros_tool.runtime.vendor_log import (
    endpoint_refusal,
    missing_security,
    participant_refusal,
    plain_refusal,
)
from sros_tool.validity import iso
from sros_tool.values import Words, shows
from sros_tool.wording import counted, first_few


@dataclass(frozen=True)
class PartyRecord:
    """The record of a process that has ended.

    ``text`` marks the messages of a talker; ``topic`` is the ROS topic of the process; ``library``
    names the library that the node in the process uses; ``output`` is what the process printed;
    ``status`` is its exit status (negative for a signal) if the process ended by itself.
    """

    text: str = ""
    topic: str = ""
    library: str = ""
    events: tuple[Event, ...] = ()
    output: str = ""
    status: int | None = None


@dataclass(frozen=True)
class RowRecord:
    """The record of a row that has ended.

    ``window`` is the start and end of the observation (seconds of CLOCK_MONOTONIC), or None if a
    party was not ready in time.  ``wire`` maps parties to counts of captured packets.  ``injected``
    counts packets that were sent again or changed;
    ``skipped`` is the reason why the row was not run, or "".  ``expiry`` is the time at which the
    certificate of a short-lived talker expires (CLOCK_MONOTONIC, s); ``memory`` maps each party to
    the number of shared memory segments that contain its text.  If ``applies`` is False, the
    keystore has no enclave for a part of the row.  ``libraries`` are the DDS libraries that the
    parties had mapped at the end.
    """

    row: Row
    domain: int
    parties: Mapping[str, PartyRecord] = field(default_factory=dict)
    window: tuple[float, float] | None = None
    wire: Mapping[str, WireCount] = field(default_factory=dict)
    injected: Injection | None = None
    expiry: float | None = None
    memory: Mapping[str, int] = field(default_factory=dict)
    skipped: str = ""
    applies: bool = True
    libraries: frozenset[MappedLibrary] = frozenset()

    @property
    def seconds(self) -> float:
        """Length of the observation in seconds."""
        return self.window[1] - self.window[0] if self.window else 0.0


@shows(
    *("name", "expected", "observed", "as_expected", "mechanism", "detail", "domain", "seconds"),
    *("attack", "defence_removed", "open_because", "remedy", "accepted", "open_here", "applies"),
    "scenario",
)
@dataclass(frozen=True)
class RowResult:
    """The result of one row."""

    name: str
    """Name of the row: the attack or the action that it tries."""
    expected: RowStatus
    """The expected outcome."""
    observed: RowStatus
    """The observed outcome."""
    mechanism: str
    """Reason for the expected outcome."""
    detail: str
    """Observation, with counts of messages."""
    domain: int
    """ROS domain of the row."""
    seconds: float = 0.0
    """Length of the observation in seconds."""
    attack: str = ""
    """Name of the attack, or an empty string for ordinary communication."""
    defence_removed: str = ""
    """Defense that the row removes, or an empty string."""
    open_because: str = ""
    """Why the attack is known to succeed, or an empty string."""
    remedy: str = ""
    """Defense against the attack, or an empty string."""
    accepted: bool = False
    """Whether `--accept-open` names the row."""
    unaccepted: bool = False
    """Whether the user's keystore allows the attack, and `--accept-open` does not name the row."""
    applies: bool = True
    """Whether the keystore has an enclave for each part; if not, the row was skipped."""
    scenario: str = ""
    """Name of the scenario."""
    libraries: frozenset[MappedLibrary] = frozenset()
    """DDS libraries that the processes of the row had mapped."""

    @property
    def as_expected(self) -> bool:
        """Whether the observed outcome is the expected one, or the row was skipped or accepted."""
        expected = self.observed in (self.expected, RowStatus.SKIPPED) and not self.open_here
        return expected or self.known_open

    @property
    def known_open(self) -> bool:
        """Whether the row shows an attack that is known to succeed, or that the user accepted."""
        if self.accepted and self.observed in SUCCESSES:
            return True
        return bool(self.open_because) and self.observed is self.expected and not self.open_here

    @property
    def open_here(self) -> bool:
        """Whether the attack succeeds because of the user's keystore, and is not accepted."""
        return self.unaccepted and self.observed is self.expected

    @property
    def untried(self) -> bool:
        """Whether an attack that has to fail was not tried, so that it may succeed.

        False for rows that prove nothing about a keystore: rows without a defense, and rows of an
        attack that is known to succeed or that the user accepted. Also false for rows that do not
        apply to the keystore.
        """
        if self.observed is not RowStatus.SKIPPED or not self.applies or self.defence_removed:
            return False
        return not self.accepted and (self.unaccepted or not self.open_because)


class _ClaimFinding(NamedTuple):
    """The observed outcome for a claim, with the evidence."""

    status: RowStatus
    detail: str


def _undecided_finding(why: str) -> _ClaimFinding:
    return _ClaimFinding(RowStatus.UNDECIDED, why)


def judge_row(record: RowRecord) -> RowResult:
    """Judge a row by the record of its processes, and return its result."""
    finding = _observe_row(record)
    row = record.row
    return RowResult(
        name=row.name,
        expected=row.expected,
        observed=finding.status,
        mechanism=row.mechanism,
        detail=finding.detail,
        domain=record.domain,
        seconds=round(record.seconds, 1),
        attack=row.attack,
        defence_removed=row.defence_removed,
        open_because=row.open_because,
        remedy=row.remedy,
        accepted=row.accepted,
        unaccepted=row.unaccepted,
        applies=record.applies,
        libraries=record.libraries,
    )


def _observe_row(record: RowRecord) -> _ClaimFinding:
    if record.skipped:
        return _ClaimFinding(RowStatus.SKIPPED, record.skipped)
    for party in record.row.parties:
        lost = _why_import_failed(party, record.parties[party.name])
        if lost:
            return _ClaimFinding(RowStatus.SKIPPED, lost)
    claims = [(claim, _judge_claim(claim, record)) for claim in record.row.claims]
    controls = [(claim, _judge_claim(claim, record)) for claim in record.row.controls]
    wrong = [finding for claim, finding in claims if finding.status is not claim.expected]
    if wrong:
        definite = wrong[0].status in chain(*OUTCOMES.values())
        several = len(claims) > 1
        status = RowStatus.DISTURBED if several and definite else wrong[0].status
        return _ClaimFinding(status, wrong[0].detail)
    for claim, finding in controls:
        if finding.status is not claim.expected:
            claim_text = f"{claim.subject} {claim.relation} {claim.talker}".strip()
            return _undecided_finding(
                f"the control failed ({claim_text}: {finding.status}, {finding.detail})"
            )
    details = [finding.detail for _, finding in claims]
    details += [f"control: {finding.detail}" for _, finding in controls]
    return _ClaimFinding(record.row.expected, "; ".join(details))


def _why_import_failed(party: Party, record: PartyRecord) -> str:
    """Return why a node could not import rclpy or a ROS interface, or ""."""
    if party.role in (Role.TALKER, Role.LISTENER):
        return ""
    failed = (
        e.text
        for e in record.events
        if e.kind is EventKind.FAILED and e.stage is ProcessStage.IMPORT
    )
    module = "rclpy" if party.role is Role.OBSERVER else f"the {party.role}"
    return next((f"{module} cannot be loaded here: {text}" for text in failed), "")


class _ClaimRecords:
    """A claim, with the records of its row and of its two parties."""

    def __init__(self, claim: Claim, record: RowRecord) -> None:
        self.claim, self.record = claim, record
        self.subject = record.parties[claim.subject]
        self.talker = record.parties.get(claim.talker, self.subject)

    def result(self, holds: bool, detail: str) -> _ClaimFinding:
        """Return the finding of a claim whose relation ``holds`` or does not hold."""
        return _ClaimFinding(OUTCOMES[self.claim.relation][holds], detail)

    def messages_sent(self, party: PartyRecord) -> list[Event]:
        """Return the messages that a party sent during the observation."""
        return [
            e for e in party.events if e.kind is EventKind.SENT and _is_in_window(e, self.record)
        ]

    def messages_heard(self) -> list[Event]:
        """Return the talker's messages that the subject heard, at any time."""
        return _messages_heard(self.talker, self.subject)


def _judge_claim(claim: Claim, record: RowRecord) -> _ClaimFinding:
    for name in filter(None, (claim.subject, claim.talker)):
        if problem := _why_not_running(name, record.parties[name]):
            unexpected = problem.status is RowStatus.REFUSED is not claim.expected
            if unexpected and _is_of_user(name, record.row):
                expected = f'{{ party = "{name}", expected = "refused" }}'
                hint = f"if you expect this, write the claim {expected}"
                return problem._replace(detail=f"{problem.detail}; {hint}")
            return _with_evidence(problem, claim, record)
    if claim.relation is Relation.IS_REFUSED:
        return _ClaimFinding(RowStatus.STARTED, f"{claim.subject} was not refused")
    if claim.relation is Relation.STARTS:
        return _ClaimFinding(RowStatus.STARTED, f"{claim.subject} started")
    if record.window is None:
        return _undecided_finding("not all processes were ready in time")
    return _JUDGES[claim.relation](_ClaimRecords(claim, record))


def _is_of_user(party: str, row: Row) -> bool:
    """Return whether a party is of a user's scenario, which names enclaves by their paths."""
    return any(e.name == party and e.identity.enclave.startswith("/") for e in row.parties)


def _judge_hearing(case: _ClaimRecords) -> _ClaimFinding:
    claim, record = case.claim, case.record
    sent = {event.text for event in case.messages_sent(case.talker)}
    if not sent:
        return _undecided_finding(f"{claim.talker} sent nothing during the observation")
    heard = case.messages_heard()
    if record.row.meanwhile is not None:  # messages before the change prove nothing
        heard = [event for event in heard if _is_in_window(event, record)]
    arrived = len(sent & {event.text for event in heard})
    heard_of = f"{arrived} of {counted(len(sent), 'message')} of the {claim.talker}"
    return case.result(bool(heard), f"{claim.subject} heard {heard_of} in {record.seconds:.1f} s")


def _judge_answers(case: _ClaimRecords) -> _ClaimFinding:
    claim, asked = case.claim, case.messages_sent(case.subject)
    if not asked:
        return _undecided_finding(f"{claim.subject} sent no request during the observation")
    answers = case.messages_heard()
    within = sum(_is_in_window(event, case.record) for event in answers)
    right = f"{counted(min(within, len(asked)), 'right answer')} from the {claim.talker}"
    times = counted(len(asked), "time")
    return case.result(bool(answers), f"{claim.subject} asked {times} and got {right}")


def _judge_execution(case: _ClaimRecords) -> _ClaimFinding:
    """Judge a call by the requests that the server executed, because a reply may be lost."""
    claim, asked = case.claim, case.messages_sent(case.talker)
    if not asked:
        return _undecided_finding(f"{claim.talker} sent no request during the observation")
    reached = case.messages_heard()
    number = (
        f"{min(len(reached), len(asked))} of {counted(len(asked), 'request')} of the {claim.talker}"
    )
    return case.result(bool(reached), f"{claim.subject} executed {number}")


_SECONDS_IN_TRANSIT = 1.0
"""Seconds after expiry in which messages may still arrive: certificates have whole seconds."""


def _judge_expiry(case: _ClaimRecords) -> _ClaimFinding:
    claim, expiry, heard = case.claim, case.record.expiry, case.messages_heard()
    if expiry is None or not any(event.time < expiry for event in heard):
        return _undecided_finding(f"{claim.talker} was not heard before its certificate expired")
    after = expiry + _SECONDS_IN_TRANSIT
    sent = [e for e in case.talker.events if e.kind is EventKind.SENT and e.time > after]
    if not sent:
        return _undecided_finding(f"{claim.talker} sent nothing after its certificate had expired")
    late = [event for event in heard if event.time > after]
    early = counted(len(heard) - len(late), "message")
    before = f"{early} of the {claim.talker} until the {claim.talker}'s certificate"
    return case.result(
        bool(late),
        f"{claim.subject} heard {before} expired, and {len(late)} of {len(sent)} after that",
    )


def _with_evidence(finding: _ClaimFinding, claim: Claim, record: RowRecord) -> _ClaimFinding:
    """Return a refusal with the log line that proves it, if the claim names a log text.

    Without such a line, a refusal is not proved: a process without a connection may only be slow.
    """
    if not claim.evidence or finding.status is not RowStatus.NOT_LET_IN:
        return finding
    if claim.evidence in finding.detail:
        return finding
    outputs = [(party.name, record.parties[party.name].output) for party in record.row.parties]
    lines = ((name, line) for name, output in outputs for line in output.splitlines())
    logged = next(((name, line) for name, line in lines if claim.evidence in line), None)
    if logged is None:
        return _undecided_finding(f"{finding.detail}, but no process logged {claim.evidence!r}")
    name, line = logged
    return _ClaimFinding(finding.status, f"{finding.detail}; {name}: {_message_of(line)}")


def _message_of(line: str) -> str:
    """Return the message in a line of Zenoh's log, without time, level, module and hint."""
    message = line.partition(": ")[2].partition(" Hint: ")[0]
    return " ".join(message.split()).rstrip(".") or line.strip()


def _judge_replay(case: _ClaimRecords) -> _ClaimFinding:
    claim, injected = case.claim, case.record.injected
    if injected is None or not injected.packets:
        return _undecided_finding("no packets of the talker were captured to send again")
    repeated = sum(event.time >= injected.time for event in case.messages_heard())
    return case.result(
        repeated > 0,
        f"{claim.subject} heard {counted(repeated, 'message')} from "
        f"{counted(injected.packets, 'packet')} of the {claim.talker}, sent again (twice) after "
        f"the {claim.talker} had left",
    )


def _judge_forgery(case: _ClaimRecords) -> _ClaimFinding:
    claim, talker, injected = case.claim, case.talker, case.record.injected
    if injected is None or not injected.packets:
        return _undecided_finding("no packet of the talker could be changed")
    sent = {event.text for event in talker.events if event.kind is EventKind.SENT}
    sent.add(f"{talker.text}: {len(sent) + 1}")  # perhaps sent, but suspended before its report
    believed = sum(
        event.kind is EventKind.HEARD and event.time >= injected.time and event.text not in sent
        for event in case.subject.events
    )
    return case.result(
        believed > 0,
        f"{claim.subject} heard {counted(believed, 'message')} that the {claim.talker} never sent,"
        f" in {counted(injected.packets, 'changed packet')}",
    )


def _messages_heard(speaker: PartyRecord, listener: PartyRecord) -> list[Event]:
    mark = f"{speaker.text}: "
    return [e for e in listener.events if e.kind is EventKind.HEARD and e.text.startswith(mark)]


def _judge_view(case: _ClaimRecords) -> _ClaimFinding:
    claim, observer, topic = case.claim, case.subject, case.talker.topic
    serves = case.record.row.party(claim.talker).role is Role.SERVER
    # A server only has to exist; no client has to call it.
    if not serves and not case.messages_sent(case.talker):
        return _undecided_finding(f"{claim.talker} sent nothing during the observation")
    looks = [
        e for e in observer.events if e.kind is EventKind.SEEN and _is_in_window(e, case.record)
    ]
    if not looks:
        return _undecided_finding(f"{claim.subject} made no poll during the observation")
    most = max(event.publishers.get(topic, 0) for event in looks)
    seen = f"{counted(most, 'server' if serves else 'publisher')} on {topic}"
    return case.result(
        most > 0, f"{observer.library} counts {seen} in {counted(len(looks), 'poll')}"
    )


def _judge_loss(case: _ClaimRecords) -> _ClaimFinding:
    claim, topic = case.claim, case.talker.topic
    if not any(event.kind is EventKind.SENT for event in case.talker.events):
        return _undecided_finding(f"{claim.talker} found no node to remove")
    looks = [event for event in case.subject.events if event.kind is EventKind.SEEN]
    most = max((event.publishers.get(topic, 0) for event in looks), default=0)
    if not most:
        return _undecided_finding(f"{claim.subject} never saw a publisher on {topic}")
    # Only inside the window, because the talker ends after it.
    inside = [event for event in looks if _is_in_window(event, case.record)]
    if not inside:
        return _undecided_finding(f"{claim.subject} made no poll during the observation")
    left = inside[-1].publishers.get(topic, 0)
    detail = (
        f"{case.subject.library} counts {counted(most, 'publisher')} on {topic}, and {left} after "
    )
    return case.result(not left, f"{detail}{claim.talker} tried to remove the node")


def _judge_wire(case: _ClaimRecords) -> _ClaimFinding:
    claim, record = case.claim, case.record
    if claim.wire is Wire.MEMORY:
        segments = record.memory.get(claim.subject, 0)
        return case.result(
            segments > 0, f"the text is in {counted(segments, 'segment')} of shared memory"
        )
    count = record.wire.get(claim.subject)
    if count is None:
        return _undecided_finding("no packets were captured")
    if claim.wire is not Wire.TEXT:
        shown = count.topics if claim.wire is Wire.TOPIC else count.certificates
        if not shown and not count.protected:
            return _undecided_finding("no packets of the row were captured")
        packet_kind = f"the {claim.wire}" if claim.wire is Wire.TOPIC else f"a {claim.wire}"
        return case.result(shown > 0, f"{packet_kind} is in {counted(shown, 'packet')}")
    if count.plain:
        return case.result(True, f"the text is in {counted(count.plain, 'packet')}")
    sent = len(case.messages_sent(case.subject))
    # Missing text proves something only if the messages were in the captured packets.
    if count.protected * 2 < max(2, sent):
        captured = counted(count.protected, "encrypted packet")
        return _undecided_finding(f"only {captured} captured for {counted(sent, 'message')}")
    return case.result(False, f"the text is in 0 packets; encrypted packets: {count.protected}")


_JUDGES: Mapping[Relation, Callable[[_ClaimRecords], _ClaimFinding]] = {
    Relation.HEARS: _judge_hearing,
    Relation.HEARS_AGAIN: _judge_replay,
    Relation.BELIEVES: _judge_forgery,
    Relation.HEARS_EXPIRED: _judge_expiry,
    Relation.IS_ANSWERED: _judge_answers,
    Relation.EXECUTES: _judge_execution,
    Relation.SEES: _judge_view,
    Relation.LOSES: _judge_loss,
    Relation.READABLE: _judge_wire,
}


def _why_not_running(party: str, record: PartyRecord) -> _ClaimFinding | None:
    """Return why a party did not run until the end of the row, or None if it ran."""
    ready = any(event.kind is EventKind.READY for event in record.events)
    for event in record.events:
        if event.kind is EventKind.REFUSED:
            return _refusal_finding(
                party, event.stage, _own_denial_message(record, "") or event.text
            )
        if event.kind is EventKind.FAILED:
            return _failure(party, record, event)
    if record.status is not None:
        return _ClaimFinding(RowStatus.CRASHED, f"{party} {_exit_text(record)}")
    if not ready:
        return _ClaimFinding(RowStatus.NOT_STARTED, f"{party} was not ready in time")
    return None


def _failure(party: str, record: PartyRecord, event: Event) -> _ClaimFinding:
    reported = f"{event.text}\n{record.output}"
    reason = " ".join(event.text.split())
    if lacking := missing_security(reported):
        return _ClaimFinding(RowStatus.NOT_STARTED, f"{party}: {lacking}")
    if event.stage is ProcessStage.ENDPOINT and (
        refusal := _own_denial_message(record, event.text)
    ):
        return _refusal_finding(party, ProcessStage.ENDPOINT, refusal)
    if event.stage in (ProcessStage.PARTICIPANT, ProcessStage.ENDPOINT):
        # A ROS node has standard topics and services: if one is denied, it does not start.
        refusal = participant_refusal(reported) or endpoint_refusal(reported)
        if refusal:
            return _refusal_finding(party, ProcessStage.PARTICIPANT, refusal)
    return _ClaimFinding(RowStatus.CRASHED, f"{party} failed: {reason}")


def _own_denial_message(record: PartyRecord, reported: str) -> str:
    """Return the log message in which DDS Security denies the party's own topic, or ""."""
    lines = f"{record.output}\n{reported}".splitlines()
    return endpoint_refusal("\n".join(line for line in lines if _is_about(line, record.topic)))


def _is_about(line: str, topic: str) -> bool:
    """Return whether a log line is about a topic, or a service or action of the same name."""
    name = rf"r[tqr]{re.escape(topic)}(?:/_action/\w+)?(?:Request|Reply)?(?!\w|/)"
    return bool(re.search(name, line)) or "not allowed by security" in line.lower()


def _refusal_finding(party: str, stage: ProcessStage | None, reason: str) -> _ClaimFinding:
    reason = plain_refusal(reason)
    if stage is ProcessStage.ENDPOINT:
        return _ClaimFinding(RowStatus.REFUSED, f"{party}: {reason}")
    return _ClaimFinding(
        RowStatus.NOT_LET_IN, f"{party} was refused before it used the topic: {reason}"
    )


def _exit_text(record: PartyRecord) -> str:
    status = record.status or 0
    if status < 0:
        return f"was ended by {signal_name(-status)}"
    last = " ".join(record.output.strip().splitlines()[-1:])
    return f"ended by itself with status {status}. {last}".strip()


def _is_in_window(event: Event, record: RowRecord) -> bool:
    if record.window is None:
        return False
    start, end = record.window
    return start <= event.time <= end


class KeystoreSummary(NamedTuple):
    """The number of a user's enclaves, and which of them the demo did not try."""

    enclaves: int
    """Number of enclaves in the keystore."""
    elsewhere: int = 0
    """Number of enclaves whose key is elsewhere; the demo did not try them."""
    not_tried: tuple[str, ...] = ()
    """Tests that did not run, but that a proof of the keystore needs; if there are any, the exit
    status is not 0.
    """


@shows("name", "title", "as_expected", "cast", "keystore", "rows", "cost")
@dataclass(frozen=True)
class ScenarioResult:
    """The result of a scenario."""

    name: str
    """Name of the scenario."""
    title: str
    """Title of the scenario."""
    rows: tuple[RowResult, ...]
    """Results of the scenario's rows."""
    cast: tuple[CastMember, ...] = ()
    """With `--keystore`: the enclaves that played a part."""
    attacked: KeystoreSummary | None = None
    """The user's keystore; its ``not_tried`` lacks the skipped rows for now (see `keystore`)."""

    @property
    def wrong(self) -> tuple[RowResult, ...]:
        """Rows that are not as expected."""
        return tuple(row for row in self.rows if not row.as_expected)

    @property
    def keystore(self) -> KeystoreSummary | None:
        """With `--keystore`: the number of enclaves, and the tests that did not run."""
        return self.attacked and self.attacked._replace(not_tried=self.not_tried)

    @property
    def not_tried(self) -> tuple[str, ...]:
        """Tests that a proof of the user's keystore needs, and that the demo did not run.

        Empty without a user's keystore: the demo's own keystores prove nothing about others.
        """
        if self.attacked is None:
            return ()
        return (*(row.name for row in self.rows if row.untried), *self.attacked.not_tried)

    @property
    def as_expected(self) -> bool:
        """Whether all rows are as expected and, with ``--keystore``, all tests ran that a proof
        needs.
        """
        return not self.wrong and not self.not_tried

    @property
    def cost(self) -> None:
        """Always null: `./dev bench --protection` measures what protection costs."""


@shows(
    *("backend", "dds", "libraries", "vulnerabilities", "why", "template", "topic", "names"),
    *("own_network", "network_reason", "as_expected", "left_out", "scenarios", "rows"),
)
@dataclass(frozen=True)
class DemoResult:
    """The result of a demo."""

    backend: Annotated[str, Words((RCLPY, CYCLONE, ZENOH))]
    """Name of the backend that ran the nodes."""
    dds: str
    """Name and version of the DDS, or of Zenoh."""
    why: str
    """Reason for the choice of this backend."""
    template: str
    """Template of the keystores."""
    topic: str
    """The ROS topic that a part of a scenario uses if it names no other topic."""
    names: tuple[str, ...]
    """The topics, services and actions that the rows use, such as `topic /chatter`."""
    own_network: bool
    """Whether the demo ran in a separate network namespace."""
    network_reason: str
    """Why the demo did not run in a separate network namespace, or an empty string."""
    scenarios: tuple[ScenarioResult, ...]
    """Results of the scenarios."""
    left_out: int = 0
    """Number of rows that `--only` left out."""
    libraries: tuple[UsedLibrary, ...] = ()
    """DDS libraries that the processes had loaded, with their known vulnerabilities.

    An empty list if no library was seen.
    """

    @property
    def vulnerabilities(self) -> str:
        """The known vulnerabilities of the DDS that the demo used, in sentences."""
        return self.known_vulnerabilities(_ALL_IDS)

    def known_vulnerabilities(self, maximum: int) -> str:
        """Return the known vulnerabilities with which the demo ran, at most ``maximum`` by name."""
        if not self.libraries:
            return f"{self.dds} may have vulnerabilities: {_UNKNOWN}."
        return " ".join(library.sentence(maximum) for library in self.libraries)

    @property
    def rows(self) -> tuple[RowResult, ...]:
        """The rows of all scenarios."""
        return tuple(row for scenario in self.scenarios for row in scenario.rows)

    @property
    def as_expected(self) -> bool:
        """Whether the exit status is 0: all rows are as expected and, with ``--keystore``, all
        tests ran that a proof needs.
        """
        return all(scenario.as_expected for scenario in self.scenarios)

    @property
    def exit_status(self) -> int:
        """The exit status: 0 if all rows are as expected, 1 if a row is not, else `NOT_DONE`."""
        if any(scenario.wrong for scenario in self.scenarios):
            return 1
        return 0 if self.as_expected else NOT_DONE


_MOST_IDS, _ALL_IDS = 3, 10_000
_MOST_NAMES = 4
_UNKNOWN = "sros does not know the loaded version, or has no advisory about this library"


class UsedLibrary(NamedTuple):
    """A DDS library that processes of the demo had loaded, and its known vulnerabilities."""

    product: str
    """Name of the DDS."""
    version: str
    """Version of the DDS in three numbers; empty if the name of the library does not show it."""
    packaged: bool
    """Whether the library is from a package of Debian or Ubuntu, which can have fixes of later
    releases.
    """
    vulnerabilities: Sequence[str] | None
    """Ids of the known vulnerabilities of this version; null if the version is not known."""
    unclear: Sequence[str]
    """Ids of vulnerabilities that this version may or may not have."""

    def sentence(self, maximum: int) -> str:
        """Return a sentence on the library's vulnerabilities, with at most ``maximum`` ids."""
        version = self.version or "of unknown version"
        name = f"{self.product} {version}, which the processes loaded,"
        if self.vulnerabilities is None:
            return f"{name} may have vulnerabilities: {_UNKNOWN}."
        other = "other " * bool(self.vulnerabilities)
        others = counted(len(self.unclear), f"{other}vulnerability", f"{other}vulnerabilities")
        unclear = f"; {others} may affect it" if self.unclear else ""
        if not self.vulnerabilities:
            return f"{name} is not known to have a vulnerability{unclear}."
        number = counted(len(self.vulnerabilities), "known vulnerability", "known vulnerabilities")
        ids = first_few(self.vulnerabilities, maximum)
        pronoun = "it" if len(self.vulnerabilities) == 1 else "them"
        unless = f", unless the installed package fixes {pronoun}" if self.packaged else ""
        return f"{name} has {number}{unless}: {ids}{unclear}."


def used_libraries(
    rows: Iterable[RowResult], advisories: Sequence[Advisory] | None = None
) -> tuple[UsedLibrary, ...]:
    """Return the DDS libraries that processes of the rows had loaded, sorted.

    ``advisories`` are the known vulnerabilities; None means the advisories that ship with sros.
    """
    used = set()
    for library in {library for row in rows for library in row.libraries}:
        known = known_vulnerabilities(library.product, library.version, advisories)
        ids = tuple(advisory.id for advisory in known.known) if known else None
        unclear = tuple(advisory.id for advisory in known.unclear) if known else ()
        used.add(UsedLibrary(library.product, library.version, library.is_packaged, ids, unclear))
    return tuple(sorted(used))


class ListedScenario(NamedTuple):
    """A scenario of the demo."""

    name: str
    """Name of the scenario."""
    title: str
    """Title of the scenario."""
    rows: int
    """Number of rows in the scenario."""
    zenoh: bool
    """Whether the scenario runs with `--backend zenoh`; otherwise it runs on a DDS."""


class ScenarioList(NamedTuple):
    """The scenarios of the demo."""

    scenarios: Sequence[ListedScenario]
    """All scenarios, in order."""


# ── as text ──────────────────────────────────────────────────────────────────────────────────────

_INDENT = " " * 6


def demo_table(result: DemoResult) -> str:
    """Return the result as a text table, with a line on the backend above and a summary below."""
    network = (
        "a separate network namespace"
        if result.own_network
        else f"the network of this machine ({result.network_reason})"
    )
    lines = [
        f"{result.dds}, {first_few(result.names, _MOST_NAMES)}, in {network}",
        f"backend {result.backend}: {result.why}",
        result.known_vulnerabilities(_MOST_IDS),
    ]
    for scenario in result.scenarios:
        lines.append("")
        if len(result.scenarios) > 1:
            lines += [f"{scenario.name}: {scenario.title}", ""]
        lines += _cast_lines(scenario.cast)
        lines += _scenario(scenario)
    return "\n".join([*lines, "", _summary(result)])


def _cast_lines(members: Sequence[CastMember]) -> list[str]:
    """Return lines that name the enclave of each part, for a user's keystore."""
    width = max((len(member.part) for member in members), default=0)
    lines = [
        f"{_INDENT}{member.part:<{width}}  {member.enclave}"
        + (f" as node {', '.join(member.nodes)}" if member.nodes else "")
        + (f": {member.why}" if member.why else "")
        for member in members
    ]
    return ["enclave for each part:", *lines, ""] if lines else []


def _scenario(scenario: ScenarioResult) -> list[str]:
    rows = scenario.rows
    widths = [
        max(len(text) for text in column)
        for column in (
            ["what was tried", *(row.name for row in rows)],
            ["expected", *(row.expected for row in rows)],
            ["observed", *(row.observed for row in rows)],
        )
    ]
    lines = [_line("", ("what was tried", "expected", "observed"), widths)] if rows else []
    for row in rows:
        lines += [
            _line(_mark(row), (row.name, row.expected, row.observed), widths),
            f"{_INDENT}{row.detail}",
        ]
        if row.known_open or row.open_here:
            lines.append(f"{_INDENT}{_why_open(row)}")
    return lines


def _why_open(row: RowResult) -> str:
    why = f"{row.open_because}; to do: {row.remedy}" if row.open_because else ""
    return "; ".join(filter(None, (why, "accepted with --accept-open" if row.accepted else "")))


def _line(mark: str, cells: Sequence[str], widths: Sequence[int]) -> str:
    padded = (cell.ljust(width) for cell, width in zip(cells, widths, strict=True))
    return f"{mark:<4}  {'  '.join(padded)}".rstrip()


def _mark(row: RowResult) -> str:
    if row.observed is RowStatus.SKIPPED:
        return "skip"
    if row.open_here:
        return "OPEN"
    if row.known_open:
        return "open"
    return "ok" if row.as_expected else "FAIL"


def _summary(result: DemoResult) -> str:
    """Return the last sentence: the number of rows as expected, and the tests that did not run."""
    rows = result.rows
    opened = sum(1 for row in rows if row.open_here)
    wrong = sum(1 for row in rows if not row.as_expected)
    known = sum(1 for row in rows if row.known_open)
    good = len(rows) - wrong - sum(1 for row in rows if row.observed is RowStatus.SKIPPED)
    parts = [f"{good} of {counted(len(rows), 'row')} as expected"]
    if known:
        parts.append(f"{known} of them known to be open")
    if opened:
        parts.append(f"{opened} open in this keystore (accept each with --accept-open NAME)")
    if wrong > opened:
        parts.append(f"{wrong - opened} not as expected")
    return ", ".join([*parts, *_left_out_clauses(result)]) + "."


def _left_out_clauses(result: DemoResult) -> Iterator[str]:
    """Yield clauses on rows and enclaves that were not tried."""
    skipped = [row for row in result.rows if row.observed is RowStatus.SKIPPED]
    if applicable := sum(1 for row in skipped if row.applies):
        yield f"{applicable} skipped"
    if others := len(skipped) - applicable:
        yield f"{others} not applicable to this keystore"
    if result.left_out:
        yield f"{result.left_out} left out with --only"
    for scenario in result.scenarios:
        if scenario.keystore is None:
            continue
        used = {member.enclave for member in scenario.cast}
        yield f"{len(used)} of {scenario.keystore.enclaves} enclaves took part"
        if scenario.keystore.elsewhere:
            yield f"{scenario.keystore.elsewhere} could not (no key in the keystore)"
        if scenario.not_tried:
            names = "; ".join(scenario.not_tried)
            yield f"the proof is incomplete, because these were not tested: {names}"


def summary_page(result: DemoResult, now: datetime) -> str:
    """Return a summary for reviewers in Markdown; ``now`` is the time of the demo."""
    attacks = [row for row in result.rows if row.attack and not row.defence_removed]
    plain_rows = [row for row in result.rows if not row.attack]
    wrong = [row for row in result.rows if not row.as_expected]
    lines = [
        "# Security demo: expected and observed",
        "",
        f"Run {iso(now)} with `sros demo` on {result.dds}. The expected results are those of"
        f" the keystore template `{result.template}`. **{_verdict(result, wrong)}**",
        "",
        result.vulnerabilities,
        "",
    ]
    for scenario in result.scenarios:
        lines += _summary_cast(scenario.cast)
    if wrong:
        lines += ["## Not as expected", ""]
        lines += [
            f"- **{row.name}**: open in this keystore: {row.open_because}; to do: {row.remedy}."
            if row.open_here
            else f"- **{row.name}**: expected {row.expected}, observed {row.observed}. {row.detail}"
            for row in wrong
        ]
        lines.append("")
    if attacks:
        lines += _attack_lines(attacks, [row for row in result.rows if row.defence_removed])
    if plain_rows:
        lines += ["## Other rows" if attacks else "## Rows", "", *_rows_table(plain_rows)]
    return "\n".join(lines).rstrip() + "\n"


def _summary_cast(members: Sequence[CastMember]) -> list[str]:
    if not members:
        return []
    lines = [
        "## Enclave for each part",
        "",
        "| part | enclave | ROS nodes | why |",
        "| --- | --- | --- | --- |",
    ]
    lines += [
        f"| {member.part} | {member.enclave} | {', '.join(member.nodes)} | {member.why} |"
        for member in members
    ]
    return [*lines, ""]


def _verdict(result: DemoResult, wrong: Sequence[RowResult]) -> str:
    known = sum(1 for row in result.rows if row.known_open)
    good = "as expected" if result.as_expected else "as expected in all rows that ran"
    parts = [
        f"{len(wrong)} of {counted(len(result.rows), 'row')} not as expected" if wrong else good
    ]
    if known:
        parts.append(f"{counted(known, 'attack')} known to succeed")
    return ", ".join([*parts, *_left_out_clauses(result)]) + "."


def _attack_lines(
    attacks: Sequence[RowResult], rows_without_defense: Sequence[RowResult]
) -> list[str]:
    closed = [row for row in attacks if not row.open_because]
    open_ = [row for row in attacks if row.open_because]
    lines = [
        "## Attacks",
        "",
        "A failed attack proves something only if the same attack succeeds without the defense: the"
        " last column shows that result.",
        "",
        "| attack | expected | observed | mechanism | without the defense |",
        "| --- | --- | --- | --- | --- |",
    ]
    for row in closed:
        texts = (
            _result_without_defense(twin)
            for twin in rows_without_defense
            if twin.attack == row.attack
        )
        twins = "; ".join(dict.fromkeys(texts))
        lines.append(f"| {_cells(row)} | {row.mechanism} | {twins} |")
    if open_:
        lines += ["", "## Attacks known to succeed, and remedies", ""]
        lines += [
            "| attack | expected | observed | why | remedy |",
            "| --- | --- | --- | --- | --- |",
        ]
        lines += [f"| {_cells(row)} | {row.open_because} | {row.remedy} |" for row in open_]
    return [*lines, ""]


def _result_without_defense(row: RowResult) -> str:
    """Return the result of a row without a defense, such as ``heard with the right key``."""
    if row.defence_removed.startswith("the wrong "):
        # Here, the defense that was removed is a fault of the attacker's own files.
        return f"{row.observed} with the right {row.defence_removed.removeprefix('the wrong ')}"
    return f"{row.observed} without {row.defence_removed}"


def _rows_table(rows: Sequence[RowResult]) -> list[str]:
    lines = ["| row | expected | observed | mechanism |", "| --- | --- | --- | --- |"]
    return [*lines, *(f"| {_cells(row)} | {row.mechanism} |" for row in rows), ""]


def _cells(row: RowResult) -> str:
    observed = str(row.observed) if row.as_expected else f"**{row.observed}**"
    if row.observed is RowStatus.SKIPPED:
        observed = f"skipped: {row.detail}"
    return f"{row.name} | {row.expected} | {observed}"
