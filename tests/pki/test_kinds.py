"""A file is recognized for what it is, as OpenSSL writes it in each of its forms."""

from __future__ import annotations

import subprocess
from pathlib import Path

import pytest

from sros_tool.errors import PkiError
from sros_tool.pki import smime
from sros_tool.pki.certificates import load_certificate
from sros_tool.pki.crl import read_list
from sros_tool.pki.keys import load_key
from sros_tool.pki.pem import kind_of
from tests.support.long_form import some

_MADE = {
    "certificate in DER": "x509 -in ca.pem -outform DER",
    "TRUSTED CERTIFICATE": "x509 -in ca.pem -trustout -addreject emailProtection",
    "signing request, not": "req -new -key key.pem -subj /CN=x",
    "signing request in DER": "req -new -key key.pem -subj /CN=x -outform DER",
    "a private key": "pkey -in key.pem",
    "private key in DER": "pkey -in key.pem -outform DER",
    "private key in DER ": "ec -in key.pem -outform DER",
    "encrypted private key in DER": "pkcs8 -topk8 -in key.pem -passout pass:x -outform DER",
    "a public key": "pkey -in key.pem -pubout",
    "public key in DER": "pkey -in key.pem -pubout -outform DER",
    "PKCS#7 in PEM": "crl2pkcs7 -nocrl -certfile ca.pem",
    "PKCS#7 in DER": "crl2pkcs7 -nocrl -certfile ca.pem -outform DER",
    "PKCS#12": "pkcs12 -export -in ca.pem -inkey key.pem -passout pass:x",
    "PKCS#7 in PEM ": "smime -sign -text -in text -signer ca.pem -inkey key.pem -outform PEM",
    "PKCS#7 in DER ": "smime -sign -text -in text -signer ca.pem -inkey key.pem -outform DER",
    "CMS in PEM": "cms -sign -in text -signer ca.pem -inkey key.pem -outform PEM",
    "encrypted, not signed": "smime -encrypt -aes256 -in text rsa.pem",
    "encrypted, not signed ": "smime -encrypt -aes256 -in text -outform DER rsa.pem",
    "S/MIME signed message": "smime -sign -text -in text -signer ca.pem -inkey key.pem",
    "S/MIME signed message ": "smime -sign -nodetach -in text -signer ca.pem -inkey key.pem",
    "parameters of a key": "ecparam -name prime256v1",
}
"""What each command of OpenSSL writes."""


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    where = tmp_path_factory.mktemp("kinds")
    (where / "text").write_text("<dds/>\n")
    new = "req -x509 -nodes -subj /CN=CA -days 1 -newkey"
    _openssl(where, f"{new} ec -pkeyopt ec_paramgen_curve:P-256 -keyout key.pem -out ca.pem")
    _openssl(where, f"{new} rsa:2048 -keyout rsa.key -out rsa.pem")
    return where


def _openssl(folder: Path, words: str) -> bytes:
    command = ["openssl", *words.split()]
    return subprocess.run(command, cwd=folder, check=True, capture_output=True).stdout


@pytest.mark.parametrize("kind", some([*_MADE], 8))
def test_what_openssl_writes_is_recognized(folder: Path, kind: str) -> None:
    assert kind.strip() in kind_of(_openssl(folder, _MADE[kind]))


@pytest.mark.parametrize(
    ("data", "kind"),
    [
        (b"<dds/>", "XML that is not signed"),
        ("<dds/>".encode("utf-16"), "UTF-16"),
        ("<dds/>".encode("utf-16-le"), "UTF-16"),
        (b"\nMIME-Version: 1.0\n", "an empty line before its headers"),
        (b"MIME-Version: 1.0\nContent-Type: text/plain\n\nx", "a MIME message that is not signed"),
        (b"-----BEGIN OPENSSH PRIVATE KEY-----\n", "OpenSSH"),
        (b"-----BEGIN RSA PRIVATE KEY-----\n", "a private key"),
        (b"-----BEGIN PGP MESSAGE-----\n", "of the kind PGP MESSAGE"),
        (b"TUlJQ" * 20, "base64 without"),
        (b"PK\x03\x04", "ZIP"),
        (b"\x1f\x8b\x08", "gzip"),
        (b" \n", "blanks"),
        (b"", "empty"),
        (b"call Bob", ""),
        (b"0\x80", ""),
        (b"0\x03\x02\x01", ""),
    ],
)
def test_other_files_are_recognized_by_how_they_begin(data: bytes, kind: str) -> None:
    assert kind in kind_of(data)
    assert bool(kind) == bool(kind_of(data))


def test_every_reader_says_what_a_file_is_in_place_of_its_own(folder: Path) -> None:
    request = _openssl(folder, _MADE["signing request, not"])
    public = _openssl(folder, _MADE["a public key"])
    certificate = _openssl(folder, _MADE["certificate in DER"])
    signature = _openssl(folder, _MADE["PKCS#7 in PEM "])
    encrypted = _openssl(folder, _MADE["encrypted, not signed"])
    for read, data, kind in (
        (lambda data: load_certificate(data, "x"), request, "a signing request"),
        (lambda data: load_key(data, "x"), public, "a public key"),
        (lambda data: read_list(data, "x"), certificate, "a certificate in DER"),
        (smime.parse, signature, "PKCS#7 in PEM"),
        (smime.parse, encrypted, "encrypted, not signed"),
    ):
        with pytest.raises(PkiError) as caught:
            read(data)
        assert kind in str(caught.value)
