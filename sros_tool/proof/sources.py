"""Read the access of one side of a comparison.

A side is a policy, keystore, permissions, a Zenoh configuration, or policies at a git
revision.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime, timedelta
from functools import lru_cache
from pathlib import Path
from shlex import quote

from sros_tool.dds.domains import MAX_DOMAIN, DomainSet
from sros_tool.dds.governance import Governance, parse_governance
from sros_tool.dds.permissions import Permissions
from sros_tool.errors import DocumentError, Note, PkiError, SrosError
from sros_tool.fleet.expansion import FleetPolicy
from sros_tool.fleet.robots import Fleet
from sros_tool.keystore.layout import (
    CERTIFICATE_FILE,
    CRL,
    CRL_FILE,
    GOVERNANCE_FILE,
    GOVERNANCE_P7S,
    IDENTITY,
    IDENTITY_CA_FILE,
    PERMISSIONS_CA_FILE,
    PERMISSIONS_FILE,
    ROUTER_FILE,
    ZENOH_SIGNED,
    ca_certificate_path,
    enclave_names,
    enclave_path,
    has_zenoh_files,
    is_keystore,
    permissions_ca_for,
)
from sros_tool.keystore.reader import OpenedKeystore
from sros_tool.keystore.rights import RELAY, RightsSource, load_rights, load_zenoh_rights
from sros_tool.keystore.template import Template
from sros_tool.keystore.zenoh_files import is_signed
from sros_tool.pki import smime
from sros_tool.pki.certificates import (
    common_name,
    common_name_of,
    fingerprints,
    key_digest,
    load_certificate,
    load_certificates,
    subject_text,
)
from sros_tool.pki.crl import embedded_lists, load_crl, names_issuers, refusal_of, signed_by
from sros_tool.policy.document import (
    PolicyFiles,
    files_of_policies,
    join_policies,
    read_policy,
    refuse_fallbacks,
)
from sros_tool.policy.model import Enclave, Policy, Source, StatedProtection, stated_protections
from sros_tool.policy.rights import Right, placed_rights, policy_rights
from sros_tool.proof.commit_files import PREFIX, PathAtRevision, find_path_at_revision
from sros_tool.proof.zenoh_settings import LONE, SIGNED, SignedConfiguration
from sros_tool.translate import permissions_for
from sros_tool.validity import iso, window
from sros_tool.xml import read_bytes
from sros_tool.zenoh.access import Enforcement
from sros_tool.zenoh.document import ConfigurationDocument

UNCERTAIN = {
    "rights.partitions",
    RELAY,
    "rights.zenoh-open",
    "rights.zenoh-conditions",
    "rights.zenoh-nameless",
    "rights.zenoh-namespace",
    "rights.zenoh-no-name",
    "rights.zenoh-strangers",
}
"""Ids of notes which say that rights are not fully known, so that access may be new."""


KEYSTORE_ITSELF = "the keystore"
"""Name that stands for the CA and revocation list that later enclaves will get."""


@dataclass(frozen=True, slots=True)
class Trust:
    """The identity CAs that an enclave trusts, and the revoked certificates of these CAs.

    A CA is given by the SHA-256 of its public key; ``revoked`` has pairs of a CA and a serial
    number.
    """

    authorities: frozenset[str]
    revoked: frozenset[tuple[str, int]]


@dataclass(frozen=True, slots=True)
class CertifiedEnclave:
    """The subject, common name and key digest of an enclave's certificate."""

    subject: str
    name: str
    key: str


