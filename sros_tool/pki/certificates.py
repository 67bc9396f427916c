"""X.509 certificates of CAs and enclaves, as DDS Security requires them, and requests for them."""

from __future__ import annotations

import hashlib
import re
import secrets
from collections.abc import Iterator
from contextlib import suppress
from datetime import UTC, datetime
from enum import Enum
from functools import cache, lru_cache
from hashlib import sha256
from typing import NamedTuple, TypeVar

from cryptography import x509
from cryptography.exceptions import InvalidSignature, UnsupportedAlgorithm
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec, ed448, ed25519, padding, rsa
from cryptography.hazmat.primitives.asymmetric.types import PrivateKeyTypes
from cryptography.x509.oid import ExtendedKeyUsageOID, ExtensionOID, NameOID, SignatureAlgorithmOID

from sros_tool.errors import PkiError
from sros_tool.pki import der, tolerant
from sros_tool.pki import pem as pem_file
from sros_tool.pki.distinguished_names import (
    check_name_readable,
    may_be_read_error,
    reading,
    same_name,
    short_names,
)
from sros_tool.pki.keys import (
    KEY_LABELS,
    PrivateKey,
    PublicKey,
    algorithm,
    check_key,
    holds_private_key,
    is_portable,
    is_weak,
    key_problem,
)
from sros_tool.pki.tolerant import TolerantName
from sros_tool.validity import Window
from sros_tool.wording import capitalized

# A permissions CA also signs governance and permissions documents.
_CA_USAGE = tolerant.key_usage("digital_signature", "key_cert_sign", "crl_sign")
_LEAF_USAGE = tolerant.key_usage("digital_signature")
Extension = TypeVar("Extension", bound=x509.ExtensionType)

_ENCODINGS = {
    0x0C: "utf-8",
    **dict.fromkeys((0x12, 0x13, 0x14, 0x16, 0x17, 0x18, 0x1A), "latin-1"),
    0x1C: "utf-32-be",
    0x1E: "utf-16-be",
}
"""Maps an ASN.1 string type to the encoding in which OpenSSL reads it (a_strex.c, tag2nbyte)."""
_ESCAPED_CHARACTERS = re.compile(r'[,+"\\<>;]|^[# ](?!\Z)| \Z')
_UNIQUE_OU = re.compile(r"[0-9a-f]{16}")
_CONTROL_CHARACTERS = re.compile(r"[\x00-\x1f\x7f]")

_SIGNING_KEYS: dict[x509.ObjectIdentifier, type] = {
    SignatureAlgorithmOID.ED25519: ed25519.Ed25519PublicKey,
    SignatureAlgorithmOID.ED448: ed448.Ed448PublicKey,
    **{
        oid: ec.EllipticCurvePublicKey if name.startswith("ECDSA") else rsa.RSAPublicKey
        for name, oid in vars(SignatureAlgorithmOID).items()
        if name.startswith(("RSA", "ECDSA", "_RSA")) and not name.startswith("ECDSA_WITH_SHA3_")
    },
}
"""Maps the OID of a signature algorithm to its kind of key; OpenSSL 3.0 has no ECDSA with SHA-3."""
_LEAF_CONSTRAINTS = x509.BasicConstraints(ca=False, path_length=None)
_CA_CONSTRAINTS = x509.BasicConstraints(ca=True, path_length=1)


def common_name(text: str) -> x509.Name:
    """Return the distinguished name ``CN=text``."""
    return x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, text)])


def enclave_subject(name: str, *, unique: bool) -> x509.Name:
    """Return the subject of an enclave's certificate: CN ``name``, and a random OU if ``unique``.

    The OU makes the subject different from the subjects of the enclave's earlier certificates, and
    from the subjects of enclaves whose names contain ``name`` (Cyclone DDS compares parts of
    subjects). So permissions for those subjects do not fit the new certificate.  As RFC 4514 text,
    the subject begins with the CN.  The subject of the root enclave ends with the CN, because
    Cyclone DDS splits subjects at slashes, and refuses a subject with an empty part before another
    part.
    """
    if not unique:
        return common_name(name)
    part = x509.NameAttribute(NameOID.ORGANIZATIONAL_UNIT_NAME, secrets.token_hex(8))
    parts = [part, x509.NameAttribute(NameOID.COMMON_NAME, name)]
    return x509.Name(parts[::-1] if name.endswith("/") else parts)


def has_unique_part(subject: x509.Name) -> bool:
    """Return whether an enclave's subject has a unique OU, as `enclave_subject` makes it."""
    if isinstance(subject, TolerantName):
        return len(subject.rdns) > 1
    units = subject.get_attributes_for_oid(NameOID.ORGANIZATIONAL_UNIT_NAME)
    return any(_UNIQUE_OU.fullmatch(str(unit.value)) for unit in units)


