"""``sros generate_policy`` beside a graph that is made up: what it says, and how it fails."""

from __future__ import annotations

import json
from collections.abc import Callable
from functools import partial
from pathlib import Path

import pytest
from lxml import etree

from sros_tool.cli import observing
from sros_tool.close.proof import _seen_by_listener
from sros_tool.graph import observe
from sros_tool.graph.observation import (
    PROFILE_VARIABLES,
    IntermittentEndpoint,
    intermittent_from_json,
    make_observation,
)
from sros_tool.graph.observe import Snapshot
from tests.cli.test_json import Seen
from tests.graph.fake_graph import Beside, graph
from tests.graph.graphs import graph as known_graph
from tests.graph.graphs import node
from tests.support.harness import Ended, sros

pytest_plugins = ["tests.graph.beside"]

NO_NODES = "No nodes detected in the ROS graph. No policy file was generated."

Program = Callable[..., Ended]


@pytest.fixture
def program(beside_graph: Beside) -> Program:
    """Runs ``sros generate_policy`` in ``tmp_path`` beside the graph that it is given."""
    return partial(beside_graph, "generate_policy")


TALKER = ("/talker", "/", "talker", "01", ["publish rt/chatter"])
TWINS = (
    ("/one", "/", "twin", "01", ["publish rt/x"]),
    ("/two", "/", "twin", "02", ["publish rt/y"]),
)
TRANSPORTS = "FASTDDS_BUILTIN_TRANSPORTS"
ANNOUNCING = Path(observe.__file__).with_name("fast_dds_observer.xml")
GIVEN_PROFILES = tuple(zip(PROFILE_VARIABLES, ("my.xml", f"${PROFILE_VARIABLES[0]}"), strict=True))
SHORT = ("robot.xml", "--spin-time", "0.6")


def test_what_is_seen_is_written_and_nothing_else_on_stdout(program: Program) -> None:
    ended = program(graph(TALKER), *SHORT)
    assert ended == Ended(0, "wrote 'robot.xml': 1 enclave, 1 node, 1 right\n", "")


def test_json_has_a_stable_shape(program: Program) -> None:
    ended = program(graph(TALKER), *SHORT, "--json").ok()
    assert json.loads(ended.out) == {
        "version": 1,
        "file": "robot.xml",
        "source": "graph",
        "created": True,
        "changed": True,
        "dry_run": False,
        "nodes": [
            {
                "enclaves": ["/talker"],
                "namespace": "/",
                "name": "talker",
                "participant": "01" + "00" * 11,
                "publish": ["rt/chatter"],
                "subscribe": [],
            }
        ],
        "ended": [],
        "intermittent": [],
        "settled": True,
        "added": [
            {
                "enclave": "/talker",
                "qualifier": "ALLOW",
                "kind": "topics",
                "right": "publish",
                "name": "/chatter",
            }
        ],
        "copied": [],
        "changes": [{"action": "create", "path": "robot.xml"}],
        "notes": [],
    }


