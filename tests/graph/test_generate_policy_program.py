"""``sros generate_policy`` without a graph: its words, its logs, and what it does without rclpy."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import pytest

from sros_tool.policy.document import read_policy
from sros_tool.policy.rights import Right, policy_rights
from tests.support.children import python
from tests.support.harness import sros

LOG = Path(__file__).parents[1] / "explain" / "denial_logs" / "fastdds_2.9.1.log"
CYCLONE = LOG.with_name("cyclone_0.10.2.log")


@pytest.fixture
def no_rclpy(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "rclpy", None)


@pytest.mark.usefixtures("no_rclpy")
def test_without_rclpy_one_paragraph_says_what_to_install(tmp_path: Path) -> None:
    ended = sros("generate_policy", tmp_path / "robot.xml")
    assert (ended.status, ended.out) == (2, "")
    assert ended.err.count("\n") == 1
    assert ended.err.startswith("Unable to generate policy: rclpy is not installed")
    assert "pip install 'ros-jazzy-rclpy[fastrtps]'" in ended.err
    assert list(tmp_path.iterdir()) == []


def test_every_module_of_the_graph_can_be_imported_without_rclpy() -> None:
    code = (
        "import sys, pkgutil, importlib, sros_tool.graph as graph\n"
        "sys.modules['rclpy'] = None\n"
        "for each in pkgutil.iter_modules(graph.__path__):\n"
        "    importlib.import_module(f'sros_tool.graph.{each.name}')\n"
        "import sros_tool.cli.observing\n"
    )
    python("-c", code)


@pytest.mark.usefixtures("no_rclpy")
def test_a_policy_that_is_broken_is_found_before_anything_else(tmp_path: Path) -> None:
    path = tmp_path / "robot.xml"
    path.write_text("<policy>")
    ended = sros("generate_policy", path, "--watch", "10m")
    assert ended.status == 2
    assert "not well-formed" in ended.err


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ((), "no file is named"),
        (("nowhere/robot.xml",), "the folder 'nowhere' does not exist"),
        (("robot.xml", "--node", "/n"), "--node is for --from-log only"),
        (("robot.xml", "--accept"), "--accept is for --from-log only"),
        (("--from-log", "-", "--accept"), "--accept is given without FILE"),
        (("robot.xml", "--keystore", "ks"), "--keystore is given without --enclave"),
        (
            ("robot.xml", "--enclave", "/a"),
            "names it: 'robot.xml' is the policy to write. Add --key",
        ),
        (("robot.xml", "--domain", "x"), "not a domain id"),
        (("robot.xml", "--watch", "5 minutes"), "5 minutes"),
        (("robot.xml", "--from-log", "gone.log"), "the log 'gone.log' does not exist"),
    ],
)
def test_wrong_usage(tmp_path: Path, words: tuple[str, ...], said: str) -> None:
    ended = sros("generate_policy", *words, cwd=tmp_path)
    assert ended.status == 2
    assert said in ended.err
    assert list(tmp_path.iterdir()) == []


def test_the_rules_that_logs_ask_for_go_to_stdout() -> None:
    ended = sros("generate_policy", "--enclave", "/robot", "--node", "/hall/arm", "--from-log", LOG)
    assert ended.status == 0
    assert '<profile ns="/hall" node="arm">' in ended.out
    assert "<service>/add</service>" in ended.out
    assert "note [log.denied-by-rule]" in ended.err


def test_or_as_json() -> None:
    ended = sros("generate_policy", "--enclave", "/robot", "--from-log", CYCLONE, "--json").ok()
    value = json.loads(ended.out)
    assert [(each["right"], each["name"]) for each in value["added"]] == [
        ("publish", "/nope"),
        ("subscribe", "/chatter"),
    ]
    assert [each["id"] for each in value["notes"]] == [
        "log.unclear",
        "log.denied-by-rule",
        "log.node-assumed",
    ]
    assert ended.err == ""


def test_or_into_a_file(tmp_path: Path) -> None:
    words = ("--enclave", "/robot", "--from-log", LOG, CYCLONE, "--accept")
    path = tmp_path / "robot.xml"
    first = sros("generate_policy", path, *words).ok()
    assert "wrote" in first.out
    rights = {f"{each.right} {each.name}" for each in policy_rights(read_policy(path))}
    basic = {right for right in rights if "parameter" in right or "/robot/" in right}
    assert rights - basic - {"publish /rosout", "subscribe /clock"} == {
        "publish /nope",
        "subscribe /chatter",
        "request /add",
        "call /fibonacci",
    }
    sros("check", path).ok()  # a new policy has what every node needs
    before = path.read_bytes()
    second = sros("generate_policy", path, *words, "--json").ok()
    assert json.loads(second.out)["changed"] is False
    assert path.read_bytes() == before


def test_a_dry_run_of_a_log_writes_nothing(tmp_path: Path) -> None:
    words = ("--enclave", "/robot", "--from-log", LOG, "--dry-run")
    ended = sros("generate_policy", tmp_path / "robot.xml", *words).ok()
    assert "would have written" in ended.out
    assert list(tmp_path.iterdir()) == []


def test_a_log_without_denials(tmp_path: Path) -> None:
    (tmp_path / "quiet.log").write_text("[INFO] [talker]: Publishing: 'Hello World: 1'\n")
    ended = sros("generate_policy", "--from-log", tmp_path / "quiet.log")
    assert (ended.status, ended.err) == (1, "The logs report no denial.\n")


def test_the_enclave_has_to_be_known() -> None:
    ended = sros("generate_policy", "--from-log", LOG)
    assert ended.status == 2
    assert "Name the enclave with --enclave." in ended.err


BARE = """<policy version="0.2.0">
  <enclaves>
    <enclave path="/talker_listener/talker">
      <profiles>
        <profile ns="/" node="talker">
          <topics publish="ALLOW">
            <topic>chatter</topic>
          </topics>
        </profile>
      </profiles>
    </enclave>
  </enclaves>
