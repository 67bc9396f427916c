"""Benchmarks of what protection costs on a real DDS: first message, latency, throughput.

Pairs of processes exchange messages, one pair after the other, each in a separate network.  All
pairs run the same program, so only the protection differs; the floor is the unsecured pair.
Latency is half a round trip.  Throughput is measured in bursts, and the receiver confirms each
burst.  Both ends are Python, whose overhead is the same in all figures and brings the ratios
closer to 1 than with nodes in C++.  Messages go over UDP, not through shared memory.  The figures
vary for payloads that do not fit into a socket's buffer.
"""

from __future__ import annotations

import json
import os
import statistics
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

from benchmarks.ping_pong import ENDS, TOPICS
from sros_tool.dds.domains import DomainSet
from sros_tool.demo.backend import Backend
from sros_tool.demo.forger import encrypted, signed, unprotected
from sros_tool.demo.program import base_environment, find_backend
from sros_tool.demo.scenarios.model import DEFAULT_TOPIC, Role
from sros_tool.errors import SrosError
from sros_tool.files import policies_dir
from sros_tool.keystore.lifecycle.create import create_keystore, generate_artifacts
from sros_tool.keystore.template import load_template
from sros_tool.parallel import end_with_starter
from sros_tool.policy.document import read_policy
from sros_tool.policy.model import ALLOW, Enclave, Group, Policy, Profile, Profiles
from sros_tool.runtime.environment import secured_environment
from sros_tool.runtime.netns import Progress, RowNetwork, run_isolated, try_isolation
from sros_tool.runtime.variables import DOMAIN

_UNSECURED = "unsecured"
_KINDS = {"none": unprotected, "sign": signed, "encrypt": encrypted}
"""The template of each kind of protection; of ``none``, access is controlled alone."""

_DOMAIN = 80
_LONGEST_START = 60.0
_TICK = 0.02
Figure = tuple[str, float, float | None, str, bool, str]
"""The task, its figure, the floor, the limit, whether it is kept, and the unit."""


class Effort(NamedTuple):
    """The extent of a measurement: payloads in bytes, seconds per figure, and rounds."""

    payloads: tuple[int, ...] = (64, 1024, 16 * 1024, 256 * 1024, 1024 * 1024)
    seconds: float = 0.2
    rounds: int = 3


class Exchange(NamedTuple):
    """What one pair of processes measured, or the median of several pairs.

    ``first`` is the time to the first message in seconds; ``latency`` (seconds) and ``rate``
    (messages per second) are by payload.
    """

    first: float
    latency: Mapping[int, float]
    rate: Mapping[int, float]


def protecting(folder: Path, wish: str, rounds: int) -> Iterator[Figure]:
    """Yield the figures of each kind of protection; ``wish`` is a back end of the demo."""
    effort = Effort(rounds=rounds)
    measured = measure_protection(folder, wish, effort)
    unsecured = measured.pop(_UNSECURED)
    for kind, exchange in measured.items():
        yield f"first message, {kind}", exchange.first, unsecured.first, "-", True, "s"
    for payload in effort.payloads:
        size = f"{payload // 1024} KiB" if payload >= 1024 else f"{payload} B"
        for kind, exchange in measured.items():
            latency, floor = exchange.latency[payload] * 1e6, unsecured.latency[payload] * 1e6
            yield f"latency of {size} in us, {kind}", latency, floor, "-", True, "us"
            rate, floor = exchange.rate[payload], unsecured.rate[payload]
            megabytes = payload / 1e6
            yield (
                f"throughput of {size} in MB/s, {kind}",
                rate * megabytes,
                floor * megabytes,
                "-",
                True,
                "MB/s",
            )


def measure_protection(folder: Path, wish: str, effort: Effort) -> dict[str, Exchange]:
    """Measure an unsecured pair, and a pair with each kind of protection.

    Raises:
        UnavailableError: no DDS enforces security here.
        SrosError: the two processes of a pair did not find each other.
    """
    now = datetime.now(UTC)
    folder.mkdir(parents=True, exist_ok=True)
    backend = find_backend(wish, folder, DEFAULT_TOPIC, now)
    unsecured = {DOMAIN: str(_DOMAIN)}
    pairs: dict[str, dict[str, Mapping[str, str]]] = {_UNSECURED: dict.fromkeys(ENDS, unsecured)}
    for kind in _KINDS:
        root = _keystore(folder, kind, now)
        pairs[kind] = {end: secured_environment(root, f"/{end}", _DOMAIN) for end in ENDS}
    isolation = try_isolation()
    work = partial(_measure, pairs, backend, folder, effort, isolation.isolated)
    return run_isolated(work, isolation, lambda line: print(line, file=sys.stderr))


