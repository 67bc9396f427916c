"""Readers of certificates and revocation lists that OpenSSL 3.0 reads, but `cryptography` does not.

OpenSSL reads BER, invalid versions, unknown keys and signatures, and odd strings and dates; most of
these are checked only when a chain is verified.  OpenSSL decodes an extension by its ASN.1 template
alone (X509V3_EXT_d2i): BER is accepted, trailing data is ignored, and contradicting values are no
error.  The classes of `cryptography` cannot be subclassed, so the classes here have the same
members, as far as sros uses them.
"""

from __future__ import annotations

import base64
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from datetime import UTC, datetime
from hashlib import sha256
from typing import Any, NamedTuple, cast

from cryptography import x509
from cryptography.exceptions import UnsupportedAlgorithm
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.x509.oid import CRLEntryExtensionOID, ExtensionOID, ObjectIdentifier

from sros_tool.errors import PkiError
from sros_tool.pki import der
from sros_tool.pki.distinguished_names import check_name_der_readable, short_names

_TIME_FORMATS = {der.UTC_TIME: "%y%m%d%H%M%SZ", der.GENERALIZED_TIME: "%Y%m%d%H%M%SZ"}
"""The forms of dates that OpenSSL compares (X509_cmp_time), by type."""
_TIME_DIGITS = {der.UTC_TIME: 12, der.GENERALIZED_TIME: 14}
_FIRST_YEAR = 1950
"""The first year of a UTCTime (RFC 5280, 4.1.2.5.1)."""
_CONTEXT_2 = 0x82
_CONTEXT_3 = 0xA3
_UNIQUE_IDENTIFIERS = (0x81, _CONTEXT_2)


@dataclass(frozen=True)
class UnknownKey:
    """A public key (SubjectPublicKeyInfo in DER) whose algorithm or parameters are unknown.

    Two keys are equal if their encodings are equal.
    """

    data: bytes

    def public_bytes(self, *form: object) -> bytes:
        """Return the key in DER."""
        return self.data


class _Attribute(NamedTuple):
    """An attribute of a distinguished name."""

    oid: ObjectIdentifier
    value: str


class TolerantName:
    """A distinguished name with values that their declared string types do not allow."""

    def __init__(self, data: bytes) -> None:
        check_name_der_readable(data)
        self._data = data

    def public_bytes(self) -> bytes:
        """Return the name in DER."""
        return self._data

    @property
    def rdns(self) -> list[list[_Attribute]]:
        """The parts of the name (RDNs), each as a list of attributes."""
        rdns = []
        for rdn in der.children(der.first_value(self._data).content):
            pairs = [der.children(attribute.content) for attribute in der.children(rdn.content)]
            rdns.append(
                [
                    _Attribute(
                        ObjectIdentifier(der.decode_oid(kind)),
                        value.content.decode("utf-8", "replace"),
                    )
                    for kind, value in pairs
                ]
            )
        return rdns

    def get_attributes_for_oid(self, oid: ObjectIdentifier) -> list[_Attribute]:
        """Return the attributes of a type."""
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
    """The common parts of certificates and revocation lists: signed part, algorithm, signature."""

    _LABEL = b""

    def __init__(self, data: bytes) -> None:
        self._data = data
        parts = _sequence(der.first_value(der.normalized(data)))
        signed, algorithm, signature = parts
        _check_bits(signature)
        self._parts = _sequence(signed)
        self._algorithm = algorithm
        self.signature = signature.content[1:]
        self.signature_algorithm_oid = _algorithm(algorithm)

    @property
    def signature_hash_algorithm(self) -> hashes.HashAlgorithm | None:
        """The hash of the signature; None if the algorithm has none, or is not known."""
        with suppress(ValueError, UnsupportedAlgorithm):
            return self._minimal_certificate().signature_hash_algorithm
        return None

    @property
    def signature_algorithm_parameters(self) -> object:
        """The padding or curve of the signature; None if it is not known."""
        with suppress(ValueError, UnsupportedAlgorithm):
            return self._minimal_certificate().signature_algorithm_parameters
        return None

    def public_bytes(self, encoding: serialization.Encoding) -> bytes:
        """Return the original bytes in DER, or their PEM encoding."""
        if encoding is serialization.Encoding.DER:
            return self._data
        text = base64.encodebytes(self._data).replace(b"\n", b"")
        lines = [text[start : start + 64] for start in range(0, len(text), 64)]
        label = self._LABEL
        return b"\n".join([b"-----BEGIN %b-----" % label, *lines, b"-----END %b-----\n" % label])

    def fingerprint(self, algorithm: hashes.HashAlgorithm) -> bytes:
        """Return the hash of the original bytes in DER."""
        digest = hashes.Hash(algorithm)
        digest.update(self._data)
        return digest.finalize()

    def _minimal_certificate(self) -> x509.Certificate:
        return _certificate_with(algorithm=self._algorithm.whole)

    def _signed_bytes(self) -> bytes:
        """Return the original bytes of the signed part."""
        return der.first_part(self._data)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, type(self)) and other._data == self._data

    def __hash__(self) -> int:
        return int.from_bytes(sha256(self._data).digest()[:7], "big")


