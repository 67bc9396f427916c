"""What security costs: time to the first message, latency and throughput, by protection kind.

Two processes talk in a network of their own, one pair after the other; each pair measures by the
same program, so that only the protection differs.

`CostResult.as_json` gives ``kinds`` (the protection kinds, unsecured first), ``payloads`` (bytes),
``note`` (what the numbers contain), ``first_message`` (a list of ``{"kind", "seconds", "ratio"}``)
and ``measurements`` (a list of ``{"kind", "payload", "latency_us", "messages_per_s",
"megabytes_per_s", "latency_ratio", "throughput_ratio"}``).  Every ratio is secured over unsecured
in the same run: of latency above 1 is slower, of throughput below 1 is slower.
"""

from __future__ import annotations

import json
import os
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from sros_tool.demo.backend import Backend
from sros_tool.demo.keystores import Scenery
from sros_tool.demo.launch import base_environment
from sros_tool.demo.model import Identity, Role
from sros_tool.demo.network import RowNetwork, Tell
from sros_tool.errors import SrosError
from sros_tool.runtime.netns import end_with_parent

UNSECURED = "unsecured"
PAYLOADS = (64, 1024, 16 * 1024, 256 * 1024, 1024 * 1024)
NOTE = (
    "medians; latency is half a round trip, throughput is that of bursts which are waited for;"
    " both ends are Python, whose overhead is in all numbers alike and makes the ratios smaller"
    " than those of nodes in C++; messages go over UDP, not through shared memory; the numbers of"
    " payloads that do not fit into the buffer of a socket scatter"
)
_LONGEST = 60.0
_TICK = 0.02


@dataclass(frozen=True)
class Effort:
    """How much is measured: payloads in bytes, seconds for each, and how often all of it."""

    payloads: tuple[int, ...] = PAYLOADS
    seconds: float = 0.2
    rounds: int = 3


@dataclass(frozen=True)
class Measurement:
    """What one pair found for one payload: seconds, and messages per second."""

    kind: str
    payload: int
    latency: float
    rate: float


@dataclass(frozen=True)
class CostResult:
    """What security costs; ``first`` has the seconds to the first message by kind."""

    kinds: tuple[str, ...]
    payloads: tuple[int, ...]
    first: Mapping[str, float]
    measurements: tuple[Measurement, ...]

    def of(self, kind: str, payload: int) -> Measurement:
        """One measurement.  Raises `KeyError`."""
        return {(each.kind, each.payload): each for each in self.measurements}[kind, payload]

    def as_json(self) -> dict[str, Any]:
        """The result as the head of this module describes it."""
        return {
            "kinds": list(self.kinds),
            "payloads": list(self.payloads),
            "note": NOTE,
            "first_message": [
                {
                    "kind": kind,
                    "seconds": round(self.first[kind], 4),
                    "ratio": round(self.first[kind] / self.first[UNSECURED], 2),
                }
                for kind in self.kinds
            ],
            "measurements": [self._measured(each) for each in self.measurements],
        }

    def _measured(self, each: Measurement) -> dict[str, Any]:
        base = self.of(UNSECURED, each.payload)
        return {
            "kind": each.kind,
            "payload": each.payload,
            "latency_us": round(each.latency * 1e6, 1),
            "messages_per_s": round(each.rate, 1),
            "megabytes_per_s": round(each.rate * each.payload / 1e6, 3),
            "latency_ratio": round(each.latency / base.latency, 3),
            "throughput_ratio": round(each.rate / base.rate, 3),
        }

    def markdown(self) -> list[str]:
        """The cost as tables of Markdown."""
        return _markdown(self.as_json())


def measure_cost(
    kinds: Mapping[str, tuple[Identity, Identity]],
    scenery: Scenery,
    domain: int,
    folder: Path,
    backend: Backend,
    effort: Effort,
    tell: Tell,
    *,
    own_network: bool,
) -> CostResult:
    """Measure each kind, by the identities of its two ends; the first one must be unsecured."""
    folder.mkdir(parents=True, exist_ok=True)
    found: dict[str, list[dict[str, Any]]] = {kind: [] for kind in kinds}
    # In turns, so that what else the machine does falls on all kinds alike.
    for turn in range(effort.rounds):
        for kind, ends in kinds.items():
            found[kind].append(
                _run_pair(ends, scenery, domain, folder, backend, effort, own_network)
            )
        tell(f"measured {len(kinds)} kinds of protection, round {turn + 1} of {effort.rounds}")
    first = {kind: statistics.median(run["first"] for run in runs) for kind, runs in found.items()}
    measurements = [
        Measurement(
            kind,
            payload,
            statistics.median(run["sizes"][place]["latency"] for run in runs),
            statistics.median(run["sizes"][place]["rate"] for run in runs),
        )
        for place, payload in enumerate(effort.payloads)
        for kind, runs in found.items()
    ]
    return CostResult(tuple(kinds), effort.payloads, first, tuple(measurements))


