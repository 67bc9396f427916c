"""The command ``python -m benchmarks``, which prints a table; ``--json FILE`` also writes JSON."""

from __future__ import annotations

import argparse
import json
import os
import platform
import resource
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from pathlib import Path

from benchmarks.checking import checking
from benchmarks.deciding import deciding
from benchmarks.explaining import explaining, explaining_zenoh
from benchmarks.fetching import fetching
from benchmarks.fleet import fleet
from benchmarks.floor import make_enclaves, sizes_of
from benchmarks.inputs import enclaves_policy, topics_policy
from benchmarks.observing import observing
from benchmarks.picturing import picturing
from benchmarks.protecting import protecting
from benchmarks.requiring import requiring
from benchmarks.zenoh import zenoh_files

RULES = 14


@dataclass(frozen=True)
class Row:
    """One figure in ``unit``, its floor in the same unit, and the limit that it should keep."""

    name: str
    value: float
    floor: float | None
    limit: str
    kept: bool
    unit: str = "s"


def main() -> int:
    """Run every benchmark; with ``--check``, exit 1 if a limit is not kept."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks")
    parser.add_argument("--json", type=Path, help="also write the figures to this file")
    parser.add_argument(
        "--rounds", type=int, default=5, help="rounds of each figure, which is the median"
    )
    parser.add_argument("--enclaves", type=int, default=1000, help="enclaves of a keystore")
    parser.add_argument("--topics", type=int, default=20000, help="topics of one policy group")
    parser.add_argument("--renew", type=int, default=0, help="also renew this number of enclaves")
    parser.add_argument(
        "--fleet", type=int, default=0, help="only measure a fleet of this number of enclaves"
    )
    parser.add_argument(
        "--agents", type=int, default=0, help="only measure this number of robots that fetch"
    )
    parser.add_argument(
        "--protection",
        choices=("auto", "rclpy", "cyclone"),
        help="only measure what encryption and signatures cost on this back end of the demo",
    )
    parser.add_argument("--check", action="store_true", help="exit 1 if a limit is not kept")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        if options.fleet:
            return _report((Row(*each) for each in fleet(folder, options.fleet, RULES)), options)
        if options.agents:
            fetched = fetching(folder, options.agents, RULES)
            return _report((Row(*figure) for figure in fetched), options)
        if options.protection:
            figures = protecting(folder, options.protection, options.rounds)
            return _report((Row(*figure) for figure in figures), options)
        rows = _artifacts(folder, options.enclaves, options.rounds)
        rows += _topics(folder, options.topics, options.rounds)
        rows += _starts(folder, options.rounds)
        rows += _memory(folder, options.enclaves)
        rows += [Row(name, taken, None, limit, kept) for name, taken, limit, kept in observing()]
        rows += [Row(*figure) for figure in deciding()]
        checked = checking(folder, options.enclaves, RULES, options.rounds)
        checked += explaining(folder, options.enclaves, RULES, options.rounds)
        checked += explaining_zenoh(folder, options.enclaves, RULES, options.rounds)
        checked += requiring(folder, options.enclaves, options.rounds)
        rows += [Row(name, taken, None, limit, kept) for name, taken, limit, kept in checked]
        rows += [
            Row(*figure) for figure in zenoh_files(folder, options.enclaves, RULES, options.rounds)
        ]
        rows += [Row(*figure) for figure in picturing(folder, options.rounds)]
        rows += _renewal(folder, options.renew) if options.renew else []
    return _report(rows, options)


def _report(rows: Iterable[Row], options: argparse.Namespace) -> int:
    """Print each row of the table as soon as it is there; return the exit status."""
    print(f"Python {platform.python_version()}, {os.cpu_count()} cores, medians")
    print(f"{'task':58} {'sros':>9} {'floor':>9} {'ratio':>6}  limit", flush=True)
    shown: list[Row] = []
    for row in rows:
        floor = f"{row.floor:9.3f}" if row.floor is not None else " " * 9
        ratio = f"{row.value / row.floor:6.2f}" if row.floor else " " * 6
        kept = "" if row.kept else "  NOT KEPT"
        print(f"{row.name:58} {row.value:9.3f} {floor} {ratio}  {row.limit}{kept}", flush=True)
        shown.append(row)
    if options.json:
        options.json.write_text(json.dumps([asdict(row) for row in shown], indent=2) + "\n")
    return 1 if options.check and not all(row.kept for row in shown) else 0


def _renewal(folder: Path, count: int) -> list[Row]:
    from benchmarks.life import measure_renewal

    found = measure_renewal(folder, count)
    kept = found.taken <= 2 * found.floor
    return [
        Row(f"renew {count} enclaves", found.taken, found.floor, "2 x floor", kept),
        Row("... floor, without verifying the old files", found.taken, found.unchecked, "-", True),
    ]


def _timed(action: Callable[[int], object], rounds: int) -> float:
    times = []
    for index in range(rounds):
        begin = time.perf_counter()
        action(index)
        times.append(time.perf_counter() - begin)
    return statistics.median(times)


def _cpu_seconds() -> float:
    """Return the CPU time of this process and of those that it started and that have ended."""
    used = map(resource.getrusage, (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    return sum(each.ru_utime + each.ru_stime for each in used)


def _artifacts(folder: Path, count: int, rounds: int) -> list[Row]:
    from sros_tool.keystore.lifecycle.create import create_keystore, generate_artifacts
    from sros_tool.keystore.template import load_template
    from sros_tool.policy.document import read_policy

    now = datetime.now(UTC)
    policy = folder / "enclaves.xml"
    policy.write_text(enclaves_policy(count, RULES))
    template = load_template("development")

    def make(root: Path) -> None:
        generate_artifacts(root, policies=[read_policy(policy)], now=now)

    for index in range(rounds):
        create_keystore(folder / f"ks{index}", template=template, now=now)
    began = _cpu_seconds()
    made = _timed(lambda index: make(folder / f"ks{index}"), rounds)
    made_cpu = (_cpu_seconds() - began) / rounds
    again = _timed(lambda index: make(folder / f"ks{index}"), rounds)
    files = sizes_of(folder / "ks0/enclaves/robot0/part")
    for index in range(rounds):
        (folder / f"floor{index}").mkdir()
    began = _cpu_seconds()
    floor = _timed(lambda i: make_enclaves(folder / f"floor{i}", files, count), rounds)
    floor_cpu = (_cpu_seconds() - began) / rounds
    task = f"policy of {count} enclaves, {RULES} rules each -> all artifacts"
    again_task = "... again: nothing changes"
    kept = made <= 2 * floor and made < 1.5
    return [
        Row(task, made, floor, "2 x floor and 1.5 s", kept),
        Row("... seconds of CPU", made_cpu, floor_cpu, "3.5 x floor", made_cpu <= 3.5 * floor_cpu),
        Row(again_task, again, floor, "-", True),
    ]


def _topics(folder: Path, most: int, rounds: int) -> list[Row]:
    from sros_tool.keystore.lifecycle.create import (
        create_enclaves,
        create_keystore,
        create_permission,
    )
    from sros_tool.keystore.template import load_template
    from sros_tool.policy.document import read_policy

    now = datetime.now(UTC)
    root = folder / "topics"
    create_keystore(root, template=load_template("development"), now=now)
    create_enclaves(root, ["/big"], now=now)
    rows: list[Row] = []
    for count in (most // 10, most):
        file = folder / f"topics{count}.xml"
        file.write_text(topics_policy(count))
        taken = _timed(
            lambda _, file=file: create_permission(root, ["/big"], read_policy(file), now=now),  # type: ignore[misc]
            rounds,
        )
        limit = "0.5 s" if count == most else "-"
        rows.append(Row(f"one policy group of {count} topics", taken, None, limit, taken < 0.5))
    growth = rows[1].value / rows[0].value
    rows.append(Row("... 10 times the topics take", growth, None, "linear", growth < 13, "x"))
    return rows


def _starts(folder: Path, rounds: int) -> list[Row]:
    program = str(Path(sys.executable).with_name("sros"))
    root = str(folder / "ks0")

    def run(*command: str) -> float:
        return _timed(
            lambda _: subprocess.run(command, check=True, stdout=subprocess.DEVNULL), 3 * rounds
        )

    floor = run(sys.executable, "-c", "pass")
    rows = []
    for words in (("--help",), ("list_enclaves", str(folder / "topics"))):
        taken = run(program, *words)
        limit = "60 ms above python -c pass"
        rows.append(Row(f"sros {words[0]}", taken, floor, limit, taken - floor <= 0.060))
    taken = run(program, "list_enclaves", root)
    rows.append(Row("sros list_enclaves, all of the first", taken, floor, "-", True))
    return rows


_PEAK = """
import sys
from datetime import UTC, datetime
from pathlib import Path
from sros_tool.keystore.lifecycle.create import create_keystore, generate_artifacts
from sros_tool.keystore.template import load_template
root, count = Path(sys.argv[1]), int(sys.argv[2])
now = datetime.now(UTC)
create_keystore(root, template=load_template("development"), now=now)
generate_artifacts(root, enclaves=[f"/robot{i}/part" for i in range(count)], now=now)
# Not ru_maxrss, which includes the size of the parent process.
print(next(line for line in open("/proc/self/status") if line.startswith("VmHWM")).split()[1])
"""


def _memory(folder: Path, enclaves: int) -> list[Row]:
    few, many = enclaves // 10, enclaves * 4
    peaks = []
    for count in (few, many):
        command = [sys.executable, "-c", _PEAK, str(folder / f"memory{count}"), str(count)]
        peaks.append(int(subprocess.run(command, check=True, capture_output=True).stdout) / 1024)
    growth = (peaks[1] - peaks[0]) / (many - few) * 1024
    task = f"peak memory, {many} enclaves (floor: {few})"
    return [
        Row(task, peaks[1], peaks[0], "-", True, "MB"),
        Row("... for each further enclave, in kB", growth, None, "8 kB", growth < 8, "kB"),
    ]


if __name__ == "__main__":
    sys.exit(main())
