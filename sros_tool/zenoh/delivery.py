"""Deliveries between Zenoh processes: which messages have to pass on each link.

On a link, both processes enforce their rules: the sender by egress rules, the receiver by ingress
rules.  A process drops a denied message without an error.  Which messages a delivery needs, and on
which links, was tested with zenoh 1.10.2, by denying one message after another.  A test compares
the result on random rules (``tests/integration/test_zenoh_deliveries.py``).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise

from sros_tool.values import shows
from sros_tool.zenoh.access import AccessDecision, Flow, Message, MessageFilter, Remote
from sros_tool.zenoh.configuration import Mode


@dataclass(frozen=True, slots=True)
class ZenohProcess:
    """A Zenoh process that uses TLS: the common name of its certificate, and what it enforces."""

    name: str
    mode: Mode
    access: MessageFilter


@shows("enforcer", "remote", "flow", "message", "key", "allowed", "rules", "why")
@dataclass(frozen=True, slots=True)
class Check:
    """A decision of the process ``enforcer`` on one message on its link with ``remote``."""

    enforcer: str
    """The enclave whose process decides."""
    remote: str
    """The enclave at the other end."""
    flow: Flow
    """From (`ingress`) or to (`egress`) the other end."""
    message: Message
    """The kind of message, as Zenoh's rules name it."""
    key: str
    """The key of the message; `any::type/hash` stands for every type."""
    decision: AccessDecision

    @property
    def allowed(self) -> bool:
        """Whether the message passes."""
        return self.decision.allowed

    @property
    def rules(self) -> tuple[str, ...]:
        """The ids of the rules that decide whether the message passes."""
        return self.decision.rules

    @property
    def why(self) -> str:
        """The reason for the decision, as a clause."""
        return self.decision.why

    def __str__(self) -> str:
        """Return text like ``put 0/chatter/*/* from /talker``."""
        end = "from" if self.flow is Flow.INGRESS else "to"
        return f"{self.message} {self.key} {end} {self.remote}"


@dataclass(frozen=True, slots=True)
class Delivery:
    """The checks that a message has to pass until it arrives, in order.

    ``replies`` are the checks on the reply to a call; the call is executed even if they fail.
    """

    checks: tuple[Check, ...]
    replies: tuple[Check, ...] = ()

    @property
    def arrives(self) -> bool:
        """Whether the message arrives: a sample, a request or a token."""
        return all(check.allowed for check in self.checks)

    @property
    def answered(self) -> bool:
        """Whether the reply arrives, too."""
        return self.arrives and all(check.allowed for check in self.replies)


Route = tuple[ZenohProcess, ...]
"""The two to four processes that a message passes, from the sender to the receiver.

A route between a session and its router is the part for which the rights of one enclave decide.
"""


def route(
    source: ZenohProcess, target: ZenohProcess, router: ZenohProcess, to: ZenohProcess | None = None
) -> Route:
    """Return the route from ``source`` to ``target``.

    Peers send to each other directly.  Messages from or to a client go through ``router`` and then,
    if the target has another router, through ``to``.
    """
    if source.mode is Mode.PEER and target.mode is Mode.PEER:
        return source, target
    if to and to.name != router.name:
        return source, router, to, target
    return source, router, target


def deliver_sample(route: Route, key: str, subscribed_key: str = "") -> Delivery:
    """Return the delivery of a published sample along ``route``.

    ``key`` is the key of the sample, perhaps with wildcards; ``subscribed_key`` is the key of the
    subscription ("": the same key).
    """
    back = route[::-1]
    # Nothing is sent that nobody wants to hear, but what has wildcards goes to the router anyway.
    wanted = back[:-1] if "*" in key and route[1].mode is Mode.ROUTER else back
    return Delivery(
        (
            *_checks_on_route(wanted, Message.DECLARE_SUBSCRIBER, subscribed_key or key),
            *_checks_on_route(route, Message.PUT, key),
        )
    )


def deliver_query(route: Route, key: str, served_key: str = "", reply_key: str = "") -> Delivery:
    """Return the delivery of a query along ``route``, and of the reply.

    ``key`` is the key of the query; ``served_key`` is the key of the queryable, and ``reply_key``
    the key of the reply ("": the same key).
    """
    back = route[::-1]
    # Queries go to the router in any case, and to another peer only if it offers to reply.
    offered = back[:-1] if route[1].mode is Mode.ROUTER else back
    return Delivery(
        (
            *_checks_on_route(offered, Message.DECLARE_QUERYABLE, served_key or key),
            *_checks_on_route(route, Message.QUERY, key),
        ),
        tuple(_checks_on_route(back, Message.REPLY, reply_key or key)),
    )


def deliver_token(
    route: Route, key: str, asked_key: str, message: Message = Message.DECLARE_LIVELINESS_SUBSCRIBER
) -> Delivery:
    """Return the delivery of a liveliness token along ``route``, to a watching process.

    ``asked_key`` is the key that this process asks for, by a ``message``.  A router answers it;
    peers send each other all tokens without being asked.
    """
    asking = route[:-3:-1] if route[-2].mode is Mode.ROUTER else ()
    return Delivery(
        (
            *_checks_on_route(asking, message, asked_key),
            *_checks_on_route(route, Message.LIVELINESS_TOKEN, key),
        )
    )


def _checks_on_route(way: Sequence[ZenohProcess], message: Message, key: str) -> Iterator[Check]:
    """Yield the checks that a message has to pass on all links of a route."""
    for sender, receiver in pairwise(way):
        for enforcer, remote, flow in (
            (sender, receiver.name, Flow.EGRESS),
            (receiver, sender.name, Flow.INGRESS),
        ):
            decision = enforcer.access.decide(Remote(remote), flow, message, key)
            yield Check(enforcer.name, remote, flow, message, key, decision)
