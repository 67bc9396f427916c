"""Deliveries between Zenoh processes: the messages that must pass on each link.

On a link, both processes enforce their rules: the sender with egress rules, the receiver with
ingress rules.  A process drops a denied message without an error.  Tests with zenoh 1.10.2, which
denied one message after another, showed the messages that a delivery needs on each link. A test
compares the results for random rules (``tests/integration/test_zenoh_deliveries.py``).
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
    """A Zenoh process that uses TLS: the common name of its certificate, and its access control."""

    name: str
    mode: Mode
    access: MessageFilter


@shows("enforcer", "remote", "flow", "message", "key", "allowed", "rules", "why")
@dataclass(frozen=True, slots=True)
class Check:
    """A decision of the process ``enforcer`` on a message on its link with ``remote``."""

    enforcer: str
    """The enclave whose process decides."""
    remote: str
    """The enclave at the other end."""
    flow: Flow
    """The direction: from (`ingress`) or to (`egress`) the other end."""
    message: Message
    """The kind of message, as in Zenoh's rules."""
    key: str
    """The key of the message; `any::type/hash` stands for any type."""
    decision: AccessDecision

    @property
    def allowed(self) -> bool:
        """Whether the message passes."""
        return self.decision.allowed

    @property
    def rules(self) -> tuple[str, ...]:
        """The ids of the rules that decide whether the message passes.

        Empty if the default decides.
        """
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
    """The checks that a message must pass on its route, in order.

    ``replies`` are the checks on the reply to a call; the call is executed even if the reply is
    denied.
    """

    checks: tuple[Check, ...]
    replies: tuple[Check, ...] = ()

    @property
    def arrives(self) -> bool:
        """Whether the message (a sample, a request or a token) arrives."""
        return all(check.allowed for check in self.checks)

    @property
    def answered(self) -> bool:
        """Whether the message and its reply arrive."""
        return self.arrives and all(check.allowed for check in self.replies)


Route = tuple[ZenohProcess, ...]
"""The two to four processes through which a message passes, from the sender to the receiver.

If a route has only a session and its router, only the rights of the session's enclave decide.
"""


def route(
    source: ZenohProcess,
    target: ZenohProcess,
    router: ZenohProcess,
    target_router: ZenohProcess | None = None,
) -> Route:
    """Return the route from ``source`` to ``target``.

    Peers send directly to each other. Messages from or to a client pass through ``router`` and
    then, if the target has another router, through ``target_router``.
    """
    if source.mode is Mode.PEER and target.mode is Mode.PEER:
        return source, target
    if target_router and target_router.name != router.name:
        return source, router, target_router, target
    return source, router, target


def sample_delivery(route: Route, key: str, subscribed_key: str = "") -> Delivery:
    """Return the delivery of a published sample along ``route``.

    ``key`` is the key of the sample, perhaps with wildcards.  ``subscribed_key`` is the key of the
    subscription; "" stands for the same key.
    """
    back = route[::-1]
    # Only samples with a declared subscription are sent, except that samples with wildcards always
    # go to the router.
    wanted = back[:-1] if "*" in key and route[1].mode is Mode.ROUTER else back
    return Delivery(
        (
            *_checks_on_route(wanted, Message.DECLARE_SUBSCRIBER, subscribed_key or key),
            *_checks_on_route(route, Message.PUT, key),
        )
    )


def query_delivery(route: Route, key: str, served_key: str = "", reply_key: str = "") -> Delivery:
    """Return the delivery of a query along ``route``, and of the reply.

    ``key`` is the key of the query.  ``served_key`` is the key of the queryable, and ``reply_key``
    the key of the reply; "" stands for the same key.
    """
    back = route[::-1]
    # Queries always go to the router, but to another peer only if it declares a queryable.
    offered = back[:-1] if route[1].mode is Mode.ROUTER else back
    return Delivery(
        (
            *_checks_on_route(offered, Message.DECLARE_QUERYABLE, served_key or key),
            *_checks_on_route(route, Message.QUERY, key),
        ),
        tuple(_checks_on_route(back, Message.REPLY, reply_key or key)),
    )


def token_delivery(
    route: Route, key: str, asked_key: str, message: Message = Message.DECLARE_LIVELINESS_SUBSCRIBER
) -> Delivery:
    """Return the delivery of a liveliness token along ``route`` to a process that watches tokens.

    ``asked_key`` is the key of the ``message`` with which the watching process asks for tokens.  A
    router sends tokens only when asked; peers send each other all tokens without being asked.
    """
    asking = route[:-3:-1] if route[-2].mode is Mode.ROUTER else ()
    return Delivery(
        (
            *_checks_on_route(asking, message, asked_key),
            *_checks_on_route(route, Message.LIVELINESS_TOKEN, key),
        )
    )


def _checks_on_route(
    processes: Sequence[ZenohProcess], message: Message, key: str
) -> Iterator[Check]:
    """Yield the checks that a message must pass on its way through ``processes``."""
    for sender, receiver in pairwise(processes):
        for enforcer, remote, flow in (
            (sender, receiver.name, Flow.EGRESS),
            (receiver, sender.name, Flow.INGRESS),
        ):
            decision = enforcer.access.decide(Remote(remote), flow, message, key)
            yield Check(enforcer.name, remote, flow, message, key, decision)
