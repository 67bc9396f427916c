"""The identity CA and the permissions CA of a keystore: creating them, and loading them to sign.

The issuing CA is the first certificate of a CA file, because Cyclone DDS 0.10.2 reads only the
first one.  Fast DDS 2.9.1 trusts all CAs in the file, and also reads a revocation list in it.
"""

from __future__ import annotations

import secrets
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime

from cryptography import x509

from sros_tool.errors import KeystoreError, Note, check_meaning
from sros_tool.keystore.authorities.imported import check_imported
from sros_tool.keystore.authorities.keyring import Keyring, check_imported_keys, check_places
from sros_tool.keystore.layout import (
    IDENTITY,
    PERMISSIONS,
    PRIVATE,
    PUBLIC,
    ROLES,
    ca_certificate,
    ca_key,
    enclave_folder,
)
from sros_tool.keystore.reader import Keystore
from sros_tool.keystore.template import Template
from sros_tool.keystore.transaction.transaction import Transaction
from sros_tool.pki import smime
from sros_tool.pki.certificates import (
    Issuer,
    authority_text,
    check_signer,
    common_name,
    issue_ca,
    pem,
    same_key,
    validity_of,
)
from sros_tool.pki.keys import PrivateKey
from sros_tool.pki.token import TokenKey
from sros_tool.validity import iso, window


@dataclass(frozen=True, slots=True)
class Authority:
    """A certificate authority that can sign."""

    certificate: x509.Certificate
    key: PrivateKey

    @property
    def on_token(self) -> bool:
        """Whether a token has the key, so that forked processes cannot sign."""
        return isinstance(self.key, TokenKey)

    def __post_init__(self) -> None:
        check_signer(self.certificate)

    def issuer(self) -> Issuer:
        """Return an `Issuer` that signs certificates with this CA."""
        return Issuer(self.certificate, self.key)

    def sign(self, document: bytes, what: str) -> bytes:
        """Return ``document`` as a signed S/MIME message (``.p7s``).

        The message is parsed again, to check its digest and its content.  ``what`` names the
        document in the error.

        Raises:
            PkiError: the message does not contain ``document`` with a correct digest.
        """
        return self.sign_all((document,), what)[0]

    def sign_all(self, documents: Sequence[bytes], what: str) -> list[bytes]:
        """Return each of some documents as `sign` does.

        Small ones take less time, because each step is done for several of them in a row.
        """
        messages: list[bytes] = []
        for some in _in_a_row(documents):
            signed = [smime.sign(each, self.certificate, self.key) for each in some]
            parsed = [smime.parse_new(each) for each in signed]
            for document, found in zip(some, parsed, strict=True):
                meant = document.replace(b"\r\n", b"\n")
                check_meaning((found.digest_matches(), found.text), (True, meant), what)
            messages += signed
        return messages


_BYTES_IN_A_ROW = 1 << 18


def _in_a_row(documents: Sequence[bytes]) -> Iterator[Sequence[bytes]]:
    """Yield the documents in order, several small ones together and each large one alone."""
    begin = size = 0
    for end, each in enumerate(documents):
        size += len(each)
        if size > _BYTES_IN_A_ROW and end > begin:
            yield documents[begin:end]
            begin, size = end, len(each)
    yield documents[begin:]


@dataclass(frozen=True, slots=True)
class Authorities:
    """The identity CA and permissions CA of a keystore, which may be the same CA."""

    identity: Authority
    permissions: Authority
    notes: tuple[Note, ...] = ()


