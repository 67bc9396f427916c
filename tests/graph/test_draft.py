"""A learned policy is written as a whole or not at all, and into an old file with care."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from sros_tool.errors import DocumentError, PolicyError
from sros_tool.files import policies_dir, replace_file
from sros_tool.graph.learn import Learned, common_parts, draft, learn, render, write
from sros_tool.graph.observation import Observation
from sros_tool.policy.document import read_policy
from sros_tool.policy.rights import policy_rights
from tests.graph.graphs import graph, node

ROBOT = graph(
    node("/talker", "publish chatter", like="python"),
    node("/hall/arm", "execute move", "subscribe /clock", like="c++", enclave="/arm"),
)
MORE = graph(*ROBOT.nodes, node("/leg", "publish step", like="c++", enclave="/leg"))


def save(path: Path, seen: Observation, *, flat: bool = False) -> Learned:
    common = None if flat else common_parts(path.parent, policies_dir())
    learned = learn(seen, common)
    write(draft(path, learned, common))
    return learned


def names(folder: Path) -> set[str]:
    return {path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file()}


@pytest.mark.parametrize("flat", [False, True])
def test_what_is_written_says_what_was_learned(tmp_path: Path, flat: bool) -> None:
    path = tmp_path / "robot.xml"
    learned = save(path, ROBOT, flat=flat)
    assert policy_rights(read_policy(path)) == policy_rights(learned.policy())
    assert (b"xi:include" in path.read_bytes()) is not flat
    assert path.stat().st_mode & 0o777 == 0o666 & ~_umask()


def test_only_the_parts_that_are_needed_come_along(tmp_path: Path) -> None:
    save(tmp_path / "robot.xml", ROBOT)
    assert names(tmp_path) == {
        "robot.xml",
        "common/node.xml",
        "common/rclpy_node.xml",
        "common/node/logging.xml",
        "common/node/parameters.xml",
        "common/node/time.xml",
        "common/node/types.xml",
    }


@pytest.mark.parametrize("flat", [False, True])
def test_again_it_changes_nothing(tmp_path: Path, flat: bool) -> None:
    path = tmp_path / "robot.xml"
    save(path, ROBOT, flat=flat)
    before = path.read_bytes(), path.stat().st_ino
    save(path, ROBOT, flat=flat)
    assert (path.read_bytes(), path.stat().st_ino) == before


def test_what_is_new_comes_with_its_includes(tmp_path: Path) -> None:
    path = tmp_path / "robot.xml"
    save(path, ROBOT)
    learned = save(path, MORE)
    whole = tmp_path / "other" / "robot.xml"
    whole.parent.mkdir()
    save(whole, MORE)
    assert sorted(path.read_text().splitlines()) == sorted(whole.read_text().splitlines())
    assert policy_rights(read_policy(path)) == policy_rights(learned.policy())


def test_a_file_keeps_its_mode_and_a_link_stays_one(tmp_path: Path) -> None:
    real, link = tmp_path / "real.xml", tmp_path / "robot.xml"
    save(real, ROBOT, flat=True)
    real.chmod(0o640)
    link.symlink_to("real.xml")
    save(link, MORE, flat=True)
    assert link.is_symlink()
    assert real.stat().st_mode & 0o777 == 0o640
    assert read_policy(real).enclave("/leg")


def test_a_denial_holds_and_its_profile_gets_no_includes(tmp_path: Path) -> None:
    path = tmp_path / "robot.xml"
    path.write_text(
        '<policy version="0.2.0">\n  <enclaves>\n    <enclave path="/robot">\n      <profiles>\n'
        '        <profile ns="/" node="other">\n          <topics publish="DENY">\n'
        "            <topic>/rosout</topic>\n          </topics>\n        </profile>\n"
        "      </profiles>\n    </enclave>\n  </enclaves>\n</policy>\n"
    )
    common = common_parts(tmp_path, policies_dir())
    plan = draft(path, learn(ROBOT, common), common)
    write(plan)
    said = {(e.enclave, e.qualifier, e.right, e.name) for e in policy_rights(read_policy(path))}
    assert ("/robot", "DENY", "publish", "/rosout") in said
    assert ("/robot", "ALLOW", "publish", "/rosout") not in said
    assert ("/robot", "ALLOW", "publish", "/chatter") in said
    assert [each.allowed.name for each in plan.contradictions] == ["/rosout"]


@pytest.mark.parametrize("content", [b"", b"<policy", b"\xff\xfe", b"<profile/>"])
def test_a_file_that_is_no_policy_is_left_alone(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "robot.xml"
    path.write_bytes(content)
    with pytest.raises(DocumentError):
        save(path, ROBOT)
    assert path.read_bytes() == content
    assert names(tmp_path) == {"robot.xml"}


@pytest.mark.parametrize("exists", [False, True])
def test_what_fails_at_the_last_step_leaves_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, exists: bool
) -> None:
    path = tmp_path / "robot.xml"
    if exists:
        save(path, ROBOT, flat=True)
    before = path.read_bytes() if exists else b""

    def full_disk(target: Path, data: bytes) -> None:
        if target == path:
            raise OSError(28, "No space left on device", str(target))
        replace_file(target, data)

    monkeypatch.setattr("sros_tool.graph.learn.replace_file", full_disk)
    with pytest.raises(OSError, match="No space"):
        save(path, MORE)
    assert {each.name for each in tmp_path.iterdir()} == ({"robot.xml"} if exists else set())
    assert not exists or path.read_bytes() == before


def test_a_result_that_says_something_else_is_not_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Whatever goes wrong between a value and its text, the file is not replaced by it."""
    path = tmp_path / "robot.xml"
    monkeypatch.setattr(
        "sros_tool.graph.learn.render", lambda found: render(found).replace(b"chatter", b"*")
    )
    with pytest.raises(PolicyError, match="cannot be written"):
        save(path, ROBOT)
    assert list(tmp_path.iterdir()) == []


def test_folders_that_were_there_stay(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "common").mkdir()
    monkeypatch.setattr("sros_tool.graph.learn.render", lambda _: b"<policy")
    with pytest.raises(PolicyError):
        save(tmp_path / "robot.xml", ROBOT)
    assert [each.name for each in tmp_path.iterdir()] == ["common"]


def _umask() -> int:
    present = os.umask(0o22)
    os.umask(present)
    return present
