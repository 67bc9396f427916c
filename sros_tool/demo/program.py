"""Run the whole demo: check options, make keystores, choose a backend, run scenarios."""

from __future__ import annotations

import itertools
import json
import shutil
import signal
import socket
import threading
import time
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from datetime import datetime
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from types import FrameType

from sros_tool.dds.advisories import Advisory
from sros_tool.dds.domains import MAX_DOMAIN, DomainSet
from sros_tool.demo.backend import (
    AUTO,
    RCLPY,
    ZENOH,
    Backend,
    choose_backend,
    conditions,
    zenoh_backend,
)
from sros_tool.demo.casting import CastMember, UserKeystore, open_user_keystore
from sros_tool.demo.keystores import KeystoreSpec, create_keystores
from sros_tool.demo.result import (
    DemoResult,
    KeystoreSummary,
    RowResult,
    ScenarioResult,
    used_libraries,
)
from sros_tool.demo.runner import Limits, RunPlan, run_rows
from sros_tool.demo.scenarios.communication import ISOLATION
from sros_tool.demo.scenarios.model import Row, Scenario, joined
from sros_tool.demo.scenarios.policies import DEFAULT_TOPIC, check_topic
from sros_tool.errors import UnavailableError, UsageError
from sros_tool.keystore.template import Template, load_template
from sros_tool.names import dds_names
from sros_tool.runtime.netns import Isolation, Progress, run_isolated, try_isolation
from sros_tool.values import versioned

_DEFAULT_DOMAIN = 80
"""First ROS domain of the rows; below 102, so that Linux does not assign its ports."""

_DEFAULT_TEMPLATE = "production"

_ENDPOINT = "localhost:7447"
"""Endpoint of the Zenoh routers; every router has a network of its own."""

_ZENOH_WINDOW = 2.0
"""Length of a row's observation on Zenoh, in seconds."""

_HOST = "host"
"""Value of --network that stands for the network of this machine."""


@dataclass(frozen=True)
class DemoOptions:
    """The options of a demo; ``keep`` is the folder for all files (None: deleted at the end).

    ``keystore`` is a keystore of the user, a copy of which is attacked.  The default ``template``
    is the template of that keystore, or production; the default ``topic`` is one that the cast may
    use.  ``only`` selects the rows whose names contain one of its words.  ``accept_open`` names the
    rows of attacks that may succeed because of the user's keystore.  ``advisories`` are the known
    DDS vulnerabilities; None for those that ship with sros.
    """

    template: Template | None = None
    backend: str = AUTO
    topic: str | None = None
    domain: int = _DEFAULT_DOMAIN
    network: str = AUTO
    keep: Path | None = None
    scenarios: tuple[Scenario, ...] = (ISOLATION,)
    keystore: Path | None = None
    only: tuple[str, ...] = ()
    accept_open: tuple[str, ...] = ()
    limits: Limits = field(default_factory=Limits)
    advisories: tuple[Advisory, ...] | None = None


