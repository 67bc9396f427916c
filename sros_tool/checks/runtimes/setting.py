"""What a process would find: its environment, the clock, and the other processes; as a value."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta, tzinfo
from pathlib import Path


@dataclass(frozen=True, slots=True)
class Process:
    """A process that runs: its command, environment, and the moment of its start."""

    pid: int
    command: tuple[str, ...]
    environment: Mapping[str, str]
    started: datetime

    @property
    def told(self) -> str:
        """As "process 4711 (talker)"."""
        program = Path(self.command[0]).name if self.command else "?"
        return f"process {self.pid} ({program})"


@dataclass(frozen=True, slots=True)
class Setting:
    """What checks of the runtime look at.

    ``clock`` is what the clock of the host says, where ``now`` is another moment.
    ``rmws`` are the installed RMWs; ``insecure_rmws`` those that were tried and do not enforce
    security, with what was seen.  ``zone`` is that of the host.
    """

    environment: Mapping[str, str]
    now: datetime
    zone: tzinfo = UTC
    processes: tuple[Process, ...] = ()
    rmws: tuple[str, ...] = ()
    insecure_rmws: Mapping[str, str] = field(default_factory=dict)
    clock: datetime | None = None


def running_processes(proc: Path = Path("/proc")) -> Iterator[Process]:
    """The processes whose environment this user may read, but for this one."""
    ticks = os.sysconf("SC_CLK_TCK")
    begin = _boot_time(proc)
    for folder in sorted(proc.glob("[0-9]*"), key=lambda each: int(each.name)):
        if int(folder.name) == os.getpid():
            continue
        with suppress(OSError, ValueError, IndexError):
            environment = dict(
                word.split("=", 1) for word in _words(folder / "environ") if "=" in word
            )
            # The command may hold spaces and brackets; the numbers follow the last bracket.
            numbers = (folder / "stat").read_text().rpartition(")")[2].split()
            started = begin + timedelta(seconds=int(numbers[19]) / ticks)
            command = tuple(_words(folder / "cmdline"))
            yield Process(int(folder.name), command, environment, started)


def _words(path: Path) -> list[str]:
    text = path.read_bytes().decode("utf-8", "replace")
    return [word for word in text.split("\0") if word]


def _boot_time(proc: Path) -> datetime:
    with suppress(OSError, StopIteration, ValueError):
        lines = (proc / "stat").read_text().splitlines()
        seconds = next(line.split()[1] for line in lines if line.startswith("btime "))
        return datetime.fromtimestamp(int(seconds), UTC)
    return datetime.fromtimestamp(0, UTC)
