"""The demo's nodes on rclpy: ``python -m sros_tool.demo.ros_node ROLE [--ros-args ...]``.

The nodes are ordinary ROS 2 nodes.  rclpy and the ROS interfaces are imported when a role starts,
so that this module can be imported without ROS.
"""

from __future__ import annotations

import importlib
import signal
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from functools import partial
from typing import Any

from sros_tool.demo.nodes import (
    FIBONACCI_ORDER,
    STRING,
    NodeOptions,
    OtherTypes,
    fibonacci,
    parse_options,
)
from sros_tool.runtime.events import EventKind, EventWriter, ProcessStage

_LOG_FLUSH_SECONDS = 0.3
"""Seconds for Fast DDS to write its log: lines are lost if the process exits earlier."""

_TICK_SECONDS = 0.1
"""Seconds between two checks for a signal."""
_QUEUE_DEPTH = 10
_FIBONACCI_PACKAGES = ("example_interfaces", "test_msgs", "action_tutorials_interfaces")

_Build = Callable[[Any, NodeOptions, EventWriter], Sequence[Any] | None]
"""A function that adds a role's endpoints to a node, and returns additional nodes."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a node in a role until it is stopped; return the exit status."""
    arguments = sys.argv[1:] if arguments is None else arguments
    options = parse_options("sros_tool.demo.ros_node", _ROLES, arguments)
    return _run_role(_ROLES[options.role], options, [sys.argv[0], *arguments])


def _run_role(build: _Build, options: NodeOptions, arguments: Sequence[str]) -> int:
    """Create a node, add its endpoints with ``build``, and spin until stopped.

    ``arguments`` is the whole command line; rclpy reads the ``--ros-args`` in it.  Returns
    the exit status.
    """
    name = "talker" if options.role == "composed" else options.role
    events = EventWriter(options.report)
    try:
        import rclpy
    except ImportError as error:
        return _fail(name, error, ProcessStage.IMPORT, events)
    stage = ProcessStage.PARTICIPANT
    nodes: list[Any] = []
    ended = _signal_watch()
    try:
        from rclpy.signals import SignalHandlerOptions

        rclpy.init(args=list(arguments), signal_handler_options=SignalHandlerOptions.NO)
        nodes.append(_create_node_by_hand(name) if options.by_hand else rclpy.create_node(name))
        stage = ProcessStage.ENDPOINT
        nodes += build(nodes[0], options, events) or ()
        stage = ProcessStage.RUNNING
        events.report(EventKind.READY)
        _spin(nodes, ended)
    except ImportError as error:
        return _fail(name, error, ProcessStage.IMPORT, events)
    except Exception as error:
        if not ended():  # a failure while the node is stopped does not count
            return _fail(name, error, stage, events)
    finally:
        # Leave the domain and free shared memory; an incomplete node may raise here.
        with suppress(Exception):
            for node in nodes:
                node.destroy_node()
            rclpy.try_shutdown()
    events.report(EventKind.DONE)
    return 0


def _create_node_by_hand(name: str) -> Any:
    """Return a node without /rosout, parameters and type descriptions, which need more rights."""
    import rclpy
    from rclpy.parameter import Parameter

    return rclpy.create_node(
        name,
        enable_rosout=False,
        start_parameter_services=False,
        parameter_overrides=[Parameter("start_type_description_service", value=False)],
    )


def _spin(nodes: Sequence[Any], ended: Callable[[], bool]) -> None:
    from rclpy.executors import SingleThreadedExecutor

    executor = SingleThreadedExecutor()
    for node in nodes:
        executor.add_node(node)
    while not ended():
        executor.spin_once(timeout_sec=_TICK_SECONDS)


def _signal_watch() -> Callable[[], bool]:
    """Handle SIGINT and SIGTERM; return a function that tells whether a signal has arrived.

    The handlers of rclpy are not used: they shut the rclpy context down in the middle of a
    callback, or just before an endless wait, and a KeyboardInterrupt inside the C++ code of rclpy
    becomes another error ("Unable to convert call argument").
    """
    received: list[int] = []
    for signal_number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(signal_number, lambda number, _frame: received.append(number))
    return lambda: bool(received)


def _fail(node_name: str, error: Exception, stage: ProcessStage, events: EventWriter) -> int:
    reason = f"{type(error).__name__}: {error}"
    time.sleep(_LOG_FLUSH_SECONDS)
    sys.stdout.flush()
    events.report(EventKind.FAILED, reason, stage=stage)
    print(f"{node_name}: failed at stage {stage.value}: {reason}", file=sys.stderr)
    return 1