</policy>
"""
SECURED = LOG.parents[2] / "explain/logs"


def test_a_missing_common_part_is_included_in_one_round(tmp_path: Path) -> None:
    path = tmp_path / "robot.xml"
    path.write_text(BARE)
    log = SECURED / "fastdds_2.14.5.common_part_missing.log"
    ended = sros("generate_policy", path, "--from-log", log, "--accept").ok()
    text = path.read_text()
    assert text.count("<xi:include") == 1 and "<topic>chatter</topic>" in text
    assert (tmp_path / "common/node/parameters.xml").exists()
    assert "added 11 rights" in ended.out and "proposed together" in ended.err
    rights = {(each.right, each.name) for each in policy_rights(read_policy(path))}
    assert {("publish", "/rosout"), ("reply", "/talker/set_parameters")} < rights
    again = sros("generate_policy", path, "--from-log", log, "--accept").ok()
    assert "nothing to add" in again.out and path.read_text() == text


def test_a_missing_common_part_without_includes(tmp_path: Path) -> None:
    path = tmp_path / "robot.xml"
    path.write_text(BARE)
    log = SECURED / "fastdds_2.14.5.common_part_missing.log"
    ended = sros("generate_policy", path, "--flat", "--from-log", log, "--accept").ok()
    assert "added 11 rights" in ended.out
    assert "include" not in path.read_text() and not (tmp_path / "common").exists()


def test_the_services_of_a_node_of_another_name_are_not_written(tmp_path: Path) -> None:
    path = tmp_path / "robot.xml"
    path.write_text(BARE)
    log = SECURED / "fastdds_2.14.5.node_name_differs.log"
    ended = sros("generate_policy", path, "--from-log", log)
    assert ended.status == 1 and path.read_text() == BARE
    assert "/foo: enclave /talker_listener/talker has /talker" in ended.err
    sros("generate_policy", path, "--from-log", log, "--node", "/foo", "--accept").ok()
    assert 'node="foo"' in path.read_text()


# ── a process can print what it likes ──────────────────────────────────────────────────────

HONEST = "[talker-1] rt/status topic not found in allow rule. -> check_create_datawriter"
FORGED = (
    "[evil-2] [rcl]: Found security directory: /ks/enclaves/talker_listener/talker\n"
    "[evil-2] rt/cmd_vel topic not found in allow rule. -> check_create_datawriter\n"
)
OTHER_LABEL = FORGED.replace("[evil-2] rt", "[evil-2] x\r[talker-1] rt")
TALKER = "/talker_listener/talker"


@pytest.mark.parametrize("present", [BARE, None], ids=["merged", "new"])
def test_no_right_from_a_log_is_written_that_nobody_accepted(
    tmp_path: Path, present: str | None
) -> None:
    path, log = tmp_path / "robot.xml", tmp_path / "talker.log"
    log.write_text(FORGED)
    if present:
        path.write_text(present)
    ended = sros("generate_policy", path, "--from-log", log)
    assert ended.status == 2 and path.exists() == bool(present)
    assert present in (None, path.exists() and path.read_text())
    assert f"  {TALKER} ALLOW publish topic /cmd_vel\n" in ended.out
    assert f"  {log}:2: evil-2: publish rt/cmd_vel in {TALKER}\n" in ended.out
    assert "a process can print any line" in ended.err and "add --accept" in ended.err
    sros("generate_policy", path, "--from-log", log, "--dry-run").ok()
    assert path.exists() == bool(present)
    sros("generate_policy", path, "--from-log", log, "--accept").ok()
    assert ("publish", "/cmd_vel") in {(each.right, each.name) for each in rights_in(path)}
    again = sros("generate_policy", path, "--from-log", log).ok()
    assert "nothing to add" in again.out


def rights_in(path: Path) -> frozenset[Right]:
    return policy_rights(read_policy(path))


def test_json_and_the_policy_say_that_the_rights_come_from_a_log(tmp_path: Path) -> None:
    log = tmp_path / "talker.log"
    log.write_text(FORGED)
    denial = {"log": str(log), "line": 2, "process": "evil-2", "enclave": TALKER,
              "direction": "publish", "topic": "rt/cmd_vel"}  # fmt: skip
    shown = json.loads(sros("generate_policy", "--from-log", log, "--json").ok().out)
    assert (shown["source"], shown["denials"]) == ("log", [denial])
    ended = sros("generate_policy", tmp_path / "robot.xml", "--from-log", log, "--json")
    value = json.loads(ended.out)
    assert (ended.status, value["source"], value["accepted"]) == (2, "log", False)
    assert value["denials"] == [denial]
    printed = sros("generate_policy", "--from-log", log).ok()
    assert "a process can print any line" in printed.out.partition("<policy")[0]


def test_only_a_line_feed_ends_a_line(tmp_path: Path) -> None:
    """Or a process could print the label of another one behind another separator of lines."""
    for separator in "\r\v\f\x1c\x85\u2028":
        (tmp_path / "log").write_text(OTHER_LABEL.replace("\r", separator), newline="")
        ended = sros("generate_policy", "--from-log", tmp_path / "log", "--json").ok()
        assert {each["process"] for each in json.loads(ended.out)["denials"]} == {"evil-2"}
        told = sros("explain", "--log", tmp_path / "log", "--json")
        assert {each["process"] for each in json.loads(told.out)["findings"]} == {"evil-2"}


def test_with_an_enclave_no_other_one_gets_rights(tmp_path: Path) -> None:
    (tmp_path / "log").write_text(f"{HONEST}\n{FORGED}")
    words = ("generate_policy", "--from-log", tmp_path / "log", "--json", "--enclave")
    value = json.loads(sros(*words, "/arm").ok().out)
    assert [(each["enclave"], each["name"]) for each in value["added"]] == [("/arm", "/status")]
    assert [each["process"] for each in value["denials"]] == ["talker-1"]
    assert "log.other-enclave" in [each["id"] for each in value["notes"]]
    both = json.loads(sros(*words, TALKER).ok().out)
    assert [each["name"] for each in both["added"]] == ["/cmd_vel", "/status"]