class _TolerantCertificate(_Signed):
    """A certificate; its members are those of `cryptography.x509.Certificate`."""

    _LABEL = b"CERTIFICATE"

    def __init__(self, data: bytes) -> None:
        super().__init__(data)
        parts = self._parts
        number = 0
        if parts[0].tag == der.CONTEXT_0:
            number = der.integer(_single_inside(parts.pop(0)))
        self.version = x509.Version.v1 if number == 0 else x509.Version.v3
        self.number = number + 1
        serial, algorithm, issuer, validity, subject, key, *rest = parts
        _algorithm(algorithm)
        self.serial_number = der.integer(serial)
        self.issuer, self.subject = _name(issuer.whole), _name(subject.whole)
        begin, end = _sequence(validity)
        self.unread_dates = [
            name for name, date in (("notBefore", begin), ("notAfter", end)) if not _date(date)
        ]
        self.not_valid_before_utc = _date(begin) or datetime.min.replace(tzinfo=UTC)
        self.not_valid_after_utc = _date(end) or datetime.max.replace(tzinfo=UTC)
        algorithm, bits = _sequence(key)
        _algorithm(algorithm)
        _check_bits(bits)
        self._key = _public_key(key.whole)
        for identifier in _UNIQUE_IDENTIFIERS:
            if rest and rest[0].tag == identifier:
                rest.pop(0)
        values = (
            _sequence(_single_inside(rest.pop(0))) if rest and rest[0].tag == _CONTEXT_3 else []
        )
        if rest:
            raise ValueError("its signed part has extra fields that a certificate does not have")
        self.extensions = _parse_extensions(values, _parse_in_certificate, _CERTIFICATE_READERS)

    @property
    def tbs_certificate_bytes(self) -> bytes:
        """The signed part, in its original bytes."""
        return self._signed_bytes()

    def public_key(self) -> object:
        """Return the public key, or an `UnknownKey`."""
        return self._key


class _TolerantEntry(NamedTuple):
    """An entry of a list; its members are those of `cryptography.x509.RevokedCertificate`."""

    serial_number: int
    revocation_date_utc: datetime
    extensions: x509.Extensions


class _TolerantList(_Signed):
    """A revocation list; its members are those of `cryptography.x509.CertificateRevocationList`."""

    _LABEL = b"X509 CRL"

    def __init__(self, data: bytes) -> None:
        super().__init__(data)
        parts = self._parts
        if parts[0].tag == der.INTEGER:
            parts.pop(0)
        algorithm, issuer, begin, *rest = parts
        _algorithm(algorithm)
        self.issuer = _name(issuer.whole)
        dates = [_date(begin)]
        while rest and rest[0].tag in _TIME_FORMATS:
            dates.append(_date(rest.pop(0)))
        if len(dates) > 2 or None in dates:
            raise ValueError("its dates have a form that OpenSSL cannot compare")
        self.last_update_utc = dates[0]
        self.next_update_utc = dates[1] if len(dates) == 2 else None
        entries = _sequence(rest.pop(0)) if rest and rest[0].tag == der.SEQUENCE else []
        values = (
            _sequence(_single_inside(rest.pop(0))) if rest and rest[0].tag == der.CONTEXT_0 else []
        )
        if rest:
            raise ValueError(
                "its signed part has extra fields that a revocation list does not have"
            )
        self.extensions = _parse_extensions(values, _parse_in_list, _LIST_READERS)
        self._entries = list(_entries(entries))

    @property
    def tbs_certlist_bytes(self) -> bytes:
        """The signed part, in its original bytes."""
        return self._signed_bytes()

    def __iter__(self) -> Iterator[_TolerantEntry]:
        return iter(self._entries)

    def __len__(self) -> int:
        return len(self._entries)

    def get_revoked_certificate_by_serial_number(self, serial: int) -> _TolerantEntry | None:
        """Return the entry for a serial number, or None."""
        return next((entry for entry in self if entry.serial_number == serial), None)


