"""The commands of `./dev`: the setup that each one needs, and the program that it runs."""

from __future__ import annotations

import os
import sys
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import NoReturn

from tools import apt, checks, dds, release
from tools.environment import GROUPS, prepare
from tools.record import PYTHON, Record, current, holds, read_record, write_record
from tools.steps import CHECKOUT, VENV, SetupError, locked, say

USAGE = """\
Usage: ./dev COMMAND [ARGUMENTS…]

  demo [ARGUMENTS…]   show on a real DDS that secured nodes are closed to other nodes (sros demo)
  test [ARGUMENTS…]   run ruff, mypy and pytest; ARGUMENTS go to pytest, except --long: run more
                      random and exhaustive cases, which takes much longer; and --oldest: run the
                      tests with the oldest packages that sros works with, those of Ubuntu 24.04
  lint                run only ruff and mypy
  bench [ARGUMENTS…]  run the benchmarks (python -m benchmarks)
  sros ARGUMENTS…     run the sros of this checkout
  release-check       build the packages, look for what must not be in them, and try the wheel with
                      every Python 3.11 to 3.14 that is here, with and without extras
  setup               set up everything that the other commands need, and check it again

Each command first sets up what it needs: a virtual environment in .venv; for demo and test also a
DDS that enforces security. The variable PYTHON names the Python to use instead of the one found.
"""


@dataclass(frozen=True)
class Needs:
    """The setup that a command needs: groups of packages, a DDS, and programs for the tests."""

    groups: tuple[str, ...] = ("package",)
    dds: bool = False
    for_tests: bool = False


NEEDS = {
    "demo": Needs(("package", "ros"), dds=True),
    "test": Needs(GROUPS, dds=True, for_tests=True),
    "lint": Needs(("package", "test")),
    "bench": Needs(),
    "sros": Needs(),
    "release-check": Needs(("package", "test"), dds=True),
    "setup": Needs(GROUPS, dds=True, for_tests=True),
}


def main(arguments: list[str]) -> int:
    """Run one command; return the exit status (2 for wrong usage)."""
    if arguments[:1] in (["--help"], ["-h"], ["help"]):
        print(USAGE, end="")
        return 0
    command, rest = (arguments[0], arguments[1:]) if arguments else ("", [])
    if command not in NEEDS:
        problem = f"unknown command {command!r}" if command else "a command is missing"
        print(f"dev: {problem}.\n\n{USAGE}", end="", file=sys.stderr)
        return 2
    try:
        set_up(NEEDS[command], again=command == "setup")
        return _run(command, rest)
    except SetupError as error:
        print(f"dev: {error}", file=sys.stderr)
    except OSError as error:
        where = f" {error.filename}" if error.filename else ""
        print(f"dev: cannot continue:{where} {error.strerror or error}", file=sys.stderr)
    except KeyboardInterrupt:
        print("\ndev: interrupted; run the command again to start over", file=sys.stderr)
        return 130
    return 1


def set_up(needs: Needs, *, again: bool = False) -> None:
    """Install what a command needs and the record of the last setup does not list.

    With ``again``, check and install everything, whatever the record lists.
    """
    with locked() as lock:
        record = read_record()
        groups = list(needs.groups)
        if again:
            record = replace(record, groups=[], dds=None, rmw=None)
        provide = partial(apt.provide_for_tests if needs.for_tests else _nothing, lock)
        if holds(record, current(), groups):
            provide()
        else:
            record = prepare(groups, record, lock, meanwhile=provide)
            write_record(record)
        if needs.dds and not apt.has_chosen_dds():
            with_dds = _with_dds(needs, record, lock)
            if with_dds != record:
                write_record(with_dds)


def _nothing(_lock: int) -> None:
    """Provide nothing, for commands that need no programs of the system."""


def _with_dds(needs: Needs, record: Record, lock: int) -> Record:
    """Provide a DDS that enforces security; return the record with its path."""
    if record.ros_around and not needs.for_tests:
        # The demo prefers the DDS of a sourced ROS 2; the tests also need Cyclone DDS.
        if not _exists(record.rmw):
            record = replace(record, rmw=dds.enforced_by_ros(PYTHON))
        if record.rmw:
            return record
    if not _exists(record.dds):
        record = replace(record, dds=dds.provide(PYTHON, lock))
    return record


def _exists(path: str | None) -> bool:
    return path is not None and Path(path).exists()


def _run(command: str, arguments: list[str]) -> int:
    folder = VENV / "bin"
    # Compiled once, and not again by each of the hundreds of programs that the tests start.
    unwanted = ("PYTHONHOME", "PYTHONDONTWRITEBYTECODE")
    env = {name: value for name, value in os.environ.items() if name not in unwanted}
    env["VIRTUAL_ENV"] = str(VENV)
    env["PATH"] = f"{folder}{os.pathsep}{env.get('PATH', os.defpath)}"
    if command == "setup":
        say(f"the setup in {VENV} is done")
        return 0
    if command in ("test", "lint"):
        return checks.run(arguments, env, with_tests=command == "test")
    if command == "release-check":
        return release.check()
    if command == "bench":
        os.chdir(CHECKOUT)
        return _become([str(PYTHON), "-m", "benchmarks", *arguments], env)
    verb = ["demo"] if command == "demo" else []
    return _become([str(folder / "sros"), *verb, *arguments], env)


def _become(program: list[str], env: dict[str, str]) -> NoReturn:
    """Replace this process by the program, so that signals and exit status are its own."""
    os.execve(program[0], program, env)
