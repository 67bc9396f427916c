"""The whole demo: check what was asked, make keystores, choose a backend, run the rows, answer."""

from __future__ import annotations

import json
import shutil
import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path
from tempfile import TemporaryDirectory
from types import FrameType
from typing import Any

from sros_tool.dds.domains import MAX_DOMAIN, DomainSet
from sros_tool.demo.backend import AUTO, Backend, choose_backend
from sros_tool.demo.isolated import run_isolated
from sros_tool.demo.keystores import DEFAULT_TOPIC, check_topic, make_keystores
from sros_tool.demo.runner import Limits, Plan, run_plan
from sros_tool.demo.scenarios import ROWS, Row
from sros_tool.demo.verdict import RowResult
from sros_tool.errors import UsageError
from sros_tool.keystore.template import Template
from sros_tool.runtime.netns import Isolation, try_isolation

DEFAULT_DOMAIN = 80
"""The rows take this domain and those after it: below 102, where Linux hands out no port."""

HOST = "host"
"""The choice to stay in the network of the machine."""


@dataclass(frozen=True)
class DemoOptions:
    """What was asked for; ``keep`` is the folder to leave everything in, if any."""

    template: Template
    backend: str = AUTO
    topic: str = DEFAULT_TOPIC
    domain: int = DEFAULT_DOMAIN
    network: str = AUTO
    keep: Path | None = None
    rows: tuple[Row, ...] = ROWS
    limits: Limits = field(default_factory=Limits)


@dataclass(frozen=True)
class DemoResult:
    """What the demo showed."""

    backend: Backend
    topic: str
    isolation: Isolation
    rows: tuple[RowResult, ...]

    @property
    def as_expected(self) -> bool:
        """Whether every row is as expected or skipped with a reason."""
        return all(row.as_expected for row in self.rows)

    def as_json(self) -> dict[str, Any]:
        """The result as `sros demo --json` shows it."""
        return {
            "backend": self.backend.name,
            "dds": self.backend.dds,
            "why": self.backend.why,
            "topic": self.topic,
            "own_network": self.isolation.isolated,
            "network_reason": self.isolation.reason,
            "as_expected": self.as_expected,
            "rows": [row.as_json() for row in self.rows],
        }


def run_demo(options: DemoOptions, now: datetime, tell: Callable[[str], None]) -> DemoResult:
    """Run the demo; ``tell`` gets lines about its progress.

    Raises `UsageError` before anything is made, `UnavailableError` where no DDS enforces
    security, and what making a keystore raises.
    """
    topic = check_topic(options.topic)
    domains = _domains(options)
    with _ended_by_signals(), _folder(options.keep) as folder:
        spanned = DomainSet.of((domains[0], domains[-1]))
        keystores = make_keystores(folder, topic, spanned, options.template, now)
        tell("looking for a DDS that enforces security")
        backend = choose_backend(options.backend, keystores.probe(topic, domains[0]))
        tell(f"running {len(options.rows)} rows on {backend.name} ({backend.dds}): {backend.why}")
        isolation = _isolation(options.network)
        plan = Plan(
            rows=options.rows,
            domains=domains,
            backend=backend,
            keystores=keystores,
            topic=topic,
            folder=folder / "rows",
            limits=options.limits,
        )
        rows = run_isolated(lambda told: run_plan(plan, told), isolation, tell)
        result = DemoResult(backend, topic, isolation, tuple(rows))
        if options.keep is not None:
            text = json.dumps(result.as_json(), indent=2) + "\n"
            (folder / "result.json").write_text(text, encoding="utf-8")
    return result


def _domains(options: DemoOptions) -> tuple[int, ...]:
    last = MAX_DOMAIN - len(options.rows) + 1
    if not 0 <= options.domain <= last:
        raise UsageError(
            f"the demo cannot start at domain {options.domain}",
            f"It uses {len(options.rows)} domains in a row, and the highest is {MAX_DOMAIN}.",
            f"Choose a domain from 0 to {last}.",
        )
    return tuple(range(options.domain, options.domain + len(options.rows)))


@contextmanager
def _folder(keep: Path | None) -> Iterator[Path]:
    if keep is None:
        with TemporaryDirectory(prefix="sros-demo-") as name:
            yield Path(name)
        return
    try:
        if keep.exists() and (not keep.is_dir() or any(keep.iterdir())):
            raise UsageError(
                f"cannot keep the demo in '{keep}'",
                "It exists, and is not an empty folder.",
                "Name a folder that does not exist yet.",
            )
        keep.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UsageError(
            f"cannot keep the demo in '{keep}'", f"{error.strerror}.", "Name another folder."
        ) from error
    try:
        yield keep.absolute()
    except BaseException:
        # What did not come to a result is not worth keeping, and it holds private keys.
        shutil.rmtree(keep, ignore_errors=True)
        raise


@contextmanager
def _ended_by_signals() -> Iterator[None]:
    """Clean up on SIGTERM and SIGHUP as on Ctrl-C: the folder holds private keys."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    def end(number: int, _frame: FrameType | None) -> None:
        raise SystemExit(128 + number)

    before = {number: signal.signal(number, end) for number in (signal.SIGTERM, signal.SIGHUP)}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _isolation(network: str) -> Isolation:
    if network == HOST:
        return Isolation(False, "the network of this machine was asked for")
    return try_isolation()
