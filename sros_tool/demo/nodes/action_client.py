"""An ordinary rclpy action client: ``python -m sros_tool.demo.nodes.action_client``.

A result does not say which server it is from: ``--server`` names the only one that there is.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from typing import Any

from sros_tool.demo.nodes.fibonacci import ORDER, fibonacci_type, sequence_of
from sros_tool.demo.nodes.options import fibonacci, option_parser, options_of, split_ros_args
from sros_tool.demo.nodes.ros_node import run_ros_node
from sros_tool.runtime.events import EventWriter, Kind


def main(arguments: Sequence[str] | None = None) -> int:
    """Send goals again and again, and report the right results; returns the exit status."""
    arguments = sys.argv[1:] if arguments is None else arguments
    own, _ = split_ros_args(arguments)
    parser = option_parser("sros_tool.demo.nodes.action_client", "Ask for Fibonacci's numbers.")
    parsed = parser.parse_args(own)
    options = options_of(parsed)

    def build(node: Any, events: EventWriter) -> None:
        from rclpy.action import ActionClient

        kind = fibonacci_type()
        client = ActionClient(node, kind, options.topic)
        sent = right = 0
        fed_back: set[tuple[int, ...]] = set()

        def send() -> None:
            nonlocal sent
            sent += 1
            events.report(Kind.SENT, f"goal {sent}", count=sent)
            future = client.send_goal_async(kind.Goal(order=ORDER), feedback_callback=see)
            future.add_done_callback(fetch)

        def see(message: Any) -> None:
            fed_back.add(tuple(sequence_of(message.feedback)))

        def fetch(future: Any) -> None:
            goal = future.result()
            if goal.accepted:
                goal.get_result_async().add_done_callback(check)

        def check(future: Any) -> None:
            nonlocal right
            sequence = sequence_of(future.result().result)
            complete = {tuple(fibonacci(length)) for length in range(2, ORDER + 1)} <= fed_back
            if sequence == fibonacci(ORDER) and complete:
                right += 1
                node.get_logger().info(f"Result: {sequence}")
                events.report(Kind.HEARD, f"{parsed.server}: {sequence}", count=right)

        node.create_timer(options.period, send)

    return run_ros_node("action_client", options, [sys.argv[0], *arguments], build)


if __name__ == "__main__":
    sys.exit(main())
