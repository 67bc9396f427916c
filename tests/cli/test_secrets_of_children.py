"""No process that sros starts, or becomes, gets the secrets of the CA keys."""

from __future__ import annotations

import json
import os
import sys
from pathlib import Path

import pytest

from tests.support.harness import forked, sros

SECRETS = {
    "SROS_CA_PASSPHRASE": "correct horse battery staple",
    "SROS_CA_PASSPHRASE_FILE": "/the/passphrase",
    "SROS_PKCS11_PIN": "98765432",
}
STARTERS = {
    "run": "run KEYSTORE /a -- spy",
    "graphviz": "view KEYSTORE --graphviz -o picture.svg",
    "observer": "generate_policy policy.xml --spin-time 1",
}


@pytest.mark.parametrize("line", STARTERS.values(), ids=STARTERS)
def test_a_child_gets_every_variable_but_the_secrets(line: str, tmp_path: Path) -> None:
    root, seen = tmp_path / "ks", tmp_path / "seen"
    env = {**os.environ, **SECRETS, "OTHER": "kept", "PATH": f"{tmp_path}:{os.environ['PATH']}"}
    sros("create_keystore", root, "--encrypt-ca-keys", env=env).ok()
    sros("create_enclave", root, "/a", env=env).ok()  # the program itself has the secrets
    for name in ("spy", "dot"):
        (tmp_path / name).write_text(f"#!/bin/sh\nenv > {seen}\n")
        (tmp_path / name).chmod(0o755)
    (tmp_path / "rclpy").mkdir()
    (tmp_path / "rclpy/__init__.py").write_text("")

    def first() -> None:
        os.chdir(tmp_path)
        sys.path.insert(0, str(tmp_path))
        sys.executable = str(tmp_path / "spy")

    forked(*line.replace("KEYSTORE", str(root)).split(), env=env, first=first)
    names = {line.partition("=")[0] for line in seen.read_text().splitlines()}
    assert "OTHER" in names
    assert not names & SECRETS.keys()


def test_they_are_not_printed_and_come_back(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name, value in SECRETS.items():
        monkeypatch.setenv(name, value)
    root = tmp_path / "ks"
    sros("create_keystore", root).ok()
    sros("create_enclave", root, "/a").ok()
    for form in ("sh", "fish", "json", "systemd", "docker"):
        printed = sros("env", root, "/a", "--format", form).ok().out
        assert "ROS_SECURITY_KEYSTORE" in printed
        assert not [name for name in SECRETS if name in printed]
    shown = json.loads(sros("env", root, "/a", "--json").ok().out)
    assert len(shown["variables"]) == 5
    assert SECRETS.items() <= os.environ.items()
