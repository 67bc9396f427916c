"""Renewing enclaves: what changes, what stays, when it is time, and what is refused."""

from __future__ import annotations

import json
import os
import re
import shutil
from datetime import UTC, datetime, timedelta
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from sros_tool import parallel
from sros_tool.checks.keystores.keystore import keystore_findings
from sros_tool.checks.keystores.opened import Circumstances
from sros_tool.cli.check import _renewal_lines
from sros_tool.dds.permissions import parse_permissions
from sros_tool.errors import KeystoreError, SrosError, UsageError
from sros_tool.keystore.expiry import Threshold, parse_threshold, survey
from sros_tool.keystore.layout import enclave_path
from sros_tool.keystore.lifecycle.create import create_enclaves, generate_artifacts
from sros_tool.keystore.lifecycle.renew import renew
from sros_tool.keystore.lifecycle.revoke import revoke
from sros_tool.keystore.lifecycle.rotate import rotate_ca
from sros_tool.keystore.reader import OpenedKeystore, open_enclave
from sros_tool.pki import smime
from sros_tool.pki.certificates import validity_of
from sros_tool.policy.document import read_policy
from sros_tool.validity import Window
from sros_tool.zenoh.configuration import ZenohNetwork
from tests.support.harness import (
    certificate,
    check_whole,
    keystore_of,
    policy_text,
    publish,
    snapshot,
    sros,
    topics_of,
)
from tests.support.long_form import some, sometimes

NOW = datetime(2026, 6, 1, tzinfo=UTC)
LATER = NOW + timedelta(days=100)
LEDGERS = {"ledger.jsonl", "ledger.p7s"}
RENEWED = {"cert.pem", "permissions.p7s", "permissions.xml"}
made = partial(keystore_of, now=NOW)


def changed(before: dict[str, tuple[int, bytes]], root: Path) -> set[str]:
    after = snapshot(root)
    return {path for path in before.keys() | after.keys() if before.get(path) != after.get(path)}


def problems(root: Path, name: str, now: datetime) -> list[str]:
    return [str(each) for each in open_enclave(enclave_path(root, name), now=now).problems]


@pytest.mark.parametrize("template", some(["production", "development", "sros2"], 1))
@pytest.mark.parametrize("new_key", [False, True])
@pytest.mark.parametrize("name", ["/a", "/", "/a/b"])
def test_one_is_renewed_and_nothing_else_changes(
    template: str, new_key: bool, name: str, tmp_path: Path
) -> None:
    root = made(tmp_path / "ks", "/a", "/", "/a/b", template=template)
    folder = enclave_path(root, name)
    before, old = snapshot(root), certificate(folder / "cert.pem")
    done = renew(root, [name], now=LATER, new_key=new_key)
    files = RENEWED | ({"key.pem"} if new_key else set())
    expected = {f"{folder.relative_to(root)}/{file}" for file in files} | LEDGERS
    assert changed(before, root) == expected
    assert {change.path for change in done.changes} == expected
    assert done.names("renewed") == (name,)
    new = certificate(folder / "cert.pem")
    assert new.serial_number != old.serial_number
    assert (new.public_key() == old.public_key()) is not new_key
    assert (new.subject == old.subject) is (template != "production")
    end = validity_of(certificate(root / "public/identity_ca.cert.pem")).not_after
    if template == "production":
        end = LATER + timedelta(days=365)
    assert validity_of(new).not_after == end
    assert not problems(root, name, LATER)
    check_whole(root)


@pytest.mark.parametrize("template", ["production", "development"])
def test_the_rights_stay(template: str, tmp_path: Path) -> None:
    root = made(tmp_path / "ks", "/a", "/b", template=template)
    policy = tmp_path / "p.xml"
    policy.write_text(policy_text({"/a": publish("x", "/y/*")}))
    generate_artifacts(root, policies=[read_policy(policy)], now=NOW)
    topics = {name: topics_of(enclave_path(root, name)) for name in ("/a", "/b")}
    grants = {
        name: parse_permissions(
            smime.parse((enclave_path(root, name) / "permissions.p7s").read_bytes()).document
        ).grants
        for name in topics
    }
    renew(root, ["/b", "/a", "/b"], now=LATER)
    for name in topics:
        folder = enclave_path(root, name)
        assert topics_of(folder) == topics[name]
        message = (folder / "permissions.p7s").read_bytes()
        (grant,) = parse_permissions(smime.parse(message).document).grants
        (old,) = grants[name]
        assert grant.rules == old.rules
        assert grant.name == old.name
        assert grant.not_before > old.not_before
        # In development they end with their CA already.
        assert (grant.not_after > old.not_after) is (template == "production")


