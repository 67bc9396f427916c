"""Certificate revocation lists (CRLs) of an identity CA (RFC 5280, section 5)."""

from __future__ import annotations

from collections.abc import Iterable
from contextlib import AbstractContextManager
from dataclasses import dataclass
from datetime import datetime

from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.x509.oid import CRLEntryExtensionOID, ExtensionOID

from sros_tool.errors import PkiError
from sros_tool.pki import der, pem, tolerant
from sros_tool.pki.certificates import (
    authority_identifier,
    extension,
    is_signed,
    subject_text,
)
from sros_tool.pki.keys import PrivateKey
from sros_tool.pki.kinds import kind_of
from sros_tool.pki.names import same_name
from sros_tool.pki.reading import is_of_reading, read_name, reading

CRL_MARK = b"-----BEGIN X509 CRL-----"
"""The first line of a PEM revocation list."""
_LABEL = "X509 CRL"
REASONS = tuple(
    flag.value
    for flag in x509.ReasonFlags
    # remove_from_crl only occurs in delta CRLs.
    if flag not in (x509.ReasonFlags.remove_from_crl,)
)
"""The reasons for a revocation, as RFC 5280 names them."""
_RESTORE = "Restore it from a backup."

SUPERSEDED = x509.ReasonFlags.superseded.value
"""The reason for a certificate that was renewed: its key may still be in use."""


@dataclass(frozen=True, slots=True)
class Revoked:
    """An entry of a revocation list; ``reason`` is one of `REASONS`."""

    serial: int
    date: datetime
    reason: str = "unspecified"


@dataclass(frozen=True, slots=True)
class RevocationList:
    """A parsed revocation list; its signature is not verified yet.

    ``revoked`` lacks entries with the reason removeFromCRL: they revoke nothing.
    """

    number: int
    this_update: datetime
    next_update: datetime
    revoked: tuple[Revoked, ...]
    list: x509.CertificateRevocationList

    def revokes(self, serial: int) -> bool:
        """Return whether the list revokes the certificate with the serial number ``serial``."""
        return any(each.serial == serial for each in self.revoked)


def sign_crl(
    issuer: x509.Certificate,
    key: PrivateKey,
    revoked: Iterable[Revoked],
    *,
    number: int,
    this_update: datetime,
    next_update: datetime,
) -> bytes:
    """Return a revocation list as PEM, signed with ``key``, the key of the CA ``issuer``.

    Raises:
        PkiError: a serial number is negative, or has more than 159 bits.
    """
    builder = (
        x509.CertificateRevocationListBuilder()
        .issuer_name(issuer.subject)
        .last_update(this_update)
        .next_update(next_update)
        .add_extension(x509.CRLNumber(number), critical=False)
        .add_extension(authority_identifier(issuer), critical=False)
    )
    for each in revoked:
        if not 0 < each.serial < 1 << 159:
            raise PkiError(
                f"the serial number {each.serial:x} cannot be put on a revocation list",
                "Serial numbers are positive, and have at most 159 bits (RFC 5280, 4.1.2.2).",
                "Sign the list with the program that issued that certificate.",
            )
        entry = (
            x509.RevokedCertificateBuilder().serial_number(each.serial).revocation_date(each.date)
        )
        if each.reason != "unspecified":  # RFC 5280, 5.3.1: the extension is left out instead
            entry = entry.add_extension(
                x509.CRLReason(x509.ReasonFlags(each.reason)), critical=False
            )
        builder = builder.add_revoked_certificate(entry.build())
    return builder.sign(key, hashes.SHA256()).public_bytes(serialization.Encoding.PEM)


def load_crl(data: bytes, name: str) -> RevocationList:
    """Return the first revocation list of a PEM file; ``name`` names the file in errors.

    Raises:
        PkiError: the list cannot be read, or does not say when it expires.
    """
    crl = read_list(data, name)
    next_update = crl.next_update_utc
    if next_update is None:
        raise PkiError(f"the revocation list {name} does not say when it expires", "", _RESTORE)
    revoked = tuple(each for each in map(_revoked, crl) if each.reason in REASONS)
    return RevocationList(_number(crl), crl.last_update_utc, next_update, revoked, crl)


def read_list(data: bytes, name: str) -> x509.CertificateRevocationList:
    """Return the first revocation list of a PEM file, with or without the time of its expiry.

    Raises:
        PkiError: the list cannot be read; ``name`` names the file.
    """
    with _reading(name, data):
        blocks = pem.blocks(data)
        return _read_block(next(each for each in blocks if each.label == _LABEL))


def read_lists(data: bytes, name: str) -> tuple[x509.CertificateRevocationList, ...]:
    """Return all revocation lists of a PEM file, which may have certificates, too.

    Raises:
        PkiError: a list, or what stands before it, cannot be read; ``name`` names the file.
    """
    with _reading(name, data):
        blocks = pem.blocks(data)
        return tuple(_read_block(each) for each in blocks if each.label == _LABEL)


