"""Runs plain rclpy nodes in one process: ``run_nodes.py JSON --ros-args ...``.

JSON is a list of nodes, each with ``name``, ``ns`` and the names that it uses by right (publish,
subscribe, reply, request, execute, call), and the nodes whose parameters it reads (ask);
``managed`` makes it a lifecycle node, ``bare`` one without parameter services.  What the messages
are does not matter here, so every topic but /rosout, which every node publishes, carries the same
type, and so does every service and every action.  Prints ``ready`` and runs until it is ended.
"""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import rclpy
from rcl_interfaces import srv
from rcl_interfaces.msg import Log, ParameterEvent
from rclpy.action import ActionClient, ActionServer
from rclpy.executors import SingleThreadedExecutor
from rclpy.lifecycle import LifecycleNode
from rclpy.node import Node
from rclpy.parameter_client import AsyncParameterClient
from rclpy.type_support import check_for_type_support
from std_msgs.msg import String
from test_msgs.action import Fibonacci
from test_msgs.srv import BasicTypes
from type_description_interfaces.srv import GetTypeDescription

from tests.support.children import Forked


def load_types() -> None:
    """Load the types that nodes use, which takes most of the time in which a node is made.

    The processes that are forked after this have them.
    """
    services = (getattr(srv, name) for name in vars(srv) if name[0].isupper())
    for each in (Log, ParameterEvent, String, *services, GetTypeDescription, BasicTypes, Fibonacci):
        check_for_type_support(each)


def make_node(spec: dict[str, Any]) -> Any:
    """The node of ``spec`` with all its endpoints."""
    kind = LifecycleNode if spec.get("managed") else Node
    services = not spec.get("bare")
    node = kind(spec["name"], namespace=spec["ns"], start_parameter_services=services)
    for name in spec.get("publish", ()):
        node.create_publisher(String, name, 10)
    for name in spec.get("subscribe", ()):
        kind_of = Log if name == "/rosout" else String
        node.create_subscription(kind_of, name, lambda message: None, 10)
    for name in spec.get("reply", ()):
        node.create_service(BasicTypes, name, lambda request, response: response)
    for name in spec.get("request", ()):
        node.create_client(BasicTypes, name)
    node.asked = [AsyncParameterClient(node, name) for name in spec.get("ask", ())]
    node.actions = [ActionClient(node, Fibonacci, name) for name in spec.get("call", ())] + [
        ActionServer(node, Fibonacci, name, lambda goal: Fibonacci.Result())
        for name in spec.get("execute", ())
    ]
    return node


def run(nodes: list[dict[str, Any]], words: Sequence[str]) -> int:
    """Run nodes until the process is ended; ``words`` are what follows the program."""
    rclpy.init(args=["run_nodes", *words])
    executor = SingleThreadedExecutor()
    for spec in nodes:
        executor.add_node(make_node(spec))
    print("ready", flush=True)
    executor.spin()
    return 0


class Nodes(Forked):
    """A forked process of nodes: rclpy, which is slow to import, is imported once for all."""

    def __init__(self, nodes: list[dict[str, Any]], *words: str) -> None:
        reader, writer = os.pipe()

        def work() -> int:
            os.dup2(writer, sys.stdout.fileno())
            return run(nodes, words)

        super().__init__(work, env=dict(os.environ), errors=Path("/dev/stderr"))
        os.close(writer)
        self._said = os.fdopen(reader)

    def wait_until_ready(self) -> None:
        if self._said.readline() != "ready\n":
            raise SystemExit("a node did not start")


if __name__ == "__main__":
    run(json.loads(sys.argv[1]), sys.argv[2:])