@pytest.mark.parametrize(
    ("settings", "days"),
    [({}, 180), ({"unique_subject": False}, 365), ({"zenoh": ZenohNetwork()}, 365)],
    ids=["unique subjects", "one subject", "Zenoh"],
)
def test_until_when_the_replaced_certificate_works(
    settings: dict[str, Any], days: int, tmp_path: Path
) -> None:
    """On DDS, a certificate needs permissions that fit it; sros signs no more for its subject."""
    root = made(tmp_path / "ks", "/a", "/b", **settings)
    done = renew(root, ["/a", "/b"], now=LATER)
    assert done.works_until == NOW + timedelta(days=days)
    assert (done.revoked, done.restart) == (0, ())
    assert not (root / "public/identity_ca.crl.pem").exists()
    long_after = NOW + timedelta(days=500)  # the certificates of LATER have ended then
    assert renew(root, ["/a"], now=long_after).works_until is None


def test_the_subject_is_unique_in_production_only(tmp_path: Path) -> None:
    root = made(tmp_path / "ks", "/a", "/b")
    subjects = set()
    for day in range(5):
        renew(root, ["/a", "/b"], now=NOW + timedelta(days=day))
        for name in ("/a", "/b"):
            text = certificate(enclave_path(root, name) / "cert.pem").subject.rfc4514_string()
            assert text.startswith(f"CN={name},OU=")
            subjects.add(text)
    assert len(subjects) == 10


def test_an_expired_enclave_is_renewed(tmp_path: Path) -> None:
    root = made(tmp_path / "ks", "/a")
    late = NOW + timedelta(days=500)
    assert len(problems(root, "/a", late)) == 2
    with pytest.raises(KeystoreError, match="sros renew"):
        create_enclaves(root, ["/a"], now=late)
    renew(root, ["/a"], now=late)
    assert not problems(root, "/a", late)


def test_nothing_outlives_its_authority(tmp_path: Path) -> None:
    root = made(tmp_path / "ks", "/a")
    late = NOW + timedelta(days=5 * 365 - 10)
    renew(root, ["/a"], now=late)
    (life,), _ = survey(OpenedKeystore(root))
    end = validity_of(certificate(root / "public/identity_ca.cert.pem")).not_after
    assert life.certificate.not_after == life.permissions.not_after == end
    assert not problems(root, "/a", end)
    before = snapshot(root)
    late = end + timedelta(seconds=1)
    with pytest.raises(KeystoreError, match="identity CA .* is not valid now") as refused:  # noqa: RUF043
        renew(root, ["/a"], now=late)
    assert snapshot(root) == before
    assert f"`sros rotate_ca {root} --finish`" in refused.value.remedy
    rotate_ca(root, finish=True, now=late)
    renew(root, ["/a"], now=late)
    assert not problems(root, "/a", late)


# ── when it is time ────────────────────────────────────────────────────────────────────────


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("30d", Threshold(remaining=timedelta(days=30))),
        (" 72h ", Threshold(remaining=timedelta(hours=72))),
        ("66%", Threshold(elapsed=0.66)),
        ("0%", Threshold(elapsed=0.0)),
        ("100%", Threshold(elapsed=1.0)),
    ],
)
def test_thresholds(text: str, expected: Threshold) -> None:
    assert parse_threshold(text) == expected


@pytest.mark.parametrize(
    ("validity", "days"), [(180, {150: False, 151: True}), (21, {14: False, 15: True})]
)
def test_what_check_says_expires_soon_is_what_soon_renews(
    validity: int, days: dict[int, bool], tmp_path: Path
) -> None:
    """It goes by the files, whatever the keystore gives now."""
    length = timedelta(days=validity)
    root = made(tmp_path / "ks", "/a", certificate_validity=length, permissions_validity=length)
    settings = root / "sros.toml"
    settings.write_text(settings.read_text().replace(f'"{validity}d"', '"9d"'))
    (life,), _ = survey(OpenedKeystore(root))
    longer = Window(life.certificate.not_before, life.certificate.not_after + 9 * length)
    for day, due in days.items():
        now = NOW + timedelta(days=day)
        found = keystore_findings(OpenedKeystore(root), Circumstances(now))
        assert any(finding.id == "enclave.ends-soon" for finding in found) is due
        for each in (life, life._replace(certificate=longer), life._replace(permissions=longer)):
            assert each.is_due(parse_threshold("soon"), now) is due


