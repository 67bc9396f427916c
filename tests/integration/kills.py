"""Kill real processes of the program at random moments, spread over all that they do."""

from __future__ import annotations

import json
import random
import signal
import subprocess
import sys
import time
from collections.abc import Iterator

import pytest

from tests.support.children import LONG, PATIENCE, importing

# Forks the imported program for each line; a program of its own would take 0.2 s to start.
SERVER = """
import json, os, signal, sys, tempfile, time
answers = os.fdopen(os.dup(1), "w")
said = tempfile.TemporaryFile()
for descriptor in (1, 2):
    os.dup2(said.fileno(), descriptor)
from sros_tool.cli import main
import sros_tool.cli.keystore, sros_tool.cli.program, sros_tool.keystore.lifecycle.create
import sros_tool.parallel, sros_tool.policy
for line in sys.stdin:
    pause, words = json.loads(line)
    said.seek(0)
    said.truncate()
    child = os.fork()
    if child == 0:
        try:
            sys.argv = ["sros", *words]
            main(words)
        except SystemExit as end:
            os._exit(end.code or 0)
        finally:
            os._exit(70)
    if pause is not None:
        time.sleep(pause)
        os.kill(child, signal.SIGKILL)
    _, status = os.waitpid(child, 0)
    said.seek(0)
    answer = [os.waitstatus_to_exitcode(status), said.read().decode(errors="replace")]
    print(json.dumps(answer), file=answers, flush=True)
"""


class Server:
    """Starts the program, already imported, in processes of its own."""

    def __init__(self) -> None:
        self._process = subprocess.Popen(
            [sys.executable, "-c", SERVER],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            env=importing(),
        )

    def run(self, *words: object) -> float:
        """Run the program to its end, which has to be a good one; return how long that took."""
        started = time.monotonic()
        status, said = self._run(None, words)
        assert status == 0, f"{words}: ended with {status}, and said: {said}"
        return time.monotonic() - started

    def kill(self, pause: float, *words: object) -> bool:
        """Run the program and kill it after a pause; False if it had ended well before."""
        status, said = self._run(pause, words)
        assert status in (0, -signal.SIGKILL), f"{words}: ended with {status}, and said: {said}"
        return status != 0

    def _run(self, pause: float | None, words: tuple[object, ...]) -> tuple[int, str]:
        assert self._process.stdin
        assert self._process.stdout
        self._process.stdin.write(json.dumps([pause, list(map(str, words))]) + "\n")
        self._process.stdin.flush()
        status, said = json.loads(self._process.stdout.readline())
        return status, said

    def close(self) -> None:
        self._process.communicate(timeout=PATIENCE)


@pytest.fixture
def server() -> Iterator[Server]:
    """Starts the program in processes that can be killed."""
    serving = Server()
    yield serving
    serving.close()


class Moments:
    """Pauses after which to kill, so that some kills come early, some late, and some too late.

    How long the work takes changes with what else the machine does, so it is learned from what
    comes of each kill: `tell` that for every pause.  There are at least ``number`` of them (twenty
    times as many in the long form), and so many more until a quarter of ``number`` was killed
    before its work was done, and the work was done at least once.
    """

    def __init__(self, number: int, seed: int, length: float) -> None:
        self._number = number * (20 if LONG else 1)
        self._random = random.Random(seed)
        self._length = length
        self._told = self._early = self._late = 0

    def __iter__(self) -> Iterator[float]:
        while self._told < self._number or self._early < self._number / 4 or not self._late:
            assert self._told < 20 * self._number, self
            yield self._random.uniform(0, 1.1 * self._length)

    def tell(self, *, killed: bool, done: bool) -> None:
        """Note whether the process was killed, and whether its work was done by then."""
        self._told += 1
        self._early += killed and not done
        self._late += done
        # At rest where nearly a third ends before it is killed, whatever the machine's speed.
        self._length *= 0.9 if not killed else 1.05 if not done else 1.0

    def __repr__(self) -> str:
        return f"{self._told} kills, {self._early} too early, {self._late} after the work"
