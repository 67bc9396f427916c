"""The process and the enclave of a node, from two lists that do not mention each other."""

from __future__ import annotations

import pytest

from sros_tool.graph.observation import Endpoint, make_observation
from sros_tool.graph.observe import NOBODY, Listed, Sighting, resolve, with_owners_of_strays
from tests.graph.graphs import graph, node

X = Endpoint("rt/x", "publish")


def at(participant: str, *names: str) -> list[tuple[str, str, str, Endpoint]]:
    return [(participant, "/", name, X) for name in names]


def enclaves(
    listed: list[str], endpoints: list[tuple[str, str, str, Endpoint]], *, ordered: bool = False
) -> dict[str, tuple[str, ...]]:
    announced: list[Listed] = [(e, "/", n) for e, n in (each.split() for each in listed)]
    seen = resolve(Sighting(tuple(announced), tuple(endpoints), ordered))
    return {node.participant: node.enclaves for node in seen.nodes}


def test_different_names_need_no_more() -> None:
    found = enclaves(["/one a", "/two b"], at("p1", "a") + at("p2", "b"))
    assert found == {"p1": ("/one",), "p2": ("/two",)}


def test_the_other_nodes_of_a_process_tell() -> None:
    found = enclaves(["/one a", "/two a", "/two b"], at("p1", "a") + at("p2", "a", "b"))
    assert found == {"p2": ("/two",), "p1": ("/one",)}


def test_what_is_told_of_one_process_is_gone_for_the_next() -> None:
    listed = ["/one a", "/two a", "/two b", "/three b", "/three c"]
    found = enclaves(listed, at("p1", "a") + at("p2", "a", "b") + at("p3", "b", "c"))
    assert found == {"p1": ("/one",), "p2": ("/two",), "p3": ("/three",)}


def test_two_processes_of_one_enclave() -> None:
    assert enclaves(["/one a", "/one a"], at("p1", "a") + at("p2", "a")) == {
        "p1": ("/one",),
        "p2": ("/one",),
    }


def test_without_an_order_it_stays_open() -> None:
    found = enclaves(["/one a", "/two a"], at("p1", "a") + at("p2", "a"))
    assert found == {"p1": ("/one", "/two"), "p2": ("/one", "/two")}


def test_the_order_of_the_middleware_tells() -> None:
    found = enclaves(["/two a", "/one a"], at("p1", "a") + at("p2", "a"), ordered=True)
    assert found == {"p1": ("/two",), "p2": ("/one",)}


@pytest.mark.parametrize(
    "listed",
    [
        ["/one a", "/two a", "/three a"],  # one of them has no endpoint
        ["/one a", "/two a", "/two b", "/one b"],  # nodes of one process in two enclaves
    ],
)
def test_an_order_that_cannot_be_is_not_trusted(listed: list[str]) -> None:
    endpoints = at("p1", "a", "b") + at("p2", "a", "b") if len(listed) == 4 else None
    found = enclaves(listed, endpoints or at("p1", "a") + at("p2", "a"), ordered=True)
    assert all(len(each) > 1 for each in found.values())


def test_endpoints_of_nobody_and_nodes_without_endpoints() -> None:
    listed: tuple[Listed, ...] = (("/one", "/", "a"), ("/one", "/", "quiet"))
    endpoints = (*at("p1", "a"), ("p1", "", NOBODY, X), ("p9", "/", "unannounced", X))
    seen = resolve(Sighting(listed, tuple(endpoints)))
    assert seen.silent == {("/one", "/", "quiet")}
    assert seen.strays == {("p1", X), ("p9", X)}
    assert [node.name for node in seen.nodes] == ["a"]


def test_strays_belong_to_the_only_node_of_their_process() -> None:
    tool = node("/n/tool", "call dock", like="python", enclave="/tool", participant="p2")
    seen = make_observation(
        [node("/a", "publish x"), node("/n/tool", "publish y", enclave="/tool", participant="p3")],
        strays=[
            ("p1", Endpoint("rt/later", "publish")),
            *(("p2", endpoint) for endpoint in tool.endpoints),
        ],
    )
    found = with_owners_of_strays(seen)
    assert found.strays == frozenset()
    assert found.nodes[0].endpoints == node("/a", "publish x", "publish later").endpoints
    assert found.nodes[1] == tool


def test_strays_of_a_process_without_a_name_or_with_two_stay() -> None:
    other = node("/b", like="python").endpoints
    asked = Endpoint("rq/a/get_parametersRequest", "publish")  # the service of another process
    strays = [("p9", X), ("p9", asked), *(("p1", endpoint) for endpoint in other)]
    seen = make_observation(graph(node("/a", "publish x")).nodes, strays=strays)
    assert with_owners_of_strays(seen) == seen
