"""Real processes of the program, killed at random moments or started all at once."""

from __future__ import annotations

import json
import os
import random
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from harness import check_whole, policy_text, publish, remains, topics_of

from sros_tool.keystore.layout import enclave_folder

KILLS = 220
# Forks the imported program for each line; a program of its own would take 0.2 s to start.
SERVER = """
import json, os, signal, sys, time
answers = os.fdopen(os.dup(1), "w")
for descriptor in (1, 2):  # what the program prints goes nowhere
    os.dup2(os.open(os.devnull, os.O_WRONLY), descriptor)
from sros_tool.cli import main
import sros_tool.cli.keystore, sros_tool.cli.program, sros_tool.keystore.create
import sros_tool.keystore.parallel, sros_tool.policy
for line in sys.stdin:
    pause, words = json.loads(line)
    child = os.fork()
    if child == 0:
        try:
            sys.argv = ["sros", *words]
            main(words)
        except SystemExit as end:
            os._exit(end.code or 0)
        finally:
            os._exit(70)
    if pause is not None:
        time.sleep(pause)
        os.kill(child, signal.SIGKILL)
    _, status = os.waitpid(child, 0)
    print(os.waitstatus_to_exitcode(status), file=answers, flush=True)
"""


class Server:
    """Starts the program, already imported, in processes of its own."""

    def __init__(self) -> None:
        self._process = subprocess.Popen(
            [sys.executable, "-c", SERVER],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            env={**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))},
        )

    def run(self, *words: object, kill_after: float | None = None) -> int:
        """Run the program; its exit status, which is negative if it was killed."""
        assert self._process.stdin
        assert self._process.stdout
        self._process.stdin.write(json.dumps([kill_after, list(map(str, words))]) + "\n")
        self._process.stdin.flush()
        return int(self._process.stdout.readline())

    def close(self) -> None:
        self._process.communicate(timeout=10)


@pytest.fixture
def server() -> Iterator[Server]:
    serving = Server()
    yield serving
    serving.close()


def write_policy(path: Path, version: str, enclaves: list[str]) -> Path:
    text = policy_text({name: publish(f"{version}{name}".replace("/", "_")) for name in enclaves})
    path.write_text(text)
    return path


def versions(keystore: Path, enclaves: list[str]) -> set[str]:
    """Which policy each enclave now has, as DDS would load it."""
    found = set()
    for name in enclaves:
        topics = topics_of(keystore / enclave_folder(name)) - {"ros_discovery_info"}
        assert len(topics) == 1, f"{name} may use {sorted(topics)}"
        (topic,) = topics
        version, _, rest = topic.removeprefix("rt/").partition("_")
        assert rest == name[1:].replace("/", "_")
        found.add(version)
    return found


def test_killed_at_random_moments(server: Server, keystore: Path, tmp_path: Path) -> None:
    """Acceptance 4: no file is empty, no pair torn, no enclave has rights of neither policy."""
    enclaves = ["/a", "/b", "/a/inner", "/c/d/e"]
    policies = [write_policy(tmp_path / f"{name}.xml", name, enclaves) for name in ("v1", "v2")]
    assert server.run("generate_artifacts", "-k", keystore, "-p", policies[0]) == 0
    durations = []
    for policy in (policies[1], policies[0], policies[1], policies[0]):
        started = time.monotonic()
        assert server.run("generate_artifacts", "-k", keystore, "-p", policy) == 0
        durations.append(time.monotonic() - started)
    assert versions(keystore, enclaves) == {"v1"}
    longest = 1.1 * sorted(durations)[2]
    moments = random.Random(4)
    current, killed, changed = "v1", 0, 0
    for number in range(KILLS):
        wanted = "v2" if current == "v1" else "v1"
        words: list[object] = ["-e", f"/new{number}"] if number % 10 == 0 else []
        policy = policies[wanted == "v2"]
        pause = moments.uniform(0, longest)
        status = server.run(
            "generate_artifacts", "-k", keystore, "-p", policy, *words, kill_after=pause
        )
        assert status in (0, -signal.SIGKILL)
        killed += status != 0
        check_whole(keystore)
        now = versions(keystore, enclaves)
        assert now in ({current}, {wanted}), f"kill {number} after {pause:.4f} s"
        assert status != 0 or now == {wanted}
        changed += now == {wanted}
        (current,) = now
    assert killed > KILLS / 2, "most of the processes ended before they were killed"
    assert 10 < changed < KILLS - 10, "the kills were not spread over the work"
    assert server.run("generate_artifacts", "-k", keystore, "-p", policies[0]) == 0
    check_whole(keystore)
    assert versions(keystore, enclaves) == {"v1"}
    assert not remains(tmp_path)


