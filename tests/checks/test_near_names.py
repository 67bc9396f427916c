"""Which names are taken for typing errors of another one, and which are not."""

from __future__ import annotations

from pathlib import Path

import pytest

from sros_tool.checks.policies import NearNames, policy_file_findings
from sros_tool.files import policies_dir
from tests.checks.policy_cases import services, topics

NEAR = [
    ("/griper/set", "/gripper/set"),
    ("/scan", "/scans"),
    ("/scan", "/sacn"),
    ("/front/scan", "/front/scam"),
    ("/cmd_vel", "/cmdvel"),
    ("/cmd_vel", "/Cmd_Vel"),
    ("/arm/joint_states", "/arm/joint_state"),
]
DIFFERENT = [
    ("/r1/grip", "/r2/grip"),
    ("/camera1/image", "/camera12/image"),
    ("/arm_l/state", "/arm_r/state"),
    ("/wheel_fl", "/wheel_fr"),
    ("/x_min", "/x_max"),
    ("/left/image", "/right/image"),
    ("/light/start", "/light/state"),
    ("/scan", "/front/scan"),
    ("/grip", "/drive"),
    ("/scan", "/scan"),
]


@pytest.mark.parametrize(("one", "other"), NEAR)
def test_near(one: str, other: str) -> None:
    assert NearNames([one, "/x"]).near(other) == [one]
    assert NearNames([other, "/x"]).near(one) == [other]


@pytest.mark.parametrize(("one", "other"), DIFFERENT)
def test_different(one: str, other: str) -> None:
    assert NearNames([one]).near(other) == []
    assert NearNames([other]).near(one) == []


def found(path: Path, content: str) -> dict[str, str]:
    path.write_text(
        '<policy version="0.2.0"><enclaves><enclave path="/a"><profiles><profile ns="/" '
        f'node="_a">{content}</profile></profiles></enclave></enclaves></policy>'
    )
    return {each.id: each.text for each in policy_file_findings(path)}


def test_another_kind_is_meant(tmp_path: Path) -> None:
    other = '</profile><profile ns="/" node="_b">'
    call = '<actions call="ALLOW"><action>pick</action></actions>'
    said = found(tmp_path / "p.xml", call + other + services("reply", "pick"))
    assert "perhaps you mean /pick (reply)" in said["policy.name-misspelt"]
    said = found(
        tmp_path / "p.xml", topics("subscribe", "pick") + other + services("reply", "pick")
    )
    assert "perhaps you mean /pick (reply)" in said["policy.name-misspelt"]
    same = found(tmp_path / "p.xml", topics("subscribe", "pick") + services("reply", "pick"))
    assert "policy.name-misspelt" not in same, "of one node"


def test_a_name_with_a_counterpart_is_no_typing_error(tmp_path: Path) -> None:
    used = topics("publish", "scan") + topics("subscribe", "scan")
    assert set(found(tmp_path / "p.xml", used + topics("subscribe", "scam"))) == {
        "policy.no-counterpart"
    }
    assert found(tmp_path / "p.xml", used + topics("publish", "scam")) == {}


def test_the_shipped_policies_have_none() -> None:
    for file in policies_dir().rglob("*.xml"):
        ids = {each.id for each in policy_file_findings(file)}
        assert "policy.name-misspelt" not in ids, file
