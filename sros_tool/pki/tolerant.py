"""Certificates and revocation lists that OpenSSL 3.0 reads, and `cryptography` does not.

OpenSSL takes BER, versions that there are not, unknown keys and signatures, odd strings and dates;
it asks about most of that when it verifies a chain.  The values here have of `cryptography`'s
classes, which cannot be derived from, the members that sros uses.
"""

from __future__ import annotations

import base64
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from datetime import UTC, datetime
from hashlib import sha256
from typing import NamedTuple, cast

from cryptography import x509
from cryptography.exceptions import UnsupportedAlgorithm
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.x509.oid import CRLEntryExtensionOID, ObjectIdentifier

from sros_tool.pki import der
from sros_tool.pki import tolerant_extensions as extensions_of
from sros_tool.pki.object_names import short_names
from sros_tool.pki.reading import read_name_der

_TIMES = {der.UTC_TIME: "%y%m%d%H%M%SZ", der.GENERALIZED_TIME: "%Y%m%d%H%M%SZ"}
"""The forms of dates that OpenSSL compares (X509_cmp_time), by type."""
_DIGITS = {der.UTC_TIME: 12, der.GENERALIZED_TIME: 14}
_FIRST_YEAR = 1950
"""The first year of a UTCTime (RFC 5280, 4.1.2.5.1)."""
_CONTEXT_2, _CONTEXT_3 = 0x82, 0xA3
_UNIQUE_IDENTIFIERS = (0x81, _CONTEXT_2)


@dataclass(frozen=True)
class UnknownKey:
    """A public key (SubjectPublicKeyInfo in DER) of an unknown algorithm, or with such parameters.

    Two are equal if they are written alike.
    """

    data: bytes

    def public_bytes(self, *form: object) -> bytes:
        """Return the key in DER."""
        return self.data


class _Part(NamedTuple):
    """An attribute of a distinguished name."""

    oid: ObjectIdentifier
    value: str


class TolerantName:
    """A distinguished name with values that its string types do not allow."""

    def __init__(self, data: bytes) -> None:
        read_name_der(data)
        self._data = data

    def public_bytes(self) -> bytes:
        """Return the name in DER."""
        return self._data

    @property
    def rdns(self) -> list[list[_Part]]:
        """The parts of the name (RDNs), a list of attributes each."""
        rdns = []
        for rdn in der.children(der.first(self._data).content):
            pairs = [der.children(attribute.content) for attribute in der.children(rdn.content)]
            rdns.append(
                [
                    _Part(
                        ObjectIdentifier(der.decode_oid(kind.content)),
                        value.content.decode("utf-8", "replace"),
                    )
                    for kind, value in pairs
                ]
            )
        return rdns

    def get_attributes_for_oid(self, oid: ObjectIdentifier) -> list[_Part]:
        """Return the attributes of a kind."""
        return [part for rdn in self.rdns for part in rdn if part.oid == oid]

    def rfc4514_string(self) -> str:
        """Return the name as text."""
        parts = (f"{part.oid.dotted_string}={part.value}" for rdn in self.rdns for part in rdn)
        return ",".join(parts)

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, (TolerantName, x509.Name)):
            return NotImplemented
        return self._data == other.public_bytes()

    def __hash__(self) -> int:
        return hash(self._data)


class _Signed:
    """What a CA signed: a value in DER of the signed part, an algorithm and the signature."""

    _LABEL = b""

    def __init__(self, data: bytes) -> None:
        self._data = data
        parts = _sequence(der.first(der.normalized(data)))
        signed, algorithm, signature = parts
        if signature.tag != der.BIT_STRING or not signature.content or signature.content[0] > 7:
            raise ValueError("its signature is not a BIT STRING")
        self._parts = _sequence(signed)
        self._algorithm = algorithm
        self.signature = signature.content[1:]
        identifier = _sequence(algorithm)[0]
        self.signature_algorithm_oid = ObjectIdentifier(der.decode_oid(identifier.content))

    @property
    def signature_hash_algorithm(self) -> hashes.HashAlgorithm | None:
        """The hash of the signature; None if the algorithm has none, or is not known."""
        with suppress(ValueError, UnsupportedAlgorithm):
            return self._shell().signature_hash_algorithm
        return None

    @property
    def signature_algorithm_parameters(self) -> object:
        """The padding or curve of the signature; None if it is not known."""
        with suppress(ValueError, UnsupportedAlgorithm):
            return self._shell().signature_algorithm_parameters
        return None

    def public_bytes(self, encoding: serialization.Encoding) -> bytes:
        """Return it as it was read, in DER, or that as PEM."""
        if encoding is serialization.Encoding.DER:
            return self._data
        text = base64.encodebytes(self._data).replace(b"\n", b"")
        lines = [text[start : start + 64] for start in range(0, len(text), 64)]
        label = self._LABEL
        return b"\n".join([b"-----BEGIN %b-----" % label, *lines, b"-----END %b-----\n" % label])

    def fingerprint(self, algorithm: hashes.HashAlgorithm) -> bytes:
        """Return the hash of it."""
        digest = hashes.Hash(algorithm)
        digest.update(self._data)
        return digest.finalize()

    def _shell(self) -> x509.Certificate:
        return extensions_of.shell(algorithm=self._algorithm.whole)

    def _signed_bytes(self) -> bytes:
        """Return the part that is signed, as it was read."""
        return der.first_part(self._data)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, type(self)) and other._data == self._data

    def __hash__(self) -> int:
        return int.from_bytes(sha256(self._data).digest()[:7], "big")


