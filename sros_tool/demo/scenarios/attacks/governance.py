"""Attacks with a governance document that protects less."""

from __future__ import annotations

from sros_tool.demo.model import (
    UNSECURED,
    Row,
    Status,
)
from sros_tool.demo.scenarios.attacks.kinds import injection

ROWS: tuple[Row, ...] = (
    *(
        injection(
            label,
            UNSECURED,
            Status.NOT_LET_IN,
            "the listener's DDS verifies the signature of the permissions CA",
            attack="weaker governance",
            victims=label,
            tampered=True,
        )
        for label in ("governance edited", "governance of another CA")
    ),
    injection(
        "an older, weaker governance put back",
        UNSECURED,
        Status.HEARD,
        "what the CA has signed holds for ever: governance has no dates",
        attack="weaker governance",
        victims="old governance",
        tampered=True,
        open_because="DDS Security 1.1 cannot revoke a governance document",
        remedy="after strengthening the governance: `sros rotate_ca`, so that nobody trusts the CA"
        " that signed the weaker one",
    ),
    injection(
        "weaker governance, signed by the permissions CA",
        UNSECURED,
        Status.HEARD,
        "the listener lets everybody in",
        attack="weaker governance",
        removed="the wrong signature",
        victims="strangers allowed",
        crowd=False,
    ),
)
