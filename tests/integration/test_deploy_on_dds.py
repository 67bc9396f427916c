"""What was sent to robots, asked of a DDS that enforces security."""

from __future__ import annotations

import shutil
import sys
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

import pytest

from sros_tool.checks.keystores.arrival import verify_arrival
from sros_tool.dds.domains import DomainSet
from sros_tool.errors import SrosError
from sros_tool.keystore.delivery.archive import pack, unpack
from sros_tool.keystore.delivery.robot import import_answer
from sros_tool.keystore.delivery.signing import sign_request
from sros_tool.keystore.lifecycle.create import create_keystore, generate_artifacts
from sros_tool.keystore.template import load_template
from sros_tool.policy.document import read_policy
from sros_tool.runtime.environment import secured_environment
from tests.integration.converse import converse, listener, talker
from tests.support.children import importing, run
from tests.support.harness import create_request, forked, policy_text, publish, snapshot

pytestmark = pytest.mark.dds

DOMAIN = 130
CAMERA, VIEWER = "/arm/camera", "/arm/viewer"
HEARS = '<topics subscribe="ALLOW"><topic>/image</topic></topics>'


@pytest.fixture
def home(tmp_path: Path) -> Path:
    """A keystore in which the viewer exists, and the camera is only in the policy."""
    now = datetime.now(UTC)
    root = tmp_path / "ks"
    domains = DomainSet.of((DOMAIN, DOMAIN))
    create_keystore(root, template=load_template("production"), domains=domains, now=now)
    (tmp_path / "p.xml").write_text(policy_text({CAMERA: publish("/image"), VIEWER: HEARS}))
    (tmp_path / "viewer.xml").write_text(policy_text({VIEWER: HEARS}))
    generate_artifacts(root, policies=[read_policy(tmp_path / "viewer.xml")], now=now)
    return root


def test_an_enclave_that_was_born_on_the_robot_talks_with_an_ordinary_one(
    home: Path, tmp_path: Path
) -> None:
    now = datetime.now(UTC)
    robot = tmp_path / "robot"
    made = create_request(robot, CAMERA)
    policy = read_policy(tmp_path / "p.xml")
    request = made.file.read_bytes()
    archive = sign_request(home, request, now=now, policy=policy).archive
    assert (robot / "enclaves" / "arm" / "camera" / "key.pem").read_bytes() not in archive

    files = unpack(archive)
    path = "enclaves/arm/camera/permissions.p7s"
    tampered = pack({**files, path: files[path].replace(b"rt/image", b"rt/spied")})
    before = snapshot(robot)
    with pytest.raises(SrosError, match="does not match its content"):
        import_answer(robot, tampered, now=now)
    assert snapshot(robot) == before
    # What import refuses, DDS would refuse as well: the twin that unpacks it by hand stays mute.
    twin = Path(shutil.copytree(robot, tmp_path / "twin"))
    for name, data in unpack(tampered).items():
        (twin / name).write_bytes(data)
    hears = listener(home, VIEWER, topic="/image")
    refused = converse(DOMAIN, talker(twin, CAMERA, topic="/image"), replace(hears, hears=False))
    assert refused.nodes["talker"].sent == 0, refused
    assert "ready" not in refused.nodes["talker"].kinds, refused
    assert not refused.heard(), refused

    import_answer(robot, archive, now=now)
    assert not verify_arrival(robot, now=now, domain=DOMAIN).findings
    said = converse(DOMAIN, talker(robot, CAMERA, topic="/image"), hears)
    assert said.heard(), said


def test_a_set_that_went_through_a_pipe_talks_when_the_original_is_gone(
    home: Path, tmp_path: Path
) -> None:
    now = datetime.now(UTC)
    generate_artifacts(home, policies=[read_policy(tmp_path / "p.xml")], now=now)
    (tmp_path / "robot").mkdir()
    script = '"$0" -m sros_tool distribute_key ks --match "/arm/*" - | tar -xz -C robot'
    run(["sh", "-c", script, sys.executable], cwd=tmp_path, env=importing())
    shutil.rmtree(home)
    robot = tmp_path / "robot"
    arrival = verify_arrival(robot, now=now, domain=DOMAIN)
    assert not arrival.findings
    assert [each.name for each in arrival.enclaves] == [CAMERA, VIEWER]
    said = converse(
        DOMAIN, talker(robot, CAMERA, topic="/image"), listener(robot, VIEWER, topic="/image")
    )
    assert said.heard(), said


def test_what_run_starts_is_what_dds_loads(home: Path, tmp_path: Path) -> None:
    robot = tmp_path / "robot"
    made = create_request(robot, CAMERA)
    archive = sign_request(home, made.file.read_bytes(), now=datetime.now(UTC)).archive
    import_answer(robot, archive, now=datetime.now(UTC))
    done = forked("run", robot, CAMERA, "--", "env")
    expected = secured_environment(robot, CAMERA, DOMAIN)
    assert {f"{name}={value}" for name, value in expected.items()} <= set(done.ok().out.split("\n"))
