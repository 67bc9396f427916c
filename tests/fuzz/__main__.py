"""Try many mutated inputs in all readers and verbs: ``python -m tests.fuzz --count 1000000``."""

from __future__ import annotations

import argparse
import os
import sys
import time
import warnings
from pathlib import Path

from tests.fuzz.runner import WEIGHTS, Findings, fuzz, shares


def main() -> int:
    """Print what was found, and the figures of each reader; return 1 if anything was found."""
    parser = argparse.ArgumentParser(prog="python -m tests.fuzz", description=__doc__)
    parser.add_argument("--count", type=int, default=100_000, help="inputs in all [100000]")
    parser.add_argument("--seed", default="0", help="another seed draws other inputs [0]")
    parser.add_argument("--reader", action="append", choices=sorted(WEIGHTS), help="only this one")
    parser.add_argument("--first", type=int, default=0, help="number of the first input [0]")
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1, help="processes")
    parser.add_argument("--keep", type=Path, help="folder for the inputs that found something")
    given = parser.parse_args()
    warnings.simplefilter("ignore")
    seen: set[tuple[str, str]] = set()
    if given.keep:
        given.keep.mkdir(parents=True, exist_ok=True)

    def report(name: str, findings: Findings) -> None:
        for fault, (number, data) in findings.found.items():
            if (name, fault) in seen:
                continue
            seen.add((name, fault))
            shown = data if isinstance(data, str) else f"{len(data)} bytes"
            print(f"{name}, input {number} ({shown}):\n  {fault}", flush=True)
            if given.keep:
                path = given.keep / f"{name.replace('/', '-')}-{number}"
                path.write_bytes(data if isinstance(data, bytes) else data.encode(errors="replace"))

    began = time.monotonic()
    counts = shares(given.count, given.reader or list(WEIGHTS))
    found = fuzz(counts, given.seed, first=given.first, jobs=given.jobs, report=report)
    print(f"{'reader':18}{'inputs':>9}{'refused':>9}{'found':>7}{'CPU s':>8}{'worst':>8}{'MiB':>6}")
    for name, each in found.items():
        print(
            f"{name:18}{each.tried:9}{each.refused:9}{sum(each.counted.values()):7}"
            f"{each.cpu:8.0f}{each.worst_cpu:8.2f}{each.worst_memory / 1024:6.0f}"
        )
    tried = sum(each.tried for each in found.values())
    faults = sum(len(each.found) for each in found.values())
    print(f"{tried} inputs, {faults} faults, {time.monotonic() - began:.0f} s, seed {given.seed}")
    return 1 if faults else 0


if __name__ == "__main__":
    sys.exit(main())
