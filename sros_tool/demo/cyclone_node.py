"""The nodes of the demo on Cyclone DDS: ``python -m sros_tool.demo.cyclone_node ROLE``.

They read the environment of a ROS 2 node and use the DDS topics and types of its messages, so that
rclpy nodes receive them, and a launcher can start both kinds of nodes in the same way.

Services and actions use the DDS topics of rmw_cyclonedds (rq/...Request, rr/...Reply,
rt/..._action/...), but send strings: names and rights are as in ROS 2, types are not.
A request is "CLIENT NUMBER ARGUMENTS"; its reply begins with the same CLIENT and NUMBER.
"""

from __future__ import annotations

import itertools
import os
import signal
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from types import FrameType

from sros_tool.demo.node_options import (
    FIBONACCI_ORDER,
    NodeOptions,
    fibonacci,
    parse_options,
    split_ros_args,
)
from sros_tool.errors import SrosError
from sros_tool.runtime.cyclone import Participant, Reader, SecurityRefusedError, Writer
from sros_tool.runtime.events import EventKind, EventWriter, ProcessStage
from sros_tool.runtime.rcl_security import choose_loadable, domain_of
from sros_tool.topics import dds_names

_POLL_SECONDS = 0.02


class _Talker:
    """A talker that publishes its text and a number periodically."""

    def __init__(self, participant: Participant, options: NodeOptions, events: EventWriter) -> None:
        self._writer = participant.writer(_dds_topic(options.topic))
        self._options, self._events = options, events
        self._sent = 0
        self._due = time.monotonic() + options.period

    def step(self) -> None:
        """Publish a message if one is due."""
        if time.monotonic() < self._due:
            return
        self._due += self._options.period
        self._sent += 1
        text = f"{self._options.text}: {self._sent}"
        self._writer.write(text)
        self._events.report(EventKind.SENT, text, count=self._sent)


class _Listener:
    """A listener that reports each message."""

    def __init__(self, participant: Participant, options: NodeOptions, events: EventWriter) -> None:
        self._reader = participant.reader(_dds_topic(options.topic))
        self._events = events
        self._heard = 0

    def step(self) -> None:
        """Report the received messages."""
        for text in self._reader.take():
            self._heard += 1
            self._events.report(EventKind.HEARD, text, count=self._heard)


class _Observer:
    """An observer that counts the publishers of topics."""

    def __init__(self, participant: Participant, options: NodeOptions, events: EventWriter) -> None:
        self._participant, self._options, self._events = participant, options, events
        self._topics = (options.topic, *options.also)
        self._due = time.monotonic()

    def step(self) -> None:
        """Count the publishers if it is time."""
        if time.monotonic() < self._due:
            return
        self._due += self._options.period
        found = [publication.topic for publication in self._participant.publications()]
        counts = {topic: found.count(_dds_topic(topic)) for topic in self._topics}
        self._events.report(EventKind.SEEN, " ".join(sorted(set(found))), publishers=counts)


class _Service:
    """One side of a service: a writer on one topic and a reader on the other."""

    def __init__(self, participant: Participant, name: str, *, server: bool) -> None:
        (request,), (reply,) = dds_names("request", name)
        self._reader: Reader = participant.reader(request if server else reply)
        self._writer: Writer = participant.writer(reply if server else request)

    def take(self) -> list[list[str]]:
        """Return the received requests or replies, each as client, number, and arguments."""
        return [text.split(" ", 2) for text in self._reader.take()]

    def send(self, client: str, number: str, text: str) -> None:
        """Send a request or reply."""
        self._writer.write(f"{client} {number} {text}")


class _Server:
    """A server that adds two numbers."""

    def __init__(self, participant: Participant, options: NodeOptions, events: EventWriter) -> None:
        self._service = _Service(participant, options.service, server=True)
        self._options, self._events = options, events
        self._answered = 0

    def step(self) -> None:
        """Answer the received requests."""
        for client, number, question in self._service.take():
            first, second = map(int, question.split(" + "))
            self._answered += 1
            answer = f"{self._options.text}: {question} = {first + second}"
            self._service.send(client, number, answer)
            self._events.report(EventKind.SENT, answer, count=self._answered)


