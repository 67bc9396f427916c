"""Attacks by nodes without an identity, and what every node with one can see."""

from __future__ import annotations

from sros_tool.demo.model import (
    OWN,
    UNSECURED,
    Case,
    Condition,
    Identity,
    Row,
    Status,
)
from sros_tool.demo.scenarios.attacks.kinds import injection, listening, looking

ROWS: tuple[Row, ...] = (
    listening(
        "an unsecured node listens",
        UNSECURED,
        Status.NOT_HEARD,
        "who cannot authenticate gets no keys, and is sent nothing",
        attack="an unsecured node listens",
    ),
    listening(
        "an unsecured node listens, strangers allowed",
        UNSECURED,
        Status.HEARD,
        "the governance lets everybody in and protects nothing",
        attack="an unsecured node listens",
        removed="the governance's refusal of strangers",
        victims="strangers allowed",
    ),
    looking(
        "an unsecured node lists topics",
        UNSECURED,
        Status.NOT_VISIBLE,
        "discovery of endpoints is encrypted: it counts no publisher of the topic",
        attack="an unsecured node lists topics",
        cases=(
            Case(
                (Condition.STRANGERS_SEE,),
                Status.VISIBLE,
                "the template lets unauthenticated participants in",
                "leave out allow_unauthenticated_participants",
            ),
        ),
    ),
    looking(
        "an unsecured node lists topics, strangers allowed",
        UNSECURED,
        Status.VISIBLE,
        "discovery is not protected, and open to everybody",
        attack="an unsecured node lists topics",
        removed="the governance's refusal of strangers",
        victims="strangers allowed",
    ),
    injection(
        "an unsecured node injects",
        UNSECURED,
        Status.NOT_HEARD,
        "a listener in a closed domain ignores a talker that cannot authenticate",
        attack="an unsecured node injects",
    ),
    injection(
        "an unsecured node injects, strangers allowed",
        UNSECURED,
        Status.HEARD,
        "the governance lets everybody in and protects nothing",
        attack="an unsecured node injects",
        removed="the governance's refusal of strangers",
        victims="strangers allowed",
    ),
    looking(
        "an enclave without rights lists topics",
        Identity(OWN, "guest"),
        Status.VISIBLE,
        "endpoints are announced to every authenticated participant",
        attack="an authenticated node looks around",
        open_because="DDS Security 1.1 does not hide endpoints from authenticated participants",
        remedy="give an identity to nobody who must not know what there is",
    ),
)