def issue_ca(key: PrivateKey, name: x509.Name, validity: Window) -> x509.Certificate:
    """Return a self-signed CA certificate.

    The certificate has BasicConstraints, KeyUsage and both key identifiers: without them, OpenSSL's
    strict check (``-x509_strict``, used by Fast DDS) refuses a chain.
    """
    public = key.public_key()
    identifier = x509.SubjectKeyIdentifier.from_public_key(public)
    return (
        _builder(name, name, public, validity)
        .add_extension(_CA_CONSTRAINTS, critical=True)
        .add_extension(_CA_USAGE, critical=True)
        .add_extension(identifier, critical=False)
        .add_extension(
            x509.AuthorityKeyIdentifier.from_issuer_subject_key_identifier(identifier),
            critical=False,
        )
        .sign(key, hashes.SHA256())
    )


def check_signer(certificate: x509.Certificate) -> None:
    """Raise `PkiError` if a CA certificate breaks rules of X.509, so that sros cannot sign."""
    if tolerant.is_tolerated(certificate):
        raise PkiError(
            f"sros cannot sign with the CA {subject_text(certificate.subject)}",
            "Its certificate breaks rules of X.509 (RFC 5280); DDS reads it nevertheless, but "
            "sros cannot issue certificates with it.",
            "Issue the certificate of the CA again, by the rules of X.509.",
        )


class Issuer:
    """An identity CA that issues certificates for enclaves."""

    def __init__(self, certificate: x509.Certificate, key: PrivateKey) -> None:
        check_signer(certificate)
        self._certificate = certificate
        self._key = key
        self._name = certificate.subject
        self._validity = validity_of(certificate)
        self._authority_id = authority_identifier(certificate)

    def issue(self, subject: x509.Name, public: PublicKey, validity: Window) -> x509.Certificate:
        """Return an end-entity certificate (not a CA), which expires no later than the CA."""
        return (
            _builder(subject, self._name, public, validity.intersection(self._validity))
            .add_extension(_LEAF_CONSTRAINTS, critical=True)
            .add_extension(_LEAF_USAGE, critical=True)
            .add_extension(x509.SubjectKeyIdentifier.from_public_key(public), critical=False)
            .add_extension(self._authority_id, critical=False)
            .sign(self._key, hashes.SHA256())
        )


def authority_identifier(certificate: x509.Certificate) -> x509.AuthorityKeyIdentifier:
    """Return the AuthorityKeyIdentifier of certificates that the CA ``certificate`` issues."""
    try:
        extension = certificate.extensions.get_extension_for_class(x509.SubjectKeyIdentifier)
    except x509.ExtensionNotFound:  # a CA that ros2/sros2 created has none
        public = certificate.public_key()
        return x509.AuthorityKeyIdentifier.from_issuer_public_key(public)  # type: ignore[arg-type]
    return x509.AuthorityKeyIdentifier.from_issuer_subject_key_identifier(extension.value)


def _builder(
    subject: x509.Name, issuer: x509.Name, public: PublicKey, validity: Window
) -> x509.CertificateBuilder:
    if isinstance(subject, TolerantName):
        raise PkiError(
            f"no certificate can have the subject {subject_text(subject)}",
            "Its text types (ASN.1) do not allow some of its characters.",
            "Create the enclave again, so that it gets a new subject.",
        )
    return x509.CertificateBuilder(
        issuer_name=issuer,
        subject_name=subject,
        public_key=public,
        serial_number=x509.random_serial_number(),
        not_valid_before=validity.not_before,
        not_valid_after=validity.not_after,
    )


def validity_of(certificate: x509.Certificate) -> Window:
    """Return the validity of a certificate, in UTC."""
    begin = tolerant.date(certificate, "not_valid_before")
    return Window(begin, tolerant.date(certificate, "not_valid_after"))


def pem(certificate: x509.Certificate) -> bytes:
    """Return the certificate as PEM."""
    return certificate.public_bytes(serialization.Encoding.PEM)


class TrustSettingsUse(Enum):
    """How a program uses the trust settings of a ``TRUSTED CERTIFICATE`` (OpenSSL, X509_AUX)."""

    IGNORED = "nothing"
    READ = "settings, but ignores what they say"
    OF_ANY_USE = "settings that must not restrict the certificate"
    OF_DOCUMENTS = "settings that must trust the certificate for S/MIME"


def load_certificate(
    data: bytes,
    label: str,
    *,
    trusted: bool = True,
    settings_use: TrustSettingsUse = TrustSettingsUse.IGNORED,
) -> x509.Certificate:
    """Return the first certificate of a PEM file; ``label`` names the file in errors.

    Without ``trusted``, blocks ``TRUSTED CERTIFICATE`` are ignored, as by Cyclone DDS.

    Raises:
        PkiError: sros or OpenSSL cannot read the certificate, or its trust settings forbid its use
            (``settings_use``).
    """
    return _first_certificate(data, label, trusted, settings_use)


