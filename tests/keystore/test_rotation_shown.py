"""What `inspect`, its history and `crl` show of both CAs while one replaces the other."""

from __future__ import annotations

import json
from collections import Counter
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest
from cryptography import x509

from sros_tool.errors import KeystoreError
from sros_tool.keystore.describe import HistoryStatus, history
from sros_tool.keystore.lifecycle.create import create_enclaves, create_keystore
from sros_tool.keystore.lifecycle.revoke import revoke
from sros_tool.keystore.lifecycle.rotate import renew_identity_ca, rotate_ca
from sros_tool.keystore.lifecycle.rotation import RotationStage
from sros_tool.keystore.reader import OpenedKeystore
from sros_tool.keystore.template import load_template
from sros_tool.pki.certificates import (
    Issuer,
    common_name,
    common_name_of,
    digest,
    extension,
    issue_ca,
    other_issuer_text,
)
from sros_tool.pki.keys import generate_key
from sros_tool.validity import window
from sros_tool.wording import serial_text
from tests.support.harness import sros

NOW = datetime.now(UTC)
STAGES = (RotationStage.DISTRIBUTE, RotationStage.REISSUE, RotationStage.RETIRE)


@pytest.fixture(params=["production", "sros2"])
def root(request: pytest.FixtureRequest, tmp_path: Path) -> Path:
    create_keystore(tmp_path / "ks", template=load_template(request.param), now=NOW)
    create_enclaves(tmp_path / "ks", ["/a", "/b", "/c"], now=NOW)
    return tmp_path / "ks"


def standing(root: Path) -> dict[str, tuple[HistoryStatus, str]]:
    """By the digests of CAs and lists, what the history says of each, and where it lies."""
    found = history(OpenedKeystore(root), now=NOW)
    assert not found.unexplained
    return {
        item.entry.sha256: (item.status, item.path)
        for item in found.entries
        if item.entry.what in ("ca", "crl")
    }


def test_the_history_knows_both_cas_and_their_lists(root: Path) -> None:
    revoke(root, ["/c"], now=NOW)
    old = {
        file: OpenedKeystore(root).certificates_of(file)[0]
        for file in OpenedKeystore(root).authority_files
    }
    for stage in STAGES:
        rotate_ca(root, stage, now=NOW)
        for file, first in old.items():
            path = f"public/{file}.cert.pem"
            new = next(each for each in OpenedKeystore(root).certificates_of(file) if each != first)
            assert standing(root)[digest(new)] == (HistoryStatus.CURRENT, path)
            expected = (HistoryStatus.CURRENT, path)
            if stage is RotationStage.RETIRE:
                expected = (HistoryStatus.RETIRED, f"retired/{first.serial_number:x}.cert.pem")
            assert standing(root)[digest(first)] == expected
        lists = [
            each
            for each in history(OpenedKeystore(root), now=NOW).entries
            if each.entry.what == "crl"
        ]
        current = [each for each in lists if each.status is HistoryStatus.CURRENT]
        assert len(current) == (1 if stage is RotationStage.RETIRE else 2)
    gone = [
        each
        for each in history(OpenedKeystore(root), now=NOW).entries
        if each.entry.enclave == "/c"
    ]
    # Its permissions were put away with its certificate; the new CA's list names neither.
    assert Counter(each.status for each in gone) == {HistoryStatus.REVOKED: 3}


def test_the_old_and_the_new_ca_are_told_apart(root: Path) -> None:
    """A new permissions CA has the name of the old one, because Fast DDS compares names."""
    file = next(
        file
        for file, roles in OpenedKeystore(root).authority_files.items()
        if "permissions" in roles
    )
    (old,) = (digest(each)[:8] for each in OpenedKeystore(root).certificates_of(file))
    signed = root / "enclaves/a/permissions.p7s"
    for stage, issuing in zip(STAGES, (0, 1, 1), strict=True):
        rotate_ca(root, stage, now=NOW)
        new = next(
            mark
            for c in OpenedKeystore(root).certificates_of(file)
            if (mark := digest(c)[:8]) != old
        )
        both = (old, new)
        there = both if stage is not RotationStage.RETIRE else (new,)
        for words in (("inspect", root), ("rotate_ca", root, "--status")):
            text = sros(*words).ok().out
            assert all(f"(SHA-256 {mark})" in text for mark in there), (words, text)
        assert f"permissions CA CN={_name(root, file)} (SHA-256 {both[issuing]})" in (
            sros("inspect", root / "enclaves/a").ok().out
        )
        assert f"(SHA-256 {both[issuing]}), sha256" in sros("inspect", signed).ok().out
        if len(OpenedKeystore(root).authority_files) == 1:
            single = sros("check", root, "--strict").out
            assert f"(SHA-256 {both[issuing]}) is identity CA and permissions CA" in single
        told = json.loads(sros("inspect", signed, "--json").ok().out)
        assert told["signer_sha256"].startswith(both[issuing])
    history_text = sros("inspect", root, "--history").out
    assert f"(SHA-256 {old})" in history_text and f"(SHA-256 {new})" in history_text


def _name(root: Path, file: str) -> str:
    return common_name_of(OpenedKeystore(root).certificates_of(file)[0].subject)


