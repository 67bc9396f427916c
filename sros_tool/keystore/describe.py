"""Descriptions of keystores, enclaves, certificates, signed documents, and of their history."""

from __future__ import annotations

import binascii
import hashlib
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from datetime import datetime
from enum import StrEnum
from pathlib import Path
from shlex import quote
from typing import Annotated, Literal, NamedTuple

from cryptography import x509

from sros_tool.dds.governance import DomainRule, TopicRule, parse_governance
from sros_tool.dds.permissions import Grant, Permissions, parse_permissions
from sros_tool.errors import DocumentError, SrosError
from sros_tool.fleet.robots import Fleet
from sros_tool.keystore.fleet import left_enclaves, load_fleet
from sros_tool.keystore.known_keys import known_authorities, unknown_authorities
from sros_tool.keystore.layout import (
    CERTIFICATE_FILE,
    CRL,
    FLEET,
    GOVERNANCE_P7S,
    KEY_URI_FILE,
    PERMISSIONS_FILE,
    PUBLIC,
    RETIRED,
    REVOKED,
    ROLES,
    SETTINGS,
    ZENOH_SIGNED,
    ca_certificate_path,
    ca_key_path,
    enclave_folder,
    enclaves_below,
    is_keystore,
    list_enclaves,
    locate_enclave,
    permissions_ca_for,
    refuse_flat_keystore,
    revoked_certificates,
    search_enclaves,
)
from sros_tool.keystore.ledger import GAP, LEFT, RESTORED, SEALED, Entry
from sros_tool.keystore.participant import EvaluatedEnclave, evaluate_enclave
from sros_tool.keystore.reader import FilesReadOnce, OpenedEnclave, OpenedKeystore, open_enclave
from sros_tool.keystore.zenoh_files import OpenedZenoh, ZenohFault, open_zenoh
from sros_tool.pki.certificates import (
    authority_text,
    common_name_of,
    digest,
    load_certificates,
    readable_fingerprints,
    subject_text,
    validity_of,
)
from sros_tool.pki.chains import Checks, chain_fault
from sros_tool.pki.crl import CRL_MARK, RevocationList, load_crl
from sros_tool.pki.keys import algorithm, holds_private_key, load_key
from sros_tool.pki.token import TokenUri, parse_token_file
from sros_tool.policy.rights import KIND_OF
from sros_tool.translate import ros_rights
from sros_tool.translate_zenoh.rights import domains_of, stated_names
from sros_tool.validity import iso
from sros_tool.values import Words, shows
from sros_tool.wording import first_few
from sros_tool.xml import parse, read_bytes
from sros_tool.zenoh.configuration import (
    Configuration,
    Mode,
    ZenohNetwork,
    ZenohRouter,
    parse_rendered,
)
from sros_tool.zenoh.document import parse_configuration

_ZENOH_SUFFIXES = (".json5", ".json", ".yaml", ".yml")

NamedPath = Annotated[Path, "PATH, as given on the command line."]
Problems = Annotated[Sequence[str], "Problems that keep a process from running in the enclave."]


# ── descriptions and their JSON ────────────────────────────────────────────────────────────


class CertificateFacts(NamedTuple):
    """The parts of a certificate that matter to DDS Security."""

    subject: str
    """Subject of the certificate."""
    issuer: str
    """Subject of the CA that issued the certificate."""
    serial: str
    """Serial number, in hexadecimal."""
    is_ca: bool
    """Whether this is the certificate of a CA."""
    key: str
    """Kind of the public key, such as ``EC secp256r1``."""
    signature: str
    """Hash algorithm of the signature, such as ``sha256``."""
    sha256: str
    """SHA-256 of the certificate (DER), in hexadecimal."""
    not_before: datetime
    """Start of the validity, in UTC."""
    not_after: datetime
    """Expiry, in UTC."""
    valid_now: bool
    """Whether the certificate is valid now."""


class RevocationListFacts(NamedTuple):
    """A revocation list; after it has expired, DDS refuses all certificates of its CA."""

    issuer: str
    """Subject of the CA that signed the list."""
    number: int
    """Number of the list; each new list has a higher number."""
    not_before: datetime
    """Start of the validity, in UTC."""
    not_after: datetime
    """Expiry, in UTC."""
    valid_now: bool
    """Whether the list is valid now."""
    revoked: Sequence[str]
    """Serial numbers of the revoked certificates, in hexadecimal."""


@shows(spread=("first",), optional=("further", "crl"))
class CertificateFile(NamedTuple):
    """The certificates in a PEM file."""

    first: CertificateFacts
    """The first certificate."""
    further: Sequence[CertificateFacts] | None
    """The other certificates in the file: the chain, or the other CA during a rotation."""
    crl: RevocationListFacts | None
    """The revocation list in the file; left out if there is none."""


@shows(spread=("file",))
class AuthorityFile(NamedTuple):
    """The certificate file of a CA."""

    file: CertificateFile
    """Content of the file."""
    key_present: bool
    """Whether the private key of the CA is in the keystore."""


class UnreadableFile(NamedTuple):
    """A file that cannot be read."""

    error: str
    """Why the file cannot be read."""


