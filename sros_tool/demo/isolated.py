"""Run a function in a child process, in a network of its own where that is possible."""

from __future__ import annotations

import asyncio
import multiprocessing
import os
import signal
from collections.abc import Callable
from multiprocessing.connection import Connection
from typing import Any, TypeVar

from sros_tool.errors import SrosError
from sros_tool.runtime.netns import Isolation, end_with_parent, enter_isolation

_Value = TypeVar("_Value")

Tell = Callable[[str], None]

ENDING_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)

_SECONDS_TO_END = 8.0


def run_isolated(work: Callable[[Tell], _Value], isolation: Isolation, tell: Tell) -> _Value:
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
    work: Callable[[Tell], Any], isolation: Isolation, answers: Connection, starter: int
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
