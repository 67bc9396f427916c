"""Renews enclaves: new certificates, and the permissions that they have signed anew."""

from __future__ import annotations

import hashlib
import os
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from datetime import datetime, timedelta
from pathlib import Path

from cryptography import x509

from sros_tool.dds.permissions import Grant, Permissions, parse_permissions, render_permissions
from sros_tool.errors import KeystoreError, SrosError, UsageError
from sros_tool.keystore.authority import Authorities, load_authorities
from sros_tool.keystore.create import list_enclaves
from sros_tool.keystore.keyring import IN_KEYSTORE, Keyring
from sros_tool.keystore.layout import enclave_folder
from sros_tool.keystore.ledger import (
    Entry,
    append,
    certificate_entry,
    document_entry,
    read_ledger,
)
from sros_tool.keystore.open import load_settings
from sros_tool.keystore.parallel import in_shares
from sros_tool.keystore.template import Template
from sros_tool.keystore.transaction import Change, Transaction, tidy
from sros_tool.names import check_enclave_name
from sros_tool.pki import smime
from sros_tool.pki.certificates import (
    enclave_subject,
    issued_by,
    load_certificate,
    pem,
    subject_text,
    validity_of,
)
from sros_tool.pki.keys import generate_key, key_pem
from sros_tool.pki.token import TokenKey
from sros_tool.validity import BACKDATE, Window, iso, parse_duration, window
from sros_tool.xml import read_bytes

Progress = Callable[[str], None]


@dataclass(frozen=True, slots=True)
class Lifetime:
    """When what an enclave consists of ends, and how much of its life is over."""

    name: str
    certificate: Window
    permissions: Window

    def ends(self) -> datetime:
        """The earlier of both ends."""
        return min(self.certificate.not_after, self.permissions.not_after)

    def due(self, threshold: Threshold, now: datetime) -> bool:
        """Whether it is to be renewed by ``threshold``."""
        if threshold.remaining is not None:
            return self.ends() - now <= threshold.remaining
        assert threshold.elapsed is not None
        return any(
            _elapsed(each, now) >= threshold.elapsed
            for each in (self.certificate, self.permissions)
        )


@dataclass(frozen=True, slots=True)
class Threshold:
    """When a thing is to be renewed: at so much ``remaining``, or ``elapsed`` (0 to 1) of it."""

    remaining: timedelta | None = None
    elapsed: float | None = None


def _elapsed(validity: Window, now: datetime) -> float:
    """How much of a life is over, from 0 to 1; the time by which it was back-dated is no life."""
    begin = validity.not_before
    if validity.not_after - begin > BACKDATE:
        begin += BACKDATE
    return (now - begin) / (validity.not_after - begin)


def parse_threshold(text: str) -> Threshold:
    """Read ``30d`` (that much is left) or ``66%`` (that much is over)."""
    match = re.fullmatch(r"(\d{1,3})%", text.strip(), re.ASCII)
    if not match:
        return Threshold(remaining=parse_duration(text))
    if int(match[1]) > 100:
        raise UsageError(f"{text!r} is more than all of a lifetime")
    return Threshold(elapsed=int(match[1]) / 100)


def lifetimes(root: Path) -> tuple[Lifetime, ...]:
    """When each enclave of a keystore ends, in the order of names."""
    return tuple(_read(root, name).lifetime for name in list_enclaves(root))


@dataclass(frozen=True, slots=True)
class Renewal:
    """What was renewed, or with ``dry_run`` would be."""

    root: Path
    renewed: tuple[str, ...]
    changes: tuple[Change, ...]


def renew(
    root: Path,
    names: Sequence[str] = (),
    *,
    now: datetime,
    expiring: Threshold | None = None,
    new_key: bool = False,
    keyring: Keyring = IN_KEYSTORE,
    dry_run: bool = False,
    progress: Progress | None = None,
) -> Renewal:
    """Renew the named enclaves, or all that are due by ``expiring``; all or nothing.

    The certificate is issued anew for the same key, or with ``new_key`` for a new one; the rights
    stay as they are signed.  Certificate, key and permissions of an enclave change at one moment.
    """
    if not dry_run:
        tidy(root)
    existing = list_enclaves(root)
    for name in names:
        check_enclave_name(name)
        if name not in existing:
            raise KeystoreError(f"enclave {name} does not exist in keystore '{root}'")
    with Transaction(root, dry_run=dry_run) as transaction:
        template = load_settings(root)
        authorities = load_authorities(root, template, keyring, now)
        chosen = list(dict.fromkeys(names))
        if expiring is not None:
            chosen += [
                each.name
                for each in lifetimes(root)
                if each.name not in chosen and each.due(expiring, now)
            ]
        work = _Renewer(transaction, authorities, template, now, new_key)
        entries = work.renew_all(chosen, progress)
        append(transaction, entries)
        transaction.commit()
    return Renewal(root, tuple(chosen), tuple(transaction.changes))


