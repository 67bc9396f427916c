"""Attacks by whoever sees the packets: reading, sending again, and what is open to all."""

from __future__ import annotations

from sros_tool.demo.model import (
    OWN,
    Case,
    Claim,
    Condition,
    Identity,
    Party,
    Relation,
    Role,
    Row,
    Status,
    Wire,
)
from sros_tool.demo.scenarios.attacks.kinds import open_to

ROWS: tuple[Row, ...] = (
    Row(
        "payload read on the wire",
        Status.NOT_READABLE,
        "every packet with data is encrypted, with keys that only authenticated peers get",
        (
            Party("talker", Role.TALKER, Identity(OWN, "talker")),
            Party("listener", Role.LISTENER, Identity(OWN, "listener")),
        ),
        (Claim(Relation.READABLE, "talker", holds=False),),
        (Claim(Relation.HEARS, "listener", "talker"),),
        wire=True,
        cases=(
            Case(
                (Condition.IN_CLEAR,),
                Status.READABLE,
                "the template does not encrypt the payload of this topic",
                'set data = "ENCRYPT" for it',
            ),
        ),
        attack="eavesdropping on the wire",
    ),
    Row(
        "payload read on the wire, not encrypted",
        Status.READABLE,
        "with the protection kinds NONE, access is controlled but nothing is hidden",
        (
            Party("talker", Role.TALKER, Identity("in clear", "talker")),
            Party("listener", Role.LISTENER, Identity("in clear", "listener")),
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
        Status.NOT_HEARD_AGAIN,
        "keys are agreed on anew with each peer, so that old packets fit nobody's",
        (
            Party("talker", Role.TALKER, Identity(OWN, "talker")),
            Party("listener", Role.LISTENER, Identity(OWN, "listener")),
        ),
        (Claim(Relation.HEARS_AGAIN, "listener", "talker", holds=False),),
        (Claim(Relation.HEARS, "listener", "talker"),),
        replay="talker",
        brief=True,
        cases=open_to(Status.HEARD_AGAIN, Status.NOT_HEARD_AGAIN),
        attack="replay of captured packets",
    ),
    Row(
        "packets of an unsecured talker sent again",
        Status.HEARD_AGAIN,
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
            Status.READABLE,
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
            remedy="put no secrets into names, and keep strangers off the network",
        )
        for what, wire in (("topic names", Wire.TOPIC), ("certificates", Wire.CERTIFICATE))
    ),
)
