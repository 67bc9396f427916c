"""Renewing, revoking and rotating a keystore that ros2/sros2 made, without settings or ledger."""

from __future__ import annotations

import errno
import json
import os
import re
import shutil
import stat
import subprocess
from datetime import UTC, datetime
from pathlib import Path

import pytest

from sros_tool.keystore.describe import HistoryStatus, history
from sros_tool.keystore.layout import enclave_path, list_enclaves
from sros_tool.keystore.lifecycle.rotation import rotation_status
from sros_tool.keystore.reader import OpenedKeystore, open_enclave
from tests.support.harness import certificate, check_enclave_whole, remains, snapshot, sros
from tests.support.long_form import some
from tests.support.made_by_ros2 import make

NOW = datetime.now(UTC).replace(microsecond=0)


@pytest.fixture
def root(tmp_path: Path) -> Path:
    make(tmp_path / "ks", "/a", "/b/c", "/d", now=NOW)
    return tmp_path / "ks"


def check(root: Path, *names: str) -> None:
    """Every enclave can be loaded, and openssl agrees."""
    assert not remains(root.parent)
    assert list_enclaves(root) == names
    crl = root / "public/identity_ca.crl.pem"
    for name in names:
        folder = enclave_path(root, name)
        assert not open_enclave(folder, now=datetime.now(UTC), domain=0).problems, name
        (folder / "key.pem").chmod(0o600)  # ros2/sros2 leaves it open
        check_enclave_whole(folder)
        words = ["verify", "-CAfile", folder / "identity_ca.cert.pem"]
        if crl.exists():
            words += ["-crl_check", "-CRLfile", folder / "crl.pem"]
        openssl(*words, folder / "cert.pem")
        for document in ("permissions", "governance"):
            words = ["smime", "-verify", "-text", "-in", folder / f"{document}.p7s"]
            openssl(*words, "-CAfile", folder / "permissions_ca.cert.pem")


def openssl(*words: object) -> None:
    done = subprocess.run(["openssl", *map(str, words)], capture_output=True, text=True)
    assert done.returncode == 0, (words, done.stderr)


def test_it_is_one_that_works(root: Path) -> None:
    check(root, "/a", "/b/c", "/d")
    assert not (root / "sros.toml").exists()
    assert not (root / "ledger.jsonl").exists()


@pytest.mark.parametrize("new_key", [False, True])
def test_renewing(new_key: bool, root: Path) -> None:
    before = {name: enclave_path(root, name) for name in ("/a", "/b/c")}
    old = {name: certificate(path / "cert.pem") for name, path in before.items()}
    sros("renew", root, "/b/c", *["--new-key"] * new_key).ok()
    check(root, "/a", "/b/c", "/d")
    assert certificate(before["/a"] / "cert.pem") == old["/a"]
    new = certificate(before["/b/c"] / "cert.pem")
    assert new.serial_number != old["/b/c"].serial_number
    assert new.subject == old["/b/c"].subject
    assert (new.public_key() != old["/b/c"].public_key()) is new_key
    sros("renew", root, "--all-expiring", "20y").ok()
    check(root, "/a", "/b/c", "/d")
    # The ledger begins with what was there, taken on trust.
    found = history(OpenedKeystore(root), now=NOW)
    assert {item.entry.enclave for item in found.entries} == {"", "/a", "/b/c", "/d"}
    assert found.unexplained == ()


WRITING = (
    ("renew", "{}", "/a"),
    ("renew", "{}", "/a", "--new-key", "--revoke-old"),
    ("revoke", "{}", "/d"),
    ("create_enclave", "{}", "/new"),
    ("generate_artifacts", "-k", "{}", "-e", "/new"),
    ("rotate_ca", "{}", "--next"),
    ("rotate_ca", "{}", "--finish"),
)


def open_to_others(root: Path) -> set[str]:
    """The private keys, and the folders of keys at the top, that others can open."""
    return {
        str(path.relative_to(root))
        for path in (*root.glob("*/"), *root.rglob("*key.pem"))
        if path.name != "public"
        and not path.is_symlink()
        and stat.S_IMODE(path.stat().st_mode) & 0o077
    }


@pytest.mark.parametrize("words", some(WRITING, 3), ids=" ".join)
def test_writing_closes_the_keys_to_other_users_and_says_so(
    words: tuple[str, ...], root: Path
) -> None:
    for path in (root, *root.rglob("*")):
        if not path.is_symlink():
            path.chmod(0o755 if path.is_dir() else 0o644)  # by the usual umask
    kept = {"private/ca.key.pem", *(f"enclaves{name}/key.pem" for name in ("/a", "/b/c", "/d"))}
    assert open_to_others(root) == {"private", "enclaves", *kept}
    words = tuple(word.format(root) for word in words)
    plan = sros(*words, "--dry-run").ok()
    assert f"would close {root}/enclaves/b/c/key.pem" in plan.out
    assert open_to_others(root) == {"private", "enclaves", *kept}, "a dry run changed modes"
    ended = sros(*words).ok()
    assert open_to_others(root) == set()
    assert f"could open until now, and cannot open any more: {root}/private" in ended.err
    assert "closed to" not in sros("renew", root, "/a").ok().err


def test_reading_and_a_failing_verb_leave_the_modes(root: Path) -> None:
    (root / "enclaves/d/key.pem").chmod(0o644)
    before = open_to_others(root)
    found = sros("check", root).out
    assert "keystore.key-readable" in found
    sros("inspect", root).ok()
    assert sros("renew", root, "/no_such_enclave").status
    assert open_to_others(root) == before


