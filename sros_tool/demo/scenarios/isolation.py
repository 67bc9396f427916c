"""The isolation scenario: nobody hears or joins secured nodes without permission.

Every row that expects silence or a refusal has a control: another listener that must hear the same
messages, or the same program in an enclave with permission.
"""

from __future__ import annotations

from sros_tool.demo.scenarios.model import (
    FOREIGN,
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
from sros_tool.demo.scenarios.policies import talking_policy

TALKER = Identity(OWN, "talker")
LISTENER = Identity(OWN, "listener")
TALKER_DENIED = Identity(OWN, "talker without permission")


def _hears(listener: str, talker: str) -> Claim:
    return Claim(Relation.HEARS, listener, talker)


def _hears_not(listener: str, talker: str) -> Claim:
    return Claim(Relation.HEARS, listener, talker, holds=False)


_SECURED_TALKER = Party("secured talker", Role.TALKER, TALKER)
_SECURED_LISTENER = Party("secured listener", Role.LISTENER, LISTENER)
_OPEN_TALKER = Party("unsecured talker", Role.TALKER, UNSECURED)
_OPEN_LISTENER = Party("unsecured listener", Role.LISTENER, UNSECURED)
_DENIED_TALKER = Party("talker without permission", Role.TALKER, TALKER_DENIED)
_DENIED_LISTENER = Party(
    "listener without permission", Role.LISTENER, Identity(OWN, "listener without permission")
)
_FOREIGN_TALKER = Party("foreign talker", Role.TALKER, Identity(FOREIGN, "talker"))
_FOREIGN_LISTENER = Party("foreign listener", Role.LISTENER, Identity(FOREIGN, "listener"))
_OTHER_OPEN_TALKER = Party(
    "unsecured talker on another topic", Role.TALKER, UNSECURED, other_topic=True
)
_OBSERVER = Party("observer", Role.OBSERVER, UNSECURED)

ROWS: tuple[Row, ...] = (
    Row(
        "secured talker to secured listener",
        RowStatus.HEARD,
        "both have a certificate of the same CA, and permission for the topic",
        (_SECURED_TALKER, _SECURED_LISTENER),
        (_hears("secured listener", "secured talker"),),
    ),
    Row(
        "unsecured talker to unsecured listener",
        RowStatus.HEARD,
        "no security on either side: the control of all rows below",
        (_OPEN_TALKER, _OPEN_LISTENER),
        (_hears("unsecured listener", "unsecured talker"),),
    ),
    Row(
        "secured talker to unsecured listener",
        RowStatus.NOT_HEARD,
        "a listener that cannot authenticate gets no keys and no messages",
        (_SECURED_TALKER, _OPEN_LISTENER, _SECURED_LISTENER),
        (_hears_not("unsecured listener", "secured talker"),),
        (_hears("secured listener", "secured talker"),),
    ),
    Row(
        "unsecured talker to secured listener",
        RowStatus.NOT_HEARD,
        "a listener in a closed domain ignores a talker that cannot authenticate",
        (_OPEN_TALKER, _SECURED_LISTENER, _OPEN_LISTENER),
        (_hears_not("secured listener", "unsecured talker"),),
        (_hears("unsecured listener", "unsecured talker"),),
    ),
    Row(
        "secured listener without permission",
        RowStatus.REFUSED,
        "its DDS refuses the DataReader: the signed permissions do not allow the topic",
        (_DENIED_LISTENER, _SECURED_LISTENER),
        (Claim(Relation.IS_REFUSED, "listener without permission"),),
        (Claim(Relation.STARTS, "secured listener"),),
    ),
    Row(
        "secured talker without permission",
        RowStatus.REFUSED,
        "its DDS refuses the DataWriter: the signed permissions do not allow the topic",
        (_DENIED_TALKER, _SECURED_TALKER),
        (Claim(Relation.IS_REFUSED, "talker without permission"),),
        (Claim(Relation.STARTS, "secured talker"),),
    ),
    Row(
        "talker of another keystore to secured listener",
        RowStatus.NOT_HEARD,
        "the listener does not trust the other CA: the handshake fails, and no keys are sent",
        (_FOREIGN_TALKER, _SECURED_LISTENER, _FOREIGN_LISTENER),
        (_hears_not("secured listener", "foreign talker"),),
        (_hears("foreign listener", "foreign talker"),),
    ),
    Row(
        "both pairs side by side on one topic",
        RowStatus.UNDISTURBED,
        "each listener hears the talker of its pair, and nothing from the other pair",
        (_SECURED_TALKER, _SECURED_LISTENER, _OPEN_TALKER, _OPEN_LISTENER),
        (
            _hears("secured listener", "secured talker"),
            _hears("unsecured listener", "unsecured talker"),
            _hears_not("secured listener", "unsecured talker"),
            _hears_not("unsecured listener", "secured talker"),
        ),
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
        (_hears("unsecured listener", "unsecured talker"),),
        wire=True,
    ),
    Row(
        "secured payload on the wire",
        RowStatus.NOT_READABLE,
        "every packet with data is encrypted",
        (_SECURED_TALKER, _SECURED_LISTENER),
        (Claim(Relation.READABLE, "secured talker", holds=False),),
        (_hears("secured listener", "secured talker"),),
        wire=True,
    ),
)

ISOLATION = Scenario(
    "isolation",
    "nobody hears or joins secured nodes without permission",
    ROWS,
    {
        "talker": "/talker_listener/talker",
        "listener": "/talker_listener/listener",
        "talker without permission": "/talker_listener/talker_without_permission",
        "listener without permission": "/talker_listener/listener_without_permission",
    },
    talking_policy,
)
