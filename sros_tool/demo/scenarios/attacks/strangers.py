"""Attacks by strangers: on the wire, by nodes without an identity; and what enclaves can see."""

from __future__ import annotations

from sros_tool.demo import forger
from sros_tool.demo.forger import Undefended
from sros_tool.demo.scenarios.attacks.kinds import injection, listening, looking, open_to
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
_STRANGERS_ALLOWED = Undefended(forger.weaker_governance)

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
                'set data = "ENCRYPT" for it',
            ),
        ),
        attack="eavesdropping on the wire",
    ),
    Row(
        "payload read on the wire, not encrypted",
        RowStatus.READABLE,
        "with the protection kinds NONE, access is controlled but nothing is hidden",
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
        "each two peers agree on new keys, so that no key fits old packets",
        (
            Party("talker", Role.TALKER, Identity(OWN, "talker")),
            Party("listener", Role.LISTENER, Identity(OWN, "listener")),
        ),
        (Claim(Relation.HEARS_AGAIN, "listener", "talker", holds=False),),
        (Claim(Relation.HEARS, "listener", "talker"),),
        replay="talker",
        brief=True,
        variants=open_to(RowStatus.HEARD_AGAIN, RowStatus.NOT_HEARD_AGAIN),
        attack="replay of captured packets",
    ),
    Row(
        "packets of an unsecured talker sent again",
        RowStatus.HEARD_AGAIN,
        "nothing in a packet proves when it was sent, nor by whom",
        (Party("talker", Role.TALKER), Party("listener", Role.LISTENER)),
        (Claim(Relation.HEARS_AGAIN, "listener", "talker"),),
        (Claim(Relation.HEARS, "listener", "talker"),),
        replay="talker",
        brief=True,
        attack="replay of captured packets",
        removed="security",
    ),
    *(
        Row(
            f"{what} read in the handshake",
            RowStatus.READABLE,
            "identity and permissions travel in clear before there are keys",
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
            remedy="do not put secrets into names, and keep strangers off the network",
        )
        for what, wire in (("topic names", Wire.TOPIC), ("certificates", Wire.CERTIFICATE))
    ),
    listening(
        "an unsecured node listens",
        UNSECURED,
        RowStatus.NOT_HEARD,
        "a node that cannot authenticate gets no keys, and is sent nothing",
        attack="an unsecured node listens",
    ),
    listening(
        "an unsecured node listens, strangers allowed",
        UNSECURED,
        RowStatus.HEARD,
        "the governance lets everybody in and protects nothing",
        attack="an unsecured node listens",
        removed="the governance's refusal of strangers",
        victims=_STRANGERS_ALLOWED,
    ),
    looking(
        "an unsecured node lists topics",
        UNSECURED,
        RowStatus.NOT_VISIBLE,
        "discovery of endpoints is encrypted: it counts no publisher of the topic",
        attack="an unsecured node lists topics",
        variants=(
            Variant(
                (Condition.STRANGERS_SEE,),
                RowStatus.VISIBLE,
                "the template lets unauthenticated participants in",
                "leave out allow_unauthenticated_participants",
            ),
        ),
    ),
    looking(
        "an unsecured node lists topics, strangers allowed",
        UNSECURED,
        RowStatus.VISIBLE,
        "discovery is not protected, and open to everybody",
        attack="an unsecured node lists topics",
        removed="the governance's refusal of strangers",
        victims=_STRANGERS_ALLOWED,
    ),
    injection(
        "an unsecured node injects",
        UNSECURED,
        RowStatus.NOT_HEARD,
        "a listener in a closed domain ignores a talker that cannot authenticate",
        attack="an unsecured node injects",
    ),
    injection(
        "an unsecured node injects, strangers allowed",
        UNSECURED,
        RowStatus.HEARD,
        "the governance lets everybody in and protects nothing",
        attack="an unsecured node injects",
        removed="the governance's refusal of strangers",
        victims=_STRANGERS_ALLOWED,
    ),
    looking(
        "an enclave without rights lists topics",
        Identity(OWN, "guest"),
        RowStatus.VISIBLE,
        "endpoints are announced to every authenticated participant",
        attack="an authenticated node looks around",
        open_because="DDS Security 1.1 does not hide endpoints from authenticated participants",
        remedy="give no identity to anybody who must not see what is on the robot",
    ),
)
