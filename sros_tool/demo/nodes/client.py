"""An ordinary rclpy client: ``python -m sros_tool.demo.nodes.client [--ros-args ...]``."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from typing import Any

from sros_tool.demo.nodes.options import option_parser, options_of, split_ros_args
from sros_tool.demo.nodes.ros_node import run_ros_node
from sros_tool.runtime.events import EventWriter, Kind


def main(arguments: Sequence[str] | None = None) -> int:
    """Ask again and again, and report the right answers; returns the exit status."""
    arguments = sys.argv[1:] if arguments is None else arguments
    own, _ = split_ros_args(arguments)
    parser = option_parser("sros_tool.demo.nodes.client", "Send requests to a service.")
    options = options_of(parser.parse_args(own), "client")

    def build(node: Any, events: EventWriter) -> None:
        from std_srvs.srv import SetBool

        client = node.create_client(SetBool, options.service)
        asked = right = 0

        def ask() -> None:
            nonlocal asked
            asked += 1
            value = bool(asked % 2)
            events.report(Kind.SENT, f"not {value}", count=asked)
            future = client.call_async(SetBool.Request(data=value))
            future.add_done_callback(lambda done: check(value, done.result()))

        def check(value: bool, response: Any) -> None:
            nonlocal right
            if response.success is not value and response.message.endswith(f"= {not value}"):
                right += 1
                node.get_logger().info(f"Answer: '{response.message}'")
                events.report(Kind.HEARD, response.message, count=right)

        node.create_timer(options.period, ask)

    return run_ros_node("client", options, [sys.argv[0], *arguments], build)


if __name__ == "__main__":
    sys.exit(main())
