"""Run the whole demo: check options, make keystores, choose a backend, run the rows of scenarios.

The observation of a row starts when all its processes are ready, also on a busy machine. The
observation has the same length for expected silence and expected messages; only a brief row that
expects no silence ends early.  No process outlives the process that started it.
"""

from __future__ import annotations

import asyncio
import itertools
import json
import logging
import math
import os
import shlex
import shutil
import signal
import socket
import subprocess
import threading
import time
import uuid
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from datetime import datetime
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from types import FrameType
from typing import NamedTuple

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
from sros_tool.demo.keystores import KeystoreSet, KeystoreSpec, create_keystores
from sros_tool.demo.result import (
    DemoResult,
    KeystoreSummary,
    PartyRecord,
    RowRecord,
    RowResult,
    ScenarioResult,
    judge_row,
    used_libraries,
)
from sros_tool.demo.scenarios.communication import ISOLATION
from sros_tool.demo.scenarios.model import (
    CALLING,
    DEFAULT_TOPIC,
    DENIALS,
    SPEAKING,
    Claim,
    Party,
    Relation,
    Role,
    Row,
    RowStatus,
    Scenario,
    Wire,
    check_topic,
    merged_row,
    merged_scenario,
)
from sros_tool.demo.wire import (
    Injection,
    Wiretap,
    bound_ports,
    mapped_segments,
    segments_with_text,
    with_changed_bit,
)
from sros_tool.errors import UnavailableError, UsageError
from sros_tool.keystore.issuing.keyring import Secrets, no_secrets
from sros_tool.keystore.template import Template, load_template
from sros_tool.names import dds_names
from sros_tool.parallel import end_with_starter
from sros_tool.runtime.events import Event, EventKind, EventReader
from sros_tool.runtime.netns import (
    ENDING_SIGNALS,
    Isolation,
    Progress,
    RowNetwork,
    run_isolated,
    try_isolation,
)
from sros_tool.runtime.processes import MappedLibrary, dds_of
from sros_tool.runtime.vendor_log import plain_text
from sros_tool.values import versioned
from sros_tool.wording import counted

_DEFAULT_DOMAIN = 80
"""First ROS domain of the rows; below 102, so that Linux does not assign its ports."""

_DEFAULT_TEMPLATE = "production"

_ROUTER_ENDPOINT = "localhost:7447"
"""Endpoint of the Zenoh routers; every router has a separate network."""

_ZENOH_WINDOW = 2.0
"""Length of a row's observation on Zenoh, in seconds."""

_HOST = "host"
"""Value of --network that stands for the network of this machine."""


@dataclass(frozen=True)
class Limits:
    """Time limits in seconds: for the start, for the observation of a row, and for all rows.

    An observation without a result after ``window`` goes on for up to ``longest_window``.  ``wave``
    is for one group of parallel rows, so that many rows get more time than ``total``.  All limits
    except ``window`` exist only to detect hanging processes, also on slow machines.
    """

    start: float = 60.0
    window: float = 5.0
    longest_window: float = 30.0
    total: float = 180.0
    wave: float = 90.0


