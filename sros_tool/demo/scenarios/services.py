"""Services: who may ask, who may answer, and that nobody else can do either."""

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
from sros_tool.demo.policies import SERVICE, shipped_service_policy

_SERVER = Party("server", Role.SERVER, Identity(OWN, "server"), SERVICE)
_CLIENT = Party("client", Role.CLIENT, Identity(OWN, "client"), SERVICE)
_OPEN_SERVER = Party("unsecured server", Role.SERVER, UNSECURED, SERVICE)
_OPEN_CLIENT = Party("unsecured client", Role.CLIENT, UNSECURED, SERVICE)
_POSING_SERVER = Party("client as a server", Role.SERVER, Identity(OWN, "client"), SERVICE)
_ASKING_SERVER = Party("server as a client", Role.CLIENT, Identity(OWN, "server"), SERVICE)


def _answered(client: str, server: str, *, holds: bool = True) -> Claim:
    return Claim(Relation.IS_ANSWERED, client, server, holds=holds)


ROWS: tuple[Row, ...] = (
    Row(
        "secured client of a secured server",
        Status.ANSWERED,
        "one may send requests and receive replies, the other one the opposite",
        (_CLIENT, _SERVER),
        (_answered("client", "server"),),
        brief=True,
    ),
    Row(
        "unsecured client of an unsecured server",
        Status.ANSWERED,
        "no security on either side: the control of the rows below",
        (_OPEN_CLIENT, _OPEN_SERVER),
        (_answered("unsecured client", "unsecured server"),),
        brief=True,
    ),
    Row(
        "unsecured client of a secured server",
        Status.NOT_ANSWERED,
        "who cannot authenticate is not heard, and would get no reply",
        (_OPEN_CLIENT, _SERVER, _CLIENT),
        (_answered("unsecured client", "server", holds=False),),
        (_answered("client", "server"),),
    ),
    Row(
        "unsecured server to a secured client",
        Status.NOT_ANSWERED,
        "a client sends its requests to nobody who cannot authenticate",
        (_OPEN_SERVER, _CLIENT, _OPEN_CLIENT),
        (_answered("client", "unsecured server", holds=False),),
        (_answered("unsecured client", "unsecured server"),),
    ),
    Row(
        "client that poses as the server",
        Status.REFUSED,
        "its permissions allow to ask, not to reply",
        (_POSING_SERVER, _SERVER),
        (Claim(Relation.IS_REFUSED, "client as a server"),),
        (Claim(Relation.STARTS, "server"),),
    ),
    Row(
        "server that asks",
        Status.REFUSED,
        "its permissions allow to reply, not to ask",
        (_ASKING_SERVER, _CLIENT),
        (Claim(Relation.IS_REFUSED, "server as a client"),),
        (Claim(Relation.STARTS, "client"),),
    ),
    Row(
        "answers on the wire, unsecured",
        Status.READABLE,
        "the text lies open in the packets",
        (_OPEN_SERVER, _OPEN_CLIENT),
        (Claim(Relation.READABLE, "unsecured server"),),
        (_answered("unsecured client", "unsecured server"),),
        wire=True,
        brief=True,
    ),
    Row(
        "answers on the wire, secured",
        Status.NOT_READABLE,
        "requests and replies are encrypted like topics",
        (_SERVER, _CLIENT),
        (Claim(Relation.READABLE, "server", holds=False),),
        (_answered("client", "server"),),
        wire=True,
    ),
)

SERVICES = Scenario(
    "services",
    "add_two_ints: who may ask and who may answer",
    ROWS,
    {"server": f"{SERVICE}/server", "client": f"{SERVICE}/client"},
    shipped_service_policy,
)
