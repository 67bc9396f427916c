"""Progress of long work, on a terminal only: one line, which is erased when the work is done."""

from __future__ import annotations

import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType
from typing import TYPE_CHECKING

from sros_tool.terminal import redraw

if TYPE_CHECKING:
    from sros_tool.parallel import Tally

_FIRST, _EVERY = 1.0, 0.5  # seconds
_ESTIMATED = 3.0
"""Seconds from which on the time that is left is shown."""


class _Line:
    """A line on the terminal that a timer draws again and again.

    The timer is a signal: unlike a thread, it does not get in the way of the processes that are
    forked for the work, and they do not inherit it.
    """

    def __init__(self, label: str, total: int, tally: Tally) -> None:
        self._label, self._total, self._tally = label, total, tally
        self._done = 0
        self._drawn = False
        self._began = time.monotonic()
        self._before = signal.signal(signal.SIGALRM, self._draw)
        signal.setitimer(signal.ITIMER_REAL, _FIRST, _EVERY)

    def step(self, _name: str) -> None:
        """Count one more item as done."""
        self._done += 1

    def pause(self) -> None:
        """Erase the line and draw no more."""
        signal.setitimer(signal.ITIMER_REAL, 0)
        if self._drawn:
            redraw("")

    def go_on(self) -> None:
        """Draw again."""
        signal.setitimer(signal.ITIMER_REAL, _FIRST, _EVERY)

    def end(self) -> None:
        """Erase the line for good."""
        self.pause()
        signal.signal(signal.SIGALRM, self._before)

    def _draw(self, _number: int, _frame: FrameType | None) -> None:
        done, total, left = self._done, self._total, None
        if self._tally.total:
            done, total, left = self._tally.done(), self._tally.total, self._tally.left()
        count = f" {done} of {total}" if total and done else ""
        seconds = time.monotonic() - self._began
        rest = "" if left is None or seconds < _ESTIMATED else f", about {_rounded(left)} left"
        redraw(f"{self._label}{count} ... {seconds:.0f} s{rest}")
        self._drawn = True


def _rounded(seconds: float) -> str:
    """Return a time as text, in minutes from two on."""
    return f"{seconds:.0f} s" if seconds < 120 else f"{seconds / 60:.0f} min"


_lines: list[_Line] = []


@contextmanager
def progress(label: str, total: int = 0) -> Iterator[Callable[[str], None] | None]:
    """Show ``label`` and the seconds on the terminal from the first second on, until the body ends.

    Args:
        label: what is done, such as "signing".
        total: number of items, if the body counts them with the yielded function.

    Yields None where nothing is shown: standard error is no terminal.
    """
    on_terminal = sys.stderr is not None and sys.stderr.isatty()
    if not on_terminal or _lines or threading.current_thread() is not threading.main_thread():
        yield None
        return
    from sros_tool.parallel import tallied

    with tallied() as tally:
        line = _Line(label, total, tally)
        _lines.append(line)
        try:
            yield line.step
        finally:
            _lines.pop()
            line.end()


@contextmanager
def paused() -> Iterator[None]:
    """Keep the terminal free for a question, such as for a passphrase."""
    for line in _lines:
        line.pause()
    try:
        yield
    finally:
        for line in _lines:
            line.go_on()
