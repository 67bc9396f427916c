"""The only writer of enclaves: it issues, proves and stages their certificates and permissions.

Every command that issues passes an `Issuance` to `EnclaveWriter.write`.  This method turns the
rights into permissions, proves that these match the policy, signs certificate and permissions,
stages both in a transaction, and records them for the ledger.  For many enclaves, several processes
share the work.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from datetime import datetime, timedelta
from functools import cache
from pathlib import Path
from shlex import quote
from typing import TypeVar

from cryptography import x509

from sros_tool.dds.domains import DomainSet
from sros_tool.dds.permissions import (
    Permissions,
    document_notes,
    parse_permissions,
    render_permissions,
)
from sros_tool.errors import KeystoreError, Note, PolicyError, SrosError, check_meaning
from sros_tool.files import policies_dir
from sros_tool.keystore.issuing.authority import Authorities, Authority
from sros_tool.keystore.issuing.ca_service import CertificateRequest
from sros_tool.keystore.issuing.keyring import Secrets, no_secrets
from sros_tool.keystore.issuing.proof import prove
from sros_tool.keystore.known_keys import KnownKeys
from sros_tool.keystore.layout import (
    CERTIFICATE_FILE,
    CRL,
    CRL_FILE,
    ENCLAVES,
    GOVERNANCE_FILE,
    GOVERNANCE_P7S,
    KEY_FILE,
    KEY_URI_FILE,
    PERMISSIONS_FILE,
    REQUEST,
    ROLES,
    ca_certificate_path,
    enclave_folder,
    enclave_path,
)
from sros_tool.keystore.ledger import Entry, certificate_entry, document_entry
from sros_tool.keystore.rights import SignedRights
from sros_tool.keystore.template import Template
from sros_tool.keystore.transaction import Transaction
from sros_tool.parallel import Progress, tick
from sros_tool.pki.certificates import (
    Issuer,
    load_request,
    make_request,
    pem,
    subject_text,
    validity_of,
)
from sros_tool.pki.keys import PrivateKey, PublicKey, generate_key, key_pem, load_key
from sros_tool.pki.token import (
    TokenKey,
    TokenUri,
    make_enclave_key,
    open_enclave_key,
    place_in_file,
    planned_key,
    token_file_content,
)
from sros_tool.policy.document import read_policy
from sros_tool.policy.model import Enclave, Policy
from sros_tool.policy.rights import nodes_as_text, nodes_not_shown
from sros_tool.translate import permissions_for
from sros_tool.validity import Window, iso, window
from sros_tool.wording import counted
from sros_tool.xml import read_bytes

Result = TypeVar("Result")

_LEAST_NOTED_LOSS = 0.01
_MOST_SHOWN = 5
"""Maximum number of enclaves of a policy that an error names."""


# ── keys on tokens ─────────────────────────────────────────────────────────────────────────


@dataclass(frozen=True, slots=True)
class EnclaveTokens:
    """The ``places`` of new keys on tokens, by enclave, and the keys that must not be reused.

    These are the ``known`` keys of the keystore, and the keys of its ``authorities``.
    """

    places: Mapping[str, TokenUri]
    secrets: Secrets
    known: KnownKeys
    authorities: Authorities
    dry_run: bool = False

    def key(self, name: str) -> TokenKey:
        """Return the key at the enclave's place on the token, after creating it if it is missing.

        Raises:
            KeystoreError: the key was revoked, or belongs to another enclave or to a CA.
            PkiError: the token cannot be used.
        """
        place = self.places[name]
        if self.dry_run:
            return planned_key(place)
        key = make_enclave_key(place, self.secrets)
        public, remedy = key.public_key(), "Name another object of the token."
        for authority in (self.authorities.identity, self.authorities.permissions):
            if authority.certificate.public_key() == public:
                raise KeystoreError(
                    f"the key for enclave {name} is the key of a CA",
                    "Whoever has the robot could issue any identity, or sign any rights.",
                    remedy,
                )
        self.known.refuse_revoked_key(public, f"enclave {name}", remedy)
        self.known.refuse_shared_key(public, name, remedy)
        return key

    def check_present(self, name: str, root: Path) -> None:
        """Raise `KeystoreError` if the key of an existing enclave is not at the chosen place."""
        path = enclave_path(root, name) / KEY_URI_FILE
        if not path.exists() or read_bytes(path, "place of the key") != token_file_content(
            self.places[name]
        ):
            where = quote(str(root))
            raise KeystoreError(
                f"enclave {name} of keystore '{root}' already has another key",
                "",
                f"To replace it: `sros renew {where} {name} --key 'pkcs11:...' --revoke-old`.",
            )


# ── certificates and permissions to issue ──────────────────────────────────────────────────


@dataclass(frozen=True, slots=True)
class NewIdentity:
    """The subject and the key for which a certificate is issued.

    ``new_key`` is the private key if it was just generated; the key itself, or its place on a
    token, is staged with the certificate.  ``request`` is the request (PEM) of a robot that has the
    key.
    """

    subject: x509.Name
    public_key: PublicKey
    new_key: PrivateKey | None = None
    request: bytes = b""


@dataclass(frozen=True, slots=True)
class StatedRights:
    """The rights that a policy states for an enclave, and the ROS domains to which they apply."""

    enclave: Enclave
    domains: DomainSet


@dataclass(frozen=True, slots=True)
class Issuance:
    """The certificate and permissions to issue for an enclave.

    ``identity`` is the certificate that the enclave keeps, or the subject and key of a new
    certificate.  If ``rights`` is None, the permissions do not change.
    """

    name: str
    identity: NewIdentity | x509.Certificate
    rights: StatedRights | SignedRights | None


@dataclass(frozen=True, slots=True)
class IssuedEnclave:
    """The certificate and the new permissions of an enclave.

    ``document`` is the signed ``permissions.p7s``.  If the permissions do not change,
    ``permissions`` and ``document`` are empty.  ``short_lived`` says that the settings of the
    keystore let this enclave expire earlier than others.
    """

    issuance: Issuance
    certificate: x509.Certificate
    permissions: Permissions = field(default_factory=lambda: Permissions(()))
    document: bytes = b""
    short_lived: bool = False

    def notes(self) -> Iterator[Note]:
        """Yield notes on short-lived enclaves, and on rights that ros2/sros2 keeps separate."""
        name, rights = self.issuance.name, self.issuance.rights
        if isinstance(rights, StatedRights) and len(rights.enclave.profiles) > 1:
            yield Note(
                "policy.several-profiles",
                f"{name}: the rights of its {len(rights.enclave.profiles)} <profiles> are joined. "
                "ros2/sros2 makes one grant per <profiles>, and DDS reads only the first grant.",
            )
        if self.short_lived:
            end = validity_of(self.certificate).not_after
            yield Note(
                "enclave.short-lived",
                f"{name} expires at {iso(end)}, because of [[enclaves]] in the keystore's "
                f"sros.toml. `sros renew KEYSTORE {quote(name)}` renews it.",
            )
        if self.document:
            yield from document_notes(name, self.permissions, len(self.document))


# ── issuing ────────────────────────────────────────────────────────────────────────────────


class EnclaveWriter:
    """Writer of enclaves, which issues certificates and permissions within one transaction.

    ``identity`` signs certificates, ``permissions`` signs permissions.  ``entries`` collects
    entries for the ledger.  ``signed`` collects the new rights of enclaves if the keystore has a
    Zenoh network.  ``notes`` report CAs that expire too early for the template's validities.
    ``keys_on_token`` says that enclaves get keys on a token.  ``reason_of_stated`` is what the
    ledger has as the reason of permissions that a policy states.
    """

    def __init__(
        self,
        transaction: Transaction,
        template: Template,
        now: datetime,
        *,
        identity: Authority | None,
        permissions: Authority | None,
        keys_on_token: bool = False,
        secrets: Secrets = no_secrets,
        reason_of_stated: str = "",
    ) -> None:
        self.entries: list[Entry] = []
        self._reason_of_stated = reason_of_stated
        self.signed: dict[str, SignedRights] = {}
        self._transaction = transaction
        self._template = template
        self._now = now
        self._identity = identity
        self._issuer = identity.issuer() if identity and not identity.service else None
        # A dry run does not ask the service.
        if identity and identity.service and transaction.dry_run:
            self._issuer = Issuer(identity.certificate, generate_key())
        self._secrets = secrets
        self._signer = permissions
        self._certificate_validity = window(now, template.certificate_validity)
        self._permissions_validity = window(now, template.permissions_validity)
        self.notes = tuple(
            note
            for kind, validity, authority in (
                ("certificates", self._certificate_validity, identity),
                ("permissions", self._permissions_validity, permissions),
            )
            if authority
            and (
                note := _early_expiry_note(kind, validity, authority.certificate, transaction.root)
            )
        )
        if permissions:
            self._permissions_validity = self._permissions_validity.intersection(
                validity_of(permissions.certificate)
            )
        signs = (authority.on_token for authority in (identity, permissions) if authority)
        self._key_on_token = keys_on_token or any(signs)

    @property
    def expiry(self) -> datetime:
        """The first expiry of certificates and permissions that are written now.

        Short-lived enclaves do not count: they expire earlier.
        """
        return min(self._certificate_validity.not_after, self._permissions_validity.not_after)

    def write(self, issuance: Issuance) -> IssuedEnclave:
        """Issue, prove, sign, stage and record an enclave's certificate and permissions.

        A certificate expires with the identity CA at the latest; permissions expire with their
        certificate and with the permissions CA at the latest.

        Raises:
            KeystoreError: the permissions would not decide as the policy does.
        """
        name, identity, rights = issuance.name, issuance.identity, issuance.rights
        certificate = self._issue(name, identity) if isinstance(identity, NewIdentity) else identity
        if rights is None:
            return IssuedEnclave(issuance, certificate)
        subject = subject_text(certificate.subject)
        validity = self._validity_of_permissions(name, certificate)
        permissions = _permissions(rights, subject, validity)
        message = self._sign(name, permissions)
        reason = ""
        if isinstance(rights, SignedRights):
            policy, nodes = rights.policy, rights.nodes
        else:
            reason = self._reason_of_stated
            policy, nodes = rights.enclave.digest, nodes_as_text(nodes_not_shown(rights.enclave))
        self.entries.append(
            document_entry(
                self._now,
                "permissions",
                message,
                enclave=name,
                subject=subject,
                validity=validity,
                policy=policy,
                nodes=nodes,
            )._replace(reason=reason)
        )
        if self._template.zenoh:
            (grant,) = permissions.grants
            self.signed[name] = SignedRights(grant, policy, nodes)
        short = self._template.longest_validity(name) is not None
        return IssuedEnclave(issuance, certificate, permissions, message, short_lived=short)

    def would_change_only_dates(
        self, rights: StatedRights, certificate: x509.Certificate, validity: Window, text: bytes
    ) -> bool:
        """Return whether `write` would change only the dates of permissions that can be kept.

        ``validity`` and ``text`` (with LF line ends) are those of the present permissions. They can
        be kept while they are valid for more than a third of the validity that new permissions
        would have (`Window.can_be_kept`).

        Raises:
            KeystoreError: the permissions would not decide as the policy does.
        """
        name = rights.enclave.path
        new = self._validity_of_permissions(name, certificate)
        if not validity.can_be_kept(new, self._now):
            return False
        permissions = _permissions(rights, subject_text(certificate.subject), validity)
        return render_permissions(permissions) == text

    def _validity(self, name: str, default_validity: Window) -> Window:
        """Return ``default_validity``, shortened if the enclave is short-lived."""
        longest = self._template.longest_validity(name)
        return (
            default_validity
            if longest is None
            else default_validity.intersection(window(self._now, longest))
        )

    def _validity_of_permissions(self, name: str, certificate: x509.Certificate) -> Window:
        """Return the validity of permissions, which expire with their certificate at the latest.

        Permissions may begin before the certificate, because Fast DDS reads their dates in local
        time (`BACKDATE`).
        """
        validity = self._validity(name, self._permissions_validity)
        end = validity_of(certificate).not_after
        return Window(validity.not_before, min(validity.not_after, end))

    def _issue(self, name: str, identity: NewIdentity) -> x509.Certificate:
        if self._identity is None:
            raise KeystoreError("there is no identity CA to issue the certificate")
        folder = enclave_folder(name)
        if isinstance(identity.new_key, TokenKey):
            if (enclave_path(self._transaction.root, name) / KEY_FILE).exists():
                self._transaction.remove(f"{folder}/{KEY_FILE}")
            self._transaction.write(f"{folder}/{KEY_URI_FILE}", identity.new_key.file)
        elif identity.new_key:
            pem_of_key = key_pem(identity.new_key)
            self._transaction.write(f"{folder}/{KEY_FILE}", pem_of_key, private=True)
        validity = self._validity(name, self._certificate_validity)
        if self._issuer:
            certificate = self._issuer.issue(identity.subject, identity.public_key, validity)
        else:
            certificate = self._ask_service(self._identity, name, identity, validity)
        self._transaction.write(f"{folder}/{CERTIFICATE_FILE}", pem(certificate))
        self.entries.append(certificate_entry(self._now, "certificate", certificate, name))
        return certificate

    def _ask_service(
        self, authority: Authority, name: str, identity: NewIdentity, validity: Window
    ) -> x509.Certificate:
        """Return the certificate that the CA service ``authority`` issues for an enclave.

        Raises:
            CaServiceError: the service issues no certificate, or another one than was requested.
        """
        assert authority.service
        asked = CertificateRequest(
            name,
            identity.request or self._request(name, identity),
            identity.subject,
            identity.public_key,
            validity.intersection(validity_of(authority.certificate)),
        )
        return authority.service.issue(asked, authority.certificate, self._now)

    def _request(self, name: str, identity: NewIdentity) -> bytes:
        """Return a request for an enclave's certificate, signed with the enclave's key.

        If the key is on a robot, this is the request that the robot signed and the keystore kept.
        """
        folder = enclave_path(self._transaction.root, name)
        key = identity.new_key
        if key is None and (folder / KEY_FILE).exists():
            key = load_key(read_bytes(folder / KEY_FILE, "private key"), f"'{folder / KEY_FILE}'")
        elif key is None and (folder / KEY_URI_FILE).exists():
            key = open_enclave_key(place_in_file(folder / KEY_URI_FILE), self._secrets)
        if key:
            return make_request(key, identity.subject)
        with suppress(SrosError):
            known = load_request(read_bytes(folder / REQUEST, "request"), f"of {name}")
            if known.public_key == identity.public_key:
                return known.pem
        raise KeystoreError(
            f"this keystore has neither the key of enclave {name}, nor a request signed with it",
            "A CA service requires proof that the requester has the key.",
            "Create a request on the robot with `sros create_request`, and sign it here with "
            "`sros sign_request --renew`.",
        )

    def _sign(self, name: str, permissions: Permissions) -> bytes:
        if self._signer is None:
            raise KeystoreError("there is no permissions CA to sign the permissions")
        folder, document_name = enclave_folder(name), f"the permissions of {name}"
        document = render_permissions(permissions)
        check_meaning(parse_permissions(document), permissions, document_name)
        message = self._signer.sign(document, document_name)
        self._transaction.write(f"{folder}/permissions.xml", document)
        self._transaction.write(f"{folder}/{PERMISSIONS_FILE}", message)
        return message

    def for_each(
        self,
        names: Sequence[str],
        work: Callable[[str], Result],
        progress: Progress | None = None,
    ) -> dict[str, Result]:
        """Run ``work`` for all enclaves on all cores, and map each enclave to its result.

        Only this process calls ``progress``: with each enclave of its own slice as soon as it is
        done, and with the other enclaves when all workers have ended.

        Everything that forked workers issue and stage is added to this writer and its transaction.
        If a CA key is on a token, no workers are forked, because the session of a token does not
        survive a fork.
        """
        own_process = os.getpid()

        def work_on(
            part: Sequence[str],
        ) -> tuple[list[Result], list[Entry], dict[str, SignedRights]]:
            first, results = len(self.entries), []
            for name in part:
                results.append(work(name))
                tick()
                if progress and os.getpid() == own_process:
                    progress(name)
            signed = {name: self.signed[name] for name in part if name in self.signed}
            return results, self.entries[first:], signed

        slices = self._transaction.stage_on_all_cores(names, work_on, alone=self._key_on_token)
        results_by_name: dict[str, Result] = {}
        for index, (part, (results, entries, signed)) in enumerate(slices):
            if index:  # forked workers did the other slices, this process the first
                self.entries += entries
                self.signed |= signed
                for name in part if progress else ():
                    progress(name)  # type: ignore[misc]
            results_by_name |= zip(part, results, strict=True)
        return results_by_name


def _permissions(
    rights: StatedRights | SignedRights, subject: str, validity: Window
) -> Permissions:
    """Return permissions with ``rights`` for a subject (RFC 4514 text) and a validity."""
    if isinstance(rights, SignedRights):
        begin, end = iso(validity.not_before), iso(validity.not_after)
        grant = rights.grant._replace(subject=subject, not_before=begin, not_after=end)
        return Permissions((grant,))
    permissions = permissions_for(
        rights.enclave, subject=subject, validity=validity, domains=rights.domains
    )
    prove(rights.enclave, permissions, rights.domains)
    return permissions


def _early_expiry_note(
    label: str, wanted_validity: Window, authority: x509.Certificate, root: Path
) -> Note | None:
    """Return a note if the CA's expiry shortens the validity by more than 1 %; otherwise None.

    ``label`` names the files in the note, such as "certificates".
    """
    end = validity_of(authority).not_after
    lost = wanted_validity.not_after - end
    if lost <= max(
        (wanted_validity.not_after - wanted_validity.not_before) * _LEAST_NOTED_LOSS, timedelta(0)
    ):
        return None
    return Note(
        "keystore.ends-with-ca",
        f"New {label} expire with their CA at {iso(end)}, {counted(lost.days, 'day')} earlier than "
        f"the keystore's settings say. Rotate the CA with `sros rotate_ca {quote(str(root))} "
        "--next`.",
    )


# ── rights and shared files ────────────────────────────────────────────────────────────────


def stated_enclave(policy: Policy, name: str) -> Enclave:
    """Return the rights that a policy states for an enclave.

    Raises:
        PolicyError: the policy does not have the enclave.
    """
    enclave = policy.enclave(name)
    if enclave is None:
        paths = [enclave.path for enclave in policy.enclaves]
        present = ", ".join(paths) or "no enclaves"
        if len(paths) > _MOST_SHOWN:
            from difflib import get_close_matches  # imported only for this error

            similar = get_close_matches(name, paths, _MOST_SHOWN) or paths[:_MOST_SHOWN]
            present = f"{len(paths)} enclaves, such as {', '.join(similar)}"
        raise PolicyError(
            f"unable to find enclave {name} in the policy '{policy.file}'",
            f"The policy has {present}.",
        )
    return enclave


@cache
def _default_policy(choice: str) -> Enclave:
    return read_policy(policies_dir() / "defaults" / f"{choice}.xml").enclaves[0]


def default_rights(template: Template, name: str) -> Enclave:
    """Return the rights that the keystore's template gives to an enclave without a policy."""
    return replace(_default_policy(template.default_permissions), path=name)


