"""The program ``sros``: parses the command line, calls one function, shows its result.

`program` lists the verbs; the modules of the verbs, by what they are about:

- keystores: `keystore`, `inspect`, `life`, `zenoh`
- robots: `deployment`, `fleet`, `agent`
- processes: `running`, `close`, `demo`
- policies: `policy`, `review`, `view`
- robots that run: `observing`, `audit`
- answers: `explain`, `check`

All share `common`; `changed` prints the changes of a keystore.  `ros2` has the verbs for ``ros2
security``.
"""

from __future__ import annotations

import atexit
import gc
import io
import os
import signal
import sys
import warnings
from types import FrameType

_COLLECT_AFTER = 50_000
"""New objects that trigger a search for garbage; Python's default is 700."""


def main(arguments: list[str] | None = None, *, name: str = "sros") -> None:
    """Run ``sros`` and exit with 0 (yes, done), 1 (no, findings) or 2 (not answered, not done).

    ``arguments`` are by default the arguments of the process; ``name`` is the program's name in
    help.
    """
    if arguments is None:
        arguments = sys.argv[1:]
    # Most of what a verb makes stays until its end, and Python would search it for garbage again
    # and again, most thoroughly when the process ends.
    gc.set_threshold(_COLLECT_AFTER)
    atexit.register(gc.freeze)
    # SIGTERM raises SystemExit, so that clean-up code runs and no partial files remain.
    signal.signal(signal.SIGTERM, _terminate)
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="surrogateescape")  # a path need not be valid UTF-8
    if not sys.warnoptions:
        warnings.simplefilter("ignore")  # warnings of libraries are not for users
    try:
        from sros_tool.cli.common import without_secrets
        from sros_tool.cli.program import program, report_error
        from sros_tool.errors import NOT_DONE
    except KeyboardInterrupt:
        print("sros: interrupted", file=sys.stderr)
        sys.exit(130)

    try:
        with without_secrets():
            color = False if os.environ.get("NO_COLOR") else None
            status = program.main(arguments, prog_name=name, standalone_mode=False, color=color)
        if sys.stdout:  # None if it was closed at the start
            sys.stdout.flush()
    except BrokenPipeError:
        _give_up_stdout()
        sys.exit(NOT_DONE)
    except BaseException as error:
        status = report_error(error, arguments, name)
        try:
            if sys.stdout:
                sys.stdout.flush()
        except OSError:
            _give_up_stdout()
        sys.exit(status)
    sys.exit(status if isinstance(status, int) else 0)


def _give_up_stdout() -> None:
    """Redirect standard output to /dev/null, so that the interpreter's last flush cannot fail."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _terminate(number: int, _frame: FrameType | None) -> None:
    sys.exit(128 + number)
