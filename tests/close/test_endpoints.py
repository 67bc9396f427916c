"""The endpoints of nodes that were moved, compared with those of the open robot."""

from __future__ import annotations

from dataclasses import replace

from sros_tool.close.endpoints import left_alone
from sros_tool.explain.audit import DeniedRight
from sros_tool.graph.observation import Endpoint, make_observation
from sros_tool.policy.model import ALLOW
from sros_tool.policy.rights import Right
from tests.close.test_assignment import node


def test_a_name_that_moved_leaves_nobody_alone() -> None:
    """Or /base never hears /cmd_vel again, and the proof says that everything talks."""
    old, new = Endpoint("rt/cmd_vel", "publish"), Endpoint("rt/nav/cmd_vel", "publish")
    heard = Endpoint("rt/cmd_vel", "subscribe")
    planner = replace(node("planner", ns="/nav"), endpoints=frozenset({new}))
    base = replace(node("base"), endpoints=frozenset({heard}))
    joystick = replace(node("joystick"), endpoints=frozenset({old}))
    seen, moved = make_observation([planner, base]), {(old, new)}
    alone = "/base subscribe /cmd_vel, which is /nav/cmd_vel now"
    assert left_alone(seen, seen, moved, ()) == [alone]
    assert not left_alone(seen, make_observation([planner, base, joystick]), moved, ())
    right = Right("/base", ALLOW, "subscribe", "/cmd_vel")
    denied = DeniedRight(right, ("/base",), "no rule", False, False, (heard,))
    assert not left_alone(seen, seen, moved, [denied])
