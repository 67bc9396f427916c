"""Benchmarks of a keystore for a whole fleet: each verb as a process, with its CPU and memory.

The CPU time of a verb is that of all its processes; where others use the machine, too, it tells
more than the time that passed.  The memory is the peak of the sum over its processes (PSS, which
counts what forked workers share once).
"""

from __future__ import annotations

import os
import resource
import subprocess
import sys
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

from benchmarks.floor import make_enclaves, sizes_of
from benchmarks.inputs import fleet_file, fleet_policy
from sros_tool.keystore.confirmation import (
    Confirmation,
    ReceivedConfirmation,
    make_confirmation,
    store_confirmation,
)
from sros_tool.keystore.reader import OpenedKeystore

PER_ROBOT = 100
_MADE = 1.5
"""Most that making may take, as a multiple of the floor."""

Figure = tuple[str, float, float | None, str, bool, str]
"""The task, its value, the floor, the limit, whether it is kept, and the unit."""


@dataclass(frozen=True)
class Cost:
    """What a command took: seconds that passed, seconds of CPU, and peak memory in MB."""

    passed: float
    cpu: float
    memory: float


def fleet(folder: Path, enclaves: int, rules: int) -> Iterator[Figure]:
    """Measure the verbs on a keystore with this number of enclaves, 100 for each robot."""
    root, policy, robots = folder / "fleet", folder / "fleet.xml", folder / "fleet.toml"
    policy.write_text(fleet_policy(PER_ROBOT, rules))
    robots.write_text(fleet_file(enclaves // PER_ROBOT))
    make = ("generate_artifacts", "-k", root, "-p", policy, "--fleet", robots)
    made = cost(*make)
    sizes = sizes_of(root / "enclaves/r1/part_0")
    floor = _cost_of(
        [
            sys.executable,
            "-m",
            "benchmarks.fleet",
            str(folder / "floor"),
            str(enclaves),
            *_words(sizes),
        ]
    )
    limit = f"{_MADE} x floor"
    yield (
        f"a fleet of {enclaves} enclaves made",
        made.passed,
        floor.passed,
        limit,
        made.passed <= _MADE * floor.passed,
        "s",
    )
    yield ("... CPU of all processes", made.cpu, floor.cpu, "-", True, "s")
    yield ("... peak memory, in MB", made.memory, floor.memory, "-", True, "MB")
    one_changed = folder / "changed.toml"
    one_changed.write_text(f'{fleet_file(enclaves // PER_ROBOT)}namespace = "/elsewhere"\n')
    for task, words in (
        ("... again without a change", make),
        ("... again, one robot changed", (*make[:-1], one_changed)),
        ("... list_enclaves", ("list_enclaves", root)),
        ("... explain of one right", ("explain", root, "/r1/part_3", "publish", "/r1/topic_0")),
        ("... explain --who", ("explain", root, "--who", "publish", "/r1/topic_0")),
        ("... check", ("check", "keystore", root)),
        ("... metrics", ("metrics", root)),
        ("... distribute_key --robot", ("distribute_key", root, "--robot", "r1", folder / "r1")),
        ("... fleet status", ("fleet", "status", root)),
        ("... revoke --robot", ("revoke", root, "--robot", "r2")),
        ("... revoke --robot, of a second robot", ("revoke", root, "--robot", "r3")),
        ("... renew --all-expiring, all of them", ("renew", root, "--all-expiring", "100y")),
    ):
        if words[0] == "fleet":
            _confirm(root, enclaves // PER_ROBOT)
        taken = cost(*words)
        yield (task, taken.passed, None, "-", True, "s")
        yield (f"{task}: CPU", taken.cpu, None, "-", True, "s")
        yield (f"{task}: peak memory, in MB", taken.memory, None, "-", True, "MB")


def _confirm(root: Path, robots: int) -> None:
    """Have all robots but the last one confirm that they have the current files."""
    now = datetime.now(UTC)
    keystore = OpenedKeystore(root)
    whole = make_confirmation(root, "r1", now=now)
    files: dict[str, dict[str, str]] = {}
    for path, digest in whole.files.items():
        files.setdefault(path.split("/")[1], {})[path] = digest
    for number in range(1, robots):
        own = files[f"r{number}"]
        certificates = {
            path: whole.certificates[path] for path in own if path in whole.certificates
        }
        confirmation = Confirmation(f"r{number}", now, own, certificates)
        store_confirmation(keystore, ReceivedConfirmation(confirmation, now))


def _words(sizes: Sequence[tuple[str, int | str]]) -> list[str]:
    return [f"{name}={size}" for name, size in sizes]


def cost(*words: object) -> Cost:
    """Run sros with these words and return what it cost."""
    return _cost_of([sys.executable, "-m", "sros_tool", *map(str, words)])


def _cost_of(command: Sequence[str]) -> Cost:
    """Run a command and return its cost; its exit status may be 1, as of `check` with findings."""
    before, begin = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
    with subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE) as process:
        peaks = [0.0]
        looking = threading.Thread(target=_watch, args=(process, peaks))
        looking.start()
        _, said = process.communicate()
        looking.join()
    if process.returncode not in (0, 1):
        raise RuntimeError(f"{' '.join(command)}: {said.decode()}")
    passed = time.perf_counter() - begin
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    cpu = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return Cost(passed, cpu, max(peaks))


def _watch(process: subprocess.Popen[bytes], peaks: list[float]) -> None:
    """Add the memory of a process and its children, in MB, ten times a second until it ends."""
    while process.poll() is None:
        peaks.append(sum(map(_memory, _with_children(process.pid))) / 1024)
        time.sleep(0.1)


def _with_children(process: int) -> list[int]:
    found = [process]
    for each in found:  # which grows
        with suppress(OSError):
            for task in os.listdir(f"/proc/{each}/task"):
                text = Path(f"/proc/{each}/task/{task}/children").read_text()
                found += map(int, text.split())
    return found


def _memory(process: int) -> int:
    """Return the memory of a process in kB, with its part of what it shares."""
    with suppress(OSError):
        for line in Path(f"/proc/{process}/smaps_rollup").read_text().splitlines():
            if line.startswith("Pss:"):
                return int(line.split()[1])
    return 0


def _floor(folder: Path, count: int, sizes: Sequence[str]) -> None:
    """Do the cryptography and write the files of enclaves on all cores, as sros does."""
    from sros_tool.parallel import map_slices

    folder.mkdir()
    pairs = [each.partition("=") for each in sizes]
    files = [(name, int(size) if size.isdigit() else size) for name, _, size in pairs]

    def make(part: Sequence[int]) -> None:
        place = folder / str(part[0])
        place.mkdir()
        make_enclaves(place, files, len(part))

    map_slices(range(count), make)
    os.sync()


if __name__ == "__main__":
    _floor(Path(sys.argv[1]), int(sys.argv[2]), sys.argv[3:])