@dataclass(frozen=True, slots=True)
class AccessSource:
    """The access that a file, a folder or a revision gives to enclaves.

    ``kind`` is "policy", "permissions", "enclave", "keystore" or "zenoh"; ``shown`` is the name of
    the source in texts. ``permissions`` are what DDS loads for each enclave, or would load after
    signing.  ``rights`` are the rights in ROS terms.  ``zenoh`` are the rights that Zenoh rules
    give, None without rules.  If there are no permissions, ``key_domains`` maps these rights to the
    ROS domains in their keys; None stands for a wildcard. ``enforcers`` are the Zenoh rules,
    ``routers`` the enclaves of routers. ``passing`` maps each of several routers to the rights that
    the router gives to the other routers. ``scope`` are the enclaves that the source is for; None
    for all.  ``governance`` is None for a source without governance. ``authorities`` are the CAs
    that the enclaves trust, as pairs of role and fingerprint. ``trusts`` maps enclaves and
    `KEYSTORE_ITSELF` to their trust; None if trust is not known. ``later`` are the settings for
    enclaves that are created later, or None. ``certified`` has the facts about the certificates of
    enclaves.  ``zenoh_files`` are the Zenoh configurations, by enclave and file name.
    """

    shown: str
    kind: str
    rights: frozenset[Right]
    permissions: Mapping[str, Permissions]
    zenoh: frozenset[Right] | None = None
    key_domains: Mapping[Right, frozenset[int | None]] = field(default_factory=dict)
    enforcers: tuple[Enforcement, ...] = ()
    routers: tuple[str, ...] = ()
    passing: Mapping[str, frozenset[Right]] = field(default_factory=dict)
    governance: Governance | None = None
    authorities: frozenset[tuple[str, str]] | None = None
    trusts: Mapping[str, Trust] | None = None
    later: Template | None = None
    certified: Mapping[str, CertifiedEnclave] = field(default_factory=dict)
    zenoh_files: Mapping[str, SignedConfiguration] = field(default_factory=dict)
    scope: frozenset[str] | None = None
    notes: tuple[Note, ...] = ()
    fleet: Fleet | None = None
    protections: tuple[StatedProtection, ...] | None = None
    enclaves: Mapping[str, Enclave] = field(default_factory=dict)
    path_at_revision: PathAtRevision | None = None

    @property
    def policy(self) -> Policy:
        """All enclaves as one policy; without any if the source is not a policy."""
        return Policy(tuple(self.enclaves.values()))

    def subject_of(self, enclave: str) -> str:
        """Return the subject of an enclave's certificate, or else of its grant, or ""."""
        if certified := self.certified.get(enclave):
            return certified.subject
        known = self.permissions.get(enclave)
        return next((grant.subject for grant in known.grants), "") if known else ""

    def as_rights(self) -> RightsSource:
        """Return the rights that a policy gives, even if the signed documents differ."""
        return RightsSource(
            Path(self.shown),
            self.kind,
            self.rights,
            self.scope,
            sound=True,
            notes=self.notes,
            fleet=self.fleet,
            protections=self.protections,
            policy=self.policy,
        )

    def sources_of(self, enclave: str) -> dict[Right, Source]:
        """Map the rights of an enclave to file and line; empty without a policy."""
        sources: dict[Right, Source] = {}
        stated = self.enclaves.get(enclave)
        for placed in placed_rights(stated) if stated else ():
            sources.setdefault(placed.right, self.shown_source(placed.source))
        return sources

    def shown_source(self, source: Source) -> Source:
        """Return a source of this side in the form that users write."""
        return self.path_at_revision.source(source) if self.path_at_revision else source


ALL_DOMAINS = DomainSet.of((0, MAX_DOMAIN))
"""The domains for which the permissions of a policy are compared."""


def load_side(path: Path, fleet: Fleet | None = None) -> AccessSource:
    """Read one side of a comparison.

    ``path`` is a file or folder that `load_rights` reads, a folder of policies, or
    ``git:REVISION:PATH``.

    Raises:
        SrosError: the side cannot be read, DDS would refuse a part of it, or a part cannot be
            compared.
    """
    if str(path).startswith(PREFIX):
        return _access_at_revision(find_path_at_revision(str(path)), fleet)
    if path.is_dir() and not is_keystore(path) and not (path / PERMISSIONS_FILE).exists():
        files = list(files_of_policies(path))
        if files:
            return _access_of_policies(
                str(path), [_read_policy_and_fleet(file, fleet) for file in files]
            )
    source = load_rights(path, fleet, hidden=True)
    for note in source.notes:
        if not source.sound or note.id in UNCERTAIN:
            raise DocumentError(
                f"'{path}' cannot be compared: {note.text.rstrip('.')}",
                "The rights that it gives are not certain.",
                f"`sros check {quote(str(path))}` shows what is wrong with it.",
            )
    if source.kind == "policy":
        return _access_of_policies(str(path), [_read_policy_and_fleet(path, fleet)])
    return _access_of_source(path, source)


