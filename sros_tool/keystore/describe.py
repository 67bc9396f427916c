"""Descriptions of keystores, enclaves, certificates and signed documents, and of their history."""

from __future__ import annotations

import binascii
import hashlib
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from datetime import datetime
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Literal, NamedTuple

from cryptography import x509

from sros_tool.dds.governance import DomainRule, TopicRule, parse_governance
from sros_tool.dds.permissions import Grant, Permissions, parse_permissions
from sros_tool.errors import DocumentError, SrosError
from sros_tool.keystore.layout import (
    CERTIFICATE_FILE,
    CRL,
    GOVERNANCE_P7S,
    KEY_URI_FILE,
    PERMISSIONS_FILE,
    PUBLIC,
    RETIRED,
    REVOKED,
    ROLES,
    SETTINGS,
    ZENOH_SIGNED,
    ca_certificate,
    ca_key,
    enclave_folder,
    is_keystore,
    list_enclaves,
    permissions_ca_for,
    refuse_earlier,
    revoked_certificates,
    search_enclaves,
)
from sros_tool.keystore.ledger import GAP, Entry
from sros_tool.keystore.participant import EvaluatedEnclave, evaluated
from sros_tool.keystore.reader import FilesReadOnce, Keystore, open_enclave
from sros_tool.keystore.zenoh_files import OpenedZenoh, ZenohFault, open_zenoh
from sros_tool.pki.certificates import (
    common_name_of,
    digest,
    load_certificates,
    subject_text,
    validity_of,
)
from sros_tool.pki.chains import Checks, chain_fault
from sros_tool.pki.crl import CRL_MARK, RevocationList, load_crl
from sros_tool.pki.keys import algorithm, holds_private_key, load_key
from sros_tool.pki.token import TokenUri, read_token_file
from sros_tool.policy.rights import KIND_OF
from sros_tool.translate import ros_rights
from sros_tool.translate_zenoh.rights import domains_of, stated_names
from sros_tool.validity import iso
from sros_tool.values import Words, shows
from sros_tool.xml import parse, read_bytes
from sros_tool.zenoh.configuration import Configuration, Mode, ZenohNetwork, parse_rendered
from sros_tool.zenoh.document import parse_configuration

_JSON = (".json5", ".json")

NamedPath = Annotated[Path, "PATH, as it was named."]
Problems = Annotated[Sequence[str], "What keeps a process from running in it."]


# ── what is described, and its JSON ────────────────────────────────────────────────────────


class CertificateFacts(NamedTuple):
    """A certificate: the parts that matter to DDS Security."""

    subject: str
    """Its subject."""
    issuer: str
    """The subject of its issuer."""
    serial: str
    """Its serial number, in hexadecimal."""
    is_ca: bool
    """Whether it is the certificate of a CA."""
    key: str
    """The kind of its key, such as ``EC secp256r1``."""
    signature: str
    """The hash of its signature, such as ``sha256``."""
    sha256: str
    """SHA-256 of the certificate (DER), in hexadecimal."""
    not_before: datetime
    """Begin of its validity, in UTC."""
    not_after: datetime
    """End of its validity, in UTC."""
    valid_now: bool
    """Whether it is valid now."""


class ListFacts(NamedTuple):
    """A revocation list; with an expired one DDS refuses all certificates of its CA."""

    issuer: str
    """The CA that signed it."""
    number: int
    """Its number; each new list has a higher one."""
    not_before: datetime
    """Begin of its validity, in UTC."""
    not_after: datetime
    """End of its validity, in UTC."""
    valid_now: bool
    """Whether it is valid now."""
    revoked: Sequence[str]
    """Serial numbers of the revoked certificates, in hexadecimal."""


@shows(spread=("first",), optional=("further", "crl"))
class CertificateFile(NamedTuple):
    """The certificates in a PEM file."""

    first: CertificateFacts
    """The first certificate."""
    further: Sequence[CertificateFacts] | None
    """The other certificates in the file: the chain, or the other CA during a rotation."""
    crl: ListFacts | None
    """The revocation list in the file, if there is one."""


@shows(spread=("file",))
class AuthorityFile(NamedTuple):
    """A CA certificate."""

    file: CertificateFile
    """Its file."""
    key_present: bool
    """Whether its private key is in the keystore."""


class UnreadableFile(NamedTuple):
    """A file that cannot be read."""

    error: str
    """Why it cannot be read."""


