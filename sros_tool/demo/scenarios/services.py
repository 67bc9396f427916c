"""Services: who may ask, who may answer, and that nobody else can do either."""

from __future__ import annotations

from sros_tool.demo.model import Claim, Relation, Role, Row, Scenario, Status
from sros_tool.demo.policies import SERVICE, shipped_service_policy
from sros_tool.demo.scenarios.asking import Asking, answered, asking_rows

_KIND = Asking(SERVICE, Role.CLIENT, Role.SERVER, "client", "server", "request", "reply")


def _on_the_wire(expected: Status, mechanism: str, *, secured: bool) -> Row:
    client, server = _KIND.pair(secured=secured)
    return Row(
        f"answers on the wire, {'secured' if secured else 'unsecured'}",
        expected,
        mechanism,
        (server, client),
        (Claim(Relation.READABLE, server.name).expecting(expected),),
        (answered(client, server),),
        wire=True,
        brief=True,
    )


ROWS: tuple[Row, ...] = (
    *asking_rows(_KIND, "one may send requests and receive replies, the other one the opposite"),
    _on_the_wire(Status.READABLE, "the text lies open in the packets", secured=False),
    _on_the_wire(
        Status.NOT_READABLE, "requests and replies are encrypted like topics", secured=True
    ),
)

SERVICES = Scenario(
    "services",
    "add_two_ints: who may ask and who may answer",
    ROWS,
    {"server": f"{SERVICE}/server", "client": f"{SERVICE}/client"},
    shipped_service_policy,
)
