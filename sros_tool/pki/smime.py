"""Signed documents (``.p7s``): S/MIME multipart/signed with a detached CMS signature.

Every DDS vendor reads this form: CRLF line ends, a first part whose signed bytes begin with the
header ``Content-Type: text/plain``, SHA-256, and the embedded certificate of the signer
(DDS-Security 1.1, 9.4.1.1; OpenSSL ``smime -sign -text``).  Opaque messages, which have the content
inside the signature (``-nodetach``), are read as well, because every vendor accepts them.

What OpenSSL rejects is never accepted: of MIME, only headers and boundaries that all programs read
in the same way are read, and of CMS, only DER (tests/integration/forged_signatures.py).
"""

from __future__ import annotations

import base64
import re
import secrets
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple, TypeVar

from cryptography import x509
from cryptography.exceptions import InvalidSignature, UnsupportedAlgorithm
from cryptography.hazmat.primitives import hashes
from cryptography.hazmat.primitives.asymmetric import ec, padding, rsa
from cryptography.hazmat.primitives.serialization import Encoding, pkcs7

from sros_tool.errors import PkiError
from sros_tool.pki import der
from sros_tool.pki.certificates import load_der_certificate
from sros_tool.pki.keys import PrivateKey

_BOM = "\ufeff".encode()
_TEXT_HEADER = b"Content-Type: text/plain\r\n\r\n"
_OPTIONS = (pkcs7.PKCS7Options.DetachedSignature, pkcs7.PKCS7Options.Binary)

# The grammar of the MIME headers that are read: what OpenSSL's reader (asn_mime.c) and RFC 2045
# understand in the same way.  A longer line is read by OpenSSL as several lines.
_FOLD = re.compile(rb";[ \t]{0,9}\n[ \t]{1,9}(?=\S)")
_FIELD = re.compile(rb"([A-Za-z][A-Za-z-]*):[ \t]{0,9}([!-~](?:[ -~]{0,900}[!-~])?)")
_PARAMETER = rb"""; {0,9}([\w-]+)=("[ !#-'*-\[\]-~]+"|[\w'+,./:=?-]+)"""
_TYPE = re.compile(rb"([\w-]+/[\w-]+)((?:" + _PARAMETER + rb")*)")
_PARAMETERS = re.compile(_PARAMETER)
_BOUNDARY = re.compile(rb"[\w'+,./:=?-]{2,200}")  # OpenSSL reads no boundary of one character
_BASE64 = re.compile(
    rb"(?:(?:[A-Za-z0-9+/]{4}){1,19}\n)*"
    rb"(?:[A-Za-z0-9+/]{4}){0,18}[A-Za-z0-9+/]{2}(?:[A-Za-z0-9+/]{2}|[A-Za-z0-9+/]=|==)\n*"
)
_OPAQUE = (b"application/pkcs7-mime", b"application/x-pkcs7-mime")
_SIGNATURE = (b"application/pkcs7-signature", b"application/x-pkcs7-signature")

_SHORT = 1024
_PARTS = 4
"""What the marks of a signed message separate: a preamble, two parts, and an epilogue."""
_VERSION = b"\x02\x01\x01"
_NULL = b"\x05\x00"
_SIGNED_DATA = der.encode_oid("1.2.840.113549.1.7.2")
_DATA = der.encode_oid("1.2.840.113549.1.7.1")
_CONTENT_TYPE = der.encode_oid("1.2.840.113549.1.9.3")
_MESSAGE_DIGEST = der.encode_oid("1.2.840.113549.1.9.4")
_RSA = der.encode_oid("1.2.840.113549.1.1.1")
_ATTRIBUTE_VALUES = (der.SEQUENCE, der.OCTET_STRING, der.OID, der.UTC_TIME, der.GENERALIZED_TIME)
_OID = re.compile(rb"(?:(?:[\x81-\xff][\x80-\xff]*)?[\x00-\x7f])+")


class _Digest(NamedTuple):
    """A hash algorithm, and the OIDs of the signatures with it by RSA and by ECDSA keys."""

    algorithm: hashes.HashAlgorithm
    rsa: bytes
    ecdsa: bytes


_DIGESTS = {
    der.encode_oid(digest): _Digest(algorithm, der.encode_oid(by_rsa), der.encode_oid(by_ecdsa))
    for digest, algorithm, by_rsa, by_ecdsa in (
        ("2.16.840.1.101.3.4.2.1", hashes.SHA256(), "1.2.840.113549.1.1.11", "1.2.840.10045.4.3.2"),
        ("2.16.840.1.101.3.4.2.2", hashes.SHA384(), "1.2.840.113549.1.1.12", "1.2.840.10045.4.3.3"),
        ("2.16.840.1.101.3.4.2.3", hashes.SHA512(), "1.2.840.113549.1.1.13", "1.2.840.10045.4.3.4"),
        # Read, never written.
        ("1.3.14.3.2.26", hashes.SHA1(), "1.2.840.113549.1.1.5", "1.2.840.10045.4.1"),  # noqa: S303
    )
}