class TokenPlace(NamedTuple):
    """The place of a key on a PKCS#11 token."""

    token: str
    """Label of the token."""
    object: str
    """Label of the key."""
    pin_source: str | None
    """File with the PIN, or null."""


RightNames = Mapping[str, Mapping[str, Sequence[str]]]
"""Names by kind and right, such as ``{"topics": {"publish": ["/chatter"]}}``."""


class RuleFacts(NamedTuple):
    """A rule."""

    qualifier: Annotated[str, Words(("ALLOW", "DENY"))]
    """Whether it allows or denies."""
    domains: str
    """The domains that it is for."""
    rights: RightNames
    """Names by kind (``topics``, ``services``, ``actions``, ``dds``) and by right, such as
    ``publish``."""
    partitions: Sequence[str]
    """The partitions that it is for."""


@shows(optional=("valid_now",))
class GrantFacts(NamedTuple):
    """A grant of permissions."""

    name: str
    """Its name."""
    subject: str
    """The subject that it is for."""
    not_before: str
    """Begin of its validity, as it is written."""
    not_after: str
    """End of its validity, as it is written."""
    valid_now: bool | None
    """Whether it is valid now."""
    rules: Sequence[RuleFacts]
    """Its rules, in order."""
    default: Annotated[str, Words(("ALLOW", "DENY"))]
    """What decides if no rule matches."""


class EnclaveFacts(NamedTuple):
    """An enclave."""

    loadable: bool
    """Whether a process can run in it now."""
    problems: Problems
    subject: str | None
    """Subject of its certificate, or null."""
    valid_until: datetime | None
    """Expiry of its certificate, in UTC, or null."""
    expires: datetime | None
    """First expiry of its certificates and permissions, in UTC, or null."""
    identity_ca: str | None
    """Subject of the identity CA that it trusts, or null."""
    identity_ca_sha256: str | None
    """SHA-256 of the certificate of that CA, or null."""
    permissions_ca: str | None
    """Subject of the permissions CA that it trusts, or null."""
    permissions_ca_sha256: str | None
    """SHA-256 of the certificate of that CA, or null."""
    domains: str | None
    """The ROS domains of its governance, or null."""
    token: TokenPlace | None
    """The place of its key on a PKCS#11 token, or null for a key in a file."""
    permissions: Sequence[GrantFacts] | None
    """The grants in its permissions, or null."""
    permissions_bytes: int | None
    """Size of permissions.p7s in bytes, or null."""


@shows(spread=("facts",))
class KeystoreEnclave(NamedTuple):
    """An enclave."""

    name: str
    """The enclave."""
    key_on_robot: bool
    """Whether its key was made on its robot and is not here."""
    facts: EnclaveFacts
    """What is known of it."""


class ZenohFileFacts(NamedTuple):
    """A configuration."""

    file: str
    """Its name, such as ``session.json5``."""
    mode: Mode
    """How the process takes part in the network."""


class ZenohFiles(NamedTuple):
    """The Zenoh configurations of an enclave."""

    files: Sequence[ZenohFileFacts]
    """Those that are signed."""
    problems: Annotated[Sequence[str], "What keeps a process of rmw_zenoh_cpp from running in it."]


class NetworkFacts(NamedTuple):
    """A Zenoh network."""

    router: str
    """The enclave of the router."""
    endpoints: Sequence[str]
    """Where sessions connect to the router, as HOST:PORT."""
    listen: Sequence[str]
    """Where the router listens, as HOST:PORT."""
    mode: Mode
    """Whether sessions also connect to each other (``peer``), or only to the router."""


class SignerFacts(NamedTuple):
    """A signature."""

    signer: str | None
    """Subject of the signer's certificate, or null."""
    signer_sha256: str | None
    """SHA-256 of that certificate, or null."""
    digest: str
    """The hash of the signature, such as ``sha256``."""
    bytes: int
    """Size of the signed document in bytes."""
    signature_problem: str
    """Why it is not valid, or an empty string."""


@shows(spread=("signer",))
class SignatureFacts(NamedTuple):
    """Whether a document is signed, and by whom."""

    signed: bool
    """Whether the document is signed."""
    signature_verified: bool | None
    """Whether the signature is valid; null if no permissions CA is known."""
    signer: SignerFacts | None
    """By whom."""


@shows(spread=("rule",))
class DomainRuleFacts(NamedTuple):
    """A domain rule."""

    domains: str
    """The domains that it is for."""
    rule: DomainRule
    """Its attributes."""
    topic_rules: Sequence[TopicRule]
    """Its topic rules; the first that matches counts."""


