"""Signed documents (``.p7s``): S/MIME multipart/signed with a detached CMS signature.

Every DDS vendor reads this form: CRLF line ends, a first part whose signed bytes begin with the
header ``Content-Type: text/plain``, SHA-256, and the embedded certificate of the signer
(DDS-Security 1.1, 9.4.1.1; OpenSSL ``smime -sign -text``).  Opaque messages, which have the content
inside the signature (``-nodetach``), are read as well, because every vendor accepts them.

A message that OpenSSL rejects is never accepted.  So only MIME headers and boundaries that all
programs read alike are read, and only CMS in DER (tests/integration/forged_signatures.py).
"""

from __future__ import annotations

import base64
import re
import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from functools import lru_cache
from hashlib import sha256
from typing import NamedTuple, TypeVar

from cryptography import x509
from cryptography.exceptions import InvalidSignature, UnsupportedAlgorithm
from cryptography.hazmat.primitives import hashes
from cryptography.hazmat.primitives.asymmetric import ec, padding, rsa
from cryptography.hazmat.primitives.serialization import Encoding

from sros_tool.errors import PkiError, SrosError
from sros_tool.pki import der, tolerant
from sros_tool.pki.certificates import digest as fingerprint
from sros_tool.pki.certificates import is_for_pss, load_der_certificate
from sros_tool.pki.distinguished_names import (
    canonical_der,
    canonical_issuer,
    check_name_der_readable,
)
from sros_tool.pki.keys import PrivateKey
from sros_tool.pki.pem import ENCRYPTED_MESSAGE, SIGNED_MESSAGE, kind_of

_BOM = "\ufeff".encode()
_TEXT_HEADER = b"Content-Type: text/plain\r\n\r\n"

# Accepted MIME headers: those that OpenSSL's reader (asn_mime.c) and RFC 2045 understand alike.
# OpenSSL splits a longer line into several lines.
_FOLDED_LINE = re.compile(rb";[ \t]{0,9}\n[ \t]{1,9}(?=\S)")
_HEADER_FIELD = re.compile(rb"([A-Za-z][A-Za-z-]*):[ \t]{0,9}([!-~](?:[ -~]{0,900}[!-~])?)")
_PARAMETER = rb"""; {0,9}([\w-]+)=("[ !#-'*-\[\]-~]+"|[\w'+,./:=?-]+)"""
_MEDIA_TYPE = re.compile(rb"([\w-]+/[\w-]+)((?:" + _PARAMETER + rb")*)")
_PARAMETERS = re.compile(_PARAMETER)
_BOUNDARY = re.compile(rb"[\w'+,./:=?-]{2,200}")  # OpenSSL ignores a boundary of one character
_BASE64 = re.compile(
    rb"(?:(?:[A-Za-z0-9+/]{4}){1,19}\n)*"
    rb"(?:[A-Za-z0-9+/]{4}){0,18}[A-Za-z0-9+/]{2}(?:[A-Za-z0-9+/]{2}|[A-Za-z0-9+/]=|==)\n*"
)
_OPAQUE_TYPES = (b"application/pkcs7-mime", b"application/x-pkcs7-mime")
_SIGNATURE_TYPES = (b"application/pkcs7-signature", b"application/x-pkcs7-signature")

_MOST_CACHED_BYTES = 1024
_MULTIPART_PIECES = 4
"""Number of pieces between MIME boundaries: a preamble, two parts, and an epilogue."""
_OID_SIGNED_DATA = der.encode_oid("1.2.840.113549.1.7.2")
_OID_DATA = der.encode_oid("1.2.840.113549.1.7.1")
_OID_CONTENT_TYPE = der.encode_oid("1.2.840.113549.1.9.3")
_OID_SIGNING_TIME = der.encode_oid("1.2.840.113549.1.9.5")
_OID_SMIME_CAPABILITIES = der.encode_oid("1.2.840.113549.1.9.15")
_OID_MESSAGE_DIGEST = der.encode_oid("1.2.840.113549.1.9.4")
_NULL_TAG = 0x05
_ANY_VALUES = (
    der.SEQUENCE, der.OCTET_STRING, der.UTC_TIME, der.GENERALIZED_TIME, _NULL_TAG
)  # fmt: skip
"""Types of values in attributes and parameters that OpenSSL re-encodes without any change."""