class _Renewer:
    def __init__(
        self,
        transaction: Transaction,
        authorities: Authorities,
        template: Template,
        now: datetime,
        new_key: bool,
    ) -> None:
        self._transaction = transaction
        self._authorities = authorities
        self._issuer = authorities.identity.issuer()
        self._template = template
        self._now = now
        self._new_key = new_key
        self._policies = {each.sha256: each.policy for each in read_ledger(transaction.root)}
        self._certificate_validity = window(now, template.certificate_validity)
        self._permissions_validity = window(now, template.permissions_validity).within(
            validity_of(authorities.permissions.certificate)
        )

    def renew_all(self, names: Sequence[str], progress: Progress | None) -> list[Entry]:
        own = os.getpid()

        def work(share: Sequence[str]) -> tuple[list[Entry], list[Change]]:
            before = len(self._transaction.changes)
            entries: list[Entry] = []
            for name in share:
                entries += self._renew(name)
                if progress and os.getpid() == own:
                    progress(name)
            return entries, self._transaction.changes[before:]

        keys = (self._authorities.identity.key, self._authorities.permissions.key)
        alone = any(isinstance(key, TokenKey) for key in keys)
        shares = [(names, work(names))] if alone else in_shares(names, work)
        found: list[Entry] = []
        for index, (share, (entries, changes)) in enumerate(shares):
            if index:
                self._transaction.absorb(changes)
                for name in share:
                    if progress:
                        progress(name)
            found += entries
        return found

    def _renew(self, name: str) -> list[Entry]:
        state = _read(self._transaction.root, name)
        folder = enclave_folder(name)
        if not issued_by(state.certificate, self._authorities.identity.certificate):
            raise KeystoreError(
                f"the certificate of enclave {name} was not issued by the identity CA of this "
                "keystore"
            )
        state.signed.verify(self._authorities.permissions.certificate)
        public = state.certificate.public_key()
        if self._new_key:
            if not (self._transaction.root / folder / "key.pem").exists():
                raise KeystoreError(
                    f"the key of enclave {name} is not in this keystore",
                    "It was made on its robot and stays there, so no new one is made here.",
                    "Have a new request made there, and sign it with --renew.",
                )
            key = generate_key()
            public = key.public_key()
            self._transaction.write(f"{folder}/key.pem", key_pem(key), private=True)
        subject = enclave_subject(name, unique=self._template.unique_subject)
        certificate = self._issuer.issue(subject, public, self._certificate_validity)  # type: ignore[arg-type]
        self._transaction.write(f"{folder}/cert.pem", pem(certificate))
        validity = self._permissions_validity.within(validity_of(certificate))
        text = subject_text(certificate.subject)
        permissions = Permissions(
            (
                replace(
                    state.grant,
                    subject=text,
                    not_before=iso(validity.not_before),
                    not_after=iso(validity.not_after),
                ),
            )
        )
        document = render_permissions(permissions)
        message = self._authorities.permissions.sign(
            document, permissions, parse_permissions, f"the permissions of {name}"
        )
        self._transaction.write(f"{folder}/permissions.xml", document)
        self._transaction.write(f"{folder}/permissions.p7s", message)
        return [
            certificate_entry(self._now, "certificate", certificate, name),
            document_entry(
                self._now,
                "permissions",
                message,
                enclave=name,
                subject=text,
                validity=validity,
                policy=self._policies.get(state.digest, ""),
            ),
        ]


@dataclass(frozen=True, slots=True)
class _State:
    certificate: x509.Certificate
    signed: smime.SignedDocument
    digest: str
    grant: Grant
    lifetime: Lifetime


def _read(root: Path, name: str) -> _State:
    folder = root / enclave_folder(name)
    try:
        path = folder / "cert.pem"
        certificate = load_certificate(read_bytes(path, "certificate"), f"'{path}'")
        path = folder / "permissions.p7s"
        message = read_bytes(path, "permissions document")
        signed = smime.parse(message)
        permissions = parse_permissions(signed.document, f"'{path}'")
    except SrosError as error:
        raise KeystoreError(
            f"enclave {name} cannot be read: {error.what}",
            error.why,
            error.remedy or f"See `sros inspect {folder}`.",
        ) from error
    subject = subject_text(certificate.subject)
    matching = [each for each in permissions.grants if each.subject == subject]
    if not matching:
        raise KeystoreError(
            f"the permissions of enclave {name} have no grant for {subject}",
            "They belong to another certificate.",
            f"Sign them anew with `sros create_permission {root} {name} POLICY_FILE`.",
        )
    # The first grant that fits is the one that DDS reads.
    lifetime = Lifetime(name, validity_of(certificate), matching[0].validity)
    digest = hashlib.sha256(message).hexdigest()
    return _State(certificate, signed, digest, matching[0], lifetime)


def describe_lifetime(lifetime: Lifetime, now: datetime) -> str:
    """In words: which part ends first, and when."""
    first = (
        "certificate"
        if lifetime.certificate.not_after <= lifetime.permissions.not_after
        else "permissions"
    )
    word = "ended" if lifetime.ends() < now else "until"
    return f"{lifetime.name}  {first} {word} {iso(lifetime.ends())}"
