"""What an enclave without a policy may do: the default of the keystore's template."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import replace
from datetime import datetime
from enum import Enum
from functools import cache
from pathlib import Path

from cryptography import x509

from sros_tool.dds.domains import DomainSet
from sros_tool.dds.permissions import parse_permissions
from sros_tool.dds.portable import document_notes
from sros_tool.errors import KeystoreError, Note, SrosError
from sros_tool.keystore.authorities.authority import Authorities
from sros_tool.keystore.issuing.issuance import Issuance
from sros_tool.keystore.issuing.proof import FEW, proven
from sros_tool.keystore.layout import (
    CRL,
    ENCLAVES,
    IDENTITY,
    PERMISSIONS,
    PUBLIC,
    REQUEST,
    enclave_folder,
)
from sros_tool.keystore.template import Template
from sros_tool.keystore.transaction.transaction import Transaction
from sros_tool.parallel import Progress
from sros_tool.pki import smime
from sros_tool.pki.certificates import (
    common_name_of,
    enclave_subject,
    issued_by,
    load_certificate,
    subject_of,
    subject_text,
    validity_of,
)
from sros_tool.pki.keys import generate_key, key_pem, load_key
from sros_tool.policy import read_policy
from sros_tool.policy.model import Enclave
from sros_tool.resources import policies_dir
from sros_tool.validity import iso
from sros_tool.xml import read_bytes


@cache
def _default_policy(choice: str) -> Enclave:
    return read_policy(policies_dir() / "defaults" / f"{choice}.xml").enclaves[0]


def default_enclave(choice: str, name: str) -> Enclave:
    """The policy ``defaults/<choice>.xml`` for the enclave ``name``."""
    return replace(_default_policy(choice), path=name)


class Fate(Enum):
    """What became of an enclave."""

    CREATED = "created"
    CHANGED = "changed"
    COMPLETED = "completed"
    KEPT = "kept"


class Registrar:
    """Adds enclaves to one transaction; ``entries`` are for the ledger, ``notes`` are remarks."""

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
        self._issuance = Issuance(
            transaction,
            template,
            now,
            identity=authorities.identity,
            permissions=authorities.permissions,
        )
        self._template = template
        self._domains = domains
        self._now = now
        self._has_crl = (transaction.root / CRL).exists()
        self._few = False
        self.notes: list[Note] = []
        self.entries = self._issuance.entries

    def register_all(
        self, wanted: Sequence[tuple[str, Enclave | None]], progress: Progress | None
    ) -> dict[str, Fate]:
        """Make or complete each enclave; with a policy, give it those permissions."""
        self._few = len(wanted) <= FEW

        def work(item: tuple[str, Enclave | None]) -> tuple[Fate, list[Note]]:
            notes: list[Note] = []
            return self._register(*item, notes), notes

        def told(item: tuple[str, Enclave | None], _: object) -> None:
            if progress:
                progress(item[0])

        done = self._issuance.spread(wanted, work, told)
        self.notes += [note for _, notes in done for note in notes]
        if self.entries:
            self.notes += self._issuance.notes
        return {name: fate for (name, _), (fate, _) in zip(wanted, done, strict=True)}

    def _register(self, name: str, policy: Enclave | None, notes: list[Note]) -> Fate:
        folder = enclave_folder(name)
        present = self._present(folder)
        before = len(self._transaction.changes)
        certificate = self._identity(name, folder, present)
        self._links(folder, present)
        if policy is not None or "permissions.p7s" not in present:
            self._permissions(name, policy, certificate, notes)
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
        return self._issuance.certificate(name, subject, public)

    def _subject_of_permissions(self, folder: str, otherwise: x509.Name) -> x509.Name:
        """The subject of this name that the permissions of an enclave are signed for."""
        path = self._transaction.root / folder / "permissions.p7s"
        try:
            signed = smime.parse(read_bytes(path, "permissions document"))
            signed.verify(self._authorities.permissions.certificate)
            subjects = [
                subject_of(grant.subject)
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
        self, name: str, policy: Enclave | None, certificate: x509.Certificate, notes: list[Note]
    ) -> None:
        enclave = policy or default_enclave(self._template.default_permissions, name)
        if len(enclave.profiles) > 1:
            notes.append(
                Note(
                    "policy.several-profiles",
                    f"{name}: the rights of its {len(enclave.profiles)} <profiles> are joined. "
                    "ros2/sros2 makes a grant of each, of which DDS reads only the first.",
                )
            )
        make = proven(enclave, self._domains, ask=self._few)
        permissions, message = self._issuance.permissions(name, certificate, make, enclave.digest)
        notes += document_notes(name, permissions, len(message))
