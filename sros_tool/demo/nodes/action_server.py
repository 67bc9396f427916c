"""An ordinary rclpy action server: ``python -m sros_tool.demo.nodes.action_server``."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from typing import Any

from sros_tool.demo.nodes.fibonacci import fibonacci_type
from sros_tool.demo.nodes.options import fibonacci, node_options, split_ros_args
from sros_tool.demo.nodes.ros_node import run_ros_node
from sros_tool.runtime.events import EventWriter, Kind


def main(arguments: Sequence[str] | None = None) -> int:
    """Execute goals until told to stop; returns the exit status."""
    arguments = sys.argv[1:] if arguments is None else arguments
    own, _ = split_ros_args(arguments)
    options = node_options("sros_tool.demo.nodes.action_server", "Count Fibonacci's numbers.", own)

    def build(node: Any, events: EventWriter) -> None:
        from rclpy.action import ActionServer

        kind = fibonacci_type()
        done = 0

        def execute(goal: Any) -> Any:
            nonlocal done
            done += 1
            feedback = kind.Feedback()
            field = "sequence" if hasattr(feedback, "sequence") else "partial_sequence"
            for length in range(2, goal.request.order + 1):
                setattr(feedback, field, fibonacci(length))
                goal.publish_feedback(feedback)
            goal.succeed()
            result = kind.Result()
            result.sequence = fibonacci(goal.request.order)
            node.get_logger().info(f"Result: {list(result.sequence)}")
            events.report(Kind.SENT, f"{options.text}: {list(result.sequence)}", count=done)
            return result

        node.action = ActionServer(node, kind, options.topic, execute)

    return run_ros_node("action_server", options, [sys.argv[0], *arguments], build)


if __name__ == "__main__":
    sys.exit(main())
