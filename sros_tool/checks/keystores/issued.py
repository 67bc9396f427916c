"""Checks that compare enclaves with each other, with the ledger, and with policies."""

from __future__ import annotations

import hashlib
from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress
from functools import lru_cache
from typing import NamedTuple, TypeVar

from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization

from sros_tool.checks.keystores.documents import DIFFERS as GOVERNANCE_DIFFERS
from sros_tool.checks.keystores.enclaves import grant_of
from sros_tool.checks.keystores.opened import CheckedEnclave, CheckedKeystore
from sros_tool.checks.kind import ERROR, NOTE, WARNING, Finding, FindingKind
from sros_tool.dds.domains import DomainSet
from sros_tool.dds.governance import parse_governance
from sros_tool.dds.permissions import mistaken_names, pairs_text
from sros_tool.errors import SrosError
from sros_tool.fleet.robots import robot_of
from sros_tool.keystore.known_keys import removed_enclaves, unknown_authorities
from sros_tool.keystore.layout import (
    CLOSED_OBSERVER,
    CRL_FILE,
    IDENTITY_CA_FILE,
    LEDGER,
    PERMISSIONS_CA_FILE,
    ROLES,
    ca_certificate_path,
    enclave_folder,
    folder_of_closed_robot,
    is_original_keystore,
)
from sros_tool.keystore.protection import unfulfilled_protections
from sros_tool.pki.certificates import authority_text, load_certificates, readable_fingerprints
from sros_tool.pki.crl import load_crl, signed_by
from sros_tool.policy.model import stated_protections
from sros_tool.policy.rights import Right, compare, policy_rights
from sros_tool.translate import grant_rights
from sros_tool.wording import first_few, serial_text

SERIAL_TWICE = FindingKind(
    "keystore.serial-twice",
    ERROR,
    "two certificates of one CA with the same serial number",
    "A revocation list names serial numbers, so revoking one revokes the other.",
    "RFC 5280, 4.1.2.2.",
    "Run `sros renew KEYSTORE ENCLAVE` for one of them.",
)
KEY_TWICE = FindingKind(
    "keystore.key-twice",
    ERROR,
    "two enclaves with the same key",
    "Each of the two enclaves can act as the other.",
    "RFC 5280, 4.1.2.6 (the subject is the holder of the key); DDS-Security 1.1, 9.3.",
    "Run `sros renew KEYSTORE ENCLAVE --new-key` for one of them.",
)
_RESTORE_REMEDY = (
    "Restore the files of the enclaves that got a copy, or run `sros renew KEYSTORE ENCLAVE "
    "--new-key` for these enclaves."
)
UNEXPLAINED = FindingKind(
    "keystore.not-in-ledger",
    WARNING,
    "a certificate or document that the keystore never issued",
    (
        "The certificate or document came from another source, or the ledger was reset to an "
        "earlier state."
    ),
    "sros: ledger.jsonl.",
    "Find out the source. Then state the rights with `sros create_permission KEYSTORE ENCLAVE "
    "POLICY_FILE`, and issue the certificate again with `sros renew KEYSTORE ENCLAVE "
    "--revoke-old`.",
)
OLD_PERMISSIONS = FindingKind(
    "enclave.old-permissions",
    ERROR,
    "replaced permissions are in use again",
    "Their signature is valid, and if the subject stays the same, DDS accepts them until they "
    "expire. Perhaps a backup was restored, or someone tries to get back a removed right.",
    "ros2/sros2 issue 275; sros: ledger.jsonl.",
    "Sign the intended permissions with `sros create_permission KEYSTORE ENCLAVE POLICY_FILE`. "
    "`sros "
    "renew` refuses to sign the replaced permissions again.",
)
STALE = FindingKind(
    "enclave.stale-permissions",
    WARNING,
    "permissions that differ from the policy",
    "The policy was changed after the permissions were signed, or the permissions were made "
    "from another policy.",
    "sros: the rights of policy and permissions, in ROS terms.",
    "Run `sros generate_artifacts -k KEYSTORE -p POLICY_FILE`; `sros diff_policy` shows all "
    "differences.",
)
LESS_PROTECTED = FindingKind(
    "governance.less-than-policy",
    ERROR,
    "names that are protected less than the policy demands",
    "The governance of the keystore decides; it was not made from this policy, or was changed "
    "since.",
    "DDS-Security 1.1, 9.4.1.2 (topic rules); sros: protect= in a policy.",
    "Run `sros generate_artifacts -k KEYSTORE -p POLICY_FILE`, which raises the protection; all "
    "processes have to be restarted with the new governance.",
)
NOT_IN_POLICY = FindingKind(
    "enclave.not-in-policy",
    NOTE,
    "an enclave that no policy names",
    "Its permissions stay valid, even if its node was renamed or removed from the policy.",
    "sros: --policy.",
    "Name the policy of this enclave, too; or, if nobody needs the enclave, revoke it: `sros "
    "revoke KEYSTORE ENCLAVE`.",
    prominent=True,
)
NOT_IN_KEYSTORE = FindingKind(
    "keystore.enclave-missing",
    WARNING,
    "an enclave that is in the policy, but not in the keystore",
    "A node that starts in this enclave fails.",
    "rcl 9 (security.c).",
    "Run `sros generate_artifacts -k KEYSTORE -p POLICY_FILE`.",
)
NOT_IN_EXPORT = FindingKind(
    "keystore.not-in-export",
    NOTE,
    "enclaves that are in the policy, but not in the export",
    "A robot needs only the enclaves of its own processes; a node that starts in another enclave "
    "fails there.",
    "rcl 9 (security.c).",
    "Export an enclave as well if a process of this robot runs in it: `sros distribute_key "
    "KEYSTORE ENCLAVE EXPORT`.",
    prominent=True,
)

