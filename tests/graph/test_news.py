"""A watch tells every new thing once, and nothing that every node has."""

from __future__ import annotations

from pathlib import Path

from sros_tool.files import policies_dir
from sros_tool.graph.learn import ReportedRights, common_parts
from tests.graph.graphs import graph, node


def test_each_new_thing_is_one_line(tmp_path: Path) -> None:
    news = ReportedRights(common_parts(tmp_path, policies_dir()))
    first = graph(node("/talker", "publish chatter", like="python"))
    second = graph(node("/talker", "publish chatter", "call /fib", like="c++"))
    assert news.lines(first) == [
        "seen: /talker (/robot)",
        "seen: /talker (/robot) publish /chatter",
    ]
    assert news.lines(first) == []
    assert news.lines(second) == ["seen: /talker (/robot) call /fib"]