@lru_cache(maxsize=16)  # several readers load the certificate of an enclave, and the same few CAs
def _first_certificate(
    data: bytes, label: str, trusted: bool, settings_use: TrustSettingsUse
) -> x509.Certificate:
    unreadable = f"the certificate {label} cannot be read"
    labels = pem_file.CERTIFICATES if trusted else pem_file.CERTIFICATES[:-1]
    for block in _certificate_blocks(data, unreadable):
        if block.label in labels:
            return _certificate_in(block, unreadable, settings_use)
    why = f"It is not a PEM certificate: {pem_file.missing_block_reason(data, 'CERTIFICATE')}."
    raise PkiError(unreadable, why, _RESTORE)


@lru_cache(maxsize=16)
def load_certificates(
    data: bytes, label: str, *, settings_use: TrustSettingsUse = TrustSettingsUse.IGNORED
) -> tuple[x509.Certificate, ...]:
    """Return all certificates of a PEM file, at least one; ``label`` names the file in errors.

    Raises:
        PkiError: the file has no certificate, sros or OpenSSL cannot read a part of it, or the
            trust settings of a ``TRUSTED CERTIFICATE`` forbid its use (``settings_use``).
    """
    load_certificate(data, label)
    unreadable = f"the certificates {label} cannot be read"
    certificates: list[x509.Certificate] = []
    for block in list(_certificate_blocks(data, unreadable)):
        if block.label in pem_file.CERTIFICATES:
            why = "A certificate after the first one is damaged." if certificates else _UNREADABLE
            of_block = (
                settings_use
                if block.label == pem_file.CERTIFICATES[-1]
                else TrustSettingsUse.IGNORED
            )
            certificates.append(_certificate_in(block, unreadable, of_block, why))
        elif block.label == "X509 CRL":
            with reading(unreadable, "A revocation list in it is damaged.", _RESTORE):
                tolerant.check_list(block.content)
        elif block.label in KEY_LABELS and not block.headers:
            with reading(unreadable, "A private key in it is damaged.", _RESTORE):
                check_key(block.content)
    return tuple(certificates)


_RESTORE = "Restore it from a backup, or issue it again."
_UNREADABLE = "It is not a PEM certificate, it is damaged, or its key algorithm is unknown."


def _certificate_blocks(data: bytes, label: str) -> Iterator[pem_file.Block]:
    blocks, damage = _undamaged_blocks(data)
    yield from blocks
    if damage:
        raise PkiError(label, f"{capitalized(damage)}.", _RESTORE)


@lru_cache(maxsize=8)  # several readers ask for the certificate of an enclave, or for all of them
def _undamaged_blocks(data: bytes) -> tuple[tuple[pem_file.Block, ...], str]:
    """Return the PEM blocks before the first damaged one, and a clause about the damage, or ""."""
    blocks: list[pem_file.Block] = []
    try:
        blocks.extend(pem_file.blocks(data))
    except PkiError as error:
        return tuple(blocks), error.what
    return tuple(blocks), ""


def _certificate_in(
    block: pem_file.Block, unreadable: str, settings_use: TrustSettingsUse, why: str = _UNREADABLE
) -> x509.Certificate:
    if block.headers:
        why = f"It has PEM headers ('{block.headers.splitlines()[0].decode('ascii', 'replace')}')."
        raise PkiError(
            unreadable, why, "Remove the lines between '-----BEGIN' and the certificate."
        )
    with reading(unreadable, why, _RESTORE):
        certificate, remainder = der.split(block.content)
        if (
            not remainder
            or settings_use is TrustSettingsUse.IGNORED
            or _permits_use(remainder, settings_use)
        ):
            return _load_der(certificate)
    why = "It is a TRUSTED CERTIFICATE that is not trusted for this use."
    remedy = "`openssl x509 -in FILE -out NEW` writes it without trust settings."
    raise PkiError(unreadable, why, remedy)


def _permits_use(trust_settings: bytes, settings_use: TrustSettingsUse) -> bool:
    """Return whether the trust settings after a certificate allow its use (OpenSSL, obj_trust).

    Raises:
        PkiError, ValueError: ``trust_settings`` is not an X509_AUX structure.
    """
    (value,) = der.children(der.normalized(trust_settings))
    if value.tag != der.SEQUENCE:
        raise ValueError("not settings of a certificate")
    parts = {part.tag: _listed_uses(part) for part in der.children(value.content)}
    if settings_use is TrustSettingsUse.READ:
        return True
    uses = (
        {_OID_ANY_USE, _OID_S_MIME}
        if settings_use is TrustSettingsUse.OF_DOCUMENTS
        else {_OID_ANY_USE}
    )
    trusted, rejected = parts.get(der.SEQUENCE), parts.get(der.CONTEXT_0)
    return not (rejected and rejected & uses) and (trusted is None or bool(trusted & uses))


