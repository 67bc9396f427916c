"""The scenarios `services` and `actions`: who may call, and who may serve, in the same rows."""

from __future__ import annotations

from dataclasses import dataclass

from sros_tool.demo.scenarios.model import (
    OWN,
    UNSECURED,
    Claim,
    Identity,
    Party,
    Relation,
    Role,
    Row,
    RowStatus,
    Scenario,
)
from sros_tool.demo.scenarios.policies import (
    ACTION,
    SERVICE,
    shipped_action_policy,
    shipped_service_policy,
)


@dataclass(frozen=True)
class _Interface:
    """A service or action: its ROS name, and the roles and names of both sides.

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
        """Return a party of this service or action."""
        return Party(name, role, identity, self.name)

    def pair(self, *, secured: bool) -> tuple[Party, Party]:
        """Return a client and a server, either with the rights that they need or unsecured."""
        own = (Identity(OWN, "client"), Identity(OWN, "server")) if secured else (UNSECURED,) * 2
        before = "" if secured else "unsecured "
        return (
            self.party(f"{before}{self.client}", self.client_role, own[0]),
            self.party(f"{before}{self.server}", self.server_role, own[1]),
        )


def _rows_of(kind: _Interface, both: str) -> tuple[Row, ...]:
    """Return the rows of a service or action; ``both`` is the mechanism of the secured pair."""
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
            RowStatus.NOT_ANSWERED,
            "a server ignores a client that cannot authenticate, and would send it no answer",
            (open_client, server, client),
            (_is_answered(open_client, server, holds=False),),
            (_is_answered(client, server),),
        ),
        Row(
            f"unsecured {kind.server} to a secured client",
            RowStatus.NOT_ANSWERED,
            "a client sends no request to a server that cannot authenticate",
            (open_server, client, open_client),
            (_is_answered(client, open_server, holds=False),),
            (_is_answered(open_client, open_server),),
        ),
        _refused(
            f"client that poses as the {kind.server}",
            kind.asks,
            kind.answers,
            posing,
            server,
        ),
        _refused(
            f"{kind.server} that poses as the {kind.client}",
            kind.answers,
            kind.asks,
            calling,
            client,
        ),
    )


def _is_answered(client: Party, server: Party, *, holds: bool = True) -> Claim:
    """Return the claim that a client gets answers from a server, or does not."""
    return Claim(Relation.IS_ANSWERED, client.name, server.name, holds=holds)


def _answered(name: str, mechanism: str, client: Party, server: Party) -> Row:
    claims = (_is_answered(client, server),)
    return Row(name, RowStatus.ANSWERED, mechanism, (client, server), claims, brief=True)


def _refused(name: str, may: str, may_not: str, intruder: Party, rightful: Party) -> Row:
    return Row(
        name,
        RowStatus.REFUSED,
        f"its permissions allow it to {may}, not to {may_not}",
        (intruder, rightful),
        (Claim(Relation.IS_REFUSED, intruder.name),),
        (Claim(Relation.STARTS, rightful.name),),
    )


_SERVICE = _Interface(SERVICE, Role.CLIENT, Role.SERVER, "client", "server", "request", "reply")


def _on_the_wire(expected: RowStatus, mechanism: str, *, secured: bool) -> Row:
    client, server = _SERVICE.pair(secured=secured)
    return Row(
        f"answers on the wire, {'secured' if secured else 'unsecured'}",
        expected,
        mechanism,
        (server, client),
        (Claim(Relation.READABLE, server.name).expecting(expected),),
        (_is_answered(client, server),),
        wire=True,
        brief=True,
    )


_SERVICE_ROWS: tuple[Row, ...] = (
    *_rows_of(_SERVICE, "the client may send requests and receive replies, the server the reverse"),
    _on_the_wire(RowStatus.READABLE, "the text is readable in the packets", secured=False),
    _on_the_wire(
        RowStatus.NOT_READABLE, "requests and replies are encrypted like topics", secured=True
    ),
)

SERVICES = Scenario(
    "services",
    "add_two_ints: who may call and who may serve",
    _SERVICE_ROWS,
    {"server": f"{SERVICE}/server", "client": f"{SERVICE}/client"},
    shipped_service_policy,
)


_ACTION = _Interface(
    ACTION,
    Role.ACTION_CLIENT,
    Role.ACTION_SERVER,
    "action client",
    "action server",
    "call",
    "execute",
)

_ACTION_ROWS = _rows_of(
    _ACTION, "goal, feedback, status and result arrive: three services and two topics"
)

ACTIONS = Scenario(
    "actions",
    "Fibonacci: who may call an action and who may execute it",
    _ACTION_ROWS,
    {"server": f"{ACTION}/server", "client": f"{ACTION}/client"},
    shipped_action_policy,
)
