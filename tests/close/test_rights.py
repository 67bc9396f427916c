"""Who may do what by the policy of a closed robot, as `sros close` shows it."""

from __future__ import annotations

from pathlib import Path

from sros_tool.close.rights import access_lines
from sros_tool.policy.document import read_policy
from tests.support.harness import policy_text, publish, subscribe


def test_wildcards_and_denials_count_in_what_is_shown(tmp_path: Path) -> None:
    text = policy_text({
        "/a": publish("/odom"),
        "/b": subscribe("/odom"),
        "/look": subscribe("/*"),
        "/not": subscribe("/*") + subscribe("/odom").replace("ALLOW", "DENY"),
    })  # fmt: skip
    (tmp_path / "p.xml").write_text(text)
    lines = access_lines(read_policy(tmp_path / "p.xml"), tmp_path)
    assert lines == ["topic /odom: /a -> /b, /look", "topic /*: nobody -> /look, /not"]