@dataclass(frozen=True)
class DemoOptions:
    """The options of a demo; ``keep`` is the folder for all files (None: deleted at the end).

    ``keystore`` is a user's keystore; the demo attacks a copy.  The default ``template`` is the
    template of that keystore, or production; the default ``topic`` is a topic that the cast may
    use. ``only`` has words, and selects the rows whose names contain such a word.  ``accept_open``
    names the rows of attacks that may succeed because of the user's keystore.  ``advisories`` are
    the known DDS vulnerabilities; None means the advisories that ship with sros.  ``secrets``
    returns the passphrases of the CA keys in ``keystore``.
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
    secrets: Secrets = no_secrets


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
            "Leave out one of the two options.",
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
    groups = [merged_scenario(scenarios)] if zenoh else list(scenarios)
    domains = [_domains(scenario, options, user, isolation) for scenario in groups]
    started = time.monotonic()
    results: list[ScenarioResult] = []
    names: dict[str, None] = {}
    with _clean_up_after_signals(), _demo_folder(options.keep) as folder:
        if zenoh is None:
            progress("looking for a DDS that enforces security")
        backend = zenoh or find_backend(options.backend, folder, topic, now)
        for scenario, row_domains in zip(groups, domains, strict=True):
            scenario_folder = folder if len(groups) == 1 else folder / scenario.name
            keystore_domains = (
                user.domains if user else DomainSet.of((row_domains[0], row_domains[-1]))
            )
            endpoint = _ROUTER_ENDPOINT if isolation.isolated else f"localhost:{_free_port()}"
            spec = KeystoreSpec(topic, keystore_domains, template, now, endpoint)
            rows = tuple(_with_expectation(row, backend, template, topic) for row in scenario.rows)
            if user:
                strong = load_template(_DEFAULT_TEMPLATE)
                rows = tuple(
                    _with_acceptance(
                        user.row_if_allowed(row, topic),
                        _with_expectation(scenario_row, backend, strong, topic),
                        options,
                    )
                    for row, scenario_row in zip(rows, scenario.rows, strict=True)
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
                f"{scenario.name}: running {counted(len(scenario.rows), 'row')} on {backend.name}"
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
                results += _scenario_results(scenarios, row_results)
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


def _scenario_results(
    scenarios: Sequence[Scenario], rows: Sequence[RowResult]
) -> Iterator[ScenarioResult]:
    """Yield the result of each scenario in order; ``rows`` has the rows of all scenarios."""
    left = iter(rows)
    for scenario in scenarios:
        own_results = itertools.islice(left, len(scenario.rows))
        yield _result_of(scenario, own_results)


def _with_expectation(row: Row, backend: Backend, template: Template, topic: str) -> Row:
    """Return the row with the outcome that a keystore from this template should give."""
    return row.with_expected_status(conditions(backend, template, _dds_topic(row, topic)))


def _with_acceptance(row: Row, strong_row: Row, options: DemoOptions) -> Row:
    """Return the row with its fields ``accepted`` and ``unaccepted`` set.

    An attack that the user's keystore allows, and a strong template (``strong_row``) does not, is
    unaccepted unless --accept-open names the row.
    """
    opened = bool(row.open_because) and not strong_row.open_because
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
            "Leave out --accept-open, or add --keystore KEYSTORE.",
        )
    rows = {
        row.name
        for scenario in options.scenarios
        for row in scenario.rows
        if not row.defence_removed
    }
    for name in options.accept_open:
        if name not in rows:
            raise UsageError(
                f"no row of an attack is named {name!r}",
                "",
                "Copy the whole name from the demo's table.",
            )


def find_backend(wished_backend: str, folder: Path, topic: str, now: datetime) -> Backend:
    """Return a backend that enforces security, after trying it with a temporary keystore."""
    with TemporaryDirectory(dir=folder, prefix="probe-") as probed:
        domains = DomainSet.of((_DEFAULT_DOMAIN, _DEFAULT_DOMAIN))
        spec = KeystoreSpec(topic, domains, load_template(_DEFAULT_TEMPLATE), now)
        keystores = create_keystores(Path(probed), replace(ISOLATION, rows=()), spec)
        return choose_backend(wished_backend, keystores.probe(topic, _DEFAULT_DOMAIN))


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
                f"the scenario {scenario.name} cannot run in your keystore",
                "The scenario needs enclaves with the rights of its own policy.",
                "Use --keystore only with --scenario attacks.",
            )
    topic = "" if options.topic is None else check_topic(options.topic)
    user = open_user_keystore(options.keystore, topic, options.scenarios[0], now)
    return user._replace(secrets=options.secrets)


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
                "Run the demo as root, or where unprivileged user namespaces are allowed.",
            )
        return (next(iter(user.domains)),) * len(scenario.rows)
    if scenario.router:  # each row has its own router, so domains may repeat
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
            f"The demo uses {counted(len(scenario.rows), 'consecutive domain')}; the highest "
            f"possible domain is {MAX_DOMAIN}.",
            f"Choose a domain from 0 to {last}.",
        )
    return tuple(range(options.domain, options.domain + len(scenario.rows)))


@contextmanager
def _demo_folder(keep: Path | None) -> Iterator[Path]:
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
def _clean_up_after_signals() -> Iterator[None]:
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


_LOG = logging.getLogger(__name__)

_POLL_SECONDS = 0.05
"""Seconds between two reads of the processes' reports."""

_GRACE_SECONDS = 0.3
"""Seconds in which messages on the wire may still arrive after the observation."""