class AccessControlFacts(NamedTuple):
    """Access control of Zenoh."""

    enabled: bool
    """Whether it is on."""
    default: Annotated[str, Words(("allow", "deny"))]
    """What no rule decides is allowed or denied."""
    rules: int
    """Number of its rules."""
    subjects: int
    """Number of its subjects."""


class RemoteFacts(NamedTuple):
    """The rights of an enclave."""

    enclave: str
    """The enclave."""
    own_rights_by_router: bool
    """Whether it is the router of a client, and ``may`` is what the client may do through it."""
    may: RightNames
    """Names by kind (``topics``, ``services``) and by right, such as ``publish``; with wildcards,
    as Zenoh writes them."""


class DescribedKeystore(NamedTuple):
    """A keystore."""

    path: NamedPath
    template: str | None
    """Name of the template in its settings, or null."""
    ledger: Sequence[str]
    """Faults of the ledger."""
    authorities: Mapping[str, AuthorityFile | UnreadableFile]
    """Its CAs, by role (``identity``, ``permissions``)."""
    governance: DescribedGovernance | UnreadableFile | None
    """Its governance, or null."""
    zenoh: NetworkFacts | None
    """Its Zenoh network, by its settings; null without one."""
    enclaves: Sequence[KeystoreEnclave]
    """Its enclaves."""
    unreadable: Sequence[str]
    """Folders that cannot be read, and why."""
    problems: Sequence[str]
    """All problems; if there are any, the exit status is 1."""
    kind: Annotated[Literal["keystore"], "What PATH is."] = "keystore"


@shows(spread=("facts",))
class DescribedEnclave(NamedTuple):
    """An enclave."""

    path: NamedPath
    facts: EnclaveFacts
    """What is known of it."""
    zenoh: ZenohFiles | None
    """Its Zenoh configurations, or null."""
    kind: Annotated[Literal["enclave"], "What PATH is."] = "enclave"


@shows(spread=("file",))
class DescribedCertificates(NamedTuple):
    """A file of certificates."""

    path: NamedPath
    file: CertificateFile
    """Its content."""
    kind: Annotated[Literal["certificate"], "What PATH is."] = "certificate"


@shows(spread=("facts",))
class DescribedList(NamedTuple):
    """A revocation list."""

    path: NamedPath
    facts: ListFacts
    """Its content."""
    kind: Annotated[Literal["revocation list"], "What PATH is."] = "revocation list"


class DescribedKey(NamedTuple):
    """A private key."""

    path: NamedPath
    algorithm: str
    """Its kind, such as ``EC secp256r1``."""
    mode: str
    """Permission bits of the file, in octal."""
    kind: Annotated[Literal["private key"], "What PATH is."] = "private key"


@shows(spread=("place",))
class DescribedToken(NamedTuple):
    """The place of a key on a PKCS#11 token."""

    path: NamedPath
    place: TokenPlace
    """The place."""
    kind: Annotated[Literal["key on a token"], "What PATH is."] = "key on a token"


@shows(spread=("signature",))
class DescribedPermissions(NamedTuple):
    """Permissions, signed or not."""

    path: NamedPath
    grants: Sequence[GrantFacts]
    """Its grants."""
    signature: SignatureFacts
    """Its signature."""
    kind: Annotated[Literal["permissions"], "What PATH is."] = "permissions"


@shows(spread=("signature",))
class DescribedGovernance(NamedTuple):
    """Governance, signed or not."""

    path: NamedPath
    domain_rules: Sequence[DomainRuleFacts]
    """The domain rules of the governance."""
    signature: SignatureFacts
    """Its signature."""
    kind: Annotated[Literal["governance"], "What PATH is."] = "governance"


@shows(spread=("signature",))
class DescribedConfiguration(NamedTuple):
    """A configuration of a Zenoh process, signed or not."""

    path: NamedPath
    mode: Mode
    """How the process takes part in the network."""
    connect: Sequence[str]
    """Where it connects, such as ``tls/localhost:7447``."""
    listen: Sequence[str]
    """Where it listens."""
    access_control: AccessControlFacts
    """Its access control."""
    made_by_sros: bool
    """Whether it is exactly as sros writes it."""
    domains: Sequence[int]
    """The ROS domains that its rules are for; empty if it is not by sros."""
    rights: Sequence[RemoteFacts]
    """What the processes of each enclave may do; empty if it is not by sros."""
    problems: Sequence[str]
    """How it does not fit its signature or its enclave."""
    signature: SignatureFacts
    """Its signature."""
    kind: Annotated[Literal["Zenoh configuration"], "What PATH is."] = "Zenoh configuration"


