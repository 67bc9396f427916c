"""The CAs of a keystore: their keys, their ends, what they may sign, and their revocation list."""

from __future__ import annotations

from collections.abc import Iterator
from datetime import timedelta

from cryptography import x509
from cryptography.hazmat.primitives import hashes

from sros_tool.checks.keystores.certificates import authority_findings
from sros_tool.checks.keystores.opened import OpenedKeystore
from sros_tool.checks.kind import ERROR, NOTE, WARNING, Finding, Kind, by_id
from sros_tool.errors import SrosError
from sros_tool.keystore.layout import (
    CRL,
    IDENTITY,
    PERMISSIONS,
    SETTINGS,
    ca_certificate,
    ca_key,
)
from sros_tool.keystore.ledger import LEDGER
from sros_tool.pki.certificates import same_key, subject_text, validity_of
from sros_tool.pki.crl import signed_by
from sros_tool.pki.keys import load_key
from sros_tool.validity import iso
from sros_tool.xml import read_bytes

UNREADABLE = Kind(
    "keystore.file-unreadable",
    ERROR,
    "a file of the keystore that cannot be read",
    "Verbs that need it fail.",
    "sros keystore layout.",
    "Restore it from a backup.",
)
ONE_AUTHORITY = Kind(
    "keystore.one-authority",
    WARNING,
    "one CA issues identities and signs permissions",
    "Cyclone DDS 0.10.2 and Fast DDS 2.9.1 then accept permissions that an enclave signed for "
    "itself: they verify a chain, and the certificate of every enclave ends at that CA.",
    "CVE-2023-24011 class; an enclave did so here on Cyclone DDS 0.10.2 and was heard.",
    "Make a keystore with separate CAs, which all templates but sros2 do.",
)
CA_ENDS = Kind(
    "keystore.ca-ends-soon",
    WARNING,
    "a CA that ends soon",
    "With it ends everything that it issued or signed, at one moment; to replace it takes stages.",
    "RFC 5280, 6.1.3; Fast DDS 2.14.5 and Cyclone DDS 0.10.2 verify the CA too.",
    "Begin now, with `sros rotate_ca ROOT`.",
)
CA_EXPIRED = Kind(
    "keystore.ca-expired",
    ERROR,
    "a CA of the keystore is not valid now",
    "Nothing can be issued or signed with it, and DDS refuses what was.",
    "RFC 5280, 6.1.3; Fast DDS 2.14.5 (Error '10' verifying CA certificate).",
    "Replace it with `sros rotate_ca ROOT`, or correct the clock.",
)
CA_MISSING = Kind(
    "keystore.ca-missing",
    ERROR,
    "the certificate of a CA is missing",
    "The links of every enclave lead to it.",
    "ROS 2 keystore layout (public/).",
    "Restore it from a backup; any enclave that was exported has a copy.",
)
CA_MISMATCH = Kind(
    "keystore.ca-key-mismatch",
    ERROR,
    "the key and the certificate of a CA do not belong together",
    "Nothing that it signs could be verified.",
    "RFC 5280, 6.1.3.",
    "Restore the pair from a backup.",
)
CA_KEY_PLAIN = Kind(
    "keystore.ca-key-plain",
    NOTE,
    "the key of a CA lies in the keystore without a passphrase",
    "Who copies the folder can make any enclave with any rights.",
    "ros2/sros2 issue 282; NIST SP 800-57 part 1, 6 (protection of keys).",
    "Make keystores with --encrypt-ca-keys or with keys on a token, or keep private/ offline.",
)
SETTINGS_MISSING = Kind(
    "keystore.settings-missing",
    WARNING,
    "a keystore of sros without its settings",
    "What is added later follows ros2/sros2: an enclave without a policy may do everything, for "
    "ten years.",
    "sros: sros.toml holds the choices that a keystore was made by.",
    "Restore sros.toml from a backup.",
)
LEDGER_MISSING = Kind(
    "keystore.ledger-missing",
    WARNING,
    "a keystore of sros without its ledger",
    "Permissions that were replaced, and certificates from elsewhere, cannot be told from those "
    "that are meant.",
    "sros: ledger.jsonl lists everything that was issued.",
    "Restore ledger.jsonl from a backup.",
)
CRL_ENDS = Kind(
    "keystore.revocation-list-ends",
    ERROR,
    "a revocation list that ends soon, or ended",
    "From its end on DDS refuses everybody.",
    "RFC 5280, 5.1.2.5; Fast DDS 2.14.5; measured.",
    "Run `sros crl ROOT --refresh`.",
)
CRL_ISSUER = Kind(
    "keystore.revocation-list-issuer",
    ERROR,
    "a revocation list that is not of the identity CA",
    "DDS cannot verify anybody with it, and refuses everybody.",
    "RFC 5280, 6.3.3; Fast DDS 2.14.5.",
    "Run `sros crl ROOT --refresh`.",
)

