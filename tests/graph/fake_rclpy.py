"""Stands in for rclpy and those of its modules that are used.

$FAKE_GRAPH describes the graph, or names a failure.

JSON: ``{"nodes": [[enclave, namespace, name, participant, ["publish topic", ...]]...]}``, or
``{"fails": "import" | "init" | "node" | "crash", "says": TEXT}``.  ``rmw`` may name variables
of the environment.  ``secured`` may have the graph that an observer with an enclave sees; others
see no node as soon as the file ``until`` is there.
"""

from __future__ import annotations

import json
import os
import sys
from types import SimpleNamespace
from typing import Any

GRAPH = json.loads(os.environ["FAKE_GRAPH"])
if os.environ.get("ROS_SECURITY_ENABLE") == "true":
    GRAPH = GRAPH.get("secured", GRAPH)
elif os.path.exists(GRAPH.get("until", "")):
    GRAPH["nodes"] = []


def _perhaps_fail(stage: str) -> None:
    if GRAPH.get("fails") == stage:
        print(GRAPH.get("says", ""), flush=True)
        if stage == "crash":
            os.abort()
        raise RuntimeError("invalid allocator")


_perhaps_fail("import")


class SignalHandlerOptions:
    NO = 0


class Parameter:
    def __init__(self, name: str, value: object) -> None: ...


class Context:
    def try_shutdown(self) -> None:
        pass


def init(**_: Any) -> None:
    _perhaps_fail("init")


def create_node(name: str, **_: Any) -> Node:
    _perhaps_fail("node")
    _perhaps_fail("crash")
    return Node(name)


def get_rmw_implementation_identifier() -> str:
    return os.path.expandvars(str(GRAPH.get("rmw", "rmw_fake")))


class Node:
    def __init__(self, name: str) -> None:
        events = "publish rt/parameter_events"
        others = [
            [each.replace("OBSERVER", name) for each in n[:4]] + n[4:] for n in GRAPH["nodes"]
        ]
        self._nodes = [["/", "/", name, "0f" * 12, [events]], *others]

    def destroy_node(self) -> None:
        print("a DDS may log to standard output", file=sys.stdout)

    def get_node_names_and_namespaces_with_enclaves(self) -> list[tuple[str, str, str]]:
        return [(name, ns, enclave) for enclave, ns, name, _, _ in self._nodes]

    def get_topic_names_and_types(self, no_demangle: bool) -> list[tuple[str, list[str]]]:
        assert no_demangle
        said = {each.split(" ", 1)[1] for node in self._nodes for each in node[4]}
        return [(topic, ["type"]) for topic in sorted(said | {"ros_discovery_info"})]

    def get_publishers_info_by_topic(self, topic: str, no_mangle: bool) -> list[SimpleNamespace]:
        return self._infos("publish", topic)

    def get_subscriptions_info_by_topic(self, topic: str, no_mangle: bool) -> list[SimpleNamespace]:
        return self._infos("subscribe", topic)

    def _infos(self, way: str, topic: str) -> list[SimpleNamespace]:
        return [
            SimpleNamespace(
                node_name=name,
                node_namespace=ns,
                endpoint_gid=[*bytes.fromhex(participant).ljust(12, b"\0"), 0, 0, 1, 3],
            )
            for _, ns, name, participant, endpoints in self._nodes
            if f"{way} {topic}" in endpoints
        ]
