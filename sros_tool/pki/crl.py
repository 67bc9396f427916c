"""Certificate revocation lists (CRLs, RFC 5280, section 5), and the decisions of OpenSSL with CRLs.

DDS vendors need a list only of the CA that issued the certificate, not of the CAs above it
(``X509_V_FLAG_CRL_CHECK`` without ``X509_V_FLAG_CRL_CHECK_ALL``).
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from contextlib import AbstractContextManager
from datetime import datetime, timedelta
from enum import Enum
from functools import lru_cache
from typing import NamedTuple, cast

from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.x509.oid import CRLEntryExtensionOID, ExtensionOID

from sros_tool.errors import PkiError
from sros_tool.pki import der, pem, tolerant
from sros_tool.pki.certificates import (
    authority_identifier,
    extension,
    identifies,
    is_signed,
    load_certificates,
    subject_text,
)
from sros_tool.pki.distinguished_names import (
    canonical,
    check_name_readable,
    may_be_read_error,
    reading,
    same_name,
)
from sros_tool.pki.keys import PrivateKey
from sros_tool.pki.pem import kind_of
from sros_tool.pki.tolerant import ContradictoryPoint
from sros_tool.validity import iso, soon_limit

CRL_MARK = b"-----BEGIN X509 CRL-----"
"""The first line of a PEM revocation list."""
_PEM_LABEL = "X509 CRL"
REASONS = tuple(
    flag.value
    for flag in x509.ReasonFlags
    # remove_from_crl only occurs in delta CRLs.
    if flag not in (x509.ReasonFlags.remove_from_crl,)
)
"""The reasons for a revocation, by their names in RFC 5280."""
_RESTORE = "Restore it from a backup."

SUPERSEDED = x509.ReasonFlags.superseded.value
"""The reason for revoking a certificate that was renewed, although its key may still be in use."""


class RevocationEntry(NamedTuple):
    """An entry of a revocation list; ``reason`` is one of `REASONS`."""

    serial: int
    date: datetime
    reason: str = "unspecified"


class RevocationList(NamedTuple):
    """A revocation list whose signature is not verified yet.

    ``list`` is the list as `cryptography` reads it.  ``revoked`` leaves out entries with the reason
    removeFromCRL, because they revoke nothing.
    """

    number: int
    this_update: datetime
    next_update: datetime
    revoked: tuple[RevocationEntry, ...]
    list: x509.CertificateRevocationList

    def expires_soon_from(self) -> datetime:
        """Return the time from which the list counts as expiring soon, or has expired."""
        lifetime = max(self.next_update - self.this_update, timedelta())
        return self.next_update - soon_limit(lifetime)

    def revokes(self, serial: int) -> bool:
        """Return whether the list revokes the certificate with the serial number ``serial``."""
        return any(entry.serial == serial for entry in self.revoked)


def sign_crl(
    issuer: x509.Certificate,
    key: PrivateKey,
    revoked: Iterable[RevocationEntry],
    *,
    number: int,
    this_update: datetime,
    next_update: datetime,
) -> bytes:
    """Return a signed revocation list, as PEM.

    Args:
        issuer: the certificate of the CA.
        key: the private key of the CA.
        revoked: the entries.
        number: the number of the list, larger than the number of the previous list.
        this_update: the time from which the list is valid.
        next_update: the time at which the list expires.

    Raises:
        PkiError: a serial number is negative, or has more than 159 bits.
    """
    builder = (
        x509.CertificateRevocationListBuilder()
        .issuer_name(issuer.subject)
        .last_update(this_update)
        .next_update(next_update)
        .add_extension(x509.CRLNumber(number), critical=False)
        .add_extension(authority_identifier(issuer), critical=False)
    )
    for revocation in revoked:
        if not 0 < revocation.serial < 1 << 159:
            raise PkiError(
                f"the serial number {revocation.serial:x} cannot be put on a revocation list",
                "Serial numbers are positive, and have at most 159 bits (RFC 5280, 4.1.2.2).",
                "Sign the revocation list with the program that issued the certificate.",
            )
        entry = (
            x509.RevokedCertificateBuilder()
            .serial_number(revocation.serial)
            .revocation_date(revocation.date)
        )
        if revocation.reason != "unspecified":  # RFC 5280, 5.3.1: no extension means "unspecified"
            entry = entry.add_extension(
                x509.CRLReason(x509.ReasonFlags(revocation.reason)), critical=False
            )
        builder = builder.add_revoked_certificate(entry.build())
    return builder.sign(key, hashes.SHA256()).public_bytes(serialization.Encoding.PEM)


def load_crl(data: bytes, label: str) -> RevocationList:
    """Return the first revocation list of a PEM file; the list must state when it expires.

    Raises:
        PkiError: the list cannot be read, or states no expiry; ``label`` names the file.
    """
    return _fields_of(read_list(data, label), label)


def load_crls(data: bytes, label: str) -> tuple[RevocationList, ...]:
    """Return all revocation lists of a PEM file, which may have certificates, too.

    Raises:
        PkiError: as `load_crl`, for any list.
    """
    return tuple(_fields_of(crl, label) for crl in read_lists(data, label))


def _fields_of(crl: x509.CertificateRevocationList, label: str) -> RevocationList:
    expiry = next_update(crl)
    if expiry is None:
        raise PkiError(f"the revocation list {label} does not say when it expires", "", _RESTORE)
    return RevocationList(list_number(crl), last_update(crl), expiry, _entries_of(crl), crl)


def _entries_of(crl: x509.CertificateRevocationList) -> tuple[RevocationEntry, ...]:
    """Return the entries of a list; entries with the reason removeFromCRL are left out."""
    return tuple(entry for entry in map(_revocation_entry, crl) if entry.reason in REASONS)


def last_update(crl: x509.CertificateRevocationList) -> datetime:
    """Return the time from which a revocation list is valid, in UTC."""
    return cast(datetime, tolerant.date(crl, "last_update"))


def next_update(crl: x509.CertificateRevocationList) -> datetime | None:
    """Return the time at which a revocation list expires, in UTC; None if no time is stated."""
    return cast("datetime | None", tolerant.date(crl, "next_update"))


def read_list(data: bytes, label: str) -> x509.CertificateRevocationList:
    """Return the first revocation list of a PEM file, even if it states no expiry.

    Raises:
        PkiError: the list cannot be read; ``label`` names the file.
    """
    with _reading_list(label, data):
        blocks = pem.blocks(data)
        return _read_block(next(block for block in blocks if block.label == _PEM_LABEL))


def read_lists(data: bytes, label: str) -> tuple[x509.CertificateRevocationList, ...]:
    """Return all revocation lists of a PEM file, which may also contain certificates.

    Raises:
        PkiError: a list, or a block before it, cannot be read; ``label`` names the file.
    """
    with _reading_list(label, data):
        blocks = pem.blocks(data)
        return tuple(_read_block(block) for block in blocks if block.label == _PEM_LABEL)


def _reading_list(label: str, data: bytes) -> AbstractContextManager[None]:
    kind = "" if CRL_MARK in data else kind_of(data)
    why = f"It is not a PEM revocation list, but {kind}" if kind else "It is not a revocation list"
    return reading(
        f"the revocation list {label} cannot be read",
        f"{why}, so DDS refuses every participant.",
        _RESTORE,
    )


def _read_block(block: pem.Block) -> x509.CertificateRevocationList:
    if block.headers:
        raise ValueError("OpenSSL reads no list with PEM headers")
    return _load_list(block.content)


@lru_cache(maxsize=8)
def _load_list(content: bytes) -> x509.CertificateRevocationList:
    data, _ = der.split(content)
    try:
        return _read_in_full(x509.load_der_x509_crl(data))
    except BaseException as error:
        if not may_be_read_error(error):
            raise
    return _read_in_full(tolerant.read_list(data))


def _read_in_full(crl: x509.CertificateRevocationList) -> x509.CertificateRevocationList:
    check_name_readable(crl.issuer)
    subject_text(crl.issuer)
    _ = last_update(crl), next_update(crl), crl.signature_hash_algorithm, list_number(crl)
    for entry in crl:
        _revocation_entry(entry)
    return crl


def embedded_lists(data: bytes) -> list[bytes]:
    """Return the revocation lists in a CA file, each as a PEM document.

    OpenSSL reads all lists in the file that begin at the start of a line (pem_lib.c).
    """
    return [CRL_MARK + text for text in (b"\n" + data).split(b"\n" + CRL_MARK)[1:]]


def names_issuers(crl: x509.CertificateRevocationList) -> bool:
    """Return whether an entry of the list names the CA that issued the revoked certificate.

    Such a list is indirect: its entries can be certificates of several CAs (certificateIssuer).
    """
    return any(
        ext.oid == CRLEntryExtensionOID.CERTIFICATE_ISSUER
        for entry in crl
        for ext in entry.extensions
    )


def lists_as_revoked(crl: x509.CertificateRevocationList, serial: int) -> bool:
    """Return whether a list revokes the certificate with the serial number ``serial``.

    An entry with the reason removeFromCRL revokes nothing (OpenSSL 3, x509_vfy.c, cert_crl).
    """
    # RFC 5280 forbids negative numbers, OpenSSL accepts them, and the search below raises for them.
    if serial < 0:
        entry = next(
            (
                revoked_certificate
                for revoked_certificate in crl
                if revoked_certificate.serial_number == serial
            ),
            None,
        )
    else:
        entry = crl.get_revoked_certificate_by_serial_number(serial)
    return entry is not None and _revocation_entry(entry).reason in REASONS


_READ_IF_CRITICAL = (
    ExtensionOID.ISSUING_DISTRIBUTION_POINT,
    ExtensionOID.AUTHORITY_KEY_IDENTIFIER,
    ExtensionOID.DELTA_CRL_INDICATOR,
)


_FOR_USER_CERTIFICATES = x509.IssuingDistributionPoint(
    full_name=None,
    relative_name=None,
    only_contains_user_certs=True,
    only_contains_ca_certs=False,
    only_some_reasons=None,
    indirect_crl=False,
    only_contains_attribute_certs=False,
)


def refusal_of(crl: x509.CertificateRevocationList) -> str:
    """Return why OpenSSL cannot use a list, as a clause; "" if it can.

    A list that cannot be used makes every verification fail.  Source: OpenSSL 3, x_crl.c
    (crl_set_issuers, crl_cb) and x509_vfy.c (get_crl_score).
    """
    for ext in crl.extensions:
        if ext.critical and ext.oid not in _READ_IF_CRITICAL:
            return f"it has the unknown critical extension {ext.oid.dotted_string}"
        if ext.oid == ExtensionOID.DELTA_CRL_INDICATOR:
            return "it is a delta CRL: only the changes to another list"
        if (
            isinstance(ext.value, x509.IssuingDistributionPoint)
            and ext.value != _FOR_USER_CERTIFICATES
        ):
            return "it is not for all certificates of its CA"
    for entry in crl:
        for ext in entry.extensions:
            if ext.critical and ext.oid != CRLEntryExtensionOID.CERTIFICATE_ISSUER:
                return f"an entry has the unknown critical extension {ext.oid.dotted_string}"
    return ""


def signed_by(crl: x509.CertificateRevocationList, authority: x509.Certificate) -> bool:
    """Return whether ``authority`` issued and signed the revocation list."""
    return same_name(crl.issuer, authority.subject) and _is_signed(_HashableList(crl), authority)


def may_sign_lists(authority: x509.Certificate) -> bool:
    """Return whether a CA's keyUsage permits signing CRLs; also True for a CA without keyUsage."""
    usage = extension(authority, x509.KeyUsage)
    return usage is None or usage.crl_sign


