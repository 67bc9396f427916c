"""Start processes of nodes, and tell what the ROS graph says of each node.

Processes are ``{enclave: [node, ...]}``, nodes as in ``run_nodes.py``, or
``{enclave: {"command": [word, ...], "nodes": count, "topics": {name: []}}}`` with DDS topics that
its nodes must have.  Every node is described by its enclave, its endpoints in ROS terms, and the
DDS topics that it writes and reads (``raw``), both as the graph tells them.
"""

from __future__ import annotations

import os
import subprocess
import time
from collections.abc import Collection, Mapping
from typing import Any

from sros_tool.names import NODE_SERVICES, dds_names, expand
from sros_tool.parallel import end_with_parent
from tests.integration.ros_nodes.run_nodes import Nodes, load_types
from tests.support.children import importing

load_types()

Process = list[dict[str, Any]] | dict[str, Any]
PATIENCE_S = 240.0
STILL_S = 1.0
"""The graph counts as complete when it has not changed for this long, and lacks nothing known."""


def start(enclave: str, process: Process) -> subprocess.Popen[bytes] | Nodes:
    # Simulated time, so that the nodes subscribe to /clock as well.
    words = ("--ros-args", "--enclave", enclave, "-p", "use_sim_time:=true")
    if isinstance(process, list):
        return Nodes(process, *words)
    return subprocess.Popen(
        [*process["command"], *words],
        env=importing(),
        stdout=subprocess.DEVNULL,
        preexec_fn=end_with_parent,
    )


def describe(observer: Any, name: str, ns: str) -> dict[str, Any]:
    """The endpoints of one node; the names behind actions appear as actions only."""
    from rclpy.action import graph

    def names(found: list[tuple[str, list[str]]]) -> list[str]:
        return sorted(each[0] for each in found if "/_action/" not in each[0])

    return {
        "publish": names(observer.get_publisher_names_and_types_by_node(name, ns)),
        "subscribe": names(observer.get_subscriber_names_and_types_by_node(name, ns)),
        "reply": names(observer.get_service_names_and_types_by_node(name, ns)),
        "request": names(observer.get_client_names_and_types_by_node(name, ns)),
        "execute": names(graph.get_action_server_names_and_types_by_node(observer, name, ns)),
        "call": names(graph.get_action_client_names_and_types_by_node(observer, name, ns)),
        "raw": {
            "publish": raw(observer.get_publisher_names_and_types_by_node(name, ns, True)),
            "subscribe": raw(observer.get_subscriber_names_and_types_by_node(name, ns, True)),
        },
    }


def raw(found: list[tuple[str, list[str]]]) -> list[str]:
    return sorted(each[0] for each in found)


def snapshot(observer: Any, enclaves: Collection[str]) -> list[dict[str, Any]]:
    found = []
    for name, ns, enclave in observer.get_node_names_and_namespaces_with_enclaves():
        if enclave not in enclaves:  # the observer itself, or a stranger in the domain
            continue
        try:
            endpoints = describe(observer, name, ns)
        except Exception:  # the node was announced, and is not known yet
            endpoints = {}
        found.append({"enclave": enclave, "ns": ns, "name": name, **endpoints})
    return sorted(found, key=lambda each: (each["enclave"], each["ns"], each["name"]))


def _watch(processes: Mapping[str, Process]) -> list[dict[str, Any]]:
    """The graph, once it shows the nodes of all ``processes`` and has come to rest."""
    import rclpy

    rclpy.init()
    observer = rclpy.create_node("sros_test_observer", start_parameter_services=False)
    wanted = sum(
        each["nodes"] if isinstance(each, dict) else len(each) for each in processes.values()
    )
    deadline = time.monotonic() + PATIENCE_S
    seen: list[dict[str, Any]] = []
    since = time.monotonic()
    while time.monotonic() < deadline:
        now = snapshot(observer, processes)
        if now != seen:
            seen, since = now, time.monotonic()
        still = time.monotonic() - since > STILL_S
        if still and len(seen) >= wanted and not any(lacks(each, processes) for each in seen):
            return seen
        time.sleep(0.1)
    raise AssertionError(f"the graph did not come to rest with {wanted} nodes: {seen}")


def lacks(seen: dict[str, Any], processes: Mapping[str, Process]) -> bool:
    """Whether a node is not yet seen with something that it is known to have."""
    process = processes[seen["enclave"]]
    topics = {
        topic for way in ("publish", "subscribe") for topic in seen.get("raw", {}).get(way, ())
    }
    if isinstance(process, dict):
        return not topics.issuperset(
            process["topics"].get(expand(seen["name"], seen["ns"], ""), ())
        )
    spec = next((n for n in process if (n["name"], n["ns"]) == (seen["name"], seen["ns"])), None)
    if spec is None:
        return False
    names = {
        topic
        for right in ("publish", "subscribe", "reply", "request", "execute", "call")
        for name in spec.get(right, ())
        for found in dds_names(right, expand(name, spec["ns"], spec["name"]))
        for topic in found
    }
    return not topics.issuperset(names | services(expand(spec["name"], spec["ns"], ""), spec))


def services(node: str, spec: dict[str, Any]) -> set[str]:
    """The DDS topics of the services that a node offers by itself."""
    offered = ("get_type_description",) if spec.get("bare") else NODE_SERVICES
    return {
        topic
        for service in offered
        for topics in dds_names("reply", f"{node}/{service}")
        for topic in topics
    }


def observe(domain: int, processes: Mapping[str, Process]) -> list[dict[str, Any]]:
    """Start processes in a domain, and describe all of their nodes.

    It changes the environment, so it is for a process of its own.
    """
    os.environ["ROS_DOMAIN_ID"] = str(domain)
    running = [start(enclave, process) for enclave, process in processes.items()]
    try:
        for each in running:
            if isinstance(each, Nodes):  # others are seen in the graph when they are ready
                each.wait_until_ready()
        return _watch(processes)
    finally:
        for each in running:
            each.kill()
            each.wait()