def create_authorities(
    transaction: Transaction,
    template: Template,
    keyring: Keyring,
    now: datetime,
    imported: Mapping[str, bytes],
) -> Authorities:
    """Stage the CAs of a new keystore and return them, ready to sign.

    ``imported`` maps roles ("identity", "permissions") to the PEM of an existing CA, which is then
    used instead of a new one.

    Raises:
        KeystoreError: the places of the CA keys do not fit the template.
        UsageError: an imported CA comes without its key, or does not fit the template.
        PkiError: an imported CA cannot be used.
    """
    check_places(keyring, template)
    check_imported_keys(imported, keyring, template)
    validity = window(now, template.authority_validity)
    # Separate CAs get unique names, so that messages and diagrams distinguish keystores.
    serial = secrets.token_hex(4)
    notes: list[Note] = []

    def make(file: str, role: str, name: str) -> Authority:
        at = f"{PRIVATE}/{file}.key.pem"
        key = keyring.make(transaction, at, role, template, compared=role in imported)
        if role in imported:
            found = check_imported(role, imported[role], key, now)
            certificate, bundle = found.certificate, found.bundle
            notes.extend(found.notes)
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
        transaction.link(ca_certificate(role), "ca.cert.pem")
        if in_keystore:
            transaction.link(ca_key(role), "ca.key.pem")
    return Authorities(authority, authority, tuple(notes))


def load_authorities(
    keystore: Keystore, template: Template, keyring: Keyring, now: datetime
) -> Authorities:
    """Return both CAs of a keystore with their keys, ready to sign.

    Raises:
        KeystoreError: a CA is missing, does not fit its key, or is not valid at ``now``.
    """
    identity = load_authority(keystore, IDENTITY, template, keyring, now)
    permissions = load_authority(keystore, PERMISSIONS, template, keyring, now)
    return Authorities(identity, permissions)


def load_authority(
    keystore: Keystore, role: str, template: Template, keyring: Keyring, now: datetime
) -> Authority:
    """Return the identity or permissions CA with its key, ready to sign.

    Raises:
        KeystoreError: the CA is missing, does not fit its key, or is not valid at ``now``.
    """
    root = keystore.root
    if not keystore.has(ca_certificate(role)) and not keystore.has(ca_key(role)):
        raise KeystoreError(
            f"keystore '{root}' has no {role} CA",
            "It may be an export for a robot, which holds enclaves but no CA to create new ones.",
            "Use the keystore that it was exported from.",
        )
    certificate = keystore.ca_certificate(role)
    key = keyring.open(keystore, role, template)
    if not same_key(certificate, key):
        raise KeystoreError(
            f"the key and the certificate of the {role} CA do not belong together",
            f"'{keyring.place(role, template)}' is not the key of "
            f"'{root / ca_certificate(role)}', so its signatures could not be verified.",
            "Restore both from a backup.",
        )
    validity = validity_of(certificate)
    if not validity.contains(now):
        raise KeystoreError(
            f"the {role} CA {authority_text(certificate)} is not valid now",
            f"It is valid from {iso(validity.not_before)} to {iso(validity.not_after)}, and DDS "
            "refuses the certificates and documents of a CA outside its validity.",
            "Check the clock of this machine; otherwise make a new keystore.",
        )
    return Authority(certificate, key)


def write_bundle(
    transaction: Transaction,
    file: str,
    roles: Sequence[str],
    bundle: bytes,
    names: Sequence[str],
) -> None:
    """Stage ``bundle`` (PEM) as the CA file named ``file``, and update its copies in enclaves.

    ``file`` lacks the suffix ``.cert.pem``; ``roles`` are the roles of the CA, ``names`` the
    enclaves of the keystore.
    """
    transaction.write(f"{PUBLIC}/{file}.cert.pem", bundle)
    for role in roles:
        write_copies(transaction, names, f"{role}_ca.cert.pem", bundle)


def write_copies(transaction: Transaction, names: Sequence[str], name: str, data: bytes) -> None:
    """Stage ``data`` as file ``name`` in each enclave that has a regular file there, not a link."""
    for enclave in names:
        path = f"{enclave_folder(enclave)}/{name}"
        if (transaction.root / path).is_file() and not (transaction.root / path).is_symlink():
            transaction.write(path, data)
