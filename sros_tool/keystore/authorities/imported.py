"""Checks of an existing CA before a keystore imports it."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from datetime import datetime

from cryptography import x509
from cryptography.hazmat.primitives import hashes
from cryptography.hazmat.primitives.asymmetric import ec, rsa

from sros_tool.dds.decision.vendors import MEASURED, Vendor
from sros_tool.errors import Note, PkiError
from sros_tool.keystore.layout import IDENTITY, PERMISSIONS
from sros_tool.keystore.loading import authority_refusals, refusals_text
from sros_tool.pki.certificates import (
    issued_by,
    load_certificates,
    pem,
    same_key,
    subject_text,
    validity_of,
    weakness,
)
from sros_tool.pki.chains import denies_issuing, purpose_faults
from sros_tool.pki.keys import PrivateKey, algorithm
from sros_tool.validity import iso

_MOST_CERTIFICATES = 8


@dataclass(frozen=True, slots=True)
class ImportedAuthority:
    """An existing CA: its certificate, the chain up to the root, and notes.

    ``bundle`` is the PEM for the CA file: the issuing certificate first, the root last.
    """

    certificate: x509.Certificate
    bundle: bytes
    notes: tuple[Note, ...]


def check_imported(role: str, data: bytes, key: PrivateKey, now: datetime) -> ImportedAuthority:
    """Return the CA certificate of ``key`` with its chain, after checking them.

    ``data`` holds the certificates of the CA and of its issuers as PEM, in any order.  A fault
    that only some DDS vendors refuse becomes a note.

    Raises:
        PkiError: the CA cannot be the ``role`` CA.
    """
    certificates = list(load_certificates(data, f"of the {role} CA"))
    own = [each for each in certificates if same_key(each, key)]
    if len(certificates) > _MOST_CERTIFICATES:
        raise PkiError(
            f"the certificate file of the {role} CA has {len(certificates)} certificates",
            f"At most {_MOST_CERTIFICATES} are allowed.",
            "Put only the CA and its issuers up to the root into the file.",
        )
    if not own:
        raise PkiError(
            f"the certificate of the {role} CA does not fit its key",
            f"The key belongs to none of the certificates in the file ({len(certificates)}).",
            "Name the certificate and the key of the same CA.",
        )
    for weak in filter(None, map(weakness, certificates)):
        raise PkiError(
            f"{subject_text(own[0].subject)} cannot be the {role} CA: {weak}",
            "Whoever forges its signatures can issue any identity or any permissions.",
            "Use a CA with EC prime256v1 or RSA 2048 keys, signed with SHA-256, or let sros create "
            "one.",
        )
    chain = list(_chain(own[0], certificates, role))
    for each in chain:
        _check_ca(each, role, now)
    refusals = authority_refusals(role, tuple(chain), now)
    if len(refusals) == len(MEASURED):
        raise PkiError(
            f"{subject_text(own[0].subject)} cannot be the {role} CA: no DDS vendor accepts it",
            f"{refusals_text(refusals)}.",
            "Issue the CA's certificate again, self-signed with SHA-256, basicConstraints CA:TRUE "
            "and keyUsage keyCertSign and digitalSignature.",
        )
    return ImportedAuthority(
        own[0], b"".join(map(pem, chain)), tuple(_notes(role, chain, refusals))
    )


def _chain(
    start: x509.Certificate, certificates: list[x509.Certificate], role: str
) -> Iterator[x509.Certificate]:
    """Yield ``start`` and its issuers, up to the self-signed root."""
    current, left = start, [each for each in certificates if each != start]
    yield current
    while not issued_by(current, current):
        above = next((each for each in left if issued_by(current, each)), None)
        if above is None:
            raise PkiError(
                f"the chain of the {role} CA has no root",
                f"The issuer {subject_text(current.issuer)} is not in the file.",
                "Put all certificates up to the self-signed root into one PEM file.",
            )
        left.remove(above)
        current = above
        yield current


def _check_ca(certificate: x509.Certificate, role: str, now: datetime) -> None:
    """Raise `PkiError` if a certificate says that it is no CA's, or is not valid ``now``.

    Whether a certificate that says neither is one of a CA is left to the vendors.
    """
    name = subject_text(certificate.subject)
    if denies_issuing(certificate):
        raise PkiError(
            f"{name} cannot be the {role} CA",
            "Its certificate does not allow it to issue certificates.",
            "It needs basicConstraints CA:TRUE, and keyCertSign in its keyUsage.",
        )
    validity = validity_of(certificate)
    if not validity.contains(now):
        raise PkiError(
            f"{name} cannot be the {role} CA now",
            f"It is valid from {iso(validity.not_before)} to {iso(validity.not_after)}.",
        )


def _notes(
    role: str, chain: list[x509.Certificate], refusals: Mapping[Vendor, str]
) -> Iterator[Note]:
    name = subject_text(chain[0].subject)
    if len(chain) > 1:
        yield Note(
            "portable.intermediate", f"{name} is an intermediate CA. {refusals_text(refusals)}."
        )
    elif role == PERMISSIONS and (fault := next(purpose_faults(chain), "")):
        yield Note(
            "portable.ca-purpose",
            f"{fault}: Fast DDS 2.9.1 and Cyclone DDS 0.10.2 refuse every document that it signs "
            '("unsuitable certificate purpose"), and only Fast DDS 2.14 accepts them. Issue its '
            "certificate again with keyUsage digitalSignature and without extendedKeyUsage, unless "
            "all robots run Fast DDS 2.14.",
        )
    for each in chain:
        key, name = each.public_key(), subject_text(each.subject)
        fits = (isinstance(key, ec.EllipticCurvePublicKey) and key.curve.name == "secp256r1") or (
            isinstance(key, rsa.RSAPublicKey) and key.key_size == 2048
        )
        if role == IDENTITY and not fits:
            yield Note(
                "portable.key-algorithm",
                f"{name} has a key of {algorithm(key)}; Cyclone DDS accepts only EC secp256r1 and "
                "RSA 2048.",
            )
        if not isinstance(each.signature_hash_algorithm, hashes.SHA256):
            yield Note(
                "portable.signature-hash",
                f"{name} is not signed with SHA-256, so Fast DDS rejects this CA.",
            )