def _reading(name: str, data: bytes) -> AbstractContextManager[None]:
    kind = "" if CRL_MARK in data else kind_of(data)
    why = f"It is not a PEM revocation list, but {kind}" if kind else "It is not a revocation list"
    return reading(
        f"the revocation list {name} cannot be read",
        f"{why}, so DDS refuses every participant.",
        _RESTORE,
    )


def _read_block(block: pem.Block) -> x509.CertificateRevocationList:
    if block.headers:
        raise ValueError("OpenSSL reads no list with PEM headers")
    return _read(block.content)


def _read(content: bytes) -> x509.CertificateRevocationList:
    data, _ = der.split(content)
    try:
        return _read_in_full(x509.load_der_x509_crl(data))
    except BaseException as error:
        if not is_of_reading(error):
            raise
    return _read_in_full(tolerant.read_list(data))


def _read_in_full(crl: x509.CertificateRevocationList) -> x509.CertificateRevocationList:
    read_name(crl.issuer)
    subject_text(crl.issuer)
    _ = crl.last_update_utc, crl.next_update_utc, crl.signature_hash_algorithm, _number(crl)
    for entry in crl:
        _revoked(entry)
    return crl


def embedded_lists(data: bytes) -> list[bytes]:
    """Return the revocation lists among the certificates of a PEM file, a PEM file each.

    OpenSSL reads all of them, and nothing that does not begin a line (pem_lib.c).
    """
    return [CRL_MARK + each for each in (b"\n" + data).split(b"\n" + CRL_MARK)[1:]]


def names_issuers(crl: x509.CertificateRevocationList) -> bool:
    """Return whether an entry says of which CA it and the entries after it are."""
    return any(
        extension.oid == CRLEntryExtensionOID.CERTIFICATE_ISSUER
        for entry in crl
        for extension in entry.extensions
    )


def lists_as_revoked(crl: x509.CertificateRevocationList, serial: int) -> bool:
    """Return whether a list revokes the certificate with the serial number ``serial``.

    An entry with the reason removeFromCRL does not (OpenSSL 3, x509_vfy.c, cert_crl).
    """
    if serial < 0:  # RFC 5280 forbids it, OpenSSL accepts it, and the search below raises
        entry = next((each for each in crl if each.serial_number == serial), None)
    else:
        entry = crl.get_revoked_certificate_by_serial_number(serial)
    return entry is not None and _revoked(entry).reason in REASONS


_READ_IF_CRITICAL = (
    ExtensionOID.ISSUING_DISTRIBUTION_POINT,
    ExtensionOID.AUTHORITY_KEY_IDENTIFIER,
    ExtensionOID.DELTA_CRL_INDICATOR,
)


_OF_USERS = x509.IssuingDistributionPoint(
    full_name=None,
    relative_name=None,
    only_contains_user_certs=True,
    only_contains_ca_certs=False,
    only_some_reasons=None,
    indirect_crl=False,
    only_contains_attribute_certs=False,
)


def refusal_of(crl: x509.CertificateRevocationList) -> str:
    """Return why OpenSSL verifies no certificate with a list, as a clause; "" if it does.

    Source: OpenSSL 3, x_crl.c (crl_set_issuers, crl_cb) and x509_vfy.c (get_crl_score).
    """
    for each in crl.extensions:
        if each.critical and each.oid not in _READ_IF_CRITICAL:
            return f"it has the unknown critical extension {each.oid.dotted_string}"
        if each.oid == ExtensionOID.DELTA_CRL_INDICATOR:
            return "it has only the changes of another list"
        if isinstance(each.value, x509.IssuingDistributionPoint) and each.value != _OF_USERS:
            return "it is not for all certificates of its CA"
    for entry in crl:
        for found in entry.extensions:
            if found.critical and found.oid != CRLEntryExtensionOID.CERTIFICATE_ISSUER:
                return f"an entry has the unknown critical extension {found.oid.dotted_string}"
    return ""


def signed_by(crl: x509.CertificateRevocationList, authority: x509.Certificate) -> bool:
    """Return whether ``authority`` issued and signed the revocation list."""
    return same_name(crl.issuer, authority.subject) and is_signed(
        crl, crl.tbs_certlist_bytes, authority
    )


def may_sign_lists(authority: x509.Certificate) -> bool:
    """Return whether OpenSSL accepts revocation lists of a CA: by keyUsage, if it has that."""
    usage = extension(authority, x509.KeyUsage)
    return usage is None or usage.crl_sign


def _number(crl: x509.CertificateRevocationList) -> int:
    try:
        return crl.extensions.get_extension_for_class(x509.CRLNumber).value.crl_number
    except x509.ExtensionNotFound:
        return 0


def _revoked(entry: x509.RevokedCertificate) -> Revoked:
    try:
        reason = entry.extensions.get_extension_for_class(x509.CRLReason).value.reason.value
    except x509.ExtensionNotFound:
        reason = "unspecified"
    return Revoked(entry.serial_number, entry.revocation_date_utc, reason)
