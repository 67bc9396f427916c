"""Actions: goals, feedback, status and results, by the one word call or execute."""

from __future__ import annotations

from sros_tool.demo.model import Role, Scenario
from sros_tool.demo.policies import ACTION, shipped_action_policy
from sros_tool.demo.scenarios.asking import Asking, asking_rows

_KIND = Asking(
    ACTION,
    Role.ACTION_CLIENT,
    Role.ACTION_SERVER,
    "action client",
    "action server",
    "call",
    "execute",
)

ROWS = asking_rows(_KIND, "goal, feedback, status and result arrive: three services and two topics")

ACTIONS = Scenario(
    "actions",
    "Fibonacci: who may call an action and who may execute it",
    ROWS,
    {"server": f"{ACTION}/server", "client": f"{ACTION}/client"},
    shipped_action_policy,
)
