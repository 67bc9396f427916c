"""The verdict: what counts as heard, as silence, and as a refusal; and that a crash is neither."""

from __future__ import annotations

from collections.abc import Iterable

import pytest

from sros_tool.demo.result import PartyRecord, RowRecord, RowResult, judge_row
from sros_tool.demo.scenarios.communication import ROWS
from sros_tool.demo.scenarios.model import Row, RowStatus
from sros_tool.demo.scenarios.on_zenoh import ATTACKS as ZENOH_ATTACKS
from sros_tool.demo.wire import WireCount
from sros_tool.runtime.events import Event, EventKind, ProcessStage
from sros_tool.values import as_plain

WINDOW = (100.0, 105.0)
FAST_DDS_DENIAL = (
    "2026-01-01 12:00:00.000 [SECURITY Error] rt/chatter topic not found in allow rule."
    " -> Function check_create_datareader\n"
)
READY = Event(EventKind.READY, 99.0)


def row(name: str) -> Row:
    return next(each for each in ROWS if each.name == name)


def talker(text: str, times: Iterable[float] = (101.0, 102.0), topic: str = "/c") -> PartyRecord:
    sent = [Event(EventKind.SENT, at, f"{text}: {n}", n) for n, at in enumerate(times, 1)]
    return PartyRecord(text=text, topic=topic, events=(READY, *sent))


def listener(*heard: str) -> PartyRecord:
    events = [Event(EventKind.HEARD, 101.5, f"{text}: 1", n) for n, text in enumerate(heard, 1)]
    return PartyRecord(events=(READY, *events))


def judge(name: str, **parties: PartyRecord) -> RowResult:
    records = {party.replace("_", " "): record for party, record in parties.items()}
    return judge_row(RowRecord(row(name), 100, records, WINDOW))


POSITIVE = "secured talker to secured listener"
NEGATIVE = "secured talker to unsecured listener"
DENIED = "secured listener without permission"


def test_heard() -> None:
    result = judge(POSITIVE, secured_talker=talker("T"), secured_listener=listener("T"))
    assert (result.observed, result.as_expected) == (RowStatus.HEARD, True)
    assert "1 of 2 messages" in result.detail


def test_silence_is_a_failure_where_sound_is_expected() -> None:
    result = judge(POSITIVE, secured_talker=talker("T"), secured_listener=listener())
    assert (result.observed, result.as_expected) == (RowStatus.NOT_HEARD, False)


def test_words_of_another_talker_do_not_count() -> None:
    result = judge(POSITIVE, secured_talker=talker("T-1"), secured_listener=listener("T-11"))
    assert result.observed is RowStatus.NOT_HEARD


def test_silence_counts_beside_a_control_that_heard() -> None:
    parties = {"secured_talker": talker("T"), "unsecured_listener": listener()}
    good = judge(NEGATIVE, **parties, secured_listener=listener("T"))
    assert (good.observed, good.as_expected) == (RowStatus.NOT_HEARD, True)
    deaf_control = judge(NEGATIVE, **parties, secured_listener=listener())
    assert (deaf_control.observed, deaf_control.as_expected) == (RowStatus.UNDECIDED, False)


def test_one_leaked_message_is_a_failure_even_before_the_window() -> None:
    leak = PartyRecord(events=(READY, Event(EventKind.HEARD, 99.5, "T: 0", 1)))
    result = judge(
        NEGATIVE,
        secured_talker=talker("T"),
        unsecured_listener=leak,
        secured_listener=listener("T"),
    )
    assert (result.observed, result.as_expected) == (RowStatus.HEARD, False)


def test_silence_of_a_talker_that_sent_nothing_is_undecided() -> None:
    result = judge(
        NEGATIVE,
        secured_talker=talker("T", times=(90.0,)),
        unsecured_listener=listener(),
        secured_listener=listener("T"),
    )
    assert (result.observed, result.as_expected) == (RowStatus.UNDECIDED, False)


