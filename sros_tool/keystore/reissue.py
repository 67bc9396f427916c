"""Issues and signs everything of a keystore anew, by CAs that take the place of others."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from datetime import datetime

from cryptography import x509

from sros_tool.dds.governance import parse_governance
from sros_tool.dds.permissions import Permissions, parse_permissions, render_permissions
from sros_tool.errors import KeystoreError, SrosError
from sros_tool.keystore.authority import Authority
from sros_tool.keystore.layout import GOVERNANCE_P7S, enclave_folder
from sros_tool.keystore.ledger import Entry, certificate_entry, document_entry, read_ledger
from sros_tool.keystore.parallel import in_shares
from sros_tool.keystore.template import Template
from sros_tool.keystore.transaction import Change, Transaction
from sros_tool.pki import smime
from sros_tool.pki.certificates import issued_by, load_certificate, pem, subject_text, validity_of
from sros_tool.pki.token import TokenKey
from sros_tool.validity import iso, window
from sros_tool.xml import read_bytes

Progress = Callable[[str], None]


@dataclass(frozen=True, slots=True)
class Turn:
    """An authority that takes the place of another."""

    old: x509.Certificate
    new: Authority


def reissue(
    transaction: Transaction,
    names: Sequence[str],
    identity: Turn | None,
    permissions: Turn | None,
    template: Template,
    now: datetime,
    progress: Progress | None = None,
) -> list[Entry]:
    """Stage what the CAs in turn have to issue: certificates, governance and permissions.

    Keys, subjects and rights stay.  What a CA that is not in turn has issued is left as it is, so
    its key is not needed.  Raises `KeystoreError` for an enclave that is not of the old CA.
    """
    work = _Reissuer(transaction, identity, permissions, template, now)
    return [*work.governance(names), *work.enclaves(names, progress)]


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
        self._issuer = identity.new.issuer() if identity else None
        self._now = now
        self._certificate_validity = window(now, template.certificate_validity)
        self._permissions_validity = window(now, template.permissions_validity)
        self._policies = {each.sha256: each.policy for each in read_ledger(transaction.root)}

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
        own = os.getpid()

        def work(share: Sequence[str]) -> tuple[list[Entry], list[Change]]:
            before = len(self._transaction.changes)
            entries: list[Entry] = []
            for name in share:
                entries += self._enclave(name)
                if progress and os.getpid() == own:
                    progress(name)
            return entries, self._transaction.changes[before:]

        turns = [turn for turn in (self._identity, self._permissions) if turn]
        # A session with a token does not survive a fork.
        alone = any(isinstance(turn.new.key, TokenKey) for turn in turns)
        found: list[Entry] = []
        for index, (share, (entries, changes)) in enumerate(
            [(names, work(names))] if alone else in_shares(names, work)
        ):
            if index:
                self._transaction.absorb(changes)
                for name in share:
                    if progress:
                        progress(name)
            found += entries
        return found

    def _enclave(self, name: str) -> list[Entry]:
        folder = enclave_folder(name)
        path = self._transaction.root / folder / "cert.pem"
        if not path.exists():
            return []  # its key waits for a certificate, which will be of the new CA
        try:
            certificate = load_certificate(read_bytes(path, "certificate"), f"'{path}'")
            entries = []
            if self._identity and self._issuer:
                if not issued_by(certificate, self._identity.old):
                    raise KeystoreError(
                        f"its certificate was not issued by the identity CA of this keystore but "
                        f"by {subject_text(certificate.issuer)}"
                    )
                public = certificate.public_key()
                certificate = self._issuer.issue(
                    certificate.subject,
                    public,  # type: ignore[arg-type]
                    self._certificate_validity,
                )
                self._transaction.write(f"{folder}/cert.pem", pem(certificate))
                entries.append(certificate_entry(self._now, "certificate", certificate, name))
            if self._permissions:
                entries += self._sign_permissions(name, folder, certificate, self._permissions)
        except SrosError as error:
            raise KeystoreError(
                f"enclave {name} cannot be moved to the new CA: {error.what}",
                error.why,
                error.remedy or f"See `sros inspect {path.parent}`; nothing was changed.",
            ) from error
        return entries

    def _sign_permissions(
        self, name: str, folder: str, certificate: x509.Certificate, turn: Turn
    ) -> list[Entry]:
        path = self._transaction.root / folder / "permissions.p7s"
        if not path.exists():
            return []
        old = read_bytes(path, "permissions document")
        signed = smime.parse(old)
        signed.verify(turn.old)
        subject = subject_text(certificate.subject)
        grants = parse_permissions(signed.document, f"'{path}'").grants
        # The first grant that fits is the one that DDS reads.
        grant = next((each for each in grants if each.subject == subject), None)
        if grant is None:
            raise KeystoreError(
                f"its permissions have no grant for {subject}",
                "They belong to another certificate.",
                f"Sign them anew with `sros create_permission {self._transaction.root} {name} "
                "POLICY_FILE`.",
            )
        validity = self._permissions_validity.within(validity_of(turn.new.certificate)).within(
            validity_of(certificate)
        )
        begin, end = iso(validity.not_before), iso(validity.not_after)
        permissions = Permissions((replace(grant, not_before=begin, not_after=end),))
        document = render_permissions(permissions)
        message = turn.new.sign(
            document, permissions, parse_permissions, f"the permissions of {name}"
        )
        self._transaction.write(f"{folder}/permissions.xml", document)
        self._transaction.write(f"{folder}/permissions.p7s", message)
        return [
            document_entry(
                self._now,
                "permissions",
                message,
                enclave=name,
                subject=subject,
                validity=validity,
                policy=self._policies.get(hashlib.sha256(old).hexdigest(), ""),
            )
        ]
