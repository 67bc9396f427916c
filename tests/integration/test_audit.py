"""A policy is tried on a live robot without security: what it would deny, and nothing else."""

from __future__ import annotations

import importlib.util
import json
import signal
from datetime import UTC, datetime
from pathlib import Path

import pytest

from sros_tool.dds.decision.vendors import Vendor
from sros_tool.dds.domains import DomainSet
from sros_tool.explain.audit import audit, policy_enclaves
from sros_tool.files import policies_dir
from sros_tool.graph.observation import observation_from_json
from sros_tool.keystore.participant import JoinContext
from sros_tool.keystore.template import load_template
from sros_tool.policy.document import policy_xml, read_policy
from sros_tool.policy.model import Policy
from sros_tool.policy.rights import policy_rights
from sros_tool.translate import governance_for
from tests.integration.test_generate_policy import live, process, stopped
from tests.integration.test_nodes_fit_their_enclaves import nodes_of
from tests.integration.test_policies_live import without
from tests.support.harness import sros
from tests.support.long_form import sometimes

pytestmark = [
    pytest.mark.dds,
    pytest.mark.skipif(importlib.util.find_spec("rclpy") is None, reason="rclpy is not here"),
]

DOMAIN = 221
UNSHOWN = "/"
"""What the graph shows as the enclave of a process that was started without one."""
TEN = {
    ("/mobile_robot/base", "publish", "/odom"),
    ("/mobile_robot/base", "subscribe", "/cmd_vel"),
    ("/mobile_robot/camera", "publish", "/front_camera/image_raw"),
    ("/mobile_robot/imu", "reply", "/imu_driver/get_parameters"),
    ("/mobile_robot/lidar", "publish", "/rosout"),
    ("/mobile_robot/lifecycle_manager", "request", "/amcl/change_state"),
    ("/mobile_robot/map_server", "reply", "/map_server/get_state"),
    ("/mobile_robot/planner", "call", "/follow_path"),
    ("/mobile_robot/planner", "execute", "/navigate_to_pose"),
    ("/mobile_robot/teleop", "publish", "/cmd_vel_teleop"),
}
"""Rights of the shipped policy that are taken away: enclave, right, name."""


def poorer(policy: Policy) -> Policy:
    enclaves = {each.path: each for each in policy.enclaves}
    for path, right, name in TEN:
        enclaves[path] = without(enclaves[path], right, name)
    return Policy(tuple(enclaves.values()))


@sometimes("missing rights of a live robot")
def test_ten_missing_rights_of_a_live_robot_are_found_and_added(tmp_path: Path) -> None:
    full = read_policy(policies_dir() / "mobile_robot.xml")
    (tmp_path / "full.xml").write_bytes(policy_xml(full))
    (tmp_path / "robot.xml").write_bytes(policy_xml(poorer(full)))
    robot = [process(UNSHOWN, *nodes_of(each)) for each in full.enclaves]
    denied = [f"denied: {path} {right} " for path, right, _ in TEN]
    command = "audit robot.xml --watch --vendor fastdds --patch add.xml --json"
    found, fine = live(
        DOMAIN,
        tmp_path,
        robot,
        [
            stopped(command, signal.SIGINT, *denied),
            "audit full.xml --vendor fastdds",
        ],
    )
    assert found.status == 1, found.err
    assert fine.status == 0, (fine.out, fine.err)
    assert fine.out == ""

    answer = json.loads(found.out)
    assert {(each["enclave"], each["right"], each["name"]) for each in answer["denied"]} == TEN
    assert len(answer["denied"]) == 10
    homes = {p.node: [each.path] for each in full.enclaves for p in each.all_profiles()}
    assert [each for each in answer["nodes"] if each["enclaves"] != homes[each["name"]]] == []

    sros("merge_policy", "robot.xml", "add.xml", "--in-place", cwd=tmp_path).ok()
    merged = read_policy(tmp_path / "robot.xml")
    assert policy_rights(merged) == policy_rights(full)
    protection = load_template("production").protection
    governance = governance_for(protection, DomainSet.of((DOMAIN, DOMAIN)))
    context = JoinContext(DOMAIN, datetime.now(UTC))
    observation = observation_from_json(answer)
    assert audit(observation, policy_enclaves(merged, governance, Vendor.FAST, context)).allowed
