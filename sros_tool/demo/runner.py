"""Run rows of the demo at the same time, each in a domain of its own, and record what happened.

A row's window starts when all its processes are ready, so a busy machine is waited for; it is as
long for silence as for sound, and ends early for neither.
"""

from __future__ import annotations

import asyncio
import os
import time
import uuid
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, field
from pathlib import Path

from sros_tool.demo.backend import Backend
from sros_tool.demo.capture import Capture
from sros_tool.demo.isolated import ENDING_SIGNALS
from sros_tool.demo.keystores import DemoKeystores
from sros_tool.demo.launch import PartyProcess, base_environment
from sros_tool.demo.scenarios import Claim, Party, Relation, Role, Row
from sros_tool.demo.verdict import RowRecord, RowResult, WireCount, judge_row
from sros_tool.runtime.events import Kind

_TICK = 0.05
_GRACE = 0.3
_ENOUGH_MESSAGES = 3
_AFTER_ENOUGH = 2.0
_SECONDS_TO_END = 2.0


@dataclass(frozen=True)
class Limits:
    """Seconds: to start in, the shortest and longest window, and for all rows together."""

    start: float = 20.0
    window: float = 5.0
    longest_window: float = 15.0
    total: float = 50.0


@dataclass(frozen=True)
class Plan:
    """All that is needed to run rows.

    ``domains`` has one domain per row; ``topic`` is absolute; ``period`` is in seconds.
    """

    rows: tuple[Row, ...]
    domains: tuple[int, ...]
    backend: Backend
    keystores: DemoKeystores
    topic: str
    folder: Path
    limits: Limits = field(default_factory=Limits)
    period: float = 0.1


def run_plan(plan: Plan, progress: Callable[[str], None]) -> list[RowResult]:
    """Run all rows, and judge them; ``progress`` is told of each row that ends."""
    return asyncio.run(_Stage(plan, progress).run())