_DIGESTS: dict[bytes, hashes.HashAlgorithm] = {
    der.encode_oid(oid): algorithm
    for algorithm, oid in (
        (hashes.SHA256(), "2.16.840.1.101.3.4.2.1"),
        (hashes.SHA384(), "2.16.840.1.101.3.4.2.2"),
        (hashes.SHA512(), "2.16.840.1.101.3.4.2.3"),
        (hashes.SHA512_256(), "2.16.840.1.101.3.4.2.6"),
        (hashes.SHA3_256(), "2.16.840.1.101.3.4.2.8"),
        (hashes.SHA3_384(), "2.16.840.1.101.3.4.2.9"),
        (hashes.SHA3_512(), "2.16.840.1.101.3.4.2.10"),
        # This hash is read but never written, because it is weak.
        (hashes.SHA224(), "2.16.840.1.101.3.4.2.4"),
        (hashes.SHA512_224(), "2.16.840.1.101.3.4.2.5"),
        (hashes.SHA3_224(), "2.16.840.1.101.3.4.2.7"),
        (hashes.SHA1(), "1.3.14.3.2.26"),  # noqa: S303
        (hashes.MD5(), "1.2.840.113549.2.5"),  # noqa: S303
    )
}
"""Maps an OID to the hash of a signature.

Some releases of OpenSSL also use the OIDs of signatures with RSA in this place.
"""


def sign(document: bytes, certificate: x509.Certificate, key: PrivateKey) -> bytes:
    """Return ``document`` as an S/MIME message, signed with the ``key`` of ``certificate``."""
    import secrets  # only signing needs this import, and most runs only read

    content = _TEXT_HEADER + document.replace(b"\r\n", b"\n").replace(b"\n", b"\r\n")
    boundary = b"----" + secrets.token_hex(16).upper().encode()
    encoded = base64.encodebytes(_detached_signature(content, certificate, key)).replace(
        b"\n", b"\r\n"
    )
    return b"".join((
        b"MIME-Version: 1.0\r\n"
        b'Content-Type: multipart/signed; protocol="application/x-pkcs7-signature"; '
        b'micalg="sha-256"; boundary="', boundary, b'"\r\n\r\n'
        b"This is an S/MIME signed message\r\n\r\n--", boundary, b"\r\n",
        content,
        b"\r\n--", boundary, b"\r\n"
        b'Content-Type: application/x-pkcs7-signature; name="smime.p7s"\r\n'
        b"Content-Transfer-Encoding: base64\r\n"
        b'Content-Disposition: attachment; filename="smime.p7s"\r\n\r\n',
        encoded,
        b"\r\n--", boundary, b"--\r\n\r\n",
    ))  # fmt: skip


def _detached_signature(content: bytes, certificate: x509.Certificate, key: PrivateKey) -> bytes:
    """Return a detached CMS signature of ``content`` in DER (RFC 5652, 5.1 and 5.3).

    The form is the same as by `cryptography` from release 42 on; earlier releases write the S/MIME
    capabilities in a form that differs from RFC 8551, 2.5.2.  The attributes are in the order of a
    DER set.
    """
    certificate_der, issuer_and_serial = _signer_parts(certificate)
    attributes = b"".join((
        _TYPE_OF_DATA,
        _attribute(_OID_SIGNING_TIME, der.encode(der.UTC_TIME, _signing_time())),
        _attribute(_OID_MESSAGE_DIGEST, der.encode(der.OCTET_STRING, sha256(content).digest())),
        _CAPABILITIES,
    ))  # fmt: skip
    signed = der.encode(der.SET, attributes)
    if isinstance(key, ec.EllipticCurvePrivateKey):
        algorithm, value = _ECDSA_SHA256, key.sign(signed, ec.ECDSA(hashes.SHA256()))
    else:
        algorithm, value = _RSA, key.sign(signed, padding.PKCS1v15(), hashes.SHA256())
    signer = der.encode(
        der.SEQUENCE,
        der.encode_integer(1),
        issuer_and_serial,
        _SHA256,
        der.encode(der.CONTEXT_0, attributes),
        algorithm,
        der.encode(der.OCTET_STRING, value),
    )
    signed_data = der.encode(
        der.SEQUENCE,
        der.encode_integer(1),
        der.encode(der.SET, _SHA256),
        der.encode(der.SEQUENCE, der.encode(der.OID, _OID_DATA)),
        der.encode(der.CONTEXT_0, certificate_der),
        der.encode(der.SET, signer),
    )
    wrapped = der.encode(der.CONTEXT_0, signed_data)
    return der.encode(der.SEQUENCE, der.encode(der.OID, _OID_SIGNED_DATA), wrapped)


