"""Revocation lists with odd content: what is said of them is what OpenSSL does with them."""

from __future__ import annotations

import subprocess
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest
from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import NameOID

from sros_tool.errors import PkiError
from sros_tool.pki.certificates import Issuer, authority_identifier, common_name, issue_ca, pem
from sros_tool.pki.crl import (
    RevocationEntry,
    lists_as_revoked,
    load_crl,
    read_list,
    refusal_of,
    sign_crl,
)
from sros_tool.pki.keys import PrivateKey, generate_key
from sros_tool.validity import Window
from tests.integration.forged_signatures import Node
from tests.support import raw_pki
from tests.support.children import run
from tests.support.openssl import takes_changes_for_lists

NOW = datetime.now(UTC).replace(microsecond=0)
DAY = timedelta(days=1)
OWN, OTHER = 7, 8
USABLE, REVOKED, REFUSED = "usable", "revoked", "refused"
Extensions = tuple[tuple[x509.ExtensionType, bool], ...]

UNKNOWN = x509.UnrecognizedExtension(x509.ObjectIdentifier("1.2.3.4.5"), b"\x05\x00")
SOMEBODY = x509.CertificateIssuer(
    [x509.DirectoryName(x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, "x")]))]
)


def scope(
    *,
    name: str = "",
    users: bool = False,
    cas: bool = False,
    reasons: frozenset[x509.ReasonFlags] | None = None,
    indirect: bool = False,
    attributes: bool = False,
) -> x509.IssuingDistributionPoint:
    names = [x509.UniformResourceIdentifier(name)] if name else None
    return x509.IssuingDistributionPoint(names, None, users, cas, reasons, indirect, attributes)


def because(reason: str, critical: bool = False) -> Extensions:
    return ((x509.CRLReason(x509.ReasonFlags(reason)), critical),)


CASES: dict[str, tuple[str, Extensions, dict[int, Extensions]]] = {
    "nothing": (USABLE, (), {}),
    "another certificate": (USABLE, (), {OTHER: ()}),
    "the certificate": (REVOKED, (), {OWN: ()}),
    "on hold": (REVOKED, (), {OWN: because("certificateHold")}),
    "removed from the list": (USABLE, (), {OWN: because("removeFromCRL")}),
    "a critical reason": (REFUSED, (), {OTHER: because("unspecified", critical=True)}),
    "an unknown extension": (USABLE, ((UNKNOWN, False),), {}),
    "an unknown critical extension": (REFUSED, ((UNKNOWN, True),), {}),
    "one of an entry": (REFUSED, (), {OTHER: ((UNKNOWN, True),)}),
    "of another issuer": (USABLE, (), {OTHER: ((SOMEBODY, True),)}),
    "changes": (REFUSED, ((x509.DeltaCRLIndicator(3), True),), {}),
    "changes, not critical": (REFUSED, ((x509.DeltaCRLIndicator(3), False),), {}),
    "of users": (USABLE, ((scope(users=True), True),), {}),
    "of CAs": (REFUSED, ((scope(cas=True), True),), {}),
    "of attributes": (REFUSED, ((scope(attributes=True), True),), {}),
    "of some reasons": (
        REFUSED,
        ((scope(reasons=frozenset({x509.ReasonFlags.key_compromise})), True),),
        {},
    ),
    "indirect": (REFUSED, ((scope(indirect=True), True),), {}),
    "of a place": (REFUSED, ((scope(name="http://x/"), True),), {}),
}


def authority() -> tuple[x509.Certificate, PrivateKey, Window]:
    """A CA with its key, and its validity."""
    key, window = generate_key(), Window(NOW - DAY, NOW + DAY)
    return issue_ca(key, common_name("CA"), window), key, window


def list_of(ca: x509.Certificate) -> x509.CertificateRevocationListBuilder:
    return x509.CertificateRevocationListBuilder(ca.subject, NOW - DAY, NOW + DAY).add_extension(
        authority_identifier(ca), critical=False
    )


def verified(
    folder: Path, ca: bytes, crl: bytes, certificate: bytes
) -> subprocess.CompletedProcess[str]:
    """What openssl says of a certificate and a list."""
    for name, data in (("ca", ca), ("crl", crl), ("certificate", certificate)):
        (folder / name).write_bytes(data)
    command = ["openssl", "verify", "-crl_check", "-CAfile", "ca", "-CRLfile", "crl", "certificate"]
    return run(command, cwd=folder, status=None)


