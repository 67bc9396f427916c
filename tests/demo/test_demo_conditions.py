"""What a template and a vendor let one expect of the attacks."""

from __future__ import annotations

from dataclasses import replace

import pytest

from sros_tool.demo.backend import Backend, conditions
from sros_tool.demo.scenarios.attacks import ATTACKS
from sros_tool.demo.scenarios.model import Condition, RowStatus
from sros_tool.keystore.template import Template, load_template
from sros_tool.policy.model import Level, NamedProtection, TopicProtection

OPEN = {
    RowStatus.HEARD,
    RowStatus.ANSWERED,
    RowStatus.VISIBLE,
    RowStatus.HEARD_AGAIN,
    RowStatus.READABLE,
    RowStatus.DECEIVED,
}
CYCLONE = Backend("cyclone", "Cyclone DDS 0.10.2", "a test")
FAST = Backend("rclpy", "Fast DDS 2.14.5", "a test")
C = Condition
BARE = TopicProtection(Level.NONE, Level.NONE, False, False, False, False)


def protected(**choices: object) -> Template:
    template = load_template("production")
    return replace(template, protection=replace(template.protection, **choices))  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("template", "topic", "holding"),
    [
        (load_template("production"), "rt/a", set()),
        (load_template("development"), "rt/a", {C.SHARED_SUBJECTS, C.OPEN_DEFAULT}),
        (load_template("sros2"), "rt/a", {C.ONE_CA, C.SHARED_SUBJECTS, C.OPEN_DEFAULT}),
        (protected(rtps=Level.SIGN, default=TopicProtection(Level.SIGN, Level.SIGN)), "rt/a",
         {C.IN_CLEAR}),
        (protected(rtps=Level.ENCRYPT, default=BARE), "rt/a", {C.UNCONTROLLED}),
        (protected(join_access_control=False), "rt/a", {C.OPEN_JOIN}),
        (protected(rtps=Level.NONE, allow_unauthenticated_participants=True), "rt/a", set()),
        (protected(rtps=Level.NONE, allow_unauthenticated_participants=True, default=BARE),
         "rt/a", {C.IN_CLEAR, C.UNSIGNED, C.UNCONTROLLED, C.UNAUTHENTICATED,
                  C.UNAUTHENTICATED_SEE}),
        (protected(rtps=Level.NONE, named=(NamedProtection("topics", "/a", BARE),)), "rt/a",
         {C.IN_CLEAR, C.UNSIGNED, C.UNCONTROLLED}),
        (protected(rtps=Level.NONE, named=(NamedProtection("topics", "/a", BARE),)), "rt/b", set()),
    ],
)  # fmt: skip
def test_templates(template: Template, topic: str, holding: set[Condition]) -> None:
    assert conditions(CYCLONE, template, topic) == holding | {C.CYCLONE}
    assert conditions(FAST, template, topic) == holding | {C.FAST, C.EXACT_SIGNER}


@pytest.mark.parametrize(
    ("version", "exact"),
    [
        ("2.1.3", False), ("2.1.4", True), ("2.6.4", False), ("2.6.5", True), ("2.8.1", False),
        ("2.9.1", False), ("2.9.2", True), ("2.10.0", True), ("2.14.5", True), ("3.2.0", True),
        ("", True),
    ],
)  # fmt: skip
def test_which_fast_dds_knows_its_signers(version: str, exact: bool) -> None:
    fast = Backend("rclpy", f"Fast DDS {version}".strip(), "a test")
    assert (C.EXACT_SIGNER in conditions(fast, load_template("sros2"), "rt/a")) is exact


def outcomes(backend: Backend, template: str) -> dict[str, RowStatus]:
    holding = conditions(backend, load_template(template), "rt/chatter")
    return {row.name: row.with_expected_status(holding).expected for row in ATTACKS.rows}


def test_what_differs_between_templates_and_vendors() -> None:
    production = outcomes(CYCLONE, "production")

    def differing(backend: Backend, template: str) -> dict[str, RowStatus]:
        found = outcomes(backend, template)
        return {name: found[name] for name in found if found[name] is not production[name]}

    assert not differing(CYCLONE, "production")
    shared = {
        "an enclave without a policy publishes": RowStatus.HEARD,
        "permissions borrowed from a longer enclave name": RowStatus.HEARD,
        "old permissions put back after renewal": RowStatus.HEARD,
    }
    assert differing(CYCLONE, "development") == shared
    assert differing(CYCLONE, "sros2") == shared | {
        "permissions signed by the enclave itself": RowStatus.HEARD,
        "permissions and governance signed by the enclave": RowStatus.HEARD,
    }
    vendors = {
        "certificate with the key of another enclave": RowStatus.NOT_LET_IN,
        "permissions for another domain": RowStatus.NOT_HEARD,
        "an enclave of another domain lists topics": RowStatus.NOT_VISIBLE,
    }
    assert differing(FAST, "production") == vendors
    assert differing(FAST, "sros2") == vendors | {
        "an enclave without a policy publishes": RowStatus.HEARD,
        "old permissions put back after renewal": RowStatus.HEARD,
    }
    of_2_9_1 = replace(FAST, dds="Fast DDS 2.9.1")
    assert {
        name for name, end in differing(of_2_9_1, "sros2").items() if end is RowStatus.HEARD
    } == {
        "an enclave without a policy publishes",
        "old permissions put back after renewal",
        "permissions signed by the enclave itself",
        "permissions and governance signed by the enclave",
    }


def test_a_defense_that_a_vendor_has_in_another_form_is_removed_in_that_form() -> None:
    holding = conditions(FAST, load_template("production"), "rt/chatter")
    twins = {
        row.name: row.with_expected_status(holding) for row in ATTACKS.rows if row.defence_removed
    }
    assert (
        twins["permissions borrowed, subjects not unique"].defence_removed
        == "a unique subject name"
    )
    for name, row in twins.items():
        assert row.expected in OPEN, name


@pytest.mark.parametrize(
    ("version", "exact"), [("0.10.2", False), ("0.10.5", False), ("11.0.1", True)]
)
def test_which_cyclone_dds_knows_its_signers(version: str, exact: bool) -> None:
    cyclone = Backend("cyclone", f"Cyclone DDS {version}", "a test")
    assert (C.EXACT_SIGNER in conditions(cyclone, load_template("sros2"), "rt/a")) is exact
