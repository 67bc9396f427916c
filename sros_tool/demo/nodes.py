"""Command line and roles of the demo's nodes, shared by Cyclone DDS and Zenoh.

Services and actions have the names and rights of ROS 2, but send strings: a request is text that
ends with ``: FIRST + SECOND``, the answer is text that ends with ``: FIRST + SECOND = SUM``.
"""

from __future__ import annotations

import argparse
import math
import os
import time
from collections import Counter
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Protocol

from sros_tool.runtime.events import EventKind, EventWriter
from sros_tool.wording import counted

_COMPOSED_SERVICE = "/add_two_ints"

FIBONACCI_ORDER = 5
"""Order of the Fibonacci sequence that an action client requests."""


@dataclass(frozen=True)
class NodeOptions:
    """The options of a node.

    ``topic`` is the ROS name of the role's topic, service or action.  ``period`` is in seconds.
    ``text`` is sent in messages, and identifies a server.  ``also`` are further topics for an
    observer.  On Zenoh, messages of a talker have ``size`` bytes or more, and ``patience`` is how
    long a process waits for its connection, in seconds.  A talker or listener ``by_hand`` needs
    only the right for its topic, and reports the types of other endpoints on the topic
    (`OtherTypes`).  If ``type`` is not `STRING`, a talker on rclpy publishes messages of the ROS
    type ``type`` with default values.
    """

    role: str
    topic: str = "chatter"
    period: float = 0.5
    text: str = "Hello World"
    report: Path | None = None
    also: tuple[str, ...] = ()
    size: int = 0
    patience: float = 60.0
    by_hand: bool = False
    type: str = "std_msgs/msg/String"

    @property
    def service(self) -> str:
        """The ROS service of the role; for a container of nodes, always the same service."""
        return self.topic if self.role in ("server", "client") else _COMPOSED_SERVICE


def parse_options(module: str, roles: Collection[str], arguments: Sequence[str]) -> NodeOptions:
    """Parse the command line of ``python -m module``, without its ``--ros-args``.

    Exits with status 2 on an error.
    """
    parser = argparse.ArgumentParser(
        prog=f"python -m {module}", description="Run a node in one role of the demo until stopped."
    )
    parser.add_argument("role", choices=tuple(roles))
    parser.add_argument(
        "--topic",
        default=NodeOptions.topic,
        help="ROS name of the topic, service or action (default: %(default)s)",
    )
    parser.add_argument(
        "--period",
        type=_positive,
        default=NodeOptions.period,
        metavar="SECONDS",
        help="time between two messages, requests, goals or counts (default: %(default)s)",
    )
    parser.add_argument(
        "--text",
        default=NodeOptions.text,
        help="text that a talker or server sends, followed by a number (default: %(default)s)",
    )
    parser.add_argument(
        "--also",
        action="append",
        default=[],
        help="another topic whose publishers an observer counts",
    )
    parser.add_argument(
        "--size",
        type=int,
        default=NodeOptions.size,
        help="minimum size of a message on Zenoh, in bytes",
    )
    parser.add_argument(
        "--patience",
        type=_positive,
        default=NodeOptions.patience,
        metavar="SECONDS",
        help="time to wait for a connection on Zenoh (default: %(default)s)",
    )
    parser.add_argument(
        "--by-hand",
        action="store_true",
        help="report other publishers and subscriptions on the topic, of any type",
    )
    parser.add_argument(
        "--type",
        default=NodeOptions.type,
        help="ROS type of the messages that a talker sends; only on rclpy (default: %(default)s)",
    )
    parser.add_argument(
        "--report", type=Path, metavar="FILE", help="append the events to FILE as JSON lines"
    )
    own_arguments, _ = split_ros_args(arguments)
    parsed = vars(parser.parse_args(own_arguments))
    return NodeOptions(**{**parsed, "also": tuple(parsed["also"])})


