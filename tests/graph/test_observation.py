"""Looks at a graph add up, and processes stay apart."""

from __future__ import annotations

import io
import itertools
import json
import select
from types import SimpleNamespace
from typing import Any

import pytest

from sros_tool.graph.observation import (
    Endpoint,
    Observation,
    Reading,
    _Observer,
    make_observation,
    observation_from_json,
    report_graph,
)
from sros_tool.values import as_plain
from tests.graph.graphs import graph, node


def test_the_union_keeps_nodes_and_endpoints_that_were_gone() -> None:
    before = graph(node("/a", "publish x"), node("/b", "publish y", participant="p2"))
    after = graph(node("/a", "subscribe z"))
    (a, b) = before.union(after).nodes
    assert a.endpoints == {Endpoint("rt/x", "publish"), Endpoint("rt/z", "subscribe")}
    assert b.name == "b"


def test_the_union_does_not_depend_on_the_order() -> None:
    looks = [
        graph(node("/a", "publish x")),
        graph(node("/a", "call fib"), node("/n/b", "reply s")),
        graph(node("/a", "publish x", participant="p2", enclave="/other")),
    ]
    forward, backward = Observation(), Observation()
    for each in looks:
        forward = forward.union(each)
    for each in reversed(looks):
        backward = backward.union(each)
    assert forward == backward
    assert forward.union(forward) == forward


def test_nodes_of_one_name_in_two_processes_stay_two() -> None:
    both = graph(node("/a", "publish x")).union(graph(node("/a", "publish y", participant="p2")))
    assert [each.endpoints for each in both.nodes] == [
        {Endpoint("rt/x", "publish")},
        {Endpoint("rt/y", "publish")},
    ]


def test_a_second_look_can_tell_the_enclave() -> None:
    unclear = graph(node("/a", "publish x", enclave=("/one", "/two")))
    clear = graph(node("/a", "publish x", enclave="/two"))
    assert [each.enclaves for each in unclear.union(clear).nodes] == [("/two",)]
    assert [each.enclaves for each in clear.union(unclear).nodes] == [("/two",)]


def test_an_endpoint_that_found_its_node_is_no_stray() -> None:
    stray = make_observation((), strays=[("p1", Endpoint("rt/x", "publish"))])
    both = stray.union(graph(node("/a", "publish x")))
    assert both.strays == frozenset()
    assert stray.union(graph(node("/b", "publish x", participant="p2"))).strays


def test_a_node_that_spoke_later_is_not_silent() -> None:
    silent = make_observation((), silent=[("/robot", "/", "a")])
    assert silent.union(graph(node("/a", "publish x"))).silent == frozenset()
    assert silent.union(graph(node("/b", "publish x"))).silent


def test_json_gives_the_same_back() -> None:
    seen = graph(node("/a", "publish x", "call fib"), node("/n/b", "reply s", participant="p2"))
    assert observation_from_json(as_plain(seen)) == seen


def test_a_graph_that_changed_is_read_again_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """A tool that lives shorter than a period would otherwise be seen only while it starts."""
    full = Reading(["tool"], ["rosout", "chatter"])
    looks = [Reading([], ["rosout"]), full, full]
    waits: list[float] = []

    class Script:
        def snapshot(self) -> Reading:
            return looks.pop(0)

    def selected(*words: Any) -> tuple[bool]:
        waits.append(words[-1])
        return (not looks,)

    monkeypatch.setattr(select, "select", selected)
    report = io.StringIO()
    report_graph(Script(), report, 60.0, ordered=True)
    told = [json.loads(line) for line in report.getvalue().splitlines()]
    assert ["listed" in each for each in told] == [True, True, False]
    began = [each["began"] for each in told]
    assert began == sorted(began)
    assert [wait < 0.05 for wait in waits] == [True, True, False]


def test_nobody_hides_behind_nodes_that_come_and_go(monkeypatch: pytest.MonkeyPatch) -> None:
    """A stranger that announces other nodes during every reading hides no node from the report."""
    monkeypatch.setattr(select, "select", lambda *_: ([True],))
    names = itertools.count()

    class Graph:
        def get_node_names_and_namespaces_with_enclaves(self) -> list[tuple[str, str, str]]:
            return [("evil", "/", "/"), (f"n{next(names)}", "/", "/")]

        def get_topic_names_and_types(self, *, no_demangle: bool) -> list[tuple[str, list[str]]]:
            return [("rt/cmd_vel", [])]

        def get_publishers_info_by_topic(self, topic: str, *, no_mangle: bool) -> list[Any]:
            return [SimpleNamespace(endpoint_gid=[1] * 16, node_namespace="/", node_name="evil")]

        def get_subscriptions_info_by_topic(self, topic: str, *, no_mangle: bool) -> list[Any]:
            return []

    report = io.StringIO()
    report_graph(_Observer(Graph()), report, 60.0, ordered=True)
    told = json.loads(report.getvalue())
    assert told["endpoints"] == [["01" * 12, "/", "evil", "rt/cmd_vel", "publish"]]
    assert told["listed"].count(["/", "/", "evil"]) == 1
    assert not told["ordered"]