def read_certificate(data: bytes) -> x509.Certificate:
    """Return a certificate, given in BER, that `cryptography` refuses to read.

    Raises:
        PkiError, ValueError: OpenSSL refuses the certificate, too.
    """
    return cast(x509.Certificate, _TolerantCertificate(data))


def read_list(data: bytes) -> x509.CertificateRevocationList:
    """Return a revocation list, given in BER, that `cryptography` refuses to read.

    Raises:
        PkiError, ValueError: OpenSSL refuses the list, too.
    """
    return cast(x509.CertificateRevocationList, _TolerantList(data))


def check_list(data: bytes) -> None:
    """Check that OpenSSL can read a revocation list.

    Raises:
        PkiError, ValueError: OpenSSL refuses the list.
    """
    value, _ = der.split(data)
    try:
        x509.load_der_x509_crl(value)
    except ValueError:
        _TolerantList(value)


def is_tolerated(certificate: x509.Certificate) -> bool:
    """Return whether this module read the certificate, because `cryptography` refused it."""
    return isinstance(certificate, _TolerantCertificate)


def unread_extension(certificate: x509.Certificate) -> str:
    """Return the name of a damaged extension that makes OpenSSL refuse a certificate, or ""."""
    if not is_tolerated(certificate):
        return ""
    return next(
        (
            short_names().get(extension.oid.dotted_string, "")
            for extension in certificate.extensions
            if extension.oid in _DECODED_EXTENSIONS and is_unread(extension)
        ),
        "",
    )


def version_of(certificate: x509.Certificate) -> int:
    """Return the version of a certificate: 3 for X.509v3, the version with extensions."""
    if isinstance(certificate, _TolerantCertificate):
        return certificate.number
    return int(certificate.version.value) + 1


def unread_date(certificate: x509.Certificate) -> str:
    """Return which date of a certificate OpenSSL cannot compare (attribute name), or ""."""
    tolerated = certificate if isinstance(certificate, _TolerantCertificate) else None
    return next(iter(tolerated.unread_dates), "") if tolerated else ""


def date(
    dated: x509.Certificate | x509.CertificateRevocationList | x509.RevokedCertificate, name: str
) -> Any:
    """Return the date in the attribute ``name`` of ``dated``, in UTC.

    The result is None for the expiry of a list that states none.

    `cryptography` 41 has only attributes for dates without a time zone.
    """
    try:
        return getattr(dated, f"{name}_utc")
    except AttributeError:
        moment = getattr(dated, name)
        return moment and moment.replace(tzinfo=UTC)


def _name(data: bytes) -> x509.Name:
    """Return a distinguished name, given in DER, even with values that its types do not allow.

    Raises:
        PkiError, ValueError: OpenSSL refuses the name, too.
    """
    with suppress(ValueError):
        name = _certificate_with(subject=data).subject
        name.rfc4514_string()
        check_name_der_readable(data)
        return name
    return cast(x509.Name, TolerantName(data))


def _entries(values: list[der.Value]) -> Iterator[_TolerantEntry]:
    """Yield the entries of a revocation list.

    As in OpenSSL (x_crl.c, crl_set_issuers), the extensions of an entry are decoded up to the first
    damaged extension.
    """
    damaged = False
    for value in values:
        serial, date, *rest = _sequence(value)
        extensions = _parse_extensions(
            _sequence(rest[0]) if rest else [], _parse_in_entry, _ENTRY_READERS
        )
        if damaged:
            extensions = x509.Extensions([])
        elif any(is_unread(e) and e.oid in _DECODED_ENTRY_EXTENSIONS for e in extensions):
            damaged = True
            extensions = x509.Extensions([])
        moment = _date(date) or datetime.min.replace(tzinfo=UTC)
        yield _TolerantEntry(der.integer(serial), moment, extensions)


