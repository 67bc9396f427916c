"""The process that looks at the ROS graph: ``python -P -m sros_tool.graph.observer FD PERIOD``.

It runs separately, so that the DDS can log to standard output, refuse, or crash without harm to
its parent.  It writes JSON, one object per line, to the file descriptor FD: first
``{"ready": RMW}`` or ``{"failed": STAGE, "reason": TEXT}``, then the graph after each change.  It
looks every PERIOD seconds, and exits when its standard input is closed.
"""

from __future__ import annotations

import json
import os
import select
import sys
import time
from typing import Any

from sros_tool.graph.observation import PUBLISH, SUBSCRIBE

NODE_NAME = "_sros_observer"
"""The name of the node with which sros observes a graph; it is left out of observations."""

_PREFIX_BYTES = 12  # of an endpoint's identifier: its participant (RTPS 2.3, 9.3.1)
_DISCOVERY = "ros_discovery_info"
# These keep their participants sorted by identifier, and list nodes in that order.
_ORDERED = ("rmw_fastrtps_cpp", "rmw_fastrtps_dynamic_cpp", "rmw_cyclonedds_cpp", "rmw_connextdds")
_LOG_FLUSH_SECONDS = 0.3
"""Time for the logging thread of Fast DDS: a process that exits at once loses the reason."""
_ATTEMPTS = 5


def main() -> int:
    """Report the graph until standard input is closed; return the exit status."""
    report, period = os.fdopen(int(sys.argv[1]), "w", buffering=1), float(sys.argv[2])
    stage = "import"
    try:
        import rclpy
        from rclpy.parameter import Parameter
        from rclpy.signals import SignalHandlerOptions

        stage = "participant"
        context = rclpy.Context()
        rclpy.init(args=[], context=context, signal_handler_options=SignalHandlerOptions.NO)
        stage = "node"
        # With as few endpoints as rclpy allows, so that an observer needs few permissions.
        node = rclpy.create_node(
            NODE_NAME,
            context=context,
            use_global_arguments=False,
            enable_rosout=False,
            start_parameter_services=False,
            parameter_overrides=[Parameter("start_type_description_service", value=False)],
        )
    except Exception as error:  # whatever rclpy raises has to reach the parent as a reason
        time.sleep(_LOG_FLUSH_SECONDS)
        _send(report, {"failed": stage, "reason": f"{type(error).__name__}: {error}"})
        return 1
    rmw = rclpy.get_rmw_implementation_identifier()
    try:
        _send(report, {"ready": rmw})
        _look(node, report, period, rmw in _ORDERED)
    except BrokenPipeError:
        pass
    finally:
        node.destroy_node()
        context.try_shutdown()
    return 0


def _look(node: Any, report: Any, period: float, ordered: bool) -> None:
    before: object = None
    while not select.select([sys.stdin], [], [], period)[0]:
        now = _sight(node)
        if now is not None and now != before:
            listed, endpoints = before = now
            _send(report, {"ordered": ordered, "listed": listed, "endpoints": endpoints})


def _sight(node: Any) -> tuple[list[Any], list[Any]] | None:
    """Return nodes and endpoints that belong together; None if nodes came or went all the time."""
    for _ in range(_ATTEMPTS):
        listed = _listed(node)
        endpoints = _endpoints(node)
        if _listed(node) == listed:
            return listed, endpoints
    return None


def _listed(node: Any) -> list[tuple[str, str, str]]:
    """Return enclave, namespace and name of each node but observers, in the RMW's order."""
    found = node.get_node_names_and_namespaces_with_enclaves()
    return [(enclave, ns, name) for name, ns, enclave in found if name != NODE_NAME]


def _endpoints(node: Any) -> list[tuple[str, str, str, str, str]]:
    """Return the sorted endpoints: participant, node namespace and name, topic, direction."""
    found = set()
    for topic, _ in node.get_topic_names_and_types(no_demangle=True):
        if topic == _DISCOVERY:  # every participant has it, and no policy mentions it
            continue
        for direction, infos in (
            (PUBLISH, node.get_publishers_info_by_topic(topic, no_mangle=True)),
            (SUBSCRIBE, node.get_subscriptions_info_by_topic(topic, no_mangle=True)),
        ):
            for info in infos:
                if info.node_name != NODE_NAME:
                    participant = bytes(info.endpoint_gid[:_PREFIX_BYTES]).hex()
                    found.add((participant, info.node_namespace, info.node_name, topic, direction))
    return sorted(found)


def _send(report: Any, value: object) -> None:
    report.write(json.dumps(value) + "\n")


if __name__ == "__main__":
    sys.exit(main())
