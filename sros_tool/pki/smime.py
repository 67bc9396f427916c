"""Signed documents (``.p7s``): S/MIME multipart/signed with a detached CMS signature.

Every DDS vendor reads this form: CRLF line ends, a first part whose signed bytes begin with the
header ``Content-Type: text/plain``, SHA-256, and the embedded certificate of the signer
(DDS-Security 1.1, 9.4.1.1; OpenSSL ``smime -sign -text``).  Opaque messages, which have the content
inside the signature (``-nodetach``), are read as well, because every vendor accepts them.
"""

from __future__ import annotations

import base64
import binascii
import re
import secrets
from collections.abc import Iterable
from dataclasses import dataclass
from functools import lru_cache

from cryptography import x509
from cryptography.exceptions import InvalidSignature, UnsupportedAlgorithm
from cryptography.hazmat.primitives import hashes
from cryptography.hazmat.primitives.asymmetric import ec, padding, rsa
from cryptography.hazmat.primitives.serialization import Encoding, pkcs7

from sros_tool.errors import PkiError
from sros_tool.pki import der
from sros_tool.pki.certificates import UNREADABLE, read_in_full
from sros_tool.pki.keys import PrivateKey

_TEXT_HEADER = b"Content-Type: text/plain\r\n\r\n"
_OPTIONS = (pkcs7.PKCS7Options.DetachedSignature, pkcs7.PKCS7Options.Binary)
_TEXT = re.compile(rb"(?i)content-type:[ \t]*text/plain\b")
_MULTIPART = re.compile(
    rb"(?im)^content-type:[ \t]*multipart/signed"
    rb"""((?:;[ \t]*(?:\n[ \t]+)?[\w-]+=(?:"[^"\x00-\x1f]+"|[^\s;"]+))+)$"""
)
_OPAQUE = re.compile(rb"(?im)^content-type:[ \t]*application/(?:x-)?pkcs7-mime(?:;|$)")
_BOUNDARY = re.compile(rb"""(?i);\s*boundary=("([^"]{1,200})"|([^\s;"]{1,200}))""")
_PKCS7 = re.compile(rb"(?im)^content-type:[ \t]*application/(?:x-)?pkcs7-signature(?:;|$)")

