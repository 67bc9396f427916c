"""The steps of a person at the robot, on a real DDS: what works in each, and what does not yet."""

from __future__ import annotations

import json
import shutil
from datetime import UTC, datetime
from pathlib import Path

import pytest

from sros_tool.dds.domains import DomainSet
from sros_tool.demo.backend import RCLPY
from sros_tool.files import policies_dir
from sros_tool.keystore.layout import enclave_path
from sros_tool.keystore.lifecycle.create import generate_artifacts
from sros_tool.keystore.template import load_template
from sros_tool.policy.document import read_policy
from tests.explain.test_operator import CASES, NEVER, STEPS, endpoints_of
from tests.integration.cyclone_rights import refusals
from tests.integration.enforcing import enforcing_backend
from tests.support.children import PATIENCE, python

pytestmark = pytest.mark.dds

SCRIPTS = Path(__file__).with_name("ros_nodes")
DOMAIN = 222
ROBOT = """<policy version="0.2.0" xmlns:xi="http://www.w3.org/2001/XInclude"><enclaves>
<enclave path="/robot"><profiles><profile ns="/" node="machine">
<xi:include href="common/node.xml" xpointer="xpointer(/profile/*)"/>
<topics publish="ALLOW"><topic>status</topic></topics>
<topics subscribe="ALLOW"><topic>command</topic></topics>
<services reply="ALLOW"><service>stop</service></services>
<actions execute="ALLOW"><action>work</action></actions>
</profile></profiles></enclave></enclaves></policy>
"""
FIRST = {
    "node list": "list",
    "topic info": "list",
    "topic echo": "look",
    "service call get_parameters": "look",
    "param get": "configure",
    "param set": "configure",
    "topic pub": "drive",
    "service call": "drive",
    "action send_goal": "drive",
}
"""The step from which on each attempt of `ros_nodes/operate.py` succeeds."""


@pytest.fixture(scope="module")
def keystore(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("operator")
    shutil.copytree(policies_dir() / "common", folder / "common")
    robot = folder / "robot.xml"
    robot.write_text(ROBOT)
    people = [policies_dir() / f"operator_{step}.xml" for step in STEPS]
    generate_artifacts(
        folder / "ks",
        policies=[read_policy(each) for each in (robot, *people)],
        now=datetime.now(UTC),
        create=load_template("production"),
        domains=DomainSet.of((DOMAIN, DOMAIN)),
    )
    return folder / "ks"


@pytest.mark.parametrize("step", STEPS)
def test_cyclone_creates_what_commands_of_the_step_need_and_not_more(
    step: str, keystore: Path
) -> None:
    cases = {what: endpoints_of(node, rights) for what, node, rights, _ in CASES}
    never = {what: endpoints_of(node, rights) for what, node, rights in NEVER}
    works = {what for what, _, _, first in CASES if STEPS.index(first) <= STEPS.index(step)}
    asked = {(e.direction, e.topic) for found in (cases | never).values() for e in found}
    folder = enclave_path(keystore, f"/operator/{step}")
    refused = set(refusals(folder, DOMAIN, asked))
    whole = {
        what
        for what, found in (cases | never).items()
        if not {(e.direction, e.topic) for e in found} & refused
    }
    assert whole == works


def test_rclpy_does_what_the_step_allows_and_nothing_else(keystore: Path) -> None:
    enforcing_backend(RCLPY)
    task = {"keystore": str(keystore), "steps": STEPS}
    done = python(SCRIPTS / "operate.py", said=json.dumps(task), patience=4 * PATIENCE)
    found = json.loads(done.stdout.splitlines()[-1])
    assert found == {
        step: {what: STEPS.index(first) <= place for what, first in FIRST.items()}
        for place, step in enumerate(STEPS)
    }
