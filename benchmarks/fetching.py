"""Benchmark of a fleet that fetches: agents against one nginx, as in docs/howto/fleet_server.md.

Each round runs every agent once, in as many processes as there are cores.  Requests and bytes are
those that nginx counted.
"""

from __future__ import annotations

import os
import subprocess
import time
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from datetime import UTC, datetime
from functools import partial
from pathlib import Path

from click.testing import CliRunner

from benchmarks.fleet import Figure, cost
from benchmarks.inputs import fleet_file, fleet_policy
from sros_tool.agent.agent import Machine, run_round
from sros_tool.agent.settings import read_settings
from sros_tool.cli.program import program
from sros_tool.keystore.issuing.keyring import no_secrets
from sros_tool.runtime.processes import RunningProcesses
from tests.support.nginx import certify_server, nginx_of_page

_PORT = 18443
_LOG = """\
log_format sizes '$request_method $request_length $bytes_sent';
    access_log {folder}/access.log sizes;"""


def fetching(folder: Path, robots: int, rules: int) -> Iterator[Figure]:
    """Measure a first delivery, a round without news, and a changed policy."""
    names = [f"r{number}" for number in range(1, robots + 1)]
    (folder / "fleet.toml").write_text(fleet_file(robots))
    (folder / "policy.xml").write_text(fleet_policy(1, rules))
    os.chdir(folder)
    make = ["generate_artifacts", "-k", "keystore", "-p", "policy.xml", "--fleet", "fleet.toml"]
    publish = ["fleet", "publish", "keystore", "srv/pub"]
    collect = ["fleet", "collect", "keystore", "srv/inbox"]
    _run("create_keystore", "keystore", "--template", "production")
    _run("crl", "keystore", "--refresh")  # the web server has a list from the start
    _run(*make)
    yield _figure(f"{robots} robots published for the first time: CPU", cost(*publish).cpu, "s")
    with _nginx(folder) as server:
        for name in names:
            _set_up(folder, name)
        for news in ("first delivery", "nothing new", "a changed policy"):
            if news == "a changed policy":
                (folder / "policy.xml").write_text(fleet_policy(1, rules + 1))
                yield _figure(f"{news}: making it, CPU", cost(*make).cpu, "s")
                yield _figure(f"{news}: publishing it, CPU", cost(*publish).cpu, "s")
            yield from _round(folder, names, news, server)
            yield _figure(f"{news}: collecting, CPU", cost(*collect).cpu, "s")
            yield _figure(f"{news}: status, CPU", cost("fleet", "status", "keystore").cpu, "s")


def _round(
    folder: Path, names: list[str], news: str, server: subprocess.Popen[bytes]
) -> Iterator[Figure]:
    log = folder / "nginx/access.log"
    log.write_bytes(b"")
    before = _cpu_of(server)
    with ProcessPoolExecutor() as pool:
        taken = list(pool.map(partial(_agent, folder), names, chunksize=10))
    requests = [line.split() for line in log.read_text().splitlines()]
    gets = [int(sent) for method, _, sent in requests if method == "GET"]
    puts = [int(length) for method, length, _ in requests if method == "PUT"]
    count = len(names)
    yield _figure(f"{news}: CPU of an agent", sum(taken) / count, "s")
    yield _figure(f"{news}: requests of an agent", len(requests) / count, "")
    yield _figure(f"{news}: fetched by an agent", sum(gets) / count / 1000, "kB")
    yield _figure(f"{news}: sent by an agent", sum(puts) / count / 1000, "kB")
    yield _figure(f"{news}: CPU of nginx", _cpu_of(server) - before, "s")


def _agent(folder: Path, name: str) -> float:
    """Run a round of an agent; return its CPU time.  It must have nothing to complain about."""
    root = folder / "robots" / name
    nothing_runs = RunningProcesses((), ())
    machine = Machine(datetime.now(UTC), UTC, no_secrets, look=lambda _now: nothing_runs)
    before = time.process_time()
    done = run_round(root, read_settings(root), machine)
    if done.problems:
        raise RuntimeError(f"{name}: {done.problems}")
    return time.process_time() - before


def _set_up(folder: Path, name: str) -> None:
    root, address = f"robots/{name}", f"https://127.0.0.1:{_PORT}"
    _run("distribute_key", "keystore", "--robot", name, root)
    _run(
        *("agent", "init", root, "--robot", name, "--root", "srv/pub/metadata/1.root.json"),
        *("--from", f"{address}/pub", "--inbox", f"{address}/inbox"),
        *("--tls-ca", str(folder / "etc/server.cert.pem")),
    )


def _nginx(folder: Path) -> subprocess.Popen[bytes]:
    (folder / "srv/inbox").mkdir()
    certify_server(folder, folder / "keystore")
    place = folder / "nginx"
    log = _LOG.format(folder=place)
    listen = f"127.0.0.1:{_PORT}"
    return _Server(nginx_of_page(folder, place, listen=listen, log=log, main="daemon off;"))


class _Server(subprocess.Popen[bytes]):
    """A process that ends with the block."""

    def __exit__(self, *what: object) -> None:
        self.terminate()
        self.wait()


def _cpu_of(server: subprocess.Popen[bytes]) -> float:
    """Return the CPU time of a process and its children, in seconds."""
    children = Path(f"/proc/{server.pid}/task/{server.pid}/children").read_text().split()
    ticks = 0
    for pid in (server.pid, *children):
        stat = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
        ticks += int(stat[11]) + int(stat[12])
    return ticks / os.sysconf("SC_CLK_TCK")


def _run(*words: str) -> None:
    done = CliRunner().invoke(program, words)
    if done.exit_code:
        raise RuntimeError(f"{' '.join(words)}: {done.output}")


def _figure(task: str, value: float, unit: str) -> Figure:
    return (task, value, None, "-", True, unit)
