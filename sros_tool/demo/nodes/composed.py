"""Three rclpy nodes in one process: ``python -m sros_tool.demo.nodes.composed``."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from typing import Any

from sros_tool.demo.nodes.listener import listen
from sros_tool.demo.nodes.options import node_options, split_ros_args
from sros_tool.demo.nodes.ros_node import run_ros_node
from sros_tool.demo.nodes.server import serve
from sros_tool.demo.nodes.talker import talk
from sros_tool.runtime.events import EventWriter


def main(arguments: Sequence[str] | None = None) -> int:
    """Talk, listen and serve until told to stop; returns the exit status."""
    arguments = sys.argv[1:] if arguments is None else arguments
    own, _ = split_ros_args(arguments)
    options = node_options(
        "sros_tool.demo.nodes.composed", "A talker, a listener and a server.", own
    )

    def build(node: Any, events: EventWriter) -> list[Any]:
        import rclpy

        # Each node gets its endpoint before the next one is made: what is denied first is told.
        talk(node, options, events)
        listener = rclpy.create_node("listener")
        listen(listener, options, events)
        server = rclpy.create_node("server")
        serve(server, options, events)
        return [listener, server]

    return run_ros_node("talker", options, [sys.argv[0], *arguments], build)


if __name__ == "__main__":
    sys.exit(main())