def run_demo(options: DemoOptions, now: datetime, progress: Progress) -> DemoResult:
    """Run the demo and return its result; ``progress`` is called with lines while it runs.

    Raises:
        UsageError: an option is wrong; nothing was created.
        UnavailableError: no DDS enforces security here.
        SrosError: a keystore could not be made.
    """
    zenoh = zenoh_backend() if options.backend == ZENOH else None
    if zenoh and options.keystore is not None:
        raise UsageError(
            "--keystore cannot be used with --backend zenoh",
            "The demo on Zenoh attacks keystores of its own.",
            "Leave out one of them.",
        )
    user = _user_keystore(options, now)
    if user:
        options = replace(options, scenarios=(_with_rows_of(user, options.scenarios[0]),))
    _check_accepted(options)
    template = options.template or (user.template if user else load_template(_DEFAULT_TEMPLATE))
    topic = options.topic
    topic = check_topic((user.topic if user else DEFAULT_TOPIC) if topic is None else topic)
    scenarios = _with_chosen_rows(options)
    isolation = _isolation(options.network)
    groups = [joined(scenarios)] if zenoh else list(scenarios)
    domains = [_domains(scenario, options, user, isolation) for scenario in groups]
    started = time.monotonic()
    results: list[ScenarioResult] = []
    names: dict[str, None] = {}
    with _ended_by_signals(), _folder(options.keep) as folder:
        if zenoh is None:
            progress("looking for a DDS that enforces security")
        backend = zenoh or find_backend(options.backend, folder, topic, now)
        for scenario, row_domains in zip(groups, domains, strict=True):
            scenario_folder = folder if len(groups) == 1 else folder / scenario.name
            keystore_domains = (
                user.domains if user else DomainSet.of((row_domains[0], row_domains[-1]))
            )
            endpoint = _ENDPOINT if isolation.isolated else f"localhost:{_free_port()}"
            spec = KeystoreSpec(topic, keystore_domains, template, now, endpoint)
            rows = tuple(_expected(row, backend, template, topic) for row in scenario.rows)
            if user:
                strong = load_template(_DEFAULT_TEMPLATE)
                rows = tuple(
                    _gated(
                        user.opened(row, topic), _expected(same, backend, strong, topic), options
                    )
                    for row, same in zip(rows, scenario.rows, strict=True)
                )
            scenario = replace(scenario, rows=rows)
            keystores = create_keystores(scenario_folder, scenario, spec, user)
            names |= dict.fromkeys(
                f"{party.role.uses} {keystores.topic(party, topic)}"
                for row in scenario.rows
                for party in row.parties
                if not party.other_topic
            )
            progress(
                f"{scenario.name}: running {len(scenario.rows)} rows on {backend.name}"
                f" ({backend.dds}): {backend.why}"
            )
            plan = RunPlan(
                rows=scenario.rows,
                domains=row_domains,
                backend=backend,
                keystores=keystores,
                topic=topic,
                folder=scenario_folder / "rows",
                limits=replace(options.limits, window=_ZENOH_WINDOW) if zenoh else options.limits,
                own_networks=isolation.isolated,
                started=started,
            )
            row_results = run_isolated(partial(run_rows, plan), isolation, progress)
            if zenoh:
                results += _parted(scenarios, row_results)
                continue
            cast = keystores.members(scenario.rows, on_ros=backend.name == RCLPY) if user else ()
            summary = (
                KeystoreSummary(user.enclaves, user.elsewhere, user.not_tried) if user else None
            )
            results.append(_result_of(scenario, row_results, cast, summary))
        left_out = sum(len(scenario.rows) for scenario in options.scenarios)
        left_out -= sum(len(scenario.rows) for scenario in results)
        result = DemoResult(
            backend=backend.name,
            dds=backend.dds,
            why=backend.why,
            template=template.name,
            topic=topic,
            names=tuple(names),
            own_network=isolation.isolated,
            network_reason=isolation.reason,
            scenarios=tuple(results),
            left_out=left_out,
            libraries=used_libraries(
                (row for scenario in results for row in scenario.rows), options.advisories
            ),
        )
        if options.keep is not None:
            text = json.dumps(versioned(result), indent=2) + "\n"
            (folder / "result.json").write_text(text, encoding="utf-8")
    return result


def _result_of(
    scenario: Scenario,
    rows: Iterable[RowResult],
    cast: tuple[CastMember, ...] = (),
    attacked: KeystoreSummary | None = None,
) -> ScenarioResult:
    rows = tuple(replace(row, scenario=scenario.name) for row in rows)
    return ScenarioResult(scenario.name, scenario.title, rows, cast, attacked)


def _parted(scenarios: Sequence[Scenario], rows: Sequence[RowResult]) -> Iterator[ScenarioResult]:
    """Yield the result of each scenario in order; the rows of several scenarios ran together."""
    left = iter(rows)
    for scenario in scenarios:
        own = itertools.islice(left, len(scenario.rows))
        yield _result_of(scenario, own)


def _expected(row: Row, backend: Backend, template: Template, topic: str) -> Row:
    """Return the row with the outcome that a keystore from this template should give."""
    return row.under(conditions(backend, template, _dds_topic(row, topic)))


def _gated(row: Row, strong: Row, options: DemoOptions) -> Row:
    """Return the row, marked as accepted, or as open although the default template prevents it."""
    opened = bool(row.open_because) and not strong.open_because
    accepted = row.name in options.accept_open
    return replace(row, accepted=accepted, unaccepted=opened and not accepted)


def _check_accepted(options: DemoOptions) -> None:
    """Raise if --accept-open names rows that do not exist.

    Raises:
        UsageError: there is no keystore of the user, or no row with such a name.
    """
    if options.accept_open and options.keystore is None:
        raise UsageError(
            "--accept-open is given without --keystore",
            "Only attacks that your own keystore allows can be accepted.",
            "Leave it out, or name the keystore.",
        )
    rows = {row.name for scenario in options.scenarios for row in scenario.rows if not row.removed}
    for name in options.accept_open:
        if name not in rows:
            raise UsageError(
                f"no row of an attack is named {name!r}",
                "",
                "Copy the whole name from the demo's table.",
            )


