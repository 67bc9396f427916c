"""A policy for a fleet loses what no robot used, and keeps its placeholders."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from tests.support.harness import policy_text, publish, sros, subscribe

FLEET = """[robots.r1]
namespace = "/hall/r1"
[robots.r2]
[robots.r3]
namespace = "/"
"""
POLICY = policy_text(
    {
        "/{robot}/base": publish(
            "{namespace}/odom", "/fleet/{robot}_state", "{namespace}/unused", "{namespace}/wide/*"
        )
        + subscribe("/all/*", "/one/{robots}/x"),
        "/dispatcher": subscribe("{namespaces}/odom", "/{robots}/*", "{namespaces}/never"),
    }
)
SEEN = policy_text(
    {
        "/r1/base": publish("/hall/r1/odom", "/fleet/r1_state", "/hall/r1/wide/a", "/hall/r1/no")
        + subscribe("/all/r1/b"),
        "/r3/base": publish("/wide/c") + subscribe("/all/d", "/one/r2/x"),
        "/dispatcher": subscribe("/hall/r1/odom", "/r2/y"),
        "/stranger": publish("/x"),
    }
)
WORDS = ("minimize_policy", "robot.xml", "--observed", "seen.xml", "--fleet", "fleet.toml")


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    for name, text in (("fleet.toml", FLEET), ("robot.xml", POLICY), ("seen.xml", SEEN)):
        (tmp_path / name).write_text(text)
    return tmp_path


def test_what_one_robot_used_stays_for_all(folder: Path) -> None:
    ended = sros(*WORDS, "-o", "narrow.xml", cwd=folder).ok()
    assert "publish topic {namespace}/unused" in ended.out
    assert "observed, and not allowed\n    publish topic /hall/r1/no\n" in ended.out
    assert (
        "/{robot}/base was never observed for r2: rights that only this robot uses are removed"
        in ended.err
    )
    assert "observed, but the policy lacks them: /stranger." in ended.err
    wanted = POLICY.replace("<topic>{namespace}/unused</topic>", "")
    wanted = wanted.replace("<topic>{namespaces}/never</topic>", "")
    wide = "<topic>{namespace}/wide/%s</topic>"
    wanted = wanted.replace(wide % "*", wide % "a" + wide % "c")
    wanted = wanted.replace(">/all/*<", ">/all/d</topic><topic>/all/{robot}/b<")
    (folder / "wanted.xml").write_text(wanted)
    same = ("diff_policy", "narrow.xml", "wanted.xml", "--fleet", "fleet.toml")
    assert sros(*same, cwd=folder).out == ""
    narrow = (folder / "narrow.xml").read_text()
    assert "{namespace}/wide/a" in narrow and "/{robots}/*" in narrow and "/hall" not in narrow
    again = json.loads(sros(*WORDS, "--json", cwd=folder).ok().out)
    names = {each["name"] for each in again["enclaves"][0]["never_observed"]}
    assert names == {"{namespace}/unused"}
    assert sros(*WORDS[:4], cwd=folder).status == 2


def test_a_wildcard_that_differs_between_robots_is_not_narrowed(folder: Path) -> None:
    (folder / "robot.xml").write_text(policy_text({"/{robot}/base": publish("/???????/x")}))
    (folder / "seen.xml").write_text(policy_text({"/r1/base": publish("/r1/x")}))
    ended = sros(*WORDS, "-o", "narrow.xml", cwd=folder)
    assert (ended.status, ended.out) == (2, "")
    assert "cannot be narrowed for all robots together" in ended.err
    assert "which enclaves may publish topic " in " ".join(ended.err.split())
    assert not (folder / "narrow.xml").exists()


def test_what_is_observed_and_denied_is_not_kept(folder: Path) -> None:
    denied = publish("{namespace}/secret").replace("ALLOW", "DENY")
    (folder / "robot.xml").write_text(policy_text({"/{robot}/base": publish("/*") + denied}))
    (folder / "seen.xml").write_text(policy_text({"/r1/base": publish("/hall/r1/secret", "/a")}))
    ended = sros(*WORDS, "--strict", cwd=folder).ok()
    assert "publish topic /*  becomes  publish topic /a\n" in ended.out


def test_a_robot_that_was_not_observed_is_a_difference(folder: Path) -> None:
    (folder / "robot.xml").write_text(policy_text({"/{robot}/base": publish("/a")}))
    for robots, status in ((("r1", "r3"), 1), (("r1", "r2", "r3"), 0)):
        seen = {f"/{robot}/base": publish("/a") for robot in robots}
        (folder / "seen.xml").write_text(policy_text(seen))
        assert sros(*WORDS, "--fail-on", "difference", cwd=folder).status == status