def _access_of_source(path: Path, source: RightsSource) -> AccessSource:
    side = AccessSource(
        str(path),
        source.kind,
        source.rights,
        {name: _without_dates(permissions) for name, permissions in source.documents.items()},
        scope=source.scope,
        notes=source.notes,
        fleet=source.fleet,
    )
    for enclave, permissions in source.documents.items():
        if len(permissions.grants) > 1:
            raise DocumentError(
                f"the permissions of {enclave} in '{path}' have several grants",
                "Vendors differ in which grant they use.",
                "Sign permissions with one grant for each enclave.",
            )
    if source.kind == "zenoh":
        (document,) = source.configurations.values()
        zenoh_files_here = {LONE: _zenoh_file(path, document)}
        # A Zenoh configuration gives nothing to enclaves that its rules do not name.
        return replace(
            side,
            zenoh=source.rights,
            key_domains=source.key_domains,
            enforcers=source.enforcers,
            zenoh_files=zenoh_files_here,
            scope=None,
        )
    if source.kind == "enclave":
        has_one = (path / GOVERNANCE_FILE).exists()
        governance = _read_governance(path / GOVERNANCE_FILE) if has_one else None
        files = path / IDENTITY_CA_FILE, path / CRL_FILE
        trusts = _trust_by_enclave(dict.fromkeys(source.scope or (), files), {})
        certified = _certified_enclaves(dict.fromkeys(source.scope or (), path))
        return replace(
            side,
            governance=governance,
            authorities=_authorities([path]),
            trusts=trusts,
            certified=certified,
        )
    if source.kind != "keystore":
        return side
    keystore = OpenedKeystore(path)
    folders = {name: enclave_path(path, name) for name in enclave_names(path, hidden=True)}
    trusting = {
        name: (folder / IDENTITY_CA_FILE, folder / CRL_FILE) for name, folder in folders.items()
    } | {KEYSTORE_ITSELF: (path / ca_certificate_path(IDENTITY), path / CRL)}
    if keystore.has_all_enclaves:
        governance = _common_governance(path, folders.values())
    else:
        governance = _exported_governance(path, folders.values())
    side = replace(
        side,
        governance=governance,
        authorities=_authorities(folders.values()),
        trusts=_trust_by_enclave(trusting, _expiries(path)),
        later=keystore.template if keystore.has_all_enclaves else None,
        certified=_certified_enclaves(folders),
    )
    if not has_zenoh_files(path, hidden=True):
        return side
    with_router = any((folder / ROUTER_FILE).is_file() for folder in folders.values())
    if not (with_router or keystore.has_all_enclaves):
        folder = next(iter(folders.values()))
        raise DocumentError(
            f"'{path}' cannot be compared: it has Zenoh files, but not {ROUTER_FILE}",
            "Only the file of the router shows which rights Zenoh enforces.",
            "Compare the original keystore, or only the permissions of an enclave, such "
            f"as '{folder}'.",
        )
    rights_source = load_zenoh_rights(keystore, hidden=True)
    for note in rights_source.notes:
        if note.id in UNCERTAIN:
            raise DocumentError(f"'{path}' cannot be compared: {note.text.rstrip('.')}")
    names = {folder: name for name, folder in folders.items()}
    configurations = {
        f"{names[file.parent]} {file.name}": _zenoh_file(file, document)
        for file, document in rights_source.configurations.items()
    }
    passing = rights_source.links.passing if rights_source.links else {}
    return replace(
        side,
        zenoh=rights_source.rights,
        enforcers=rights_source.enforcers,
        routers=rights_source.routers,
        passing={router: frozenset(rights) for router, rights in passing.items()},
        zenoh_files=configurations,
    )


def _certified_enclaves(folders: Mapping[str, Path]) -> dict[str, CertifiedEnclave]:
    """Map the enclaves that have a certificate to its subject, common name and key digest."""
    certified = {}
    for name, folder in folders.items():
        if (file := folder / CERTIFICATE_FILE).exists():
            certificate = load_certificate(read_bytes(file, "certificate"), f"'{file}'")
            key = key_digest(certificate.public_key())  # type: ignore[arg-type]
            subject = certificate.subject
            certified[name] = CertifiedEnclave(subject_text(subject), common_name_of(subject), key)
    return certified


def _zenoh_file(path: Path, document: ConfigurationDocument) -> SignedConfiguration:
    """Return a Zenoh configuration with the state of the signature next to it."""
    signed = ZENOH_SIGNED.get(path.name)
    authority = permissions_ca_for(path)
    if signed is None or not os.path.lexists(path.with_name(signed)):
        return SignedConfiguration(document, "missing")
    if authority is None:
        return SignedConfiguration(document, "not verified")
    certificate = load_certificate(read_bytes(authority, "certificate"), f"'{authority}'")
    data = read_bytes(path, "Zenoh configuration")
    return SignedConfiguration(document, SIGNED if is_signed(path, data, certificate) else "broken")