def _signing_time() -> bytes:
    """Return the current time as a UTCTime, for the signing time, which no reader uses."""
    return time.strftime("%y%m%d%H%M%SZ", time.gmtime()).encode()


@lru_cache(maxsize=16)
def _signer_parts(certificate: x509.Certificate) -> tuple[bytes, bytes]:
    """Return a signer's certificate in DER, and its IssuerAndSerialNumber."""
    certificate_der = certificate.public_bytes(Encoding.DER)
    parts = der.children(der.first_value(certificate.tbs_certificate_bytes).content)
    serial, _, issuer = parts[parts[0].tag == der.CONTEXT_0 :][:3]
    return certificate_der, der.encode(der.SEQUENCE, issuer.whole, serial.whole)


def _algorithm(dotted: str, *parameters: bytes) -> bytes:
    """Encode an AlgorithmIdentifier."""
    return der.encode(der.SEQUENCE, der.encode(der.OID, der.encode_oid(dotted)), *parameters)


def _attribute(kind: bytes, value: bytes) -> bytes:
    """Encode an attribute with one value; ``kind`` is the content of the attribute's OID."""
    return der.encode(der.SEQUENCE, der.encode(der.OID, kind), der.encode(der.SET, value))


_SHA256 = _algorithm("2.16.840.1.101.3.4.2.1", der.encode(_NULL_TAG))
_ECDSA_SHA256 = _algorithm("1.2.840.10045.4.3.2")
_RSA = _algorithm("1.2.840.113549.1.1.1", der.encode(_NULL_TAG))
_TYPE_OF_DATA = _attribute(_OID_CONTENT_TYPE, der.encode(der.OID, _OID_DATA))
_AES_CBC = [_algorithm(f"2.16.840.1.101.3.4.1.{number}") for number in (42, 22, 2)]
_CAPABILITIES = _attribute(_OID_SMIME_CAPABILITIES, der.encode(der.SEQUENCE, *_AES_CBC))
"""The S/MIME capabilities: AES-CBC with keys of 256, 192 and 128 bits."""


@dataclass(frozen=True, slots=True, eq=False)
class Signature:
    """A signature in a signed message; ``digest`` is the hash algorithm."""

    digest: hashes.HashAlgorithm
    _signed_attributes: bytes
    _message_digest: bytes
    _value: bytes
    _issuer_and_serial: tuple[tuple[bytes, ...], int]
    _verified: dict[tuple[bytes, x509.Certificate], bool] = field(default_factory=dict)

    def signer_among(self, certificates: Iterable[x509.Certificate]) -> x509.Certificate | None:
        """Return the first certificate with the signer's issuer and serial number, or None."""
        issuer, serial = self._issuer_and_serial
        for certificate in certificates:
            if certificate.serial_number == serial and canonical_issuer(certificate) == issuer:
                return certificate
        return None

    def digest_matches(self, content: bytes) -> bool:
        """Return whether the messageDigest attribute is the digest of ``content``."""
        digest = hashes.Hash(self.digest)
        digest.update(content)
        return digest.finalize() == self._message_digest

    def is_intact(self, content: bytes, signer: x509.Certificate) -> bool:
        """Return whether the signature of ``content`` verifies with the key of ``signer``.

        The result is cached, because every vendor asks for it.
        """
        known = self._verified.get((content, signer))
        if known is None:
            known = self._verified[content, signer] = self._verify(content, signer)
        return known

    def _verify(self, content: bytes, signer: x509.Certificate) -> bool:
        """Return whether the signature verifies, without using the cache of `is_intact`.

        As in OpenSSL, the kind of the key decides the algorithm; the algorithm that the message
        names is ignored.  So RSA-PSS is accepted only from keys that are restricted to RSA-PSS, and
        Ed25519 never (pk7_doit.c, PKCS7_signatureVerify).
        """
        if self._signed_attributes and not self.digest_matches(content):
            return False
        signed = self._signed_attributes or content
        key = _public_key(signer)
        try:
            if isinstance(key, ec.EllipticCurvePublicKey):
                key.verify(self._value, signed, ec.ECDSA(self.digest))
            elif isinstance(key, rsa.RSAPublicKey):
                key.verify(self._value, signed, _padding(signer, self.digest), self.digest)
            else:
                return False
        except (InvalidSignature, UnsupportedAlgorithm, ValueError):
            return False
        return True