class TokenPlace(NamedTuple):
    """The place of a key on a PKCS#11 token."""

    token: str
    """Label of the token."""
    object: str
    """Label of the key."""
    pin_source: str | None
    """File with the PIN; null if the URI names none."""


RightNames = Mapping[str, Mapping[str, Sequence[str]]]
"""Names by kind and right, such as ``{"topics": {"publish": ["/chatter"]}}``."""


class RuleFacts(NamedTuple):
    """A rule of a grant."""

    qualifier: Annotated[str, Words(("ALLOW", "DENY"))]
    """Whether the rule allows or denies."""
    domains: str
    """The DDS domains to which the rule applies."""
    rights: RightNames
    """Names by kind (``topics``, ``services``, ``actions``, ``dds``) and by right, such as
    ``publish``."""
    partitions: Sequence[str]
    """The DDS partitions to which the rule applies."""


@shows(optional=("valid_now",))
class GrantFacts(NamedTuple):
    """A grant of permissions."""

    name: str
    """Name of the grant."""
    subject: str
    """Subject of the certificates to which the grant gives rights."""
    not_before: str
    """Start of the validity, as written in the document."""
    not_after: str
    """Expiry, as written in the document."""
    valid_now: bool | None
    """Whether the grant is valid now."""
    rules: Sequence[RuleFacts]
    """Rules of the grant, in order; the first one that matches decides."""
    default: Annotated[str, Words(("ALLOW", "DENY"))]
    """The decision if no rule matches."""


class EnclaveFacts(NamedTuple):
    """The files of an enclave; the value for a missing or unreadable file is null."""

    loadable: bool
    """Whether a process can run in the enclave now."""
    problems: Problems
    subject: str | None
    """Subject of the certificate, or null."""
    valid_until: datetime | None
    """Expiry of the certificate, in UTC, or null."""
    expires: datetime | None
    """First expiry of certificates and permissions, in UTC, or null."""
    identity_ca: str | None
    """Subject of the identity CA that the enclave trusts, or null."""
    identity_ca_sha256: str | None
    """SHA-256 of the identity CA's certificate (DER), in hexadecimal, or null."""
    permissions_ca: str | None
    """Subject of the permissions CA that the enclave trusts, or null."""
    permissions_ca_sha256: str | None
    """SHA-256 of the permissions CA's certificate (DER), in hexadecimal, or null."""
    domains: str | None
    """The ROS domains of the governance, or null."""
    token: TokenPlace | None
    """Place of the key on a PKCS#11 token; null for a key in a file."""
    permissions: Sequence[GrantFacts] | None
    """The grants in the permissions, or null."""
    permissions_bytes: int | None
    """Size of permissions.p7s in bytes, or null."""


@shows(spread=("facts",))
class KeystoreEnclave(NamedTuple):
    """An enclave of a keystore."""

    name: str
    """Name of the enclave."""
    key_on_robot: bool
    """Whether the key was made on the robot and is not in the keystore."""
    facts: EnclaveFacts
    """The enclave's files."""


class ZenohFileFacts(NamedTuple):
    """A Zenoh configuration file."""

    file: str
    """Name of the file, such as ``session.json5``."""
    mode: Mode
    """How the process takes part in the network."""


class ZenohFiles(NamedTuple):
    """The Zenoh configurations of an enclave."""

    files: Sequence[ZenohFileFacts]
    """The configurations that are signed."""
    problems: Annotated[
        Sequence[str], "Problems that keep a process of rmw_zenoh_cpp from running in the enclave."
    ]


class RouterFacts(NamedTuple):
    """A router of a robot or a host."""

    router: str
    """Enclave of the router."""
    endpoints: Sequence[str]
    """Where sessions and other routers connect to the router, as HOST:PORT."""
    listen: Sequence[str]
    """Where the router listens, as HOST:PORT."""
    enclaves: Sequence[str]
    """The enclaves whose sessions connect to the router, perhaps with wildcards."""
    crossing: Sequence[str]
    """Names that may pass between this router and others; empty if the network's names apply."""


def router_facts(router: ZenohRouter) -> RouterFacts:
    """Return the facts about a Zenoh router that are printed."""
    return RouterFacts(
        router.name, router.endpoints, router.listening(), router.enclaves, router.crossing
    )


class NetworkFacts(NamedTuple):
    """The Zenoh network of a keystore."""

    router: str
    """The enclave of the first router."""
    endpoints: Sequence[str]
    """Endpoints at which sessions connect to the router, as HOST:PORT."""
    listen: Sequence[str]
    """Endpoints on which the router listens, as HOST:PORT."""
    mode: Mode
    """Whether sessions also connect to each other (``peer``), or only to the router."""
    routers: Sequence[RouterFacts]
    """Further routers, on robots or other hosts."""
    crossing: Sequence[str]
    """The names that may pass between routers; empty if all names to which enclaves have rights may
    pass.
    """


class SignerFacts(NamedTuple):
    """The signature of a document, and the certificate of its signer."""

    signer: str | None
    """Subject of the signer's certificate, or null."""
    signer_sha256: str | None
    """SHA-256 of the signer's certificate (DER), in hexadecimal, or null."""
    digest: str
    """Hash algorithm of the signature, such as ``sha256``."""
    bytes: int
    """Size of the signed document in bytes."""
    signature_problem: str
    """Why the signature is not valid; empty if it is valid."""