def sign(document: bytes, certificate: x509.Certificate, key: PrivateKey) -> bytes:
    """Return the S/MIME message of ``document``, signed with ``key`` of ``certificate``."""
    content = _TEXT_HEADER + document.replace(b"\r\n", b"\n").replace(b"\n", b"\r\n")
    signature = (
        pkcs7.PKCS7SignatureBuilder()
        .set_data(content)
        .add_signer(certificate, key, hashes.SHA256())
        .sign(Encoding.DER, _OPTIONS)
    )
    boundary = b"----" + secrets.token_hex(16).upper().encode()
    encoded = base64.encodebytes(signature).replace(b"\n", b"\r\n")
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


@dataclass(frozen=True, slots=True)
class SignedDocument:
    """A parsed ``.p7s``; do not trust its content before `verify`.

    ``content`` is the signed part, with CRLF line ends and the MIME header; ``document`` is the
    same without the header.  ``certificates`` are the embedded certificates.  ``digest`` is the
    name of the hash algorithm.
    """

    content: bytes
    document: bytes
    certificates: tuple[x509.Certificate, ...]
    digest: str
    _digest_algorithm: _Digest
    _signature_algorithm: der.Value
    _signed_attributes: bytes
    _message_digest: bytes
    _signature: bytes
    _issuer_and_serial: tuple[bytes, int]

    @property
    def text(self) -> bytes:
        """The document with LF line ends, as it was before it was signed: S/MIME has CRLF."""
        return self.document.replace(b"\r\n", b"\n")

    def signer(self) -> x509.Certificate | None:
        """Return the signer's certificate, or None if it is not embedded."""
        return self.signer_among(self.certificates)

    def signer_among(self, certificates: Iterable[x509.Certificate]) -> x509.Certificate | None:
        """Return the signer's certificate by issuer and serial number, or None.

        OpenSSL compares the issuers' names in a looser way, and takes the first that fits: where
        several certificates have the serial number, none is the signer's.
        """
        issuer, serial = self._issuer_and_serial
        found = {each for each in certificates if each.serial_number == serial}
        if len(found) != 1 or (signer := found.pop()).issuer.public_bytes() != issuer:
            return None
        return signer

    def verify(self, authority: x509.Certificate) -> None:
        """Verify that ``authority`` itself signed this document.

        Stricter than Cyclone DDS 0.10.2 and Fast DDS 2.9.1, which accept any signer with a chain to
        the authority (the CVE-2023-24011 class; both measured).

        Raises:
            PkiError: another certificate signed it, or its signature does not match its content.
        """
        signer = self.signer()
        if signer is None or signer != authority:
            who = (
                f"by {signer.subject.rfc4514_string()}"
                if signer
                else "by a certificate that is not embedded"
            )
            raise PkiError(
                f"it is signed {who}, not by the permissions CA "
                f"{authority.subject.rfc4514_string()}"
            )
        if not self.is_intact(signer):
            raise PkiError(
                "its signature does not match its content",
                "The document was changed after it was signed, or its signature is damaged.",
            )

    def weakness(self) -> str:
        """Return the weak hash of the signature as a clause, or ""."""
        weak = self._digest_algorithm.algorithm.digest_size < hashes.SHA256.digest_size
        return f"it has a weak signature, with {self.digest.upper()}" if weak else ""

    def digest_matches(self) -> bool:
        """Return whether the messageDigest attribute is the digest of the content."""
        digest = hashes.Hash(self._digest_algorithm.algorithm)
        digest.update(self.content)
        return digest.finalize() == self._message_digest

    def is_intact(self, signer: x509.Certificate) -> bool:
        """Return whether the signature verifies with the key of ``signer``."""
        if self._signed_attributes and not self.digest_matches():
            return False
        signed = self._signed_attributes or self.content
        key, digest = _public_key(signer), self._digest_algorithm
        try:
            if isinstance(key, ec.EllipticCurvePublicKey):
                if _algorithm(self._signature_algorithm) != digest.ecdsa:
                    return False
                key.verify(self._signature, signed, ec.ECDSA(digest.algorithm))
            elif isinstance(key, rsa.RSAPublicKey):
                if _algorithm(self._signature_algorithm) not in (_RSA, digest.rsa):
                    return False
                key.verify(self._signature, signed, padding.PKCS1v15(), digest.algorithm)
            else:
                return False
        except (InvalidSignature, UnsupportedAlgorithm, ValueError):
            return False
        return True


_Part = TypeVar("_Part", bytes, der.Value)
_Read = TypeVar("_Read")


