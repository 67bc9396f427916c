"""The scenario data: every row can fail, and every silence has a control."""

from __future__ import annotations

from itertools import chain

import pytest

from sros_tool.demo.scenarios import SCENARIOS, choose_scenarios
from sros_tool.demo.scenarios.communication import ROWS
from sros_tool.demo.scenarios.model import (
    CALLING,
    OUTCOMES,
    SPEAKING,
    Relation,
    Role,
    Row,
    Scenario,
)
from sros_tool.demo.scenarios.on_zenoh import ZENOH_SCENARIOS
from sros_tool.errors import UsageError
from tests.support.tables import for_every

EVERY_ROW = for_every(
    (row for scenario in (*SCENARIOS, *ZENOH_SCENARIOS) for row in scenario.rows),
    lambda row: row.name,
)


@EVERY_ROW
def test_claims_name_parties_of_the_row(row: Row) -> None:
    names = [party.name for party in row.parties]
    assert len(names) == len(set(names))
    for claim in (*row.claims, *row.controls):
        row.party(claim.subject)
        if claim.talker:
            acting = {Relation.EXECUTES: CALLING, Relation.LOSES: {Role.ERASER}}
            assert row.party(claim.talker).role in acting.get(claim.relation, SPEAKING)


@EVERY_ROW
def test_what_is_expected_of_a_row_is_what_its_claims_say(row: Row) -> None:
    if len(row.claims) == 1:
        assert row.claims[0].expected is row.expected
    else:
        assert row.expected not in chain(*OUTCOMES.values())


@for_every(ROWS, lambda row: row.name)
def test_every_negative_claim_has_a_positive_one_beside_it(row: Row) -> None:
    everything = (*row.claims, *row.controls)
    for claim in everything:
        if claim.relation is Relation.HEARS and not claim.holds:
            assert any(
                other.holds and other.relation is Relation.HEARS and other.talker == claim.talker
                for other in everything
            )
        elif claim.relation is Relation.IS_REFUSED or not claim.holds:
            assert any(other.holds for other in row.controls)


@EVERY_ROW
def test_whoever_is_not_to_succeed_is_tried_beside_somebody_who_does(row: Row) -> None:
    if not all(claim.holds and not claim.denied for claim in row.claims):
        assert any(claim.holds for claim in (*row.claims, *row.controls))


@pytest.mark.parametrize(
    "scenario", (*SCENARIOS, *ZENOH_SCENARIOS), ids=lambda scenario: scenario.name
)
def test_names_are_distinct_and_can_be_printed_anywhere(scenario: Scenario) -> None:
    names = [row.name for row in scenario.rows]
    assert len(names) == len(set(names)) >= 3
    assert all(name.isascii() for name in names)


def test_scenarios_are_chosen_by_name() -> None:
    assert [each.name for each in choose_scenarios(())] == ["isolation"]
    assert choose_scenarios(("all", "attacks")) == SCENARIOS
    names = [each.name for each in choose_scenarios(("actions", "services", "actions"))]
    assert names == ["actions", "services"]
    for unknown in (("x",), ("all", "x")):  # `all` hides no other name
        with pytest.raises(UsageError, match=r"no scenario 'x'.*isolation, services"):
            choose_scenarios(unknown)
