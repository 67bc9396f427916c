"""The events that a running process reports: one JSON object per line, appended to a file.

Times are seconds of CLOCK_MONOTONIC, which all processes of a machine share.  Each line is written
with one system call, so that lines of different writers never mix.  A reader leaves an incomplete
last line for the next read.
"""

from __future__ import annotations

import json
import os
import signal
import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from pathlib import Path
from typing import Any

from sros_tool.errors import DocumentError


class EventKind(StrEnum):
    """The kind of an event, such as that a process is ready, or that it heard a message."""

    READY = "ready"
    REFUSED = "refused"
    FAILED = "failed"
    SENT = "sent"
    HEARD = "heard"
    SEEN = "seen"
    DONE = "done"


_MESSAGES = (EventKind.SENT, EventKind.HEARD)


class ProcessStage(StrEnum):
    """The stage of a process to which an event belongs, such as a refusal."""

    IMPORT = "import"
    PARTICIPANT = "participant"
    ENDPOINT = "endpoint"
    RUNNING = "running"


@dataclass(frozen=True)
class Event:
    """An event that a process reported.

    ``text`` is the message sent or received, or the reason of a refusal or failure; ``count`` is
    the number of messages sent or received; ``publishers`` maps topics to the number of publishers
    that an observer counts.  ``time`` is in seconds, by the monotonic clock.
    """

    kind: EventKind
    time: float
    text: str = ""
    count: int = 0
    stage: ProcessStage | None = None
    publishers: Mapping[str, int] = field(default_factory=dict)


class EventWriter:
    """A writer that appends events to a file; without ``path``, events are discarded."""

    def __init__(self, path: Path | None) -> None:
        self._file = None
        if path is not None:
            flags = os.O_WRONLY | os.O_CREAT | os.O_APPEND | os.O_CLOEXEC
            self._file = os.open(path, flags, 0o644)

    def report(
        self,
        kind: EventKind,
        text: str = "",
        *,
        count: int = 0,
        stage: ProcessStage | None = None,
        publishers: Mapping[str, int] | None = None,
    ) -> None:
        """Append an event with the current time."""
        if self._file is None:
            return
        record: dict[str, Any] = {"event": kind.value, "time": round(time.monotonic(), 6)}
        if text:
            record["text"] = text
        if count or kind in _MESSAGES:
            record["count"] = count or 1
        if stage is not None:
            record["stage"] = stage.value
        if publishers:
            record["publishers"] = dict(publishers)
        os.write(self._file, (json.dumps(record, ensure_ascii=False) + "\n").encode())

    def close(self) -> None:
        """Close the file."""
        if self._file is not None:
            os.close(self._file)
            self._file = None


class EventReader:
    """A reader of the events since the last read; a missing file counts as empty."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._position = 0

    def new_events(self) -> list[Event]:
        """Return the events of the complete lines appended since the last call.

        Raises:
            DocumentError: A line is not an event.
        """
        try:
            with self._path.open("rb") as file:
                file.seek(self._position)
                data = file.read()
        except FileNotFoundError:
            return []
        whole_lines = data[: data.rfind(b"\n") + 1]
        self._position += len(whole_lines)
        return [parse_event(line, self._path) for line in whole_lines.splitlines()]


def read_events(path: Path) -> list[Event]:
    """Return the events of all complete lines in a file, oldest first; [] without the file.

    Raises:
        DocumentError: A line is not an event.
    """
    return EventReader(path).new_events()


def parse_event(line: bytes, path: Path) -> Event:
    """Return the event in a line of the file at ``path``.

    Raises:
        DocumentError: The line is not an event.
    """
    try:
        record = json.loads(line)
        return Event(
            kind=EventKind(record["event"]),
            time=float(record["time"]),
            text=str(record.get("text", "")),
            count=int(record.get("count", 0)),
            stage=ProcessStage(record["stage"]) if "stage" in record else None,
            publishers={str(k): int(v) for k, v in record.get("publishers", {}).items()},
        )
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise DocumentError(
            f"cannot read the report {path}", f"A line is not an event: {error}."
        ) from error


def signal_name(number: int) -> str:
    """Return the name of a signal that ended a process, such as ``SIGSEGV``."""
    try:
        return signal.Signals(number).name
    except ValueError:
        return f"signal {number}"