@lru_cache(maxsize=8)
def newest_list(data: bytes, authorities: bytes) -> x509.CertificateRevocationList | None:
    """Return the newest of the revocation lists in ``data`` that a CA in ``authorities`` signed.

    The list with the highest number is the newest.  Returns None if there is no list, or if a file
    cannot be read.  Compare the result with None: a list without entries is falsy.
    """
    try:
        signers = load_certificates(authorities, "the identity CAs")
        lists = read_lists(data, "the list") if data else ()
    except PkiError:
        return None
    signed = [crl for crl in lists if any(signed_by(crl, signer) for signer in signers)]
    return max(signed, key=list_number, default=None)


class Revocations(NamedTuple):
    """The number of a revocation list (-1: there is no list), and the revoked serial numbers."""

    number: int = -1
    serials: frozenset[int] = frozenset()


@lru_cache(maxsize=256)
def newest_revocations(signer: bytes, *files: bytes) -> Revocations:
    """Return the revocations of the newest list in ``files`` that ``signer`` signed.

    ``signer`` is the certificate of a CA, as PEM.  An unreadable file counts as a file without
    lists.
    """
    lists = [crl for data in files if (crl := newest_list(data, signer)) is not None]
    newest = max(lists, key=list_number, default=None)
    if newest is None:  # a list without entries is falsy
        return Revocations()
    return Revocations(list_number(newest), frozenset(e.serial for e in _entries_of(newest)))