def split_ros_args(arguments: Sequence[str]) -> tuple[list[str], list[str]]:
    """Return the arguments outside and inside ``--ros-args ... --``."""
    own_arguments: list[str] = []
    ros: list[str] = []
    target = own_arguments
    for argument in arguments:
        if argument == "--ros-args":
            target = ros
        elif argument == "--" and target is ros:
            target = own_arguments
        else:
            target.append(argument)
    return own_arguments, ros


def enclave_in(arguments: Sequence[str], default: str) -> str:
    """Return the enclave of ``--ros-args --enclave`` on a command line, or ``default``."""
    enclave = default
    for flag, value in pairwise(split_ros_args(arguments)[1]):
        if flag in ("-e", "--enclave"):
            enclave = value
    return enclave


def _positive(text: str) -> float:
    value = float(text)
    if not (math.isfinite(value) and value > 0):
        raise ValueError(text)
    return value


def fibonacci(order: int) -> list[int]:
    """Return the Fibonacci sequence from 0 and 1 up to index ``order``."""
    sequence = [0, 1]
    while len(sequence) <= order:
        sequence.append(sequence[-1] + sequence[-2])
    return sequence[: order + 1]


# ── roles ──────────────────────────────────────────────────────────────────────────────────

Hear = Callable[[str], None]
Call = Callable[[str, Hear], None]


class Node(Protocol):
    """Interface of a node on any library; names are absolute ROS names."""

    def publisher(self, name: str) -> Hear:
        """Return a function that publishes a text."""

    def subscribe(self, name: str, hear: Hear) -> None:
        """Subscribe to a topic; ``hear`` is called with every text received."""

    def types(self, name: str, *, of_publishers: bool) -> Sequence[str]:
        """Return the ROS types of a topic's discovered publishers.

        If ``of_publishers`` is False, return the types of the topic's subscriptions.
        """

    def count(self, name: str, kind: str, on_count: Callable[[int], None]) -> str:
        """Count messages of the ROS type ``kind``; return why that is impossible, or "".

        ``on_count`` is called with the number of messages since its last call.
        """

    def serve(self, name: str, answer: Callable[[str], str]) -> None:
        """Offer a service; ``answer`` is called with a request and returns the reply."""

    def client(self, name: str) -> Call:
        """Return a function that sends a request to a service.

        Its arguments are the request and the function that gets the replies.
        """

    def watch(self) -> None:
        """Start to discover publishers."""

    def publications(self) -> Sequence[str]:
        """Return the topics of the discovered publishers, as packets name them."""

    def wire_name(self, topic: str) -> str:
        """Return the name of a ROS topic as packets have it."""


class NodeRole:
    """The behavior of a node in a role; call ``step`` repeatedly to do the work that is due."""

    def __init__(self, node: Node, options: NodeOptions, events: EventWriter) -> None:
        self._node, self._options, self._events = node, options, events
        self._due = time.monotonic() + options.period
        self._sent = 0
        self.prepare()

    def prepare(self) -> None:
        """Create the node's publishers, subscriptions, services and clients."""

    def act(self) -> None:
        """Do the node's periodic work once."""

    def step(self) -> None:
        """Do the periodic work if a period has passed."""
        if time.monotonic() >= self._due:
            self._due = max(self._due + self._options.period, time.monotonic())
            self.act()

    def end(self) -> None:
        """Report what was heard since the last report; the node stops."""

    def _other_types(self, *, of_publishers: bool) -> OtherTypes | None:
        """Begin to discover other endpoints on the topic of a node that was started by hand.

        The result is None for any other node.
        """
        options, node = self._options, self._node
        if not options.by_hand:
            return None
        node.watch()
        types = partial(node.types, options.topic, of_publishers=of_publishers)
        count = partial(node.count, options.topic) if of_publishers else None
        return OtherTypes(options, self._events, types, count)

    def report_sent(self, text: str) -> None:
        """Report a message that was sent."""
        self._sent += 1
        self._events.report(EventKind.SENT, text)

    def report_heard(self, text: str) -> None:
        """Report a message that was received."""
        self._events.report(EventKind.HEARD, text)


