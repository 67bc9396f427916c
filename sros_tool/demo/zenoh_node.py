"""The nodes of the demo on Zenoh: ``python -m sros_tool.demo.zenoh_node ROLE``.

They take the configuration from the variables of rmw_zenoh, and use its key expressions, graph
tokens, attachments and messages in CDR (ros2/rmw_zenoh, docs/design.md).  Services and actions have
the names and messages of ROS 2, but send strings.  The role ``router`` is a Zenoh router.

A process whose connection is not accepted reports a refusal only if the port is open.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import signal
import socket
import struct
import sys
import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from types import FrameType
from typing import Any

import zenoh
import zenoh.ext

from sros_tool.demo.node_options import (
    FIBONACCI_ORDER,
    NodeOptions,
    fibonacci,
    parse_options,
    split_ros_args,
)
from sros_tool.runtime.events import EventKind, EventWriter, ProcessStage

_POLL_SECONDS = 0.02
_REPLY_SECONDS = 5.0
_NO_HASH = f"RIHS01_{'0' * 64}"
_MESSAGE = (
    "std_msgs::msg::dds_::String_",
    "RIHS01_df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18",
)
_SERVICE = (
    "example_interfaces::srv::dds_::AddTwoInts_",
    "RIHS01_e118de6bf5eeb66a2491b5bda11202e7b68f198d6f67922cf30364858239c81a",
)
_ACTION_TYPES = {
    "send_goal": ("example_interfaces::action::dds_::Fibonacci_SendGoal_", _NO_HASH),
    "get_result": ("example_interfaces::action::dds_::Fibonacci_GetResult_", _NO_HASH),
    "cancel_goal": ("action_msgs::srv::dds_::CancelGoal_", _NO_HASH),
    "feedback": ("example_interfaces::action::dds_::Fibonacci_FeedbackMessage_", _NO_HASH),
    "status": ("action_msgs::msg::dds_::GoalStatusArray_", _NO_HASH),
}
_QOS = "::,7:,:,:,,"
"""The QoS in a graph token: keep the last 7, and all else as rmw_zenoh has it by default."""
_CDR_HEADER = b"\0\1\0\0"
_DEFAULTS: Mapping[bool, Mapping[str, Any]] = {
    True: {"mode": "router", "listen": {"endpoints": ["tcp/localhost:7447"]}},
    False: {
        "mode": "peer",
        "listen": {"endpoints": ["tcp/localhost:0"]},
        "connect": {"endpoints": ["tcp/localhost:7447"]},
    },
}
"""What matters here of the defaults of rmw_zenoh, for a router and for a session."""


def _configuration(variables: Mapping[str, str], *, router: bool) -> zenoh.Config:
    """Return the configuration that the variables of rmw_zenoh choose.

    Raises:
        zenoh.ZError: a file or a value is not valid.
    """
    uri = variables.get(f"ZENOH_{'ROUTER' if router else 'SESSION'}_CONFIG_URI", "")
    if uri:
        config = zenoh.Config.from_json5(Path(uri).read_text(encoding="utf-8"))
    else:
        unsecured = {"scouting": {"multicast": {"enabled": False}}, **_DEFAULTS[router]}
        config = zenoh.Config.from_json5(json.dumps(unsecured))
    for each in filter(None, variables.get("ZENOH_CONFIG_OVERRIDE", "").split(";")):
        name, _, value = each.partition("=")
        config.insert_json5(name, value)
    return config


def _key_of(domain: str, name: str, kind: tuple[str, str]) -> str:
    """Return the key expression of a ROS name with its type and the hash of the type."""
    return "/".join((domain, name.strip("/"), *kind))


def _cdr_string(text: str, size: int = 0) -> bytes:
    """Return a std_msgs/String in CDR, filled with blanks up to ``size`` bytes."""
    data = text.encode().ljust(size) + b"\0"
    return _CDR_HEADER + struct.pack("<I", len(data)) + data


def _text_of(payload: zenoh.ZBytes | None) -> str:
    """Return the text of a std_msgs/String in CDR, without the blanks at its end."""
    data = bytes(payload) if payload is not None else b""
    return data[8:].rstrip(b"\0 ").decode(errors="replace")


class _Node:
    """One node in the graph; its enclave in tokens is what the process says of itself."""

    def __init__(self, session: zenoh.Session, domain: str, enclave: str, name: str) -> None:
        self.session, self.domain = session, domain
        self._place = f"{_mangled(enclave)}/%/{name}"
        self._entities = 0
        self._tokens: list[zenoh.LivelinessToken] = []
        self._announce("NN")

    def _announce(self, kind: str, name: str = "", types: tuple[str, str] = ("", "")) -> bytes:
        """Put an entity of the node into the graph, and return its GID."""
        number = self._entities
        self._entities += 1
        identity = f"{self.session.info.zid()}/0/{number}/{kind}"
        token = f"@ros2_lv/{self.domain}/{identity}/{self._place}"
        if name:
            token = "/".join((token, _mangled(name), *types, _QOS))
        self._tokens.append(self.session.liveliness().declare_token(token))
        return hashlib.blake2b(token.encode(), digest_size=16).digest()

    def publisher(self, name: str, kind: tuple[str, str] = _MESSAGE) -> _Publisher:
        """Return a publisher; ``name`` may also be a key expression with wildcards."""
        gid = _GID if "*" in name else self._announce("MP", name, kind)
        return _Publisher(self.session, _key_of(self.domain, name, kind), gid)

    def subscribe(self, name: str, hear: Any, kind: tuple[str, str] = _MESSAGE) -> Any:
        """Subscribe to a topic; ``hear`` gets each text."""
        if "*" not in name:
            self._announce("MS", name, kind)
        key = _key_of(self.domain, name, kind) if name != "/**" else f"{self.domain}/**"
        return self.session.declare_subscriber(key, lambda each: hear(_text_of(each.payload)))

    def serve(self, name: str, answer: Any, kind: tuple[str, str] = _SERVICE) -> Any:
        """Offer a service; ``answer`` gets each request and returns the reply."""
        self._announce("SS", name, kind)
        key = _key_of(self.domain, name, kind)

        def reply(query: zenoh.Query) -> None:
            with query:
                text = answer(_text_of(query.payload))
                query.reply(key, _cdr_string(text), attachment=_attachment(1, _GID))

        return self.session.declare_queryable(key, reply, complete=True)

    def client(self, name: str, kind: tuple[str, str] = _SERVICE) -> _Client:
        """Return a client of a service; ``name`` may also be a key expression with wildcards."""
        gid = _GID if "*" in name else self._announce("SC", name, kind)
        key = _key_of(self.domain, name, kind) if name != "/**" else f"{self.domain}/**"
        return _Client(self.session, key, gid)


_GID = b"\1" * 16


def _mangled(name: str) -> str:
    return name.replace("/", "%") or "%"


def _attachment(number: int, gid: bytes) -> zenoh.ZBytes:
    """Return the attachment of a message: sequence number, time (ns) and GID of the sender."""
    return zenoh.ext.z_serialize(
        (
            "sequence_number",
            zenoh.ext.Int64(number),
            "source_timestamp",
            zenoh.ext.Int64(time.time_ns()),
            "source_gid",
            gid,
        )
    )


class _Publisher:
    def __init__(self, session: zenoh.Session, key: str, gid: bytes) -> None:
        self._session, self._key, self._gid = session, key, gid
        self._sent = 0

    def put(self, text: str, size: int = 0) -> None:
        """Publish a text."""
        self._sent += 1
        self._session.put(
            self._key, _cdr_string(text, size), attachment=_attachment(self._sent, self._gid)
        )


class _Client:
    def __init__(self, session: zenoh.Session, key: str, gid: bytes) -> None:
        self._session, self._key, self._gid = session, key, gid
        self._asked = 0

    def call(self, text: str) -> Iterator[str]:
        """Send a request, and yield the replies."""
        self._asked += 1
        exact = "*" not in self._key
        replies = self._session.get(
            self._key,
            target=zenoh.QueryTarget.ALL_COMPLETE if exact else zenoh.QueryTarget.ALL,
            consolidation=zenoh.ConsolidationMode.NONE,
            payload=_cdr_string(text),
            attachment=_attachment(self._asked, self._gid),
            timeout=_REPLY_SECONDS,
        )
        yield from (_text_of(each.ok.payload) for each in replies if each.ok is not None)


class _Role:
    """What a node does; ``step`` is called again and again, and does what is due."""

    def __init__(self, node: _Node, options: NodeOptions, events: EventWriter) -> None:
        self._node, self._options, self._events = node, options, events
        self._kept: list[Any] = []
        self._due = time.monotonic() + options.period
        self._count = 0
        self.prepare()

    def prepare(self) -> None:
        """Declare what the node offers and hears."""

    def act(self) -> None:
        """Do what the node does once in each period."""

    def step(self) -> None:
        """Act if it is time."""
        if time.monotonic() >= self._due:
            self._due = max(self._due + self._options.period, time.monotonic())
            self.act()

    def sent(self, text: str) -> None:
        """Report a message that was sent."""
        self._count += 1
        self._events.report(EventKind.SENT, text, count=self._count)

    def heard(self, text: str) -> None:
        """Report a message that was received."""
        self._events.report(EventKind.HEARD, text)


class _Talker(_Role):
    """A talker that publishes its text and a number."""

    def prepare(self) -> None:
        self._publisher = self._node.publisher(self._options.topic)

    def act(self) -> None:
        text = f"{self._options.text}: {self._count + 1}"
        self._publisher.put(text, self._options.size)
        self.sent(text)


class _Listener(_Role):
    """A listener that reports each message."""

    def prepare(self) -> None:
        self._kept.append(self._node.subscribe(self._options.topic, self.heard))


class _Relay(_Talker):
    """A talker that also listens."""

    def prepare(self) -> None:
        super().prepare()
        self._kept.append(self._node.subscribe(self._options.topic, self.heard))


class _Observer(_Role):
    """An observer that counts the publishers of topics in the graph."""

    def prepare(self) -> None:
        self._tokens: set[str] = set()
        graph = self._node.session.liveliness()
        self._kept.append(
            graph.declare_subscriber(f"@ros2_lv/{self._node.domain}/**", self._change, history=True)
        )

    def _change(self, sample: zenoh.Sample) -> None:
        added = sample.kind == zenoh.SampleKind.PUT
        (self._tokens.add if added else self._tokens.discard)(str(sample.key_expr))

    def act(self) -> None:
        entities = [each.split("/") for each in tuple(self._tokens)]
        found = [each[9] for each in entities if len(each) > 9 and each[5] == "MP"]
        topics = (self._options.topic, *self._options.also)
        counts = {topic: found.count(_mangled(topic)) for topic in topics}
        self._events.report(EventKind.SEEN, " ".join(sorted(set(found))), publishers=counts)


class _Server(_Role):
    """A server that adds two numbers, and reports the requests that it executes."""

    def prepare(self) -> None:
        self._kept.append(self._node.serve(self._options.topic, self._answer))

    def _answer(self, request: str) -> str:
        self.heard(request)
        question = request.rpartition(": ")[2]
        try:
            first, second = map(int, question.split(" + "))
        except ValueError:
            return "no such sum"
        answer = f"{self._options.text}: {question} = {first + second}"
        self.sent(answer)
        return answer


class _Caller(_Role):
    """A client that requests sums, and reports the right answers."""

    def prepare(self) -> None:
        self._client = self._node.client(self._options.topic)

    def act(self) -> None:
        first, second = self._count + 1, 3 * (self._count + 1) + 1
        request = f"{self._options.text}: {first} + {second}"
        self.sent(request)
        for answer in self._client.call(request):
            if answer.endswith(f": {first} + {second} = {first + second}"):
                self.heard(answer)


class _ActionServer(_Role):
    """An action server that computes Fibonacci numbers, with feedback, status and result."""

    def prepare(self) -> None:
        action = f"{self._options.topic}/_action"
        topics = {
            each: self._node.publisher(f"{action}/{each}", _ACTION_TYPES[each])
            for each in ("feedback", "status")
        }

        def accept(request: str) -> str:
            self.heard(request)
            goal = request.rpartition(": ")[2]
            for length in range(2, FIBONACCI_ORDER + 1):
                topics["feedback"].put(f"{goal} {fibonacci(length)}")
            topics["status"].put(f"{goal} succeeded")
            return "accepted"

        def result(_request: str) -> str:
            answer = f"{self._options.text}: {fibonacci(FIBONACCI_ORDER)}"
            self.sent(answer)
            return answer

        answers = {"send_goal": accept, "get_result": result, "cancel_goal": lambda _: "refused"}
        for each, answer in answers.items():
            self._kept.append(self._node.serve(f"{action}/{each}", answer, _ACTION_TYPES[each]))


class _ActionCaller(_Role):
    """An action client that reports right results of goals with all their feedback."""

    def prepare(self) -> None:
        action = f"{self._options.topic}/_action"
        self._clients = {
            each: self._node.client(f"{action}/{each}", _ACTION_TYPES[each])
            for each in ("send_goal", "get_result", "cancel_goal")
        }
        self._steps: dict[str, list[str]] = {"feedback": [], "status": []}
        for each, heard in self._steps.items():
            kept = self._node.subscribe(f"{action}/{each}", heard.append, _ACTION_TYPES[each])
            self._kept.append(kept)

    def act(self) -> None:
        goal = f"goal {self._count + 1} of {os.getpid()}"
        self.sent(f"{self._options.text}: {goal}")
        if "accepted" not in self._clients["send_goal"].call(f"{self._options.text}: {goal}"):
            return
        latest = time.monotonic() + _REPLY_SECONDS
        while not self._is_done(goal) and time.monotonic() < latest:
            time.sleep(_POLL_SECONDS)
        for answer in self._clients["get_result"].call(goal):
            if self._is_done(goal) and answer.endswith(f": {fibonacci(FIBONACCI_ORDER)}"):
                self.heard(answer)

    def _is_done(self, goal: str) -> bool:
        steps = [each for each in self._steps["feedback"] if each.startswith(f"{goal} ")]
        return len(steps) == FIBONACCI_ORDER - 1 and f"{goal} succeeded" in self._steps["status"]


class _Router(_Role):
    """A router, which passes on what others say."""


_FLOOD_AT_ONCE = 20
_FLOOD_PAUSE = 0.02
_GARBAGE = b"\0" * 64


def _flood(endpoint: str, events: EventWriter, stop: threading.Event) -> None:
    """Make useless connections to an endpoint until stopped."""
    while not stop.wait(_FLOOD_PAUSE):
        made = 0
        for _ in range(_FLOOD_AT_ONCE):
            with contextlib.suppress(OSError):
                with socket.create_connection(_address(endpoint), 1) as useless:
                    useless.sendall(_GARBAGE)
                made += 1
        if made:
            events.report(EventKind.READY)
            break
    while not stop.wait(_FLOOD_PAUSE):
        with (
            contextlib.suppress(OSError),
            socket.create_connection(_address(endpoint), 1) as useless,
        ):
            useless.sendall(_GARBAGE)


_ROLES: Mapping[str, type[_Role]] = {
    "talker": _Talker,
    "listener": _Listener,
    "relay": _Relay,
    "observer": _Observer,
    "server": _Server,
    "client": _Caller,
    "action_server": _ActionServer,
    "action_client": _ActionCaller,
    "router": _Router,
}


_FLOODER = "flooder"


class _RefusedError(Exception):
    """No connection, although the port is open."""


def _open(config: zenoh.Config, patience: float, stop: threading.Event) -> zenoh.Session | None:
    """Open a session, and wait until it is connected to its router; return None if stopped before.

    Raises:
        _RefusedError: that took longer than ``patience`` seconds, and the router's port is open.
        zenoh.ZError: the session does not open for another reason.
    """
    mode = json.loads(config.get_json("mode"))
    session = None
    latest = time.monotonic() + patience
    reason = "no connection"
    while True:
        try:
            session = session or zenoh.open(config)
            if mode == "router" or list(session.info.routers_zid()):
                return session
        except zenoh.ZError as error:
            reason = str(error).partition(" at /")[0]
        if time.monotonic() >= latest:
            break
        if stop.wait(_POLL_SECONDS):
            return None
    endpoint = json.loads(config.get_json("connect/endpoints"))[0]
    if _is_open(endpoint):
        raise _RefusedError(f"{reason} to {endpoint} within {patience:g} s, whose port is open")
    raise zenoh.ZError(f"nobody listens at {endpoint}")


def _is_open(endpoint: str) -> bool:
    try:
        socket.create_connection(_address(endpoint), 5).close()
    except OSError:
        return False
    return True


def _address(endpoint: str) -> tuple[str, int]:
    host, _, port = endpoint.partition("/")[2].rpartition(":")
    return host.strip("[]"), int(port)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a role until stopped; return the exit status."""
    arguments = sys.argv[1:] if arguments is None else arguments
    roles = (*_ROLES, _FLOODER)
    options = parse_options("sros_tool.demo.zenoh_node", roles, arguments)
    events = EventWriter(options.report)
    stop = threading.Event()

    def end(_number: int, _frame: FrameType | None) -> None:
        stop.set()

    signal.signal(signal.SIGINT, end)
    signal.signal(signal.SIGTERM, end)
    # It warns of each connection that names are not verified, as the configuration says.
    zenoh.init_log_from_env_or("error,zenoh_link_tls=warn,zenoh_link_tls::utils=error")
    stage = ProcessStage.PARTICIPANT
    try:
        config = _configuration(os.environ, router=options.role == "router")
        if options.role == _FLOODER:
            _flood(json.loads(config.get_json("connect/endpoints"))[0], events, stop)
            return 0
        session = _open(config, options.patience, stop)
        if session is None:
            return 0
        stage = ProcessStage.ENDPOINT
        domain = os.environ.get("ROS_DOMAIN_ID", "0")
        name = options.role if options.role != "router" else "rmw_zenohd"
        node = _Node(session, domain, _enclave_in(arguments), name)
        role = _ROLES[options.role](node, options, events)
        stage = ProcessStage.RUNNING
        events.report(EventKind.READY)
        while not stop.wait(_POLL_SECONDS):
            role.step()
    except _RefusedError as refusal:
        events.report(EventKind.REFUSED, str(refusal), stage=stage)
        return 1
    except (zenoh.ZError, OSError) as error:
        events.report(EventKind.FAILED, str(error).partition(" at /")[0], stage=stage)
        return 1
    events.report(EventKind.DONE)
    return 0


def _enclave_in(arguments: Sequence[str]) -> str:
    enclave = ""
    for flag, value in pairwise(split_ros_args(arguments)[1]):
        if flag in ("-e", "--enclave"):
            enclave = value
    return enclave


if __name__ == "__main__":
    status = main()
    sys.stderr.flush()
    os._exit(status)  # the threads of an open session would delay the end