CRASHES = {
    "killed": (PartyRecord(events=(READY,), status=-11), RowStatus.CRASHED, "SIGSEGV"),
    "ended by itself": (PartyRecord(events=(READY,), status=0), RowStatus.CRASHED, "status 0"),
    "died before it was ready": (
        PartyRecord(output="Traceback\nImportError: no std_msgs", status=1),
        RowStatus.CRASHED,
        "ImportError",
    ),
    "an exception": (
        PartyRecord(
            events=(Event(EventKind.FAILED, 99, "ValueError: x", stage=ProcessStage.ENDPOINT),)
        ),
        RowStatus.CRASHED,
        "ValueError: x",
    ),
    "never ready": (PartyRecord(), RowStatus.NOT_STARTED, "not ready"),
    "no security built in": (
        PartyRecord(
            events=(
                Event(
                    EventKind.FAILED,
                    99,
                    "This Fast DDS version doesn't have the security libraries",
                    stage=ProcessStage.PARTICIPANT,
                ),
            )
        ),
        RowStatus.NOT_STARTED,
        "security libraries",
    ),
    "refused already as a participant": (
        PartyRecord(
            events=(Event(EventKind.REFUSED, 99, "bad file", stage=ProcessStage.PARTICIPANT),)
        ),
        RowStatus.NOT_LET_IN,
        "before it used the topic",
    ),
    "denied a topic that every node has": (
        PartyRecord(
            topic="/chatter",
            output="[SECURITY Error] rt/rosout topic not found in allow rule.\n",
            events=(Event(EventKind.FAILED, 99, "RCLError: x", stage=ProcessStage.ENDPOINT),),
        ),
        RowStatus.NOT_LET_IN,
        "before it used the topic",
    ),
    "a denial in the log, then a crash": (
        PartyRecord(topic="/chatter", output=FAST_DDS_DENIAL, status=-6),
        RowStatus.CRASHED,
        "SIGABRT",
    ),
}


@pytest.mark.parametrize("case", CRASHES)
def test_a_crash_is_not_a_refusal(case: str) -> None:
    record, observed, told = CRASHES[case]
    result = judge(DENIED, listener_without_permission=record, secured_listener=listener())
    assert (result.observed, result.as_expected) == (observed, False)
    assert told in result.detail


@pytest.mark.parametrize("case", CRASHES)
def test_a_crash_is_not_silence(case: str) -> None:
    record, observed, _ = CRASHES[case]
    result = judge(
        NEGATIVE,
        secured_talker=talker("T"),
        unsecured_listener=record,
        secured_listener=listener("T"),
    )
    assert (result.observed, result.as_expected) == (observed, False)


REFUSALS = {
    "Cyclone says so": PartyRecord(
        topic="/chatter",
        events=(
            Event(EventKind.REFUSED, 99, "Not Allowed By Security", stage=ProcessStage.ENDPOINT),
        ),
    ),
    "rclpy raises, Fast DDS says so on stdout": PartyRecord(
        topic="/chatter",
        output=FAST_DDS_DENIAL,
        events=(
            Event(EventKind.FAILED, 99, "RCLError: invalid allocator", stage=ProcessStage.ENDPOINT),
        ),
        status=1,
    ),
}


@pytest.mark.parametrize("case", REFUSALS)
def test_a_refusal_by_security(case: str) -> None:
    parties = {"listener_without_permission": REFUSALS[case]}
    result = judge(DENIED, **parties, secured_listener=listener())
    assert (result.observed, result.as_expected) == (RowStatus.REFUSED, True)
    without_twin = judge(DENIED, **parties, secured_listener=PartyRecord())
    assert (without_twin.observed, without_twin.as_expected) == (RowStatus.UNDECIDED, False)


def test_a_listener_that_is_let_in_is_a_failure() -> None:
    result = judge(DENIED, listener_without_permission=listener(), secured_listener=listener())
    assert (result.observed, result.as_expected) == (RowStatus.STARTED, False)


def test_a_refused_listener_is_not_silence() -> None:
    result = judge(
        NEGATIVE,
        secured_talker=talker("T"),
        unsecured_listener=REFUSALS["Cyclone says so"],
        secured_listener=listener("T"),
    )
    assert (result.observed, result.as_expected) == (RowStatus.REFUSED, False)


