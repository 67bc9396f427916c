"""Runs plain rclpy nodes in one process: ``run_nodes.py JSON --ros-args ...``.

JSON is a list of nodes, each with ``name``, ``ns`` and the names that it uses by right (publish,
subscribe, reply, request, execute, call), and the nodes whose parameters it reads (ask);
``managed`` makes it a lifecycle node, ``bare`` one without parameter services.  What the messages
are does not matter here, so every topic but /rosout, which every node publishes, carries the same
type, and so does every service and every action.  Prints ``ready`` and runs until it is ended.
"""

from __future__ import annotations

import json
import sys
from typing import Any

import rclpy
from rcl_interfaces.msg import Log
from rclpy.action import ActionClient, ActionServer
from rclpy.executors import SingleThreadedExecutor
from rclpy.lifecycle import LifecycleNode
from rclpy.node import Node
from rclpy.parameter_client import AsyncParameterClient
from std_msgs.msg import String
from test_msgs.action import Fibonacci
from test_msgs.srv import BasicTypes


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


def main() -> None:
    rclpy.init(args=sys.argv)
    executor = SingleThreadedExecutor()
    for spec in json.loads(sys.argv[1]):
        executor.add_node(make_node(spec))
    print("ready", flush=True)
    executor.spin()


if __name__ == "__main__":
    main()
