"""What `sros close` finds while it prepares a robot."""

from __future__ import annotations

import pytest

from sros_tool.close.preparation import denied_remappings
from sros_tool.close.processes import ClosedProcess
from sros_tool.explain.audit import DeniedRight
from sros_tool.policy.model import ALLOW
from sros_tool.policy.rights import Right


@pytest.mark.parametrize(
    ("rules", "blamed"),
    [
        ("words:=chatter", "words:=chatter"),
        ("words:=other", ""),
        ("/a:=/left/chatter b:=/chatter", "/a:=/left/chatter"),
        ("hearer:words:=chatter", "hearer:words:=chatter"),
        ("rostopic://words:=chatter hearer:rostopic://x:=y", "words:=chatter"),
        ("talker:words:=chatter", ""),  # the process has a node for which this name is allowed
        ("__node:=chatter", ""),
        ("hearer:__ns:=/left/chatter", ""),
    ],
)
def test_the_remapping_rule_that_gives_a_denied_name(rules: str, blamed: str) -> None:
    words = (word for rule in rules.split() for word in ("-r", rule))
    command = ("/opt/run", "--ros-args", *words)
    process = ClosedProcess("/e", 7, command, "/opt", 0, "", "program")
    right = Right("/e", ALLOW, "subscribe", "/left/chatter")
    denied = DeniedRight(right, ("/left/hearer",), "", False, False, ())
    found = denied_remappings([denied], [process])
    assert found == ({"/e": [blamed]} if blamed else {})