Described = (
    DescribedKeystore
    | DescribedEnclave
    | DescribedCertificates
    | DescribedList
    | DescribedKey
    | DescribedToken
    | DescribedPermissions
    | DescribedGovernance
    | DescribedConfiguration
)

_NOT_SIGNED = SignatureFacts(signed=False, signature_verified=False, signer=None)


# ── describing ─────────────────────────────────────────────────────────────────────────────


def describe(
    path: Path,
    *,
    now: datetime,
    authority: Path | None = None,
    files: FilesReadOnce | None = None,
) -> Described:
    """Describe the content of ``path``.

    Args:
        path: a keystore, the folder of an enclave, or a file of one.
        now: the moment for which validity is reported.
        authority: the permissions CA certificate that verifies a signed document; by default the
            one next to it.
        files: those that were read before.

    Raises:
        DocumentError: ``path`` is none of these kinds, or cannot be read.
    """
    files = files or FilesReadOnce()
    if path.is_dir():
        if is_keystore(path):
            return _keystore(path, now)
        of_enclave = (CERTIFICATE_FILE, PERMISSIONS_FILE, KEY_URI_FILE)
        if any((path / name).exists() for name in of_enclave):
            state = open_enclave(path, now=now, files=files)
            facts = _enclave_facts(evaluated("", path, state, at=now))
            return DescribedEnclave(path, facts, _zenoh(path, now))
        refuse_earlier(path)
        raise DocumentError(
            f"'{path}' is neither a keystore nor an enclave",
            "It has no enclaves folder, and neither cert.pem nor permissions.p7s.",
        )
    data = files.read(path, "file")
    try:
        return _file(path, data, now, authority, files)
    except SrosError as error:
        raise DocumentError(f"'{path}' cannot be read: {error.what}", error.why) from error


def problems_of(described: Described) -> Sequence[str]:
    """Return what is wrong with a keystore, an enclave or a Zenoh configuration."""
    if isinstance(described, DescribedEnclave):
        zenoh = described.zenoh
        return (*described.facts.problems, *(zenoh.problems if zenoh else ()))
    if isinstance(described, (DescribedKeystore, DescribedConfiguration)):
        return described.problems
    return ()


def _file(
    path: Path, data: bytes, now: datetime, authority: Path | None, files: FilesReadOnce
) -> Described:
    """Describe a file; its content decides the kind, not its name."""
    if b"-----BEGIN CERTIFICATE-----" in data:
        return DescribedCertificates(path, _certificates(data, "in it", now))
    if CRL_MARK in data:
        return DescribedList(path, _revocation_list(load_crl(data, "in it"), now))
    if path.name == KEY_URI_FILE:
        return DescribedToken(path, _token(read_token_file(data)))
    if holds_private_key(data):
        mode = path.stat().st_mode & 0o777
        return DescribedKey(path, algorithm(load_key(data, "in it")), f"{mode:04o}")
    if b"multipart/signed" in data[:1000].lower():
        signed = files.signed(data)
        signature = _signature(path, data, now, authority, files)
        if signed.document.lstrip()[:1] == b"<":
            return _document(path, signed.document, signature, now)
        return _configuration(path, signed.text, signature, now)
    if data.lstrip()[:1] == b"<":
        return _document(path, data, _NOT_SIGNED, now)
    if path.suffix in _JSON or data.lstrip()[:1] == b"{":
        return _configuration(
            path, data, _signature_next_to(path, data, now, authority, files), now
        )
    raise DocumentError(
        "it is neither a PEM certificate, revocation list or key, nor a signed document, nor XML, "
        "nor a Zenoh configuration",
    )


