"""CAs whose keys are on a PKCS#11 token are replaced by others there."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.integration.test_token import MODULE, make, sros, token, uri

__all__ = ["token"]

pytestmark = pytest.mark.skipif(not MODULE, reason="softhsm2 is not installed")


def test_new_keys_stay_on_the_token(token: dict[str, str], tmp_path: Path) -> None:
    root = tmp_path / "ks"
    make(token, root)
    assert sros(token, "create_enclave", root, "/a", "/b").returncode == 0
    refused = sros(token, "rotate_ca", root, "--next")
    assert (refused.returncode, "--identity-key" in refused.stderr) == (2, True)
    keys = ["--identity-key", uri("identity 2"), "--permissions-key", uri("permissions 2")]
    for words in (["--to", "distribute", *keys], ["--to", "reissue"], ["--to", "retire"]):
        done = sros(token, "rotate_ca", root, *words)
        assert done.returncode == 0, done.stderr
        assert sros(token, "inspect", root).returncode == 0
    assert sros(token, "create_enclave", root, "/later").returncode == 0
    assert sros(token, "inspect", root).returncode == 0
    files = [p for p in root.rglob("*") if p.is_file() and b"PRIVATE KEY" in p.read_bytes()]
    assert {file.name for file in files} == {"key.pem"}  # those of the enclaves alone
    assert (root / "sros.toml").read_text().count(" 2") == 2
