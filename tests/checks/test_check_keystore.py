"""``sros check keystore`` as people run it: what it shows, accepts, and returns."""

from __future__ import annotations

import json
import os
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path
from zoneinfo import ZoneInfo

import pytest

from sros_tool.checks.keystores.keystore import keystore_findings
from sros_tool.checks.keystores.opened import Circumstances
from sros_tool.checks.kind import FindingFilter, group_by_cause
from sros_tool.dds.decision.access import Access, GovernedDomain
from sros_tool.dds.decision.vendors import TESTED, Signers, Vendor, joined_titles
from sros_tool.keystore.layout import enclave_path
from sros_tool.keystore.lifecycle.create import create_enclaves, create_keystore
from sros_tool.keystore.lifecycle.rotation import rotation_status
from sros_tool.keystore.reader import OpenedKeystore, open_enclave
from sros_tool.keystore.template import load_template
from sros_tool.pki import smime
from sros_tool.pki.certificates import load_certificate, subject_text
from sros_tool.pki.keys import load_key
from tests.support.harness import policy_text, publish, sros

NOW = datetime.now(UTC)


def ids(root: Path, now: datetime = NOW) -> list[str]:
    selection = FindingFilter(exclude=("enclave.node-cannot-start",))
    chosen = selection.choose(keystore_findings(OpenedKeystore(root), Circumstances(now)))
    return [each.id for each in chosen.shown]


@pytest.mark.parametrize("template", ["sros2", "development", "production"])
def test_only_an_open_enclave_is_found_in_what_sros_makes(template: str, tmp_path: Path) -> None:
    root, policy = tmp_path / "ks", tmp_path / "policy.xml"
    policy.write_text(policy_text({"/a": publish("x")}))
    sros("create_keystore", root, "--template", template).ok()
    sros("create_enclave", root, "/a").ok()
    ended = sros("check", "keystore", root)
    assert ended.status == (template != "production"), ended
    assert ("keystore.allow-everything" in ended.out) == (template != "production")
    sros("create_permission", root, "/a", policy).ok()
    no_node = ("--exclude", "enclave.node-cannot-start")  # the policy is for one topic
    ended = sros("check", "keystore", root, *no_node).ok()
    named = "keystore.one-authority" in ended.out
    assert named == (template == "sros2")
    assert sros("check", root, "--strict", *no_node).status == (template != "production")


def test_a_template_accepts_nothing_that_was_opened_later(tmp_path: Path) -> None:
    root = tmp_path / "ks"
    sros("create_keystore", root, "--template", "production").ok()
    sros("create_enclave", root, "/a").ok()
    sros("check", root).ok()
    words = ("update_keystore", root, "--allow-looser", "--set")
    sros(*words, "protection.rtps=NONE", "--set", "protection.default.data=NONE").ok()
    sros(*words, "protection.default.metadata=NONE").ok()
    ended = sros("check", root)
    assert ended.status == 1
    assert "accepted by" not in ended.out


def test_a_folder_that_is_named_like_a_family_is_that_folder(tmp_path: Path) -> None:
    """`keystore` is what the examples call a keystore, and beside it stands no other path."""
    sros("create_keystore", "keystore", cwd=tmp_path).ok()
    sros("create_enclave", "keystore", "/a", cwd=tmp_path).ok()
    (tmp_path / "keystore/enclaves/a/key.pem").chmod(0o644)
    for words in (["keystore"], ["keystore", "keystore"]):
        ended = sros("check", *words, cwd=tmp_path, env={"ROS_SECURITY_KEYSTORE": None})
        assert "keystore.key-readable" in ended.out, words


def test_what_was_looked_at_is_told_where_nothing_was_named(tmp_path: Path) -> None:
    ended = sros("check", cwd=tmp_path, env={"ROS_SECURITY_KEYSTORE": None})
    assert ended.err.startswith("checked the runtime only")
    assert "checked the runtime" not in sros("check", "runtime", cwd=tmp_path).err


def test_one_authority_that_nobody_chose(tmp_path: Path) -> None:
    """A keystore of ros2/sros2 has no settings, so nothing in it counts as chosen."""
    root = tmp_path / "ks"
    sros("create_keystore", root, "--template", "sros2").ok()
    (root / "sros.toml").unlink()
    (root / "ledger.jsonl").unlink()
    ended = sros("check", "keystore", root)
    assert ended.status == 1
    assert "keystore.one-authority" in ended.out