# ── topics ─────────────────────────────────────────────────────────────────────────────────


def _talker(node: Any, options: NodeOptions, events: EventWriter) -> None:
    """Publish the text with a running number, or a message of another type, periodically."""
    message = _message_class(options.type)
    publisher = node.create_publisher(message, options.topic, _QUEUE_DEPTH)
    sent = 0

    def speak() -> None:
        nonlocal sent
        sent += 1
        is_text = options.type == STRING
        text = f"{options.text}: {sent}" if is_text else f"{options.type}: {sent}"
        node.get_logger().info(f"Publishing: '{text}'")
        publisher.publish(message(data=text) if is_text else message())
        events.report(EventKind.SENT, text)

    node.create_timer(options.period, speak)
    if options.by_hand:
        types = partial(_types_of_endpoints, node.get_subscriptions_info_by_topic, options.topic)
        node.create_timer(options.period, OtherTypes(options, events, types).step)


def _message_class(kind: str) -> Any:
    """Return the class of a ROS type such as ``geometry_msgs/msg/Twist``.

    Raises:
        ImportError: the package of the type is not installed, or lacks the type.
    """
    package, _, name = kind.replace("/", ".").rpartition(".")
    try:
        return getattr(importlib.import_module(package), name)
    except AttributeError as error:
        raise ImportError(str(error)) from error


def _types_of_endpoints(
    endpoint_infos: Callable[[str], Sequence[Any]], topic: str
) -> Sequence[str]:
    return [info.topic_type for info in endpoint_infos(topic)]


def _listener(node: Any, options: NodeOptions, events: EventWriter) -> None:
    """Log and report every message."""
    from std_msgs.msg import String

    def hear(message: Any) -> None:
        node.get_logger().info(f"I heard: '{message.data}'")
        events.report(EventKind.HEARD, message.data)

    # The subscription needs no variable: its node keeps it alive.
    if not options.by_hand:
        node.create_subscription(String, options.topic, hear, _QUEUE_DEPTH)
        return
    from rclpy.qos import qos_profile_sensor_data  # receives from publishers of any reliability

    texts = node.create_subscription(String, options.topic, hear, qos_profile_sensor_data)
    types = partial(_types_of_endpoints, node.get_publishers_info_by_topic, options.topic)

    def count(kind: str, on_count: Callable[[int], None]) -> str:
        try:
            message = _message_class(kind)
        except ImportError as error:
            return f", which this listener cannot hear ({error}): add --backend cyclone"
        if {*types()} != {kind}:
            return ", which this listener cannot hear next to another type: add --backend cyclone"
        node.destroy_subscription(texts)  # Fast DDS allows one type per topic in a process
        get = (message, options.topic, lambda _raw: on_count(1), qos_profile_sensor_data)
        node.create_subscription(*get, raw=True)
        return ""

    others = OtherTypes(options, events, types, count)
    node.create_timer(options.period, others.step)
    node.context.on_shutdown(partial(OtherTypes.report_heard, others))


def _observer(node: Any, options: NodeOptions, events: EventWriter) -> None:
    """Count the publishers of topics, as any intruder could."""

    def count_publishers() -> None:
        counts = {topic: node.count_publishers(topic) for topic in (options.topic, *options.also)}
        # A node lists its own topics too, so the list of names is only logged: the count of
        # publishers shows whether a talker is visible.
        listed = " ".join(sorted(name for name, _ in node.get_topic_names_and_types()))
        node.get_logger().info(f"Publishers: {counts}; topics: {listed}")
        events.report(EventKind.SEEN, listed, publishers=counts)

    node.create_timer(options.period, count_publishers)


# ── services ───────────────────────────────────────────────────────────────────────────────


def _server(node: Any, options: NodeOptions, events: EventWriter) -> None:
    """Answer every request with the negated truth value.

    Every ROS 2 installation has the type std_srvs/SetBool, and DDS Security checks only the name of
    a service.
    """
    from std_srvs.srv import SetBool

    def answer(request: Any, response: Any) -> Any:
        response.success = not request.data
        response.message = f"{options.text}: not {request.data} = {response.success}"
        node.get_logger().info(f"Answering: '{response.message}'")
        events.report(EventKind.SENT, response.message)
        return response

    node.create_service(SetBool, options.service, answer)