class SignedDocument(NamedTuple):
    """A parsed ``.p7s`` file; do not trust the content before `verify`.

    ``content`` is the signed part, with CRLF line ends and the MIME header; ``document`` is the
    same without the header.  ``certificates`` are the embedded certificates.  OpenSSL, and so every
    vendor, verifies all ``signatures`` of a document, which usually has one.
    """

    content: bytes
    document: bytes
    certificates: tuple[x509.Certificate, ...]
    signatures: tuple[Signature, ...]

    @property
    def text(self) -> bytes:
        """The document with LF line ends, as before signing (S/MIME uses CRLF)."""
        return self.document.replace(b"\r\n", b"\n")

    @property
    def digest(self) -> str:
        """The name of the weakest hash algorithm among the signatures."""
        return min((signature.digest for signature in self.signatures), key=_digest_bits).name

    def signer(self) -> x509.Certificate | None:
        """Return the first signer's certificate; None if the certificate is not embedded."""
        return self.signatures[0].signer_among(self.certificates)

    def verify(self, authority: x509.Certificate) -> None:
        """Verify that ``authority`` signed this document, and that nobody else signed it.

        Cyclone DDS 0.10.2 and Fast DDS 2.9.1 are less strict: they accept any signer with a chain
        to the authority (the CVE-2023-24011 class; both tested).

        Raises:
            PkiError: another certificate also signed the document, a signature does not match the
                content, or a signature uses MD5.
        """
        for signature in self.signatures:
            signer = signature.signer_among(self.certificates)
            if signer is None or signer != authority:
                raise PkiError(f"it is signed {_wrong_signer_clause(signer, authority)}")
            if not signature.is_intact(self.content, signer):
                raise PkiError(
                    "its signature does not match its content",
                    "The document was changed after it was signed, or its signature is damaged.",
                )
            if isinstance(signature.digest, hashes.MD5):  # noqa: S303 - it is refused
                raise PkiError("it is signed with MD5", "Such a signature can be forged.")

    def problem_for(self, authorities: Iterable[x509.Certificate]) -> str:
        """Return why no permissions CA in ``authorities`` signed this document; "" if one did."""
        problem = "no permissions CA is trusted"
        for authority in authorities:
            try:
                self.verify(authority)
                return ""
            except SrosError as error:
                problem = str(error)
        return problem

    def weakness(self) -> str:
        """Return the weak hash of a signature as a clause, or "" if no hash is weak."""
        weak = any(
            _digest_bits(signature.digest) < _digest_bits(hashes.SHA256())
            for signature in self.signatures
        )
        return f"it has a weak signature, with {self.digest.upper()}" if weak else ""

    def digest_matches(self) -> bool:
        """Return whether every messageDigest attribute is the digest of the content."""
        return all(signature.digest_matches(self.content) for signature in self.signatures)


def _wrong_signer_clause(signer: x509.Certificate | None, authority: x509.Certificate) -> str:
    """Return a clause about the wrong signer; None stands for a signer without a certificate."""
    name = authority.subject.rfc4514_string()
    if signer is None:
        lacks = "by a signer whose certificate the document lacks"
        return f"not by the permissions CA {name}, but {lacks}"
    if signer.subject != authority.subject:
        return f"by {signer.subject.rfc4514_string()}, not by the permissions CA {name}"
    same_key = _public_key(signer) == _public_key(authority)
    how = "an earlier or later certificate of the permissions CA" if same_key else "another CA"
    return (
        f"by {how} named {name} (SHA-256 {fingerprint(signer)[:8]}), not by the permissions CA "
        f"of the enclave (SHA-256 {fingerprint(authority)[:8]})"
    )