@shows(spread=("signer",))
class SignatureFacts(NamedTuple):
    """Whether a document is signed, and by whom."""

    signed: bool
    """Whether the document is signed."""
    signature_verified: bool | None
    """Whether the signature is valid; null if the permissions CA is not known."""
    signer: SignerFacts | None
    """The signature; null if the document is not signed."""


@shows(spread=("rule",))
class DomainRuleFacts(NamedTuple):
    """A domain rule of a governance."""

    domains: str
    """The DDS domains to which the rule applies."""
    rule: DomainRule
    """Attributes of the rule."""
    topic_rules: Sequence[TopicRule]
    """Topic rules, in order; the first one that matches a topic decides."""


class AccessControlFacts(NamedTuple):
    """The access control of a Zenoh configuration."""

    enabled: bool
    """Whether access control is on."""
    default: Annotated[str, Words(("allow", "deny"))]
    """The decision if no rule matches."""
    rules: int
    """Number of rules."""
    subjects: int
    """Number of subjects."""


class RemoteFacts(NamedTuple):
    """The rights that a Zenoh configuration gives to a remote enclave."""

    enclave: str
    """Name of the remote enclave."""
    own_rights_by_router: bool
    """Whether the remote enclave is the router of this client; ``may`` then has the rights of the
    client itself.
    """
    may: RightNames
    """Names by kind (``topics``, ``services``) and by right, such as ``publish``; wildcards are
    written as in Zenoh.
    """


class DescribedKeystore(NamedTuple):
    """A keystore: its settings, CAs, shared documents and enclaves."""

    path: NamedPath
    template: str | None
    """Name of the template in the settings, or null."""
    ledger: Sequence[str]
    """Faults of the ledger."""
    authorities: Mapping[str, AuthorityFile | UnreadableFile]
    """CAs of the keystore, by role (``identity``, ``permissions``)."""
    unknown_authorities: Sequence[str]
    """CAs that somebody else added to CA files of the keystore or of an enclave, as text."""
    governance: DescribedGovernance | UnreadableFile | None
    """Governance of the keystore, or null."""
    zenoh: NetworkFacts | None
    """Zenoh network in the settings; null if there is none."""
    enclaves: Sequence[KeystoreEnclave]
    """Enclaves of the keystore."""
    unreadable: Sequence[str]
    """Folders that cannot be read, with the reason."""
    problems: Sequence[str]
    """All problems of the keystore; if not empty, the exit status is 1."""
    kind: Annotated[Literal["keystore"], "What PATH is."] = "keystore"


@shows(spread=("facts",))
class DescribedEnclave(NamedTuple):
    """The folder of an enclave."""

    path: NamedPath
    key_on_robot: bool
    """Whether the key was made on the robot, and is not in this folder."""
    facts: EnclaveFacts
    """The enclave's files."""
    zenoh: ZenohFiles | None
    """Zenoh configurations of the enclave, or null."""
    kind: Annotated[Literal["enclave"], "What PATH is."] = "enclave"


@shows(spread=("file",))
class DescribedCertificates(NamedTuple):
    """A file of certificates."""

    path: NamedPath
    file: CertificateFile
    """Content of the file."""
    kind: Annotated[Literal["certificate"], "What PATH is."] = "certificate"


@shows(spread=("facts",))
class DescribedList(NamedTuple):
    """A revocation list."""

    path: NamedPath
    facts: RevocationListFacts
    """Content of the list."""
    kind: Annotated[Literal["revocation list"], "What PATH is."] = "revocation list"


class DescribedKey(NamedTuple):
    """A private key."""

    path: NamedPath
    algorithm: str
    """Kind of the key, such as ``EC secp256r1``."""
    mode: str
    """Permission bits of the file, in octal."""
    kind: Annotated[Literal["private key"], "What PATH is."] = "private key"


@shows(spread=("place",))
class DescribedKeyOnToken(NamedTuple):
    """The place of a key on a PKCS#11 token."""

    path: NamedPath
    place: TokenPlace
    """Token and object of the key."""
    kind: Annotated[Literal["key on a token"], "What PATH is."] = "key on a token"


@shows(spread=("signature",))
class DescribedPermissions(NamedTuple):
    """Permissions, signed or not."""

    path: NamedPath
    grants: Sequence[GrantFacts]
    """Grants of the permissions."""
    signature: SignatureFacts
    """Signature of the permissions."""
    kind: Annotated[Literal["permissions"], "What PATH is."] = "permissions"


@shows(spread=("signature",))
class DescribedGovernance(NamedTuple):
    """Governance, signed or not."""

    path: Annotated[Path, "Path of the governance."]
    domain_rules: Sequence[DomainRuleFacts]
    """Domain rules of the governance."""
    signature: SignatureFacts
    """Signature of the governance."""
    kind: Annotated[Literal["governance"], "What PATH is."] = "governance"


