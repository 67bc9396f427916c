"""Real processes of the program, killed at random moments or started all at once."""

from __future__ import annotations

import json
import random
import shutil
from pathlib import Path

import pytest

from sros_tool.keystore.layout import enclave_folder
from tests.integration.kills import Moments, Server, server
from tests.support.children import LONG, python, run
from tests.support.harness import check_whole, policy_text, publish, remains, topics_of
from tests.support.long_form import some, sometimes

__all__ = ["server"]

KILLS = 12


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
    server.run("generate_artifacts", "-k", keystore, "-p", policies[0])
    length = server.run("generate_artifacts", "-k", keystore, "-p", policies[1])
    assert versions(keystore, enclaves) == {"v2"}
    moments = Moments(KILLS, 4, length)
    current = "v2"
    for number, pause in enumerate(moments):
        wanted = "v2" if current == "v1" else "v1"
        words: list[object] = ["-e", f"/new{number}"] if number % 10 == 0 else []
        policy = policies[wanted == "v2"]
        killed = server.kill(pause, "generate_artifacts", "-k", keystore, "-p", policy, *words)
        check_whole(keystore)
        now = versions(keystore, enclaves)
        assert now in ({current}, {wanted}), f"kill {number} after {pause:.4f} s"
        assert killed or now == {wanted}
        moments.tell(killed=killed, done=now == {wanted})
        (current,) = now
    server.run("generate_artifacts", "-k", keystore, "-p", policies[0])
    check_whole(keystore)
    assert versions(keystore, enclaves) == {"v1"}
    assert not remains(tmp_path)


@sometimes("killed while all cores sign")
def test_killed_while_signing_with_every_core(
    server: Server, keystore: Path, tmp_path: Path
) -> None:
    """The processes that share the work end with the one that was killed."""
    enclaves = [f"/fleet/n{number}" for number in range(220)]
    policies = [write_policy(tmp_path / f"{name}.xml", name, enclaves) for name in ("v1", "v2")]
    length = server.run("generate_artifacts", "-k", keystore, "-p", policies[0])
    moments = random.Random(5)
    current = "v1"
    for _ in range(40 if LONG else 2):
        wanted = "v2" if current == "v1" else "v1"
        pause = moments.uniform(0.1, 1.0) * length
        server.kill(pause, "generate_artifacts", "-k", keystore, "-p", policies[wanted == "v2"])
        now = versions(keystore, enclaves)
        assert now in ({current}, {wanted})
        (current,) = now
    server.run("generate_artifacts", "-k", keystore, "-p", policies[0])
    check_whole(keystore)
    assert versions(keystore, enclaves) == {"v1"}
    assert not remains(tmp_path)


def openssl(*words: object) -> None:
    run(["openssl", *words])


def verify_with_openssl(keystore: Path) -> None:
    for role in ("identity", "permissions"):
        certificate = keystore / f"public/{role}_ca.cert.pem"
        openssl("verify", "-x509_strict", "-CAfile", certificate, certificate)
    governance = keystore / "enclaves/governance.p7s"
    openssl("smime", "-verify", "-text", "-in", governance, "-CAfile", certificate)


@pytest.mark.parametrize("root", some(["missing", "empty", "in a missing folder"], 1))
def test_bug_17_of_eight_at_once_one_makes_the_keystore(root: str, tmp_path: Path) -> None:
    keystore = tmp_path / ("deep/er/ks" if "folder" in root else "ks")
    for _ in range(5 if LONG else 1):
        if root == "empty":
            keystore.mkdir()
        ended = python("-c", _STARTER, keystore)
        statuses = json.loads(ended.stdout.splitlines()[-1])
        assert sorted(statuses) == [0] + [2] * 7, ended.stderr
        assert ended.stderr.count("already exists") == 7, ended.stderr
        verify_with_openssl(keystore)
        check_whole(keystore)
        assert not remains(tmp_path)
        shutil.rmtree(keystore)


_STARTER = """
import json, os, sys, time
from pathlib import Path
import sros_tool.keystore.lifecycle.create, sros_tool.cli.keystore, sros_tool.cli.program
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