def test_what_was_seen_only_for_a_while_or_without_endpoints_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also under the name of a tool; twin: a tool that only reads."""
    talker, tool = node("/talker", "publish x"), node("/_ros2cli_7", "publish x", participant="p2")
    everything = known_graph(talker, tool, node("/_ros2cli_8", "subscribe x", participant="p3"))
    left = make_observation([], silent=[("/", "/", "_ros2cli_9")])
    snapshot = Snapshot(left, everything, 9.0, True)
    monkeypatch.setattr(observing, "observe", lambda *_, **__: (snapshot, "rmw_fake"))
    ended = sros("generate_policy", "robot.xml", "--json", cwd=tmp_path)
    notes = {note["id"]: note["text"] for note in json.loads(ended.out)["notes"]}
    assert {of: text.rpartition(": ")[2] for of, text in notes.items()} == {
        "graph.ended": "/_ros2cli_7, /talker",
        "graph.silent": "/_ros2cli_9",
    }
    assert [*_seen_by_listener({"nodes": [], "notes": json.loads(ended.out)["notes"]})] == [
        "nodes that ended while it listened: /_ros2cli_7, /talker",
        "nodes without endpoints: /_ros2cli_9",
    ]


def test_json_names_what_a_watch_saw_for_a_part_of_its_time(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    lost = IntermittentEndpoint("/talker", "p1", "rt/chatter", "publish")
    seen = known_graph(node("/talker", "publish chatter"))
    snapshot = Snapshot(seen, seen, 19.0, True, frozenset({lost}), grew=True)
    monkeypatch.setattr(observing, "observe", lambda *_, **__: (snapshot, "rmw_fake"))
    ended = sros("generate_policy", "robot.xml", "--watch", "9s", "--json", cwd=tmp_path)
    Seen().check("generate_policy", ended.ok())
    assert intermittent_from_json(json.loads(ended.out)) == [lost]
    assert json.loads(ended.out)["settled"] is False
    assert ended.err == (
        "new nodes or endpoints still appeared in the last 3.5 s of the watch, which took 19 s, so "
        "more may be missing; watch again for longer.\n"
    )


def test_twins_are_told_apart_where_the_middleware_keeps_an_order(
    program: Program, tmp_path: Path
) -> None:
    ended = program(graph(*TWINS, rmw="rmw_cyclonedds_cpp"), *SHORT).ok()
    assert ended.err == ""
    assert (tmp_path / "robot.xml").read_text().count("<topic>") == 2


def test_twins_get_the_union_and_a_note_where_it_does_not(program: Program, tmp_path: Path) -> None:
    ended = program(graph(*TWINS), *SHORT).ok()
    assert ended.err.startswith("note [graph.ambiguous]: ")
    assert "/twin in /one or /two" in ended.err
    assert (tmp_path / "robot.xml").read_text().count("<topic>") == 4


UNSHOWN = (
    ("/", "/", "talker", "01", ["publish rt/chatter"]),
    ("/", "/hall", "listener", "02", ["subscribe rt/chatter"]),
)


@pytest.mark.parametrize(
    ("words", "summary", "enclaves"),
    [
        ((), "1 enclave, 2 nodes", ['path="/"']),
        (("--enclave-per-node",), "2 enclaves, 2 nodes", ['path="/hall/listener"', 'path="/tal']),
    ],
)
def test_an_enclave_for_each_node_of_an_unsecured_robot(
    program: Program, tmp_path: Path, words: tuple[str, ...], summary: str, enclaves: list[str]
) -> None:
    ended = program(graph(*UNSHOWN), *SHORT, *words).ok()
    assert summary in ended.out
    assert ("[graph.root-enclave]" in ended.err) == (not words)
    text = (tmp_path / "robot.xml").read_text()
    assert text.count("<enclave ") == len(enclaves)
    assert all(each in text for each in enclaves)


def test_a_watch_names_the_enclaves_that_it_gives(program: Program) -> None:
    words = ("robot.xml", "--watch", "1s", "--enclave-per-node")
    ended = program(graph(*UNSHOWN), *words).ok()
    assert "seen: /hall/listener (/hall/listener) subscribe /chatter" in ended.err


def test_a_log_names_enclaves_itself(program: Program, tmp_path: Path) -> None:
    (tmp_path / "x.log").write_text("")
    ended = program(graph(), "robot.xml", "--enclave-per-node", "--from-log", "x.log")
    assert ended.status == 2
    assert "--enclave-per-node is not for --from-log" in ended.err


@pytest.mark.parametrize(
    ("environment", "why"),
    [
        ({}, "Nodes may be in another domain (ROS_DOMAIN_ID, --domain)"),
        ({"ROS_SECURITY_KEYSTORE": "/ks"}, "ROS_SECURITY_KEYSTORE is set, so the robot may be"),
        ({"ROS_SECURITY_ENABLE": "true"}, "does not see open nodes, because ROS_SECURITY_ENABLE"),
        ({"ROS_DOMAIN_ID": "7"}, "Observed domain 7 for 1 s with rmw_fake."),
    ],
)
def test_an_empty_graph_is_explained(
    program: Program, tmp_path: Path, environment: dict[str, str], why: str
) -> None:
    ended = program(graph(), *SHORT, **environment)
    assert (ended.status, ended.out) == (1, "")
    assert ended.err.splitlines()[0] == NO_NODES
    assert why in ended.err
    assert list(tmp_path.iterdir()) == []


def test_tools_alone_are_an_empty_graph(program: Program) -> None:
    ended = program(graph(("/", "/", "_ros2cli_12", "01", ["publish rt/x"])), *SHORT)
    assert ended.status == 1
    assert ended.err.splitlines()[0] == NO_NODES
    assert "note [graph.tool-writes]" in ended.err and "/_ros2cli_12 (publish /x)" in ended.err


@pytest.mark.parametrize(
    ("stage", "says", "what"),
    [
        ("import", "", "rclpy cannot be imported. RuntimeError: invalid allocator"),
        ("init", "", "rclpy cannot start. RuntimeError"),
        ("node", "", "rclpy cannot start a node to observe the graph. RuntimeError"),
        ("crash", "boom", "the process that observes the ROS graph failed. It exited with status"),
        (
            "node",
            "\x1b[31mrt/parameter_events topic not found in allow rule.\x1b[m",
            "the enclave / does not permit an observer. DDS says: rt/parameter_events topic not",
        ),
        ("node", "PKCS7 data verification failed", "DDS refuses the enclave /. DDS says: PKCS7"),
        ("node", "Please compile Fast DDS using the -DSECURITY=ON", "was built without DDS Sec"),
    ],
)
def test_a_failure_is_one_paragraph(
    program: Program, tmp_path: Path, stage: str, says: str, what: str
) -> None:
    ended = program({"fails": stage, "says": says}, *SHORT)
    assert (ended.status, ended.out) == (2, "")
    assert ended.err.count("\n") == 1
    assert ended.err.startswith("Unable to generate policy: ")
    assert what in ended.err
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("shown", "chosen", "used"),
    [
        (TRANSPORTS, {}, "UDPv4"),
        (TRANSPORTS, {TRANSPORTS: "SHM"}, "SHM"),
        *((name, {}, str(ANNOUNCING)) for name in PROFILE_VARIABLES),
        *((PROFILE_VARIABLES[0], {name: "my.xml"}, given) for name, given in GIVEN_PROFILES),
    ],
)
def test_the_variables_of_an_observer_on_fast_dds(
    program: Program, shown: str, chosen: dict[str, str], used: str
) -> None:
    """It cannot write to other users' memory, and must announce itself to nodes that soon end.

    A profile of the user, such as one that names a discovery server, stays.
    """
    assert f"with {used}." in program(graph(rmw=f"${shown}"), *SHORT, **chosen).err


def test_an_observer_announces_itself_to_nodes_that_soon_end() -> None:
    (participant,) = etree.parse(ANNOUNCING).getroot()
    assert participant.get("is_default_profile") == "true"
    (period,) = participant.iterfind(".//{*}leaseAnnouncement")
    assert [part.text for part in period] == ["0", "100000000"]


def test_a_watch_tells_what_is_new(program: Program) -> None:
    ended = program(graph(TALKER), "robot.xml", "--watch", "1s").ok()
    assert ended.err.splitlines()[:3] == [
        "watching for 1 s, or until Ctrl-C; then the policy is written",
        "seen: /talker (/talker)",
        "seen: /talker (/talker) publish /chatter",
    ]


def test_the_words_of_a_watch(program: Program, tmp_path: Path) -> None:
    """A duration belongs to --watch, and a file that follows it does not."""
    program(graph(TALKER), "--watch", "1s", "robot.xml").ok()
    assert (tmp_path / "robot.xml").exists()
    ended = program(graph(TALKER), "robot.xml", "--watch", "1s", "--spin-time", "2")
    assert ended.status == 2
