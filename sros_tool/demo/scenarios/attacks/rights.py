"""Attacks by an enclave that tries more than its permissions allow."""

from __future__ import annotations

from sros_tool.demo import forger
from sros_tool.demo.forger import Undefended
from sros_tool.demo.scenarios.attacks.kinds import calling, injection, listening, posing_as_server
from sros_tool.demo.scenarios.model import OWN, Condition, Identity, Row, RowStatus, Variant

ROWS: tuple[Row, ...] = (
    injection(
        "an enclave publishes a topic that it was not given",
        Identity(OWN, "guest"),
        RowStatus.REFUSED,
        "its signed permissions do not allow the topic",
        attack="an enclave publishes a topic",
    ),
    injection(
        "an enclave publishes a topic, wildcard permissions",
        Identity(Undefended(forger.guest_may_do_everything), "guest"),
        RowStatus.HEARD,
        "permissions for * allow every topic",
        attack="an enclave publishes a topic",
        removed="least privilege",
        victims=Undefended(forger.guest_may_do_everything),
    ),
    listening(
        "an enclave hears a topic that it was not given",
        Identity(OWN, "guest"),
        RowStatus.REFUSED,
        "its signed permissions do not allow the topic",
        attack="an enclave hears a topic",
    ),
    listening(
        "an enclave hears a topic, wildcard permissions",
        Identity(Undefended(forger.guest_may_do_everything), "guest"),
        RowStatus.HEARD,
        "permissions for * allow every topic",
        attack="an enclave hears a topic",
        removed="least privilege",
        victims=Undefended(forger.guest_may_do_everything),
    ),
    injection(
        "a listener publishes",
        Identity(OWN, "listener"),
        RowStatus.REFUSED,
        "its signed permissions allow the topic only in the other direction",
        attack="a listener publishes",
    ),
    injection(
        "a listener publishes, wildcard permissions",
        Identity(Undefended(forger.listener_may_do_everything), "listener"),
        RowStatus.HEARD,
        "permissions for * allow both directions",
        attack="a listener publishes",
        removed="least privilege",
        victims=Undefended(forger.listener_may_do_everything),
    ),
    listening(
        "a talker listens",
        Identity(OWN, "talker"),
        RowStatus.REFUSED,
        "its signed permissions allow the topic only in the other direction",
        attack="a talker listens",
    ),
    listening(
        "a talker listens, wildcard permissions",
        Identity(Undefended(forger.talker_may_do_everything), "talker"),
        RowStatus.HEARD,
        "permissions for * allow both directions",
        attack="a talker listens",
        removed="least privilege",
        victims=Undefended(forger.talker_may_do_everything),
    ),
    calling(
        "an enclave calls a service that it was not given",
        Identity(OWN, "guest"),
        RowStatus.REFUSED,
        "its signed permissions allow neither the request nor the reply",
        attack="an enclave calls a service",
    ),
    calling(
        "an enclave calls a service, wildcard permissions",
        Identity(Undefended(forger.guest_may_do_everything), "guest"),
        RowStatus.ANSWERED,
        "permissions for * allow every service",
        attack="an enclave calls a service",
        removed="least privilege",
        victims=Undefended(forger.guest_may_do_everything),
    ),
    posing_as_server(
        "a client poses as the server",
        Identity(OWN, "client"),
        RowStatus.REFUSED,
        "its signed permissions allow requests, not replies",
        attack="a client poses as the server",
    ),
    posing_as_server(
        "a client poses as the server, wildcard permissions",
        Identity(Undefended(forger.client_may_do_everything), "client"),
        RowStatus.ANSWERED,
        "permissions for * allow replies as well",
        attack="a client poses as the server",
        removed="least privilege",
        victims=Undefended(forger.client_may_do_everything),
    ),
    injection(
        "an enclave without a policy publishes",
        Identity(OWN, "newcomer"),
        RowStatus.REFUSED,
        "the template denies every topic of the robot to an enclave without a policy",
        attack="an enclave without a policy",
        variants=(
            Variant(
                (Condition.OPEN_DEFAULT,),
                RowStatus.HEARD,
                "the template allows everything to an enclave without a policy",
                "give every enclave a policy, or use the template production",
            ),
        ),
    ),
    injection(
        "an enclave without a policy publishes, open default",
        Identity(Undefended(template=forger.open_default), "newcomer"),
        RowStatus.HEARD,
        "an enclave without a policy may do everything",
        attack="an enclave without a policy",
        removed="the template's denial by default",
        victims=Undefended(template=forger.open_default),
    ),
)
