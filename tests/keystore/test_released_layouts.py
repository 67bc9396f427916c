"""Keystores of every released ros2/sros2: used as they are since Foxy, refused until Eloquent."""

from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path

import pytest

from sros_tool.keystore.layout import (
    CLOSED_POLICY,
    CLOSED_PROCESSES,
    enclave_path,
    folder_of_closed_robot,
)
from sros_tool.keystore.reader import open_enclave
from sros_tool.keystore.rights import load_rights
from tests.support.harness import policy_text, publish, snapshot, sros
from tests.support.long_form import some
from tests.support.made_by_ros2 import RELEASES, issue, make, write

NOW = datetime.now(UTC).replace(microsecond=0)


def make_flat(root: Path) -> None:
    """Make the CA and the node /talker as until Eloquent: at the top, and in a folder beside it."""
    (root / "talker").mkdir(parents=True)
    authority, key = issue("sros2testCA", NOW)
    write(root / "ca.cert.pem", authority, root / "ca.key.pem", key)
    certificate, own = issue("/talker", NOW, (authority, key))
    write(root / "talker/cert.pem", certificate, root / "talker/key.pem", own)


VERBS = (
    "inspect {}",
    "check {}",
    "check keystore {}",
    "check {}/talker",
    "verify {}/talker",
    "audit {}",
    "list_enclaves {}",
    "verify {}",
    "renew {} /talker",
    "revoke {} /talker",
    "rotate_ca {}",
    "crl {}",
    "create_enclave {} /new",
    "generate_artifacts -k {} -e /new",
    "create_keystore {}",
    "update_keystore {} --template production",
    "create_permission {} /talker policy.xml",
    "sign_request {} robot/enclaves/new/request.pem",
    "demo --scenario attacks --keystore {}",
    "create_request /new {}",
    "distribute_key {} /talker out",
    "env {} /talker",
    "run {} /talker -- true",
    "explain {} /talker publish /chatter",
    "view {}",
    "diff_policy {} {}",
)


@pytest.mark.parametrize("words", VERBS)
def test_every_verb_refuses_a_flat_keystore_in_one_line(words: str, tmp_path: Path) -> None:
    old = tmp_path / "old"
    make_flat(old)
    before = snapshot(old)
    (tmp_path / "policy.xml").write_text(policy_text({"/talker": publish("/x")}))
    sros("create_request", "/new", tmp_path / "robot").ok()
    ended = sros(*words.format(old, old).split(), cwd=tmp_path)
    assert ended.status == 2, ended
    assert f"'{old}' is not a valid keystore" in ended.err, ended
    assert "a keystore of ROS 2 Eloquent or earlier" in ended.err, ended
    assert "`sros create_keystore NEW`" in ended.err, ended
    assert ended.err.count("\n") == 1, ended
    assert snapshot(old) == before


def test_a_variable_that_names_a_flat_keystore_is_explained(tmp_path: Path) -> None:
    make_flat(tmp_path / "old")
    told = {"ROS_SECURITY_KEYSTORE": str(tmp_path / "old"), "ROS_SECURITY_ENABLE": "true"}
    said = " ".join(sros("check", "runtime", env=told).out.split())
    assert (
        "a keystore of ROS 2 Eloquent or earlier" in said and "`sros create_keystore NEW`" in said
    )


def test_the_files_of_a_flat_keystore_in_one_of_today_do_not_matter(tmp_path: Path) -> None:
    make_flat(tmp_path / "ks")
    make(tmp_path / "foxy", "/a", now=NOW)
    for part in ("public", "private", "enclaves"):
        (tmp_path / "foxy" / part).rename(tmp_path / "ks" / part)
    assert sros("list_enclaves", tmp_path / "ks").ok().out == "/a\n"


@pytest.mark.parametrize("release", some([*RELEASES], 2))
def test_keystores_of_foxy_and_later_are_used_as_they_are(release: str, tmp_path: Path) -> None:
    root = tmp_path / "ks"
    make(root, "/a", "/n/b", now=NOW, release=RELEASES[release])
    assert sros("list_enclaves", root).ok().out == "/a\n/n/b\n"
    sros("inspect", root).ok()
    rights = load_rights(root)
    assert rights.sound and "/n/b ALLOW publish topic /*" in map(str, rights.rights)
    sros("create_enclave", root, "/added").ok()
    sros("renew", root, "/a").ok()
    sros("rotate_ca", root, "--finish").ok()
    kept = {each for each in load_rights(root).rights if each.enclave != "/added"}
    assert kept == set(rights.rights)
    for name in ("/a", "/n/b", "/added"):
        assert not open_enclave(enclave_path(root, name), now=datetime.now(UTC), domain=0).problems


@pytest.mark.parametrize("named", [".", "enclaves/..", "../keystore", "{}/robot/keystore"])
def test_a_keystore_of_close_knows_its_robot_by_every_path(
    named: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "robot/keystore/enclaves").mkdir(parents=True)
    for file in (CLOSED_PROCESSES, CLOSED_POLICY):
        (tmp_path / "robot" / file).touch()
    monkeypatch.chdir(tmp_path / "robot/keystore")
    robot = folder_of_closed_robot(Path(named.format(tmp_path)))
    assert robot and robot.samefile(tmp_path / "robot")
    assert folder_of_closed_robot(tmp_path / "robot") is None