def test_weaknesses_of_single_files(tmp_path: Path) -> None:
    root = tmp_path / "ks"
    sros("create_keystore", root, "--template", "production").ok()
    sros("create_enclave", root, "/a", "/b").ok()
    assert ids(root) == []
    (root / "enclaves/a/key.pem").chmod(0o644)
    assert ids(root) == ["keystore.key-readable"]
    (root / "enclaves/a/key.pem").chmod(0)
    unread = "enclave.file-unreadable" if os.geteuid() else "keystore.file-unreadable"
    assert ids(root) == [unread]
    if not os.geteuid():  # root reads it, and the owner does not
        said = sros("explain", root, "/a", "publish", "/x").err
        assert "key.pem' is 0000, so only root can read it" in said
    (root / "enclaves/a/key.pem").chmod(0o644)
    (root / "enclaves/b/cert.pem").unlink()
    assert ids(root) == ["keystore.key-readable", "enclave.file-missing"]
    words = ("check", root, "--json", "--include", "enclave.not-loadable")
    found = json.loads(sros(*words).out)["findings"]
    assert [each["id"] for each in found] == ["enclave.file-missing"]


def test_a_revocation_list_that_ends(tmp_path: Path) -> None:
    root = tmp_path / "ks"
    sros("create_keystore", root, "--template", "production").ok()
    sros("create_enclave", root, "/a", "/b").ok()
    sros("revoke", root, "/b").ok()
    assert ids(root) == []
    assert "keystore.revocation-list-ends" in ids(root, NOW + timedelta(days=3649))
    sros("update_keystore", root, "--set", "revocation.validity=21d").ok()
    sros("crl", root, "--refresh").ok()
    ends = [day for day in (0, 12, 16, 22) if ids(root, NOW + timedelta(days=day))]
    assert ends == [16, 22], "nothing is wrong with the list that the remedy makes"
    for day, text in ((16, "it expires at "), (22, "it expired at ")):
        at = Circumstances(NOW + timedelta(days=day))
        found = keystore_findings(OpenedKeystore(root), at)
        assert any(each.text.startswith(text) and "DDS" in each.text for each in found), text


def test_a_ca_with_a_short_validity_expires_soon_in_its_last_third(tmp_path: Path) -> None:
    choices = replace(load_template("production"), authority_validity=timedelta(days=60))
    create_keystore(tmp_path / "ks", template=choices, now=NOW)
    for day, soon in ((39, False), (41, True)):
        now = NOW + timedelta(days=day)
        assert ("keystore.ca-ends-soon" in ids(tmp_path / "ks", now)) is soon
        remarks = rotation_status(OpenedKeystore(tmp_path / "ks"), now=now).remarks
        assert any("begin to replace it" in remark for remark in remarks) is soon


def test_files_that_expire_soon_are_one_finding(tmp_path: Path) -> None:
    root = tmp_path / "ks"
    sros("create_keystore", root, "--template", "production").ok()
    sros("create_enclave", root, "/a", "/b").ok()
    found = keystore_findings(OpenedKeystore(root), Circumstances(NOW + timedelta(days=160)))
    (soon,) = (group for group in group_by_cause(found) if group[0].id == "enclave.ends-soon")
    cause = soon[0].cause
    assert (
        len(soon) == 2
        and cause
        and "2 files of 2 enclaves; the file that expires first belongs to /a" in cause.text
    )
    assert f"`sros renew {root} --all-expiring soon`" in cause.remedy
    assert "export" in cause.remedy and "publish" not in cause.remedy


def test_a_key_on_its_robot_is_no_fault(tmp_path: Path) -> None:
    root, robot = tmp_path / "ks", tmp_path / "robot"
    sros("create_keystore", root, "--template", "production").ok()
    sros("create_request", "/arm", robot).ok()
    answer = tmp_path / "answer.tar.gz"
    sros("sign_request", root, robot / "enclaves/arm/request.pem", "-o", answer).ok()
    assert ids(root) == []
    (root / "enclaves/arm/cert.pem").write_text("nonsense")
    assert set(ids(root)) == {"enclave.certificate-malformed"}