def _keystore(root: Path, now: datetime) -> DescribedKeystore:
    keystore = Keystore(root)
    settings = keystore.settings
    authorities: dict[str, AuthorityFile | UnreadableFile] = {}
    for role in ROLES:
        path = root / ca_certificate(role)
        if not path.exists():
            continue
        try:
            file = _certificates(keystore.read(path, "file"), f"'{path}'", now)
            authorities[role] = AuthorityFile(file, (root / ca_key(role)).exists())
        except SrosError as error:
            authorities[role] = UnreadableFile(str(error))
    names, unread = search_enclaves(root)
    enclaves = [_enclave(keystore, name, now) for name in names]
    governance = _governance_of(keystore, now)
    problems = [f"{each.name}: {problem}" for each in enclaves for problem in each.facts.problems]
    unreadable = [f"'{each.path}' cannot be read: {each.why}" for each in unread]
    problems += unreadable
    for role, authority in authorities.items():
        if isinstance(authority, UnreadableFile):
            problems.append(f"{role} CA: {authority.error}")
    if isinstance(governance, UnreadableFile):
        problems.append(f"governance: {governance.error}")
    try:
        gaps = list(keystore.ledger.gaps)
    except SrosError as error:
        gaps = [str(error)]
    problems += [f"ledger: {gap}" for gap in gaps]
    return DescribedKeystore(
        path=root,
        template=settings.name if settings else None,
        ledger=gaps,
        authorities=authorities,
        governance=governance,
        zenoh=_network(settings.zenoh) if settings and settings.zenoh else None,
        enclaves=enclaves,
        unreadable=unreadable,
        problems=problems,
    )


def _governance_of(
    keystore: Keystore, now: datetime
) -> DescribedGovernance | UnreadableFile | None:
    """Describe the governance that the enclaves of a keystore share, if there is one."""
    if not keystore.has(GOVERNANCE_P7S):
        return None
    try:
        described = describe(keystore.root / GOVERNANCE_P7S, now=now, files=keystore.files)
    except SrosError as error:
        return UnreadableFile(str(error))
    if isinstance(described, DescribedGovernance):
        return described
    return UnreadableFile(f"it is a {described.kind} document")


def _network(network: ZenohNetwork) -> NetworkFacts:
    return NetworkFacts(network.router, network.endpoints, network.listening(), network.mode)


def _zenoh(folder: Path, now: datetime) -> ZenohFiles | None:
    """Describe the Zenoh configurations of an enclave: the files, and what is wrong with them."""
    opened = _opened_at(folder, now)
    if opened is None or not opened.files:
        return None
    modes = {file: each.mode for file, each in opened.configurations.items()}
    return ZenohFiles(
        [ZenohFileFacts(file, modes[file]) for file in opened.files if file in modes],
        [str(each) for each in opened.problems],
    )


def _enclave(keystore: Keystore, name: str, now: datetime) -> KeystoreEnclave:
    """Describe an enclave of a keystore; a key that stays on its robot is not a problem there."""
    state = keystore.enclave(name, now=now)
    evaluation = evaluated(name, keystore.folder(name), state, at=now)
    problems = [*evaluation.problems, *evaluation.for_some(state.problems)]
    facts = _enclave_facts(evaluation)._replace(problems=problems)
    return KeystoreEnclave(name, state.key_on_robot, facts)


def _enclave_facts(evaluation: EvaluatedEnclave) -> EnclaveFacts:
    """Describe an enclave; ``loadable`` says whether a process can run in it now."""
    state = evaluation.state
    domains, problems = state.domains(), list(evaluation.problems_here)
    identity, identity_sha256 = _subject_and_digest(state.identity_ca)
    permissions, permissions_sha256 = _subject_and_digest(state.permissions_ca)
    return EnclaveFacts(
        loadable=not problems,
        problems=problems,
        subject=state.subject or None,
        valid_until=validity_of(state.certificate).not_after if state.certificate else None,
        expires=state.valid_until(),
        identity_ca=identity,
        identity_ca_sha256=identity_sha256,
        permissions_ca=permissions,
        permissions_ca_sha256=permissions_sha256,
        domains=str(domains) if domains else None,
        token=_token(state.token) if state.token else None,
        permissions=_grants(state.permissions) if state.permissions else None,
        permissions_bytes=state.permissions_bytes,
    )


def _token(place: TokenUri) -> TokenPlace:
    return TokenPlace(place.token, place.object, place.pin_source or None)


def _subject_and_digest(certificate: x509.Certificate | None) -> tuple[str | None, str | None]:
    """Return the subject of a CA, and its SHA-256, since two CAs can have one name."""
    return (subject_text(certificate.subject), digest(certificate)) if certificate else (None, None)


