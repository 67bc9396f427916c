"""The governance scenario: the same messages unprotected, signed and encrypted."""

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
from sros_tool.demo.scenarios.policies import talking_policy

_KINDS = {
    "none": Undefended(template=forger.unprotected),
    "sign": Undefended(template=forger.signed),
    "encrypt": Undefended(template=forger.encrypted),
}
"""The keystore of each protection kind."""

_MECHANISMS = {
    "none": "access is controlled, but messages are neither signed nor encrypted",
    "sign": "messages carry a message authentication code, but are not encrypted",
    "encrypt": "messages are encrypted",
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
    _changed("none", RowStatus.DECEIVED, "nothing in the packet proves who sent it"),
    _changed(
        "sign",
        RowStatus.NOT_DECEIVED,
        "the message authentication code of a changed packet is wrong",
    ),
)

GOVERNANCE = Scenario(
    "governance",
    "the same messages unprotected, signed and encrypted, on the wire",
    (*(_row(kind) for kind in _KINDS), *_CHANGES),
    {
        "talker": "/talker_listener/talker",
        "listener": "/talker_listener/listener",
    },
    talking_policy,
)
