"""An unsecured rclpy node that lists topics and counts publishers, as any intruder could."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from typing import Any

from sros_tool.demo.nodes.options import option_parser, options_of, split_ros_args
from sros_tool.demo.nodes.ros_node import run_ros_node
from sros_tool.runtime.events import EventWriter, Kind


def main(arguments: Sequence[str] | None = None) -> int:
    """Report how many publishers the graph shows on ``--topic`` and each ``--also`` topic."""
    arguments = sys.argv[1:] if arguments is None else arguments
    own, _ = split_ros_args(arguments)
    parser = option_parser("sros_tool.demo.nodes.observer", "Count the publishers of topics.")
    parser.add_argument("--also", action="append", default=[], help="one more topic to look at")
    parsed = parser.parse_args(own)
    options = options_of(parsed)
    topics = [parsed.topic, *parsed.also]

    def build(node: Any, events: EventWriter) -> None:
        def look() -> None:
            counts = {topic: node.count_publishers(topic) for topic in topics}
            # What a node sees of the names is worth a line, but it lists its own topics too:
            # only the count of publishers says whether a talker is visible.
            listed = " ".join(sorted(name for name, _ in node.get_topic_names_and_types()))
            node.get_logger().info(f"Publishers: {counts}; topics: {listed}")
            events.report(Kind.SEEN, listed, publishers=counts)

        node.create_timer(options.period, look)

    return run_ros_node("observer", options, [sys.argv[0], *arguments], build)


if __name__ == "__main__":
    sys.exit(main())