def _common_governance(root: Path, folders: Iterable[Path]) -> Governance:
    """Return the governance of a keystore, after a check that all enclaves have it.

    Raises:
        DocumentError: an enclave has another governance, such as an earlier one with less
            protection.
    """
    governance = OpenedKeystore(root).governance
    wanted = _signed_text(read_bytes(root / GOVERNANCE_P7S, "governance document"))
    known: set[bytes] = set()
    for folder in folders:
        file = folder / GOVERNANCE_FILE
        data = read_bytes(file, "governance document") if file.exists() else b""
        if not data or data in known:
            continue
        if _signed_text(data) != wanted:
            raise DocumentError(
                f"'{root}' cannot be compared: '{file}' is not the governance of the keystore",
                "It is not certain which protection applies to the enclave and its peers.",
                f"`sros check {quote(str(root))}` shows what is wrong with it.",
            )
        known.add(data)
    return governance


def _signed_text(message: bytes) -> bytes | None:
    """Return the document in a signed message, without verification; None for other messages."""
    try:
        return smime.parse(message).document
    except PkiError:
        return None


def _exported_governance(root: Path, folders: Iterable[Path]) -> Governance:
    """Return the governance of an export's enclaves, after verifying the document of each enclave.

    Raises:
        DocumentError: enclaves have different governances, or an enclave lacks a file that every
            node needs to start.
    """
    enclaves: dict[Governance, Path] = {}
    for folder in folders:
        for file in (IDENTITY_CA_FILE, PERMISSIONS_CA_FILE, CERTIFICATE_FILE):
            if not (folder / file).exists():
                raise DocumentError(
                    f"'{root}' cannot be compared: '{folder}' has no {file}",
                    "No node starts in this enclave.",
                    "Export the enclave again.",
                )
        enclaves.setdefault(_read_governance(folder / GOVERNANCE_FILE), folder)
    if len(enclaves) > 1:
        first, second, *_ = enclaves.values()
        raise DocumentError(
            f"'{root}' cannot be compared: '{first}' and '{second}' have different governance "
            "documents",
            "Nodes of these enclaves protect messages differently.",
            "Export both enclaves again.",
        )
    return next(iter(enclaves))


def _authorities(folders: Iterable[Path]) -> frozenset[tuple[str, str]]:
    """Return pairs of role and fingerprint of the CAs that the enclaves in folders trust."""
    authorities = {
        (role, read_bytes(folder / file, "certificate"))
        for folder in folders
        for role, file in (("identity", IDENTITY_CA_FILE), ("permissions", PERMISSIONS_CA_FILE))
        if (folder / file).exists()
    }
    return frozenset(
        (role, fingerprint) for role, pem in authorities for fingerprint in fingerprints(pem)
    )


_NEVER_EXPIRES = "9999"


def _expiries(root: Path) -> dict[int, str]:
    """Map serial numbers of certificates to expiries, by the ledger of the keystore."""
    if not (root / CRL).exists():
        return {}
    expiries: dict[int, str] = {}
    for entry in OpenedKeystore(root).ledger_with("what", "certificate").entries:
        with suppress(ValueError):
            serial = int(entry.serial, 16)
            expiries[serial] = max(expiries.get(serial, ""), entry.not_after or _NEVER_EXPIRES)
    return expiries


def _trust_by_enclave(
    files: Mapping[str, tuple[Path, Path]], expiries: Mapping[int, str]
) -> dict[str, Trust]:
    """Map enclaves to the CAs that they trust and the certificates that they refuse.

    Enclaves without a CA file are left out.  Certificates that had expired when a list was signed
    are ignored: lists may leave them out.

    Raises:
        DocumentError: a list is damaged, is of no CA that the enclave trusts, does not cover all
            certificates, or has entries that vendors may ignore; or there are several lists of a
            CA, so that it is uncertain which of them OpenSSL takes.
    """

    @lru_cache(maxsize=8)  # most enclaves have the same files, so this is cached
    def trust(pem: bytes, own_list: bytes | None) -> Trust:
        """Return the trust by the content of a CA file and of the revocation list next to it."""
        authorities = load_certificates(pem, IDENTITY_CA_FILE)
        keys = [(authority, key_digest(authority.public_key())) for authority in authorities]  # type: ignore[arg-type]
        revoked = set()
        lists: dict[str, bytes] = {}
        for data in dict.fromkeys(([] if own_list is None else [own_list]) + embedded_lists(pem)):
            crl = load_crl(data, CRL_FILE)
            key = next((key for certificate, key in keys if signed_by(crl.list, certificate)), "")
            if refusal := refusal_of(crl.list) or ("" if key else "another CA signed it"):
                raise DocumentError(
                    f"its revocation list makes DDS refuse every enclave: {refusal}"
                )
            if len(crl.revoked) < len(crl.list) or names_issuers(crl.list):
                raise DocumentError("its revocation list has entries that vendors may ignore")
            if lists.setdefault(key, crl.list.signature) != crl.list.signature:
                raise DocumentError(
                    "it has several revocation lists of one CA, and DDS uses only one"
                )
            signed = iso(crl.this_update)
            revoked |= {
                (key, entry.serial)
                for entry in crl.revoked
                if expiries.get(entry.serial, signed) >= signed
            }
        return Trust(frozenset(key for _, key in keys), frozenset(revoked))

    trusts = {}
    for name, (authority, own) in files.items():
        if authority.exists():
            pem = read_bytes(authority, "certificate")
            try:
                listed = read_bytes(own, "revocation list") if os.path.lexists(own) else None
                trusts[name] = trust(pem, listed)
            except SrosError as error:
                raise DocumentError(
                    f"'{authority.parent}' cannot be compared: {error.what}",
                    "It is not certain which certificates are refused there.",
                    error.remedy,
                ) from error
    return trusts


