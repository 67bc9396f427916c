"""Answers to signing requests: all files that an enclave on a robot needs, except its key."""

from __future__ import annotations

from contextlib import nullcontext
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from shlex import quote

from cryptography import x509

from sros_tool.dds.portable import name_notes
from sros_tool.errors import KeystoreError, Note, PkiError, SrosError
from sros_tool.files import staged_file
from sros_tool.folders import Folder
from sros_tool.keystore.authorities.authority import load_authorities
from sros_tool.keystore.authorities.keyring import IN_KEYSTORE, Keyring
from sros_tool.keystore.delivery.answer import RequestAnswer, check_answer, seal
from sros_tool.keystore.delivery.archive import pack
from sros_tool.keystore.issuing.enclave import (
    EnclaveWriter,
    Issuance,
    Issued,
    NewIdentity,
    StatedRights,
    default_rights,
    link_shared_files,
    present_files,
    shared_files,
    stated_enclave,
)
from sros_tool.keystore.issuing.zenoh import KeptZenoh, keep_zenoh
from sros_tool.keystore.known_keys import KnownKeys
from sros_tool.keystore.layout import (
    CERTIFICATE_FILE,
    GOVERNANCE_FILE,
    GOVERNANCE_P7S,
    KEY_FILE,
    PERMISSIONS_FILE,
    REQUEST,
    SEAL,
    ZENOH_FILES,
    enclave_folder,
    enclave_path,
    list_enclaves,
)
from sros_tool.keystore.ledger import append, document_entry, read_ledger
from sros_tool.keystore.lifecycle.replaced import (
    EarlierPermissions,
    earlier_permissions,
    lasting_text,
    replaced_rights,
    rights_text,
)
from sros_tool.keystore.reader import (
    check_domain,
    load_governance,
    load_settings,
    read_certificate,
    read_signed_grant,
)
from sros_tool.keystore.recorded import EarlierRights, RecordedRights
from sros_tool.keystore.settings import edit_notes
from sros_tool.keystore.transaction.recovery import tidy
from sros_tool.keystore.transaction.stage import Change
from sros_tool.keystore.transaction.transaction import Transaction
from sros_tool.keystore.zenoh.wanted import ZenohChange
from sros_tool.names import check_enclave_name
from sros_tool.pki.certificates import enclave_subject, has_unique_part, pem, validity_of
from sros_tool.pki.certificates import subject_text as text_of
from sros_tool.pki.keys import holds_private_key, load_key
from sros_tool.pki.requests import SigningRequest, key_digest, load_request
from sros_tool.policy.model import Policy
from sros_tool.validity import iso
from sros_tool.xml import read_bytes


@dataclass(frozen=True, slots=True)
class Signed:
    """A signed request.

    ``key`` is the SHA-256 of the enclave's public key, ``identity_ca`` the certificate of the CA
    that the robot will trust, ``archive`` the answer for the robot (``.tar.gz``).
    """

    name: str
    key: str
    identity_ca: x509.Certificate
    archive: bytes
    renewed: bool
    changes: tuple[Change, ...]
    notes: tuple[Note, ...]


