"""What a template and a vendor let one expect of the attacks."""

from __future__ import annotations

from dataclasses import replace

import pytest

from sros_tool.demo.backend import Backend
from sros_tool.demo.conditions import conditions
from sros_tool.demo.model import Condition, Status
from sros_tool.demo.scenarios.attacks import ATTACKS
from sros_tool.keystore.template import Template, load_template
from sros_tool.policy.protection import Level, NamedProtection, TopicProtection

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
         "rt/a", {C.IN_CLEAR, C.UNCONTROLLED, C.STRANGERS, C.STRANGERS_SEE}),
        (protected(rtps=Level.NONE, named=(NamedProtection("topics", "/a", BARE),)), "rt/a",
         {C.IN_CLEAR, C.UNCONTROLLED}),
        (protected(rtps=Level.NONE, named=(NamedProtection("topics", "/a", BARE),)), "rt/b", set()),
    ],
)  # fmt: skip
def test_templates(template: Template, topic: str, holding: set[Condition]) -> None:
    assert conditions(CYCLONE, template, topic) == holding | {C.CYCLONE}
    assert conditions(FAST, template, topic) == holding | {C.FAST}


def outcomes(backend: Backend, template: str) -> dict[str, Status]:
    holding = conditions(backend, load_template(template), "rt/chatter")
    rows = [row.under(holding) for row in ATTACKS.rows]
    return {row.name: Status.SKIPPED if row.skipped else row.expected for row in rows}


def test_what_differs_between_templates_and_vendors() -> None:
    production = outcomes(CYCLONE, "production")

    def differing(backend: Backend, template: str) -> dict[str, Status]:
        found = outcomes(backend, template)
        return {name: found[name] for name in found if found[name] is not production[name]}

    assert not differing(CYCLONE, "production")
    shared = {
        "an enclave without a policy publishes": Status.HEARD,
        "permissions borrowed from a longer name": Status.HEARD,
        "old permissions put back after renewal": Status.HEARD,
    }
    assert differing(CYCLONE, "development") == shared
    assert differing(CYCLONE, "sros2") == shared | {
        "permissions signed by the enclave itself": Status.HEARD,
        "permissions and governance signed by itself": Status.HEARD,
    }
    vendors = {
        "certificate with the key of another enclave": Status.NOT_LET_IN,
        "permissions for another domain": Status.NOT_HEARD,
        "permissions signed by the enclave itself, one CA": Status.SKIPPED,
        "permissions borrowed, subjects not unique": Status.SKIPPED,
    }
    assert differing(FAST, "production") == vendors
