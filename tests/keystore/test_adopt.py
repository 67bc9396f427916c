"""Keystores of every released ros2/sros2: recognised, continued, or taken over."""

from __future__ import annotations

import json
import os
import shutil
import stat
from collections.abc import Callable, Mapping
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest
from cryptography.hazmat.primitives.serialization import (
    Encoding,
    NoEncryption,
    PrivateFormat,
    load_pem_private_key,
)

from sros_tool.dds.permissions import parse_permissions
from sros_tool.keystore.layout import enclave_path
from sros_tool.keystore.ledger import read_ledger
from sros_tool.keystore.reader import open_enclave
from sros_tool.keystore.rights import load_rights
from sros_tool.pki import smime
from tests.support.harness import (
    certificate,
    policy_text,
    publish,
    remains,
    snapshot,
    sros,
)
from tests.support.made_by_eloquent import EVERYTHING, age, make_dashing, make_eloquent
from tests.support.made_by_ros2 import RELEASES, make

NOW = datetime.now(UTC).replace(microsecond=0)
NODES = {
    "/talker": EVERYTHING,
    "/plant/north/valve": ("rt/plant/flow", "rq/plant/north/valve/get_parametersRequest"),
    "/plant": (),
}
DOMAIN = 7


def _eloquent(root: Path) -> None:
    make_eloquent(root, NODES, now=NOW, domain=DOMAIN)


def _dashing(root: Path) -> None:
    nodes = dict(NODES)
    nodes["/plant/north/valve"] = ("rt/plant/flow", "rq/plant/north/valve//get_parametersRequest")
    make_dashing(root, nodes, domain=DOMAIN)


FLAT: Mapping[str, Callable[[Path], None]] = {"dashing": _dashing, "eloquent": _eloquent}