def _certificate(certificate: x509.Certificate, now: datetime) -> CertificateFacts:
    validity = validity_of(certificate)
    try:
        is_ca = certificate.extensions.get_extension_for_class(x509.BasicConstraints).value.ca
    except x509.ExtensionNotFound:
        is_ca = False
    signature = certificate.signature_hash_algorithm
    return CertificateFacts(
        subject=subject_text(certificate.subject),
        issuer=subject_text(certificate.issuer),
        serial=f"{certificate.serial_number:x}",
        is_ca=is_ca,
        key=algorithm(certificate.public_key()),
        signature=str(signature.name) if signature else "none",
        sha256=digest(certificate),
        not_before=validity.not_before,
        not_after=validity.not_after,
        valid_now=validity.contains(now),
    )


def _certificates(data: bytes, name: str, now: datetime) -> CertificateFile:
    """Describe the certificates of a PEM file, and the revocation list after them."""
    first, *further = (_certificate(each, now) for each in load_certificates(data, name))
    crl = _revocation_list(load_crl(data, name), now) if CRL_MARK in data else None
    return CertificateFile(first, further or None, crl)


def _revocation_list(crl: RevocationList, now: datetime) -> ListFacts:
    return ListFacts(
        issuer=subject_text(crl.list.issuer),
        number=crl.number,
        not_before=crl.this_update,
        not_after=crl.next_update,
        valid_now=crl.this_update <= now <= crl.next_update,
        revoked=[f"{each.serial:x}" for each in crl.revoked],
    )


def _signature(
    path: Path, data: bytes, now: datetime, authority: Path | None, files: FilesReadOnce
) -> SignatureFacts:
    """Describe the signature of the signed document ``data`` at ``path``."""
    signed = files.signed(data)
    found = authority or permissions_ca_for(path)
    reason = "no permissions CA certificate is next to it; name one with --ca"
    verified: bool | None = None
    if found:
        certificates = load_certificates(files.read(found, "certificate"), f"'{found}'")
        try:
            signed.verify(certificates[0])
            reason = chain_fault(certificates[0], certificates, at=now, checks=Checks.DOCUMENTS)
        except SrosError as error:
            reason = str(error)
        verified = not reason
    subject, sha256 = _subject_and_digest(signed.signer())
    signer = SignerFacts(subject, sha256, signed.digest, len(data), reason)
    return SignatureFacts(signed=True, signature_verified=verified, signer=signer)


def _signature_next_to(
    path: Path, data: bytes, now: datetime, authority: Path | None, files: FilesReadOnce
) -> SignatureFacts:
    """Describe the signature of a Zenoh configuration: of the same document next to it."""
    signed = path.with_name(ZENOH_SIGNED.get(path.name, path.name))
    if signed == path or not signed.exists():
        return _NOT_SIGNED
    message = files.read(signed, "signed document")
    signature = _signature(signed, message, now, authority, files)
    if files.signed(message).text == data or signature.signer is None:
        return signature
    problem = f"it is not the document that was signed in {signed.name}"
    signer = signature.signer._replace(signature_problem=problem)
    return signature._replace(signature_verified=False, signer=signer)


def _document(
    path: Path, document: bytes, signature: SignatureFacts, now: datetime
) -> DescribedPermissions | DescribedGovernance:
    if parse(document, "its content").find("domain_access_rules") is None:
        permissions = parse_permissions(document, "its content")
        return DescribedPermissions(path, _grants(permissions, now), signature)
    rules = [
        DomainRuleFacts(str(rule.domains), rule, rule.topic_access_rules)
        for rule in parse_governance(document, "its content").domain_access_rules
    ]
    return DescribedGovernance(path, rules, signature)


def _grants(permissions: Permissions, now: datetime | None = None) -> list[GrantFacts]:
    return [_grant(grant, now) for grant in permissions.grants]


def _grant(grant: Grant, now: datetime | None) -> GrantFacts:
    return GrantFacts(
        name=grant.name,
        subject=grant.subject,
        not_before=grant.not_before,
        not_after=grant.not_after,
        valid_now=grant.validity.contains(now) if now else None,
        rules=[
            RuleFacts(
                qualifier="ALLOW" if rule.allow else "DENY",
                domains=str(rule.domains),
                rights=_by_kind((each.kind, each.right, each.name) for each in ros_rights(rule)),
                partitions=sorted(
                    {p for c in (*rule.publish, *rule.subscribe) for p in c.partitions}
                ),
            )
            for rule in grant.rules
        ],
        default="ALLOW" if grant.default_allow else "DENY",
    )


