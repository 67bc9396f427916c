"""The requirements of the mobile robot hold, and find each change of its policy that breaks one."""

from __future__ import annotations

import re
import shutil
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

import pytest

from sros_tool import check_requirements
from sros_tool.checks.keystores.opened import Circumstances
from sros_tool.files import policies_dir
from sros_tool.graph.learn import merge_policies
from sros_tool.policy.document import read_policy
from sros_tool.proof.findings import decide_all
from sros_tool.proof.requirements import Requirement, demand, read_requirements
from sros_tool.proof.system import load_system
from tests.support.children import LONG
from tests.support.long_form import some

NOW = datetime(2027, 1, 1, tzinfo=UTC)
FILE = "mobile_robot.requirements.toml"
ROBOT = "/mobile_robot/"


@pytest.fixture(scope="module")
def requirements() -> tuple[Requirement, ...]:
    return read_requirements(policies_dir() / FILE)


def test_they_hold_and_could_fail(requirements: tuple[Requirement, ...]) -> None:
    decided = decide_all(
        requirements, load_system(policies_dir() / "mobile_robot.xml", Circumstances(NOW))
    )
    assert decided.violations == ()
    assert decided.vacuous == ()
    assert len(requirements) >= 15
    assert len({each.KIND for each in requirements}) == 7


@dataclass(frozen=True)
class Mutation:
    """A change of a file of the policy, the demand that it breaks, and the witness.

    ``add`` is put before the end of the profile; ``drop`` is a text that is taken out.
    """

    file: str
    breaks: str
    witness: tuple[str, ...]
    add: str = ""
    drop: str = ""


def publish(name: str) -> str:
    return f'<topics publish="ALLOW"><topic>{name}</topic></topics>'


def subscribe(name: str) -> str:
    return f'<topics subscribe="ALLOW"><topic>{name}</topic></topics>'


def request(name: str) -> str:
    return f'<services request="ALLOW"><service>{name}</service></services>'


MUTATIONS = [
    Mutation("lidar_driver", "only velocity_mux may publish /cmd_vel",
             ("lidar publish /cmd_vel",), publish("/cmd_vel")),
    Mutation("imu_driver", "only controller may publish /cmd_vel_nav",
             ("imu publish /cmd_vel_nav",), publish("cmd_vel_nav")),
    Mutation("lidar_driver", "only teleop may publish /cmd_vel_teleop, /emergency_stop, "
             "/initialpose", ("lidar publish /emergency_stop",), publish("emergency_stop")),
    Mutation("velocity_mux", "velocity_mux has to be able to publish /cmd_vel and subscribe "
             "/emergency_stop, /cmd_vel_teleop", ("velocity_mux subscribe /emergency_stop",),
             drop="<topic>emergency_stop</topic>"),
    Mutation("base_driver", "base has to be able to subscribe /cmd_vel",
             ("base subscribe /cmd_vel",),
             drop='<topics subscribe="ALLOW">\n    <topic>cmd_vel</topic>\n  </topics>'),
    Mutation("base_driver", "planner, controller, teleop must not influence base except through "
             "velocity_mux", ("controller publish /cmd_vel_nav", "base subscribe /cmd_vel_nav"),
             subscribe("cmd_vel_nav")),
    Mutation("imu_driver", "only lidar may publish /scan", ("imu publish /scan",),
             publish("scan")),
    Mutation("lidar_driver", "only base may publish /odom, /joint_states",
             ("lidar publish /odom",), publish("/odom")),
    Mutation("imu_driver", "at most 2 enclaves may publish /tf, /tf_static",
             ("base publish /tf", "imu publish /tf", "localization publish /tf"), publish("/tf")),
    Mutation("recorder", "nobody may subscribe /front_camera/*",
             ("recorder subscribe /front_camera/image_raw",),
             drop='<topics subscribe="DENY">\n    <topic>/front_camera/*</topic>\n  </topics>'),
    Mutation("lidar_driver", "nobody may request */set_parameters, */set_parameters_atomically",
             ("lidar request /amcl/set_parameters",), request("/amcl/set_parameter?")),
    Mutation("imu_driver", "nobody may request /map_server/load_map",
             ("imu request /map_server/load_map",), request("/map_server/loa[d-m]_map")),
    Mutation("lidar_driver", "only lifecycle_manager may request */change_state",
             ("lidar request /amcl/change_state",), request("/amcl/change_state")),
    Mutation("lifecycle_manager", "lifecycle_manager has to be able to request "
             "/controller_server/change_state, /planner_server/change_state",
             ("lifecycle_manager request /planner_server/change_state",),
             drop="<service>/planner_server/change_state</service>"),
    Mutation("lidar_driver", "only teleop may call action /navigate_to_pose",
             ("lidar call /navigate_to_pose",),
             '<actions call="ALLOW"><action>navigate_*</action></actions>'),
    Mutation("controller", "only planner may execute action /navigate_to_pose, "
             "/compute_path_to_pose", ("controller execute /compute_path_to_pose",),
             '<actions execute="ALLOW"><action>compute_path_to_pose</action></actions>'),
    Mutation("camera_driver", "recorder must not influence * except through monitor",
             ("recorder publish /events/write_split", "camera subscribe /events/write_split"),
             subscribe("/events/write_split")),
    Mutation("monitor", "monitor, camera must not influence base except through "
             "lifecycle_manager",
             ("monitor publish /speed_limit", "controller subscribe /speed_limit",
              "controller publish /cmd_vel_nav", "velocity_mux subscribe /cmd_vel_nav",
              "velocity_mux publish /cmd_vel", "base subscribe /cmd_vel"),
             publish("speed_limit")),
    Mutation("lidar_driver", "* may use wildcards only to publish /front_camera/image_raw/*",
             ("lidar publish /scan_",), publish("scan_*")),
]  # fmt: skip


