"""The identity CA and the permissions CA of a keystore: creating and loading them.

The issuing CA is the first certificate of a CA file, because Cyclone DDS 0.10.2 reads only the
first certificate.  Fast DDS 2.9.1 trusts all CAs in the file, and also reads a revocation list from
it.
"""

from __future__ import annotations

import secrets
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from shlex import quote

from cryptography import x509
from cryptography.hazmat.primitives import hashes

from sros_tool.dds.decision.vendors import TESTED, Vendor
from sros_tool.errors import KeystoreError, Note, PkiError, UsageError, check_meaning
from sros_tool.faults import WAIT_FOR_CA
from sros_tool.keystore.issuing.ca_service import CaService
from sros_tool.keystore.issuing.keyring import Keyring, check_imported_keys, check_places
from sros_tool.keystore.layout import (
    IDENTITY,
    PERMISSIONS,
    PRIVATE,
    PUBLIC,
    ROLES,
    ca_certificate_path,
    ca_key_path,
    enclave_folder,
)
from sros_tool.keystore.loading import authority_refusals, refusals_text
from sros_tool.keystore.reader import OpenedKeystore
from sros_tool.keystore.template import Template
from sros_tool.keystore.transaction import Transaction
from sros_tool.pki import smime
from sros_tool.pki.certificates import (
    Issuer,
    authority_text,
    check_signer,
    common_name,
    issue_ca,
    issued_by,
    load_certificates,
    pem,
    same_key,
    subject_text,
    validity_of,
    weakness,
)
from sros_tool.pki.chains import denies_issuing, purpose_faults
from sros_tool.pki.keys import PrivateKey, algorithm, is_portable
from sros_tool.pki.token import TokenKey
from sros_tool.validity import iso, window


@dataclass(frozen=True, slots=True)
class Authority:
    """A certificate authority that can sign.

    If the identity CA is a CA ``service``, its key is not here, and it only issues certificates.
    """

    certificate: x509.Certificate
    own_key: PrivateKey | None
    service: CaService | None = None

    @property
    def key(self) -> PrivateKey:
        """The private key.

        Raises:
            KeystoreError: the key belongs to a CA service.
        """
        if self.own_key is None:
            raise KeystoreError(
                f"only the CA service can sign for {authority_text(self.certificate)}",
                "sros does not have the key of this CA.",
            )
        return self.own_key

    @property
    def on_token(self) -> bool:
        """Whether the key is on a token, so that forked processes cannot use it."""
        return isinstance(self.own_key, TokenKey)

    def __post_init__(self) -> None:
        check_signer(self.certificate)

    def issuer(self) -> Issuer:
        """Return an `Issuer` that signs certificates with this CA."""
        return Issuer(self.certificate, self.key)

    def sign(self, document: bytes, label: str) -> bytes:
        """Return ``document`` as a signed S/MIME message (``.p7s``).

        The message is read back, to check its digest and its content.  ``label`` names the document
        in the error.

        Raises:
            PkiError: the message does not contain ``document`` with a correct digest.
        """
        return self.sign_all((document,), label)[0]

    def sign_all(self, documents: Sequence[bytes], label: str) -> list[bytes]:
        """Return ``documents`` as signed S/MIME messages, in order, like `sign`.

        For small documents, this is faster than `sign`, because each step is done for several
        documents in a row.
        """
        messages: list[bytes] = []
        for batch in _batches(documents):
            signed = [smime.sign(document, self.certificate, self.key) for document in batch]
            parsed = [smime.parse_new(message) for message in signed]
            for document, message in zip(batch, parsed, strict=True):
                text = document.replace(b"\r\n", b"\n")
                check_meaning((message.digest_matches(), message.text), (True, text), label)
            messages += signed
        return messages


_BATCH_BYTES = 1 << 18


