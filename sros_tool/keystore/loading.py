"""Reasons why a DDS vendor refuses to load an enclave or a CA.

Vendors differ by the traits in `sros_tool.dds.decision.vendors`.  Faults that all vendors refuse
are found by `sros_tool.keystore.reader`, and not checked here again.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from datetime import datetime, timedelta
from functools import lru_cache
from itertools import dropwhile
from typing import NamedTuple

from cryptography import x509
from cryptography.hazmat.primitives.asymmetric import dsa, ec, rsa
from cryptography.x509.oid import SignatureAlgorithmOID

from sros_tool.dds.decision.vendors import (
    TESTED,
    Hashes,
    Keys,
    Signers,
    Vendor,
    VendorTraits,
    joined_titles,
)
from sros_tool.errors import PkiError
from sros_tool.faults import BEFORE_DDS, Fault
from sros_tool.keystore.layout import (
    CERTIFICATE_FILE,
    CRL_FILE,
    GOVERNANCE_FILE,
    IDENTITY,
    IDENTITY_CA_FILE,
    KEY_FILE,
    KEY_URI_FILE,
    PERMISSIONS_CA_FILE,
    PERMISSIONS_FILE,
    REQUIRED_FILES,
)
from sros_tool.keystore.reader import OpenedEnclave, Problem
from sros_tool.pki import smime
from sros_tool.pki.certificates import (
    TrustSettingsUse,
    is_for_pss,
    load_certificate,
    load_certificates,
    subject_text,
    validity_of,
)
from sros_tool.pki.chains import Checks, build_chain, chain_fault
from sros_tool.pki.crl import Obstacle, list_refusal, read_list, read_lists, refusal_of
from sros_tool.pki.keys import algorithm, is_key_for_pss
from sros_tool.pki.pem import read_as_text

Certificates = tuple[x509.Certificate, ...]

_FILES_BY_CA = (
    (IDENTITY_CA_FILE, CERTIFICATE_FILE),
    (PERMISSIONS_CA_FILE, GOVERNANCE_FILE, PERMISSIONS_FILE),
)
_FAULTS_BY_OBSTACLE = {
    Obstacle.MISSING: Fault.CRL_ISSUER,
    Obstacle.USAGE: Fault.CRL_USAGE,
    Obstacle.SCOPE: Fault.CRL_PARTIAL,
    Obstacle.CRITICAL: Fault.CRL_PARTIAL,
    Obstacle.NOT_YET_VALID: Fault.CRL_NOT_YET_VALID,
    Obstacle.EXPIRED: Fault.CRL_EXPIRED,
    Obstacle.SIGNATURE: Fault.CRL_ISSUER,
    Obstacle.REVOKED: Fault.REVOKED,
}
_VENDOR_SPECIFIC = frozenset(
    {
        Fault.CA_EXPIRED,
        Fault.CA_NOT_YET_VALID,
        Fault.CERTIFICATE_ISSUER,
        Fault.SIGNATURE,
        Fault.CRL_MALFORMED,
        *_FAULTS_BY_OBSTACLE.values(),
    }
)
"""Faults in an `OpenedEnclave` for which only some vendors refuse the enclave."""
_UNREADABLE_FAULTS = (Fault.NOT_SIGNED, Fault.CERTIFICATE_MALFORMED)
CRASHES = (Fault.CA_CRASH, Fault.CERTIFICATE_CRASH)
"""Faults that crash a process."""
_FILES_READ_FIRST = (IDENTITY_CA_FILE, CRL_FILE, CERTIFICATE_FILE)
_FAULTS_ON_READING = (
    Fault.FILE_UNREADABLE,
    Fault.FILE_EMPTY,
    Fault.CERTIFICATE_MALFORMED,
    Fault.CERTIFICATE_FILE,
    Fault.CRL_MALFORMED,
    *CRASHES,
)
"""Faults that a process finds before it verifies a chain."""
_CA_FAULTS_ON_READING = (Fault.SIGNATURE_HASH, Fault.CA_CHAIN)
"""Faults in the file of the identity CA; a process finds them in the same step as
``_FAULTS_ON_READING``.
"""


def starts_without_security(problems: Iterable[Problem]) -> bool:
    """Return whether a process with these problems starts without security, except with Enforce.

    The process does so if the RMW does not find a file that every enclave needs.
    """
    return any(
        problem.fault is Fault.KEY_ON_TOKEN
        or (problem.fault in BEFORE_DDS and problem.file in REQUIRED_FILES)
        for problem in problems
    )


def vendor_problems(
    traits: VendorTraits, state: OpenedEnclave, moment: datetime
) -> tuple[Problem, ...]:
    """Return the problems for which a vendor refuses to load an enclave at the time ``moment``.

    The problems are in the order in which a process finds them.  Of governance and permissions,
    only signature and size are checked here; problems in their content are taken from ``state``.
    """
    problems = [problem for problem in state.problems if problem.fault is not Fault.CRL_LEFT_OUT]
    specific = [problem for problem in problems if _is_vendor_specific(problem, state)]
    kept = [problem for problem in problems if problem not in specific]
    if state.token and not traits.reads_tokens:
        text = f"{traits.title} does not read it, and there is no {KEY_FILE}"
        kept.append(Problem(KEY_URI_FILE, text, Fault.KEY_ON_TOKEN))
    # In files that every vendor refuses anyway, no second problem is reported.
    known = {
        problem.file
        for problem in kept
        if problem.file == CERTIFICATE_FILE or problem.fault in _UNREADABLE_FAULTS
    }
    faults = [
        fault
        for fault in sorted(_vendor_faults(traits, state, moment), key=_order_of_checks)
        if fault.file not in known or fault.fault in CRASHES
    ]
    if not faults:
        return tuple(sorted(kept, key=_order_of_checks))
    kept += [fault for fault in faults if _is_of_list(fault)]
    specific = [problem for problem in specific if not _is_of_list(problem)]
    faults = [fault for fault in faults if not _is_of_list(fault)]
    for side in _FILES_BY_CA:
        of_side = [fault for fault in faults if fault.file in side]
        files = {problem.file for problem in of_side}
        if files & {*side[:2]}:  # a fault of a CA counts for the first file that needs the CA
            files.add(side[0])
        if of_side and of_side[0].fault in CRASHES:
            kept.append(of_side[0])
            continue
        of_side = [problem for problem in of_side if problem.fault not in CRASHES]
        kept += [problem for problem in specific if problem.file in files] or of_side
    if not any(problem.fault is Fault.KEY_ALGORITHM for problem in kept):
        kept += [fault for fault in faults if fault.file == KEY_FILE]
    return tuple(sorted(kept, key=_order_of_checks))


def _order_of_checks(problem: Problem) -> int:
    """Return the sort key of a problem, by the order in which a process finds problems."""
    if problem.fault in BEFORE_DDS:
        return 0
    early = (
        (*_FAULTS_ON_READING, *_CA_FAULTS_ON_READING)
        if problem.file == IDENTITY_CA_FILE
        else _FAULTS_ON_READING
    )
    if problem.file in _FILES_READ_FIRST and problem.fault in early:
        return 1 + _FILES_READ_FIRST.index(problem.file)
    later = (
        (*_FILES_READ_FIRST, KEY_FILE, KEY_URI_FILE),
        (PERMISSIONS_CA_FILE,),
        (GOVERNANCE_FILE,),
        (PERMISSIONS_FILE,),
    )
    return 4 + next(place for place, files in enumerate(later) if problem.file in files)


def _is_of_list(problem: Problem) -> bool:
    return problem.fault is Fault.CRL_MALFORMED or problem.fault in _FAULTS_BY_OBSTACLE.values()


def _is_vendor_specific(problem: Problem, state: OpenedEnclave) -> bool:
    """Return whether a problem is one for which only some vendors refuse an enclave."""
    later = problem.file == IDENTITY_CA_FILE and state.identity_ca is not None
    return problem.fault in _VENDOR_SPECIFIC or (
        problem.fault is Fault.CERTIFICATE_MALFORMED and later
    )


class _Trust(NamedTuple):
    """The CA files of a keystore, as a vendor reads them.

    ``authorities`` are the certificates in the file of the identity CA, in order.  ``signers`` are
    the certificates in the file of the permissions CA.  Either is empty if the file cannot be read.
    ``unreadable`` are the problems of files that the vendor cannot read, and ``refused`` the
    problems of files that it reads but refuses.
    """

    authorities: Certificates
    signers: Certificates
    unreadable: tuple[Problem, ...]
    refused: tuple[Problem, ...]


@lru_cache(maxsize=16)  # for a few keystores and all vendors
def _read_trust(
    traits: VendorTraits,
    identity_ca: bytes | None,
    permissions_ca: bytes | None,
    moment: datetime,
) -> _Trust:
    read: dict[str, Certificates] = {}
    unreadable = []
    for file, data in ((IDENTITY_CA_FILE, identity_ca), (PERMISSIONS_CA_FILE, permissions_ca)):
        if data is not None:
            try:
                read[file] = _read_certificates(traits, data, file)
            except PkiError as error:
                unreadable.append(_unreadable_problem(traits, data, file, error))
    refused = [
        Problem(file, *fault)
        for file, certificates in read.items()
        if (fault := _authority_fault(traits, certificates, moment))
    ]
    signers = read.get(PERMISSIONS_CA_FILE, ())
    return _Trust(
        read.get(IDENTITY_CA_FILE, ()),
        signers,
        tuple(unreadable),
        tuple(refused),
    )


def _unreadable_problem(traits: VendorTraits, data: bytes, file: str, error: PkiError) -> Problem:
    cut = ", because it has a zero byte" if _read_part(traits, data) != data else ""
    return Problem(file, f"{error.clause}{cut}", Fault.CERTIFICATE_FILE)


def _vendor_faults(
    traits: VendorTraits, state: OpenedEnclave, moment: datetime
) -> Iterator[Problem]:
    files = state.files
    shared = (files.get(IDENTITY_CA_FILE), files.get(PERMISSIONS_CA_FILE))
    trust = _read_trust(traits, *shared, moment)
    yield from trust.unreadable
    identity: Certificates = ()
    if CERTIFICATE_FILE in files:
        try:
            identity = _read_certificates(traits, files[CERTIFICATE_FILE], CERTIFICATE_FILE)
        except PkiError as error:
            yield _unreadable_problem(traits, files[CERTIFICATE_FILE], CERTIFICATE_FILE, error)
    yield from trust.refused
    if trust.authorities and identity:
        yield from _identity_faults(traits, identity[0], state, trust.authorities, moment)
        yield from _list_faults(traits, state, identity[0], trust.authorities, moment)
    for file in (GOVERNANCE_FILE, PERMISSIONS_FILE):
        yield from _signature_problems(traits, file, state, trust.signers, moment)
    largest = traits.largest_document
    if largest is not None and state.permissions_bytes > largest:
        text = f"it has {state.permissions_bytes} bytes: with {largest + 1} or more, the "
        yield Problem(PERMISSIONS_FILE, f"{text}handshake may never finish", Fault.DOCUMENT_SIZE)


def _read_part(traits: VendorTraits, data: bytes) -> bytes:
    """Return the part that a vendor reads of a file with certificates or lists."""
    return read_as_text(data) if traits.reads_files_as_text else data


def _read_certificates(traits: VendorTraits, data: bytes, file: str) -> Certificates:
    """Return the certificates that a vendor reads from a file.

    Raises:
        PkiError: the vendor cannot read the file.
    """
    data = _read_part(traits, data)
    if not traits.reads_trusted_certificates and (
        traits.reads_first_authority or file == CERTIFICATE_FILE
    ):
        return (load_certificate(data, file, trusted=False),)
    if file == CERTIFICATE_FILE:
        return (load_certificate(data, file, settings_use=TrustSettingsUse.READ),)
    of_file = (
        TrustSettingsUse.OF_DOCUMENTS
        if file == PERMISSIONS_CA_FILE
        else TrustSettingsUse.OF_ANY_USE
    )
    return load_certificates(data, file, settings_use=of_file)


def _signature_problems(
    traits: VendorTraits, file: str, state: OpenedEnclave, signers: Certificates, moment: datetime
) -> Iterator[Problem]:
    """Yield the problem for which a vendor refuses the signature of a document, if there is one."""
    if file not in state.files or not signers:
        return
    try:
        text = _signer_fault(traits, state.signed_document(file), signers, moment)
    except PkiError as error:
        text = str(error)
    if text:
        yield Problem(file, text, Fault.SIGNATURE)


def _authority_fault(
    traits: VendorTraits, certificates: Certificates, moment: datetime
) -> tuple[str, Fault] | None:
    """Return why a vendor refuses a CA file, as a clause and a fault; None if the file is accepted.

    ``certificates`` are all certificates of the file, in order.
    """
    trusted = _trusted_certificates(traits, certificates)
    if not trusted:
        return _hash_fault(certificates[0]), Fault.SIGNATURE_HASH
    if traits.verifies_authorities and certificates[0] not in trusted:
        text = f"{_hash_fault(certificates[0])}, which crashes the process"
        return text, Fault.CA_CRASH
    if traits.verifies_authorities:
        checks = _chain_checks(traits) | Checks.STRICT
        fault = chain_fault(certificates[0], trusted, moment=moment, checks=checks)
        if fault:
            return f"it is refused: {fault}", Fault.CA_CHAIN
    return None


def authority_refusals(
    role: str, certificates: Certificates, moment: datetime
) -> dict[Vendor, str]:
    """Map each tested vendor that refuses the certificates or documents of a CA to the reason.

    ``certificates`` are all certificates of the CA file, with the issuing CA first.
    """
    refusals = {}
    for vendor in TESTED:
        traits = vendor.traits
        fault = _authority_fault(traits, certificates, moment)
        if fault:
            refusals[vendor] = fault[0]
        elif role == IDENTITY:
            trusted = _trusted_certificates(traits, certificates)
            below = chain_fault(
                certificates[0], trusted, moment=moment, checks=_chain_checks(traits)
            )
            first = certificates[0]
            fits = _key_fits(traits, first.public_key(), pss=is_for_pss(first))
            key = "" if fits else "its key algorithm is not supported"
            refusals[vendor] = below or key
        elif traits.signers is Signers.CHAIN:
            trusted = _trusted_certificates(traits, certificates)
            refusals[vendor] = chain_fault(
                certificates[0], trusted, moment=moment, checks=Checks.DOCUMENTS
            )
    return {vendor: text for vendor, text in refusals.items() if text}


def refusals_text(refusals: Mapping[Vendor, str]) -> str:
    """Return clauses on vendors that refuse a CA, with reasons, and on vendors that accept it."""
    by_text: dict[str, list[str]] = {}
    for vendor, text in refusals.items():
        by_text.setdefault(text, []).append(vendor.title)
    clauses = []
    for text, named in by_text.items():
        titles = joined_titles(named)
        verb = "refuses" if len(titles) == 1 else "refuse"
        clauses.append(
            f"{' and '.join(titles)} {verb} the certificates or documents of this CA: {text}"
        )
    accepts = joined_titles(vendor.title for vendor in TESTED if vendor not in refusals)
    if accepts:
        verb = "accepts" if len(accepts) == 1 else "accept"
        clauses.append(f"{' and '.join(accepts)} {verb} it")
    return "; ".join(clauses)


def _signer_fault(
    traits: VendorTraits, signed: smime.SignedDocument, certificates: Certificates, moment: datetime
) -> str:
    """Return why a vendor refuses a document's signature, as a clause; "" if it is accepted.

    ``certificates`` are all certificates in the file of the permissions CA, in order.
    """
    trusted = _trusted_certificates(traits, certificates)
    if traits.signers is Signers.AUTHORITY:
        try:
            signed.verify(certificates[0])
        except PkiError as error:
            return str(error)
        return ""
    listed = traits.signers is Signers.LISTED
    for signature in signed.signatures:
        signer = signature.signer_among(trusted if listed else signed.certificates)
        if signer is None:
            where = "in the file of the permissions CA" if listed else "in the document"
            return f"the certificate of its signer is not {where}"
        if not signature.is_intact(signed.content, signer):
            return "its signature does not match its content"
        if is_for_pss(signer):
            return "the key of its signer is for RSA-PSS only, which signed documents cannot use"
        if listed:
            continue
        fault = chain_fault(
            signer, trusted, signed.certificates, moment=moment, checks=Checks.DOCUMENTS
        )
        if fault:
            return f"its signer is not accepted: {fault}"
    return ""


def _trusted_certificates(traits: VendorTraits, certificates: Certificates) -> Certificates:
    if traits.reads_first_authority:
        return certificates[:1]
    return tuple(dropwhile(lambda certificate: not _hash_fits(traits, certificate), certificates))


def _hash_fits(traits: VendorTraits, certificate: x509.Certificate) -> bool:
    return traits.hashes is Hashes.ANY or certificate.signature_algorithm_oid in _SHA256_ALGORITHMS


_SHA256_ALGORITHMS = {
    SignatureAlgorithmOID.ECDSA_WITH_SHA256,
    SignatureAlgorithmOID.RSA_WITH_SHA256,
    SignatureAlgorithmOID.RSA_WITH_SHA1,
}


def _hash_fault(certificate: x509.Certificate) -> str:
    if certificate.signature_algorithm_oid == SignatureAlgorithmOID.RSASSA_PSS:
        return f"{subject_text(certificate.subject)} is signed with RSA-PSS"
    return f"{subject_text(certificate.subject)} is not signed with SHA-256"


def _chain_checks(traits: VendorTraits) -> Checks:
    return Checks.ROOT_SIGNATURE | Checks.POLICIES if traits.verifies_policies else Checks.NONE


def _identity_faults(
    traits: VendorTraits,
    certificate: x509.Certificate,
    state: OpenedEnclave,
    authorities: Certificates,
    moment: datetime,
) -> Iterator[Problem]:
    """Yield the problems of certificate, key or issuer for which a vendor refuses an identity."""
    if not _hash_fits(traits, certificate):
        pss = certificate.signature_algorithm_oid == SignatureAlgorithmOID.RSASSA_PSS
        text = "it is signed with RSA-PSS" if pss else "it is not signed with SHA-256"
        yield Problem(CERTIFICATE_FILE, text, Fault.SIGNATURE_HASH)
    trusted = _trusted_certificates(traits, authorities)
    with_keys = [(CERTIFICATE_FILE, certificate), *((IDENTITY_CA_FILE, ca) for ca in trusted[:1])]
    for file, holder in with_keys:
        pss = is_for_pss(holder)
        if not _key_fits(traits, holder.public_key(), pss=pss):
            text = f"it has a key of {algorithm(holder.public_key())}{_PSS_CLAUSE * pss}"
            yield Problem(file, text, Fault.KEY_ALGORITHM)
    if (key := state.public_key) is not None and traits.keys is Keys.SMALL:
        pss = isinstance(key, rsa.RSAPublicKey) and is_key_for_pss(state.files[KEY_FILE])
        if not _key_fits(traits, key, pss=pss):
            text = f"it is a key of {algorithm(key)}{_PSS_CLAUSE * pss}"
            yield Problem(KEY_FILE, text, Fault.KEY_ALGORITHM)
    if traits.crashes_on_empty_subject and not any(certificate.subject.rdns):
        text = "its subject is empty, which crashes the process"
        yield Problem(CERTIFICATE_FILE, text, Fault.CERTIFICATE_CRASH)
    remaining = validity_of(certificate).not_after - moment
    if traits.expiry_overflows and remaining // _LONGEST_TIMER % 2:
        text = "it expires more than 292 years from now: DDS takes it for expired, or crashes"
        yield Problem(CERTIFICATE_FILE, text, Fault.CERTIFICATE_LASTS)
    if fault := chain_fault(certificate, trusted, moment=moment, checks=_chain_checks(traits)):
        yield Problem(CERTIFICATE_FILE, fault, Fault.CERTIFICATE_ISSUER)


_PSS_CLAUSE = " for RSA-PSS alone"
_LONGEST_TIMER = timedelta(microseconds=2**63 / 1000)  # what 64 bits of nanoseconds can hold


def _list_faults(
    traits: VendorTraits,
    state: OpenedEnclave,
    certificate: x509.Certificate,
    authorities: Certificates,
    moment: datetime,
) -> Iterator[Problem]:
    """Yield the problems of revocation lists for which a vendor refuses a certificate."""
    lists: list[tuple[x509.CertificateRevocationList, str]] = []
    try:
        if traits.reads_lists_of_authorities:
            file = IDENTITY_CA_FILE
            lists += [
                (revocation_list, file)
                for revocation_list in _cached_lists(_read_part(traits, state.files[file]), file)
            ]
        file = CRL_FILE
        if file in state.files:
            lists.append((_cached_list(_read_part(traits, state.files[file]), file), file))
    except PkiError as error:
        text = error.clause
        if file == IDENTITY_CA_FILE:
            text = "it has a revocation list that cannot be read, so DDS refuses every participant"
        yield Problem(file, text, Fault.CRL_MALFORMED)
        return
    if not lists:
        return
    chain, fault = build_chain(certificate, _trusted_certificates(traits, authorities), (), moment)
    # A fault of the chain is already reported.
    refusal = (
        None
        if fault
        else list_refusal(chain, [revocation_list for revocation_list, _ in lists], moment=moment)
    )
    if refusal is None:
        return
    crl, file = next((pair for pair in lists if pair[0] is refusal.list), lists[0])
    if refusal.obstacle is Obstacle.REVOKED:
        yield Problem(CERTIFICATE_FILE, f"it is revoked by {file}", Fault.REVOKED)
        return
    text, kind = refusal.text, _FAULTS_BY_OBSTACLE[refusal.obstacle]
    if refusal.obstacle is Obstacle.MISSING and (partial := refusal_of(crl)):
        text, kind = partial, Fault.CRL_PARTIAL
    yield Problem(file, f"{text}, so DDS refuses every participant", kind)


_cached_lists = lru_cache(maxsize=16)(read_lists)
_cached_list = lru_cache(maxsize=16)(read_list)


def _key_fits(traits: VendorTraits, key: object, *, pss: bool = False) -> bool:
    if traits.keys is Keys.ANY:
        return True
    if isinstance(key, ec.EllipticCurvePublicKey):
        return traits.keys is not Keys.SMALL or key.key_size == 256
    if isinstance(key, rsa.RSAPublicKey):
        return traits.keys is not Keys.SMALL or (key.key_size == 2048 and not pss)
    return traits.keys is Keys.EC_AND_RSA and isinstance(key, dsa.DSAPublicKey)
