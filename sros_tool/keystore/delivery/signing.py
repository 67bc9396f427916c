"""Answers the signing request of a robot: all that its enclave needs but the key it has."""

from __future__ import annotations

from contextlib import nullcontext
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path

from cryptography import x509

from sros_tool.dds.domains import DomainSet
from sros_tool.dds.portable import document_notes, name_notes
from sros_tool.errors import KeystoreError, Note, PkiError, PolicyError, SrosError
from sros_tool.keystore.authorities.authority import Authorities, load_authorities
from sros_tool.keystore.authorities.keyring import IN_KEYSTORE, Keyring
from sros_tool.keystore.delivery.answer import SEAL, Answer, check_answer, seal
from sros_tool.keystore.delivery.archive import pack, staged_file
from sros_tool.keystore.issuing.enclave import default_enclave
from sros_tool.keystore.issuing.issuance import Issuance, Make, policies_of, renewed
from sros_tool.keystore.issuing.proof import proven
from sros_tool.keystore.layout import (
    CRL,
    ENCLAVES,
    GOVERNANCE_P7S,
    REQUEST,
    REVOKED,
    ROLES,
    ca_certificate,
    enclave_folder,
    list_enclaves,
)
from sros_tool.keystore.ledger import Entry, append, document_entry
from sros_tool.keystore.reader import check_domain, load_governance, load_settings, read_granted
from sros_tool.keystore.template import Template
from sros_tool.keystore.transaction.recovery import tidy
from sros_tool.keystore.transaction.stage import Change
from sros_tool.keystore.transaction.transaction import Transaction
from sros_tool.names import check_enclave_name
from sros_tool.pki.certificates import enclave_subject, load_certificate, pem, validity_of
from sros_tool.pki.certificates import subject_text as text_of
from sros_tool.pki.keys import load_key
from sros_tool.pki.requests import SigningRequest, key_digest, load_request
from sros_tool.policy.model import Enclave, Policy
from sros_tool.validity import iso
from sros_tool.xml import read_bytes


@dataclass(frozen=True, slots=True)
class Signed:
    """A request that was answered; ``archive`` is the answer for the robot, as `.tar.gz`.

    ``identity_ca`` is the certificate of the CA that the robot is going to trust.
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

    The keystore gets everything but the key.  The rights are those that ``policy`` states; else,
    with ``renew``, those that are signed already; else the default of the keystore's template.
    ``answer`` is the file that the answer goes to, which appears after the keystore has changed.
    """
    request = load_request(data, "that was given")
    name = check_enclave_name(request.name)
    enclave = policy.enclave(name) if policy else None
    if policy and enclave is None:
        there = ", ".join(each.path for each in policy.enclaves)
        raise PolicyError(
            f"unable to find enclave {name} in the policy '{policy.file}'", f"It has {there}."
        )
    if answer is not None:
        _check_free(answer, force)
    if not dry_run:
        tidy(root)
    list_enclaves(root)
    with Transaction(root, dry_run=dry_run) as transaction:
        existing = list_enclaves(root)
        _check_name(root, name, renew, name in existing)
        _check_key(root, request)
        template = load_settings(root)
        authorities = load_authorities(root, template, keyring, now)
        domains = load_governance(root, authorities.permissions.certificate).domains().closed()
        check_domain(domains, domain, root)
        work = _Signer(transaction, authorities, template, domains, now)
        prepared = work.sign(request, enclave, renew=renew)
        notes, sealed = prepared.notes, seal(prepared.files, authorities.permissions)
        _check_result(Answer(name, prepared.files, sealed), request, now)
        archive = pack({SEAL: sealed, **prepared.files})
        sent = document_entry(now, "answer", sealed, enclave=name)
        append(transaction, [*prepared.entries, sent])
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
        raise KeystoreError(f"'{answer}' is in the way", "It is not a regular file.")
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
            "Whoever sent the request would get its rights.",
            "If that is meant, add --renew; otherwise have the request made for another name.",
        )
    if renew and not exists:
        raise KeystoreError(
            f"enclave {name} does not exist in keystore '{root}'",
            "There is nothing to renew.",
            "Leave --renew out.",
        )


def _check_key(root: Path, request: SigningRequest) -> None:
    """Refuse a key that was revoked, and one beside which the keystore has another."""
    for path in sorted((root / REVOKED).glob("*/cert.pem")):
        certificate = load_certificate(read_bytes(path, "certificate"), f"'{path}'")
        if certificate.public_key() == request.public_key:
            raise KeystoreError(
                f"the key of the request for {request.name} was revoked",
                f"It is that of the certificate {certificate.serial_number:x} of "
                f"{text_of(certificate.subject)}.",
                "Have a new key made on the robot, in another folder.",
            )
    path = root / enclave_folder(request.name) / "key.pem"
    if path.exists():
        key = load_key(read_bytes(path, "private key"), f"'{path}'")
        if key.public_key() != request.public_key:
            raise KeystoreError(
                f"enclave {request.name} has another key in keystore '{root}'",
                "Its key.pem would be useless with the certificate of the request.",
                f"Revoke the enclave first, with `sros revoke {root} {request.name}`.",
            )


