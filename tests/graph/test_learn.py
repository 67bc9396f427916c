"""An observation becomes the least policy that allows it."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from sros_tool.files import policies_dir
from sros_tool.graph.learn import PARTS, CommonParts, Learned, common_parts, learn
from sros_tool.graph.observation import Endpoint, ObservedNode, make_observation
from sros_tool.policy.model import ALLOW, Group
from tests.graph.graphs import common, endpoints, graph, node


@pytest.fixture
def parts(tmp_path: Path) -> CommonParts:
    return common_parts(tmp_path, policies_dir())


def ids(learned: Learned) -> list[str]:
    return [note.id for note in learned.notes]


def text(learned: Learned, name: str) -> str:
    return next(note.text for note in learned.notes if note.id == f"graph.{name}")


# ── common parts ───────────────────────────────────────────────────────────────────────────


@pytest.mark.parametrize(
    ("rights", "includes"),
    [
        (common("python"), ("common/rclpy_node.xml",)),
        (common("c++"), ("common/rclcpp_node.xml",)),
        ([*common("c++"), "subscribe /clock"], ("common/node.xml",)),
        (
            [*common("python"), "subscribe /clock"],
            ("common/rclpy_node.xml", "common/node/time.xml"),
        ),
        (
            ["publish /rosout", "reply ~/get_type_description"],
            ("common/node/logging.xml", "common/node/types.xml"),
        ),
        (["publish chatter"], ()),
    ],
)
def test_parts_are_included_where_the_node_has_all_of_them(
    parts: CommonParts, rights: list[str], includes: tuple[str, ...]
) -> None:
    (profile,) = learn(graph(node("/hall/n", *rights)), parts).profiles
    assert profile.includes == includes


def test_a_container_and_a_managed_node(parts: CommonParts) -> None:
    every = [*common("c++"), "subscribe /clock"]
    container = [f"reply ~/_container/{each}_node" for each in ("load", "unload")]
    managed = [f"reply ~/{each}" for each in (
        "change_state", "get_available_states", "get_available_transitions", "get_state",
        "get_transition_graph",
    )]  # fmt: skip
    seen = graph(
        node("/c", *every, *container, "reply ~/_container/list_nodes"),
        node("/m", *every, *managed, "publish ~/transition_event"),
    )
    first, second = learn(seen, parts).profiles
    assert (first.includes, first.groups) == (("common/component_container.xml",), ())
    assert (second.includes, second.groups) == (("common/lifecycle_node.xml",), ())


def test_includes_and_groups_say_together_what_was_seen(parts: CommonParts) -> None:
    seen = graph(node("/hall/n", "publish x", "call fib", "subscribe /clock", like="c++"))
    (profile,) = learn(seen, parts).profiles
    given = {
        (each.right, each.name.replace("~", "/hall/n"))
        for part in profile.includes
        for each in parts.rights[part]
    }
    assert profile.groups == (
        Group("topics", (("publish", ALLOW),), ("x",)),
        Group("actions", (("call", ALLOW),), ("fib",)),
    )
    rest = {("publish", "/hall/x"), ("call", "/hall/fib")}
    assert {(each.right, each.name) for each in profile.rights} == given | rest


def test_every_part_can_be_read(parts: CommonParts) -> None:
    assert set(parts.rights) == set(PARTS)
    assert "common/node/types.xml" in parts.files_to_copy(["common/node.xml"])


def test_parts_that_are_there_are_not_copied(tmp_path: Path) -> None:
    shutil.copytree(policies_dir() / "common", tmp_path / "common")
    assert common_parts(tmp_path, policies_dir()).files_to_copy(PARTS) == {}


def test_a_part_that_its_owner_has_changed_counts_as_it_is(tmp_path: Path) -> None:
    (tmp_path / "common").mkdir()
    (tmp_path / "common" / "node.xml").write_text(
        '<profile><topics publish="ALLOW"><topic>everything/*</topic></topics></profile>'
    )
    parts = common_parts(tmp_path, policies_dir())
    (profile,) = learn(graph(node("/n", "subscribe /clock", like="c++")), parts).profiles
    assert "common/node.xml" not in profile.includes


def test_ours_is_not_mixed_with_a_changed_one(tmp_path: Path) -> None:
    (tmp_path / "common" / "node").mkdir(parents=True)
    (tmp_path / "common" / "node" / "logging.xml").write_text(
        '<profile><topics publish="ALLOW"><topic>/*</topic></topics></profile>'
    )
    parts = common_parts(tmp_path, policies_dir())
    assert "common/rclpy_node.xml" not in parts.rights
    (profile,) = learn(graph(node("/n", like="python")), parts).profiles
    assert profile.includes == ("common/node/types.xml",)


# ── nodes and enclaves ─────────────────────────────────────────────────────────────────────


def test_profiles_are_sorted_and_nodes_of_one_name_kept_apart() -> None:
    seen = graph(
        node("/b", "publish x", enclave="/two", participant="p2"),
        node("/b", "publish y", enclave="/one"),
        node("/a", "publish z", enclave="/two", participant="p2"),
    )
    places = [(each.enclave, each.ns, each.node) for each in learn(seen).profiles]
    assert places == [("/one", "/", "b"), ("/two", "/", "a"), ("/two", "/", "b")]


def test_a_node_whose_enclave_is_open_gets_its_rights_in_each_and_a_note() -> None:
    seen = graph(node("/a", "publish x", enclave=("/one", "/two")))
    learned = learn(seen)
    assert [each.enclave for each in learned.profiles] == ["/one", "/two"]
    assert "/a in /one or /two" in text(learned, "ambiguous")


def test_tools_are_left_out_and_said() -> None:
    daemon = node("/_ros2cli_daemon_0_a", "publish /rosout", "subscribe x")
    learned = learn(graph(daemon, node("/_ros2cli_1", "publish x", participant="p2")))
    assert learned.profiles == ()
    assert "/_ros2cli_daemon_0_a" in text(learned, "tool")
    assert "/_ros2cli_1 (publish /x)" in text(learned, "tool-writes")


def test_a_node_of_the_robot_with_the_name_of_a_tool_gets_its_rights() -> None:
    learned = learn(graph(node("/driver"), node("/_ros2cli_1", "publish /cmd_evil")))
    assert [(each.node, *each.rights) for each in learned.profiles] == [
        ("_ros2cli_1", ("publish", "/cmd_evil"))
    ]


def test_a_node_that_changes_its_name_has_one_profile() -> None:
    first = node("/transform_listener_impl_55aa", "subscribe /tf", "reply ~/get_type_description")
    second = node("/transform_listener_impl_66bb", "subscribe /tf_static", participant="p2")
    learned = learn(graph(first, second))
    (profile,) = learned.profiles
    assert profile.node == "transform_listener_impl_*"
    assert ("services", ("~/get_type_description",)) in [(g.kind, g.names) for g in profile.groups]
    assert "graph.changing-name" in ids(learned)


@pytest.mark.parametrize(
    ("enclaves", "said"),
    [
        (("/", "/"), "2 of 2 nodes"),
        (("/", "/x"), "1 of 2 nodes"),
        (("/",), "1 node"),
        (("/x",), ""),
    ],
)
def test_nodes_whose_enclave_the_graph_does_not_show(enclaves: tuple[str, ...], said: str) -> None:
    """Whether they share it is not known: `sros run` sets it in a way that the graph hides."""
    learned = learn(
        graph(*(node(f"/n{i}", "publish x", enclave=e) for i, e in enumerate(enclaves)))
    )
    if not said:
        assert "graph.root-enclave" not in ids(learned)
        return
    note = text(learned, "root-enclave")
    assert f"shows the enclave / for {said}" in note
    assert "ROS_SECURITY_ENCLAVE_OVERRIDE" in note and "--enclave-per-node" in note


def test_silent_nodes_and_strays_are_said() -> None:
    learned = learn(
        make_observation(
            [node("/a", "publish x")],
            silent=[("/robot", "/", "quiet")],
            strays=[("p9", Endpoint("Square", "publish"))],
        )
    )
    assert "/quiet" in text(learned, "silent")
    assert "Square" in text(learned, "stray")


# ── names that nobody should trust ─────────────────────────────────────────────────────────


@pytest.mark.parametrize(
    "topic", ["rt/*", "rt/a/*", "rt/?", "rt/[ab]", "rt/a b", "rt//x", "rt/<x>", f"rt/{'x' * 2000}"]
)
def test_a_topic_named_like_a_wildcard_never_becomes_one(topic: str) -> None:
    endpoint = Endpoint(topic, "publish")
    learned = learn(graph(ObservedNode(("/robot",), "/", "n", "p1", frozenset({endpoint}))))
    assert learned.profiles == ()
    assert "graph.odd-name" in ids(learned)


@pytest.mark.parametrize(
    ("enclave", "ns", "name"),
    [
        ("/robot", "/", "*"),
        ("/robot", "/", 'n"/>'),
        ("/robot", "/", "x" * 256),
        ("/robot", "/", "~"),
        ("/robot", "/" + "x" * 245, "n"),
        ("/robot", "/*", "n"),
        ("/robot", "relative", "n"),
        ("/robot/../x", "/", "n"),
        ("/" + "x" * 64, "/", "n"),
        ("", "/", "n"),
    ],
)
def test_nodes_that_no_policy_can_name_are_left_out(enclave: str, ns: str, name: str) -> None:
    learned = learn(
        graph(ObservedNode((enclave,), ns, name, "p1", endpoints("/", "n", ["publish x"])))
    )
    assert learned.profiles == ()
    assert "graph.odd-node" in ids(learned)


# ── what is worth a remark ─────────────────────────────────────────────────────────────────


@pytest.mark.parametrize(
    ("right", "note"),
    [
        ("publish /add/_service_event", "service-event"),
        ("publish /clock", "sets-clock"),
        ("subscribe /fib/_action/feedback", "partial-action"),
    ],
)
def test_kept_and_remarked_on(right: str, note: str) -> None:
    learned = learn(graph(node("/n", right)))
    assert f"graph.{note}" in ids(learned)
    assert {f"{each.right} {each.name}" for each in learned.profiles[0].rights} == {right}


def test_statistics_are_ordinary_topics() -> None:
    learned = learn(graph(node("/n", "publish /statistics")))
    assert learned.notes == ()
    assert learned.profiles[0].groups[0].names == ("statistics",)


def test_half_a_service_and_a_topic_without_ros_are_left_out_and_said() -> None:
    strange = frozenset({Endpoint("rq/addRequest", "publish"), Endpoint("Square", "publish")})
    learned = learn(graph(ObservedNode(("/robot",), "/", "n", "p1", strange)))
    assert learned.profiles == ()
    assert ids(learned) == ["graph.half-service", "graph.no-ros-name"]


def test_parameters_of_others_stay_requests() -> None:
    learned = learn(graph(node("/n", "request /other/get_parameters")))
    assert learned.profiles[0].groups == (
        Group("services", (("request", ALLOW),), ("/other/get_parameters",)),
    )
