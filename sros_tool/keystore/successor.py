"""The CAs that take the place of others: made, or found again with their keys."""

from __future__ import annotations

import secrets
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from cryptography import x509

from sros_tool.errors import KeystoreError, UsageError
from sros_tool.keystore.authority import Authority
from sros_tool.keystore.bundle import authority_files, certificates_of
from sros_tool.keystore.keyring import Keyring, check_places
from sros_tool.keystore.layout import PERMISSIONS, PRIVATE, PUBLIC, ROLES
from sros_tool.keystore.reissue import Turn
from sros_tool.keystore.rotation import Replacement, Rotation
from sros_tool.keystore.template import Template
from sros_tool.keystore.transaction import Transaction
from sros_tool.pki.certificates import common_name, digest, issue_ca, same_key
from sros_tool.validity import Window
from sros_tool.xml import read_bytes


@dataclass(frozen=True, slots=True)
class Successor:
    """A new CA, and the certificates of the one whose place it takes (with the chain above it).

    ``file`` is the stem of the CA file, ``key`` the place of the new key: a URI, or a path in the
    keystore.
    """

    file: str
    roles: tuple[str, ...]
    old: tuple[x509.Certificate, ...]
    new: Authority
    key: str

    def turn(self) -> Turn:
        """What has to be issued anew."""
        return Turn(self.old[0], self.new)

    def replacement(self) -> Replacement:
        """What is remembered of it."""
        return Replacement(self.file, digest(self.old[0]), digest(self.new.certificate), self.key)


def begin(
    transaction: Transaction,
    roles: Sequence[str],
    new_keys: Keyring,
    keyring: Keyring,
    template: Template,
    validity: Window,
    *,
    beside: bool,
) -> list[Successor]:
    """Make new CAs for ``roles`` (none: for all), and stage their keys.

    Where they go into the keystore, they go ``beside`` the present keys, or in their place.
    """
    root = transaction.root
    files = authority_files(root)
    wanted = set(roles or ROLES)
    for file, serves in files.items():
        if wanted & set(serves) and not set(serves) <= wanted:
            raise UsageError(
                f"the CA in '{PUBLIC}/{file}.cert.pem' does both jobs",
                "It can only be replaced for both.",
                "Leave out --identity and --permissions.",
            )
    check_places(new_keys, replace(template, separate_authorities=len(files) > 1))
    found = []
    for file, serves in files.items():
        if wanted & set(serves):
            _check_place(root, file, serves[0], new_keys, keyring, template)
            at = f"{PRIVATE}/{'next_' if beside else ''}{file}.key.pem"
            found.append(_make(transaction, file, serves, at, new_keys, template, validity))
    return found


def _check_place(
    root: Path, file: str, role: str, new_keys: Keyring, keyring: Keyring, template: Template
) -> None:
    if not new_keys.places.get(role) and not (root / f"{PRIVATE}/{file}.key.pem").is_file():
        raise KeystoreError(
            f"the key of the {role} CA is not in the keystore, so its successor's should not be "
            "either",
            f"It is at '{keyring.place(role, template)}'.",
            f"Name a place for the new one with --{role}-key.",
        )


def _make(
    transaction: Transaction,
    file: str,
    roles: tuple[str, ...],
    at: str,
    new_keys: Keyring,
    template: Template,
    validity: Window,
) -> Successor:
    old = certificates_of(transaction.root, file)
    present = transaction.root / f"{PRIVATE}/{file}.key.pem"
    encrypted = present.is_file() and b"ENCRYPTED" in read_bytes(present, "CA key")
    new_keys = replace(new_keys, encrypt=new_keys.encrypt or encrypted)
    place = new_keys.places.get(roles[0], "")
    key = new_keys.make(
        transaction, at, roles[0], replace(template, identity_key="", permissions_key="")
    )
    if same_key(old[0], key):
        raise KeystoreError(
            f"the key at '{place}' is that of the present {roles[0]} CA",
            "A new CA needs a new key.",
            "Name another place.",
        )
    # Fast DDS refuses peers whose permissions CA has another name (2.9.1: ran).
    name = old[0].subject
    if PERMISSIONS not in roles:
        name = common_name(f"{template.authority_name} identity CA {secrets.token_hex(4)}")
    certificate = issue_ca(key, name, validity)
    return Successor(file, roles, old, Authority(certificate, key), place or at)


def resume(root: Path, rotation: Rotation, keyring: Keyring, template: Template) -> list[Successor]:
    """The new CAs that were distributed, with their keys."""
    found = []
    files = authority_files(root)
    for each in rotation.replacements:
        roles = files[each.file]
        certificates = certificates_of(root, each.file)
        (new,) = [one for one in certificates if digest(one) == each.new]
        moved = replace(template, identity_key=each.key, permissions_key=each.key)
        key = replace(keyring, places={}).open(root, roles[0], moved)
        if not same_key(new, key):
            raise KeystoreError(
                f"the key at '{each.key}' is not that of the new {roles[0]} CA",
                "",
                "Restore it from a backup.",
            )
        old = tuple(one for one in certificates if one != new)
        found.append(Successor(each.file, roles, old, Authority(new, key), each.key))
    return found


def check_later(old: x509.Certificate, new: x509.Certificate) -> None:
    """Raise `UsageError` where a new CA would end before the old one, which nobody asked for."""
    if new.not_valid_after_utc < old.not_valid_after_utc:
        raise UsageError(
            "the new CA would end before the old one",
            f"The old one ends at {old.not_valid_after_utc:%Y-%m-%d}, the new one would at "
            f"{new.not_valid_after_utc:%Y-%m-%d}.",
            "Say how long it is to be valid with --ca-validity.",
        )
