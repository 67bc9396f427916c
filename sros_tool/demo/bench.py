"""The workbench of a forger: a copy of a keystore, and the moves that forgeries are made of."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import datetime
from pathlib import Path

from cryptography import x509

from sros_tool.dds.permissions import (
    Criteria,
    Permissions,
    Rule,
    parse_permissions,
    render_permissions,
)
from sros_tool.keystore.authority import Authorities, load_authorities
from sros_tool.keystore.enclave import enclave_path
from sros_tool.keystore.keyring import IN_KEYSTORE, Keyring
from sros_tool.keystore.open import load_settings
from sros_tool.pki import smime
from sros_tool.pki.certificates import load_certificate, pem
from sros_tool.pki.keys import PrivateKey, generate_key, key_pem, load_key
from sros_tool.validity import Window

PERMISSIONS, GOVERNANCE = "permissions.p7s", "governance.p7s"
CERTIFICATE, KEY = "cert.pem", "key.pem"
PERMISSIONS_CA, IDENTITY_CA = "permissions_ca.cert.pem", "identity_ca.cert.pem"


@dataclass(frozen=True)
class Bench:
    """``root`` is the copy that is worked on, ``foreign`` another keystore with the same names.

    ``cast`` has the enclave of each part; ``topic`` is the ROS topic that attackers are after,
    ``domain`` one of the keystore's; ``keyring`` says where the keys of the copy's CAs are.
    """

    root: Path
    foreign: Path
    cast: Mapping[str, str]
    topic: str
    domain: int
    now: datetime
    keyring: Keyring = IN_KEYSTORE

    def folder(self, part: str) -> Path:
        """The folder of the enclave that plays a part.  Raises `KeyError`."""
        return enclave_path(self.root, self.cast[part])

    def authorities(self, root: Path | None = None) -> Authorities:
        """The CAs, with their keys, of the copy or of another keystore.

        Raises `SrosError` where the keys are not there.
        """
        keyring = IN_KEYSTORE if root else self.keyring
        root = root or self.root
        return load_authorities(root, load_settings(root), keyring, self.now)

    def put(self, part: str, name: str, data: bytes) -> None:
        """Replace a file of an enclave; a link is replaced, not followed."""
        file = self.folder(part) / name
        file.unlink(missing_ok=True)
        file.touch(0o600)
        file.write_bytes(data)

    def read(self, part: str, name: str) -> bytes:
        """A file of an enclave."""
        return (self.folder(part) / name).read_bytes()

    def certificate(self, part: str) -> x509.Certificate:
        """The certificate of an enclave."""
        return load_certificate(self.read(part, CERTIFICATE), self.cast[part])

    def key(self, part: str) -> PrivateKey:
        """The key of an enclave."""
        return load_key(self.read(part, KEY), self.cast[part])

    def permissions(self, part: str) -> Permissions:
        """What the permissions of an enclave say."""
        return parse_permissions(smime.parse(self.read(part, PERMISSIONS)).document)

    def governance(self) -> bytes:
        """The signed governance of the keystore, as XML."""
        part = next(iter(self.cast))
        return smime.parse(self.read(part, GOVERNANCE)).document

    def wanted(
        self, part: str, publish: Sequence[str] = (), subscribe: Sequence[str] = ()
    ) -> bytes:
        """The permissions of an enclave with more DDS topics in its first allow rule, as XML."""
        permissions = self.permissions(part)
        grant = permissions.grants[0]
        place = next(place for place, rule in enumerate(grant.rules) if rule.allow)
        rules = list(grant.rules)
        rules[place] = _with(rules[place], publish, subscribe)
        grants = (replace(grant, rules=tuple(rules)), *permissions.grants[1:])
        return render_permissions(Permissions(grants))

    def sign(self, document: bytes, root: Path | None = None) -> bytes:
        """A document signed by the permissions CA of this keystore, or of another one."""
        authority = self.authorities(root).permissions
        return smime.sign(document, authority.certificate, authority.key)

    def reissue(
        self, part: str, validity: Window, *, new_key: bool = False, subject_of: str = ""
    ) -> None:
        """Give an enclave another certificate, and perhaps a new key.

        Its subject stays, or becomes that of the part ``subject_of``.
        """
        subject = self.certificate(subject_of or part).subject
        key = generate_key() if new_key else self.key(part)
        issuer = self.authorities().identity.issuer()
        self.put(part, CERTIFICATE, pem(issuer.issue(subject, key.public_key(), validity)))
        if new_key:
            self.put(part, KEY, key_pem(key))

    @property
    def dds_topic(self) -> str:
        """The DDS name of the topic that attackers are after."""
        return f"rt{self.topic}"


Forge = Callable[[Bench], None]
"""Turns the copy on the bench into what an attacker would use."""


def copy_keystore(source: Path, target: Path) -> None:
    """A copy with its links as they are."""
    target.parent.mkdir(parents=True, exist_ok=True)
    shutil.copytree(source, target, symlinks=True)


def _with(rule: Rule, publish: Sequence[str], subscribe: Sequence[str]) -> Rule:
    return replace(
        rule,
        publish=_more(rule.publish, publish),
        subscribe=_more(rule.subscribe, subscribe),
    )


def _more(criteria: tuple[Criteria, ...], topics: Sequence[str]) -> tuple[Criteria, ...]:
    if not topics:
        return criteria
    if not criteria:
        return (Criteria(tuple(topics)),)
    first = criteria[0]
    return (replace(first, topics=(*first.topics, *topics)), *criteria[1:])