AUTHORITIES_DIFFER = FindingKind(
    "keystore.authorities-differ",
    ERROR,
    "enclaves that do not trust the same CAs",
    "Nodes that trust different CAs never communicate, and neither Fast DDS nor Cyclone DDS "
    "reports why.",
    "DDS-Security 1.1, 9.3; Fast DDS 2.9.1, Cyclone DDS 0.10.2; tested.",
    "Export the enclave again from the keystore of the other enclaves, or create it again in "
    "that keystore.",
)

UNKNOWN_AUTHORITY = FindingKind(
    "keystore.unknown-authority",
    ERROR,
    "a file of CAs with a CA that the keystore does not know",
    "Fast DDS trusts every CA in the file, Cyclone DDS only the first CA. Whoever has the key of "
    "an "
    "identity CA can make any enclave; whoever has the key of a permissions CA can give any "
    "rights.",
    "Fast DDS 2.6 to 3.6, Cyclone DDS 0.10 and 11.0; sros: ledger.jsonl has the CAs.",
    "Find out who added the CA, and restore the file from a backup.",
)
REVOKED_BY_NEWER_LIST = FindingKind(
    "keystore.enclave-revoked",
    ERROR,
    "an enclave that a newer revocation list, or the ledger, revokes",
    "The enclave was revoked after it was exported, or its files were put back. Its processes "
    "can still start, and communicate with all processes that have not loaded the newer list.",
    "RFC 5280, 5; rmw_dds_common (crl.pem).",
    "Remove the enclave's folder.",
)
REMOVED = FindingKind(
    "keystore.enclave-removed",
    NOTE,
    "an enclave that was removed from the keystore, and not revoked",
    "Whoever has its files, as from a robot or a backup, has its rights until the files expire.",
    "sros: ledger.jsonl has the certificate, and no revocation of it.",
    "Restore the enclave's folder from a backup. Or create the enclave again with `sros "
    "create_enclave KEYSTORE ENCLAVE`, and run `sros revoke KEYSTORE ENCLAVE`, which revokes "
    "all its certificates.",
)
OLDER_LIST = FindingKind(
    "enclave.crl-older",
    WARNING,
    "an enclave with an older revocation list than another enclave",
    "Processes of this enclave communicate with enclaves that the newer list revokes.",
    "RFC 5280, 5.2.3; rmw_dds_common (crl.pem).",
    "Export the enclave again, with `sros distribute_key KEYSTORE ENCLAVE TARGET --force`.",
)

