"""The mobile robot as ordinary rclpy nodes, secured: it runs, and is learned again as it is.

Runs where rclpy enforces DDS Security, and is skipped elsewhere.
"""

from __future__ import annotations

import json
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import pytest

from sros_tool.dds.domains import DomainSet
from sros_tool.demo.backend import RCLPY
from sros_tool.explain.log import explain_log
from sros_tool.files import policies_dir
from sros_tool.keystore.lifecycle.create import generate_artifacts
from sros_tool.keystore.template import load_template
from sros_tool.names import expand
from sros_tool.policy.document import read_policy
from sros_tool.policy.model import Policy
from sros_tool.policy.rights import policy_rights
from tests.integration.enforcing import enforcing_backend
from tests.integration.test_nodes_fit_their_enclaves import nodes_of
from tests.support.children import PATIENCE, python

pytestmark = pytest.mark.dds

SCRIPT = Path(__file__).with_name("ros_nodes") / "secured_robot.py"
DOMAIN = 188

INSTANCES: dict[str, dict[str, dict[str, list[str]]]] = {
    "/mobile_robot/camera": {"driver": {"publish": ["image_raw/compressed"]}},
    "/mobile_robot/monitor": {
        "monitor": {
            "request": ["/amcl/get_parameters", "/amcl/get_state"],
            "subscribe": ["/rosout", "/navigate_to_pose/_action/status"],
        },
    },
    "/mobile_robot/recorder": {
        "rosbag2_recorder": {"subscribe": ["/scan", "/tf"], "reply": ["~/pause"]},
    },
}
"""What nodes do by rights with wildcards, or on topics that others have by themselves, by right."""


@pytest.fixture(scope="module")
def robot() -> Policy:
    """The policy of thirteen enclaves."""
    return read_policy(policies_dir() / "mobile_robot.xml")


def processes_of(policy: Policy) -> list[dict[str, Any]]:
    """A process for each enclave; every other one has its enclave from the variable alone."""
    found = []
    for number, enclave in enumerate(policy.enclaves):
        nodes = nodes_of(enclave)
        for node in nodes:
            for right, names in INSTANCES.get(enclave.path, {}).get(node["name"], {}).items():
                node[right] = [*node.get(right, ()), *names]
        found.append({"enclave": enclave.path, "nodes": nodes, "named": number % 2 == 0})
    return found


def rights_of(processes: list[dict[str, Any]]) -> set[str]:
    """What these nodes do beside what every node does, as a policy says it."""
    items = {
        **dict.fromkeys(("publish", "subscribe"), "topic"),
        **dict.fromkeys(("request", "reply"), "service"),
        **dict.fromkeys(("call", "execute"), "action"),
    }
    return {
        f"{each['enclave']} ALLOW {right} {item} {expand(name, node['ns'], node['name'])}"
        for each in processes
        for node in each["nodes"]
        for right, item in items.items()
        for name in node.get(right, ())
    }


def test_the_robot_runs_secured_and_is_learned_again(robot: Policy, tmp_path: Path) -> None:
    enforcing_backend(RCLPY)
    keystore = tmp_path / "keystore"
    generate_artifacts(
        keystore,
        policies=[robot, read_policy(policies_dir() / "observer.xml")],
        now=datetime.now(UTC),
        create=load_template("production"),
        domains=DomainSet.of((DOMAIN, DOMAIN)),
    )
    processes = processes_of(robot)
    wanted = rights_of(processes)
    task = {
        "keystore": str(keystore),
        "folder": str(tmp_path),
        "processes": processes,
        "learn": ["generate_policy", "learned.xml", "--keystore", str(keystore),
                  "--enclave", "/sros_observer"],
        "until": sorted(wanted),
        "patience": PATIENCE,
    }  # fmt: skip
    done = python(SCRIPT, said=json.dumps(task), patience=4 * PATIENCE)
    said = json.loads(done.stdout.splitlines()[-1])
    assert said["ended"] == []
    for enclave, log in said["logs"].items():
        assert explain_log(log, lambda _: None, lambda _: pytest.fail("not asked")) == (), log
        assert "Found security directory" in log, enclave
    found = {str(each) for each in policy_rights(read_policy(tmp_path / "learned.xml"))}
    assert wanted <= found, (wanted - found, said["learned"])
    allowed = {str(each) for each in policy_rights(robot)}
    assert found - wanted <= allowed, said["learned"]
    assert {each.split()[0] for each in found} == {each.path for each in robot.enclaves}
    literal = {each for each in allowed if not set(each) & set("*?") and " ALLOW " in each}
    # Nodes of C++ subscribe to /parameter_events too, and those of Python do not.
    assert {each for each in literal - found if not each.endswith("/parameter_events")} == set()
