"""The program ``sros``: parses the command line, calls one function, shows its result."""

from __future__ import annotations

import os
import signal
import sys
from types import FrameType


def main(arguments: list[str] | None = None) -> None:
    """Run ``sros`` and exit: 0 yes or done; 1 no, denied, or failed; 2 wrong usage."""
    # Turns a polite request to end into an exception, so that nothing half-made is left behind.
    signal.signal(signal.SIGTERM, _terminate)
    from sros_tool.cli.program import program
    from sros_tool.cli.report import report_error

    try:
        status = program.main(arguments, prog_name="sros", standalone_mode=False)
        sys.stdout.flush()
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(1)
    except BaseException as error:
        sys.exit(report_error(error))
    sys.exit(status if isinstance(status, int) else 0)


def _terminate(number: int, _frame: FrameType | None) -> None:
    sys.exit(128 + number)