_VERSION = b"\x02\x01\x01"
_SIGNED_DATA = der.encode_oid("1.2.840.113549.1.7.2")
_DATA = der.encode_oid("1.2.840.113549.1.7.1")
_MESSAGE_DIGEST = der.encode_oid("1.2.840.113549.1.9.4")
_DIGESTS: dict[bytes, hashes.HashAlgorithm] = {
    der.encode_oid("2.16.840.1.101.3.4.2.1"): hashes.SHA256(),
    der.encode_oid("2.16.840.1.101.3.4.2.2"): hashes.SHA384(),
    der.encode_oid("2.16.840.1.101.3.4.2.3"): hashes.SHA512(),
    der.encode_oid("1.3.14.3.2.26"): hashes.SHA1(),  # noqa: S303 - read, never written
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
    _digest_algorithm: hashes.HashAlgorithm
    _signed_attributes: bytes
    _message_digest: bytes
    _signature: bytes
    _issuer_and_serial: tuple[bytes, int]

    def signer(self) -> x509.Certificate | None:
        """Return the signer's certificate, or None if it is not embedded."""
        return self.signer_among(self.certificates)

    def signer_among(self, certificates: Iterable[x509.Certificate]) -> x509.Certificate | None:
        """Return the signer's certificate by issuer and serial number, or None."""
        issuer, serial = self._issuer_and_serial
        for certificate in certificates:
            if certificate.serial_number == serial and certificate.issuer.public_bytes() == issuer:
                return certificate
        return None

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

    def digest_matches(self) -> bool:
        """Return whether the messageDigest attribute is the digest of the content."""
        digest = hashes.Hash(self._digest_algorithm)
        digest.update(self.content)
        return digest.finalize() == self._message_digest

    def is_intact(self, signer: x509.Certificate) -> bool:
        """Return whether the signature verifies with the key of ``signer``."""
        if self._signed_attributes and not self.digest_matches():
            return False
        signed = self._signed_attributes or self.content
        key = signer.public_key()
        try:
            if isinstance(key, ec.EllipticCurvePublicKey):
                key.verify(self._signature, signed, ec.ECDSA(self._digest_algorithm))
            elif isinstance(key, rsa.RSAPublicKey):
                key.verify(self._signature, signed, padding.PKCS1v15(), self._digest_algorithm)
            else:
                return False
        except (InvalidSignature, UnsupportedAlgorithm):
            return False
        return True


@lru_cache(maxsize=8)  # several callers parse the same document in a row
def parse(message: bytes) -> SignedDocument:
    """Parse a ``.p7s`` without verifying it; raise `PkiError` if it is not a signed message."""
    content, signature = _split(message)
    try:
        return _parse_cms(signature, content)
    except (IndexError, *UNREADABLE) as error:
        raise PkiError("its signature is not a readable CMS signature") from error


def _document(content: bytes) -> bytes:
    header, separator, document = content.partition(b"\r\n\r\n")
    if not separator or not _TEXT.match(header):
        raise PkiError(
            "its signed part has no MIME header text/plain",
            "DDS vendors accept only documents that are signed with this header "
            "(openssl smime -sign -text).",
        )
    return document


def _split(message: bytes) -> tuple[bytes | None, bytes]:
    """Return the signed part, with CRLF line ends, and the signature in DER.

    The signed part is None for an opaque message, which has it inside the signature.
    """
    head, _, body = message.replace(b"\r\n", b"\n").partition(b"\n\n")
    if _OPAQUE.search(head):
        return None, _decoded(body)
    multipart = _MULTIPART.search(head)
    boundary = _BOUNDARY.search(multipart[1]) if multipart else None
    if not boundary:
        raise PkiError(
            "it is not an S/MIME signed message",
            "A signed document begins with MIME headers of the type multipart/signed; "
            "this may be the unsigned XML.",
        )
    mark = b"\n--" + (boundary[2] or boundary[3])
    parts = (b"\n" + body).split(mark)
    if len(parts) != 4 or not parts[3].startswith(b"--"):
        raise PkiError("it is not one signed part followed by one signature")
    content = parts[1].removeprefix(b"\n").replace(b"\n", b"\r\n")
    header, _, encoded = parts[2].removeprefix(b"\n").partition(b"\n\n")
    signature = _decoded(encoded)
    if not _PKCS7.search(header) or not signature:
        raise PkiError("it has no signature")
    return content, signature


def _decoded(encoded: bytes) -> bytes:
    try:
        return base64.b64decode(b"".join(encoded.split()), validate=True)
    except binascii.Error as error:
        raise PkiError("its signature is not valid base64") from error


@lru_cache(maxsize=16)
def _certificate(data: bytes) -> x509.Certificate:
    # All documents of a keystore embed the certificate of the permissions CA.
    return read_in_full(x509.load_der_x509_certificate(data))


def _parts(value: der.Value, *tags: int) -> list[der.Value]:
    """Return the values in a constructed value; raise `ValueError` if their tags do not fit."""
    parts = der.children(value.content)
    if [part.tag for part in parts[: len(tags)]] != list(tags):
        raise ValueError("not the structure of a CMS signature")
    return parts


def _parse_cms(signature: bytes, content: bytes | None) -> SignedDocument:
    """Parse a ContentInfo with SignedData and one SignerInfo (RFC 5652, 3, 5.1 and 5.3).

    Without ``content``, the signed part is taken from the SignedData.
    """
    message = der.first(signature)
    content_type, wrapped = _parts(message, der.OID, der.CONTEXT_0)[:2]
    (signed_data,) = _parts(wrapped, der.SEQUENCE)
    if message.tag != der.SEQUENCE or content_type.content != _SIGNED_DATA:
        raise ValueError("not SignedData")
    fields = _parts(signed_data, der.INTEGER, der.SET, der.SEQUENCE)
    version, digests, encapsulated = fields[:3]
    kind, *contained = _parts(encapsulated, der.OID)
    if version.whole != _VERSION or kind.content != _DATA:
        raise ValueError("not a signature of data")
    if content is None:
        (octets,) = _parts(contained[0], der.OCTET_STRING)
        content = octets.content
    certificates = tuple(
        _certificate(value.whole)
        for field in fields[3:]
        if field.tag == der.CONTEXT_0
        for value in der.children(field.content)
        if value.tag == der.SEQUENCE
    )
    (signer,) = _parts(fields[-1], der.SEQUENCE)
    info = _parts(signer, der.INTEGER, der.SEQUENCE, der.SEQUENCE)
    issuer, serial = _parts(info[1], der.SEQUENCE, der.INTEGER)
    digest = _parts(info[2], der.OID)[0].content
    algorithm = _DIGESTS.get(digest)
    (listed,) = _parts(digests, der.SEQUENCE)
    if _parts(listed, der.OID)[0].content != digest or info[0].whole != _VERSION:
        raise ValueError("another digest or version than announced")
    if algorithm is None or fields[-1].tag != der.SET:
        raise ValueError("unknown digest, or no signers")
    attributes, message_digest = b"", b""
    if info[3].tag == der.CONTEXT_0:
        # The signature covers the attributes with the tag SET, not with their tag in SignerInfo.
        attributes = b"\x31" + info[3].whole[1:]
        message_digest = _message_digest(info[3].content)
    signature_algorithm, signature_value = info[4:6] if attributes else info[3:5]
    if (
        signature_value.tag != der.OCTET_STRING
        or signature_algorithm.tag != der.SEQUENCE
        or not _parts(signature_algorithm, der.OID)
    ):
        raise ValueError("no signature value")
    return SignedDocument(
        content=content,
        document=_document(content),
        certificates=certificates,
        digest=algorithm.name,
        _digest_algorithm=algorithm,
        _signed_attributes=attributes,
        _message_digest=message_digest,
        _signature=signature_value.content,
        _issuer_and_serial=(issuer.whole, int.from_bytes(serial.content, "big", signed=True)),
    )


def _message_digest(attributes: bytes) -> bytes:
    for attribute in der.children(attributes):
        name, values = der.children(attribute.content)
        if name.content == _MESSAGE_DIGEST:
            return der.first(values.content).content
    raise ValueError("no message digest")
