"""Work that is shared by processes, which all end together."""

from __future__ import annotations

import os
import signal
from collections.abc import Iterator, Sequence
from itertools import count
from pathlib import Path

import pytest

from sros_tool.keystore import parallel

ITEMS = range(1000)


class _Ended(BaseException):
    """What the program raises when it is told to end."""


@pytest.fixture
def two_cores(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """A machine with two cores, on which SIGTERM ends as it ends the program."""
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: {0, 1})

    def end(*_: object) -> None:
        raise _Ended

    before = signal.signal(signal.SIGTERM, end)
    yield
    signal.signal(signal.SIGTERM, before)


@pytest.mark.usefixtures("two_cores")
def test_the_outcomes_come_in_order() -> None:
    shares = parallel.in_shares(ITEMS, sum)
    assert [outcome for _, outcome in shares] == [sum(ITEMS[:500]), sum(ITEMS[500:])]


@pytest.mark.usefixtures("two_cores")
def test_no_process_is_left_by_a_signal_that_comes_as_it_starts(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    fork, children = os.fork, []

    def interrupted() -> int:
        child = fork()
        if child:
            children.append(child)
            os.kill(os.getpid(), signal.SIGTERM)
        return child

    def write(share: Sequence[int]) -> None:
        for number in count(share[0]):  # until it is ended
            (tmp_path / str(number % 1000)).touch()

    monkeypatch.setattr(os, "fork", interrupted)
    with pytest.raises(_Ended):
        parallel.in_shares(ITEMS, write)
    (child,) = children
    try:
        with pytest.raises(ChildProcessError):
            os.waitpid(child, os.WNOHANG)
    finally:
        if Path(f"/proc/{child}/cwd").exists():
            os.kill(child, signal.SIGKILL)