_DECODED_ENTRY_EXTENSIONS = (
    CRLEntryExtensionOID.CERTIFICATE_ISSUER,
    CRLEntryExtensionOID.CRL_REASON,
)


def _sequence(value: der.Value) -> list[der.Value]:
    if value.tag != der.SEQUENCE:
        raise ValueError("not a SEQUENCE")
    return der.children(value.content)


def _algorithm(value: der.Value) -> ObjectIdentifier:
    """Return the OID of an algorithm; the parameters may be any single value."""
    identifier, *parameters = _sequence(value)
    if len(parameters) > 1:
        raise ValueError("not an algorithm")
    for parameter in parameters:
        if parameter.tag == der.OID:
            der.decode_oid(parameter)
    return ObjectIdentifier(der.decode_oid(identifier))


def _check_bits(value: der.Value) -> None:
    if value.tag != der.BIT_STRING or not value.content or value.content[0] > 7:
        raise ValueError("not a BIT STRING")


def _single_inside(value: der.Value) -> der.Value:
    """Return the single value inside an explicitly tagged value."""
    (inner,) = der.children(value.content)
    return inner


def _public_key(data: bytes) -> object:
    try:
        return serialization.load_der_public_key(data)
    except (ValueError, UnsupportedAlgorithm):
        return UnknownKey(data)


def _date(value: der.Value) -> datetime | None:
    """Parse a date in UTC; None for a date in a form that OpenSSL cannot compare."""
    digits, form = _TIME_DIGITS.get(value.tag), _TIME_FORMATS.get(value.tag)
    if digits is None or form is None:
        raise ValueError("not a date")
    text = value.content
    if not (len(text) == digits + 1 and text[:digits].isdigit() and text[digits:] == b"Z"):
        return None
    if text[:4] == b"0000" and value.tag == der.GENERALIZED_TIME:
        text = b"0001" + text[4:]  # Python's first year is 1
    with suppress(ValueError):
        if value.tag == der.UTC_TIME:
            century = b"19" if int(text[:2]) >= _FIRST_YEAR % 100 else b"20"
            text = century + text
        return datetime.strptime(text.decode(), _TIME_FORMATS[der.GENERALIZED_TIME]).replace(
            tzinfo=UTC
        )
    return None


# ── extensions (v3_lib.c) ─────────────────────────────────────────────────────────────────────


_ENUMERATED = 0x0A
_GENERAL_NAMES = (0xA0, 0x81, 0x82, 0xA3, 0xA4, 0xA5, 0x86, 0x87, 0x88)
"""The tags of the alternatives of a GeneralName (RFC 5280, 4.2.1.6)."""
_USER, _CA, _INDIRECT, _ATTRIBUTES = 0x81, 0x82, 0x84, 0x85
"""The tags of the flags of an issuingDistributionPoint (RFC 5280, 5.2.5)."""
_DECODED_EXTENSIONS = frozenset(
    {
        ExtensionOID.BASIC_CONSTRAINTS,
        ExtensionOID.KEY_USAGE,
        ExtensionOID.EXTENDED_KEY_USAGE,
        ExtensionOID.SUBJECT_KEY_IDENTIFIER,
        ExtensionOID.AUTHORITY_KEY_IDENTIFIER,
        ExtensionOID.SUBJECT_ALTERNATIVE_NAME,
        ExtensionOID.NAME_CONSTRAINTS,
        ExtensionOID.CRL_DISTRIBUTION_POINTS,
    }
)
"""Extensions that OpenSSL always decodes: if damaged, the certificate is invalid (v3_purp.c)."""


class _LooseConstraints(x509.BasicConstraints):
    """basicConstraints in which a certificate that is not a CA may have a path length."""

    def __init__(self, ca: bool, path_length: int | None) -> None:
        super().__init__(ca, path_length if ca else None)
        self._longest = path_length

    @property
    def path_length(self) -> int | None:
        """The pathLenConstraint; None if the certificate has none."""
        return self._longest