@shows(spread=("signature",))
class DescribedConfiguration(NamedTuple):
    """A configuration of a Zenoh process, signed or not."""

    path: NamedPath
    mode: Mode
    """How the process takes part in the network."""
    connect: Sequence[str]
    """Endpoints to which the process connects, such as ``tls/localhost:7447``."""
    listen: Sequence[str]
    """Endpoints on which the process listens."""
    access_control: AccessControlFacts
    """Access control of the process."""
    made_by_sros: bool
    """Whether the configuration is exactly as sros writes it."""
    domains: Sequence[int]
    """The ROS domains to which the rules apply; empty if sros did not write the configuration."""
    rights: Sequence[RemoteFacts]
    """The rights of remote enclaves; empty if sros did not write the configuration."""
    problems: Sequence[str]
    """How the configuration differs from its signed document, or does not fit its enclave."""
    signature: SignatureFacts
    """Signature of the configuration."""
    kind: Annotated[Literal["Zenoh configuration"], "What PATH is."] = "Zenoh configuration"


Described = (
    DescribedKeystore
    | DescribedEnclave
    | DescribedCertificates
    | DescribedList
    | DescribedKey
    | DescribedKeyOnToken
    | DescribedPermissions
    | DescribedGovernance
    | DescribedConfiguration
)

_NOT_SIGNED = SignatureFacts(signed=False, signature_verified=False, signer=None)


# ── describing ─────────────────────────────────────────────────────────────────────────────


def _remedy_naming_enclaves(folder: Path) -> str:
    """Return a remedy that names the enclaves in a folder, or "" if the folder has none."""
    with suppress(SrosError):
        root, name = locate_enclave(folder)
        if enclaves := enclaves_below(root, name):
            command = quote(str(root / enclave_folder(enclaves[0])))
            return f"It contains {first_few(enclaves, 3)}; name one: `sros inspect {command}`."
    return ""


def describe(
    path: Path,
    *,
    now: datetime,
    authority: Path | None = None,
    files: FilesReadOnce | None = None,
    keystore: OpenedKeystore | None = None,
) -> Described:
    """Describe the content of ``path``.

    Args:
        path: a keystore, the folder of an enclave, or a file in them.
        now: the time for which validity is reported.
        authority: the file of the permissions CA's certificate, to verify a signed document; by
            default, the file next to the document.
        files: files that were already read.
        keystore: the keystore at ``path``, if it is already opened.

    Raises:
        DocumentError: ``path`` is something else, or cannot be read.
    """
    files = files or FilesReadOnce()
    if path.is_dir():
        if is_keystore(path):
            return _describe_keystore(keystore or OpenedKeystore(path), now)
        of_enclave = (CERTIFICATE_FILE, PERMISSIONS_FILE, KEY_URI_FILE)
        if any((path / name).exists() for name in of_enclave):
            state = open_enclave(path, now=now, files=files)
            evaluation = evaluate_enclave("", path, state, moment=now)
            elsewhere = state.key_on_robot
            facts = (
                _facts_in_keystore(evaluation, state) if elsewhere else _enclave_facts(evaluation)
            )
            return DescribedEnclave(path, state.key_on_robot, facts, _describe_zenoh(path, now))
        refuse_flat_keystore(path)
        raise DocumentError(
            f"'{path}' is neither a keystore nor an enclave",
            "It has no enclaves folder, and neither cert.pem nor permissions.p7s.",
            _remedy_naming_enclaves(path),
        )
    data = files.read(path, "file")
    try:
        return _describe_file(path, data, now, authority, files)
    except SrosError as error:
        raise DocumentError(f"'{path}' cannot be read: {error.what}", error.why) from error


def problems_of(described: Described) -> Sequence[str]:
    """Return the problems of a keystore, enclave or Zenoh configuration; () for anything else."""
    if isinstance(described, DescribedEnclave):
        zenoh = described.zenoh
        return (*described.facts.problems, *(zenoh.problems if zenoh else ()))
    if isinstance(described, (DescribedKeystore, DescribedConfiguration)):
        return described.problems
    return ()


def _describe_file(
    path: Path, data: bytes, now: datetime, authority: Path | None, files: FilesReadOnce
) -> Described:
    """Describe a file by its content, not by its name."""
    if b"-----BEGIN CERTIFICATE-----" in data:
        return DescribedCertificates(path, _describe_certificates(data, "in it", now))
    if CRL_MARK in data:
        return DescribedList(path, _describe_revocation_list(load_crl(data, "in it"), now))
    if path.name == KEY_URI_FILE:
        return DescribedKeyOnToken(path, _describe_token(parse_token_file(data)))
    if holds_private_key(data):
        mode = path.stat().st_mode & 0o777
        return DescribedKey(path, algorithm(load_key(data, "in it")), f"{mode:04o}")
    if b"multipart/signed" in data[:1000].lower():
        signed = files.signed_document(data)
        signature = _describe_signature(path, data, now, authority, files)
        if signed.document.lstrip()[:1] == b"<":
            return _describe_document(path, signed.document, signature, now)
        return _describe_configuration(path, signed.text, signature, now)
    if data.lstrip()[:1] == b"<":
        return _describe_document(path, data, _NOT_SIGNED, now)
    if path.suffix in _ZENOH_SUFFIXES or data.lstrip()[:1] == b"{":
        return _describe_configuration(
            path, data, _describe_signature_next_to(path, data, now, authority, files), now
        )
    raise DocumentError(
        "it is neither a PEM certificate, revocation list or key, nor a signed document, nor XML, "
        "nor a Zenoh configuration",
    )


