"""OpenSSL agrees with what renewing and revoking make of a keystore."""

from __future__ import annotations

import re
import subprocess
from pathlib import Path

import pytest

from tests.support.harness import sros
from tests.support.long_form import some


def openssl(*words: object, accept: bool = True) -> str:
    """Run openssl; everything that it printed."""
    ended = subprocess.run(["openssl", *map(str, words)], capture_output=True, text=True)
    assert (ended.returncode == 0) is accept, (words, ended.stderr)
    return ended.stdout + ended.stderr


def verify(root: Path, certificate: Path, *, accept: bool = True, crl: bool = False) -> str:
    words: list[object] = [
        "verify",
        "-x509_strict",
        "-CAfile",
        root / "public/identity_ca.cert.pem",
    ]
    if crl:
        words += ["-crl_check", "-CRLfile", root / "public/identity_ca.crl.pem"]
    return openssl(*words, certificate, accept=accept)


def verify_signatures(root: Path, enclave: Path) -> None:
    authority = root / "public/permissions_ca.cert.pem"
    for name in ("permissions", "governance"):
        message = enclave / f"{name}.p7s"
        said = openssl("smime", "-verify", "-text", "-in", message, "-CAfile", authority)
        assert "Verification successful" in said


@pytest.fixture(params=some(["development", "production", "sros2"], 1))
def root(request: pytest.FixtureRequest, tmp_path: Path) -> Path:
    keystore = tmp_path / "ks"
    sros("create_keystore", keystore, "--template", request.param).ok()
    sros("create_enclave", keystore, "/a", "/b", "/c", "/d", "/").ok()
    return keystore


@pytest.mark.parametrize("options", [[], ["--new-key"]])
def test_what_is_renewed_verifies(options: list[str], root: Path) -> None:
    enclaves = root / "enclaves"
    old = (enclaves / "a/cert.pem").read_bytes()
    sros("renew", root, "/a", "/", *options).ok()
    assert (enclaves / "a/cert.pem").read_bytes() != old
    for folder in (enclaves, enclaves / "a", enclaves / "b"):
        verify(root, folder / "cert.pem")
        verify_signatures(root, folder)
        public = openssl("x509", "-in", folder / "cert.pem", "-noout", "-pubkey")
        assert openssl("pkey", "-in", folder / "key.pem", "-pubout") == public


def test_the_list_refuses_whom_it_names_and_nobody_else(root: Path, tmp_path: Path) -> None:
    enclaves = root / "enclaves"
    copies = {}
    for name in ("a", "b", "c"):
        copies[name] = tmp_path / f"{name}.pem"
        copies[name].write_bytes((enclaves / name / "cert.pem").read_bytes())
    sros("renew", root, "/a").ok()
    copies["a again"] = tmp_path / "a2.pem"
    copies["a again"].write_bytes((enclaves / "a/cert.pem").read_bytes())
    revoked: list[str] = []
    for enclave, names, reason in (
        ("/a", ["a", "a again"], "key_compromise"),
        ("/b", ["b"], "cessation_of_operation"),
        (None, [], ""),
        ("/c", ["c"], "unspecified"),
        (None, [], ""),
    ):
        for name in names:
            verify(root, copies[name])  # without the list, all is well with it
        if enclave:
            sros("revoke", root, enclave, "--reason", reason).ok()
        else:
            sros("crl", root, "--refresh").ok()
        revoked += names
        for name, path in copies.items():
            said = verify(root, path, crl=True, accept=name not in revoked)
            assert ("certificate revoked" in said) is (name in revoked)
        verify(root, enclaves / "d/cert.pem", crl=True)
    sros("create_enclave", root, "/a").ok()
    verify(root, enclaves / "a/cert.pem", crl=True)
    verify(root, copies["a"], crl=True, accept=False)
    verify_signatures(root, enclaves / "a")


def test_the_text_of_the_list(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    enclaves = root / "enclaves"
    monkeypatch.setattr("cryptography.x509.random_serial_number", lambda: 0xABC)
    sros("create_enclave", root, "/e").ok()
    serials = [
        openssl("x509", "-in", enclaves / name / "cert.pem", "-noout", "-serial")
        .strip()
        .removeprefix("serial=")
        for name in ("e", "b")
    ]
    certificate = root.parent / "e.pem"
    certificate.write_bytes((enclaves / "e/cert.pem").read_bytes())
    sros("revoke", root, "/e", "--reason", "keyCompromise").ok()
    sros("revoke", root, "/b").ok()
    sros("crl", root, "--refresh").ok()
    crl = root / "public/identity_ca.crl.pem"
    authority = root / "public/identity_ca.cert.pem"
    said = openssl("crl", "-in", crl, "-noout", "-text", "-CAfile", authority)
    assert "verify OK" in said
    assert "Version 2" in said
    assert "Signature Algorithm: ecdsa-with-SHA256" in said
    assert re.search(r"X509v3 CRL Number: *\n *3\n", said)
    identifier = re.search(r"X509v3 Authority Key Identifier: *\n *(?:keyid:)?([0-9A-F:]+)", said)
    assert identifier
    assert identifier[1] in openssl("x509", "-in", authority, "-noout", "-text")
    listed = re.findall(r"Serial Number: ([0-9A-F]+)", said)
    assert listed == serials and serials[0] == "0ABC"
    for words in (
        ("crl", root), ("inspect", root, "--history"),
        ("inspect", crl), ("inspect", certificate),
    ):  # fmt: skip
        assert re.search(r"(^|\s)0abc(\s|\Z)", sros(*words).out), words
    assert said.count("Key Compromise") == 1
    assert said.count("X509v3 CRL Reason Code") == 1  # unspecified is left out (RFC 5280, 5.3.1)


def test_a_list_of_another_keystore_is_refused(root: Path, tmp_path: Path) -> None:
    other = tmp_path / "other"
    sros("create_keystore", other).ok()
    sros("create_enclave", other, "/a").ok()
    sros("revoke", other, "/a").ok()
    sros("revoke", root, "/a").ok()
    verify(root, root / "enclaves/b/cert.pem", crl=True)
    words = ("crl", "-noout", "-CAfile", root / "public/identity_ca.cert.pem", "-in")
    assert "verify OK" in openssl(*words, root / "public/identity_ca.crl.pem")
    refused = subprocess.run(
        ["openssl", *map(str, words), str(other / "public/identity_ca.crl.pem")],
        capture_output=True,
        text=True,
    )
    assert "verify OK" not in refused.stdout + refused.stderr
