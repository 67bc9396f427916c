"""Work that is shared by processes, which all end together."""

from __future__ import annotations

import os
import threading
from collections.abc import Sequence
from pathlib import Path

import pytest

from sros_tool import parallel
from tests.support.children import python, wait_for

ITEMS = range(1000)


def test_each_slice_has_its_own_result_in_order(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: {0, 1, 2})
    # A test runner may have threads, and a list would then stay whole.
    monkeypatch.setattr(threading, "active_count", lambda: 1)
    thirds = [ITEMS[:333], ITEMS[333:666], ITEMS[666:]]
    assert parallel.map_slices(ITEMS, sum) == [(part, sum(part)) for part in thirds]


def test_a_program_with_threads_works_on_the_whole_list(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: {0, 1})
    monkeypatch.setattr(threading, "active_count", lambda: 2)
    assert parallel.map_slices(ITEMS, sum) == [(ITEMS, sum(ITEMS))]


def test_what_forked_workers_have_done_is_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: {0, 1})
    own, seen = os.getpid(), []

    def work(share: Sequence[int]) -> None:
        for _ in share:
            parallel.tick()
        if os.getpid() == own:
            wait_for(lambda: tally.done() == len(ITEMS), "the worker counts its share")
            seen.append((tally.total, tally.remaining_seconds()))

    with parallel.tallied() as tally:
        assert tally.remaining_seconds() is None
        for _ in range(2):
            parallel.map_slices(ITEMS, work)
            assert (tally.total, tally.done()) == (0, 0)
    assert seen == [(len(ITEMS), 0.0)] * 2
    parallel.tick()  # without anybody who counts


INTERRUPTED = """
import os, signal, sys
from itertools import count
from pathlib import Path
from sros_tool import parallel

folder = Path(sys.argv[1])
fork, children = os.fork, []
os.sched_getaffinity = lambda _: {0, 1}


class Ended(BaseException):
    pass


def end(*_):
    raise Ended


def interrupted():
    child = fork()
    if child:
        children.append(child)
        os.kill(os.getpid(), signal.SIGTERM)
    return child


def write(share):
    for number in count(share[0]):  # until it is ended
        (folder / str(number % 1000)).touch()


signal.signal(signal.SIGTERM, end)
os.fork = interrupted
try:
    parallel.map_slices(range(1000), write)
except Ended:
    pass
(child,) = children
try:
    os.waitpid(child, os.WNOHANG)
except ChildProcessError:
    print("nobody is left")
else:
    os.kill(child, signal.SIGKILL)
"""


def test_no_process_is_left_by_a_signal_that_comes_as_it_starts(tmp_path: Path) -> None:
    """In a process of its own: one with several threads may get the signal in any of them."""
    assert python("-c", INTERRUPTED, tmp_path).stdout == "nobody is left\n"