def sign_request(
    root: Path,
    data: bytes,
    *,
    now: datetime,
    policy: Policy | None = None,
    renew: bool = False,
    answer: Path | None = None,
    force: bool = False,
    domain: int | None = None,
    keyring: Keyring = IN_KEYSTORE,
    dry_run: bool = False,
) -> Signed:
    """Certify the key of a request, sign the permissions, and make the answer for the robot.

    The keystore gets all files of the enclave except the key.  The rights come from ``policy``.
    Without a policy they come from the present permissions if ``renew`` is set, otherwise from the
    keystore's template.

    Args:
        data: the request (PEM).
        answer: the path for the answer, which is put in place after the keystore has changed.
        force: replace ``answer`` if it exists.
        domain: refuse a keystore that is not made for this domain.

    Raises:
        PkiError: the request is not valid.
        KeystoreError: the enclave exists (without ``renew``) or does not (with it), its key was
            revoked or belongs to another enclave, ``answer`` exists, or the keystore cannot issue.
    """
    request = load_request(data, "that was given")
    name = check_enclave_name(request.name)
    stated = stated_enclave(policy, name) if policy else None
    if answer is not None:
        _check_free(answer, force)
    if not dry_run:
        tidy(root)
    list_enclaves(root)
    with Transaction(root, dry_run=dry_run) as transaction:
        existing = list_enclaves(root)
        _check_name(root, name, renew, name in existing)
        known = KnownKeys(root)
        _check_key(root, request, known, renew)
        template = load_settings(root)
        authorities = load_authorities(root, template, keyring, now)
        governance = load_governance(root, authorities.permissions.certificate)
        domains = governance.domains().closed()
        check_domain(domains, domain, root)
        notes = _new_key_note(root, request) or [*known.shared_notes([name])] if renew else []
        rights: EarlierRights | StatedRights
        if renew and stated is None:
            rights = _earlier_rights(root, name, authorities.permissions.certificate)
        else:
            rights = StatedRights(stated or default_rights(template, name), domains)
        writer = EnclaveWriter(
            transaction,
            template,
            now,
            identity=authorities.identity,
            permissions=authorities.permissions,
        )
        unique = template.unique_subject or (
            renew and has_unique_part(_present_certificate(root, name).subject)
        )
        identity = NewIdentity(enclave_subject(name, unique=unique), request.public_key)
        authority = authorities.permissions.certificate
        earlier = earlier_permissions(root, name, authority) if renew else None
        issued = writer.write(Issuance(name, identity, rights))
        if earlier:
            notes += _lost_rights(root, earlier, issued, now)
        transaction.write(f"{enclave_folder(name)}/{REQUEST}", request.pem)
        link_shared_files(transaction, name, present_files(root, name))
        notes += [*issued.notes(), *writer.notes, *edit_notes(root, governance)]
        permissions = authorities.permissions
        kept = keep_zenoh(
            transaction,
            template.zenoh,
            domains,
            permissions.certificate,
            lambda: permissions,
            now,
            ZenohChange(writer.grants, stated={name: stated}),
        )
        notes += kept.notes
        files = _answer_files(root, issued, kept)
        number = read_ledger(root).next_number()
        sealed = seal(files, number, authorities.permissions)
        _check_result(RequestAnswer(name, files, sealed), request, now)
        archive = pack({SEAL: sealed, **files})
        sent = document_entry(now, "answer", sealed, enclave=name, number=number)
        append(transaction, [*writer.entries, sent], authorities.identity, now)
        staged = staged_file(answer, archive) if answer and not dry_run else nullcontext()
        with staged as put_in_place:
            transaction.commit()
            if put_in_place:
                put_in_place()
    if not renew:
        notes += name_notes({*existing, name}, [name])
    return Signed(
        name,
        key_digest(request.public_key),
        authorities.identity.certificate,
        archive,
        renew,
        tuple(transaction.changes),
        tuple(notes),
    )


def _check_free(answer: Path, force: bool) -> None:
    if answer.exists() and not answer.is_file():
        raise KeystoreError(
            f"'{answer}' is in the way",
            "It is not a regular file.",
            "Choose another name with -o.",
        )
    if answer.exists() and not force:
        raise KeystoreError(
            f"'{answer}' already exists",
            "Nothing was changed.",
            "Add --force to replace it, or choose another name with -o.",
        )


def _check_name(root: Path, name: str, renew: bool, exists: bool) -> None:
    if exists and not renew:
        raise KeystoreError(
            f"enclave {name} exists already in keystore '{root}'",
            "The sender of the request would get the rights of this enclave.",
            "If that is intended, add --renew; otherwise create the request for another name.",
        )
    if renew and not exists:
        raise KeystoreError(
            f"enclave {name} does not exist in keystore '{root}'",
            "Only an existing enclave can be renewed.",
            "Leave --renew out.",
        )