@pytest.mark.parametrize("text", ["", "%", "101%", "-1%", "6.5%", "30", "d", "0d", "٣%", "1e1%"])
def test_what_is_no_threshold(text: str) -> None:
    with pytest.raises(UsageError):
        parse_threshold(text)


@pytest.mark.parametrize(
    ("threshold", "day", "due"),
    [
        ("30d", 149, False),  # the permissions end on day 180, and before the certificate
        ("30d", 150, True),
        ("30d", 200, True),
        ("50%", 89, False),
        ("50%", 90, True),
        ("100%", 179, False),
        ("100%", 180, True),
        ("0%", 0, True),
    ],
)
def test_due(threshold: str, day: int, due: bool, tmp_path: Path) -> None:
    root = made(tmp_path / "ks", "/a")
    (life,), _ = survey(OpenedKeystore(root))
    assert life.is_due(parse_threshold(threshold), NOW + timedelta(days=day)) is due


@pytest.mark.parametrize("hours", [1, 6, 24, 72])
def test_a_short_life_is_not_over_as_it_begins(hours: int, tmp_path: Path) -> None:
    """It is back-dated by a day, which is not part of its life."""
    short = timedelta(hours=hours)
    root = made(tmp_path / "ks", "/a", certificate_validity=short, permissions_validity=short)
    (life,), _ = survey(OpenedKeystore(root))
    assert not life.is_due(parse_threshold("66%"), NOW)
    assert not life.is_due(parse_threshold("66%"), NOW + 0.6 * short)
    assert life.is_due(parse_threshold("66%"), NOW + 0.7 * short)


def test_the_life_of_a_certificate_of_another_ca_begins_when_it_came(tmp_path: Path) -> None:
    """It is back-dated by nothing: of 30 hours, 20 are over, and not the last day alone."""
    root = made(tmp_path / "ks", "/a")
    file, hour = root / "enclaves/a/cert.pem", timedelta(hours=1)
    (life,), _ = survey(OpenedKeystore(root))
    short = life._replace(certificate=Window(NOW, NOW + 30 * hour))
    assert not short.is_due(parse_threshold("66%"), NOW + 20 * hour)
    os.utime(file, (NOW.timestamp(), NOW.timestamp()))
    (life,), _ = survey(OpenedKeystore(root))
    short = life._replace(certificate=short.certificate)
    assert not short.is_due(parse_threshold("66%"), NOW + 19 * hour)
    assert short.is_due(parse_threshold("66%"), NOW + 20 * hour)
    for strange in (-1e12, 1e12):
        os.utime(file, (strange, strange))
        (life,), _ = survey(OpenedKeystore(root))
        assert not life._replace(certificate=short.certificate).is_due(
            parse_threshold("66%"), NOW + 20 * hour
        )


def test_all_that_expire(tmp_path: Path) -> None:
    root = made(tmp_path / "ks", "/a", "/b", "/c")
    renew(root, ["/b"], now=LATER)
    soon = NOW + timedelta(days=160)
    seen: list[str] = []
    month = parse_threshold("30d")
    done = renew(root, ["/b"], now=soon, expiring=month, progress=seen.append)
    assert done.names("renewed") == ("/b", "/a", "/c")
    assert seen == ["/b", "/a", "/c"]
    assert renew(root, now=soon, expiring=month).names("renewed") == ()
    assert renew(root, now=soon, expiring=month).changes == ()


@sometimes("renewing with all cores")
def test_many_are_renewed_by_several_processes(tmp_path: Path) -> None:
    names = [f"/n{index:03}" for index in range(230)]
    root = made(tmp_path / "ks", *names)
    seen: list[str] = []
    done = renew(root, names, now=LATER, new_key=True, progress=seen.append)
    assert sorted(seen) == names
    assert len(done.changes) == 4 * len(names) + len(LEDGERS)
    assert not [problem for name in names for problem in problems(root, name, LATER)]
    keys = {(enclave_path(root, name) / "key.pem").read_bytes() for name in names}
    assert len(keys) == len(names)
    check_whole(root)


