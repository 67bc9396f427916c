"""Subjects are printed as OpenSSL prints them, which is what vendors compare."""

from __future__ import annotations

import subprocess
import warnings
from pathlib import Path

import pytest
from cryptography import x509
from cryptography.x509.name import _ASN1Type
from cryptography.x509.oid import NameOID

from sros_tool.errors import PkiError
from sros_tool.pki.certificates import issue_ca, load_certificate, parse_subject, pem, subject_text
from sros_tool.pki.distinguished_names import short_names
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


OBJECTS = [
    x509.ObjectIdentifier(oid)
    for oid in short_names()
    if oid.count(".") > 1 and not oid.startswith(("2.5.4.6", "1.3.6.1.4.1.311.60.2.1.3"))
]
"""All that OpenSSL has names for, but for those that `cryptography` takes for countries."""
TEXTS = (
    "",
    "a",
    "#",
    " ",
    "  ",
    " a ",
    "#a#",
    "a\\b",
    'q"q',
    "a=b+c<d>e;f,g",
    "\0",
    "\x7f\n",
    "/|",
)
WIDE = ("größe", "日本", "\x80ÿ")


def of_all_types() -> list[tuple[_ASN1Type, x509.Name]]:
    """Names of many texts, for each type that a text of a name can have."""
    wide = (_ASN1Type.UTF8String, _ASN1Type.BMPString, _ASN1Type.UniversalString)
    narrow = (_ASN1Type.PrintableString, _ASN1Type.IA5String, _ASN1Type.NumericString)
    made = []
    for kind in (*wide, *narrow, _ASN1Type.T61String):
        texts: tuple[str, ...] = ("a b", "", "0", " 1 ") if kind in narrow else TEXTS
        texts += WIDE if kind in wide else ("größe",) if kind is _ASN1Type.T61String else ()
        with warnings.catch_warnings(action="ignore"):  # of the empty text
            values = [
                x509.NameAttribute(NameOID.COMMON_NAME, text, kind, _validate=False)
                for text in texts
            ]
        made.append((kind, x509.Name(values)))
    return made


@pytest.mark.filterwarnings("ignore:Attribute's length")
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
        pytest.param(x509.Name([attribute(oid, "a,b") for oid in OBJECTS]), id="every object"),
        *(pytest.param(name, id=f"texts of type {kind.name}") for kind, name in of_all_types()),
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
    if "#" not in text and len(certificate.subject.rdns) < 3:
        assert parse_subject(text) == certificate.subject


@pytest.mark.filterwarnings("ignore:Attribute's length")
@pytest.mark.parametrize(
    ("kind", "oid", "value"),
    [
        (_ASN1Type.BitString, NameOID.X500_UNIQUE_IDENTIFIER, b"\0abc"),
        (_ASN1Type.BMPString, NameOID.COMMON_NAME, "\U0001f600"),  # in UTF-16
        (_ASN1Type.OctetString, NameOID.COMMON_NAME, "a"),
        (_ASN1Type.VisibleString, NameOID.COMMON_NAME, "a"),
        (_ASN1Type.UTCTime, NameOID.COMMON_NAME, "200101000000Z"),
        (_ASN1Type.UTF8String, NameOID.COMMON_NAME, ""),
    ],
    ids=lambda each: getattr(each, "name", ""),
)
def test_a_name_is_read_where_openssl_reads_it(
    kind: _ASN1Type, oid: x509.ObjectIdentifier, value: str | bytes, tmp_path: Path
) -> None:
    name = x509.Name([x509.NameAttribute(oid, value, kind, _validate=False)])
    data = pem(issue_ca(generate_key(), name, WINDOW))
    command = ["openssl", "x509", "-noout", "-subject", "-nameopt", "RFC2253"]
    openssl = subprocess.run(command, input=data, capture_output=True, check=False)
    if openssl.returncode:
        with pytest.raises(PkiError):
            load_certificate(data, "it")
    else:
        text = subject_text(load_certificate(data, "it").subject)
        assert f"subject={text}\n".encode() == openssl.stdout
