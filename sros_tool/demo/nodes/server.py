"""An ordinary rclpy server: ``python -m sros_tool.demo.nodes.server [--ros-args ...]``.

It negates a truth value (std_srvs/SetBool, which every ROS 2 installation has): DDS Security goes
by the name of a service, not by its type.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from typing import Any

from sros_tool.demo.nodes.options import NodeOptions, option_parser, options_of, split_ros_args
from sros_tool.demo.nodes.ros_node import run_ros_node
from sros_tool.runtime.events import EventWriter, Kind


def main(arguments: Sequence[str] | None = None) -> int:
    """Answer requests until told to stop; returns the exit status."""
    arguments = sys.argv[1:] if arguments is None else arguments
    own, _ = split_ros_args(arguments)
    parser = option_parser("sros_tool.demo.nodes.server", "Answer the requests of a service.")
    options = options_of(parser.parse_args(own), "server")

    def build(node: Any, events: EventWriter) -> None:
        serve(node, options, events)

    return run_ros_node("server", options, [sys.argv[0], *arguments], build)


def serve(node: Any, options: NodeOptions, events: EventWriter) -> None:
    """Give a node the service."""
    from std_srvs.srv import SetBool

    answered = 0

    def answer(request: Any, response: Any) -> Any:
        nonlocal answered
        answered += 1
        response.success = not request.data
        response.message = f"{options.text}: not {request.data} = {response.success}"
        node.get_logger().info(f"Answering: '{response.message}'")
        events.report(Kind.SENT, response.message, count=answered)
        return response

    node.create_service(SetBool, options.service, answer)


if __name__ == "__main__":
    sys.exit(main())
