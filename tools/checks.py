"""The commands test and lint: format, lint, types and tests, with a summary line at the end."""

from __future__ import annotations

import os
import resource
import shutil
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Mapping
from contextlib import ExitStack
from pathlib import Path
from random import SystemRandom
from xml.etree import ElementTree

from tools.record import PYTHON, read_record
from tools.steps import CHECKOUT, VENV, SetupError, log_tail, say, succeeds

_PLUGINS = "_hypothesis_pytestplugin"

LONG = "--long"
"""The argument for more random and exhaustive cases; like the variable SROS_LONG."""

OLDEST = "--oldest"
"""The argument for the oldest packages that sros works with, in place of those in .venv."""

OLDEST_PACKAGES = ("click==8.1.6", "cryptography==41.0.7", "lxml==5.2.1")
"""The packages of Ubuntu 24.04, which ROS 2 Jazzy and Kilted have."""

QUICK = ("--assert=plain", "-p", "no:logging")
"""pytest's arguments for assertions as Python compiles them, and for no record of what is logged.

To make all assertions tell their values takes pytest 19 s of CPU, and a test that passes tells
none; of each test, three parts have their own record.
"""

WITH_VALUES = ("-m", "pytest", "--last-failed", "--last-failed-no-failures=none", "--maxfail=20")
"""Python's arguments for the tests that failed, with assertions that tell their values."""

FORKED = ("-p", "tools.forked_tests", "--processes")
"""pytest's arguments before a number of processes."""

LINT = {
    "ruff check": ["-m", "ruff", "check", "--quiet"],
    "ruff format": ["-m", "ruff", "format", "--check", "--quiet"],
    "mypy": ["-m", "mypy", "--no-error-summary"],
}


def run(arguments: list[str], env: Mapping[str, str], *, with_tests: bool) -> int:
    """Run every check, even after failures; return the worst exit status.

    With the oldest packages only the tests run: ruff and mypy check against the newest.

    Ruff and mypy run beside the tests; their output is shown after that of the tests.  Without
    ``arguments``, the tests run in more processes than there are cores: those that start DDS
    processes often wait.  With ``arguments``, pytest runs in one process, with these arguments.
    """
    started = time.monotonic()
    if LONG in arguments:
        arguments = [each for each in arguments if each != LONG]
        env = {**env, "SROS_LONG": "1"}
    lint = LINT
    if not (CHECKOUT / ".mypy_cache").exists():
        # Writing what only another run could use takes a seventh of the time; `lint` does.
        lint = LINT | {"mypy": [*LINT["mypy"], "--cache-dir", os.devnull]}
    if OLDEST in arguments:
        arguments = [each for each in arguments if each != OLDEST]
        env, lint = _with_oldest_packages(env), {}
    if read_record().ros_around or not arguments:
        # ROS 2 installs pytest plugins that are made for other versions of pytest, and colcon some
        # that look at each test and that only arguments make use of.
        env = {**env, "PYTEST_DISABLE_PLUGIN_AUTOLOAD": "1", "PYTEST_PLUGINS": _PLUGINS}
    if not with_tests:
        return _conclude(_run_together(LINT, "mypy", env), Counter(), started)
    if arguments:
        steps = lint | {"pytest": ["-m", "pytest", *arguments]}
        return _conclude(_run_together(steps, "pytest", env), Counter(), started)
    report = VENV / "tests.xml"
    report.unlink(missing_ok=True)
    env = {"SROS_SEED": str(SystemRandom().randrange(1_000_000)), **env}
    processes = str(2 * len(os.sched_getaffinity(0)) + 1)
    words = ["-m", "pytest", *QUICK, *FORKED, processes, f"--junit-xml={report}"]
    results = _run_together(lint | {"tests": words}, "tests", env)
    if results["tests"] == 1:
        with _Step("tests that failed, again, for their values", [*WITH_VALUES], env) as again:
            again.end()
    return _conclude(results, count(report), started)


