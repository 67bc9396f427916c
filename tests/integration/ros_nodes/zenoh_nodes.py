"""A node on Zenoh as rmw_zenoh has it: ``zenoh_nodes.py REPORT ROLE NAME --ros-args ...``.

A role of the demo, with what every ROS node has: /rosout, /parameter_events and its services.
Started by the name ``rmw_zenohd``, it is the router, which is not a node.
"""

from __future__ import annotations

import os
import signal
import sys
from pathlib import Path
from typing import Any

import zenoh

from sros_tool.demo import zenoh_node
from sros_tool.graph.zenoh_tokens import configuration
from sros_tool.names import NODE_SERVICES
from sros_tool.runtime.environment import node_argument


class WholeNode(zenoh_node._ZenohNode):
    def __init__(self, session: zenoh.Session, domain: str, enclave: str, *more: Any) -> None:
        _, name = node_argument(sys.argv) or ("/", "")
        super().__init__(session, domain, enclave, name, more[-1])
        self.publisher("/rosout")
        self.publisher("/parameter_events")
        for service in NODE_SERVICES:
            self.serve(f"/{name}/{service}", lambda request: request)


def main() -> int:
    if Path(sys.argv[0]).name == "rmw_zenohd":
        session = zenoh.open(configuration(os.environ, router=True))
        print("router ready", session.zid(), flush=True)
        return int(signal.sigwait({signal.SIGINT, signal.SIGTERM}) < 0)
    report, role, name, *ros_args = sys.argv[1:]
    zenoh_node._ZenohNode = WholeNode  # type: ignore[misc, assignment]
    return zenoh_node.main([role, "--topic", name, "--report", report, *ros_args])


if __name__ == "__main__":
    status = main()
    os._exit(status)  # the threads of an open session would delay the end
