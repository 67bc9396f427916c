"""Creation and verification of certificate signing requests (PKCS#10, RFC 2986)."""

from __future__ import annotations

import hashlib

from cryptography import x509
from cryptography.exceptions import UnsupportedAlgorithm
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec, rsa

from sros_tool.dataclass import dataclass
from sros_tool.errors import PkiError
from sros_tool.pki.certificates import common_name, common_name_of, subject_text
from sros_tool.pki.distinguished_names import reading
from sros_tool.pki.keys import PrivateKey, PublicKey, algorithm

_MAX_BYTES = 64 * 1024
"""Largest request that is read, in bytes."""
_DIGESTS = (hashes.SHA256, hashes.SHA384, hashes.SHA512)


@dataclass(frozen=True, slots=True)
class SigningRequest:
    """A verified certificate signing request; ``name`` is the common name of its subject."""

    name: str
    public_key: PublicKey
    pem: bytes


def make_request(key: PrivateKey, name: str) -> bytes:
    """Return a PEM request, signed with ``key``, for a certificate with the CN ``name``."""
    builder = x509.CertificateSigningRequestBuilder().subject_name(common_name(name))
    return builder.sign(key, hashes.SHA256()).public_bytes(serialization.Encoding.PEM)


def load_request(data: bytes, what: str) -> SigningRequest:
    """Read a PEM request and verify its signature; ``what`` names the request in errors.

    Only keys that every DDS vendor accepts are allowed: EC prime256v1 and RSA 2048.  Extensions in
    a request are ignored: the keystore decides the content of a certificate.

    Raises:
        PkiError: the request cannot be read, its signature does not verify, its key is of another
            kind, or its subject is not exactly one common name.
    """
    with reading(
        f"the request {what} cannot be read",
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
        said = subject_text(subject)
    if not (
        isinstance(public, ec.EllipticCurvePublicKey) and public.curve.name == "secp256r1"
    ) and (not (isinstance(public, rsa.RSAPublicKey) and public.key_size == 2048)):
        raise PkiError(
            f"the request {what} is for a key of {algorithm(public)}",
            "Only EC prime256v1 and RSA 2048 are accepted by every DDS vendor.",
            "Create the key with `sros create_request`.",
        )
    if not isinstance(digest, _DIGESTS) or not _has_valid_signature(request):
        raise PkiError(
            f"the signature of the request {what} is not valid",
            "The sender did not prove possession of the key, or the request was changed "
            "in transit.",
            "Ask the sender to send it again.",
        )
    if len(list(subject)) != 1 or not common_name_of(subject):
        raise PkiError(
            f"the request {what} is for {said or 'an empty subject'}",
            "The subject of a request has to be one common name, the name of the enclave, and "
            "nothing else.",
            "Create it with `sros create_request`.",
        )
    return SigningRequest(
        common_name_of(subject), public, request.public_bytes(serialization.Encoding.PEM)
    )


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
