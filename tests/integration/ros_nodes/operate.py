"""A small secured robot, and a person who tries at it what commands of ros2cli do.

``operate.py`` reads ``{"keystore", "steps"}`` from stdin, starts the robot in the enclave /robot,
and prints as JSON, for the enclave of each step, which attempts succeeded.  ``operate.py robot``
and ``operate.py person`` are these processes themselves.  All is in a network of its own where the
kernel allows it.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Callable
from typing import Any

from sros_tool.parallel import end_with_parent
from sros_tool.runtime.netns import enter_isolation, try_isolation
from tests.support.children import LATE, run, wait_for

NODE = "machine"
TOPIC, COMMANDS, SERVICE, ACTION = "/status", "/command", "/stop", "/work"


def robot() -> None:
    import rclpy
    from rclpy.action import ActionServer
    from std_msgs.msg import String
    from test_msgs.action import Fibonacci
    from test_msgs.srv import BasicTypes

    def execute(goal: Any) -> Any:
        goal.succeed()
        return Fibonacci.Result()

    rclpy.init()
    node = rclpy.create_node(NODE)
    node.declare_parameter("speed", 1)
    publisher = node.create_publisher(String, TOPIC, 10)
    node.create_timer(0.2, lambda: publisher.publish(String()))
    node.create_subscription(String, COMMANDS, lambda message: None, 10)
    node.create_service(BasicTypes, SERVICE, lambda request, response: response)
    server = ActionServer(node, Fibonacci, ACTION, execute)
    print("ready", flush=True)
    rclpy.spin(node)
    server.destroy()


def person() -> None:
    """Print as JSON which of the attempts succeeded."""
    import rclpy
    from rcl_interfaces.srv import GetParameters
    from rclpy.action import ActionClient
    from rclpy.parameter import Parameter
    from rclpy.parameter_client import AsyncParameterClient
    from std_msgs.msg import String
    from test_msgs.action import Fibonacci
    from test_msgs.srv import BasicTypes

    rclpy.init()
    # As a command of ros2cli makes it (ros2cli/node/direct.py).
    node = rclpy.create_node(f"_ros2cli_{os.getpid()}", start_parameter_services=False)

    def until(what: Callable[[], Any], at: Any = node) -> bool:
        end = rclpy.clock.Clock().now().nanoseconds + LATE * 1e9
        while rclpy.clock.Clock().now().nanoseconds < end:
            if what():
                return True
            rclpy.spin_once(at, timeout_sec=0.1)
        return False

    def echo() -> bool:
        heard: list[Any] = []
        node.create_subscription(String, TOPIC, heard.append, 10)
        return until(lambda: heard)

    def publish() -> bool:
        publisher = node.create_publisher(String, COMMANDS, 10)
        return until(publisher.get_subscription_count)

    def parameters(how: Callable[[Any], Any]) -> bool:
        future = None
        client = AsyncParameterClient(node, NODE)
        if until(client.services_are_ready):
            future = how(client)
        return future is not None and until(future.done)

    def call(kind: Any, service: str, name: str) -> bool:
        caller = rclpy.create_node(f"_ros2cli_requester_{name}")
        client = caller.create_client(kind, service)
        if not until(client.service_is_ready, caller):
            return False
        return until(client.call_async(kind.Request()).done, caller)

    def send_goal() -> bool:
        sender = rclpy.create_node("_ros2cli_send_goal_test_msgs_action_Fibonacci")
        client = ActionClient(sender, Fibonacci, ACTION)
        if not until(client.server_is_ready, sender):
            return False
        return until(client.send_goal_async(Fibonacci.Goal()).done, sender)

    attempts: dict[str, Callable[[], bool]] = {
        "node list": lambda: until(lambda: NODE in node.get_node_names()),
        "topic info": lambda: until(lambda: node.count_publishers(TOPIC)),
        "topic echo": echo,
        "service call get_parameters": lambda: call(
            GetParameters, f"/{NODE}/get_parameters", "rcl_interfaces_GetParameters"
        ),
        "param get": lambda: parameters(lambda client: client.get_parameters(["speed"])),
        "param set": lambda: parameters(
            lambda client: client.set_parameters([Parameter("speed", value=7)])
        ),
        "topic pub": publish,
        "service call": lambda: call(BasicTypes, SERVICE, "test_msgs_BasicTypes"),
        "action send_goal": send_goal,
    }
    found = {}
    for name, attempt in attempts.items():
        try:
            found[name] = attempt()
        except Exception:  # what rclpy raises for a denial has many names
            found[name] = False
    print("\n" + json.dumps(found))


def main() -> None:
    task = json.load(sys.stdin)
    if try_isolation().isolated:
        enter_isolation()
    sros = [sys.executable, "-m", "sros_tool", "run", task["keystore"]]
    itself = [sys.executable, __file__]
    with subprocess.Popen(
        [*sros, "/robot", "--", *itself, "robot"],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        preexec_fn=end_with_parent,
    ) as machine:
        assert machine.stdout
        wait_for(lambda: machine.stdout and "ready" in machine.stdout.readline(), "the robot")
        found = {}
        for step in task["steps"]:
            done = run([*sros, f"/operator/{step}", "--", *itself, "person"])
            lines = [line for line in done.stdout.splitlines() if line.startswith("{")]
            found[step] = json.loads(lines[-1])
        machine.kill()
    print("\n" + json.dumps(found))


if __name__ == "__main__":
    {"robot": robot, "person": person}.get(" ".join(sys.argv[1:]), main)()