class _LooseKeyIdentifier(x509.AuthorityKeyIdentifier):
    """An authorityKeyIdentifier that has an issuer or a serial number, but not both.

    `cryptography` demands both or neither.
    """

    def __init__(
        self, key: bytes | None, issuer: list[x509.GeneralName] | None, serial: int | None
    ) -> None:
        super().__init__(key, None, None)
        self._issuer_names, self._serial = issuer, serial

    @property
    def authority_cert_issuer(self) -> list[x509.GeneralName] | None:
        """The names of the CA that issued the authority's own certificate; None if not stated."""
        return self._issuer_names

    @property
    def authority_cert_serial_number(self) -> int | None:
        """The serial number of the authority's own certificate; None if not stated."""
        return self._serial


class UnreadableName(x509.GeneralName):
    """A GeneralName with an invalid value, such as an IP address of one byte."""

    value = None


class ContradictoryPoint(x509.ExtensionType):
    """An issuingDistributionPoint that is limited to two kinds of certificates, a contradiction."""

    oid = ExtensionOID.ISSUING_DISTRIBUTION_POINT


def is_unread(extension: x509.Extension[x509.ExtensionType]) -> bool:
    """Return whether the value of an extension was not decoded."""
    return isinstance(extension.value, x509.UnrecognizedExtension)


_StrictReader = Callable[[bytes], x509.Extensions]
_LooseReader = Callable[[bytes], x509.ExtensionType | None]


def _parse_extensions(
    parts: Iterable[der.Value],
    strict: _StrictReader,
    loose: Mapping[ObjectIdentifier, _LooseReader],
) -> x509.Extensions:
    """Parse extensions in DER, each with the reader ``strict`` or else with one of ``loose``.

    Raises:
        PkiError: one of ``parts`` is not an extension.
    """
    known = [_parts(part) for part in parts]
    count = [oid for oid, _, _ in known]
    extensions = []
    for oid, critical, content in known:
        value: x509.ExtensionType | None = x509.UnrecognizedExtension(oid, content)
        if count.count(oid) == 1:  # OpenSSL decodes no extension that occurs twice
            value = _extension_value(oid, content, strict, loose)
        if value is not None:
            extensions.append(x509.Extension(oid, critical, value))
    return x509.Extensions(extensions)


def _parts(extension: der.Value) -> tuple[ObjectIdentifier, bool, bytes]:
    """Return the identifier of an extension, whether it is critical, and its content."""
    identifier, *flag, content = der.children(extension.content)
    tags = (extension.tag, identifier.tag, content.tag, [value.tag for value in flag])
    if tags not in (
        (der.SEQUENCE, der.OID, der.OCTET_STRING, []),
        (der.SEQUENCE, der.OID, der.OCTET_STRING, [der.BOOLEAN]),
    ):
        raise PkiError("an extension is not an Extension structure")
    if any(len(value.content) != 1 for value in flag):
        raise PkiError("an extension's critical flag is not a BOOLEAN")
    oid = ObjectIdentifier(der.decode_oid(identifier))
    return oid, any(value.content != b"\0" for value in flag), content.content


def _extension_value(
    oid: ObjectIdentifier,
    content: bytes,
    strict: _StrictReader,
    loose: Mapping[ObjectIdentifier, _LooseReader],
) -> x509.ExtensionType | None:
    """Return the value of an extension, decoded strictly or else by a looser reader.

    The result is None for an empty value that can be ignored, and an UnrecognizedExtension for a
    value that neither reader can decode.
    """
    ways: list[Callable[[bytes], x509.ExtensionType | None]] = [
        lambda data: strict(_encoded_extension(oid, data))[0].value
    ]
    if oid in loose:
        ways.append(loose[oid])
    for way in ways:
        try:
            return way(der.normalized(content))
        except (PkiError, ValueError, TypeError, x509.UnsupportedGeneralNameType):
            continue
    return x509.UnrecognizedExtension(oid, content)


def _encoded_extension(oid: ObjectIdentifier, content: bytes) -> bytes:
    identifier = der.encode(der.OID, der.encode_oid(oid.dotted_string))
    return der.encode(der.SEQUENCE, identifier, der.encode(der.OCTET_STRING, content))


