"""A signing request is answered by CAs whose keys are on a PKCS#11 token."""

from __future__ import annotations

import os
import subprocess
from pathlib import Path

import pytest

from tests.integration.test_token import MODULE, make, sros, token

__all__ = ["token"]

pytestmark = pytest.mark.skipif(not MODULE, reason="softhsm2 is not installed")

NAME, FOLDER = "/arm/camera", "enclaves/arm/camera"


def openssl(*words: object) -> None:
    done = subprocess.run(["openssl", *map(str, words)], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def test_a_request_is_signed_renewed_and_revoked_by_the_token(
    token: dict[str, str], tmp_path: Path
) -> None:
    home, robot, answer = tmp_path / "ks", tmp_path / "robot", tmp_path / "answer.tgz"
    without = {**token, "SOFTHSM2_CONF": os.devnull}
    make(token, home)
    assert sros(without, "create_request", NAME, robot).returncode == 0
    sign = ("sign_request", home, robot / FOLDER / "request.pem", "-o", answer)
    before = {path: path.read_bytes() for path in home.rglob("*") if path.is_file()}
    refused = sros(without, *sign)
    assert (refused.returncode, refused.stderr.count("\n")) == (2, 1), refused.stderr
    assert {path: path.read_bytes() for path in home.rglob("*") if path.is_file()} == before
    assert not answer.exists()
    for words in ((), ("--renew", "--force")):
        done = sros(token, *sign, *words)
        assert done.returncode == 0, done.stderr
        ca = home / "public/permissions_ca.cert.pem"
        imported = sros(without, "import", answer, robot, "--ca", ca)
        assert imported.returncode == 0, imported.stderr
        assert sros(without, "verify", robot).returncode == 0
        folder = robot / FOLDER
        identity, permissions = (folder / f"{r}_ca.cert.pem" for r in ("identity", "permissions"))
        openssl("verify", "-x509_strict", "-CAfile", identity, folder / "cert.pem")
        for document in ("permissions", "governance"):
            signed = folder / f"{document}.p7s"
            openssl("smime", "-verify", "-text", "-in", signed, "-CAfile", permissions)
    for place, kept in ((home, set()), (robot, {"key.pem"})):
        keys = {
            p.name for p in place.rglob("*") if p.is_file() and b"PRIVATE KEY" in p.read_bytes()
        }
        assert keys == kept
    assert sros(token, "revoke", home, NAME).returncode == 0
    assert sros(without, "inspect", home, "--history").returncode == 0