ROOT_ENCLAVE = FindingKind(
    "keystore.root-enclave",
    WARNING,
    "the enclave '/', with all rights of other enclaves",
    "A process that names no enclave runs in /, and gets all rights of /. Without an enclave /, it "
    "would not start (with ROS_SECURITY_STRATEGY=Enforce).",
    "rcl 9 (rcl/src/rcl/security.c, context.c: the enclave is / by default).",
    "Start each process in its enclave, run `sros revoke KEYSTORE /`, and remove the enclave / "
    "from the policy.",
)

_Key = TypeVar("_Key")

_RIGHTS_SHOWN = 3
_AUTHORITY_FILES = (IDENTITY_CA_FILE, PERMISSIONS_CA_FILE)
"""The CA files of an enclave, which decide which peers the enclave trusts."""


class EnclaveSummary(NamedTuple):
    """The digests and names by which an enclave is compared with other enclaves.

    ``governance_digest`` is "" if the keystore has a governance document.  ``trusted`` has the
    fingerprints of the CAs in each CA file of the enclave.
    """

    name: str
    serial: int
    issuer: str
    key_digest: bytes
    certificate_digest: str
    permissions_digest: str
    governance_digest: str
    has_unique_subject: bool
    trusted: tuple[frozenset[str], ...]
    list_number: int
    """CRL number of the enclave's revocation list, or -1 without a list signed by a trusted CA."""


def summary_of(enclave: CheckedEnclave) -> EnclaveSummary | None:
    """Return the summary of an enclave, or None if it has no certificate."""
    certificate = enclave.state.certificate
    if certificate is None:
        return None
    key = certificate.public_key().public_bytes(
        serialization.Encoding.DER, serialization.PublicFormat.SubjectPublicKeyInfo
    )
    message = enclave.state.files.get("permissions.p7s")
    return EnclaveSummary(
        enclave.name,
        certificate.serial_number,
        certificate.issuer.rfc4514_string(),
        hashlib.sha256(key).digest(),
        certificate.fingerprint(hashes.SHA256()).hex(),
        hashlib.sha256(message).hexdigest() if message else "",
        hashlib.sha256(repr(enclave.state.governance).encode()).hexdigest()
        if enclave.state.governance and not enclave.keystore.governance
        else "",
        len(certificate.subject.rdns) > 1,
        tuple(
            readable_fingerprints(enclave.state.files.get(name, b"")) for name in _AUTHORITY_FILES
        ),
        _list_number(enclave),
    )


def _list_number(enclave: CheckedEnclave) -> int:
    path = enclave.folder / CRL_FILE
    if not path.exists():
        return -1
    try:
        data = enclave.keystore.opened.read(path, "revocation list")
    except SrosError:
        return -1  # another check reports it
    return _number_if_signed(data, enclave.state.files.get(IDENTITY_CA_FILE, b""))


@lru_cache(maxsize=8)
def _number_if_signed(data: bytes, authority: bytes) -> int:
    try:
        crl = load_crl(data, CRL_FILE)
        authentic = any(
            signed_by(crl.list, certificate) for certificate in load_certificates(authority, "")
        )
    except SrosError:
        return -1
    return crl.number if authentic else -1


