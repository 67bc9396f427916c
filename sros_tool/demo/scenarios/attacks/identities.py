"""Attacks with certificates and keys: of another CA, out of date, revoked, mixed, copied."""

from __future__ import annotations

from sros_tool.demo.forger import STOLEN
from sros_tool.demo.model import (
    FOREIGN,
    OWN,
    Case,
    Condition,
    Identity,
    Row,
    Status,
)
from sros_tool.demo.scenarios.attacks.kinds import injection, succeeds

ROWS: tuple[Row, ...] = (
    injection(
        "identity of another CA",
        Identity(FOREIGN, "talker"),
        Status.NOT_HEARD,
        "a certificate of another CA proves nothing here: no handshake, no keys",
        attack="identity of another CA",
    ),
    succeeds(
        "identity of another CA, to a listener of that CA",
        Identity(FOREIGN, "talker"),
        attack="identity of another CA",
        removed="the difference of the CAs",
        victims=FOREIGN,
    ),
    injection(
        "expired identity",
        Identity("expired", "talker"),
        Status.NOT_LET_IN,
        "its DDS checks the dates of the certificate before anything else",
        attack="identity out of date",
    ),
    injection(
        "identity not yet valid",
        Identity("not yet valid", "talker"),
        Status.NOT_LET_IN,
        "its DDS checks the dates of the certificate before anything else",
        attack="identity out of date",
    ),
    succeeds(
        "the same identity in date",
        Identity("in date", "talker"),
        attack="identity out of date",
        removed="the wrong dates",
        victims="in date",
    ),
    injection(
        "revoked identity",
        Identity(OWN, "talker"),
        Status.NOT_HEARD,
        "the listener's crl.pem names the certificate",
        attack="revoked identity",
        victims="talker revoked",
    ),
    injection(
        "revoked identity, list not delivered",
        Identity("revocation not delivered", STOLEN),
        Status.HEARD,
        "who has no crl.pem knows of no revocation",
        attack="revoked identity",
        removed="the listener's crl.pem",
        victims="revocation not delivered",
    ),
    injection(
        "certificate with the key of another enclave",
        Identity("key of another", "talker"),
        Status.NOT_HEARD,
        "the handshake proves that the key belongs to the certificate",
        attack="key and certificate do not belong together",
        cases=(
            Case(
                (Condition.FAST,),
                Status.NOT_LET_IN,
                mechanism="its own DDS compares the key with the certificate",
            ),
        ),
    ),
    succeeds(
        "certificate with its own key",
        Identity("made", "talker"),
        attack="key and certificate do not belong together",
        removed="the wrong key",
        victims="made",
    ),
    injection(
        "identity copied by another user of the robot",
        Identity("stolen", "talker"),
        Status.NOT_LET_IN,
        "the file modes keep the key from other users, and without it nothing starts",
        attack="world-readable keys",
    ),
    injection(
        "identity copied by another user, modes opened",
        Identity("keys readable for all", "talker"),
        Status.HEARD,
        "no DDS looks at file modes: who can read the key is the enclave",
        attack="world-readable keys",
        removed="the modes of files and folders",
        victims="keys readable for all",
    ),
)
