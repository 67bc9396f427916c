"""The attacks as data: each has a control, and a twin without its defense that succeeds."""

from __future__ import annotations

import inspect
import re
from datetime import UTC, datetime
from itertools import chain, combinations
from pathlib import Path

import pytest

from sros_tool.demo import forger
from sros_tool.demo.forger import KeystoreCopy, Undefended, folder_name_of
from sros_tool.demo.keystores import KeystoreSet
from sros_tool.demo.scenarios import SCENARIOS
from sros_tool.demo.scenarios.attacks import ATTACKS
from sros_tool.demo.scenarios.model import (
    DENIALS,
    FOREIGN,
    OWN,
    Condition,
    Row,
    RowStatus,
    Scenario,
)
from sros_tool.demo.scenarios.on_zenoh import ATTACKS as ZENOH_ATTACKS
from sros_tool.errors import KeystoreError
from tests.support.checkout import CHECKOUT
from tests.support.tables import for_every

ROWS = (
    *ATTACKS.rows,
    *(variant.instead for row in ATTACKS.rows for variant in row.variants if variant.instead),
)
CLOSED = {
    *DENIALS,
    RowStatus.NOT_HEARD,
    RowStatus.NOT_HEARD_AGAIN,
    RowStatus.NOT_DECEIVED,
    RowStatus.NOT_ANSWERED,
    RowStatus.NOT_VISIBLE,
    RowStatus.NOT_ERASED,
    RowStatus.NOT_READABLE,
}
BY_NAME = for_every(ROWS, lambda row: row.name)


@BY_NAME
def test_a_closed_door_has_a_control_that_is_open(row: Row) -> None:
    if row.expected in CLOSED:
        assert not row.defence_removed
        assert row.controls
        assert all(claim.holds for claim in row.controls)


def test_every_closed_door_opens_without_its_defense() -> None:
    closed = {row.attack for row in ROWS if row.expected in CLOSED}
    opened = {row.attack for row in ROWS if row.defence_removed}
    # The closed row of this one is the control of those with variables that are spelt wrong.
    assert closed - opened == {"misspelt security variables"}
    for row in ROWS:
        if row.defence_removed:
            assert row.expected not in CLOSED, row.name


@pytest.mark.parametrize(
    ("title", "scenario", "count"),
    [("", ATTACKS, 7), (" on Zenoh", ZENOH_ATTACKS, 5)],
    ids=["DDS", "Zenoh"],
)
def test_the_page_lists_the_attacks_that_work(title: str, scenario: Scenario, count: int) -> None:
    page = (CHECKOUT / "docs/attacks.md").read_text()
    _, _, text = page.partition(f"These attacks are known to work{title}:\n")
    listed = re.findall(r"^\| (.+?) \|", text.strip().partition("\n\n")[0], re.MULTILINE)[2:]
    assert listed == [
        row.name for row in scenario.rows if row.open_because and not row.defence_removed
    ]
    assert len(listed) == count, "docs/security.md has the number"


@BY_NAME
def test_what_is_open_says_why_and_what_to_do(row: Row) -> None:
    if row.expected not in CLOSED and not row.defence_removed:
        assert row.open_because
        assert row.remedy
    for variant in row.variants:
        if variant.expected not in CLOSED and not variant.instead:
            assert variant.open_because
            assert variant.remedy


@BY_NAME
def test_its_identities_can_be_made(row: Row) -> None:
    keystores = KeystoreSet({}, ATTACKS.cast)
    for party in row.parties:
        chosen = party.identity.keystore
        assert chosen in (None, OWN, FOREIGN) or isinstance(chosen, Undefended) or callable(chosen)
        if chosen is not None:
            assert keystores.enclave(party.identity).startswith("/")


def public_functions(argument: str) -> set[str]:
    """The public functions of the forger that take one argument of that name."""
    found = inspect.getmembers(forger, inspect.isfunction)
    return {
        name
        for name, function in found
        if not name.startswith("_") and [*inspect.signature(function).parameters] == [argument]
    }


def test_every_forgery_is_used_and_has_a_folder_of_its_own() -> None:
    rows = [*ROWS, *(row for scenario in SCENARIOS for row in scenario.rows)]
    used = {party.identity.keystore for row in rows for party in row.parties}
    forged = {each for each in used if each not in (None, OWN, FOREIGN)}
    undefended = {each for each in forged if isinstance(each, Undefended)}
    forges = {each.forge for each in undefended} | (forged - undefended)
    names = {each.__name__ for each in forges if callable(each)}
    assert len(public_functions("copy")) > 25
    assert names - {"_forge_nothing"} == public_functions("copy")
    templates = {each.template.__name__ for each in undefended}
    assert templates - {"_same_template"} == public_functions("template")
    folders = [folder_name_of(each) for each in forged]  # type: ignore[arg-type]
    assert len(folders) == len(set(folders)) == len(forged) > 40


@BY_NAME
def test_every_template_and_vendor_has_an_expectation(row: Row) -> None:
    """A variant must fit the claim that it changes; `Row.under` raises where it does not."""
    subsets = chain.from_iterable(combinations(Condition, size) for size in range(4))
    for conditions in subsets:
        chosen = row.with_expected_status(frozenset(conditions))
        assert chosen.claims[0].expected is chosen.expected


def test_names_are_distinct() -> None:
    names = [row.name for row in ROWS]
    assert len(names) == len(set(names)) > 55


def test_a_part_that_nobody_plays_is_named() -> None:
    copy = KeystoreCopy(Path("ks"), Path("other"), {}, "/t", 0, datetime(2026, 1, 1, tzinfo=UTC))
    with pytest.raises(KeystoreError, match="The row needs two more enclaves"):
        forger.borrowed_permissions(copy)