def check_issued(
    keystore: CheckedKeystore, summaries: Sequence[EnclaveSummary]
) -> Iterator[Finding]:
    """Yield findings from comparing enclaves with each other, the ledger and the policies."""
    certificates = {summary.name: summary.certificate_digest for summary in summaries}
    different = {summary.certificate_digest: summary for summary in summaries}.values()
    for (_, serial), names in _shared_values(((t.issuer, t.serial), t.name) for t in different):
        yield SERIAL_TWICE.found(", ".join(names), f"the serial number is {serial_text(serial)}")
    for _, names in _shared_values((summary.key_digest, summary.name) for summary in summaries):
        if len({certificates[name] for name in names}) > 1:
            text, remedy = "their certificates have the same public key", ""
        else:
            text = "they have the same certificate: the files of one enclave were copied"
            remedy = (
                _RESTORE_REMEDY if keystore.looks_like_original else "Export these enclaves again."
            )
        yield KEY_TWICE.found(", ".join(names), text, remedy=remedy)
    # A subject name with a unique part matches no other subject name.
    plain = {summary.name for summary in summaries if not summary.has_unique_subject}
    names = [summary.name for summary in summaries]
    pairs = [(inner, outer) for inner, outer in mistaken_names(names) if inner in plain]
    if pairs:
        from sros_tool.checks.policies.portability import ENCLAVE_NAMES

        text = f"Cyclone DDS mistakes {pairs_text(pairs)}"
        yield ENCLAVE_NAMES.found(pairs[0][0], text, str(keystore.root))
    if "/" in keystore.names:
        from sros_tool.checks.policies.enclaves import clause_on_enclaves_within_root
        from sros_tool.keystore.rights import load_rights

        if text := clause_on_enclaves_within_root(load_rights(keystore.opened).rights):
            yield ROOT_ENCLAVE.found("/", text, str(keystore.opened.folder("/")))
    yield from _trust_findings(keystore, summaries)
    yield from _exported_governance_findings(keystore, summaries)
    yield from _revocation_list_findings(keystore, summaries)
    yield from _ledger_findings(keystore, summaries)
    if keystore.at.policies:
        wanted = {enclave.path for policy in keystore.at.policies for enclave in policy.enclaves}
        root, missing = str(keystore.root), sorted(wanted.difference(keystore.names))
        if is_original_keystore(keystore.root):
            for name in missing:
                yield NOT_IN_KEYSTORE.found(name, "the keystore does not have this enclave", root)
        elif missing:
            text = (
                f"{len(missing)} of {len(wanted)} enclaves of the policy "
                f"{'is' if len(missing) == 1 else 'are'} not in this export"
            )
            yield NOT_IN_EXPORT.found(missing[0], f"{text}: {first_few(missing, 3)}", root)
        yield from _lower_protection_findings(keystore)


def _lower_protection_findings(keystore: CheckedKeystore) -> Iterator[Finding]:
    """Yield findings about names that the governance protects less than a policy demands."""
    stated = stated_protections(
        enclave for policy in keystore.at.policies for enclave in policy.enclaves
    )
    if not stated:
        return
    try:
        governance = parse_governance(
            keystore.opened.files.signed_document(keystore.governance).document
        )
    except SrosError:
        return  # another check reports it
    for protection, level in unfulfilled_protections(governance, stated):
        text = f"{protection} has the protection {level.lower()}, but the policy demands "
        text += protection.word
        yield LESS_PROTECTED.found(
            protection.enclave, text, protection.source.file, protection.source.line
        )


def _shared_values(pairs: Iterable[tuple[_Key, str]]) -> Iterator[tuple[_Key, list[str]]]:
    names_by_key: dict[_Key, list[str]] = defaultdict(list)
    for key, name in pairs:
        names_by_key[key].append(name)
    return ((key, names) for key, names in names_by_key.items() if len(names) > 1)


