"""Who talks with whom while the CAs of a keystore are replaced, asked of two DDS that enforce."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from dataclasses import replace
from datetime import UTC, datetime
from itertools import pairwise
from pathlib import Path

import pytest

from sros_tool.dds.domains import DomainSet
from sros_tool.keystore import create_enclaves, create_keystore
from sros_tool.keystore.enclave import enclave_path
from sros_tool.keystore.revoke import revoke
from sros_tool.keystore.rotate import renew_identity_ca, rotate_ca
from sros_tool.keystore.template import load_template
from sros_tool.runtime.netns import try_isolation

pytestmark = pytest.mark.dds

DOMAIN = 141
HERE = Path(__file__).parent
ALL = {"running": True, "listener": True, "talker": True, "both": True}
TOGETHER = {"running": True, "listener": False, "talker": False, "both": True}
STAGES = ["distribute", "reissue", "retire"]


def make(root: Path, template: str, *, revoked: bool = False) -> None:
    now = datetime.now(UTC)
    choice = replace(load_template(template), default_permissions="everything")
    create_keystore(root, template=choice, domains=DomainSet.of((DOMAIN, DOMAIN)), now=now)
    create_enclaves(root, ["/talker", "/listener", "/lost"], now=now)
    if revoked:
        revoke(root, ["/lost"], now=now)


# ── Cyclone DDS: nodes that run, and are restarted one by one ──────────────────────────────


def restarts(root: Path, *steps: str) -> list[dict[str, bool]]:
    command = [sys.executable, str(HERE / "restarts.py"), str(root), str(DOMAIN), *steps]
    done = subprocess.run(command, capture_output=True, text=True, timeout=240)
    assert done.returncode == 0, done.stderr
    return list(json.loads(done.stdout))


@pytest.mark.parametrize(
    ("template", "revoked"), [("production", False), ("production", True), ("sros2", False)]
)
def test_the_stages_on_cyclone(template: str, revoked: bool, tmp_path: Path) -> None:
    """It trusts one CA at a time: after the stage reissue, all have to be restarted together."""
    make(tmp_path / "ks", template, revoked=revoked)
    assert restarts(tmp_path / "ks", *STAGES) == [ALL, TOGETHER, ALL]


def test_a_ca_with_the_same_key_disturbs_nobody_on_cyclone(tmp_path: Path) -> None:
    make(tmp_path / "ks", "production", revoked=True)
    assert restarts(tmp_path / "ks", "same-key") == [ALL]


def test_all_stages_at_once_on_cyclone(tmp_path: Path) -> None:
    make(tmp_path / "ks", "production")
    assert restarts(tmp_path / "ks", "finish") == [TOGETHER]


# ── Fast DDS: processes with the files of one moment, and of another ───────────────────────


@pytest.fixture(scope="module")
def probe(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The program that asks Fast DDS."""
    source = HERE / "fastdds_probe.cpp"
    if not shutil.which("g++") or not Path("/usr/include/fastdds").is_dir():
        pytest.skip("g++ and libfastrtps-dev are not installed")
    if not source.exists():
        pytest.skip(f"there is no {source.name} here")
    program = tmp_path_factory.mktemp("probe") / "fastdds_probe"
    command = ["g++", "-std=c++17", "-O0", "-o", str(program), str(source), "-lfastrtps"]
    built = subprocess.run(command, capture_output=True, text=True)
    assert built.returncode == 0, built.stderr
    return program


ISOLATED = """
import os, sys
from sros_tool.runtime.netns import enter_isolation
enter_isolation()
os.execv(sys.argv[1], sys.argv[1:])
"""


def talk(program: Path, *pairs: tuple[Path, Path]) -> list[str]:
    """For each pair of keystores, whether the listener of one hears the talker of the other."""
    lines = [
        f"{enclave_path(talking, '/talker')} {enclave_path(listening, '/listener')} rt/chatter\n"
        for talking, listening in pairs
    ]
    command = [str(program), str(DOMAIN)]
    if try_isolation().isolated:
        command = [sys.executable, "-c", ISOLATED, *command]
    done = subprocess.run(
        command, input="".join(lines), capture_output=True, text=True, timeout=120
    )
    return done.stdout.splitlines()


def moments(root: Path, steps: int) -> list[Path]:
    """Copies of a keystore: as it is, and after each of the stages.

    A process goes on with what it read when it was started, so whoever has not been restarted
    since is one that is started with the copy.
    """
    copies = [Path(shutil.copytree(root, root.with_name("before"), symlinks=True))]
    for step in range(steps):
        rotate_ca(root, now=datetime.now(UTC))
        copies.append(Path(shutil.copytree(root, root.with_name(f"after{step}"), symlinks=True)))
    return copies


@pytest.mark.parametrize(
    ("template", "revoked"),
    [("production", False), ("production", True), ("sros2", False), ("sros2", True)],
)
def test_the_stages_on_fast_dds(template: str, revoked: bool, probe: Path, tmp_path: Path) -> None:
    """It trusts all CAs of a file: everybody talks, whoever was restarted since the last stage."""
    make(tmp_path / "ks", template, revoked=revoked)
    copies = moments(tmp_path / "ks", 3)
    pairs = [(one, one) for one in copies]
    for one, next_one in pairwise(copies):
        pairs += [(one, next_one), (next_one, one)]
    assert talk(probe, *pairs) == ["heard"] * len(pairs)
    # Who missed a stage is left behind, so the answers above say something.
    assert talk(probe, (copies[0], copies[2]), (copies[3], copies[1])) == ["silent"] * 2


def test_a_ca_with_the_same_key_disturbs_nobody_on_fast_dds(probe: Path, tmp_path: Path) -> None:
    root = tmp_path / "ks"
    make(root, "production", revoked=True)
    before = Path(shutil.copytree(root, tmp_path / "before", symlinks=True))
    renew_identity_ca(root, now=datetime.now(UTC))
    assert talk(probe, (before, root), (root, before), (root, root)) == ["heard"] * 3
