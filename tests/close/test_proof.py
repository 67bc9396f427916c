"""What proves that a robot is closed: nodes that are not seen, and names that moved."""

from __future__ import annotations

from dataclasses import replace
from datetime import UTC, datetime
from types import SimpleNamespace
from typing import Any

from sros_tool.close.proof import _abandoned_names, _unseen_text
from sros_tool.explain.audit import DeniedRight
from sros_tool.graph.observation import Endpoint, make_observation
from sros_tool.policy.model import ALLOW
from sros_tool.policy.rights import Right
from sros_tool.runtime.processes import Process, ProcessEnclave
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
    assert _abandoned_names(seen, seen, moved, ()) == [alone]
    assert not _abandoned_names(seen, make_observation([planner, base, joystick]), moved, ())
    right = Right("/base", ALLOW, "subscribe", "/cmd_vel")
    denied = DeniedRight(right, ("/base",), "no rule", False, False, (heard,))
    assert not _abandoned_names(seen, seen, moved, [denied])


def test_a_node_that_others_do_not_see_on_zenoh_needs_its_enclave_in_its_command() -> None:
    variables = {"RMW_IMPLEMENTATION": "rmw_zenoh_cpp"}
    process = Process(1, ("python3", "talk"), variables, datetime.now(UTC))
    now: Any = SimpleNamespace(secured=[(process, ProcessEnclave("/export", "/talker"))])
    unseen = _unseen_text(now, "/talker", "/talker")
    assert "start process 1 (talk) with `--ros-args --enclave /talker` at its end" in unseen
