"""``sros audit`` beside a graph that is made up: what it prints, writes, and how it ends."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from sros_tool.cli import audit
from sros_tool.cli.observing import observe
from sros_tool.graph.observation import Observation
from sros_tool.graph.observe import Snapshot
from sros_tool.runtime.environment import RMW_ZENOH
from tests.graph.fake_graph import Beside, graph
from tests.support.harness import Ended, sros
from tests.support.long_form import some

pytest_plugins = ["tests.graph.beside"]

POLICY = """<policy version="0.2.0"><enclaves><enclave path="/t"><profiles>
<profile ns="/" node="talker"><topics publish="ALLOW"><topic>chatter</topic></topics></profile>
</profiles></enclave></enclaves></policy>
"""
FINE = ("/", "/", "talker", "01", ["publish rt/chatter"])
LOUD = ("/", "/", "talker", "01", ["publish rt/chatter", "publish rt/x"])
SHORT = ("--spin-time", "0.6")
DENIED = "/t publish topic /x (/talker): no rule allows publish rt/x\n"

Program = Callable[..., Ended]


@pytest.fixture
def program(beside_graph: Beside, tmp_path: Path) -> Program:
    """Runs ``sros audit`` beside a policy ``robot.xml`` for a talker."""
    (tmp_path / "robot.xml").write_text(POLICY)
    return partial(beside_graph, "audit")


def test_nothing_would_be_denied(program: Program, tmp_path: Path) -> None:
    """Several policies count as one."""
    (tmp_path / "hall.xml").write_text(POLICY.replace('"/t"', '"/l"').replace("talker", "listener"))
    both = graph(FINE, ("/", "/", "listener", "02", ["publish rt/chatter"]))
    ended = program(both, "robot.xml", "hall.xml", *SHORT)
    summary = "nothing would be denied to 2 nodes with 2 endpoints, on Fast DDS 2.14\n"
    assert ended == Ended(0, "", summary)


def test_an_audit_says_by_whose_rules_it_decides_and_which_nodes_ended(
    program: Program, monkeypatch: pytest.MonkeyPatch
) -> None:
    def on_zenoh(*asked: Any, **more: Any) -> tuple[Snapshot, str]:
        return replace(observe(*asked, **more)[0], observation=Observation()), RMW_ZENOH

    monkeypatch.setattr(audit, "observe", on_zenoh)
    ended = program(graph(FINE), "robot.xml", *SHORT)
    assert "with 1 endpoint, by the rules of Fast DDS 2.14\nnote [audit.ended]: " in ended.err
    assert "such nodes: /talker\nnote [audit.on-zenoh]: " in ended.err


def test_a_graph_that_still_grew_when_the_watch_ended_is_no_pass(
    program: Program, monkeypatch: pytest.MonkeyPatch
) -> None:
    for grew, accepted, status in ((False, (), 0), (True, (), 1), (True, ("--unsettled",), 0)):

        def growing(*asked: Any, grew: bool = grew, **more: Any) -> tuple[Snapshot, str]:
            snapshot, rmw = observe(*asked, **more)
            return replace(snapshot, grew=grew, seconds=12.0), rmw

        monkeypatch.setattr(audit, "observe", growing)
        ended = program(graph(FINE), "robot.xml", *SHORT, *accepted)
        assert ended.status == status
        assert ("; new nodes or endpoints still appeared in" in ended.err) is grew


@pytest.mark.parametrize(
    ("files", "words", "status", "out", "err"),
    [
        ("new", (), 0, "", "with 2 endpoints, by the keystore's files for Zenoh\n"),
        ("old", (), 1, "/t publish topic /x (/talker): put 0/x/", "write the files again with"),
        ("none", (), 1, "", "not judged: what the keystore's files for Zenoh allow"),
        (
            "none",
            ("--unjudged",),
            0,
            "",
            "[audit.zenoh-unknown]: the rules of a DDS vendor decided, not the key",
        ),
        ("old", ("--vendor", "fastdds"), 0, "", "by the rules of Fast DDS 2.14\nnote [audit.on-z"),
        ("damaged", (), 0, "", "with 2 endpoints, by the keystore's files for Zenoh\n"),
        ("damaged", ("raw",), 1, "", "; not judged: 1 topic without a ROS name (raw)\n"),
        ("new", ("raw",), 1, "/t publish DDS topic raw (/talker): no rule names publish raw", ""),
    ],
)
def test_on_zenoh_the_files_of_the_keystore_decide(
    files: str,
    words: tuple[str, ...],
    status: int,
    out: str,
    err: str,
    program: Program,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def on_zenoh(*asked: Any, **more: Any) -> tuple[Snapshot, str]:
        return observe(*asked, **more)[0], RMW_ZENOH

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(audit, "observe", on_zenoh)
    allowing_x = POLICY.replace("</topic>", "</topic><topic>x</topic>")
    for policy in (POLICY, allowing_x):
        (tmp_path / "robot.xml").write_text(policy)
        sros("generate_artifacts", "-k", "ks", "-p", "robot.xml").ok()
        if files != "none":
            sros("zenoh", "ks").ok()
        if policy == POLICY:
            shutil.copytree("ks", "before")
    if files == "old":
        for file in Path("before").rglob("*.json5*"):
            shutil.copy(file, "ks" / file.relative_to("before"))
    if files == "damaged":
        Path("ks/enclaves/t/permissions.p7s").write_text("")
    raw = ("publish raw",) if "raw" in words else ()
    node = ("/t", *LOUD[1:-1], [*LOUD[-1], *raw])
    ended = program(graph(node), "ks", *SHORT, *(word for word in words if word != "raw"))
    assert (ended.status, ended.out[: len(out)]) == (status, out)
    assert err in ended.err


TO_ALLOW = (
    "to allow the denied access, add --patch missing.xml: sros then writes the missing rights as a "
    "policy, and names the command that adds them"
)


def test_something_would_be_denied_and_nothing_is_written(program: Program, tmp_path: Path) -> None:
    ended = program(graph(LOUD), "robot.xml", *SHORT)
    summary = "1 right would be denied to 1 node with 2 endpoints, on Fast DDS 2.14\n"
    assert (ended.status, ended.out) == (1, DENIED)
    assert ended.err == f"{summary}{TO_ALLOW}\n"
    assert [each.name for each in tmp_path.iterdir()] == ["robot.xml"]


TWO = POLICY.replace("</profiles>", '<profile ns="/hall" node="listener"></profile></profiles>')


@pytest.mark.parametrize(
    ("nodes", "words", "status", "out", "verdict"),
    [
        (
            (FINE,), (), 1, "not seen: node /hall/listener of enclave /t\n",
            "only 1 of 2 nodes of the policy was seen: nothing would be denied to 1 node",
        ),
        (
            (FINE,), ("--partial",), 0, "not seen: node /hall/listener of enclave /t\n",
            "only 1 of 2 nodes of the policy was seen: nothing would be denied to 1 node",
        ),
        (
            (LOUD,), ("--partial",), 1, DENIED + "not seen: node /hall/listener of enclave /t\n",
            "only 1 of 2 nodes of the policy was seen: 1 right would be denied to 1 node",
        ),
        (
            (FINE, ("/", "/hall", "listener", "01", ["subscribe rt/chatter"])), (), 1,
            "/t subscribe topic /chatter (/hall/listener): no rule allows subscribe rt/chatter\n",
            "1 right would be denied to 2 nodes",
        ),
    ],
)  # fmt: skip
def test_the_verdict_says_what_was_not_seen(
    nodes: tuple[tuple[str, str, str, str, list[str]], ...],
    words: tuple[str, ...],
    status: int,
    out: str,
    verdict: str,
    program: Program,
    tmp_path: Path,
) -> None:
    (tmp_path / "robot.xml").write_text(TWO)
    ended = program(graph(*nodes), "robot.xml", *SHORT, *words)
    assert (ended.status, ended.out) == (status, out), ended.err
    assert ended.err.startswith(verdict)
    accepted = status == 0 or "1 right" in verdict
    assert ("--partial accepts this" in ended.err) is not accepted


def test_nodes_that_were_not_seen_are_accepted_apart_from_what_was_not_judged(
    program: Program, tmp_path: Path
) -> None:
    (tmp_path / "robot.xml").write_text(TWO)
    options = "--partial", "--unjudged"
    seen = graph(FINE, ("/", "/", "_NODE_NAME_UNKNOWN_", "09", ["publish rt/cmd_vel"]))
    for option, other in (options, options[::-1]):
        ended = program(seen, "robot.xml", *SHORT, option)
        assert ended.status == 1
        assert f"{other} accepts this" in ended.err and f"{option} accepts" not in ended.err
    assert program(seen, "robot.xml", *SHORT, *options).status == 0


@pytest.mark.parametrize("name", some(["_sros_observer", "OBSERVER"], 1))
def test_another_node_with_the_name_of_the_observer_is_shown(name: str, program: Program) -> None:
    """OBSERVER stands for the name that the observer gives itself."""
    hidden = ("/", "/", name, "02", ["publish rt/parameter_events", "publish rt/cmd_vel"])
    ended = program(graph(FINE, hidden), "robot.xml", *SHORT)
    assert ended.status == 1
    assert ended.out.startswith("/_sros_observer") and "(publish topic /cmd_vel, " in ended.out
    # Another sros that observes is a tool, and is named.
    ended = program(graph(FINE, (*hidden[:4], hidden[4][:1])), "robot.xml", *SHORT).ok()
    assert "note [audit.tool]" in ended.err and "/_sros_observer" in ended.err


def test_the_vendor_of_the_robot_decides(program: Program) -> None:
    ended = program(graph(LOUD), "robot.xml", *SHORT, "--vendor", "cyclonedds")
    assert "on Cyclone DDS" in ended.err
    ended = program(graph(LOUD), "robot.xml", *SHORT, RMW_IMPLEMENTATION="rmw_cyclonedds_cpp")
    assert "on Cyclone DDS" in ended.err


@pytest.mark.parametrize(
    ("words", "sourced", "assumed"),
    [
        (("--distro", "iron"), "", True),
        ((), "rolling", True),
        (("--vendor", "fastdds"), "rolling", False),
        (("--distro", "jazzy"), "rolling", False),
    ],
)
def test_an_audit_says_that_the_rules_of_a_distribution_are_assumed(
    words: tuple[str, ...], sourced: str, assumed: bool, program: Program
) -> None:
    ended = program(graph(FINE), "robot.xml", *SHORT, *words, ROS_DISTRO=sourced)
    note = "note [audit.assumed-distribution]: ROS 2"
    assert (f"\n{note}" in ended.err and "decided as in" in ended.err) is assumed, ended.err


EVIL = ("/", "/", "_ros2cli_12", "02", ["publish rt/cmd_evil", "subscribe rt/chatter"])


@pytest.mark.parametrize(
    ("node", "status", "said"),
    [
        # `ros2 topic echo` and the daemon only read.
        ((*EVIL[:4], EVIL[4][1:]), 0, "note [audit.tool]: left out, because these nodes are tools"),
        # `ros2 topic pub` is named with its topic.
        (EVIL, 1, "not judged: 1 node with a tool's name (/_ros2cli_12 publish /cmd_evil)\n"),
        # In the process of a robot's node, the name changes nothing.
        ((*EVIL[:3], "01", EVIL[4]), 1, "2 rights would be denied to 2 nodes with 3 endpoints"),
    ],
)
def test_no_node_hides_behind_the_name_of_a_tool(
    node: Any, status: int, said: str, program: Program
) -> None:
    seen = graph(FINE, node)
    ended = program(seen, "robot.xml", *SHORT)
    assert (ended.status, said in ended.err) == (status, True), ended.err
    found = json.loads(program(seen, "robot.xml", *SHORT, "--unjudged", "--json").out)
    assert found["allowed"] is (node[3] == "02")
    shown = found["tools"] if found["allowed"] else found["nodes"]
    assert next(each for each in shown if each["name"] == "_ros2cli_12")["subscribe"]
    assert status == 0 or "cmd_evil" in json.dumps(found)


def test_json_has_a_stable_shape(program: Program) -> None:
    ended = program(graph(LOUD), "robot.xml", *SHORT, "--json", ROS_DOMAIN_ID="7")
    assert ended.status == 1
    assert json.loads(ended.out) == {
        "version": 1,
        "source": "robot.xml",
        "kind": "policy",
        "vendor": "fastdds",
        "domain": 7,
        "allowed": False,
        "denied": [
            {
                "enclave": "/t",
                "qualifier": "ALLOW",
                "kind": "topics",
                "right": "publish",
                "name": "/x",
                "nodes": ["/talker"],
                "reason": "no rule allows publish rt/x",
                "by_rule": False,
                "new_enclave": False,
                "endpoints": [{"topic": "rt/x", "direction": "publish"}],
                "by_files": False,
            }
        ],
        "others": [],
        "refused": [],
        "unseen": [],
        "unjudged": [],
        "settled": True,
        "partial": False,
        "unjudged_accepted": False,
        "unsettled_accepted": False,
        "tools": [],
        "nodes": [
            {
                "enclaves": ["/t"],
                "namespace": "/",
                "name": "talker",
                "participant": "01" + "00" * 11,
                "publish": ["rt/chatter", "rt/x"],
                "subscribe": [],
            }
        ],
        "patch": None,
        "dry_run": False,
        "notes": [],
        "changes": [],
    }


def test_a_patch_is_merged_and_then_nothing_is_denied(program: Program, tmp_path: Path) -> None:
    ended = program(graph(LOUD), "robot.xml", *SHORT, "--patch", "add.xml")
    assert (ended.status, ended.out) == (1, DENIED)
    assert "wrote 'add.xml'; add it: sros merge_policy robot.xml add.xml --in-place" in ended.err
    sros("merge_policy", "robot.xml", "add.xml", "--in-place", cwd=tmp_path).ok()
    ended = program(graph(LOUD), "robot.xml", *SHORT, "--patch", "more.xml").ok()
    assert "no patch is needed\n" in ended.err
    assert not (tmp_path / "more.xml").exists()
    ended = program(graph(LOUD), "robot.xml", *SHORT, "--patch", "add.xml", "--force").ok()
    assert "no patch is needed; the earlier 'add.xml' stays\n" in ended.err


def test_a_name_that_the_policy_may_mean_is_named(program: Program, tmp_path: Path) -> None:
    also = '<services request="ALLOW"><service>dock</service></services></profile>'
    (tmp_path / "robot.xml").write_text(POLICY.replace("</profile>", also, 1))
    services = [f"{way} {topic}" for way, topic in (
        ("publish", "rq/dock/_action/send_goalRequest"),
        ("subscribe", "rr/dock/_action/send_goalReply"),
        ("publish", "rq/dock/_action/cancel_goalRequest"),
        ("subscribe", "rr/dock/_action/cancel_goalReply"),
        ("publish", "rq/dock/_action/get_resultRequest"),
        ("subscribe", "rr/dock/_action/get_resultReply"),
        ("subscribe", "rt/dock/_action/feedback"),
        ("subscribe", "rt/dock/_action/status"),
    )]  # fmt: skip
    node = ("/", "/", "talker", "01", ["publish rt/chater", *services])
    ended = program(graph(node), "robot.xml", *SHORT)
    assert "publish rt/chater; perhaps the policy means /chatter (the node may " in ended.out
    assert (
        "(the node may lack the remapping -r /chater:=/chatter, or the policy may lack --"
        in ended.out
    )
    assert "; the policy has it as a service (request)\n" in ended.out
    both = ("/", "/", "talker", "01", ["publish rt/chatter", "publish rt/chater"])
    ended = program(graph(both), "robot.xml", *SHORT)
    assert "no rule allows publish rt/chater\n" in ended.out


def test_a_policy_with_placeholders_is_changed_by_hand(program: Program, tmp_path: Path) -> None:
    (tmp_path / "robot.xml").write_text(POLICY.replace('"/t"', '"/{robot}/t"'))
    (tmp_path / "fleet.toml").write_text("[robots.r1]\n")
    asked = ("robot.xml", *SHORT, "--fleet", "fleet.toml", "--patch", "add.xml")
    ended = program(graph(LOUD), *asked)
    where = "robot.xml:1 (/{robot}/t)"
    by_hand = f"wrote 'add.xml'; add its rights by hand, with placeholders, at {where}\n"
    assert ended.status == 1 and by_hand in ended.err
    (tmp_path / "robot.xml").write_text(POLICY.replace('"/t"', '"/r1/t"'))
    ended = program(graph(LOUD), *asked, "--force")
    assert "add it: sros merge_policy robot.xml add.xml --in-place" in ended.err
    ended = program(graph(LOUD), "robot.xml", *SHORT, "--patch", "-")
    assert (ended.status, (tmp_path / "-").exists()) == (2, False)
    assert "'-' is not a file name here" in ended.err


def test_a_dry_run_writes_no_patch(program: Program, tmp_path: Path) -> None:
    ended = program(graph(LOUD), "robot.xml", *SHORT, "--patch", "add.xml", "--dry-run")
    assert ended.status == 1
    assert "would write 'add.xml'" in ended.err
    assert not (tmp_path / "add.xml").exists()


def test_a_denial_by_a_rule_is_not_patched(program: Program, tmp_path: Path) -> None:
    denial = '</topics><topics publish="DENY"><topic>x</topic></topics>'
    (tmp_path / "robot.xml").write_text(POLICY.replace("</topics>", denial))
    ended = program(graph(LOUD), "robot.xml", *SHORT, "--patch", "add.xml")
    assert ended.status == 1
    assert "denies publish rt/x" in ended.out
    assert "some of these rights are denied by a DENY" in ended.err
    assert "no patch was written" in ended.err
    assert not (tmp_path / "add.xml").exists()


def test_the_rights_of_a_node_of_another_enclave_are_not_patched(
    program: Program, tmp_path: Path
) -> None:
    """A process of two nodes: `sros check` would refuse a node in two enclaves."""
    (tmp_path / "other.xml").write_text(
        POLICY.replace('"/t"', '"/l"').replace("talker", "listener")
    )
    other = ("/", "/", "listener", "01", ["publish rt/chatter"])
    ended = program(graph(LOUD, other), "robot.xml", "other.xml", *SHORT, "--patch", "add.xml")
    assert ended.status == 1
    assert "`sros merge_policy POLICY OTHER --enclave ENCLAVE`, with --node for each" in ended.err
    assert "no patch was written: first give the nodes of each process one enclave\n" in ended.err
    assert not (tmp_path / "add.xml").exists()


def test_a_watch_tells_each_denial_when_it_is_seen(program: Program) -> None:
    ended = program(graph(LOUD), "robot.xml", "--watch", "1s")
    assert (ended.status, ended.out) == (1, DENIED)
    watching, denied, _, to_allow = ended.err.splitlines()
    assert to_allow == TO_ALLOW
    assert watching == "watching for 1 s, or until Ctrl-C; then the result is shown"
    assert denied == f"denied: {DENIED.strip()}"


def test_a_keystore_is_audited_too(program: Program, tmp_path: Path) -> None:
    sros("generate_artifacts", "-k", "ks", "-p", "robot.xml", cwd=tmp_path).ok()
    shown = ("/t", *LOUD[1:])
    ended = program(graph(shown), "ks", *SHORT)
    assert (ended.status, ended.out) == (1, DENIED)
    ended = program(graph(shown), *SHORT, ROS_SECURITY_KEYSTORE="ks")
    assert (ended.status, ended.out) == (1, DENIED)


FAILS = {"fails": "node", "says": "boom"}


@pytest.mark.parametrize(
    ("seen", "words", "said"),
    [
        (graph(), ("robot.xml",), "there is nothing to audit: no node was observed"),
        (graph(("/", "/", "_ros2cli_12", "01", [])), ("robot.xml",), "no node was observed"),
        (FAILS, ("robot.xml",), "rclpy cannot start a node to observe the graph"),
        (graph(FINE), ("gone.xml",), "gone.xml"),
        (graph(FINE), ("gone",), "gone"),
        (graph(FINE), (), "no keystore is named"),
        (graph(FINE), ("ks/enclaves/t",), "is neither a policy nor a keystore"),
        (graph(FINE), ("robot.xml", "--force"), "--force is for --patch only"),
        (graph(FINE), ("robot.xml", "--patch", "robot.xml"), "already exists"),
        (graph(FINE), ("robot.xml", "--watch", "1s"), "--watch and --spin-time exclude"),
        (graph(FINE), ("robot.xml", "--keystore", "ks"), "without --enclave"),
        (graph(FINE), ("ks", "--enclave", "/t"), "No argument names it: 'ks' is compared"),
        (graph(FINE), ("robot.xml", "--domain", "999"), "999"),
    ],
)
def test_what_cannot_be_asked_is_not_a_no(
    seen: dict[str, object], words: tuple[str, ...], said: str, program: Program, tmp_path: Path
) -> None:
    sros("generate_artifacts", "-k", "ks", "-p", "robot.xml", cwd=tmp_path).ok()
    ended = program(seen, *words, *SHORT)
    assert (ended.status, ended.out) == (2, "")
    assert said in ended.err
    assert ended.err.count("\n") == 1


def test_a_policy_is_not_compared_with_the_runtime(tmp_path: Path) -> None:
    (tmp_path / "robot.xml").write_text(POLICY)
    ended = sros("check", "runtime", "--policy", "robot.xml", cwd=tmp_path)
    assert ended.status == 2
    assert "sros audit robot.xml" in ended.err


@pytest.mark.parametrize("words", [SHORT, ("--watch", "1s")])
def test_a_name_on_the_network_forges_no_line(program: Program, words: tuple[str, ...]) -> None:
    """The names of nodes and topics are what anybody on the network sends."""
    hostile = ("/", "/", "talker", "01", ["publish rt/x\x1b[2J\n/t publish topic /y"])
    ended = program(graph(hostile), "robot.xml", *words)
    assert ended.status == 1
    assert "\x1b" not in ended.out + ended.err
    for text in (ended.out, ended.err):
        assert [line for line in text.splitlines() if line.startswith("/t publish topic /y")] == []
    assert "\\x1b[2J\\x0a/t publish topic /y" in ended.out
    stray = graph(LOUD, ("/", "/", "_NODE_NAME_UNKNOWN_", "09", ["publish Sq\nnote [x]: forged"]))
    ended = program(stray, "robot.xml", *words)
    assert [line for line in ended.err.splitlines() if line.startswith("note [x]")] == []
    assert "note [audit.stray]" in ended.err
