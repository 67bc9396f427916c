"""`-v` reports steps on standard error, and never a secret."""

from __future__ import annotations

import logging
import sys
from pathlib import Path

import pytest

from tests.support.children import run
from tests.support.harness import sros

PASSPHRASE = "correct-horse-battery-staple"


@pytest.fixture
def keystore(tmp_path: Path) -> Path:
    root = tmp_path / "keystore"
    sros("create_keystore", root).ok()
    return root


@pytest.mark.parametrize(
    "words",
    [
        ("-v", "create_enclave", "KEYSTORE", "/a"),
        ("create_enclave", "-v", "KEYSTORE", "/a"),
        ("create_enclave", "KEYSTORE", "/a", "--verbose"),
    ],
)
def test_steps_are_reported_before_and_after_the_verb(
    keystore: Path, words: tuple[str, ...]
) -> None:
    done = sros(*(keystore if word == "KEYSTORE" else word for word in words)).ok()
    assert done.out == "created enclave /a\n"
    assert f"began a transaction in the keystore '{keystore}'" in done.err
    assert "opened the key of the identity CA" in done.err
    assert "committed" in done.err
    assert "read the" not in done.err


@pytest.mark.parametrize(
    ("before", "after"), [("-vv", ()), ("-v", ("-v",)), ("--verbose", ("-v",))]
)
def test_twice_reports_the_files_as_well(
    keystore: Path, before: str, after: tuple[str, ...]
) -> None:
    done = sros(before, "create_enclave", keystore, "/a", *after).ok()
    assert "read the settings file" in done.err
    assert "create enclaves/a/key.pem" in done.err


def test_nothing_is_reported_without_it_nor_afterwards(keystore: Path) -> None:
    assert sros("-vv", "create_enclave", keystore, "/a").ok().err
    assert sros("create_enclave", keystore, "/b").ok().err == ""
    assert logging.getLogger("sros_tool").handlers == []


def test_no_secret_is_reported(tmp_path: Path) -> None:
    root, env = tmp_path / "keystore", {"SROS_CA_PASSPHRASE": PASSPHRASE}
    said = ""
    for words in (
        ("create_keystore", root, "--encrypt-ca-keys"),
        ("create_enclave", root, "/a"),
        ("renew", root, "/a", "--new-key"),
        ("revoke", root, "/a"),
        ("rotate_ca", root, "--finish", "--encrypt-ca-keys"),
    ):
        done = sros("-vv", *words, env=env).ok()
        said += done.err + done.out
    assert "opened the key of the permissions CA" in said and "committed" in said
    assert PASSPHRASE not in said
    files = [path for path in root.rglob("*") if path.is_file()]
    assert [path for path in files if PASSPHRASE.encode() in path.read_bytes()] == []
    keys = [path for path in files if b"PRIVATE" in path.read_bytes()]
    assert keys
    for key in keys:
        for line in key.read_text().splitlines():
            assert "PRIVATE" in line or line not in said
    assert "PRIVATE KEY" not in said


def test_names_cannot_steer_the_terminal(tmp_path: Path) -> None:
    root = tmp_path / "key\x1b[2Jstore"
    done = sros("-v", "create_keystore", root).ok()
    assert "\x1b" not in done.err and "key\\x1b[2Jstore" in done.err


def test_a_command_keeps_its_own_option(keystore: Path) -> None:
    sros("create_enclave", keystore, "/a").ok()
    command = [sys.executable, "-m", "sros_tool", "run", str(keystore), "/a", "echo", "-v"]
    assert run(command).stdout == "-v\n"


def test_logging_is_not_even_imported_for_the_help() -> None:
    code = "import sys; from sros_tool.cli import main\n"
    code += "try: main(['--help'])\nexcept SystemExit: print('logging' in sys.modules)"
    assert run([sys.executable, "-c", code]).stdout.endswith("\nFalse\n")