# ── extensions that `cryptography` reads ───────────────────────────────────────────────────

_ED25519 = der.encode(der.SEQUENCE, der.encode(der.OID, der.encode_oid("1.3.101.112")))
_EMPTY_NAME = der.encode(der.SEQUENCE)
_ANY_TIME = der.encode(der.UTC_TIME, b"260101000000Z")
_ANY_BIT_STRING = der.encode(der.BIT_STRING, b"\0" * 33)
_ANY_SERIAL = der.encode_integer(1)


def _certificate_with(
    *, algorithm: bytes = _ED25519, subject: bytes = _EMPTY_NAME, extension: bytes = b""
) -> x509.Certificate:
    """Return a minimal certificate with the given parts (DER).

    `cryptography` parses a name, an algorithm or an extension only inside of a certificate.

    Raises:
        ValueError: `cryptography` cannot read a part.
    """
    extensions = der.encode(0xA3, der.encode(der.SEQUENCE, extension)) if extension else b""
    signed = der.encode(
        der.SEQUENCE,
        der.encode(der.CONTEXT_0, der.encode_integer(2)),
        _ANY_SERIAL,
        algorithm,
        _EMPTY_NAME,
        der.encode(der.SEQUENCE, _ANY_TIME, _ANY_TIME),
        subject,
        der.encode(der.SEQUENCE, _ED25519, _ANY_BIT_STRING),
        extensions,
    )
    return x509.load_der_x509_certificate(
        der.encode(der.SEQUENCE, signed, algorithm, _ANY_BIT_STRING)
    )


def _parse_in_certificate(extension: bytes) -> x509.Extensions:
    return _certificate_with(extension=extension).extensions


def _minimal_list(entry: bytes, extensions: bytes) -> x509.CertificateRevocationList:
    signed = der.encode(
        der.SEQUENCE, _ANY_SERIAL, _ED25519, _EMPTY_NAME, _ANY_TIME, entry, extensions
    )
    return x509.load_der_x509_crl(der.encode(der.SEQUENCE, signed, _ED25519, _ANY_BIT_STRING))


def _parse_in_list(extension: bytes) -> x509.Extensions:
    return _minimal_list(
        b"", der.encode(der.CONTEXT_0, der.encode(der.SEQUENCE, extension))
    ).extensions


def _parse_in_entry(extension: bytes) -> x509.Extensions:
    entry = der.encode(der.SEQUENCE, _ANY_SERIAL, _ANY_TIME, der.encode(der.SEQUENCE, extension))
    return next(iter(_minimal_list(der.encode(der.SEQUENCE, entry), b""))).extensions


# ── extensions that `cryptography` refuses ─────────────────────────────────────────────────


def _basic_constraints(content: bytes) -> _LooseConstraints:
    ca, length = False, None
    parts = _values_inside(content)
    if parts and parts[0].tag == der.BOOLEAN:
        ca = parts.pop(0).content != b"\0"
    if parts and parts[0].tag == der.INTEGER:
        length = der.integer(parts.pop(0))
    if parts or (length is not None and length < 0):
        raise ValueError("OpenSSL takes it for invalid")
    return _LooseConstraints(ca, length)


def _key_usage(content: bytes) -> x509.KeyUsage:
    value = der.first_value(content)
    _check_bits(value)
    bits = "".join(f"{octet:08b}" for octet in value.content[1:])
    if value.content[0] and bits:  # OpenSSL clears the unused bits of the last byte
        bits = bits[: -value.content[0]]
    flags = [bit == "1" for bit in bits[: len(_USAGES)].ljust(len(_USAGES), "0")]
    usage = dict(zip(_USAGES, flags, strict=True))
    # `x509.KeyUsage` accepts these two flags only together with key_agreement.
    usage["key_agreement"] |= usage["encipher_only"] or usage["decipher_only"]
    return x509.KeyUsage(**usage)


_USAGES = (
    "digital_signature",
    "content_commitment",
    "key_encipherment",
    "data_encipherment",
    "key_agreement",
    "key_cert_sign",
    "crl_sign",
    "encipher_only",
    "decipher_only",
)
"""The bits of a keyUsage, in order (RFC 5280, 4.2.1.3)."""