def _check_result(answer: Answer, request: SigningRequest, now: datetime) -> None:
    """See that the robot will accept the answer, before anybody relies on it."""
    try:
        check_answer(answer, request.public_key, now=now)
    except SrosError as error:
        raise KeystoreError(
            f"the answer for {answer.name} would be of no use on the robot: {error.what}",
            error.why,
            "Nothing was changed; `sros inspect` tells more of the keystore.",
        ) from error


@dataclass(frozen=True, slots=True)
class _Prepared:
    """The files of the answer by their paths, what the ledger is told, and remarks."""

    files: dict[str, bytes]
    entries: list[Entry]
    notes: list[Note]


class _Signer:
    """Puts what a request asks for into a transaction."""

    def __init__(
        self,
        transaction: Transaction,
        authorities: Authorities,
        template: Template,
        domains: DomainSet,
        now: datetime,
    ) -> None:
        self._transaction = transaction
        self._root = transaction.root
        self._authorities = authorities
        self._issuance = Issuance(
            transaction,
            template,
            now,
            identity=authorities.identity,
            permissions=authorities.permissions,
        )
        self._template = template
        self._domains = domains

    def sign(self, request: SigningRequest, enclave: Enclave | None, *, renew: bool) -> _Prepared:
        """Stage the enclave."""
        name, folder = request.name, enclave_folder(request.name)
        notes = self._new_key(request) if renew else []
        made, policy = self._rights(name, enclave, renew)
        certificate = self._issuance.certificate(
            name, enclave_subject(name, unique=self._template.unique_subject), request.public_key
        )
        permissions, message = self._issuance.permissions(name, certificate, made, policy)
        self._transaction.write(f"{folder}/{REQUEST}", request.pem)
        files = {f"{folder}/cert.pem": pem(certificate), f"{folder}/permissions.p7s": message}
        files |= self._shared(folder)
        notes += document_notes(name, permissions, len(message))
        notes += self._issuance.notes
        return _Prepared(dict(sorted(files.items())), self._issuance.entries, notes)

    def _new_key(self, request: SigningRequest) -> list[Note]:
        old = self._certificate(request.name)
        if old.public_key() == request.public_key:
            return []
        until = iso(validity_of(old).not_after)
        return [
            Note(
                "request.new-key",
                f"{request.name}: the request has a new key. The certificate of the earlier one "
                f"stays valid until {until}, for whoever has that key.",
            )
        ]

    def _rights(self, name: str, enclave: Enclave | None, renew: bool) -> tuple[Make, str]:
        """What makes the permissions, and the digest of the policy that it comes from."""
        if enclave is None and renew:
            subject = text_of(self._certificate(name).subject)
            old = read_granted(self._root / enclave_folder(name) / "permissions.p7s", subject)
            old.signed.verify(self._authorities.permissions.certificate)
            if old.grant is None:
                raise PkiError(
                    f"the permissions of enclave {name} have no grant for {subject}",
                    "They belong to another certificate.",
                    "State the rights with -p POLICY_FILE.",
                )
            return renewed(old.grant), policies_of(self._root).get(old.digest, "")
        meant = enclave or default_enclave(self._template.default_permissions, name)
        return proven(meant, self._domains, ask=True), meant.digest

    def _certificate(self, name: str) -> x509.Certificate:
        path = self._root / enclave_folder(name) / "cert.pem"
        return load_certificate(read_bytes(path, "certificate"), f"'{path}'")

    def _shared(self, folder: str) -> dict[str, bytes]:
        """Link what all enclaves share, where that is missing, and return it for the answer."""
        up = "../" * folder.count("/")
        sources = {f"{role}_ca.cert.pem": (ca_certificate(role), "../") for role in ROLES}
        if (self._root / CRL).exists():
            sources["crl.pem"] = (CRL, "../")
        found = {}
        for file, (source, above) in sources.items():
            path = f"{folder}/{file}"
            if not (self._root / path).exists():
                self._transaction.link(path, f"{up}{above}{source}")
            found[path] = read_bytes(self._root / source, "file")
        path = f"{folder}/governance.p7s"
        if folder != ENCLAVES and not (self._root / path).exists():
            self._transaction.link(path, f"{up}governance.p7s")
        found[path] = read_bytes(self._root / GOVERNANCE_P7S, "governance document")
        return found