class _Client:
    """A client that requests sums periodically, and reports the right answers."""

    def __init__(self, participant: Participant, options: NodeOptions, events: EventWriter) -> None:
        self._service = _Service(participant, options.service, server=False)
        self._options, self._events = options, events
        self._name = os.urandom(16).hex()
        self._asked = self._right = 0
        self._due = time.monotonic() + options.period

    def step(self) -> None:
        """Send a request if one is due, and check the answers."""
        if time.monotonic() >= self._due:
            self._due += self._options.period
            self._asked += 1
            first, second = _operands(self._asked)
            self._service.send(self._name, str(self._asked), f"{first} + {second}")
            self._events.report(EventKind.SENT, f"{first} + {second}", count=self._asked)
        for client, number, answer in self._service.take():
            first, second = _operands(int(number))
            if client == self._name and answer.endswith(f": {first} + {second} = {first + second}"):
                self._right += 1
                self._events.report(EventKind.HEARD, answer, count=self._right)


class _ActionServer:
    """An action server that computes Fibonacci numbers, with feedback and results.

    A goal is "CLIENT NUMBER ORDER"; feedback and status are "CLIENT NUMBER WHAT".
    """

    def __init__(self, participant: Participant, options: NodeOptions, events: EventWriter) -> None:
        action = f"{options.topic}/_action"
        self._goals = _Service(participant, f"{action}/send_goal", server=True)
        self._cancels = _Service(participant, f"{action}/cancel_goal", server=True)
        self._results = _Service(participant, f"{action}/get_result", server=True)
        self._feedback = participant.writer(f"rt{action}/feedback")
        self._status = participant.writer(f"rt{action}/status")
        self._options, self._events = options, events
        self._orders: dict[tuple[str, str], int] = {}
        self._done = 0

    def step(self) -> None:
        """Accept goals, compute them, and send requested results."""
        for client, number, order in self._goals.take():
            self._orders[client, number] = int(order)
            self._goals.send(client, number, "accepted")
            for length in range(2, int(order) + 1):
                self._feedback.write(f"{client} {number} {fibonacci(length)}")
            self._status.write(f"{client} {number} succeeded")
        for client, number, _ in self._results.take():
            result = fibonacci(self._orders.pop((client, number), 0))
            self._done += 1
            answer = f"{self._options.text}: {result}"
            self._results.send(client, number, answer)
            self._events.report(EventKind.SENT, answer, count=self._done)
        self._cancels.take()


class _ActionClient:
    """An action client that sends goals periodically, and reports right results with feedback."""

    def __init__(self, participant: Participant, options: NodeOptions, events: EventWriter) -> None:
        action = f"{options.topic}/_action"
        self._goals = _Service(participant, f"{action}/send_goal", server=False)
        self._cancels = _Service(participant, f"{action}/cancel_goal", server=False)
        self._results = _Service(participant, f"{action}/get_result", server=False)
        self._feedback = participant.reader(f"rt{action}/feedback")
        self._status = participant.reader(f"rt{action}/status")
        self._options, self._events = options, events
        self._name = os.urandom(16).hex()
        self._sent = self._right = 0
        self._steps: dict[str, int] = {}
        self._succeeded: set[str] = set()
        self._due = time.monotonic() + options.period

    def step(self) -> None:
        """Send a goal if one is due, and fetch the results of accepted goals."""
        if time.monotonic() >= self._due:
            self._due += self._options.period
            self._sent += 1
            self._goals.send(self._name, str(self._sent), str(FIBONACCI_ORDER))
            self._events.report(EventKind.SENT, f"goal {self._sent}", count=self._sent)
        for text in self._feedback.take():
            client, number, _ = text.split(" ", 2)
            if client == self._name:
                self._steps[number] = self._steps.get(number, 0) + 1
        for text in self._status.take():
            client, number, _ = text.split(" ", 2)
            if client == self._name:
                self._succeeded.add(number)
        for client, number, word in self._goals.take():
            if client == self._name and word == "accepted":
                self._results.send(client, number, "?")
        for client, number, answer in self._results.take():
            complete = self._steps.get(number) == FIBONACCI_ORDER - 1 and number in self._succeeded
            if (
                client == self._name
                and complete
                and answer.endswith(f": {fibonacci(FIBONACCI_ORDER)}")
            ):
                self._right += 1
                self._events.report(EventKind.HEARD, answer, count=self._right)
        self._cancels.take()