def _with_oldest_packages(env: Mapping[str, str]) -> dict[str, str]:
    """Install the oldest packages into a folder; return an environment that prefers them.

    Raises:
        SetupError: they cannot be installed.
    """
    folder = VENV / "oldest"
    say(f"installing {', '.join(OLDEST_PACKAGES)} into {folder}")
    shutil.rmtree(folder, ignore_errors=True)
    words = ["-m", "pip", "install", "--progress-bar=off", "--no-deps", "--target", str(folder)]
    if not succeeds([PYTHON, *words, *OLDEST_PACKAGES]):
        raise SetupError(f"pip cannot install them. {log_tail()}")
    return {**env, "PYTHONPATH": str(folder)}


def _run_together(
    steps: Mapping[str, list[str]], shown: str, env: Mapping[str, str]
) -> dict[str, int]:
    """Run steps at the same time; show the output of one as it comes, and of the others later."""
    with ExitStack() as running:
        # The step with direct output is started last, and usually ends first.
        order = sorted(steps, key=lambda name: (name not in LINT, name == shown))
        begun = {}
        for name in order:
            step = _Step(name, steps[name], env, aside=name != shown)
            begun[name] = running.enter_context(step)
        ended = {name: begun[name].end() for name in reversed(order)}
    return {name: ended[name] for name in steps}


def _conclude(results: Mapping[str, int], counts: Counter[str], started: float) -> int:
    verdicts = [f"{name} {_verdict(status)}" for name, status in results.items()]
    if counts:
        verdicts.append(", ".join(f"{number} {word}" for word, number in counts.items()))
    took = f"{time.monotonic() - started:.0f} s, {_cpu_seconds():.0f} s of CPU with the set-up"
    print(f"\n{'; '.join(verdicts)} ({took})", flush=True)
    return max(results.values(), default=0)


def _cpu_seconds() -> float:
    """Return the CPU time, in seconds, of all processes that this one has started and that ended.

    Unlike the time on the clock, it grows with the tests and hardly with other work of the machine.
    """
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def count(report: Path) -> Counter[str]:
    """Return how many tests passed, failed and were skipped, from pytest's JUnit report."""
    try:
        suites = ElementTree.parse(report).getroot().iter("testsuite")  # noqa: S314 - our own
    except (OSError, ElementTree.ParseError):
        return Counter()
    found: Counter[str] = Counter()
    for suite in suites:
        numbers = {
            key: int(suite.get(key, "0")) for key in ("tests", "failures", "errors", "skipped")
        }
        failed = numbers["failures"] + numbers["errors"]
        found["passed"] += numbers["tests"] - failed - numbers["skipped"]
        found["failed"] += failed
        found["skipped"] += numbers["skipped"]
    return found


class _Step:
    """A running check; with ``aside``, its output is kept in a log until `end` shows it."""

    def __init__(
        self, name: str, words: list[str], env: Mapping[str, str], *, aside: bool = False
    ) -> None:
        self._name = name
        self._output = (VENV / f"{name.replace(' ', '-')}.log").open("w+b") if aside else None
        if not aside:
            _say(name)
        self._process = subprocess.Popen(
            [PYTHON, *words], cwd=CHECKOUT, env=env, stdout=self._output, stderr=self._output
        )

    def end(self) -> int:
        """Wait for the end, show the kept output, and return the exit status."""
        status = self._process.wait()
        if self._output:
            _say(self._name)
            self._output.seek(0)
            sys.stdout.buffer.write(self._output.read())
            sys.stdout.flush()
        return status if status >= 0 else 128 - status

    def __enter__(self) -> _Step:
        return self

    def __exit__(self, *_: object) -> None:
        if self._process.poll() is None:  # interrupted
            self._process.terminate()
            self._process.wait()
        if self._output:
            self._output.close()


def _say(name: str) -> None:
    print(f"dev: {name}", file=sys.stderr, flush=True)


def _verdict(status: int) -> str:
    return "ok" if status == 0 else f"FAILED ({status})"