def _describe_keystore(keystore: OpenedKeystore, now: datetime) -> DescribedKeystore:
    settings = keystore.settings
    authorities: dict[str, AuthorityFile | UnreadableFile] = {}
    for role in ROLES:
        path = keystore.root / ca_certificate_path(role)
        if not path.exists():
            continue
        try:
            file = _describe_certificates(keystore.read(path, "file"), f"'{path}'", now)
            authorities[role] = AuthorityFile(file, (keystore.root / ca_key_path(role)).exists())
        except SrosError as error:
            authorities[role] = UnreadableFile(str(error))
    names, unread = search_enclaves(keystore.root)
    enclaves = [_describe_enclave(keystore, name, now) for name in names]
    governance = _describe_governance(keystore, now)
    problems = [
        f"{enclave.name}: {problem}" for enclave in enclaves for problem in enclave.facts.problems
    ]
    unreadable = [f"'{folder.path}' cannot be read: {folder.why}" for folder in unread]
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
    strangers: list[str] = []
    for role in authorities:
        with suppress(SrosError):  # a damaged ledger or CA file is reported elsewhere
            strangers += _unknown_authorities(keystore, role, names, now)
    return DescribedKeystore(
        path=keystore.root,
        template=settings.name if settings else None,
        ledger=gaps,
        authorities=authorities,
        unknown_authorities=strangers,
        governance=governance,
        zenoh=_describe_network(settings.zenoh) if settings and settings.zenoh else None,
        enclaves=enclaves,
        unreadable=unreadable,
        problems=problems + strangers,
    )


def _unknown_authorities(
    keystore: OpenedKeystore, role: str, names: Iterable[str], now: datetime
) -> Iterator[str]:
    """Yield a clause on each CA that the ledger or the CA file of the keystore lacks.

    Raises:
        SrosError: the ledger or the CA file of the keystore cannot be read.
    """
    for authority in unknown_authorities(keystore, role):
        yield f"{role} CA: {authority_text(authority)} is not in the ledger"
    known, file = {*map(digest, keystore.authority(role))}, f"{role}_ca.cert.pem"
    for name in names:
        data = keystore.enclave(name, now=now).files.get(file, b"")
        if more := readable_fingerprints(data) - known:
            text = f"{file} has a CA that the keystore lacks (SHA-256 {min(more)[:8]})"
            yield f"{role} CA: {name}: {text}"


def _describe_governance(
    keystore: OpenedKeystore, now: datetime
) -> DescribedGovernance | UnreadableFile | None:
    """Describe the governance that a keystore's enclaves share; None if there is none."""
    if not keystore.has(GOVERNANCE_P7S):
        return None
    try:
        described = describe(keystore.root / GOVERNANCE_P7S, now=now, files=keystore.files)
    except SrosError as error:
        return UnreadableFile(str(error))
    if isinstance(described, DescribedGovernance):
        return described
    return UnreadableFile(f"it is a {described.kind} document")


def _describe_network(network: ZenohNetwork) -> NetworkFacts:
    routers = [router_facts(router) for router in network.routers]
    return NetworkFacts(
        network.router,
        network.endpoints,
        network.listening(),
        network.mode,
        routers,
        network.crossing,
    )


def _describe_zenoh(folder: Path, now: datetime) -> ZenohFiles | None:
    """Describe the Zenoh configurations of an enclave, with their problems; None without any."""
    opened = _open_zenoh_in(folder, now)
    if opened is None or not opened.files:
        return None
    modes = {file: configuration.mode for file, configuration in opened.configurations.items()}
    return ZenohFiles(
        [ZenohFileFacts(file, modes[file]) for file in opened.files if file in modes],
        [str(problem) for problem in opened.problems],
    )


def _describe_enclave(keystore: OpenedKeystore, name: str, now: datetime) -> KeystoreEnclave:
    """Describe an enclave of a keystore."""
    state = keystore.enclave(name, now=now)
    evaluation = evaluate_enclave(name, keystore.folder(name), state, moment=now)
    return KeystoreEnclave(name, state.key_on_robot, _facts_in_keystore(evaluation, state))


def _facts_in_keystore(evaluation: EvaluatedEnclave, state: OpenedEnclave) -> EnclaveFacts:
    """Describe an enclave's files, without counting a key that is only on the robot as missing.

    The result also has the problems in ``state`` for which only some vendors refuse the enclave.
    """
    problems = [*evaluation.problems, *evaluation.partial_refusal_clauses(state.problems)]
    return _enclave_facts(evaluation)._replace(problems=problems)


def _enclave_facts(evaluation: EvaluatedEnclave) -> EnclaveFacts:
    """Describe an enclave's files, with the problems of a process on this machine."""
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
        token=_describe_token(state.token) if state.token else None,
        permissions=_describe_grants(state.permissions) if state.permissions else None,
        permissions_bytes=state.permissions_bytes,
    )