def _remembered(read: Callable[[_Part], _Read]) -> Callable[[_Part], _Read]:
    """Have what was read from short parts remembered: all documents of a keystore have the same."""
    remembered = lru_cache(maxsize=64)(read)

    def read_or_remember(part: _Part) -> _Read:
        size = len(part if isinstance(part, bytes) else part.whole)
        return remembered(part) if size <= _SHORT else read(part)

    return read_or_remember


@lru_cache(maxsize=8)  # several callers parse the same document in a row
def parse(message: bytes) -> SignedDocument:
    """Parse a ``.p7s`` without verifying it; raise `PkiError` if it is not a signed message."""
    content, signature = _split(message)
    try:
        return _parse_cms(signature, content)
    except (IndexError, ValueError) as error:
        raise PkiError("its signature is not a readable CMS signature") from error


def _document(content: bytes) -> bytes:
    header, separator, document = content.partition(b"\r\n\r\n")
    kind, _ = _media_type(header.replace(b"\r\n", b"\n"))
    if not separator or kind != b"text/plain":
        raise PkiError(
            "its signed part has no MIME header text/plain",
            "DDS vendors accept only documents that are signed with this header "
            "(openssl smime -sign -text).",
        )
    return document


@_remembered
def _media_type(header: bytes) -> tuple[bytes, Mapping[bytes, bytes]]:
    """Return the type in a MIME header, in lower case, and its parameters.

    Return an empty type if the header has none or several, or if any of its lines has a form that
    programs read in different ways.
    """
    fields = [_FIELD.fullmatch(line) for line in _FOLD.sub(b"; ", header).split(b"\n")]
    named = [found[2] for found in fields if found and found[1].lower() == b"content-type"]
    kind = _TYPE.fullmatch(named[0]) if len(named) == 1 and all(fields) else None
    if not kind:
        return b"", {}
    pairs = _PARAMETERS.findall(kind[2])
    parameters = {name.lower(): value.strip(b'"') for name, value in pairs}
    return (kind[1].lower(), parameters) if len(parameters) == len(pairs) else (b"", {})


def _split(message: bytes) -> tuple[bytes | None, bytes]:
    """Return the signed part, with CRLF line ends, and the signature in DER.

    The signed part is None for an opaque message, which has it inside the signature.
    """
    text = message.replace(b"\r\n", b"\n")
    if b"\r" in text or b"\0" in text:
        raise PkiError(
            "it has a line end, or a zero byte, that programs read in different ways",
            "The lines of a signed document end with CR and LF, or with LF.",
        )
    head, _, body = text.partition(b"\n\n")
    if head.startswith(_BOM) and not head[len(_BOM) :].lower().startswith(b"content-type"):
        head = head[len(_BOM) :]  # OpenSSL reads it as a part of the first header's name
    kind, parameters = _media_type(head)
    if kind in _OPAQUE:
        return None, _decoded(body)
    boundary = parameters.get(b"boundary", b"")
    if kind != b"multipart/signed" or not _BOUNDARY.fullmatch(boundary):
        raise PkiError(
            "it is not an S/MIME signed message",
            "A signed document begins with MIME headers of the type multipart/signed; "
            "this may be the unsigned XML.",
        )
    # Also inside of lines: OpenSSL reads a long line in pieces, each of which may begin a part.
    parts = (b"\n" + body + b"\n").split(b"--" + boundary)
    if len(parts) != _PARTS or not (
        parts[0].endswith(b"\n")
        and all(part.startswith(b"\n") and part.endswith(b"\n") for part in parts[1:-1])
        and parts[-1].startswith(b"--\n")
    ):
        raise PkiError("it is not one signed part followed by one signature")
    header, _, encoded = parts[2][1:-1].partition(b"\n\n")
    if _media_type(header)[0] not in _SIGNATURE or not encoded:
        raise PkiError("it has no signature")
    return parts[1][1:-1].replace(b"\n", b"\r\n"), _decoded(encoded)


def _decoded(encoded: bytes) -> bytes:
    if not _BASE64.fullmatch(encoded):
        raise PkiError("its signature is not valid base64")
    return base64.b64decode(encoded.replace(b"\n", b""), validate=True)


# All documents of a keystore embed the certificate of the permissions CA.
_certificate = lru_cache(maxsize=16)(load_der_certificate)
_public_key = lru_cache(maxsize=16)(x509.Certificate.public_key)


def _parts(value: der.Value, *tags: int) -> list[der.Value]:
    """Return the values in a constructed value; raise `ValueError` unless they have the tags."""
    parts = der.children(value.content)
    if tuple(part.tag for part in parts) != tags:
        raise ValueError("not the structure of a CMS signature")
    return parts


