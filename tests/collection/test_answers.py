"""What is taken from the answers of robots, and how it is shown."""

from __future__ import annotations

import json
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

import pytest

pytest.importorskip("ansible")

from ansible_collections.sros.fleet.plugins.module_utils.home import harmless
from ansible_collections.sros.fleet.plugins.plugin_utils.answers import read_answer
from tests.support.children import run

if TYPE_CHECKING:
    from ansible_collections.sros.fleet.plugins.action.enclaves import ActionModule


def answered(**answer: object) -> dict[str, Any]:
    from ansible_collections.sros.fleet.plugins.action.enclaves import ActionModule

    return read_answer(json.dumps(answer), "", ActionModule.readers)


def action(*, diff: bool) -> ActionModule:
    from ansible_collections.sros.fleet.plugins.action.enclaves import ActionModule

    made = ActionModule.__new__(ActionModule)
    made._task = SimpleNamespace(diff=diff)
    return made


def test_what_is_shown_of_many_problems_is_short() -> None:
    problems = ["/r1/a: broken"] * 5000
    found = answered(verification={"ok": False, "problems": problems, "remarks": problems})
    assert found["verification"]["problems"][-2:] == ["/r1/a: broken", "and 4980 more"]
    assert len(found["verification"]["remarks"]) == 21


def test_only_its_own_enclaves_are_to_be_restarted() -> None:
    made = action(diff=False)
    made._sent = frozenset(["/r3/a"])
    found = made.shown(answered(restart=["/r1/a", "/r3/a"], routers=["/r2/a"]))
    assert found == {"restart": ["/r3/a"], "routers": []}


def test_differences_are_compared_before_the_task_ends() -> None:
    """Ansible compares them without a limit of time."""
    differences = [{"before": "a\nb", "after": "a\nc", "before_header": "x", "after_header": "x"}]
    assert "diff" not in action(diff=False).shown(answered(diff=differences))
    (shown,) = action(diff=True).shown(answered(diff=differences * 9000))["diff"]
    assert shown["prepared"].startswith(
        "--- before: x\n+++ after: x\n@@ -1,2 +1,2 @@\n a\n-b\n+c\n"
    )
    assert len(shown["prepared"]) < 300_000


def test_nothing_is_forwarded_to_a_robot() -> None:
    """Ansible puts ``ssh_args``, which are first here, before ``ssh_extra_args``."""
    from ansible_collections.sros.fleet.plugins.plugin_utils.robot_action import RobotAction

    options = {"ssh_extra_args": "-o ForwardAgent=yes"}
    made = RobotAction.__new__(RobotAction)
    made._connection = SimpleNamespace(
        transport="ssh", get_option=options.get, set_option=options.__setitem__
    )
    made._keep_the_agent()
    asked = ["-A", "-X", "-L", "9:r9:9", "-R", "9:r9:9", *options["ssh_extra_args"].split()]
    shown = run(["ssh", "-F", "/dev/null", "-T", "-G", *asked, "r1"]).stdout.splitlines()
    assert {"forwardagent no", "forwardx11 no"} <= {*shown}, shown
    assert not [each for each in shown if each.startswith(("localforward", "remoteforward"))], shown


def test_text_is_visible_and_in_its_order() -> None:
    assert harmless("é\u2800\u3164\u0301\u05d0" + " " * 99 + "x") == "é???? x"
    assert harmless("a\n" + " " * 8 + "b" + " " * 99 + "c", lines=True) == "a\n        b c"