def _batches(documents: Sequence[bytes]) -> Iterator[Sequence[bytes]]:
    """Yield the documents in batches of up to 256 KiB; a larger document is a batch by itself."""
    begin = size = 0
    for end, document in enumerate(documents):
        size += len(document)
        if size > _BATCH_BYTES and end > begin:
            yield documents[begin:end]
            begin, size = end, len(document)
    yield documents[begin:]


@dataclass(frozen=True, slots=True)
class Authorities:
    """The identity CA and the permissions CA of a keystore, which may be the same CA."""

    identity: Authority
    permissions: Authority
    notes: tuple[Note, ...] = ()


def create_authorities(
    transaction: Transaction,
    template: Template,
    keyring: Keyring,
    now: datetime,
    imported_cas: Mapping[str, bytes],
) -> Authorities:
    """Stage the CAs of a new keystore and return them, ready to sign.

    ``imported_cas`` maps roles ("identity", "permissions") to the PEM of an existing CA, which is
    then used instead of a new one.

    Raises:
        KeystoreError: the places of the CA keys contradict the template.
        UsageError: an imported CA comes without its key, or does not fit the template.
        PkiError: an imported CA cannot be used.
    """
    check_places(keyring, template)
    check_imported_keys(imported_cas, keyring, template)
    validity = window(now, template.authority_validity)
    # Separate CAs get unique names, by which messages and diagrams tell keystores apart.
    serial = secrets.token_hex(4)
    notes: list[Note] = []

    def make(file: str, role: str, name: str) -> Authority:
        path = f"{PRIVATE}/{file}.key.pem"
        service = keyring.ca_service(transaction.root, role, template)
        if service:
            if role not in imported_cas:
                raise UsageError(
                    f"the certificate of the CA service '{service.place}' is missing",
                    "",
                    "Run `sros create_keystore` with --identity-ca FILE, a file with this "
                    "certificate and the certificates of its issuers.",
                )
            existing = check_imported_ca(role, imported_cas[role], None, now)
            transaction.write(f"{PUBLIC}/{file}.cert.pem", existing.bundle)
            notes.extend(existing.notes)
            return Authority(existing.certificate, None, service)
        key = keyring.make(transaction, path, role, template, compared=role in imported_cas)
        if role in imported_cas:
            existing = check_imported_ca(role, imported_cas[role], key, now)
            certificate, bundle = existing.certificate, existing.bundle
            notes.extend(existing.notes)
        else:
            certificate = issue_ca(key, common_name(name), validity)
            bundle = pem(certificate)
        transaction.write(f"{PUBLIC}/{file}.cert.pem", bundle)
        return Authority(certificate, key)

    if template.separate_authorities:
        name = template.authority_name
        return Authorities(
            make("identity_ca", IDENTITY, f"{name} identity CA {serial}"),
            make("permissions_ca", PERMISSIONS, f"{name} permissions CA {serial}"),
            tuple(notes),
        )
    authority = make("ca", IDENTITY, template.authority_name)
    in_keystore = not (keyring.places.get(IDENTITY) or template.identity_key)
    for role in ROLES:
        transaction.link(ca_certificate_path(role), "ca.cert.pem")
        if in_keystore:
            transaction.link(ca_key_path(role), "ca.key.pem")
    return Authorities(authority, authority, tuple(notes))


def load_authorities(
    keystore: OpenedKeystore, template: Template, keyring: Keyring, now: datetime
) -> Authorities:
    """Return both CAs of a keystore with their keys, ready to sign.

    Raises:
        KeystoreError: a CA is missing, does not fit its key, or is not valid at ``now``.
    """
    identity = load_authority(keystore, IDENTITY, template, keyring, now)
    permissions = load_authority(keystore, PERMISSIONS, template, keyring, now)
    return Authorities(identity, permissions)


