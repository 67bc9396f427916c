"""Verification of a certificate with revocation lists, as OpenSSL 3.0 does it (x509_vfy.c).

The DDS vendors ask for a list of the CA that issued the certificate, not for lists of the CAs above
it (``X509_V_FLAG_CRL_CHECK`` without ``X509_V_FLAG_CRL_CHECK_ALL``).
"""

from __future__ import annotations

from collections.abc import Sequence
from datetime import datetime
from enum import Enum
from functools import lru_cache
from typing import NamedTuple

from cryptography import x509
from cryptography.x509.oid import CRLEntryExtensionOID, ExtensionOID

from sros_tool.pki.certificates import Extension, extension, is_signed, subject_text
from sros_tool.pki.crl import (
    lists_as_revoked,
    may_sign_lists,
    names_issuers,
)
from sros_tool.pki.names import canonical, same_name
from sros_tool.pki.tolerant_extensions import ContradictoryPoint
from sros_tool.validity import iso

Lists = Sequence[x509.CertificateRevocationList]

_READ_IF_CRITICAL = (
    ExtensionOID.ISSUING_DISTRIBUTION_POINT,
    ExtensionOID.AUTHORITY_KEY_IDENTIFIER,
    ExtensionOID.DELTA_CRL_INDICATOR,
)
_REASONS = frozenset(x509.ReasonFlags) - {
    x509.ReasonFlags.unspecified,
    x509.ReasonFlags.remove_from_crl,
}


class Obstacle(Enum):
    """Why a certificate is refused with the revocation lists that there are."""

    MISSING = "no list of its CA"
    USAGE = "the CA may not sign lists"
    SCOPE = "the list is not for this certificate"
    CRITICAL = "the list has an unknown critical extension"
    NOT_YET_VALID = "the list is not valid yet"
    EXPIRED = "the list has expired"
    SIGNATURE = "another key signed the list"
    REVOKED = "the certificate is revoked"


class ListRefusal(NamedTuple):
    """Why a certificate is refused, the list that is the reason if there is one, and a clause."""

    obstacle: Obstacle
    list: x509.CertificateRevocationList | None
    text: str


class _Score(NamedTuple):
    """How well a list fits, in the order that OpenSSL weighs it (get_crl_score)."""

    only_known: bool
    in_scope: bool
    current: bool
    from_issuer: bool

    @property
    def is_valid(self) -> bool:
        return self.only_known and self.in_scope and self.current


def list_refusal(
    chain: Sequence[x509.Certificate], lists: Lists, *, at: datetime
) -> ListRefusal | None:
    """Return why OpenSSL refuses ``chain[0]`` with these lists at the time ``at``, or None.

    ``chain`` leads to a self-signed CA, and is valid without lists.
    """
    certificate = chain[0]
    found = _best(chain, lists, at)
    if found is None:
        name = subject_text(certificate.issuer)
        text = f"there is no revocation list of {name}, for which OpenSSL asks where it has another"
        return ListRefusal(Obstacle.MISSING, None, text)
    crl, issuer, score = found
    name = subject_text(issuer.subject)
    if not may_sign_lists(issuer):
        text = f"the keyUsage of {name} lacks cRLSign"
        return ListRefusal(Obstacle.USAGE, crl, text)
    if not score.in_scope:
        return ListRefusal(Obstacle.SCOPE, crl, "it is not for all certificates of its CA")
    if crl.last_update_utc > at:
        text = f"it is not valid before {iso(crl.last_update_utc)}"
        return ListRefusal(Obstacle.NOT_YET_VALID, crl, text)
    if _has_expired(crl, at):
        assert crl.next_update_utc
        return ListRefusal(Obstacle.EXPIRED, crl, f"it expired at {iso(crl.next_update_utc)}")
    if not _is_signed(_Content(crl), issuer):
        return ListRefusal(Obstacle.SIGNATURE, crl, f"it is not signed with the key of {name}")
    if not score.only_known:
        return ListRefusal(Obstacle.CRITICAL, crl, "it has an unknown critical extension")
    if _revokes(crl, certificate):
        return ListRefusal(Obstacle.REVOKED, crl, "it is revoked")
    if not _all_reasons(certificate, crl):
        text = "the certificate names lists for some reasons only"
        return ListRefusal(Obstacle.SCOPE, crl, text)
    return None


def _revokes(crl: x509.CertificateRevocationList, certificate: x509.Certificate) -> bool:
    """Return whether the list has an entry for the certificate, and not one that takes it back."""
    if not _entries(_Content(crl)).name_issuers:
        return lists_as_revoked(crl, certificate.serial_number)
    issuers: list[x509.Name] | None = None
    for entry in crl:
        for each in entry.extensions:
            if isinstance(each.value, x509.CertificateIssuer):
                issuers = each.value.get_values_for_type(x509.DirectoryName)
        if entry.serial_number == certificate.serial_number and (
            issuers is None or any(same_name(each, certificate.issuer) for each in issuers)
        ):
            return not any(
                isinstance(each.value, x509.CRLReason)
                and each.value.reason is x509.ReasonFlags.remove_from_crl
                for each in entry.extensions
            )
    return False