# ── what is refused ────────────────────────────────────────────────────────────────────────


def lose_key(root: Path) -> None:
    shutil.rmtree(root / "private")


def foreign_certificate(root: Path) -> None:
    other = made(root.with_name("other"), "/b")
    shutil.copy(other / "enclaves/b/cert.pem", root / "enclaves/b/cert.pem")


def foreign_permissions(root: Path) -> None:
    other = made(root.with_name("other"), "/b", template="sros2")
    shutil.copy(other / "enclaves/b/permissions.p7s", root / "enclaves/b/permissions.p7s")


def tampered(root: Path) -> None:
    path = root / "enclaves/b/permissions.p7s"
    path.write_bytes(path.read_bytes().replace(b"rt/rosout", b"rt/cmdvel"))


@pytest.mark.parametrize(
    ("spoil", "said"),
    [
        (lose_key, "the key of the identity CA is missing"),
        (foreign_certificate, "was not issued by the identity CA|no grant for"),
        (foreign_permissions, "not by the permissions CA|no grant for"),
        (tampered, "signature does not match"),
        (lambda root: (root / "enclaves/b/cert.pem").unlink(), "enclave /b cannot be read"),
        (lambda root: (root / "enclaves/b/permissions.p7s").unlink(), "enclave /b cannot be read"),
        (lambda root: (root / "enclaves/b/cert.pem").write_text("x"), "enclave /b cannot be read"),
        (lambda root: shutil.rmtree(root / "enclaves/b"), "enclave /b does not exist"),
    ],
)
def test_one_that_cannot_be_renewed_changes_nothing(
    spoil: object, said: str, tmp_path: Path
) -> None:
    root = made(tmp_path / "ks", "/a", "/b")
    assert callable(spoil)
    spoil(root)
    before = snapshot(root)
    with pytest.raises(SrosError, match=said):
        renew(root, ["/a", "/b"], now=LATER)
    assert snapshot(root) == before


def test_the_key_of_another_enclave_is_not_certified(tmp_path: Path) -> None:
    """A key that is not that of the certificate was put there by somebody."""
    root = made(tmp_path / "ks", "/a", "/b")
    shutil.copy(root / "enclaves/a/key.pem", root / "enclaves/b/key.pem")
    renew(root, ["/b"], now=LATER)
    new = certificate(root / "enclaves/b/cert.pem")
    assert new.public_key() != certificate(root / "enclaves/a/cert.pem").public_key()


def test_a_lost_key_is_replaced_by_the_command_of_the_finding(tmp_path: Path) -> None:
    """Twin: a key that was made on its robot, which has no file here, either, but its request."""
    root = made(tmp_path / "ks", "/a")
    (root / "enclaves/a/key.pem").unlink()
    (command,) = re.findall(r"`sros (renew .* --new-key)`", sros("check", root).out)
    assert f"`sros {command}`" in sros("create_enclave", root, "/a").err
    sros(*command.split()).ok()
    sros("check", root).ok()
    (root / "enclaves/a/key.pem").rename(root / "enclaves/a/request.pem")
    assert "It was generated on the robot and stays there" in sros(*command.split()).err


def test_a_certificate_made_anew_fits_the_permissions_that_are_there(tmp_path: Path) -> None:
    root = made(tmp_path / "ks", "/a")
    (root / "enclaves/a/cert.pem").unlink()
    create_enclaves(root, ["/a"], now=NOW)
    assert not problems(root, "/a", NOW)
    renew(root, ["/a"], now=LATER)
    assert not problems(root, "/a", LATER)


def test_permissions_of_another_enclave_do_not_name_a_certificate(tmp_path: Path) -> None:
    root = made(tmp_path / "ks", "/a", "/b")
    (root / "enclaves/a/cert.pem").unlink()
    shutil.copy(root / "enclaves/b/permissions.p7s", root / "enclaves/a/permissions.p7s")
    create_enclaves(root, ["/a"], now=NOW)
    subject = certificate(root / "enclaves/a/cert.pem").subject.rfc4514_string()
    assert subject.startswith("CN=/a,OU=")
    assert len(problems(root, "/a", NOW)) == 1