def load_authority(
    keystore: OpenedKeystore, role: str, template: Template, keyring: Keyring, now: datetime
) -> Authority:
    """Return the identity or permissions CA with its key, ready to sign.

    Raises:
        KeystoreError: the CA is missing, does not fit its key, or is not valid at ``now``.
    """
    root = keystore.root
    if not keystore.has(ca_certificate_path(role)) and not keystore.has(ca_key_path(role)):
        raise KeystoreError(
            f"keystore '{root}' has no {role} CA",
            "Perhaps it is an export for a robot: an export has enclaves, but no CA to create "
            "more.",
            "Use the keystore that it was exported from.",
        )
    certificate = keystore.ca_certificate(role)
    service = keyring.ca_service(root, role, template)
    key = None if service else keyring.open(keystore, role, template)
    if key and not same_key(certificate, key):
        raise KeystoreError(
            f"the key and the certificate of the {role} CA do not belong together",
            f"'{keyring.place(role, template)}' is not the key of "
            f"'{root / ca_certificate_path(role)}', so its signatures could not be verified.",
            "Restore both from a backup.",
        )
    validity = validity_of(certificate)
    if not validity.contains(now):
        raise KeystoreError(
            f"the {role} CA {authority_text(certificate)} is not valid now",
            f"It is valid from {iso(validity.not_before)} to {iso(validity.not_after)}, and DDS "
            "refuses the certificates and documents of a CA outside its validity.",
            WAIT_FOR_CA
            if now < validity.not_before
            else "Check the clock of this machine. If it is right, replace the CA: `sros rotate_ca "
            f"{quote(str(root))} --finish`.",
        )
    return Authority(certificate, key, service)


def write_bundle(
    transaction: Transaction,
    file: str,
    roles: Sequence[str],
    bundle: bytes,
    names: Sequence[str],
) -> None:
    """Stage ``bundle`` (PEM) as a CA file, and as the copies of this file in enclaves.

    ``file`` is the file's name without the suffix ``.cert.pem``.  ``roles`` are the roles of the
    CA, and ``names`` the enclaves of the keystore.
    """
    transaction.write(f"{PUBLIC}/{file}.cert.pem", bundle)
    for role in roles:
        write_copies(transaction, names, f"{role}_ca.cert.pem", bundle)


def write_copies(transaction: Transaction, names: Sequence[str], file: str, data: bytes) -> None:
    """Stage ``data`` as the ``file`` of all enclaves in ``names`` that have a copy, not a link."""
    for enclave in names:
        path = f"{enclave_folder(enclave)}/{file}"
        if (transaction.root / path).is_file() and not (transaction.root / path).is_symlink():
            transaction.write(path, data)


# ── checks of an existing CA before a keystore imports it ─────────────────────────────────


_MOST_CERTIFICATES = 8


@dataclass(frozen=True, slots=True)
class ImportedAuthority:
    """An existing CA: its certificate, the chain up to the root, and notes.

    ``bundle`` is the PEM for the CA file: the issuing certificate first, the root last.
    """

    certificate: x509.Certificate
    bundle: bytes
    notes: tuple[Note, ...]