_OID_ANY_USE = ExtendedKeyUsageOID.ANY_EXTENDED_KEY_USAGE.dotted_string
_OID_S_MIME = ExtendedKeyUsageOID.EMAIL_PROTECTION.dotted_string


def _listed_uses(uses: der.Value) -> set[str]:
    """Return the OIDs in a list of trusted or rejected uses; empty for any other value."""
    if uses.tag not in (der.SEQUENCE, der.CONTEXT_0):
        return set()
    return {der.decode_oid(use) for use in der.children(uses.content)}


def load_der_certificate(data: bytes) -> x509.Certificate:
    """Return the certificate in ``data`` (DER), such as one embedded in a signed document.

    Raises:
        PkiError: the certificate cannot be read.
    """
    with reading("a certificate in it cannot be read", "It is damaged."):
        return _load_der(data)


def _load_der(data: bytes) -> x509.Certificate:
    known = len(data) < _MOST_CACHED_BYTES
    return _load_known_der(data) if known else _load_known_der.__wrapped__(data)


@lru_cache(maxsize=64)  # several readers load the certificate of an enclave, and the same few CAs
def _load_known_der(data: bytes) -> x509.Certificate:
    try:
        return _read_in_full(x509.load_der_x509_certificate(data))
    except BaseException as error:
        if not may_be_read_error(error):
            raise
    return _read_names(tolerant.read_certificate(data))


_MOST_CACHED_BYTES = 16 * 1024


def _read_in_full(certificate: x509.Certificate) -> x509.Certificate:
    """Return ``certificate`` after reading all parts that sros uses, to raise errors now."""
    certificate.public_key()
    authority_identifier(certificate)
    _ = certificate.signature_hash_algorithm, certificate.serial_number
    return _read_names(certificate)


def _read_names(certificate: x509.Certificate) -> x509.Certificate:
    for name in (certificate.subject, certificate.issuer):
        check_name_readable(name)
        subject_text(name)
    validity_of(certificate)  # raises an error if the certificate expires before it begins
    return certificate


def same_key(certificate: x509.Certificate, key: PrivateKeyTypes) -> bool:
    """Return whether ``key`` is the private key of ``certificate``."""
    return certificate.public_key() == key.public_key()


def weakness(certificate: x509.Certificate) -> str:
    """Return the weak cryptography of a certificate as a clause, or "".

    A hash under 256 bits (SHA-1, MD5) is weak: whoever requests a certificate chooses part of the
    signed content, and could search for two contents with the same hash.
    """
    key, digest = certificate.public_key(), certificate.signature_hash_algorithm
    if is_weak(key):
        return f"{subject_text(certificate.subject)} has a weak key, {algorithm(key)}"
    if digest and digest.digest_size < hashes.SHA256.digest_size:
        name = subject_text(certificate.subject)
        return f"{name} has a weak signature, with {digest.name.upper()}"
    return ""


@lru_cache(maxsize=256)  # the same few certificates are checked repeatedly
def issued_by(certificate: x509.Certificate, authority: x509.Certificate) -> bool:
    """Return whether ``authority`` issued and signed ``certificate``; validity is not checked."""
    return likely_issued(certificate, authority) and signature_matches(certificate, authority)


@lru_cache(maxsize=256)
def likely_issued(certificate: x509.Certificate, authority: x509.Certificate) -> bool:
    """Return whether ``authority`` may be the issuer of ``certificate``.

    As in OpenSSL 3.0 (``ossl_x509_likely_issued``), the signature and the validity are not checked.
    Three things are compared: the names, the kind of the CA's key with the signature algorithm of
    the certificate, and the key identifiers if both certificates have them.
    """
    if tolerant.unread_extension(certificate) or tolerant.unread_extension(authority):
        return False
    algorithm = _signed_algorithm(certificate)
    kind = _SIGNING_KEYS.get(algorithm)
    if not (
        same_name(certificate.issuer, authority.subject)
        and kind
        and isinstance(authority.public_key(), kind)
        and (algorithm == SignatureAlgorithmOID.RSASSA_PSS or not is_for_pss(authority))
    ):
        return False
    named = extension(certificate, x509.AuthorityKeyIdentifier)
    return named is None or identifies(named, authority)


def identifies(identifier: x509.AuthorityKeyIdentifier, authority: x509.Certificate) -> bool:
    """Return whether a key identifier names a CA (OpenSSL 3, X509_check_akid)."""
    key_identifier = extension(authority, x509.SubjectKeyIdentifier)
    issuers = [
        name.value
        for name in identifier.authority_cert_issuer or ()
        if isinstance(name, x509.DirectoryName)
    ]
    return (
        (not key_identifier or identifier.key_identifier in (None, key_identifier.digest))
        and identifier.authority_cert_serial_number in (None, authority.serial_number)
        and (not issuers or same_name(issuers[0], authority.issuer))
    )


