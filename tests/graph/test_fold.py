"""DDS topics are said as what they are in ROS."""

from __future__ import annotations

import pytest

from sros_tool.graph.learn import NodeRight, rights_of_endpoints
from sros_tool.graph.observation import Endpoint
from tests.graph.graphs import endpoints


@pytest.mark.parametrize(
    "said",
    [
        ["publish /chatter"],
        ["publish /x", "subscribe /x"],
        ["request /add"],
        ["reply /add", "request /add"],
        ["call /fib"],
        ["execute /fib"],
        ["call /fib", "execute /fib"],
        ["call /a", "execute /b", "request /c", "reply /a/d", "publish /a/feedback"],
        ["subscribe /fib/_action/status"],
        ["subscribe /fib/_action/status", "subscribe /fib/_action/feedback"],
        ["publish /s/_service_event", "reply /s"],
        ["publish /statistics"],
        ["request /fib/_action/cancel_goal"],
    ],
    ids=", ".join,
)
def test_folding_undoes_the_translation(said: list[str]) -> None:
    folded = rights_of_endpoints(endpoints("/", "n", said))
    assert {f"{each.right} {each.name}" for each in folded.rights} == set(said)
    assert not folded.halves
    assert not folded.foreign


def test_a_partial_action_stays_its_parts() -> None:
    whole = endpoints("/", "n", ["execute /fib"])
    folded = rights_of_endpoints(whole - {Endpoint("rt/fib/_action/status", "publish")})
    assert folded.rights == {
        NodeRight("publish", "/fib/_action/feedback"),
        NodeRight("reply", "/fib/_action/cancel_goal"),
        NodeRight("reply", "/fib/_action/get_result"),
        NodeRight("reply", "/fib/_action/send_goal"),
    }


def test_halves_and_foreign_topics_are_no_rights() -> None:
    half, foreign = Endpoint("rq/addRequest", "publish"), Endpoint("Square", "subscribe")
    folded = rights_of_endpoints([half, foreign])
    assert folded.rights == frozenset()
    assert folded.halves == {half}
    assert folded.foreign == {foreign}
