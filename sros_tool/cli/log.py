"""Reads the logs that verbs are given: files, pipes and standard input, of bounded size."""

from __future__ import annotations

import stat
import sys
from pathlib import Path

from sros_tool.errors import DocumentError

MAX_LOG = 64 * 1024 * 1024
"""Largest log that is read, in bytes."""


def read_log(log: str) -> str:
    """The text of a log, of standard input for "-"; a pipe (``<(journalctl ...)``) is read, too.

    Raises `DocumentError` for what cannot be read, is a device, or is larger than ``MAX_LOG``.
    """
    try:
        if log == "-":
            data = sys.stdin.buffer.read(MAX_LOG + 1) if sys.stdin else b""
        else:
            kind = Path(log).stat().st_mode
            if not (stat.S_ISREG(kind) or stat.S_ISFIFO(kind) or stat.S_ISDIR(kind)):
                raise DocumentError(f"the log '{log}' is neither a file nor a pipe")
            with Path(log).open("rb") as file:
                data = file.read(MAX_LOG + 1)
    except FileNotFoundError as error:
        raise DocumentError(f"the log '{log}' does not exist") from error
    except OSError as error:
        raise DocumentError(f"the log '{log}' cannot be read", f"{error.strerror}.") from error
    except ValueError as error:  # a name that holds NUL is of no file
        raise DocumentError(f"the log '{log}' does not exist") from error
    if len(data) > MAX_LOG:
        raise DocumentError(
            f"the log '{log}' is too large",
            f"More than {MAX_LOG // 1024**2} MiB.",
            "Cut it to what is of interest: tail -n 100000 LOG.",
        )
    return data.decode("utf-8", "replace")
