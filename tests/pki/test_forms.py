"""Certificates have one form where they differ in name, key, serial number and dates alone."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta

import pytest
from cryptography import x509
from cryptography.hazmat.primitives import hashes
from cryptography.hazmat.primitives.asymmetric import ec

from sros_tool.pki.certificates import CertificateForm, common_name, is_valid_at, pem, read_form

NOW = datetime(2026, 3, 1, tzinfo=UTC)
LATER = NOW + timedelta(days=30)
AUTHORITY_KEY = ec.generate_private_key(ec.SECP256R1())


def certificate(
    name: str = "/talker",
    *,
    curve: ec.EllipticCurve | None = None,
    serial: int = 1000,
    end: datetime = LATER,
    issuer: str = "CA",
    digest: hashes.SHA256 | hashes.SHA384 | None = None,
    ca: bool = False,
) -> bytes:
    """Return a certificate file."""
    key = ec.generate_private_key(curve or ec.SECP256R1())
    return pem(
        x509.CertificateBuilder()
        .subject_name(common_name(name))
        .issuer_name(common_name(issuer))
        .public_key(key.public_key())
        .serial_number(serial)
        .not_valid_before(NOW)
        .not_valid_after(end)
        .add_extension(x509.BasicConstraints(ca=ca, path_length=None), critical=True)
        .sign(AUTHORITY_KEY, digest or hashes.SHA256())
    )


def form(data: bytes) -> CertificateForm:
    """Return the form of a certificate file that has one."""
    read = read_form(data)
    assert read is not None
    return read


@pytest.mark.parametrize(
    "other",
    [
        certificate(),
        certificate("/robot/listener"),
        certificate(serial=2000),
        certificate(end=LATER + timedelta(days=1)),
    ],
    ids=["key", "name", "serial", "dates"],
)
def test_own_parts_leave_the_form_equal(other: bytes) -> None:
    assert form(other).common == form(certificate()).common


@pytest.mark.parametrize(
    "other",
    [
        certificate(curve=ec.SECP384R1()),
        certificate("/tälker"),
        certificate(issuer="other CA"),
        certificate(digest=hashes.SHA384()),
        certificate(ca=True),
        certificate() + certificate(),
        b"-----BEGIN X509 CRL-----\nMAA=\n-----END X509 CRL-----\n" + certificate(),
    ],
    ids=["curve", "character", "issuer", "digest", "CA", "two", "list before"],
)
def test_what_vendors_judge_makes_another_form(other: bytes) -> None:
    assert form(other).common != form(certificate()).common


def test_serial_and_dates_are_those_of_the_certificate() -> None:
    read = form(certificate(serial=77))
    assert read.serial == 77
    assert is_valid_at(read, NOW)
    assert is_valid_at(read, LATER)
    assert is_valid_at(read, NOW - timedelta(seconds=1)) is False
    assert is_valid_at(read, LATER + timedelta(seconds=1)) is False


def test_dates_after_2049_are_read() -> None:
    read = form(certificate(end=datetime(2060, 1, 1, tzinfo=UTC)))
    assert is_valid_at(read, datetime(2059, 12, 31, tzinfo=UTC))
    assert is_valid_at(read, datetime(2060, 1, 2, tzinfo=UTC)) is False


def test_dates_that_cannot_be_read_are_unknown() -> None:
    assert is_valid_at(form(certificate())._replace(validity=b"\x17\x01x\x17\x01x"), NOW) is None


@pytest.mark.parametrize(
    "data",
    [b"", b"text", b"-----BEGIN CERTIFICATE-----\nMAA=\n-----END CERTIFICATE-----\n"],
    ids=["empty", "text", "empty sequence"],
)
def test_unusual_files_have_no_form(data: bytes) -> None:
    assert read_form(data) is None


def test_two_digits_of_a_year_from_50_are_of_the_last_century() -> None:
    period = b"\x17\x0d500101000000Z\x17\x0d490101000000Z"  # 1950 to 2049 (RFC 5280, 4.1.2.5.1)
    assert is_valid_at(form(certificate())._replace(validity=period), NOW)