def check_imported_ca(
    role: str, data: bytes, key: PrivateKey | None, now: datetime
) -> ImportedAuthority:
    """Return the CA to which ``key`` belongs, with its chain, after checks.

    ``data`` has the certificates of the CA and of its issuers as PEM, in any order; without a
    ``key``, the first certificate belongs to the CA.  Faults that only some DDS vendors refuse
    become notes.

    Raises:
        PkiError: the CA cannot be the ``role`` CA.
    """
    certificates = list(load_certificates(data, f"of the {role} CA"))
    own = [certificate for certificate in certificates if key is None or same_key(certificate, key)]
    if len(certificates) > _MOST_CERTIFICATES:
        raise PkiError(
            f"the certificate file of the {role} CA has {len(certificates)} certificates",
            f"At most {_MOST_CERTIFICATES} are allowed.",
            "Put only the CA and its issuers up to the root into the file.",
        )
    if not own:
        raise PkiError(
            f"the certificate of the {role} CA does not fit its key",
            "The key belongs to no certificate in the file.",
            "Name the certificate and the key of the same CA.",
        )
    for weak in filter(None, map(weakness, certificates)):
        raise PkiError(
            f"{subject_text(own[0].subject)} cannot be the {role} CA: {weak}",
            "Whoever forges its signatures can issue any identity or any permissions.",
            "Use a CA with EC prime256v1 or RSA 2048 keys, signed with SHA-256, or let sros create "
            "one.",
        )
    chain = list(_chain_to_root(own[0], certificates, role))
    for authority in chain:
        _check_ca(authority, role, now)
    refusals = authority_refusals(role, tuple(chain), now)
    if len(refusals) == len(TESTED):
        raise PkiError(
            f"{subject_text(own[0].subject)} cannot be the {role} CA: no DDS vendor accepts it",
            f"{refusals_text(refusals)}.",
            "Issue the CA's certificate again, self-signed, with SHA-256, basicConstraints "
            "CA:TRUE, and keyUsage keyCertSign and digitalSignature.",
        )
    return ImportedAuthority(
        own[0], b"".join(map(pem, chain)), tuple(_refusal_notes(role, chain, refusals))
    )


def _chain_to_root(
    start: x509.Certificate, certificates: list[x509.Certificate], role: str
) -> Iterator[x509.Certificate]:
    """Yield ``start`` and its issuers, up to the self-signed root."""
    current, left = start, [issuer for issuer in certificates if issuer != start]
    yield current
    while not issued_by(current, current):
        above = next((issuer for issuer in left if issued_by(current, issuer)), None)
        if above is None:
            raise PkiError(
                f"the chain of the {role} CA has no root",
                f"The issuer {subject_text(current.issuer)} is not in the file.",
                "Put all certificates up to the self-signed root into one PEM file.",
            )
        left.remove(above)
        current = above
        yield current


def _check_ca(certificate: x509.Certificate, role: str, now: datetime) -> None:
    """Raise `PkiError` if a certificate says that it is not a CA, or is not valid at ``now``.

    If a certificate does not say whether it is a CA, the decision is left to the vendors.
    """
    name = subject_text(certificate.subject)
    if denies_issuing(certificate):
        raise PkiError(
            f"{name} cannot be the {role} CA",
            "Its certificate does not allow it to issue certificates.",
            "It needs basicConstraints CA:TRUE, and keyCertSign in its keyUsage.",
        )
    validity = validity_of(certificate)
    if not validity.contains(now):
        raise PkiError(
            f"{name} cannot be the {role} CA now",
            f"It is valid from {iso(validity.not_before)} to {iso(validity.not_after)}.",
        )


def _refusal_notes(
    role: str, chain: list[x509.Certificate], refusals: Mapping[Vendor, str]
) -> Iterator[Note]:
    name = subject_text(chain[0].subject)
    if len(chain) > 1:
        yield Note(
            "portable.intermediate", f"{name} is an intermediate CA. {refusals_text(refusals)}."
        )
    elif role == PERMISSIONS and (fault := next(purpose_faults(chain), "")):
        yield Note(
            "portable.ca-purpose",
            f"{fault}: Fast DDS 2.9.1 and Cyclone DDS 0.10.2 refuse all documents that the CA "
            "signs "
            '("unsuitable certificate purpose"). If a robot runs one of these, issue the '
            "CA's certificate again with keyUsage digitalSignature and without extendedKeyUsage.",
        )
    for certificate in chain:
        key, name = certificate.public_key(), subject_text(certificate.subject)
        if role == IDENTITY and not is_portable(key):
            yield Note(
                "portable.key-algorithm",
                f"{name} has a key of {algorithm(key)}; Cyclone DDS accepts only EC secp256r1 and "
                "RSA 2048.",
            )
        if not isinstance(certificate.signature_hash_algorithm, hashes.SHA256):
            yield Note(
                "portable.signature-hash",
                f"{name} is not signed with SHA-256, so Fast DDS rejects this CA.",
            )