KINDS = by_id(
    UNREADABLE, ONE_AUTHORITY, CA_ENDS, CA_EXPIRED, CA_MISSING, CA_MISMATCH, CA_KEY_PLAIN,
    SETTINGS_MISSING, LEDGER_MISSING, CRL_ENDS, CRL_ISSUER,
)  # fmt: skip

_SOON = timedelta(days=90)
_LIST_SOON = timedelta(days=30)


def check_authorities(keystore: OpenedKeystore) -> Iterator[Finding]:
    """The certificates of the CAs, their keys where these lie in the keystore, and the list."""
    for each in keystore.unread:
        why = f"{each.error.what}. {each.error.why}".strip()
        yield UNREADABLE.found(each.path, why, keystore.shown(each.path), remedy=each.error.remedy)
    unread = {each.path for each in keystore.unread}
    if keystore.is_home:
        for role in (IDENTITY, PERMISSIONS):
            path = ca_certificate(role)
            if role not in keystore.authorities and path not in unread:
                text = f"there is no certificate of the {role} CA"
                yield CA_MISSING.found(f"{role} CA", text, keystore.shown(path))
    yield from _records(keystore)
    told: set[bytes] = set()
    for role, chain in keystore.authorities.items():
        fingerprint = chain[0].fingerprint(hashes.SHA256())
        if fingerprint not in told:
            told.add(fingerprint)
            yield from _authority(keystore, role, chain)
    yield from _one_for_both(keystore)
    yield from _revocation_list(keystore)


def _records(keystore: OpenedKeystore) -> Iterator[Finding]:
    """Keystores of ros2/sros2 have neither settings nor a ledger, those of sros have both."""
    settings, ledger = ((keystore.root / name).exists() for name in (SETTINGS, LEDGER))
    if ledger and not settings:
        yield SETTINGS_MISSING.found("settings", f"there is no {SETTINGS}", str(keystore.root))
    if settings and not ledger:
        yield LEDGER_MISSING.found("ledger", f"there is no {LEDGER}", str(keystore.root))


def _authority(
    keystore: OpenedKeystore, role: str, chain: tuple[x509.Certificate, ...]
) -> Iterator[Finding]:
    certificate = chain[0]
    file, subject = keystore.shown(ca_certificate(role)), f"{role} CA"
    name, validity = subject_text(certificate.subject), validity_of(certificate)
    begin, end = iso(validity.not_before), iso(validity.not_after)
    if not validity.contains(keystore.now):
        yield CA_EXPIRED.found(subject, f"{name} is valid from {begin} to {end}", file)
    elif validity.not_after - keystore.now < _SOON:
        yield CA_ENDS.found(subject, f"{name} ends at {end}", file)
    yield from authority_findings(role, chain, keystore.now, subject, file)
    yield from _key(keystore, role, certificate)


def _key(keystore: OpenedKeystore, role: str, certificate: x509.Certificate) -> Iterator[Finding]:
    path = keystore.root / ca_key(role)
    if not path.exists():
        return  # it is kept elsewhere
    try:
        key = load_key(read_bytes(path, "key"), f"'{path}'", _locked)
    except _LockedError:
        return
    except SrosError as error:
        yield UNREADABLE.found(f"{role} CA key", f"{error.what}. {error.why}", str(path))
        return
    yield CA_KEY_PLAIN.found(f"{role} CA key", "it has no passphrase", str(path))
    if not same_key(certificate, key):
        text = f"'{path.name}' is not the key of '{ca_certificate(role)}'"
        yield CA_MISMATCH.found(f"{role} CA", text, str(path))


class _LockedError(Exception):
    """A key has a passphrase, so nothing can be said about it."""


def _locked() -> str:
    raise _LockedError


def _one_for_both(keystore: OpenedKeystore) -> Iterator[Finding]:
    found = [chain[0] for chain in keystore.authorities.values()]
    if len(found) == 2:
        yield from one_for_both(
            keystore, found[0], found[1], keystore.shown(ca_certificate(IDENTITY))
        )


def one_for_both(
    keystore: OpenedKeystore, identity: x509.Certificate, permissions: x509.Certificate, file: str
) -> Iterator[Finding]:
    """Whether one CA does both jobs."""
    if identity.public_key() == permissions.public_key():
        text = f"{subject_text(identity.subject)} does both jobs"
        accepted = keystore.accepts(lambda settings: not settings.separate_authorities)
        yield ONE_AUTHORITY.found("the CAs", text, file, accepted=accepted)


def _revocation_list(keystore: OpenedKeystore) -> Iterator[Finding]:
    crl = keystore.crl
    if crl is None:
        return
    file = keystore.shown(CRL)
    if crl.next_update - keystore.now < _LIST_SOON:
        text = f"it ends at {iso(crl.next_update)}, and DDS then refuses everybody"
        yield CRL_ENDS.found("revocation list", text, file)
    identity = keystore.authorities.get(IDENTITY, ())
    if identity and not any(signed_by(crl.list, each) for each in identity):
        yield CRL_ISSUER.found("revocation list", "no identity CA of the keystore signed it", file)