class OtherTypes:
    """The types of other endpoints on the topic of a talker or listener started by hand.

    ``types`` returns the ROS types of the publishers for a listener, and of the subscriptions for a
    talker. Only a listener has ``count``, which is `Node.count` for its topic.
    """

    def __init__(
        self,
        options: NodeOptions,
        events: EventWriter,
        types: Callable[[], Sequence[str]],
        count: Callable[[str, Callable[[int], None]], str] | None = None,
    ) -> None:
        self._topic, self._period, self._own = options.topic, options.period, options.type
        self._events, self._types, self._count = events, types, count
        self._seen: Mapping[str, int] = {}
        self._why_not: dict[str, str] = {}
        self._heard: Counter[str] = Counter()
        self._due = 0.0

    def step(self) -> None:
        """Once in a period, report new types and the number of messages heard."""
        if (moment := time.monotonic()) < self._due:
            return
        self._due = moment + self._period
        if (seen := Counter(self._types())) != self._seen:
            self._seen = seen
            self._events.report(EventKind.SEEN, "; ".join(map(self._kind_text, sorted(seen))))
        self.report_heard()

    def report_heard(self) -> None:
        """Report the number of messages heard since the last report."""
        for kind in [kind for kind, number in self._heard.items() if number]:
            text = f"{counted(number := self._heard[kind], 'message')} of {kind}"
            self._heard[kind] -= number
            self._events.report(EventKind.HEARD, text, count=number)

    def _kind_text(self, kind: str) -> str:
        endpoint_kind = "publisher" if self._count else "subscription"
        text = f"{self._topic} has {counted(self._seen[kind], endpoint_kind)} of {kind}"
        if kind == self._own:
            return text
        if self._count is None:
            return f"{text}, but this talker sends {self._own}: add --type {kind}"
        if kind not in self._why_not:
            self._heard[kind] = 0
            self._why_not[kind] = self._count(kind, partial(self._keep, kind))
        return f"{text}{self._why_not[kind]}"

    def _keep(self, kind: str, number: int) -> None:
        self._heard[kind] += number


STRING = NodeOptions.type
"""The type that talkers publish by default, and that listeners read."""


def ros_type(dds_type: str) -> str:
    """Return the ROS name of a DDS type: std_msgs/msg/String for std_msgs::msg::dds_::String_."""
    return dds_type.replace("::dds_::", "::").removesuffix("_").replace("::", "/")


class _Talker(NodeRole):
    """A talker that publishes its text with a running number."""

    def prepare(self) -> None:
        self._publish = self._node.publisher(self._options.topic)
        self._others = self._other_types(of_publishers=False)

    def step(self) -> None:
        """Publish, and look for subscriptions of other types."""
        super().step()
        if self._others:
            self._others.step()

    def act(self) -> None:
        text = f"{self._options.text}: {self._sent + 1}"
        self._publish(text)
        self.report_sent(text)


class _Listener(NodeRole):
    """A listener that reports every message."""

    def prepare(self) -> None:
        self._node.subscribe(self._options.topic, self.report_heard)
        self._others = self._other_types(of_publishers=True)

    def step(self) -> None:
        """Look for publishers of other types."""
        if self._others:
            self._others.step()

    def end(self) -> None:
        if self._others:
            self._others.report_heard()


class _Relay(_Talker):
    """A talker that also listens."""

    def prepare(self) -> None:
        super().prepare()
        self._node.subscribe(self._options.topic, self.report_heard)


class _Observer(NodeRole):
    """An observer that counts the publishers of topics."""

    def prepare(self) -> None:
        self._node.watch()

    def act(self) -> None:
        seen = self._node.publications()
        topics = (self._options.topic, *self._options.also)
        counts = {topic: seen.count(self._node.wire_name(topic)) for topic in topics}
        self._events.report(EventKind.SEEN, " ".join(sorted(set(seen))), publishers=counts)


class _Server(NodeRole):
    """A server that adds two numbers, and reports the requests that it answers."""

    def prepare(self) -> None:
        self._node.serve(self._options.service, self._answer)

    def _answer(self, request: str) -> str:
        self.report_heard(request)
        question = request.rpartition(": ")[2]
        try:
            first, second = map(int, question.split(" + "))
        except ValueError:
            return "no such sum"
        answer = f"{self._options.text}: {question} = {first + second}"
        self.report_sent(answer)
        return answer