def _optional(values: list[der.Value], place: int, tag: int) -> list[der.Value]:
    """Remove the value at a place if it has the tag, and return it in a list."""
    return [values.pop(place)] if len(values) > place and values[place].tag == tag else []


@_remembered
def _algorithm(value: der.Value) -> bytes:
    """Return the OID of an AlgorithmIdentifier that has no parameters, or NULL as parameters."""
    oid, *parameters = der.children(value.content)
    if oid.tag != der.OID or [each.whole for each in parameters] not in ([], [_NULL]):
        raise ValueError("not a known algorithm")
    return oid.content


def _parse_cms(signature: bytes, content: bytes | None) -> SignedDocument:
    """Parse a ContentInfo with SignedData and one SignerInfo (RFC 5652, 3, 5.1 and 5.3).

    Only DER is read, and only the fields that a signature of one signer needs: of anything else,
    OpenSSL and sros might think differently.  Without ``content``, the signed part is taken from
    the SignedData.
    """
    (message,) = der.children(signature)
    content_type, wrapped = _parts(message, der.OID, der.CONTEXT_0)
    (signed_data,) = _parts(wrapped, der.SEQUENCE)
    if message.tag != der.SEQUENCE or content_type.content != _SIGNED_DATA:
        raise ValueError("not SignedData")
    fields = der.children(signed_data.content)
    bags = _optional(fields, 3, der.CONTEXT_0)
    if [each.tag for each in fields] != [der.INTEGER, der.SET, der.SEQUENCE, der.SET]:
        raise ValueError("not the fields of SignedData")
    version, digests, encapsulated, signers = fields
    kind, *contained = der.children(encapsulated.content)
    if version.whole != _VERSION or (kind.tag, kind.content) != (der.OID, _DATA):
        raise ValueError("not a signature of data")
    if (content is None) != bool(contained):
        raise ValueError("two contents, or none")
    if content is None:
        (wrapped,) = contained
        (octets,) = _parts(wrapped, der.OCTET_STRING)
        if wrapped.tag != der.CONTEXT_0:
            raise ValueError("no content")
        content = octets.content
    embedded = [value for bag in bags for value in der.children(bag.content)]
    (signer,) = _parts(signers, der.SEQUENCE)
    info = der.children(signer.content)
    attributes = _optional(info, 3, der.CONTEXT_0)
    if [each.tag for each in info] != [
        *(der.INTEGER, der.SEQUENCE, der.SEQUENCE, der.SEQUENCE, der.OCTET_STRING)
    ]:
        raise ValueError("not the fields of SignerInfo")
    version, identifier, digest, signature_algorithm, signature_value = info
    (listed,) = _parts(digests, der.SEQUENCE)
    algorithm = _DIGESTS.get(_algorithm(digest))
    if _algorithm(listed) != _algorithm(digest) or version.whole != _VERSION:
        raise ValueError("another digest or version than announced")
    if algorithm is None:
        raise ValueError("unknown digest")
    _algorithm(signature_algorithm)
    return SignedDocument(
        content=content,
        document=_document(content),
        certificates=tuple(_certificate(each.whole) for each in embedded),
        digest=algorithm.algorithm.name,
        _digest_algorithm=algorithm,
        _signature_algorithm=signature_algorithm,
        # The signature covers the attributes with the tag SET, not with their tag in SignerInfo.
        _signed_attributes=b"".join(b"\x31" + each.whole[1:] for each in attributes),
        _message_digest=b"".join(_message_digest(each.content) for each in attributes),
        _signature=signature_value.content,
        _issuer_and_serial=_issuer_and_serial(identifier),
    )


@_remembered
def _issuer_and_serial(identifier: der.Value) -> tuple[bytes, int]:
    issuer, serial = _parts(identifier, der.SEQUENCE, der.INTEGER)
    return issuer.whole, der.integer(serial)


def _message_digest(attributes: bytes) -> bytes:
    """Return the digest in the signed attributes, after checking their form (RFC 5652, 11)."""
    found: dict[bytes, der.Value] = {}
    for attribute in der.children(attributes):
        name, values = _parts(attribute, der.OID, der.SET)
        (value,) = der.children(values.content)
        if attribute.tag != der.SEQUENCE or value.tag not in _ATTRIBUTE_VALUES:
            raise ValueError("not a signed attribute")
        if not all(_OID.fullmatch(each.content) for each in (name, value) if each.tag == der.OID):
            raise ValueError("not an object identifier")
        if name.content in found:
            raise ValueError("an attribute appears twice")
        found[name.content] = value
    kind, digest = found.get(_CONTENT_TYPE), found.get(_MESSAGE_DIGEST)
    if kind is None or (kind.tag, kind.content) != (der.OID, _DATA):
        raise ValueError("not a signature of data")
    if digest is None or digest.tag != der.OCTET_STRING:
        raise ValueError("no message digest")
    return digest.content
