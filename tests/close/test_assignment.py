"""Which running process has the nodes of which enclave."""

from __future__ import annotations

from datetime import UTC, datetime
from typing import Any

import pytest

from sros_tool.close.assignment import assign
from sros_tool.graph.observation import Endpoint, ObservedNode
from sros_tool.runtime.processes import Process


def process(pid: int, *command: str, **more: Any) -> Process:
    return Process(pid, command, {}, datetime.now(UTC), frozenset({"libfastrtps"}), **more)


def node(name: str, participant: str = "01", ns: str = "/") -> ObservedNode:
    enclave = f"{ns.rstrip('/')}/{name}"
    writes = frozenset({Endpoint("rt/x", "publish")})
    return ObservedNode((enclave,), ns, name, participant, writes)


@pytest.mark.parametrize(
    ("nodes", "processes", "known"),
    [
        (
            [node("a", "010f7f01a530")],
            [process(0x130A5, "x"), process(2, "a")],
            {"/a": "process id"},
        ),
        (  # in a container, and beside a process that has this id on the host
            [node("a", "010f7f010700")],
            [process(0x130A5, "x", own_pid=7), process(2, "y")],
            {"/a": "process id"},
        ),
        (
            [node("a", "010f7f010700")],
            [process(0x130A5, "x", own_pid=7), process(7, "y", own_pid=7)],
            {},
        ),
        ([node("a", "01107f01a530")], [process(0x130A5, "x"), process(2, "y")], {}),
        (
            [node("a", "1", "/n"), node("b", "2")],
            [process(1, "x", "--ros-args", "-r", "__node:=a", "-r", "__ns:=/n"), process(2, "y")],
            {"/n/a": "node name", "/b": "elimination"},
        ),
        (
            [node("a", "1"), node("b", "2")],
            [process(1, "python3", "/opt/a.py"), process(2, "/opt/b")],
            {"/a": "program", "/b": "program"},
        ),
        ([node("a", "1")], [process(1, "/opt/a"), process(2, "/usr/a")], {}),
        (
            [node("a", "1"), node("a", "2")],
            [process(1, "/opt/a"), process(2, "/usr/a")],
            {"/a": "program"},
        ),
        ([node("a")], [process(1, "x", network="net:[1]")], {}),
        ([node("a")], [process(1, "x")], {"/a": "elimination"}),
    ],
)
def test_the_enclave_of_a_process(
    nodes: list[ObservedNode], processes: list[Process], known: dict[str, str]
) -> None:
    observed = assign(nodes, processes, 0)
    assert {closed.enclave: closed.known_by for closed in observed.processes} == known
    assert set(observed.elsewhere) == {seen.enclaves[0] for seen in nodes} - known.keys()


def test_a_process_of_cyclone_dds_is_known_by_what_it_says() -> None:
    """Not by the two bytes in which Fast DDS has the id."""
    nodes = [node("a", "01107f01a530"), node("b", "0110")]
    processes = [process(0x130A5, "x"), process(2, "y")]
    observed = assign(nodes, processes, 0, {"0110": 0x130A5, "01107f01a530": 2})
    known = {closed.enclave: (closed.pid, closed.known_by) for closed in observed.processes}
    assert known == {"/a": (2, "process id"), "/b": (0x130A5, "process id")}


def test_nodes_of_the_same_name_elsewhere_are_reported() -> None:
    own, same = node("a", "010f7f01a53057bc00"), node("a", "010f7f01a53057bc01")
    talker = process(0x30A5, "/opt/a")
    assert assign([own, same], [talker], 0).elsewhere == []
    for other in (node("a", "010f7f02a530"), node("a", "010f7f01ffff"), node("a", "0110aa")):
        observed = assign([own, other], [talker], 0)
        assert [closed.pid for closed in observed.processes] == [talker.pid]
        assert observed.elsewhere == ["/a"]