def _best(
    chain: Sequence[x509.Certificate], lists: Lists, at: datetime
) -> tuple[x509.CertificateRevocationList, x509.Certificate, _Score] | None:
    """Return the list that OpenSSL chooses: what fits best, then the newest (get_crl_sk)."""
    best: tuple[x509.CertificateRevocationList, x509.Certificate, _Score] | None = None
    for crl in lists:
        issuer = _issuer(chain, crl)
        point = _value(crl, x509.IssuingDistributionPoint)
        if issuer is None or (point and (point.indirect_crl or point.only_some_reasons)):
            continue
        if _value(crl, x509.DeltaCRLIndicator) or _value(crl, ContradictoryPoint):
            continue
        score = _Score(
            not _entries(_Content(crl)).has_unknown,
            _is_in_scope(chain[0], crl, point),
            crl.last_update_utc <= at and not _has_expired(crl, at),
            issuer is chain[min(1, len(chain) - 1)],
        )
        if best is None or (score, crl.last_update_utc) > (best[2], best[0].last_update_utc):
            best = (crl, issuer, score)
    return best


def _issuer(
    chain: Sequence[x509.Certificate], crl: x509.CertificateRevocationList
) -> x509.Certificate | None:
    """Return the CA of the chain whose list it is, or None (crl_akid_check).

    Only lists with the name of the certificate's issuer are looked at.
    """
    if not same_name(crl.issuer, chain[0].issuer):
        return None
    identifier = _value(crl, x509.AuthorityKeyIdentifier)
    first = 1 if len(chain) > 1 else 0
    for place, each in enumerate(chain[first:]):
        named = place == 0 or same_name(each.subject, crl.issuer)
        if named and (identifier is None or _identifies(identifier, each)):
            return each
    return None


def _identifies(identifier: x509.AuthorityKeyIdentifier, authority: x509.Certificate) -> bool:
    """Return whether a key identifier names the CA (X509_check_akid)."""
    own = extension(authority, x509.SubjectKeyIdentifier)
    if identifier.key_identifier is not None and own and identifier.key_identifier != own.digest:
        return False
    if identifier.authority_cert_serial_number not in (None, authority.serial_number):
        return False
    names = [
        each.value
        for each in identifier.authority_cert_issuer or ()
        if isinstance(each, x509.DirectoryName)
    ]
    return not names or same_name(names[0], authority.issuer)


class _Content:
    """A list with a hash, that of the object: all enclaves of a keystore have the same lists."""

    def __init__(self, crl: x509.CertificateRevocationList) -> None:
        self.crl = crl

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Content) and self.crl is other.crl

    def __hash__(self) -> int:
        return id(self.crl)


class _Entries(NamedTuple):
    """Whether a list has a critical extension that OpenSSL does not know, also in an entry.

    ``name_issuers`` says whether its entries name the CAs whose certificates they revoke.
    """

    has_unknown: bool
    name_issuers: bool


@lru_cache(maxsize=16)
def _entries(content: _Content) -> _Entries:
    crl = content.crl
    unknown = any(each.critical and each.oid not in _READ_IF_CRITICAL for each in crl.extensions)
    in_entry = any(
        each.critical and each.oid != CRLEntryExtensionOID.CERTIFICATE_ISSUER
        for entry in crl
        for each in entry.extensions
    )
    return _Entries(unknown or in_entry, names_issuers(crl))


@lru_cache(maxsize=16)
def _is_signed(content: _Content, issuer: x509.Certificate) -> bool:
    return is_signed(content.crl, content.crl.tbs_certlist_bytes, issuer)


def _is_in_scope(
    certificate: x509.Certificate,
    crl: x509.CertificateRevocationList,
    point: x509.IssuingDistributionPoint | None,
) -> bool:
    """Return whether the list is for the certificate (crl_crldp_check)."""
    if point is None:
        return True
    constraints = extension(certificate, x509.BasicConstraints)
    is_ca = constraints is not None and constraints.ca
    if point.only_contains_attribute_certs or (
        point.only_contains_user_certs if is_ca else point.only_contains_ca_certs
    ):
        return False
    if point.full_name is None and point.relative_name is None:
        return True
    places = extension(certificate, x509.CRLDistributionPoints)
    return any(_same_place(place, point) for place in places or () if _is_of(place, crl))


def _is_of(place: x509.DistributionPoint, crl: x509.CertificateRevocationList) -> bool:
    if place.crl_issuer is None:
        return True
    names = [each.value for each in place.crl_issuer if isinstance(each, x509.DirectoryName)]
    return any(same_name(each, crl.issuer) for each in names)


def _same_place(place: x509.DistributionPoint, point: x509.IssuingDistributionPoint) -> bool:
    if place.full_name is None and place.relative_name is None:
        return True
    if place.full_name is not None and point.full_name is not None:
        ours = [_general_name(each) for each in place.full_name]
        return any(_general_name(each) in ours for each in point.full_name)
    return False  # names relative to the issuer: not decided here, and seldom used


def _general_name(name: x509.GeneralName) -> object:
    return canonical(name.value) if isinstance(name, x509.DirectoryName) else name


def _all_reasons(certificate: x509.Certificate, crl: x509.CertificateRevocationList) -> bool:
    """Return whether the places of lists in the certificate leave out no reason."""
    for place in extension(certificate, x509.CRLDistributionPoints) or ():
        if _is_of(place, crl):
            return place.reasons is None or place.reasons >= _REASONS
    return True


def _has_expired(crl: x509.CertificateRevocationList, at: datetime) -> bool:
    return crl.next_update_utc is not None and crl.next_update_utc <= at


def _value(crl: x509.CertificateRevocationList, kind: type[Extension]) -> Extension | None:
    try:
        return crl.extensions.get_extension_for_class(kind).value
    except x509.ExtensionNotFound:
        return None