def test_every_one_that_cannot_be_renewed_is_named_at_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(parallel, "_SMALLEST_SLICE", 8)  # so that several processes renew
    names = [f"/n{index:03}" for index in range(24)]
    root = made(tmp_path / "ks", *names)
    (root / "enclaves/n003/cert.pem").write_text("x")
    (root / "enclaves/n023/permissions.p7s").unlink()
    before = snapshot(root)
    for chosen, expiring in ((names, None), ([], parse_threshold("100y"))):
        with pytest.raises(KeystoreError, match="2 enclaves cannot be renewed: /n003, /n0") as told:
            renew(root, chosen, now=LATER, expiring=expiring)
        assert ", or name the other enclaves in the command. For /n003: " in told.value.remedy
        assert snapshot(root) == before
    for name in names[4:7]:
        (root / f"enclaves{name}/key.pem").rename(root / f"enclaves{name}/request.pem")
    refused = sros("renew", root, *names[4:7], "--new-key").err
    assert refused.count("is not in this keystore") == 1
    assert ". The key of enclave /n004 is not in this keystore (3 such enclaves)." in refused
    before = snapshot(root)
    updated = sros("update_keystore", root, "--domain", "0-9", "--allow-looser")
    assert "2 enclaves cannot be updated: /n003, /n023" in updated.err
    assert "Repair or revoke them. For /n003: " in updated.err
    assert snapshot(root) == before
    assert len(renew(root, names[4:-1], now=LATER).names("renewed")) == 19


# ── what becomes of the old ────────────────────────────────────────────────────────────────


def serials(root: Path, *names: str) -> dict[str, int]:
    return {
        name: certificate(enclave_path(root, name) / "cert.pem").serial_number for name in names
    }


def revoked(root: Path) -> dict[int, str]:
    crl = OpenedKeystore(root).revocation_list
    return {each.serial: each.reason for each in crl.revoked} if crl else {}


def test_all_earlier_certificates_of_the_renewed_are_revoked(tmp_path: Path) -> None:
    root = made(tmp_path / "ks", "/a", "/b", "/c")
    first = serials(root, "/a", "/b", "/c")
    renew(root, ["/a"], now=LATER)
    second = serials(root, "/a", "/b", "/c")
    done = renew(root, ["/a", "/b"], now=LATER, revoke_old=True)
    gone = {first["/a"], second["/a"], second["/b"]}
    assert revoked(root) == dict.fromkeys(gone, "superseded")
    assert (done.works_until, done.revoked) == (None, 3)
    assert done.restart == ("/a", "/b", "/c")
    for name in ("/a", "/b", "/c"):
        assert (enclave_path(root, name) / "crl.pem").is_symlink()
        assert not problems(root, name, LATER)
    told = {
        int(e.serial, 16): e.reason
        for e in OpenedKeystore(root).ledger.entries
        if e.what == "revocation"
    }
    assert told == revoked(root)
    # What was revoked already stays as it was, and nothing is listed twice.
    renew(root, ["/a"], now=LATER, revoke_old=True)
    third = serials(root, "/b")
    assert len(revoked(root)) == 4
    revoke(root, ["/b"], now=LATER, reason="keyCompromise")
    assert revoked(root)[third["/b"]] == "keyCompromise"
    assert revoked(root)[first["/a"]] == "superseded"
    check_whole(root)


def test_nothing_is_revoked_where_nothing_is_renewed(tmp_path: Path) -> None:
    root = made(tmp_path / "ks", "/a")
    before = snapshot(root)
    done = renew(root, now=NOW, expiring=parse_threshold("30d"), revoke_old=True)
    assert (done.names("renewed"), done.changes, done.restart) == ((), (), ())
    assert snapshot(root) == before
    plan = renew(root, ["/a"], now=LATER, revoke_old=True, dry_run=True)
    assert snapshot(root) == before
    assert "public/identity_ca.crl.pem" in {change.path for change in plan.changes}


def test_a_certificate_that_has_ended_needs_no_revocation(tmp_path: Path) -> None:
    """The ledger, and not only the clock, says that it has ended."""
    root = made(tmp_path / "ks", "/a")
    create_enclaves(root, ["/b"], now=NOW + timedelta(days=400))
    done = renew(root, ["/a"], now=NOW + timedelta(days=500), revoke_old=True)
    assert (done.revoked, revoked(root)) == (0, {})


