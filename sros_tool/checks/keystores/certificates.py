"""What vendors ask of certificates: algorithms, extensions, and no intermediate CA."""

from __future__ import annotations

from collections.abc import Iterator
from datetime import datetime

from cryptography import x509
from cryptography.hazmat.primitives import hashes
from cryptography.hazmat.primitives.asymmetric import ec, rsa

from sros_tool.checks.kind import ERROR, NOTE, WARNING, Finding, Kind, by_id
from sros_tool.keystore.acceptance import authority_refusals, refusals_text
from sros_tool.keystore.layout import PERMISSIONS
from sros_tool.pki.certificates import subject_text
from sros_tool.pki.chains import purpose_faults
from sros_tool.pki.keys import algorithm

NOT_A_CA = Kind(
    "keystore.not-a-ca",
    ERROR,
    "a CA certificate that does not say that it is one",
    "OpenSSL refuses chains over it.",
    "RFC 5280, 4.2.1.9 and 4.2.1.3 (BasicConstraints, KeyUsage keyCertSign).",
    "Replace it with `sros rotate_ca ROOT`.",
)
CA_EXTENSIONS = Kind(
    "keystore.ca-extensions",
    NOTE,
    "a CA certificate without key identifiers or key usage",
    "Fast DDS checks strictly, and refuses it as soon as an intermediate CA is in play. CAs of "
    "ros2/sros2 are so.",
    "RFC 5280, 4.2.1.1 to 4.2.1.3; openssl verify -x509_strict.",
    "Replace it with `sros rotate_ca ROOT`, if intermediates are to come.",
)
INTERMEDIATE = Kind(
    "portable.intermediate",
    WARNING,
    "a CA that is not self-signed",
    "Cyclone DDS takes a self-signed CA only, the first of its file. Fast DDS follows a chain of "
    "identity CAs, 2.14 only where each has keyUsage and key identifiers. What a permissions CA "
    "below another signs, Fast DDS 2.14 takes if it has keyUsage, 2.9 if it may sign documents.",
    "Fast DDS 2.9.1 and 2.14.5 (FileProvider.cpp), Cyclone DDS 0.10.2; measured.",
    "Use a root for robots of its own, unless all run a Fast DDS that takes it.",
)
CA_PURPOSE = Kind(
    "portable.ca-purpose",
    WARNING,
    "a permissions CA whose certificate is not for signing documents",
    "Fast DDS 2.9 and Cyclone DDS verify the purpose of S/MIME, and refuse every document "
    '("unsuitable certificate purpose"): keyUsage must have digitalSignature, extendedKeyUsage '
    "emailProtection, if they are there. Fast DDS 2.14 does not look at them.",
    "RFC 8550, 4.4.2; Fast DDS 2.9.1 and 2.14.5 (Permissions.cpp), Cyclone DDS 0.10.2; measured.",
    "Replace it with `sros rotate_ca ROOT`, or issue its certificate anew with digitalSignature.",
    vendors=("fastdds-2.9", "cyclonedds"),
)
KEY_ALGORITHM = Kind(
    "portable.key-algorithm",
    WARNING,
    "a key that not every vendor takes",
    "Cyclone DDS takes EC prime256v1 and RSA of exactly 2048 bits alone. Fast DDS takes larger "
    "ones of both kinds too, but no Ed25519, which fails in its handshake.",
    "DDS-Security 1.1, 9.3.1; Cyclone DDS 0.10.2, Fast DDS 2.9.1 and 2.14.5; measured.",
    "Use EC prime256v1, as sros does.",
)
SIGNATURE_HASH = Kind(
    "portable.signature-hash",
    WARNING,
    "a certificate that is not signed with SHA-256",
    "Fast DDS refuses SHA-384 in a CA and in an enclave's certificate; Cyclone DDS takes it.",
    "Fast DDS 2.9.1 and 2.14.5 (PKIDH.cpp), Cyclone DDS 0.10.2; measured.",
    "Issue it with SHA-256, as sros does.",
    vendors=("fastdds", "fastdds-2.9"),
)

KINDS = by_id(
    NOT_A_CA, CA_EXTENSIONS, INTERMEDIATE, CA_PURPOSE, KEY_ALGORITHM, SIGNATURE_HASH
)  # fmt: skip


def authority_findings(
    role: str, chain: tuple[x509.Certificate, ...], at: datetime, subject: str, file: str
) -> Iterator[Finding]:
    """Whether every vendor takes a CA; ``chain`` are the certificates of its file, in order."""
    certificate = chain[0]
    name = subject_text(certificate.subject)
    if certificate.issuer != certificate.subject:
        issuer = subject_text(certificate.issuer)
        told = refusals_text(authority_refusals(role, chain, at))
        yield INTERMEDIATE.found(subject, f"{name} is issued by {issuer}. {told}", file)
    elif role == PERMISSIONS and (fault := next(purpose_faults(chain[:1]), "")):
        yield CA_PURPOSE.found(subject, fault, file)
    yield from key_findings(certificate, subject, file, what=f"{name} has")
    yield from _extensions(certificate, subject, name, file)


def key_findings(
    certificate: x509.Certificate, subject: str, file: str, *, what: str = "it has"
) -> Iterator[Finding]:
    """Whether every vendor takes the key and the signature of a certificate."""
    key = certificate.public_key()
    fits = (isinstance(key, ec.EllipticCurvePublicKey) and key.curve.name == "secp256r1") or (
        isinstance(key, rsa.RSAPublicKey) and key.key_size == 2048
    )
    if not fits:
        yield KEY_ALGORITHM.found(subject, f"{what} a key of {algorithm(key)}", file)
    digest = certificate.signature_hash_algorithm
    if not isinstance(digest, hashes.SHA256):
        name = digest.name.upper() if digest else "no digest"
        yield SIGNATURE_HASH.found(subject, f"{what} a signature with {name}", file)


def _extensions(
    certificate: x509.Certificate, subject: str, name: str, file: str
) -> Iterator[Finding]:
    extensions = certificate.extensions
    present = {type(each.value): each.value for each in extensions}
    constraints = present.get(x509.BasicConstraints)
    usage = present.get(x509.KeyUsage)
    is_ca = isinstance(constraints, x509.BasicConstraints) and constraints.ca
    may_sign = not isinstance(usage, x509.KeyUsage) or usage.key_cert_sign
    if not (is_ca and may_sign):
        yield NOT_A_CA.found(subject, f"{name} may not issue certificates", file)
    wanted = (x509.KeyUsage, x509.SubjectKeyIdentifier, x509.AuthorityKeyIdentifier)
    missing = [kind.__name__ for kind in wanted if kind not in present]
    if missing:
        yield CA_EXTENSIONS.found(subject, f"{name} lacks {', '.join(missing)}", file)