def test_a_commit_that_fails_leaves_the_modes(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    (root / "enclaves/d/key.pem").chmod(0o644)
    before = snapshot(root)
    opened = open_to_others(root)
    with monkeypatch.context() as broken:
        broken.setattr("sros_tool.keystore.transaction._write_manifest", full)
        assert sros("renew", root, "/a").status == 2
    assert snapshot(root) == before
    assert open_to_others(root) == opened
    renewed = sros("renew", root, "/a").ok()
    assert f"could open until now, and cannot open any more: {root}" in renewed.err
    assert open_to_others(root) == set()


def test_a_key_with_a_name_elsewhere_and_a_link_stay_as_they_are(
    root: Path, tmp_path: Path
) -> None:
    """As root this would change the mode of any file that is linked into the keystore."""
    other = tmp_path / "other.pem"
    other.write_bytes(b"something else")
    other.chmod(0o644)
    os.link(other, root / "private/hard.key.pem")
    (root / "private/soft.key.pem").symlink_to(other)
    sros("renew", root, "/a").ok()
    assert stat.S_IMODE(other.stat().st_mode) == 0o644
    assert open_to_others(root) == {"private/hard.key.pem"}


OPENED = {
    "keystore.key-readable": ("enclaves/d/key.pem", 0o644),
    "keystore.folder-open": ("private", 0o755),
    "keystore.world-writable": ("public/ca.cert.pem", 0o646),
}


@pytest.mark.parametrize("kind", OPENED)
def test_the_remedy_of_an_open_mode_runs(kind: str, root: Path) -> None:
    path, mode = OPENED[kind]
    (root / path).chmod(mode)

    def remedies() -> list[str]:
        found = json.loads(sros("check", root, "--json").out)["findings"]
        return [each["remedy"] for each in found if each["id"] == kind]

    assert remedies()
    for remedy in remedies():
        command = re.search(r"`(chmod [^`]+)`", remedy)
        assert command, remedy
        subprocess.run(command[1], shell=True, check=True)
    assert not remedies()


def test_revoking(root: Path, tmp_path: Path) -> None:
    stolen = Path(shutil.copytree(enclave_path(root, "/d"), tmp_path / "stolen"))
    sros("revoke", root, "/d", "--reason", "key_compromise").ok()
    check(root, "/a", "/b/c")
    (crl,) = OpenedKeystore(root).revocation_lists
    assert [each.serial for each in crl.revoked] == [certificate(stolen / "cert.pem").serial_number]
    shutil.copy(root / "public/identity_ca.crl.pem", stolen / "crl.pem")
    found = [str(each) for each in open_enclave(stolen, now=datetime.now(UTC)).problems]
    assert found == ["cert.pem: it is revoked by crl.pem"]
    sros("crl", root, "--refresh").ok()
    check(root, "/a", "/b/c")
    assert len(OpenedKeystore(root).revocation_lists[0].revoked) == 1
    revoked = {
        each.entry.what
        for each in history(OpenedKeystore(root), now=NOW).entries
        if each.entry.serial
    }
    assert revoked == {"revocation", "certificate", "ca"}


def test_rotating_with_a_revocation_in_every_stage(root: Path) -> None:
    old = certificate(root / "public/ca.cert.pem")
    names = ["/a", "/b/c", "/d"]
    for number, stage in enumerate(("distribute", "reissue", "retire")):
        sros("rotate_ca", root, "--to", stage).ok()
        check(root, *names)
        sros("create_enclave", root, f"/new{number}").ok()
        sros("renew", root, "/a").ok()
        check(root, *names, f"/new{number}")
        sros("revoke", root, f"/new{number}").ok()
        check(root, *names)
    (state,) = rotation_status(OpenedKeystore(root), now=NOW).authorities
    assert state.state == "issuing"
    assert state.serial != f"{old.serial_number:x}"
    assert len(list((root / "public").glob("*_ca.cert.pem"))) == 2
    assert all(path.is_symlink() for path in (root / "public").glob("*_ca.cert.pem"))
    assert (root / "private/ca.key.pem").stat().st_mode & 0o777 == 0o600
    found = history(OpenedKeystore(root), now=NOW)
    assert found.unexplained == ()
    assert {each.status for each in found.entries if each.entry.what == "ca"} == {
        HistoryStatus.CURRENT,
        HistoryStatus.RETIRED,
    }
    sros("revoke", root, "/d").ok()
    check(root, "/a", "/b/c")


def test_no_list_is_distributed_that_may_be_taken_for_another(root: Path) -> None:
    """Fast DDS would start no process: the old CA has the new one's name, and no identifier."""
    sros("revoke", root, "/d").ok()
    sros("rotate_ca", root, "--to", "distribute").ok()
    sros("create_enclave", root, "/e").ok()
    sros("revoke", root, "/e").ok()
    assert b"X509 CRL" not in (root / "public/ca.cert.pem").read_bytes()
    assert len(OpenedKeystore(root).revocation_lists) == 1
    sros("rotate_ca", root, "--to", "reissue").ok()
    new, old = OpenedKeystore(root).revocation_lists
    assert not new.revoked
    assert len(old.revoked) == 2  # whoever trusts the old CA still asks this one


def test_all_stages_at_once(root: Path) -> None:
    sros("revoke", root, "/d").ok()
    sros("rotate_ca", root, "--finish").ok()
    check(root, "/a", "/b/c")


def test_a_dry_run_of_each_changes_nothing(root: Path) -> None:
    before = snapshot(root)
    for words in (
        ("renew", root, "/a"),
        ("revoke", root, "/a"),
        ("crl", root, "--refresh"),
        ("rotate_ca", root, "--next"),
    ):
        assert sros(*words, "--dry-run").ok().out, words
    assert snapshot(root) == before
