"""Findings about several keystores and exports whose nodes do not communicate."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta
from itertools import combinations
from pathlib import Path
from shutil import rmtree

from sros_tool.checks.keystores.opened import Circumstances
from sros_tool.checks.targets import path_findings
from sros_tool.keystore.delivery.export import distribute
from sros_tool.keystore.lifecycle.create import create_enclaves, create_keystore
from sros_tool.keystore.lifecycle.revoke import refresh_crl, revoke
from sros_tool.keystore.reader import OpenedKeystore
from sros_tool.keystore.template import load_template
from tests.support.harness import copy_of, sros

FOUND = {
    "keystore.strangers",
    "keystore.peers-revoked",
    "keystore.peers-accept-revoked",
    "keystore.peers-protection",
    "keystore.peers-domains",
}
NOW = datetime.now(UTC)


def strangers(*paths: Path, vendors: tuple[str, ...] = (), at: datetime = NOW) -> list[str]:
    found = path_findings(paths, Circumstances(at, vendors=vendors))
    return [each.text for each in found if each.id in FOUND]


def test_keystores_and_their_exports_are_strangers(keystore: Path, tmp_path: Path) -> None:
    other, export = tmp_path / "other", tmp_path / "export"
    sros("create_keystore", other).ok()
    sros("create_enclave", other, "/a").ok()
    sros("distribute_key", keystore, "/a", export).ok()
    (text,) = strangers(keystore, other, export)
    assert text == (
        f"nodes of {keystore}, {export} do not communicate with nodes of {other}: one side does "
        "not trust the other's identity CA and permissions CA"
    )
    assert strangers(keystore, export) == strangers(keystore, keystore / "enclaves/a") == []
    assert strangers(other) == strangers(keystore / "enclaves/a/cert.pem", other) == []
    (text,) = strangers(export / "enclaves/a", other / "enclaves/a", vendors=("zenoh",))
    assert text.endswith("the other's identity CA")
    assert "keystore.strangers" in sros("check", "keystore", export, other).out
    export.rename(tmp_path / "keystore")  # the word names the folder, and no family of checks
    assert "keystore.strangers" in sros("check", "keystore", "other", cwd=tmp_path).out


def test_enclaves_in_a_rotation_are_strangers_after_two_stages(
    keystore: Path, tmp_path: Path
) -> None:
    stages = [keystore]
    for number in range(1, 4):
        stages.append(copy_of(stages[-1], tmp_path / f"stage{number}"))
        sros("rotate_ca", stages[-1], "--permissions", "--next").ok()
    for one, other in combinations(range(4), 2):
        assert bool(strangers(stages[one], stages[other])) is (other - one > 1), (one, other)


def test_a_list_that_revokes_an_enclave_of_the_other_folder(keystore: Path, tmp_path: Path) -> None:
    laptop, robot = tmp_path / "laptop", tmp_path / "robot"
    sros("distribute_key", keystore, "/a", laptop).ok()
    sros("distribute_key", keystore, "/b", robot).ok()
    assert strangers(keystore, laptop) == strangers(robot, laptop) == []
    sros("renew", keystore, "/a", "--new-key", "--revoke-old").ok()
    sros("distribute_key", keystore, "/b", robot, "--force").ok()
    for paths in ((robot, laptop), (laptop, robot), (keystore, robot, laptop)):
        refusing = ", ".join(str(path) for path in paths if path != laptop)
        assert strangers(*paths) == [
            f"nodes of {refusing} refuse nodes of {laptop} in /a: the revocation list of "
            f"{refusing} revokes the certificate",
            f"nodes of {laptop} accept 1 certificate that the newer revocation list of {refusing} "
            "revokes",
        ]
    assert strangers(robot, laptop, vendors=("zenoh",)) == []
    sros("distribute_key", keystore, "/a", laptop, "--force").ok()
    assert strangers(keystore, robot, laptop) == []


def test_an_export_from_before_a_revocation(keystore: Path, tmp_path: Path) -> None:
    """Its nodes hear a revoked enclave, of which nothing is in any of the folders."""
    sros("create_enclave", keystore, "/stolen").ok()
    early, late = tmp_path / "early", tmp_path / "late"
    sros("crl", keystore, "--refresh").ok()
    for folder in (early, late):
        sros("distribute_key", keystore, "/a", folder).ok()
    sros("crl", keystore, "--refresh").ok()
    assert strangers(early, keystore) == []  # a newer list with the same entries
    sros("revoke", keystore, "/stolen").ok()
    sros("distribute_key", keystore, "/a", late, "--force").ok()
    accepts = f"nodes of {early} accept 1 certificate that the newer revocation list of"
    assert strangers(early, late) == [f"{accepts} {late} revokes"]
    assert strangers(keystore, early, late) == [f"{accepts} {keystore}, {late} revokes"]
    (early / "enclaves/a/crl.pem").unlink()
    assert strangers(late, early) == [f"{accepts} {late} revokes"]
    assert strangers(late, keystore) == strangers(late, early, vendors=("zenoh",)) == []
    ca = early / "enclaves/a/identity_ca.cert.pem"
    listed = (late / "enclaves/a/crl.pem").read_text()
    ca.write_text(ca.read_text() + listed)  # as in a rotation
    assert strangers(late, early) == []
    ca.write_text("broken")
    assert strangers(late, early) == []


def test_a_keystore_from_before_a_revocation(keystore: Path, tmp_path: Path) -> None:
    """A restored keystore lacks it, and its next list has the number of another one."""
    for name in ("/stolen", "/lost"):
        sros("create_enclave", keystore, name).ok()
    restored, robot = copy_of(keystore, tmp_path / "restored"), tmp_path / "robot"
    sros("revoke", keystore, "/stolen").ok()
    sros("distribute_key", keystore, "/a", robot).ok()
    nodes, of = f"nodes of {restored} accept 1 certificate that the", f"list of {robot} revokes"

    def accepting() -> list[str]:
        return [text for text in strangers(restored, robot) if "accept" in text]

    assert accepting() == [f"{nodes} newer revocation {of}"]
    said = sros("check", restored, robot).out
    assert "`sros crl KEYSTORE --refresh --crl FILE`" in said and "distribute_key" not in said
    sros("revoke", restored, "/lost").ok()
    assert accepting() == [
        f"{nodes} revocation {of}",
        f"nodes of {robot} accept 1 certificate that the revocation list of {restored} revokes",
    ]
    for _ in range(2):
        sros("crl", restored, "--refresh").ok()  # a later list: an export would replace the robot's
    late = tmp_path / "late"
    sros("distribute_key", restored, "/a", late).ok()
    assert accepting()[0] == f"{nodes} revocation {of}"
    assert len([text for text in strangers(robot, late) if "accept" in text]) == 1, "by the later"
    said = sros("check", restored, robot).out
    assert "before its next export, revoke the certificates on the other list" in said
    assert "first revoke them again in that keystore" in said and "distribute_key" in said


def test_a_list_may_lack_what_expired(tmp_path: Path) -> None:
    keystore, robot, later = tmp_path / "ks", tmp_path / "robot", NOW + timedelta(days=400)
    create_keystore(keystore, template=load_template("production"), now=NOW)
    create_enclaves(keystore, ["/a", "/gone"], now=NOW)
    revoke(keystore, ["/gone"], now=NOW)
    distribute(OpenedKeystore(keystore), ["/a"], robot, now=NOW)
    for days in (0, 2):
        refresh_crl(keystore, now=later + timedelta(days=days))
    assert not OpenedKeystore(keystore).revocation_lists[0].revoked
    assert [len(strangers(keystore, robot, at=moment)) for moment in (NOW, later)] == [1, 0]


def test_protection_and_domains_that_keep_nodes_apart(keystore: Path, tmp_path: Path) -> None:
    robot, other = tmp_path / "robot", tmp_path / "other"
    sros("distribute_key", keystore, "/a", robot).ok()
    for change, text in (
        (("--set", "protection.rtps=NONE"), ": protection.rtps: SIGN in "),
        (
            ("--rule", "topic /scan data=NONE metadata=SIGN"),
            " on topic /scan: protection.topic /scan.",
        ),
        (("--domain", "5"), ": the first side is for domain 0, the second for domain 5"),
        (("--set", "protection.join_access_control=false"), ""),  # does no harm; tested
        (("--domain", "0,5"), ""),
    ):
        copy_of(keystore, other)
        sros("update_keystore", other, *change, "--allow-looser").ok()
        found = strangers(other, robot)
        assert bool(found) is bool(text), found
        for each in found:
            assert each.startswith(f"nodes of {robot} do not communicate with nodes of {other}")
            assert text in each
        rmtree(other)
