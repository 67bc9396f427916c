"""The report of a watched process."""

from __future__ import annotations

from pathlib import Path

import pytest

from sros_tool.errors import DocumentError
from sros_tool.runtime.events import EventKind, EventReader, EventWriter, ProcessStage, read_events


def test_what_is_written_is_read(tmp_path: Path) -> None:
    path = tmp_path / "report"
    writer = EventWriter(path)
    writer.report(EventKind.HEARD, "Grüße\n: 1", count=1)
    writer.report(EventKind.FAILED, "x", stage=ProcessStage.ENDPOINT)
    writer.report(EventKind.SEEN, publishers={"/a": 2})
    writer.close()
    heard, failed, seen = read_events(path)
    assert (heard.kind, heard.text, heard.count) == (EventKind.HEARD, "Grüße\n: 1", 1)
    assert failed.stage is ProcessStage.ENDPOINT
    assert seen.publishers == {"/a": 2}
    assert heard.time <= failed.time <= seen.time


def test_a_half_written_line_is_left_for_later(tmp_path: Path) -> None:
    path = tmp_path / "report"
    reader = EventReader(path)
    assert reader.new_events() == []
    line = b'{"event": "sent", "time": 1.5, "count": 3}\n'
    path.write_bytes(line + line[:20])
    assert [event.count for event in reader.new_events()] == [3]
    assert reader.new_events() == []
    path.write_bytes(line + line)
    assert [event.count for event in reader.new_events()] == [3]


@pytest.mark.parametrize("line", ["{}", "[]", "nonsense", '{"event": "x", "time": 1}', "3"])
def test_foreign_lines_are_errors(line: str, tmp_path: Path) -> None:
    path = tmp_path / "report"
    path.write_text(f"{line}\n")
    with pytest.raises(DocumentError):
        read_events(path)


def test_without_a_file_nothing_is_written() -> None:
    EventWriter(None).report(EventKind.READY)