class _TolerantCertificate(_Signed):
    """A certificate; see `cryptography.x509.Certificate` for the members."""

    _LABEL = b"CERTIFICATE"

    def __init__(self, data: bytes) -> None:
        super().__init__(data)
        parts = self._parts
        number = 0
        if parts[0].tag == der.CONTEXT_0:
            number = der.integer(der.first(parts.pop(0).content))
        self.version = x509.Version.v1 if number == 0 else x509.Version.v3
        self.number = number + 1
        serial, _, issuer, validity, subject, key, *rest = parts
        self.serial_number = der.integer(serial)
        self.issuer, self.subject = _name(issuer.whole), _name(subject.whole)
        begin, end = _sequence(validity)
        self.unread_dates = [
            name for name, date in (("notBefore", begin), ("notAfter", end)) if not _date(date)
        ]
        self.not_valid_before_utc = _date(begin) or datetime.min.replace(tzinfo=UTC)
        self.not_valid_after_utc = _date(end) or datetime.max.replace(tzinfo=UTC)
        algorithm, _ = _sequence(key)
        oid = _sequence(algorithm)[0]
        self.public_key_algorithm_oid = ObjectIdentifier(der.decode_oid(oid.content))
        self._key = _public_key(key.whole)
        while rest and rest[0].tag in _UNIQUE_IDENTIFIERS:
            rest.pop(0)
        found = _sequence(der.first(rest.pop(0).content)) if rest else []
        if rest:
            raise ValueError("its signed part has more than a certificate has")
        self.extensions = extensions_of.of_certificate(found)

    @property
    def tbs_certificate_bytes(self) -> bytes:
        """The signed part, as it was read."""
        return self._signed_bytes()

    def public_key(self) -> object:
        """Return the public key, or an `UnknownKey`."""
        return self._key


class _TolerantEntry(NamedTuple):
    """An entry of a list; see `cryptography.x509.RevokedCertificate` for the members."""

    serial_number: int
    revocation_date_utc: datetime
    extensions: x509.Extensions


class _TolerantList(_Signed):
    """A revocation list; see `cryptography.x509.CertificateRevocationList` for the members."""

    _LABEL = b"X509 CRL"

    def __init__(self, data: bytes) -> None:
        super().__init__(data)
        parts = self._parts
        if parts[0].tag == der.INTEGER:
            parts.pop(0)
        _, issuer, begin, *rest = parts
        self.issuer = _name(issuer.whole)
        dates = [_date(begin)]
        while rest and rest[0].tag in _TIMES:
            dates.append(_date(rest.pop(0)))
        if len(dates) > 2 or None in dates:
            raise ValueError("its dates are none that OpenSSL compares")
        self.last_update_utc = dates[0]
        self.next_update_utc = dates[1] if len(dates) == 2 else None
        entries = _sequence(rest.pop(0)) if rest and rest[0].tag == der.SEQUENCE else []
        found = _sequence(der.first(rest.pop(0).content)) if rest else []
        if rest:
            raise ValueError("its signed part has more than a list has")
        self.extensions = extensions_of.of_list(found)
        self._entries = list(_entries(entries))

    @property
    def tbs_certlist_bytes(self) -> bytes:
        """The signed part, as it was read."""
        return self._signed_bytes()

    def __iter__(self) -> Iterator[_TolerantEntry]:
        return iter(self._entries)

    def __len__(self) -> int:
        return len(self._entries)

    def get_revoked_certificate_by_serial_number(self, serial: int) -> _TolerantEntry | None:
        """Return the entry for a serial number, if there is one."""
        return next((entry for entry in self if entry.serial_number == serial), None)