def _describe_token(place: TokenUri) -> TokenPlace:
    return TokenPlace(place.token, place.object, place.pin_source or None)


def _subject_and_digest(certificate: x509.Certificate | None) -> tuple[str | None, str | None]:
    """Return subject and SHA-256 of a CA's certificate, or (None, None).

    Two CAs can have the same subject, so the SHA-256 tells them apart.
    """
    return (subject_text(certificate.subject), digest(certificate)) if certificate else (None, None)


def _describe_certificate(certificate: x509.Certificate, now: datetime) -> CertificateFacts:
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


def _describe_certificates(data: bytes, name: str, now: datetime) -> CertificateFile:
    """Describe the certificates of a PEM file, and the revocation list after them."""
    certificates = load_certificates(data, name)
    first, *further = (_describe_certificate(certificate, now) for certificate in certificates)
    crl = _describe_revocation_list(load_crl(data, name), now) if CRL_MARK in data else None
    return CertificateFile(first, further or None, crl)


def _describe_revocation_list(crl: RevocationList, now: datetime) -> RevocationListFacts:
    return RevocationListFacts(
        issuer=subject_text(crl.list.issuer),
        number=crl.number,
        not_before=crl.this_update,
        not_after=crl.next_update,
        valid_now=crl.this_update <= now <= crl.next_update,
        revoked=[f"{entry.serial:x}" for entry in crl.revoked],
    )


def _describe_signature(
    path: Path, data: bytes, now: datetime, authority: Path | None, files: FilesReadOnce
) -> SignatureFacts:
    """Describe the signature of the signed document ``data`` at ``path``."""
    signed = files.signed_document(data)
    authority_file = authority or permissions_ca_for(path)
    reason = "no certificate of a permissions CA is next to the document; name one with --ca"
    verified: bool | None = None
    if authority_file:
        certificates = load_certificates(
            files.read(authority_file, "certificate"), f"'{authority_file}'"
        )
        try:
            signed.verify(certificates[0])
            reason = chain_fault(certificates[0], certificates, moment=now, checks=Checks.DOCUMENTS)
        except SrosError as error:
            reason = str(error)
        verified = not reason
    subject, sha256 = _subject_and_digest(signed.signer())
    signer = SignerFacts(subject, sha256, signed.digest, len(data), reason)
    return SignatureFacts(signed=True, signature_verified=verified, signer=signer)


def _describe_signature_next_to(
    path: Path, data: bytes, now: datetime, authority: Path | None, files: FilesReadOnce
) -> SignatureFacts:
    """Describe the signature in the signed document next to a Zenoh configuration."""
    signed = path.with_name(ZENOH_SIGNED.get(path.name, path.name))
    if signed == path or not signed.exists():
        return _NOT_SIGNED
    message = files.read(signed, "signed document")
    signature = _describe_signature(signed, message, now, authority, files)
    if files.signed_document(message).text == data or signature.signer is None:
        return signature
    problem = f"{path.name} is not the document that {signed.name} signs"
    signer = signature.signer._replace(signature_problem=problem)
    return signature._replace(signature_verified=False, signer=signer)


def _describe_document(
    path: Path, document: bytes, signature: SignatureFacts, now: datetime
) -> DescribedPermissions | DescribedGovernance:
    if parse(document, "its content").find("domain_access_rules") is None:
        permissions = parse_permissions(document, "its content")
        return DescribedPermissions(path, _describe_grants(permissions, now), signature)
    rules = [
        DomainRuleFacts(str(rule.domains), rule, rule.topic_access_rules)
        for rule in parse_governance(document, "its content").domain_access_rules
    ]
    return DescribedGovernance(path, rules, signature)


def _describe_grants(permissions: Permissions, now: datetime | None = None) -> list[GrantFacts]:
    return [_describe_grant(grant, now) for grant in permissions.grants]


def _describe_grant(grant: Grant, now: datetime | None) -> GrantFacts:
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
                rights=_rights_by_kind(
                    (right.kind, right.right, right.name) for right in ros_rights(rule)
                ),
                partitions=sorted(
                    {p for c in (*rule.publish, *rule.subscribe) for p in c.partitions}
                ),
            )
            for rule in grant.rules
        ],
        default="ALLOW" if grant.default_allow else "DENY",
    )


def _rights_by_kind(rights: Iterable[tuple[str, str, str]]) -> RightNames:
    """Group names by kind and right, from (kind, right, name)."""
    table: dict[str, dict[str, list[str]]] = {}
    for kind, right, name in rights:
        table.setdefault(kind, {}).setdefault(right, []).append(name)
    return table


# ── Zenoh configurations ──────────────────────────────────────────────────────────────────


_CONTENT_FAULTS = (
    ZenohFault.OTHER_DOCUMENT,
    ZenohFault.MALFORMED,
    ZenohFault.OUT_OF_DATE,
    ZenohFault.OTHER_NAME,
)