class _TimeLimits(NamedTuple):
    """Time limits in seconds, which are longer when an undecided row is tried again.

    ``lifetime`` is the lifetime of a short-lived certificate.  A process that should be refused
    tries to connect for ``connect`` seconds.
    """

    lifetime: int
    connect: float


_PATIENCE = (_TimeLimits(8, 2.0), _TimeLimits(20, 8.0), _TimeLimits(60, 30.0))

_SECONDS_AFTER_EXPIRY = 2.0
"""Seconds that a row continues after a certificate's expiry."""

_ENOUGH_MESSAGES = 3
_AFTER_ENOUGH = 2.0
_SHORTEST_BRIEF = 1.0
_SECONDS_TO_END = 2.0


@dataclass(frozen=True)
class RunPlan:
    """The rows to run, and the settings to run them with.

    ``domains`` has one domain per row; ``topic`` is absolute; ``period`` is in seconds.  With
    ``own_networks``, each row gets a separate network namespace.  ``started`` is the time at which
    the plan was made (CLOCK_MONOTONIC, s).  ``folder`` gets the files of the rows.
    """

    rows: tuple[Row, ...]
    domains: tuple[int, ...]
    backend: Backend
    keystores: KeystoreSet
    topic: str
    folder: Path
    limits: Limits = field(default_factory=Limits)
    period: float = 0.1
    own_networks: bool = False
    started: float = field(default_factory=time.monotonic)

    @property
    def rows_at_once(self) -> int:
        """The number of groups of rows to run in parallel; rows of a group share processes."""
        # Routers of one machine listen at the same port.
        return 1 if self.backend.on_zenoh and not self.own_networks else self.backend.rows_at_once


def run_rows(plan: RunPlan, progress: Progress) -> list[RowResult]:
    """Run the rows of a plan; return their results in order."""
    return asyncio.run(_Runner(plan, progress).run())


