"""Governance: the same talk without protection, signed, and encrypted; and what that costs."""

from __future__ import annotations

from sros_tool.demo.model import (
    Claim,
    Identity,
    Party,
    Relation,
    Role,
    Row,
    Scenario,
    Status,
)
from sros_tool.demo.policies import measured_policy

KINDS = ("none", "sign", "encrypt")

_MECHANISMS = {
    "none": "access is controlled, and messages travel as they are",
    "sign": "messages carry a code that proves who sent them, and travel in clear",
    "encrypt": "messages travel encrypted",
}


def _row(kind: str) -> Row:
    expected = Status.NOT_READABLE if kind == "encrypt" else Status.READABLE
    label = f"protection {kind}"
    return Row(
        f"payload on the wire under {kind}",
        expected,
        _MECHANISMS[kind],
        (
            Party("talker", Role.TALKER, Identity(label, "talker")),
            Party("listener", Role.LISTENER, Identity(label, "listener")),
        ),
        (Claim(Relation.READABLE, "talker").expecting(expected),),
        (Claim(Relation.HEARS, "listener", "talker"),),
        wire=True,
        brief=True,
    )


def _changed(kind: str, expected: Status, mechanism: str) -> Row:
    label = f"protection {kind}"
    return Row(
        f"changed packets under {kind}",
        expected,
        mechanism,
        (
            Party("talker", Role.TALKER, Identity(label, "talker")),
            Party("listener", Role.LISTENER, Identity(label, "listener")),
        ),
        (Claim(Relation.BELIEVES, "listener", "talker").expecting(expected),),
        (Claim(Relation.HEARS, "listener", "talker"),),
        forge="talker",
        brief=True,
    )


_CHANGES = (
    _changed("none", Status.DECEIVED, "nothing proves that the packet is the talker's"),
    _changed("sign", Status.NOT_DECEIVED, "its code does not fit a changed packet"),
)

GOVERNANCE = Scenario(
    "governance",
    "the same talk without protection, signed and encrypted: on the wire, and its cost",
    (*(_row(kind) for kind in KINDS), *_CHANGES),
    {
        "talker": "/talker_listener/talker",
        "listener": "/talker_listener/listener",
        "ping": "/cost/ping",
        "pong": "/cost/pong",
    },
    measured_policy,
    measured=KINDS,
)