@pytest.mark.parametrize("case", CASES)
def test_what_is_said_of_a_list_is_what_openssl_does(case: str, tmp_path: Path) -> None:
    expected, extensions, entries = CASES[case]
    ca, key, window = authority()
    certificate = Issuer(ca, key).issue(common_name("/a"), generate_key().public_key(), window)
    builder = list_of(ca)
    for extension, critical in extensions:
        builder = builder.add_extension(extension, critical=critical)
    for number, more in entries.items():
        entry = x509.RevokedCertificateBuilder().revocation_date(NOW - DAY)
        entry = entry.serial_number(certificate.serial_number if number == OWN else number)
        for extension, critical in more:
            entry = entry.add_extension(extension, critical=critical)
        builder = builder.add_revoked_certificate(entry.build())
    document = builder.sign(key, hashes.SHA256()).public_bytes(serialization.Encoding.PEM)

    done = verified(tmp_path, pem(ca), document, pem(certificate))
    revoked = "certificate revoked" in done.stderr
    observed = USABLE if not done.returncode else REVOKED if revoked else REFUSED
    assert observed == expected or (case.startswith("changes") and takes_changes_for_lists())

    parsed = load_crl(document, "")
    listed = lists_as_revoked(parsed.list, certificate.serial_number)
    assert (REFUSED if refusal_of(parsed.list) else REVOKED if listed else USABLE) == expected
    assert parsed.revokes(certificate.serial_number) is listed


@pytest.mark.filterwarnings("ignore")  # of cryptography, for the serial number
@pytest.mark.parametrize("listed", [False, True])
def test_a_certificate_with_a_negative_serial_number(listed: bool, tmp_path: Path) -> None:
    ca, key, window = authority()
    issued = Issuer(ca, key).issue(common_name("/a"), generate_key().public_key(), window)
    (changed,) = Node.read(issued.public_bytes(serialization.Encoding.DER))
    changed.children[0].children[1].content = b"\xfb"  # -5
    certificate = x509.load_der_x509_certificate(signed_again(changed, key))
    entry = x509.RevokedCertificateBuilder().revocation_date(NOW - DAY).serial_number(OWN)
    built = (
        list_of(ca)
        .add_extension(x509.CRLNumber(1), critical=False)
        .add_revoked_certificate(entry.build())
        .sign(key, hashes.SHA256())
    )
    (changed,) = Node.read(built.public_bytes(serialization.Encoding.DER))
    if listed:
        entries = next(each for each in changed.children[0].children[::-1] if each.tag == 0x30)
        entries.children[0].children[0].content = b"\xfb"
    data = raw_pki.pem("X509 CRL", signed_again(changed, key))
    crl = read_list(data, "")
    done = verified(tmp_path, pem(ca), data, pem(certificate))
    assert ("certificate revoked" in done.stderr) is listed
    assert lists_as_revoked(crl, certificate.serial_number) is listed


@pytest.mark.parametrize("serial", [-1, 0, 1 << 159, (1 << 175) + 1])
def test_a_serial_number_that_no_list_holds_is_refused(serial: int) -> None:
    ca, key, _ = authority()
    times = {"this_update": NOW - DAY, "next_update": NOW + DAY}
    assert load_crl(
        sign_crl(ca, key, [RevocationEntry((1 << 159) - 1, NOW)], number=1, **times), ""
    )
    with pytest.raises(PkiError, match=f"the serial number {serial:x} cannot be put"):
        sign_crl(ca, key, [RevocationEntry(serial, NOW)], number=1, **times)


def test_a_list_whose_serial_numbers_are_no_numbers_is_refused(tmp_path: Path) -> None:
    ca, key, _ = authority()
    times = {"this_update": NOW - DAY, "next_update": NOW + DAY}
    made = load_crl(sign_crl(ca, key, [RevocationEntry(5, NOW)], number=1, **times), "").list
    (changed,) = Node.read(made.public_bytes(serialization.Encoding.DER))
    entries = next(each for each in changed.children[0].children[::-1] if each.tag == 0x30)
    entries.children[0].children[0].tag = 0x0A  # ENUMERATED
    data = raw_pki.pem("X509 CRL", signed_again(changed, key))
    (tmp_path / "crl").write_bytes(data)
    assert run(["openssl", "crl", "-in", "crl", "-noout"], cwd=tmp_path, status=None).returncode
    with pytest.raises(PkiError):
        load_crl(data, "")


def signed_again(changed: Node, key: PrivateKey) -> bytes:
    assert isinstance(key, ec.EllipticCurvePrivateKey)
    signature = key.sign(changed.children[0].write(), ec.ECDSA(hashes.SHA256()))
    changed.children[2].content = b"\0" + signature
    return changed.write()


def test_a_list_that_expired_before_it_begins_expires_soon_from_its_end() -> None:
    key = ec.generate_private_key(ec.SECP256R1())
    ca = issue_ca(key, common_name("CA"), Window(NOW, NOW + DAY))
    made = sign_crl(ca, key, (), number=1, this_update=NOW, next_update=NOW + DAY)
    crl = load_crl(made, "list")._replace(next_update=NOW - 90 * DAY)
    assert crl.expires_soon_from() == crl.next_update
