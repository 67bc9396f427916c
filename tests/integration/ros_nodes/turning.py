"""A node that runs on rclpy while it is open, and on Cyclone DDS once it is secured.

``turning.py ROLE REPORT NODES``: a role of the demo, the file for its events, and the nodes of
`run_nodes` as JSON.  The wheels of rclpy enforce no security, and the demo's nodes on Cyclone DDS
are not in the ROS graph.
"""

from __future__ import annotations

import os
import sys

from sros_tool.runtime.variables import ENABLE

if __name__ == "__main__":
    role, report, nodes = sys.argv[1:4]
    if os.environ.get(ENABLE) == "true":
        from sros_tool.demo.cyclone_node import main

        sys.exit(main([role, "--topic", "chatter", "--report", report]))
    import json

    from tests.integration.ros_nodes.run_nodes import run

    sys.exit(run(json.loads(nodes), []))