def _client(node: Any, options: NodeOptions, events: EventWriter) -> None:
    """Send requests periodically, and report correct answers."""
    from std_srvs.srv import SetBool

    client = node.create_client(SetBool, options.service)
    asked = 0

    def ask() -> None:
        nonlocal asked
        asked += 1
        value = bool(asked % 2)
        events.report(EventKind.SENT, f"not {value}")
        future = client.call_async(SetBool.Request(data=value))
        future.add_done_callback(lambda done: check(value, done.result()))

    def check(value: bool, response: Any) -> None:
        if response.success is not value and response.message.endswith(f"= {not value}"):
            node.get_logger().info(f"Answer: '{response.message}'")
            events.report(EventKind.HEARD, response.message)

    node.create_timer(options.period, ask)


# ── actions ────────────────────────────────────────────────────────────────────────────────


def _action_server(node: Any, options: NodeOptions, events: EventWriter) -> None:
    """Compute the Fibonacci sequence for every goal, with feedback.

    The bytes of ``options.text`` (UTF-8) follow the sequence in a result, which has no other field
    that could name its server.
    """
    from rclpy.action import ActionServer

    action = _fibonacci_action()

    def execute(goal: Any) -> Any:
        feedback = action.Feedback()
        field = "sequence" if hasattr(feedback, "sequence") else "partial_sequence"
        for length in range(2, goal.request.order + 1):
            setattr(feedback, field, fibonacci(length))
            goal.publish_feedback(feedback)
        goal.succeed()
        sequence = fibonacci(goal.request.order)
        node.get_logger().info(f"Result: {sequence}")
        events.report(EventKind.SENT, f"{options.text}: {sequence}")
        return action.Result(sequence=[*sequence, *options.text.encode()])

    node.action = ActionServer(node, action, options.topic, execute)


def _action_client(node: Any, options: NodeOptions, events: EventWriter) -> None:
    """Send goals periodically, and report correct results with complete feedback."""
    from rclpy.action import ActionClient

    action = _fibonacci_action()
    client = ActionClient(node, action, options.topic)
    sent = 0
    feedback: set[tuple[int, ...]] = set()

    def send() -> None:
        nonlocal sent
        sent += 1
        events.report(EventKind.SENT, f"goal {sent}")
        goal = action.Goal(order=FIBONACCI_ORDER)
        future = client.send_goal_async(goal, feedback_callback=keep)
        future.add_done_callback(fetch)

    def keep(message: Any) -> None:
        feedback.add(tuple(_sequence_of(message.feedback)))

    def fetch(future: Any) -> None:
        goal = future.result()
        if goal.accepted:
            goal.get_result_async().add_done_callback(check)

    def check(future: Any) -> None:
        numbers = _sequence_of(future.result().result)
        sequence, text = numbers[: FIBONACCI_ORDER + 1], numbers[FIBONACCI_ORDER + 1 :]
        lengths = range(2, FIBONACCI_ORDER + 1)
        complete = {tuple(fibonacci(length)) for length in lengths} <= feedback
        if sequence == fibonacci(FIBONACCI_ORDER) and complete:
            node.get_logger().info(f"Result: {sequence}")
            server = bytes(number % 256 for number in text).decode(errors="replace")
            events.report(EventKind.HEARD, f"{server}: {sequence}")

    node.create_timer(options.period, send)


def _fibonacci_action() -> Any:
    """Return the class ``Fibonacci`` of the first installed ROS 2 package that has it.

    Raises:
        ImportError: no package has the class.
    """
    reasons = []
    for package in _FIBONACCI_PACKAGES:
        try:
            return importlib.import_module(f"{package}.action").Fibonacci
        except (ImportError, AttributeError) as error:
            reasons.append(str(error))
    raise ImportError(f"no package has the action Fibonacci: {'; '.join(reasons)}")


def _sequence_of(message: Any) -> list[int]:
    """Return the numbers in a result or feedback; the field's name depends on the package."""
    return list(getattr(message, "sequence", None) or getattr(message, "partial_sequence", []))


# ── several nodes in one process ───────────────────────────────────────────────────────────


def _run_composed(node: Any, options: NodeOptions, events: EventWriter) -> list[Any]:
    """Run a talker, a listener and a server as three nodes in one process and one enclave.

    ``node`` becomes the talker; returns the two other nodes.
    """
    import rclpy

    # Each node gets its endpoint before the next node is created, to report the first denial.
    _talker(node, options, events)
    listener = rclpy.create_node("listener")
    _listener(listener, options, events)
    server = rclpy.create_node("server")
    _server(server, options, events)
    return [listener, server]


_ROLES: Mapping[str, _Build] = {
    "talker": _talker,
    "listener": _listener,
    "observer": _observer,
    "server": _server,
    "client": _client,
    "action_server": _action_server,
    "action_client": _action_client,
    "composed": _run_composed,
}


if __name__ == "__main__":
    sys.exit(main())
