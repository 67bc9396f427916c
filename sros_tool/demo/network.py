"""A network for each row: a namespace that lives as long as what was started in it.

Only for a process that is already in a network of its own and has one thread (`isolated`): to
enter a namespace and to come back changes the calling thread alone (setns(2)).
"""

from __future__ import annotations

import asyncio
import ctypes
import multiprocessing
import os
import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from multiprocessing.connection import Connection
from typing import Any, TypeVar

from sros_tool.errors import SrosError
from sros_tool.runtime.netns import Isolation, end_with_parent, enter_isolation

_CLONE_NEWNET = 0x40000000
_HERE = "/proc/thread-self/ns/net"


class RowNetwork:
    """Where the processes and the capture of a row live; the host's network where not ``own``."""

    def __init__(self, *, own: bool) -> None:
        self.own = own
        self._there = self._back = -1
        if not own:
            return
        self._back = os.open(_HERE, os.O_RDONLY | os.O_CLOEXEC)
        try:
            enter_isolation()
            self._there = os.open(_HERE, os.O_RDONLY | os.O_CLOEXEC)
        finally:
            _enter(self._back)

    @contextmanager
    def entered(self) -> Iterator[None]:
        """What is started or opened in this context belongs to the network of the row."""
        if not self.own:
            yield
            return
        _enter(self._there)
        try:
            yield
        finally:
            _enter(self._back)

    def close(self) -> None:
        """Let go of it; the kernel removes it with the last process and socket in it."""
        for descriptor in (self._there, self._back):
            if descriptor >= 0:
                os.close(descriptor)
        self._there = self._back = -1


def _enter(descriptor: int) -> None:
    library = ctypes.CDLL(None, use_errno=True)
    if library.setns(descriptor, _CLONE_NEWNET) != 0:
        number = ctypes.get_errno()
        raise OSError(number, f"setns: {os.strerror(number)}")


_Value = TypeVar("_Value")

Progress = Callable[[str], None]

ENDING_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)

_SECONDS_TO_END = 8.0


def run_isolated(
    work: Callable[[Progress], _Value], isolation: Isolation, tell: Progress
) -> _Value:
    """Return what ``work`` returns; lines that it tells are passed on while it runs.

    The child enters a network of its own if ``isolation`` says so.  Whatever ends this process
    ends the child.  An `SrosError` of ``work`` is raised here again.
    """
    context = multiprocessing.get_context("fork")
    ours, theirs = context.Pipe(duplex=False)
    child = context.Process(target=_main, args=(work, isolation, theirs, os.getpid()))
    child.start()
    theirs.close()
    try:
        while True:
            try:
                kind, value = ours.recv()
            except EOFError:
                child.join()
                raise SrosError(
                    "the demo ended without a result",
                    f"Its process ended with status {child.exitcode}.",
                ) from None
            if kind == "told":
                tell(value)
            elif kind == "failed":
                raise value
            else:
                result: _Value = value
                return result
    except BaseException:
        child.terminate()
        raise
    finally:
        child.join(_SECONDS_TO_END)
        if child.is_alive():
            child.kill()
            child.join()
        ours.close()


def _main(
    work: Callable[[Progress], Any], isolation: Isolation, answers: Connection, starter: int
) -> None:
    end_with_parent()
    if os.getppid() != starter:
        os._exit(1)
    # Not the handlers of the parent: one that raises can do so in the middle of a fork, where
    # Python drops the exception.  Work that has something to clean up sets its own.
    for number in ENDING_SIGNALS:
        signal.signal(number, signal.SIG_DFL)
    try:
        if isolation.isolated:
            enter_isolation()
        answers.send(("result", work(lambda line: answers.send(("told", line)))))
    except asyncio.CancelledError:
        os._exit(1)
    except SrosError as error:
        answers.send(("failed", error))
    except Exception as error:
        answers.send(("failed", SrosError("the demo failed", f"{type(error).__name__}: {error}")))