class _Runner:
    """A runner of a plan's rows, as many in parallel as the backend allows."""

    def __init__(self, plan: RunPlan, progress: Progress) -> None:
        self._plan = plan
        self._progress = progress
        self._mark = uuid.uuid4().hex[:8]
        self._slots = asyncio.Semaphore(plan.rows_at_once)
        self._end = 0.0
        self._finished = 0

    async def run(self) -> list[RowResult]:
        plan = self._plan
        groups = groups_of_rows(plan.rows)
        waves = math.ceil(len(groups) / plan.rows_at_once)
        self._end = time.monotonic() + max(plan.limits.total, waves * plan.limits.wave)
        loop, task = asyncio.get_running_loop(), asyncio.current_task()
        assert task is not None
        for number in ENDING_SIGNALS:
            loop.add_signal_handler(number, task.cancel)
        results: dict[int, RowResult] = {}
        for played in await asyncio.gather(*map(self._run, groups)):
            results |= played
        return [results[index] for index in range(len(plan.rows))]

    def _text(self, index: int, party: Party) -> str:
        """Return a talker's text, unique among all rows."""
        return f"Hello World from the {party.name} {self._mark}-{index}"

    async def _run(self, group: Sequence[int]) -> dict[int, RowResult]:
        """Run rows that share their processes; return their results by index."""
        rows, domain = [self._plan.rows[index] for index in group], self._plan.domains[group[0]]
        skipped = {row.name: why for row in rows if (why := self._why_skipped(row))}
        inapplicable = {row.name for row in rows if self._plan.keystores.why_inapplicable(row)}
        tried = [row for row in rows if row.name not in skipped]
        played = RowRecord(rows[0], domain)
        if tried:
            async with self._slots:
                for patience in _PATIENCE if self._plan.backend.on_zenoh else _PATIENCE[:1]:
                    played = await self._play(group[0], merged_row(tried), patience)
                    observed = (judge_row(replace(played, row=row)).observed for row in tried)
                    if RowStatus.UNDECIDED not in observed:
                        break
        results = {}
        for index, row in zip(group, rows, strict=True):
            record = replace(
                played,
                row=row,
                skipped=skipped.get(row.name, played.skipped),
                applies=row.name not in inapplicable,
            )
            result = results[index] = judge_row(record)
            self._finished += 1
            self._progress(
                f"[{self._finished}/{len(self._plan.rows)}] {row.name}: {result.observed}"
            )
        return results

    def _why_skipped(self, row: Row) -> str:
        if why := self._plan.keystores.why_inapplicable(row):
            return why
        handshake = any(claim.wire in (Wire.TOPIC, Wire.CERTIFICATE) for claim in row.claims)
        if (handshake or row.replay or row.impersonate) and not self._plan.own_networks:
            return "the row needs a separate network namespace"
        return self._plan.keystores.problem(row)

    async def _play(self, index: int, row: Row, patience: _TimeLimits) -> RowRecord:
        plan, domain = self._plan, self._plan.domains[index]
        folder = plan.folder / f"row_{index + 1:02}"
        shutil.rmtree(folder, ignore_errors=True)  # left by an attempt with shorter time limits
        folder.mkdir(parents=True)
        expiry = None
        if row.short_lived:
            identity, lifetime = row.first_talker.identity, patience.lifetime
            seconds = plan.keystores.issue_short_lived(identity, lifetime, self._elapsed())
            expiry = time.monotonic() + seconds
        processes: dict[str, _PartyProcess] = {}
        tap: Wiretap | None = None
        segments: frozenset[Path] = frozenset()
        memory: Mapping[str, int] = {}
        network = RowNetwork(own=self._plan.own_networks)
        try:
            with network.in_network():
                if row.is_captured:
                    tap = self._start_wiretap(index, row)
                    if tap.problem:
                        return RowRecord(row, domain, skipped=tap.problem)
            for turn in sorted({party.turn for party in row.parties}):
                await self._wait_until_settled(processes.values())
                with network.in_network():
                    for party in row.parties:
                        if party.turn == turn:
                            started = self._start(index, row, party, folder, patience)
                            processes[party.name] = started
            window = await self._watch(row, processes, expiry)
            libraries = frozenset[MappedLibrary]().union(
                *(process.dds() for process in processes.values())
            )
            if any(claim.wire is Wire.MEMORY for claim in row.claims):
                texts = {name: process.text for name, process in processes.items()}
                segments = frozenset().union(
                    *(process.segments() for process in processes.values())
                )
                memory = segments_with_text(texts, segments)
            ports = frozenset[int]().union(*(process.ports() for process in processes.values()))
            wire = tap.count(ports) if tap and row.wire else {}
            injected = None
            if tap and row.replay and window:
                secured = row.party(row.replay).identity.keystore is not None
                lease = plan.backend.seconds_until_forgotten if secured else 0.0
                injected = await _replay_packets(processes[row.replay], tap, lease)
            if tap and row.impersonate and window:
                injected = await _forge_packets(processes[row.impersonate], tap)
        finally:
            try:
                await _end_softly(processes.values())
            finally:
                for process in processes.values():
                    process.end()
                for path in segments:  # Zenoh processes leave their shared memory
                    path.unlink(missing_ok=True)
                if tap is not None:
                    tap.close()
                network.close()
        records = {name: process.record() for name, process in processes.items()}
        return RowRecord(
            row, domain, records, window, wire, injected, expiry, memory, libraries=libraries
        )

    def _elapsed(self) -> float:
        """Return the seconds since the plan was made."""
        return time.monotonic() - self._plan.started

    async def _wait_until_settled(self, processes: Collection[_PartyProcess]) -> bool:
        """Wait until all processes are settled; return False if that takes too long."""
        deadline = min(time.monotonic() + self._plan.limits.start, self._end)
        while not all(process.is_settled for process in processes):
            if time.monotonic() > deadline:
                return False
            await asyncio.sleep(_POLL_SECONDS)
        return True

    def _start_wiretap(self, index: int, row: Row) -> Wiretap:
        texts = {party.name: self._text(index, party) for party in row.parties}
        topic = self._plan.backend.wire_name(self._plan.topic, self._plan.domains[index])
        return Wiretap(texts, topic, replayed=bool(row.replay or row.impersonate))

    def _start(
        self, index: int, row: Row, party: Party, folder: Path, patience: _TimeLimits
    ) -> _PartyProcess:
        plan, domain = self._plan, self._plan.domains[index]
        topic = plan.keystores.topic(party, plan.topic)
        options = ["--topic", topic, "--period", str(plan.period)]
        text = self._text(index, party)
        if party.role in SPEAKING or (plan.backend.on_zenoh and party.role in CALLING):
            options += ["--text", text]
        if party.role is Role.OBSERVER:
            for other_party in row.parties:
                if other_party.role in (Role.TALKER, Role.SERVER) and (
                    other_party.other_topic or other_party.topic
                ):
                    options += ["--also", plan.keystores.topic(other_party, plan.topic)]
        if plan.backend.on_zenoh:
            options += ["--size", str(party.size)] if party.size else []
            options += ["--patience", str(patience.connect)] if _is_refused(party, row) else []
        environment = base_environment(os.environ)
        secured = party.identity.keystore is not None
        denied = any(
            (claim.relation is Relation.IS_REFUSED and claim.subject == party.name)
            or (claim.denied and party.intruder)
            for claim in row.claims
        )
        backend = plan.backend
        environment |= backend.environment(
            party.role,
            wire=row.is_captured,
            denied=denied,
            secured=secured,
        )
        environment |= plan.keystores.environment(party.identity, domain)
        if backend.on_zenoh:
            command = backend.zenoh_command(
                party.role, options, plan.keystores.announced_enclave(party)
            )
        else:
            names = plan.keystores.node_names(party)
            command = backend.command(party.role, options, names, secured=secured)
        return _PartyProcess(
            party.name,
            command,
            environment,
            folder,
            topic=topic,
            text=text,
            dds_library=backend.library(party.role, secured=secured),
        )

    async def _watch(
        self, row: Row, processes: Mapping[str, _PartyProcess], expiry: float | None
    ) -> tuple[float, float] | None:
        limits = self._plan.limits
        if not await self._wait_until_settled(processes.values()):
            return None
        if _is_decided_by_start(row):
            now = time.monotonic()
            return now, now
        needed = [processes[party.name] for party in row.parties if _is_needed(party, row)]
        if not all(process.is_running for process in needed):
            return None
        if row.meanwhile is not None:
            self._plan.keystores.change(row.party(row.claims[0].subject).identity, row.meanwhile)
        start = time.monotonic()
        shortest = max(start + limits.window, (expiry or 0.0) + _SECONDS_AFTER_EXPIRY)
        shortest = min(shortest, self._end)
        longest = min(max(start + limits.longest_window, shortest), self._end)
        claims = (*row.claims, *row.controls)
        positive = [claim for claim in claims if claim.holds]
        silence = not row.brief or expiry is not None
        silence = silence or any(_awaits_silence(claim, row, processes) for claim in claims)
        enough_at = None
        while True:
            now = time.monotonic()
            if enough_at is None and all(
                _is_hopeless(claim, row, processes) or self._is_met(claim, processes)
                for claim in positive
            ):
                enough_at = now
            if enough_at is not None:
                if not silence and now >= start + _SHORTEST_BRIEF:
                    break
                if silence and now >= max(shortest, enough_at + _AFTER_ENOUGH):
                    break
            if now >= longest or any(process.ended_by_itself for process in needed):
                break
            await asyncio.sleep(_POLL_SECONDS)
        await asyncio.sleep(_GRACE_SECONDS)
        return start, now

    def _is_met(self, claim: Claim, processes: Mapping[str, _PartyProcess]) -> bool:
        """Return whether the events that a claim expects were observed often enough.

        True for relations that no event shows.
        """
        events = processes[claim.subject].look()
        if claim.relation in (Relation.HEARS, Relation.IS_ANSWERED, Relation.EXECUTES):
            mark = f"{processes[claim.talker].text}: "
            heard = [e for e in events if e.kind is EventKind.HEARD and e.text.startswith(mark)]
            return len(heard) >= _ENOUGH_MESSAGES
        if claim.relation in (Relation.SEES, Relation.LOSES):
            topic = processes[claim.talker].topic
            seen = any(event.publishers.get(topic) for event in events)
            lost = seen and not events[-1].publishers.get(topic)
            return lost if claim.relation is Relation.LOSES else seen
        return True


