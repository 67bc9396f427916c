"""An ordinary rclpy listener: ``python -m sros_tool.demo.nodes.listener [--ros-args ...]``."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from typing import Any

from sros_tool.demo.nodes.options import NodeOptions, node_options, split_ros_args
from sros_tool.demo.nodes.ros_node import run_ros_node
from sros_tool.runtime.events import EventWriter, Kind


def main(arguments: Sequence[str] | None = None) -> int:
    """Log what is heard on a topic until told to stop; returns the exit status."""
    arguments = sys.argv[1:] if arguments is None else arguments
    own, _ = split_ros_args(arguments)
    options = node_options("sros_tool.demo.nodes.listener", "Log what is heard on a topic.", own)

    def build(node: Any, events: EventWriter) -> None:
        listen(node, options, events)

    return run_ros_node("listener", options, [sys.argv[0], *arguments], build)


def listen(node: Any, options: NodeOptions, events: EventWriter) -> None:
    """Give a node the subscription."""
    from std_msgs.msg import String

    heard = 0

    def hear(message: Any) -> None:
        nonlocal heard
        heard += 1
        node.get_logger().info(f"I heard: '{message.data}'")
        events.report(Kind.HEARD, message.data, count=heard)

    # rclpy keeps subscriptions alive through the node.
    node.create_subscription(String, options.topic, hear, 10)


if __name__ == "__main__":
    sys.exit(main())
