"""A ROS graph that is made up, for `tests/graph/fake_rclpy.py`."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from tests.support.harness import Ended

Beside = Callable[..., Ended]
"""Runs a verb of sros beside a graph: the verb, the graph, further words, variables."""


def graph(*nodes: tuple[str, str, str, str, list[str]], rmw: str = "rmw_fake") -> dict[str, Any]:
    """A graph for `fake_rclpy`: enclave, namespace, name, participant, endpoints of each node."""
    return {"nodes": nodes, "rmw": rmw}
