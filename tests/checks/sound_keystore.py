"""A keystore in which nothing is to be found, for every test to break a copy of its own."""

from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path

import pytest

from tests.checks.bench import SECRET, Bench
from tests.checks.policy_cases import BASICS
from tests.support.harness import copy_of, sros

NOW = datetime.now(UTC).replace(microsecond=0)

POLICY = "".join(
    f'<enclave path="/{name}"><profiles><profile ns="/" node="{name}">{BASICS}'
    '<topics publish="ALLOW"><topic>status</topic></topics></profile></profiles></enclave>'
    for name in ("base", "arm")
)


@pytest.fixture(scope="session")
def sound(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a keystore `ks` and its `policy.xml`; only to be copied."""
    folder = tmp_path_factory.mktemp("sound")
    policy = folder / "policy.xml"
    policy.write_text(f'<policy version="0.2.0"><enclaves>{POLICY}</enclaves></policy>')
    root, env = folder / "ks", {"SROS_CA_PASSPHRASE": SECRET}
    words = ("--template", "production", "--encrypt-ca-keys")
    sros("create_keystore", root, *words, env=env).ok()
    sros("generate_artifacts", "-k", root, "-p", policy, env=env).ok()
    return folder


@pytest.fixture
def bench(sound: Path, tmp_path: Path) -> Bench:
    """A copy of one's own."""
    copy_of(sound, tmp_path / "copy")
    return Bench(tmp_path / "copy/ks", NOW)
