"""Adoption of a flat keystore, of ROS 2 Eloquent or earlier, by a new keystore of today's layout.

The new keystore has the same CA, keys, certificates and governance; an enclave has the name of its
node.  Permissions are signed again, because those of ros2/sros2 0.6 to 0.8 expired in October 2023
and lack ``ros_discovery_info``, without which no node since Foxy starts.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from datetime import datetime
from pathlib import Path
from shlex import quote

from cryptography import x509

from sros_tool.dds.governance import Governance, parse_governance
from sros_tool.dds.permissions import Criteria, Grant, Rule, parse_permissions
from sros_tool.errors import InvalidNameError, KeystoreError, Note, PkiError, SrosError
from sros_tool.folders import Folder
from sros_tool.keystore.authorities.authority import Authority
from sros_tool.keystore.authorities.imported import check_imported
from sros_tool.keystore.authorities.keyring import IN_KEYSTORE, Keyring
from sros_tool.keystore.issuing.enclave import (
    EnclaveWriter,
    Issuance,
    NewIdentity,
    link_shared_files,
)
from sros_tool.keystore.layout import (
    CERTIFICATE_FILE,
    EARLIER_CA,
    EARLIER_CA_KEY,
    GOVERNANCE_FILE,
    GOVERNANCE_P7S,
    GOVERNANCE_XML,
    IDENTITY,
    KEY_FILE,
    PERMISSIONS,
    PERMISSIONS_FILE,
    PRIVATE,
    PUBLIC,
    ROLES,
    ca_certificate,
    ca_key,
    earlier_nodes,
    enclave_folder,
    is_earlier_keystore,
    is_keystore,
)
from sros_tool.keystore.ledger import Entry, append, certificate_entry, document_entry
from sros_tool.keystore.lifecycle.create import Creation, check_free, place_notes
from sros_tool.keystore.recorded import EarlierRights
from sros_tool.keystore.settings import write_settings
from sros_tool.keystore.template import Template, load_template
from sros_tool.keystore.transaction.recovery import tidy
from sros_tool.keystore.transaction.transaction import Transaction
from sros_tool.names import ROS_DISCOVERY_TOPIC, check_enclave_name
from sros_tool.parallel import Progress
from sros_tool.pki import smime
from sros_tool.pki.certificates import (
    issued_by,
    load_certificate,
    other_issuer,
    pem,
    same_key,
    subject_text,
    validity_of,
)
from sros_tool.pki.keys import PublicKey, load_key
from sros_tool.translate import governance_for, protection_for
from sros_tool.validity import iso


@dataclass(frozen=True, slots=True)
class _Node:
    """The files of a node that its enclave gets, verified.

    ``rights`` are those of its permissions, as every ROS 2 since Foxy needs them.
    """

    name: str
    key: bytes
    certificate: x509.Certificate
    rights: Grant


@dataclass(frozen=True, slots=True)
class _EarlierKeystore:
    """A flat keystore, read and verified."""

    authority: Authority
    key: bytes
    bundle: bytes
    governance: Governance
    signed_governance: bytes
    governance_document: bytes
    nodes: tuple[_Node, ...]
    notes: tuple[Note, ...]


def adopt_keystore(
    root: Path,
    earlier: Path,
    *,
    now: datetime,
    keyring: Keyring = IN_KEYSTORE,
    dry_run: bool = False,
    progress: Progress | None = None,
) -> Creation:
    """Create the keystore ``root`` with the CA, keys and rights of the flat keystore ``earlier``.

    ``earlier`` does not change.  Nothing is taken from outside of it, also not through a link.

    Raises:
        KeystoreError: ``root`` exists; or ``earlier`` is no flat keystore, or a node in it cannot
            be taken over: the error names all of them.
        PkiError: no DDS vendor accepts the CA.
    """
    if not dry_run:
        tidy(root)
    check_free(root)
    if not is_earlier_keystore(earlier):
        if is_keystore(earlier):
            raise KeystoreError(
                f"'{earlier}' is a keystore of ROS 2 Foxy or later",
                "It is used as it is: there is nothing to take over, and no other keystore to "
                "create.",
                f"Name it where a verb takes a keystore, as in `sros check {quote(str(earlier))}`.",
            )
        raise KeystoreError(
            f"'{earlier}' is not a keystore of ROS 2 Eloquent or earlier",
            f"It has neither {EARLIER_CA} nor {EARLIER_CA_KEY}.",
            "Name the folder that has them.",
        )
    with Folder(earlier) as folder:
        old = _read_keystore(folder, keyring, now)
    domains = old.governance.domains().closed()
    authority = old.authority
    template, settings = _settings(old)
    with Transaction(root, fresh=True, dry_run=dry_run) as transaction:
        check_free(root)  # another process may have created it meanwhile
        entries = [certificate_entry(now, "ca", authority.certificate)]
        transaction.write(f"{PUBLIC}/ca.cert.pem", old.bundle)
        transaction.write(f"{PRIVATE}/ca.key.pem", old.key, private=True)
        for role in ROLES:
            transaction.link(ca_certificate(role), "ca.cert.pem")
            transaction.link(ca_key(role), "ca.key.pem")
        transaction.write(GOVERNANCE_XML, old.governance_document)
        transaction.write(GOVERNANCE_P7S, old.signed_governance)
        entries.append(document_entry(now, "governance", old.signed_governance))
        if settings:
            entries.append(write_settings(transaction, settings, now))
        writer = EnclaveWriter(
            transaction, template, now, identity=authority, permissions=authority
        )
        nodes = {node.name: node for node in old.nodes}

        def adopt(name: str) -> tuple[Entry | None, tuple[Note, ...]]:
            return _write_node(transaction, writer, nodes[name], now)

        done = writer.for_each(list(nodes), adopt, progress)
        entries += [entry for entry, _ in done.values() if entry]
        if settings:
            append(transaction, [*entries, *writer.entries], authority, now)
        transaction.commit()
    return Creation(
        root,
        template,
        domains,
        True,
        created=tuple(nodes),
        changes=transaction.changes,
        notes=(
            *old.notes,
            *(note for _, notes in done.values() for note in notes),
            *(writer.notes if nodes else ()),
            *place_notes(root),
        ),
    )


def _write_node(
    transaction: Transaction, writer: EnclaveWriter, node: _Node, now: datetime
) -> tuple[Entry | None, tuple[Note, ...]]:
    """Stage the enclave of a node; return the ledger entry of a certificate that it keeps."""
    folder = enclave_folder(node.name)
    transaction.write(f"{folder}/{KEY_FILE}", node.key, private=True)
    certificate, entry, notes = node.certificate, None, []
    if validity_of(certificate).not_after < now:
        public: PublicKey = certificate.public_key()  # type: ignore[assignment]
        identity: NewIdentity | x509.Certificate = NewIdentity(certificate.subject, public)
        text = f"{node.name} has a new certificate for its key: that of its node has expired."
        notes.append(Note("adopt.new-certificate", text))
    else:
        identity = certificate
        transaction.write(f"{folder}/{CERTIFICATE_FILE}", pem(certificate))
        entry = certificate_entry(now, "certificate", certificate, node.name)
    issued = writer.write(Issuance(node.name, identity, EarlierRights(node.rights, "")))
    link_shared_files(transaction, node.name, ())
    return entry, (*notes, *issued.notes())


def _settings(old: _EarlierKeystore) -> tuple[Template, Template | None]:
    """Return the template for what is issued now, and the settings that the keystore gets.

    These are None if no settings can state its governance; without them it is continued as one that
    ros2/sros2 made.
    """
    template = load_template("sros2")
    protection = protection_for(old.governance)
    if protection is None:
        return template, None
    template = replace(template, protection=protection)
    same = governance_for(protection, old.governance.domains()) == old.governance
    return template, template if same else None


# ── reading ────────────────────────────────────────────────────────────────────────────────


def _read_keystore(folder: Folder, keyring: Keyring, now: datetime) -> _EarlierKeystore:
    root = folder.path
    bundle, key_data = _read(folder, EARLIER_CA), _read(folder, EARLIER_CA_KEY)
    path = f"'{root / EARLIER_CA_KEY}'"
    key = load_key(key_data, path, lambda: keyring.secrets("the passphrase of the CA key"))
    imported = {role: check_imported(role, bundle, key, now) for role in (IDENTITY, PERMISSIONS)}
    found = imported[IDENTITY]
    authority = Authority(found.certificate, key)
    message = _read(folder, GOVERNANCE_FILE)
    try:
        signed = smime.parse(message)
        signed.verify(found.certificate)
        governance = parse_governance(signed.document, f"'{root / GOVERNANCE_FILE}'")
    except SrosError as error:
        raise KeystoreError(
            f"the governance of '{root}' cannot be used: {error.what}",
            error.why,
            error.remedy or "Restore it from a backup.",
        ) from error
    nodes, faults = [], []
    for name in earlier_nodes(root):
        try:
            nodes.append(_read_node(folder, name, found.certificate, governance, now))
        except SrosError as error:
            faults.append(f"{name}: {error.what}. {error.why}".rstrip(". "))
    if faults:
        raise KeystoreError(
            f"{_count(len(faults), 'node')} of '{root}' cannot be taken over",
            f"{'; '.join(faults)}.",
            "Correct them, or move their folders out of it, and create their enclaves later.",
        )
    notes = dict.fromkeys(note for each in imported.values() for note in each.notes)
    return _EarlierKeystore(
        authority,
        key_data,
        found.bundle,
        governance,
        message,
        signed.document,
        tuple(nodes),
        tuple(notes),
    )


def _read(folder: Folder, path: str) -> bytes:
    try:
        return folder.read_inside(path)
    except OSError as error:
        raise KeystoreError(
            f"'{folder.path / path}' cannot be read",
            f"{error.strerror}.",
            "Restore it from a backup.",
        ) from error


def _count(number: int, noun: str) -> str:
    return f"{number} {noun}{'s' * (number != 1)}"


def _read_node(
    folder: Folder,
    name: str,
    authority: x509.Certificate,
    governance: Governance,
    now: datetime,
) -> _Node:
    """Return a node of a flat keystore; raise `SrosError` if its enclave would not work."""
    inside = name.lstrip("/")
    try:
        check_enclave_name(name)
    except InvalidNameError as error:
        raise KeystoreError("no enclave can have this name", error.why) from error
    key_data = _read(folder, f"{inside}/{KEY_FILE}")
    certificate = load_certificate(_read(folder, f"{inside}/{CERTIFICATE_FILE}"), CERTIFICATE_FILE)
    if not issued_by(certificate, authority):
        raise KeystoreError(
            "the CA of the keystore did not issue its certificate",
            f"Its issuer is {other_issuer(certificate, authority)}.",
        )
    if not same_key(certificate, load_key(key_data, KEY_FILE)):
        raise PkiError(f"its {KEY_FILE} is not the key of its {CERTIFICATE_FILE}")
    begin = validity_of(certificate).not_before
    if begin > now:
        raise KeystoreError(f"its certificate is not valid before {iso(begin)}")
    signed = smime.parse(_read(folder, f"{inside}/{PERMISSIONS_FILE}"))
    signed.verify(authority)
    subject = subject_text(certificate.subject)
    grant = parse_permissions(signed.document, PERMISSIONS_FILE).grant_of(subject)
    if grant is None:
        raise KeystoreError(f"its {PERMISSIONS_FILE} has no grant for {subject}")
    return _Node(name, key_data, certificate, _completed(grant, governance))


def _completed(grant: Grant, governance: Governance) -> Grant:
    """Return the grant as nodes since Foxy need it, with the same rights in ROS terms.

    Every allow rule gets ``ros_discovery_info``.  ros2/sros2 0.6 and 0.7 doubled the slash of a
    private name (``~/name``); no topic has such a name.
    """
    rules = [_single_slashes(rule) for rule in grant.rules]
    if not any(rule.allow for rule in rules):
        rules.append(Rule(True, governance.domains().closed()))
    discovery = (Criteria((ROS_DISCOVERY_TOPIC,)),)
    return replace(
        grant,
        rules=tuple(
            replace(
                rule,
                publish=_with(rule.publish, discovery),
                subscribe=_with(rule.subscribe, discovery),
            )
            if rule.allow
            else rule
            for rule in rules
        ),
    )


def _with(present: Sequence[Criteria], added: tuple[Criteria, ...]) -> tuple[Criteria, ...]:
    there = {topic for each in present if not each.partitions for topic in each.topics}
    return (*present, *(each for each in added if not there.issuperset(each.topics)))


def _single_slashes(rule: Rule) -> Rule:
    def corrected(all_criteria: Sequence[Criteria]) -> Iterator[Criteria]:
        for each in all_criteria:
            topics = tuple(topic.replace("//", "/") for topic in each.topics)
            yield replace(each, topics=topics)

    publish, subscribe = tuple(corrected(rule.publish)), tuple(corrected(rule.subscribe))
    return replace(rule, publish=publish, subscribe=subscribe)
