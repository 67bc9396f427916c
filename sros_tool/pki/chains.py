"""Verification of certificate chains, as OpenSSL 3.0 does it for DDS vendors (x509_vfy.c).

OpenSSL itself is not used: the version in Python may be newer, and may accept chains that the
vendors' version refuses. tests/integration/test_forged_chains.py compares this module with OpenSSL.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress
from datetime import datetime
from enum import Flag, auto
from functools import lru_cache
from itertools import pairwise
from urllib.parse import urlsplit

from cryptography import x509
from cryptography.x509.oid import ExtendedKeyUsageOID, ExtensionOID, NameOID, ObjectIdentifier

from sros_tool.errors import PkiError
from sros_tool.pki import der, tolerant
from sros_tool.pki.certificates import (
    extension,
    has_explicit_curve,
    is_self_issued,
    likely_issued,
    signature_matches,
    subject_text,
    validity_of,
)
from sros_tool.pki.distinguished_names import canonical
from sros_tool.pki.tolerant import UnknownKey, UnreadableName, is_unread
from sros_tool.validity import iso

_OID_NETSCAPE_TYPE = ObjectIdentifier("2.16.840.1.113730.1.1")
_KNOWN_CRITICAL = frozenset(
    {
        ExtensionOID.BASIC_CONSTRAINTS,
        ExtensionOID.KEY_USAGE,
        ExtensionOID.EXTENDED_KEY_USAGE,
        ExtensionOID.SUBJECT_ALTERNATIVE_NAME,
        ExtensionOID.CERTIFICATE_POLICIES,
        ExtensionOID.POLICY_CONSTRAINTS,
        ExtensionOID.POLICY_MAPPINGS,
        ExtensionOID.INHIBIT_ANY_POLICY,
        ExtensionOID.NAME_CONSTRAINTS,
        ExtensionOID.CRL_DISTRIBUTION_POINTS,
        ExtensionOID.OCSP_NO_CHECK,
        _OID_NETSCAPE_TYPE,
    }
)
"""The critical extensions that are accepted (X509_supported_extension); any other is refused."""
_NO_USAGE = x509.KeyUsage(*[False] * 9)
_OID_PROXY = ObjectIdentifier("1.3.6.1.5.5.7.1.14")
_NETWORK_EXTENSIONS = {
    ObjectIdentifier("1.3.6.1.5.5.7.1.7"): "sbgp-ipAddrBlock",
    ObjectIdentifier("1.3.6.1.5.5.7.1.8"): "sbgp-autonomousSysNum",
}
"""The extensions for IP addresses and autonomous system numbers (RFC 3779)."""
_INHERITED_VALUES = tuple(
    map(
        bytes.fromhex,
        ("30083006040200010500", "30083006040200020500", "3004a0020500", "3004a1020500"),
    )
)
"""Values of the network extensions that mean "inherited from the CA"."""
_SSL_CLIENT, _SMIME, _SMIME_CA, _ANY_NETSCAPE_CA = 0x80, 0x20, 0x02, 0x07
_POLICY_EXTENSIONS = {
    ExtensionOID.CERTIFICATE_POLICIES,
    ExtensionOID.POLICY_CONSTRAINTS,
    ExtensionOID.POLICY_MAPPINGS,
    ExtensionOID.INHIBIT_ANY_POLICY,
}
_LONGEST_CHAIN = 100
_VERSION_3 = 3
"""X.509v3, the version of certificates with extensions (RFC 5280, 4.1.2.1)."""


class Checks(Flag):
    """Optional checks of a chain; signatures, dates and critical extensions are always checked."""

    NONE = 0
    ROOT_SIGNATURE = auto()
    """The signature of the self-signed CA (``X509_V_FLAG_CHECK_SS_SIGNATURE``)."""
    POLICIES = auto()
    """Certificate policies (``X509_V_FLAG_POLICY_CHECK``)."""
    STRICT = auto()
    """The rules of RFC 5280 for chains (``X509_V_FLAG_X509_STRICT``)."""
    DOCUMENTS = auto()
    """Whether the first certificate may sign S/MIME messages (``smime_sign``)."""


def chain_fault(
    start: x509.Certificate,
    authorities: Sequence[x509.Certificate],
    other_certificates: Iterable[x509.Certificate] = (),
    *,
    moment: datetime,
    checks: Checks = Checks.NONE,
) -> str:
    """Return why no valid chain leads from ``start`` to a self-signed CA of ``authorities``, or "".

    ``other_certificates`` may serve as intermediate CAs.  Validities are checked at ``moment``.
    """
    chain = _chain_of(start, tuple(dict.fromkeys(authorities)), tuple(other_certificates), moment)
    return chain.missing or chain.fault(checks)


class _Chain:
    """A certificate chain from `build_chain`, which can be verified with different checks.

    ``missing`` says why the chain ends before a trusted CA; "" if it does not.
    """

    def __init__(
        self, certificates: list[x509.Certificate], missing: str, moment: datetime
    ) -> None:
        self.missing = missing
        self._certificates = certificates
        self._at = moment
        self._known: dict[Checks, str] = {}

    def fault(self, checks: Checks) -> str:
        """Return why the chain is not valid, or ""."""
        if checks not in self._known:
            # If the chain passes the checks that all vendors make, only the optional checks remain.
            with_common = not checks or bool(self.fault(Checks.NONE))
            self._known[checks] = next(self._faults(checks, with_common=with_common), "")
        return self._known[checks]

    def _faults(self, checks: Checks, *, with_common: bool) -> Iterator[str]:
        chain = self._certificates
        if with_common:
            yield from _key_faults(chain[0])
            for certificate in chain:
                yield from _extension_faults(certificate)
            yield from _network_faults(chain)
        if with_common or Checks.STRICT in checks:
            yield from _authority_faults(chain, checks)
        if Checks.DOCUMENTS in checks:
            yield from purpose_faults(chain)
        if Checks.STRICT in checks:
            yield from _strict_faults(chain)
        if with_common:
            yield from _time_faults(chain, self._at)
        if with_common or Checks.ROOT_SIGNATURE in checks:
            yield from _signature_faults(chain, checks)
        if with_common:
            yield from _name_faults(chain)
        if Checks.POLICIES in checks:
            yield from _policy_faults(chain)


@lru_cache(maxsize=64)  # vendors check the same chain, and all documents have the same signer
def _chain_of(
    start: x509.Certificate,
    authorities: tuple[x509.Certificate, ...],
    other_certificates: tuple[x509.Certificate, ...],
    moment: datetime,
) -> _Chain:
    certificates, missing = build_chain(start, authorities, other_certificates, moment)
    if missing:
        unread = (
            fault for certificate in (start, *authorities) for fault in _unread_faults(certificate)
        )
        missing = next(unread, missing)
    return _Chain(certificates, missing, moment)


def build_chain(
    start: x509.Certificate,
    authorities: Sequence[x509.Certificate],
    other_certificates: Sequence[x509.Certificate],
    moment: datetime,
) -> tuple[list[x509.Certificate], str]:
    """Return the chain from ``start`` to a trusted CA, and why it does not reach one, or "".

    As in OpenSSL (build_chain), the first certificate with a fitting name and fitting identifiers
    is the issuer, even if the signature was made by another key.
    """
    chain = [start]
    only_others = 1  # the certificates at the start of the chain that are not trusted CAs
    ask_others = True
    while len(chain) <= _LONGEST_CHAIN:
        last = chain[-1]
        complete = _is_self_signed(last)
        issuer = _find_issuer(last, authorities, moment)
        if issuer is not None and not complete:
            chain.append(issuer)
        elif issuer is not None and len(chain) == only_others:
            if issuer == last:
                only_others -= 1
            else:  # this certificate only has the name of a trusted CA
                issuer = None
        if issuer is not None:
            ask_others = False
            if any(map(_is_self_signed, chain[only_others:])):
                return chain, ""
            continue
        below = (
            None
            if complete or not ask_others
            else _find_issuer(last, other_certificates, moment, chain)
        )
        if below is None:
            kind = "self-signed certificate" if complete else "issuer"
            name = subject_text(last.subject if complete else last.issuer)
            return chain, f"the {kind} {name} is not trusted"
        chain.append(below)
        only_others += 1
    return chain, "the chain is too long"


def _is_self_signed(certificate: x509.Certificate) -> bool:
    return likely_issued(certificate, certificate)


def _find_issuer(
    certificate: x509.Certificate,
    candidates: Sequence[x509.Certificate],
    moment: datetime,
    chain: Sequence[x509.Certificate] = (),
) -> x509.Certificate | None:
    """Return the issuer of ``certificate``, or None; certificates in ``chain`` are left out.

    The first candidate that is valid at ``moment`` is chosen, otherwise the candidate that expires
    last.
    """
    certificates = [
        candidate
        for candidate in candidates
        if likely_issued(certificate, candidate) and candidate not in chain
    ]
    valid = (
        issuer
        for issuer in certificates
        if validity_of(issuer).contains(moment) and not tolerant.unread_date(issuer)
    )
    return next(
        valid,
        max(certificates, key=lambda issuer: validity_of(issuer).not_after, default=None),
    )


def _may_sign_certificates(certificate: x509.Certificate) -> bool:
    usage = extension(certificate, x509.KeyUsage)
    return usage is None or usage.key_cert_sign


def denies_issuing(certificate: x509.Certificate) -> bool:
    """Return whether a certificate says that it must not issue other certificates.

    A certificate with neither basicConstraints nor keyUsage does not say so, and vendors disagree
    on whether such a certificate is a CA.
    """
    constraints = extension(certificate, x509.BasicConstraints)
    denied = constraints is not None and not constraints.ca
    return denied or not _may_sign_certificates(certificate)


def _key_faults(certificate: x509.Certificate) -> Iterator[str]:
    """Yield a fault if the key of the first certificate in a chain cannot be read.

    As in OpenSSL (X509_self_signed), a key on a curve that is given by its parameters is read, too.
    """
    if isinstance(certificate.public_key(), UnknownKey) and not has_explicit_curve(certificate):
        name = subject_text(certificate.subject)
        yield f"the public key of {name} is damaged, or of a kind which sros does not know"


@lru_cache(maxsize=64)
def _extension_faults(certificate: x509.Certificate) -> tuple[str, ...]:
    """Return the faults of extensions that make OpenSSL or sros refuse chains of a certificate."""
    name = subject_text(certificate.subject)
    faults = [*_unread_faults(certificate)]
    if extension(certificate, x509.KeyUsage) == _NO_USAGE:
        faults.append(f"the keyUsage of {name} is empty")
    if _netscape_type(certificate) == -1:
        faults.append(f"the nsCertType of {name} cannot be read")
    for found in certificate.extensions:
        if found.oid == _OID_PROXY:
            faults.append(f"{name} has proxyCertInfo, so it is a proxy certificate")
        elif (
            found.critical
            and found.oid not in _KNOWN_CRITICAL
            and found.oid not in _NETWORK_EXTENSIONS
        ):
            oid = found.oid.dotted_string
            faults.append(f"{name} has the unknown critical extension {oid}")
    return tuple(faults)


def _unread_faults(certificate: x509.Certificate) -> list[str]:
    unread = tolerant.unread_extension(certificate)
    return [f"the {unread} of {subject_text(certificate.subject)} cannot be read"] if unread else []


def _network_faults(chain: Sequence[x509.Certificate]) -> Iterator[str]:
    """Yield reasons why OpenSSL or sros refuses the network extensions of a chain (v3_addr.c).

    Extensions with the value "inherited from the CA" restrict nothing.  But if the first
    certificate has such an extension, the trusted CA must not have that value.
    """
    for oid, title in _NETWORK_EXTENSIONS.items():
        values = [
            [part.value.public_bytes() for part in certificate.extensions if part.oid == oid]
            for certificate in chain
        ]
        for certificate, networks in zip(chain, values, strict=True):
            if len(networks) > 1 or not set(networks) <= set(_INHERITED_VALUES):
                yield f"{subject_text(certificate.subject)} has {title}, which sros does not know"
        if values[0] and values[-1]:
            name = subject_text(chain[-1].subject)
            yield f"the trusted CA {name} inherits {title} from another CA"


class _CaStatus(Flag):
    """Whether OpenSSL accepts a certificate as a CA certificate (X509_check_ca)."""

    NO = 0
    YES = auto()
    OLD = auto()
    """A certificate without basicConstraints: accepted as a root CA, but not by strict checks."""
    NETSCAPE = auto()
    """A certificate that is a CA certificate only because of its nsCertType."""


@lru_cache(maxsize=64)
def _ca_status(certificate: x509.Certificate) -> _CaStatus:
    if not _may_sign_certificates(certificate):
        return _CaStatus.NO
    constraints = extension(certificate, x509.BasicConstraints)
    if constraints is not None:
        return _CaStatus.YES if constraints.ca else _CaStatus.NO
    first_version = certificate.version is x509.Version.v1 and _is_self_signed(certificate)
    if first_version or extension(certificate, x509.KeyUsage) is not None:
        return _CaStatus.OLD
    if (_netscape_type(certificate) or 0) & _ANY_NETSCAPE_CA:
        return _CaStatus.OLD | _CaStatus.NETSCAPE
    return _CaStatus.NO


def _netscape_type(certificate: x509.Certificate) -> int | None:
    """Return the bits of the nsCertType extension; None without it, -1 if it is unreadable."""
    kinds = [
        extension.value
        for extension in certificate.extensions
        if extension.oid == _OID_NETSCAPE_TYPE
    ]
    if not kinds:
        return None
    with suppress(PkiError):
        value = der.first_value(kinds[0].public_bytes())
        if value.tag == der.BIT_STRING and len(value.content) in (1, 2) and len(kinds) == 1:
            return (value.content + b"\0")[1]
    return -1


def _authority_faults(chain: Sequence[x509.Certificate], checks: Checks) -> Iterator[str]:
    strict = Checks.STRICT in checks
    if strict and _CaStatus.OLD in _ca_status(chain[0]):
        yield f"{subject_text(chain[0].subject)} has no basicConstraints, so it is not a CA"
    if len(chain) > 1:
        for certificate in filter(has_explicit_curve, chain):
            name = subject_text(certificate.subject)
            yield f"the key of {name} has a curve with explicit parameters"
    below = 0
    for place, certificate in enumerate(chain):
        constraints = extension(certificate, x509.BasicConstraints)
        if place:
            kind = _ca_status(certificate)
            root = place == len(chain) - 1
            if not kind or (_CaStatus.OLD in kind and (strict or not root)):
                subject = subject_text(certificate.subject)
                yield f"{subject} is not a CA: {_not_a_ca_clause(certificate)}"
        longest = constraints.path_length if constraints else None
        if place > 1 and longest is not None and below > longest:
            name = subject_text(certificate.subject)
            yield f"the chain is longer than the pathlen of {name} allows"
        if place and not is_self_issued(certificate):
            below += 1


def _not_a_ca_clause(certificate: x509.Certificate) -> str:
    """Return why a certificate is not a CA certificate, as a clause."""
    if extension(certificate, x509.BasicConstraints) is None:
        return "it has no basicConstraints"
    may_sign = _may_sign_certificates(certificate)
    return "its basicConstraints say CA:FALSE" if may_sign else "its keyUsage lacks keyCertSign"


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
    for certificate in chain:
        name = subject_text(certificate.subject)
        purposes = extension(certificate, x509.ExtendedKeyUsage)
        if purposes is not None and ExtendedKeyUsageOID.EMAIL_PROTECTION not in purposes:
            yield (
                f"the extendedKeyUsage of {name} lacks emailProtection, which signed documents need"
            )
        kinds = _netscape_type(certificate)
        if kinds is None:
            continue
        needed = _SMIME_CA if certificate is not chain[0] else _SMIME | _SSL_CLIENT
        if not kinds & needed and (
            certificate is chain[0] or _CaStatus.NETSCAPE in _ca_status(certificate)
        ):
            yield f"the nsCertType of {name} has no S/MIME, which signed documents need"


def _strict_faults(chain: Sequence[x509.Certificate]) -> Iterator[str]:
    if len(chain) == 1:
        return
    for certificate in chain:
        name = subject_text(certificate.subject)
        usage = extension(certificate, x509.KeyUsage)
        constraints = extension(certificate, x509.BasicConstraints)
        version = tolerant.version_of(certificate)
        if version < _VERSION_3 and list(certificate.extensions):
            yield f"{name} has extensions, which its X.509 version does not allow"
        if constraints and constraints.ca:
            if ExtensionOID.BASIC_CONSTRAINTS not in _critical_extensions(certificate):
                yield f"the basicConstraints of {name} are not critical"
            if usage is None:
                yield f"{name} is a CA without keyUsage"
            if version >= _VERSION_3 and extension(certificate, x509.SubjectKeyIdentifier) is None:
                yield f"{name} is a CA without subjectKeyIdentifier"
        elif usage and usage.key_cert_sign:
            yield f"{name} has keyCertSign but is not a CA"
        may_issue = constraints and constraints.ca and usage and usage.key_cert_sign
        if constraints and constraints.path_length is not None and not may_issue:
            yield f"{name} has a pathlen but may not issue certificates"
        if not (name and subject_text(certificate.issuer)):
            yield "a certificate has an empty subject or issuer"
        names = extension(certificate, x509.SubjectAlternativeName)
        if names is not None and not list(names):
            yield f"the subjectAltName of {name} is empty"
        if _IDENTIFIERS & _critical_extensions(certificate):
            yield f"a key identifier of {name} is critical"
        if version >= _VERSION_3 and certificate is not chain[-1]:
            authority = extension(certificate, x509.AuthorityKeyIdentifier)
            if authority is None or authority.key_identifier is None:
                yield f"{name} lacks an authorityKeyIdentifier"


_IDENTIFIERS = {ExtensionOID.SUBJECT_KEY_IDENTIFIER, ExtensionOID.AUTHORITY_KEY_IDENTIFIER}


def _critical_extensions(certificate: x509.Certificate) -> set[ObjectIdentifier]:
    return {extension.oid for extension in certificate.extensions if extension.critical}


def _time_faults(chain: Sequence[x509.Certificate], moment: datetime) -> Iterator[str]:
    for certificate in chain:
        name = subject_text(certificate.subject)
        if date := tolerant.unread_date(certificate):
            yield f"the {date} of {name} cannot be read"
        validity = validity_of(certificate)
        if moment > validity.not_after:
            yield f"{name} expired at {iso(validity.not_after)}"
        elif moment < validity.not_before:
            yield f"{name} is not valid before {iso(validity.not_before)}"


def _signature_faults(chain: Sequence[x509.Certificate], checks: Checks) -> Iterator[str]:
    pairs = list(pairwise(chain))
    if Checks.ROOT_SIGNATURE in checks:
        pairs.append((chain[-1], chain[-1]))
    for below, issuer in pairs:
        constraints = extension(issuer, x509.BasicConstraints)
        authority = below is not issuer or (constraints is not None and constraints.ca)
        if authority and not _may_sign_certificates(issuer):
            yield f"the keyUsage of {subject_text(issuer.subject)} lacks keyCertSign"
        elif not signature_matches(below, issuer):
            name = subject_text(issuer.subject)
            yield (
                f"the signature of {subject_text(below.subject)} was not made with the key of "
                f"{name}"
            )


_DEMANDING_EXTENSIONS = {ExtensionOID.CERTIFICATE_POLICIES, ExtensionOID.POLICY_CONSTRAINTS}
"""The policy extensions that OpenSSL decodes even if no certificate names a policy."""


def _policy_faults(chain: Sequence[x509.Certificate]) -> Iterator[str]:
    """Yield a fault if a certificate demands a policy, or its policies are not valid (pcy_tree.c).

    DDS processes accept no policy by name, so a chain in which a policy is demanded is never valid.
    Also yield a fault if a certificate maps policies, which sros does not support.
    """
    if not any(
        _POLICY_EXTENSIONS & {extension.oid for extension in below.extensions}
        for below in chain[:-1]
    ):
        return
    until_demanded = len(chain)
    for certificate in reversed(chain[:-1]):
        name = subject_text(certificate.subject)
        policies = extension(certificate, x509.CertificatePolicies)
        named = [policy.policy_identifier for policy in policies or ()]
        if len(named) != len(set(named)):
            yield f"{name} has a certificate policy twice"
        maps = any(
            extension.oid == ExtensionOID.POLICY_MAPPINGS for extension in certificate.extensions
        )
        if maps and policies is not None:
            yield f"{name} has policyMappings, which sros does not know"
        asked = _POLICY_EXTENSIONS if named else _DEMANDING_EXTENSIONS
        if any(
            extension.oid in asked and is_unread(extension) for extension in certificate.extensions
        ):
            yield f"the policies of {name} cannot be read"
        constraints = extension(certificate, x509.PolicyConstraints)
        after = constraints.require_explicit_policy if constraints else None
        if until_demanded:
            until_demanded -= not is_self_issued(certificate)
            until_demanded = min(until_demanded, until_demanded if after is None else after)
    if not until_demanded:
        yield "a certificate demands a certificate policy, and DDS names none that it accepts"


# ── name constraints (v3_ncons.c) ─────────────────────────────────────────────────────────────


_IA5_MAIL = der.encode(der.OID, der.encode_oid(NameOID.EMAIL_ADDRESS.dotted_string)) + b"\x16"
_HOST = re.compile(r"(?!.*(?:\.-|-\.))\w(?:[\w-]*\w)?(?:\.[\w-]*\w)+", re.ASCII)
"""Matches a common name that OpenSSL takes for a host name: a name with a dot."""


def _name_faults(chain: Sequence[x509.Certificate]) -> Iterator[str]:
    """Yield faults of names that violate the name constraints of a CA in the chain."""
    for place, certificate in enumerate(chain):
        if place and is_self_issued(certificate):
            continue
        for authority in chain[place + 1 :]:
            constraints = extension(authority, x509.NameConstraints)
            if constraints is None:
                continue
            for name in _names(certificate, is_leaf=not place):
                if not _is_allowed(name, constraints):
                    yield (
                        f"the nameConstraints of {subject_text(authority.subject)} do not allow "
                        f"the names of {subject_text(certificate.subject)}"
                    )


def _names(certificate: x509.Certificate, *, is_leaf: bool) -> Iterator[x509.GeneralName | None]:
    """Yield the names in a certificate to which constraints apply; None for an unreadable name."""
    subject = certificate.subject
    if any(subject.rdns):
        readable_name = isinstance(subject, x509.Name)
        yield x509.DirectoryName(subject) if readable_name else None
    for text in subject.get_attributes_for_oid(NameOID.EMAIL_ADDRESS):
        readable = _IA5_MAIL in subject.public_bytes() and str(text.value).isascii()
        yield x509.RFC822Name(str(text.value)) if readable else None
    names = tuple(extension(certificate, x509.SubjectAlternativeName) or ())
    yield from (None if isinstance(name, UnreadableName) else name for name in names)
    if is_leaf and not any(isinstance(name, x509.DNSName) for name in names):
        for common in subject.get_attributes_for_oid(NameOID.COMMON_NAME):
            host = str(common.value).rstrip("\0")
            if _HOST.fullmatch(host):
                yield x509.DNSName(host)


def _is_allowed(name: x509.GeneralName | None, constraints: x509.NameConstraints) -> bool:
    if name is None:
        return False
    permitted = [
        subtree
        for subtree in constraints.permitted_subtrees or ()
        if isinstance(subtree, type(name))
    ]
    excluded = [
        subtree
        for subtree in constraints.excluded_subtrees or ()
        if isinstance(subtree, type(name))
    ]
    if not (permitted or excluded):
        return True
    try:
        return (not permitted or any(_is_in_subtree(name, base) for base in permitted)) and not any(
            _is_in_subtree(name, base) for base in excluded
        )
    except ValueError:
        return False


def _is_in_subtree(name: x509.GeneralName, base: x509.GeneralName) -> bool:
    """Return whether a name is in the subtree ``base``.

    Raises:
        ValueError: sros cannot decide this for the kind or the value of the names.
    """
    if isinstance(name, x509.DirectoryName) and isinstance(base, x509.DirectoryName):
        parts = canonical(base.value)
        return canonical(name.value)[: len(parts)] == parts
    if isinstance(name, x509.IPAddress) and isinstance(base, x509.IPAddress):
        return name.value.version == base.value.version and name.value in base.value  # type: ignore[operator]
    if isinstance(name, x509.DNSName) and isinstance(base, x509.DNSName):
        text, end = name.value.lower(), base.value.lower()
        return not end or text == end or text.endswith(end if end[0] == "." else f".{end}")
    if isinstance(name, x509.RFC822Name) and isinstance(base, x509.RFC822Name):
        return _mail_within(name.value, base.value)
    if isinstance(name, x509.UniformResourceIdentifier) and isinstance(
        base, x509.UniformResourceIdentifier
    ):
        return _host_within(urlsplit(name.value).netloc.partition(":")[0], base.value)
    raise ValueError("OpenSSL supports no constraint of this kind")


def _mail_within(text: str, base: str) -> bool:
    local, at, host = text.rpartition("@")
    if not at:
        raise ValueError("not a mail address")
    base_local, base_at, base_host = base.rpartition("@")
    if not base_at and base[:1] == ".":
        return len(text) > len(base) and text.lower().endswith(base.lower())
    if base_local and base_local != local:
        return False
    return base_host.lower() == host.lower()


def _host_within(host: str, base: str) -> bool:
    if not host:
        raise ValueError("an address without a host")
    if base[:1] == ".":
        return len(host) > len(base) and host.lower().endswith(base.lower())
    return host.lower() == base.lower()
