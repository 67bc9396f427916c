"""Checks whether the files of several keystores and exports let their nodes communicate."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from datetime import datetime
from functools import cached_property, lru_cache
from itertools import chain, combinations, product
from typing import NamedTuple

from cryptography import x509

from sros_tool.checks.kind import NOTE, WARNING, Finding, FindingKind, names_text
from sros_tool.dds.domains import DomainSet
from sros_tool.dds.governance import Governance, parse_governance
from sros_tool.errors import SrosError
from sros_tool.keystore.comparison import Mismatch, compare_governance, mismatch
from sros_tool.keystore.known_keys import known_expiries
from sros_tool.keystore.layout import (
    CERTIFICATE_FILE,
    CRL_FILE,
    GOVERNANCE_FILE,
    IDENTITY,
    IDENTITY_CA_FILE,
    PERMISSIONS_CA_FILE,
    PERMISSIONS_FILE,
    ROLES,
)
from sros_tool.keystore.reader import OpenedKeystore
from sros_tool.keystore.template import is_ca_service
from sros_tool.pki import smime
from sros_tool.pki.certificates import issued_by, load_certificate, load_certificates, pem
from sros_tool.pki.crl import Revocations, lists_as_revoked, newest_revocations, read_list
from sros_tool.pki.distinguished_names import same_name
from sros_tool.validity import iso
from sros_tool.wording import counted, first_few

STRANGERS = FindingKind(
    "keystore.strangers",
    NOTE,
    "keystores or exports whose nodes do not trust each other",
    "A node accepts only a peer whose certificate and permissions come from CAs that it trusts, "
    "and neither Fast DDS nor Cyclone DDS reports why a peer is refused.",
    "DDS-Security 1.1, 9.3 and 9.4; Fast DDS 2.9.1, Cyclone DDS 0.10.2; tested.",
    "If their nodes have to communicate, export all of their enclaves again from one keystore; if "
    "not, ignore this.",
    prominent=True,
)
PEERS_REVOKED = FindingKind(
    "keystore.peers-revoked",
    WARNING,
    "enclaves that the revocation list of another keystore or export revokes",
    "A node with this list refuses the nodes of the revoked enclaves. Fast DDS logs nothing about "
    "it, on either side.",
    "RFC 5280, 5; rmw_dds_common (crl.pem); Fast DDS 2.6 to 3.6; tested.",
    "If an enclave is meant to be revoked, remove its files. If not, export it again from its "
    "keystore, which may have a new certificate already. If the keystore has none, run `sros "
    "generate_artifacts -k KEYSTORE -e ENCLAVE -p POLICY_FILE`, and export the enclave again.",
)
PEERS_ACCEPT = FindingKind(
    "keystore.peers-accept-revoked",
    WARNING,
    "a revocation list that lacks certificates on the list of another keystore or export",
    "A node with this list still communicates with enclaves that only the other list revokes, for "
    "example with the thief of a key.",
    "RFC 5280, 5.2.3; rmw_dds_common (crl.pem).",
    "Export again the enclaves that have this list (`sros distribute_key KEYSTORE ENCLAVE "
    "TARGET --force` in their keystore), bring the files to the robot, and restart the "
    "processes.",
)
_REVOKE_AGAIN = (
    "This keystore was perhaps restored from a backup: before its next export, revoke the "
    "certificates on the other list again, with `sros crl KEYSTORE --refresh --crl FILE`. FILE is "
    "the other crl.pem."
)
_REVOKE_FIRST = (
    "The keystore was perhaps restored from a backup: the export's own list revokes certificates "
    "that the keystore's list does not revoke. Unless these have expired, first revoke them again "
    "in that keystore, with `sros crl KEYSTORE --refresh --crl FILE`. FILE is the export's "
    "crl.pem. "
    f"{PEERS_ACCEPT.remedy}"
)
PEERS_PROTECTION = FindingKind(
    "keystore.peers-protection",
    WARNING,
    "keystores or exports whose governance protects messages differently",
    "Both ends of a connection have to protect messages in the same way. Otherwise, nodes do "
    "not hear each other, and Fast DDS does not log why.",
    "DDS-Security 1.1, 9.4.1.2; Fast DDS 2.9.1 and 2.14.5, Cyclone DDS 0.10.2; tested.",
    "If one of the two is an earlier export, export its enclaves again, and restart the processes. "
    "Otherwise give both keystores the same protection (`sros inspect` shows it, `sros "
    "update_keystore --set` and `--rule` change it), and export the enclaves again.",
)
PEERS_DOMAINS = FindingKind(
    "keystore.peers-domains",
    NOTE,
    "keystores or exports for different ROS domains",
    "Nodes find each other only in the same ROS domain, and no node of one keystore or export "
    "may join a domain of the other one.",
    "DDS-Security 1.1, 9.4.1.2 and 9.4.1.3; tested.",
    "If their nodes have to communicate, name a common domain with `sros update_keystore KEYSTORE "
    "--domain IDS --allow-looser`, and export the enclaves again; if not, ignore this.",
    prominent=True,
)

_Certificates = tuple[x509.Certificate, ...]
_TrustKey = tuple[tuple[_Certificates, ...], tuple[bool, ...], x509.Certificate | None]
"""The trusted CAs of an enclave, which of them issued its certificate, and its permissions' signer.
"""


class _Party:
    """The CAs that an enclave trusts, its certificate, and the signer of its permissions."""

    def __init__(self, certificate: x509.Certificate, trusted_cas: tuple[bytes, bytes]) -> None:
        self.certificate = certificate
        self.trusted = tuple(map(_certificates, trusted_cas))
        self.signer: x509.Certificate | None = None

    def accepts(self, other: _Party, role: int) -> bool:
        """Return whether a node of this enclave accepts the other enclave's CA.

        ``role`` is the index in `ROLES` of the CA's role.
        """
        shown = (other.certificate, other.signer)[role]
        return shown is not None and any(
            shown == authority or issued_by(shown, authority) for authority in self.trusted[role]
        )


@lru_cache(maxsize=64)
def _certificates(data: bytes) -> _Certificates:
    return load_certificates(data, "the certificate of a CA")


Targets = Mapping[str, tuple[OpenedKeystore, Sequence[str]]]
"""Maps each path, as the user wrote it, to its keystore or export and the enclaves in it."""


def findings_between(
    targets: Targets, *, now: datetime, on_zenoh: bool = False
) -> Iterator[Finding]:
    """Yield findings about keystores and exports whose nodes do not communicate with each other.

    Other checks report unreadable files, and files that are not valid ``now``.  If the files of two
    enclaves are never valid at the same time, other checks report at least one of the two enclaves
    at any moment.

    Args:
        targets: the keystores and exports, as the user named them.
        now: the moment to check for.
        on_zenoh: whether all nodes use Zenoh, which reads neither permissions nor governance, and
            no revocation list.
    """
    refused: set[frozenset[str]] = set()
    yield from _stranger_findings(targets, refused, on_zenoh=on_zenoh)
    if not on_zenoh:
        yield from _revoked_findings(targets)
        yield from _earlier_list_findings(targets, now)
        governed = {shown: _TargetGovernance(*target, now) for shown, target in targets.items()}
        yield from _incompatible_governance_findings(governed, refused)


# ── CAs ────────────────────────────────────────────────────────────────────────────────────


def _stranger_findings(
    targets: Targets, refused_pairs: set[frozenset[str]], *, on_zenoh: bool
) -> Iterator[Finding]:
    """Yield findings about two keystores or exports whose enclaves all refuse each other.

    In a rotation of CAs, enclaves trust the old CA and the new one.  Pairs with a finding are added
    to ``refused_pairs``.
    """
    read = {shown: dict(_parties(*target)) for shown, target in targets.items()}
    # Most exports trust and present the same CAs as others: only one of each kind is compared.
    names_by_kinds: dict[frozenset[_TrustKey], list[str]] = defaultdict(list)
    for shown, of_target in read.items():
        names_by_kinds[frozenset(of_target)].append(shown)
    parties = {
        targets_alike[0]: list(read[targets_alike[0]].values())
        for targets_alike in names_by_kinds.values()
    }
    roles = range(1 if on_zenoh else len(ROLES))
    # Maps each target to the targets that refuse it, with the roles; equal entries form a group.
    refused_by: dict[str, dict[str, tuple[int, ...]]] = {shown: {} for shown in parties}
    for first_target, other in combinations(parties, 2):
        if refused := _refused_roles(parties[first_target], parties[other], roles):
            refused_by[first_target][other] = refused_by[other][first_target] = refused
    groups: dict[tuple[tuple[str, tuple[int, ...]], ...], list[str]] = defaultdict(list)
    for targets_alike in names_by_kinds.values():
        groups[tuple(refused_by[targets_alike[0]].items())] += targets_alike
    for group, other_group in combinations(groups.values(), 2):
        if refused := refused_by[group[0]].get(other_group[0], ()):
            authorities = " and ".join(f"{ROLES[role]} CA" for role in refused)
            text = (
                f"nodes of {names_text(group)} do not communicate with nodes of "
                f"{names_text(other_group)}: one side does not trust the other's {authorities}"
            )
            yield STRANGERS.found(other_group[0], text, other_group[0])
            refused_pairs.update(map(frozenset, product(group, other_group)))


def _refused_roles(
    parties: Sequence[_Party], other_parties: Sequence[_Party], roles: range
) -> tuple[int, ...]:
    """Return the roles of the CAs because of which the enclaves of two groups refuse each other.

    Of all pairs with one enclave of each group, the pair with the fewest refused roles decides. The
    result is () if the enclaves of a pair accept each other, or if no enclave can be read.
    """
    pairs = (
        tuple(
            role
            for role in roles
            if not (party.accepts(other, role) and other.accepts(party, role))
        )
        for party, other in product(parties, other_parties)
    )
    return min(pairs, key=len, default=())


def _parties(
    keystore: OpenedKeystore, enclaves: Sequence[str]
) -> Iterator[tuple[_TrustKey, _Party]]:
    """Yield a `_Party` for each different set of CAs that enclaves trust and present."""
    seen = set()
    for name in enclaves:
        folder = keystore.folder(name)
        with suppress(SrosError, ValueError):
            certificate = load_certificate(
                keystore.read(folder / CERTIFICATE_FILE, "certificate"), name
            )
            trusted = (
                keystore.read(folder / IDENTITY_CA_FILE, "CA certificate"),
                keystore.read(folder / PERMISSIONS_CA_FILE, "CA certificate"),
            )
            party = _Party(certificate, trusted)
            issuers = tuple(issued_by(certificate, authority) for authority in party.trusted[0])
            message = keystore.read(folder / PERMISSIONS_FILE, "permissions document")
            # Only in a rotation can enclaves that trust the same CAs have another issuer or signer.
            if (shown := (party.trusted, issuers)) in seen and len(party.trusted[1]) == 1:
                continue
            seen.add(shown)
            party.signer = smime.parse(message).signer()
            yield (*shown, party.signer), party


# ── revocation lists ───────────────────────────────────────────────────────────────────────


def _revoked_findings(targets: Targets) -> Iterator[Finding]:
    """Yield findings about enclaves that the revocation lists of other targets revoke."""
    holders: dict[bytes, dict[str, None]] = defaultdict(dict)
    for shown, (keystore, enclaves) in targets.items():
        for name in enclaves:
            with suppress(SrosError):
                data = keystore.read(keystore.folder(name) / CRL_FILE, "revocation list")
                holders[data][shown] = None
    revocations: dict[tuple[str, tuple[str, ...]], dict[str, None]] = defaultdict(dict)
    for data, of_list in holders.items():
        for shown, target in targets.items():
            if shown not in of_list and (names := tuple(revoked_enclaves(data, *target))):
                revocations[shown, names].update(of_list)
    for (shown, names), of_lists in revocations.items():
        text = (
            f"nodes of {names_text(list(of_lists))} refuse nodes of {shown} in "
            f"{names_text(names)}: the revocation list of {names_text(list(of_lists))} revokes "
            f"{'the certificate' if len(names) == 1 else 'the certificates'}"
        )
        yield PEERS_REVOKED.found(shown, text, shown)


def revoked_enclaves(
    list_data: bytes, keystore: OpenedKeystore, enclaves: Sequence[str]
) -> Iterator[str]:
    """Yield those of ``enclaves`` whose certificates a revocation list revokes."""
    with suppress(SrosError):
        revocation_list = read_list(list_data, CRL_FILE)
        for name in enclaves:
            with suppress(SrosError, ValueError):
                certificate = keystore.certificate(keystore.folder(name) / CERTIFICATE_FILE)
                if same_name(revocation_list.issuer, certificate.issuer) and lists_as_revoked(
                    revocation_list, certificate.serial_number
                ):
                    yield name


def _earlier_list_findings(targets: Targets, now: datetime) -> Iterator[Finding]:
    """Yield findings about targets that accept certificates which another target's list revokes.

    A later list may lack certificates that have expired. The ledger of a keystore shows which
    certificates have expired; without a keystore among the targets, every missing certificate
    counts as expired.
    """
    holders: dict[tuple[_Certificates, bytes, bytes], dict[str, None]] = defaultdict(dict)
    for shown, (keystore, enclaves) in targets.items():
        for name in enclaves:
            folder = keystore.folder(name)
            with suppress(SrosError, ValueError, OSError):
                trusted = keystore.read(folder / IDENTITY_CA_FILE, "CA certificate")
                listed = b""
                if (folder / CRL_FILE).exists():
                    listed = keystore.read(folder / CRL_FILE, "revocation list")
                # In a rotation, the file of the identity CAs also contains a revocation list.
                holders[_certificates(trusted), trusted, listed][shown] = None
    found: dict[tuple[str, str], str] = {}
    for (authorities, *own_files), earlier in holders.items():
        for authority in authorities:
            signer = pem(authority)
            own = newest_revocations(signer, *own_files)
            of_list: dict[Revocations, list[str]] = defaultdict(list)
            for (_, *files), names in holders.items():
                of_list[newest_revocations(signer, *files)] += names
            newest = max(other.number for other in of_list)
            said = own.serials.union(*(e.serials for e in of_list if e.number == newest))
            # If a keystore was restored from a backup, several lists may have the same number.
            for other, holding in sorted(of_list.items(), key=lambda held: -held[0].number):
                lacking = other.serials - own.serials
                if other.number < newest:
                    lacking = _unexpired_serials(lacking - said, authority, targets, now)
                    said |= lacking
                if not lacking:
                    continue
                text = (
                    f"accept {counted(len(lacking), 'certificate')} that the "
                    f"{'newer ' * (other.number > own.number)}revocation list of "
                    f"{names_text(holding)} revokes"
                )
                remedy = _REVOKE_FIRST if own.serials - other.serials else ""
                found |= {(e, f"nodes of {e} {text}"): remedy for e in earlier if e not in holding}
    for (shown, text), of_export in found.items():
        remedy = _REVOKE_AGAIN if targets[shown][0].is_original else of_export
        yield PEERS_ACCEPT.found(shown, text, shown, remedy=remedy)


def _unexpired_serials(
    serials: frozenset[int], authority: x509.Certificate, targets: Targets, now: datetime
) -> frozenset[int]:
    """Return the serial numbers of certificates that have not expired, by the ledgers of their CA.

    Empty if no keystore of the CA ``authority`` is a target, or if the CA is a service, which also
    issues certificates that no ledger has.
    """
    may_be_expired = True
    for keystore, _ in targets.values() if serials else ():
        with suppress(SrosError):
            if not keystore.is_original or authority not in keystore.authority(IDENTITY):
                continue
            if is_ca_service(keystore.template.identity_key):
                return frozenset()
            expiries = known_expiries(keystore, serials)
            serials = frozenset(s for s in serials if expiries.get(s, iso(now)) >= iso(now))
            may_be_expired = False
    return frozenset() if may_be_expired else serials


# ── governance and domains ─────────────────────────────────────────────────────────────────


class _TargetGovernance:
    """The governance documents of a target, and the domains that its enclaves may join."""

    def __init__(self, keystore: OpenedKeystore, enclaves: Sequence[str], now: datetime) -> None:
        self._keystore = keystore
        self._enclaves = enclaves
        self._now = now

    @cached_property
    def documents(self) -> tuple[Governance, ...]:
        """The different governance documents of the enclaves."""
        signed: dict[bytes, None] = {}
        for name in self._enclaves:
            with suppress(SrosError):
                file = self._keystore.folder(name) / GOVERNANCE_FILE
                signed[self._keystore.read(file, "governance document")] = None
        documents = []
        for message in signed:
            with suppress(SrosError):
                documents.append(
                    parse_governance(self._keystore.files.signed_document(message).document)
                )
        return tuple(documents)

    @cached_property
    def first_domains(self) -> tuple[DomainSet, ...]:
        """The domains of the first enclave."""
        return self._domains(self._enclaves[:1])

    @cached_property
    def domains(self) -> tuple[DomainSet, ...]:
        """The different sets of domains of all enclaves; () if a set cannot be read."""
        return self._domains(self._enclaves)

    def _domains(self, enclaves: Sequence[str]) -> tuple[DomainSet, ...]:
        domain_sets: dict[DomainSet, None] = {}
        for name in enclaves:
            domains = None
            with suppress(SrosError):
                domains = self._keystore.enclave(name, now=self._now).joined_domains()
            if domains is None:
                return ()
            domain_sets[domains] = None
        return tuple(domain_sets)

    def joined_by_any(self) -> Iterator[int]:
        """Yield the domains that at least one enclave may join."""
        return chain.from_iterable(self.domains)

    def overlaps(self, other: _TargetGovernance) -> bool:
        """Return whether enclaves of both targets may join a common domain; True if not known."""
        return _domains_meet(self.first_domains, other.first_domains) or _domains_meet(
            self.domains, other.domains
        )


def _domains_meet(domain_sets: Sequence[DomainSet], other_sets: Sequence[DomainSet]) -> bool:
    pairs = list(product(domain_sets, other_sets))
    return not pairs or any((domains & other).ranges for domains, other in pairs)


class _Incompatibility(NamedTuple):
    """The reason that two targets do not communicate.

    ``names`` are the names that cannot be used between the targets; () for all names.
    ``differences`` are settings with both values; () if only the domains differ.
    """

    kind: FindingKind
    names: tuple[str, ...] = ()
    differences: tuple[tuple[str, str, str], ...] = ()


def _incompatible_governance_findings(
    governed: Mapping[str, _TargetGovernance], refused_pairs: set[frozenset[str]]
) -> Iterator[Finding]:
    """Yield findings about targets that trust each other, and differ in governance or domains."""
    groups: dict[tuple[_Incompatibility, tuple[str, ...]], list[str]] = defaultdict(list)
    shown_before: list[str] = []
    for shown, own_side in governed.items():
        names_by_incompatibility: dict[_Incompatibility, list[str]] = defaultdict(list)
        for other_shown in shown_before:
            if frozenset((shown, other_shown)) not in refused_pairs and (
                incompatibility := _incompatibility_of(own_side, governed[other_shown])
            ):
                names_by_incompatibility[incompatibility].append(other_shown)
        for incompatibility, others in names_by_incompatibility.items():
            groups[incompatibility, tuple(others)].append(shown)
        shown_before.append(shown)
    for (incompatibility, incompatible_names), alike_names in groups.items():
        on = f" on {first_few(incompatibility.names, _MOST_SHOWN)}" if incompatibility.names else ""
        why = first_few(
            [
                f"{key}: {own_value} in {alike_names[0]}, {value} in {incompatible_names[0]}"
                for key, own_value, value in incompatibility.differences
            ],
            _MOST_SHOWN,
        )
        if incompatibility.kind is PEERS_DOMAINS:
            own_domains, domains = (
                DomainSet.of(*((d, d) for name in names for d in governed[name].joined_by_any()))
                for names in (alike_names, incompatible_names)
            )
            why = f"the first side is for domain {own_domains}, the second for domain {domains}"
        text = (
            f"nodes of {names_text(alike_names)} do not communicate with "
            f"nodes of {names_text(incompatible_names)}{on}: {why}"
        )
        yield incompatibility.kind.found(alike_names[0], text, alike_names[0])


def _incompatibility_of(
    own_side: _TargetGovernance, other_side: _TargetGovernance
) -> _Incompatibility | None:
    if not own_side.overlaps(other_side):
        return _Incompatibility(PEERS_DOMAINS)
    different = [
        _differences_between(*pair) for pair in product(own_side.documents, other_side.documents)
    ]
    if not different or not all(disturbed for disturbed, _ in different):
        return None
    disturbed, values = min(
        different,
        key=lambda disturbed_and_values: (
            disturbed_and_values[0].everything,
            len(disturbed_and_values[0].names),
        ),
    )
    return _Incompatibility(
        PEERS_PROTECTION, () if disturbed.everything else disturbed.names, values
    )


_MOST_SHOWN = 3


@lru_cache(maxsize=256)
def _differences_between(
    own_governance: Governance, other: Governance
) -> tuple[Mismatch, tuple[tuple[str, str, str], ...]]:
    """Return the communication that differences of two documents prevent, and these differences.

    A difference has the name of the setting, the own value and the other value.
    """
    disturbed = mismatch(other, own_governance)
    if not disturbed:
        return disturbed, ()
    values = {
        change.key: (change.key, change.after, change.before)
        for change in compare_governance(other, own_governance)
        if change.key.startswith("protection") and not change.key.endswith(_HARMLESS_SETTINGS)
    }
    return disturbed, tuple(values.values())


_HARMLESS_SETTINGS = ("allow_unauthenticated_participants", "join_access_control")
"""Settings in which two ends may differ; see `Mismatch`."""
