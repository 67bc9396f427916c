"""Governance: the same talk without protection, signed, and encrypted; and what that costs."""

from __future__ import annotations

from sros_tool.demo import forger
from sros_tool.demo.forger import Undefended
from sros_tool.demo.scenarios.model import (
    Claim,
    Identity,
    Party,
    Relation,
    Role,
    Row,
    RowStatus,
    Scenario,
)
from sros_tool.demo.scenarios.policies import measured_policy

_KINDS = {
    "none": Undefended(template=forger.unprotected),
    "sign": Undefended(template=forger.signed),
    "encrypt": Undefended(template=forger.encrypted),
}
"""The keystore of each protection kind."""

_MECHANISMS = {
    "none": "access is controlled, and messages travel as they are",
    "sign": "messages carry a code that proves who sent them, and travel in clear",
    "encrypt": "messages travel encrypted",
}


def _row(kind: str) -> Row:
    expected = RowStatus.NOT_READABLE if kind == "encrypt" else RowStatus.READABLE
    return Row(
        f"payload on the wire under {kind}",
        expected,
        _MECHANISMS[kind],
        (
            Party("talker", Role.TALKER, Identity(_KINDS[kind], "talker")),
            Party("listener", Role.LISTENER, Identity(_KINDS[kind], "listener")),
        ),
        (Claim(Relation.READABLE, "talker").expecting(expected),),
        (Claim(Relation.HEARS, "listener", "talker"),),
        wire=True,
        brief=True,
    )


def _changed(kind: str, expected: RowStatus, mechanism: str) -> Row:
    return Row(
        f"changed packets under {kind}",
        expected,
        mechanism,
        (
            Party("talker", Role.TALKER, Identity(_KINDS[kind], "talker")),
            Party("listener", Role.LISTENER, Identity(_KINDS[kind], "listener")),
        ),
        (Claim(Relation.BELIEVES, "listener", "talker").expecting(expected),),
        (Claim(Relation.HEARS, "listener", "talker"),),
        impersonate="talker",
        brief=True,
    )


_CHANGES = (
    _changed("none", RowStatus.DECEIVED, "nothing proves that the packet is the talker's"),
    _changed("sign", RowStatus.NOT_DECEIVED, "its code does not fit a changed packet"),
)

GOVERNANCE = Scenario(
    "governance",
    "the same talk without protection, signed and encrypted: on the wire, and its cost",
    (*(_row(kind) for kind in _KINDS), *_CHANGES),
    {
        "talker": "/talker_listener/talker",
        "listener": "/talker_listener/listener",
        "ping": "/cost/ping",
        "pong": "/cost/pong",
    },
    measured_policy,
    measured=_KINDS,
)
