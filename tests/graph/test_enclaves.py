"""Each process whose enclave the graph does not show gets one, with the name of its node."""

from __future__ import annotations

import pytest

from sros_tool.graph.learn import enclave_per_node, learn
from sros_tool.graph.observation import ObservedNode
from tests.graph.graphs import graph, node

FIRST, SECOND, OTHER = (
    f"010f7f013101{process}{participant}000000"
    for process, participant in (("57bc", "00"), ("57bc", "01"), ("e2a1", "00"))
)
LOADS = "reply ~/_container/load_node"


def unshown(fqn: str, *rights: str, participant: str = "p1", enclave: str = "/") -> ObservedNode:
    return node(fqn, *(rights or ("publish x",)), enclave=enclave, participant=participant)


@pytest.mark.parametrize(
    ("nodes", "enclaves"),
    [
        ([unshown("/talker")], {"/talker"}),
        ([unshown("/hall/camera")], {"/hall/camera"}),
        ([unshown("/a"), unshown("/b", participant="p2")], {"/a", "/b"}),
        # One process has one enclave.
        ([unshown("/long_name"), unshown("/short")], {"/short"}),
        # With Fast DDS, its participants show that they are of one process.
        (
            [unshown("/aa", participant=FIRST), unshown("/b", participant=SECOND)],
            {"/b"},
        ),
        ([unshown("/aa", participant=FIRST), unshown("/b", participant=OTHER)], {"/aa", "/b"}),
        ([unshown("/x"), unshown("/the_container", LOADS)], {"/the_container"}),
        ([unshown("/a"), unshown("/a/transform_listener_impl_55aa")], {"/a"}),
        ([unshown("/bt_navigator"), unshown("/transform_listener_impl_55aa")], {"/bt_navigator"}),
        # A part of a name that changes with every start.
        ([unshown("/launch_ros_4711")], {"/launch_ros"}),
        ([unshown("/transform_listener_impl_55aa")], {"/transform_listener_impl"}),
        # What the graph shows, and a tool, stay as they are.
        ([unshown("/a", enclave="/shown")], {"/shown"}),
        ([unshown("/_ros2cli_12"), unshown("/a", participant="p2")], {"/", "/a"}),
    ],
)
def test_names(nodes: list[ObservedNode], enclaves: set[str]) -> None:
    named = enclave_per_node(graph(*nodes)).observation
    assert {each.enclaves for each in named.nodes} == {(each,) for each in enclaves}


@pytest.mark.parametrize(
    ("nodes", "said"),
    [
        ([unshown("/a"), unshown("/b", participant="p2")], []),
        (
            [unshown("/a"), unshown("/bb")],
            ["graph.several-nodes: named after one of the nodes: /a has /a, /bb"],
        ),
        (
            [unshown("/a"), unshown("/a", participant="p2")],
            ["graph.same-node: /a in /a (2 processes)"],
        ),
        # A stranger that takes the name and the enclave of a node gets no right without a word.
        (
            [unshown("/a", enclave="/e"), unshown("/a", enclave="/e", participant="p2")],
            ["graph.same-node: /a in /e (2 processes)"],
        ),
        (
            [unshown("/a"), unshown("/z", participant="p2", enclave="/a")],
            ["graph.shared-enclave: of their nodes: /a (2 processes)"],
        ),
        (
            [unshown("/launch_ros_1"), unshown("/launch_ros_2", participant="p2")],
            ["graph.shared-enclave: of their nodes: /launch_ros (2 processes)"],
        ),
        (
            [unshown("/camera"), unshown("/camera/driver", participant="p2")],
            ["portable.enclave-names: mistakes /camera for /camera/driver"],
        ),
        # Enclaves that were shown may share a process or a name as their owner wants it.
        ([unshown("/a", enclave="/e"), unshown("/bb", enclave="/e")], []),
    ],
)
def test_what_a_name_cannot_tell_apart_is_said(nodes: list[ObservedNode], said: list[str]) -> None:
    named = enclave_per_node(graph(*nodes))
    notes = [
        *named.notes,
        *(n for n in learn(named.observation).notes if n.id == "graph.same-node"),
    ]
    assert [note.id for note in notes] == [each.partition(": ")[0] for each in said]
    for note, each in zip(notes, said, strict=True):
        assert each.partition(": ")[2] in note.text


def test_the_rights_of_each_process_are_learned_into_its_enclave() -> None:
    seen = graph(
        unshown("/talker", "publish chatter"),
        unshown("/hall/listener", "subscribe /chatter", participant="p2"),
    )
    learned = learn(enclave_per_node(seen).observation)
    assert [(each.enclave, each.ns, each.node) for each in learned.profiles] == [
        ("/hall/listener", "/hall", "listener"),
        ("/talker", "/", "talker"),
    ]
    assert learned.notes == ()
    assert [each.enclave for each in learn(seen).profiles] == ["/", "/"]
    assert [note.id for note in learn(seen).notes] == ["graph.root-enclave"]
