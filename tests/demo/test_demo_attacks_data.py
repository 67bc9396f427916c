"""The attacks as data: each has a control, and a twin without its defence that succeeds."""

from __future__ import annotations

from itertools import chain, combinations

import pytest

from sros_tool.demo.forger import FORGERIES, REMOVALS
from sros_tool.demo.keystores import Scenery
from sros_tool.demo.model import DENIALS, FOREIGN, OWN, Condition, Row, Status
from sros_tool.demo.scenarios import SCENARIOS
from sros_tool.demo.scenarios.attacks import ATTACKS

ROWS = (
    *ATTACKS.rows,
    *(case.instead for row in ATTACKS.rows for case in row.cases if case.instead),
)
CLOSED = {
    *DENIALS,
    Status.NOT_HEARD,
    Status.NOT_HEARD_AGAIN,
    Status.NOT_ANSWERED,
    Status.NOT_VISIBLE,
    Status.NOT_READABLE,
}
BY_NAME = pytest.mark.parametrize("row", ROWS, ids=lambda row: row.name)


@BY_NAME
def test_a_closed_door_has_a_control_that_is_open(row: Row) -> None:
    if row.expected in CLOSED:
        assert not row.removed
        assert row.controls
        assert all(claim.holds for claim in row.controls)


def test_every_closed_door_opens_without_its_defence() -> None:
    closed = {row.attack for row in ROWS if row.expected in CLOSED}
    opened = {row.attack for row in ROWS if row.removed}
    # The closed row of this one is the control of those with variables that are spelt wrong.
    assert closed - opened == {"misspelt security variables"}
    for row in ROWS:
        if row.removed:
            assert row.expected not in CLOSED, row.name


@BY_NAME
def test_what_is_open_says_why_and_what_to_do(row: Row) -> None:
    if row.expected not in CLOSED and not row.removed:
        assert row.open_because
        assert row.remedy
    for case in row.cases:
        if case.expected not in CLOSED and not case.instead:
            assert case.open_because
            assert case.remedy


@BY_NAME
def test_its_identities_can_be_made(row: Row) -> None:
    scenery = Scenery({}, ATTACKS.cast)
    for party in row.parties:
        assert party.identity.keystore in {"", OWN, FOREIGN, *FORGERIES, *REMOVALS}
        if party.identity.keystore:
            assert scenery.enclave(party.identity).startswith("/")


def test_every_forgery_is_used() -> None:
    rows = [*ROWS, *(row for scenario in SCENARIOS for row in scenario.rows)]
    used = {party.identity.keystore for row in rows for party in row.parties}
    assert set(FORGERIES) | set(REMOVALS) <= used


@BY_NAME
def test_every_template_and_vendor_has_an_expectation(row: Row) -> None:
    """A case must fit the claim that it changes; `Row.under` raises where it does not."""
    subsets = chain.from_iterable(combinations(Condition, size) for size in range(4))
    for conditions in subsets:
        chosen = row.under(frozenset(conditions))
        assert chosen.claims[0].expected is chosen.expected


def test_names_are_distinct() -> None:
    names = [row.name for row in ROWS]
    assert len(names) == len(set(names)) > 55
