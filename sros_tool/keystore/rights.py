"""Reads the rights that a policy, a permissions document, an enclave or a keystore gives.

What DDS loads is ``permissions.p7s``, so that counts in enclaves and keystores.  Its signature is
verified against the permissions CA that lies with it.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

from cryptography import x509

from sros_tool.dds.permissions import Grant, Permissions, parse_permissions
from sros_tool.errors import DocumentError, Note, SrosError
from sros_tool.keystore.layout import (
    PERMISSIONS,
    PUBLIC,
    enclave_names,
    enclave_path,
    is_keystore,
)
from sros_tool.pki import smime
from sros_tool.pki.certificates import load_certificate
from sros_tool.policy.document import read_policy
from sros_tool.policy.rights import Right, policy_rights
from sros_tool.translate import grant_rights
from sros_tool.xml import parse, read_bytes

_SIGNED = "permissions.p7s"
_AUTHORITY = f"{PERMISSIONS}_ca.cert.pem"
_COMMON_NAME = re.compile(r"(?:^|[,/])\s*CN\s*=\s*(/[^,]*?)\s*(?:,|$)")


@dataclass(frozen=True, slots=True)
class RightsSource:
    """What a file or folder says of rights.

    ``kind`` is policy, permissions, enclave or keystore.  ``scope`` are the enclaves of which it
    can speak; None where it speaks of all.  ``sound`` is False where DDS would refuse some of it:
    a signature that does not verify, permissions that are missing or cannot be read.
    """

    path: Path
    kind: str
    rights: frozenset[Right]
    scope: frozenset[str] | None
    sound: bool
    notes: tuple[Note, ...]


def load_rights(path: Path) -> RightsSource:
    """The rights that lie at ``path``.

    A policy file, ``permissions.p7s`` or ``permissions.xml``, the folder of an enclave, or a
    keystore.  Raises `DocumentError` for anything else.
    """
    if path.is_dir():
        if is_keystore(path):
            return _keystore(path)
        if (path / _SIGNED).exists():
            return _one(path, "enclave", path / _SIGNED)
        raise DocumentError(
            f"'{path}' is neither a keystore nor an enclave",
            f"It has no enclaves folder, and no {_SIGNED}.",
        )
    data = read_bytes(path, "file")
    signed = b"multipart/signed" in data[:1000].lower()
    if not signed and parse(data, f"'{path}'").tag == "policy":
        policy = read_policy(path)
        return RightsSource(path, "policy", policy_rights(policy), None, True, ())
    return _one(path, "permissions", path)


def _one(path: Path, kind: str, file: Path) -> RightsSource:
    reader = _Reader()
    rights, scope = reader.permissions(file, str(path))
    return RightsSource(
        path, kind, rights, frozenset(scope), reader.sound, tuple(reader.unsure + reader.notes)
    )


def _keystore(root: Path) -> RightsSource:
    reader = _Reader()
    rights: set[Right] = set()
    for name in enclave_names(root):
        file = enclave_path(root, name) / _SIGNED
        try:
            found, scope = reader.permissions(file, name)
        except SrosError as error:
            reader.sound = False
            reader.notes.append(Note("rights.unreadable", f"{name}: {error}"))
            continue
        rights |= found
        if foreign := sorted(set(scope) - {name}):
            text = f"{name}: its permissions are for {', '.join(foreign)}, and DDS refuses them."
            reader.sound = False
            reader.notes.append(Note("rights.foreign-grant", text))
    return RightsSource(
        root,
        "keystore",
        frozenset(rights),
        None,
        reader.sound,
        tuple(reader.unsure[:1] + reader.notes),
    )


@dataclass(slots=True)
class _Reader:
    """Reads permissions, and remembers what is to be said about them."""

    sound: bool = True
    unsure: list[Note] = field(default_factory=list)
    notes: list[Note] = field(default_factory=list)
    _authorities: dict[bytes, x509.Certificate] = field(default_factory=dict)

    def permissions(self, file: Path, what: str) -> tuple[frozenset[Right], tuple[str, ...]]:
        """The rights in a permissions document, signed or not, and the enclaves it is for."""
        data = read_bytes(file, "permissions document")
        if b"multipart/signed" in data[:1000].lower():
            try:
                signed = smime.parse(data)
            except SrosError as error:
                raise DocumentError(f"'{file}' cannot be read: {error.what}", error.why) from error
            self._verify(signed, file, what)
            data = signed.document
        else:
            self.unsure.append(
                Note("rights.unsigned", f"{what}: not signed. DDS loads {_SIGNED} instead.")
            )
        permissions = parse_permissions(data, f"'{file}'")
        self.notes += [
            Note(note.id, f"{what}: {note.text}") for note in _left_out(permissions.grants)
        ]
        grants = _first_of_each(permissions)
        rights = (right for name, grant in grants.items() for right in grant_rights(name, grant))
        return frozenset(rights), tuple(grants)

    def _verify(self, signed: smime.SignedDocument, file: Path, what: str) -> None:
        try:
            authority = self._authority_beside(file)
            if authority is None:
                text = f"{what}: the signature was not verified, for no {_AUTHORITY} lies with it."
                self.unsure.append(Note("rights.not-verified", text))
                return
            signed.verify(authority)
        except SrosError as error:
            self.sound = False
            text = f"{what}: THE SIGNATURE DOES NOT VERIFY, and DDS refuses it: {error}"
            self.notes.append(Note("rights.bad-signature", text.rstrip(".") + "."))

    def _authority_beside(self, file: Path) -> x509.Certificate | None:
        folder = file.absolute().parent
        for path in (folder / _AUTHORITY, folder.parent / PUBLIC / _AUTHORITY):
            if path.exists():
                data = read_bytes(path, "certificate")
                if data not in self._authorities:
                    self._authorities[data] = load_certificate(data, f"'{path}'")
                return self._authorities[data]
        return None


def _first_of_each(permissions: Permissions) -> dict[str, Grant]:
    """The grant of each enclave: DDS reads the first one of a subject only."""
    grants: dict[str, Grant] = {}
    for grant in permissions.grants:
        grants.setdefault(_enclave_of(grant), grant)
    return grants


def _enclave_of(grant: Grant) -> str:
    """An enclave's name is the common name of its certificate; else the grant's own name."""
    match = _COMMON_NAME.search(grant.subject)
    return match[1] if match else grant.name or grant.subject


def _left_out(grants: Iterable[Grant]) -> Iterator[Note]:
    """Remarks on what a grant says and rights in ROS terms do not."""
    seen: set[str] = set()
    for grant in grants:
        name = _enclave_of(grant)
        if name in seen:
            text = f"a further grant for {grant.subject} is left out: DDS reads the first one only."
            yield Note("rights.later-grant", text)
            continue
        seen.add(name)
        if grant.default_allow:
            text = "what no rule names is allowed by <default>, except on Fast DDS."
            yield Note("rights.default-allow", text)
        if any(c.partitions for r in grant.rules for c in (*r.publish, *r.subscribe)):
            yield Note("rights.partitions", "its partitions are left out of the comparison.")
        if len({rule.domains for rule in grant.rules}) > 1:
            text = "its rules are for different domains, which are left out of the comparison."
            yield Note("rights.domains", text)
        kinds = [rule.allow for rule in grant.rules]
        if False in kinds[kinds.index(True) if True in kinds else len(kinds) :]:
            text = "a deny_rule stands after an allow_rule; DDS takes the first one that matches."
            yield Note("rights.rule-order", text)
