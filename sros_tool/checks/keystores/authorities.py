"""Checks of the CAs: certificates, keys, expiry and revocation list, as vendors require them."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import suppress
from datetime import datetime
from pathlib import Path
from shlex import quote

from cryptography import x509
from cryptography.hazmat.primitives import hashes

from sros_tool.checks.keystores.files import UNREADABLE, key_mode_findings
from sros_tool.checks.keystores.opened import CheckedKeystore
from sros_tool.checks.kind import ERROR, NOTE, WARNING, Finding, FindingKind
from sros_tool.dds.decision.vendors import FAST_DDS, Vendor
from sros_tool.errors import SrosError
from sros_tool.faults import ORIGINAL_KEYSTORE, WAIT_FOR_CA
from sros_tool.fleet.robots import Fleet
from sros_tool.keystore.fleet import FLEET_REMEDY, is_of_damaged_ledger
from sros_tool.keystore.known_keys import unlisted_revocations
from sros_tool.keystore.layout import (
    CRL,
    FLEET,
    IDENTITY,
    LEDGER,
    PERMISSIONS,
    PUBLISHED,
    SETTINGS,
    ca_certificate_path,
    ca_key_path,
    key_path,
)
from sros_tool.keystore.ledger import LEDGER_REMEDY, RESTORED
from sros_tool.keystore.loading import authority_refusals, refusals_text
from sros_tool.keystore.settings import edit_remedy
from sros_tool.keystore.template import is_ca_service
from sros_tool.pki.certificates import authority_text, same_key, subject_text, validity_of, weakness
from sros_tool.pki.chains import denies_issuing, purpose_faults
from sros_tool.pki.crl import signed_by
from sros_tool.pki.keys import algorithm, few_rounds_clause, is_portable, load_key
from sros_tool.pki.token import is_token_uri
from sros_tool.validity import AUTHORITY_SOON, iso
from sros_tool.wording import counted, first_few

NOT_A_CA = FindingKind(
    "keystore.not-a-ca",
    ERROR,
    "a CA certificate without the right to issue certificates",
    "OpenSSL refuses every chain that contains it.",
    "RFC 5280, 4.2.1.9 and 4.2.1.3 (BasicConstraints, KeyUsage keyCertSign).",
    "Replace the CA with `sros rotate_ca KEYSTORE`.",
)
CA_EXTENSIONS = FindingKind(
    "keystore.ca-extensions",
    NOTE,
    "a CA certificate without key identifiers or key usage",
    "Fast DDS verifies strictly, and refuses such a CA as soon as there is an intermediate CA. "
    "CAs made by ros2/sros2 lack these extensions.",
    "RFC 5280, 4.2.1.1 to 4.2.1.3; openssl verify -x509_strict.",
    "Before you add intermediate CAs, replace the CA with `sros rotate_ca KEYSTORE`.",
)
INTERMEDIATE = FindingKind(
    "portable.intermediate",
    WARNING,
    "a CA that is not self-signed",
    "Cyclone DDS accepts only a self-signed CA, as the first certificate of its file. Fast DDS "
    "verifies a chain of identity CAs; 2.14 requires keyUsage and key identifiers in each CA. For "
    "an intermediate permissions CA, Fast DDS 2.14 requires keyUsage, and 2.9 requires a purpose "
    "that allows signing documents.",
    "Fast DDS 2.6 to 3.6 (FileProvider.cpp), Cyclone DDS 0.10 and 11.0; tested.",
    "Use a separate root CA for robots, unless all of them run a Fast DDS that accepts this CA.",
)
CA_PURPOSE = FindingKind(
    "portable.ca-purpose",
    WARNING,
    "a permissions CA whose certificate does not allow signing documents",
    "Fast DDS 2.9 and Cyclone DDS 0.10 verify the S/MIME purpose, and refuse every document "
    '("unsuitable certificate purpose"): keyUsage, if present, must have digitalSignature, and '
    "extendedKeyUsage, if present, emailProtection. Fast DDS 2.14 and Cyclone DDS 11 check "
    "neither.",
    "RFC 8550, 4.4.2; Fast DDS 2.9.1 and 2.14.5 (Permissions.cpp), Cyclone DDS 0.10.2 and 11.0.1; "
    "tested.",
    "Replace the CA with `sros rotate_ca KEYSTORE`, or issue its certificate again with "
    "digitalSignature.",
    vendors=(Vendor.FAST_2_9, Vendor.CYCLONE),
)
KEY_ALGORITHM = FindingKind(
    "portable.key-algorithm",
    WARNING,
    "a key that not every vendor accepts",
    "Cyclone DDS accepts only EC prime256v1 and RSA of exactly 2048 bits. Fast DDS also accepts "
    "larger keys of both kinds, but not Ed25519, which fails in its handshake.",
    "DDS-Security 1.1, 9.3.1; Cyclone DDS 0.10 and 11.0, Fast DDS 2.6 to 3.6; tested.",
    "Use EC prime256v1, as sros does.",
)
SIGNATURE_HASH = FindingKind(
    "portable.signature-hash",
    WARNING,
    "a certificate that is not signed with SHA-256",
    "Fast DDS refuses SHA-384 in a CA and in an enclave's certificate; Cyclone DDS accepts it.",
    "Fast DDS 2.6 to 3.6 (PKIDH.cpp), Cyclone DDS 0.10 and 11.0; tested.",
    "Issue the certificate again with SHA-256, as sros does.",
    vendors=FAST_DDS,
)
WEAK = FindingKind(
    "keystore.weak-cryptography",
    ERROR,
    "a weak key, or a signature with a weak hash",
    "An attacker who computes the key of a CA, or finds another document with the same "
    "signature, can issue any identity or any permissions. An attacker who computes the key of "
    "an enclave can act as the enclave. Some vendors accept weak keys and weak hashes.",
    "NIST SP 800-57 part 1, 5.6, and SP 800-131A: RSA under 2048 bits, EC under 256 bits, SHA-1.",
    "Replace a CA with `sros rotate_ca KEYSTORE`; renew an enclave with `sros renew KEYSTORE "
    "ENCLAVE`.",
)


def _authority_findings(
    role: str, chain: tuple[x509.Certificate, ...], moment: datetime, subject: str, file: str
) -> Iterator[Finding]:
    """Yield findings about properties of a CA because of which vendors refuse the CA.

    ``chain`` are the certificates in the file of the CA, the CA's own certificate first.
    """
    certificate = chain[0]
    name = authority_text(certificate)
    if certificate.issuer != certificate.subject:
        issuer = subject_text(certificate.issuer)
        refused = refusals_text(authority_refusals(role, chain, moment))
        yield INTERMEDIATE.found(subject, f"{name} is issued by {issuer}. {refused}", file)
    elif role == PERMISSIONS and (fault := next(purpose_faults(chain[:1]), "")):
        yield CA_PURPOSE.found(subject, fault, file)
    signs_documents = role == PERMISSIONS  # no vendor refuses such a key for its algorithm (tested)
    for finding in key_findings(certificate, subject, file, owner_clause=f"{name} has"):
        if finding.kind is not KEY_ALGORITHM or not signs_documents:
            yield finding
    yield from _extension_findings(certificate, subject, name, file)


def key_findings(
    certificate: x509.Certificate, subject: str, file: str, *, owner_clause: str = "it has"
) -> Iterator[Finding]:
    """Yield findings about a certificate's key or signature that a vendor refuses.

    ``owner_clause`` begins the texts of the findings.
    """
    key = certificate.public_key()
    if not is_portable(key):
        yield KEY_ALGORITHM.found(subject, f"{owner_clause} a key of {algorithm(key)}", file)
    digest = certificate.signature_hash_algorithm
    if not isinstance(digest, hashes.SHA256):
        name = digest.name.upper() if digest else "no digest"
        yield SIGNATURE_HASH.found(subject, f"{owner_clause} a signature with {name}", file)


def _extension_findings(
    certificate: x509.Certificate, subject: str, ca_text: str, file: str
) -> Iterator[Finding]:
    if denies_issuing(certificate):
        yield NOT_A_CA.found(subject, f"{ca_text} may not issue certificates", file)
    wanted = (x509.KeyUsage, x509.SubjectKeyIdentifier, x509.AuthorityKeyIdentifier)
    present = {type(extension.value) for extension in certificate.extensions}
    missing = [kind.__name__ for kind in wanted if kind not in present]
    if missing:
        yield CA_EXTENSIONS.found(subject, f"{ca_text} lacks {', '.join(missing)}", file)


ONE_AUTHORITY = FindingKind(
    "keystore.one-authority",
    WARNING,
    "one CA issues identities and signs permissions",
    "Cyclone DDS 0.10.2 and Fast DDS 2.9.1 accept every signer whose certificate chain ends at "
    "the permissions CA. With one CA this includes every enclave, so an enclave can sign "
    "permissions for itself.",
    "CVE-2023-24011; reproduced on Cyclone DDS 0.10.2, where readers received data of such an "
    "enclave.",
    "Run `sros update_keystore KEYSTORE --set authorities.layout=separate`, and then `sros "
    "rotate_ca KEYSTORE --permissions --next`.",
)
CA_EXPIRES_SOON = FindingKind(
    "keystore.ca-ends-soon",
    WARNING,
    "a CA that expires soon",
    "Everything that the CA issued or signed expires with it, and replacing a CA takes several "
    "stages.",
    "RFC 5280, 6.1.3; Fast DDS 2.14.5 and Cyclone DDS 0.10.2 verify the CA too.",
    "Begin to replace the CA now, with `sros rotate_ca KEYSTORE`.",
)
CA_EXPIRED = FindingKind(
    "keystore.ca-expired",
    ERROR,
    "a CA of the keystore is not valid now",
    "Nothing can be issued or signed with the CA, and DDS refuses everything that it issued or "
    "signed. Only Cyclone DDS 11 still accepts documents of an expired permissions CA.",
    "RFC 5280, 6.1.3; Fast DDS 2.14.5 (Error '10' verifying CA certificate).",
    "Check the clock of this machine. If it is right, replace the CA: `sros rotate_ca KEYSTORE "
    "--finish`.",
)
CA_MISSING = FindingKind(
    "keystore.ca-missing",
    ERROR,
    "the certificate of a CA is missing",
    "Every enclave has a link to this file.",
    "ROS 2 keystore layout (public/).",
    "Restore the certificate from a backup; every exported enclave has a copy.",
)
CA_MISMATCH = FindingKind(
    "keystore.ca-key-mismatch",
    ERROR,
    "the key and the certificate of a CA do not belong together",
    "No signature by this key verifies against the certificate.",
    "RFC 5280, 6.1.3.",
    "Restore the pair from a backup.",
)
CA_KEY_PLAIN = FindingKind(
    "keystore.ca-key-plain",
    NOTE,
    "a CA key without a passphrase",
    "Anyone who copies the file can create any enclave, with any rights.",
    "ros2/sros2 issue 282; NIST SP 800-57 part 1, 6 (protection of keys).",
    "Encrypt the key with `openssl pkcs8 -topk8 -scrypt -in KEY -out KEY.new && mv KEY.new KEY`, "
    "or keep it offline. Create later keystores with --encrypt-ca-keys, or with keys on a token.",
)
CA_KEY_FEW_ROUNDS = FindingKind(
    "keystore.ca-key-few-rounds",
    NOTE,
    "a CA key whose passphrase can be guessed quickly",
    "Whoever copies the key can try millions of passphrases in a minute. OpenSSL makes 2048 rounds "
    "of PBKDF2 by default; 600,000 are recommended, or scrypt.",
    "OWASP Password Storage Cheat Sheet (2025); OpenSSL 3.0 (openssl-pkcs8).",
    "Run `openssl pkcs8 -topk8 -scrypt -in KEY -out KEY.new && mv KEY.new KEY`.",
)
SETTINGS_MISSING = FindingKind(
    "keystore.settings-missing",
    WARNING,
    "a keystore with a ledger of sros, but without settings",
    "New enclaves then follow the defaults of ros2/sros2: without a policy they may do "
    "everything, for ten years.",
    "sros: sros.toml holds the settings of a keystore.",
    "Run `sros update_keystore KEYSTORE --discard-edits`, which writes the settings that the "
    "ledger has. If the ledger has none, restore sros.toml from a backup.",
)
SETTINGS_EDITED = FindingKind(
    "keystore.settings-edited",
    WARNING,
    "settings that were edited by hand and not applied",
    "Files that are issued after the edit may follow it; earlier files do not. sros has not yet "
    "shown whether the edit weakens a protection.",
    "sros: the ledger has the settings as sros wrote them.",
    edit_remedy("KEYSTORE"),
)
FLEET_EDITED = FindingKind(
    "keystore.fleet-edited",
    WARNING,
    "an edit by hand in the keystore's copy of the fleet file",
    "The file decides which enclaves belong to a robot, and which domains they may join. Verbs "
    "that use the file to issue, revoke or export refuse it after such an edit.",
    "sros: the ledger has the SHA-256 of the file as sros wrote it.",
    FLEET_REMEDY,
)
LEFT_ENCLAVES = FindingKind(
    "keystore.left-enclaves",
    NOTE,
    "enclaves of robots that perhaps left the fleet, or the group that has these enclaves",
    "Anyone who has the files of such an enclave has its rights, and `--robot` no longer chooses "
    "the enclave. `sros renew --all-expiring` renews it, because its path is no proof that it "
    "belonged to a robot.",
    "sros: the paths have the form of a robot's enclaves, and no robot has these enclaves.",
    "Revoke the enclaves with `sros revoke KEYSTORE ENCLAVE...` if the robots are gone. Keep an "
    "enclave that never belonged to a robot.",
)
ROBOT_LEFT = FindingKind(
    "keystore.robot-left",
    WARNING,
    "valid enclaves of robots that left the fleet, or the group that has these enclaves",
    "Other robots still accept these enclaves, although no robot of the fleet has them. `sros "
    "renew --all-expiring` does not renew them.",
    "sros: ledger.jsonl has the enclaves of each robot that left.",
    "Revoke the enclaves with `sros revoke KEYSTORE ENCLAVE...`. If the robot is to keep them, add "
    "it to the fleet file again, and run `sros generate_artifacts`.",
)
NOT_AS_SETTINGS = FindingKind(
    "governance.not-as-settings",
    WARNING,
    "a signed governance that differs from the settings",
    "DDS loads the signed governance. The section [protection] of sros.toml has no effect.",
    "sros: sros.toml holds the settings of a keystore; DDS-Security 1.1, 9.4.1.2.",
    edit_remedy("KEYSTORE"),
)
LEDGER_MISSING = FindingKind(
    "keystore.ledger-missing",
    WARNING,
    "a keystore that sros made, but that has no ledger",
    "Without the ledger, sros cannot detect replaced permissions, or certificates from another "
    "source.",
    "sros: ledger.jsonl lists everything that was issued.",
    "Restore ledger.jsonl from a backup.",
)
LEDGER_DAMAGED = FindingKind(
    "keystore.ledger-damaged",
    ERROR,
    "a ledger with lines that are missing or were changed",
    "The ledger may lack certificates that `sros revoke` should revoke, and permissions newer "
    "than the current ones.",
    "sros: each line of ledger.jsonl has the digest of the line before it; ledger.p7s has the "
    "digest of the last line.",
    LEDGER_REMEDY,
)
CLOCK_BEHIND = FindingKind(
    "keystore.clock-behind",
    WARNING,
    "a check whose time is before the last change of the keystore",
    "If the clock of this machine is behind, expired files count as valid.",
    "sros: ledger.jsonl has the time of each change.",
    "Set the clock. If the clock is correct now, but was ahead at the last change, run `sros crl "
    "KEYSTORE --refresh`, so that the last entry of the ledger has today's date.",
)
OLDER_THAN_ROBOTS = FindingKind(
    "keystore.older-than-robots",
    ERROR,
    "a keystore that is older than its robots",
    "The keystore was restored from a backup, or is a copy. It may lack revocations, and its "
    "enclaves may have rights that were taken away after the backup.",
    "sros: the ledger has all releases; a message or the publishing folder has a later one.",
    "Run `sros fleet status KEYSTORE`, which names the command that publishes with --restored; "
    "docs/howto/keystore_is_lost.md has the other steps.",
)
PUBLICATION_UNSEEN = FindingKind(
    "keystore.publication-unseen",
    WARNING,
    "a last publication that cannot be examined",
    "If the keystore was restored from a backup, it may lack revocations, and perhaps only the "
    "publishing folder shows this.",
    "sros: published.json has the folder and the versions of the last publication.",
    "Run `sros fleet status KEYSTORE`, which names the remedy. If the folder belongs on another "
    "machine, add `--exclude keystore.publication-unseen`.",
)
CRL_EXPIRES_SOON = FindingKind(
    "keystore.revocation-list-ends",
    ERROR,
    "a revocation list that expires soon, or has expired",
    "Once the list has expired, DDS refuses every participant.",
    "RFC 5280, 5.1.2.5; Fast DDS 2.6 to 3.6; tested.",
    "Run `sros crl KEYSTORE --refresh`.",
)
CRL_LACKS = FindingKind(
    "keystore.revocation-list-lacks",
    ERROR,
    "a revocation list that lacks revoked certificates",
    "An earlier list was put back, or the list was removed: processes that start now accept "
    "these certificates.",
    "RFC 5280, 5; sros: ledger.jsonl has all revocations.",
    "Find out who changed the list, and run `sros crl KEYSTORE --refresh`, which revokes the "
    "certificates again.",
)
CRL_ISSUER = FindingKind(
    "keystore.revocation-list-issuer",
    ERROR,
    "a revocation list that the identity CA did not sign",
    "DDS cannot verify any certificate with this list, and refuses every participant.",
    "RFC 5280, 6.3.3; Fast DDS 2.14.5.",
    "Run `sros crl KEYSTORE --refresh`.",
)


def check_authorities(keystore: CheckedKeystore) -> Iterator[Finding]:
    """Yield findings about the certificates and keys of the CAs, and the revocation list."""
    for part in keystore.unread:
        why = f"{part.error.what}. {part.error.why}".strip()
        yield UNREADABLE.found(
            part.path, why, keystore.shown_path(part.path), remedy=part.error.remedy
        )
    unread = {part.path for part in keystore.unread}
    if keystore.is_original:
        for role in (IDENTITY, PERMISSIONS):
            path = ca_certificate_path(role)
            if role not in keystore.authorities and path not in unread:
                text = f"there is no certificate of the {role} CA"
                yield CA_MISSING.found(f"{role} CA", text, keystore.shown_path(path))
    yield from _settings_and_ledger_findings(keystore)
    seen: set[bytes] = set()
    for role, chain in keystore.authorities.items():
        fingerprint = chain[0].fingerprint(hashes.SHA256())
        if fingerprint not in seen:
            seen.add(fingerprint)
            yield from _authority(keystore, role, chain)
    yield from _shared_ca_findings(keystore)
    yield from _revocation_list_findings(keystore)


_SHOWN, _MOST_LEFT = 5, 20
"""Maximum numbers in a finding's text: enclaves of each removed robot, and removed robots.
"""


def _former_robot_findings(keystore: CheckedKeystore, fleet: Fleet) -> Iterator[Finding]:
    from sros_tool.fleet.robots import former_robot_of

    left = keystore.left_enclaves
    former = {name: former_robot_of(fleet, name) for name in keystore.names if name not in left}
    for kind, enclaves in ((ROBOT_LEFT, left), (LEFT_ENCLAVES, former)):
        robots: dict[str, list[str]] = {}
        for name, robot in enclaves.items():
            if robot:
                robots.setdefault(robot, []).append(name)
        for robot, names in list(robots.items())[:_MOST_LEFT]:
            clause = f"enclaves of {robot}: {first_few(names, _SHOWN)}"
            yield kind.found("fleet", clause, keystore.shown_path(FLEET))
        if (more_robots := len(robots) - _MOST_LEFT) > 0:
            clause = f"enclaves of {counted(more_robots, 'more robot')}"
            yield kind.found("fleet", clause, keystore.shown_path(FLEET))


_NEXT_CA = "Make a new keystore with the certificate of the next CA of the CA service."
_NEXT_LIST = (
    "Have the CA service sign a later list, FILE, and run `sros crl KEYSTORE --refresh --crl FILE`."
)


def _has_ca_service(keystore: CheckedKeystore) -> bool:
    """Return whether a CA service is the identity CA."""
    return bool(keystore.settings and is_ca_service(keystore.settings.identity_key))


def _restore_findings(keystore: CheckedKeystore, file: str) -> Iterator[Finding]:
    opened = keystore.opened
    if not (opened.entries_of(RESTORED) or opened.has(PUBLISHED)):
        return
    # Most keystores publish nothing, and do not need it.
    from sros_tool.keystore.delivery.publish import (
        unpublished_restore_clause,
        unseen_publication_clause,
    )

    if why := unpublished_restore_clause(opened):
        yield OLDER_THAN_ROBOTS.found("keystore", why, file)
        return
    try:
        why, remedy = unseen_publication_clause(opened), ""
    except SrosError as error:
        why, remedy = error.what, error.remedy
    if why:
        path = keystore.shown_path(PUBLISHED)
        yield PUBLICATION_UNSEEN.found("keystore", why, path, remedy=remedy)


def _settings_and_ledger_findings(keystore: CheckedKeystore) -> Iterator[Finding]:
    """Yield findings about the settings and the ledger, which only sros writes."""
    settings, ledger = ((keystore.root / name).exists() for name in (SETTINGS, LEDGER))
    if ledger and not settings:
        yield SETTINGS_MISSING.found("settings", f"there is no {SETTINGS}", str(keystore.root))
    if settings and not ledger:
        yield LEDGER_MISSING.found("ledger", f"there is no {LEDGER}", str(keystore.root))
        return
    edits, file = keystore.edits, keystore.shown_path(SETTINGS)
    if edits.settings:
        yield SETTINGS_EDITED.found("settings", "; ".join(edits.settings), file)
    if keystore.fleet_edits and not is_of_damaged_ledger(keystore.fleet_edits):
        clause = f"{FLEET} {keystore.fleet_edits}"
        yield FLEET_EDITED.found("fleet", clause, keystore.shown_path(FLEET))
    if keystore.fleet:
        yield from _former_robot_findings(keystore, keystore.fleet)
    for clause in edits.unsigned:
        yield NOT_AS_SETTINGS.found("settings", clause, file)
    file = keystore.shown_path(LEDGER)
    with suppress(SrosError):  # a ledger that cannot be read is unread
        if behind := keystore.opened.ledger_file.clock_clause(keystore.at.now):
            yield CLOCK_BEHIND.found("clock", behind, file)
        yield from _restore_findings(keystore, file)
    for gap in keystore.ledger.gaps:
        yield LEDGER_DAMAGED.found("ledger", gap, file)


def _authority(
    keystore: CheckedKeystore, role: str, chain: tuple[x509.Certificate, ...]
) -> Iterator[Finding]:
    certificate = chain[0]
    file, subject = keystore.shown_path(ca_certificate_path(role)), f"{role} CA"
    name, validity = authority_text(certificate), validity_of(certificate)
    begin, end = iso(validity.not_before), iso(validity.not_after)
    remedy = _NEXT_CA if role == IDENTITY and _has_ca_service(keystore) else ""
    if not validity.contains(keystore.at.now):
        text = f"{name} is valid from {begin} to {end}"
        if keystore.at.now < validity.not_before:
            remedy = WAIT_FOR_CA
        yield CA_EXPIRED.found(subject, text, file, remedy=remedy)
    elif validity.expires_soon_from(AUTHORITY_SOON) < keystore.at.now:
        yield CA_EXPIRES_SOON.found(subject, f"{name} expires at {end}", file, remedy=remedy)
    for weak in filter(None, map(weakness, chain)):
        yield WEAK.found(subject, weak, file)
    yield from _authority_findings(role, chain, keystore.at.now, subject, file)
    yield from _ca_key_findings(keystore, role, certificate)


def _ca_key_findings(
    keystore: CheckedKeystore, role: str, certificate: x509.Certificate
) -> Iterator[Finding]:
    """Yield findings about the key that signs as a CA, and about its copies in the keystore."""
    inside, subject = keystore.root / ca_key_path(role), f"{role} CA key"
    place = (keystore.settings.key_place(role) if keystore.settings else "") or ca_key_path(role)
    is_file = not (is_token_uri(place) or is_ca_service(place))
    signing = key_path(keystore.root, place) if is_file else inside
    for path in dict.fromkeys((inside, signing)):
        if not os.access(path, os.R_OK if path != inside else os.F_OK):
            continue  # on a medium that is not there now, or for another user only
        if path != inside:
            yield from key_mode_findings(keystore, str(path), path.stat().st_mode)
        try:
            pem = keystore.opened.read(path, "key")
            key = load_key(pem, f"'{path}'", _refuse_passphrase)
        except _LockedError:
            yield from _weak_derivation_findings(subject, path, pem)
        except SrosError as error:
            yield UNREADABLE.found(subject, f"{error.what}. {error.why}", str(path))
        else:
            if same_key(certificate, key):
                yield CA_KEY_PLAIN.found(subject, "it has no passphrase", str(path))
            elif path == signing and is_file:
                text = f"'{path.name}' is not the key of '{ca_certificate_path(role)}'"
                yield CA_MISMATCH.found(f"{role} CA", text, str(path))


def _weak_derivation_findings(subject: str, path: Path, pem: bytes) -> Iterator[Finding]:
    if text := few_rounds_clause(pem):
        old, new = quote(str(path)), quote(f"{path}.new")
        remedy = f"Run `openssl pkcs8 -topk8 -scrypt -in {old} -out {new} && mv {new} {old}`."
        yield CA_KEY_FEW_ROUNDS.found(subject, text, str(path), remedy=remedy)


class _LockedError(Exception):
    """A CA key has a passphrase, so it cannot be checked."""


def _refuse_passphrase() -> str:
    raise _LockedError


def _shared_ca_findings(keystore: CheckedKeystore) -> Iterator[Finding]:
    certificates = [chain[0] for chain in keystore.authorities.values()]
    if len(certificates) == 2:
        yield from shared_ca_findings(
            keystore,
            certificates[0],
            certificates[1],
            keystore.shown_path(ca_certificate_path(IDENTITY)),
        )


def shared_ca_findings(
    keystore: CheckedKeystore, identity: x509.Certificate, permissions: x509.Certificate, file: str
) -> Iterator[Finding]:
    """Yield a finding if the identity CA and the permissions CA have the same key."""
    if identity.public_key() == permissions.public_key():
        text = f"{authority_text(identity)} is identity CA and permissions CA"
        accepted = keystore.accepted_by(
            ONE_AUTHORITY, lambda settings: not settings.separate_authorities
        )
        in_keystore = f"In the {ORIGINAL_KEYSTORE}: {ONE_AUTHORITY.remedy}"
        remedy = _separation_remedy(keystore) if keystore.can_issue else in_keystore
        yield ONE_AUTHORITY.found("the CAs", text, file, remedy=remedy, accepted=accepted)


def _separation_remedy(keystore: CheckedKeystore) -> str:
    """Return a remedy: the commands that give identity CA and permissions CA separate keys.

    The result is "" if the rotation cannot be read, or if both CAs share a file.
    """
    from sros_tool.keystore.lifecycle.rotation import RotationStage, read_rotation

    try:
        stage = read_rotation(keystore.opened).stage
        files = keystore.opened.authority_files
    except SrosError:  # `sros rotate_ca` reports it
        return ""
    if stage is not RotationStage.NONE:
        text = f"Continue the current rotation (stage {stage}): restart all processes, "
        text += "and run `sros rotate_ca KEYSTORE --next`."
        return text if len(files) > 1 else f"{text} Once it is complete: {ONE_AUTHORITY.remedy}"
    return "Run `sros rotate_ca KEYSTORE --permissions --next`." if len(files) > 1 else ""


def _revocation_list_findings(keystore: CheckedKeystore) -> Iterator[Finding]:
    crl, file = keystore.crl, keystore.shown_path(CRL)
    if keystore.is_original:
        with suppress(SrosError):  # a ledger or list that cannot be read is unread
            if names := unlisted_revocations(keystore.opened, keystore.at.now):
                text = f"it lacks certificates of {first_few(names, _SHOWN)}"
                yield CRL_LACKS.found("revocation list", text, file)
    if crl is None:
        return
    remedy = _NEXT_LIST if _has_ca_service(keystore) else ""
    if crl.expires_soon_from() < keystore.at.now:
        end = iso(crl.next_update)
        text = f"it expires at {end}, and DDS then refuses every participant"
        if crl.next_update < keystore.at.now:
            text = f"it expired at {end}, so DDS refuses every participant"
        yield CRL_EXPIRES_SOON.found("revocation list", text, file, remedy=remedy)
    identity = keystore.authorities.get(IDENTITY, ())
    if identity and not any(signed_by(crl.list, certificate) for certificate in identity):
        text = "no identity CA of the keystore signed it"
        yield CRL_ISSUER.found("revocation list", text, file, remedy=remedy)