def _keystore(folder: Path, kind: str, now: datetime) -> Path:
    """Return a keystore with both ends and this kind of protection."""
    root = folder / kind
    template = _KINDS[kind](load_template("production"))
    create_keystore(root, template=template, domains=DomainSet.of((_DOMAIN, _DOMAIN)), now=now)
    generate_artifacts(root, policies=[_policy()], now=now)
    return root


def _policy() -> Policy:
    """Return the policy of both ends: what every node needs, and the topics of the messages."""
    basics = read_policy(policies_dir() / "defaults/node_basics.xml").enclaves[0].all_profiles()
    rights = (("publish", ALLOW), ("subscribe", ALLOW))
    groups = (*basics[0].groups, Group("topics", rights, TOPICS))
    ends = (Enclave(f"/{end}", (Profiles((Profile("/", "cost", groups),)),)) for end in ENDS)
    return Policy(tuple(ends))


def _measure(
    pairs: Mapping[str, Mapping[str, Mapping[str, str]]],
    backend: Backend,
    folder: Path,
    effort: Effort,
    own_networks: bool,
    progress: Progress,
) -> dict[str, Exchange]:
    runs: dict[str, list[dict[str, Any]]] = {kind: [] for kind in pairs}
    # In turns, so that other load of the machine affects all kinds equally.
    for turn in range(effort.rounds):
        for kind, ends in pairs.items():
            runs[kind].append(_run_pair(ends, backend, folder, effort, own_networks))
        progress(f"measured {len(pairs)} kinds of protection, round {turn + 1} of {effort.rounds}")

    def median(kind: str, place: int, figure: str) -> float:
        return float(statistics.median(run["sizes"][place][figure] for run in runs[kind]))

    places = {payload: place for place, payload in enumerate(effort.payloads)}
    return {
        kind: Exchange(
            statistics.median(run["first"] for run in runs[kind]),
            {payload: median(kind, place, "latency") for payload, place in places.items()},
            {payload: median(kind, place, "rate") for payload, place in places.items()},
        )
        for kind in pairs
    }


def _run_pair(
    ends: Mapping[str, Mapping[str, str]],
    backend: Backend,
    folder: Path,
    effort: Effort,
    own_network: bool,
) -> dict[str, Any]:
    """Run one pair of processes, and return the JSON that its ping wrote."""
    answer = folder / "answer.json"
    answer.unlink(missing_ok=True)
    command = [sys.executable, "-m", "benchmarks.ping_pong", backend.name]
    ping = ["--answer", str(answer), "--seconds", str(effort.seconds)]
    ping += ["--sizes", *map(str, effort.payloads)]
    network = RowNetwork(own=own_network)
    processes: list[subprocess.Popen[bytes]] = []
    try:
        with network.in_network(), (folder / "pair.log").open("ab") as log:
            for end, variables in ends.items():
                environment = base_environment(os.environ)
                environment |= backend.environment(Role.TALKER, wire=True)
                environment |= variables
                processes.append(
                    subprocess.Popen(
                        [*command, end, *(ping if end == "ping" else [])],
                        cwd=Path(__file__).parents[1],
                        stdin=subprocess.DEVNULL,
                        stdout=log,
                        stderr=log,
                        env=environment,
                        preexec_fn=end_with_starter(),
                    )
                )
        deadline = time.monotonic() + _LONGEST_START + len(effort.payloads) * 4 * effort.seconds
        while all(process.poll() is None for process in processes):
            if time.monotonic() > deadline:
                break
            time.sleep(_TICK)
    finally:
        for process in processes:
            process.kill()
            process.wait()
        network.close()
    if not answer.exists():
        log_text = (folder / "pair.log").read_text(encoding="utf-8", errors="replace")
        raise SrosError(
            "the cost of protection could not be measured",
            f"{' '.join(log_text.split())[-300:] or 'The two ends did not find each other'}",
        )
    measured: dict[str, Any] = json.loads(answer.read_text(encoding="utf-8"))
    return measured