@pytest.mark.parametrize("day", [1500, 1700, 1815])
def test_what_is_cut_short_by_its_authority_says_so(day: int, tmp_path: Path) -> None:
    """The CAs live for 1825 days, certificates for 365, permissions for 180."""
    root = made(tmp_path / "ks", "/a")
    late = NOW + timedelta(days=day)
    expected = [what for what, days in (("certificates", 365), ("permissions", 180))
                if day + days > 1825]  # fmt: skip
    for notes in (
        renew(root, ["/a"], now=late).notes,
        create_enclaves(root, ["/b"], now=late).notes,
    ):
        said = [each.text for each in notes if each.id == "keystore.ends-with-ca"]
        assert len(said) == len(expected)
        for text, what in zip(said, expected, strict=True):
            assert what in text
            assert "expire with their CA at 2031-05-31" in text
            assert "sros rotate_ca" in text
    assert not create_enclaves(root, ["/b"], now=late).notes, "nothing was issued"


def test_the_last_of_all_earlier_certificates_tells_until_when_they_work(tmp_path: Path) -> None:
    """As after a restored backup: the ledger has a certificate that expires after the replaced."""
    root = made(tmp_path / "ks", "/a", unique_subject=False)
    path = enclave_path(root, "/a") / "cert.pem"
    first = path.read_bytes()
    renew(root, ["/a"], now=LATER)
    last = validity_of(certificate(path)).not_after
    path.write_bytes(first)
    ended = renew(root, ["/a"], now=LATER, dry_run=True)
    assert ended.works_until == last > validity_of(certificate(path)).not_after
    assert not ended.may_work_longer
    soon = NOW + timedelta(days=1)
    assert renew(root, ["/a"], now=soon, revoke_old=True).works_until is None
    until = renew(root, ["/a"], now=soon).works_until
    assert until and until < last, "it is revoked"


# ── the program ────────────────────────────────────────────────────────────────────────────


def test_the_program(tmp_path: Path) -> None:
    root = tmp_path / "ks"
    sros("create_keystore", root, "--template", "production").ok()
    sros("create_enclave", root, "/a", "/b").ok()
    before = snapshot(root)
    plan = sros("renew", root, "/a", "--dry-run").ok()
    assert snapshot(root) == before
    for file in RENEWED:
        assert f"enclaves/a/{file}" in plan.out
    assert "enclaves/b" not in plan.out
    done = sros("renew", root, "/a").ok()
    assert done.out == "renewed enclave /a\n"
    assert "the replaced certificate works until" in done.err
    (root / "private").rename(tmp_path / "unplugged")
    for dry_run in ((), ("--dry-run",)):
        found = sros("renew", root, "--all-expiring", "30d", *dry_run).ok()
        assert "renewed" not in found.out, "no CA key is needed"
    assert sros("renew", root, "--all-expiring", "200d").status == 2
    (tmp_path / "unplugged").rename(root / "private")
    every = sros("renew", root, "--all-expiring", "200d").ok().out
    assert every == "renewed enclave /a\nrenewed enclave /b\n"
    again = sros("renew", root, "--all-expiring", "9000d").ok().err
    assert "the new files expire within 9000d, too" in again
    assert "the last of the replaced certificates works until" in (
        sros("renew", root, "/a", "/b").ok().err
    )
    told = sros("renew", root, "/a", "--revoke-old").ok()
    assert "restart the processes of 2 enclaves" in told.err
    assert "the replaced" not in told.err
    assert sros("crl", root).ok().out.count("superseded") == 5
    assert sros("renew", root).status == 2
    assert sros("renew", root, "--all-expiring", "often").status == 2
    assert sros("renew", root, "/missing").status == 2