def _describe_configuration(
    path: Path, document: bytes, signature: SignatureFacts, now: datetime
) -> DescribedConfiguration:
    """Describe a Zenoh configuration; ``rights`` and ``domains`` are empty unless sros wrote it.

    Raises:
        DocumentError: Zenoh would refuse the configuration.
    """
    # A signed document is JSON5, whatever the name of the configuration is.
    yaml = path.suffix in (".yaml", ".yml")
    read = parse_configuration(document, f"its content{path.suffix if yaml else ''}")
    own: Configuration | None = None
    with suppress(SrosError):
        own = parse_rendered(document, "its content")
    access = read.access
    return DescribedConfiguration(
        path=path,
        mode=read.mode,
        connect=[endpoint.text for endpoint in read.connect],
        listen=[endpoint.text for endpoint in read.listen],
        access_control=AccessControlFacts(
            enabled=access.enabled,
            default="allow" if access.allows_by_default else "deny",
            rules=len(access.rules),
            subjects=len(access.subjects),
        ),
        made_by_sros=own is not None,
        domains=sorted(domains_of(own.access_control)) if own else [],
        rights=_describe_remote_rights(own) if own else [],
        problems=_content_problems(path, now),
        signature=signature,
    )


def _describe_remote_rights(configuration: Configuration) -> list[RemoteFacts]:
    """Return the rights that a configuration gives to remote enclaves.

    In client mode, the remote enclave is the router.  The rules for the router mirror the rules of
    the client: the router may send what the client may receive.  So the router's entry shows the
    rights of the client's own enclave.
    """
    is_client = configuration.mode is Mode.CLIENT
    remotes = []
    for remote in configuration.access_control.remotes:
        rules = (rule.mirrored() if is_client else rule for rule in remote.rules)
        may = _rights_by_kind((KIND_OF[right], right, name) for right, name in stated_names(rules))
        remotes.append(RemoteFacts(remote.common_name, is_client, may))
    return remotes


def _open_zenoh_in(folder: Path, now: datetime) -> OpenedZenoh | None:
    """Return the Zenoh configurations in ``folder``; None if it is not an enclave's folder."""
    if not all((folder / file).exists() for file in (CERTIFICATE_FILE, PERMISSIONS_FILE)):
        return None
    state = open_enclave(folder, now=now)
    name = common_name_of(state.certificate.subject) if state.certificate else ""
    return open_zenoh(folder, name, state)


def _content_problems(path: Path, now: datetime) -> list[str]:
    """Return how the Zenoh configuration at ``path`` contradicts its enclave.

    ``path`` can also be the signed document.  A difference between a configuration and its signed
    document is not included, because `describe` reports it with the signature.
    """
    reported = {ZenohFault.OTHER_DOCUMENT} if path.name in ZENOH_SIGNED else set()
    names = [pair for pair in ZENOH_SIGNED.items() if path.name in pair]
    opened = _open_zenoh_in(path.absolute().parent, now) if names else None
    return [
        str(problem)
        for problem in (opened.problems if opened else ())
        if problem.fault in _CONTENT_FAULTS
        and problem.fault not in reported
        and problem.file in (*names[0], CERTIFICATE_FILE)
    ]


_ISSUED_FILES = (CERTIFICATE_FILE, PERMISSIONS_FILE)
_PEM_BLOCK = re.compile(rb"-----BEGIN ([A-Z0-9 ]+)-----(.*?)-----END \1-----\n?", re.DOTALL)


# ── the history ────────────────────────────────────────────────────────────────────────────


class HistoryStatus(StrEnum):
    """The state of an issued certificate or document."""

    CURRENT = "current"
    """The certificate or document is in the keystore, and has not expired; or a robot that left has
    not come back, and its enclave is valid.
    """
    SUPERSEDED = "superseded"
    """The keystore has a later file instead, but DDS still accepts this one: it is not revoked and
    has not expired.
    """
    REPLACED = "replaced"
    """Earlier settings of the keystore, which DDS does not read; or a robot that left, but came
    back, or whose enclave is no longer valid.
    """
    REVOKED = "revoked"
    RETIRED = "retired"
    """A replaced CA, which is no longer trusted."""
    EXPIRED = "expired"
    DAMAGED = "damaged"
    """Lines of the ledger were missing or changed when this entry was made."""
    INCOMPLETE = "incomplete"
    """The keystore came from a backup: what it issued after the backup may be missing."""
    SENT = "sent"
    """Sent to a robot; the keystore keeps no copy."""
    SEALED = "sealed"
    """A part of the ledger that will not be written again."""


@shows(spread=("entry",))
class HistoryItem(NamedTuple):
    """An entry of the ledger, and the present state of the recorded certificate or document."""

    entry: Entry
    """Entry of the ledger."""
    status: HistoryStatus
    """Present state of the certificate or document."""
    path: str
    """File of the certificate or document in the keystore; empty if there is none."""


class History(NamedTuple):
    """All certificates and documents that a keystore issued, by its ledger."""

    path: NamedPath
    entries: tuple[HistoryItem, ...]
    """The entries of the ledger, oldest first."""
    unexplained: tuple[str, ...]
    """Certificates and signed documents in the keystore that the ledger does not record."""
    gaps: tuple[str, ...]
    """Faults of the ledger: lines that are missing, changed or unreadable."""
    kind: Annotated[Literal["history"], "What PATH is."] = "history"