def test_killed_while_signing_with_every_core(
    server: Server, keystore: Path, tmp_path: Path
) -> None:
    """The processes that share the work end with the one that was killed."""
    enclaves = [f"/fleet/n{number}" for number in range(220)]
    policies = [write_policy(tmp_path / f"{name}.xml", name, enclaves) for name in ("v1", "v2")]
    started = time.monotonic()
    assert server.run("generate_artifacts", "-k", keystore, "-p", policies[0]) == 0
    longest = time.monotonic() - started
    moments = random.Random(5)
    current = "v1"
    for _ in range(8):
        wanted = "v2" if current == "v1" else "v1"
        server.run(
            *("generate_artifacts", "-k", keystore, "-p", policies[wanted == "v2"]),
            kill_after=moments.uniform(0.1, 1.0) * longest,
        )
        now = versions(keystore, enclaves)
        assert now in ({current}, {wanted})
        (current,) = now
    assert server.run("generate_artifacts", "-k", keystore, "-p", policies[0]) == 0
    check_whole(keystore)
    assert versions(keystore, enclaves) == {"v1"}
    assert not remains(tmp_path)


def openssl(*words: object) -> None:
    subprocess.run(["openssl", *map(str, words)], check=True, capture_output=True)


def verify_with_openssl(keystore: Path) -> None:
    for role in ("identity", "permissions"):
        certificate = keystore / f"public/{role}_ca.cert.pem"
        openssl("verify", "-x509_strict", "-CAfile", certificate, certificate)
    governance = keystore / "enclaves/governance.p7s"
    openssl("smime", "-verify", "-text", "-in", governance, "-CAfile", certificate)


@pytest.mark.parametrize("root", ["missing", "empty", "in a missing folder"])
def test_bug_17_of_eight_at_once_one_makes_the_keystore(root: str, tmp_path: Path) -> None:
    keystore = tmp_path / ("deep/er/ks" if "folder" in root else "ks")
    command = [sys.executable, "-c", _STARTER, str(keystore)]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    for _ in range(5):
        if root == "empty":
            keystore.mkdir()
        ended = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
        statuses = json.loads(ended.stdout.splitlines()[-1])
        assert sorted(statuses) == [0] + [1] * 7, ended.stderr
        assert ended.stderr.count("already exists") == 7, ended.stderr
        verify_with_openssl(keystore)
        check_whole(keystore)
        assert not remains(tmp_path)
        shutil.rmtree(keystore)


_STARTER = """
import json, os, sys, time
from pathlib import Path
import sros_tool.keystore.create, sros_tool.cli.keystore, sros_tool.cli.program
from sros_tool.cli import main
sys.argv = ["sros", "create_keystore", sys.argv[1]]
ready, go = os.pipe()
children = []
for _ in range(8):
    child = os.fork()
    if child == 0:
        os.close(go)
        os.read(ready, 1)
        try:
            main(sys.argv[1:])
        except SystemExit as end:
            os._exit(end.code or 0)
        finally:
            os._exit(70)
    children.append(child)
os.close(go)
statuses = [os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) for child in children]
print(json.dumps(statuses))
"""
