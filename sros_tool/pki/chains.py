"""Verification of certificate chains as OpenSSL 3 does it for the DDS vendors (x509_vfy.c)."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from datetime import datetime
from functools import lru_cache
from typing import TypeVar

from cryptography import x509
from cryptography.x509.oid import ExtendedKeyUsageOID

from sros_tool.pki.certificates import issued_by, subject_text, validity_of
from sros_tool.validity import iso

Extension = TypeVar("Extension", bound=x509.ExtensionType)

_issued_by = lru_cache(maxsize=256)(issued_by)  # the same few certificates are checked repeatedly


def chain_fault(
    start: x509.Certificate,
    authorities: Sequence[x509.Certificate],
    others: Iterable[x509.Certificate] = (),
    *,
    at: datetime,
    for_documents: bool = False,
    strict: bool = False,
) -> str:
    """Return why ``start`` has no valid chain to a self-signed CA of ``authorities``, or "".

    ``others`` are possible intermediate certificates; validities are checked at the time ``at``.
    ``for_documents`` also checks the purpose S/MIME, and ``strict`` the rules of RFC 5280 for
    chains (OpenSSL's ``X509_V_FLAG_X509_STRICT`` with ``X509_V_FLAG_CHECK_SS_SIGNATURE``).
    """
    chain = [start]
    while not _issued_by(chain[-1], chain[-1]):
        issuer = _issuer(chain[-1], [*authorities, *others], at)
        if issuer is None or issuer in chain:
            return f"the issuer {subject_text(chain[-1].issuer)} is not a trusted certificate"
        chain.append(issuer)
    # Of several CA certificates with the same name and key, OpenSSL tries only the first.
    root = next((each for each in authorities if _issued_by(chain[-1], each)), None)
    if root != chain[-1]:
        return f"the self-signed {subject_text(chain[-1].subject)} is not a trusted certificate"
    faults = (
        *_extension_faults(chain),
        *(purpose_faults(chain) if for_documents else ()),
        *(_strict_faults(chain) if strict else ()),
        *_time_faults(chain, at),
    )
    return next(iter(faults), "")


def _issuer(
    certificate: x509.Certificate, among: Iterable[x509.Certificate], at: datetime
) -> x509.Certificate | None:
    found = [
        each
        for each in among
        if each.subject == certificate.issuer
        and _may_sign_certificates(each)
        and _issued_by(certificate, each)
    ]
    return next((each for each in found if validity_of(each).contains(at)), next(iter(found), None))


def _extension(certificate: x509.Certificate, kind: type[Extension]) -> Extension | None:
    try:
        return certificate.extensions.get_extension_for_class(kind).value
    except x509.ExtensionNotFound:
        return None


def _may_sign_certificates(certificate: x509.Certificate) -> bool:
    usage = _extension(certificate, x509.KeyUsage)
    return usage is None or usage.key_cert_sign


def _extension_faults(chain: Sequence[x509.Certificate]) -> Iterator[str]:
    for below, each in enumerate(chain[1:]):
        constraints = _extension(each, x509.BasicConstraints)
        if constraints is None or not constraints.ca:
            yield f"{subject_text(each.subject)} is not a CA"
        elif constraints.path_length is not None and below > constraints.path_length:
            yield f"the chain is longer than the pathlen of {subject_text(each.subject)} allows"


def purpose_faults(chain: Sequence[x509.Certificate]) -> Iterator[str]:
    """Yield the reasons why the first certificate of ``chain`` must not sign S/MIME messages.

    OpenSSL reports them as "unsuitable certificate purpose".
    """
    usage = _extension(chain[0], x509.KeyUsage)
    if usage and not (usage.digital_signature or usage.content_commitment):
        yield (
            f"the keyUsage of {subject_text(chain[0].subject)} lacks digitalSignature, which "
            "signed documents need"
        )
    for each in chain:
        purposes = _extension(each, x509.ExtendedKeyUsage)
        if purposes and ExtendedKeyUsageOID.EMAIL_PROTECTION not in purposes:
            name = subject_text(each.subject)
            yield (
                f"the extendedKeyUsage of {name} lacks emailProtection, which signed documents need"
            )


def _strict_faults(chain: Sequence[x509.Certificate]) -> Iterator[str]:
    if not _may_sign_certificates(chain[-1]):
        yield f"the keyUsage of {subject_text(chain[-1].subject)} lacks keyCertSign"
    usage = _extension(chain[0], x509.KeyUsage)
    if usage and usage.key_cert_sign and _extension(chain[0], x509.BasicConstraints) is None:
        yield f"{subject_text(chain[0].subject)} has keyCertSign but no basicConstraints"
    if len(chain) == 1:
        return
    for each in chain:
        name = subject_text(each.subject)
        constraints = _extension(each, x509.BasicConstraints)
        if constraints and constraints.ca:
            found = each.extensions.get_extension_for_class(x509.BasicConstraints)
            if not found.critical:
                yield f"the basicConstraints of {name} are not critical"
            if _extension(each, x509.KeyUsage) is None:
                yield f"{name} is a CA without keyUsage"
            if _extension(each, x509.SubjectKeyIdentifier) is None:
                yield f"{name} is a CA without subjectKeyIdentifier"
        if each is not chain[-1] and _extension(each, x509.AuthorityKeyIdentifier) is None:
            yield f"{name} lacks an authorityKeyIdentifier"


def _time_faults(chain: Sequence[x509.Certificate], at: datetime) -> Iterator[str]:
    for each in chain:
        validity = validity_of(each)
        if at > validity.not_after:
            yield f"{subject_text(each.subject)} expired at {iso(validity.not_after)}"
        elif at < validity.not_before:
            yield f"{subject_text(each.subject)} is not valid before {iso(validity.not_before)}"