def list_number(crl: x509.CertificateRevocationList) -> int:
    """Return the number of a revocation list; 0 if it has none."""
    try:
        return crl.extensions.get_extension_for_class(x509.CRLNumber).value.crl_number
    except x509.ExtensionNotFound:
        return 0


def _revocation_entry(entry: x509.RevokedCertificate) -> RevocationEntry:
    try:
        reason = entry.extensions.get_extension_for_class(x509.CRLReason).value.reason.value
    except x509.ExtensionNotFound:
        reason = "unspecified"
    return RevocationEntry(entry.serial_number, tolerant.date(entry, "revocation_date"), reason)


# ── verification with lists (x509_vfy.c) ───────────────────────────────────────────────────


Lists = Sequence[x509.CertificateRevocationList]

_ALL_REASONS = frozenset(x509.ReasonFlags) - {
    x509.ReasonFlags.unspecified,
    x509.ReasonFlags.remove_from_crl,
}


class Obstacle(Enum):
    """The reason why OpenSSL refuses a certificate because of revocation lists."""

    MISSING = "no list of its CA"
    USAGE = "the CA may not sign lists"
    SCOPE = "the list is not for this certificate"
    CRITICAL = "the list has an unknown critical extension"
    NOT_YET_VALID = "the list is not valid yet"
    EXPIRED = "the list has expired"
    SIGNATURE = "another key signed the list"
    REVOKED = "the certificate is revoked"


