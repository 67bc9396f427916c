"""Revoking enclaves: the list, its way to everybody, and the files out of the way."""

from __future__ import annotations

import json
import os
import re
import shutil
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from functools import partial
from pathlib import Path

import pytest
from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec

from sros_tool.errors import KeystoreError, SrosError, UsageError
from sros_tool.keystore.delivery.export import distribute
from sros_tool.keystore.known_keys import KnownKeys
from sros_tool.keystore.layout import LEDGER, enclave_path, list_enclaves
from sros_tool.keystore.ledger import Entry
from sros_tool.keystore.lifecycle.create import create_enclaves, create_keystore
from sros_tool.keystore.lifecycle.renew import renew
from sros_tool.keystore.lifecycle.revoke import refresh_crl, revoke
from sros_tool.keystore.reader import OpenedKeystore, open_enclave
from sros_tool.keystore.template import load_template
from sros_tool.pki.certificates import key_digest, validity_of
from sros_tool.pki.crl import REASONS, SUPERSEDED, RevocationList
from sros_tool.pki.keys import generate_key
from tests.support.children import run
from tests.support.harness import (
    certificate,
    check_whole,
    copy_of,
    keystore_of,
    policy_text,
    publish,
    snapshot,
    sros,
)
from tests.support.long_form import some

NOW = datetime(2026, 6, 1, tzinfo=UTC)
DAY = timedelta(days=1)
made = partial(keystore_of, now=NOW)


def serial(root: Path, name: str) -> int:
    return certificate(enclave_path(root, name) / "cert.pem").serial_number


def crl_of(root: Path) -> RevocationList:
    found = OpenedKeystore(root).revocation_list
    assert found
    return found


def problems(folder: Path, now: datetime = NOW) -> list[str]:
    return [str(each) for each in open_enclave(folder, now=now).problems]


@pytest.mark.parametrize("template", some(["production", "development", "sros2"], 1))
@pytest.mark.parametrize("name", ["/a", "/", "/a/b"])
def test_one_is_revoked(template: str, name: str, tmp_path: Path) -> None:
    names = ("/", "/a", "/a/b", "/c")
    root = made(tmp_path / "ks", *names, template=template)
    folder = enclave_path(root, name)
    stolen = Path(shutil.copytree(folder, tmp_path / "stolen"))
    number = serial(root, name)
    done = revoke(root, [name], now=NOW, reason="keyCompromise")
    others = tuple(each for each in names if each != name)
    assert done.names("revoked") == (name,)
    assert done.restart == list_enclaves(root) == others
    (entry,) = crl_of(root).revoked
    assert (entry.serial, entry.reason, entry.date) == (number, "keyCompromise", NOW)
    for other in others:
        path = enclave_path(root, other) / "crl.pem"
        assert path.resolve() == (root / "public/identity_ca.crl.pem").resolve()
        assert not problems(enclave_path(root, other))
    moved = root / f"revoked/{number:x}"
    assert {path.name for path in moved.iterdir()} == {
        "cert.pem",
        "key.pem",
        "permissions.p7s",
        "permissions.xml",
    }
    assert (moved / "key.pem").read_bytes() == (stolen / "key.pem").read_bytes()
    assert (moved / "key.pem").stat().st_mode & 0o777 == 0o600
    assert moved.stat().st_mode & 0o777 == moved.parent.stat().st_mode & 0o777 == 0o700
    left = {path.name for path in folder.iterdir()} if folder.exists() else set()
    assert left <= {"a", "b", "c", "governance.xml", "governance.p7s"}
    check_whole(root)
    shutil.copy(root / "public/identity_ca.crl.pem", stolen / "crl.pem")
    assert problems(stolen) == ["cert.pem: it is revoked by crl.pem"]


def test_folders_of_which_nothing_is_left_go(tmp_path: Path) -> None:
    root = made(tmp_path / "ks", "/x/y/z", "/x/w", "/v")
    revoke(root, ["/x/y/z"], now=NOW)
    assert not (root / "enclaves/x/y").exists()
    assert (root / "enclaves/x/w").exists()
    revoke(root, ["/x/w", "/v"], now=NOW)
    assert sorted(path.name for path in (root / "enclaves").iterdir()) == [
        "governance.p7s",
        "governance.xml",
    ]