def read_certificate(data: bytes) -> x509.Certificate:
    """Return a certificate that `cryptography` does not read; ``data`` is in BER.

    Raises:
        PkiError, ValueError: OpenSSL does not read it either.
    """
    return cast(x509.Certificate, _TolerantCertificate(data))


def read_list(data: bytes) -> x509.CertificateRevocationList:
    """Return a revocation list that `cryptography` does not read; raise as `read_certificate`."""
    return cast(x509.CertificateRevocationList, _TolerantList(data))


def check_list(data: bytes) -> None:
    """Read a revocation list that is not used.

    Raises:
        PkiError, ValueError: OpenSSL does not read it.
    """
    value, _ = der.split(data)
    try:
        x509.load_der_x509_crl(value)
    except ValueError:
        _TolerantList(value)


def is_tolerated(certificate: x509.Certificate) -> bool:
    """Return whether a certificate is one that `cryptography` does not read."""
    return isinstance(certificate, _TolerantCertificate)


def unread_extension(certificate: x509.Certificate) -> str:
    """Return the name of an extension for which OpenSSL takes a certificate for invalid, or ""."""
    if not is_tolerated(certificate):
        return ""
    return next(
        (
            short_names().get(extension.oid.dotted_string, "")
            for extension in certificate.extensions
            if extension.oid in extensions_of.DECODED and extensions_of.is_unread(extension)
        ),
        "",
    )


def version_of(certificate: x509.Certificate) -> int:
    """Return the version of a certificate as people count: the one with extensions is the third."""
    if isinstance(certificate, _TolerantCertificate):
        return certificate.number
    return int(certificate.version.value) + 1


def unread_date(certificate: x509.Certificate) -> str:
    """Return which date of a certificate OpenSSL does not compare, or ""."""
    tolerated = certificate if isinstance(certificate, _TolerantCertificate) else None
    return next(iter(tolerated.unread_dates), "") if tolerated else ""


def _name(data: bytes) -> x509.Name:
    """Return a distinguished name in DER, also with values that their types do not allow.

    Raises:
        PkiError, ValueError: OpenSSL does not read it either.
    """
    with suppress(ValueError):
        name = extensions_of.shell(subject=data).subject
        name.rfc4514_string()
        read_name_der(data)
        return name
    return cast(x509.Name, TolerantName(data))


def _entries(values: list[der.Value]) -> Iterator[_TolerantEntry]:
    """Yield the entries of a list; OpenSSL decodes extensions up to the first one that is damaged.

    Source: x_crl.c (crl_set_issuers).
    """
    damaged = False
    for value in values:
        serial, date, *rest = _sequence(value)
        found = extensions_of.of_entry(_sequence(rest[0]) if rest else [])
        if damaged:
            found = x509.Extensions([])
        elif any(
            extensions_of.is_unread(extension) and extension.oid in _DECODED_OF_ENTRIES
            for extension in found
        ):
            damaged = True
            found = x509.Extensions([])
        moment = _date(date) or datetime.min.replace(tzinfo=UTC)
        yield _TolerantEntry(der.integer(serial), moment, found)


_DECODED_OF_ENTRIES = (CRLEntryExtensionOID.CERTIFICATE_ISSUER, CRLEntryExtensionOID.CRL_REASON)


def _sequence(value: der.Value) -> list[der.Value]:
    if value.tag != der.SEQUENCE:
        raise ValueError("not a SEQUENCE")
    return der.children(value.content)


def _public_key(data: bytes) -> object:
    try:
        return serialization.load_der_public_key(data)
    except (ValueError, UnsupportedAlgorithm):
        return UnknownKey(data)


def _date(value: der.Value) -> datetime | None:
    """Return a date in UTC, or None for one that OpenSSL does not compare with others."""
    digits, form = _DIGITS.get(value.tag), _TIMES.get(value.tag)
    if digits is None or form is None:
        raise ValueError("not a date")
    text = value.content
    if not (len(text) == digits + 1 and text[:digits].isdigit() and text[digits:] == b"Z"):
        return None
    if text[:4] == b"0000" and value.tag == der.GENERALIZED_TIME:
        text = b"0001" + text[4:]  # the first year that Python has
    with suppress(ValueError):
        if value.tag == der.UTC_TIME:
            century = b"19" if int(text[:2]) >= _FIRST_YEAR % 100 else b"20"
            text = century + text
        return datetime.strptime(text.decode(), _TIMES[der.GENERALIZED_TIME]).replace(tzinfo=UTC)
    return None
