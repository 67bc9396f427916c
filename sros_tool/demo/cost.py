"""Measure the cost of security by protection kind: first message, latency, throughput.

Pairs of processes exchange messages, one pair after the other, each in a separate network.  All
pairs run the same program, so only the protection differs.

`CostResult.as_json` gives ``kinds`` (the protection kinds, unsecured first), ``payloads`` (bytes),
``note`` (what the numbers contain), ``first_message`` (a list of ``{"kind", "seconds", "ratio"}``)
and ``measurements`` (a list of ``{"kind", "payload", "latency_us", "messages_per_s",
"megabytes_per_s", "latency_ratio", "throughput_ratio"}``).  Every ratio is secured divided
by unsecured in the same run: a latency ratio above 1, or a throughput ratio below 1, is slower.
"""

from __future__ import annotations

import json
import os
import statistics
import subprocess
import sys
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from sros_tool.demo.forger import Undefended
from sros_tool.demo.network import Progress, RowNetwork, end_with_starter
from sros_tool.demo.runner import RunPlan, base_environment
from sros_tool.demo.scenarios.model import Identity, Role
from sros_tool.errors import SrosError

_UNSECURED = "unsecured"
_PAYLOADS = (64, 1024, 16 * 1024, 256 * 1024, 1024 * 1024)
NOTE = (
    "medians; latency is half a round trip; throughput is measured in bursts, and the receiver"
    " confirms each burst; both ends are Python, whose overhead is the same in all numbers and"
    " brings the ratios closer to 1 than with nodes in C++; messages go over UDP, not through"
    " shared memory; the numbers vary for payloads that do not fit into a socket's buffer"
)
_LONGEST_START = 60.0
_TICK = 0.02


@dataclass(frozen=True)
class Effort:
    """The extent of a measurement: payloads in bytes, seconds per number, and rounds."""

    payloads: tuple[int, ...] = _PAYLOADS
    seconds: float = 0.2
    rounds: int = 3


@dataclass(frozen=True)
class Measurement:
    """The latency (s) and rate (messages per second) of one protection kind and payload (bytes)."""

    kind: str
    payload: int
    latency: float
    rate: float


@dataclass(frozen=True)
class CostResult:
    """The cost of security; ``first`` has the seconds to the first message by protection kind."""

    kinds: tuple[str, ...]
    payloads: tuple[int, ...]
    first: Mapping[str, float]
    measurements: tuple[Measurement, ...]

    def of(self, kind: str, payload: int) -> Measurement:
        """Return the measurement of a protection kind and payload.

        Raises:
            KeyError: this kind or payload was not measured.
        """
        return {(each.kind, each.payload): each for each in self.measurements}[kind, payload]

    def as_json(self) -> dict[str, Any]:
        """Return the result as JSON, described at the top of this module."""
        return {
            "kinds": list(self.kinds),
            "payloads": list(self.payloads),
            "note": NOTE,
            "first_message": [
                {
                    "kind": kind,
                    "seconds": round(self.first[kind], 4),
                    "ratio": round(self.first[kind] / self.first[_UNSECURED], 2),
                }
                for kind in self.kinds
            ],
            "measurements": [self._measured(each) for each in self.measurements],
        }

    def _measured(self, each: Measurement) -> dict[str, Any]:
        base = self.of(_UNSECURED, each.payload)
        return {
            "kind": each.kind,
            "payload": each.payload,
            "latency_us": round(each.latency * 1e6, 1),
            "messages_per_s": round(each.rate, 1),
            "megabytes_per_s": round(each.rate * each.payload / 1e6, 3),
            "latency_ratio": round(each.latency / base.latency, 3),
            "throughput_ratio": round(each.rate / base.rate, 3),
        }


def measure_cost(
    plan: RunPlan,
    measured: Mapping[str, Undefended],
    folder: Path,
    effort: Effort,
    progress: Progress,
) -> CostResult:
    """Measure an unsecured pair, and a pair in each keystore of ``measured`` (by kind).

    Raises:
        SrosError: the two processes of a pair did not find each other.
    """
    kinds = {_UNSECURED: (Identity(), Identity())}
    for kind, keystore in measured.items():
        kinds[kind] = (Identity(keystore, "pong"), Identity(keystore, "ping"))
    folder.mkdir(parents=True, exist_ok=True)
    found: dict[str, list[dict[str, Any]]] = {kind: [] for kind in kinds}
    # In turns, so that other load of the machine affects all kinds equally.
    for turn in range(effort.rounds):
        for kind, ends in kinds.items():
            found[kind].append(_run_pair(ends, plan, folder, effort))
        progress(f"measured {len(kinds)} kinds of protection, round {turn + 1} of {effort.rounds}")
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
    ends: tuple[Identity, Identity], plan: RunPlan, folder: Path, effort: Effort
) -> dict[str, Any]:
    """Run one pair of processes, and return the JSON that its ping wrote."""
    answer = folder / "answer.json"
    answer.unlink(missing_ok=True)
    # -P: never import modules from the current folder.
    command = [sys.executable, "-P", "-m", "sros_tool.demo.nodes.ping_pong", plan.backend.name]
    ping = ["ping", "--answer", str(answer), "--seconds", str(effort.seconds)]
    ping += ["--sizes", *map(str, effort.payloads)]
    network = RowNetwork(own=plan.own_networks)
    processes: list[subprocess.Popen[bytes]] = []
    try:
        with network.entered(), (folder / "cost.log").open("ab") as log:
            for identity, arguments in zip(ends, (["pong"], ping), strict=True):
                environment = base_environment(os.environ)
                environment |= plan.backend.environment(Role.TALKER, wire=True)
                environment |= plan.keystores.environment(identity, plan.domains[0])
                processes.append(
                    subprocess.Popen(
                        [*command, *arguments],
                        stdin=subprocess.DEVNULL,
                        stdout=log,
                        stderr=log,
                        env=environment,
                        preexec_fn=end_with_starter(),
                    )
                )
        deadline = time.monotonic() + _LONGEST_START + len(effort.payloads) * 4 * effort.seconds
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
