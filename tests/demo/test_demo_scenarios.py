"""The scenario data: every row can fail, and every silence has a control."""

from __future__ import annotations

import pytest

from sros_tool.demo.model import STATUS_OF, Relation, Role, Row
from sros_tool.demo.scenarios.isolation import ROWS


@pytest.mark.parametrize("row", ROWS, ids=lambda row: row.name)
def test_claims_name_parties_of_the_row(row: Row) -> None:
    names = [party.name for party in row.parties]
    assert len(names) == len(set(names))
    for claim in (*row.claims, *row.controls):
        row.party(claim.subject)
        if claim.talker:
            assert row.party(claim.talker).role is Role.TALKER


@pytest.mark.parametrize("row", ROWS, ids=lambda row: row.name)
def test_what_is_expected_of_a_row_is_what_its_claims_say(row: Row) -> None:
    if len(row.claims) == 1:
        assert row.claims[0].expected is row.expected
    else:
        assert row.expected not in STATUS_OF.values()


@pytest.mark.parametrize("row", ROWS, ids=lambda row: row.name)
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


def test_names_are_distinct_and_can_be_printed_anywhere() -> None:
    names = [row.name for row in ROWS]
    assert len(names) == len(set(names)) >= 10
    assert all(name.isascii() for name in names)
