"""An ordinary rclpy talker: ``python -m sros_tool.demo.nodes.talker [--ros-args ...]``."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from typing import Any

from sros_tool.demo.nodes.options import NodeOptions, node_options, split_ros_args
from sros_tool.demo.nodes.ros_node import run_ros_node
from sros_tool.runtime.events import EventWriter, Kind


def main(arguments: Sequence[str] | None = None) -> int:
    """Publish ``Hello World: N`` on a topic until told to stop; returns the exit status."""
    arguments = sys.argv[1:] if arguments is None else arguments
    own, _ = split_ros_args(arguments)
    options = node_options(
        "sros_tool.demo.nodes.talker", "Publish a greeting, again and again.", own
    )

    def build(node: Any, events: EventWriter) -> None:
        talk(node, options, events)

    return run_ros_node("talker", options, [sys.argv[0], *arguments], build)


def talk(node: Any, options: NodeOptions, events: EventWriter) -> None:
    """Give a node the publisher, and a timer that uses it."""
    from std_msgs.msg import String

    publisher = node.create_publisher(String, options.topic, 10)
    sent = 0

    def speak() -> None:
        nonlocal sent
        sent += 1
        text = f"{options.text}: {sent}"
        node.get_logger().info(f"Publishing: '{text}'")
        publisher.publish(String(data=text))
        events.report(Kind.SENT, text, count=sent)

    node.create_timer(options.period, speak)


if __name__ == "__main__":
    sys.exit(main())