def _trust_findings(
    keystore: CheckedKeystore, summaries: Sequence[EnclaveSummary]
) -> Iterator[Finding]:
    """Yield findings about unknown CAs, and about enclaves that share no CA with the keystore.

    In an export, an enclave is compared with the CAs that most enclaves there trust.  During a
    rotation, an enclave trusts the old and the new CA, so one common CA is enough.
    """
    for role in keystore.authorities:
        strangers: Sequence[x509.Certificate] = ()
        with suppress(SrosError):  # a ledger that cannot be read is unread
            strangers = unknown_authorities(keystore.opened, role)
        for authority in strangers:
            text = f"{authority_text(authority)} is not in the ledger"
            path = keystore.shown_path(ca_certificate_path(role))
            yield UNKNOWN_AUTHORITY.found(f"{role} CA", text, path)
    for index, (role, file) in enumerate(zip(ROLES, _AUTHORITY_FILES, strict=True)):
        everyone = [summary for summary in summaries if summary.trusted[index]]
        if not everyone:
            continue
        usual, _ = Counter(summary.trusted[index] for summary in everyone).most_common(1)[0]
        trusted_elsewhere = "most other enclaves"
        if chain := keystore.authorities.get(role):
            usual = frozenset(
                certificate.fingerprint(hashes.SHA256()).hex() for certificate in chain
            )
            trusted_elsewhere = "the keystore"
        for summary in everyone:
            place = f"{keystore.root}/{enclave_folder(summary.name)}/{file}"
            if not summary.trusted[index] & usual:
                text = f"{file} contains another CA than {trusted_elsewhere}"
                yield AUTHORITIES_DIFFER.found(summary.name, text, place)
            elif chain and (more := sorted(summary.trusted[index] - usual)):
                text = f"the CAs of the keystore, and another one (SHA-256 {more[0][:8]})"
                yield UNKNOWN_AUTHORITY.found(summary.name, f"{file} has {text}", place)


def _exported_governance_findings(
    keystore: CheckedKeystore, summaries: Sequence[EnclaveSummary]
) -> Iterator[Finding]:
    """Yield findings about exported enclaves whose governance differs from the first enclave's."""
    copies = [summary for summary in summaries if summary.governance_digest]
    for copy in copies[1:]:
        if copy.governance_digest != copies[0].governance_digest:
            file = f"{keystore.root}/{enclave_folder(copy.name)}/governance.p7s"
            text = f"its governance differs from the governance of {copies[0].name}"
            yield GOVERNANCE_DIFFERS.found(copy.name, text, file)


def _revocation_list_findings(
    keystore: CheckedKeystore, summaries: Sequence[EnclaveSummary]
) -> Iterator[Finding]:
    """Yield findings about enclaves whose revocation list is not the newest list of their CA."""
    for issuer in dict.fromkeys(summary.issuer for summary in summaries):
        enclaves = [summary for summary in summaries if summary.issuer == issuer]
        newest = max(enclaves, key=lambda summary: summary.list_number)
        older = [enclave for enclave in enclaves if enclave.list_number < newest.list_number]
        if not older:
            continue
        path = keystore.opened.folder(newest.name) / CRL_FILE
        crl = load_crl(keystore.opened.read(path, "revocation list"), f"'{path}'")
        for summary in older:
            folder = str(keystore.opened.folder(summary.name))
            of = f"the list of {newest.name} has number {newest.list_number}"
            if crl.revokes(summary.serial):
                yield REVOKED_BY_NEWER_LIST.found(
                    summary.name, f"{of}, and revokes this enclave", folder
                )
            # Another check reports a missing list.
            elif (number := summary.list_number) >= 0 or not keystore.crl:
                own_list = f"has number {number}" if number >= 0 else "is missing"
                text = f"its list {own_list}, {of}"
                yield OLDER_LIST.found(summary.name, text, f"{folder}/{CRL_FILE}")


