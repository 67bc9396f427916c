"""Let Cyclone DDS nodes talk in a network of their own, and print what was heard, as JSON.

Reads a JSON list of nodes from standard input: {"role", "name", "keystore", "enclave", "topic",
"text"}; ``keystore`` "" is no security.  Prints for each node what it reported, and for each text
in how many packets it was readable.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from sros_tool.demo.capture import Capture
from sros_tool.runtime.environment import secured_environment
from sros_tool.runtime.events import Kind, read_events
from sros_tool.runtime.netns import enter_isolation, try_isolation

WINDOW = 4.0
START = 30.0


def main() -> None:
    nodes: list[dict[str, Any]] = json.load(sys.stdin)
    domain = int(sys.argv[1])
    isolation = try_isolation()
    if isolation.isolated:
        enter_isolation()
    capture = open_capture([node["text"] for node in nodes if node["role"] == "talker"])
    with tempfile.TemporaryDirectory() as folder:
        running = [(node, *start(node, domain, Path(folder))) for node in nodes]
        deadline = time.monotonic() + START
        settled = {Kind.READY, Kind.REFUSED, Kind.FAILED}
        while time.monotonic() < deadline and not all(
            settled & {event.kind for event in read_events(report)} for _, _, report in running
        ):
            time.sleep(0.05)
        end = time.monotonic() + WINDOW
        while time.monotonic() < end:
            if capture:
                capture.drain()
            time.sleep(0.02)
        result = []
        for node, process, report in running:
            process.terminate()
            process.wait(10)
            events = read_events(report)
            result.append(
                {
                    "name": node["name"],
                    "kinds": sorted({event.kind.value for event in events}),
                    "sent": sum(event.kind is Kind.SENT for event in events),
                    "heard": [event.text for event in events if event.kind is Kind.HEARD],
                    "reasons": [
                        event.text for event in events if event.kind in (Kind.REFUSED, Kind.FAILED)
                    ],
                }
            )
    readable = dict(capture.plain) if capture else None
    json.dump({"nodes": result, "readable": readable}, sys.stdout)


def open_capture(texts: list[str]) -> Capture | None:
    """None where packets may not be captured: without root, and without a network of one's own."""
    try:
        return Capture(texts)
    except PermissionError:
        return None


def start(node: dict[str, Any], domain: int, folder: Path) -> tuple[subprocess.Popen[bytes], Path]:
    report = folder / f"{node['name']}.jsonl"
    report.touch()
    environment = {k: v for k, v in os.environ.items() if not k.startswith("ROS_")}
    environment["ROS_DOMAIN_ID"] = str(domain)
    if node["keystore"]:
        environment |= secured_environment(Path(node["keystore"]), node["enclave"], domain)
    command = [sys.executable, "-m", "sros_tool.demo.cyclone_node", node["role"]]
    command += ["--topic", node["topic"], "--text", node["text"], "--period", "0.1"]
    process = subprocess.Popen(
        [*command, "--report", str(report)], env=environment, stderr=subprocess.DEVNULL
    )
    return process, report


if __name__ == "__main__":
    main()