def _padding(signer: x509.Certificate, digest: hashes.HashAlgorithm) -> padding.AsymmetricPadding:
    if is_for_pss(signer):
        return padding.PSS(padding.MGF1(digest), padding.PSS.AUTO)
    return padding.PKCS1v15()


def _digest_bits(algorithm: hashes.HashAlgorithm) -> int:
    return 8 * algorithm.digest_size


_Part = TypeVar("_Part", bytes, der.Value)
_Result = TypeVar("_Result")


def _cached(read: Callable[[_Part], _Result]) -> Callable[[_Part], _Result]:
    """Cache a parser's results for short parts, which many files of a keystore share."""
    remembered = lru_cache(maxsize=64)(read)

    def read_or_remember(part: _Part) -> _Result:
        size = len(part if isinstance(part, bytes) else part.whole)
        return remembered(part) if size <= _MOST_CACHED_BYTES else read(part)

    return read_or_remember


@lru_cache(maxsize=8)  # several callers parse the same document in a row
def parse(message: bytes) -> SignedDocument:
    """Parse a ``.p7s`` without verifying it; raise `PkiError` if it is not a signed message."""
    return parse_new(message)


def parse_new(message: bytes) -> SignedDocument:
    """Return a message that was just signed, parsed as by `parse` but without the cache."""
    content, signature = _split(message)
    try:
        return _parse_cms(signature, content)
    except (IndexError, ValueError, PkiError) as error:
        if kind_of(signature) == ENCRYPTED_MESSAGE:
            raise PkiError(f"it is {ENCRYPTED_MESSAGE}") from error
        if isinstance(error, PkiError):
            raise
        raise PkiError("its signature is not a readable CMS signature") from error


def _without_text_header(content: bytes) -> bytes:
    header, separator, document = content.partition(b"\r\n\r\n")
    kind, _ = _media_type(header.replace(b"\r\n", b"\n"))
    if not separator or kind != b"text/plain":
        raise PkiError(
            "its signed part has no MIME header text/plain",
            "DDS vendors accept only documents that are signed with this header "
            "(openssl smime -sign -text).",
        )
    return document


@_cached
def _media_type(header: bytes) -> tuple[bytes, Mapping[bytes, bytes]]:
    """Return the type in a MIME header, in lower case, and the parameters.

    The type is empty if the header has no type or several types, or if programs read one of the
    lines in different ways.
    """
    fields = [
        _HEADER_FIELD.fullmatch(line) for line in _FOLDED_LINE.sub(b"; ", header).split(b"\n")
    ]
    named = [field[2] for field in fields if field and field[1].lower() == b"content-type"]
    kind = _MEDIA_TYPE.fullmatch(named[0]) if len(named) == 1 and all(fields) else None
    if not kind:
        return b"", {}
    pairs = _PARAMETERS.findall(kind[2])
    parameters = {name.lower(): value.strip(b'"') for name, value in pairs}
    return (kind[1].lower(), parameters) if len(parameters) == len(pairs) else (b"", {})