def _by_kind(rights: Iterable[tuple[str, str, str]]) -> RightNames:
    """Map the names of rights, given by kind, right and name, by kind and right."""
    table: dict[str, dict[str, list[str]]] = {}
    for kind, right, name in rights:
        table.setdefault(kind, {}).setdefault(right, []).append(name)
    return table


# ── configurations of Zenoh ───────────────────────────────────────────────────────────────


_ABOUT_THE_CONTENT = (
    ZenohFault.OTHER_DOCUMENT,
    ZenohFault.MALFORMED,
    ZenohFault.OUT_OF_DATE,
    ZenohFault.OTHER_NAME,
)


def _configuration(
    path: Path, document: bytes, signature: SignatureFacts, now: datetime
) -> DescribedConfiguration:
    """Describe any Zenoh configuration; ``rights`` only of one that sros wrote.

    Raises:
        DocumentError: Zenoh would not accept it.
    """
    read = parse_configuration(document, "its content")
    own: Configuration | None = None
    with suppress(SrosError):
        own = parse_rendered(document, "its content")
    access = read.access
    return DescribedConfiguration(
        path=path,
        mode=read.mode,
        connect=[each.text for each in read.connect],
        listen=[each.text for each in read.listen],
        access_control=AccessControlFacts(
            enabled=access.enabled,
            default="allow" if access.allows_by_default else "deny",
            rules=len(access.rules),
            subjects=len(access.subjects),
        ),
        made_by_sros=own is not None,
        domains=sorted(domains_of(own.access_control)) if own else [],
        rights=_remote_rights(own) if own else [],
        problems=_content_problems(path, now),
        signature=signature,
    )


def _remote_rights(configuration: Configuration) -> list[RemoteFacts]:
    """Return what each remote enclave may do here, and whether it is as the router of a session.

    The router of a session in client mode may send what the session may get, and the reverse: its
    entry shows the rights of the session's own enclave.
    """
    is_client = configuration.mode is Mode.CLIENT
    remotes = []
    for remote in configuration.access_control.remotes:
        rules = (rule.mirrored() if is_client else rule for rule in remote.rules)
        may = _by_kind((KIND_OF[right], right, name) for right, name in stated_names(rules))
        remotes.append(RemoteFacts(remote.common_name, is_client, may))
    return remotes


def _opened_at(folder: Path, now: datetime) -> OpenedZenoh | None:
    """Return the Zenoh configurations of the enclave in ``folder``; None if it is no enclave."""
    if not all((folder / file).exists() for file in (CERTIFICATE_FILE, PERMISSIONS_FILE)):
        return None
    state = open_enclave(folder, now=now)
    name = common_name_of(state.certificate.subject) if state.certificate else ""
    return open_zenoh(folder, name, state)


def _content_problems(path: Path, now: datetime) -> list[str]:
    """Return how a configuration, or a signed one, does not fit the enclave that it lies in.

    Of a configuration, `describe` itself says whether it is the document that was signed.
    """
    told = {ZenohFault.OTHER_DOCUMENT} if path.name in ZENOH_SIGNED else set()
    names = [pair for pair in ZENOH_SIGNED.items() if path.name in pair]
    opened = _opened_at(path.absolute().parent, now) if names else None
    return [
        str(each)
        for each in (opened.problems if opened else ())
        if each.fault in _ABOUT_THE_CONTENT
        and each.fault not in told
        and each.file in (*names[0], CERTIFICATE_FILE)
    ]


_ISSUED = (CERTIFICATE_FILE, PERMISSIONS_FILE)
_PEM = re.compile(rb"-----BEGIN ([A-Z0-9 ]+)-----(.*?)-----END \1-----\n?", re.DOTALL)


# ── the history ────────────────────────────────────────────────────────────────────────────


class HistoryStatus(StrEnum):
    """The state of an issued certificate or document."""

    CURRENT = "current"
    """It is in the keystore, and has not expired."""
    SUPERSEDED = "superseded"
    """It is no longer in the keystore, but neither revoked nor expired: DDS still accepts it."""
    REPLACED = "replaced"
    """Settings that the keystore had before; DDS never reads any."""
    REVOKED = "revoked"
    RETIRED = "retired"
    """A CA that was replaced, and is no longer trusted."""
    EXPIRED = "expired"
    DAMAGED = "damaged"
    """Lines of the ledger were missing or changed when the entry was made."""
    SENT = "sent"
    """It went to a robot; the keystore keeps no copy."""


