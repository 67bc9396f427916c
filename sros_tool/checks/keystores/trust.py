"""Whether the enclaves of several keystores and exports trust each other."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from functools import lru_cache
from itertools import combinations, product

from cryptography import x509

from sros_tool.checks.kind import NOTE, Finding, FindingKind, some_names
from sros_tool.errors import SrosError
from sros_tool.keystore.layout import (
    CERTIFICATE_FILE,
    IDENTITY_CA_FILE,
    PERMISSIONS_CA_FILE,
    PERMISSIONS_FILE,
    ROLES,
)
from sros_tool.keystore.reader import Keystore
from sros_tool.pki import smime
from sros_tool.pki.certificates import issued_by, load_certificate, load_certificates

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

_Certificates = tuple[x509.Certificate, ...]
_Kind = tuple[tuple[_Certificates, ...], tuple[bool, ...], x509.Certificate | None]
"""The CAs that an enclave trusts, which of them issued its certificate, and who signed its
permissions."""


class _Party:
    """What an enclave trusts, and what it presents, of the identity and the permissions CA."""

    def __init__(self, certificate: x509.Certificate, trusted_cas: tuple[bytes, bytes]) -> None:
        self.certificate = certificate
        self.trusted = tuple(map(_certificates, trusted_cas))
        self.signer: x509.Certificate | None = None

    def accepts(self, other: _Party, role: int) -> bool:
        """Return whether a node of this enclave accepts the CA of the other one in this role."""
        shown = (other.certificate, other.signer)[role]
        return shown is not None and any(
            shown == authority or issued_by(shown, authority) for authority in self.trusted[role]
        )


@lru_cache(maxsize=64)
def _certificates(data: bytes) -> _Certificates:
    return load_certificates(data, "the certificate of a CA")


def stranger_findings(
    targets: Mapping[str, tuple[Keystore, Sequence[str]]], *, on_zenoh: bool = False
) -> Iterator[Finding]:
    """Yield findings about keystores and exports of which no two enclaves accept each other.

    In a rotation of CAs, enclaves trust the old and the new one.  What cannot be read is a finding
    of another check.

    Args:
        targets: maps what the user named to a keystore or export, and the enclaves in it.
        on_zenoh: whether all nodes use Zenoh, which reads no permissions.
    """
    read = {shown: dict(_parties(*target)) for shown, target in targets.items()}
    # Most exports trust and present the same as others: only one of each kind is compared.
    alike: dict[frozenset[_Kind], list[str]] = defaultdict(list)
    for shown, of_target in read.items():
        alike[frozenset(of_target)].append(shown)
    parties = {same[0]: list(read[same[0]].values()) for same in alike.values()}
    roles = range(1 if on_zenoh else len(ROLES))
    # What each target is apart from, and in which roles; targets with the same are one group.
    apart: dict[str, dict[str, tuple[int, ...]]] = {shown: {} for shown in parties}
    for one, other in combinations(parties, 2):
        if refused := _refused_roles(parties[one], parties[other], roles):
            apart[one][other] = apart[other][one] = refused
    groups: dict[tuple[tuple[str, tuple[int, ...]], ...], list[str]] = defaultdict(list)
    for same in alike.values():
        groups[tuple(apart[same[0]].items())] += same
    for some, others in combinations(groups.values(), 2):
        if refused := apart[some[0]].get(others[0], ()):
            authorities = " and ".join(f"{ROLES[role]} CA" for role in refused)
            text = (
                f"nodes of {some_names(some)} do not communicate with nodes of "
                f"{some_names(others)}: not both of them trust the other's {authorities}"
            )
            yield STRANGERS.found(others[0], text, others[0])


def _refused_roles(
    some: Sequence[_Party], others: Sequence[_Party], roles: range
) -> tuple[int, ...]:
    """Return the roles in which all pairs of enclaves refuse each other; () if one pair does not.

    It is () without a readable enclave, too.
    """
    pairs = (
        tuple(role for role in roles if not (one.accepts(other, role) and other.accepts(one, role)))
        for one, other in product(some, others)
    )
    return min(pairs, key=len, default=())


def _parties(keystore: Keystore, enclaves: Sequence[str]) -> Iterator[tuple[_Kind, _Party]]:
    """Yield one of all enclaves that trust and present the same CAs, by what these are."""
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
            issuers = tuple(issued_by(certificate, each) for each in party.trusted[0])
            message = keystore.read(folder / PERMISSIONS_FILE, "permissions document")
            # Which of several CAs signed them differs only in a rotation.
            if (shown := (party.trusted, issuers)) in seen and len(party.trusted[1]) == 1:
                continue
            seen.add(shown)
            party.signer = smime.parse(message).signer()
            yield (*shown, party.signer), party