class _Stage:
    def __init__(self, plan: Plan, progress: Callable[[str], None]) -> None:
        self._plan = plan
        self._capture_problem = ""
        self._progress = progress
        self._mark = uuid.uuid4().hex[:8]
        self._capture: Capture | None = None
        self._places = asyncio.Semaphore(plan.backend.rows_at_once)
        self._end = 0.0
        self._finished = 0

    async def run(self) -> list[RowResult]:
        self._end = time.monotonic() + self._plan.limits.total
        loop, task = asyncio.get_running_loop(), asyncio.current_task()
        assert task is not None
        for number in ENDING_SIGNALS:
            loop.add_signal_handler(number, task.cancel)
        self._start_capture()
        try:
            return await asyncio.gather(*map(self._run_row, range(len(self._plan.rows))))
        finally:
            self._stop_capture()

    def _start_capture(self) -> None:
        wired = [index for index, row in enumerate(self._plan.rows) if row.wire]
        if not wired:
            return
        marks = [self._text(i, party) for i in wired for party in self._plan.rows[i].parties]
        try:
            self._capture = Capture(marks)
        except OSError as error:
            self._capture_problem = f"capturing packets is not permitted: {error.strerror}"
            return
        asyncio.get_running_loop().add_reader(self._capture.fileno(), self._capture.drain)

    def _stop_capture(self) -> None:
        if self._capture is not None:
            asyncio.get_running_loop().remove_reader(self._capture.fileno())
            self._capture.close()

    def _text(self, index: int, party: Party) -> str:
        """What a talker says; it occurs nowhere else, not in another row either."""
        return f"Hello World from the {party.name} {self._mark}-{index}"

    async def _run_row(self, index: int) -> RowResult:
        row, domain = self._plan.rows[index], self._plan.domains[index]
        skipped = self._capture_problem if row.wire else ""
        if skipped:
            result = judge_row(RowRecord(row, domain, skipped=skipped))
        else:
            async with self._places:
                result = judge_row(await self._play(index))
        self._finished += 1
        self._progress(
            f"[{self._finished}/{len(self._plan.rows)}] {row.name}: {result.observed.value}"
        )
        return result

    async def _play(self, index: int) -> RowRecord:
        row, domain = self._plan.rows[index], self._plan.domains[index]
        folder = self._plan.folder / f"row_{index + 1:02}"
        folder.mkdir(parents=True)
        processes: dict[str, PartyProcess] = {}
        try:
            for party in row.parties:
                processes[party.name] = self._start(index, party, domain, folder)
            window = await self._watch(row, processes)
            ports = frozenset[int]().union(*(each.ports() for each in processes.values()))
            wire = self._count(index, ports)
        finally:
            try:
                await _end_softly(processes.values())
            finally:
                for process in processes.values():
                    process.end()
        records = {name: process.record() for name, process in processes.items()}
        return RowRecord(row, domain, records, window, wire)

    def _start(self, index: int, party: Party, domain: int, folder: Path) -> PartyProcess:
        plan, row = self._plan, self._plan.rows[index]
        topic = _topic_of(party, plan.topic)
        options = ["--topic", topic, "--period", str(plan.period)]
        text = self._text(index, party)
        if party.role is Role.TALKER:
            options += ["--text", text]
        if party.role is Role.OBSERVER:
            for other in row.parties:
                if other.role is Role.TALKER and other.aside:
                    options += ["--also", _topic_of(other, plan.topic)]
        environment = base_environment(os.environ)
        denied = any(
            claim.relation is Relation.IS_REFUSED and claim.subject == party.name
            for claim in row.claims
        )
        environment |= plan.backend.environment(party.role, wire=row.wire, denied=denied)
        environment |= plan.keystores.environment(party.identity, domain)
        command = [*plan.backend.command(party.role), *options]
        return PartyProcess(
            party.name,
            command,
            environment,
            folder,
            topic=topic,
            text=text,
            through=plan.backend.library(party.role),
        )

    async def _watch(
        self, row: Row, processes: Mapping[str, PartyProcess]
    ) -> tuple[float, float] | None:
        limits = self._plan.limits
        deadline = min(time.monotonic() + limits.start, self._end)
        while not all(process.settled for process in processes.values()):
            if time.monotonic() > deadline:
                return None
            await asyncio.sleep(_TICK)
        if _is_decided_by_start(row):
            now = time.monotonic()
            return now, now
        if not all(process.running for process in processes.values()):
            return None
        start = time.monotonic()
        shortest = min(start + limits.window, self._end)
        longest = min(start + limits.longest_window, self._end)
        positive = [claim for claim in (*row.claims, *row.controls) if claim.holds]
        enough_at = None
        while True:
            now = time.monotonic()
            if enough_at is None and all(self._is_met(claim, processes) for claim in positive):
                enough_at = now
            if enough_at is not None and now >= max(shortest, enough_at + _AFTER_ENOUGH):
                break
            if now >= longest or any(process.ended for process in processes.values()):
                break
            await asyncio.sleep(_TICK)
        await asyncio.sleep(_GRACE)
        return start, now

    def _is_met(self, claim: Claim, processes: Mapping[str, PartyProcess]) -> bool:
        """Whether a claim that something happens has been seen to hold, several times."""
        events = processes[claim.subject].look()
        if claim.relation is Relation.HEARS:
            mark = f"{processes[claim.talker].text}: "
            heard = [e for e in events if e.kind is Kind.HEARD and e.text.startswith(mark)]
            return len(heard) >= _ENOUGH_MESSAGES
        if claim.relation is Relation.SEES:
            return any(count for event in events for count in event.publishers.values() if count)
        return True

    def _count(self, index: int, ports: frozenset[int]) -> Mapping[str, WireCount]:
        row, capture = self._plan.rows[index], self._capture
        if not row.wire or capture is None:
            return {}
        capture.drain()
        protected = sum(capture.protected[port] for port in ports)
        return {
            party.name: WireCount(capture.plain[self._text(index, party)], protected)
            for party in row.parties
        }


async def _end_softly(processes: Collection[PartyProcess]) -> None:
    """Let the processes end by themselves, for a while; they log and report until then."""
    for process in processes:
        process.ask_to_end()
    latest = time.monotonic() + _SECONDS_TO_END
    while time.monotonic() < latest and not all(process.gone for process in processes):
        await asyncio.sleep(_TICK)


def _topic_of(party: Party, topic: str) -> str:
    return f"{topic}_in_the_open" if party.aside else topic


def _is_decided_by_start(row: Row) -> bool:
    decided = (Relation.IS_REFUSED, Relation.STARTS)
    return all(claim.relation in decided for claim in (*row.claims, *row.controls))
