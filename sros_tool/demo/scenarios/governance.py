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


GOVERNANCE = Scenario(
    "governance",
    "the same talk without protection, signed and encrypted: on the wire, and its cost",
    tuple(_row(kind) for kind in KINDS),
    {
        "talker": "/talker_listener/talker",
        "listener": "/talker_listener/listener",
        "ping": "/cost/ping",
        "pong": "/cost/pong",
    },
    measured_policy,
    measured=KINDS,
)