def _run_pair(
    ends: tuple[Identity, Identity],
    scenery: Scenery,
    domain: int,
    folder: Path,
    backend: Backend,
    effort: Effort,
    own_network: bool,
) -> dict[str, Any]:
    answer = folder / "answer.json"
    answer.unlink(missing_ok=True)
    command = [sys.executable, "-m", "sros_tool.demo.cost_node", backend.name]
    ping = ["ping", "--answer", str(answer), "--seconds", str(effort.seconds)]
    ping += ["--sizes", *map(str, effort.payloads)]
    network = RowNetwork(own=own_network)
    processes: list[subprocess.Popen[bytes]] = []
    try:
        with network.entered(), (folder / "cost.log").open("ab") as log:
            for identity, arguments in zip(ends, (["pong"], ping), strict=True):
                environment = base_environment(os.environ)
                environment |= backend.environment(Role.TALKER, wire=True)
                environment |= scenery.environment(identity, domain)
                processes.append(
                    subprocess.Popen(
                        [*command, *arguments],
                        stdin=subprocess.DEVNULL,
                        stdout=log,
                        stderr=log,
                        env=environment,
                        preexec_fn=_with(os.getpid()),
                    )
                )
        deadline = time.monotonic() + _LONGEST + len(effort.payloads) * 4 * effort.seconds
        while processes[1].poll() is None and processes[0].poll() is None:
            if time.monotonic() > deadline:
                break
            time.sleep(_TICK)
    finally:
        for process in processes:
            process.kill()
            process.wait()
        network.close()
    if not answer.exists():
        log_text = (folder / "cost.log").read_text(encoding="utf-8", errors="replace")
        raise SrosError(
            "the cost of security could not be measured",
            f"{' '.join(log_text.split())[-300:] or 'The two ends did not find each other'}",
        )
    found: dict[str, Any] = json.loads(answer.read_text(encoding="utf-8"))
    return found


def _with(starter: int) -> Callable[[], None]:
    def before() -> None:
        end_with_parent()
        if os.getppid() != starter:
            os._exit(1)

    return before


def payload_text(size: int) -> str:
    """A payload for people: "64 B", "16 KiB", "1 MiB"."""
    for unit, name in ((1024 * 1024, "MiB"), (1024, "KiB")):
        if size >= unit:
            return f"{size / unit:g} {name}"
    return f"{size} B"


def cost_table(cost: CostResult) -> list[str]:
    """The cost for a terminal."""
    shown = cost.as_json()
    lines = ["what security costs: latency and throughput, and their ratio to unsecured", ""]
    lines.append(f"{'protection':<12}{'first message':>15}{'ratio':>8}")
    lines += [
        f"{each['kind']:<12}{each['seconds']:>13.3f} s{each['ratio']:>8.2f}"
        for each in shown["first_message"]
    ]
    lines += [
        "",
        f"{'payload':<10}{'protection':<12}{'latency':>13}{'ratio':>7}{'MB/s':>11}{'ratio':>7}",
    ]
    for payload in cost.payloads:
        for each in shown["measurements"]:
            if each["payload"] == payload:
                lines.append(
                    f"{payload_text(payload):<10}{each['kind']:<12}{each['latency_us']:>10.0f} us"
                    f"{each['latency_ratio']:>7.2f}{each['megabytes_per_s']:>11.2f}"
                    f"{each['throughput_ratio']:>7.2f}"
                )
    return [*lines, "", NOTE]


def _markdown(shown: Mapping[str, Any]) -> list[str]:
    lines = ["| protection | first message | ratio |", "| --- | ---: | ---: |"]
    lines += [
        f"| {each['kind']} | {each['seconds']:.3f} s | {each['ratio']:.2f} |"
        for each in shown["first_message"]
    ]
    lines += [
        "",
        "| payload | protection | latency | ratio | throughput | ratio |",
        "| ---: | --- | ---: | ---: | ---: | ---: |",
    ]
    lines += [
        f"| {payload_text(each['payload'])} | {each['kind']} | {each['latency_us']:.0f} µs"
        f" | {each['latency_ratio']:.2f} | {each['megabytes_per_s']:.2f} MB/s"
        f" | {each['throughput_ratio']:.2f} |"
        for each in sorted(shown["measurements"], key=lambda each: int(each["payload"]))
    ]
    return [*lines, "", shown["note"] + "."]