def key_usage(*usages: str) -> x509.KeyUsage:
    """Return a keyUsage that allows only the named usages (names of `x509.KeyUsage`)."""
    return x509.KeyUsage(**{usage: usage in usages for usage in _USAGES})


def _extended_key_usage(content: bytes) -> x509.ExtendedKeyUsage:
    parts = _values_inside(content)
    if any(part.tag != der.OID for part in parts):
        raise ValueError("not a purpose")
    return x509.ExtendedKeyUsage(ObjectIdentifier(der.decode_oid(p)) for p in parts)


def _name_constraints(content: bytes) -> None:
    if any(part.content for part in _values_inside(content)):
        raise ValueError("not empty")


def _policies(content: bytes) -> None:
    if _values_inside(content):
        raise ValueError("not empty")


def _alternative_names(content: bytes) -> x509.SubjectAlternativeName:
    return x509.SubjectAlternativeName(_names(_values_inside(content)))


def _names(values: Iterable[der.Value]) -> list[x509.GeneralName]:
    names: list[x509.GeneralName] = []
    for value in values:
        if value.tag not in _GENERAL_NAMES:
            raise ValueError("not a GeneralName")
        alone = der.encode(der.SEQUENCE, value.whole)
        try:
            (extension,) = _parse_in_certificate(
                _encoded_extension(ExtensionOID.SUBJECT_ALTERNATIVE_NAME, alone)
            )
            assert isinstance(extension.value, x509.SubjectAlternativeName)
            names += extension.value
        except ValueError:
            names.append(UnreadableName())
    return names


def _authority_key_identifier(content: bytes) -> _LooseKeyIdentifier:
    key, issuer, serial = None, None, None
    for part in _values_inside(content):
        if part.tag == 0x80 and issuer is None and serial is None:
            key = part.content
        elif part.tag == der.CONTEXT_1 and serial is None:
            issuer = _names(der.children(part.content))
        elif part.tag == 0x82:
            serial = int.from_bytes(part.content, "big", signed=True)
        else:
            raise ValueError("not an authorityKeyIdentifier")
    return _LooseKeyIdentifier(key, issuer, serial)


def _distribution_point(content: bytes) -> x509.ExtensionType | None:
    parts = {part.tag: part.content for part in _values_inside(content)}
    if any(len(parts.get(tag, b"?")) != 1 for tag in (_USER, _CA, _INDIRECT, _ATTRIBUTES)):
        raise ValueError("not a flag")
    kinds = [tag for tag in (_USER, _CA, _ATTRIBUTES) if parts.get(tag, b"\0") != b"\0"]
    if len(kinds) > 1:
        return ContradictoryPoint()
    if any(part != b"\0" for part in parts.values()):
        raise ValueError("an issuingDistributionPoint that is not known")
    return None


def _crl_reason(content: bytes) -> x509.CRLReason:
    value = der.first_value(content)
    if value.tag != _ENUMERATED or not value.content:
        raise ValueError("not a reason")
    return x509.CRLReason(x509.ReasonFlags.unspecified)


def _values_inside(content: bytes) -> list[der.Value]:
    return _sequence(der.first_value(content))


_CERTIFICATE_READERS: dict[ObjectIdentifier, _LooseReader] = {
    ExtensionOID.BASIC_CONSTRAINTS: _basic_constraints,
    ExtensionOID.KEY_USAGE: _key_usage,
    ExtensionOID.EXTENDED_KEY_USAGE: _extended_key_usage,
    ExtensionOID.NAME_CONSTRAINTS: _name_constraints,
    ExtensionOID.CERTIFICATE_POLICIES: _policies,
    ExtensionOID.SUBJECT_ALTERNATIVE_NAME: _alternative_names,
    ExtensionOID.AUTHORITY_KEY_IDENTIFIER: _authority_key_identifier,
}
_LIST_READERS: dict[ObjectIdentifier, _LooseReader] = {
    ExtensionOID.AUTHORITY_KEY_IDENTIFIER: _authority_key_identifier,
    ExtensionOID.ISSUING_DISTRIBUTION_POINT: _distribution_point,
}
_ENTRY_READERS: dict[ObjectIdentifier, _LooseReader] = {
    CRLEntryExtensionOID.CRL_REASON: _crl_reason
}
