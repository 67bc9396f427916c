"""Keystores of users: which enclaves the demo casts, what it forges in a copy, what is open."""

from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path

from sros_tool.demo import forger
from sros_tool.demo.forger import KeystoreCopy
from sros_tool.keystore.layout import CRL_FILE, REQUIRED_FILES
from tests.support.harness import policy_text, publish, sros

HEARS = '<topics subscribe="ALLOW"><topic>/image</topic></topics>'


def make_keystore(
    folder: Path, rights: dict[str, str], template: str | Path = "production"
) -> Path:
    """Create a keystore with an enclave for each key, which may do what its policy says."""
    root = folder / "ks"
    (folder / "policy.xml").write_text(policy_text(rights))
    sros("create_keystore", root, "--template", template).ok()
    sros("generate_artifacts", "-k", root, "-p", folder / "policy.xml").ok()
    return root


def test_an_enclave_alone_in_its_namespace_is_revoked_in_the_copy(tmp_path: Path) -> None:
    """A revocation also removes the folder of the namespace, if nothing is left in it."""
    root = make_keystore(tmp_path, {"/a/talker": publish("/image"), "/b/listener": HEARS})
    cast = {"talker": "/a/talker", "listener": "/b/listener"}
    copy = KeystoreCopy(root, root, cast, "/image", 0, datetime.now(UTC))
    before = copy.certificate("talker")
    forger.talker_revoked(copy)
    assert copy.certificate("talker").serial_number != before.serial_number
    for part in cast:
        files = {path.name for path in copy.folder(part).iterdir()}
        assert files >= {*REQUIRED_FILES, CRL_FILE}