def history(keystore: OpenedKeystore, *, now: datetime) -> History:
    """Return the entries of a keystore's ledger, with the present state of the recorded items."""
    issued = _paths_by_digest(keystore, _active_paths(keystore))
    revoked_files = _paths_by_digest(keystore, _revoked_paths(keystore))
    retired = _paths_by_digest(keystore, _retired_paths(keystore))
    ledger = keystore.ledger
    entries = ledger.entries
    # Lists do not tell everything: a new CA begins with an empty list, and expired certificates are
    # dropped from lists.  So the ledger counts, too.
    revoked = {entry.serial for entry in entries if entry.what == "revocation"}
    revoked |= {f"{entry.serial:x}" for crl in keystore.revocation_lists for entry in crl.revoked}
    moment = iso(now)
    settings = _paths_by_digest(keystore, iter((SETTINGS, FLEET)))
    fleet = None
    with suppress(SrosError):  # `sros check` reports a fleet file that cannot be read
        fleet = load_fleet(keystore)
    left = left_enclaves(keystore, fleet or Fleet.of(()), now)

    def status(entry: Entry) -> HistoryStatus:
        if entry.what == GAP:
            return HistoryStatus.DAMAGED
        if entry.what == RESTORED:
            return HistoryStatus.INCOMPLETE
        if entry.what == SEALED:
            return HistoryStatus.SEALED
        if entry.what in ("answer", "release"):
            return HistoryStatus.SENT
        if entry.what == LEFT:
            is_left = left.get(entry.enclave) == entry.reason
            return HistoryStatus.CURRENT if is_left else HistoryStatus.REPLACED
        if entry.what in ("settings", "fleet"):
            return HistoryStatus.CURRENT if entry.sha256 in settings else HistoryStatus.REPLACED
        if entry.what == "revocation" or entry.serial in revoked or entry.sha256 in revoked_files:
            return HistoryStatus.REVOKED
        if entry.sha256 in retired and entry.sha256 not in issued:
            return HistoryStatus.RETIRED
        if entry.not_after and entry.not_after < moment:
            return HistoryStatus.EXPIRED
        return HistoryStatus.CURRENT if entry.sha256 in issued else HistoryStatus.SUPERSEDED

    known = {entry.sha256 for entry in entries}
    for role in ROLES:
        with suppress(SrosError):  # the CAs in an unreadable file are not known
            known |= known_authorities(keystore, role) or set()
    present_files = {**retired, **revoked_files, **issued}
    places = {**present_files, **settings}
    return History(
        keystore.root,
        tuple(
            HistoryItem(entry, status(entry), (places.get(entry.sha256) or [""])[0])
            for entry in entries
        ),
        tuple(
            sorted(
                path
                for digest, paths in present_files.items()
                if digest not in known
                for path in paths
            )
        ),
        ledger.gaps,
    )


def _active_paths(keystore: OpenedKeystore) -> Iterator[str]:
    """Yield where DDS loads certificates and signed documents from; some files may be missing."""
    authorities = sorted((keystore.root / PUBLIC).glob("*.cert.pem"))
    yield from (f"{PUBLIC}/{path.name}" for path in authorities)
    yield from (GOVERNANCE_P7S, CRL)
    for name in list_enclaves(keystore.root):
        yield from (f"{enclave_folder(name)}/{file}" for file in _ISSUED_FILES)


def _revoked_paths(keystore: OpenedKeystore) -> Iterator[str]:
    for path in revoked_certificates(keystore.root):
        yield from (f"{REVOKED}/{path.parent.name}/{file}" for file in _ISSUED_FILES)


def _retired_paths(keystore: OpenedKeystore) -> Iterator[str]:
    authorities = sorted((keystore.root / RETIRED).glob("*.cert.pem"))
    yield from (f"{RETIRED}/{path.name}" for path in authorities)


def _paths_by_digest(keystore: OpenedKeystore, paths: Iterator[str]) -> dict[str, list[str]]:
    """Map the digests that the ledger uses to the ``paths`` of files with this digest."""
    paths_by_digest: dict[str, list[str]] = {}
    for path in paths:
        file = keystore.root / path
        if file.is_file() and not file.is_symlink():
            for digest in _ledger_digests(file):
                paths_by_digest.setdefault(digest, []).append(path)
    return paths_by_digest


def _ledger_digests(path: Path) -> list[str]:
    """Return the digests that the ledger uses for a file: several for a CA file of several CAs.

    The digest of a certificate is the SHA-256 of its DER; for other files, it is the SHA-256 of the
    bytes.
    """
    data = read_bytes(path, "file")
    if not path.name.endswith("cert.pem"):
        return [hashlib.sha256(data).hexdigest()]
    digests = []
    for part in _PEM_BLOCK.finditer(data):
        content = part[0]
        if part[1] == b"CERTIFICATE":
            try:
                content = binascii.a2b_base64(part[2])
            except binascii.Error:
                return ["unreadable"]
        digests.append(hashlib.sha256(content).hexdigest())
    return digests or ["unreadable"]