def test_earlier_certificates_are_revoked_too(tmp_path: Path) -> None:
    """One that was renewed is not revoked by that: with the key, it is as good as the last."""
    root = made(tmp_path / "ks", "/a", "/b")
    serials = [serial(root, "/a")]
    for day in (10, 20):
        renew(root, ["/a"], now=NOW + day * DAY, new_key=day == 20)
        serials.append(serial(root, "/a"))
    other = serial(root, "/b")
    revoke(root, ["/a"], now=NOW + 30 * DAY)
    assert {each.serial for each in crl_of(root).revoked} == set(serials)
    assert not crl_of(root).revokes(other)
    told = [
        int(each.serial, 16)
        for each in OpenedKeystore(root).ledger.entries
        if each.what == "revocation"
    ]
    assert sorted(told) == sorted(serials)


def test_one_that_has_ended_needs_no_revocation(tmp_path: Path) -> None:
    root = made(tmp_path / "ks", "/a", "/b")
    first = serial(root, "/a")
    late = NOW + 366 * DAY
    renew(root, ["/a"], now=late)
    second = serial(root, "/a")
    revoke(root, ["/a"], now=late)
    assert [each.serial for each in crl_of(root).revoked] == [second]
    assert first != second


def test_what_was_revoked_stays_revoked(tmp_path: Path) -> None:
    root = made(tmp_path / "ks", "/a", "/b", "/c", "/d")
    serials = {name: serial(root, name) for name in ("/a", "/b", "/c")}
    for number, (name, reason) in enumerate(
        [("/a", "keyCompromise"), ("/b", "unspecified"), ("/c", "cessationOfOperation")], 1
    ):
        revoke(root, [name], now=NOW + number * DAY, reason=reason)
        assert crl_of(root).number == number
    expected = [
        (serials["/a"], "keyCompromise", NOW + DAY),
        (serials["/b"], "unspecified", NOW + 2 * DAY),
        (serials["/c"], "cessationOfOperation", NOW + 3 * DAY),
    ]
    refresh_crl(root, now=NOW + 9 * DAY)
    found = crl_of(root)
    assert [(each.serial, each.reason, each.date) for each in found.revoked] == expected
    assert found.number == 4


@pytest.mark.parametrize("reason", sorted({*REASONS} - {SUPERSEDED}))
def test_every_reason(reason: str, tmp_path: Path) -> None:
    root = made(tmp_path / "ks", "/a", "/b")
    revoke(root, ["/a"], now=NOW, reason=reason)
    assert crl_of(root).revoked[0].reason == reason


def test_again_under_the_same_name(tmp_path: Path) -> None:
    root = made(tmp_path / "ks", "/a", "/b")
    old = certificate(root / "enclaves/a/cert.pem")
    revoke(root, ["/a"], now=NOW)
    create_enclaves(root, ["/a", "/new"], now=NOW)
    new = certificate(root / "enclaves/a/cert.pem")
    assert new.public_key() != old.public_key()
    assert not crl_of(root).revokes(new.serial_number)
    for name in ("a", "new"):
        assert not problems(root / "enclaves" / name)
        assert (root / "enclaves" / name / "crl.pem").is_symlink()
    revoke(root, ["/a"], now=NOW)
    assert len(crl_of(root).revoked) == 2
    assert len(list((root / "revoked").iterdir())) == 2