def find_backend(wish: str, folder: Path, topic: str, now: datetime) -> Backend:
    """Return a backend that enforces security; a temporary keystore is used to try."""
    with TemporaryDirectory(dir=folder, prefix="probe-") as probed:
        domains = DomainSet.of((_DEFAULT_DOMAIN, _DEFAULT_DOMAIN))
        spec = KeystoreSpec(topic, domains, load_template(_DEFAULT_TEMPLATE), now)
        keystores = create_keystores(Path(probed), replace(ISOLATION, rows=()), spec)
        return choose_backend(wish, keystores.probe(topic, _DEFAULT_DOMAIN))


def _user_keystore(options: DemoOptions, now: datetime) -> UserKeystore | None:
    """Return the user's keystore; None if no keystore is given.

    Raises:
        UsageError: a scenario cannot use the user's keystore.
    """
    if options.keystore is None:
        return None
    for scenario in options.scenarios:
        if not scenario.any_keystore:
            raise UsageError(
                f"the scenario {scenario.name} cannot run in a keystore of yours",
                "It needs enclaves with the rights of the scenario's policy.",
                "Use --keystore with --scenario attacks alone.",
            )
    topic = "" if options.topic is None else check_topic(options.topic)
    return open_user_keystore(options.keystore, topic, options.scenarios[0], now)


def _with_rows_of(user: UserKeystore, scenario: Scenario) -> Scenario:
    """Return the scenario with additional rows for the user's keystore."""
    return replace(scenario, rows=(*scenario.rows, *user.rows))


def _with_chosen_rows(options: DemoOptions) -> tuple[Scenario, ...]:
    """Return the scenarios reduced to the rows that --only selects.

    Raises:
        UsageError: --only selects no row.
    """
    if not options.only:
        return options.scenarios
    chosen = tuple(
        replace(scenario, rows=rows)
        for scenario in options.scenarios
        if (rows := tuple(row for row in scenario.rows if _is_selected(row, options)))
    )
    if not chosen:
        raise UsageError(
            f"no row has {' or '.join(map(repr, options.only))} in its name",
            f"The scenarios are {', '.join(scenario.name for scenario in options.scenarios)}.",
            "Run without --only to see the names of the rows.",
        )
    return chosen


def _dds_topic(row: Row, topic: str) -> str:
    """Return the DDS topic whose protection matters for a row; for a service, its request topic."""
    return dds_names("request", row.ros_name).publish[0] if row.ros_name else f"rt{topic}"


def _is_selected(row: Row, options: DemoOptions) -> bool:
    return any(word.lower() in f"{row.attack} {row.name}".lower() for word in options.only)


def _domains(
    scenario: Scenario, options: DemoOptions, user: UserKeystore | None, isolation: Isolation
) -> tuple[int, ...]:
    """Return a domain for each row; with a user's keystore, always its first domain."""
    if user is not None:
        if not isolation.isolated:
            raise UnavailableError(
                "cannot attack a keystore here",
                f"Each row needs a separate network namespace ({isolation.reason}).",
                "Run it as root, or where unprivileged user namespaces are allowed.",
            )
        return (next(iter(user.domains)),) * len(scenario.rows)
    if scenario.router:  # every row has a router of its own
        if not 0 <= options.domain <= MAX_DOMAIN:
            raise UsageError(
                f"the demo cannot run in domain {options.domain}",
                f"The highest domain is {MAX_DOMAIN}.",
                f"Choose a domain from 0 to {MAX_DOMAIN}.",
            )
        return (options.domain,) * len(scenario.rows)
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
                f"cannot keep the files of the demo in '{keep}'",
                "It exists and is not an empty folder.",
                "Name a folder that does not exist yet.",
            )
        keep.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UsageError(
            f"cannot keep the files of the demo in '{keep}'",
            f"{error.strerror}.",
            "Name another folder.",
        ) from error
    try:
        yield keep.absolute()
    except BaseException:
        # Without a result, delete the folder: it contains private keys.
        shutil.rmtree(keep, ignore_errors=True)
        raise


@contextmanager
def _ended_by_signals() -> Iterator[None]:
    """Clean up after SIGTERM and SIGHUP as after Ctrl-C: the folder has private keys."""
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


def _free_port() -> int:
    """Return an unused TCP port of this host."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port: int = free.getsockname()[1]
        return port


def _isolation(network: str) -> Isolation:
    if network == _HOST:
        return Isolation(False, "--network host was given")
    return try_isolation()
