"""Run a function over slices of a list in forked workers.

Signing is limited by the CPU, and forked workers share all data that the parent read and checked.
The workers also share the parent's lock on the keystore: the lock is held until the last worker has
exited.
"""

from __future__ import annotations

import contextlib
import gc
import os
import signal
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from itertools import pairwise
from typing import TypeVar

from sros_tool.errors import SrosError

Item = TypeVar("Item")
Result = TypeVar("Result")

Progress = Callable[[str], None]
"""Callback that is called with an enclave's name when work on the enclave is done."""

_MOST_PROCESSES = 8


class Tally:
    """A progress counter in memory that forked workers share.

    ``total`` is the number of items that `map_slices` works on now, or 0.
    """

    def __init__(self) -> None:
        import mmap  # most lists are short, and need no tally and no worker

        self.total = 0
        self._memory = mmap.mmap(-1, 8 * _MOST_PROCESSES)
        self._counts = memoryview(self._memory).cast("Q")  # a number for each process
        self._began = 0.0
        self._place = 0

    def begin(self, total: int) -> None:
        """Set the number of items to ``total`` and the number of finished items to 0."""
        self._counts[:] = memoryview(bytes(8 * _MOST_PROCESSES)).cast("Q")
        self.total, self._began = total, time.monotonic()

    def use_worker_slot(self, place: int) -> None:
        """Count this worker's finished items in slot ``place``, which no other worker uses."""
        self._place = place

    def add(self) -> None:
        """Count an item as done."""
        self._counts[self._place] += 1

    def done(self) -> int:
        """Return the number of items that are done."""
        return sum(self._counts)

    def remaining_seconds(self) -> float | None:
        """Return the estimated remaining seconds; None before the first item is done."""
        done = self.done()
        return (time.monotonic() - self._began) * (self.total - done) / done if done else None


_tallies: list[Tally] = []


@contextlib.contextmanager
def tallied() -> Iterator[Tally]:
    """Yield a `Tally` of the items that `tick` reports while the ``with`` body runs."""
    _tallies.append(Tally())
    try:
        yield _tallies[-1]
    finally:
        _tallies.pop()


def tick() -> None:
    """Report that the work on one item of `map_slices` is done."""
    for tally in _tallies:
        tally.add()


_SMALLEST_SLICE = 100
_COLLECT_AFTER = 50_000
"""New objects that trigger a garbage collection; Python's default is 700."""
_PR_SET_PDEATHSIG = 1
_STOP_SIGNALS = (signal.SIGINT, signal.SIGTERM)


def map_slices(
    items: Sequence[Item], work: Callable[[Sequence[Item]], Result]
) -> list[tuple[Sequence[Item], Result]]:
    """Split ``items`` into slices; return each slice with the result of ``work`` on it, in order.

    There is at most one slice for each core; this process handles the first slice, forked workers
    the others.  A short list becomes one slice without a worker, as does any list in a program
    with several threads: a fork could leave the locks of other threads held forever.  Results and
    errors of workers are pickled.

    Raises:
        SrosError: a worker died.  The first error that ``work`` raises is raised here, too.
    """
    cores = len(os.sched_getaffinity(0))
    count = min(cores, len(items) // _SMALLEST_SLICE, _MOST_PROCESSES)
    if count < 2 or threading.active_count() > 1:
        count = 1
    for tally in _tallies:
        tally.begin(len(items))
    try:
        with _rare_collections():
            return _run_on_slices(items, work, count)
    finally:
        for tally in _tallies:
            tally.begin(0)


@contextlib.contextmanager
def _rare_collections() -> Iterator[None]:
    """Run garbage collection less often in the body, which makes many objects and no cycles."""
    before = gc.get_threshold()
    gc.set_threshold(_COLLECT_AFTER, *before[1:])
    try:
        yield
    finally:
        gc.set_threshold(*before)


def _run_on_slices(
    items: Sequence[Item], work: Callable[[Sequence[Item]], Result], count: int
) -> list[tuple[Sequence[Item], Result]]:
    bounds = [len(items) * index // count for index in range(count + 1)]
    slices = [items[begin:end] for begin, end in pairwise(bounds)]
    workers: list[tuple[int, int]] = []
    try:
        for part in slices[1:]:
            _fork(part, work, workers)
        results = [work(slices[0])]
        while workers:
            results.append(_collect(*workers[0]))
            workers.pop(0)
    finally:
        for worker, pipe in workers:
            with contextlib.suppress(OSError):
                os.kill(worker, signal.SIGKILL)
                os.waitpid(worker, 0)
            with contextlib.suppress(OSError):
                os.close(pipe)
    return list(zip(slices, results, strict=True))


def _fork(
    items: Sequence[Item],
    work: Callable[[Sequence[Item]], Result],
    workers: list[tuple[int, int]],
) -> None:
    """Fork a worker, and add its process id and the pipe for its result to ``workers``.

    Signals are blocked during both steps: a signal between the two steps would leave a worker
    running that ``workers`` does not list.
    """
    import pickle

    follow_parent = end_with_starter()
    reader, writer = os.pipe()
    before = signal.pthread_sigmask(signal.SIG_BLOCK, _STOP_SIGNALS)
    worker = os.fork()
    if worker:
        workers.append((worker, reader))
        os.close(writer)
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
        return
    try:
        os.close(reader)
        follow_parent()  # ends with the parent, and so stops writing
        signal.signal(signal.SIGTERM, signal.SIG_DFL)
        # The parent gets the signal, too, and kills workers.
        signal.signal(signal.SIGINT, signal.SIG_IGN)
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
        for tally in _tallies:
            tally.use_worker_slot(len(workers) + 1)
        with open(writer, "wb") as pipe:
            pickle.dump(_result_or_error(items, work), pipe)
    finally:
        os._exit(0)  # without the parent's exit handlers, buffers and temporary files


def _result_or_error(
    items: Sequence[Item], work: Callable[[Sequence[Item]], Result]
) -> Result | BaseException:
    try:
        return work(items)
    except BaseException as error:
        return error


def end_with_parent() -> None:
    """Ask the kernel to kill this process when the thread that started it ends."""
    import ctypes

    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, int(signal.SIGKILL), 0, 0, 0)


def end_with_starter() -> Callable[[], None]:
    """Return a function for a child process to call first.

    The function makes the kernel kill the child when this process ends.
    """
    import ctypes  # noqa: F401 - here, because a lock may be held when the child is forked

    starter = os.getpid()

    def end_with_this_starter() -> None:
        end_with_parent()
        if os.getppid() != starter:
            os._exit(1)

    return end_with_this_starter


def _exit_text(exit_code: int) -> str:
    """Return how a worker ended; an ``exit_code`` below 0 is a signal."""
    if exit_code >= 0:
        return f"It exited with status {exit_code}."
    return f"It was killed by signal {-exit_code}; perhaps there was too little memory."


def _collect(worker: int, pipe: int) -> Result:  # type: ignore[type-var]
    """Wait for a worker, and return its result or raise its error."""
    with open(pipe, "rb") as stream:
        message = stream.read()
    _, status = os.waitpid(worker, 0)
    if not message:
        raise SrosError(
            "a worker process died",
            _exit_text(os.waitstatus_to_exitcode(status)),
            "Try again.",
        )
    import pickle

    result = pickle.loads(message)  # noqa: S301 - from our own child, through a pipe
    if isinstance(result, BaseException):
        raise result
    return result  # type: ignore[no-any-return]
