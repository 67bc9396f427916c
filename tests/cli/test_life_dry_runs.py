"""What the verbs for the life of keys say in a dry run is what they then do, file by file."""

from __future__ import annotations

import time
from pathlib import Path

import pytest

from tests.support.harness import check_dry_run, copy_of, sros

LINES = (
    "renew ks /a --new-key",
    "renew ks --all-expiring 400d",
    "renew ks /a --revoke-old",
    "revoke ks /a",
    "crl ks --refresh",
    "rotate_ca ks --next",
    "rotate_ca ks --finish",
    "rotate_ca ks --same-key --identity",
)


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("made")
    sros("create_keystore", "ks", "--template", "production", cwd=folder).ok()
    sros("create_enclave", "ks", "/a", "/b", "/c", cwd=folder).ok()
    sros("revoke", "ks", "/c", cwd=folder).ok()
    time.sleep(1.1)  # within the second of its making, a document that is made anew is the same
    return folder


@pytest.fixture
def home(made: Path, tmp_path: Path) -> Path:
    return copy_of(made, tmp_path / "home")


@pytest.mark.parametrize("line", LINES)
def test_a_dry_run_tells_what_the_verb_then_does(line: str, home: Path) -> None:
    assert check_dry_run(line, home) > 1
