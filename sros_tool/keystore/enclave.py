"""Puts enclaves into a keystore: key, certificate, links and signed permissions."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from datetime import datetime
from enum import Enum
from pathlib import Path

from cryptography import x509

from sros_tool.dds.domains import DomainSet
from sros_tool.dds.permissions import parse_permissions, render_permissions
from sros_tool.dds.portable import document_notes
from sros_tool.errors import KeystoreError, SrosError
from sros_tool.keystore.authority import Authorities
from sros_tool.keystore.defaults import default_enclave
from sros_tool.keystore.layout import (
    CRL,
    ENCLAVES,
    IDENTITY,
    PERMISSIONS,
    PUBLIC,
    REQUEST,
    enclave_folder,
)
from sros_tool.keystore.ledger import Entry, certificate_entry, document_entry
from sros_tool.keystore.parallel import in_shares
from sros_tool.keystore.template import Template
from sros_tool.keystore.transaction import Change, Transaction
from sros_tool.notes import Note
from sros_tool.pki import smime
from sros_tool.pki.certificates import (
    common_name_of,
    enclave_subject,
    issued_by,
    load_certificate,
    pem,
    subject_text,
    validity_of,
)
from sros_tool.pki.keys import generate_key, key_pem, load_key
from sros_tool.pki.token import TokenKey
from sros_tool.policy.model import Enclave
from sros_tool.translate import permissions_for
from sros_tool.validity import iso, window
from sros_tool.xml import read_bytes


class Fate(Enum):
    """What became of an enclave."""

    CREATED = "created"
    CHANGED = "changed"
    COMPLETED = "completed"
    KEPT = "kept"


Progress = Callable[[str], None]
"""Told the name of each enclave when it is done."""


@dataclass(slots=True)
class Outcome:
    """What became of each enclave of a share, with remarks, staged files and ledger entries."""

    fates: list[tuple[str, Fate]]
    notes: list[Note]
    changes: list[Change]
    entries: list[Entry]


class Registrar:
    """Adds enclaves to one transaction."""

    def __init__(
        self,
        transaction: Transaction,
        authorities: Authorities,
        template: Template,
        domains: DomainSet,
        now: datetime,
    ) -> None:
        self._transaction = transaction
        self._authorities = authorities
        self._issuer = authorities.identity.issuer()
        self._template = template
        self._domains = domains
        self._now = now
        self._certificate_validity = window(now, template.certificate_validity)
        self._permissions_validity = window(now, template.permissions_validity).within(
            validity_of(authorities.permissions.certificate)
        )
        self._notes: list[Note] = []
        self._entries: list[Entry] = []
        self._has_crl = (transaction.root / CRL).exists()

    def register_all(
        self, wanted: Sequence[tuple[str, Enclave | None]], progress: Progress | None
    ) -> list[Outcome]:
        """Make or complete each enclave; with a policy, give it those permissions."""
        outcomes = []
        own = os.getpid()

        def work(share: Sequence[tuple[str, Enclave | None]]) -> Outcome:
            before = len(self._transaction.changes)
            fates = []
            for name, enclave in share:
                fates.append((name, self._register(name, enclave)))
                if progress and os.getpid() == own:
                    progress(name)
            changes = self._transaction.changes[before:]
            return Outcome(fates, self._notes, changes, self._entries)

        # A session with a token does not survive a fork.
        keys = (self._authorities.identity.key, self._authorities.permissions.key)
        alone = any(isinstance(key, TokenKey) for key in keys)
        shares = [(wanted, work(wanted))] if alone else in_shares(wanted, work)
        for index, (share, outcome) in enumerate(shares):
            if index:  # the first share was done here, the others by other processes
                self._transaction.absorb(outcome.changes)
                for name, _ in share:
                    if progress:
                        progress(name)
            outcomes.append(outcome)
        return outcomes

    def _register(self, name: str, policy: Enclave | None) -> Fate:
        folder = enclave_folder(name)
        present = self._present(folder)
        before = len(self._transaction.changes)
        certificate = self._identity(name, folder, present)
        self._links(folder, present)
        if policy is not None or "permissions.p7s" not in present:
            self._permissions(name, folder, policy, certificate)
        if not present & {"key.pem", REQUEST}:
            return Fate.CREATED
        if "permissions.p7s" in present and policy is not None:
            return Fate.CHANGED
        return Fate.COMPLETED if len(self._transaction.changes) > before else Fate.KEPT

    def _present(self, folder: str) -> set[str]:
        path = os.path.join(self._transaction.root, folder)
        try:
            names = os.listdir(path)
        except FileNotFoundError:
            return set()
        # A link that leads nowhere is a file that is missing.
        return {name for name in names if Path(path, name).exists()}

    def _identity(self, name: str, folder: str, present: set[str]) -> x509.Certificate:
        if "cert.pem" in present and present & {"key.pem", REQUEST}:
            return self._existing(name, folder)
        if "cert.pem" in present:
            raise KeystoreError(
                f"enclave {name} has a certificate but no key",
                "Its key.pem is missing, and a new key would make the certificate useless.",
                f"Restore the key, or remove '{self._transaction.root / folder}/cert.pem' to have "
                "both made anew.",
            )
        if "key.pem" in present:
            path = self._transaction.root / folder / "key.pem"
            key = load_key(read_bytes(path, "private key"), f"'{path}'")
            public = key.public_key()
        else:
            new = generate_key()
            public = new.public_key()
            self._transaction.write(f"{folder}/key.pem", key_pem(new), private=True)
        subject = enclave_subject(name, unique=self._template.unique_subject)
        if "permissions.p7s" in present:
            subject = self._subject_of_permissions(folder, subject)
        certificate = self._issuer.issue(subject, public, self._certificate_validity)
        self._transaction.write(f"{folder}/cert.pem", pem(certificate))
        self._entries.append(certificate_entry(self._now, "certificate", certificate, name))
        return certificate

    def _subject_of_permissions(self, folder: str, otherwise: x509.Name) -> x509.Name:
        """The subject of this name that the permissions of an enclave are signed for."""
        path = self._transaction.root / folder / "permissions.p7s"
        try:
            signed = smime.parse(read_bytes(path, "permissions document"))
            signed.verify(self._authorities.permissions.certificate)
            subjects = [
                x509.Name.from_rfc4514_string(grant.subject)
                for grant in parse_permissions(signed.document, f"'{path}'").grants
            ]
        except (SrosError, ValueError):
            return otherwise  # they cannot be used with any certificate
        own = common_name_of(otherwise)
        return next((each for each in subjects if common_name_of(each) == own), otherwise)

    def _existing(self, name: str, folder: str) -> x509.Certificate:
        path = self._transaction.root / folder / "cert.pem"
        certificate = load_certificate(read_bytes(path, "certificate"), f"'{path}'")
        if not issued_by(certificate, self._authorities.identity.certificate):
            raise KeystoreError(
                f"the certificate of enclave {name} was not issued by the identity CA of this "
                "keystore",
                f"'{path}' names {subject_text(certificate.issuer)} as its issuer, so no node of "
                "this keystore would talk to it.",
                "Restore the right certificate, or remove the enclave's folder and make it anew.",
            )
        validity = validity_of(certificate)
        if not validity.contains(self._now):
            raise KeystoreError(
                f"the certificate of enclave {name} is not valid now",
                f"It is valid from {iso(validity.not_before)} to {iso(validity.not_after)}.",
                f"Renew it with `sros renew {self._transaction.root} {name}`.",
            )
        return certificate

    def _links(self, folder: str, present: set[str]) -> None:
        up = "../" * folder.count("/")
        for role in (IDENTITY, PERMISSIONS):
            name = f"{role}_ca.cert.pem"
            if name not in present:
                self._transaction.link(f"{folder}/{name}", f"{up}../{PUBLIC}/{name}")
        if "governance.p7s" not in present and folder != ENCLAVES:
            self._transaction.link(f"{folder}/governance.p7s", f"{up}governance.p7s")
        if self._has_crl and "crl.pem" not in present:
            self._transaction.link(f"{folder}/crl.pem", f"{up}../{CRL}")

    def _permissions(
        self, name: str, folder: str, policy: Enclave | None, certificate: x509.Certificate
    ) -> None:
        enclave = policy or default_enclave(self._template.default_permissions, name)
        if len(enclave.profiles) > 1:
            self._notes.append(
                Note(
                    "policy.several-profiles",
                    f"{name}: the rights of its {len(enclave.profiles)} <profiles> are joined. "
                    "ros2/sros2 makes a grant of each, of which DDS reads only the first.",
                )
            )
        subject = subject_text(certificate.subject)
        validity = self._permissions_validity.within(validity_of(certificate))
        permissions = permissions_for(
            enclave, subject=subject, validity=validity, domains=self._domains
        )
        document = render_permissions(permissions)
        message = self._authorities.permissions.sign(
            document, permissions, parse_permissions, f"the permissions of {name}"
        )
        self._transaction.write(f"{folder}/permissions.xml", document)
        self._transaction.write(f"{folder}/permissions.p7s", message)
        self._entries.append(
            document_entry(
                self._now,
                "permissions",
                message,
                enclave=name,
                subject=subject,
                validity=validity,
                policy=enclave.digest,
            )
        )
        self._notes += document_notes(name, permissions, len(message))


def enclave_path(root: Path, name: str) -> Path:
    """The folder of an enclave of a keystore."""
    return root / enclave_folder(name)
