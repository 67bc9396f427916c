"""Rows of whoever asks and whoever answers: the same for services and for actions."""

from __future__ import annotations

from dataclasses import dataclass

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
from sros_tool.demo.policies import ACTION, SERVICE, shipped_action_policy, shipped_service_policy


@dataclass(frozen=True)
class Asking:
    """A service or action: its ROS name, the roles of both sides, and what they are called.

    ``asks`` and ``answers`` are the words of the policy language for the two rights.
    """

    name: str
    client_role: Role
    server_role: Role
    client: str
    server: str
    asks: str
    answers: str

    def party(self, name: str, role: Role, identity: Identity = UNSECURED) -> Party:
        """A party of this service or action."""
        return Party(name, role, identity, self.name)

    def pair(self, *, secured: bool) -> tuple[Party, Party]:
        """A client and a server, each with the rights that it needs, or both unsecured."""
        own = (Identity(OWN, "client"), Identity(OWN, "server")) if secured else (UNSECURED,) * 2
        before = "" if secured else "unsecured "
        return (
            self.party(f"{before}{self.client}", self.client_role, own[0]),
            self.party(f"{before}{self.server}", self.server_role, own[1]),
        )


def asking_rows(kind: Asking, both: str) -> tuple[Row, ...]:
    """Who is answered and who is refused; ``both`` says why a pair with its rights is answered."""
    client, server = kind.pair(secured=True)
    open_client, open_server = kind.pair(secured=False)
    posing = kind.party("client as a server", kind.server_role, Identity(OWN, "client"))
    calling = kind.party("server as a client", kind.client_role, Identity(OWN, "server"))
    return (
        _answered(f"secured client of a secured {kind.server}", both, client, server),
        _answered(
            f"unsecured client of an unsecured {kind.server}",
            "no security on either side: the control of the rows below",
            open_client,
            open_server,
        ),
        Row(
            f"unsecured client of a secured {kind.server}",
            Status.NOT_ANSWERED,
            "who cannot authenticate is not heard, and would get no answer",
            (open_client, server, client),
            (answered(open_client, server, holds=False),),
            (answered(client, server),),
        ),
        Row(
            f"unsecured {kind.server} to a secured client",
            Status.NOT_ANSWERED,
            "a client asks nobody who cannot authenticate",
            (open_server, client, open_client),
            (answered(client, open_server, holds=False),),
            (answered(open_client, open_server),),
        ),
        _refused(
            f"client that poses as the {kind.server}", kind.asks, kind.answers, posing, server
        ),
        _refused(f"{kind.server} that asks", kind.answers, kind.asks, calling, client),
    )


def answered(client: Party, server: Party, *, holds: bool = True) -> Claim:
    """That a client gets answers of a server, or does not."""
    return Claim(Relation.IS_ANSWERED, client.name, server.name, holds=holds)


def _answered(name: str, mechanism: str, client: Party, server: Party) -> Row:
    claims = (answered(client, server),)
    return Row(name, Status.ANSWERED, mechanism, (client, server), claims, brief=True)


def _refused(name: str, may: str, may_not: str, intruder: Party, rightful: Party) -> Row:
    return Row(
        name,
        Status.REFUSED,
        f"its permissions allow to {may}, not to {may_not}",
        (intruder, rightful),
        (Claim(Relation.IS_REFUSED, intruder.name),),
        (Claim(Relation.STARTS, rightful.name),),
    )


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


_ACTIONS_KIND = Asking(
    ACTION,
    Role.ACTION_CLIENT,
    Role.ACTION_SERVER,
    "action client",
    "action server",
    "call",
    "execute",
)

ACTIONS_ROWS = asking_rows(
    _ACTIONS_KIND, "goal, feedback, status and result arrive: three services and two topics"
)

ACTIONS = Scenario(
    "actions",
    "Fibonacci: who may call an action and who may execute it",
    ACTIONS_ROWS,
    {"server": f"{ACTION}/server", "client": f"{ACTION}/client"},
    shipped_action_policy,
)
