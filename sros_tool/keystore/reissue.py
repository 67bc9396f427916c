"""Issues and signs everything of a keystore anew, by CAs that take the place of others."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime

from cryptography import x509

from sros_tool.dds.governance import parse_governance
from sros_tool.errors import KeystoreError, SrosError
from sros_tool.keystore.authority import Authority
from sros_tool.keystore.granted import read_granted
from sros_tool.keystore.issuance import Issuance, policies_of, renewed, teller
from sros_tool.keystore.layout import GOVERNANCE_P7S, enclave_folder
from sros_tool.keystore.ledger import Entry, document_entry
from sros_tool.keystore.parallel import Progress
from sros_tool.keystore.template import Template
from sros_tool.keystore.transaction import Transaction
from sros_tool.notes import Note
from sros_tool.pki import smime
from sros_tool.pki.certificates import issued_by, load_certificate, subject_text
from sros_tool.xml import read_bytes

__all__ = ["Progress", "Turn", "reissue"]


@dataclass(frozen=True, slots=True)
class Turn:
    """An authority that takes the place of another."""

    old: x509.Certificate
    new: Authority


@dataclass(frozen=True, slots=True)
class Reissued:
    """What the ledger is told, and remarks."""

    entries: tuple[Entry, ...]
    notes: tuple[Note, ...]


def reissue(
    transaction: Transaction,
    names: Sequence[str],
    identity: Turn | None,
    permissions: Turn | None,
    template: Template,
    now: datetime,
    progress: Progress | None = None,
) -> Reissued:
    """Stage what the CAs in turn have to issue: certificates, governance and permissions.

    Keys, subjects and rights stay.  What a CA that is not in turn has issued is left as it is, so
    its key is not needed.  Raises `KeystoreError` for an enclave that is not of the old CA.
    """
    work = _Reissuer(transaction, identity, permissions, template, now)
    entries = (*work.governance(names), *work.enclaves(names, progress))
    return Reissued(entries, work.notes)


class _Reissuer:
    def __init__(
        self,
        transaction: Transaction,
        identity: Turn | None,
        permissions: Turn | None,
        template: Template,
        now: datetime,
    ) -> None:
        self._transaction = transaction
        self._identity = identity
        self._permissions = permissions
        self._issuance = Issuance(
            transaction,
            template,
            now,
            identity=identity.new if identity else None,
            permissions=permissions.new if permissions else None,
        )
        self._now = now
        self._policies = policies_of(transaction.root)
        self.notes = self._issuance.notes

    def governance(self, names: Sequence[str]) -> list[Entry]:
        """Sign the keystore's governance anew, as it is, and that of enclaves with a copy."""
        if not self._permissions:
            return []
        copies = [f"{enclave_folder(name)}/governance.p7s" for name in names if name != "/"]
        entries = []
        for path in (GOVERNANCE_P7S, *copies):
            real = self._transaction.root / path
            if not real.is_file() or real.is_symlink():
                continue
            signed = smime.parse(read_bytes(real, "governance document"))
            signed.verify(self._permissions.old)
            document = signed.document.replace(b"\r\n", b"\n")
            message = self._permissions.new.sign(
                document, parse_governance(document), parse_governance, "the governance document"
            )
            self._transaction.write(path, message)
            entries.append(document_entry(self._now, "governance", message))
        return entries

    def enclaves(self, names: Sequence[str], progress: Progress | None) -> list[Entry]:
        """Issue and sign for all enclaves, on all cores."""
        self._issuance.spread(names, self._enclave, teller(progress))
        return self._issuance.entries

    def _enclave(self, name: str) -> None:
        folder = enclave_folder(name)
        path = self._transaction.root / folder / "cert.pem"
        if not path.exists():
            return  # its key waits for a certificate, which will be of the new CA
        try:
            certificate = load_certificate(read_bytes(path, "certificate"), f"'{path}'")
            if self._identity:
                if not issued_by(certificate, self._identity.old):
                    raise KeystoreError(
                        f"its certificate was not issued by the identity CA of this keystore but "
                        f"by {subject_text(certificate.issuer)}"
                    )
                certificate = self._issuance.certificate(
                    name,
                    certificate.subject,
                    certificate.public_key(),  # type: ignore[arg-type]
                )
            if self._permissions:
                self._sign_permissions(name, certificate, self._permissions)
        except SrosError as error:
            raise KeystoreError(
                f"enclave {name} cannot be moved to the new CA: {error.what}",
                error.why,
                error.remedy or f"See `sros inspect {path.parent}`; nothing was changed.",
            ) from error

    def _sign_permissions(self, name: str, certificate: x509.Certificate, turn: Turn) -> None:
        path = self._transaction.root / enclave_folder(name) / "permissions.p7s"
        if not path.exists():
            return
        subject = subject_text(certificate.subject)
        old = read_granted(path, subject)
        old.signed.verify(turn.old)
        if old.grant is None:
            raise KeystoreError(
                f"its permissions have no grant for {subject}",
                "They belong to another certificate.",
                f"Sign them anew with `sros create_permission {self._transaction.root} {name} "
                "POLICY_FILE`.",
            )
        policy = self._policies.get(old.digest, "")
        self._issuance.permissions(name, certificate, renewed(old.grant), policy)
