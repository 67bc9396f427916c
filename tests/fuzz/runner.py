"""Try mutated inputs in forked processes, and measure what each of them takes."""

from __future__ import annotations

import io
import mmap
import os
import pickle
import random
import resource
import shutil
import signal
import sys
import tempfile
import time
import traceback
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

from sros_tool.errors import SrosError
from tests.fuzz.corpus import Corpus, make_corpus
from tests.fuzz.folders import Folders
from tests.fuzz.mutations import Mutator
from tests.fuzz.readers import READERS, Place

MOST_CPU = 2.0
"""Seconds of CPU that an input may take."""
MOST_MEMORY = 200 * 1024
"""Memory that an input may take, in KiB."""
KILLED_AFTER = 20.0
"""Seconds of CPU after which a process is killed by the system."""
VERBS = "verbs on folders"
WEIGHTS: Mapping[str, float] = {**{name: each.weight for name, each in READERS.items()}, VERBS: 1.5}

Attempt = Callable[[random.Random], tuple[str | bytes, Callable[[], object]]]
"""Draws an input, and returns it and the function that tries it."""


@dataclass
class Findings:
    """What trying a number of inputs of one reader has found.

    ``found`` maps a fault to the input that showed it first; ``counted`` says how often.
    """

    tried: int = 0
    refused: int = 0
    cpu: float = 0
    worst_cpu: float = 0
    worst_memory: int = 0
    found: dict[str, tuple[int, str | bytes]] = field(default_factory=dict)
    counted: dict[str, int] = field(default_factory=dict)

    def add(self, fault: str, number: int, given: str | bytes) -> None:
        self.found.setdefault(fault, (number, given))
        self.counted[fault] = self.counted.get(fault, 0) + 1

    def include(self, other: Findings) -> None:
        self.tried += other.tried
        self.refused += other.refused
        self.cpu += other.cpu
        self.worst_cpu = max(self.worst_cpu, other.worst_cpu)
        self.worst_memory = max(self.worst_memory, other.worst_memory)
        for fault, (number, given) in other.found.items():
            self.found.setdefault(fault, (number, given))
            self.counted[fault] = self.counted.get(fault, 0) + other.counted[fault]


def shares(count: int, names: Sequence[str]) -> dict[str, int]:
    """Distribute ``count`` inputs among readers by their weights."""
    whole = sum(WEIGHTS[name] for name in names)
    return {name: max(1, round(count * WEIGHTS[name] / whole)) for name in names}


def attempts(name: str, corpus: Corpus, folder: Path) -> Attempt:
    """Return what draws and tries the inputs of a reader; it leaves files in ``folder`` only."""
    if name == VERBS:
        folders = Folders(corpus, folder / "place")

        def run(dice: random.Random) -> tuple[str | bytes, Callable[[], object]]:
            trial = folders.draw(dice)
            return str(trial), lambda: folders.run(trial)

        return run
    reader, place = READERS[name], Place(corpus, folder)
    mutator = Mutator(corpus.read(*reader.corpus), corpus.key, corpus.sign)

    def read(dice: random.Random) -> tuple[str | bytes, Callable[[], object]]:
        data = mutator.draw(dice)
        return data, lambda: reader.read(data, place)

    return read


def try_range(
    name: str, corpus: Corpus, numbers: range, seed: object, begun: Callable[[int], object]
) -> Findings:
    """Try the inputs with these numbers in this process; ``begun`` is called before each."""
    findings = Findings()
    with tempfile.TemporaryDirectory(dir=corpus.root.parent) as folder:
        attempt = attempts(name, corpus, Path(folder))
        for number in numbers:
            begun(number)
            given, run = attempt(random.Random(f"{seed}:{name}:{number}"))
            memory, cpu = _memory(), _cpu()
            try:
                run()
            except SrosError:
                findings.refused += 1
            except KeyboardInterrupt:
                raise
            except BaseException as error:  # a panic of a library is no Exception
                findings.add(_fault(error), number, given)
            took, grown = _cpu() - cpu, _memory() - memory
            findings.tried += 1
            findings.cpu += took
            findings.worst_cpu = max(findings.worst_cpu, took)
            findings.worst_memory = max(findings.worst_memory, grown)
            if took > MOST_CPU:
                findings.add("takes too much CPU", number, given)
            if grown > MOST_MEMORY:
                findings.add("takes too much memory", number, given)
    return findings


def _cpu() -> float:
    children = resource.getrusage(resource.RUSAGE_CHILDREN)
    return time.process_time() + children.ru_utime + children.ru_stime


