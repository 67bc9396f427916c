"""Run processes in tests, with their output in the failure.

Nothing here depends on the speed of a machine: tests wait for events, and `PATIENCE` is only for
a child that hangs.
"""

from __future__ import annotations

import os
import pickle
import select
import signal
import subprocess
import sys
import time
import traceback
from collections.abc import Callable, Mapping, Sequence
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, TypeVar

from sros_tool.parallel import end_with_parent
from sros_tool.runtime.netns import enter_isolation, try_isolation

PATIENCE = 300.0
"""Seconds after which a process is taken to hang."""

LATE = 30.0
"""Seconds after which a DDS participant that should be heard is taken to be silent."""

LONG = "SROS_LONG" in os.environ
"""Whether to run the long forms of the tests, with more random and exhaustive cases."""

Done = subprocess.CompletedProcess[str]
_Value = TypeVar("_Value")


def some_steps(steps: Sequence[int]) -> Sequence[int]:
    """Return the steps at which to stop a process: of many some eight, with the last one.

    In the long form all are.
    """
    return steps if LONG else steps[:: -(1 + len(steps) // 10)][::-1]


def run(
    command: Sequence[object],
    *,
    status: int | None = 0,
    said: str = "",
    env: Mapping[str, str] | None = None,
    cwd: Path | None = None,
    patience: float = PATIENCE,
    **more: Any,
) -> Done:
    """Run a program to its end, with ``said`` on its standard input.

    Fails with the program's output unless its exit status is ``status`` (None: any).
    """
    words = [str(each) for each in command]
    try:
        done = subprocess.run(
            words,
            input=said,
            env=env,
            cwd=cwd,
            capture_output=True,
            text=True,
            timeout=patience,
            **more,
        )
    except subprocess.TimeoutExpired as late:
        raise AssertionError(_story(words, "did not end", late.stdout, late.stderr)) from None
    if status is not None and done.returncode != status:
        ended = f"ended with {done.returncode}, not {status}"
        raise AssertionError(_story(words, ended, done.stdout, done.stderr))
    return done


def python(*words: object, **more: Any) -> Done:
    """Run this Python: with a script, ``-c`` and code, or ``-m`` and a module.

    It imports what this process imports, unless ``env`` says otherwise.  Fails as `run` does.
    """
    more.setdefault("env", importing())
    return run([sys.executable, *words], **more)


def importing(**variables: str) -> dict[str, str]:
    """Return this process's environment and ``variables``, with the import path of this process."""
    return {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path)), **variables}


def finish(process: subprocess.Popen[str], *, status: int | None = 0) -> Done:
    """Wait for a program that was started with pipes; fail as `run` does."""
    words = [str(each) for each in process.args]  # type: ignore[union-attr]
    try:
        out, err = process.communicate(timeout=PATIENCE)
    except subprocess.TimeoutExpired:
        process.kill()
        out, err = process.communicate()
        raise AssertionError(_story(words, "did not end", out, err)) from None
    if status is not None and process.returncode != status:
        ended = f"ended with {process.returncode}, not {status}"
        raise AssertionError(_story(words, ended, out, err))
    return subprocess.CompletedProcess(words, process.returncode, out, err)


