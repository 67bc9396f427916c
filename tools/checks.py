"""The test command: format, lint, types and tests, all of them run, one line at the end."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from xml.etree import ElementTree

from tools.record import PYTHON, read_record
from tools.steps import CHECKOUT, VENV

_NOTHING_COLLECTED = 5
"""pytest's exit status when a selection matches no test."""

_PLUGINS = "xdist.plugin,_hypothesis_pytestplugin"

LINTERS = {
    "ruff check": ["-m", "ruff", "check", "--quiet"],
    "ruff format": ["-m", "ruff", "format", "--check", "--quiet"],
    "mypy": ["-m", "mypy", "--no-error-summary"],
}


def run(arguments: list[str], env: Mapping[str, str], *, with_tests: bool) -> int:
    """Run every check whatever the others say; return the worst exit status.

    Without ``arguments`` the tests that start DDS processes run by themselves, after the others
    have used all cores, and more of them at once than there are cores: each is in a network of its
    own and mostly waits for real time to pass.  With ``arguments`` pytest runs once, with just
    these.
    """
    started = time.monotonic()
    if read_record().ros_around:
        # ROS 2 brings pytest plugins of its own, made for other versions of pytest.
        env = {**env, "PYTEST_DISABLE_PLUGIN_AUTOLOAD": "1", "PYTEST_PLUGINS": _PLUGINS}
    results = {name: _python(words, env, name) for name, words in LINTERS.items()}
    counts: Counter[str] = Counter()
    if with_tests and not arguments:
        # The table is shown, not judged: how fast a shared machine is proves nothing.
        results["benchmarks"] = _python(["-m", "benchmarks", "--rounds", "1"], env, "benchmarks")
    if with_tests and arguments:
        results["pytest"] = _python(["-m", "pytest", *arguments], env, "pytest")
    elif with_tests:
        cores = len(os.sched_getaffinity(0))
        parts = {
            "tests": ["-m", "not dds", "-n", str(cores)],
            "tests on a real DDS": ["-m", "dds", "-n", str(2 * cores), "--dist", "loadscope"],
        }
        for name, words in parts.items():
            report = VENV / f"{name.replace(' ', '-')}.xml"
            report.unlink(missing_ok=True)
            command = ["-m", "pytest", *words, f"--junit-xml={report}"]
            status = _python(command, env, name)
            results[name] = 0 if status == _NOTHING_COLLECTED else status
            counts += count(report)
    verdicts = [f"{name} {_verdict(status)}" for name, status in results.items()]
    if counts:
        verdicts.append(", ".join(f"{number} {word}" for word, number in counts.items()))
    print(f"\n{'; '.join(verdicts)} ({time.monotonic() - started:.0f} s)", flush=True)
    return max(results.values(), default=0)


def count(report: Path) -> Counter[str]:
    """How many tests passed, failed and were skipped, as pytest's JUnit report tells."""
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


def _python(words: list[str], env: Mapping[str, str], name: str) -> int:
    print(f"dev: {name}", file=sys.stderr, flush=True)
    ended = subprocess.run([PYTHON, *words], cwd=CHECKOUT, env=env, check=False)
    return ended.returncode if ended.returncode >= 0 else 128 - ended.returncode


def _verdict(status: int) -> str:
    return "ok" if status == 0 else f"FAILED ({status})"
