"""Steps of a setup: report the step, run an installer quietly, show its last output lines."""

from __future__ import annotations

import contextlib
import fcntl
import functools
import os
import shutil
import subprocess
import sys
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

CHECKOUT = Path(__file__).resolve().parent.parent
VENV = CHECKOUT / ".venv"
LOG = VENV / "setup.log"

APT_LOG = "apt.log"
"""The log of apt, next to `LOG`: apt works while packages for Python are installed."""

_PATIENCE = 1800
"""Seconds after which an installer is stopped."""

_TAIL = 15
"""Lines of an installer's output that are shown when it fails."""


class SetupError(Exception):
    """An error that ends a setup; its text says what is missing, why, and how to get it."""


def say(text: str) -> None:
    """Print one line about the setup to stderr; stdout is for the results of the command."""
    print(f"dev: {text}", file=sys.stderr, flush=True)


def succeeds(
    command: Sequence[str | Path],
    *,
    cwd: Path | None = None,
    env: Mapping[str, str] | None = None,
    keep_open: int | None = None,
    log_name: str | None = None,
) -> bool:
    """Run an installer with its output in a log; return whether its exit status was 0.

    The log is `LOG`, or the file ``log_name`` next to it.

    The installer inherits ``keep_open``, the file descriptor of the lock.  So the next setup waits
    for an installer that still runs after its setup was killed.
    """
    LOG.parent.mkdir(parents=True, exist_ok=True)
    with LOG.with_name(log_name or LOG.name).open("ab") as log:
        log.write(f"\n$ {' '.join(map(str, command))}\n".encode())
        log.flush()
        try:
            ended = subprocess.run(
                command,
                cwd=cwd,
                env=env,
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=subprocess.STDOUT,
                timeout=_PATIENCE,
                pass_fds=() if keep_open is None else (keep_open,),
                check=False,
            )
        except (OSError, subprocess.TimeoutExpired) as error:
            log.write(f"{error}\n".encode())
            return False
        log.write(f"(exit status {ended.returncode})\n".encode())
        return ended.returncode == 0


def output_of(command: Sequence[str | Path], env: Mapping[str, str] | None = None) -> str | None:
    """Return a command's stdout, or None if it fails or cannot be started."""
    try:
        ended = subprocess.run(
            command,
            env=env,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            timeout=60,
            encoding="utf-8",
            errors="replace",
            check=False,
        )
    except (OSError, subprocess.TimeoutExpired):
        return None
    return ended.stdout if ended.returncode == 0 else None


def log_tail() -> str:
    """Return the last lines of the log, indented, with the path of the whole log."""
    try:
        lines = LOG.read_text(encoding="utf-8", errors="replace").splitlines()
    except OSError:
        return ""
    shown = "\n".join(f"    {line}" for line in lines[-_TAIL:])
    return f"The end of {LOG}:\n{shown}"


@contextlib.contextmanager
def locked() -> Iterator[int]:
    """Lock this checkout against other setups; yield the descriptor that holds the lock.

    The lock is on the checkout's folder itself, so it needs no file.  It ends with the last process
    that has the descriptor open.
    """
    lock = os.open(CHECKOUT, os.O_RDONLY | os.O_DIRECTORY)
    try:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            say("another ./dev is setting up this checkout; waiting for it")
            fcntl.flock(lock, fcntl.LOCK_EX)
        yield lock
    finally:
        os.close(lock)


@functools.cache
def root_prefix() -> list[str] | None:
    """Return the words that make root run a command; None if that needs a password."""
    if os.geteuid() == 0:
        return []
    if shutil.which("sudo") and output_of(["sudo", "-n", "true"]) is not None:
        return ["sudo", "-n"]
    return None
