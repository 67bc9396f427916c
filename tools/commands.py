"""The commands of `./dev`: which setup each one needs, and what it then runs."""

from __future__ import annotations

import os
import sys
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NoReturn

from tools import apt, checks, dds
from tools.environment import GROUPS, prepare
from tools.record import PYTHON, Record, current, holds, read_record, write_record
from tools.steps import CHECKOUT, VENV, SetupError, locked, say

USAGE = """\
Usage: ./dev COMMAND [ARGUMENTS…]

  demo [ARGUMENTS…]   show on a real DDS that secured nodes are closed to all others: sros demo
  test [ARGUMENTS…]   ruff, mypy and pytest; ARGUMENTS go to pytest
  lint                ruff and mypy alone
  bench [ARGUMENTS…]  measure: python -m benchmarks
  sros ARGUMENTS…     run this checkout's sros
  setup               set up everything for the above, also what is thought to be in place

Each sets up first what it needs: a virtual environment in .venv, for demo and test also a DDS
that enforces security. PYTHON names the Python to build upon, otherwise a fitting one is found.
"""


@dataclass(frozen=True)
class Needs:
    """What has to stand before a command runs."""

    groups: tuple[str, ...] = ("package",)
    dds: bool = False
    openssl: bool = False


NEEDS = {
    "demo": Needs(("package", "ros"), dds=True),
    "test": Needs(GROUPS, dds=True, openssl=True),
    "lint": Needs(("package", "test")),
    "bench": Needs(),
    "sros": Needs(),
    "setup": Needs(GROUPS, dds=True, openssl=True),
}


def main(arguments: list[str]) -> int:
    """Run one command; return the exit status (2 for wrong usage)."""
    if arguments[:1] in (["--help"], ["-h"], ["help"]):
        print(USAGE, end="")
        return 0
    command, rest = (arguments[0], arguments[1:]) if arguments else ("", [])
    if command not in NEEDS:
        problem = f"there is no command {command!r}" if command else "a command is missing"
        print(f"dev: {problem}.\n\n{USAGE}", end="", file=sys.stderr)
        return 2
    try:
        set_up(NEEDS[command], afresh=command == "setup")
        return _run(command, rest)
    except SetupError as error:
        print(f"dev: {error}", file=sys.stderr)
    except OSError as error:
        where = f" {error.filename}" if error.filename else ""
        print(f"dev: cannot go on:{where} {error.strerror or error}", file=sys.stderr)
    except KeyboardInterrupt:
        print("\ndev: interrupted; run it again to start over", file=sys.stderr)
        return 130
    return 1


def set_up(needs: Needs, *, afresh: bool = False) -> None:
    """Bring about what a command needs, where the last setup's record does not say it is there.

    ``afresh`` asks pip and the system again whatever the record says.
    """
    with locked() as lock:
        record = read_record()
        groups = list(needs.groups)
        if afresh:
            record = replace(record, groups=[], dds=None)
        if not holds(record, current(), groups):
            record = prepare(groups, record, lock)
            write_record(record)
        if needs.openssl:
            apt.provide_openssl(lock)
        if _lacks_dds(needs, record):
            plugins = dds.provide(PYTHON, lock)
            if plugins and not dds.chosen_by_user():
                write_record(replace(record, dds=plugins))


def _lacks_dds(needs: Needs, record: Record) -> bool:
    if not needs.dds or dds.chosen_by_user():
        return False
    # A sourced ROS 2 brings its own DDS; only tests ask for Cyclone DDS besides.
    if record.ros_around and not needs.openssl:
        return False
    return record.dds is None or not Path(record.dds).is_dir()


def _run(command: str, arguments: list[str]) -> int:
    folder = VENV / "bin"
    env = {name: value for name, value in os.environ.items() if name != "PYTHONHOME"}
    env["VIRTUAL_ENV"] = str(VENV)
    env["PATH"] = f"{folder}{os.pathsep}{env.get('PATH', os.defpath)}"
    if command == "setup":
        say(f"everything is in place in {VENV}")
        return 0
    if command in ("test", "lint"):
        return checks.run(arguments, env, with_tests=command == "test")
    if command == "bench":
        os.chdir(CHECKOUT)
        return _become([str(PYTHON), "-m", "benchmarks", *arguments], env)
    verb = ["demo"] if command == "demo" else []
    return _become([str(folder / "sros"), *verb, *arguments], env)


def _become(program: list[str], env: dict[str, str]) -> NoReturn:
    """Let the program take this process over: its signals and exit status are its own."""
    os.execve(program[0], program, env)  # noqa: S606 - no shell is wanted