def _is_hopeless(claim: Claim, row: Row, processes: Mapping[str, _PartyProcess]) -> bool:
    """Return whether a claim can no longer hold, because an intruder was refused or has ended."""
    names = [name for name in (claim.subject, claim.talker) if name and row.party(name).intruder]
    return not all(processes[name].is_running for name in names)


def _awaits_silence(claim: Claim, row: Row, processes: Mapping[str, _PartyProcess]) -> bool:
    """Return whether a claim needs the full time: it expects silence that could still end."""
    if claim.holds or claim.relation in (Relation.HEARS_AGAIN, Relation.BELIEVES):
        return False
    names = [name for name in (claim.subject, claim.talker) if name and row.party(name).intruder]
    return claim.denied not in DENIALS or all(processes[name].is_running for name in names)


def groups_of_rows(rows: Sequence[Row]) -> list[list[int]]:
    """Return groups of rows that can share processes, as indexes of rows."""
    groups: dict[object, list[int]] = {}
    for index, row in enumerate(rows):
        groups.setdefault(row.world or index, []).append(index)
    return list(groups.values())


def _is_needed(party: Party, row: Row) -> bool:
    """Return whether a row needs a party to run: no intruder, nor a party that a claim refuses."""
    refused = {claim.subject for claim in row.claims if claim.relation is Relation.IS_REFUSED}
    return not party.intruder and party.name not in refused