class Forked:
    """A forked process that calls ``work`` and ends with what it returns; used like a `Popen`.

    Nothing is imported again, so it starts faster than a new program.  ``env`` is its whole
    environment, and ``errors`` the file of its standard error.  It ends with this process.
    """

    def __init__(self, work: Callable[[], int], *, env: Mapping[str, str], errors: Path) -> None:
        self.returncode: int | None = None
        self.pid = os.fork()
        if self.pid == 0:
            status = 70
            try:
                end_with_parent()
                with errors.open("wb") as file:
                    os.dup2(file.fileno(), 2)
                os.environ.clear()
                os.environ.update(env)
                status = work()
            except BaseException:
                os.write(2, traceback.format_exc().encode(errors="replace"))
            finally:
                os._exit(status)

    def poll(self) -> int | None:
        """Return the exit status, or None while the process runs."""
        if self.returncode is None:
            ended, status = os.waitpid(self.pid, os.WNOHANG)
            self.returncode = os.waitstatus_to_exitcode(status) if ended else None
        return self.returncode

    def send_signal(self, number: signal.Signals) -> None:
        """Send a signal, unless the process has ended."""
        if self.poll() is None:
            os.kill(self.pid, number)

    def terminate(self) -> None:
        """Send SIGTERM, unless the process has ended."""
        self.send_signal(signal.SIGTERM)

    def kill(self) -> None:
        """Send SIGKILL, unless the process has ended."""
        self.send_signal(signal.SIGKILL)

    def wait(self, timeout: float = PATIENCE) -> int:
        """Wait at most ``timeout`` seconds for the end; return the exit status."""
        if self.poll() is None:
            ended = os.pidfd_open(self.pid)
            try:
                select.select([ended], [], [], timeout)
            finally:
                os.close(ended)
        if (status := self.poll()) is None:
            raise subprocess.TimeoutExpired(f"process {self.pid}", timeout)
        return status


def together(works: Sequence[Callable[[], _Value]], *, patience: float = PATIENCE) -> list[_Value]:
    """Call functions at the same time, and return what they return, in their order.

    Each runs in a forked process and in a separate network, where the kernel allows one.  A forked
    process imports nothing again, so it costs less than a new program.  Fails with the traceback
    of a function that fails.
    """
    isolated = has_isolation()
    with TemporaryDirectory() as folder:

        def begin(number: int, work: Callable[[], _Value]) -> Forked:
            def run_work() -> int:
                if isolated:
                    enter_isolation()
                Path(folder, f"{number}").write_bytes(pickle.dumps(work()))
                return 0

            return Forked(run_work, env=dict(os.environ), errors=Path(folder, f"{number}.err"))

        children = [begin(number, work) for number, work in enumerate(works)]
        values: list[_Value] = []
        try:
            for number, child in enumerate(children):
                status = child.wait(patience)
                errors = Path(folder, f"{number}.err").read_text(errors="replace")
                assert status == 0, f"a forked process ended with {status}: {errors}"
                values.append(pickle.loads(Path(folder, f"{number}").read_bytes()))
        finally:
            for child in children:
                child.kill()
        return values


def apart(work: Callable[[], _Value], *, patience: float = PATIENCE) -> _Value:
    """Call a function in a forked process and in a separate network, as `together` does."""
    (value,) = together([work], patience=patience)
    return value


@cache
def has_isolation() -> bool:
    """Return whether a process can have a separate network; it is tried once."""
    return try_isolation().isolated


def wait_for(
    look: Callable[[], _Value],
    what: str,
    process: subprocess.Popen[str] | None = None,
    *,
    words: Callable[[], object] = str,
) -> _Value:
    """Return the first true value of ``look()``.

    Fails when there is none within `PATIENCE`, or when ``process`` ended before; the assertion
    then has the process's output and ``words()``.
    """
    end = time.monotonic() + PATIENCE
    while True:
        ended = process is not None and process.poll() is not None
        if found := look():
            return found
        if ended or time.monotonic() > end:
            if process is None:
                raise AssertionError(f"{what}: never seen. {words()}")
            process.kill()
            out, err = process.communicate()
            story = f"never brought about: {what}. {words()}"
            raise AssertionError(_story([str(process.args)], story, out, err))
        time.sleep(0.02)


def _story(words: Sequence[str], what: str, *said: str | bytes | None) -> str:
    texts = [each.decode(errors="replace") if isinstance(each, bytes) else each for each in said]
    out, err = [(text or "").strip() or "(nothing)" for text in texts]
    name = " ".join(words)
    shown = name if len(name) < 300 else f"{name[:300]}…"
    return f"{shown}\n{what}\nit said: {out}\nand, as errors: {err}"