def _memory() -> int:
    own, children = (
        resource.getrusage(who).ru_maxrss
        for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)
    )
    return max(own, children)


def _fault(error: BaseException) -> str:
    """Return a text that is the same for the same fault: the class and the last places in sros."""
    if type(error).__name__ == "UnexpectedError":
        lines = [line for line in str(error).splitlines() if line.strip()]
        return " | ".join(lines[-4:])[:500]
    frames = traceback.extract_tb(error.__traceback__)
    own = [each for each in frames if "sros_tool" in each.filename][-3:] or frames[-1:]
    places = " > ".join(f"{Path(each.filename).name}:{each.lineno}" for each in own)
    return f"{type(error).__name__} at {places}: {str(error)[:100]}"


def fuzz(
    counts: Mapping[str, int],
    seed: object,
    *,
    first: int = 0,
    jobs: int = 1,
    chunk: int = 1000,
    report: Callable[[str, Findings], object] = lambda *_: None,
) -> dict[str, Findings]:
    """Try inputs of several readers, in processes of ``chunk`` inputs.

    ``report`` is called with all findings of a reader whenever there is news of it.
    """
    shared = mmap.mmap(-1, 8 * jobs)
    found = {name: Findings() for name in counts}
    memory = Path("/dev/shm")
    where = memory if os.access(memory, os.W_OK) else None
    base = Path(tempfile.mkdtemp(dir=where, prefix="sros-fuzz-"))
    (base / "corpus").mkdir()
    try:
        corpus = make_corpus(base / "corpus")
        work = [
            (name, range(begin, min(begin + _chunk(name, chunk), first + count)))
            for name, count in counts.items()
            for begin in range(first, first + count, _chunk(name, chunk))
        ]
        random.Random(0).shuffle(work)
        for name, findings in _in_processes(work, corpus, seed, jobs, shared):
            found[name].include(findings)
            report(name, found[name])
    finally:
        shutil.rmtree(base, ignore_errors=True)
    return found


def _chunk(name: str, chunk: int) -> int:
    return max(1, chunk // 5) if name == VERBS else chunk


def _in_processes(
    work: list[tuple[str, range]], corpus: Corpus, seed: object, jobs: int, shared: mmap.mmap
) -> Iterator[tuple[str, Findings]]:
    running: dict[int, tuple[str, range, int, Path]] = {}
    free = list(range(jobs))
    while work or running:
        while work and free:
            name, numbers = work.pop()
            slot = free.pop()
            answer = corpus.root.parent / f"answer-{slot}"
            answer.unlink(missing_ok=True)
            child = os.fork()
            if child == 0:
                _work(name, numbers, corpus, seed, shared, slot, answer)
            running[child] = name, numbers, slot, answer
        child, status = os.wait()
        if child not in running:
            continue
        name, numbers, slot, answer = running.pop(child)
        free.append(slot)
        if answer.exists():
            yield name, pickle.loads(answer.read_bytes())
            continue
        number = int.from_bytes(shared[8 * slot : 8 * slot + 8], "little")
        ended = os.waitstatus_to_exitcode(status)
        given, _ = attempts(name, corpus, Path(tempfile.mkdtemp(dir=corpus.root.parent)))(
            random.Random(f"{seed}:{name}:{number}")
        )
        findings = Findings(tried=number - numbers.start + 1)
        findings.add(f"the process ended with {ended}", number, given)
        yield name, findings
        if number + 1 < numbers.stop:
            work.append((name, range(number + 1, numbers.stop)))


def _work(
    name: str,
    numbers: range,
    corpus: Corpus,
    seed: object,
    shared: mmap.mmap,
    slot: int,
    answer: Path,
) -> None:
    status = 1
    try:
        os.setpgid(0, 0)
        sys.stdin = io.TextIOWrapper(io.BytesIO())
        resource.setrlimit(resource.RLIMIT_AS, (4 << 30, 4 << 30))
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))

        def begun(number: int) -> None:
            shared[8 * slot : 8 * slot + 8] = number.to_bytes(8, "little")
            signal.setitimer(signal.ITIMER_PROF, KILLED_AFTER)
            signal.setitimer(signal.ITIMER_REAL, 2 * KILLED_AFTER)

        findings = try_range(name, corpus, numbers, seed, begun)
        part = answer.with_suffix(".part")
        part.write_bytes(pickle.dumps(findings))
        part.rename(answer)
        status = 0
    except BaseException:
        traceback.print_exc()
    finally:
        with suppress(OSError):
            sys.stderr.flush()
        os._exit(status)
