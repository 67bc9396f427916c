"""Subjects are printed as OpenSSL prints them, which is what vendors compare."""

from __future__ import annotations

import subprocess
from pathlib import Path

import pytest
from cryptography import x509
from cryptography.x509.oid import NameOID

from sros_tool.pki.certificates import issue_ca, parse_subject, pem, subject_text
from sros_tool.pki.keys import generate_key
from sros_tool.validity import Window, parse_iso

WINDOW = Window(parse_iso("2020-01-01T00:00:00Z"), parse_iso("2040-01-01T00:00:00Z"))
KNOWN = [
    oid
    for name, oid in vars(NameOID).items()
    if name.isupper() and "COUNTRY" not in name and name != "UNSIGNED"
]


def attribute(oid: x509.ObjectIdentifier, text: str) -> x509.NameAttribute[str]:
    return x509.NameAttribute(oid, text)


def common_names(*texts: str) -> list[x509.Name]:
    return [x509.Name([attribute(NameOID.COMMON_NAME, text)]) for text in texts]


@pytest.mark.parametrize(
    "name",
    [
        *common_names(' #a+b;<>"\\, ', "#x\n\ty", " ", "größe =x", "/robot/arm"),
        x509.Name([attribute(oid, "a,b") for oid in KNOWN]),
        x509.Name([attribute(NameOID.COUNTRY_NAME, "DE"), attribute(NameOID.COMMON_NAME, "/t")]),
        x509.Name(
            [
                x509.RelativeDistinguishedName(
                    [
                        attribute(NameOID.ORGANIZATION_NAME, "x"),
                        attribute(NameOID.ORGANIZATIONAL_UNIT_NAME, "y"),
                    ]
                ),
                x509.RelativeDistinguishedName([attribute(NameOID.COMMON_NAME, "/t")]),
            ]
        ),
        x509.Name([attribute(x509.ObjectIdentifier("1.2.3.4"), "x")]),
    ],
    ids=str,
)
def test_as_openssl_prints_it(name: x509.Name, tmp_path: Path) -> None:
    certificate = issue_ca(generate_key(), name, WINDOW)
    (tmp_path / "cert.pem").write_bytes(pem(certificate))
    command = ["openssl", "x509", "-in", "cert.pem", "-noout", "-subject", "-nameopt"]
    printed = subprocess.run(
        [*command, "RFC2253,-esc_msb"], cwd=tmp_path, check=True, capture_output=True, text=True
    ).stdout
    text = subject_text(certificate.subject)
    assert text == printed.removeprefix("subject=").removesuffix("\n")
    if "#" not in text:
        assert parse_subject(text) == certificate.subject
