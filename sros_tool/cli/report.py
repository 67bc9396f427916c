"""Tells the user about errors: one paragraph on stderr, never a traceback."""

from __future__ import annotations

import os
import sys
import traceback
from pathlib import Path

import click

from sros_tool.cli.visible import visible
from sros_tool.errors import SrosError, UsageError

_PHRASES = {
    "create_keystore": "create keystore",
    "create_enclave": "create enclave",
    "create_permission": "create permission",
    "generate_artifacts": "generate artifacts",
    "list_enclaves": "list enclaves",
    "distribute_key": "distribute key",
    "rotate_ca": "rotate the CA",
    "create_request": "create the request",
    "sign_request": "sign the request",
    "import": "import the answer",
    "generate_policy": "generate policy",
    "merge_policy": "merge policies",
    "diff_policy": "compare",
    "minimize_policy": "minimize the policy",
    "env": "print the environment",
    "run": "run the command",
    "demo": "run the demo",
    "doctor": "examine this machine",
}


def report_error(error: BaseException) -> int:
    """Print what is wrong, why, and what to do; return the exit status."""
    if isinstance(error, SystemExit):
        return error.code if isinstance(error.code, int) else 1
    if isinstance(error, click.exceptions.Exit):
        return error.exit_code
    if isinstance(error, (KeyboardInterrupt, click.Abort)):
        print("sros: interrupted", file=sys.stderr)
        return 130
    if isinstance(error, click.exceptions.NoArgsIsHelpError):
        error.show()
        return 2
    if isinstance(error, click.UsageError):
        return _usage(error)
    if isinstance(error, SrosError):
        return _say(_prefixed(str(error)), error.exit_status)
    if isinstance(error, OSError):
        return _say(_prefixed(_os_problem(error)), 1)
    return _defect(error)


def _usage(error: click.UsageError) -> int:
    message = error.format_message()
    where = error.ctx.command_path if error.ctx else "sros"
    return _say(f"{where}: {message} See `{where} --help`.", 2)


def _say(text: str, status: int) -> int:
    print(visible(" ".join(text.split())), file=sys.stderr)
    return status


def _prefixed(text: str) -> str:
    verb = _verb()
    if verb is None:
        return f"sros: {text}"
    return f"Unable to {_PHRASES.get(verb, verb.replace('_', ' '))}: {text}"


def _verb() -> str | None:
    from sros_tool.cli.program import _NAMES

    for word in sys.argv[1:]:
        if not word.startswith("-"):
            return _NAMES.get(word.replace("-", "_"))
    return None


def _os_problem(error: OSError) -> str:
    if error.filename is None:  # perhaps what was done can only not be printed
        try:
            Path.cwd()
        except OSError:
            return "the folder that this runs in does not exist any more. Go to another one."
        return f"the operating system refuses: {error.strerror or error}."
    path = os.fsdecode(error.filename)
    return f"the operating system refuses '{path}': {error.strerror or error}. Nothing was changed."


def _defect(error: BaseException) -> int:
    if os.environ.get("SROS_DEBUG"):
        traceback.print_exception(error)
    return _say(
        _prefixed(
            f"this is a defect of sros: {type(error).__name__}: {error}. Please report it; "
            "SROS_DEBUG=1 shows where it happened."
        ),
        1,
    )


__all__ = ["UsageError", "report_error"]