def _split(message: bytes) -> tuple[bytes | None, bytes]:
    """Return the signed part, with CRLF line ends, and the signature in DER.

    The signed part is None for an opaque message, where it is inside the signature.
    """
    text = message.replace(b"\r\n", b"\n")
    if b"\r" in text or b"\0" in text:
        if (form := kind_of(message)) not in ("", SIGNED_MESSAGE):
            raise PkiError("it is not an S/MIME signed message", f"It is {form}.")
        raise PkiError(
            "it has a zero byte, or a line end that programs read in different ways",
            "The lines of a signed document end with CR and LF, or with LF.",
        )
    head, _, body = text.partition(b"\n\n")
    if head.startswith(_BOM) and not head[len(_BOM) :].lower().startswith(b"content-type"):
        # OpenSSL reads the byte order mark as part of the first header's name.
        head = head[len(_BOM) :]
    kind, parameters = _media_type(head)
    if kind in _OPAQUE_TYPES:
        return None, _decoded(body)
    boundary = parameters.get(b"boundary", b"")
    if kind != b"multipart/signed" or not _BOUNDARY.fullmatch(boundary):
        raise PkiError(
            "it is not an S/MIME signed message",
            "A signed document begins with MIME headers of the type multipart/signed; "
            f"this is {kind_of(message) or 'something else'}.",
        )
    # Boundaries inside a line split, too: OpenSSL reads a long line in pieces, and each piece may
    # begin a part.
    parts = (b"\n" + body + b"\n").split(b"--" + boundary)
    if len(parts) != _MULTIPART_PIECES or not (
        parts[0].endswith(b"\n")
        and all(part.startswith(b"\n") and part.endswith(b"\n") for part in parts[1:-1])
        and parts[-1].startswith(b"--\n")
    ):
        raise PkiError("it is not one signed part followed by one signature")
    header, _, encoded = parts[2][1:-1].partition(b"\n\n")
    if _media_type(header)[0] not in _SIGNATURE_TYPES or not encoded:
        raise PkiError("it has no signature")
    return parts[1][1:-1].replace(b"\n", b"\r\n"), _decoded(encoded)


def _decoded(encoded: bytes) -> bytes:
    if not _BASE64.fullmatch(encoded):
        raise PkiError("its signature is not valid base64")
    return base64.b64decode(encoded.replace(b"\n", b""), validate=True)


# Cached, because all documents of a keystore embed the certificate of the permissions CA.
_certificate = lru_cache(maxsize=16)(load_der_certificate)


@lru_cache(maxsize=16)
def _public_key(certificate: x509.Certificate) -> object:
    return certificate.public_key()


def _checked_parts(value: der.Value, *tags: int) -> list[der.Value]:
    """Return the values in a constructed value; raise `ValueError` unless they have ``tags``."""
    parts = der.children(value.content)
    if tuple(part.tag for part in parts) != tags:
        raise ValueError("not the structure of a CMS signature")
    return parts


def _take_optional(values: list[der.Value], place: int, tag: int) -> list[der.Value]:
    """Remove ``values[place]`` and return it in a list; return [] if it does not have the tag."""
    return [values.pop(place)] if len(values) > place and values[place].tag == tag else []


@_cached
def _digest_of(identifier: der.Value) -> hashes.HashAlgorithm | None:
    """Return the hash that an AlgorithmIdentifier names, or None if sros does not know it.

    As in OpenSSL, the parameters of the algorithm are ignored.
    """
    oid, *parameters = der.children(identifier.content)
    if (identifier.tag, oid.tag) != (der.SEQUENCE, der.OID) or len(parameters) > 1:
        raise ValueError("not an algorithm")
    _check_values(oid, *parameters)
    return _DIGESTS.get(oid.content)


def _parse_cms(signature: bytes, content: bytes | None) -> SignedDocument:
    """Parse a ContentInfo with SignedData (RFC 2315, 7 and 9; RFC 5652, 3, 5.1 and 5.3).

    Only DER is read, because OpenSSL and sros might read other encodings differently.  Version
    numbers are ignored, as by OpenSSL.  Without ``content``, the signed part is taken from the
    SignedData.
    """
    (message,) = der.children(signature)
    content_type, wrapped = _checked_parts(message, der.OID, der.CONTEXT_0)
    (signed_data,) = _checked_parts(wrapped, der.SEQUENCE)
    if message.tag != der.SEQUENCE or content_type.content != _OID_SIGNED_DATA:
        raise ValueError("not SignedData")
    fields = der.children(signed_data.content)
    certificate_sets = _take_optional(fields, 3, der.CONTEXT_0)
    lists = _take_optional(fields, 3, der.CONTEXT_1)
    if [value.tag for value in fields] != [der.INTEGER, der.SET, der.SEQUENCE, der.SET]:
        raise ValueError("not the fields of SignedData")
    version, digests, encapsulated, signers = fields
    der.integer(version)
    kind, *contained = der.children(encapsulated.content)
    if (kind.tag, kind.content) != (der.OID, _OID_DATA):
        raise ValueError("not a signature of data")
    inside = [_octet_string(value) for value in contained]
    if len(inside) > 1 or (content is None and not inside):
        raise ValueError("several contents, or none")
    if content is None:
        (content,) = inside
    for unused in (value for crl_set in lists for value in der.split_all(crl_set.content)):
        tolerant.check_list(unused)  # OpenSSL reads the list, but does not use it
    embedded = [
        value
        for certificate_set in certificate_sets
        for value in der.split_all(certificate_set.content)
    ]
    listed = [_digest_of(child) for child in der.children(digests.content)]
    if None in listed:
        raise ValueError("unknown digest")
    signatures = tuple(_signature(child) for child in der.children(signers.content))
    if not signatures or any(signature.digest not in listed for signature in signatures):
        raise ValueError("no signature, or a digest other than the announced one")
    return SignedDocument(
        content=content,
        document=_without_text_header(content),
        certificates=tuple(map(_certificate, embedded)),
        signatures=signatures,
    )