class ListRefusal(NamedTuple):
    """The refusal of a certificate because of revocation lists.

    ``obstacle`` is the reason, ``list`` the list (None if a list is missing), and ``text`` a clause
    for messages.
    """

    obstacle: Obstacle
    list: x509.CertificateRevocationList | None
    text: str


class _ListScore(NamedTuple):
    """How well a list fits a certificate; scores compare field by field, in this order.

    ``only_known``: OpenSSL knows all critical extensions of the list.  ``in_scope``: the list is
    for this certificate.  ``current``: the list is valid now.  ``from_issuer``: the certificate in
    the chain that issued the checked certificate also issued the list.

    Source: OpenSSL 3, x509_vfy.c (get_crl_score).
    """

    only_known: bool
    in_scope: bool
    current: bool
    from_issuer: bool


def list_refusal(
    chain: Sequence[x509.Certificate], lists: Lists, *, moment: datetime
) -> ListRefusal | None:
    """Return why OpenSSL refuses ``chain[0]`` with these lists at the time ``moment``, or None.

    ``chain`` leads to a self-signed CA, and is already known to be valid apart from revocation.
    """
    certificate = chain[0]
    best = _best_list(chain, lists, moment)
    if best is None:
        name = subject_text(certificate.issuer)
        text = f"the revocation list of {name} is missing, although there is a list of another CA"
        return ListRefusal(Obstacle.MISSING, None, text)
    crl, issuer, score = best
    name = subject_text(issuer.subject)
    if not may_sign_lists(issuer):
        text = f"the keyUsage of {name} lacks cRLSign"
        return ListRefusal(Obstacle.USAGE, crl, text)
    if not score.in_scope:
        return ListRefusal(Obstacle.SCOPE, crl, "it is not for all certificates of its CA")
    if last_update(crl) > moment:
        text = f"it is not valid before {iso(last_update(crl))}"
        return ListRefusal(Obstacle.NOT_YET_VALID, crl, text)
    if _has_expired(crl, moment):
        expiry = next_update(crl)
        assert expiry
        return ListRefusal(Obstacle.EXPIRED, crl, f"it expired at {iso(expiry)}")
    if not _is_signed(_HashableList(crl), issuer):
        return ListRefusal(Obstacle.SIGNATURE, crl, f"it is not signed with the key of {name}")
    if not score.only_known:
        return ListRefusal(Obstacle.CRITICAL, crl, "it has an unknown critical extension")
    if _revokes(crl, certificate):
        return ListRefusal(Obstacle.REVOKED, crl, "it is revoked")
    if not _covers_all_reasons(certificate, crl):
        text = "the certificate names lists only for some revocation reasons"
        return ListRefusal(Obstacle.SCOPE, crl, text)
    return None