def is_for_pss(certificate: x509.Certificate) -> bool:
    """Return whether the key of a certificate is an RSA key only for RSA-PSS (RFC 4055, 1.2)."""
    return _key_algorithm(certificate)[0].content == _OID_RSA_PSS


def _normalized(certificate: x509.Certificate, part: bytes) -> bytes:
    """Return a part of a certificate, re-encoded in DER if the certificate is in BER."""
    return der.normalized(part) if tolerant.is_tolerated(certificate) else part


def has_explicit_curve(certificate: x509.Certificate) -> bool:
    """Return whether a certificate describes its elliptic curve by parameters instead of an OID."""
    kind, *parameters = _key_algorithm(certificate)
    return kind.content == _OID_EC and bool(parameters) and parameters[-1].tag == der.SEQUENCE


_OID_RSA_PSS = der.encode_oid("1.2.840.113549.1.1.10")
_OID_EC = der.encode_oid("1.2.840.10045.2.1")


@lru_cache(maxsize=256)
def _key_algorithm(certificate: x509.Certificate) -> list[der.Value]:
    """Return the identifier and the parameters of the algorithm of a certificate's key."""
    parts = der.children(
        der.first_value(_normalized(certificate, certificate.tbs_certificate_bytes)).content
    )
    key = parts[6 if parts[0].tag == der.CONTEXT_0 else 5]
    return der.children(der.first_value(key.content).content)


@lru_cache(maxsize=256)
def _algorithms(certificate: x509.Certificate) -> tuple[der.Value, der.Value]:
    """Return both fields for the signature algorithm: first the one inside the signed part.

    OpenSSL compares the two fields when it verifies the signature.  OpenSSL does not verify the
    signature of a self-signed CA (RFC 5280, 4.1.1.2).
    """
    certificate_value = der.first_value(
        _normalized(certificate, certificate.public_bytes(serialization.Encoding.DER))
    )
    signed, outer, _ = der.children(certificate_value.content)
    parts = der.children(signed.content)
    return parts[2 if parts[0].tag == der.CONTEXT_0 else 1], outer


def _signed_algorithm(certificate: x509.Certificate) -> x509.ObjectIdentifier:
    inner, _ = _algorithms(certificate)
    return x509.ObjectIdentifier(der.decode_oid(der.first_value(inner.content)))


@lru_cache(maxsize=256)
def is_self_issued(certificate: x509.Certificate) -> bool:
    """Return whether the subject and the issuer of a certificate are equal."""
    return same_name(certificate.subject, certificate.issuer)


@lru_cache(maxsize=256)
def signature_matches(certificate: x509.Certificate, authority: x509.Certificate) -> bool:
    """Return whether the key of ``authority`` made the signature of ``certificate``."""
    inner, outer = _algorithms(certificate)
    signed = certificate.tbs_certificate_bytes
    return inner.whole == outer.whole and is_signed(certificate, signed, authority)


def is_signed(
    signed_object: x509.Certificate | x509.CertificateRevocationList,
    tbs_bytes: bytes,
    authority: x509.Certificate,
) -> bool:
    """Return whether the key of ``authority`` signed ``tbs_bytes``.

    ``tbs_bytes`` is the signed part of ``signed_object``, which also has the signature and its
    algorithm.
    """
    key, signature = authority.public_key(), signed_object.signature
    if not isinstance(key, _SIGNING_KEYS.get(signed_object.signature_algorithm_oid, ())):
        return False
    try:
        digest = signed_object.signature_hash_algorithm
        if isinstance(key, ec.EllipticCurvePublicKey) and digest:
            key.verify(signature, tbs_bytes, ec.ECDSA(digest))
        elif isinstance(key, rsa.RSAPublicKey) and digest:
            pss = signed_object.signature_algorithm_oid == SignatureAlgorithmOID.RSASSA_PSS
            scheme = signed_object.signature_algorithm_parameters if pss else padding.PKCS1v15()
            key.verify(signature, tbs_bytes, scheme, digest)  # type: ignore[arg-type]
        elif isinstance(key, (ed25519.Ed25519PublicKey, ed448.Ed448PublicKey)):
            key.verify(signature, tbs_bytes)
        else:
            return False
    except (InvalidSignature, UnsupportedAlgorithm, ValueError, TypeError):
        return False
    return True


def extension(
    signed: x509.Certificate | x509.CertificateRevocationList, kind: type[Extension]
) -> Extension | None:
    """Return an extension of a certificate or revocation list, or None."""
    try:
        return signed.extensions.get_extension_for_class(kind).value
    except x509.ExtensionNotFound:
        return None


def digest(certificate: x509.Certificate) -> str:
    """Return the SHA-256 fingerprint of a certificate, in hexadecimal."""
    return certificate.fingerprint(hashes.SHA256()).hex()