def present_files(root: Path, name: str) -> set[str]:
    """Return the names of an enclave's files; a broken link counts as missing."""
    folder = enclave_path(root, name)
    try:
        names = os.listdir(folder)
        return {file for file in names if os.path.exists(f"{folder}/{file}")}  # noqa: PTH110
    except FileNotFoundError:
        return set()


def shared_files(root: Path, name: str) -> dict[str, str]:
    """Map the names of the files that all enclaves share to the files' paths in the keystore."""
    shared = {f"{role}_ca.cert.pem": ca_certificate_path(role) for role in ROLES}
    if enclave_folder(name) != ENCLAVES:  # the folder of the enclave / itself holds the governance
        shared[GOVERNANCE_FILE] = GOVERNANCE_P7S
    if (root / CRL).exists():
        shared[CRL_FILE] = CRL
    return shared


def link_shared_files(transaction: Transaction, name: str, present: Collection[str]) -> None:
    """Stage links to the files that all enclaves share, except those in ``present``."""
    folder = enclave_folder(name)
    up = "../" * folder.count("/")
    for file, source in shared_files(transaction.root, name).items():
        if file not in present:
            inside = source.removeprefix(f"{ENCLAVES}/")
            target = f"{up}{inside}" if inside != source else f"{up}../{source}"
            transaction.link(f"{folder}/{file}", target)