def _ledger_findings(
    keystore: CheckedKeystore, summaries: Sequence[EnclaveSummary]
) -> Iterator[Finding]:
    entries = keystore.ledger.entries
    if not entries:
        return
    known = {entry.sha256 for entry in entries}
    revoked = {entry.serial for entry in entries if entry.what == "revocation"}
    with suppress(SrosError):  # a list that cannot be read is unread
        lists = keystore.opened.revocation_lists
        revoked -= {f"{entry.serial:x}" for crl in lists for entry in crl.revoked}
    signed: dict[str, list[str]] = defaultdict(list)
    for entry in entries:
        if entry.what == "permissions":
            signed[entry.enclave].append(entry.sha256)
    with suppress(SrosError):  # a ledger that cannot be read is unread
        for name, expiry in sorted(removed_enclaves(keystore.opened, keystore.at.now).items()):
            text = f"the ledger has a certificate that is valid until {expiry}"
            yield REMOVED.found(name, text, keystore.shown_path(LEDGER))
    for summary in summaries:
        place = f"{keystore.root}/{enclave_folder(summary.name)}"
        if f"{summary.serial:x}" in revoked:
            text = "the ledger says that the enclave is revoked, but the revocation list does not"
            yield REVOKED_BY_NEWER_LIST.found(summary.name, text, place)
        for file, sha256 in (
            ("cert.pem", summary.certificate_digest),
            ("permissions.p7s", summary.permissions_digest),
        ):
            if sha256 and sha256 not in known:
                text = f"{file} is not in the ledger"
                yield UNEXPLAINED.found(summary.name, text, f"{place}/{file}")
        if (
            summary.permissions_digest in signed[summary.name]
            and summary.permissions_digest != signed[summary.name][-1]
        ):
            text = "the ledger has permissions that were signed later"
            yield OLD_PERMISSIONS.found(summary.name, text, f"{place}/permissions.p7s")


_SIGN_FOR_THE_FLEET = "Run `sros generate_artifacts -k KEYSTORE -p POLICY_FILE --fleet FLEET_FILE`."


def check_policy(
    enclave: CheckedEnclave, wanted_rights: dict[str, frozenset[Right]]
) -> Iterator[Finding]:
    """Yield a finding if the rights of an enclave differ from the rights in the policies."""
    if not wanted_rights:
        return
    name, grant = enclave.name, grant_of(enclave)
    if name not in wanted_rights:
        from sros_tool.keystore.rights import is_plain_router

        of_close = name == CLOSED_OBSERVER and folder_of_closed_robot(enclave.keystore.root)
        settings = enclave.keystore.settings
        if of_close or (grant and is_plain_router(settings, name, grant_rights(name, grant))):
            return
        yield NOT_IN_POLICY.found(name, "none of the given policies names it", str(enclave.folder))
        return
    if grant is None:
        return
    robot = robot_of(enclave.keystore.at.fleet, name) if enclave.keystore.at.fleet else None
    if robot and robot.domain is not None:
        signed, stated = grant.domains().closed(), DomainSet.of((robot.domain, robot.domain))
        if signed != stated:
            text = (
                f"the fleet file has {robot.name} in domain {stated}, but the permissions are "
                f"for domain {signed}"
            )
            yield STALE.found(
                name, text, enclave.file("permissions.p7s"), remedy=_SIGN_FOR_THE_FLEET
            )
    difference = compare(grant_rights(name, grant), wanted_rights[name])
    if difference:
        shown = [
            f"{sign} {right.qualifier} {right.describe()}" for sign, right in difference.lines()
        ]
        rights = first_few(shown, _RIGHTS_SHOWN, "; ")
        text = f"permissions (-) and policy (+) differ: {rights}"
        yield STALE.found(name, text, enclave.file("permissions.p7s"))


def wanted_rights(keystore: CheckedKeystore) -> dict[str, frozenset[Right]]:
    """Map each enclave of the given policies to its rights."""
    rights_by_enclave: dict[str, frozenset[Right]] = {}
    for policy in keystore.at.policies:
        rights = defaultdict(set)
        for right in policy_rights(policy):
            rights[right.enclave].add(right)
        for enclave in policy.enclaves:
            rights_by_enclave[enclave.path] = frozenset(rights[enclave.path])
    return rights_by_enclave
