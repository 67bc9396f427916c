"""Processes that tests start: awaited with patience, and heard when they fail.

Nothing here depends on how fast a machine is: what is awaited is an event, and `PATIENCE` only
tells a child that hangs from one that is slow.
"""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar

PATIENCE = 300.0
"""Seconds after which something awaited is taken for never coming."""

LATE = 30.0
"""Seconds after which one who is expected on a DDS is taken for silent."""

LONG = "SROS_LONG" in os.environ
"""Whether the long forms are asked for: more of what is drawn or killed at random."""

Done = subprocess.CompletedProcess[str]
_Value = TypeVar("_Value")


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

    Fails with the program's own words unless it ends with ``status`` (None: any).
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
    """As `run`, with this Python: a script, or ``-c`` and code, or ``-m`` and a module.

    It finds what this process finds, unless ``env`` says otherwise.
    """
    more.setdefault("env", importing())
    return run([sys.executable, *words], **more)


def importing(**variables: str) -> dict[str, str]:
    """This process's environment, and more, for a Python that imports what is imported here."""
    return {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path)), **variables}


def finish(process: subprocess.Popen[str], *, status: int | None = 0) -> Done:
    """Wait for the end of a program that was started with pipes; fails as `run` does."""
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


def wait_for(
    look: Callable[[], _Value],
    what: str,
    process: subprocess.Popen[str] | None = None,
    *,
    words: Callable[[], object] = str,
) -> _Value:
    """Return what ``look`` gives as soon as it is true.

    Fails when it never is, or when ``process``, which has to bring it about, has ended before;
    what then stands in the assertion is the process's output, and ``words()``.
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