def _check_key(root: Path, request: SigningRequest, known: KnownKeys, renew: bool) -> None:
    """Refuse a revoked key, the key of another enclave, and a key that does not fit the keystore.

    An enclave that already shares its key with another one is renewed with a note.
    """
    remedy = "Create a new key on the robot, with `sros create_request` in another folder."
    present = _present_certificate(root, request.name) if renew else None
    same = present if present and present.public_key() == request.public_key else None
    known.refuse_revoked(request.public_key, f"the request for {request.name}", remedy, same)
    if not same:
        known.refuse_second(request.public_key, request.name, remedy)
    path = enclave_path(root, request.name) / KEY_FILE
    if path.exists():
        key = load_key(read_bytes(path, "private key"), f"'{path}'")
        if key.public_key() != request.public_key:
            raise KeystoreError(
                f"enclave {request.name} has another key in keystore '{root}'",
                "Its key.pem would not fit a certificate for the key in the request.",
                f"Revoke the enclave first, with `sros revoke {quote(str(root))} {request.name}`.",
            )


def _check_result(answer: RequestAnswer, request: SigningRequest, now: datetime) -> None:
    """Raise `KeystoreError` if the robot would reject the answer."""
    try:
        check_answer(answer, request.public_key, now=now)
    except SrosError as error:
        raise KeystoreError(
            f"the robot would reject the answer for {answer.name}: {error.what}",
            error.why,
            "Nothing was changed. See `sros inspect` of the keystore.",
        ) from error


def _new_key_note(root: Path, request: SigningRequest) -> list[Note]:
    """Return a note if the request's key is not the key of the present certificate."""
    old = _present_certificate(root, request.name)
    if old.public_key() == request.public_key:
        return []
    until = iso(validity_of(old).not_after)
    return [
        Note(
            "request.new-key",
            f"{request.name}: the request has a new key. The certificate of the old key "
            f"stays valid until {until} for anyone who has that key.",
        )
    ]


def _lost_rights(
    root: Path, earlier: EarlierPermissions, issued: Issued, now: datetime
) -> list[Note]:
    """Return a note on rights that the enclave loses, and on what still works of them."""
    (grant,) = issued.permissions.grants
    replaced = replaced_rights(issued.issuance.name, earlier, grant, now)
    text = lasting_text(root, replaced)
    if not text:
        return []
    lost = f"{replaced.enclave} loses: {rights_text(replaced.lost)}."
    again = "Then answer its request again with `sros sign_request --renew`."
    return [Note("request.rights-lost", f"{lost} {text} {again}")]


def _earlier_rights(root: Path, name: str, authority: x509.Certificate) -> EarlierRights:
    """Return the rights in an enclave's present permissions, after verifying their signature."""
    subject = text_of(_present_certificate(root, name).subject)
    old = read_signed_grant(enclave_path(root, name) / PERMISSIONS_FILE, subject)
    old.signed.verify(authority)
    if old.grant is None:
        raise PkiError(
            f"the permissions of enclave {name} have no grant for {subject}",
            "They belong to another certificate.",
            "State the rights with -p POLICY_FILE.",
        )
    return RecordedRights(root).of(name, old.digest, old.grant)


def _present_certificate(root: Path, name: str) -> x509.Certificate:
    path = enclave_path(root, name) / CERTIFICATE_FILE
    return read_certificate(path)


def _answer_files(root: Path, issued: Issued, zenoh: KeptZenoh) -> dict[str, bytes]:
    """Map the paths of the answer's files to their content, sorted by path."""
    name = issued.issuance.name
    folder = enclave_folder(name)
    files = {
        f"{folder}/{CERTIFICATE_FILE}": pem(issued.certificate),
        f"{folder}/{PERMISSIONS_FILE}": issued.document,
    }
    shared = {GOVERNANCE_FILE: GOVERNANCE_P7S, **shared_files(root, name)}
    for file in ZENOH_FILES if name in zenoh.files else ():
        path = f"{folder}/{file}"
        if path in zenoh.written:
            files[path] = zenoh.written[path]
        elif (root / path).is_file():
            shared[file] = path
    with Folder(root) as opened:
        for file, source in shared.items():
            files[f"{folder}/{file}"] = data = opened.read_inside(source)
            if holds_private_key(data):
                raise KeystoreError(
                    f"'{root / source}' holds a private key",
                    "It would get into the answer, and so to the robot.",
                    "Remove the key from the file.",
                )
    return dict(sorted(files.items()))