def test_the_serial_number_of_a_revoked_key_is_printed_as_openssl_does(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    keystore, key = OpenedKeystore(made(tmp_path / "keystore")), generate_key().public_key()
    entry = Entry("", "revocation", subject="CN=/a", serial="abc", key=key_digest(key))
    monkeypatch.setattr(OpenedKeystore, "entries_of", lambda *_: [entry])
    with pytest.raises(KeystoreError, match="the key of certificate 0abc of CN=/a"):
        KnownKeys(keystore).refuse_revoked_key(key, "it", "")


@pytest.mark.parametrize("ledger", ["whole", "lost"])
def test_a_policy_alone_makes_no_revoked_enclave_again(ledger: str, tmp_path: Path) -> None:
    root = made(tmp_path / "ks", "/b")
    policy = tmp_path / "robot.xml"
    policy.write_text(policy_text({"/a": publish("chatter"), "/c": publish("x")}))
    given = ("generate_artifacts", "-k", root, "-p", policy)
    sros(*given).ok()
    sros("renew", root, "/c", "--revoke-old").ok()  # superseded: /c still is an enclave
    sros("revoke", root, "/a", "--reason", "cessation_of_operation").ok()
    shutil.rmtree(root / "enclaves/c")
    if ledger == "lost":
        (root / "ledger.jsonl").unlink()
    before = snapshot(root)
    refused = sros(*given)
    assert refused.status == 2, refused
    assert "a policy names /a, revoked in keystore" in refused.err
    assert snapshot(root) == before
    (command,) = re.findall("`sros (generate_artifacts .+?)`", refused.err)
    named = sros(*command.replace("POLICY_FILE", str(policy)).split()).ok()
    assert "/a was revoked, and now exists again" in named.err
    assert "was revoked" not in sros(*given).ok().err
    assert {"/a", "/c"} < set(list_enclaves(root))


def test_put_back_and_revoked_again(tmp_path: Path) -> None:
    root = made(tmp_path / "ks", "/a", "/b")
    kept = copy_of(root / "enclaves/a", tmp_path / "kept")
    revoke(root, ["/a"], now=NOW)
    copy_of(kept, root / "enclaves/a")
    revoke(root, ["/a"], now=NOW + DAY)
    (entry,) = crl_of(root).revoked
    assert entry.date == NOW
    assert list_enclaves(root) == ("/b",)


@pytest.mark.parametrize("there", ["copy", "another link", "dangling link"])
def test_a_list_that_would_grow_stale_becomes_a_link(there: str, tmp_path: Path) -> None:
    root = made(tmp_path / "ks", "/a", "/b", "/c")
    revoke(root, ["/a"], now=NOW)
    path = root / "enclaves/b/crl.pem"
    data = path.read_bytes()
    path.unlink()
    if there == "copy":
        path.write_bytes(data)
    else:
        (tmp_path / "elsewhere").write_bytes(data)
        path.symlink_to(tmp_path / ("elsewhere" if there == "another link" else "nowhere"))
    revoke(root, ["/c"], now=NOW)
    assert os.readlink(path) == "../../public/identity_ca.crl.pem"
    check = open_enclave(root / "enclaves/b", now=NOW)
    assert not check.problems


# ── how long it holds ──────────────────────────────────────────────────────────────────────


def test_the_list_ends_with_its_authority(tmp_path: Path) -> None:
    root = made(tmp_path / "ks", "/a", "/b", authority_validity=100 * DAY)
    done = revoke(root, ["/a"], now=NOW)
    end = validity_of(certificate(root / "public/identity_ca.cert.pem")).not_after
    assert done.next_update == crl_of(root).next_update == end


def test_an_ended_list_locks_everybody_out_until_it_is_refreshed(tmp_path: Path) -> None:
    root = made(tmp_path / "ks", "/a", "/b", revocation_validity=30 * DAY)
    revoke(root, ["/a"], now=NOW)
    folder = root / "enclaves/b"
    assert problems(folder, NOW + 30 * DAY) == []
    assert len(problems(folder, NOW + 31 * DAY)) == 1
    assert len(problems(folder, NOW - 2 * DAY)) > 1  # the list begins a day before
    refresh_crl(root, now=NOW + 31 * DAY)
    assert problems(folder, NOW + 31 * DAY) == []


def test_a_list_of_another_authority_is_seen(tmp_path: Path) -> None:
    """Also where that has the same name, as all of ros2/sros2 have."""
    both = {"one": ("/a", "/b"), "two": ("/b", "/a")}  # made apart, by CAs of their own
    roots = [made(tmp_path / name, *names, template="sros2") for name, names in both.items()]
    for root in roots:
        revoke(root, ["/a"], now=NOW)
    crls = [root / "public/identity_ca.crl.pem" for root in roots]
    shutil.copy(crls[1], crls[0])
    (problem,) = problems(roots[0] / "enclaves/b")
    assert "the identity CA did not sign it" in problem
    assert not problems(roots[1] / "enclaves/b")


@pytest.mark.parametrize("reason", ["removeFromCRL", "unspecified"])
def test_a_list_that_no_ca_signed_revokes_nobody_and_keeps_nobody(
    reason: str, tmp_path: Path
) -> None:
    """Whoever can write it, but not sign, decides neither who is revoked nor who is not."""
    root = made(tmp_path / "ks", "/a", "/b", "/c")
    revoke(root, ["/c"], now=NOW)
    victims = {name: root / f"enclaves{name}/cert.pem" for name in ("/a", "/b")}
    gone, kept = (certificate(path) for path in victims.values())
    copy = tmp_path / "a.pem"
    shutil.copy(victims["/a"], copy)
    earlier = crl_of(root)
    forged = forged_list(earlier, {gone.serial_number: reason, kept.serial_number: "unspecified"})
    (root / "public/identity_ca.crl.pem").write_bytes(forged)

    done = revoke(root, ["/a"], now=NOW)

    assert any("signed its current revocation list" in each.text for each in done.remarks)
    found = crl_of(root)
    assert {(each.serial, each.reason) for each in found.revoked} == {
        (earlier.revoked[0].serial, "unspecified"),
        (gone.serial_number, "unspecified"),
    }
    assert found.number > earlier.number
    assert not problems(root / "enclaves/b")
    with pytest.raises(AssertionError, match="revoked"):
        openssl(root, copy)
    openssl(root, victims["/b"])


def forged_list(like: RevocationList, reasons: dict[int, str]) -> bytes:
    """Return a list with the names and numbers of another one, signed with a key of nobody."""
    builder = (
        x509.CertificateRevocationListBuilder()
        .issuer_name(like.list.issuer)
        .last_update(like.this_update)
        .next_update(like.next_update)
        .add_extension(x509.CRLNumber(like.number + 1000), critical=False)
    )
    for number, reason in reasons.items():
        entry = x509.RevokedCertificateBuilder().serial_number(number)
        entry = entry.revocation_date(like.this_update)
        entry = entry.add_extension(x509.CRLReason(x509.ReasonFlags(reason)), critical=False)
        builder = builder.add_revoked_certificate(entry.build())
    key = ec.generate_private_key(ec.SECP256R1())
    return builder.sign(key, hashes.SHA256()).public_bytes(serialization.Encoding.PEM)


def openssl(root: Path, path: Path) -> None:
    """Have OpenSSL verify a certificate with the list of the keystore."""
    public = root / "public"
    command = ["openssl", "verify", "-crl_check", "-attime", str(int(NOW.timestamp()))]
    command += ["-CAfile", str(public / "identity_ca.cert.pem")]
    command += ["-CRLfile", str(public / "identity_ca.crl.pem"), str(path)]
    run(command)


def test_refresh_reaches_an_enclave_without_a_list(tmp_path: Path) -> None:
    root = made(tmp_path / "ks", "/a", "/b")
    assert refresh_crl(root, now=NOW).restart == (), "nothing is revoked yet"
    assert crl_of(root).revoked == ()
    (root / "enclaves/a/crl.pem").unlink()
    assert refresh_crl(root, now=NOW).restart == ("/a", "/b")
    assert (root / "enclaves/a/crl.pem").is_symlink()


def test_an_export_brings_the_list(tmp_path: Path) -> None:
    root = made(tmp_path / "ks", "/a", "/b")
    distribute(OpenedKeystore(root), ["/b"], tmp_path / "out", now=NOW)
    revoke(root, ["/a"], now=NOW)
    distribute(OpenedKeystore(root), ["/b"], tmp_path / "out", now=NOW, force=True)
    sent = tmp_path / "out/enclaves/b/crl.pem"
    assert sent.read_bytes() == (root / "public/identity_ca.crl.pem").read_bytes()
    assert not sent.is_symlink()


# ── what is refused ────────────────────────────────────────────────────────────────────────


def lose_key(root: Path) -> None:
    shutil.rmtree(root / "private")


def foreign_certificate(root: Path) -> None:
    other = made(root.with_name("other"), "/b")
    shutil.copy(other / "enclaves/b/cert.pem", root / "enclaves/b/cert.pem")


def damaged_list(root: Path) -> None:
    (root / "public/identity_ca.crl.pem").write_text("no list")


@pytest.mark.parametrize(
    ("spoil", "said"),
    [
        (lose_key, "the key of the identity CA is missing"),
        (foreign_certificate, "was not issued by the identity CA"),
        (damaged_list, "revocation list .* cannot be read"),
        (lambda root: (root / "enclaves/b/cert.pem").write_text("x"), "cannot be read"),
        (lambda root: shutil.rmtree(root / "enclaves/b"), "enclave /b does not exist"),
    ],
)
def test_what_cannot_be_revoked_changes_nothing(spoil: object, said: str, tmp_path: Path) -> None:
    root = made(tmp_path / "ks", "/a", "/b", "/c")
    assert callable(spoil)
    spoil(root)
    before = snapshot(root)
    with pytest.raises(SrosError, match=said):
        revoke(root, ["/a", "/b"], now=NOW)
    assert snapshot(root) == before


def test_no_reason(tmp_path: Path) -> None:
    root = made(tmp_path / "ks", "/a")
    with pytest.raises(UsageError, match="unknown reason 'boredom' for a revocation"):
        revoke(root, ["/a"], now=NOW, reason="boredom")
    with pytest.raises(KeystoreError, match="not a valid keystore"):
        revoke(tmp_path / "none", ["/a"], now=NOW)


# ── the program ────────────────────────────────────────────────────────────────────────────


def test_the_program(tmp_path: Path) -> None:
    root = tmp_path / "ks"
    sros("create_keystore", root, "--template", "production").ok()
    sros("create_enclave", root, "/a", "/b", "/c").ok()
    assert sros("crl", root).ok().err == "the keystore knows of no revocation\n"
    assert json.loads(sros("crl", root, "--json").ok().out)["number"] is None
    sros("distribute_key", root, "--all", tmp_path / "robot").ok()
    exported = sros("crl", tmp_path / "robot")
    assert exported.status == 2 and "is an export" in exported.err
    before = snapshot(root)
    plan = sros("revoke", root, "/a", "--dry-run").ok()
    assert snapshot(root) == before
    assert plan.out.startswith("would revoke enclave /a\nwould ")
    assert "enclaves/a/key.pem" in plan.out
    done = sros("revoke", root, "/a", "--reason", "key-compromise").ok()
    assert done.out == "revoked enclave /a\n"
    assert "restart the processes of 2 enclaves for the change to take effect: /b, /c" in done.err
    listed = sros("crl", root).ok().out
    assert listed.startswith("revocation list 1, until ")
    assert "keyCompromise" in listed
    sros("crl", root, "--refresh", "--dry-run").ok()
    found = json.loads(sros("crl", root, "--refresh", "--json").ok().out)
    assert (found["number"], found["expires_soon"], len(found["revoked"])) == (2, False, 1)
    assert sros("revoke", root, "/b", "--reason", "boredom").status == 2
    assert sros("revoke", root, "/a").ok().err == "/a was revoked before: nothing to do.\n"
    assert sros("revoke", root).status == 2
    list_file = (root / "public/identity_ca.crl.pem").resolve()
    earlier = list_file.read_bytes()
    done = sros("revoke", root, "/b").ok()
    later = list_file.read_bytes()
    list_file.write_bytes(earlier)
    refused = sros("revoke", root, "/b")
    assert refused.status == 2 and f"`sros crl {root} --refresh`" in refused.err, "no /b listed"
    list_file.write_bytes(later)
    assert "nothing to do" in sros("revoke", root, "/b").ok().err
    ledger = (root / LEDGER).read_bytes()
    (root / LEDGER).write_bytes(b"".join(ledger.splitlines(keepends=True)[-1:]))
    assert sros("revoke", root, "/b").status == 2, "the ledger lacks lines"
    (root / LEDGER).write_bytes(ledger)
    assert "restart the processes of 1 enclave for the change to take effect: /c" in done.err
    assert "\n  1 enclave\n" in sros("inspect", root).ok().out


def test_a_list_that_ends_soon_is_an_alarm(tmp_path: Path) -> None:
    root = tmp_path / "ks"
    choices = replace(load_template("production"), revocation_validity=20 * DAY)
    now = datetime.now(UTC) - 15 * DAY
    create_keystore(root, template=choices, now=now)
    create_enclaves(root, ["/a", "/b"], now=now)
    revoke(root, ["/a"], now=now)
    ended = sros("crl", root)
    assert ended.status == 1
    assert "--refresh" in ended.err
    assert json.loads(sros("crl", root, "--json").out)["expires_soon"] is True
    sros("crl", root, "--refresh").ok()
