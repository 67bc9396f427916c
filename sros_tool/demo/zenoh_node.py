"""The nodes of the demo on Zenoh: ``python -m sros_tool.demo.zenoh_node ROLE``.

The nodes take the configuration from the variables of rmw_zenoh, and use the key expressions, graph
tokens, attachments and CDR messages of rmw_zenoh (ros2/rmw_zenoh, docs/design.md).  Services and
actions have the names and messages of ROS 2, but send strings.  The role ``router`` is a Zenoh
router.

A process without a connection reports a refusal only if the router's port is open.
"""

from __future__ import annotations

import contextlib
import hashlib
import itertools
import json
import os
import signal
import socket
import struct
import sys
import threading
import time
from collections.abc import Callable, Sequence
from types import FrameType

import zenoh
import zenoh.ext

from sros_tool.demo.nodes import (
    ROLES,
    Call,
    Hear,
    NodeOptions,
    NodeRole,
    enclave_in,
    parse_options,
    ros_type,
)
from sros_tool.graph.zenoh_tokens import NODE, configuration
from sros_tool.runtime.events import EventKind, EventWriter, ProcessStage

_POLL_SECONDS = 0.02
_REPLY_SECONDS = 5.0
_NO_HASH = f"RIHS01_{'0' * 64}"
_MESSAGE_TYPE = (
    "std_msgs::msg::dds_::String_",
    "RIHS01_df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18",
)
_SERVICE_TYPE = (
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
_GRAPH_QOS = "::,7:,:,:,,"
"""The QoS in a graph token: keep the last 7, else the defaults of rmw_zenoh."""
_CDR_HEADER = b"\0\1\0\0"


def _type_of_topic(name: str, default: tuple[str, str]) -> tuple[str, str]:
    """Return the type and type hash of a part of an action; ``default`` for all other names."""
    return _ACTION_TYPES.get(name.rpartition("/_action/")[2], default)


def _cdr_string(text: str, size: int = 0) -> bytes:
    """Return a std_msgs/String in CDR, filled with blanks up to ``size`` bytes."""
    data = text.encode().ljust(size) + b"\0"
    return _CDR_HEADER + struct.pack("<I", len(data)) + data


def _text_of(payload: zenoh.ZBytes | None) -> str:
    """Return the text of a std_msgs/String in CDR, without the blanks at its end."""
    data = bytes(payload) if payload is not None else b""
    return data[8:].rstrip(b"\0 ").decode(errors="replace")


class _ZenohNode:
    """A node in the graph; the process itself chooses the enclave in the node's tokens.

    Messages of the node have ``size`` bytes or more.  A router, which is no node, has no ``name``.
    """

    def __init__(
        self, session: zenoh.Session, domain: str, enclave: str, name: str, size: int
    ) -> None:
        self._session, self._domain, self._size = session, domain, size
        self._enclave = self.wire_name(enclave)
        self._place = f"{self._enclave}/%/{name}"
        self._entities = 0
        self._graph: set[str] = set()
        self._declared: list[object] = []
        self._keep = self._declared.append  # an object without a reference is undeclared
        if name:
            self._announce(NODE)

    def _announce(self, kind: str, name: str = "", types: tuple[str, str] = ("", "")) -> bytes:
        """Put an entity of the node into the graph, and return its GID."""
        number = self._entities
        self._entities += 1
        identity = f"{self._session.info.zid()}/0/{number}/{kind}"
        token = f"@ros2_lv/{self._domain}/{identity}/{self._place}"
        if name:
            token = "/".join((token, self.wire_name(name), *types, _GRAPH_QOS))
        self._keep(self._session.liveliness().declare_token(token))
        return hashlib.blake2b(token.encode(), digest_size=16).digest()

    def publisher(self, name: str) -> Hear:
        """Return a function that publishes a text; ``name`` may have Zenoh wildcards."""
        kind = _type_of_topic(name, _MESSAGE_TYPE)
        gid = _GID if "*" in name else self._announce("MP", name, kind)
        key, numbers = self._key_of(name, kind), itertools.count(1)

        def publish(text: str) -> None:
            attachment = _attachment(next(numbers), gid)
            self._session.put(key, _cdr_string(text, self._size), attachment=attachment)

        return publish

    def subscribe(self, name: str, hear: Hear) -> None:
        """Subscribe to a topic; ``hear`` gets each text."""
        kind = _type_of_topic(name, _MESSAGE_TYPE)
        if "*" not in name:
            self._announce("MS", name, kind)
        key = self._key_of(name, kind)
        self._keep(self._session.declare_subscriber(key, lambda it: hear(_text_of(it.payload))))

    def types(self, name: str, *, of_publishers: bool) -> Sequence[str]:
        """Return the ROS types of a topic's publishers in the graph.

        If ``of_publishers`` is False, return the types of the topic's subscriptions.
        """
        return [ros_type(kind) for kind, _ in self._types(name, "MP" if of_publishers else "MS")]

    def _types(self, name: str, kind: str) -> list[tuple[str, str]]:
        """Return the types, with their hashes, of a topic's endpoints of one kind."""
        chunks = (token.split("/") for token in tuple(self._graph) if _kind_of(token) == kind)
        wire = self.wire_name(name)
        return [(of[10], of[11]) for of in chunks if len(of) > 11 and of[9] == wire]

    def count(self, name: str, kind: str, on_count: Callable[[int], None]) -> str:
        """Call ``on_count`` with 1 for each message of the type ``kind`` on the topic ``name``.

        The topic's publishers announce the hashes of the type in the graph.  The result is "",
        because counting is always possible.
        """
        for typed in {typed for typed in self._types(name, "MP") if ros_type(typed[0]) == kind}:
            key = self._key_of(name, typed)
            self._keep(self._session.declare_subscriber(key, lambda _: on_count(1)))
        return ""

    def serve(self, name: str, answer: Callable[[str], str]) -> None:
        """Offer a service; ``answer`` gets each request and returns the reply."""
        kind = _type_of_topic(name, _SERVICE_TYPE)
        self._announce("SS", name, kind)
        key = self._key_of(name, kind)

        def reply(query: zenoh.Query) -> None:
            with query:
                text = answer(_text_of(query.payload))
                query.reply(key, _cdr_string(text), attachment=_attachment(1, _GID))

        self._keep(self._session.declare_queryable(key, reply, complete=True))

    def client(self, name: str) -> Call:
        """Return a function that sends a request to a service.

        Its arguments are the request and the function that gets every reply.  ``name`` may have
        Zenoh wildcards.
        """
        kind = _type_of_topic(name, _SERVICE_TYPE)
        gid = _GID if "*" in name else self._announce("SC", name, kind)
        key, numbers = self._key_of(name, kind), itertools.count(1)
        exact = "*" not in key

        def call(request: str, hear: Hear) -> None:
            replies = self._session.get(
                key,
                target=zenoh.QueryTarget.ALL_COMPLETE if exact else zenoh.QueryTarget.ALL,
                consolidation=zenoh.ConsolidationMode.NONE,
                payload=_cdr_string(request),
                attachment=_attachment(next(numbers), gid),
                timeout=_REPLY_SECONDS,
            )
            for reply in replies:
                if reply.ok is not None:
                    hear(_text_of(reply.ok.payload))

        return call

    def watch(self) -> None:
        """Begin to discover nodes and their endpoints, by the tokens in the graph."""

        def change(sample: zenoh.Sample) -> None:
            token = str(sample.key_expr)
            if sample.kind == zenoh.SampleKind.PUT:
                self._graph.add(token)
                return
            self._graph.discard(token)
            if _kind_of(token) == NODE:
                # As in rmw_zenoh, all entities of the node go with its token, whatever enclave the
                # token has.
                node = _node_of(token)
                self._graph.difference_update({e for e in self._graph if _node_of(e) == node})

        graph = self._session.liveliness()
        self._keep(graph.declare_subscriber(f"@ros2_lv/{self._domain}/**", change, history=True))

    def publications(self) -> Sequence[str]:
        """Return the topics that have a publisher and the services that have a server now."""
        tokens = [token for token in tuple(self._graph) if _kind_of(token) in ("MP", "SS")]
        return [token.split("/")[9] for token in tokens]

    def erase(self, name: str) -> int:
        """Try to remove the nodes of this name from the graph, and return their number.

        Withdraws the token of each node, with the enclave of this process, as if the node had
        ended.
        """
        other_tokens = [
            chunks
            for token in tuple(self._graph)
            if _kind_of(token) == NODE
            and (chunks := token.split("/"))[8] == name
            and chunks[6] != self._enclave
        ]
        for chunks in other_tokens:
            token = "/".join((*chunks[:6], self._enclave, *chunks[7:]))
            own_token = self._session.liveliness().declare_token(token)
            own_token.undeclare()  # type: ignore[no-untyped-call]
        return len(other_tokens)

    def wire_name(self, topic: str) -> str:
        """Return a name in the form that tokens have."""
        return topic.replace("/", "%") or "%"

    def _key_of(self, name: str, kind: tuple[str, str]) -> str:
        """Return the key expression of a ROS name with its type and the hash of the type."""
        parts = ("**",) if name == "/**" else (name.strip("/"), *kind)
        return "/".join((self._domain, *parts))


def _kind_of(token: str) -> str:
    """Return the kind of entity that a graph token announces."""
    return token.split("/")[5]


def _node_of(token: str) -> tuple[str, ...]:
    """Return the parts of a token that identify its node: session, number, namespace and name."""
    chunks = token.split("/")
    return (*chunks[2:4], *chunks[7:9])


_GID = b"\1" * 16


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


class _Eraser(NodeRole):
    """A node that takes the nodes of talkers out of the graph."""

    def __init__(self, node: _ZenohNode, options: NodeOptions, events: EventWriter) -> None:
        self._zenoh_node = node
        super().__init__(node, options, events)

    def prepare(self) -> None:
        self._zenoh_node.watch()

    def act(self) -> None:
        if self._zenoh_node.erase("talker"):
            self.report_sent(f"erased {self._sent + 1}")


_FLOODER, _ERASER = "flooder", "eraser"


class _RefusedError(Exception):
    """Raised if there is no connection to a router, although its port is open."""


def _open(config: zenoh.Config, patience: float, stop: threading.Event) -> zenoh.Session | None:
    """Open a session, and wait until it is connected to its router; return None if stopped before.

    Raises:
        _RefusedError: there was no connection within ``patience`` seconds, but the router's port is
            open.
        zenoh.ZError: the session does not open for another reason.
    """
    mode = json.loads(config.get_json("mode"))
    # By the files of sros, a session waits for its router forever; here, this function waits
    # instead.
    config.insert_json5("connect/timeout_ms", "0")
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
        raise _RefusedError(
            f"{reason} to {endpoint} within {patience:g} s, though its port is open"
        )
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
    roles = (*(role for role in ROLES if role != "composed"), _FLOODER, _ERASER)
    options = parse_options("sros_tool.demo.zenoh_node", roles, arguments)
    events = EventWriter(options.report)
    stop = threading.Event()

    def end(_number: int, _frame: FrameType | None) -> None:
        stop.set()

    signal.signal(signal.SIGINT, end)
    signal.signal(signal.SIGTERM, end)
    # The configuration chooses not to verify host names: no warning about this at each connection.
    zenoh.init_log_from_env_or("error,zenoh_link_tls=warn,zenoh_link_tls::utils=error")
    stage = ProcessStage.PARTICIPANT
    try:
        config = configuration(os.environ, router=options.role == "router")
        if options.role == _FLOODER:
            _flood(json.loads(config.get_json("connect/endpoints"))[0], events, stop)
            return 0
        session = _open(config, options.patience, stop)
        if session is None:
            return 0
        stage = ProcessStage.ENDPOINT
        domain = os.environ.get("ROS_DOMAIN_ID", "0")
        name = options.role if options.role != "router" else ""
        node = _ZenohNode(session, domain, enclave_in(arguments, ""), name, options.size)
        kind = _Eraser if options.role == _ERASER else ROLES[options.role]
        role = kind(node, options, events)
        stage = ProcessStage.RUNNING
        events.report(EventKind.READY)
        while not stop.wait(_POLL_SECONDS):
            role.step()
        role.end()
    except _RefusedError as refusal:
        events.report(EventKind.REFUSED, str(refusal), stage=stage)
        return 1
    except (zenoh.ZError, OSError) as error:
        events.report(EventKind.FAILED, str(error).partition(" at /")[0], stage=stage)
        return 1
    events.report(EventKind.DONE)
    return 0


if __name__ == "__main__":
    status = main()
    sys.stderr.flush()
    os._exit(status)  # without waiting for the threads of the open session
