"""Actions: goals, feedback, status and results, by the one word call or execute."""

from __future__ import annotations

from sros_tool.demo.model import (
    OWN,
    UNSECURED,
    Claim,
    Identity,
    Party,
    Relation,
    Role,
    Row,
    Scenario,
    Status,
)
from sros_tool.demo.policies import ACTION, shipped_action_policy

_SERVER = Party("action server", Role.ACTION_SERVER, Identity(OWN, "server"), ACTION)
_CLIENT = Party("action client", Role.ACTION_CLIENT, Identity(OWN, "client"), ACTION)
_OPEN_SERVER = Party("unsecured action server", Role.ACTION_SERVER, UNSECURED, ACTION)
_OPEN_CLIENT = Party("unsecured action client", Role.ACTION_CLIENT, UNSECURED, ACTION)
_POSING = Party("client as a server", Role.ACTION_SERVER, Identity(OWN, "client"), ACTION)
_CALLING = Party("server as a client", Role.ACTION_CLIENT, Identity(OWN, "server"), ACTION)


def _answered(client: str, server: str, *, holds: bool = True) -> Claim:
    return Claim(Relation.IS_ANSWERED, client, server, holds=holds)


ROWS: tuple[Row, ...] = (
    Row(
        "secured client of a secured action server",
        Status.ANSWERED,
        "goal, feedback, status and result arrive: three services and two topics",
        (_CLIENT, _SERVER),
        (_answered("action client", "action server"),),
        brief=True,
    ),
    Row(
        "unsecured client of an unsecured action server",
        Status.ANSWERED,
        "no security on either side: the control of the rows below",
        (_OPEN_CLIENT, _OPEN_SERVER),
        (_answered("unsecured action client", "unsecured action server"),),
        brief=True,
    ),
    Row(
        "unsecured client of a secured action server",
        Status.NOT_ANSWERED,
        "who cannot authenticate can neither send goals nor see feedback",
        (_OPEN_CLIENT, _SERVER, _CLIENT),
        (_answered("unsecured action client", "action server", holds=False),),
        (_answered("action client", "action server"),),
    ),
    Row(
        "unsecured action server to a secured client",
        Status.NOT_ANSWERED,
        "a client sends its goals to nobody who cannot authenticate",
        (_OPEN_SERVER, _CLIENT, _OPEN_CLIENT),
        (_answered("action client", "unsecured action server", holds=False),),
        (_answered("unsecured action client", "unsecured action server"),),
    ),
    Row(
        "client that executes",
        Status.REFUSED,
        "its permissions allow to call the action, not to execute it",
        (_POSING, _SERVER),
        (Claim(Relation.IS_REFUSED, "client as a server"),),
        (Claim(Relation.STARTS, "action server"),),
    ),
    Row(
        "server that calls",
        Status.REFUSED,
        "its permissions allow to execute the action, not to call it",
        (_CALLING, _CLIENT),
        (Claim(Relation.IS_REFUSED, "server as a client"),),
        (Claim(Relation.STARTS, "action client"),),
    ),
)

ACTIONS = Scenario(
    "actions",
    "Fibonacci: who may call an action and who may execute it",
    ROWS,
    {"server": "/fibonacci/server", "client": "/fibonacci/client"},
    shipped_action_policy,
)