@pytest.mark.parametrize("kept", ["cert.pem", "identity_ca.cert.pem"])
def test_a_certificate_of_the_other_ca_is_said_to_be_of_another_one(kept: str, root: Path) -> None:
    """With "issued by CN=x, not by CN=x" nobody knows what is wrong."""
    folder = root / "enclaves/a"
    old = (folder / kept).read_bytes()
    rotate_ca(root, finish=True, now=NOW)
    (folder / kept).unlink()
    (folder / kept).write_bytes(old)
    text = sros("inspect", folder).out
    same = "public/ca.cert.pem" in {
        f"public/{each}.cert.pem" for each in OpenedKeystore(root).authority_files
    }
    assert ("but by another CA named CN=" in text) is same, text
    if kept == "cert.pem":
        refused = sros("renew", root, "/a").err
        assert ("another CA named CN=" in refused) is same, refused


def test_two_cas_of_one_name_differ_by_their_key_identifiers() -> None:
    keys, name, moment = (
        [generate_key() for _ in range(2)],
        common_name("ca"),
        window(NOW, timedelta(days=1)),
    )
    one, other = (issue_ca(key, name, moment) for key in keys)
    issued = Issuer(one, keys[0]).issue(common_name("/a"), keys[1].public_key(), moment)
    text = other_issuer_text(issued, other)
    for authority in (one, other):
        identifier = extension(authority, x509.SubjectKeyIdentifier)
        assert identifier and identifier.digest.hex() in text
    assert "not the same key or serial number" in other_issuer_text(issued, one)  # a changed one
    assert other_issuer_text(other, issue_ca(keys[0], common_name("b"), moment)) == "CN=ca"


@pytest.mark.parametrize("target", [".", "..", "../..", "../private", "/", "gone.cert.pem"])
def test_a_ca_file_that_leads_to_no_file_of_its_folder_is_refused(target: str, root: Path) -> None:
    path = root / "public/identity_ca.cert.pem"
    path.unlink()
    path.symlink_to(target)
    with pytest.raises(KeystoreError, match=r"has no identity CA.*identity_ca\.cert\.pem"):
        _ = OpenedKeystore(root).authority_files


def test_a_stranger_in_the_file_of_a_ca_is_named(root: Path, tmp_path: Path) -> None:
    """Fast DDS would trust it: the first certificate of a file does not vouch for the next."""
    create_keystore(tmp_path / "other", template=load_template("production"), now=NOW)
    file = f"public/{next(iter(OpenedKeystore(root).authority_files))}.cert.pem"
    assert not history(OpenedKeystore(root), now=NOW).unexplained
    with (root / file).open("ab") as stream:
        stream.write((tmp_path / "other/public/identity_ca.cert.pem").read_bytes())
    assert history(OpenedKeystore(root), now=NOW).unexplained == (file,)
    assert f"NOT IN THE LEDGER  {file}" in sros("inspect", root, "--history").out


def test_a_ca_of_the_same_key_is_followed(tmp_path: Path) -> None:
    root = tmp_path / "ks"
    create_keystore(root, template=load_template("production"), now=NOW)
    create_enclaves(root, ["/a"], now=NOW)
    old = OpenedKeystore(root).certificates_of("identity_ca")[0]
    renew_identity_ca(root, now=NOW)
    assert standing(root)[digest(old)][0] is HistoryStatus.RETIRED


def test_inspect_shows_all_that_a_ca_file_holds(root: Path) -> None:
    revoke(root, ["/c"], now=NOW)
    rotate_ca(root, now=NOW)
    file = next(iter(OpenedKeystore(root).authority_files))
    old, new = OpenedKeystore(root).certificates_of(file)
    path = root / f"public/{file}.cert.pem"
    said = sros("inspect", path).ok().out
    for each in (old, new):
        assert f"serial {serial_text(each.serial_number)}\n" in said
        assert digest(each) in said
    assert said.count("another certificate in the same file") == 1
    assert "revocation list 2 of " in said
    described = json.loads(sros("inspect", path, "--json").ok().out)
    assert described["sha256"] == digest(old)
    assert [each["sha256"] for each in described["further"]] == [digest(new)]
    assert described["crl"]["revoked"] == []
    whole = sros("inspect", root).ok().out
    assert f"serial {serial_text(new.serial_number)}" in whole
    assert "revocation list 2 of " in whole
    authorities = json.loads(sros("inspect", root, "--json").ok().out)["authorities"]
    assert authorities["identity"]["further"][0]["sha256"] == digest(new)


def test_inspect_shows_a_revocation_list(root: Path) -> None:
    serial = root / "enclaves/c/cert.pem"
    told = json.loads(sros("inspect", serial, "--json").ok().out)["serial"]
    revoke(root, ["/c"], now=NOW)
    path = root / "public/identity_ca.crl.pem"
    said = sros("inspect", path).ok().out
    assert said.startswith("revocation list 1 of CN=")
    assert said.endswith(f"1 revoked\n  {serial_text(int(told, 16))}\n")
    assert json.loads(sros("inspect", path, "--json").ok().out)["revoked"] == [told]


def test_crl_shows_the_list_beside(root: Path) -> None:
    revoke(root, ["/c"], now=NOW)
    assert "next to it" not in sros("crl", root).ok().out
    rotate_ca(root, now=NOW)
    assert "next to it, list 2 of the other CA, CN=" in sros("crl", root).ok().out
    (other,) = json.loads(sros("crl", root, "--json").ok().out)["other_lists"]
    assert (other["number"], other["revoked"]) == (2, [])
    for _ in range(2):
        rotate_ca(root, now=NOW)
    assert json.loads(sros("crl", root, "--json").ok().out)["other_lists"] == []