def authority_text(certificate: x509.Certificate) -> str:
    """Return the subject of a CA with the first digits of its SHA-256.

    The digits tell CAs of one name apart.  In a rotation, the new permissions CA keeps the name of
    the old one, because Fast DDS 2.9.1 refuses peers whose permissions CA has another name.  Only a
    CA that signs no documents gets a new name.
    """
    return f"{subject_text(certificate.subject)} (SHA-256 {digest(certificate)[:8]})"


def other_issuer_text(certificate: x509.Certificate, authority: x509.Certificate) -> str:
    """Return the issuer of a certificate that ``authority`` did not issue.

    If the issuer is named like ``authority``, the text tells both CAs apart by their key
    identifiers.
    """
    name = subject_text(certificate.issuer)
    if certificate.issuer != authority.subject:
        return name
    issuer = extension(certificate, x509.AuthorityKeyIdentifier)
    own = extension(authority, x509.SubjectKeyIdentifier)
    if issuer is None or issuer.key_identifier is None:
        return f"another CA named {name} (the certificate does not name the CA's key)"
    named, here = issuer.key_identifier.hex(), own.digest.hex() if own else "missing"
    if named == here:
        return (
            f"a CA that has the same name, {name}, and the same key identifier, but not the same "
            "key or serial number"
        )
    return f"another CA named {name} (key identifier {named}, not {here})"


def subject_text(name: x509.Name) -> str:
    """Return a distinguished name as OpenSSL prints it (RFC 2253); vendors compare this text.

    RDNs, and the attributes in an RDN, are in reverse order; non-ASCII characters are kept.
    """
    if isinstance(name, TolerantName) or all(len(rdn) == 1 for rdn in name.rdns):
        return _name_text(name.public_bytes())
    # This name sorts the attributes of an RDN, so each attribute is printed by itself.
    return ",".join(
        "+".join(
            _name_text(x509.Name([attribute]).public_bytes()) for attribute in reversed(list(rdn))
        )
        for rdn in reversed(name.rdns)
    )


@lru_cache(maxsize=1024)  # the subjects of a keystore are asked for repeatedly
def _name_text(name: bytes) -> str:
    """Return a name (DER) as OpenSSL prints it; the attributes of an RDN keep their order."""
    return ",".join(
        "+".join(map(_attribute_text, reversed(der.children(rdn.content))))
        for rdn in reversed(der.children(der.first_value(name).content))
    )


def _attribute_text(attribute: der.Value) -> str:
    """Return ``type=value``; the value is hexadecimal if the type is unknown or not a string."""
    oid, value = der.children(attribute.content)
    dotted = der.decode_oid(oid)
    known = short_names().get(dotted)
    encoding = _ENCODINGS.get(value.tag)
    if known is None or encoding is None:
        return f"{known or dotted}=#{value.whole.hex().upper()}"
    text = _ESCAPED_CHARACTERS.sub(lambda found: f"\\{found[0]}", value.content.decode(encoding))
    return f"{known}={_CONTROL_CHARACTERS.sub(lambda found: f'{chr(92)}{ord(found[0]):02X}', text)}"


def parse_subject(text: str) -> x509.Name:
    """Parse the text of a distinguished name, as `subject_text` returns it.

    Raises:
        ValueError: the text is not a distinguished name.
    """
    return x509.Name.from_rfc4514_string(text, _oids_by_name())


@cache
def _oids_by_name() -> dict[str, x509.ObjectIdentifier]:
    return {name: x509.ObjectIdentifier(oid) for oid, name in short_names().items()}


def common_name_of(name: x509.Name) -> str:
    """Return the common name of a distinguished name, or ""."""
    attributes = name.get_attributes_for_oid(NameOID.COMMON_NAME)
    return str(attributes[0].value) if attributes else ""


def fingerprints(pem: bytes) -> frozenset[str]:
    """Return the fingerprints of the certificates in a CA file: several during a rotation."""
    return frozenset(map(digest, load_certificates(pem, "the certificate of a CA")))


@lru_cache(maxsize=8)
def readable_fingerprints(pem: bytes) -> frozenset[str]:
    """Return the `fingerprints` of a CA file; none if it cannot be read."""
    try:
        return fingerprints(pem)
    except PkiError:
        return frozenset()


# ── DDS participants ───────────────────────────────────────────────────────────────────────

IDENTITY_DIGITS = 12
_FIRST_BIT = 1 << (4 * IDENTITY_DIGITS - 1)


def identity_of(subject: bytes) -> str:
    """Return the first 6 bytes (hexadecimal) of a secured participant's GUID.

    The bytes depend only on the participant's ``subject`` name (DER).  Source: DDS-Security 1.1,
    9.3.3.
    """
    digest = int(sha256(subject).hexdigest()[:IDENTITY_DIGITS], 16)
    return f"{_FIRST_BIT | digest >> 1:x}"


