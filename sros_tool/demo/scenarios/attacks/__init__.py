"""The attacks: every known way in, each with a control, and once without its defence.

An attacker is an intruder in the row.  The control of a row that expects a closed door is the
rightful talker, whom the same listener hears at the same time.  A row with ``removed`` shows the
same attack succeed where the defence is gone: an attack that never works would prove nothing.
"""

from __future__ import annotations

from sros_tool.demo.scenarios.attacks import (
    documents,
    identities,
    rights,
    strangers,
    variables,
)
from sros_tool.demo.scenarios.model import Row, Scenario
from sros_tool.demo.scenarios.policies import GUEST, SERVICE, attacked_policy

_ROWS: tuple[Row, ...] = (
    *strangers.ROWS,
    *rights.ROWS,
    *identities.ROWS,
    *documents.ROWS,
    *variables.ROWS,
)

ATTACKS = Scenario(
    "attacks",
    "every known way in, tried; and each again without the defence that closes it",
    _ROWS,
    {
        "talker": "/talker_listener/talker",
        "listener": "/talker_listener/listener",
        "guest": GUEST,
        "admin": f"{GUEST}/admin",
        "server": f"{SERVICE}/server",
        "client": f"{SERVICE}/client",
        "newcomer": "/talker_listener/newcomer",
    },
    attacked_policy,
    unpermitted=("/talker_listener/newcomer",),
    any_keystore=True,
)