class _Composed:
    """A talker, a listener and a server in one process: one participant, one enclave."""

    def __init__(self, participant: Participant, options: NodeOptions, events: EventWriter) -> None:
        kinds = (_Talker, _Listener, _Server)
        self._nodes = [kind(participant, options, events) for kind in kinds]

    def step(self) -> None:
        """Do a step of each node."""
        for node in self._nodes:
            node.step()


_Node = (
    _Talker | _Listener | _Observer | _Server | _Client | _ActionServer | _ActionClient | _Composed
)

_ROLES: Mapping[str, type[_Node]] = {
    "talker": _Talker,
    "listener": _Listener,
    "observer": _Observer,
    "server": _Server,
    "client": _Client,
    "action_server": _ActionServer,
    "action_client": _ActionClient,
    "composed": _Composed,
}


def _dds_topic(topic: str) -> str:
    """Return the DDS topic of a ROS topic of a node in the namespace /."""
    return f"rt/{topic.removeprefix('/')}"


def _operands(number: int) -> tuple[int, int]:
    """Return the two numbers to add in a request; each request has a different sum."""
    return number, 3 * number + 1


class _Stopped(Exception):  # noqa: N818 - not an error
    """A request to stop, by Ctrl-C or SIGTERM."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a role until stopped; return the exit status."""
    arguments = sys.argv[1:] if arguments is None else arguments
    options = parse_options("sros_tool.demo.cyclone_node", _ROLES, arguments)
    _stop_on_signals()
    events = EventWriter(options.report)
    stage = ProcessStage.PARTICIPANT
    try:
        choice = choose_loadable(os.environ, _enclave_in(arguments))
        _say(options.role, choice.note)
        with Participant(domain_of(os.environ), choice.enclave) as participant:
            stage = ProcessStage.ENDPOINT
            node = _ROLES[options.role](participant, options, events)
            stage = ProcessStage.RUNNING
            events.report(EventKind.READY)
            while True:
                node.step()
                time.sleep(_POLL_SECONDS)
    except _Stopped:
        pass
    except SecurityRefusedError as refusal:
        events.report(EventKind.REFUSED, str(refusal), stage=stage)
        _say(options.role, f"refused by DDS Security: {refusal}")
        return 1
    except SrosError as error:
        events.report(EventKind.FAILED, str(error), stage=stage)
        _say(options.role, f"failed: {error}")
        return 1
    events.report(EventKind.DONE)
    return 0


def _enclave_in(arguments: Sequence[str]) -> str:
    enclave = "/"
    for flag, value in itertools.pairwise(split_ros_args(arguments)[1]):
        if flag in ("-e", "--enclave"):
            enclave = value
    return enclave


def _say(role: str, text: str) -> None:
    print(f"[{role}] {text}", file=sys.stderr, flush=True)


def _stop_on_signals() -> None:
    def stop(_number: int, _frame: FrameType | None) -> None:
        raise _Stopped

    handler: Callable[[int, FrameType | None], None] = stop
    signal.signal(signal.SIGINT, handler)
    signal.signal(signal.SIGTERM, handler)


if __name__ == "__main__":
    sys.exit(main())
