"""The whole demo: check what was asked, make keystores, choose a backend, run scenarios, answer."""

from __future__ import annotations

import json
import shutil
import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from datetime import datetime
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from types import FrameType

from sros_tool.dds.domains import MAX_DOMAIN, DomainSet
from sros_tool.demo.backend import AUTO, Backend, choose_backend
from sros_tool.demo.conditions import conditions
from sros_tool.demo.isolated import run_isolated
from sros_tool.demo.model import Row, Scenario
from sros_tool.demo.policies import DEFAULT_TOPIC, check_topic
from sros_tool.demo.result import DemoResult, ScenarioResult
from sros_tool.demo.runner import Limits, Plan, run_plan
from sros_tool.demo.scenarios.isolation import ISOLATION
from sros_tool.demo.scenery import Scenery, Setting, build_scenery
from sros_tool.errors import UsageError
from sros_tool.keystore.template import Template
from sros_tool.runtime.netns import Isolation, try_isolation

DEFAULT_DOMAIN = 80
"""The rows take this domain and those after it: below 102, where Linux hands out no port."""

HOST = "host"
"""The choice to stay in the network of the machine."""


@dataclass(frozen=True)
class DemoOptions:
    """What was asked for; ``keep`` is the folder to leave everything in, if any.

    ``only`` leaves those rows whose names contain one of its words.
    """

    template: Template
    backend: str = AUTO
    topic: str = DEFAULT_TOPIC
    domain: int = DEFAULT_DOMAIN
    network: str = AUTO
    keep: Path | None = None
    scenarios: tuple[Scenario, ...] = (ISOLATION,)
    only: tuple[str, ...] = ()
    limits: Limits = field(default_factory=Limits)


Tell = Callable[[str], None]


def run_demo(options: DemoOptions, now: datetime, tell: Tell) -> DemoResult:
    """Run the demo; ``tell`` gets lines about its progress.

    Raises `UsageError` before anything is made, `UnavailableError` where no DDS enforces
    security, and what making a keystore raises.
    """
    topic = check_topic(options.topic)
    scenarios = [_chosen(scenario, options) for scenario in options.scenarios]
    domains = [_domains(scenario, options) for scenario in scenarios]
    isolation = _isolation(options.network)
    results: list[ScenarioResult] = []
    backend: Backend | None = None
    with _ended_by_signals(), _folder(options.keep) as folder:
        for scenario, places in zip(scenarios, domains, strict=True):
            under = folder if len(scenarios) == 1 else folder / scenario.name
            spanned = DomainSet.of((places[0], places[-1]))
            setting = Setting(topic, spanned, options.template, now)
            scenery = build_scenery(under, scenario, setting)
            if backend is None:
                tell("looking for a DDS that enforces security")
                backend = choose_backend(options.backend, scenery.probe(topic, places[0]))
            tell(
                f"{scenario.name}: running {len(scenario.rows)} rows on {backend.name}"
                f" ({backend.dds}): {backend.why}"
            )
            holding = conditions(backend, options.template, topic)
            scenario = replace(scenario, rows=tuple(row.under(holding) for row in scenario.rows))
            plan = _plan(options, scenario, places, backend, scenery, topic, under, isolation)
            rows = run_isolated(partial(run_plan, plan), isolation, tell)
            results.append(ScenarioResult(scenario.name, scenario.title, tuple(rows)))
        assert backend is not None
        result = DemoResult(backend, topic, isolation, options.template.name, tuple(results))
        if options.keep is not None:
            text = json.dumps(result.as_json(), indent=2) + "\n"
            (folder / "result.json").write_text(text, encoding="utf-8")
    return result


def _plan(
    options: DemoOptions,
    scenario: Scenario,
    domains: tuple[int, ...],
    backend: Backend,
    scenery: Scenery,
    topic: str,
    folder: Path,
    isolation: Isolation,
) -> Plan:
    return Plan(
        rows=scenario.rows,
        domains=domains,
        backend=backend,
        scenery=scenery,
        topic=topic,
        folder=folder / "rows",
        limits=options.limits,
        own_networks=isolation.isolated,
    )


def _chosen(scenario: Scenario, options: DemoOptions) -> Scenario:
    """The scenario with the rows that were asked for."""
    if not options.only:
        return scenario
    return replace(scenario, rows=tuple(row for row in scenario.rows if _asked_for(row, options)))


def _asked_for(row: Row, options: DemoOptions) -> bool:
    return any(word.lower() in f"{row.attack} {row.name}".lower() for word in options.only)


def _domains(scenario: Scenario, options: DemoOptions) -> tuple[int, ...]:
    last = MAX_DOMAIN - len(scenario.rows) + 1
    if not 0 <= options.domain <= last:
        raise UsageError(
            f"the demo cannot start at domain {options.domain}",
            f"It uses {len(scenario.rows)} domains in a row, and the highest is {MAX_DOMAIN}.",
            f"Choose a domain from 0 to {last}.",
        )
    return tuple(range(options.domain, options.domain + len(scenario.rows)))


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
