"""Does the same work on the shares of a long list, one process for each core.

Signing is bound by the processor, and the processes of a fork share everything that was read and
checked before.  They also share the lock on the keystore: it is held until the last one is gone.
"""

from __future__ import annotations

import contextlib
import ctypes
import os
import pickle
import signal
import threading
from collections.abc import Callable, Sequence
from itertools import pairwise
from typing import TypeVar

from sros_tool.errors import SrosError

Item = TypeVar("Item")
Outcome = TypeVar("Outcome")

Progress = Callable[[str], None]
"""Told the name of each enclave when it is done."""

_SMALLEST_SHARE = 100
_MOST_PROCESSES = 8
_PR_SET_PDEATHSIG = 1
_ENDING = (signal.SIGINT, signal.SIGTERM)


def in_shares(
    items: Sequence[Item], work: Callable[[Sequence[Item]], Outcome]
) -> list[tuple[Sequence[Item], Outcome]]:
    """Each share of ``items`` with what ``work`` made of it, in order; the first error is raised.

    Short lists, and programs with several threads (which a fork could stop half-way), get one
    share and no further process.  Outcomes and errors are pickled.
    """
    cores = len(os.sched_getaffinity(0))
    count = min(cores, len(items) // _SMALLEST_SHARE, _MOST_PROCESSES)
    if count < 2 or threading.active_count() > 1:
        return [(items, work(items))]
    bounds = [len(items) * index // count for index in range(count + 1)]
    shares = [items[begin:end] for begin, end in pairwise(bounds)]
    children: list[tuple[int, int]] = []
    try:
        for share in shares[1:]:
            _fork(share, work, children)
        outcomes = [work(shares[0])]
        while children:
            outcomes.append(_collect(*children[0]))
            children.pop(0)
    finally:
        for child, pipe in children:
            with contextlib.suppress(OSError):
                os.kill(child, signal.SIGKILL)
                os.waitpid(child, 0)
            with contextlib.suppress(OSError):
                os.close(pipe)
    return list(zip(shares, outcomes, strict=True))


def _fork(
    share: Sequence[Item],
    work: Callable[[Sequence[Item]], Outcome],
    children: list[tuple[int, int]],
) -> None:
    """Start a child and add it, with the pipe for its outcome, to ``children``.

    A signal that came between these two would leave a child that nobody ends.
    """
    parent = os.getpid()
    reader, writer = os.pipe()
    before = signal.pthread_sigmask(signal.SIG_BLOCK, _ENDING)
    child = os.fork()
    if child:
        children.append((child, reader))
        os.close(writer)
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
        return
    try:
        os.close(reader)
        _end_with(parent)
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
        with open(writer, "wb") as pipe:
            pickle.dump(_attempt(share, work), pipe)
    finally:
        os._exit(0)  # no handlers, buffers or temporary files of the parent's


def _attempt(
    share: Sequence[Item], work: Callable[[Sequence[Item]], Outcome]
) -> Outcome | BaseException:
    try:
        return work(share)
    except BaseException as error:
        return error


def _end_with(parent: int) -> None:
    """Let this process be killed when its parent dies, so that nothing is written afterwards."""
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
    if os.getppid() != parent:
        os._exit(1)
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent gets it too, and ends its children


def _collect(child: int, pipe: int) -> Outcome:  # type: ignore[type-var]
    with open(pipe, "rb") as stream:
        message = stream.read()
    _, status = os.waitpid(child, 0)
    if not message:
        raise SrosError(
            "a process that shared the work died",
            f"It ended with status {status}; perhaps there was too little memory.",
            "Try again.",
        )
    outcome = pickle.loads(message)  # noqa: S301 - from our own child, through a pipe
    if isinstance(outcome, BaseException):
        raise outcome
    return outcome  # type: ignore[no-any-return]
