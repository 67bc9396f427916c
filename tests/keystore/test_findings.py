"""What ``check keystore`` finds, each beside a keystore in which it is not to be found."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest
from harness import sros

from sros_tool.keystore.findings import keystore_findings

NOW = datetime.now(UTC)


def ids(root: Path, now: datetime = NOW) -> list[str]:
    return [each.id for each in keystore_findings(root, now)]


@pytest.mark.parametrize(
    ("template", "found"),
    [("sros2", ["keystore.one-authority"]), ("development", []), ("production", [])],
)
def test_one_authority_for_both_jobs(template: str, found: list[str], tmp_path: Path) -> None:
    sros("create_keystore", tmp_path / "ks", "--template", template).ok()
    sros("create_enclave", tmp_path / "ks", "/a").ok()
    assert ids(tmp_path / "ks") == found
    ended = sros("check", "keystore", tmp_path / "ks")
    assert (ended.status, bool(ended.out)) == ((1, True) if found else (0, False))


def test_weaknesses_of_single_files(tmp_path: Path) -> None:
    root = tmp_path / "ks"
    sros("create_keystore", root).ok()
    sros("create_enclave", root, "/a", "/b").ok()
    assert ids(root) == []
    (root / "enclaves/a/key.pem").chmod(0o644)
    assert ids(root) == ["keystore.key-readable"]
    (root / "enclaves/b/cert.pem").unlink()
    assert ids(root) == ["enclave.not-loadable", "keystore.key-readable"]


def test_a_revocation_list_that_ends(tmp_path: Path) -> None:
    root = tmp_path / "ks"
    sros("create_keystore", root).ok()
    sros("create_enclave", root, "/a", "/b").ok()
    sros("revoke", root, "/b").ok()
    assert ids(root) == []
    assert "keystore.revocation-list-ends" in ids(root, NOW + timedelta(days=3649))


def test_a_key_on_its_robot_is_no_fault(tmp_path: Path) -> None:
    root, robot = tmp_path / "ks", tmp_path / "robot"
    sros("create_keystore", root).ok()
    sros("create_request", "/arm", robot).ok()
    answer = tmp_path / "answer.tar.gz"
    sros("sign_request", root, robot / "enclaves/arm/request.pem", "-o", answer).ok()
    assert ids(root) == []
    (root / "enclaves/arm/cert.pem").write_text("nonsense")
    assert set(ids(root)) == {"enclave.not-loadable"}
