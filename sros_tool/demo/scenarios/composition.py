"""The composition scenario: nodes of one process share one enclave and the sum of their rights."""

from __future__ import annotations

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
from sros_tool.demo.scenarios.policies import SERVICE, composed_policy

_CONTAINER = Party("container", Role.COMPOSED, Identity(OWN, "container"))
_TALKER = Party("talker", Role.TALKER, Identity(OWN, "talker"))
_LISTENER = Party("listener", Role.LISTENER, Identity(OWN, "listener"))
_CLIENT = Party("client", Role.CLIENT, Identity(OWN, "client"), SERVICE)
_OPEN_LISTENER = Party("unsecured listener", Role.LISTENER, UNSECURED)

_ROWS: tuple[Row, ...] = (
    Row(
        "listener of a container hears a talker",
        RowStatus.HEARD,
        "the enclave of the container may subscribe to the topic",
        (_CONTAINER, _TALKER),
        (Claim(Relation.HEARS, "container", "talker"),),
        brief=True,
    ),
    Row(
        "talker of a container is heard by a listener",
        RowStatus.HEARD,
        "the enclave of the container may publish the topic",
        (_CONTAINER, _LISTENER),
        (Claim(Relation.HEARS, "listener", "container"),),
        brief=True,
    ),
    Row(
        "server of a container answers a client",
        RowStatus.ANSWERED,
        "the enclave of the container may reply",
        (_CONTAINER, _CLIENT),
        (Claim(Relation.IS_ANSWERED, "client", "container"),),
        brief=True,
    ),
    Row(
        "unsecured listener hears a container",
        RowStatus.NOT_HEARD,
        "all nodes of the process share one participant, so all of them are protected",
        (_CONTAINER, _OPEN_LISTENER, _LISTENER),
        (Claim(Relation.HEARS, "unsecured listener", "container", holds=False),),
        (Claim(Relation.HEARS, "listener", "container"),),
    ),
    Row(
        "container in the enclave of one of its nodes",
        RowStatus.REFUSED,
        "the enclave lacks the rights of the other nodes in the process",
        (Party("container as a listener", Role.COMPOSED, Identity(OWN, "listener")), _LISTENER),
        (Claim(Relation.IS_REFUSED, "container as a listener"),),
        (Claim(Relation.STARTS, "listener"),),
    ),
    Row(
        "listener node with the rights of its container publishes",
        RowStatus.HEARD,
        "DDS cannot distinguish the nodes of a process: they share the sum of their rights",
        (
            Party("compromised listener node", Role.TALKER, Identity(OWN, "container")),
            _LISTENER,
        ),
        (Claim(Relation.HEARS, "listener", "compromised listener node"),),
        brief=True,
        attack="a node uses the rights of another node in its process",
        open_because="one process is one participant with one enclave",
        remedy="run nodes that must not share rights in separate processes and enclaves",
    ),
    Row(
        "listener node in a separate enclave publishes",
        RowStatus.REFUSED,
        "its enclave has only the rights of the listener",
        (
            Party("listener that talks", Role.TALKER, Identity(OWN, "listener")),
            _TALKER,
        ),
        (Claim(Relation.IS_REFUSED, "listener that talks"),),
        (Claim(Relation.STARTS, "talker"),),
    ),
)

COMPOSITION = Scenario(
    "composition",
    "several nodes in one process share one enclave",
    _ROWS,
    {
        "container": "/composition",
        "talker": "/talker_listener/talker",
        "listener": "/talker_listener/listener",
        "client": f"{SERVICE}/client",
    },
    composed_policy,
)
