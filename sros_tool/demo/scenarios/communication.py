"""The scenarios of ordinary communication: isolation, services, actions, composition, governance.

Every row that expects silence or a refusal has a control: another listener that must hear the same
messages, or the same program in an enclave with permission.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

from sros_tool.demo import forger
from sros_tool.demo.forger import Undefended
from sros_tool.demo.scenarios.model import (
    ACTION,
    FOREIGN,
    OWN,
    SERVICE,
    UNSECURED,
    Claim,
    Identity,
    Party,
    Relation,
    Role,
    Row,
    RowStatus,
    Scenario,
    answered,
    composed_policy,
    hears,
    known_open,
    shipped_action_policy,
    shipped_service_policy,
    talker_and_listener,
    talking_policy,
)

TALKER = Identity(OWN, "talker")
LISTENER = Identity(OWN, "listener")
TALKER_DENIED = Identity(OWN, "talker without permission")


def _refused_process_row(name: str, mechanism: str, intruder: Party, rightful: Party) -> Row:
    """Return a row in which a process is refused; the control is its program in another enclave."""
    return Row(
        name,
        RowStatus.REFUSED,
        mechanism,
        (intruder, rightful),
        (Claim(Relation.IS_REFUSED, intruder.name),),
        (Claim(Relation.STARTS, rightful.name),),
    )


# ── isolation ──────────────────────────────────────────────────────────────────────────────

_SECURED_TALKER = Party("secured talker", Role.TALKER, TALKER)
_SECURED_LISTENER = Party("secured listener", Role.LISTENER, LISTENER)
_OPEN_TALKER = Party("unsecured talker", Role.TALKER)
_OPEN_LISTENER = Party("unsecured listener", Role.LISTENER)
_DENIED_TALKER = Party("talker without permission", Role.TALKER, TALKER_DENIED)
_DENIED_LISTENER = Party(
    "listener without permission", Role.LISTENER, Identity(OWN, "listener without permission")
)
_FOREIGN_TALKER = Party("foreign talker", Role.TALKER, Identity(FOREIGN, "talker"))
_FOREIGN_LISTENER = Party("foreign listener", Role.LISTENER, Identity(FOREIGN, "listener"))
_OTHER_OPEN_TALKER = Party("unsecured talker on another topic", Role.TALKER, other_topic=True)
_OBSERVER = Party("observer", Role.OBSERVER)
_SECURED_HEARS = hears("secured listener", "secured talker")
_OPEN_HEARS = hears("unsecured listener", "unsecured talker")
_OPEN_HEARS_NOT = hears("unsecured listener", "secured talker", holds=False)
_SECURED_HEARS_NOT = hears("secured listener", "unsecured talker", holds=False)

ROWS: tuple[Row, ...] = (
    Row(
        "secured talker to secured listener",
        RowStatus.HEARD,
        "both have a certificate of the same CA, and permission for the topic",
        (_SECURED_TALKER, _SECURED_LISTENER),
        (_SECURED_HEARS,),
    ),
    Row(
        "unsecured talker to unsecured listener",
        RowStatus.HEARD,
        "no security on either side: the control of all rows below",
        (_OPEN_TALKER, _OPEN_LISTENER),
        (_OPEN_HEARS,),
    ),
    Row(
        "secured talker to unsecured listener",
        RowStatus.NOT_HEARD,
        "a listener that cannot authenticate gets no keys and no messages",
        (_SECURED_TALKER, _OPEN_LISTENER, _SECURED_LISTENER),
        (_OPEN_HEARS_NOT,),
        (_SECURED_HEARS,),
    ),
    Row(
        "unsecured talker to secured listener",
        RowStatus.NOT_HEARD,
        "a secured listener ignores a talker that cannot authenticate",
        (_OPEN_TALKER, _SECURED_LISTENER, _OPEN_LISTENER),
        (_SECURED_HEARS_NOT,),
        (_OPEN_HEARS,),
    ),
    _refused_process_row(
        "secured listener without permission",
        "its DDS refuses the DataReader: the signed permissions do not allow the topic",
        _DENIED_LISTENER,
        _SECURED_LISTENER,
    ),
    _refused_process_row(
        "secured talker without permission",
        "its DDS refuses the DataWriter: the signed permissions do not allow the topic",
        _DENIED_TALKER,
        _SECURED_TALKER,
    ),
    Row(
        "talker of another keystore to secured listener",
        RowStatus.NOT_HEARD,
        "the listener does not trust the other CA: the handshake fails, and no keys are sent",
        (_FOREIGN_TALKER, _SECURED_LISTENER, _FOREIGN_LISTENER),
        (hears("secured listener", "foreign talker", holds=False),),
        (hears("foreign listener", "foreign talker"),),
    ),
    Row(
        "both pairs side by side on one topic",
        RowStatus.UNDISTURBED,
        "each listener hears the talker of its pair, and nothing from the other pair",
        (_SECURED_TALKER, _SECURED_LISTENER, _OPEN_TALKER, _OPEN_LISTENER),
        (_SECURED_HEARS, _OPEN_HEARS, _SECURED_HEARS_NOT, _OPEN_HEARS_NOT),
    ),
    Row(
        "secured talker in an unsecured node's view",
        RowStatus.NOT_VISIBLE,
        "endpoint discovery is encrypted: the node sees no publisher of the secured topic",
        (_SECURED_TALKER, _OTHER_OPEN_TALKER, _OBSERVER),
        (Claim(Relation.SEES, "observer", "secured talker", holds=False),),
        (Claim(Relation.SEES, "observer", "unsecured talker on another topic"),),
    ),
    Row(
        "unsecured payload on the wire",
        RowStatus.READABLE,
        "the text is readable in the packets",
        (_OPEN_TALKER, _OPEN_LISTENER),
        (Claim(Relation.READABLE, "unsecured talker"),),
        (_OPEN_HEARS,),
        wire=True,
    ),
    Row(
        "secured payload on the wire",
        RowStatus.NOT_READABLE,
        "every packet with data is encrypted",
        (_SECURED_TALKER, _SECURED_LISTENER),
        (Claim(Relation.READABLE, "secured talker", holds=False),),
        (_SECURED_HEARS,),
        wire=True,
    ),
)

_TALKER_AND_LISTENER = {
    "talker": "/talker_listener/talker",
    "listener": "/talker_listener/listener",
}
ISOLATION = Scenario(
    "isolation",
    "nobody hears or joins secured nodes without permission",
    ROWS,
    {
        **_TALKER_AND_LISTENER,
        "talker without permission": "/talker_listener/talker_without_permission",
        "listener without permission": "/talker_listener/listener_without_permission",
    },
    talking_policy,
)


# ── services and actions ───────────────────────────────────────────────────────────────────


class _Interface(NamedTuple):
    """A service or action: its ROS name, and the roles and names of both sides.

    ``asks`` and ``answers`` are the words of policies for the two rights, such as call and serve.
    """

    name: str
    client_role: Role
    server_role: Role
    client: str
    server: str
    asks: str
    answers: str

    def party(self, name: str, role: Role, identity: Identity = UNSECURED) -> Party:
        """Return a party that uses this service or action."""
        return Party(name, role, identity, self.name)

    def pair(self, *, secured: bool) -> tuple[Party, Party]:
        """Return a client and a server, with the rights that they need, or unsecured."""
        identities = (
            (Identity(OWN, "client"), Identity(OWN, "server")) if secured else (UNSECURED,) * 2
        )
        before = "" if secured else "unsecured "
        return (
            self.party(f"{before}{self.client}", self.client_role, identities[0]),
            self.party(f"{before}{self.server}", self.server_role, identities[1]),
        )


def _rows_of(kind: _Interface, pair_meaning: str) -> tuple[Row, ...]:
    """Return the rows of a service or action; ``pair_meaning`` explains the secured pair."""
    client, server = kind.pair(secured=True)
    open_client, open_server = kind.pair(secured=False)
    client_as_server = kind.party("client as a server", kind.server_role, Identity(OWN, "client"))
    calling = kind.party("server as a client", kind.client_role, Identity(OWN, "server"))
    may_not = "its permissions allow it to {}, not to {}"
    return (
        _answered_call_row(
            f"secured client of a secured {kind.server}", pair_meaning, client, server
        ),
        _answered_call_row(
            f"unsecured client of an unsecured {kind.server}",
            "no security on either side, for comparison with the rows below",
            open_client,
            open_server,
        ),
        Row(
            f"unsecured client of a secured {kind.server}",
            RowStatus.NOT_ANSWERED,
            "a server ignores a client that cannot authenticate, and sends it no answer",
            (open_client, server, client),
            (answered(open_client.name, server.name, holds=False),),
            (answered(client.name, server.name),),
        ),
        Row(
            f"unsecured {kind.server} to a secured client",
            RowStatus.NOT_ANSWERED,
            "a client sends no request to a server that cannot authenticate",
            (open_server, client, open_client),
            (answered(client.name, open_server.name, holds=False),),
            (answered(open_client.name, open_server.name),),
        ),
        _refused_process_row(
            f"client that poses as the {kind.server}",
            may_not.format(kind.asks, kind.answers),
            client_as_server,
            server,
        ),
        _refused_process_row(
            f"{kind.server} that poses as the {kind.client}",
            may_not.format(kind.answers, kind.asks),
            calling,
            client,
        ),
    )


def _answered_call_row(name: str, mechanism: str, client: Party, server: Party) -> Row:
    claims = (answered(client.name, server.name),)
    return Row(name, RowStatus.ANSWERED, mechanism, (client, server), claims, brief=True)


_SERVICE = _Interface(SERVICE, Role.CLIENT, Role.SERVER, "client", "server", "request", "reply")


def _wire_row(expected: RowStatus, mechanism: str, *, secured: bool) -> Row:
    client, server = _SERVICE.pair(secured=secured)
    return Row(
        f"answers on the wire, {'secured' if secured else 'unsecured'}",
        expected,
        mechanism,
        (server, client),
        (Claim(Relation.READABLE, server.name).expecting(expected),),
        (answered(client.name, server.name),),
        wire=True,
        brief=True,
    )


SERVICES = Scenario(
    "services",
    "add_two_ints: who may call and who may serve",
    (
        *_rows_of(
            _SERVICE, "the client may send requests and receive replies, the server the reverse"
        ),
        _wire_row(RowStatus.READABLE, "the text is readable in the packets", secured=False),
        _wire_row(
            RowStatus.NOT_READABLE, "requests and replies are encrypted like topics", secured=True
        ),
    ),
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

ACTIONS = Scenario(
    "actions",
    "Fibonacci: who may call an action and who may execute it",
    _rows_of(
        _ACTION, "goal, feedback, status and result arrive, over three services and two topics"
    ),
    {"server": f"{ACTION}/server", "client": f"{ACTION}/client"},
    shipped_action_policy,
)


# ── composition ────────────────────────────────────────────────────────────────────────────

_CONTAINER = Party("container", Role.COMPOSED, Identity(OWN, "container"))
_TALKING, _LISTENING = talker_and_listener(OWN)
_CLIENT = Party("client", Role.CLIENT, Identity(OWN, "client"), SERVICE)
_COMPROMISED = Party("compromised listener node", Role.TALKER, Identity(OWN, "container"))

COMPOSITION = Scenario(
    "composition",
    "several nodes in one process share one enclave",
    (
        Row(
            "listener of a container hears a talker",
            RowStatus.HEARD,
            "the enclave of the container may subscribe to the topic",
            (_CONTAINER, _TALKING),
            (hears("container", "talker"),),
            brief=True,
        ),
        Row(
            "talker of a container is heard by a listener",
            RowStatus.HEARD,
            "the enclave of the container may publish the topic",
            (_CONTAINER, _LISTENING),
            (hears("listener", "container"),),
            brief=True,
        ),
        _answered_call_row(
            "server of a container answers a client",
            "the enclave of the container may reply",
            _CLIENT,
            _CONTAINER,
        ),
        Row(
            "unsecured listener hears a container",
            RowStatus.NOT_HEARD,
            "all nodes of the process share one participant, so all of them are protected",
            (_CONTAINER, _OPEN_LISTENER, _LISTENING),
            (hears("unsecured listener", "container", holds=False),),
            (hears("listener", "container"),),
        ),
        _refused_process_row(
            "container in the enclave of one of its nodes",
            "the enclave lacks the rights of the other nodes in the process",
            Party("container as a listener", Role.COMPOSED, LISTENER),
            _LISTENING,
        ),
        known_open(
            Row(
                "listener node with the rights of its container publishes",
                RowStatus.HEARD,
                "DDS cannot distinguish the nodes of a process: they share the sum of their rights",
                (_COMPROMISED, _LISTENING),
                (hears("listener", _COMPROMISED.name),),
                brief=True,
                attack="a node uses the rights of another node in its process",
            ),
            "one process is one participant with one enclave",
            "run nodes that must not share rights in separate processes and enclaves",
        ),
        _refused_process_row(
            "listener node in a separate enclave publishes",
            "its enclave has only the rights of the listener",
            Party("listener that talks", Role.TALKER, LISTENER),
            _TALKING,
        ),
    ),
    {
        "container": "/composition",
        **_TALKER_AND_LISTENER,
        "client": f"{SERVICE}/client",
    },
    composed_policy,
)


# ── governance ─────────────────────────────────────────────────────────────────────────────

_KINDS = {
    "none": Undefended(template=forger.unprotected),
    "sign": Undefended(template=forger.signed),
    "encrypt": Undefended(template=forger.encrypted),
}
"""Maps the name of a protection kind to a keystore that has this protection."""


def _payload_row(name: str, kind: str, expected: RowStatus, mechanism: str) -> Row:
    """Return a row that looks for readable payload in packets, with one protection kind."""
    return Row(
        f"{name} under {kind}",
        expected,
        mechanism,
        talker_and_listener(_KINDS[kind]),
        (Claim(Relation.READABLE, "talker").expecting(expected),),
        (hears("listener", "talker"),),
        wire=True,
        brief=True,
    )


def _changed_packets_row(kind: str, expected: RowStatus, mechanism: str) -> Row:
    """Return a row in which somebody changes packets that have the protection ``kind``."""
    return replace(
        _payload_row("changed packets", kind, RowStatus.READABLE, mechanism),
        expected=expected,
        claims=(Claim(Relation.BELIEVES, "listener", "talker").expecting(expected),),
        wire=False,
        impersonate="talker",
    )


_PAYLOAD = "payload on the wire"
GOVERNANCE = Scenario(
    "governance",
    "the same messages unprotected, signed and encrypted, on the wire",
    (
        _payload_row(
            _PAYLOAD,
            "none",
            RowStatus.READABLE,
            "access is controlled, but messages are neither signed nor encrypted",
        ),
        _payload_row(
            _PAYLOAD,
            "sign",
            RowStatus.READABLE,
            "messages carry a message authentication code, but are not encrypted",
        ),
        _payload_row(_PAYLOAD, "encrypt", RowStatus.NOT_READABLE, "messages are encrypted"),
        _changed_packets_row(
            "none", RowStatus.DECEIVED, "nothing in the packet proves who sent it"
        ),
        _changed_packets_row(
            "sign",
            RowStatus.NOT_DECEIVED,
            "the message authentication code of a changed packet is wrong",
        ),
    ),
    _TALKER_AND_LISTENER,
    talking_policy,
)