def test_the_check_answers_by_its_exit_status(tmp_path: Path) -> None:
    root = tmp_path / "ks"
    sros("create_keystore", root, "--template", "production").ok()
    sros("create_enclave", root, "/a").ok()
    check = ("check", "keystore", root, "--needs-renewal")
    well = sros(*check, "66%").ok()
    assert (well.out, well.err) == ("", "no enclave needs to be renewed (66%)\n")
    due = sros(*check, "181d")
    assert (due.status, due.out.startswith("/a  permissions until ")) == (1, True), due
    (entry,) = json.loads(sros(*check, "181d", "--json").out)["enclaves"]
    assert set(entry) == {"enclave", "certificate_until", "permissions_until"}
    assert json.loads(sros(*check, "30d", "--json").ok().out)["enclaves"] == []
    sros("create_enclave", root, *(f"/b{number}" for number in range(21))).ok()
    lines = sros(*check, "181d").out.splitlines()
    assert lines[-1] == "22 enclaves in all (-v lists them)" and len(lines) <= 3, "by days"
    assert re.match(r"/a(, /b0 and 20 more)?  permissions until \S+Z( \(the first\))?$", lines[0])
    assert len(sros(*check, "181d", "-v").out.splitlines()) == 22
    ends = [f"/{day}  permissions until 2027-05-{day:02}T00:00:00Z" for day in range(31, 6, -1)]
    assert next(_renewal_lines(ends, ())) == ends[-1], "what expires first comes first"
    (root / "enclaves/b7/cert.pem").write_text("damaged")
    unread = sros(*check, "181d")
    assert (unread.status, unread.out.startswith("/b7  unknown: ")) == (2, True), "none hides it"
    assert sros(*check, "often").status == 2


def test_the_check_also_lists_what_enclaves_share(tmp_path: Path) -> None:
    """CAs and revocation list, each with its command; with a share of the validity, only soon."""
    check = ("check", "keystore", "ks", "--needs-renewal")
    sros("create_keystore", "ks", "--template", "production", cwd=tmp_path).ok()
    sros("create_enclave", "ks", "/a", cwd=tmp_path).ok()
    sros("revoke", "ks", "/a", cwd=tmp_path).ok()
    assert sros(*check, "30d", cwd=tmp_path).ok().out == ""
    due = sros(*check, "20y", cwd=tmp_path)
    names, commands = zip(
        *(re.split(r"  until \S+: ", line) for line in due.out.splitlines()), strict=True
    )
    assert (due.status, names) == (1, ("identity CA", "permissions CA", "revocation list"))
    assert {*commands} == {"sros rotate_ca ks --next"}, "the list ends with the CA"
    for years, is_due in (("4y", False), ("5y", True)):  # five years, less than 90 days are left
        ended = sros(*check, "99%", "--at", f"{5 * 365 - 60 if is_due else 4 * 365}d", cwd=tmp_path)
        assert (ended.status, "identity CA" in ended.out) == (int(is_due), is_due), years
    expired = sros(*check, "soon", "--at", "6y", "--json", cwd=tmp_path)
    files = {each["file"]: each["command"] for each in json.loads(expired.out)["files"]}
    assert files["permissions CA"] == "sros rotate_ca ks --finish"
    sros("rotate_ca", "ks", "--same-key", "--ca-validity", "10y", cwd=tmp_path).ok()
    listed = sros(*check, "6y", cwd=tmp_path).out.splitlines()
    assert [line.partition("  ")[0] for line in listed] == ["permissions CA", "revocation list"]
    assert listed[-1].endswith(": sros crl ks --refresh")
    (tmp_path / "ks/public/permissions_ca.cert.pem").write_text("x")
    unread = sros(*check, "30d", cwd=tmp_path)
    assert (unread.status, unread.out.startswith("CAs  unknown: ")) == (2, True), unread


def test_the_check_goes_on_after_one_that_cannot_be_read(tmp_path: Path) -> None:
    root = tmp_path / "ks"
    sros("create_keystore", root, "--template", "production").ok()
    sros("create_enclave", root, "/a", "/b", "/c").ok()
    (root / "enclaves/b/cert.pem").write_text("x")
    check = ("check", "keystore", root, "--needs-renewal")
    told = sros(*check, "30d")
    assert (told.status, told.out.count("\n")) == (2, 1), told
    assert told.out.startswith("/b  unknown: enclave /b cannot be read")
    told = sros(*check, "181d")
    assert [line.split()[0] for line in told.out.splitlines()] == ["/a", "/c", "/b"]
    shown = json.loads(sros(*check, "181d", "--json").out)
    assert [entry["enclave"] for entry in shown["enclaves"]] == ["/a", "/c"]
    (unreadable,) = shown["unreadable"]
    assert (unreadable["enclave"], set(unreadable)) == ("/b", {"enclave", "problem"})