# ── forms ──────────────────────────────────────────────────────────────────────────────────
#
# Certificates of one form differ in their names, keys, serial numbers and dates alone.  A form is
# read from their DER, in a tenth of the time that reading a certificate in full takes.


_EXTENSIONS_TAG = 0xA3
_LONGEST_SERIAL = 20
_GENERALIZED_TIME = re.compile(r"\d{14}Z", re.ASCII)
_OID_NETSCAPE_TYPE = "2.16.840.1.113730.1.1"
_EVALUATED_EXTENSIONS = {
    der.encode_oid(oid)
    for oid in (
        ExtensionOID.AUTHORITY_KEY_IDENTIFIER.dotted_string,
        ExtensionOID.BASIC_CONSTRAINTS.dotted_string,
        ExtensionOID.CERTIFICATE_POLICIES.dotted_string,
        ExtensionOID.CRL_DISTRIBUTION_POINTS.dotted_string,
        ExtensionOID.EXTENDED_KEY_USAGE.dotted_string,
        ExtensionOID.INHIBIT_ANY_POLICY.dotted_string,
        ExtensionOID.KEY_USAGE.dotted_string,
        ExtensionOID.POLICY_CONSTRAINTS.dotted_string,
        _OID_NETSCAPE_TYPE,
    )
}
"""The extensions whose values OpenSSL evaluates, except for those that hold names."""
_UNUSUAL_CHARACTERS = re.compile(rb"[^A-Za-z0-9/_]")


class CertificateForm(NamedTuple):
    """The form of a certificate file: ``common`` has what is usually equal for all enclaves.

    Two files with equal ``common`` differ only in values of their own, such as the key.
    ``validity`` is the period in DER.
    """

    common: tuple[object, ...]
    serial: int
    validity: bytes


def read_form(data: bytes) -> CertificateForm | None:
    """Return the form of the first certificate in a PEM file; None if it has unusual parts."""
    with suppress(PkiError, ValueError, IndexError, StopIteration):
        blocks = list(pem_file.blocks(data))
        first = next(block for block in blocks if block.label in pem_file.CERTIFICATES)
        around = tuple((block.label, block.headers) for block in blocks)
        form = _certificate_form(first.content)
        return form._replace(common=(*around, *form.common))
    return None


def is_valid_at(form: CertificateForm, now: datetime) -> bool | None:
    """Return whether the certificate with this form is valid at ``now``; None if unreadable."""
    times = _validity_times(form.validity)
    return times and times[0] <= now.astimezone(UTC).strftime("%Y%m%d%H%M%SZ") <= times[1]


@lru_cache(maxsize=256)  # certificates issued together share their dates
def _validity_times(validity: bytes) -> tuple[str, str] | None:
    """Return the start and the end of a validity (DER), or None if they cannot be read.

    Both have the form GeneralizedTime (RFC 5280, 4.1.2.5).
    """
    with suppress(PkiError, ValueError):
        begin, end = map(_as_generalized_time, der.children(validity))
        return begin, end
    return None


def _as_generalized_time(value: der.Value) -> str:
    text = value.content.decode("ascii")
    if value.tag == der.UTC_TIME:
        text = f"{'20' if text < '50' else '19'}{text}"
    if not _GENERALIZED_TIME.fullmatch(text):
        raise ValueError("not a time in UTC")
    return text


def _certificate_form(certificate: bytes) -> CertificateForm:
    (certificate_value,) = der.children(certificate)
    signed, signature_algorithm, _ = der.children(certificate_value.content)
    parts = der.children(signed.content)
    version = parts.pop(0).whole if parts[0].tag == der.CONTEXT_0 else b""
    serial, algorithm, issuer, validity, subject, key, *more = parts
    key_algorithm, key_bits = der.children(key.content)
    number = der.integer(serial)
    common = (
        *(version, algorithm.whole, signature_algorithm.whole, issuer.whole),
        *(key_algorithm.whole, len(key_bits.content)),
        *(number > 0, len(serial.content) > _LONGEST_SERIAL),
        _form_of_name(subject.content),
        *map(_form_of_extensions, more),
    )
    return CertificateForm(common, number, validity.content)


def _form_of_name(name: bytes) -> tuple[object, ...]:
    """Return the kinds of a name's attributes, by RDN, and the unusual characters of the name."""
    kinds: list[object] = []
    unusual: set[bytes] = set()
    for part in der.children(name):
        for attribute in der.children(part.content):
            kind, value = der.children(attribute.content)
            kinds.append((kind.content, value.tag))
            unusual.update(_UNUSUAL_CHARACTERS.findall(value.content))
        kinds.append(None)
    return (*kinds, frozenset(unusual))


def _form_of_extensions(part: der.Value) -> tuple[object, ...]:
    if part.tag != _EXTENSIONS_TAG:
        return (part.whole,)
    (extensions,) = der.children(part.content)
    return tuple(
        child.whole if kind.content in _EVALUATED_EXTENSIONS else (kind.content, len(rest) > 1)
        for child in der.children(extensions.content)
        for kind, *rest in (der.children(child.content),)
    )