@pytest.fixture(scope="module", params=FLAT)
def made(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A keystore of each flat layout; only to be read."""
    root = tmp_path_factory.mktemp(request.param) / "old"
    FLAT[request.param](root)
    return root


READING = (
    "inspect {}",
    "check {}",
    "check keystore {}",
    "check {}/talker",
    "verify {}/plant/north/valve",
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


@pytest.mark.parametrize("words", READING)
def test_every_verb_says_what_it_is_and_what_to_do(words: str, made: Path, tmp_path: Path) -> None:
    before = snapshot(made)
    (tmp_path / "policy.xml").write_text(policy_text({"/talker": publish("/x")}))
    sros("create_request", "/new", tmp_path / "robot").ok()
    ended = sros(*words.format(made, made).split(), cwd=tmp_path)
    assert ended.status == 2, ended
    assert f"create_keystore NEW --from {made}" in ended.err, ended
    assert ended.err.count("\n") == 1, ended
    assert snapshot(made) == before


def test_the_variable_of_that_time_is_explained(made: Path) -> None:
    told = {"ROS_SECURITY_KEYSTORE": str(made), "ROS_SECURITY_ENABLE": "true"}
    assert f"--from {made}" in sros("check", "runtime", env=told).out


def test_a_part_of_it_on_a_robot_is_explained(made: Path, tmp_path: Path) -> None:
    robot = tmp_path / "robot"
    os.makedirs(robot)
    os.rename(_copy(made, tmp_path) / "talker", robot / "talker")
    for verb in ("inspect", "create_keystore"):
        ended = sros(verb, robot)
        assert ended.status and "--from OLD` where the CA of that keystore" in ended.err, ended


def test_a_copy_of_an_enclave_does_not_make_a_folder_an_earlier_keystore(
    made: Path, tmp_path: Path
) -> None:
    _copy(made, tmp_path)
    shutil.copytree(made / "talker", tmp_path / "robot/backup")
    sros("create_keystore", tmp_path / "robot").ok()


def test_taken_over_it_keeps_ca_keys_and_rights(made: Path, tmp_path: Path) -> None:
    before, new = snapshot(made), tmp_path / "new"
    plan = sros("create_keystore", new, "--from", made, "--dry-run").ok()
    assert not new.exists() and f"would create {new}/private/ca.key.pem" in plan.out
    told = json.loads(
        sros("-v", "create_keystore", new, "--from", made, "--json", "--dry-run").ok().out
    )
    assert told["from"] == str(made) and len(told["enclaves"]) == len(NODES)
    assert told["domains"] == "7" and told["dry_run"]
    said = sros("create_keystore", new, "--from", made).ok()
    assert "for domain 7" in said.out and "enclave /plant/north/valve" in said.out
    assert snapshot(made) == before and not remains(tmp_path)
    assert certificate(new / "public/identity_ca.cert.pem") == certificate(made / "ca.cert.pem")
    assert _key(new / "private/permissions_ca.key.pem") == _key(made / "ca.key.pem")
    assert sros("list_enclaves", new).ok().out.split() == sorted(NODES)
    for name, topics in NODES.items():
        old, folder = made / name[1:], enclave_path(new, name)
        assert not open_enclave(folder, now=datetime.now(UTC), domain=DOMAIN).problems, name
        assert open_enclave(folder, now=datetime.now(UTC), domain=0).problems
        assert certificate(folder / "cert.pem") == certificate(old / "cert.pem")
        assert _key(folder / "key.pem") == _key(old / "key.pem")
        pairs = {(way, topic) for way in ("publish", "subscribe") for topic in topics}
        pairs |= {("publish", "ros_discovery_info"), ("subscribe", "ros_discovery_info")}
        assert _topics(folder) == pairs
    assert smime.parse((new / "enclaves/governance.p7s").read_bytes()).document
    modes = {path: path.lstat().st_mode for path in new.rglob("*key.pem") if not path.is_symlink()}
    assert len(modes) == 1 + len(NODES)
    assert {stat.S_IMODE(mode) for mode in modes.values()} == {0o600}
    no_node = ("--exclude", "enclave.node-cannot-start")
    assert sros("check", new, "--fail-on", "error", *no_node).status == 0, sros("check", new).out
    assert (new / "sros.toml").exists() and read_ledger(new).gaps == ()


def test_taken_over_it_lives_on(made: Path, tmp_path: Path) -> None:
    new = tmp_path / "new"
    sros("create_keystore", new, "--from", made).ok()
    sros("create_enclave", new, "/added").ok()
    sros("renew", new, "/talker", "--new-key").ok()
    sros("revoke", new, "/plant").ok()
    sros("rotate_ca", new, "--finish").ok()
    for name in ("/added", "/talker", "/plant/north/valve"):
        folder = enclave_path(new, name)
        assert not open_enclave(folder, now=datetime.now(UTC), domain=DOMAIN).problems, name


def test_an_expired_certificate_is_issued_again_for_its_key(tmp_path: Path) -> None:
    age(NODES, tmp_path / "old", NOW)
    said = sros("create_keystore", tmp_path / "new", "--from", tmp_path / "old").ok()
    assert said.err.count("adopt.new-certificate") == len(NODES)
    folder = enclave_path(tmp_path / "new", "/talker")
    assert not open_enclave(folder, now=datetime.now(UTC), domain=0).problems
    assert _key(folder / "key.pem") == _key(tmp_path / "old/talker/key.pem")


def _other_key(old: Path) -> None:
    os.replace(old / "plant/key.pem", old / "talker/key.pem")


def _foreign_certificate(old: Path) -> None:
    make_eloquent(old.with_name("second"), {"/talker": ()}, now=NOW)
    os.replace(old.with_name("second") / "talker/cert.pem", old / "talker/cert.pem")


def _permissions_of_another(old: Path) -> None:
    os.replace(old / "plant/permissions.p7s", old / "talker/permissions.p7s")


def _forged_permissions(old: Path) -> None:
    make_eloquent(old.with_name("second"), {"/plant": EVERYTHING}, now=NOW)
    os.replace(old.with_name("second") / "plant/permissions.p7s", old / "plant/permissions.p7s")


def _foreign_governance(old: Path) -> None:
    make_eloquent(old.with_name("second"), {}, now=NOW)
    os.replace(old.with_name("second") / "governance.p7s", old / "governance.p7s")


def _link_out(old: Path) -> None:
    secret = old.with_name("secret.pem")
    os.replace(old / "ca.key.pem", secret)
    (old / "ca.key.pem").symlink_to(secret)


def _folder_link_out(old: Path) -> None:
    os.rename(old / "talker", old.with_name("elsewhere"))
    (old / "talker").symlink_to(old.with_name("elsewhere"))


BROKEN: Mapping[str, tuple[Callable[[Path], None], str]] = {
    "the CA key is missing": (lambda old: (old / "ca.key.pem").unlink(), "No such file"),
    "the CA key leads out": (_link_out, "is a link out of"),
    "a node leads out": (_folder_link_out, "is a link out of"),
    "a node without a key": (lambda old: (old / "plant/key.pem").unlink(), "/plant: "),
    "a node with another key": (_other_key, "/talker: its key.pem is not the key"),
    "a certificate of another CA": (_foreign_certificate, "/talker: the CA of the keystore did"),
    "the permissions of another node": (_permissions_of_another, "has no grant for CN=/talker"),
    "permissions that another CA signed": (_forged_permissions, "/plant: "),
    "a governance of another CA": (_foreign_governance, "the governance of"),
    "a node that no enclave can be": (
        lambda old: os.rename(old / "plant", old / "1plant"),
        "/1plant: no enclave can have this name",
    ),
}


@pytest.mark.parametrize("case", BROKEN)
def test_what_cannot_be_taken_over_is_refused_as_a_whole(case: str, tmp_path: Path) -> None:
    spoil, reason = BROKEN[case]
    _eloquent(tmp_path / "old")
    spoil(tmp_path / "old")
    before = snapshot(tmp_path / "old")
    ended = sros("create_keystore", tmp_path / "new", "--from", tmp_path / "old")
    assert ended.status and reason in ended.err, ended
    assert not (tmp_path / "new").exists() and snapshot(tmp_path / "old") == before
    assert not remains(tmp_path)


def test_nothing_else_can_be_chosen_and_nothing_else_taken_over(tmp_path: Path) -> None:
    make(tmp_path / "foxy", "/a", now=NOW)
    _eloquent(tmp_path / "old")
    for other, used in ((tmp_path / "foxy", True), (tmp_path / "nothing", False)):
        refused = sros("create_keystore", tmp_path / "new", "--from", other)
        assert refused.status == 2
        said = {"used as it is": used, f"`sros check {other}`": used, "Name the folder": not used}
        assert {each: each in refused.err for each in said} == said
    sros("list_enclaves", tmp_path / "foxy").ok()
    for words in (("--template", "production"), ("--domain", "3"), ("--encrypt-ca-keys",)):
        ended = sros("create_keystore", tmp_path / "new", "--from", tmp_path / "old", *words)
        assert ended.status == 2 and f"{words[0]} and --from exclude" in ended.err
    there = sros("create_keystore", tmp_path / "foxy", "--from", tmp_path / "old")
    assert there.status and "already exists" in there.err


def test_a_second_pki_in_an_earlier_keystore_does_not_hide_it(tmp_path: Path) -> None:
    """`generate_artifacts` of an earlier sros put enclaves next to the nodes."""
    old = tmp_path / "old"
    _eloquent(old)
    make(tmp_path / "foxy", "/a", now=NOW)
    for part in ("public", "private", "enclaves"):
        os.rename(tmp_path / "foxy" / part, old / part)
    sros("create_keystore", tmp_path / "new", "--from", old).ok()
    assert sros("list_enclaves", tmp_path / "new").out.split() == sorted(NODES)


@pytest.mark.parametrize(
    ("changed", "stated"),
    [(("kind>SIGN<", "kind>NONE<"), True), (("expression>*<", "expression>clock*<"), False)],
)
def test_a_governance_of_ones_own_stays(
    changed: tuple[str, str], stated: bool, tmp_path: Path
) -> None:
    """Where no settings can state it, there are none: they would say another protection."""
    old, new = tmp_path / "old", tmp_path / "new"
    make_eloquent(old, NODES, now=NOW, changed=changed)
    sros("create_keystore", new, "--from", old).ok()
    assert (new / "enclaves/governance.p7s").read_bytes() == (old / "governance.p7s").read_bytes()
    for file in ("sros.toml", "ledger.jsonl"):
        assert (new / file).exists() is stated
    found = sros("check", new).out
    assert "settings" not in found and "edited" not in found, found
    sros("create_enclave", new, "/added").ok()
    sros("renew", new, "/talker").ok()


def test_taken_over_it_can_get_the_settings_of_another_template(tmp_path: Path) -> None:
    old, new = tmp_path / "old", tmp_path / "new"
    make_eloquent(old, NODES, now=NOW)
    sros("create_keystore", new, "--from", old).ok()
    told = sros("update_keystore", new, "--set", "protection.rtps=ENCRYPT").ok()
    assert "protection.rtps SIGN -> ENCRYPT" in told.out
    for name in NODES:
        assert not open_enclave(enclave_path(new, name), now=datetime.now(UTC), domain=0).problems


def test_taken_over_nodes_that_may_do_everything_are_named(tmp_path: Path) -> None:
    """Their rights are not those of today's default, so they stay, and that is said."""
    old, new = tmp_path / "old", tmp_path / "new"
    make_eloquent(old, {**NODES, "/all": ("*",)}, now=NOW)
    sros("create_keystore", new, "--from", old).ok()
    sros("create_enclave", new, "/free").ok()
    words = ("update_keystore", new, "--template", "production")
    for more in (("--dry-run",), ("--next",)):
        ended = sros(*words, *more).ok()
        assert "Still open: /all may do everything as before" in ended.err
        assert f"`sros create_permission {new} /all POLICY_FILE`" in ended.err
    assert load_rights(new).sound
    assert "Still open" not in sros(*words).ok().err


def test_a_ca_that_has_expired_is_refused(tmp_path: Path) -> None:
    make_eloquent(tmp_path / "old", NODES, now=NOW - timedelta(days=4000))
    ended = sros("create_keystore", tmp_path / "new", "--from", tmp_path / "old")
    assert ended.status and "cannot be the identity CA now" in ended.err


@pytest.mark.parametrize("release", RELEASES)
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
    assert sros("create_keystore", tmp_path / "new", "--from", root).status == 2


def _topics(folder: Path) -> set[tuple[str, str]]:
    signed = smime.parse((folder / "permissions.p7s").read_bytes())
    return {
        (way, topic)
        for rule in parse_permissions(signed.document).grants[0].rules
        for way in ("publish", "subscribe")
        for criteria in getattr(rule, way)
        for topic in criteria.topics
    }


def _key(path: Path) -> bytes:
    key = load_pem_private_key(path.read_bytes(), None)
    return key.private_bytes(Encoding.DER, PrivateFormat.PKCS8, NoEncryption())


def _copy(made: Path, folder: Path) -> Path:
    return Path(shutil.copytree(made, folder / "copy", symlinks=True))