def _revokes(crl: x509.CertificateRevocationList, certificate: x509.Certificate) -> bool:
    """Return whether a list revokes a certificate; an entry with removeFromCRL revokes nothing."""
    if not _entry_extensions(_HashableList(crl)).name_issuers:
        return lists_as_revoked(crl, certificate.serial_number)
    issuers: list[x509.Name] | None = None
    for entry in crl:
        for ext in entry.extensions:
            if isinstance(ext.value, x509.CertificateIssuer):
                issuers = ext.value.get_values_for_type(x509.DirectoryName)
        if entry.serial_number == certificate.serial_number and (
            issuers is None or any(same_name(name, certificate.issuer) for name in issuers)
        ):
            return not any(
                isinstance(ext.value, x509.CRLReason)
                and ext.value.reason is x509.ReasonFlags.remove_from_crl
                for ext in entry.extensions
            )
    return False


def _best_list(
    chain: Sequence[x509.Certificate], lists: Lists, moment: datetime
) -> tuple[x509.CertificateRevocationList, x509.Certificate, _ListScore] | None:
    """Return the list that OpenSSL uses for ``chain[0]``, with its issuer and score, or None.

    OpenSSL uses the list with the highest score, and the newest list among equals (get_crl_sk).
    """
    best: tuple[x509.CertificateRevocationList, x509.Certificate, _ListScore] | None = None
    for crl in lists:
        issuer = _issuer(chain, crl)
        point = extension(crl, x509.IssuingDistributionPoint)
        if issuer is None or (point and (point.indirect_crl or point.only_some_reasons)):
            continue
        if extension(crl, x509.DeltaCRLIndicator) or extension(crl, ContradictoryPoint):
            continue
        score = _ListScore(
            not _entry_extensions(_HashableList(crl)).has_unknown,
            _is_in_scope(chain[0], crl, point),
            last_update(crl) <= moment and not _has_expired(crl, moment),
            issuer is chain[min(1, len(chain) - 1)],
        )
        if best is None or (score, last_update(crl)) > (best[2], last_update(best[0])):
            best = (crl, issuer, score)
    return best