def _is_refused(party: Party, row: Row) -> bool:
    """Return whether a row expects that a party's connection is refused."""
    return any(
        claim.denied and party.intruder and party.name in (claim.subject, claim.talker)
        for claim in row.claims
    )


def _is_decided_by_start(row: Row) -> bool:
    decided = (Relation.IS_REFUSED, Relation.STARTS)
    return all(claim.relation in decided for claim in (*row.claims, *row.controls))


async def _end_softly(processes: Collection[_PartyProcess]) -> None:
    """Send SIGTERM, and wait up to `_SECONDS_TO_END` for the last log lines and reports."""
    for process in processes:
        process.ask_to_end()
    latest = time.monotonic() + _SECONDS_TO_END
    while time.monotonic() < latest and not all(process.has_exited for process in processes):
        await asyncio.sleep(_POLL_SECONDS)


_AFTER_REPLAY = 2.0
_LONGEST_PAUSE = 0.5
_REPLAY_ROUNDS = 2
_LAST_PACKETS = 20
"""Number of a talker's last packets to send again; some of them contain messages."""
_CHANGED_PLACES = 8
_AFTER_FORGERY = 1.0


async def _replay_packets(talker: _PartyProcess, tap: Wiretap, lease: float) -> Injection:
    """End a talker, then send the captured packets again, with pauses shortened.

    A listener still knows the talker for up to ``lease`` seconds, and drops the packets as
    duplicates.
    """
    packets = tap.packets(talker.ports())
    await _end_softly([talker])
    await asyncio.sleep(lease + _GRACE_SECONDS)
    started = time.monotonic()
    # Twice, since the listener may use the first round only to discover the talker.
    for _ in range(_REPLAY_ROUNDS):
        for before, packet in zip([*packets[:1], *packets], packets, strict=False):
            await asyncio.sleep(min(packet.time - before.time, _LONGEST_PAUSE))
            tap.send(packet.packet)
    await asyncio.sleep(_AFTER_REPLAY)
    return Injection(len(packets), started)


async def _forge_packets(talker: _PartyProcess, tap: Wiretap) -> Injection:
    """Suspend a talker, then send changed copies of its last packet of every length.

    An attacker need not know which packet has a message, or where. For every sequence number, there
    is a copy for each place in which a bit is changed, because a reader drops malformed copies.
    """
    talker.hold()
    await asyncio.sleep(_GRACE_SECONDS)
    last = {
        len(packet.packet): packet.packet for packet in tap.packets(talker.ports())[-_LAST_PACKETS:]
    }
    places = range(_CHANGED_PLACES)
    changed = [
        with_changed_bit(packet, 1 + later, (later + turn) % len(places), len(places))
        for packet in last.values()
        for later in places
        for turn in places
    ]
    sent = [packet for packet in changed if packet]
    started = time.monotonic()
    for packet in sent:
        tap.send(packet)
    await asyncio.sleep(_AFTER_FORGERY)
    return Injection(len(sent), started)


_PREFIXES_LEFT_OUT = ("ROS_SECURITY_",)


_VARIABLES_LEFT_OUT = frozenset(
    {
        "CYCLONEDDS_URI",
        "RUST_LOG",
        "ZENOH_CONFIG_OVERRIDE",
        "ZENOH_ROUTER_CONFIG_URI",
        "ZENOH_SESSION_CONFIG_URI",
        "FASTDDS_BUILTIN_TRANSPORTS",
        "FASTDDS_DEFAULT_PROFILES_FILE",
        "FASTRTPS_DEFAULT_PROFILES_FILE",
        "RMW_FASTRTPS_USE_QOS_FROM_XML",
        "RMW_IMPLEMENTATION",
        "ROS_AUTOMATIC_DISCOVERY_RANGE",
        "ROS_DISCOVERY_SERVER",
        "ROS_DOMAIN_ID",
        "ROS_LOCALHOST_ONLY",
        "ROS_STATIC_PEERS",
    }
)