def _read_governance(file: Path) -> Governance:
    data = read_bytes(file, "governance document")
    try:
        signed = smime.parse(data)
        if authority := permissions_ca_for(file):
            signed.verify(load_certificate(read_bytes(authority, "certificate"), f"'{authority}'"))
    except PkiError as error:
        raise DocumentError(
            f"the governance document '{file}' cannot be used: {error.what}",
            error.why,
            error.remedy,
        ) from error
    return parse_governance(signed.document, f"'{file}'")


AT = datetime(2026, 1, 1, tzinfo=UTC)
"""The time for which permissions are compared; all permissions then count as valid."""
_ASSUMED_VALIDITY = window(AT - timedelta(days=2), timedelta(days=9))


def _without_dates(permissions: Permissions) -> Permissions:
    """Return permissions with dates that are valid at `AT`, because dates are not compared."""
    begin, end = iso(_ASSUMED_VALIDITY.not_before), iso(_ASSUMED_VALIDITY.not_after)
    return Permissions(
        tuple(grant._replace(not_before=begin, not_after=end) for grant in permissions.grants)
    )


def _access_at_revision(path_at_revision: PathAtRevision, fleet: Fleet | None) -> AccessSource:
    try:
        policies = [
            _read_policy_and_fleet(policy.place, fleet, policy.read)
            for policy in path_at_revision.policies()
        ]
        side = _access_of_policies(str(path_at_revision), policies)
    except SrosError as error:
        raise path_at_revision.error(error) from error
    return replace(side, path_at_revision=path_at_revision)


_PolicyAndFleet = tuple[Policy, Fleet | None]


def _read_policy_and_fleet(
    path: Path, fleet: Fleet | None, policy_files: PolicyFiles | None = None
) -> _PolicyAndFleet:
    """Return the policy in a file, and the fleet with its enclaves (None without a fleet)."""
    if fleet is None:
        return read_policy(path, policy_files=policy_files), None
    expanded = FleetPolicy(read_policy(path, placeholders=True, policy_files=policy_files), fleet)
    return expanded.policy(), fleet.with_enclaves(expanded.patterns)


def _access_of_policies(shown: str, policies: list[_PolicyAndFleet]) -> AccessSource:
    if not policies:
        raise DocumentError(f"'{shown}' has no policies", "", "Name a policy file.")
    policy = join_policies([policy for policy, _ in policies])
    refuse_fallbacks(policy)
    enclaves = {enclave.path: enclave for enclave in policy.enclaves}
    permissions = {
        path: permissions_for(
            enclave,
            subject=subject_text(common_name(path)),
            validity=_ASSUMED_VALIDITY,
            domains=ALL_DOMAINS,
        )
        for path, enclave in enclaves.items()
    }
    rights = frozenset(policy_rights(policy))
    stated = stated_protections(enclaves.values())
    fleets = [fleet for _, fleet in policies if fleet]
    patterns = dict.fromkeys(enclave for fleet in fleets for enclave in fleet.enclaves)
    fleet = fleets[0].with_enclaves(tuple(patterns)) if fleets else None
    return AccessSource(
        shown, "policy", rights, permissions, fleet=fleet, protections=stated, enclaves=enclaves
    )


def load_policies(files: Iterable[Path], shown: str, fleet: Fleet | None = None) -> AccessSource:
    """Return the joint access by the policies of one robot or fleet; texts name it ``shown``.

    Raises:
        SrosError: a policy cannot be read, or two policies have the same enclave.
    """
    return _access_of_policies(shown, [_read_policy_and_fleet(file, fleet) for file in files])