@pytest.mark.parametrize(
    ("secured", "unsecured", "observed"),
    [
        (["S"], ["U"], RowStatus.UNDISTURBED),
        (["S", "U"], ["U"], RowStatus.DISTURBED),
        (["S"], ["U", "S"], RowStatus.DISTURBED),
        ([], ["U"], RowStatus.DISTURBED),
    ],
)
def test_side_by_side(secured: list[str], unsecured: list[str], observed: RowStatus) -> None:
    result = judge(
        "both pairs side by side on one topic",
        secured_talker=talker("S"),
        unsecured_talker=talker("U"),
        secured_listener=listener(*secured),
        unsecured_listener=listener(*unsecured),
    )
    assert result.observed is observed


@pytest.mark.parametrize(
    ("before", "inside", "after", "tries", "observed"),
    [
        (1, 1, 0, True, RowStatus.NOT_ERASED),  # when the window is over, the talker ends
        (1, 0, 0, True, RowStatus.ERASED),
        (0, 0, 0, True, RowStatus.UNDECIDED),
        (1, 1, 1, False, RowStatus.UNDECIDED),
    ],
)
def test_a_node_that_is_erased(
    before: int, inside: int, after: int, tries: bool, observed: RowStatus
) -> None:
    erasing = next(each for each in ZENOH_ATTACKS.rows if each.expected is RowStatus.NOT_ERASED)
    looks = tuple(
        Event(EventKind.SEEN, moment, publishers={"/c": count})
        for moment, count in ((50, before), (103, inside), (900, after))
    )
    eraser = (READY, *((Event(EventKind.SENT, 60, "erased 1"),) if tries else ()))
    records = {
        "router": PartyRecord(events=(READY,)),
        "talker": talker("S"),
        "observer": PartyRecord(events=(READY, *looks)),
        "eraser": PartyRecord(events=eraser, topic="/c"),
    }
    assert judge_row(RowRecord(erasing, 0, records, WINDOW)).observed is observed


@pytest.mark.parametrize(
    ("of_secured", "of_open", "observed"),
    [(0, 1, RowStatus.NOT_VISIBLE), (1, 1, RowStatus.VISIBLE), (0, 0, RowStatus.UNDECIDED)],
)
def test_view(of_secured: int, of_open: int, observed: RowStatus) -> None:
    looks = {"/c": of_secured, "/c_open": of_open}
    result = judge(
        "secured talker in an unsecured node's view",
        secured_talker=talker("S"),
        unsecured_talker_on_another_topic=talker("U", topic="/c_open"),
        observer=PartyRecord(events=(READY, Event(EventKind.SEEN, 103, publishers=looks))),
    )
    assert result.observed is observed


def test_an_observer_without_rclpy_is_skipped_with_the_reason() -> None:
    failed = Event(EventKind.FAILED, 99, "ModuleNotFoundError: rclpy", stage=ProcessStage.IMPORT)
    result = judge(
        "secured talker in an unsecured node's view",
        secured_talker=talker("S"),
        unsecured_talker_on_another_topic=talker("U"),
        observer=PartyRecord(events=(failed,), status=1),
    )
    assert (result.observed, result.as_expected) == (RowStatus.SKIPPED, True)
    assert "ModuleNotFoundError" in result.detail


@pytest.mark.parametrize(
    ("plain", "protected", "observed"),
    [
        (0, 100, RowStatus.NOT_READABLE),
        (1, 100, RowStatus.READABLE),
        (0, 0, RowStatus.UNDECIDED),
    ],
)
def test_wire(plain: int, protected: int, observed: RowStatus) -> None:
    parties = {"secured talker": talker("T"), "secured listener": listener("T")}
    wire = {"secured talker": WireCount(plain, protected)}
    record = RowRecord(row("secured payload on the wire"), 100, parties, WINDOW, wire)
    assert judge_row(record).observed is observed


def test_a_skipped_row_is_shown_with_its_reason() -> None:
    result = judge_row(RowRecord(row(POSITIVE), 100, skipped="not permitted"))
    assert (result.observed, result.detail) == (RowStatus.SKIPPED, "not permitted")
    assert set(as_plain(result)) >= {"name", "expected", "observed", "as_expected", "mechanism"}