def base_environment(environment: Mapping[str, str]) -> dict[str, str]:
    """Return ``environment`` without variables that change discovery or security of DDS."""
    return {
        name: value
        for name, value in environment.items()
        if name not in _VARIABLES_LEFT_OUT and not name.startswith(_PREFIXES_LEFT_OUT)
    } | {"PYTHONUNBUFFERED": "1"}


class _PartyProcess:
    """A running process of a row; report and log are in ``folder`` under ``name``."""

    def __init__(
        self,
        name: str,
        command: Sequence[str],
        environment: Mapping[str, str],
        folder: Path,
        *,
        topic: str,
        text: str = "",
        dds_library: str = "",
    ) -> None:
        stem = name.replace(" ", "_")
        self.name = name
        self.topic = topic
        self.text = text
        self._library = dds_library
        self._log = folder / f"{stem}.log"
        report = folder / f"{stem}.jsonl"
        self._reader = EventReader(report)
        self._events: list[Event] = []
        self._own_status: int | None = None
        self._asked = False
        self._ports: frozenset[int] = frozenset()
        with self._log.open("wb") as output:
            self._process = subprocess.Popen(
                [*command, "--report", str(report)],
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=output,
                env={**environment, "ROS_LOG_DIR": str(folder / "ros_log")},
                start_new_session=True,
                preexec_fn=end_with_starter(),
            )
        _LOG.info("started process %d, %s: %s", self._process.pid, name, shlex.join(command))

    def look(self) -> list[Event]:
        """Return all reports of the process so far, oldest first."""
        ended = self._process.poll()
        self._events += self._reader.new_events()
        if ended is not None and self._own_status is None and not self._asked:
            self._own_status = ended
        return self._events

    @property
    def is_settled(self) -> bool:
        """Whether the process is ready, was refused, or has failed or ended."""
        events = self.look()
        return self._own_status is not None or any(
            event.kind in (EventKind.READY, EventKind.REFUSED, EventKind.FAILED) for event in events
        )

    @property
    def is_running(self) -> bool:
        """Whether the process was ready and has not ended by itself."""
        events = self.look()
        return self._own_status is None and any(event.kind is EventKind.READY for event in events)

    @property
    def ended_by_itself(self) -> bool:
        """Whether the process has ended by itself."""
        self.look()
        return self._own_status is not None

    def ports(self) -> frozenset[int]:
        """Return the ports that the process has bound; after its end, the last known ports."""
        self._ports = bound_ports(self._process.pid) or self._ports
        return self._ports

    def segments(self) -> frozenset[Path]:
        """Return the segments of shared memory that the process maps."""
        return mapped_segments(self._process.pid)

    def dds(self) -> tuple[MappedLibrary, ...]:
        """Return the DDS libraries that the process has mapped; empty if it has ended."""
        return dds_of(self._process.pid)

    def ask_to_end(self) -> None:
        """Send SIGTERM; an end after that does not count as `ended_by_itself`."""
        self.look()
        self._asked = True
        with suppress(ProcessLookupError):
            self._process.terminate()
            self._process.send_signal(signal.SIGCONT)

    def hold(self) -> None:
        """Suspend the process; `end` can still kill it."""
        with suppress(ProcessLookupError):
            self._process.send_signal(signal.SIGSTOP)

    @property
    def has_exited(self) -> bool:
        """Whether the process has ended, for any reason."""
        return self._process.poll() is not None

    def end(self) -> None:
        """Kill the process and its children."""
        with suppress(ProcessLookupError):
            os.killpg(self._process.pid, signal.SIGKILL)
        self._process.wait()

    def record(self) -> PartyRecord:
        """Return the record of the process; call it after `end`."""
        # A node that was asked to end may report a failure, which does not count.
        late = [event for event in self._reader.new_events() if event.kind is not EventKind.FAILED]
        return PartyRecord(
            text=self.text,
            topic=self.topic,
            library=self._library,
            events=(*self._events, *late),
            output=plain_text(self._log.read_text(encoding="utf-8", errors="replace")),
            status=self._own_status,
        )
