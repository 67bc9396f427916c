"""Issues certificates, signs permissions and records both: what every verb that issues shares.

All of it goes into one transaction.  What it does for many enclaves, several processes do.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from dataclasses import replace
from datetime import datetime, timedelta
from pathlib import Path
from typing import TypeVar

from cryptography import x509

from sros_tool.dds.permissions import Grant, Permissions, parse_permissions, render_permissions
from sros_tool.errors import KeystoreError, Note
from sros_tool.keystore.authorities.authority import Authority
from sros_tool.keystore.layout import enclave_folder
from sros_tool.keystore.ledger import Entry, certificate_entry, document_entry, read_ledger
from sros_tool.keystore.template import Template
from sros_tool.keystore.transaction.stage import Staged
from sros_tool.keystore.transaction.transaction import Transaction
from sros_tool.parallel import Progress, map_slices
from sros_tool.pki.certificates import pem, subject_text, validity_of
from sros_tool.pki.keys import PublicKey
from sros_tool.pki.token import TokenKey
from sros_tool.validity import Window, iso, window

Item = TypeVar("Item")
Result = TypeVar("Result")
Make = Callable[[str, Window], Permissions]
"""Makes the permissions of a subject (RFC 4514 text) for a time."""

_WORTH_SAYING = 0.01


class Issuance:
    """Issues in the name of the authorities that are given, and keeps the ledger's entries."""

    def __init__(
        self,
        transaction: Transaction,
        template: Template,
        now: datetime,
        *,
        identity: Authority | None,
        permissions: Authority | None,
    ) -> None:
        self.entries: list[Entry] = []
        self._transaction = transaction
        self._now = now
        self._issuer = identity.issuer() if identity else None
        self._authority = permissions
        self._certificate_validity = window(now, template.certificate_validity)
        self._permissions_validity = window(now, template.permissions_validity)
        self.notes = tuple(
            note
            for what, validity, authority in (
                ("certificates", self._certificate_validity, identity),
                ("permissions", self._permissions_validity, permissions),
            )
            if authority and (note := _cut(what, validity, authority.certificate, transaction.root))
        )
        if permissions:
            self._permissions_validity = self._permissions_validity.within(
                validity_of(permissions.certificate)
            )
        keys = (authority.key for authority in (identity, permissions) if authority)
        self._alone = any(isinstance(key, TokenKey) for key in keys)

    def certificate(self, name: str, subject: x509.Name, public: PublicKey) -> x509.Certificate:
        """Issue the certificate of an enclave; it ends with the identity CA at the latest."""
        if self._issuer is None:
            raise KeystoreError("there is no identity CA to issue by")
        certificate = self._issuer.issue(subject, public, self._certificate_validity)
        self._transaction.write(f"{enclave_folder(name)}/cert.pem", pem(certificate))
        self.entries.append(certificate_entry(self._now, "certificate", certificate, name))
        return certificate

    def permissions(
        self, name: str, certificate: x509.Certificate, make: Make, policy: str
    ) -> tuple[Permissions, bytes]:
        """Sign the permissions that belong to a certificate; also as the signed document.

        They end with their certificate and with the permissions CA at the latest.  ``policy`` is
        the digest of what they were made from, for the ledger.
        """
        if self._authority is None:
            raise KeystoreError("there is no permissions CA to sign by")
        subject = subject_text(certificate.subject)
        validity = self._permissions_validity.within(validity_of(certificate))
        permissions = make(subject, validity)
        document = render_permissions(permissions)
        message = self._authority.sign(
            document, permissions, parse_permissions, f"the permissions of {name}"
        )
        folder = enclave_folder(name)
        self._transaction.write(f"{folder}/permissions.xml", document)
        self._transaction.write(f"{folder}/permissions.p7s", message)
        self.entries.append(
            document_entry(
                self._now,
                "permissions",
                message,
                enclave=name,
                subject=subject,
                validity=validity,
                policy=policy,
            )
        )
        return permissions, message

    def spread(
        self,
        items: Sequence[Item],
        work: Callable[[Item], Result],
        told: Callable[[Item, Result], None] | None = None,
    ) -> list[Result]:
        """Do ``work`` for each item, on all cores; what it makes of each, in order.

        What the other processes issued and staged is as if it had been done here.  ``told`` hears
        of each item as it is done.  A token's session does not survive a fork, so with a key on
        one there is no other process.
        """
        own = os.getpid()

        def share(part: Sequence[Item]) -> tuple[list[Result], list[Entry], Staged]:
            mark, first, results = self._transaction.mark(), len(self.entries), []
            for item in part:
                results.append(work(item))
                if told and os.getpid() == own:
                    told(item, results[-1])
            return results, self.entries[first:], self._transaction.since(mark)

        found: list[Result] = []
        shares = [(items, share(items))] if self._alone else map_slices(items, share)
        for index, (part, (results, entries, staged)) in enumerate(shares):
            if index:  # the first share was done here, the others by other processes
                self._transaction.absorb(staged)
                self.entries += entries
                for item, result in zip(part, results, strict=True):
                    if told:
                        told(item, result)
            found += results
        return found


def teller(progress: Progress | None) -> Callable[[str, object], None] | None:
    """What `Issuance.spread` tells, for items that are names of enclaves."""
    return (lambda name, _: progress(name)) if progress else None


def renewed(grant: Grant) -> Make:
    """The same rights for another subject and time."""

    def make(subject: str, validity: Window) -> Permissions:
        begin, end = iso(validity.not_before), iso(validity.not_after)
        return Permissions((replace(grant, subject=subject, not_before=begin, not_after=end),))

    return make


def policies_of(root: Path) -> dict[str, str]:
    """The digest of the policy of each signed document, by the document's own SHA-256."""
    return {each.sha256: each.policy for each in read_ledger(root)}


def _cut(what: str, wanted: Window, authority: x509.Certificate, root: Path) -> Note | None:
    """A remark where a CA takes something worth mention of a validity that was chosen."""
    end = validity_of(authority).not_after
    lost = wanted.not_after - end
    if lost <= max((wanted.not_after - wanted.not_before) * _WORTH_SAYING, timedelta(0)):
        return None
    return Note(
        "keystore.ends-with-ca",
        f"What is issued now ends with its CA at {iso(end)}, {lost.days} days before the "
        f"validity that is chosen for {what} is over: rotate the CA with "
        f"`sros rotate_ca {root} --next`.",
    )
