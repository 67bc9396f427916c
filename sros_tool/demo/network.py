"""Network namespaces for the demo (in a child process) and for each of its rows.

A row's network is a namespace that exists as long as the processes and sockets in it.  To create
one, a process must be in a separate network and have only one thread (`run_isolated`): setns(2)
changes only the calling thread.
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
    """The network of a row's processes and capture; the machine's network if ``own`` is false."""

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
        """Enter the network of the row, and leave it at the end of the context."""
        if not self.own:
            yield
            return
        _enter(self._there)
        try:
            yield
        finally:
            _enter(self._back)

    def close(self) -> None:
        """Release the network; the kernel removes it with the last process and socket in it."""
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
"""A function that is called with each line about the progress."""

ENDING_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)

_SECONDS_TO_END = 8.0


def end_with_starter() -> Callable[[], None]:
    """Return a function for a child to call first: the kernel then kills it with this process."""
    starter = os.getpid()

    def follow() -> None:
        end_with_parent()
        if os.getppid() != starter:
            os._exit(1)

    return follow


def run_isolated(
    work: Callable[[Progress], _Value], isolation: Isolation, progress: Progress
) -> _Value:
    """Run ``work`` in a child process and return its result.

    ``progress`` gets each line that ``work`` passes to its argument.  The child enters a separate
    network if ``isolation`` says so, and does not outlive this process.

    Raises:
        SrosError: ``work`` raised it, or the child ended without a result.
    """
    context = multiprocessing.get_context("fork")
    ours, theirs = context.Pipe(duplex=False)
    child = context.Process(target=_main, args=(work, isolation, theirs, end_with_starter()))
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
            if kind == "progress":
                progress(value)
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
    work: Callable[[Progress], Any],
    isolation: Isolation,
    answers: Connection,
    follow_starter: Callable[[], None],
) -> None:
    follow_starter()
    # Drop the parent's handlers: Python loses an exception that a handler raises during a fork.
    # Work that must clean up sets handlers again.
    for number in ENDING_SIGNALS:
        signal.signal(number, signal.SIG_DFL)
    try:
        if isolation.isolated:
            enter_isolation()
        answers.send(("result", work(lambda line: answers.send(("progress", line)))))
    except asyncio.CancelledError:
        os._exit(1)
    except SrosError as error:
        answers.send(("failed", error))
    except Exception as error:
        answers.send(("failed", SrosError("the demo failed", f"{type(error).__name__}: {error}")))