def test_permissions_that_were_replaced_and_put_back(tmp_path: Path) -> None:
    """Their signature holds, and DDS takes them: only the ledger knows that they are old."""
    root, policy = tmp_path / "ks", tmp_path / "policy.xml"
    sros("create_keystore", root, "--template", "production").ok()
    policy.write_text(policy_text({"/a": publish("rosout", "wide")}))
    sros("generate_artifacts", "-k", root, "-p", policy).ok()
    files = [root / "enclaves/a" / name for name in ("permissions.p7s", "permissions.xml")]
    before = [file.read_bytes() for file in files]
    policy.write_text(policy_text({"/a": publish("rosout")}))
    sros("create_permission", root, "/a", policy).ok()
    assert ids(root) == []
    for file, data in zip(files, before, strict=True):
        file.write_bytes(data)
    assert ids(root) == ["enclave.old-permissions"]
    shown = sros("check", root, "--policy", policy).out
    assert "enclave.stale-permissions" in shown
    assert "- ALLOW publish topic /wide" in shown


def test_permissions_that_an_enclave_signed_for_itself(tmp_path: Path) -> None:
    """With one CA for both jobs some vendors take them; sros names these, and who gave the rights.

    Twin: of permissions that were changed after a CA signed them, no vendor takes any.
    """
    root = tmp_path / "ks"
    sros("create_keystore", root, "--template", "sros2").ok()
    sros("create_enclave", root, "/a").ok()
    folder = root / "enclaves/a"
    certificate = load_certificate((folder / "cert.pem").read_bytes(), "")
    key = load_key((folder / "key.pem").read_bytes(), "")
    document = (folder / "permissions.xml").read_bytes()
    (folder / "permissions.p7s").write_bytes(smime.sign(document, certificate, key))
    ended = sros("check", root)
    assert ended.status == 1
    assert "it is signed by CN=/a, not by the permissions CA" in ended.out
    assert "keystore.one-authority" in ended.out
    assert "enclave.signer-no-ca" in ended.out
    assert "the enclave gave itself these rights" in ended.out
    refusing = joined_titles(each.title for each in TESTED if each.traits.signers is Signers.LISTED)
    taken = f"accepted by Fast DDS 2.9.1, Cyclone DDS 0.10, refused by {', '.join(refusing)}"
    assert taken in ended.out
    ended = sros("check", root, "--vendor", "cyclonedds")
    assert "accepted by Cyclone DDS 0.10" in ended.out and "Fast" not in ended.out
    damaged = smime.sign(document, certificate, key).replace(b"<validity>", b"<validity >", 1)
    (folder / "permissions.p7s").write_bytes(damaged)
    ended = sros("check", root)
    assert "enclave.signature" in ended.out and "accepted by Fast" not in ended.out


@pytest.mark.parametrize(("hours", "found"), [(6.5, True), (7.5, True), (8.5, False)])
def test_local_time_is_standard_time_in_summer_too(
    hours: float, found: bool, tmp_path: Path
) -> None:
    """Fast DDS calls mktime without daylight saving: 8 hours in Los Angeles, not 7, in July."""
    root, signed = tmp_path / "ks", datetime(2026, 7, 10, tzinfo=UTC)
    create_keystore(root, template=load_template("production"), now=signed)
    create_enclaves(root, ["/a"], now=signed)
    at = signed - timedelta(days=1) + timedelta(hours=hours)
    zone = ZoneInfo("America/Los_Angeles")
    state = open_enclave(enclave_path(root, "/a"), now=at)
    assert state.governance and state.permissions and state.certificate
    subject = subject_text(state.certificate.subject)
    fast, cyclone = (
        Access(
            GovernedDomain(vendor, state.governance, 0),
            state.permissions,
            subject,
            moment=at,
            zone=zone,
        )
        for vendor in (Vendor.FAST, Vendor.CYCLONE)
    )
    assert cyclone.join().outcome.ok
    assert fast.join().outcome.ok is not found
    told = {
        each.id for each in keystore_findings(OpenedKeystore(root), Circumstances(at, zone=zone))
    }
    assert ("enclave.permissions-local-time" in told) is found


@pytest.mark.parametrize("unique", [True, False])
def test_names_that_unique_subjects_tell_apart(tmp_path: Path, unique: bool) -> None:
    """Also for the policy from which the keystore is made."""
    policy = tmp_path / "p.xml"
    policy.write_text(policy_text({"/bot/sensor": publish("x"), "/bot/front/sensor": publish("x")}))
    template = "production" if unique else "development"
    sros("create_keystore", tmp_path / "ks", "--template", template).ok()
    sros("generate_artifacts", "-k", tmp_path / "ks", "-p", policy).ok()
    ended = sros(
        "check", tmp_path / "ks", "--policy", policy, "--include", "portable.enclave-names"
    )
    assert (ended.status, "p.xml:" in ended.out) == ((0, False) if unique else (1, True)), ended