def shown(requirement: Requirement) -> str:
    return demand(requirement).replace(ROBOT, "")


@pytest.mark.parametrize("mutation", some(MUTATIONS, 3), ids=lambda each: each.breaks[:60])
def test_a_change_breaks_what_it_should(
    mutation: Mutation, requirements: tuple[Requirement, ...], tmp_path: Path
) -> None:
    """Only that requirement is asked; in the long form all are, and no other is broken."""
    folder = tmp_path / "policies"
    shutil.copytree(policies_dir(), folder)
    file = folder / "mobile_robot" / f"{mutation.file}.xml"
    before = file.read_text()
    after = before.replace(mutation.drop, "") if mutation.drop else before
    after = after.replace("</profile>", f"{mutation.add}</profile>")
    assert after != before
    file.write_text(after)
    asked = [each for each in requirements if LONG or shown(each) == mutation.breaks]
    decided = decide_all(asked, load_system(folder / "mobile_robot.xml", Circumstances(NOW)))
    (violation,) = decided.violations
    assert decided.vacuous == ()
    assert shown(violation.requirement) == mutation.breaks
    assert violation.worlds == ()
    uses = (f"{each.enclave} {each.right} {each.name}" for each in violation.witness.uses)
    assert tuple(each.replace(ROBOT, "") for each in uses) == mutation.witness
    if mutation.add:
        line = 1 + after[: after.index(mutation.add)].count("\n")
        places = [str(each.source) for each in violation.steps]
        assert any(each.endswith(f"{mutation.file}.xml:{line}") for each in places)


def test_each_kind_has_a_change_that_breaks_it(requirements: tuple[Requirement, ...]) -> None:
    broken = {each.breaks for each in MUTATIONS}
    assert len(broken) == len(MUTATIONS) >= 15
    by_demand = {demand(each).replace(ROBOT, ""): each for each in requirements}
    assert {by_demand[each].KIND for each in broken} == {each.KIND for each in requirements} - {
        "protected"
    }


def test_operators_break_no_requirement_of_the_page_for_packages(tmp_path: Path) -> None:
    """If the owner allows all of them.  Twins: of another package, or not in the requirements."""
    page = (policies_dir().parent / "docs/howto/package.md").read_text()
    (text,) = re.findall(r"requirements.toml -->\n```toml\n(.*?)```", page, re.DOTALL)
    text = text.replace("//operator/panel", "//operator/*")
    text = text.replace('"/gripper"', '"/gripper", "//operator/*"')
    operators, empty = tmp_path / "operators.xml", tmp_path / "empty.xml"
    empty.write_text('<policy version="0.2.0"><enclaves/></policy>')
    for name in ("common", "operator"):
        shutil.copytree(policies_dir() / name, tmp_path / name)
    for written, namespace, broken in (
        (text, None, 0),
        (text, "/vendor", 2),
        (text, "/left", 2),
        (text.replace("//operator/*", "/arm"), None, 2),
    ):
        added = [
            read_policy(policies_dir() / f"operator_{role}.xml") for role in ("configure", "drive")
        ]
        operators.write_bytes(
            merge_policies(empty, added, may_include=False, namespace=namespace).document
        )
        (required := tmp_path / "r.toml").write_text(written)
        found = check_requirements(operators, required, namespaces=["/left"])
        lines = {each.line for each in found if each.id == "requirement.violated"}
        assert len(lines) == broken, found
