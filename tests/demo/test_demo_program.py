"""What the demo checks before it starts, the policy it makes, and the backend it chooses."""

from __future__ import annotations

import json
import subprocess
from datetime import UTC, datetime
from pathlib import Path

import pytest

from sros_tool.demo import backend as backends
from sros_tool.demo.backend import choose_backend
from sros_tool.demo.nodes import split_ros_args
from sros_tool.demo.program import DemoOptions, run_demo
from sros_tool.demo.result import DemoResult, RowResult, ScenarioResult, demo_table
from sros_tool.demo.scenarios.model import Role, RowStatus, check_topic, talking_policy
from sros_tool.errors import UnavailableError, UsageError
from sros_tool.keystore.template import load_template
from sros_tool.runtime.stacks import ProbeEnclave, Stack
from sros_tool.values import as_plain
from tests.support.harness import sros

NOW = datetime(2026, 1, 1, tzinfo=UTC)
PROBE = ProbeEnclave({}, "/chatter", "/denied")
ENFORCING = Stack("rclpy with rmw_x", "rmw", "X DDS", "1.0", "/x", True, True, "seen", rmw="rmw_x")
CYCLONE = Stack("Cyclone DDS", "cyclone", "Cyclone DDS", "0.10", "/c", True, True, "seen")
ABSENT = Stack("rclpy", "rmw", "", "", "", False, None, "")


@pytest.mark.parametrize(
    ("given", "absolute"), [("chatter", "/chatter"), ("/a/b_1", "/a/b_1"), ("_x", "/_x")]
)
def test_topics(given: str, absolute: str) -> None:
    assert check_topic(given) == absolute


@pytest.mark.parametrize(
    "topic",
    [
        *("", "/", "9x", "/a//b", "/a/", "a b", "a*", "~/a", "~", "ä", "a\n", "a" * 201, "a/9"),
        *("a-b", "{a}", "/rosout", "/parameter_events", "/clock", "/sros_not_allowed"),
    ],
)
def test_topics_that_are_refused(topic: str, tmp_path: Path) -> None:
    with pytest.raises(UsageError):
        check_topic(topic)
    keep = tmp_path / "kept"
    options = DemoOptions(load_template("production"), topic=topic, keep=keep)
    with pytest.raises(UsageError):
        run_demo(options, NOW, print)
    assert not keep.exists()


@pytest.mark.parametrize("domain", [-1, 221, 230, 99999])
def test_domains_that_are_refused(domain: int, tmp_path: Path) -> None:
    keep = tmp_path / "kept"
    options = DemoOptions(load_template("production"), domain=domain, keep=keep)
    with pytest.raises(UsageError, match="domain"):
        run_demo(options, NOW, print)
    assert not keep.exists()


def test_a_folder_with_something_in_it_is_not_mixed_with_the_demo(tmp_path: Path) -> None:
    (tmp_path / "mine").write_text("x")
    options = DemoOptions(load_template("production"), keep=tmp_path)
    with pytest.raises(UsageError, match="not an empty folder"):
        run_demo(options, NOW, print)
    assert [path.name for path in tmp_path.iterdir()] == ["mine"]


def test_nothing_is_kept_of_a_demo_that_could_not_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(backends, "rclpy_stacks", lambda _probe: iter([ABSENT]))
    keep = tmp_path / "kept"
    options = DemoOptions(load_template("production"), backend="rclpy", keep=keep)
    with pytest.raises(UnavailableError):
        run_demo(options, NOW, print)
    assert not keep.exists()


def test_the_policy_follows_the_topic_and_leaves_two_enclaves_without_it() -> None:
    policy = talking_policy("/camera")
    topics = {
        enclave.path.rpartition("/")[2]: {
            (right, name)
            for profile in enclave.all_profiles()
            for group in profile.groups
            if group.kind == "topics"
            for right, _ in group.rights
            for name in group.names
        }
        for enclave in policy.enclaves
    }
    assert ("publish", "/camera") in topics["talker"]
    assert ("subscribe", "/camera") in topics["listener"]
    assert not any("chatter" in name for rights in topics.values() for _, name in rights)
    assert topics["talker"] - topics["talker_without_permission"] == {("publish", "/camera")}
    assert topics["listener"] - topics["listener_without_permission"] == {("subscribe", "/camera")}
    assert topics["talker_without_permission"]


