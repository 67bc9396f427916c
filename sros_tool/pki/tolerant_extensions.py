"""Extensions of certificates and revocation lists that OpenSSL 3.0 reads, `cryptography` does not.

OpenSSL decodes an extension by its ASN.1 template alone (v3_lib.c, X509V3_EXT_d2i): BER will do,
what follows is ignored, and values that contradict each other are no error.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping

from cryptography import x509
from cryptography.x509.oid import CRLEntryExtensionOID, ExtensionOID, ObjectIdentifier

from sros_tool.errors import PkiError
from sros_tool.pki import der

_ENUMERATED = 0x0A
_GENERAL_NAMES = (0xA0, 0x81, 0x82, 0xA3, 0xA4, 0xA5, 0x86, 0x87, 0x88)
"""The tags of the kinds of a GeneralName (RFC 5280, 4.2.1.6)."""
_USER, _CA, _INDIRECT, _ATTRIBUTES = 0x81, 0x82, 0x84, 0x85
"""The tags of the flags of an issuingDistributionPoint (RFC 5280, 5.2.5)."""
DECODED = frozenset(
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
"""What OpenSSL decodes of a certificate before it uses it (v3_purp.c): damaged, it is invalid."""


class _LooseConstraints(x509.BasicConstraints):
    """basicConstraints that may have a path length without being those of a CA."""

    def __init__(self, ca: bool, path_length: int | None) -> None:
        super().__init__(ca, path_length if ca else None)
        self._longest = path_length

    @property
    def path_length(self) -> int | None:
        """The pathLenConstraint."""
        return self._longest


class _LooseKeyIdentifier(x509.AuthorityKeyIdentifier):
    """An authorityKeyIdentifier that may name an issuer without a serial number, or the reverse."""

    def __init__(
        self, key: bytes | None, issuer: list[x509.GeneralName] | None, serial: int | None
    ) -> None:
        super().__init__(key, None, None)
        self._issuer_names, self._serial = issuer, serial

    @property
    def authority_cert_issuer(self) -> list[x509.GeneralName] | None:
        """The names of the CA that issued the certificate of the authority."""
        return self._issuer_names

    @property
    def authority_cert_serial_number(self) -> int | None:
        """The serial number of the certificate of the authority."""
        return self._serial


class UnreadableName(x509.GeneralName):
    """A GeneralName whose value is none of its kind, such as an IP address of one byte."""

    value = None


class ContradictoryPoint(x509.ExtensionType):
    """An issuingDistributionPoint that is only for certificates of two kinds at once."""

    oid = ExtensionOID.ISSUING_DISTRIBUTION_POINT


def of_certificate(parts: Iterable[der.Value]) -> x509.Extensions:
    """Return the extensions of a certificate, given in DER.

    Raises:
        PkiError: a part is not an extension.
    """
    return _read(parts, _in_certificate, _LOOSE_OF_CERTIFICATES)


def of_list(parts: Iterable[der.Value]) -> x509.Extensions:
    """Return the extensions of a revocation list, given in DER; raise as `of_certificate`."""
    return _read(parts, _in_list, _LOOSE_OF_LISTS)


def of_entry(parts: Iterable[der.Value]) -> x509.Extensions:
    """Return the extensions of an entry of a list, given in DER; raise as `of_certificate`."""
    return _read(parts, _in_entry, _LOOSE_OF_ENTRIES)


def is_unread(extension: x509.Extension[x509.ExtensionType]) -> bool:
    """Return whether the value of an extension was not decoded."""
    return isinstance(extension.value, x509.UnrecognizedExtension)


_Strict = Callable[[bytes], x509.Extensions]
_Loose = Callable[[bytes], x509.ExtensionType | None]


def _read(
    parts: Iterable[der.Value], strict: _Strict, loose: Mapping[ObjectIdentifier, _Loose]
) -> x509.Extensions:
    known = [_parts(each) for each in parts]
    count = [oid for oid, _, _ in known]
    extensions = []
    for oid, critical, content in known:
        value: x509.ExtensionType | None = x509.UnrecognizedExtension(oid, content)
        if count.count(oid) == 1:  # one that is there twice is decoded by nobody
            value = _value(oid, content, strict, loose)
        if value is not None:
            extensions.append(x509.Extension(oid, critical, value))
    return x509.Extensions(extensions)


def _parts(extension: der.Value) -> tuple[ObjectIdentifier, bool, bytes]:
    """Return the identifier of an extension, whether it is critical, and its content."""
    identifier, *flag, content = der.children(extension.content)
    tags = (extension.tag, identifier.tag, content.tag, [each.tag for each in flag])
    if tags not in (
        (der.SEQUENCE, der.OID, der.OCTET_STRING, []),
        (der.SEQUENCE, der.OID, der.OCTET_STRING, [der.BOOLEAN]),
    ):
        raise PkiError("an extension has another structure")
    if any(len(each.content) != 1 for each in flag):
        raise PkiError("an extension has a flag that is none")
    oid = ObjectIdentifier(der.decode_oid(identifier.content))
    return oid, any(each.content != b"\0" for each in flag), content.content


def _value(
    oid: ObjectIdentifier,
    content: bytes,
    strict: _Strict,
    loose: Mapping[ObjectIdentifier, _Loose],
) -> x509.ExtensionType | None:
    """Return the value of an extension; None if it says nothing, so that it may be left out."""
    ways: list[Callable[[bytes], x509.ExtensionType | None]] = [
        lambda data: strict(_encoded(oid, data))[0].value
    ]
    if oid in loose:
        ways.append(loose[oid])
    for way in ways:
        try:
            return way(der.normalized(content))
        except (PkiError, ValueError, TypeError, x509.UnsupportedGeneralNameType):
            continue
    return x509.UnrecognizedExtension(oid, content)


def _encoded(oid: ObjectIdentifier, content: bytes) -> bytes:
    identifier = der.encode(der.OID, der.encode_oid(oid.dotted_string))
    return der.encode(der.SEQUENCE, identifier, der.encode(der.OCTET_STRING, content))


# ── what the library reads ─────────────────────────────────────────────────────────────────

_ED25519 = der.encode(der.SEQUENCE, der.encode(der.OID, der.encode_oid("1.3.101.112")))
_NOBODY = der.encode(der.SEQUENCE)
_WHEN = der.encode(der.UTC_TIME, b"260101000000Z")
_BITS = der.encode(der.BIT_STRING, b"\0" * 33)
_ONE = der.encode_integer(1)


def shell(
    *, algorithm: bytes = _ED25519, subject: bytes = _NOBODY, extension: bytes = b""
) -> x509.Certificate:
    """Return a certificate that holds parts of another one, in DER, for `cryptography` to read.

    Raises:
        ValueError: `cryptography` does not read a part.
    """
    extensions = der.encode(0xA3, der.encode(der.SEQUENCE, extension)) if extension else b""
    signed = der.encode(
        der.SEQUENCE,
        der.encode(der.CONTEXT_0, der.encode_integer(2)),
        _ONE,
        algorithm,
        _NOBODY,
        der.encode(der.SEQUENCE, _WHEN, _WHEN),
        subject,
        der.encode(der.SEQUENCE, _ED25519, _BITS),
        extensions,
    )
    return x509.load_der_x509_certificate(der.encode(der.SEQUENCE, signed, algorithm, _BITS))


def _in_certificate(extension: bytes) -> x509.Extensions:
    return shell(extension=extension).extensions


def _list(entry: bytes, extensions: bytes) -> x509.CertificateRevocationList:
    signed = der.encode(der.SEQUENCE, _ONE, _ED25519, _NOBODY, _WHEN, entry, extensions)
    return x509.load_der_x509_crl(der.encode(der.SEQUENCE, signed, _ED25519, _BITS))


def _in_list(extension: bytes) -> x509.Extensions:
    return _list(b"", der.encode(der.CONTEXT_0, der.encode(der.SEQUENCE, extension))).extensions


def _in_entry(extension: bytes) -> x509.Extensions:
    entry = der.encode(der.SEQUENCE, _ONE, _WHEN, der.encode(der.SEQUENCE, extension))
    return next(iter(_list(der.encode(der.SEQUENCE, entry), b""))).extensions


# ── what it does not ───────────────────────────────────────────────────────────────────────


def _basic_constraints(content: bytes) -> _LooseConstraints:
    ca, length = False, None
    parts = _inside(content)
    if parts and parts[0].tag == der.BOOLEAN:
        ca = parts.pop(0).content != b"\0"
    if parts and parts[0].tag == der.INTEGER:
        length = der.integer(parts.pop(0))
    if parts or (length is not None and length < 0):
        raise ValueError("OpenSSL takes it for invalid")
    return _LooseConstraints(ca, length)


def _key_usage(content: bytes) -> x509.KeyUsage:
    value = der.first(content)
    if value.tag != der.BIT_STRING or not value.content or value.content[0] > 7:
        raise ValueError("not a BIT STRING")
    bits = "".join(f"{octet:08b}" for octet in value.content[1:])
    if value.content[0] and bits:  # OpenSSL clears the bits that do not count
        bits = bits[: -value.content[0]]
    flags = [bit == "1" for bit in bits[: len(_USAGES)].ljust(len(_USAGES), "0")]
    usage = dict(zip(_USAGES, flags, strict=True))
    # These say how keys are agreed upon, and the class has them only beside that.
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


def _extended_key_usage(content: bytes) -> x509.ExtendedKeyUsage:
    parts = _inside(content)
    if any(part.tag != der.OID for part in parts):
        raise ValueError("not a purpose")
    return x509.ExtendedKeyUsage(ObjectIdentifier(der.decode_oid(p.content)) for p in parts)


def _name_constraints(content: bytes) -> None:
    if any(each.content for each in _inside(content)):
        raise ValueError("not empty")


def _policies(content: bytes) -> None:
    if _inside(content):
        raise ValueError("not empty")


def _alternative_names(content: bytes) -> x509.SubjectAlternativeName:
    return x509.SubjectAlternativeName(_names(_inside(content)))


def _names(values: Iterable[der.Value]) -> list[x509.GeneralName]:
    names: list[x509.GeneralName] = []
    for value in values:
        if value.tag not in _GENERAL_NAMES:
            raise ValueError("not a GeneralName")
        alone = der.encode(der.SEQUENCE, value.whole)
        try:
            (extension,) = _in_certificate(_encoded(ExtensionOID.SUBJECT_ALTERNATIVE_NAME, alone))
            assert isinstance(extension.value, x509.SubjectAlternativeName)
            names += extension.value
        except ValueError:
            names.append(UnreadableName())
    return names


def _authority_key_identifier(content: bytes) -> _LooseKeyIdentifier:
    key, issuer, serial = None, None, None
    for part in _inside(content):
        if part.tag == 0x80 and issuer is None and serial is None:
            key = part.content
        elif part.tag == der.CONTEXT_1 and serial is None:
            issuer = _names(der.children(part.content))
        elif part.tag == 0x82:
            serial = int.from_bytes(part.content, "big", signed=True)
        else:
            raise ValueError("not an authorityKeyIdentifier")
    return _LooseKeyIdentifier(key, issuer, serial)


def _point(content: bytes) -> x509.ExtensionType | None:
    parts = {part.tag: part.content for part in _inside(content)}
    if any(len(parts.get(tag, b"?")) != 1 for tag in (_USER, _CA, _INDIRECT, _ATTRIBUTES)):
        raise ValueError("not a flag")
    kinds = [tag for tag in (_USER, _CA, _ATTRIBUTES) if parts.get(tag, b"\0") != b"\0"]
    if len(kinds) > 1:
        return ContradictoryPoint()
    if any(part != b"\0" for part in parts.values()):
        raise ValueError("an issuingDistributionPoint that is not known")
    return None


def _reason(content: bytes) -> x509.CRLReason:
    value = der.first(content)
    if value.tag != _ENUMERATED or not value.content:
        raise ValueError("not a reason")
    return x509.CRLReason(x509.ReasonFlags.unspecified)


def _inside(content: bytes) -> list[der.Value]:
    value = der.first(content)
    if value.tag != der.SEQUENCE:
        raise ValueError("not a SEQUENCE")
    return der.children(value.content)


_LOOSE_OF_CERTIFICATES: dict[ObjectIdentifier, _Loose] = {
    ExtensionOID.BASIC_CONSTRAINTS: _basic_constraints,
    ExtensionOID.KEY_USAGE: _key_usage,
    ExtensionOID.EXTENDED_KEY_USAGE: _extended_key_usage,
    ExtensionOID.NAME_CONSTRAINTS: _name_constraints,
    ExtensionOID.CERTIFICATE_POLICIES: _policies,
    ExtensionOID.SUBJECT_ALTERNATIVE_NAME: _alternative_names,
    ExtensionOID.AUTHORITY_KEY_IDENTIFIER: _authority_key_identifier,
}
_LOOSE_OF_LISTS: dict[ObjectIdentifier, _Loose] = {
    ExtensionOID.AUTHORITY_KEY_IDENTIFIER: _authority_key_identifier,
    ExtensionOID.ISSUING_DISTRIBUTION_POINT: _point,
}
_LOOSE_OF_ENTRIES: dict[ObjectIdentifier, _Loose] = {CRLEntryExtensionOID.CRL_REASON: _reason}
