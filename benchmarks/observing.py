"""Benchmarks of learning the policy of a large graph, with real nodes of rclpy.

``python -m benchmarks.observing FOLDER`` measures in a separate network namespace and prints JSON;
`observing` runs this command and returns its figures.
"""

from __future__ import annotations

import importlib.util
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

PROCESSES, NODES_EACH, TOPICS_EACH = 10, 5, 6
NODES = PROCESSES * NODES_EACH
ENDPOINTS = 500
"""Six topics, and four more of a node without parameter services: log, events, types."""

_DOMAIN = "219"
_LIMIT = 5.0
_ROUNDS = 5
_PATIENCE = 60.0

_NODES = """
import sys, rclpy
from rclpy.executors import SingleThreadedExecutor
from std_msgs.msg import String
process, nodes, topics = map(int, sys.argv[1:4])
rclpy.init(args=["--ros-args", "--enclave", f"/robot_{process}"])
executor = SingleThreadedExecutor()
for number in range(nodes):
    name = f"node_{process}_{number}"
    node = rclpy.create_node(name, namespace="/hall", start_parameter_services=False)
    for topic in range(topics):
        if topic % 2:
            node.create_subscription(String, f"{name}/topic_{topic}", lambda message: None, 10)
        else:
            node.create_publisher(String, f"{name}/topic_{topic}", 10)
    executor.add_node(node)
print("ready", flush=True)
executor.spin()
"""

Figure = tuple[str, float, str, bool]
"""The task, its seconds, the limit, and whether it is kept."""


def observing() -> list[Figure]:
    """Measure one look at a large graph, and learning its policy; [] without rclpy."""
    if importlib.util.find_spec("rclpy") is None:
        return []
    with tempfile.TemporaryDirectory() as folder:
        done = subprocess.run(
            [sys.executable, "-m", "benchmarks.observing", folder],
            check=True,
            stdout=subprocess.PIPE,
        )
    found: dict[str, float] = json.loads(done.stdout.splitlines()[-1])
    what = f"{NODES} nodes, {ENDPOINTS} endpoints"
    both = found["look"] + found["write"]
    return [
        (f"{what}: one look at the graph", found["look"], "-", True),
        (f"{what}: learned and written", found["write"], "-", True),
        ("... both, after the graph has settled", both, f"{_LIMIT:.0f} s", both < _LIMIT),
        (f"{what}: sros generate_policy, settling included", found["whole"], "-", True),
    ]


def main() -> None:
    """Start the nodes, measure, and print the seconds as JSON."""
    from sros_tool.runtime.netns import enter_isolation, try_isolation

    if try_isolation().isolated:
        enter_isolation()
    os.environ["ROS_DOMAIN_ID"] = _DOMAIN
    command = [sys.executable, "-c", _NODES]
    processes = [
        subprocess.Popen(
            [*command, str(number), str(NODES_EACH), str(TOPICS_EACH)], stdout=subprocess.PIPE
        )
        for number in range(PROCESSES)
    ]
    try:
        for process in processes:
            assert process.stdout is not None and process.stdout.readline() == b"ready\n"
        print(json.dumps(_measured(Path(sys.argv[1]))))
    finally:
        for process in processes:
            process.kill()
            process.wait()


def _measured(folder: Path) -> dict[str, float]:
    from sros_tool.files import policies_dir
    from sros_tool.graph.learn import common_parts, draft, learn, write
    from sros_tool.graph.observation import Observation
    from sros_tool.graph.observe import RosGraph

    seen = Observation()
    deadline = time.monotonic() + _PATIENCE
    with RosGraph() as graph:
        while seen.endpoint_count < ENDPOINTS and time.monotonic() < deadline:
            seen = graph.next(0.2) or seen
    assert (len(seen.nodes), seen.endpoint_count) == (NODES, ENDPOINTS)

    def learn_and_write(number: int) -> None:
        path = folder / str(number) / "robot.xml"
        path.parent.mkdir()
        common = common_parts(path.parent, policies_dir())
        write(draft(path, learn(seen, common), common))

    whole = [sys.executable, "-m", "sros_tool", "generate_policy", str(folder / "whole.xml")]
    begin = time.perf_counter()
    done = subprocess.run(whole, check=True, capture_output=True, text=True)
    seconds = time.perf_counter() - begin
    assert f"{NODES} nodes" in done.stdout, done.stdout
    return {"look": _look(), "write": _median(learn_and_write), "whole": seconds}


def _look() -> float:
    """Return the seconds of one look at the whole graph with rclpy in this process."""
    import rclpy

    from sros_tool.graph.observation import _NODE_NAME, _Observer

    rclpy.init(args=[])
    node = rclpy.create_node(_NODE_NAME, enable_rosout=False, start_parameter_services=False)
    observer = _Observer(node)
    observer = _Observer(node)
    deadline = time.monotonic() + _PATIENCE
    found: Any = None
    while time.monotonic() < deadline and (found is None or len(found[1]) < ENDPOINTS):
        time.sleep(0.1)
        found = observer.snapshot()
    taken = _median(lambda _: observer.snapshot())
    node.destroy_node()
    rclpy.shutdown()
    return taken


def _median(action: Callable[[int], object]) -> float:
    times = []
    for number in range(_ROUNDS):
        begin = time.perf_counter()
        action(number)
        times.append(time.perf_counter() - begin)
    return statistics.median(times)


if __name__ == "__main__":
    main()
