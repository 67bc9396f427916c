"""What a file is, whatever its name promises: certificates, keys and messages in all their forms.

Readers ask it once they failed, so that their messages name the cause: DER in place of PEM, a
signing request in place of a certificate, a message that is encrypted and not signed.
"""

from __future__ import annotations

import re

from sros_tool.errors import PkiError
from sros_tool.pki import der

ENCRYPTED_MESSAGE = "an S/MIME message that is encrypted, not signed"
SIGNED_MESSAGE = "an S/MIME signed message"
XML = "XML that is not signed"
_UTF_16 = "a text in UTF-16"

_MARKS = (
    (b"\xff\xfe", _UTF_16),
    (b"\xfe\xff", _UTF_16),
    (b"<\0", _UTF_16),
    (b"\0<", _UTF_16),
    (b"PK\x03\x04", "a ZIP archive"),
    (b"\x1f\x8b", "a file that gzip compressed"),
    (b"ssh-", "a public key of OpenSSH"),
    (b"ecdsa-sha2-", "a public key of OpenSSH"),
    (b"pkcs11:", "the URI of a key on a token"),
)
"""What files with these first bytes are."""

_LABEL = re.compile(rb"^-----BEGIN ([^\r\n]{1,60})-----[ \t\r]*$", re.MULTILINE)
_OF_LABEL = {
    "CERTIFICATE": "a certificate",
    "X509 CERTIFICATE": "a certificate",
    "TRUSTED CERTIFICATE": "a TRUSTED CERTIFICATE of OpenSSL",
    "CERTIFICATE REQUEST": "a signing request, not yet a certificate",
    "NEW CERTIFICATE REQUEST": "a signing request, not yet a certificate",
    "X509 CRL": "a revocation list",
    "PUBLIC KEY": "a public key",
    "RSA PUBLIC KEY": "a public key",
    "SSH2 PUBLIC KEY": "a public key of OpenSSH",
    "OPENSSH PRIVATE KEY": "a private key in the form of OpenSSH",
    "EC PARAMETERS": "the parameters of a key, without the key",
    "PKCS7": "PKCS#7 in PEM",
    "CMS": "CMS in PEM",
}

_OID_OF_MESSAGE = {
    der.encode_oid("1.2.840.113549.1.7.2"): "PKCS#7 in DER",
    der.encode_oid("1.2.840.113549.1.7.3"): ENCRYPTED_MESSAGE,
    der.encode_oid("1.2.840.113549.1.7.6"): ENCRYPTED_MESSAGE,
    der.encode_oid("1.2.840.113549.1.9.16.1.23"): ENCRYPTED_MESSAGE,
}
_KEY_IN_DER = "a private key in DER, not in PEM (`openssl pkey -inform DER` writes PEM)"
_CERTIFICATE_IN_DER = "a certificate in DER, not in PEM (`openssl x509 -inform DER` writes PEM)"
_LIST_IN_DER = "a revocation list in DER, not in PEM (`openssl crl -inform DER` writes PEM)"
_PKCS12 = "a PKCS#12 container (.p12, .pfx)"

_HEADER = re.compile(rb"(?i)\s*(?:mime-version|content-type|content-transfer-encoding)[ \t]*:")
_BASE64 = re.compile(rb"[A-Za-z0-9+/\s]{40,}={0,2}\s*")
_MOST = 4096
"""How much of a text is looked at, in bytes."""


def kind_of(data: bytes) -> str:
    """Return what a file is, as a noun with its article; "" if that is not known."""
    for mark, kind in _MARKS:
        if data.startswith(mark):
            return kind
    if data[:1] == bytes((der.SEQUENCE,)) and (kind := _kind_of_der(data)):
        return kind
    text = data.removeprefix(b"\xef\xbb\xbf")
    if found := _LABEL.search(text):
        return _kind_of_label(found[1].decode("ascii", "replace"))
    if _HEADER.match(text):
        return _kind_of_message(text)
    if text.lstrip()[:1] == b"<":
        return XML
    if not text.strip():
        return "a file of blanks alone"
    if _BASE64.fullmatch(text[:_MOST]):
        return "base64 without its lines '-----BEGIN' and '-----END'"
    return ""


def _kind_of_label(label: str) -> str:
    if label.endswith("PRIVATE KEY") and label not in _OF_LABEL:
        return "a private key"
    return _OF_LABEL.get(label, f"a PEM file of the kind {label}")


def _kind_of_message(text: bytes) -> str:
    """Return what a text with MIME headers is."""
    if text[:1].isspace():
        return "a MIME message with an empty line before its headers, which ends them at once"
    head = text[:_MOST].lower()
    if b"enveloped-data" in head or b"encrypted-data" in head:
        return ENCRYPTED_MESSAGE
    signed = b"multipart/signed" in head or b"pkcs7-mime" in head
    return SIGNED_MESSAGE if signed else "a MIME message that is not signed"


def _kind_of_der(data: bytes) -> str:
    """Return what a value in DER is by its structure; "" for any other."""
    try:
        whole, _ = der.split(data)
        parts = der.children(der.first(der.normalized(whole)).content)
        tags = tuple(part.tag for part in parts)
        if tags[:1] == (der.OID,):
            return _OID_OF_MESSAGE.get(parts[0].content, "a message in DER")
        if tags == (der.SEQUENCE, der.SEQUENCE, der.BIT_STRING):
            return _kind_of_signed(der.children(parts[0].content))
    except PkiError:
        return ""
    if tags == (der.SEQUENCE, der.BIT_STRING):
        return "a public key in DER"
    if tags == (der.SEQUENCE, der.OCTET_STRING):
        return "an encrypted private key in DER"
    if tags[:2] == (der.INTEGER, der.SEQUENCE):
        return _KEY_IN_DER if der.OCTET_STRING in tags else _PKCS12
    return _KEY_IN_DER if tags[:1] == (der.INTEGER,) else ""


def _kind_of_signed(parts: list[der.Value]) -> str:
    """Return what is signed: a certificate, a request or a revocation list, by its parts."""
    tags = [part.tag for part in parts]
    if der.UTC_TIME in tags or der.GENERALIZED_TIME in tags:
        return _LIST_IN_DER
    if tags[:3] == [der.INTEGER, der.SEQUENCE, der.SEQUENCE] and tags[3:] in ([], [der.CONTEXT_0]):
        return "a signing request in DER, not yet a certificate"
    return _CERTIFICATE_IN_DER
