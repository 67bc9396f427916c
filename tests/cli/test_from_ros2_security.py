"""The page for users of ros2/sros2: what each of its commands ends with, and what it does.

The statuses of ros2/sros2 there are those of sros2 0.13.0 on ros2cli 0.32.2, rclpy 7.1 and
cryptography 41.0.7, by the same commands in the same order.
"""

from __future__ import annotations

import re
import shutil
from pathlib import Path

import pytest

from tests.support.harness import policy_text, publish, snapshot, sros, topics_of
from tests.support.pages import PROJECT

_ROW = re.compile(r"\| (?:`([^`]*)`|no verb) \| ([012]) \| ([012]) \| (.*)\|")
ROWS = _ROW.findall((PROJECT / "docs/ros2_security.md").read_text("utf-8"))


def test_each_command_of_the_page(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    policy = policy_text({"/talker": publish("/chatter"), "/listener": publish("/x")})
    Path("policy.xml").write_text(policy)
    assert len(ROWS) > 30
    for command, in_ros2, status, difference in ROWS:
        before = snapshot(tmp_path)
        if command.startswith("rm -r "):
            shutil.rmtree(command.removeprefix("rm -r "))
            continue
        ended = sros(*command.split())
        assert ended.status == int(status), (command, ended)
        assert difference or status == ("2" if in_ros2 != "0" else "0"), f"{command}: and why?"
        if ended.status:
            assert snapshot(tmp_path) == before, command
        elif command.startswith("list_"):
            assert ended.out.startswith("/") and not ended.err, command
        if command == "create_enclave ks /":
            assert "/\n" in sros("list_enclaves", "ks").ok().out
    made = sros("list_enclaves", "ks").ok().out.split()
    assert made == ["/", "/a", "/b", "/c", "/camera", "/d", "/listener", "/talker"]
    assert "rt/chatter" in topics_of(Path("ks/enclaves/talker"))