def _issuer(
    chain: Sequence[x509.Certificate], crl: x509.CertificateRevocationList
) -> x509.Certificate | None:
    """Return the CA in ``chain`` that issued the revocation list, or None.

    The result is also None if the list and ``chain[0]`` name different issuers.  Source: OpenSSL 3,
    x509_vfy.c (crl_akid_check).
    """
    if not same_name(crl.issuer, chain[0].issuer):
        return None
    identifier = extension(crl, x509.AuthorityKeyIdentifier)
    first = 1 if len(chain) > 1 else 0
    for place, certificate in enumerate(chain[first:]):
        named = place == 0 or same_name(certificate.subject, crl.issuer)
        if named and (identifier is None or identifies(identifier, certificate)):
            return certificate
    return None


class _HashableList:
    """A hashable revocation list, so that caches work for all enclaves with the same list."""

    def __init__(self, crl: x509.CertificateRevocationList) -> None:
        self.crl = crl

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _HashableList) and self.crl == other.crl

    def __hash__(self) -> int:
        return hash(self.crl.signature)


class _EntryExtensions(NamedTuple):
    """Properties of the extensions of a list and of its entries.

    ``has_unknown``: the list or an entry has a critical extension that OpenSSL does not know.
    ``name_issuers``: entries name the CAs whose certificates they revoke.
    """

    has_unknown: bool
    name_issuers: bool


@lru_cache(maxsize=16)
def _entry_extensions(hashable_list: _HashableList) -> _EntryExtensions:
    crl = hashable_list.crl
    unknown = any(ext.critical and ext.oid not in _READ_IF_CRITICAL for ext in crl.extensions)
    in_entry = any(
        ext.critical and ext.oid != CRLEntryExtensionOID.CERTIFICATE_ISSUER
        for entry in crl
        for ext in entry.extensions
    )
    return _EntryExtensions(unknown or in_entry, names_issuers(crl))


@lru_cache(maxsize=16)
def _is_signed(hashable_list: _HashableList, issuer: x509.Certificate) -> bool:
    return is_signed(hashable_list.crl, hashable_list.crl.tbs_certlist_bytes, issuer)


def _is_in_scope(
    certificate: x509.Certificate,
    crl: x509.CertificateRevocationList,
    point: x509.IssuingDistributionPoint | None,
) -> bool:
    """Return whether a list covers the certificate, by the distribution point of the list.

    Source: OpenSSL 3, x509_vfy.c (crl_crldp_check).
    """
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
    return any(
        _have_common_name(place, point) for place in places or () if _is_at_point(place, crl)
    )


def _is_at_point(
    distribution_point: x509.DistributionPoint, crl: x509.CertificateRevocationList
) -> bool:
    if distribution_point.crl_issuer is None:
        return True
    names = [
        name.value for name in distribution_point.crl_issuer if isinstance(name, x509.DirectoryName)
    ]
    return any(same_name(name, crl.issuer) for name in names)


def _have_common_name(
    distribution_point: x509.DistributionPoint, point: x509.IssuingDistributionPoint
) -> bool:
    if distribution_point.full_name is None and distribution_point.relative_name is None:
        return True
    if distribution_point.full_name is not None and point.full_name is not None:
        ours = [_general_name(name) for name in distribution_point.full_name]
        return any(_general_name(name) in ours for name in point.full_name)
    return False  # sros does not compare names relative to the issuer, which are rare


def _general_name(name: x509.GeneralName) -> object:
    return canonical(name.value) if isinstance(name, x509.DirectoryName) else name


def _covers_all_reasons(certificate: x509.Certificate, crl: x509.CertificateRevocationList) -> bool:
    """Return whether the distribution points of a certificate cover all reasons to revoke it."""
    for place in extension(certificate, x509.CRLDistributionPoints) or ():
        if _is_at_point(place, crl):
            return place.reasons is None or place.reasons >= _ALL_REASONS
    return True


def _has_expired(crl: x509.CertificateRevocationList, moment: datetime) -> bool:
    expiry = next_update(crl)
    return expiry is not None and expiry <= moment