@shows(spread=("entry",))
class HistoryItem(NamedTuple):
    """An entry of the ledger, and what became of it."""

    entry: Entry
    """The entry."""
    status: HistoryStatus
    """What became of it."""
    path: str
    """Its file in the keystore, or an empty string."""


class History(NamedTuple):
    """Everything that a keystore ever issued."""

    path: NamedPath
    entries: tuple[HistoryItem, ...]
    """The entries of the ledger, oldest first."""
    unexplained: tuple[str, ...]
    """Files that the ledger does not have."""
    gaps: tuple[str, ...]
    """Faults of the ledger: lines that are missing, changed or unreadable."""
    kind: Annotated[Literal["history"], "What PATH is."] = "history"


def history(root: Path, *, now: datetime) -> History:
    """Return the ledger of a keystore, compared with its certificates and signed documents."""
    issued, revoked_files = _files(root, _active_paths(root)), _files(root, _revoked_paths(root))
    retired = _files(root, _retired_paths(root))
    keystore = Keystore(root)
    ledger = keystore.ledger
    entries = ledger.entries
    # A new CA starts with an empty revocation list, and lists drop expired certificates, so the
    # ledger is asked too.
    revoked = {each.serial for each in entries if each.what == "revocation"}
    revoked |= {f"{entry.serial:x}" for crl in keystore.revocation_lists for entry in crl.revoked}
    moment = iso(now)
    settings = _files(root, iter((SETTINGS,)))

    def status(entry: Entry) -> HistoryStatus:
        if entry.what == GAP:
            return HistoryStatus.DAMAGED
        if entry.what == "answer":
            return HistoryStatus.SENT
        if entry.what == "settings":
            return HistoryStatus.CURRENT if entry.sha256 in settings else HistoryStatus.REPLACED
        if entry.what == "revocation" or entry.serial in revoked or entry.sha256 in revoked_files:
            return HistoryStatus.REVOKED
        if entry.sha256 in retired and entry.sha256 not in issued:
            return HistoryStatus.RETIRED
        if entry.not_after and entry.not_after < moment:
            return HistoryStatus.EXPIRED
        return HistoryStatus.CURRENT if entry.sha256 in issued else HistoryStatus.SUPERSEDED

    known = {entry.sha256 for entry in entries}
    found = {**retired, **revoked_files, **issued}
    places = {**found, **settings}
    return History(
        root,
        tuple(
            HistoryItem(entry, status(entry), (places.get(entry.sha256) or [""])[0])
            for entry in entries
        ),
        tuple(
            sorted(path for digest, paths in found.items() if digest not in known for path in paths)
        ),
        ledger.gaps,
    )


def _active_paths(root: Path) -> Iterator[str]:
    """Yield the paths where DDS loads certificates and signed documents, missing files included."""
    yield from (f"{PUBLIC}/{path.name}" for path in sorted((root / PUBLIC).glob("*.cert.pem")))
    yield from (GOVERNANCE_P7S, CRL)
    for name in list_enclaves(root):
        yield from (f"{enclave_folder(name)}/{file}" for file in _ISSUED)


def _revoked_paths(root: Path) -> Iterator[str]:
    for path in revoked_certificates(root):
        yield from (f"{REVOKED}/{path.parent.name}/{file}" for file in _ISSUED)


def _retired_paths(root: Path) -> Iterator[str]:
    yield from (f"{RETIRED}/{path.name}" for path in sorted((root / RETIRED).glob("*.cert.pem")))


def _files(root: Path, paths: Iterator[str]) -> dict[str, list[str]]:
    """Map SHA-256 digests, as in the ledger, to the paths of existing files."""
    found: dict[str, list[str]] = {}
    for path in paths:
        if (root / path).is_file() and not (root / path).is_symlink():
            for digest in _digests(root / path):
                found.setdefault(digest, []).append(path)
    return found


def _digests(path: Path) -> list[str]:
    """Return the digests of a file's content; a CA file may hold several certificates."""
    data = read_bytes(path, "file")
    if not path.name.endswith("cert.pem"):
        return [hashlib.sha256(data).hexdigest()]
    found = []
    for part in _PEM.finditer(data):
        content = part[0]
        if part[1] == b"CERTIFICATE":
            try:
                content = binascii.a2b_base64(part[2])
            except binascii.Error:
                return ["unreadable"]
        found.append(hashlib.sha256(content).hexdigest())
    return found or ["unreadable"]
