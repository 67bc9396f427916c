"""The scenario of all known attacks, each with a control, and again without its defence.

The attacker is the intruder of the row.  A row that expects the attack to fail has a control: the
same listener must hear the permitted talker at the same time.  A row with ``removed`` shows that
the same attack succeeds without that defence: an attack that never works would prove nothing.
"""

from __future__ import annotations

from sros_tool.demo.scenarios.attacks import (
    documents,
    identities,
    network,
    rights,
    variables,
)
from sros_tool.demo.scenarios.model import Row, Scenario
from sros_tool.demo.scenarios.policies import GUEST, SERVICE, attacked_policy

_ROWS: tuple[Row, ...] = (
    *network.ROWS,
    *rights.ROWS,
    *identities.ROWS,
    *documents.ROWS,
    *variables.ROWS,
)

ATTACKS = Scenario(
    "attacks",
    "all attacks that sros knows, also without the defences that stop them",
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
