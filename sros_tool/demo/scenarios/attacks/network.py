"""Attacks from the network: capture, replay, unsecured nodes; and what enclaves can discover."""

from __future__ import annotations

from sros_tool.demo import forger
from sros_tool.demo.forger import Undefended
from sros_tool.demo.scenarios.attacks.kinds import discovering, injection, listening, open_to
from sros_tool.demo.scenarios.model import (
    OWN,
    UNSECURED,
    Claim,
    Condition,
    Identity,
    Party,
    Relation,
    Role,
    Row,
    RowStatus,
    Variant,
    Wire,
)

_IN_CLEAR = Undefended(template=forger.unprotected)
_OPEN_GOVERNANCE = Undefended(forger.weaker_governance)

ROWS: tuple[Row, ...] = (
    Row(
        "payload read on the wire",
        RowStatus.NOT_READABLE,
        "every packet with data is encrypted, with keys that only authenticated peers get",
        (
            Party("talker", Role.TALKER, Identity(OWN, "talker")),
            Party("listener", Role.LISTENER, Identity(OWN, "listener")),
        ),
        (Claim(Relation.READABLE, "talker", holds=False),),
        (Claim(Relation.HEARS, "listener", "talker"),),
        wire=True,
        variants=(
            Variant(
                (Condition.IN_CLEAR,),
                RowStatus.READABLE,
                "the template does not encrypt the payload of this topic",
                'set data = "ENCRYPT" for this topic',
            ),
        ),
        attack="eavesdropping on the wire",
    ),
    Row(
        "payload read on the wire, not encrypted",
        RowStatus.READABLE,
        "with the protection kind NONE, access is controlled but nothing is encrypted",
        (
            Party("talker", Role.TALKER, Identity(_IN_CLEAR, "talker")),
            Party(
                "listener",
                Role.LISTENER,
                Identity(_IN_CLEAR, "listener"),
            ),
        ),
        (Claim(Relation.READABLE, "talker"),),
        (Claim(Relation.HEARS, "listener", "talker"),),
        wire=True,
        brief=True,
        attack="eavesdropping on the wire",
        removed="encryption",
    ),
    Row(
        "packets of a secured talker sent again",
        RowStatus.NOT_HEARD_AGAIN,
        "every two participants agree on new keys, so that old packets are rejected",
        (
            Party("talker", Role.TALKER, Identity(OWN, "talker")),
            Party("listener", Role.LISTENER, Identity(OWN, "listener")),
        ),
        (Claim(Relation.HEARS_AGAIN, "listener", "talker", holds=False),),
        (Claim(Relation.HEARS, "listener", "talker"),),
        replay="talker",
        brief=True,
        variants=(
            Variant(
                (Condition.UNAUTHENTICATED, Condition.FAST),
                RowStatus.NOT_HEARD_AGAIN,
                mechanism="the packets show an identity: Fast DDS waits until it authenticates",
            ),
            *open_to(RowStatus.HEARD_AGAIN, RowStatus.NOT_HEARD_AGAIN),
        ),
        attack="replay of captured packets",
    ),
    Row(
        "packets of an unsecured talker sent again",
        RowStatus.HEARD_AGAIN,
        "nothing in an unsecured packet proves when or by whom it was sent",
        (Party("talker", Role.TALKER), Party("listener", Role.LISTENER)),
        (Claim(Relation.HEARS_AGAIN, "listener", "talker"),),
        (Claim(Relation.HEARS, "listener", "talker"),),
        replay="talker",
        brief=True,
        attack="replay of captured packets",
        removed="security",
    ),
    Row(
        "packets of a secured talker changed",
        RowStatus.NOT_DECEIVED,
        "every packet has a message authentication code, which nobody without the keys can make",
        (
            Party("talker", Role.TALKER, Identity(OWN, "talker")),
            Party("listener", Role.LISTENER, Identity(OWN, "listener")),
        ),
        (Claim(Relation.BELIEVES, "listener", "talker", holds=False),),
        (Claim(Relation.HEARS, "listener", "talker"),),
        impersonate="talker",
        brief=True,
        variants=(
            Variant(
                (Condition.UNSIGNED,),
                RowStatus.DECEIVED,
                "the template neither signs nor encrypts the messages of this topic",
                'set rtps = "SIGN" or "ENCRYPT", or protect the topic',
            ),
        ),
        attack="changed packets",
    ),
    Row(
        "packets of a secured talker changed, not signed",
        RowStatus.DECEIVED,
        "with the protection kind NONE, nothing in a packet proves who sent it",
        (
            Party("talker", Role.TALKER, Identity(_IN_CLEAR, "talker")),
            Party("listener", Role.LISTENER, Identity(_IN_CLEAR, "listener")),
        ),
        (Claim(Relation.BELIEVES, "listener", "talker"),),
        (Claim(Relation.HEARS, "listener", "talker"),),
        impersonate="talker",
        brief=True,
        attack="changed packets",
        removed="signatures and encryption",
    ),
    *(
        Row(
            f"{what} read in the handshake",
            RowStatus.READABLE,
            "certificates and permissions are sent in clear before keys are agreed",
            (
                Party("talker", Role.TALKER, Identity(OWN, "talker")),
                Party("listener", Role.LISTENER, Identity(OWN, "listener")),
            ),
            (Claim(Relation.READABLE, "talker", wire=wire),),
            (Claim(Relation.HEARS, "listener", "talker"),),
            wire=True,
            brief=True,
            attack="what the handshake reveals",
            open_because="DDS Security 1.1 sends certificates and permissions unencrypted",
            remedy="do not put secrets into names, and admit only trusted machines to the network",
        )
        for what, wire in (("topic names", Wire.TOPIC), ("certificates", Wire.CERTIFICATE))
    ),
    listening(
        "an unsecured node listens",
        UNSECURED,
        RowStatus.NOT_HEARD,
        "a node that cannot authenticate gets no keys and no messages",
        attack="an unsecured node listens",
    ),
    listening(
        "an unsecured node listens, open governance",
        UNSECURED,
        RowStatus.HEARD,
        "the governance admits everybody and protects nothing",
        attack="an unsecured node listens",
        removed="the refusal of unauthenticated participants",
        victims=_OPEN_GOVERNANCE,
    ),
    discovering(
        "an unsecured node lists topics",
        UNSECURED,
        RowStatus.NOT_VISIBLE,
        "endpoint discovery is encrypted: the node sees no publisher of the topic",
        attack="an unsecured node lists topics",
        variants=(
            Variant(
                (Condition.UNAUTHENTICATED_SEE,),
                RowStatus.VISIBLE,
                "the template admits unauthenticated participants",
                "remove allow_unauthenticated_participants from the template",
            ),
        ),
    ),
    discovering(
        "an unsecured node lists topics, open governance",
        UNSECURED,
        RowStatus.VISIBLE,
        "discovery is not protected, and everybody may join",
        attack="an unsecured node lists topics",
        removed="the refusal of unauthenticated participants",
        victims=_OPEN_GOVERNANCE,
    ),
    injection(
        "an unsecured node injects",
        UNSECURED,
        RowStatus.NOT_HEARD,
        "a listener in a closed domain ignores a talker that cannot authenticate",
        attack="an unsecured node injects",
    ),
    injection(
        "an unsecured node injects, open governance",
        UNSECURED,
        RowStatus.HEARD,
        "the governance admits everybody and protects nothing",
        attack="an unsecured node injects",
        removed="the refusal of unauthenticated participants",
        victims=_OPEN_GOVERNANCE,
    ),
    discovering(
        "an enclave without rights lists topics",
        Identity(OWN, "guest"),
        RowStatus.VISIBLE,
        "endpoints are announced to every authenticated participant",
        attack="an authenticated node looks around",
        open_because="DDS Security 1.1 does not hide endpoints from authenticated participants",
        remedy="give an identity only to those who may see all endpoints of the robot",
    ),
)
