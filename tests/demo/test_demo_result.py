"""What is shown of a result: JSON, the table, the page for a reviewer."""

from __future__ import annotations

import json
from dataclasses import replace
from datetime import UTC, datetime

import pytest

from sros_tool.demo.result import (
    DemoResult,
    RowResult,
    ScenarioResult,
    demo_table,
    summary_page,
    used_libraries,
)
from sros_tool.demo.scenarios.model import RowStatus
from sros_tool.report.pages import render_demo_page
from sros_tool.runtime.processes import MappedLibrary
from sros_tool.values import as_plain

NOW = datetime(2026, 1, 2, 3, 4, 5, tzinfo=UTC)
CLOSED = RowResult(
    "edited", RowStatus.NOT_LET_IN, RowStatus.NOT_LET_IN, "a signature", "seen", 1, attack="forged"
)
TWIN = RowResult(
    "signed",
    RowStatus.HEARD,
    RowStatus.HEARD,
    "m",
    "seen",
    1,
    attack="forged",
    defence_removed="the signature",
)
OPEN = RowResult(
    "put back",
    RowStatus.HEARD,
    RowStatus.HEARD,
    "m",
    "seen",
    1,
    attack="old",
    open_because="nothing revokes it",
    remedy="renew",
)


def result(*rows: RowResult) -> DemoResult:
    named = tuple(replace(row, scenario="attacks") for row in rows)
    return DemoResult(
        backend="cyclone",
        dds="Cyclone DDS 0.10.2",
        why="a test",
        template="production",
        topic="/chatter",
        names=("topic /chatter",),
        own_network=True,
        network_reason="",
        scenarios=(ScenarioResult("attacks", "every way in", named),),
    )


def test_json_says_what_the_module_describes() -> None:
    shown = json.loads(json.dumps(as_plain(result(CLOSED, TWIN, OPEN))))
    assert shown["as_expected"] is True
    assert shown["scenarios"][0]["rows"] == shown["rows"]
    closed, twin, open_ = shown["rows"]
    assert (closed["scenario"], closed["attack"]) == ("attacks", "forged")
    assert (twin["defence_removed"], closed["defence_removed"]) == ("the signature", "")
    assert (open_["open_because"], open_["remedy"]) == ("nothing revokes it", "renew")


OLD = MappedLibrary("Fast DDS", "2.14.5", "/opt/ros/jazzy/lib/libfastrtps.so.2.14.5")


@pytest.mark.parametrize(
    ("library", "text"),
    [
        (
            OLD,
            "27 known vulnerabilities: CVE-2025-62599, CVE-2025-62600, CVE-2025-62601 and 24",
        ),
        (
            OLD._replace(path="/usr/lib/x.so"),
            "vulnerabilities, unless the installed package fixes them: CVE",
        ),
        (
            MappedLibrary("Cyclone DDS", "0.10.2", "/usr/lib/libddsc.so.0.10.2"),
            "1 known vulnerability, unless the installed package fixes it: CVE-2023-24011.",
        ),
        (
            OLD._replace(version="3.2.5"),
            "is not known to have a vulnerability; 2 vulnerabilities may affect it.",
        ),
        (OLD._replace(version=""), "of unknown version, which the processes loaded, may have"),
        (None, "Cyclone DDS 0.10.2 may have vulnerabilities: sros does not"),
    ],
)
def test_the_known_holes_with_which_it_ran_are_named(
    library: MappedLibrary | None, text: str
) -> None:
    row = replace(CLOSED, libraries=frozenset({library} if library else ()))
    shown = replace(result(row), libraries=used_libraries([row, CLOSED]))
    assert text in demo_table(shown)
    listed = as_plain(shown)
    assert len(listed["libraries"]) == bool(library)
    page = render_demo_page(listed, "")
    for name in listed["libraries"][0]["vulnerabilities"] or () if library else ():
        assert name in listed["vulnerabilities"] and name in page
    assert listed["vulnerabilities"] in summary_page(shown, NOW)
    assert library or listed["vulnerabilities"] in page


def test_a_known_open_door_is_named_and_no_failure() -> None:
    shown = result(CLOSED, TWIN, OPEN)
    text = demo_table(shown)
    assert shown.as_expected
    assert "open  put back" in text
    assert "nothing revokes it; to do: renew" in text
    assert text.endswith("3 of 3 rows as expected, 1 of them known to be open.")


def test_a_door_that_only_this_keystore_opens_is_a_failure_until_it_is_accepted() -> None:
    shown = result(replace(OPEN, unaccepted=True), CLOSED)
    text = demo_table(shown)
    assert not shown.as_expected
    assert "OPEN  put back" in text and "nothing revokes it; to do: renew" in text
    assert "1 of 2 rows as expected, 1 open in this keystore (accept each with" in text
    assert [row["open_here"] for row in as_plain(shown)["rows"]] == [True, False]
    assert "- **put back**: open in this keystore: nothing" in summary_page(shown, NOW)
    page = render_demo_page(as_plain(shown), "")
    assert "<b>1</b> open in this keystore" in page and "known to be open" not in page
    skipped = replace(OPEN, unaccepted=True, observed=RowStatus.SKIPPED)
    assert result(skipped).as_expected


@pytest.mark.parametrize(
    ("row", "observed", "good"),
    [
        (OPEN, RowStatus.HEARD, True),
        (CLOSED, RowStatus.HEARD, True),
        (CLOSED, RowStatus.NOT_LET_IN, True),
        (CLOSED, RowStatus.CRASHED, False),
        (CLOSED, RowStatus.UNDECIDED, False),
        (OPEN, RowStatus.NOT_HEARD, False),
    ],
)
def test_what_is_accepted_may_succeed_and_nothing_else(
    row: RowResult, observed: RowStatus, good: bool
) -> None:
    shown = result(replace(row, observed=observed, accepted=True))
    assert shown.as_expected is good
    opened = observed is RowStatus.HEARD
    assert ("accepted with --accept-open" in demo_table(shown)) is opened
    assert ("open  " in demo_table(shown)) is opened


def test_a_door_that_is_open_and_should_not_be_is_a_failure() -> None:
    bad = RowResult(
        "edited", RowStatus.NOT_LET_IN, RowStatus.HEARD, "m", "was heard", 1, attack="x"
    )
    shown = result(bad, OPEN)
    assert not shown.as_expected
    assert "FAIL  edited" in demo_table(shown)
    page = summary_page(shown, NOW)
    assert "**1 of 2 rows not as expected" in page
    assert "- **edited**: expected not let in, observed heard. was heard" in page


def test_a_door_that_was_known_to_be_open_and_is_closed_is_told() -> None:
    """Perhaps the vendor has closed it: then the expectation is to be changed."""
    closed = RowResult(
        "put back", RowStatus.HEARD, RowStatus.NOT_HEARD, "m", "d", 1, attack="a", open_because="o"
    )
    assert not result(closed).as_expected
    assert "FAIL  put back" in demo_table(result(closed))


def test_the_page_for_a_reviewer() -> None:
    page = summary_page(result(CLOSED, TWIN, OPEN), NOW)
    assert "2026-01-02T03:04:05Z" in page
    assert "template `production`" in page
    assert (
        "| edited | not let in | not let in | a signature | heard without the signature |" in page
    )
    assert "| put back | heard | heard | nothing revokes it | renew |" in page