# ── signing requests ───────────────────────────────────────────────────────────────────────

_MAX_BYTES = 64 * 1024
"""Largest request that is read, in bytes."""
_REQUEST_DIGESTS = (hashes.SHA256, hashes.SHA384, hashes.SHA512)


class SigningRequest(NamedTuple):
    """A verified certificate signing request; ``name`` is the common name of its subject."""

    name: str
    public_key: PublicKey
    pem: bytes


def make_request(key: PrivateKey, subject: str | x509.Name) -> bytes:
    """Return a PEM request, signed with ``key``, for a certificate with this subject.

    If ``subject`` is text, the name has only this common name.
    """
    name = common_name(subject) if isinstance(subject, str) else subject
    builder = x509.CertificateSigningRequestBuilder().subject_name(name)
    return builder.sign(key, hashes.SHA256()).public_bytes(serialization.Encoding.PEM)


def load_request(data: bytes, label: str) -> SigningRequest:
    """Read a PEM request and verify its signature; ``label`` names the request in errors.

    Only keys that every DDS vendor accepts are allowed: EC prime256v1 and RSA 2048, and no RSA key
    that is easy to break.  Extensions in a request are ignored, because the keystore decides what a
    certificate contains.

    Raises:
        PkiError: the request cannot be read, its signature does not verify, its key is weak or of
            another kind, or its subject is not exactly one common name.
    """
    with reading(
        f"the request {label} cannot be read",
        "It is not a PEM certificate request, or it is damaged.",
        "Create it with `sros create_request` on the robot, and send its request.pem.",
    ):
        if len(data) > _MAX_BYTES:
            raise ValueError("too large")
        request = x509.load_pem_x509_csr(data)
        subject, public, digest = (
            request.subject,
            request.public_key(),
            request.signature_hash_algorithm,
        )
        stated_name = subject_text(subject)
    if holds_private_key(data):
        raise PkiError(
            f"the request {label} has a private key next to it",
            "A private key stays on the robot: whoever saw this one can act as the enclave.",
            "Make another key with `sros create_request`, and send only its request.pem.",
        )
    if isinstance(public, rsa.RSAPublicKey) and not _states_key(request, public):
        raise PkiError(
            f"the request {label} is for an RSA key for RSA-PSS alone",
            "No DDS vendor loads such a key next to a certificate of the keystore.",
            "Create the key with `sros create_request`.",
        )
    if not is_portable(public):
        raise PkiError(
            f"the request {label} is for a key of {algorithm(public)}",
            "Only EC prime256v1 and RSA 2048 are accepted by every DDS vendor.",
            "Create the key with `sros create_request`.",
        )
    if problem := key_problem(public):
        raise PkiError(
            f"the key of the request {label} is weak",
            f"A certificate for this key would prove nothing: {problem}.",
            "Create another key with `sros create_request`, in another folder or on another token.",
        )
    if not isinstance(digest, _REQUEST_DIGESTS) or not _has_valid_signature(request):
        raise PkiError(
            f"the signature of the request {label} is not valid",
            "The sender did not prove possession of the key, or the request was changed "
            "in transit.",
            "Ask the sender to send it again.",
        )
    if len(list(subject)) != 1 or not common_name_of(subject):
        raise PkiError(
            f"the request {label} is for {stated_name or 'an empty subject'}",
            "The subject of a request has to be one common name, the name of the enclave, and "
            "nothing else.",
            "Create it with `sros create_request`.",
        )
    return SigningRequest(
        common_name_of(subject), public, request.public_bytes(serialization.Encoding.PEM)
    )


def _states_key(request: x509.CertificateSigningRequest, key: rsa.RSAPublicKey) -> bool:
    """Return whether a request states ``key`` as an RSA key for any use, not only for RSA-PSS.

    `cryptography` reads both kinds of keys alike.
    """
    stated = key.public_bytes(
        serialization.Encoding.DER, serialization.PublicFormat.SubjectPublicKeyInfo
    )
    return stated in request.tbs_certrequest_bytes


def _has_valid_signature(request: x509.CertificateSigningRequest) -> bool:
    try:
        return request.is_signature_valid
    except (ValueError, TypeError, UnsupportedAlgorithm):
        return False


def key_digest(key: PublicKey) -> str:
    """Return the SHA-256 of a public key (its DER SubjectPublicKeyInfo), in hexadecimal."""
    der = key.public_bytes(
        serialization.Encoding.DER, serialization.PublicFormat.SubjectPublicKeyInfo
    )
    return hashlib.sha256(der).hexdigest()


def key_digest_of_ca(authority: x509.Certificate) -> str:
    """Return the `key_digest` of a CA: a later certificate of the same key is the same CA."""
    return key_digest(authority.public_key())  # type: ignore[arg-type]