class _Client(NodeRole):
    """A client that requests different sums, and reports correct answers."""

    def prepare(self) -> None:
        self._call = self._node.client(self._options.service)

    def act(self) -> None:
        first, second = self._sent + 1, 3 * (self._sent + 1) + 1

        def check(answer: str) -> None:
            if answer.endswith(f": {first} + {second} = {first + second}"):
                self.report_heard(answer)

        request = f"{self._options.text}: {first} + {second}"
        self.report_sent(request)
        self._call(request, check)


class _ActionServer(NodeRole):
    """An action server that computes Fibonacci numbers, with feedback, status and result."""

    def prepare(self) -> None:
        action = f"{self._options.topic}/_action"
        self._feedback = self._node.publisher(f"{action}/feedback")
        self._status = self._node.publisher(f"{action}/status")
        self._node.serve(f"{action}/send_goal", self._accept)
        self._node.serve(f"{action}/get_result", self._result)
        self._node.serve(f"{action}/cancel_goal", lambda _request: "refused")

    def _accept(self, request: str) -> str:
        self.report_heard(request)
        goal = request.rpartition(": ")[2]
        for length in range(2, FIBONACCI_ORDER + 1):
            self._feedback(f"{goal} {fibonacci(length)}")
        self._status(f"{goal} succeeded")
        return "accepted"

    def _result(self, _request: str) -> str:
        answer = f"{self._options.text}: {fibonacci(FIBONACCI_ORDER)}"
        self.report_sent(answer)
        return answer


class _ActionClient(NodeRole):
    """An action client that reports correct results with complete feedback."""

    def prepare(self) -> None:
        action = f"{self._options.topic}/_action"
        self._call_goal = self._node.client(f"{action}/send_goal")
        self._call_result = self._node.client(f"{action}/get_result")
        self._node.client(f"{action}/cancel_goal")
        self._feedback: list[str] = []
        self._status: list[str] = []
        self._node.subscribe(f"{action}/feedback", self._feedback.append)
        self._node.subscribe(f"{action}/status", self._status.append)
        self._accepted: list[str] = []

    def act(self) -> None:
        goal = f"goal {self._sent + 1} of {os.getpid()}"
        request = f"{self._options.text}: {goal}"
        self.report_sent(request)
        self._call_goal(
            request, lambda reply: self._accepted.append(goal) if reply == "accepted" else None
        )

    def step(self) -> None:
        """Send a goal if a period has passed, and fetch the results of finished goals."""
        super().step()
        for goal in [goal for goal in self._accepted if self._is_done(goal)]:
            self._accepted.remove(goal)
            self._call_result(goal, self._check)

    def _is_done(self, goal: str) -> bool:
        steps = [text for text in self._feedback if text.startswith(f"{goal} ")]
        return len(steps) == FIBONACCI_ORDER - 1 and f"{goal} succeeded" in self._status

    def _check(self, answer: str) -> None:
        if answer.endswith(f": {fibonacci(FIBONACCI_ORDER)}"):
            self.report_heard(answer)


class _Composed(NodeRole):
    """A talker, a listener and a server in one process: one participant, one enclave."""

    def prepare(self) -> None:
        kinds = (_Talker, _Listener, _Server)
        self._parts = [kind(self._node, self._options, self._events) for kind in kinds]

    def step(self) -> None:
        """Run one step of the talker, the listener and the server."""
        for part in self._parts:
            part.step()


class _Router(NodeRole):
    """A router, which forwards messages of other processes."""


ROLES: Mapping[str, type[NodeRole]] = {
    "talker": _Talker,
    "listener": _Listener,
    "relay": _Relay,
    "observer": _Observer,
    "server": _Server,
    "client": _Client,
    "action_server": _ActionServer,
    "action_client": _ActionClient,
    "composed": _Composed,
    "router": _Router,
}
