"""Which processes have connected, as sros sees it, on real nodes of rclpy."""

from __future__ import annotations

import importlib.util
import os
from datetime import UTC, datetime
from typing import Any

import pytest

from sros_tool.checks.connections import connections_between
from sros_tool.runtime.processes import ProcessTable
from tests.support.children import apart, wait_for

pytestmark = [
    pytest.mark.dds,
    pytest.mark.skipif(importlib.util.find_spec("rclpy") is None, reason="rclpy is not here"),
]
DOMAIN = 223


def nodes_that_connect() -> bool:
    """Run two nodes that discover each other, and one that looks for nobody."""
    from tests.integration.ros_nodes.robot import start

    os.environ["ROS_DOMAIN_ID"] = str(DOMAIN)

    def started(name: str) -> Any:
        return start({"enclave": "/", "nodes": [{"name": name, "ns": "/", "bare": True}]})

    nodes = [started("first"), started("second")]
    os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "OFF"
    nodes.append(started("loner"))
    first, second, loner = (node.pid for node in nodes)

    def are_as_expected() -> bool:
        running = ProcessTable().look(datetime.now(UTC)).processes
        connections = connections_between(
            process for process in running if process.pid in (first, second, loner)
        )
        missing = {frozenset((one.pid, other.pid)) for one, other in connections.missing}
        expected = {frozenset((first, loner)), frozenset((second, loner))}
        return len(connections.compared) == 3 and missing == expected

    try:
        for node in nodes:
            node.wait_until_ready()
        return wait_for(are_as_expected, "the connections")
    finally:
        for node in nodes:
            node.kill()
            node.wait()


def test_nodes_that_do_not_hear_each_other_are_found() -> None:
    assert apart(nodes_that_connect)
