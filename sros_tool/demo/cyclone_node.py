"""The demo's nodes on Cyclone DDS: ``python -m sros_tool.demo.cyclone_node ROLE``.

The nodes read the environment of a ROS 2 node, and use the DDS topics and types of ROS messages. So
rclpy nodes receive their messages, and both kinds of nodes are started in the same way.

Services and actions use the DDS topics of rmw_cyclonedds (rq/...Request, rr/...Reply,
rt/..._action/...), but send strings: names and rights are as in ROS 2, types are not. A request is
"CLIENT NUMBER TEXT"; the reply begins with the same CLIENT and NUMBER.
"""

from __future__ import annotations

import os
import signal
import sys
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from types import FrameType

from sros_tool.demo.nodes import ROLES, Call, Hear, enclave_in, parse_options, ros_type
from sros_tool.errors import SrosError
from sros_tool.names import dds_names
from sros_tool.runtime.cyclone import Participant, Reader, SecurityRefusedError
from sros_tool.runtime.events import EventKind, EventWriter, ProcessStage
from sros_tool.runtime.variables import choose_loadable, domain_of

_POLL_SECONDS = 0.02


class CycloneNode:
    """A node in a DDS participant; `poll` hands over received messages."""

    def __init__(self, participant: Participant, *, reliable: bool) -> None:
        self._participant, self._reliable = participant, reliable
        self._name = os.urandom(16).hex()
        self._readers: list[tuple[Reader, Hear]] = []
        self._counters: list[tuple[Reader, Callable[[int], None]]] = []

    def publisher(self, name: str) -> Hear:
        """Return a function that publishes a text."""
        return self._participant.writer(self.wire_name(name)).write

    def subscribe(self, name: str, hear: Hear) -> None:
        """Subscribe to a topic; ``hear`` is called with every text received."""
        reader = self._participant.reader(self.wire_name(name), reliable=self._reliable)
        self._readers.append((reader, hear))

    def types(self, name: str, *, of_publishers: bool) -> Sequence[str]:
        """Return the ROS types of a topic's discovered publishers.

        If ``of_publishers`` is False, return the types of the topic's subscriptions.
        """
        participant, topic = self._participant, self.wire_name(name)
        endpoints = participant.publications() if of_publishers else participant.subscriptions()
        return [ros_type(endpoint.type_name) for endpoint in endpoints if endpoint.topic == topic]

    def count(self, name: str, kind: str, on_count: Callable[[int], None]) -> str:
        """Call ``on_count`` with the number of new messages of the type ``kind``, again and again.

        The result is "", because counting is always possible.
        """
        package, _, name_of_type = kind.rpartition("/")
        type_name = f"{package.replace('/', '::')}::dds_::{name_of_type}_"
        self._counters.append(
            (self._participant.counter(self.wire_name(name), type_name), on_count)
        )
        return ""

    def serve(self, name: str, answer: Callable[[str], str]) -> None:
        """Offer a service; ``answer`` is called with a request and returns the reply."""
        (requests,), (replies,) = dds_names("request", name)
        reader, writer = self._participant.reader(requests), self._participant.writer(replies)

        def reply(text: str) -> None:
            client, number, request = text.split(" ", 2)
            writer.write(f"{client} {number} {answer(request)}")

        self._readers.append((reader, reply))

    def client(self, name: str) -> Call:
        """Return a function that sends a request to a service.

        Its arguments are the request and the function that gets the replies.
        """
        (requests,), (replies,) = dds_names("request", name)
        reader, writer = self._participant.reader(replies), self._participant.writer(requests)
        waiting: list[Hear] = []

        def receive(text: str) -> None:
            client, number, reply = text.split(" ", 2)
            if client == self._name:
                waiting[int(number)](reply)

        def call(request: str, hear: Hear) -> None:
            writer.write(f"{self._name} {len(waiting)} {request}")
            waiting.append(hear)

        self._readers.append((reader, receive))
        return call

    def watch(self) -> None:
        """Do nothing: every participant discovers publishers."""

    def publications(self) -> Sequence[str]:
        """Return the DDS topics of the discovered publishers."""
        return [publication.topic for publication in self._participant.publications()]

    def wire_name(self, topic: str) -> str:
        """Return the DDS topic of a ROS topic of a node in the namespace /."""
        return f"rt/{topic.removeprefix('/')}"

    def poll(self) -> None:
        """Hand received messages to their receivers."""
        for reader, hear in self._readers:
            for text in reader.take():
                hear(text)
        for reader, heard in self._counters:
            heard(reader.count())


_ROLES = tuple(role for role in ROLES if role not in ("relay", "router"))


class _Stopped(Exception):  # noqa: N818 - not an error
    """Raised to stop on Ctrl-C or SIGTERM."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a node in a role until it is stopped; return the exit status."""
    arguments = sys.argv[1:] if arguments is None else arguments
    options = parse_options("sros_tool.demo.cyclone_node", _ROLES, arguments)
    _stop_on_signals()
    events = EventWriter(options.report)
    stage = ProcessStage.PARTICIPANT
    try:
        choice = choose_loadable(os.environ, enclave_in(arguments, "/"))
        _say(options.role, choice.note)
        with Participant(domain_of(os.environ), choice.enclave) as participant:
            stage = ProcessStage.ENDPOINT
            node = CycloneNode(participant, reliable=not options.by_hand)
            role = ROLES[options.role](node, options, events)
            stage = ProcessStage.RUNNING
            events.report(EventKind.READY)
            with suppress(_Stopped):
                while True:
                    role.step()
                    node.poll()
                    time.sleep(_POLL_SECONDS)
            role.end()
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


def _say(role: str, text: str) -> None:
    print(f"[{role}] {text}", file=sys.stderr, flush=True)


def _stop_on_signals() -> None:
    def stop(_number: int, _frame: FrameType | None) -> None:
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, signal.SIG_IGN)
        raise _Stopped

    handler: Callable[[int, FrameType | None], None] = stop
    signal.signal(signal.SIGINT, handler)
    signal.signal(signal.SIGTERM, handler)


if __name__ == "__main__":
    sys.exit(main())
