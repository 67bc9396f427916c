"""Verification of certificate chains as OpenSSL 3 does it for the DDS vendors (x509_vfy.c)."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from datetime import datetime

from cryptography import x509
from cryptography.x509.oid import ExtendedKeyUsageOID, ExtensionOID

from sros_tool.pki.certificates import extension, issued_by, subject_text, validity_of
from sros_tool.validity import iso

_CRITICAL = frozenset(
    {
        ExtensionOID.BASIC_CONSTRAINTS,
        ExtensionOID.KEY_USAGE,
        ExtensionOID.EXTENDED_KEY_USAGE,
        ExtensionOID.SUBJECT_ALTERNATIVE_NAME,
    }
)
"""The critical extensions that are taken; with any other, the chain is refused."""
_NO_USAGE = x509.KeyUsage(*[False] * 9)
_RESTRICTING = {
    ExtensionOID.NAME_CONSTRAINTS.dotted_string: "nameConstraints",
    "1.3.6.1.5.5.7.1.7": "sbgp-ipAddrBlock",
    "1.3.6.1.5.5.7.1.8": "sbgp-autonomousSysNum",
    "1.3.6.1.5.5.7.1.14": "proxyCertInfo",
    "2.16.840.1.113730.1.1": "nsCertType",
}
"""Extensions by which OpenSSL may refuse a chain, and which sros does not decide."""


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
    while not issued_by(chain[-1], chain[-1]):
        issuer = _issuer(chain[-1], [*authorities, *others], at)
        if issuer is None or issuer in chain:
            return f"the issuer {subject_text(chain[-1].issuer)} is not a trusted certificate"
        chain.append(issuer)
    # Of several CA certificates with the same name and key, OpenSSL tries only the first.
    root = next((each for each in authorities if issued_by(chain[-1], each)), None)
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
        and issued_by(certificate, each)
    ]
    return next((each for each in found if validity_of(each).contains(at)), next(iter(found), None))


def _may_sign_certificates(certificate: x509.Certificate) -> bool:
    usage = extension(certificate, x509.KeyUsage)
    return usage is None or usage.key_cert_sign


def _extension_faults(chain: Sequence[x509.Certificate]) -> Iterator[str]:
    for each in chain:
        if extension(each, x509.KeyUsage) == _NO_USAGE:
            yield f"the keyUsage of {subject_text(each.subject)} is empty"
        for found in each.extensions:
            oid = found.oid.dotted_string
            if oid in _RESTRICTING:
                yield f"{subject_text(each.subject)} has {_RESTRICTING[oid]}, not known to sros"
            elif found.critical and found.oid not in _CRITICAL:
                yield f"{subject_text(each.subject)} has the unknown critical extension {oid}"
    for below, each in enumerate(chain[1:]):
        constraints = extension(each, x509.BasicConstraints)
        if constraints is None or not constraints.ca:
            yield f"{subject_text(each.subject)} is not a CA"
        elif constraints.path_length is not None and below > constraints.path_length:
            yield f"the chain is longer than the pathlen of {subject_text(each.subject)} allows"


def purpose_faults(chain: Sequence[x509.Certificate]) -> Iterator[str]:
    """Yield the reasons why the first certificate of ``chain`` must not sign S/MIME messages.

    OpenSSL reports them as "unsuitable certificate purpose".
    """
    usage = extension(chain[0], x509.KeyUsage)
    if usage and not (usage.digital_signature or usage.content_commitment):
        yield (
            f"the keyUsage of {subject_text(chain[0].subject)} lacks digitalSignature, which "
            "signed documents need"
        )
    for each in chain:
        purposes = extension(each, x509.ExtendedKeyUsage)
        if purposes and ExtendedKeyUsageOID.EMAIL_PROTECTION not in purposes:
            name = subject_text(each.subject)
            yield (
                f"the extendedKeyUsage of {name} lacks emailProtection, which signed documents need"
            )


def _strict_faults(chain: Sequence[x509.Certificate]) -> Iterator[str]:
    if not _may_sign_certificates(chain[-1]):
        yield f"the keyUsage of {subject_text(chain[-1].subject)} lacks keyCertSign"
    usage = extension(chain[0], x509.KeyUsage)
    if usage and usage.key_cert_sign and extension(chain[0], x509.BasicConstraints) is None:
        yield f"{subject_text(chain[0].subject)} has keyCertSign but no basicConstraints"
    if len(chain) == 1:
        return
    for each in chain:
        name = subject_text(each.subject)
        usage = extension(each, x509.KeyUsage)
        constraints = extension(each, x509.BasicConstraints)
        if constraints and constraints.ca:
            found = each.extensions.get_extension_for_class(x509.BasicConstraints)
            if not found.critical:
                yield f"the basicConstraints of {name} are not critical"
            if usage is None:
                yield f"{name} is a CA without keyUsage"
            if extension(each, x509.SubjectKeyIdentifier) is None:
                yield f"{name} is a CA without subjectKeyIdentifier"
        elif usage and usage.key_cert_sign:
            yield f"{name} has keyCertSign but is not a CA"
        may_issue = constraints and constraints.ca and usage and usage.key_cert_sign
        if constraints and constraints.path_length is not None and not may_issue:
            yield f"{name} has a pathlen but may not issue certificates"
        if not (name and subject_text(each.issuer)):
            yield "a certificate has an empty subject or issuer"
        names = extension(each, x509.SubjectAlternativeName)
        if names is not None and not list(names):
            yield f"the subjectAltName of {name} is empty"
        if each is not chain[-1]:
            identifier = extension(each, x509.AuthorityKeyIdentifier)
            if identifier is None or identifier.key_identifier is None:
                yield f"{name} lacks an authorityKeyIdentifier"


def _time_faults(chain: Sequence[x509.Certificate], at: datetime) -> Iterator[str]:
    for each in chain:
        validity = validity_of(each)
        if at > validity.not_after:
            yield f"{subject_text(each.subject)} expired at {iso(validity.not_after)}"
        elif at < validity.not_before:
            yield f"{subject_text(each.subject)} is not valid before {iso(validity.not_before)}"