def _octet_string(octet_string: der.Value) -> bytes:
    (octets,) = _checked_parts(octet_string, der.OCTET_STRING)
    if octet_string.tag != der.CONTEXT_0:
        raise ValueError("no content")
    return octets.content


def _signature(signer: der.Value) -> Signature:
    """Return the signature of a SignerInfo that names its signer by issuer and serial number."""
    info = der.children(signer.content)
    attributes = _take_optional(info, 3, der.CONTEXT_0)
    unsigned = _take_optional(info, 5, der.CONTEXT_1)
    if signer.tag != der.SEQUENCE or [value.tag for value in info] != [
        *(der.INTEGER, der.SEQUENCE, der.SEQUENCE, der.SEQUENCE, der.OCTET_STRING)
    ]:
        raise ValueError("not the fields of SignerInfo")
    version, identifier, digest, algorithm, value = info
    der.integer(version)
    named = _digest_of(digest)
    if named is None:
        raise ValueError("unknown digest")
    _digest_of(algorithm)
    for attribute in unsigned:
        _attributes(attribute.content)
    contents = [_attributes(attribute.content) for attribute in attributes]
    return Signature(
        named,
        # The signature covers the attributes with the tag SET, not with their tag in SignerInfo.
        b"".join(b"\x31" + attribute.whole[1:] for attribute in attributes if attribute.content),
        b"".join(map(_message_digest, contents)),
        value.content,
        _issuer_and_serial(identifier),
    )


@_cached
def _issuer_and_serial(identifier: der.Value) -> tuple[tuple[bytes, ...], int]:
    issuer, serial = _checked_parts(identifier, der.SEQUENCE, der.INTEGER)
    check_name_der_readable(issuer.whole)
    return canonical_der(issuer.whole), der.integer(serial)


def _check_values(*values: der.Value) -> None:
    """Raise `ValueError` if OpenSSL might refuse one of the values, or read it differently."""
    for value in values:
        if value.tag == der.OID:
            der.decode_oid(value)  # raises an error if OpenSSL refuses it
        elif value.tag not in _ANY_VALUES or (value.tag == _NULL_TAG and value.content):
            raise ValueError("not a value of an attribute or parameter")


def _attributes(attributes: bytes) -> dict[bytes, der.Value]:
    """Map the types of attributes to their first values; check all attributes (RFC 5652, 11)."""
    by_kind: dict[bytes, der.Value] = {}
    for attribute in der.children(attributes):
        name, values = _checked_parts(attribute, der.OID, der.SET)
        (value,) = der.children(values.content)
        if attribute.tag != der.SEQUENCE:
            raise ValueError("not an attribute")
        _check_values(name, value)
        by_kind.setdefault(name.content, value)
    return by_kind


def _message_digest(attributes: Mapping[bytes, der.Value]) -> bytes:
    if not attributes:
        return b""
    digest = attributes.get(_OID_MESSAGE_DIGEST)
    if digest is None or digest.tag != der.OCTET_STRING:
        raise ValueError("no message digest")
    return digest.content