@pytest.mark.parametrize(
    ("wish", "ros", "cyclone", "name", "why"),
    [
        ("auto", ENFORCING, CYCLONE, "rclpy", "enforces security here"),
        ("auto", ENFORCING._replace(enforces=False), CYCLONE, "cyclone", "does not enforce"),
        ("auto", ENFORCING._replace(enforces=None), CYCLONE, "cyclone", "could not be tried"),
        ("auto", ABSENT, CYCLONE, "cyclone", "rclpy is not installed here"),
        ("cyclone", ENFORCING, CYCLONE, "cyclone", "chosen with --backend"),
        ("rclpy", ENFORCING, CYCLONE, "rclpy", "chosen with --backend"),
        ("rclpy", ABSENT, CYCLONE, None, "rclpy is not installed here"),
        ("auto", ABSENT, CYCLONE._replace(enforces=False), None, "no DDS here"),
        ("cyclone", ENFORCING, CYCLONE._replace(enforces=None), None, "no DDS here"),
    ],
)
def test_backends(
    wish: str,
    ros: Stack,
    cyclone: Stack,
    name: str | None,
    why: str,
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
) -> None:
    monkeypatch.setattr(backends, "rclpy_stacks", lambda _probe: iter([ros]))
    monkeypatch.setattr(backends, "cyclone_stack", lambda _probe: cyclone)
    if name is None:
        with pytest.raises(UnavailableError, match=why):
            choose_backend(wish, PROBE)
        return
    chosen = choose_backend(wish, PROBE)
    assert chosen.name == name
    assert why in chosen.why
    if name == "rclpy":
        assert chosen.environment(Role.TALKER, wire=False) == {"RMW_IMPLEMENTATION": "rmw_x"}
        command = chosen.command(Role.TALKER, ["--topic", "/x"], ["/robot/mouth"])
        module, role, *options = command[command.index("-m") + 1 :]
        assert (module, role) == ("sros_tool.demo.ros_node", "talker")
        remapped = ["-r", "talker:__node:=mouth", "-r", "mouth:__ns:=/robot"]
        assert options == ["--topic", "/x", "--ros-args", *remapped, "--"]
    else:
        variables = chosen.environment(Role.TALKER, wire=True)
        assert list(variables) == ["PYTHONPATH"]
        command = chosen.command(Role.LISTENER, ["--topic", "/x"], ["/robot/ear"])
        # Without site packages, the module is found by the variable alone, wherever it is run.
        found = [*command[: command.index("-m")], "-c", "import sros_tool.demo.cyclone_node"]
        subprocess.run(found, env=dict(variables), cwd=tmp_path, check=True)
        assert command[-4:] == ["sros_tool.demo.cyclone_node", "listener", "--topic", "/x"]


@pytest.mark.parametrize(
    ("given", "own", "ros"),
    [
        (["--topic", "x"], ["--topic", "x"], []),
        (["-x", "--ros-args", "-r", "a:=b"], ["-x"], ["-r", "a:=b"]),
        (["--ros-args", "-e", "/a", "--", "-x"], ["-x"], ["-e", "/a"]),
    ],
)
def test_ros_arguments(given: list[str], own: list[str], ros: list[str]) -> None:
    assert split_ros_args(given) == (own, ros)


def test_the_table_shows_reasons_and_a_summary() -> None:
    rows = (
        RowResult("a", RowStatus.HEARD, RowStatus.HEARD, "m", "49 of 50", 1),
        RowResult("b", RowStatus.REFUSED, RowStatus.CRASHED, "m", "SIGSEGV", 2),
        RowResult("c", RowStatus.READABLE, RowStatus.SKIPPED, "m", "not permitted", 3),
    )
    result = DemoResult(
        backend="cyclone",
        dds="C 1",
        why="w",
        template="production",
        topic="/t",
        names=("service /s", "action /a"),
        own_network=False,
        network_reason="no right",
        scenarios=(ScenarioResult("s", "title", rows),),
    )
    text = demo_table(result)
    assert text.startswith("C 1, service /s, action /a, in the network of this machine (no right)")
    assert "FAIL  b" in text
    assert "not permitted" in text
    assert text.endswith("1 of 3 rows as expected, 1 not as expected, 1 skipped.")
    assert not result.as_expected
    assert as_plain(result)["rows"][1]["as_expected"] is False


def test_rows_that_nobody_has_are_refused() -> None:
    options = DemoOptions(load_template("production"), only=("no such row",))
    with pytest.raises(UsageError, match="no row has 'no such row'"):
        run_demo(options, NOW, print)


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (("--scenario", "nothing"), "no scenario 'nothing'"),
        (("--summary", "no/such/folder/x.md"), "Its folder does not exist"),
        (("--keystore", "x"), "isolation cannot run in your keystore"),
        (("--topic", ""), "not a topic name"),
        (("--accept-open", "x"), "--accept-open is given without --keystore"),
    ],
)
def test_wrong_usage_is_told_before_anything_runs(
    arguments: tuple[str, ...], told: str, tmp_path: Path
) -> None:
    ended = sros("demo", *arguments, cwd=tmp_path)
    assert ended.status == 2
    assert told in ended.err
    assert not list(tmp_path.iterdir())


def test_the_list_of_scenarios() -> None:
    text = sros("demo", "--list").ok().out
    on_dds, _, on_zenoh = text.partition("\nwith --backend zenoh:\n")
    assert [line.split()[0] for line in on_dds.splitlines()] == [
        *("isolation", "services", "actions", "composition", "attacks", "governance")
    ]
    assert [line.split()[0] for line in on_zenoh.splitlines()] == [
        *("isolation", "services", "routers", "attacks")
    ]
    shown = json.loads(sros("demo", "--list", "--json").ok().out)["scenarios"]
    assert shown[0]["rows"] == 11
